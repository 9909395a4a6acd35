//! A scene as its author wrote it, checked.

use crate::tile::Size;

/// A whole scene.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// The size the file asks for, if it does.
    pub size_hint: Option<Size>,
}
