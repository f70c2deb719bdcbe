//! The pieces of a surface that separate an inside from an outside.
//!
//! Where parts of a mesh overlap, some of its area lies inside of the union and must not attract the distance; where it is
//! a sheet, both sides are outside. A piece counts if the winding number is above ½ on one of its sides and not on the other.
//!
//! In front of triangles that no others touch the winding number changes only because of the mesh's boundary, and no faster
//! than [`Rim`] says: connected ones are judged together, by one point, as far as that goes. Others are halved until that goes for
//! their parts, or they are pieces of at most [`COARSE`] voxels, and where pieces that count lie beside pieces that do not, further
//! down to [`FINE`].

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::Doubts;
use super::inside::Inside;
use super::intersect::Intersections;
use super::rim::{Rim, WINDING_ERROR};
use crate::error::Result;
use crate::mesh::TriangleMesh;
use crate::mesh::topology::{by_edge, edge_uses};
use crate::mesh::winding::BATCH;
use crate::run::RunOptions;

/// Longest edge, in voxels, of the pieces that are judged first.
const COARSE: f64 = 2.0;
/// Longest edge, in voxels, of the pieces along the border between what counts and what does not.
const FINE: f64 = 0.25;
/// How far, in voxels, beside a piece its sides are judged: beyond the rounding of coincident triangles, well below the
/// distance of two walls that a grid could tell apart.
const BESIDE: f64 = 1e-3;

/// Within this distance, in voxels, triangles are judged together where the mesh has a boundary.
const TOGETHER: f64 = 4.0;
/// How near the centres of pieces are that lie beside each other, in longest edges. Halves of a right-angled triangle have
/// theirs at a third, equal neighbours across a shorter edge at half; the farthest, 4/3, are slivers end to end.
const BESIDE_EACH_OTHER: f64 = 0.75;
/// Cutting stops when there are this many times the pieces that it began with: a border is a line and grows slowly; where it
/// is everywhere, as in a heap of triangles, its exact place means nothing.
const GROWTH: usize = 2;
/// Up to this many pieces cost too little for that to matter.
const FEW: usize = 1 << 15;

/// What remains of a surface.
pub(super) struct Pieces {
    /// The pieces that count.
    pub kept: Vec<[DVec3; 3]>,
    /// Fraction of the area that does not.
    pub removed_area_fraction: f64,
}

/// Part of a triangle.
struct Piece {
    triangle: u32,
    corners: [DVec3; 3],
}

impl Piece {
    fn center(&self) -> DVec3 {
        let [a, b, c] = self.corners;
        (a + b + c) / 3.0
    }

    /// Radius of the ball about `center` that holds it.
    fn radius_about(&self, center: DVec3) -> f64 {
        self.corners.iter().map(|c| c.distance_squared(center)).fold(0.0, f64::max).sqrt()
    }

    fn longest_edge(&self) -> f64 {
        let [a, b, c] = self.corners;
        a.distance(b).max(b.distance(c)).max(c.distance(a))
    }

    /// A point just beside it, in front of it or behind it.
    fn beside(&self, side: f64) -> DVec3 {
        let [a, b, c] = self.corners;
        self.center() + (b - a).cross(c - a).normalize_or_zero() * (side * BESIDE)
    }

    /// Cuts it until no edge is longer than `size`.
    fn cut(&self, size: f64) -> impl Iterator<Item = Self> {
        let triangle = self.triangle;
        cut(self.corners, size).into_iter().map(move |corners| Self { triangle, corners })
    }
}

/// Cuts and judges the triangles of an indexed mesh in index space that have a mark in `doubtful`; the others are known to count.
pub(super) fn separating_pieces(
    mesh: &TriangleMesh,
    doubtful: &[bool],
    doubts: &Doubts<'_>,
    run: &RunOptions,
) -> Result<Pieces> {
    let triangles = &mesh.triangles;
    let whole = |t: u32| Piece { triangle: t, corners: mesh.corners(t as usize) };
    let total: f64 = (0..triangles.len() as u32).map(|t| area(&whole(t).corners)).sum();
    let mut removed = 0.0;
    let mut kept = Vec::new();
    let &Doubts { tree, ref inside, rim, .. } = doubts;
    let intersections = Intersections { bvh: tree, positions: &mesh.positions, triangles };
    let crossed = intersections.marks(doubtful);
    let sure = doubtful.iter().map(|doubtful| (!doubtful).then_some(true)).collect();
    let verdicts = verdicts_together(&whole, triangles, sure, &crossed, inside, rim);
    let mut undecided = Vec::new();
    // In the order of the tree, so that those judged together lie together.
    for piece in tree.order().into_iter().map(whole) {
        match verdicts[piece.triangle as usize] {
            Some(true) => kept.push(piece.corners),
            Some(false) => removed += area(&piece.corners),
            None => undecided.push(piece),
        }
    }
    let touched =
        |piece: &Piece| crossed[piece.triangle as usize] && intersections.touch_part(piece.triangle, piece.corners);
    let check = |pieces: usize| {
        let bytes = pieces * 4 * std::mem::size_of::<Piece>();
        let advice = "the mesh is open or overlaps itself in many places; take a larger voxel_size";
        run.check("mesh to level set")?;
        run.reserve("mesh to level set", bytes as u64, advice)
    };
    let mut open = Vec::new();
    while !undecided.is_empty() {
        check(undecided.len() + open.len() + kept.len())?;
        let verdicts = judge_by_front(&undecided, touched, inside, rim);
        let mut next = Vec::new();
        for (piece, verdict) in undecided.into_iter().zip(verdicts) {
            match verdict {
                Some(true) => kept.push(piece.corners),
                Some(false) => removed += area(&piece.corners),
                None if piece.longest_edge() <= COARSE => open.push(piece),
                None => next.extend(piece.cut((0.5 * piece.longest_edge()).max(COARSE))),
            }
        }
        undecided = next;
    }
    let mut size = COARSE;
    let limit = FEW.max(GROWTH * open.len());
    while !open.is_empty() {
        check(open.len() + kept.len())?;
        let sure = judge_by_front(&open, touched, inside, rim);
        let unsure: Vec<usize> = (0..open.len()).filter(|&i| sure[i].is_none()).collect();
        let [fronts, backs] = [1.0, -1.0].map(|side| windings(unsure.len(), |i| open[unsure[i]].beside(side), inside));
        let mut counts: Vec<bool> = sure.iter().map(|sure| sure.unwrap_or_default()).collect();
        for ((i, front), back) in unsure.into_iter().zip(fronts).zip(backs) {
            counts[i] = (front > 0.5) != (back > 0.5);
        }
        let border = if size > FINE && open.len() < limit {
            borders(&open, &counts, size, triangles)
        } else {
            vec![false; open.len()]
        };
        let mut next = Vec::new();
        for (i, piece) in open.into_iter().enumerate() {
            match (border[i] && sure[i].is_none(), counts[i]) {
                (true, _) => next.extend(piece.cut(size / 2.0)),
                (false, true) => kept.push(piece.corners),
                (false, false) => removed += area(&piece.corners),
            }
        }
        open = next;
        size /= 2.0;
    }
    Ok(Pieces { kept, removed_area_fraction: if total > 0.0 { removed / total } else { 0.0 } })
}

/// Completes the `verdicts` whether triangles count for those that no others touch, unless one point does not decide.
fn verdicts_together(
    whole: &impl Fn(u32) -> Piece,
    triangles: &[[u32; 3]],
    mut verdicts: Vec<Option<bool>>,
    crossed: &[bool],
    inside: &Inside<'_>,
    rim: &Rim,
) -> Vec<Option<bool>> {
    const NONE: u32 = u32::MAX;
    // Over an edge of two triangles that agree on the outside one walks from front to front.
    let mut neighbours = vec![[NONE; 3]; triangles.len()];
    let uses = edge_uses(triangles);
    for edge in by_edge(&uses) {
        if let [a, b] = edge
            && a.forward != b.forward
        {
            for (from, to) in [(a, b), (b, a)] {
                if let Some(slot) = neighbours[from.triangle as usize].iter_mut().find(|slot| **slot == NONE) {
                    *slot = to.triangle;
                }
            }
        }
    }
    let mut open = Vec::new();
    for seed in 0..triangles.len() as u32 {
        if crossed[seed as usize] || verdicts[seed as usize].is_some() {
            continue;
        }
        let piece = whole(seed);
        let center = piece.center();
        let [front] = inside.windings_at(&[piece.beside(1.0)]);
        let own = piece.radius_about(center);
        let widest = if rim.is_empty() { f64::MAX } else { TOGETHER.max(2.0 * own) };
        // The verdict for all triangles within some distance, or at least for this one.
        let decided = [widest, own]
            .into_iter()
            .find(|&radius| error_in_front(center, radius, rim).is_some_and(|error| is_clear(front, error)));
        let Some(radius) = decided else { continue };
        // Behind a triangle w is one more than in front: ½ lies between for |front| < ½.
        let verdict = Some(front.abs() < 0.5);
        verdicts[seed as usize] = verdict;
        open.push(seed);
        while let Some(t) = open.pop() {
            for next in neighbours[t as usize] {
                let free = next != NONE && !crossed[next as usize] && verdicts[next as usize].is_none();
                if free && whole(next).radius_about(center) <= radius {
                    verdicts[next as usize] = verdict;
                    open.push(next);
                }
            }
        }
    }
    verdicts
}

/// Whether all of a piece counts, as far as the winding number in front of its middle tells.
fn judge_by_front(
    pieces: &[Piece],
    touched: impl Fn(&Piece) -> bool + Sync,
    inside: &Inside<'_>,
    rim: &Rim,
) -> Vec<Option<bool>> {
    // Most pieces near the boundary are passed over here, before anything is asked that takes longer.
    let error = |piece: &Piece| {
        let center = piece.center();
        error_in_front(center, piece.radius_about(center), rim).filter(|_| !touched(piece))
    };
    let errors: Vec<Option<f64>> = pieces.par_iter().map(error).collect();
    let asked: Vec<usize> = (0..pieces.len()).filter(|&i| errors[i].is_some()).collect();
    let mut verdicts = vec![None; pieces.len()];
    for (&i, front) in asked.iter().zip(windings(asked.len(), |i| pieces[asked[i]].beside(1.0), inside)) {
        // Behind it the winding number is one more.
        let clear = errors[i].is_some_and(|error| is_clear(front, error));
        verdicts[i] = clear.then_some(front.abs() < 0.5);
    }
    verdicts
}

/// How far the winding number in front of connected triangles within `radius` of `center` may be from what it is at one point there;
/// `None` if that says nothing, as near the boundary.
fn error_in_front(center: DVec3, radius: f64, rim: &Rim) -> Option<f64> {
    let slope = rim.steepest(center, radius, 0.5 / radius.max(f64::MIN_POSITIVE))?;
    Some(WINDING_ERROR + slope * radius)
}

/// Whether the winding number stays on its side of ½ and −½, where the verdict changes.
fn is_clear(front: f64, error: f64) -> bool {
    (front.abs() - 0.5).abs() > error
}

/// Winding numbers at points that lie near those before them.
fn windings(count: usize, point: impl Fn(usize) -> DVec3 + Sync, inside: &Inside<'_>) -> Vec<f64> {
    let batch = |first: usize| {
        let points = std::array::from_fn(|i| point((first + i).min(count - 1)));
        inside.windings_at::<BATCH>(&points).into_iter().take(count - first)
    };
    (0..count).into_par_iter().step_by(BATCH).flat_map_iter(batch).collect()
}

/// Which pieces lie beside a piece of the other kind on the same surface: of the same triangle or one that shares a vertex.
fn borders(pieces: &[Piece], counts: &[bool], size: f64, triangles: &[[u32; 3]]) -> Vec<bool> {
    if counts.iter().all(|&c| c) || !counts.iter().any(|&c| c) {
        return vec![false; pieces.len()];
    }
    let edge = size * BESIDE_EACH_OTHER;
    let cell = |p: DVec3| (p / edge).floor().as_i64vec3();
    let mut cells: FxHashMap<I64Vec3, [Vec<(DVec3, u32)>; 2]> = FxHashMap::default();
    for (piece, &counts) in pieces.iter().zip(counts) {
        let center = piece.center();
        cells.entry(cell(center)).or_default()[usize::from(counts)].push((center, piece.triangle));
    }
    let share = |a: u32, b: u32| a == b || triangles[a as usize].iter().any(|v| triangles[b as usize].contains(v));
    pieces
        .par_iter()
        .zip(counts)
        .map(|(piece, &counts)| {
            let center = piece.center();
            let middle = cell(center);
            (0..27).any(|i| {
                let neighbour = middle + I64Vec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
                let others = cells.get(&neighbour).map_or(&[][..], |c| &c[usize::from(!counts)]);
                others.iter().any(|&(other, triangle)| {
                    other.distance_squared(center) <= edge * edge && share(piece.triangle, triangle)
                })
            })
        })
        .collect()
}

fn area([a, b, c]: &[DVec3; 3]) -> f64 {
    0.5 * (b - a).cross(c - a).length()
}

/// Cuts a triangle into pieces whose edges are not longer than `size`: in halves across the longest edge, and what is
/// narrow by then into slices, because halving a needle makes ever more needles.
fn cut(triangle: [DVec3; 3], size: f64) -> Vec<[DVec3; 3]> {
    let mut done = Vec::new();
    let mut open = vec![triangle];
    while let Some([a, b, c]) = open.pop() {
        let lengths = [a.distance(b), b.distance(c), c.distance(a)];
        let longest = (0..3).fold(0, |best, k| if lengths[k] > lengths[best] { k } else { best });
        let length = lengths[longest];
        if length <= size {
            done.push([a, b, c]);
            continue;
        }
        let [from, to, apex] = [[a, b, c], [b, c, a], [c, a, b]][longest];
        if 2.0 * area(&[a, b, c]) <= 0.5 * size * length {
            slice([from, to, apex], size, &mut done);
            continue;
        }
        let middle = (from + to) * 0.5;
        open.push([middle, to, apex]);
        open.push([from, middle, apex]);
    }
    done
}

/// Slices a triangle whose first edge is its longest and whose height is at most half of `size` across that edge.
fn slice([from, to, apex]: [DVec3; 3], size: f64, done: &mut Vec<[DVec3; 3]>) {
    let base = to - from;
    let length = base.length();
    let at_apex = ((apex - from).dot(base) / (length * length)).clamp(0.0, 1.0);
    // With the height, the diagonal of a slice of 0.8 by 0.5 is below one size.
    let steps = (length / (0.8 * size)).ceil();
    let mut cuts: Vec<f64> = (0..=steps as usize).map(|i| i as f64 / steps).chain([at_apex]).collect();
    cuts.sort_unstable_by(f64::total_cmp);
    cuts.dedup();
    let roof = |t: f64| {
        if t <= at_apex && at_apex > 0.0 {
            from.lerp(apex, t / at_apex)
        } else {
            to.lerp(apex, (1.0 - t) / (1.0 - at_apex))
        }
    };
    for pair in cuts.windows(2) {
        let (floor0, floor1) = (from.lerp(to, pair[0]), from.lerp(to, pair[1]));
        let (roof0, roof1) = (roof(pair[0]), roof(pair[1]));
        let corners = [[floor0, floor1, roof1], [floor0, roof1, roof0]];
        done.extend(corners.into_iter().filter(|t| area(t) > 0.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Bvh;
    use crate::mesh::testing::*;
    use crate::mesh::to_levelset::crossings::Crossings;
    use crate::mesh::to_levelset::inside::caps;
    use crate::mesh::topology::boundary_chain;

    fn pieces(mesh: &TriangleMesh) -> Pieces {
        let chain = boundary_chain(&edge_uses(&mesh.triangles));
        let caps = caps(&mesh.positions, &chain);
        let count = mesh.triangles.len();
        let crossings = Crossings::new(count + caps.len(), |t| {
            caps.get(t.wrapping_sub(count)).copied().unwrap_or_else(|| mesh.corners(t))
        });
        let (tree, caps) = (Bvh::new((0..count).map(|t| mesh.corners(t)).collect()), Bvh::new(caps));
        let rim = Rim::new(&mesh.positions, &chain);
        let doubts =
            Doubts { inside: Inside::new(crossings, &tree, &caps, &rim), overlaps: Vec::new(), tree: &tree, rim: &rim };
        separating_pieces(mesh, &vec![true; count], &doubts, &RunOptions::default()).unwrap()
    }

    #[test]
    fn all_of_a_cube_counts_and_nothing_of_a_sheet() {
        let cube = cube(DVec3::ZERO, 10.0);
        assert_eq!(pieces(&cube).removed_area_fraction, 0.0);
        let sheet = TriangleMesh { triangles: cube.triangles[..2].to_vec(), ..cube };
        let sheet = pieces(&sheet);
        assert!(sheet.kept.is_empty() && (sheet.removed_area_fraction - 1.0).abs() < 1e-12);
    }

    #[test]
    fn only_the_outer_walls_of_two_cubes_count() {
        // Two cubes of edge 8 that overlap in a cube of edge 4: of 768, three faces of 4x4 of each are inside.
        let both = pieces(&joined(cube(DVec3::splat(0.1), 8.0), &cube(DVec3::splat(4.1), 8.0)));
        assert!((both.removed_area_fraction - 96.0 / 768.0).abs() < 0.01, "{}", both.removed_area_fraction);
        let overlap = |p: DVec3| p.cmpgt(DVec3::splat(4.1 + 0.25)).all() && p.cmplt(DVec3::splat(8.1 - 0.25)).all();
        assert!(!both.kept.iter().flatten().any(|&p| overlap(p)));
    }

    #[test]
    fn cutting_keeps_the_area_and_bounds_the_edges() {
        for triangle in [
            [DVec3::ZERO, DVec3::X * 9.0, DVec3::Y * 5.0],
            [DVec3::ZERO, DVec3::X * 300.0, DVec3::new(150.0, 0.01, 0.0)],
        ] {
            let pieces = cut(triangle, 1.0);
            assert!((pieces.iter().map(area).sum::<f64>() - area(&triangle)).abs() < 1e-9);
            assert!(
                pieces.iter().all(|[a, b, c]| a.distance(*b).max(b.distance(*c)).max(c.distance(*a)) <= 1.0 + 1e-12)
            );
            // In proportion to the length, not to its square.
            assert!(pieces.len() < 1000, "{}", pieces.len());
        }
    }
}
