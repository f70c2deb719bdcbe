//! A set of voxels of a grid, and how it grows.

use rayon::prelude::*;

use super::RegionWeights;
use crate::grid::{Face, Grid, LeafMask, LeafSet, Paged, neighbour_index};

/// Voxels of the leaves of a grid, whether they are active or not.
#[derive(Clone)]
pub struct VoxelSet {
    masks: Paged<LeafMask>,
    leaves: LeafSet,
}

impl VoxelSet {
    /// The voxels that `mask` gives for each leaf.
    pub fn new(grid: &Grid, mask: impl Fn(crate::grid::LeafId) -> LeafMask + Sync) -> Self {
        let of_leaf = |&id: &_| Some((id, mask(id))).filter(|(_, mask)| !mask.is_empty());
        let found: Vec<_> = grid.leaves().par_iter().with_min_len(16).filter_map(of_leaf).collect();
        let mut masks = Paged::filled(grid.value_pages().page_count(), LeafMask::EMPTY);
        found.iter().for_each(|&(id, mask)| *masks.get_mut(id) = mask);
        Self { masks, leaves: found.into_iter().map(|(id, _)| id).collect() }
    }

    /// The active voxels of a grid.
    pub fn active(grid: &Grid) -> Self {
        Self { masks: grid.mask_pages().clone(), leaves: grid.leaf_set().clone() }
    }

    /// The active voxels of a grid where α is above 0.
    pub fn weighted(grid: &Grid, weights: &RegionWeights) -> Self {
        let mut masks = Paged::filled(grid.value_pages().page_count(), LeafMask::EMPTY);
        masks.par_update(weights.leaves(), |id, mask: &mut LeafMask| {
            *mask = grid.mask(id).zip(weights.positive(id), |active, positive| active & positive);
        });
        Self { masks, leaves: weights.leaves().clone() }
    }

    /// All voxels of stored leaves that are at most so many steps from face to face away.
    pub fn grown(&self, grid: &Grid, steps: usize) -> Self {
        let around = grid.neighbours();
        let mut grown = self.clone();
        for _ in 0..steps {
            let seed = grown.masks.clone();
            for id in grown.leaves.clone().iter() {
                for face in Face::ALL {
                    let beside = around[id.index()][neighbour_index(face.step())];
                    if !beside.is_sentinel() && !seed.get(id).spill(face).is_empty() {
                        grown.leaves.insert(beside);
                    }
                }
            }
            grown.masks.par_update(&grown.leaves, |id, mask| {
                *mask = seed.get(id).dilated();
                for face in Face::ALL {
                    let beside = around[id.index()][neighbour_index(face.step())];
                    *mask = mask.zip(seed.get(beside).spill(face.opposite()), |a, b| a | b);
                }
            });
        }
        grown
    }

    /// The leaves with a voxel of the set, and maybe others.
    pub fn leaves(&self) -> &LeafSet {
        &self.leaves
    }

    /// The voxels of a leaf.
    #[inline(always)]
    pub fn mask(&self, id: crate::grid::LeafId) -> LeafMask {
        *self.masks.get(id)
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.leaves.iter().all(|id| self.mask(id).is_empty())
    }
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;
    use crate::grid::{leaf_offset, offset_to_local};

    #[test]
    fn a_voxel_grows_to_the_octahedron_around_it() {
        let origins: Vec<_> = (0..27).map(|q| IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * 8).collect();
        let grid = Grid::from_origins(1.0, &origins);
        let centre = IVec3::new(1, 6, 3);
        let one = VoxelSet::new(&grid, |id| {
            let mut mask = LeafMask::EMPTY;
            mask.set(leaf_offset(centre), grid.origin(id) == IVec3::ZERO);
            mask
        });
        let grown = one.grown(&grid, 5);
        for &id in grid.leaves() {
            for at in 0..512 {
                let steps = (grid.origin(id) + offset_to_local(at) - centre).abs().element_sum();
                assert_eq!(grown.mask(id).get(at), steps <= 5);
            }
        }
        assert!(!grown.is_empty() && VoxelSet::new(&grid, |_| LeafMask::EMPTY).is_empty());
    }
}
