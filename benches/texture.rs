//! Texturing: patch set-up, vertices a second of the semi-implicit map, and the inverse and implicit maps with the repair to a distance, at several
//! resolutions of the base: what grows with the texture's surface doubles its voxels by four, what grows with the space by eight.
//!
//! `cargo bench --bench texture -- [RADIUS:PARTICLES...]`, radii of a ball in voxels. The global evaluation of the radial basis functions is timed on a
//! hundredth of the voxels above the patch.

use std::hint::black_box;
use std::time::Instant;

use glam::DVec3;
use rayon::prelude::*;
use vdb_edit::LevelSet;
use vdb_edit::mesh::level_set_to_mesh;
use vdb_edit::ops::shape::Shape;
use vdb_edit::ops::{Operator, WorldLength};
use vdb_edit::rbf::{Basis, Interpolant};
use vdb_edit::run::RunOptions;
use vdb_edit::texture::{Laying, Map, Parameterization, Patch, Rbf, Sampling, Source, warped, wrapped};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    let mut cases = Vec::new();
    for word in std::env::args().skip(1).filter(|a| a != "--bench") {
        let case = word.split_once(':').and_then(|(r, n)| Some((r.parse::<f64>().ok()?, n.parse::<u32>().ok()?)));
        cases.push(
            case.ok_or_else(|| format!("`{word}`: a radius in voxels and a number of particles, such as 115:280"))?,
        );
    }
    if cases.is_empty() {
        // Those of 280 and the last have the sizes of Brodersen et al. 2007: 4 and 30 million voxels.
        cases = vec![(60.0, 400), (120.0, 280), (120.0, 400), (240.0, 400)];
    }
    println!("{} threads\n", rayon::current_num_threads());
    println!(
        "| million voxels around the patch | particles | active voxels of the result | patch, ms | semi-implicit, million vertices/s | inverse, ms | implicit, ms | kernel sums near | kernel sums everywhere | those, ms |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let mut times = Vec::new();
    for (radius, particles) in cases {
        times.push((radius, particles, measure(radius, particles)?));
    }
    let most = times.iter().map(|t| t.1).max();
    times.retain(|t| Some(t.1) == most);
    for pair in times.windows(2) {
        let [(a, _, s), (b, _, t)] = [pair[0], pair[1]];
        let power = (t / s).ln() / (b / a).ln();
        println!("\nfrom {a} to {b}: the time of the implicit map grows with the resolution to the power {power:.2}");
    }
    Ok(())
}

fn shape(spec: &str, voxel_size: f64, run: &RunOptions) -> Result<LevelSet> {
    let params = Shape { spec: spec.into(), voxel_size: Some(WorldLength::new(voxel_size)), ..Shape::default() };
    Ok(params.apply(vec![], run)?.level_set)
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let began = Instant::now();
    let result = work();
    (result, began.elapsed().as_secs_f64() * 1e3)
}

/// Milliseconds of the implicit map.
fn measure(radius: f64, particles: u32) -> Result<f64> {
    let run = RunOptions::default();
    let ball = shape("sphere radius=1", 1.0 / radius, &run)?;
    // A ring that stands on the patch, as fine as the base.
    let ring = shape("torus major=0.35 minor=0.12", 0.5 / radius, &run)?;
    let corners = [(-0.6, -0.6), (0.6, -0.6), (0.6, 0.6), (-0.6, 0.6)];
    let corners = corners.map(|(x, y)| DVec3::new(x, y, 1.0).normalize());
    let (patch, setup) = timed(|| Patch::between(&ball, corners, 0.5, &Parameterization::Conforming, &run));
    let patch = patch?;
    let laying = Laying { tile: [1, 1], push: 1.0, map: Map::Inverse, sampling: Sampling::Linear };
    let mut source = Source::new(ring.clone(), &run)?;
    let mesh = level_set_to_mesh(&ring, 0.0, &run)?;
    let bounds = mesh.bounding_box().ok_or("a texture")?;
    let (moved, forwards) = timed(|| warped(&mesh, bounds, &ball, &patch, &laying));
    let speed = moved.positions.len() as f64 / forwards / 1e3;
    let (inverse, inverse_ms) = timed(|| wrapped(&ball, &mut source, &patch, &laying, &run));
    let rbf = Rbf { basis: Basis::Linear, lambda: [0.005, 0.3], particles };
    let with = Laying { map: Map::Implicit(rbf), ..laying };
    let (implicit, implicit_ms) = timed(|| wrapped(&ball, &mut source, &patch, &with, &run));
    let [near, everywhere] = implicit?.kernels.unwrap_or_default();
    // Any particles cost the same.
    let all = patch.particles().places;
    let some: Vec<_> = all.iter().step_by((all.len() / particles as usize).max(1)).copied().collect();
    let (places, values): (Vec<DVec3>, Vec<DVec3>) = some.into_iter().unzip();
    let sum = Interpolant::new(&places, &values, |_| 0.3, Basis::Linear, 10.0).ok_or("particles apart")?;
    let box_of = |pick: fn(DVec3, DVec3) -> DVec3| all.iter().map(|(p, _)| *p).reduce(pick).unwrap_or_default();
    let voxels = (box_of(DVec3::max) - box_of(DVec3::min)).element_product() / 1e6;
    let hundredth = everywhere / 100 / sum.len() as u64;
    let (_, hundredth) = timed(|| {
        (0..hundredth).into_par_iter().for_each(|k| {
            black_box(sum.at(DVec3::splat(k as f64 * 1e-3)));
        });
    });
    println!(
        "| {voxels:.1} | {particles} | {} | {setup:.0} | {speed:.1} | {inverse_ms:.0} | {implicit_ms:.0} | {near} | {everywhere} | {:.0} |",
        inverse?.level_set.grid().active_voxels(),
        hundredth * 100.0
    );
    Ok(implicit_ms)
}
