//! The files that a scene names: textures and meshes.

use std::{
    collections::{HashMap, HashSet},
    io,
    sync::Arc,
};

use super::{
    block::Block,
    diagnostic::{Report, quoted},
    encoding::check_encoding,
    lexer::Word,
    pieces::skip_plain_triangles,
    walk::Walk,
};
use crate::{
    assets::{mesh, texture},
    exact::hash::content_hash,
    scene::Scene,
};

/// Reads the bytes of a file that a scene names; the path is as the scene has it.
pub type Resolve<'a> = dyn Fn(&str) -> io::Result<Vec<u8>> + Sync + 'a;

/// The files that a scene text names, each once and in the order of the text: the textures of its
/// materials and its meshes, under the names that it has for them. For a text without mistakes
/// they are those that reading it asks for; of one with mistakes they may be more. Nothing is
/// opened or decoded.
///
/// ```
/// use rtfarm_core::language::referenced_files;
///
/// let text = b"materials entry name a texture \"my wood.png\" endentry endmaterials
///     geometry mesh file bottle.stl material a endmesh endgeometry # file none.obj";
/// assert_eq!(referenced_files(text), ["my wood.png", "bottle.stl"]);
/// ```
pub fn referenced_files(text: &[u8]) -> Vec<String> {
    let mut unheard = Report::default();
    if !check_encoding(text, &mut unheard) {
        return Vec::new();
    }
    // Large scenes end with millions of words among which there is no field of a file.
    let fields: [&[u8]; 3] = [b"texture", b"image", b"file"];
    let last = fields.iter().filter_map(|field| memchr::memmem::rfind(text, field)).max();
    let mut walk = Walk::new(text, unheard);
    let mut known = HashSet::new();
    let mut names = Vec::new();
    let mut name = |file: Word<'_>| {
        if known.insert(file.bytes.to_owned()) {
            names.push(file.to_text());
        }
    };
    // The file of each open block: where a field is given twice, the last one counts.
    let mut open: Vec<Option<Word<'_>>> = Vec::new();
    while last.is_some_and(|last| walk.lexer.at() <= last) {
        let Some(word) = walk.next() else {
            let Some(file) = open.pop() else { break };
            file.map(&mut name);
            continue;
        };
        if let Some(block) = Block::opened_by(&word) {
            let end = skip_plain_triangles(text, word.start);
            if end > word.start {
                walk.lexer.go_to(end);
            } else {
                walk.enter(block, word);
                open.push(None);
            }
            continue;
        }
        match (walk.innermost(), word.bytes) {
            (Block::Entry, b"texture" | b"image")
            | (Block::Mesh | Block::StlModel, b"file" | b"filename") => {
                let file = walk.file_name(word);
                if let Some(open) = open.last_mut() {
                    *open = file;
                }
            }
            (Block::Entry, b"name") => _ = walk.value_word(word, "a name"),
            (_, b"material") => _ = walk.value_word(word, "the name of a material"),
            (block, field) if block.has_field(field) => {}
            _ => walk.skip_unknown_keyword(word),
        }
    }
    open.into_iter().flatten().for_each(name);
    names
}

/// Reads every image once, whatever its paths, and gives it to the materials that name it.
pub(super) fn read_textures(
    names: &[(u32, Word<'_>)],
    resolve: &Resolve<'_>,
    report: &mut Report,
    scene: &mut Scene,
) {
    let mut files = Files::new("texture", resolve, report);
    for &(material, name) in names {
        let texture = files.read(name, |path, bytes| {
            let texture = texture::read_texture(path, bytes).map_err(|error| error.to_string())?;
            scene.textures.push(texture);
            Ok(scene.textures.len() as u32 - 1)
        });
        scene.materials[material as usize].texture = texture;
    }
}

/// Reads every mesh file once, whatever its paths; `names` are those of the scene's meshes.
pub(super) fn read_meshes(
    names: &[Word<'_>],
    resolve: &Resolve<'_>,
    report: &mut Report,
    scene: &mut Scene,
) {
    let mut files = Files::new("mesh", resolve, report);
    for (mesh, &name) in scene.meshes.iter_mut().zip(names) {
        let shape = files.read(name, |path, bytes| {
            let file = mesh::read_mesh(path, bytes).map_err(|error| error.to_string())?;
            scene.dropped.zero_area += file.dropped.zero_area;
            scene.dropped.duplicates += file.dropped.duplicates;
            Ok(Arc::new(file.shape))
        });
        if let Some(shape) = shape {
            mesh.shape = shape;
        }
    }
}

/// Files of one kind that are read once each, whatever their paths.
struct Files<'a, 't, T> {
    /// What one is called.
    noun: &'static str,
    resolve: &'a Resolve<'a>,
    report: &'a mut Report,
    /// `None` for a file that cannot be read.
    by_path: HashMap<&'t [u8], Option<T>>,
    by_content: HashMap<blake3::Hash, T>,
}

impl<'a, 't, T: Clone> Files<'a, 't, T> {
    fn new(noun: &'static str, resolve: &'a Resolve<'a>, report: &'a mut Report) -> Self {
        Self { noun, resolve, report, by_path: HashMap::new(), by_content: HashMap::new() }
    }

    /// What `decode` makes of the path and the bytes of a file, unless its content is known;
    /// `None` when it cannot be read, which is reported where it is named first.
    fn read(
        &mut self,
        name: Word<'t>,
        decode: impl FnOnce(&str, &[u8]) -> Result<T, String>,
    ) -> Option<T> {
        if let Some(known) = self.by_path.get(name.bytes) {
            return known.clone();
        }
        let file = self.decode(&name.to_text(), decode);
        let file = file.map_err(|error| {
            self.report.error(name.span(), || {
                format!("cannot read the {} {}: {error}", self.noun, quoted(name.bytes))
            });
        });
        self.by_path.entry(name.bytes).or_insert(file.ok()).clone()
    }

    fn decode(
        &mut self,
        path: &str,
        decode: impl FnOnce(&str, &[u8]) -> Result<T, String>,
    ) -> Result<T, String> {
        let bytes = (self.resolve)(path).map_err(|error| error.to_string())?;
        let hash = content_hash(&bytes);
        if let Some(known) = self.by_content.get(&hash) {
            return Ok(known.clone());
        }
        let file = decode(path, &bytes)?;
        self.by_content.insert(hash, file.clone());
        Ok(file)
    }
}
