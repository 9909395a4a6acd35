//! Polygons into triangles.

use std::cmp::Ordering;

use glam::{DVec2, DVec3};

use super::predicates::{exponent, project, scale_by_power};

/// Corners that a polygon which is not convex may have: cutting it up takes their square in time.
pub(crate) const MOST_CORNERS: usize = 1024;

/// Cuts a simple polygon into triangles that turn as it does, three indices in `points` each.
/// Convex ones of any size are cut into a fan, others by their ears. What is not simple or has no
/// area gives some triangles. `false` when there are too many corners.
///
/// Source: Meisters, "Polygons Have Ears" (1975); O'Rourke, "Computational Geometry in C" (1998),
/// on which corners can become or cease to be ears.
pub(crate) fn triangulate(points: &[DVec3], mut emit: impl FnMut([usize; 3])) -> bool {
    let count = points.len();
    if count <= 3 {
        if count == 3 {
            emit([0, 1, 2]);
        }
        return true;
    }
    let largest = points.iter().map(|point| point.abs().max_element()).fold(0.0, f64::max);
    let power = -exponent(largest);
    let scaled: Vec<DVec3> =
        points.iter().map(|point| point.map(|number| scale_by_power(number, power))).collect();
    let normal = newell_normal(&scaled);
    let size = normal.abs();
    let axis = (0..3).max_by(|&j, &k| size[j].total_cmp(&size[k])).unwrap_or(0);
    let flat: Vec<DVec2> = scaled
        .iter()
        .map(|&point| {
            let seen = project(axis, point - scaled[0]);
            if normal[axis] < 0.0 { DVec2::new(seen.y, seen.x) } else { seen }
        })
        .collect();
    if is_convex(&flat) {
        (1..count - 1).for_each(|k| emit([0, k, k + 1]));
        return true;
    }
    if count > MOST_CORNERS {
        return false;
    }
    let mut ring = Ring::new(&flat);
    let mut corner = 0;
    for left in (4..=count).rev() {
        // Without an ear the polygon is not simple: then a corner that is straight, or any.
        let ear = ring.find(corner, left, |ring, k| ring.is_ear[k]);
        let cut = ear
            .or_else(|| ring.find(corner, left, |ring, k| ring.turn_at(k) == Ordering::Equal))
            .unwrap_or(corner);
        emit([ring.previous[cut], cut, ring.next[cut]]);
        corner = ring.cut(cut);
    }
    emit([ring.previous[corner], corner, ring.next[corner]]);
    true
}

/// Computes Newell's normal of a polygon: twice its area, towards the side that sees it
/// counter-clockwise. Source: Sutherland, Sproull & Schumacker, "A Characterization of Ten
/// Hidden-Surface Algorithms" (1974), who credit M. E. Newell. Taken about the first corner, so
/// that it does not lose digits far from the origin.
fn newell_normal(points: &[DVec3]) -> DVec3 {
    let from_first = |k: usize| points[k] - points[0];
    (1..points.len() - 1).map(|k| from_first(k).cross(from_first(k + 1))).sum()
}

/// Tells how a, b, c turn, `Greater` to the left. It is rounded: files round the corners of their
/// polygons more than this does.
fn turn(a: DVec2, b: DVec2, c: DVec2) -> Ordering {
    let (u, v) = (b - a, c - a);
    (u.x * v.y).partial_cmp(&(u.y * v.x)).unwrap_or(Ordering::Equal)
}

/// Whether the polygon turns left at every corner, and once around in all.
fn is_convex(flat: &[DVec2]) -> bool {
    let count = flat.len();
    let at = |k: usize| flat[k % count];
    let turns_left = (0..count).all(|k| turn(at(k), at(k + 1), at(k + 2)) == Ordering::Greater);
    let goes_right = |k: usize| (at(k).x, at(k).y) < (at(k + 1).x, at(k + 1).y);
    turns_left && (0..count).filter(|&k| goes_right(k) != goes_right(k + 1)).count() == 2
}

/// The rest of a polygon while its ears are cut off.
struct Ring<'a> {
    points: &'a [DVec2],
    previous: Vec<usize>,
    next: Vec<usize>,
    is_ear: Vec<bool>,
    /// Corners that turn right or not at all: only they can lie in an ear.
    dents: Vec<usize>,
}

impl<'a> Ring<'a> {
    fn new(points: &'a [DVec2]) -> Self {
        let count = points.len();
        let mut ring = Self {
            points,
            previous: (0..count).map(|k| (k + count - 1) % count).collect(),
            next: (0..count).map(|k| (k + 1) % count).collect(),
            is_ear: vec![false; count],
            dents: Vec::new(),
        };
        ring.dents = (0..count).filter(|&k| ring.turn_at(k) != Ordering::Greater).collect();
        for k in 0..count {
            ring.is_ear[k] = ring.can_be_cut(k);
        }
        ring
    }

    fn turn_at(&self, k: usize) -> Ordering {
        turn(self.points[self.previous[k]], self.points[k], self.points[self.next[k]])
    }

    fn can_be_cut(&self, k: usize) -> bool {
        let corners = [self.previous[k], k, self.next[k]];
        let [a, b, c] = corners.map(|corner| self.points[corner]);
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let blocks = |dent: usize| {
            let point = self.points[dent];
            point.cmpge(low).all()
                && point.cmple(high).all()
                && !corners.contains(&dent)
                && point != a
                && point != b
                && point != c
                && turn(a, b, point) != Ordering::Less
                && turn(b, c, point) != Ordering::Less
                && turn(c, a, point) != Ordering::Less
        };
        turn(a, b, c) == Ordering::Greater && !self.dents.iter().any(|&dent| blocks(dent))
    }

    /// Finds the first of the `left` corners from `from` on that `is_right`.
    fn find(
        &self,
        from: usize,
        left: usize,
        is_right: impl Fn(&Self, usize) -> bool,
    ) -> Option<usize> {
        std::iter::successors(Some(from), |&k| Some(self.next[k]))
            .take(left)
            .find(|&k| is_right(self, k))
    }

    /// Takes a corner out; the answer is one two further on, so that the triangles do not all
    /// meet in one corner.
    fn cut(&mut self, k: usize) -> usize {
        let (before, after) = (self.previous[k], self.next[k]);
        self.next[before] = after;
        self.previous[after] = before;
        self.dents.retain(|&dent| dent != k);
        for corner in [before, after] {
            if self.turn_at(corner) == Ordering::Greater {
                self.dents.retain(|&dent| dent != corner);
            }
        }
        for corner in [before, after] {
            self.is_ear[corner] = self.can_be_cut(corner);
        }
        self.next[after]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangulates a polygon in several planes and checks that the triangles turn as it does,
    /// and have its area together.
    fn check_triangles(polygon: &[[f64; 2]]) {
        let twice_area = |corners: &[[f64; 2]]| -> f64 {
            let pairs = corners.iter().zip(corners.iter().cycle().skip(1));
            pairs.map(|(p, q)| p[0] * q[1] - p[1] * q[0]).sum()
        };
        let planes: [fn([f64; 2]) -> DVec3; 4] = [
            |[x, y]| DVec3::new(x, y, 7.0),
            |[x, y]| DVec3::new(y, x, 7.0),
            |[x, y]| DVec3::new(7.0, x, y),
            |[x, y]| DVec3::new(x + y, x - y, x + 3.0 * y),
        ];
        for plane in planes {
            let points: Vec<DVec3> = polygon.iter().map(|&point| plane(point)).collect();
            let mut triangles = Vec::new();
            assert!(triangulate(&points, |triangle| triangles.push(triangle)));
            assert_eq!(triangles.len(), polygon.len() - 2);
            let areas: Vec<f64> = triangles
                .iter()
                .map(|triangle| twice_area(&triangle.map(|k| polygon[k])))
                .collect();
            assert!(areas.iter().all(|&area| area > 0.0), "{areas:?}");
            assert!(
                (areas.iter().sum::<f64>() - twice_area(polygon)).abs()
                    < 1e-9 * twice_area(polygon)
            );
        }
    }

    #[test]
    fn convex_and_concave_polygons_are_covered_once() {
        check_triangles(&[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
        check_triangles(&[[0.0, 0.0], [4.0, 0.0], [1.0, 1.0], [0.0, 4.0]]);
        check_triangles(&[[1.0, 1.0], [0.0, 4.0], [0.0, 0.0], [4.0, 0.0]]);
        check_triangles(&[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 2.0], [0.0, 2.0]]);
        check_triangles(&[
            [0.0, 0.0],
            [6.0, 0.0],
            [6.0, 3.0],
            [4.0, 3.0],
            [4.0, 1.0],
            [2.0, 1.0],
            [2.0, 3.0],
            [0.0, 3.0],
        ]);
    }

    #[test]
    fn a_comb_is_covered_once() {
        let teeth =
            (0..100).flat_map(|k| [[f64::from(200 - 2 * k), 5.0], [f64::from(199 - 2 * k), 1.0]]);
        let comb: Vec<_> = [[0.0, 0.0], [200.0, 0.0]].into_iter().chain(teeth).collect();
        check_triangles(&comb);
    }

    #[test]
    fn a_spiral_is_covered_once() {
        let arm = |k: i32, radius: f64| {
            let corner = [
                [1.0, 0.0],
                [0.7, 0.7],
                [0.0, 1.0],
                [-0.7, 0.7],
                [-1.0, 0.0],
                [-0.7, -0.7],
                [0.0, -1.0],
                [0.7, -0.7],
            ][(k % 8) as usize];
            corner.map(|x| x * radius * (1.0 + f64::from(k) / 4.0))
        };
        let spiral: Vec<_> =
            (0..100).map(|k| arm(k, 1.2)).chain((0..100).rev().map(|k| arm(k, 1.0))).collect();
        check_triangles(&spiral);
    }

    #[test]
    fn what_is_no_polygon_does_not_matter() {
        for points in [
            vec![DVec3::ZERO; 7],
            vec![DVec3::ZERO, DVec3::ONE, DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE],
            vec![DVec3::splat(f64::MAX), DVec3::ZERO, -DVec3::splat(f64::MAX), DVec3::X],
            vec![DVec3::X, DVec3::Y],
        ] {
            let mut count = 0;
            assert!(triangulate(&points, |_| count += 1));
            assert_eq!(count, points.len() - 2);
        }
    }
}
