//! The colours that images give to triangles and quadrangles.

use glam::{DVec2, DVec3};
use rtfarm_core::scene::{Scene, Texture};

use crate::oracle::{Hit, Oracle};

/// Corners with their texture coordinates, in one order.
struct Wearer {
    corners: Vec<DVec3>,
    texcoords: Vec<DVec2>,
}

impl Oracle {
    /// The colour of a face at a hit, its texture included: the image itself, bilinear between the
    /// middles of its texels.
    pub fn surface_color(&self, hit: &Hit) -> DVec3 {
        let material = &self.scene.materials[hit.material as usize];
        let worn = material.texture.and_then(|texture| {
            let wearer = wearer(&self.scene, hit.id.primitive)?;
            Some(bilinear(&self.scene.textures[texture as usize], wearer.texcoord(hit.point)))
        });
        material.color * worn.unwrap_or(DVec3::ONE)
    }
}

fn wearer(scene: &Scene, primitive: u32) -> Option<Wearer> {
    if let Some(index) = scene.triangles.iter().position(|face| face.primitive == primitive) {
        let given = scene.triangle_texcoords.iter().find(|(k, _)| *k as usize == index);
        let default = [DVec2::new(0.0, 1.0), DVec2::new(1.0, 1.0), DVec2::ZERO];
        return Some(Wearer {
            corners: scene.triangles[index].vertices.to_vec(),
            texcoords: given.map_or(default, |(_, texcoords)| *texcoords).to_vec(),
        });
    }
    let index = scene.quadrangles.iter().position(|face| face.primitive == primitive)?;
    let given = scene.quadrangle_texcoords.iter().find(|(k, _)| *k as usize == index);
    let default = [DVec2::new(0.0, 1.0), DVec2::ONE, DVec2::new(1.0, 0.0), DVec2::ZERO];
    Some(Wearer {
        corners: scene.quadrangles[index].vertices.to_vec(),
        texcoords: given.map_or(default, |(_, texcoords)| *texcoords).to_vec(),
    })
}

impl Wearer {
    fn texcoord(&self, point: DVec3) -> DVec2 {
        let weights = if self.corners.len() == 3 {
            self.barycentric(point).to_vec()
        } else {
            corner_weights(self.unit_square_place(point)).to_vec()
        };
        weights.iter().zip(&self.texcoords).map(|(&weight, &at)| weight * at).sum()
    }

    /// Shares of the area.
    fn barycentric(&self, point: DVec3) -> [f64; 3] {
        let normal = (self.corners[1] - self.corners[0]).cross(self.corners[2] - self.corners[0]);
        [0, 1, 2].map(|k| {
            let (next, last) = (self.corners[(k + 1) % 3], self.corners[(k + 2) % 3]);
            (next - point).cross(last - point).dot(normal) / normal.length_squared()
        })
    }

    /// Newton's method from many places; of those that it finds in the square (in theory one) the
    /// one that fits best.
    fn unit_square_place(&self, point: DVec3) -> DVec2 {
        let starts = (0..25).map(|k| DVec2::new(f64::from(k % 5), f64::from(k / 5)) / 4.0);
        let found = starts.filter_map(|start| {
            let mut place = start;
            for _ in 0..60 {
                let (s, t) = (place.x, place.y);
                let [a, b, c, d] = [0, 1, 2, 3].map(|k| self.corners[k]);
                let (along, up) =
                    ((b - a) * (1.0 - t) + (c - d) * t, (d - a) * (1.0 - s) + (c - b) * s);
                let miss = point - self.point(place);
                // Least squares: the step that both see alike, in their common plane.
                let (aa, au, uu) = (along.dot(along), along.dot(up), up.dot(up));
                let determinant = aa * uu - au * au;
                if determinant == 0.0 {
                    return None;
                }
                let (x, y) = (along.dot(miss), up.dot(miss));
                place += DVec2::new(x * uu - y * au, y * aa - x * au) / determinant;
            }
            let is_within = (place - 0.5).abs().max_element() <= 0.5 + 1e-7;
            let miss = (self.point(place) - point).length();
            is_within.then_some((miss, place))
        });
        let best = found.min_by(|a, b| a.0.total_cmp(&b.0)).expect("a point of the face");
        best.1.clamp(DVec2::ZERO, DVec2::ONE)
    }

    fn point(&self, place: DVec2) -> DVec3 {
        corner_weights(place).iter().zip(&self.corners).map(|(&weight, &at)| weight * at).sum()
    }
}

fn corner_weights(place: DVec2) -> [f64; 4] {
    let (s, t) = (place.x, place.y);
    [(1.0 - s) * (1.0 - t), s * (1.0 - t), s * t, (1.0 - s) * t]
}

/// The sum over texels of colour times tent.
fn bilinear(texture: &Texture, at: DVec2) -> DVec3 {
    let place = at * DVec2::new(texture.width.into(), texture.height.into());
    let (column, row) = ((place.x - 0.5).floor() as i64, (place.y - 0.5).floor() as i64);
    let mut color = DVec3::ZERO;
    for (x, y) in [(column, row), (column + 1, row), (column, row + 1), (column + 1, row + 1)] {
        let off = (place - DVec2::new(x as f64 + 0.5, y as f64 + 0.5)).abs();
        let [x, y] = [(x, texture.width), (y, texture.height)]
            .map(|(index, count)| index.rem_euclid(i64::from(count)) as usize);
        let texel = texture.texels[y * texture.width as usize + x];
        let texel = DVec3::from_array(texel.map(|channel| f64::from(channel) / 255.0));
        color += (1.0 - off.x) * (1.0 - off.y) * texel;
    }
    color
}
