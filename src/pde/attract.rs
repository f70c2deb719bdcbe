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
//! Pushed surfaces move by −F, faster and faster: a largest depth, measured from where the surface was, or a time ends it. All that faces the target is
//! pushed, at any distance: a region holds what is to stay.

use fearless_simd::{Simd, SimdBase};
use glam::{DVec3, IVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rustc_hash::{FxHashMap, FxHashSet};

use super::curvature_flow::upwind_gradient;
use super::evolve::{Motion, Report, Until, drive};
use super::{CutOff, SolverOptions, Tracker, UpwindScheme};
use crate::error::{EditError, Result};
use crate::grid::{
    Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafValues, leaf_offset, leaf_origin, offset_to_local,
};
use crate::levelset::{LevelSet, Sampler};
use crate::mesh::{Rebuild, rebuild, with_half_width};
use crate::region::{Region, ramp_between};
use crate::run::RunOptions;
use crate::stencil::FaceHalo;
use crate::stencil::simd::{Lanes, Work, dispatch};

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

/// Gap in voxels up to which it goes on: where the band is rebuilt, tips are cut by up to an eighth of a voxel.
const CLOSED: f64 = REACHED / 4.0;

/// Motion of the surface in a step, in voxels.
const COURANT: f64 = 0.5;

/// Travel of what changes the normal in a step, in voxels.
const TRAVEL: f64 = 0.4;

/// Most parts of a step.
const MOST_PARTS: f64 = 16.0;

/// Half the width, as a cosine, of the window over which C's slope is taken: as much as neighbouring normals differ.
const WINDOW: f64 = 0.05;

/// How far upwind normals are read, in voxels, and the sine of the angle between n and u from which on: towards the target there is no upwind.
const UPWIND: f64 = 0.25;
const ASKEW: f64 = 0.1;

/// Longest step where a time was asked for: a step closes its part of the gap, and a twentieth keeps that within 3 % of e^(−t).
const LONGEST_TIMED: f64 = 0.05;

/// Longest step where only the end matters.
const LONGEST_STEP: f64 = 0.5;

/// Least half width, in voxels, of the band it works on: φ(p) is a distance within it.
const BAND: f32 = 7.0;

/// How the band is tracked: distances of the first order would round edges in the leaves around what moves.
const SOLVER: SolverOptions = SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

/// Voxels within so many voxels of the surface are asked what they feel; those beyond take it from the voxel next to their foot point, which is one.
const FELT: f64 = 1.5;

/// Voxels nearer to the surface than this keep the values of a step, in voxels.
const NEXT: f32 = 0.75;

/// The cosine from which on a surface within the tip is drawn fully.
const SIDEWAYS: f64 = 0.5;

/// Voxels with less of the pull do not tell whether all that draws is reached: the rim of a region would never be.
const DRAWN: f32 = 0.5;

/// Steps without progress after which a flow is at rest.
const PATIENCE: u32 = 8;

/// What counts as progress, in voxels: a fall of the largest gap, or of the mean distance of what is drawn from its targets.
const PROGRESS: f64 = 0.01;

/// The closest surface point of a target is told by the foot points of voxels, which are no farther from it than this, in voxels.
const FOOTING: f64 = 0.5;

/// Voxels around what is drawn and what draws it that may change as well.
const MARGIN: f64 = 6.0;

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
    let mut drawing = Drawing {
        pull,
        original,
        start: wide.clone(),
        within,
        drawn: None,
        rates: Speeds::default(),
        leaves: FxHashSet::default(),
        moved: FxHashMap::default(),
        gap: 0.0,
        least: [f64::INFINITY; 2],
        patience: PATIENCE,
        substep: f64::INFINITY,
        stepped: None,
    };
    let mut tracker = Tracker::new(&mut wide, None, SOLVER, run);
    let flow = drive(&mut tracker, &mut drawing, until)?;
    drawing.anchor(&mut tracker);
    if flow.steps > 0 {
        *level_set = rebuild(&wide, &Rebuild::band(half_width), run)?;
    }
    let Drawing { gap, patience, leaves, .. } = drawing;
    Ok(AttractionReport { flow, gap, stalled: patience == 0, moved: leaves })
}

/// The origins of a leaf and of the 26 around it.
pub fn leaves_around(origin: IVec3) -> impl Iterator<Item = IVec3> {
    (0..27).map(move |n| origin + IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1) * LEAF_DIM)
}

/// What a voxel feels.
struct Felt {
    /// F, world units a unit of time.
    speed: f64,
    /// C.
    share: f64,
    /// Speed, in voxels a unit of time, at which changes of the normal travel along the surface.
    travel: f64,
    /// |φ(p)| in voxels, or how far a pushed surface still goes.
    gap: f64,
    /// From the surface to the target, in voxels.
    distance: f64,
    /// The target.
    point: DVec3,
}

/// The force on a surface.
pub struct Pull<'a> {
    target: &'a dyn Attractor,
    how: &'a Attraction,
    region: Option<&'a dyn Region>,
    /// Points of the surface as it was, where the region lets it move.
    before: ImmutableKdTree<f64, 3>,
}

impl<'a> Pull<'a> {
    /// The force on a level set, where `region` lets it move; `None` if that is nowhere.
    pub fn new(
        level_set: &LevelSet,
        target: &'a dyn Attractor,
        how: &'a Attraction,
        region: Option<&'a dyn Region>,
        run: &RunOptions,
    ) -> Result<Option<Self>> {
        let feet = beside_surface(level_set, region, run, |feet: &mut Vec<[f64; 3]>, sampler, ijk| {
            feet.extend(foot(sampler, level_set.voxel_size(), ijk).map(|(foot, _)| foot.to_array()));
        })?;
        let feet: Vec<[f64; 3]> = feet.concat();
        if feet.is_empty() {
            return Ok(None);
        }
        let before = ImmutableKdTree::new_from_slice(&feet).map_err(|e| {
            EditError::parameter(
                OPERATION,
                "region",
                format!("{} voxels", feet.len()),
                format!("a smaller part of the surface: {e}"),
            )
        })?;
        Ok(Some(Self { target, how, region, before }))
    }

    /// A box around what is drawn and what draws it, with a margin; `None` if nothing is drawn.
    pub fn drawn_within(&self, level_set: &LevelSet, run: &RunOptions) -> Result<Option<IndexBounds>> {
        let voxel_size = level_set.voxel_size();
        let boxes = beside_surface(level_set, self.region, run, |drawn: &mut Drawn, sampler, ijk| {
            // At the start nothing has been pushed: no depth counts yet.
            let Some(felt) = self.at(sampler, None, voxel_size, ijk, drawn.near) else { return };
            drawn.near = Some(felt.point);
            if felt.share > 0.0 && (self.how.repel || felt.gap >= REACHED) {
                let (a, b) = (ijk.as_dvec3().min(felt.point), ijk.as_dvec3().max(felt.point));
                drawn.bounds = Some(drawn.bounds.map_or((a, b), |(lo, hi)| (lo.min(a), hi.max(b))));
            }
        })?;
        let bounds = boxes.into_iter().filter_map(|drawn| drawn.bounds).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        Ok(bounds.map(|(lo, hi)| (lo - MARGIN, hi + MARGIN)))
    }

    /// Part of what faces a target at `distance` that is near enough to it, if the surface is now `gap` away from it.
    fn reach(&self, point: DVec3, distance: f64, gap: f64) -> f64 {
        // Feet of voxels stand for the surface between them.
        let weight = |nearest: f64| self.how.cut_off.weight((nearest + FOOTING) / distance.max(FOOTING));
        // What is drawn has come nearer since the start. What is pushed goes away: its distance says nothing.
        if self.how.repel || weight(gap) >= 1.0 {
            return 1.0;
        }
        let nearest =
            self.before.query(&point.to_array()).nearest_one::<SquaredEuclidean<f64>>().execute().distance.sqrt();
        weight(nearest)
    }

    /// What the voxel at `ijk` feels; `None` where the field has no normal, or without a target. `near` is a point of the target, the nearer the
    /// better: it bounds the search. Depths are measured in the field `original`.
    fn at(
        &self,
        sampler: &mut Sampler,
        original: Option<&LevelSet>,
        voxel_size: f64,
        ijk: IVec3,
        near: Option<DVec3>,
    ) -> Option<Felt> {
        let (foot, normal) = foot(sampler, voxel_size, ijk)?;
        // Wide enough for the rounding of a point that is found again.
        let within = near.map_or(f64::INFINITY, |near| near.distance(foot) * (1.0 + 1e-9) + 1e-9);
        let point = self.target.closest(foot, within)?;
        let (to, phi) = (point - foot, f64::from(sampler.trilinear(point)));
        let distance = to.length();
        let towards = if distance > 1e-6 { to / distance * phi.signum() } else { normal };
        let tip = self.how.tip;
        let close = if tip > 0.0 { 1.0 - ramp_between(distance, tip / 2.0, tip) } else { 0.0 };
        let mut cosine = normal.dot(towards);
        let mut gap = phi.abs() / voxel_size;
        let faces = self.how.cut_off.weight(cosine + WINDOW) > 0.0;
        let reach = if faces && close < 1.0 { self.reach(point, distance, gap) } else { 1.0 };
        let share =
            |cosine: f64| (reach * self.how.cut_off.weight(cosine)).max(close * ramp_between(cosine, 0.0, SIDEWAYS));
        let slope = (share(cosine + WINDOW) - share(cosine - WINDOW)) / (2.0 * WINDOW);
        let aside = towards - normal * cosine;
        let travel = slope * gap * aside.length();
        if travel > 0.0 {
            // What draws has its upwind away from the target, what pushes towards it.
            let upwind = if self.how.repel { UPWIND } else { -UPWIND };
            let there = foot + aside * (phi.signum() * upwind / aside.length().max(ASKEW));
            cosine = sampler.smooth_gradient(there).try_normalize()?.dot(towards);
        }
        let mut share = share(cosine);
        let mut speed = phi;
        if self.how.repel {
            speed = -phi;
            if let (Some(depth), Some(original)) = (self.how.max_depth, original) {
                let gone = f64::from(original.sampler().trilinear(foot)).abs() / voxel_size;
                gap = (depth - gone).max(0.0);
                // In the last voxel the rest of the way closes like a gap, and no faster than the step allows.
                let rest = gap * voxel_size;
                speed = speed.signum() * speed.abs().max(voxel_size).min(rest);
            }
            // The target that is touched pushes nowhere.
            if phi == 0.0 {
                share = 0.0;
            }
        }
        Some(Felt { speed: share * speed, share, travel, gap, distance, point })
    }
}

/// The surface point closest to a voxel, and the outward normal there.
fn foot(sampler: &mut Sampler, voxel_size: f64, ijk: IVec3) -> Option<(DVec3, DVec3)> {
    let phi = f64::from(sampler.voxel(ijk)) / voxel_size;
    let mut foot = ijk.as_dvec3() - sampler.voxel_gradient(ijk).try_normalize()? * phi;
    // There the stencil lies within the band: once more for what the first step missed.
    let gradient = sampler.smooth_gradient(foot);
    let squared = gradient.length_squared();
    if squared < 1e-2 {
        return None;
    }
    let rest = f64::from(sampler.trilinear(foot)) / voxel_size;
    foot -= gradient * (rest / squared).clamp(-1.0, 1.0);
    Some((foot, gradient / squared.sqrt()))
}

/// The part of a leaf that is drawn.
#[derive(Default)]
struct Drawn {
    bounds: Option<IndexBounds>,
    /// The target of the voxel before.
    near: Option<DVec3>,
}

/// What `f` gathers, leaf by leaf, of the voxels beside the surface that `region` lets move; these stand for the others on their normals.
fn beside_surface<T: Default + Send>(
    level_set: &LevelSet,
    region: Option<&dyn Region>,
    run: &RunOptions,
    f: impl Fn(&mut T, &mut Sampler, IVec3) + Sync,
) -> Result<Vec<T>> {
    let (grid, transform, voxel_size) = (level_set.grid(), level_set.transform(), level_set.voxel_size());
    let half = (f64::from(LEAF_DIM) - 1.0) / 2.0;
    let found = grid.map_leaves(|id| {
        let (origin, values, mut found) = (grid.origin(id), grid.values(id), T::default());
        let centre = transform.index_to_world(origin.as_dvec3() + half);
        let reached = region.is_none_or(|r| r.weights_within(centre, half * 3f64.sqrt() * voxel_size)[1] > 0.0);
        if !reached || run.is_cancelled() {
            return found;
        }
        let mut sampler = level_set.sampler();
        for offset in grid.mask(id).iter() {
            let ijk = origin + offset_to_local(offset);
            if f64::from(values.0[offset].abs()) <= voxel_size
                && region.is_none_or(|r| r.weight(transform.voxel_to_world(ijk)) > 0.0)
            {
                f(&mut found, &mut sampler, ijk);
            }
        }
        found
    });
    run.check(OPERATION)?;
    Ok(found)
}

/// A number a voxel of leaves, by the leaves' index; none where nothing is drawn.
type Speeds = FxHashMap<usize, Box<LeafValues>>;

/// What the voxels of a leaf feel.
#[derive(Default)]
struct LeafFelt {
    speeds: Option<Box<LeafValues>>,
    fastest: f64,
    travel: f64,
    gap: f64,
    /// Sum over the voxels that are drawn, of what they have still to go if they are pushed, and their number.
    distance: f64,
    count: f64,
}

/// What all voxels feel: the largest of each, the mean distance.
struct Felts {
    fastest: f64,
    travel: f64,
    gap: f64,
    distance: f64,
}

/// The motion towards the target.
struct Drawing<'a> {
    pull: &'a Pull<'a>,
    original: Option<LevelSet>,
    /// The field at the start, in the wide band.
    start: LevelSet,
    within: IndexBounds,
    /// Origins of the leaves that were drawn in the last step, and those around them: what lies elsewhere has not moved, and so is not drawn
    /// now. None at first.
    drawn: Option<FxHashSet<IVec3>>,
    /// F|∇φ|.
    rates: Speeds,
    /// Origins of the leaves whose surface has moved.
    leaves: FxHashSet<IVec3>,
    /// Origins of leaves, and the voxels of the band in them that have moved.
    moved: FxHashMap<IVec3, LeafMask>,
    gap: f64,
    /// Largest gap and mean distance from the targets at the last progress, and the steps left to make some.
    least: [f64; 2],
    patience: u32,
    /// Longest Euler step.
    substep: f64,
    /// The field after the last step, before it was tracked.
    stepped: Option<Grid>,
}

impl Drawing<'_> {
    /// What the voxels beside the surface feel.
    fn feel(&self, grid: &Grid, id: LeafId) -> LeafFelt {
        let (transform, voxel_size) = (self.start.transform(), self.start.voxel_size());
        let (origin, values) = (grid.origin(id), grid.values(id));
        let mut felt = LeafFelt::default();
        let (lo, hi) = self.within;
        let last = origin + (LEAF_DIM - 1);
        let apart = last.as_dvec3().cmplt(lo).any() || origin.as_dvec3().cmpgt(hi).any();
        if apart || self.drawn.as_ref().is_some_and(|drawn| !drawn.contains(&origin)) {
            return felt;
        }
        let mut sampler = Sampler::new(grid, voxel_size);
        let mut near = None;
        for offset in grid.mask(id).iter() {
            if f64::from(values.0[offset].abs()) > FELT * voxel_size {
                continue;
            }
            let ijk = origin + offset_to_local(offset);
            if ijk.as_dvec3().cmplt(lo).any() || ijk.as_dvec3().cmpgt(hi).any() {
                continue;
            }
            let alpha = self.pull.region.map_or(1.0, |region| f64::from(region.weight(transform.voxel_to_world(ijk))));
            if alpha <= 0.0 {
                continue;
            }
            let Some(voxel) = self.pull.at(&mut sampler, self.original.as_ref(), voxel_size, ijk, near) else {
                continue;
            };
            near = Some(voxel.point);
            // What is about to be drawn limits the step as well.
            felt.travel = felt.travel.max(voxel.travel * alpha);
            let speed = voxel.speed * alpha;
            if speed == 0.0 {
                continue;
            }
            felt.speeds.get_or_insert_default().0[offset] = speed as f32;
            felt.fastest = felt.fastest.max(speed.abs());
            if voxel.share * alpha >= f64::from(DRAWN) {
                felt.gap = felt.gap.max(voxel.gap);
                felt.distance += if self.pull.how.repel { voxel.gap } else { voxel.distance };
                felt.count += 1.0;
            }
        }
        felt
    }

    /// Takes back what tracking the band did beside the surface, where renormalisation wears down tips and what nothing draws: voxels that have never moved
    /// get the values that they had at the start, the others, next to the surface, those of the last step.
    fn anchor(&self, tracker: &mut Tracker) {
        let (Some(stepped), Some(drawn)) = (&self.stepped, &self.drawn) else { return };
        let voxel_size = self.start.voxel_size() as f32;
        let (start, felt, next) = (self.start.grid(), FELT as f32 * voxel_size, NEXT * voxel_size);
        let grid = &mut *tracker.grid;
        let origins: FxHashMap<usize, IVec3> = grid.leaves().iter().map(|id| (id.index(), grid.origin(*id))).collect();
        let leaves = grid.leaves().iter().copied().filter(|id| drawn.contains(&origins[&id.index()])).collect();
        grid.update(&leaves, |id, values, _| {
            let Some(origin) = origins.get(&id.index()) else { return };
            let moved = self.moved.get(origin).copied().unwrap_or(LeafMask::EMPTY);
            let (start, stepped) = (start.values(start.find(*origin)), stepped.values(stepped.find(*origin)));
            for (at, value) in values.0.iter_mut().enumerate() {
                let (old, reach) = if moved.get(at) { (stepped.0[at], next) } else { (start.0[at], felt) };
                if old.abs() < reach {
                    *value = old;
                }
            }
        });
    }

    /// F of the voxels of a leaf that lie farther from the surface.
    fn continued(&self, grid: &Grid, id: LeafId, near: &Speeds) -> Option<Box<LeafValues>> {
        let voxel_size = self.start.voxel_size();
        let mut sampler = Sampler::new(grid, voxel_size);
        let mut speeds = near.get(&id.index()).cloned();
        for offset in grid.mask(id).iter() {
            let phi = f64::from(grid.values(id).0[offset]) / voxel_size;
            if phi.abs() <= FELT {
                continue;
            }
            let ijk = grid.origin(id) + offset_to_local(offset);
            let Some(normal) = sampler.voxel_gradient(ijk).try_normalize() else { continue };
            let foot = (ijk.as_dvec3() - normal * phi).round().as_ivec3();
            if let Some(there) = near.get(&grid.find(leaf_origin(foot)).index()) {
                let speed = there.0[leaf_offset(foot)];
                if speed != 0.0 {
                    speeds.get_or_insert_default().0[offset] = speed;
                }
            }
        }
        speeds
    }
}

impl Drawing<'_> {
    /// Finds what every voxel feels.
    fn look(&mut self, grid: &Grid) -> Felts {
        let felt = grid.map_leaves(|id| self.feel(grid, id));
        let most = |of: fn(&LeafFelt) -> f64| felt.iter().map(of).fold(0.0, f64::max);
        let count: f64 = felt.iter().map(|f| f.count).sum();
        let felts = Felts {
            fastest: most(|f| f.fastest),
            travel: most(|f| f.travel),
            gap: most(|f| f.gap),
            distance: felt.iter().map(|f| f.distance).sum::<f64>() / count.max(1.0),
        };
        let by_leaf = |speeds: Vec<Option<Box<LeafValues>>>| -> Speeds {
            grid.leaves().iter().zip(speeds).filter_map(|(id, speeds)| Some((id.index(), speeds?))).collect()
        };
        let speeds = by_leaf(felt.into_iter().map(|felt| felt.speeds).collect());
        let drawn = grid.leaves().iter().filter(|id| speeds.contains_key(&id.index()));
        let drawn: Vec<IVec3> = drawn.map(|id| grid.origin(*id)).collect();
        let around: FxHashSet<IVec3> = drawn.iter().copied().flat_map(leaves_around).collect();
        let voxel_size = self.start.voxel_size() as f32;
        self.rates = by_leaf(grid.map_leaves(|id| {
            let mut speeds = around.contains(&grid.origin(id)).then(|| self.continued(grid, id, &speeds))??;
            dispatch(Rate { grid, id, speeds: &mut speeds, voxel_size });
            Some(speeds)
        }));
        for id in grid.leaves() {
            if let Some(rates) = self.rates.get(&id.index()) {
                let moved = self.moved.entry(grid.origin(*id)).or_insert(LeafMask::EMPTY);
                rates.0.iter().enumerate().filter(|(_, rate)| **rate != 0.0).for_each(|(at, _)| moved.set(at, true));
            }
        }
        self.leaves.extend(drawn);
        self.drawn = Some(around);
        felts
    }
}

impl Motion for Drawing<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        let felts = self.look(tracker.grid());
        self.gap = felts.gap;
        let endless = self.pull.how.repel && self.pull.how.max_depth.is_none();
        if felts.fastest == 0.0 || (!endless && self.gap < CLOSED) {
            return None;
        }
        for (least, now) in self.least.iter_mut().zip([felts.gap, felts.distance]) {
            if now < *least - PROGRESS {
                (*least, self.patience) = (now, PATIENCE);
            }
        }
        if !endless {
            self.patience -= 1;
            if self.patience == 0 {
                return None;
            }
        }
        self.substep = TRAVEL / felts.travel;
        let longest = if left.is_finite() { LONGEST_TIMED } else { LONGEST_STEP };
        Some((COURANT * self.start.voxel_size() / felts.fastest).min(longest).min(left))
    }

    /// In as many parts as changes of the normal ask for: the band is tracked after all of them, since each renormalisation takes a little off tips.
    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        self.anchor(tracker);
        let mut left = dt;
        loop {
            let part = if self.substep < left { left / (left / self.substep).ceil().min(MOST_PARTS) } else { left };
            let rates = &self.rates;
            let leaves = tracker.grid.leaves().iter().copied().filter(|id| rates.contains_key(&id.index())).collect();
            tracker.grid.update(&leaves, |id, values, mask| {
                if let Some(rates) = rates.get(&id.index()) {
                    mask.iter().for_each(|at| values.0[at] -= part as f32 * rates.0[at]);
                }
            });
            tracker.run.check(OPERATION)?;
            left -= part;
            if left <= dt * 1e-9 {
                self.stepped = Some(tracker.grid.clone());
                return Ok(());
            }
            self.substep = TRAVEL / self.look(tracker.grid()).travel;
        }
    }
}

/// F|∇φ| in place of F, in a leaf.
struct Rate<'a> {
    grid: &'a Grid,
    id: LeafId,
    speeds: &'a mut LeafValues,
    voxel_size: f32,
}

impl Work for Rate<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut halo = FaceHalo::default();
        halo.gather(self.grid.value_pages(), &self.grid.neighbours()[self.id.index()]);
        for pair in 0..LEAF_VOXELS / 16 {
            let (x, y, at) = (pair / 4, pair % 4 * 2, pair * 16);
            let speed = Lanes::from_slice(simd, &self.speeds.0[at..at + 16]);
            let rate = speed * upwind_gradient(simd, &halo, x, y, speed, self.voxel_size);
            rate.store_slice(&mut self.speeds.0[at..at + 16]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::levelset::testing::box_distance;
    use crate::mesh::Bvh;

    struct Points(Bvh);

    impl Attractor for Points {
        fn closest(&self, ijk: DVec3, within: f64) -> Option<DVec3> {
            self.0.closest_point(ijk, within).map(|hit| hit.point)
        }
    }

    fn points(list: impl IntoIterator<Item = DVec3>) -> Points {
        Points(Bvh::new(list.into_iter().map(|p| [p; 3]).collect()))
    }

    /// Solid below z = 0, far enough to all sides; the band of the reference.
    fn ground() -> LevelSet {
        let half = DVec3::new(30.0, 30.0, 15.0);
        let bounds = (IVec3::new(-40, -40, -40), IVec3::new(40, 40, 10));
        let distance = move |p: DVec3| box_distance(p + DVec3::Z * half.z, half);
        LevelSet::from_distance(Transform::uniform(1.0), 7.0, bounds, distance, &RunOptions::default()).unwrap()
    }

    /// A sheet of 13 × 13 points with spacing 1.
    fn sheet(z: f64) -> Points {
        points((0..169).map(|i| DVec3::new(f64::from(i / 13 - 6), f64::from(i % 13 - 6), z)))
    }

    /// The limits of the paper alone.
    fn paper() -> Attraction {
        Attraction { tip: 0.0, ..Attraction::default() }
    }

    fn drawn(target: &Points, how: &Attraction, until: Until) -> (LevelSet, AttractionReport) {
        let mut level_set = ground();
        let run = RunOptions::default();
        let pull = Pull::new(&level_set, target, how, None, &run).unwrap().unwrap();
        let within = pull.drawn_within(&level_set, &run).unwrap().unwrap();
        let report = attract(&mut level_set, &pull, within, until, &run).unwrap();
        assert_eq!(level_set.check(), []);
        (level_set, report)
    }

    /// Height of the surface above (x, y).
    fn height(level_set: &LevelSet, x: f64, y: f64) -> f64 {
        let mut sampler = level_set.sampler();
        let mut at = |z: f64| f64::from(sampler.trilinear(DVec3::new(x, y, z)));
        let steps = (-100..100).map(|k| f64::from(k) / 10.0);
        let z = steps.rev().find(|z| at(*z) < 0.0).unwrap();
        let (a, b) = (at(z), at(z + 0.1));
        z + 0.1 * a / (a - b)
    }

    #[test]
    fn a_sheet_of_points_draws_a_plateau() {
        // A dense reference in f64: 2.566, 3.816, 3.992; linear theory 4(1 − e^(−t)): 2.528, 3.801, 3.990. Steps of a twentieth
        // are up to 0.03 ahead of it.
        for (t, expected) in [(1.0, 2.566), (3.0, 3.816), (6.0, 3.992)] {
            let (level_set, report) = drawn(&sheet(4.0), &paper(), Until::Time(t));
            let z = height(&level_set, 0.0, 0.0);
            assert!((z - expected).abs() < 0.06 && report.flow.time <= t, "{t} {z}");
            if t == 6.0 {
                // The last points are at 6. On this grid the reference has 3 and 1 at 6 and 7, which is its own error; this scheme has 1.76 and
                // 0.74 here, 1.42 and 0.54 at half, 1.31 and 0.49 at a third of the voxel size. At 9 all have 0.
                let [at6, at7, at9] = [6.0, 7.0, 9.0].map(|x| height(&level_set, x, 0.0));
                assert!(
                    (1.2..3.0).contains(&at6) && (0.4..1.0).contains(&at7) && at9.abs() < 0.05,
                    "{at6} {at7} {at9}"
                );
                // The flank is even: what changes normals has broken up into no pits.
                let along: Vec<f64> = (-5..=5).map(|y| height(&level_set, 6.0, f64::from(y))).collect();
                assert!(along.iter().all(|z| (z - at6).abs() < 0.05), "{along:?}");
            }
        }
        // Engraved: −3.816.
        let (level_set, _) = drawn(&sheet(-4.0), &paper(), Until::Time(3.0));
        let z = height(&level_set, 0.0, 0.0);
        assert!((z + 3.816).abs() < 0.06, "{z}");
    }

    #[test]
    fn a_sheet_of_points_pushes_faster_and_faster() {
        // z = 4(1 − e^t) is −1.967 at t = 0.4; the reference has −1.91.
        let repel = Attraction { repel: true, ..paper() };
        let (level_set, _) = drawn(&sheet(4.0), &repel, Until::Time(0.4));
        let z = height(&level_set, 0.0, 0.0);
        assert!((z + 1.91).abs() < 0.1, "{z}");
    }

    #[test]
    fn a_point_draws_what_faces_it() {
        // Six above a plane: full speed up to .4843·6 = 2.9, none from .75·6 = 4.5 on.
        let (level_set, target, how) = (ground(), points([DVec3::new(0.0, 0.0, 6.0)]), paper());
        let pull = Pull::new(&level_set, &target, &how, None, &RunOptions::default()).unwrap().unwrap();
        let mut sampler = level_set.sampler();
        for (r, expected) in (0..6).zip([6.0, 6.0, 6.0, 5.963, 1.233, 0.0]) {
            for z in [-2, 0, 1, 3] {
                let felt = pull.at(&mut sampler, None, 1.0, IVec3::new(r, 0, z), None).unwrap();
                assert!((felt.speed - expected).abs() < 1e-3, "{r} {z} {}", felt.speed);
            }
        }
    }

    #[test]
    fn a_single_point_is_reached() {
        let target = points([DVec3::new(0.0, 0.0, 6.0)]);
        // By the limits alone the disc that is drawn shrinks to a voxel on the way: a dense reference stalls at 4.
        let (level_set, report) = drawn(&target, &paper(), Until::Iterations(1000));
        let apex = height(&level_set, 0.0, 0.0);
        assert!((4.0..6.3).contains(&apex), "{apex} {report:?}");
        let (level_set, report) = drawn(&target, &Attraction::default(), Until::Iterations(1000));
        let apex = height(&level_set, 0.0, 0.0);
        assert!((apex - 6.0).abs() < REACHED + 0.05 && report.gap < REACHED && !report.stalled, "{apex} {report:?}");
        // A cone, without a bulb at its tip.
        let mut sampler = level_set.sampler();
        for (r, z) in [(4.0, 5.0), (4.0, 6.0), (5.0, 3.0)] {
            assert!(sampler.trilinear(DVec3::new(r, 0.0, z)) > 0.0, "{r} {z}");
        }
    }

    #[test]
    fn threads_and_instructions_change_no_bit() {
        use crate::stencil::simd::{Isa, choose};
        let target = points([DVec3::new(5.0, 4.0, 3.0), DVec3::new(7.0, 4.0, 3.0)]);
        let on = |threads, isa| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let chosen = choose(isa);
            let (after, _) = pool.install(|| drawn(&target, &Attraction::default(), Until::Iterations(1000)));
            choose(chosen);
            after
        };
        let bits = |level_set: &LevelSet| {
            let grid = level_set.grid();
            grid.leaves().iter().map(|&id| (grid.origin(id), grid.values(id).0.map(f32::to_bits))).collect::<Vec<_>>()
        };
        assert!(bits(&on(1, Isa::Portable)) == bits(&on(3, Isa::Avx2)));
    }
}
