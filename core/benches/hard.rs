//! Hard cases that are about time: numbers next to zero, and many faces in one place.
//!
//!     cargo bench -p rtfarm-core --bench hard

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock and makes a bottle")]

mod bottle;

use std::{ops::ControlFlow, time::Instant};

use bottle::bottle;
use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::PreparedScene,
    render::{Quality, Sampling, render_tile},
    scene::{Scene, Viewport},
    tile::{Area, Size},
};
use rtfarm_oracle::hard_case::HardCase;

const FACES: usize = 100_000;
const ROUNDS: usize = 9;

fn main() {
    let plain = tilted(0.0);
    let denormal = tilted(1e-310);
    let ratio = ratio_of_medians(|| picture(&denormal), || picture(&plain));
    let row = HardCase::Denormal.row();
    println!(
        "case {row}: denormal coordinates and directions, time over that of zeros: {ratio:.2}"
    );

    let normal = bottle(FACES);
    let coincident = coincident();
    let build = |scene: &Scene| drop(prepare(scene).expect("a plain scene"));
    let ratio = ratio_of_medians(|| build(&coincident), || build(&normal));
    let row = HardCase::ManyFacesInOnePlace.row();
    println!(
        "case {row}: preparing 1e5 coincident triangles, time over that of a mesh: {ratio:.2}"
    );
}

/// Seconds of one over seconds of the other: medians of runs in turns.
fn ratio_of_medians(mut one: impl FnMut(), mut other: impl FnMut()) -> f64 {
    let mut seconds = [Vec::new(), Vec::new()];
    for _ in 0..ROUNDS {
        for (run, seconds) in
            [&mut one as &mut dyn FnMut(), &mut other].into_iter().zip(&mut seconds)
        {
            let start = Instant::now();
            run();
            seconds.push(start.elapsed().as_secs_f64());
        }
    }
    let [one, other] = seconds.map(|mut seconds| {
        seconds.sort_by(f64::total_cmp);
        seconds[ROUNDS / 2]
    });
    one / other
}

/// The bottle, its smallest coordinates and the screen's zeros replaced.
fn tilted(zero: f64) -> Scene {
    let near_zero = |point: DVec3| {
        DVec3::from_array(point.to_array().map(|x| if x.abs() < 0.02 { zero } else { x }))
    };
    let mut scene = bottle(FACES);
    for triangle in &mut scene.triangles {
        triangle.vertices = triangle.vertices.map(near_zero);
    }
    let Viewport { eye, top_left, bottom_left, top_right } =
        scene.viewport.expect("the bottle has one");
    let [eye, top_left, bottom_left, top_right] =
        [eye, top_left, bottom_left, top_right].map(near_zero);
    scene.viewport = Some(Viewport { eye, top_left, bottom_left, top_right });
    scene
}

/// The bottle's first triangle, over and over.
fn coincident() -> Scene {
    let mut scene = bottle(FACES);
    let vertices = scene.triangles[0].vertices;
    for triangle in &mut scene.triangles {
        triangle.vertices = vertices;
    }
    scene
}

fn picture(scene: &Scene) {
    let scene = PreparedScene::open(prepare(scene).expect("a plain scene")).expect("valid");
    let size = Size::new(160, 120).expect("a size");
    let quality = Quality { sampling: Sampling::fixed(4).unwrap(), ..Quality::default() };
    let go_on = &mut || ControlFlow::Continue(());
    render_tile(&scene, &quality, Area::whole(size), Isa::fastest(), go_on);
}
