//! A picture under way as a screen shows it: eight bits a channel, and pixels left out where there are
//! too many.

use std::io;

use ::png::{BitDepth, ColorType, Compression, Encoder};
use rtfarm_core::{
    tile::{Area, Size},
    transfer::Transfer,
};

use crate::{Picture, PictureFormat, format::quantize};

/// The most pixels that a view has.
const MOST_PIXELS: u64 = 1 << 23;

/// Which pixels of a picture a view shows: each `step`-th of each `step`-th row, from the first on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct View {
    window: Area,
    step: u32,
}

impl View {
    /// The view of a picture of that window which shows as much as a screen can use.
    pub fn of(window: Area) -> Self {
        let is_small =
            |step: &u32| Self { window, step: *step }.size().pixel_count() <= MOST_PIXELS;
        let step = (0..16).map(|power| 1 << power).find(is_small).expect("a side has 16 bits");
        Self { window, step }
    }

    /// Of the picture's pixels each of so many to the right and downwards is shown.
    pub fn step(self) -> u32 {
        self.step
    }

    /// What the view measures.
    pub fn size(self) -> Size {
        let Self { window, step } = self;
        let side = |side: u32| u64::from(side.div_ceil(step));
        Size::new(side(window.width()), side(window.height())).expect("it is no larger")
    }

    /// Encodes what the view shows of these areas of the picture, one below the other, as a PNG; empty
    /// where it shows nothing of them.
    pub fn encode(self, picture: &Picture, areas: &[Area]) -> io::Result<Vec<u8>> {
        let (mut width, mut rows) = (0, Vec::new());
        for &area in areas {
            let row_bytes = area.width() as usize * picture.format().bytes_per_pixel();
            let bytes = picture.read_area(area)?;
            let skipped = self.skipped(area.x0() - self.window.x0());
            for (y, row) in area.rows().zip(bytes.chunks_exact(row_bytes)) {
                if (y - self.window.y0()).is_multiple_of(self.step) {
                    let pixels = row.chunks_exact(picture.format().bytes_per_pixel());
                    let shown = pixels.skip(skipped).step_by(self.step as usize);
                    let shown = shown.flat_map(|pixel| eight_bits(pixel, picture));
                    rows.push(shown.collect::<Vec<u8>>());
                    width = width.max(rows[rows.len() - 1].len());
                }
            }
        }
        let mut png = Vec::new();
        if width == 0 {
            return Ok(png);
        }
        let mut bytes = Vec::with_capacity(width * rows.len());
        for mut row in rows {
            row.resize(width, 0);
            bytes.append(&mut row);
        }
        let mut encoder = Encoder::new(&mut png, (width / 3) as u32, (bytes.len() / width) as u32);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Fast);
        encoder.write_header()?.write_image_data(&bytes)?;
        Ok(png)
    }

    /// How many pixels stand before the first that is shown, from this place on.
    fn skipped(self, place: u32) -> usize {
        (place.next_multiple_of(self.step) - place) as usize
    }
}

/// The numbers of one pixel of the window, from the upper left: light, or what a PNG says of it.
pub fn pixel_values(picture: &Picture, area: Area) -> io::Result<[f64; 3]> {
    let bytes = picture.read_area(area)?;
    Ok(match picture.format() {
        PictureFormat::Png8 => [0, 1, 2].map(|channel| f64::from(bytes[channel])),
        PictureFormat::Png16 => {
            [0, 2, 4].map(|at| f64::from(u16::from_be_bytes([bytes[at], bytes[at + 1]])))
        }
        PictureFormat::ExrF32 => [0, 4, 8].map(|at| f64::from(light(&bytes[at..]))),
    })
}

fn light(bytes: &[u8]) -> f32 {
    f32::from_ne_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
}

/// A pixel as eight bits a channel can show it.
fn eight_bits(pixel: &[u8], picture: &Picture) -> [u8; 3] {
    match picture.format() {
        PictureFormat::Png8 => [pixel[0], pixel[1], pixel[2]],
        PictureFormat::Png16 => [0, 2, 4].map(|at| {
            let step = u32::from(u16::from_be_bytes([pixel[at], pixel[at + 1]]));
            ((step + 128) / 257) as u8
        }),
        PictureFormat::ExrF32 => {
            let transfer: Transfer = picture.transfer();
            [0, 4, 8].map(|at| quantize(light(&pixel[at..]), transfer, 255.0) as u8)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_shows_the_pixels_of_each_format_and_each_step() {
        let frame = Size::new(40, 30).unwrap();
        let window = Area::new(frame, [3, 2], [37, 28]).unwrap();
        for format in [PictureFormat::Png8, PictureFormat::Png16, PictureFormat::ExrF32] {
            let file = tempfile::tempfile().unwrap();
            let picture = Picture::new(file, window, format, Transfer::None).unwrap();
            let ramp = |(x, y)| [x as f32 / 255.0, y as f32 / 255.0, 1.0];
            let pixels: Vec<[f32; 3]> = window.pixels().map(ramp).collect();
            picture.put(window, &pixels).unwrap();
            let area = Area::new(frame, [6, 7], [9, 10]).unwrap();
            let at_1 = Area::new(frame, [8, 8], [1, 1]).unwrap();
            let [red, green, blue] = pixel_values(&picture, at_1).unwrap();
            assert_eq!(red, green);
            assert!((red / blue - 8.0 / 255.0).abs() < 1e-4, "{red} of {blue}");
            for step in [1, 2, 4, 8] {
                let png = View { window, step }.encode(&picture, &[area, area]).unwrap();
                let image = image::load_from_memory(&png).unwrap().into_rgb8();
                let shown = |place: u32| place.is_multiple_of(step);
                let columns: Vec<u32> = area.columns().filter(|x| shown(x - 3)).collect();
                let rows: Vec<u32> = area.rows().filter(|y| shown(y - 2)).collect();
                let (width, height) = (columns.len() as u32, 2 * rows.len() as u32);
                assert_eq!(image.dimensions(), (width, height), "{format:?} {step}");
                for (x, y, pixel) in image.enumerate_pixels() {
                    let expected = [columns[x as usize], rows[y as usize % rows.len()]];
                    assert_eq!(pixel.0, [expected[0] as u8, expected[1] as u8, 255], "{step}");
                }
            }
        }
    }

    #[test]
    fn a_view_of_the_largest_picture_fits_a_screen() {
        let largest = Size::new(65_535, 65_535).unwrap();
        let view = View::of(Area::whole(largest));
        assert!(view.size().pixel_count() <= MOST_PIXELS && view.step() == 32);
        assert_eq!(View::of(Area::whole(Size::new(1, 1).unwrap())).step(), 1);
    }
}
