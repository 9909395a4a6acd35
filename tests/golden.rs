//! Every scene in `scenes/` as a small picture, compared exactly with the one in `tests/golden/`.
//!
//! A miss writes the picture and an amplified difference to `target/golden`. Pictures change only
//! when somebody means it: `UPDATE_GOLDEN=1 cargo test --test golden` writes them anew.

use std::{
    collections::BTreeSet,
    env, fs,
    io::Cursor,
    ops::ControlFlow,
    path::{Path, PathBuf},
};

use image::{ImageBuffer, Rgb};
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    language::read_scene,
    prepare::{Form, prepare_as},
    prepared::PreparedScene,
    render::{Quality, Sampling, Settings, render_tile},
    tile::{Area, Size},
    transfer::Transfer,
};
use rtfarm_picture::{Picture, PictureFormat};

type Image = ImageBuffer<Rgb<u16>, Vec<u16>>;

/// The longer side of a golden picture, in pixels.
const SIDE: u32 = 128;

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// The names of the files in a folder of the project that have this extension, without it.
fn names(folder_name: &str, extension: &str) -> BTreeSet<String> {
    fs::read_dir(folder(folder_name))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|found| found == extension))
        .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
        .collect()
}

/// The scene's picture as a PNG of 16 bits a channel.
fn render(name: &str) -> Vec<u8> {
    let path = folder("scenes").join(name).with_extension("rt");
    let beside = |file: &str| fs::read(path.with_file_name(file));
    let reading = read_scene(&fs::read(&path).unwrap(), &beside);
    let told: Vec<_> =
        reading.diagnostics.iter().map(|d| format!("{name}.rt:{}: {}", d.at, d.message)).collect();
    assert_eq!(told, Vec::<String>::new(), "our own scenes are without a fault");
    let scene = reading.scene.unwrap();
    let open = |form| PreparedScene::open(prepare_as(&scene, form).unwrap()).unwrap();
    let [prepared, compact] = [Form::Fast, Form::Compact].map(open);
    let viewport = scene.viewport.unwrap();
    let size = small(scene.size_hint.unwrap_or_else(|| viewport.default_size()));
    let settings = Settings {
        size,
        quality: Quality { sampling: Sampling::fixed(8).unwrap(), ..Quality::default() },
    };
    let area = Area::whole(size);

    let render = |prepared, isa| {
        render_tile(prepared, &settings.quality, area, isa, &mut || ControlFlow::Continue(()))
            .unwrap()
    };
    let tile = render(&prepared, Isa::Scalar);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
        let bits = |pixel: &[f32; 3]| pixel.map(f32::to_bits);
        for other in [render(&prepared, isa), render(&compact, isa)] {
            assert!(
                tile.pixels.iter().map(bits).eq(other.pixels.iter().map(bits)),
                "{name}: {isa}"
            );
            assert_eq!(tile.tally.rays, other.tally.rays, "{name}: {isa}");
        }
    }
    let file = tempfile::tempfile().unwrap();
    let picture = Picture::new(file, size, PictureFormat::Png16, Transfer::None).unwrap();
    picture.put(area, &tile.pixels).unwrap();
    let mut png = Cursor::new(Vec::new());
    picture.encode(&rtfarm_picture::Notes::default(), &mut png).unwrap();
    png.into_inner()
}

/// The same shape with a longer side of [`SIDE`].
fn small(size: Size) -> Size {
    let longer = size.width().max(size.height());
    let scaled = |side: u32| u64::from((side * SIDE).div_ceil(longer));
    Size::new(scaled(size.width()), scaled(size.height())).unwrap()
}

fn decode(png: &[u8]) -> Image {
    image::load_from_memory(png).unwrap().into_rgb16()
}

/// Where two pictures of one size differ, the greatest difference white.
fn amplified_difference(found: &Image, golden: &Image) -> Image {
    let differences: Vec<u16> =
        found.as_raw().iter().zip(golden.as_raw()).map(|(a, b)| a.abs_diff(*b)).collect();
    let greatest = u32::from(differences.iter().copied().max().unwrap_or(0)).max(1);
    let amplified = differences.iter().map(|&d| (u32::from(d) * 65_535 / greatest) as u16);
    Image::from_raw(found.width(), found.height(), amplified.collect()).unwrap()
}

/// Whether the scene's picture is its golden one; if not, what is wrong.
fn check_golden(name: &str) -> Result<(), String> {
    let png = render(name);
    let found = decode(&png);
    let path = folder("tests/golden").join(name).with_extension("png");
    let golden = fs::read(&path).ok().map(|png| decode(&png));
    if golden.as_ref() == Some(&found) {
        return Ok(());
    }
    if env::var_os("UPDATE_GOLDEN").is_some_and(|value| value == "1") {
        fs::write(&path, png).unwrap();
        return Ok(());
    }
    let written = folder("target/golden");
    fs::create_dir_all(&written).unwrap();
    fs::write(written.join(format!("{name}.png")), png).unwrap();
    let told = match golden {
        None => "has no golden picture".to_owned(),
        Some(golden) if golden.dimensions() == found.dimensions() => {
            let difference = amplified_difference(&found, &golden);
            difference.save(written.join(format!("{name}.difference.png"))).unwrap();
            let pixels = found.pixels().zip(golden.pixels()).filter(|(a, b)| a != b).count();
            format!(
                "differs from its golden picture in {pixels} of {} pixels",
                found.pixels().len()
            )
        }
        Some(_) => "has another size than its golden picture".to_owned(),
    };
    Err(format!("{name} {told}; see {}", written.display()))
}

#[test]
fn every_scene_looks_as_it_did() {
    let names: Vec<String> = names("scenes", "rt").into_iter().collect();
    let misses: Vec<String> =
        names.par_iter().filter_map(|name| check_golden(name).err()).collect();
    assert!(misses.is_empty(), "{}\nUPDATE_GOLDEN=1 accepts what is seen now", misses.join("\n"));
}

#[test]
fn every_golden_picture_has_a_scene() {
    let scenes = names("scenes", "rt");
    let orphans: Vec<String> = names("tests/golden", "png").difference(&scenes).cloned().collect();
    assert_eq!(orphans, Vec::<String>::new());
}
