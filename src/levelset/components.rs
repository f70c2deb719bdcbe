//! Connected parts of the inside: 6 neighbours, as the surface separates them.
//!
//! Each leaf is split into its own connected parts by bit masks, and the solid space between leaves into runs of
//! absent leaves along z; parts and runs that touch are then joined. A large interior costs one run a column of
//! leaves, not its voxels.

use glam::IVec3;
use rayon::prelude::*;
use smallvec::SmallVec;

use super::isosurface::IsoSurface;
use super::union_find::UnionFind;
use crate::grid::{Face, Grid, LEAF_DIM, LeafId, LeafMask, neighbour_index};

/// Number of connected parts of the inside.
pub(super) fn count(grid: &Grid, surface: &IsoSurface) -> u64 {
    let leaves = grid.leaves();
    let parts: Vec<Parts> = grid.map_leaves(|id| split(*surface.inside(id)));
    let mut first_part = vec![0u32; grid.neighbours().len()];
    let mut place = vec![0u32; grid.neighbours().len()];
    let mut total = 0;
    for (i, (&id, parts)) in leaves.iter().zip(&parts).enumerate() {
        first_part[id.index()] = total;
        place[id.index()] = i as u32;
        total += parts.len() as u32;
    }
    let runs = runs_of(&grid.inside_tiles());
    let run_number = |i: usize| total + i as u32;
    let sets = UnionFind::new(total as usize + runs.len());

    leaves.par_iter().zip(&parts).with_min_len(64).for_each(|(&id, own)| {
        let origin = grid.origin(id);
        for face in Face::ALL {
            let beyond = grid.neighbours()[id.index()][neighbour_index(face.step())];
            if beyond == LeafId::OUTSIDE {
                continue;
            }
            let upper = matches!(face, Face::XPlus | Face::YPlus | Face::ZPlus);
            for (i, part) in own.iter().enumerate() {
                let spill = part.spill(face);
                let number = first_part[id.index()] + i as u32;
                if beyond == LeafId::INSIDE {
                    let run = find_run(&runs, origin + face.step() * LEAF_DIM).filter(|_| !spill.is_empty());
                    if let Some(run) = run {
                        sets.join(number, run_number(run));
                    }
                } else if upper {
                    for (k, other) in parts[place[beyond.index()] as usize].iter().enumerate() {
                        if !spill.zip(*other, |a, b| a & b).is_empty() {
                            sets.join(number, first_part[beyond.index()] + k as u32);
                        }
                    }
                }
            }
        }
    });
    runs.par_iter().enumerate().for_each(|(i, run)| {
        for step in [IVec3::X, IVec3::Y] {
            let beside = run.origin + step * LEAF_DIM;
            // The first run of that column that ends above this one's beginning.
            let first = runs.partition_point(|r| (r.origin.x, r.origin.y, r.end) <= (beside.x, beside.y, beside.z));
            let touching = runs[first..]
                .iter()
                .take_while(|r| (r.origin.x, r.origin.y) == (beside.x, beside.y) && r.origin.z < run.end);
            for k in 0..touching.count() {
                sets.join(run_number(i), run_number(first + k));
            }
        }
    });
    sets.count()
}

/// Bytes that [`count`] needs, where few leaves have more than one part.
pub(super) fn bytes_needed(grid: &Grid) -> u64 {
    (grid.leaves().len() * (size_of::<Parts>() + 3 * size_of::<u32>())) as u64
}

/// The connected parts of one leaf's inside: rarely more than one.
type Parts = SmallVec<[LeafMask; 1]>;

fn split(inside: LeafMask) -> Parts {
    let mut rest = inside;
    let mut parts = Parts::new();
    while let Some(seed) = rest.iter().next() {
        let mut part = LeafMask::EMPTY;
        part.set(seed, true);
        loop {
            let grown = part.dilated().zip(rest, |a, b| a & b);
            if grown == part {
                break;
            }
            part = grown;
        }
        rest = rest.zip(part, |a, b| a & !b);
        parts.push(part);
    }
    parts
}

/// A row of absent inside leaves along z, from the voxel `origin` up to z = `end` (excluded).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Run {
    origin: IVec3,
    end: i32,
}

/// The runs of all tiles (by origin, with their edges), sorted by origin.
fn runs_of(tiles: &[(IVec3, i32)]) -> Vec<Run> {
    let (large, small): (Vec<_>, Vec<_>) = tiles.iter().copied().partition(|(_, edge)| *edge > LEAF_DIM);
    // Tiles of one size come column by column; whole nodes are joined along z before they are cut into columns of
    // leaves.
    let mut runs = join_along_z(small.into_iter().map(|(origin, edge)| Run { origin, end: origin.z + edge }));
    for (edge, tower) in towers(&large) {
        for x in (0..edge).step_by(LEAF_DIM as usize) {
            for y in (0..edge).step_by(LEAF_DIM as usize) {
                runs.push(Run { origin: tower.origin + IVec3::new(x, y, 0), ..tower });
            }
        }
    }
    runs.par_sort_unstable_by_key(|r| (r.origin.x, r.origin.y, r.origin.z));
    join_along_z(runs.into_iter())
}

/// Whole nodes joined along z, with their edge.
fn towers(tiles: &[(IVec3, i32)]) -> Vec<(i32, Run)> {
    let Some(&(_, edge)) = tiles.first() else { return Vec::new() };
    let runs = tiles.iter().map(|&(origin, edge)| Run { origin, end: origin.z + edge });
    join_along_z(runs).into_iter().map(|run| (edge, run)).collect()
}

/// Joins runs that continue the one before.
fn join_along_z(runs: impl Iterator<Item = Run>) -> Vec<Run> {
    let mut joined: Vec<Run> = Vec::new();
    for run in runs {
        match joined.last_mut() {
            Some(last) if last.origin.with_z(last.end) == run.origin => last.end = run.end,
            _ => joined.push(run),
        }
    }
    joined
}

/// The run that holds the absent leaf at `origin`.
fn find_run(runs: &[Run], origin: IVec3) -> Option<usize> {
    let after = runs.partition_point(|r| (r.origin.x, r.origin.y, r.origin.z) <= (origin.x, origin.y, origin.z));
    let run = after.checked_sub(1)?;
    let Run { origin: first, end } = runs[run];
    ((first.x, first.y) == (origin.x, origin.y) && origin.z < end).then_some(run)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_become_runs_along_z() {
        let tiles =
            [(IVec3::new(0, 0, -8), 8), (IVec3::ZERO, 128), (IVec3::new(0, 0, 128), 128), (IVec3::new(0, 8, 256), 8)];
        let runs = runs_of(&tiles);
        assert_eq!(runs.len(), 256);
        assert_eq!(runs[0], Run { origin: IVec3::new(0, 0, -8), end: 256 });
        assert_eq!(runs[1], Run { origin: IVec3::new(0, 8, 0), end: 264 });
        assert_eq!(find_run(&runs, IVec3::new(0, 8, 256)), Some(1));
        assert_eq!(find_run(&runs, IVec3::new(0, 8, 264)), None);
        assert_eq!(find_run(&runs, IVec3::new(0, 0, -16)), None);
        assert_eq!(find_run(&runs, IVec3::new(128, 0, 0)), None);
    }

    #[test]
    fn a_leaf_is_split_into_its_parts() {
        // Voxels that touch at edges and corners only stay apart; a snake through the whole leaf is one.
        let mut checkerboard = LeafMask::EMPTY;
        let mut snake = LeafMask::EMPTY;
        for offset in 0..512 {
            let p = crate::grid::offset_to_local(offset);
            checkerboard.set(offset, p.element_sum() % 2 == 0);
            let turn = if p.y % 4 == 1 { p.z == 7 } else { p.z == 0 };
            snake.set(offset, p.x % 2 == 0 && (p.y % 2 == 0 || turn) || (p.x % 2 == 1 && p.y == 0 && p.z == 0));
        }
        assert_eq!(split(checkerboard).len(), 256);
        assert_eq!(split(snake).len(), 1);
        assert!(split(LeafMask::EMPTY).is_empty());
    }
}
