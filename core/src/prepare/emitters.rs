//! Faces that send light on, and about how much each does.

use glam::{DVec2, DVec3};

use super::{
    emitter_tree::{EmitterBounds, EmitterTree},
    sort::Sorted,
};
use crate::{
    exact::clip::clip,
    prepared::{
        face::Part,
        record::{EmitterNode, EmitterRecord, LightRecord, MaterialRecord},
    },
};

/// At most so many lights are asked about one face; of more, every second, third and so on stands
/// for those between.
const MOST_LIGHTS: usize = 256;

/// The faces that send light on, by their ranks, and the tree over them.
#[derive(Default)]
pub(super) struct Emitters {
    pub(super) records: Vec<EmitterRecord>,
    pub(super) nodes: Vec<EmitterNode>,
}

impl Emitters {
    /// Finds all faces that send light on, which they have from `lights` and from all around. Those
    /// of solids may need vertices that no other face has.
    pub(super) fn find(
        faces: &mut Sorted,
        materials: &[MaterialRecord],
        lights: &[LightRecord],
        ambient: DVec3,
    ) -> Self {
        if !materials.iter().any(MaterialRecord::emits) {
            return Self::default();
        }
        let mut search = Search { materials, lights, ambient, found: Vec::new() };
        for face in &faces.faces {
            if let Some((_, material)) = faces.plane_and_material(face) {
                search.add_polygon((material, face.rank()), &face.vertices, &faces.vertices);
            }
        }
        for face in &faces.quadrangles {
            search.add_polygon((face.material, face.rank), &face.vertices, &faces.vertices);
        }
        for sphere in &faces.spheres {
            search.add_sphere((sphere.material, sphere.rank), sphere.center, sphere.radius);
        }
        let mut box_corners = faces.box_corners.chunks(4);
        for (solid, &bounds) in faces.solids_in_file_order.iter().zip(&faces.solid_bounds) {
            for (number, leaf) in (0..).zip(&faces.leaves[solid.leaves()]) {
                let rank = |face: u32| Part::new(number, face).rank(solid);
                if leaf.is_sphere() {
                    let (center, radius) =
                        smaller_sphere(DVec3::from_array(leaf.center), leaf.radius, bounds);
                    search.add_sphere((leaf.material, rank(0)), center.to_array(), radius);
                    continue;
                }
                for (face, corners) in (0..).zip(box_corners.by_ref().take(6)) {
                    if !search.is_emitter(leaf.material) {
                        continue;
                    }
                    // The solid has nothing of the others.
                    let Some(corners) = part_within(corners, bounds) else { continue };
                    let first = faces.vertices.len() as u32;
                    faces.vertices.extend(corners.iter().map(DVec3::to_array));
                    let vertices = [first, first + 1, first + 2, first + 3];
                    search.add_polygon((leaf.material, rank(face)), &vertices, &faces.vertices);
                }
            }
        }
        search.finish()
    }
}

/// The search for faces that send light on: it is given all faces, in any order.
struct Search<'a> {
    materials: &'a [MaterialRecord],
    lights: &'a [LightRecord],
    ambient: DVec3,
    found: Vec<(Emitter, EmitterBounds)>,
}

/// The part of an emitter's record that is known before all of them are found; its centre is that
/// of its bounds.
struct Emitter {
    vector_area: DVec3,
    size: f64,
    radiosity: [f64; 2],
    vertices: [u32; 4],
    rank: u32,
    shape: u32,
}

impl<'a> Search<'a> {
    /// Whether faces of a material send light on.
    fn is_emitter(&self, material: u32) -> bool {
        self.materials[material as usize].emits()
    }

    /// Adds a triangle or a simple quadrangle, if it sends light on.
    fn add_polygon(
        &mut self,
        (material, rank): (u32, u32),
        vertices: &[u32],
        all_vertices: &[[f64; 3]],
    ) {
        if !self.is_emitter(material) {
            return;
        }
        let mut vertices: [u32; 4] = std::array::from_fn(|k| vertices[k.min(vertices.len() - 1)]);
        let mut corners = vertices.map(|vertex| DVec3::from_array(all_vertices[vertex as usize]));
        let vector_area = 0.5 * (corners[2] - corners[0]).cross(corners[3] - corners[1]);
        let area = vector_area.length();
        if area == 0.0 {
            return; // Below what numbers hold: nothing can be aimed at it.
        }
        // The diagonal between the first and the third corner is to be the one inside.
        let [b, c, d] = [1, 2, 3].map(|k| corners[k] - corners[0]);
        if b.cross(c).dot(vector_area) < 0.0 || c.cross(d).dot(vector_area) < 0.0 {
            vertices.rotate_left(1);
            corners.rotate_left(1);
        }
        let is_triangle = vertices[2] == vertices[3];
        let outline = &corners[..if is_triangle { 3 } else { 4 }];
        let middle = outline.iter().sum::<DVec3>() / outline.len() as f64;
        let mut received = [DVec3::ZERO; 2];
        for (light, times) in self.some_lights() {
            let position = DVec3::from_array(light.position);
            for &corner in outline {
                let to_light = position - (middle + 0.8 * (corner - middle));
                let height = vector_area.dot(to_light) / area;
                let distance = to_light.length();
                if distance > 0.0 {
                    let share = height.abs() / (distance * distance * distance);
                    received[usize::from(height < 0.0)] +=
                        DVec3::from_array(light.intensity) * (share * times / outline.len() as f64);
                }
            }
        }
        let reach = |&corner: &DVec3| (corner - middle).length();
        let radius = outline.iter().map(reach).fold(0.0, f64::max);
        let emitter = Emitter {
            vector_area,
            size: area,
            radiosity: received.map(|light| self.radiosity(material, light)),
            vertices,
            rank,
            shape: if is_triangle { EmitterRecord::TRIANGLE } else { EmitterRecord::QUADRANGLE },
        };
        self.add(emitter, middle, radius, area);
    }

    /// Adds a sphere, if it sends light on. Only its outside is aimed at.
    fn add_sphere(&mut self, (material, rank): (u32, u32), center: [f64; 3], radius: f64) {
        if !self.is_emitter(material) {
            return;
        }
        let center = DVec3::from_array(center);
        let mut received = DVec3::ZERO;
        for (light, times) in self.some_lights() {
            let distance = (DVec3::from_array(light.position) - center).length();
            if distance > radius {
                // What falls on it, spread over its surface.
                let sine = radius / distance;
                let cosine = ((1.0 - sine) * (1.0 + sine)).sqrt();
                let share = 0.5 / (distance * distance * (1.0 + cosine));
                received += DVec3::from_array(light.intensity) * (share * times);
            } else {
                // Seen from outside through it, or where a solid has no such face.
                received += DVec3::from_array(light.intensity) * (times / (radius * radius));
            }
        }
        let emitter = Emitter {
            vector_area: DVec3::ZERO,
            size: radius,
            radiosity: [self.radiosity(material, received); 2],
            vertices: [0; 4],
            rank,
            shape: EmitterRecord::SPHERE,
        };
        let area = 4.0 * std::f64::consts::PI * (radius * radius);
        self.add(emitter, center, radius, area);
    }

    fn add(&mut self, emitter: Emitter, center: DVec3, radius: f64, area: f64) {
        let [front, back] = emitter.radiosity;
        let power = area * front.max(back);
        self.found.push((emitter, EmitterBounds { center, radius, area, power }));
    }

    /// Sorts what was found, builds the tree and makes the records.
    fn finish(mut self) -> Emitters {
        self.found.sort_unstable_by_key(|(emitter, _)| emitter.rank);
        let (emitters, bounds): (Vec<_>, Vec<_>) = self.found.into_iter().unzip();
        let mut by_size: Vec<u32> = (0..bounds.len() as u32).collect();
        by_size.sort_by(|&a, &b| bounds[b as usize].area.total_cmp(&bounds[a as usize].area));
        let EmitterTree { nodes, leaves } = EmitterTree::new(&bounds);
        let records = (emitters.into_iter().zip(bounds).zip(leaves).zip(by_size))
            .map(|(((emitter, bounds), node), by_size)| EmitterRecord {
                middle: bounds.center.to_array(),
                vector_area: emitter.vector_area.to_array(),
                size: emitter.size,
                radiosity: emitter.radiosity,
                vertices: emitter.vertices,
                rank: emitter.rank,
                shape: emitter.shape,
                node,
                by_size,
            })
            .collect();
        Emitters { records, nodes }
    }

    /// Lights that stand for all others, and for how many each of them stands.
    fn some_lights(&self) -> impl Iterator<Item = (&'a LightRecord, f64)> {
        let step = self.lights.len().div_ceil(MOST_LIGHTS).max(1);
        self.lights.iter().step_by(step).map(move |light| (light, step as f64))
    }

    /// The light that a face sends on in its brightest channel where it receives `light` from the
    /// lights.
    fn radiosity(&self, material: u32, light: DVec3) -> f64 {
        let material = &self.materials[material as usize];
        let sent = DVec3::from_array(material.color) * (self.ambient + light);
        (material.reflect * material.alpha * sent.max_element()).min(1e100)
    }
}

/// The smaller of a sphere and the one around `bounds`: a solid's face on the sphere lies in both.
fn smaller_sphere(center: DVec3, radius: f64, (min, max): (DVec3, DVec3)) -> (DVec3, f64) {
    let around = (max - min).length() / 2.0;
    if around > 0.0 && around < radius {
        (min + (max - min) / 2.0, around)
    } else {
        (center, radius)
    }
}

/// The part of a parallelogram, cut along its sides, that holds what lies within `bounds`; `None`
/// where nothing does.
fn part_within(corners: &[DVec3], (min, max): (DVec3, DVec3)) -> Option<[DVec3; 4]> {
    let (start, right, up) = (corners[0], corners[1] - corners[0], corners[3] - corners[0]);
    // What lies on a bound is within it, whatever the rounding.
    let slack = 1e-9 * max.abs().max(min.abs()).max_element();
    let (min, max) = (min - slack, max + slack);
    // Places as shares of the two sides.
    let mut outline = vec![DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y];
    let mut room = Vec::new();
    for axis in 0..3 {
        for (bound, sign) in [(min[axis], 1.0), (max[axis], -1.0)] {
            let height =
                |at: DVec2| sign * (start[axis] + at.x * right[axis] + at.y * up[axis] - bound);
            clip(&mut outline, &mut room, height, |p, q, share| p + (q - p) * share);
        }
    }
    let none = (DVec2::ONE, DVec2::ZERO);
    let (low, high) = outline.iter().fold(none, |(low, high), &at| (low.min(at), high.max(at)));
    let (low, high) = ((low - 1e-9).max(DVec2::ZERO), (high + 1e-9).min(DVec2::ONE));
    low.cmplt(high).all().then(|| {
        [(low.x, low.y), (high.x, low.y), (high.x, high.y), (low.x, high.y)]
            .map(|(x, y)| start + x * right + y * up)
    })
}
