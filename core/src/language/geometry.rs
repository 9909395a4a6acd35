//! The shapes of a scene text.

use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::{
    block::Block,
    diagnostic::shown,
    field::Field,
    lexer::Word,
    reader::{Reader, plain},
};
use crate::{
    exact::predicates::{self, QuadrangleFault},
    scene::{
        Mesh, MeshShape, MeshVertices, Operation, Parallelepiped, Quadrangle, Solid, SolidNode,
        Sphere, Triangle,
    },
};

/// A set operation whose end has not come yet.
struct OpenOperation<'t> {
    opening: Word<'t>,
    operation: Operation,
    operands: u32,
}

impl<'t> Reader<'t> {
    /// Reads the shapes. Operations may be nested a million deep: those that are open form a
    /// list, not calls.
    pub(super) fn read_geometry(&mut self, opening: Word<'t>) {
        self.blocks.enter(Block::Geometry, opening);
        let mut operations: Vec<OpenOperation<'t>> = Vec::new();
        let mut nodes: Vec<SolidNode> = Vec::new();
        let mut leaf_count = 0;
        loop {
            let Some(word) = self.blocks.next() else {
                let Some(done) = operations.pop() else { return };
                self.finish_operation(&done, &mut nodes);
                if let Some(outer) = operations.last_mut() {
                    outer.operands += 1;
                } else {
                    self.finish_solid(done.opening, std::mem::take(&mut nodes));
                    leaf_count = 0;
                }
                continue;
            };
            let Some(block) = Block::opened_by(&word) else {
                self.blocks.skip_unknown_keyword(word);
                continue;
            };
            if let Some(operation) = operation(block) {
                self.blocks.enter(block, word);
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
                    self.report().error(word.span(), || {
                        format!(
                            "{} takes solids: spheres, parallelepipeds and operations on them, no {}",
                            shown(outer.bytes),
                            plain(word)
                        )
                    });
                }
            }
            let is_alone = operations.is_empty();
            match block {
                Block::Sphere => {
                    let primitive =
                        if is_alone { self.next_primitive(word) } else { leaf_count - 1 };
                    if let Some(sphere) = self.read_sphere(word, primitive) {
                        if is_alone {
                            self.scene.spheres.push(sphere);
                        } else {
                            nodes.push(SolidNode::Sphere(sphere));
                        }
                    }
                }
                Block::Parallelepiped => {
                    let primitive =
                        if is_alone { self.next_primitive(word) } else { leaf_count - 1 };
                    if let Some(parallelepiped) = self.read_parallelepiped(word, primitive) {
                        if is_alone {
                            self.scene.parallelepipeds.push(parallelepiped);
                        } else {
                            nodes.push(SolidNode::Parallelepiped(parallelepiped));
                        }
                    }
                }
                Block::Triangle => {
                    if is_alone && self.read_plain_triangles(word) {
                        continue;
                    }
                    self.read_triangle(word);
                }
                Block::Quadrangle => self.read_quadrangle(word),
                _ => self.read_mesh(word, block),
            }
        }
    }

    fn finish_operation(&mut self, done: &OpenOperation<'t>, nodes: &mut Vec<SolidNode>) {
        let OpenOperation { opening, operation, operands } = *done;
        if operands < 2 && !self.blocks.is_cut {
            let found = if operands == 0 { "none" } else { "only one" };
            self.report().error(opening.span(), || {
                format!(
                    "{} joins two or more solids, but {found} stands here",
                    shown(opening.bytes)
                )
            });
        }
        nodes.push(SolidNode::Operation { operation, operands });
    }

    fn finish_solid(&mut self, opening: Word<'t>, nodes: Vec<SolidNode>) {
        let primitive = self.next_primitive(opening);
        self.scene.solids.push(Solid { nodes, primitive });
    }

    /// The number of a primitive that begins at `word`.
    fn next_primitive(&mut self, word: Word<'t>) -> u32 {
        let number = u32::try_from(self.primitive);
        if self.primitive == u64::from(u32::MAX) {
            self.report()
                .error(word.span(), || format!("a scene has at most {} primitives", u32::MAX));
        }
        self.primitive += 1;
        number.unwrap_or(u32::MAX)
    }

    /// Reads as many plain triangle blocks as there are, from the one that `word` opens; whether
    /// there was one.
    fn read_plain_triangles(&mut self, word: Word<'t>) -> bool {
        let at = self.triangles.read_run(
            self.text,
            word.start,
            self.piece,
            &mut self.primitive,
            &mut self.symbols,
        );
        if at > word.start {
            self.blocks.lexer.go_to(at);
        }
        at > word.start
    }

    fn material(&mut self, word: Word<'t>, shape: &'static str) -> Option<u32> {
        let name = self.blocks.value_word(word, "the name of a material")?;
        Some(match shape {
            "triangle" | "quadrangle" => self.symbols.use_on_flat(name, 1),
            _ => self.symbols.use_on_untexturable(name, shape),
        })
    }

    fn read_sphere(&mut self, opening: Word<'t>, primitive: u32) -> Option<Sphere> {
        self.blocks.enter(Block::Sphere, opening);
        let (mut coords, mut radius, mut material) =
            (Field::default(), Field::default(), Field::default());
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"coords" | b"position" => self.read_coords(word, &mut coords),
                b"radius" => {
                    let value =
                        self.blocks.number(word).and_then(|value| self.above_zero(word, value));
                    radius.set(&mut self.blocks.report, word, value);
                }
                b"material" => {
                    let value = self.material(word, "sphere");
                    material.set(&mut self.blocks.report, word, value);
                }
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
        let center = coords.require(&mut self.blocks, opening, "coords");
        let radius = radius.require(&mut self.blocks, opening, "radius");
        let material = material.require(&mut self.blocks, opening, "material");
        Some(Sphere { center: center?, radius: radius?, material: material?, primitive })
    }

    fn read_triangle(&mut self, opening: Word<'t>) {
        let primitive = self.next_primitive(opening);
        let Some((vertices, texcoords, material)) =
            self.read_corners(Block::Triangle, opening, "triangle")
        else {
            return;
        };
        self.triangles.add(
            Triangle { vertices, material, primitive },
            texcoords,
            &mut self.symbols,
        );
    }

    fn read_quadrangle(&mut self, opening: Word<'t>) {
        let primitive = self.next_primitive(opening);
        let Some((vertices, texcoords, material)) =
            self.read_corners(Block::Quadrangle, opening, "quadrangle")
        else {
            return;
        };
        match predicates::check_quadrangle(vertices) {
            Ok(None) => {}
            Ok(Some(deviation)) => self.report().warn(opening.span(), || {
                format!("this quadrangle is planar only to within {deviation:.3e}; taken as planar")
            }),
            Err(fault) => {
                self.report().error(opening.span(), || match fault {
                    QuadrangleFault::Degenerate => {
                        "this quadrangle has no area: its vertices are on one line".into()
                    }
                    QuadrangleFault::SamePlace => {
                        "this quadrangle has two vertices in one place; three make a triangle".into()
                    }
                    QuadrangleFault::Crossing => {
                        "the sides of this quadrangle cross or touch; its vertices must stand in their order around it".into()
                    }
                    QuadrangleFault::NotPlanar { deviation, tolerance } => format!(
                        "this quadrangle is not planar: its vertices are {deviation:.3e} off their plane, and \
                         {tolerance:.3e} is the most; two triangles could be bent so"
                    ),
                });
                return;
            }
        }
        let index = self.scene.quadrangles.len() as u32;
        self.scene.quadrangles.push(Quadrangle { vertices, material, primitive });
        self.scene.quadrangle_texcoords.extend(texcoords.map(|texcoords| (index, texcoords)));
    }

    fn read_parallelepiped(&mut self, opening: Word<'t>, primitive: u32) -> Option<Parallelepiped> {
        let (vertices, _, material) =
            self.read_corners::<4>(Block::Parallelepiped, opening, "parallelepiped")?;
        let corner = vertices[0];
        let edges = [1, 2, 3].map(|k| vertices[k] - corner);
        if predicates::is_coplanar(vertices[0], vertices[1], vertices[2], vertices[3]) {
            self.report().error(opening.span(), || {
                "this parallelepiped has no volume: its vertices are a corner and that corner's three \
                 neighbours, not all in one plane"
                    .into()
            });
            return None;
        }
        if !edges.iter().all(|edge| edge.is_finite()) {
            self.report().error(opening.span(), || {
                "this parallelepiped is too large to be computed with".into()
            });
            return None;
        }
        let condition = condition(edges);
        if condition.is_nan() || condition > MOST_SHEARED {
            self.report().error(opening.span(), || {
                format!(
                    "this parallelepiped is too flat to be computed with: its condition number is {condition:.1e}, \
                     and {MOST_SHEARED:.0e} is the most"
                )
            });
            return None;
        }
        Some(Parallelepiped { corner, edges, material, primitive })
    }

    /// Reads a block of `N` vertices, each perhaps with texture coordinates, and a material.
    fn read_corners<const N: usize>(
        &mut self,
        block: Block,
        opening: Word<'t>,
        shape: &'static str,
    ) -> Option<([DVec3; N], Option<[DVec2; N]>, u32)> {
        self.blocks.enter(block, opening);
        let mut vertices = [DVec3::ZERO; N];
        let mut texcoords = [Field::<DVec2>::default(); N];
        let (mut count, mut is_sound) = (0, true);
        let mut material = Field::default();
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"vertex" => {
                    let vertex = self.blocks.numbers(word).map(DVec3::from);
                    match vertices.get_mut(count) {
                        Some(place) => *place = vertex.unwrap_or_default(),
                        None if count == N => self.report().error(word.span(), || {
                            format!("a {shape} has {N} vertices; this is one more")
                        }),
                        None => {}
                    }
                    is_sound &= vertex.is_some() && count < N;
                    count += 1;
                }
                b"texcoord" | b"textureCoord" if N != 4 || block == Block::Quadrangle => {
                    if word.bytes == b"textureCoord" {
                        self.warn_synonym(word, "`texcoord`");
                    }
                    let value = self.blocks.numbers(word).map(DVec2::from);
                    if word.bytes == b"textureCoord" && self.blocks.numbers_that_follow() > 0 {
                        self.blocks.number(word); // The third of three coordinates.
                    }
                    is_sound &= value.is_some();
                    match count.checked_sub(1) {
                        Some(index) if index < N => {
                            texcoords[index].set(&mut self.blocks.report, word, value);
                        }
                        Some(_) => {}
                        None => {
                            is_sound = false;
                            self.report().error(word.span(), || {
                                format!(
                                    "{} stands behind the vertex that it belongs to",
                                    shown(word.bytes)
                                )
                            });
                        }
                    }
                }
                b"material" => {
                    let value = self.material(word, shape);
                    material.set(&mut self.blocks.report, word, value);
                }
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
        if count < N {
            if !self.blocks.is_cut {
                self.report().error(opening.span(), || {
                    format!("a {shape} has {N} vertices, but this one has {count}")
                });
            }
            is_sound = false;
        }
        let with_texcoords = texcoords.iter().filter(|texcoord| texcoord.word.is_some()).count();
        if count >= N && with_texcoords > 0 && with_texcoords < N {
            is_sound = false;
            self.report().error(opening.span(), || {
                format!(
                    "every vertex has a `texcoord` or none has; here {with_texcoords} of {N} have"
                )
            });
        }
        let material = material.require(&mut self.blocks, opening, "material")?;
        let texcoords = (with_texcoords == N)
            .then(|| texcoords.map(|texcoord| texcoord.value.unwrap_or_default()));
        is_sound.then_some((vertices, texcoords, material))
    }

    fn read_mesh(&mut self, opening: Word<'t>, block: Block) {
        if block == Block::StlModel {
            self.warn_synonym(opening, "`mesh`");
        }
        let primitive = self.next_primitive(opening);
        self.blocks.enter(block, opening);
        let (mut file, mut material) = (Field::default(), Field::default());
        let (mut scale, mut rotate, mut offset) =
            (Field::default(), Field::default(), Field::default());
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"file" | b"filename" => {
                    if word.bytes == b"filename" {
                        self.warn_synonym(word, "`file`");
                    }
                    let value = self.file_name(word);
                    file.set(&mut self.blocks.report, word, value);
                }
                b"material" => {
                    let value = self.material(word, "mesh");
                    material.set(&mut self.blocks.report, word, value);
                }
                b"scale" => {
                    let value =
                        self.blocks.number(word).and_then(|value| self.above_zero(word, value));
                    scale.set(&mut self.blocks.report, word, value);
                }
                b"rotate" => {
                    let value = self.blocks.numbers(word).and_then(|[x, y, z, degrees]| {
                        let axis = DVec3::new(x, y, z);
                        if axis == DVec3::ZERO {
                            self.refuse_value(|| "the axis of `rotate` must not be 0 0 0".into());
                        }
                        (axis != DVec3::ZERO).then_some((axis, degrees))
                    });
                    rotate.set(&mut self.blocks.report, word, value);
                }
                b"move" => {
                    let value = self.blocks.numbers(word).map(DVec3::from);
                    offset.set(&mut self.blocks.report, word, value);
                }
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
        let file = file.require(&mut self.blocks, opening, "file");
        let material = material.require(&mut self.blocks, opening, "material");
        if let (Some(file), Some(material)) = (file, material) {
            self.mesh_files.push(file);
            self.scene.meshes.push(Mesh {
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
}

/// The largest condition number of a parallelepiped: beyond, less than four digits of a hit
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

/// A vector of length 1 along `vector`, however long that is.
pub(super) fn direction(vector: DVec3) -> DVec3 {
    let scaled = vector / vector.abs().max_element();
    scaled / scaled.length()
}

/// The condition number (Frobenius) of three edges, each taken as long as the others: how much
/// more the inverse of a sheared box errs than that of an upright one.
fn condition(edges: [DVec3; 3]) -> f64 {
    let [a, b, c] = edges.map(direction);
    let faces = [b.cross(c), c.cross(a), a.cross(b)];
    let area: f64 = faces.iter().map(|face| face.length_squared()).sum();
    (3.0 * area).sqrt() / a.dot(faces[0]).abs()
}
