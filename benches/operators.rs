//! Every operator beside OpenVDB's own tool, as `crosscheck` does it, printed as the tables of docs/PERFORMANCE.md.
//!
//! `cargo bench --bench operators -- [MESH [RESOLUTION...]]`; without arguments a model of `assets/` at 256 voxels. One and
//! two threads, each measured in a process of its own. `-- papers` prints the rows of the papers' tables instead.

#[path = "papers/mod.rs"]
mod papers;

use std::process::Command;

use vdb_edit::crosscheck::{Row, crosscheck};
use vdb_edit::mesh::{self, MeshToLevelSet, mesh_to_level_set};
use vdb_edit::run::RunOptions;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    // Cargo adds --bench.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["--threads", threads, file, resolution] => measure(file, resolution.parse()?, threads.parse()?),
        ["papers"] => papers::measure(2),
        [] => compare("assets/nefertiti_70k.ply", &["256"]),
        [file] => compare(file, &["256"]),
        [file, resolutions @ ..] => compare(file, resolutions),
    }
}

/// The number of threads of a process is set once: every table is made by a process of its own.
fn compare(file: &str, resolutions: &[&str]) -> Result<()> {
    for resolution in resolutions {
        for threads in ["1", "2"] {
            let status =
                Command::new(std::env::current_exe()?).args(["--threads", threads, file, resolution]).status()?;
            if !status.success() {
                return Err(format!("{file} at {resolution} voxels with {threads} threads: {status}").into());
            }
        }
    }
    Ok(())
}

fn measure(file: &str, resolution: u32, threads: usize) -> Result<()> {
    rayon::ThreadPoolBuilder::new().num_threads(threads).use_current_thread().build_global()?;
    vdb_edit::vdb::set_threads(threads)?;
    let run = RunOptions::default();
    let mesh = mesh::read(file.as_ref())?.mesh;
    let (lo, hi) = mesh.bounding_box().ok_or("the mesh has no triangles")?;
    let voxel_size = (hi - lo).max_element() / f64::from(resolution);
    let (level_set, _) = mesh_to_level_set(&mesh, &MeshToLevelSet::new(voxel_size), &run)?;
    println!(
        "\n{file}, {resolution} voxels, {} active, {threads} thread(s), OpenVDB {}\n",
        level_set.grid().active_voxels(),
        vdb_edit::vdb::library_version(),
    );
    println!("| operator | scheme | ours, ms | OpenVDB, ms | ratio (min–max) | largest difference, voxels |");
    println!("|---|---|---|---|---|---|");
    crosscheck(&level_set, Some(&mesh), &[], &run, print)?;
    Ok(())
}

fn print(row: &Row) {
    let theirs = row.openvdb_max_error_voxels.map(|e| format!(" (OpenVDB {e:.1e})")).unwrap_or_default();
    println!(
        "| {} | {} | {:.2} | {:.2} | {:.1} ({:.1}–{:.1}) | {:.1e}{theirs} |",
        row.operator,
        row.scheme,
        row.ours_ms,
        row.openvdb_ms,
        row.ratio,
        row.ratio_min,
        row.ratio_max,
        row.max_diff_voxels
    );
}
