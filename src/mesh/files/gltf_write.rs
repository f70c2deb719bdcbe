//! Writing glTF 2.0: one mesh of one primitive, with smooth normals.
//!
//! Positions are single precision, as the format demands. Colours are linear, and `v` is turned, as in reading.

use std::collections::BTreeMap;
use std::io::{self, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use glam::{DVec3, Vec3};
use gltf::Semantic;
use gltf::json::validation::{Checked::Valid, USize64};
use gltf::json::{self, Index, accessor, buffer};
use gltf::mesh::Mode;
use rustc_hash::FxHashMap;

use super::TriangleMesh;
use super::unwritable;

/// Writes the binary form.
pub(super) fn write_glb(out: &mut dyn Write, mesh: &TriangleMesh) -> io::Result<()> {
    let (root, bin) = build(mesh)?;
    let json = json::serialize::to_vec(&root)?;
    let total = json.len() as u64 + bin.len() as u64 + 64;
    if u32::try_from(total).is_err() {
        return Err(unwritable(format!("{total} bytes; a .glb holds 4 GiB at most, PLY would work")));
    }
    let header = gltf::binary::Header { magic: *b"glTF", version: 2, length: 0 };
    let glb = gltf::Glb { header, json: json.into(), bin: Some(bin.into()) };
    glb.to_writer(out).map_err(|e| match e {
        gltf::Error::Io(e) => e,
        e => io::Error::other(e.to_string()),
    })
}

/// Writes the text form, its data inside as base64.
pub(super) fn write_gltf(out: &mut dyn Write, mesh: &TriangleMesh) -> io::Result<()> {
    let (mut root, bin) = build(mesh)?;
    for buffer in &mut root.buffers {
        buffer.uri = Some(format!("data:application/octet-stream;base64,{}", BASE64.encode(&bin)));
    }
    json::serialize::to_writer_pretty(out, &root)?;
    Ok(())
}

/// The document and its one buffer.
fn build(mesh: &TriangleMesh) -> io::Result<(json::Root, Vec<u8>)> {
    let mut root = json::Root::default();
    root.asset.generator = Some("vdb-edit".into());
    let mut bin: Vec<u8> = Vec::new();
    let mut add = |bytes: &[u8], count: usize, kind: accessor::Type, data: accessor::ComponentType, bounds: Bounds| {
        let target = if kind == accessor::Type::Scalar {
            buffer::Target::ElementArrayBuffer
        } else {
            buffer::Target::ArrayBuffer
        };
        let view = root.push(buffer::View {
            buffer: Index::new(0),
            byte_length: USize64::from(bytes.len()),
            byte_offset: Some(USize64::from(bin.len())),
            byte_stride: None,
            name: None,
            target: Some(Valid(target)),
            extensions: None,
            extras: Default::default(),
        });
        bin.extend_from_slice(bytes);
        root.push(json::Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64::from(count),
            component_type: Valid(accessor::GenericComponentType(data)),
            type_: Valid(kind),
            min: bounds.map(|b| b.0.to_array().to_vec().into()),
            max: bounds.map(|b| b.1.to_array().to_vec().into()),
            name: None,
            normalized: false,
            sparse: None,
            extensions: None,
            extras: Default::default(),
        })
    };
    let positions = singles(mesh)?;
    let vertices = positions.len();
    let bounds = positions.iter().map(|&p| (p, p)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
    let bytes = |v: &[Vec3]| v.iter().flat_map(|v| v.to_array()).flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let single = accessor::ComponentType::F32;
    let mut attributes = BTreeMap::new();
    let accessor = add(&bytes(&positions), vertices, accessor::Type::Vec3, single, bounds);
    attributes.insert(Valid(Semantic::Positions), accessor);
    let accessor = add(&bytes(&normals(mesh)), vertices, accessor::Type::Vec3, single, None);
    attributes.insert(Valid(Semantic::Normals), accessor);
    if let Some(colors) = &mesh.colors {
        let bytes: Vec<u8> = colors.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
        attributes.insert(Valid(Semantic::Colors(0)), add(&bytes, vertices, accessor::Type::Vec4, single, None));
    }
    if let Some(uvs) = &mesh.uvs {
        let bytes: Vec<u8> = uvs.iter().flat_map(|[u, v]| [*u, 1.0 - v]).flat_map(f32::to_le_bytes).collect();
        attributes.insert(Valid(Semantic::TexCoords(0)), add(&bytes, vertices, accessor::Type::Vec2, single, None));
    }
    let bytes: Vec<u8> = mesh.triangles.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let count = 3 * mesh.triangles.len();
    let indices = add(&bytes, count, accessor::Type::Scalar, accessor::ComponentType::U32, None);
    root.push(json::Buffer {
        byte_length: USize64::from(bin.len()),
        name: None,
        uri: None,
        extensions: None,
        extras: Default::default(),
    });
    // Without a material, viewers show metal (the default of chapter 5.19), which is black without surroundings.
    let material = root.push(json::Material {
        pbr_metallic_roughness: json::material::PbrMetallicRoughness {
            metallic_factor: json::material::StrengthFactor(0.0),
            ..Default::default()
        },
        ..Default::default()
    });
    let mesh = root.push(json::Mesh {
        primitives: vec![json::mesh::Primitive {
            attributes,
            indices: Some(indices),
            material: Some(material),
            mode: Valid(Mode::Triangles),
            targets: None,
            extensions: None,
            extras: Default::default(),
        }],
        weights: None,
        name: None,
        extensions: None,
        extras: Default::default(),
    });
    let node = root.push(json::Node { mesh: Some(mesh), ..Default::default() });
    let scene = root.push(json::Scene { nodes: vec![node], name: None, extensions: None, extras: Default::default() });
    root.scene = Some(scene);
    Ok((root, bin))
}

/// Smallest and largest corner of the positions, which the format demands.
type Bounds = Option<(Vec3, Vec3)>;

/// The positions as the format holds them.
fn singles(mesh: &TriangleMesh) -> io::Result<Vec<Vec3>> {
    let positions: Vec<_> = mesh.positions.iter().map(|p| p.as_vec3()).collect();
    match positions.iter().position(|p| !p.is_finite()) {
        Some(v) => {
            let p = mesh.positions[v];
            Err(unwritable(format!(
                "vertex {v} ({:e}, {:e}, {:e}) is too large for glTF; PLY or OBJ would work",
                p.x, p.y, p.z
            )))
        }
        None => Ok(positions),
    }
}

/// Its own normals, or smooth ones: those of the triangles around a place, weighted by area, so that vertices split at a seam shade alike.
/// Where they cancel, any unit vector: the format allows no other length.
fn normals(mesh: &TriangleMesh) -> Vec<Vec3> {
    if let Some(normals) = &mesh.normals {
        return normals.iter().map(|n| Vec3::from_array(*n).try_normalize().unwrap_or(Vec3::Z)).collect();
    }
    let mut at_place: FxHashMap<[u64; 3], usize> = FxHashMap::default();
    let place: Vec<usize> = (0..mesh.positions.len())
        .map(|v| *at_place.entry(mesh.positions[v].to_array().map(f64::to_bits)).or_insert(v))
        .collect();
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = mesh.corners(t);
        let area = (b - a).cross(c - a);
        triangle.iter().for_each(|&v| sums[place[v as usize]] += area);
    }
    place.into_iter().map(|v| sums[v].try_normalize().unwrap_or(DVec3::Z).as_vec3()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn split_vertices_share_a_normal_and_lone_ones_have_one() {
        // A roof whose ridge x = 0 is split, its right side twice as long, and a vertex without triangles.
        let mesh = TriangleMesh {
            positions: [[0, 0, 1], [0, 1, 1], [-1, 0, 0], [0, 0, 1], [2, 0, -1], [0, 1, 1], [9, 9, 9]]
                .map(|p| DVec3::from_array(p.map(f64::from)))
                .to_vec(),
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            ..Default::default()
        };
        let normals = normals(&mesh);
        // The area vectors are (-1, 0, 1) and (2, 0, 2).
        let ridge = Vec3::new(1.0, 0.0, 3.0).normalize();
        for v in [0, 1, 3, 5] {
            assert!((normals[v] - ridge).length() < 1e-6, "{}", normals[v]);
        }
        assert!((normals[2] - Vec3::new(-1.0, 0.0, 1.0).normalize()).length() < 1e-6);
        assert_eq!(normals[6], Vec3::Z);
    }

    #[test]
    fn the_document_is_valid_and_bounds_its_positions() {
        let mesh = TriangleMesh {
            positions: vec![DVec3::X, DVec3::Y * 2.0, -DVec3::Z],
            triangles: vec![[0, 1, 2]],
            colors: Some(vec![[0.5; 4]; 3]),
            uvs: Some(vec![[0.5; 2]; 3]),
            normals: None,
        };
        let mut glb = Vec::new();
        write_glb(&mut glb, &mesh).unwrap();
        // The crate's own strict validation.
        let document = gltf::Gltf::from_slice(&glb).unwrap();
        let primitive = document.meshes().next().and_then(|mesh| mesh.primitives().next()).unwrap();
        let bounds = primitive.bounding_box();
        assert_eq!((bounds.min, bounds.max), ([0.0, 0.0, -1.0], [1.0, 2.0, 0.0]));
        assert_eq!(primitive.attributes().count(), 4);
    }
}
