//! A region evaluated on a grid: α at the active voxels of the leaves that it touches.

use fearless_simd::Simd;
use glam::DVec3;
use rayon::prelude::*;

use super::Region;
use crate::grid::{
    Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet, LeafValues, PAGE_LEAVES, PageLeaves, Paged, Transform,
    offset_to_local,
};
use crate::stencil::simd::{Work, dispatch};

/// α at the active voxels of a grid, by leaf slot. Voxels are looked at when they become active. Only leaves at the region's rim have
/// values of their own.
pub struct RegionWeights {
    /// Where the values of a leaf are, by slot.
    places: Vec<Place>,
    /// α of the leaves with values of their own, by slots that are numbered here; 0 where no voxel was active yet.
    rim: Paged<LeafValues>,
    /// The leaf of each of these slots.
    rim_leaves: Vec<LeafId>,
    /// The slots that are free.
    free: Vec<LeafId>,
    /// Where α is above 0, as far as it is known.
    positive: Paged<LeafMask>,
    known: Paged<LeafMask>,
    leaves: LeafSet,
}

/// Where the values of a leaf are.
#[derive(Clone, Copy, Default)]
enum Place {
    /// None is known: as good as 0.
    #[default]
    Unknown,
    /// α = 1 in the whole leaf.
    One,
    /// In a slot of the rim.
    Rim(LeafId),
}

static ZERO: LeafValues = LeafValues([0.0; LEAF_VOXELS]);
static ONE: LeafValues = LeafValues([1.0; LEAF_VOXELS]);

impl RegionWeights {
    /// Evaluates `region` on the leaves of `grid` that it can touch.
    pub fn new(grid: &Grid, transform: &Transform, region: &dyn Region) -> Self {
        let mut weights = Self {
            places: Vec::new(),
            rim: Paged::default(),
            rim_leaves: Vec::new(),
            free: Vec::new(),
            positive: Paged::default(),
            known: Paged::default(),
            leaves: LeafSet::default(),
        };
        weights.evaluate(grid, transform, region, &touched_leaves(grid, transform, region));
        weights
    }

    /// Evaluates `region` at the voxels of `leaves` that became active.
    pub fn evaluate(&mut self, grid: &Grid, transform: &Transform, region: &dyn Region, leaves: &LeafSet) {
        self.grow(grid.value_pages().page_count());
        let known = &self.known;
        let unknown = |id| grid.mask(id).zip(*known.get(id), |active, known| active & !known);
        // Leaves with voxels to look at, and whether α = 1 in all of one.
        let look = |id| {
            let whole = || known.get(id).is_empty() && range(grid, transform, region, id)[0] == 1.0;
            (!unknown(id).is_empty()).then(|| (id, whole()))
        };
        let new: Vec<_> = leaves.par_pages().flat_map_iter(|leaves| leaves.iter().filter_map(look)).collect();
        let mut touched = LeafSet::default();
        for &(id, whole) in &new {
            let place = &mut self.places[id.index()];
            if whole {
                *place = Place::One;
                continue;
            }
            if let Place::Unknown = place {
                let free = self.free.pop().unwrap_or_else(|| {
                    self.rim_leaves.push(id);
                    LeafId::new(self.rim_leaves.len() - 1)
                });
                self.rim_leaves[free.index()] = id;
                *place = Place::Rim(free);
            }
            if let Place::Rim(slot) = *place {
                touched.insert(slot);
            }
        }
        self.rim.grow_unwritten(self.rim_leaves.len().div_ceil(PAGE_LEAVES));
        let rim_leaves = &self.rim_leaves;
        let found = self.rim.par_update_pages(&touched, |slots, alpha| {
            let mut places = [DVec3::ZERO; LEAF_VOXELS];
            let mut found = Vec::with_capacity(slots.iter().count());
            for slot in slots.iter() {
                let id = rim_leaves[slot.index()];
                let alpha = &mut alpha[PageLeaves::slot(slot)];
                if known.get(id).is_empty() {
                    alpha.0.fill(0.0);
                }
                let mut positive = LeafMask::EMPTY;
                dispatch(RimLeaf {
                    region,
                    transform,
                    origin: grid.origin(id).as_dvec3(),
                    new: unknown(id),
                    alpha,
                    positive: &mut positive,
                    places: &mut places,
                });
                found.push((id, positive));
            }
            found
        });
        for (id, new) in found.into_iter().flatten() {
            let positive = self.positive.get_mut(id);
            *positive = positive.zip(new, |old, new| old | new);
            let known = self.known.get_mut(id);
            *known = known.zip(grid.mask(id), |known, active| known | active);
            if !positive.is_empty() {
                self.leaves.insert(id);
            }
        }
        for (id, _) in new.into_iter().filter(|(_, whole)| *whole) {
            *self.positive.get_mut(id) = LeafMask::FULL;
            *self.known.get_mut(id) = LeafMask::FULL;
            self.leaves.insert(id);
        }
    }

    /// Makes room for the leaves of so many pages.
    pub fn grow(&mut self, pages: usize) {
        self.places.resize(self.places.len().max(pages * PAGE_LEAVES), Place::default());
        self.positive.grow(pages, LeafMask::EMPTY);
        self.known.grow(pages, LeafMask::EMPTY);
    }

    /// Forgets leaves that the grid lost.
    pub fn forget(&mut self, leaves: &[LeafId]) {
        for &id in leaves {
            self.leaves.remove(id);
            *self.known.get_mut(id) = LeafMask::EMPTY;
            *self.positive.get_mut(id) = LeafMask::EMPTY;
            if let Place::Rim(slot) = std::mem::take(&mut self.places[id.index()]) {
                self.free.push(slot);
            }
        }
    }

    /// The leaves with an active voxel where α is above 0.
    pub fn leaves(&self) -> &LeafSet {
        &self.leaves
    }

    /// α at the active voxels of a leaf; anything at the others.
    #[inline(always)]
    pub fn alpha(&self, id: LeafId) -> &LeafValues {
        match self.places[id.index()] {
            Place::Unknown => &ZERO,
            Place::One => &ONE,
            Place::Rim(slot) => self.rim.get(slot),
        }
    }

    /// The active voxels of a leaf where α is above 0, and maybe others where it is.
    #[inline(always)]
    pub fn positive(&self, id: LeafId) -> LeafMask {
        *self.positive.get(id)
    }
}

/// The leaves of `grid` that `region` may touch.
pub fn touched_leaves(grid: &Grid, transform: &Transform, region: &dyn Region) -> LeafSet {
    // In index space a leaf is beside a box at a glance.
    let bounds = region.bounds().map(|bounds| transform.box_to_index(bounds));
    let near = |id| {
        let origin = grid.origin(id).as_dvec3();
        bounds.is_none_or(|(lo, hi)| (origin + f64::from(LEAF_DIM)).cmpge(lo).all() && origin.cmple(hi).all())
    };
    let touched = |id: &LeafId| near(*id) && range(grid, transform, region, *id)[1] > 0.0;
    let touched: Vec<_> = grid.leaves().par_iter().copied().filter(touched).collect();
    touched.into_iter().collect()
}

/// α at the voxels `new` of a leaf. As vector work because bits are found one by one otherwise.
struct RimLeaf<'a> {
    region: &'a dyn Region,
    transform: &'a Transform,
    origin: DVec3,
    new: LeafMask,
    alpha: &'a mut LeafValues,
    positive: &'a mut LeafMask,
    places: &'a mut [DVec3; LEAF_VOXELS],
}

impl Work for RimLeaf<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let to_world = self.transform.to_world();
        let mut count = 0;
        self.new.for_each(
            #[inline(always)]
            |offset| {
                let ijk = self.origin + offset_to_local(offset).as_dvec3();
                self.places[count] = to_world.transform_point3(ijk);
                count += 1;
            },
        );
        let mut found = [0.0; LEAF_VOXELS];
        self.region.weights(&self.places[..count], &mut found[..count]);
        let mut next = 0;
        self.new.for_each(
            #[inline(always)]
            |offset| {
                let alpha = found[next].clamp(0.0, 1.0);
                next += 1;
                self.alpha.0[offset] = alpha;
                self.positive.0[offset >> 6] |= u64::from(alpha > 0.0) << (offset & 63);
            },
        );
    }
}

/// Limits of α in a leaf.
fn range(grid: &Grid, transform: &Transform, region: &dyn Region, id: LeafId) -> [f32; 2] {
    // From the centre of a leaf to those of its outermost voxels.
    let half = (f64::from(LEAF_DIM) - 1.0) / 2.0;
    let centre = transform.index_to_world(grid.origin(id).as_dvec3() + half);
    region.weights_within(centre, half * 3f64.sqrt() * transform.voxel_size())
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3, IVec3};

    use super::*;
    use crate::levelset::testing::ball;
    use crate::region::{Primitive, Shape};

    #[test]
    fn weights_are_the_regions_wherever_leaves_come_and_go() {
        let mut level_set = ball(DVec3::ZERO, 20.0);
        let transform = *level_set.transform();
        let region =
            Primitive::new(Shape::Sphere { radius: 30.0 }, DVec3::X * 25.0, DMat3::IDENTITY, [0.7, 1.0]).unwrap();
        let check = |weights: &RegionWeights, grid: &Grid| {
            let mut seen = [0; 3];
            for &id in grid.leaves() {
                for offset in grid.mask(id).iter() {
                    let alpha = region.weight(transform.voxel_to_world(grid.origin(id) + offset_to_local(offset)));
                    assert_eq!((weights.alpha(id).0[offset], weights.positive(id).get(offset)), (alpha, alpha > 0.0));
                    assert!(alpha == 0.0 || weights.leaves().contains(id));
                    seen[usize::from(alpha > 0.0) + usize::from(alpha == 1.0)] += 1;
                }
            }
            assert!(seen.into_iter().all(|n| n > 1000), "{seen:?}");
        };
        let grid = level_set.grid_mut();
        let mut weights = RegionWeights::new(grid, &transform, &region);
        check(&weights, grid);
        let gone: Vec<_> = grid.leaves().iter().copied().step_by(5).collect();
        grid.remove_leaves(&gone, false);
        weights.forget(&gone);
        // New leaves take the slots of the old ones.
        let origins: Vec<_> = (-3..4).map(|y| IVec3::new(4, y, 0) * 8).collect();
        let added = grid.add_leaves(&origins);
        assert!(added.iter().all(|id| gone.contains(id)));
        let added: LeafSet = added.into_iter().collect();
        grid.update(&added, |_, _, mask| *mask = LeafMask::FULL);
        weights.evaluate(grid, &transform, &region, &added);
        check(&weights, grid);
    }
}
