//! What other programs make of the same scenes and rays, through a folder: `--for-peers` fills it,
//! some script runs the programs, and `--peers` reads what they left.

use std::{collections::BTreeMap, fs, path::Path};

use anyhow::{Context, bail, ensure};
use glam::DVec3;
use rtfarm_core::tile::Size;
use rtfarm_ladder::{
    Rung, Series,
    figures::{Errors, Truth},
};
use rtfarm_oracle::known_pictures::known_texts;

use crate::kernels::{Aim, Case, Mesh, Other, rounded};

/// The pictures of others, a line each: scene, renderer, setting, the milliseconds of each run
/// parted by commas, the picture's file. Tabs part the columns.
const PICTURES: &str = "pictures.tsv";

/// The kernels of others, a line each: kernel, how far the mesh was moved, aim, millions of rays a
/// second of each run parted by commas, the file of distances: a little-endian f32 a ray, infinite
/// where it met nothing.
const KERNELS: &str = "kernels.tsv";

/// Writes what other programs are to work on: every scene of [`known_texts`] as `NAME.rt`,
/// `size` with the pictures' width and height, `mesh-MOVED` with nine little-endian f32 a triangle
/// and `rays-MOVED-AIM` with eight a ray: origin, direction, reach and one that counts nothing.
pub(crate) fn write(folder: &Path, size: Size, rays: usize) -> anyhow::Result<()> {
    fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.join(name);
        fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))
    };
    for (name, text) in known_texts() {
        put(&format!("{name}.rt"), text.as_bytes())?;
    }
    put("size", format!("{} {}\n", size.width(), size.height()).as_bytes())?;
    let bytes = |numbers: &mut dyn Iterator<Item = f64>| -> Vec<u8> {
        numbers.flat_map(|number| (number as f32).to_le_bytes()).collect()
    };
    for mesh in Mesh::all() {
        let cases = Case::all_of(&mesh, rays).filter(|case| case.is_single);
        for case in cases {
            let corners = mesh.triangles.as_flattened().iter();
            let mesh_bytes = bytes(&mut corners.flat_map(|corner: &DVec3| corner.to_array()));
            put(&format!("mesh-{:e}", case.moved), &mesh_bytes)?;
            let rays = case.rays.iter().map(rounded);
            let numbers = rays.flat_map(|ray| {
                let [[x, y, z], [dx, dy, dz]] = [ray.origin, ray.direction].map(|v| v.to_array());
                [x, y, z, dx, dy, dz, f64::INFINITY, f64::INFINITY]
            });
            let ray_bytes = bytes(&mut numbers.into_iter());
            put(&format!("rays-{:e}-{}", case.moved, case.aim.name()), &ray_bytes)?;
        }
    }
    Ok(())
}

/// The lines of a file that may be missing, in columns.
pub(crate) fn lines<const COLUMNS: usize>(path: &Path) -> anyhow::Result<Vec<[String; COLUMNS]>> {
    let text = match fs::read_to_string(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        read => read.with_context(|| format!("cannot read {}", path.display()))?,
    };
    let columns = |(number, line): (usize, &str)| {
        let columns: Vec<String> = line.split('\t').map(str::to_owned).collect();
        let place = || format!("{}:{}", path.display(), number + 1);
        columns.try_into().map_err(|_| anyhow::anyhow!("{}: not {COLUMNS} columns", place()))
    };
    text.lines().enumerate().map(columns).collect()
}

pub(crate) fn numbers(text: &str) -> anyhow::Result<Vec<f64>> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(str::parse).collect();
    let numbers = numbers.with_context(|| format!("`{text}` are no numbers"))?;
    ensure!(numbers.iter().all(|&number| number > 0.0), "`{text}`: all should be above 0");
    Ok(numbers)
}

/// What other renderers made of each scene. `truth_of` knows the scenes.
pub(crate) fn read_pictures<'a>(
    folder: &Path,
    truth_of: &dyn Fn(&str) -> Option<&'a Truth>,
) -> anyhow::Result<BTreeMap<String, Vec<Series>>> {
    let mut of_scene: BTreeMap<String, Vec<Series>> = BTreeMap::new();
    for [scene, renderer, setting, times, file] in lines(&folder.join(PICTURES))? {
        let truth = truth_of(&scene).with_context(|| format!("there is no scene `{scene}`"))?;
        let path = folder.join(&file);
        let rung = read_picture(&path, truth, &times, format!("{renderer} `{setting}`"))
            .with_context(|| format!("cannot use {}", path.display()))?;
        let series = of_scene.entry(scene).or_default();
        match series.iter_mut().find(|series| series.name == renderer) {
            Some(series) => series.rungs.push(rung),
            None => series.push(Series { name: renderer, rungs: vec![rung] }),
        }
    }
    Ok(of_scene)
}

fn read_picture(path: &Path, truth: &Truth, times: &str, setting: String) -> anyhow::Result<Rung> {
    let image = image::ImageReader::open(path)?.with_guessed_format()?.decode()?.into_rgb16();
    let size = (truth.size.width(), truth.size.height());
    if image.dimensions() != size {
        bail!("it has {:?} pixels, not {size:?}", image.dimensions());
    }
    let pixels: Vec<[f32; 3]> =
        image.pixels().map(|pixel| pixel.0.map(|value| f32::from(value) / 65_535.0)).collect();
    Ok(Rung {
        setting,
        milliseconds: numbers(times)?,
        samples_a_pixel: None,
        errors: vec![Errors::new(&pixels, truth, None)],
        told: Vec::new(),
    })
}

/// What other kernels met of one case's rays.
pub(crate) fn read_kernels(folder: &Path, moved: f64, aim: Aim) -> anyhow::Result<Vec<Other>> {
    let mut others = Vec::new();
    for [name, its_move, its_aim, speeds, file] in lines(&folder.join(KERNELS))? {
        if its_aim != aim.name() || its_move.parse() != Ok(moved) {
            continue;
        }
        let path = folder.join(file);
        let bytes = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let distances = bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes).into());
        others.push(Other { name, speeds: numbers(&speeds)?, distances: distances.collect() });
    }
    Ok(others)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_compared_with_the_truth_of_their_scene() {
        let folder = tempfile::tempdir().unwrap();
        let image = image::ImageBuffer::from_pixel(2, 1, image::Rgb([32_768_u16, 0, 65_535]));
        image.save(folder.path().join("a.png")).unwrap();
        let line = "ball\tOther 1.0\t-q\t3,1,2\ta.png\n";
        fs::write(folder.path().join(PICTURES), line).unwrap();
        let truth = Truth::new(vec![[0.5, 0.0, 1.0]; 2], Size::new(2, 1).unwrap());
        let read = read_pictures(folder.path(), &|name| (name == "ball").then_some(&truth));
        let rung = &read.unwrap()["ball"][0].rungs[0];
        assert_eq!((rung.setting.as_str(), rung.time()), ("Other 1.0 `-q`", 2.0));
        assert!(rung.errors[0].worst < 1e-5);
        assert!(read_pictures(folder.path(), &|_| None).is_err());
    }

    #[test]
    fn what_is_broken_is_told() {
        let folder = tempfile::tempdir().unwrap();
        assert!(read_kernels(folder.path(), 0.0, Aim::Edges).unwrap().is_empty());
        fs::write(folder.path().join(KERNELS), "a\t0\tedges\t1,x\tb\n").unwrap();
        assert!(read_kernels(folder.path(), 0.0, Aim::Edges).is_err());
        assert!(read_kernels(folder.path(), 0.0, Aim::Corners).unwrap().is_empty());
        fs::write(folder.path().join(KERNELS), "a\t0\n").unwrap();
        let error = read_kernels(folder.path(), 0.0, Aim::Edges).err().unwrap();
        assert!(error.to_string().ends_with("kernels.tsv:1: not 5 columns"), "{error}");
    }
}
