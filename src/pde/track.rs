//! Tracking: the band follows the surface. Dilate by one voxel, renormalise, trim (OpenVDB's `LevelSetTracker::track`).

use rayon::prelude::*;

use super::SolverOptions;
use super::step::{Emptied, Target};
use super::tracker::Tracker;
use crate::awake::awake;
use crate::error::Result;
use crate::grid::{Face, LeafId, LeafMask, LeafSet, Paged, neighbour_index};
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// Dilates, renormalises and trims the whole band once.
pub fn track(level_set: &mut LevelSet, solver: &SolverOptions, run: &RunOptions) -> Result<()> {
    awake(|| Tracker::new(level_set, None, *solver, run).track())
}

impl Tracker<'_> {
    /// Dilates, renormalises and trims the domain once.
    pub fn track(&mut self) -> Result<()> {
        self.dilate_band();
        self.renormalize_to(Target::Trimmed)
    }

    /// Activates the face neighbours of the voxels that may have moved. They start at ±background.
    pub fn dilate_band(&mut self) {
        let mut moving = self.moving();
        let reached = self.reached_leaves(&moving);
        self.domain.include_old(self.grid, &reached);
        let added = self.grid.add_leaves(&self.grid.absent_beside(&moving, self.domain.leaves()));
        let (grid, new) = (&*self.grid, added.iter().copied().collect());
        for buffer in &mut self.buffers {
            buffer.grow_unwritten(grid.value_pages().page_count());
            buffer.par_update(&new, |id, values| values.clone_from(grid.values(id)));
        }
        self.domain.include_new(self.grid, &added);
        // Slots of new leaves may have belonged to others before.
        moving.grow(self.grid.value_pages().page_count(), LeafMask::EMPTY);
        added.iter().for_each(|&id| *moving.get_mut(id) = LeafMask::EMPTY);
        self.grid.activate_beside(&moving, self.domain.leaves());
        if let Some(region) = self.region {
            self.domain.weigh(self.grid, &self.transform, region);
        }
    }

    /// After a trimming step: puts the second buffers in step with φ, and removes the leaves that were left empty. `emptied` is sorted by leaf.
    pub(super) fn settle(&mut self, emptied: &[Emptied]) {
        let touched: LeafSet = emptied.iter().map(|e| e.id).collect();
        let grid = &*self.grid;
        for buffer in &mut self.buffers {
            buffer.par_update(&touched, |id, values| {
                // Rows with an active voxel are written whole by the next step, these by none.
                if let Ok(i) = emptied.binary_search_by_key(&id, |e| e.id) {
                    for at in (0..32).filter(|pair| emptied[i].pairs >> pair & 1 == 1).map(|pair| 16 * pair) {
                        values.0[at..at + 16].copy_from_slice(&grid.values(id).0[at..at + 16]);
                    }
                }
            });
        }
        let removed = self.grid.prune(&touched);
        self.domain.forget(&removed);
    }

    /// The voxels of the domain's leaves that may have moved.
    fn moving(&self) -> Paged<LeafMask> {
        if !self.domain.is_local() {
            return self.grid.mask_pages().clone();
        }
        let mut moving = Paged::filled(self.grid.value_pages().page_count(), LeafMask::EMPTY);
        moving.par_update(self.domain.leaves(), |id, m: &mut LeafMask| *m = self.domain.moving(id, self.grid.mask(id)));
        moving
    }

    /// Leaves outside the domain that its moving voxels border on.
    fn reached_leaves(&self, moving: &Paged<LeafMask>) -> Vec<LeafId> {
        if !self.domain.is_local() {
            return Vec::new();
        }
        let (around, leaves) = (self.grid.neighbours(), self.domain.leaves());
        let beside = |id: LeafId| {
            let neighbour = move |face: Face| around[id.index()][neighbour_index(face.step())];
            let reached = move |face: &Face| {
                let n = neighbour(*face);
                !n.is_sentinel() && !leaves.contains(n) && !moving.get(id).spill(*face).is_empty()
            };
            Face::ALL.into_iter().filter(reached).map(neighbour)
        };
        leaves.par_pages().flat_map_iter(|page| page.iter().flat_map(beside)).collect()
    }
}
