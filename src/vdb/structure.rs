//! What a file says of itself, before OpenVDB sees it: whether it is a VDB file at all, what it is if not, whether its format is newer
//! than the library; and whether its headers ask for more bytes than there are.
//!
//! A file begins with the 8-byte magic number `" BDV\0\0\0\0"` and a 32-bit format version, all numbers little-endian. Library version (two
//! numbers), a byte that tells whether grids have offsets, 36 letters of identity, metadata, the number of grids. Of each grid: name, type,
//! name of the grid whose tree it shares, three offsets; where it lies: compression, metadata, kind of transform.
//!
//! OpenVDB makes room for a text or an entry of metadata of any length that the file names, before it reads it: one wrong bit costs
//! gigabytes and the time to clear them.

use std::io::{Read, Seek};

const MAGIC: [u8; 8] = *b" BDV\0\0\0\0";

/// Bytes that [`check_start`] wants to see, or the whole file if it is shorter.
pub(super) const START_BYTES: usize = 512;

/// Refuses, with the reason, what cannot be read as a VDB file of format `newest` or older.
pub(super) fn check_start(start: &[u8], newest: u32) -> Result<(), String> {
    if start.is_empty() {
        return Err("the file is empty".into());
    }
    if let Some(rest) = start.strip_prefix(&MAGIC) {
        let Some(version) = rest.first_chunk::<4>() else {
            return Err("truncated: the file ends in the middle of the header".into());
        };
        let version = u32::from_le_bytes(*version);
        if version > newest {
            return Err(format!(
                "file format {version}, this OpenVDB reads up to {newest}: write the file again with an older version, or \
                 build with a newer OpenVDB"
            ));
        }
        return Ok(());
    }
    if MAGIC.starts_with(start) {
        return Err("truncated: the file ends in the middle of the header".into());
    }
    let text = std::str::from_utf8(start).ok().map(str::trim);
    Err(match text {
        Some(text) if text.starts_with("version https://git-lfs") => {
            "not a VDB file but a Git LFS pointer: fetch the file itself with `git lfs pull`".into()
        }
        Some(text) if is_link_target(text) => {
            format!(
                "not a VDB file but the text `{text}`: a symbolic link checked out as a file; use the file it names"
            )
        }
        _ => {
            let shown = &start[..start.len().min(8)];
            format!("not a VDB file: it begins with {shown:02x?}, not with {MAGIC:02x?}")
        }
    })
}

/// Since this format version grids name their compression, and headers are as described above.
const COMPRESSION_BY_GRID: u32 = 222;

/// Refuses a file of `size` bytes, with the reason, whose headers do not fit into it. Older formats than 222 are not looked at. Of a file
/// without offsets only the first grid can be found.
pub(super) fn check_headers(file: impl Read + Seek, size: u64) -> Result<(), String> {
    let mut walk = Walk { file, at: 0, size };
    let end = |what: &str| format!("truncated: the file ends in the middle of {what}");
    let head = "the header";
    walk.skip(MAGIC.len() as u64).ok_or_else(|| end(head))?;
    if walk.number().ok_or_else(|| end(head))? < COMPRESSION_BY_GRID {
        return Ok(());
    }
    walk.skip(8).ok_or_else(|| end(head))?;
    let [offsets] = walk.bytes().ok_or_else(|| end(head))?;
    walk.skip(36).ok_or_else(|| end(head))?;
    walk.metadata("the file's metadata")?;
    let what = "the number of grids";
    let grids = walk.number().ok_or_else(|| end(what))?;
    for grid in 1..=grids {
        let what = format!("the description of grid {grid} of {grids}");
        for _ in 0..3 {
            walk.text(&what)?;
        }
        walk.skip(16).ok_or_else(|| end(&what))?;
        let next = u64::from_le_bytes(walk.bytes().ok_or_else(|| end(&what))?);
        let what = format!("grid {grid} of {grids}");
        walk.skip(4).ok_or_else(|| end(&what))?;
        walk.metadata(&format!("the metadata of {what}"))?;
        walk.text(&format!("the transform of {what}"))?;
        if offsets == 0 {
            break;
        }
        if next < walk.at {
            return Err(format!("damaged at {what}: it ends before it begins"));
        }
        walk.skip(next - walk.at).ok_or_else(|| end(&what))?;
    }
    Ok(())
}

/// Goes through a file.
struct Walk<F> {
    file: F,
    at: u64,
    size: u64,
}

impl<F: Read + Seek> Walk<F> {
    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes).ok()?;
        self.at += N as u64;
        Some(bytes)
    }

    fn number(&mut self) -> Option<u32> {
        self.bytes().map(u32::from_le_bytes)
    }

    /// Past some bytes, if they are there.
    fn skip(&mut self, bytes: u64) -> Option<()> {
        if bytes > self.size.saturating_sub(self.at) {
            return None;
        }
        self.at += bytes;
        self.file.seek_relative(i64::try_from(bytes).ok()?).ok()
    }

    /// A text, or a value of metadata: its length, then its bytes.
    fn text(&mut self, what: &str) -> Result<(), String> {
        let end = || format!("truncated: the file ends in the middle of {what}");
        let length = self.number().ok_or_else(end)?;
        let left = self.size.saturating_sub(self.at);
        self.skip(length.into()).ok_or_else(|| {
            format!("truncated or damaged: {what} names a text or value of {length} bytes where {left} are left")
        })
    }

    fn metadata(&mut self, what: &str) -> Result<(), String> {
        let end = || format!("truncated: the file ends in the middle of {what}");
        for _ in 0..self.number().ok_or_else(end)? {
            // Name, type, value.
            for _ in 0..3 {
                self.text(what)?;
            }
        }
        Ok(())
    }
}

/// Whether the whole content is one line that reads like a path.
fn is_link_target(text: &str) -> bool {
    text.len() < START_BYTES / 2
        && !text.is_empty()
        && text.chars().all(|c| !c.is_control() && !c.is_whitespace())
        && (text.contains('/') || text.ends_with(".vdb"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(start: &[u8]) -> String {
        check_start(start, 224).unwrap_err()
    }

    #[test]
    fn says_what_a_file_is_that_is_no_vdb() {
        assert!(refusal(b"").contains("empty"));
        assert!(refusal(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n").contains("Git LFS"));
        assert!(refusal(b"../data/smoke.vdb").contains("symbolic link"));
        assert!(refusal(b"ply\nformat ascii 1.0\n").contains("not a VDB file"));
        assert!(refusal(b" BDV").contains("truncated"));
        assert!(refusal(b" BDV\0\0\0\0\xe0\0").contains("truncated"));
        assert!(refusal(&[0xff; 100]).contains("not a VDB file"));
    }

    #[test]
    fn lengths_beyond_the_file_are_refused() {
        // A header with one entry of metadata and one grid, as far as its transform.
        let text = |text: &str| [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
        let entry = [text("creator"), text("string"), text("nobody")].concat();
        let start =
            [&MAGIC[..], &224u32.to_le_bytes(), &[10, 0, 0, 0, 0, 0, 0, 0, 1], &[b'a'; 36], &[1, 0, 0, 0]].concat();
        let description = [text("surface"), text("Tree_float_5_4_3"), text("")].concat();
        let begin = (start.len() + entry.len() + 4 + description.len() + 24) as u64;
        let grid = [&[0; 4][..], &[1, 0, 0, 0], &entry, &text("UniformScaleMap")].concat();
        let end = begin + grid.len() as u64;
        let offsets = [begin, begin, end].map(u64::to_le_bytes).concat();
        let file = [&start, &entry, &[1, 0, 0, 0][..], &description, &offsets, &grid].concat();
        let check = |file: &[u8]| check_headers(std::io::Cursor::new(file), file.len() as u64);
        assert_eq!(check(&file), Ok(()));
        for length in 12..file.len() {
            assert!(check(&file[..length]).unwrap_err().starts_with("truncated"), "{length}");
        }
        // Each length in turn, of what lies before the tree.
        let lengths = file.windows(4).enumerate().filter(|(at, w)| {
            let value = u32::from_le_bytes([w[0], w[1], w[2], w[3]]);
            *at >= start.len() - 4 && (1..20).contains(&value) && (*at as u64 + 4) <= end
        });
        let mut refused = 0;
        for (at, _) in lengths {
            let mut damaged = file.clone();
            damaged[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
            refused += u32::from(check(&damaged).is_err());
        }
        assert!(refused >= 10, "{refused}");
    }

    #[test]
    fn names_a_newer_format() {
        let mut start = MAGIC.to_vec();
        start.extend(226u32.to_le_bytes());
        assert!(refusal(&start).contains("file format 226, this OpenVDB reads up to 224"));
        start[8] = 224;
        assert!(check_start(&start, 224).is_ok());
    }
}
