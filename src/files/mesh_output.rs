//! How a result becomes a mesh file: which faces, how many, and what their vertices carry.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::input;
use super::output::Written;
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{
    self, Attributes, Bound, MeshFormat, Remesh, TriangleMesh, level_set_to_mesh, level_set_to_quads, simplify,
    transfer_attributes,
};
use crate::run::RunOptions;

/// The options of a mesh.
#[derive(Default)]
pub struct MeshOptions {
    faces: Faces,
    /// `--attributes-from`.
    attributes: Option<(PathBuf, TriangleMesh)>,
    warnings: Vec<String>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Faces {
    /// The triangles of marching cubes.
    #[default]
    All,
    /// `--simplify`: this part of them.
    Part(f64),
    /// `--adaptivity`: as few as stay within this many voxels.
    Within(f64),
    /// `--quads`.
    Quads,
}

/// What is asked of a mesh; at most one of the first three.
#[derive(Clone, Debug, Default)]
pub struct MeshParams {
    /// Part of the triangles to keep.
    pub simplify: Option<f64>,
    /// Voxels that vertices left out may be away from the result.
    pub adaptivity: Option<f64>,
    /// Quads instead of triangles.
    pub quads: bool,
    /// The mesh whose colours and texture coordinates are taken over.
    pub attributes_from: Option<PathBuf>,
}

impl MeshParams {
    fn faces(&self) -> Faces {
        match (self.simplify, self.adaptivity) {
            (Some(ratio), _) => Faces::Part(ratio),
            (None, Some(voxels)) => Faces::Within(voxels),
            (None, None) if self.quads => Faces::Quads,
            (None, None) => Faces::All,
        }
    }

    /// Refuses numbers that cannot work, and several ways of having fewer faces at once.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &str, value: f64, accepted: &str| {
            Err(EditError::parameter("write", field, value, accepted.to_owned()))
        };
        match (self.simplify, self.adaptivity, self.quads) {
            (Some(ratio), ..) if !(ratio > 0.0 && ratio <= 1.0) => refuse("simplify", ratio, "a part above 0, up to 1"),
            (_, Some(voxels), _) if !(0.0..=1.0).contains(&voxels) => {
                refuse("adaptivity", voxels, "a number of voxels from 0 to 1")
            }
            (Some(ratio), Some(_), _) | (Some(ratio), _, true) => {
                refuse("simplify", ratio, "one of `simplify`, `adaptivity` and `quads`")
            }
            (_, Some(voxels), true) => refuse("adaptivity", voxels, "one of `simplify`, `adaptivity` and `quads`"),
            _ => Ok(()),
        }
    }

    /// Refuses what a file at `path` cannot hold.
    pub fn fits(&self, path: &Path) -> Result<()> {
        let format = MeshFormat::of(path);
        let refuse = |field: &str, value: String, accepted: &str| {
            Err(EditError::parameter("vdb-edit", field, value, accepted.to_owned()))
        };
        let is_mesh = format.is_some() && !input::is_volume(path);
        let accepted = "an output that is a mesh (.obj, .ply, .stl, .glb, .gltf or .off)";
        match self.faces() {
            Faces::Part(ratio) if !is_mesh => return refuse("simplify", ratio.to_string(), accepted),
            Faces::Within(voxels) if !is_mesh => return refuse("adaptivity", voxels.to_string(), accepted),
            Faces::Quads if !is_mesh => return refuse("quads", "true".into(), accepted),
            _ => {}
        }
        match &self.attributes_from {
            Some(source) if !is_mesh || format.is_some_and(|format| !format.has_attributes()) => {
                let accepted =
                    "an output that can hold colours and texture coordinates (.obj, .ply, .glb, .gltf or .off)";
                refuse("attributes_from", source.display().to_string(), accepted)
            }
            _ => Ok(()),
        }
    }
}

impl MeshOptions {
    /// For a mesh at `path`: refused if that is no mesh, or cannot hold what is asked.
    pub fn new(params: &MeshParams, path: &Path) -> Result<Self> {
        params.fits(path)?;
        let faces = params.faces();
        let mut warnings = Vec::new();
        let attributes = match params.attributes_from.clone() {
            None => None,
            Some(source) => {
                let mesh = input::read_mesh(&source, &mut warnings)?;
                if attributes_of(&mesh).is_none() {
                    return Err(EditError::input(source, "has neither colours nor texture coordinates"));
                }
                Some((source, mesh))
            }
        };
        Ok(Self { faces, attributes, warnings })
    }

    /// Whether a mesh as it stands in a file is not enough.
    pub fn needs_level_set(&self) -> bool {
        matches!(self.faces, Faces::Within(_) | Faces::Quads)
    }

    /// What becomes of the attributes of an input, if they do not come through to `path`.
    pub fn loss(&self, input: &Path, attributes: &str, path: &Path) -> Option<String> {
        if self.attributes.is_some() {
            return None;
        }
        let input = input.display();
        Some(match MeshFormat::of(path) {
            Some(format) if !format.has_attributes() => {
                format!("{input}: its {attributes} are lost: {format} files hold none")
            }
            Some(_) => format!("{input}: its {attributes} are lost; --attributes-from {input} keeps them"),
            None => format!(
                "{input}: its {attributes} are lost: a level set has none; --attributes-from {input} brings them back when a mesh is written"
            ),
        })
    }

    /// Writes the surface φ = `iso`. Triangles are taken from the `last` mesh as far as they are the same.
    pub fn write_level_set(
        &self,
        path: &Path,
        level_set: &LevelSet,
        iso: f32,
        last: Option<&mut Remesh>,
        run: &RunOptions,
    ) -> Result<Written> {
        if self.faces != Faces::Quads {
            let mesh = match last {
                Some(last) => Cow::Borrowed(last.level_set_to_mesh(level_set, iso, run)?),
                None => Cow::Owned(level_set_to_mesh(level_set, iso, run)?),
            };
            return self.write_triangles(path, mesh, level_set.voxel_size(), run);
        }
        // Its triangles are of no use to quads.
        if let Some(last) = last {
            *last = Remesh::default();
        }
        let mut mesh = level_set_to_quads(level_set, iso, run)?;
        if let Some(Attributes { colors, uvs }) = self.attributes(&mesh.positions, run)? {
            (mesh.colors, mesh.uvs) = (colors, uvs);
        }
        mesh::write_quads(path, &mesh)?;
        let mut warnings = self.warnings.clone();
        let format = MeshFormat::of(path);
        if let Some(format) = format.filter(|format| !format.has_polygons()) {
            warnings.push(format!("{format} files hold triangles only: each quad was split in two"));
        }
        let details = counts(&[("vertices", mesh.positions.len()), ("quads", mesh.quads.len())]);
        Ok(Written { bytes: size(path), warnings, details })
    }

    /// Writes a mesh that came from a file.
    pub fn write_mesh(&self, path: &Path, mesh: TriangleMesh, run: &RunOptions) -> Result<Written> {
        self.write_triangles(path, Cow::Owned(mesh), 1.0, run)
    }

    fn write_triangles(
        &self,
        path: &Path,
        mut mesh: Cow<'_, TriangleMesh>,
        voxel_size: f64,
        run: &RunOptions,
    ) -> Result<Written> {
        let mut warnings = self.warnings.clone();
        let mut details = Map::new();
        let bound = match self.faces {
            Faces::Part(ratio) => Some(Bound::Ratio(ratio)),
            Faces::Within(voxels) if voxels > 0.0 => Some(Bound::Distance(voxels * voxel_size)),
            _ => None,
        };
        if let Some(bound) = bound {
            let simplified = simplify(&mesh, bound, run)?;
            details.insert("triangles_before".into(), mesh.triangles.len().into());
            details.insert("deviation".into(), simplified.deviation.into());
            warnings.extend(simplified.warnings);
            mesh = Cow::Owned(simplified.mesh);
        }
        if let Some(Attributes { colors, uvs }) = self.attributes(&mesh.positions, run)? {
            let mesh = mesh.to_mut();
            (mesh.colors, mesh.uvs) = (colors, uvs);
        }
        mesh::write(path, &mesh)?;
        details.extend(counts(&[("vertices", mesh.positions.len()), ("triangles", mesh.triangles.len())]));
        Ok(Written { bytes: size(path), warnings, details })
    }

    fn attributes(&self, positions: &[glam::DVec3], run: &RunOptions) -> Result<Option<Attributes>> {
        let Some((path, source)) = &self.attributes else { return Ok(None) };
        let found = transfer_attributes(source, positions, run);
        found.map(Some).map_err(|error| input::naming(path, error))
    }
}

/// What the vertices of a mesh carry, in words.
pub fn attributes_of(mesh: &TriangleMesh) -> Option<&'static str> {
    match (mesh.colors.is_some(), mesh.uvs.is_some()) {
        (true, true) => Some("colours and texture coordinates"),
        (true, false) => Some("colours"),
        (false, true) => Some("texture coordinates"),
        (false, false) => None,
    }
}

fn counts(counts: &[(&str, usize)]) -> Map<String, Value> {
    counts.iter().map(|(name, count)| ((*name).to_owned(), Value::from(*count))).collect()
}

fn size(path: &Path) -> Option<u64> {
    std::fs::metadata(path).ok().map(|m| m.len())
}
