//! Which flat faces lie in one plane as far as the rounding of their coordinates can tell.
//!
//! A label on a tilted wall is given in decimals, as the wall is. Read as binary numbers, their
//! planes are some roundings apart, and which of them a ray met first would be chance. So two faces
//! of different primitives that overlap, and are nowhere there farther apart than [`ROUNDINGS`],
//! lie in one plane, and so do all faces that such pairs join, if they are as near to the largest
//! of them. The order of the faces has no part in it.

use std::{collections::HashMap, ops::Range};

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::{
    flat::{Corners, FlatFaces, bounds_of},
    ranks::Ranks,
};
use crate::exact::clip::clip;

/// How far apart faces may be that lie in one plane, in roundings of their coordinates. A corner is
/// off by one, a plane by up to two inside its face, and corners that were computed by some more.
const ROUNDINGS: f64 = 8.0;

/// The rounding of a number, over the number.
const ROUNDING: f64 = f64::EPSILON / 2.0;

/// At most so many pairs are looked at. Where thousands of faces cross each other in planes that
/// are nearly one there are more; then some that are not exactly one stay apart.
const MOST_PAIRS: u64 = 1 << 26;

/// Sets of faces that lie in one plane within rounding, the largest face of each set first. Faces
/// for which `exact` has the same number are known to lie in one plane exactly: a set has all of
/// them or none.
pub(super) fn near_sets(
    flat: &FlatFaces,
    ranks: &Ranks,
    exact: impl Fn(usize) -> Option<usize>,
) -> Vec<Vec<usize>> {
    let primitive = |face: usize| ranks.primitive(flat.rank(face));
    let mut overlaps = Vec::new();
    let mut pairs_left = MOST_PAIRS;
    let mut keys = keys(flat, &meeting_others(flat, ranks));
    for cluster in clusters(&mut keys) {
        let first = exact(cluster[0].face);
        if first.is_some() && cluster.iter().all(|key| exact(key.face) == first) {
            continue;
        }
        for_each_pair(cluster, &mut pairs_left, |a, b| {
            let is_known = exact(a).is_some_and(|plane| Some(plane) == exact(b));
            if !is_known && primitive(a) != primitive(b) {
                overlaps.extend(Overlap::new(flat, a.min(b), a.max(b)));
            }
        });
    }
    if overlaps.is_empty() { Vec::new() } else { join(flat, &overlaps, exact) }
}

/// The box around some points, as its least and its greatest corner.
type Bounds = (DVec3, DVec3);

const NOTHING: Bounds = (DVec3::INFINITY, DVec3::NEG_INFINITY);

fn joined(a: Bounds, b: Bounds) -> Bounds {
    (a.0.min(b.0), a.1.max(b.1))
}

fn is_apart(a: Bounds, b: Bounds) -> bool {
    (a.0.cmpgt(b.1) | b.0.cmpgt(a.1)).any()
}

/// A primitive of fewer faces is not looked at by itself.
const LARGE: usize = 256;

/// The faces that may overlap one of another primitive: of a large primitive only those in the box
/// around all others.
fn meeting_others(flat: &FlatFaces, ranks: &Ranks) -> Vec<u32> {
    let bounds = |face: usize| flat.bounds(face);
    let bounds_of_run =
        |run: &Range<usize>| run.clone().into_par_iter().map(bounds).reduce(|| NOTHING, joined);
    // Large primitives with their boxes, and the faces of all others.
    let (mut large, mut small) = (Vec::new(), Vec::new());
    let mut start = 0;
    while start < flat.count() {
        let ranks = ranks.of(ranks.primitive(flat.rank(start)));
        let faces = &flat.attributes[start..];
        let length = faces.iter().take_while(|face| ranks.contains(&face.rank)).count();
        let run = start..start + length;
        start = run.end;
        if length >= LARGE {
            large.push((run.clone(), bounds_of_run(&run)));
        } else {
            small.extend(run.map(|face| face as u32));
        }
    }
    let mut before = small.iter().map(|&face| bounds(face as usize)).fold(NOTHING, joined);
    let mut others: Vec<Bounds> = Vec::with_capacity(large.len());
    for &(_, own) in &large {
        others.push(before);
        before = joined(before, own);
    }
    let mut behind = NOTHING;
    for ((_, own), others) in large.iter().zip(&mut others).rev() {
        *others = joined(*others, behind);
        behind = joined(behind, *own);
    }
    for ((run, _), others) in large.into_iter().zip(others) {
        let meets = |&face: &usize| !is_apart(bounds(face), others);
        small.par_extend(run.into_par_iter().filter(meets).map(|face| face as u32));
    }
    small
}

/// A face by a number that planes have nearly in common if they are nearly the same, from the least
/// to the greatest that rounding may make of it, and the box around the face.
struct Key {
    face: usize,
    from: f64,
    to: f64,
    bounds: Bounds,
}

/// The keys of some faces, by their least numbers, but for faces so thin that any plane could be
/// theirs.
fn keys(flat: &FlatFaces, faces: &[u32]) -> Vec<Key> {
    // A direction that no modeller prefers.
    const DIRECTION: DVec3 = DVec3::new(0.483, 0.836, 0.259);
    let key = |&face: &u32| {
        let face = face as usize;
        let corners = flat.corners_of(face);
        let (first, last) = (corners[0], corners[corners.len() - 1]);
        // The diagonals of a quadrangle, two sides of a triangle.
        let (u, v) = (corners[2] - first, corners[1] - last);
        let cross = u.cross(v);
        let bounds = bounds_of(&corners);
        let extent = bounds.0.abs().max(bounds.1.abs()).max_element();
        // What roundings of the corners turn the normal by, and what that moves the plane by.
        let turn = 16.0 * ROUNDING * extent * (u.length() + v.length()) / cross.length();
        let slack = (1.0 + extent) * turn + 16.0 * ROUNDING * extent;
        // The same for the plane that looks the other way.
        let number = (cross.normalize().dot(DIRECTION) + cross.normalize().dot(first)).abs();
        (slack < 1e-3).then_some(Key { face, from: number - slack, to: number + slack, bounds })
    };
    let mut keys: Vec<Key> = faces.par_iter().filter_map(key).collect();
    keys.par_sort_unstable_by(|a, b| a.from.total_cmp(&b.from).then(a.face.cmp(&b.face)));
    keys
}

/// Runs of two and more keys that overlap.
fn clusters(keys: &mut [Key]) -> impl Iterator<Item = &mut [Key]> {
    let mut end = f64::NEG_INFINITY;
    let runs = keys.chunk_by_mut(move |a, b| {
        end = end.max(a.to);
        let goes_on = b.from <= end;
        if !goes_on {
            end = f64::NEG_INFINITY;
        }
        goes_on
    });
    runs.filter(|run| run.len() > 1)
}

/// Calls `visit` with every two faces whose boxes meet: they are swept along one axis.
fn for_each_pair(cluster: &mut [Key], pairs_left: &mut u64, mut visit: impl FnMut(usize, usize)) {
    let (min, max) = cluster.iter().map(|key| key.bounds).fold(NOTHING, joined);
    let axis = (max - min).max_position();
    cluster.sort_unstable_by(|a, b| {
        a.bounds.0[axis].total_cmp(&b.bounds.0[axis]).then(a.face.cmp(&b.face))
    });
    let mut open: Vec<&Key> = Vec::new();
    for key in &*cluster {
        open.retain(|other| other.bounds.1[axis] >= key.bounds.0[axis]);
        for other in &open {
            let Some(left) = pairs_left.checked_sub(1) else { return };
            *pairs_left = left;
            if !is_apart(key.bounds, other.bounds) {
                visit(key.face, other.face);
            }
        }
        open.push(key);
    }
}

/// Two faces that overlap, and that rounding cannot tell apart there.
struct Overlap {
    faces: [usize; 2],
    /// Corners of what both cover, in the first one's plane.
    corners: Vec<DVec3>,
}

impl Overlap {
    /// `None` for faces that do not overlap, or whose planes are apart where they do.
    fn new(flat: &FlatFaces, a: usize, b: usize) -> Option<Self> {
        let [first, second] = [a, b].map(|face| Plane::of(flat, face));
        let axis = first.normal.abs().max_position();
        let mut corners = Vec::new();
        for triangle in first.triangles(axis) {
            for other in second.triangles(axis) {
                corners.extend(intersection(triangle, other));
            }
        }
        let corners: Vec<DVec3> = corners.into_iter().map(|at| first.point_at(axis, at)).collect();
        let is_one = !corners.is_empty() && corners.iter().all(|&at| second.is_near(at, &first));
        is_one.then_some(Self { faces: [a, b], corners })
    }
}

/// A face and its plane.
struct Plane {
    corners: Corners,
    normal: DVec3,
}

impl Plane {
    fn of(flat: &FlatFaces, face: usize) -> Self {
        Self { corners: flat.corners_of(face), normal: flat.normal(face) }
    }

    /// Whether rounding cannot tell the plane from that of another face, of which `point` is one.
    fn is_near(&self, point: DVec3, other: &Self) -> bool {
        let of_face =
            |face: &Self| face.corners.iter().fold(DVec3::ZERO, |max, c| max.max(c.abs()));
        let extent = of_face(self).max(of_face(other));
        let distance = self.normal.dot(point - self.middle()).abs();
        distance <= ROUNDINGS * ROUNDING * self.normal.abs().dot(extent)
    }

    /// The mean corner.
    fn middle(&self) -> DVec3 {
        let from_first: DVec3 = self.corners.iter().map(|&corner| corner - self.corners[0]).sum();
        self.corners[0] + from_first / self.corners.len() as f64
    }

    /// The point of the plane that `along`, an axis, projects to `at`.
    fn point_at(&self, axis: usize, at: DVec2) -> DVec3 {
        let on_axis = |along: f64| unproject(axis, at, along);
        let middle = self.middle();
        let height = self.normal.dot(middle - on_axis(middle[axis])) / self.normal[axis];
        on_axis(middle[axis] + height)
    }

    /// The face as triangles, seen along an axis, counter-clockwise.
    fn triangles(&self, axis: usize) -> Vec<[DVec2; 3]> {
        let turned = |mut triangle: [DVec2; 3]| {
            if doubled_area(&triangle) < 0.0 {
                triangle.swap(1, 2);
            }
            triangle
        };
        match *self.corners {
            [a, b, c, d] => {
                let [a, b, c, d] = [a, b, c, d].map(|corner| project(axis, corner));
                let halves = [[a, b, c], [a, c, d]];
                let is_inside = doubled_area(&halves[0]) * doubled_area(&halves[1]) >= 0.0;
                // One diagonal at least runs inside.
                let halves = if is_inside { halves } else { [[b, c, d], [b, d, a]] };
                halves.map(turned).to_vec()
            }
            _ => vec![turned([0, 1, 2].map(|k| project(axis, self.corners[k])))],
        }
    }

    /// Larger faces first; of equal ones the corners decide.
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        let area = |plane: &Self| {
            let axis = plane.normal.abs().max_position();
            let seen: f64 = plane.triangles(axis).iter().map(doubled_area).sum();
            seen / plane.normal[axis].abs()
        };
        let corners = |plane: &Self| -> Vec<[f64; 3]> {
            plane.corners.iter().map(glam::DVec3::to_array).collect()
        };
        let by_area = area(other).total_cmp(&area(self));
        by_area.then_with(|| corners(self).partial_cmp(&corners(other)).expect("they are finite"))
    }
}

/// The corners of what two triangles cover, both counter-clockwise; none where they only touch
/// within rounding.
fn intersection(a: [DVec2; 3], b: [DVec2; 3]) -> Vec<DVec2> {
    let (mut outline, mut room) = (a.to_vec(), Vec::new());
    for k in 0..3 {
        let (start, side) = (b[k], b[(k + 1) % 3] - b[k]);
        clip(&mut outline, &mut room, |p| side.perp_dot(p - start), glam::DVec2::lerp);
    }
    let extent = a.iter().chain(&b).fold(0.0, |max: f64, p| max.max(p.abs().max_element()));
    let edges = || outline.iter().zip(outline.iter().cycle().skip(1));
    let length: f64 = edges().map(|(p, q)| p.distance(*q)).sum();
    let fans = outline.windows(2).map(|pair| doubled_area(&[outline[0], pair[0], pair[1]]));
    let is_real = fans.sum::<f64>() > 64.0 * ROUNDING * extent * length;
    if is_real { outline } else { Vec::new() }
}

fn doubled_area([a, b, c]: &[DVec2; 3]) -> f64 {
    (b - a).perp_dot(c - a)
}

/// The faces that overlaps join, with all that lie in one plane with them exactly; not those that
/// would lie farther from their largest face than rounding explains.
fn join(
    flat: &FlatFaces,
    overlaps: &[Overlap],
    exact: impl Fn(usize) -> Option<usize>,
) -> Vec<Vec<usize>> {
    let mut sets = DisjointSets::new(flat.count());
    let mut firsts = HashMap::new();
    for face in 0..flat.count() {
        if let Some(plane) = exact(face) {
            sets.join(*firsts.entry(plane).or_insert(face), face);
        }
    }
    for Overlap { faces: [a, b], .. } in overlaps {
        sets.join(*a, *b);
    }
    let mut joined: HashMap<usize, Vec<&Overlap>> = HashMap::new();
    for overlap in overlaps {
        joined.entry(sets.find(overlap.faces[0])).or_default().push(overlap);
    }
    let mut faces: HashMap<usize, Vec<usize>> = HashMap::new();
    for face in 0..flat.count() {
        let set = sets.find(face);
        if joined.contains_key(&set) {
            faces.entry(set).or_default().push(face);
        }
    }
    let mut near: Vec<Vec<usize>> = (faces.into_iter())
        .filter_map(|(set, mut faces)| {
            faces.sort_by(|&a, &b| Plane::of(flat, a).cmp(&Plane::of(flat, b)));
            let largest = Plane::of(flat, faces[0]);
            let is_near = |overlap: &&Overlap| {
                let of = Plane::of(flat, overlap.faces[0]);
                overlap.corners.iter().all(|&corner| largest.is_near(corner, &of))
            };
            joined[&set].iter().all(is_near).then_some(faces)
        })
        .collect();
    near.sort_unstable();
    near
}

/// Sets of numbers that have none in common.
/// Source: Galler & Fischer, "An Improved Equivalence Algorithm" (1964).
struct DisjointSets(Vec<usize>);

impl DisjointSets {
    fn new(count: usize) -> Self {
        Self((0..count).collect())
    }

    /// The number that stands for all of the set that has `number`.
    fn find(&mut self, mut number: usize) -> usize {
        while self.0[number] != number {
            self.0[number] = self.0[self.0[number]];
            number = self.0[number];
        }
        number
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b)] = a.min(b);
    }
}

fn project(axis: usize, point: DVec3) -> DVec2 {
    DVec2::new(point[(axis + 1) % 3], point[(axis + 2) % 3])
}

fn unproject(axis: usize, at: DVec2, along: f64) -> DVec3 {
    let mut point = DVec3::splat(along);
    point[(axis + 1) % 3] = at.x;
    point[(axis + 2) % 3] = at.y;
    point
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prepare::flat::FaceAttributes;

    /// Squares, some of them roundings before the plane x + 2y + 3z = 0, at a multiple of their
    /// side.
    fn squares(places: &[(f64, f64)]) -> FlatFaces {
        let (u, v) = (DVec3::new(0.2, -0.1, 0.0), DVec3::new(0.3, 0.0, -0.1));
        let normal = u.cross(v).normalize();
        let corners = places.iter().flat_map(|&(roundings, along)| {
            let place = normal * (roundings * ROUNDING) + u * along + v * 0.01 * along;
            [place, place + u, place + u + v, place + v]
        });
        let attributes = (0..places.len() as u32).map(|rank| FaceAttributes { material: 0, rank });
        FlatFaces {
            corners: (0..4 * places.len() as u32).collect(),
            points: corners.collect(),
            attributes: attributes.collect(),
            triangle_count: 0,
            quadrangle_count: places.len(),
            box_edges: Vec::new(),
        }
    }

    fn sets(places: &[(f64, f64)]) -> Vec<Vec<usize>> {
        let mut sets = near_sets(&squares(places), &Ranks { firsts: Vec::new() }, |_| None);
        for set in &mut sets {
            set.sort_unstable();
        }
        sets
    }

    #[test]
    fn overlapping_faces_within_rounding_are_one_plane_in_any_order() {
        assert_eq!(sets(&[(0.0, 0.0), (1.5, 0.5)]), [[0, 1]]);
        assert_eq!(sets(&[(1.5, 0.5), (0.0, 0.0)]), [[0, 1]]);
        assert_eq!(sets(&[(0.0, 0.0), (16.0, 0.5)]), [[0; 0]; 0], "too far apart");
        assert_eq!(sets(&[(0.0, 0.0), (1.5, 1.0)]), [[0; 0]; 0], "they only touch");
        assert_eq!(sets(&[(0.0, 0.0), (1.5, 7.0), (1.0, 0.5), (0.0, 7.5)]), [[0, 2], [1, 3]]);
    }

    #[test]
    fn a_label_finds_the_face_of_a_large_primitive_that_it_lies_on() {
        let mut places: Vec<(f64, f64)> = (0..400).map(|k| (0.0, 10.0 * f64::from(k))).collect();
        places.push((1.5, 1230.5));
        let flat = squares(&places);
        let ranks = Ranks { firsts: vec![0, 400] };
        assert_eq!(meeting_others(&flat, &ranks), [400, 123]);
        let mut sets = near_sets(&flat, &ranks, |_| None);
        sets[0].sort_unstable();
        assert_eq!(sets, [[123, 400]]);
    }

    #[test]
    fn a_stack_of_planes_that_is_too_high_stays_apart() {
        let stack = |count: usize| -> Vec<(f64, f64)> {
            (0..count).map(|k| (0.8 * k as f64, 0.1 * k as f64)).collect()
        };
        let reversed = |count: usize| stack(count).into_iter().rev().collect::<Vec<_>>();
        assert_eq!(sets(&stack(3)), [[0, 1, 2]]);
        assert_eq!(sets(&reversed(3)), [[0, 1, 2]]);
        assert_eq!(sets(&stack(9)), [[0; 0]; 0]);
        assert_eq!(sets(&reversed(9)), [[0; 0]; 0]);
    }
}
