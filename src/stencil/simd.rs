//! Which vector instructions kernels run on.
//!
//! Kernels are written once over `fearless_simd`'s sixteen-lane vectors, two rows of a leaf at a time, and compiled for
//! every instruction set; [`dispatch`] picks one at run time. No fused multiply-add, no reciprocal estimate and no
//! reordered sum is used, so every instruction set gives the same bits; a test compares them.

use std::sync::atomic::{AtomicU8, Ordering};

use fearless_simd::{Level, f32x16};
pub use fearless_simd::{Select, Simd, SimdBase};

/// Sixteen values: two rows of a leaf, z fastest.
pub type Lanes<S> = f32x16<S>;

/// One number in all lanes.
#[inline(always)]
pub fn splat<S: Simd>(simd: S, value: f64) -> Lanes<S> {
    Lanes::splat(simd, value as f32)
}

/// `magnitude`, negated where `sign` is below zero.
///
/// In place of `copysign`, which must not be used on lanes: for AVX-512, LLVM makes a ternary logic instruction of its bit operations,
/// and where one operand is folded into it from memory, it is given the truth table of another order of operands
/// (<https://github.com/llvm/llvm-project/issues/157929>; seen in a `select` of `copysign(x, y)` and `y`). Comparison and
/// negation are no such operations. Negative zero is not below zero.
#[inline(always)]
pub fn with_sign<S: Simd>(simd: S, magnitude: Lanes<S>, sign: Lanes<S>) -> Lanes<S> {
    sign.simd_lt(Lanes::splat(simd, 0.0)).select(-magnitude, magnitude)
}

/// An instruction set that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Isa {
    /// What every machine of the target has (SSE2 on x86-64, NEON on AArch64).
    Portable = 1,
    /// 256-bit vectors on x86-64.
    Avx2 = 2,
    /// 512-bit vectors on x86-64, as of Ice Lake.
    Avx512 = 3,
}

impl Isa {
    /// The best that this machine has.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let level = Level::new();
            if level.as_avx512().is_some() {
                return Self::Avx512;
            }
            if level.as_avx2().is_some() {
                return Self::Avx2;
            }
        }
        Self::Portable
    }

    fn level(self) -> Level {
        #[cfg(target_arch = "x86_64")]
        {
            let best = Level::new();
            let found = match self {
                Self::Portable => None,
                Self::Avx2 => best.as_avx2().map(Level::Avx2),
                Self::Avx512 => best.as_avx512().map(Level::Avx512),
            };
            found.unwrap_or(Level::baseline())
        }
        #[cfg(not(target_arch = "x86_64"))]
        Level::baseline()
    }
}

/// The choice in force: 0 until the first use.
static CHOSEN: AtomicU8 = AtomicU8::new(0);

/// The instruction set that [`dispatch`] uses.
pub fn chosen() -> Isa {
    match CHOSEN.load(Ordering::Relaxed) {
        1 => Isa::Portable,
        2 => Isa::Avx2,
        3 => Isa::Avx512,
        _ => choose(Isa::detect()),
    }
}

/// Chooses an instruction set for the whole process, or the best one below it that the machine has; returns the choice.
pub fn choose(isa: Isa) -> Isa {
    let isa = isa.min(Isa::detect());
    CHOSEN.store(isa as u8, Ordering::Relaxed);
    isa
}

/// A piece of work over vectors. `run` and all that it calls in its loops must be `#[inline(always)]`: what is not inlined
/// is compiled for the portable instruction set.
pub trait Work {
    /// Does the work.
    fn run<S: Simd>(self, simd: S);
}

/// Runs `work` with the [`chosen`] instruction set.
pub fn dispatch(work: impl Work) {
    fearless_simd::dispatch!(chosen().level(), simd => work.run(simd));
}

#[cfg(test)]
mod tests {
    use fearless_simd::{SimdMask, mask32x16};

    use super::*;

    /// What a sweep and the trimming of a band do with signs.
    struct Signs<'a> {
        found: &'a [f32; 16],
        old: &'a [f32; 16],
        bits: u16,
        out: &'a mut [[f32; 16]; 2],
        same: &'a mut u64,
    }

    const BACKGROUND: f32 = 2.0;

    impl Work for Signs<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let old = Lanes::from_slice(simd, self.old);
            let found = Lanes::from_slice(simd, self.found).min(old.abs());
            let free = mask32x16::from_bitmask(simd, u64::from(self.bits));
            let swept = free.select(with_sign(simd, found, old), old);
            swept.store_slice(&mut self.out[0]);
            *self.same = swept.simd_eq(old).to_bitmask();
            let background = Lanes::splat(simd, BACKGROUND);
            let outside = old.abs().simd_ge(background);
            outside.select(with_sign(simd, background, old), old).store_slice(&mut self.out[1]);
        }
    }

    #[test]
    fn signs_are_the_same_with_every_instruction_set() {
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as u32
        };
        for _ in 0..2000 {
            let mut value = || match random() % 8 {
                0 => 0.0,
                1 => -0.0,
                2 => BACKGROUND,
                _ => (random() as f32 / 8_388_608.0 - 1.0) * 5.0,
            };
            let found: [f32; 16] = std::array::from_fn(|_| value().abs());
            let old: [f32; 16] = std::array::from_fn(|_| value());
            let bits = random() as u16;
            let signed = |m: f32, v: f32| if v < 0.0 { -m } else { m };
            let swept: [f32; 16] = std::array::from_fn(|i| match bits >> i & 1 {
                1 => signed(found[i].min(old[i].abs()), old[i]),
                _ => old[i],
            });
            let trimmed = old.map(|v| if v.abs() >= BACKGROUND { signed(BACKGROUND, v) } else { v });
            let equal = (0..16).map(|i| u64::from(swept[i] == old[i]) << i).sum::<u64>();
            for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
                let (mut out, mut same) = ([[0.0; 16]; 2], 0);
                let work = Signs { found: &found, old: &old, bits, out: &mut out, same: &mut same };
                fearless_simd::dispatch!(isa.level(), simd => work.run(simd));
                // Bits: zeros of different sign are equal.
                let bits_of = |values: [[f32; 16]; 2]| values.map(|half| half.map(f32::to_bits));
                assert_eq!(
                    (bits_of(out), same),
                    (bits_of([swept, trimmed]), equal),
                    "{isa:?} {found:?} {old:?} {bits:x}"
                );
            }
        }
    }
}
