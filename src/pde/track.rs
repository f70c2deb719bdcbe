//! Tracking: the band follows the surface. Dilate by one voxel, renormalise, trim (OpenVDB's `LevelSetTracker::track`).

use glam::IVec3;

use super::SolverOptions;
use super::tracker::Tracker;
use crate::error::Result;
use crate::grid::{Face, Grid, LEAF_DIM, LeafId, LeafMask, LeafSet, Paged, neighbour_index};
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// Dilates, renormalises and trims the whole band once.
pub fn track(level_set: &mut LevelSet, solver: &SolverOptions, run: &RunOptions) -> Result<()> {
    Tracker::new(level_set, None, *solver, run).track()
}

impl Tracker<'_> {
    /// Dilates, renormalises and trims the domain once.
    pub fn track(&mut self) -> Result<()> {
        self.dilate_band();
        self.renormalize()?;
        self.trim_band();
        Ok(())
    }

    /// Activates the face neighbours of the voxels that may have moved. They start at ±background.
    pub fn dilate_band(&mut self) {
        let new_origins = absent_neighbours(self.grid, &self.domain_moving());
        let added = self.grid.add_leaves(&new_origins);
        let pages = self.grid.value_pages().page_count();
        for buffer in &mut self.buffers {
            buffer.grow(pages, crate::grid::LeafValues::default());
            for &id in &added {
                buffer.get_mut(id).clone_from(self.grid.values(id));
            }
        }
        let reached = self.reached_leaves();
        self.domain.include(&added, pages);
        self.domain.include(&reached, pages);
        if let (Some(weights), Some(region)) = (self.domain.weights_mut(), self.region) {
            weights.extend(self.grid, &self.transform, region, &added);
        }
        let moving = self.domain_moving();
        let mut grown = moving.clone();
        let around = self.grid.neighbours();
        grown.par_update(self.domain.leaves(), |id, grown| {
            *grown = grown.dilated();
            for face in Face::ALL {
                let n = around[id.index()][neighbour_index(face.step())];
                *grown = grown.zip(moving.get(n).spill(opposite(face)), |a, b| a | b);
            }
        });
        self.grid.update_masks(self.domain.leaves(), |id, mask| *mask = mask.zip(*grown.get(id), |a, b| a | b));
    }

    /// Deactivates the voxels of the domain that lie outside the band, sets them to ±background, and removes empty leaves.
    pub fn trim_band(&mut self) {
        let background = self.grid.background();
        let domain = &self.domain;
        let mut trimmed: Paged<LeafMask> = Paged::filled(self.grid.value_pages().page_count(), LeafMask::EMPTY);
        let leaves = domain.leaves().clone();
        {
            let grid = &*self.grid;
            trimmed.par_update(&leaves, |id, out| {
                let values = &grid.values(id).0;
                let repairable = domain.repairable(id, grid.mask(id));
                for offset in repairable.iter() {
                    out.set(offset, values[offset].abs() >= background);
                }
            });
        }
        let touched: LeafSet = leaves.iter().filter(|&id| !trimmed.get(id).is_empty()).collect();
        self.grid.update(&touched, |id, values, mask| {
            for offset in trimmed.get(id).iter() {
                values.0[offset] = background.copysign(values.0[offset]);
                mask.set(offset, false);
            }
        });
        let grid = &*self.grid;
        for buffer in &mut self.buffers {
            buffer.par_update(&touched, |id, values| {
                for offset in trimmed.get(id).iter() {
                    values.0[offset] = grid.values(id).0[offset];
                }
            });
        }
        let removed = self.grid.prune(&touched);
        self.domain.forget(&removed);
    }

    /// The voxels of the domain's leaves that may have moved.
    fn domain_moving(&self) -> Paged<LeafMask> {
        let mut moving = Paged::filled(self.grid.value_pages().page_count(), LeafMask::EMPTY);
        moving.par_update(self.domain.leaves(), |id, m: &mut LeafMask| {
            *m = self.domain.moving(id, self.grid.mask(id));
        });
        moving
    }

    /// Leaves outside the domain that its moving voxels border on.
    fn reached_leaves(&self) -> Vec<LeafId> {
        if !self.domain.is_local() {
            return Vec::new();
        }
        let around = self.grid.neighbours();
        let mut reached = Vec::new();
        for id in self.domain.leaves().iter() {
            let moving = self.domain.moving(id, self.grid.mask(id));
            for face in Face::ALL {
                let n = around[id.index()][neighbour_index(face.step())];
                if !n.is_sentinel() && !self.domain.leaves().contains(n) && !moving.spill(face).is_empty() {
                    reached.push(n);
                }
            }
        }
        reached
    }
}

/// Origins of the absent leaves that face neighbours of the voxels of `moving` lie in, sorted.
fn absent_neighbours(grid: &Grid, moving: &Paged<LeafMask>) -> Vec<IVec3> {
    let around = grid.neighbours();
    let mut origins: Vec<IVec3> = grid
        .map_leaves(|id| {
            let mask = moving.get(id);
            let absent = |face: Face| around[id.index()][neighbour_index(face.step())].is_sentinel();
            Face::ALL
                .into_iter()
                .filter(|&face| absent(face) && !mask.spill(face).is_empty())
                .map(|face| grid.origin(id) + face.step() * LEAF_DIM)
                .collect::<smallvec::SmallVec<[IVec3; 6]>>()
        })
        .into_iter()
        .flatten()
        .collect();
    origins.sort_unstable_by_key(|o| (o.x, o.y, o.z));
    origins.dedup();
    origins
}

fn opposite(face: Face) -> Face {
    match face {
        Face::XMinus => Face::XPlus,
        Face::XPlus => Face::XMinus,
        Face::YMinus => Face::YPlus,
        Face::YPlus => Face::YMinus,
        Face::ZMinus => Face::ZPlus,
        Face::ZPlus => Face::ZMinus,
    }
}
