//! The reader of whole scene texts.
//!
//! It walks over the words once and never stops at a mistake: it notes it, skips as little as it
//! can and goes on, so that an author learns of all mistakes at once. Names of materials are
//! resolved at the end, since they may be used before they are defined; so are byte offsets into
//! lines and columns.

use super::{
    block::Block,
    diagnostic::{Diagnostic, Omitted, Places, Report, Severity},
    encoding::check_encoding,
    files::{Resolve, read_meshes, read_textures},
    geometry::Shapes,
    lights::Lights,
    materials::Materials,
    symbol::Symbols,
    viewport::Picture,
    walk::Walk,
};
use crate::{scene::Scene, transfer::Transfer};

/// What reading a scene text gave.
#[derive(Debug)]
pub struct Reading {
    /// The scene, unless there were errors.
    pub scene: Option<Scene>,
    /// Errors and warnings in the order of the text; the first hundred of either.
    pub diagnostics: Vec<Diagnostic>,
    /// Errors and warnings beyond those.
    pub omitted: Omitted,
}

impl Reading {
    /// The strict reading: every warning is an error.
    #[must_use]
    pub fn into_strict(self) -> Self {
        let Self { scene, mut diagnostics, omitted } = self;
        let scene = scene.filter(|_| diagnostics.is_empty());
        for diagnostic in &mut diagnostics {
            diagnostic.severity = Severity::Error;
        }
        let omitted = Omitted { errors: omitted.errors + omitted.warnings, warnings: 0 };
        Self { scene, diagnostics, omitted }
    }
}

/// What has been read so far, section by section.
pub(super) struct Reader<'t> {
    text: &'t [u8],
    transfer: Transfer,
    walk: Walk<'t>,
    symbols: Symbols<'t>,
    picture: Picture<'t>,
    materials: Materials<'t>,
    lights: Lights<'t>,
    shapes: Shapes<'t>,
}

impl<'t> Reader<'t> {
    /// Reads a text whose colours are encoded by `transfer`. Runs of triangles are parsed in
    /// parallel by pieces of about so many bytes; the materials of `textured` names will turn out
    /// to have textures.
    pub(super) fn read(
        text: &'t [u8],
        transfer: Transfer,
        piece: usize,
        textured: &[Vec<u8>],
    ) -> Self {
        let mut report = Report::default();
        let is_text = check_encoding(text, &mut report);
        let mut reader = Self {
            text,
            transfer,
            walk: Walk::new(text, report),
            symbols: Symbols::new(textured),
            picture: Picture::default(),
            materials: Materials::default(),
            lights: Lights::default(),
            shapes: Shapes::new(piece),
        };
        if is_text {
            reader.read_sections();
        }
        reader
    }

    fn read_sections(&mut self) {
        let Self { transfer, walk, symbols, picture, materials, lights, shapes, .. } = self;
        while let Some(word) = walk.next() {
            match Block::opened_by(&word) {
                Some(Block::Viewport) => picture.read_viewport(walk, word, *transfer),
                Some(Block::Materials) => materials.read_materials(walk, symbols, word, *transfer),
                Some(Block::Lights) => lights.read_lights(walk, word, *transfer),
                Some(Block::Geometry) => shapes.read_geometry(walk, symbols, word),
                _ if picture.read_field(walk, word, *transfer) => {}
                _ => walk.skip_unknown_keyword(word),
            }
        }
    }

    /// Names of materials of which copies of triangles were judged as if they had no texture,
    /// though they have one: the text must be read again with them.
    pub(super) fn textured_after_use(&self) -> Vec<Vec<u8>> {
        self.symbols.textured_after_use()
    }

    /// Resolves what could not be while reading.
    pub(super) fn finish(self, resolve: &Resolve<'_>) -> Reading {
        let mut report = self.walk.report;
        let mut scene = Scene { transfer: self.transfer, ..Scene::default() };
        self.picture.finish(&mut report, &mut scene);
        self.lights.finish(&mut report, &mut scene);
        self.materials.report_names(&self.symbols, &mut report);
        let mesh_files = self.shapes.finish(&self.symbols, &mut scene);
        scene.materials = self.materials.list;
        read_textures(&self.materials.textures, resolve, &mut report, &mut scene);
        read_meshes(&mesh_files, resolve, &mut report, &mut scene);
        let scene = report.is_free_of_errors().then_some(scene);
        let places = Places::new(self.text, report.offsets());
        let (diagnostics, omitted) = report.finish(&places);
        Reading { scene, diagnostics, omitted }
    }
}
