//! Whatever ends a run or stands in its way: the old output stays whole, or the new one is complete.
#![cfg(all(unix, feature = "cli", feature = "openvdb"))]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

fn start(folder: &Path, words: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_vdb-edit"));
    command.args(words).current_dir(folder).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().unwrap()
}

fn code(folder: &Path, words: &[&str]) -> Option<i32> {
    start(folder, words).wait().unwrap().code()
}

/// Makes `out.vdb`: one surface or another.
const FIRST: [&str; 6] = ["shape", "sphere radius=1", "-o", "out.vdb", "--voxel-size", "0.02"];
const SECOND: [&str; 6] = ["shape", "box size=2,2,2", "-o", "out.vdb", "--voxel-size", "0.02"];

/// What a file holds, if it is whole.
fn content(folder: &Path) -> String {
    let words = ["info", "out.vdb", "--check", "--json"];
    let output = Command::new(env!("CARGO_BIN_EXE_vdb-edit")).args(words).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let whole: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    whole["grids"].to_string()
}

/// What `out.vdb` holds after one and after the other; the second stays.
fn both(folder: &Path) -> [String; 2] {
    [FIRST, SECOND].map(|words| {
        assert_eq!(code(folder, &words), Some(0));
        content(folder)
    })
}

#[test]
fn kill_at_any_moment_leaves_the_old_file_or_the_new_one() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    assert_eq!(code(folder, &FIRST), Some(0));
    let (first_bytes, first) = (fs::read(folder.join("out.vdb")).unwrap(), content(folder));
    let began = Instant::now();
    assert_eq!(code(folder, &SECOND), Some(0));
    let (length, second) = (began.elapsed(), content(folder));
    assert_ne!(first, second);
    let (mut old, mut new) = (0, 0);
    for moment in 0..100 {
        fs::write(folder.join("out.vdb"), &first_bytes).unwrap();
        let mut child = start(folder, &SECOND);
        // In no order, and some after the usual end.
        std::thread::sleep(length * (moment * 37 % 100) / 80);
        child.kill().unwrap();
        child.wait().unwrap();
        if fs::read(folder.join("out.vdb")).unwrap() == first_bytes {
            old += 1;
        } else {
            assert_eq!(content(folder), second, "moment {moment}");
            new += 1;
        }
    }
    assert!(old > 0 && new > 0, "{old} {new}");
    // What the killed ones left is removed once it is old.
    let left = || fs::read_dir(folder).unwrap().flatten().filter(|e| e.file_name() != "out.vdb");
    let long_ago = std::time::SystemTime::now() - Duration::from_secs(3600);
    left().for_each(|entry| fs::File::open(entry.path()).unwrap().set_modified(long_ago).unwrap());
    assert_eq!(code(folder, &FIRST), Some(0));
    assert_eq!(left().count(), 0);
}

#[test]
fn two_runs_on_one_output_leave_one_of_their_results() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let contents = both(folder);
    for _ in 0..5 {
        let both = [FIRST, SECOND].map(|words| start(folder, &words));
        both.into_iter().for_each(|mut child| assert_eq!(child.wait().unwrap().code(), Some(0)));
        assert!(contents.contains(&content(folder)));
        assert_eq!(fs::read_dir(folder).unwrap().count(), 1);
    }
}

/// A limit on the size of a file stands in for a full disk: both end in a failed write.
#[test]
fn a_write_that_finds_no_room_leaves_the_old_file() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    assert_eq!(code(folder, &FIRST), Some(0));
    let before = fs::read(folder.join("out.vdb")).unwrap();
    // Blocks of 512 bytes or 1 KiB; the signal that goes with the limit is ignored, so that the write fails.
    let script = "ulimit -f 40; trap '' XFSZ; exec \"$0\" \"$@\"";
    let mut command = Command::new("sh");
    command.args(["-c", script, env!("CARGO_BIN_EXE_vdb-edit")]).args(SECOND).current_dir(folder);
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(4), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(fs::read(folder.join("out.vdb")).unwrap() == before);
    assert_eq!(fs::read_dir(folder).unwrap().count(), 1);
}

/// A file system in memory, mounted on a folder until it is dropped.
struct Disk<'a>(&'a Path);

impl<'a> Disk<'a> {
    /// `None`, said on standard error, where mounting is not allowed.
    fn mount(folder: &'a Path, size: &str) -> Option<Self> {
        let options = format!("size={size}");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &options, "tmpfs"]).arg(folder).output();
        if mounted.is_ok_and(|output| output.status.success()) {
            return Some(Self(folder));
        }
        eprintln!("SKIPPED: no file system can be mounted on {}", folder.display());
        None
    }
}

impl Drop for Disk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0).status();
    }
}

/// A disk that is full for the new file, and has room for it once something else is gone.
#[test]
fn a_full_disk_leaves_the_old_file() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let Some(_disk) = Disk::mount(folder, "16m") else { return };
    assert_eq!(code(folder, &FIRST), Some(0));
    let before = fs::read(folder.join("out.vdb")).unwrap();
    // Room for half as much as is there; each of these takes more.
    fs::write(folder.join("ballast"), vec![0; (16 << 20) - before.len() * 3 / 2]).unwrap();
    let run = |words: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_vdb-edit")).args(words).current_dir(folder).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let larger = ["shape", "sphere radius=2", "-o", "out.vdb", "--voxel-size", "0.02"];
    for words in [
        &larger[..],
        &["convert", "out.vdb", "-o", "out.ply"],
        &["render", "out.vdb", "-o", "out.png", "--size", "2000x2000"],
    ] {
        let (code, said) = run(words);
        assert_eq!(code, Some(4), "{words:?}: {said}");
        assert!(said.contains("space"), "{words:?}: {said}");
        assert!(fs::read(folder.join("out.vdb")).unwrap() == before);
        assert_eq!(fs::read_dir(folder).unwrap().count(), 2, "{words:?}");
    }
    fs::remove_file(folder.join("ballast")).unwrap();
    assert_eq!(code(folder, &larger), Some(0));
}

#[test]
fn a_target_that_is_closed_to_writing_or_gone_is_said_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    assert_eq!(code(folder, &FIRST), Some(0));
    let out = folder.join("out.vdb");
    let before = fs::read(&out).unwrap();
    fs::set_permissions(&out, fs::Permissions::from_mode(0o444)).unwrap();
    assert_eq!(code(folder, &SECOND), Some(4));
    assert!(fs::read(&out).unwrap() == before);
    assert_eq!(code(folder, &["shape", "sphere radius=1", "-o", "gone/out.vdb", "--voxel-size", "0.02"]), Some(4));
}

/// A file that is replaced by a rename while it is read is the old one to its reader, or the new one.
#[test]
fn an_input_replaced_while_it_is_read_is_one_of_both() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let contents = both(folder);
    for round in 0..5 {
        let mut writer = start(folder, if round % 2 == 0 { &FIRST } else { &SECOND });
        while writer.try_wait().unwrap().is_none() {
            assert!(contents.contains(&content(folder)));
        }
    }
}
