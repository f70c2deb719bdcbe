//! Edits surfaces stored as narrow-band level sets.

#![warn(missing_docs)]

pub mod atomic;
pub mod error;
pub mod grid;
pub mod levelset;
pub mod mesh;
pub mod ops;
pub mod pde;
pub mod region;
pub mod run;
pub mod spec;
pub mod stencil;

pub use error::{EditError, Result};
pub use levelset::LevelSet;
