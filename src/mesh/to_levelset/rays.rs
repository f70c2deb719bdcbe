//! Integer winding numbers of closed surfaces: how often a ray leaves the surface more than it enters it.
//!
//! Rays run along z. Seen from there a triangle holds a point if the point is on the same side of its three edges; neighbours decide on
//! which side of their common edge it is by the same arithmetic, so that a ray through an edge or a vertex passes through one of
//! the triangles around it, whichever that is.

use glam::DVec3;

use crate::mesh::Bvh;
use crate::mesh::bvh::Children;

/// The triangles above `p`, those that face upwards less those that face downwards: the winding number if the surface is closed.
pub(super) fn crossings_above(bvh: &Bvh, p: DVec3) -> i32 {
    let mut sum = 0;
    let mut stack = smallvec::SmallVec::<[usize; 64]>::new();
    if bvh.node_count() > 0 {
        stack.push(0);
    }
    while let Some(node) = stack.pop() {
        let (lo, hi) = bvh.node_box(node);
        if p.x < lo.x || p.x > hi.x || p.y < lo.y || p.y > hi.y || p.z > hi.z {
            continue;
        }
        match bvh.children(node) {
            Children::Nodes(pair) => stack.extend(pair),
            Children::Triangles(list) => sum += list.iter().map(|triangle| crossing(triangle, p)).sum::<i32>(),
        }
    }
    sum
}

/// 1 or −1 if the triangle is above `p` and faces upwards or downwards, else 0.
fn crossing(&[a, b, c]: &[DVec3; 3], p: DVec3) -> i32 {
    let upwards = is_left(a, b, p);
    if is_left(b, c, p) != upwards || is_left(c, a, p) != upwards {
        return 0;
    }
    let in_front = (b - a).cross(c - a).dot(p - a) > 0.0;
    match (upwards, in_front) {
        (true, false) => 1,
        (false, true) => -1,
        _ => 0,
    }
}

/// Whether `p` is to the left of the line from `a` to `b`, seen from above: never so for the line from `b` to `a` as well.
fn is_left(a: DVec3, b: DVec3, p: DVec3) -> bool {
    let forward = (a.x, a.y) < (b.x, b.y);
    let (from, to) = if forward { (a, b) } else { (b, a) };
    let left = (to.x - from.x) * (p.y - from.y) - (to.y - from.y) * (p.x - from.x) >= 0.0;
    left == forward
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::testing::*;

    #[test]
    fn rays_through_edges_and_vertices_count_once() {
        // Rays from the middle of a cube and of an octahedron-like sphere run along edges and into vertices.
        for mesh in [cube(DVec3::splat(-4.0), 8.0), sphere(DVec3::ZERO, 4.0, 6)] {
            let bvh = Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
            for i in 0..13i32.pow(3) {
                let p = DVec3::new(f64::from(i % 13), f64::from(i / 13 % 13), f64::from(i / 169)) - 6.0;
                let Some(hit) = bvh.closest_point(p, 100.0) else { panic!("no triangle") };
                if hit.distance_squared > 1e-6 {
                    let winding = crate::mesh::WindingNumber::new(&bvh).at(p);
                    assert_eq!(f64::from(crossings_above(&bvh, p)), winding.round(), "{p}");
                }
            }
        }
    }

    #[test]
    fn parts_inside_of_each_other_add_up() {
        let mesh = joined(cube(DVec3::ZERO, 10.0), &cube(DVec3::splat(2.5), 5.0));
        let bvh = Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
        assert_eq!([-1.0, 1.0, 5.0, 8.0].map(|x| crossings_above(&bvh, DVec3::splat(x))), [0, 1, 2, 1]);
    }
}
