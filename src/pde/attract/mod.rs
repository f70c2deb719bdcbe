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
//! a few voxels of the target (`tip`) everything that does not face away is drawn: the limits fall to 0 and 0.5.
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
//! A curve or point many voxels away draws a fin or a spine that ends thinner than a voxel: its rim is ragged, and specks may break off.
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
use super::evolve::{Report, Until, drive};
use super::{CutOff, SolverOptions, Tracker, UpwindScheme};
use crate::error::Result;
use crate::grid::LEAF_DIM;
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
    /// Distance from the target, in voxels, within which all that does not face away is drawn, fully within half of it. 0 for the
    /// limits alone.
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
    let mut drawing = Drawing::new(pull, original, wide.clone(), within);
    let mut tracker = Tracker::new(&mut wide, None, SOLVER, run);
    let flow = drive(&mut tracker, &mut drawing, until)?;
    drawing.anchor(&mut tracker);
    if flow.steps > 0 {
        *level_set = rebuild(&wide, &Rebuild::band(half_width), run)?;
    }
    Ok(drawing.report(flow))
}

/// The origins of a leaf and of the 26 around it.
pub fn leaves_around(origin: IVec3) -> impl Iterator<Item = IVec3> {
    (0..27).map(move |n| origin + IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1) * LEAF_DIM)
}
