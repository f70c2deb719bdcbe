//! Filters of the field and the offset by a flow, each step followed by a track: OpenVDB's `LevelSetFilter`.
//!
//! The formulas of the filters are in [`crate::stencil::filter`]. With a region, a step is blended as a whole,
//! (1 − α)φ + α·E(φ); OpenVDB blends the three averages of a mean one by one, which is the same where α is 0 or 1 over
//! the width of the box.

use fearless_simd::{Simd, SimdBase};

use super::evolve::{Motion, Until, drive};
use super::step::{LeafKernel, Rows, Target};
use super::{Report, SolverOptions, TimeIntegrator, Tracker};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LeafId, LeafValues};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;
use crate::stencil::simd::Lanes;
use crate::stencil::{Cube, MedianScratch, SlabScratch, WIDEST_RIM, box_mean, box_median};

/// What a field is filtered with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FilterKind {
    /// The mean over a box, as three averages along the axes.
    Mean,
    /// Four means: a Gaussian of variance 4w(w + 1)/3 voxels² along each axis.
    Gaussian,
    /// The median over a box.
    Median,
}

/// A filter over boxes of (2·width + 1)³ voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Filter {
    /// Which one.
    pub kind: FilterKind,
    /// Voxels to each side, 1 to [`Filter::WIDEST`].
    pub width: usize,
}

impl Filter {
    /// The widest box to each side, in voxels. A wider one would see more of the cut-off values beside the band than of the surface.
    pub const WIDEST: usize = WIDEST_RIM;

    /// Refuses a width that cannot be.
    pub fn validate(&self, operation: &str) -> Result<()> {
        if (1..=Self::WIDEST).contains(&self.width) {
            return Ok(());
        }
        Err(EditError::parameter(operation, "width", self.width, format!("1 to {} voxels", Self::WIDEST)))
    }
}

/// Applies `filter` a number of times, everywhere or weighted by a region, tracking the band after each mean or median.
pub fn filter(
    level_set: &mut LevelSet,
    filter: Filter,
    applications: u32,
    region: Option<&dyn Region>,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    filter.validate("filter")?;
    let mut tracker = Tracker::new(level_set, region, *solver, run);
    let mut motion = filter;
    let rounds = if filter.kind == FilterKind::Gaussian { 4 } else { 1 };
    let report = drive(&mut tracker, &mut motion, Until::Iterations(applications.saturating_mul(rounds)))?;
    Ok(Report { steps: report.steps.div_ceil(rounds), time: 0.0, ..report })
}

impl Motion for Filter {
    fn prepare(&mut self, _: &Tracker, _: f64) -> Option<f64> {
        // A filter knows no time.
        Some(1.0)
    }

    fn step(&mut self, tracker: &mut Tracker, _: f64) -> Result<()> {
        let width = self.width;
        match self.kind {
            FilterKind::Mean | FilterKind::Gaussian => {
                let background = tracker.grid().background();
                tracker.integrate(&BoxMean { width, background }, TimeIntegrator::TvdRk1, Target::Moving)
            }
            FilterKind::Median => tracker.integrate(&BoxMedian { width }, TimeIntegrator::TvdRk1, Target::Moving),
        }
    }
}

/// Moves the surface by `distance` (world units, positive outwards) in steps of at most half a voxel, φ ← φ − d, tracking the band
/// after each; everywhere or weighted by a region.
///
/// Every step relies on |∇φ| = 1, and each renormalisation errs a little; the offset of `ops::morphology` is exact.
/// This is OpenVDB's `LevelSetFilter::offset` with the sign turned, and rounds as that does.
pub fn offset(
    level_set: &mut LevelSet,
    distance: f64,
    region: Option<&dyn Region>,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    let mut tracker = Tracker::new(level_set, region, *solver, run);
    let largest = 0.5 * tracker.voxel_size();
    let most = f64::from(largest) * MOST_STEPS;
    if !distance.is_finite() || distance.abs() > most {
        let accepted = format!("a length of at most {most} at this voxel size");
        return Err(EditError::parameter("offset", "distance", distance, accepted));
    }
    let length = distance.abs() as f32;
    let mut shift = Shift { length, largest, done: 0.0, sign: 1f32.copysign(distance as f32) };
    // Negative becomes 0.
    let steps = (f64::from(length) / f64::from(largest) - ROUNDING).ceil() as u32;
    let report = drive(&mut tracker, &mut shift, Until::Iterations(steps))?;
    Ok(Report { time: 0.0, ..report })
}

/// Most steps of an offset: a distance that needs more was meant otherwise.
const MOST_STEPS: f64 = 1e5;

/// Part of a step that is not worth one.
const ROUNDING: f64 = 0.001;

/// A motion by a length.
struct Shift {
    length: f32,
    largest: f32,
    done: f32,
    sign: f32,
}

impl Motion for Shift {
    fn prepare(&mut self, _: &Tracker, _: f64) -> Option<f64> {
        let left = self.length - self.done;
        (left > ROUNDING as f32 * self.largest).then_some(f64::from(left.min(self.largest)))
    }

    fn step(&mut self, tracker: &mut Tracker, step: f64) -> Result<()> {
        self.done += step as f32;
        tracker.integrate(&Subtract(self.sign * step as f32), TimeIntegrator::TvdRk1, Target::Moving)
    }
}

struct BoxMean {
    width: usize,
    background: f32,
}

impl LeafKernel for BoxMean {
    const REACH: usize = 1;

    type Scratch = (Cube, SlabScratch);

    fn scratch(&self) -> Self::Scratch {
        (Cube::new(self.width), SlabScratch::new(self.width))
    }

    #[inline(always)]
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: Rows,
        (cube, scratch): &mut Self::Scratch,
        out: &mut LeafValues,
    ) {
        let rows = rows.voxels();
        cube.gather(grid.value_pages(), &grid.neighbours()[id.index()], rows);
        box_mean(simd, cube, self.background, rows, scratch, out);
    }
}

struct BoxMedian {
    width: usize,
}

impl LeafKernel for BoxMedian {
    const REACH: usize = 1;

    type Scratch = (Cube, MedianScratch);

    fn scratch(&self) -> Self::Scratch {
        (Cube::new(self.width), MedianScratch::default())
    }

    #[inline(always)]
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: Rows,
        (cube, scratch): &mut Self::Scratch,
        out: &mut LeafValues,
    ) {
        let rows = rows.voxels();
        cube.gather(grid.value_pages(), &grid.neighbours()[id.index()], rows);
        box_median(simd, cube, rows, scratch, out);
    }
}

/// φ less a constant.
struct Subtract(f32);

impl LeafKernel for Subtract {
    const REACH: usize = 0;

    type Scratch = ();

    fn scratch(&self) {}

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, (): &mut (), out: &mut LeafValues) {
        let phi = &grid.values(id).0;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                (Lanes::from_slice(simd, &phi[at..at + 16]) - self.0).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, IVec3};

    use super::*;
    use crate::grid::{Transform, offset_to_local};
    use crate::levelset::testing::box_distance;

    const KINDS: [FilterKind; 3] = [FilterKind::Mean, FilterKind::Gaussian, FilterKind::Median];
    const CENTRE: DVec3 = DVec3::new(0.3, 0.2, -0.4);

    fn made(half_width: f32, distance: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
        let bounds = (IVec3::splat(-31), IVec3::splat(31));
        let run = RunOptions::default();
        LevelSet::from_distance(Transform::uniform(0.5), half_width, bounds, distance, &run).unwrap()
    }

    fn filtered(mut level_set: LevelSet, what: Filter, times: u32, solver: &SolverOptions) -> LevelSet {
        filter(&mut level_set, what, times, None, solver, &RunOptions::default()).unwrap();
        level_set
    }

    /// Largest difference to `distance` of the voxels that are within `reach` of the surface and 20 of the origin, in voxels.
    fn error(level_set: &LevelSet, reach: f64, distance: impl Fn(DVec3) -> f64) -> f64 {
        let grid = level_set.grid();
        let (mut worst, mut count) = (0f64, 0);
        for &id in grid.leaves() {
            for at in grid.mask(id).iter() {
                let ijk = grid.origin(id) + offset_to_local(at);
                let exact = distance(ijk.as_dvec3());
                if exact.abs() < reach && ijk.abs().max_element() < 20 {
                    worst = worst.max((f64::from(grid.values(id).0[at]) / 0.5 - exact).abs());
                    count += 1;
                }
            }
        }
        assert!(count > 500);
        worst
    }

    #[test]
    fn a_plane_stays() {
        // Nothing is repaired, so that what is seen is the filter; a Gaussian reads four boxes far.
        let solver = SolverOptions { normalizations: 0, ..SolverOptions::FIRST_ORDER };
        for normal in [DVec3::X, DVec3::new(1.0, 2.0, -2.0) / 3.0] {
            let plane = |p: DVec3| (p - CENTRE).dot(normal);
            for kind in KINDS {
                let boxes = if kind == FilterKind::Gaussian { 4.0 } else { 1.0 };
                for width in [1, 2] {
                    let reach = boxes * width as f64 * 3f64.sqrt();
                    let half_width = (reach + 2.0).ceil() as f32;
                    let level_set = filtered(made(half_width, plane), Filter { kind, width }, 1, &solver);
                    // 27 or 125 sums of f32 distances of up to 16 voxels.
                    assert!(error(&level_set, 2.0, plane) < 2e-5, "{kind:?} {width} {normal}");
                }
            }
        }
    }

    #[test]
    fn a_mean_moves_a_sphere_by_its_variance_over_the_radius() {
        // dR = −σ²/R with σ² = w(w + 1)/3 voxels²: R² = R₀² − 2σ²n; within the 0.05 voxel that flows are held to.
        let solver = SolverOptions { normalizations: 1, ..SolverOptions::OPENVDB };
        for (kind, width, times, boxes) in
            [(FilterKind::Mean, 1, 12, 12.0), (FilterKind::Gaussian, 1, 3, 12.0), (FilterKind::Mean, 2, 4, 4.0)]
        {
            let variance = (width * (width + 1)) as f64 / 3.0;
            let radius = (400.0 - 2.0 * variance * boxes).sqrt();
            let sphere = made(5.0, |p| (p - CENTRE).length() - 20.0);
            let level_set = filtered(sphere, Filter { kind, width }, times, &solver);
            let error = error(&level_set, 0.5, |p| (p - CENTRE).length() - radius);
            assert!(error < 0.05, "{kind:?} {width}: {error}, moved by {}", 20.0 - radius);
        }
    }

    #[test]
    fn a_median_keeps_a_sphere_and_removes_a_spike() {
        // The box sees 0.017 voxel of bulge on a sphere of 20 voxels at its faces and three times that at its corners.
        let sphere = |p: DVec3| (p - CENTRE).length() - 20.0;
        let what = Filter { kind: FilterKind::Median, width: 1 };
        let level_set = filtered(made(3.0, sphere), what, 1, &SolverOptions::OPENVDB);
        let kept = error(&level_set, 0.5, sphere);
        assert!(kept > 1e-3 && kept < 0.075, "{kept}");
        // A needle one voxel thick is gone after one pass.
        let needle = |p: DVec3| sphere(p).min((p.x.hypot(p.y) - 0.6).max(p.z.abs() - 26.0));
        let before = made(3.0, needle);
        assert!(before.grid().voxel(IVec3::new(0, 0, 24)).0 < 0.0);
        let after = filtered(before, what, 1, &SolverOptions::OPENVDB);
        assert!(after.grid().voxel(IVec3::new(0, 0, 24)).0 > 0.0 && after.check().is_empty());
    }

    #[test]
    fn erosion_keeps_the_corners_of_a_box_and_dilation_rounds_them() {
        let half = DVec3::new(12.3, 13.1, 12.7);
        let cuboid = made(3.0, |p| box_distance(p, half));
        let moved = |by: f64| {
            let mut level_set = cuboid.clone();
            offset(&mut level_set, by * 0.5, None, &SolverOptions::OPENVDB, &RunOptions::default()).unwrap();
            level_set
        };
        let (eroded, dilated) = (moved(-4.0), moved(4.0));
        // Both take eight tracks; beside an edge each may shift the surface by a few hundredths of a voxel.
        assert!(error(&eroded, 0.5, |p| box_distance(p, half - 4.0)) < 0.25);
        assert!(error(&dilated, 0.5, |p| box_distance(p, half) - 4.0) < 0.4);
        let at = |level_set: &LevelSet, p: DVec3| f64::from(level_set.sampler().trilinear(p)) / 0.5;
        // A corner of voxels is blunt by half a voxel; one that is rounded by 4 ends 2.93 = 4(√3 − 1) before the corner of the box around it.
        let blunt = at(&eroded, half - 4.0);
        assert!(blunt.abs() < 0.7, "{blunt}");
        let rounded = at(&dilated, half + 4.0);
        assert!((rounded - 4.0 * (3f64.sqrt() - 1.0)).abs() < 0.1, "{rounded}");
    }

    #[test]
    fn offsets_of_a_sphere_step_by_step() {
        let run = RunOptions::default();
        for distance in [1.0, -1.0, 2.7, -0.2] {
            let mut sphere = made(3.0, |p| (p - CENTRE).length() - 18.0);
            let report = offset(&mut sphere, distance * 0.5, None, &SolverOptions::OPENVDB, &run).unwrap();
            assert_eq!(report.steps, (f64::abs(distance) * 2.0).ceil() as u32);
            let error = error(&sphere, 0.5, |p| (p - CENTRE).length() - 18.0 - distance);
            // Each of up to six tracks may shift the surface by a hundredth of a voxel.
            assert!(error < 0.06, "{distance}: {error}");
            assert!(sphere.check().is_empty());
        }
        for distance in [f64::NAN, f64::INFINITY, 1e6] {
            let mut sphere = made(3.0, |p| p.length() - 18.0);
            let refused = offset(&mut sphere, distance, None, &SolverOptions::OPENVDB, &run).unwrap_err();
            assert!(refused.to_string().contains("distance"), "{refused}");
        }
        let mut sphere = made(3.0, |p| p.length() - 18.0);
        assert_eq!(offset(&mut sphere, 0.0, None, &SolverOptions::OPENVDB, &run).unwrap().steps, 0);
    }

    #[test]
    fn widths_out_of_range_are_refused() {
        for width in [0, Filter::WIDEST + 1] {
            let mut sphere = made(3.0, |p| p.length() - 18.0);
            let what = Filter { kind: FilterKind::Mean, width };
            let refused = filter(&mut sphere, what, 1, None, &SolverOptions::OPENVDB, &RunOptions::default());
            assert!(refused.unwrap_err().to_string().contains("1 to 8"));
        }
    }
}
