//! How much memory is left.

/// Bytes that may still be taken without swapping, the limit of a control group included; `None` where the system does not say.
#[must_use]
pub fn available_bytes() -> Option<u64> {
    let machine = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| of_machine(&text));
    let number = |name: &str| std::fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok()?.trim().parse::<u64>().ok();
    // Version 2; without a limit the file says `max`, which is no number.
    let group = number("memory.max").zip(number("memory.current")).map(|(most, used)| most.saturating_sub(used));
    match (machine, group) {
        (Some(machine), Some(group)) => Some(machine.min(group)),
        (one, other) => one.or(other),
    }
}

fn of_machine(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

/// `None` where `needed` bytes are there, else a sentence with the numbers.
#[must_use]
pub fn refusal(what: &str, needed: u64, available: Option<u64>) -> Option<String> {
    let available = available.filter(|available| needed > *available)?;
    let gib = |bytes: u64| bytes as f64 / (1u64 << 30) as f64;
    Some(format!("{what} need {:.1} GiB of memory, {:.1} GiB are free", gib(needed), gib(available)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_available_is_read_and_compared() {
        assert_eq!(of_machine("MemTotal: 9 kB\nMemAvailable:   2097152 kB\n"), Some(2 << 30));
        assert_eq!(of_machine("MemTotal: 9 kB\n"), None);
        assert!(available_bytes().is_none_or(|bytes| bytes > 1 << 20));
        let text = refusal("1024 x 1024 x 1024 voxels", 6 << 30, Some(3 << 30)).expect("too much");
        assert_eq!(text, "1024 x 1024 x 1024 voxels need 6.0 GiB of memory, 3.0 GiB are free");
        assert_eq!(refusal("few voxels", 3 << 30, Some(3 << 30)), None);
        assert_eq!(refusal("any", u64::MAX, None), None);
    }
}
