//! Image files into textures.

use std::io::Cursor;

use image::{ImageReader, Limits};

use crate::scene::Texture;

/// Why an image file is no texture.
#[derive(Debug, thiserror::Error)]
pub enum TextureError {
    /// Its first bytes are those of none of the formats, nor is its name.
    #[error("it is no PNG, JPEG, BMP, TGA or WebP")]
    UnknownFormat,
    /// It is broken, or larger than [`MOST_TEXELS`] and [`MOST_BYTES`] allow.
    #[error("{0}")]
    Image(#[from] image::ImageError),
    /// It has no texels.
    #[error("it has no texels")]
    Empty,
}

/// The longest side of a texture, in texels.
pub const LONGEST_SIDE: u32 = 65_535;

/// The memory that decoding an image may take.
pub const MOST_BYTES: u64 = 1 << 30;

/// Decodes the bytes of an image file. The name tells the format where the bytes do not.
pub fn read_texture(path: &str, bytes: &[u8]) -> Result<Texture, TextureError> {
    let mut reader =
        ImageReader::new(Cursor::new(bytes)).with_guessed_format().expect("memory is always read");
    if reader.format().is_none() {
        let format =
            image::ImageFormat::from_path(path).map_err(|_| TextureError::UnknownFormat)?;
        reader.set_format(format);
    }
    let mut limits = Limits::no_limits();
    limits.max_image_width = Some(LONGEST_SIDE);
    limits.max_image_height = Some(LONGEST_SIDE);
    limits.max_alloc = Some(MOST_BYTES);
    reader.limits(limits);
    let image = reader.decode()?.into_rgb8();
    let (width, height) = image.dimensions();
    if width == 0 || height == 0 {
        return Err(TextureError::Empty);
    }
    let texels = image.pixels().map(|texel| texel.0).collect();
    Ok(Texture { path: path.to_owned(), width, height, texels })
}
