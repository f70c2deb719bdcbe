//! PLY, text and binary of both byte orders.
//!
//! The header is parsed by `ply-rs-bw`; the body is decoded here in one pass, without a map a vertex, with the place of every
//! error, and with the numbers of real exporters (`.5`, `5.`, `nan`) that the crate's grammar refuses.
//!
//! Read: element `vertex` (x, y, z; red, green, blue, alpha; s, t or u, v), element `face` (a list `vertex_indices` or
//! `vertex_index`), element `tristrips` (lists in which −1 begins a new strip). All other elements and properties are
//! skipped. Colours of integer type are fractions of their type's largest value.
//! Source: Turk, The PLY Polygon File Format, 1994.

use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{DefaultElement, ElementDef, Encoding, PropertyType, ScalarType};

use super::build::MeshBuilder;
use super::text::{number, show};
use super::{Polygons, ReadMesh, color};
use crate::Result;

/// The body of the file: a stream of scalars in one of the encodings.
struct Body<'a> {
    data: &'a [u8],
    at: usize,
    encoding: Encoding,
    /// Line of the text encoding.
    line: usize,
}

impl Body<'_> {
    fn place(&self) -> String {
        match self.encoding {
            Encoding::Ascii => format!("line {}", self.line),
            _ => format!("byte {}", self.at),
        }
    }

    fn left(&self) -> usize {
        self.data.len() - self.at
    }

    /// The fewest bytes that a scalar takes; in text, a digit and a separator.
    fn least(&self, scalar: &ScalarType) -> usize {
        if self.encoding == Encoding::Ascii { 2 } else { size(scalar) }
    }

    /// The next scalar. Every type of the format fits an f64 exactly.
    fn next(&mut self, scalar: &ScalarType) -> Result<f64, String> {
        const ENDS: &str = "the file ends here, more is announced";
        if self.encoding == Encoding::Ascii {
            while let Some(byte) = self.data.get(self.at).filter(|byte| byte.is_ascii_whitespace()) {
                self.line += usize::from(*byte == b'\n');
                self.at += 1;
            }
            let rest = &self.data[self.at..];
            let word = &rest[..rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len())];
            if word.is_empty() {
                return Err(ENDS.into());
            }
            self.at += word.len();
            return number(word);
        }
        let bytes = self.data.get(self.at..self.at + size(scalar)).ok_or(ENDS)?;
        let mut little = [0; 8];
        little[..bytes.len()].copy_from_slice(bytes);
        if self.encoding == Encoding::BinaryBigEndian {
            little[..bytes.len()].reverse();
        }
        self.at += bytes.len();
        let [b0, b1, b2, b3, ..] = little;
        Ok(match scalar {
            ScalarType::Char => i8::from_le_bytes([b0]).into(),
            ScalarType::UChar => b0.into(),
            ScalarType::Short => i16::from_le_bytes([b0, b1]).into(),
            ScalarType::UShort => u16::from_le_bytes([b0, b1]).into(),
            ScalarType::Int => i32::from_le_bytes([b0, b1, b2, b3]).into(),
            ScalarType::UInt => u32::from_le_bytes([b0, b1, b2, b3]).into(),
            ScalarType::Float => f32::from_le_bytes([b0, b1, b2, b3]).into(),
            ScalarType::Double => f64::from_le_bytes(little),
        })
    }

    /// The length of a list that can be in the rest of the file.
    fn length(&mut self, count: &ScalarType, item: &ScalarType) -> Result<usize, String> {
        let length = self.next(count)?;
        if length < 0.0 || length.fract() != 0.0 {
            return Err(format!("a list cannot have {length} entries"));
        }
        let most = (self.left() + 1) / self.least(item);
        if length > most as f64 {
            return Err(format!("a list claims {length} entries, but {} bytes follow", self.left()));
        }
        Ok(length as usize)
    }
}

fn size(scalar: &ScalarType) -> usize {
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// The largest value of an integer type; 1 for fractions.
fn full_scale(scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Char => i8::MAX.into(),
        ScalarType::UChar => u8::MAX.into(),
        ScalarType::Short => i16::MAX.into(),
        ScalarType::UShort => u16::MAX.into(),
        ScalarType::Int => i32::MAX.into(),
        ScalarType::UInt => u32::MAX.into(),
        ScalarType::Float | ScalarType::Double => 1.0,
    }
}

pub(super) fn read(path: &Path, data: &[u8]) -> Result<ReadMesh> {
    let mut builder = MeshBuilder::new(path);
    let mut reader = Reader::new(data);
    let header = Parser::<DefaultElement>::new().read_header(&mut reader).map_err(|e| builder.refuse(in_a_line(&e)))?;
    let at = data.len() - reader.get_ref().len();
    let mut body = Body { data, at, encoding: header.encoding, line: reader.line() };
    for element in header.elements.values() {
        let least: usize = element
            .properties
            .values()
            .map(|p| match &p.data_type {
                PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => body.least(scalar),
            })
            .sum();
        if least == 0 {
            continue;
        }
        if element.count > (body.left() + 1) / least {
            let (name, count, left) = (&element.name, element.count, body.left());
            let problem = format!("truncated: the header claims {count} of element `{name}`, but {left} bytes follow");
            return Err(builder.refuse(format!("{}: {problem}", body.place())));
        }
        match element.name.as_str() {
            "vertex" => read_vertices(&mut builder, &mut body, element)?,
            "face" => read_faces(&mut builder, &mut body, element, Faces::Polygons)?,
            "tristrips" => read_faces(&mut builder, &mut body, element, Faces::Strips)?,
            _ => read_faces(&mut builder, &mut body, element, Faces::Other)?,
        }
    }
    if body.encoding != Encoding::Ascii && body.left() > 0 {
        builder.warn(format!("{} bytes behind the last element are ignored", body.left()));
    }
    builder.finish()
}

/// The crate's message without its line breaks and the bytes of a garbled line.
fn in_a_line(error: &ply_rs_bw::parser::ParseError) -> String {
    let message = error.to_string();
    let mut parts = message.lines();
    let what = parts.next().unwrap_or_default().trim_end_matches('.');
    let text = parts.find_map(|part| part.trim().strip_prefix("String: '"));
    match text {
        Some(text) => format!("header: {what}: `{}`", show(text.trim_end_matches('\'').as_bytes())),
        None => format!("header: {what}"),
    }
}

fn read_vertices(builder: &mut MeshBuilder, body: &mut Body, element: &ElementDef) -> Result<()> {
    // Where each property goes in [x, y, z, r, g, b, a, u, v].
    let role = |name: &str| {
        Some(match name {
            "x" => 0,
            "y" => 1,
            "z" => 2,
            "red" | "r" | "diffuse_red" => 3,
            "green" | "g" | "diffuse_green" => 4,
            "blue" | "b" | "diffuse_blue" => 5,
            "alpha" | "a" | "diffuse_alpha" => 6,
            "s" | "u" | "texture_u" => 7,
            "t" | "v" | "texture_v" => 8,
            "nx" => 9,
            "ny" => 10,
            "nz" => 11,
            _ => return None,
        })
    };
    let properties: Vec<_> = element.properties.iter().map(|(name, p)| (role(name), &p.data_type)).collect();
    let has = |role: usize| properties.iter().any(|p| p.0 == Some(role) && matches!(p.1, PropertyType::Scalar(_)));
    if !(0..3).all(has) {
        return Err(builder.refuse("header: element `vertex` needs the properties x, y and z"));
    }
    let (colored, mapped, normal) = ((3..6).all(has), (7..9).all(has), (9..12).all(has));
    let mut colors = Vec::new();
    let mut uvs = Vec::new();
    let mut normals = Vec::new();
    for _ in 0..element.count {
        let mut values = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        for (role, data_type) in &properties {
            match data_type {
                PropertyType::Scalar(scalar) => {
                    let value = body.next(scalar).map_err(|e| refuse_at(builder, body, &e))?;
                    match role {
                        Some(role @ 3..7) => values[*role] = value / full_scale(scalar),
                        Some(role) => values[*role] = value,
                        None => {}
                    }
                }
                PropertyType::List(count, item) => {
                    skip_list(body, count, item).map_err(|e| refuse_at(builder, body, &e))?;
                }
            }
        }
        let [x, y, z, r, g, b, a, u, v, ref n @ ..] = values;
        builder.vertex(DVec3::new(x, y, z), || body.place())?;
        if colored {
            colors.push([r, g, b, a].map(|c| c as f32));
        }
        if mapped {
            uvs.push([u as f32, v as f32]);
        }
        if normal {
            normals.push(n.map(|v| v as f32));
        }
    }
    if colored {
        // Fractions above 1 are bytes that an exporter stored as floats.
        let full =
            |channel: &dyn Fn(&[f32; 4]) -> f32| if colors.iter().any(|c| channel(c) > 1.0) { 255.0 } else { 1.0 };
        let rgb = full(&|&[r, g, b, _]: &[f32; 4]| r.max(g).max(b));
        let alpha = full(&|c| c[3]);
        let decode = |&[r, g, b, a]: &[f32; 4]| color::decode([r / rgb, g / rgb, b / rgb, a / alpha]);
        builder.mesh.colors = Some(colors.iter().map(decode).collect());
    }
    builder.mesh.uvs = mapped.then_some(uvs);
    builder.mesh.normals = normal.then_some(normals);
    Ok(())
}

/// What the lists of an element mean.
#[derive(Clone, Copy, PartialEq)]
enum Faces {
    Polygons,
    Strips,
    Other,
}

fn read_faces(builder: &mut MeshBuilder, body: &mut Body, element: &ElementDef, kind: Faces) -> Result<()> {
    let is_corners = |name: &str| matches!(name, "vertex_indices" | "vertex_index");
    let lists = element.properties.iter().filter(|(_, p)| matches!(p.data_type, PropertyType::List(..)));
    if kind != Faces::Other && element.count > 0 && !lists.into_iter().any(|(name, _)| is_corners(name)) {
        let problem = format!("header: element `{}` needs a list `vertex_indices`", element.name);
        return Err(builder.refuse(problem));
    }
    let mut corners = Vec::new();
    for n in 0..element.count {
        for (name, property) in &element.properties {
            match &property.data_type {
                PropertyType::Scalar(scalar) => {
                    body.next(scalar).map_err(|e| refuse_at(builder, body, &e))?;
                }
                PropertyType::List(count, item) if kind != Faces::Other && is_corners(name) => {
                    let length = body.length(count, item).map_err(|e| refuse_at(builder, body, &e))?;
                    corners.clear();
                    for _ in 0..length {
                        let index = body.next(item).map_err(|e| refuse_at(builder, body, &e))?;
                        if kind == Faces::Strips && index == -1.0 {
                            end_strip(builder, &mut corners);
                            continue;
                        }
                        if index.fract() != 0.0 {
                            return Err(refuse_at(builder, body, &format!("{index} is no vertex index")));
                        }
                        let place = || format!("{}: {} {n}", body.place(), element.name);
                        corners.push(builder.index(index as i64, place)?);
                    }
                    match kind {
                        Faces::Strips => end_strip(builder, &mut corners),
                        _ => builder.polygon(&mut corners, || format!("{}: face {n}", body.place())),
                    }
                }
                PropertyType::List(count, item) => {
                    if kind == Faces::Polygons && name.contains("texcoord") {
                        builder.note("list(s) of texture coordinates a corner skipped", || format!("face {n}"));
                    }
                    skip_list(body, count, item).map_err(|e| refuse_at(builder, body, &e))?;
                }
            }
        }
    }
    if kind == Faces::Strips {
        builder.warn("triangle strips expanded");
    }
    Ok(())
}

/// Expands a strip: every second triangle is turned, so that all face one way. Strips repeat vertices to go around
/// corners: such triangles are none.
fn end_strip(builder: &mut MeshBuilder, corners: &mut Vec<u32>) {
    for (i, window) in corners.windows(3).enumerate() {
        if let &[a, b, c] = window
            && a != b
            && b != c
            && c != a
        {
            builder.mesh.triangles.push(if i % 2 == 0 { [a, b, c] } else { [b, a, c] });
        }
    }
    corners.clear();
}

fn skip_list(body: &mut Body, count: &ScalarType, item: &ScalarType) -> Result<(), String> {
    for _ in 0..body.length(count, item)? {
        body.next(item)?;
    }
    Ok(())
}

fn refuse_at(builder: &MeshBuilder, body: &Body, problem: &str) -> crate::EditError {
    builder.refuse(format!("{}: {problem}", body.place()))
}

pub(super) fn write<const N: usize>(out: &mut dyn Write, mesh: &Polygons<N>) -> io::Result<()> {
    // Single precision where nothing is lost by it.
    let single = mesh.positions.iter().all(|p| p.as_vec3().as_dvec3() == *p);
    let real = if single { "float" } else { "double" };
    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment vdb-edit\nelement vertex {}", mesh.positions.len())?;
    writeln!(out, "property {real} x\nproperty {real} y\nproperty {real} z")?;
    if mesh.colors.is_some() {
        writeln!(out, "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha")?;
    }
    if mesh.uvs.is_some() {
        writeln!(out, "property float s\nproperty float t")?;
    }
    if mesh.normals.is_some() {
        writeln!(out, "property float nx\nproperty float ny\nproperty float nz")?;
    }
    // Signed indices are what the oldest readers expect.
    let index = if mesh.positions.len() <= i32::MAX as usize { "int" } else { "uint" };
    writeln!(out, "element face {}\nproperty list uchar {index} vertex_indices\nend_header", mesh.faces.len())?;
    for (v, p) in mesh.positions.iter().enumerate() {
        for x in p.to_array() {
            match single {
                true => out.write_all(&(x as f32).to_le_bytes())?,
                false => out.write_all(&x.to_le_bytes())?,
            }
        }
        if let Some(colors) = mesh.colors {
            out.write_all(&color::encode_bytes(colors[v]))?;
        }
        if let Some(uvs) = mesh.uvs {
            out.write_all(uvs[v].map(f32::to_le_bytes).as_flattened())?;
        }
        if let Some(normals) = mesh.normals {
            out.write_all(normals[v].map(f32::to_le_bytes).as_flattened())?;
        }
    }
    for face in mesh.faces {
        out.write_all(&[N as u8])?;
        out.write_all(face.map(u32::to_le_bytes).as_flattened())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(data: impl AsRef<[u8]>) -> Result<ReadMesh> {
        read(Path::new("a.ply"), data.as_ref())
    }

    fn problem(data: impl AsRef<[u8]>) -> String {
        parse(data).unwrap_err().to_string()
    }

    const XYZ: &str = "property float x\nproperty double y\nproperty short z\n";
    const LIST: &str = "property list uchar int vertex_index\n";

    fn header(format: &str, vertices: usize, properties: &str, faces: usize) -> String {
        format!(
            "ply\nformat {format} 1.0\ncomment c\nobj_info o\nelement vertex {vertices}\n{XYZ}{properties}\
             element face {faces}\nproperty uchar flags\n{LIST}end_header\n"
        )
    }

    /// A square as text: its corners, and one polygon of 4.
    const SQUARE: &str = "0 0. -0\n1 .0 0\n1. 1e0 0\n0 +1 0\n7 4 0 1 2 3\n";

    #[test]
    fn text_with_odd_numbers_and_crlf() {
        let text = header("ascii", 4, "", 1) + SQUARE;
        for text in [text.clone(), text.replace('\n', "\r\n")] {
            let read = parse(text).unwrap();
            assert_eq!(read.mesh.triangles, [[0, 1, 2], [2, 3, 0]]);
            assert_eq!(read.mesh.positions, [DVec3::ZERO, DVec3::X, DVec3::ONE - DVec3::Z, DVec3::Y]);
            assert_eq!(read.warnings, Vec::<String>::new());
        }
    }

    #[test]
    fn binary_of_both_byte_orders_with_a_crlf_header() {
        for big in [false, true] {
            let order = |little: &[u8]| -> Vec<u8> {
                if big { little.iter().rev().copied().collect() } else { little.to_vec() }
            };
            let format = if big { "binary_big_endian" } else { "binary_little_endian" };
            let mut data = header(format, 3, "property list uchar ushort ring\n", 1).replace('\n', "\r\n").into_bytes();
            for [x, y, z] in [[0i16, 0, 5], [1, 0, -5], [0, 1, 300]] {
                data.extend(order(&f32::from(x).to_le_bytes()));
                data.extend(order(&f64::from(y).to_le_bytes()));
                data.extend(order(&z.to_le_bytes()));
                data.extend([2, 9, 9, 9, 9]);
            }
            data.extend([1, 3]);
            for index in [2i32, 0, 1] {
                data.extend(order(&index.to_le_bytes()));
            }
            let read = parse(&data).unwrap();
            assert_eq!(read.mesh.positions[2], DVec3::new(0.0, 1.0, 300.0));
            assert_eq!(read.mesh.triangles, [[2, 0, 1]]);
            assert!(problem(&data[..data.len() - 1]).contains("the file ends here, more is announced"));
            data.extend([0; 7]);
            assert_eq!(parse(&data).unwrap().warnings, ["7 bytes behind the last element are ignored"]);
        }
    }

    #[test]
    fn colours_and_texture_coordinates_of_every_type() {
        for (types, values) in [
            ("uchar", ["255 0 0", "0 255 0", "0 0 255"]),
            ("ushort", ["65535 0 0", "0 65535 0", "0 0 65535"]),
            ("float", ["1 0 0", "0 1 0", "0 0 1"]),
            ("float", ["255 0 0", "0 255 0", "0 0 255"]),
        ] {
            let properties = ["red", "green", "blue"].map(|c| format!("property {types} {c}\n")).concat();
            let text = header("ascii", 3, &(properties + "property float u\nproperty float v\n"), 1);
            let body =
                format!("0 0 0 {} 0 .5\n1 0 0 {} 1 .5\n0 1 0 {} 0 1\n0 3 0 1 2\n", values[0], values[1], values[2]);
            let mesh = parse(text + &body).unwrap().mesh;
            assert_eq!(mesh.colors.unwrap(), [[1., 0., 0., 1.], [0., 1., 0., 1.], [0., 0., 1., 1.]], "{types}");
            assert_eq!(mesh.uvs.unwrap(), [[0., 0.5], [1., 0.5], [0., 1.]]);
        }
    }

    #[test]
    fn strips_alternate_restart_and_turn_corners() {
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 5\n{XYZ}element tristrips 1\n\
             property list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 2 0\n\
             11 0 1 2 3 3 4 -1 0 1 2 -1\n"
        );
        let read = parse(text).unwrap();
        assert_eq!(read.mesh.triangles, [[0, 1, 2], [2, 1, 3], [0, 1, 2]]);
        assert_eq!(read.warnings, ["triangle strips expanded", "1 of 5 vertices are in no face"]);
    }

    #[test]
    fn refusals_say_where() {
        let start = header("ascii", 4, "", 1);
        let square = |from: &str, to: &str| start.clone() + &SQUARE.replace(from, to);
        let binary = header("binary_little_endian", 1, "", 1);
        for (data, part) in [
            (square("7 4 0 1 2 3", "7 4 0 1 2 4"), "line 17: face 0: vertex index 4 is out of range"),
            (square("7 4 0 1 2 3", "7 4 0 1 2 -1"), "vertex index -1 is out of range"),
            (square("7 4 0 1 2 3", "7 4 0 1 2 0.5"), "line 17: 0.5 is no vertex index"),
            (square("7 4 0 1 2 3", "7 4 0 1 2"), "line 18: the file ends here"),
            (square("7 4 0 1 2 3", "7 400000 0 1 2 3"), "line 17: a list claims 400000 entries"),
            (square("7 4 0 1 2 3", "7 -4 0 1 2 3"), "a list cannot have -4 entries"),
            (square("1e0", "nan"), "line 15: vertex 2 is not finite: (1, NaN, 0)"),
            (square("1e0", "x"), "line 15: `x` is not a number"),
            (header("ascii", usize::MAX, "", 1) + SQUARE, "claims 18446744073709551615 of element `vertex`"),
            (header("ascii", 4, "", 1 << 40) + SQUARE, "of element `face`, but"),
            (binary.clone() + "12345", "claims 1 of element `vertex`, but 5 bytes follow"),
            (header("ascii", 4, "", 0) + SQUARE, "no faces, 4 points only"),
            (start.replace("float x", "float nx") + SQUARE, "needs the properties x, y and z"),
            (start.replace("vertex_index", "corners") + SQUARE, "needs a list `vertex_indices`"),
            (start.replace("float x", "vec3 x") + SQUARE, "header: Line 6: Couldn't parse line: `property"),
            ("ply\nformat ascii 1.0\nelement vertex 3\n".into(), "header"),
            ("solid".into(), "header: Line 1: Expected magic number 'ply'"),
        ] {
            let error = problem(&data);
            assert!(error.starts_with("a.ply: ") && error.contains(part), "{part} in {error}");
            assert!(!error.contains('\n'));
        }
        assert!(problem([b"ply\n\xff\xfe".as_slice(), &[0; 9]].concat()).contains("header"));
    }

    #[test]
    fn elements_without_properties_take_no_time() {
        let text = header("ascii", 4, "", 1).replace("element vertex", "element nothing 9999999999999\nelement vertex");
        assert_eq!(parse(text + SQUARE).unwrap().mesh.triangles.len(), 2);
    }
}
