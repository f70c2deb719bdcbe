//! One grid of several: leaves that one part alone decides are taken over with their pages, only the others are made.
//!
//! The leaves of all parts are visited once, in the order of origins. Where a part has the sign that wins, no leaf is left;
//! where one part has a leaf and the others lose, its leaf stays as it is; where several have one, a new leaf is merged.
//! A page of which at least half survives is shared with its part; of any other page the survivors are copied, so that a
//! result holds at most twice the memory of its leaves.

use glam::IVec3;
use rayon::prelude::*;
use smallvec::SmallVec;

use super::topology::{Cursor, Topology, key};
use super::{Grid, LeafId, LeafMask, LeafSet, LeafValues, PAGE_LEAVES};

/// How the signs of several grids make one: a sign that wins does so where any part has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SignRule {
    /// The sign that wins: inside makes a union, outside an intersection.
    pub inside_wins: bool,
    /// Whether all parts but the first count with the opposite sign.
    pub complement_others: bool,
}

impl SignRule {
    /// Whether part `part` counts with the opposite sign.
    fn complements(self, part: usize) -> bool {
        part > 0 && self.complement_others
    }

    /// What absent leaves of part `part` look like where it wins.
    pub(super) fn winner(self, part: usize) -> LeafId {
        LeafId::sentinel(self.inside_wins != self.complements(part))
    }

    fn factor(self, part: usize) -> f32 {
        if self.complements(part) { -1.0 } else { 1.0 }
    }
}

/// The leaves of the parts that lie at one place, by part.
type Sources = SmallVec<[(u32, LeafId); 2]>;

/// A grid to be made of several others of one background, planned but not yet made.
pub struct Combination<'a> {
    parts: &'a [&'a Grid],
    rule: SignRule,
    /// The pages that are shared: part and page, in the order of the new grid's pages after the first.
    shared: Vec<(usize, usize)>,
    /// All leaves of the new grid with their origins, in order.
    leaves: Vec<(IVec3, LeafId)>,
    /// What the new leaves are made of, by slot from the first that is not shared.
    made: Vec<Sources>,
}

/// A leaf of the result, before it has a slot.
struct Place {
    origin: IVec3,
    sources: Sources,
}

impl<'a> Combination<'a> {
    /// Finds out which leaves the result has and where each comes from.
    pub fn new(parts: &'a [&'a Grid], rule: SignRule) -> Self {
        let places = places(parts, rule);
        let as_it_is = |place: &Place| match place.sources[..] {
            [(part, id)] if !rule.complements(part as usize) => Some((part as usize, id)),
            _ => None,
        };
        let mut survivors: Vec<Vec<u32>> = parts.iter().map(|p| vec![0; p.topology.page_count()]).collect();
        for (part, id) in places.iter().flatten().filter_map(as_it_is) {
            survivors[part][id.page()] += 1;
        }
        // The page of the new grid that a page of a part becomes; 0, the page of the sentinels, where it is not shared.
        let mut shared = Vec::new();
        for (part, counts) in survivors.iter_mut().enumerate() {
            for (page, count) in counts.iter_mut().enumerate() {
                let share = *count as usize * 2 >= PAGE_LEAVES;
                if share {
                    shared.push((part, page));
                }
                *count = if share { shared.len() as u32 } else { 0 };
            }
        }
        let first_made = (1 + shared.len()) * PAGE_LEAVES;
        let mut made = Vec::new();
        let leaves = places
            .into_iter()
            .flatten()
            .map(|place| {
                let page = as_it_is(&place).map_or(0, |(part, id)| survivors[part][id.page()] as usize);
                let id = match as_it_is(&place) {
                    Some((_, id)) if page != 0 => LeafId::new(page * PAGE_LEAVES + id.slot()),
                    _ => {
                        made.push(place.sources);
                        LeafId::new(first_made + made.len() - 1)
                    }
                };
                (place.origin, id)
            })
            .collect();
        Self { parts, rule, shared, leaves, made }
    }

    /// Bytes that making the grid takes: its new leaves and its tables.
    pub fn bytes(&self) -> u64 {
        let leaf = size_of::<LeafValues>() + size_of::<LeafMask>();
        let tables: u64 = self.parts.iter().map(|part| part.topology.bytes()).sum();
        (self.made.len() * leaf) as u64 + tables
    }

    /// Makes the grid. A leaf of several parts begins as that of the first of them; `merge` adds each further one, whose
    /// values count with the factor given, 1 or −1.
    pub fn make(self, merge: impl Fn(&mut LeafValues, &mut LeafMask, &LeafValues, LeafMask, f32) + Sync) -> Grid {
        let first_made = (1 + self.shared.len()) * PAGE_LEAVES;
        let topologies: Vec<&Topology> = self.parts.iter().map(|part| &*part.topology).collect();
        let slots = first_made + self.made.len();
        let topology = Topology::combined(&topologies, self.rule, &self.leaves, slots);
        let mut out = Grid::empty(self.parts.first().map_or(1.0, |part| part.background));
        for &(part, page) in &self.shared {
            out.values.share_page(&self.parts[part].values, page);
            out.masks.share_page(&self.parts[part].masks, page);
        }
        out.values.grow(topology.page_count(), LeafValues::filled(out.background));
        out.masks.grow(topology.page_count(), LeafMask::EMPTY);
        out.topology = topology.into();

        let new: LeafSet = (first_made..slots).map(LeafId::new).collect();
        out.update(&new, |id, values, mask| {
            let mut sources = self.made[id.index() - first_made].iter().map(|&(part, id)| (part as usize, id));
            if let Some((part, id)) = sources.next() {
                let factor = self.rule.factor(part);
                *mask = self.parts[part].mask(id);
                values.0.iter_mut().zip(&self.parts[part].values(id).0).for_each(|(v, s)| *v = factor * s);
            }
            for (part, id) in sources {
                merge(values, mask, self.parts[part].values(id), self.parts[part].mask(id), self.rule.factor(part));
            }
        });
        let several = self.made.iter().zip(first_made..).filter(|(sources, _)| sources.len() > 1);
        let merged: LeafSet = several.map(|(_, slot)| LeafId::new(slot)).collect();
        out.prune(&merged);
        out
    }
}

/// Leaves of the largest part that one task walks over.
const TASK_LEAVES: usize = 2048;

/// Where the result has leaves, in the order of origins: lists to be read one after the other.
fn places(parts: &[&Grid], rule: SignRule) -> Vec<Vec<Place>> {
    let largest = parts.iter().max_by_key(|part| part.leaves().len());
    let mut cuts: Vec<i32> = largest
        .map(|part| part.leaves().iter().skip(TASK_LEAVES).step_by(TASK_LEAVES).map(|id| part.origin(*id).x).collect())
        .unwrap_or_default();
    cuts.dedup();
    let slabs: Vec<(i32, i32)> =
        std::iter::once(i32::MIN).chain(cuts.iter().copied()).zip(cuts.iter().copied().chain([i32::MAX])).collect();
    slabs.into_par_iter().map(|(from, to)| places_between(parts, rule, from, to)).collect()
}

fn places_between(parts: &[&Grid], rule: SignRule, from: i32, to: i32) -> Vec<Place> {
    let mut cursors: Vec<Cursor> = parts.iter().map(|part| Cursor::new(&part.topology, from, to)).collect();
    let mut places = Vec::new();
    while let Some(origin) = cursors.iter().filter_map(Cursor::origin).min_by_key(|o| key(*o)) {
        let mut sources = Sources::new();
        let mut won = false;
        for (part, cursor) in cursors.iter_mut().enumerate() {
            match cursor.take(origin) {
                Some(id) => sources.push((part as u32, id)),
                None => won = won || cursor.sentinel(origin) == rule.winner(part),
            }
        }
        if !won {
            places.push(Place { origin, sources });
        }
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNION: SignRule = SignRule { inside_wins: true, complement_others: false };

    /// A run of leaves along x, all active, holding `value`.
    fn run(from: i32, to: i32, value: f32) -> Grid {
        let origins: Vec<_> = (from..to).map(|x| IVec3::new(8 * x, 0, 0)).collect();
        let mut grid = Grid::from_origins(3.0, &origins);
        grid.update_all(|_, values, mask| {
            values.0.fill(value);
            *mask = LeafMask::FULL;
        });
        grid
    }

    fn smaller(a: &mut LeafValues, _: &mut LeafMask, b: &LeafValues, _: LeafMask, factor: f32) {
        a.0.iter_mut().zip(&b.0).for_each(|(a, b)| *a = a.min(factor * b));
    }

    #[test]
    fn whole_pages_are_shared_and_sparse_ones_copied() {
        let (a, b) = (run(0, 200, 0.5), run(190, 400, -0.5));
        let out = Combination::new(&[&a, &b], UNION).make(smaller);
        assert_eq!(out.leaves().len(), 400);
        assert!(out.leaves().is_sorted_by_key(|id| key(out.origin(*id))));
        for (x, value, part) in [(0, 0.5, Some(&a)), (195, -0.5, None), (300, -0.5, Some(&b))] {
            let origin = IVec3::new(8 * x, 0, 0);
            assert_eq!(out.voxel(origin), (value, true));
            let shared = |part: &Grid| std::ptr::eq(part.values(part.find(origin)), out.values(out.find(origin)));
            assert_eq!(part.is_some_and(shared), part.is_some(), "{x}");
        }
        // 10 leaves in both; 2 of the last page of `a`, 18 of that of `b` are copied: the other 370 lie in shared pages.
        let pages = out.value_pages().page_count();
        assert_eq!(pages, 1 + 3 + 3 + 1);
        // Neighbours across parts, and room in shared pages for new leaves.
        let at = |x: i32| out.find(IVec3::new(8 * x, 0, 0));
        assert_eq!(out.neighbours()[at(199).index()][22], at(200));
        let mut grown = out.clone();
        grown.add_leaves(&[IVec3::new(0, 8, 0)]);
        assert_eq!(grown.value_pages().page_count(), pages);
        assert_eq!(out.voxel(IVec3::new(8, 0, 0)), (0.5, true));
    }

    #[test]
    fn signs_that_win_leave_no_leaf() {
        let (a, mut b, mut c) = (run(0, 10, 0.5), Grid::empty(3.0), run(20, 21, 0.25));
        b.set_sign(IVec3::new(0, 0, 0), IVec3::new(40, 8, 8), true);
        c.set_sign(IVec3::new(0, 0, 0), IVec3::new(16, 8, 8), true);
        let out = Combination::new(&[&a, &b, &c], UNION).make(smaller);
        assert_eq!(out.leaves().len(), 6);
        assert_eq!(out.voxel(IVec3::new(20, 0, 0)), (-3.0, false));
        assert_eq!(out.voxel(IVec3::new(48, 0, 0)), (0.5, true));
        let common = Combination::new(&[&a, &b], SignRule { inside_wins: false, ..UNION }).make(smaller);
        assert_eq!(common.leaves().len(), 5);
        let cut = Combination::new(&[&b, &a], SignRule { inside_wins: false, complement_others: true }).make(smaller);
        assert_eq!((cut.leaves().len(), cut.voxel(IVec3::ZERO)), (5, (-0.5, true)));
        assert_eq!(cut.voxel(IVec3::new(48, 0, 0)), (3.0, false));
    }
}
