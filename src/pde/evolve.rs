//! The time loop.

use super::rest::Watch;
use super::speed::{FlowStep, SpeedFunction};
use super::step::Target;
use super::{SolverOptions, TimeIntegrator, Tracker};
use crate::awake::awake;
use crate::error::{EditError, Result};
use crate::grid::{Grid, LeafValues};
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
    /// When a step moves next to nothing, and after so many steps at the latest: where a limit is approached, ever more slowly.
    Rest(u32),
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
    /// Nothing moves any more, or next to nothing where that was asked for.
    AtRest,
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

/// What the time loop drives.
pub(super) trait Motion {
    /// Looks at the field and returns the next time step, at most `left`; `None` if nothing moves any more.
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64>;

    /// Moves the surface by that time step.
    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()>;

    /// Lets voxels move again that it had left out, when none is left that moves. Says whether there were any.
    fn wake(&mut self, _: &mut Tracker) -> bool {
        false
    }
}

/// The time loop: steps and tracks until it is time to stop.
pub(super) fn drive(tracker: &mut Tracker, motion: &mut impl Motion, until: Until) -> Result<Report> {
    let (most, end) = match until {
        Until::Iterations(n) | Until::Rest(n) => (n, f64::INFINITY),
        Until::Time(t) if t >= 0.0 && t.is_finite() => (u32::MAX, t),
        Until::Time(t) => return Err(EditError::parameter("evolve", "time", t, "0 or more")),
    };
    let run = tracker.run;
    let mut task = None;
    let mut report = Report {
        steps: 0,
        time: 0.0,
        voxels: tracker.moving_voxels(),
        stopped: if end.is_finite() { StopReason::Time } else { StopReason::Iterations },
    };
    while report.steps < most && report.time < end {
        if report.voxels == 0 && motion.wake(tracker) {
            report.voxels = tracker.moving_voxels();
        }
        if report.voxels == 0 {
            report.stopped = StopReason::NothingLeft;
            break;
        }
        let left = end - report.time;
        let Some(dt) = motion.prepare(tracker, left) else {
            report.stopped = StopReason::AtRest;
            break;
        };
        if end.is_finite() && left / dt > MOST_STEPS {
            let accepted = format!("0 to {} at this voxel size", dt * MOST_STEPS);
            return Err(EditError::parameter("evolve", "time", end, accepted));
        }
        let steps_left = if end.is_finite() { (left / dt).ceil() as u32 } else { most - report.steps };
        let task = task.get_or_insert_with(|| run.task("evolving", u64::from(steps_left)));
        awake(|| motion.step(tracker, dt).and_then(|()| tracker.track()))?;
        report.steps += 1;
        // Not the sum of the steps, which rounding may leave short of the end.
        report.time = if dt == left { end } else { report.time + dt };
        report.voxels = tracker.moving_voxels();
        task.advance(1);
    }
    Ok(report)
}

/// Moves a surface by φ_t = −F|∇φ|, everywhere or weighted by a region, tracking the band after each step.
pub fn evolve(
    level_set: &mut LevelSet,
    function: &impl SpeedFunction,
    region: Option<&dyn Region>,
    until: Until,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    let voxel_size = level_set.voxel_size();
    let start = region.filter(|_| function.needs_hold()).map(|_| level_set.grid().clone());
    let rest = watch(level_set, until, run)?;
    let mut tracker = Tracker::new(level_set, region, *solver, run);
    drive(&mut tracker, &mut Flow { function, voxel_size, start, rest }, until)
}

/// What watches for rest, if the flow goes on until then.
pub(super) fn watch(level_set: &LevelSet, until: Until, run: &RunOptions) -> Result<Option<Watch>> {
    if !matches!(until, Until::Rest(_)) {
        return Ok(None);
    }
    let bytes = level_set.grid().leaves().len() as u64 * size_of::<LeafValues>() as u64;
    run.reserve("evolve", bytes, "a region or a coarser grid needs less")?;
    Ok(Some(Watch::new(level_set.grid())))
}

/// Part of a step by which a time may exceed a whole number of steps without one more.
pub(super) const WHOLE_STEPS: f64 = 1e-9;

/// The motion that a speed function describes.
struct Flow<'a, F> {
    function: &'a F,
    voxel_size: f64,
    /// The field before, if the flow is held at the rim of its region.
    start: Option<Grid>,
    /// What watches for rest, if it goes on until then.
    rest: Option<Watch>,
}

impl<F: SpeedFunction> Motion for Flow<'_, F> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        if self.rest.as_mut().is_some_and(|watch| watch.is_rest(tracker)) {
            return None;
        }
        let largest = self.function.largest_step(self.voxel_size);
        if left.is_infinite() {
            return Some(largest);
        }
        // Equal parts of the time, as few as may be. Rounding of the sum of steps must not make it one more.
        Some(left / (left / largest - WHOLE_STEPS).ceil().max(1.0))
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        let step = FlowStep { function: self.function, dt: dt as f32, voxel_size: self.voxel_size as f32 };
        // Flows of curvature are first order in time: dt is bounded by stability, not by accuracy.
        tracker.integrate(&step, TimeIntegrator::TvdRk1, Target::Moving)?;
        if let Some(start) = &self.start {
            tracker.hold(start);
        }
        if let Some(watch) = &mut self.rest {
            watch.stepped(tracker, dt);
        }
        Ok(())
    }
}
