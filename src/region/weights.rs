//! A region evaluated on a grid: α at the active voxels of the leaves that it touches.

use rayon::prelude::*;

use super::Region;
use crate::grid::{
    Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet, LeafValues, PAGE_LEAVES, Paged, Transform, offset_to_local,
};

/// α at the active voxels of a grid, by leaf slot. Voxels are looked at when they become active. Only leaves at the region's rim have
/// values of their own.
pub struct RegionWeights {
    /// Where the values of a leaf are, by slot.
    places: Vec<Place>,
    /// The leaves with values of their own; a sentinel in the place of those that are gone.
    rim: Vec<(LeafId, LeafValues)>,
    /// Places in `rim` that are free.
    free: Vec<u32>,
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
    /// In the list of the rim.
    Rim(u32),
}

static ZERO: LeafValues = LeafValues([0.0; LEAF_VOXELS]);
static ONE: LeafValues = LeafValues([1.0; LEAF_VOXELS]);

impl RegionWeights {
    /// Evaluates `region` on the leaves of `grid` that it can touch.
    pub fn new(grid: &Grid, transform: &Transform, region: &dyn Region) -> Self {
        let mut weights = Self {
            places: Vec::new(),
            rim: Vec::new(),
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
        let new: Vec<LeafId> = leaves.iter().filter(|&id| !unknown(id).is_empty()).collect();
        let whole = |id: &LeafId| known.get(*id).is_empty() && range(grid, transform, region, *id)[0] == 1.0;
        let whole: Vec<bool> = new.par_iter().map(whole).collect();
        for (&id, whole) in new.iter().zip(whole) {
            let place = &mut self.places[id.index()];
            if whole {
                *place = Place::One;
            } else if let Place::Unknown = place {
                let free = self.free.pop().unwrap_or_else(|| {
                    self.rim.push((LeafId::OUTSIDE, ZERO.clone()));
                    self.rim.len() as u32 - 1
                });
                self.rim[free as usize].0 = id;
                *place = Place::Rim(free);
            }
        }
        let set: LeafSet = new.iter().copied().collect();
        self.rim.par_iter_mut().filter(|(id, _)| set.contains(*id)).for_each(|(id, alpha)| {
            let origin = grid.origin(*id);
            let offsets: Vec<usize> = unknown(*id).iter().collect();
            let xyz: Vec<_> =
                offsets.iter().map(|&offset| transform.voxel_to_world(origin + offset_to_local(offset))).collect();
            let mut found = [0.0; LEAF_VOXELS];
            region.weights(&xyz, &mut found);
            for (offset, found) in offsets.into_iter().zip(found) {
                alpha.0[offset] = found.clamp(0.0, 1.0);
            }
        });
        let (places, rim) = (&self.places, &self.rim);
        self.positive.par_update(&set, |id, positive| {
            if let Place::Rim(place) = places[id.index()] {
                let alpha = &rim[place as usize].1;
                unknown(id).iter().for_each(|offset| positive.set(offset, alpha.0[offset] > 0.0));
            } else {
                *positive = LeafMask::FULL;
            }
        });
        let positive = &self.positive;
        self.known.par_update(&set, |id, known| {
            let all = *positive.get(id) == LeafMask::FULL;
            *known = if all { LeafMask::FULL } else { known.zip(grid.mask(id), |known, active| known | active) };
        });
        for id in new.into_iter().filter(|id| !self.positive.get(*id).is_empty()) {
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
            if let Place::Rim(place) = std::mem::take(&mut self.places[id.index()]) {
                self.rim[place as usize].0 = LeafId::OUTSIDE;
                self.free.push(place);
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
            Place::Rim(place) => &self.rim[place as usize].1,
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
    let touched = |id: &LeafId| range(grid, transform, region, *id)[1] > 0.0;
    let touched: Vec<_> = grid.leaves().par_iter().copied().filter(touched).collect();
    touched.into_iter().collect()
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
