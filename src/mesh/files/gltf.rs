//! glTF 2.0, as `.glb` or as `.gltf` with its data inside or beside it.
//!
//! Read: all triangles, strips and fans of the default scene, moved by their nodes (a mirroring node turns their
//! winding), with `POSITION`, `NORMAL`, `COLOR_0` and `TEXCOORD_0`. Vertices split for the sake of normals or texture coordinates stay
//! split. glTF counts texture rows from the top, all other formats from the bottom: `v` is turned. Colours are linear.
//! Extensions that the file requires and that change geometry (Draco, meshopt, instancing …) are refused by name.
//!
//! The JSON and its validity are the `gltf` crate's; accessors are decoded here, because the crate's own iterators panic
//! on overflowing offsets and do not read quantized positions.
//! Source: Khronos, glTF 2.0 Specification; chapter numbers below are its.

use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use glam::{DMat3, DMat4, DQuat, DVec3, Vec3};
use gltf::accessor::{DataType, Dimensions};
use gltf::json::validation::Validate;
use gltf::mesh::Mode;
use gltf::scene::Transform;
use gltf::{Accessor, Document, Gltf, Primitive, Semantic};

use super::build::MeshBuilder;
use super::read_beside;
use super::{ReadMesh, color};
use crate::{EditError, Result};

/// Required extensions that do not change where surfaces are.
const HARMLESS: [&str; 4] = ["KHR_mesh_quantization", "KHR_lights_", "KHR_materials_", "KHR_texture_"];

/// A document with the bytes of its buffers.
struct File {
    document: Document,
    buffers: Vec<Vec<u8>>,
}

pub(super) fn read(path: &Path, data: &[u8]) -> Result<ReadMesh> {
    let mut builder = MeshBuilder::new(path);
    let file = load(path, data)?;
    let mut colors = Attribute::new([1.0; 4]);
    let mut uvs = Attribute::new([0.0; 2]);
    let mut normals = Attribute::new([0.0; 3]);
    for (node, to_world) in instances(path, &file.document)? {
        if node.skin().is_some() {
            builder.note("skinned mesh(es) read in their rest pose", || format!("node {}", node.index()));
        }
        let Some(mesh) = node.mesh() else { continue };
        for primitive in mesh.primitives() {
            let place = format!("mesh {} primitive {}", mesh.index(), primitive.index());
            if primitive.morph_targets().len() > 0 {
                builder.note("primitive(s) with morph targets read without them", || place.clone());
            }
            if matches!(primitive.mode(), Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip) {
                builder.note("primitive(s) of points or lines skipped", || place);
                continue;
            }
            let first = builder.mesh.positions.len();
            read_primitive(&mut builder, &file, &primitive, to_world, &place)?;
            let added = first..builder.mesh.positions.len();
            let values = |semantic: Semantic| match primitive.get(&semantic) {
                Some(accessor) => {
                    let values =
                        decode(&file, &accessor).map_err(|e| EditError::input(path, format!("{place}: {e}")))?;
                    if values.len() != added.len() {
                        let problem =
                            format!("{} values of {} for {} vertices", values.len(), semantic.to_string(), added.len());
                        return Err(EditError::input(path, format!("{place}: {problem}")));
                    }
                    Ok(Some(values))
                }
                None => Ok(None),
            };
            colors.extend(added.clone(), values(Semantic::Colors(0))?, |c| {
                [c[0], c[1], c[2], if c[4] > 3.0 { c[3] } else { 1.0 }].map(|c| color::unit(c as f32))
            });
            uvs.extend(added.clone(), values(Semantic::TexCoords(0))?, |c| [c[0] as f32, 1.0 - c[1] as f32]);
            let turned = DMat3::from_mat4(to_world).inverse().transpose();
            normals.extend(added.clone(), values(Semantic::Normals)?, |c| {
                (turned * DVec3::new(c[0], c[1], c[2])).normalize_or_zero().as_vec3().to_array()
            });
        }
    }
    builder.mesh.colors = colors.values;
    builder.mesh.uvs = uvs.values;
    builder.mesh.normals = normals.values;
    builder.finish()
}

/// An optional attribute of the whole mesh; primitives without it get the default.
struct Attribute<const N: usize> {
    default: [f32; N],
    values: Option<Vec<[f32; N]>>,
}

impl<const N: usize> Attribute<N> {
    fn new(default: [f32; N]) -> Self {
        Self { default, values: None }
    }

    fn extend(
        &mut self,
        vertices: std::ops::Range<usize>,
        values: Option<Vec<[f64; 5]>>,
        convert: impl Fn([f64; 5]) -> [f32; N],
    ) {
        match (values, &mut self.values) {
            (Some(new), all) => {
                let all = all.get_or_insert_default();
                all.resize(vertices.start, self.default);
                all.extend(new.into_iter().map(convert));
            }
            (None, Some(all)) => all.resize(vertices.end, self.default),
            (None, None) => {}
        }
    }
}

/// Parses and validates the document and fetches its buffers.
fn load(path: &Path, data: &[u8]) -> Result<File> {
    let refuse = |problem: String| EditError::input(path, problem);
    // The crate subtracts the 12 bytes of the header from this length unseen.
    if data.starts_with(b"glTF") {
        let length = data.get(8..12).and_then(|bytes| bytes.try_into().ok()).map_or(0, u32::from_le_bytes);
        if length < 20 || length as usize > data.len() {
            return Err(refuse(format!("truncated: the header claims {length} bytes, the file has {}", data.len())));
        }
    }
    let Gltf { document, blob } =
        Gltf::from_slice_without_validation(data).map_err(|e| refuse(format!("no glTF: {e}")))?;
    let harmless = |name: &str| HARMLESS.iter().any(|start| name.starts_with(start));
    if let Some(name) = document.extensions_required().find(|name| !harmless(name)) {
        let advice = "export without it (no compression, instances made real)";
        return Err(refuse(format!("the required extension `{name}` is not supported; {advice}")));
    }
    // The crate's validation looks these accessors up before it has checked their indices.
    let root = document.as_json();
    let used = root.meshes.iter().flat_map(|m| &m.primitives).flat_map(|p| p.attributes.values());
    if let Some(missing) = used.map(|index| index.value()).find(|&index| index >= root.accessors.len()) {
        let problem = format!("accessor {missing} is missing: there are {}", root.accessors.len());
        return Err(refuse(format!("invalid glTF: {problem}")));
    }
    let mut invalid = None;
    root.validate(root, gltf::json::Path::new, &mut |at, error| {
        let at = at().to_string();
        // Harmless extensions were let through above; bounds of accessors are not needed.
        if !(at.starts_with("extensionsRequired") || at.ends_with(".min") || at.ends_with(".max")) {
            invalid.get_or_insert_with(|| format!("invalid glTF: {at}: {error}"));
        }
    });
    if let Some(problem) = invalid {
        return Err(refuse(problem));
    }
    let mut blob = blob;
    let mut buffers = Vec::new();
    for buffer in document.buffers() {
        let bytes = match buffer.source() {
            gltf::buffer::Source::Bin => blob.take().ok_or("the binary chunk is missing".into()),
            gltf::buffer::Source::Uri(uri) => fetch(path, uri),
        };
        let bytes = bytes.map_err(|e| refuse(format!("buffer {}: {e}", buffer.index())))?;
        if bytes.len() < buffer.length() {
            let problem = format!("truncated: {} bytes of {}", bytes.len(), buffer.length());
            return Err(refuse(format!("buffer {}: {problem}", buffer.index())));
        }
        buffers.push(bytes);
    }
    Ok(File { document, buffers })
}

/// The bytes behind a URI: base64 data, or a file beside the document.
fn fetch(path: &Path, uri: &str) -> Result<Vec<u8>, String> {
    if let Some(data) = uri.strip_prefix("data:") {
        let (_, text) = data.split_once(";base64,").ok_or("a data URI that is not base64")?;
        return BASE64.decode(text).map_err(|e| format!("base64: {e}"));
    }
    let name = percent_encoding::percent_decode_str(uri).decode_utf8().map_err(|e| e.to_string())?;
    if name.contains("://") {
        return Err(format!("`{name}` is not beside the file; only relative paths are followed"));
    }
    read_beside(path, &name).map_err(|e| format!("`{name}` cannot be read: {e}"))
}

/// The nodes of the default scene with their transforms to world.
fn instances<'a>(path: &Path, document: &'a Document) -> Result<Vec<(gltf::Node<'a>, DMat4)>> {
    let scene = document.default_scene().or_else(|| document.scenes().next());
    let roots: Vec<_> = match scene {
        Some(scene) => scene.nodes().collect(),
        None => {
            // A library of nodes without a scene (chapter 3.5.1): take those that are nobody's child.
            let mut child = vec![false; document.nodes().len()];
            document.nodes().flat_map(|node| node.children()).for_each(|node| child[node.index()] = true);
            document.nodes().filter(|node| !child[node.index()]).collect()
        }
    };
    let mut seen = vec![false; document.nodes().len()];
    let mut found = Vec::new();
    let mut open: Vec<_> = roots.into_iter().rev().map(|node| (node, DMat4::IDENTITY)).collect();
    while let Some((node, parent)) = open.pop() {
        if std::mem::replace(&mut seen[node.index()], true) {
            let problem = format!("node {} is reached twice; the nodes of a scene must form a tree", node.index());
            return Err(EditError::input(path, problem));
        }
        let to_world = parent * local(&node);
        let children: Vec<_> = node.children().map(|child| (child, to_world)).collect();
        open.extend(children.into_iter().rev());
        found.push((node, to_world));
    }
    Ok(found)
}

fn local(node: &gltf::Node) -> DMat4 {
    match node.transform() {
        Transform::Matrix { matrix } => DMat4::from_cols_array_2d(&matrix.map(|column| column.map(f64::from))),
        Transform::Decomposed { translation, rotation, scale } => {
            let rotation = DQuat::from_array(rotation.map(f64::from));
            // Files hold rotations rounded to single precision; a rotation of length 0 is none.
            let length = rotation.length();
            let rotation = if length > 0.0 { rotation / length } else { DQuat::IDENTITY };
            let [scale, translation] = [scale, translation].map(|v| Vec3::from_array(v).as_dvec3());
            DMat4::from_scale_rotation_translation(scale, rotation, translation)
        }
    }
}

fn read_primitive(
    builder: &mut MeshBuilder,
    file: &File,
    primitive: &Primitive,
    to_world: DMat4,
    place: &str,
) -> Result<()> {
    let Some(accessor) = primitive.get(&Semantic::Positions) else {
        return Err(builder.refuse(format!("{place}: no POSITION")));
    };
    let first = builder.mesh.positions.len();
    for [x, y, z, ..] in decode(file, &accessor).map_err(|e| builder.refuse(format!("{place}: {e}")))? {
        builder.vertex(to_world.transform_point3(DVec3::new(x, y, z)), || place.into())?;
    }
    let count = builder.mesh.positions.len() - first;
    let indices = match primitive.indices() {
        Some(accessor) => {
            let values = decode(file, &accessor).map_err(|e| builder.refuse(format!("{place}: indices: {e}")))?;
            values.into_iter().map(|[index, ..]| index as usize).collect()
        }
        None => (0..count).collect::<Vec<_>>(),
    };
    if let Some(index) = indices.iter().find(|&&index| index >= count) {
        return Err(
            builder.refuse(format!("{place}: vertex index {index} is out of range: there are {count} vertices"))
        );
    }
    let corner = |i: usize| (first + indices[i]) as u32;
    let triangles = match primitive.mode() {
        Mode::Triangles => indices.len() / 3,
        _ => indices.len().saturating_sub(2),
    };
    if primitive.mode() == Mode::Triangles && indices.len() % 3 != 0 {
        builder.note("primitive(s) with left-over indices", || place.into());
    }
    let mut polygon = Vec::with_capacity(3);
    let mirrored = to_world.determinant() < 0.0;
    for t in 0..triangles {
        // Chapter 3.7.2.1: every second triangle of a strip is turned.
        let [a, b, c] = match primitive.mode() {
            Mode::TriangleStrip if t % 2 == 1 => [t + 1, t, t + 2],
            Mode::TriangleStrip => [t, t + 1, t + 2],
            Mode::TriangleFan => [0, t + 1, t + 2],
            _ => [3 * t, 3 * t + 1, 3 * t + 2],
        }
        .map(corner);
        polygon.clear();
        polygon.extend(if mirrored { [a, c, b] } else { [a, b, c] });
        builder.polygon(&mut polygon, || format!("{place} triangle {t}"));
    }
    Ok(())
}

/// The values of an accessor, up to four components each; the fifth number is how many there are. Whole numbers of a
/// normalized accessor become fractions (chapter 3.11).
fn decode(file: &File, accessor: &Accessor) -> Result<Vec<[f64; 5]>, String> {
    let name = accessor.index();
    if accessor.sparse().is_some() {
        return Err(format!("accessor {name} is sparse, which is not supported; export without"));
    }
    let view = accessor.view().ok_or(format!("accessor {name} has no buffer view"))?;
    let components = match accessor.dimensions() {
        Dimensions::Scalar => 1,
        Dimensions::Vec2 => 2,
        Dimensions::Vec3 => 3,
        Dimensions::Vec4 => 4,
        matrix => return Err(format!("accessor {name} holds matrices ({matrix:?})")),
    };
    let size = accessor.data_type().size();
    let element = components * size;
    let stride = view.stride().unwrap_or(element);
    let count = accessor.count();
    let out_of_range = || format!("accessor {name}: {count} values reach beyond its buffer view or buffer");
    let buffer = file.buffers.get(view.buffer().index()).ok_or_else(out_of_range)?;
    let end = view.offset().checked_add(view.length()).ok_or_else(out_of_range)?;
    let bytes =
        buffer.get(view.offset()..end).and_then(|bytes| bytes.get(accessor.offset()..)).ok_or_else(out_of_range)?;
    let last = count.checked_sub(1).and_then(|n| n.checked_mul(stride)).and_then(|n| n.checked_add(element));
    if stride == 0 || stride < element || last.is_none_or(|last| last > bytes.len()) {
        return Err(out_of_range());
    }
    let value = |b: &[u8]| match (accessor.data_type(), b) {
        (DataType::I8, &[a, ..]) => (i8::from_le_bytes([a]).into(), i8::MAX.into()),
        (DataType::U8, &[a, ..]) => (f64::from(a), f64::from(u8::MAX)),
        (DataType::I16, &[a, b, ..]) => (i16::from_le_bytes([a, b]).into(), i16::MAX.into()),
        (DataType::U16, &[a, b, ..]) => (u16::from_le_bytes([a, b]).into(), u16::MAX.into()),
        (DataType::U32, &[a, b, c, d, ..]) => (u32::from_le_bytes([a, b, c, d]).into(), u32::MAX.into()),
        (DataType::F32, &[a, b, c, d, ..]) => (f32::from_le_bytes([a, b, c, d]).into(), 1.0),
        _ => (f64::NAN, 1.0),
    };
    let mut values = Vec::with_capacity(count);
    for element in bytes.chunks(stride).take(count) {
        let mut entry = [0.0, 0.0, 0.0, 0.0, components as f64];
        for (component, bytes) in entry.iter_mut().zip(element.chunks_exact(size).take(components)) {
            let (number, full) = value(bytes);
            // The most negative whole number is −1, not a little less.
            *component = if accessor.normalized() { (number / full).max(-1.0) } else { number };
        }
        values.push(entry);
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A buffer of three vertices in the plane z = 0, then a fourth, then 16-bit indices 0 1 2 3.
    fn bytes() -> Vec<u8> {
        let positions = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
        let mut bytes: Vec<u8> = positions.as_flattened().iter().flat_map(|x| x.to_le_bytes()).collect();
        bytes.extend([0u16, 1, 2, 3].iter().flat_map(|i| i.to_le_bytes()));
        bytes
    }

    /// A document around [`bytes`]: `nodes` and `primitive` go in as JSON.
    fn document(nodes: &str, primitive: &str, more: &str) -> String {
        let uri = format!("data:application/octet-stream;base64,{}", BASE64.encode(bytes()));
        format!(
            r#"{{"asset": {{"version": "2.0"}}, "scene": 0, "scenes": [{{"nodes": [0]}}], "nodes": [{nodes}],
            "buffers": [{{"byteLength": 56, "uri": "{uri}"}}],
            "bufferViews": [{{"buffer": 0, "byteLength": 48}}, {{"buffer": 0, "byteOffset": 48, "byteLength": 8}}],
            "accessors": [{{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}},
                          {{"bufferView": 1, "componentType": 5123, "count": 4, "type": "SCALAR"}}],
            "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0}} {primitive}}}]}}] {more}}}"#
        )
    }

    fn parse(text: impl AsRef<[u8]>) -> Result<ReadMesh> {
        super::read(Path::new("a.gltf"), text.as_ref())
    }

    const NODE: &str = r#"{"mesh": 0}"#;

    /// Sum of the triangles' area vectors.
    fn facing(mesh: &super::super::TriangleMesh) -> DVec3 {
        let area = |t| {
            let [a, b, c] = mesh.corners(t);
            (b - a).cross(c - a) / 2.0
        };
        (0..mesh.triangles.len()).map(area).sum()
    }

    #[test]
    fn strips_fans_and_skipped_modes() {
        let strip = parse(document(NODE, r#", "mode": 5, "indices": 1"#, "")).unwrap().mesh;
        assert_eq!(strip.triangles, [[0, 1, 2], [2, 1, 3]]);
        assert_eq!(facing(&strip), DVec3::Z);
        let fan = parse(document(NODE, r#", "mode": 6, "indices": 1"#, "")).unwrap().mesh;
        assert_eq!(fan.triangles, [[0, 1, 2], [0, 2, 3]]);
        let plain = parse(document(NODE, "", "")).unwrap();
        assert_eq!(plain.mesh.triangles, [[0, 1, 2]]);
        assert!(plain.warnings[0].contains("left-over indices"), "{:?}", plain.warnings);
        let error = parse(document(NODE, r#", "mode": 1"#, "")).unwrap_err().to_string();
        assert!(error.contains("no vertices and no faces") && error.contains("points or lines skipped"), "{error}");
    }

    #[test]
    fn nested_transforms_are_multiplied_and_mirrors_turn_the_winding() {
        let nodes = r#"{"translation": [10, 0, 0], "scale": [2, 2, 2], "children": [1]},
                       {"matrix": [-1,0,0,0, 0,1,0,0, 0,0,1,0, 0,3,0,1], "mesh": 0}"#;
        let mesh = parse(document(nodes, r#", "mode": 5"#, "")).unwrap().mesh;
        assert_eq!(mesh.positions[1], DVec3::new(8.0, 6.0, 0.0));
        assert_eq!(facing(&mesh), 4.0 * DVec3::Z, "the square still faces +z, its area times 4");
        // A quarter turn about x takes +z to −y.
        let nodes = r#"{"rotation": [0.70710678, 0, 0, 0.70710678], "mesh": 0}"#;
        let mesh = parse(document(nodes, r#", "mode": 5"#, "")).unwrap().mesh;
        assert!((facing(&mesh) + DVec3::Y).length() < 1e-12);
    }

    #[test]
    fn quantized_positions_become_fractions() {
        let text = document(NODE, "", r#", "extensionsRequired": ["KHR_mesh_quantization"]"#).replace(
            r#""componentType": 5126, "count": 4"#,
            r#""componentType": 5121, "normalized": true, "count": 4"#,
        );
        let mesh = parse(text).unwrap().mesh;
        // The first bytes of 0.0, 0.0, 0.0, 1.0f32: the twelve that four vertices take.
        assert_eq!(mesh.positions[..2], [DVec3::ZERO; 2]);
    }

    #[test]
    fn data_beside_the_file_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let text = document(NODE, r#", "mode": 5"#, "");
        let start = text.find("data:").unwrap();
        let end = start + text[start..].find('"').unwrap();
        let path = folder.path().join("a.gltf");
        let outside = |uri: &str| format!("{}{uri}{}", &text[..start], &text[end..]);
        std::fs::write(folder.path().join("my data.bin"), bytes()).unwrap();
        let read = super::read(&path, outside("my%20data.bin").as_bytes()).unwrap();
        assert_eq!(read.mesh.triangles.len(), 2);
        std::fs::write(folder.path().join("my data.bin"), &bytes()[..40]).unwrap();
        for (uri, part) in [
            ("my%20data.bin", "buffer 0: truncated: 40 bytes of 56"),
            ("none.bin", "buffer 0: `none.bin` cannot be read"),
            ("/dev/zero", "`/dev/zero` cannot be read: not a file beside it"),
            ("https://example.org/a.bin", "only relative paths are followed"),
            ("data:;base64,***", "base64"),
            ("data:text/plain,x", "not base64"),
        ] {
            let error = super::read(&path, outside(uri).as_bytes()).unwrap_err().to_string();
            assert!(error.contains(part), "{part} in {error}");
        }
    }

    #[test]
    fn refusals_name_what_is_wrong() {
        let good = document(NODE, r#", "indices": 1"#, "");
        let swap = |from: &str, to: &str| {
            assert!(good.contains(from), "{from}");
            good.replacen(from, to, 1)
        };
        let required = r#", "extensionsRequired": ["KHR_draco_mesh_compression"]"#;
        for (text, part) in [
            (document(NODE, "", required), "the required extension `KHR_draco_mesh_compression` is not supported"),
            (document(r#"{"children": [1]}, {"children": [0]}"#, "", ""), "node 0 is reached twice"),
            (document(r#"{"mesh": 7}"#, "", ""), "invalid glTF: nodes[0].mesh"),
            (swap(r#""POSITION": 0"#, r#""NORMAL": 0"#), "POSITION"),
            (swap(r#""POSITION": 0"#, r#""POSITION": 9"#), "invalid glTF: accessor 9 is missing: there are 2"),
            (
                swap(r#""count": 4, "type": "VEC3""#, r#""count": 5, "type": "VEC3""#),
                "accessor 0: 5 values reach beyond",
            ),
            (swap(r#""count": 4"#, r#""count": 18446744073709551615"#), "reach beyond"),
            (swap(r#""byteOffset": 48"#, r#""byteOffset": 18446744073709551615"#), "reach beyond"),
            (swap(r#""count": 4"#, r#""count": 3"#), "vertex index 3 is out of range: there are 3 vertices"),
            (swap(r#""byteLength": 56"#, r#""byteLength": 57"#), "buffer 0: truncated: 56 bytes of 57"),
            ("{".into(), "no glTF"),
            ("glTF\u{2}\0\0\0\u{3}\0\0\0".into(), "truncated: the header claims 3 bytes, the file has 12"),
        ] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.starts_with("a.gltf: ") && error.contains(part), "{part} in {error}");
        }
    }
}
