//! What flows that go on for long need: whether a step still moved the surface, and what holds it at the region's rim.
//!
//! At rest is what no longer moves over [`Watch::STEPS`] steps, renormalisation included: each shifts the surface a little, which the flow takes
//! back, so that a single Euler step goes on moving a surface that stays where it is.
//!
//! A region's weight α slows a flow down. One that goes on long enough ends up as far from where it was at α = 0.01 as at α = 1, and
//! one-sided flows pile material up against the voxels with α = 0, which stay as they were: a cliff, and no distance. So such
//! a flow is held,
//!
//! > |φ − φ₀| ≤ h α/(1 − α),
//!
//! a voxel at α = ½, and no bound in effect from α = 0.9 on. Where a region fades within two voxels or so that is no bound on the slope of φ:
//! operators cut what is too steep afterwards (`ops::confine`).

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::Tracker;
use super::domain::Domain;
use crate::grid::{Grid, LeafId, LeafSet, LeafValues, PageLeaves, Paged};
use crate::stencil::simd::{Lanes, Work, dispatch};

/// The fastest that a resting surface moves, in voxels a unit of time in voxels squared (F = −H moves a ball of 1000 voxels so).
const SLOWEST: f64 = 1e-3;
/// The root mean square change, in voxels, that is rest, of a step or of as many as lie between two looks, over the voxels that change at all: however large the
/// region, a part of it that still moves is not lost in the mean.
const SMALLEST: f64 = 1e-4;

/// The weight from which on nothing is held: the bound is nine voxels there, more than twice the half width of common bands.
const FREE: f32 = 0.9;

/// What a step changed at the surface: the voxels that are less than one away from it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Change {
    /// Largest |Δφ| in voxels.
    largest: f32,
    /// Σ Δφ² in voxels², in units of 2⁻⁴⁰: whole numbers have the same sum in any order.
    squares: u64,
    /// Voxels that changed.
    voxels: u64,
}

/// One voxel² in units of [`Change::squares`].
const UNIT: f64 = (1u64 << 40) as f64;

impl Change {
    /// Whether that is rest, of steps that last `dt` (world units squared).
    pub fn is_rest(&self, dt: f64, voxel_size: f64) -> bool {
        let slow = f64::from(self.largest) <= SLOWEST * dt / (voxel_size * voxel_size);
        slow || self.squares as f64 <= SMALLEST * SMALLEST * UNIT * self.voxels as f64
    }

    fn join(self, other: Self) -> Self {
        Self {
            largest: self.largest.max(other.largest),
            squares: self.squares.saturating_add(other.squares),
            voxels: self.voxels + other.voxels,
        }
    }
}

/// Watches for rest.
pub(super) struct Watch {
    before: Grid,
    steps: u32,
    time: f64,
    rest: bool,
}

impl Watch {
    /// Steps between two looks.
    const STEPS: u32 = 10;

    /// From now on.
    pub fn new(grid: &Grid) -> Self {
        Self { before: grid.clone(), steps: 0, time: 0.0, rest: false }
    }

    /// After an Euler step of `dt`, before the band is tracked.
    pub fn stepped(&mut self, tracker: &Tracker, dt: f64) {
        self.rest = tracker.last_change().is_rest(dt, f64::from(tracker.voxel_size()));
        self.steps += 1;
        self.time += dt;
    }

    /// Whether the surface rests; after the band is tracked.
    pub fn is_rest(&mut self, tracker: &Tracker) -> bool {
        if self.steps >= Self::STEPS {
            let change = tracker.change_since(&self.before);
            self.rest |= change.is_rest(self.time, f64::from(tracker.voxel_size()));
            (self.before, self.steps, self.time) = (tracker.grid().clone(), 0, 0.0);
        }
        self.rest
    }
}

impl Tracker<'_> {
    /// Holds φ near what it was at the start where the region's weight is small.
    pub(super) fn hold(&mut self, start: &Grid) {
        let Some(weights) = self.domain.weights() else { return };
        let (grid, domain) = (&*self.grid, &self.domain);
        let at_rim = |id: &LeafId| {
            let alpha = &weights.alpha(*id).0;
            domain.moving(*id, grid.mask(*id)).iter().any(|at| alpha[at] < FREE)
        };
        // The slots of a leaf differ once leaves have come and gone.
        let leaves = domain.leaves().par_pages().flat_map_iter(PageLeaves::iter).filter(at_rim);
        let leaves: Vec<(LeafId, LeafId)> = leaves.map(|id| (id, start.find(grid.origin(id)))).collect();
        let rim: LeafSet = leaves.iter().map(|(id, _)| *id).collect();
        let place: FxHashMap<LeafId, LeafId> = leaves.into_iter().collect();
        let voxel_size = self.transform.voxel_size() as f32;
        self.grid.update(&rim, |id, values, mask| {
            let Some(&before) = place.get(&id) else { return };
            let (before, alpha) = (&start.values(before).0, &weights.alpha(id).0);
            for at in domain.moving(id, *mask).iter().filter(|&at| alpha[at] < FREE) {
                let reach = voxel_size * alpha[at] / (1.0 - alpha[at]);
                values.0[at] = values.0[at].max(before[at] - reach).min(before[at] + reach);
            }
        });
    }

    /// What has changed since `before`, of the same level set a few steps ago.
    pub(super) fn change_since(&self, before: &Grid) -> Change {
        let (grid, domain, scale) = (&*self.grid, &self.domain, 1.0 / self.voxel_size());
        let leaves: Vec<_> = domain.leaves().iter().collect();
        let of_leaf = |&id| {
            // The slots of a leaf differ once leaves have come and gone.
            let (now, old) = (&grid.values(id).0, &before.values(before.find(grid.origin(id))).0);
            let (mut largest, mut sum, mut voxels) = (0.0f32, 0.0, 0);
            for at in domain.moving(id, grid.mask(id)).iter().filter(|&at| now[at].abs() * scale < 1.0) {
                let moved = (now[at] - old[at]).abs() * scale;
                largest = largest.max(moved);
                sum += f64::from(moved * moved);
                voxels += u64::from(moved > 0.0);
            }
            Change { largest, squares: (sum * UNIT) as u64, voxels }
        };
        leaves.par_iter().map(of_leaf).reduce(Change::default, Change::join)
    }

    /// What the last Euler step changed, region included; before the band is tracked.
    pub(super) fn last_change(&self) -> Change {
        // The step left the old field in the first buffer.
        let Some(old) = self.buffers.first() else { return Change::default() };
        let (grid, domain, scale) = (&*self.grid, &self.domain, 1.0 / self.voxel_size());
        let of_page = |leaves| {
            let mut change = Change::default();
            dispatch(PageChange { grid, old, domain, leaves, scale, change: &mut change });
            change
        };
        domain.leaves().par_pages().map(of_page).reduce(Change::default, Change::join)
    }
}

/// The change of the leaves of one page.
struct PageChange<'a> {
    grid: &'a Grid,
    old: &'a Paged<LeafValues>,
    domain: &'a Domain,
    leaves: PageLeaves,
    scale: f32,
    change: &'a mut Change,
}

impl Work for PageChange<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let zero = Lanes::splat(simd, 0.0);
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let (now, old) = (self.grid.values(id), self.old.get(id));
                let (mut largest, mut squares, mut voxels) = (zero, zero, 0);
                self.domain.moving(id, self.grid.mask(id)).for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let now = Lanes::from_slice(simd, &now.0[at..at + 16]);
                        let moved = (now - Lanes::from_slice(simd, &old.0[at..at + 16])).abs() * self.scale;
                        let near = (now.abs() * self.scale).simd_lt(1.0);
                        let counted = near & mask32x16::from_bitmask(simd, u64::from(bits));
                        let moved = counted.select(moved, zero);
                        largest = largest.max(moved);
                        squares += moved * moved;
                        voxels += u64::from(moved.simd_gt(zero).to_bitmask().count_ones());
                    },
                );
                let (mut each, mut sum) = ([0.0f32; 16], 0.0);
                squares.store_slice(&mut each);
                each.iter().for_each(|s| sum += f64::from(*s));
                largest.store_slice(&mut each);
                let largest = each.into_iter().fold(0.0, f32::max);
                *self.change = self.change.join(Change { largest, squares: (sum * UNIT) as u64, voxels });
            },
        );
    }
}
