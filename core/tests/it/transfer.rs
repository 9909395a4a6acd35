//! Pictures of scenes whose colours are encoded by the sRGB curve: what stands there unmixed looks
//! as it is written, and what mixes does so as light.

use std::io::Cursor;

use image::{DynamicImage, ImageFormat, RgbImage};
use rtfarm_core::{
    language::{Reading, read_scene_with},
    render::Settings,
    scene::Scene,
    transfer::Transfer,
};
use rtfarm_picture::{Picture, PictureFormat};

use crate::support::studio::{self, picture, settings, whole};

const BOTH: [Transfer; 2] = [Transfer::None, Transfer::Srgb];

/// A screen of 16 x 16 at z = 0, its upper left corner at 0 0, seen from afar.
const VIEWPORT: &str = "viewport origin 8 -8 1000 topleft 0 0 0 bottomleft 0 -16 0 topright 16 0 0
    background 255 255 255 endviewport\n";

fn reading(text: &str, image: &RgbImage, transfer: Transfer) -> Reading {
    let file = |_: &str| {
        let mut bytes = Cursor::new(Vec::new());
        DynamicImage::from(image.clone()).write_to(&mut bytes, ImageFormat::Png).unwrap();
        Ok(bytes.into_inner())
    };
    read_scene_with(text.as_bytes(), &file, transfer)
}

fn read_with_image(text: &str, image: &RgbImage, transfer: Transfer) -> Scene {
    let reading = reading(&format!("{VIEWPORT}{text}"), image, transfer);
    assert!(reading.diagnostics.is_empty(), "{:?}", reading.diagnostics);
    reading.scene.unwrap()
}

fn read(text: &str, transfer: Transfer) -> Scene {
    read_with_image(text, &RgbImage::new(1, 1), transfer)
}

/// The picture as a PNG has it.
fn as_png(pixels: &[[f32; 3]], settings: &Settings, transfer: Transfer) -> RgbImage {
    let file = tempfile::tempfile().unwrap();
    let picture = Picture::new(file, settings.size, PictureFormat::Png8, transfer).unwrap();
    picture.put(whole(settings.size), pixels).unwrap();
    let mut file = Cursor::new(Vec::new());
    picture.encode(&rtfarm_picture::Notes::default(), &mut file).unwrap();
    image::load_from_memory(file.get_ref()).unwrap().into_rgb8()
}

/// The one pixel of a picture: its light, and what a PNG has of it.
fn pixel(scene: &Scene, transfer: Transfer) -> ([f32; 3], [u8; 3]) {
    let settings = settings(1, 1, 64);
    let pixels = picture(scene, &settings);
    (pixels[0], as_png(&pixels, &settings, transfer).get_pixel(0, 0).0)
}

/// A quadrangle over this part of the screen's width and all its height.
fn sheet([left, right]: [f64; 2], material: &str) -> String {
    format!(
        "geometry quadrangle vertex {left:?} -16 0 vertex {right:?} -16 0 vertex {right:?} 0 0
        vertex {left:?} 0 0 material {material} endquadrangle endgeometry\n"
    )
}

#[test]
fn every_colour_looks_as_it_is_written() {
    let material = |k: u32| format!("entry name m{k} color {k} {} 255 endentry\n", 255 - k);
    let materials: String = (0..256).map(material).collect();
    let square = |k: u32| {
        let (x, y) = (k % 16, k / 16);
        let (right, bottom) = (x + 1, y + 1);
        format!(
            "quadrangle vertex {x} -{bottom} 0 vertex {right} -{bottom} 0 vertex {right} -{y} 0
            vertex {x} -{y} 0 material m{k} endquadrangle\n"
        )
    };
    let geometry: String = (0..256).map(square).collect();
    let text = format!("materials {materials} endmaterials geometry {geometry} endgeometry");
    for transfer in BOTH {
        let settings = settings(16, 16, 4);
        let pixels = picture(&read(&text, transfer), &settings);
        let found = as_png(&pixels, &settings, transfer);
        for (k, pixel) in (0..=u8::MAX).zip(found.pixels()) {
            assert_eq!(pixel.0, [k, 255 - k, 255], "{transfer:?}");
        }
    }
}

#[test]
fn a_half_covered_pixel_has_half_the_light() {
    let black = "materials entry name black color 0 0 0 endentry endmaterials\n".to_owned();
    for (transfer, half) in [(Transfer::None, 128), (Transfer::Srgb, 188)] {
        let scene = read(&(black.clone() + &sheet([8.0, 16.0], "black")), transfer);
        assert_eq!(pixel(&scene, transfer), ([0.5; 3], [half; 3]), "an edge, {transfer:?}");
    }
    let pane = "materials entry name pane color 0 0 0 alpha 0.5 endentry endmaterials\n".to_owned();
    for (transfer, half) in [(Transfer::None, 128), (Transfer::Srgb, 188)] {
        let scene = read(&(pane.clone() + &sheet([0.0, 16.0], "pane")), transfer);
        assert_eq!(pixel(&scene, transfer), ([0.5; 3], [half; 3]), "a pane, {transfer:?}");
    }
}

const TEXTURED: &str = "materials entry name image texture image.png endentry
    entry name tinted texture image.png color 188 255 100 endentry endmaterials\n";

#[test]
fn every_texel_looks_as_its_file_has_it() {
    for transfer in BOTH {
        for byte in 0..=u8::MAX {
            let image = RgbImage::from_pixel(3, 2, image::Rgb([byte, 255 - byte, 77]));
            let scene = TEXTURED.to_owned() + &sheet([0.0, 16.0], "image");
            let (_, found) = pixel(&read_with_image(&scene, &image, transfer), transfer);
            assert_eq!(found, [byte, 255 - byte, 77], "{transfer:?}");
        }
    }
}

#[test]
fn a_colour_multiplies_the_light_of_texels() {
    let image = RgbImage::from_pixel(1, 1, image::Rgb([100, 30, 255]));
    let scene = TEXTURED.to_owned() + &sheet([0.0, 16.0], "tinted");
    let (light, _) = pixel(&read_with_image(&scene, &image, Transfer::Srgb), Transfer::Srgb);
    let decode = |byte: f64| Transfer::Srgb.decode(byte / 255.0);
    let truth = [decode(188.0) * decode(100.0), decode(30.0), decode(100.0)];
    for (found, truth) in light.into_iter().zip(truth) {
        assert!((f64::from(found) - truth).abs() < 1e-7, "{light:?}, not {truth}");
    }
}

#[test]
fn texels_mix_as_light_near_and_far() {
    for (transfer, half) in [(Transfer::None, 128), (Transfer::Srgb, 188)] {
        // Far: a pixel sees them all.
        let board = |side: u32| {
            RgbImage::from_fn(side, side, |x, y| image::Rgb([255 * ((x + y) % 2) as u8; 3]))
        };
        for side in [16, 256] {
            let scene = TEXTURED.to_owned() + &sheet([0.0, 16.0], "image");
            let scene = read_with_image(&scene, &board(side), transfer);
            let (light, found) = pixel(&scene, transfer);
            assert!((light[0] - 0.5).abs() < 1e-3, "{side}, {transfer:?}: {light:?}");
            assert!(found[0].abs_diff(half) <= 1, "{side}, {transfer:?}: {found:?}");
        }
        // Near: the pixel in the middle lies between two texels.
        let image = RgbImage::from_fn(2, 1, |x, _| image::Rgb([255 * x as u8; 3]));
        let scene = TEXTURED.to_owned() + &sheet([0.0, 16.0], "image");
        let settings = settings(1025, 1, 64);
        let pixels = picture(&read_with_image(&scene, &image, transfer), &settings);
        assert!((pixels[512][0] - 0.5).abs() < 1e-3, "{transfer:?}: {:?}", pixels[512]);
        let found = as_png(&pixels, &settings, transfer);
        assert_eq!(found.get_pixel(512, 0).0, [half; 3], "{transfer:?}");
    }
}

#[test]
fn lights_and_background_are_decoded_also_beyond_white() {
    // A light far away on the axis, as bright as the reference.
    let lit = "materials entry name white endentry endmaterials
        lights reference power 1 distance 1e6 endreference
        point coords 8 -8 1e6 power 1 color 188 510 0 endpoint endlights\n";
    for transfer in BOTH {
        let decode = |byte: f64| transfer.decode(byte / 255.0);
        let scene = read(&(lit.to_owned() + &sheet([0.0, 16.0], "white")), transfer);
        let (light, found) = pixel(&scene, transfer);
        let truth = [decode(188.0), decode(510.0), 0.0];
        for (found, truth) in light.into_iter().zip(truth) {
            assert!((f64::from(found) - truth).abs() < 1e-6 * truth.max(1.0), "{light:?}");
        }
        assert_eq!(found, [188, 255, 0], "{transfer:?}");

        let scene = read("", transfer);
        assert_eq!(pixel(&scene, transfer).1, [255; 3]);
        let sky = VIEWPORT.replace("background 255 255 255", "background 1020 100 0");
        let scene = reading(&sky, &RgbImage::new(1, 1), transfer).scene.unwrap();
        let (light, found) = pixel(&scene, transfer);
        assert_eq!(light, [decode(1020.0), decode(100.0), 0.0].map(|light| light as f32));
        assert_eq!(found, [255, 100, 0], "{transfer:?}");
    }
}

#[test]
fn ambient_is_an_amount_of_light() {
    let white = "materials entry name white endentry endmaterials\n".to_owned();
    for ambient in ["ambient 0.5", "ambient 127.5 127.5 127.5"] {
        let text = format!("lights {ambient} endlights\n{white}") + &sheet([0.0, 16.0], "white");
        let found = pixel(&read(&text, Transfer::Srgb), Transfer::Srgb);
        assert_eq!(found, ([0.5; 3], [188; 3]), "{ambient}");
    }
}

#[test]
fn a_colour_whose_light_is_beyond_all_numbers_is_refused() {
    let sky = VIEWPORT.replace("background 255 255 255", "background 0 0 1e200");
    let told = reading(&sky, &RgbImage::new(1, 1), Transfer::Srgb).diagnostics;
    let told: Vec<_> = told.iter().map(|d| d.message.as_str()).collect();
    assert_eq!(told, ["this colour is too bright; the largest amount of light is about 1.8e308"]);
}

#[test]
fn without_textures_the_prepared_scene_does_not_tell_the_curve() {
    let scene = "materials entry name white endentry endmaterials\n".to_owned();
    let scene = scene + &sheet([0.0, 16.0], "white");
    let [plain, srgb] = BOTH.map(|transfer| studio::prepared(&read(&scene, transfer)).hash());
    assert_eq!(plain, srgb);
    let image = RgbImage::from_pixel(1, 1, image::Rgb([9; 3]));
    let scene = TEXTURED.to_owned() + &sheet([0.0, 16.0], "image");
    let [plain, srgb] =
        BOTH.map(|transfer| studio::prepared(&read_with_image(&scene, &image, transfer)).hash());
    assert_ne!(plain, srgb);
}
