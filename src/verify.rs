//! `rtfarm verify`: whether a picture is what its scene gives. Tiles are rendered again, band by
//! band, so that the picture's size is not limited by memory.

use std::{
    fmt::Write as _,
    io::{self, Write},
    ops::ControlFlow,
    path::Path,
};

use anyhow::{Context, anyhow};
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa, prepare::Form, prepared::PreparedScene, render::render_tile, tile::TileId,
};
use rtfarm_job::{Order, Provenance, Refusal, RenderRequest};
use rtfarm_picture::{PictureReader, pixel_bytes};
use serde_json::json;
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{TileShare, VerifyArgs},
    failure::Failure,
    render::software,
    scene_files::SceneFiles,
    source::SceneText,
};

/// What was found out about a picture.
struct Found {
    /// How it is not what it says to be, or the scene is not.
    differences: Vec<String>,
    /// Another build rendered it.
    other_build: Option<String>,
    tile_count: u32,
    checked: usize,
    /// Tiles whose pixels are others.
    wrong: Vec<u32>,
}

pub(crate) async fn run(args: VerifyArgs, stop: &CancellationToken) -> Result<(), Failure> {
    let text = SceneText::read(&args.scene, stop).await?;
    let (image, as_json) = (args.image.clone(), args.json);
    let token = stop.clone();
    let found = spawn_blocking(move || verify(&args, &text, &token)).await??;
    let Some(found) = found else { return Err(Failure::Interrupted) };
    found.tell(&image, as_json)
}

impl Found {
    fn tell(&self, image: &Path, as_json: bool) -> Result<(), Failure> {
        let Self { differences, other_build, tile_count, checked, wrong } = self;
        let is_same = differences.is_empty() && wrong.is_empty();
        let mut text = String::new();
        if as_json {
            let json = json!({
                "image": image.display().to_string(), "same": is_same, "differences": differences,
                "other_build": other_build, "tiles": tile_count, "checked": checked, "wrong": wrong,
            });
            text = format!("{json:#}\n");
        } else {
            for difference in differences.iter().chain(other_build) {
                text += difference;
                text += "\n";
            }
            if differences.is_empty() {
                let right = checked - wrong.len();
                let others = if wrong.is_empty() { "" } else { &format!(", but not {wrong:?}") };
                let _ = writeln!(
                    text,
                    "{checked} of {tile_count} tiles were rendered again: \
                     {right} are the same to the bit{others}"
                );
            }
        }
        io::stdout()
            .lock()
            .write_all(text.as_bytes())
            .context("cannot write to standard output")?;
        if is_same {
            return Ok(());
        }
        Err(anyhow!("{} is not what its scene gives", image.display()).into())
    }
}

/// Compares; `None` when it was stopped. Never call this on the async runtime.
fn verify(
    args: &VerifyArgs,
    text: &SceneText,
    stop: &CancellationToken,
) -> Result<Option<Found>, Failure> {
    let image = args.image.display();
    let unread = |error: io::Error| {
        Failure::Input(anyhow!(error).context(format!("cannot read the picture {image}")))
    };
    let mut reader = PictureReader::open(&args.image).map_err(unread)?;
    let said = &reader.notes().provenance;
    if said.is_empty() {
        return Err(Failure::Input(anyhow!(
            "{image} does not say what it shows: another program wrote it, or an earlier rtfarm"
        )));
    }
    let provenance = Provenance::read(said)
        .map_err(|error| Failure::Input(anyhow!("{image} cannot be verified: {error}")))?;
    let Provenance { ref build, scene, settings, grid, transfer, format } = provenance;
    let (ours, size) = (software(), grid.window().size());
    let other_build = (*build != ours)
        .then(|| format!("the build differs: {build} rendered the picture, this is {ours}"));
    let mut differences = Vec::new();
    if reader.size() != size || reader.format() != format {
        differences.push(format!(
            "the settings differ: the picture says {size} and {format:?}, and is {} and {:?}",
            reader.size(),
            reader.format()
        ));
    }
    for (option, word, wanted) in args.settings.said() {
        let mut lines = said.lines().filter_map(|line| line.split_once(' '));
        let there = lines.find(|(there, _)| *there == word).map(|(_, value)| value);
        if there != Some(&wanted) {
            let there =
                there.map_or("does not say it".to_owned(), |value| format!("says {word} {value}"));
            differences.push(format!(
                "the settings differ: --{option} makes {word} {wanted}, the picture {there}"
            ));
        }
    }
    let mut order = prepare(args, text, &provenance, Form::Fast)?;
    let plain = order.prepared.hash();
    if plain != scene {
        order = prepare(args, text, &provenance, Form::Compact)?;
    }
    if order.prepared.hash() != scene {
        differences.push(format!(
            "the scene differs: the picture says {scene}, {name} is {plain}, or {} with --compact",
            order.prepared.hash(),
            name = args.scene.name(),
        ));
    }
    let tile_count = grid.count();
    let mut found = Found { differences, other_build, tile_count, checked: 0, wrong: Vec::new() };
    if !found.differences.is_empty() {
        return Ok(Some(found));
    }

    let chosen = choose(args.tiles, tile_count, random_key().map_err(Failure::from)?);
    let prepared = PreparedScene::open(order.prepared).map_err(anyhow::Error::from)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads()).build();
    let pool = pool.map_err(anyhow::Error::from)?;
    let isa: Isa = args.isa.0;
    let bytes_per_pixel = format.bytes_per_pixel();
    for row in 0..grid.rows() {
        let tiles: Vec<TileId> = (row * grid.columns()..(row + 1) * grid.columns())
            .filter(|&number| chosen(number))
            .filter_map(|number| grid.tile(number))
            .collect();
        let first = grid.area(grid.tile(row * grid.columns()).expect("each row has a tile"));
        let band = reader.read_rows(first.rows().len() as u32).map_err(unread)?;
        let band_row = size.width() as usize * bytes_per_pixel;
        let check = |&tile: &TileId| -> Option<(u32, bool)> {
            let area = grid.area(tile);
            let mut go_on = || {
                if stop.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            let rendered = render_tile(&prepared, &settings.quality, area, isa, &mut go_on)?;
            let expected = format.encode(pixel_bytes(&rendered.pixels), transfer);
            let from = (area.x0() - grid.window().x0()) as usize * bytes_per_pixel;
            let length = area.width() as usize * bytes_per_pixel;
            let there = band.chunks_exact(band_row).map(|row| &row[from..from + length]);
            let mut rows = std::iter::zip(there, expected.chunks_exact(length));
            Some((tile.number(), rows.all(|(there, expected)| there == expected)))
        };
        let checked: Option<Vec<(u32, bool)>> =
            pool.install(|| tiles.par_iter().map(check).collect());
        let Some(checked) = checked else { return Ok(None) };
        found.checked += checked.len();
        found.wrong.extend(checked.iter().filter(|(_, same)| !same).map(|(number, _)| number));
    }
    Ok(Some(found))
}

/// Reads and prepares the scene as the picture says that it was.
fn prepare(
    args: &VerifyArgs,
    text: &SceneText,
    provenance: &Provenance,
    form: Form,
) -> Result<Order, Failure> {
    let request = RenderRequest {
        name: args.scene.name(),
        strict: false,
        size: Some(provenance.settings.size),
        crop: Some(provenance.grid.window().into()),
        quality: provenance.settings.quality,
        tile_side: Some(provenance.grid.side().into()),
        transfer: provenance.transfer,
        format: provenance.format,
        form,
    };
    let files = SceneFiles::new(&args.scene);
    let placed = request.place(text, &|name: &str| files.read(name));
    placed.order.map_err(|refusal| {
        Failure::Input(match refusal {
            Refusal::Scene => {
                anyhow!("{name} is wrong; `rtfarm check {name}` says how", name = args.scene.name())
            }
            Refusal::Other(reason) => anyhow!("cannot render {}: {reason}", args.scene.name()),
        })
    })
}

/// Which of `count` tiles are rendered again: nobody who lacks the key knows before, unless all
/// are.
fn choose(share: TileShare, count: u32, key: [u8; 32]) -> impl Fn(u32) -> bool + Sync {
    let wanted = match share {
        TileShare::All => count,
        TileShare::Some(wanted) => wanted.min(count),
        TileShare::Few => (count / 32).clamp(8, 1024).min(count),
    };
    // Of each run of `count / wanted` tiles one, at a place that is drawn.
    let (count, wanted) = (u64::from(count), u64::from(wanted));
    move |number: u32| {
        let run = u64::from(number) * wanted / count;
        let first = (run * count).div_ceil(wanted);
        let length = ((run + 1) * count).div_ceil(wanted) - first;
        let hash = blake3::keyed_hash(&key, &run.to_le_bytes());
        let drawn = u64::from_le_bytes(*hash.as_bytes().first_chunk().expect("it has 32 bytes"));
        u64::from(number) == first + drawn % length
    }
}

/// Bytes that nobody can foretell.
fn random_key() -> io::Result<[u8; 32]> {
    let mut key = [0; 32];
    rustix::rand::getrandom(&mut key, rustix::rand::GetRandomFlags::empty())?;
    Ok(key)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_tiles_are_chosen_as_are_wanted_and_each_may_be() {
        for (count, wanted) in [(1, 1), (7, 3), (96, 96), (1000, 31), (5, 9)] {
            let mut seen = vec![false; count as usize];
            for number in 0_u32..1000 {
                let key = *blake3::hash(&number.to_le_bytes()).as_bytes();
                let chosen = choose(TileShare::Some(wanted), count, key);
                let tiles: Vec<u32> = (0..count).filter(|&tile| chosen(tile)).collect();
                assert_eq!(tiles.len() as u32, wanted.min(count), "{count} {wanted}");
                for &tile in &tiles {
                    seen[tile as usize] = true;
                }
            }
            assert!(seen.iter().all(|&seen| seen), "{count} {wanted}");
        }
        let all = choose(TileShare::All, 64, [0; 32]);
        assert!((0..64).all(all));
    }
}
