//! Smooth CSG of level sets: rounded edges where surfaces meet, with exact distances.
//!
//! The forms are those of [`crate::levelset::smooth_csg`]. They need the distances of all operands as far as the blend reaches, so bands are first widened by exact
//! distances where two operands come near each other. The blended field is no distance: its zero set is polygonised, and the distances within a band's width of what changed are
//! rebuilt. All other voxels keep the bits of the plain operation.
//!
//! Exponential and hyperbolic blends have no end. They are cut where the second operand would move the surface of the first by less than a fiftieth of a voxel, or at
//! 64 voxels, which is said.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet, LeafValues, offset_to_local};
use crate::levelset::LevelSet;
use crate::levelset::smooth_csg::{BlendForm, Combine};
use crate::mesh::{rebuilt_leaves, widened};
use crate::region::{Near, Region, VoxelSet};
use crate::run::RunOptions;

const OPERATION: &str = "csg";

/// Part of a voxel by which a blend without end may move a surface where it is cut.
const TOLERANCE: f64 = 0.02;
/// The widest band, in voxels, that operands are given.
const WIDEST: f64 = 64.0;
/// Part of a voxel below which a blend has done nothing.
const NOTHING: f64 = 1e-6;
/// Edge of the boxes, in voxels, in which it is found out where two operands are near each other.
const BOX: i32 = 32;

/// What is blended, and where. Lengths in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SmoothCsg {
    /// Which solid is made.
    pub combine: Combine,
    /// The form of the blend.
    pub form: BlendForm,
    /// Full up to the first distance from the curves where surfaces meet, nothing beyond the second; everywhere if not given.
    pub near_curve: Option<[f64; 2]>,
}

/// Blends `operands`, of the same lattice and half width, of which `plain` is the plain combination; says what has to be said.
pub fn smooth_csg(
    operands: &[&LevelSet],
    plain: &LevelSet,
    what: &SmoothCsg,
    run: &RunOptions,
) -> Result<(LevelSet, Vec<String>)> {
    what.form.validate(OPERATION)?;
    let voxel_size = plain.voxel_size();
    let mut warnings = Vec::new();
    if what.form.largest_depth() == 0.0 {
        warnings.push("R-functions keep the surface of the plain operation: its edges stay sharp".into());
        return Ok((plain.clone(), warnings));
    }
    let curve = match what.near_curve {
        None => None,
        Some(reach) => Some(Near::new(&curves(operands), reach)?),
    };
    let reach = what.form.reach(TOLERANCE * voxel_size) / voxel_size;
    if reach > WIDEST {
        warnings.push(format!(
            "the blend has no end: it was cut {WIDEST} voxels from the other surface; a smaller radius or the super-elliptic function reach less far"
        ));
    }
    let half_width = (reach.min(WIDEST).ceil() + 2.0) as f32;
    let near = Neighbourhood::new(operands, f64::from(half_width));
    let wanted = |first: IVec3, last: IVec3| {
        let (centre, radius) = ((first + last).as_dvec3() / 2.0, (last - first).as_dvec3().length() / 2.0);
        let to_world = plain.transform();
        near.touches(first, last)
            && curve
                .as_ref()
                .is_none_or(|curve| curve.weights_within(to_world.index_to_world(centre), radius * voxel_size)[1] > 0.0)
    };
    let wide = operands.iter().map(|operand| widened(operand, half_width, wanted, run)).collect::<Result<Vec<_>>>()?;
    let blend = Blend { wide: &wide, what, curve: curve.as_ref(), voxel_size };
    let changes = blend.changes(&wanted, run)?;
    if changes.is_empty() {
        warnings.push("no surfaces come near enough to be blended: the result is that of the plain operation".into());
        return Ok((plain.clone(), warnings));
    }
    Ok((repaired(plain, changes, run)?, warnings))
}

/// Points on the curves where any two of the surfaces meet.
fn curves(operands: &[&LevelSet]) -> Vec<DVec3> {
    let mut points = Vec::new();
    for (i, a) in operands.iter().enumerate() {
        for b in &operands[i + 1..] {
            points.extend(a.intersection_curve(b));
        }
    }
    points
}

/// The boxes within reach of two operands or more.
struct Neighbourhood(FxHashSet<IVec3>);

impl Neighbourhood {
    fn new(operands: &[&LevelSet], reach: f64) -> Self {
        let reach = reach.ceil() as i32;
        // How many operands reach a box, and which was the last of them.
        let mut counts: FxHashMap<IVec3, (usize, usize)> = FxHashMap::default();
        for (number, operand) in operands.iter().enumerate() {
            let grid = operand.grid();
            let mut own: FxHashSet<IVec3> = FxHashSet::default();
            for &id in grid.leaves() {
                own.extend(boxes(grid.origin(id) - reach, grid.origin(id) + LEAF_DIM - 1 + reach));
            }
            for place in own {
                let (count, last) = counts.entry(place).or_insert((0, usize::MAX));
                *count += usize::from(*last != number);
                *last = number;
            }
        }
        Self(counts.into_iter().filter(|(_, (count, _))| *count > 1).map(|(place, _)| place).collect())
    }

    fn touches(&self, first: IVec3, last: IVec3) -> bool {
        boxes(first, last).any(|place| self.0.contains(&place))
    }
}

/// The boxes that the voxels from `first` to `last` lie in.
fn boxes(first: IVec3, last: IVec3) -> impl Iterator<Item = IVec3> {
    let (lo, hi) = (first.div_euclid(IVec3::splat(BOX)), last.div_euclid(IVec3::splat(BOX)));
    (lo.x..=hi.x).flat_map(move |x| (lo.y..=hi.y).flat_map(move |y| (lo.z..=hi.z).map(move |z| IVec3::new(x, y, z))))
}

/// A leaf that the blend changes.
struct Change {
    origin: IVec3,
    /// φ in world units, at the voxels of the mask.
    values: Box<LeafValues>,
    mask: LeafMask,
}

struct Blend<'a> {
    wide: &'a [LevelSet],
    what: &'a SmoothCsg,
    curve: Option<&'a Near>,
    voxel_size: f64,
}

impl Blend<'_> {
    /// The leaves in which the blend changes the surface, by origin.
    fn changes(&self, wanted: &(impl Fn(IVec3, IVec3) -> bool + Sync), run: &RunOptions) -> Result<Vec<Change>> {
        let origins: FxHashSet<IVec3> =
            self.wide.iter().flat_map(|w| w.grid().leaves().iter().map(|&id| w.grid().origin(id))).collect();
        let mut origins: Vec<IVec3> = origins.into_iter().filter(|&o| wanted(o, o + (LEAF_DIM - 1))).collect();
        origins.sort_unstable_by_key(|o| o.to_array());
        let task = run.task("blending", origins.len() as u64);
        let changes = origins.par_iter().map(|&origin| {
            run.check(OPERATION)?;
            task.advance(1);
            Ok(self.leaf(origin))
        });
        Ok(changes.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect())
    }

    fn leaf(&self, origin: IVec3) -> Option<Change> {
        let fields: Vec<&LeafValues> = self.wide.iter().map(|w| w.grid().values(w.grid().find(origin))).collect();
        let mut change = Change { origin, values: Box::new(LeafValues::default()), mask: LeafMask::EMPTY };
        let mut matters = false;
        let mut distances = vec![0.0; fields.len()];
        for at in 0..LEAF_VOXELS {
            for (i, (distance, field)) in distances.iter_mut().zip(&fields).enumerate() {
                *distance = self.known(i, field.0[at]);
            }
            let combine = self.what.combine;
            let plain = extreme(combine, &distances);
            if !plain.is_finite() {
                continue;
            }
            let mut value = self.what.form.combine(combine, &distances);
            if let Some(curve) = self.curve
                && value != plain
            {
                let xyz = self.wide[0].transform().voxel_to_world(origin + offset_to_local(at));
                value = plain + f64::from(curve.weight(xyz)) * (value - plain);
            }
            if (value - plain).abs() <= NOTHING * self.voxel_size {
                continue;
            }
            change.values.0[at] = value as f32;
            // What the polygons of the new surface and of the old one hang on.
            let near = 2.0 * self.voxel_size;
            let of_surface = value.abs() < near || plain.abs() < near || (value < 0.0) != (plain < 0.0);
            change.mask.set(at, of_surface);
            matters |= of_surface;
        }
        matters.then_some(change)
    }

    /// A stored distance, infinite where it is so far on the side that takes no part that it is not known.
    fn known(&self, operand: usize, value: f32) -> f64 {
        let of_union = match self.what.combine {
            Combine::Union => true,
            Combine::Intersection => false,
            Combine::Difference => operand > 0,
        };
        let background = self.wide[operand].background();
        match of_union {
            true if value >= background => f64::INFINITY,
            false if value <= -background => f64::NEG_INFINITY,
            _ => f64::from(value),
        }
    }
}

/// The plain minimum or maximum.
fn extreme(combine: Combine, distances: &[f64]) -> f64 {
    let all = distances.iter().copied();
    match combine {
        Combine::Union => all.fold(f64::INFINITY, f64::min),
        Combine::Intersection => all.fold(f64::NEG_INFINITY, f64::max),
        Combine::Difference => {
            all.enumerate().map(|(i, f)| if i == 0 { f } else { -f }).fold(f64::NEG_INFINITY, f64::max)
        }
    }
}

/// `plain` with the changed voxels, and exact distances to the new surface within a band's width of them.
fn repaired(plain: &LevelSet, changes: Vec<Change>, run: &RunOptions) -> Result<LevelSet> {
    let (transform, background, half_width) = (*plain.transform(), plain.background(), plain.half_width());
    let mut grid = plain.grid().clone();
    add_missing(&mut grid, changes.iter().map(|change| change.origin));
    let by_leaf: FxHashMap<LeafId, &Change> = changes.iter().map(|change| (grid.find(change.origin), change)).collect();
    let leaves: LeafSet = by_leaf.keys().copied().collect();
    grid.update(&leaves, |id, values, mask| {
        let Some(change) = by_leaf.get(&id) else { return };
        for at in change.mask.iter() {
            values.0[at] = change.values.0[at].clamp(-background, background);
            mask.set(at, values.0[at].abs() < background);
        }
    });
    let blended = LevelSet::new(grid, transform);

    // Whatever has its nearest surface among the changed voxels, before or after, is within the band of them: within so many steps from face to face.
    let reach = ((f64::from(half_width) + 2.0).ceil() * 3f64.sqrt()).ceil() as i32;
    let changed: FxHashSet<IVec3> =
        changes.iter().flat_map(|c| boxes(c.origin - reach, c.origin + LEAF_DIM - 1 + reach)).collect();
    let wanted = |first: IVec3, last: IVec3| boxes(first, last).any(|place| changed.contains(&place));
    let rebuilt = rebuilt_leaves(&blended, half_width, wanted, run)?;
    let rebuilt: FxHashMap<IVec3, (&LeafValues, LeafMask)> =
        rebuilt.iter().flatten().map(|(origin, values, mask)| (*origin, (values, *mask))).collect();

    let mut grid = blended.into_grid();
    add_missing(&mut grid, rebuilt.keys().copied());
    let seeds: FxHashMap<IVec3, LeafMask> = changes.iter().map(|change| (change.origin, change.mask)).collect();
    let seeds = VoxelSet::new(&grid, |id| seeds.get(&grid.origin(id)).copied().unwrap_or_default());
    let affected = seeds.grown(&grid, reach as usize);
    let origins: FxHashMap<LeafId, IVec3> = affected.leaves().iter().map(|id| (id, grid.origin(id))).collect();
    grid.update(affected.leaves(), |id, values, mask| {
        let new = origins.get(&id).and_then(|origin| rebuilt.get(origin));
        for at in affected.mask(id).iter() {
            match new {
                Some((new, active)) => {
                    values.0[at] = new.0[at];
                    mask.set(at, active.get(at));
                }
                None => {
                    values.0[at] = if values.0[at] < 0.0 { -background } else { background };
                    mask.set(at, false);
                }
            }
        }
    });
    let all = grid.leaf_set().clone();
    grid.prune(&all);
    Ok(LevelSet::new(grid, transform))
}

fn add_missing(grid: &mut Grid, origins: impl Iterator<Item = IVec3>) {
    let mut missing: Vec<IVec3> = origins.filter(|&o| grid.find(o).is_sentinel()).collect();
    missing.sort_unstable_by_key(|o| o.to_array());
    grid.add_leaves(&missing);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{box_distance, sampled};
    use crate::ops::Operator;
    use crate::ops::csg::{Csg, CsgOperation, csg};

    const FORM: BlendForm = BlendForm::SuperElliptic { radius: 6.0, exponent: 2.0 };

    fn smooth(a: &LevelSet, b: &LevelSet, combine: Combine, form: BlendForm, near: Option<[f64; 2]>) -> LevelSet {
        let operation = match combine {
            Combine::Union => CsgOperation::Union,
            Combine::Intersection => CsgOperation::Intersection,
            Combine::Difference => CsgOperation::Difference,
        };
        let run = RunOptions::default();
        let plain = csg(a, &[b], operation, &run).unwrap();
        let what = SmoothCsg { combine, form, near_curve: near };
        let result = smooth_csg(&[a, b], &plain, &what, &run).unwrap().0;
        assert_eq!(result.check(), []);
        assert_eq!(result.half_width(), plain.half_width());
        result
    }

    fn slab(axis: usize) -> LevelSet {
        let half = DVec3::from(std::array::from_fn(|i| if i == axis { 8.0 } else { 24.0 }));
        sampled(30, move |p| box_distance(p, half))
    }

    /// Largest difference of active voxels from `exact`, of those where `wanted`.
    fn worst(level_set: &LevelSet, exact: impl Fn(DVec3) -> f64, wanted: impl Fn(DVec3) -> bool) -> f64 {
        let (grid, mut worst, mut count) = (level_set.grid(), 0f64, 0);
        for &id in grid.leaves() {
            for at in grid.mask(id).iter() {
                let p = (grid.origin(id) + offset_to_local(at)).as_dvec3();
                if wanted(p) {
                    worst = worst.max((f64::from(grid.values(id).0[at]) - exact(p)).abs());
                    count += 1;
                }
            }
        }
        assert!(count > 100, "{count}");
        worst
    }

    #[test]
    fn right_angled_edges_become_circular_and_distances_exact() {
        // Slabs across x and y: the edge at (8, 8) is filled by a circle of radius 6 around (14, 14).
        let (a, b) = (slab(0), slab(1));
        let union = smooth(&a, &b, Combine::Union, FORM, None);
        let fillet = |p: DVec3| 6.0 - (p.truncate() - 14.0).length();
        let here = |p: DVec3| p.z.abs() < 12.0 && p.x.max(p.y) < 13.0 && p.x.min(p.y) > 9.5;
        // Polygons of a circle of 6 voxels: 3/8·h²/R = 0.06.
        let error = worst(&union, fillet, here);
        assert!(error < 0.08, "{error}");
        // Intersections round the convex edge, differences that of the hole.
        let convex = |p: DVec3| (p.truncate() - 2.0).length() - 6.0;
        let here = |p: DVec3| p.z.abs() < 12.0 && p.x.min(p.y) > 3.0;
        let error = worst(&smooth(&a, &b, Combine::Intersection, FORM, None), convex, here);
        assert!(error < 0.08, "{error}");
        let edge = |p: DVec3| (p.truncate() - glam::DVec2::new(2.0, 14.0)).length() - 6.0;
        let here = |p: DVec3| p.z.abs() < 12.0 && p.x > 3.0 && p.y > 6.0 && p.y < 13.0;
        let error = worst(&smooth(&a, &b, Combine::Difference, FORM, None), edge, here);
        assert!(error < 0.08, "{error}");
    }

    #[test]
    fn every_form_is_as_deep_in_the_edge() {
        let (a, b) = (slab(0), slab(1));
        for form in [FORM, BlendForm::Exponential { radius: 6.0 }, BlendForm::Hyperbolic { radius: 6.0 }] {
            let union = smooth(&a, &b, Combine::Union, form, None);
            let (mut sampler, mut depth) = (union.sampler(), 0.0);
            while sampler.trilinear(DVec3::new(8.0 + depth, 8.0 + depth, 0.0)) < 0.0 {
                depth += 0.01;
            }
            // 6(1 − 1/√2).
            assert!((depth - 1.757).abs() < 0.06, "{form:?} {depth}");
        }
    }

    #[test]
    fn what_is_not_blended_keeps_its_bits() {
        let (a, b) = (slab(0), slab(1));
        let plain = csg(&a, &[&b], CsgOperation::Union, &RunOptions::default()).unwrap();
        let union = smooth(&a, &b, Combine::Union, FORM, None);
        let (mut kept, mut changed) = (0, 0);
        for &id in plain.grid().leaves() {
            let origin = plain.grid().origin(id);
            for at in plain.grid().mask(id).iter() {
                let ijk = origin + offset_to_local(at);
                let same = union.grid().voxel(ijk).0 == plain.grid().values(id).0[at];
                // The blend begins 6 voxels from the other surface; nine steps beyond it, nothing changes.
                if (ijk.x.abs().max(ijk.y.abs()) - 8) > 6 + 9 {
                    assert!(same, "{ijk}");
                    kept += 1;
                }
                changed += u32::from(!same);
            }
        }
        assert!(kept > 500 && changed > 1000, "{kept} {changed}");
        // Out of each other's reach nothing is blended at all.
        let run = RunOptions::default();
        let far = [-15.0, 15.0].map(|x| sampled(30, move |p| (p - DVec3::X * x).length() - 8.0));
        let plain = csg(&far[0], &[&far[1]], CsgOperation::Union, &run).unwrap();
        let what = SmoothCsg { combine: Combine::Union, form: FORM, near_curve: None };
        let (same, warnings) = smooth_csg(&[&far[0], &far[1]], &plain, &what, &run).unwrap();
        assert!(warnings[0].contains("no surfaces come near"), "{warnings:?}");
        assert!(plain.grid().leaves().iter().all(|&id| same.grid().shares_storage(plain.grid(), id)));
    }

    #[test]
    fn surfaces_that_do_not_meet_are_joined_only_if_not_limited() {
        // Two plates with a gap of 2 voxels.
        let upper = sampled(30, |p| box_distance(p - DVec3::Z * 6.0, DVec3::new(20.0, 20.0, 4.0)));
        let lower = sampled(30, |p| box_distance(p + DVec3::Z * 4.0, DVec3::new(20.0, 20.0, 4.0)));
        let joined = smooth(&upper, &lower, Combine::Union, FORM, None);
        assert!(joined.grid().voxel(IVec3::new(0, 0, 1)).0 < 0.0);
        let run = RunOptions::default();
        let plain = csg(&upper, &[&lower], CsgOperation::Union, &run).unwrap();
        let what = SmoothCsg { combine: Combine::Union, form: FORM, near_curve: Some([4.0, 8.0]) };
        let (apart, _) = smooth_csg(&[&upper, &lower], &plain, &what, &run).unwrap();
        assert!(apart.grid().voxel(IVec3::new(0, 0, 1)).0 > 0.0);
        // Where surfaces do meet, the limited blend acts near the curve.
        let (a, b) = (slab(0), slab(1));
        let plain = csg(&a, &[&b], CsgOperation::Union, &run).unwrap().measure(&run).unwrap().volume;
        let near = smooth(&a, &b, Combine::Union, FORM, Some([7.0, 9.0])).measure(&run).unwrap().volume;
        let full = smooth(&a, &b, Combine::Union, FORM, None).measure(&run).unwrap().volume;
        assert!(near > plain + 100.0 && near < full + 1.0, "{plain} {near} {full}");
    }

    #[test]
    fn several_operands_and_added_material_only() {
        let bars: Vec<LevelSet> = (0..3)
            .map(|axis| {
                let half = DVec3::from(std::array::from_fn(|i| if i == axis { 20.0 } else { 4.3 }));
                sampled(28, move |p| box_distance(p, half))
            })
            .collect();
        let run = RunOptions::default();
        let params = Csg {
            operation: crate::ops::csg::CsgKind::SmoothUnion,
            radius: Some("5vx".parse().unwrap()),
            ..Csg::default()
        };
        let smooth = params.apply(bars.clone(), &run).unwrap();
        assert!(smooth.summary.warnings.is_empty(), "{:?}", smooth.summary.warnings);
        let plain = Csg::default().apply(bars, &run).unwrap().level_set;
        assert_eq!(smooth.level_set.check(), []);
        let volume = |level_set: &LevelSet| level_set.measure(&run).unwrap().volume;
        assert!(volume(&smooth.level_set) > volume(&plain) + 100.0);
        assert_eq!(smooth.level_set.components(&run).unwrap().voxels().len(), 1);
        for &id in plain.grid().leaves() {
            for at in plain.grid().mask(id).iter().filter(|at| plain.grid().values(id).0[*at] < 0.0) {
                assert!(smooth.level_set.grid().voxel(plain.grid().origin(id) + offset_to_local(at)).0 < 0.0);
            }
        }
    }

    #[test]
    fn parameters_that_do_not_go_together_are_refused() {
        let values = |json: serde_json::Value| serde_json::from_value::<Csg>(json).unwrap().validate();
        for (json, field) in [
            (serde_json::json!({"operation": "smooth-union"}), "radius"),
            (serde_json::json!({"operation": "smooth-union", "radius": -1}), "radius"),
            (serde_json::json!({"operation": "smooth-union", "radius": 1, "function": "r"}), "radius"),
            (serde_json::json!({"operation": "union", "radius": 1}), "radius"),
            (serde_json::json!({"operation": "union", "function": "r"}), "function"),
            (serde_json::json!({"operation": "smooth-union", "radius": 1, "near_curve": [9, 7]}), "near_curve"),
            (serde_json::json!({"operation": "difference", "near_curve": [7, 9]}), "near_curve"),
        ] {
            let refused = values(json.clone()).unwrap_err().to_string();
            assert!(refused.contains(field) && refused.starts_with("csg"), "{json}: {refused}");
        }
        assert!(values(serde_json::json!({"operation": "smooth-difference", "function": "r"})).is_ok());
    }
}
