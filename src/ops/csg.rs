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

use super::params::words;
use super::registry::{Arity, Operator, Outcome, Summary};
use crate::error::Result;
use crate::grid::{Combination, Grid, LeafMask, LeafValues, SignRule};
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

/// Unite, intersect or subtract level sets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Csg {
    /// What to do with the second and further inputs.
    pub operation: CsgOperation,
    /// Make the result an exact distance again. Without it the result is the plain minimum or maximum of the fields.
    pub rebuild: bool,
}

impl Default for Csg {
    fn default() -> Self {
        Self { operation: CsgOperation::Union, rebuild: false }
    }
}

impl Operator for Csg {
    const NAME: &'static str = "csg";
    const ARITY: Arity = Arity::Many;

    fn validate(&self) -> Result<()> {
        Ok(())
    }

    fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let (aligned, warnings) = align(inputs, run)?;
        let Some((first, others)) = aligned.split_first() else { unreachable!("the registry counts the inputs") };
        let others: Vec<&LevelSet> = others.iter().collect();
        let mut result = csg(first, &others, self.operation, run)?;
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
