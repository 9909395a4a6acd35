//! What an author is told of a mistake: one at a time, with its place.

use std::io;

use rtfarm_core::language::read_scene;

/// Checks all that is told about a text.
fn check_told(text: &str, told: &[&str]) {
    let reading = read_scene(text.as_bytes(), &|path| match path {
        "broken.png" => Ok(b"GIF".to_vec()),
        "broken.obj" => Ok(b"v 0 0 0\nf 1 2 3".to_vec()),
        "fine.obj" => Ok(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3".to_vec()),
        _ => Err(io::Error::new(io::ErrorKind::NotFound, "no such file")),
    });
    let lines: Vec<_> = reading
        .diagnostics
        .iter()
        .map(|d| format!("{}: {}: {}", d.at, d.severity, d.message))
        .collect();
    assert_eq!(lines, told, "\n{text}");
    assert_eq!(reading.scene.is_none(), told.iter().any(|line| line.contains(" error: ")));
}

/// Names of mistakes, texts that have one, and what is told.
const MISTAKES: &[(&str, &str, &[&str])] = &[
    (
        "a misspelt section",
        "geometri
endgeometri",
        &["1:1: warning: the block `geometri` is unknown and is skipped; did you mean `geometry`?"],
    ),
    (
        "a misspelt section that ends rightly",
        "geometri
endgeometry",
        &[
            "1:1: error: `geometri` is not a section; did you mean `geometry`?",
            "2:1: error: `endgeometry` ends nothing, because no `geometry` is open",
        ],
    ),
    (
        "a shape outside its section",
        "  sphere
    coords 0 0 0
    radius 1
    material red
  endsphere",
        &["1:3: error: `sphere` is not allowed here; it belongs in `geometry`"],
    ),
    (
        "a second viewport",
        "viewport
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport
viewport
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &["7:1: error: a scene has only one `viewport`, but this is another"],
    ),
    (
        "a viewport without a corner",
        "viewport
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
endviewport",
        &["1:1: error: this `viewport` has no `topright`"],
    ),
    (
        "corners on one line",
        "viewport
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright -1 3 0
endviewport",
        &["3:3: error: the three corners of the screen lie on one line"],
    ),
    (
        "an eye in the plane of the screen",
        "viewport
  origin 5 5 0
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &["2:3: error: the eye, `origin`, lies in the plane of the screen"],
    ),
    (
        "a screen that is no rectangle",
        "viewport
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1.5 0
endviewport",
        &[
            "3:3: warning: the screen is not a rectangle: its edges at `topleft` are not at a right angle, so the picture is sheared",
        ],
    ),
    (
        "a size of zero",
        "viewport
  size 0 480
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &[
            "2:8: error: the width and the height of a picture must be whole numbers from 1 to 65535, but one is 0",
        ],
    ),
    (
        "a size with a fraction",
        "viewport
  size 640.5 480
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &[
            "2:8: error: the width and the height of a picture must be whole numbers from 1 to 65535, but one is 640.5",
        ],
    ),
    (
        "a size beyond all pictures",
        "viewport
  size 100000 480
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &[
            "2:8: error: the width and the height of a picture must be whole numbers from 1 to 65535, but one is 100000",
        ],
    ),
    (
        "one side of two",
        "viewport
  xres 640
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &[
            "2:3: warning: `xres` is read as the width in `size`",
            "2:3: warning: `xres` is ignored, because there is no `yres`",
        ],
    ),
    (
        "a negative background",
        "viewport
  background 0 -1 0
  origin 0 0 5
  topleft -1 1 0
  bottomleft -1 -1 0
  topright 1 1 0
endviewport",
        &["2:14: error: the components of a colour must be 0 or more, but one is -1"],
    ),
    (
        "a missing number",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0
    radius 1
    material red
  endsphere
endgeometry",
        &["4:5: error: `coords` takes 3 numbers, but only 2 are given"],
    ),
    (
        "a number too many",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0 0
    radius 1
    material red
  endsphere
endgeometry",
        &["4:18: error: `coords` takes 3 numbers, but one more follows"],
    ),
    (
        "numbers with commas between",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0, 0, 0
    radius 1
    material red
  endsphere
endgeometry",
        &["4:12: error: `0,` is not a number; numbers are separated by spaces, not by commas"],
    ),
    (
        "a decimal comma",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1,5
    material red
  endsphere
endgeometry",
        &["5:12: error: `1,5` is not a number; write its decimal point as in `1.5`"],
    ),
    (
        "a word in place of a number",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius big
    material red
  endsphere
endgeometry",
        &["5:12: error: `big` is not a number; `radius` takes one number"],
    ),
    (
        "not a number",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius nan
    material red
  endsphere
endgeometry",
        &["5:12: error: expected a finite number, found `nan`"],
    ),
    (
        "a number beyond all",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1e999
    material red
  endsphere
endgeometry",
        &["5:12: error: `1e999` is too large; the largest number is about 1.8e308"],
    ),
    (
        "a negative radius",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius -1
    material red
  endsphere
endgeometry",
        &["5:12: error: `radius` must be above 0, but is -1"],
    ),
    (
        "a radius of zero",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 0
    material red
  endsphere
endgeometry",
        &["5:12: error: `radius` must be above 0, but is 0"],
    ),
    (
        "a sphere without a radius",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    material red
  endsphere
endgeometry",
        &["3:3: error: this `sphere` has no `radius`"],
    ),
    (
        "a field twice",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    radius 2
    material red
  endsphere
endgeometry",
        &["6:5: warning: `radius` is given again; this value replaces the earlier one"],
    ),
    (
        "a field of another shape",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    vertex 0 0 0
    material red
  endsphere
endgeometry",
        &[
            "6:5: warning: `sphere` has no `vertex`, so its line is skipped; `vertex` belongs in `triangle`, `quadrangle` or `parallelepiped`",
        ],
    ),
    (
        "a misspelt field",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    raduis 1
    material red
  endsphere
endgeometry",
        &[
            "3:3: error: this `sphere` has no `radius`",
            "5:5: warning: `sphere` has no `raduis`, so its line is skipped; did you mean `radius`?",
        ],
    ),
    (
        "a capital letter",
        "materials entry name red endentry endmaterials
geometry
  Sphere
    coords 0 0 0
    radius 1
    material red
  endsphere
endgeometry",
        &[
            "3:3: warning: `geometry` has no `Sphere`, so its line is skipped; did you mean `sphere`?",
            "4:5: warning: `geometry` has no `coords`, so its line is skipped; `coords` belongs in `point` or `sphere`",
            "5:5: warning: `geometry` has no `radius`, so its line is skipped; `radius` belongs in `sphere`",
            "6:5: warning: `geometry` has no `material`, so its line is skipped; `material` belongs in `sphere`, `triangle`, `quadrangle` or `parallelepiped`",
            "7:3: error: `endsphere` ends nothing, because no `sphere` is open",
        ],
    ),
    (
        "a misspelt material",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material rad
  endsphere
endgeometry",
        &["6:14: error: no material is named `rad`; did you mean `red`?"],
    ),
    (
        "an unknown material",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material glass
  endsphere
endgeometry",
        &["6:14: error: no material is named `glass`"],
    ),
    (
        "a forgotten name of a material",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material
  endsphere
endgeometry",
        &["6:5: error: `material` takes the name of a material, but none is given"],
    ),
    (
        "a block that is not closed",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material red

endgeometry",
        &["8:1: error: `endsphere` is missing before `endgeometry`"],
    ),
    (
        "a misspelt end",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material red
  endspere
endgeometry",
        &["7:3: error: no block ends with `endspere`; did you mean `endsphere`?"],
    ),
    (
        "the end of another block",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material red
  endtriangle
endgeometry",
        &["7:3: error: `endtriangle` cannot end this `sphere`; expected `endsphere`"],
    ),
    (
        "a shape that begins in another",
        "materials entry name red endentry endmaterials
geometry
  sphere
    coords 0 0 0
    radius 1
    material red
  triangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 0 1 0
    material red
  endtriangle
endgeometry",
        &["7:3: error: `endsphere` is missing before `triangle`"],
    ),
    (
        "a section that is not closed",
        "geometry
",
        &["1:1: error: this `geometry` is never closed: `endgeometry` is missing"],
    ),
    (
        "a section in a section",
        "geometry
lights
  point
    coords 0 0 9
    power 5
  endpoint
endlights
endgeometry",
        &[
            "2:1: error: `endgeometry` is missing before `lights`",
            "8:1: error: `endgeometry` ends nothing, because no `geometry` is open",
        ],
    ),
    (
        "a triangle of two vertices",
        "materials entry name red endentry endmaterials
geometry
  triangle
    vertex 0 0 0
    vertex 1 0 0
    material red
  endtriangle
endgeometry",
        &["3:3: error: a triangle has 3 vertices, but this one has 2"],
    ),
    (
        "a triangle of four vertices",
        "materials entry name red endentry endmaterials
geometry
  triangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 0 1 0
    vertex 1 1 0
    material red
  endtriangle
endgeometry",
        &["7:5: error: a triangle has 3 vertices, but this is one more"],
    ),
    (
        "texcoords on some vertices",
        "materials entry name red endentry endmaterials
geometry
  triangle
    vertex 0 0 0 texcoord 0 0
    vertex 1 0 0
    vertex 0 1 0
    material red
  endtriangle
endgeometry",
        &[
            "3:3: error: a `texcoord` is given for 1 of 3 vertices; give one for all of them or for none",
        ],
    ),
    (
        "texcoords before the vertex",
        "materials entry name red endentry endmaterials
geometry
  triangle
    texcoord 0 0 vertex 0 0 0
    vertex 1 0 0
    vertex 0 1 0
    material red
  endtriangle
endgeometry",
        &["4:5: error: `texcoord` must come after the vertex that it belongs to"],
    ),
    (
        "a bow tie",
        "materials entry name red endentry endmaterials
geometry
  quadrangle
    vertex 0 0 0
    vertex 1 1 0
    vertex 1 0 0
    vertex 0 1 0
    material red
  endquadrangle
endgeometry",
        &[
            "3:3: error: the sides of this quadrangle cross or touch; its vertices must go around it in order",
        ],
    ),
    (
        "a quadrangle of equal vertices",
        "materials entry name red endentry endmaterials
geometry
  quadrangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 1 0 0
    vertex 0 1 0
    material red
  endquadrangle
endgeometry",
        &[
            "3:3: error: two vertices of this quadrangle are equal; write a shape of three vertices as a `triangle`",
        ],
    ),
    (
        "a quadrangle on one line",
        "materials entry name red endentry endmaterials
geometry
  quadrangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 2 0 0
    vertex 3 0 0
    material red
  endquadrangle
endgeometry",
        &["3:3: error: this quadrangle has no area: its vertices lie on one line"],
    ),
    (
        "a bent quadrangle",
        "materials entry name red endentry endmaterials
geometry
  quadrangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 1 1 0.1
    vertex 0 1 0
    material red
  endquadrangle
endgeometry",
        &[
            "3:3: error: this quadrangle is not planar: its vertices are 2.494e-2 away from their plane, and at most 1.005e-5 is allowed; use two triangles instead",
        ],
    ),
    (
        "a slightly bent quadrangle",
        "materials entry name red endentry endmaterials
geometry
  quadrangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 1 1 1e-6
    vertex 0 1 0
    material red
  endquadrangle
endgeometry",
        &[
            "3:3: warning: this quadrangle is planar only to within 2.500e-7, but is taken as planar",
        ],
    ),
    (
        "a flat parallelepiped",
        "materials entry name red endentry endmaterials
geometry
  parallelepiped
    vertex 0 0 0
    vertex 1 0 0
    vertex 0 1 0
    vertex 1 1 0
    material red
  endparallelepiped
endgeometry",
        &[
            "3:3: error: this parallelepiped has no volume; its vertices must be a corner and that corner's three neighbours, not all in one plane",
        ],
    ),
    (
        "a parallelepiped of the far corner",
        "materials entry name red endentry endmaterials
geometry
  parallelepiped
    vertex 0 0 0
    vertex 1 0 0
    vertex 0 1 0
    vertex 1 1 1e-13
    material red
  endparallelepiped
endgeometry",
        &[
            "3:3: error: this parallelepiped is too flat: its condition number is 3.5e13, and at most 1e12 is allowed",
        ],
    ),
    (
        "an operation on one solid",
        "materials entry name red endentry endmaterials
geometry
  union
  sphere
    coords 0 0 0
    radius 1
    material red
  endsphere
  endunion
endgeometry",
        &["3:3: error: `union` joins two or more solids, but only one is given"],
    ),
    (
        "an operation on nothing",
        "materials entry name red endentry endmaterials
geometry
  difference
  enddifference
endgeometry",
        &["3:3: error: `difference` joins two or more solids, but none is given"],
    ),
    (
        "a flat shape in an operation",
        "materials entry name red endentry endmaterials
geometry
  union
  sphere
    coords 0 0 0
    radius 1
    material red
  endsphere
  triangle
    vertex 0 0 0
    vertex 1 0 0
    vertex 0 1 0
    material red
  endtriangle
  sphere
    coords 0 0 0
    radius 1
    material red
  endsphere
  endunion
endgeometry",
        &[
            "9:3: error: `triangle` is not a solid; `union` takes spheres, parallelepipeds and operations on them",
        ],
    ),
    (
        "a material on an operation",
        "materials entry name red endentry endmaterials
geometry
  union
    material red
  sphere
    coords 0 0 0
    radius 1
    material red
  endsphere
  sphere
    coords 0 0 0
    radius 1
    material red
  endsphere
  endunion
endgeometry",
        &[
            "4:5: warning: `union` has no `material`, so its line is skipped; each solid in it has its own",
        ],
    ),
    (
        "a mesh that is not there",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file bottle.stl
    material red
  endmesh
endgeometry",
        &["4:10: error: cannot read the mesh `bottle.stl`: no such file"],
    ),
    (
        "a mesh that is broken",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file broken.obj
    material red
  endmesh
endgeometry",
        &[
            "4:10: error: cannot read the mesh `broken.obj`: line 2: there is no vertex 2; vertices are numbered from 1, and the file has 1",
        ],
    ),
    (
        "a mesh without a file",
        "materials entry name red endentry endmaterials
geometry
  mesh
    material red
  endmesh
endgeometry",
        &["3:3: error: this `mesh` has no `file`"],
    ),
    (
        "a file name with a space",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file my bottle.stl
    material red
  endmesh
endgeometry",
        &["4:10: error: a file name with spaces must be in double quotes"],
    ),
    (
        "a quote that is not closed",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file \"fine.obj
    material red
  endmesh
endgeometry",
        &["4:10: error: this name has no closing quote on its line"],
    ),
    (
        "a mesh scaled to nothing",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file fine.obj
    material red
    scale 0
  endmesh
endgeometry",
        &["6:11: error: `scale` must be above 0, but is 0"],
    ),
    (
        "a rotation about nothing",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file fine.obj
    material red
    rotate 0 0 0 90
  endmesh
endgeometry",
        &["6:12: error: the axis of `rotate` must not be 0 0 0"],
    ),
    (
        "a rotation without its angle",
        "materials entry name red endentry endmaterials
geometry
  mesh
    file fine.obj
    material red
    rotate 0 0 1
  endmesh
endgeometry",
        &["6:5: error: `rotate` takes 4 numbers, but only 3 are given"],
    ),
    (
        "a texture that is not there",
        "materials
  entry
    name red
    texture wood.png
  endentry
endmaterials",
        &["4:13: error: cannot read the texture `wood.png`: no such file"],
    ),
    (
        "a texture that is broken",
        "materials
  entry
    name red
    texture broken.png
  endentry
endmaterials",
        &["4:13: error: cannot read the texture `broken.png`: unexpected end of file"],
    ),
    (
        "a material without a name",
        "materials
  entry
    color 255 0 0
  endentry
endmaterials",
        &["2:3: error: this `entry` has no `name`"],
    ),
    (
        "two materials of one name",
        "materials
  entry name red endentry
  entry name red endentry
endmaterials",
        &["3:14: error: another material is already named `red`"],
    ),
    (
        "a name that begins with a digit",
        "materials
  entry name 1st endentry
endmaterials",
        &[
            "2:14: warning: `1st` is not an identifier (letters, digits and `_`, with no digit first), but it is used as it is",
        ],
    ),
    (
        "a name of two words",
        "materials
  entry
    name dark red
  endentry
endmaterials",
        &["3:15: warning: `name` takes one word; the line is skipped from `red` on"],
    ),
    (
        "a colour beyond 255",
        "materials
  entry
    name red
    color 300 0 0
  endentry
endmaterials",
        &[
            "4:11: warning: the components of a colour go from 0 to 255; this one is taken as 255 0 0",
        ],
    ),
    (
        "a colour of two numbers",
        "materials
  entry
    name red
    color 255 0
  endentry
endmaterials",
        &["4:5: error: `color` takes 3 numbers, but only 2 are given"],
    ),
    (
        "a colour with a name",
        "materials
  entry
    name red
    color blue
  endentry
endmaterials",
        &["4:11: error: `blue` is not a number; `color` takes 3 numbers"],
    ),
    (
        "an alpha in percent",
        "materials
  entry
    name red
    alpha 50
  endentry
endmaterials",
        &["4:11: warning: `alpha` goes from 0 (clear) to 1 (opaque); 50 is taken as 1"],
    ),
    (
        "a reflect in percent",
        "materials
  entry
    name red
    reflect 50
  endentry
endmaterials",
        &["4:13: warning: `reflect` goes from 0 to 1; 50 is read as a percentage, 0.5"],
    ),
    (
        "a reflect beyond percent",
        "materials
  entry
    name red
    reflect 500
  endentry
endmaterials",
        &["4:13: error: `reflect` must be from 0 to 1, but is 500"],
    ),
    (
        "a negative refract",
        "materials
  entry
    name red
    refract -1
  endentry
endmaterials",
        &["4:13: error: `refract` must be 0 or more, but is -1"],
    ),
    (
        "a field that no material has",
        "materials
  entry
    name red
    roughness 0.5
  endentry
endmaterials",
        &["4:5: warning: `entry` has no `roughness`, so its line is skipped"],
    ),
    (
        "a light of negative power",
        "lights
  point
    coords 0 0 9
    power -5
  endpoint
endlights",
        &["4:11: error: `power` must be 0 or more, but is -5"],
    ),
    (
        "a light without a place",
        "lights
  point
    power 5
  endpoint
endlights",
        &["2:3: error: this `point` has no `coords`"],
    ),
    (
        "a light without its block",
        "lights
  coords 0 0 9
  power 5
endlights",
        &[
            "2:3: warning: `lights` has no `coords`, so its line is skipped; `coords` belongs in `point` or `sphere`",
            "3:3: warning: `lights` has no `power`, so its line is skipped; `power` belongs in `reference` or `point`",
        ],
    ),
    (
        "a reference of no power",
        "lights
  reference power 0 distance 1 endreference
  point
    coords 0 0 9
    power 5
  endpoint
endlights",
        &["2:19: error: `power` must be above 0, but is 0"],
    ),
    (
        "a reference without a distance",
        "lights
  reference power 1 endreference
  point
    coords 0 0 9
    power 5
  endpoint
endlights",
        &["2:3: warning: this `reference` has no `distance`, which is taken as 1"],
    ),
    (
        "ambient of two numbers",
        "lights
  ambient 1 2
  point
    coords 0 0 9
    power 5
  endpoint
endlights",
        &["2:11: error: `ambient` takes one number or three, but two are given"],
    ),
    (
        "a negative ambient",
        "lights
  ambient -1
  point
    coords 0 0 9
    power 5
  endpoint
endlights",
        &["2:11: error: the numbers of `ambient` must be 0 or more"],
    ),
    (
        "dots where the list goes on",
        "lights
  point
    coords 0 0 9
    power 5
  endpoint
  ...
endlights",
        &["6:3: warning: `...` has no meaning here and is skipped"],
    ),
    (
        "a number from nowhere",
        "geometry
5
endgeometry",
        &["2:1: error: expected a keyword, found `5`"],
    ),
    (
        "an unknown block",
        "materials entry name red endentry endmaterials
geometry
  cylinder
    radius 1
  endcylinder
endgeometry",
        &["3:3: warning: the block `cylinder` is unknown and is skipped"],
    ),
    (
        "a word from another language",
        "geometry
  шар 0 0 0
endgeometry",
        &["2:3: warning: `geometry` has no `шар`, so its line is skipped"],
    ),
];

#[test]
fn every_mistake_is_told_at_its_place() {
    for (name, text, told) in MISTAKES {
        eprintln!("{name}");
        check_told(text, told);
    }
}
