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

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};

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
/// Lanes without a bit in `bits` are not wanted and hold anything.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "a kernel's operands")]
pub fn godunov_weno5<S: Simd>(
    simd: S,
    halo: &StarHalo,
    x: usize,
    y: usize,
    bits: u16,
    direction: Lanes<S>,
    voxel_size: f32,
    epsilon: WenoEpsilon,
) -> Lanes<S> {
    let wanted = mask32x16::from_bitmask(simd, u64::from(bits));
    // The mirror and the unit of differences in one factor: they are in voxel sizes.
    let (centre, unit) = (halo.centre(simd, x, y), mirror(simd, direction) * (1.0 / voxel_size));
    let weno = Weno5::new(epsilon, voxel_size);
    let sum = godunov_weno5_axis(simd, centre, halo.along(simd, x, y, 0), wanted, unit, weno)
        + godunov_weno5_axis(simd, centre, halo.along(simd, x, y, 1), wanted, unit, weno)
        + godunov_weno5_axis(simd, centre, halo.along(simd, x, y, 2), wanted, unit, weno);
    sum * (voxel_size * voxel_size)
}

/// V·Dφ (unscaled) of rows (x, y) and (x, y + 1) by first-order differences, taken on each axis from where V comes.
#[inline(always)]
pub fn transport_first<S: Simd>(
    simd: S,
    halo: &impl LeafHalo,
    x: usize,
    y: usize,
    velocity: [Lanes<S>; 3],
) -> Lanes<S> {
    let (centre, zero) = (halo.centre(simd, x, y), Lanes::splat(simd, 0.0));
    let mut sum = zero;
    for (axis, v) in velocity.into_iter().enumerate() {
        let [before, after] = halo.beside(simd, x, y, axis);
        sum += v.max(zero) * (centre - before) + v.min(zero) * (after - centre);
    }
    sum
}

/// V·Dφ (unscaled) of rows (x, y) and (x, y + 1) by HJ-WENO5 differences, taken on each axis from where V comes.
#[inline(always)]
pub fn transport_weno5<S: Simd>(
    simd: S,
    halo: &StarHalo,
    x: usize,
    y: usize,
    velocity: [Lanes<S>; 3],
    voxel_size: f32,
    epsilon: WenoEpsilon,
) -> Lanes<S> {
    let (centre, zero) = (halo.centre(simd, x, y), Lanes::splat(simd, 0.0));
    let (weno, unit) = (Weno5::new(epsilon, voxel_size), 1.0 / voxel_size);
    let mut sum = zero;
    for (axis, v) in velocity.into_iter().enumerate() {
        let [m3, m2, m1, p1, p2, p3] = halo.along(simd, x, y, axis);
        let (v1, v2, v3) = ((m2 - m3) * unit, (m1 - m2) * unit, (centre - m1) * unit);
        let (v4, v5, v6) = ((p1 - centre) * unit, (p2 - p1) * unit, (p3 - p2) * unit);
        let (behind, ahead) = (Side::new([v1, v2, v3, v4, v5]), Side::new([v6, v5, v4, v3, v2]));
        sum += v * weno.difference(simd, &behind.select(v.simd_gt(zero), &ahead));
    }
    sum * voxel_size
}

/// One axis of Godunov's |Dφ|² by HJ-WENO5 differences, from the values at −3, −2, −1, 1, 2, 3.
#[inline(always)]
fn godunov_weno5_axis<S: Simd>(
    simd: S,
    centre: Lanes<S>,
    [m3, m2, m1, p1, p2, p3]: [Lanes<S>; 6],
    wanted: mask32x16<S>,
    unit: Lanes<S>,
    weno: Weno5,
) -> Lanes<S> {
    let zero = Lanes::splat(simd, 0.0);
    let (v1, v2, v3) = ((m2 - m3) * unit, (m1 - m2) * unit, (centre - m1) * unit);
    let (v4, v5, v6) = ((p1 - centre) * unit, (p2 - p1) * unit, (p3 - p2) * unit);
    let (behind, ahead) = (Side::new([v1, v2, v3, v4, v5]), Side::new([v6, v5, v4, v3, v2]));
    // A side counts only where its difference has the right sign. WENO5's is a mean of three candidates: where all of them have
    // the wrong one, so has it, and is not needed. Of a distance that is one side nearly everywhere: each lane computes the
    // one that counts, and the other is computed only where a lane needs both.
    let from_behind = behind.candidates[0].max(behind.candidates[1]).max(behind.candidates[2]).simd_gt(zero);
    let from_ahead = ahead.candidates[0].min(ahead.candidates[1]).min(ahead.candidates[2]).simd_lt(zero);
    let one = weno.difference(simd, &behind.select(from_behind, &ahead));
    let mut other = zero;
    if (from_behind & from_ahead & wanted).any_true() {
        other = weno.difference(simd, &ahead);
    }
    godunov(simd, from_behind.select(one, zero), from_behind.select(other, one))
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

/// What one-sided WENO5 reads: five consecutive first differences, the upwind side first.
struct Side<S: Simd> {
    /// The differences, in voxel sizes.
    first: [Lanes<S>; 5],
    /// Six times the third-order differences that WENO5 weighs: (2v₁ − 7v₂ + 11v₃), (−v₂ + 5v₃ + 2v₄), (2v₃ + 5v₄ − v₅).
    candidates: [Lanes<S>; 3],
}

impl<S: Simd> Side<S> {
    #[inline(always)]
    fn new([v1, v2, v3, v4, v5]: [Lanes<S>; 5]) -> Self {
        let candidates = [v1 * 2.0 - v2 * 7.0 + v3 * 11.0, v3 * 5.0 - v2 + v4 * 2.0, v3 * 2.0 + v4 * 5.0 - v5];
        Self { first: [v1, v2, v3, v4, v5], candidates }
    }

    /// This side where `mask` is set, the other elsewhere.
    #[inline(always)]
    fn select(&self, mask: mask32x16<S>, other: &Self) -> Self {
        macro_rules! each {
            ($field:ident: $($i:literal)*) => {
                [$(mask.select(self.$field[$i], other.$field[$i])),*]
            };
        }
        Self { first: each!(first: 0 1 2 3 4), candidates: each!(candidates: 0 1 2) }
    }
}

/// The fifth-order weighted difference.
#[derive(Clone, Copy)]
struct Weno5 {
    /// ε in squared voxel sizes.
    least: f32,
    relative: f32,
}

impl Weno5 {
    #[inline(always)]
    fn new(epsilon: WenoEpsilon, voxel_size: f32) -> Self {
        let scale = 1.0 / (voxel_size * voxel_size);
        Self { least: (epsilon.absolute * scale).max(LEAST_EPSILON), relative: epsilon.relative }
    }

    /// The mean of the candidates with the weights γₖ/(ε + βₖ)², γ = 0.1, 0.6, 0.3.
    #[inline(always)]
    fn difference<S: Simd>(self, simd: S, side: &Side<S>) -> Lanes<S> {
        let [v1, v2, v3, v4, v5] = side.first;
        let mut floor = Lanes::splat(simd, 4.0 * self.least);
        if self.relative > 0.0 {
            let (a, b, c, d, e) = (v1 * v1, v2 * v2, v3 * v3, v4 * v4, v5 * v5);
            floor = floor.max(a.max(b).max(c.max(d)).max(e) * (4.0 * self.relative));
        }
        // Four times ε + βₖ: β₁ = 13/12 (v₁ − 2v₂ + v₃)² + ¼ (v₁ − 4v₂ + 3v₃)² and so on, by second differences.
        let (e1, e2, e3, e4) = (v2 - v1, v3 - v2, v4 - v3, v5 - v4);
        let s1 = smoothness(e2 - e1, e2 * 3.0 - e1, floor);
        let s2 = smoothness(e3 - e2, e3 + e2, floor);
        let s3 = smoothness(e4 - e3, e3 * 3.0 - e4, floor);
        // The weights γ/s² times (s₁s₂s₃)²: products instead of three quotients.
        let (p1, p2, p3) = (s2 * s3, s1 * s3, s1 * s2);
        let (a1, a2, a3) = (p1 * p1 * 0.1, p2 * p2 * 0.6, p3 * p3 * 0.3);
        let [d1, d2, d3] = side.candidates;
        (a1 * d1 + a2 * d2 + a3 * d3) / ((a1 + a2 + a3) * 6.0)
    }
}

/// Four times the smoothness of a third-order stencil, and `floor`: large beside a kink.
#[inline(always)]
fn smoothness<S: Simd>(second: Lanes<S>, first: Lanes<S>, floor: Lanes<S>) -> Lanes<S> {
    second * second * (13.0 / 3.0) + first * first + floor
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
                self.0(
                    &mut |v, e| Weno5::new(e, 1.0).difference(simd, &Side::new(v.map(splat)))[0],
                    &mut |[p, b, a]| {
                        let sign = mirror(simd, splat(p));
                        godunov(simd, splat(b) * sign, splat(a) * sign)[0]
                    },
                );
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
