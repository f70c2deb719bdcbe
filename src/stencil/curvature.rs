//! Curvature of the level sets of φ along a row, second order.
//!
//! With unscaled central differences Dx = (φ₊ − φ₋)/2, Dxx = φ₊ − 2φ + φ₋, Dxy = (φ₊₊ − φ₊₋ − φ₋₊ + φ₋₋)/4,
//!
//! > 2H |Dφ|³ = Σ Dx²(Dyy + Dzz) − 2 Σ Dx Dy Dxy   (sums over the cyclic permutations; MATH 3.2)
//!
//! H = (κ₁ + κ₂)/2 = div(∇φ/|∇φ|)/2 is positive on convex parts (φ negative inside). Where the gradient vanishes
//! (the medial axis, flat parts beyond the band) the curvature is taken as 0.

use super::{Halo, Row};

/// Below this part of a voxel size, squared, a central difference counts as no gradient. A distance field has |Dφ| = 1 voxel size.
const FLAT_SQUARED: f32 = 1e-12;

/// Mean curvature and gradient norm of a row.
pub struct MeanCurvature {
    /// H in 1/world.
    pub mean: Row,
    /// |∇φ| by central differences, dimensionless.
    pub gradient: Row,
}

/// H (1/world) and central |∇φ| of row (x, y).
#[inline(always)]
pub fn mean_curvature(halo: &Halo<10>, x: usize, y: usize, voxel_size: f32) -> MeanCurvature {
    let at = |dx, dy, dz| halo.row(x, y, [dx, dy, dz]);
    let (c, xm, xp) = (at(0, 0, 0), at(-1, 0, 0), at(1, 0, 0));
    let (ym, yp, zm, zp) = (at(0, -1, 0), at(0, 1, 0), at(0, 0, -1), at(0, 0, 1));
    let (xmym, xmyp, xpym, xpyp) = (at(-1, -1, 0), at(-1, 1, 0), at(1, -1, 0), at(1, 1, 0));
    let (xmzm, xmzp, xpzm, xpzp) = (at(-1, 0, -1), at(-1, 0, 1), at(1, 0, -1), at(1, 0, 1));
    let (ymzm, ymzp, ypzm, ypzp) = (at(0, -1, -1), at(0, -1, 1), at(0, 1, -1), at(0, 1, 1));
    let inverse = 1.0 / voxel_size;
    let flat = FLAT_SQUARED * voxel_size * voxel_size;
    let mut out = MeanCurvature { mean: [0.0; 8], gradient: [0.0; 8] };
    for z in 0..8 {
        let (dx, dy, dz) = (0.5 * (xp[z] - xm[z]), 0.5 * (yp[z] - ym[z]), 0.5 * (zp[z] - zm[z]));
        let (dx2, dy2, dz2) = (dx * dx, dy * dy, dz * dz);
        let norm2 = dx2 + dy2 + dz2;
        let twice = c[z] + c[z];
        let (dxx, dyy, dzz) = (xp[z] + xm[z] - twice, yp[z] + ym[z] - twice, zp[z] + zm[z] - twice);
        let dxy = 0.25 * ((xpyp[z] - xpym[z]) - (xmyp[z] - xmym[z]));
        let dxz = 0.25 * ((xpzp[z] - xpzm[z]) - (xmzp[z] - xmzm[z]));
        let dyz = 0.25 * ((ypzp[z] - ypzm[z]) - (ymzp[z] - ymzm[z]));
        let alpha = dx2 * (dyy + dzz) + dy2 * (dxx + dzz) + dz2 * (dxx + dyy)
            - 2.0 * (dx * (dy * dxy + dz * dxz) + dy * dz * dyz);
        let norm = norm2.sqrt();
        let curved = norm2 > flat;
        // H = alpha / (2 |Dφ|³ dx); the quotient by the square first keeps small voxel sizes within f32.
        let mean = alpha / norm2 / (2.0 * norm) * inverse;
        out.mean[z] = if curved { mean } else { 0.0 };
        out.gradient[z] = norm * inverse;
    }
    out
}

/// Laplacian of a row: Δφ in 1/world.
#[inline(always)]
pub fn laplacian(halo: &Halo<10>, x: usize, y: usize, voxel_size: f32) -> Row {
    let at = |dx, dy, dz| halo.row(x, y, [dx, dy, dz]);
    let (c, xm, xp) = (at(0, 0, 0), at(-1, 0, 0), at(1, 0, 0));
    let (ym, yp, zm, zp) = (at(0, -1, 0), at(0, 1, 0), at(0, 0, -1), at(0, 0, 1));
    let inverse2 = 1.0 / (voxel_size * voxel_size);
    let mut out = [0.0; 8];
    for z in 0..8 {
        out[z] = ((xp[z] + xm[z]) + (yp[z] + ym[z]) + (zp[z] + zm[z]) - 6.0 * c[z]) * inverse2;
    }
    out
}
