//! Mesh files of every format, and patches of curved surfaces.
#![no_main]

use file::with_file;
use libfuzzer_sys::fuzz_target;
use vdb_edit::mesh::{self, BezierPatches};

fuzz_target!(|data: &[u8]| {
    with_file(data, &["obj", "ply", "stl", "off", "gltf", "glb", "bpt"], |path, extension| {
        if extension == "bpt" {
            drop(BezierPatches::read(path));
        } else {
            drop(mesh::read(path));
        }
    });
});
