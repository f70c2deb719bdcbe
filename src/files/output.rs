//! Where a result goes: settled before any work, written at its end.

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde_json::{Map, Value};

use super::input;
use super::mesh_output::{MeshOptions, MeshParams};
use super::volume::{self, Volume};
use crate::atomic;
use crate::error::{EditError, Result};
use crate::levelset::{Field, LevelSet};
use crate::mesh::{MeshFormat, Remesh, TriangleMesh, level_set_to_mesh};
use crate::run::RunOptions;

/// A file to be written.
pub struct Output {
    /// Its path; `-` is standard output.
    pub path: PathBuf,
    kind: Kind,
    options: VolumeOptions,
    mesh: MeshOptions,
}

/// What it will hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    Volume,
    Mesh,
}

/// How a `.vdb` is written.
#[derive(Clone, Debug, Default)]
#[cfg_attr(not(feature = "openvdb"), allow(dead_code))] // nothing is written without OpenVDB
pub struct VolumeOptions {
    /// `--precision`: whether half; `None` keeps that of the input.
    pub half: Option<bool>,
    /// `--compression`; `None` keeps that of the input.
    pub compression: Option<String>,
    /// `--only-result`.
    pub only_result: bool,
}

/// What was written.
#[derive(Default)]
pub struct Written {
    /// Size of the file, where it is known.
    pub bytes: Option<u64>,
    /// What is not as asked.
    pub warnings: Vec<String>,
    /// What else is worth telling.
    pub details: Map<String, Value>,
}

/// Linear colours (red, green, blue, opacity) at positions of the world.
pub type Colors<'a> = dyn Fn(&[DVec3]) -> Result<Vec<[f32; 4]>> + 'a;

impl Output {
    /// An output that is refused now if it could not be written later.
    pub fn plan(path: PathBuf, options: VolumeOptions, mesh: &MeshParams) -> Result<Self> {
        let kind = Self::check(&path)?;
        let mesh = MeshOptions::new(mesh, &path)?;
        Ok(Self { path, kind, options, mesh })
    }

    /// What a file at `path` would hold; refused if none can be written there.
    pub fn check(path: &Path) -> Result<Kind> {
        let kind = kind_of(path)?;
        writable(path)?;
        Ok(kind)
    }

    /// How meshes are written.
    pub fn mesh(&self) -> &MeshOptions {
        &self.mesh
    }

    /// Whether it is a mesh.
    pub fn is_mesh(&self) -> bool {
        self.kind == Kind::Mesh
    }

    /// Whether the file can hold colours.
    pub fn holds_colors(&self) -> bool {
        !self.is_mesh() || MeshFormat::of(&self.path).is_some_and(MeshFormat::has_attributes)
    }

    /// Whether it is standard output.
    pub fn is_pipe(&self) -> bool {
        input::is_pipe(&self.path)
    }

    /// Writes a level set; the surface `iso` of it where a mesh is wanted. `from` is the file that it came from, and the grid whose
    /// place it takes.
    pub fn write(
        &self,
        level_set: &LevelSet,
        iso: f32,
        from: Option<(&Volume, Option<usize>)>,
        run: &RunOptions,
    ) -> Result<Written> {
        self.write_again(level_set, iso, from, None, run)
    }

    /// The same; a mesh takes of the `last` one written there what has not changed, if that is given.
    pub fn write_again(
        &self,
        level_set: &LevelSet,
        iso: f32,
        from: Option<(&Volume, Option<usize>)>,
        last: Option<&mut Remesh>,
        run: &RunOptions,
    ) -> Result<Written> {
        run.check("writing")?;
        match self.kind {
            Kind::Volume => {
                let (bytes, warnings) = volume::write(&self.path, level_set, None, from, &self.options)?;
                Ok(Written { bytes: Some(bytes), warnings, ..Written::default() })
            }
            Kind::Mesh => self.mesh.write_level_set(&self.path, level_set, iso, last, run),
        }
    }

    /// Writes a level set with colours, linear, that are found for positions of the world: those of the vertices of a mesh, or those of the voxels of the band, as a
    /// grid `Cd`. Without them where the file holds none.
    pub fn write_colored(
        &self,
        level_set: &LevelSet,
        from: Option<(&Volume, Option<usize>)>,
        colors: &Colors<'_>,
        run: &RunOptions,
    ) -> Result<Written> {
        run.check("writing")?;
        match self.kind {
            Kind::Volume => {
                let rgb = |xyz: &[DVec3]| Ok(colors(xyz)?.into_iter().map(|[r, g, b, _]| [r, g, b]).collect());
                let fields = Field::three_of(level_set, rgb)?;
                let (bytes, warnings) = volume::write(&self.path, level_set, Some(&fields), from, &self.options)?;
                Ok(Written { bytes: Some(bytes), warnings, ..Written::default() })
            }
            Kind::Mesh if self.holds_colors() => {
                let mut mesh = level_set_to_mesh(level_set, 0.0, run)?;
                mesh.colors = Some(colors(&mesh.positions)?);
                self.mesh.write_mesh(&self.path, mesh, run)
            }
            Kind::Mesh => self.mesh.write_level_set(&self.path, level_set, 0.0, None, run),
        }
    }

    /// Writes a mesh that came from a file.
    pub fn write_mesh(&self, mesh: TriangleMesh, run: &RunOptions) -> Result<Written> {
        run.check("writing")?;
        self.mesh.write_mesh(&self.path, mesh, run)
    }
}

fn kind_of(path: &Path) -> Result<Kind> {
    if input::is_volume(path) {
        Ok(Kind::Volume)
    } else if MeshFormat::of(path).is_some() {
        Ok(Kind::Mesh)
    } else {
        let accepted = format!("a file name that ends in {}, or `-`", input::EXTENSIONS);
        Err(EditError::parameter("vdb-edit", "output", path.display(), accepted))
    }
}

/// Refuses a result that is no valid level set.
pub fn verify(operation: &str, level_set: &LevelSet) -> Result<()> {
    let violations = level_set.check();
    if violations.is_empty() {
        return Ok(());
    }
    let said: Vec<String> = violations.iter().map(ToString::to_string).collect();
    let problem = format!("--check: the result is not written: {}", said.join("; "));
    Err(EditError::Unmet { operation: operation.into(), problem })
}

/// Refuses a path at which nothing can be written, by making a temporary file beside it.
pub fn writable(path: &Path) -> Result<()> {
    if input::is_pipe(path) {
        return Ok(());
    }
    match std::fs::metadata(path) {
        Ok(facts) if facts.is_dir() => return Err(EditError::output(path, "it is a folder; a file name is wanted")),
        Ok(facts) if !facts.is_file() => return Ok(()),
        Ok(facts) if facts.permissions().readonly() => {
            return Err(EditError::output(path, "the existing file is read-only"));
        }
        _ => {}
    }
    // Through links: the file that they name is the one that is replaced.
    let real = atomic::final_target(path)?;
    let folder = match real.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        return Err(EditError::output(path, format!("there is no folder `{}`", folder.display())));
    }
    let probe = atomic::temporary_in(folder, "");
    probe
        .map(|(_unfinished, file)| drop(file))
        .map_err(|e| EditError::output(path, format!("no file can be made in `{}`: {e}", folder.display())))
}
