//! The force on a surface: what a voxel feels of the target.

use std::cmp::Ordering;
use std::f64::consts::SQRT_2;
use std::sync::RwLock;

use glam::{DVec3, IVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rustc_hash::FxHashMap;

use super::{Attraction, Attractor, IndexBounds, OPERATION, REACHED};
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, offset_to_local};
use crate::levelset::{LevelSet, Sampler};
use crate::region::{Region, ramp_between};
use crate::run::RunOptions;

/// Half the width, as a cosine, of the window over which C's slope is taken: as much as neighbouring normals differ.
const WINDOW: f64 = 0.05;

/// How far upwind normals are read, in voxels, and the sine of the angle between n and u from which on: towards the target there is no upwind.
const UPWIND: f64 = 0.25;
const ASKEW: f64 = 0.1;

/// The cosines between which what is drawn within the tip rises from nothing to all. The flanks of a straight cone have 0: they must
/// widen while the tip grows, or it becomes thinner than the voxels show.
const SIDEWAYS: [f64; 2] = [-0.4, 0.1];

/// The closest surface point of a target is told by the foot points of voxels, which are no farther from it than this, in voxels.
const FOOTING: f64 = 0.5;

/// A target this part of its distance from the surface at the start away draws like one within `tip`: what is drawn has the same shape from far as from near,
/// of as many voxels more. A single point six voxels off is reached with the least tip.
const FAR_TIP: f64 = Attraction::TIP / 6.0;

/// How far aside of the way from a target to the surface point closest to it all is drawn that faces it: at least so many voxels, and such a part of the distance,
/// two thirds of what the limits draw of a plane. On the edge of a solid and on a sharp bump hardly a voxel is within the limits, and what grows from a single
/// one breaks off.
const FRONT: f64 = 2.5;
const FRONT_SLOPE: f64 = 0.4;

/// The cosines between which what is drawn there rises from nothing to all.
const FORWARD: [f64; 2] = [0.0, 0.5];

/// Voxels around what is drawn and what draws it that may change as well.
const MARGIN: f64 = 6.0;

/// What a voxel feels.
pub(super) struct Felt {
    /// F, world units a unit of time.
    pub speed: f64,
    /// C.
    pub share: f64,
    /// Speed, in voxels a unit of time, at which changes of the normal travel along the surface.
    pub travel: f64,
    /// |φ(p)| in voxels, or how far a pushed surface still goes.
    pub gap: f64,
    /// From the surface to the target, in voxels.
    pub distance: f64,
    /// The surface point.
    pub foot: DVec3,
    /// What draws.
    pub target: Target,
    /// From the surface to what draws, or away from it for a target inside: a unit vector.
    pub towards: DVec3,
}

/// A point of the target.
#[derive(Clone, Copy)]
pub(super) struct Target {
    pub point: DVec3,
    /// Distance from the surface as it was, in voxels, once it has been asked for.
    nearest: Option<f64>,
}

/// What has been found out about the targets, by voxel.
#[derive(Default)]
pub(super) struct Found {
    /// The surface points that are closest to them now, with their distances, in voxels.
    pub closest: FxHashMap<IVec3, (f64, DVec3)>,
    /// What to aim at beyond them.
    pub aims: FxHashMap<IVec3, DVec3>,
}

/// How near a surface point is to a target.
pub(super) struct Approach {
    /// The target's voxel.
    target: IVec3,
    distance: f64,
    foot: DVec3,
}

impl Found {
    /// Notes the closest of surface points anew.
    pub fn note<'d>(&mut self, approaches: impl Iterator<Item = &'d Approach>) {
        self.closest.clear();
        for Approach { target, distance, foot } in approaches {
            let known = self.closest.entry(*target).or_insert((*distance, *foot));
            let order = distance.total_cmp(&known.0);
            // Of points that are equally close, the same one in any order.
            if order.then_with(|| lexical(*foot, known.1)).is_lt() {
                *known = (*distance, *foot);
            }
        }
    }
}

fn lexical(a: DVec3, b: DVec3) -> Ordering {
    a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)).then(a.z.total_cmp(&b.z))
}

impl Felt {
    /// What there is to note of it.
    pub fn approach(&self) -> Approach {
        Approach { target: self.target.point.round().as_ivec3(), distance: self.distance, foot: self.foot }
    }
}

/// The force on a surface.
pub struct Pull<'a> {
    target: &'a dyn Attractor,
    pub(super) how: &'a Attraction,
    pub(super) region: Option<&'a dyn Region>,
    before: Before,
}

/// The surface as it was, where the region lets it move.
struct Before {
    points: ImmutableKdTree<f64, 3>,
    /// Distances of voxels from it, as far as they have been asked for: a point far off has many that are almost the closest, and is asked for again in every
    /// step.
    known: RwLock<FxHashMap<IVec3, f64>>,
}

/// Distances of voxels that are kept.
const MOST_KNOWN: usize = 1 << 22;

impl Before {
    /// Distance of a point, linear between those of the voxels around it.
    fn distance(&self, point: DVec3) -> f64 {
        let first = point.floor();
        let part = point - first;
        let weight = |c: i32, axis: usize| if c == 1 { part[axis] } else { 1.0 - part[axis] };
        let corner = |n: i32| {
            let [x, y, z] = [n >> 2, n >> 1 & 1, n & 1];
            weight(x, 0) * weight(y, 1) * weight(z, 2) * self.of_voxel(first.as_ivec3() + IVec3::new(x, y, z))
        };
        (0..8).map(corner).sum()
    }

    fn of_voxel(&self, ijk: IVec3) -> f64 {
        if let Some(distance) = self.known.read().ok().and_then(|known| known.get(&ijk).copied()) {
            return distance;
        }
        let place = ijk.as_dvec3().to_array();
        let distance = self.points.query(&place).nearest_one::<SquaredEuclidean<f64>>().execute().distance.sqrt();
        if let Ok(mut known) = self.known.write()
            && known.len() < MOST_KNOWN
        {
            known.insert(ijk, distance);
        }
        distance
    }
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
        let points = ImmutableKdTree::new_from_slice(&feet).map_err(|e| {
            EditError::parameter(
                OPERATION,
                "region",
                format!("{} voxels", feet.len()),
                format!("a smaller part of the surface: {e}"),
            )
        })?;
        let before = Before { points, known: RwLock::default() };
        Ok(Some(Self { target, how, region, before }))
    }

    /// A box around what is drawn and what draws it, with a margin; `None` if nothing is drawn.
    pub fn drawn_within(&self, level_set: &LevelSet, run: &RunOptions) -> Result<Option<IndexBounds>> {
        let voxel_size = level_set.voxel_size();
        let nothing_found = Found::default();
        let leaves = beside_surface(level_set, self.region, run, |drawn: &mut LeafDrawn, sampler, ijk| {
            // At the start nothing has been pushed: no depth counts yet.
            let Some(felt) = self.at(sampler, None, voxel_size, ijk, drawn.near, &nothing_found) else { return };
            drawn.near = Some(felt.target);
            if self.how.repel || felt.gap >= REACHED {
                drawn.approaches.push(felt.approach());
                if felt.share > 0.0 {
                    drawn.bounds = joined(drawn.bounds, (ijk.as_dvec3(), felt.target.point));
                }
            }
        })?;
        let mut bounds = leaves
            .iter()
            .filter_map(|drawn| drawn.bounds)
            .fold(None, |all, (a, b)| joined(joined(all, (a, a)), (b, b)));
        if self.draws_in_front() {
            let mut found = Found::default();
            found.note(leaves.iter().flat_map(|drawn| &drawn.approaches));
            bounds = found.closest.iter().fold(bounds, |all, (target, (distance, foot))| {
                let aside = DVec3::splat(SQRT_2 * front_radius(*distance));
                joined(joined(all, (target.as_dvec3(), *foot)), (foot - aside, foot + aside))
            });
        }
        Ok(bounds.map(|(lo, hi)| (lo - MARGIN, hi + MARGIN)))
    }

    /// Whether what lies around the surface point closest to a target is drawn, facing it or not.
    fn draws_in_front(&self) -> bool {
        self.how.tip > 0.0 && !self.how.repel
    }

    /// Part of what faces a target at `distance` that is near enough to it, if the surface was `nearest` away from it.
    fn reach(&self, distance: f64, nearest: f64) -> f64 {
        // Feet of voxels stand for the surface between them.
        self.how.cut_off.weight((nearest + FOOTING) / distance.max(FOOTING))
    }

    /// The target closest to a surface point, which is no farther than `near`.
    fn target(&self, foot: DVec3, near: Option<Target>) -> Option<Target> {
        // Wide enough for the rounding of a point that is found again.
        let within = near.map_or(f64::INFINITY, |near| near.point.distance(foot) * (1.0 + 1e-9) + 1e-9);
        let point = self.target.closest(foot, within)?;
        Some(near.filter(|near| near.point == point).unwrap_or(Target { point, nearest: None }))
    }

    /// What the voxel at `ijk` feels; `None` where the field has no normal, or without a target. `near` is a point of the target, the nearer the
    /// better: it bounds the search. Depths are measured in the field `original`.
    pub(super) fn at(
        &self,
        sampler: &mut Sampler,
        original: Option<&LevelSet>,
        voxel_size: f64,
        ijk: IVec3,
        near: Option<Target>,
        found: &Found,
    ) -> Option<Felt> {
        let (foot, normal) = foot(sampler, voxel_size, ijk)?;
        let mut target = self.target(foot, near)?;
        let voxel = target.point.round().as_ivec3();
        let point = target.point + found.aims.get(&voxel).copied().unwrap_or_default();
        let (to, phi) = (point - foot, f64::from(sampler.trilinear(point)));
        let distance = to.length();
        let towards = if distance > 1e-6 { to / distance * phi.signum() } else { normal };
        let mut tip = self.how.tip;
        // What is pushed goes away: distances from where it was say nothing of it.
        let nearest = if self.how.repel || distance <= tip / 2.0 {
            f64::INFINITY
        } else {
            let nearest = *target.nearest.get_or_insert_with(|| self.before.distance(target.point));
            tip = if tip > 0.0 { tip.max(FAR_TIP * nearest) } else { 0.0 };
            nearest
        };
        let close = if tip > 0.0 { 1.0 - ramp_between(distance, tip / 2.0, tip) } else { 0.0 };
        let front = match found.closest.get(&voxel) {
            Some(closest) if self.draws_in_front() => in_front(foot, closest.1, point),
            _ => 0.0,
        };
        let mut cosine = normal.dot(towards);
        let mut gap = phi.abs() / voxel_size;
        let faces = self.how.cut_off.weight(cosine + WINDOW) > 0.0;
        let reach = if faces && close < 1.0 { self.reach(distance, nearest) } else { 1.0 };
        let share = |cosine: f64| {
            let faces = reach * self.how.cut_off.weight(cosine);
            let [sideways, forward] = [SIDEWAYS, FORWARD].map(|limits| ramp_between(cosine, limits[0], limits[1]));
            faces.max(close * sideways).max(front * forward)
        };
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
        Some(Felt { speed: share * speed, share, travel, gap, distance, foot, target, towards })
    }
}

/// How far aside of the way to a target at this distance from the surface all is drawn, in voxels: what grows is a cone also where next to nothing faces the target.
fn front_radius(distance: f64) -> f64 {
    FRONT.max(FRONT_SLOPE * distance)
}

/// Whether a surface point is around the one that is closest to a target: 1 within [`front_radius`] of the way between the two, 0 beyond √2 of it, and twice as
/// deep below that point.
fn in_front(foot: DVec3, closest: DVec3, target: DVec3) -> f64 {
    let Some(way) = (target - closest).try_normalize() else { return 1.0 };
    let radius = front_radius(target.distance(closest));
    let height = (foot - closest).dot(way);
    let aside = (foot - closest - way * height).length_squared() / (radius * radius);
    (1.0 - ramp_between(aside, 1.0, 2.0)).min(1.0 - ramp_between(-height / radius, 2.0, 3.0))
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

/// A box and what it is to hold as well.
fn joined(bounds: Option<IndexBounds>, (a, b): (DVec3, DVec3)) -> Option<IndexBounds> {
    let (lo, hi) = bounds.unwrap_or((a, a));
    Some((lo.min(a).min(b), hi.max(a).max(b)))
}

/// The part of a leaf that is drawn.
#[derive(Default)]
struct LeafDrawn {
    bounds: Option<IndexBounds>,
    approaches: Vec<Approach>,
    /// The target of the voxel before.
    near: Option<Target>,
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
