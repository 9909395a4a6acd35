//! Constructive solids as sets of points.

use std::ops::Range;

use rtfarm_core::scene::{Operation, Solid, SolidNode};

use crate::{
    ball::Ball,
    face::{Crossing, Face, FaceId, Shape},
    oracle::parallelepiped_faces,
    ray::Ray,
};

/// A solid whose leaves' faces stand in the oracle's list of faces.
#[derive(Debug, Clone)]
pub(crate) struct SolidFaces {
    pub(crate) faces: Range<usize>,
    /// The faces of each leaf, in postfix order.
    leaves: Vec<Range<usize>>,
    nodes: Vec<SolidNode>,
}

/// What a set does at one time of a ray: whether the points just before and just behind belong to
/// it and, if only one of them does, the face between them.
#[derive(Debug, Clone, Copy)]
struct Change<'a> {
    before: bool,
    after: bool,
    crossing: Option<Crossing<'a>>,
}

impl SolidFaces {
    /// Adds the faces of all leaves to `faces`.
    pub(crate) fn new(solid: &Solid, faces: &mut Vec<Face>) -> Self {
        let start = faces.len();
        let mut leaves = Vec::new();
        for node in &solid.nodes {
            let leaf_start = faces.len();
            match node {
                SolidNode::Sphere(sphere) => faces.push(Face {
                    shape: Shape::Ball(Ball::new(*sphere)),
                    id: FaceId { primitive: solid.primitive, face: 6 * sphere.primitive },
                    material: sphere.material,
                }),
                SolidNode::Parallelepiped(leaf) => {
                    faces.extend(parallelepiped_faces(leaf, solid.primitive, 6 * leaf.primitive));
                }
                SolidNode::Operation { .. } => continue,
            }
            leaves.push(leaf_start..faces.len());
        }
        Self { faces: start..faces.len(), leaves, nodes: solid.nodes.clone() }
    }

    /// Where the ray's line enters and leaves the solid, in ascending order.
    ///
    /// All leaves are bounded, so the line starts outside of all. Crossings at the same time count
    /// as one step: what is left out or put in by single points or lines is not the solid's
    /// boundary.
    pub(crate) fn cross<'a>(
        &self,
        faces: &'a [Face],
        ray: &Ray,
        left: Option<&Face>,
    ) -> Vec<Crossing<'a>> {
        let mut events = Vec::new();
        for (leaf, range) in self.leaves.iter().enumerate() {
            let crossings = faces[range.clone()].iter().flat_map(|face| face.cross(ray, left));
            events.extend(passage(crossings, ray).into_iter().flatten().map(|event| (event, leaf)));
        }
        events.sort_by(|a, b| a.0.compare_time(&b.0, ray));

        let outside = Change { before: false, after: false, crossing: None };
        let mut leaves = vec![outside; self.leaves.len()];
        let mut found = Vec::new();
        for step in events.chunk_by(|a, b| a.0.compare_time(&b.0, ray).is_eq()) {
            for leaf in &mut leaves {
                leaf.before = leaf.after;
            }
            for &(crossing, leaf) in step {
                leaves[leaf].after = crossing.front;
                leaves[leaf].crossing = Some(crossing);
            }
            let whole = self.evaluate(&leaves);
            if whole.before != whole.after {
                let crossing = whole.crossing.expect("a set changes at a face of a leaf");
                assert_eq!(crossing.front != crossing.reversed, whole.after);
                found.push(crossing);
            }
        }
        found
    }

    /// What the whole solid does where its leaves do this.
    fn evaluate<'a>(&self, leaves: &[Change<'a>]) -> Change<'a> {
        let mut leaves = leaves.iter();
        let mut stack: Vec<Change<'a>> = Vec::new();
        for node in &self.nodes {
            let change = match node {
                SolidNode::Operation { operation, operands } => {
                    let operands = stack.split_off(stack.len() - *operands as usize);
                    join(*operation, &operands)
                }
                _ => *leaves.next().expect("one for each leaf"),
            };
            stack.push(change);
        }
        stack.pop().expect("a solid has a root")
    }
}

/// Where a line enters and leaves a convex leaf, if it does. A ray that leaves a face starts on it
/// by decree and not quite by its coordinates; where it then seems to go out before it goes in, it
/// only touches an edge.
fn passage<'a>(
    crossings: impl Iterator<Item = Crossing<'a>>,
    ray: &Ray,
) -> Option<[Crossing<'a>; 2]> {
    let (fronts, backs): (Vec<_>, Vec<_>) = crossings.partition(|crossing| crossing.front);
    assert!(fronts.len() == backs.len() && fronts.len() < 2, "a leaf is convex and closed");
    let (&enter, &leave) = (fronts.first()?, backs.first()?);
    enter.compare_time(&leave, ray).is_lt().then_some([enter, leave])
}

/// What an operation's result does where its operands do this. If the result changes, some
/// operand does, and the face is that of the first one.
fn join<'a>(operation: Operation, operands: &[Change<'a>]) -> Change<'a> {
    let combine = |state: fn(&Change<'a>) -> bool| match operation {
        Operation::Union => operands.iter().any(state),
        Operation::Intersection => operands.iter().all(state),
        Operation::Difference => state(&operands[0]) && !operands[1..].iter().any(state),
    };
    let (before, after) = (combine(|change| change.before), combine(|change| change.after));
    let first = operands.iter().position(|change| change.before != change.after);
    let crossing = first.and_then(|k| {
        let is_reversed = operation == Operation::Difference && k > 0;
        operands[k]
            .crossing
            .map(|crossing| Crossing { reversed: crossing.reversed != is_reversed, ..crossing })
    });
    Change { before, after, crossing }
}
