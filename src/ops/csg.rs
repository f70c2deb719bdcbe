//! Constructive solid geometry: union (paste), intersection (copy), difference (cut) (Museth et al. 2002, section 4).
//!
//! With φ negative inside: union min(a, b), intersection max(a, b), difference max(a, −b), voxel by voxel, the state of a
//! voxel being that of the operand it comes from; a tie is the first operand's. Nothing is renormalised: the result is
//! an exact distance outside a union and inside an intersection, elsewhere at most the distance. `rebuild` makes it exact.
//!
//! Only leaves that several operands have, and the leaves of what is cut away, are written; all others are shared with
//! their operand.

use fearless_simd::{Select, Simd, SimdBase, SimdMask};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::{WorldLength, words};
use super::registry::{Arity, Operator, Outcome, Summary};
use super::smooth_csg::{SmoothCsg, smooth_csg};
use crate::error::{EditError, Result};
use crate::grid::{Combination, Grid, LeafMask, LeafValues, SignRule};
use crate::levelset::smooth_csg::{BlendForm, Combine};
use crate::levelset::{LevelSet, background};
use crate::mesh::{Rebuild, onto_lattice, rebuild, with_half_width};
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch};

words! {
    /// A constructive operation.
    CsgOperation {
        /// What is in any of them: paste.
        Union = "union",
        /// What is in all of them: copy.
        Intersection = "intersection",
        /// What is in the first and in none of the others: cut.
        Difference = "difference",
    }
}

words! {
    /// What `csg` makes.
    CsgKind {
        /// What is in any of them: paste.
        Union = "union",
        /// What is in all of them: copy.
        Intersection = "intersection",
        /// What is in the first and in none of the others: cut.
        Difference = "difference",
        /// A union with rounded edges.
        SmoothUnion = "smooth-union",
        /// An intersection with rounded edges.
        SmoothIntersection = "smooth-intersection",
        /// A difference with rounded edges.
        SmoothDifference = "smooth-difference",
    }
}

impl CsgKind {
    /// The plain operation, and the smooth one if the edges are rounded.
    fn parts(self) -> (CsgOperation, Option<Combine>) {
        match self {
            Self::Union => (CsgOperation::Union, None),
            Self::Intersection => (CsgOperation::Intersection, None),
            Self::Difference => (CsgOperation::Difference, None),
            Self::SmoothUnion => (CsgOperation::Union, Some(Combine::Union)),
            Self::SmoothIntersection => (CsgOperation::Intersection, Some(Combine::Intersection)),
            Self::SmoothDifference => (CsgOperation::Difference, Some(Combine::Difference)),
        }
    }
}

words! {
    /// The form of rounded edges.
    SmoothFunction {
        /// Bounded: nothing changes where all other surfaces are a radius away.
        SuperElliptic = "superelliptic",
        /// Sum of densities.
        Exponential = "exponential",
        /// Branch of a hyperbola.
        Hyperbolic = "hyperbolic",
        /// R-function: edges stay sharp, the field off the surface is smooth.
        R = "r",
    }
}

/// Unite, intersect or subtract level sets, with sharp or with rounded edges.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Csg {
    /// What to do with the second and further inputs.
    pub operation: CsgKind,
    /// Of smooth operations: the radius of a circular fillet as deep as the blend in a right-angled edge.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius: Option<WorldLength>,
    /// Of smooth operations, superelliptic if not given: `superelliptic` is exactly circular in right-angled edges and leaves alone what is farther than the radius from all other surfaces;
    /// `exponential` and `hyperbolic` reach farther; `r` keeps the edge sharp.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub function: Option<SmoothFunction>,
    /// Of smooth operations: blend in full up to the first distance from where surfaces meet, not at all beyond the second, in voxels; so surfaces that come near each other without meeting are not joined.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near_curve: Option<[f64; 2]>,
    /// Make the result an exact distance again. Without it the result is the plain minimum or maximum of the fields, but for exact distances around rounded edges.
    pub rebuild: bool,
}

impl Default for Csg {
    fn default() -> Self {
        Self { operation: CsgKind::Union, radius: None, function: None, near_curve: None, rebuild: false }
    }
}

impl Csg {
    /// The smooth operation that is meant, if it is one, on voxels of a size.
    fn smooth(&self, voxel_size: f64) -> Result<Option<SmoothCsg>> {
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter(Self::NAME, field, value, accepted));
        let Some(combine) = self.operation.parts().1 else {
            let only = "only with smooth-union, smooth-intersection and smooth-difference";
            if let Some(radius) = self.radius {
                return refuse("radius", radius.to_string(), only);
            }
            if let Some([a, b]) = self.near_curve {
                return refuse("near_curve", format!("{a},{b}"), only);
            }
            return match self.function {
                Some(function) => refuse("function", format!("{function:?}").to_lowercase(), only),
                None => Ok(None),
            };
        };
        let function = self.function.unwrap_or(SmoothFunction::SuperElliptic);
        let form = match (function, self.radius) {
            (SmoothFunction::R, None) => BlendForm::R { alpha: 0.0, order: 0 },
            (SmoothFunction::R, Some(radius)) => {
                return refuse("radius", radius.to_string(), "none with the function `r`, which keeps edges sharp");
            }
            (_, None) => return refuse("radius", "none".into(), "a length, such as 0.1 or 5vx"),
            (function, Some(radius)) => {
                let radius = radius.world(voxel_size);
                match function {
                    SmoothFunction::Exponential => BlendForm::Exponential { radius },
                    SmoothFunction::Hyperbolic => BlendForm::Hyperbolic { radius },
                    _ => BlendForm::SuperElliptic { radius, exponent: 2.0 },
                }
            }
        };
        form.validate(Self::NAME)?;
        if let Some([a, b]) = self.near_curve
            && !(0.0 <= a && a <= b && b > 0.0 && b.is_finite())
        {
            return refuse("near_curve", format!("{a},{b}"), "two distances in voxels, the smaller first, such as 7,9");
        }
        let near_curve = self.near_curve.map(|reach| reach.map(|d| d * voxel_size));
        Ok(Some(SmoothCsg { combine, form, near_curve }))
    }
}

impl Operator for Csg {
    const NAME: &'static str = "csg";
    const ARITY: Arity = Arity::Many;

    fn validate(&self) -> Result<()> {
        self.smooth(1.0).map(drop)
    }

    fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let (aligned, mut warnings) = align(inputs, run)?;
        let Some((first, others)) = aligned.split_first() else { unreachable!("the registry counts the inputs") };
        let others: Vec<&LevelSet> = others.iter().collect();
        let mut result = csg(first, &others, self.operation.parts().0, run)?;
        if let Some(what) = self.smooth(first.voxel_size())? {
            let operands: Vec<&LevelSet> = aligned.iter().collect();
            let (smooth, more) = smooth_csg(&operands, &result, &what, run)?;
            result = smooth;
            warnings.extend(more);
        }
        if self.rebuild {
            result = rebuild(&result, &Rebuild::band(result.half_width()), run)?;
        }
        Ok(Outcome { level_set: result, summary: Summary { warnings, ..Summary::default() } })
    }
}

/// Brings level sets onto the lattice of the finest, with its half width; says what was changed.
pub fn align(mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<(Vec<LevelSet>, Vec<String>)> {
    let Some(finest) = (0..inputs.len()).min_by(|&a, &b| inputs[a].voxel_size().total_cmp(&inputs[b].voxel_size()))
    else {
        return Ok((inputs, Vec::new()));
    };
    let (transform, half_width) = (*inputs[finest].transform(), inputs[finest].half_width());
    let mut warnings = Vec::new();
    for (i, input) in inputs.iter_mut().enumerate() {
        if i == finest {
            continue;
        }
        if input.transform() != &transform {
            if input.renamed(&transform).is_none() {
                warnings.push(format!(
                    "input {} (voxel size {}) was resampled to the grid of input {} (voxel size {})",
                    i + 1,
                    input.voxel_size(),
                    finest + 1,
                    transform.voxel_size()
                ));
            }
            *input = onto_lattice(input, &transform, half_width, run)?;
        }
        if input.background() != background(half_width, &transform) {
            if (input.half_width() - half_width).abs() >= 1e-3 {
                warnings.push(format!(
                    "input {}: its band of {} voxels was made {half_width} wide",
                    i + 1,
                    input.half_width()
                ));
            }
            *input = with_half_width(input, half_width, run)?;
        }
    }
    Ok((inputs, warnings))
}

/// One operation on level sets of the same lattice and half width, all at once: no grid between two of them is made.
///
/// The result shares the pages of leaves that one of them alone decides.
pub fn csg(first: &LevelSet, others: &[&LevelSet], operation: CsgOperation, run: &RunOptions) -> Result<LevelSet> {
    let parts: Vec<&Grid> = std::iter::once(first).chain(others.iter().copied()).map(LevelSet::grid).collect();
    let union = operation == CsgOperation::Union;
    let rule = SignRule { inside_wins: union, complement_others: operation == CsgOperation::Difference };
    let combination = Combination::new(&parts, rule);
    run.reserve(Csg::NAME, combination.bytes(), "resample to a larger voxel size or raise the memory limit")?;
    run.check(Csg::NAME)?;
    let merged = combination.make(|a, a_mask, b, b_mask, factor| {
        dispatch(Merge { a, a_mask, b, b_mask, factor, union });
    });
    Ok(LevelSet::new(merged, *first.transform()))
}

/// a ← min(a, factor · b) for a union, else the maximum; each voxel with the state of the operand it comes from, a tie with that
/// of a.
struct Merge<'a> {
    a: &'a mut LeafValues,
    a_mask: &'a mut LeafMask,
    b: &'a LeafValues,
    b_mask: LeafMask,
    factor: f32,
    union: bool,
}

impl Work for Merge<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let factor = Lanes::splat(simd, self.factor);
        for x in 0..8 {
            let mut from_b = 0;
            for pair in 0..4 {
                let at = 64 * x + 16 * pair;
                let a = Lanes::from_slice(simd, &self.a.0[at..at + 16]);
                let b = Lanes::from_slice(simd, &self.b.0[at..at + 16]) * factor;
                let take = if self.union { a.simd_gt(b) } else { a.simd_lt(b) };
                take.select(b, a).store_slice(&mut self.a.0[at..at + 16]);
                from_b |= take.to_bitmask() << (16 * pair);
            }
            self.a_mask.0[x] = (self.a_mask.0[x] & !from_b) | (self.b_mask.0[x] & from_b);
        }
    }
}
