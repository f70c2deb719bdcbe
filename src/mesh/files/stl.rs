//! STL, binary and text.
//!
//! Read here and not through a crate: text files of several solids, binary files that begin with `solid` and counts that
//! do not fit the file need decisions that a crate does not leave to its user.
//!
//! The format repeats every vertex in every triangle: exactly equal ones become one. Normals and colours (there are two
//! rival ways to hide them in the attribute bytes) are read over; a triangle's side follows from its winding.
//! Source: 3D Systems, StereoLithography Interface Specification, 1988.

use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::build::MeshBuilder;
use super::text::{lines, number, show, words};
use super::unwritable;
use super::{ReadMesh, TriangleMesh};
use crate::Result;

/// Header and count of a binary file.
const HEADER: usize = 84;
/// Normal, three corners, two attribute bytes.
const FACET: usize = 50;

/// A builder that gives equal positions one index.
struct Welder<'a> {
    builder: MeshBuilder<'a>,
    known: FxHashMap<[u64; 3], u32>,
}

impl Welder<'_> {
    fn vertex(&mut self, position: DVec3, place: impl FnOnce() -> String) -> Result<u32> {
        // Adding zero turns −0 into 0, so that the two weld.
        let key = (position + DVec3::ZERO).to_array().map(f64::to_bits);
        if let Some(&known) = self.known.get(&key) {
            return Ok(known);
        }
        let index = self.builder.mesh.positions.len() as u32;
        self.builder.vertex(position, place)?;
        self.known.insert(key, index);
        Ok(index)
    }
}

pub(super) fn read(path: &Path, data: &[u8]) -> Result<ReadMesh> {
    let mut welder = Welder { builder: MeshBuilder::new(path), known: FxHashMap::default() };
    match claimed_facets(data) {
        // The size decides before the first word: binary files that begin with `solid` are common.
        Some(count) if HEADER as u64 + count * FACET as u64 == data.len() as u64 => read_binary(&mut welder, data)?,
        _ if is_text(data) => read_text(&mut welder, data)?,
        Some(_) => read_binary(&mut welder, data)?,
        None => {
            let problem =
                format!("neither text STL nor binary: {} bytes, a binary file has {HEADER} or more", data.len());
            return Err(welder.builder.refuse(problem));
        }
    }
    welder.builder.finish()
}

/// The number of triangles in a binary header.
fn claimed_facets(data: &[u8]) -> Option<u64> {
    let count = data.get(HEADER - 4..HEADER)?;
    Some(count.try_into().map(u32::from_le_bytes).ok()?.into())
}

/// Whether the file begins with `solid` and goes on as text.
fn is_text(data: &[u8]) -> bool {
    let start = &data[..data.len().min(1024)];
    let word = start.trim_ascii_start();
    word.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid")) && !start.contains(&0)
}

fn read_binary(welder: &mut Welder, data: &[u8]) -> Result<()> {
    let claimed = claimed_facets(data).unwrap_or(0);
    let body = data.get(HEADER..).unwrap_or_default();
    let whole = (body.len() / FACET) as u64;
    if claimed > whole {
        return Err(welder.builder.refuse(format!(
            "truncated: claims {claimed} triangles, which take {} bytes, but the file has {} ({whole} whole triangles)",
            HEADER as u64 + claimed * FACET as u64,
            data.len()
        )));
    }
    let used = claimed as usize * FACET;
    if used < body.len() {
        welder.builder.warn(format!("{} bytes behind the last triangle are ignored", body.len() - used));
    }
    let mut corners = Vec::with_capacity(3);
    for (t, facet) in body[..used].chunks_exact(FACET).enumerate() {
        let place = || format!("triangle {t} (byte {})", HEADER + t * FACET);
        let (numbers, _) = facet.as_chunks::<4>();
        let value = |i: usize| f64::from(f32::from_le_bytes(numbers[i]));
        corners.clear();
        for i in [3, 6, 9] {
            corners.push(welder.vertex(DVec3::new(value(i), value(i + 1), value(i + 2)), place)?);
        }
        welder.builder.polygon(&mut corners, place);
    }
    Ok(())
}

fn read_text(welder: &mut Welder, data: &[u8]) -> Result<()> {
    let mut solids = 0;
    let mut facet: Option<(usize, Vec<u32>)> = None;
    let mut open_solid = false;
    let mut last = 1;
    for (line, text) in lines(data) {
        let words: Vec<_> = words(text).collect();
        let Some(&keyword) = words.first() else { continue };
        last = line;
        let refuse = |welder: &Welder, problem: String| welder.builder.refuse(format!("line {line}: {problem}"));
        match (keyword.to_ascii_lowercase().as_slice(), &mut facet) {
            (b"solid", None) => {
                solids += 1;
                open_solid = true;
            }
            (b"endsolid", None) => open_solid = false,
            (b"facet", None) => facet = Some((line, Vec::with_capacity(3))),
            (b"outer" | b"endloop", Some(_)) => {}
            (b"vertex", Some((_, corners))) => {
                let values: Result<Vec<f64>, _> = words[1..].iter().map(|word| number(word)).collect();
                let values = values.map_err(|e| refuse(welder, e))?;
                let &[x, y, z] = values.as_slice() else {
                    return Err(refuse(welder, format!("a vertex needs 3 coordinates, it has {}", values.len())));
                };
                corners.push(welder.vertex(DVec3::new(x, y, z), || format!("line {line}"))?);
            }
            (b"endfacet", Some((first, corners))) => {
                if corners.len() < 3 {
                    let problem = format!("the facet of line {first} has {} vertices, not 3", corners.len());
                    return Err(refuse(welder, problem));
                }
                welder.builder.polygon(corners, || format!("line {first}"));
                facet = None;
            }
            _ => {
                let inside = if facet.is_some() { "inside a facet" } else { "outside of facets" };
                return Err(refuse(welder, format!("`{}` is not expected {inside}", show(keyword))));
            }
        }
    }
    if let Some((first, _)) = facet {
        let problem = format!("truncated: the file ends at line {last} inside the facet of line {first}");
        return Err(welder.builder.refuse(problem));
    }
    if open_solid {
        welder.builder.warn("the last solid has no `endsolid`; the file may be truncated");
    }
    if solids > 1 {
        welder.builder.warn(format!("{solids} solids merged into one mesh"));
    }
    Ok(())
}

pub(super) fn write(out: &mut dyn Write, mesh: &TriangleMesh) -> io::Result<()> {
    let count = u32::try_from(mesh.triangles.len())
        .map_err(|_| unwritable(format!("{} triangles; STL counts to {}", mesh.triangles.len(), u32::MAX)))?;
    let mut header = [b' '; HEADER - 4];
    let title = b"vdb-edit binary STL";
    header[..title.len()].copy_from_slice(title);
    out.write_all(&header)?;
    out.write_all(&count.to_le_bytes())?;
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = mesh.corners(t);
        let normal = (b - a).cross(c - a).normalize_or_zero();
        for value in [normal, a, b, c].map(|p| p.to_array()).concat() {
            let single = value as f32;
            if !single.is_finite() {
                let problem =
                    format!("triangle {t} ({triangle:?}): {value:e} is too large for STL; PLY or OBJ would work");
                return Err(unwritable(problem));
            }
            out.write_all(&single.to_le_bytes())?;
        }
        out.write_all(&[0, 0])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(data: &[u8]) -> Result<ReadMesh> {
        read(Path::new("a.stl"), data)
    }

    fn tetrahedron() -> TriangleMesh {
        TriangleMesh {
            positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z],
            triangles: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
            ..Default::default()
        }
    }

    fn binary() -> Vec<u8> {
        let mut data = Vec::new();
        write(&mut data, &tetrahedron()).unwrap();
        data
    }

    #[test]
    fn equal_vertices_are_welded_also_across_the_sign_of_zero() {
        let mut data = binary();
        data[96..100].copy_from_slice(&(-0.0f32).to_le_bytes());
        let mesh = parse(&data).unwrap().mesh;
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (4, 4));
    }

    #[test]
    fn a_binary_file_that_begins_with_solid_is_binary() {
        let mut data = binary();
        data[..6].copy_from_slice(b"solid ");
        assert_eq!(parse(&data).unwrap().mesh.triangles.len(), 4);
    }

    #[test]
    fn binary_counts_that_lie() {
        let mut data = binary();
        data.truncate(data.len() - 1);
        assert!(
            parse(&data)
                .unwrap_err()
                .to_string()
                .contains("claims 4 triangles, which take 284 bytes, but the file has 283 (3 whole")
        );
        let mut data = binary();
        data[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(parse(&data).unwrap_err().to_string().contains("truncated: claims 4294967295"));
        data[80..84].copy_from_slice(&3u32.to_le_bytes());
        assert_eq!(parse(&data).unwrap().warnings, ["50 bytes behind the last triangle are ignored"]);
        data[80..84].copy_from_slice(&0u32.to_le_bytes());
        assert!(parse(&data).unwrap_err().to_string().contains("no faces"));
        assert!(parse(b"short").unwrap_err().to_string().contains("neither text STL nor binary: 5 bytes"));
    }

    #[test]
    fn binary_nan_says_where() {
        let mut data = binary();
        data[170..174].copy_from_slice(&f32::NAN.to_le_bytes());
        let error = parse(&data).unwrap_err().to_string();
        assert!(error.contains("triangle 1 (byte 134): vertex 3 is not finite"), "{error}");
    }

    const FACET_TEXT: &str =
        "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n";

    #[test]
    fn text_with_several_solids_in_any_case() {
        let text = format!(" SOLID a\r\n{}endsolid a\nsolid\n{FACET_TEXT}endsolid\n", FACET_TEXT.to_uppercase());
        let read = parse(text.as_bytes()).unwrap();
        assert_eq!((read.mesh.positions.len(), read.mesh.triangles.len()), (3, 2));
        assert_eq!(read.warnings, ["2 solids merged into one mesh"]);
    }

    #[test]
    fn text_refusals_say_the_line() {
        for (text, part) in [
            (
                "solid\nfacet\nvertex 0 0 0\n".to_owned(),
                "truncated: the file ends at line 3 inside the facet of line 2",
            ),
            ("solid\nfacet\nvertex 0 0 0\nendfacet\n".to_owned(), "line 4: the facet of line 2 has 1 vertices"),
            ("solid\nfacet\nvertex 0 0\n".to_owned(), "line 3: a vertex needs 3 coordinates, it has 2"),
            ("solid\nfacet\nvertex 0 0 1,5\n".to_owned(), "line 3: `1,5` is not a number"),
            ("solid\nvertex 0 0 0\n".to_owned(), "line 2: `vertex` is not expected outside of facets"),
            ("solid\nendsolid\n".to_owned(), "no vertices and no faces"),
        ] {
            let error = parse(text.as_bytes()).unwrap_err().to_string();
            assert!(error.contains(part), "{part} in {error}");
        }
        let read = parse(format!("solid\n{FACET_TEXT}").as_bytes()).unwrap();
        assert!(read.warnings[0].contains("no `endsolid`"));
    }
}
