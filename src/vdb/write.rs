//! Writing: to a temporary file beside the target, flushed, read back, compared, renamed.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::pin::Pin;

use cxx::UniquePtr;
use rayon::prelude::*;

use super::bridge::ffi;
use super::listing::{Compression, Precision};
use super::read::{PIPE, VdbFile};
use crate::atomic::{final_target, temporary_in};
use crate::error::{EditError, Result};
use crate::grid::{Grid, Transform};
use crate::levelset::{Field, LevelSet};

/// The smallest edge of a voxel that OpenVDB's maps take: they refuse determinants below 3e-15.
const SMALLEST_VOXEL: f64 = 1.45e-5;

/// What made a grid, in its metadata.
const CREATOR: &str = concat!("vdb-edit ", env!("CARGO_PKG_VERSION"));

/// How a file is written. The default keeps what the input had, else float and blosc.
#[derive(Clone, Debug, Default)]
pub struct WriteOptions {
    /// How the values of the written level sets are stored; `None` keeps that of the grid they replace.
    pub precision: Option<Precision>,
    /// How the file is compressed; `None` keeps that of the input. Points keep what they have.
    pub compression: Option<Compression>,
    /// Leaves the other grids of the input out.
    pub only_result: bool,
}

/// A level set on its way to a file.
#[derive(Clone, Copy)]
pub struct GridToWrite<'a> {
    /// The level set.
    pub level_set: &'a LevelSet,
    /// Its name; `None` keeps that of the grid it replaces, else the grid is unnamed.
    pub name: Option<&'a str>,
    /// The grid of the input, by its place in the file, whose metadata it takes over and in whose place it is written.
    pub replaces: Option<usize>,
}

/// A field on its way to a file, as a float grid of no class.
#[derive(Clone, Copy)]
pub struct FieldToWrite<'a> {
    /// The field.
    pub field: &'a Field,
    /// Its name.
    pub name: &'a str,
}

/// Three fields of one level set on their way to a file, as a grid of vectors.
#[derive(Clone, Copy)]
pub struct VectorsToWrite<'a> {
    /// The components.
    pub components: &'a [Field; 3],
    /// Their name.
    pub name: &'a str,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WriteReport {
    /// Size of the file.
    pub bytes: u64,
    /// Number of grids in it.
    pub grids: usize,
    /// What is not as asked, and why.
    pub warnings: Vec<String>,
}

/// Writes level sets, and with them the metadata and all other grids of `input`, to `path`; `-` is standard output.
///
/// What is there already is replaced only when the new file is complete, on disk, and was found to hold what was meant to be
/// written. Any failure leaves the target as it was and nothing else behind.
pub fn write(
    path: impl AsRef<Path>,
    grids: &[GridToWrite<'_>],
    input: Option<&VdbFile>,
    options: &WriteOptions,
) -> Result<WriteReport> {
    write_all(path.as_ref(), grids, &[], None, input, options)
}

/// As [`write()`], with a grid of vectors after all other grids.
pub fn write_with_vectors(
    path: impl AsRef<Path>,
    grids: &[GridToWrite<'_>],
    vectors: VectorsToWrite<'_>,
    input: Option<&VdbFile>,
    options: &WriteOptions,
) -> Result<WriteReport> {
    write_all(path.as_ref(), grids, &[], Some(vectors), input, options)
}

/// As [`write()`], with fields after all other grids.
pub fn write_with_fields(
    path: impl AsRef<Path>,
    grids: &[GridToWrite<'_>],
    fields: &[FieldToWrite<'_>],
    input: Option<&VdbFile>,
    options: &WriteOptions,
) -> Result<WriteReport> {
    write_all(path.as_ref(), grids, fields, None, input, options)
}

fn write_all(
    path: &Path,
    grids: &[GridToWrite<'_>],
    fields: &[FieldToWrite<'_>],
    vectors: Option<VectorsToWrite<'_>>,
    input: Option<&VdbFile>,
    options: &WriteOptions,
) -> Result<WriteReport> {
    let output = Target { path };
    let compression = options.compression.or_else(|| Compression::of_all(&input?.listing().grids));
    let compression = compression.unwrap_or(Compression::Blosc);
    let sizes = grids.iter().map(|g| g.level_set.voxel_size());
    let sizes = sizes.chain(fields.iter().map(|f| f.field.transform().voxel_size()));
    if let Some(small) = sizes.into_iter().find(|size| *size < SMALLEST_VOXEL) {
        return Err(output.error(format!(
            "OpenVDB stores no voxels smaller than {SMALLEST_VOXEL} world units, these are {small:e}: scale the model up, as by `transform --scale 1000`"
        )));
    }
    if let (Some(file), false) = (input, options.only_result) {
        for index in (0..file.listing().grids.len()).filter(|index| grids.iter().all(|g| g.replaces != Some(*index))) {
            file.check_present(index)?;
        }
    }
    // SAFETY: the level sets are borrowed for longer than `content` lives.
    let collected = unsafe { collect(grids, input, options) };
    let (mut content, mut count) = collected.map_err(|e| output.error(e.what()))?;
    for field in fields {
        // SAFETY: as above.
        let made = to_openvdb_field(field, |grid, of| unsafe { lend_leaves(grid, of) }, options);
        let added = made.and_then(|grid| content.pin_mut().add_grid(grid));
        added.map_err(|e| output.error(e.what()))?;
        count += 1;
    }
    if let Some(VectorsToWrite { components: [x, y, z], name }) = vectors {
        // Halves are compared after rounding for grids of floats alone.
        let whole = WriteOptions { precision: None, ..options.clone() };
        let component = |field| to_openvdb_field(&FieldToWrite { field, name }, copy_leaves, &whole);
        let mut add = || content.pin_mut().add_vectors(component(x)?, component(y)?, component(z)?);
        add().map_err(|e| output.error(e.what()))?;
        count += 1;
    }
    let bytes = output.write(content.pin_mut(), compression.flags())?;
    let mut warnings: Vec<_> =
        ffi::take_log().map_err(|e| output.error(e.what()))?.lines().map(str::to_string).collect();
    if compression == Compression::Zip && !grids.is_empty() {
        warnings.push("OpenVDB does not zip level sets: they are stored uncompressed".into());
    }
    Ok(WriteReport { bytes, grids: count, warnings })
}

/// All grids of the file to be, in order.
///
/// # Safety
/// The level sets stay as they are for as long as the output lives.
unsafe fn collect(
    grids: &[GridToWrite<'_>],
    input: Option<&VdbFile>,
    options: &WriteOptions,
) -> Result<(UniquePtr<ffi::Output>, usize), cxx::Exception> {
    let mut content = ffi::new_output()?;
    let mut count = 0;
    // SAFETY: as this function.
    let lent = |grid: &GridToWrite<'_>, input| unsafe { to_openvdb_grid(grid, input, options) };
    if let Some(file) = input {
        content.pin_mut().carry_metadata(&file.archive)?;
        for index in 0..file.listing().grids.len() {
            if let Some(grid) = grids.iter().find(|g| g.replaces == Some(index)) {
                content.pin_mut().add_grid(lent(grid, input)?)?;
            } else if !options.only_result {
                content.pin_mut().carry_grid(&file.archive, index)?;
            } else {
                continue;
            }
            count += 1;
        }
    }
    let known = input.map_or(0, |file| file.listing().grids.len());
    for grid in grids.iter().filter(|g| g.replaces.is_none_or(|index| index >= known)) {
        content.pin_mut().add_grid(lent(grid, None)?)?;
        count += 1;
    }
    Ok((content, count))
}

/// # Safety
/// As [`lend_leaves`].
unsafe fn to_openvdb_grid(
    grid: &GridToWrite<'_>,
    input: Option<&VdbFile>,
    options: &WriteOptions,
) -> Result<UniquePtr<ffi::FloatGrid>, cxx::Exception> {
    // SAFETY: as this function.
    let mut made = to_openvdb(grid.level_set, |made, of| unsafe { lend_leaves(made, of) })?;
    let mut precision = options.precision;
    if let (Some(file), Some(index)) = (input, grid.replaces) {
        let listing = &file.listing().grids[index];
        // The very transform of the input if it is still the same: its kind and every bit of it stay.
        let same = listing.to_world == Some(grid.level_set.transform().to_world());
        made.pin_mut().carry(&file.archive, index, same)?;
        precision = precision.or(Some(listing.precision));
    } else {
        made.pin_mut().set_creator(CREATOR)?;
    }
    if let Some(name) = grid.name {
        made.pin_mut().set_name(name)?;
    }
    made.pin_mut().set_half(precision == Some(Precision::Half))?;
    Ok(made)
}

fn to_openvdb_field(
    to_write: &FieldToWrite<'_>,
    add_leaves: impl AddLeaves,
    options: &WriteOptions,
) -> Result<UniquePtr<ffi::FloatGrid>, cxx::Exception> {
    let FieldToWrite { field, name } = to_write;
    let mut made = ffi::new_float_grid(0.0)?;
    add_leaves(made.pin_mut(), field.grid())?;
    made.pin_mut().set_affine(&matrix(field.transform()))?;
    made.pin_mut().set_creator(CREATOR)?;
    made.pin_mut().set_name(name)?;
    made.pin_mut().set_half(options.precision == Some(Precision::Half))?;
    Ok(made)
}

/// How the leaves of a grid come into one of OpenVDB's.
pub(super) trait AddLeaves: Fn(Pin<&mut ffi::FloatGrid>, &Grid) -> Result<(), cxx::Exception> {}

impl<F: Fn(Pin<&mut ffi::FloatGrid>, &Grid) -> Result<(), cxx::Exception>> AddLeaves for F {}

/// A level set in OpenVDB's own tree: all leaves, and the inside as tiles.
pub(super) fn to_openvdb(
    level_set: &LevelSet,
    add_leaves: impl AddLeaves,
) -> Result<UniquePtr<ffi::FloatGrid>, cxx::Exception> {
    let grid = level_set.grid();
    let mut made = ffi::new_level_set(f64::from(grid.background()))?;
    add_leaves(made.pin_mut(), grid)?;
    let value = -grid.background();
    let tiles: Vec<ffi::Tile> = grid
        .inside_tiles()
        .into_iter()
        .map(|(o, edge)| ffi::Tile { x: o.x, y: o.y, z: o.z, size: edge.unsigned_abs(), value, active: false })
        .collect();
    made.pin_mut().add_tiles(&tiles)?;
    made.pin_mut().set_affine(&matrix(level_set.transform()))?;
    Ok(made)
}

/// Row-major 4x4 that acts on columns.
pub(super) fn matrix(transform: &Transform) -> [f64; 16] {
    let m = transform.to_world();
    let [x, y, z, t] = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis, m.translation];
    [x.x, y.x, z.x, t.x, x.y, y.y, z.y, t.y, x.z, y.z, z.z, t.z, 0.0, 0.0, 0.0, 1.0]
}

fn add_origins(made: Pin<&mut ffi::FloatGrid>, grid: &Grid) -> Result<(), cxx::Exception> {
    let origins: Vec<i32> = grid.leaves().iter().flat_map(|&id| grid.origin(id).to_array()).collect();
    made.add_leaves(&origins)
}

/// Adds leaves with values of their own.
pub(super) fn copy_leaves(mut made: Pin<&mut ffi::FloatGrid>, grid: &Grid) -> Result<(), cxx::Exception> {
    add_origins(made.as_mut(), grid)?;
    let made = made.as_ref().get_ref();
    grid.leaves().par_iter().with_min_len(16).enumerate().try_for_each(|(index, &id)| {
        // SAFETY: every task fills another leaf.
        unsafe { made.fill(index, &grid.values(id).0, &grid.mask(id).0) }
    })
}

/// Adds leaves whose values stay in the grid: for an output only.
///
/// # Safety
/// The grid stays as it is for as long as what was made, and the output that it is added to, live.
unsafe fn lend_leaves(mut made: Pin<&mut ffi::FloatGrid>, grid: &Grid) -> Result<(), cxx::Exception> {
    add_origins(made.as_mut(), grid)?;
    // SAFETY: as this function.
    grid.leaves().iter().try_for_each(|&id| unsafe { made.as_mut().lend(&grid.values(id).0, &grid.mask(id).0) })
}

/// Where a file goes.
struct Target<'a> {
    path: &'a Path,
}

impl Target<'_> {
    fn error(&self, problem: impl Into<String>) -> EditError {
        EditError::output(self.path, problem)
    }

    fn io(&self, what: &str) -> impl Fn(std::io::Error) -> EditError {
        move |e| self.error(format!("{what}: {e}"))
    }

    /// Writes and verifies; returns the size.
    fn write(&self, content: Pin<&mut ffi::Output>, compression: u32) -> Result<u64> {
        if self.path == Path::new(PIPE) {
            return self.write_through(content, compression, std::io::stdout().lock());
        }
        // Devices are asked for by the path as given: links like /dev/stdout lead to names that only the kernel can follow.
        let real = match std::fs::metadata(self.path) {
            Ok(facts) if !facts.is_file() => self.path.to_path_buf(),
            _ => final_target(self.path)?,
        };
        match std::fs::metadata(&real) {
            Ok(facts) if facts.is_dir() => Err(self.error("it is a directory")),
            Ok(facts) if !facts.is_file() => {
                let device =
                    std::fs::OpenOptions::new().write(true).open(&real).map_err(self.io("cannot be opened"))?;
                self.write_through(content, compression, device)
            }
            facts => self.replace(content, compression, &real, facts.ok()),
        }
    }

    /// To a pipe or device: verified in memory first.
    fn write_through(&self, mut content: Pin<&mut ffi::Output>, compression: u32, mut to: impl Write) -> Result<u64> {
        let bytes = content.as_mut().write_bytes(compression).map_err(|e| self.error(e.what()))?;
        content.as_mut().seal().map_err(|e| self.error(e.what()))?;
        self.verify(&content, || ffi::fingerprint_bytes(bytes.as_bytes()))?;
        to.write_all(bytes.as_bytes()).and_then(|()| to.flush()).map_err(self.io("writing"))?;
        Ok(bytes.len() as u64)
    }

    fn replace(
        &self,
        mut content: Pin<&mut ffi::Output>,
        compression: u32,
        real: &Path,
        old: Option<std::fs::Metadata>,
    ) -> Result<u64> {
        let folder = match real.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
            _ => PathBuf::from("."),
        };
        let in_folder = format!("no file can be made in {}", folder.display());
        let (_unfinished, temporary) = temporary_in(&folder, ".vdb").map_err(self.io(&in_folder))?;
        let name = temporary.path().as_os_str().as_encoded_bytes();
        content.as_mut().write_path(name, compression).map_err(|e| self.error(e.what()))?;
        // The disk and the processor have different work to do.
        let verified = std::thread::scope(|scope| {
            let flushed = scope.spawn(|| temporary.as_file().sync_all());
            // Sealed before it is read back, so that the two copies are never in memory together.
            let sealed = content.as_mut().seal().map_err(|e| self.error(e.what()));
            let verified = sealed.and_then(|()| self.verify(&content, || ffi::fingerprint_path(name)));
            let flushed = flushed.join().unwrap_or_else(|_| Err(std::io::Error::other("the flushing thread failed")));
            flushed.map_err(self.io("flushing")).and(verified)
        });
        verified?;
        let bytes = temporary.as_file().metadata().map_err(self.io("flushing"))?.len();
        if let Some(old) = old {
            temporary.as_file().set_permissions(old.permissions()).map_err(self.io("setting its permissions"))?;
        }
        temporary.persist(real).map_err(|e| self.io("renaming")(e.error))?;
        // So that the new name survives a power failure; not every file system can, and the content is safe either way.
        let _ = std::fs::File::open(&folder).and_then(|f| f.sync_all());
        Ok(bytes)
    }

    fn verify(
        &self,
        content: &ffi::Output,
        read_back: impl FnOnce() -> Result<UniquePtr<ffi::Archive>, cxx::Exception>,
    ) -> Result<()> {
        let failed = |problem: &str| self.error(format!("what was written does not read back: {problem}"));
        let archive = read_back().map_err(|e| failed(e.what()))?;
        let difference = content.verify(&archive).map_err(|e| failed(e.what()))?;
        if difference.is_empty() { Ok(()) } else { Err(failed(&difference)) }
    }
}
