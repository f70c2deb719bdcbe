//! Which triangles of a mesh pass through each other.

use glam::DVec3;
use rayon::prelude::*;

use crate::mesh::Bvh;

/// Triangles nearer than this (voxels) touch: rounding must not hide that two coincide.
const TOUCH: f64 = 1e-3;

/// The triangles of an indexed mesh that cross, overlap or touch each other otherwise than at the vertices that they share.
/// Neighbours over an edge are not looked at.
pub(super) struct Intersections<'a> {
    /// Holds the triangles in their order.
    pub bvh: &'a Bvh,
    pub positions: &'a [DVec3],
    pub triangles: &'a [[u32; 3]],
}

impl Intersections<'_> {
    /// Marks the triangles that another one crosses, of those with a mark in `asked`.
    pub fn marks(&self, asked: &[bool]) -> Vec<bool> {
        (0..self.triangles.len() as u32)
            .into_par_iter()
            .with_min_len(256)
            .map(|t| asked[t as usize] && self.near(self.corners(t), |other| self.cross(t, other)))
            .collect()
    }

    /// Whether one that crosses triangle `t` touches this part of it.
    pub fn touch_part(&self, t: u32, part: [DVec3; 3]) -> bool {
        self.near(part, |other| touch(part, self.corners(other)) && self.cross(t, other))
    }

    fn corners(&self, t: u32) -> [DVec3; 3] {
        self.triangles[t as usize].map(|v| self.positions[v as usize])
    }

    /// Whether `f` holds for a triangle whose box is near that of another.
    fn near(&self, [a, b, c]: [DVec3; 3], f: impl Fn(u32) -> bool) -> bool {
        self.bvh.any_in_box(a.min(b).min(c) - TOUCH, a.max(b).max(c) + TOUCH, f)
    }

    fn cross(&self, t: u32, other: u32) -> bool {
        if other == t {
            return false;
        }
        let (own, others) = (&self.triangles[t as usize], &self.triangles[other as usize]);
        match own.iter().filter(|v| others.contains(v)).count() {
            0 => touch(self.corners(t), self.corners(other)),
            1 => {
                // Beyond the vertex they meet if and only if the edge opposite to it of one meets the other.
                let far_edge = |a: &[u32; 3], b: &[u32; 3]| {
                    let mut rest = a.iter().filter(|v| !b.contains(v)).map(|&v| self.positions[v as usize]);
                    Some([rest.next()?, rest.next()?])
                };
                let (Some(own_far), Some(other_far)) = (far_edge(own, others), far_edge(others, own)) else {
                    return false;
                };
                let meets = |[a, b]: [DVec3; 2], triangle| touch([a, b, b], triangle);
                !bisected(self.corners(t), own_far, other_far)
                    && (meets(own_far, self.corners(other)) || meets(other_far, self.corners(t)))
            }
            _ => false,
        }
    }
}

/// Whether the plane through the vertex that two triangles share, square to the difference of the directions in which they
/// lie, has their other vertices well on either side. It has, for most neighbours on a surface.
fn bisected(own: [DVec3; 3], own_far: [DVec3; 2], other_far: [DVec3; 2]) -> bool {
    let shared = own[0] + own[1] + own[2] - own_far[0] - own_far[1];
    let direction = |far: [DVec3; 2]| (far[0] + far[1] - 2.0 * shared).normalize_or_zero();
    let axis = direction(own_far) - direction(other_far);
    let margin = TOUCH * axis.length();
    own_far.iter().all(|p| axis.dot(*p - shared) > margin) && other_far.iter().all(|p| axis.dot(*p - shared) < -margin)
}

/// Whether two triangles, which may be segments, come within [`TOUCH`] of each other: no axis separates them, neither a
/// normal, nor a common perpendicular of two edges, nor an edge's perpendicular within its triangle's plane.
fn touch(a: [DVec3; 3], b: [DVec3; 3]) -> bool {
    let edges = |t: [DVec3; 3]| [t[1] - t[0], t[2] - t[1], t[0] - t[2]];
    let (ea, eb) = (edges(a), edges(b));
    let (na, nb) = (ea[0].cross(ea[1]), eb[0].cross(eb[1]));
    let separates = |axis: DVec3| {
        let range = |t: [DVec3; 3]| {
            let (x, y, z) = (axis.dot(t[0] - a[0]), axis.dot(t[1] - a[0]), axis.dot(t[2] - a[0]));
            (x.min(y).min(z), x.max(y).max(z))
        };
        let ((a_lo, a_hi), (b_lo, b_hi)) = (range(a), range(b));
        // In lengths of the axis. Most gaps are none, and need no root.
        let gap = (b_lo - a_hi).max(a_lo - b_hi);
        gap > 0.0 && gap > TOUCH * axis.length()
    };
    let in_plane = ea.iter().map(|e| na.cross(*e)).chain(eb.iter().map(|e| nb.cross(*e)));
    let across = ea.iter().flat_map(|x| eb.iter().map(|y| x.cross(*y)));
    ![na, nb].into_iter().chain(in_plane).chain(across).any(separates)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::TriangleMesh;
    use crate::mesh::testing::*;

    fn count(mesh: &TriangleMesh) -> usize {
        let bvh = Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
        let asked = vec![true; mesh.triangles.len()];
        let all = Intersections { bvh: &bvh, positions: &mesh.positions, triangles: &mesh.triangles };
        all.marks(&asked).iter().filter(|&&i| i).count()
    }

    #[test]
    fn neighbours_on_a_surface_do_not_intersect() {
        assert_eq!(count(&sphere(DVec3::ZERO, 50.0, 20)), 0);
        assert_eq!(count(&cube(DVec3::ZERO, 50.0)), 0);
    }

    #[test]
    fn crossing_touching_and_coincident_triangles_do() {
        let a = cube(DVec3::ZERO, 10.0);
        assert!(count(&joined(a.clone(), &cube(DVec3::splat(5.0), 10.0))) >= 12);
        assert_eq!(count(&joined(a.clone(), &cube(DVec3::splat(2.0), 5.0))), 0, "within, not crossing");
        // Two face to face: the two triangles of each of the faces, and the edges of the faces around.
        assert!(count(&joined(a.clone(), &cube(DVec3::X * 10.0, 10.0))) >= 4);
        assert_eq!(count(&joined(a, &cube(DVec3::X * 10.1, 10.0))), 0);
    }

    #[test]
    fn fans_that_fold_through_themselves_do() {
        // Two triangles that share a vertex; the far edge of one passes through the other.
        let positions =
            vec![DVec3::ZERO, DVec3::X * 4.0, DVec3::Y * 4.0, DVec3::new(2.0, 1.0, -1.0), DVec3::new(1.0, 2.0, 1.0)];
        let mesh = TriangleMesh { positions, triangles: vec![[0, 1, 2], [0, 3, 4]], ..TriangleMesh::default() };
        assert_eq!(count(&mesh), 2);
        let mut apart = mesh;
        apart.positions[3].z = 1.0;
        assert_eq!(count(&apart), 0);
    }
}
