//! The command's view of `.vdb` files in a build without OpenVDB: every one is refused, with the reason.

use std::convert::Infallible;
use std::path::Path;

use glam::DVec3;
use serde_json::{Map, Value};

use super::output::VolumeOptions;
use crate::error::{EditError, Result};
use crate::levelset::{Field, LevelSet};
use crate::run::RunOptions;
use crate::scan::Inside;

const ABSENT: &str = "this vdb-edit was built without OpenVDB; build it with the feature `openvdb`";

/// An open `.vdb` file: there is none.
pub struct Volume(Infallible);

/// A level set of a file.
pub struct VolumeGrid {
    pub level_set: LevelSet,
    pub index: usize,
    pub selector: String,
    pub band: BandState,
}

/// What a band needs to be a regular one.
#[allow(dead_code)] // never made here, and matched on as in the build with OpenVDB
pub enum BandState {
    Regular,
    Trim { half_width: f32, what: String },
    Rebuild { what: String, gross: bool },
}

/// Which grid is meant.
#[derive(Clone, Copy)]
#[allow(dead_code)] // nothing is chosen here
pub struct Choice<'a> {
    pub grid: Option<&'a str>,
    pub assume_level_set: bool,
}

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

/// What a file says of itself, and its level sets.
pub struct Description {
    pub metadata: Map<String, Value>,
    pub format: String,
    pub grids: Vec<GridDescription>,
}

/// A grid of a file.
pub struct GridDescription {
    pub name: String,
    pub selector: String,
    pub value_type: String,
    pub class: String,
    pub voxel_size: DVec3,
    pub active_voxels: Option<u64>,
    pub bounds: Option<(DVec3, DVec3)>,
    pub storage: String,
    pub metadata: Map<String, Value>,
    pub level_set: Option<std::result::Result<VolumeGrid, String>>,
}

/// Refuses.
pub fn describe(path: &Path, _: Choice, _: &RunOptions) -> Result<Description> {
    Err(EditError::input(path, ABSENT))
}
