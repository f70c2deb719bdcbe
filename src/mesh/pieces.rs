//! The pieces of a surface that separate an inside from an outside.
//!
//! Where parts of a mesh overlap, some of its area lies inside of the union and must not attract the distance; where it is
//! a sheet, both sides are outside. A piece counts if the winding number is above ½ on one of its sides and not on the other. Triangles
//! are cut into pieces of at most [`COARSE`] voxels, and where pieces that count lie beside pieces that do not,
//! further down to [`FINE`].

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::WindingNumber;

/// Longest edge, in voxels, of the pieces that are judged first.
const COARSE: f64 = 2.0;
/// Longest edge, in voxels, of the pieces along the border between what counts and what does not.
const FINE: f64 = 0.25;
/// How far, in voxels, beside a piece its sides are judged: beyond the rounding of coincident triangles, well below the
/// distance of two walls that a grid could tell apart.
const BESIDE: f64 = 1e-3;

/// What remains of a surface.
pub(crate) struct Pieces {
    /// The pieces that count.
    pub kept: Vec<[DVec3; 3]>,
    /// Fraction of the area that does not.
    pub removed_area_fraction: f64,
}

/// Cuts and judges the triangles, which are in index space.
pub(crate) fn separating_pieces(triangles: &[[DVec3; 3]], winding: &WindingNumber<'_>) -> Pieces {
    let total: f64 = triangles.iter().map(area).sum();
    let mut removed = 0.0;
    let mut kept = Vec::new();
    let mut size = COARSE;
    let mut open: Vec<[DVec3; 3]> = triangles.par_iter().flat_map_iter(|&t| cut(t, size)).collect();
    loop {
        let counts: Vec<bool> = open.par_iter().map(|piece| separates(piece, winding)).collect();
        let cell = |piece: &[DVec3; 3]| ((piece[0] + piece[1] + piece[2]) / (3.0 * size)).floor().as_i64vec3();
        let mut cells: FxHashMap<I64Vec3, [bool; 2]> = FxHashMap::default();
        if size > FINE {
            for (piece, &counts) in open.iter().zip(&counts) {
                cells.entry(cell(piece)).or_default()[usize::from(counts)] = true;
            }
        }
        // Only where both kinds occur at all is there a border.
        let mixed = cells.values().any(|c| c[0]) && cells.values().any(|c| c[1]);
        let at_border = |piece: &[DVec3; 3], counts: bool| {
            let center = cell(piece);
            mixed
                && (0..27).any(|i| {
                    let neighbour = center + I64Vec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
                    cells.get(&neighbour).is_some_and(|c| c[usize::from(!counts)])
                })
        };
        let border: Vec<bool> = open.par_iter().zip(&counts).map(|(piece, &counts)| at_border(piece, counts)).collect();
        let mut next = Vec::new();
        for ((piece, counts), border) in open.into_iter().zip(counts).zip(border) {
            match (border, counts) {
                (true, _) => next.extend(cut(piece, size / 2.0)),
                (false, true) => kept.push(piece),
                (false, false) => removed += area(&piece),
            }
        }
        if next.is_empty() {
            break;
        }
        open = next;
        size /= 2.0;
    }
    Pieces { kept, removed_area_fraction: if total > 0.0 { removed / total } else { 0.0 } }
}

fn area([a, b, c]: &[DVec3; 3]) -> f64 {
    0.5 * (b - a).cross(c - a).length()
}

/// Whether the two sides of a piece differ.
fn separates(piece: &[DVec3; 3], winding: &WindingNumber<'_>) -> bool {
    let [a, b, c] = piece;
    let Some(normal) = (b - a).cross(c - a).try_normalize() else { return false };
    let center = (a + b + c) / 3.0;
    let side = |sign: f64| winding.at(center + normal * (sign * BESIDE)) > 0.5;
    side(1.0) != side(-1.0)
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
    use crate::mesh::testing::*;
    use crate::mesh::{Bvh, TriangleMesh};

    fn pieces(mesh: &TriangleMesh) -> Pieces {
        let triangles: Vec<_> = (0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect();
        let bvh = Bvh::new(triangles.clone());
        separating_pieces(&triangles, &WindingNumber::new(&bvh))
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
