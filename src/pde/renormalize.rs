//! Renormalisation: φ_τ + S(φ)(|∇φ| − 1) = 0 restores |∇φ| = 1 and keeps the zero set (Sussman, Smereka & Osher 1994;
//! Peng et al. 1999).
//!
//! S = φ / √(φ² + |Dφ|²) with Godunov's |Dφ| on unscaled differences, as OpenVDB's tracker has it; τ advances by 0.3, 0.9
//! or 1.0 voxel for RK1, RK2, RK3. First order shifts the zero set by about 0.04 voxel where it is repeated to
//! convergence; a step or two after each step of a flow shifts it far less.

use fearless_simd::{Simd, SimdBase, SimdFloat};

use super::step::{LeafKernel, Rows, Target};
use super::tracker::Tracker;
use super::{SolverOptions, TimeIntegrator};
use crate::error::Result;
use crate::grid::{Grid, LeafId, LeafValues};
use crate::levelset::LevelSet;
use crate::run::RunOptions;
use crate::stencil::simd::Lanes;
use crate::stencil::upwind::{UpwindScheme, WenoEpsilon, godunov_first, godunov_weno5};
use crate::stencil::{FaceHalo, LeafHalo, StarHalo};

/// Renormalises the whole band `solver.normalizations` times. The band itself stays as it is.
pub fn renormalize(level_set: &mut LevelSet, solver: &SolverOptions, run: &RunOptions) -> Result<()> {
    Tracker::new(level_set, None, *solver, run).renormalize()
}

impl Tracker<'_> {
    /// Renormalises the domain `solver.normalizations` times.
    pub fn renormalize(&mut self) -> Result<()> {
        self.renormalize_to(Target::Repairable)
    }

    /// Renormalises the domain `solver.normalizations` times, the last time with target `last`.
    pub(super) fn renormalize_to(&mut self, last: Target) -> Result<()> {
        let SolverOptions { scheme, integrator, normalizations, weno_epsilon } = self.solver;
        let voxel_size = self.voxel_size();
        // The steps of OpenVDB's LevelSetTracker: the largest that stay stable with each scheme.
        let courant = match integrator {
            TimeIntegrator::TvdRk1 => 0.3,
            TimeIntegrator::TvdRk2 => 0.9,
            TimeIntegrator::TvdRk3 => 1.0,
        };
        let step = RenormalizationStep { dt: courant * voxel_size, voxel_size };
        for n in 1..=normalizations {
            let target = if n == normalizations { last } else { Target::Repairable };
            match scheme {
                UpwindScheme::First => self.integrate(&FirstOrder(step), integrator, target)?,
                UpwindScheme::HjWeno5 => self.integrate(&Weno5(step, weno_epsilon), integrator, target)?,
            }
        }
        if normalizations == 0 && last == Target::Trimmed {
            self.trim_band()?;
        }
        Ok(())
    }

    /// Deactivates the voxels of the domain that lie outside the band, sets them to ±background, and removes empty leaves.
    pub fn trim_band(&mut self) -> Result<()> {
        self.integrate(&Unchanged, TimeIntegrator::TvdRk1, Target::Trimmed)
    }
}

/// No renormalisation: trimming alone.
struct Unchanged;

impl LeafKernel for Unchanged {
    const REACH: usize = 0;

    type Scratch = ();

    fn scratch(&self) {}

    #[inline(always)]
    fn euler<S: Simd>(&self, _: S, grid: &Grid, id: LeafId, _: Rows, (): &mut (), out: &mut LeafValues) {
        out.0 = grid.values(id).0;
    }
}

/// The formula shared by both schemes.
#[derive(Clone, Copy)]
struct RenormalizationStep {
    dt: f32,
    voxel_size: f32,
}

impl RenormalizationStep {
    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, phi: Lanes<S>, norm2: Lanes<S>) -> Lanes<S> {
        // 1e-8 keeps 0/0 from a voxel that lies on the surface of a flat field; as in OpenVDB.
        let sign = phi / ((phi * phi + norm2).sqrt() + 1e-8);
        let excess = norm2.sqrt() * (1.0 / self.voxel_size) - Lanes::splat(simd, 1.0);
        phi - sign * self.dt * excess
    }
}

struct FirstOrder(RenormalizationStep);

impl LeafKernel for FirstOrder {
    const REACH: usize = FaceHalo::REACH;

    type Scratch = FaceHalo;

    fn scratch(&self) -> FaceHalo {
        FaceHalo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, halo: &mut FaceHalo, out: &mut LeafValues) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        // A copy, so that what depends on it alone is computed once a leaf.
        let step = self.0;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let phi = halo.centre(simd, x, y);
                step.euler(simd, phi, godunov_first(simd, halo, x, y, phi)).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

struct Weno5(RenormalizationStep, WenoEpsilon);

impl LeafKernel for Weno5 {
    const REACH: usize = <StarHalo as LeafHalo>::REACH;

    type Scratch = StarHalo;

    fn scratch(&self) -> StarHalo {
        StarHalo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, halo: &mut StarHalo, out: &mut LeafValues) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        let Self(step, epsilon) = *self;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, bits| {
                let at = x * 64 + y * 8;
                let phi = halo.centre(simd, x, y);
                step.euler(simd, phi, godunov_weno5(simd, halo, x, y, bits, phi, step.voxel_size, epsilon))
                    .store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}
