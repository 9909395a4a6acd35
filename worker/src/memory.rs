//! How much memory there is for this process: what the machine has, or less where its control
//! groups allow less.

use std::{fs, path::Path};

/// Of the memory that there is, this is left to pixels, threads and everybody else.
const MARGIN: u64 = 4;

/// Bytes that prepared scenes may have here together: three quarters of what there is. `None` when
/// the system does not tell.
pub fn memory_for_scenes() -> Option<u64> {
    let read = |path: &Path| fs::read_to_string(path).ok();
    let there_is = memory(&read)?;
    Some(there_is - there_is / MARGIN)
}

/// Bytes of memory, by files that tell of it. See `proc_meminfo(5)` and `cgroups(7)`.
fn memory(read: &dyn Fn(&Path) -> Option<String>) -> Option<u64> {
    let told = read(Path::new("/proc/meminfo"))?;
    let total = told.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let total: u64 = total.trim().strip_suffix("kB")?.trim().parse().ok()?;
    let groups = read(Path::new("/proc/self/cgroup")).unwrap_or_default();
    let limits = groups.lines().flat_map(|line| {
        let mut fields = line.splitn(3, ':').skip(1);
        let (controllers, group) = (fields.next().unwrap_or(""), fields.next().unwrap_or(""));
        let (root, file) = match controllers {
            "" => ("/sys/fs/cgroup", "memory.max"),
            "memory" => ("/sys/fs/cgroup/memory", "memory.limit_in_bytes"),
            _ => return Vec::new(),
        };
        // Each group is limited by those that it is in. In a container the path may not be there.
        let groups = Path::new(group).ancestors().map(|group| {
            let group = group.strip_prefix("/").unwrap_or(group);
            read(&Path::new(root).join(group).join(file))?.trim().parse().ok()
        });
        groups.flatten().collect::<Vec<u64>>()
    });
    Some(limits.fold(total * 1024, u64::min))
}

#[cfg(test)]
mod tests {
    use super::*;

    const MEMINFO: &str = "MemTotal:       16000 kB\nMemFree:         1 kB\n";

    fn memory_of(files: &[(&str, &str)]) -> Option<u64> {
        memory(&|path| {
            let found = files.iter().find(|(name, _)| Path::new(name) == path);
            found.map(|(_, text)| (*text).to_owned())
        })
    }

    #[test]
    fn the_least_that_machine_and_groups_allow_counts() {
        let all = 16_000 * 1024;
        assert_eq!(memory_of(&[("/proc/meminfo", MEMINFO)]), Some(all));
        let version_2 = [
            ("/proc/meminfo", MEMINFO),
            ("/proc/self/cgroup", "0::/a/b\n"),
            ("/sys/fs/cgroup/a/b/memory.max", "max\n"),
            ("/sys/fs/cgroup/a/memory.max", "5000000\n"),
            ("/sys/fs/cgroup/memory.max", "7000000\n"),
        ];
        assert_eq!(memory_of(&version_2), Some(5_000_000));
        let version_1 = [
            ("/proc/meminfo", MEMINFO),
            ("/proc/self/cgroup", "5:cpu:/a\n4:memory:/c:d\n"),
            ("/sys/fs/cgroup/memory/c:d/memory.limit_in_bytes", "6000000\n"),
            ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n"),
        ];
        assert_eq!(memory_of(&version_1), Some(6_000_000));
        assert_eq!(memory_of(&[]), None);
    }
}
