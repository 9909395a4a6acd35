//! Image files of all formats against the texels that they give, and textured faces against what
//! is to be seen of them.

use std::{fs, io::Cursor, ops::ControlFlow, path::Path};

use glam::DVec2;
use image::{DynamicImage, ImageFormat, RgbImage, RgbaImage};
use rtfarm_core::{
    assets::texture::read_texture,
    isa::Isa,
    language::read_scene,
    render::{Settings, render_tile},
    sample::Samples,
    scene::{Scene, Texture},
    tile::Area,
};
use rtfarm_oracle::{
    Settings as OracleSettings, eye_direction,
    hard_case::HardCase,
    known_pictures::checkerboard,
    random::Random,
    random_scene::{Recipe, Style, random_scene},
    reference_picture,
};

use crate::support::studio::{
    self, picture, pixels, prepared, quality, settings, tree_picture, whole,
};

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
    check_error("a.txt", b"text", "it is not a PNG, JPEG, BMP, TGA or WebP file");
    check_error("a.gif", b"GIF89a", "it is not a PNG, JPEG, BMP, TGA or WebP file");
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
        "it has 16000 x 16000 texels in only 45 bytes, which no real image has",
    );
    check_error(
        "a.png",
        &empty_png(70_000, 1),
        "it has 70000 x 1 texels; at most 268435456 are allowed, in sides of at most 65535",
    );
    check_error(
        "a.png",
        &empty_png(60_000, 60_000),
        "it has 60000 x 60000 texels; at most 268435456 are allowed, in sides of at most 65535",
    );
}

/// A scene whose material `image` wears one.
fn read(text: &str, image: &RgbImage) -> Scene {
    let mut scene = studio::read(text);
    wear(&mut scene, image, |name| name == "image");
    scene
}

fn wear(scene: &mut Scene, image: &RgbImage, is_meant: impl Fn(&str) -> bool) {
    let (width, height) = image.dimensions();
    let texels = image.pixels().map(|pixel| pixel.0).collect();
    scene.textures.push(Texture { path: "image.png".to_owned(), width, height, texels });
    for material in scene.materials.iter_mut().filter(|material| is_meant(&material.name)) {
        material.texture = Some(0);
    }
}

/// A screen of 2 x 2 at z = 0, seen from z = 4, and a material with an image.
const VIEWPORT: &str = "viewport origin 0 0 4 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0
    endviewport materials entry name image endentry
    entry name mirror reflect 1 endentry entry name pane alpha 0 endentry endmaterials\n";

fn noise(width: u32, height: u32) -> RgbImage {
    let mut random = Random::new(u64::from(width) << 32 | u64::from(height));
    RgbImage::from_fn(width, height, |_, _| image::Rgb([(); 3].map(|()| random.bits() as u8)))
}

fn worst(found: &[[f32; 3]], truth: &[[f64; 3]]) -> f64 {
    let differences =
        found.iter().zip(truth).flat_map(|(f, t)| (0..3).map(|c| f64::from(f[c]) - t[c]));
    differences.fold(0.0, |worst, difference| worst.max(difference.abs()))
}

fn rms(found: &[[f32; 3]], truth: &[[f64; 3]]) -> f64 {
    let differences =
        found.iter().zip(truth).flat_map(|(f, t)| (0..3).map(|c| f64::from(f[c]) - t[c]));
    (differences.map(|d| d * d).sum::<f64>() / (3 * found.len()) as f64).sqrt()
}

/// The image itself at texture coordinates, bilinear.
fn texel_color(image: &RgbImage, at: DVec2) -> [f64; 3] {
    let (width, height) = image.dimensions();
    let (x, y) = (at.x * f64::from(width) - 0.5, at.y * f64::from(height) - 0.5);
    let texel = |dx: i64, dy: i64, c: usize| {
        let column = (x.floor() as i64 + dx).rem_euclid(width.into()) as u32;
        let row = (y.floor() as i64 + dy).rem_euclid(height.into()) as u32;
        f64::from(image.get_pixel(column, row).0[c]) / 255.0
    };
    let (s, t) = (x - x.floor(), y - y.floor());
    [0, 1, 2].map(|c| {
        let row = |dy| texel(0, dy, c) * (1.0 - s) + texel(1, dy, c) * s;
        row(0) * (1.0 - t) + row(1) * t
    })
}

#[test]
fn an_image_stands_upright_on_a_quadrangle_seen_from_the_front() {
    let image = RgbImage::from_raw(2, 2, TEXELS[..4].concat()).unwrap();
    let scene = read(
        &format!(
            "{VIEWPORT} geometry quadrangle vertex -1 -1 0 vertex 1 -1 0 vertex 1 1 0 vertex -1 1 0
            material image endquadrangle endgeometry"
        ),
        &image,
    );
    let settings = settings(6, 6, 1);
    let found = picture(&scene, &settings);
    for (pixel, texel) in [(7, 0), (10, 1), (25, 2), (28, 3)] {
        let truth = TEXELS[texel].map(|channel| f64::from(channel) / 255.0);
        assert!(
            worst(&[found[pixel]], &[truth]) < 1e-7,
            "{pixel}: {:?}, not {truth:?}",
            found[pixel]
        );
    }
}

#[test]
fn a_triangle_has_half_of_an_upright_image() {
    let image = noise(3, 3);
    let scene = read(
        &format!(
            "{VIEWPORT} geometry triangle vertex -1 -1 0 vertex 1 -1 0 vertex -1 1 0
            material image endtriangle endgeometry"
        ),
        &image,
    );
    let settings = settings(12, 12, 1);
    for (k, found) in (0..).zip(picture(&scene, &settings)) {
        let at = DVec2::new(f64::from(k % 12) + 0.5, f64::from(k / 12) + 0.5) / 12.0;
        if at.y > at.x + 0.01 {
            assert!(worst(&[found], &[texel_color(&image, at)]) < 1e-7, "{at}");
        }
    }
}

#[test]
fn coordinates_beyond_the_image_repeat_it() {
    let image = noise(5, 3);
    let geometry = |[left, right]: [f64; 2], [top, bottom]: [f64; 2]| {
        format!(
            "{VIEWPORT} geometry quadrangle vertex -1 -1 0 texcoord {left:?} {bottom:?}
            vertex 1 -1 0 texcoord {right:?} {bottom:?} vertex 1 1 0 texcoord {right:?} {top:?}
            vertex -1 1 0 texcoord {left:?} {top:?} material image endquadrangle endgeometry"
        )
    };
    let settings = settings(40, 40, 1);
    for (across, down) in
        [([0.25, 0.75], [0.5, 1.0]), ([-2.5, 1.5], [-0.25, 3.0]), ([7.0, 4.0], [2.0, -1.0])]
    {
        let found = picture(&read(&geometry(across, down), &image), &settings);
        let truth: Vec<_> = (0..40 * 40)
            .map(|k| {
                let at = [k % 40, k / 40].map(|k| (f64::from(k) + 0.5) / 40.0);
                let along = |[start, end]: [f64; 2], k: usize| start + at[k] * (end - start);
                texel_color(&image, DVec2::new(along(across, 0), along(down, 1)))
            })
            .collect();
        let off = worst(&found, &truth);
        assert!(off < 1e-7, "{across:?} {down:?}: {off:e}");
    }
}

/// A plane at y = -1 to the horizon, seen level from the origin; one unit of texture coordinates
/// is one of length.
fn plane_scene(image: &RgbImage) -> Scene {
    read(
        "viewport origin 0 0 0 topleft -0.6 0.5 -1 bottomleft -0.6 -1 -1 topright 0.6 0.5 -1 endviewport
        materials entry name image endentry endmaterials
        geometry quadrangle vertex -100000 -1 0.5 texcoord -100000 0.5
            vertex 100000 -1 0.5 texcoord 100000 0.5
            vertex 100000 -1 -100000 texcoord 100000 -100000
            vertex -100000 -1 -100000 texcoord -100000 -100000
            material image endquadrangle endgeometry",
        image,
    )
}

#[test]
fn a_checkerboard_fades_to_its_mean_at_the_horizon() {
    let known = checkerboard(settings(96, 72, 1).size);
    let scene = prepared(&known.scene);
    let (width, height) = (96_u32, 72_u32);
    // The row at which the horizon lies, exactly between two rows of pixels.
    let horizon = height / 3;
    let mut errors = Vec::new();
    for samples in [1, 4, 16, 64, 256] {
        let settings = settings(width.into(), height.into(), samples);
        let found = pixels(&scene, &settings, whole(settings.size));
        let (mut far, mut worst, mut squares) = (0.0_f64, 0.0_f64, 0.0);
        for (k, (found, truth)) in (0..).zip(found.iter().zip(&known.truth)) {
            let error = (f64::from(found[0]) - truth[0]).abs();
            let row = k / width;
            // There a pixel covers six squares and more in depth.
            if (horizon..horizon + 4).contains(&row) {
                far = far.max(error);
            }
            worst = worst.max(error);
            squares += error * error;
        }
        let rms = f64::sqrt(squares / f64::from(width * (height - horizon)));
        eprintln!("checkerboard, {samples} samples: far {far:.4}, worst {worst:.4}, rms {rms:.4}");
        errors.push((far, worst, rms));
    }
    let (far, worst, rms) = errors[0];
    assert!(far < 0.02 && worst < 0.1 && rms < 0.012, "at one sample: {errors:?}");
    assert!(errors[2..].windows(2).all(|pair| pair[1].2 < 0.7 * pair[0].2), "{errors:?}");
    assert!(errors[4].2 < 0.008, "{errors:?}");
}

#[test]
fn more_samples_come_to_the_image_itself() {
    let image = noise(48, 37);
    let scene = prepared(&plane_scene(&image));
    let (width, height) = (24, 18);
    let (viewport, size) = (plane_scene(&image).viewport.unwrap(), settings(24, 18, 1).size);
    // Rows that are near enough for a grid of points to see every texel.
    let first = 12 * width;
    let side = 256_u32;
    let truth: Vec<[f64; 3]> = (first..width * height)
        .map(|k| {
            let mut sum = [0.0; 3];
            for point in 0..side * side {
                let at =
                    |from: u32, k: u32| f64::from(from) + (f64::from(k) + 0.5) / f64::from(side);
                let direction = eye_direction(
                    &viewport,
                    size,
                    at(k % width, point % side),
                    at(k / width, point / side),
                );
                let hit = direction / -direction.y;
                let color = texel_color(&image, DVec2::new(hit.x, hit.z));
                sum = [0, 1, 2].map(|c| sum[c] + color[c]);
            }
            sum.map(|sum| sum / f64::from(side * side))
        })
        .collect();
    let mut errors = Vec::new();
    for samples in [1, 4, 16, 64, 256, 1024] {
        let found = pixels(&scene, &settings(24, 18, samples), whole(size));
        let found = &found[first as usize..];
        let mean = |c: usize| {
            let sum: f64 = found.iter().zip(&truth).map(|(f, t)| f64::from(f[c]) - t[c]).sum();
            sum / found.len() as f64
        };
        let bias = mean(0).abs().max(mean(1).abs()).max(mean(2).abs());
        let rms = rms(found, &truth);
        eprintln!(
            "noise, {samples} samples: rms {rms:.5}, worst {:.5}, mean {bias:.5}",
            worst(found, &truth)
        );
        errors.push(rms);
    }
    // A few samples in places by chance are worse than a single footprint; many are not.
    assert!(errors[2..].windows(2).all(|pair| pair[1] < 0.75 * pair[0]), "{errors:?}");
    assert!(errors[5] < 1.0 / 255.0, "{errors:?}");
}

#[test]
fn an_image_of_one_texel_is_a_colour() {
    let image = RgbImage::from_pixel(1, 1, image::Rgb([51, 102, 204]));
    for samples in [1, 16] {
        let settings = settings(32, 24, samples);
        for found in &picture(&plane_scene(&image), &settings)[32 * 9..] {
            assert!(worst(&[*found], &[[0.2, 0.4, 0.8]]) < 1e-7, "{found:?}");
        }
    }
}

/// The mean that a grazing footprint, ten thousand times longer than wide, sees of an image.
#[test]
fn a_footprint_of_ten_thousand_to_one_keeps_the_mean() {
    let mut worst_off = 0.0_f64;
    // A pixel is a twenty-fifth of an image wide: of more than 200 columns it tells some apart, and
    // what it sees is no longer the mean of all.
    for image in [noise(64, 64), noise(37, 53), noise(1, 1), noise(200, 3), noise(3, 1000)] {
        // One row of pixels just below the horizon: 1e4 images deep, a twentieth across.
        let scene = read(
            "viewport origin 0 0 0 topleft -1 -0.00005 -1 bottomleft -1 -0.0001 -1
                topright 1 -0.00005 -1 endviewport
            materials entry name image endentry endmaterials
            geometry quadrangle vertex -1e6 -1 1 texcoord -100 1
                vertex 1e6 -1 1 texcoord 100 1 vertex 1e6 -1 -1e6 texcoord 100 -1e6
                vertex -1e6 -1 -1e6 texcoord -100 -1e6 material image endquadrangle endgeometry",
            &image,
        );
        let mut truth = [0.0; 3];
        for pixel in image.pixels() {
            truth = [0, 1, 2].map(|c| truth[c] + f64::from(pixel.0[c]));
        }
        let count = f64::from(image.width() * image.height());
        let truth = truth.map(|sum| sum / (255.0 * count));
        let found = picture(&scene, &settings(64, 1, 1));
        let off = found.iter().map(|pixel| worst(&[*pixel], &[truth])).fold(0.0, f64::max);
        assert!(off < 1e-6, "{:?}: off by {off:e}", image.dimensions());
        worst_off = worst_off.max(off);
    }
    HardCase::AwkwardTextures.tell(
        "images of 1 x 1 to 200 x 3 and 3 x 1000 texels, seen at 1e4 to 1, keep their mean",
        format!("off by {worst_off:.1e} at most"),
    );
}

/// A square with the image between these coordinates across and twice down.
fn square(z: f64, [left, right]: [f64; 2]) -> String {
    format!(
        "quadrangle vertex -2 -2 {z:?} texcoord {left:?} 2 vertex 2 -2 {z:?} texcoord {right:?} 2
        vertex 2 2 {z:?} texcoord {right:?} 0 vertex -2 2 {z:?} texcoord {left:?} 0
        material image endquadrangle "
    )
}

#[test]
fn a_mirror_and_a_pane_show_what_is_behind_the_window() {
    let image = noise(100, 70);
    let picture_of = |geometry: &str, samples| {
        let scene = read(&format!("{VIEWPORT} geometry {geometry} endgeometry"), &image);
        picture(&scene, &settings(48, 48, samples))
    };
    let pane = |material: &str, tilt: f64| {
        format!(
            "quadrangle vertex -3 -3 0 vertex 3 -3 0 vertex 3 3 {tilt:?} vertex -3 3 {tilt:?}
            material {material} endquadrangle "
        )
    };
    for samples in [1, 16] {
        let direct: Vec<_> = picture_of(&square(-6.0, [0.0, 2.0]), samples)
            .into_iter()
            .map(|pixel| pixel.map(f64::from))
            .collect();
        let mirrored = picture_of(&(pane("mirror", 0.0) + &square(6.0, [0.0, 2.0])), samples);
        let through = picture_of(&(pane("pane", 1.5) + &square(-6.0, [0.0, 2.0])), samples);
        let (mirrored, through) = (worst(&mirrored, &direct), worst(&through, &direct));
        eprintln!("{samples} samples: mirror off by {mirrored:.1e}, pane by {through:.1e}");
        assert!(mirrored < 1e-6 && through < 1e-6, "{samples}: {mirrored:e}, {through:e}");
    }
}

#[test]
fn glass_shifts_an_image_and_keeps_its_footprint() {
    let image = noise(40, 30);
    let scene = |glass: &str| {
        read(
            &format!(
                "viewport origin 0 0 4 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endviewport
                materials entry name image endentry
                entry name glass alpha 0 refract 0.6 endentry endmaterials
                geometry {glass} {} endgeometry",
                square(-6.0, [0.0, 2.0])
            ),
            &image,
        )
    };
    let slab = "parallelepiped vertex -9 -9 -3 vertex 9 -9 -3 vertex -9 9 -3 vertex -9 -9 -1
        material glass endparallelepiped";
    let settings = settings(200, 200, 1);
    let viewport = scene("").viewport.unwrap();
    let found = picture(&scene(slab), &settings);
    let mut off = 0.0_f64;
    for (k, found) in (0..).zip(found) {
        let (x, y) = (f64::from(k % 200) + 0.5, f64::from(k / 200) + 0.5);
        let direction = eye_direction(&viewport, settings.size, x, y).normalize();
        // 8 of air and 2 of glass, where the sine is 0.6 as large.
        let sideways = DVec2::new(direction.x, direction.y);
        let inside = 0.6 * sideways;
        let hit = sideways * (8.0 / -direction.z)
            + inside * (2.0 / (1.0 - inside.length_squared()).sqrt());
        if hit.abs().max_element() < 2.0 {
            let truth = texel_color(&image, DVec2::new(hit.x + 2.0, 2.0 - hit.y) / 2.0);
            off = off.max(worst(&[found], &[truth]));
        }
    }
    eprintln!("glass: off by {off:.1e}");
    assert!(off < 1e-6, "off by {off:e}");
}

/// A random scene whose faces all wear images with random coordinates.
fn random_textured_scene(seed: u64, image: (u32, u32), repeats: f64) -> Scene {
    let recipe = Recipe { triangles: 6, quadrangles: 6, clear: true, ..Recipe::new(Style::Plain) };
    let mut scene = random_scene(seed, &recipe);
    wear(&mut scene, &noise(image.0, image.1), |_| true);
    let mut random = Random::new(seed);
    let mut at = || DVec2::new(random.unit(), random.unit()) * repeats;
    for index in (0..scene.triangles.len() as u32).step_by(2) {
        scene.triangle_texcoords.push((index, [at(), at(), at()]));
    }
    for index in (0..scene.quadrangles.len() as u32).step_by(2) {
        scene.quadrangle_texcoords.push((index, [at(), at(), at(), at()]));
    }
    scene
}

#[test]
fn random_textured_scenes_look_as_the_oracle_sees_them() {
    let (mut wide, mut count, mut far) = (0, 0, 0.0_f64);
    for seed in 300..306 {
        let scene = random_textured_scene(seed, (3, 2), 1.0);
        let settings = Settings { quality: quality(1, 3), ..settings(48, 36, 1) };
        let found = tree_picture(&scene, &settings);
        let of_pixel =
            |x, y| vec![Samples::new(1, settings.quality.seed, x, y).sample(0).position().into()];
        let truth = reference_picture(&scene, settings.size, &of_pixel, &OracleSettings::default());
        for (found, truth) in found.iter().zip(&truth) {
            let off = worst(&[*found], &[*truth]) / truth.iter().fold(1.0, |a: f64, b| a.max(*b));
            wide += u32::from(off > 1e-6);
            far = far.max(off);
            count += 1;
        }
    }
    eprintln!("{wide} of {count} pixels have footprints wider than a texel; at most {far:.2} off");
    assert!(wide * 20 < count, "{wide} of {count} pixels differ");
}

#[test]
fn a_textured_picture_is_the_same_to_the_bit_however_it_is_made() {
    let scene = prepared(&random_textured_scene(310, (37, 64), 4.0));
    for samples in [1, 5, 16] {
        let settings = settings(64, 48, samples);
        let bits = |area: Area, isa: Isa| {
            let go_on = &mut || ControlFlow::Continue(());
            let pixels = render_tile(&scene, &settings.quality, area, isa, go_on).unwrap().pixels;
            pixels.iter().map(|pixel| pixel.map(f32::to_bits)).collect::<Vec<_>>()
        };
        let picture = bits(whole(settings.size), Isa::Scalar);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
            assert!(bits(whole(settings.size), isa) == picture, "{isa}");
        }
        for (x0, y0, width, height) in
            [(0, 0, 64, 1), (7, 11, 13, 17), (63, 0, 1, 48), (20, 30, 1, 1)]
        {
            let rows = (y0..y0 + height).flat_map(|y| {
                let start = (y * 64 + x0) as usize;
                picture[start..start + width as usize].iter().copied()
            });
            let area = Area::new(settings.size, [x0, y0], [width, height]).unwrap();
            assert!(bits(area, Isa::fastest()).into_iter().eq(rows), "{area:?}");
        }
    }
}

#[test]
fn our_textured_scene_comes_to_what_the_oracle_sees() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes/texture.rt");
    let beside = |name: &str| fs::read(path.with_file_name(name));
    let scene = read_scene(&fs::read(&path).unwrap(), &beside).scene.unwrap();
    let size = settings(48, 27, 1).size;
    let of_pixel = |_, _| rtfarm_oracle::grid_positions(12);
    let truth = reference_picture(&scene, size, &of_pixel, &OracleSettings::default());
    let mut errors = Vec::new();
    for samples in [4, 16, 64, 256] {
        let found = picture(&scene, &settings(48, 27, samples));
        errors.push(rms(&found, &truth));
    }
    eprintln!("texture.rt, 4 to 256 samples: rms {errors:.4?}");
    // The truth is a grid of 144 points, which has an error of its own at edges.
    assert!(errors[3] < 0.015, "{errors:?}");
}
