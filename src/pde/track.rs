//! Tracking: the band follows the surface. Dilate by one voxel, renormalise, trim (OpenVDB's `LevelSetTracker::track`).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask, mask32x16};

use super::SolverOptions;
use super::domain::Domain;
use super::tracker::Tracker;
use crate::error::Result;
use crate::grid::{Face, LEAF_VOXELS, LeafId, LeafMask, LeafSet, LeafValues, PageLeaves, Paged, neighbour_index};
use crate::levelset::LevelSet;
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch};

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
        let added = self.grid.add_leaves(&self.grid.absent_beside(&self.moving()));
        let pages = self.grid.value_pages().page_count();
        for buffer in &mut self.buffers {
            buffer.grow(pages, LeafValues::default());
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
        let moving = self.moving();
        self.grid.activate_beside(&moving, self.domain.leaves());
    }

    /// Deactivates the voxels of the domain that lie outside the band, sets them to ±background, and removes empty leaves.
    pub fn trim_band(&mut self) {
        let background = self.grid.background();
        let touched = self.grid.update_pages(self.domain.leaves(), |leaves, values, masks| {
            let mut touched = Vec::new();
            dispatch(Trim { domain: &self.domain, background, leaves, values, masks, touched: &mut touched });
            touched
        });
        let touched: LeafSet = touched.into_iter().flatten().collect();
        for buffer in &mut self.buffers {
            let grid = &*self.grid;
            buffer.par_update(&touched, |id, values| {
                let (phi, active) = (grid.values(id), grid.mask(id));
                // Rows with an active voxel are written whole by the next step.
                let empty = |at: usize| active.0[at / 64] >> (at % 64) & 0xffff == 0;
                for at in (0..LEAF_VOXELS).step_by(16).filter(|at| empty(*at)) {
                    values.0[at..at + 16].copy_from_slice(&phi.0[at..at + 16]);
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

/// Trims the leaves of one page and lists those that lost a voxel.
struct Trim<'a> {
    domain: &'a Domain,
    background: f32,
    leaves: PageLeaves,
    values: &'a mut [LeafValues],
    masks: &'a mut [LeafMask],
    touched: &'a mut Vec<LeafId>,
}

impl Work for Trim<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let background = Lanes::splat(simd, self.background);
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let (values, mask) = (&mut self.values[PageLeaves::slot(id)], &mut self.masks[PageLeaves::slot(id)]);
                let mut trimmed = LeafMask::EMPTY;
                self.domain.repairable(id, *mask).for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let phi = Lanes::from_slice(simd, &values.0[at..at + 16]);
                        let out = phi.abs().simd_ge(background).to_bitmask() & u64::from(bits);
                        if out != 0 {
                            let lanes = mask32x16::from_bitmask(simd, out);
                            lanes.select(background.copysign(phi), phi).store_slice(&mut values.0[at..at + 16]);
                            trimmed.0[x] |= out << (y * 8);
                        }
                    },
                );
                if !trimmed.is_empty() {
                    *mask = mask.zip(trimmed, |m, t| m & !t);
                    self.touched.push(id);
                }
            },
        );
    }
}
