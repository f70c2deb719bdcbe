//! NRRD scans (<https://teem.sourceforge.net/nrrd/format.html>), attached and detached, raw, gzip and text. No crate that is kept up reads
//! them.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use glam::{DAffine3, DMat3, DVec3};

use super::Scan;
use super::samples::{Encoding, Kind, Samples};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

/// Longest header and most lines that are skipped, so that a file of another kind is not read to its end.
const LONGEST_HEADER: usize = 1 << 20;
const MOST_LINES: usize = 1 << 20;

/// Reads a `.nrrd`, or a `.nhdr` with its data file.
pub(super) fn read(path: &Path, run: &RunOptions) -> Result<Scan> {
    let refuse = |problem: String| EditError::input(path, problem);
    let open = |path: &Path| {
        let file = File::open(path).map_err(|e| EditError::input(path, format!("cannot be opened: {e}")))?;
        let bytes = file.metadata().map_err(|e| EditError::input(path, format!("cannot be read: {e}")))?.len();
        Ok::<_, EditError>((BufReader::new(file), bytes))
    };
    let (mut input, mut bytes) = open(path)?;
    let header = Header::read(&mut input).map_err(refuse)?;
    let samples = header.samples().map_err(refuse)?;
    let to_world = header.placement().map_err(refuse)?;
    if let Some(name) = header.get("data file").or(header.get("datafile")) {
        if name.starts_with("LIST") || name.contains('%') {
            return Err(refuse(format!("has its samples in several files (`{name}`); one is read")));
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        (input, bytes) = open(&folder.join(name))?;
    } else {
        let position = input.stream_position().map_err(|e| refuse(format!("cannot be read: {e}")))?;
        bytes = bytes.saturating_sub(position);
    }
    samples.reserve(bytes, run)?.map_err(refuse)?;
    for _ in 0..header.whole("line skip").map_err(refuse)?.unwrap_or(0).clamp(0, MOST_LINES as i64) {
        line(&mut input).map_err(refuse)?;
    }
    let mut skip = header.whole("byte skip").map_err(refuse)?.unwrap_or(0);
    if skip < 0 {
        // The samples end the file.
        let count = samples.count().map_err(refuse)? * samples.kind.bytes();
        let end = samples.encoding == Encoding::Raw && input.seek(SeekFrom::End(-(count as i64))).is_ok();
        if !end {
            return Err(refuse("is truncated, or compressed with a byte skip of -1".into()));
        }
        skip = 0;
    }
    let values = samples.read(input, skip as u64, run).map_err(refuse)?;
    run.check("reading a scan")?;
    Scan::new(samples.size, values, to_world).map_err(refuse)
}

/// The fields of a header.
struct Header(HashMap<String, String>);

/// A line without its end; an empty one at the end of the file.
fn line(input: &mut impl BufRead) -> Result<String, String> {
    let mut bytes = Vec::new();
    let got = input.take(LONGEST_HEADER as u64).read_until(b'\n', &mut bytes);
    got.map_err(|e| format!("cannot be read: {e}"))?;
    Ok(String::from_utf8_lossy(&bytes).trim_end_matches(['\n', '\r']).to_owned())
}

impl Header {
    fn read(input: &mut impl BufRead) -> Result<Self, String> {
        let magic = line(input)?;
        if !magic.starts_with("NRRD000") {
            return Err("is no NRRD file: it does not begin with `NRRD000`".into());
        }
        let mut fields = HashMap::new();
        let mut length = 0;
        loop {
            let text = line(input)?;
            length += text.len() + 1;
            if text.is_empty() {
                return Ok(Self(fields));
            }
            if length > LONGEST_HEADER {
                return Err("its header does not end".into());
            }
            if text.starts_with('#') || text.contains(":=") {
                continue;
            }
            let (key, value) = text.split_once(':').ok_or_else(|| format!("its header has the line `{text}`"))?;
            fields.insert(key.trim().to_lowercase(), value.trim().to_owned());
        }
    }

    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    fn required(&self, key: &str) -> Result<&str, String> {
        self.get(key).ok_or_else(|| format!("its header has no `{key}`"))
    }

    fn whole(&self, key: &str) -> Result<Option<i64>, String> {
        let spaced = self.get(key).or(self.get(&key.replace(' ', "")));
        spaced.map(|text| text.parse().map_err(|_| format!("its `{key}` is `{text}`, no whole number"))).transpose()
    }

    /// Samples along each axis of the file.
    fn sizes(&self) -> Result<Vec<usize>, String> {
        let dimension: usize = self
            .required("dimension")?
            .parse()
            .ok()
            .filter(|d| (1..=16).contains(d))
            .ok_or("its `dimension` is none")?;
        let text = self.required("sizes")?;
        let sizes: Option<Vec<usize>> =
            text.split_whitespace().map(|n| n.parse().ok().filter(|n: &usize| *n > 0)).collect();
        sizes
            .filter(|s| s.len() == dimension)
            .ok_or_else(|| format!("its `sizes` are `{text}`, not {dimension} numbers"))
    }

    /// The axes of space: all but those of one sample, where there are more than three.
    fn axes(&self) -> Result<[usize; 3], String> {
        let sizes = self.sizes()?;
        let mut axes: Vec<usize> = (0..sizes.len()).collect();
        if let Some(directions) = self.directions()? {
            axes.retain(|axis| directions.get(*axis).is_some_and(Option::is_some) || sizes[*axis] > 1);
        }
        while axes.len() > 3 {
            let flat = axes.iter().position(|axis| sizes[*axis] == 1);
            axes.remove(
                flat.ok_or_else(|| format!("has {sizes:?} samples; one number a voxel on three axes is read"))?,
            );
        }
        axes.try_into().map_err(|_| format!("has {sizes:?} samples; three axes are wanted"))
    }

    fn samples(&self) -> Result<Samples, String> {
        let sizes = self.sizes()?;
        let name = self.required("type")?;
        let kind = match name.to_lowercase().as_str() {
            "signed char" | "int8" | "int8_t" => Kind::I8,
            "uchar" | "unsigned char" | "uint8" | "uint8_t" => Kind::U8,
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => Kind::I16,
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Kind::U16,
            "int" | "signed int" | "int32" | "int32_t" => Kind::I32,
            "uint" | "unsigned int" | "uint32" | "uint32_t" => Kind::U32,
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "int64_t" => Kind::I64,
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => Kind::U64,
            "float" => Kind::F32,
            "double" => Kind::F64,
            _ => return Err(format!("holds values of type `{name}`; whole numbers and floats up to 64 bits are read")),
        };
        let encoding = match self.required("encoding")?.to_lowercase().as_str() {
            "raw" => Encoding::Raw,
            "gzip" | "gz" => Encoding::Gzip,
            "txt" | "text" | "ascii" => Encoding::Text,
            other => return Err(format!("is encoded as `{other}`; raw, gzip and text are read")),
        };
        let big_endian = match self.get("endian") {
            Some("big") => true,
            Some("little") => false,
            None if kind.bytes() == 1 || encoding == Encoding::Text => false,
            other => return Err(format!("its `endian` is `{}`, not little or big", other.unwrap_or("missing"))),
        };
        Ok(Samples { size: self.axes()?.map(|axis| sizes[axis]), kind, big_endian, encoding })
    }

    /// `space directions`: a vector an axis, or none.
    fn directions(&self) -> Result<Option<Vec<Option<DVec3>>>, String> {
        let Some(text) = self.get("space directions") else { return Ok(None) };
        let failed = || format!("its `space directions` are `{text}`");
        let mut found = Vec::new();
        let mut rest = text.trim();
        while !rest.is_empty() {
            if let Some(after) = rest.strip_prefix("none") {
                found.push(None);
                rest = after.trim_start();
            } else {
                let (vector, after) = rest.split_once(')').ok_or_else(failed)?;
                found.push(Some(vector_of(vector).ok_or_else(failed)?));
                rest = after.trim_start();
            }
        }
        Ok(Some(found))
    }

    fn placement(&self) -> Result<DAffine3, String> {
        let axes = self.axes()?;
        let origin = match self.get("space origin") {
            None => DVec3::ZERO,
            Some(text) => {
                vector_of(text.trim_end_matches(')')).ok_or_else(|| format!("its `space origin` is `{text}`"))?
            }
        };
        if let Some(directions) = self.directions()? {
            let of = |axis: usize| {
                directions.get(axis).copied().flatten().ok_or_else(|| "has an axis without a direction".to_owned())
            };
            let matrix = DMat3::from_cols(of(axes[0])?, of(axes[1])?, of(axes[2])?);
            return Ok(DAffine3::from_mat3_translation(matrix, origin));
        }
        let spacing = match self.get("spacings") {
            None => DVec3::ONE,
            Some(text) => {
                let words: Vec<&str> = text.split_whitespace().collect();
                // Not known is written as NaN: then it is 1, as without the field.
                let of = |axis: usize| match words.get(axis).and_then(|w| w.parse::<f64>().ok()) {
                    Some(v) if v.is_nan() => Some(1.0),
                    Some(v) if v != 0.0 && v.is_finite() => Some(v.abs()),
                    _ => None,
                };
                let all = axes.map(of);
                let [Some(x), Some(y), Some(z)] = all else { return Err(format!("its `spacings` are `{text}`")) };
                DVec3::new(x, y, z)
            }
        };
        Ok(DAffine3::from_mat3_translation(DMat3::from_diagonal(spacing), origin))
    }
}

/// `(a,b,c` as a vector.
fn vector_of(text: &str) -> Option<DVec3> {
    let numbers: Option<Vec<f64>> = text
        .trim()
        .strip_prefix('(')?
        .split(',')
        .map(|part| part.trim().parse().ok().filter(|v: &f64| v.is_finite()))
        .collect();
    numbers.and_then(|n| <[f64; 3]>::try_from(n).ok()).map(DVec3::from)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use glam::IVec3;

    use super::*;

    const HEAD: &str = "NRRD0004\n# made by hand\ntype: short\ndimension: 3\nsizes: 2 3 4\nkey:=value\n";

    fn read_bytes(bytes: &[u8]) -> Result<Scan> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.nrrd");
        std::fs::write(&path, bytes).unwrap();
        Scan::read(&path, &RunOptions::default())
    }

    fn file(fields: &str, data: &[u8]) -> Vec<u8> {
        [HEAD.as_bytes(), fields.as_bytes(), b"\n", data].concat()
    }

    fn numbers(big_endian: bool) -> Vec<u8> {
        (0..24i16).flat_map(|k| if big_endian { (10 * k).to_be_bytes() } else { (10 * k).to_le_bytes() }).collect()
    }

    #[test]
    fn encodings_and_byte_orders() {
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        gzip.write_all(&numbers(true)).unwrap();
        let text: String = (0..24).map(|k| format!("{}\n", 10 * k)).collect();
        let raw = read_bytes(&file("encoding: raw\nendian: little\n", &numbers(false))).unwrap();
        assert_eq!((raw.size(), raw.range()), ([2, 3, 4], Some((0.0, 230.0))));
        assert_eq!((raw.value(IVec3::new(0, 1, 0)), raw.value(IVec3::new(1, 0, 2))), (20.0, 130.0));
        assert!(raw.value(IVec3::new(2, 0, 0)).is_nan());
        for bytes in [
            file("encoding: gzip\nendian: big\n", &gzip.finish().unwrap()),
            file("encoding: ascii\n", text.as_bytes()),
            file(
                "encoding: raw\nendian: little\nline skip: 1\nbyte skip: 3\n",
                &[b"one\nabc", &numbers(false)[..]].concat(),
            ),
            file("encoding: raw\nendian: big\nbyte skip: -1\n", &[b"anything", &numbers(true)[..]].concat()),
        ] {
            assert_eq!(read_bytes(&bytes).unwrap(), raw);
        }
    }

    #[test]
    fn a_detached_header_finds_its_samples() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("b.raw"), numbers(false)).unwrap();
        let path = folder.path().join("b.nhdr");
        std::fs::write(&path, format!("{HEAD}encoding: raw\nendian: little\ndata file: b.raw\n")).unwrap();
        assert_eq!(Scan::read(&path, &RunOptions::default()).unwrap().value(IVec3::new(1, 2, 3)), 230.0);
        std::fs::remove_file(folder.path().join("b.raw")).unwrap();
        let error = Scan::read(&path, &RunOptions::default()).unwrap_err();
        assert!(error.to_string().contains("b.raw") && error.exit_code() == 3);
    }

    #[test]
    fn placements_and_axes_of_one_sample() {
        let raw = "encoding: raw\nendian: little\n";
        let at = |fields: &str| read_bytes(&file(&format!("{raw}{fields}"), &numbers(false))).unwrap();
        let p = DVec3::new(1.0, 2.0, 3.0);
        assert_eq!(at("").to_world().transform_point3(p), p);
        assert_eq!(at("spacings: 2 -3 NaN\n").to_world().transform_point3(p), DVec3::new(2.0, 6.0, 3.0));
        let placed =
            at("space: left-posterior-superior\nspace directions: (0,2,0) (-2,0,0) (0, 0, 2)\nspace origin: (1,1,5)\n");
        assert_eq!(placed.to_world().transform_point3(p), DVec3::new(-3.0, 3.0, 11.0));
        assert_eq!(placed.transform().unwrap().voxel_size(), 2.0);
        let four = String::from_utf8(file("", b"")).unwrap();
        let four = four.replace("dimension: 3\nsizes: 2 3 4", "dimension: 4\nsizes: 1 2 3 4").trim_end().to_owned();
        let four = format!("{four}\n{raw}space directions: none (1,0,0) (0,1,0) (0,0,4)\n\n");
        let scan = read_bytes(&[four.as_bytes(), &numbers(false)].concat()).unwrap();
        assert_eq!((scan.size(), scan.to_world().transform_point3(p)), ([2, 3, 4], DVec3::new(1.0, 2.0, 12.0)));
    }

    #[test]
    fn damaged_files_are_refused() {
        let raw = "encoding: raw\nendian: little\n";
        let with = |from: &str, to: &str| {
            let text = String::from_utf8(file(raw, b"")).unwrap().replace(from, to);
            [text.as_bytes(), &numbers(false)].concat()
        };
        for (bytes, part) in [
            (b"PLY".to_vec(), "does not begin with"),
            (file(raw, &numbers(false)[..40]), "truncated"),
            (with("type: short", "type: block"), "`block`"),
            (with("sizes: 2 3 4", "sizes: 2 3"), "`sizes`"),
            (with("sizes: 2 3 4", "sizes: 0 3 4"), "`sizes`"),
            (with("sizes: 2 3 4", "sizes: 99999999 99999999 99999999"), "impossible"),
            (with("sizes: 2 3 4", "sizes: 99999 9999 99"), "truncated"),
            (with("dimension: 3\nsizes: 2 3 4", "dimension: 4\nsizes: 2 3 2 2"), "one number a voxel"),
            (with("endian: little", "endian: middle"), "`middle`"),
            (with("encoding: raw", "encoding: bzip2"), "`bzip2`"),
            (with("key:=value", "no field"), "the line"),
            (with("key:=value", "space directions: (1,0,0) (0,1,0) (0,0"), "space directions"),
            (with("key:=value", "space directions: (1,0,0) (2,0,0) (0,0,1)"), "do not span"),
            (with("key:=value", "data file: a%03d.raw 1 9 1"), "several files"),
        ] {
            let error = read_bytes(&bytes).unwrap_err();
            assert!(error.to_string().contains(part) && error.exit_code() == 3, "{part}: {error}");
        }
    }
}
