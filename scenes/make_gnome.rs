//! Writes `gnome.rt` to standard output: a garden gnome of spheres and his bottle, a lathe surface
//! of some 5,000 triangles, on a ground quadrangle under two lights.
//!
//!     cargo run --example make_gnome > scenes/gnome.rt

#![expect(clippy::disallowed_methods, reason = "numbers are written with four digits only")]

use std::{f64::consts::TAU, fmt::Write as _, io::Write as _};

const MATERIALS: [(&str, [u8; 3]); 14] = [
    ("ground", [132, 158, 96]),
    ("boot", [74, 50, 36]),
    ("trousers", [92, 84, 70]),
    ("coat", [46, 84, 168]),
    ("button", [232, 190, 70]),
    ("belt", [52, 40, 34]),
    ("skin", [242, 190, 158]),
    ("nose", [226, 122, 104]),
    ("eye", [28, 30, 40]),
    ("beard", [240, 238, 232]),
    ("hat", [204, 40, 38]),
    ("glass", [48, 128, 74]),
    ("label", [238, 226, 188]),
    ("cork", [176, 128, 82]),
];

fn main() -> std::io::Result<()> {
    let mut scene = String::from(
        "# A garden gnome and his bottle. Written by make_gnome.rs.\n\
         viewport\n\
         \torigin 0.5 2.1 7.6\n\
         \ttopleft -1.22 2.72 4\n\
         \tbottomleft -1.22 1 4\n\
         \ttopright 1.84 2.72 4\n\
         \tsize 1280 720\n\
         \tbackground 176 206 236\n\
         endviewport\n\
         materials\n",
    );
    for (name, [r, g, b]) in MATERIALS {
        line(&mut scene, format_args!("\tentry name {name} color {r} {g} {b} endentry"));
    }
    scene += "endmaterials\n\
              lights\n\
              \tambient 0.32\n\
              \treference power 100 distance 9 endreference\n\
              \tpoint coords 5.5 8 6.5 power 92 color 255 244 224 endpoint\n\
              \tpoint coords -6 5 5 power 30 color 206 224 255 endpoint\n\
              endlights\n\
              geometry\n\
              \tquadrangle vertex -40 0 40 vertex 40 0 40 vertex 40 0 -40 vertex -40 0 -40 \
              material ground endquadrangle\n";
    gnome(&mut scene, -0.75);
    bottle(&mut scene, 1.0, 0.4);
    scene += "endgeometry\n";
    std::io::stdout().write_all(scene.as_bytes())
}

fn line(scene: &mut String, text: std::fmt::Arguments<'_>) {
    writeln!(scene, "{text}").expect("a string takes all");
}

/// Balls, mirrored left and right where `sides` says so.
fn gnome(scene: &mut String, x: f64) {
    let mut ball = |dx: f64, y: f64, z: f64, radius: f64, material: &str| {
        let x = x + dx;
        line(
            scene,
            format_args!(
                "\tsphere coords {x:.4} {y:.4} {z:.4} radius {radius:.4} material {material} endsphere"
            ),
        );
    };
    for side in [-1.0, 1.0] {
        for k in 0..6 {
            let t = f64::from(k) / 5.0;
            ball(
                side * (0.27 + 0.05 * t),
                0.15 - 0.02 * t,
                0.05 + 0.34 * t,
                0.17 - 0.02 * t,
                "boot",
            );
            ball(side * (0.24 - 0.03 * t), 0.28 + 0.22 * t, 0.04, 0.17 + 0.03 * t, "trousers");
        }
        // The left arm hangs, the right one holds the bottle's shoulder.
        for k in 0..14 {
            let t = f64::from(k) / 13.0;
            let reach = if side > 0.0 { 0.72 * t } else { 0.22 * t };
            let drop = if side > 0.0 { 0.38 * t - 0.46 * t * t } else { 0.58 * t };
            ball(side * (0.42 + reach), 1.3 - drop, 0.1 + 0.34 * t * t, 0.17 - 0.04 * t, "coat");
        }
        let hand = if side > 0.0 { (1.2, 1.39, 0.47) } else { (-0.66, 0.66, 0.47) };
        ball(hand.0, hand.1, hand.2, 0.135, "skin");
        ball(hand.0 - side * 0.02, hand.1 + 0.09, hand.2 + 0.09, 0.055, "skin");
        ball(side * 0.15, 1.86, 0.335, 0.05, "eye");
        ball(side * 0.15 + 0.018, 1.876, 0.378, 0.014, "beard");
        ball(side * 0.2, 1.68, 0.27, 0.11, "nose");
        ball(side * 0.4, 1.74, 0.0, 0.09, "skin");
        for k in 0..7 {
            let t = f64::from(k) / 6.0;
            ball(
                side * (0.04 + 0.25 * t),
                1.6 - 0.06 * t * t,
                0.43 - 0.1 * t,
                0.075 - 0.045 * t,
                "beard",
            );
            ball(
                side * (0.08 + 0.13 * t),
                1.945 + 0.025 * (1.0 - t),
                0.345 - 0.02 * t,
                0.035,
                "beard",
            );
        }
    }
    ball(0.0, 0.72, 0.0, 0.53, "coat");
    ball(0.0, 1.0, 0.0, 0.48, "coat");
    ball(0.0, 1.24, 0.0, 0.38, "coat");
    for k in 0..48 {
        let angle = TAU * f64::from(k) / 48.0;
        ball(0.5 * angle.sin(), 0.84, 0.5 * angle.cos(), 0.055, "belt");
    }
    ball(0.0, 0.84, 0.55, 0.085, "button");
    for k in 0..3 {
        ball(0.0, 0.46 + 0.13 * f64::from(k), 0.5 + 0.035 * f64::from(k), 0.045, "button");
    }
    ball(0.0, 1.75, 0.0, 0.39, "skin");
    ball(0.0, 1.72, 0.43, 0.12, "nose");
    // The beard: rows of locks, narrower and farther down.
    for row in 0..13 {
        let t = f64::from(row) / 12.0;
        let locks = 15 - row;
        for k in 0..locks {
            let across = (f64::from(k) + 0.5) / f64::from(locks) * 2.0 - 1.0;
            let wave = 0.02 * (f64::from(7 * row + 3 * k)).sin();
            let angle = across * (1.25 - 0.85 * t);
            let distance = 0.4 + 0.16 * t - 0.1 * t * t;
            ball(
                distance * angle.sin() * (1.0 - 0.25 * t),
                1.6 - 0.7 * t + 0.1 * (1.0 - t) * across * across + wave,
                distance * angle.cos() + 0.03 - wave,
                0.105 - 0.045 * t,
                "beard",
            );
        }
    }
    // The hat: a cone that leans and curls.
    for k in 0..60 {
        let t = f64::from(k) / 59.0;
        let lean = t * t;
        ball(
            -0.3 * lean,
            2.12 + 0.98 * t - 0.08 * lean * t,
            -0.03 - 0.22 * lean,
            0.38 * (1.0 - t) + 0.045,
            "hat",
        );
    }
    for k in 0..40 {
        let angle = TAU * f64::from(k) / 40.0;
        ball(0.37 * angle.sin(), 2.07, 0.37 * angle.cos() - 0.02, 0.075, "hat");
    }
    ball(-0.32, 3.06, -0.26, 0.1, "beard");
}

/// A lathe surface: the outline runs from the foot up to the lip, the cork stands in it.
fn bottle(scene: &mut String, x: f64, z: f64) {
    const AROUND: usize = 56;
    let outline: &[(f64, f64)] = &[(0.0, 0.0), (0.3, 0.0), (0.4, 0.03), (0.44, 0.1)];
    let mut profile: Vec<(f64, f64)> = outline.to_vec();
    profile.extend((0..=18).map(|k| (0.445, 0.16 + 1.05 * f64::from(k) / 18.0)));
    profile.extend((1..=14).map(|k| {
        let t = f64::from(k) / 14.0;
        let smooth = t * t * (3.0 - 2.0 * t);
        (0.445 - 0.305 * smooth, 1.21 + 0.5 * t)
    }));
    profile.extend((1..=5).map(|k| (0.14 - 0.01 * f64::from(k) / 5.0, 1.71 + 0.08 * f64::from(k))));
    profile.extend([(0.165, 2.12), (0.17, 2.17), (0.165, 2.22), (0.12, 2.23)]);
    let corks = profile.len();
    profile.extend([(0.115, 2.23), (0.12, 2.33), (0.1, 2.36), (0.0, 2.36)]);
    let point = |i: usize, j: usize| {
        let angle = TAU * (i % AROUND) as f64 / AROUND as f64;
        let (radius, y) = profile[j];
        (x + radius * angle.sin(), y, z + radius * angle.cos())
    };
    for j in 0..profile.len() - 1 {
        for i in 0..AROUND {
            let middle = f64::midpoint(profile[j].1, profile[j + 1].1);
            let from_front = (i as f64 + 0.5) / AROUND as f64 * 2.0 - 1.0;
            let material = if j >= corks {
                "cork"
            } else if (0.36..1.02).contains(&middle) && from_front.abs() > 0.62 {
                "label"
            } else {
                "glass"
            };
            let [a, b, c, d] = [point(i, j), point(i + 1, j), point(i + 1, j + 1), point(i, j + 1)];
            for corners in [[a, b, c], [a, c, d]] {
                if corners[0] == corners[1] || corners[1] == corners[2] || corners[2] == corners[0]
                {
                    continue; // At the axis.
                }
                let [p, q, r] = corners.map(|(x, y, z)| format!("vertex {x:.4} {y:.4} {z:.4}"));
                line(scene, format_args!("\ttriangle {p} {q} {r} material {material} endtriangle"));
            }
        }
    }
}
