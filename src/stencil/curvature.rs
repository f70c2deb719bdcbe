//! Curvature of the level sets of φ, second order.
//!
//! With unscaled central differences Dx = (φ₊ − φ₋)/2, Dxx = φ₊ − 2φ + φ₋, Dxy = (φ₊₊ − φ₊₋ − φ₋₊ + φ₋₋)/4,
//!
//! > 2H |Dφ|³ = Σ Dx²(Dyy + Dzz) − 2 Σ Dx Dy Dxy   (sums over the cyclic permutations)
//!
//! H = (κ₁ + κ₂)/2 = div(∇φ/|∇φ|)/2 is positive on convex parts (φ negative inside). Where the gradient vanishes
//! (the medial axis, flat parts beyond the band) the curvature is taken as 0.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::simd::Lanes;
use super::{Halo, LeafHalo};

/// Below this part of a voxel size, squared, a central difference counts as no gradient. A distance field has |Dφ| = 1 voxel size.
const FLAT_SQUARED: f32 = 1e-12;

/// Mean curvature and gradient norm.
pub struct MeanCurvature<S: Simd> {
    /// H in 1/world.
    pub mean: Lanes<S>,
    /// |∇φ| by central differences, dimensionless.
    pub gradient: Lanes<S>,
    /// H|∇φ| in 1/world, without a root.
    pub motion: Lanes<S>,
}

/// H (1/world) and central |∇φ| of rows (x, y) and (x, y + 1).
#[inline(always)]
pub fn mean_curvature<S: Simd>(simd: S, halo: &Halo, x: usize, y: usize, voxel_size: f32) -> MeanCurvature<S> {
    macro_rules! at {
        ($dx:expr, $dy:expr, $dz:expr) => {
            halo.rows(simd, x, y, [$dx, $dy, $dz])
        };
    }
    let (c, xm, xp) = (at!(0, 0, 0), at!(-1, 0, 0), at!(1, 0, 0));
    let (ym, yp, zm, zp) = (at!(0, -1, 0), at!(0, 1, 0), at!(0, 0, -1), at!(0, 0, 1));
    let (dx, dy, dz) = ((xp - xm) * 0.5, (yp - ym) * 0.5, (zp - zm) * 0.5);
    let (dx2, dy2, dz2) = (dx * dx, dy * dy, dz * dz);
    let norm2 = dx2 + dy2 + dz2;
    let twice = c + c;
    let (dxx, dyy, dzz) = (xp + xm - twice, yp + ym - twice, zp + zm - twice);
    let dxy = ((at!(1, 1, 0) - at!(1, -1, 0)) - (at!(-1, 1, 0) - at!(-1, -1, 0))) * 0.25;
    let dxz = ((at!(1, 0, 1) - at!(1, 0, -1)) - (at!(-1, 0, 1) - at!(-1, 0, -1))) * 0.25;
    let dyz = ((at!(0, 1, 1) - at!(0, 1, -1)) - (at!(0, -1, 1) - at!(0, -1, -1))) * 0.25;
    let alpha =
        dx2 * (dyy + dzz) + dy2 * (dxx + dzz) + dz2 * (dxx + dyy) - (dx * (dy * dxy + dz * dxz) + dy * dz * dyz) * 2.0;
    let norm = norm2.sqrt();
    let curved = norm2.simd_gt(FLAT_SQUARED * voxel_size * voxel_size);
    // One quotient: |Dφ|³ dx is at most the fourth power of a voxel size, which f32 holds from 1e-9 to 1e9.
    let mean = alpha / (norm2 * norm * (2.0 * voxel_size));
    let motion = alpha / (norm2 * (2.0 * voxel_size * voxel_size));
    let zero = Lanes::splat(simd, 0.0);
    MeanCurvature {
        mean: curved.select(mean, zero),
        gradient: norm * (1.0 / voxel_size),
        motion: curved.select(motion, zero),
    }
}

/// Laplacian: Δφ in 1/world.
#[inline(always)]
pub fn laplacian<S: Simd>(simd: S, halo: &impl LeafHalo, x: usize, y: usize, voxel_size: f32) -> Lanes<S> {
    let ([xm, xp], [ym, yp], [zm, zp]) =
        (halo.beside(simd, x, y, 0), halo.beside(simd, x, y, 1), halo.beside(simd, x, y, 2));
    let sum = (xp + xm) + (yp + ym) + (zp + zm);
    (sum - halo.centre(simd, x, y) * 6.0) * (1.0 / (voxel_size * voxel_size))
}
