//! Nearest points on segments, triangles and boxes.

use glam::DVec3;

/// The nearest point to `p` on the segment from `a` to `b`, which may be a point.
pub(crate) fn closest_on_segment(p: DVec3, a: DVec3, b: DVec3) -> DVec3 {
    let ab = b - a;
    let length_squared = ab.length_squared();
    if length_squared == 0.0 {
        return a;
    }
    let t = ((p - a).dot(ab) / length_squared).clamp(0.0, 1.0);
    // From the nearer end, so that the far end is met exactly.
    if t <= 0.5 { a + ab * t } else { b - ab * (1.0 - t) }
}

/// The nearest point to `p` on a triangle, which may be a segment or a point.
///
/// The foot of the perpendicular where it falls into the triangle, else the nearest point of the three edges. Slower than
/// walking the Voronoi regions (Ericson 2005, 5.1.5) by two segments, but no division by the area decides between
/// them, so that a sliver costs nothing but digits of its own plane.
pub(crate) fn closest_on_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let edges = [closest_on_segment(p, a, b), closest_on_segment(p, b, c), closest_on_segment(p, c, a)];
    let mut best = edges[0];
    for candidate in &edges[1..] {
        if candidate.distance_squared(p) < best.distance_squared(p) {
            best = *candidate;
        }
    }
    let normal = (b - a).cross(c - a);
    let area_squared = normal.length_squared();
    let inside = |from: DVec3, to: DVec3| normal.dot((to - from).cross(p - from)) > 0.0;
    if area_squared > 0.0 && inside(a, b) && inside(b, c) && inside(c, a) {
        let foot = p - normal * (normal.dot(p - a) / area_squared);
        if foot.distance_squared(p) < best.distance_squared(p) {
            best = foot;
        }
    }
    best
}

/// Square of the distance from `p` to a box, 0 within.
#[inline]
pub(crate) fn distance_squared_to_box(p: DVec3, lo: DVec3, hi: DVec3) -> f64 {
    (lo - p).max(p - hi).max(DVec3::ZERO).length_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn point() -> impl Strategy<Value = DVec3> {
        prop::array::uniform3(-4.0f64..4.0).prop_map(DVec3::from_array)
    }

    proptest! {
        /// The nearest point of a convex set is the one from which no point of the set lies ahead towards `p`.
        #[test]
        fn the_nearest_point_is_optimal(p in point(), a in point(), b in point(), mix in 0.0f64..1.0, thin in 0i32..8) {
            // From a fair triangle to a sliver of height 1e-14, and to a segment.
            let off = if thin == 7 { DVec3::ZERO } else { DVec3::new(0.3, -0.8, 0.5) * 100f64.powi(-thin) };
            let c = a + (b - a) * mix + off;
            let q = closest_on_triangle(p, [a, b, c]);
            for corner in [a, b, c] {
                prop_assert!((p - q).dot(corner - q) <= 1e-9, "{} ahead by {}", corner, (p - q).dot(corner - q));
            }
        }

        #[test]
        fn points_of_the_triangle_are_their_own_nearest(a in point(), b in point(), c in point(), u in 0.0f64..1.0, v in 0.0f64..1.0) {
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let inside = a + (b - a) * u + (c - a) * v;
            prop_assert!(closest_on_triangle(inside, [a, b, c]).distance(inside) < 1e-12);
            let on_edge = a + (b - a) * u;
            prop_assert!(closest_on_triangle(on_edge, [a, b, c]).distance(on_edge) < 1e-12);
            prop_assert_eq!(closest_on_triangle(b, [a, b, c]), b);
        }
    }

    #[test]
    fn the_corners_of_a_box_are_outside_by_their_diagonal() {
        assert_eq!(distance_squared_to_box(DVec3::splat(2.0), DVec3::ZERO, DVec3::ONE), 3.0);
        assert_eq!(distance_squared_to_box(DVec3::splat(0.3), DVec3::ZERO, DVec3::ONE), 0.0);
    }
}
