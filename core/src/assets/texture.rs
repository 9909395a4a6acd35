//! Image files into textures.

use std::io::Cursor;

use image::{ImageFormat, ImageReader, Limits};

use crate::scene::Texture;

/// Why an image file is no texture.
#[derive(Debug, thiserror::Error)]
pub enum TextureError {
    /// Neither its bytes nor its name are those of a format.
    #[error("it is not a PNG, JPEG, BMP, TGA or WebP file")]
    UnknownFormat,
    /// It is broken.
    #[error("{0}")]
    Image(#[from] image::ImageError),
    /// It has no texels.
    #[error("it has no texels")]
    Empty,
    /// It would take memory out of all proportion to its file.
    #[error("it has {width} x {height} texels in only {bytes} bytes, which no real image has")]
    Bomb {
        /// Its width in texels.
        width: u32,
        /// Its height in texels.
        height: u32,
        /// The length of its file.
        bytes: usize,
    },
    /// It would take too much memory.
    #[error(
        "it has {width} x {height} texels; at most {MOST_TEXELS} are allowed, in sides of at most {LONGEST_SIDE}"
    )]
    TooLarge {
        /// Its width in texels.
        width: u32,
        /// Its height in texels.
        height: u32,
    },
}

/// The longest side of a texture, in texels.
pub const LONGEST_SIDE: u32 = 65_535;

/// The most texels that a texture has: a square of 16 384.
pub const MOST_TEXELS: u64 = 1 << 28;

/// Texels that any file may have, however short.
const HARMLESS_TEXELS: u64 = 1 << 22;

/// Texels that a longer file may have for each of its bytes. A PNG of one colour has 344.
const MOST_TEXELS_A_BYTE: u64 = 400;

/// The memory that a decoder may take besides.
const MOST_BYTES: u64 = 1 << 30;

/// Decodes the bytes of an image file. They tell the format, except that TGA has no mark: its name
/// does.
pub fn read_texture(path: &str, bytes: &[u8]) -> Result<Texture, TextureError> {
    let format = match image::guess_format(bytes) {
        Ok(format) => format,
        Err(_) => ImageFormat::from_path(path).map_err(|_| TextureError::UnknownFormat)?,
    };
    if !format.reading_enabled() {
        return Err(TextureError::UnknownFormat);
    }
    let (width, height) = ImageReader::with_format(Cursor::new(bytes), format).into_dimensions()?;
    if width == 0 || height == 0 {
        return Err(TextureError::Empty);
    }
    let texel_count = u64::from(width) * u64::from(height);
    if width.max(height) > LONGEST_SIDE || texel_count > MOST_TEXELS {
        return Err(TextureError::TooLarge { width, height });
    }
    if texel_count > HARMLESS_TEXELS.max(MOST_TEXELS_A_BYTE * bytes.len() as u64) {
        return Err(TextureError::Bomb { width, height, bytes: bytes.len() });
    }
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = Limits::no_limits();
    // Decoders count what they give as well: at most 16 bytes a texel.
    limits.max_alloc = Some(MOST_BYTES + 16 * texel_count);
    reader.limits(limits);
    let image = reader.decode()?.into_rgb8();
    let texels = image.into_raw();
    let (texels, _) = texels.as_chunks::<3>();
    Ok(Texture { path: path.to_owned(), width, height, texels: texels.to_vec() })
}
