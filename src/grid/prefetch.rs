//! Bringing memory into the cache ahead of its use.

use super::leaf::LeafValues;
use super::paged::Paged;
use super::topology::Neighbours;

/// Values of a slab of a leaf, and of a cache line.
const SLAB: usize = 64;
const LINE: usize = 16;

/// Asks for the values within `reach` voxels (1 to 8) of a leaf across its faces in x and y, which lie farther away in memory than
/// the processor foresees. Those across the faces in z are the leaf's neighbours in memory as well.
#[inline(always)]
pub fn prefetch_faces(values: &Paged<LeafValues>, around: &Neighbours, reach: usize) {
    let (below, above) = (&values.get(around[4]).0, &values.get(around[22]).0);
    for at in (0..reach.min(8) * SLAB).step_by(LINE) {
        prefetch(&below[8 * SLAB - LINE - at]);
        prefetch(&above[at]);
    }
    let (below, above) = (&values.get(around[10]).0, &values.get(around[16]).0);
    for slab in (0..8 * SLAB).step_by(SLAB) {
        for at in (0..reach.min(8) * 8).step_by(LINE) {
            prefetch(&below[slab + SLAB - LINE - at]);
            prefetch(&above[slab + at]);
        }
    }
}

#[inline(always)]
fn prefetch(value: &f32) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a prefetch reads and writes nothing and cannot fault; the address is that of a reference.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}
