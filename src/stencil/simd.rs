//! Runs kernels compiled for the widest instruction set of the machine.
//!
//! A kernel is plain Rust marked `#[inline(always)]`; [`dispatch`] inlines it into functions compiled with AVX2 and
//! AVX-512 and picks one at run time. Rust never contracts a·b + c into a fused multiply-add nor reorders sums, so every
//! instruction set gives the same bits; a test compares them.
//!
//! This file holds the only `unsafe` outside `vdb`: calling a function that needs an instruction set after finding out
//! that the machine has it.

use std::sync::atomic::{AtomicU8, Ordering};

/// An instruction set that kernels can be compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Isa {
    /// What every machine of the target has (SSE2 on x86-64).
    Portable = 1,
    /// 256-bit vectors.
    Avx2 = 2,
    /// 512-bit registers and masks.
    Avx512 = 3,
}

impl Isa {
    /// The best that this machine has.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
            {
                return Self::Avx512;
            }
            if is_x86_feature_detected!("avx2") {
                return Self::Avx2;
            }
        }
        Self::Portable
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
        _ => {
            let isa = Isa::detect();
            CHOSEN.store(isa as u8, Ordering::Relaxed);
            isa
        }
    }
}

/// Chooses an instruction set for the whole process, or the best one below it that the machine has; returns the choice.
pub fn choose(isa: Isa) -> Isa {
    let isa = isa.min(Isa::detect());
    CHOSEN.store(isa as u8, Ordering::Relaxed);
    isa
}

/// A piece of work to be compiled for several instruction sets. `run` and all that it calls in its loops must be
/// `#[inline(always)]`, or they are compiled for the portable set only (slow, never wrong).
pub trait Work {
    /// Does the work.
    fn run(self);
}

/// Runs `work` with the [`chosen`] instruction set.
pub fn dispatch(work: impl Work) {
    #[cfg(target_arch = "x86_64")]
    match chosen() {
        // SAFETY: `chosen` never exceeds what `Isa::detect` found on this machine.
        Isa::Avx512 => unsafe { run_avx512(work) },
        // SAFETY: as above.
        Isa::Avx2 => unsafe { run_avx2(work) },
        Isa::Portable => work.run(),
    }
    #[cfg(not(target_arch = "x86_64"))]
    work.run();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq")]
fn run_avx512(work: impl Work) {
    work.run();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn run_avx2(work: impl Work) {
    work.run();
}
