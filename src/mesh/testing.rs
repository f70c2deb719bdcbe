//! Small meshes with known geometry, and a reader of the shared test data, for the unit tests of this module.

use glam::DVec3;

use super::TriangleMesh;

/// An axis-aligned cube with corner `origin`, facing outwards.
pub(crate) fn cube(origin: DVec3, edge: f64) -> TriangleMesh {
    let corner = |i: u32| origin + edge * DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2 & 1) as f64);
    // Each face counter-clockwise seen from outside.
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    TriangleMesh { positions: (0..8).map(corner).collect(), triangles, ..TriangleMesh::default() }
}

/// A unit tetrahedron, facing outwards.
pub(crate) fn tetrahedron() -> TriangleMesh {
    let positions = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
    TriangleMesh { positions, triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], ..TriangleMesh::default() }
}

/// A sphere of `2·rings·rings` quads at most, split into triangles, facing outwards; vertices lie on the sphere.
pub(crate) fn sphere(center: DVec3, radius: f64, rings: u32) -> TriangleMesh {
    let sectors = 2 * rings;
    let mut positions = vec![center + radius * DVec3::Z];
    for j in 1..rings {
        let theta = std::f64::consts::PI * j as f64 / rings as f64;
        for i in 0..sectors {
            let phi = std::f64::consts::TAU * i as f64 / sectors as f64;
            let direction = DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            positions.push(center + radius * direction);
        }
    }
    positions.push(center - radius * DVec3::Z);
    let south = positions.len() as u32 - 1;
    let at = |j: u32, i: u32| 1 + (j - 1) * sectors + i % sectors;
    let mut triangles = Vec::new();
    for i in 0..sectors {
        triangles.push([0, at(1, i), at(1, i + 1)]);
        for j in 1..rings - 1 {
            triangles.push([at(j, i), at(j + 1, i), at(j + 1, i + 1)]);
            triangles.push([at(j, i), at(j + 1, i + 1), at(j, i + 1)]);
        }
        triangles.push([at(rings - 1, i), south, at(rings - 1, i + 1)]);
    }
    TriangleMesh { positions, triangles, ..TriangleMesh::default() }
}

/// Both meshes as one.
pub(crate) fn joined(mut a: TriangleMesh, b: &TriangleMesh) -> TriangleMesh {
    let offset = a.positions.len() as u32;
    a.positions.extend_from_slice(&b.positions);
    a.triangles.extend(b.triangles.iter().map(|t| t.map(|v| v + offset)));
    a
}

/// The same surface seen from the other side.
pub(crate) fn reversed(mut mesh: TriangleMesh) -> TriangleMesh {
    mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    mesh
}

/// A repeatable number in 0..1: tests need variety, not randomness.
pub(crate) fn noise(i: usize) -> f64 {
    let mut x = (i as u64).wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// A file of the shared test data, or `None` (with a message) where that is absent.
pub(crate) fn shared(file: &str) -> Option<std::path::PathBuf> {
    let root = std::env::var_os("VDB_EDIT_SHARED")
        .map_or_else(|| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into(), std::path::PathBuf::from);
    let path = root.join("data").join(file);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED: {} is absent", path.display());
    None
}

/// A mesh of the shared test data, read just well enough for tests of geometry (ASCII OBJ and OFF, binary STL and the
/// plain binary PLY of that collection).
pub(crate) fn shared_mesh(file: &str) -> Option<TriangleMesh> {
    let bytes = std::fs::read(shared(file)?).expect("readable test data");
    Some(match file.rsplit('.').next() {
        Some("obj") => parse_obj(&String::from_utf8_lossy(&bytes)),
        Some("off") => parse_off(&String::from_utf8_lossy(&bytes)),
        Some("ply") => parse_ply(&bytes),
        _ => parse_stl(&bytes),
    })
}

fn parse_obj(text: &str) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for line in text.lines() {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => {
                let xyz: Vec<f64> = words.take(3).map(|w| w.parse().expect("a number")).collect();
                mesh.positions.push(DVec3::from_slice(&xyz));
            }
            Some("f") => {
                let n = mesh.positions.len() as i64;
                let corner = |w: &str| w.split('/').next().and_then(|i| i.parse::<i64>().ok()).expect("an index");
                let polygon: Vec<u32> = words.map(corner).map(|i| if i < 0 { n + i } else { i - 1 } as u32).collect();
                mesh.triangles.extend((2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]));
            }
            _ => {}
        }
    }
    mesh
}

fn parse_off(text: &str) -> TriangleMesh {
    let mut numbers =
        text.lines().filter(|l| !l.starts_with('#') && !l.starts_with("OFF")).flat_map(str::split_whitespace);
    let mut next = || numbers.next().and_then(|w| w.parse::<f64>().ok()).expect("a number");
    let (vertices, faces, _) = (next() as usize, next() as usize, next());
    let mut mesh = TriangleMesh::default();
    mesh.positions.extend((0..vertices).map(|_| DVec3::new(next(), next(), next())));
    for _ in 0..faces {
        let polygon: Vec<u32> = (0..next() as usize).map(|_| next() as u32).collect();
        mesh.triangles.extend((2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]));
    }
    mesh
}

fn parse_stl(bytes: &[u8]) -> TriangleMesh {
    let float = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes")) as f64;
    let mut mesh = TriangleMesh::default();
    for triangle in 0..(bytes.len() - 84) / 50 {
        let base = 84 + triangle * 50 + 12;
        mesh.triangles.push([0, 1, 2].map(|k| 3 * triangle as u32 + k));
        mesh.positions
            .extend((0..3).map(|k| base + 12 * k).map(|at| DVec3::new(float(at), float(at + 4), float(at + 8))));
    }
    mesh
}

fn parse_ply(bytes: &[u8]) -> TriangleMesh {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
    let header = String::from_utf8_lossy(&bytes[..end]);
    let count = |element: &str| -> usize {
        let line = header.lines().find(|l| l.starts_with(&format!("element {element}"))).expect("the element");
        line.rsplit(' ').next().and_then(|w| w.parse().ok()).expect("a count")
    };
    let (vertices, faces) = (count("vertex"), count("face"));
    let big = header.contains("binary_big_endian");
    let word = |at: usize| -> [u8; 4] {
        let mut word: [u8; 4] = bytes[at..at + 4].try_into().expect("4 bytes");
        if big {
            word.reverse();
        }
        word
    };
    let mut mesh = TriangleMesh::default();
    if header.contains("ascii") {
        let body = String::from_utf8_lossy(&bytes[end..]).into_owned();
        let mut lines = body.lines().map(|l| l.split_whitespace().map(|w| w.parse::<f64>().expect("a number")));
        mesh.positions.extend(lines.by_ref().take(vertices).map(|l| DVec3::from_slice(&l.take(3).collect::<Vec<_>>())));
        mesh.triangles.extend(lines.take(faces).map(|l| {
            let f: Vec<u32> = l.map(|w| w as u32).collect();
            [f[1], f[2], f[3]]
        }));
        return mesh;
    }
    let stride = header.lines().filter(|l| l.starts_with("property float")).count() * 4;
    let float = |at: usize| f32::from_le_bytes(word(at)) as f64;
    mesh.positions
        .extend((0..vertices).map(|v| end + v * stride).map(|at| DVec3::new(float(at), float(at + 4), float(at + 8))));
    let faces_at = end + vertices * stride;
    mesh.triangles
        .extend((0..faces).map(|f| [0, 1, 2].map(|k| u32::from_le_bytes(word(faces_at + f * 13 + 1 + 4 * k)))));
    mesh
}
