//! How memory is taken and kept.

#![expect(unsafe_code, reason = "allocators are told with unsafe calls")]

use std::alloc::{GlobalAlloc, Layout, System};

/// The system's allocator, which takes large pieces in large pages: the arrays of a big scene are
/// written once and read all over, and with pages of 4 KiB to clear and to find these takes a tenth
/// of the time.
pub(crate) struct LargePages;

/// Pieces from this size on are several large pages, so that little is taken and not used.
const LARGE: usize = 8 << 20;

impl LargePages {
    /// Asks for large pages under a piece of memory. Whether there are any is the system's choice,
    /// and nothing but time depends on it.
    fn ask(piece: *mut u8, size: usize) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if size >= LARGE && !piece.is_null() {
            const PAGE: usize = 4096;
            let before = piece.align_offset(PAGE);
            // SAFETY: the pages lie in a piece that is allocated, and the advice changes no
            // content.
            unsafe {
                let whole = (size - before) / PAGE * PAGE;
                libc::madvise(piece.add(before).cast(), whole, libc::MADV_HUGEPAGE);
            }
        }
        piece
    }
}

// SAFETY: the system's allocator does all the work.
unsafe impl GlobalAlloc for LargePages {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller promises what the system's allocator wants.
        Self::ask(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        Self::ask(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, piece: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as above.
        Self::ask(unsafe { System.realloc(piece, layout, size) }, size)
    }

    unsafe fn dealloc(&self, piece: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(piece, layout) }
    }
}

/// From this size on, what is allocated is returned to the system as soon as it is freed.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const RETURNED: i32 = 1 << 20;

/// Has large pieces of memory returned once they are freed. A scene that is read and prepared takes
/// several times its size for a moment; glibc, which learns from the first pieces that are freed,
/// would keep as much for as long as the picture takes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub(crate) fn return_what_is_freed() {
    // SAFETY: `mallopt` takes two numbers and touches nothing that is allocated; this comes before
    // other threads start.
    unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, RETURNED) };
}

/// Other allocators do as they do.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(crate) fn return_what_is_freed() {}
