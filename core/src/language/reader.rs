//! Scene text into a [`Scene`].
//!
//! The reader walks over the words once and never stops at a mistake: it notes it, skips as
//! little as it can and goes on, so that an author learns of all mistakes at once. Names of
//! materials are resolved at the end, since they may be used before they are defined; so are
//! byte offsets into lines and columns.

use std::{collections::HashMap, io, sync::Arc};

use glam::DVec3;

use super::{
    block::Block,
    diagnostic::{Places, Report, shown},
    field::Field,
    geometry::direction,
    lexer::Word,
    pieces,
    suggestion::suggestion,
    symbol::Symbols,
    triangles::Triangles,
    walk::Blocks,
};
use crate::{
    assets::{
        mesh::{self, MeshFile},
        texture,
    },
    exact::predicates,
    scene::{Light, Material, MeshShape, Scene, SolidNode, Viewport},
    tile::Size,
    transfer::Transfer,
};

pub use super::{
    diagnostic::{Diagnostic, Omitted, Related, Severity},
    drawing::{Style, draw_diagnostics},
};

/// Reads the bytes of a file that a scene names; the path is as the scene has it.
pub type Resolve<'a> = dyn Fn(&str) -> io::Result<Vec<u8>> + Sync + 'a;

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

/// Reads a scene.
///
/// ```
/// use rtfarm_core::read::read_scene;
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
pub(crate) fn read_scene_in_pieces(
    text: &[u8],
    resolve: &Resolve<'_>,
    transfer: Transfer,
    piece: usize,
) -> Reading {
    let mut reader = Reader::new(text, transfer, piece, &[]);
    reader.read_file();
    let surprising = reader.symbols.textured_after_use();
    if !surprising.is_empty() {
        // Copies were judged as if these materials had no texture. Once more, knowing better.
        reader = Reader::new(text, transfer, piece, &surprising);
        reader.read_file();
    }
    reader.finish(resolve)
}

/// What has been read so far.
pub(super) struct Reader<'t> {
    pub(super) text: &'t [u8],
    /// Whether it is worth reading.
    is_text: bool,
    pub(super) piece: usize,
    pub(super) blocks: Blocks<'t>,
    pub(super) symbols: Symbols<'t>,
    pub(super) triangles: Triangles,
    pub(super) scene: Scene,
    /// The next primitive's number.
    pub(super) primitive: u64,
    viewport: Option<Word<'t>>,
    width: Field<'t, u32>,
    height: Field<'t, u32>,
    background: Field<'t, DVec3>,
    ambient: Field<'t, DVec3>,
    /// Power and distance of each `reference`.
    references: Vec<(f64, f64)>,
    lights: Vec<PointLight<'t>>,
    /// The file name of each material's texture.
    texture_names: Vec<(u32, Word<'t>)>,
    /// What each mesh's file is called.
    pub(super) mesh_files: Vec<Word<'t>>,
}

/// A point light before the reference that governs it is known.
struct PointLight<'t> {
    word: Word<'t>,
    position: DVec3,
    power: f64,
    color: DVec3,
    /// How many references stand before it.
    references_before: usize,
}

impl<'t> Reader<'t> {
    fn new(text: &'t [u8], transfer: Transfer, piece: usize, textured: &[Vec<u8>]) -> Self {
        let mut report = Report::default();
        let is_text = check_encoding(text, &mut report);
        Self {
            text,
            is_text,
            piece,
            blocks: Blocks::new(text, report),
            symbols: Symbols::new(textured),
            triangles: Triangles::new(),
            scene: Scene { transfer, ..Scene::default() },
            primitive: 0,
            viewport: None,
            width: Field::default(),
            height: Field::default(),
            background: Field::default(),
            ambient: Field::default(),
            references: Vec::new(),
            lights: Vec::new(),
            texture_names: Vec::new(),
            mesh_files: Vec::new(),
        }
    }

    pub(super) fn report(&mut self) -> &mut Report {
        &mut self.blocks.report
    }

    fn read_file(&mut self) {
        while self.is_text
            && let Some(word) = self.blocks.next()
        {
            match Block::opened_by(&word) {
                Some(block @ Block::Viewport) => self.read_viewport(word, block),
                Some(Block::Materials) => self.read_materials(word),
                Some(Block::Lights) => self.read_lights(word),
                Some(Block::Geometry) => self.read_geometry(word),
                _ if self.read_picture_field(word) => {}
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
    }

    fn read_viewport(&mut self, opening: Word<'t>, block: Block) {
        if let Some(first) = self.viewport {
            self.report().error_with(
                opening.span(),
                || "a scene has one `viewport`; this is one more".into(),
                || Some((first.span(), "the first one".into())),
            );
        }
        self.blocks.enter(block, opening);
        let [mut origin, mut top_left, mut bottom_left, mut top_right] = [Field::default(); 4];
        loop {
            let Some(word) = self.blocks.next() else {
                if self.blocks.innermost() == Block::Viewport {
                    continue; // That was the end of `screen`.
                }
                break;
            };
            let corner = match word.bytes {
                b"origin" => &mut origin,
                b"topleft" => &mut top_left,
                b"bottomleft" => &mut bottom_left,
                b"topright" => &mut top_right,
                b"screen" => {
                    self.warn_synonym(word, "the corners directly in `viewport`");
                    self.blocks.enter(Block::Screen, word);
                    continue;
                }
                _ if self.read_picture_field(word) => continue,
                _ => {
                    self.blocks.skip_unknown_keyword(word);
                    continue;
                }
            };
            let value = self.blocks.numbers(word).map(DVec3::from);
            corner.set(&mut self.blocks.report, word, value);
        }
        let (eye_word, corner_word) =
            (origin.word.unwrap_or(opening), top_left.word.unwrap_or(opening));
        let origin = origin.require(&mut self.blocks, opening, "origin");
        let corners = [(top_left, "topleft"), (bottom_left, "bottomleft"), (top_right, "topright")]
            .map(|(corner, name)| corner.require(&mut self.blocks, opening, name));
        if self.viewport.is_none()
            && let (Some(eye), [Some(top_left), Some(bottom_left), Some(top_right)]) =
                (origin, corners)
        {
            let viewport = Viewport { eye, top_left, bottom_left, top_right };
            check_viewport(&viewport, eye_word, corner_word, &mut self.blocks.report);
            self.scene.viewport = Some(viewport);
        }
        self.viewport.get_or_insert(opening);
    }

    /// Reads a field that belongs to the picture as a whole; whether `word` is one.
    fn read_picture_field(&mut self, word: Word<'t>) -> bool {
        let is_at_home = matches!(self.blocks.innermost(), Block::Viewport | Block::Screen);
        match word.bytes {
            b"background" => {
                if !is_at_home {
                    self.warn_synonym(word, "`background` in `viewport`");
                }
                let color = self.encoded_color(word);
                self.background.set(&mut self.blocks.report, word, color);
            }
            b"size" if is_at_home => self.read_size(word),
            b"resolution" => {
                self.warn_synonym(word, "`size` in `viewport`");
                self.read_size(word);
            }
            b"xres" | b"yres" => {
                self.warn_synonym(word, "`size` in `viewport`");
                let side = self.blocks.number(word).and_then(|side| self.side(side));
                let field = if word.bytes == b"xres" { &mut self.width } else { &mut self.height };
                field.set(&mut self.blocks.report, word, side);
            }
            _ => return false,
        }
        true
    }

    fn read_size(&mut self, word: Word<'t>) {
        let sides = self
            .blocks
            .numbers(word)
            .and_then(|[width, height]| Some((self.side(width)?, self.side(height)?)));
        self.width.set(&mut self.blocks.report, word, sides.map(|(width, _)| width));
        self.height.word = Some(word);
        self.height.value = sides.map(|(_, height)| height);
    }

    /// A side of the picture in pixels.
    fn side(&mut self, side: f64) -> Option<u32> {
        let is_sound = side.fract() == 0.0 && (1.0..=f64::from(Size::MAX_SIDE)).contains(&side);
        if !is_sound {
            self.refuse_value(|| {
                format!(
                    "a picture's sides are whole numbers from 1 to {}, not {side}",
                    Size::MAX_SIDE
                )
            });
        }
        is_sound.then_some(side as u32)
    }

    /// Reports that the value that was read last cannot be used.
    pub(super) fn refuse_value(&mut self, message: impl FnOnce() -> String) {
        let span = self.blocks.value_span();
        self.report().error(span, message);
    }

    /// A colour where 255 is 1, that may be brighter but not negative.
    fn color(&mut self, word: Word<'t>) -> Option<DVec3> {
        let color = DVec3::from(self.blocks.numbers(word)?);
        let is_color = color.min_element() >= 0.0;
        if !is_color {
            self.refuse_value(|| {
                format!(
                    "the parts of a colour must be 0 or more, but one is {}",
                    color.min_element()
                )
            });
        }
        is_color.then_some(color / 255.0)
    }

    /// The light of such a colour.
    fn encoded_color(&mut self, word: Word<'t>) -> Option<DVec3> {
        let color = self.color(word)?;
        let light = self.decode(color);
        if !light.is_finite() {
            self.refuse_value(|| "this colour is too bright to be computed with".into());
        }
        light.is_finite().then_some(light)
    }

    fn decode(&self, color: DVec3) -> DVec3 {
        DVec3::from(color.to_array().map(|number| self.scene.transfer.decode(number)))
    }

    pub(super) fn warn_synonym(&mut self, word: Word<'t>, instead: &str) {
        self.report().warn(word.span(), || format!("{} is read as {instead}", shown(word.bytes)));
    }

    fn read_materials(&mut self, opening: Word<'t>) {
        self.blocks.enter(Block::Materials, opening);
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"entry" => self.read_entry(word),
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
    }

    fn read_entry(&mut self, opening: Word<'t>) {
        self.blocks.enter(Block::Entry, opening);
        let (mut name, mut color, mut texture) =
            (Field::default(), Field::default(), Field::default());
        let [mut alpha, mut reflect, mut refract] = [Field::default(); 3];
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"name" => {
                    let value = self.blocks.value_word(word, "a name");
                    name.set(&mut self.blocks.report, word, value);
                }
                b"color" => {
                    let value = self.blocks.numbers(word).map(|parts| self.clamp_color(parts));
                    color.set(&mut self.blocks.report, word, value);
                }
                b"alpha" => {
                    let value = self.blocks.number(word).map(|value| self.clamp_alpha(value));
                    alpha.set(&mut self.blocks.report, word, value);
                }
                b"reflect" => {
                    let value = self.blocks.number(word).and_then(|value| self.share(value));
                    reflect.set(&mut self.blocks.report, word, value);
                }
                b"refract" => {
                    let value =
                        self.blocks.number(word).and_then(|value| self.not_negative(word, value));
                    refract.set(&mut self.blocks.report, word, value);
                }
                b"texture" | b"image" => {
                    if word.bytes == b"image" {
                        self.warn_synonym(word, "`texture`");
                    }
                    let value = self.file_name(word);
                    texture.set(&mut self.blocks.report, word, value);
                }
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
        let name = name.require(&mut self.blocks, opening, "name");
        let Some(name) = name else { return };
        let index = self.scene.materials.len() as u32;
        let symbol = self.symbols.symbol(name.bytes);
        if let Some((_, first)) = self.symbols.get(symbol).definition {
            self.report().error_with(
                name.span(),
                || format!("a material {} is there already", shown(name.bytes)),
                || Some((first.span(), "the first one".into())),
            );
            return;
        }
        if !is_identifier(name.bytes) {
            self.report().warn(name.span(), || {
                format!(
                    "{} is no C++ identifier (letters, digits and `_`, no digit first); taken as it is",
                    shown(name.bytes)
                )
            });
        }
        let entry = self.symbols.get_mut(symbol);
        entry.definition = Some((index, name));
        entry.is_textured = texture.value.is_some();
        self.scene.materials.push(Material {
            name: String::from_utf8_lossy(name.bytes).into_owned(),
            color: color.value.unwrap_or(DVec3::ONE),
            alpha: alpha.value.unwrap_or(if refract.value > Some(0.0) { 0.0 } else { 1.0 }),
            reflect: reflect.value.unwrap_or(0.0),
            refract: refract.value.unwrap_or(0.0),
            texture: None,
        });
        self.texture_names.extend(texture.value.map(|file| (index, file)));
    }

    fn clamp_color(&mut self, parts: [f64; 3]) -> DVec3 {
        let clamped = parts.map(|part| part.clamp(0.0, 255.0));
        if parts.iter().any(|part| !(0.0..=255.0).contains(part)) {
            let span = self.blocks.value_span();
            self.report().warn(span, || {
                let [r, g, b] = clamped;
                format!("the parts of a colour are from 0 to 255; taken as {r} {g} {b}")
            });
        }
        self.decode(DVec3::from(clamped) / 255.0)
    }

    fn clamp_alpha(&mut self, alpha: f64) -> f64 {
        let clamped = alpha.clamp(0.0, 1.0);
        if !(0.0..=1.0).contains(&alpha) {
            let span = self.blocks.value_span();
            self.report().warn(span, || {
                format!("alpha is from 0, clear, to 1, opaque; {alpha} is taken as {clamped}")
            });
        }
        clamped
    }

    /// The mirrored share, or a percentage of it.
    fn share(&mut self, reflect: f64) -> Option<f64> {
        match reflect {
            0.0..=1.0 => Some(reflect),
            1.0..=100.0 => {
                let (share, span) = (reflect / 100.0, self.blocks.value_span());
                self.report().warn(span, || {
                    format!("reflect is from 0 to 1; {reflect} is read as percent, {share}")
                });
                Some(share)
            }
            _ => {
                self.refuse_value(|| format!("reflect must be from 0 to 1, but is {reflect}"));
                None
            }
        }
    }

    fn not_negative(&mut self, word: Word<'t>, value: f64) -> Option<f64> {
        if value < 0.0 {
            self.refuse_value(|| {
                format!("{} must be 0 or more, but is {value}", shown(word.bytes))
            });
        }
        (value >= 0.0).then_some(value)
    }

    pub(super) fn above_zero(&mut self, word: Word<'t>, value: f64) -> Option<f64> {
        if value <= 0.0 {
            self.refuse_value(|| format!("{} must be above 0, but is {value}", shown(word.bytes)));
        }
        (value > 0.0).then_some(value)
    }

    pub(super) fn file_name(&mut self, word: Word<'t>) -> Option<Word<'t>> {
        let name = self.blocks.value_word(word, "a file name")?;
        self.blocks.ends_file_name(name).then_some(name)
    }

    fn read_lights(&mut self, opening: Word<'t>) {
        self.blocks.enter(Block::Lights, opening);
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"reference" => self.read_reference(word),
                b"point" => self.read_point(word),
                b"ambient" => {
                    let light = self.read_ambient(word);
                    self.ambient.set(&mut self.blocks.report, word, light);
                }
                b"backlight" => {
                    self.warn_synonym(word, "`ambient`");
                    let light = self.color(word);
                    self.ambient.set(&mut self.blocks.report, word, light);
                }
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
    }

    /// Reads one number, or the three of a colour.
    fn read_ambient(&mut self, word: Word<'t>) -> Option<DVec3> {
        let first = self.blocks.number(word)?;
        let light = match self.blocks.numbers_that_follow() {
            0 => DVec3::splat(first),
            1 => {
                self.refuse_value(|| {
                    "`ambient` takes one number or three, but two stand here".into()
                });
                self.blocks.number(word);
                return None;
            }
            _ => self.blocks.numbers(word).map(|[g, b]| DVec3::new(first, g, b) / 255.0)?,
        };
        if light.min_element() < 0.0 {
            self.refuse_value(|| "ambient light must be 0 or more".into());
            return None;
        }
        Some(light)
    }

    fn read_reference(&mut self, opening: Word<'t>) {
        self.blocks.enter(Block::Reference, opening);
        let [mut power, mut distance] = [Field::default(); 2];
        while let Some(word) = self.blocks.next() {
            let field = match word.bytes {
                b"power" => &mut power,
                b"distance" => &mut distance,
                _ => {
                    self.blocks.skip_unknown_keyword(word);
                    continue;
                }
            };
            let value = self.blocks.number(word).and_then(|value| self.above_zero(word, value));
            field.set(&mut self.blocks.report, word, value);
        }
        for (field, name) in [(&power, "power"), (&distance, "distance")] {
            if field.word.is_none() {
                self.report().warn(opening.span(), || {
                    format!("this `reference` has no `{name}`; taken as 1")
                });
            }
        }
        self.references.push((power.value.unwrap_or(1.0), distance.value.unwrap_or(1.0)));
    }

    fn read_point(&mut self, opening: Word<'t>) {
        self.blocks.enter(Block::Point, opening);
        let (mut coords, mut power, mut color) =
            (Field::default(), Field::default(), Field::default());
        while let Some(word) = self.blocks.next() {
            match word.bytes {
                b"coords" | b"position" => self.read_coords(word, &mut coords),
                b"power" => {
                    let value =
                        self.blocks.number(word).and_then(|value| self.not_negative(word, value));
                    power.set(&mut self.blocks.report, word, value);
                }
                b"color" => {
                    let value = self.encoded_color(word);
                    color.set(&mut self.blocks.report, word, value);
                }
                _ => self.blocks.skip_unknown_keyword(word),
            }
        }
        let position = coords.require(&mut self.blocks, opening, "coords");
        let power = power.require(&mut self.blocks, opening, "power");
        if let (Some(position), Some(power)) = (position, power) {
            self.lights.push(PointLight {
                word: opening,
                position,
                power,
                color: color.value.unwrap_or(DVec3::ONE),
                references_before: self.references.len(),
            });
        }
    }

    pub(super) fn read_coords(&mut self, word: Word<'t>, coords: &mut Field<'t, DVec3>) {
        if word.bytes == b"position" {
            self.warn_synonym(word, "`coords`");
        }
        let value = self.blocks.numbers(word).map(DVec3::from);
        coords.set(&mut self.blocks.report, word, value);
    }

    /// Resolves what could not be while reading.
    fn finish(mut self, resolve: &Resolve<'_>) -> Reading {
        self.finish_picture();
        self.finish_lights();
        self.finish_materials();
        self.read_textures(resolve);
        self.read_meshes(resolve);
        let is_sound = self.blocks.report.is_free_of_errors();
        let places = Places::new(self.text, self.blocks.report.offsets());
        let scene = is_sound.then(|| std::mem::take(&mut self.scene));
        let (diagnostics, omitted) = self.blocks.report.finish(&places);
        Reading { scene, diagnostics, omitted }
    }

    fn finish_picture(&mut self) {
        for (set, other, name) in
            [(self.width, self.height, "yres"), (self.height, self.width, "xres")]
        {
            if let (Some(word), None) = (set.word, other.word) {
                self.report().warn(word.span(), || {
                    format!("{} without `{name}` is skipped", shown(word.bytes))
                });
            }
        }
        if let (Some(width), Some(height)) = (self.width.value, self.height.value) {
            self.scene.size_hint = Size::new(width.into(), height.into()).ok();
        }
        self.scene.background = self.background.value.unwrap_or_default();
        self.scene.ambient = self.ambient.value;
    }

    fn finish_lights(&mut self) {
        for light in std::mem::take(&mut self.lights) {
            let governing = self.references.get(light.references_before.saturating_sub(1));
            let (power, distance) = governing.copied().unwrap_or((1.0, 1.0));
            let intensity = light.power / power * distance * distance * light.color;
            if !intensity.is_finite() {
                self.report().error(light.word.span(), || {
                    "this light is too bright to be computed with: its power over the reference's, times the \
                     reference's distance squared, is beyond 1.8e308"
                        .into()
                });
            }
            self.scene.lights.push(Light { position: light.position, intensity });
        }
    }

    /// Reports names that mean nothing and turns symbols into indices.
    fn finish_materials(&mut self) {
        let report = &mut self.blocks.report;
        let candidates = if self.scene.materials.len() <= 10_000 {
            self.scene.materials.as_slice()
        } else {
            &[]
        };
        for symbol in self.symbols.iter() {
            if let (None, Some(word)) = (symbol.definition, symbol.used) {
                report.error(word.span(), || {
                    let names = candidates.iter().map(|known| known.name.as_str());
                    let hint = suggestion(symbol.name, names)
                        .map(|guess| format!("; did you mean {}?", shown(guess.as_bytes())));
                    let times = (symbol.use_count > 1)
                        .then(|| format!(" (used {} times)", symbol.use_count));
                    let (hint, times) = (hint.unwrap_or_default(), times.unwrap_or_default());
                    format!("no material is named {}{hint}{times}", shown(symbol.name))
                });
            }
            if let (true, Some((word, shape))) = (symbol.is_textured, symbol.untexturable) {
                report.warn(word.span(), || {
                    format!("textures are for triangles and quadrangles; this {shape} shows none")
                });
            }
        }
        let index = |symbol: u32| self.symbols.get(symbol).definition.map_or(0, |(index, _)| index);
        self.scene.dropped = self.triangles.dropped;
        self.scene.triangles = std::mem::take(&mut self.triangles.list);
        self.scene.triangle_texcoords = std::mem::take(&mut self.triangles.texcoords);
        self.scene.spheres.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.scene.triangles.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.scene.quadrangles.iter_mut().for_each(|shape| shape.material = index(shape.material));
        self.scene
            .parallelepipeds
            .iter_mut()
            .for_each(|shape| shape.material = index(shape.material));
        self.scene.meshes.iter_mut().for_each(|shape| shape.material = index(shape.material));
        for node in self.scene.solids.iter_mut().flat_map(|solid| &mut solid.nodes) {
            match node {
                SolidNode::Sphere(shape) => shape.material = index(shape.material),
                SolidNode::Parallelepiped(shape) => shape.material = index(shape.material),
                SolidNode::Operation { .. } => {}
            }
        }
    }

    /// Reads every image once, whatever its paths.
    fn read_textures(&mut self, resolve: &Resolve<'_>) {
        let (scene, report) = (&mut self.scene, &mut self.blocks.report);
        let mut by_path: HashMap<&[u8], Option<u32>> = HashMap::new();
        let mut by_content: HashMap<blake3::Hash, u32> = HashMap::new();
        for (material, name) in std::mem::take(&mut self.texture_names) {
            let index = *by_path.entry(name.bytes).or_insert_with(|| {
                let path = String::from_utf8_lossy(name.bytes);
                let mut read = || {
                    let bytes = resolve(&path).map_err(|error| error.to_string())?;
                    let hash = blake3::hash(&bytes);
                    if let Some(&index) = by_content.get(&hash) {
                        return Ok(index);
                    }
                    let texture =
                        texture::read_texture(&path, &bytes).map_err(|error| error.to_string())?;
                    let index = scene.textures.len() as u32;
                    scene.textures.push(texture);
                    by_content.insert(hash, index);
                    Ok(index)
                };
                let told = |error: String| {
                    report.error(name.span(), || {
                        format!("cannot read the texture {}: {error}", shown(name.bytes))
                    });
                };
                read().map_err(told).ok()
            });
            scene.materials[material as usize].texture = index;
        }
    }

    /// Reads every mesh file once, whatever its paths.
    fn read_meshes(&mut self, resolve: &Resolve<'_>) {
        let (scene, report) = (&mut self.scene, &mut self.blocks.report);
        let mut by_path: HashMap<&[u8], Option<Arc<MeshShape>>> = HashMap::new();
        let mut by_content: HashMap<blake3::Hash, Arc<MeshShape>> = HashMap::new();
        for (mesh, name) in scene.meshes.iter_mut().zip(&self.mesh_files) {
            let shape = by_path.entry(name.bytes).or_insert_with(|| {
                let path = String::from_utf8_lossy(name.bytes);
                let mut read = || {
                    let bytes = resolve(&path).map_err(|error| error.to_string())?;
                    let hash = blake3::hash(&bytes);
                    if let Some(shape) = by_content.get(&hash) {
                        return Ok(Arc::clone(shape));
                    }
                    let MeshFile { shape, dropped } =
                        mesh::read_mesh(&path, &bytes).map_err(|error| error.to_string())?;
                    scene.dropped.zero_area += dropped.zero_area;
                    scene.dropped.duplicates += dropped.duplicates;
                    let shape = Arc::new(shape);
                    by_content.insert(hash, Arc::clone(&shape));
                    Ok(shape)
                };
                let told = |error: String| {
                    report.error(name.span(), || {
                        format!("cannot read the mesh {}: {error}", shown(name.bytes))
                    });
                };
                read().map_err(told).ok()
            });
            if let Some(shape) = shape {
                mesh.shape = Arc::clone(shape);
            }
        }
    }
}

/// A keyword in a sentence.
pub(super) fn plain(word: Word<'_>) -> String {
    String::from_utf8_lossy(word.bytes).into_owned()
}

/// Whether C++ would take `name` as an identifier.
fn is_identifier(name: &[u8]) -> bool {
    let Ok(name) = std::str::from_utf8(name) else { return false };
    name.chars().all(|character| character == '_' || character.is_alphanumeric())
        && name.chars().next().is_some_and(|first| first == '_' || first.is_alphabetic())
}

/// Reports what makes the text no UTF-8; whether its words may make sense all the same.
fn check_encoding(text: &[u8], report: &mut Report) -> bool {
    let head = &text[..text.len().min(1024)];
    if let [0x1f, 0x8b, ..] = text {
        report.error(0..2, || "this file is compressed by gzip; unpack it first".into());
        return false;
    }
    if let [0xff, 0xfe, ..] | [0xfe, 0xff, ..] = text {
        report.error(0..2, || "this file is in UTF-16; save it as UTF-8".into());
        return false;
    }
    if let Some(at) = memchr::memchr(0, head) {
        report.error(at..at + 1, || "a NUL byte stands here: this file is no text".into());
        return false;
    }
    if let Err(error) = std::str::from_utf8(text) {
        let at = error.valid_up_to();
        let length = error.error_len().unwrap_or(text.len() - at);
        report.error(at..at + length, || {
            format!("the byte 0x{:02x} is no UTF-8; save the file as UTF-8", text[at])
        });
    }
    true
}

fn check_viewport(
    viewport: &Viewport,
    eye_word: Word<'_>,
    corner_word: Word<'_>,
    report: &mut Report,
) {
    let Viewport { eye, top_left, bottom_left, top_right } = *viewport;
    if predicates::is_collinear(top_left, bottom_left, top_right) {
        report
            .error(corner_word.span(), || "the three corners of the screen are on one line".into());
    } else if predicates::is_coplanar(top_left, bottom_left, top_right, eye) {
        report.error(eye_word.span(), || "the eye, `origin`, is in the plane of the screen".into());
    } else if ![bottom_left - top_left, top_right - top_left, eye - top_left]
        .iter()
        .all(|edge| edge.is_finite())
    {
        report
            .error(corner_word.span(), || "this viewport is too large to be computed with".into());
    } else {
        let (left, top) = (direction(bottom_left - top_left), direction(top_right - top_left));
        let cosine = left.dot(top);
        if cosine.abs() > RIGHT_ANGLE {
            report.warn(corner_word.span(), || {
                "the screen is no rectangle: its edges at `topleft` are not at a right angle; rendered sheared"
                    .into()
            });
        }
    }
}

/// The largest cosine that passes for a right angle: it shears the largest picture by less than
/// a pixel.
const RIGHT_ANGLE: f64 = 1e-5;
