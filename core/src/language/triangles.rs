//! The triangles of a scene text, each only once.

use hashbrown::{HashTable, hash_table::Entry};

use glam::{DVec2, DVec3};

use super::symbol::Symbols;
use crate::{
    exact::{hash::HashFunction, predicates::is_collinear},
    scene::{DroppedFaces, Triangle},
};

/// The triangles that a scene keeps: of an area above zero, each only once.
#[derive(Debug)]
pub(super) struct Triangles {
    /// The triangles; their `material` is a symbol.
    pub(super) list: Vec<Triangle>,
    /// Explicit texture coordinates, by ascending index in `list`.
    pub(super) texcoords: Vec<(u32, [DVec2; 3])>,
    pub(super) dropped: DroppedFaces,
    /// Index in `list` and half a hash of each triangle.
    table: HashTable<(u32, u32)>,
    pub(super) hash_function: HashFunction,
}

impl Triangles {
    /// Starts without triangles.
    pub(super) fn new() -> Self {
        Self {
            list: Vec::new(),
            texcoords: Vec::new(),
            dropped: DroppedFaces::default(),
            table: HashTable::new(),
            hash_function: HashFunction::random(),
        }
    }

    /// Adds a triangle unless it has no area or is there already.
    pub(super) fn add(
        &mut self,
        triangle: Triangle,
        texcoords: Option<[DVec2; 3]>,
        symbols: &mut Symbols<'_>,
    ) {
        let [a, b, c] = triangle.vertices;
        if is_collinear(a, b, c) {
            self.dropped.zero_area += 1;
        } else {
            self.add_solid(
                triangle,
                texcoords,
                hash_vertices(&triangle.vertices, &self.hash_function),
                symbols,
            );
        }
    }

    /// Adds a triangle of an area above zero.
    pub(super) fn add_solid(
        &mut self,
        triangle: Triangle,
        texcoords: Option<[DVec2; 3]>,
        vertex_hash: u64,
        symbols: &mut Symbols<'_>,
    ) {
        let function = &self.hash_function;
        let mut hash = function.extend(vertex_hash, [u64::from(triangle.material)]);
        if let Some(texcoords) = texcoords {
            let first = first_vertex(&triangle.vertices);
            let texcoord = |k: usize| texcoords[(first + k) % 3].to_array().map(f64::to_bits);
            hash = function.extend(hash, (0..3).flat_map(texcoord));
        }
        let half = (hash >> 32) as u32;
        let (list, known_texcoords) = (&self.list, &self.texcoords);
        let is_same = |&(index, other_half): &(u32, u32)| {
            other_half == half
                && is_copy(
                    &list[index as usize],
                    texcoords_at(known_texcoords, index),
                    &triangle,
                    texcoords,
                    symbols,
                )
        };
        match self.table.entry(spread(half), is_same, |&(_, half)| spread(half)) {
            Entry::Occupied(_) => self.dropped.duplicates += 1,
            Entry::Vacant(place) => {
                let index = self.list.len() as u32;
                place.insert((index, half));
                self.list.push(triangle);
                self.texcoords.extend(texcoords.map(|texcoords| (index, texcoords)));
            }
        }
    }
}

/// Whether two triangles are the same but for the vertex that they begin with.
fn is_copy(
    old: &Triangle,
    old_texcoords: Option<[DVec2; 3]>,
    new: &Triangle,
    new_texcoords: Option<[DVec2; 3]>,
    symbols: &mut Symbols<'_>,
) -> bool {
    if old.material != new.material {
        return false;
    }
    let is_turned_by =
        |turn: usize| (0..3).all(|k| old.vertices[(k + turn) % 3] == new.vertices[k]);
    let Some(turn) = (0..3).find(|&turn| is_turned_by(turn)) else { return false };
    match (old_texcoords, new_texcoords) {
        (None, None) => turn == 0 || symbols.may_turn(old.material),
        (Some(old), Some(new)) => (0..3).all(|k| old[(k + turn) % 3] == new[k]),
        _ => false,
    }
}

/// Finds the explicit texture coordinates of a triangle in the list.
fn texcoords_at(texcoords: &[(u32, [DVec2; 3])], index: u32) -> Option<[DVec2; 3]> {
    let place = texcoords.binary_search_by_key(&index, |&(known, _)| known).ok()?;
    Some(texcoords[place].1)
}

/// Finds the vertex that comes first in an order of all points; turning the triangle does not move
/// it.
fn first_vertex(vertices: &[DVec3; 3]) -> usize {
    let key = |k: usize| vertices[k].to_array().map(f64::to_bits);
    let first = usize::from(key(1) < key(0));
    if key(2) < key(first) { 2 } else { first }
}

/// Hashes the vertices of a triangle; turning it does not change the hash.
pub(super) fn hash_vertices(vertices: &[DVec3; 3], function: &HashFunction) -> u64 {
    let first = first_vertex(vertices);
    function.hash((0..3).flat_map(|k| vertices[(first + k) % 3].to_array().map(f64::to_bits)))
}

/// Makes a whole hash of half a one: tables take the place from the low bits and a tag from the
/// high.
fn spread(half: u32) -> u64 {
    u64::from(half) | u64::from(half) << 32
}
