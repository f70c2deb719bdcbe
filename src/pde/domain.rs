//! Which voxels a step may write: everything, what a region touches, or some leaves.

use crate::grid::{Grid, LeafId, LeafMask, LeafSet, Paged, Transform};
use crate::region::{Region, RegionWeights};

/// The leaves that a flow works on and, with a region, its weights and the voxels that must keep their bits.
pub(super) struct Domain {
    leaves: LeafSet,
    local: Option<Local>,
}

struct Local {
    /// Of a region; where only leaves are listed, whatever is not frozen has weight 1.
    weights: Option<RegionWeights>,
    /// Of the leaves worked on, the voxels that were active at the start and have weight 0.
    frozen: Paged<LeafMask>,
}

impl Domain {
    /// Every leaf of a grid.
    pub fn everywhere(grid: &Grid) -> Self {
        Self { leaves: grid.leaf_set().clone(), local: None }
    }

    /// The leaves that a region touches.
    pub fn region(grid: &Grid, weights: RegionWeights) -> Self {
        let mut frozen = Paged::filled(grid.value_pages().page_count(), LeafMask::EMPTY);
        frozen.par_update(weights.leaves(), |id, frozen: &mut LeafMask| {
            *frozen = grid.mask(id).zip(weights.positive(id), |active, moves| active & !moves);
        });
        Self { leaves: weights.leaves().clone(), local: Some(Local { weights: Some(weights), frozen }) }
    }

    /// Some leaves of a grid, and new ones beside them; what is active in the others now is frozen.
    pub fn part(grid: &Grid, leaves: LeafSet) -> Self {
        let frozen = Paged::filled(grid.value_pages().page_count(), LeafMask::EMPTY);
        Self { leaves, local: Some(Local { weights: None, frozen }) }
    }

    /// The leaves to work on.
    pub fn leaves(&self) -> &LeafSet {
        &self.leaves
    }

    /// Whether only part of the grid is worked on.
    pub fn is_local(&self) -> bool {
        self.local.is_some()
    }

    /// The weights, where there is a region.
    pub fn weights(&self) -> Option<&RegionWeights> {
        self.local.as_ref().and_then(|l| l.weights.as_ref())
    }

    /// Looks up the weights of voxels that became active.
    pub fn weigh(&mut self, grid: &Grid, transform: &Transform, region: &dyn Region) {
        if let Some(weights) = self.local.as_mut().and_then(|local| local.weights.as_mut()) {
            weights.evaluate(grid, transform, region, &self.leaves);
        }
    }

    /// Of the active voxels of a leaf, those that a flow moves: weight above 0.
    #[inline(always)]
    pub fn moving(&self, id: LeafId, active: LeafMask) -> LeafMask {
        match &self.local {
            None => active,
            Some(Local { weights: Some(weights), .. }) => active.zip(weights.positive(id), |a, moves| a & moves),
            Some(Local { weights: None, frozen }) => active.zip(*frozen.get(id), |a, frozen| a & !frozen),
        }
    }

    /// Of the active voxels of a leaf, those that renormalisation and trimming may change: all but the frozen ones.
    #[inline(always)]
    pub fn repairable(&self, id: LeafId, active: LeafMask) -> LeafMask {
        match &self.local {
            None => active,
            Some(local) => active.zip(*local.frozen.get(id), |a, frozen| a & !frozen),
        }
    }

    /// Takes in new leaves of a grid.
    pub fn include_new(&mut self, grid: &Grid, leaves: &[LeafId]) {
        for &id in leaves {
            self.leaves.insert(id);
        }
        if let Some(local) = &mut self.local {
            let pages = grid.value_pages().page_count();
            local.frozen.grow(pages, LeafMask::EMPTY);
            local.weights.iter_mut().for_each(|weights| weights.grow(pages));
            leaves.iter().for_each(|&id| *local.frozen.get_mut(id) = LeafMask::EMPTY);
        }
    }

    /// Takes in leaves of a grid that have not been worked on before: what is active in them was so at the start.
    pub fn include_old(&mut self, grid: &Grid, leaves: &[LeafId]) {
        for &id in leaves {
            self.leaves.insert(id);
        }
        if let Some(local) = &mut self.local {
            leaves.iter().for_each(|&id| *local.frozen.get_mut(id) = grid.mask(id));
        }
    }

    /// Forgets leaves that the grid lost.
    pub fn forget(&mut self, leaves: &[LeafId]) {
        for &id in leaves {
            self.leaves.remove(id);
        }
        if let Some(local) = &mut self.local {
            local.weights.iter_mut().for_each(|weights| weights.forget(leaves));
        }
    }
}
