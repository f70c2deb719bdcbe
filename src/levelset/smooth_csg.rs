//! Constructive solid geometry whose edges are rounded: functions of the distances of the operands, negative inside.
//!
//! For a union of f₁, f₂, …:
//!
//! | form | union | edge |
//! |---|---|---|
//! | super-elliptic (Rockwood 1989) | R (1 − (Σ max(0, 1 − fᵢ/R)ᵗ)^(1/t)), R = r c/(1 − 2^(−1/t)) | exact where all others are at least R away |
//! | exponential (Blinn 1982) | −ln(Σ exp(−k fᵢ))/k, k = ln 2/(r c) | falls off as exp(−k f) |
//! | hyperbolic | (f₁ + f₂ − √((f₁ − f₂)² + 4k²))/2, k = r c; pair by pair | falls off as k²/f |
//! | R-function (Rvachev 1982) | (f₁ + f₂ − √(f₁² + f₂² − 2α f₁ f₂))/(1 + α) · (f₁² + f₂²)^(n/2); pair by pair | stays sharp: only the field off the surface is smooth |
//!
//! with c = 1 − 1/√2: all of them put the surface at the same depth, r c from either face, into a right-angled edge. That is where a circular fillet of the
//! radius r has it, and for t = 2 the super-elliptic form is that circle, R = r. An intersection is the complement of the union of the complements, a difference the
//! intersection with the complements of the others.
//!
//! Results are no distances. A union only adds: it is at most the smallest of the fᵢ. All forms but the R-functions also join surfaces that come near each other without
//! meeting; where this is not wanted they are to be limited to the neighbourhood of the curve of intersection.
//!
//! The forms are those of the thesis of 2006, section 2.3, with the signs of distances that are negative inside.

use std::f64::consts::{FRAC_1_SQRT_2, LN_2};

use crate::error::{EditError, Result};

/// Depth of a circular fillet of radius 1 in a right-angled edge, from either face.
const DEPTH: f64 = 1.0 - FRAC_1_SQRT_2;

/// Which solid is made of several.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Combine {
    /// What is in any of them.
    Union,
    /// What is in all of them.
    Intersection,
    /// What is in the first and in none of the others.
    Difference,
}

/// The form of a smooth union; the module's comment has their equations. Lengths are in the unit of the distances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BlendForm {
    /// Of bounded influence: the default. `exponent` t ≥ 2; 2 is a circle, larger ones are fuller bends.
    SuperElliptic {
        /// Radius of a circular fillet of the same depth.
        radius: f64,
        /// t.
        exponent: f64,
    },
    /// The densities exp(−k f) add up to 1.
    Exponential {
        /// Radius of a circular fillet of the same depth.
        radius: f64,
    },
    /// The branch f₁ f₂ = k² of a hyperbola.
    Hyperbolic {
        /// Radius of a circular fillet of the same depth.
        radius: f64,
    },
    /// R-functions: minimum and maximum with derivatives. `alpha` in (−1, 1], 1 is the plain minimum; `order` n makes the field n times continuously
    /// differentiable where both are 0 (with `alpha` = 0), and its gradient on the surface fᵢⁿ instead of 1.
    R {
        /// α.
        alpha: f64,
        /// n.
        order: u32,
    },
}

impl BlendForm {
    /// Refuses what has no meaning.
    pub fn validate(&self, operation: &str) -> Result<()> {
        let refuse = |field, value: f64, accepted: &str| Err(EditError::parameter(operation, field, value, accepted));
        match *self {
            Self::SuperElliptic { radius, .. } | Self::Exponential { radius } | Self::Hyperbolic { radius }
                if !(radius > 0.0 && radius.is_finite()) =>
            {
                refuse("radius", radius, "a finite length above 0")
            }
            Self::SuperElliptic { exponent, .. } if !(2.0..=64.0).contains(&exponent) => {
                refuse("exponent", exponent, "2 (a circle) to 64 (nearly sharp)")
            }
            Self::R { alpha, .. } if !(alpha > -1.0 && alpha <= 1.0) => {
                refuse("alpha", alpha, "above -1, up to 1 (the plain minimum)")
            }
            Self::R { order, .. } if order > 8 => refuse("order", f64::from(order), "0 to 8"),
            _ => Ok(()),
        }
    }

    /// The distance of the other operands from which on one is left as it is, to less than `tolerance`: with one other, a union differs there from it by no more.
    pub fn reach(&self, tolerance: f64) -> f64 {
        match *self {
            Self::SuperElliptic { radius, exponent } => range(radius, exponent),
            // ln(1 + exp(−k f))/k ≤ exp(−k f)/k.
            Self::Exponential { radius } => {
                let k = rate(radius);
                (1.0 / (k * tolerance)).ln().max(0.0) / k
            }
            // The branch f₁ = k²/f₂.
            Self::Hyperbolic { radius } => (radius * DEPTH).powi(2) / tolerance,
            Self::R { .. } => 0.0,
        }
    }

    /// How far, at most, a union's surface lies outside those of two operands.
    pub fn largest_depth(&self) -> f64 {
        match *self {
            Self::SuperElliptic { radius, .. } | Self::Exponential { radius } | Self::Hyperbolic { radius } => {
                radius * DEPTH
            }
            Self::R { .. } => 0.0,
        }
    }

    /// The solid made of `distances`, in the order of the operands. Without any, everything is outside.
    pub fn combine(&self, combine: Combine, distances: &[f64]) -> f64 {
        match combine {
            Combine::Union => self.union(distances.iter().copied()),
            Combine::Intersection => -self.union(distances.iter().map(|f| -f)),
            Combine::Difference => -self.union(distances.iter().enumerate().map(|(i, f)| if i == 0 { -f } else { *f })),
        }
    }

    /// The union of two.
    pub fn union_of(&self, a: f64, b: f64) -> f64 {
        self.union([a, b].into_iter())
    }

    fn union(&self, f: impl Iterator<Item = f64> + Clone) -> f64 {
        let least = f.clone().fold(f64::INFINITY, f64::min);
        match *self {
            Self::SuperElliptic { radius, exponent } => {
                let range = range(radius, exponent);
                // One alone, or all out of range: a distance already.
                if least >= range || f.clone().filter(|f| *f < range).count() < 2 {
                    return least;
                }
                let sum: f64 = f.map(|f| power((1.0 - f / range).max(0.0), exponent)).sum();
                range * (1.0 - root(sum, exponent))
            }
            Self::Exponential { radius } => {
                if !least.is_finite() {
                    return least;
                }
                let k = rate(radius);
                least - f.map(|f| (k * (least - f)).exp()).sum::<f64>().ln() / k
            }
            Self::Hyperbolic { radius } => {
                let k = radius * DEPTH;
                pairwise(f, |a, b| {
                    // Of the conjugate form, which does not cancel.
                    let (low, gap) = (a.min(b), (a - b).abs());
                    low - 2.0 * k * k / (gap + gap.hypot(2.0 * k))
                })
            }
            Self::R { alpha, order } => pairwise(f, |a, b| r_union(a, b, alpha, order)),
        }
    }
}

/// The exponential form's k.
fn rate(radius: f64) -> f64 {
    LN_2 / (radius * DEPTH)
}

/// The super-elliptic form's R, at which its influence ends.
fn range(radius: f64, exponent: f64) -> f64 {
    if exponent == 2.0 { radius } else { radius * DEPTH / (1.0 - (-1.0 / exponent).exp2()) }
}

fn power(base: f64, exponent: f64) -> f64 {
    if exponent == 2.0 { base * base } else { base.powf(exponent) }
}

fn root(sum: f64, exponent: f64) -> f64 {
    if exponent == 2.0 { sum.sqrt() } else { sum.powf(1.0 / exponent) }
}

/// A union of two made one of many, from the first on. What is infinitely far away takes no part.
fn pairwise(f: impl Iterator<Item = f64>, union: impl Fn(f64, f64) -> f64) -> f64 {
    let joined = f.reduce(|a, b| if a.is_finite() && b.is_finite() { union(a, b) } else { a.min(b) });
    joined.unwrap_or(f64::INFINITY)
}

fn r_union(a: f64, b: f64, alpha: f64, order: u32) -> f64 {
    let sum = a + b;
    let radicand = (a - b).powi(2) + 2.0 * (1.0 - alpha) * a * b;
    let s = radicand.max(0.0).sqrt();
    // (sum − s)(sum + s) = 2(1 + α)ab: the form without cancellation.
    let value = if sum > 0.0 { 2.0 * a * b / (sum + s) } else { (sum - s) / (1.0 + alpha) };
    if order == 0 { value } else { value * a.hypot(b).powi(order as i32) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The form whose own parameter, R or k, is `own`; that of the exponential one is a rate.
    fn super_elliptic(own: f64, exponent: f64) -> BlendForm {
        BlendForm::SuperElliptic { radius: own * (1.0 - (-1.0 / exponent).exp2()) / DEPTH, exponent }
    }

    fn exponential(k: f64) -> BlendForm {
        BlendForm::Exponential { radius: LN_2 / (k * DEPTH) }
    }

    fn hyperbolic(k: f64) -> BlendForm {
        BlendForm::Hyperbolic { radius: k / DEPTH }
    }

    fn r(alpha: f64) -> BlendForm {
        BlendForm::R { alpha, order: 0 }
    }

    /// Reproducible numbers in −1..1.
    fn random(count: usize) -> Vec<[f64; 2]> {
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        (0..count).map(|_| [next(), next()]).collect()
    }

    /// Where f(s, s) = 0: how deep the surface lies in the edge of two faces.
    fn edge_depth(form: BlendForm) -> f64 {
        zero(|s| form.union_of(s, s), 0.0, 3.0)
    }

    fn zero(f: impl Fn(f64) -> f64, mut lo: f64, mut hi: f64) -> f64 {
        let rises = f(hi) > f(lo);
        for _ in 0..80 {
            let middle = (lo + hi) / 2.0;
            if (f(middle) > 0.0) == rises { hi = middle } else { lo = middle }
        }
        (lo + hi) / 2.0
    }

    /// Where the surfaces of unit spheres at ±3 on an axis come to lie on the positive side: outer and inner.
    fn spheres(form: BlendForm) -> [f64; 2] {
        let f = |x: f64| form.union_of((x - 3.0).abs() - 1.0, (x + 3.0).abs() - 1.0);
        [zero(f, 3.0, 6.0), zero(f, 0.0, 3.0)]
    }

    #[test]
    fn r_functions_have_the_sign_of_minimum_and_maximum() {
        for alpha in [1.0, 0.0, 0.5, -0.5] {
            for pair in random(100_000) {
                let [a, b] = pair;
                assert_eq!(r(alpha).combine(Combine::Union, &pair) < 0.0, a.min(b) < 0.0, "{alpha} {a} {b}");
                assert_eq!(r(alpha).combine(Combine::Intersection, &pair) < 0.0, a.max(b) < 0.0);
                assert_eq!(r(alpha).combine(Combine::Difference, &pair) < 0.0, a.max(-b) < 0.0);
            }
        }
        // α = 1 is the minimum itself, and none of them fills the edge.
        assert!(random(1000).into_iter().all(|[a, b]| (r(1.0).union_of(a, b) - a.min(b)).abs() < 1e-15));
        for alpha in [1.0, 0.5, 0.0, -0.5] {
            assert!(edge_depth(r(alpha)).abs() < 1e-12);
        }
        // Far outside the print's form loses all digits.
        assert!((r(0.0).union_of(1e-9, 1e9) - 1e-9).abs() < 1e-18);
    }

    #[test]
    fn an_r_function_of_order_n_is_no_distance() {
        // |∇f| on the surface f₁ = 0 is f₂ⁿ: 4 at f₂ = 2, n = 2.
        let form = BlendForm::R { alpha: 0.0, order: 2 };
        let slope = (form.union_of(1e-6, 2.0) - form.union_of(-1e-6, 2.0)) / 2e-6;
        assert!((slope - 4.0).abs() < 1e-5, "{slope}");
    }

    #[test]
    fn edges_are_filled_as_deep_as_the_formulas_say() {
        for (form, depth) in [
            (super_elliptic(1.0, 2.0), 0.2929),
            (super_elliptic(1.0, 3.0), 0.2063),
            (exponential(1.0), std::f64::consts::LN_2),
            (hyperbolic(0.4), 0.4),
        ] {
            assert!((edge_depth(form) - depth).abs() < 5e-5, "{form:?} {}", edge_depth(form));
            assert!((form.largest_depth() - depth).abs() < 5e-5);
        }
        // A radius means the same in all of them.
        for form in [
            BlendForm::SuperElliptic { radius: 2.0, exponent: 2.0 },
            BlendForm::SuperElliptic { radius: 2.0, exponent: 5.0 },
            BlendForm::Exponential { radius: 2.0 },
            BlendForm::Hyperbolic { radius: 2.0 },
        ] {
            assert!((edge_depth(form) - 2.0 * DEPTH).abs() < 1e-12, "{form:?}");
        }
    }

    #[test]
    fn the_hyperbolic_surface_is_the_branch_of_a_hyperbola() {
        // f₁ f₂ = k².
        for f1 in [0.01, 0.1, 0.4, 2.0, 30.0] {
            let k = 0.4;
            let f2 = zero(|f2| hyperbolic(k).union_of(f1, f2), 0.0, 100.0);
            assert!((f1 * f2 / (k * k) - 1.0).abs() < 1e-12, "{f1} {f2}");
        }
        for [a, b] in random(1000) {
            assert!((hyperbolic(0.4).union_of(a, b) - a.min(b)).abs() <= 0.4 + 1e-12);
        }
    }

    #[test]
    fn spheres_apart_are_moved_by_what_has_no_end() {
        for (form, outer, inner) in [
            (super_elliptic(1.0, 2.0), 4.0, 2.0),
            (exponential(1.0), 4.003, 1.981),
            (exponential(4.0), 4.0, 2.0),
            (hyperbolic(0.2), 4.007, 1.990),
        ] {
            let found = spheres(form);
            assert!((found[0] - outer).abs() < 6e-4 && (found[1] - inner).abs() < 6e-4, "{form:?} {found:?}");
        }
        // Disjoint solids out of range of each other: exactly themselves, and a distance.
        assert_eq!(super_elliptic(1.0, 2.0).union_of(1.5, 3.0), 1.5);
        assert_eq!(super_elliptic(1.0, 2.0).union_of(-0.25, 1.0), -0.25);
    }

    #[test]
    fn small_radii_approach_the_minimum() {
        for [a, b] in random(1000) {
            for form in [super_elliptic(1e-4, 2.0), exponential(1e4), hyperbolic(1e-4)] {
                // In a union's inside, the super-elliptic form is deeper than the minimum at any radius: its sign is what tends to that of the minimum.
                let limit = if matches!(form, BlendForm::SuperElliptic { .. }) && a < 0.0 && b < 0.0 {
                    -a.hypot(b)
                } else {
                    a.min(b)
                };
                assert!((form.union_of(a, b) - limit).abs() < 2e-4, "{form:?} {a} {b}");
            }
        }
    }

    #[test]
    fn unions_commute_and_only_add() {
        let forms = [super_elliptic(0.7, 2.0), super_elliptic(0.7, 4.0), exponential(3.0), hyperbolic(0.2), r(0.0)];
        for [a, b] in random(2000) {
            for form in forms {
                let union = form.union_of(a, b);
                assert!((union - form.union_of(b, a)).abs() < 1e-14);
                // R-functions keep the sign alone.
                if !matches!(form, BlendForm::R { .. }) {
                    assert!(union <= a.min(b) + 1e-15, "{form:?} {a} {b} {union}");
                }
                // Intersections and differences are unions of complements.
                assert_eq!(form.combine(Combine::Intersection, &[a, b]), -form.union_of(-a, -b));
                assert_eq!(form.combine(Combine::Difference, &[a, b]), -form.union_of(-a, b));
            }
        }
        // Three at once: the sum is over all.
        let three = super_elliptic(1.0, 2.0).combine(Combine::Union, &[0.4, 0.5, 0.6]);
        assert!((three - (1.0 - (0.36f64 + 0.25 + 0.16).sqrt())).abs() < 1e-12);
        assert_eq!(super_elliptic(1.0, 2.0).combine(Combine::Union, &[]), f64::INFINITY);
        assert_eq!(hyperbolic(1.0).union_of(f64::INFINITY, 2.0), 2.0);
    }

    #[test]
    fn the_reach_is_where_the_blend_ends() {
        for form in [super_elliptic(2.0, 2.0), super_elliptic(2.0, 3.0), exponential(3.0), hyperbolic(0.1)] {
            let far = form.reach(1e-3);
            assert!(form.union_of(0.0, far).abs() <= 1e-3 * (1.0 + 1e-9), "{form:?} {far}");
        }
        assert!(super_elliptic(2.0, 2.0).union_of(0.0, 1.99) < 0.0);
    }

    #[test]
    fn meaningless_parameters_are_refused() {
        for (form, field) in [
            (BlendForm::SuperElliptic { radius: -1.0, exponent: 2.0 }, "radius"),
            (BlendForm::SuperElliptic { radius: 1.0, exponent: 1.0 }, "exponent"),
            (BlendForm::Exponential { radius: 0.0 }, "radius"),
            (BlendForm::Hyperbolic { radius: f64::NAN }, "radius"),
            (BlendForm::R { alpha: -1.0, order: 0 }, "alpha"),
            (BlendForm::R { alpha: 0.0, order: 99 }, "order"),
        ] {
            assert!(form.validate("csg").unwrap_err().to_string().contains(field), "{form:?}");
        }
        assert!(BlendForm::R { alpha: 1.0, order: 0 }.validate("csg").is_ok());
    }
}
