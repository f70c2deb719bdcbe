//! Lists of triangles by tile.

use std::hash::Hash;

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Triangles looked at in one task.
const CHUNK: usize = 4096;

/// The triangles that touch each tile, tiles in the order of their keys, triangles in that of their numbers.
pub(crate) struct Bins<K> {
    keys: Vec<K>,
    /// Where the items of each tile start, and where the last end.
    starts: Vec<usize>,
    items: Vec<u32>,
}

impl<K: Copy + Ord + Hash + Send + Sync> Bins<K> {
    /// Asks `touched` for the tiles of each of `count` triangles, which it adds to a list, each once.
    pub fn new(count: usize, touched: impl Fn(usize, &mut Vec<K>) + Sync) -> Self {
        // By chunk: the keys met, and each triangle with the number of its key in that list.
        let chunks: Vec<(Vec<K>, Vec<(u32, u32)>)> = (0..count.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let mut numbers: FxHashMap<K, u32> = FxHashMap::default();
                let (mut keys, mut tiles) = (Vec::new(), Vec::new());
                let mut pairs = Vec::with_capacity(2 * CHUNK);
                for t in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                    tiles.clear();
                    touched(t, &mut tiles);
                    for &key in &tiles {
                        let number = *numbers.entry(key).or_insert_with(|| {
                            keys.push(key);
                            keys.len() as u32 - 1
                        });
                        pairs.push((number, t as u32));
                    }
                }
                (keys, pairs)
            })
            .collect();
        let mut keys: Vec<K> = chunks.iter().flat_map(|c| &c.0).copied().collect();
        keys.par_sort_unstable();
        keys.dedup();
        let global: Vec<Vec<u32>> = chunks
            .par_iter()
            .map(|(local, _)| local.iter().map(|key| keys.partition_point(|k| k < key) as u32).collect())
            .collect();
        let mut starts = vec![0; keys.len() + 1];
        for ((_, pairs), global) in chunks.iter().zip(&global) {
            pairs.iter().for_each(|&(number, _)| starts[global[number as usize] as usize + 1] += 1);
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut items = vec![0; starts[keys.len()]];
        for ((_, pairs), global) in chunks.iter().zip(&global) {
            for &(number, t) in pairs {
                let at = &mut next[global[number as usize] as usize];
                items[*at] = t;
                *at += 1;
            }
        }
        Self { keys, starts, items }
    }

    /// Number of tiles.
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    pub fn key(&self, bin: usize) -> &K {
        &self.keys[bin]
    }

    /// The triangles of a tile.
    pub fn items(&self, bin: usize) -> &[u32] {
        &self.items[self.starts[bin]..self.starts[bin + 1]]
    }
}

/// Rounded up, for coordinates within the range of i32. Unlike `f64::ceil`, no function call where the target has no
/// instruction for it.
#[inline(always)]
pub(crate) fn ceil(p: DVec3) -> IVec3 {
    IVec3::new(ceil1(p.x), ceil1(p.y), ceil1(p.z))
}

/// Rounded down, as [`ceil`].
#[inline(always)]
pub(crate) fn floor(p: DVec3) -> IVec3 {
    -ceil(-p)
}

/// One coordinate of [`ceil`].
#[inline(always)]
pub(crate) fn ceil1(v: f64) -> i32 {
    let truncated = v as i32;
    truncated + i32::from(f64::from(truncated) < v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_triangle_is_in_its_tiles_in_order() {
        // Triangle t touches tiles t/7 and t % 5 + 100, for several chunks.
        let count = 3 * CHUNK + 17;
        let bins = Bins::new(count, |t, tiles| tiles.extend([t as i32 / 7 % 50, t as i32 % 5 + 100]));
        assert_eq!(bins.len(), 55);
        let mut found = 0;
        for bin in 0..bins.len() {
            let key = *bins.key(bin);
            assert!(bin == 0 || *bins.key(bin - 1) < key);
            assert!(bins.items(bin).is_sorted());
            assert!(bins.items(bin).iter().all(|&t| t as i32 / 7 % 50 == key || t as i32 % 5 + 100 == key));
            found += bins.items(bin).len();
        }
        assert_eq!(found, 2 * count);
        assert_eq!(Bins::<i32>::new(0, |_, _| ()).len(), 0);
    }

    #[test]
    fn rounding_is_that_of_f64() {
        for v in [-2.0, -1.5, -0.0, 0.0, 1e-300, 0.5, 3.0, 1e9 + 0.25, -1e9 - 0.25] {
            let (up, down) = (ceil(DVec3::splat(v)).x, floor(DVec3::splat(v)).x);
            assert_eq!((f64::from(up), f64::from(down)), (v.ceil(), v.floor()), "{v}");
        }
    }
}
