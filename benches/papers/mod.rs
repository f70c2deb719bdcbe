//! The rows of the papers' tables: the same operators on sub-volumes of the same size, beside OpenVDB's nearest tool in the same run.
//!
//! Operators are called by name with the parameters of the command line. A row without a counterpart in OpenVDB has none beside it: its masked curvature
//! flow stands in for blending and smoothing, with as many steps and an equal mask, its PDE offset for opening, its Gaussian for the anisotropic one.

use std::time::Instant;

use serde_json::{Map, Value, json};
use vdb_edit::grid::offset_to_local;
use vdb_edit::mesh::{self, MeshToLevelSet, mesh_to_level_set};
use vdb_edit::ops::find;
use vdb_edit::region::Region;
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::reference::{Csg, Filter, ReferenceGrid, ReferenceScheme, Tracker};
use vdb_edit::{LevelSet, ops};

use super::Result;

/// Runs of which the median is printed.
const RUNS: usize = 5;

/// What a row is measured against.
struct Row {
    name: &'static str,
    /// Voxels of the sub-volume.
    volume: [u32; 3],
    /// Seconds that it should take with two threads.
    target: f64,
    /// Seconds that the paper reports.
    paper: &'static str,
}

const FIRST: Tracker = Tracker { scheme: ReferenceScheme::First, runge_kutta: 1, normalizations: 1 };

/// Prints all rows; those whose operator is not there yet say so.
pub fn measure(threads: usize) -> Result<()> {
    rayon::ThreadPoolBuilder::new().num_threads(threads).use_current_thread().build_global()?;
    vdb_edit::vdb::set_threads(threads)?;
    println!("\n{threads} thread(s), OpenVDB {}\n", vdb_edit::vdb::library_version());
    println!("| row | sub-volume | ours, s (min–max of {RUNS}) | target, s | paper, s | OpenVDB, s | ratio |");
    println!("|---|---|---|---|---|---|---|");
    let run = RunOptions::default();
    for row in [paste, blend, smooth, emboss, opening] {
        if let Err(error) = row(&run) {
            println!("| not measured: {error} |");
        }
    }
    for rows in [box_and_torus, smoothing_against_opening] {
        if let Err(error) = rows(&run) {
            println!("| not measured: {error} |");
        }
    }
    Ok(())
}

fn values(value: Value) -> Map<String, Value> {
    value.as_object().cloned().unwrap_or_default()
}

/// Median, least and most of the seconds that `f` takes; what it works on is made anew by `fresh`, which does not count.
fn timed<T, R>(fresh: impl Fn() -> Result<T>, f: impl Fn(T) -> Result<R>) -> Result<[f64; 3]> {
    let mut times = Vec::new();
    for _ in 0..=RUNS {
        let input = fresh()?;
        let began = Instant::now();
        let made = f(input)?;
        times.push(began.elapsed().as_secs_f64());
        drop(made);
    }
    // The first run warms up.
    times.remove(0);
    times.sort_by(f64::total_cmp);
    Ok([times[RUNS / 2], times[0], times[RUNS - 1]])
}

/// An operator of the registry on copies of its inputs that share nothing with them.
fn ours(name: &str, parameters: Value, inputs: &[&LevelSet], run: &RunOptions) -> Result<[f64; 3]> {
    let entry = find(name)?;
    let fresh = || {
        let mut copies: Vec<LevelSet> = inputs.iter().map(|&input| input.clone()).collect();
        copies.iter_mut().for_each(|copy| copy.grid_mut().update_all(|_, _, _| ()));
        Ok(copies)
    };
    timed(fresh, |copies| Ok(entry.run(values(parameters.clone()), copies, run)?))
}

fn print(row: &Row, ours: [f64; 3], openvdb: Option<f64>) {
    let [x, y, z] = row.volume;
    let ([median, least, most], met) = (ours, if ours[0] <= row.target { "met" } else { "missed" });
    let (theirs, ratio) = match openvdb {
        Some(theirs) => (format!("{theirs:.4}"), format!("{:.1}", theirs / median)),
        None => ("none".into(), "–".into()),
    };
    println!(
        "| {} | {x} x {y} x {z} | {median:.4} ({least:.4}–{most:.4}) | {} {met} | {} | {theirs} | {ratio} |",
        row.name, row.target, row.paper
    );
}

/// A level set of an analytic solid; lengths in voxels.
fn shape(spec: &str, run: &RunOptions) -> Result<LevelSet> {
    let parameters = values(json!({ "spec": spec, "voxel_size": 1.0 }));
    Ok(find("shape")?.run(parameters, Vec::new(), run)?.level_set)
}

/// The bust of `assets`, `across` voxels along its longest axis; voxel size 1.
fn bust(across: f64, run: &RunOptions) -> Result<LevelSet> {
    let mut mesh = mesh::read("assets/nefertiti_70k.ply".as_ref())?.mesh;
    let (lo, hi) = mesh.bounding_box().ok_or("the mesh has no triangles")?;
    let scale = across / (hi - lo).max_element();
    mesh.positions.iter_mut().for_each(|p| *p = (*p - (lo + hi) / 2.0) * scale);
    Ok(mesh_to_level_set(&mesh, &MeshToLevelSet::new(1.0), run)?.0)
}

/// So many masked steps of OpenVDB's curvature flow, with the weights of a region on the whole grid.
fn masked_flow(level_set: &LevelSet, region: &str, steps: usize, run: &RunOptions) -> Result<f64> {
    let region = ops::RegionSpecs(vec![region.to_owned()]).on(level_set, run)?.ok_or("no region")?;
    let region: &dyn Region = &*region;
    let mut weights = level_set.clone();
    let (grid, transform) = (level_set.grid(), *level_set.transform());
    weights.grid_mut().update_all(|id, values, _| {
        for (at, value) in values.0.iter_mut().enumerate() {
            *value = region.weight(transform.voxel_to_world(grid.origin(id) + offset_to_local(at)));
        }
    });
    let mask = ReferenceGrid::from_level_set(&weights)?;
    let grid = ReferenceGrid::from_level_set(level_set)?;
    let flow = |mut grid: ReferenceGrid| -> Result<()> {
        for _ in 0..steps {
            grid.mean_curvature_masked(&mask, &FIRST)?;
        }
        Ok(())
    };
    Ok(timed(|| Ok(grid.duplicate()?), flow)?[0])
}

/// Two busts, one of them turned over, side by side: each sub-volume is that of the pasted model.
fn paste(run: &RunOptions) -> Result<()> {
    let row = Row { name: "paste (union)", volume: [316, 172, 215], target: 0.1, paper: "33" };
    let first = bust(316.0, run)?;
    let steps = json!({ "steps": ["rotate z,90", "translate 60,20,10"] });
    let second = find("transform")?.run(values(steps), vec![first.clone()], run)?.level_set;
    let times = ours("csg", json!({ "operation": "union" }), &[&first, &second], run)?;
    let (a, b) = (ReferenceGrid::from_level_set(&first)?, ReferenceGrid::from_level_set(&second)?);
    let theirs = timed(|| Ok(()), |()| Ok(a.csg(&b, Csg::Union)?))?[0];
    print(&row, times, Some(theirs));
    Ok(())
}

/// An elliptic column through a slanted slab: the curve where they meet, and 9 voxels around it, take 82 x 48 x 63.
fn blend(run: &RunOptions) -> Result<()> {
    let row = Row { name: "blend, 60 iterations", volume: [82, 48, 63], target: 0.1, paper: "98" };
    let column = shape("superellipsoid radii=32,15,110 exponents=0.1,1", run)?;
    let slab = shape("box size=260,200,60 center=0,0,-30 rotate=y,-35", run)?;
    let parameters = json!({ "iterations": 60, "d_min": 7, "d_max": 9, "curvature_low": [0.04, 0.06] });
    let times = ours("blend", parameters, &[&column, &slab], run)?;
    let united = find("csg")?.run(values(json!({})), vec![column.clone(), slab.clone()], run)?.level_set;
    let theirs = masked_flow(&united, "box size=82,48,63 soft=0.9,1", 60, run)?;
    print(&row, times, Some(theirs));
    Ok(())
}

/// A box of that size on the bust's face.
fn smooth(run: &RunOptions) -> Result<()> {
    let row = Row { name: "smooth, 10 iterations", volume: [60, 55, 31], target: 0.1, paper: "15" };
    let bust = bust(256.0, run)?;
    let region = format!("box size=60,55,31 center={} soft=0.9,1", highest(&bust)?);
    let times = ours("smooth", json!({ "iterations": 10, "region": region }), &[&bust], run)?;
    print(&row, times, Some(masked_flow(&bust, &region, 10, run)?));
    Ok(())
}

/// The voxel of the surface that is farthest along z, as text.
fn highest(level_set: &LevelSet) -> Result<String> {
    let grid = level_set.grid();
    let voxels = grid.leaves().iter().flat_map(|&id| {
        grid.mask(id)
            .iter()
            .filter(move |at| grid.values(id).0[*at].abs() < 0.5)
            .map(move |at| grid.origin(id) + offset_to_local(at))
    });
    let top = voxels.max_by_key(|v| (v.z, v.x, v.y)).ok_or("no surface")?;
    Ok(format!("{},{},{}", top.x, top.y, top.z))
}

/// One point six voxels above the bust draws the surface to it.
fn emboss(run: &RunOptions) -> Result<()> {
    let row = Row { name: "emboss, one point", volume: [21, 29, 29], target: 0.1, paper: "1.5" };
    let bust = bust(256.0, run)?;
    let top = highest(&bust)?;
    let numbers: Vec<f64> = top.split(',').map(str::parse).collect::<std::result::Result<_, _>>()?;
    let file = tempfile::Builder::new().suffix(".xyz").tempfile()?;
    std::fs::write(file.path(), format!("{} {} {}\n", numbers[0], numbers[1], numbers[2] + 6.0))?;
    let region = format!("box size=21,29,29 center={top} soft=0.9,1");
    let points = file.path().display().to_string();
    let times = ours("emboss", json!({ "points": points, "region": region }), &[&bust], run)?;
    print(&row, times, None);
    Ok(())
}

/// The whole bust, by three voxels.
fn opening(run: &RunOptions) -> Result<()> {
    let row = Row { name: "opening, 3 voxels", volume: [256, 246, 193], target: 0.4, paper: "22" };
    let bust = bust(256.0, run)?;
    let times = ours("open", json!({ "distance": "3vx" }), &[&bust], run)?;
    let grid = ReferenceGrid::from_level_set(&bust)?;
    let tracker = Tracker::default();
    let open = |mut grid: ReferenceGrid| {
        grid.apply(Filter::Offset(-3.0), &tracker)?;
        Ok(grid.apply(Filter::Offset(3.0), &tracker)?)
    };
    print(&row, times, Some(timed(|| Ok(grid.duplicate()?), open)?[0]));
    Ok(())
}

/// The thesis' union of a box and a torus, blended by both methods.
fn box_and_torus(run: &RunOptions) -> Result<()> {
    let bar = shape("box size=180,60,180", run)?;
    let ring = shape("torus major=48 minor=21 axis=y center=0,30,0", run)?;
    let united = find("csg")?.run(values(json!({})), vec![bar.clone(), ring.clone()], run)?.level_set;
    let region = "cylinder axis=y radius=78 height=42 center=0,30,0";
    let grid = ReferenceGrid::from_level_set(&united)?;
    let volume = [180, 81, 180];

    let row = Row { name: "box + torus, anisotropic σ 2, 3", volume, target: 0.2, paper: "72" };
    let filter = ours("blend", json!({ "method": "gaussian", "sigma": [2, 3] }), &[&bar, &ring], run);
    if let Ok(times) = &filter {
        let gaussian = |mut grid: ReferenceGrid| Ok(grid.apply(Filter::Gaussian(3), &FIRST)?);
        print(&row, *times, Some(timed(|| Ok(grid.duplicate()?), gaussian)?[0]));
    }
    let row = Row { name: "box + torus, curvature, 30 iterations", volume, target: 0.3, paper: "1851" };
    let flow = ours("blend", json!({ "method": "curvature", "iterations": 30 }), &[&bar, &ring], run)?;
    print(&row, flow, Some(masked_flow(&united, region, 30, run)?));
    let ratio = flow[0] / filter?[0];
    println!(
        "\nOf the two methods, the flow takes {ratio:.1} times as long as the filter (thesis: 1851 s / 72 s = 25.7)."
    );
    Ok(())
}

/// Table 5.3 of the thesis: noise smoothed away by the anisotropic Gaussian, and by an opening that reaches as far (three times three voxels are nine at
/// once). Its volume was 251 x 242 x 168, smoothed in 115 s and opened in 754 s.
fn smoothing_against_opening(run: &RunOptions) -> Result<()> {
    let volume = [251, 242, 168];
    let bust = bust(251.0, run)?;
    let grid = ReferenceGrid::from_level_set(&bust)?;
    let row = Row { name: "smoothing, anisotropic σ 1.5, 2.2", volume, target: 0.2, paper: "115" };
    let smoothed = ours("smooth", json!({ "method": "anisotropic", "sigma": [1.5, 2.2] }), &[&bust], run)?;
    let gaussian = |mut grid: ReferenceGrid| Ok(grid.apply(Filter::Gaussian(2), &FIRST)?);
    print(&row, smoothed, Some(timed(|| Ok(grid.duplicate()?), gaussian)?[0]));
    let row = Row { name: "opening, 9 voxels", volume, target: 1.3, paper: "754" };
    let opened = ours("open", json!({ "distance": "9vx" }), &[&bust], run)?;
    let tracker = Tracker::default();
    let open = |mut grid: ReferenceGrid| {
        grid.apply(Filter::Offset(-9.0), &tracker)?;
        Ok(grid.apply(Filter::Offset(9.0), &tracker)?)
    };
    print(&row, opened, Some(timed(|| Ok(grid.duplicate()?), open)?[0]));
    let ratio = opened[0] / smoothed[0];
    println!("\nThe opening takes {ratio:.1} times as long as the smoothing (thesis: 754 s / 115 s = 6.6).");
    Ok(())
}
