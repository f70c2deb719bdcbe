//! Small pieces of a surface taken away: parts of the inside that float, and bubbles.

use glam::IVec3;
use rayon::prelude::*;
use smallvec::SmallVec;

use super::LevelSet;
use super::components::split;
use super::union_find::UnionFind;
use crate::error::{EditError, Result};
use crate::grid::{Face, Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet};
use crate::run::RunOptions;

const OPERATION: &str = "dropping specks";

impl LevelSet {
    /// Without the connected parts of the inside, and of the outside that they enclose, that have less than `part` of the voxels of the largest part of the
    /// inside; neighbours are those across faces. Says how many went. What goes becomes ±background by what is around it: distances beside it are too short.
    pub(crate) fn without_specks(&self, part: f64, run: &RunOptions) -> Result<(Self, usize)> {
        let Some(pieces) = Pieces::new(self.grid(), run)? else { return Ok((self.clone(), 0)) };
        let (signs, count) = pieces.signs(part);
        if count == 0 {
            return Ok((self.clone(), 0));
        }
        let original = self.grid();
        let changed = |id: LeafId| {
            pieces.at(pieces.place_of_leaf(original, id)).filter(|(n, piece)| signs[*n as usize] != piece.inside)
        };
        let touched: LeafSet = original.leaves().iter().copied().filter(|&id| changed(id).next().is_some()).collect();
        let mut grid = original.clone();
        let background = grid.background();
        grid.update(&touched, |id, values, mask| {
            for (_, piece) in changed(id) {
                for at in piece.voxels.iter() {
                    values.0[at] = if piece.inside { background } else { -background };
                }
                *mask = mask.zip(piece.voxels, |active, gone| active & !gone);
            }
        });
        grid.flood_signs();
        Ok((Self::new(grid, *self.transform()), count))
    }
}

/// Connected voxels of one sign in a leaf, or all of one that is absent.
struct Piece {
    inside: bool,
    voxels: LeafMask,
}

/// The connected parts of inside and outside in a box of leaves around a surface, a leaf of the outside wider than that.
struct Pieces {
    /// The first leaf of the box, and leaves along its sides.
    first: IVec3,
    size: IVec3,
    /// By place in the box; none where the leaf is absent.
    of_place: Vec<SmallVec<[Piece; 2]>>,
    /// The number of the first piece of each place; an absent leaf has one.
    number: Vec<u32>,
    /// Whether an absent leaf is inside.
    sign: Vec<bool>,
    sets: UnionFind,
}

impl Pieces {
    fn new(grid: &Grid, run: &RunOptions) -> Result<Option<Self>> {
        let origins = || grid.leaves().iter().map(|&id| grid.origin(id).div_euclid(IVec3::splat(LEAF_DIM)));
        let Some((lo, hi)) = origins().map(|o| (o, o)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) else {
            return Ok(None);
        };
        let (first, size) = (lo - 1, hi - lo + 3);
        let [sx, sy, sz] = size.to_array().map(|n| u64::from(n.unsigned_abs()));
        let places = sx.saturating_mul(sy).saturating_mul(sz);
        let bytes = size_of::<SmallVec<[Piece; 2]>>() + 2 * size_of::<u32>() + size_of::<bool>();
        run.reserve(OPERATION, places.saturating_mul(bytes as u64), "take a larger voxel_size")?;
        if places > u64::from(u32::MAX) / LEAF_VOXELS as u64 {
            return Err(EditError::parameter(
                OPERATION,
                "voxel_size",
                sx.max(sy).max(sz) * LEAF_DIM as u64,
                "fewer voxels along a side",
            ));
        }
        let mut pieces =
            Self { first, size, of_place: Vec::new(), number: Vec::new(), sign: Vec::new(), sets: UnionFind::new(0) };
        let found = (0..places as usize).into_par_iter().with_min_len(64).map(|n| {
            let id = grid.find((pieces.first + pieces.place(n)) * LEAF_DIM);
            match id {
                LeafId::OUTSIDE => (SmallVec::new(), false),
                LeafId::INSIDE => (SmallVec::new(), true),
                _ => (pieces_of_leaf(grid, id), false),
            }
        });
        (pieces.of_place, pieces.sign) = found.unzip();
        run.check(OPERATION)?;
        let mut total = 0;
        for here in &pieces.of_place {
            pieces.number.push(total);
            total += here.len().max(1) as u32;
        }
        pieces.sets = UnionFind::new(total as usize);
        (0..places as usize).into_par_iter().with_min_len(64).for_each(|n| pieces.join_upwards(n));
        run.check(OPERATION)?;
        Ok(Some(pieces))
    }

    /// The place of a number, in leaves from the first one.
    fn place(&self, n: usize) -> IVec3 {
        let [_, sy, sz] = self.size.to_array().map(|n| n as usize);
        IVec3::new((n / (sy * sz)) as i32, (n / sz % sy) as i32, (n % sz) as i32)
    }

    /// The number of a place; `None` beyond the box.
    fn number_of(&self, place: IVec3) -> Option<usize> {
        let within = place.cmpge(IVec3::ZERO).all() && place.cmplt(self.size).all();
        within.then(|| ((place.x * self.size.y + place.y) * self.size.z + place.z) as usize)
    }

    /// The pieces of a place with their numbers.
    fn at(&self, n: usize) -> impl Iterator<Item = (u32, Piece)> + '_ {
        let here = &self.of_place[n];
        let absent = here.is_empty().then(|| Piece { inside: self.sign[n], voxels: LeafMask::FULL });
        let present = here.iter().map(|piece| Piece { inside: piece.inside, voxels: piece.voxels });
        (self.number[n]..).zip(present.chain(absent))
    }

    /// The pieces of two places beside each other that touch across a face of the first one.
    fn touching(&self, n: usize, face: Face, next: usize, mut touch: impl FnMut((u32, bool), (u32, bool))) {
        if self.of_place[n].is_empty() && self.of_place[next].is_empty() {
            return touch((self.number[n], self.sign[n]), (self.number[next], self.sign[next]));
        }
        for (number, piece) in self.at(n) {
            let spill = piece.voxels.spill(face);
            for (other, beside) in self.at(next) {
                if !spill.zip(beside.voxels, |a, b| a & b).is_empty() {
                    touch((number, piece.inside), (other, beside.inside));
                }
            }
        }
    }

    /// Joins what touches in a place and the next ones along the axes.
    fn join_upwards(&self, n: usize) {
        for face in [Face::XPlus, Face::YPlus, Face::ZPlus] {
            let Some(next) = self.number_of(self.place(n) + face.step()) else { continue };
            self.touching(n, face, next, |(a, one), (b, other)| {
                if one == other {
                    self.sets.join(a, b);
                }
            });
        }
    }

    /// The sign that each piece is to have, by number, and how many specks there are. A speck gets the sign of what is around it, be that a speck itself.
    fn signs(&self, part: f64) -> (Vec<bool>, usize) {
        let total = self.number.last().zip(self.of_place.last()).map_or(0, |(n, last)| *n as usize + last.len().max(1));
        let roots: Vec<u32> = (0..total as u32).map(|number| self.sets.root(number)).collect();
        let mut voxels = vec![0u64; total];
        let mut inside = vec![false; total];
        for (number, piece) in (0..self.of_place.len()).flat_map(|n| self.at(n)) {
            voxels[roots[number as usize] as usize] += u64::from(piece.voxels.count());
            inside[number as usize] = piece.inside;
        }
        let of_inside = voxels.iter().zip(&inside).filter(|(_, inside)| **inside).map(|(count, _)| *count);
        let least = part * of_inside.max().unwrap_or(0) as f64;
        // The first place is of the outside that goes on for ever.
        let is_speck = |number: u32| {
            let root = roots[number as usize];
            root != 0 && (voxels[root as usize] as f64) < least
        };
        let count = (0..total as u32).filter(|&n| roots[n as usize] == n && is_speck(n)).count();
        if count == 0 {
            return (inside, 0);
        }
        // What specks touch, by roots.
        let mut beside: Vec<(u32, u32)> = Vec::new();
        for n in 0..self.of_place.len() {
            if !self.at(n).any(|(number, _)| is_speck(number)) {
                continue;
            }
            let mut touch = |(a, one): (u32, bool), (b, other): (u32, bool)| {
                if one != other && (is_speck(a) || is_speck(b)) {
                    beside.push((roots[a as usize], roots[b as usize]));
                }
            };
            for face in Face::ALL {
                if let Some(next) = self.number_of(self.place(n) + face.step()) {
                    self.touching(n, face, next, &mut touch);
                }
            }
            for (a, one) in self.at(n).filter(|(_, piece)| piece.inside) {
                let grown = one.voxels.dilated();
                for (b, other) in self.at(n).filter(|(_, piece)| !piece.inside) {
                    if !grown.zip(other.voxels, |a, b| a & b).is_empty() {
                        touch((a, true), (b, false));
                    }
                }
            }
        }
        beside.sort_unstable();
        beside.dedup();
        let mut of_root: Vec<Option<bool>> =
            (0..total as u32).map(|n| (!is_speck(n)).then_some(inside[n as usize])).collect();
        // From what stays inwards, a speck in a speck at a time.
        loop {
            let found: Vec<(u32, bool)> = beside
                .iter()
                .flat_map(|&(a, b)| [(a, b), (b, a)])
                .filter_map(|(a, b)| {
                    of_root[b as usize].filter(|_| of_root[a as usize].is_none()).map(|sign| (a, sign))
                })
                .collect();
            if found.is_empty() {
                break;
            }
            found.into_iter().for_each(|(root, sign)| of_root[root as usize] = Some(sign));
        }
        let sign = |n: usize| of_root[roots[n] as usize].unwrap_or(inside[n]);
        ((0..total).map(sign).collect(), count)
    }

    fn place_of_leaf(&self, grid: &Grid, id: LeafId) -> usize {
        self.number_of(grid.origin(id).div_euclid(IVec3::splat(LEAF_DIM)) - self.first).unwrap_or(0)
    }
}

fn pieces_of_leaf(grid: &Grid, id: LeafId) -> SmallVec<[Piece; 2]> {
    let mut inside = LeafMask::EMPTY;
    for (at, value) in grid.values(id).0.iter().enumerate() {
        inside.set(at, *value < 0.0);
    }
    let outside = inside.zip(inside, |a, _| !a);
    let of = |inside: bool, voxels: LeafMask| split(voxels).into_iter().map(move |voxels| Piece { inside, voxels });
    of(true, inside).chain(of(false, outside)).collect()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::levelset::testing::sampled;

    #[test]
    fn specks_and_bubbles_go_and_the_rest_keeps_its_bits() {
        let ball = |p: DVec3, centre: [f64; 3], radius: f64| p.distance(DVec3::from_array(centre)) - radius;
        let run = RunOptions::default();
        // A bubble and a ball wide enough to have absent leaves, and small ones of each.
        let whole = |p: DVec3| ball(p, [-15.0, 0.0, 0.0], 40.0);
        let kept = |p: DVec3| whole(p).min(ball(p, [60.0, 0.0, 0.0], 22.0));
        let level_set = sampled(90, |p| {
            let bubbles = ball(p, [-20.0, 3.0, 0.0], 20.0).min(ball(p, [10.0, 0.0, 5.0], 4.0));
            kept(p).max(-bubbles).min(ball(p, [-20.0, 3.0, 1.0], 6.0)).min(ball(p, [0.0, 60.0, 0.0], 5.0))
        });
        let (all, none) = level_set.without_specks(0.0, &run).unwrap();
        assert!(none == 0 && all.grid().leaves() == level_set.grid().leaves());
        let (clean, count) = level_set.without_specks(0.15, &run).unwrap();
        // 8000 of 56 thousand: the large bubble goes, with the ball in it; the ball of 22 is a sixth of the one of 40.
        assert_eq!(count, 4);
        let expected = sampled(90, kept);
        for ijk in
            [(-20, 3, 1), (-20, 3, 15), (10, 0, 5), (0, 60, 0), (60, 0, 0), (-15, 0, 38), (26, 0, 0), (80, 80, 80)]
        {
            let ijk = IVec3::from(ijk);
            assert_eq!(clean.grid().voxel(ijk).0 < 0.0, expected.grid().voxel(ijk).0 < 0.0, "{ijk}");
        }
        let measures = clean.measure(&run).unwrap();
        assert_eq!((measures.components, measures.euler), (2, 4));
        let (same, count) = clean.without_specks(0.15, &run).unwrap();
        assert_eq!((count, same.measure(&run).unwrap().volume), (0, measures.volume));
        // Far from what went nothing has changed.
        assert_eq!(clean.grid().voxel(IVec3::new(82, 0, 1)), level_set.grid().voxel(IVec3::new(82, 0, 1)));
    }

    #[test]
    fn nothing_of_nothing() {
        let empty = LevelSet::empty(crate::grid::Transform::uniform(1.0), 3.0);
        assert_eq!(empty.without_specks(0.5, &RunOptions::default()).unwrap().1, 0);
    }
}
