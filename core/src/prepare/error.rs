//! What keeps a scene from being prepared.

use crate::prepared::node::Child;

/// Why a scene cannot be prepared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// There is nothing to look through.
    #[error("a picture needs a `viewport` block with origin, topleft, bottomleft and topright")]
    NoViewport,
    /// The scene has more faces than indices reach.
    #[error("the scene has {0} faces; at most {limit} can be rendered", limit = Child::ITEM_LIMIT)]
    TooManyFaces(u64),
    /// A light that, seen in the scene's own units, is no finite number.
    #[error("light {0} (counted from 1) is too strong for numbers to hold")]
    Light(usize),
}
