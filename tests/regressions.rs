//! What once went wrong, by way of the command: each test was a hang, a panic, a blown-up memory or a wrong result.
#![cfg(all(feature = "cli", feature = "openvdb"))]

mod common;

use std::path::Path;
use std::time::Duration;

use common::{Ended, vdb_edit};
use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::{GridToWrite, WriteOptions, open, write};

const TIME: Duration = Duration::from_secs(30);

fn sphere(radius: f64, voxel_size: f64, half_width: f32) -> LevelSet {
    let reach = IVec3::splat((radius / voxel_size) as i32 + 8);
    let distance = |ijk: DVec3| ijk.length() - radius / voxel_size;
    let transform = Transform::uniform(voxel_size);
    LevelSet::from_distance(transform, half_width, (-reach, reach), distance, &RunOptions::default()).unwrap()
}

fn store(folder: &Path, name: &str, level_set: &LevelSet) {
    let grid = GridToWrite { level_set, name: Some("surface"), replaces: None };
    write(folder.join(name), &[grid], None, &WriteOptions::default()).unwrap();
}

/// Runs in a folder that holds `s.vdb`, a sphere of 12 voxels radius.
fn run(words: &[&str]) -> (tempfile::TempDir, Ended) {
    let folder = tempfile::tempdir().unwrap();
    store(folder.path(), "s.vdb", &sphere(1.2, 0.1, 3.0));
    let ended = vdb_edit(words, folder.path(), TIME);
    (folder, ended)
}

#[test]
fn a_surface_that_needs_too_much_memory_is_refused_before_it_is_searched() {
    for words in [
        &["shape", "sphere radius=1", "-o", "a.vdb", "--resolution", "100000"][..],
        &["offset", "s.vdb", "-o", "a.vdb", "--distance", "1e6"],
    ] {
        let (folder, ended) = run(&[words, &["--memory-limit", "1GiB"]].concat());
        assert_eq!(ended.code(), Some(5), "{words:?}: {}", ended.err);
        assert!(ended.err.contains("limit is 1.0 GiB"), "{}", ended.err);
        assert!(ended.peak_bytes < 1 << 30, "{words:?} used {} bytes", ended.peak_bytes);
        assert!(!folder.path().join("a.vdb").exists());
    }
}

#[test]
fn voxels_that_f32_or_openvdb_cannot_hold_are_refused() {
    for radius in ["1e-300", "1e-12", "1e30"] {
        let (_, ended) = run(&["shape", &format!("sphere radius={radius}"), "-o", "a.vdb", "--resolution", "24"]);
        assert_eq!(ended.code(), Some(2), "{radius}: {}", ended.err);
    }
    // Too small for OpenVDB alone: as a mesh it can be written.
    let (folder, ended) = run(&["transform", "s.vdb", "--scale", "1e-5", "-o", "a.vdb"]);
    assert_eq!(ended.code(), Some(4), "{}", ended.err);
    assert!(ended.err.contains("scale the model up"), "{}", ended.err);
    let ended = vdb_edit(&["transform", "s.vdb", "--scale", "1e-5", "-o", "a.obj"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
}

#[cfg(unix)]
#[test]
fn links_that_lead_nowhere_yet_are_written_through_and_loops_are_refused() {
    use std::os::unix::fs::symlink;
    let folder = tempfile::tempdir().unwrap();
    store(folder.path(), "s.vdb", &sphere(1.2, 0.1, 3.0));
    symlink("later.vdb", folder.path().join("link.vdb")).unwrap();
    symlink("loop.vdb", folder.path().join("loop.vdb")).unwrap();
    let ended = vdb_edit(&["offset", "s.vdb", "-o", "link.vdb"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
    assert!(folder.path().join("link.vdb").is_symlink() && folder.path().join("later.vdb").is_file());
    let ended = vdb_edit(&["offset", "s.vdb", "-o", "loop.vdb"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(4), "{}", ended.err);
    assert!(ended.err.contains("loop") && folder.path().join("loop.vdb").is_symlink(), "{}", ended.err);
}

/// A file of a few kilobytes may claim any number of solid tiles; 16 GiB of signs were made of one.
#[test]
fn solid_tiles_beyond_the_band_cost_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let level_set = sphere(1.2, 0.1, 3.0);
    let mut solid = level_set.clone();
    solid.grid_mut().set_sign(IVec3::splat(4096), IVec3::splat(4096 + 1024), true);
    assert!(solid.grid().inside_tiles().len() > level_set.grid().inside_tiles().len());
    store(folder.path(), "solid.vdb", &solid);
    let read =
        open(folder.path().join("solid.vdb"), &RunOptions::default()).unwrap().read_level_set(None, false).unwrap();
    assert_eq!(read.level_set.grid().inside_tiles(), level_set.grid().inside_tiles());
    assert_eq!(read.level_set.check(), []);
}

/// 2.9995 voxels become 3 in half precision, which is the background.
#[test]
fn a_band_stays_valid_in_half_precision() {
    let folder = tempfile::tempdir().unwrap();
    store(folder.path(), "s.vdb", &sphere(10.0005, 1.0, 3.0));
    let ended = vdb_edit(&["convert", "s.vdb", "-o", "half.vdb", "--precision", "half"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
    let ended = vdb_edit(&["info", "--check", "half.vdb"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
}

/// In a band of one voxel a flow loses the surface.
#[test]
fn bands_too_narrow_for_a_flow_are_widened() {
    let folder = tempfile::tempdir().unwrap();
    store(folder.path(), "thin.vdb", &sphere(1.5, 0.1, 1.0));
    let ended = vdb_edit(&["smooth", "thin.vdb", "-o", "a.vdb", "--check"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(0), "{}", ended.err);
    assert!(ended.err.contains("too narrow to be edited"), "{}", ended.err);
}

#[test]
fn a_level_set_whose_inside_is_outside_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut swapped = sphere(1.5, 0.1, 3.0);
    swapped.grid_mut().update_all(|_, values, _| values.0.iter_mut().for_each(|v| *v = -*v));
    store(folder.path(), "swapped.vdb", &swapped);
    let ended = vdb_edit(&["offset", "swapped.vdb", "-o", "a.vdb"], folder.path(), TIME);
    assert_eq!(ended.code(), Some(3), "{}", ended.err);
    assert!(ended.err.contains("opposite sign"), "{}", ended.err);
}

/// Fog, velocity and all metadata of a file pass through every command that edits its level set.
#[test]
fn everything_beside_the_level_set_passes_through() {
    let asset = format!("{}/assets/three_grids.vdb", env!("CARGO_MANIFEST_DIR"));
    let run = RunOptions::default();
    let before = open(&asset, &run).unwrap();
    for edit in [
        &["offset", "--distance", "1vx"][..],
        &["smooth", "--iterations", "1"],
        &["transform", "--translate", "1,0,0"],
        &["csg", "union", &asset],
        &["rebuild"],
    ] {
        let folder = tempfile::tempdir().unwrap();
        let ended = vdb_edit(&[edit, &[&asset, "-o", "a.vdb"]].concat(), folder.path(), TIME);
        assert_eq!(ended.code(), Some(0), "{edit:?}: {}", ended.err);
        let after = open(folder.path().join("a.vdb"), &run).unwrap();
        assert_eq!(after.listing().metadata, before.listing().metadata, "{edit:?}");
        let grids = before.listing().grids.iter().zip(&after.listing().grids);
        assert_eq!(before.listing().grids.len(), after.listing().grids.len());
        for (index, (old, new)) in grids.enumerate() {
            let own = |grid: &vdb_edit::vdb::GridListing| {
                // What OpenVDB computes of the voxels while it writes.
                let items = grid.metadata.iter().filter(|item| !item.name.starts_with("file_"));
                items.cloned().collect::<Vec<_>>()
            };
            assert_eq!((&old.name, &old.class), (&new.name, &new.class), "{edit:?}");
            assert_eq!(own(old), own(new), "{edit:?}: {}", old.name);
            if !old.is_level_set() {
                assert_eq!(before.fingerprint(index).unwrap(), after.fingerprint(index).unwrap(), "{edit:?}");
            }
        }
    }
}
