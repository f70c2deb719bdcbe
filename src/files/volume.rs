//! The command's view of `.vdb` files: one open file, its level sets, and what it says of itself.

use std::path::Path;

use glam::DVec3;
use serde_json::{Map, Value, json};

pub use super::grids::{BandState, Choice, Description, GridDescription, VolumeGrid};
use super::output::VolumeOptions;
use crate::error::{EditError, Result};
use crate::levelset::{Field, LevelSet};
use crate::run::RunOptions;
use crate::scan::Inside;
pub use crate::vdb::FieldToWrite;
pub use crate::vdb::trim_heap;
use crate::vdb::{
    Band, Compression, GridListing, GridToWrite, MetaItem, Precision, ReadLevelSet, VdbFile, VectorsToWrite,
    WriteOptions,
};

/// The name of a level set that had none: what Houdini and Blender call a surface.
const NEW_NAME: &str = "surface";

/// The name of colours: what Houdini calls those of points.
const COLORS: &str = "Cd";

/// An open `.vdb` file.
pub struct Volume {
    file: VdbFile,
}

/// Opens a file; `-` is standard input.
pub fn open(path: &Path, run: &RunOptions) -> Result<Volume> {
    Ok(Volume { file: crate::vdb::open(path, run)? })
}

/// Finds out without loading voxels whether the chosen level set is there; returns how it is selected.
pub fn probe(path: &Path, choice: Choice) -> Result<String> {
    let listing = crate::vdb::list(path)?;
    let index = listing.select_level_set(choice.grid, choice.assume_level_set);
    let index = index.map_err(|problem| EditError::input(path, problem))?;
    Ok(listing.grids[index].selector.clone())
}

/// Limits the threads of OpenVDB.
pub fn set_threads(threads: usize) -> Result<()> {
    crate::vdb::set_threads(threads)
}

impl Volume {
    /// Reads the chosen level set.
    pub fn read(&self, choice: Choice) -> Result<VolumeGrid> {
        let read = self.file.read_level_set(choice.grid, choice.assume_level_set)?;
        Ok(self.named(read))
    }

    /// Reads the chosen level set and lets go of its voxels in the file.
    pub fn take(&mut self, choice: Choice) -> Result<VolumeGrid> {
        let read = self.file.take_level_set(choice.grid, choice.assume_level_set)?;
        Ok(self.named(read))
    }

    fn named(&self, read: ReadLevelSet) -> VolumeGrid {
        let selector = self.file.listing().grids[read.index].selector.clone();
        let band = band_state(&read);
        VolumeGrid { level_set: read.level_set, index: read.index, selector, band }
    }

    /// The field whose zero set is the surface of a scalar volume at a value; its level set is still to be made.
    pub fn read_iso_field(&self, grid: Option<&str>, iso: f32, inside: Inside, run: &RunOptions) -> Result<LevelSet> {
        self.file.read_iso_field(self.file.select_scalar(grid)?, iso, inside, run)
    }

    /// Whether the chosen grid is a level set, or the only grid that could be one.
    pub fn has_level_set(&self, choice: Choice) -> bool {
        self.file.select_level_set(choice.grid, choice.assume_level_set).is_ok()
    }

    /// What OpenVDB had to say while reading.
    pub fn warnings(&self) -> &[String] {
        &self.file.listing().warnings
    }
}

fn band_state(read: &ReadLevelSet) -> BandState {
    let voxel_size = read.level_set.voxel_size();
    match &read.band {
        Band::Regular => BandState::Regular,
        Band::Trim { inner, outer } => {
            let half_width = (inner.min(*outer) / voxel_size) as f32;
            let what = format!(
                "the band reaches {:.2} voxels inside and {:.2} outside: trimmed to {half_width:.2}",
                inner / voxel_size,
                outer / voxel_size
            );
            match half_width <= read.level_set.half_width() {
                true => BandState::Trim { half_width, what },
                false => BandState::Rebuild { what: read.band.to_string(), gross: false },
            }
        }
        Band::Rebuild { reason } => {
            BandState::Rebuild { what: reason.clone(), gross: read.facts.non_finite > 0 || read.facts.active_tiles > 0 }
        }
    }
}

/// Writes a level set with all else that is in the file that it came from, in the place of the grid that it was made
/// from or after all others. Returns the size of the file and what is not as asked.
pub fn write(
    path: &Path,
    level_set: &LevelSet,
    colors: Option<&[Field; 3]>,
    from: Option<(&Volume, Option<usize>)>,
    options: &VolumeOptions,
) -> Result<(u64, Vec<String>)> {
    let options = WriteOptions {
        precision: options.half.map(|half| if half { Precision::Half } else { Precision::Float }),
        compression: options.compression.as_deref().map(|word| match word {
            "zip" => Compression::Zip,
            "none" => Compression::None,
            _ => Compression::Blosc,
        }),
        only_result: options.only_result,
    };
    let index = from.and_then(|(_, index)| index);
    let grid = GridToWrite { level_set, name: index.is_none().then_some(NEW_NAME), replaces: index };
    let input = from.map(|(volume, _)| &volume.file);
    let report = match colors {
        Some(components) => {
            let colors = VectorsToWrite { components, name: COLORS };
            crate::vdb::write_with_vectors(path, &[grid], colors, input, &options)?
        }
        None => crate::vdb::write(path, &[grid], input, &options)?,
    };
    Ok((report.bytes, report.warnings))
}

/// Writes a field of a level set after all that is in the file that the level set came from, or after the level set itself.
/// Returns the size of the file and what is not as asked.
pub fn write_field(
    path: &Path,
    level_set: &LevelSet,
    field: FieldToWrite,
    from: Option<&Volume>,
) -> Result<(u64, Vec<String>)> {
    let grid = GridToWrite { level_set, name: Some(NEW_NAME), replaces: None };
    let grids = if from.is_none() { std::slice::from_ref(&grid) } else { &[] };
    let file = from.map(|volume| &volume.file);
    let report = crate::vdb::write_with_fields(path, grids, &[field], file, &WriteOptions::default())?;
    Ok((report.bytes, report.warnings))
}

/// Describes a file, or one grid of it.
pub fn describe(path: &Path, choice: Choice, run: &RunOptions) -> Result<Description> {
    let volume = open(path, run)?;
    let listing = volume.file.listing();
    let chosen = match choice.grid {
        Some(selector) => Some(listing.find(selector).map_err(|problem| EditError::input(path, problem))?),
        None => None,
    };
    let grids = listing.grids.iter().enumerate().filter(|(index, _)| chosen.is_none_or(|c| c == *index));
    Ok(Description {
        metadata: metadata(&listing.metadata),
        format: format!(
            "{} (OpenVDB {}.{})",
            listing.file_version, listing.library_version.0, listing.library_version.1
        ),
        grids: grids.map(|(_, grid)| describe_grid(&volume, grid, choice.assume_level_set)).collect(),
    })
}

fn describe_grid(volume: &Volume, grid: &GridListing, assume_level_set: bool) -> GridDescription {
    let wanted = grid.is_scalar() && (grid.is_level_set() || (assume_level_set && grid.class == "unknown"));
    let read = || {
        let choice = Choice { grid: Some(&grid.selector), assume_level_set };
        volume.read(choice).map_err(|e| e.to_string())
    };
    let box_in_world = || {
        let (lo, hi) = grid.active_bounds()?;
        let to_world = grid.to_world?;
        let corners = (0..8).map(|c| {
            let pick = |bit: i32, axis: usize| f64::from(if c & bit == 0 { lo[axis] } else { hi[axis] });
            to_world.transform_point3(DVec3::new(pick(1, 0), pick(2, 1), pick(4, 2)))
        });
        corners.map(|p| (p, p)).reduce(|(lo, hi), (p, _)| (lo.min(p), hi.max(p)))
    };
    let precision = if grid.precision == Precision::Half { "half" } else { "full" };
    let compression = match grid.compression {
        Compression::Blosc => "blosc",
        Compression::Zip => "zip",
        Compression::None => "uncompressed",
    };
    GridDescription {
        name: grid.name.clone(),
        selector: grid.selector.clone(),
        value_type: grid.value_type.clone(),
        class: grid.class.clone(),
        voxel_size: grid.voxel_size,
        active_voxels: grid.active_voxels(),
        bounds: box_in_world(),
        storage: format!("{precision} precision, {compression}"),
        metadata: metadata(&grid.metadata),
        level_set: wanted.then(read),
    }
}

/// Metadata as JSON: numbers and booleans as such, everything else as text.
fn metadata(items: &[MetaItem]) -> Map<String, Value> {
    let value = |item: &MetaItem| match item.type_name.as_str() {
        "int32" | "int64" => item.value.parse::<i64>().map(Value::from).ok(),
        "float" | "double" => item.value.parse::<f64>().map(|v| json!(v)).ok(),
        "bool" => Some(Value::from(matches!(item.value.as_str(), "true" | "1"))),
        _ => None,
    };
    items.iter().map(|item| (item.name.clone(), value(item).unwrap_or_else(|| item.value.clone().into()))).collect()
}
