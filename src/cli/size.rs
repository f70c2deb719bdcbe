//! Sizes in bytes as people write them, and what this machine has.

/// Part of the machine's memory that a run may use where nothing is said: the rest is for the system and for files in cache.
const DEFAULT_PART: f64 = 0.8;

/// Bytes of `2GiB`, `500M`, `1.5g` or `1048576`; `None` for `none`. Without `B` or with `iB` the units are powers of
/// 1024, with a plain `B` (`MB`) of 1000.
pub fn parse(text: &str) -> Result<Option<u64>, String> {
    let wrong = || format!("`{text}` is not a size: bytes, or a number with a unit such as 500M or 2GiB, or `none`");
    let text_lower = text.trim().to_ascii_lowercase();
    if text_lower == "none" {
        return Ok(None);
    }
    let digits = text_lower.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text_lower.len());
    let (number, unit) = text_lower.split_at(digits);
    let number: f64 = number.parse().map_err(|_| wrong())?;
    let unit = unit.trim();
    let power = |letter: &str| ["", "k", "m", "g", "t"].iter().position(|p| *p == letter);
    let (letter, base) = match (unit.strip_suffix("ib"), unit.strip_suffix('b')) {
        (Some(letter), _) => (letter, 1024f64),
        (_, Some(letter)) => (letter, 1000f64),
        _ => (unit, 1024f64),
    };
    let power = power(letter).ok_or_else(wrong)?;
    let bytes = number * base.powi(power as i32);
    if bytes >= 1.0 && bytes < u64::MAX as f64 { Ok(Some(bytes as u64)) } else { Err(wrong()) }
}

/// The memory limit of a run where none is given: 80 % of what the machine, or the container, has.
pub fn default_limit() -> Option<u64> {
    let machine = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| total_of_meminfo(&text));
    let container = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok().and_then(|text| text.trim().parse().ok());
    let least = [machine, container].into_iter().flatten().min()?;
    Some((least as f64 * DEFAULT_PART) as u64)
}

fn total_of_meminfo(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

/// Bytes in the unit that a person would use.
pub fn shown(bytes: u64) -> String {
    humansize::format_size(bytes, humansize::BINARY)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_with_and_without_units() {
        for (text, bytes) in [
            ("1", 1),
            ("500M", 500 << 20),
            ("2GiB", 2 << 30),
            ("2 gib", 2 << 30),
            ("1.5k", 1536),
            ("3MB", 3_000_000),
            ("10B", 10),
        ] {
            assert_eq!(parse(text), Ok(Some(bytes)), "{text}");
        }
        assert_eq!(parse("none"), Ok(None));
        for text in ["", "M", "-1", "1X", "0", "1e30T", "nan", "1.2.3"] {
            assert!(parse(text).is_err(), "{text}");
        }
    }

    #[test]
    fn memory_of_a_machine() {
        assert_eq!(total_of_meminfo("MemTotal:       16303404 kB\nMemFree: 1 kB\n"), Some(16303404 * 1024));
        assert_eq!(total_of_meminfo("MemFree: 1 kB\n"), None);
    }
}
