//! Per-leaf data in pages of 64, shared until written.

use std::sync::Arc;

use rayon::prelude::*;

use super::leaf_set::LeafSet;
use super::page_pool::Pooled;

/// Leaves in a page: 128 KiB of values, the size of one parallel task.
pub const PAGE_LEAVES: usize = 64;

/// The slot of a leaf in a grid's pages.
///
/// The first page of every grid holds two sentinels that stand for all absent leaves, so that a neighbour always has
/// values and no kernel needs a branch: [`OUTSIDE`](Self::OUTSIDE) is all +background, [`INSIDE`](Self::INSIDE) all −background.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LeafId(u32);

impl LeafId {
    /// Stands for an absent leaf outside the surface.
    pub const OUTSIDE: Self = Self(0);
    /// Stands for an absent leaf inside the surface.
    pub const INSIDE: Self = Self(1);

    /// The id of slot `index`.
    pub(crate) fn new(index: usize) -> Self {
        Self(index as u32)
    }

    /// The sentinel of a sign.
    pub fn sentinel(inside: bool) -> Self {
        if inside { Self::INSIDE } else { Self::OUTSIDE }
    }

    /// Whether this is one of the sentinels: no leaf is stored there.
    pub fn is_sentinel(self) -> bool {
        self.0 < 2
    }

    /// The slot as an index.
    pub fn index(self) -> usize {
        self.0 as usize
    }

    pub(crate) fn page(self) -> usize {
        self.0 as usize / PAGE_LEAVES
    }

    pub(crate) fn slot(self) -> usize {
        self.0 as usize % PAGE_LEAVES
    }
}

/// One `T` a leaf slot, in pages of [`PAGE_LEAVES`] behind `Arc`: a clone copies page pointers, a write copies only the
/// page that it touches while that page is shared.
///
/// Pages of values that nobody holds any more are kept for the next array (`page_pool`).
#[derive(Clone, Debug, Default)]
pub struct Paged<T: Pooled> {
    pages: Vec<Arc<[T]>>,
}

impl<T: Pooled> Paged<T> {
    /// `pages` pages that share one page of `value`.
    pub fn filled(pages: usize, value: T) -> Self {
        Self { pages: vec![Self::page_of(value); pages] }
    }

    fn page_of(value: T) -> Arc<[T]> {
        std::iter::repeat_n(value, PAGE_LEAVES).collect()
    }

    /// The page for writing, copied first if it is shared.
    fn own(page: &mut Arc<[T]>) -> &mut [T] {
        if Arc::get_mut(page).is_none()
            && let Some(mut own) = T::used_page()
        {
            if let Some(entries) = Arc::get_mut(&mut own) {
                entries.clone_from_slice(page);
            }
            *page = own;
        }
        Arc::make_mut(page)
    }

    /// The page for writing, and whether it is new: then its entries of `word` hold anything. A shared page is not copied
    /// but for the entries beside `word`.
    fn own_unwritten(page: &mut Arc<[T]>, word: u64) -> (&mut [T], bool) {
        let new = Arc::get_mut(page).is_none();
        if new && let Some(mut own) = T::used_page() {
            if let Some(entries) = Arc::get_mut(&mut own) {
                for slot in (0..PAGE_LEAVES).filter(|slot| word >> slot & 1 == 0) {
                    entries[slot].clone_from(&page[slot]);
                }
            }
            *page = own;
        }
        (Arc::make_mut(page), new)
    }

    /// Number of pages.
    pub fn page_count(&self) -> usize {
        self.pages.len()
    }

    /// Appends pages of `value` until there are `pages`.
    pub fn grow(&mut self, pages: usize, value: T) {
        if self.pages.len() < pages {
            self.pages.resize(pages, Self::page_of(value));
        }
    }

    /// Appends pages that hold anything until there are `pages`: for slots that are written before they are read.
    pub fn grow_unwritten(&mut self, pages: usize)
    where
        T: Default,
    {
        while self.pages.len() < pages {
            self.pages.push(T::used_page().unwrap_or_else(|| Self::page_of(T::default())));
        }
    }

    /// Drops the pages from `pages` on.
    pub fn truncate(&mut self, pages: usize) {
        self.pages.truncate(pages);
    }

    /// The entry of a leaf.
    #[inline(always)]
    pub fn get(&self, id: LeafId) -> &T {
        &self.pages[id.page()][id.slot()]
    }

    /// The entry of a leaf for writing; its page is copied first if it is shared.
    pub fn get_mut(&mut self, id: LeafId) -> &mut T {
        &mut Self::own(&mut self.pages[id.page()])[id.slot()]
    }

    /// Appends a page of `other`, shared with it.
    pub(super) fn share_page(&mut self, other: &Self, page: usize) {
        self.pages.push(other.pages[page].clone());
    }

    /// Whether two arrays share the storage of a leaf's page.
    pub fn shares_page(&self, other: &Self, id: LeafId) -> bool {
        Arc::ptr_eq(&self.pages[id.page()], &other.pages[id.page()])
    }

    /// Calls `f` with every page that holds a leaf of `set`, in parallel, one task a page. Other pages stay shared.
    pub fn par_update_pages<R, F>(&mut self, set: &LeafSet, f: F) -> Vec<R>
    where
        R: Send,
        F: Fn(PageLeaves, &mut [T]) -> R + Sync,
    {
        pages_of(&mut self.pages, set).into_par_iter().map(|(leaves, data)| f(leaves, Self::own(data))).collect()
    }

    /// As [`par_update_pages`](Self::par_update_pages) over two arrays of one grid at once.
    pub fn par_update_pages_with<U, R, F>(&mut self, other: &mut Paged<U>, set: &LeafSet, f: F) -> Vec<R>
    where
        U: Pooled,
        R: Send,
        F: Fn(PageLeaves, &mut [T], &mut [U]) -> R + Sync,
    {
        let pages = pages_of(self.pages.iter_mut().zip(&mut other.pages), set).into_par_iter();
        pages.map(|(leaves, (a, b))| f(leaves, Self::own(a), Paged::own(b))).collect()
    }

    /// Calls `f` with every leaf of `set`, in parallel over pages.
    pub fn par_update(&mut self, set: &LeafSet, f: impl Fn(LeafId, &mut T) + Sync) {
        self.par_update_pages(set, |leaves, data| leaves.for_each(|id| f(id, &mut data[id.slot()])));
    }

    /// Copies those pages of the leaves of `set` that are shared.
    pub fn own_pages(&mut self, set: &LeafSet) {
        self.par_update_pages(set, |_, _| ());
    }

    /// As [`par_update_pages`](Self::par_update_pages) for an `f` that writes its leaves wholly if it is told `true`: a page that is
    /// shared is not copied then but replaced by one whose entries of `set` hold anything.
    pub fn par_rewrite_pages<F>(&mut self, set: &LeafSet, f: F)
    where
        F: Fn(PageLeaves, bool, &mut [T]) + Sync,
    {
        pages_of(&mut self.pages, set).into_par_iter().for_each(|(leaves, data)| {
            let (own, new) = Self::own_unwritten(data, leaves.word);
            f(leaves, new, own);
        });
    }

    /// As [`par_rewrite_pages`](Self::par_rewrite_pages) with a second array of the grid beside it, whose pages keep their entries.
    pub fn par_rewrite_pages_with<U, R, F>(&mut self, other: &mut Paged<U>, set: &LeafSet, f: F) -> Vec<R>
    where
        U: Pooled,
        R: Send,
        F: Fn(PageLeaves, bool, &mut [T], &mut [U]) -> R + Sync,
    {
        let pages = pages_of(self.pages.iter_mut().zip(&mut other.pages), set).into_par_iter();
        pages
            .map(|(leaves, (a, b))| {
                let (own, new) = Self::own_unwritten(a, leaves.word);
                f(leaves, new, own, Paged::own(b))
            })
            .collect()
    }

    /// Bytes of the pages, shared ones included.
    pub fn bytes(&self) -> u64 {
        (self.pages.len() * PAGE_LEAVES * size_of::<T>()) as u64
    }
}

impl<T: Pooled> Drop for Paged<T> {
    fn drop(&mut self) {
        self.pages.drain(..).for_each(T::keep_page);
    }
}

/// Of `pages`, those that hold a leaf of `set`. Found before the work is divided: the pages of a region lie close together, and halves of all
/// pages would leave a thread without any.
fn pages_of<P>(pages: impl IntoIterator<Item = P>, set: &LeafSet) -> Vec<(PageLeaves, P)> {
    let leaves = |(page, data)| (PageLeaves { page, word: set.word(page) }, data);
    pages.into_iter().enumerate().map(leaves).filter(|(leaves, _)| leaves.word != 0).collect()
}

/// The leaves of a set that lie in one page.
#[derive(Clone, Copy)]
pub struct PageLeaves {
    page: usize,
    word: u64,
}

impl PageLeaves {
    pub(super) fn new(page: usize, word: u64) -> Self {
        Self { page, word }
    }

    /// The leaves, in slot order.
    pub fn iter(self) -> impl Iterator<Item = LeafId> {
        let mut rest = self.word;
        std::iter::from_fn(move || {
            (rest != 0).then(|| {
                let slot = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                LeafId::new(self.page * PAGE_LEAVES + slot)
            })
        })
    }

    /// The leaf after `id`, in slot order.
    #[inline(always)]
    pub fn after(self, id: LeafId) -> Option<LeafId> {
        let rest = self.word & (!1 << id.slot());
        (rest != 0).then(|| LeafId::new(self.page * PAGE_LEAVES + rest.trailing_zeros() as usize))
    }

    /// Calls `f` with each leaf, in slot order.
    #[inline(always)]
    pub fn for_each(self, mut f: impl FnMut(LeafId)) {
        let mut rest = self.word;
        while rest != 0 {
            let slot = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            f(LeafId::new(self.page * PAGE_LEAVES + slot));
        }
    }

    /// The entry of a leaf of this page in the page's slice.
    #[inline(always)]
    pub fn slot(id: LeafId) -> usize {
        id.slot()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Pooled for u32 {}

    #[test]
    fn a_write_copies_only_its_page() {
        let mut a: Paged<u32> = Paged::filled(3, 7);
        let mut set = LeafSet::default();
        for slot in [70, 130] {
            set.insert(LeafId::new(slot));
        }
        a.par_update(&set, |id, v| *v = id.index() as u32);
        let b = a.clone();
        *a.get_mut(LeafId::new(70)) += 1;
        assert_eq!((*a.get(LeafId::new(70)), *b.get(LeafId::new(70))), (71, 70));
        assert!(!a.shares_page(&b, LeafId::new(70)));
        assert!(a.shares_page(&b, LeafId::new(130)));
        assert_eq!(*a.get(LeafId::new(130)), 130);
        assert_eq!(*a.get(LeafId::new(131)), 7);
    }
}
