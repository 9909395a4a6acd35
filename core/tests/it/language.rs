//! What the scene language means: texts against the scenes that they give.

use std::io;

use glam::{DVec2, DVec3};
use rtfarm_core::{
    language::{Reading, read_scene},
    scene::{DroppedFaces, Operation, Scene, SolidNode},
    tile::Size,
};

fn read(text: &str) -> Reading {
    read_scene(text.as_bytes(), &|path| match path {
        "two.png" | "папка/две точки #1.png" => Ok(two_texels()),
        _ => Err(io::ErrorKind::NotFound.into()),
    })
}

/// A PNG of a red and a green texel.
fn two_texels() -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, 2, 1);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&[255, 0, 0, 0, 255, 0]).unwrap();
    bytes
}

/// The scene of a text that nothing is said about.
fn check_clean(text: &str) -> Scene {
    check_told(text, &[])
}

/// The scene of a text, about which `told` is said.
fn check_told(text: &str, told: &[&str]) -> Scene {
    let reading = read(text);
    let lines: Vec<_> = reading
        .diagnostics
        .iter()
        .map(|d| format!("{}: {}: {}", d.at, d.severity, d.message))
        .collect();
    assert_eq!(lines, told, "{text}");
    reading.scene.expect("there are no errors")
}

const VIEWPORT: &str =
    "viewport origin 0 0 5 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endviewport\n";
const RED: &str = "materials entry name red color 255 0 0 endentry endmaterials\n";

#[test]
fn an_empty_file_is_an_empty_scene() {
    for text in ["", "\u{feff}", "# Пусто", "\r\n\t ", "geometry endgeometry lights endlights"]
    {
        let scene = check_clean(text);
        assert!(scene.viewport.is_none() && scene.lights.is_empty() && scene.spheres.is_empty());
    }
}

#[test]
fn bom_crlf_tabs_and_glued_comments_change_nothing() {
    let text = "\u{feff}viewport# экран\r\n\torigin 0 0 5#глаз\r\n\ttopleft\t-1.\t+1 -0\r\n\
                bottomleft -1e0 -1 .0\r\n topright 1 1 0e-05 endviewport";
    let viewport = check_clean(text).viewport.unwrap();
    assert_eq!(Some(viewport), check_clean(VIEWPORT).viewport);
    assert!(viewport.top_left.z.is_sign_positive(), "-0 is stored as 0");
}

#[test]
fn sections_come_in_any_order_and_merge() {
    let scene = check_clean(
        "geometry sphere material red radius 1 coords 0 0 0 endsphere endgeometry
         lights point power 2 coords 1 2 3 endpoint endlights
         geometry sphere coords 1 0 0 radius 2 material blue endsphere endgeometry
         materials entry color 0 0 255 name blue endentry endmaterials
         lights point power 3 coords 1 2 3 endpoint endlights
         materials entry name red endentry endmaterials",
    );
    assert_eq!(
        scene.spheres.iter().map(|s| (s.radius, s.material, s.primitive)).collect::<Vec<_>>(),
        [(1.0, 1, 0), (2.0, 0, 1)]
    );
    assert_eq!(
        scene.materials.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(),
        ["blue", "red"]
    );
    assert_eq!(scene.lights.iter().map(|l| l.intensity.x).collect::<Vec<_>>(), [2.0, 3.0]);
}

#[test]
fn materials_have_the_documented_defaults() {
    let scene = check_clean(
        "materials\nentry name plain endentry\nentry\nname glass\n refract 0.7 endentry
         entry name both color 51 102 255 alpha 0.25 reflect 0.5 refract 2 texture two.png endentry\nendmaterials",
    );
    let [plain, glass, both] = &scene.materials[..] else { panic!() };
    assert_eq!(
        (plain.color, plain.alpha, plain.reflect, plain.refract),
        (DVec3::ONE, 1.0, 0.0, 0.0)
    );
    assert_eq!((glass.alpha, glass.refract), (0.0, 0.7));
    assert_eq!(
        (both.color, both.alpha, both.reflect, both.refract),
        (DVec3::new(0.2, 0.4, 1.0), 0.25, 0.5, 2.0)
    );
    assert_eq!(both.texture, Some(0));
    assert_eq!(scene.textures[0].texels, [[255, 0, 0], [0, 255, 0]]);
}

#[test]
fn a_reference_governs_the_lights_after_it() {
    let scene = check_clean(
        "lights
           point coords 0 0 0 power 8 endpoint
           reference power 2 distance 3 endreference
           point coords 0 0 0 power 8 color 255 510 0 endpoint
         endlights
         lights
           point coords 0 0 0 power 4 endpoint
           reference power 4 distance 1 endreference
           point coords 0 0 0 power 4 endpoint
         endlights",
    );
    let intensities: Vec<_> = scene.lights.iter().map(|light| light.intensity).collect();
    assert_eq!(
        intensities,
        [DVec3::splat(36.0), DVec3::new(36.0, 72.0, 0.0), DVec3::splat(18.0), DVec3::ONE]
    );
    let alone = check_clean("lights point coords 0 0 0 power 5 endpoint endlights");
    assert_eq!(alone.lights[0].intensity, DVec3::splat(5.0));
}

#[test]
fn ambient_light_is_one_number_or_a_colour() {
    assert_eq!(check_clean("lights endlights").ambient, None);
    assert_eq!(check_clean("lights ambient 0 endlights").ambient, Some(DVec3::ZERO));
    assert_eq!(check_clean("lights ambient 0.5 endlights").ambient, Some(DVec3::splat(0.5)));
    assert_eq!(
        check_clean("lights ambient 51 255 0 endlights").ambient,
        Some(DVec3::new(0.2, 1.0, 0.0))
    );
}

#[test]
fn the_viewport_knows_size_and_background() {
    let scene = check_clean(
        "viewport size 640 480 background 255 51 0 origin 0 0 5 topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endviewport",
    );
    assert_eq!(scene.size_hint, Size::new(640, 480).ok());
    assert_eq!(scene.background, DVec3::new(1.0, 0.2, 0.0));
    assert_eq!(check_clean(VIEWPORT).size_hint, None);
}

#[test]
fn synonyms_of_real_files_are_read_with_a_warning() {
    let scene = check_told(
        "viewport origin 0 0 5
screen topleft -1 1 0 bottomleft -1 -1 0 topright 1 1 0 endscreen
resolution 64 48
endviewport
background 0 0 255
lights
backlight 0 51 0
point position 1 2 3 power 1 endpoint
endlights
materials entry name a image two.png
specular 1 2
shininess 3
endentry endmaterials
geometry quadrangle material a
vertex 0 0 0 textureCoord 0 0 0 vertex 1 0 0 textureCoord 1 0
vertex 1 1 0 textureCoord 1 1 vertex 0 1 0 textureCoord 0 1 0 endquadrangle endgeometry",
        &[
            "2:1: warning: `screen` is not needed: its corners are read as those of `viewport`",
            "3:1: warning: `resolution` is read as `size` in `viewport`",
            "5:1: warning: `background` belongs in `viewport`, and is read as if it were there",
            "7:1: warning: `backlight` is read as `ambient`",
            "8:7: warning: `position` is read as `coords`",
            "10:24: warning: `image` is read as `texture`",
            "11:1: warning: materials have no `specular`, so its line is skipped",
            "12:1: warning: materials have no `shininess`, so its line is skipped",
            "15:14: warning: `textureCoord` is read as `texcoord`",
            "15:46: warning: `textureCoord` is read as `texcoord`",
            "16:14: warning: `textureCoord` is read as `texcoord`",
            "16:44: warning: `textureCoord` is read as `texcoord`",
        ],
    );
    assert_eq!(scene.size_hint, Size::new(64, 48).ok());
    assert_eq!((scene.background, scene.ambient), (DVec3::Z, Some(DVec3::new(0.0, 0.2, 0.0))));
    assert_eq!(scene.lights[0].position, DVec3::new(1.0, 2.0, 3.0));
    assert_eq!(scene.quadrangle_texcoords, [(0, [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y])]);
}

#[test]
fn file_names_may_have_spaces_hashes_and_cyrillic() {
    let scene = check_clean(
        "materials entry name стекло texture \"папка/две точки #1.png\" endentry endmaterials",
    );
    assert_eq!(scene.textures[0].path, "папка/две точки #1.png");
    assert_eq!(scene.materials[0].name, "стекло");
}

#[test]
fn a_texture_file_is_loaded_once() {
    let scene = check_clean(
        "materials entry name a texture two.png endentry entry name b texture two.png endentry endmaterials",
    );
    assert_eq!((scene.textures.len(), scene.materials[1].texture), (1, Some(0)));
}

#[test]
fn operations_are_read_in_postfix_order() {
    let scene = check_clean(&format!(
        "{RED}geometry
         sphere coords 9 9 9 radius 1 material red endsphere
         difference
            union
               sphere coords 0 0 0 radius 1 material red endsphere
               sphere coords 1 0 0 radius 2 material red endsphere
            endunion
            parallelepiped vertex 1 1 1 vertex 2 1 1 vertex 1 3 1 vertex 1 1 4 material red endparallelepiped
            sphere coords 2 0 0 radius 3 material red endsphere
         enddifference
         endgeometry"
    ));
    let solid = &scene.solids[0];
    assert_eq!(solid.primitive, 1);
    let leaf = |node: &SolidNode| match node {
        SolidNode::Sphere(sphere) => format!("sphere {} {}", sphere.primitive, sphere.radius),
        SolidNode::Parallelepiped(p) => format!("parallelepiped {} {}", p.primitive, p.edges[2]),
        SolidNode::Operation { operation, operands } => format!("{operation:?} {operands}"),
    };
    assert_eq!(
        solid.nodes.iter().map(leaf).collect::<Vec<_>>(),
        [
            "sphere 0 1",
            "sphere 1 2",
            "Union 2",
            "parallelepiped 2 [0, 0, 3]",
            "sphere 3 3",
            "Difference 3"
        ]
    );
}

#[test]
fn operations_may_be_nested_a_million_deep() {
    const DEPTH: usize = 1_000_000;
    let sphere = " sphere coords 0 0 0 radius 1 material red endsphere\n";
    let text = format!(
        "{RED}geometry {}{sphere}{} endgeometry",
        "union".to_owned() + &" union".repeat(DEPTH - 1),
        format!("{sphere} endunion").repeat(DEPTH)
    );
    let nodes = &check_clean(&text).solids[0].nodes;
    assert_eq!(nodes.len(), 2 * DEPTH + 1);
    assert_eq!(nodes[2 * DEPTH], SolidNode::Operation { operation: Operation::Union, operands: 2 });
}

fn triangle(rest: &str) -> String {
    format!("triangle {rest} endtriangle\n")
}

#[test]
fn triangles_without_area_and_copies_are_dropped() {
    let scene = check_clean(&format!(
        "{RED}materials entry name blue endentry endmaterials geometry {} endgeometry",
        [
            "vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 material red",
            "vertex 1 0 0 vertex 0 1 -0 vertex 0 0 0 material red",
            "vertex 1 0 0 vertex 0 0 0 vertex 0 1 0 material red",
            "vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 material blue",
            "vertex 0 0 0 vertex 1 1 1 vertex 2 2 2 material red",
            "vertex 0 0 0 vertex 0 0 0 vertex 0 1 0 material red",
            "vertex 0 0 0 vertex 1e-300 0 0 vertex 0 1e-300 0 material red",
            "vertex 0 0 0 texcoord 0 0 vertex 1 0 0 texcoord 1 0 vertex 0 1 0 texcoord 0 1 material red",
            "vertex 1 0 0 texcoord 1 0 vertex 0 1 0 texcoord 0 1 vertex 0 0 0 texcoord 0 0 material red",
            "vertex 1 0 0 texcoord 1 0 vertex 0 1 0 texcoord 0 0 vertex 0 0 0 texcoord 0 0 material red",
        ]
        .map(triangle)
        .concat()
    ));
    assert_eq!(scene.dropped, DroppedFaces { zero_area: 2, duplicates: 2 });
    assert_eq!(scene.triangles.iter().map(|t| t.primitive).collect::<Vec<_>>(), [0, 2, 3, 6, 7, 9]);
    assert_eq!(scene.triangle_texcoords.iter().map(|t| t.0).collect::<Vec<_>>(), [4, 5]);
}

#[test]
fn a_turned_triangle_is_no_copy_where_a_texture_shows_the_turn() {
    let geometry = format!(
        "geometry {}{} endgeometry ",
        triangle("vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 material a"),
        triangle("vertex 1 0 0 vertex 0 1 0 vertex 0 0 0 material a"),
    );
    for (material, count) in [("", 1), ("texture two.png", 2)] {
        let materials = format!("materials entry name a {material} endentry endmaterials ");
        assert_eq!(check_clean(&format!("{materials}{geometry}")).triangles.len(), count);
        assert_eq!(check_clean(&format!("{geometry}{materials}")).triangles.len(), count);
    }
}

#[test]
fn strict_reading_makes_errors_of_warnings() {
    let reading = read("materials entry name 0 endentry … endmaterials");
    assert!(reading.scene.is_some());
    let strict = reading.into_strict();
    assert!(strict.scene.is_none());
    let told: Vec<_> =
        strict.diagnostics.iter().map(|d| format!("{}: {}", d.at, d.severity)).collect();
    assert_eq!(told, ["1:22: error", "1:33: error"]);
    assert!(read(VIEWPORT).into_strict().scene.is_some());
}

#[test]
fn tiny_and_huge_scenes_are_read() {
    for scale in [1e-200, 1e-12, 1.0, 1e12, 1e150] {
        let (one, five) = (format!("{scale:e}"), format!("{:e}", 5.0 * scale));
        let text = format!(
            "viewport origin 0 0 {five} topleft -{one} {one} 0 bottomleft -{one} -{one} 0 topright {one} {one} 0 endviewport {RED}
             geometry triangle vertex 0 0 0 vertex {one} 0 0 vertex 0 {one} 0 material red endtriangle
             quadrangle vertex 0 0 0 vertex {one} 0 0 vertex {one} {one} {one} vertex 0 {one} {one} material red endquadrangle
             parallelepiped vertex 0 0 0 vertex {one} 0 0 vertex {one} {one} 0 vertex 0 0 {one} material red endparallelepiped
             sphere coords 0 0 0 radius {one} material red endsphere endgeometry",
        );
        let scene = check_clean(&text);
        assert!(
            scene.viewport.is_some() && scene.triangles.len() == 1 && scene.quadrangles.len() == 1
        );
        assert!(scene.parallelepipeds.len() == 1 && scene.spheres.len() == 1);
    }
}
