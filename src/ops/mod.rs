//! The operators: one file each, and one registry that lists them all.
//!
//! An operator is a struct of parameters with plain public fields and a doc comment a field. That struct is the
//! library's argument and the options of the command; its field documentation is the help. The command line finds operators
//! in [`REGISTRY`] and knows nothing of any one of them.

pub mod advect;
pub mod blend;
pub mod compare;
mod confine;
pub mod csg;
mod curvature;
pub mod distance;
pub mod emboss;
pub mod fillet;
pub mod morph;
pub mod morphology;
mod params;
pub mod reconstruct;
mod registry;
mod rolling;
pub mod segment;
mod sequence;
pub mod shape;
pub mod sharpen;
pub mod smooth;
pub mod smooth_csg;
mod solver;
pub mod sweep;
pub mod texture;
pub mod transform;
pub mod warp;

pub use curvature::{CurvatureOptions, Preset};
pub(crate) use params::words;
pub use params::{Vector, VoxelLength, WorldLength};
pub(crate) use registry::parse;
pub use registry::{Arity, Entry, Operator, Outcome, Parameter, ParameterSet, REGISTRY, Summary, find};
pub use sequence::{Sequence, SequenceOption};
pub use solver::{EvolutionOptions, Like, RegionSpecs, Scheme};
