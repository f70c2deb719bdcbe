//! The motion by that force: speeds of the voxels beside the surface, steps, rest.

use std::collections::BTreeMap;

use fearless_simd::{Simd, SimdBase};
use glam::{DVec3, IVec3};
use rustc_hash::{FxHashMap, FxHashSet};
use smallvec::SmallVec;

use super::super::Tracker;
use super::super::curvature_flow::upwind_gradient;
use super::super::evolve::{Motion, Report};
use super::pull::{Approach, Found, Pull};
use super::{AttractionReport, IndexBounds, OPERATION, REACHED, leaves_around};
use crate::error::Result;
use crate::grid::{
    Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet, LeafValues, leaf_offset, leaf_origin, offset_to_local,
};
use crate::levelset::{LevelSet, Sampler};
use crate::stencil::FaceHalo;
use crate::stencil::simd::{Lanes, Work, dispatch};

/// Gap in voxels up to which it goes on: where the band is rebuilt, tips are cut by up to an eighth of a voxel.
const CLOSED: f64 = REACHED / 4.0;

/// Motion of the surface in a step, in voxels.
const COURANT: f64 = 0.5;

/// Travel of what changes the normal in a step, in voxels.
const TRAVEL: f64 = 0.4;

/// Longest step where a time was asked for: a step closes its part of the gap, and a twentieth keeps that within 3 % of e^(−t).
const LONGEST_TIMED: f64 = 0.05;

/// Longest step where only the end matters.
const LONGEST_STEP: f64 = 0.5;

/// Voxels within so many voxels of the surface are asked what they feel; those beyond take it from the voxel next to their foot point, which is one.
const FELT: f64 = 1.2;

/// Voxels nearer to the surface than this keep the values of a step, in voxels.
const NEXT: f32 = 0.75;

/// Voxels with less weight do not tell whether all that draws is reached: the rim of a region would never be.
const DRAWN: f64 = 0.5;

/// Voxels of which less is drawn do not, either: they hardly face what draws. The tip of a cone between the voxels may show them its flanks alone.
const FACING: f64 = 0.05;

/// Steps without progress after which a flow is at rest.
const PATIENCE: u32 = 8;

/// What counts as progress, in voxels: a fall of the largest gap, or of the mean or least distance of what is drawn from its targets.
const PROGRESS: f64 = 0.01;

/// Distance from the surface, in voxels, up to which a target is next to it.
const BESIDE: f64 = 2.0;

/// How much a finished surface may miss what was reached, and how far beyond targets are aimed at, in voxels.
const CLOSE_ENOUGH: f64 = 0.6 * REACHED;
const FARTHEST_AIM: f64 = 1.5;

/// A number a voxel of leaves, by the leaves' index; none where nothing is drawn.
type Speeds = FxHashMap<usize, Box<LeafValues>>;

/// What is drawn can grow by no more than this from one look to the next, in voxels.
const GROWTH: f64 = 4.0;

/// What is drawn: the first and the last voxel of it in each leaf, by the leaf's origin.
struct Drawn(FxHashMap<IVec3, (IVec3, IVec3)>);

impl Drawn {
    /// The voxels of leaves that have a speed.
    fn new(grid: &Grid, speeds: &Speeds) -> Self {
        let bounds = |id: &LeafId| {
            let (origin, speeds) = (grid.origin(*id), speeds.get(&id.index())?);
            let drawn = speeds.0.iter().enumerate().filter(|(_, speed)| **speed != 0.0);
            let voxels = drawn.map(|(at, _)| origin + offset_to_local(at)).map(|ijk| (ijk, ijk));
            Some((origin, voxels.reduce(|(lo, hi), (ijk, _)| (lo.min(ijk), hi.max(ijk)))?))
        };
        Self(grid.leaves().iter().filter_map(bounds).collect())
    }

    /// The boxes in and around a leaf.
    fn around(&self, origin: IVec3) -> SmallVec<[(IVec3, IVec3); 27]> {
        leaves_around(origin).filter_map(|leaf| self.0.get(&leaf).copied()).collect()
    }
}

/// Whether a voxel lies within `reach` of one of the boxes.
fn is_near(boxes: &[(IVec3, IVec3)], ijk: IVec3, reach: f64) -> bool {
    let gap = |(lo, hi): &(IVec3, IVec3)| (*lo - ijk).max(ijk - *hi).max(IVec3::ZERO).length_squared();
    boxes.iter().any(|bounds| f64::from(gap(bounds)) <= reach * reach)
}

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
    /// Least distance from a target that is not reached.
    nearest: Option<f64>,
    /// The targets that are next to the surface.
    touched: Vec<Touched>,
    approaches: Vec<Approach>,
}

/// A target next to the surface, and the way to it.
#[derive(Clone, Copy)]
struct Touched {
    point: DVec3,
    towards: DVec3,
}

/// What all voxels feel: the largest of each, the mean and the least distance.
struct Felts {
    fastest: f64,
    travel: f64,
    gap: f64,
    distance: f64,
    nearest: f64,
}

/// The motion towards the target.
pub(super) struct Drawing<'a> {
    pull: &'a Pull<'a>,
    original: Option<LevelSet>,
    /// The field at the start, in the wide band.
    start: LevelSet,
    within: IndexBounds,
    /// What was drawn at the last look: what lies elsewhere has not moved, and so is not drawn now. None at first.
    drawn: Option<Drawn>,
    /// Origins of the leaves that were drawn then, and those around them.
    around: FxHashSet<IVec3>,
    /// F|∇φ|.
    rates: Speeds,
    /// Origins of the leaves whose surface has moved.
    leaves: FxHashSet<IVec3>,
    /// Origins of leaves, and the voxels of the band in them that have moved.
    moved: FxHashMap<IVec3, LeafMask>,
    gap: f64,
    /// Largest gap, mean and least distance from the targets at the last progress, and the steps left to make some.
    least: [f64; 3],
    patience: u32,
    /// Longest Euler step.
    substep: f64,
    /// The field after the last step, before it was tracked.
    stepped: Option<Grid>,
    /// The targets that were next to the surface in the last step, by voxel.
    touched: BTreeMap<[i32; 3], Touched>,
    found: Found,
}

impl<'a> Drawing<'a> {
    /// The motion of a field by `pull`, within a box; depths are measured in `original`.
    pub fn new(pull: &'a Pull<'a>, original: Option<LevelSet>, start: LevelSet, within: IndexBounds) -> Self {
        Self {
            pull,
            original,
            start,
            within,
            drawn: None,
            around: FxHashSet::default(),
            rates: Speeds::default(),
            leaves: FxHashSet::default(),
            moved: FxHashMap::default(),
            gap: 0.0,
            least: [f64::INFINITY; 3],
            patience: PATIENCE,
            substep: f64::INFINITY,
            stepped: None,
            touched: BTreeMap::new(),
            found: Found::default(),
        }
    }

    /// Aims beyond the targets that a finished surface misses, by as much as it misses them; whether it misses any by more than it may.
    /// The tip of a cone and the rim of a fin lose up to half a voxel when they become polygons.
    pub fn aim_beyond(&mut self, finished: &LevelSet) -> bool {
        let (mut sampler, mut start, mut missed) = (finished.sampler(), self.start.sampler(), false);
        for (voxel, touched) in &self.touched {
            let side = f64::from(start.trilinear(touched.point)).signum();
            let short = side * f64::from(sampler.trilinear(touched.point)) / finished.voxel_size();
            let Some(towards) = touched.towards.try_normalize() else { continue };
            let aim = self.found.aims.entry(IVec3::from_array(*voxel)).or_default();
            *aim = (*aim + towards * (side * short)).clamp_length_max(FARTHEST_AIM);
            missed |= short.abs() > CLOSE_ENOUGH;
        }
        if missed {
            (self.least, self.patience) = ([f64::INFINITY; 3], PATIENCE);
        }
        missed
    }

    /// What there is to say after a flow.
    pub fn report(self, flow: Report, specks: u64) -> AttractionReport {
        AttractionReport { flow, gap: self.gap, stalled: self.patience == 0, moved: self.leaves, specks }
    }

    /// What the voxels beside the surface feel.
    fn feel(&self, grid: &Grid, id: LeafId) -> LeafFelt {
        let (transform, voxel_size) = (self.start.transform(), self.start.voxel_size());
        let (origin, values) = (grid.origin(id), grid.values(id));
        let mut felt = LeafFelt::default();
        let (lo, hi) = self.within;
        let last = origin + (LEAF_DIM - 1);
        let apart = last.as_dvec3().cmplt(lo).any() || origin.as_dvec3().cmpgt(hi).any();
        let drawn = self.drawn.as_ref().map(|drawn| drawn.around(origin));
        if apart || drawn.as_ref().is_some_and(|boxes| boxes.is_empty()) {
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
            if drawn.as_ref().is_some_and(|boxes| !is_near(boxes, ijk, GROWTH)) {
                continue;
            }
            let alpha = self.pull.region.map_or(1.0, |region| f64::from(region.weight(transform.voxel_to_world(ijk))));
            if alpha <= 0.0 {
                continue;
            }
            let Some(voxel) = self.pull.at(&mut sampler, self.original.as_ref(), voxel_size, ijk, near, &self.found)
            else {
                continue;
            };
            near = Some(voxel.target);
            felt.approaches.push(voxel.approach());
            // What is about to be drawn limits the step as well.
            felt.travel = felt.travel.max(voxel.travel * alpha);
            let speed = voxel.speed * alpha;
            if speed == 0.0 {
                continue;
            }
            felt.speeds.get_or_insert_default().0[offset] = speed as f32;
            felt.fastest = felt.fastest.max(speed.abs());
            if alpha >= DRAWN && voxel.share >= FACING {
                felt.gap = felt.gap.max(voxel.gap);
                if voxel.gap >= CLOSED {
                    felt.nearest = Some(felt.nearest.map_or(voxel.distance, |nearest| nearest.min(voxel.distance)));
                }
                if voxel.distance < BESIDE {
                    felt.touched.push(Touched { point: voxel.target.point, towards: voxel.towards });
                }
                felt.distance += if self.pull.how.repel { voxel.gap } else { voxel.distance };
                felt.count += 1.0;
            }
        }
        felt
    }

    /// Takes back what tracking the band did beside the surface, where renormalisation wears down tips and what nothing draws: voxels that have never moved
    /// get the values that they had at the start, the others, next to the surface, those of the last step.
    pub fn anchor(&self, tracker: &mut Tracker) {
        let Some(stepped) = &self.stepped else { return };
        let voxel_size = self.start.voxel_size() as f32;
        let (start, felt, next) = (self.start.grid(), FELT as f32 * voxel_size, NEXT * voxel_size);
        let grid = &mut *tracker.grid;
        let origins: FxHashMap<usize, IVec3> = grid.leaves().iter().map(|id| (id.index(), grid.origin(*id))).collect();
        let leaves = self.awake(grid);
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

    /// The leaves that are drawn and those around them, as far as the band of what moves reaches: the others are at rest.
    fn awake(&self, grid: &Grid) -> LeafSet {
        grid.leaves().iter().copied().filter(|id| self.around.contains(&grid.origin(*id))).collect()
    }

    /// F of the voxels of a leaf that lie farther from the surface.
    fn continued(&self, grid: &Grid, id: LeafId, near: &Speeds, drawn: &Drawn) -> Option<Box<LeafValues>> {
        let voxel_size = self.start.voxel_size();
        let mut sampler = Sampler::new(grid, voxel_size);
        let mut speeds = near.get(&id.index()).cloned();
        let boxes = drawn.around(grid.origin(id));
        for offset in grid.mask(id).iter() {
            let phi = f64::from(grid.values(id).0[offset]) / voxel_size;
            if phi.abs() <= FELT {
                continue;
            }
            let ijk = grid.origin(id) + offset_to_local(offset);
            // The foot point is so far away, and the voxel next to it half a diagonal more at most.
            if !is_near(&boxes, ijk, phi.abs() + 0.9) {
                continue;
            }
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

    /// Finds what every voxel feels.
    fn look(&mut self, grid: &Grid) -> Felts {
        let mut felt = grid.map_leaves(|id| self.feel(grid, id));
        if self.drawn.is_none() {
            // What lies closest to the targets is known only now.
            self.found.note(felt.iter().flat_map(|felt| &felt.approaches));
            felt = grid.map_leaves(|id| self.feel(grid, id));
        }
        let most = |of: fn(&LeafFelt) -> f64| felt.iter().map(of).fold(0.0, f64::max);
        let count: f64 = felt.iter().map(|f| f.count).sum();
        let felts = Felts {
            fastest: most(|f| f.fastest),
            travel: most(|f| f.travel),
            gap: most(|f| f.gap),
            distance: felt.iter().map(|f| f.distance).sum::<f64>() / count.max(1.0),
            nearest: felt.iter().filter_map(|f| f.nearest).fold(f64::INFINITY, f64::min),
        };
        let by_leaf = |speeds: Vec<Option<Box<LeafValues>>>| -> Speeds {
            grid.leaves().iter().zip(speeds).filter_map(|(id, speeds)| Some((id.index(), speeds?))).collect()
        };
        self.touched.clear();
        self.found.note(felt.iter().flat_map(|felt| &felt.approaches));
        for touched in felt.iter().flat_map(|felt| &felt.touched) {
            let place = self.touched.entry(touched.point.round().as_ivec3().to_array());
            place.and_modify(|known| known.towards += touched.towards).or_insert(*touched);
        }
        let speeds = by_leaf(felt.into_iter().map(|felt| felt.speeds).collect());
        let drawn = Drawn::new(grid, &speeds);
        self.around = drawn.0.keys().copied().flat_map(leaves_around).collect();
        let voxel_size = self.start.voxel_size() as f32;
        self.rates = by_leaf(grid.map_leaves(|id| {
            let mut speeds =
                self.around.contains(&grid.origin(id)).then(|| self.continued(grid, id, &speeds, &drawn))??;
            dispatch(Rate { grid, id, speeds: &mut speeds, voxel_size });
            Some(speeds)
        }));
        for id in grid.leaves() {
            if let Some(rates) = self.rates.get(&id.index()) {
                let moved = self.moved.entry(grid.origin(*id)).or_insert(LeafMask::EMPTY);
                rates.0.iter().enumerate().filter(|(_, rate)| **rate != 0.0).for_each(|(at, _)| moved.set(at, true));
            }
        }
        self.leaves.extend(drawn.0.keys());
        self.drawn = Some(drawn);
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
        for (least, now) in self.least.iter_mut().zip([felts.gap, felts.distance, felts.nearest]) {
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
        tracker.confine(Some(self.awake(tracker.grid())));
        let mut left = dt;
        loop {
            let part = left / (left / self.substep).ceil().max(1.0);
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
