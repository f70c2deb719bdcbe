//! Every real file of the shared test data through the command: edited, converted with a warning where it has defects, or
//! refused for the right reason. Never a panic, a hang, or more memory than allowed.
#![cfg(all(feature = "cli", feature = "openvdb"))]

mod common;

use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

use common::{names, shared, vdb_edit};

/// Generous for one file at this resolution, on a slow machine that does other things as well.
const TIME: Duration = Duration::from_secs(90);
const MEMORY_LIMIT: &str = "2GiB";
const RESOLUTION: &str = "64";

/// What a mesh must end in.
enum Mesh {
    /// A level set of this volume to within so many percent, and nothing to say but about materials and texture seams.
    Exact(f64, f64),
    /// A level set, and these words among the warnings.
    Warned(&'static [&'static str]),
    /// Exit code 3, with these words in the message.
    Refused(&'static [&'static str]),
}
use Mesh::{Exact, Refused, Warned};

const OPEN: &str = "the mesh is open";
const UNION: &str = "their union was taken";
const THIN: &str = "thinner than a voxel are lost";
const INSIDE_OUT: &str = "the mesh was inside out";

/// Volumes are the manifest's; coarse voxels round corners off, hence the percents.
const NASTY: &[(&str, Mesh)] = &[
    ("3DSMaxExport.STL", Warned(&["16 edges have more than two triangles"])),
    ("Offset1_degenerate.obj", Warned(&[THIN])),
    ("OutOfMemory.off", Refused(&["line 2", "353535235358 vertices", "309 bytes"])),
    ("Spider_binary.stl", Warned(&["72 boundary edges", "fewer than three different corners"])),
    ("Wuson_inside_out.off", Warned(&[OPEN, INSIDE_OUT])),
    ("beetle_car.obj", Warned(&["296 boundary edges", "47 edges have more than two triangles"])),
    ("boxNotManifold.obj", Warned(&["4 boundary edges"])),
    ("box_longline.obj", Warned(&["run around the same corners several times"])),
    ("bun_zipper_res2.ply", Warned(&[OPEN, "25 of 8171 vertices are in no face", "back to back", "stored twice"])),
    ("bun_zipper_res4.ply", Warned(&[OPEN, "back to back", "stored twice"])),
    ("chair_double_sided.obj", Refused(&["encloses nothing", "back to back", "12756 of 12756"])),
    ("concave_polygon.obj", Refused(&["encloses no voxel", "open"])),
    ("conrod_flipped.stl", Warned(&["disagreed with their neighbours", "3 triangles were stored twice"])),
    ("crlf_header_binary.ply", Exact(1.0, 1.0)),
    ("empty.ply", Refused(&["the file is empty"])),
    ("empty_zero_faces.ply", Refused(&["no vertices and no faces"])),
    ("featuretype_cracks.STL", Warned(&["288 vertices on cracks", "joined"])),
    ("fuzz_crash.ply", Refused(&["header"])),
    ("halftunnel_open.off", Warned(&["96 boundary edges"])),
    ("huge_coordinates.obj", Refused(&["coordinates reach", "3.4", "scale it down"])),
    ("invalid.off", Refused(&["line 7", "claims 2 corners"])),
    ("joined_tetrahedra.obj", Warned(&["2 triangles lay back to back"])),
    ("malformed_bad_index.obj", Refused(&["line 28", "indices begin at 1"])),
    ("malformed_face.obj", Warned(&["fewer than three corners skipped", "line 23", "4 boundary edges"])),
    ("many_small_holes.ply", Warned(&["556 boundary edges"])),
    ("multibody_flipped.stl", Warned(&["2 solids merged", "turned over"])),
    ("negative_indices.obj", Exact(8.0, 1.0)),
    ("nested_boxes.glb", Exact(0.8988, 2.0)),
    ("nested_shell_hollow.obj", Warned(&[THIN])),
    ("nonmanifold_not_convex.obj", Warned(&["12 edges have more than two triangles"])),
    ("number_formats.obj", Refused(&["line 11", "`3.1+e2` is not a number"])),
    ("openscad_nonmanifold.obj", Warned(&["edges have more than two triangles"])),
    ("rabbit_overlapping_parts.obj", Warned(&[UNION])),
    ("self_intersectA.obj", Warned(&[UNION])),
    ("sphereWithHole.stl", Warned(&["9 boundary edges"])),
    ("thingi10k_112932.stl", Exact(2403.0, 3.0)),
    ("thingi10k_79741_butterfly.stl", Exact(2985.0, 3.0)),
    ("triangle_soup.stl", Warned(&["300 boundary edges"])),
    ("tristrips_brain.ply", Warned(&["triangle strips expanded", UNION])),
    ("truck_open_parts.obj", Warned(&[OPEN, "54 edges have more than two triangles"])),
    ("two_solids.stl", Refused(&["encloses no voxel", "6 boundary edges"])),
    ("wallhole_degenerate.obj", Exact(1067.0, 2.0)),
];

const MESHES: &[(&str, Mesh)] = &[
    ("airliner.ply", Exact(32.66, 10.0)),
    ("armadillo_86k.ply", Exact(0.06862, 3.0)),
    ("bumpy_cube.off", Exact(141.0, 1.0)),
    ("bunny_closed.ply", Exact(0.7454, 1.0)),
    ("bunny_zipper.ply", Warned(&["223 boundary edges", "1113 of 35947 vertices are in no face"])),
    ("cow.obj", Warned(&[UNION])),
    ("cumulus_cloud.obj", Exact(5.74e5, 1.0)),
    ("fandisk.obj", Exact(20.24, 2.0)),
    ("fertility.off", Exact(4.322e5, 2.0)),
    ("goathead.obj", Exact(421.7, 2.0)),
    ("hammer.ply", Exact(3.54, 6.0)),
    ("head_open_neck.obj", Warned(&["96 boundary edges"])),
    ("horse_inside_out.ply", Warned(&[INSIDE_OUT])),
    ("human_man.obj", Warned(&[UNION])),
    ("knot.ply", Exact(1.054e6, 2.0)),
    ("max_planck.obj", Exact(5.721e6, 1.0)),
    ("menger_sponge3.ply", Exact(0.4064, 10.0)),
    ("nefertiti_70k.ply", Exact(1.155e7, 1.0)),
    ("rocker_arm.obj", Exact(0.04251, 2.0)),
    ("scorpion_12k.obj", Exact(12.18, 8.0)),
    ("spot.obj", Exact(0.7183, 1.0)),
    ("suzanne.obj", Warned(&["42 boundary edges", "back to back"])),
    ("teapot.bpt", Refused(&["unknown kind", ".obj"])),
    ("teapot_closed.obj", Warned(&[THIN])),
    ("teapot_newell_original.txt", Refused(&["unknown kind", ".obj"])),
    ("teapot_utah.obj", Warned(&["160 boundary edges"])),
    ("torus.obj", Exact(1.219, 1.0)),
];

/// Warnings that are no news about the shape.
const HARMLESS: [&str; 4] =
    ["material", "texture coordinates have seams", "vertices are in no face", "are lost: a level set has none"];

/// All files of a folder, each by its row; every file has one, and every row a file. Two at a time: each uses all threads only
/// part of the time.
fn walk(folder: &str, rows: &[(&str, Mesh)]) {
    let Some(folder) = shared(folder) else { return };
    assert_eq!(names(&folder), rows.iter().map(|row| row.0).collect::<Vec<_>>());
    let out = tempfile::tempdir().unwrap();
    let rows = Mutex::new(rows.iter());
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let Some((name, expected)) = rows.lock().unwrap().next() else { break };
                    one(&folder.join(name), name, expected, out.path());
                }
            });
        }
    });
}

fn one(path: &Path, name: &str, expected: &Mesh, out: &Path) {
    let result = format!("{name}.vdb");
    let path = path.to_str().unwrap();
    let words =
        ["convert", path, "-o", &result, "--resolution", RESOLUTION, "--json", "--memory-limit", MEMORY_LIMIT, "-q"];
    let ended = vdb_edit(&words, out, TIME);
    assert!(ended.peak_bytes < 2 << 30, "{name} used {} bytes", ended.peak_bytes);
    if let Refused(words) = expected {
        assert_eq!(ended.code(), Some(3), "{name}: {}", ended.err);
        assert!(ended.err.contains(name), "{name} is not named: {}", ended.err);
        words.iter().for_each(|w| assert!(ended.err.contains(w), "{name}: no `{w}` in {}", ended.err));
        assert!(!out.join(&result).exists(), "{name} left a result");
        return;
    }
    assert_eq!(ended.code(), Some(0), "{name}: {}", ended.err);
    let json = ended.json();
    let warnings: Vec<&str> = json["warnings"].as_array().unwrap().iter().map(|w| w.as_str().unwrap()).collect();
    match expected {
        Exact(volume, percent) => {
            let news: Vec<_> = warnings.iter().filter(|w| !HARMLESS.iter().any(|h| w.contains(h))).collect();
            assert!(news.is_empty(), "{name}: {news:?}");
            let measured = json["volume_after"].as_f64().unwrap();
            let off = 100.0 * (measured / volume - 1.0).abs();
            assert!(off < *percent, "{name}: volume {measured}, not {volume} ({off:.2} %)");
        }
        Warned(words) => {
            for word in *words {
                assert!(warnings.iter().any(|w| w.contains(word)), "{name}: no `{word}` in {warnings:#?}");
                // Said on standard error as well, quiet or not.
                assert!(ended.err.contains(word), "{name}: no `{word}` in {}", ended.err);
            }
        }
        Refused(_) => unreachable!(),
    }
    let info = vdb_edit(&["info", &result, "--check", "--json"], out, TIME);
    assert_eq!(info.code(), Some(0), "{name}: {}", info.err);
    let level_set = &info.json()["grids"][0]["level_set"];
    assert_eq!(level_set["violations"], serde_json::json!([]), "{name}");
    assert!(level_set["volume"].as_f64().unwrap() > 0.0, "{name}");
}

#[test]
fn every_nasty_mesh_is_converted_warned_of_or_refused() {
    walk("nasty", NASTY);
}

#[test]
fn every_mesh_becomes_a_valid_level_set() {
    walk("meshes", MESHES);
}

/// What a `.vdb` must end in when its level set is edited.
enum Volume {
    /// Exit code 0 with these options, and so many grids in the result.
    Edited(&'static [&'static str], usize),
    /// Exit code 3, with these words in the message.
    Not(&'static [&'static str]),
    /// Not even listed.
    Unreadable(&'static [&'static str]),
}
use Volume::{Edited, Not, Unreadable};

const VOLUMES: &[(&str, Volume)] = &[
    (
        "blender_fluid_0152.vdb",
        Not(&["no level set", "`density` (fog volume, float)", "`velocity` (staggered, vec3s)"]),
    ),
    ("box_active_tiles.vdb", Not(&["`temperature`", "class", "never set", "--assume-level-set"])),
    ("empty_tree.vdb", Not(&["`density`", "never set", "--assume-level-set"])),
    ("fog_rotated_anisotropic.vdb", Not(&["`density` is a fog volume", "--iso"])),
    ("fog_sphere_v223.vdb", Not(&["`density` is a fog volume", "--iso"])),
    ("ls_sphere_translated.vdb", Edited(&[], 1)),
    ("ls_sphere_v222_half.vdb", Edited(&[], 1)),
    ("not_a_vdb_lfs_pointer.vdb", Unreadable(&["Git LFS pointer", "git lfs pull"])),
    ("not_a_vdb_symlink_text.vdb", Unreadable(&["not a VDB file", "symbolic link"])),
    ("points_houdini16.vdb", Not(&["`points`", "ptdataidx32", "float or double"])),
    ("smoke_v222_half.vdb", Not(&["`density` is a fog volume", "--iso"])),
    ("three_grids_same_name.vdb", Not(&["`density[0]`", "`density[1]`", "`density[2]`", "fog volume"])),
    ("two_levelsets_streamed_unnamed.vdb", Edited(&["--grid", "[1]"], 2)),
    ("velocity_vec3s.vdb", Not(&["`vel`", "vec3s", "float or double"])),
];

#[test]
fn every_vdb_is_edited_or_refused_for_the_right_reason() {
    let Some(folder) = shared("vdb") else { return };
    assert_eq!(names(&folder), VOLUMES.iter().map(|row| row.0).collect::<Vec<_>>());
    let out = tempfile::tempdir().unwrap();
    for (name, expected) in VOLUMES {
        let path = folder.join(name);
        let path = path.to_str().unwrap();
        let mut words = vec!["offset", path, "-o", name, "--distance", "1vx", "--memory-limit", MEMORY_LIMIT];
        words.extend(["--json", "--check", "-q"]);
        if let Edited(options, _) = expected {
            words.extend(*options);
        }
        let ended = vdb_edit(&words, out.path(), TIME);
        assert!(ended.peak_bytes < 2 << 30, "{name} used {} bytes", ended.peak_bytes);
        let listed = vdb_edit(&["info", path, "--json", "--memory-limit", MEMORY_LIMIT], out.path(), TIME);
        match expected {
            Edited(_, grids) => {
                assert_eq!(ended.code(), Some(0), "{name}: {}", ended.err);
                let json = ended.json();
                // One voxel outwards: the volume grows by the area times it, and a bit.
                let of = |key: &str| json[key].as_f64().unwrap();
                let grown = (of("volume_after") - of("volume_before")) / (of("area_before") * of("voxel_size"));
                assert!((1.0..1.2).contains(&grown), "{name}: {grown}");
                let info = vdb_edit(&["info", name, "--check", "--json"], out.path(), TIME);
                assert_eq!(info.code(), Some(0), "{name}: {}", info.err);
                assert_eq!(info.json()["grids"].as_array().unwrap().len(), *grids, "{name}");
            }
            Not(words) | Unreadable(words) => {
                assert_eq!(ended.code(), Some(3), "{name}: {}", ended.err);
                words.iter().for_each(|w| assert!(ended.err.contains(w), "{name}: no `{w}` in {}", ended.err));
                assert!(!out.path().join(name).exists(), "{name} left a result");
                let code = if matches!(expected, Unreadable(_)) { 3 } else { 0 };
                assert_eq!(listed.code(), Some(code), "{name}: {}", listed.err);
            }
        }
    }
}
