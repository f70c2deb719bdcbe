//! The driver: gathers leaves, runs a kernel on their active rows, writes the voxels that may be written.
//!
//! Masks and regions are handled here and nowhere else.

use super::domain::Domain;
use super::tracker::Tracker;
use crate::grid::{Grid, LeafId, LeafMask, LeafValues, PageLeaves, Paged};
use crate::stencil::simd::{self, Work};

/// One explicit Euler step on a leaf.
pub(super) trait LeafKernel: Sync {
    /// Buffers that a task reuses from leaf to leaf.
    type Scratch;

    /// New buffers.
    fn scratch(&self) -> Self::Scratch;

    /// Computes φ + dt·L(φ) for the rows of leaf `id` that have a bit in `rows`; other rows of `out` are not read.
    /// Must be `#[inline(always)]`.
    fn euler(&self, grid: &Grid, id: LeafId, rows: LeafMask, scratch: &mut Self::Scratch, out: &mut LeafValues);
}

/// Which voxels a step writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Target {
    /// Active voxels where the region's weight is above 0, blended by the weight: flows and filters.
    Moving,
    /// Active voxels but the frozen ones: repair of the distance.
    Repairable,
}

/// result = old·φₙ + new·E(φ).
#[derive(Clone, Copy, Debug)]
pub(super) struct Blend {
    pub old: f32,
    pub new: f32,
}

impl Blend {
    /// The new value alone.
    pub const NEW: Self = Self { old: 0.0, new: 1.0 };
}

impl Tracker<'_> {
    /// Steps φ into buffer `to`. The old value φₙ of the blend is read from buffer `from`, or from `to` itself.
    pub(super) fn step_into(
        &mut self,
        kernel: &impl LeafKernel,
        target: Target,
        from: Option<usize>,
        to: usize,
        blend: Blend,
    ) {
        let mut out = std::mem::take(&mut self.buffers[to]);
        let old = from.map(|i| &self.buffers[i]);
        let (grid, domain, run) = (&*self.grid, &self.domain, self.run);
        // All tasks read the neighbours: computed before they start, not by the first of them.
        grid.neighbours();
        out.par_update_pages(domain.leaves(), |leaves, page| {
            // One check a page of 64 leaves: a cancelled run stops within a fraction of a step.
            if !run.is_cancelled() {
                simd::dispatch(PageStep { kernel, grid, domain, target, old, blend, leaves, page });
            }
        });
        self.buffers[to] = out;
    }
}

/// The leaves of one page.
struct PageStep<'a, K> {
    kernel: &'a K,
    grid: &'a Grid,
    domain: &'a Domain,
    target: Target,
    old: Option<&'a Paged<LeafValues>>,
    blend: Blend,
    leaves: PageLeaves,
    page: &'a mut [LeafValues],
}

impl<K: LeafKernel> Work for PageStep<'_, K> {
    #[inline(always)]
    fn run(self) {
        let mut scratch = self.kernel.scratch();
        let mut new = LeafValues::default();
        self.leaves.for_each(|id| {
            let out = &mut self.page[PageLeaves::slot(id)];
            let phi = self.grid.values(id);
            let active = self.grid.mask(id);
            let (write, alpha) = match self.target {
                Target::Moving => (self.domain.moving(id, active), self.domain.weights().map(|w| w.alpha(id))),
                Target::Repairable => (self.domain.repairable(id, active), None),
            };
            if self.domain.is_local() && self.blend.old == 0.0 {
                // The buffer may hold an older state of voxels that this step does not write.
                out.0 = phi.0;
            }
            if write.is_empty() {
                return;
            }
            self.kernel.euler(self.grid, id, write, &mut scratch, &mut new);
            if let Some(alpha) = alpha {
                for (n, (p, a)) in new.0.iter_mut().zip(phi.0.iter().zip(&alpha.0)) {
                    *n = (1.0 - a) * p + a * *n;
                }
            }
            if self.blend.old != 0.0 {
                let old = self.old.map_or(&*out, |buffer| buffer.get(id));
                for (n, o) in new.0.iter_mut().zip(&old.0) {
                    *n = self.blend.old * o + self.blend.new * *n;
                }
            }
            store(write, &new, out);
        });
    }
}

/// Calls `f` with every row (x, y) that has a bit in `rows`.
#[inline(always)]
pub(super) fn for_each_row(rows: LeafMask, mut f: impl FnMut(usize, usize)) {
    for x in 0..8 {
        if rows.0[x] == 0 {
            continue;
        }
        for y in 0..8 {
            if rows.row(x, y) != 0 {
                f(x, y);
            }
        }
    }
}

/// Writes the voxels of `mask`, a row at a time.
#[inline(always)]
fn store(mask: LeafMask, new: &LeafValues, out: &mut LeafValues) {
    for_each_row(mask, |x, y| {
        let bits = mask.row(x, y);
        let at = x * 64 + y * 8;
        for z in 0..8 {
            let i = at + z;
            out.0[i] = if bits >> z & 1 == 1 { new.0[i] } else { out.0[i] };
        }
    });
}
