//! Files damaged at random, read by the command as a user would: an answer or an error, never a signal, never longer than ten seconds, within
//! an address space of a few times the memory limit.
#![cfg(all(unix, feature = "cli", feature = "openvdb"))]

use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::mesh::{self, MeshFormat, level_set_to_mesh};
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::{self, Compression, GridToWrite, WriteOptions};

/// Kilobytes of address space of a reader: its libraries need half a gigabyte, its threads' heaps some more.
const ADDRESS_SPACE: u64 = 4 << 20;
const LONGEST: Duration = Duration::from_secs(10);

/// Numbers at random, the same in every run (Knuth's multiplier).
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % limit.max(1)
    }
}

/// What is written over numbers: counts that are too large, sizes that are negative, offsets beyond the end.
const ODD_NUMBERS: [&[u8]; 6] = [
    &[0xff; 4],
    &[0xff; 8],
    &[0xff, 0xff, 0xff, 0x7f],
    &[0; 8],
    &[0, 0, 0, 0, 0, 1, 0, 0],
    &[0xf0, 0xd8, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff],
];

fn damaged(original: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = original.to_vec();
    // Headers are short, and all that follows hangs on them.
    let place = |random: &mut Random| {
        let within = if random.below(5) < 2 { original.len().min(4096) } else { original.len() };
        random.below(within)
    };
    match random.below(6) {
        0 => bytes.truncate(random.below(original.len())),
        1 => bytes[place(random)] ^= 1 << random.below(8),
        2 => (0..2 + random.below(40)).for_each(|_| bytes[place(random)] = random.below(256) as u8),
        3 => {
            let (number, at) = (ODD_NUMBERS[random.below(ODD_NUMBERS.len())], place(random));
            bytes.iter_mut().skip(at).zip(number).for_each(|(byte, new)| *byte = *new);
        }
        4 => {
            let (at, count) = (place(random), random.below(200));
            bytes.iter_mut().skip(at).take(count).for_each(|byte| *byte = 0);
        }
        _ => {
            let (from, at, count) = (place(random), place(random), random.below(500));
            original[from..].iter().zip(bytes.iter_mut().skip(at)).take(count).for_each(|(old, byte)| *byte = *old);
        }
    }
    bytes
}

/// What is wrong with how the command took a file, if anything.
fn fault(file: &Path) -> Option<String> {
    let reader = format!("ulimit -v {ADDRESS_SPACE}; exec \"$0\" info \"$1\" --memory-limit 1GB --threads 1");
    let mut child = Command::new("sh")
        .args(["-c", &reader, env!("CARGO_BIN_EXE_vdb-edit")])
        .arg(file)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("sh starts");
    let began = Instant::now();
    loop {
        if let Some(status) = child.try_wait().expect("a child can be waited for") {
            return match (status.code(), status.signal()) {
                // Read, refused as input, refused for its size.
                (Some(0 | 3 | 5), _) => None,
                (code, signal) => Some(format!("exit code {code:?}, signal {signal:?}")),
            };
        }
        if began.elapsed() > LONGEST {
            child.kill().and_then(|()| child.wait()).expect("a child can be ended");
            return Some(format!("not done after {LONGEST:?}"));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Small files of every kind that is read.
fn originals(folder: &Path) -> Vec<PathBuf> {
    let run = RunOptions::default();
    let ball = |p: DVec3| p.length() - 6.0;
    let reach = IVec3::splat(12);
    let level_set = LevelSet::from_distance(Transform::uniform(0.1), 3.0, (-reach, reach), ball, &run).unwrap();
    let mut files = Vec::new();
    for compression in [Compression::Blosc, Compression::None] {
        let path = folder.join(format!("{compression:?}.vdb"));
        let options = WriteOptions { compression: Some(compression), ..WriteOptions::default() };
        let grid = GridToWrite { level_set: &level_set, name: Some("surface"), replaces: None };
        vdb::write(&path, &[grid], None, &options).unwrap();
        files.push(path);
    }
    let surface = level_set_to_mesh(&level_set, 0.0, &run).unwrap();
    for format in MeshFormat::ALL {
        let path = folder.join("surface").with_extension(format.extension());
        let mut bytes = Vec::new();
        mesh::write_to(&mut bytes, format, &surface).unwrap();
        fs::write(&path, bytes).unwrap();
        files.push(path);
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    files.push(root.join("assets/three_grids.vdb"));
    let shared = std::env::var_os("VDB_EDIT_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    for name in [
        "velocity_vec3s.vdb",
        "fog_sphere_v223.vdb",
        "points_houdini16.vdb",
        "empty_tree.vdb",
        "three_grids_same_name.vdb",
    ] {
        let path = shared.join("data/vdb").join(name);
        if path.exists() {
            files.push(path);
        } else {
            println!("skipped: {name} of the shared data is not there");
        }
    }
    files
}

fn damage(mutants: usize) {
    let folder = tempfile::tempdir().unwrap();
    let originals: Vec<(PathBuf, Vec<u8>)> =
        originals(folder.path()).into_iter().map(|path| (path.clone(), fs::read(path).unwrap())).collect();
    let next = AtomicUsize::new(0);
    let faults = std::sync::Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(2, |n| n.get()) {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= mutants {
                        break;
                    }
                    let (original, bytes) = &originals[number % originals.len()];
                    let extension = original.extension().and_then(|e| e.to_str()).unwrap_or_default();
                    let file = folder.path().join(format!("{number}.{extension}"));
                    fs::write(&file, damaged(bytes, &mut Random(number as u64 + 1))).unwrap();
                    let Some(fault) = fault(&file) else {
                        fs::remove_file(&file).unwrap();
                        continue;
                    };
                    faults.lock().unwrap().push(format!("mutant {number} of {}: {fault}", original.display()));
                }
            });
        }
    });
    let faults = faults.into_inner().unwrap();
    assert!(faults.is_empty(), "{} of {mutants}:\n{}", faults.len(), faults.join("\n"));
}

#[test]
fn damaged_files_are_read_or_refused() {
    damage(1000);
}

#[test]
#[ignore = "half an hour: part of make nightly"]
fn fifty_thousand_damaged_files_are_read_or_refused() {
    damage(50_000);
}
