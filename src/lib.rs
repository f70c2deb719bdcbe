//! Edits surfaces stored as narrow-band level sets.

#![warn(missing_docs)]

pub mod error;
pub mod grid;
pub mod levelset;
pub mod mesh;
pub mod run;
#[cfg(feature = "openvdb")]
pub mod vdb;

pub use error::{EditError, Result};
pub use levelset::LevelSet;
