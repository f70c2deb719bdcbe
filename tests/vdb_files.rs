//! Reading and writing .vdb files: real files of many programs, and files made here.
#![cfg(feature = "openvdb")]

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DQuat, DVec3, IVec3};
use vdb_edit::grid::{Grid, Transform};
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::reference::ReferenceGrid;
use vdb_edit::vdb::{self, Band, Compression, FileListing, GridToWrite, MetaItem, Precision, VdbFile, WriteOptions};
use vdb_edit::{EditError, LevelSet};

/// A file of the shared data, or `None` with a note when that is not there.
fn shared(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("VDB_EDIT_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"));
    let path = root.join("data/vdb").join(name);
    if !path.exists() {
        println!("skipped: {name} of the shared data is not there");
        return None;
    }
    Some(path)
}

fn open(path: impl AsRef<Path>) -> vdb_edit::Result<VdbFile> {
    vdb::open(path, &RunOptions::default())
}

fn sphere(transform: Transform, radius: f64) -> LevelSet {
    let reach = IVec3::splat(radius as i32 + 8);
    LevelSet::from_distance(transform, 3.0, (-reach, reach), |p| p.length() - radius, &RunOptions::default()).unwrap()
}

fn result(level_set: &LevelSet) -> GridToWrite<'_> {
    GridToWrite { level_set, name: Some("surface"), replaces: None }
}

/// Every voxel, mask and sign equal.
fn assert_same_grid(a: &Grid, b: &Grid) {
    assert_eq!(a.background(), b.background());
    assert_eq!(a.leaves().len(), b.leaves().len());
    for (&i, &j) in a.leaves().iter().zip(b.leaves()) {
        assert_eq!(a.origin(i), b.origin(j));
        assert!(a.values(i) == b.values(j) && a.mask(i) == b.mask(j), "leaf {}", a.origin(i));
    }
    assert_eq!(a.inside_tiles(), b.inside_tiles());
}

/// What must not change when a file is written again. The `file_` items are statistics of the content that OpenVDB adds.
fn lasting(metadata: &[MetaItem]) -> Vec<MetaItem> {
    let mut items: Vec<_> = metadata.iter().filter(|m| !m.name.starts_with("file_")).cloned().collect();
    items.sort_by(|a, b| a.name.cmp(&b.name));
    items
}

fn assert_same_except(before: &FileListing, after: &FileListing, edited: Option<usize>) {
    assert_eq!(lasting(&before.metadata), lasting(&after.metadata));
    assert_eq!(before.grids.len(), after.grids.len());
    for (index, (a, b)) in before.grids.iter().zip(&after.grids).enumerate() {
        assert_eq!(a.name, b.name);
        assert_eq!(a.selector, b.selector);
        assert_eq!(a.class, b.class);
        assert_eq!(a.to_world, b.to_world);
        assert_eq!(a.map_type, b.map_type);
        assert_eq!(a.precision, b.precision);
        assert_eq!(a.compression, b.compression);
        assert_eq!(lasting(&a.metadata), lasting(&b.metadata), "grid {}", a.selector);
        if edited != Some(index) {
            assert_eq!(a.value_type, b.value_type);
            assert_eq!(a.active_voxels(), b.active_voxels());
        }
    }
}

fn input_error(result: vdb_edit::Result<impl Sized>) -> String {
    match result.map(|_| ()) {
        Err(e @ EditError::Input { .. }) => e.to_string(),
        other => panic!("an input error was expected: {other:?}"),
    }
}

#[test]
fn real_level_sets_survive_an_edit_unchanged() {
    let files = [
        ("ls_sphere_v222_half.vdb", None, 270_638),
        ("ls_sphere_translated.vdb", None, 40_404),
        ("two_levelsets_streamed_unnamed.vdb", Some("[0]"), 188_574),
        ("two_levelsets_streamed_unnamed.vdb", Some("[1]"), 67_646),
    ];
    let folder = tempfile::tempdir().unwrap();
    for (name, selector, active) in files {
        let Some(path) = shared(name) else { continue };
        let file = open(&path).unwrap();
        let read = file.read_level_set(selector, false).unwrap();
        assert_eq!(read.level_set.grid().active_voxels(), active, "{name}");
        assert_eq!(read.band, Band::Regular, "{name}: {:?}", read.facts);
        assert!(!read.level_set.grid().inside_tiles().is_empty(), "{name}: a sphere has an inside");

        let out = folder.path().join(name);
        let grid = GridToWrite { level_set: &read.level_set, name: None, replaces: Some(read.index) };
        vdb::write(&out, &[grid], Some(&file), &WriteOptions::default()).unwrap();
        let back = open(&out).unwrap();
        assert_same_except(file.listing(), back.listing(), Some(read.index));
        for index in 0..file.listing().grids.len() {
            assert_eq!(file.fingerprint(index).unwrap(), back.fingerprint(index).unwrap(), "{name} grid {index}");
        }
        let again = back.read_level_set(selector, false).unwrap();
        assert_same_grid(read.level_set.grid(), again.level_set.grid());
        assert_eq!(read.level_set.transform(), again.level_set.transform());
        assert_eq!(back.listing().grids[read.index].active_voxels(), Some(active));
        assert_eq!(back.listing().grids[read.index].active_bounds(), read.level_set.grid().active_bounds());
    }
}

#[test]
fn real_files_without_a_level_set_are_refused_for_their_reason() {
    let refusals = [
        ("smoke_v222_half.vdb", None, "fog volume"),
        ("fog_sphere_v223.vdb", Some("density"), "fog volume"),
        ("fog_rotated_anisotropic.vdb", None, "fog volume"),
        ("points_houdini16.vdb", None, "ptdataidx32"),
        ("velocity_vec3s.vdb", Some("vel"), "vec3s"),
        ("three_grids_same_name.vdb", None, "no level set"),
        ("three_grids_same_name.vdb", Some("density"), "`density[2]`"),
        ("three_grids_same_name.vdb", Some("density[1]"), "fog volume"),
        ("blender_fluid_0152.vdb", None, "no level set"),
        ("blender_fluid_0152.vdb", Some("smoke"), "there is no grid `smoke`"),
        ("two_levelsets_streamed_unnamed.vdb", None, "several level sets: `[0]`"),
        ("two_levelsets_streamed_unnamed.vdb", Some(""), "take one by its number"),
        ("box_active_tiles.vdb", None, "was never set"),
        ("empty_tree.vdb", None, "was never set"),
    ];
    for (name, selector, reason) in refusals {
        let Some(path) = shared(name) else { continue };
        let error = input_error(open(&path).unwrap().read_level_set(selector, false));
        assert!(error.contains(reason), "{name}: {error}");
    }
    for (name, reason) in [("not_a_vdb_symlink_text.vdb", "symbolic link"), ("not_a_vdb_lfs_pointer.vdb", "Git LFS")] {
        let Some(path) = shared(name) else { continue };
        assert!(input_error(open(&path)).contains(reason));
        assert!(input_error(vdb::list(&path)).contains(reason));
    }
}

#[test]
fn an_assumed_level_set_is_judged_by_its_band() {
    if let Some(path) = shared("box_active_tiles.vdb") {
        let read = open(&path).unwrap().read_level_set(None, true).unwrap();
        assert_eq!(read.facts.active_tiles, 1728);
        assert!(matches!(read.band, Band::Rebuild { .. }), "{:?}", read.band);
    }
    if let Some(path) = shared("empty_tree.vdb") {
        let read = open(&path).unwrap().read_level_set(None, true).unwrap();
        assert!(read.level_set.is_empty());
    }
}

#[test]
fn every_grid_of_every_real_file_passes_through_an_edit() {
    let folder = tempfile::tempdir().unwrap();
    let added = sphere(Transform::uniform(0.1), 10.0);
    for name in [
        "blender_fluid_0152.vdb",
        "box_active_tiles.vdb",
        "empty_tree.vdb",
        "fog_rotated_anisotropic.vdb",
        "fog_sphere_v223.vdb",
        "points_houdini16.vdb",
        "smoke_v222_half.vdb",
        "three_grids_same_name.vdb",
        "two_levelsets_streamed_unnamed.vdb",
        "velocity_vec3s.vdb",
    ] {
        let Some(path) = shared(name) else { continue };
        let file = open(&path).unwrap();
        let listed = vdb::list(&path).unwrap();
        assert_same_except(&listed, file.listing(), None);

        let out = folder.path().join(name);
        vdb::write(&out, &[result(&added)], Some(&file), &WriteOptions::default()).unwrap();
        let back = open(&out).unwrap();
        let mut after = back.listing().clone();
        assert_eq!(after.grids.pop().map(|g| g.name).as_deref(), Some("surface"), "{name}");
        assert_same_except(file.listing(), &after, None);
        for index in 0..file.listing().grids.len() {
            assert_eq!(file.fingerprint(index).unwrap(), back.fingerprint(index).unwrap(), "{name} grid {index}");
        }
        // And without the others.
        let alone = WriteOptions { only_result: true, ..WriteOptions::default() };
        vdb::write(&out, &[result(&added)], Some(&file), &alone).unwrap();
        let grids = vdb::list(&out).unwrap().grids;
        assert_eq!(grids.iter().map(|g| g.name.as_str()).collect::<Vec<_>>(), ["surface"]);
    }
}

/// OpenVDB ends the process where an assertion about the chunks of points fails.
#[test]
fn points_are_carried_over_without_being_decoded() {
    let Some(path) = shared("points_houdini16.vdb") else { return };
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(path).unwrap();
    let [damaged, out] = ["damaged.vdb", "out.vdb"].map(|name| folder.path().join(name));
    // The sizes of chunks, and what the voxels of the tree's leaves are.
    for (at, bit) in [(38222, 2), (38222, 4), (763, 16), (38248, 24), (38257, 8)] {
        let mut changed = bytes.clone();
        changed[at] ^= bit;
        std::fs::write(&damaged, &changed).unwrap();
        let file = open(&damaged).unwrap();
        vdb::write(&out, &[result(&sphere(Transform::uniform(0.1), 10.0))], Some(&file), &WriteOptions::default())
            .unwrap();
        let written = std::fs::read(&out).unwrap();
        // What is stored of them is there byte by byte.
        let content = &changed[changed.len() / 2..];
        assert!(written.windows(content.len()).any(|w| w == content), "{at}");
    }
    // A file without offsets, as written to a pipe, has to be decoded.
    let mut streamed = bytes;
    streamed[20] = 0;
    std::fs::write(&damaged, &streamed).unwrap();
    let file = open(&damaged).unwrap();
    vdb::write(&out, &[], Some(&file), &WriteOptions::default()).unwrap();
    assert_same_except(file.listing(), open(&out).unwrap().listing(), None);
}

/// Every length near both ends, and many between, must be refused.
fn assert_cuts_are_errors(bytes: &[u8], what: &str) {
    let folder = tempfile::tempdir().unwrap();
    let cut = folder.path().join("cut.vdb");
    let lengths = (0..bytes.len()).filter(|n| *n < 700 || bytes.len() - n < 40 || n % 997 == 0);
    for length in lengths {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        let error = input_error(open(&cut));
        assert!(error.contains("truncated") || error.contains("empty"), "{what} {length}: {error}");
        input_error(vdb::list(&cut));
    }
    std::fs::write(&cut, [bytes, &[0]].concat()).unwrap();
    assert!(input_error(open(&cut)).contains("1 bytes follow"), "{what}");
}

#[test]
fn files_cut_short_anywhere_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole.vdb");
    let level_set = sphere(Transform::uniform(0.1), 6.0);
    for compression in [Compression::Blosc, Compression::None] {
        let options = WriteOptions { compression: Some(compression), ..WriteOptions::default() };
        let report = vdb::write(&whole, &[result(&level_set)], None, &options).unwrap();
        assert!(report.warnings.is_empty(), "{report:?}");
        assert_eq!(vdb::list(&whole).unwrap().grids[0].compression, compression);
        assert_cuts_are_errors(&std::fs::read(&whole).unwrap(), &format!("{compression:?}"));
    }
}

#[test]
fn zip_is_for_other_grids_than_level_sets() {
    let Some(path) = shared("velocity_vec3s.vdb") else { return };
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("zip.vdb");
    let (file, level_set) = (open(path).unwrap(), sphere(Transform::uniform(0.1), 4.0));
    let zip = WriteOptions { compression: Some(Compression::Zip), ..WriteOptions::default() };
    let report = vdb::write(&out, &[result(&level_set)], Some(&file), &zip).unwrap();
    assert!(report.warnings[0].contains("does not zip level sets"));
    let back = open(&out).unwrap();
    assert_eq!(back.listing().grids[0].compression, Compression::Zip);
    assert_eq!(back.listing().grids[1].compression, Compression::None);
    assert_eq!(back.fingerprint(0).unwrap(), file.fingerprint(0).unwrap());
    assert_cuts_are_errors(&std::fs::read(&out).unwrap(), "zip");
    // The next write keeps it for the grids that have it.
    vdb::write(&out, &[], Some(&back), &WriteOptions::default()).unwrap();
    assert_eq!(vdb::list(&out).unwrap().grids[0].compression, Compression::Zip);
}

#[test]
fn real_files_cut_short_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let cut = folder.path().join("cut.vdb");
    for name in [
        "ls_sphere_v222_half.vdb",
        "two_levelsets_streamed_unnamed.vdb",
        "points_houdini16.vdb",
        "blender_fluid_0152.vdb",
        "fog_sphere_v223.vdb",
    ] {
        let Some(path) = shared(name) else { continue };
        let bytes = std::fs::read(path).unwrap();
        for length in (0..12).map(|i| bytes.len() * i / 12 + 13).chain([bytes.len() - 1]) {
            std::fs::write(&cut, &bytes[..length]).unwrap();
            let error = input_error(open(&cut));
            assert!(error.contains("truncated"), "{name} {length}: {error}");
        }
    }
}

#[test]
fn what_is_written_reads_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vdb");
    let rotation = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7);
    let transforms = [
        DAffine3::from_scale(DVec3::splat(0.05)),
        DAffine3::from_scale_rotation_translation(DVec3::splat(0.1), DQuat::IDENTITY, DVec3::new(0.1, -7.3, 1e5)),
        DAffine3::from_scale_rotation_translation(DVec3::splat(0.3), rotation, DVec3::new(1.0, 2.0, 3.0)),
        // Mirrored.
        DAffine3::from_mat3_translation(DMat3::from_diagonal(DVec3::new(0.2, 0.2, -0.2)), DVec3::splat(-12345.6)),
    ];
    for affine in transforms {
        let transform = Transform::from_affine(affine).unwrap();
        // Larger than a node, so that there are inside tiles of both sizes.
        let level_set = sphere(transform, 240.0);
        assert!(level_set.grid().inside_tiles().iter().any(|(_, edge)| *edge == 128));
        let report = vdb::write(&path, &[result(&level_set)], None, &WriteOptions::default()).unwrap();
        assert_eq!(report.bytes, std::fs::metadata(&path).unwrap().len());
        let back = open(&path).unwrap();
        let read = back.read_level_set(Some("surface"), false).unwrap();
        assert_same_grid(level_set.grid(), read.level_set.grid());
        assert_eq!(read.level_set.transform().to_world(), affine);
        assert_eq!(read.band, Band::Regular);

        // An edit keeps the transform's very bits and kind.
        let again = folder.path().join("b.vdb");
        let grid = GridToWrite { level_set: &read.level_set, name: None, replaces: Some(0) };
        vdb::write(&again, &[grid], Some(&back), &WriteOptions::default()).unwrap();
        assert_same_except(back.listing(), &vdb::list(&again).unwrap(), None);
    }
    let leftovers: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|f| f.unwrap().file_name()).collect();
    assert_eq!(leftovers.len(), 2, "{leftovers:?}");
}

#[test]
fn equal_results_are_equal_files() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = |name: &str, radius: f64| {
        let path = folder.path().join(name);
        vdb::write(&path, &[result(&sphere(Transform::uniform(0.1), radius))], None, &WriteOptions::default()).unwrap();
        std::fs::read(path).unwrap()
    };
    let (first, again, other) = (bytes("a.vdb", 6.0), bytes("b.vdb", 6.0), bytes("c.vdb", 6.5));
    assert!(first == again);
    // The identity: a UUID of version 8, after magic number, versions and a flag.
    let identity = |file: &[u8]| String::from_utf8(file[21..57].to_vec()).unwrap();
    assert_eq!((&identity(&first)[14..15], &identity(&first)[19..20]), ("8", "8"), "{}", identity(&first));
    assert_ne!(identity(&first), identity(&other));
}

#[test]
fn files_are_those_that_openvdb_writes() {
    let folder = tempfile::tempdir().unwrap();
    // Values and masks at random, which do not compress; every way in which inactive values can be stored.
    let origins: Vec<IVec3> = (0..200).map(|i| IVec3::new(i / 35, i / 7 % 5, i % 7) * 8).collect();
    let mut grid = Grid::from_origins(0.3, &origins);
    grid.update_all(|id, values, mask| {
        let mut state = id.index() as u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u32
        };
        let (active, inside) = (random() % 5, random() % 3);
        for (offset, value) in values.0.iter_mut().enumerate() {
            mask.set(offset, random() % 4 < active);
            let sign = if random() % 2 < inside { -0.3 } else { 0.3 };
            *value = if mask.get(offset) { 0.29 - (random() % 58_000) as f32 * 1e-5 } else { sign };
        }
    });
    let noise = LevelSet::new(grid, Transform::uniform(0.1));
    let empty = LevelSet::empty(Transform::uniform(0.1), 3.0);
    for (n, level_set) in [sphere(Transform::uniform(0.1), 150.0), noise, empty].into_iter().enumerate() {
        for compression in [Compression::Blosc, Compression::Zip, Compression::None] {
            for precision in [Precision::Float, Precision::Half] {
                let [plain, ours] = ["plain.vdb", "ours.vdb"].map(|name| folder.path().join(name));
                let options = WriteOptions {
                    compression: Some(compression),
                    precision: Some(precision),
                    ..WriteOptions::default()
                };
                ReferenceGrid::from_level_set(&level_set).unwrap().write(&plain, &options).unwrap();
                let file = open(&plain).unwrap();
                let grid = GridToWrite { level_set: &level_set, name: None, replaces: Some(0) };
                vdb::write(&ours, &[grid], Some(&file), &options).unwrap();
                let carried = folder.path().join("carried.vdb");
                vdb::write(&carried, &[], Some(&file), &options).unwrap();
                let [plain, ours, carried] = [plain, ours, carried].map(|path| {
                    let mut bytes = std::fs::read(path).unwrap();
                    // The identity: OpenVDB makes one up for every file.
                    bytes[21..57].fill(0);
                    bytes
                });
                let what = format!("{n} {compression:?} {precision:?}: {} {}", plain.len(), ours.len());
                assert!(plain == ours && plain == carried, "{what} {}", carried.len());
            }
        }
    }
}

#[test]
fn half_precision_rounds_and_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("half.vdb");
    let level_set = sphere(Transform::uniform(0.1), 20.0);
    let half = WriteOptions { precision: Some(Precision::Half), ..WriteOptions::default() };
    vdb::write(&path, &[result(&level_set)], None, &half).unwrap();
    let file = open(&path).unwrap();
    assert_eq!(file.listing().grids[0].precision, Precision::Half);
    let read = file.read_level_set(None, false).unwrap();
    assert_eq!(read.band, Band::Regular, "{:?}", read.facts);
    let mut accessor = read.level_set.grid().accessor();
    for ijk in [IVec3::new(20, 0, 0), IVec3::new(0, -19, 3), IVec3::new(12, 12, 11)] {
        let (exact, _) = level_set.grid().voxel(ijk);
        assert!((accessor.value(ijk) - exact).abs() <= exact.abs() / 2048.0, "{ijk}");
    }
    // Kept where nothing else is asked.
    let again = folder.path().join("again.vdb");
    let grid = GridToWrite { level_set: &read.level_set, name: None, replaces: Some(0) };
    vdb::write(&again, &[grid], Some(&file), &WriteOptions::default()).unwrap();
    let kept = open(&again).unwrap();
    assert_eq!(kept.listing().grids[0].precision, Precision::Half);
    assert_eq!(kept.fingerprint(0).unwrap(), file.fingerprint(0).unwrap());
}

#[test]
fn grids_of_one_name_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("names.vdb");
    let spheres = [5.0, 7.0, 9.0].map(|r| sphere(Transform::uniform(0.1), r));
    let grids: Vec<_> = spheres.iter().map(|s| GridToWrite { level_set: s, name: Some("s"), replaces: None }).collect();
    vdb::write(&path, &grids, None, &WriteOptions::default()).unwrap();
    let file = open(&path).unwrap();
    for (n, wanted) in spheres.iter().enumerate() {
        let read = file.read_level_set(Some(&format!("s[{n}]")), false).unwrap();
        assert_eq!(read.index, n);
        assert_same_grid(read.level_set.grid(), wanted.grid());
    }
    // Replacing the middle one leaves the others where they are.
    let small = sphere(Transform::uniform(0.1), 3.0);
    let edit = GridToWrite { level_set: &small, name: None, replaces: Some(1) };
    vdb::write(&path, &[edit], Some(&file), &WriteOptions::default()).unwrap();
    let back = open(&path).unwrap();
    assert_same_grid(back.read_level_set(Some("s[1]"), false).unwrap().level_set.grid(), small.grid());
    assert_eq!(back.fingerprint(0).unwrap(), file.fingerprint(0).unwrap());
    assert_eq!(back.fingerprint(2).unwrap(), file.fingerprint(2).unwrap());
}

#[test]
fn a_write_that_fails_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let level_set = sphere(Transform::uniform(0.1), 5.0);
    let failure = |path: &Path| {
        let error = vdb::write(path, &[result(&level_set)], None, &WriteOptions::default()).unwrap_err();
        assert!(matches!(error, EditError::Output { .. }), "{error:?}");
        error.to_string()
    };
    assert!(failure(folder.path()).contains("directory"));
    failure(&folder.path().join("missing/out.vdb"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    if cfg!(target_os = "linux") {
        assert!(failure(Path::new("/dev/full")).contains("No space left"));
        // A folder in which nothing can be made, whoever runs the test.
        failure(Path::new("/proc/out.vdb"));
    }
}

#[cfg(unix)]
#[test]
fn a_link_keeps_pointing_and_permissions_stay() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let (real, link) = (folder.path().join("real.vdb"), folder.path().join("link.vdb"));
    std::fs::write(&real, "old").unwrap();
    std::fs::set_permissions(&real, std::fs::Permissions::from_mode(0o640)).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    let level_set = sphere(Transform::uniform(0.1), 5.0);
    vdb::write(&link, &[result(&level_set)], None, &WriteOptions::default()).unwrap();
    assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
    assert_eq!(std::fs::metadata(&real).unwrap().permissions().mode() & 0o777, 0o640);
    assert_eq!(vdb::list(&real).unwrap().grids.len(), 1);
}

#[test]
fn bad_paths_are_input_errors() {
    let folder = tempfile::tempdir().unwrap();
    assert!(input_error(open(folder.path())).contains("directory"));
    assert!(input_error(open(folder.path().join("none.vdb"))).contains("cannot be opened"));
    let empty = folder.path().join("empty.vdb");
    std::fs::write(&empty, "").unwrap();
    assert!(input_error(vdb::list(&empty)).contains("empty"));
}

#[test]
fn a_file_over_the_memory_limit_is_refused_before_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vdb");
    let level_set = sphere(Transform::uniform(0.1), 20.0);
    vdb::write(&path, &[result(&level_set)], None, &WriteOptions::default()).unwrap();
    let limited = |bytes| {
        let mut run = RunOptions::default();
        run.memory_limit = Some(bytes);
        vdb::open(&path, &run)
    };
    assert!(matches!(limited(100_000), Err(EditError::Memory { .. })));
    assert!(limited(100_000_000).is_ok());
}

#[cfg(unix)]
#[test]
fn pipes_are_read_and_written() {
    let folder = tempfile::tempdir().unwrap();
    let (pipe, copy) = (folder.path().join("pipe"), folder.path().join("copy.vdb"));
    if !std::process::Command::new("mkfifo").arg(&pipe).status().is_ok_and(|s| s.success()) {
        println!("skipped: mkfifo is not there");
        return;
    }
    let level_set = sphere(Transform::uniform(0.1), 12.0);
    std::thread::scope(|scope| {
        scope.spawn(|| vdb::write(&pipe, &[result(&level_set)], None, &WriteOptions::default()).unwrap());
        let piped = open(&pipe).unwrap();
        assert_same_grid(piped.read_level_set(None, false).unwrap().level_set.grid(), level_set.grid());
        vdb::write(&copy, &[], Some(&piped), &WriteOptions::default()).unwrap();
        // What went through the pipe can be read grid by grid like any file.
        assert!(piped.listing().has_offsets && vdb::list(&copy).unwrap().has_offsets);
    });
}

/// A band with all of the interior active, as Houdini makes it on request.
fn filled(radius: f64) -> LevelSet {
    let reach = IVec3::splat(radius as i32 + 8);
    let transform = Transform::uniform(0.1);
    // A half width as wide as the solid makes every voxel of it active.
    let wide = radius as f32 + 2.0;
    let distance = |p: DVec3| p.length() - radius;
    let solid = LevelSet::from_distance(transform, wide, (-reach, reach), distance, &RunOptions::default()).unwrap();
    let source = solid.grid();
    let origins: Vec<IVec3> = source.leaves().iter().map(|&id| source.origin(id)).collect();
    let mut grid = Grid::from_origins(0.3, &origins);
    grid.update_all(|id, values, mask| {
        // Fresh grids of the same leaves have the same slots.
        values.clone_from(source.values(id));
        for (offset, value) in values.0.iter_mut().enumerate() {
            mask.set(offset, *value < 0.3);
            *value = value.min(0.3);
        }
    });
    LevelSet::new(grid, transform)
}

#[test]
fn a_filled_interior_is_found_and_measured() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("filled.vdb");
    vdb::write(&path, &[result(&filled(12.0))], None, &WriteOptions::default()).unwrap();
    let read = open(&path).unwrap().read_level_set(None, false).unwrap();
    let Band::Trim { inner, outer } = read.band else { panic!("{:?}", read.band) };
    assert!((inner - 1.2).abs() < 1e-6 && (outer - 0.3).abs() < 1e-6, "{inner} {outer}");
    assert!(read.facts.inactive_inside.is_empty());
}
