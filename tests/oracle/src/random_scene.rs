//! Random scenes, and rays that go where it hurts.

use glam::{DVec2, DVec3};
use rtfarm_core::scene::{
    Light, Material, Operation, Parallelepiped, Quadrangle, Scene, Solid, SolidNode, Sphere,
    Triangle, Viewport,
};

use crate::random::Random;

/// What a random scene is made of.
#[derive(Debug, Clone, Copy)]
pub struct Recipe {
    /// How many of them.
    pub spheres: u32,
    /// How many of them.
    pub triangles: u32,
    /// How many of them, a third concave.
    pub quadrangles: u32,
    /// How many of them.
    pub parallelepipeds: u32,
    /// How many of them.
    pub solids: u32,
    /// Point lights; with none the scene is flat.
    pub lights: u32,
    /// How numbers are drawn.
    pub style: Style,
    /// Whether some surfaces mirror, bend or let light through.
    pub clear: bool,
}

/// How the numbers of a random scene are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// Anything in a cube of side 2, sizes like 1.
    Plain,
    /// Multiples of 1/4: shared corners, coincident faces, rays that meet edges exactly.
    Grid,
    /// Sizes from 1e-6 to 1e6, slivers and needles.
    Extreme,
    /// As plain, but all about a million away from the origin, the eye too.
    Far,
}

impl Recipe {
    /// A few of everything but solids, opaque, under two lights.
    pub fn new(style: Style) -> Self {
        Self {
            spheres: 4,
            triangles: 6,
            quadrangles: 4,
            parallelepipeds: 2,
            solids: 0,
            lights: 2,
            style,
            clear: false,
        }
    }
}

/// The scene of a seed. It has a viewport that looks at most of it.
pub fn random_scene(seed: u64, recipe: &Recipe) -> Scene {
    let mut maker = Maker { random: Random::new(seed), style: recipe.style, primitives: 0 };
    let mut scene = Scene {
        materials: (0..6).map(|k| maker.material(k, recipe.clear)).collect(),
        background: DVec3::new(0.1, 0.2, 0.3),
        ambient: maker.random.chance(0.5).then_some(DVec3::splat(0.125)),
        ..Scene::default()
    };
    scene.lights = (0..recipe.lights).map(|_| maker.light()).collect();
    scene.spheres = (0..recipe.spheres).map(|_| maker.sphere()).collect();
    scene.triangles = (0..recipe.triangles).map(|_| maker.triangle()).collect();
    scene.quadrangles = (0..recipe.quadrangles).map(|_| maker.quadrangle()).collect();
    scene.parallelepipeds = (0..recipe.parallelepipeds).map(|_| maker.parallelepiped()).collect();
    scene.solids = (0..recipe.solids).map(|_| maker.solid()).collect();
    scene.viewport = Some(maker.viewport());
    scene
}

/// Draws the parts of a scene.
struct Maker {
    random: Random,
    style: Style,
    primitives: u32,
}

impl Maker {
    /// Where a shape stands.
    fn place(&mut self) -> DVec3 {
        let place = self.random.in_cube();
        match self.style {
            Style::Plain => place,
            Style::Grid => snap(place),
            Style::Extreme => place * self.random.log_uniform(1e-2, 1e2),
            Style::Far => place + FAR,
        }
    }

    /// From there to a corner.
    fn step(&mut self) -> DVec3 {
        match self.style {
            Style::Grid => loop {
                let step = snap(self.random.in_cube());
                // Axis-parallel steps make faces coincide.
                let axis = self.random.below(3);
                let step = if self.random.chance(0.7) { only(step, axis) } else { step };
                if step != DVec3::ZERO {
                    return step;
                }
            },
            Style::Extreme => self.random.direction() * self.random.log_uniform(1e-6, 1e6),
            Style::Plain | Style::Far => self.random.direction() * self.random.between(0.2, 1.0),
        }
    }

    fn primitive(&mut self) -> u32 {
        self.primitives += 1;
        self.primitives - 1
    }

    fn material_index(&mut self) -> u32 {
        self.random.below(6) as u32
    }

    fn material(&mut self, index: u32, clear: bool) -> Material {
        let is_clear = clear && self.random.chance(0.5);
        let some = |random: &mut Random| random.below(5) as f64 / 4.0;
        Material {
            name: format!("m{index}"),
            color: (self.random.in_cube() + 1.0) / 2.0,
            alpha: if is_clear { some(&mut self.random) } else { 1.0 },
            reflect: if clear { some(&mut self.random) * 0.75 } else { 0.0 },
            refract: if is_clear { self.random.between(0.5, 2.0) } else { 0.0 },
            texture: None,
        }
    }

    fn light(&mut self) -> Light {
        let position = self.place() + 2.0 * self.random.in_cube();
        let position = if self.style == Style::Grid { snap(position) } else { position };
        Light { position, intensity: DVec3::splat(self.random.between(0.5, 2.0)) }
    }

    fn sphere(&mut self) -> Sphere {
        let radius = self.step().length();
        let radius = if self.style == Style::Grid { (radius * 4.0).ceil() / 4.0 } else { radius };
        Sphere {
            center: self.place(),
            radius,
            material: self.material_index(),
            primitive: self.primitive(),
        }
    }

    fn triangle(&mut self) -> Triangle {
        let vertices = loop {
            let (corner, u, v) = (self.place(), self.step(), self.step());
            let vertices = [corner, corner + u, corner + v];
            let edges = [vertices[1] - vertices[0], vertices[2] - vertices[0]];
            if edges[0].cross(edges[1]) != DVec3::ZERO {
                break vertices;
            }
        };
        Triangle { vertices, material: self.material_index(), primitive: self.primitive() }
    }

    fn quadrangle(&mut self) -> Quadrangle {
        let (corner, u, v) = loop {
            let (corner, u, v) = (self.place(), self.step(), self.step());
            if u.cross(v).length() > 1e-3 * u.length() * v.length() {
                break (corner, u, v);
            }
        };
        let vertices = self.simple_outline().map(|point| corner + point.x * u + point.y * v);
        Quadrangle { vertices, material: self.material_index(), primitive: self.primitive() }
    }

    /// Four corners of a simple quadrangle, counter-clockwise, in units of 1/4.
    fn simple_outline(&mut self) -> [DVec2; 4] {
        loop {
            let mut corners = [DVec2::ZERO; 4];
            for corner in &mut corners {
                let coordinate = |random: &mut Random| random.below(9) as f64 / 4.0 - 1.0;
                *corner = DVec2::new(coordinate(&mut self.random), coordinate(&mut self.random));
            }
            if is_simple(&corners) {
                return corners;
            }
        }
    }

    fn parallelepiped(&mut self) -> Parallelepiped {
        let edges = loop {
            let edges = [self.step(), self.step(), self.step()];
            let volume = edges[0].dot(edges[1].cross(edges[2])).abs();
            let lengths = edges[0].length() * edges[1].length() * edges[2].length();
            if volume > 1e-3 * lengths {
                break edges;
            }
        };
        Parallelepiped {
            corner: self.place(),
            edges,
            material: self.material_index(),
            primitive: self.primitive(),
        }
    }

    /// A tree of two to six leaves whose operations join two or three operands.
    fn solid(&mut self) -> Solid {
        let (primitive, center) = (self.primitive(), self.place());
        let mut nodes = Vec::new();
        let (mut leaves, mut ready) = (0, 0);
        while ready < 2 || leaves < 6 && self.random.chance(0.6) {
            if ready >= 2 && self.random.chance(0.4) {
                ready -= self.join(&mut nodes, ready) - 1;
            } else {
                nodes.push(self.leaf(leaves, center));
                (leaves, ready) = (leaves + 1, ready + 1);
            }
        }
        while ready > 1 {
            ready -= self.join(&mut nodes, ready) - 1;
        }
        Solid { nodes, primitive }
    }

    /// A leaf whose middle is near `center`, so that leaves overlap.
    fn leaf(&mut self, index: u32, center: DVec3) -> SolidNode {
        let nudge = self.random.in_cube() * 0.5;
        let center = center + if self.style == Style::Grid { snap(nudge) } else { nudge };
        // Leaves have numbers of their own.
        let primitives = self.primitives;
        let leaf = if self.random.chance(0.5) {
            SolidNode::Sphere(Sphere { center, primitive: index, ..self.sphere() })
        } else {
            let solid = self.parallelepiped();
            let corner = center - solid.edges.iter().sum::<DVec3>() / 2.0;
            SolidNode::Parallelepiped(Parallelepiped { corner, primitive: index, ..solid })
        };
        self.primitives = primitives;
        leaf
    }

    /// Adds an operation and tells how many of the `ready` results it takes.
    fn join(&mut self, nodes: &mut Vec<SolidNode>, ready: u32) -> u32 {
        let operands = if ready > 2 && self.random.chance(0.3) { 3 } else { 2 };
        let operations = [Operation::Union, Operation::Intersection, Operation::Difference];
        nodes.push(SolidNode::Operation { operation: operations[self.random.below(3)], operands });
        operands
    }

    fn viewport(&mut self) -> Viewport {
        let center = if self.style == Style::Far { FAR } else { DVec3::ZERO };
        let away = self.random.direction();
        let right = away.any_orthonormal_vector();
        let up = right.cross(away);
        let top_left = center + 2.0 * away - right + up;
        Viewport {
            eye: center + 5.0 * away,
            top_left,
            bottom_left: top_left - 2.0 * up,
            top_right: top_left + 2.0 * right,
        }
    }
}

/// Where [`Style::Far`] is.
const FAR: DVec3 = DVec3::new(1e6, -2e6, 3e5);

/// To multiples of 1/4.
fn snap(point: DVec3) -> DVec3 {
    (point * 4.0).round() / 4.0
}

fn only(vector: DVec3, axis: usize) -> DVec3 {
    let mut kept = DVec3::ZERO;
    kept[axis] = vector[axis];
    kept
}

/// Whether corners on a small grid, where all is exact, make a simple counter-clockwise outline
/// without repeated corners. Three in a line are fine.
fn is_simple(corners: &[DVec2; 4]) -> bool {
    let area =
        |a: usize, b: usize, c: usize| (corners[b] - corners[a]).perp_dot(corners[c] - corners[a]);
    let between = |p: usize, a: usize, b: usize| {
        area(a, b, p) == 0.0 && (corners[a] - corners[p]).dot(corners[b] - corners[p]) <= 0.0
    };
    let crosses = |a: usize, b: usize, c: usize, d: usize| {
        let proper = area(a, b, c) * area(a, b, d) < 0.0 && area(c, d, a) * area(c, d, b) < 0.0;
        proper || between(c, a, b) || between(d, a, b) || between(a, c, d) || between(b, c, d)
    };
    // Neighbouring edges share a corner and must not fold back; opposite ones must not meet.
    let folds = (0..4).any(|k| {
        let (a, b, c) = (k, (k + 1) % 4, (k + 2) % 4);
        between(a, b, c) || between(c, a, b)
    });
    !folds && !crosses(0, 1, 2, 3) && !crosses(1, 2, 3, 0) && area(0, 1, 2) + area(0, 2, 3) > 0.0
}

/// Where a random ray aims.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Aim {
    /// Anywhere near a shape.
    Somewhere,
    /// At a point of a shape.
    Surface,
    /// At a point of an edge, or of a sphere's outline.
    Edge,
    /// At a corner; spheres: at a point of the outline.
    Corner,
    /// Along a face, in its plane if the numbers allow it; spheres: at the outline.
    Grazing,
}

impl Aim {
    /// All of them.
    pub const ALL: [Self; 5] =
        [Self::Somewhere, Self::Surface, Self::Edge, Self::Corner, Self::Grazing];
}

/// A ray: its origin and its direction, of any length, never zero.
pub fn random_ray(scene: &Scene, aim: Aim, random: &mut Random) -> (DVec3, DVec3) {
    let outlines = outlines(scene);
    let spheres = spheres(scene);
    assert!(!outlines.is_empty() || !spheres.is_empty(), "there must be something to aim at");
    let choice = random.below(outlines.len() + spheres.len());
    let target;
    let mut origin;
    if let Some(corners) = outlines.get(choice) {
        let size = (corners[1] - corners[0]).length();
        let k = random.below(corners.len());
        let (corner, next) = (corners[k], corners[(k + 1) % corners.len()]);
        let previous = corners[(k + corners.len() - 1) % corners.len()];
        let quarters = random.below(5) as f64 / 4.0;
        target = match aim {
            Aim::Somewhere => corner + size * random.in_cube(),
            Aim::Surface => {
                let (u, v) = (random.unit(), random.unit());
                corner + (next - corner) * u + (previous - corner) * v * (1.0 - u)
            }
            Aim::Edge => corner + (next - corner) * quarters,
            Aim::Corner | Aim::Grazing => corner,
        };
        origin = some_origin(scene, target, size, random);
        if aim == Aim::Grazing {
            let along = (next - corner) * quarters + (previous - corner);
            origin = target + along * if random.chance(0.5) { 2.0 } else { -2.0 };
        }
    } else {
        let (center, radius) = spheres[choice - outlines.len()];
        origin = some_origin(scene, center, radius, random);
        let direction = random.direction();
        target = match aim {
            Aim::Somewhere => center + 2.0 * radius * random.in_cube(),
            Aim::Surface => center + radius * direction,
            Aim::Edge | Aim::Corner | Aim::Grazing => outline_point(center, radius, origin, random),
        };
    }
    let direction = target - origin;
    if direction == DVec3::ZERO { (origin, DVec3::X) } else { (origin, direction) }
}

/// The eye, or somewhere around the target; on a grid for scenes on a grid.
fn some_origin(scene: &Scene, target: DVec3, size: f64, random: &mut Random) -> DVec3 {
    let viewport = scene.viewport.filter(|_| random.chance(0.3));
    let near = target + random.direction() * size * random.log_uniform(0.1, 100.0);
    let is_on_grid = snap(target) == target;
    viewport.map_or(if is_on_grid { snap(near) } else { near }, |viewport| viewport.eye)
}

/// A point where a ray from `origin`, if it is outside, touches the sphere.
fn outline_point(center: DVec3, radius: f64, origin: DVec3, random: &mut Random) -> DVec3 {
    let to_origin = origin - center;
    let distance = to_origin.length();
    if distance <= radius {
        return center + radius * random.direction();
    }
    let axis = to_origin / distance;
    let sideways = axis.any_orthonormal_vector();
    let (u, v) = loop {
        let point = DVec2::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0));
        if (0.01..1.0).contains(&point.length_squared()) {
            break point.normalize().into();
        }
    };
    let around = sideways * u + axis.cross(sideways) * v;
    let sine = radius / distance;
    center + radius * (axis * sine + around * ((1.0 - sine) * (1.0 + sine)).sqrt())
}

/// The outlines of all flat faces.
fn outlines(scene: &Scene) -> Vec<Vec<DVec3>> {
    let mut outlines: Vec<Vec<DVec3>> =
        scene.triangles.iter().map(|triangle| triangle.vertices.to_vec()).collect();
    outlines.extend(scene.quadrangles.iter().map(|quadrangle| quadrangle.vertices.to_vec()));
    let boxes = scene.solids.iter().flat_map(|solid| &solid.nodes).filter_map(|node| match node {
        SolidNode::Parallelepiped(solid) => Some(solid),
        _ => None,
    });
    for solid in scene.parallelepipeds.iter().chain(boxes) {
        for k in 0..3 {
            let (e, f) = (solid.edges[(k + 1) % 3], solid.edges[(k + 2) % 3]);
            for corner in [solid.corner, solid.corner + solid.edges[k]] {
                outlines.push(vec![corner, corner + e, corner + e + f, corner + f]);
            }
        }
    }
    outlines
}

/// Centres and radii of all spheres.
fn spheres(scene: &Scene) -> Vec<(DVec3, f64)> {
    let leaves = scene.solids.iter().flat_map(|solid| &solid.nodes).filter_map(|node| match node {
        SolidNode::Sphere(sphere) => Some(sphere),
        _ => None,
    });
    scene.spheres.iter().chain(leaves).map(|sphere| (sphere.center, sphere.radius)).collect()
}
