//! Attraction: a surface is drawn to points, curves, meshes or solids, or pushed from them (Museth et al. 2002, equation 10).
//!
//! > φ_t = −F|∇φ|,  F = C(γ)·φ(p),  γ = sign(φ(p)) n·u
//!
//! For a point y of the surface, p is the point of the target closest to y, u the direction from y to p and n the outward normal. A
//! target outside (φ(p) > 0) draws the surface outwards, one inside draws it inwards; the gap closes as e^(−t). Beyond the band φ(p) is
//! ±background and the surface comes nearer at a constant speed. F is constant along normals: it is evaluated at the surface
//! point y closest to each voxel, since at a voxel on the target u would not be defined, and behind it it would turn round.
//!
//! C rises from 0 to 1 between two cosines, so that only what faces the target moves: a target at height d above a plane draws a
//! disc of radius d·tan(arccos γ). Near the target that disc shrinks to a voxel, and a single point would never be reached. So within
//! a few voxels of the target (`tip`), or five sixths of its distance from the surface at the start if that is more, all is drawn that does not face away
//! by more than a third of a right angle: the limits fall to −0.4 and 0.1. What is drawn has thus the same shape from far as from near, and a tip
//! that the voxels show: the flanks of a cone, whose cosine is 0, widen while it grows.
//!
//! On an edge or a sharp bump hardly a voxel faces a target by the limits, and what grows from a single voxel is too thin to hold. So around the surface point
//! closest to a target, now, all is drawn that faces it at all and lies within two and a half voxels of the way between the two, or 0.4 of that way if this is more.
//!
//! F depends on the normal. So where C rises, changes of the normal travel along the surface, with the speed of the Hamiltonian F(n)|∇φ|,
//!
//! > ∂(F|∇φ|)/∂∇φ = F n + C'(γ)|φ(p)| (u − (u·n) n),
//!
//! towards the target, and ten times faster than the surface moves. Steps too long for that, and central normals, break up flanks into pits: n is read
//! a little upwind, and an Euler step lasts no longer than 0.4 voxels of that travel. |∇φ| is Godunov's of the first order. The band is tracked
//! after half a voxel of motion, and what renormalisation then changes next to the surface is taken back: it wears down tips.
//!
//! Whatever faces a target would be drawn, at any distance, the other side of a solid among it. So γ is also bounded by what it would be if the
//! surface closest to p were a plane, d(p)/|p − y| with d the distance of p from the surface at the start.
//!
//! The tip of a cone and the rim of a fin lose up to half a voxel when the finished surface becomes polygons. So once the flow rests the target is aimed at beyond
//! itself by what is missing, and it goes on, up to five times. Single points, rings of points and closed curves 3 to 25 voxels off a plane, at any place between
//! the voxels, end within 0.15 voxel of the surface, in one piece. Parts that break off all the same are taken away and counted.
//!
//! Pushed surfaces move by −F, faster and faster: a largest depth, measured from where the surface was, or a time ends it. All that faces the target is
//! pushed, at any distance: a region holds what is to stay.

mod motion;
mod pull;
#[cfg(test)]
mod tests;

use glam::{DVec3, IVec3};
use rustc_hash::FxHashSet;

use self::motion::Drawing;
pub use self::pull::Pull;
use super::evolve::{Report, StopReason, Until, drive};
use super::{CutOff, SolverOptions, Tracker, UpwindScheme};
use crate::error::Result;
use crate::grid::{LEAF_DIM, LEAF_VOXELS, LeafId, offset_to_local};
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild, with_half_width};
use crate::run::RunOptions;

const OPERATION: &str = "attraction";

/// What draws a surface.
pub trait Attractor: Sync {
    /// The point of it closest to a point and not farther away than `within`, all in index space of the level set.
    fn closest(&self, ijk: DVec3, within: f64) -> Option<DVec3>;
}

/// How a surface is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attraction {
    /// C of the cosine γ.
    pub cut_off: CutOff,
    /// Distance from the target, in voxels, within which all that does not face away is drawn, fully within half of it; five sixths of the target's
    /// distance from the surface at the start if that is more. 0 for the limits alone.
    pub tip: f64,
    /// Away from the target instead of towards it.
    pub repel: bool,
    /// Largest distance, in voxels, that pushed surfaces go.
    pub max_depth: Option<f64>,
}

impl Attraction {
    /// The cosines of the paper (table 4, teapot embossing) between which C rises.
    pub const LIMITS: [f64; 2] = [0.8, 0.9];
    /// The least distance, rounded up, with which a single point is reached.
    pub const TIP: f64 = 5.0;
}

impl Default for Attraction {
    fn default() -> Self {
        let cut_off = CutOff::NONE.with_low(Self::LIMITS).unwrap_or_default();
        Self { cut_off, tip: Self::TIP, repel: false, max_depth: None }
    }
}

/// What a flow of attraction did.
#[derive(Clone, Debug, PartialEq)]
pub struct AttractionReport {
    /// The flow.
    pub flow: Report,
    /// Largest |φ(p)| in voxels, at most the half width, of targets that still draw; 0 if none does.
    pub gap: f64,
    /// Whether it ended because nothing comes nearer any more although something is still drawn.
    pub stalled: bool,
    /// Origins of the leaves in which the surface moved.
    pub moved: FxHashSet<IVec3>,
    /// Parts that broke off what was drawn and were taken away.
    pub specks: u64,
}

/// A target nearer than this, in voxels, is reached.
pub const REACHED: f64 = 0.25;

/// Least half width, in voxels, of the band it works on: φ(p) is a distance within it.
const BAND: f32 = 7.0;

/// How the band is tracked: distances of the first order would round edges in the leaves around what moves.
const SOLVER: SolverOptions = SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

/// A box in index space.
pub type IndexBounds = (DVec3, DVec3);

/// Moves a level set by `pull`, within a box (that of [`Pull::drawn_within`]), until every point that draws is reached
/// (well within [`REACHED`]), nothing comes nearer, or `until`. The time unit is that in which a gap falls to 1/e.
///
/// The whole band is rebuilt if anything moves; the report says in which leaves something did.
pub fn attract(
    level_set: &mut LevelSet,
    pull: &Pull,
    within: IndexBounds,
    until: Until,
    run: &RunOptions,
) -> Result<AttractionReport> {
    let half_width = level_set.half_width();
    // Depths are measured in the field as it was.
    let original = match pull.how.max_depth {
        Some(depth) => Some(with_half_width(level_set, half_width.max(depth as f32 + 2.0), run)?),
        None => None,
    };
    let mut wide = with_half_width(level_set, half_width.max(BAND), run)?;
    let start = wide.clone();
    let mut drawing = Drawing::new(pull, original, start.clone(), within);
    let mut report: Option<Report> = None;
    let mut specks = 0;
    for round in 0..=CORRECTIONS {
        let mut tracker = Tracker::new(&mut wide, None, SOLVER, run);
        let flow = drive(&mut tracker, &mut drawing, left(until, report.as_ref()))?;
        drawing.anchor(&mut tracker);
        let moved = flow.steps > 0;
        report = Some(match report {
            None => flow,
            Some(before) => Report { steps: before.steps + flow.steps, time: before.time + flow.time, ..flow },
        });
        if !moved {
            break;
        }
        let (whole, broken) = without_specks(&wide, &start, run)?;
        *level_set = rebuild(&whole, &Rebuild::band(half_width), run)?;
        specks = broken;
        let at_rest = !matches!(until, Until::Time(_)) && !pull.how.repel;
        if !at_rest || round == CORRECTIONS || !drawing.aim_beyond(level_set) {
            break;
        }
    }
    let flow = report.unwrap_or(Report { steps: 0, time: 0.0, voxels: 0, stopped: StopReason::AtRest });
    Ok(drawing.report(flow, specks))
}

/// How often a flow goes on, aiming beyond what its finished surface misses.
const CORRECTIONS: u32 = 5;

/// What is left of the steps.
fn left(until: Until, done: Option<&Report>) -> Until {
    let done = done.map_or(0, |done| done.steps);
    match until {
        Until::Iterations(n) => Until::Iterations(n.saturating_sub(done)),
        Until::Rest(n) => Until::Rest(n.saturating_sub(done)),
        Until::Time(_) => until,
    }
}

/// A level set without the parts that have nothing of what was inside at the start, and their number.
fn without_specks(level_set: &LevelSet, start: &LevelSet, run: &RunOptions) -> Result<(LevelSet, u64)> {
    let parts = level_set.components(run)?;
    if parts.voxels().len() < 2 {
        return Ok((level_set.clone(), 0));
    }
    let (grid, before) = (level_set.grid(), start.grid());
    let inside = |id: LeafId| {
        let origin = grid.origin(id);
        let values = (&grid.values(id).0, &before.values(before.find(origin)).0);
        let both = move |at: &usize| values.0[*at] < 0.0 && values.1[*at] < 0.0;
        (0..LEAF_VOXELS)
            .filter(both)
            .filter_map(|at| parts.at(origin + offset_to_local(at)))
            .collect::<FxHashSet<u32>>()
    };
    let whole: FxHashSet<u32> = grid.map_leaves(inside).into_iter().flatten().collect();
    let is_speck = |ijk: IVec3| parts.at(ijk).is_some_and(|part| !whole.contains(&part));
    let background = level_set.background();
    let mut left = level_set.clone();
    left.grid_mut().update_all(|id, values, mask| {
        let inside: Vec<usize> = (0..LEAF_VOXELS).filter(|at| values.0[*at] < 0.0).collect();
        for at in inside.into_iter().filter(|at| is_speck(grid.origin(id) + offset_to_local(*at))) {
            values.0[at] = background;
            mask.set(at, false);
        }
    });
    left.grid_mut().flood_signs();
    Ok((left, parts.voxels().len() as u64 - whole.len() as u64))
}

/// The origins of a leaf and of the 26 around it.
pub fn leaves_around(origin: IVec3) -> impl Iterator<Item = IVec3> {
    (0..27).map(move |n| origin + IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1) * LEAF_DIM)
}
