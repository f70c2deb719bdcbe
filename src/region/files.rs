//! What regions and operators read from files beside their input: level sets, volumes, meshes and points.

use std::path::Path;

use glam::DVec3;

use crate::error::{EditError, Result};
use crate::grid::{VectorVolume, Volume};
use crate::levelset::LevelSet;
use crate::mesh::{self, MeshFormat, MeshToLevelSet, mesh_to_level_set};
use crate::run::RunOptions;

/// The level set of a `.vdb` file, or of a mesh file at `voxel_size` with a band of `half_width` voxels.
pub(crate) fn level_set(
    path: &Path,
    grid: Option<&str>,
    voxel_size: f64,
    half_width: f32,
    run: &RunOptions,
) -> Result<LevelSet> {
    if MeshFormat::of(path).is_none() {
        return volumes::level_set(path, grid, run);
    }
    let mesh = mesh::read(path)?.mesh;
    let params = MeshToLevelSet { half_width, ..MeshToLevelSet::new(voxel_size) };
    mesh_to_level_set(&mesh, &params, run).map(|(level_set, _)| level_set).map_err(|error| match error {
        EditError::Input { problem, .. } => EditError::input(path, problem),
        error => error,
    })
}

/// The numbers of a grid of a `.vdb` file.
pub(crate) fn volume(path: &Path, grid: Option<&str>, run: &RunOptions) -> Result<Volume> {
    volumes::volume(path, grid, run)
}

/// The vectors of a grid of a `.vdb` file.
pub(crate) fn vectors(path: &Path, grid: Option<&str>, run: &RunOptions) -> Result<VectorVolume> {
    volumes::vectors(path, grid, run)
}

/// Points: the vertices of a mesh file, or a text of `x y z` or `x,y,z` a line (`#` begins a comment).
pub(crate) fn points(path: &Path) -> Result<Vec<DVec3>> {
    if MeshFormat::of(path).is_some() {
        return Ok(mesh::read(path)?.mesh.positions);
    }
    let refuse = |problem: String| EditError::input(path, problem);
    let text = std::fs::read_to_string(path).map_err(|e| refuse(format!("cannot be read as text: {e}")))?;
    let mut points = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.split('#').next().unwrap_or_default();
        let mut words = line.split(|c: char| c.is_whitespace() || c == ',').filter(|word| !word.is_empty()).peekable();
        if words.peek().is_none() {
            continue;
        }
        let mut next = || words.next()?.parse::<f64>().ok().filter(|v| v.is_finite());
        match (next(), next(), next()) {
            (Some(x), Some(y), Some(z)) => points.push(DVec3::new(x, y, z)),
            _ => {
                return Err(refuse(format!(
                    "line {number}: three finite numbers `x y z` are wanted, not `{}`",
                    line.trim()
                )));
            }
        }
    }
    if points.is_empty() { Err(refuse("there are no points in it".into())) } else { Ok(points) }
}

#[cfg(feature = "openvdb")]
mod volumes {
    use super::{EditError, LevelSet, Path, Result, RunOptions, VectorVolume, Volume};
    use crate::vdb::{self, Band};

    pub fn level_set(path: &Path, grid: Option<&str>, run: &RunOptions) -> Result<LevelSet> {
        let read = vdb::open(path, run)?.read_level_set(grid, false)?;
        match read.band {
            Band::Regular => Ok(read.level_set),
            _ => Err(EditError::input(
                path,
                "its band is irregular; `vdb-edit convert` makes a regular level set of it, which a region can use",
            )),
        }
    }

    pub fn volume(path: &Path, grid: Option<&str>, run: &RunOptions) -> Result<Volume> {
        let file = vdb::open(path, run)?;
        file.read_volume(file.select_scalar(grid)?, run)
    }

    pub fn vectors(path: &Path, grid: Option<&str>, run: &RunOptions) -> Result<VectorVolume> {
        let file = vdb::open(path, run)?;
        file.read_vectors(file.select_vector(grid)?, run)
    }
}

#[cfg(not(feature = "openvdb"))]
mod volumes {
    use super::{EditError, LevelSet, Path, Result, RunOptions, VectorVolume, Volume};

    fn refuse<T>(path: &Path) -> Result<T> {
        Err(EditError::input(path, "this build has no OpenVDB and cannot read it; a mesh file works for `mesh file=`"))
    }

    pub fn level_set(path: &Path, _: Option<&str>, _: &RunOptions) -> Result<LevelSet> {
        refuse(path)
    }

    pub fn volume(path: &Path, _: Option<&str>, _: &RunOptions) -> Result<Volume> {
        refuse(path)
    }

    pub fn vectors(path: &Path, _: Option<&str>, _: &RunOptions) -> Result<VectorVolume> {
        refuse(path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_text_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.xyz");
        std::fs::write(&path, "# a comment\n1 2 3\n\n4,5, 6 0.5 # more columns are left alone\n").unwrap();
        assert_eq!(points(&path).unwrap(), [DVec3::new(1.0, 2.0, 3.0), DVec3::new(4.0, 5.0, 6.0)]);
        for (text, part) in [("1 2\n", "line 1"), ("1 2 3\n1 2 nan\n", "line 2"), ("# nothing\n", "no points")] {
            std::fs::write(&path, text).unwrap();
            let error = points(&path).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
        assert!(points(&folder.path().join("absent.xyz")).is_err());
    }
}
