//! Level sets from files: grids of a `.vdb` are verified, meshes converted.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::mesh_output;
use super::volume::{self, BandState, Choice, Volume, VolumeGrid};
use crate::error::{EditError, Result};
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet, Violation, ViolationKind};
use crate::mesh::{self, MeshFormat, MeshToLevelSet, Rebuild, TriangleMesh, mesh_to_level_set, rebuild};
use crate::ops::{VoxelLength, WorldLength};
use crate::run::RunOptions;
use crate::scan::{Inside, Scan, is_scan};

/// What can be read and written.
pub const EXTENSIONS: &str = ".vdb, .obj, .ply, .stl, .glb, .gltf or .off";

/// What to do with a scan where a level set is expected.
const SCAN: &str = "is a scan: `vdb-edit convert --iso VALUE` makes a level set of it, `vdb-edit segment` a smooth one";

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
#[derive(Clone, Debug, Default)]
pub struct InputOptions {
    /// Which level set of each `.vdb`; the last name goes for all that follow.
    pub grids: Vec<String>,
    /// Whether float grids without a class are taken for level sets.
    pub assume_level_set: bool,
    /// Whether invalid level sets are rebuilt from their surface.
    pub repair: bool,
    /// Whether meshes that would have to be repaired are refused.
    pub strict: bool,
    /// Edge of a voxel, for meshes.
    pub voxel_size: Option<WorldLength>,
    /// Voxels along the longest axis of all meshes together.
    pub resolution: Option<f64>,
    /// Half width of the band, for meshes.
    pub half_width: Option<VoxelLength>,
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

    /// Takes the level set; an empty one stays.
    pub fn release(&mut self) -> LevelSet {
        let empty = LevelSet::empty(*self.level_set.transform(), self.level_set.half_width());
        std::mem::replace(&mut self.level_set, empty)
    }
}

impl InputOptions {
    /// Refuses what cannot work.
    pub fn validate(&self) -> Result<()> {
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter("convert", field, value, accepted));
        if let Some(size) = self.voxel_size {
            // Asked in a world whose voxels have no size, a length in voxels is no number.
            let world = size.world(f64::NAN);
            if !(world > 0.0 && world.is_finite()) {
                return refuse("voxel_size", size.to_string(), "a positive length in world units, such as 0.01");
            }
        }
        match (self.resolution, self.voxel_size) {
            (Some(n), _) if !(n >= 1.0 && n.is_finite()) => {
                refuse("resolution", n.to_string(), "a number of voxels, 1 or more, such as 256")
            }
            (Some(n), Some(_)) => refuse("resolution", n.to_string(), "either `voxel_size` or `resolution`, not both"),
            _ => Ok(()),
        }
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
        Ok(_) if is_scan(path) => EditError::input(path, SCAN),
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
    run: &RunOptions,
) -> Result<Vec<Input>> {
    load_with(paths, options, Volume::take, warnings, run)
}

/// As [`load`], each for itself: the first as the options say, the meshes after it with voxels of their own size.
pub fn load_apart(
    paths: &[PathBuf],
    options: &InputOptions,
    warnings: &mut Vec<String>,
    run: &RunOptions,
) -> Result<Vec<Input>> {
    one_pipe(paths)?;
    let mut inputs = Vec::new();
    for path in paths {
        let own = InputOptions {
            voxel_size: None,
            resolution: None,
            grids: options.choice(inputs.len()).grid.map(str::to_owned).into_iter().collect(),
            ..options.clone()
        };
        let options = if inputs.is_empty() { options } else { &own };
        inputs.append(&mut load(std::slice::from_ref(path), options, warnings, run)?);
    }
    Ok(inputs)
}

/// As [`load`], for results that go beside the grids that the level sets are read from: files stay whole.
pub fn load_whole(
    paths: &[PathBuf],
    options: &InputOptions,
    warnings: &mut Vec<String>,
    run: &RunOptions,
) -> Result<Vec<Input>> {
    load_with(paths, options, |volume, choice| volume.read(choice), warnings, run)
}

fn load_with(
    paths: &[PathBuf],
    options: &InputOptions,
    read: impl Fn(&mut Volume, Choice) -> Result<VolumeGrid>,
    warnings: &mut Vec<String>,
    run: &RunOptions,
) -> Result<Vec<Input>> {
    one_pipe(paths)?;
    // All kinds are known before anything large is read.
    for path in paths.iter().filter(|path| !is_volume(path)) {
        mesh_format(path)?;
    }
    let mut raw = Vec::new();
    let mut volumes = 0;
    for path in paths {
        run.check("reading")?;
        if is_volume(path) {
            let mut volume = volume::open(path, run)?;
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
                (valid(path, grid, options, warnings, run)?, Some((volume, Some(index))), None)
            }
            Raw::Mesh(mesh) => {
                (convert(path, &mesh, &conversion, warnings, run)?, None, mesh_output::attributes_of(&mesh))
            }
        };
        if level_set.is_empty() {
            warnings.push(format!("{}: the level set is empty: there is no surface", path.display()));
        }
        inputs.push(Input { path: path.clone(), level_set, source, attributes });
    }
    Ok(inputs)
}

/// Refuses standard input for several inputs.
fn one_pipe(paths: &[PathBuf]) -> Result<()> {
    if paths.iter().filter(|path| is_pipe(path)).count() > 1 {
        let accepted = "standard input can be read once: give `-` once";
        return Err(EditError::parameter("vdb-edit", "input", "-", accepted));
    }
    Ok(())
}

/// The level set of the surface of a scalar volume at `iso`; `None` if the file holds a level set, or is none of volumes.
pub fn load_iso(
    path: &Path,
    options: &InputOptions,
    iso: f32,
    inside: Inside,
    warnings: &mut Vec<String>,
    run: &RunOptions,
) -> Result<Option<Input>> {
    let half_width = |voxel_size| options.half_width.map_or(DEFAULT_HALF_WIDTH, |w| w.voxels(voxel_size) as f32);
    let no_surface = || {
        let side = if inside == Inside::Above { "more" } else { "less" };
        EditError::input(path, format!("no voxel holds {side} than {iso}: there is no surface"))
    };
    if is_scan(path) {
        let scan = Scan::read(path, run)?;
        let (scan, resampled) = scan.on_cubes(run).map_err(|problem| EditError::input(path, problem))?;
        warnings.extend(resampled.map(|said| format!("{}: {said}", path.display())));
        let field = scan.iso_field(iso, inside, run).map_err(|error| naming(path, error))?.ok_or_else(no_surface)?;
        let level_set = rebuild(&field, &Rebuild::band(half_width(field.voxel_size())), run)?;
        return Ok(Some(Input { path: path.to_path_buf(), level_set, source: None, attributes: None }));
    }
    if !is_volume(path) || is_pipe(path) {
        return Ok(None);
    }
    let choice = options.choice(0);
    let volume = volume::open(path, run)?;
    if volume.has_level_set(choice) {
        return Ok(None);
    }
    warnings.extend(volume.warnings().iter().map(|w| format!("{}: {w}", path.display())));
    let field = volume.read_iso_field(choice.grid, iso, inside, run)?;
    let level_set = rebuild(&field, &Rebuild::band(half_width(field.voxel_size())), run)?;
    if level_set.is_empty() {
        return Err(no_surface());
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
        (Some(size), ..) => size.world(1.0),
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
    run: &RunOptions,
) -> Result<LevelSet> {
    let (level_set, findings) = mesh_to_level_set(mesh, conversion, run).map_err(|error| naming(path, error))?;
    warnings.extend(findings.warnings().into_iter().map(|w| format!("{}: {w}", path.display())));
    // Where the mesh was repaired, its own volume says nothing.
    if findings.is_sound() && findings.duplicates_dropped == 0 {
        let (wanted, has) = (enclosed_volume(mesh), level_set.measure(run)?.volume);
        if (has - wanted).abs() > LOST * wanted.abs() {
            warnings.push(format!(
                "{}: the level set has {:.1} % of the mesh's volume: parts or walls thinner than a voxel are lost; take a voxel size smaller than {:e}",
                path.display(),
                100.0 * has / wanted.abs(),
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
    run: &RunOptions,
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
            (rebuilt(&grid.level_set, run)?, true)
        }
    };
    let violations = level_set.check();
    let said = violations.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ");
    if !violations.is_empty() {
        if options.repair && !is_rebuilt {
            warnings.push(format!("{name}: {said}: rebuilt from its surface"));
            return rebuilt(&level_set, run);
        }
        if is_gross(&violations, level_set.grid().active_voxels()) {
            return Err(refuse(said));
        }
        warnings.push(format!("{name}: {said}"));
    }
    wide_enough(&name, level_set, warnings, run)
}

/// A level set in a band that is wide enough to be edited; `name` is what a warning calls it.
pub fn wide_enough(name: &str, level_set: LevelSet, warnings: &mut Vec<String>, run: &RunOptions) -> Result<LevelSet> {
    if level_set.half_width() >= NARROWEST || level_set.is_empty() {
        return Ok(level_set);
    }
    warnings.push(format!(
        "{name}: its band of {:.2} voxels is too narrow to be edited: rebuilt from its surface with {DEFAULT_HALF_WIDTH}",
        level_set.half_width()
    ));
    rebuilt(&level_set, run)
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
fn rebuilt(level_set: &LevelSet, run: &RunOptions) -> Result<LevelSet> {
    let half_width = level_set.half_width().max(DEFAULT_HALF_WIDTH);
    rebuild(level_set, &Rebuild::band(half_width), run)
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
        let of = |size: &str| InputOptions { voxel_size: size.parse().ok(), ..InputOptions::default() }.validate();
        assert!(of("0.5wu").is_ok() && of("0.25").is_ok());
        for size in ["3vx", "0", "-1"] {
            assert!(of(size).is_err(), "{size}");
        }
    }
}
