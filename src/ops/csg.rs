//! Constructive solid geometry: union (paste), intersection (copy), difference (cut) (Museth et al. 2002, section 4).
//!
//! With φ negative inside: union min(a, b), intersection max(a, b), difference max(a, −b), voxel by voxel, the state of a
//! voxel being that of the operand it comes from; a tie is the first operand's. Nothing is renormalised: the result is
//! an exact distance outside a union and inside an intersection, elsewhere at most the distance. `rebuild` makes it exact.
//!
//! The result begins as a copy of the first operand that shares its pages; only leaves that both have, and those that
//! come from the second alone, are written.

use glam::IVec3;
use rustc_hash::FxHashMap;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::words;
use super::registry::{Arity, Operator, Outcome, Summary};
use crate::error::Result;
use crate::grid::{Grid, LEAF_VOXELS, LeafId, LeafMask, LeafSet, LeafValues};
use crate::levelset::{LevelSet, background};
use crate::mesh::{Rebuild, onto_lattice, rebuild, with_half_width};
use crate::run::RunOptions;

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
        let task = run.task("combining", aligned.len() as u64 - 1);
        let mut parts = aligned.into_iter();
        let mut result = parts.next().unwrap_or_else(|| unreachable!("the registry counts the inputs"));
        for part in parts {
            run.check(Self::NAME)?;
            result = csg(&result, &part, self.operation);
            task.advance(1);
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

/// One operation on two level sets of the same lattice and half width.
pub fn csg(a: &LevelSet, b: &LevelSet, operation: CsgOperation) -> LevelSet {
    LevelSet::new(combine(a.grid(), b.grid(), operation), *a.transform())
}

fn combine(a: &Grid, b: &Grid, operation: CsgOperation) -> Grid {
    // The sign of the second operand's space that wins over whatever the first one has, and the one that leaves it alone.
    let (union, negate) = match operation {
        CsgOperation::Union => (true, false),
        CsgOperation::Intersection => (false, false),
        CsgOperation::Difference => (false, true),
    };
    let inside = |id: LeafId| (id == LeafId::INSIDE) != negate;
    let wins = |inside: bool| inside == union;

    let mut out = a.clone();
    let swallowed: Vec<LeafId> = a
        .leaves()
        .iter()
        .copied()
        .filter(|&id| {
            let there = b.find(a.origin(id));
            there.is_sentinel() && wins(inside(there))
        })
        .collect();
    out.remove_leaves(&swallowed, union);

    let mut both = LeafSet::default();
    // The leaves that come from the second operand alone: where they go, and which they are.
    let (mut places, mut sources): (Vec<IVec3>, Vec<LeafId>) = Default::default();
    for &id in b.leaves() {
        let here = a.find(b.origin(id));
        if !here.is_sentinel() {
            both.insert(here);
        } else if !wins(here == LeafId::INSIDE) {
            places.push(b.origin(id));
            sources.push(id);
        }
    }
    let copied: FxHashMap<LeafId, LeafId> = out.add_leaves(&places).into_iter().zip(sources).collect();
    let added: LeafSet = copied.keys().copied().collect();
    let sign = if negate { -1.0 } else { 1.0 };
    out.update(&both, |id, values, mask| {
        let other = b.find(a.origin(id));
        merge_leaf(values, mask, b.values(other), b.mask(other), sign, union);
    });
    out.update(&added, |id, values, mask| {
        let source = copied[&id];
        *mask = b.mask(source);
        for (v, s) in values.0.iter_mut().zip(&b.values(source).0) {
            *v = sign * s;
        }
    });
    out.combine_signs(b, |mine, theirs| if union { mine || theirs != negate } else { mine && theirs != negate });
    out.prune(&both);
    out
}

/// The minimum or maximum of two leaves, each voxel with the state of the operand it comes from.
#[inline(always)]
fn merge_leaf(a: &mut LeafValues, mask: &mut LeafMask, b: &LeafValues, b_mask: LeafMask, sign: f32, union: bool) {
    let mut from_b = LeafMask::EMPTY;
    for offset in 0..LEAF_VOXELS {
        let other = sign * b.0[offset];
        let take = if union { a.0[offset] > other } else { a.0[offset] < other };
        a.0[offset] = if take { other } else { a.0[offset] };
        from_b.0[offset >> 6] |= u64::from(take) << (offset & 63);
    }
    *mask = LeafMask(std::array::from_fn(|x| (mask.0[x] & !from_b.0[x]) | (b_mask.0[x] & from_b.0[x])));
}
