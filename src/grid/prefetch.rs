//! Bringing memory into the cache ahead of its use.

use super::leaf::LeafValues;
use super::paged::Paged;
use super::topology::Neighbours;

/// Values of a slab of a leaf, and of a cache line.
const SLAB: usize = 64;
const LINE: usize = 16;

/// Asks for what a stencil that reaches `reach` voxels (1 to 8) along the axes will read around a leaf: the values across its faces
/// in x and y, and all of the leaf above it in z, whose rows begin with what is read. The leaf itself and the one below were read
/// before as neighbours in z of the leaves below, as leaves mostly come in the order of their origins.
#[inline(always)]
pub fn prefetch_faces(values: &Paged<LeafValues>, around: &Neighbours, reach: usize) {
    let (below, above) = (&values.get(around[4]).0, &values.get(around[22]).0);
    for at in (0..reach.min(8) * SLAB).step_by(LINE) {
        prefetch(&below[8 * SLAB - LINE - at]);
        prefetch(&above[at]);
    }
    let next = &values.get(around[14]).0;
    for at in (0..next.len()).step_by(LINE) {
        prefetch(&next[at]);
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
