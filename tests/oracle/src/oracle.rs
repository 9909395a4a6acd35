//! What a ray meets.

use std::collections::HashMap;

use glam::DVec3;
use rtfarm_core::scene::{Parallelepiped, Scene};

use crate::{
    ball::Ball,
    dyadic::Dyadic,
    face::{Crossing, Face, FaceId, Leaving, Shape},
    mesh::mesh_triangles,
    polygon::Polygon,
    ray::Ray,
    solid::SolidFaces,
    vector::Vector,
};

/// A scene, ready to be asked.
#[derive(Debug)]
pub struct Oracle {
    pub(crate) scene: Scene,
    /// Those of the solids last.
    pub(crate) faces: Vec<Face>,
    solids: Vec<SolidFaces>,
    index_of: HashMap<FaceId, usize>,
}

/// The point where a ray crosses a face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// How far, in units of the direction's length; correctly rounded but for ties within 2^-60.
    pub t: f64,
    /// Which face.
    pub id: FaceId,
    /// origin + t · direction, each coordinate as well rounded as `t`.
    pub point: DVec3,
    /// The unit normal at the point, on the side that the ray comes from.
    pub normal: DVec3,
    /// Whether that side is the front.
    pub front: bool,
    /// An index in the scene's materials.
    pub material: u32,
    /// How little would change the answer; see [`Oracle::miss_margin`].
    pub margin: f64,
}

impl Oracle {
    /// Makes a scene ready.
    pub fn new(scene: &Scene) -> Self {
        let mut faces = Vec::new();
        for &sphere in &scene.spheres {
            faces.push(Face {
                shape: Shape::Ball(Ball::new(sphere)),
                id: FaceId { primitive: sphere.primitive, face: 0 },
                material: sphere.material,
            });
        }
        for triangle in &scene.triangles {
            faces.push(Face {
                shape: Shape::Polygon(Polygon::planar(exact_corners(&triangle.vertices))),
                id: FaceId { primitive: triangle.primitive, face: 0 },
                material: triangle.material,
            });
        }
        for quadrangle in &scene.quadrangles {
            let corners = exact_corners(&quadrangle.vertices);
            faces.push(Face {
                shape: Shape::Polygon(Polygon::nearly_planar(corners)),
                id: FaceId { primitive: quadrangle.primitive, face: 0 },
                material: quadrangle.material,
            });
        }
        for solid in &scene.parallelepipeds {
            faces.extend(parallelepiped_faces(solid, solid.primitive, 0));
        }
        for mesh in &scene.meshes {
            for (index, corners) in (0..).zip(mesh_triangles(mesh)) {
                let corners = exact_corners(&corners);
                // Rounding may have made it a line, which no ray crosses.
                if Polygon::has_area(&corners) {
                    faces.push(Face {
                        shape: Shape::Polygon(Polygon::planar(corners)),
                        id: FaceId { primitive: mesh.primitive, face: index },
                        material: mesh.material,
                    });
                }
            }
        }
        let solids: Vec<_> =
            scene.solids.iter().map(|solid| SolidFaces::new(solid, &mut faces)).collect();
        let index_of = faces.iter().enumerate().map(|(k, face)| (face.id, k)).collect();
        Self { scene: scene.clone(), faces, solids, index_of }
    }

    /// The first face that a ray crosses: the smallest (t, primitive, face) with t > 0.
    pub fn first_hit(
        &self,
        origin: DVec3,
        direction: DVec3,
        leaving: Option<Leaving>,
    ) -> Option<Hit> {
        let ray = Ray::along(origin, direction);
        let crossing = self.first_crossing(&ray, leaving)?;
        let margin = self.margin(&ray, leaving, Some(&crossing));
        Some(Hit { margin, ..hit(&ray, &crossing) })
    }

    /// Every face that a ray crosses, by (t, primitive, face).
    pub fn all_hits(&self, origin: DVec3, direction: DVec3, leaving: Option<Leaving>) -> Vec<Hit> {
        let ray = Ray::along(origin, direction);
        let mut crossings: Vec<_> = self.crossings(&ray, leaving).collect();
        crossings.sort_by(|a, b| a.compare(b, &ray));
        let margin = self.margin(&ray, leaving, None);
        crossings.iter().map(|crossing| Hit { margin, ..hit(&ray, crossing) }).collect()
    }

    pub(crate) fn first_crossing(
        &self,
        ray: &Ray,
        leaving: Option<Leaving>,
    ) -> Option<Crossing<'_>> {
        self.crossings(ray, leaving).min_by(|a, b| a.compare(b, ray))
    }

    /// All crossings ahead of a ray, in no order.
    pub(crate) fn crossings(
        &self,
        ray: &Ray,
        leaving: Option<Leaving>,
    ) -> impl Iterator<Item = Crossing<'_>> {
        let left = self.left(leaving);
        let plain_count = self.solids.first().map_or(self.faces.len(), |solid| solid.faces.start);
        let plain = self.faces[..plain_count].iter().flat_map(move |face| face.cross(ray, left));
        let solids = self.solids.iter().flat_map(move |solid| solid.cross(&self.faces, ray, left));
        plain.chain(solids).filter(move |crossing| crossing.is_ahead(ray, leaving))
    }

    /// The face that a ray leaves.
    pub(crate) fn left(&self, leaving: Option<Leaving>) -> Option<&Face> {
        leaving.map(|leaving| &self.faces[self.index_of[&leaving.id]])
    }
}

/// A crossing in numbers, without its margin.
pub(crate) fn hit(ray: &Ray, crossing: &Crossing<'_>) -> Hit {
    let t = crossing.root(ray).to_dyadic();
    let point = ray.at(&t);
    let normal = crossing.face.unit_normal(&point);
    Hit {
        t: t.to_f64(),
        id: crossing.face.id,
        point: point.to_dvec3(),
        normal: if crossing.front { normal } else { -normal },
        front: crossing.front != crossing.reversed,
        material: crossing.face.material,
        margin: f64::NAN,
    }
}

fn exact_corners(corners: &[DVec3]) -> Vec<Vector<Dyadic>> {
    corners.iter().map(|&corner| Vector::exactly(corner)).collect()
}

/// The six faces, numbered from `first` as [`FaceId::face`] says.
pub(crate) fn parallelepiped_faces(
    solid: &Parallelepiped,
    primitive: u32,
    first: u32,
) -> impl Iterator<Item = Face> {
    let corner = Vector::exactly(solid.corner);
    let edges = solid.edges.map(Vector::exactly);
    let volume = edges[0].dot(&edges[1].cross(&edges[2])).sign();
    let material = solid.material;
    (0..6).map(move |face| {
        let k = face as usize / 2;
        let (mut e, mut f) = (&edges[(k + 1) % 3], &edges[(k + 2) % 3]);
        // e × f points to where edge k leads if the volume is positive: that is the outside of
        // the far face and the inside of the near one.
        let is_far = face % 2 == 1;
        if is_far != volume.is_gt() {
            (e, f) = (f, e);
        }
        let start = if is_far { corner.plus(&edges[k]) } else { corner.clone() };
        let corners = vec![start.clone(), start.plus(e), start.plus(e).plus(f), start.plus(f)];
        Face {
            shape: Shape::Polygon(Polygon::planar(corners)),
            id: FaceId { primitive, face: first + face },
            material,
        }
    })
}
