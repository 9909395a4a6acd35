//! Rays through a prepared scene: what they meet.

pub(crate) mod batch;
mod box_ray;
mod boxes;
#[cfg(target_arch = "x86_64")]
#[expect(unsafe_code, reason = "SIMD intrinsics")]
mod boxes_avx512;
#[cfg(target_arch = "x86_64")]
#[expect(unsafe_code, reason = "SIMD intrinsics")]
mod boxes_x86;
mod course;
mod gate;
mod hit;
pub(crate) mod kernels;
mod lane_faces;
mod lanes;
mod lone;
mod meeting;
mod packet;
mod parallelepiped;
#[cfg(target_arch = "x86_64")]
#[expect(unsafe_code, reason = "SIMD intrinsics")]
mod parallelepiped_x86;
pub(crate) mod probe;
pub(crate) mod quadrangle;
pub(crate) mod ray;
pub(crate) mod solid;
mod solid_lanes;
mod solid_rays;
pub(crate) mod sphere;
pub(crate) mod timed;
pub(crate) mod traversal;
pub(crate) mod triangle;
mod walk;
