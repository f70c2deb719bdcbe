//! A ball that rolls along the surface: the fillets and rounds of a radius, at once.
//!
//! The flow of concave curvatures above 1/R goes on until nothing is concave more sharply than that, and adds no more than it must. Where it
//! has gone on from an edge, it rests where a ball of radius R rolls along both sides without touching the edge: that is the closing by the ball, the offset by R outwards
//! and back. (The closing is concave by 1/R at most, so the flow stays inside it; and a place of the flow at rest is touched by such a
//! ball from outside.) Rounds are the opening.
//!
//! The closing also fills what is merely narrow, a gap between parts that do not meet; there the flow has nothing to begin with. So what the closing
//! has added is taken part by part, and only if the part holds a place that is too sharp.
//!
//! Where a gap is left open, distances at its mouth are bounds: those to the ball that was taken back.
//!
//! Error: that of the two offsets ([`Rebuild`](crate::mesh::Rebuild)), 3/8·h²/R each. Leaves in which nothing changes by more than a tenth of a voxel keep
//! their bits.

use glam::IVec3;

use super::csg::{CsgOperation, csg};
use super::morphology::offset_sharp;
use crate::error::Result;
use crate::grid::{LEAF_VOXELS, offset_to_local};
use crate::levelset::{Components, CurvatureKind, LevelSet, curvature};
use crate::run::RunOptions;

/// What counts as added, in voxels: more than the error of polygons.
const LEAST: f32 = 0.1;

/// How much sharper than the ball a place is from which it is filled: the curvature of a fillet of the same radius is known that well.
const SHARPER: f64 = 1.1;

/// The level set with its concave edges filled by a ball of `radius` (world units), or its convex ones rounded; `None` if none is sharper than that.
pub(super) fn rolled(level_set: &LevelSet, radius: f64, rounds: bool, run: &RunOptions) -> Result<Option<LevelSet>> {
    let sharp = sharper_than(level_set, SHARPER / radius, rounds, run)?;
    if sharp.is_empty() {
        return Ok(None);
    }
    let (outwards, least) = (if rounds { -1.0 } else { 1.0 }, LEAST * level_set.voxel_size() as f32);
    let (merge, take_back) = match rounds {
        false => (CsgOperation::Union, CsgOperation::Difference),
        true => (CsgOperation::Intersection, CsgOperation::Union),
    };
    let mut rolled = offset_sharp(&offset_sharp(level_set, outwards * radius, run)?, -outwards * radius, run)?;
    // What was added or removed, where it is thicker than that.
    let changed = match rounds {
        false => csg(&rolled, &[&grown(level_set, least)], CsgOperation::Difference, run)?,
        true => csg(&grown(level_set, -least), &[&rolled], CsgOperation::Difference, run)?,
    };
    let parts = changed.components(run)?;
    let wanted = parts_beside(&parts, &sharp);
    if wanted.contains(&false) {
        let others = without(changed, |ijk| parts.at(ijk).is_some_and(|part| wanted[part as usize]));
        rolled = csg(&rolled, &[&grown(&others, 2.0 * least)], take_back, run)?;
    }
    let mut result = csg(level_set, &[&rolled], merge, run)?;
    // The error of polygons is no change.
    let (grid, old) = (result.grid().clone(), level_set.grid());
    result.grid_mut().update_all(|id, values, mask| {
        let there = old.find(grid.origin(id));
        let (before, near) = (&old.values(there).0, |(a, b): (&f32, &f32)| (a - b).abs() < least);
        if !there.is_sentinel() && values.0.iter().zip(before).all(near) {
            (values.0, *mask) = (*before, old.mask(there));
        }
    });
    Ok(Some(result))
}

/// The voxels beside the surface where it is concave, or convex, more sharply than `least`.
fn sharper_than(level_set: &LevelSet, least: f64, convex: bool, run: &RunOptions) -> Result<Vec<IVec3>> {
    let (kind, sign) = if convex { (CurvatureKind::Max, 1.0) } else { (CurvatureKind::Min, -1.0) };
    let field = curvature(level_set, kind, run)?;
    let (grid, voxel_size) = (field.grid(), level_set.voxel_size() as f32);
    let of_leaf = |id| {
        let origin = grid.origin(id);
        let phi = &level_set.grid().values(level_set.grid().find(origin)).0;
        let is_sharp = |&at: &usize| {
            let (k, phi) = (grid.values(id).0[at], phi[at]);
            // Of the surface, not of the level set through the voxel.
            phi.abs() < voxel_size && f64::from(sign * k / (1.0 - phi * k).max(f32::MIN_POSITIVE)) > least
        };
        grid.mask(id).iter().filter(is_sharp).map(|at| origin + offset_to_local(at)).collect::<Vec<_>>()
    };
    Ok(grid.map_leaves(of_leaf).concat())
}

/// Of each part, whether it begins at one of some voxels, or two voxels from it at most.
fn parts_beside(parts: &Components, voxels: &[IVec3]) -> Vec<bool> {
    let mut beside = vec![false; parts.voxels().len()];
    for voxel in voxels {
        for step in (0..125).map(|n| IVec3::new(n / 25 - 2, n / 5 % 5 - 2, n % 5 - 2)) {
            if let Some(part) = parts.at(*voxel + step).and_then(|part| beside.get_mut(part as usize)) {
                *part = true;
            }
        }
    }
    beside
}

/// The solid {φ < `distance`}, where the band knows it.
fn grown(level_set: &LevelSet, distance: f32) -> LevelSet {
    let (mut grown, background) = (level_set.clone(), level_set.background());
    grown.grid_mut().update_all(|_, values, mask| {
        for at in 0..LEAF_VOXELS {
            if mask.get(at) {
                let value = values.0[at] - distance;
                mask.set(at, value.abs() < background);
                values.0[at] = value.clamp(-background, background);
            }
        }
    });
    grown
}

/// A solid without the parts of which `gone` says so of their voxels.
fn without(mut solid: LevelSet, gone: impl Fn(IVec3) -> bool + Sync) -> LevelSet {
    let (before, background) = (solid.grid().clone(), solid.background());
    solid.grid_mut().update_all(|id, values, mask| {
        for at in 0..LEAF_VOXELS {
            if values.0[at] < 0.0 && gone(before.origin(id) + offset_to_local(at)) {
                values.0[at] = background;
                mask.set(at, false);
            }
        }
    });
    solid.grid_mut().flood_signs();
    solid
}
