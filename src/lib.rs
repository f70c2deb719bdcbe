//! Edits surfaces stored as narrow-band level sets.
//!
//! A [`LevelSet`] holds the signed distance φ to a surface in a band of voxels around it: world units, negative inside. It comes
//! from a mesh file ([`mesh`]), an analytic solid ([`ops::shape`]) or a `.vdb` file (`vdb`, with the feature `openvdb`), is
//! changed by operators ([`ops`]), and goes out as a `.vdb`, a mesh or a picture ([`render`]).
//!
//! ```
//! use vdb_edit::mesh::{self, level_set_to_mesh};
//! use vdb_edit::ops::shape::Shape;
//! use vdb_edit::ops::smooth::{Smooth, smooth};
//! use vdb_edit::ops::{EvolutionOptions, Operator, RegionSpecs, WorldLength};
//! use vdb_edit::run::RunOptions;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("bar.ply");
//! let run = RunOptions::default();
//!
//! // A bar of 40 × 20 × 20 voxels; lengths are in world units.
//! let bar = Shape { spec: "box size=2,1,1".into(), voxel_size: Some(WorldLength::new(0.05)), ..Shape::default() };
//! let mut level_set = bar.apply(vec![], &run)?.level_set;
//! let before = level_set.measure(&run)?;
//!
//! // Smoothed by mean curvature flow, inside a sphere around one end.
//! let region = RegionSpecs(vec!["sphere center=1,0,0 radius=0.8".into()]);
//! let evolution = EvolutionOptions { iterations: Some(20), region, ..EvolutionOptions::default() };
//! let report = smooth(&mut level_set, &Smooth { evolution, ..Smooth::default() }, &run)?;
//! assert_eq!(report.steps, 20);
//!
//! // Still a level set, with less area, and written as a closed mesh.
//! assert_eq!(level_set.check(), []);
//! assert!(level_set.measure(&run)?.area < before.area);
//! mesh::write(&path, &level_set_to_mesh(&level_set, 0.0, &run)?)?;
//! # assert_eq!(mesh::read(&path)?.warnings, [""; 0]);
//! # Ok(())
//! # }
//! ```
//!
//! # Modules, from the ground up
//!
//! A module uses only what is named before it or beside it.
//!
//! | module | holds |
//! |---|---|
//! | [`error`], [`run`] | what can go wrong; cancellation, progress and the memory limit |
//! | [`atomic`], [`spec`] | files that appear whole or not at all; the one-line grammar of shapes and regions |
//! | [`rbf`] | interpolation by radial basis functions |
//! | [`grid`] | sparse storage: leaves of 8³ voxels, their active masks, the sign everywhere else |
//! | [`stencil`] | finite differences: gathering, curvature, upwind gradients, instruction sets |
//! | [`levelset`] | [`LevelSet`]: band, invariants, measures, sampling, analytic solids |
//! | [`region`] | where an operator acts, and how strongly |
//! | [`pde`] | time stepping: flows, renormalisation, tracking of the band |
//! | [`mesh`] | triangle meshes: files, to a level set and back, exact rebuilding |
//! | [`texture`] | the space above a patch of a surface, and solids wrapped into it |
//! | [`scan`] | scans (NRRD, NIfTI), the surfaces in them, segmentation |
//! | [`range`] | range maps: what scanners measured along rays |
//! | `vdb` | OpenVDB files and OpenVDB's own tools as a reference (feature `openvdb`) |
//! | [`render`] | pictures |
//! | [`ops`] | the operators and their registry |
//! | [`recipe`] | whole editing sessions from TOML files |
//! | `crosscheck` | our operators beside OpenVDB's, timed and compared (feature `openvdb`) |
//! | `cli` | the command (feature `cli`) |
//!
//! # What holds everywhere
//!
//! - φ is in world units, `f32`, negative inside; lengths in voxels say so in their documentation.
//! - Results have the same bits for every number of threads and every instruction set.
//! - Every error is an [`EditError`] that names the operation or file, the value, and what would be accepted. Malformed input
//!   is an error, not a panic.
//! - Nothing below `cli` prints.

#![warn(missing_docs)]

pub mod atomic;
mod awake;
#[cfg(feature = "cli")]
pub mod cli;
#[cfg(feature = "openvdb")]
pub mod crosscheck;
pub mod error;
pub(crate) mod files;
pub mod grid;
pub mod levelset;
pub mod mesh;
pub mod ops;
pub mod pde;
pub mod range;
pub mod rbf;
pub mod recipe;
pub mod region;
pub mod render;
pub mod run;
pub mod scan;
pub mod spec;
pub mod stencil;
pub mod texture;
#[cfg(feature = "openvdb")]
pub mod vdb;

pub use error::{EditError, Result};
pub use levelset::LevelSet;

// The examples of the documents are compiled and run with the tests.
#[cfg(doctest)]
mod documents {
    #[doc = include_str!("../README.md")]
    mod readme {}
    #[doc = include_str!("../docs/ADDING_AN_OPERATOR.md")]
    mod adding_an_operator {}
}
