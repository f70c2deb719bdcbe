//! What is typed on the command line: lengths, vectors, rotations, frames, shapes, expressions, regions.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vdb_edit::levelset::expression::Expression;
use vdb_edit::levelset::shapes::Solid;
use vdb_edit::ops::{Vector, VoxelLength, WorldLength};
use vdb_edit::recipe::parse_frames;
use vdb_edit::region::RegionPlan;
use vdb_edit::spec::parse_rotation;

fuzz_target!(|text: &str| {
    let _ = (text.parse::<VoxelLength>(), text.parse::<WorldLength>(), text.parse::<Vector>());
    let _ = (parse_rotation(text), parse_frames(text));
    let _ = (Solid::parse(text), Expression::parse(text));
    let _ = RegionPlan::parse(&text.split('\n').map(str::to_owned).collect::<Vec<_>>());
});
