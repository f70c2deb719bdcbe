//! Polygons of mesh files to triangles.
//!
//! Ear clipping (Meisters 1975) in the plane of the polygon's area vector (Newell). A polygon of n corners always gives
//! n − 2 triangles that use each of its edges once and each diagonal twice, also where corners lie on one line: dropping
//! those, as faster triangulators do, would open a crack towards the neighbouring face. Bridges to holes (two corners at
//! one place) are allowed. A polygon without area or one that crosses itself still gives n − 2 triangles, and that is said.

use glam::{DVec2, DVec3};

/// Point-in-triangle tests for one polygon before the remaining ears are taken untested (a few seconds of work):
/// ear clipping is cubic at worst, and a file must not be able to hang the program.
const MAX_TESTS: u64 = 1 << 30;

/// How far the area of the triangles may be from that of the polygon, as a fraction, before it counts as crossed.
const AREA_TOLERANCE: f64 = 1e-6;

/// What [`triangulate`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outline {
    /// The triangles cover the polygon exactly once.
    Simple,
    /// The polygon crosses itself, has no area, or is too intricate to tell: its triangles may overlap.
    Crossed,
}

/// Appends the triangles of the polygon `corners` (at least 3, no two in a row equal, all valid indices).
pub(super) fn triangulate(positions: &[DVec3], corners: &[u32], triangles: &mut Vec<[u32; 3]>) -> Outline {
    if let &[a, b, c] = corners {
        triangles.push([a, b, c]);
        return Outline::Simple;
    }
    let mut outline = Outline::Crossed;
    if let Some(points) = flatten(positions, corners) {
        let first = triangles.len();
        let mut area = 0.0;
        let clean = clip(&points, |ear| {
            area += cross(points[ear[0]], points[ear[1]], points[ear[2]]).abs();
            triangles.push(ear.map(|i| corners[i]));
        });
        let exact = polygon_area(&points);
        if clean && (area - exact).abs() <= AREA_TOLERANCE * exact {
            outline = Outline::Simple;
        }
        debug_assert_eq!(triangles.len() - first, corners.len() - 2);
    } else {
        triangles.extend((1..corners.len() - 1).map(|i| [corners[0], corners[i], corners[i + 1]]));
    }
    outline
}

/// The corners of one turn where a polygon runs around the same loop several times, else all.
pub(super) fn one_turn(corners: &[u32]) -> &[u32] {
    let n = corners.len();
    (3..=n / 2)
        .filter(|period| n.is_multiple_of(*period))
        .find(|&period| corners[period..] == corners[..n - period])
        .map_or(corners, |period| &corners[..period])
}

/// The corners in the plane of the polygon, counter-clockwise, scaled to about 1; `None` without a plane.
fn flatten(positions: &[DVec3], corners: &[u32]) -> Option<Vec<DVec2>> {
    // Relative to a corner and scaled: large coordinates far from the origin neither cancel nor overflow.
    let origin = positions[corners[0] as usize];
    let offsets: Vec<_> = corners.iter().map(|&v| positions[v as usize] - origin).collect();
    let size = offsets.iter().map(|o| o.abs().max_element()).fold(0.0, f64::max);
    if !(size > 0.0 && size.is_finite()) {
        return None;
    }
    let offsets: Vec<_> = offsets.into_iter().map(|o| o / size).collect();
    let normal = offsets.windows(2).map(|pair| pair[0].cross(pair[1])).sum::<DVec3>().try_normalize()?;
    let (u, v) = normal.any_orthonormal_pair();
    Some(offsets.into_iter().map(|o| DVec2::new(o.dot(u), o.dot(v))).collect())
}

/// Twice the signed area of a triangle.
fn cross(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

/// Twice the signed area of a polygon whose first corner is the origin.
fn polygon_area(points: &[DVec2]) -> f64 {
    points.windows(2).map(|pair| pair[0].perp_dot(pair[1])).sum()
}

/// How picky the search for the next ear is. Slivers are left for last: by then their neighbours have often made them fat.
#[derive(Clone, Copy, PartialEq, PartialOrd)]
enum Accept {
    /// The sine of the angle at the tip is at least 0.05.
    Fat,
    /// Any ear with area.
    Thin,
    /// An ear whose tip lies on a line with its neighbours.
    Flat,
    /// Anything: the polygon is not simple.
    Any,
}

/// Clips ears until a triangle is left; `false` if some had to be taken that are no ears.
fn clip(points: &[DVec2], mut emit: impl FnMut([usize; 3])) -> bool {
    let n = points.len();
    let mut previous: Vec<usize> = (0..n).map(|i| (i + n - 1) % n).collect();
    let mut next: Vec<usize> = (0..n).map(|i| (i + 1) % n).collect();
    // From corner 1: a convex quad a b c d becomes abc, cda.
    let (mut tip, mut left, mut misses) = (1, n, 0);
    let (mut accept, mut clean, mut tests) = (Accept::Fat, true, 0);
    while left > 3 {
        let (a, c) = (previous[tip], next[tip]);
        let shaped = accept == Accept::Any || is_convex([points[a], points[tip], points[c]], accept);
        if shaped && (accept == Accept::Any || is_empty(points, &next, [a, tip, c], &mut tests)) {
            clean &= accept != Accept::Any;
            emit([a, tip, c]);
            (next[a], previous[c]) = (c, a);
            left -= 1;
            // Going on behind the neighbour gives rounder triangles than a fan around `a`.
            tip = next[c];
            misses = 0;
            accept = if tests > MAX_TESTS { Accept::Any } else { Accept::Fat };
        } else {
            tip = c;
            misses += 1;
            if misses == left {
                misses = 0;
                accept = match accept {
                    Accept::Fat => Accept::Thin,
                    Accept::Thin => Accept::Flat,
                    Accept::Flat | Accept::Any => Accept::Any,
                };
            }
            if tests > MAX_TESTS {
                accept = Accept::Any;
            }
        }
    }
    emit([previous[tip], tip, next[tip]]);
    clean
}

fn is_convex([a, tip, c]: [DVec2; 3], accept: Accept) -> bool {
    /// Rounding of a sine computed from coordinates of size 1.
    const ROUNDING: f64 = 1e-12;
    let sine = (tip - a).perp_dot(c - tip);
    let lengths = (tip - a).length() * (c - tip).length();
    match accept {
        Accept::Fat => sine > 0.05 * lengths,
        Accept::Thin => sine > ROUNDING * lengths,
        Accept::Flat | Accept::Any => sine >= -ROUNDING * lengths,
    }
}

/// Whether no other corner lies in the closed triangle; corners at the places of its own corners (bridges) do not count.
fn is_empty(points: &[DVec2], next: &[usize], ear: [usize; 3], tests: &mut u64) -> bool {
    let [a, tip, c] = ear.map(|i| points[i]);
    let mut i = next[ear[2]];
    while i != ear[0] {
        *tests += 1;
        let p = points[i];
        let inside = cross(a, tip, p) >= 0.0 && cross(tip, c, p) >= 0.0 && cross(c, a, p) >= 0.0;
        if inside && p != a && p != tip && p != c {
            return false;
        }
        i = next[i];
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashMap;

    fn ring(points: &[[f64; 2]]) -> Vec<DVec3> {
        points.iter().map(|p| DVec3::new(3.0 + p[0], 0.5 * p[0] - p[1], 1.0 + p[1])).collect()
    }

    /// Triangulates the ring and checks the promise: n − 2 triangles, outline edges once, diagonals once each way.
    fn check(positions: &[DVec3], corners: &[u32]) -> (Vec<[u32; 3]>, Outline) {
        let mut triangles = Vec::new();
        let outline = triangulate(positions, corners, &mut triangles);
        assert_eq!(triangles.len(), corners.len() - 2);
        let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
        for t in &triangles {
            for i in 0..3 {
                *edges.entry((t[i], t[(i + 1) % 3])).or_default() += 1;
                *edges.entry((t[(i + 1) % 3], t[i])).or_default() -= 1;
            }
        }
        for i in 0..corners.len() {
            let (a, b) = (corners[i], corners[(i + 1) % corners.len()]);
            *edges.entry((a, b)).or_default() -= 1;
            *edges.entry((b, a)).or_default() += 1;
        }
        assert!(edges.values().all(|&balance| balance == 0));
        (triangles, outline)
    }

    fn area(positions: &[DVec3], triangles: &[[u32; 3]]) -> f64 {
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            (b - a).cross(c - a).length() / 2.0
        };
        triangles.iter().map(area).sum()
    }

    #[test]
    fn a_reflex_quad_is_split_at_its_reflex_corner() {
        for shift in 0..4 {
            let mut points = vec![[0.0, 0.0], [2.0, 0.0], [0.5, 0.5], [0.0, 2.0]];
            points.rotate_left(shift);
            let positions = ring(&points);
            let (triangles, outline) = check(&positions, &[0, 1, 2, 3]);
            let reflex = (6 - shift as u32) % 4;
            assert_eq!(outline, Outline::Simple);
            assert!(triangles.iter().all(|t| t.contains(&reflex)), "{triangles:?}");
        }
    }

    #[test]
    fn corners_on_one_line_keep_their_edges() {
        let mut points = Vec::new();
        for i in 0..4 {
            points.push([f64::from(i), 0.0]);
        }
        points.extend([[4.0, 0.0], [4.0, 1.0], [2.0, 1.0], [0.0, 1.0]]);
        let positions = ring(&points);
        let (triangles, outline) = check(&positions, &[0, 1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(outline, Outline::Simple);
        assert!(triangles.iter().all(|t| area(&positions, &[*t]) > 0.1), "no slivers: {triangles:?}");
    }

    #[test]
    fn a_bridge_to_a_hole_is_followed() {
        // A square of side 3 with a hole of side 1: the bridge 0–4 is walked twice.
        let points = [[0., 0.], [3., 0.], [3., 3.], [0., 3.], [1., 1.], [1., 2.], [2., 2.], [2., 1.]];
        let positions = ring(&points);
        let (triangles, outline) = check(&positions, &[0, 1, 2, 3, 0, 4, 5, 6, 7, 4]);
        assert_eq!(outline, Outline::Simple);
        let unit = area(&positions, &[[0, 1, 2], [0, 2, 3]]) / 9.0;
        assert!((area(&positions, &triangles) - 8.0 * unit).abs() < 1e-12);
    }

    #[test]
    fn crossed_and_flat_polygons_are_said_to_be_so() {
        let bow = ring(&[[0., 0.], [2., 2.], [2., 0.], [0., 3.]]);
        assert_eq!(check(&bow, &[0, 1, 2, 3]).1, Outline::Crossed);
        let line = ring(&[[0., 0.], [1., 1.], [2., 2.], [3., 3.], [4., 4.]]);
        assert_eq!(check(&line, &[0, 1, 2, 3, 4]).1, Outline::Crossed);
        let huge = [DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y].map(|p| p * f64::MAX);
        assert_eq!(check(&huge, &[0, 1, 2, 3]).1, Outline::Crossed);
    }

    #[test]
    fn huge_and_far_polygons_are_ordinary() {
        for (scale, offset) in [(3e38, 0.0), (1e-3, 1e6)] {
            let points = ring(&[[0., 0.], [2., 0.], [2., 2.], [1., 0.5], [0., 2.]]);
            let positions: Vec<_> = points.iter().map(|p| *p * scale + offset).collect();
            assert_eq!(check(&positions, &[0, 1, 2, 3, 4]).1, Outline::Simple);
        }
    }

    #[test]
    fn repeated_turns_are_taken_once() {
        assert_eq!(one_turn(&[1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, 4]), [1, 2, 3, 4]);
        assert_eq!(one_turn(&[1, 2, 3, 1, 2, 4]), [1, 2, 3, 1, 2, 4]);
        assert_eq!(one_turn(&[1, 2, 3]), [1, 2, 3]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// Star-shaped outlines are simple whatever their radii.
        #[test]
        fn star_shaped_polygons_are_covered_exactly(radii in prop::collection::vec(0.05..1.0f64, 3..60)) {
            let n = radii.len();
            let points: Vec<_> = radii.iter().enumerate().map(|(i, r)| {
                let angle = i as f64 / n as f64 * std::f64::consts::TAU;
                [r * angle.cos(), r * angle.sin()]
            }).collect();
            let positions = ring(&points);
            let corners: Vec<u32> = (0..n as u32).collect();
            let (triangles, outline) = check(&positions, &corners);
            prop_assert_eq!(outline, Outline::Simple);
            let exact: f64 = (0..n).map(|i| DVec2::from(points[i]).perp_dot(DVec2::from(points[(i + 1) % n]))).sum();
            let plane = DVec3::new(1.0, 0.5, 0.0).cross(DVec3::new(0.0, -1.0, 1.0)).length();
            prop_assert!((area(&positions, &triangles) - exact / 2.0 * plane).abs() < 1e-9);
        }

        /// Random corners cross themselves in every way: the promise of n − 2 triangles still holds.
        #[test]
        fn any_outline_gives_n_minus_two_triangles(points in prop::collection::vec([0..4, 0..4], 4..30)) {
            let positions = ring(&points.iter().map(|p| p.map(f64::from)).collect::<Vec<_>>());
            let corners: Vec<u32> = (0..positions.len() as u32).collect();
            check(&positions, &corners);
        }
    }
}
