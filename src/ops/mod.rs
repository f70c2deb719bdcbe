//! The operators: one file each, and one registry that lists them all.
//!
//! An operator is a struct of parameters with plain public fields and a doc comment a field. That struct is the
//! library's argument and the options of the command; its field documentation is the help. The command line finds operators
//! in [`REGISTRY`] and knows nothing of any one of them.

pub mod compare;
pub mod csg;
mod curvature;
pub mod distance;
pub mod morphology;
mod params;
mod registry;
pub mod shape;
pub mod smooth;
pub mod smooth_csg;
mod solver;
pub mod transform;

pub use curvature::{CurvatureOptions, Preset};
pub use params::{Vector, VoxelLength, WorldLength};
pub use registry::{Arity, Entry, Operator, Outcome, Parameter, REGISTRY, Summary, find};
pub use solver::{EvolutionOptions, Like, RegionSpecs, Scheme};
