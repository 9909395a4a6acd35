//! The section of the shapes.

use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::{
    block::Block, diagnostic::quoted, direction::direction, field::Field, lexer::Word,
    pieces::Runs, symbol::Symbols, triangles::Triangles, walk::Walk,
};
use crate::{
    exact::predicates::{self, QuadrangleFault},
    scene::{
        Mesh, MeshShape, MeshVertices, Operation, Parallelepiped, Quadrangle, Scene, Solid,
        SolidNode, Sphere, Triangle,
    },
};

/// The shapes that are known.
#[derive(Debug)]
pub(super) struct Shapes<'t> {
    runs: Runs,
    triangles: Triangles,
    spheres: Vec<Sphere>,
    quadrangles: Vec<Quadrangle>,
    quadrangle_texcoords: Vec<(u32, [DVec2; 4])>,
    parallelepipeds: Vec<Parallelepiped>,
    solids: Vec<Solid>,
    /// The meshes; their files have not been read yet.
    meshes: Vec<Mesh>,
    /// The name of each mesh's file.
    mesh_files: Vec<Word<'t>>,
    /// The next primitive's number.
    primitive: u64,
}

/// A set operation whose end has not come yet.
struct OpenOperation<'t> {
    opening: Word<'t>,
    operation: Operation,
    operands: u32,
}

impl<'t> Shapes<'t> {
    /// Starts without shapes. Runs of triangles are parsed in parallel by pieces of about so many
    /// bytes.
    pub(super) fn new(piece: usize) -> Self {
        Self {
            runs: Runs::new(piece),
            triangles: Triangles::new(),
            spheres: Vec::new(),
            quadrangles: Vec::new(),
            quadrangle_texcoords: Vec::new(),
            parallelepipeds: Vec::new(),
            solids: Vec::new(),
            meshes: Vec::new(),
            mesh_files: Vec::new(),
            primitive: 0,
        }
    }

    /// Reads a `geometry` block. Operations may be nested a million deep: those that are open form
    /// a list, not calls.
    pub(super) fn read_geometry(
        &mut self,
        walk: &mut Walk<'t>,
        symbols: &mut Symbols<'t>,
        opening: Word<'t>,
    ) {
        walk.enter(Block::Geometry, opening);
        let mut operations: Vec<OpenOperation<'t>> = Vec::new();
        let mut nodes: Vec<SolidNode> = Vec::new();
        let mut leaf_count = 0;
        loop {
            let Some(word) = walk.next() else {
                let Some(done) = operations.pop() else { return };
                finish_operation(walk, &done, &mut nodes);
                if let Some(outer) = operations.last_mut() {
                    outer.operands += 1;
                } else {
                    self.finish_solid(walk, done.opening, std::mem::take(&mut nodes));
                    leaf_count = 0;
                }
                continue;
            };
            let Some(block) = Block::opened_by(&word) else {
                walk.skip_unknown_keyword(word);
                continue;
            };
            if let Some(operation) = operation(block) {
                walk.enter(block, word);
                operations.push(OpenOperation { opening: word, operation, operands: 0 });
                continue;
            }
            let is_solid = matches!(block, Block::Sphere | Block::Parallelepiped);
            if let Some(outer) = operations.last_mut() {
                if is_solid {
                    outer.operands += 1;
                    leaf_count += 1;
                } else {
                    let outer = outer.opening;
                    walk.report.error(word.span(), || {
                        format!(
                            "{} is not a solid; {} takes spheres, parallelepipeds and operations on them",
                            quoted(word.bytes),
                            quoted(outer.bytes)
                        )
                    });
                }
            }
            let is_alone = operations.is_empty();
            match block {
                Block::Sphere => {
                    let primitive =
                        if is_alone { self.next_primitive(walk, word) } else { leaf_count - 1 };
                    if let Some(sphere) = read_sphere(walk, symbols, word, primitive) {
                        if is_alone {
                            self.spheres.push(sphere);
                        } else {
                            nodes.push(SolidNode::Sphere(sphere));
                        }
                    }
                }
                Block::Parallelepiped => {
                    let primitive =
                        if is_alone { self.next_primitive(walk, word) } else { leaf_count - 1 };
                    if let Some(parallelepiped) =
                        read_parallelepiped(walk, symbols, word, primitive)
                    {
                        if is_alone {
                            self.parallelepipeds.push(parallelepiped);
                        } else {
                            nodes.push(SolidNode::Parallelepiped(parallelepiped));
                        }
                    }
                }
                Block::Triangle => {
                    if is_alone && self.read_plain_triangles(walk, symbols, word) {
                        continue;
                    }
                    self.read_triangle(walk, symbols, word);
                }
                Block::Quadrangle => self.read_quadrangle(walk, symbols, word),
                _ => self.read_mesh(walk, symbols, word, block),
            }
        }
    }

    fn finish_solid(&mut self, walk: &mut Walk<'t>, opening: Word<'t>, nodes: Vec<SolidNode>) {
        let primitive = self.next_primitive(walk, opening);
        self.solids.push(Solid { nodes, primitive });
    }

    /// Counts a primitive that begins at `word`, and gives its number.
    fn next_primitive(&mut self, walk: &mut Walk<'t>, word: Word<'t>) -> u32 {
        let number = u32::try_from(self.primitive);
        if self.primitive == u64::from(u32::MAX) {
            walk.report
                .error(word.span(), || format!("a scene has at most {} primitives", u32::MAX));
        }
        self.primitive += 1;
        number.unwrap_or(u32::MAX)
    }

    /// Reads as many plain triangle blocks as there are, from the one that `word` opens; whether
    /// there was one.
    fn read_plain_triangles(
        &mut self,
        walk: &mut Walk<'t>,
        symbols: &mut Symbols<'t>,
        word: Word<'t>,
    ) -> bool {
        let at = self.runs.read(
            walk.lexer.text(),
            word.start,
            &mut self.triangles,
            &mut self.primitive,
            symbols,
        );
        if at > word.start {
            walk.lexer.go_to(at);
        }
        at > word.start
    }

    fn read_triangle(&mut self, walk: &mut Walk<'t>, symbols: &mut Symbols<'t>, opening: Word<'t>) {
        let primitive = self.next_primitive(walk, opening);
        let Some((vertices, texcoords, material)) =
            read_corners(walk, symbols, Block::Triangle, opening, "triangle")
        else {
            return;
        };
        self.triangles.add(Triangle { vertices, material, primitive }, texcoords, symbols);
    }

    fn read_quadrangle(
        &mut self,
        walk: &mut Walk<'t>,
        symbols: &mut Symbols<'t>,
        opening: Word<'t>,
    ) {
        let primitive = self.next_primitive(walk, opening);
        let Some((vertices, texcoords, material)) =
            read_corners(walk, symbols, Block::Quadrangle, opening, "quadrangle")
        else {
            return;
        };
        match predicates::check_quadrangle(vertices) {
            Ok(None) => {}
            Ok(Some(deviation)) => walk.report.warn(opening.span(), || {
                format!("this quadrangle is planar only to within {deviation:.3e}, but is taken as planar")
            }),
            Err(fault) => {
                walk.report.error(opening.span(), || match fault {
                    QuadrangleFault::Degenerate => {
                        "this quadrangle has no area: its vertices lie on one line".into()
                    }
                    QuadrangleFault::SamePlace => {
                        "two vertices of this quadrangle are equal; write a shape of three vertices as a `triangle`".into()
                    }
                    QuadrangleFault::Crossing => {
                        "the sides of this quadrangle cross or touch; its vertices must go around it in order".into()
                    }
                    QuadrangleFault::NotPlanar { deviation, tolerance } => format!(
                        "this quadrangle is not planar: its vertices are {deviation:.3e} away from their plane, and at \
                         most {tolerance:.3e} is allowed; use two triangles instead"
                    ),
                });
                return;
            }
        }
        let index = self.quadrangles.len() as u32;
        self.quadrangles.push(Quadrangle { vertices, material, primitive });
        self.quadrangle_texcoords.extend(texcoords.map(|texcoords| (index, texcoords)));
    }

    fn read_mesh(
        &mut self,
        walk: &mut Walk<'t>,
        symbols: &mut Symbols<'t>,
        opening: Word<'t>,
        block: Block,
    ) {
        if block == Block::StlModel {
            walk.warn_synonym(opening, "`mesh`");
        }
        let primitive = self.next_primitive(walk, opening);
        walk.enter(block, opening);
        let (mut file, mut material) = (Field::default(), Field::default());
        let (mut scale, mut rotate, mut offset) =
            (Field::default(), Field::default(), Field::default());
        while let Some(word) = walk.next() {
            match word.bytes {
                b"file" | b"filename" => {
                    if word.bytes == b"filename" {
                        walk.warn_synonym(word, "`file`");
                    }
                    let value = walk.file_name(word);
                    file.set(&mut walk.report, word, value);
                }
                b"material" => {
                    let value = material_name(walk, symbols, word, "mesh");
                    material.set(&mut walk.report, word, value);
                }
                b"scale" => {
                    let value = walk.number_above_zero(word);
                    scale.set(&mut walk.report, word, value);
                }
                b"rotate" => {
                    let value = walk.numbers(word).and_then(|[x, y, z, degrees]| {
                        let axis = DVec3::new(x, y, z);
                        if axis == DVec3::ZERO {
                            walk.refuse_value(|| "the axis of `rotate` must not be 0 0 0".into());
                        }
                        (axis != DVec3::ZERO).then_some((axis, degrees))
                    });
                    rotate.set(&mut walk.report, word, value);
                }
                b"move" => {
                    let value = walk.position(word);
                    offset.set(&mut walk.report, word, value);
                }
                _ => walk.skip_unknown_keyword(word),
            }
        }
        let file = file.require(walk, opening, "file");
        let material = material.require(walk, opening, "material");
        if let (Some(file), Some(material)) = (file, material) {
            self.mesh_files.push(file);
            self.meshes.push(Mesh {
                path: String::from_utf8_lossy(file.bytes).into_owned(),
                shape: Arc::new(MeshShape {
                    vertices: MeshVertices::Single(Vec::new()),
                    triangles: Vec::new(),
                }),
                scale: scale.value.unwrap_or(1.0),
                rotate: rotate.value,
                offset: offset.value.unwrap_or_default(),
                material,
                primitive,
            });
        }
    }

    /// Gives what was read to the scene, symbols turned into indices of materials. The answer is
    /// the name of each mesh's file.
    pub(super) fn finish(mut self, symbols: &Symbols<'_>, scene: &mut Scene) -> Vec<Word<'t>> {
        let index = |symbol: u32| symbols.get(symbol).definition.map_or(0, |(index, _)| index);
        self.triangles.list.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.spheres.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.quadrangles.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.parallelepipeds.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.meshes.iter_mut().for_each(|shape| shape.material = index(shape.material));
        for node in self.solids.iter_mut().flat_map(|solid| &mut solid.nodes) {
            match node {
                SolidNode::Sphere(shape) => shape.material = index(shape.material),
                SolidNode::Parallelepiped(shape) => shape.material = index(shape.material),
                SolidNode::Operation { .. } => {}
            }
        }
        scene.spheres = self.spheres;
        scene.triangles = self.triangles.list;
        scene.triangle_texcoords = self.triangles.texcoords;
        scene.dropped = self.triangles.dropped;
        scene.quadrangles = self.quadrangles;
        scene.quadrangle_texcoords = self.quadrangle_texcoords;
        scene.parallelepipeds = self.parallelepipeds;
        scene.solids = self.solids;
        scene.meshes = self.meshes;
        self.mesh_files
    }
}

fn finish_operation(walk: &mut Walk<'_>, done: &OpenOperation<'_>, nodes: &mut Vec<SolidNode>) {
    let OpenOperation { opening, operation, operands } = *done;
    if operands < 2 && !walk.is_cut {
        let found = if operands == 0 { "none is given" } else { "only one is given" };
        walk.report.error(opening.span(), || {
            format!("{} joins two or more solids, but {found}", quoted(opening.bytes))
        });
    }
    nodes.push(SolidNode::Operation { operation, operands });
}

/// Reads the name of a material, for a `shape`.
fn material_name<'t>(
    walk: &mut Walk<'t>,
    symbols: &mut Symbols<'t>,
    word: Word<'t>,
    shape: &'static str,
) -> Option<u32> {
    let name = walk.value_word(word, "the name of a material")?;
    Some(match shape {
        "triangle" | "quadrangle" => symbols.use_on_flat(name, 1),
        _ => symbols.use_on_untexturable(name, shape),
    })
}

fn read_sphere<'t>(
    walk: &mut Walk<'t>,
    symbols: &mut Symbols<'t>,
    opening: Word<'t>,
    primitive: u32,
) -> Option<Sphere> {
    walk.enter(Block::Sphere, opening);
    let (mut coords, mut radius, mut material) =
        (Field::default(), Field::default(), Field::default());
    while let Some(word) = walk.next() {
        match word.bytes {
            b"coords" | b"position" => walk.read_coords(word, &mut coords),
            b"radius" => {
                let value = walk.number_above_zero(word);
                radius.set(&mut walk.report, word, value);
            }
            b"material" => {
                let value = material_name(walk, symbols, word, "sphere");
                material.set(&mut walk.report, word, value);
            }
            _ => walk.skip_unknown_keyword(word),
        }
    }
    let center = coords.require(walk, opening, "coords");
    let radius = radius.require(walk, opening, "radius");
    let material = material.require(walk, opening, "material");
    Some(Sphere { center: center?, radius: radius?, material: material?, primitive })
}

fn read_parallelepiped<'t>(
    walk: &mut Walk<'t>,
    symbols: &mut Symbols<'t>,
    opening: Word<'t>,
    primitive: u32,
) -> Option<Parallelepiped> {
    let (vertices, _, material) =
        read_corners::<4>(walk, symbols, Block::Parallelepiped, opening, "parallelepiped")?;
    let corner = vertices[0];
    let edges = [1, 2, 3].map(|k| vertices[k] - corner);
    if predicates::is_coplanar(vertices[0], vertices[1], vertices[2], vertices[3]) {
        walk.report.error(opening.span(), || {
            "this parallelepiped has no volume; its vertices must be a corner and that corner's three \
                 neighbours, not all in one plane"
                .into()
        });
        return None;
    }
    if !edges.iter().all(|edge| edge.is_finite()) {
        walk.report.error(opening.span(), || {
            "this parallelepiped is too large; the longest edge is about 1.8e308".into()
        });
        return None;
    }
    let condition = condition(edges);
    if condition.is_nan() || condition > MOST_SHEARED {
        walk.report.error(opening.span(), || {
            format!(
                "this parallelepiped is too flat: its condition number is {condition:.1e}, \
                     and at most {MOST_SHEARED:.0e} is allowed"
            )
        });
        return None;
    }
    Some(Parallelepiped { corner, edges, material, primitive })
}

/// Reads a block of `N` vertices, each perhaps with texture coordinates, and a material.
fn read_corners<'t, const N: usize>(
    walk: &mut Walk<'t>,
    symbols: &mut Symbols<'t>,
    block: Block,
    opening: Word<'t>,
    shape: &'static str,
) -> Option<([DVec3; N], Option<[DVec2; N]>, u32)> {
    walk.enter(block, opening);
    let mut vertices = [DVec3::ZERO; N];
    let mut texcoords = [Field::<DVec2>::default(); N];
    let (mut count, mut is_sound) = (0, true);
    let mut material = Field::default();
    while let Some(word) = walk.next() {
        match word.bytes {
            b"vertex" => {
                let vertex = walk.position(word);
                match vertices.get_mut(count) {
                    Some(place) => *place = vertex.unwrap_or_default(),
                    None if count == N => walk.report.error(word.span(), || {
                        format!("a {shape} has {N} vertices, but this is one more")
                    }),
                    None => {}
                }
                is_sound &= vertex.is_some() && count < N;
                count += 1;
            }
            b"texcoord" | b"textureCoord" if N != 4 || block == Block::Quadrangle => {
                if word.bytes == b"textureCoord" {
                    walk.warn_synonym(word, "`texcoord`");
                }
                let value = walk.numbers(word).map(DVec2::from);
                if word.bytes == b"textureCoord" && walk.numbers_that_follow() > 0 {
                    walk.number(word); // The third of three coordinates.
                }
                is_sound &= value.is_some();
                match count.checked_sub(1) {
                    Some(index) if index < N => {
                        texcoords[index].set(&mut walk.report, word, value);
                    }
                    Some(_) => {}
                    None => {
                        is_sound = false;
                        walk.report.error(word.span(), || {
                            format!(
                                "{} must come after the vertex that it belongs to",
                                quoted(word.bytes)
                            )
                        });
                    }
                }
            }
            b"material" => {
                let value = material_name(walk, symbols, word, shape);
                material.set(&mut walk.report, word, value);
            }
            _ => walk.skip_unknown_keyword(word),
        }
    }
    if count < N {
        if !walk.is_cut {
            walk.report.error(opening.span(), || {
                format!("a {shape} has {N} vertices, but this one has {count}")
            });
        }
        is_sound = false;
    }
    let with_texcoords = texcoords.iter().filter(|texcoord| texcoord.word.is_some()).count();
    if count >= N && with_texcoords > 0 && with_texcoords < N {
        is_sound = false;
        walk.report.error(opening.span(), || {
            format!("a `texcoord` is given for {with_texcoords} of {N} vertices; give one for all of them or for none")
        });
    }
    let material = material.require(walk, opening, "material")?;
    let texcoords =
        (with_texcoords == N).then(|| texcoords.map(|texcoord| texcoord.value.unwrap_or_default()));
    is_sound.then_some((vertices, texcoords, material))
}

/// The largest condition number of a parallelepiped. Beyond it, fewer than four digits of a hit
/// would be right.
const MOST_SHEARED: f64 = 1e12;

fn operation(block: Block) -> Option<Operation> {
    match block {
        Block::Union => Some(Operation::Union),
        Block::Intersection => Some(Operation::Intersection),
        Block::Difference => Some(Operation::Difference),
        _ => None,
    }
}

/// Computes the condition number (Frobenius) of three edges, each taken as long as the others: how
/// much more the inverse of a sheared box errs than that of an upright one.
fn condition(edges: [DVec3; 3]) -> f64 {
    let [a, b, c] = edges.map(direction);
    let faces = [b.cross(c), c.cross(a), a.cross(b)];
    let area: f64 = faces.iter().map(|face| face.length_squared()).sum();
    (3.0 * area).sqrt() / a.dot(faces[0]).abs()
}
