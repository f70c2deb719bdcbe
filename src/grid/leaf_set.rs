//! A set of leaves of one grid: a bit a slot, a word a page.

use rayon::prelude::*;

use super::paged::{LeafId, PageLeaves};

/// A set of leaf slots. The word of a page tells a parallel task which of its 64 leaves are meant.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LeafSet {
    words: Vec<u64>,
}

impl LeafSet {
    /// Adds a leaf; whether it is new.
    pub fn insert(&mut self, id: LeafId) -> bool {
        if self.words.len() <= id.page() {
            self.words.resize(id.page() + 1, 0);
        }
        let bit = 1u64 << id.slot();
        let new = self.words[id.page()] & bit == 0;
        self.words[id.page()] |= bit;
        new
    }

    /// Removes a leaf; whether it was there.
    pub fn remove(&mut self, id: LeafId) -> bool {
        let bit = 1u64 << id.slot();
        match self.words.get_mut(id.page()) {
            Some(word) if *word & bit != 0 => {
                *word &= !bit;
                true
            }
            _ => false,
        }
    }

    /// Whether a leaf is in the set.
    #[inline(always)]
    pub fn contains(&self, id: LeafId) -> bool {
        self.word(id.page()) >> id.slot() & 1 == 1
    }

    /// The leaves of a page, a bit a slot.
    #[inline(always)]
    pub fn word(&self, page: usize) -> u64 {
        self.words.get(page).copied().unwrap_or(0)
    }

    /// Whether no leaf is in the set.
    pub fn is_empty(&self) -> bool {
        self.words.iter().all(|w| *w == 0)
    }

    /// Number of leaves.
    pub fn len(&self) -> usize {
        self.words.iter().map(|w| w.count_ones() as usize).sum()
    }

    /// The leaves in slot order (not the order of origins).
    pub fn iter(&self) -> impl Iterator<Item = LeafId> + '_ {
        self.words.iter().enumerate().flat_map(|(page, &word)| PageLeaves::new(page, word).iter())
    }

    /// The leaves by page, for parallel tasks; pages without any are left out.
    pub fn par_pages(&self) -> impl IndexedParallelIterator<Item = PageLeaves> + use<> {
        let pages = self.words.iter().enumerate().filter(|(_, word)| **word != 0);
        pages.map(|(page, &word)| PageLeaves::new(page, word)).collect::<Vec<_>>().into_par_iter()
    }
}

impl FromIterator<LeafId> for LeafSet {
    fn from_iter<I: IntoIterator<Item = LeafId>>(ids: I) -> Self {
        let mut set = Self::default();
        for id in ids {
            set.insert(id);
        }
        set
    }
}
