//! Memory that the process no longer needs.

/// Gives the system back what was freed. To read and prepare a scene takes several times its size for
/// a moment, and the allocator would keep that for as long as the picture takes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[expect(unsafe_code, reason = "only the allocator knows what it keeps")]
pub(crate) fn give_back() {
    // SAFETY: `malloc_trim` takes nothing that is in use, and any thread may call it at any time.
    unsafe { libc::malloc_trim(0) };
}

/// Other allocators give it back on their own, or never.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(crate) fn give_back() {}
