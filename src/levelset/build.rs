//! Level sets from distance functions.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::{LevelSet, background};
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LeafMask, LeafValues, Transform, offset_to_local};
use crate::run::RunOptions;

/// Edge, in voxels, of the largest block that the search for the surface can start from: index space is eight of them.
const LARGEST_BLOCK: i32 = 1 << 30;

const OPERATION: &str = "sampling a distance function";

/// Bytes that a leaf costs while it is built: its values twice (collected, then in pages), mask and tables.
pub const BYTES_A_LEAF: u64 = 2 * 2048 + 512;

impl LevelSet {
    /// The level set of a signed distance function given in **index space and voxels**: `distance(ijk)` is negative inside,
    /// exact or at least never larger in magnitude than the true distance (1-Lipschitz). All of the surface and its band
    /// must lie between the voxels `lo` and `hi`.
    ///
    /// Blocks whose centre is farther from the surface than their corners plus the band are skipped, so that the work is
    /// proportional to the surface.
    pub fn from_distance(
        transform: Transform,
        half_width: f32,
        (lo, hi): (IVec3, IVec3),
        distance: impl Fn(DVec3) -> f64 + Sync,
        run: &RunOptions,
    ) -> Result<Self> {
        let background = background(half_width, &transform);
        let scale = transform.voxel_size();
        let band = f64::from(half_width);
        let near = |block: IVec3, edge: i32| {
            let centre = block.as_dvec3() + DVec3::splat(f64::from(edge - 1) / 2.0);
            let reach = f64::from(edge - 1) / 2.0 * 3f64.sqrt() + band;
            distance(centre).abs() <= reach
        };
        let origins = leaves_near(lo, hi, near, run)?;
        // Corner leaves of the search hold no band: keep only those with an active voxel.
        let leaves: Vec<(IVec3, LeafValues, LeafMask)> = origins
            .into_par_iter()
            .filter_map(|origin| {
                if run.is_cancelled() {
                    return None;
                }
                let mut values = LeafValues::default();
                let mut mask = LeafMask::EMPTY;
                for (offset, value) in values.0.iter_mut().enumerate() {
                    let ijk = (origin + offset_to_local(offset)).as_dvec3();
                    let phi = (distance(ijk) * scale) as f32;
                    *value = phi.clamp(-background, background);
                    mask.set(offset, phi.abs() < background);
                }
                (!mask.is_empty()).then_some((origin, values, mask))
            })
            .collect();
        run.check(OPERATION)?;
        Ok(Self::new(grid_of_leaves(background, leaves), transform))
    }
}

/// A grid of the given leaves, sorted here; the signs of the space between are flooded from them.
pub fn grid_of_leaves(background: f32, leaves: Vec<(IVec3, LeafValues, LeafMask)>) -> Grid {
    grid_of_parts(background, &[leaves])
}

/// As [`grid_of_leaves`], from the parts that several tasks made.
pub(crate) fn grid_of_parts(background: f32, parts: &[Vec<(IVec3, LeafValues, LeafMask)>]) -> Grid {
    // Two kilobytes a leaf stay where they are until they are copied into pages.
    let mut leaves: Vec<_> = parts.iter().flatten().collect();
    leaves.par_sort_unstable_by_key(|(o, ..)| (o.x, o.y, o.z));
    let origins: Vec<IVec3> = leaves.iter().map(|l| l.0).collect();
    let mut grid = Grid::from_origins(background, &origins);
    let places = grid.places();
    grid.update_all(|id, values, mask| {
        let (_, v, m) = leaves[places[id.index()] as usize];
        values.clone_from(v);
        *mask = *m;
    });
    grid.flood_signs();
    grid
}

/// Origins of the leaves between the voxels `lo` and `hi` for which `near(block, edge)` holds, for the leaf and every block around it.
///
/// Goes down level by level: the blocks of one are about as many as the leaves of a surface as much smaller, so that work which
/// needs more memory than there may be is refused long before it is done.
fn leaves_near(lo: IVec3, hi: IVec3, near: impl Fn(IVec3, i32) -> bool + Sync, run: &RunOptions) -> Result<Vec<IVec3>> {
    let farthest = lo.abs().max(hi.abs()).max_element().clamp(LEAF_DIM, LARGEST_BLOCK);
    let mut edge = (farthest as u32).next_power_of_two() as i32;
    let eight = |corner: IVec3, edge: i32| (0..8).map(move |c| corner + IVec3::new(c >> 2, c >> 1 & 1, c & 1) * edge);
    let wanted = |block: &IVec3, edge: i32| {
        let within = block.cmple(hi).all() && (*block + IVec3::splat(edge - 1)).cmpge(lo).all();
        within && !run.is_cancelled() && near(*block, edge)
    };
    let mut blocks: Vec<IVec3> = eight(IVec3::splat(-edge), edge).filter(|block| wanted(block, edge)).collect();
    while edge > LEAF_DIM {
        edge /= 2;
        blocks = blocks.into_par_iter().flat_map_iter(|b| eight(b, edge)).filter(|b| wanted(b, edge)).collect();
        run.check(OPERATION)?;
        reserve(blocks.len() as u64, edge, run)?;
    }
    Ok(blocks)
}

/// Refuses what needs too much memory already if each block of this edge holds one leaf; says what it would need in all.
fn reserve(blocks: u64, edge: i32, run: &RunOptions) -> Result<()> {
    if run.memory_limit.is_none_or(|limit| blocks.saturating_mul(BYTES_A_LEAF) <= limit) {
        return Ok(());
    }
    // A surface meets four of a block's eight halves.
    let leaves = (u64::from((edge / LEAF_DIM).unsigned_abs())).saturating_pow(2).saturating_mul(blocks);
    run.reserve(OPERATION, leaves.saturating_mul(BYTES_A_LEAF), "take a larger voxel_size or a narrower band")
}
