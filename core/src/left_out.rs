//! Features whose code this build leaves out, to count what that code costs scenes without them.
//!
//! `RTFARM_BUILD_WITHOUT=texture` in the compiler's environment leaves textures out: such a build
//! shows scenes as if they had none. Records keep their layout. `benches/ablation.rs` makes these
//! builds; no other is one.

/// The feature whose code this build leaves out.
pub const BUILT_WITHOUT: Option<&str> = option_env!("RTFARM_BUILD_WITHOUT");

/// What can be left out, each on its own.
pub const FEATURES: [&str; 7] =
    ["ambient", "mirror", "secondary light", "transparency", "refraction", "texture", "solid"];

pub(crate) const AMBIENT: bool = is_left_out(FEATURES[0]);
pub(crate) const MIRROR: bool = is_left_out(FEATURES[1]);
pub(crate) const SECONDARY_LIGHT: bool = is_left_out(FEATURES[2]);
pub(crate) const TRANSPARENCY: bool = is_left_out(FEATURES[3]);
pub(crate) const REFRACTION: bool = is_left_out(FEATURES[4]);
pub(crate) const TEXTURE: bool = is_left_out(FEATURES[5]);
pub(crate) const SOLID: bool = is_left_out(FEATURES[6]);

const _: () = assert!(
    BUILT_WITHOUT.is_none()
        || (AMBIENT || MIRROR || SECONDARY_LIGHT || TRANSPARENCY || REFRACTION || TEXTURE || SOLID),
    "no feature has the name that RTFARM_BUILD_WITHOUT gives"
);

const fn is_left_out(feature: &str) -> bool {
    let Some(without) = BUILT_WITHOUT else { return false };
    let (a, b) = (without.as_bytes(), feature.as_bytes());
    let mut k = 0;
    while k < a.len() && k < b.len() && a[k] == b[k] {
        k += 1;
    }
    k == a.len() && k == b.len()
}
