//! Edits surfaces stored as narrow-band level sets.

#![warn(missing_docs)]

pub mod atomic;
#[cfg(feature = "cli")]
pub mod cli;
pub mod error;
pub mod grid;
pub mod levelset;
pub mod mesh;
pub mod ops;
pub mod pde;
pub mod region;
pub mod render;
pub mod run;
pub mod spec;
pub mod stencil;
#[cfg(feature = "openvdb")]
pub mod vdb;

pub use error::{EditError, Result};
pub use levelset::LevelSet;
