//! How long a morph and a reconstruction take.
//!
//! `cargo bench --bench sequences -- morph FROM TO [RESOLUTION]`: both meshes are scaled to a box of one size, and 24 frames written as `.vdb` to a
//! folder that is removed again. `cargo bench --bench sequences -- reconstruct SCANS [RESOLUTION]`: a set of range maps.

use std::time::Instant;

use glam::DVec3;
use vdb_edit::mesh::{self, MeshToLevelSet, TriangleMesh, mesh_to_level_set};
use vdb_edit::ops::Operator;
use vdb_edit::ops::morph::{Morph, Sequence};
use vdb_edit::ops::reconstruct::Reconstruct;
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::{GridToWrite, WriteOptions, write};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    // Cargo adds --bench.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words.as_slice() {
        [] => morph("assets/spot.obj", "assets/teapot.ply", 256.0),
        ["morph", from, to] => morph(from, to, 256.0),
        ["morph", from, to, resolution] => morph(from, to, resolution.parse()?),
        ["reconstruct", scans] => reconstruct(scans, 256.0),
        ["reconstruct", scans, resolution] => reconstruct(scans, resolution.parse()?),
        _ => Err("morph FROM TO [RESOLUTION], or reconstruct SCANS [RESOLUTION]".into()),
    }
}

/// A mesh in the box from −1/2 to 1/2 along its longest side.
fn unit(file: &str) -> Result<TriangleMesh> {
    let mut mesh = mesh::read(file.as_ref())?.mesh;
    let (lo, hi) = mesh.bounding_box().ok_or("the mesh has no triangles")?;
    let (centre, size) = ((lo + hi) * 0.5, (hi - lo).max_element());
    mesh.positions.iter_mut().for_each(|p: &mut DVec3| *p = (*p - centre) / size);
    Ok(mesh)
}

fn morph(from: &str, to: &str, resolution: f64) -> Result<()> {
    let run = RunOptions::default();
    let meshes = [unit(from)?, unit(to)?];
    let folder = tempfile::tempdir()?;
    let began = Instant::now();
    let params = MeshToLevelSet::new(1.0 / resolution);
    let [a, b] = &meshes;
    let shapes = [mesh_to_level_set(a, &params, &run)?.0, mesh_to_level_set(b, &params, &run)?.0];
    let converted = began.elapsed();
    let morph = Morph::default();
    let sequence = Sequence::new(&shapes, &morph, &run)?;
    let planned = began.elapsed();
    let places = sequence.places();
    let report = sequence.frames(&places, &mut |n, level_set, _| {
        let grid = GridToWrite { level_set: &level_set, name: Some("surface"), replaces: None };
        write(folder.path().join(format!("{n:04}.vdb")), &[grid], None, &WriteOptions::default()).map(drop)
    })?;
    println!(
        "{from} to {to} at {resolution}: {:.2} s ({:.2} conversion, {:.2} distances), {} steps, {:?}",
        began.elapsed().as_secs_f64(),
        converted.as_secs_f64(),
        (planned - converted).as_secs_f64(),
        report.steps,
        report.ends
    );
    Ok(())
}

fn reconstruct(scans: &str, resolution: f64) -> Result<()> {
    let began = Instant::now();
    let params = Reconstruct { scans: scans.into(), resolution, ..Reconstruct::default() };
    let outcome = params.apply(Vec::new(), &RunOptions::default())?;
    println!(
        "{scans} at {resolution}: {:.2} s, {} active voxels, {:?} steps",
        began.elapsed().as_secs_f64(),
        outcome.level_set.grid().active_voxels(),
        outcome.summary.steps
    );
    Ok(())
}
