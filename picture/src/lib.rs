//! A picture in a file: tiles are put into it in any order and from any thread, then it is encoded
//! as a PNG or an `OpenEXR`, band by band, so that its size is not limited by memory. A [`Canvas`]
//! may outlive its process, and says then which tiles are in it. A [`View`] shows one under way.

mod bands;
mod canvas;
mod disk;
mod exr;
mod filter;
mod format;
mod picture;
mod pixels;
mod png;
mod reading;
mod view;

pub use canvas::{Canvas, CanvasTile, TileRecord};
pub use disk::{Cache, Disk};
pub use format::PictureFormat;
pub use picture::{Notes, Picture, PutError, TilePixels, pixel_bytes};
pub use reading::PictureReader;
pub use view::{View, encode_screen, pixel_values};
