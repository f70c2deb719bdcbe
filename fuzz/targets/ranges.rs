//! Range maps and what describes them.
#![no_main]

use file::{run, with_file};
use libfuzzer_sys::fuzz_target;
use vdb_edit::range::RangeSet;

fuzz_target!(|data: &[u8]| {
    with_file(data, &["ptx", "toml", "conf", "e57"], |path, _| drop(RangeSet::read(path, true, &run())));
});
