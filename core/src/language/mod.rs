//! The rt language: text into a scene, every mistake told at its place.

// Words, and what is told of them.
mod block;
mod diagnostic;
mod drawing;
mod encoding;
mod lexer;
mod suggestion;

// From word to word.
mod field;
mod walk;

// The sections of a text, and the files that it names.
mod direction;
mod files;
mod geometry;
mod lights;
mod materials;
mod pieces;
mod symbol;
mod triangles;
mod viewport;

// All of it.
mod reader;

pub use self::{
    diagnostic::{Diagnostic, Omitted, Related, Severity},
    drawing::{Style, draw_diagnostics},
    files::{Resolve, referenced_files},
    reader::Reading,
};

use self::reader::Reader;
use crate::transfer::Transfer;

/// Reads a scene.
///
/// ```
/// use rtfarm_core::language::read_scene;
///
/// let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
/// let reading = read_scene(b"geometry\n  sphere coords 0 0 0 radius -1 endsphere\nendgeometry", &nothing);
/// let told: Vec<_> = reading.diagnostics.iter().map(|d| format!("{}: {}", d.at, d.message)).collect();
/// assert_eq!(
///     told,
///     ["2:3: this `sphere` has no `material`", "2:30: `radius` must be above 0, but is -1"]
/// );
/// ```
pub fn read_scene(text: &[u8], resolve: &Resolve<'_>) -> Reading {
    read_scene_with(text, resolve, Transfer::None)
}

/// Reads a scene whose colours are encoded: those of materials, textures, point lights and the
/// background. `ambient` is an amount of light.
pub fn read_scene_with(text: &[u8], resolve: &Resolve<'_>, transfer: Transfer) -> Reading {
    read_scene_in_pieces(text, resolve, transfer, pieces::PIECE)
}

/// Reads a scene whose triangles are parsed in parallel by pieces of about so many bytes.
fn read_scene_in_pieces(
    text: &[u8],
    resolve: &Resolve<'_>,
    transfer: Transfer,
    piece: usize,
) -> Reading {
    let mut reader = Reader::read(text, transfer, piece, &[]);
    let surprising = reader.textured_after_use();
    if !surprising.is_empty() {
        // Copies were judged as if these materials had no texture. Once more, knowing better.
        reader = Reader::read(text, transfer, piece, &surprising);
    }
    reader.finish(resolve)
}

#[cfg(test)]
mod tests {
    use super::{pieces::PIECE, *};

    /// Reads with pieces of a few bytes on two threads, with whole pieces on one thread, and
    /// compares.
    fn check_same(text: &str) -> Reading {
        let read = |threads: usize, piece: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                read_scene_in_pieces(
                    text.as_bytes(),
                    &|_| Err(std::io::ErrorKind::NotFound.into()),
                    Transfer::None,
                    piece,
                )
            })
        };
        let expected = read(1, usize::MAX);
        for (threads, piece) in [(1, 1), (2, 1), (2, 100), (3, 333), (2, 1000), (2, PIECE)] {
            let reading = read(threads, piece);
            assert_eq!(
                reading.diagnostics, expected.diagnostics,
                "{threads} threads, pieces of {piece}"
            );
            assert_eq!(reading.omitted, expected.omitted);
            assert_eq!(format!("{:?}", reading.scene), format!("{:?}", expected.scene));
        }
        expected
    }

    fn scene(shapes: impl IntoIterator<Item = String>) -> String {
        let shapes: String = shapes.into_iter().collect();
        format!(
            "materials entry name a endentry entry name b endentry endmaterials\ngeometry\n{shapes}endgeometry\n"
        )
    }

    fn triangle(k: usize) -> String {
        let material = ["a", "b", "b"][k % 3];
        format!(
            "triangle\n\tvertex 0 0 {k}\n\tvertex 1 0 {k}.5\n\tvertex 0 1 {k}e-1\n\tmaterial {material}\nendtriangle\n"
        )
    }

    #[test]
    fn pieces_give_what_the_whole_gives() {
        let reading = check_same(&scene((0..1000).map(triangle)));
        assert_eq!(reading.scene.unwrap().triangles.len(), 1000);
    }

    #[test]
    fn copies_and_flat_ones_are_found_across_pieces() {
        let flat = "triangle vertex 0 0 0 vertex 1 1 1 vertex 2 2 2 material a endtriangle\n";
        let reading = check_same(&scene(
            (0..1000).map(|k| if k % 7 == 0 { flat.into() } else { triangle(k % 400) }),
        ));
        let scene = reading.scene.unwrap();
        assert_eq!(
            (scene.dropped.zero_area, scene.dropped.zero_area + scene.dropped.duplicates),
            (143, 600)
        );
    }

    #[test]
    fn anything_between_plain_triangles_is_read() {
        let odd = [
            "# a comment\n triangle\n",
            "sphere coords 0 0 0 radius 1 material a endsphere\n",
            "triangle vertex 0 0 0 texcoord 0 0 vertex 1 0 0 texcoord 1 0 vertex 0 1 0 texcoord 0 1 material b endtriangle",
            "triangle material a vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 endtriangle triangle\n",
            "triangle vertex 0 0 0\n vertex 1 0 0 vertex 0 1 x\n material\ntriangle\nendtriangle\n",
            "union\n\n",
            "endtriangle\n",
            "endgeometry\ngeometry\n",
            "triangle vertex 0 0 0 vertex 1 0 0 vertex 0 1 1e999 material a endtriangle\n",
            "triangle vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 material unknown endtriangle\n",
            "fog\ntriangle\nendfog\n",
            "… \u{a0}",
        ];
        for odd in odd {
            for every in [1, 10, 97] {
                check_same(&scene(
                    (0..200).map(|k| {
                        format!("{}{}", if k % every == 0 { odd } else { "" }, triangle(k))
                    }),
                ));
            }
        }
    }

    #[test]
    fn triangles_on_one_line_are_read() {
        let reading = check_same(&scene((0..500).map(|k| triangle(k).replace('\n', " "))));
        assert_eq!(reading.scene.unwrap().triangles.len(), 500);
    }
}
