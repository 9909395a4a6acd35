//! What a bottle costs that cannot be seen, and one that can, as its triangles grow: seconds a
//! picture with the bottle behind the eye and out of every shadow's way, and nodes visited by a
//! ray with the bottle in view.
//!
//!     cargo bench -p rtfarm-core --bench gnome

#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]
#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock and makes a bottle")]

mod bottle;

use std::{ops::ControlFlow, time::Instant};

use bottle::bottle;
use glam::DVec3;
use rtfarm_core::{
    isa::Isa,
    prepare::prepare,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, Sampling, Settings, render_tile},
    scene::{Scene, Sphere, Viewport},
    testing::{Probe, Probing},
    tile::{Area, Size},
};

const COUNTS: [usize; 5] = [1_000, 10_000, 100_000, 1_000_000, 4_000_000];
const ROUNDS: usize = 9;

fn main() {
    let scenes: Vec<(usize, PreparedScene<PreparedBytes>)> = COUNTS
        .into_iter()
        .map(|count| {
            let bytes = prepare(&away(bottle(count))).expect("a plain scene");
            (count, PreparedScene::open(bytes).expect("a valid block"))
        })
        .collect();
    // In turns, so that the machine's moods strike all alike.
    let mut seconds = vec![Vec::new(); scenes.len()];
    for _ in 0..ROUNDS {
        for ((_, scene), seconds) in scenes.iter().zip(&mut seconds) {
            seconds.push(render(scene));
        }
    }
    let medians: Vec<f64> = seconds
        .into_iter()
        .map(|mut seconds| {
            seconds.sort_by(f64::total_cmp);
            seconds[ROUNDS / 2]
        })
        .collect();
    println!("the bottle behind the eye, one thread, medians of {ROUNDS}");
    for ((count, _), median) in scenes.iter().zip(&medians) {
        let ratio = median / medians[0];
        println!("{count:8} triangles: {:.1} ms a picture, {ratio:.3} of the first", median * 1e3);
    }
    drop(scenes);

    println!("the bottle in view");
    for count in COUNTS {
        let scene = bottle(count);
        let rays = eye_rays(&scene);
        let bytes = prepare(&scene).expect("a plain scene");
        let scene = PreparedScene::open(bytes).expect("a valid block");
        let visits: u64 = scene.count_visits(&rays).into_iter().map(u64::from).sum();
        let visits = visits as f64 / rays.len() as f64;
        let logarithm = (count as f64).log2();
        let ratio = visits / logarithm;
        println!("{count:8} triangles: {visits:.2} nodes a ray, {ratio:.3} a doubling");
    }
}

/// The bottle behind the eye, which looks at some balls; the lights are on the balls' side.
fn away(mut scene: Scene) -> Scene {
    let first = (scene.triangles.len() + scene.quadrangles.len()) as u32;
    scene.spheres = (0..40)
        .map(|k: u32| {
            let (x, z) = (f64::from(k % 8) - 3.5, 8.0 + f64::from(k / 8));
            let center = DVec3::new(x, 0.45, z);
            Sphere { center, radius: 0.45, material: 0, primitive: first + k }
        })
        .collect();
    for light in &mut scene.lights {
        light.position.z += 6.0;
    }
    scene.viewport = Some(Viewport {
        eye: DVec3::new(0.0, 2.0, 4.0),
        top_left: DVec3::new(1.6, 2.4, 6.0),
        bottom_left: DVec3::new(1.6, 0.6, 6.0),
        top_right: DVec3::new(-1.6, 2.4, 6.0),
    });
    scene
}

fn render(scene: &PreparedScene<PreparedBytes>) -> f64 {
    let size = Size::new(320, 180).expect("a size");
    let settings = Settings {
        size,
        quality: Quality { sampling: Sampling::fixed(4).unwrap(), ..Quality::default() },
    };
    let area = Area::whole(size);
    let start = Instant::now();
    let on_progress = &mut || ControlFlow::Continue(());
    render_tile(scene, &settings.quality, area, Isa::fastest(), on_progress)
        .expect("nobody stops it");
    start.elapsed().as_secs_f64()
}

fn eye_rays(scene: &Scene) -> Vec<Probe> {
    let viewport = scene.viewport.expect("the bottle's own");
    let right = viewport.top_right - viewport.top_left;
    let down = viewport.bottom_left - viewport.top_left;
    (0..160 * 90)
        .map(|k: u32| {
            let (u, v) = ((f64::from(k % 160) + 0.5) / 160.0, (f64::from(k / 160) + 0.5) / 90.0);
            let direction = viewport.top_left + u * right + v * down - viewport.eye;
            Probe { origin: viewport.eye, direction: direction.normalize(), leaving: None }
        })
        .collect()
}
