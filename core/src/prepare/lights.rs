//! Point lights, with the surfaces that they lie on.

use glam::DVec3;

use super::{error::PrepareError, flat::bounds_of, sort::Sorted};
use crate::{
    prepared::{
        face::triangle_normal,
        record::{LightRecord, Surface},
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
    let mut surfaces = Vec::new();
    let mut add_flat = |corners: &[u32], normal: &dyn Fn() -> DVec3, surface: Surface| {
        let mut points = [DVec3::ZERO; 4];
        for (point, &corner) in points.iter_mut().zip(corners) {
            *point = DVec3::from_array(faces.vertices[corner as usize]);
        }
        let (min, max) = bounds_of(&points[..corners.len()]);
        let blur = 8.0 * f64::EPSILON * (max.abs().max(min.abs()).max(point.abs()));
        let is_within = point.cmpge(min - blur).all() && point.cmple(max + blur).all();
        if is_within && normal().dot(point - points[0]).abs() <= blur.max_element() {
            surfaces.push(surface);
        }
    };
    for triangle in &faces.triangles {
        let corner = |v: u32| DVec3::from_array(faces.vertices[v as usize]);
        let normal = || triangle_normal(triangle.vertices.map(corner));
        add_flat(&triangle.vertices, &normal, Surface(triangle.rank));
    }
    for face in &faces.coplanars {
        let normal = || DVec3::from_array(faces.planes[face.plane.index()].normal);
        add_flat(&face.vertices, &normal, face.plane.surface());
    }
    for face in &faces.quadrangles {
        let normal = || DVec3::from_array(faces.planes[face.plane.index()].normal);
        add_flat(&face.vertices, &normal, face.plane.surface());
    }
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
