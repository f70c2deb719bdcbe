//! The command as users and pipelines meet it: exit codes, messages, JSON, pipes, signals.
#![cfg(all(feature = "cli", feature = "openvdb"))]

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use glam::{DVec3, IVec3};
use serde_json::Value;
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::{GridToWrite, WriteOptions, write};

/// A folder that the command runs in.
struct Desk(tempfile::TempDir);

/// How a command ended.
struct Ended {
    code: i32,
    out: String,
    err: String,
}

impl From<Output> for Ended {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code().expect("ended by itself"),
            out: String::from_utf8_lossy(&output.stdout).into_owned(),
            err: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }
}

impl Ended {
    /// The JSON object on standard output.
    #[track_caller]
    fn json(&self) -> Value {
        assert_eq!(self.code, 0, "{}", self.err);
        serde_json::from_str(&self.out).unwrap_or_else(|e| panic!("{e}: {}", self.out))
    }

    /// Checks exit code, and that the error is one line that holds all of `words`.
    #[track_caller]
    fn fails(&self, code: i32, words: &[&str]) {
        assert_eq!(self.code, code, "{}{}", self.out, self.err);
        let line = self.err.lines().find(|line| line.starts_with("error: ")).unwrap_or_else(|| panic!("{}", self.err));
        for word in words {
            assert!(self.err.contains(word), "`{word}` is not in: {}", self.err);
        }
        assert!(!self.err.contains("stack backtrace") && !self.err.contains("panicked"), "{}", self.err);
        assert!(line.len() > "error: ".len());
    }
}

impl Desk {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn command(&self, words: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_vdb-edit"));
        command.args(words).current_dir(self.0.path()).env("RUST_BACKTRACE", "1").stdin(Stdio::null());
        command
    }

    fn run(&self, words: &[&str]) -> Ended {
        self.command(words).output().unwrap().into()
    }

    #[track_caller]
    fn done(&self, words: &[&str]) -> Ended {
        let ended = self.run(words);
        assert_eq!(ended.code, 0, "{words:?}: {}", ended.err);
        ended
    }

    fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    /// A sphere of radius 1 with 10 voxels a radius, as `name`.
    fn sphere(&self, name: &str) {
        self.write(name, &sphere(0.1));
    }

    fn write(&self, name: &str, level_set: &LevelSet) {
        let grid = GridToWrite { level_set, name: Some("surface"), replaces: None };
        write(self.path(name), &[grid], None, &WriteOptions::default()).unwrap();
    }

    /// A cube as an OBJ file, with one coordinate replaced.
    fn cube(&self, name: &str, coordinate: &str) {
        let mut text = String::new();
        for corner in 0..8 {
            let bit = |b: i32| if corner & b == 0 { "0" } else { "1" };
            let x = if corner == 7 { coordinate } else { bit(1) };
            text += &format!("v {x} {} {}\n", bit(2), bit(4));
        }
        text += "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n";
        std::fs::write(self.path(name), text).unwrap();
    }
}

fn sphere(voxel_size: f64) -> LevelSet {
    let transform = Transform::uniform(voxel_size);
    let reach = IVec3::splat((1.0 / voxel_size) as i32 + 8);
    let distance = |ijk: DVec3| ijk.length() - 1.0 / voxel_size;
    LevelSet::from_distance(transform, 3.0, (-reach, reach), distance, &RunOptions::default()).unwrap()
}

fn shared(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("VDB_EDIT_SHARED").map(PathBuf::from);
    let root = root.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"));
    let path = root.join("data").join(name);
    if !path.exists() {
        eprintln!("skipped: {} is not there", path.display());
    }
    path.exists().then_some(path)
}

const COMMANDS: [&str; 17] = [
    "info",
    "convert",
    "compare",
    "render",
    "completions",
    "man",
    "shape",
    "transform",
    "csg",
    "smooth",
    "offset",
    "dilate",
    "erode",
    "open",
    "close",
    "rebuild",
    "renormalize",
];

#[test]
fn every_command_has_help_and_is_listed() {
    let desk = Desk::new();
    let list = desk.done(&["--help"]).out;
    for command in COMMANDS {
        assert!(list.contains(command), "{command}");
        let help = desk.done(&[command, "--help"]).out;
        assert!(help.contains("Usage:") && help.contains("--threads") && help.contains("--json"), "{command}: {help}");
    }
    assert!(desk.done(&["--version"]).out.starts_with("vdb-edit "));
}

#[test]
fn a_session() {
    let desk = Desk::new();
    let shape =
        desk.done(&["shape", "torus major=1 minor=0.3", "-o", "t.vdb", "--voxel-size", "0.05", "--json"]).json();
    assert_eq!(shape["output"], "t.vdb");
    assert_eq!(shape["components_after"], 1);
    let exact = 2.0 * std::f64::consts::PI.powi(2) * 0.09;
    assert!((shape["volume_after"].as_f64().unwrap() / exact - 1.0).abs() < 0.01, "{shape}");

    desk.done(&["transform", "t.vdb", "-o", "m.vdb", "--translate", "-0.5,0.25,0.1", "--rotate", "x,90"]);
    let union = desk.done(&["csg", "union", "t.vdb", "m.vdb", "-o", "u.vdb", "--check", "--json"]).json();
    let smooth = ["smooth", "u.vdb", "-o", "s.vdb", "--iterations", "3", "--region", "sphere center=-1,0,0 radius=0.8"];
    let smooth = desk.done(&[&smooth[..], &["--preview", "p.png", "--json"]].concat()).json();
    assert_eq!(smooth["steps"], 3);
    assert_eq!(smooth["volume_before"], union["volume_after"]);
    for key in ["seconds", "voxels_changed", "area_before", "area_after"] {
        assert!(smooth[key].is_number(), "{key}: {smooth}");
    }
    assert!(smooth["stopped_because"].is_string() && smooth["warnings"].is_array());
    desk.done(&["convert", "s.vdb", "-o", "s.ply"]);
    desk.done(&["convert", "s.ply", "-o", "s.stl"]);
    desk.done(&["render", "s.vdb", "-o", "s.png", "--size", "64x48"]);
    // A sheet of three, two in a row.
    desk.done(&["render", "s.vdb", "s.ply", "s.stl", "-o", "sheet.png", "--size", "64x48", "--columns", "2"]);
    let sheet = std::fs::read(desk.path("sheet.png")).unwrap();
    assert_eq!(sheet[16..24], [0, 0, 0, 128, 0, 0, 0, 96]);
    desk.done(&["info", "s.vdb", "--check"]);
    for name in ["p.png", "s.png"] {
        assert!(std::fs::read(desk.path(name)).unwrap().starts_with(b"\x89PNG"), "{name}");
    }
}

#[test]
fn operators_say_what_they_need() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    for (words, expected) in [
        (vec!["smoth"], "'smooth'"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--iteratons", "3"], "--iterations"),
        (vec!["smooth", "a.vdb"], "--output"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--iterations", "1.5"], "whole number"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--iterations=-3"], "a whole number from 0 to 4294967295"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--time", "-1"], "time"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--method", "magic"], "laplacian"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--method", "mean", "--width", "9"], "1 to 8"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--width", "1"], "median"),
        (vec!["smooth", "a.vdb", "-o", "b.vdb", "--region", "spere radius=1"], "`sphere`"),
        (vec!["csg", "union", "a.vdb", "-o", "b.vdb"], "2 values"),
        (vec!["csg", "xor", "a.vdb", "a.vdb", "-o", "b.vdb"], "difference"),
        (vec!["offset", "a.vdb", "-o", "b.vdb", "--distance", "--json"], "--distance"),
        (vec!["transform", "a.vdb", "-o", "b.vdb", "--translate", "--json"], "--translate"),
        (vec!["smooth", "a.vdb", "-o", "b.xyz"], ".vdb"),
        (vec!["smooth", "a.vdb", "-o", "-", "--json"], "standard output"),
        (vec!["smooth", "-", "-", "-o", "b.vdb"], "unexpected"),
        (vec!["csg", "union", "-", "-", "-o", "b.vdb"], "once"),
        (vec!["convert", "a.vdb", "-o", "b.vdb", "--memory-limit", "lots"], "2GiB"),
        (vec!["convert", "a.vdb", "-o", "b.vdb", "--threads", "0"], "--threads"),
        (vec!["convert", "a.vdb", "-o", "b.vdb", "--voxel-size", "1", "--resolution", "9"], "cannot be used with"),
        (vec!["render", "a.vdb", "-o", "a.png", "--size", "0x5"], "width"),
        (vec!["render", "a.vdb", "-o", "a.jpg"], ".png"),
        (vec!["render", "a.vdb", "-o", "a.png", "--stripes", "1"], "geodesic"),
        (vec!["compare", "a.vdb", "a.vdb", "--tolerance", "-1"], "0 or more"),
    ] {
        desk.run(&words).fails(2, &[expected]);
    }
    assert_eq!(desk.names(), ["a.vdb"]);
}

#[test]
fn values_may_begin_with_a_minus() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    let moved =
        ["transform", "a.vdb", "-o", "m.vdb", "--translate", "-0.045,0.33,0.9", "--about", "-1,0,0", "--scale", "1"];
    let moved = desk.done(&[&moved[..], &["--json"]].concat()).json();
    let centre = |axis: usize| {
        let bound = |end: usize| moved["bbox_world"][end][axis].as_f64().unwrap();
        (bound(0) + bound(1)) / 2.0
    };
    for (axis, expected) in [-0.045, 0.33, 0.9].into_iter().enumerate() {
        assert!((centre(axis) - expected).abs() < 0.1, "{moved}");
    }
    let eroded = desk.done(&["offset", "a.vdb", "-o", "o.vdb", "--distance", "-2vx", "--json"]).json();
    let radius = (eroded["volume_after"].as_f64().unwrap() * 0.75 / std::f64::consts::PI).cbrt();
    assert!((radius - 0.8).abs() < 0.005, "{radius}");
}

#[test]
fn steps_of_a_transform_keep_their_order() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    let centre_x = |words: &[&str]| {
        let moved = desk.done(&[&["transform", "a.vdb", "-o", "m.vdb", "--json"], words].concat()).json();
        let bound = |end: usize| moved["bbox_world"][end][0].as_f64().unwrap();
        ((bound(0) + bound(1)) / 2.0).round()
    };
    assert_eq!(centre_x(&["--scale", "2", "--translate", "3,0,0"]), 3.0);
    assert_eq!(centre_x(&["--translate", "3,0,0", "--scale", "2"]), 6.0);
    assert_eq!(centre_x(&["--translate", "3,0,0", "--mirror", "x", "--translate", "1,0,0"]), -2.0);
}

#[test]
fn bad_inputs_end_with_3() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    let bytes = std::fs::read(desk.path("a.vdb")).unwrap();
    std::fs::write(desk.path("empty.vdb"), "").unwrap();
    std::fs::write(desk.path("text.vdb"), "hello, this is no volume\n").unwrap();
    std::fs::write(desk.path("cut.vdb"), &bytes[..bytes.len() / 2]).unwrap();
    std::fs::write(desk.path("data.xyz"), "1 2 3\n").unwrap();
    std::fs::write(desk.path("empty.obj"), "").unwrap();
    std::fs::create_dir(desk.path("folder.vdb")).unwrap();
    desk.cube("nan.obj", "nan");
    for (input, expected) in [
        ("missing.vdb", "cannot be opened"),
        ("missing.obj", "cannot be read"),
        ("missing", "cannot be opened"),
        ("data.xyz", ".vdb, .obj"),
        ("empty.vdb", "empty"),
        ("empty.obj", "empty"),
        ("text.vdb", "not a VDB file"),
        ("cut.vdb", "cut.vdb"),
        ("folder.vdb", "directory"),
        ("nan.obj", "nan.obj"),
    ] {
        desk.run(&["smooth", input, "-o", "out.vdb"]).fails(3, &[expected]);
        desk.run(&["info", input]).fails(3, &[expected]);
    }
    desk.run(&["smooth", "a.vdb", "-o", "out.vdb", "--grid", "nose"]).fails(3, &["`nose`", "`surface`"]);
    assert!(!desk.path("out.vdb").exists());
}

#[test]
fn what_is_no_level_set_is_refused_unless_repaired() {
    let desk = Desk::new();
    let mut steep = sphere(0.1);
    steep.grid_mut().update_all(|_, values, mask| {
        for offset in mask.iter() {
            values.0[offset] = (values.0[offset] * 4.0).clamp(-0.299, 0.299);
        }
    });
    desk.write("steep.vdb", &steep);
    let smooth = ["smooth", "steep.vdb", "-o", "out.vdb", "--iterations", "1"];
    desk.run(&smooth).fails(3, &["not a valid level set", "not a distance", "--repair"]);
    let repaired = desk.done(&[&smooth[..], &["--repair", "--check", "--json"]].concat());
    assert!(repaired.err.contains("rebuilt from its surface"), "{}", repaired.err);
    let warnings = repaired.json()["warnings"].to_string();
    assert!(warnings.contains("steep.vdb"), "{warnings}");
    desk.done(&["info", "out.vdb", "--check"]);
    desk.run(&["info", "steep.vdb", "--check"]).fails(1, &["--check", "steep.vdb"]);
    let info = desk.run(&["info", "steep.vdb", "--json"]).json();
    let violation = &info["grids"][0]["level_set"]["violations"][0];
    assert_eq!(violation["kind"], "too_steep", "{info}");
    assert!(violation["count"].as_u64().unwrap() > 0 && violation["example_ijk"].as_array().unwrap().len() == 3);
}

#[test]
fn fog_and_points_are_refused_by_name() {
    for (file, words) in [
        ("vdb/fog_sphere_v223.vdb", ["fog volume", "density"]),
        ("vdb/points_houdini16.vdb", ["points", "ptdataidx32"]),
        ("vdb/box_active_tiles.vdb", ["temperature", "--assume-level-set"]),
        ("vdb/two_levelsets_streamed_unnamed.vdb", ["several level sets", "[1]"]),
    ] {
        let Some(path) = shared(file) else { continue };
        let desk = Desk::new();
        desk.run(&["smooth", path.to_str().unwrap(), "-o", "out.vdb"]).fails(3, &words);
        let info = desk.done(&["info", path.to_str().unwrap(), "--json"]).json();
        assert!(!info["grids"].as_array().unwrap().is_empty());
        assert!(desk.names().is_empty());
    }
}

#[test]
fn volumes_become_level_sets_at_a_value() {
    for (file, voxel_size) in [("vdb/fog_sphere_v223.vdb", 0.2), ("vdb/box_active_tiles.vdb", 1.0)] {
        let Some(path) = shared(file) else { continue };
        let path = path.to_str().unwrap();
        let desk = Desk::new();
        let made = desk.done(&["convert", path, "-o", "out.vdb", "--iso", "0.5", "--check", "--json"]).json();
        assert!((made["voxel_size"].as_f64().unwrap() - voxel_size).abs() < 1e-6);
        assert_eq!(made["components_after"], 1);
        if file.contains("box") {
            // 100 voxels a side hold 1 and the ones beside them 0: the surface is halfway, its edges cut by the polygons.
            assert!((made["volume_after"].as_f64().unwrap() / 1e6 - 1.0).abs() < 1e-3, "{made}");
        }
        let info = desk.done(&["info", "out.vdb", "--json"]).json();
        let classes: Vec<&Value> = info["grids"].as_array().unwrap().iter().map(|grid| &grid["class"]).collect();
        assert_eq!((classes.len(), classes[1]), (2, &Value::from("level set")), "{info}");
        desk.run(&["convert", path, "-o", "x.vdb", "--iso", "-1"]).fails(3, &["larger value"]);
        desk.run(&["convert", path, "-o", "x.vdb", "--iso", "7"]).fails(3, &["no surface"]);
    }
}

#[test]
fn scans_become_level_sets() {
    let desk = Desk::new();
    let mut text =
        String::from("NRRD0004\ntype: float\ndimension: 3\nsizes: 32 32 17\nspacings: 0.5 0.5 1\nencoding: text\n\n");
    for i in 0..32 * 32 * 17 {
        let p =
            DVec3::new(f64::from(i % 32) - 15.5, f64::from(i / 32 % 32) - 15.5, 2.0 * f64::from(i / 1024) - 16.0) * 0.5;
        text += &format!("{:.4} ", 100.0 - 10.0 * p.length());
    }
    std::fs::write(desk.path("scan.nrrd"), &text).unwrap();
    let volume = 4.0 / 3.0 * std::f64::consts::PI * 125.0;
    let found = desk.done(&["convert", "scan.nrrd", "-o", "a.vdb", "--iso", "50", "--check", "--json"]).json();
    assert!((found["volume_after"].as_f64().unwrap() / volume - 1.0).abs() < 0.03, "{found}");
    assert!(found["warnings"][0].as_str().unwrap().contains("resampled"), "{found}");
    assert_eq!(found["voxel_size"], 0.5);
    let segmented =
        desk.done(&["segment", "scan.nrrd", "-o", "b.ply", "--iso", "50", "--smoothness", "0.02", "--json"]).json();
    assert!((segmented["volume_after"].as_f64().unwrap() / volume - 1.0).abs() < 0.03, "{segmented}");
    let hollow = desk.done(&["convert", "scan.nrrd", "-o", "c.vdb", "--iso", "50", "--invert", "--json"]).json();
    assert!(hollow["volume_after"].as_f64().unwrap() > 2.0 * volume);
    let seeded = desk.done(&["segment", "a.vdb", "-o", "d.vdb", "--iso", "0", "--invert", "--json"]);
    assert_eq!(seeded.code, 0);
    desk.run(&["convert", "scan.nrrd", "-o", "e.vdb"]).fails(3, &["--iso", "segment"]);
    desk.run(&["convert", "a.vdb", "-o", "e.vdb", "--iso", "0", "--invert"]).fails(2, &["invert"]);
    desk.run(&["convert", "scan.nrrd", "-o", "e.vdb", "--iso", "500"]).fails(3, &["no voxel holds more"]);
    std::fs::write(desk.path("short.nrrd"), &text[..text.len() / 2]).unwrap();
    desk.run(&["convert", "short.nrrd", "-o", "e.vdb", "--iso", "50"]).fails(3, &["truncated"]);
    desk.run(&["segment", "short.nrrd", "-o", "e.vdb", "--iso", "50"]).fails(3, &["truncated"]);
    desk.run(&["segment", "scan.nrrd", "-o", "e.vdb"]).fails(2, &["iso"]);
}

#[test]
fn solids_combine() {
    let desk = Desk::new();
    let made = |spec: &str| {
        let made = desk.done(&["shape", spec, "-o", "a.vdb", "--voxel-size", "0.02", "--check", "--json"]).json();
        made["volume_after"].as_f64().unwrap()
    };
    let drilled = made("difference(box size=1,1,1, cylinder radius=0.2 height=2)");
    assert!((drilled - (1.0 - std::f64::consts::PI * 0.04)).abs() < 0.01, "{drilled}");
    let (sharp, smooth) = (
        made("union(sphere radius=0.5, sphere center=0.6,0,0 radius=0.4)"),
        made("smooth-union(radius=0.2, sphere radius=0.5, sphere center=0.6,0,0 radius=0.4)"),
    );
    assert!(smooth > 1.01 * sharp, "{smooth} {sharp}");
    desk.run(&["shape", "union(sphere radius=1)", "-o", "b.vdb"]).fails(2, &["two or more"]);
    desk.run(&["shape", "intersection(sphere radius=1, sphere radius=1 center=5,0,0)", "-o", "b.vdb"])
        .fails(2, &["overlap"]);
    assert_eq!(desk.names(), ["a.vdb"]);
}

#[test]
fn impossible_sizes() {
    let desk = Desk::new();
    desk.cube("cube.obj", "1");
    for (words, code, expected) in [
        (["--voxel-size", "0"], 2, "voxel_size"),
        (["--voxel-size", "-1"], 2, "voxel_size"),
        (["--voxel-size", "nan"], 2, "not a length"),
        (["--voxel-size", "3vx"], 2, "world units"),
        (["--resolution", "0"], 2, "resolution"),
        (["--half-width", "0.5"], 2, "half_width"),
        (["--voxel-size", "1e-5"], 5, "memory"),
    ] {
        let all = [&["convert", "cube.obj", "-o", "out.vdb", "--memory-limit", "64MiB"], &words[..]].concat();
        desk.run(&all).fails(code, &[expected]);
    }
    assert_eq!(desk.names(), ["cube.obj"]);
}

#[test]
fn outputs_that_cannot_be_written_end_with_4_before_any_work() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    std::fs::create_dir(desk.path("folder.vdb")).unwrap();
    desk.run(&["smooth", "missing.vdb", "-o", "nowhere/out.vdb"]).fails(4, &["no folder", "nowhere"]);
    desk.run(&["smooth", "missing.vdb", "-o", "folder.vdb"]).fails(4, &["folder"]);
    desk.run(&["render", "missing.vdb", "-o", "nowhere/out.png"]).fails(4, &["no folder"]);
    desk.run(&["smooth", "missing.vdb", "-o", "a.vdb", "--preview", "nowhere/p.png"]).fails(4, &["no folder"]);
    #[cfg(target_os = "linux")]
    desk.run(&["smooth", "a.vdb", "-o", "/dev/full"]).fails(4, &["/dev/full"]);
    assert_eq!(desk.names(), ["a.vdb", "folder.vdb"]);
}

#[test]
fn a_result_may_replace_its_input_and_a_dry_run_replaces_nothing() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    let before = std::fs::read(desk.path("a.vdb")).unwrap();
    let dry = desk.done(&["smooth", "a.vdb", "-o", "a.vdb", "--iterations", "1", "--dry-run", "--json"]).json();
    assert_eq!((&dry["dry_run"], &dry["output"]), (&Value::Bool(true), &Value::from("a.vdb")));
    assert_eq!(dry["parameters"]["iterations"], 1);
    assert_eq!(std::fs::read(desk.path("a.vdb")).unwrap(), before);
    desk.run(&["smooth", "missing.vdb", "-o", "b.vdb", "--dry-run"]).fails(3, &["missing.vdb"]);
    desk.done(&["smooth", "a.vdb", "-o", "a.vdb", "--iterations", "1"]);
    assert_ne!(std::fs::read(desk.path("a.vdb")).unwrap(), before);
    assert_eq!(desk.names(), ["a.vdb"]);
}

#[test]
fn meshes_are_converted_on_the_way_in() {
    let desk = Desk::new();
    desk.cube("cube.obj", "1");
    let cube = desk.done(&["convert", "cube.obj", "-o", "cube.vdb", "--resolution", "20", "--json"]).json();
    assert!((cube["voxel_size"].as_f64().unwrap() - 0.05).abs() < 1e-12);
    // The polygons cut the twelve edges: about h²/2 of each, with corners 1.5 %.
    assert!((cube["volume_after"].as_f64().unwrap() - 1.0).abs() < 0.02, "{cube}");
    assert!(cube["volume_before"].is_null());
    // The voxel size of the .vdb counts for the mesh beside it.
    let union = desk.done(&["csg", "union", "cube.vdb", "cube.obj", "-o", "u.vdb", "--json"]).json();
    assert_eq!((&union["voxels_changed"], &union["warnings"]), (&Value::from(0), &Value::Array(vec![])));
    let same =
        desk.done(&["compare", "cube.obj", "cube.obj", "--resolution", "16", "--tolerance", "0", "--json"]).json();
    assert_eq!(same["identical"], true);
}

#[test]
fn comparisons_have_a_tolerance() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    desk.done(&["offset", "a.vdb", "-o", "b.vdb", "--distance", "0.05"]);
    let found = desk.done(&["compare", "a.vdb", "b.vdb", "--json"]).json();
    assert_eq!(found["identical"], false);
    for (value, expected) in [
        (&found["max_diff_voxels"], 0.5),
        (&found["surface_distance"]["mean"], 0.5),
        (&found["surface_distance"]["max"], 0.5),
        (&found["volume_ratio"], 1.05f64.powi(3)),
        (&found["area_ratio"], 1.05f64.powi(2)),
    ] {
        assert!((value.as_f64().unwrap() - expected).abs() < 0.05, "{found}");
    }
    for key in ["rms_diff_voxels", "active_only_in_a", "active_only_in_b"] {
        assert!(found[key].is_number(), "{key}");
    }
    desk.done(&["compare", "a.vdb", "b.vdb", "--tolerance", "0.6"]);
    desk.run(&["compare", "a.vdb", "b.vdb", "--tolerance", "0.1"]).fails(1, &["tolerance 0.1"]);
}

#[test]
fn info_has_the_promised_shape() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    let info = desk.done(&["info", "a.vdb", "--json"]).json();
    assert_eq!(info["file"], "a.vdb");
    assert!(info["metadata"].is_object());
    let grid = &info["grids"][0];
    assert_eq!(
        (&grid["name"], &grid["type"], &grid["class"]),
        (&"surface".into(), &"float".into(), &"level set".into())
    );
    assert!((grid["voxel_size"].as_f64().unwrap() - 0.1).abs() < 1e-9);
    assert!((grid["half_width"].as_f64().unwrap() - 3.0).abs() < 1e-5);
    for key in ["active_voxels", "leaves", "memory_bytes"] {
        assert!(grid[key].as_u64().unwrap() > 0, "{key}");
    }
    assert!((grid["bbox_world"][1][2].as_f64().unwrap() - 1.3).abs() < 0.11);
    let level_set = &grid["level_set"];
    assert_eq!((&level_set["components"], &level_set["euler"]), (&Value::from(1), &Value::from(2)));
    assert_eq!(level_set["violations"], Value::Array(vec![]));
    let pi = std::f64::consts::PI;
    for (key, truth) in [("area", 4.0 * pi), ("volume", 4.0 / 3.0 * pi), ("mean_curvature_integral", 4.0 * pi)] {
        assert!((level_set[key].as_f64().unwrap() / truth - 1.0).abs() < 0.01, "{key}: {level_set}");
    }
    let both = desk.done(&["info", "a.vdb", "a.vdb", "--json"]).json();
    assert_eq!(both["files"].as_array().unwrap().len(), 2);
}

#[test]
fn other_grids_and_metadata_are_carried_over() {
    let Some(path) = shared("vdb/two_levelsets_streamed_unnamed.vdb") else { return };
    let desk = Desk::new();
    let path = path.to_str().unwrap();
    desk.done(&["erode", path, "-o", "both.vdb", "--grid", "[1]", "--distance", "1vx"]);
    let volumes = |file: &str| -> Vec<f64> {
        let info = desk.done(&["info", file, "--json"]).json();
        let grids = info["grids"].as_array().unwrap().clone();
        grids.iter().map(|grid| grid["level_set"]["volume"].as_f64().unwrap()).collect()
    };
    let (before, after) = (volumes(path), volumes("both.vdb"));
    assert_eq!((before.len(), after.len()), (2, 2));
    assert_eq!(before[0], after[0]);
    assert!(after[1] < before[1] * 0.95);
    desk.done(&["erode", path, "-o", "one.vdb", "--grid", "[1]", "--distance", "1vx", "--only-result"]);
    assert_eq!(volumes("one.vdb").len(), 1);
}

#[test]
fn commands_compose_in_a_pipe() {
    let desk = Desk::new();
    let made = desk.command(&["shape", "sphere radius=1", "-o", "-", "--voxel-size", "0.05"]).output().unwrap();
    assert!(made.status.success());
    let mut dilate = desk
        .command(&["dilate", "-", "-o", "-", "--distance", "0.1", "-q"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = dilate.stdin.take().unwrap();
    let feed = std::thread::spawn(move || stdin.write_all(&made.stdout).unwrap());
    let dilated = dilate.wait_with_output().unwrap();
    feed.join().unwrap();
    assert!(dilated.status.success(), "{}", String::from_utf8_lossy(&dilated.stderr));
    std::fs::write(desk.path("d.vdb"), &dilated.stdout).unwrap();
    let info = desk.done(&["info", "d.vdb", "--json"]).json();
    let volume = info["grids"][0]["level_set"]["volume"].as_f64().unwrap();
    assert!((volume / (4.0 / 3.0 * std::f64::consts::PI * 1.331) - 1.0).abs() < 0.01, "{volume}");
}

#[test]
fn a_closed_pipe_is_no_error() {
    let desk = Desk::new();
    for words in [vec!["--help"], vec!["man", "smooth"], vec!["completions", "zsh"]] {
        let mut child = desk.command(&words).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let ended = child.wait_with_output().unwrap();
        let err = String::from_utf8_lossy(&ended.stderr);
        assert!(ended.status.success() && err.is_empty(), "{words:?}: {:?} {err}", ended.status);
    }
}

#[test]
fn messages_for_programs_are_json_lines() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    let failed = desk.run(&["smooth", "missing.vdb", "-o", "b.vdb", "--log-format", "json"]);
    assert_eq!(failed.code, 3);
    let line: Value = serde_json::from_str(failed.err.trim()).unwrap();
    assert_eq!((&line["level"], &line["exit_code"]), (&"error".into(), &Value::from(3)));
    let usage = desk.run(&["smooth", "--log-format", "json", "--nonsense"]);
    assert_eq!(usage.code, 2);
    let line: Value = serde_json::from_str(usage.err.trim()).unwrap();
    assert!(line["message"].as_str().unwrap().contains("--nonsense"));
    let drawn = desk.done(&["render", "a.vdb", "-o", "a.png", "--size", "160x120", "--log-format", "json", "--quiet"]);
    assert!(drawn.err.is_empty() && drawn.out.is_empty(), "{}{}", drawn.err, drawn.out);
    let drawn = desk.done(&["render", "a.vdb", "-o", "a.png", "--size", "160x120", "--log-format", "json"]);
    let progress: Vec<f64> = drawn
        .err
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap_or_else(|e| panic!("{e}: {line}")))
        .filter_map(|line| line["progress"].as_f64())
        .collect();
    assert_eq!((progress.first(), progress.last()), (Some(&0.0), Some(&1.0)), "{}", drawn.err);
}

#[test]
fn textures_that_cannot_work_are_named() {
    let desk = Desk::new();
    let asset = |name: &str| format!("{}/assets/{name}", env!("CARGO_MANIFEST_DIR"));
    let (spike, shape) = (asset("spike.obj"), ["--voxel-size", "0.04", "-o"]);
    desk.done(&[&["shape", "sphere radius=1"], &shape[..], &["ball.vdb"]].concat());
    desk.done(&[&["shape", "torus major=1 minor=0.3"], &shape[..], &["torus.vdb"]].concat());
    std::fs::write(desk.path("flat.obj"), "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n").unwrap();
    let cube = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\nf 4 3 2 1\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
    std::fs::write(desk.path("open.obj"), cube).unwrap();
    let good = ["-0.3,-0.3,0.9", "0.3,-0.3,0.9", "0.3,0.3,0.9", "-0.3,0.3,0.9"];
    let [a, b, c, d] = good;
    let texture = |base: &str, texture: &str, corners: [&str; 4], more: &[&str]| {
        let words = [&["texture", base, texture, "-o", "out.vdb", "--corners"], &corners[..], more].concat();
        desk.run(&words)
    };
    let refused =
        |corners: [&str; 4], more: &[&str], words: &[&str]| texture("ball.vdb", &spike, corners, more).fails(2, words);
    refused([a, a, c, d], &["--height", "0.2"], &["corners", "1 and 2 coincide"]);
    refused(["-0.3,-0.3,3", b, c, d], &["--height", "0.2"], &["corners", "corner 1", "from the surface"]);
    refused([d, c, b, a], &["--height", "0.2"], &["corners", "clockwise", "the other way round"]);
    refused(good, &["--height", "-2.2"], &["height", "smaller", "through itself"]);
    refused(good, &["--height", "0.2", "--map", "implicit", "--lambda", "11,0.3"], &["lambda", "0", "10"]);
    refused(good, &["--height", "0.2", "--map", "implicit", "--lambda", "-0.1,0.3"], &["lambda", "0", "10"]);
    // All around the hole.
    let around = ["0.7,0.7,0.3", "-0.7,0.7,0.3", "-0.7,-0.7,0.3", "0.7,-0.7,0.3"];
    texture("torus.vdb", &spike, around, &["--height", "0.2"]).fails(2, &["corners", "hole"]);
    // No volume; and an open one, which is closed with a word, or refused.
    texture("ball.vdb", "flat.obj", good, &["--height", "0.2"]).fails(3, &["flat.obj", "encloses no voxel", "closed"]);
    texture("ball.vdb", "open.obj", good, &["--height", "0.2", "--strict"]).fails(3, &["open.obj", "open"]);
    assert_eq!(desk.names(), ["ball.vdb", "flat.obj", "open.obj", "torus.vdb"]);
    let done = texture("ball.vdb", "open.obj", good, &["--height", "0.2", "--write-particles", "net.ply"]);
    assert_eq!(done.code, 0, "{}", done.err);
    assert!(["open.obj", "is open", "close it"].iter().all(|w| done.err.contains(w)), "{}", done.err);
    // The net is drawn.
    let draw =
        |color: &str, path: &str| desk.run(&["render", "ball.vdb", "-o", path, "--color-by", color, "--size", "64x48"]);
    for (color, path) in [("patch:net.ply", "net.png"), ("distortion:net.ply", "distortion.png")] {
        assert_eq!(draw(color, path).code, 0, "{}", draw(color, path).err);
    }
    draw("patch:open.obj", "none.png").fails(3, &["open.obj", "--write-particles"]);
}

#[test]
fn threads_and_instruction_sets_give_the_same_bits() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    for (name, words) in
        [("one.vdb", ["--threads", "1", "--isa", "portable"]), ("two.vdb", ["--threads", "2", "--isa", "auto"])]
    {
        desk.done(&[&["smooth", "a.vdb", "-o", name, "--iterations", "4"], &words[..]].concat());
    }
    assert_eq!(desk.done(&["compare", "one.vdb", "two.vdb", "--json"]).json()["identical"], true);
}

/// The promise is a second; the rest is for a loaded machine to schedule the processes.
#[cfg(unix)]
const PATIENCE: Duration = Duration::from_secs(10);

#[cfg(unix)]
#[test]
fn signals_cancel_and_leave_nothing_behind() {
    let desk = Desk::new();
    desk.write("a.vdb", &sphere(0.01));
    for (signal, code) in [("INT", 130), ("TERM", 143)] {
        let words = ["smooth", "a.vdb", "-o", "out.vdb", "--iterations", "100000", "--log-format", "json"];
        let mut child = desk.command(&words).stderr(Stdio::piped()).spawn().unwrap();
        // The flow's first line of progress says that the work has begun, however busy the machine is.
        let mut lines = BufReader::new(child.stderr.as_mut().unwrap()).lines();
        assert!(lines.any(|line| line.unwrap().contains("evolving")));
        let id = child.id().to_string();
        let began = Instant::now();
        assert!(Command::new("kill").args(["-s", signal, &id]).status().unwrap().success());
        let ended = child.wait_with_output().unwrap();
        assert_eq!(ended.status.code(), Some(code), "{}", String::from_utf8_lossy(&ended.stderr));
        assert!(began.elapsed() < PATIENCE, "{:?}", began.elapsed());
        assert_eq!(desk.names(), ["a.vdb"]);
    }
}

#[test]
fn manual_pages_are_written_into_a_folder() {
    let desk = Desk::new();
    desk.done(&["man", "-o", "pages"]);
    let smooth = std::fs::read_to_string(desk.path("pages/vdb-edit-smooth.1")).unwrap();
    assert!(smooth.contains("iterations"));
    desk.run(&["man", "smoth"]).fails(2, &["`smooth`"]);
}

#[test]
fn info_writes_curvatures_beside_the_level_set() {
    let desk = Desk::new();
    desk.sphere("s.vdb");
    for (kind, exact) in [("mean", 1.0), ("gaussian", 1.0), ("min", 1.0), ("max", 1.0)] {
        let out = format!("{kind}.vdb");
        let found = desk.done(&["info", "s.vdb", "--write-curvature", kind, &out, "--json"]).json();
        let written = &found["curvature"];
        assert_eq!((&written["kind"], &written["output"]), (&kind.into(), &out.clone().into()));
        // On level sets of radius 0.75 to 1.25, where the stencil fits into the band; the principal ones differ from them by up to h.
        let power = if kind == "gaussian" { 2 } else { 1 };
        let (least, most) = (written["min"].as_f64().unwrap(), written["max"].as_f64().unwrap());
        assert!(least > exact / 1.3f64.powi(power) - 0.1 && most < exact / 0.73f64.powi(power) + 0.2, "{found}");
        let listing = vdb_edit::vdb::list(desk.path(&out)).unwrap();
        let grids: Vec<_> = listing.grids.iter().map(|g| (g.name.as_str(), g.class.as_str())).collect();
        assert_eq!(grids, [("surface", "level set"), (format!("{kind}_curvature").as_str(), "unknown")]);
        assert_eq!(listing.grids[1].active_voxels(), written["voxels"].as_u64());
        // The level set beside it is still the one to be edited.
        assert!(desk.done(&["compare", "s.vdb", &out, "--json"]).json()["identical"].as_bool().unwrap());
    }
    desk.run(&["info", "s.vdb", "--write-curvature", "men", "o.vdb"]).fails(2, &["`mean`"]);
    desk.run(&["info", "s.vdb", "--write-curvature", "mean", "o.stl"]).fails(2, &[".vdb", ".ply"]);
    let colored = desk.done(&["info", "s.vdb", "--write-curvature", "gaussian", "o.ply", "--json"]).json();
    // Red and blue are full at balls of 8 voxels, 0.8 world units.
    let full = colored["curvature"]["color_range"][1].as_f64().unwrap();
    assert!((full - 1.0 / 0.64).abs() < 1e-6, "{full}");
    assert!(std::fs::read(desk.path("o.ply")).unwrap().windows(3).any(|w| w == b"red"));
    desk.run(&["info", "s.vdb", "mean.vdb", "--write-curvature", "mean", "o.vdb"]).fails(2, &["one input"]);
    assert!(!desk.path("o.vdb").exists());
}

#[test]
fn geodesic_distances_are_a_grid_or_vertex_colours() {
    let desk = Desk::new();
    desk.sphere("s.vdb");
    let found = desk.done(&["geodesic", "s.vdb", "--from", "0,0,1", "-o", "g.vdb", "--json"]).json();
    // The antipode is π away.
    let farthest = found["farthest"].as_f64().unwrap();
    assert!((farthest / std::f64::consts::PI - 1.0).abs() < 0.03 && found["unreachable_voxels"] == 0, "{found}");
    let listing = vdb_edit::vdb::list(desk.path("g.vdb")).unwrap();
    let grids: Vec<_> = listing.grids.iter().map(|g| (g.name.as_str(), g.class.as_str())).collect();
    assert_eq!(grids, [("surface", "level set"), ("geodesic", "unknown")]);
    // Several points, which may begin with a minus; the nearest counts.
    let both = desk.done(&["geodesic", "s.vdb", "--from", "0,0,1", "-0.0,0,-1", "-o", "g.ply", "--json"]).json();
    assert!((both["farthest"].as_f64().unwrap() / farthest - 0.5).abs() < 0.03, "{both}");
    assert!(std::fs::read(desk.path("g.ply")).unwrap().windows(3).any(|w| w == b"red"));
    desk.run(&["geodesic", "s.vdb", "--from", "0,0,9", "-o", "o.vdb"])
        .fails(2, &["from", "closest point on it is 0,0,1"]);
    desk.run(&["geodesic", "s.vdb", "--from", "0,0,1", "-o", "o.vdb", "--check"]).fails(2, &["check"]);
    assert!(!desk.path("o.vdb").exists());
}

#[test]
fn smooth_csg_and_anisotropic_smoothing_are_reached() {
    let desk = Desk::new();
    desk.sphere("a.vdb");
    desk.done(&["transform", "a.vdb", "--translate", "1.2,0,0", "-o", "b.vdb"]);
    let plain = desk.done(&["csg", "union", "a.vdb", "b.vdb", "-o", "u.vdb", "--json"]).json();
    let smooth = ["csg", "smooth-union", "a.vdb", "b.vdb", "-o", "s.vdb", "--radius", "0.4", "--check", "--json"];
    let smooth = desk.done(&smooth).json();
    assert!(smooth["volume_after"].as_f64().unwrap() > plain["volume_after"].as_f64().unwrap() * 1.005);
    desk.run(&["csg", "smooth-union", "a.vdb", "b.vdb", "-o", "o.vdb"]).fails(2, &["radius"]);
    desk.run(&["csg", "smooth-union", "a.vdb", "b.vdb", "-o", "o.vdb", "--radius", "-1"]).fails(2, &["radius", "-1"]);
    let method =
        ["smooth", "u.vdb", "-o", "f.vdb", "--method", "anisotropic", "--sigma", "1,1.5", "--direction", "add"];
    let filtered = desk.done(&[&method[..], &["--check", "--json"]].concat()).json();
    assert!(filtered["volume_after"].as_f64().unwrap() > filtered["volume_before"].as_f64().unwrap());
    assert_eq!(filtered["filtered_in_half_width"], 4.0);
    desk.run(&["smooth", "u.vdb", "-o", "o.vdb", "--method", "anisotropic", "--sigma", "3,1"]).fails(2, &["sigma"]);
    desk.run(&["smooth", "u.vdb", "-o", "o.vdb", "--sigma", "1,2"]).fails(2, &["sigma", "anisotropic"]);
    desk.run(&["smooth", "u.vdb", "-o", "o.vdb", "--preserve-shape"]).fails(2, &["preserve_shape"]);
    assert!(!desk.path("o.vdb").exists());
}
