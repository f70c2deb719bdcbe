//! The driver: runs a kernel on the active rows of leaves, writes the voxels that may be written.
//!
//! Masks and regions are handled here and nowhere else.

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};

use super::domain::Domain;
use super::tracker::Tracker;
use crate::grid::{Ahead, Grid, LeafId, LeafMask, LeafValues, PageLeaves, Paged};
use crate::stencil::Results;
use crate::stencil::simd::{self, Lanes, Work, with_sign};

/// One explicit Euler step on a leaf.
pub(super) trait LeafKernel: Sync {
    /// Voxels beyond a leaf that it reads along the axes.
    const REACH: usize;

    /// Buffers that a task reuses from leaf to leaf.
    type Scratch;

    /// New buffers.
    fn scratch(&self) -> Self::Scratch;

    /// Computes φ + dt·L(φ) for the row pairs of leaf `id` that have a voxel in `rows`; the others of `out` are not read.
    /// Reads values and neighbours of the grid, not its masks. Must be `#[inline(always)]`.
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: Rows,
        scratch: &mut Self::Scratch,
        out: &mut LeafValues,
    );
}

/// The rows of a leaf that a kernel computes. While it goes through them, the memory of the next leaf is brought into the cache.
pub(super) struct Rows<'a> {
    voxels: LeafMask,
    ahead: Option<Ahead<'a>>,
}

impl Rows<'_> {
    /// Calls `f` with x, y and the 16 bits of every pair of rows (x, y), (x, y + 1) that has a voxel to compute; y is even.
    #[inline(always)]
    pub fn for_each_pair(mut self, mut f: impl FnMut(usize, usize, u16)) {
        self.voxels.for_each_pair(
            #[inline(always)]
            |x, y, bits| {
                // A leaf has 32 pairs, and mostly more than half of them have a voxel.
                if let Some(ahead) = &mut self.ahead {
                    ahead.some();
                    ahead.some();
                }
                f(x, y, bits);
            },
        );
        if let Some(ahead) = &mut self.ahead {
            ahead.rest();
        }
    }

    /// The voxels to compute, for kernels that do not go through pairs of rows.
    #[inline(always)]
    pub fn voxels(mut self) -> LeafMask {
        if let Some(ahead) = &mut self.ahead {
            ahead.rest();
        }
        self.voxels
    }
}

/// Which voxels a step writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Target {
    /// Active voxels where the region's weight is above 0, blended by the weight: flows and filters.
    Moving,
    /// Active voxels but the frozen ones: repair of the distance.
    Repairable,
    /// As `Repairable`; those that end outside the band are deactivated and set to ±background. The last step of a track.
    Trimmed,
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

/// What trimming a leaf leaves to be done.
pub(super) struct Emptied {
    pub id: LeafId,
    /// Row pairs without an active voxel whose values differ from those before the step, bit `4x + y/2` each.
    pub pairs: u32,
}

impl Tracker<'_> {
    /// Steps φ into buffer `to`. The old value φₙ of the blend is read from buffer `from`, or from `to` itself.
    ///
    /// Returns the rows that trimming emptied, sorted by leaf.
    pub(super) fn step_into(
        &mut self,
        kernel: &impl LeafKernel,
        target: Target,
        from: Option<usize>,
        to: usize,
        blend: Blend,
    ) -> Vec<Emptied> {
        let mut out = std::mem::take(&mut self.buffers[to]);
        // Its masks are lent to the tasks, page by page.
        let mut masks = if target == Target::Trimmed { self.grid.take_masks() } else { Paged::default() };
        let several_buffers = self.buffers.len() > 1;
        let old = from.map(|i| &self.buffers[i]);
        let (grid, domain, run) = (&*self.grid, &self.domain, self.run);
        if blend.old != 0.0 && old.is_none() {
            // The old values are read from the pages that are written.
            out.own_pages(domain.leaves());
        }
        let (written, overwrites) = (domain.leaves().len(), blend.old == 0.0 || old.is_some());
        let step = |leaves, new_page, page: &mut [LeafValues], masks: Option<&mut [LeafMask]>| {
            let mut emptied = Vec::new();
            // One check a page of 64 leaves: a cancelled run stops within a fraction of a step.
            if !run.is_cancelled() {
                let emptied = &mut emptied;
                simd::dispatch(PageStep {
                    kernel,
                    grid,
                    domain,
                    target,
                    old,
                    blend,
                    leaves,
                    new_page,
                    page,
                    results: Results::new(written, overwrites),
                    masks,
                    several_buffers,
                    emptied,
                });
            }
            emptied
        };
        let mut emptied = Vec::new();
        if target == Target::Trimmed {
            emptied = out.par_rewrite_pages_with(&mut masks, domain.leaves(), |leaves, new, page, masks| {
                step(leaves, new, page, Some(masks))
            });
            self.grid.restore_masks(masks);
        } else {
            out.par_rewrite_pages(domain.leaves(), |leaves, new, page| drop(step(leaves, new, page, None)));
        }
        self.buffers[to] = out;
        emptied.into_iter().flatten().collect()
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
    /// Whether the page holds anything but the values that a step into it relies on.
    new_page: bool,
    page: &'a mut [LeafValues],
    /// How the page is written.
    results: Results,
    /// The masks of the page, if the step trims.
    masks: Option<&'a mut [LeafMask]>,
    /// Whether other buffers than φ and this one are to be kept in step.
    several_buffers: bool,
    emptied: &'a mut Vec<Emptied>,
}

impl<K: LeafKernel> Work for PageStep<'_, K> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let mut scratch = self.kernel.scratch();
        let mut new = LeafValues::default();
        let background = Lanes::splat(simd, self.grid.background());
        let (several, neighbours) = (self.several_buffers, self.grid.neighbours());
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let phi = self.grid.values(id);
                let mut mask = self.masks.as_mut().map(|masks| &mut masks[PageLeaves::slot(id)]);
                let active = mask.as_ref().map_or_else(|| self.grid.mask(id), |mask| **mask);
                let (write, alpha) = match self.target {
                    Target::Moving => (self.domain.moving(id, active), self.domain.weights().map(|w| w.alpha(id))),
                    Target::Repairable | Target::Trimmed => (self.domain.repairable(id, active), None),
                };
                if !write.is_empty() {
                    let ahead = self.leaves.after(id).map(
                        #[inline(always)]
                        |next| {
                            let written = &self.page[PageLeaves::slot(next)];
                            let written = (!self.results.past_cache()).then_some(written);
                            Ahead::new(self.grid.value_pages(), &neighbours[next.index()], K::REACH, written)
                        },
                    );
                    self.kernel.euler(simd, self.grid, id, Rows { voxels: write, ahead }, &mut scratch, &mut new);
                }
                let out = &mut self.page[PageLeaves::slot(id)];
                if self.new_page || (self.domain.is_local() && self.blend.old == 0.0) {
                    // The buffer may hold an older state of rows that this step does not write.
                    write.for_each_empty_pair(
                        #[inline(always)]
                        |x, y| {
                            let at = x * 64 + y * 8;
                            load(simd, phi, at).store_slice(&mut out.0[at..at + 16]);
                        },
                    );
                }
                if write.is_empty() {
                    return;
                }
                let mut emptied = 0u32;
                write.for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let mut value = load(simd, &new, at);
                        let now = load(simd, phi, at);
                        if let Some(alpha) = alpha {
                            let a = load(simd, alpha, at);
                            value = (Lanes::splat(simd, 1.0) - a) * now + a * value;
                        }
                        if self.blend.old != 0.0 {
                            let old = load(simd, self.old.map_or(&*out, |buffer| buffer.get(id)), at);
                            value = old * self.blend.old + value * self.blend.new;
                        }
                        if let Some(mask) = &mut mask {
                            let outside = value.abs().simd_ge(background);
                            value = outside.select(with_sign(simd, background, value), value);
                            let trimmed = outside.to_bitmask() & u64::from(bits);
                            mask.0[x] &= !(trimmed << (8 * y));
                            if mask.0[x] >> (8 * y) & 0xffff == 0
                                && (several || value.simd_eq(now).to_bitmask() & u64::from(bits) != u64::from(bits))
                            {
                                emptied |= 1 << (4 * x + y / 2);
                            }
                        }
                        // The other voxels of the rows take φ's value: so trimmed ones need no care of their own.
                        let mask = mask32x16::from_bitmask(simd, u64::from(bits));
                        self.results.write(simd, out, x, y, mask.select(value, now));
                    },
                );
                if emptied != 0 || mask.is_some_and(|mask| mask.is_empty()) {
                    self.emptied.push(Emptied { id, pairs: emptied });
                }
            },
        );
    }
}

/// Two rows of a leaf.
#[inline(always)]
fn load<S: Simd>(simd: S, leaf: &LeafValues, at: usize) -> Lanes<S> {
    Lanes::from_slice(simd, &leaf.0[at..at + 16])
}
