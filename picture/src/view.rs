//! A picture under way as a screen shows it: eight bits a channel, and pixels left out where there
//! are too many.

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

    /// The view of a picture of that window which shows as much as fits into so many pixels across
    /// and down, both at least 1.
    pub fn within(window: Area, [across, down]: [u32; 2]) -> Self {
        Self { window, step: window.width().div_ceil(across).max(window.height().div_ceil(down)) }
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

    /// Encodes what the view shows of these areas of the picture, one below the other, as a PNG;
    /// empty where it shows nothing of them.
    pub fn encode(self, picture: &Picture, areas: &[Area]) -> io::Result<Vec<u8>> {
        let (mut width, mut rows) = (0, Vec::new());
        for &area in areas {
            for row in self.rows(picture, area) {
                rows.push(row?);
                width = width.max(rows[rows.len() - 1].len());
            }
        }
        if width == 0 {
            return Ok(Vec::new());
        }
        let mut bytes = Vec::with_capacity(width * rows.len());
        for mut row in rows {
            row.resize(width, 0);
            bytes.append(&mut row);
        }
        encode_screen(&bytes, width as u32 / 3)
    }

    /// What the view shows of the whole picture: `[y][x]`, red, green and blue. Only the rows that
    /// are shown are read.
    pub fn pixels(self, picture: &Picture) -> io::Result<Vec<u8>> {
        let rows: Vec<Vec<u8>> = self.rows(picture, self.window).collect::<io::Result<_>>()?;
        Ok(rows.concat())
    }

    /// The rows of an area that are shown, one by one.
    fn rows(self, picture: &Picture, area: Area) -> impl Iterator<Item = io::Result<Vec<u8>>> {
        let skipped = self.skipped(area.x0() - self.window.x0());
        let is_shown = move |y: &u32| (y - self.window.y0()).is_multiple_of(self.step);
        area.rows().filter(is_shown).map(move |y| {
            let bytes = picture.read_row(y, area.columns())?;
            let pixels = bytes.chunks_exact(picture.format().bytes_per_pixel());
            let shown = pixels.skip(skipped).step_by(self.step as usize);
            Ok(shown.flat_map(|pixel| eight_bits(pixel, picture)).collect())
        })
    }

    /// How many pixels stand before the first that is shown, from this place on.
    fn skipped(self, place: u32) -> usize {
        (place.next_multiple_of(self.step) - place) as usize
    }
}

/// Encodes pixels of a screen, `[y][x]`, red, green and blue, as a PNG.
pub fn encode_screen(bytes: &[u8], width: u32) -> io::Result<Vec<u8>> {
    let mut png = Vec::new();
    let mut encoder = Encoder::new(&mut png, width, bytes.len() as u32 / 3 / width);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    encoder.write_header()?.write_image_data(bytes)?;
    Ok(png)
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
    fn a_view_fits_and_shows_the_whole_picture() {
        let frame = Size::new(40, 30).unwrap();
        let window = Area::new(frame, [3, 2], [37, 28]).unwrap();
        let file = tempfile::tempfile().unwrap();
        let picture = Picture::new(file, window, PictureFormat::Png8, Transfer::None).unwrap();
        let pixels: Vec<[f32; 3]> =
            window.pixels().map(|(x, y)| [x as f32 / 255.0, y as f32 / 255.0, 1.0]).collect();
        picture.put(window, &pixels).unwrap();
        for (most, step) in
            [([37, 28], 1), ([36, 28], 2), ([37, 10], 3), ([1, 28], 37), ([8, 1], 28)]
        {
            let view = View::within(window, most);
            assert_eq!(view.step(), step, "{most:?}");
            assert!(view.size().width() <= most[0] && view.size().height() <= most[1]);
            let at = |from: u32, count: u32| (0..count).map(move |at| (from + at * step) as u8);
            let rows = at(2, view.size().height());
            let expected =
                rows.flat_map(|y| at(3, view.size().width()).flat_map(move |x| [x, y, 255]));
            assert_eq!(view.pixels(&picture).unwrap(), expected.collect::<Vec<u8>>(), "{most:?}");
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
