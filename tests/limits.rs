//! The limits of memory and of size: what is refused, and that what is done stays within them.
#![cfg(all(target_os = "linux", feature = "cli", feature = "openvdb"))]

mod common;

use std::path::Path;
use std::time::Duration;

use common::{Ended, names, vdb_edit};

/// Longest that one command may take on a loaded machine.
const LIMIT: Duration = Duration::from_secs(600);

/// Bytes that are filled while the thread that watches waits for its turn on a loaded machine.
const LATE: f64 = (16 << 20) as f64;

#[track_caller]
fn done(words: &[&str], folder: &Path) -> Ended {
    let ended = vdb_edit(words, folder, LIMIT);
    assert_eq!(ended.code(), Some(0), "{words:?}: {}", ended.err);
    ended
}

/// Runs a command without a limit, and then with limits around what it took.
fn holds_its_limit(words: &[&str], folder: &Path) {
    let files = names(folder);
    let clear = || {
        for name in names(folder).into_iter().filter(|name| !files.contains(name)) {
            std::fs::remove_file(folder.join(name)).unwrap();
        }
    };
    let free = done(words, folder).peak_bytes;
    assert!(free > 100 << 20, "{words:?} takes {free} bytes, too little to tell anything");
    for part in [0.3, 0.6, 0.8, 0.95, 1.5] {
        clear();
        let limit = (free as f64 * part) as u64;
        let bytes = limit.to_string();
        let limited = [words, &["--memory-limit", &bytes]].concat();
        let ended = vdb_edit(&limited, folder, LIMIT);
        let peak = ended.peak_bytes;
        println!(
            "{} with {part} of {free}: {:?}, peak {:.2} of the limit",
            words[0],
            ended.code(),
            peak as f64 / limit as f64
        );
        assert!(peak as f64 <= 1.1 * limit as f64 + LATE, "{words:?}: {peak} bytes with a limit of {limit}");
        match ended.code() {
            Some(0) => assert!(part > 0.5, "{words:?} with {part} of what it takes"),
            Some(5) => {
                assert!(ended.err.contains("of memory, the limit is"), "{}", ended.err);
                assert!(part < 1.0, "{words:?} with {part} of what it takes: {}", ended.err);
                assert_eq!(names(folder), files, "{words:?}");
            }
            code => panic!("{words:?}: {code:?} {}", ended.err),
        }
    }
    clear();
}

/// Two level sets of some size.
fn inputs(folder: &Path, voxel_size: &str) {
    let ball = ["shape", "sphere radius=1", "-o", "a.vdb", "--voxel-size", voxel_size];
    done(&ball, folder);
    done(&["shape", "torus major=0.8 minor=0.4", "-o", "b.vdb", "--voxel-size", voxel_size], folder);
}

#[test]
fn conversion_and_offset_hold_their_memory_limit() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    inputs(folder, "0.006");
    holds_its_limit(&["offset", "a.vdb", "-o", "out.vdb", "--distance", "10vx"], folder);
    let mesh = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/spot.obj");
    let mesh = mesh.to_str().unwrap();
    holds_its_limit(&["convert", mesh, "-o", "out.vdb", "--resolution", "500"], folder);
}

#[test]
#[ignore = "some minutes: part of make nightly"]
fn large_consumers_hold_their_memory_limit() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    inputs(folder, "0.004");
    let star = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/star.obj");
    let star = star.to_str().unwrap();
    for words in [
        &["csg", "union", "a.vdb", "b.vdb", "-o", "out.vdb"][..],
        &["offset", "a.vdb", "-o", "out.vdb", "--distance", "-40vx"],
        &["close", "b.vdb", "-o", "out.vdb", "--distance", "5vx"],
        &["smooth", "a.vdb", "-o", "out.vdb", "--iterations", "3"],
        &["morph", "a.vdb", "b.vdb", "-o", "out.####.vdb", "--frame-count", "3"],
        &["texture", "a.vdb", star, "-o", "out.vdb", "--center", "0,0,1", "--radius", "0.5"],
    ] {
        holds_its_limit(words, folder);
    }
}

/// A mesh of octahedra, `count` along each axis, three voxels in radius and ten apart where a voxel is 1.
fn dots(path: &Path, count: u32) {
    use std::fmt::Write;
    let mut text = String::new();
    for n in 0..count.pow(3) {
        let at = [n % count, n / count % count, n / count.pow(2)].map(|c| f64::from(c) * 10.0 + 0.3);
        for axis in 0..3 {
            for side in [3.0, -3.0] {
                let mut corner = at;
                corner[axis] += side;
                writeln!(text, "v {} {} {}", corner[0], corner[1], corner[2]).unwrap();
            }
        }
        for face in [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]] {
            let [a, b, c] = face.map(|corner| 6 * n + corner + 1);
            writeln!(text, "f {a} {b} {c}").unwrap();
        }
    }
    std::fs::write(path, text).unwrap();
}

/// Conversion, measures, opening and polygons of as many parts as asked for.
fn many_components(count: u32) {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dots(&folder.join("dots.obj"), count);
    let components = |file: &str| {
        let listed = done(&["info", file, "--json"], folder).json();
        listed["grids"][0]["level_set"]["components"].as_u64()
    };
    let all = Some(u64::from(count.pow(3)));
    done(&["convert", "dots.obj", "-o", "dots.vdb", "--voxel-size", "1"], folder);
    assert_eq!(components("dots.vdb"), all);
    done(&["open", "dots.vdb", "-o", "open.vdb", "--distance", "1vx", "--check"], folder);
    assert_eq!(components("open.vdb"), all);
    // Too much for any of them.
    let gone = done(&["open", "dots.vdb", "-o", "gone.vdb", "--distance", "2.5vx"], folder);
    assert!(gone.err.contains("nothing is left"), "{}", gone.err);
    done(&["convert", "dots.vdb", "-o", "dots.ply"], folder);
    let mesh = vdb_edit::mesh::read(&folder.join("dots.ply")).unwrap().mesh;
    let (vertices, triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
    // Spheres, all of them: V − E + F = 2 each, with E = 3/2 F.
    assert_eq!(Some(vertices - triangles / 2), all.map(|n| 2 * n));
}

#[test]
fn a_thousand_components_are_as_good_as_one() {
    many_components(10);
}

#[test]
#[ignore = "some minutes: part of make nightly"]
fn a_hundred_thousand_components_are_as_good_as_one() {
    many_components(47);
}
