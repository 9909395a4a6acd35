//! Who may do what on a farm that others can reach: its certificate, and tokens, which are kept as
//! hashes. In a farm's state there is a folder for both:
//!
//! ```text
//! access/authority      the farm's own authority: its certificate and key, as PEM
//! access/certificate    what the coordinator shows: likewise, vouched for by the authority
//! access/tokens         the address, then a line a token: its holder's name and its BLAKE3 hash
//! access/submit, work, read, admin     access files, to be handed to those who need them
//! access/submit.NAME    likewise, of one whose orders are counted by themselves
//! ```
//!
//! Tokens are 32 random bytes: a plain hash of one tells nothing.

use std::{
    collections::BTreeSet,
    fmt,
    fs::{self, DirBuilder, Metadata},
    io::{self, Write},
    os::unix::fs::{DirBuilderExt, MetadataExt},
    path::{Path, PathBuf},
    str::FromStr,
    sync::{Arc, Mutex},
    time::Duration,
};

use blake3::Hash;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, KeyUsagePurpose,
    date_time_ymd,
};
use rtfarm_proto::{Access, Address, CERTIFIED_NAME};
use tempfile::NamedTempFile;
use tokio::time::Instant;
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        ServerConfig,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _},
    },
};
use tonic::{Code, Status};

const FOLDER: &str = "access";
const AUTHORITY: &str = "authority";
const CERTIFICATE: &str = "certificate";
const TOKENS: &str = "tokens";

/// A token that is revoked is not taken this long afterwards, at the latest.
const REREAD: Duration = Duration::from_secs(1);

/// A certificate is good to this day: who could take its key could take the authority's as well.
const LAST_DAY: (i32, u8, u8) = (4096, 1, 1);

/// The end of a certificate as PEM.
const END: &str = "-----END CERTIFICATE-----\n";

/// What somebody may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Order pictures and look after the jobs.
    Submit,
    /// Render.
    Work,
    /// Look.
    Read,
    /// Everything.
    Admin,
}

impl Role {
    const ALL: [Self; 4] = [Self::Submit, Self::Work, Self::Read, Self::Admin];

    fn name(self) -> &'static str {
        match self {
            Self::Submit => "submit",
            Self::Work => "work",
            Self::Read => "read",
            Self::Admin => "admin",
        }
    }

    /// Says whether who has this role may call that method, by its path.
    fn may(self, path: &str) -> bool {
        let path = path.trim_start_matches('/');
        let (service, method) = match path.split_once('/') {
            Some(named) => named,
            None if path == "metrics" => ("page", path),
            None => return false,
        };
        let reads = matches!(method, "List" | "Workers" | "Watch" | "Image" | "Explain");
        match (self, service) {
            (Self::Admin, _)
            | (Self::Work, "rtfarm.v1.Farm")
            | (Self::Read | Self::Submit, "page") => true,
            (Self::Read, "rtfarm.v1.Jobs") => reads,
            (Self::Submit, "rtfarm.v1.Jobs") => {
                reads || matches!(method, "Submit" | "Cancel" | "Control")
            }
            _ => false,
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let role = Self::ALL.into_iter().find(|role| role.name() == name);
        role.ok_or_else(|| format!("`{name}` is no role; there are submit, work, read and admin"))
    }
}

/// The name of one whose orders are counted by themselves: 1 to 32 letters, digits, `-` and `_`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Owner(String);

impl FromStr for Owner {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_".contains(&byte);
        if (1..=32).contains(&name.len()) && name.bytes().all(is_plain) {
            Ok(Self(name.to_owned()))
        } else {
            Err("it is no owner's name, which has 1 to 32 letters, digits, `-` and `_`".to_owned())
        }
    }
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Whose a token is. Only one to submit may have an owner. Its text is that of its file's name:
/// `work`, or `submit.NAME`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Holder {
    role: Role,
    owner: Option<Owner>,
}

impl Holder {
    /// Who has a role, as this owner if one is named.
    pub fn new(role: Role, owner: Option<Owner>) -> Result<Self, String> {
        if owner.is_some() && role != Role::Submit {
            return Err(format!("owners have tokens to submit, not to {role}"));
        }
        Ok(Self { role, owner })
    }

    /// What its token allows.
    pub(crate) fn role(&self) -> Role {
        self.role
    }

    /// Who orders by it; `None` when the token is one for all.
    pub(crate) fn owner(&self) -> Option<&Owner> {
        self.owner.as_ref()
    }
}

impl From<Role> for Holder {
    fn from(role: Role) -> Self {
        Self { role, owner: None }
    }
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.owner {
            Some(owner) => write!(f, "{}.{owner}", self.role),
            None => self.role.fmt(f),
        }
    }
}

impl FromStr for Holder {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('.') {
            Some((role, owner)) => Self::new(role.parse()?, Some(owner.parse()?)),
            None => text.parse::<Role>().map(Self::from),
        }
    }
}

/// Why a farm's certificate or tokens cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SecurityError {
    /// A file cannot be read or written.
    #[error("{path}: {error}", path = .0.display(), error = .1)]
    Io(PathBuf, io::Error),
    /// A file does not hold what it should.
    #[error("{path} is damaged; remove the folder to have new certificates and tokens", path = .0.display())]
    Damaged(PathBuf),
    /// No certificate can be made.
    #[error("cannot make a certificate: {0}")]
    Certificate(#[from] rcgen::Error),
    /// There is nothing to change.
    #[error("there are no tokens in {}: a coordinator makes them when it starts there", .0.display())]
    None(PathBuf),
    /// An owner has no token to revoke.
    #[error("{owner} has no token; {}", who_have(.others))]
    NoToken {
        /// The owner.
        owner: Owner,
        /// Those who have one, in alphabetical order.
        others: Vec<Owner>,
    },
}

/// Says that these, in this order, have something.
fn who_have(owners: &[Owner]) -> String {
    let names: Vec<&str> = owners.iter().map(|Owner(name)| &**name).collect();
    match names.split_last() {
        None => "no owner has".to_owned(),
        Some((last, [])) => format!("{last} has"),
        Some((last, others)) => format!("{} and {last} have", others.join(", ")),
    }
}

/// The certificate and the tokens of a farm, in a folder.
#[derive(Debug)]
pub struct Security {
    folder: PathBuf,
    /// What the folder said when it was read.
    known: Mutex<Known>,
}

#[derive(Debug)]
struct Known {
    tokens: Tokens,
    /// By which the file is known that was read.
    stamp: Option<(u64, i64, i64)>,
    read_at: Instant,
}

/// The address in the access files, and the hash of each token.
#[derive(Debug, Clone, Default, PartialEq)]
struct Tokens {
    address: String,
    hashes: Vec<(Holder, Hash)>,
}

impl Security {
    /// Opens what a farm's state has, and makes what it lacks: an authority, a certificate, a token
    /// and an access file for each role. `address` is where others find the coordinator.
    pub fn open(state: &Path, address: &Address) -> Result<Self, SecurityError> {
        let folder = state.join(FOLDER);
        if !folder.exists() {
            DirBuilder::new()
                .mode(0o700)
                .create(&folder)
                .map_err(|error| SecurityError::Io(folder.clone(), error))?;
        }
        if !folder.join(CERTIFICATE).exists() {
            make_certificates(&folder, LAST_DAY)?;
        }
        let is_new = !folder.join(TOKENS).exists();
        let mut tokens = if is_new { Tokens::default() } else { Tokens::read(&folder)? };
        // A folder that others look after, such as a secret of Kubernetes, is not written to.
        let address_text = address.to_string();
        if tokens.address != address_text {
            tokens.address = address_text;
            tokens.write(&folder)?;
        }
        let holders = Role::ALL.map(Holder::from).into_iter();
        let owners = tokens.hashes.into_iter().map(|(holder, _)| holder);
        for holder in holders.chain(owners.filter(|holder| holder.owner.is_some())) {
            let path = folder.join(holder.to_string());
            if is_new {
                renew_in(&folder, &holder)?;
            } else if let Ok(text) = fs::read_to_string(&path)
                && let Ok(access) = Access::read(&text)
                && access.address() != address
                && let Some(moved) = access.at(address.clone()).text()
            {
                write(&path, &moved)?;
            }
        }
        let known = Known { tokens: Tokens::read(&folder)?, stamp: None, read_at: Instant::now() };
        Ok(Self { folder, known: Mutex::new(known) })
    }

    /// What the coordinator shows to those who connect: workers and clients speak HTTP/2, browsers
    /// that or HTTP/1.1.
    pub(crate) fn tls(&self) -> io::Result<TlsAcceptor> {
        let pem = fs::read(self.folder.join(CERTIFICATE))?;
        let chain = CertificateDer::pem_slice_iter(&pem).collect::<Result<Vec<_>, _>>();
        let chain = chain.map_err(io::Error::other)?;
        let key = PrivateKeyDer::from_pem_slice(&pem).map_err(io::Error::other)?;
        let config = ServerConfig::builder().with_no_client_auth().with_single_cert(chain, key);
        let mut config = config.map_err(io::Error::other)?;
        config.alpn_protocols = ["h2", "http/1.1"].map(Vec::from).into();
        Ok(TlsAcceptor::from(Arc::new(config)))
    }

    /// Says as whom who shows this `Authorization` may call that method. A file of tokens that was
    /// written to is read anew.
    pub(crate) fn check(&self, path: &str, authorization: Option<&[u8]>) -> Result<Holder, Status> {
        let token = authorization.and_then(|value| value.strip_prefix(b"Bearer "));
        let Some(token) = token else {
            return Err(Status::unauthenticated(
                "a token is asked for; --access FILE names the access file that has it",
            ));
        };
        // Hashes of this kind are compared in constant time.
        let hash = blake3::hash(token);
        let known = self.known();
        let mut holders =
            known.hashes.iter().filter(|(_, known)| *known == hash).map(|(holder, _)| holder);
        match (holders.clone().find(|holder| holder.role.may(path)), holders.next()) {
            (Some(holder), _) => Ok(holder.clone()),
            (None, Some(Holder { role, .. })) => Err(Status::new(
                Code::PermissionDenied,
                format!("the token is one to {role}, which does not allow this"),
            )),
            (None, None) => Err(Status::unauthenticated("the token is not known, or not any more")),
        }
    }

    fn known(&self) -> Tokens {
        let mut known = self.known.lock().expect("nothing here panics");
        if known.stamp.is_none() || known.read_at.elapsed() >= REREAD {
            known.read_at = Instant::now();
            let of = |metadata: Metadata| (metadata.ino(), metadata.mtime(), metadata.mtime_nsec());
            let stamp = fs::metadata(self.folder.join(TOKENS)).map(of);
            match stamp {
                Ok(stamp) if known.stamp == Some(stamp) => {}
                Ok(stamp) => match Tokens::read(&self.folder) {
                    Ok(tokens) => (known.tokens, known.stamp) = (tokens, Some(stamp)),
                    Err(error) => tracing::error!(reason = %error, "cannot read the tokens"),
                },
                // Who removes the file revokes all.
                Err(_) => (known.tokens, known.stamp) = (Tokens::default(), None),
            }
        }
        known.tokens.clone()
    }
}

/// Makes a new token and access file; the holder's old one is not taken any more. Answers with the
/// file.
pub fn renew_token(state: &Path, holder: &Holder) -> Result<PathBuf, SecurityError> {
    renew_in(&of_state(state)?, holder)
}

/// Has a token not taken any more, and removes its access file. Answers with the owners who have
/// tokens of their own, which stay. It fails for an owner who has none.
pub fn revoke_token(state: &Path, holder: &Holder) -> Result<Vec<Owner>, SecurityError> {
    let folder = of_state(state)?;
    let mut tokens = Tokens::read(&folder)?;
    let is_known = tokens.hashes.iter().any(|(of, _)| of == holder);
    tokens.hashes.retain(|(of, _)| of != holder);
    let others = tokens.hashes.iter().filter_map(|(of, _)| of.owner.clone());
    let others: Vec<Owner> = others.collect::<BTreeSet<_>>().into_iter().collect();
    let path = folder.join(holder.to_string());
    if let Some(owner) = holder.owner.clone().filter(|_| !is_known && !path.exists()) {
        return Err(SecurityError::NoToken { owner, others });
    }
    tokens.write(&folder)?;
    match fs::remove_file(&path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(SecurityError::Io(path, error))
        }
        _ => Ok(others),
    }
}

fn of_state(state: &Path) -> Result<PathBuf, SecurityError> {
    let folder = state.join(FOLDER);
    if folder.join(TOKENS).exists() { Ok(folder) } else { Err(SecurityError::None(folder)) }
}

fn renew_in(folder: &Path, holder: &Holder) -> Result<PathBuf, SecurityError> {
    let (path, authority) = (folder.join(holder.to_string()), folder.join(AUTHORITY));
    let io = |error| SecurityError::Io(path.clone(), error);
    let mut tokens = Tokens::read(folder)?;
    let mut random = [0; 32];
    rustix::rand::getrandom(&mut random, rustix::rand::GetRandomFlags::empty())
        .map_err(|error| io(error.into()))?;
    let token = Hash::from_bytes(random).to_hex().to_string();
    let pem = fs::read_to_string(&authority)
        .map_err(|error| SecurityError::Io(authority.clone(), error))?;
    // The key after it is nobody else's business.
    let certificate = pem.split_inclusive(END).next().filter(|pem| pem.ends_with(END));
    let certificate = certificate.ok_or(SecurityError::Damaged(authority))?;
    let address = tokens.address.parse();
    let address = address.map_err(|_| SecurityError::Damaged(folder.join(TOKENS)))?;
    let access = Access::new(address, certificate.to_owned(), token.clone());
    // The file first: nobody has a token that is known and written nowhere.
    write(&path, &access.text().expect("it has a token"))?;
    tokens.hashes.retain(|(of, _)| of != holder);
    tokens.hashes.push((holder.clone(), blake3::hash(token.as_bytes())));
    tokens.write(folder)?;
    Ok(path)
}

impl Tokens {
    fn read(folder: &Path) -> Result<Self, SecurityError> {
        let path = folder.join(TOKENS);
        let text = fs::read_to_string(&path);
        let text = text.map_err(|error| SecurityError::Io(path.clone(), error))?;
        let mut tokens = Self::default();
        for line in text.lines() {
            let damaged = || SecurityError::Damaged(path.clone());
            let (name, value) = line.split_once(' ').ok_or_else(damaged)?;
            if name == "address" {
                value.clone_into(&mut tokens.address);
            } else {
                let holder = name.parse().map_err(|_| damaged())?;
                let hash = Hash::from_hex(value).map_err(|_| damaged())?;
                tokens.hashes.push((holder, hash));
            }
        }
        Ok(tokens)
    }

    fn write(&self, folder: &Path) -> Result<(), SecurityError> {
        let mut text = format!("address {}\n", self.address);
        for (holder, hash) in &self.hashes {
            text +=
                &[holder.to_string(), " ".to_owned(), hash.to_string(), "\n".to_owned()].concat();
        }
        write(&folder.join(TOKENS), &text)
    }
}

/// Makes an authority and a certificate that it vouches for.
pub(crate) fn make_certificates(
    folder: &Path,
    (year, month, day): (i32, u8, u8),
) -> Result<(), SecurityError> {
    let mut of_authority = CertificateParams::default();
    of_authority.distinguished_name.push(DnType::CommonName, "rtfarm authority");
    of_authority.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    of_authority.key_usages = vec![KeyUsagePurpose::KeyCertSign];
    let key = KeyPair::generate()?;
    let authority = of_authority.self_signed(&key)?;
    write(&folder.join(AUTHORITY), &(authority.pem() + &key.serialize_pem()))?;
    let issuer = Issuer::new(of_authority, key);

    let mut shown = CertificateParams::new([CERTIFIED_NAME.to_owned()])?;
    shown.distinguished_name.push(DnType::CommonName, CERTIFIED_NAME);
    shown.not_after = date_time_ymd(year, month, day);
    let key = KeyPair::generate()?;
    let certificate = shown.signed_by(&key, &issuer)?;
    write(&folder.join(CERTIFICATE), &(certificate.pem() + &key.serialize_pem()))
}

/// Writes a file that only its owner may read, beside its place, then renames it.
fn write(path: &Path, text: &str) -> Result<(), SecurityError> {
    let write = || -> io::Result<()> {
        let folder = path.parent().unwrap_or(Path::new("."));
        // Such a file has mode 0600.
        let mut file = NamedTempFile::new_in(folder)?;
        file.write_all(text.as_bytes())?;
        file.as_file().sync_all()?;
        file.persist(path)?;
        Ok(())
    };
    write().map_err(|error| SecurityError::Io(path.to_owned(), error))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn address() -> Address {
        "https://127.0.0.1:7878".parse().unwrap()
    }

    fn access(state: &Path, holder: impl Into<Holder>) -> Access {
        let name = holder.into().to_string();
        let text = fs::read_to_string(state.join(FOLDER).join(name)).unwrap();
        Access::read(&text).unwrap()
    }

    /// What becomes of a call with a token.
    fn check(security: &Security, path: &str, token: &str) -> Option<Code> {
        let shown = format!("Bearer {token}");
        security.check(path, Some(shown.as_bytes())).err().map(|status| status.code())
    }

    #[test]
    fn each_role_may_do_its_own_and_no_more() {
        let all = ["Submit", "Watch", "Image", "Cancel", "List", "Control", "Workers", "Station"];
        let may = |role: Role| -> Vec<&str> {
            let jobs =
                all.into_iter().filter(|method| role.may(&format!("/rtfarm.v1.Jobs/{method}")));
            let work = role.may("/rtfarm.v1.Farm/Deliver").then_some("Deliver");
            jobs.chain(work).collect()
        };
        assert_eq!(may(Role::Read), ["Watch", "Image", "List", "Workers"]);
        assert_eq!(may(Role::Submit), all[..7]);
        assert_eq!(may(Role::Work), ["Deliver"]);
        assert_eq!(may(Role::Admin).len(), all.len() + 1);
        assert!(!Role::Work.may("/") && !Role::Read.may("rtfarm.v1.Jobs"));
    }

    #[tokio::test(start_paused = true)]
    async fn tokens_are_renewed_and_revoked_without_a_restart_and_kept_as_hashes() {
        let state = tempfile::tempdir().unwrap();
        let security = Security::open(state.path(), &address()).unwrap();
        let submit = "/rtfarm.v1.Jobs/Submit";
        let token = access(state.path(), Role::Submit).token().unwrap().to_owned();
        assert_eq!(check(&security, submit, &token), None);
        assert_eq!(check(&security, "/rtfarm.v1.Farm/Join", &token), Some(Code::PermissionDenied));
        assert_eq!(check(&security, submit, "another"), Some(Code::Unauthenticated));
        for shown in [None, Some(&b"Basic x"[..]), Some(token.as_bytes())] {
            assert_eq!(security.check(submit, shown).unwrap_err().code(), Code::Unauthenticated);
        }
        let kept = fs::read_to_string(state.path().join("access/tokens")).unwrap();
        assert!(!kept.contains(&token));

        renew_token(state.path(), &Role::Submit.into()).unwrap();
        let renewed = access(state.path(), Role::Submit).token().unwrap().to_owned();
        tokio::time::advance(REREAD).await;
        assert_eq!(check(&security, submit, &token), Some(Code::Unauthenticated));
        assert_eq!(check(&security, submit, &renewed), None);
        revoke_token(state.path(), &Role::Submit.into()).unwrap();
        tokio::time::advance(REREAD).await;
        assert_eq!(check(&security, submit, &renewed), Some(Code::Unauthenticated));

        // The others are the same at the next start, and know the new address; the revoked stays
        // so.
        let elsewhere: Address = "https://elsewhere:1".parse().unwrap();
        let again = Security::open(state.path(), &elsewhere).unwrap();
        let worker = access(state.path(), Role::Work);
        assert_eq!(worker.address(), &elsewhere);
        assert_eq!(check(&again, "/rtfarm.v1.Farm/Join", worker.token().unwrap()), None);
        assert!(!state.path().join("access/submit").exists());
    }

    #[tokio::test(start_paused = true)]
    async fn owners_have_tokens_of_their_own_to_submit() {
        let state = tempfile::tempdir().unwrap();
        let security = Security::open(state.path(), &address()).unwrap();
        let holder = |name: &str| -> Holder { name.parse().unwrap() };
        let [ada, bo] = ["submit.ada", "submit.bo_2"].map(holder);
        for holder in [&ada, &bo] {
            renew_token(state.path(), holder).unwrap();
        }
        tokio::time::advance(REREAD).await;
        let found = |security: &Security, holder: &Holder| {
            let shown = format!("Bearer {}", access(state.path(), holder.clone()).token().unwrap());
            security.check("/rtfarm.v1.Jobs/Submit", Some(shown.as_bytes())).ok()
        };
        let all = Holder::from(Role::Submit);
        for holder in [&ada, &bo, &all] {
            assert_eq!(found(&security, holder).as_ref(), Some(holder));
        }
        let old = access(state.path(), ada.clone());
        let of_bo = access(state.path(), bo.clone());
        let of_adda = revoke_token(state.path(), &holder("submit.adda")).unwrap_err();
        assert_eq!(of_adda.to_string(), "adda has no token; ada and bo_2 have");
        assert_eq!(revoke_token(state.path(), &ada).unwrap(), ["bo_2".parse().unwrap()]);
        let of_ada = revoke_token(state.path(), &ada).unwrap_err();
        assert_eq!(of_ada.to_string(), "ada has no token; bo_2 has");
        tokio::time::advance(REREAD).await;
        let code = check(&security, "/rtfarm.v1.Jobs/Submit", old.token().unwrap());
        assert_eq!(code, Some(Code::Unauthenticated));
        assert_eq!(found(&security, &bo).as_ref(), Some(&bo), "the others are as they were");
        // They learn of another address at the next start, too.
        let elsewhere: Address = "https://elsewhere:1".parse().unwrap();
        let again = Security::open(state.path(), &elsewhere).unwrap();
        let moved = access(state.path(), bo.clone());
        assert_eq!((moved.address(), moved.token()), (&elsewhere, of_bo.token()));
        assert_eq!(found(&again, &bo), Some(bo));
        for wrong in ["work.ada", "submit.", "submit.a.b", "submit.a/b", "submit.a b", "submit.é"]
        {
            wrong.parse::<Holder>().unwrap_err();
        }
    }

    #[test]
    fn a_folder_that_needs_no_change_is_left_alone() {
        let state = tempfile::tempdir().unwrap();
        Security::open(state.path(), &address()).unwrap();
        let files = || -> BTreeMap<PathBuf, u64> {
            let files = fs::read_dir(state.path().join(FOLDER)).unwrap().map(Result::unwrap);
            files.map(|file| (file.path(), file.metadata().unwrap().ino())).collect()
        };
        // A coordinator needs neither the authority's key nor the access files.
        for needless in ["authority", "submit", "work", "read", "admin"] {
            fs::remove_file(state.path().join(FOLDER).join(needless)).unwrap();
        }
        let before = files();
        assert_eq!(before.len(), 2);
        let security = Security::open(state.path(), &address()).unwrap();
        assert_eq!(files(), before);
        security.tls().unwrap();
    }

    #[test]
    fn secrets_are_their_owners_alone() {
        let state = tempfile::tempdir().unwrap();
        Security::open(state.path(), &address()).unwrap();
        let folder = state.path().join(FOLDER);
        assert_eq!(fs::metadata(&folder).unwrap().mode() & 0o777, 0o700);
        for entry in fs::read_dir(&folder).unwrap() {
            let entry = entry.unwrap();
            assert_eq!(entry.metadata().unwrap().mode() & 0o777, 0o600, "{entry:?}");
        }
        let given = fs::read_to_string(folder.join("work")).unwrap();
        assert!(!given.contains("PRIVATE KEY"));
    }
}
