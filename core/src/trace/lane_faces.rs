//! Spheres and quadrangles before a group of rays: loops over lanes in plain Rust, which are
//! compiled for each instruction set. Every lane computes what the ray alone does, in the same
//! order.

use super::{
    lanes::{LANES, RayGroup},
    triangle::EDGE_ON,
};

/// Where the lines of a group's rays cross a sphere.
pub(super) struct SphereEnds {
    /// The rays whose lines cross it, a bit each; the ends of the others mean nothing.
    pub(super) met: u64,
    pub(super) near: [f64; LANES],
    pub(super) far: [f64; LANES],
}

/// `hit_sphere` for a group whose starts have these axes.
#[inline(always)]
pub(super) fn cross_sphere(
    group: &RayGroup,
    axes: [usize; 3],
    center: &[f64; 3],
    radius: f64,
) -> SphereEnds {
    let mut to_origin = [[0.0; LANES]; 3];
    for (axis, starts) in axes.into_iter().zip(&group.origin) {
        for (difference, start) in to_origin[axis % 3].iter_mut().zip(starts) {
            *difference = start - center[axis % 3];
        }
    }
    let ([x, y, z], [dx, dy, dz]) = (&to_origin, &group.direction);
    let [mut half_b, mut squares] = [[0.0; LANES]; 2];
    let mut least = f64::INFINITY;
    for lane in 0..LANES {
        let (x, y, z) = (x[lane], y[lane], z[lane]);
        let (dx, dy, dz) = (dx[lane], dy[lane], dz[lane]);
        let b = -(x * dx + y * dy + z * dz);
        let [cx, cy, cz] = [x + b * dx, y + b * dy, z + b * dz];
        half_b[lane] = b;
        squares[lane] = cx * cx + cy * cy + cz * cz;
    }
    for square in squares {
        least = if square < least { square } else { least };
    }
    let mut ends = SphereEnds { met: 0, near: [0.0; LANES], far: [0.0; LANES] };
    // Rounding takes less than this from a ray that touches the sphere.
    if least > radius * radius * (1.0 + 1e-12) {
        return ends;
    }
    let mut discriminants = [0.0; LANES];
    for lane in 0..LANES {
        let (x, y, z, half_b) = (x[lane], y[lane], z[lane], half_b[lane]);
        let closest = squares[lane].sqrt();
        let discriminant = (radius - closest) * (radius + closest);
        let far = half_b + discriminant.sqrt().copysign(half_b);
        let distance = (x * x + y * y + z * z).sqrt();
        let other = (distance - radius) * (distance + radius) / far;
        discriminants[lane] = discriminant;
        ends.near[lane] = if far < other { far } else { other };
        ends.far[lane] = if far < other { other } else { far };
    }
    for (lane, discriminant) in discriminants.iter().enumerate() {
        ends.met |= u64::from(*discriminant > 0.0) << lane;
    }
    ends
}

/// `hit_sphere_again` for a group whose starts have these axes.
#[inline(always)]
pub(super) fn cross_sphere_again(
    group: &RayGroup,
    axes: [usize; 3],
    center: &[f64; 3],
) -> [f64; LANES] {
    let mut products = [[0.0; LANES]; 3];
    for (axis, starts) in axes.into_iter().zip(&group.origin) {
        let axis = axis % 3;
        for lane in 0..LANES {
            products[axis][lane] = (starts[lane] - center[axis]) * group.direction[axis][lane];
        }
    }
    let mut again = [0.0; LANES];
    for (lane, again) in again.iter_mut().enumerate() {
        *again = -2.0 * (products[0][lane] + products[1][lane] + products[2][lane]);
    }
    again
}

/// The rays of a group that leave a surface, a bit each; and those of them that still have the face
/// of this rank on it ahead of them.
#[inline(always)]
pub(super) fn leaves(group: &RayGroup, surface: u32, rank: u32) -> (u64, u64) {
    let (mut leaves, mut ahead) = (0, 0);
    for (lane, (&leaving, &after)) in group.leaving.iter().zip(&group.after).enumerate() {
        leaves |= u64::from(leaving == surface) << lane;
        ahead |= u64::from(after < rank) << lane;
    }
    (leaves, leaves & ahead)
}

/// `is_inside` for a group of rays and a quadrangle with its corners in the order of the rays'
/// axes: those that pass inside, and those for which rounded products do not tell.
#[inline(always)]
pub(super) fn pass_quadrangle(group: &RayGroup, corners: &[[f64; 3]; 4]) -> (u64, u64) {
    let [mut x, mut y] = [[[0.0; LANES]; 4]; 2];
    for (corner, at) in corners.iter().enumerate() {
        for lane in 0..LANES {
            let depth = at[2] - group.origin[2][lane];
            x[corner][lane] = (at[0] - group.origin[0][lane]) - group.slopes[0][lane] * depth;
            y[corner][lane] = (at[1] - group.origin[1][lane]) - group.slopes[1][lane] * depth;
        }
    }
    let (mut inside, mut in_doubt) = (0, 0);
    for a in 0..4 {
        let b = (a + 1) % 4;
        for lane in 0..LANES {
            let rounded = x[a][lane] * y[b][lane] - y[a][lane] * x[b][lane];
            let upward = y[b][lane] > 0.0;
            let crosses = upward != (y[a][lane] > 0.0);
            inside ^= u64::from(crosses && (rounded > 0.0) == upward) << lane;
            in_doubt |= u64::from(crosses && rounded == 0.0) << lane;
        }
    }
    (inside, in_doubt)
}

/// `hit_plane` for a group whose starts have these axes: the rays that do not as good as run along
/// the plane, a bit each, and their distances from it.
#[inline(always)]
pub(super) fn cross_plane(
    group: &RayGroup,
    axes: [usize; 3],
    [point, normal]: [&[f64; 3]; 2],
) -> (u64, [f64; LANES]) {
    let [mut distance, mut along] = [[[0.0; LANES]; 3]; 2];
    for (axis, starts) in axes.into_iter().zip(&group.origin) {
        let axis = axis % 3;
        for lane in 0..LANES {
            distance[axis][lane] = normal[axis] * (point[axis] - starts[lane]);
            along[axis][lane] = normal[axis] * group.direction[axis][lane];
        }
    }
    let (mut crosses, mut t) = (0, [0.0; LANES]);
    for lane in 0..LANES {
        let [x, y, z] = [distance[0][lane], distance[1][lane], distance[2][lane]];
        let along = along[0][lane] + along[1][lane] + along[2][lane];
        t[lane] = (x + y + z) / along;
        crosses |= u64::from(along.abs() > EDGE_ON) << lane;
    }
    (crosses, t)
}
