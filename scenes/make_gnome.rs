//! Writes `gnome.rt` to standard output: a garden gnome and his bottle on a terrace, with a mirror
//! behind them, a red ball, a die and toadstools. Everything is spheres, boxes, quadrangles and
//! what the arithmetic of solids makes of them.
//!
//!     cargo run --example make_gnome > scenes/gnome.rt

#![expect(clippy::disallowed_methods, reason = "numbers are written with four digits only")]

use std::{f64::consts::TAU, io::Write as _};

/// x to the right, y up, z towards the eye.
type Point = [f64; 3];

/// What stands beside the name. `refract` is n1/n2 from the front side in.
const MATERIALS: [(&str, &str); 32] = [
    ("planks", "texture planks.png"),
    ("plaster", "color 128 164 160"),
    ("board", "color 226 218 200"),
    ("lawn", "color 176 220 104"),
    ("leaves", "color 140 206 108"),
    ("gold", "color 222 172 74"),
    ("mirror", "color 0 0 0 reflect 0.92"),
    ("boot", "color 94 58 36"),
    ("sole", "color 44 34 30"),
    ("trousers", "color 104 92 76"),
    ("coat", "color 40 82 176"),
    ("button", "color 240 196 70"),
    ("belt", "color 58 40 32"),
    ("skin", "color 246 194 160"),
    ("nose", "color 232 126 106"),
    ("eye", "color 28 30 40"),
    ("beard", "color 244 241 234"),
    ("hat", "color 214 40 36"),
    ("brim", "color 150 22 26"),
    ("ball", "color 255 26 18 reflect 0.4"),
    ("ivory", "color 246 240 226"),
    ("ink", "color 36 38 48"),
    ("cap", "color 222 54 36"),
    ("stem", "color 240 228 204"),
    ("clay", "color 200 110 68"),
    ("soil", "color 74 54 42"),
    ("cork", "color 190 142 94"),
    ("label", "texture label.png"),
    // The air's side of a wall of glass, the elixir's side of it, and the air's of the elixir.
    ("glass", "color 255 255 255 alpha 0 refract 0.6667"),
    ("elixir", "color 255 176 34 alpha 0.5 refract 0.8867"),
    ("level", "color 255 190 70 alpha 0.35 refract 0.75"),
    ("clear", "alpha 0"),
];

fn main() -> std::io::Result<()> {
    let mut scene = vec![String::from(
        "# A garden gnome and his bottle. Written by make_gnome.rs.\n\
         viewport",
    )];
    scene.extend(screen([2.1, 2.15, 8.4], 0.47, [3.12, 1.755], -0.38));
    scene.push(String::from("\tsize 1280 720\n\tbackground 186 214 240\nendviewport\nmaterials"));
    scene.extend(MATERIALS.map(|(name, fields)| format!("\tentry name {name} {fields} endentry")));
    scene.push(String::from(
        "endmaterials\n\
         lights\n\
         \tambient 0.3\n\
         \treference power 100 distance 9 endreference\n\
         \tpoint coords 5.2 7.6 7 power 124 color 255 240 214 endpoint\n\
         \tpoint coords -6 5 6 power 26 color 200 222 255 endpoint\n\
         endlights\n\
         geometry",
    ));
    scene.extend(terrace());
    scene.extend(looking_glass([0.05, 2.15, -2.2], 0.98));
    scene.extend(gnome(-0.75));
    scene.extend(bottle([1.1, 0.66, 0.45]));
    scene.push(sphere([2.4, 0.45, 0.3], 0.45, "ball"));
    scene.push(die([3.0, 0.2, 0.5], 0.2, 0.28));
    scene.extend(toadstools([-2.15, 0.0, -0.35]));
    scene.push(String::from("endgeometry\n"));
    std::io::stdout().write_all(scene.join("\n").as_bytes())
}

/// An upright screen as large as `size`, 4 in front of the eye, which looks towards `x` at z = 0;
/// the screen's middle is `lift` above the eye.
fn screen(eye: Point, x: f64, size: [f64; 2], lift: f64) -> [String; 4] {
    let (ahead_x, ahead_z) = unit(x - eye[0], -eye[2]);
    let corner = |right: f64, up: f64| {
        place([
            eye[0] + 4.0 * ahead_x - ahead_z * right * size[0] / 2.0,
            eye[1] + lift + up * size[1] / 2.0,
            eye[2] + 4.0 * ahead_z + ahead_x * right * size[0] / 2.0,
        ])
    };
    [
        format!("\torigin {}", place(eye)),
        format!("\ttopleft {}", corner(-1.0, 1.0)),
        format!("\tbottomleft {}", corner(-1.0, -1.0)),
        format!("\ttopright {}", corner(1.0, 1.0)),
    ]
}

fn unit(x: f64, y: f64) -> (f64, f64) {
    let length = (x * x + y * y).sqrt();
    (x / length, y / length)
}

/// Four digits, and no more zeros than needed.
fn place(point: Point) -> String {
    point.map(|c| ((c * 1e4).round() / 1e4 + 0.0).to_string()).join(" ")
}

fn sphere(at: Point, radius: f64, material: &str) -> String {
    format!("sphere coords {} radius {radius:.4} material {material} endsphere", place(at))
}

/// An upright box between two heights around a middle line, turned by `angle` around it.
fn block(
    [x, z]: [f64; 2],
    [low, high]: [f64; 2],
    half: [f64; 2],
    angle: f64,
    material: &str,
) -> String {
    let (sin, cos) = angle.sin_cos();
    let corner = |right: f64, y: f64, near: f64| {
        let (right, near) = (right * half[0], near * half[1]);
        format!("vertex {}", place([x + right * cos + near * sin, y, z - right * sin + near * cos]))
    };
    let corners = [
        corner(-1.0, low, -1.0),
        corner(1.0, low, -1.0),
        corner(-1.0, high, -1.0),
        corner(-1.0, low, 1.0),
    ];
    format!("parallelepiped {} material {material} endparallelepiped", corners.join(" "))
}

/// A box between two corners.
fn cuboid(low: Point, high: Point, material: &str) -> String {
    let [x, y, z] = [0, 1, 2].map(|axis| f64::midpoint(low[axis], high[axis]));
    let half = [high[0] - x, high[2] - z];
    block([x, z], [low[1], y + y - low[1]], half, 0.0, material)
}

/// A column of 16 sides: what boxes have in common that stand turned against each other.
fn column(at: [f64; 2], heights: [f64; 2], radius: f64, material: &str) -> String {
    let boxes = (0..4).map(|k| {
        let angle = TAU / 16.0 * f64::from(k);
        block(at, heights, [radius, radius], angle, material)
    });
    intersection(boxes)
}

fn union(operands: impl IntoIterator<Item = String>) -> String {
    solid("union", operands)
}

fn intersection(operands: impl IntoIterator<Item = String>) -> String {
    solid("intersection", operands)
}

/// The first less all others.
fn difference(operands: impl IntoIterator<Item = String>) -> String {
    solid("difference", operands)
}

fn solid(operation: &str, operands: impl IntoIterator<Item = String>) -> String {
    let operands: Vec<String> = operands.into_iter().collect();
    format!("{operation}\n{}\nend{operation}", operands.join("\n"))
}

fn quadrangle(corners: [Point; 4], images: Option<[[f64; 2]; 4]>, material: &str) -> String {
    let vertices: Vec<String> = (0..4)
        .map(|k| {
            let image = images.map(|images| format!(" texcoord {} {}", images[k][0], images[k][1]));
            format!("vertex {}{}", place(corners[k]), image.unwrap_or_default())
        })
        .collect();
    format!("quadrangle {} material {material} endquadrangle", vertices.join(" "))
}

/// The floor and the wall behind; a garden that only the mirror and the ball show.
fn terrace() -> Vec<String> {
    let floor = [[-9.0, 0.0, 10.0], [9.0, 0.0, 10.0], [9.0, 0.0, -2.2], [-9.0, 0.0, -2.2]];
    let wall = [[-9.0, 0.0, -2.2], [9.0, 0.0, -2.2], [9.0, 6.0, -2.2], [-9.0, 6.0, -2.2]];
    let lawn = [[-90.0, -0.2, 90.0], [90.0, -0.2, 90.0], [90.0, -0.2, -2.3], [-90.0, -0.2, -2.3]];
    // An image shows planks 1.6 wide and 3.2 long.
    let images = floor.map(|[x, _, z]| [x / 1.6, z / 3.2]);
    let mut parts = vec![
        quadrangle(floor, Some(images), "planks"),
        quadrangle(wall, None, "plaster"),
        quadrangle(lawn, None, "lawn"),
        cuboid([-9.0, 0.0, -2.2], [9.0, 0.34, -2.12], "board"),
    ];
    for k in 0..14 {
        let k = f64::from(k);
        let radius = 1.7 + 0.6 * (5.0 * k).sin();
        let at = [-20.0 + 3.1 * k, 0.6 * radius, 20.0 + 3.0 * (3.0 * k).sin()];
        parts.push(sphere(at, radius, "leaves"));
    }
    parts
}

/// A round mirror on the wall, in a frame: discs are what balls and a box have in common.
fn looking_glass(at: Point, radius: f64) -> Vec<String> {
    let slab = |thickness: f64, material: &str| {
        let [x, y, z] = at;
        let side = 1.5 * radius;
        cuboid([x - side, y - side, z], [x + side, y + side, z + thickness], material)
    };
    let ball = |radius: f64, material: &str| sphere(at, radius, material);
    let outer = ball(radius + 0.13, "gold");
    vec![
        difference([intersection([slab(0.12, "gold"), outer]), ball(radius, "gold")]),
        intersection([slab(0.04, "mirror"), ball(radius, "mirror")]),
    ]
}

/// Balls, mirrored left and right, and clothes of cut solids.
fn gnome(x: f64) -> Vec<String> {
    let ball =
        |dx: f64, y: f64, z: f64, radius: f64, material| sphere([x + dx, y, z], radius, material);
    let mut parts = Vec::new();
    for side in [-1.0, 1.0] {
        parts.extend(boot(x, side));
        for k in 0..6 {
            let t = f64::from(k) / 5.0;
            let leg =
                ball(side * (0.25 - 0.03 * t), 0.3 + 0.2 * t, 0.04, 0.17 + 0.03 * t, "trousers");
            parts.push(leg);
        }
        // The left arm hangs, the right one lies on the bottle's shoulder.
        for k in 0..24 {
            let t = f64::from(k) / 23.0;
            let (reach, drop) =
                if side > 0.0 { (0.78 * t, 0.3 * t - 0.33 * t * t) } else { (0.22 * t, 0.58 * t) };
            let (y, z) = (1.3 - drop, 0.1 + 0.34 * t * t);
            parts.push(ball(side * (0.42 + reach), y, z, 0.175 - 0.045 * t, "coat"));
        }
        let hand = if side > 0.0 { (1.28, 1.35, 0.46) } else { (-0.66, 0.66, 0.47) };
        parts.push(ball(hand.0, hand.1, hand.2, 0.135, "skin"));
        parts.push(ball(hand.0 - side * 0.02, hand.1 + 0.09, hand.2 + 0.09, 0.055, "skin"));
        parts.push(ball(side * 0.15, 1.86, 0.335, 0.052, "eye"));
        parts.push(ball(side * 0.15 + 0.02, 1.878, 0.38, 0.014, "beard"));
        parts.push(ball(side * 0.2, 1.68, 0.27, 0.11, "nose"));
        parts.push(ball(side * 0.4, 1.74, 0.0, 0.09, "skin"));
        for k in 0..9 {
            let t = f64::from(k) / 8.0;
            let (y, z) = (1.6 - 0.06 * t * t, 0.43 - 0.1 * t);
            parts.push(ball(side * (0.04 + 0.27 * t), y, z, 0.08 - 0.048 * t, "beard"));
            let (y, z) = (1.945 + 0.025 * (1.0 - t), 0.345 - 0.02 * t);
            parts.push(ball(side * (0.08 + 0.13 * t), y, z, 0.035, "beard"));
        }
    }
    parts.extend([
        ball(0.0, 0.72, 0.0, 0.53, "coat"),
        ball(0.0, 1.0, 0.0, 0.48, "coat"),
        ball(0.0, 1.24, 0.0, 0.38, "coat"),
        ball(0.0, 1.75, 0.0, 0.39, "skin"),
        ball(0.0, 1.72, 0.43, 0.12, "nose"),
    ]);
    parts.extend(belt(x));
    for k in 0..3 {
        let k = f64::from(k);
        parts.push(ball(0.0, 0.42 + 0.13 * k, 0.47 + 0.05 * k - 0.012 * k * k, 0.045, "button"));
    }
    // The beard: rows of locks, narrower and farther down.
    for row in 0..13 {
        let t = f64::from(row) / 12.0;
        let locks = 15 - row;
        for k in 0..locks {
            let across = (f64::from(k) + 0.5) / f64::from(locks) * 2.0 - 1.0;
            let wave = 0.02 * (f64::from(7 * row + 3 * k)).sin();
            let angle = across * (1.25 - 0.85 * t);
            let distance = 0.4 + 0.16 * t - 0.1 * t * t;
            parts.push(ball(
                distance * angle.sin() * (1.0 - 0.25 * t),
                1.6 - 0.7 * t + 0.1 * (1.0 - t) * across * across + wave,
                distance * angle.cos() + 0.03 - wave,
                0.105 - 0.045 * t,
                "beard",
            ));
        }
    }
    parts.extend(hat(x));
    parts
}

/// A row of balls less all that is below the ground; the sole is a slice of larger ones.
fn boot(x: f64, side: f64) -> [String; 2] {
    let balls = |more: f64, material: &str| {
        let balls = (0..8).map(|k| {
            let t = f64::from(k) / 7.0;
            let at = [x + side * (0.25 + 0.07 * t), 0.17 - 0.01 * t, 0.03 + 0.36 * t];
            sphere(at, 0.18 - 0.02 * t * t + more, material)
        });
        union(balls)
    };
    let layer = |low: f64, high: f64, material: &str| {
        cuboid([x - 1.0, low, -1.0], [x + 1.0, high, 1.0], material)
    };
    [
        intersection([layer(0.05, 1.0, "boot"), balls(0.0, "boot")]),
        intersection([layer(0.0, 0.06, "sole"), balls(0.03, "sole")]),
    ]
}

/// A slice of a ball; the buckle is a frame of a box less a box, with its pin.
fn belt(x: f64) -> [String; 3] {
    let buckle = |half: f64, near: f64, far: f64, material: &str| {
        let y = 0.8 * half;
        cuboid([x - half, 0.84 - y, near], [x + half, 0.84 + y, far], material)
    };
    [
        intersection([
            cuboid([x - 1.0, 0.76, -1.0], [x + 1.0, 0.92, 1.0], "belt"),
            sphere([x, 0.82, 0.0], 0.55, "belt"),
        ]),
        difference([buckle(0.15, 0.48, 0.6, "button"), buckle(0.1, 0.4, 0.7, "button")]),
        cuboid([x - 0.1, 0.825, 0.5], [x + 0.04, 0.855, 0.595], "button"),
    ]
}

/// A cone of balls that leans and curls, on a brim: a lens with a hollow upper side.
fn hat(x: f64) -> Vec<String> {
    let disc = [
        sphere([x, 2.02, -0.02], 0.5, "brim"),
        cuboid([x - 1.0, 2.0, -1.0], [x + 1.0, 2.14, 1.0], "brim"),
    ];
    let hollow = sphere([x, 2.62, -0.02], 0.6, "brim");
    let mut parts = vec![difference([intersection(disc), hollow])];
    for k in 0..60 {
        let t = f64::from(k) / 59.0;
        let lean = t * t;
        let at = [x - 0.3 * lean, 2.1 + t - 0.08 * lean * t, -0.03 - 0.22 * lean];
        parts.push(sphere(at, 0.39 * (1.0 - t) + 0.045, "hat"));
    }
    parts.push(sphere([x - 0.32, 3.06, -0.26], 0.1, "beard"));
    parts
}

/// A flask with walls of glass, flat in front for its label. `at` is the middle of its body.
///
/// The two hollows have the same walls; where they coincide the first one's is taken, so that
/// the glass ends in elixir up to its level and in air above.
fn bottle([x, y, z]: Point) -> Vec<String> {
    const ANGLE: f64 = 0.2;
    const LEVEL: f64 = 0.3;
    let ball = |radius: f64, material: &str| sphere([x, y, z], radius, material);
    let slice = |low: f64, high: f64, depth: f64, material: &str| {
        block([x, z], [y + low, y + high], [1.0, depth], ANGLE, material)
    };
    let neck = |low: f64, high: f64, radius: f64, material: &str| {
        column([x, z], [y + low, y + high], radius, material)
    };
    let outside = [
        intersection([ball(0.74, "glass"), slice(-0.66, 1.0, 0.42, "glass")]),
        neck(0.6, 1.14, 0.2, "glass"),
        neck(1.06, 1.18, 0.26, "glass"),
    ];
    let hollow = |high: f64, material: &str| {
        intersection([ball(0.67, material), slice(-0.57, high, 0.35, material)])
    };
    let surface = [
        slice(-1.0, LEVEL, 1.0, "level"),
        slice(LEVEL - 0.01, 1.0, 0.3498, "clear"),
        ball(0.6698, "clear"),
    ];
    let (sin, cos) = f64::sin_cos(ANGLE);
    let label = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[right, up]| {
        let (right, near) = (right * 0.4, 0.424);
        [x + right * cos + near * sin, y - 0.04 + up * 0.3, z - right * sin + near * cos]
    });
    vec![
        difference([
            union(outside),
            hollow(LEVEL, "elixir"),
            hollow(1.0, "glass"),
            neck(0.5, 1.3, 0.13, "glass"),
        ]),
        intersection(surface),
        neck(0.98, 1.32, 0.128, "cork"),
        quadrangle(label, None, "label"),
    ]
}

/// A box within a ball, less its pips: two in front, three to the left, one on top.
fn die([x, y, z]: Point, half: f64, angle: f64) -> String {
    const PIPS: [Point; 6] = [
        [-0.5, -0.5, 1.0],
        [0.5, 0.5, 1.0],
        [-1.0, -0.5, -0.5],
        [-1.0, 0.0, 0.0],
        [-1.0, 0.5, 0.5],
        [0.0, 1.0, 0.0],
    ];
    let (sin, cos) = angle.sin_cos();
    let pips = PIPS.map(|[right, up, near]| {
        let at = [
            x + half * (right * cos + near * sin),
            y + half * up,
            z + half * (near * cos - right * sin),
        ];
        sphere(at, 0.24 * half, "ink")
    });
    let body = intersection([
        block([x, z], [y - half, y + half], [half, half], angle, "ivory"),
        sphere([x, y, z], 1.42 * half, "ivory"),
    ]);
    difference([body].into_iter().chain(pips))
}

/// Toadstools in a pot.
fn toadstools([x, y, z]: Point) -> Vec<String> {
    let layer = |low: f64, high: f64, material: &str| {
        cuboid([x - 2.0, y + low, z - 2.0], [x + 2.0, y + high, z + 2.0], material)
    };
    let ball =
        |height: f64, radius: f64, material: &str| sphere([x, y + height, z], radius, material);
    let mut parts = vec![
        difference([
            union([
                intersection([ball(0.5, 0.56, "clay"), layer(0.0, 0.62, "clay")]),
                intersection([ball(0.66, 0.6, "clay"), layer(0.56, 0.72, "clay")]),
            ]),
            ball(0.66, 0.5, "clay"),
        ]),
        intersection([ball(0.66, 0.52, "soil"), layer(0.3, 0.64, "soil")]),
    ];
    for (dx, dz, height, radius) in [(-0.12, 0.02, 1.2, 0.4), (0.24, 0.16, 0.9, 0.24)] {
        let at = [x + dx, y + height, z + dz];
        let floor = [at[0] - 1.0, at[1] + 0.15 * radius, at[2] - 1.0];
        parts.push(intersection([
            sphere(at, radius, "cap"),
            cuboid(floor, [at[0] + 1.0, at[1] + 1.0, at[2] + 1.0], "stem"),
        ]));
        for k in 0..24 {
            let t = f64::from(k) / 23.0;
            let stem = [at[0], y + 0.62 + t * (height + 0.15 * radius - 0.62), at[2]];
            parts.push(sphere(stem, radius * (0.38 - 0.12 * t), "stem"));
        }
        for k in 0..11 {
            // Spots along a spiral from the top down.
            let k = f64::from(k);
            let up = 0.96 - 0.072 * k;
            let (sin, cos) = (2.4 * k + 0.6).sin_cos();
            let out = (1.0 - up * up).sqrt() * radius;
            let spot = [at[0] + out * sin, at[1] + up * radius, at[2] + out * cos];
            parts.push(sphere(spot, radius * (0.15 - 0.004 * k), "stem"));
        }
    }
    parts
}
