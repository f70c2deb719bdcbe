//! The surface of a scalar volume (density, temperature) at a value.
//!
//! What is read is the field iso − value (or value − iso): negative where the volume holds more than iso (less), zero on the surface, linear between voxels as the
//! volume is. It is no distance; [`rebuild`](crate::mesh::rebuild) makes one of it.

use glam::IVec3;

use super::VdbFile;
use super::bridge::ffi;
use crate::error::{EditError, Result};
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafValues, MAX_COORD, Volume};
use crate::levelset::LevelSet;
use crate::run::RunOptions;
use crate::scan::Inside;

/// Bytes of a leaf: values, mask and tables, and once more the copy that is read into.
const BYTES_A_LEAF: u64 = 2 * 2048 + 512;

impl VdbFile {
    /// The place of the scalar grid that `selector` names; without one the only scalar grid.
    pub fn select_scalar(&self, selector: Option<&str>) -> Result<usize> {
        let refuse = |problem: String| EditError::input(&self.path, problem);
        let grids = &self.listing().grids;
        let scalars: Vec<usize> = (0..grids.len()).filter(|&i| grids[i].is_scalar()).collect();
        let index = match (selector, &scalars[..]) {
            (Some(selector), _) => self.listing().find(selector).map_err(refuse)?,
            (None, [index]) => *index,
            (None, []) => return Err(refuse("there is no grid of numbers in it".into())),
            (None, several) => {
                let names: Vec<String> = several.iter().map(|&i| format!("`{}`", grids[i].selector)).collect();
                return Err(refuse(format!("it holds several volumes: {}; choose one", names.join(", "))));
            }
        };
        match grids[index].is_scalar() {
            true => Ok(index),
            false => Err(refuse(format!(
                "grid `{}` holds {} values, not numbers",
                grids[index].selector, grids[index].value_type
            ))),
        }
    }

    /// The field iso − value of a scalar grid, whose zero set is the volume's surface at `iso`, with leaves wherever that runs.
    pub fn read_iso_field(&self, index: usize, iso: f32, inside: Inside, run: &RunOptions) -> Result<LevelSet> {
        let listing = &self.listing().grids[index];
        let refuse = |problem: String| EditError::input(&self.path, format!("grid `{}`: {problem}", listing.selector));
        let failed = |e: cxx::Exception| refuse(e.what().into());
        let transform = listing.uniform_transform().map_err(refuse)?;
        let leaves = ffi::archive_leaves(&self.archive, index).map_err(failed)?;
        let background = inside.field(leaves.background() as f32, iso);
        if !(background > 0.0 && background.is_finite()) {
            return Err(refuse(format!(
                "no closed surface at {iso}: everywhere outside of the volume its value is {}; take a {} value",
                leaves.background(),
                if inside == Inside::Above { "larger" } else { "smaller" }
            )));
        }
        let tiles = leaves.tiles().map_err(failed)?;
        let solid: Vec<&ffi::Tile> = tiles.iter().filter(|tile| inside.field(tile.value, iso) < 0.0).collect();
        let blocks = leaves.count() as u64 + solid.iter().map(|tile| shell_size(tile)).sum::<u64>();
        run.reserve("reading a volume", blocks * BYTES_A_LEAF, "take a smaller volume")?;

        let mut flat = vec![0; leaves.count() * 3];
        leaves.origins(&mut flat).map_err(failed)?;
        let stored = flat.as_chunks::<3>().0.iter().map(|o| IVec3::from_array(*o));
        let mut places: Vec<(IVec3, Source)> =
            stored.zip(0..).map(|(origin, leaf)| (origin, Source::Leaf(leaf))).collect();
        for tile in &solid {
            shell(tile, |origin| places.push((origin, Source::Constant(inside.field(tile.value, iso)))));
        }
        let farthest = solid.iter().map(|tile| corner(tile).abs().max_element().saturating_add(tile.size as i32));
        let farthest = farthest.chain(places.iter().map(|(o, _)| o.abs().max_element())).max().unwrap_or(0);
        if farthest > MAX_COORD - 2 * LEAF_DIM {
            return Err(refuse(format!("it reaches to voxel {farthest}; coordinates go to {MAX_COORD}")));
        }
        places.sort_unstable_by_key(|(o, _)| (o.x, o.y, o.z));
        places.dedup_by_key(|(o, _)| *o);

        let origins: Vec<IVec3> = places.iter().map(|(origin, _)| *origin).collect();
        let mut grid = Grid::from_origins(background, &origins);
        for tile in solid.iter().filter(|tile| tile.size > LEAF_DIM as u32) {
            grid.set_sign(corner(tile), corner(tile) + tile.size as i32, true);
        }
        fill(&mut grid, &places, &leaves, iso, inside).map_err(refuse)?;
        surround(&mut grid);
        Ok(LevelSet::new(grid, transform))
    }
}

impl VdbFile {
    /// A grid of numbers as it is: leaves, tiles and background.
    pub fn read_volume(&self, index: usize, run: &RunOptions) -> Result<Volume> {
        let listing = &self.listing().grids[index];
        let refuse = |problem: String| EditError::input(&self.path, format!("grid `{}`: {problem}", listing.selector));
        let leaves = ffi::archive_leaves(&self.archive, index).map_err(|e| refuse(e.what().into()))?;
        self.volume_of(index, &leaves, run)
    }

    /// The numbers of `leaves`, which are those of grid `index` or a component of them.
    pub(super) fn volume_of(&self, index: usize, leaves: &ffi::Leaves, run: &RunOptions) -> Result<Volume> {
        let listing = &self.listing().grids[index];
        let refuse = |problem: String| EditError::input(&self.path, format!("grid `{}`: {problem}", listing.selector));
        let failed = |e: cxx::Exception| refuse(e.what().into());
        let transform = listing.uniform_transform().map_err(refuse)?;
        let bytes = leaves.count() as u64 * size_of::<LeafValues>() as u64;
        run.reserve("reading a volume", bytes, "take a smaller volume")?;
        let mut flat = vec![0; leaves.count() * 3];
        leaves.origins(&mut flat).map_err(failed)?;
        let mut volume = Volume::new(transform, leaves.background() as f32);
        for (leaf, origin) in flat.as_chunks::<3>().0.iter().enumerate() {
            let (mut values, mut active) = (Box::new(LeafValues::default()), LeafMask::EMPTY);
            leaves.copy(leaf, &mut values.0, &mut active.0).map_err(failed)?;
            volume.insert_leaf(IVec3::from_array(*origin), values);
        }
        for tile in leaves.tiles().map_err(failed)? {
            // The root's tiles are as large as an internal node of the tree.
            volume.insert_tile(corner(&tile), tile.size as i32, tile.value);
        }
        Ok(volume)
    }
}

/// Where the values of a leaf come from.
#[derive(Clone, Copy)]
enum Source {
    Leaf(usize),
    Constant(f32),
}

fn corner(tile: &ffi::Tile) -> IVec3 {
    IVec3::new(tile.x, tile.y, tile.z)
}

/// Number of leaves along the edge of a tile.
fn edge(tile: &ffi::Tile) -> i32 {
    tile.size as i32 / LEAF_DIM
}

fn shell_size(tile: &ffi::Tile) -> u64 {
    let n = edge(tile) as u64;
    n.pow(3) - n.saturating_sub(2).pow(3)
}

/// Calls `f` with the origins of the leaves on the surface of a tile.
fn shell(tile: &ffi::Tile, mut f: impl FnMut(IVec3)) {
    let last = edge(tile) - 1;
    for x in 0..=last {
        for y in 0..=last {
            let rim = x == 0 || x == last || y == 0 || y == last;
            let step = if rim { 1 } else { last.max(1) };
            for z in (0..=last).step_by(step as usize) {
                f(corner(tile) + IVec3::new(x, y, z) * LEAF_DIM);
            }
        }
    }
}

/// Sets the values of all leaves. NaN counts as outside.
fn fill(
    grid: &mut Grid,
    places: &[(IVec3, Source)],
    leaves: &ffi::Leaves,
    iso: f32,
    inside: Inside,
) -> Result<(), String> {
    let background = grid.background();
    // A fresh grid has its leaves in slot order.
    let first = grid.leaves().first().map_or(0, |id| id.index());
    let failed = std::sync::Mutex::new(None);
    grid.update_all(|id, values, mask| {
        match places[id.index() - first].1 {
            Source::Constant(value) => values.0.fill(value),
            Source::Leaf(leaf) => {
                let mut active = LeafMask::EMPTY;
                if let Err(e) = leaves.copy(leaf, &mut values.0, &mut active.0) {
                    failed.lock().unwrap_or_else(|p| p.into_inner()).get_or_insert(e.what().to_string());
                }
                for value in &mut values.0 {
                    *value = if value.is_nan() { background } else { inside.field(*value, iso) };
                }
            }
        }
        *mask = LeafMask::FULL;
    });
    match failed.into_inner().unwrap_or_else(|p| p.into_inner()) {
        Some(problem) => Err(problem),
        None => Ok(()),
    }
}

/// Adds the absent outside leaves around those that have an inside: the surface may run between the two.
fn surround(grid: &mut Grid) {
    let around = grid.map_leaves(|id| {
        let (origin, values) = (grid.origin(id), grid.values(id));
        if (0..LEAF_VOXELS).all(|offset| values.0[offset] >= 0.0) {
            return Vec::new();
        }
        let steps = (0..27).map(|n| IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1) * LEAF_DIM);
        steps.map(|step| origin + step).filter(|o| grid.find(*o) == LeafId::OUTSIDE).collect()
    });
    let mut missing: Vec<IVec3> = around.into_iter().flatten().collect();
    missing.sort_unstable_by_key(|o| (o.x, o.y, o.z));
    missing.dedup();
    grid.add_leaves(&missing);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tile(size: u32) -> ffi::Tile {
        ffi::Tile { x: -16, y: 0, z: 128, size, value: 1.0, active: true }
    }

    #[test]
    fn the_shell_of_a_tile_is_its_outer_leaves() {
        for (size, count) in [(8, 1), (16, 8), (24, 26), (128, 16 * 16 * 16 - 14 * 14 * 14)] {
            let mut origins = Vec::new();
            shell(&tile(size), |o| origins.push(o));
            origins.sort_unstable_by_key(|o| o.to_array());
            origins.dedup();
            assert_eq!((origins.len() as u64, shell_size(&tile(size))), (count, count));
            let (lo, hi) = (corner(&tile(size)), corner(&tile(size)) + size as i32);
            assert!(origins.iter().all(|o| o.cmpge(lo).all() && o.cmplt(hi).all()));
        }
    }
}
