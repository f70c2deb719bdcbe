//! What is known of the grids of a `.vdb` file, with OpenVDB and without.

use glam::DVec3;
use serde_json::{Map, Value};

use crate::levelset::LevelSet;

/// A level set of a file, as it was read.
pub struct VolumeGrid {
    /// The level set; its band may have to be made regular first.
    pub level_set: LevelSet,
    /// Its place in the file.
    pub index: usize,
    /// How it is selected.
    pub selector: String,
    /// What its band needs.
    pub band: BandState,
}

/// What a band needs to be a regular one.
#[cfg_attr(not(feature = "openvdb"), allow(dead_code))] // no file is read there
pub enum BandState {
    /// Nothing.
    Regular,
    /// To be cut to this half width.
    Trim { half_width: f32, what: String },
    /// To be made anew; `gross` if the values may be no distances at all.
    Rebuild { what: String, gross: bool },
}

/// Whether grids of this class may be taken for level sets, and which one is meant.
#[derive(Clone, Copy)]
#[cfg_attr(not(feature = "openvdb"), allow(dead_code))] // and nothing chosen
pub struct Choice<'a> {
    pub grid: Option<&'a str>,
    pub assume_level_set: bool,
}

/// What a file says of itself, and its level sets.
pub struct Description {
    /// As JSON.
    pub metadata: Map<String, Value>,
    /// Format and library.
    pub format: String,
    /// Its grids.
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
    /// Its level set, the reason why it cannot be read as one, or `None` if it does not claim to be one.
    pub level_set: Option<std::result::Result<VolumeGrid, String>>,
}
