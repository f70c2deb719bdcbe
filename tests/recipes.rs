//! Recipes as users and farms meet them: what is refused and how, the same bits as commands one by one, keyframes, frames, outputs.
#![cfg(all(feature = "cli", feature = "openvdb"))]

mod common;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use common::{Ended, names, vdb_edit};

/// Longest that one command may take on a loaded machine.
const LIMIT: Duration = Duration::from_secs(120);

/// A folder that recipes are in.
struct Desk(tempfile::TempDir);

impl Desk {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn folder(&self) -> &Path {
        self.0.path()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).unwrap();
    }

    #[track_caller]
    fn run(&self, words: &[&str]) -> Ended {
        vdb_edit(words, self.folder(), LIMIT)
    }

    #[track_caller]
    fn done(&self, words: &[&str]) -> Ended {
        let ended = self.run(words);
        assert_eq!(ended.code(), Some(0), "{words:?}: {}", ended.err);
        ended
    }

    /// Runs `steps` as a recipe `r.toml`.
    #[track_caller]
    fn recipe(&self, steps: &str, words: &[&str]) -> Ended {
        self.write("r.toml", &format!("version = 1\n{steps}"));
        self.run(&[&["run", "r.toml"], words].concat())
    }

    /// Checks that a recipe fails with a code and an error that holds all words, and that nothing was written.
    #[track_caller]
    fn fails(&self, steps: &str, code: i32, words: &[&str]) {
        let before = names(self.folder());
        let ended = self.recipe(steps, &[]);
        assert_eq!(ended.code(), Some(code), "{steps}\n{}", ended.err);
        for word in words {
            assert!(ended.err.contains(word), "`{word}` is not in: {}", ended.err);
        }
        let mut after = names(self.folder());
        after.retain(|name| name != "r.toml" || before.contains(name));
        assert_eq!(before, after, "{steps}");
    }

    #[track_caller]
    fn same(&self, a: &str, b: &str) {
        let compared = self.done(&["compare", a, b, "--json"]).json();
        assert_eq!(compared["identical"], true, "{a} {b}: {compared}");
    }

    #[track_caller]
    fn measure(&self, name: &str) -> Value {
        self.done(&["info", name, "--json"]).json()["grids"][0]["level_set"].clone()
    }
}

const BALL: &str = "[[step]]\nop = \"shape\"\nspec = \"sphere radius=1\"\nvoxel_size = 0.1\nname = \"ball\"\n";
const OUT: &str = "[[step]]\nop = \"write\"\ninput = \"ball\"\npath = \"out.vdb\"\n";

#[test]
fn bad_recipes_are_refused_with_line_and_remedy() {
    let desk = Desk::new();
    let write = |input: &str| format!("[[step]]\nop = \"write\"\ninput = \"{input}\"\npath = \"out.vdb\"\n");
    let smooth =
        |keys: &str| format!("{BALL}[[step]]\nop = \"smooth\"\ninput = \"ball\"\nname = \"s\"\n{keys}\n{}", write("s"));
    // Line 2 is the first after the version; the ball has six lines, the keys of `smooth` begin in line 11.
    for (steps, code, words) in [
        // unknown keys, with line and nearest known key
        (smooth("iteratons = 3"), 2, &["r.toml:11: smooth `s`", "iteratons", "did you mean `iterations`"][..]),
        (smooth("iterations = 3\nregoin = \"sphere radius=1\""), 2, &["r.toml:12:", "did you mean `region`"]),
        (format!("{BALL}{OUT}compresion = \"zip\""), 2, &["r.toml:11: write", "did you mean `compression`"]),
        (format!("stpe = 1\n{BALL}{OUT}"), 2, &["r.toml:2", "did you mean `step`"]),
        ("[[step]]\nop = \"smoth\"\ninput = \"a.obj\"\nname = \"s\"".into(), 2, &["r.toml:3", "did you mean `smooth`"]),
        // wrong types and values
        (smooth("iterations = \"three\""), 2, &["r.toml:11: smooth `s`", "iterations = \"three\""]),
        (smooth("iterations = 2.5"), 2, &["r.toml:11:", "iterations = 2.5", "a whole number from 0"]),
        (smooth("iterations = -3"), 2, &["r.toml:11:", "iterations = -3", "a whole number from 0"]),
        (smooth("time = true"), 2, &["r.toml:11:", "time = true", "a number"]),
        (smooth("preserve_shape = 3"), 2, &["r.toml:11:", "true or false"]),
        (smooth("method = 3"), 2, &["r.toml:11:", "method = 3", "curvature, laplacian"]),
        (smooth("method = \"guassian\""), 2, &["r.toml:11:", "did you mean `gaussian`"]),
        (smooth("method = \"magic\""), 2, &["r.toml:11:", "magic", "laplacian"]),
        (smooth("iterations = 3\ntime = -1.0"), 2, &["r.toml:12:", "either `iterations` or `time`"]),
        (smooth("iterations = 1979-05-27"), 2, &["r.toml:11", "no dates"]),
        (smooth("iterations = nan"), 2, &["r.toml:11", "finite"]),
        (smooth("iterations = { frames = [2, 1], values = [0, 1] }"), 2, &["r.toml:11:", "rising"]),
        (smooth("curvature_low = [0.06, 0.04]"), 2, &["r.toml:11:", "curvature_low"]),
        (smooth("region = \"spher radius=1\""), 2, &["r.toml:11:", "did you mean `sphere`"]),
        (smooth("region = \"mask file=nowhere.vdb\""), 3, &["nowhere.vdb", "r.toml:11:"]),
        (smooth("iterations = \"$n\""), 2, &["r.toml:11:", "`$n` is no variable"]),
        (
            format!("[[step]]\nop = \"shape\"\nspec = \"sphere\"\nname = \"ball\"\n{OUT}"),
            2,
            &["r.toml:4:", "needs `radius=`"],
        ),
        ("step = 3".into(), 2, &["[[step]]"]),
        (format!("set = 3\n{BALL}{OUT}"), 2, &["[set]"]),
        (format!("[set]\nF = 3\n{BALL}{OUT}"), 2, &["r.toml:3", "small letter"]),
        // names
        (BALL.replace("name = \"ball\"\n", ""), 2, &["r.toml:2: shape", "name = nothing"]),
        (format!("{BALL}{BALL}{OUT}"), 2, &["r.toml:7: shape `ball`", "line 2 has it already"]),
        (BALL.replace("\"ball\"", "\"a ball\""), 2, &["r.toml:6", "letters, digits"]),
        (
            format!("{BALL}[[step]]\nop = \"assert\"\ninput = \"bal\"\ncomponents = 1\n"),
            2,
            &["r.toml:9: assert", "did you mean `ball`"],
        ),
        // circular, forward and unused
        (
            format!("[[step]]\nop = \"smooth\"\ninput = \"ball\"\nname = \"ball\"\n{OUT}"),
            2,
            &["r.toml:4: smooth `ball`", "circular"],
        ),
        (format!("{}{BALL}", write("ball")), 2, &["r.toml:4: write", "line 6", "circular"]),
        (BALL.into(), 2, &["r.toml:2: shape `ball`", "nothing uses"]),
        (format!("{BALL}{OUT}{}", BALL.replace("ball", "other")), 2, &["r.toml:11: shape `other`", "nothing uses"]),
        // inputs
        (format!("{BALL}{OUT}input = \"ball\""), 3, &["r.toml", "line 11"]),
        (format!("{BALL}{}", OUT.replace("input = \"ball\"\n", "")), 2, &["r.toml:7: write", "one input"]),
        (
            format!("{BALL}[[step]]\nop = \"csg\"\ninput = \"ball\"\nname = \"u\"\n{}", write("u")),
            2,
            &["r.toml:7: csg `u`", "two inputs"],
        ),
        (format!("{BALL}{}", OUT.replace("\"ball\"", "3")), 2, &["r.toml:9", "a text in quotes"]),
        (
            format!("{BALL}[[step]]\nop = \"csg\"\ninputs = \"ball\"\nname = \"u\"\n{}", write("u")),
            2,
            &["r.toml:9: csg `u`", "a list of names"],
        ),
        (
            format!("[[step]]\nop = \"convert\"\ninput = \"absent.obj\"\nname = \"a\"\n{}", write("a")),
            3,
            &["absent.obj", "r.toml:2: convert `a`"],
        ),
        (
            format!("{BALL}[[step]]\nop = \"convert\"\ninput = \"ball\"\nname = \"a\"\n{}", write("a")),
            2,
            &["a level set already"],
        ),
        // outputs
        (format!("{BALL}{}", OUT.replace("out.vdb", "nowhere/out.vdb")), 4, &["nowhere/out.vdb", "no folder"]),
        (format!("{BALL}{}", OUT.replace("out.vdb", "out.txt")), 2, &["r.toml:10: write", ".obj"]),
        (format!("{BALL}{OUT}{OUT}"), 2, &["r.toml:11: write", "an earlier step writes"]),
        (format!("{BALL}{OUT}quads = true"), 2, &["r.toml:11: write", "quads"]),
        (format!("{BALL}{OUT}").replace("\"write\"", "\"render\""), 2, &["r.toml:10: render", ".png"]),
        // not a recipe at all
        (format!("{BALL}{OUT}name = \n"), 3, &["r.toml", "line 11"]),
        (String::new(), 2, &["[[step]]"]),
    ] {
        desk.fails(&steps, code, words);
    }
    for (text, code, part) in [("", 2, "version = 1"), ("version = 2", 2, "version = 2"), ("version", 3, "line 1")] {
        desk.write("v.toml", text);
        let ended = desk.run(&["run", "v.toml"]);
        assert_eq!(ended.code(), Some(code), "{}", ended.err);
        assert!(ended.err.contains(part), "{}", ended.err);
    }
    assert_eq!(desk.run(&["run", "absent.toml"]).code(), Some(3));
    assert_eq!(desk.run(&["run"]).code(), Some(2));
}

#[test]
fn a_later_failure_leaves_nothing_of_what_was_written_before() {
    let desk = Desk::new();
    desk.write("out.vdb", "old");
    let assert = "[[step]]\nop = \"assert\"\ninput = \"ball\"\ncomponents = 2\nvolume = [4.1, 4.2]\ngenus = [1, 3]\n";
    desk.fails(
        &format!("{BALL}{OUT}{assert}"),
        1,
        &["r.toml:11: assert", "components is 1, not 2", "genus is 0, not within 1 to 3"],
    );
    assert_eq!(std::fs::read(desk.path("out.vdb")).unwrap(), b"old");
    let ended = desk.recipe(
        &format!("{BALL}{OUT}{assert}").replace("components = 2", "components = 1").replace("genus = [1, 3]", ""),
        &["--json"],
    );
    let steps = &ended.json()["frames"][0]["steps"];
    assert_eq!((&steps[2]["op"], &steps[2]["components"]), (&"assert".into(), &1.into()));
    assert!(steps[2]["volume"].as_f64().is_some_and(|v| (4.1..4.2).contains(&v)), "{steps}");
    assert!(steps[1]["bytes"].as_u64().is_some_and(|bytes| bytes > 10_000));
}

/// A session and the same commands one by one: the voxels have the same bits, and what a file carries is carried over.
#[test]
fn the_same_bits_as_commands_one_by_one() {
    let desk = Desk::new();
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets");
    for name in ["spot.obj", "goathead.obj", "three_grids.vdb"] {
        std::fs::copy(assets.join(name), desk.path(name)).unwrap();
    }
    let recipe = r#"
        [[step]]
        op = "convert"
        input = "spot.obj"
        resolution = 70
        name = "body"
        [[step]]
        op = "shape"
        spec = "torus center=0,0.4,0 major=0.5 minor=0.1 axis=z"
        voxel_size = 0.03
        half_width = 1.5
        name = "loop"
        [[step]]
        op = "transform"
        input = "loop"
        rotate = "x,30"
        translate = [0, 0.1, 0]
        name = "turned"
        [[step]]
        op = "csg"
        inputs = ["body", "turned"]
        operation = "union"
        name = "both"
        [[step]]
        op = "smooth"
        input = "both"
        iterations = 3
        region = "sphere center=0,0.5,0 radius=0.6"
        region_not = "sphere center=0,0.5,0 radius=0.2"
        name = "smoothed"
        [[step]]
        op = "csg"
        inputs = ["smoothed", "goathead.obj"]
        operation = "difference"
        name = "cut"
        [[step]]
        op = "smooth"
        input = "three_grids.vdb"
        name = "grid"
        [[step]]
        op = "write"
        input = "cut"
        path = "recipe.vdb"
        [[step]]
        op = "write"
        input = "both"
        path = "both.vdb"
        [[step]]
        op = "write"
        input = "grid"
        path = "grid.vdb"
        [[step]]
        op = "write"
        input = "both"
        path = "both.ply"
        simplify = 0.5
    "#;
    let ended = desk.recipe(recipe, &[]);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
    for command in [
        "convert spot.obj -o 1.vdb --resolution 70",
        "transform 2.vdb -o 3.vdb --rotate x,30 --translate 0,0.1,0",
        "csg union 1.vdb 3.vdb -o 4.vdb",
        "smooth 4.vdb -o 5.vdb --iterations 3 --region REGION --region-not NOT",
        "csg difference 5.vdb goathead.obj -o 6.vdb",
        "smooth three_grids.vdb -o 7.vdb",
        "convert 4.vdb -o 4.ply --simplify 0.5",
    ] {
        if command.starts_with("transform") {
            let spec = "torus center=0,0.4,0 major=0.5 minor=0.1 axis=z";
            desk.done(&["shape", spec, "--voxel-size", "0.03", "--half-width", "1.5", "-o", "2.vdb"]);
        }
        let words: Vec<&str> = command
            .split(' ')
            .map(|word| match word {
                "REGION" => "sphere center=0,0.5,0 radius=0.6",
                "NOT" => "sphere center=0,0.5,0 radius=0.2",
                word => word,
            })
            .collect();
        desk.done(&words);
    }
    for (ours, theirs) in [("recipe.vdb", "6.vdb"), ("both.vdb", "4.vdb"), ("grid.vdb", "7.vdb")] {
        desk.same(ours, theirs);
        let listed = |name: &str| {
            let listing = vdb_edit::vdb::list(desk.path(name)).unwrap();
            listing.grids.iter().map(|g| (g.name.clone(), g.class.clone(), g.active_voxels())).collect::<Vec<_>>()
        };
        assert_eq!(listed(ours), listed(theirs), "{ours}");
    }
    assert_eq!(std::fs::read(desk.path("both.ply")).unwrap(), std::fs::read(desk.path("4.ply")).unwrap());
    assert!(ended.err.contains("was resampled"), "{}", ended.err);
}

#[test]
fn keyframes_frames_and_patterns() {
    let desk = Desk::new();
    let recipe = r#"
        [set]
        radius = { frames = [1, 5], values = [0.5, 0.9] }
        at = [0, 0, 0]
        [[step]]
        op = "shape"
        spec = "sphere radius=$radius center=$at"
        voxel_size = 0.05
        name = "ball"
        [[step]]
        op = "transform"
        input = "ball"
        translate = { frames = [1, 5], values = [[0, 0, 0], [2, 0, 0]] }
        name = "moved"
        [[step]]
        op = "smooth"
        input = "moved"
        iterations = { frames = [1, 5], values = [0, 3] }
        name = "smoothed"
        [[step]]
        op = "write"
        input = "smoothed"
        path = "a.####.vdb"
        [[step]]
        op = "write"
        input = "moved"
        path = "moved.$F2.vdb"
        [[step]]
        op = "render"
        inputs = ["moved", "smoothed"]
        path = "b.%03d.png"
        size = [40, 30]
    "#;
    let ended = desk.recipe(recipe, &["--frames", "1-5x2,2", "--json"]);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
    let frames: Vec<i64> =
        ended.json()["frames"].as_array().unwrap().iter().map(|f| f["frame"].as_i64().unwrap()).collect();
    assert_eq!(frames, [1, 3, 5, 2]);
    for (frame, radius, steps) in [(1, 0.5f64, 0), (2, 0.6, 1), (3, 0.7, 2), (5, 0.9, 3)] {
        let found = desk.done(&["info", &format!("moved.{frame:02}.vdb"), "--json"]).json()["grids"][0].clone();
        let volume = found["level_set"]["volume"].as_f64().unwrap();
        let exact = 4.0 / 3.0 * std::f64::consts::PI * radius.powi(3);
        // 0.61/R² of the exact volume, R in voxels.
        assert!((volume / exact - 1.0).abs() < 0.61 / (radius / 0.05).powi(2) + 1e-3, "{frame}: {volume} {exact}");
        let lowest = found["bbox_world"][0][0].as_f64().unwrap();
        let expected = 0.5 * (f64::from(frame) - 1.0) - radius - 0.15;
        assert!((lowest - expected).abs() <= 0.1, "{frame}: {lowest} {expected}");
        let smoothed =
            desk.done(&["smooth", &format!("moved.{frame:02}.vdb"), "-o", "s.vdb", "--iterations", &steps.to_string()]);
        drop(smoothed);
        desk.same("s.vdb", &format!("a.{frame:04}.vdb"));
        let picture = png_size(&desk.path(&format!("b.{frame:03}.png")));
        assert_eq!(picture, (80, 30));
    }
    // One frame is one call: the third alone has the same bits.
    std::fs::rename(desk.path("a.0003.vdb"), desk.path("third.vdb")).unwrap();
    desk.done(&["run", "r.toml", "--frames", "3"]);
    desk.same("third.vdb", "a.0003.vdb");
    // Files without the frame in their names would replace each other.
    let fixed = recipe.replace("a.####.vdb", "a.vdb");
    let ended = desk.recipe(&fixed, &["--frames", "1-2"]);
    assert_eq!(ended.code(), Some(2));
    assert!(ended.err.contains("`####`, `%04d` or `$F4`"), "{}", ended.err);
    assert_eq!(desk.run(&["run", "r.toml", "--frames", "5-1"]).code(), Some(2));
}

fn png_size(path: &Path) -> (u32, u32) {
    let bytes = std::fs::read(path).unwrap();
    let number = |at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
    (number(16), number(20))
}

#[test]
fn existing_frames_are_skipped_and_folders_chosen() {
    let desk = Desk::new();
    let recipe = format!("{BALL}{}", OUT.replace("out.vdb", "out.####.vdb"));
    std::fs::create_dir(desk.path("elsewhere")).unwrap();
    assert_eq!(desk.recipe(&recipe, &["--frames", "1-2", "-o", "elsewhere"]).code(), Some(0));
    assert_eq!(names(&desk.path("elsewhere")), ["out.0001.vdb", "out.0002.vdb"]);
    desk.write("elsewhere/out.0001.vdb", "kept");
    std::fs::remove_file(desk.path("elsewhere/out.0002.vdb")).unwrap();
    let ended = desk.run(&["run", "r.toml", "--frames", "1-3", "-o", "elsewhere", "--skip-existing", "--json"]);
    let skipped: Vec<bool> =
        ended.json()["frames"].as_array().unwrap().iter().map(|f| f["skipped"].as_bool().unwrap()).collect();
    assert_eq!(skipped, [true, false, false]);
    assert_eq!(std::fs::read(desk.path("elsewhere/out.0001.vdb")).unwrap(), b"kept");
    assert_eq!(names(&desk.path("elsewhere")), ["out.0001.vdb", "out.0002.vdb", "out.0003.vdb"]);
}

#[test]
fn variables_are_set_and_dry_runs_write_nothing() {
    let desk = Desk::new();
    let recipe = format!(
        "[set]\nr = 1\nname = \"out\"\n{}{}",
        BALL.replace("radius=1", "radius=$r"),
        OUT.replace("out.vdb", "$name.vdb")
    );
    let ended = desk.recipe(&recipe, &["--set", "r=0.5", "--set", "name=1-2", "--dry-run", "--json"]).json();
    assert_eq!(ended["frames"][0]["steps"][0]["parameters"]["spec"], "sphere radius=0.5");
    assert_eq!(names(desk.folder()), ["r.toml"]);
    desk.done(&["run", "r.toml", "--set", "r=0.5", "--set", "name=1-2"]);
    let volume = desk.measure("1-2.vdb")["volume"].as_f64().unwrap();
    assert!((volume - 4.0 / 3.0 * std::f64::consts::PI * 0.125).abs() < 0.02, "{volume}");
    for (set, part) in
        [("radius=1", "there are r, name"), ("r=[1,2,3]", "like that of the recipe"), ("r", "NAME=VALUE")]
    {
        let ended = desk.run(&["run", "r.toml", "--set", set]);
        assert_eq!(ended.code(), Some(2), "{}", ended.err);
        assert!(ended.err.contains(part), "{}", ended.err);
    }
}

#[cfg(unix)]
#[test]
fn cancelled_recipes_leave_nothing_behind() {
    let desk = Desk::new();
    let smooth = "[[step]]\nop = \"smooth\"\ninput = \"ball\"\niterations = 100000\nname = \"s\"\n";
    let ball = BALL.replace("voxel_size = 0.1", "voxel_size = 0.01");
    desk.write("r.toml", &format!("version = 1\n{ball}{OUT}{smooth}{}", OUT.replace("ball", "s").replace("out", "s")));
    let mut child = Command::new(env!("CARGO_BIN_EXE_vdb-edit"))
        .args(["run", "r.toml", "--log-format", "json"])
        .current_dir(desk.folder())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // The first file is complete by then, and waits for the rest of the frame.
    let mut lines = BufReader::new(child.stderr.as_mut().unwrap()).lines();
    assert!(lines.any(|line| line.unwrap().contains("evolving")));
    assert!(Command::new("kill").args(["-s", "TERM", &child.id().to_string()]).status().unwrap().success());
    let ended = child.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(143), "{}", String::from_utf8_lossy(&ended.stderr));
    assert_eq!(names(desk.folder()), ["r.toml"]);
}

#[cfg(unix)]
#[test]
fn watching_runs_again_when_a_file_changes() {
    let desk = Desk::new();
    let recipe = |radius: &str| format!("version = 1\n{}{OUT}", BALL.replace("radius=1", radius));
    desk.write("r.toml", &recipe("radius=1"));
    let mut child = Command::new(env!("CARGO_BIN_EXE_vdb-edit"))
        .args(["run", "r.toml", "--watch"])
        .current_dir(desk.folder())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut until = |part: &str| assert!(lines.by_ref().any(|line| line.unwrap().contains(part)), "{part}");
    until("watching");
    let first = std::fs::metadata(desk.path("out.vdb")).unwrap().len();
    // A mistake is said, and does not end it.
    desk.write("r.toml", &recipe("radius=-1"));
    until("watching");
    desk.write("r.toml", &recipe("radius=0.5"));
    until("watching");
    assert!(std::fs::metadata(desk.path("out.vdb")).unwrap().len() < first);
    let began = Instant::now();
    assert!(Command::new("kill").args(["-s", "INT", &child.id().to_string()]).status().unwrap().success());
    let ended = child.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(130));
    assert!(String::from_utf8_lossy(&ended.stderr).contains("positive"));
    assert!(began.elapsed() < Duration::from_secs(10));
}

/// Voxel sizes that keep this test short; the others run as they are.
const COARSER: [(&str, &str); 11] = [
    ("bars", "0.04"),
    ("bust", "2"),
    ("creature", "0.016"),
    ("cube_to_torus", "0.04"),
    ("embossed_teapot", "0.6"),
    ("eye", "1.5"),
    ("jet_to_dart", "0.03"),
    ("offset", "1"),
    ("smoothing_against_opening", "0.08"),
    ("three_heads", "0.08"),
    ("winged_cow", "0.016"),
];

/// Every recipe of the gallery does what its assertions say.
#[test]
fn the_gallery_holds_what_it_asserts() {
    let recipes = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/recipes");
    let desk = Desk::new();
    for file in names(&recipes) {
        let path = recipes.join(&file).display().to_string();
        let mut words = vec!["run", &path, "-o", ".", "--json"];
        let coarser = COARSER.iter().find(|(name, _)| file.strip_suffix(".toml") == Some(name));
        let set = coarser.map(|(_, size)| format!("voxel_size={size}"));
        if let Some(set) = &set {
            words.extend(["--set", set]);
        }
        if file == "superquadrics.toml" {
            words.extend(["--frames", "1,24"]);
        }
        let done = desk.done(&words).json();
        for frame in done["frames"].as_array().unwrap() {
            let steps = frame["steps"].as_array().unwrap();
            assert!(steps.iter().any(|step| step["op"] == "assert"), "{file}");
            for output in frame["outputs"].as_array().unwrap() {
                assert!(desk.path(output.as_str().unwrap()).exists(), "{file}: {output}");
            }
        }
    }
}

/// Two surfaces, one of which is edited; each is written, the edited one drawn.
const EDITED: &str = r#"version = 1
[[step]]
op = "shape"
spec = "union(sphere radius=1, box center=1,0,0 size=1,1,1)"
voxel_size = 0.05
name = "body"
[[step]]
op = "smooth"
input = "body"
iterations = 2
region = ["sphere center=0.6,0.6,0 radius=0.4"]
name = "smoothed"
[[step]]
op = "write"
input = "body"
path = "body.vdb"
[[step]]
op = "write"
input = "smoothed"
path = "smoothed.vdb"
[[step]]
op = "render"
input = "smoothed"
path = "smoothed.png"
size = [320, 240]
"#;

/// Runs a recipe with the results of earlier runs; the operators and names of the steps that ran.
fn rerun(desk: &Desk, text: &str, results: &mut vdb_edit::recipe::Results) -> Vec<String> {
    let recipe = vdb_edit::recipe::Recipe::parse(text, &desk.path("r.toml")).unwrap();
    let run = vdb_edit::run::RunOptions::default();
    let plans = recipe.plan(&[]).unwrap();
    let done = plans[0].rerun(results, &run, &mut |_| {}).unwrap();
    results.forget_unused();
    let shown = |path: &PathBuf| path.file_name().unwrap().to_str().unwrap().to_owned();
    let ran = done.steps.into_iter().filter(|step| !step.kept);
    ran.map(|step| step.output.as_ref().map(shown).or(step.name).unwrap()).collect()
}

#[test]
fn only_steps_that_a_change_affects_run_again() {
    let desk = Desk::new();
    let results = &mut vdb_edit::recipe::Results::default();
    let all = ["body", "smoothed", "body.vdb", "smoothed.vdb", "smoothed.png"];
    let affected = ["smoothed", "smoothed.vdb", "smoothed.png"];
    let none: [&str; 0] = [];
    assert_eq!(rerun(&desk, EDITED, results), all);
    assert_eq!(rerun(&desk, EDITED, results), none);
    let stamp = std::fs::metadata(desk.path("body.vdb")).unwrap().modified().unwrap();
    let more = EDITED.replace("iterations = 2", "iterations = 9");
    assert_eq!(rerun(&desk, &more, results), affected);
    assert_eq!(std::fs::metadata(desk.path("body.vdb")).unwrap().modified().unwrap(), stamp);
    // What was written and drawn is what a run from nothing leaves.
    let fresh = Desk::new();
    assert_eq!(rerun(&fresh, &more, &mut vdb_edit::recipe::Results::default()), all);
    let once = Desk::new();
    once.write("r.toml", &more);
    once.done(&["run", "r.toml"]);
    for file in ["body.vdb", "smoothed.vdb", "smoothed.png"] {
        let [again, fresh, once] = [&desk, &fresh, &once].map(|desk| std::fs::read(desk.path(file)).unwrap());
        assert!(again == once && fresh == once, "{file}");
    }
    // A name says nothing of a result; a file that is gone is written again; what was made before the last run is forgotten.
    assert_eq!(rerun(&desk, &more.replace("\"smoothed\"", "\"other\""), results), none);
    std::fs::remove_file(desk.path("body.vdb")).unwrap();
    assert_eq!(rerun(&desk, &more, results), ["body.vdb"]);
    assert_eq!(rerun(&desk, EDITED, results), affected);
    // Files that are read count by what they are on the disk.
    let of_file = format!(
        "{}{}",
        "version = 1\n[[step]]\nop = \"dilate\"\ninput = \"body.vdb\"\ndistance = 0.1\nname = \"d\"\n",
        "[[step]]\nop = \"write\"\ninput = \"d\"\npath = \"d.vdb\"\n"
    );
    assert_eq!(rerun(&desk, &of_file, results), ["d", "d.vdb"]);
    assert_eq!(rerun(&desk, &of_file, results), none);
    std::fs::copy(desk.path("smoothed.vdb"), desk.path("body.vdb")).unwrap();
    assert_eq!(rerun(&desk, &of_file, results), ["d", "d.vdb"]);
    // A step that fails does not lose what was made before it.
    let failing = format!("{EDITED}[[step]]\nop = \"assert\"\ninput = \"smoothed\"\ncomponents = 7\n");
    let recipe = vdb_edit::recipe::Recipe::parse(&failing, &desk.path("r.toml")).unwrap();
    let run = vdb_edit::run::RunOptions::default();
    assert!(recipe.plan(&[]).unwrap()[0].rerun(results, &run, &mut |_| {}).is_err());
    assert_eq!(rerun(&desk, EDITED, results), ["body.vdb", "smoothed.vdb"]);
}

#[test]
fn of_a_mesh_only_the_leaves_that_an_edit_changed_are_polygonised() {
    let text = format!("{EDITED}[[step]]\nop = \"write\"\ninput = \"smoothed\"\npath = \"smoothed.ply\"\n");
    let more = text.replace("iterations = 2", "iterations = 9");
    let [desk, fresh] = [Desk::new(), Desk::new()];
    let results = &mut vdb_edit::recipe::Results::default();
    let polygonised = |desk: &Desk, text: &str, results: &mut vdb_edit::recipe::Results| {
        let recipe = vdb_edit::recipe::Recipe::parse(text, &desk.path("r.toml")).unwrap();
        let run = vdb_edit::run::RunOptions::default();
        let done = recipe.plan(&[]).unwrap()[0].rerun(results, &run, &mut |_| {}).unwrap();
        results.forget_unused();
        done.steps.last().unwrap().summary.details["leaves_polygonised"].as_u64().unwrap()
    };
    polygonised(&desk, &text, results);
    let part = polygonised(&desk, &more, results);
    let all = polygonised(&fresh, &more, &mut vdb_edit::recipe::Results::default());
    assert!(0 < part && part < all / 2, "{part} of {all}");
    let [again, fresh] = [&desk, &fresh].map(|desk| std::fs::read(desk.path("smoothed.ply")).unwrap());
    assert!(again == fresh);
}

#[test]
fn without_room_steps_run_again_with_the_same_result() {
    let desk = Desk::new();
    let results = &mut vdb_edit::recipe::Results::within(Some(0));
    assert_eq!(rerun(&desk, EDITED, results).len(), 5);
    let before = std::fs::read(desk.path("smoothed.png")).unwrap();
    // Nothing that has no size is lost: what is written stays.
    assert_eq!(rerun(&desk, EDITED, results), ["body", "smoothed"]);
    assert!(std::fs::read(desk.path("smoothed.png")).unwrap() == before);
}
