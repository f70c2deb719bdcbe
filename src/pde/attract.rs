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
//! a few voxels of the target (`tip`) everything that does not face away is drawn: the limits fall to 0 and 0.2.
//!
//! F depends on the normal: where C rises, a change of the normal travels along the surface towards the target at the speed |φ(p)| C′(γ) |u − (n·u)n|,
//! many times faster than the surface itself moves. So the normal is taken a voxel upwind of y, and that speed bounds the step as well: with central
//! differences and longer steps, flanks break up into pits.
//!
//! Pushed surfaces move by −F, faster and faster: a largest depth, measured from where the surface was, or a time ends it.

use glam::{DVec3, IVec3};

use super::evolve::{Motion, Report, StopReason, Until, drive};
use super::morph::{FirstOrder, MorphSpeed, MorphStep};
use super::step::Target;
use super::tracker::Tracker;
use super::{CutOff, SolverOptions, TimeIntegrator};
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LeafId, LeafSet, LeafValues, PageLeaves, Paged, offset_to_local};
use crate::levelset::{LevelSet, Sampler};
use crate::region::{Region, ramp_between};
use crate::run::RunOptions;

/// What draws a surface.
pub trait Attractor: Sync {
    /// The point of it closest to a point, both in index space of the level set.
    fn closest(&self, ijk: DVec3) -> Option<DVec3>;
}

/// How a surface is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attraction {
    /// C of the cosine γ.
    pub cut_off: CutOff,
    /// Distance from the target, in voxels, within which all that does not face away is drawn. 0 for the limits alone.
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
    pub const TIP: f64 = 3.0;
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
}

/// A target nearer than this, in voxels, is reached.
pub const REACHED: f64 = 0.25;

/// Motion of the surface in a step, in voxels: φ(p) is to be refreshed at least every half voxel.
const COURANT: f64 = 0.5;

/// Longest step where a time was asked for: a step closes its part of the gap, and a tenth keeps that within 5 % of e^(−t).
const LONGEST_TIMED: f64 = 0.1;

/// Longest step where only the end matters.
const LONGEST_STEP: f64 = 0.5;

/// Largest way in a step, in voxels, of what travels along the surface.
const TRAVEL: f64 = 0.8;

/// Half the interval of cosines over which C′ is measured.
const SLOPE_STEP: f64 = 0.02;

/// The cosine from which on a surface within the tip is drawn fully.
const SIDEWAYS: f64 = 0.2;

/// Voxels with less of the pull do not tell whether all that draws is reached: the rim of a region would never be.
const DRAWN: f32 = 0.5;

/// Steps without progress after which a flow is at rest.
const PATIENCE: u32 = 30;

/// What counts as progress, in voxels: a change of the mean distance of what is drawn from its targets.
const PROGRESS: f64 = 0.01;

/// Voxels around what is drawn and what draws it that may change as well.
const MARGIN: f64 = 6.0;

/// Draws a level set to `target`, where `region` lets it, until every point that draws is reached (within [`REACHED`]), nothing comes nearer,
/// or `until`. The time unit is that in which a gap falls to 1/e.
///
/// Only a box around what is drawn at the start and what draws it is touched: outside of it voxels keep their bits.
pub fn attract(
    level_set: &mut LevelSet,
    target: &dyn Attractor,
    how: &Attraction,
    region: Option<&dyn Region>,
    until: Until,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<AttractionReport> {
    let Some(bounds) = drawn_bounds(level_set, target, how, region, run)? else {
        let voxels = level_set.grid().active_voxels();
        let flow = Report { steps: 0, time: 0.0, voxels, stopped: StopReason::AtRest };
        return Ok(AttractionReport { flow, gap: 0.0, stalled: false });
    };
    let within = Within { bounds, region };
    // Depths are measured in the field as it was.
    let original = match how.max_depth {
        Some(depth) => {
            Some(crate::mesh::with_half_width(level_set, level_set.half_width().max(depth as f32 + 2.0), run)?)
        }
        None => None,
    };
    let mut tracker = Tracker::new(level_set, Some(&within), *solver, run);
    let pull = Pull { target, how, original };
    let mut motion = Drawing {
        pull,
        speed: Paged::default(),
        awake: None,
        drawn: Vec::new(),
        gap: 0.0,
        mean: f64::INFINITY,
        patience: PATIENCE,
    };
    let flow = drive(&mut tracker, &mut motion, until)?;
    Ok(AttractionReport { flow, gap: motion.gap, stalled: motion.patience == 0 })
}

/// A box in world space, and a region.
struct Within<'a> {
    bounds: (DVec3, DVec3),
    region: Option<&'a dyn Region>,
}

impl Region for Within<'_> {
    fn weight(&self, xyz: DVec3) -> f32 {
        let (lo, hi) = self.bounds;
        match xyz.cmpge(lo).all() && xyz.cmple(hi).all() {
            true => self.region.map_or(1.0, |region| region.weight(xyz)),
            false => 0.0,
        }
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let (lo, hi) = self.bounds;
        let other = self.region.and_then(|region| region.bounds());
        Some(other.map_or((lo, hi), |(a, b)| (lo.max(a), hi.min(b).max(lo.max(a)))))
    }

    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        let (lo, hi) = self.bounds;
        if (centre + radius).cmplt(lo).any() || (centre - radius).cmpgt(hi).any() {
            return [0.0; 2];
        }
        let [low, high] = self.region.map_or([1.0; 2], |region| region.weights_within(centre, radius));
        let all = (centre - radius).cmpge(lo).all() && (centre + radius).cmple(hi).all();
        [if all { low } else { 0.0 }, high]
    }
}

/// What a voxel feels.
struct Felt {
    /// F, world units a unit of time.
    speed: f32,
    /// |φ(p)| C′(γ) |u − (n·u)n|: how fast a change of the normal travels along the surface.
    transport: f32,
    /// C.
    share: f32,
    /// |φ(p)| in voxels, or how far a pushed surface still goes.
    gap: f64,
    /// From the surface to the target, in voxels.
    distance: f64,
    /// The target.
    point: DVec3,
}

/// The force on a surface.
struct Pull<'a> {
    target: &'a dyn Attractor,
    how: &'a Attraction,
    original: Option<LevelSet>,
}

impl Pull<'_> {
    /// What the voxel at `ijk` feels; `None` where the field has no normal, or without a target.
    fn at(&self, sampler: &mut Sampler, voxel_size: f64, ijk: IVec3) -> Option<Felt> {
        let (foot, mut normal) = foot(sampler, voxel_size, ijk)?;
        let point = self.target.closest(foot)?;
        let (to, phi) = (point - foot, f64::from(sampler.trilinear(point)));
        let distance = to.length();
        let aside = to - normal * normal.dot(to);
        if aside.length() > 1e-6 {
            // Against the wind: what happens at the rim of C travels to the target, or from it.
            let upwind = aside * (aside.length().min(1.0) / aside.length());
            let from = if self.how.repel { foot + upwind } else { foot - upwind };
            normal = sampler.smooth_gradient(from).try_normalize()?;
        }
        let cosine = if distance > 1e-6 { normal.dot(to) / distance * phi.signum() } else { 1.0 };
        let near =
            if distance < self.how.tip { 1.0 - ramp_between(distance, self.how.tip / 2.0, self.how.tip) } else { 0.0 };
        let share_at = |cosine: f64| self.how.cut_off.weight(cosine).max(near * ramp_between(cosine, 0.0, SIDEWAYS));
        let mut share = share_at(cosine);
        let slope = (share_at(cosine + SLOPE_STEP) - share_at(cosine - SLOPE_STEP)).abs() / (2.0 * SLOPE_STEP);
        let transport = slope * phi.abs() * (1.0 - cosine * cosine).max(0.0).sqrt();
        let mut gap = phi.abs() / voxel_size;
        let mut speed = phi;
        if self.how.repel {
            speed = -phi;
            if let (Some(depth), Some(original)) = (self.how.max_depth, &self.original) {
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
        let (speed, transport) = ((share * speed) as f32, transport as f32);
        Some(Felt { speed, transport, share: share as f32, gap, distance, point })
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

/// World-space box around what is drawn and what draws it, with a margin; `None` if nothing is drawn.
fn drawn_bounds(
    level_set: &LevelSet,
    target: &dyn Attractor,
    how: &Attraction,
    region: Option<&dyn Region>,
    run: &RunOptions,
) -> Result<Option<(DVec3, DVec3)>> {
    let (grid, transform, voxel_size) = (level_set.grid(), level_set.transform(), level_set.voxel_size());
    // At the start nothing has been pushed: no depth counts yet.
    let how = Attraction { max_depth: None, ..*how };
    let pull = Pull { target, how: &how, original: None };
    let half = (f64::from(LEAF_DIM) - 1.0) / 2.0;
    let boxes = grid.map_leaves(|id| {
        let origin = grid.origin(id);
        let centre = transform.index_to_world(origin.as_dvec3() + half);
        let reached = region.is_none_or(|r| r.weights_within(centre, half * 3f64.sqrt() * voxel_size)[1] > 0.0);
        if !reached || run.is_cancelled() {
            return None;
        }
        let (values, mut sampler) = (grid.values(id), level_set.sampler());
        let mut bounds: Option<(DVec3, DVec3)> = None;
        for offset in grid.mask(id).iter() {
            // The voxels beside the surface stand for the others on their normals.
            if f64::from(values.0[offset].abs()) > voxel_size {
                continue;
            }
            let ijk = origin + offset_to_local(offset);
            if region.is_some_and(|r| r.weight(transform.voxel_to_world(ijk)) <= 0.0) {
                continue;
            }
            let Some(felt) = pull.at(&mut sampler, voxel_size, ijk) else { continue };
            if felt.share > 0.0 && (how.repel || felt.gap >= REACHED) {
                let (a, b) = (ijk.as_dvec3().min(felt.point), ijk.as_dvec3().max(felt.point));
                bounds = Some(bounds.map_or((a, b), |(lo, hi)| (lo.min(a), hi.max(b))));
            }
        }
        bounds
    });
    run.check("attraction")?;
    let bounds = boxes.into_iter().flatten().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
    let margin = f64::from(level_set.half_width()) + MARGIN;
    Ok(bounds.map(|(lo, hi)| {
        let corners = (0..8).map(|c| {
            let pick = |bit: i32, axis: usize| if c & bit == 0 { lo[axis] - margin } else { hi[axis] + margin };
            transform.index_to_world(DVec3::new(pick(4, 0), pick(2, 1), pick(1, 2)))
        });
        corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), c| (lo.min(c), hi.max(c)))
    }))
}

struct Drawing<'a> {
    pull: Pull<'a>,
    /// F of the step.
    speed: Paged<LeafValues>,
    /// The leaves that are looked at; all of them at first.
    awake: Option<LeafSet>,
    /// Origins of the leaves that were drawn in the last step.
    drawn: Vec<IVec3>,
    gap: f64,
    /// Mean distance from the targets at the last progress, and the steps left to make some.
    mean: f64,
    patience: u32,
}

/// What the leaves of a page feel.
#[derive(Default)]
struct PageFelt {
    fastest: f32,
    transport: f32,
    gap: f64,
    /// Sum over the voxels that are drawn, and their number.
    distance: f64,
    count: f64,
    drawn: Vec<LeafId>,
}

impl Drawing<'_> {
    /// F on the leaves of one page.
    fn feel(&self, tracker: &Tracker, leaves: PageLeaves, speed: &mut [LeafValues]) -> PageFelt {
        let (grid, voxel_size) = (tracker.grid(), f64::from(tracker.voxel_size()));
        let mut sampler = Sampler::new(grid, voxel_size);
        let mut all = PageFelt::default();
        leaves.for_each(|id| {
            let speed = &mut speed[PageLeaves::slot(id)];
            speed.0.fill(0.0);
            if self.awake.as_ref().is_some_and(|awake| !awake.contains(id)) {
                return;
            }
            let origin = grid.origin(id);
            let alpha = tracker.domain.weights().map(|weights| weights.alpha(id));
            let mut drawn = false;
            for offset in tracker.domain.moving(id, grid.mask(id)).iter() {
                let ijk = origin + offset_to_local(offset);
                let Some(felt) = self.pull.at(&mut sampler, voxel_size, ijk) else { continue };
                if felt.speed == 0.0 {
                    continue;
                }
                speed.0[offset] = felt.speed;
                drawn = true;
                all.fastest = all.fastest.max(felt.speed.abs());
                all.transport = all.transport.max(felt.transport);
                if felt.share * alpha.map_or(1.0, |alpha| alpha.0[offset]) >= DRAWN {
                    all.gap = all.gap.max(felt.gap);
                    all.distance += felt.distance;
                    all.count += 1.0;
                }
            }
            if drawn {
                all.drawn.push(id);
            }
        });
        all
    }

    /// The leaves drawn before and those around them: what lies elsewhere has not moved, and so is not drawn now.
    fn wake(&mut self, grid: &Grid) {
        let mut awake = LeafSet::default();
        for &origin in &self.drawn {
            for n in 0..27 {
                let step = IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1) * LEAF_DIM;
                let id = grid.find(origin + step);
                if !id.is_sentinel() {
                    awake.insert(id);
                }
            }
        }
        self.awake = Some(awake);
    }
}

impl Motion for Drawing<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        let grid = tracker.grid();
        if !self.drawn.is_empty() {
            self.wake(grid);
        }
        let pages = grid.value_pages().page_count();
        let mut speed = std::mem::take(&mut self.speed);
        speed.truncate(pages);
        speed.grow_unwritten(pages);
        let felt = speed.par_update_pages(tracker.domain.leaves(), |leaves, page| self.feel(tracker, leaves, page));
        self.speed = speed;
        let fastest = felt.iter().map(|f| f.fastest).fold(0.0, f32::max);
        let count: f64 = felt.iter().map(|f| f.count).sum();
        let mean = felt.iter().map(|f| f.distance).sum::<f64>() / count.max(1.0);
        self.gap = felt.iter().map(|f| f.gap).fold(0.0, f64::max);
        self.drawn = felt.iter().flat_map(|f| &f.drawn).map(|&id| grid.origin(id)).collect();
        let endless = self.pull.how.repel && self.pull.how.max_depth.is_none();
        if fastest == 0.0 || (!endless && self.gap < REACHED) {
            return None;
        }
        if (mean - self.mean).abs() > PROGRESS {
            (self.mean, self.patience) = (mean, PATIENCE);
        }
        if !endless {
            self.patience -= 1;
            if self.patience == 0 {
                return None;
            }
        }
        let transport = felt.iter().map(|f| f.transport).fold(0.0, f32::max);
        let voxel_size = f64::from(tracker.voxel_size());
        let largest = (COURANT * voxel_size / f64::from(fastest)).min(TRAVEL * voxel_size / f64::from(transport));
        Some(largest.min(if left.is_finite() { LONGEST_TIMED } else { LONGEST_STEP }).min(left))
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        let voxel_size = tracker.voxel_size();
        let step = MorphStep { speed: &self.speed, form: MorphSpeed::Upwind, dt: dt as f32, voxel_size };
        tracker.integrate(&FirstOrder(step), TimeIntegrator::TvdRk1, Target::Moving)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::levelset::testing::box_distance;
    use crate::mesh::Bvh;
    use crate::stencil::upwind::UpwindScheme;

    struct Points(Bvh);

    impl Attractor for Points {
        fn closest(&self, ijk: DVec3) -> Option<DVec3> {
            self.0.closest_point(ijk, f64::INFINITY).map(|hit| hit.point)
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

    const SOLVER: SolverOptions =
        SolverOptions { scheme: UpwindScheme::HjWeno5, normalizations: 3, ..SolverOptions::FIRST_ORDER };

    /// The limits of the paper alone.
    fn paper() -> Attraction {
        Attraction { tip: 0.0, ..Attraction::default() }
    }

    fn drawn(target: &Points, how: &Attraction, until: Until) -> (LevelSet, AttractionReport) {
        let mut level_set = ground();
        let report = attract(&mut level_set, target, how, None, until, &SOLVER, &RunOptions::default()).unwrap();
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
        // A dense reference in f64: 2.566, 3.816, 3.992; linear theory 4(1 − e^(−t)): 2.528, 3.801, 3.990. Steps of a tenth of the time
        // are up to 0.05 ahead of it.
        for (t, expected) in [(1.0, 2.566), (3.0, 3.816), (6.0, 3.992)] {
            let (level_set, report) = drawn(&sheet(4.0), &paper(), Until::Time(t));
            let z = height(&level_set, 0.0, 0.0);
            assert!((z - expected).abs() < 0.06 && report.flow.time <= t, "{t} {z}");
            if t == 6.0 {
                // The last points are at 6: there the reference has 3 and 1 beside it, one voxel less is within its own cells.
                let [at6, at7, at9] = [6.0, 7.0, 9.0].map(|x| height(&level_set, x, 0.0));
                assert!(
                    (2.0..3.5).contains(&at6) && (0.5..2.0).contains(&at7) && at9.abs() < 0.05,
                    "{at6} {at7} {at9}"
                );
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
        let pull = Pull { target: &target, how: &how, original: None };
        let mut sampler = level_set.sampler();
        for (r, expected) in (0..6).zip([6.0, 6.0, 6.0, 5.963, 1.233, 0.0]) {
            for z in [-2, 0, 1, 3] {
                let felt = pull.at(&mut sampler, 1.0, IVec3::new(r, 0, z)).unwrap();
                assert!((felt.speed - expected).abs() < 1e-3, "{r} {z} {}", felt.speed);
            }
        }
    }

    #[test]
    fn a_single_point_is_reached() {
        let target = points([DVec3::new(0.0, 0.0, 6.0)]);
        // By the limits alone the flow stalls two voxels before it.
        let (level_set, report) = drawn(&target, &paper(), Until::Iterations(1000));
        let apex = height(&level_set, 0.0, 0.0);
        assert!((3.5..5.0).contains(&apex), "{apex} {report:?}");
        let (level_set, report) = drawn(&target, &Attraction::default(), Until::Iterations(1000));
        let apex = height(&level_set, 0.0, 0.0);
        assert!((apex - 6.0).abs() < REACHED + 0.05 && report.gap < REACHED && !report.stalled, "{apex} {report:?}");
        // A cone, without a bulb at its tip.
        let mut sampler = level_set.sampler();
        for (r, z) in [(3.0, 5.0), (3.0, 6.0), (4.0, 3.0)] {
            assert!(sampler.trilinear(DVec3::new(r, 0.0, z)) > 0.0, "{r} {z}");
        }
    }

    #[test]
    fn what_is_far_keeps_its_bits_and_threads_change_none() {
        use crate::stencil::simd::{Isa, choose};
        let before = ground();
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
        let after = on(1, Isa::Portable);
        assert!(bits(&after) == bits(&on(3, Isa::Avx2)));
        for &id in before.grid().leaves() {
            for offset in before.grid().mask(id).iter() {
                let ijk = before.grid().origin(id) + offset_to_local(offset);
                if ijk.x < -14 || ijk.y < -14 || ijk.z < -14 {
                    assert_eq!(after.grid().voxel(ijk), before.grid().voxel(ijk));
                }
            }
        }
    }
}
