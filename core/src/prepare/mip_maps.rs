//! Images at every size down to one texel, for footprints of every size.
//!
//! Source: Williams, "Pyramidal Parametrics" (1983).

use rayon::prelude::*;

use crate::{
    prepared::record::{LevelRecord, TextureRecord},
    scene::Texture,
    transfer::Transfer,
};

/// Images with all their levels, `[y][x]` each.
#[derive(Debug, Default)]
pub(crate) struct MipMaps {
    /// The images' texels become light by this.
    pub(crate) transfer: Transfer,
    pub(super) textures: Vec<TextureRecord>,
    pub(crate) levels: Vec<LevelRecord>,
    /// The texels of the images themselves: red, green, blue as their files have them, and 0.
    pub(crate) fine: Vec<[u8; 4]>,
    /// The texels of all other levels: red, green, blue light.
    pub(crate) coarse: Vec<[f32; 3]>,
}

impl MipMaps {
    /// Adds an image: the same texels on any number of threads.
    pub(crate) fn add(&mut self, texture: &Texture) {
        let (mut width, mut height) = (texture.width, texture.height);
        let first_level = self.levels.len() as u32;
        self.levels.push(LevelRecord { width, height, offset: self.fine.len() as u64 });
        self.fine.par_extend(texture.texels.par_iter().map(|&[r, g, b]| [r, g, b, 0]));
        let light = self.transfer.light_of_bytes();
        let mut last_start = None;
        while width > 1 || height > 1 {
            let texels = match last_start {
                None => half_size(width, height, |x, y| {
                    let texel = texture.texels[y as usize * texture.width as usize + x as usize];
                    texel.map(|channel| light[usize::from(channel)] / 255.0)
                }),
                Some(start) => {
                    let finer: &[[f32; 3]] = &self.coarse[start..];
                    let at = |x, y| finer[y as usize * width as usize + x as usize].map(f64::from);
                    half_size(width, height, at)
                }
            };
            (width, height) = (half(width), half(height));
            let start = self.coarse.len();
            self.levels.push(LevelRecord { width, height, offset: start as u64 });
            self.coarse.extend(texels);
            last_start = Some(start);
        }
        let level_count = self.levels.len() as u32 - first_level;
        self.textures.push(TextureRecord { first_level, level_count });
    }
}

fn half(side: u32) -> u32 {
    (side / 2).max(1)
}

/// The next level of an image whose texels `at` gives as (x, y): each texel the mean over its
/// area, whether or not that cuts finer texels, so that the mean of the whole is kept.
fn half_size(width: u32, height: u32, at: impl Fn(u32, u32) -> [f64; 3] + Sync) -> Vec<[f32; 3]> {
    let (columns, rows) = (half(width), half(height));
    let mut texels = vec![[0.0; 3]; columns as usize * rows as usize];
    texels.par_chunks_mut(columns as usize).zip(0..rows).for_each(|(row, y)| {
        for (texel, x) in row.iter_mut().zip(0..columns) {
            let mut sum = [0.0; 3];
            for (y, down) in overlaps(y, height, rows) {
                for (x, across) in overlaps(x, width, columns) {
                    for (sum, channel) in sum.iter_mut().zip(at(x, y)) {
                        *sum += down * across * channel;
                    }
                }
            }
            *texel = sum.map(|sum| (sum / (f64::from(width) * f64::from(height))) as f32);
        }
    });
    texels
}

/// Which of `fine` parts of a line the `index`th of `coarse` parts covers, and how much of each, in
/// units of 1 / `coarse` part: whole numbers whose sum is `fine`.
fn overlaps(index: u32, fine: u32, coarse: u32) -> impl Iterator<Item = (u32, f64)> {
    let [index, fine, coarse] = [index, fine, coarse].map(u64::from);
    let (start, end) = (index * fine, (index + 1) * fine);
    (start / coarse..end.div_ceil(coarse)).map(move |part| {
        let covered = end.min((part + 1) * coarse) - start.max(part * coarse);
        (part as u32, covered as f64)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(width: u32, height: u32) -> Texture {
        let channel = |k: u32| (k.wrapping_mul(2_654_435_761) >> 24) as u8;
        let texels = (0..width * height).map(|k| [channel(k), channel(k + 7), 255]).collect();
        Texture { path: String::new(), width, height, texels }
    }

    #[test]
    fn every_level_keeps_the_mean() {
        let mut worst = 0.0_f64;
        for (width, height) in [(1, 1), (2, 2), (64, 64), (3, 5), (1, 1000), (1023, 37), (640, 479)]
        {
            let texture = texture(width, height);
            let mut mip_maps = MipMaps::default();
            mip_maps.add(&texture);
            let mean = |texels: &mut dyn Iterator<Item = [f64; 3]>, count: usize| {
                texels
                    .fold([0.0; 3], |sum, texel| [0, 1, 2].map(|k| sum[k] + texel[k]))
                    .map(|sum| sum / count as f64)
            };
            let fine = &mut texture.texels.iter().map(|t| t.map(|c| f64::from(c) / 255.0));
            let truth = mean(fine, texture.texels.len());
            for level in &mip_maps.levels[1..] {
                let start = level.offset as usize;
                let texels = &mip_maps.coarse[start..][..(level.width * level.height) as usize];
                let found = mean(&mut texels.iter().map(|t| t.map(f64::from)), texels.len());
                let off = found.iter().zip(truth).map(|(f, t)| (f - t).abs()).fold(0.0, f64::max);
                worst = worst.max(off);
            }
            let last = mip_maps.levels.last().unwrap();
            assert_eq!((last.width, last.height), (1, 1));
        }
        eprintln!("means are kept to {worst:.1e}");
        assert!(worst < 1e-6);
    }

    #[test]
    fn coarser_levels_are_means_of_light() {
        let texels = vec![[0, 255, 10], [255, 255, 200]];
        let texture = Texture { path: String::new(), width: 2, height: 1, texels };
        let coarse = |transfer: Transfer| {
            let mut mip_maps = MipMaps { transfer, ..MipMaps::default() };
            mip_maps.add(&texture);
            assert_eq!(mip_maps.fine, [[0, 255, 10, 0], [255, 255, 200, 0]]);
            mip_maps.coarse
        };
        assert_eq!(coarse(Transfer::None), [[0.5, 1.0, (210.0 / 510.0) as f32]]);
        let blue = [10.0, 200.0].map(|byte| Transfer::Srgb.decode(byte / 255.0));
        let mean = f64::midpoint(blue[0], blue[1]) as f32;
        let found = coarse(Transfer::Srgb);
        assert_eq!(found[0][..2], [0.5, 1.0]);
        assert!((found[0][2] - mean).abs() < 1e-7, "{found:?}");
    }

    #[test]
    fn the_number_of_threads_changes_no_texel() {
        let texels = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut mip_maps = MipMaps::default();
                mip_maps.add(&texture(301, 203));
                mip_maps.coarse.iter().map(|texel| texel.map(f32::to_bits)).collect::<Vec<_>>()
            })
        };
        let one = texels(1);
        assert!(one == texels(2) && one == texels(5));
    }
}
