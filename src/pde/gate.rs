//! What limits a speed: the cut-off C(γ) and the direction in which the surface may move (Museth et al. 2002, sections 4.3 and 5).
//!
//! > C(γ) = P(γ; l₀, l₁) up to the middle of l₁ and u₀, 1 − P(γ; u₀, u₁) beyond
//!
//! with the ramp P of [`ramp_between`] and γ dimensionless: |κ|h for curvatures (1/voxel), a cosine for angles. Either half may
//! be left out and is then 1. As l₁ ≤ u₀, C is the product of its halves.

use fearless_simd::{Select, Simd, SimdBase};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::region::ramp_between;
use crate::stencil::simd::Lanes;

/// C(γ): where γ lies between the limits a flow acts, outside it rests.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CutOff {
    low: Option<[f64; 2]>,
    high: Option<[f64; 2]>,
}

impl CutOff {
    /// No limits: C = 1.
    pub const NONE: Self = Self { low: None, high: None };

    /// Nothing below `limits[0]`, everything from `limits[1]` on. Refused, with the reason, where C would not be a function.
    pub fn with_low(self, limits: [f64; 2]) -> Result<Self, &'static str> {
        Self { low: Some(in_order(limits)?), ..self }.consistent()
    }

    /// Everything up to `limits[0]`, nothing above `limits[1]`. Refused, with the reason, where C would not be a function.
    pub fn with_high(self, limits: [f64; 2]) -> Result<Self, &'static str> {
        Self { high: Some(in_order(limits)?), ..self }.consistent()
    }

    fn consistent(self) -> Result<Self, &'static str> {
        match (self.low, self.high) {
            (Some(low), Some(high)) if low[1] > high[0] => {
                Err("upper limits that begin where the lower ones end or above: C would jump between them")
            }
            _ => Ok(self),
        }
    }

    /// Where C rises from 0 to 1.
    pub fn low(&self) -> Option<[f64; 2]> {
        self.low
    }

    /// Where C falls from 1 to 0.
    pub fn high(&self) -> Option<[f64; 2]> {
        self.high
    }

    /// Whether C is 1 everywhere.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    /// C(γ).
    pub fn weight(&self, gamma: f64) -> f64 {
        let low = self.low.map_or(1.0, |[a, b]| ramp_between(gamma, a, b));
        low * self.high.map_or(1.0, |[a, b]| 1.0 - ramp_between(gamma, a, b))
    }

    /// C(γ) with the lower half replaced by max(γ − l₀, 0)/γ: zero where C is, but γ times it has no slope above 1.
    ///
    /// For flows that go on until they rest. γ·P(γ; l₀, l₁) is steeper than γ by up to 5.5 for (0.04, 0.06): explicit steps that are stable
    /// for γ overshoot there, a one-sided flow never takes that back, and P ~ 2β² makes the approach to l₀ algebraic.
    #[inline(always)]
    pub fn excess<S: Simd>(&self, simd: S, gamma: Lanes<S>) -> Lanes<S> {
        let mut weight = Lanes::splat(simd, 1.0);
        if let Some([least, _]) = self.low {
            let above = (gamma - least as f32).max(Lanes::splat(simd, 0.0));
            weight = above / gamma.max(Lanes::splat(simd, f32::MIN_POSITIVE));
        }
        if let Some(limits) = self.high {
            weight *= Lanes::splat(simd, 1.0) - ramp(simd, gamma, limits);
        }
        weight
    }

    /// C(γ) of sixteen voxels.
    #[inline(always)]
    pub fn weights<S: Simd>(&self, simd: S, gamma: Lanes<S>) -> Lanes<S> {
        let mut weight = Lanes::splat(simd, 1.0);
        if let Some(limits) = self.low {
            weight = ramp(simd, gamma, limits);
        }
        if let Some(limits) = self.high {
            weight *= Lanes::splat(simd, 1.0) - ramp(simd, gamma, limits);
        }
        weight
    }
}

fn in_order(limits: [f64; 2]) -> Result<[f64; 2], &'static str> {
    let [a, b] = limits;
    if 0.0 <= a && a <= b && b.is_finite() { Ok(limits) } else { Err("two limits of 0 or more, the smaller first") }
}

/// P(γ; a, b): the step above b where they coincide.
#[inline(always)]
fn ramp<S: Simd>(simd: S, gamma: Lanes<S>, [a, b]: [f64; 2]) -> Lanes<S> {
    let (zero, one) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0));
    // The steepest slope there is stands for the step: infinity times 0 would be no number.
    let slope = if b > a { ((b - a).recip() as f32).min(f32::MAX) } else { f32::MAX };
    let beta = ((gamma - a as f32) * slope).max(zero).min(one);
    let left = one - beta;
    beta.simd_gt(0.5).select(one - left * left * 2.0, beta * beta * 2.0)
}

/// Which way a surface may move; a constraint on the final speed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub enum Direction {
    /// Outwards and inwards.
    #[default]
    Both,
    /// Outwards only: F = max(F, 0).
    Add,
    /// Inwards only: F = min(F, 0).
    Remove,
}

impl Direction {
    /// The speed that is allowed.
    #[inline(always)]
    pub fn constrain<S: Simd>(self, simd: S, speed: Lanes<S>) -> Lanes<S> {
        let zero = Lanes::splat(simd, 0.0);
        match self {
            Self::Both => speed,
            Self::Add => speed.max(zero),
            Self::Remove => speed.min(zero),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stencil::simd::{Work, dispatch};

    fn limited(low: Option<[f64; 2]>, high: Option<[f64; 2]>) -> CutOff {
        let cut_off = low.map_or(Ok(CutOff::NONE), |low| CutOff::NONE.with_low(low)).unwrap();
        high.map_or(Ok(cut_off), |high| cut_off.with_high(high)).unwrap()
    }

    /// C(γ) and the constrained γ − ½ by lanes.
    fn lanes(cut_off: CutOff, direction: Direction, gamma: f32) -> (f32, f32) {
        struct One<'a>(CutOff, Direction, f32, &'a mut (f32, f32));
        impl Work for One<'_> {
            fn run<S: Simd>(self, simd: S) {
                let gamma = Lanes::splat(simd, self.2);
                *self.3 = (self.0.weights(simd, gamma)[3], self.1.constrain(simd, gamma - 0.5)[3]);
            }
        }
        let mut out = (0.0, 0.0);
        dispatch(One(cut_off, direction, gamma, &mut out));
        out
    }

    #[test]
    fn rises_between_the_lower_limits_and_falls_between_the_upper() {
        // Hair sharpening in table 4 of the paper; P(¼) = ⅛, P(½) = ½, P(¾) = ⅞.
        let hair = limited(Some([0.01, 0.014]), Some([0.8, 0.9]));
        for (gamma, c) in [
            (0.0, 0.0),
            (0.01, 0.0),
            (0.011, 0.125),
            (0.012, 0.5),
            (0.013, 0.875),
            (0.014, 1.0),
            (0.4, 1.0),
            (0.8, 1.0),
            (0.825, 0.875),
            (0.85, 0.5),
            (0.9, 0.0),
            (1.0, 0.0),
        ] {
            assert!((hair.weight(gamma) - c).abs() < 1e-9, "{gamma}");
            // f32 knows γ to 6e-8, which the steeper ramp multiplies by its slope of at most 500.
            assert!((f64::from(lanes(hair, Direction::Both, gamma as f32).0) - c).abs() < 5e-6, "{gamma}");
        }
        for (cut_off, gamma, c) in [
            (CutOff::NONE, 3.0, 1.0),
            (limited(Some([0.04, 0.06]), None), 0.05, 0.5),
            (limited(Some([0.04, 0.06]), None), 9.0, 1.0),
            (limited(None, Some([0.25, 0.5])), 0.0, 1.0),
            (limited(None, Some([0.25, 0.5])), 0.75, 0.0),
            // Limits that coincide are steps, above the lower and up to the upper.
            (limited(Some([0.25, 0.25]), Some([0.5, 0.5])), 0.25, 0.0),
            (limited(Some([0.25, 0.25]), Some([0.5, 0.5])), 0.2500001, 1.0),
            (limited(Some([0.25, 0.25]), Some([0.5, 0.5])), 0.5, 1.0),
            (limited(Some([0.25, 0.25]), Some([0.5, 0.5])), 0.5000001, 0.0),
        ] {
            assert!((cut_off.weight(gamma) - c).abs() < 1e-6, "{cut_off:?} {gamma}");
            assert!(
                (f64::from(lanes(cut_off, Direction::Both, gamma as f32).0) - c).abs() < 1e-6,
                "{cut_off:?} {gamma}"
            );
        }
        assert!(CutOff::NONE.is_none() && !hair.is_none());
    }

    #[test]
    fn limits_out_of_order_are_refused() {
        for wrong in [[0.06, 0.04], [-0.1, 0.2], [0.1, f64::INFINITY], [f64::NAN, 1.0]] {
            assert!(CutOff::NONE.with_low(wrong).is_err() && CutOff::NONE.with_high(wrong).is_err(), "{wrong:?}");
        }
        let low = CutOff::NONE.with_low([0.04, 0.06]).unwrap();
        assert!(low.with_high([0.05, 0.07]).unwrap_err().contains("jump"));
        assert!(low.with_high([0.06, 0.06]).is_ok());
    }

    #[test]
    fn directions_let_one_sign_through() {
        for (direction, outwards, inwards) in
            [(Direction::Both, 0.25, -0.25), (Direction::Add, 0.25, 0.0), (Direction::Remove, 0.0, -0.25)]
        {
            assert_eq!(lanes(CutOff::NONE, direction, 0.75).1, outwards);
            assert_eq!(lanes(CutOff::NONE, direction, 0.25).1, inwards);
        }
    }
}
