//! The result of an operator that moves the whole surface, confined to a region.
//!
//! φ' = (1 − α) φ + α φ_new, on a band wide enough that both are distances wherever the two differ in sign. φ' is no distance
//! where α varies; its zero set is the new surface, and the distance to that is rebuilt exactly around the region. Voxels that
//! were active with α = 0 keep their bits, so where a steep surface rises beside them the field is cut to what they allow,
//! |φ(x) − φ(f)| ≤ |x − f|: the surface stays out of the balls that they say are empty, as in an intersection of solids.
//!
//! The work is proportional to the region, and to the surface within the operator's reach of it.

use std::collections::VecDeque;

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::csg::{CsgOperation, csg};
use crate::error::Result;
use crate::grid::{
    Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet, Transform, leaf_offset, leaf_origin, offset_to_local,
};
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild, rebuild_where, with_half_width};
use crate::pde::Report;
use crate::region::{Region, RegionWeights};
use crate::run::RunOptions;
use crate::stencil::Cube;

/// How far an operator acts, in voxels.
pub(super) struct Reach {
    /// From the old surface to points that change sides.
    pub moves: f64,
    /// From a point to the old surface that decides whether it changes sides.
    pub sees: f64,
}

/// Slope between a kept voxel and another above which the other is cut: 1, and what the polygons of a surface add.
const STEEPEST: f32 = 1.02;

/// What `operator` makes of the level set in `region`; `None` if the region touches nothing that it could change.
pub(super) fn confined(
    operation: &str,
    level_set: &LevelSet,
    region: &dyn Region,
    reach: &Reach,
    operator: impl FnOnce(LevelSet) -> Result<LevelSet>,
    run: &RunOptions,
) -> Result<Option<LevelSet>> {
    let half_width = level_set.half_width();
    let inner = IndexBox::around(region, level_set);
    let margin = 2.0 * f64::from(half_width) + reach.moves + reach.sees + 4.0;
    let source = match &inner {
        Some(inner) => inner.padded(margin).crop(level_set, run)?,
        None => level_set.clone(),
    };
    let mut blended = with_half_width(&source, half_width + reach.moves as f32 + 1.0, run)?;
    let weights = RegionWeights::new(blended.grid(), blended.transform(), region);
    if weights.leaves().is_empty() {
        return Ok(None);
    }
    let moved = operator(blended.clone())?;
    run.check(operation)?;
    blend(&mut blended, &weights, moved.grid());
    let touched: Vec<IVec3> = weights.leaves().iter().map(|id| blended.grid().origin(id)).collect();
    let rebuilt = rebuild(&blended, &Rebuild::band(half_width), run)?;
    drop((blended, moved, weights));
    run.check(operation)?;
    let around = inner.map(|inner| inner.padded(f64::from(half_width) + 1.0));
    Ok(Some(Merge::new(level_set, rebuilt.grid(), region, around).result(&touched)))
}

/// `edited`, whose operator has weighed the region itself, but for the voxels that were active in `original` with α = 0: those keep their
/// bits, and the field beside them is cut to what they allow. Both on one lattice.
pub(super) fn kept(original: &LevelSet, mut edited: LevelSet, region: &dyn Region) -> LevelSet {
    let (old, new) = (original.grid(), edited.grid().clone());
    let merge = Merge::new(original, &new, region, None);
    // Leaves whose kept voxels the edited field lost.
    let lost = |origin: &IVec3| new.find(*origin).is_sentinel() && !merge.kept(old.find(*origin)).is_empty();
    let lost: Vec<IVec3> = old.leaves().iter().map(|&id| old.origin(id)).filter(lost).collect();
    edited.grid_mut().add_leaves(&lost);
    let grid = edited.grid().clone();
    let differs = |id: LeafId| match old.find(grid.origin(id)) {
        from if from.is_sentinel() => false,
        from => from != id || !grid.shares_storage(old, id),
    };
    let here: LeafSet = grid.leaf_set().iter().filter(|&id| differs(id)).collect();
    edited.grid_mut().update(&here, |id, values, mask| {
        let from = old.find(grid.origin(id));
        for at in merge.kept(from).iter() {
            values.0[at] = old.values(from).0[at];
            mask.set(at, true);
        }
    });
    drop(grid);
    let grid = edited.grid();
    let edited_here = |id: &LeafId| match old.find(grid.origin(*id)) {
        from if from.is_sentinel() => true,
        from => !merge.weights.positive(from).is_empty(),
    };
    let mut changed: LeafSet = grid.leaves().iter().copied().filter(edited_here).collect();
    merge.cut_to_kept(&mut edited, &mut changed);
    edited.grid_mut().prune(&changed);
    edited
}

/// The part of a level set in a box of index space and so many voxels around it, closed by its sides.
pub(super) fn cut_out(
    level_set: &LevelSet,
    (lo, hi): (DVec3, DVec3),
    margin: f64,
    run: &RunOptions,
) -> Result<LevelSet> {
    IndexBox { lo, hi }.padded(margin).crop(level_set, run)
}

/// `level_set` with what an edited part of it has become in the leaves at these origins, where `region` is positive: all other active voxels
/// keep their bits. The part holds those leaves and the band around them; both on one lattice.
pub(super) fn put_back(
    level_set: &LevelSet,
    part: &LevelSet,
    leaves: FxHashSet<IVec3>,
    region: Option<&dyn Region>,
) -> LevelSet {
    let mut touched: Vec<IVec3> = leaves.iter().copied().collect();
    touched.sort_unstable_by_key(|o| (o.x, o.y, o.z));
    let changed = Leaves { leaves, region, transform: *level_set.transform() };
    let around = IndexBox::around(&changed, level_set);
    Merge::new(level_set, part.grid(), &changed, around).result(&touched)
}

/// Some leaves of a grid, in a region.
struct Leaves<'a> {
    leaves: FxHashSet<IVec3>,
    region: Option<&'a dyn Region>,
    transform: Transform,
}

impl Leaves<'_> {
    fn holds(&self, xyz: DVec3) -> bool {
        self.leaves.contains(&leaf_origin(self.transform.world_to_index(xyz).round().as_ivec3()))
    }
}

impl Region for Leaves<'_> {
    fn weight(&self, xyz: DVec3) -> f32 {
        if self.holds(xyz) { self.region.map_or(1.0, |region| region.weight(xyz)) } else { 0.0 }
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let corners = self
            .leaves
            .iter()
            .flat_map(|o| (0..8).map(|c| IVec3::new((c >> 2) & 1, (c >> 1) & 1, c & 1) * (LEAF_DIM - 1) + *o));
        let world = corners.map(|ijk| self.transform.voxel_to_world(ijk));
        Some(world.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p))))
    }

    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        // It is asked for leaves, by their middle.
        match self.holds(centre) {
            true => self.region.map_or([1.0; 2], |region| region.weights_within(centre, radius)),
            false => [0.0; 2],
        }
    }
}

/// Moves a level set by a flow that weighs its region itself; in a region, with exact distances again at the end, and the field beside voxels
/// that stay cut as [`kept`] does. For flows that come to rest at once where they are cut off, and may pile material up at the region's rim:
/// few renormalisations, against voxels that must not change, leave no distance there.
pub(super) fn held(
    level_set: &mut LevelSet,
    region: Option<&dyn Region>,
    run: &RunOptions,
    flow: impl FnOnce(&mut LevelSet) -> Result<Report>,
) -> Result<Report> {
    let Some(region) = region else { return flow(level_set) };
    let original = level_set.clone();
    let report = flow(level_set)?;
    let nothing = LevelSet::empty(*original.transform(), original.half_width());
    let moved = std::mem::replace(level_set, nothing);
    *level_set = if report.steps == 0 { moved } else { kept(&original, restored(&original, &moved, run)?, region) };
    Ok(report)
}

/// Exact distances where a flow has changed the field, and as far from there as distances can have changed.
fn restored(original: &LevelSet, moved: &LevelSet, run: &RunOptions) -> Result<LevelSet> {
    let changed = Changed::between(original.grid(), moved.grid(), moved.half_width() + 1.0);
    rebuild_where(moved, |first, last| changed.touches(first, last), run)
}

/// The cubes of 4³ voxels in which two grids differ, and those around.
struct Changed {
    /// Places of the cubes and of the boxes of 8, 16 and 32 voxels that hold them, in units of their edges.
    boxes: [FxHashSet<IVec3>; 4],
}

impl Changed {
    const CUBE: i32 = 4;

    /// What of `new` is no more than `margin` voxels from a voxel that is not as in `old`.
    fn between(old: &Grid, new: &Grid, margin: f32) -> Self {
        let cubes_of = |&id: &LeafId| {
            let from = old.find(new.origin(id));
            if from == id && new.shares_storage(old, id) {
                return Vec::new();
            }
            let other = old.mask(from).zip(new.mask(id), |a, b| a ^ b);
            let (before, after) = (&old.values(from).0, &new.values(id).0);
            let mut differs = [false; 8];
            for at in 0..LEAF_VOXELS {
                // The upper bits of x, y and z.
                let cube = at >> 6 & 4 | at >> 4 & 2 | at >> 2 & 1;
                differs[cube] |= before[at].to_bits() != after[at].to_bits() || other.get(at);
            }
            let first = new.origin(id) / Self::CUBE;
            let cubes = (0..8).filter(|&cube| differs[cube]).map(|cube| cube as i32);
            cubes.map(|cube| first + IVec3::new(cube >> 2, cube >> 1 & 1, cube & 1)).collect()
        };
        let cubes: Vec<Vec<IVec3>> = new.leaves().par_iter().map(cubes_of).collect();
        let reach = (margin / Self::CUBE as f32).ceil() as i32;
        let along = || -reach..=reach;
        let mut boxes: [FxHashSet<IVec3>; 4] = Default::default();
        for cube in cubes.concat() {
            let around = along().flat_map(|x| along().flat_map(move |y| along().map(move |z| IVec3::new(x, y, z))));
            boxes[0].extend(around.map(|step| cube + step));
        }
        for level in 1..boxes.len() {
            boxes[level] = boxes[level - 1].iter().map(|place| *place >> 1).collect();
        }
        Self { boxes }
    }

    /// Whether a box of 4, 8, 16 or 32 voxels holds any of it.
    fn touches(&self, first: IVec3, last: IVec3) -> bool {
        let edge = last.x - first.x + 1;
        // What is smaller than a cube is judged by the cube.
        let (edge, level) = (edge.max(Self::CUBE), (edge / Self::CUBE).max(1).ilog2() as usize);
        self.boxes.get(level).is_none_or(|boxes| boxes.contains(&first.div_euclid(IVec3::splat(edge))))
    }
}

/// φ ← (1 − α) φ + α φ_new where α > 0.
fn blend(level_set: &mut LevelSet, weights: &RegionWeights, new: &Grid) {
    let before = level_set.grid().clone();
    level_set.grid_mut().update(weights.leaves(), |id, values, mask| {
        let there = &new.values(new.find(before.origin(id))).0;
        let (alpha, positive) = (&weights.alpha(id).0, weights.positive(id));
        for at in mask.zip(positive, |active, positive| active & positive).iter() {
            values.0[at] = (1.0 - alpha[at]) * values.0[at] + alpha[at] * there[at];
        }
    });
}

/// A box of voxels in index space.
struct IndexBox {
    lo: DVec3,
    hi: DVec3,
}

impl IndexBox {
    /// Around a region, if it has bounds.
    fn around(region: &dyn Region, level_set: &LevelSet) -> Option<Self> {
        let (lo, hi) = level_set.transform().box_to_index(region.bounds()?);
        Some(Self { lo, hi })
    }

    fn padded(&self, voxels: f64) -> Self {
        Self { lo: self.lo - voxels, hi: self.hi + voxels }
    }

    fn holds(&self, ijk: IVec3) -> bool {
        let p = ijk.as_dvec3();
        p.cmpge(self.lo).all() && p.cmple(self.hi).all()
    }

    /// The part of a level set in the box, closed by its sides.
    fn crop(&self, level_set: &LevelSet, run: &RunOptions) -> Result<LevelSet> {
        let Some((lo, hi)) = level_set.grid().active_bounds() else { return Ok(level_set.clone()) };
        let (lo, hi) = (lo.as_dvec3() - 8.0, hi.as_dvec3() + 8.0);
        if self.lo.cmple(lo).all() && self.hi.cmpge(hi).all() {
            return Ok(level_set.clone());
        }
        // Not beyond the surface, where its sides would cost and close nothing.
        let (lo, hi) = (self.lo.max(lo), self.hi.min(hi));
        if lo.cmpge(hi).any() {
            return Ok(LevelSet::empty(*level_set.transform(), level_set.half_width()));
        }
        let (centre, half) = ((lo + hi) / 2.0, (hi - lo) / 2.0);
        let distance = |p: DVec3| {
            let d = (p - centre).abs() - half;
            d.max(DVec3::ZERO).length() + d.max_element().min(0.0)
        };
        let half_width = level_set.half_width();
        let rim = f64::from(half_width) + 2.0;
        let bounds = ((lo - rim).floor().as_ivec3(), (hi + rim).ceil().as_ivec3());
        let sides = LevelSet::from_distance(*level_set.transform(), half_width, bounds, distance, run)?;
        csg(level_set, &[&sides], CsgOperation::Intersection, run)
    }
}

/// The old grid with the rebuilt one around the region, but for the voxels that are kept.
struct Merge<'a> {
    old: &'a LevelSet,
    new: &'a Grid,
    weights: RegionWeights,
    around: Option<IndexBox>,
}

impl<'a> Merge<'a> {
    fn new(old: &'a LevelSet, new: &'a Grid, region: &dyn Region, around: Option<IndexBox>) -> Self {
        Self { old, new, weights: RegionWeights::new(old.grid(), old.transform(), region), around }
    }

    /// Of a leaf of the old grid, the voxels that keep their bits: active with α = 0.
    fn kept(&self, id: LeafId) -> LeafMask {
        if id.is_sentinel() {
            return LeafMask::EMPTY;
        }
        self.old.grid().mask(id).zip(self.weights.positive(id), |active, positive| active & !positive)
    }

    fn is_kept(&self, ijk: IVec3) -> bool {
        self.kept(self.old.grid().find(leaf_origin(ijk))).get(leaf_offset(ijk))
    }

    fn is_around(&self, ijk: IVec3) -> bool {
        self.around.as_ref().is_none_or(|around| around.holds(ijk))
    }

    /// `touched`: origins of the leaves where the sign may have changed.
    fn result(&self, touched: &[IVec3]) -> LevelSet {
        let (old, new) = (self.old.grid(), self.new);
        let mut result = self.old.clone();
        let reaches = |origin: &IVec3| self.is_around(*origin + 7) || self.is_around(*origin) || self.overlaps(*origin);
        let mut missing: Vec<IVec3> = new.leaves().iter().map(|&id| new.origin(id)).filter(reaches).collect();
        missing.extend(touched.iter().filter(|&&origin| new.find(origin) != old.find(origin)));
        missing.retain(|&origin| old.find(origin).is_sentinel());
        missing.sort_unstable_by_key(|o| (o.x, o.y, o.z));
        missing.dedup();
        let mut changed: LeafSet = result.grid_mut().add_leaves(&missing).into_iter().collect();
        let of_old = |id: &LeafId| reaches(&old.origin(*id)) && self.differs(*id);
        old.leaves().iter().copied().filter(of_old).for_each(|id| _ = changed.insert(id));

        let before = result.grid().clone();
        result.grid_mut().update(&changed, |id, values, mask| {
            let origin = before.origin(id);
            let there = new.find(origin);
            let (from, active) = (new.values(there), new.mask(there));
            let kept = self.kept(old.find(origin));
            for at in 0..LEAF_VOXELS {
                if !kept.get(at) && self.is_around(origin + offset_to_local(at)) {
                    values.0[at] = from.0[at];
                    mask.set(at, active.get(at));
                }
            }
        });
        drop(before);
        self.cut_to_kept(&mut result, &mut changed);
        result.grid_mut().prune(&changed);
        result
    }

    fn overlaps(&self, origin: IVec3) -> bool {
        self.around
            .as_ref()
            .is_none_or(|b| (origin + 7).as_dvec3().cmpge(b.lo).all() && origin.as_dvec3().cmple(b.hi).all())
    }

    /// Whether a leaf of the old grid has anything to take from the new one.
    fn differs(&self, id: LeafId) -> bool {
        if !self.weights.positive(id).is_empty() {
            return true;
        }
        let (old, there) = (self.old.grid(), self.new.find(self.old.grid().origin(id)));
        let appear = self.new.mask(there).zip(old.mask(id), |new, old| new & !old);
        let (before, after) = (&old.values(id).0, &self.new.values(there).0);
        !appear.is_empty()
            || (0..LEAF_VOXELS).any(|at| !old.mask(id).get(at) && (before[at] < 0.0) != (after[at] < 0.0))
    }

    /// Cuts the field beside kept voxels to what they allow.
    fn cut_to_kept(&self, result: &mut LevelSet, changed: &mut LeafSet) {
        let (voxel_size, background) = (result.voxel_size() as f32, result.background());
        for side in [1.0, -1.0] {
            let cut = self.cuts(result.grid(), changed, side, voxel_size);
            if cut.is_empty() {
                continue;
            }
            let mut origins: Vec<IVec3> = cut.keys().map(|ijk| leaf_origin(*ijk)).collect();
            origins.sort_unstable_by_key(|o| (o.x, o.y, o.z));
            origins.dedup();
            let missing: Vec<IVec3> =
                origins.iter().copied().filter(|o| result.grid().find(*o).is_sentinel()).collect();
            let added = result.grid_mut().add_leaves(&missing);
            added.into_iter().for_each(|id| _ = changed.insert(id));
            let set: LeafSet = origins.iter().map(|o| result.grid().find(*o)).collect();
            set.iter().for_each(|id| _ = changed.insert(id));
            let before = result.grid().clone();
            result.grid_mut().update(&set, |id, values, mask| {
                for at in 0..LEAF_VOXELS {
                    if let Some(value) = cut.get(&(before.origin(id) + offset_to_local(at))) {
                        values.0[at] = *value;
                        mask.set(at, value.abs() < background);
                    }
                }
            });
        }
    }

    /// The voxels, none of them kept, where `side`·φ is above what kept ones allow, with their new values.
    fn cuts(&self, grid: &Grid, changed: &LeafSet, side: f32, voxel_size: f32) -> FxHashMap<IVec3, f32> {
        let steps: Vec<(IVec3, f32)> = (0..27)
            .map(|n| IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1))
            .filter(|step| *step != IVec3::ZERO)
            .map(|step| (step, step.as_vec3().length() * voxel_size * STEEPEST))
            .collect();
        // Kept voxels lie beside changed ones in the next leaf as well.
        let around = |id: LeafId| grid.neighbours()[id.index()].into_iter().filter(|id| !id.is_sentinel());
        let leaves: LeafSet = changed.iter().flat_map(around).collect();
        let leaves: Vec<LeafId> = leaves.iter().collect();
        // Places in a cube of a leaf and the voxels around it.
        let beside: Vec<_> = steps.iter().map(|(step, most)| (*step + 1, *most)).collect();
        let seeds_of = |cube: &mut Cube, &id: &LeafId| {
            let origin = grid.origin(id);
            let kept = self.kept(self.old.grid().find(origin));
            let mut found = Vec::new();
            if kept.is_empty() {
                return found;
            }
            cube.gather(grid.value_pages(), &grid.neighbours()[id.index()], kept);
            for (x, word) in kept.0.into_iter().enumerate() {
                for y in (0..8).filter(|y| word >> (8 * y) & 0xff != 0) {
                    // A row at once: hardly any voxel is one.
                    let row = |x: usize, y: usize, z: usize| &cube.slab(x)[y * (LEAF_DIM as usize + 2) + z..][..8];
                    let here = row(x + 1, y + 1, 1);
                    let mut steep = [false; 8];
                    for (step, most) in &beside {
                        let [sx, sy, sz] = step.to_array().map(|s| s as usize);
                        for ((steep, there), here) in steep.iter_mut().zip(row(x + sx, y + sy, sz)).zip(here) {
                            *steep |= side * (there - here) > *most;
                        }
                    }
                    for z in (0..8).filter(|&z| steep[z] && word >> (8 * y + z) & 1 == 1) {
                        found.push((origin + IVec3::new(x as i32, y as i32, z as i32), here[z]));
                    }
                }
            }
            found
        };
        let seeds: Vec<Vec<(IVec3, f32)>> =
            leaves.par_iter().map_init(|| Cube::new(1), |cube, id| seeds_of(cube, id)).collect();
        let mut cut: FxHashMap<IVec3, f32> = FxHashMap::default();
        let mut queue: VecDeque<(IVec3, f32)> = seeds.concat().into();
        let mut accessor = grid.accessor();
        // The least value over all paths from kept voxels, whatever the order.
        while let Some((ijk, value)) = queue.pop_front() {
            for (step, most) in &steps {
                let (beside, limit) = (ijk + *step, value + side * most);
                let now = cut.get(&beside).copied().unwrap_or_else(|| accessor.value(beside));
                if side * (now - limit) > 0.0 && self.is_around(beside) && !self.is_kept(beside) {
                    cut.insert(beside, limit);
                    queue.push_back((beside, limit));
                }
            }
        }
        cut
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::levelset::testing::ball;
    use crate::region::{Primitive, Shape};

    #[test]
    fn what_a_region_leaves_out_keeps_its_bits() {
        let (before, after) = (ball(DVec3::ZERO, 12.0), ball(DVec3::X * 3.0, 12.0));
        let shape = Shape::Box { half_size: DVec3::new(20.0, 40.0, 40.0) };
        let region = Primitive::new(shape, DVec3::X * 20.0, DMat3::IDENTITY, [0.9, 1.0]).unwrap();
        let mixed = kept(&before, after.clone(), &region);
        let (mut same, mut new) = (0, 0);
        for &id in before.grid().leaves() {
            for offset in (0..LEAF_VOXELS).filter(|o| before.grid().mask(id).get(*o)) {
                let ijk = before.grid().origin(id) + offset_to_local(offset);
                if region.weight(ijk.as_dvec3()) == 0.0 {
                    assert_eq!(mixed.grid().voxel(ijk), before.grid().voxel(ijk));
                    same += 1;
                } else if mixed.grid().voxel(ijk) == after.grid().voxel(ijk) {
                    new += 1;
                }
            }
        }
        assert!(same > 1000 && new > 1000);
    }
}
