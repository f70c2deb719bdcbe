//! A region evaluated on a grid: α at the voxels of the leaves that it touches.

use rayon::prelude::*;

use super::Region;
use crate::grid::{Grid, LEAF_DIM, LeafId, LeafMask, LeafSet, LeafValues, Paged, Transform, offset_to_local};

/// α at the voxels of a grid, by leaf slot. Pages that the region does not touch share one page of zeros.
pub struct RegionWeights {
    alpha: Paged<LeafValues>,
    /// Where α is above 0.
    positive: Paged<LeafMask>,
    leaves: LeafSet,
}

impl RegionWeights {
    /// Evaluates `region` on the leaves of `grid` that it can touch.
    pub fn new(grid: &Grid, transform: &Transform, region: &dyn Region) -> Self {
        let pages = grid.value_pages().page_count();
        let mut weights = Self {
            alpha: Paged::filled(pages, LeafValues::default()),
            positive: Paged::filled(pages, LeafMask::EMPTY),
            leaves: LeafSet::default(),
        };
        weights.evaluate(grid, transform, region, grid.leaves());
        weights
    }

    /// Evaluates `region` on leaves that are new in the grid. Their slots may have belonged to others before.
    pub fn extend(&mut self, grid: &Grid, transform: &Transform, region: &dyn Region, leaves: &[LeafId]) {
        let pages = grid.value_pages().page_count();
        self.alpha.grow(pages, LeafValues::default());
        self.positive.grow(pages, LeafMask::EMPTY);
        for &id in leaves {
            if self.leaves.remove(id) {
                *self.alpha.get_mut(id) = LeafValues::default();
                *self.positive.get_mut(id) = LeafMask::EMPTY;
            }
        }
        self.evaluate(grid, transform, region, leaves);
    }

    fn evaluate(&mut self, grid: &Grid, transform: &Transform, region: &dyn Region, leaves: &[LeafId]) {
        // Of the centres of a leaf's outermost voxels from its own.
        let radius = (f64::from(LEAF_DIM) - 1.0) / 2.0 * 3f64.sqrt() * transform.voxel_size();
        let range = |id| {
            let centre = transform.index_to_world(grid.origin(id).as_dvec3() + (f64::from(LEAF_DIM) - 1.0) / 2.0);
            region.weights_within(centre, radius)
        };
        let touched: LeafSet =
            leaves.par_iter().copied().filter(|&id| range(id)[1] > 0.0).collect::<Vec<_>>().into_iter().collect();
        self.alpha.par_update(&touched, |id, alpha| {
            if range(id)[0] == 1.0 {
                alpha.0.fill(1.0);
                return;
            }
            let origin = grid.origin(id);
            for (offset, a) in alpha.0.iter_mut().enumerate() {
                *a = region.weight(transform.voxel_to_world(origin + offset_to_local(offset))).clamp(0.0, 1.0);
            }
        });
        let alpha = &self.alpha;
        self.positive.par_update(&touched, |id, positive| {
            let alpha = &alpha.get(id).0;
            for (word, alpha) in positive.0.iter_mut().zip(alpha.as_chunks::<64>().0) {
                *word = alpha.iter().rev().fold(0, |word, a| word << 1 | u64::from(*a > 0.0));
            }
        });
        for id in touched.iter().filter(|id| !self.positive.get(*id).is_empty()) {
            self.leaves.insert(id);
        }
    }

    /// The leaves where α is not zero everywhere.
    pub fn leaves(&self) -> &LeafSet {
        &self.leaves
    }

    /// α in a leaf; zeros where the region does not touch it.
    #[inline(always)]
    pub fn alpha(&self, id: LeafId) -> &LeafValues {
        self.alpha.get(id)
    }

    /// Where α is above 0 in a leaf.
    #[inline(always)]
    pub fn positive(&self, id: LeafId) -> LeafMask {
        *self.positive.get(id)
    }
}
