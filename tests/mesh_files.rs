//! Every mesh of the shared test data is read as its manifest describes it, or refused for the reason it was made for.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use vdb_edit::mesh::{self, MeshFormat, TriangleMesh};

/// The shared data, or `None` (said on standard error) where it is not at hand.
fn data() -> Option<PathBuf> {
    let shared = std::env::var_os("VDB_EDIT_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let data = shared.join("data");
    if data.join("MANIFEST.md").is_file() {
        return Some(data);
    }
    eprintln!("skipped: no test data at {}", data.display());
    None
}

fn mesh_files(data: &Path, folder: &str) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(data.join(folder))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| MeshFormat::of(path).is_some())
        .collect();
    files.sort();
    files
}

/// A line of the manifest.
struct Described {
    triangles: usize,
    /// Vertices at different places.
    places: usize,
    bounds: [DVec3; 2],
    volume: Option<f64>,
}

/// The manifest lists what its author's reader made of a file: STL and text readers of other make keep repeated
/// vertices and triangles with a repeated index, whose numbers stand in the remarks.
fn described(manifest: &str, name: &str) -> Option<Described> {
    let row = manifest.lines().find(|line| line.starts_with(&format!("| `{name}`")))?;
    let cells: Vec<_> = row.split('|').map(str::trim).collect();
    let (triangles, vertices) = cells[3].split_once(" / ")?;
    let count = |text: &str| text.replace(',', "").trim().parse::<usize>().ok();
    let remark =
        |what: &str| cells[5].split(',').map(str::trim).find_map(|part| count(part.strip_suffix(what)?)).unwrap_or(0);
    let corner = |text: &str| {
        let numbers: Vec<f64> = text.trim().trim_matches(['[', ']']).split(", ").map(|x| x.parse().unwrap()).collect();
        DVec3::from_slice(&numbers)
    };
    let (low, high) = cells[4].split_once(" .. ")?;
    Some(Described {
        triangles: count(triangles)? - remark(" index-degenerate"),
        places: count(vertices)? - remark(" repeated vertices"),
        bounds: [corner(low), corner(high)],
        volume: cells[5].split(',').find_map(|part| part.trim().strip_prefix("volume ")?.parse().ok()),
    })
}

fn places(mesh: &TriangleMesh) -> usize {
    mesh.positions.iter().map(|p| (*p + DVec3::ZERO).to_array().map(f64::to_bits)).collect::<HashSet<_>>().len()
}

fn volume(mesh: &TriangleMesh) -> f64 {
    (0..mesh.triangles.len())
        .map(|t| {
            let [a, b, c] = mesh.corners(t);
            a.dot(b.cross(c)) / 6.0
        })
        .sum()
}

/// What is wrong with the files that cannot be read.
const REFUSED: [(&str, &str); 7] = [
    ("OutOfMemory.off", "line 2: claims 353535235358 vertices, but the file has 309 bytes"),
    ("empty.ply", "the file is empty"),
    ("empty_zero_faces.ply", "no vertices and no faces"),
    ("fuzz_crash.ply", "header: Line 7: Couldn't parse line"),
    ("invalid.off", "line 7: the face claims 2 corners"),
    ("malformed_bad_index.obj", "indices begin at 1"),
    ("number_formats.obj", "line 11: `3.1+e2` is not a number"),
];

#[test]
fn every_file_reads_as_described_or_is_refused_for_its_fault() {
    let Some(data) = data() else { return };
    let manifest = fs::read_to_string(data.join("MANIFEST.md")).unwrap();
    let mut compared = 0;
    for path in ["meshes", "nasty", "textures"].iter().flat_map(|folder| mesh_files(&data, folder)) {
        let name = path.file_name().unwrap().to_str().unwrap();
        if let Some((_, fault)) = REFUSED.iter().find(|(file, _)| *file == name) {
            let error = mesh::read(&path).expect_err(name);
            assert!(error.to_string().contains(fault), "{error}");
            assert_eq!(error.exit_code(), 3);
            continue;
        }
        let read = mesh::read(&path).unwrap_or_else(|e| panic!("{e}"));
        let mut expected = described(&manifest, name);
        match name {
            // A polygon that runs 234 times around a square: the manifest counts a fan of it all.
            "box_longline.obj" => {
                let expected = expected.as_mut().unwrap();
                (expected.triangles, expected.volume) = (12, None);
            }
            // The manifest gives the triangles of the strips in its last column.
            "tristrips_brain.ply" => {
                assert_eq!((read.mesh.triangles.len(), read.mesh.positions.len()), (36_752, 18_844));
                continue;
            }
            _ => {}
        }
        let expected = expected.unwrap_or_else(|| panic!("{name} is not in the manifest"));
        assert_eq!(read.mesh.triangles.len(), expected.triangles, "{name}: triangles");
        assert_eq!(places(&read.mesh), expected.places, "{name}: vertices");
        // Four digits are listed.
        let (low, high) = read.mesh.bounding_box().unwrap();
        let [low_expected, high_expected] = expected.bounds;
        let largest = low_expected.abs().max(high_expected.abs()).max_element();
        assert!((low - low_expected).abs().max_element() <= 1e-3 * largest, "{name}: {low} {low_expected}");
        assert!((high - high_expected).abs().max_element() <= 1e-3 * largest, "{name}: {high} {high_expected}");
        if let Some(expected) = expected.volume.filter(|v| v.abs() > 1e-12) {
            assert!((volume(&read.mesh) / expected - 1.0).abs() < 1e-3, "{name}: volume {}", volume(&read.mesh));
        }
        compared += 1;
    }
    assert!(compared > 60, "{compared}");
}

#[test]
fn oddities_of_real_files_are_said() {
    let Some(data) = data() else { return };
    for (file, part) in [
        ("meshes/bunny_zipper.ply", "1113 of 35947 vertices are in no face"),
        ("meshes/spot.obj", "295 vertices added where texture coordinates have seams"),
        ("nasty/Spider_binary.stl", "56 polygon(s) with fewer than three different corners skipped"),
        ("nasty/box_longline.obj", "run around the same corners several times, taken once (first: line 24)"),
        ("nasty/malformed_face.obj", "unknown material, ignored (first: `DefaultDoesNotExist`, line 22)"),
        ("nasty/malformed_face.obj", "fewer than three corners skipped (first: line 23)"),
        ("nasty/tristrips_brain.ply", "triangle strips expanded"),
        ("nasty/two_solids.stl", "2 solids merged"),
    ] {
        let warnings = mesh::read(&data.join(file)).unwrap().warnings.join("\n");
        assert!(warnings.contains(part), "{file}: {warnings}");
    }
}

#[test]
fn a_concave_polygon_is_covered_once() {
    let Some(data) = data() else { return };
    let read = mesh::read(&data.join("nasty/concave_polygon.obj")).unwrap();
    assert!(!read.warnings.iter().any(|w| w.contains("cross")), "{:?}", read.warnings);
    let normals: Vec<_> = (0..read.mesh.triangles.len())
        .map(|t| {
            let [a, b, c] = read.mesh.corners(t);
            (b - a).cross(c - a)
        })
        .collect();
    let sum: DVec3 = normals.iter().sum();
    let covered: f64 = normals.iter().map(|n| n.length()).sum();
    assert!((covered - sum.length()).abs() < 1e-9 * covered, "overlapping triangles face both ways");
}

#[test]
fn real_meshes_survive_every_format() {
    let Some(data) = data() else { return };
    let folder = tempfile::tempdir().unwrap();
    for file in ["meshes/spot.obj", "meshes/fertility.off", "nasty/many_small_holes.ply", "nasty/nested_boxes.glb"] {
        let original = mesh::read(&data.join(file)).unwrap().mesh;
        let size = original.bounding_box().map(|(low, high)| (high - low).max_element()).unwrap();
        for format in MeshFormat::ALL {
            let path = folder.path().join("copy").with_extension(format.extension());
            mesh::write(&path, &original).unwrap();
            let copy = mesh::read(&path).unwrap().mesh;
            assert_eq!(copy.triangles.len(), original.triangles.len(), "{file} {format}");
            let exact = matches!(format, MeshFormat::Obj | MeshFormat::Ply | MeshFormat::Off);
            if exact {
                assert_eq!((&copy.positions, &copy.triangles), (&original.positions, &original.triangles));
            }
            for t in 0..copy.triangles.len() {
                for (a, b) in copy.corners(t).iter().zip(original.corners(t)) {
                    assert!((a - b).abs().max_element() <= 1e-6 * size, "{file} {format}: {a} {b}");
                }
            }
            if format != MeshFormat::Stl {
                assert_eq!(copy.colors.is_some(), original.colors.is_some(), "{file} {format}");
                let uvs = |mesh: &TriangleMesh| mesh.uvs.clone().unwrap_or_default().concat();
                assert_eq!(uvs(&copy).len(), uvs(&original).len());
                // 1 − v is rounded on the way to glTF and back.
                assert!(uvs(&copy).iter().zip(uvs(&original)).all(|(a, b)| (a - b).abs() < 1e-6), "{file} {format}");
            }
        }
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), MeshFormat::ALL.len());
}

/// Damaged files are refused or read, and nothing else: cut off anywhere, or some bytes changed.
#[test]
fn damaged_files_neither_crash_nor_hang() {
    let Some(data) = data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let small = mesh::read(&data.join("nasty/crlf_header_binary.ply")).unwrap().mesh;
    let mut random = 1u64;
    let mut next = |below: usize| {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (random >> 33) as usize % below
    };
    let mut refused = 0;
    for format in MeshFormat::ALL {
        let mut original = Vec::new();
        mesh::write_to(&mut original, format, &small).unwrap();
        let path = folder.path().join("damaged").with_extension(format.extension());
        for round in 0..150 {
            let mut damaged = original.clone();
            match round % 2 {
                0 => damaged.truncate(next(original.len())),
                _ => (0..=next(4)).for_each(|_| damaged[next(original.len())] = [0, 0xff, b'9', b'-', b'\n'][next(5)]),
            }
            fs::write(&path, &damaged).unwrap();
            match mesh::read(&path) {
                Ok(read) => {
                    let count = read.mesh.positions.len();
                    assert!(read.mesh.triangles.iter().flatten().all(|&v| (v as usize) < count));
                    assert!(read.mesh.positions.iter().all(|p| p.is_finite()));
                }
                Err(error) => {
                    assert_eq!(error.exit_code(), 3, "{error}");
                    refused += 1;
                }
            }
        }
    }
    assert!(refused > 200, "{refused}");
}
