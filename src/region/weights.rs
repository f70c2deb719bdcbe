//! A region evaluated on a grid: α at the active voxels of the leaves that it touches.

use rayon::prelude::*;

use super::Region;
use crate::grid::{
    Grid, LEAF_DIM, LeafId, LeafMask, LeafSet, LeafValues, PageLeaves, Paged, Transform, offset_to_local,
};

/// α at the active voxels of a grid, by leaf slot. Voxels are looked at when they become active. Pages that the region does not touch
/// are shared.
pub struct RegionWeights {
    alpha: Paged<LeafValues>,
    /// Where α is above 0, as far as it is known.
    positive: Paged<LeafMask>,
    known: Paged<LeafMask>,
    leaves: LeafSet,
}

impl RegionWeights {
    /// Evaluates `region` on the leaves of `grid` that it can touch.
    pub fn new(grid: &Grid, transform: &Transform, region: &dyn Region) -> Self {
        let mut weights = Self {
            alpha: Paged::default(),
            positive: Paged::default(),
            known: Paged::default(),
            leaves: LeafSet::default(),
        };
        weights.grow(grid.value_pages().page_count());
        let touched = |id: &LeafId| range(grid, transform, region, *id)[1] > 0.0;
        let touched: Vec<_> = grid.leaves().par_iter().copied().filter(touched).collect();
        weights.evaluate(grid, transform, region, &touched.into_iter().collect());
        weights
    }

    /// Evaluates `region` at the voxels of `leaves` that became active.
    pub fn evaluate(&mut self, grid: &Grid, transform: &Transform, region: &dyn Region, leaves: &LeafSet) {
        self.grow(grid.value_pages().page_count());
        let new: LeafSet = leaves
            .iter()
            .filter(|&id| !grid.mask(id).zip(*self.known.get(id), |active, known| active & !known).is_empty())
            .collect();
        let known = &self.known;
        self.alpha.par_update_pages_with(&mut self.positive, &new, |leaves, alpha, positive| {
            leaves.for_each(|id| {
                let (alpha, positive) = (&mut alpha[PageLeaves::slot(id)], &mut positive[PageLeaves::slot(id)]);
                if known.get(id).is_empty() {
                    // The slot may have belonged to another leaf before.
                    *positive = LeafMask::EMPTY;
                    if range(grid, transform, region, id)[0] == 1.0 {
                        (*alpha, *positive) = (LeafValues::filled(1.0), LeafMask::FULL);
                        return;
                    }
                }
                let origin = grid.origin(id);
                for offset in grid.mask(id).zip(*known.get(id), |active, known| active & !known).iter() {
                    let a = region.weight(transform.voxel_to_world(origin + offset_to_local(offset))).clamp(0.0, 1.0);
                    alpha.0[offset] = a;
                    positive.set(offset, a > 0.0);
                }
            });
        });
        let positive = &self.positive;
        self.known.par_update(&new, |id, known| {
            let all = *positive.get(id) == LeafMask::FULL;
            *known = if all { LeafMask::FULL } else { known.zip(grid.mask(id), |known, active| known | active) };
        });
        for id in new.iter().filter(|id| !self.positive.get(*id).is_empty()) {
            self.leaves.insert(id);
        }
    }

    /// Makes room for the leaves of so many pages.
    pub fn grow(&mut self, pages: usize) {
        self.alpha.grow(pages, LeafValues::default());
        self.positive.grow(pages, LeafMask::EMPTY);
        self.known.grow(pages, LeafMask::EMPTY);
    }

    /// Forgets leaves that the grid lost.
    pub fn forget(&mut self, leaves: &[LeafId]) {
        for &id in leaves {
            self.leaves.remove(id);
            *self.known.get_mut(id) = LeafMask::EMPTY;
            *self.positive.get_mut(id) = LeafMask::EMPTY;
        }
    }

    /// The leaves with an active voxel where α is above 0.
    pub fn leaves(&self) -> &LeafSet {
        &self.leaves
    }

    /// α at the active voxels of a leaf; anything at the others.
    #[inline(always)]
    pub fn alpha(&self, id: LeafId) -> &LeafValues {
        self.alpha.get(id)
    }

    /// The active voxels of a leaf where α is above 0, and maybe others where it is.
    #[inline(always)]
    pub fn positive(&self, id: LeafId) -> LeafMask {
        *self.positive.get(id)
    }
}

/// Limits of α in a leaf.
fn range(grid: &Grid, transform: &Transform, region: &dyn Region, id: LeafId) -> [f32; 2] {
    // From the centre of a leaf to those of its outermost voxels.
    let half = (f64::from(LEAF_DIM) - 1.0) / 2.0;
    let centre = transform.index_to_world(grid.origin(id).as_dvec3() + half);
    region.weights_within(centre, half * 3f64.sqrt() * transform.voxel_size())
}
