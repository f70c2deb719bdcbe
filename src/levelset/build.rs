//! Level sets from distance functions.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::{LevelSet, background};
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LeafMask, LeafValues, Transform, offset_to_local};
use crate::run::RunOptions;

/// Edge, in voxels, of the blocks that the search for the surface starts from: a multiple of the leaf's edge by a power of two.
const ROOT_BLOCK: i32 = 1024;

/// Bytes that a leaf costs while it is built: its values twice (collected, then in pages), mask and tables.
const BYTES_A_LEAF: u64 = 2 * 2048 + 512;

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
        let origins = leaves_near(lo, hi, &|block: IVec3, edge: i32| {
            let centre = block.as_dvec3() + DVec3::splat(f64::from(edge - 1) / 2.0);
            let reach = f64::from(edge - 1) / 2.0 * 3f64.sqrt() + band;
            distance(centre).abs() <= reach
        });
        run.check("sampling a distance function")?;
        run.reserve(
            "sampling a distance function",
            origins.len() as u64 * BYTES_A_LEAF,
            "take a larger voxel_size or a narrower band",
        )?;
        // Corner leaves of the search hold no band: keep only those with an active voxel.
        let leaves: Vec<(IVec3, LeafValues, LeafMask)> = origins
            .into_par_iter()
            .filter_map(|origin| {
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
        Ok(Self::new(grid_of_leaves(background, leaves), transform))
    }
}

/// A grid of the given leaves, sorted here; the signs of the space between are flooded from them.
pub(crate) fn grid_of_leaves(background: f32, mut leaves: Vec<(IVec3, LeafValues, LeafMask)>) -> Grid {
    leaves.par_sort_unstable_by_key(|(o, ..)| (o.x, o.y, o.z));
    let origins: Vec<IVec3> = leaves.iter().map(|l| l.0).collect();
    let mut grid = Grid::from_origins(background, &origins);
    // A fresh grid has its leaves in slot order, so the leaf of an id is found by counting.
    let first = grid.leaves().first().map_or(0, |id| id.index());
    grid.update_all(|id, values, mask| {
        let (_, v, m) = &leaves[id.index() - first];
        values.clone_from(v);
        *mask = *m;
    });
    grid.flood_signs();
    grid
}

/// Origins of the leaves between the voxels `lo` and `hi` for which `near(block, edge)` holds, for the leaf and every block around it.
fn leaves_near(lo: IVec3, hi: IVec3, near: &(impl Fn(IVec3, i32) -> bool + Sync)) -> Vec<IVec3> {
    let first: IVec3 = lo & !(ROOT_BLOCK - 1);
    let mut roots = Vec::new();
    for x in (first.x..=hi.x).step_by(ROOT_BLOCK as usize) {
        for y in (first.y..=hi.y).step_by(ROOT_BLOCK as usize) {
            for z in (first.z..=hi.z).step_by(ROOT_BLOCK as usize) {
                roots.push(IVec3::new(x, y, z));
            }
        }
    }
    roots.into_par_iter().flat_map(|root| descend(root, ROOT_BLOCK, near)).collect()
}

fn descend(block: IVec3, edge: i32, near: &(impl Fn(IVec3, i32) -> bool + Sync)) -> Vec<IVec3> {
    if !near(block, edge) {
        return Vec::new();
    }
    if edge == LEAF_DIM {
        return vec![block];
    }
    let half = edge / 2;
    (0..8)
        .into_par_iter()
        .flat_map(|c| descend(block + IVec3::new(c >> 2, c >> 1 & 1, c & 1) * half, half, near))
        .collect()
}
