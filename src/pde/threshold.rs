//! Segmentation: a surface grows over the parts of a volume whose numbers are in a range, and is kept smooth by its curvature
//! (Lefohn, Cates & Whitaker 2003, "Interactive, GPU-based level sets for 3D segmentation"; the solvers of Whitaker & Breen 1998).
//!
//! > φ_t = −F|∇φ|,  F = h [(1 − β) D(I) − β h (κ₁ + κ₂)],  −1 ≤ D ≤ 1
//!
//! D is positive where the number I belongs to the part, negative where it does not, and 0 at the edge of the range. With β = 0 the surface runs
//! to D = 0, noise and all; the second term holds it back where it would have to bend. It rests where (1 − β) D = β h (κ₁ + κ₂): a ball of R
//! voxels comes to rest where D = 2β / ((1 − β) R), inside of the edge by that over the slope of D. Time is in steps of a voxel at full speed.
//!
//! D is that of the voxel, not of the surface beside it: where it changes sign the level sets of φ bunch up, and each track repairs it only in part. The
//! result is to be made a distance again by a rebuild.
//!
//! Godunov's |∇φ| for D, central differences for the curvature; 1/dt = 1/dt_D + 1/dt_κ with dt_D = ½/(1 − β), dt_κ = 0.9/(6β).

use glam::IVec3;

use super::evolve::{Motion, Report, Until, drive};
use super::step::Target;
use super::surface_speed::SmoothedStep;
use super::tracker::Tracker;
use super::{SolverOptions, TimeIntegrator};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LeafId, LeafValues, PageLeaves, Paged, offset_to_local};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;

/// Steps between two looks at whether the surface still moves, and the mean motion in voxels a look below which it rests.
const LOOK_EVERY: u32 = 10;
const AT_REST: f64 = 0.005;

/// Moves a level set by D and its curvature, everywhere or weighted by a region, until `until` or until it rests. `membership` is D at a voxel
/// of its lattice, between −1 and 1; `smoothness` is β, 0 to 1.
pub fn grow_by_threshold(
    level_set: &mut LevelSet,
    membership: &(dyn Fn(IVec3) -> f32 + Sync),
    smoothness: f64,
    region: Option<&dyn Region>,
    until: Until,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    if !(0.0..=1.0).contains(&smoothness) {
        return Err(EditError::parameter("segment", "smoothness", smoothness, "a number from 0 to 1"));
    }
    let mut tracker = Tracker::new(level_set, region, *solver, run);
    let mut growth = Growth { membership, smoothness, speed: Paged::default(), steps: 0, before: None };
    drive(&mut tracker, &mut growth, until)
}

struct Growth<'a> {
    membership: &'a (dyn Fn(IVec3) -> f32 + Sync),
    smoothness: f64,
    /// (1 − β) D at the voxels of the band.
    speed: Paged<LeafValues>,
    steps: u32,
    /// The field at the last look.
    before: Option<Grid>,
}

impl Growth<'_> {
    /// Whether the surface has hardly moved since the last look: by the parts of the voxels that changed sides, to the first order.
    fn rests(&mut self, grid: &Grid, voxel_size: f32) -> bool {
        if !self.steps.is_multiple_of(LOOK_EVERY) {
            return false;
        }
        let Some(before) = self.before.replace(grid.clone()) else { return false };
        let share = |value: f32| f64::from((0.5 - 0.5 * value / voxel_size).clamp(0.0, 1.0));
        let changed = |id: LeafId| {
            let (now, then) = (&grid.values(id).0, &before.values(before.find(grid.origin(id))).0);
            grid.mask(id).iter().map(|at| (share(now[at]) - share(then[at])).abs()).sum()
        };
        let area = grid.active_voxels() as f64 * f64::from(voxel_size) / (2.0 * f64::from(grid.background()));
        grid.sum_leaves(changed) < AT_REST * area
    }
}

impl Motion for Growth<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        let grid = tracker.grid();
        if self.rests(grid, tracker.voxel_size()) {
            return None;
        }
        self.steps += 1;
        let pages = grid.value_pages().page_count();
        self.speed.truncate(pages);
        // Voxels are written before they are read.
        self.speed.grow_unwritten(pages);
        let (membership, weight) = (self.membership, (1.0 - self.smoothness as f32) * tracker.voxel_size());
        self.speed.par_update_pages(tracker.domain.leaves(), |leaves, speed| {
            leaves.for_each(|id| {
                let (speed, origin) = (&mut speed[PageLeaves::slot(id)].0, grid.origin(id));
                for at in tracker.domain.moving(id, grid.mask(id)).iter() {
                    speed[at] = weight * membership(origin + offset_to_local(at)).clamp(-1.0, 1.0);
                }
            });
        });
        let slowness = (1.0 - self.smoothness) / 0.5 + 6.0 * self.smoothness / 0.9;
        Some((1.0 / slowness).min(left))
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        let voxel_size = tracker.voxel_size();
        let twice = 2.0 * self.smoothness as f32 * voxel_size * voxel_size;
        let step = SmoothedStep { speed: &self.speed, twice, dt: dt as f32, voxel_size };
        tracker.integrate(&step, TimeIntegrator::TvdRk1, Target::Moving)
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::levelset::testing::ball;
    use crate::pde::{StopReason, UpwindScheme};

    const SOLVER: SolverOptions = SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

    fn radius(level_set: &LevelSet) -> f64 {
        let volume = level_set.measure(&RunOptions::default()).unwrap().volume;
        (volume * 3.0 / 4.0 / std::f64::consts::PI).cbrt()
    }

    #[test]
    fn at_full_speed_a_ball_grows_by_a_voxel_a_unit_of_time() {
        let mut level_set = ball(DVec3::ZERO, 10.0);
        let run = RunOptions::default();
        let report = grow_by_threshold(&mut level_set, &|_| 1.0, 0.0, None, Until::Time(6.0), &SOLVER, &run).unwrap();
        assert!((report.time - 6.0).abs() < 1e-12);
        // First-order upwind |∇φ| errs by about 0.2 voxel over 8 voxels of growth.
        assert!((radius(&level_set) - 16.0).abs() < 0.35, "{}", radius(&level_set));
        assert!(level_set.check().is_empty());
    }

    #[test]
    fn it_rests_where_membership_and_curvature_balance() {
        let run = RunOptions::default();
        for smoothness in [0.0, 0.3, 0.6] {
            let mut level_set = ball(DVec3::new(0.4, 0.1, 0.2), 8.0);
            // D falls by a quarter a voxel through 0 at 16.
            let membership = |ijk: IVec3| ((16.0 - ijk.as_vec3().length()) * 0.25).clamp(-1.0, 1.0);
            let until = Until::Iterations(400);
            let report =
                grow_by_threshold(&mut level_set, &membership, smoothness, None, until, &SOLVER, &run).unwrap();
            assert_eq!(report.stopped, StopReason::AtRest, "{report:?}");
            // (1 − β)(16 − R)/4 = 2β/R.
            let balance = |r: f64| (1.0 - smoothness) * (16.0 - r) / 4.0 - 2.0 * smoothness / r;
            assert!(balance(radius(&level_set)).abs() < 0.015, "{smoothness}: {}", radius(&level_set));
        }
        let mut level_set = ball(DVec3::ZERO, 8.0);
        let bad = grow_by_threshold(&mut level_set, &|_| 1.0, 1.5, None, Until::Iterations(1), &SOLVER, &run);
        assert!(bad.is_err());
    }
}
