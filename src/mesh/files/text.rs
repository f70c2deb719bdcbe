//! Lines and numbers of the text formats (OBJ, OFF, STL).

use std::str::FromStr;

/// The lines of a file with their numbers from 1; the ends (`\n` or `\r\n`) are taken off.
pub(super) fn lines(data: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    data.split(|&b| b == b'\n').enumerate().map(|(i, line)| (i + 1, line.strip_suffix(b"\r").unwrap_or(line)))
}

/// The words of a line up to a `#`.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    let end = line.iter().position(|&b| b == b'#').unwrap_or(line.len());
    line[..end].split(u8::is_ascii_whitespace).filter(|word| !word.is_empty())
}

/// A number; Rust's own syntax covers `1`, `+1`, `2.`, `.5`, `1E2`, `2.e+1`, `inf` and `nan`.
pub(super) fn number<T: FromStr>(word: &[u8]) -> Result<T, String> {
    let parsed = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
    parsed.ok_or_else(|| format!("`{}` is not a number", show(word)))
}

/// A word of the file for a message: cut off where it is long, odd bytes replaced.
pub(super) fn show(word: &[u8]) -> String {
    const LONGEST: usize = 40;
    let mut shown: String =
        word.iter().take(LONGEST).map(|&b| if b.is_ascii_graphic() { b as char } else { '?' }).collect();
    if word.len() > LONGEST {
        shown.push('…');
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_the_spellings_of_exporters() {
        let spelled = ["1", "+1.", "1.0E0", "10.e-1", ".1e+1", "001"];
        assert!(spelled.iter().all(|s| number(s.as_bytes()) == Ok(1.0)));
        for bad in ["3.1+e2", "", "1,5", "0x1", "1\0", "--1"] {
            assert!(number::<f64>(bad.as_bytes()).is_err(), "{bad}");
        }
    }
}
