//! Files of points, as regions take them.
#![no_main]

use std::sync::LazyLock;

use file::{run, with_file};
use libfuzzer_sys::fuzz_target;
use vdb_edit::LevelSet;
use vdb_edit::ops::{RegionSpecs, find};

/// A small ball.
static BALL: LazyLock<LevelSet> = LazyLock::new(|| {
    let values = [("spec", "sphere radius=6"), ("voxel_size", "1")];
    let values = values.into_iter().map(|(key, value)| (key.to_owned(), value.into())).collect();
    find("shape").expect("in the list").run(values, Vec::new(), &run()).expect("a ball").level_set
});

fuzz_target!(|data: &[u8]| {
    with_file(data, &["txt", "csv", "xyz", "ply", "obj"], |path, _| {
        let region = RegionSpecs(vec![format!("points file={} d=1,3", path.display())]);
        drop(region.on(&BALL, &run()));
    });
});
