//! Interpolation by radial basis functions, with a polynomial of first degree and smoothing (Carr et al. 2001; Brodersen et al. 2007, section 3).
//!
//! > s(x) = Σ ωᵢ φ(|x − pᵢ|) + R x + t,  Σ ωᵢ = 0,  Σ ωᵢ pᵢᵀ = 0
//!
//! so that affine functions are reproduced. With Q the matrix of the polynomial at the points,
//!
//! > (sA + Λ) ω + s Q ρ = s k,  Qᵀω = 0,  A_ij = φ(|pᵢ − pⱼ|)
//!
//! s = −1 for φ = r, which is conditionally *negative* definite, 1 for r³ and Wendland's function: sA + Λ is positive definite where Qᵀω = 0, so
//! every λ ≥ 0 can be solved. (The paper adds λ to A with φ = r, which is singular where λ meets an eigenvalue.) Householder reflections of Q's
//! columns take A to that subspace, where it is solved by Cholesky's decomposition: n³/3 operations, and no decomposition where points coincide.
//!
//! Lengths are divided by a unit, of which λ is a multiple.

use glam::DVec3;
use nalgebra::{DMatrix, DVector};

/// What a point contributes at a distance r, in units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Basis {
    /// r.
    Linear,
    /// r³.
    Cubic,
    /// Wendland's C² function (1 − r/R)⁴ (4 r/R + 1) up to the distance R.
    Wendland(f64),
}

impl Basis {
    /// The sign that makes it positive definite.
    fn sign(self) -> f64 {
        if self == Self::Linear { -1.0 } else { 1.0 }
    }

    fn at(self, squared: f64) -> f64 {
        match self {
            Self::Linear => squared.sqrt(),
            Self::Cubic => squared * squared.sqrt(),
            Self::Wendland(reach) => {
                let q = squared.sqrt() / reach;
                if q < 1.0 { (1.0 - q).powi(4) * (4.0 * q + 1.0) } else { 0.0 }
            }
        }
    }
}

/// Least extent of points across a plane, as a part of their extent along it, for a linear polynomial.
const SPANNING: f64 = 1e-3;

/// A smooth vector function through values at points.
#[derive(Clone, Debug)]
pub struct Interpolant {
    centre: DVec3,
    unit: f64,
    basis: Basis,
    /// In units around the centre.
    points: Vec<DVec3>,
    weights: Vec<DVec3>,
    /// t and the columns of R.
    polynomial: [DVec3; 4],
}

impl Interpolant {
    /// Through `values` at `points`, but for a smoothing λᵢ ≥ 0 a point (0 interpolates), distances in multiples of `unit`. `None` where points coincide or
    /// the numbers are not finite. Where the points lie in a plane, or are fewer than four, t alone stands beside the sum.
    pub fn new(
        points: &[DVec3],
        values: &[DVec3],
        smoothing: impl Fn(usize) -> f64,
        basis: Basis,
        unit: f64,
    ) -> Option<Self> {
        let n = points.len();
        if n == 0 || values.len() != n || !(unit > 0.0 && unit.is_finite()) {
            return None;
        }
        let centre = points.iter().sum::<DVec3>() / n as f64;
        let points: Vec<DVec3> = points.iter().map(|p| (p - centre) / unit).collect();
        let extents = DMatrix::from_fn(n, 3, |i, axis| points[i][axis]).singular_values();
        let (least, most) = extents.iter().fold((f64::INFINITY, 0.0f64), |(l, m), &s| (l.min(s), m.max(s)));
        let columns = if n > 4 && least > SPANNING * most { 4 } else { 1 };
        let polynomial = |i: usize, k: usize| if k == 0 { 1.0 } else { points[i][k - 1] };
        let mut q = DMatrix::from_fn(n, columns, polynomial);
        let sign = basis.sign();
        let mut matrix = DMatrix::from_fn(n, n, |i, j| {
            let smooth = if i == j { smoothing(i) } else { 0.0 };
            sign * basis.at(points[i].distance_squared(points[j])) + smooth
        });
        let mut right = DMatrix::from_fn(n, 3, |i, axis| sign * values[i][axis]);
        // H = 1 − 2vvᵀ takes a column of Q to one entry, and A to HAH.
        let mut reflections = Vec::with_capacity(columns);
        for k in 0..columns.min(n) {
            let mut v = DVector::from_fn(n, |i, _| if i < k { 0.0 } else { q[(i, k)] });
            let length = v.norm();
            v[k] += if v[k] < 0.0 { -length } else { length };
            let norm = v.norm();
            if norm.is_nan() || norm <= 0.0 {
                return None;
            }
            v /= norm;
            let reflect = |m: &mut DMatrix<f64>| {
                let along = m.tr_mul(&v);
                for (mut column, a) in m.column_iter_mut().zip(along.iter()) {
                    column.axpy(-2.0 * a, &v, 1.0);
                }
            };
            reflect(&mut q);
            reflect(&mut right);
            reflect(&mut matrix);
            matrix.transpose_mut();
            reflect(&mut matrix);
            reflections.push(v);
        }
        let inner = n - columns;
        let mut weights = DMatrix::zeros(n, 3);
        if inner > 0 {
            let lower = matrix.view((columns, columns), (inner, inner)).into_owned();
            let solved = lower.cholesky()?.solve(&right.rows(columns, inner).into_owned());
            weights.rows_mut(columns, inner).copy_from(&solved);
        }
        let rest = right.rows(0, columns) - matrix.view((0, columns), (columns, inner)) * weights.rows(columns, inner);
        let upper = q.view((0, 0), (columns, columns)).into_owned() * sign;
        let solved = upper.solve_upper_triangular(&rest)?;
        for v in reflections.iter().rev() {
            let along = weights.tr_mul(v);
            for (mut column, a) in weights.column_iter_mut().zip(along.iter()) {
                column.axpy(-2.0 * a, v, 1.0);
            }
        }
        let row = |m: &DMatrix<f64>, i: usize| DVec3::new(m[(i, 0)], m[(i, 1)], m[(i, 2)]);
        let polynomial = std::array::from_fn(|k| if k < columns { row(&solved, k) } else { DVec3::ZERO });
        let weights: Vec<DVec3> = (0..n).map(|i| row(&weights, i)).collect();
        let finite = weights.iter().chain(&polynomial).all(|w| w.is_finite());
        finite.then_some(Self { centre, unit, basis, points, weights, polynomial })
    }

    /// The value at a point: a sum over all points.
    pub fn at(&self, x: DVec3) -> DVec3 {
        let x = (x - self.centre) / self.unit;
        let [t, a, b, c] = self.polynomial;
        let sum = match self.basis {
            Basis::Linear => self.sum(x, |squared| Basis::Linear.at(squared)),
            Basis::Cubic => self.sum(x, |squared| Basis::Cubic.at(squared)),
            Basis::Wendland(reach) => self.sum(x, |squared| Basis::Wendland(reach).at(squared)),
        };
        sum + a * x.x + b * x.y + c * x.z + t
    }

    /// Points that a value is a sum over.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points at which the sum has a kink, and the slopes of the cones a·|x − p| that they add to it.
    pub fn cones(&self) -> impl Iterator<Item = (DVec3, DVec3)> + '_ {
        let has = self.basis == Basis::Linear;
        let all = self.points.iter().zip(&self.weights).filter(move |_| has);
        all.map(|(p, w)| (self.centre + *p * self.unit, *w / self.unit))
    }

    #[inline(always)]
    fn sum(&self, x: DVec3, kernel: impl Fn(f64) -> f64) -> DVec3 {
        self.points.iter().zip(&self.weights).map(|(p, w)| *w * kernel(p.distance_squared(x))).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scattered(n: usize) -> Vec<DVec3> {
        let unit = |i: usize, a: f64| (i as f64 * a).fract();
        (0..n).map(|i| DVec3::new(unit(i, 0.754_877_67), unit(i, 0.569_840_29), unit(i, 0.819_172_51)) * 6.0).collect()
    }

    const BASES: [Basis; 3] = [Basis::Linear, Basis::Cubic, Basis::Wendland(3.0)];

    #[test]
    fn affine_functions_are_reproduced_for_every_smoothing() {
        let points = scattered(120);
        let affine = |p: DVec3| DVec3::new(2.0 * p.x - p.z + 1.0, p.y, 0.3 * p.x + p.y - p.z);
        let values: Vec<DVec3> = points.iter().map(|p| affine(*p)).collect();
        for basis in BASES {
            for lambda in [0.0, 0.005, 0.3] {
                let s = Interpolant::new(&points, &values, |_| lambda, basis, 1.0).unwrap();
                for x in [DVec3::ZERO, DVec3::splat(2.5), DVec3::new(9.0, -1.0, 4.0)] {
                    assert!(s.at(x).distance(affine(x)) < 1e-11, "{basis:?} {lambda} {}", s.at(x) - affine(x));
                }
            }
        }
    }

    #[test]
    fn values_are_met_without_smoothing_and_missed_by_more_with_more() {
        let points = scattered(160);
        let bent = |p: DVec3| DVec3::new((p.x * 0.8).sin(), (p.y - p.x).cos(), p.z * p.z * 0.1);
        let values: Vec<DVec3> = points.iter().map(|p| bent(*p)).collect();
        for basis in BASES {
            // The printed sign is singular at eigenvalues of A, from 0.1 on for this spacing; this one never is.
            let residuals = [0.0, 0.001, 0.01, 0.05, 0.1, 0.2, 0.5].map(|lambda| {
                let s = Interpolant::new(&points, &values, |_| lambda, basis, 1.0).unwrap();
                let squared: f64 = points.iter().zip(&values).map(|(p, v)| s.at(*p).distance_squared(*v)).sum();
                (squared / points.len() as f64).sqrt()
            });
            assert!(residuals[0] < 1e-10, "{basis:?} {residuals:?}");
            assert!(residuals.is_sorted() && residuals[6] > 1e-3, "{basis:?} {residuals:?}");
        }
    }

    #[test]
    fn residuals_are_those_of_the_reference() {
        // 9 × 9 × 4 particles over a cap of radius 3, which waves by 0.02.
        let mut points = Vec::new();
        let mut values = Vec::new();
        for k in 0..4 {
            for i in 0..9 {
                for j in 0..9 {
                    let [u, v, w] = [f64::from(i) / 8.0, f64::from(j) / 8.0, f64::from(k) / 3.0];
                    let (a, b) = ((u - 0.5) * 0.8, (v - 0.5) * 0.8);
                    let radius = 3.0 + 0.02 * (9.0 * u).sin() * (7.0 * v).cos() + 0.6 * w;
                    points.push(DVec3::new(a.sin() * b.cos(), b.sin(), a.cos() * b.cos()) * radius);
                    values.push(DVec3::new(u, v, w));
                }
            }
        }
        for (lambda, expected) in
            [(0.001, 2.6e-5), (0.01, 2.6e-4), (0.05, 1.2e-3), (0.1, 2.2e-3), (0.2, 3.9e-3), (0.5, 7.7e-3)]
        {
            let s = Interpolant::new(&points, &values, |_| lambda, Basis::Linear, 1.0).unwrap();
            let squared: f64 = points.iter().zip(&values).map(|(p, v)| s.at(*p).distance_squared(*v)).sum();
            let residual = (squared / (3 * points.len()) as f64).sqrt();
            assert!((residual / expected - 1.0).abs() < 0.05, "{lambda}: {residual:e}");
        }
    }

    #[test]
    fn lengths_do_not_matter_in_units() {
        let points = scattered(60);
        let values: Vec<DVec3> = points.iter().map(|p| DVec3::new(p.y, p.z, p.x) * p.x).collect();
        let s = Interpolant::new(&points, &values, |_| 0.3, Basis::Linear, 1.0).unwrap();
        for scale in [100.0, 0.01] {
            let far: Vec<DVec3> = points.iter().map(|p| *p * scale + DVec3::new(7.0, -3.0, 40.0)).collect();
            let t = Interpolant::new(&far, &values, |_| 0.3, Basis::Linear, scale).unwrap();
            let x = DVec3::new(1.0, 2.0, 3.0);
            assert!(t.at(x * scale + DVec3::new(7.0, -3.0, 40.0)).distance(s.at(x)) < 1e-9);
        }
    }

    #[test]
    fn points_that_coincide_cannot_be_solved() {
        let mut points = scattered(20);
        points[7] = points[3];
        let values = vec![DVec3::X; 20];
        assert!(Interpolant::new(&points, &values, |_| 0.0, Basis::Cubic, 1.0).is_none());
        assert!(Interpolant::new(&[], &[], |_| 0.0, Basis::Linear, 1.0).is_none());
        // In a plane a constant stands alone.
        let flat: Vec<DVec3> = scattered(20).iter().map(|p| p.with_z(1.0)).collect();
        let s = Interpolant::new(&flat, &values, |_| 0.0, Basis::Linear, 1.0).unwrap();
        assert!(s.at(DVec3::splat(50.0)).distance(DVec3::X) < 1e-9);
    }
}
