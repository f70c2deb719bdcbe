//! What the first bytes of a file say, before OpenVDB sees it: whether it is a VDB file at all, what it is if not, and
//! whether its format is newer than the library.
//!
//! A file begins with the 8-byte magic number `" BDV\0\0\0\0"` and a 32-bit format version, both little-endian.

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
    fn names_a_newer_format() {
        let mut start = MAGIC.to_vec();
        start.extend(226u32.to_le_bytes());
        assert!(refusal(&start).contains("file format 226, this OpenVDB reads up to 224"));
        start[8] = 224;
        assert!(check_start(&start, 224).is_ok());
    }
}
