//! Upwind |∇φ|² of a row: Godunov's choice among one-sided differences, first order or HJ-WENO5.
//!
//! For φ_t + S(|∇φ| − 1) = 0 with S of φ's sign, information flows away from the surface (MATH 1.1):
//!
//! > φ > 0:  |Dφ|² = Σ max( max(D⁻, 0)², min(D⁺, 0)² )
//! > φ ≤ 0:  |Dφ|² = Σ max( min(D⁻, 0)², max(D⁺, 0)² )
//!
//! HJ-WENO5 weighs three third-order one-sided differences by their smoothness (Jiang & Peng 2000; Shu's ICASE report
//! 97-65); fifth order where φ is smooth, and never worse than third order beside a kink.

use super::{Halo, Row, Star};

/// The one-sided differences in use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UpwindScheme {
    /// Two-point differences.
    #[default]
    First,
    /// Fifth-order weighted essentially non-oscillatory differences, six points.
    HjWeno5,
}

/// Godunov's |Dφ|² (unscaled) of row (x, y) by first-order differences.
#[inline(always)]
pub fn godunov_first(halo: &Halo<10>, x: usize, y: usize) -> Row {
    let star = Star::new(halo, x, y);
    let centre = star.at(0, 0);
    let mut out = [0.0; 8];
    for axis in 0..3 {
        let (before, after) = (star.at(axis, -1), star.at(axis, 1));
        for z in 0..8 {
            out[z] += godunov(centre[z], centre[z] - before[z], after[z] - centre[z]);
        }
    }
    out
}

/// Godunov's |Dφ|² (unscaled) of row (x, y) by HJ-WENO5 differences. `epsilon` as for [`weno5`].
#[inline(always)]
pub fn godunov_weno5(halo: &Halo<14>, x: usize, y: usize, epsilon: WenoEpsilon) -> Row {
    let star = Star::new(halo, x, y);
    let centre = star.at(0, 0);
    let mut out = [0.0; 8];
    for axis in 0..3 {
        let [m3, m2, m1, p1, p2, p3] = [-3, -2, -1, 1, 2, 3].map(|step| star.at(axis, step));
        for z in 0..8 {
            let v1 = m2[z] - m3[z];
            let v2 = m1[z] - m2[z];
            let v3 = centre[z] - m1[z];
            let v4 = p1[z] - centre[z];
            let v5 = p2[z] - p1[z];
            let v6 = p3[z] - p2[z];
            let before = weno5([v1, v2, v3, v4, v5], epsilon);
            let after = weno5([v6, v5, v4, v3, v2], epsilon);
            out[z] += godunov(centre[z], before, after);
        }
    }
    out
}

/// One axis of Godunov's |Dφ|², for a field that grows away from its zero set.
#[inline(always)]
fn godunov(phi: f32, before: f32, after: f32) -> f32 {
    // Inside, the mirrored field −φ obeys the outside rule.
    let sign = if phi > 0.0 { 1.0 } else { -1.0 };
    let (before, after) = (sign * before, sign * after);
    let a = before.max(0.0);
    let b = after.min(0.0);
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
    pub const SCALE_FREE: Self = Self { relative: 1e-6, absolute: 1e-18 };

    /// OpenVDB's absolute 1e-8 on unscaled differences: its results depend on the voxel size. For comparisons.
    pub const OPENVDB: Self = Self { relative: 0.0, absolute: 1e-8 };
}

/// HJ-WENO5 difference from five consecutive first differences, the upwind side first.
#[inline(always)]
pub fn weno5(v: [f32; 5], epsilon: WenoEpsilon) -> f32 {
    const C: f32 = 13.0 / 12.0;
    let [v1, v2, v3, v4, v5] = v;
    let mut floor = epsilon.absolute;
    if epsilon.relative > 0.0 {
        let largest = v.into_iter().fold(0.0f32, |m, d| m.max(d * d));
        floor += epsilon.relative * largest;
    }
    let smoothness = |second: f32, first: f32| C * (second * second) + 0.25 * (first * first) + floor;
    let s1 = smoothness(v1 - 2.0 * v2 + v3, v1 - 4.0 * v2 + 3.0 * v3);
    let s2 = smoothness(v2 - 2.0 * v3 + v4, v2 - v4);
    let s3 = smoothness(v3 - 2.0 * v4 + v5, 3.0 * v3 - 4.0 * v4 + v5);
    // Weights relative to the smoothest stencil: they stay within f32 for any voxel size.
    let least = s1.min(s2).min(s3);
    let weight = |linear: f32, s: f32| {
        let r = least / s;
        linear * (r * r)
    };
    let (a1, a2, a3) = (weight(0.1, s1), weight(0.6, s2), weight(0.3, s3));
    (a1 * (2.0 * v1 - 7.0 * v2 + 11.0 * v3) + a2 * (5.0 * v3 - v2 + 2.0 * v4) + a3 * (2.0 * v3 + 5.0 * v4 - v5))
        / (6.0 * (a1 + a2 + a3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weno5_is_fifth_order_on_smooth_data_and_exact_on_lines() {
        for epsilon in [WenoEpsilon::SCALE_FREE, WenoEpsilon::OPENVDB] {
            assert!((weno5([0.3; 5], epsilon) - 0.3).abs() < 1e-7);
        }
        assert_eq!(weno5([0.0; 5], WenoEpsilon::SCALE_FREE), 0.0);
        // First differences of sin at spacing h; the derivative at the point between the third and the fourth is cos.
        let error = |h: f64| {
            let f = |k: f64| (0.4 + k * h).sin();
            let v = [-3.0, -2.0, -1.0, 0.0, 1.0].map(|k| ((f(k + 1.0) - f(k)) / h) as f32);
            (f64::from(weno5(v, WenoEpsilon::SCALE_FREE)) - 0.4f64.cos()).abs()
        };
        // Halving h from 0.4 divides a fifth-order error by 32; rounding of f32 allows no finer spacing.
        assert!(error(0.4) < 0.4f64.powi(5) / 20.0 && error(0.2) < error(0.4) / 16.0, "{} {}", error(0.4), error(0.2));
    }

    #[test]
    fn godunov_looks_towards_the_surface() {
        // Outside a surface to the left: the difference behind counts, the one ahead does not.
        assert_eq!(godunov(1.0, 0.5, 0.7), 0.25);
        assert_eq!(godunov(-1.0, 0.5, 0.7), 0.7 * 0.7);
        // A ridge takes nothing, a valley the steeper side.
        assert_eq!(godunov(1.0, -0.5, 0.7), 0.0);
        assert_eq!(godunov(1.0, 0.5, -0.7), 0.7 * 0.7);
    }
}
