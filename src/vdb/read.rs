//! Reading: the listing of a file, and its level sets.

use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek};
use std::path::Path;

use cxx::UniquePtr;
use glam::IVec3;
use rayon::prelude::*;

use super::band::{Band, BandFacts, diagnose_band};
use super::bridge::ffi;
use super::listing::{FileListing, Precision};
use super::select::select_level_set;
use super::structure::{START_BYTES, check_headers, check_start};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LEAF_DIM, LeafMask, LeafValues, MAX_COORD, PageLeaves};
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// Stands for standard input and output.
pub(super) const PIPE: &str = "-";

/// What a file holds, without loading voxels. `-` is standard input. A file written as a stream, which has no table of
/// offsets, must be read whole.
pub fn list(path: impl AsRef<Path>) -> Result<FileListing> {
    let path = path.as_ref();
    let archive = open_archive(path, true)?;
    FileListing::of(&archive).map_err(|e| EditError::input(path, e.what()))
}

/// A file that was read whole: the source of level sets, and of everything that an edit carries over.
pub struct VdbFile {
    pub(super) archive: UniquePtr<ffi::Archive>,
    listing: FileListing,
    pub(super) path: std::path::PathBuf,
    /// The grids whose voxels were given away.
    taken: Vec<usize>,
}

/// A level set as it was read.
#[derive(Clone)]
pub struct ReadLevelSet {
    /// Its values, inactive ones ±background. A valid level set if `band` is [`Band::Regular`].
    pub level_set: LevelSet,
    /// Its place in the file.
    pub index: usize,
    /// What must be done to the band to make it regular.
    pub band: Band,
    /// What was measured of it.
    pub facts: BandFacts,
}

/// Reads a whole file. `-` is standard input. Refused before reading if the file itself says that its grids need more than
/// the memory limit of `run`.
pub fn open(path: impl AsRef<Path>, run: &RunOptions) -> Result<VdbFile> {
    let path = path.as_ref();
    run.check("reading")?;
    if run.memory_limit.is_some() && path.is_file() {
        let listing = list(path)?;
        let needed = listing.grids.iter().filter_map(|g| g.meta("file_mem_bytes")?.parse::<u64>().ok()).sum();
        run.reserve("reading", needed, "take a file with fewer or smaller grids")?;
    }
    let archive = open_archive(path, false)?;
    let listing = FileListing::of(&archive).map_err(|e| EditError::input(path, e.what()))?;
    Ok(VdbFile { archive, listing, path: path.into(), taken: Vec::new() })
}

impl VdbFile {
    /// What the file holds.
    pub fn listing(&self) -> &FileListing {
        &self.listing
    }

    /// The grid that `selector` names and that can be read as a level set: `NAME`, `NAME[n]` for the n-th (from 0) of several
    /// of one name, the empty text for an unnamed grid; without a selector the only one. Grids whose class was never set count
    /// if `assume_level_set`.
    pub fn select_level_set(&self, selector: Option<&str>, assume_level_set: bool) -> Result<usize> {
        select_level_set(&self.listing.grids, selector, assume_level_set).map_err(|e| self.error(e))
    }

    /// Reads the level set that [`select_level_set`](Self::select_level_set) chooses. Doubles are rounded to f32.
    pub fn read_level_set(&self, selector: Option<&str>, assume_level_set: bool) -> Result<ReadLevelSet> {
        let index = self.select_level_set(selector, assume_level_set)?;
        let listing = &self.listing.grids[index];
        let refuse =
            |reason: String| self.error(format!("grid `{}` cannot be a level set: {reason}", listing.selector));
        self.check_present(index)?;
        let transform = listing.uniform_transform().map_err(refuse)?;
        let leaves = ffi::archive_leaves(&self.archive, index).map_err(|e| refuse(e.what().into()))?;
        let (mut grid, facts) = read_grid(&leaves, transform.voxel_size()).map_err(refuse)?;
        if listing.precision == Precision::Half {
            drop_rounded_rim(&mut grid, facts.active.low.abs().max(facts.active.high));
        }
        let band = diagnose_band(&facts, transform.voxel_size());
        Ok(ReadLevelSet { level_set: LevelSet::new(grid, transform), index, band, facts })
    }

    /// As [`read_level_set`](Self::read_level_set), and lets go of the voxels that OpenVDB holds: they are not in memory
    /// twice. What is left of the grid is what a result in its place takes over; it cannot be read or written again.
    pub fn take_level_set(&mut self, selector: Option<&str>, assume_level_set: bool) -> Result<ReadLevelSet> {
        let read = self.read_level_set(selector, assume_level_set)?;
        ffi::release_voxels(self.archive.pin_mut(), read.index).map_err(|e| self.error(e.what()))?;
        self.taken.push(read.index);
        Ok(read)
    }

    /// Fails if the voxels of a grid were taken.
    pub(super) fn check_present(&self, index: usize) -> Result<()> {
        match self.taken.contains(&index) {
            true => Err(self.error(format!("the voxels of grid `{}` were taken", self.listing.grids[index].selector))),
            false => Ok(()),
        }
    }

    /// 128 bits, as text, that are equal for grids of the same structure and values: for tests and comparisons.
    pub fn fingerprint(&self, index: usize) -> Result<String> {
        ffi::grid_fingerprint(&self.archive, index).map_err(|e| self.error(e.what()))
    }

    fn error(&self, problem: impl Into<String>) -> EditError {
        EditError::input(&self.path, problem)
    }
}

/// Limits the threads that OpenVDB uses from now on; 0 lifts the limit.
pub fn set_threads(threads: usize) -> Result<()> {
    ffi::set_threads(threads).map_err(|e| EditError::parameter("OpenVDB", "threads", threads, e.what()))
}

/// Gives memory that was freed back to the system. The C library keeps millions of small blocks otherwise, in the pools of threads that may not need
/// them again.
pub fn trim_heap() {
    ffi::trim_heap();
}

/// Version of the OpenVDB library in use.
pub fn library_version() -> String {
    ffi::library_version().unwrap_or_else(|_| "unknown".into())
}

fn open_archive(path: &Path, headers_only: bool) -> Result<UniquePtr<ffi::Archive>> {
    let fail = |problem: String| EditError::input(path, problem);
    let bytes = if path == Path::new(PIPE) {
        Some(read_all(std::io::stdin().lock()))
    } else {
        let facts = std::fs::metadata(path).map_err(|e| fail(format!("cannot be opened: {e}")))?;
        if facts.is_dir() {
            return Err(fail("is a directory; a .vdb file is wanted".into()));
        }
        // Pipes and devices cannot seek.
        (!facts.is_file()).then(|| read_all(std::fs::File::open(path)?))
    };
    let newest = ffi::newest_file_version();
    let archive = match bytes {
        Some(bytes) => {
            let bytes = bytes.map_err(|e| fail(format!("cannot be read: {e}")))?;
            check_start(&bytes[..bytes.len().min(START_BYTES)], newest).map_err(fail)?;
            check_headers(Cursor::new(&bytes), bytes.len() as u64).map_err(fail)?;
            ffi::read_bytes(&bytes, headers_only)
        }
        None => {
            let unreadable = |e| fail(format!("cannot be read: {e}"));
            let mut file = BufReader::new(File::open(path).map_err(unreadable)?);
            let start = read_all((&mut file).take(START_BYTES as u64)).map_err(unreadable)?;
            check_start(&start, newest).map_err(fail)?;
            file.rewind().map_err(unreadable)?;
            let size = file.get_ref().metadata().map_err(unreadable)?.len();
            check_headers(file, size).map_err(fail)?;
            ffi::read_path(path.as_os_str().as_encoded_bytes(), headers_only)
        }
    };
    archive.map_err(|e| fail(e.what().into()))
}

fn read_all(mut from: impl Read) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    from.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Makes active voxels that half precision has rounded up to the background inactive, as they would be if they were so in float.
fn drop_rounded_rim(grid: &mut Grid, widest: f64) {
    // Half numbers have 11 bits: values and background are each off by 2⁻¹² of themselves at most.
    const ROUNDING: f64 = 1.0 + 1.0 / 1024.0;
    let background = grid.background();
    if widest < f64::from(background) || widest > f64::from(background) * ROUNDING {
        return;
    }
    grid.update_all(|_, values, mask| {
        for (offset, value) in values.0.iter_mut().enumerate() {
            if mask.get(offset) && value.abs() >= background {
                *value = background.copysign(*value);
                mask.set(offset, false);
            }
        }
    });
    let leaves = grid.leaf_set().clone();
    grid.prune(&leaves);
}

/// Copies the leaves and signs of a float or double grid. Inactive voxels become ±background by their sign, once what
/// they held has been noted. Fails with a reason.
pub(super) fn read_grid(leaves: &ffi::Leaves, voxel_size: f64) -> Result<(Grid, BandFacts), String> {
    let mut flat = vec![0; leaves.count() * 3];
    leaves.origins(&mut flat).map_err(|e| e.what().to_string())?;
    let (triples, _) = flat.as_chunks::<3>();
    // Ours are in the order of origins; OpenVDB's go node by node.
    let mut order: Vec<(IVec3, usize)> = triples.iter().map(|o| IVec3::from_array(*o)).zip(0..).collect();
    order.par_sort_unstable_by_key(|(o, _)| (o.x, o.y, o.z));
    if let Some((far, _)) = order.iter().find(|(o, _)| o.abs().max_element() > MAX_COORD - LEAF_DIM) {
        return Err(format!("it reaches to voxel {far}; coordinates go to ±{MAX_COORD}"));
    }
    let origins: Vec<IVec3> = order.iter().map(|(o, _)| *o).collect();

    let mut facts = BandFacts::new(leaves.background());
    facts.take_tiles(leaves).map_err(|e| e.what().to_string())?;
    let background = facts.usable_background(voxel_size);
    let mut grid = Grid::from_origins(background, &origins);
    let places = grid.places();
    let all = grid.leaf_set().clone();
    let pages = grid.update_pages(&all, |page, values, masks| {
        let mut facts = BandFacts::new(0.0);
        let mut failed = None;
        page.for_each(|id| {
            let (values, mask) = (&mut values[PageLeaves::slot(id)], &mut masks[PageLeaves::slot(id)]);
            if let Err(e) = leaves.copy(order[places[id.index()] as usize].1, &mut values.0, &mut mask.0) {
                failed.get_or_insert(e.what().to_string());
            }
            // While the leaf is in the cache.
            let of_leaf = BandFacts::of_leaf(values, *mask);
            if of_leaf.has_odd_inactive(background) {
                set_inactive(values, *mask, background);
            }
            facts.join(&of_leaf);
        });
        failed.map_or(Ok(facts), Err)
    });
    for page in pages {
        facts.join(&page?);
    }
    set_signs(&mut grid, leaves)?;
    Ok((grid, facts))
}

/// Sets inactive voxels to the background of their sign.
fn set_inactive(values: &mut LeafValues, mask: LeafMask, background: f32) {
    for (offset, value) in values.0.iter_mut().enumerate() {
        if !mask.get(offset) {
            *value = background.copysign(*value);
        }
    }
}

/// Gives the space between the leaves the signs of the tiles.
fn set_signs(grid: &mut Grid, leaves: &ffi::Leaves) -> Result<(), String> {
    const NODE_WORDS: usize = 64;
    let mut origins = vec![0; leaves.node_count() * 3];
    let mut inside = vec![0; leaves.node_count() * NODE_WORDS];
    leaves.node_origins(&mut origins).map_err(|e| e.what().to_string())?;
    leaves.node_inside(&mut inside).map_err(|e| e.what().to_string())?;
    let (origins, _) = origins.as_chunks::<3>();
    for (origin, words) in origins.iter().zip(inside.chunks_exact(NODE_WORDS)) {
        for (word, &bits) in words.iter().enumerate() {
            // A word holds four rows of 16 slots along z: one call a run of inside slots.
            for row in 0..4 {
                let mut bits = (bits >> (16 * row)) as u16;
                let (x, y) = (word as i32 / 4, word as i32 % 4 * 4 + row);
                let mut z = 0;
                while bits != 0 {
                    let gap = bits.trailing_zeros();
                    let run = (bits >> gap).trailing_ones();
                    z += gap as i32;
                    let lo = IVec3::from_array(*origin) + IVec3::new(x, y, z) * LEAF_DIM;
                    grid.set_sign(lo, lo + IVec3::new(1, 1, run as i32) * LEAF_DIM, true);
                    z += run as i32;
                    bits = bits.checked_shr(gap + run).unwrap_or(0);
                }
            }
        }
    }
    // What is inside lies between leaves of the band. A tile that reaches beyond all of them is cut there: its space costs
    // memory, and a file of a few kilobytes can claim any amount of it.
    let Some((first, last)) = leaf_box(grid) else { return Ok(()) };
    let mut boxes = Vec::new();
    for tile in leaves.tiles().map_err(|e| e.what().to_string())? {
        let lo = IVec3::new(tile.x, tile.y, tile.z);
        if tile.value < 0.0 && tile.size > 8 {
            if lo.abs().max_element() > MAX_COORD - tile.size as i32 {
                return Err(format!("it is solid at voxel {lo}; coordinates go to ±{MAX_COORD}"));
            }
            let (lo, hi) = (lo.max(first), (lo + IVec3::splat(tile.size as i32)).min(last));
            if lo.cmplt(hi).all() {
                boxes.push((lo, hi));
            }
        }
    }
    let volume: f64 = boxes.iter().map(|(lo, hi)| (hi - lo).as_dvec3().element_product()).sum();
    let limit = (MOST_SIGN_BYTES + grid.leaves().len() * BYTES_A_LEAF * MOST_SIGNS_A_LEAF) as f64;
    if volume * SIGN_BYTES_A_VOXEL > limit {
        return Err(format!("its solid tiles fill {volume:e} voxels, far more than its narrow band can enclose"));
    }
    boxes.into_iter().for_each(|(lo, hi)| grid.set_sign(lo, hi, true));
    Ok(())
}

/// Memory that a node of 16³ absent leaves takes, for each voxel in it.
const SIGN_BYTES_A_VOXEL: f64 = (16 * 16 * 16 * 4) as f64 / (128.0 * 128.0 * 128.0);
/// Memory that the signs of solid tiles may take in any file: a solid of 6500³ voxels.
const MOST_SIGN_BYTES: usize = 1 << 31;
/// And, of the memory of the leaves, so many times more.
const MOST_SIGNS_A_LEAF: usize = 4;
const BYTES_A_LEAF: usize = 2048;

/// First voxel of the box of all leaves, and the one after its last.
fn leaf_box(grid: &Grid) -> Option<(IVec3, IVec3)> {
    let origins = grid.leaves().iter().map(|&id| grid.origin(id));
    let (lo, hi) = origins.map(|o| (o, o)).reduce(|(lo, hi), (o, _)| (lo.min(o), hi.max(o)))?;
    Some((lo, hi + IVec3::splat(LEAF_DIM)))
}
