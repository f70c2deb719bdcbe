//! The flows of the papers' tables on sub-volumes of their sizes: `cargo bench --bench papers`. Medians of nine runs, one and two threads.

use std::time::Instant;

use vdb_edit::LevelSet;
use vdb_edit::ops::blend::{Blend, BlendMethod, blend};
use vdb_edit::ops::csg::{CsgOperation, csg};
use vdb_edit::ops::shape::Shape;
use vdb_edit::ops::smooth::{Smooth, smooth};
use vdb_edit::ops::{CurvatureOptions, EvolutionOptions, Operator, Preset, RegionSpecs, WorldLength};
use vdb_edit::run::RunOptions;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// A solid, a voxel a unit.
fn solid(spec: &str) -> Result<LevelSet> {
    let shape = Shape { spec: spec.into(), voxel_size: Some(WorldLength::new(1.0)), ..Shape::default() };
    Ok(shape.apply(vec![], &RunOptions::default())?.level_set)
}

fn median(mut once: impl FnMut() -> Result<String>) -> Result<(f64, String)> {
    let mut times = Vec::new();
    let mut said = String::new();
    for _ in 0..9 {
        let began = Instant::now();
        said = once()?;
        times.push(began.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    Ok((times[times.len() / 2], said))
}

fn main() -> Result<()> {
    let run = RunOptions::default();
    let steps = |iterations| EvolutionOptions { iterations: Some(iterations), ..EvolutionOptions::default() };
    // A wing on a body: 82 × 48 × 63 voxels.
    let (body, wing) =
        (solid("box center=0,0,-16 size=82,48,31 round=4")?, solid("cylinder radius=13 center=0,0,6 height=52")?);
    let (block, ring) = (solid("box size=180,60,180")?, solid("torus center=0,30,0 major=48 minor=21 axis=y")?);
    // Two bars that meet like a spout and its pot: 60 × 55 × 31 voxels.
    let spout = csg(
        &solid("capsule a=-22,0,0 b=22,0,0 radius=8")?,
        &[&solid("capsule a=0,0,0 b=8,38,0 radius=9")?],
        CsgOperation::Union,
        &run,
    )?;
    println!("| operation | threads | ms | |\n|---|---|---|---|");
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let blending = |a: &LevelSet, b: &LevelSet, method, iterations| {
            pool.install(|| {
                median(|| {
                    let params = Blend { method, evolution: steps(iterations), ..Blend::default() };
                    Ok(format!("{:?}", blend(a, b, &params, &run)?.1))
                })
            })
        };
        let row = |name: &str, (ms, said): (f64, String)| println!("| {name} | {threads} | {ms:.1} | {said} |");
        row("blend 82×48×63, 60 iterations", blending(&body, &wing, BlendMethod::Curvature, 60)?);
        row("the same as a fillet", blending(&body, &wing, BlendMethod::Fillet, 60)?);
        row(
            "blend box 180×60×180 and torus 138×42×138, 30 iterations",
            blending(&block, &ring, BlendMethod::Curvature, 30)?,
        );
        row(
            "smooth 60×55×31 in a region, 30 iterations",
            pool.install(|| {
                median(|| {
                    let flow = CurvatureOptions { preset: Some(Preset::SpoutSmoothing), ..CurvatureOptions::default() };
                    let region = RegionSpecs(vec!["superellipsoid center=2,10,0 radii=30,28,16".into()]);
                    let params =
                        Smooth { flow, evolution: EvolutionOptions { region, ..steps(30) }, ..Smooth::default() };
                    let mut level_set = spout.clone();
                    Ok(format!("{} voxels", smooth(&mut level_set, &params, &run)?.voxels))
                })
            })?,
        );
    }
    Ok(())
}
