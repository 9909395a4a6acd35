//! The forms of a prepared scene.

/// What a prepared scene is to be good at. Its pictures do not depend on it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Form {
    /// It is traced fast.
    #[default]
    Fast,
    /// It takes little memory: its leaves hold more faces, the boxes of its hierarchy have 8 bits a
    /// bound, and vertices that single precision holds exactly are kept in it.
    Compact,
}
