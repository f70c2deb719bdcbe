//! Small meshes with known geometry, and a reader of the shared test data, for the unit tests of this module.

use std::collections::HashMap;

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

/// Asserts that every edge joins two triangles in opposite directions and that the triangles around every vertex
/// form one ring, that no triangle is degenerate, and returns V − E + F.
pub(crate) fn assert_manifold(mesh: &TriangleMesh) -> i64 {
    let mut sides = HashMap::new();
    let mut around = vec![Vec::new(); mesh.positions.len()];
    for (t, &[a, b, c]) in mesh.triangles.iter().enumerate() {
        for (from, to, apex) in [(a, b, c), (b, c, a), (c, a, b)] {
            assert!(sides.insert((from, to), apex).is_none(), "edge {from}-{to} is used twice in one direction");
            around[from as usize].push((to, apex));
        }
        let [p, q, r] = mesh.corners(t);
        assert!((q - p).cross(r - p).length() > 0.0, "triangle {t} has no area");
    }
    assert!(sides.keys().all(|&(from, to)| sides.contains_key(&(to, from))), "open edge");
    for (v, fan) in around.iter().enumerate() {
        let next: HashMap<u32, u32> = fan.iter().copied().collect();
        let start = fan.first().unwrap_or_else(|| panic!("vertex {v} is not used")).0;
        let (mut at, mut steps) = (next[&start], 1);
        while at != start {
            at = next[&at];
            steps += 1;
        }
        assert_eq!(steps, fan.len(), "vertex {v} joins several sheets");
    }
    mesh.positions.len() as i64 - sides.len() as i64 / 2 + mesh.triangles.len() as i64
}

/// Area and volume, by the textbook.
pub(crate) fn area_and_volume(mesh: &TriangleMesh) -> (f64, f64) {
    (0..mesh.triangles.len()).map(|t| mesh.corners(t)).fold((0.0, 0.0), |(area, volume), [a, b, c]| {
        (area + (b - a).cross(c - a).length() / 2.0, volume + a.dot(b.cross(c)) / 6.0)
    })
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

/// A mesh of the shared test data.
pub(crate) fn shared_mesh(file: &str) -> Option<TriangleMesh> {
    Some(super::read(&shared(file)?).expect("a readable mesh").mesh)
}
