//! The polygons of one cell, for each of the 256 ways in which its eight corners can lie inside or outside.
//!
//! The table is derived, not typed in. On each face of the cell every run of inside corners, followed counter-clockwise
//! as seen from outside the cell, gives one directed segment from the edge where the run is entered to the edge where
//! it is left. An ambiguous face (two inside corners across the diagonal) thus always separates the inside corners. The
//! neighbour sees the same face in the opposite direction and finds the same segments reversed. Each crossed edge
//! ends one segment and begins another, so the segments close to loops, and the loops of all cells form a closed
//! surface, counter-clockwise seen from outside, for every sign field.
//!
//! Loops have 3 to 7 corners. They are triangulated without any diagonal between two edges of one cell face: such a
//! diagonal could coincide with one of the neighbour, and four triangles would meet there. Every loop has such a
//! triangulation. Each triangle edge is then either a segment, shared by exactly two cells, or a diagonal within one
//! cell: the surface is manifold.

use std::sync::LazyLock;

/// A corner of a cell: x·4 + y·2 + z.
pub(crate) type Corner = u8;
/// An edge of a cell: axis·4 + position, where the position holds the other two coordinates in the order of the axes.
pub(crate) type Edge = u8;

/// Most triangles of a cell.
pub(crate) const MAX_TRIANGLES: usize = 5;

/// The polygons of one sign pattern.
#[derive(Debug, Default)]
pub(crate) struct CellCase {
    /// Number of loops: disjoint pieces of surface.
    pub loops: u32,
    /// The edges whose ends have different signs, a bit an edge.
    pub crossed: u16,
    /// Triangles over crossed edges, counter-clockwise seen from outside.
    pub triangles: Vec<[Edge; 3]>,
    /// Triangle edges on the faces of the cell.
    pub segments: Vec<Segment>,
    /// Triangle edges within the cell: the crossed edges at both ends, and the two triangles, the one that follows
    /// the direction first.
    pub diagonals: Vec<([Edge; 2], [u8; 2])>,
}

/// A triangle edge that lies on a face of the cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Segment {
    /// The face: axis·2, + 1 on the upper side.
    pub face: u8,
    /// From one crossed edge to another, as the triangle goes.
    pub ends: [Edge; 2],
    /// The triangle.
    pub triangle: u8,
}

/// Axis (0 = x) and first corner of an edge.
pub(crate) const EDGES: [(usize, Corner); 12] = {
    let mut edges = [(0, 0); 12];
    let mut e = 0;
    while e < 12 {
        let (u, v) = ((e >> 1 & 1) as u8, (e & 1) as u8);
        edges[e] = match e / 4 {
            0 => (0, u << 1 | v),
            1 => (1, u << 2 | v),
            _ => (2, u << 2 | v << 1),
        };
        e += 1;
    }
    edges
};

/// The polygons of the cell whose corner c is inside where bit c of `pattern` is set.
#[inline(always)]
pub(crate) fn cell_case(pattern: u8) -> &'static CellCase {
    static CASES: LazyLock<Vec<CellCase>> = LazyLock::new(|| (0..=255).map(derive).collect());
    &CASES[usize::from(pattern)]
}

/// The same edge as the neighbour beyond `axis` names it: on the opposite side of the cell.
pub(crate) fn across(edge: Edge, axis: usize) -> Edge {
    let (along, corner) = EDGES[usize::from(edge)];
    edge_at(along, corner ^ step(axis))
}

/// The corner bit of an axis.
fn step(axis: usize) -> Corner {
    4 >> axis
}

/// The edge along `axis` at a corner; the corner's coordinate along the axis does not matter.
pub(crate) fn edge_at(axis: usize, corner: Corner) -> Edge {
    let bit = |a: usize| corner >> (2 - a) & 1;
    let (u, v) = [(1, 2), (0, 2), (0, 1)][axis];
    axis as Edge * 4 + bit(u) * 2 + bit(v)
}

fn edge_between(a: Corner, b: Corner) -> Edge {
    let axis = match a ^ b {
        4 => 0,
        2 => 1,
        _ => 2,
    };
    edge_at(axis, a)
}

/// The corners of a face, counter-clockwise seen from outside the cell.
fn face_corners(face: u8) -> [Corner; 4] {
    let axis = usize::from(face / 2);
    let (u, v) = (step((axis + 1) % 3), step((axis + 2) % 3));
    // u × v points along the axis: right for the upper face, reversed for the lower.
    if face % 2 == 1 { [0, u, u | v, v].map(|c| c | step(axis)) } else { [0, v, u | v, u] }
}

/// The face that holds both edges, if any. Two edges share at most one.
fn common_face(a: Edge, b: Edge) -> Option<u8> {
    (0..6).find(|&face| {
        let corners = face_corners(face);
        let holds = |e| (0..4).any(|i| edge_between(corners[i], corners[(i + 1) % 4]) == e);
        holds(a) && holds(b)
    })
}

/// The loops of a sign pattern, each as its edges in order.
///
/// On the face `turned`, if any, the outside corners are separated where the inside ones would be; it must be ambiguous.
pub(super) fn loops(pattern: u8, turned: Option<u8>) -> Vec<Vec<Edge>> {
    let inside = |c: Corner| pattern >> c & 1 == 1;
    let mut next: [Option<Edge>; 12] = [None; 12];
    for face in 0..6 {
        let corners = face_corners(face);
        // Leaving where the run across the diagonal does joins the two inside corners.
        let skipped = if turned == Some(face) { 2 } else { 0 };
        for i in 0..4 {
            let (before, first) = (corners[(i + 3) % 4], corners[i]);
            if inside(first) && !inside(before) {
                // The corner before is outside, so the run ends within four steps.
                let mut last = i + skipped;
                while inside(corners[(last + 1) % 4]) {
                    last += 1;
                }
                next[usize::from(edge_between(before, first))] =
                    Some(edge_between(corners[last % 4], corners[(last + 1) % 4]));
            }
        }
    }
    let mut loops = Vec::new();
    for start in 0..12 {
        let mut outline = Vec::new();
        let mut edge = start;
        while let Some(following) = next[usize::from(edge)].take() {
            outline.push(edge);
            edge = following;
        }
        if !outline.is_empty() {
            loops.push(outline);
        }
    }
    loops
}

/// The face whose two inside corners lie across its diagonal and whose four crossed edges all belong to one loop.
pub(super) fn doubled_face(pattern: u8) -> Option<u8> {
    let loops = loops(pattern, None);
    (0..6).find(|&face| {
        let corners = face_corners(face);
        let inside = corners.map(|c| pattern >> c & 1);
        let ambiguous = inside[0] == inside[2] && inside[1] == inside[3] && inside[0] != inside[1];
        let mut edges = (0..4).map(|i| edge_between(corners[i], corners[(i + 1) % 4]));
        let first = loops.iter().find(|outline| outline.contains(&edge_between(corners[0], corners[1])));
        ambiguous && first.is_some_and(|outline| edges.all(|e| outline.contains(&e)))
    })
}

fn derive(pattern: u8) -> CellCase {
    let mut case = CellCase::default();
    for outline in loops(pattern, None) {
        case.loops += 1;
        case.crossed |= outline.iter().fold(0, |bits, e| bits | 1 << e);
        let split = triangulate(&outline, 0, outline.len() - 1);
        case.triangles.extend(split.unwrap_or_default());
    }
    link(&mut case);
    case
}

/// Triangles of the corners `first..=last` of a loop, without a diagonal in a cell face; `None` if there is no such
/// way.
fn triangulate(outline: &[Edge], first: usize, last: usize) -> Option<Vec<[Edge; 3]>> {
    if last - first < 2 {
        return Some(Vec::new());
    }
    let allowed = |i: usize, k: usize| k - i == 1 || common_face(outline[i], outline[k]).is_none();
    // From the middle outwards: fewer thin fans.
    let middle = (first + last) / 2;
    let mut apexes: Vec<usize> = (first + 1..last).collect();
    apexes.sort_by_key(|k| k.abs_diff(middle));
    apexes.into_iter().filter(|&k| allowed(first, k) && allowed(k, last)).find_map(|k| {
        let mut triangles = triangulate(outline, first, k)?;
        triangles.push([outline[first], outline[k], outline[last]]);
        triangles.extend(triangulate(outline, k, last)?);
        Some(triangles)
    })
}

/// Finds out which triangle edges are segments and which are diagonals.
fn link(case: &mut CellCase) {
    let sides: Vec<([Edge; 2], u8)> = case
        .triangles
        .iter()
        .enumerate()
        .flat_map(|(t, &[a, b, c])| [([a, b], t as u8), ([b, c], t as u8), ([c, a], t as u8)])
        .collect();
    for &(ends, triangle) in &sides {
        let [from, to] = ends;
        match sides.iter().find(|other| other.0 == [to, from]) {
            // Each diagonal is seen from both sides: listed once.
            Some(other) if triangle < other.1 => case.diagonals.push((ends, [triangle, other.1])),
            Some(_) => {}
            None => case.segments.extend(common_face(from, to).map(|face| Segment { face, ends, triangle })),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pattern_is_covered_once_and_closes_with_its_neighbours() {
        for pattern in 0..=255u8 {
            let case = cell_case(pattern);
            let crossed = (0..12u8).filter(|&e| {
                let (axis, corner) = EDGES[usize::from(e)];
                (pattern >> corner ^ pattern >> (corner | step(axis))) & 1 == 1
            });
            assert_eq!(case.crossed, crossed.fold(0, |bits, e| bits | 1 << e), "{pattern:08b}");
            // A loop of n corners has n − 2 triangles, n segments, n − 3 diagonals, none of them in a face.
            let corners = case.crossed.count_ones() as usize;
            let loops = case.loops as usize;
            assert_eq!(case.triangles.len(), corners - 2 * loops, "{pattern:08b}");
            assert!(case.triangles.len() <= MAX_TRIANGLES, "{pattern:08b}");
            assert_eq!(case.segments.len(), corners, "{pattern:08b}");
            assert_eq!(case.diagonals.len(), corners - 3 * loops, "{pattern:08b}");
            for ([a, b], _) in &case.diagonals {
                assert_eq!(common_face(*a, *b), None, "{pattern:08b}");
            }
        }
    }

    #[test]
    fn both_sides_of_a_face_agree() {
        // All pairs of cells that share a face, by the signs of that face's corners: the lower cell's upper face.
        for axis in 0..3 {
            let on_upper = |c: u8| c & step(axis) != 0;
            for below in 0..=255u8 {
                for above in 0..=255u8 {
                    let shared =
                        (0..8).filter(|&c| on_upper(c)).all(|c| below >> c & 1 == above >> (c ^ step(axis)) & 1);
                    if !shared {
                        continue;
                    }
                    let face = axis as u8 * 2 + 1;
                    let ends = |pattern, face| {
                        let mut ends: Vec<_> =
                            cell_case(pattern).segments.iter().filter(|s| s.face == face).map(|s| s.ends).collect();
                        ends.sort_unstable();
                        ends
                    };
                    let mut reversed: Vec<_> = ends(below, face)
                        .into_iter()
                        .map(|[from, to]| [across(to, axis), across(from, axis)])
                        .collect();
                    reversed.sort_unstable();
                    assert_eq!(reversed, ends(above, face - 1), "{axis} {below:08b} {above:08b}");
                }
            }
        }
    }

    #[test]
    fn a_single_inside_corner_is_seen_from_outside() {
        let [triangle] = cell_case(1).triangles[..] else { panic!("one triangle") };
        // Edges x, y, z at the origin: that order is counter-clockwise seen from (1, 1, 1).
        let at = triangle.iter().position(|e| *e == 0).unwrap();
        assert_eq!([triangle[at], triangle[(at + 1) % 3], triangle[(at + 2) % 3]], [0, 4, 8]);
    }
}
