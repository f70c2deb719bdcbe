//! Where leaves are: node tables over 16³ leaves, the order of origins, free slots, neighbours.
//!
//! A node covers 128³ voxels and is a dense table with an entry for each of its 16³ leaves: the slot of a leaf, or the
//! sentinel of the sign that the space there has. So the sign of every point is known, and the neighbours of a leaf are
//! read from tables; a hash finds nodes only. A node without a table is outside.

use std::sync::{Arc, OnceLock};

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::combine::SignRule;
use super::leaf::LEAF_DIM;
use super::leaf_set::LeafSet;
use super::paged::{LeafId, PAGE_LEAVES, PageLeaves};

/// Leaves along the edge of a node.
const NODE_LEAVES: i32 = 16;
/// Voxels along the edge of a node.
pub(crate) const NODE_DIM: i32 = NODE_LEAVES * LEAF_DIM;
/// Entries of a node table.
const NODE_ENTRIES: usize = (NODE_LEAVES * NODE_LEAVES * NODE_LEAVES) as usize;

/// The entries of a node, z fastest.
type NodeTable = [LeafId; NODE_ENTRIES];

/// A leaf and its 26 neighbours: entry `(dx+1)·9 + (dy+1)·3 + (dz+1)`; 13 is the leaf itself.
pub type Neighbours = [LeafId; 27];

/// The [`Neighbours`] of every leaf, by slot ([`LeafId::index`]). They are looked up a page at a time, when one of its leaves is asked
/// for, and kept up to date from then on: work on a few leaves does not pay for the others.
#[derive(Clone, Copy)]
pub struct NeighbourTable<'a>(&'a Topology);

impl std::ops::Index<usize> for NeighbourTable<'_> {
    type Output = Neighbours;

    #[inline(always)]
    fn index(&self, slot: usize) -> &Neighbours {
        let page = slot / PAGE_LEAVES;
        let neighbours = self.0.neighbours[page].get_or_init(|| self.0.neighbours_of_page(page));
        &neighbours[slot % PAGE_LEAVES]
    }
}

/// The neighbours of the leaves of one page.
type NeighbourPage = [Neighbours; PAGE_LEAVES];

#[derive(Clone, Default)]
pub(super) struct Topology {
    nodes: FxHashMap<IVec3, Arc<NodeTable>>,
    /// Origin of the leaf in each slot; of no meaning for sentinels and free slots.
    origins: Vec<IVec3>,
    /// The leaves, by origin: x, then y, then z.
    order: Vec<LeafId>,
    live: LeafSet,
    /// Slots of removed leaves, the next one to use last.
    free: Vec<LeafId>,
    /// By page, once they have been asked for.
    neighbours: Vec<OnceLock<Arc<NeighbourPage>>>,
}

/// Sort key of origins: x, then y, then z.
pub(super) fn key(origin: IVec3) -> (i32, i32, i32) {
    (origin.x, origin.y, origin.z)
}

/// Sort key of slots: node by node, along a Z-order curve in each.
fn block_key(origin: IVec3) -> ((i32, i32, i32), u32) {
    // Bits 0 to 3 to places 0, 3, 6, 9.
    let spread = |v: i32| {
        let v = (v & (NODE_LEAVES - 1)) as u32;
        v & 1 | (v & 2) << 2 | (v & 4) << 4 | (v & 8) << 6
    };
    let leaf: IVec3 = origin >> 3;
    (key(node_of(origin)), spread(leaf.x) << 2 | spread(leaf.y) << 1 | spread(leaf.z))
}

fn node_of(origin: IVec3) -> IVec3 {
    origin >> 7
}

fn entry_of(origin: IVec3) -> usize {
    entry_of_leaf(origin >> 3)
}

/// Entry of the leaf at `leaf`, counted in leaves.
fn entry_of_leaf(leaf: IVec3) -> usize {
    let local: IVec3 = leaf & (NODE_LEAVES - 1);
    ((local.x << 8) | (local.y << 4) | local.z) as usize
}

impl Topology {
    /// Leaves at `origins`, which must be sorted by (x, y, z), without duplicates and multiples of 8. All space between is outside.
    pub fn from_origins(origins: &[IVec3]) -> Self {
        debug_assert!(origins.is_sorted_by(|a, b| key(*a) < key(*b)));
        let mut slots: Vec<(u32, IVec3)> = (0..).zip(origins.iter().copied()).collect();
        slots.par_sort_unstable_by_key(|(_, origin)| block_key(*origin));
        let mut topology = Self { origins: vec![IVec3::ZERO; PAGE_LEAVES], ..Self::default() };
        topology.origins.extend(slots.iter().map(|(_, origin)| *origin));
        topology.order = vec![LeafId::OUTSIDE; origins.len()];
        for (slot, (place, _)) in (PAGE_LEAVES..).zip(slots) {
            topology.order[place as usize] = LeafId::new(slot);
        }
        topology.live = topology.order.iter().copied().collect();
        for (&origin, &id) in origins.iter().zip(&topology.order) {
            set_entry(&mut topology.nodes, origin, id);
        }
        topology.forget_neighbours();
        topology
    }

    /// `leaves` at their slots, sorted by origin, and between them the signs of `parts` as `rule` combines them; `slots` are
    /// taken in all.
    pub fn combined(parts: &[&Self], rule: SignRule, leaves: &[(IVec3, LeafId)], slots: usize) -> Self {
        let mut nodes: Vec<IVec3> = parts.iter().flat_map(|part| part.nodes.keys().copied()).collect();
        nodes.sort_unstable_by_key(|n| key(*n));
        nodes.dedup();
        let mut tables: Vec<Arc<NodeTable>> = nodes.par_iter().map(|node| combined_signs(parts, rule, *node)).collect();
        let places: FxHashMap<IVec3, usize> = nodes.iter().copied().zip(0..).collect();
        let mut topology = Self { origins: vec![IVec3::ZERO; slots], ..Self::default() };
        // Leaves come in runs of one node.
        let mut last = None;
        for &(origin, id) in leaves {
            let node = node_of(origin);
            let place = match last {
                Some((n, place)) if n == node => Some(place),
                _ => places.get(&node).copied(),
            };
            last = place.map(|place| (node, place));
            if let Some(table) = place.and_then(|place| tables.get_mut(place)) {
                Arc::make_mut(table)[entry_of(origin)] = id;
            }
            topology.origins[id.index()] = origin;
        }
        topology.order = leaves.iter().map(|(_, id)| *id).collect();
        topology.live = topology.order.iter().copied().collect();
        topology.free = (PAGE_LEAVES..slots).rev().map(LeafId::new).filter(|id| !topology.live.contains(*id)).collect();
        let known = nodes.into_iter().zip(tables).filter(|(_, table)| table.iter().any(|e| *e != LeafId::OUTSIDE));
        topology.nodes = known.collect();
        topology.forget_neighbours();
        topology
    }

    /// The leaves in the order of their origins.
    pub fn order(&self) -> &[LeafId] {
        &self.order
    }

    /// The place of each leaf in the order of origins, by slot.
    pub fn places(&self) -> Vec<u32> {
        let mut places = vec![u32::MAX; self.origins.len()];
        for (place, id) in (0..).zip(&self.order) {
            places[id.index()] = place;
        }
        places
    }

    pub fn live(&self) -> &LeafSet {
        &self.live
    }

    pub fn origin(&self, id: LeafId) -> IVec3 {
        self.origins[id.index()]
    }

    /// Slots of sentinels, leaves and free ones.
    pub fn slot_count(&self) -> usize {
        self.origins.len()
    }

    /// Pages that the slots need.
    pub fn page_count(&self) -> usize {
        self.slot_count().div_ceil(PAGE_LEAVES)
    }

    /// The leaf at `origin`, or the sentinel of the sign there.
    pub fn find(&self, origin: IVec3) -> LeafId {
        self.nodes.get(&node_of(origin)).map_or(LeafId::OUTSIDE, |table| table[entry_of(origin)])
    }

    /// Bytes of tables and lists.
    pub fn bytes(&self) -> u64 {
        let per_leaf = size_of::<IVec3>() + size_of::<LeafId>() + 27 * size_of::<LeafId>();
        (self.nodes.len() * size_of::<NodeTable>() + self.origins.len() * per_leaf) as u64
    }

    /// Copies the tables that are shared with other topologies.
    pub fn unshare(&mut self) {
        self.nodes.values_mut().for_each(|table| _ = Arc::make_mut(table));
        self.neighbours.iter_mut().filter_map(OnceLock::get_mut).for_each(|page| _ = Arc::make_mut(page));
    }

    /// Adds leaves at `origins` (sorted, no leaf there yet); returns them with the sentinel that they replace.
    pub fn insert(&mut self, origins: &[IVec3]) -> Vec<(LeafId, LeafId)> {
        let mut added = Vec::with_capacity(origins.len());
        for &origin in origins {
            let id = self.free.pop().unwrap_or_else(|| {
                self.origins.push(IVec3::ZERO);
                LeafId::new(self.origins.len() - 1)
            });
            self.origins[id.index()] = origin;
            self.live.insert(id);
            added.push((id, set_entry(&mut self.nodes, origin, id)));
        }
        self.merge_order(&added);
        self.relink(&added, |id, _| id);
        added
    }

    /// Removes leaves (in the order of origins), leaving the sentinel of each one's sign in its place.
    pub fn remove(&mut self, removed: &[(LeafId, LeafId)]) {
        if removed.is_empty() {
            return;
        }
        for &(id, sentinel) in removed {
            set_entry(&mut self.nodes, self.origins[id.index()], sentinel);
            self.live.remove(id);
            self.free.push(id);
        }
        self.order.retain(|id| self.live.contains(*id));
        self.relink(removed, |_, sentinel| sentinel);
    }

    /// Leaves have come or gone: tells all around each of them whose neighbours are known, and itself, that `entry(leaf, sentinel)` now
    /// lies at its place.
    fn relink(&mut self, changed: &[(LeafId, LeafId)], entry: impl Fn(LeafId, LeafId) -> LeafId) {
        let mut table = std::mem::take(&mut self.neighbours);
        table.resize_with(self.page_count(), OnceLock::new);
        let mut pages: Vec<KnownPage> = table.iter_mut().map(|page| KnownPage::Shared(page.get_mut())).collect();
        let around = |changed: &[(LeafId, LeafId)]| -> Vec<Neighbours> {
            let mut cache = NodeCache::default();
            changed.iter().map(|(id, _)| self.neighbours_of(*id, &mut cache)).collect()
        };
        let around: Vec<_> = changed.par_chunks(RELINK_LEAVES).map(around).collect();
        for (&(id, sentinel), around) in changed.iter().zip(around.iter().flatten()) {
            let entry = entry(id, sentinel);
            if let Some(page) = pages[id.page()].own() {
                page[id.slot()] = *around;
            }
            for (q, &n) in around.iter().enumerate() {
                if q != 13
                    && !n.is_sentinel()
                    && let Some(page) = pages[n.page()].own()
                {
                    page[n.slot()][26 - q] = entry;
                }
            }
        }
        self.neighbours = table;
    }

    fn merge_order(&mut self, added: &[(LeafId, LeafId)]) {
        let old = std::mem::take(&mut self.order);
        let mut order = Vec::with_capacity(old.len() + added.len());
        let mut news = added.iter().map(|a| a.0).peekable();
        for id in old {
            while let Some(new) = news.next_if(|n| key(self.origins[n.index()]) < key(self.origins[id.index()])) {
                order.push(new);
            }
            order.push(id);
        }
        order.extend(news);
        self.order = order;
    }

    /// The neighbours of every leaf.
    pub fn neighbours(&self) -> NeighbourTable<'_> {
        NeighbourTable(self)
    }

    /// For when signs have changed: neighbours are looked up anew.
    fn forget_neighbours(&mut self) {
        self.neighbours.clear();
        self.neighbours.resize_with(self.page_count(), OnceLock::new);
    }

    fn neighbours_of_page(&self, page: usize) -> Arc<NeighbourPage> {
        let mut cache = NodeCache::default();
        let mut neighbours = Arc::new([[LeafId::OUTSIDE; 27]; PAGE_LEAVES]);
        if let Some(neighbours) = Arc::get_mut(&mut neighbours) {
            PageLeaves::new(page, self.live.word(page))
                .for_each(|id| neighbours[id.slot()] = self.neighbours_of(id, &mut cache));
        }
        neighbours
    }

    fn neighbours_of<'a>(&'a self, id: LeafId, cache: &mut NodeCache<'a>) -> Neighbours {
        let origin = self.origin(id);
        cache.enter(node_of(origin));
        let local: IVec3 = (origin >> 3) & (NODE_LEAVES - 1);
        let mut around = [LeafId::OUTSIDE; 27];
        let one_table = 0 < local.z && local.z < NODE_LEAVES - 1;
        // Nine runs of three along z. A leaf's place shifted by 4 is −1, 0 or 1 for the node below, this one, the node above.
        for (run, entries) in around.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let leaf = local + IVec3::new(run as i32 / 3 - 1, run as i32 % 3 - 1, 0);
            if one_table {
                if let Some(table) = cache.table(self, leaf >> 4) {
                    entries.copy_from_slice(&table[entry_of_leaf(leaf) - 1..][..3]);
                }
            } else {
                for (z, entry) in (leaf.z - 1..).zip(entries) {
                    let leaf = leaf.with_z(z);
                    *entry = cache.table(self, leaf >> 4).map_or(LeafId::OUTSIDE, |table| table[entry_of_leaf(leaf)]);
                }
            }
        }
        around
    }

    /// Gives all absent leaves in the box of leaf origins `lo..hi` (exclusive) the sign `inside`.
    pub fn set_sign(&mut self, lo: IVec3, hi: IVec3, inside: bool) {
        let sentinel = LeafId::sentinel(inside);
        let (node_lo, node_hi) = (node_of(lo), node_of(hi - 1));
        for nx in node_lo.x..=node_hi.x {
            for ny in node_lo.y..=node_hi.y {
                for nz in node_lo.z..=node_hi.z {
                    let node = IVec3::new(nx, ny, nz);
                    let from = lo.max(node * NODE_DIM);
                    let to = hi.min((node + 1) * NODE_DIM);
                    let whole = to - from == IVec3::splat(NODE_DIM);
                    match self.nodes.get_mut(&node) {
                        None if whole => {
                            self.nodes.insert(node, Arc::new([sentinel; NODE_ENTRIES]));
                        }
                        table => {
                            let table = match table {
                                Some(table) => table,
                                None => self.nodes.entry(node).or_insert_with(outside_table),
                            };
                            let table = Arc::make_mut(table);
                            for_each_origin(from, to, |origin| {
                                let entry = &mut table[entry_of(origin)];
                                if entry.is_sentinel() {
                                    *entry = sentinel;
                                }
                            });
                        }
                    }
                }
            }
        }
        self.forget_neighbours();
    }

    /// Gives every absent leaf the sign of the surface around it: along each row of leaves in z the sign is outside until
    /// a leaf is met, and then `leaves_inside(leaf)`, the sign at that leaf's last z, until the next. The surface must be closed.
    pub fn flood_signs(&mut self, leaves_inside: impl Fn(LeafId) -> bool + Sync) {
        let mut columns: FxHashMap<(i32, i32), Vec<i32>> = FxHashMap::default();
        for node in self.nodes.keys() {
            columns.entry((node.x, node.y)).or_default().push(node.z);
        }
        let columns: Vec<_> = columns.into_iter().collect();
        let nodes = &self.nodes;
        let flooded: Vec<(IVec3, Arc<NodeTable>)> = columns
            .into_par_iter()
            .flat_map_iter(|((x, y), mut zs)| {
                zs.sort_unstable();
                let mut out = Vec::with_capacity(zs.len());
                // The sign of each of the 16² rows of leaves as the scan rises.
                let mut inside = [false; 256];
                let mut last_z = None;
                for z in zs {
                    if inside.iter().all(|i| *i) {
                        // Nodes without any leaf between two that have some: solid all through.
                        out.extend(
                            (last_z.map_or(z, |l: i32| l + 1)..z)
                                .map(|z| (IVec3::new(x, y, z), Arc::new([LeafId::INSIDE; NODE_ENTRIES]))),
                        );
                    }
                    last_z = Some(z);
                    let node = IVec3::new(x, y, z);
                    let mut table = *nodes[&node];
                    for (row, inside) in inside.iter_mut().enumerate() {
                        for entry in &mut table[row * 16..(row + 1) * 16] {
                            if entry.is_sentinel() {
                                *entry = LeafId::sentinel(*inside);
                            } else {
                                *inside = leaves_inside(*entry);
                            }
                        }
                    }
                    out.push((node, Arc::new(table)));
                }
                out
            })
            .collect();
        self.nodes.extend(flooded);
        self.forget_neighbours();
    }

    /// Where both this and `other` have no leaf, the sign becomes `sign(inside here, inside there)`. Entries that are leaves stay.
    pub fn combine_signs(&mut self, other: &Self, sign: impl Fn(bool, bool) -> bool) {
        let combine = |mine: LeafId, theirs: LeafId| {
            if mine.is_sentinel() && theirs.is_sentinel() {
                LeafId::sentinel(sign(mine == LeafId::INSIDE, theirs == LeafId::INSIDE))
            } else {
                mine
            }
        };
        let missing: Vec<IVec3> = other.nodes.keys().copied().filter(|n| !self.nodes.contains_key(n)).collect();
        for node in missing {
            self.nodes.insert(node, outside_table());
        }
        for (node, table) in &mut self.nodes {
            let theirs = other.nodes.get(node);
            let there = |i: usize| theirs.map_or(LeafId::OUTSIDE, |t| t[i]);
            // A table is copied only if an entry of it changes.
            if (0..NODE_ENTRIES).any(|i| combine(table[i], there(i)) != table[i]) {
                let table = Arc::make_mut(table);
                for (i, entry) in table.iter_mut().enumerate() {
                    *entry = combine(*entry, there(i));
                }
            }
        }
        self.forget_neighbours();
    }

    /// Boxes of absent leaves that are inside, each as its first origin and its edge in voxels (8, or 128 for a whole node), by origin.
    pub fn inside_tiles(&self) -> Vec<(IVec3, i32)> {
        let mut tiles = Vec::new();
        for (&node, table) in &self.nodes {
            if table.iter().all(|e| *e == LeafId::INSIDE) {
                tiles.push((node * NODE_DIM, NODE_DIM));
                continue;
            }
            let base = node * NODE_DIM;
            for_each_origin(base, base + NODE_DIM, |origin| {
                if table[entry_of(origin)] == LeafId::INSIDE {
                    tiles.push((origin, LEAF_DIM));
                }
            });
        }
        tiles.sort_unstable_by_key(|(origin, _)| key(*origin));
        tiles
    }
}

fn outside_table() -> Arc<NodeTable> {
    Arc::new([LeafId::OUTSIDE; NODE_ENTRIES])
}

/// The signs of a node where no part has a leaf; of no meaning elsewhere.
fn combined_signs(parts: &[&Topology], rule: SignRule, node: IVec3) -> Arc<NodeTable> {
    let mut won = [false; NODE_ENTRIES];
    for (part, topology) in parts.iter().enumerate() {
        let winner = rule.winner(part);
        match topology.nodes.get(&node) {
            Some(table) => won.iter_mut().zip(table.iter()).for_each(|(won, entry)| *won |= *entry == winner),
            None if winner == LeafId::OUTSIDE => won.fill(true),
            None => {}
        }
    }
    Arc::new(won.map(|won| LeafId::sentinel(won == rule.inside_wins)))
}

/// Puts `id` into the table at `origin`; returns what was there.
fn set_entry(nodes: &mut FxHashMap<IVec3, Arc<NodeTable>>, origin: IVec3, id: LeafId) -> LeafId {
    let table = nodes.entry(node_of(origin)).or_insert_with(outside_table);
    std::mem::replace(&mut Arc::make_mut(table)[entry_of(origin)], id)
}

/// Leaves whose neighbours one task looks up.
const RELINK_LEAVES: usize = 128;

/// Neighbours of a page's leaves, if they are known. Asking an `Arc` whether it is shared takes longer than an entry, so it is asked once.
enum KnownPage<'a> {
    Shared(Option<&'a mut Arc<NeighbourPage>>),
    Own(&'a mut NeighbourPage),
}

impl KnownPage<'_> {
    /// The page for writing, copied first if it is shared.
    #[inline(always)]
    fn own(&mut self) -> Option<&mut NeighbourPage> {
        if let Self::Shared(page) = self {
            *self = Self::Own(Arc::make_mut(page.take()?));
        }
        match self {
            Self::Own(page) => Some(page),
            Self::Shared(_) => None,
        }
    }
}

fn for_each_origin(lo: IVec3, hi: IVec3, mut f: impl FnMut(IVec3)) {
    for x in (lo.x..hi.x).step_by(LEAF_DIM as usize) {
        for y in (lo.y..hi.y).step_by(LEAF_DIM as usize) {
            for z in (lo.z..hi.z).step_by(LEAF_DIM as usize) {
                f(IVec3::new(x, y, z));
            }
        }
    }
}

/// Index in [`Neighbours`] of the neighbour at `step` (each component −1, 0 or 1).
pub fn neighbour_index(step: IVec3) -> usize {
    ((step.x + 1) * 9 + (step.y + 1) * 3 + step.z + 1) as usize
}

/// Walks the leaves of a topology in order, and knows the sign of other places on the way.
pub(super) struct Cursor<'a> {
    topology: &'a Topology,
    rest: std::slice::Iter<'a, LeafId>,
    head: Option<(IVec3, LeafId)>,
    /// The last node asked for.
    node: Option<(IVec3, Option<&'a NodeTable>)>,
}

impl<'a> Cursor<'a> {
    /// A walk over the leaves whose origins have `from` <= x < `to`.
    pub fn new(topology: &'a Topology, from: i32, to: i32) -> Self {
        let before = |x: i32| topology.order.partition_point(|id| topology.origin(*id).x < x);
        let rest = topology.order.get(before(from)..before(to)).unwrap_or_default().iter();
        let mut cursor = Self { topology, rest, head: None, node: None };
        cursor.advance();
        cursor
    }

    fn advance(&mut self) {
        self.head = self.rest.next().map(|&id| (self.topology.origin(id), id));
    }

    /// Where the next leaf is.
    pub fn origin(&self) -> Option<IVec3> {
        self.head.map(|(origin, _)| origin)
    }

    /// The next leaf if it is at `origin`, and steps past it.
    pub fn take(&mut self, origin: IVec3) -> Option<LeafId> {
        let (_, id) = self.head.filter(|(at, _)| *at == origin)?;
        self.advance();
        Some(id)
    }

    /// The sign at `origin`, where there is no leaf.
    pub fn sentinel(&mut self, origin: IVec3) -> LeafId {
        let node = node_of(origin);
        let table = match self.node {
            Some((last, table)) if last == node => table,
            _ => self.topology.nodes.get(&node).map(|table| &**table),
        };
        self.node = Some((node, table));
        table.map_or(LeafId::OUTSIDE, |table| table[entry_of(origin)])
    }
}

/// The tables around the last node entered, as far as they were asked for: leaves come in runs of one node, and most of them need no
/// other table than their own.
#[derive(Default)]
struct NodeCache<'a> {
    centre: IVec3,
    tables: [Option<&'a NodeTable>; 27],
    /// A bit for each of `tables` that was looked up.
    known: u32,
}

impl<'a> NodeCache<'a> {
    fn enter(&mut self, node: IVec3) {
        if self.centre != node {
            *self = Self { centre: node, ..Self::default() };
        }
    }

    /// The table of the node at `step` from the one entered; `None` if it has none.
    #[inline(always)]
    fn table(&mut self, topology: &'a Topology, step: IVec3) -> Option<&'a NodeTable> {
        let q = neighbour_index(step);
        if self.known >> q & 1 == 0 {
            self.known |= 1 << q;
            self.tables[q] = topology.nodes.get(&(self.centre + step)).map(|table| &**table);
        }
        self.tables[q]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn neighbour_step(index: usize) -> IVec3 {
        let q = index as i32;
        IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1)
    }

    fn sorted(mut origins: Vec<IVec3>) -> Vec<IVec3> {
        origins.sort_unstable_by_key(|o| key(*o));
        origins.dedup();
        origins
    }

    /// Leaves around node borders, on both sides of zero.
    fn scattered() -> Vec<IVec3> {
        sorted((0..400).map(|i| IVec3::new(i * 37 % 29 - 14, i * 53 % 31 - 16, i * 71 % 37 - 18) * 8).collect())
    }

    #[test]
    fn neighbours_equal_look_ups_after_any_history() {
        let origins = scattered();
        let mut topology = Topology::from_origins(&origins);
        let check = |t: &Topology| {
            for &id in t.order() {
                for (q, &n) in t.neighbours()[id.index()].iter().enumerate() {
                    assert_eq!(n, t.find(t.origin(id) + neighbour_step(q) * 8));
                }
            }
            assert!(t.order().is_sorted_by_key(|id| key(t.origin(*id))));
            assert_eq!(t.order().len(), t.live().len());
        };
        // One with only some of the neighbours looked up before the leaves change.
        let mut partly = topology.clone();
        partly.neighbours[2].get_or_init(|| topology.neighbours_of_page(2));
        check(&topology);
        let removed: Vec<_> = topology.order().iter().copied().step_by(3).map(|id| (id, LeafId::INSIDE)).collect();
        topology.remove(&removed);
        partly.remove(&removed);
        check(&topology);
        let absent: Vec<_> =
            (-20..20).map(|i| IVec3::new(i, 2 * i, -i) * 8).filter(|o| topology.find(*o).is_sentinel()).collect();
        let pages = topology.page_count();
        let added = topology.insert(&sorted(absent.clone()));
        assert_eq!(added.len(), absent.len());
        check(&topology);
        assert_eq!(topology.page_count(), pages, "freed slots are used again");
        partly.insert(&sorted(absent));
        assert!(partly.neighbours.iter().any(|page| page.get().is_none()));
        check(&partly);
    }

    #[test]
    fn flood_fills_a_hollow_shell_across_nodes() {
        // A box of leaves with walls one leaf thick, its inside crossing several nodes.
        let on_wall = |o: IVec3| o.min_element() == -20 || o.max_element() == 20;
        let mut origins = Vec::new();
        for x in -20..=20 {
            for y in -20..=20 {
                for z in -20..=20 {
                    let o = IVec3::new(x, y, z);
                    if on_wall(o) {
                        origins.push(o * 8);
                    }
                }
            }
        }
        let mut topology = Topology::from_origins(&origins);
        // Walls face inwards on the low side and outwards on the high side; rows inside the side walls end outside.
        let o = topology.origins.clone();
        topology.flood_signs(|id| {
            let o = o[id.index()] / 8;
            o.z == -20 && o.x.abs() < 20 && o.y.abs() < 20
        });
        assert_eq!(topology.find(IVec3::ZERO), LeafId::INSIDE);
        assert_eq!(topology.find(IVec3::splat(19 * 8)), LeafId::INSIDE);
        assert_eq!(topology.find(IVec3::new(0, 0, 21 * 8)), LeafId::OUTSIDE);
        assert_eq!(topology.find(IVec3::new(1000, 0, 0)), LeafId::OUTSIDE);
        let inside: i64 = topology.inside_tiles().iter().map(|(_, edge)| (*edge as i64 / 8).pow(3)).sum();
        assert_eq!(inside, 39 * 39 * 39);
    }
}
