//! Rays, and what they hit.

use std::mem::offset_of;

use glam::DVec3;

use crate::{
    exact::float::exact_product,
    prepared::{
        face::Face,
        record::{Item, Surface},
    },
};

/// A half-line, with what it must not meet.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub(crate) struct Ray {
    /// Where it starts.
    pub(crate) origin: DVec3,
    /// Where it goes; of length 1 within rounding, never zero or NaN.
    pub(crate) direction: DVec3,
    /// Only hits nearer than this count. Above 0, may be infinite.
    pub(crate) reach: f64,
    /// The surface that it leaves: never met again at the start.
    pub(crate) leaving: Surface,
    /// For a ray that went through a face, that face's rank: coincident faces that come later are
    /// still ahead, at distance 0. Else [`Ray::NOTHING_AHEAD`].
    pub(crate) after: u32,
}

// Kernels load a ray as eight numbers.
const _: () = assert!(size_of::<Ray>() == 64 && offset_of!(Ray, direction) == 24);
const _: () = assert!(offset_of!(Ray, reach) == 48 && offset_of!(Ray, leaving) == 56);

impl Ray {
    /// No face comes later than this.
    pub(crate) const NOTHING_AHEAD: u32 = u32::MAX;

    /// A ray that meets nothing.
    pub(crate) const NOWHERE: Self = Self {
        origin: DVec3::NAN,
        direction: DVec3::NAN,
        reach: 0.0,
        leaving: Surface::NONE,
        after: Self::NOTHING_AHEAD,
    };
}

/// The nearest face along a ray: the smallest (t, rank).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hit {
    /// The distance in units of the ray's direction; infinite where nothing is hit.
    pub(crate) t: f64,
    /// The face's place among all faces of the scene.
    pub(crate) rank: u32,
    /// What is hit.
    pub(crate) face: Face,
}

impl Hit {
    /// Nothing, up to `reach`.
    pub(super) fn none(reach: f64) -> Self {
        Self { t: reach, rank: u32::MAX, face: Face::NONE }
    }

    /// Whether a face is hit.
    pub(crate) fn is_some(&self) -> bool {
        self.face.item != Item::NONE
    }
}

/// A ray ready to meet flat faces: seen along its own direction, it is the point (0, 0).
///
/// Source: Woop, Benthin & Wald, "Watertight Ray/Triangle Intersection" (2013): the direction's
/// largest component becomes the depth axis and the other two are sheared along it.
#[derive(Debug, Clone, Copy, bytemuck::Zeroable)]
pub(super) struct Shear {
    pub(super) axes: [usize; 3],
    pub(super) origin: [f64; 3],
    pub(super) slopes: [f64; 3],
}

/// A vertex as a ray sees it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Projected {
    pub(super) x: f64,
    pub(super) y: f64,
    /// The distance along the ray, in units of its direction.
    pub(super) z: f64,
}

/// The axis of a direction's largest component, the last one of several.
#[inline(always)]
pub(super) fn depth_axis(d: [f64; 3]) -> usize {
    let [x, y, z] = [d[0].abs(), d[1].abs(), d[2].abs()];
    if x > y {
        if x > z { 0 } else { 2 }
    } else if y > z {
        1
    } else {
        2
    }
}

impl Shear {
    #[inline(always)]
    pub(crate) fn new(origin: DVec3, direction: DVec3) -> Self {
        let d = direction.to_array();
        let z = depth_axis(d);
        let (x, y) = ((z + 1) % 3, (z + 2) % 3);
        let o = origin.to_array();
        Self {
            axes: [x, y, z],
            origin: [o[x], o[y], o[z]],
            slopes: [d[x] / d[z], d[y] / d[z], 1.0 / d[z]],
        }
    }

    /// The same for one vertex whoever asks, so that faces that share it agree on it.
    #[inline(always)]
    pub(super) fn project(&self, vertex: &[f64; 3]) -> Projected {
        let [x, y, z] = self.axes;
        let depth = vertex[z] - self.origin[2];
        Projected {
            x: (vertex[x] - self.origin[0]) - self.slopes[0] * depth,
            y: (vertex[y] - self.origin[1]) - self.slopes[1] * depth,
            z: self.slopes[2] * depth,
        }
    }

    /// Projects every vertex. This is a loop, since the closure of a `map` is called where a kernel
    /// is compiled for an instruction set.
    #[inline(always)]
    pub(super) fn project_all<const N: usize>(&self, vertices: &[[f64; 3]; N]) -> [Projected; N] {
        let mut projected = [Projected { x: 0.0, y: 0.0, z: 0.0 }; N];
        for (projected, vertex) in projected.iter_mut().zip(vertices) {
            *projected = self.project(vertex);
        }
        projected
    }
}

/// On which side of the directed edge from `a` to `b` the ray passes: twice the signed area of
/// (ray, a, b) as the rays sees it, rounded.
///
/// Its sign is exact unless it is 0: rounding keeps order, so a rounded product can only be larger
/// than another if the exact one is. Swapping `a` and `b` flips the sign and nothing else, so
/// faces that share an edge never both let a ray through or both stop it.
#[inline(always)]
pub(super) fn edge(a: &Projected, b: &Projected) -> f64 {
    a.x * b.y - a.y * b.x
}

/// [`edge`] with the digits that the products lost: right to an ulp or two.
pub(super) fn exact_edge(a: &Projected, b: &Projected) -> f64 {
    let (left, left_error) = exact_product(a.x, b.y);
    let (right, right_error) = exact_product(a.y, b.x);
    (left - right) + (left_error - right_error)
}

/// The side on which a ray passes that is nudged off every edge: by ε² along x and by the much
/// larger ε along y, for an ε smaller than any number. So a ray that meets an edge or a vertex
/// belongs to exactly one of the faces around it, and a face seen edge-on is never met.
/// -1, 0 or 1; 0 only where `a` and `b` coincide on the screen.
///
/// Source: Edelsbrunner & Mücke, "Simulation of Simplicity" (1990).
#[cold]
pub(super) fn side(a: &Projected, b: &Projected) -> i32 {
    let (left, left_error) = exact_product(a.x, b.y);
    let (right, right_error) = exact_product(a.y, b.x);
    // Equal products differ by what they lost; after that the nudge decides.
    [left - right, left_error - right_error, b.x - a.x, a.y - b.y]
        .into_iter()
        .find(|&difference| difference != 0.0)
        .map_or(0, |difference| if difference > 0.0 { 1 } else { -1 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, y: f64) -> Projected {
        Projected { x, y, z: 1.0 }
    }

    #[test]
    fn an_edge_that_rounds_to_zero_still_has_a_side() {
        // (1 + u)(1 - u) = 1 - u², which rounds to 1.
        let u = f64::EPSILON;
        let (a, b) = (at(1.0 + u, 1.0), at(1.0, 1.0 - u));
        assert_eq!(edge(&a, &b), 0.0);
        assert!(exact_edge(&a, &b) < 0.0);
        assert_eq!(side(&a, &b), -side(&b, &a));
    }

    #[test]
    fn a_ray_at_a_vertex_belongs_to_one_triangle_of_a_fan() {
        let middle = at(0.0, 0.0);
        let rim = [at(1.0, 0.0), at(0.3, 2.0), at(-1.0, 0.5), at(-1.0, -1.0), at(0.0, -2.0)];
        let inside = (0..rim.len())
            .filter(|&k| {
                let (a, b) = (rim[k], rim[(k + 1) % rim.len()]);
                side(&middle, &a) == side(&a, &b) && side(&a, &b) == side(&b, &middle)
            })
            .count();
        assert_eq!(inside, 1);
    }
}
