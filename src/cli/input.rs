//! Level sets from files: grids of a `.vdb` are verified, meshes converted.

use std::path::{Path, PathBuf};

use clap::ArgMatches;
use glam::DVec3;
use serde_json::Value;

use super::context::Context;
use super::volume::{self, BandState, Choice, Volume, VolumeGrid};
use super::{args, mesh_output, table};
use crate::error::{EditError, Result};
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet, Violation, ViolationKind};
use crate::mesh::{self, MeshFormat, MeshToLevelSet, Rebuild, TriangleMesh, mesh_to_level_set, rebuild};
use crate::ops::{VoxelLength, WorldLength};

/// What can be read and written.
pub const EXTENSIONS: &str = ".vdb, .obj, .ply, .stl, .glb, .gltf or .off";

/// Voxels along the longest axis where no size is given.
const DEFAULT_RESOLUTION: f64 = 256.0;

/// Part of the active voxels that may break an invariant in an input that is still taken, with a warning: other programs
/// leave a few voxels askew, and every editing operator repairs them on its way.
const TOLERATED: f64 = 0.01;

/// The narrowest band, in voxels, that flows keep the surface in: as narrow as meshes may become.
const NARROWEST: f32 = 1.5;

/// Whether a path stands for standard input or output.
pub fn is_pipe(path: &Path) -> bool {
    path == Path::new("-")
}

/// Whether a path is a `.vdb`, standard input or output, or a device or pipe without an extension of its own.
pub fn is_volume(path: &Path) -> bool {
    let special = || path.extension().is_none() && std::fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir());
    is_pipe(path) || path.extension().is_some_and(|e| e.eq_ignore_ascii_case("vdb")) || special()
}

/// How inputs are read.
pub struct InputOptions {
    grids: Vec<String>,
    assume_level_set: bool,
    repair: bool,
    strict: bool,
    voxel_size: Option<f64>,
    resolution: Option<f64>,
    half_width: Option<VoxelLength>,
}

/// A level set from a file.
pub struct Input {
    /// The file.
    pub path: PathBuf,
    /// The level set, valid.
    pub level_set: LevelSet,
    /// The `.vdb` that it came from, and its place there if it was a grid of its own.
    pub source: Option<(Volume, Option<usize>)>,
    /// What the vertices of its mesh carried, which a level set does not.
    pub attributes: Option<&'static str>,
}

impl Input {
    /// The file to be carried over by a result of this input, and the grid to be replaced by it.
    pub fn from(&self) -> Option<(&Volume, Option<usize>)> {
        self.source.as_ref().map(|(volume, index)| (volume, *index))
    }
}

impl InputOptions {
    /// From the options of a command, whether they are its own or its operator's.
    pub fn new(matches: &ArgMatches) -> Result<Self> {
        let value = |id: &str| matches.try_get_one::<Value>(id).ok().flatten().cloned();
        let refuse = |field: &str, value: &Value, accepted: &str| {
            Err(EditError::parameter("convert", field, value.to_string().trim_matches('"'), accepted))
        };
        let voxel_size = match value("voxel_size") {
            None => None,
            Some(given) => match length_in_world(&given) {
                Some(size) if size > 0.0 => Some(size),
                _ => return refuse("voxel_size", &given, "a positive length in world units, such as 0.01"),
            },
        };
        let resolution = match value("resolution") {
            None => None,
            Some(given) => match given.as_f64() {
                Some(n) if n >= 1.0 => Some(n),
                _ => return refuse("resolution", &given, "a number of voxels, 1 or more, such as 256"),
            },
        };
        let half_width = match value("half_width") {
            None => None,
            Some(given) => match serde_json::from_value(given.clone()) {
                Ok(width) => Some(width),
                Err(_) => return refuse("half_width", &given, "a number of voxels, such as 3"),
            },
        };
        let grids = matches.try_get_many::<String>("grid").ok().flatten();
        Ok(Self {
            grids: grids.map(|names| names.cloned().collect()).unwrap_or_default(),
            assume_level_set: args::flag(matches, "assume-level-set"),
            repair: args::flag(matches, "repair"),
            strict: args::flag(matches, "strict"),
            voxel_size,
            resolution,
            half_width,
        })
    }

    /// Whether a size for meshes was given.
    pub fn has_size(&self) -> bool {
        self.voxel_size.is_some() || self.resolution.is_some()
    }

    /// Which grid of the n-th `.vdb` is meant.
    pub fn choice(&self, n: usize) -> Choice<'_> {
        let grid = self.grids.get(n).or(self.grids.last());
        Choice { grid: grid.map(String::as_str), assume_level_set: self.assume_level_set }
    }
}

/// World units of a length that cannot be in voxels, because it says how large a voxel is.
fn length_in_world(value: &Value) -> Option<f64> {
    if value.as_str().is_some_and(|text| text.ends_with("vx")) {
        return None;
    }
    serde_json::from_value::<WorldLength>(value.clone()).ok().map(|length| length.world(1.0))
}

/// Finds out without reading whole files whether all inputs are there; returns one line each on what they are.
pub fn probe(paths: &[PathBuf], options: &InputOptions) -> Result<Vec<String>> {
    let mut volumes = 0;
    let mut lines = Vec::new();
    for path in paths {
        if is_pipe(path) {
            lines.push("-: a .vdb from standard input".into());
        } else if is_volume(path) {
            let selector = volume::probe(path, options.choice(volumes))?;
            lines.push(format!("{}: level set `{selector}`", path.display()));
            volumes += 1;
        } else {
            let format = mesh_format(path)?;
            std::fs::File::open(path).map_err(|e| EditError::input(path, format!("cannot be opened: {e}")))?;
            lines.push(format!("{}: a {format} mesh", path.display()));
        }
    }
    Ok(lines)
}

fn mesh_format(path: &Path) -> Result<MeshFormat> {
    MeshFormat::of(path).ok_or_else(|| match std::fs::metadata(path) {
        Err(e) => EditError::input(path, format!("cannot be opened: {e}")),
        Ok(facts) if facts.is_dir() => EditError::input(path, "is a folder; a file is wanted"),
        Ok(_) => {
            EditError::input(path, format!("of an unknown kind; files are told apart by their ending: {EXTENSIONS}"))
        }
    })
}

/// A file read, not yet a level set where it is a mesh.
enum Raw {
    Volume(Box<(Volume, VolumeGrid)>),
    Mesh(TriangleMesh),
}

/// Reads all inputs. Meshes get voxels of one size, so that they lie on one lattice: that of the options, else that of the
/// first `.vdb`, else by the resolution over all of them together. What was repaired goes to `warnings`.
///
/// Of the grids that they are read from only the place in their files is left, to be taken by a result.
pub fn load(
    paths: &[PathBuf],
    options: &InputOptions,
    warnings: &mut Vec<String>,
    context: &Context,
) -> Result<Vec<Input>> {
    load_with(paths, options, Volume::take, warnings, context)
}

/// As [`load`], for results that go beside the grids that the level sets are read from: files stay whole.
pub fn load_whole(
    paths: &[PathBuf],
    options: &InputOptions,
    warnings: &mut Vec<String>,
    context: &Context,
) -> Result<Vec<Input>> {
    load_with(paths, options, |volume, choice| volume.read(choice), warnings, context)
}

fn load_with(
    paths: &[PathBuf],
    options: &InputOptions,
    read: impl Fn(&mut Volume, Choice) -> Result<VolumeGrid>,
    warnings: &mut Vec<String>,
    context: &Context,
) -> Result<Vec<Input>> {
    if paths.iter().filter(|path| is_pipe(path)).count() > 1 {
        let accepted = "standard input can be read once: give `-` once";
        return Err(EditError::parameter("vdb-edit", "input", "-", accepted));
    }
    // All kinds are known before anything large is read.
    for path in paths.iter().filter(|path| !is_volume(path)) {
        mesh_format(path)?;
    }
    let mut raw = Vec::new();
    let mut volumes = 0;
    for path in paths {
        context.run.check("reading")?;
        if is_volume(path) {
            let mut volume = volume::open(path, &context.run)?;
            warnings.extend(volume.warnings().iter().map(|w| format!("{}: {w}", path.display())));
            let grid = read(&mut volume, options.choice(volumes))?;
            volumes += 1;
            raw.push(Raw::Volume(Box::new((volume, grid))));
        } else {
            raw.push(Raw::Mesh(read_mesh(path, warnings)?));
        }
    }
    let conversion = conversion_of(&raw, options)?;
    let mut inputs = Vec::new();
    for (path, raw) in paths.iter().zip(raw) {
        let (level_set, source, attributes) = match raw {
            Raw::Volume(read) => {
                let (volume, grid) = *read;
                let index = grid.index;
                (valid(path, grid, options, warnings, context)?, Some((volume, Some(index))), None)
            }
            Raw::Mesh(mesh) => {
                (convert(path, &mesh, &conversion, warnings, context)?, None, mesh_output::attributes_of(&mesh))
            }
        };
        if level_set.is_empty() {
            warnings.push(format!("{}: the level set is empty: there is no surface", path.display()));
        }
        inputs.push(Input { path: path.clone(), level_set, source, attributes });
    }
    Ok(inputs)
}

/// The level set of the surface of a scalar volume at `iso`; `None` if the file holds a level set, or is none of volumes.
pub fn load_iso(
    path: &Path,
    options: &InputOptions,
    iso: f32,
    warnings: &mut Vec<String>,
    context: &Context,
) -> Result<Option<Input>> {
    if !is_volume(path) || is_pipe(path) {
        return Ok(None);
    }
    let choice = options.choice(0);
    let volume = volume::open(path, &context.run)?;
    if volume.has_level_set(choice) {
        return Ok(None);
    }
    warnings.extend(volume.warnings().iter().map(|w| format!("{}: {w}", path.display())));
    let field = volume.read_iso_field(choice.grid, iso, &context.run)?;
    let half_width = options.half_width.map_or(DEFAULT_HALF_WIDTH, |w| w.voxels(field.voxel_size()) as f32);
    let level_set = rebuild(&field, &Rebuild::band(half_width), &context.run)?;
    if level_set.is_empty() {
        return Err(EditError::input(path, format!("no voxel holds more than {iso}: there is no surface")));
    }
    Ok(Some(Input { path: path.to_path_buf(), level_set, source: Some((volume, None)), attributes: None }))
}

/// Reads a mesh file.
pub fn read_mesh(path: &Path, warnings: &mut Vec<String>) -> Result<TriangleMesh> {
    mesh_format(path)?;
    let read = mesh::read(path)?;
    warnings.extend(read.warnings.into_iter().map(|w| format!("{}: {w}", path.display())));
    Ok(read.mesh)
}

/// The error with the file of a mesh, which the library does not know.
pub fn naming(path: &Path, error: EditError) -> EditError {
    match error {
        EditError::Input { problem, .. } => EditError::input(path, problem),
        error => error,
    }
}

fn conversion_of(raw: &[Raw], options: &InputOptions) -> Result<MeshToLevelSet> {
    let volume = raw.iter().find_map(|raw| match raw {
        Raw::Volume(read) => Some(&read.1.level_set),
        Raw::Mesh(_) => None,
    });
    let boxes = raw.iter().filter_map(|raw| match raw {
        Raw::Mesh(mesh) => mesh.bounding_box(),
        Raw::Volume(..) => None,
    });
    let together: Option<(DVec3, DVec3)> = boxes.reduce(|(a, b), (c, d)| (a.min(c), b.max(d)));
    let longest = together.map_or(0.0, |(lo, hi)| (hi - lo).max_element());
    let by_resolution = |n: f64| longest / n;
    let voxel_size = match (options.voxel_size, options.resolution, volume) {
        (Some(size), ..) => size,
        (None, Some(n), _) => by_resolution(n),
        (None, None, Some(level_set)) => level_set.voxel_size(),
        (None, None, None) => by_resolution(DEFAULT_RESOLUTION),
    };
    let half_width = match (options.half_width, volume) {
        (Some(width), _) => width.voxels(voxel_size) as f32,
        (None, Some(level_set)) if level_set.half_width() >= DEFAULT_HALF_WIDTH => level_set.half_width(),
        _ => DEFAULT_HALF_WIDTH,
    };
    // A mesh without extent has no voxel size; the conversion says what is wrong with it.
    let voxel_size = if voxel_size > 0.0 || together.is_none() { voxel_size } else { 1.0 };
    Ok(MeshToLevelSet { voxel_size, half_width, strict: options.strict })
}

fn convert(
    path: &Path,
    mesh: &TriangleMesh,
    conversion: &MeshToLevelSet,
    warnings: &mut Vec<String>,
    context: &Context,
) -> Result<LevelSet> {
    let (level_set, findings) =
        mesh_to_level_set(mesh, conversion, &context.run).map_err(|error| naming(path, error))?;
    warnings.extend(findings.warnings().into_iter().map(|w| format!("{}: {w}", path.display())));
    // Where the mesh was repaired, its own volume says nothing.
    if findings.is_sound() && findings.duplicates_dropped == 0 {
        let (wanted, has) = (enclosed_volume(mesh), level_set.measure(&context.run)?.volume);
        if (has - wanted).abs() > LOST * wanted.abs() {
            warnings.push(format!(
                "{}: the level set has {} % of the mesh's volume: parts or walls thinner than a voxel are lost; take a voxel size smaller than {:e}",
                path.display(),
                table::number(100.0 * has / wanted.abs()),
                conversion.voxel_size
            ));
        }
    }
    Ok(level_set)
}

/// Part of a mesh's volume that may be missing unsaid: more than the rounded corners of anything a few voxels thick.
const LOST: f64 = 0.1;

/// The volume that a closed mesh encloses, by the divergence theorem.
fn enclosed_volume(mesh: &TriangleMesh) -> f64 {
    let Some((lo, hi)) = mesh.bounding_box() else { return 0.0 };
    let centre = (lo + hi) / 2.0;
    let tetrahedron = |t| {
        let [a, b, c] = mesh.corners(t).map(|p| p - centre);
        a.dot(b.cross(c)) / 6.0
    };
    (0..mesh.triangles.len()).map(tetrahedron).sum()
}

/// The level set of a grid as it was read, made valid where that is harmless or asked for, refused where it is no level set.
fn valid(
    path: &Path,
    grid: VolumeGrid,
    options: &InputOptions,
    warnings: &mut Vec<String>,
    context: &Context,
) -> Result<LevelSet> {
    let name = format!("{} [{}]", path.display(), grid.selector);
    let refuse = |problem: String| EditError::NotALevelSet {
        operation: "reading".into(),
        name: name.clone(),
        problem: format!("{problem}; --repair or `rebuild --repair` would make it one from its surface"),
    };
    let (level_set, is_rebuilt) = match grid.band {
        BandState::Regular => (grid.level_set, false),
        BandState::Trim { half_width, what } => {
            warnings.push(format!("{name}: {what}"));
            (grid.level_set.narrowed(half_width), false)
        }
        BandState::Rebuild { what, gross } if gross && !options.repair => return Err(refuse(what)),
        BandState::Rebuild { what, .. } => {
            warnings.push(format!("{name}: {what}: rebuilt from its surface"));
            (rebuilt(&grid.level_set, context)?, true)
        }
    };
    let violations = level_set.check();
    let said = violations.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ");
    if !violations.is_empty() {
        if options.repair && !is_rebuilt {
            warnings.push(format!("{name}: {said}: rebuilt from its surface"));
            return rebuilt(&level_set, context);
        }
        if is_gross(&violations, level_set.grid().active_voxels()) {
            return Err(refuse(said));
        }
        warnings.push(format!("{name}: {said}"));
    }
    if level_set.half_width() < NARROWEST && !level_set.is_empty() {
        warnings.push(format!(
            "{name}: its band of {} voxels is too narrow to be edited: rebuilt from its surface with {DEFAULT_HALF_WIDTH}",
            table::number(f64::from(level_set.half_width()))
        ));
        return rebuilt(&level_set, context);
    }
    Ok(level_set)
}

/// Whether so much is wrong that the values cannot be taken for distances.
fn is_gross(violations: &[Violation], active_voxels: u64) -> bool {
    violations.iter().any(|violation| match violation.kind {
        ViolationKind::NonFinite => true,
        ViolationKind::TooSteep | ViolationKind::TooFlat | ViolationKind::HoleInBand | ViolationKind::SignMismatch => {
            violation.count as f64 > TOLERATED * active_voxels as f64
        }
        _ => false,
    })
}

/// Distances anew from the surface, in a band that is wide enough for every operator.
fn rebuilt(level_set: &LevelSet, context: &Context) -> Result<LevelSet> {
    let half_width = level_set.half_width().max(DEFAULT_HALF_WIDTH);
    rebuild(level_set, &Rebuild::band(half_width), &context.run)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_of_files() {
        for (path, volume) in
            [("-", true), ("a.vdb", true), ("a.VDB", true), ("a.obj", false), ("a", false), ("vdb", false)]
        {
            assert_eq!(is_volume(Path::new(path)), volume, "{path}");
        }
        #[cfg(target_os = "linux")]
        assert!(is_volume(Path::new("/dev/null")));
    }

    #[test]
    fn voxel_sizes_are_not_in_voxels() {
        assert_eq!(length_in_world(&"0.5wu".into()), Some(0.5));
        assert_eq!(length_in_world(&0.25.into()), Some(0.25));
        assert_eq!(length_in_world(&"3vx".into()), None);
    }
}
