//! The anisotropic Gaussian of the thesis of 2006: smooths a field along its surface more than across it.
//!
//! The kernels are those of [`crate::stencil::anisotropic`]. Normals and widths are taken once, from the field as it was before the first pass. One application
//! acts as the flow F = −2H for the time s₂²/2 (voxels²): a sphere of radius R shrinks by s₂²/R, the concave edge of a union is filled up to 0.80 s₂ from the edge. s₁ acts
//! where φ is no distance, at edges and on medial axes: a slab survives if it is thicker than 1.6 s₁.
//!
//! - **Band.** Kernels read up to 2.5 s₁ off the voxels that matter: a band narrower than that, and 1.25 voxels more, is widened by exact distances first; its own voxels stay as they are.
//! - **Region.** The second and third pass read what the one before left around each voxel, so the first two are computed beyond the region as well, ⌈1.5 s₂⌉ voxels; restricted to it they would lose a fifth
//!   of the effect. Either the result is blended by the region's weight (the default), or the widths are faded by it, which keeps the shape natural around curves.
//! - **Direction.** min(filtered, φ) only adds, max(filtered, φ) only removes, exactly, also after the repair.
//! - **Shape.** With a critical curvature, s₂ falls as s₂/(1 + (κ/κ_c)⁴) with κ the larger principal curvature of φ smoothed by two voxels, so that edges stay; normals are then those of φ smoothed by one voxel.
//! - **Repair.** φ is renormalised afterwards, in a band that was let grow with the motion.

use fearless_simd::{Simd, SimdBase};

use super::step::{LeafKernel, Target};
use super::{Direction, Report, SolverOptions, StopReason, TimeIntegrator, Tracker, UpwindScheme, WenoEpsilon};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LeafId, LeafMask, LeafValues, PageLeaves, Paged};
use crate::levelset::LevelSet;
use crate::mesh::widened;
use crate::region::{Region, RegionWeights, VoxelSet};
use crate::run::RunOptions;
use crate::stencil::anisotropic::{Kernels, LARGEST_SIGMA, LEAST_SIGMA, Pass, Window, filter_leaf, normals};
use crate::stencil::normals::curvatures;
use crate::stencil::simd::{Lanes, Work, dispatch};
use crate::stencil::{FaceHalo, Halo};

const OPERATION: &str = "anisotropic gaussian";

/// Standard deviations, in voxels, of the isotropic Gaussians before normals and curvatures are taken where shapes are preserved.
const NORMAL_SIGMA: f32 = 1.0;
const BEND_SIGMA: f32 = 2.0;

/// An anisotropic Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AnisotropicGaussian {
    /// Standard deviations along the normal and along the surface, in voxels.
    pub sigma: [f32; 2],
    /// Principal curvature (1/voxel) at which s₂ is halved; `None` smooths everything alike.
    pub critical_curvature: Option<f32>,
    /// Which way the surface may move.
    pub direction: Direction,
    /// Whether a region's weight scales the kernels instead of blending the result: for regions around curves.
    pub fades_kernels: bool,
}

impl Default for AnisotropicGaussian {
    fn default() -> Self {
        Self { sigma: Self::DEFAULT_SIGMA, critical_curvature: None, direction: Direction::Both, fades_kernels: false }
    }
}

impl AnisotropicGaussian {
    /// The default widths: s₂ = 1.5 s₁.
    pub const DEFAULT_SIGMA: [f32; 2] = [1.5, 2.25];

    /// The critical curvature where shapes are to be kept and none is given: edges of boxes stay within a tenth of a voxel, faces lose as much noise as without.
    pub const DEFAULT_CRITICAL_CURVATURE: f32 = 0.12;

    /// Refuses widths that cannot be.
    pub fn validate(&self, operation: &str) -> Result<()> {
        let [along, across] = self.sigma;
        if !(LEAST_SIGMA <= along && along <= across && across <= LARGEST_SIGMA) {
            let accepted = format!(
                "two widths in voxels, that along the normal first and not larger, both from {LEAST_SIGMA} to {LARGEST_SIGMA}, such as 1.5,2.25"
            );
            return Err(EditError::parameter(operation, "sigma", format!("{along},{across}"), accepted));
        }
        match self.critical_curvature {
            Some(k) if !(k > 0.0 && k.is_finite()) => {
                Err(EditError::parameter(operation, "critical_curvature", k, "a curvature above 0, in 1/voxel"))
            }
            _ => Ok(()),
        }
    }

    /// The half width of the band that the kernels need, in voxels.
    pub fn needed_half_width(&self) -> f32 {
        // Curvatures are those of φ smoothed by two voxels in all directions.
        let along = if self.critical_curvature.is_some() { self.sigma[0].max(BEND_SIGMA) } else { self.sigma[0] };
        (2.5 * along + 1.25).ceil().max(3.0)
    }

    /// How far beyond the region the first two passes are computed, in voxels.
    fn rim(&self) -> usize {
        (1.5 * self.sigma[1]).ceil() as usize
    }

    /// How far, in voxels, a right-angled edge may move the band.
    fn motion(&self) -> usize {
        1 + (0.6 * self.sigma[1]) as usize
    }

    /// How φ is repaired: the band was moved, and is up to three voxels wide.
    pub fn repair(&self) -> SolverOptions {
        SolverOptions {
            scheme: UpwindScheme::HjWeno5,
            integrator: TimeIntegrator::TvdRk3,
            normalizations: self.motion() as u32 + 3,
            weno_epsilon: WenoEpsilon::SCALE_FREE,
        }
    }
}

/// Applies the filter a number of times, everywhere or in a region, repairing the distance after each. The band keeps its half width.
pub fn filter_anisotropic(
    level_set: &mut LevelSet,
    what: &AnisotropicGaussian,
    applications: u32,
    region: Option<&dyn Region>,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    what.validate(OPERATION)?;
    let support = region.filter(|_| what.fades_kernels).map(Support);
    // Faded kernels leave nothing to be blended.
    let blended = support.as_ref().map_or(region, |support| Some(support as &dyn Region));
    let mut report = Report { steps: 0, time: 0.0, voxels: 0, stopped: StopReason::Iterations };
    let task = run.task("filtering", u64::from(applications));
    for _ in 0..applications {
        run.check(OPERATION)?;
        let wide = reach_out(level_set, what, region, run)?;
        let filtered = filtered(&wide, what, region, run)?;
        let before = level_set.grid().clone();
        let mut tracker = Tracker::new(level_set, blended, *solver, run);
        report.voxels = tracker.moving_voxels();
        if report.voxels == 0 {
            report.stopped = StopReason::NothingLeft;
            break;
        }
        for _ in 0..what.motion() {
            tracker.dilate_band();
        }
        let (direction, values) = (what.direction, &filtered);
        let take = Take { direction, from: wide.grid(), values };
        tracker.integrate(&take, TimeIntegrator::TvdRk1, Target::Moving)?;
        tracker.renormalize()?;
        match direction {
            Direction::Both => tracker.trim_band()?,
            _ => tracker.integrate(&Bound { direction, by: &before }, TimeIntegrator::TvdRk1, Target::Trimmed)?,
        }
        report.voxels = tracker.moving_voxels();
        report.steps += 1;
        task.advance(1);
    }
    Ok(report)
}

/// α = 1 wherever a region's weight is above 0.
struct Support<'a>(&'a dyn Region);

impl Region for Support<'_> {
    fn weight(&self, xyz: glam::DVec3) -> f32 {
        f32::from(u8::from(self.0.weight(xyz) > 0.0))
    }

    fn bounds(&self) -> Option<(glam::DVec3, glam::DVec3)> {
        self.0.bounds()
    }

    fn weights_within(&self, centre: glam::DVec3, radius: f64) -> [f32; 2] {
        self.0.weights_within(centre, radius).map(|w| f32::from(u8::from(w > 0.0)))
    }
}

/// The level set with a band as wide as the kernels need, where they read it.
fn reach_out(
    level_set: &LevelSet,
    what: &AnisotropicGaussian,
    region: Option<&dyn Region>,
    run: &RunOptions,
) -> Result<LevelSet> {
    let transform = level_set.transform();
    // Kernels reach three standard deviations; two voxels more are for differences.
    let reach = f64::from(3.0 * what.sigma[1]) + what.rim() as f64 + 2.0;
    let wanted = |first: glam::IVec3, last: glam::IVec3| {
        let Some(region) = region else { return true };
        let (centre, half) = ((first + last).as_dvec3() / 2.0, (last - first).as_dvec3().length() / 2.0);
        let radius = (half + reach) * transform.voxel_size();
        region.weights_within(transform.index_to_world(centre), radius)[1] > 0.0
    };
    widened(level_set, what.needed_half_width(), wanted, run)
}

/// The field after the three passes, on the leaves of `wide`; where the region is 0 it is what it was.
fn filtered(
    wide: &LevelSet,
    what: &AnisotropicGaussian,
    region: Option<&dyn Region>,
    run: &RunOptions,
) -> Result<Paged<LeafValues>> {
    let grid = wide.grid();
    let bytes = grid.leaves().len() as u64 * 2 * size_of::<LeafValues>() as u64;
    run.reserve(OPERATION, bytes, "filter a smaller region")?;
    let weights = region.map(|region| RegionWeights::new(grid, wide.transform(), region));
    // Voxels of the last pass, and of those before it.
    let voxels = match &weights {
        None => VoxelSet::active(grid),
        Some(weights) => VoxelSet::weighted(grid, weights),
    };
    let around = match (&weights, what.fades_kernels) {
        (Some(_), false) => voxels.grown(grid, what.rim()),
        _ => voxels.clone(),
    };
    let voxel_size = wide.voxel_size() as f32;
    let start = grid.value_pages();
    grid.neighbours();
    let isotropic = |sigma: f32, voxels: &VoxelSet| {
        let source =
            KernelSource { normals: None, bends: None, sigma: [sigma; 2], critical: 1.0, fade: None, voxel_size };
        three_passes(grid, start, &source, [voxels, voxels], run)
    };
    let smooth = match what.critical_curvature {
        None => None,
        Some(_) => {
            // Differences of normals read one voxel beyond each, and kernels three standard deviations beyond that.
            let beyond = around.grown(grid, 2);
            Some((isotropic(NORMAL_SIGMA, &beyond)?, isotropic(BEND_SIGMA, &beyond)?))
        }
    };
    let source = KernelSource {
        normals: Some(smooth.as_ref().map_or(start, |(a_little, _)| a_little)),
        bends: smooth.as_ref().map(|(_, more)| more),
        sigma: what.sigma,
        critical: what.critical_curvature.unwrap_or(1.0),
        fade: weights.as_ref().filter(|_| what.fades_kernels),
        voxel_size,
    };
    three_passes(grid, start, &source, [&around, &voxels], run)
}

/// `start` after the three passes; the first two at the voxels `around`, the last at `voxels`.
fn three_passes(
    grid: &Grid,
    start: &Paged<LeafValues>,
    source: &KernelSource,
    [around, voxels]: [&VoxelSet; 2],
    run: &RunOptions,
) -> Result<Paged<LeafValues>> {
    let mut current = start.clone();
    for pass in Pass::ALL {
        let voxels = if pass == Pass::Third { voxels } else { around };
        let mut next = current.clone();
        next.par_update_pages(voxels.leaves(), |leaves, page| {
            if !run.is_cancelled() {
                dispatch(PassWork { pass, grid, current: &current, source, voxels, leaves, page });
            }
        });
        run.check(OPERATION)?;
        current = next;
    }
    Ok(current)
}

/// Where the kernels of each voxel come from.
struct KernelSource<'a> {
    /// The field whose normals count; without one the kernels are isotropic, of the first width.
    normals: Option<&'a Paged<LeafValues>>,
    /// The field whose curvature makes kernels narrower.
    bends: Option<&'a Paged<LeafValues>>,
    sigma: [f32; 2],
    critical: f32,
    fade: Option<&'a RegionWeights>,
    voxel_size: f32,
}

/// One pass on the leaves of a page.
struct PassWork<'a> {
    pass: Pass,
    grid: &'a Grid,
    current: &'a Paged<LeafValues>,
    source: &'a KernelSource<'a>,
    voxels: &'a VoxelSet,
    leaves: PageLeaves,
    page: &'a mut [LeafValues],
}

impl Work for PassWork<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { pass, grid, current, source, voxels, leaves, page } = self;
        let KernelSource { sigma, voxel_size, .. } = *source;
        let mut window = Window::new(sigma[1]);
        let (mut faces, mut block) = (FaceHalo::new(), Halo::new());
        let (zero, one) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0));
        // Of a curvature, in units of the critical one.
        let scale = voxel_size / source.critical;
        leaves.for_each(
            #[inline(always)]
            |id| {
                let around = &grid.neighbours()[id.index()];
                if let Some(values) = source.normals {
                    faces.gather(values, around);
                }
                if let Some(values) = source.bends {
                    block.gather(values, around);
                }
                let (faces, block) = (&faces, &block);
                let mask = voxels.mask(id).zip(grid.mask(id), |voxels, active| voxels & active);
                filter_leaf(
                    simd,
                    pass,
                    &mut window,
                    (grid, current),
                    (id, mask),
                    #[inline(always)]
                    |x: usize, y: usize| {
                        let normal = match source.normals {
                            Some(_) => normals(simd, faces, x, y, voxel_size),
                            None => [zero; 3],
                        };
                        let [mut along, mut across] = sigma.map(
                            #[inline(always)]
                            |s| Lanes::splat(simd, s),
                        );
                        if source.bends.is_some() {
                            let found = curvatures(simd, block, x, y, voxel_size);
                            let bend = found.max.abs().max(found.min.abs()) * scale;
                            let squared = bend * bend;
                            across = across / (one + squared * squared);
                            along = along.min(across);
                        }
                        if let Some(weights) = source.fade {
                            let alpha = Lanes::from_slice(simd, &weights.alpha(id).0[x * 64 + y * 8..][..16]);
                            (along, across) = (along * alpha, across * alpha);
                        }
                        Kernels { normal, variances: [along * along, across * across] }
                    },
                    &mut page[PageLeaves::slot(id)],
                );
            },
        );
    }
}

/// The filtered value of each voxel, on the side of the old one that the direction allows.
struct Take<'a> {
    direction: Direction,
    from: &'a Grid,
    values: &'a Paged<LeafValues>,
}

impl LeafKernel for Take<'_> {
    const REACH: usize = 0;

    type Scratch = ();

    fn scratch(&self) {}

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: LeafMask, (): &mut (), out: &mut LeafValues) {
        let id = self.from.find(grid.origin(id));
        one_sided(simd, self.direction, rows, self.values.get(id), self.from.values(id), out);
    }
}

/// φ on the side of an older φ that the direction allows.
struct Bound<'a> {
    direction: Direction,
    by: &'a Grid,
}

impl LeafKernel for Bound<'_> {
    const REACH: usize = 0;

    type Scratch = ();

    fn scratch(&self) {}

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: LeafMask, (): &mut (), out: &mut LeafValues) {
        let by = self.by.values(self.by.find(grid.origin(id)));
        one_sided(simd, self.direction, rows, grid.values(id), by, out);
    }
}

/// The values `new` where the surface may move there from `old`.
#[inline(always)]
fn one_sided<S: Simd>(
    simd: S,
    direction: Direction,
    rows: LeafMask,
    new: &LeafValues,
    old: &LeafValues,
    out: &mut LeafValues,
) {
    rows.for_each_pair(
        #[inline(always)]
        |x, y, _| {
            let at = x * 64 + y * 8;
            let (new, old) =
                (Lanes::from_slice(simd, &new.0[at..at + 16]), Lanes::from_slice(simd, &old.0[at..at + 16]));
            let value = match direction {
                Direction::Both => new,
                Direction::Add => new.min(old),
                Direction::Remove => new.max(old),
            };
            value.store_slice(&mut out.0[at..at + 16]);
        },
    );
}

#[cfg(test)]
mod tests;
