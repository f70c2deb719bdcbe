//! Sequences of frames and solids from range maps, by the command, on models of this repository and on the shared scans.
#![cfg(all(feature = "cli", feature = "openvdb"))]

mod common;

use std::path::Path;
use std::time::Duration;

use common::{Ended, shared, vdb_edit};
use glam::DVec3;
use serde_json::Value;
use vdb_edit::mesh::{self, Bvh, TriangleMesh};

const LIMIT: Duration = Duration::from_secs(300);

#[track_caller]
fn done(words: &[&str], folder: &Path) -> Value {
    let ended = vdb_edit(words, folder, LIMIT);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
    ended.json()
}

#[track_caller]
fn fails(words: &[&str], folder: &Path, code: i32, said: &[&str]) {
    let Ended { status, err, .. } = vdb_edit(words, folder, LIMIT);
    assert_eq!(status.code(), Some(code), "{err}");
    assert!(said.iter().all(|word| err.contains(word)), "{said:?} in {err}");
}

fn shapes(folder: &Path) {
    for (name, spec) in [
        ("a.vdb", "sphere radius=0.8"),
        ("b.vdb", "sphere radius=1.5"),
        ("c.vdb", "box size=1.6,1.6,1.6"),
        ("far.vdb", "sphere center=5,0,0 radius=0.8"),
    ] {
        done(&["shape", spec, "-o", name, "--voxel-size", "0.1", "--json"], folder);
    }
}

#[test]
fn frames_of_a_sequence() {
    let desk = tempfile::tempdir().unwrap();
    let folder = desk.path();
    shapes(folder);
    let words =
        ["morph", "a.vdb", "b.vdb", "-o", "out.####.vdb", "--frame-count", "8", "--check", "--plot", "p.png", "--json"];
    let made = done(&words, folder);
    assert_eq!(made["output"], "out.####.vdb");
    let frames = made["frames"].as_array().unwrap();
    assert_eq!(frames.len(), 8);
    for (n, frame) in frames.iter().enumerate() {
        let radius = (frame["volume"].as_f64().unwrap() * 0.75 / std::f64::consts::PI).cbrt();
        assert!((radius - 0.8 - 0.1 * n as f64).abs() < 0.015, "{frame}");
        assert!(folder.join(format!("out.{:04}.vdb", n + 1)).exists());
    }
    assert!(made["end_rms_voxels"][0].as_f64().unwrap() <= 0.02, "{made}");
    assert!(std::fs::metadata(folder.join("p.png")).unwrap().len() > 1000);
    // The ends are the shapes themselves.
    for (frame, shape) in [("out.0001.vdb", "a.vdb"), ("out.0008.vdb", "b.vdb")] {
        assert_eq!(done(&["compare", frame, shape, "--json"], folder)["identical"], true);
    }
    // Frames that are there stay, others come again with the same bits.
    let before = std::fs::read(folder.join("out.0003.vdb")).unwrap();
    std::fs::rename(folder.join("out.0003.vdb"), folder.join("kept.vdb")).unwrap();
    std::fs::write(folder.join("out.0004.vdb"), "mine").unwrap();
    let again = done(&[&words[..], &["--skip-existing"]].concat(), folder);
    let written: Vec<bool> = again["frames"].as_array().unwrap().iter().map(|f| f["written"] == true).collect();
    assert_eq!(written.iter().filter(|w| **w).count(), 1);
    assert!(written[2]);
    assert_eq!(done(&["compare", "out.0003.vdb", "kept.vdb", "--json"], folder)["identical"], true);
    assert_eq!(std::fs::read(folder.join("out.0004.vdb")).unwrap(), b"mine");
    assert!(!before.is_empty());
    // Meshes, pictures, other numbers, a chain.
    let words =
        ["morph", "a.vdb", "c.vdb", "b.vdb", "-o", "m.%03d.ply", "--frame-count", "4", "--frame-start", "7", "--json"];
    assert_eq!(done(&words, folder)["frames"].as_array().unwrap().len(), 4);
    assert!(folder.join("m.007.ply").exists() && folder.join("m.010.ply").exists());
    let words = [
        "morph",
        "a.vdb",
        "c.vdb",
        "-o",
        "p.##.png",
        "--frame-count",
        "2",
        "--preview",
        "all.png",
        "--animation",
        "move.png",
        "--json",
    ];
    done(&words, folder);
    let moving = std::fs::read(folder.join("move.png")).unwrap();
    assert!(moving.windows(4).any(|w| w == b"acTL"));
    assert!(folder.join("p.02.png").exists() && folder.join("all.png").exists());
}

/// A red shape becomes a blue one: half way its vertices are both.
#[test]
fn colours_are_blended() {
    let desk = tempfile::tempdir().unwrap();
    let folder = desk.path();
    for (name, spec, color) in [
        ("red.ply", "sphere radius=0.8", [1.0, 0.0, 0.0, 1.0]),
        ("blue.ply", "box size=1.4,1.4,1.4", [0.0, 0.0, 1.0, 1.0]),
    ] {
        done(&["shape", spec, "-o", name, "--voxel-size", "0.1", "--json"], folder);
        let mut mesh = mesh::read(&folder.join(name)).unwrap().mesh;
        mesh.colors = Some(vec![color; mesh.positions.len()]);
        mesh::write(&folder.join(name), &mesh).unwrap();
    }
    let words =
        ["morph", "red.ply", "blue.ply", "-o", "c.#.ply", "--frame-count", "3", "--voxel-size", "0.1", "--json"];
    done(&words, folder);
    for (n, expected) in [(1, [1.0, 0.0, 0.0]), (2, [0.5, 0.0, 0.5]), (3, [0.0, 0.0, 1.0])] {
        let colors = mesh::read(&folder.join(format!("c.{n}.ply"))).unwrap().mesh.colors.unwrap();
        // Eight bits of sRGB.
        assert!(colors.iter().all(|c| (0..3).all(|k| (c[k] - expected[k]).abs() < 0.01)), "{n}: {:?}", colors[0]);
    }
}

/// Colours go with the transformation under a morph, into vertices and into a grid of vectors.
#[test]
fn colours_are_carried_along() {
    let desk = tempfile::tempdir().unwrap();
    let folder = desk.path();
    for (name, spec, colored) in
        [("a.ply", "box size=1.4,1,0.6", true), ("b.ply", "box center=1,0,0 size=1,1.4,0.6", false)]
    {
        done(&["shape", spec, "-o", name, "--voxel-size", "0.1", "--json"], folder);
        let mut mesh = mesh::read(&folder.join(name)).unwrap().mesh;
        let half = |p: &DVec3| if p.x > 0.0 { [1.0, 0.0, 0.0, 1.0] } else { [0.0, 1.0, 0.0, 1.0] };
        let white = |_: &DVec3| [1.0; 4];
        mesh.colors = Some(mesh.positions.iter().map(|p| if colored { half(p) } else { white(p) }).collect());
        mesh::write(&folder.join(name), &mesh).unwrap();
    }
    let words = ["morph", "a.ply", "b.ply", "--transform", "rotate z,90; translate 1,0,0", "--frame-count", "3"];
    let with = |output: &'static str| [&words[..], &["--voxel-size", "0.1", "-o", output, "--json"]].concat();
    done(&with("c.#.ply"), folder);
    done(&with("c.#.vdb"), folder);
    let middle = mesh::read(&folder.join("c.2.ply")).unwrap().mesh;
    let run = vdb_edit::run::RunOptions::default();
    let file = vdb_edit::vdb::open(folder.join("c.2.vdb"), &run).unwrap();
    let volumes = file.read_vectors(file.select_vector(Some("Cd")).unwrap(), &run).unwrap();
    let mut seen = 0;
    for (p, color) in middle.positions.iter().zip(middle.colors.as_ref().unwrap()) {
        // Half way it has turned by 45 degrees and moved by half.
        let x = ((*p - DVec3::X * 0.5).dot(DVec3::new(1.0, 1.0, 0.0))) / 2f64.sqrt();
        if x.abs() > 0.15 {
            let expected = if x > 0.0 { [1.0, 0.5, 0.5] } else { [0.5, 1.0, 0.5] };
            assert!((0..3).all(|k| (color[k] - expected[k]).abs() < 0.02), "{p} {color:?}");
            let voxel = [0, 1, 2].map(|k| volumes.components[k].trilinear(*p));
            assert!((0..3).all(|k| (voxel[k] - expected[k]).abs() < 0.02), "{p} {voxel:?}");
            seen += 1;
        }
    }
    assert!(seen > 100);
}

#[test]
fn what_cannot_become_what() {
    let desk = tempfile::tempdir().unwrap();
    let folder = desk.path();
    shapes(folder);
    fails(&["morph", "a.vdb", "b.vdb", "-o", "out.vdb"], folder, 2, &["output", "####"]);
    fails(&["morph", "a.vdb", "b.vdb", "-o", "o.####.vdb", "--frame-count", "1"], folder, 2, &["frame_count"]);
    fails(&["morph", "a.vdb", "far.vdb", "-o", "o.####.vdb"], folder, 2, &["do not overlap", "bridge"]);
    fails(&["morph", "a.vdb", "none.vdb", "-o", "o.####.vdb"], folder, 3, &["none.vdb"]);
    fails(&["morph", "a.vdb", "b.vdb", "-o", "o.####.vdb", "--landmarks", "no.txt"], folder, 3, &["no.txt"]);
    fails(&["morph", "a.vdb", "b.vdb", "-o", "o.####.vdb", "--transform", "mirror x"], folder, 2, &["transform"]);
    let words = ["morph", "a.vdb", "far.vdb", "-o", "o.####.vdb", "--bridge", "--frame-count", "5", "--json"];
    let made = done(&words, folder);
    let volumes: Vec<f64> = made["frames"].as_array().unwrap().iter().map(|f| f["volume"].as_f64().unwrap()).collect();
    assert!(volumes.iter().all(|v| (v / volumes[0] - 1.0).abs() < 0.02), "{volumes:?}");
    fails(&["reconstruct", "no.conf", "-o", "o.vdb"], folder, 3, &["no.conf"]);
    std::fs::write(folder.join("a.conf"), "bmesh gone.ply 0 0 0 0 0 0 1\n").unwrap();
    fails(&["reconstruct", "a.conf", "-o", "o.vdb"], folder, 3, &["gone.ply", "skip_missing"]);
    fails(&["reconstruct", "a.vdb", "-o", "o.vdb"], folder, 3, &[".toml"]);
    assert!(!folder.join("o.vdb").exists());
}

/// A greyscale picture of 16 bits, or one of colours.
fn picture(path: &Path, side: u32, depth: png::BitDepth, kind: png::ColorType, bytes: &[u8]) {
    let mut encoder = png::Encoder::new(std::fs::File::create(path).unwrap(), side, side);
    encoder.set_color(kind);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(bytes).unwrap();
}

/// Depth maps with pictures of what they show: a ball whose eighths have colours of their own, in the vertices of a mesh and in a grid of vectors.
#[test]
fn range_maps_with_colours() {
    const SIDE: u32 = 120;
    let desk = tempfile::tempdir().unwrap();
    let folder = desk.path();
    let of_eighth = |p: DVec3| p.to_array().map(|x| if x > 0.0 { 1.0f32 } else { 0.0 });
    let (pitch, first) = (2.4 / f64::from(SIDE - 1), -1.2);
    let mut description = format!(
        "version = 1\nscale = 0.0001\nbackground = \"empty\"\northographic = {{ pitch = [{pitch}, {pitch}], first = [{first}, {first}] }}\n"
    );
    for (n, view) in [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z].into_iter().enumerate() {
        let side = if view.z == 0.0 { DVec3::Z.cross(view) } else { DVec3::X };
        let up = view.cross(side);
        let (mut depths, mut colors) = (Vec::new(), Vec::new());
        for at in 0..SIDE * SIDE {
            let (x, y) = (first + pitch * f64::from(at % SIDE), first + pitch * f64::from(at / SIDE));
            let height = (1.0 - x * x - y * y).sqrt();
            // Nothing was measured where the count is 0.
            let count = if height.is_nan() { 0 } else { ((3.0 - height) * 1e4).round() as u16 };
            depths.extend(count.to_be_bytes());
            colors.extend(of_eighth(side * x + up * y + view * height).map(|c| (255.0 * c) as u8));
        }
        picture(&folder.join(format!("{n}.png")), SIDE, png::BitDepth::Sixteen, png::ColorType::Grayscale, &depths);
        picture(&folder.join(format!("c{n}.png")), SIDE, png::BitDepth::Eight, png::ColorType::Rgb, &colors);
        let row = |k: usize| [side[k], up[k], view[k], 3.0 * view[k]];
        let pose = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
        description += &format!("[[map]]\nfile = \"{n}.png\"\ncolor = \"c{n}.png\"\npose = {pose:?}\n");
    }
    std::fs::write(folder.join("set.toml"), description).unwrap();
    for output in ["ball.ply", "ball.vdb"] {
        let words =
            ["reconstruct", "set.toml", "-o", output, "--voxel-size", "0.05", "--beta", "0", "--check", "--json"];
        assert_eq!(done(&words, folder)["components_after"], 1);
    }
    let ball = mesh::read(&folder.join("ball.ply")).unwrap().mesh;
    let run = vdb_edit::run::RunOptions::default();
    let file = vdb_edit::vdb::open(folder.join("ball.vdb"), &run).unwrap();
    let volumes = file.read_vectors(file.select_vector(Some("Cd")).unwrap(), &run).unwrap();
    let mut eighths = std::collections::BTreeMap::new();
    for (p, color) in ball.positions.iter().zip(ball.colors.as_ref().unwrap()) {
        assert!((p.length() - 1.0).abs() < 0.02, "{p}");
        // Two voxels from where colours meet.
        if p.abs().min_element() > 0.1 {
            let expected = of_eighth(*p);
            let voxel = [0, 1, 2].map(|k| volumes.components[k].trilinear(*p) as f32);
            assert!((0..3).all(|k| (color[k] - expected[k]).abs() < 0.01), "{p} {color:?}");
            assert!((0..3).all(|k| (voxel[k] - expected[k]).abs() < 0.02), "{p} {voxel:?}");
            *eighths.entry(expected.map(|c| c as u8)).or_insert(0) += 1;
        }
    }
    assert!(eighths.len() == 8 && eighths.values().all(|count| *count > 100), "{eighths:?}");
}

/// Mean and 95th percentile of the distance of the vertices of one mesh from another.
fn distances(from: &TriangleMesh, to: &TriangleMesh) -> (f64, f64) {
    let tree = Bvh::new((0..to.triangles.len()).map(|t| to.corners(t)).collect());
    let of = |p: &DVec3| tree.closest_point(*p, f64::INFINITY).unwrap().distance_squared.sqrt();
    let mut all: Vec<f64> = from.positions.iter().step_by(7).map(of).collect();
    all.sort_by(f64::total_cmp);
    (all.iter().sum::<f64>() / all.len() as f64, all[all.len() * 95 / 100])
}

/// The ten scans of the bunny are a closed bunny, near the one that was published.
#[test]
fn the_bunny_of_ten_scans() {
    let (Some(scans), Some(models)) = (shared("range"), shared("meshes")) else { return };
    let desk = tempfile::tempdir().unwrap();
    let folder = desk.path();
    let archive = scans.join("stanford_bunny_range.zip").display().to_string();
    let unpacked = std::process::Command::new("unzip").args(["-qo", &archive]).current_dir(folder).status();
    if !unpacked.is_ok_and(|status| status.success()) {
        eprintln!("SKIPPED: the archive could not be unpacked by `unzip`");
        return;
    }
    let words = ["reconstruct", "bunny/data/bun.conf", "-o", "bunny.ply", "--resolution", "100", "--check", "--json"];
    let made = done(&words, folder);
    assert_eq!(made["components_after"], 1);
    assert_eq!(made["maps"].as_array().unwrap().len(), 10);
    let bunny = mesh::read(&folder.join("bunny.ply")).unwrap().mesh;
    let published = mesh::read(&models.join("bunny_zipper.ply")).unwrap().mesh;
    // In metres; the voxels are 1.6 mm. The way there crosses the holes in the base that nobody scanned.
    let ((there, far), (back, far_back)) = (distances(&bunny, &published), distances(&published, &bunny));
    println!("bunny: {there:.6} {far:.6}; back {back:.6} {far_back:.6}; unseen {}", made["unseen_part"]);
    assert!(there < 0.0008 && back < 0.0005 && far_back < 0.001, "{there} {far} {back} {far_back}");
}
