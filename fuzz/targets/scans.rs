//! Volumes of scanners.
#![no_main]

use file::{run, with_file};
use libfuzzer_sys::fuzz_target;
use vdb_edit::scan::Scan;

fuzz_target!(|data: &[u8]| {
    with_file(data, &["nrrd", "nii"], |path, _| drop(Scan::read(path, &run())));
});
