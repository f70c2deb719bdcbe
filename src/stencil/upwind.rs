//! Upwind |∇φ|² of a row: Godunov's choice among one-sided differences, first order or HJ-WENO5.
//!
//! For φ_t + F|∇φ| = … information comes from where φ is smaller if F > 0, and from where it is larger if F < 0:
//!
//! > F > 0:  |Dφ|² = Σ max( max(D⁻, 0)², min(D⁺, 0)² )
//! > F ≤ 0:  |Dφ|² = Σ max( min(D⁻, 0)², max(D⁺, 0)² )
//!
//! Renormalisation, φ_τ + S(|∇φ| − 1) = 0 with S of φ's sign, takes φ itself for F: information flows away from the surface.
//!
//! HJ-WENO5 weighs three third-order one-sided differences by their smoothness (Jiang & Peng 2000; Shu's ICASE report
//! 97-65); fifth order where φ is smooth, and never worse than third order beside a kink.

use fearless_simd::{Select, Simd, SimdBase, SimdMask};

use super::simd::Lanes;
use super::{LeafHalo, StarHalo};

/// The one-sided differences in use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UpwindScheme {
    /// Two-point differences.
    #[default]
    First,
    /// Fifth-order weighted essentially non-oscillatory differences, six points.
    HjWeno5,
}

/// Godunov's |Dφ|² (unscaled) of rows (x, y) and (x, y + 1) by first-order differences, upwind for a speed of `direction`'s sign.
#[inline(always)]
pub fn godunov_first<S: Simd>(simd: S, halo: &impl LeafHalo, x: usize, y: usize, direction: Lanes<S>) -> Lanes<S> {
    let centre = halo.centre(simd, x, y);
    let sign = mirror(simd, direction);
    let mut sum = Lanes::splat(simd, 0.0);
    for axis in 0..3 {
        let [before, after] = halo.beside(simd, x, y, axis);
        sum += godunov(simd, (centre - before) * sign, (after - centre) * sign);
    }
    sum
}

/// Godunov's |Dφ|² (unscaled) of rows (x, y) and (x, y + 1) by HJ-WENO5 differences, upwind for a speed of `direction`'s sign.
#[inline(always)]
pub fn godunov_weno5<S: Simd>(
    simd: S,
    halo: &StarHalo,
    x: usize,
    y: usize,
    direction: Lanes<S>,
    voxel_size: f32,
    epsilon: WenoEpsilon,
) -> Lanes<S> {
    let (centre, sign) = (halo.centre(simd, x, y), mirror(simd, direction));
    let scale = 1.0 / (voxel_size * voxel_size);
    godunov_weno5_axis(simd, centre, halo.along(simd, x, y, 0), sign, scale, epsilon)
        + godunov_weno5_axis(simd, centre, halo.along(simd, x, y, 1), sign, scale, epsilon)
        + godunov_weno5_axis(simd, centre, halo.along(simd, x, y, 2), sign, scale, epsilon)
}

/// One axis of Godunov's |Dφ|² by HJ-WENO5 differences, from the values at −3, −2, −1, 1, 2, 3.
#[inline(always)]
fn godunov_weno5_axis<S: Simd>(
    simd: S,
    centre: Lanes<S>,
    [m3, m2, m1, p1, p2, p3]: [Lanes<S>; 6],
    sign: Lanes<S>,
    scale: f32,
    epsilon: WenoEpsilon,
) -> Lanes<S> {
    let zero = Lanes::splat(simd, 0.0);
    let (v1, v2, v3) = ((m2 - m3) * sign, (m1 - m2) * sign, (centre - m1) * sign);
    let (v4, v5, v6) = ((p1 - centre) * sign, (p2 - p1) * sign, (p3 - p2) * sign);
    // A side counts only where its difference has the right sign. WENO5's is a mean of three candidates: where all of them have
    // the wrong one, so has it, and is not needed. Of a distance that is one side nearly everywhere.
    let (behind, ahead) = ([v1, v2, v3, v4, v5], [v6, v5, v4, v3, v2]);
    let ([a1, a2, a3], [b1, b2, b3]) = (candidates(behind), candidates(ahead));
    let (mut before, mut after) = (zero, zero);
    if a1.max(a2).max(a3).simd_gt(zero).any_true() {
        before = weno5(simd, behind, scale, epsilon);
    }
    if b1.min(b2).min(b3).simd_lt(zero).any_true() {
        after = weno5(simd, ahead, scale, epsilon);
    }
    godunov(simd, before, after)
}

/// 1 where the direction is positive, else −1: for F ≤ 0 the mirrored field −φ obeys the rule for F > 0.
#[inline(always)]
fn mirror<S: Simd>(simd: S, direction: Lanes<S>) -> Lanes<S> {
    direction.simd_gt(Lanes::splat(simd, 0.0)).select(Lanes::splat(simd, 1.0), Lanes::splat(simd, -1.0))
}

/// One axis of Godunov's |Dφ|² for F > 0.
#[inline(always)]
fn godunov<S: Simd>(simd: S, before: Lanes<S>, after: Lanes<S>) -> Lanes<S> {
    let zero = Lanes::splat(simd, 0.0);
    let (a, b) = (before.max(zero), after.min(zero));
    (a * a).max(b * b)
}

/// What keeps the smoothness weights of WENO5 finite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WenoEpsilon {
    relative: f32,
    absolute: f32,
}

impl WenoEpsilon {
    /// ε = 1e-6 · max(v²): the result does not depend on the voxel size.
    pub const SCALE_FREE: Self = Self { relative: 1e-6, absolute: 0.0 };

    /// OpenVDB's absolute 1e-8 on unscaled differences: its results depend on the voxel size. For comparisons.
    pub const OPENVDB: Self = Self { relative: 0.0, absolute: 1e-8 };
}

/// The least ε in squared voxel sizes: its fourth power is still a normal f32, so that weights as products stay above zero.
const LEAST_EPSILON: f32 = 1e-9;

/// HJ-WENO5 difference from five consecutive unscaled first differences, the upwind side first; `scale` is 1/dx².
#[inline(always)]
pub fn weno5<S: Simd>(simd: S, [v1, v2, v3, v4, v5]: [Lanes<S>; 5], scale: f32, epsilon: WenoEpsilon) -> Lanes<S> {
    let mut floor = Lanes::splat(simd, (epsilon.absolute * scale).max(LEAST_EPSILON));
    if epsilon.relative > 0.0 {
        let (a, b, c, d, e) = (v1 * v1, v2 * v2, v3 * v3, v4 * v4, v5 * v5);
        floor = floor.max(a.max(b).max(c.max(d)).max(e) * (epsilon.relative * scale));
    }
    let s1 = smoothness(v1 - v2 * 2.0 + v3, v1 - v2 * 4.0 + v3 * 3.0, scale, floor);
    let s2 = smoothness(v2 - v3 * 2.0 + v4, v2 - v4, scale, floor);
    let s3 = smoothness(v3 - v4 * 2.0 + v5, v3 * 3.0 - v4 * 4.0 + v5, scale, floor);
    // The weights γ/s² times (s₁s₂s₃)²: products instead of three quotients.
    let (p1, p2, p3) = (s2 * s3, s1 * s3, s1 * s2);
    let (a1, a2, a3) = (p1 * p1 * 0.1, p2 * p2 * 0.6, p3 * p3 * 0.3);
    let [d1, d2, d3] = candidates([v1, v2, v3, v4, v5]);
    (a1 * d1 + a2 * d2 + a3 * d3) / ((a1 + a2 + a3) * 6.0)
}

/// The third-order differences that HJ-WENO5 weighs, six times each.
#[inline(always)]
fn candidates<S: Simd>([v1, v2, v3, v4, v5]: [Lanes<S>; 5]) -> [Lanes<S>; 3] {
    [v1 * 2.0 - v2 * 7.0 + v3 * 11.0, v3 * 5.0 - v2 + v4 * 2.0, v3 * 2.0 + v4 * 5.0 - v5]
}

/// Smoothness of a third-order stencil in squared voxel sizes: large beside a kink.
#[inline(always)]
fn smoothness<S: Simd>(second: Lanes<S>, first: Lanes<S>, scale: f32, floor: Lanes<S>) -> Lanes<S> {
    second * second * (13.0 / 12.0 * scale) + first * first * (0.25 * scale) + floor
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stencil::simd::{Work, dispatch};

    /// Runs a kernel on equal lanes and hands over the first.
    fn lane(f: impl FnOnce(&mut dyn FnMut([f32; 5], WenoEpsilon) -> f32, &mut dyn FnMut([f32; 3]) -> f32)) {
        struct Run<F>(F);
        impl<F: FnOnce(&mut dyn FnMut([f32; 5], WenoEpsilon) -> f32, &mut dyn FnMut([f32; 3]) -> f32)> Work for Run<F> {
            fn run<S: Simd>(self, simd: S) {
                let splat = |v: f32| Lanes::splat(simd, v);
                self.0(&mut |v, e| weno5(simd, v.map(splat), 1.0, e)[0], &mut |[p, b, a]| {
                    let sign = mirror(simd, splat(p));
                    godunov(simd, splat(b) * sign, splat(a) * sign)[0]
                });
            }
        }
        dispatch(Run(f));
    }

    #[test]
    fn weno5_is_fifth_order_on_smooth_data_and_exact_on_lines() {
        lane(|weno5, _| {
            for epsilon in [WenoEpsilon::SCALE_FREE, WenoEpsilon::OPENVDB] {
                assert!((weno5([0.3; 5], epsilon) - 0.3).abs() < 1e-7);
            }
            assert_eq!(weno5([0.0; 5], WenoEpsilon::SCALE_FREE), 0.0);
            // First differences of sin at spacing h; the derivative at the point between the third and the fourth is cos.
            let mut error = |h: f64| {
                let f = |k: f64| (0.4 + k * h).sin();
                let v = [-3.0, -2.0, -1.0, 0.0, 1.0].map(|k| ((f(k + 1.0) - f(k)) / h) as f32);
                (f64::from(weno5(v, WenoEpsilon::SCALE_FREE)) - 0.4f64.cos()).abs()
            };
            // Halving h from 0.4 divides a fifth-order error by 32; rounding of f32 allows no finer spacing.
            let (coarse, fine) = (error(0.4), error(0.2));
            assert!(coarse < 0.4f64.powi(5) / 20.0 && fine < coarse / 16.0, "{coarse} {fine}");
        });
    }

    #[test]
    fn godunov_looks_towards_the_surface() {
        lane(|_, godunov| {
            // Outside a surface to the left: the difference behind counts, the one ahead does not.
            assert_eq!(godunov([1.0, 0.5, 0.7]), 0.25);
            assert_eq!(godunov([-1.0, 0.5, 0.7]), 0.7 * 0.7);
            // A ridge takes nothing, a valley the steeper side.
            assert_eq!(godunov([1.0, -0.5, 0.7]), 0.0);
            assert_eq!(godunov([1.0, 0.5, -0.7]), 0.7 * 0.7);
        });
    }
}
