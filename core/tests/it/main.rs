//! Everything that is tested of the core from outside, in one program: it is built and linked once.

mod branches;
mod catalogue;
mod compact;
mod corpora;
mod damage;
mod edges;
mod estimates;
mod hard_cases;
mod hostile;
mod language;
mod meshes;
mod mistakes;
mod named_files;
mod numbers;
mod optics;
mod pictures;
mod real_files;
mod reference;
mod secondary;
mod solids;
mod textures;
mod thin;
mod transfer;
mod truth;

mod support;
