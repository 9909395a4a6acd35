//! Polygons cut off along a line or a plane.

/// Cuts off the part of a polygon where `height`, which is linear, is below 0. What is left takes
/// the place of `outline`, in the same sense of rotation and beginning at its last edge; nothing
/// is left of a polygon that lies below as a whole. `room` only lends its memory.
///
/// `between(p, q, share)` is the point p + share · (q - p) of the edge from p to q, where share is
/// in 0..=1. It is asked about each edge in the direction of the outline, whichever end is below.
///
/// Source: Sutherland & Hodgman, "Reentrant Polygon Clipping" (1974).
pub(crate) fn clip<P: Copy>(
    outline: &mut Vec<P>,
    room: &mut Vec<P>,
    height: impl Fn(P) -> f64,
    between: impl Fn(P, P, f64) -> P,
) {
    room.clear();
    let Some(mut last) = outline.last().copied() else { return };
    let mut last_height = height(last);
    for &corner in outline.iter() {
        let its_height = height(corner);
        if (its_height < 0.0) != (last_height < 0.0) {
            let share = last_height / (last_height - its_height);
            room.push(between(last, corner, share));
        }
        if its_height >= 0.0 {
            room.push(corner);
        }
        (last, last_height) = (corner, its_height);
    }
    std::mem::swap(outline, room);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(corners: &[[f64; 2]], height: impl Fn([f64; 2]) -> f64, left: &[[f64; 2]]) {
        let (mut outline, mut room) = (corners.to_vec(), vec![[7.0; 2]]);
        let between = |p: [f64; 2], q: [f64; 2], share: f64| {
            [0, 1].map(|axis| p[axis] + share * (q[axis] - p[axis]))
        };
        clip(&mut outline, &mut room, height, between);
        assert_eq!(outline, left);
    }

    const SQUARE: [[f64; 2]; 4] = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];

    #[test]
    fn half_a_square_is_a_rectangle() {
        let left = [[0.0, 0.25], [1.0, 0.25], [1.0, 1.0], [0.0, 1.0]];
        check(&SQUARE, |[_, y]| y - 0.25, &left);
    }

    #[test]
    fn a_corner_cut_off_leaves_five() {
        let left = [[0.5, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.5]];
        let mut from_its_last_edge = left;
        from_its_last_edge.rotate_right(1);
        check(&SQUARE, |[x, y]| x + y - 0.5, &from_its_last_edge);
    }

    #[test]
    fn a_polygon_above_or_on_the_line_is_kept_and_one_below_is_gone() {
        check(&SQUARE, |[x, _]| x, &SQUARE);
        check(&SQUARE, |[x, _]| -0.5 - x, &[]);
        check(&[], |[x, _]| x, &[]);
    }
}
