//! Sparse storage: leaves of 8³ voxels in pages, found through node tables. Knows nothing of distance.
//!
//! A [`Grid`] holds an f32 and an active bit a voxel near a surface, and a sign everywhere else: absent leaves are
//! all +[`background`](Grid::background) (outside) or all −background (inside). Inactive voxels of a leaf hold ±background as well.
//!
//! Leaves live in slots of pages behind `Arc` ([`Paged`]): copying a grid copies page pointers, and writing copies only
//! the pages that change. The slot of a leaf depends on the grid's history; every list and every sum goes by the order of
//! origins and does not.

mod accessor;
mod combine;
mod leaf;
mod leaf_set;
mod page_pool;
mod paged;
mod prefetch;
mod topology;
mod transform;
mod volume;

use std::sync::Arc;

use glam::IVec3;
use rayon::prelude::*;

pub use accessor::Accessor;
pub use combine::{Combination, SignRule};
pub use leaf::{Face, LEAF_DIM, LEAF_VOXELS, LeafMask, LeafValues, leaf_offset, leaf_origin, offset_to_local};
pub use leaf_set::LeafSet;
pub use paged::{LeafId, PAGE_LEAVES, PageLeaves, Paged};
pub(crate) use prefetch::Ahead;
use topology::Topology;
pub use topology::{NeighbourTable, Neighbours, neighbour_index};
pub use transform::{Transform, VOXEL_SIZES};
pub use volume::{VectorVolume, Volume};

/// Largest index coordinate of a voxel, either sign: beyond it the arithmetic of neighbours could overflow.
pub const MAX_COORD: i32 = 1 << 30;

/// A sparse grid of f32 with a sign everywhere. Cheap to clone.
#[derive(Clone)]
pub struct Grid {
    background: f32,
    topology: Arc<Topology>,
    values: Paged<LeafValues>,
    masks: Paged<LeafMask>,
}

impl Grid {
    /// A grid without leaves, outside everywhere. `background` must be positive.
    pub fn empty(background: f32) -> Self {
        Self::from_origins(background, &[])
    }

    /// A grid with leaves at `origins` (sorted by x, y, z; multiples of 8; no duplicates), every voxel inactive and outside.
    pub fn from_origins(background: f32, origins: &[IVec3]) -> Self {
        debug_assert!(background > 0.0);
        Self::blank_of(Arc::new(Topology::from_origins(origins)), background)
    }

    /// A grid of the same leaves with another background: no voxel active, every leaf outside.
    pub(crate) fn blank(&self, background: f32) -> Self {
        Self::blank_of(self.topology.clone(), background)
    }

    fn blank_of(topology: Arc<Topology>, background: f32) -> Self {
        let mut values = Paged::filled(1, LeafValues::filled(background));
        *values.get_mut(LeafId::INSIDE) = LeafValues::filled(-background);
        values.grow(topology.page_count(), LeafValues::filled(background));
        let masks = Paged::filled(topology.page_count(), LeafMask::EMPTY);
        Self { background, topology, values, masks }
    }

    /// A grid of the same leaves and active voxels whose values are all 0, the background as well: for fields that are no distance.
    pub(crate) fn zeroed(&self) -> Self {
        let values = Paged::filled(self.topology.page_count(), LeafValues::default());
        Self { background: 0.0, topology: self.topology.clone(), values, masks: self.masks.clone() }
    }

    /// As `zeroed`, with the active voxels of some leaves alone.
    pub(crate) fn zeroed_on(&self, leaves: &LeafSet) -> Self {
        let mut masks = Paged::filled(self.topology.page_count(), LeafMask::EMPTY);
        masks.par_update(leaves, |id, mask: &mut LeafMask| *mask = self.mask(id));
        Self { masks, ..self.zeroed() }
    }

    /// A copy that shares nothing with this grid.
    pub fn deep_copy(&self) -> Self {
        let mut copy = self.clone();
        Arc::make_mut(&mut copy.topology).unshare();
        copy.update_all(|_, _, _| ());
        copy
    }

    /// The value that stands for everything outside; its negative for everything inside.
    pub fn background(&self) -> f32 {
        self.background
    }

    /// The leaves in the order of their origins.
    pub fn leaves(&self) -> &[LeafId] {
        self.topology.order()
    }

    /// The place of each leaf in [`leaves`](Self::leaves), by slot ([`LeafId::index`]).
    pub(crate) fn places(&self) -> Vec<u32> {
        self.topology.places()
    }

    /// Slots in all, those without a leaf included: the length of a list by [`LeafId::index`].
    pub(crate) fn slot_count(&self) -> usize {
        self.topology.slot_count()
    }

    /// All leaves as a set.
    pub fn leaf_set(&self) -> &LeafSet {
        self.topology.live()
    }

    /// First voxel of a leaf.
    pub fn origin(&self, id: LeafId) -> IVec3 {
        self.topology.origin(id)
    }

    /// Values of a leaf or sentinel.
    #[inline(always)]
    pub fn values(&self, id: LeafId) -> &LeafValues {
        self.values.get(id)
    }

    /// Active mask of a leaf; empty for a sentinel.
    #[inline(always)]
    pub fn mask(&self, id: LeafId) -> LeafMask {
        *self.masks.get(id)
    }

    /// The leaf at `origin` (a multiple of 8), or the sentinel of the sign there.
    pub fn find(&self, origin: IVec3) -> LeafId {
        self.topology.find(origin)
    }

    /// The 27 leaves around and including each leaf, by slot ([`LeafId::index`]).
    pub fn neighbours(&self) -> NeighbourTable<'_> {
        self.topology.neighbours()
    }

    /// Value and state of one voxel. For many voxels use an [`Accessor`].
    pub fn voxel(&self, ijk: IVec3) -> (f32, bool) {
        let id = self.find(leaf_origin(ijk));
        let offset = leaf_offset(ijk);
        (self.values(id).0[offset], self.mask(id).get(offset))
    }

    /// A reader of single voxels that remembers the last leaf.
    pub fn accessor(&self) -> Accessor<'_> {
        Accessor::new(self)
    }

    /// Number of active voxels.
    pub fn active_voxels(&self) -> u64 {
        self.leaves().iter().map(|&id| u64::from(self.mask(id).count())).sum()
    }

    /// Smallest box of voxels around the active ones, both ends included; `None` if there are none.
    pub fn active_bounds(&self) -> Option<(IVec3, IVec3)> {
        self.map_leaves(|id| {
            let mask = self.mask(id);
            let bounds = mask.iter().map(offset_to_local).map(|p| (p, p)).reduce(join_bounds)?;
            Some((bounds.0 + self.origin(id), bounds.1 + self.origin(id)))
        })
        .into_iter()
        .flatten()
        .reduce(join_bounds)
    }

    /// Bytes held, shared pages included.
    pub fn bytes(&self) -> u64 {
        self.values.bytes() + self.masks.bytes() + self.topology.bytes()
    }

    /// `f` of every leaf, in the order of origins, computed in parallel.
    pub fn map_leaves<R: Send>(&self, f: impl Fn(LeafId) -> R + Sync) -> Vec<R> {
        self.leaves().par_iter().with_min_len(16).map(|&id| f(id)).collect()
    }

    /// Sum of `f` over the leaves, added up in the order of origins: the same bits for any number of threads.
    pub fn sum_leaves(&self, f: impl Fn(LeafId) -> f64 + Sync) -> f64 {
        self.map_leaves(f).into_iter().sum()
    }

    /// Calls `f` with the values and masks of every page that holds a leaf of `set`, in parallel; the results in page order.
    pub fn update_pages<R: Send>(
        &mut self,
        set: &LeafSet,
        f: impl Fn(PageLeaves, &mut [LeafValues], &mut [LeafMask]) -> R + Sync,
    ) -> Vec<R> {
        self.values.par_update_pages_with(&mut self.masks, set, f)
    }

    /// Changes the values and masks of the leaves of `set`, in parallel. Inactive voxels must be left at ±background.
    pub fn update(&mut self, set: &LeafSet, f: impl Fn(LeafId, &mut LeafValues, &mut LeafMask) + Sync) {
        self.values.par_update_pages_with(&mut self.masks, set, |leaves, values, masks| {
            leaves.for_each(|id| f(id, &mut values[PageLeaves::slot(id)], &mut masks[PageLeaves::slot(id)]));
        });
    }

    /// The pages of active masks.
    pub fn mask_pages(&self) -> &Paged<LeafMask> {
        &self.masks
    }

    /// Origins of the absent leaves that face neighbours of the voxels of `seed` lie in, sorted. `seed` is empty but in the leaves of `set`.
    pub fn absent_beside(&self, seed: &Paged<LeafMask>, set: &LeafSet) -> Vec<IVec3> {
        let around = self.neighbours();
        let beside = |id: LeafId| {
            let around = &around[id.index()];
            Face::ALL.into_iter().filter_map(move |face| {
                let absent = around[neighbour_index(face.step())].is_sentinel() && !seed.get(id).spill(face).is_empty();
                absent.then(|| self.origin(id) + face.step() * LEAF_DIM)
            })
        };
        let mut origins: Vec<IVec3> = set.par_pages().flat_map_iter(|leaves| leaves.iter().flat_map(beside)).collect();
        origins.sort_unstable_by_key(|o| topology::key(*o));
        origins.dedup();
        origins
    }

    /// Activates the voxels of `seed` and their face neighbours, in the leaves of `set`. `seed` has the pages of this grid.
    pub fn activate_beside(&mut self, seed: &Paged<LeafMask>, set: &LeafSet) {
        let around = self.topology.neighbours();
        self.masks.par_update(set, |id, mask| {
            let mut grown = seed.get(id).dilated();
            for face in Face::ALL {
                let beyond = around[id.index()][neighbour_index(face.step())];
                grown = grown.zip(seed.get(beyond).spill(face.opposite()), |a, b| a | b);
            }
            *mask = mask.zip(grown, |a, b| a | b);
        });
    }

    /// Changes the values and masks of all leaves, in parallel.
    pub fn update_all(&mut self, f: impl Fn(LeafId, &mut LeafValues, &mut LeafMask) + Sync) {
        let set = self.leaf_set().clone();
        self.update(&set, f);
    }

    /// The pages of values, for kernels that write to a second buffer.
    pub fn value_pages(&self) -> &Paged<LeafValues> {
        &self.values
    }

    /// Exchanges the values with a second buffer of the same topology.
    pub(crate) fn swap_values(&mut self, buffer: &mut Paged<LeafValues>) {
        debug_assert_eq!(self.values.page_count(), buffer.page_count());
        std::mem::swap(&mut self.values, buffer);
    }

    /// Takes the masks out, to be changed while the rest of the grid is read. Until they are restored there are none to look at.
    pub(crate) fn take_masks(&mut self) -> Paged<LeafMask> {
        std::mem::take(&mut self.masks)
    }

    /// Puts back what [`take_masks`](Self::take_masks) took.
    pub(crate) fn restore_masks(&mut self, masks: Paged<LeafMask>) {
        debug_assert_eq!(self.values.page_count(), masks.page_count());
        self.masks = masks;
    }

    /// Adds leaves at `origins` (sorted, no leaf there yet): all voxels inactive, with the sign that the space had. Returns their ids.
    pub fn add_leaves(&mut self, origins: &[IVec3]) -> Vec<LeafId> {
        if origins.is_empty() {
            return Vec::new();
        }
        let topology = Arc::make_mut(&mut self.topology);
        let added = topology.insert(origins);
        self.values.grow_unwritten(topology.page_count());
        self.masks.grow(topology.page_count(), LeafMask::EMPTY);
        let inside: LeafSet =
            added.iter().filter(|(_, sentinel)| *sentinel == LeafId::INSIDE).map(|(id, _)| *id).collect();
        let added: Vec<LeafId> = added.into_iter().map(|(id, _)| id).collect();
        let (set, background) = (added.iter().copied().collect(), self.background);
        self.update(&set, |id, values, mask| {
            values.0.fill(if inside.contains(id) { -background } else { background });
            *mask = LeafMask::EMPTY;
        });
        added
    }

    /// Removes those of `candidates` that have no active voxel and one sign, which stays known.
    pub fn prune(&mut self, candidates: &LeafSet) -> Vec<LeafId> {
        let removed: Vec<_> = candidates
            .par_pages()
            .flat_map_iter(PageLeaves::iter)
            .filter(|&id| self.mask(id).is_empty())
            .filter_map(|id| Some((id, LeafId::sentinel(self.values(id).one_sign()?))))
            .collect();
        if !removed.is_empty() {
            Arc::make_mut(&mut self.topology).remove(&removed);
        }
        removed.into_iter().map(|(id, _)| id).collect()
    }

    /// Removes leaves, whatever they hold; the space takes the sign `inside`.
    pub fn remove_leaves(&mut self, leaves: &[LeafId], inside: bool) {
        let removed: Vec<_> = leaves.iter().map(|&id| (id, LeafId::sentinel(inside))).collect();
        if !removed.is_empty() {
            Arc::make_mut(&mut self.topology).remove(&removed);
        }
    }

    /// Where neither this grid nor `other` has a leaf, the sign becomes `sign(inside here, inside there)`.
    pub fn combine_signs(&mut self, other: &Self, sign: impl Fn(bool, bool) -> bool) {
        Arc::make_mut(&mut self.topology).combine_signs(&other.topology, sign);
    }

    /// Gives all absent leaves in the box of voxels `lo..hi` (multiples of 8, `hi` excluded) a sign.
    pub fn set_sign(&mut self, lo: IVec3, hi: IVec3, inside: bool) {
        Arc::make_mut(&mut self.topology).set_sign(lo, hi, inside);
    }

    /// Gives every absent leaf its sign, from the leaves: the surface must be closed, and the last voxel in z of each
    /// row of every leaf's border must have the sign of the space beyond.
    pub fn flood_signs(&mut self) {
        let values = &self.values;
        Arc::make_mut(&mut self.topology).flood_signs(|id| values.get(id).0[7] < 0.0);
    }

    /// Boxes of absent leaves inside the surface: first voxel and edge in voxels (8, or 128 for a whole node), by origin.
    pub fn inside_tiles(&self) -> Vec<(IVec3, i32)> {
        self.topology.inside_tiles()
    }

    /// Whether two grids share the storage of a leaf: true after a copy until either writes near it.
    pub fn shares_storage(&self, other: &Self, id: LeafId) -> bool {
        self.values.shares_page(&other.values, id)
    }
}

fn join_bounds(a: (IVec3, IVec3), b: (IVec3, IVec3)) -> (IVec3, IVec3) {
    (a.0.min(b.0), a.1.max(b.1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_leaves_and_signs() {
        let origins = [IVec3::new(-8, 0, 0), IVec3::new(0, 0, 0), IVec3::new(0, 0, 128)];
        let mut grid = Grid::from_origins(3.0, &origins);
        grid.update_all(|id, values, mask| {
            values.0[9] = id.index() as f32;
            mask.set(9, true);
        });
        let id = grid.find(IVec3::ZERO);
        assert_eq!(grid.voxel(IVec3::new(0, 1, 1)), (id.index() as f32, true));
        assert_eq!(grid.voxel(IVec3::new(0, 1, 2)), (3.0, false));
        assert_eq!(grid.active_voxels(), 3);
        assert_eq!(grid.active_bounds(), Some((IVec3::new(-8, 1, 1), IVec3::new(0, 1, 129))));
        grid.set_sign(IVec3::new(0, 0, 8), IVec3::new(8, 8, 128), true);
        assert_eq!(grid.voxel(IVec3::new(3, 3, 60)), (-3.0, false));
        assert_eq!(grid.inside_tiles().len(), 15);
    }

    #[test]
    fn a_copy_is_shared_until_written_and_pruning_keeps_the_sign() {
        let origins: Vec<_> = (0..200).map(|z| IVec3::new(0, 0, 8 * z)).collect();
        let mut grid = Grid::from_origins(1.0, &origins);
        grid.update_all(|_, values, mask| {
            values.0.fill(-0.5);
            *mask = LeafMask::FULL;
        });
        let copy = grid.clone();
        let first = grid.find(IVec3::ZERO);
        let last = grid.find(IVec3::new(0, 0, 8 * 199));
        let only_first: LeafSet = [first].into_iter().collect();
        grid.update(&only_first, |_, values, mask| {
            values.0.fill(-1.0);
            *mask = LeafMask::EMPTY;
        });
        assert!(!grid.shares_storage(&copy, first));
        assert!(grid.shares_storage(&copy, last));
        assert_eq!(copy.voxel(IVec3::ZERO), (-0.5, true));
        let all = grid.leaf_set().clone();
        assert_eq!(grid.prune(&all), [first]);
        assert_eq!(grid.voxel(IVec3::ZERO), (-1.0, false));
        assert_eq!(grid.leaves().len(), 199);
        assert_eq!(copy.leaves().len(), 200);
    }
}
