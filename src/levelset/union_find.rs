//! Disjoint sets that many threads join at once.

use std::sync::atomic::{AtomicU32, Ordering};

use rayon::prelude::*;

/// Sets of the numbers 0..n. A larger root is always linked below a smaller one, so links never form a cycle, and the
/// sets do not depend on the order in which threads join them.
pub(crate) struct UnionFind {
    parents: Vec<AtomicU32>,
}

impl UnionFind {
    /// Each number alone. `n` is at most 2³².
    pub fn new(n: usize) -> Self {
        Self { parents: (0..n).into_par_iter().map(|i| AtomicU32::new(i as u32)).collect() }
    }

    fn parent(&self, i: u32) -> &AtomicU32 {
        &self.parents[i as usize]
    }

    /// The smallest number known to be in the set of `i`.
    pub fn root(&self, mut i: u32) -> u32 {
        loop {
            let parent = self.parent(i).load(Ordering::Relaxed);
            if parent == i {
                return i;
            }
            let grandparent = self.parent(parent).load(Ordering::Relaxed);
            // Halves the path. Another thread may have shortened it further: both are ancestors, either is right.
            self.parent(i).store(grandparent, Ordering::Relaxed);
            i = grandparent;
        }
    }

    /// Joins the sets of `a` and `b`.
    pub fn join(&self, a: u32, b: u32) {
        loop {
            let (a, b) = (self.root(a), self.root(b));
            if a == b {
                return;
            }
            let (small, large) = (a.min(b), a.max(b));
            // Fails when another thread has linked `large` meanwhile: then it is no root any more.
            let linked =
                self.parent(large).compare_exchange(large, small, Ordering::Relaxed, Ordering::Relaxed).is_ok();
            if linked {
                return;
            }
        }
    }

    /// Number of sets.
    pub fn count(&self) -> u64 {
        self.parents.par_iter().enumerate().filter(|(i, p)| p.load(Ordering::Relaxed) as usize == *i).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joins_from_many_threads() {
        // i and i + 7 together leave seven sets, however the joins interleave.
        let sets = UnionFind::new(70_000);
        (0..70_000u32 - 7).into_par_iter().for_each(|i| sets.join(i + 7, i));
        assert_eq!(sets.count(), 7);
        sets.join(0, 1);
        sets.join(1, 0);
        assert_eq!(sets.count(), 6);
        assert_eq!(UnionFind::new(0).count(), 0);
    }
}
