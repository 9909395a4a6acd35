//! Brute-force truth that tests hold the tracer to: every face is asked about every ray, each
//! decision is made exactly, and nothing is shared with the tracer but the scene's types.

#![expect(clippy::float_cmp, reason = "truth is compared exactly")]

// Numbers that are exact, or know how far off they are; times along a ray.
mod dyadic;
mod number;
mod root;
mod vector;

// Faces and what a ray meets.
mod ball;
mod face;
mod margin;
mod mesh;
mod oracle;
mod polygon;
mod ray;
mod solid;

// What is seen.
mod light;
mod picture;
mod radiance;
mod secondary;
mod texture;

// What needs no rays.
pub mod closed_forms;
pub mod known_pictures;

// What tests throw at the oracle and at the tracer, and how they tell what they found.
pub mod hard_case;
pub mod random;
pub mod random_scene;

pub use face::{FaceId, Leaving};
pub use light::Passage;
pub use mesh::mesh_triangles;
pub use oracle::{Hit, Oracle};
pub use picture::{Positions, eye_direction, grid_positions, reference_picture};
pub use radiance::Settings;
