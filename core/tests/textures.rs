//! Image files of all formats against the texels that they give.

use std::io::Cursor;

use image::{DynamicImage, ImageFormat, RgbImage, RgbaImage};
use rtfarm_core::texture::read_texture;

const TEXELS: [[u8; 3]; 6] =
    [[255, 0, 0], [0, 255, 0], [0, 0, 255], [1, 2, 3], [128, 64, 32], [250, 251, 252]];

fn encode(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn opaque() -> DynamicImage {
    RgbImage::from_raw(3, 2, TEXELS.concat()).unwrap().into()
}

fn check_error(path: &str, bytes: &[u8], message: &str) {
    let error = read_texture(path, bytes).expect_err("this image is refused");
    assert_eq!(error.to_string(), message);
}

#[test]
fn every_format_is_read_from_the_top_row() {
    for (path, format) in [
        ("a.png", ImageFormat::Png),
        ("misnamed.jpg", ImageFormat::Png),
        ("a.bmp", ImageFormat::Bmp),
        ("a.tga", ImageFormat::Tga),
        ("a.webp", ImageFormat::WebP),
    ] {
        let texture = read_texture(path, &encode(&opaque(), format)).unwrap();
        assert_eq!(
            (texture.width, texture.height, texture.texels),
            (3, 2, TEXELS.to_vec()),
            "{path}"
        );
    }
    let grey = RgbImage::from_pixel(16, 16, image::Rgb([100; 3])).into();
    assert_eq!(
        read_texture("a.jpeg", &encode(&grey, ImageFormat::Jpeg)).unwrap().texels[255],
        [100; 3]
    );
}

#[test]
fn the_alpha_channel_is_not_used() {
    let clear = RgbaImage::from_pixel(1, 1, image::Rgba([9, 8, 7, 0])).into();
    assert_eq!(
        read_texture("a.png", &encode(&clear, ImageFormat::Png)).unwrap().texels,
        [[9, 8, 7]]
    );
}

#[test]
fn the_widest_image_is_read() {
    let wide = RgbImage::new(65_535, 1).into();
    assert_eq!(read_texture("a.png", &encode(&wide, ImageFormat::Png)).unwrap().width, 65_535);
}

#[test]
fn other_files_are_refused() {
    check_error("a.txt", b"text", "it is no PNG, JPEG, BMP, TGA or WebP file");
    check_error("a.gif", b"GIF89a", "it is no PNG, JPEG, BMP, TGA or WebP file");
    let png = encode(&opaque(), ImageFormat::Png);
    assert!(read_texture("a.png", &png[..png.len() / 2]).is_err());
    assert!(read_texture("a.tga", b"").is_err());
}

/// A PNG that says how large it is, and holds nothing.
fn empty_png(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    drop(encoder.write_header().unwrap());
    bytes.truncate(33);
    bytes.extend(b"\0\0\0\0IDAT\x35\xaf\x06\x1e");
    bytes
}

#[test]
fn bombs_are_refused_before_memory_is_taken() {
    check_error(
        "a.png",
        &empty_png(16_000, 16_000),
        "it has 16000 x 16000 texels in 45 bytes: a bomb",
    );
    check_error(
        "a.png",
        &empty_png(70_000, 1),
        "it has 70000 x 1 texels; at most 268435456 are read, in sides of at most 65535",
    );
    check_error(
        "a.png",
        &empty_png(60_000, 60_000),
        "it has 60000 x 60000 texels; at most 268435456 are read, in sides of at most 65535",
    );
}
