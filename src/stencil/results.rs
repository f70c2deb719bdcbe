//! Writing what a step computes: through the cache, or past it.
//!
//! A line of memory that is written is read first, and takes the place of another. In a grid much larger than the cache it has left the cache
//! before anybody reads it again: written past the cache in one piece, it spares a third of what a step of the first order moves.

use fearless_simd::{Level, Simd, SimdBase};

use super::simd::Lanes;
use crate::grid::LeafValues;

/// Leaves from which on the results of a step go past the cache: 16 MiB. With a cache of 32 MiB a step costs a tenth more then at a quarter
/// of it, as much at half of it, and a tenth less at twice as many.
const PAST_CACHE_FROM: usize = 8192;

/// Writes the results of a step.
pub struct Results {
    past_cache: bool,
}

impl Results {
    /// For a step that writes so many leaves. What it reads before, instead of overwriting it, is in the cache anyway.
    pub fn new(leaves: usize, overwrites: bool) -> Self {
        Self { past_cache: cfg!(target_arch = "x86_64") && overwrites && leaves >= PAST_CACHE_FROM }
    }

    /// Whether they go past the cache.
    pub fn past_cache(&self) -> bool {
        self.past_cache
    }

    /// Writes rows (x, y) and (x, y + 1) of a leaf, y even.
    #[inline(always)]
    pub fn write<S: Simd>(&self, simd: S, leaf: &mut LeafValues, x: usize, y: usize, value: Lanes<S>) {
        let line = &mut leaf.0.as_chunks_mut::<16>().0[(x * 8 + y) / 2];
        if self.past_cache {
            write_past_cache(simd, line, value);
        } else {
            value.store_slice(line);
        }
    }
}

impl Drop for Results {
    fn drop(&mut self) {
        #[cfg(target_arch = "x86_64")]
        if self.past_cache {
            // SAFETY: SSE is part of the architecture.
            unsafe { std::arch::x86_64::_mm_sfence() };
        }
    }
}

/// `line` is one of a leaf, aligned to 64 bytes. In as few pieces as can be: they are put together outside the cache, in few buffers.
#[inline(always)]
fn write_past_cache<S: Simd>(simd: S, line: &mut [f32; 16], value: Lanes<S>) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{
            _mm_loadu_ps, _mm_stream_ps, _mm256_loadu_ps, _mm256_stream_ps, _mm512_loadu_ps, _mm512_stream_ps,
        };
        let mut values = [0.0; 16];
        value.store_slice(&mut values);
        let (from, to) = (values.as_ptr(), line.as_mut_ptr());
        debug_assert_eq!(to.addr() % 64, 0, "a line of a leaf is aligned");
        // SAFETY: both are sixteen values, aligned as each instruction asks, which is of the level that is in use. The fence that makes the
        // line visible to other threads comes when the `Results` of the page are dropped, before its task ends.
        unsafe {
            match simd.level() {
                Level::Avx512(_) => _mm512_stream_ps(to, _mm512_loadu_ps(from)),
                Level::Avx2(_) => {
                    _mm256_stream_ps(to, _mm256_loadu_ps(from));
                    _mm256_stream_ps(to.add(8), _mm256_loadu_ps(from.add(8)));
                }
                _ => {
                    for part in [0, 4, 8, 12] {
                        _mm_stream_ps(to.add(part), _mm_loadu_ps(from.add(part)));
                    }
                }
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        let _ = simd;
        value.store_slice(line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stencil::simd::{Isa, Work, choose, dispatch};

    struct Write<'a>(&'a Results, &'a mut LeafValues);

    impl Work for Write<'_> {
        fn run<S: Simd>(self, simd: S) {
            for x in 0..8 {
                for y in [0, 2, 4, 6] {
                    let values: [f32; 16] = std::array::from_fn(|lane| (x * 64 + y * 8 + lane) as f32);
                    self.0.write(simd, self.1, x, y, Lanes::from_slice(simd, &values));
                }
            }
        }
    }

    #[test]
    fn both_ways_write_the_same() {
        let best = choose(Isa::Avx512);
        for (leaves, overwrites) in [(1, true), (PAST_CACHE_FROM, true), (PAST_CACHE_FROM, false)] {
            for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
                choose(isa);
                let mut leaf = LeafValues::filled(-1.0);
                let results = Results::new(leaves, overwrites);
                dispatch(Write(&results, &mut leaf));
                drop(results);
                assert!(leaf.0.iter().enumerate().all(|(at, &value)| value == at as f32), "{isa:?}, {leaves} leaves");
            }
        }
        choose(best);
    }
}
