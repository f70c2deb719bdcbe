//! How long a morph and a reconstruction take.
//!
//! `cargo bench --bench sequences -- morph FROM TO [RESOLUTION]`: both meshes are scaled to a box of one size, and 24 frames written as `.vdb` to a
//! folder that is removed again. `cargo bench --bench sequences -- reconstruct SCANS [RESOLUTION]`: a set of range maps. `cargo bench --bench sequences -- room`: a room
//! of 300 x 150 x 180 voxels, seen by twelve noisy scanners with turning heads, in 32 steps.

use std::time::Instant;

use glam::{DAffine3, DQuat, DVec2, DVec3};
use vdb_edit::mesh::{self, MeshToLevelSet, TriangleMesh, mesh_to_level_set};
use vdb_edit::ops::morph::{Morph, Sequence};
use vdb_edit::ops::reconstruct::{Reconstruct, reconstruct};
use vdb_edit::ops::{Operator, WorldLength};
use vdb_edit::range::{Projection, RangeMap, RangeSet};
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
        ["room"] => room(),
        ["reconstruct", scans] => scans_at(scans, 256.0),
        ["reconstruct", scans, resolution] => scans_at(scans, resolution.parse()?),
        _ => Err("morph FROM TO [RESOLUTION], reconstruct SCANS [RESOLUTION], or room".into()),
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
    let sequence = Sequence::new(&shapes, &morph, &run, &mut |_| ())?;
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

fn scans_at(file: &str, resolution: f64) -> Result<()> {
    let began = Instant::now();
    let params = Reconstruct { scans: file.into(), resolution, ..Reconstruct::default() };
    let outcome = params.apply(Vec::new(), &RunOptions::default())?;
    println!(
        "{file} at {resolution}: {:.2} s, {} active voxels, {:?} steps",
        began.elapsed().as_secs_f64(),
        outcome.level_set.grid().active_voxels(),
        outcome.summary.steps
    );
    Ok(())
}

/// A hall of 9 x 4.4 x 5.2 with a table, a column and a ball; positive in the air.
fn hall(p: DVec3) -> f64 {
    let cuboid = |centre: DVec3, half: DVec3| {
        let q = (p - centre).abs() - half;
        q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
    };
    let walls = -cuboid(DVec3::ZERO, DVec3::new(4.5, 2.2, 2.6));
    let table = cuboid(DVec3::new(1.5, -1.2, 0.3), DVec3::new(0.9, 1.0, 0.6));
    let column = p.truncate().distance(DVec2::new(-1.8, 0.3)) - 0.4;
    let ball = p.distance(DVec3::new(-3.2, -1.4, 1.4)) - 0.7;
    walls.min(table).min(column).min(ball)
}

/// Nearly normal numbers that are the same everywhere: a sum of four.
fn noise(state: &mut u64) -> f64 {
    let mut uniform = || {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    };
    (uniform() + uniform() + uniform() + uniform()) * 3f64.sqrt()
}

fn room() -> Result<()> {
    const COLUMNS: usize = 600;
    const ROWS: usize = 270;
    const NOISE: f64 = 0.05;
    let mut state = 1;
    let mut maps = Vec::new();
    for n in 0..12 {
        let place = DVec3::new((n % 4) as f64 * 2.3 - 3.5, [1.2, 0.6, 1.6][n / 4], (n % 3) as f64 * 0.9 - 1.0);
        let step = DVec2::new(std::f64::consts::TAU / COLUMNS as f64, 2.8 / ROWS as f64);
        let projection = Projection::Spherical { first: DVec2::new(-3.0, -1.4), step };
        let pose = DAffine3::from_rotation_translation(DQuat::from_rotation_z(n as f64), place);
        let of_pixel = |at: usize| {
            let pixel = DVec2::new((at % COLUMNS) as f64, (at / COLUMNS) as f64);
            let direction = pose.transform_vector3(projection.point(pixel, 1.0));
            let mut t = 0.0;
            for _ in 0..100 {
                t += hall(place + direction * t);
            }
            (t + NOISE * noise(&mut state)) as f32
        };
        let ranges: Vec<f32> = (0..COLUMNS * ROWS).map(of_pixel).collect();
        let map = RangeMap::new(format!("scanner {n}"), projection, pose, COLUMNS, ranges);
        maps.push(RangeMap { noise: Some(NOISE), ..map });
    }
    let params = Reconstruct { voxel_size: Some(WorldLength::new(0.03)), iterations: 32, ..Reconstruct::default() };
    let set = RangeSet { maps, ..RangeSet::default() };
    let began = Instant::now();
    let outcome = reconstruct(set, &params, &RunOptions::default())?;
    let (lo, hi) = outcome.level_set.grid().active_bounds().unwrap_or_default();
    println!(
        "room of {:?} voxels: {:.2} s, {} active voxels, {:?} steps",
        (hi - lo + 1).to_array(),
        began.elapsed().as_secs_f64(),
        outcome.level_set.grid().active_voxels(),
        outcome.summary.steps
    );
    Ok(())
}
