//! Flows that go on until they rest: how far a step moved the surface, and what holds them at the rim of a region.
//!
//! A region's weight α slows a flow down. One that goes on until it rests has all the time it needs, and ends up as far from where it
//! was at α = 0.01 as at α = 1: a cliff at the rim, where the voxels with α = 0 stay as they were. So such a flow is held:
//!
//! > |φ − φ₀| ≤ 2 · background · α/(1 − α),
//!
//! which is no bound from α = ½ on and lets nothing move where α vanishes.

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};
use rayon::prelude::*;

use super::Tracker;
use super::domain::Domain;
use crate::grid::{Grid, LeafSet, LeafValues, PAGE_LEAVES, PageLeaves, Paged};
use crate::stencil::simd::{Lanes, Work, dispatch};

/// The fastest that a resting surface moves, in voxels a unit of time in voxels squared (F = −H moves a ball of 1000 voxels so).
const SLOWEST: f64 = 1e-3;
/// The root mean square change of a step, in voxels, that is rest, over the voxels that change at all: however large the
/// region, a part of it that still moves is not lost in the mean.
const SMALLEST: f64 = 1e-4;

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
    /// Whether that is rest, of a step of `dt` (world units squared).
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

impl Tracker<'_> {
    /// Holds φ near what it was at the start where the region's weight is small.
    pub(super) fn hold(&mut self, start: &Grid) {
        let Some(weights) = self.domain.weights() else { return };
        let grid = &*self.grid;
        // The slots of a leaf differ once leaves have come and gone.
        let mut place = vec![None; grid.value_pages().page_count() * PAGE_LEAVES];
        let mut rim = LeafSet::default();
        for id in self.domain.leaves().iter() {
            let (alpha, moving) = (&weights.alpha(id).0, self.domain.moving(id, grid.mask(id)));
            if moving.iter().any(|at| alpha[at] < 0.5) {
                place[id.index()] = Some(start.find(grid.origin(id)));
                rim.insert(id);
            }
        }
        let (domain, most) = (&self.domain, 2.0 * grid.background());
        self.grid.update(&rim, |id, values, mask| {
            let Some(before) = place[id.index()] else { return };
            let (before, alpha) = (&start.values(before).0, &weights.alpha(id).0);
            for at in domain.moving(id, *mask).iter().filter(|&at| alpha[at] < 0.5) {
                let reach = most * alpha[at] / (1.0 - alpha[at]);
                values.0[at] = values.0[at].clamp(before[at] - reach, before[at] + reach);
            }
        });
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
