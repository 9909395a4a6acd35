//! Maps files into memory, so that all workers of a machine share one copy of a scene.

use std::{fs::File, io};

use memmap2::Mmap;

/// A file's bytes, aligned to a page.
#[derive(Debug)]
pub(crate) struct Map(Mmap);

impl Map {
    /// Maps a whole file that nobody changes any more: either it has no name, or it was written
    /// once, is read-only and stands in a folder of this user alone.
    #[expect(unsafe_code, reason = "a map is as good as what is known about its file")]
    pub(crate) fn new(file: &File) -> io::Result<Self> {
        // SAFETY: the caller's files are never written again nor cut short, so the bytes do not
        // change while they are borrowed. Their content is checked before it is trusted.
        unsafe { Mmap::map(file) }.map(Self)
    }
}

impl AsRef<[u8]> for Map {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}
