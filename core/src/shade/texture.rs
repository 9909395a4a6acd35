//! A sample sees of an image its mean over the part that belongs to the sample.

use glam::{DVec2, DVec3};

use super::{chart::Chart, ray_differential::SurfaceFootprint};
use crate::prepared::{
    face::Face,
    layout::View,
    record::{LevelRecord, TexturedFace},
};

/// The most probes along a footprint's longer axis. A footprint that is longer than this times its
/// width is blurred.
const MOST_PROBES: f64 = 32.0;

/// The least distance of a footprint's middle relative to that of its far end: one that reaches to
/// the horizon ends there.
const LEAST_NEARNESS: f64 = 1.0 / 64.0;

/// The part of an image that belongs to a sample, in texture coordinates; see
/// [`SurfaceFootprint`].
#[derive(Debug, Clone, Copy)]
pub(super) struct TextureFootprint {
    center: DVec2,
    sides: [DVec2; 2],
    tapers: [f64; 2],
}

/// Finds what multiplies the colour of a face at a hit, in linear RGB: the mean of its texture over
/// `footprint`, or white where the face has no texture coordinates.
pub(super) fn texture_color(
    view: &View<'_>,
    texture: u32,
    face: Face,
    rank: u32,
    (position, outward): (DVec3, DVec3),
    footprint: SurfaceFootprint,
) -> DVec3 {
    let faces = view.textured_faces;
    let Ok(index) = faces.binary_search_by_key(&rank, |face| face.rank) else {
        return DVec3::ONE;
    };
    let TexturedFace { texcoords, .. } = faces[index];
    let Some(polygon) = face.polygon(view) else { return DVec3::ONE };
    let chart = Chart::new(polygon.corners(), outward);
    let place = chart.place(position);
    let footprint = TextureFootprint {
        center: texcoords.at(place),
        sides: footprint.sides.map(|side| texcoords.step(place, chart.step(place, side))),
        tapers: footprint.tapers,
    };
    TextureView::new(view, texture).mean(&footprint)
}

/// A texture that can be looked at.
#[derive(Debug, Clone, Copy)]
pub(super) struct TextureView<'a> {
    /// Its levels, the finest first, each half as large as the one before it.
    levels: &'a [LevelRecord],
    /// The texels of the finest levels of all images, encoded RGB and one byte unused.
    fine: &'a [[u8; 4]],
    /// What a byte of `fine` stands for, in 255ths.
    light_of_bytes: &'a [f64; 256],
    /// The texels of the coarser levels of all images, linear RGB.
    coarse: &'a [[f32; 3]],
}

impl<'a> TextureView<'a> {
    /// Looks at the image of an index.
    pub(super) fn new(view: &View<'a>, index: u32) -> Self {
        Self {
            levels: &view.texture_levels[view.textures[index as usize].levels()],
            fine: view.fine_texels,
            light_of_bytes: view.header.features.texel_transfer().light_of_bytes(),
            coarse: view.coarse_texels,
        }
    }

    /// Estimates the mean over a footprint, in linear RGB, by probes along its longer axis, each as
    /// wide as its shorter one is there. A footprint within a texel gives the image itself,
    /// bilinear between the middles of texels.
    pub(super) fn mean(&self, footprint: &TextureFootprint) -> DVec3 {
        // Source: McCormack, Perry, Farkas & Jouppi, "Feline: Fast Elliptical Lines for Anisotropic
        // Texture Mapping" (1999), but with the axes of the footprint's own ellipse, equal weights,
        // which fit a pixel's square, and probes at equal distances on the screen, not the image.
        let size = self.size();
        let [a, b] = footprint.sides.map(|side| side * size);
        // The longer axis is an eigenvector of [a b] [a b]ᵀ.
        let (xx, xy, yy) = (a.x * a.x + b.x * b.x, a.x * a.y + b.x * b.y, a.y * a.y + b.y * b.y);
        let half_difference = (xx - yy) / 2.0;
        let root = (half_difference * half_difference + xy * xy).sqrt();
        let length = ((xx + yy) * 0.5 + root).sqrt();
        if length <= 1.0 {
            return self.bilinear(0, footprint.center);
        }
        if !length.is_finite() {
            return self.bilinear(self.levels.len() - 1, footprint.center);
        }
        let axis = if half_difference > 0.0 {
            DVec2::new(half_difference + root, xy)
        } else {
            DVec2::new(xy, root - half_difference)
        };
        let axis_length = axis.length();
        // A circle has no longer axis.
        let direction = if axis_length > 0.0 { axis / axis_length } else { DVec2::X };
        let minor = a.perp_dot(b).abs() / length;
        let width = minor.max(length / MOST_PROBES).max(1.0);
        let count = (length / width).ceil().min(MOST_PROBES);
        // From end to end, so that a footprint grows into a second probe without a jump.
        let step = (length - width) / (count - 1.0).max(1.0);
        let taper = (a.dot(direction) * footprint.tapers[0]
            + b.dot(direction) * footprint.tapers[1])
            / (length * length);
        let mut sum = DVec3::ZERO;
        for k in 0..count as u32 {
            let along = (f64::from(k) - (count - 1.0) / 2.0) * step;
            // Beyond the horizon there is nothing to see.
            let growth = 1.0 / (1.0 + along * taper).max(LEAST_NEARNESS);
            let wide = (width * growth * growth).max(minor * growth).max(1.0);
            let at = footprint.center + direction * (along * growth) / size;
            sum += self.trilinear(wide, at);
        }
        sum / count
    }

    fn size(&self) -> DVec2 {
        DVec2::new(self.levels[0].width.into(), self.levels[0].height.into())
    }

    /// Interpolates between the two levels whose texels are nearest to `width`, at least 1, of the
    /// finest ones.
    fn trilinear(&self, width: f64, at: DVec2) -> DVec3 {
        // The logarithm to base 2, linear between powers of two: exponent and mantissa.
        let exponent = (width.to_bits() >> 52) as usize - 1023;
        let mantissa = f64::from_bits(width.to_bits() & ((1 << 52) - 1) | 1023 << 52);
        let last = self.levels.len() - 1;
        if exponent >= last {
            return self.bilinear(last, at);
        }
        let finer = self.bilinear(exponent, at);
        if mantissa <= 1.0 {
            return finer;
        }
        finer + (mantissa - 1.0) * (self.bilinear(exponent + 1, at) - finer)
    }

    /// Interpolates between the middles of four texels of a level, which repeats on all sides.
    fn bilinear(&self, level: usize, at: DVec2) -> DVec3 {
        let LevelRecord { width, height, offset } = self.levels[level];
        let ([left, right], across) = neighbours(at.x, width);
        let ([above, below], down) = neighbours(at.y, height);
        let row = |y: usize| {
            let start = offset as usize + y * width as usize;
            let [left, right] = [left, right].map(|x| self.texel(level, start + x));
            left + across * (right - left)
        };
        let (above, below) = (row(above), row(below));
        let color = above + down * (below - above);
        if level == 0 { color / 255.0 } else { color }
    }

    /// Reads a texel: of the finest level in 255ths, which keeps sums exact, else as it is.
    fn texel(&self, level: usize, index: usize) -> DVec3 {
        if level == 0 {
            let [r, g, b, _] = self.fine[index];
            let light = |byte: u8| self.light_of_bytes[usize::from(byte)];
            DVec3::new(light(r), light(g), light(b))
        } else {
            DVec3::from_array(self.coarse[index].map(f64::from))
        }
    }
}

/// Finds the two of `count` texels around a coordinate, and how far it is on the way from the first
/// to the second, 0..=1.
fn neighbours(coordinate: f64, count: u32) -> ([usize; 2], f64) {
    let fraction = coordinate - coordinate.floor();
    // Not NaN, nor the 1 that a tiny negative number rounds to.
    let fraction = if fraction < 1.0 { fraction } else { 0.0 };
    let from_first = fraction * f64::from(count) - 0.5;
    let first = from_first.floor();
    let last = count as usize - 1;
    let low = if first < 0.0 { last } else { (first as usize).min(last) };
    let high = if low == last { 0 } else { low + 1 };
    ([low, high], from_first - first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{prepare::mip_maps::MipMaps, scene::Texture};

    fn image(width: u32, height: u32, texel: impl Fn(u32, u32) -> [u8; 3]) -> MipMaps {
        let texels =
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| texel(x, y));
        let texture = Texture { path: String::new(), width, height, texels: texels.collect() };
        let mut mip_maps = MipMaps::default();
        mip_maps.add(&texture);
        mip_maps
    }

    fn look(mip_maps: &MipMaps) -> TextureView<'_> {
        TextureView {
            levels: &mip_maps.levels,
            fine: &mip_maps.fine,
            light_of_bytes: mip_maps.transfer.light_of_bytes(),
            coarse: &mip_maps.coarse,
        }
    }

    fn noise(x: u32, y: u32) -> [u8; 3] {
        let bits = (x ^ y.wrapping_mul(0x9E37_79B9)).wrapping_mul(0x85EB_CA6B);
        [bits >> 24, bits >> 16, bits >> 8].map(|channel| channel as u8)
    }

    fn footprint(center: [f64; 2], sides: [[f64; 2]; 2]) -> TextureFootprint {
        TextureFootprint {
            center: DVec2::from_array(center),
            sides: sides.map(DVec2::from_array),
            tapers: [0.0; 2],
        }
    }

    #[test]
    fn a_point_is_bilinear_between_the_middles_of_texels() {
        let mip_maps = image(2, 2, |x, y| [255 * x as u8, 255 * y as u8, 255]);
        let seen = |u, v| look(&mip_maps).mean(&footprint([u, v], [[0.0; 2]; 2]));
        assert_eq!(seen(0.25, 0.25), DVec3::new(0.0, 0.0, 1.0));
        assert_eq!(seen(0.75, 0.25), DVec3::new(1.0, 0.0, 1.0));
        assert_eq!(seen(0.25, 0.75), DVec3::new(0.0, 1.0, 1.0));
        assert_eq!(seen(0.5, 0.375), DVec3::new(0.5, 0.25, 1.0));
        // It repeats.
        assert_eq!(seen(1.0, 0.25), DVec3::new(0.5, 0.0, 1.0));
        assert_eq!(seen(-3.25, 5.75), seen(0.75, 0.75));
        assert_eq!(seen(-1e-20, 0.25), seen(0.0, 0.25));
    }

    #[test]
    fn nothing_is_too_large_too_long_or_no_number() {
        let mip_maps = image(5, 3, noise);
        for bad in [f64::NAN, f64::INFINITY, -f64::INFINITY, 1e300, -1e300, 1e17, 1e-300] {
            for at in 0..6 {
                let mut numbers = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6];
                numbers[at] = bad;
                let [u, v, a, b, c, d] = numbers;
                let seen = look(&mip_maps).mean(&footprint([u, v], [[a, b], [c, d]]));
                assert!((0.0..=1.0).contains(&seen.x), "{bad} at {at}: {seen}");
            }
        }
    }

    /// Footprints whose centres fill the image evenly see its mean on average, however long.
    #[test]
    fn the_mean_is_kept() {
        let mut worst = 0.0_f64;
        for count in [1, 2, 7, 13, 16, 31, 100] {
            let sides = [[1e4, 1.0], [100.0, 0.01], [3.0, 3e-4], [0.3, 0.2], [0.05, 0.0], [0.0; 2]];
            for (k, [long, short]) in sides.into_iter().chain(sides).enumerate() {
                let is_across = k < sides.len();
                let (width, height) = if is_across { (count, 1) } else { (1, count) };
                let mip_maps = image(width, height, noise);
                let truth = mip_maps.fine.iter().fold(DVec3::ZERO, |sum, &[r, g, b, _]| {
                    sum + DVec3::new(r.into(), g.into(), b.into()) / (255.0 * f64::from(count))
                });
                let steps = 40_000;
                let seen = (0..steps).map(|k| {
                    let along = (f64::from(k) + 0.5) / f64::from(steps);
                    let (at, sides) = if is_across {
                        ([along, 0.3], [[long, 0.0], [0.0, short]])
                    } else {
                        ([0.3, along], [[short, 0.0], [0.0, long]])
                    };
                    look(&mip_maps).mean(&footprint(at, sides))
                });
                let mean = seen.sum::<DVec3>() / f64::from(steps);
                worst = worst.max((mean - truth).abs().max_element());
            }
        }
        eprintln!("the mean is kept to {worst:.1e}");
        assert!(worst < 1e-6);
    }

    #[test]
    fn probes_stand_along_the_longer_axis() {
        // Stripes that depend on v alone: a footprint along u sees them sharp.
        let mip_maps = image(64, 64, |_, y| [if y % 8 < 4 { 255 } else { 0 }; 3]);
        let view = look(&mip_maps);
        let (u, v) = (0.3, 2.0 / 64.0);
        let long = 12.0 / 64.0;
        assert_eq!(view.mean(&footprint([u, v], [[long, 0.0], [0.0, 1e-3]])), DVec3::ONE);
        assert_eq!(view.mean(&footprint([u, v], [[1e-3, 0.0], [long, 0.0]])), DVec3::ONE);
        let across = view.mean(&footprint([u, v], [[0.0, 16.0 / 64.0], [1e-3, 0.0]]));
        assert!((across.x - 0.5).abs() < 1e-6, "{across}");
    }
}
