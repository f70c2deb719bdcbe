//! The time loop.

use super::speed::{FlowStep, SpeedFunction};
use super::step::Target;
use super::{SolverOptions, TimeIntegrator, Tracker};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;

/// When a flow ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Until {
    /// After a number of its largest stable steps.
    Iterations(u32),
    /// After a time, in the unit that the speed function implies (world² for F = −H).
    Time(f64),
}

/// Why a flow ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// The steps that were asked for are done.
    Iterations,
    /// The time that was asked for has passed.
    Time,
    /// The surface vanished, or the region touches nothing.
    NothingLeft,
}

/// What a flow did.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Steps taken.
    pub steps: u32,
    /// Time passed.
    pub time: f64,
    /// Voxels in the domain after the last step.
    pub voxels: u64,
    /// Why it ended.
    pub stopped: StopReason,
}

/// Most steps of one flow: a time that needs more was meant otherwise.
const MOST_STEPS: f64 = 1e6;

/// Moves a surface by φ_t = −F|∇φ|, everywhere or weighted by a region, tracking the band after each step.
pub fn evolve(
    level_set: &mut LevelSet,
    function: &impl SpeedFunction,
    region: Option<&dyn Region>,
    until: Until,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    let largest = function.largest_step(level_set.voxel_size());
    let (steps, dt) = match until {
        Until::Iterations(n) => (n, largest),
        Until::Time(t) => {
            if !(t >= 0.0 && t / largest <= MOST_STEPS) {
                return Err(EditError::parameter(
                    "evolve",
                    "time",
                    t,
                    format!("0 to {} at this voxel size", largest * MOST_STEPS),
                ));
            }
            let steps = (t / largest).ceil();
            (steps as u32, if steps > 0.0 { t / steps } else { 0.0 })
        }
    };
    let voxel_size = level_set.voxel_size() as f32;
    let mut tracker = Tracker::new(level_set, region, *solver, run);
    let task = run.task("evolving", u64::from(steps));
    let step = FlowStep { function, dt: dt as f32, voxel_size };
    let mut report = Report {
        steps: 0,
        time: 0.0,
        voxels: tracker.moving_voxels(),
        stopped: if matches!(until, Until::Time(_)) { StopReason::Time } else { StopReason::Iterations },
    };
    for n in 0..steps {
        if report.voxels == 0 {
            report.stopped = StopReason::NothingLeft;
            break;
        }
        // Flows of curvature are first order in time: dt is bounded by stability, not by accuracy.
        tracker.integrate(&step, TimeIntegrator::TvdRk1, Target::Moving)?;
        tracker.track()?;
        report.steps = n + 1;
        report.time = f64::from(report.steps) * dt;
        report.voxels = tracker.moving_voxels();
        task.advance(1);
    }
    Ok(report)
}
