//! The order of all faces.

use std::{collections::HashMap, ops::Range};

use super::error::PrepareError;
use crate::{
    prepared::node::Child,
    scene::{Scene, SolidNode},
};

/// The order of all faces: by primitive, then by face.
pub(super) struct Ranks {
    /// The first rank of each primitive; empty where every primitive has one face.
    pub(super) firsts: Vec<u32>,
}

impl Ranks {
    /// The order of a scene's faces, unless there are too many to number.
    pub(crate) fn new(scene: &Scene) -> Result<Self, PrepareError> {
        let counts = (scene.parallelepipeds.iter().map(|solid| (solid.primitive, 6)))
            .chain(
                scene.meshes.iter().map(|mesh| (mesh.primitive, mesh.shape.triangles.len() as u64)),
            )
            .chain(scene.solids.iter().map(|solid| {
                let is_leaf = |node: &&SolidNode| !matches!(node, SolidNode::Operation { .. });
                (solid.primitive, 6 * solid.nodes.iter().filter(is_leaf).count() as u64)
            }));
        let several: HashMap<u32, u64> = counts.filter(|&(_, count)| count != 1).collect();
        let primitives = (scene.triangles.iter().map(|face| face.primitive))
            .chain(scene.quadrangles.iter().map(|face| face.primitive))
            .chain(scene.spheres.iter().map(|face| face.primitive))
            .chain(scene.parallelepipeds.iter().map(|face| face.primitive))
            .chain(scene.solids.iter().map(|face| face.primitive))
            .chain(scene.meshes.iter().map(|face| face.primitive))
            .max()
            .map_or(0, |last| last + 1);
        let (mut count, mut firsts) = (u64::from(primitives), Vec::new());
        if !several.is_empty() {
            count = 0;
            firsts = (0..primitives)
                .map(|primitive| {
                    let first = count;
                    count += several.get(&primitive).copied().unwrap_or(1);
                    first.min(u32::MAX.into()) as u32
                })
                .collect();
        }
        if count > Child::ITEM_LIMIT as u64 {
            return Err(PrepareError::TooManyFaces(count));
        }
        Ok(Self { firsts })
    }

    /// The primitive that has the face of a rank.
    pub(super) fn primitive(&self, rank: u32) -> u32 {
        match self.firsts.partition_point(|&first| first <= rank) {
            0 => rank,
            after => after as u32 - 1,
        }
    }

    /// The ranks of a primitive's faces.
    pub(super) fn of(&self, primitive: u32) -> Range<u32> {
        let first = self.first(primitive);
        match self.firsts.get(primitive as usize + 1) {
            Some(&next) => first..next,
            None if self.firsts.is_empty() => first..first + 1,
            None => first..u32::MAX,
        }
    }

    /// The rank of a primitive's first face.
    pub(super) fn first(&self, primitive: u32) -> u32 {
        self.firsts.get(primitive as usize).copied().unwrap_or(primitive)
    }
}
