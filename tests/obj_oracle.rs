//! Our OBJ reader beside tobj on real files: the same triangles, area and box.

use std::path::{Path, PathBuf};

use vdb_edit::mesh::{TriangleMesh, read};

/// OBJ files without concave polygons, which tobj cuts into fans that overlap.
fn files() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let shared = std::env::var_os("VDB_EDIT_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    let mut files: Vec<PathBuf> = [root.join("assets"), shared.join("data/meshes")]
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|e| e == "obj"))
        .collect();
    files.sort();
    files
}

fn area(mesh: &TriangleMesh) -> f64 {
    let one = |t: usize| {
        let [a, b, c] = mesh.corners(t);
        (b - a).cross(c - a).length() / 2.0
    };
    (0..mesh.triangles.len()).map(one).sum()
}

/// All of tobj's models as one mesh.
fn oracle(path: &Path) -> TriangleMesh {
    let options = tobj::LoadOptions { triangulate: true, single_index: true, ..tobj::LoadOptions::default() };
    let (models, _) = tobj::load_obj(path, &options).unwrap();
    let mut whole = TriangleMesh::default();
    for model in models {
        let first = whole.positions.len() as u32;
        whole
            .positions
            .extend(model.mesh.positions.chunks_exact(3).map(|p| glam::DVec3::from([p[0], p[1], p[2]].map(f64::from))));
        whole.triangles.extend(model.mesh.indices.chunks_exact(3).map(|t| [t[0] + first, t[1] + first, t[2] + first]));
    }
    whole
}

#[test]
fn the_same_surface_as_tobj() {
    let files = files();
    assert!(files.len() >= 4, "assets hold OBJ files");
    for path in files {
        let (ours, theirs) = (read(&path).unwrap().mesh, oracle(&path));
        let name = path.display();
        assert_eq!(ours.triangles.len(), theirs.triangles.len(), "{name}");
        // tobj holds f32, and cuts quadrilaterals that are not flat along the other diagonal.
        assert!((area(&ours) / area(&theirs) - 1.0).abs() < 1e-2, "{name}");
        let ((lo, hi), (lo2, hi2)) = (ours.bounding_box().unwrap(), theirs.bounding_box().unwrap());
        let size = (hi - lo).length();
        assert!((lo - lo2).length() < 1e-5 * size && (hi - hi2).length() < 1e-5 * size, "{name}");
    }
}
