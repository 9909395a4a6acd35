//! Scene text into a [`Scene`].

use crate::scene::Scene;

/// Reads the bytes of a file that a scene names; the path is as the scene has it.
pub type Resolve<'a> = dyn Fn(&str) -> std::io::Result<Vec<u8>> + Sync + 'a;

/// What reading a scene text gave.
#[derive(Debug)]
pub struct Reading {
    /// The scene, unless there were errors.
    pub scene: Option<Scene>,
    /// Errors and warnings in the order of the text.
    pub diagnostics: Vec<Diagnostic>,
}

/// Whether a diagnostic stops the scene from being used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Severity {
    /// The scene cannot be used.
    Error,
    /// Something had to be guessed.
    Warning,
}

/// One thing to tell the scene's author.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// How bad it is.
    pub severity: Severity,
    /// The line and the column, both from 1, the column in characters.
    pub at: (usize, usize),
    /// What is wrong and what would be right.
    pub message: String,
}

/// Reads `text`.
pub fn read_scene(_text: &[u8], _resolve: &Resolve<'_>) -> Reading {
    Reading { scene: Some(Scene::default()), diagnostics: Vec::new() }
}
