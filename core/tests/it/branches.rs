//! Branches that are followed by chance: right on average, cheap, and bounded in memory and in the
//! work between two reports of progress.

use std::{env, fmt::Write, fs, ops::ControlFlow, process::Command};

use glam::DVec3;
use rayon::prelude::*;
use rtfarm_core::{
    isa::Isa,
    prepared::{PreparedBytes, PreparedScene},
    render::{Quality, RenderedTile, Tally, render_tile},
    scene::{Scene, Texture},
    testing::render_trees,
    tile::Area,
};
use rtfarm_oracle::hard_case::{HardCase, few_rays};

use crate::support::{
    parts::{join, sphere, upright},
    studio::{prepared, quality, read, settings, whole},
};

/// The weight that light branches get when they survive.
const FULL_WEIGHT: f64 = 1.0 / 256.0;

/// How many rays may be traced between two reports of progress.
const RAYS_A_REPORT: u64 = 256;

/// A screen of 2 x 2 at z = 2.5, seen from z = 5.
const VIEWPORT: &str = "viewport origin 0 0 5 topleft -1 1 2.5 bottomleft -1 -1 2.5
    topright 1 1 2.5 endviewport ";

fn scene(materials: &str, lights: &str, geometry: &str) -> Scene {
    read(&format!(
        "{VIEWPORT} materials entry name white endentry {materials} endmaterials
        lights {lights} endlights geometry {geometry} endgeometry"
    ))
}

/// A square at this z, its front to the eye.
fn pane(z: f64, material: &str) -> String {
    format!(
        "quadrangle vertex -1e6 -1e6 {z:?} vertex 1e6 -1e6 {z:?} vertex 1e6 1e6 {z:?}
        vertex -1e6 1e6 {z:?} material {material} endquadrangle "
    )
}

fn render(scene: &PreparedScene<PreparedBytes>, quality: &Quality, area: Area) -> RenderedTile {
    let go_on = &mut || ControlFlow::Continue(());
    render_tile(scene, quality, area, Isa::fastest(), go_on).expect("nobody stops it")
}

/// Numbers that estimate one: their mean, its standard error, and their root mean square about
/// `truth`.
fn statistics(numbers: &[f64], truth: f64) -> (f64, f64, f64) {
    let count = numbers.len() as f64;
    let mean = numbers.iter().sum::<f64>() / count;
    let about = |center: f64| numbers.iter().map(|x| (x - center) * (x - center)).sum::<f64>();
    (mean, (about(mean) / (count - 1.0) / count).sqrt(), (about(truth) / count).sqrt())
}

/// In a scene that looks the same through every pixel, the mean over many pixels of one sample is
/// the truth within 3 standard errors; one sample is by less than `steps` of 8 bits off, rms.
fn check_uniform(what: &str, scene: &Scene, truth: f64, steps: f64) -> Tally {
    let settings = settings(64, few_rays(64) as u64, 1);
    let tile = render(&prepared(scene), &settings.quality, whole(settings.size));
    let seen: Vec<f64> = tile.pixels.iter().map(|pixel| f64::from(pixel[0])).collect();
    let (mean, error, noise) = statistics(&seen, truth);
    let sigmas = (mean - truth) / error.max(1e-7);
    eprintln!(
        "{what}: {mean:.6}, truly {truth:.6}, {sigmas:+.1} sigma; one sample is {:.2}/255 off",
        255.0 * noise
    );
    assert!((mean - truth).abs() <= 3.0 * error + 1e-7, "{what}: {mean} ± {error}, truly {truth}");
    assert!(noise < steps / 255.0, "{what}: {noise}");
    tile.tally
}

#[test]
fn parallel_mirrors_add_up_a_geometric_series_and_report_the_rest() {
    for share in [0.25_f64, 0.5, 0.9, 0.95, 0.99, 1.0] {
        let materials = format!("entry name mirror reflect {share:?} endentry");
        let mirrors = pane(0.0, "mirror") + &pane(6.0, "mirror");
        let rest = share.powi(65);
        let scene = scene(&materials, "", &mirrors);
        let tally = check_uniform(&format!("mirrors of {share}"), &scene, 1.0 - rest, 1.0);
        let untraced = tally.untraced / tally.samples as f64;
        // The rest of a sample is all of it, or one light branch by chance.
        let error = (rest * FULL_WEIGHT / tally.samples as f64).sqrt();
        assert!((untraced - rest).abs() <= 3.0 * error + 1e-12, "{share}: {untraced} untraced");
        let most = if rest < FULL_WEIGHT { FULL_WEIGHT * share } else { rest };
        assert!(tally.most_untraced <= most * (1.0 + 1e-12), "{share}: {}", tally.most_untraced);
    }
    HardCase::ParallelMirrors
        .tell("parallel mirrors add up a geometric series", "mean within 3 standard errors");
}

#[test]
fn light_between_panes_adds_up_its_series() {
    // Black panes that mirror r and let t through, before a white wall: the transfer of one is
    // (t, r), and of two that stand before each other (t t' / (1 - r r'), r + t² r' / (1 - r r')).
    for (reflect, alpha, steps) in [
        (0.5_f64, 0.0, 1.0),
        (0.4, 0.0, 1.0),
        (0.3, 0.1, 1.1),
        (0.05, 0.3, 1.0),
        (0.8, 0.5, 1.3),
        (0.8, 0.0, 2.0),
    ] {
        for count in 2..=4 {
            let one = ((1.0 - reflect) * (1.0 - alpha), reflect);
            let add = |(t, r): (f64, f64), _| {
                let between = 1.0 - r * one.1;
                (t * one.0 / between, r + t * t * one.1 / between)
            };
            // The wall takes in what comes to it, and shows 1.
            let (through, _) = (1..count).fold(one, add);
            let (seen, rest) = through_panes(count as usize, one, 64);
            assert!(seen <= through + 1e-12 && through <= seen + rest + 1e-12, "{seen}, {rest}");
            let materials =
                format!("entry name pane color 0 0 0 alpha {alpha:?} reflect {reflect:?} endentry");
            let panes: String =
                (0..count).map(|k| pane(1.0 - f64::from(k), "pane")).collect::<String>();
            let scene = scene(&materials, "", &(panes + &pane(-9.0, "white")));
            let what = format!("{count} panes of {reflect}, {alpha}");
            let tally = check_uniform(&what, &scene, seen, steps);
            let untraced = tally.untraced / tally.samples as f64;
            let error = (rest * FULL_WEIGHT / tally.samples as f64).sqrt();
            assert!((untraced - rest).abs() <= 3.0 * error + 2e-6, "{untraced}, truly {rest}");
        }
    }
}

/// What comes through panes of a transfer (transmitted, mirrored) by rays of at most this depth,
/// and what is on its way then.
fn through_panes(count: usize, (t, r): (f64, f64), deepest: u32) -> (f64, f64) {
    // The light between the panes, downwards and upwards; the first is before all of them.
    let (mut down, mut up) = (vec![0.0; count + 1], vec![0.0; count + 1]);
    let mut seen = 0.0;
    down[0] = 1.0;
    for _ in 0..=deepest {
        let (was_down, was_up) = (down.clone(), up.clone());
        seen += was_down[count];
        (down, up) = (vec![0.0; count + 1], vec![0.0; count + 1]);
        for k in 0..count {
            down[k + 1] += t * was_down[k] + r * was_up[k + 1];
            up[k] += r * was_down[k] + t * was_up[k + 1];
        }
    }
    (seen, down.iter().chain(&up).sum())
}

/// The room of `scenes/glass.rt`, seen out of a ball of this material in which light is turned back
/// many times.
fn inside_ball(material: &str) -> Scene {
    let floor = "quadrangle vertex -8 0 8 vertex 8 0 8 vertex 8 0 -3 vertex -8 0 -3 material light
        endquadrangle quadrangle vertex -8 0 -3 vertex 8 0 -3 vertex 8 1.2 -3 vertex -8 1.2 -3
        material dark endquadrangle ";
    let balls = sphere(DVec3::new(0.0, 0.9, 0.0), 0.8, "glass")
        + &sphere(DVec3::new(-1.1, 0.35, -1.2), 0.35, "red")
        + &sphere(DVec3::new(1.3, 0.45, -0.8), 0.45, "red");
    read(&format!(
        "viewport origin 0.72 0.9 0 topleft -0.35 1.7 0.2 bottomleft -0.35 0.1 0.2
            topright 0.35 1.7 -1.2 background 170 200 230 endviewport
        materials entry name light color 225 215 190 endentry
            entry name dark color 110 90 80 endentry entry name red color 210 60 50 endentry
            entry name glass color 220 240 230 {material} endentry endmaterials
        lights ambient 0.25 reference power 100 distance 6 endreference
            point coords 2.5 6 3 power 110 endpoint endlights
        geometry {floor} {balls} endgeometry"
    ))
}

/// Pictures of single samples in the middles of pixels, one for each seed: their means are those of
/// the whole trees of branches within their noise, and the noise of one is small.
fn check_against_trees(what: &str, scene: &Scene, seeds: u64) -> (f64, f64) {
    let (block, settings) = (prepared(scene), settings(64, 48, 1));
    let area = whole(settings.size);
    let flattened = |tile: RenderedTile| tile.pixels.into_flattened();
    let trees = flattened(render_trees(&block, &settings.quality, area, Isa::fastest(), 1e-6));
    let pictures: Vec<(Tally, Vec<f32>)> = (0..seeds)
        .into_par_iter()
        .map(|seed| {
            let tile = render(&block, &quality(1, seed), area);
            (tile.tally, tile.pixels.into_flattened())
        })
        .collect();
    let (mut squares, mut noise) = (0.0, 0.0);
    for (k, &truth) in trees.iter().enumerate() {
        let seen: Vec<f64> = pictures.iter().map(|(_, seen)| f64::from(seen[k])).collect();
        let (mean, error, noise_here) = statistics(&seen, truth.into());
        noise += noise_here * noise_here / trees.len() as f64;
        // Branches so light that none survived may be one survivor short.
        let short = FULL_WEIGHT / seeds as f64;
        squares += (mean - f64::from(truth)).powi(2) / (error * error + short * short);
    }
    let total = |seen: &[f32]| seen.iter().map(|x| f64::from(*x)).sum::<f64>() / seen.len() as f64;
    let totals: Vec<f64> = pictures.iter().map(|(_, seen)| total(seen)).collect();
    let (mean, error, _) = statistics(&totals, 0.0);
    let sigmas = (mean - total(&trees)) / error;
    let tally = pictures[0].0;
    let (noise, rays) = (255.0 * f64::sqrt(noise), tally.rays as f64 / tally.samples as f64);
    // Student's: the square of such a mean over its own error is (n - 1) / (n - 3) on average.
    let spread = squares / trees.len() as f64 / ((seeds - 1) as f64 / (seeds - 3) as f64);
    eprintln!(
        "{what}: {rays:.0} rays a sample, noise {noise:.2}/255 of one; the picture's mean \
        {sigmas:+.1} sigma off, its pixels {:.2} sigma",
        spread.sqrt()
    );
    assert!(sigmas.abs() < 3.0, "{what}: {mean} ± {error}, truly {}", total(&trees));
    assert!(spread < 1.2, "{what}: {spread}");
    (noise, rays)
}

#[test]
fn mirroring_glass_around_the_eye_shows_what_all_its_branches_do() {
    let scene = inside_ball("refract 0.667 reflect 0.05 alpha 0.1");
    let (noise, rays) = check_against_trees("a ball", &scene, few_rays(32) as u64);
    assert!(noise < 1.0 && rays < 400.0, "noise {noise}, {rays} rays a sample");
    HardCase::InsideMirroringGlass.tell(
        "glass that mirrors, around the eye, shows on average what all its branches do",
        format!("{rays:.0} rays a sample, which is {noise:.2}/255 off"),
    );
    for (what, material) in [
        ("a ball that mirrors much", "refract 0.667 reflect 0.4 alpha 0.1"),
        ("a ball without loss", "refract 0.8 reflect 0.2 alpha 0"),
    ] {
        check_against_trees(what, &inside_ball(material), few_rays(16) as u64);
    }
}

#[test]
fn a_white_world_stays_white_on_average_whatever_branches() {
    for (reflect, alpha, refract) in [(0.5, 0.0, 0.7), (0.2, 0.05, 0.667), (0.05, 0.5, 1.5)] {
        let materials = format!(
            "entry name glass alpha {alpha:?} reflect {reflect:?} refract {refract:?} endentry"
        );
        let mut scene = scene(
            &materials,
            "ambient 1",
            &(sphere(DVec3::ZERO, 1.3, "glass")
                + &upright(DVec3::new(-0.5, -0.7, -0.9), DVec3::new(0.7, 0.6, 0.4), "glass")
                + &sphere(DVec3::new(0.0, 0.0, 5.0), 0.7, "glass")),
        );
        scene.background = DVec3::ONE;
        check_uniform(&format!("a world of {reflect}, {alpha}"), &scene, 1.0, 1.0);
    }
}

/// 64 shells of glass inside each other, which mirror much and lose nothing.
fn shells() -> Scene {
    let balls: String =
        (0..64).map(|k| sphere(DVec3::ZERO, 1.3 - 0.015 * f64::from(k), "glass")).collect();
    scene("entry name glass alpha 0 reflect 0.5 refract 0.98 endentry", "", &balls)
}

/// Shells that also send light on, before a wall with a texture: everything that takes memory.
fn lit_shells() -> Scene {
    let mut balls = String::new();
    for k in 0..64 {
        balls += &sphere(DVec3::ZERO, 1.3 - 0.015 * f64::from(k), "glass");
    }
    let solid = join(
        "difference",
        &[
            &upright(DVec3::splat(-3.0), DVec3::new(3.0, 3.0, 0.0), "glass"),
            &sphere(DVec3::ZERO, 1.4, "glass"),
        ],
    );
    let lamps =
        "ambient 0.1 point coords 3 4 5 power 1 endpoint point coords -3 4 5 power 1 endpoint";
    let glass = "entry name glass alpha 0.02 reflect 0.3 refract 0.98 endentry";
    let mut scene = scene(glass, lamps, &(balls + &solid + &pane(-9.0, "white")));
    let texels = vec![[255, 0, 0], [0, 255, 0]];
    scene.textures.push(Texture { path: String::new(), width: 2, height: 1, texels });
    scene.materials[0].texture = Some(0);
    scene
}

#[test]
fn a_pixel_is_the_same_whatever_is_traced_with_it() {
    let block = prepared(&shells());
    // 400 samples fill no batch but, at some depth, many queues.
    let settings = settings(9, 5, 9);
    let all = render(&block, &settings.quality, whole(settings.size));
    assert!(all.tally.rays > 100 * all.tally.samples, "{:?}", all.tally);
    for (k, pixel) in (0..).zip(&all.pixels) {
        let area = Area::new(settings.size, [k % 9, k / 9], [1, 1]).unwrap();
        assert_eq!(render(&block, &settings.quality, area).pixels, [*pixel], "pixel {k}");
    }
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
        let go_on = &mut || ControlFlow::Continue(());
        let other = render_tile(&block, &settings.quality, whole(settings.size), isa, go_on);
        assert_eq!(other, Some(all.clone()), "{isa}");
    }
}

const PROBE: &str = "RTFARM_MEMORY_PROBE";

/// The most memory that this process has held, in MB.
fn peak_memory() -> f64 {
    let status = fs::read_to_string("/proc/self/status").expect("Linux tells");
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("its peak");
    line.trim().trim_end_matches(" kB").parse::<f64>().expect("a number") / 1000.0
}

#[test]
fn no_material_takes_much_memory() {
    // In a process of its own: others' memory would count.
    if env::var_os(PROBE).is_none() {
        let this = env::current_exe().expect("this test has a file");
        let mut child = Command::new(this);
        child.args(["--exact", "branches::no_material_takes_much_memory", "--nocapture"]);
        let done = child.env(PROBE, "1").output().expect("it runs again");
        eprint!("{}", String::from_utf8_lossy(&done.stderr));
        assert!(done.status.success());
        return;
    }
    for (what, scene) in [("shells", shells()), ("lit shells", lit_shells())] {
        let (block, settings) = (prepared(&scene), settings(32, 16, 4));
        let before = peak_memory();
        let tally = render(&block, &settings.quality, whole(settings.size)).tally;
        let more = peak_memory() - before;
        let rays = tally.rays / tally.samples;
        eprintln!("{what}: {rays} rays a sample, {more:.1} MB beyond the scene");
        assert!(rays > 200 && more <= 32.0, "{what}: {more} MB, {rays} rays a sample");
    }
}

#[test]
fn progress_is_reported_within_a_batch_and_a_depth() {
    let mut lamps = "ambient 0.1 ".to_owned();
    for k in 0..200 {
        write!(lamps, "point coords {k} 9 9 power 1 endpoint ").unwrap();
    }
    let matte = scene("", &lamps, &pane(0.0, "white"));
    for (what, scene) in
        [("shells", shells()), ("lit shells", lit_shells()), ("one depth and 200 lamps", matte)]
    {
        // Few enough samples for one batch.
        let settings = settings(16, 16, 4);
        let mut reports = 0;
        let on_progress = &mut || {
            reports += 1;
            ControlFlow::Continue(())
        };
        let area = whole(settings.size);
        let tile =
            render_tile(&prepared(&scene), &settings.quality, area, Isa::fastest(), on_progress);
        let rays = tile.expect("nobody stops it").tally.rays;
        eprintln!("{what}: {rays} rays, {reports} reports");
        assert!(rays <= RAYS_A_REPORT * reports, "{what}: {rays} rays, {reports} reports");
        // And it stops at any of them.
        for wanted in [1, 2, reports / 2, reports] {
            let mut seen = 0;
            let on_progress = &mut || {
                seen += 1;
                if seen == wanted { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            let isa = Isa::fastest();
            let stopped = render_tile(&prepared(&scene), &settings.quality, area, isa, on_progress);
            assert_eq!((stopped, seen), (None, wanted), "{what}");
        }
    }
}
