//! The check of a prepared scene when it is opened: all that its readers rely on, once.

use super::{
    layout::View,
    node::{Child, CompactNode, MOST_LEVELS, Node},
    record::{
        EmitterNode, EmitterRecord, Kind, LeafRecord, MaterialRecord, NO_NODE, PlaneIndex,
        SolidNodeKind, SolidNodeRecord, TexturedFace,
    },
    solid_tree::link_solid,
};

/// Checks everything that readers rely on; the error names what is wrong.
pub(super) fn check(view: &View<'_>) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite() && x.abs() < 1e100);
    let header = view.header;

    let camera = &header.camera;
    for vector in [camera.eye, camera.top_left, camera.right, camera.down] {
        ensure(finite(&vector), "the camera")?;
    }
    let lighting = &header.lighting;
    ensure(finite(&lighting.background) && finite(&lighting.ambient), "a colour")?;
    let is_scale = |x: f64| x.is_normal() && x > 0.0 && (1.0 / x).is_normal();
    ensure(is_scale(header.scale) && is_scale(header.frame.scale), "a scale")?;
    ensure(finite(&header.frame.origin), "the frame")?;

    let root = [(Node::ROOT, view.faces.len())];
    if view.compact_nodes.is_empty() {
        check_hierarchies(view.nodes.iter().copied(), root)?;
    } else {
        ensure(view.nodes.is_empty(), "nodes of two kinds")?;
        check_hierarchies(view.compact_nodes.iter().map(CompactNode::expand), root)?;
    }
    ensure(view.vertices.iter().all(|vertex| finite(vertex)), "a vertex")?;
    let is_finite = |vertex: &[f32; 3]| vertex.iter().all(|x| x.is_finite());
    ensure(view.single_vertices.iter().all(is_finite), "a vertex")?;
    let vertices = |indices: &[u32]| indices.iter().all(|&k| (k as usize) < view.vertex_count());
    let material = |index: u32| (index as usize) < view.materials.len();
    let plane = |index: PlaneIndex| index.index() < view.planes.len();
    for (face, item) in view.faces.iter().zip(view.all_items()) {
        let is_whole = match item.kind().ok_or("an item")? {
            Kind::Triangle => vertices(&face.vertices) && material(face.material()),
            Kind::Coplanar => vertices(&face.vertices) && face.coat() < view.coats.len(),
            Kind::Quadrangle => item.index() < view.quadrangles.len(),
            Kind::Sphere => item.index() < view.spheres.len(),
            Kind::Solid => item.index() < view.solids.len(),
        };
        ensure(is_whole, "an item")?;
    }
    for coat in view.coats {
        ensure(plane(coat.plane) && material(coat.material), "a coat")?;
    }
    for face in view.quadrangles {
        let whole = vertices(&face.vertices) && material(face.material) && plane(face.plane);
        ensure(whole, "a quadrangle")?;
    }
    for sphere in view.spheres {
        let whole = finite(&sphere.center) && finite(&[sphere.radius]) && sphere.radius > 0.0;
        ensure(whole && material(sphere.material), "a sphere")?;
    }
    for plane in view.planes {
        ensure(finite(&plane.point) && finite(&plane.normal), "a plane")?;
    }
    for record in view.materials {
        let numbers = [record.reflect, record.alpha, record.refract];
        let is_share = |x: f64| (0.0..=1.0).contains(&x);
        let whole = finite(&record.color) && finite(&numbers) && record.refract >= 0.0;
        ensure(whole && is_share(record.reflect) && is_share(record.alpha), "a material")?;
        let has_texture = (record.texture as usize) < view.textures.len();
        ensure(has_texture || record.texture == MaterialRecord::PLAIN, "a material")?;
    }
    for planes in view.box_planes {
        let numbers = [planes.points.as_flattened(), planes.normals.as_flattened()];
        let whole = numbers.into_iter().all(finite) && finite(&planes.surfaces);
        ensure(whole, "a parallelepiped")?;
    }
    for leaf in view.leaves {
        let whole = finite(&leaf.center) && finite(&[leaf.radius]) && material(leaf.material);
        let is_box = leaf.planes.iter().all(|&index| plane(index))
            && (leaf.surface as usize) < view.box_planes.len();
        let has_extent = finite(&[leaf.extent]) && leaf.extent > 0.0;
        ensure(whole && (leaf.is_sphere() || is_box) && has_extent, "a leaf")?;
    }
    for solid in view.solids {
        ensure(solid.nodes().end <= view.solid_nodes.len(), "a solid")?;
        ensure(solid.leaves().end <= view.leaves.len(), "a solid")?;
        let leaves = view.solid_leaves(solid);
        check_solid_tree(view.solid_nodes(solid), leaves).map_err(|()| "a solid's tree")?;
        let last_rank = u64::from(solid.rank) + 6 * leaves.len() as u64;
        ensure(last_rank <= Child::ITEM_LIMIT as u64, "a solid")?;
        let is_framed = is_scale(solid.frame.scale) && finite(&solid.frame.origin);
        ensure(is_framed && finite(&[solid.margin]), "a solid's frame")?;
        let is_doubt = 0.0 < solid.most_doubt && solid.most_doubt <= solid.margin / 8.0;
        ensure(is_doubt, "a solid's margin")?;
    }
    let roots = view.solids.iter().map(|solid| (solid.first_box as usize, solid.leaves().len()));
    check_hierarchies(view.solid_boxes.iter().copied(), roots)?;
    for light in view.lights {
        let is_finite = light.intensity.iter().all(|channel| channel.is_finite());
        ensure(finite(&light.position) && is_finite, "a light")?;
        let end = light.coincident_first as usize + light.coincident_count as usize;
        ensure(end <= view.coincident.len(), "a light")?;
    }
    check_textures(view)?;
    check_emitters(view)
}

/// Checks that nodes are trees with these roots, whose leaves name items below a number.
fn check_hierarchies(
    nodes: impl ExactSizeIterator<Item = Node>,
    roots: impl IntoIterator<Item = (usize, usize)>,
) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let mut known = vec![(0_u8, 0); nodes.len()];
    for (root, limit) in roots {
        let known = known.get_mut(root).ok_or("no root")?;
        ensure(known.0 == 0, "two roots in one place")?;
        *known = (1, limit);
    }
    for (index, node) in nodes.enumerate() {
        let (level, limit) = known[index];
        ensure(level > 0, "a node without a parent")?;
        ensure(node.planes.as_flattened().iter().all(|x| !x.is_nan()), "a box")?;
        for (k, &child) in node.children.iter().enumerate() {
            if child == Child::NONE {
                // Its box is what keeps rays from going there, to the root again.
                let is_empty = |side: usize| node.planes[side][k] == Node::EMPTY.planes[side][k];
                ensure((0..6).all(is_empty), "a box")?;
                continue;
            }
            if child.is_leaf() {
                ensure(child.items().end <= limit, "a leaf")?;
                continue;
            }
            let child_known = known.get_mut(child.node()).ok_or("a child")?;
            // One parent each, standing before it: no loops, and no node is visited twice.
            ensure(child_known.0 == 0 && child.node() > index, "a child")?;
            ensure(usize::from(level) < MOST_LEVELS, "too many levels")?;
            *child_known = (level + 1, limit);
        }
    }
    Ok(())
}

/// Checks what readers of textures rely on.
fn check_textures(view: &View<'_>) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite() && x.abs() < 1e100);
    let is_sorted = view.textured_faces.is_sorted_by(|a, b| a.rank < b.rank);
    ensure(is_sorted, "the textured faces' order")?;
    let texcoords = |face: &TexturedFace| finite(face.texcoords.0.as_flattened());
    ensure(view.textured_faces.iter().all(texcoords), "a texture coordinate")?;
    for texture in view.textures {
        let levels = view.texture_levels.get(texture.levels()).ok_or("a texture")?;
        let (finest, coarser) = levels.split_first().ok_or("a texture")?;
        ensure(finest.lies_within(view.fine_texels.len()), "a texture")?;
        let are_within = coarser.iter().all(|level| level.lies_within(view.coarse_texels.len()));
        ensure(are_within, "a texture's level")?;
    }
    let texels = view.coarse_texels.as_flattened();
    ensure(texels.iter().all(|channel| (0.0..=1.0).contains(channel)), "a texel")
}

/// Checks what those rely on who aim at emitters.
fn check_emitters(view: &View<'_>) -> Result<(), &'static str> {
    let ensure = |holds: bool, what: &'static str| if holds { Ok(()) } else { Err(what) };
    let finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite() && x.abs() < 1e100);
    let vertices = |emitter: &EmitterRecord| {
        emitter.vertices.iter().all(|&k| (k as usize) < view.vertex_count()) || emitter.is_sphere()
    };
    for emitter in view.emitters {
        let is_place = finite(&emitter.middle) && finite(&emitter.vector_area);
        let is_shape = is_place && finite(&[emitter.size]) && emitter.size > 0.0;
        let is_known = emitter.shape <= EmitterRecord::SPHERE && vertices(emitter);
        ensure((emitter.by_size as usize) < view.emitters.len(), "an emitter")?;
        let is_light = emitter.radiosity.iter().all(|&x| (0.0..=1e100).contains(&x));
        ensure(is_shape && is_known && is_light, "an emitter")?;
    }
    ensure(view.emitters.is_sorted_by(|a, b| a.rank < b.rank), "the emitters' order")?;
    for node in view.emitter_nodes {
        let numbers = [node.radius, node.fill, node.radiosity];
        let is_ball = finite(&node.center) && numbers.iter().all(|&x| (0.0..=1e100).contains(&x));
        ensure(is_ball, "a node of emitters")?;
    }
    check_emitter_tree(view.emitter_nodes, view.emitters).map_err(|()| "the tree of emitters")
}

/// Checks that nodes are a tree over these leaves in postfix order and linked as they should be, so
/// that walking it ends.
fn check_solid_tree(nodes: &[SolidNodeRecord], leaves: &[LeafRecord]) -> Result<(), ()> {
    let ensure = |holds: bool| if holds { Ok(()) } else { Err(()) };
    let links = link_solid(nodes.iter().map(|node| (node.kind, node.operands))).ok_or(())?;
    ensure(links == nodes)?;
    let mut leaves = leaves.iter();
    for (index, node) in (0..).zip(nodes) {
        if node.kind == SolidNodeKind::LEAF {
            ensure(leaves.next().ok_or(())?.node == index)?;
        }
    }
    ensure(leaves.next().is_none())
}

/// Checks that nodes are a tree over the emitters, parents first: every walk up or down ends.
fn check_emitter_tree(nodes: &[EmitterNode], emitters: &[EmitterRecord]) -> Result<(), ()> {
    let ensure = |holds: bool| if holds { Ok(()) } else { Err(()) };
    ensure(nodes.len() == (2 * emitters.len()).saturating_sub(1))?;
    let mut parents = vec![NO_NODE; nodes.len()];
    for (index, node) in (0..).zip(nodes) {
        ensure(node.parent == parents[index as usize])?;
        ensure((node.parent == NO_NODE) == (index == 0))?;
        if node.is_leaf() {
            let emitter = emitters.get(node.emitter as usize).ok_or(())?;
            ensure(emitter.node == index)?;
            continue;
        }
        ensure(node.child > index && (node.child as usize) < nodes.len() - 1)?;
        for child in [node.child, node.child + 1] {
            let parent = &mut parents[child as usize];
            ensure(*parent == NO_NODE)?;
            *parent = index;
        }
    }
    // As many leaves as emitters, each its own emitter's.
    ensure(emitters.iter().all(|emitter| (emitter.node as usize) < nodes.len()))
}
