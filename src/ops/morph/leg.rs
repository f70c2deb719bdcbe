//! One leg of a morph: the flow from a shape to the next, and the states of it that are frames.

use super::distance::TargetDistance;
use super::{FrameSpacing, NAME, SpeedLaw};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LeafValues};
use crate::levelset::LevelSet;
use crate::pde::{LeafSurface, Moment, SurfaceSpeed, Tally, move_surface};
use crate::run::RunOptions;

/// Most steps of a leg.
const MOST_STEPS: u32 = 100_000;

/// Part of what is left that a step takes at most, f being linear: a longer one would overshoot.
const RELAXATION: f64 = 0.5;

/// Steps without progress after which a flow rests, and what counts as progress, as a part of the RMS.
const PATIENCE: u32 = 40;
const PROGRESS: f64 = 0.002;

/// How near a frame comes to its place, as a part of the way between frames.
const TOLERANCE: f64 = 0.01;

/// Steps that look for the place of a frame at most: where the flow slows down they would become ever shorter.
const MOST_LANDING_STEPS: u32 = 8;

/// The speed that is rest, as a part of the RMS distance at which a flow ends, a unit of time.
const AT_REST: f64 = 0.25;

/// F = −f(b).
#[derive(Clone, Copy, Debug)]
pub(super) struct Law {
    pub kind: SpeedLaw,
    /// Largest speed, world units a unit of time.
    pub most: f64,
    /// Edge of a voxel.
    pub voxel_size: f64,
}

impl Law {
    /// f, monotone and odd.
    fn of(&self, b: f64) -> f64 {
        match self.kind {
            SpeedLaw::Linear => b,
            SpeedLaw::Clamped => b.clamp(-self.most, self.most),
            // Full speed from a voxel or so on.
            SpeedLaw::Constant => self.most * b / b.hypot(self.voxel_size),
        }
    }

    /// The largest f'.
    fn slope(&self) -> f64 {
        match self.kind {
            SpeedLaw::Linear | SpeedLaw::Clamped => 1.0,
            SpeedLaw::Constant => self.most / self.voxel_size,
        }
    }
}

/// The speed towards a target: F = −f(b(y)).
struct Towards<'a> {
    target: &'a TargetDistance,
    law: Law,
}

impl SurfaceSpeed for Towards<'_> {
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
        let target = self.target.around(leaf.origin);
        let mut tally = Tally::default();
        for foot in leaf.feet() {
            let b = target.at(foot.point);
            let f = self.law.of(b);
            speed.0[foot.offset] = -f as f32;
            if foot.beside {
                tally.count += 1.0;
                tally.squares += b * b;
                tally.fall += b * f;
            }
        }
        tally
    }
}

/// A flow towards a target.
pub(super) struct Leg<'a> {
    pub target: &'a TargetDistance,
    pub law: Law,
    /// β of the curvature prior, world units squared a unit of time.
    pub bending: f64,
    pub spacing: FrameSpacing,
    /// RMS distance from the target (world units) at which it has arrived.
    pub stop: f64,
}

/// Where a flow stands.
#[derive(Clone, Copy, Debug)]
pub(super) struct State {
    /// RMS distance from the target, world units.
    pub rms: f64,
    pub time: f64,
    pub steps: u32,
}

/// How a flow ended.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    pub state: State,
    /// Whether it came as near as was asked.
    pub arrived: bool,
}

/// What takes frames: the place in 0..1, the surface, where it stands.
pub(super) type Take<'a> = dyn FnMut(f64, LevelSet, State) -> Result<()> + 'a;

impl Leg<'_> {
    /// Its speed.
    pub fn towards(&self) -> impl SurfaceSpeed {
        Towards { target: self.target, law: self.law }
    }

    /// RMS distance of a surface from the target, world units.
    pub fn rms(&self, start: &LevelSet, run: &RunOptions) -> Result<f64> {
        let mut rms = 0.0;
        let mut control = |moment: &Moment| {
            rms = moment.tally.rms();
            None
        };
        move_surface(&mut start.clone(), &self.towards(), 0.0, 0.0, 1, &mut control, run)?;
        Ok(rms)
    }

    /// Flows from `start` and hands over the frames at `places` between 0 and 1, in ascending order; `arrives` says to go on to the target.
    pub fn flow(
        &self,
        start: &LevelSet,
        places: &[f64],
        arrives: bool,
        take: &mut Take,
        run: &RunOptions,
    ) -> Result<Arrival> {
        // By time it flows twice, since the time of arrival is not known before. States kept on the way, for the frames to be chosen from at the end, would have to lie
        // within a hundredth of the way between frames: a hundred states in memory or on disk for each frame.
        let end = match self.spacing {
            FrameSpacing::Time if !places.is_empty() => {
                self.steps(start, &[], true, &mut |_, _, _| Ok(()), 0.0, run)?.state.time
            }
            _ => 0.0,
        };
        self.steps(start, places, arrives, take, end, run)
    }

    fn steps(
        &self,
        start: &LevelSet,
        places: &[f64],
        arrives: bool,
        take: &mut Take,
        end: f64,
        run: &RunOptions,
    ) -> Result<Arrival> {
        let transform = *start.transform();
        let of_grid = |grid: &Grid| LevelSet::new(grid.clone(), transform);
        let volume = |level_set: &LevelSet| level_set.measure(run).map(|m| m.volume);
        let by_volume = self.spacing == FrameSpacing::Volume && !places.is_empty();
        let volumes = match by_volume {
            true => [volume(start)?, volume(self.target.level_set())?],
            false => [0.0; 2],
        };
        let mut progress = Progress { best: f64::INFINITY, patience: PATIENCE };
        let mut state = State { rms: 0.0, time: 0.0, steps: 0 };
        let (mut first, mut next, mut arrived, mut landing) = (None, 0, false, 0);
        let mut before: Option<(f64, f64)> = None;
        let mut failure = None;
        let mut surface = start.clone();
        let mut control = |moment: &Moment| {
            let rms = moment.tally.rms();
            state = State { rms, time: moment.time, steps: moment.steps };
            let first = *first.get_or_insert(rms);
            let spacing = 1.0 / (places.len() as f64 + 1.0);
            let mut longest = RELAXATION / self.law.slope();
            // What is left of the way, from 1 to 0, and how fast it is gone.
            let (left, rate) = match self.spacing {
                FrameSpacing::Rms => {
                    let fall = moment.tally.fall / moment.tally.count.max(1.0) / rms.max(f64::MIN_POSITIVE);
                    (rms / first.max(f64::MIN_POSITIVE), fall / first.max(f64::MIN_POSITIVE))
                }
                FrameSpacing::Time => (1.0 - moment.time / end.max(f64::MIN_POSITIVE), 1.0 / end),
                FrameSpacing::Volume if by_volume => {
                    let now = match volume(&of_grid(moment.grid)) {
                        Ok(now) => now,
                        Err(error) => {
                            failure = Some(error);
                            return None;
                        }
                    };
                    let left = (volumes[1] - now) / (volumes[1] - volumes[0]);
                    let rate = before.map_or(0.0, |(time, left_then)| (left_then - left) / (moment.time - time));
                    before = Some((moment.time, left));
                    (left, rate)
                }
                FrameSpacing::Volume => (1.0, 0.0),
            };
            while let Some(&place) = places.get(next) {
                let ahead = left - (1.0 - place);
                if ahead > TOLERANCE * spacing && landing < MOST_LANDING_STEPS {
                    let wanted = ahead / rate;
                    if wanted > 0.0 && wanted < longest {
                        longest = wanted;
                        landing += 1;
                    }
                    break;
                }
                (next, landing) = (next + 1, 0);
                if let Err(error) = take(place, of_grid(moment.grid), state) {
                    failure = Some(error);
                    return None;
                }
            }
            if next == places.len() && (rms <= self.stop || !arrives) {
                arrived = rms <= self.stop;
                return None;
            }
            (landing > 0 || progress.goes_on(rms)).then_some(longest)
        };
        move_surface(&mut surface, &self.towards(), self.bending, AT_REST * self.stop, MOST_STEPS, &mut control, run)?;
        if let Some(error) = failure {
            return Err(error);
        }
        for &place in &places[next..] {
            take(place, surface.clone(), state)?;
        }
        Ok(Arrival { state, arrived })
    }
}

/// Whether the RMS still falls.
struct Progress {
    best: f64,
    patience: u32,
}

impl Progress {
    fn goes_on(&mut self, rms: f64) -> bool {
        if rms < self.best * (1.0 - PROGRESS) {
            (self.best, self.patience) = (rms, PATIENCE);
        }
        self.patience -= 1;
        self.patience > 0
    }
}

/// Frames by volume need two volumes.
pub(super) fn check_volumes(from: f64, to: f64) -> Result<()> {
    if (from - to).abs() > 1e-3 * from.max(to) {
        return Ok(());
    }
    let accepted = "`rms` or `time`: these two shapes have the same volume";
    Err(EditError::parameter(NAME, "frame_spacing", "volume", accepted))
}
