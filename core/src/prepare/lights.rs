//! Point lights, with the surfaces that they lie on.

use glam::DVec3;
use rayon::prelude::*;

use super::{error::PrepareError, flat::bounds_of, sort::Sorted};
use crate::{
    prepared::{
        face::triangle_normal,
        record::{LightRecord, PlaneIndex, Surface},
    },
    scene::Light,
};

/// The lights of a scene.
pub(super) struct Lights {
    pub(super) records: Vec<LightRecord>,
    /// The surfaces that lights lie on: a run for each light.
    pub(super) coincident: Vec<Surface>,
}

impl Lights {
    /// Scales lights like all faces and finds the surfaces that they lie on.
    pub(crate) fn new(lights: &[Light], scale: f64, faces: &Sorted) -> Result<Self, PrepareError> {
        let mut records = Vec::with_capacity(lights.len());
        let mut coincident = Vec::new();
        for (k, light) in lights.iter().enumerate() {
            let position = light.position * scale;
            let intensity = light.intensity * scale * scale;
            if !intensity.is_finite() {
                return Err(PrepareError::Light(k + 1));
            }
            let first = coincident.len();
            coincident.extend(surfaces_at(position, faces));
            records.push(LightRecord::new(position, intensity, first..coincident.len()));
        }
        Ok(Self { records, coincident })
    }
}

/// The surfaces that a point lies on, within rounding.
fn surfaces_at(point: DVec3, faces: &Sorted) -> Vec<Surface> {
    let flat_at = |corners: &[u32], normal: &dyn Fn() -> DVec3, surface: Surface| {
        let mut points = [DVec3::ZERO; 4];
        for (point, &corner) in points.iter_mut().zip(corners) {
            *point = DVec3::from_array(faces.vertices[corner as usize]);
        }
        let (min, max) = bounds_of(&points[..corners.len()]);
        let blur = 8.0 * f64::EPSILON * (max.abs().max(min.abs()).max(point.abs()));
        let is_within = point.cmpge(min - blur).all() && point.cmple(max + blur).all();
        let is_on = is_within && normal().dot(point - points[0]).abs() <= blur.max_element();
        is_on.then_some(surface)
    };
    let in_plane = |corners: &[u32], plane: PlaneIndex| {
        let normal = || DVec3::from_array(faces.planes[plane.index()].normal);
        flat_at(corners, &normal, plane.surface())
    };
    let triangles = faces.faces.par_iter().filter_map(|face| {
        if let (Some(plane), _) = faces.plane_and_material(face)? {
            return in_plane(&face.vertices, plane);
        }
        let corner = |v: u32| DVec3::from_array(faces.vertices[v as usize]);
        let normal = || triangle_normal(face.vertices.map(corner));
        flat_at(&face.vertices, &normal, Surface(face.rank()))
    });
    let mut surfaces: Vec<Surface> = triangles.collect();
    let quadrangles = faces.quadrangles.par_iter();
    surfaces.par_extend(quadrangles.filter_map(|face| in_plane(&face.vertices, face.plane)));
    let is_on_sphere = |center: [f64; 3], radius: f64| {
        let blur = 8.0 * f64::EPSILON * (radius + point.abs().max_element());
        ((point - DVec3::from_array(center)).length() - radius).abs() <= blur
    };
    for sphere in &faces.spheres {
        if is_on_sphere(sphere.center, sphere.radius) {
            surfaces.push(Surface(sphere.surface));
        }
    }
    for leaf in &faces.leaves {
        if leaf.is_sphere() {
            if is_on_sphere(leaf.center, leaf.radius) {
                surfaces.push(Surface(leaf.surface));
            }
            continue;
        }
        for plane in leaf.planes {
            let record = &faces.planes[plane.index()];
            let [on, normal] = [record.point, record.normal].map(DVec3::from_array);
            let blur = 8.0 * f64::EPSILON * (1.0 + point.abs().max_element());
            if normal.dot(point - on).abs() <= blur {
                surfaces.push(plane.surface());
            }
        }
    }
    surfaces.sort_unstable_by_key(|surface| surface.0);
    surfaces.dedup();
    surfaces
}
