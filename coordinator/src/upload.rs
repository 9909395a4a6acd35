//! What clients send of their scenes, on disk until it is whole, and how much of it there may be.

use std::{
    collections::HashMap,
    fs::File,
    io::{self, Write},
    ops::Range,
    os::unix::fs::FileExt,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

/// What is ordered may be so much: by each owner of a token, and by all others together. Who looks
/// after the farm, with a token to do everything, may order more.
#[derive(Debug, Clone, Copy)]
pub struct OrderLimits {
    /// Jobs that have not ended.
    pub jobs: u64,
    /// Pixels of their pictures together.
    pub pixels: u64,
    /// Bytes on disk of all their jobs, those that have ended included.
    pub bytes: u64,
    /// Bytes of all scenes together that are being sent.
    pub upload_bytes: u64,
    /// Bytes of messages that are in memory at once, each way.
    pub flight_bytes: u64,
}

impl Default for OrderLimits {
    fn default() -> Self {
        Self {
            jobs: 1000,
            pixels: 1 << 34,
            bytes: 256_000_000_000,
            upload_bytes: 8_000_000_000,
            flight_bytes: 1_000_000_000,
        }
    }
}

/// What is ordered, or would be.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Ordered {
    pub(crate) jobs: u64,
    pub(crate) pixels: u64,
    pub(crate) bytes: u64,
}

impl OrderLimits {
    /// Says why an order cannot be taken on top of what there is; `None` when it can.
    pub(crate) fn refusal(&self, account: &str, there: Ordered, order: Ordered) -> Option<String> {
        let gigabytes = |bytes: u64| bytes as f64 / 1e9;
        // Nobody need wait for what will never be.
        let too_large = if order.pixels > self.pixels {
            Some(format!("{} pixels, and may have {}", order.pixels, self.pixels))
        } else if order.bytes > self.bytes {
            let [more, most] = [order.bytes, self.bytes].map(gigabytes);
            Some(format!("{more:.2} GB on disk, and may have {most:.2} GB"))
        } else {
            None
        };
        if let Some(too_large) = too_large {
            return Some(format!("it is too large for the farm: it has {too_large}"));
        }
        let [jobs, pixels, bytes] = [
            (there.jobs, order.jobs, self.jobs),
            (there.pixels, order.pixels, self.pixels),
            (there.bytes, order.bytes, self.bytes),
        ]
        .map(|(there, more, most)| there.saturating_add(more) > most);
        let over = if jobs {
            let there = match there.jobs {
                1 => "is 1 job".to_owned(),
                count => format!("are {count} jobs"),
            };
            format!("there {there} already, and may be {}", self.jobs)
        } else if pixels {
            format!(
                "{} pixels more than the {} under way would be more than {}",
                order.pixels, there.pixels, self.pixels
            )
        } else if bytes {
            let [there, more, most] = [there.bytes, order.bytes, self.bytes].map(gigabytes);
            format!("{more:.2} GB more on disk than {there:.2} GB would be more than {most:.2} GB")
        } else {
            return None;
        };
        let of = if account.is_empty() { String::new() } else { format!(" of {account}") };
        Some(format!("the farm takes no more{of} for now: {over}; cancel or fetch jobs, or wait"))
    }
}

/// How many bytes are being sent, of all clients together.
#[derive(Debug, Clone, Default)]
pub(crate) struct Uploads(Arc<AtomicU64>);

/// A scene as a client sends it: its text and the files that it names, in a file without a name.
#[derive(Debug)]
pub(crate) struct Spool {
    file: File,
    end: u64,
    text: Extents,
    files: HashMap<String, Extents>,
    uploads: Uploads,
}

/// The parts of the spool's file that something is in, in order.
type Extents = Vec<Range<u64>>;

impl Spool {
    pub(crate) fn new(folder: &Path, uploads: &Uploads) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        let (text, files, uploads) = (Extents::new(), HashMap::new(), uploads.clone());
        Ok(Self { file, end: 0, text, files, uploads })
    }

    /// Bytes that all clients are sending.
    pub(crate) fn bytes_of_all(&self) -> u64 {
        self.uploads.0.load(Ordering::Relaxed)
    }

    /// Bytes that came.
    pub(crate) fn byte_count(&self) -> u64 {
        self.end
    }

    /// Adds a piece to the text, or to the file of that path. Blocks.
    pub(crate) fn put(&mut self, path: Option<String>, piece: &[u8]) -> io::Result<()> {
        self.file.write_all(piece)?;
        let begin = self.end;
        self.end += piece.len() as u64;
        self.uploads.0.fetch_add(piece.len() as u64, Ordering::Relaxed);
        let extents = match path {
            Some(path) => self.files.entry(path).or_default(),
            None => &mut self.text,
        };
        match extents.last_mut().filter(|last| last.end == begin) {
            Some(last) => last.end = self.end,
            None => extents.push(begin..self.end),
        }
        Ok(())
    }

    /// The scene's text. Blocks.
    pub(crate) fn text(&self) -> io::Result<Vec<u8>> {
        self.read(&self.text)
    }

    /// A file that came with it. Blocks.
    pub(crate) fn file(&self, path: &str) -> io::Result<Vec<u8>> {
        let extents = self.files.get(path).ok_or_else(|| {
            let reason = format!("`{path}` was not sent along with the scene");
            io::Error::new(io::ErrorKind::NotFound, reason)
        })?;
        self.read(extents)
    }

    fn read(&self, extents: &[Range<u64>]) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        for extent in extents {
            let begin = bytes.len();
            bytes.resize(begin + (extent.end - extent.start) as usize, 0);
            self.file.read_exact_at(&mut bytes[begin..], extent.start)?;
        }
        Ok(bytes)
    }
}

impl Drop for Spool {
    fn drop(&mut self) {
        self.uploads.0.fetch_sub(self.end, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_put_together_again_and_counted_as_long_as_they_are_there() {
        let (folder, uploads) = (tempfile::tempdir().unwrap(), Uploads::default());
        let mut spool = Spool::new(folder.path(), &uploads).unwrap();
        for (path, piece) in
            [(None, "te"), (None, "xt"), (Some("a"), "12"), (Some("b"), ""), (Some("a"), "3")]
        {
            spool.put(path.map(str::to_owned), piece.as_bytes()).unwrap();
        }
        spool.put(None, b" more").unwrap();
        assert_eq!(spool.text().unwrap(), b"text more");
        assert_eq!(spool.text.len(), 2, "what comes in one go is in one place");
        assert_eq!(spool.file("a").unwrap(), b"123");
        assert_eq!(spool.file("b").unwrap(), b"");
        assert_eq!(spool.file("c").unwrap_err().kind(), io::ErrorKind::NotFound);
        let other = Spool::new(folder.path(), &uploads).unwrap();
        assert_eq!((other.byte_count(), other.bytes_of_all()), (0, 12));
        drop(spool);
        assert_eq!(other.bytes_of_all(), 0);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "a file without a name");
    }

    #[test]
    fn who_orders_too_much_is_told_what_there_is_too_much_of() {
        let limits = OrderLimits { jobs: 2, pixels: 100, ..OrderLimits::default() };
        let limits = OrderLimits { bytes: 1_000_000_000, ..limits };
        let there = Ordered { jobs: 1, pixels: 60, bytes: 500_000_000 };
        let order = Ordered { jobs: 1, pixels: 40, bytes: 500_000_000 };
        assert_eq!(limits.refusal("", there, order), None);
        for (order, reason) in [
            (Ordered { jobs: 2, ..order }, "there is 1 job already, and may be 2"),
            (
                Ordered { pixels: 41, ..order },
                "41 pixels more than the 60 under way would be more than 100",
            ),
            (
                Ordered { bytes: 500_000_001, ..order },
                "0.50 GB more on disk than 0.50 GB would be more than 1.00 GB",
            ),
        ] {
            let told = limits.refusal("", there, order).unwrap();
            assert!(told.contains(reason), "{told}");
            let told = limits.refusal("ada", there, order).unwrap();
            assert!(told.starts_with("the farm takes no more of ada for now: "), "{told}");
        }
        for (order, reason) in [
            (Ordered { pixels: 101, ..order }, "it has 101 pixels, and may have 100"),
            (Ordered { bytes: u64::MAX, ..order }, "GB on disk, and may have 1.00 GB"),
        ] {
            let told = limits.refusal("ada", Ordered::default(), order).unwrap();
            assert!(told.contains(reason) && !told.contains("wait"), "{told}");
        }
    }
}
