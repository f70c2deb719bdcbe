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
