//! Meshes as the command writes them: quads, fewer triangles, colours that follow, and pictures of components.
#![cfg(all(feature = "cli", feature = "openvdb"))]

use std::path::PathBuf;
use std::process::Command;

use glam::DVec3;
use serde_json::Value;
use vdb_edit::mesh::{self, TriangleMesh, analyze};

/// A folder that the command runs in.
struct Desk(tempfile::TempDir);

impl Desk {
    /// With `ball.vdb`: radius 1, 20 voxels a radius.
    fn new() -> Self {
        let desk = Self(tempfile::tempdir().unwrap());
        desk.done(&["shape", "sphere radius=1", "-o", "ball.vdb", "--voxel-size", "0.05"]);
        desk
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn run(&self, words: &[&str]) -> std::process::Output {
        Command::new(env!("CARGO_BIN_EXE_vdb-edit")).args(words).current_dir(self.0.path()).output().unwrap()
    }

    /// The JSON result of a command that must succeed.
    #[track_caller]
    fn done(&self, words: &[&str]) -> Value {
        let ended = self.run(&[words, &["--json"]].concat());
        assert!(ended.status.success(), "{words:?}: {}", String::from_utf8_lossy(&ended.stderr));
        serde_json::from_slice(&ended.stdout).unwrap()
    }

    #[track_caller]
    fn fails(&self, words: &[&str], code: i32, part: &str) {
        let ended = self.run(words);
        let said = String::from_utf8_lossy(&ended.stderr);
        assert!(ended.status.code() == Some(code) && said.contains(part), "{words:?}: {:?} {said}", ended.status);
    }

    fn mesh(&self, name: &str) -> TriangleMesh {
        mesh::read(&self.path(name)).unwrap().mesh
    }

    /// The ball as a mesh whose colour is its normal, brought into 0..1, and whose texture coordinates are x and y.
    fn painted(&self, name: &str) {
        self.done(&["convert", "ball.vdb", "-o", "plain.ply"]);
        let mut mesh = self.mesh("plain.ply");
        let color = |p: &DVec3| ((*p + 1.0) / 2.0).as_vec3().extend(1.0).to_array();
        mesh.colors = Some(mesh.positions.iter().map(color).collect());
        mesh.uvs = Some(mesh.positions.iter().map(|p| [p.x as f32, p.y as f32]).collect());
        mesh::write(&self.path(name), &mesh).unwrap();
    }
}

fn warnings(result: &Value) -> String {
    result["warnings"].as_array().unwrap().iter().map(|w| w.as_str().unwrap()).collect::<Vec<_>>().join("\n")
}

#[test]
fn quads_are_written_as_quads_where_the_format_has_them() {
    let desk = Desk::new();
    let result = desk.done(&["convert", "ball.vdb", "-o", "q.obj", "--quads"]);
    let text = std::fs::read_to_string(desk.path("q.obj")).unwrap();
    let faces: Vec<usize> =
        text.lines().filter(|l| l.starts_with("f ")).map(|l| l.split_whitespace().count() - 1).collect();
    assert_eq!((result["quads"].as_u64(), warnings(&result)), (Some(faces.len() as u64), String::new()));
    assert!(faces.iter().all(|&corners| corners == 4));
    for (name, warned) in [("q.ply", false), ("q.off", false), ("q.stl", true), ("q.glb", true)] {
        let result = desk.done(&["convert", "ball.vdb", "-o", name, "--quads"]);
        assert_eq!(warnings(&result).contains("each quad was split in two"), warned, "{name}: {result}");
        let mesh = desk.mesh(name);
        assert_eq!(mesh.triangles.len(), 2 * faces.len(), "{name}");
        let topology = analyze(&mesh);
        assert!(name == "q.glb" || topology.closed && topology.euler_characteristic == 2, "{name}: {topology:?}");
        assert!((topology.signed_volume / (4.0 / 3.0 * std::f64::consts::PI) - 1.0).abs() < 5e-3, "{topology:?}");
    }
    // A mesh becomes quads by way of a level set.
    let result = desk.done(&["convert", "q.ply", "-o", "r.obj", "--quads", "--voxel-size", "0.1"]);
    assert!(result["quads"].as_u64().unwrap() > 500);
}

#[test]
fn fewer_triangles_by_ratio_or_by_distance() {
    let desk = Desk::new();
    let full = desk.done(&["convert", "ball.vdb", "-o", "full.ply"])["triangles"].as_f64().unwrap();
    let part = desk.done(&["convert", "ball.vdb", "-o", "part.ply", "--simplify", "0.25"]);
    assert_eq!((part["triangles_before"].as_f64(), warnings(&part)), (Some(full), String::new()));
    assert!((part["triangles"].as_f64().unwrap() / full - 0.25).abs() < 0.01, "{part}");
    let topology = analyze(&desk.mesh("part.ply"));
    assert!(topology.closed && topology.euler_characteristic == 2, "{topology:?}");

    let mut last = full;
    for a in ["0.1", "0.5", "1"] {
        let result = desk.done(&["convert", "ball.vdb", "-o", "a.ply", "--adaptivity", a]);
        let deviation = result["deviation"].as_f64().unwrap();
        assert!(deviation > 0.0 && deviation <= a.parse::<f64>().unwrap() * 0.05, "{result}");
        let triangles = result["triangles"].as_f64().unwrap();
        assert!(triangles < last, "{a}: {triangles} {last}");
        assert!(analyze(&desk.mesh("a.ply")).closed);
        last = triangles;
    }
    desk.done(&["convert", "ball.vdb", "-o", "zero.ply", "--adaptivity", "0"]);
    assert_eq!(std::fs::read(desk.path("zero.ply")).unwrap(), std::fs::read(desk.path("full.ply")).unwrap());

    // From mesh to mesh the attributes go with their vertices.
    desk.painted("painted.ply");
    desk.done(&["convert", "painted.ply", "-o", "less.obj", "--simplify", "0.1"]);
    let mesh = desk.mesh("less.obj");
    assert!(mesh.uvs.unwrap().iter().zip(&mesh.positions).all(|(uv, p)| (f64::from(uv[0]) - p.x).abs() < 1e-6));
}

#[test]
fn options_of_meshes_are_refused_where_they_cannot_work() {
    let desk = Desk::new();
    desk.done(&["convert", "ball.vdb", "-o", "plain.ply"]);
    for ratio in ["0", "1.5", "nan", "half"] {
        desk.fails(&["convert", "ball.vdb", "-o", "a.ply", "--simplify", ratio], 2, "a part above 0, up to 1");
    }
    desk.fails(&["convert", "ball.vdb", "-o", "a.ply", "--adaptivity", "2"], 2, "from 0 to 1");
    desk.fails(&["convert", "ball.vdb", "-o", "a.ply", "--adaptivity", "1", "--quads"], 2, "--quads");
    for words in [&["--quads"][..], &["--simplify", "0.5"], &["--adaptivity", "0.5"]] {
        desk.fails(&[&["convert", "ball.vdb", "-o", "a.vdb"], words].concat(), 2, "an output that is a mesh");
    }
    let from = |out, source| ["convert", "ball.vdb", "-o", out, "--attributes-from", source];
    desk.fails(&from("a.stl", "plain.ply"), 2, "can hold colours");
    desk.fails(&from("a.vdb", "plain.ply"), 2, "can hold colours");
    desk.fails(&from("a.ply", "plain.ply"), 3, "neither colours nor texture coordinates");
    desk.fails(&from("a.ply", "missing.ply"), 3, "missing.ply");
    assert!(!desk.path("a.ply").exists() && !desk.path("a.stl").exists());
}

#[test]
fn attributes_follow_by_closest_point_or_their_loss_is_said() {
    let desk = Desk::new();
    desk.painted("painted.ply");
    let grow = |out| ["dilate", "painted.ply", "-o", out, "--distance", "0.1", "--voxel-size", "0.05"];
    let kept = "painted.ply: its colours and texture coordinates are lost; --attributes-from painted.ply keeps them";
    assert!(warnings(&desk.done(&grow("lost.obj"))).contains(kept));
    assert!(warnings(&desk.done(&grow("lost.vdb"))).contains("are lost: a level set has none"));
    assert!(warnings(&desk.done(&grow("lost.stl"))).contains("are lost: .stl files hold none"));
    let converted = desk.done(&["convert", "painted.ply", "-o", "flat.stl"]);
    assert!(warnings(&converted).contains("are lost: .stl files hold none"), "{converted}");
    assert_eq!(warnings(&desk.done(&["convert", "painted.ply", "-o", "same.glb"])), "");

    for extra in [&["--attributes-from", "painted.ply"][..], &["--attributes-from", "painted.ply", "--check"]] {
        assert_eq!(warnings(&desk.done(&[&grow("kept.ply")[..], extra].concat())), "");
        let mesh = desk.mesh("kept.ply");
        let (colors, uvs) = (mesh.colors.unwrap(), mesh.uvs.unwrap());
        for ((p, color), uv) in mesh.positions.iter().zip(&colors).zip(&uvs) {
            assert!((p.length() - 1.1).abs() < 0.02);
            let truth = (p.normalize() + 1.0) / 2.0;
            // 8 bits of sRGB a channel, and the facets.
            assert!((f64::from(color[0]) - truth.x).abs() < 0.02 && (f64::from(color[2]) - truth.z).abs() < 0.02);
            assert!((f64::from(uv[1]) - p.normalize().y).abs() < 0.02, "{uv:?} {p}");
        }
    }
    let quads = ["convert", "ball.vdb", "-o", "quads.obj", "--quads", "--attributes-from", "painted.ply"];
    assert_eq!(warnings(&desk.done(&quads)), "");
    assert!(desk.mesh("quads.obj").uvs.is_some());
}

#[test]
fn pictures_of_components_of_meshes_and_once_around() {
    let desk = Desk::new();
    desk.done(&["transform", "ball.vdb", "-o", "other.vdb", "--translate", "3,0,0"]);
    desk.done(&["csg", "union", "ball.vdb", "other.vdb", "-o", "two.vdb"]);
    let words = ["render", "two.vdb", "-o", "two.png", "--size", "96x48", "--camera", "0,0", "--color-by", "component"];
    assert_eq!(desk.done(&words)["components"], 2);
    // Two colours, neither of them the clay of what has no number.
    let pixels = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(desk.path("two.png")).unwrap()));
    let mut reader = pixels.read_info().unwrap();
    let mut rgba = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut rgba).unwrap();
    let pixel = |x: usize, y: usize| &rgba[(y * 96 + x) * rgba.len() / (96 * 48)..][..3];
    let hue = |p: &[u8]| (0..3).max_by_key(|&k| p[k]).unwrap();
    assert_ne!(hue(pixel(24, 24)), hue(pixel(72, 24)), "{:?} {:?}", pixel(24, 24), pixel(72, 24));

    desk.done(&["convert", "ball.vdb", "-o", "ball.obj"]);
    let around = ["render", "ball.obj", "-o", "out.png", "--size", "32x24", "--turntable", "3", "--resolution", "20"];
    assert_eq!(desk.done(&around)["outputs"], serde_json::json!(["out.0001.png", "out.0002.png", "out.0003.png"]));
    assert!(desk.path("out.0003.png").exists() && !desk.path("out.png").exists());
}
