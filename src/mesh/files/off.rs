//! OFF, the object file format of Geomview, as text.
//!
//! `[ST][C][N]OFF`, the numbers of vertices, faces and edges, then a line a vertex (position, normal, colour, texture
//! coordinate, as the letters say) and a line a face (number of corners, corners from 0, a colour that is read over).
//! Comments run from `#` to the end of the line. Colours are whole numbers 0..255 or fractions 0..1, with or without
//! alpha. The homogeneous (`4OFF`), n-dimensional (`nOFF`) and binary kinds are refused.
//! Source: <http://www.geomview.org/docs/html/OFF.html>.

use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;

use super::build::MeshBuilder;
use super::text::{lines, number, show, words};
use super::{Polygons, ReadMesh, color};
use crate::Result;

/// Which columns a vertex has behind its position.
#[derive(Clone, Copy, Default)]
struct Columns {
    normal: bool,
    color: bool,
    uv: bool,
}

/// The lines that hold anything, without comments.
struct Records<'a> {
    lines: Box<dyn Iterator<Item = (usize, Vec<&'a [u8]>)> + 'a>,
    last: usize,
}

impl<'a> Records<'a> {
    fn next(&mut self) -> Option<(usize, Vec<&'a [u8]>)> {
        let record = self.lines.next()?;
        self.last = record.0;
        Some(record)
    }
}

pub(super) fn read(path: &Path, data: &[u8]) -> Result<ReadMesh> {
    let mut builder = MeshBuilder::new(path);
    let mut records = Records {
        lines: Box::new(lines(data).map(|(i, line)| (i, words(line).collect::<Vec<_>>())).filter(|r| !r.1.is_empty())),
        last: 1,
    };
    let at = |builder: &MeshBuilder, line: usize, problem: String| builder.refuse(format!("line {line}: {problem}"));

    let (line, mut header) = records.next().ok_or_else(|| builder.refuse("no header; `OFF` is expected"))?;
    let columns = columns(header[0]).map_err(|e| at(&builder, line, e))?;
    if header.get(1).is_some_and(|word| word.eq_ignore_ascii_case(b"binary")) {
        return Err(builder.refuse("binary OFF is not read; text OFF, PLY or OBJ would work"));
    }
    header.remove(0);
    let (line, counts) = match header.is_empty() {
        false => (line, header),
        true => {
            records.next().ok_or_else(|| builder.refuse("the file ends before the numbers of vertices and faces"))?
        }
    };
    let counts: Vec<u64> =
        counts.into_iter().map(number).collect::<Result<_, _>>().map_err(|e| at(&builder, line, e))?;
    let &[vertices, faces, ..] = counts.as_slice() else {
        return Err(at(&builder, line, "the numbers of vertices and faces are expected".into()));
    };
    // A vertex takes 6 bytes at least (`0 0 0` and a line end), a face 2: counts beyond that are lies.
    for (count, what, least) in [(vertices, "vertices", 6), (faces, "faces", 2)] {
        if count > data.len() as u64 / least {
            return Err(at(&builder, line, format!("claims {count} {what}, but the file has {} bytes", data.len())));
        }
    }

    let mut colors = Vec::new();
    let mut uvs = Vec::new();
    let mut normals = Vec::new();
    for v in 0..vertices {
        let Some((line, record)) = records.next() else {
            return Err(at(&builder, records.last, format!("the file ends after {v} of {vertices} vertices")));
        };
        let vertex = vertex(&record, columns).map_err(|e| at(&builder, line, e))?;
        builder.vertex(vertex.position, || format!("line {line}"))?;
        colors.extend(vertex.color);
        uvs.extend(vertex.uv);
        normals.extend(vertex.normal);
    }
    let mut polygon = Vec::new();
    for f in 0..faces {
        let Some((line, record)) = records.next() else {
            return Err(at(&builder, records.last, format!("the file ends after {f} of {faces} faces")));
        };
        let claimed: usize = number(record[0]).map_err(|e| at(&builder, line, e))?;
        let Some(corners) = record.get(1..=claimed) else {
            let problem = format!("the face claims {claimed} corners, but {} numbers follow", record.len() - 1);
            return Err(at(&builder, line, problem));
        };
        polygon.clear();
        for corner in corners {
            let index: i64 = number(corner).map_err(|e| at(&builder, line, e))?;
            polygon.push(builder.index(index, || format!("line {line}"))?);
        }
        builder.polygon(&mut polygon, || format!("line {line}"));
    }
    if let Some((line, _)) = records.next() {
        builder.warn(format!("line {line}: what follows the last face is ignored"));
    }
    builder.mesh.colors = columns.color.then_some(colors);
    builder.mesh.uvs = columns.uv.then_some(uvs);
    builder.mesh.normals = (normals.len() == builder.mesh.positions.len()).then_some(normals);
    builder.finish()
}

fn columns(keyword: &[u8]) -> Result<Columns, String> {
    let Some(letters) = keyword.strip_suffix(b"OFF") else {
        return Err(format!("`{}` is no OFF header; OFF, COFF, NOFF, CNOFF or STOFF is expected", show(keyword)));
    };
    let (uv, letters) = match letters.strip_prefix(b"ST") {
        Some(letters) => (true, letters),
        None => (false, letters),
    };
    let (color, normal) = match letters {
        b"" => (false, false),
        b"C" => (true, false),
        b"N" => (false, true),
        b"CN" | b"NC" => (true, true),
        _ => return Err(format!("`{}` is not read; points in three dimensions would work", show(keyword))),
    };
    Ok(Columns { normal, color, uv })
}

struct Vertex {
    position: DVec3,
    /// None where it is no numbers.
    normal: Option<[f32; 3]>,
    color: Option<[f32; 4]>,
    uv: Option<[f32; 2]>,
}

fn vertex(record: &[&[u8]], columns: Columns) -> Result<Vertex, String> {
    let least = 3 + 3 * usize::from(columns.normal || columns.color) + 2 * usize::from(columns.uv);
    let least = least + 3 * usize::from(columns.normal && columns.color);
    if record.len() < least {
        return Err(format!("a vertex needs {least} numbers here, it has {}", record.len()));
    }
    let [x, y, z] = [number(record[0]), number(record[1]), number(record[2])];
    let normal = [3, 4, 5].map(|i| record.get(i).and_then(|word| number(word).ok()));
    let normal = match normal {
        [Some(x), Some(y), Some(z)] if columns.normal => Some([x, y, z]),
        _ => None,
    };
    let mut record = &record[3 + 3 * usize::from(columns.normal)..];
    let uv = match columns.uv {
        true => {
            let (front, uv) = record.split_at(record.len() - 2);
            record = front;
            Some([number(uv[0])?, number(uv[1])?])
        }
        false => None,
    };
    let color = columns.color.then(|| rgba(record)).transpose()?;
    Ok(Vertex { position: DVec3::new(x?, y?, z?), normal, color, uv })
}

/// Three or four channels: whole numbers are 0..255, numbers with a point are 0..1.
fn rgba(words: &[&[u8]]) -> Result<[f32; 4], String> {
    let full = if words.iter().any(|word| word.contains(&b'.')) { 1.0 } else { 255.0 };
    let mut color = [1.0; 4];
    for (channel, word) in color.iter_mut().zip(words) {
        *channel = number::<f32>(word)? / full;
    }
    Ok(color::decode(color))
}

pub(super) fn write<const N: usize>(out: &mut dyn Write, mesh: &Polygons<N>) -> io::Result<()> {
    let letters = [("ST", mesh.uvs.is_some()), ("C", mesh.colors.is_some()), ("N", mesh.normals.is_some())];
    let kind: String = letters.into_iter().filter(|(_, has)| *has).map(|(letter, _)| letter).collect();
    writeln!(out, "{kind}OFF\n{} {} 0", mesh.positions.len(), mesh.faces.len())?;
    for (v, p) in mesh.positions.iter().enumerate() {
        write!(out, "{:?} {:?} {:?}", p.x, p.y, p.z)?;
        if let Some(normals) = mesh.normals {
            let [x, y, z] = normals[v];
            write!(out, " {x:?} {y:?} {z:?}")?;
        }
        if let Some(colors) = mesh.colors {
            let [r, g, b, a] = color::encode_bytes(colors[v]);
            write!(out, " {r} {g} {b} {a}")?;
        }
        if let Some(uvs) = mesh.uvs {
            write!(out, " {:?} {:?}", uvs[v][0], uvs[v][1])?;
        }
        writeln!(out)?;
    }
    for face in mesh.faces {
        write!(out, "{N}")?;
        for v in face {
            write!(out, " {v}")?;
        }
        writeln!(out)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<ReadMesh> {
        read(Path::new("a.off"), text.as_bytes())
    }

    const SQUARE: &str = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n";

    #[test]
    fn comments_crlf_polygons_and_counts_beside_the_keyword() {
        let text =
            format!("OFF 4 2 0 # counts\n\n# the corners\n{SQUARE}4 0 1 2 3 255 0 0\n3 0 1 2\n").replace('\n', "\r\n");
        let read = parse(&text).unwrap();
        assert_eq!(read.mesh.triangles.len(), 3);
        assert_eq!((read.mesh.colors, read.warnings), (None, vec![]));
    }

    #[test]
    fn colours_normals_and_texture_coordinates() {
        let text = "STCNOFF\n3 1 0\n0 0 0 0 0 1 255 0 0 0 .5\n1 0 0 0 0 1 0 255 0 51 1 .5\n0 1 0 0 0 1 0.0 0.0 1.0 0 1\n3 0 1 2\n";
        let mesh = parse(text).unwrap().mesh;
        assert_eq!(mesh.colors.unwrap(), [[1., 0., 0., 1.], [0., 1., 0., 0.2], [0., 0., 1., 1.]]);
        assert_eq!(mesh.uvs.unwrap(), [[0., 0.5], [1., 0.5], [0., 1.]]);
    }

    #[test]
    fn refusals_say_the_line() {
        for (text, part) in [
            ("OFF\n3535235358 6 0\n".to_owned() + SQUARE, "line 2: claims 3535235358 vertices"),
            ("OFF\n3 9999999 0\n".to_owned() + SQUARE, "line 2: claims 9999999 faces"),
            ("OFF\n5 1 0\n".to_owned() + SQUARE, "line 6: the file ends after 4 of 5 vertices"),
            ("OFF\n4 2 0\n".to_owned() + SQUARE + "3 0 1 2", "line 7: the file ends after 1 of 2 faces"),
            ("OFF\n4 1 0\n".to_owned() + SQUARE + "3 0 1 4", "line 7: vertex index 4 is out of range"),
            ("OFF\n4 1 0\n".to_owned() + SQUARE + "3 0 1 -1", "vertex index -1 is out of range"),
            ("OFF\n4 1 0\n".to_owned() + SQUARE + "5 0 1 2", "claims 5 corners, but 3 numbers follow"),
            ("OFF\n4 0 0\n".to_owned() + SQUARE, "4 points only"),
            ("OFF\n1 0 0\n0 nan 0 \n".to_owned(), "line 3: vertex 0 is not finite"),
            ("COFF\n1 0 0\n0 0 0\n".to_owned(), "line 3: a vertex needs 6 numbers here"),
            ("4OFF\n".to_owned(), "line 1: `4OFF` is not read"),
            ("OFF BINARY\n".to_owned(), "binary OFF is not read"),
            ("solid\n".to_owned(), "`solid` is no OFF header"),
            ("OFF\n".to_owned(), "ends before the numbers"),
            ("OFF\n3\n".to_owned(), "line 2: the numbers of vertices and faces"),
        ] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains(part), "{part} in {error}");
        }
    }
}
