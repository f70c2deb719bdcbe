//! A region evaluated on a grid: α at the voxels of the leaves that it touches.

use crate::grid::{Grid, LEAF_DIM, LeafId, LeafSet, LeafValues, Paged, Transform, offset_to_local};

use super::Region;

/// α at the voxels of a grid, by leaf slot. Pages that the region does not touch share one page of zeros.
pub struct RegionWeights {
    alpha: Paged<LeafValues>,
    leaves: LeafSet,
}

impl RegionWeights {
    /// Evaluates `region` on the leaves of `grid` that it can touch.
    pub fn new(grid: &Grid, transform: &Transform, region: &dyn Region) -> Self {
        let mut weights = Self {
            alpha: Paged::filled(grid.value_pages().page_count(), LeafValues::default()),
            leaves: LeafSet::default(),
        };
        weights.extend(grid, transform, region, grid.leaves());
        weights
    }

    /// Evaluates `region` on leaves that are new in the grid.
    pub fn extend(&mut self, grid: &Grid, transform: &Transform, region: &dyn Region, leaves: &[LeafId]) {
        self.alpha.grow(grid.value_pages().page_count(), LeafValues::default());
        let touched: LeafSet = leaves
            .iter()
            .copied()
            .filter(|&id| {
                let centre = transform.index_to_world(grid.origin(id).as_dvec3() + (f64::from(LEAF_DIM) - 1.0) / 2.0);
                let reach = (f64::from(LEAF_DIM) - 1.0) / 2.0 * 3f64.sqrt() * transform.voxel_size();
                region.touches(centre, reach)
            })
            .collect();
        self.alpha.par_update(&touched, |id, alpha| {
            let origin = grid.origin(id);
            for (offset, a) in alpha.0.iter_mut().enumerate() {
                *a = region.weight(transform.voxel_to_world(origin + offset_to_local(offset))).clamp(0.0, 1.0);
            }
        });
        for &id in leaves {
            if !touched.contains(id) && self.alpha(id).0.iter().any(|a| *a > 0.0) {
                // The slot belonged to another leaf before.
                *self.alpha.get_mut(id) = LeafValues::default();
            }
            if self.alpha(id).0.iter().any(|a| *a > 0.0) {
                self.leaves.insert(id);
            } else {
                self.leaves.remove(id);
            }
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
}
