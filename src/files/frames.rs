//! Frame numbers: lists of them, and their place in the names of files.

use std::path::{Path, PathBuf};

/// More frames than any sequence has; a list that is longer is a slip.
const MOST_FRAMES: usize = 1_000_000;

/// The frames of `1-100`, `1-100x5` or `1,3,7-9`, in the order written, each once; otherwise what would be accepted.
pub fn parse_frames(text: &str) -> Result<Vec<i64>, String> {
    let accepted = || format!("frames such as `1-100`, `1-100x5` or `1,3,7-9` are wanted, not `{text}`");
    let number = |t: &str| t.trim().parse::<u32>().map(i64::from).map_err(|_| accepted());
    let mut frames = Vec::new();
    for part in text.split(',') {
        let (range, step) = match part.split_once('x') {
            Some((range, step)) => (range, number(step)?),
            None => (part, 1),
        };
        let (first, last) = match range.split_once('-') {
            Some((first, last)) => (number(first)?, number(last)?),
            None if part.contains('x') => return Err(accepted()),
            None => (number(range)?, number(range)?),
        };
        if step < 1 || last < first {
            return Err(accepted());
        }
        let count = usize::try_from((last - first) / step).unwrap_or(usize::MAX);
        if count.saturating_add(frames.len()) >= MOST_FRAMES {
            return Err(format!("at most {MOST_FRAMES} frames"));
        }
        frames.extend((0..=count as i64).map(|n| first + n * step));
    }
    let mut seen = std::collections::HashSet::new();
    frames.retain(|frame| seen.insert(*frame));
    Ok(frames)
}

/// The path of a frame: its number in the place of `####` or `%04d` in the file's name; `None` where there is neither.
pub fn numbered(path: &Path, frame: i64) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let name = match (name.find('#'), printf(name)) {
        (Some(start), _) => {
            let width = name[start..].chars().take_while(|c| *c == '#').count();
            format!("{}{frame:0width$}{}", &name[..start], &name[start + width..])
        }
        (None, Some((start, end, width))) => format!("{}{frame:0width$}{}", &name[..start], &name[end..]),
        (None, None) => return None,
    };
    Some(path.with_file_name(name))
}

/// Where `%d` or `%04d` is in a name, and its width.
fn printf(name: &str) -> Option<(usize, usize, usize)> {
    let start = name.find('%')?;
    let rest = &name[start + 1..];
    let digits = rest.find(|c: char| !c.is_ascii_digit())?;
    let width = if digits == 0 { 0 } else { rest[..digits].parse().ok().filter(|width| *width <= 20)? };
    (rest[digits..].starts_with('d')).then_some((start, start + digits + 2, width))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_of_frames() {
        for (text, frames) in [
            ("5", vec![5]),
            ("1-4", vec![1, 2, 3, 4]),
            ("1-10x3", vec![1, 4, 7, 10]),
            ("1,3,7-9", vec![1, 3, 7, 8, 9]),
            ("3, 1-3", vec![3, 1, 2]),
        ] {
            assert_eq!(parse_frames(text), Ok(frames), "{text}");
        }
        for text in ["", "a", "1-", "-1", "5-1", "1-9x0", "1x2", "1,,2", "1-4000000000"] {
            assert!(parse_frames(text).is_err(), "{text}");
        }
    }

    #[test]
    fn numbers_take_their_place_in_names() {
        for (path, there) in [
            ("out/a.####.vdb", Some("out/a.0012.vdb")),
            ("a#.vdb", Some("a12.vdb")),
            ("a.%04d.png", Some("a.0012.png")),
            ("a%d.png", Some("a12.png")),
            ("shot#1/a.vdb", None),
            ("100%.vdb", None),
            ("a%99999999999999999999d.vdb", None),
        ] {
            assert_eq!(numbered(Path::new(path), 12), there.map(PathBuf::from), "{path}");
        }
    }
}
