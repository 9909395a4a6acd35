//! How the allocator keeps memory.

/// From this size on, what is allocated is returned to the system as soon as it is freed.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const RETURNED: i32 = 1 << 20;

/// Has large pieces of memory returned once they are freed. A scene that is read and prepared takes
/// several times its size for a moment; glibc, which learns from the first pieces that are freed, would
/// keep as much for as long as the picture takes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[expect(unsafe_code, reason = "only the allocator can be told")]
pub(crate) fn return_what_is_freed() {
    // SAFETY: `mallopt` takes two numbers and touches nothing that is allocated; this comes before other
    // threads start.
    unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, RETURNED) };
}

/// Other allocators do as they do.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(crate) fn return_what_is_freed() {}
