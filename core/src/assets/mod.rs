//! The files that a scene names: images and meshes.

pub mod mesh;
pub mod texture;
