//! Level sets from files of every kind that is understood, and into them: what commands and recipes share.
//!
//! Grids of a `.vdb` are verified, meshes converted; outputs are settled before any work and written at its end.

// Recipes need part of it, the command all of it.
#![cfg_attr(not(feature = "cli"), allow(dead_code, unused_imports))]

pub mod frames;
mod grids;
pub mod input;
pub mod mesh_output;
pub mod output;
#[cfg(feature = "openvdb")]
pub mod volume;
#[cfg(not(feature = "openvdb"))]
#[path = "volume_absent.rs"]
pub mod volume;
