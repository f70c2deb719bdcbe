//! A level set on the move: the grid, its second buffers, the domain and how it is solved.

use fearless_simd::Simd;
use rayon::prelude::*;

use super::domain::Domain;
use super::step::{Blend, LeafKernel, Target};
use super::{SolverOptions, TimeIntegrator};
use crate::awake::awake;
use crate::error::Result;
use crate::grid::{Grid, LeafSet, LeafValues, PageLeaves, Paged, Transform};
use crate::levelset::LevelSet;
use crate::region::{Region, RegionWeights};
use crate::run::RunOptions;
use crate::stencil::simd::{Work, dispatch};

/// Steps a level set and keeps its band on the surface (OpenVDB's word for it).
///
/// Reads come from φ, writes go to a second buffer, then the two change places. Outside the listed leaves of a local
/// domain the buffers hold equal values and share their pages, so that the exchange is right for the whole grid.
pub struct Tracker<'a> {
    pub(super) grid: &'a mut Grid,
    pub(super) transform: Transform,
    pub(super) domain: Domain,
    pub(super) region: Option<&'a dyn Region>,
    /// Second buffers, in step with the grid: same pages, same values where inactive.
    pub(super) buffers: Vec<Paged<LeafValues>>,
    pub(super) solver: SolverOptions,
    pub(super) run: &'a RunOptions,
}

impl<'a> Tracker<'a> {
    /// A tracker of the whole level set, or of the part where `region` is above 0.
    pub fn new(
        level_set: &'a mut LevelSet,
        region: Option<&'a dyn Region>,
        solver: SolverOptions,
        run: &'a RunOptions,
    ) -> Self {
        let transform = *level_set.transform();
        let grid = level_set.grid_mut();
        let domain = match region {
            None => Domain::everywhere(grid),
            Some(region) => awake(|| Domain::region(grid, RegionWeights::new(grid, &transform, region))),
        };
        Self { grid, transform, domain, region, buffers: Vec::new(), solver, run }
    }

    /// Edge of a voxel.
    pub(super) fn voxel_size(&self) -> f32 {
        self.transform.voxel_size() as f32
    }

    /// The field as it is now.
    pub fn grid(&self) -> &Grid {
        self.grid
    }

    /// Active voxels that the domain lets move.
    pub fn moving_voxels(&self) -> u64 {
        let (grid, domain) = (&*self.grid, &self.domain);
        let count = |leaves| {
            let mut voxels = 0;
            dispatch(CountMoving { grid, domain, leaves, voxels: &mut voxels });
            voxels
        };
        domain.leaves().par_pages().map(count).sum()
    }

    /// From now on these leaves alone move, with the new ones that they spill into; `None` for all of them. Not for a tracker with a region.
    pub(super) fn confine(&mut self, leaves: Option<LeafSet>) {
        self.domain = match leaves {
            Some(leaves) => Domain::part(self.grid, leaves),
            None => Domain::everywhere(self.grid),
        };
        // Outside of the domain, buffers hold what φ does: they begin anew.
        self.buffers.clear();
    }

    /// Exchanges φ with second buffer `i`.
    fn exchange(&mut self, i: usize) {
        self.grid.swap_values(&mut self.buffers[i]);
    }

    /// Makes sure that there are `count` second buffers.
    fn need_buffers(&mut self, count: usize) {
        while self.buffers.len() < count {
            self.buffers.push(self.grid.value_pages().clone());
        }
    }

    /// One explicit step of `kernel`, integrated in time by `integrator`, at the voxels that `target` names.
    ///
    /// With L the kernel's Euler step φ + dt·L(φ) (Shu & Osher 1988):
    /// RK2: φ' = ½φ + ½E(E(φ)); RK3: φ' = ⅓φ + ⅔E(¾φ + ¼E(E(φ))).
    pub(super) fn integrate(
        &mut self,
        kernel: &impl LeafKernel,
        integrator: TimeIntegrator,
        target: Target,
    ) -> Result<()> {
        self.need_buffers(if integrator == TimeIntegrator::TvdRk3 { 2 } else { 1 });
        // Only the last stage trims.
        let stage = if target == Target::Trimmed { Target::Repairable } else { target };
        let mut euler = |target, from: Option<usize>, to: usize, blend: Blend| {
            let emptied = self.step_into(kernel, target, from, to, blend);
            self.exchange(to);
            emptied
        };
        // After an exchange the buffer just written is φ, and what was φ lies in its place.
        let emptied = match integrator {
            TimeIntegrator::TvdRk1 => euler(target, None, 0, Blend::NEW),
            TimeIntegrator::TvdRk2 => {
                euler(stage, None, 0, Blend::NEW);
                euler(target, None, 0, Blend { old: 0.5, new: 0.5 })
            }
            TimeIntegrator::TvdRk3 => {
                euler(stage, None, 0, Blend::NEW);
                euler(stage, Some(0), 1, Blend { old: 0.75, new: 0.25 });
                euler(target, None, 0, Blend { old: 1.0 / 3.0, new: 2.0 / 3.0 })
            }
        };
        if target == Target::Trimmed {
            self.settle(&emptied);
        }
        self.run.check("stepping the level set")
    }
}

/// Counts the active voxels of a page that move. As vector work because bits are counted one by one otherwise.
struct CountMoving<'a> {
    grid: &'a Grid,
    domain: &'a Domain,
    leaves: PageLeaves,
    voxels: &'a mut u64,
}

impl Work for CountMoving<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        self.leaves.for_each(
            #[inline(always)]
            |id| *self.voxels += u64::from(self.domain.moving(id, self.grid.mask(id)).count()),
        );
    }
}
