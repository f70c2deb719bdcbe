//! Cost and memory as grids grow: nanoseconds an active voxel, and the most that an operator holds beside its input.
//!
//! `cargo bench --bench scale -- [VOXELS_ACROSS...]`; without arguments spheres of 256, 512 and 1024 voxels across (1, 4 and
//! 17 million active ones). Memory is what the allocator has handed out, counted by the allocator itself.

use std::time::Instant;

use peak_alloc::PeakAlloc;
use vdb_edit::LevelSet;
use vdb_edit::mesh::{Rebuild, level_set_to_mesh, rebuild};
use vdb_edit::ops::csg::{CsgOperation, csg};
use vdb_edit::ops::morphology::offset;
use vdb_edit::ops::shape::Shape;
use vdb_edit::ops::smooth::{Smooth, SmoothMethod, smooth};
use vdb_edit::ops::{EvolutionOptions, Operator, Scheme, WorldLength};
use vdb_edit::pde::{SolverOptions, renormalize, track};
use vdb_edit::run::RunOptions;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Runs of which the median is printed.
const RUNS: usize = 5;

fn main() -> Result<()> {
    let mut sizes = Vec::new();
    for word in std::env::args().skip(1).filter(|a| a != "--bench") {
        sizes.push(word.parse::<u32>().map_err(|e| format!("`{word}`: {e}; a number of voxels such as 512"))?);
    }
    if sizes.is_empty() {
        sizes = vec![256, 512, 1024];
    }
    println!("{} threads\n", rayon::current_num_threads());
    println!("| operator | active voxels | ms | ns a voxel | memory beside the input, bytes a voxel |");
    println!("|---|---|---|---|---|");
    sizes.into_iter().try_for_each(measure)
}

fn measure(across: u32) -> Result<()> {
    let run = RunOptions::default();
    let level_set = sphere(across, &run)?;
    let before = MEMORY.current_usage();
    drop(sphere(across, &run)?);
    row("shape", &level_set, before, || sphere(across, &run))?;
    let one_step = |method, scheme| Smooth {
        method,
        evolution: EvolutionOptions { iterations: Some(1), scheme: Some(scheme), ..EvolutionOptions::default() },
        ..Smooth::default()
    };
    in_place("smooth, curvature, first order, one step", &level_set, |grid| {
        Ok(smooth(grid, &one_step(SmoothMethod::Curvature, Scheme::First), &run).map(drop)?)
    })?;
    in_place("smooth, curvature, WENO5, one step", &level_set, |grid| {
        Ok(smooth(grid, &one_step(SmoothMethod::Curvature, Scheme::Weno5), &run).map(drop)?)
    })?;
    in_place("renormalize, first order", &level_set, |grid| Ok(renormalize(grid, &SolverOptions::FIRST_ORDER, &run)?))?;
    in_place("track, first order", &level_set, |grid| Ok(track(grid, &SolverOptions::FIRST_ORDER, &run)?))?;
    row("csg union with itself", &level_set, MEMORY.current_usage(), || {
        Ok(csg(&level_set, &[&level_set.clone()], CsgOperation::Union, &run)?)
    })?;
    row("rebuild", &level_set, MEMORY.current_usage(), || Ok(rebuild(&level_set, &Rebuild::band(3.0), &run)?))?;
    row("offset by a voxel", &level_set, MEMORY.current_usage(), || {
        Ok(offset(&level_set, level_set.voxel_size(), &run)?)
    })?;
    row("to mesh", &level_set, MEMORY.current_usage(), || Ok(level_set_to_mesh(&level_set, 0.0, &run)?))
}

fn sphere(across: u32, run: &RunOptions) -> Result<LevelSet> {
    let voxel_size = Some(WorldLength::new(2.0 / f64::from(across)));
    let shape = Shape { spec: "sphere radius=1".into(), voxel_size, ..Shape::default() };
    Ok(shape.apply(Vec::new(), run)?.level_set)
}

/// An operator that changes a copy, which shares nothing with the original.
fn in_place(name: &str, level_set: &LevelSet, operator: impl Fn(&mut LevelSet) -> Result<()>) -> Result<()> {
    let mut times = Vec::new();
    let mut peak = 0;
    for _ in 0..RUNS {
        let mut copy = level_set.clone();
        copy.grid_mut().update_all(|_, _, _| ());
        let before = MEMORY.current_usage();
        MEMORY.reset_peak_usage();
        let began = Instant::now();
        operator(&mut copy)?;
        times.push(began.elapsed().as_secs_f64());
        peak = peak.max(MEMORY.peak_usage().saturating_sub(before));
    }
    print(name, level_set, times, peak);
    Ok(())
}

/// An operator that makes something new; `before` is what was in use without it.
fn row<T>(name: &str, level_set: &LevelSet, before: usize, operator: impl Fn() -> Result<T>) -> Result<()> {
    let mut times = Vec::new();
    let mut peak = 0;
    for _ in 0..RUNS {
        MEMORY.reset_peak_usage();
        let began = Instant::now();
        let made = operator()?;
        times.push(began.elapsed().as_secs_f64());
        drop(made);
        peak = peak.max(MEMORY.peak_usage().saturating_sub(before));
    }
    print(name, level_set, times, peak);
    Ok(())
}

fn print(name: &str, level_set: &LevelSet, mut times: Vec<f64>, peak: usize) {
    times.sort_by(f64::total_cmp);
    let (seconds, voxels) = (times[times.len() / 2], level_set.grid().active_voxels() as f64);
    println!(
        "| {name} | {voxels} | {:.2} | {:.2} | {:.1} |",
        seconds * 1e3,
        seconds * 1e9 / voxels,
        peak as f64 / voxels
    );
}
