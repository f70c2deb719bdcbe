//! Level sets from files of every kind that is understood, and into them: what commands and recipes share.
//!
//! Grids of a `.vdb` are verified, meshes converted; outputs are settled before any work and written at its end.

pub mod frames;
pub mod input;
pub mod mesh_output;
pub mod output;
#[cfg(feature = "openvdb")]
pub mod volume;
#[cfg(not(feature = "openvdb"))]
#[path = "volume_absent.rs"]
pub mod volume;
