//! Flows whose speed is found at the surface: each voxel of the band moves as the surface point nearest to it does.
//!
//! > φ_t = −(F(y, n) − 2βH)|∇φ|,  y = x − φ ∇φ/|∇φ|²,  n = ∇φ/|∇φ|
//!
//! This is the sub-voxel correction of the sparse-field method (Whitaker & Breen 1998) on a band: F is constant along normals, so that φ stays a
//! distance and the surface comes to rest where F vanishes between the voxels, not at the voxel beside it. F on voxels instead bunches the level sets up.
//!
//! Normals are central differences; |∇φ| is Godunov's of first order for F, central for the curvature. Near rest the scheme of |∇φ| does not matter, since F
//! vanishes; that of renormalisation does, since each track shifts the surface: HJ-WENO5 there.
//! 1/dt = 1/dt_F + 1/dt_κ with dt_F = ½h / max|F|, dt_κ = 0.9 h²/(6β).
//!
//! Most of a surface arrives long before its last part. So every few steps the leaves whose surface has not moved since the last look are left out until a
//! leaf beside them moves.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask, mask32x16};
use glam::{DVec3, IVec3};

use super::evolve::{Motion, Report, Until, drive};
use super::morph::{FirstOrder, MorphSpeed, MorphStep};
use super::step::{LeafKernel, Rows, Target};
use super::tracker::Tracker;
use super::{SolverOptions, TimeIntegrator};
use crate::error::Result;
use crate::grid::{Grid, LeafId, LeafMask, LeafSet, LeafValues, PageLeaves, Paged, offset_to_local};
use crate::levelset::LevelSet;
use crate::run::RunOptions;
use crate::stencil::curvature::mean_curvature;
use crate::stencil::simd::{Lanes, Work, dispatch};
use crate::stencil::upwind::godunov_first;
use crate::stencil::{FaceHalo, Halo, LeafHalo};

/// Part of a voxel that anything moves in a step.
const COURANT: f64 = 0.5;

/// Below this part of a voxel a unit of time, nothing moves.
const AT_REST: f32 = 1e-6;

/// Steps between two looks at which leaves rest, and until the first one. In that time nothing crosses the ring of leaves around those that move.
const SURVEY_EVERY: u32 = 10;
const FIRST_SURVEY: u32 = 4;

/// Parts of a voxel: what a surface at rest moves at most between two looks, whatever the time, since renormalisation shifts it to and fro.
const SMALLEST_MOVE: f64 = 3e-4;

/// The part of the leaves that is worth leaving the others out.
const WORTH_A_PART: f64 = 0.8;

/// What moves a surface.
pub trait SurfaceSpeed: Sync {
    /// Writes F (world units a unit of time, positive outwards) of the voxels of a leaf, and sums up what is wanted of the surface there.
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally;
}

/// Sums over the surface, of what a speed measures there.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// Voxels less than half a voxel from the surface: as many as its area has voxels.
    pub count: f64,
    /// Sum of the squares of what is to vanish.
    pub squares: f64,
    /// Half the rate at which that sum falls, if all goes straight.
    pub fall: f64,
}

impl Tally {
    fn sum<'a>(tallies: impl Iterator<Item = &'a OfLeaf>) -> Self {
        tallies.fold(Self::default(), |sum, leaf| sum.add(leaf.tally))
    }

    fn add(self, other: Self) -> Self {
        Self { count: self.count + other.count, squares: self.squares + other.squares, fall: self.fall + other.fall }
    }

    /// The root of the mean square.
    pub fn rms(&self) -> f64 {
        (self.squares / self.count.max(1.0)).sqrt()
    }
}

/// The surface as the voxels of a leaf see it.
pub struct LeafSurface<'a> {
    /// The leaf's first voxel.
    pub origin: IVec3,
    /// The value of voxels beyond the band, world units.
    pub background: f32,
    moving: LeafMask,
    /// Unit normals in index axes.
    normal: &'a [LeafValues; 3],
    /// φ/|∇φ| in voxels.
    depth: &'a LeafValues,
}

/// The surface point nearest to a voxel. Index space.
#[derive(Clone, Copy, Debug)]
pub struct Foot {
    /// The voxel's place in its leaf.
    pub offset: usize,
    /// The surface point.
    pub point: DVec3,
    /// How far along the normal the voxel is from it; negative inside.
    pub depth: f64,
    /// The outward normal; 0 where the field is flat.
    pub normal: DVec3,
    /// Whether the voxel is less than half a voxel away: these stand for the surface.
    pub beside: bool,
}

impl LeafSurface<'_> {
    /// The voxels that move.
    pub fn moving(&self) -> LeafMask {
        self.moving
    }

    /// Of these, the ones less than half a voxel from the surface: they stand for it.
    pub fn beside(&self) -> LeafMask {
        let mut beside = LeafMask::EMPTY;
        dispatch(Beside { depth: self.depth, beside: &mut beside });
        beside.zip(self.moving, |beside, moving| beside & moving)
    }

    /// Unit normals in index axes, an axis each; 0 where the field is flat. Of the rows that have a moving voxel.
    pub fn normals(&self) -> &[LeafValues; 3] {
        self.normal
    }

    /// How far voxels are from the surface along the normal, in voxels; negative inside. Of the rows that have a moving voxel.
    pub fn depths(&self) -> &LeafValues {
        self.depth
    }

    /// The voxels that move, and the surface points nearest to them.
    pub fn feet(&self) -> impl Iterator<Item = Foot> + '_ {
        self.moving.iter().map(|offset| {
            let [x, y, z] = self.normal;
            let normal = DVec3::new(x.0[offset].into(), y.0[offset].into(), z.0[offset].into());
            let depth = f64::from(self.depth.0[offset]);
            let ijk = (self.origin + offset_to_local(offset)).as_dvec3();
            Foot { offset, point: ijk - normal * depth, depth, normal, beside: depth.abs() < 0.5 }
        })
    }
}

/// Where a flow stands, before a step.
pub struct Moment<'a> {
    /// The field.
    pub grid: &'a Grid,
    /// Steps taken.
    pub steps: u32,
    /// Time passed.
    pub time: f64,
    /// What the speed measured.
    pub tally: Tally,
}

/// Moves a level set by a speed at the surface and β times twice its curvature (`bending`, world²), for at most `most` steps. What is slower than
/// `at_rest` (world units a unit of time) rests. `control` says how long the next step may be at most, or that there is to be none.
pub fn move_surface(
    level_set: &mut LevelSet,
    speed: &dyn SurfaceSpeed,
    bending: f64,
    at_rest: f64,
    most: u32,
    control: &mut dyn FnMut(&Moment) -> Option<f64>,
    run: &RunOptions,
) -> Result<Report> {
    let bytes = 3 * level_set.grid().bytes();
    run.reserve("moving a surface", bytes, "take a larger voxel size")?;
    let mut tracker = Tracker::new(level_set, None, SOLVER, run);
    let rest = Rest { slowest: at_rest, ..Rest::default() };
    let mut motion = Moving { source: speed, bending, control, speed: Paged::default(), steps: 0, time: 0.0, rest };
    drive(&mut tracker, &mut motion, Until::Iterations(most))
}

const SOLVER: SolverOptions = SolverOptions { scheme: super::UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

struct Moving<'a> {
    source: &'a dyn SurfaceSpeed,
    bending: f64,
    control: &'a mut dyn FnMut(&Moment) -> Option<f64>,
    /// F of the step.
    speed: Paged<LeafValues>,
    steps: u32,
    time: f64,
    rest: Rest,
}

/// The leaves that are left out because nothing moves there.
#[derive(Default)]
struct Rest {
    /// World units a unit of time.
    slowest: f64,
    /// The field at the last look, and when that was.
    before: Option<(Grid, u32, f64)>,
    leaves: LeafSet,
    /// Whether any are left out.
    confined: bool,
    /// The sums over them, which stay as they are.
    tally: Tally,
    /// The leaves that move from now on, if they are others than before; all of them for the inner `None`.
    next: Option<Option<LeafSet>>,
}

/// What is found in a leaf.
struct OfLeaf {
    id: LeafId,
    origin: IVec3,
    tally: Tally,
    /// Largest |F|.
    fastest: f32,
    /// How far φ near the surface has moved since the last look; infinite for a leaf that was not there.
    moved: f32,
}

impl Rest {
    /// How far a leaf at rest may have moved at most, if it is time for a look.
    fn limit(&self, steps: u32, time: f64, voxel_size: f64) -> Option<f64> {
        let (_, then, begun) = self.before.as_ref()?;
        let passed = (self.slowest * (time - begun)).max(SMALLEST_MOVE * voxel_size);
        let wait = if *then == 0 { FIRST_SURVEY } else { SURVEY_EVERY };
        (steps >= then + wait).then_some(passed)
    }

    /// How far φ of a leaf has moved near the surface.
    fn moved(&self, grid: &Grid, id: LeafId) -> f32 {
        let Some((before, ..)) = &self.before else { return f32::INFINITY };
        let then = before.find(grid.origin(id));
        if then.is_sentinel() {
            return f32::INFINITY;
        }
        let near = 0.5 * grid.background();
        let (now, then) = (&grid.values(id).0, &before.values(then).0);
        let moved = grid.mask(id).iter().filter(|&at| now[at].abs() < near).map(|at| (now[at] - then[at]).abs());
        moved.fold(0.0, f32::max)
    }

    /// Looks which leaves have come to rest; `found` is of all of them.
    fn survey(&mut self, grid: &Grid, found: &[OfLeaf], limit: f64) {
        let awake = found.iter().filter(|leaf| f64::from(leaf.moved) > limit);
        let around = grid.neighbours();
        let mut part = LeafSet::default();
        for leaf in awake {
            for &id in around[leaf.id.index()].iter().filter(|id| !id.is_sentinel()) {
                part.insert(id);
            }
        }
        let whole = part.len() as f64 > WORTH_A_PART * found.len() as f64;
        self.leaves = LeafSet::default();
        if !whole {
            for leaf in found.iter().filter(|leaf| !part.contains(leaf.id)) {
                self.leaves.insert(leaf.id);
            }
        }
        self.tally = Tally::sum(found.iter().filter(|leaf| self.leaves.contains(leaf.id)));
        // Where all leaves move already, nothing changes.
        self.next = (self.confined || !whole).then_some((!whole).then_some(part));
        self.confined = !whole;
    }
}

impl Motion for Moving<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        let grid = tracker.grid();
        let voxel_size = f64::from(tracker.voxel_size());
        let pages = grid.value_pages().page_count();
        self.speed.truncate(pages);
        // Voxels are written before they are read.
        self.speed.grow_unwritten(pages);
        let (source, rest) = (self.source, &self.rest);
        let limit = rest.limit(self.steps, self.time, voxel_size);
        let leaves = if limit.is_some() { grid.leaf_set() } else { tracker.domain.leaves() };
        let found = self.speed.par_update_pages(leaves, |leaves, speed| {
            let mut found = Vec::new();
            if !tracker.run.is_cancelled() {
                let mut normal = [LeafValues::default(), LeafValues::default(), LeafValues::default()];
                let mut depth = LeafValues::default();
                let mut halo = FaceHalo::new();
                leaves.for_each(|id| {
                    let moving = match limit {
                        Some(_) => grid.mask(id),
                        None => tracker.domain.moving(id, grid.mask(id)),
                    };
                    let (origin, background) = (grid.origin(id), grid.background());
                    let speed = &mut speed[PageLeaves::slot(id)];
                    let moved = if limit.is_some() { rest.moved(grid, id) } else { 0.0 };
                    dispatch(Feet { tracker, id, moving, halo: &mut halo, normal: &mut normal, depth: &mut depth });
                    let leaf = LeafSurface { origin, background, moving, normal: &normal, depth: &depth };
                    let tally = source.of_leaf(&leaf, speed);
                    let mut fastest = 0.0;
                    dispatch(Fastest { moving, speed, fastest: &mut fastest });
                    found.push(OfLeaf { id, origin, tally, fastest, moved });
                });
            }
            found
        });
        // Slots depend on the history of a grid, the order of origins does not.
        let mut found: Vec<OfLeaf> = found.into_iter().flatten().collect();
        found.sort_unstable_by_key(|leaf| (leaf.origin.x, leaf.origin.y, leaf.origin.z));
        if let Some(limit) = limit {
            self.rest.survey(grid, &found, limit);
        }
        if limit.is_some() || self.rest.before.is_none() {
            self.rest.before = Some((grid.clone(), self.steps, self.time));
        }
        found.retain(|leaf| !self.rest.leaves.contains(leaf.id));
        let tally = Tally::sum(found.iter()).add(self.rest.tally);
        let fastest = found.iter().map(|leaf| leaf.fastest).fold(0.0, f32::max);
        let moment = Moment { grid, steps: self.steps, time: self.time, tally };
        let wanted = (self.control)(&moment)?;
        if found.is_empty() {
            return None;
        }
        if self.bending == 0.0 && fastest <= AT_REST * tracker.voxel_size() {
            return None;
        }
        let slowness =
            f64::from(fastest) / (COURANT * voxel_size) + 6.0 * self.bending / (0.9 * voxel_size * voxel_size);
        let dt = (1.0 / slowness).min(wanted).min(left);
        (self.steps, self.time) = (self.steps + 1, self.time + dt);
        Some(dt)
    }

    fn wake(&mut self, tracker: &mut Tracker) -> bool {
        let rest = &mut self.rest;
        if !std::mem::take(&mut rest.confined) {
            return false;
        }
        (rest.leaves, rest.tally, rest.next) = (LeafSet::default(), Tally::default(), None);
        tracker.confine(None);
        true
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        if let Some(leaves) = self.rest.next.take() {
            tracker.confine(leaves);
        }
        let voxel_size = tracker.voxel_size();
        let step = MorphStep { speed: &self.speed, form: MorphSpeed::Upwind, dt: dt as f32, voxel_size };
        match self.bending {
            0.0 => tracker.integrate(&FirstOrder(step), TimeIntegrator::TvdRk1, Target::Moving),
            bending => tracker.integrate(
                &SmoothedStep { speed: &self.speed, twice: 2.0 * bending as f32, dt: dt as f32, voxel_size },
                TimeIntegrator::TvdRk1,
                Target::Moving,
            ),
        }
    }
}

/// Normals and distances of a leaf.
struct Feet<'a> {
    tracker: &'a Tracker<'a>,
    id: LeafId,
    moving: LeafMask,
    halo: &'a mut FaceHalo,
    normal: &'a mut [LeafValues; 3],
    depth: &'a mut LeafValues,
}

/// Bounds of |∇φ|: at the rim of the band the stencil meets ±background, and φ is the better distance there. A field that is too flat is a distance that is too
/// short, and the flow makes it longer until it is one.
const STEEPNESS: [f32; 2] = [1.0, 1.25];

/// Below this, squared, there is no gradient.
const FLAT_SQUARED: f32 = 1e-6;

impl Work for Feet<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tracker, id, moving, halo, normal: [nx, ny, nz], depth } = self;
        let grid = tracker.grid();
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        let per_voxel = 1.0 / tracker.voxel_size();
        let (zero, one) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0));
        moving.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                macro_rules! difference {
                    ($axis:literal) => {{
                        let [before, after] = halo.beside(simd, x, y, $axis);
                        (after - before) * (0.5 * per_voxel)
                    }};
                }
                let [a, b, c] = [difference!(0), difference!(1), difference!(2)];
                let squared = a * a + b * b + c * c;
                let sloping = squared.simd_gt(FLAT_SQUARED);
                let norm = sloping.select(squared, one).sqrt();
                let scale = sloping.select(one / norm, zero);
                (a * scale).store_slice(&mut nx.0[at..at + 16]);
                (b * scale).store_slice(&mut ny.0[at..at + 16]);
                (c * scale).store_slice(&mut nz.0[at..at + 16]);
                let steep = norm.max(Lanes::splat(simd, STEEPNESS[0])).min(Lanes::splat(simd, STEEPNESS[1]));
                (halo.centre(simd, x, y) * per_voxel / steep).store_slice(&mut depth.0[at..at + 16]);
            },
        );
    }
}

/// The voxels less than half a voxel from the surface.
struct Beside<'a> {
    depth: &'a LeafValues,
    beside: &'a mut LeafMask,
}

impl Work for Beside<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for (x, word) in self.beside.0.iter_mut().enumerate() {
            for pair in 0..4 {
                let at = x * 64 + pair * 16;
                let depth = Lanes::from_slice(simd, &self.depth.0[at..at + 16]);
                *word |= depth.abs().simd_lt(0.5).to_bitmask() << (16 * pair);
            }
        }
    }
}

/// The largest |F| of voxels that move.
struct Fastest<'a> {
    moving: LeafMask,
    speed: &'a LeafValues,
    fastest: &'a mut f32,
}

impl Work for Fastest<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let zero = Lanes::splat(simd, 0.0);
        let mut most = zero;
        self.moving.for_each_pair(
            #[inline(always)]
            |x, y, bits| {
                let at = x * 64 + y * 8;
                let speed = Lanes::from_slice(simd, &self.speed.0[at..at + 16]).abs();
                most = most.max(mask32x16::from_bitmask(simd, u64::from(bits)).select(speed, zero));
            },
        );
        *self.fastest = (0..16).map(|k| most[k]).fold(0.0, f32::max);
    }
}

/// One Euler step φ − dt(F − 2βH)|∇φ| with F a field, world units a unit of time, and β in world².
pub(super) struct SmoothedStep<'a> {
    /// F.
    pub speed: &'a Paged<LeafValues>,
    /// 2β.
    pub twice: f32,
    pub dt: f32,
    pub voxel_size: f32,
}

impl LeafKernel for SmoothedStep<'_> {
    const REACH: usize = <Halo as LeafHalo>::REACH;

    type Scratch = Halo;

    fn scratch(&self) -> Halo {
        Halo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, halo: &mut Halo, out: &mut LeafValues) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        let (h, dt, twice) = (self.voxel_size, self.dt, self.twice);
        let speed = &self.speed.get(id).0;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let speed = Lanes::from_slice(simd, &speed[at..at + 16]);
                let steepness = godunov_first(simd, halo, x, y, speed).sqrt() * (1.0 / h);
                let rate = speed * steepness - mean_curvature(simd, halo, x, y, h).motion * twice;
                (halo.centre(simd, x, y) - rate * dt).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::ball;

    /// F falls with the distance from the origin and vanishes at a radius.
    struct Spring {
        radius: f64,
    }

    impl SurfaceSpeed for Spring {
        fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
            let mut tally = Tally::default();
            for foot in leaf.feet() {
                let gap = self.radius - foot.point.length();
                speed.0[foot.offset] = gap as f32;
                if foot.beside {
                    tally.count += 1.0;
                    tally.squares += gap * gap;
                    tally.fall += gap * gap;
                }
            }
            tally
        }
    }

    fn radius(level_set: &LevelSet) -> f64 {
        let volume = level_set.measure(&RunOptions::default()).unwrap().volume;
        (volume * 3.0 / 4.0 / std::f64::consts::PI).cbrt()
    }

    #[test]
    fn it_rests_where_the_speed_vanishes_and_where_curvature_balances_it() {
        let run = RunOptions::default();
        for bending in [0.0, 2.0] {
            let mut level_set = ball(DVec3::new(0.3, -0.2, 0.1), 9.0);
            let mut control = |moment: &Moment| (moment.time < 30.0).then_some(0.5);
            let report =
                move_surface(&mut level_set, &Spring { radius: 12.4 }, bending, 1e-3, 2000, &mut control, &run)
                    .unwrap();
            assert_eq!(level_set.check(), []);
            // 12.4 − R = 2β/R. The volume is that of polygons, 0.6/R² of it less: 0.017 of the radius.
            let r = radius(&level_set);
            assert!((12.4 - r - 2.0 * bending / r).abs() < 0.03, "{bending}: {r} {report:?}");
        }
    }
}
