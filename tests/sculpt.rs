//! `emboss`, `warp`, `sweep` and `advect` as a user runs them.
#![cfg(all(feature = "cli", feature = "openvdb"))]

mod common;

use std::path::Path;
use std::time::Duration;

use common::{Ended, shared, vdb_edit};

const LIMIT: Duration = Duration::from_secs(120);

fn run(folder: &Path, words: &[&str]) -> Ended {
    vdb_edit(words, folder, LIMIT)
}

/// The middle of the world-space box of what a command wrote.
fn middle(result: &Ended) -> [f64; 3] {
    let bounds = result.json()["bbox_world"].clone();
    [0, 1, 2].map(|axis| (bounds[0][axis].as_f64().unwrap() + bounds[1][axis].as_f64().unwrap()) / 2.0)
}

#[test]
fn a_grid_of_vectors_carries_a_ball_along() {
    let Some(volumes) = shared("vdb") else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    assert_eq!(
        run(at, &["shape", "sphere center=2,3,2 radius=0.5", "--voxel-size", "0.03", "-o", "ball.vdb"]).code(),
        Some(0)
    );
    let velocity = volumes.join("velocity_vec3s.vdb");
    let velocity = velocity.to_str().unwrap();
    // The velocity is 0, −15, 0 in a box from 0 to 4.
    let moved = run(at, &["advect", "ball.vdb", "--velocity", velocity, "--time", "0.06", "-o", "moved.vdb", "--json"]);
    let [x, y, z] = middle(&moved);
    assert!((x - 2.0).abs() < 0.02 && (y - 2.1).abs() < 0.02 && (z - 2.0).abs() < 0.02, "{x} {y} {z}");
    let json = moved.json();
    let ratio = json["volume_after"].as_f64().unwrap() / json["volume_before"].as_f64().unwrap();
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    // A file without vectors, and none at all.
    for (file, code) in [("ball.vdb", 3), ("absent.vdb", 3)] {
        let refused = run(at, &["advect", "ball.vdb", "--velocity", file, "-o", "none.vdb"]);
        assert_eq!(refused.code(), Some(code), "{}", refused.err);
        assert!(!at.join("none.vdb").exists());
    }
}

#[test]
fn sweeping_and_warping_follow_their_options() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    assert_eq!(run(at, &["shape", "sphere radius=0.5", "--voxel-size", "0.05", "-o", "ball.vdb"]).code(), Some(0));
    let swept = run(
        at,
        &["sweep", "ball.vdb", "--through", "0,0,0", "--through", "2,0,0", "-o", "rod.vdb", "--json", "--check"],
    );
    let volume = swept.json()["volume_after"].as_f64().unwrap();
    let exact = std::f64::consts::PI * (0.25 * 2.0 + 0.125 * 4.0 / 3.0);
    assert!((volume / exact - 1.0).abs() < 0.01, "{volume} {exact}");
    let warped = run(
        at,
        &[
            "warp",
            "ball.vdb",
            "--handle",
            "0,0,0.5:0,0,0.8",
            "--fixed",
            "0,0,-0.5",
            "-o",
            "drop.vdb",
            "--json",
            "--check",
        ],
    );
    assert!((middle(&warped)[2] - 0.15).abs() < 0.05);
}

#[test]
fn stamps_that_cannot_be_read_leave_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    assert_eq!(run(at, &["shape", "box size=4,4,1", "--voxel-size", "0.05", "-o", "plate.vdb"]).code(), Some(0));
    std::fs::write(at.join("broken.png"), b"no picture").unwrap();
    std::fs::write(at.join("broken.svg"), b"<svg").unwrap();
    std::fs::write(at.join("broken.ttf"), b"no font").unwrap();
    let place = ["--at", "0,0,0.5", "--size", "3", "--up", "0,1,0"];
    for (words, code) in [
        (&["--image", "broken.png"][..], 3),
        (&["--svg", "broken.svg"], 3),
        (&["--text", "a", "--font", "broken.ttf"], 3),
        (&["--text", "a"], 2),
        (&["--image", "broken.png", "--svg", "broken.svg"], 2),
    ] {
        let command: Vec<&str> = [&["emboss", "plate.vdb", "-o", "out.vdb"], words, &place].concat();
        let refused = run(at, &command);
        assert_eq!(refused.code(), Some(code), "{}", refused.err);
        assert!(!at.join("out.vdb").exists());
    }
}
