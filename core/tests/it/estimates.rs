//! How well the error that a render tells predicts the true one, and what it saves to sample only
//! where that is large. Pictures with closed forms are the truth.

#![expect(clippy::disallowed_methods, reason = "slopes of errors reach no pixel")]

use std::{fmt::Write, ops::ControlFlow};

use rtfarm_core::{
    isa::Isa,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, RenderedTile, Sampling, Settings, render_tile},
    tile::Size,
};
use rtfarm_oracle::{
    hard_case::{HardCase, few_rays},
    known_pictures::{KnownPicture, checkerboard, indirect_pictures, known_pictures},
};

use crate::support::studio::{prepared, read, whole};

const SEEDS: u64 = 16;

fn render(
    scene: &PreparedScene<PreparedBytes>,
    known: &KnownPicture,
    sampling: Sampling,
    seed: u64,
) -> RenderedTile {
    let settings =
        Settings { size: known.size, quality: Quality { sampling, seed, ..Quality::default() } };
    let go_on = &mut || ControlFlow::Continue(());
    render_tile(scene, &settings.quality, whole(known.size), Isa::fastest(), go_on).unwrap()
}

/// The true mean square error, over all channels.
fn square_error(rendered: &RenderedTile, known: &KnownPicture) -> f64 {
    let squares = rendered.pixels.iter().zip(&known.truth).flat_map(|(pixel, truth)| {
        [0, 1, 2].map(|c| (f64::from(pixel[c]) - truth[c]) * (f64::from(pixel[c]) - truth[c]))
    });
    squares.sum::<f64>() / (3 * known.truth.len()) as f64
}

fn adaptive(steps: f64) -> Sampling {
    Sampling::adaptive(steps / 255.0, 256).unwrap()
}

/// Told over true error for every scene, sampling and seed.
fn check_calibration(samplings: &[Sampling]) {
    let mut all = Vec::new();
    for known in known_pictures(32) {
        let scene = prepared(&known.scene);
        for &sampling in samplings {
            let mut ratios: Vec<f64> = (0..SEEDS)
                .map(|seed| {
                    let rendered = render(&scene, &known, sampling, seed);
                    rendered.tally.error().unwrap() / square_error(&rendered, &known).sqrt()
                })
                .collect();
            ratios.sort_by(f64::total_cmp);
            let [low, middle, high] = [ratios[0], ratios[ratios.len() / 2], ratios[15]];
            eprintln!("{}: {sampling:?}: {low:.2} .. {middle:.2} .. {high:.2}", known.name);
            all.extend(ratios);
        }
    }
    all.sort_by(f64::total_cmp);
    let [low, median, high] = [all[0], all[all.len() / 2], all[all.len() - 1]];
    eprintln!("told over true: {low:.2} .. {median:.2} .. {high:.2}");
    assert!((0.8..=1.25).contains(&median), "{median}");
    assert!(low >= 0.5 && high <= 2.0, "{low} .. {high}");
}

#[test]
fn fixed_samples_tell_their_error() {
    check_calibration(&[8, 11, 16, 64, 256].map(|count| Sampling::fixed(count).unwrap()));
}

#[test]
fn adaptive_samples_tell_their_error() {
    check_calibration(&[16.0, 8.0, 4.0, 2.0, 1.0, 0.5].map(adaptive));
}

/// One sample a pixel, whose error only the neighbours' samples tell; seeds that no factor was
/// fitted to.
#[test]
fn one_sample_tells_its_error_beside_edges() {
    let pictures = known_pictures(96).into_iter().chain(indirect_pictures(96));
    for known in pictures.filter(|known| known.name != "checkerboard") {
        let scene = prepared(&known.scene);
        let mut ratios: Vec<f64> = (7000..7000 + SEEDS)
            .map(|seed| {
                let rendered = render(&scene, &known, adaptive(220.0), seed);
                rendered.tally.error().unwrap() / square_error(&rendered, &known).sqrt()
            })
            .collect();
        ratios.sort_by(f64::total_cmp);
        let [low, median, high] = [ratios[0], ratios[ratios.len() / 2], ratios[15]];
        eprintln!("{}: {low:.2} .. {median:.2} .. {high:.2}", known.name);
        assert!((0.8..=1.25).contains(&median), "{}: {median}", known.name);
        assert!(low >= 0.5 && high <= 2.0, "{}: {low} .. {high}", known.name);
    }
}

#[test]
fn the_error_of_a_textures_filter_is_told_with_the_samples() {
    let known = checkerboard(Size::new(48, 36).unwrap());
    let scene = prepared(&known.scene);
    let fixed = [8, 16, 64, 256].map(|count| Sampling::fixed(count).unwrap());
    let all = fixed.into_iter().chain([16.0, 8.0, 4.0, 2.0, 1.0].map(adaptive));
    let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
    for sampling in all {
        for seed in 0..few_rays(2) as u64 {
            let rendered = render(&scene, &known, sampling, seed);
            let square = square_error(&rendered, &known);
            let ratio = rendered.tally.error().unwrap() / square.sqrt();
            let each = rendered.tally.samples as f64 / known.size.pixel_count() as f64;
            eprintln!("{sampling}, {seed}: {:.1e}, told over true {ratio:.2}", square.sqrt());
            (least, most) = (least.min(ratio), most.max(ratio));
            if matches!(sampling, Sampling::Adaptive { .. }) && seed == 0 {
                let fixed = fixed_samples_for(&known, square);
                eprintln!("{each:.1} samples, fixed {fixed:.1}");
                assert!(fixed > each, "{sampling}: {fixed} fixed for {each}");
            }
        }
    }
    HardCase::FilteredCheckerboard
        .tell("the error that is told over the true one", format!("{least:.2} to {most:.2}"));
    assert!(least >= 0.5 && most <= 2.0, "{least} .. {most}");
}

/// The samples that a fixed number in every pixel takes for that mean square error, between two
/// powers of two by the slope of the errors.
fn fixed_samples_for(known: &KnownPicture, square: f64) -> f64 {
    let scene = prepared(&known.scene);
    let square_of =
        |count| square_error(&render(&scene, known, Sampling::fixed(count).unwrap(), 3), known);
    let (mut count, mut before) = (8, square_of(8));
    loop {
        let after = square_of(2 * count);
        if after < square || count > 2048 {
            let part = (before / square).ln() / (before / after).ln();
            return f64::from(count) * part.exp2();
        }
        (count, before) = (2 * count, after);
    }
}

#[test]
fn adaptive_samples_take_a_third_of_the_rays_where_there_are_edges() {
    for known in
        known_pictures(96).into_iter().filter(|known| known.name != "lamp" && known.name != "ball")
    {
        let scene = prepared(&known.scene);
        for steps in [2.0, 1.0] {
            let rendered = render(&scene, &known, adaptive(steps), 0);
            let square = square_error(&rendered, &known);
            let each = rendered.tally.samples as f64 / known.size.pixel_count() as f64;
            let fixed = fixed_samples_for(&known, square);
            eprintln!(
                "{}, {steps}/255: error {:.1e}, {each:.1} samples, fixed {fixed:.0}: {:.1} x",
                known.name,
                square.sqrt(),
                fixed / each
            );
            assert!(fixed > 3.0 * each, "{}: {fixed} fixed for {each}", known.name);
        }
    }
}

#[test]
fn what_the_file_clips_gets_no_more_samples() {
    // A lamp that is much too bright, and balls that shade each other.
    let text = "viewport origin 0 0 5 topleft -2 1.5 0 bottomleft -2 -1.5 0 topright 2 1.5 0
        endviewport materials entry name a endentry entry name m reflect 0.5 endentry endmaterials
        lights reference power 100 distance 6 endreference
            point coords 3 4 6 color 255 255 100 power 900 endpoint endlights
        geometry quadrangle vertex -9 -9 -2 vertex 9 -9 -2 vertex 9 9 -2 vertex -9 9 -2 material a
            endquadrangle sphere coords -0.5 0 0 radius 0.6 material m endsphere
            sphere coords 0.8 0.4 0.4 radius 0.5 material a endsphere endgeometry";
    let scene = prepared(&read(text));
    let size = Size::new(96, 72).unwrap();
    let picture = |sampling, clips| {
        let quality = Quality { sampling, clips, ..Quality::default() };
        let go_on = &mut || ControlFlow::Continue(());
        render_tile(&scene, &quality, whole(size), Isa::fastest(), go_on).unwrap()
    };
    let truth = picture(Sampling::fixed(1024).unwrap(), false);
    let clip = |tile: &RenderedTile| -> Vec<f64> {
        tile.pixels.as_flattened().iter().map(|&c| f64::from(c).min(1.0)).collect()
    };
    let truth = clip(&truth);
    let [plain, clipped] = [false, true].map(|clips| {
        let tile = picture(adaptive(1.0), clips);
        let off = clip(&tile).iter().zip(&truth).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
        let (true_error, told) = ((off / truth.len() as f64).sqrt(), tile.tally.error().unwrap());
        eprintln!(
            "clips {clips}: {} samples, {true_error:.1e}, told {told:.1e}",
            tile.tally.samples
        );
        (tile.tally.samples, true_error, told)
    });
    assert!(clipped.0 * 4 < plain.0 * 3, "{} of {}", clipped.0, plain.0);
    assert!(clipped.1 < 1.0 / 255.0 && clipped.1 < 1.25 * plain.1, "{} {}", clipped.1, plain.1);
    assert!((0.5..2.0).contains(&(clipped.2 / clipped.1)), "{} {}", clipped.2, clipped.1);
}

/// Upright wires of that width in pixels, every fourth column, in a picture of 96 x 72: how much
/// of their light the adaptive picture and one of 64 samples lack.
fn missing_light(width: f64) -> [f64; 2] {
    const PIXEL: f64 = 4.0 / 96.0;
    let mut text = "viewport origin 0 0 5 topleft -2 1.5 0 bottomleft -2 -1.5 0 topright 2 1.5 0
        endviewport materials entry name a endentry endmaterials geometry\n"
        .to_owned();
    for k in 0..22 {
        // Leaning, so that a wire crosses its pixels at all places.
        let (x, lean) = (-1.9 + 4.1 * PIXEL * f64::from(k), 0.9 * PIXEL);
        let right = x + width * PIXEL;
        writeln!(
            text,
            "quadrangle vertex {x} -1.4 0 vertex {right} -1.4 0 vertex {} 1.4 0 vertex {} 1.4 0
             material a endquadrangle",
            right + lean,
            x + lean
        )
        .unwrap();
    }
    let size = Size::new(96, 72).unwrap();
    let scene = read(&(text + "endgeometry"));
    let known = KnownPicture { name: "wires", scene, size, truth: Vec::new() };
    let scene = prepared(&known.scene);
    let truth = 22.0 * 2.8 * width * PIXEL / (PIXEL * PIXEL);
    [adaptive(1.0), Sampling::fixed(64).unwrap()].map(|sampling| {
        let pixels = render(&scene, &known, sampling, 1).pixels;
        1.0 - pixels.iter().map(|pixel| f64::from(pixel[0])).sum::<f64>() / truth
    })
}

#[test]
fn wires_that_64_samples_show_the_adaptive_picture_shows() {
    for (width, most) in [(0.5, 0.01), (0.25, 0.01), (0.125, 0.01), (0.0625, 0.02), (0.03125, 0.03)]
    {
        let [adaptive, fixed] = missing_light(width);
        eprintln!("width {width}: the adaptive picture lacks {adaptive:.3}, 64 samples {fixed:.3}");
        assert!(adaptive.abs() < most, "{width}: {adaptive}");
    }
}
