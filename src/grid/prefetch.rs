//! Bringing memory into the cache ahead of its use.
//!
//! A leaf that is stepped for the first time since long lies in memory or in the last level of caches, and so does the one that is
//! written. Few lines can be on their way at a time: asked for in one go, they hold up the work; asked for a few at a time between
//! pieces of it, they cost next to nothing.

use super::leaf::{LEAF_VOXELS, LeafValues};
use super::paged::Paged;
use super::topology::Neighbours;

/// Values of a cache line.
const LINE: usize = 16;
/// Lines of a leaf, and of one of its slabs.
const LINES: usize = LEAF_VOXELS / LINE;
const SLAB_LINES: usize = LINES / 8;

/// The memory of a step on a leaf yet to come, asked for line by line.
pub struct Ahead<'a> {
    /// The leaf that is written, unless that goes past the cache.
    written: Option<&'a LeafValues>,
    /// The leaf and its neighbours below and above in x, y and z.
    read: [&'a LeafValues; 7],
    reach: usize,
    /// The next line of each leaf.
    line: usize,
}

impl<'a> Ahead<'a> {
    /// For a stencil that reaches `reach` voxels along the axes, 0 to 8, on the leaf in the middle of `around`; the result goes to `written`,
    /// if it goes through the cache.
    #[inline(always)]
    pub fn new(
        values: &'a Paged<LeafValues>,
        around: &Neighbours,
        reach: usize,
        written: Option<&'a LeafValues>,
    ) -> Self {
        // Not by `map`, which would not be inlined.
        let mut read = [values.get(around[13]); 7];
        for (leaf, q) in read.iter_mut().zip([13, 4, 22, 10, 16, 12, 14]) {
            *leaf = values.get(around[q]);
        }
        Self { written, read, reach, line: 0 }
    }

    /// Asks for the next line of each leaf, as far as the stencil reads it.
    #[inline(always)]
    pub fn some(&mut self) {
        if self.line == LINES {
            return;
        }
        let (at, slab, in_slab) = (self.line * LINE, self.line / SLAB_LINES, self.line % SLAB_LINES);
        self.line += 1;
        if let Some(leaf) = self.written {
            prefetch::<true>(&leaf.0[at]);
        }
        // A line is two rows of a slab. Of the neighbours in z every row is read.
        let (reach, rim) = (self.reach, self.reach.div_ceil(2));
        let wanted =
            [true, slab + reach >= 8, slab < reach, in_slab + rim >= SLAB_LINES, in_slab < rim, reach > 0, reach > 0];
        for (leaf, wanted) in self.read.iter().zip(wanted) {
            if wanted {
                prefetch::<false>(&leaf.0[at]);
            }
        }
    }

    /// Asks for all that is left.
    #[inline(always)]
    pub fn rest(&mut self) {
        while self.line < LINES {
            self.some();
        }
    }
}

#[inline(always)]
fn prefetch<const TO_WRITE: bool>(value: &f32) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_ET0, _MM_HINT_T0, _mm_prefetch};
        let line = std::ptr::from_ref(value).cast();
        // SAFETY: a prefetch reads and writes nothing and cannot fault; the address is that of a reference.
        unsafe {
            if TO_WRITE {
                _mm_prefetch::<_MM_HINT_ET0>(line);
            } else {
                _mm_prefetch::<_MM_HINT_T0>(line);
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}
