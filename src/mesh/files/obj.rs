//! Wavefront OBJ.
//!
//! Read here and not through a crate: those at hand cut the mesh at every group, which tears neighbouring faces apart,
//! drop the line numbers, and give up at the first odd face.
//!
//! Faces index positions from 1, or back from the latest one by negative numbers; polygons may have any number of corners.
//! A vertex whose faces give it several texture coordinates (on a seam) is split: the first keeps its number, the others
//! follow behind all vertices of the file. Colours are the common extension `v x y z r g b`. A vertex has the mean of the
//! normals of its corners, if all have some. Groups, materials, lines and free-form statements are read over.
//! Source: Appendix B1 of the manual of Wavefront's Advanced Visualizer.

use std::borrow::Cow;
use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::build::MeshBuilder;
use super::read_beside;
use super::text::{lines, number, show, words};
use super::{Polygons, ReadMesh, color};
use crate::Result;

/// In place of an index that a corner does not give.
const NONE: u32 = u32::MAX;

/// What the statements of the file add up to, before indices are checked: faces may come before their vertices.
#[derive(Default)]
struct Statements {
    colors: Vec<Option<[f32; 3]>>,
    uvs: Vec<[f32; 2]>,
    normals: Vec<DVec3>,
    /// Position, texture coordinate and normal (or [`NONE`]) of all corners, from 0.
    corners: Vec<(u32, u32, u32)>,
    /// The end of each face in `corners`, and its line.
    faces: Vec<(usize, usize)>,
    materials: FxHashSet<Vec<u8>>,
}

pub(super) fn read(path: &Path, data: &[u8]) -> Result<ReadMesh> {
    let mut builder = MeshBuilder::new(path);
    let mut read = Statements::default();
    for (line, statement) in statements(data) {
        read.statement(&mut builder, &statement, line, path)?;
    }
    read.finish(builder)
}

/// Lines with their numbers; a backslash at the end joins the next line.
fn statements(data: &[u8]) -> impl Iterator<Item = (usize, Cow<'_, [u8]>)> {
    let mut lines = lines(data);
    std::iter::from_fn(move || {
        let (number, line) = lines.next()?;
        let mut whole = Cow::Borrowed(line);
        while whole.last() == Some(&b'\\') {
            let text = whole.to_mut();
            text.pop();
            text.push(b' ');
            match lines.next() {
                Some((_, more)) => text.extend_from_slice(more),
                None => break,
            }
        }
        Some((number, whole))
    })
}

impl Statements {
    fn statement(&mut self, builder: &mut MeshBuilder, text: &[u8], line: usize, path: &Path) -> Result<()> {
        let place = || format!("line {line}");
        let mut words = words(text);
        let Some(keyword) = words.next() else { return Ok(()) };
        match keyword {
            b"v" => self.position(builder, words, line)?,
            b"vt" => {
                let uv = numbers(words.take(2)).map_err(|e| builder.refuse(format!("line {line}: {e}")))?;
                let [u, v] = [0, 1].map(|i| uv.get(i).map_or(0.0, |&x| x as f32));
                self.uvs.push([u, v]);
            }
            b"f" | b"fo" => self.face(builder, words, line)?,
            b"mtllib" => {
                let name = String::from_utf8_lossy(rest(text, keyword)).into_owned();
                match read_beside(path, &name) {
                    Ok(library) => self.materials.extend(material_names(&library)),
                    Err(_) => builder.warn(format!("line {line}: material library `{name}` is missing; not needed")),
                }
            }
            b"usemtl" if !self.materials.contains(rest(text, keyword)) => {
                builder.note("use(s) of an unknown material, ignored", || {
                    format!("`{}`, line {line}", String::from_utf8_lossy(rest(text, keyword)))
                });
            }
            b"vn" => {
                let normal = numbers(words.take(3)).unwrap_or_default();
                self.normals.push(<[f64; 3]>::try_from(normal).map_or(DVec3::ZERO, DVec3::from_array));
            }
            b"l" | b"p" => builder.note("line(s) and point(s) skipped", place),
            b"vp" | b"usemtl" | b"o" | b"g" | b"s" | b"mg" => {}
            b"cstype" | b"deg" | b"bmat" | b"step" | b"curv" | b"curv2" | b"surf" | b"parm" | b"trim" | b"hole"
            | b"scrv" | b"sp" | b"end" | b"con" | b"call" => {
                builder.note("free-form statement(s) skipped", || format!("`{}`, line {line}", show(keyword)));
            }
            _ => builder.note("unknown statement(s) skipped", || format!("`{}`, line {line}", show(keyword))),
        }
        Ok(())
    }

    /// `v x y z [w]` or `v x y z r g b [a]`; the weight of rational curves means nothing to faces.
    fn position<'a>(
        &mut self,
        builder: &mut MeshBuilder,
        words: impl Iterator<Item = &'a [u8]>,
        line: usize,
    ) -> Result<()> {
        let values = numbers(words.take(7)).map_err(|e| builder.refuse(format!("line {line}: {e}")))?;
        let &[x, y, z, ref more @ ..] = values.as_slice() else {
            return Err(builder.refuse(format!("line {line}: a vertex needs 3 coordinates, it has {}", values.len())));
        };
        self.colors.push(match *more {
            [r, g, b, ..] => Some([r, g, b].map(|c| c as f32)),
            _ => None,
        });
        builder.vertex(DVec3::new(x, y, z), || format!("line {line}"))
    }

    fn face<'a>(
        &mut self,
        builder: &mut MeshBuilder,
        words: impl Iterator<Item = &'a [u8]>,
        line: usize,
    ) -> Result<()> {
        let first = self.corners.len();
        for word in words {
            let mut parts = word.split(|&b| b == b'/');
            let mut next = |count| parts.next().map_or(Ok(NONE), |part| from_zero(part, count));
            let corner = next(builder.mesh.positions.len()).and_then(|v| match v {
                NONE => Err("no vertex".into()),
                // Faces were never refused for the sake of normals.
                v => Ok((v, next(self.uvs.len())?, next(self.normals.len()).unwrap_or(NONE))),
            });
            let bad = |e| builder.refuse(format!("line {line}: face corner `{}`: {e}", show(word)));
            self.corners.push(corner.map_err(bad)?);
        }
        if self.corners.len() - first < 3 {
            self.corners.truncate(first);
            builder.note("face(s) with fewer than three corners skipped", || format!("line {line}"));
        } else {
            self.faces.push((self.corners.len(), line));
        }
        Ok(())
    }

    /// Checks the indices, splits vertices at seams and makes triangles.
    fn finish(self, mut builder: MeshBuilder) -> Result<ReadMesh> {
        let in_file = builder.mesh.positions.len();
        // Texture coordinate of each vertex so far, and the copies of vertices on seams.
        let mut uv_of = vec![NONE; in_file];
        let mut copies: FxHashMap<(u32, u32), u32> = FxHashMap::default();
        let mut origin: Vec<u32> = Vec::new();
        let mut normals = vec![DVec3::ZERO; in_file];
        let mut has_normals = !self.normals.is_empty();
        let mut polygon = Vec::new();
        let mut start = 0;
        for &(end, line) in &self.faces {
            polygon.clear();
            for &(v, vt, vn) in &self.corners[start..end] {
                // Said in the file's own counting, from 1.
                let bad = |what: &str, index: u32, count: usize| {
                    let index = u64::from(index) + 1;
                    let problem = format!("{what} index {index} is out of range: there are {count} (1..={count})");
                    builder.refuse(format!("line {line}: {problem}"))
                };
                if v as usize >= in_file {
                    return Err(bad("vertex", v, in_file));
                }
                if vt != NONE && vt as usize >= self.uvs.len() {
                    return Err(bad("texture coordinate", vt, self.uvs.len()));
                }
                let known = &mut uv_of[v as usize];
                if *known == NONE {
                    *known = vt;
                }
                let same = vt == NONE || *known == vt || self.uvs[*known as usize] == self.uvs[vt as usize];
                let own = match same {
                    true => v,
                    false => *copies.entry((v, vt)).or_insert_with(|| {
                        builder.mesh.positions.push(builder.mesh.positions[v as usize]);
                        origin.push(v);
                        uv_of.push(vt);
                        normals.push(DVec3::ZERO);
                        (builder.mesh.positions.len() - 1) as u32
                    }),
                };
                match self.normals.get(vn as usize) {
                    Some(normal) => normals[own as usize] += *normal,
                    None => has_normals = false,
                }
                polygon.push(own);
            }
            start = end;
            builder.polygon(&mut polygon, || format!("line {line}"));
        }
        if u32::try_from(builder.mesh.positions.len()).is_err() {
            return Err(builder.refuse("more than 4,294,967,295 vertices once split at texture seams"));
        }
        if uv_of.iter().any(|&vt| vt != NONE) {
            builder.mesh.uvs =
                Some(uv_of.iter().map(|&vt| self.uvs.get(vt as usize).copied().unwrap_or_default()).collect());
        }
        if has_normals {
            builder.mesh.normals = Some(normals.iter().map(|n| n.normalize_or_zero().as_vec3().to_array()).collect());
        }
        if !origin.is_empty() {
            builder.warn(format!("{} vertices added where texture coordinates have seams", origin.len()));
        }
        if self.colors.iter().any(Option::is_some) {
            // 0..1 by convention; some exporters write 0..255.
            let largest = self.colors.iter().flatten().flatten().fold(0.0, |a: f32, &b| a.max(b));
            let full = if largest > 1.0 { 255.0 } else { 1.0 };
            let decode = |c: &Option<[f32; 3]>| {
                c.map_or([1.0; 4], |[r, g, b]| color::decode([r / full, g / full, b / full, 1.0]))
            };
            let mut colors: Vec<_> = self.colors.iter().map(decode).collect();
            colors.extend(origin.iter().map(|&v| decode(&self.colors[v as usize])));
            builder.mesh.colors = Some(colors);
        }
        builder.finish()
    }
}

/// An index of the file, from 1 or backwards from −1, as one from 0; [`NONE`] where nothing stands.
fn from_zero(part: &[u8], count: usize) -> Result<u32, String> {
    if part.is_empty() {
        return Ok(NONE);
    }
    let index: i64 = number(part)?;
    let from_zero = match index {
        0 => return Err("indices begin at 1, or at -1 for the latest".into()),
        1.. => Some(index as u64 - 1),
        ..0 => (count as u64).checked_sub(index.unsigned_abs()),
    };
    let valid = from_zero.and_then(|index| u32::try_from(index).ok()).filter(|&index| index != NONE);
    valid.ok_or_else(|| format!("{index} is out of range: there are {count} so far"))
}

fn numbers<'a>(words: impl Iterator<Item = &'a [u8]>) -> Result<Vec<f64>, String> {
    words.map(number).collect()
}

/// What follows the keyword, spaces inside kept: names may have them.
fn rest<'a>(text: &'a [u8], keyword: &[u8]) -> &'a [u8] {
    let text = text.trim_ascii();
    text.get(keyword.len()..).unwrap_or_default().trim_ascii()
}

fn material_names(library: &[u8]) -> impl Iterator<Item = Vec<u8>> {
    lines(library).filter_map(|(_, line)| {
        let line = line.trim_ascii();
        line.starts_with(b"newmtl").then(|| rest(line, b"newmtl").to_vec())
    })
}

pub(super) fn write<const N: usize>(out: &mut dyn Write, mesh: &Polygons<N>) -> io::Result<()> {
    writeln!(out, "# vdb-edit: {} vertices, {} faces", mesh.positions.len(), mesh.faces.len())?;
    for (v, p) in mesh.positions.iter().enumerate() {
        // Debug prints the shortest number that reads back the same, with an exponent where zeros would fill the line.
        write!(out, "v {:?} {:?} {:?}", p.x, p.y, p.z)?;
        if let Some(colors) = mesh.colors {
            let [r, g, b, _] = colors[v];
            let [r, g, b] = [r, g, b].map(color::to_srgb);
            write!(out, " {r:?} {g:?} {b:?}")?;
        }
        writeln!(out)?;
    }
    for [u, v] in mesh.uvs.iter().copied().flatten() {
        writeln!(out, "vt {u:?} {v:?}")?;
    }
    for [x, y, z] in mesh.normals.iter().copied().flatten() {
        writeln!(out, "vn {x:?} {y:?} {z:?}")?;
    }
    for face in mesh.faces {
        out.write_all(b"f")?;
        for v in face.map(|v| u64::from(v) + 1) {
            match (mesh.uvs, mesh.normals) {
                (Some(_), Some(_)) => write!(out, " {v}/{v}/{v}")?,
                (None, Some(_)) => write!(out, " {v}//{v}")?,
                (Some(_), None) => write!(out, " {v}/{v}")?,
                (None, None) => write!(out, " {v}")?,
            }
        }
        writeln!(out)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<ReadMesh> {
        read(Path::new("folder/a.obj"), text.as_bytes())
    }

    fn problem(text: &str) -> String {
        parse(text).unwrap_err().to_string()
    }

    const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

    #[test]
    fn negative_and_later_indices_comments_and_joined_lines() {
        let read =
            parse("f 1 2 3 # ahead\r\nv 0 0 0\r\nv +1. 0 0\r\nv 1E0 1.e+0 0\r\n\r\nv 0 1 \\\r\n0\r\nf -4 -2\\\n -1\n");
        let read = read.unwrap();
        assert_eq!(read.mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(read.mesh.positions[3], DVec3::Y);
        assert_eq!(read.warnings, Vec::<String>::new());
    }

    #[test]
    fn groups_do_not_cut_the_mesh() {
        let read = parse(&format!("{SQUARE}g one\nf 1 2 3\no two\nf 1 3 4\n")).unwrap();
        assert_eq!((read.mesh.positions.len(), read.mesh.triangles.len()), (4, 2));
    }

    #[test]
    fn seams_split_vertices_and_keep_their_colours() {
        let text = "v 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0 0 1 0\nv 0 1 0\nvt 0 0\nvt .5 0\nvt 1\nvt 0 0\n\
                    f 1/1 2/2 3/3\nf 1/4/9 3/2 4/1\n";
        let ReadMesh { mesh, warnings } = parse(text).unwrap();
        // Corner 1/4 has the same coordinates as 1/1; 3/2 differs from 3/3.
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 4, 3]]);
        assert_eq!(mesh.uvs.unwrap(), [[0., 0.], [0.5, 0.], [1., 0.], [0., 0.], [0.5, 0.]]);
        assert_eq!(mesh.positions[4], mesh.positions[2]);
        let colors = mesh.colors.unwrap();
        assert_eq!([colors[0], colors[1], colors[4]], [[1., 0., 0., 1.], [1.; 4], [0., 1., 0., 1.]]);
        assert_eq!(warnings, ["1 vertices added where texture coordinates have seams"]);
    }

    #[test]
    fn odd_faces_and_materials_are_said() {
        let read =
            parse(&format!("{SQUARE}mtllib none.mtl\nusemtl A b\nf\nf 1 2\nf 1 1 2\nl 1 2\nxyz\nf 1 2 3\n")).unwrap();
        assert_eq!(read.mesh.triangles.len(), 1);
        let all = read.warnings.join("\n");
        for part in [
            "`none.mtl` is missing",
            "`A b`, line 6",
            "2 face(s) with fewer than three corners skipped (first: line 7)",
            "three different corners skipped (first: line 9)",
            "`xyz`, line 11",
            "1 of 4 vertices are in no face",
        ] {
            assert!(all.contains(part), "{part} in {all}");
        }
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_its_line() {
        for (face, part) in [
            ("f 1 2 5", "line 5: vertex index 5 is out of range: there are 4 (1..=4)"),
            ("f 0 1 2", "line 5: face corner `0`: indices begin at 1"),
            ("f -5 1 2", "line 5: face corner `-5`: -5 is out of range: there are 4 so far"),
            ("f 1 2 99999999999999999999", "line 5: face corner"),
            ("f 1 2 4294967296", "4294967296 is out of range"),
            ("f 1/1 2/1 3/1", "texture coordinate index 1 is out of range: there are 0"),
            ("f /1 2 3", "face corner `/1`: no vertex"),
            ("f 1 b 3", "`b` is not a number"),
            ("v 1 2", "line 5: a vertex needs 3 coordinates, it has 2"),
            ("v 1 3.1+e2 0", "line 5: `3.1+e2` is not a number"),
            ("v 0 inf 0", "line 5: vertex 4 is not finite"),
            ("", "no faces, 4 points only"),
        ] {
            let error = problem(&format!("{SQUARE}{face}\n"));
            assert!(error.starts_with("folder/a.obj: ") && error.contains(part), "{face}: {error}");
        }
        assert!(problem("# nothing\n").contains("no vertices and no faces"));
        assert!(problem(&format!("{SQUARE}f {} 1 2", i64::MIN)).contains("out of range"));
    }
}
