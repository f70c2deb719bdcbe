//! The command's view of `.vdb` files in a build without OpenVDB: every one is refused, with the reason.

use std::convert::Infallible;
use std::path::Path;

pub use super::grids::{BandState, Choice, Description, GridDescription, VolumeGrid};
use super::output::VolumeOptions;
use crate::error::{EditError, Result};
use crate::levelset::{Field, LevelSet};
use crate::run::RunOptions;
use crate::scan::Inside;

const ABSENT: &str = "this vdb-edit was built without OpenVDB; build it with the feature `openvdb`";

/// An open `.vdb` file: there is none.
pub struct Volume(Infallible);

/// Refuses.
pub fn open(path: &Path, _: &RunOptions) -> Result<Volume> {
    Err(EditError::input(path, ABSENT))
}

/// Refuses.
pub fn probe(path: &Path, _: Choice) -> Result<String> {
    Err(EditError::input(path, ABSENT))
}

/// There is no other pool of threads.
pub fn set_threads(_: usize) -> Result<()> {
    Ok(())
}

/// Asked for where OpenVDB has left much behind.
pub fn trim_heap() {}

impl Volume {
    pub fn take(&mut self, _: Choice) -> Result<VolumeGrid> {
        match self.0 {}
    }

    pub fn read(&self, _: Choice) -> Result<VolumeGrid> {
        match self.0 {}
    }

    pub fn read_iso_field(&self, _: Option<&str>, _: f32, _: Inside, _: &RunOptions) -> Result<LevelSet> {
        match self.0 {}
    }

    pub fn has_level_set(&self, _: Choice) -> bool {
        match self.0 {}
    }

    pub fn warnings(&self) -> &[String] {
        match self.0 {}
    }
}

/// Refuses.
pub fn write(
    path: &Path,
    _: &LevelSet,
    _: Option<&[Field; 3]>,
    _: Option<(&Volume, Option<usize>)>,
    _: &VolumeOptions,
) -> Result<(u64, Vec<String>)> {
    Err(EditError::output(path, ABSENT))
}

/// A field on its way to a file.
#[allow(dead_code)] // nothing is written without OpenVDB
pub struct FieldToWrite<'a> {
    pub field: &'a Field,
    pub name: &'a str,
}

/// Refuses.
pub fn write_field(path: &Path, _: &LevelSet, _: FieldToWrite, _: Option<&Volume>) -> Result<(u64, Vec<String>)> {
    Err(EditError::output(path, ABSENT))
}

/// Refuses.
pub fn describe(path: &Path, _: Choice, _: &RunOptions) -> Result<Description> {
    Err(EditError::input(path, ABSENT))
}
