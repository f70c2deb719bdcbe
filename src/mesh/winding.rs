//! The generalised winding number of a triangle mesh (Jacobson et al. 2013), fast by far-field expansion
//! (Barill, Dickson, Schmidt, Levin and Jacobson 2018, "Fast Winding Numbers for Soups and Clouds").
//!
//! w(p) = 1/4π Σ Ω_t(p), the sum of the solid angles that the triangles subtend at p: 1 inside a closed surface that faces
//! outwards, 0 outside, in between for open ones, where the surface w = ½ closes the holes smoothly. Nearby
//! triangles are summed exactly; a group of triangles seen from farther than β times its radius is replaced by its
//! dipole and the first-order term (eq. 10 and 11 there), both exact integrals over the triangles:
//! Ω ≈ N·r/|r|³ + tr M/|r|³ − 3 rᵀMr/|r|⁵ with r from p to the centre c, N = Σ a n and M = Σ a n (x − c)ᵀ.
//!
//! At a point on a triangle, that triangle's own solid angle is 0: w is the mean of the two sides.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};

use super::bvh::{Bvh, Children};

/// Signed solid angle of a triangle seen from `p`, positive when `p` is on the inner side (van Oosterom and Strackee 1983).
/// In the triangle's plane it is 0.
pub(crate) fn solid_angle(p: DVec3, corners: [DVec3; 3]) -> f64 {
    let [a, b, c] = corners.map(|corner| corner - p);
    let (la, lb, lc) = (a.length(), b.length(), c.length());
    let numerator = a.dot(b.cross(c));
    let denominator = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
    // In the plane the sign of a zero would choose between 2π and −2π.
    if numerator == 0.0 { 0.0 } else { 2.0 * numerator.atan2(denominator) }
}

/// How many radii away a group of triangles must be to be seen as a whole. 2 is the value of Barill et al.; the test
/// below holds the error under 0.02 with it.
const DEFAULT_BETA: f64 = 2.0;

/// What a group of triangles looks like from afar.
#[derive(Clone, Copy, Debug, Default)]
struct Moments {
    /// Area-weighted centre.
    center: DVec3,
    /// Square of the distance from which the expansion serves, (β · radius)².
    reach_squared: f64,
    /// Σ a n.
    dipole: DVec3,
    /// Σ a n (x − c)ᵀ; only its symmetric part matters.
    gradient: DMat3,
}

/// The winding number of the triangles of a [`Bvh`].
pub struct WindingNumber<'a> {
    bvh: &'a Bvh,
    moments: Vec<Moments>,
}

impl<'a> WindingNumber<'a> {
    /// Sums the moments of all groups of triangles.
    pub fn new(bvh: &'a Bvh) -> Self {
        Self::with_beta(bvh, DEFAULT_BETA)
    }

    /// The same with another accuracy: greater `beta` is more exact and slower.
    pub fn with_beta(bvh: &'a Bvh, beta: f64) -> Self {
        let mut moments = vec![Moments::default(); bvh.node_count()];
        let mut areas = vec![0.0; bvh.node_count()];
        // Children lie behind their parents, so backwards is bottom-up.
        for node in (0..bvh.node_count()).rev() {
            let mut m = Moments::default();
            let (lo, hi) = bvh.node_box(node);
            let triangles = match bvh.children(node) {
                Children::Nodes(pair) => {
                    let total = areas[pair[0]] + areas[pair[1]];
                    areas[node] = total;
                    let weighted = moments[pair[0]].center * areas[pair[0]] + moments[pair[1]].center * areas[pair[1]];
                    m.center = if total > 0.0 { weighted / total } else { (lo + hi) * 0.5 };
                    for child in pair.map(|i| moments[i]) {
                        m.dipole += child.dipole;
                        m.gradient += child.gradient + outer(child.dipole, child.center - m.center);
                    }
                    &[][..]
                }
                Children::Triangles(list) => list,
            };
            if !triangles.is_empty() {
                let parts = triangles.iter().map(|[a, b, c]| ((*b - *a).cross(*c - *a) * 0.5, (*a + *b + *c) / 3.0));
                let total: f64 = parts.clone().map(|(n, _)| n.length()).sum();
                areas[node] = total;
                let weighted: DVec3 = parts.clone().map(|(n, c)| c * n.length()).sum();
                m.center = if total > 0.0 { weighted / total } else { (lo + hi) * 0.5 };
                for (n, c) in parts {
                    m.dipole += n;
                    m.gradient += outer(n, c - m.center);
                }
            }
            let radius_squared = (hi - m.center).max(m.center - lo).length_squared();
            m.reach_squared = beta * beta * radius_squared;
            moments[node] = m;
        }
        Self { bvh, moments }
    }

    /// The winding number at `p`.
    pub fn at(&self, p: DVec3) -> f64 {
        let mut stack = smallvec::SmallVec::<[usize; 64]>::new();
        if !self.moments.is_empty() {
            stack.push(0);
        }
        let mut sum = 0.0;
        while let Some(node) = stack.pop() {
            let m = &self.moments[node];
            let r = m.center - p;
            let r2 = r.length_squared();
            if r2 > m.reach_squared {
                let inverse = 1.0 / r2.sqrt();
                let inverse3 = inverse * inverse * inverse;
                let trace = m.gradient.x_axis.x + m.gradient.y_axis.y + m.gradient.z_axis.z;
                sum += inverse3 * (m.dipole.dot(r) + trace - 3.0 * r.dot(m.gradient * r) / r2);
                continue;
            }
            match self.bvh.children(node) {
                Children::Nodes(pair) => stack.extend(pair),
                Children::Triangles(list) => sum += list.iter().map(|&t| solid_angle(p, t)).sum::<f64>(),
            }
        }
        sum / (4.0 * PI)
    }
}

/// a bᵀ.
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::testing::*;

    fn exact(p: DVec3, triangles: &[[DVec3; 3]]) -> f64 {
        triangles.iter().map(|&t| solid_angle(p, t)).sum::<f64>() / (4.0 * PI)
    }

    fn corners(mesh: &crate::mesh::TriangleMesh) -> Vec<[DVec3; 3]> {
        (0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect()
    }

    #[test]
    fn a_corner_of_a_cube_sees_an_octant() {
        let triangles = corners(&cube(DVec3::ZERO, 2.0));
        assert!((exact(DVec3::ONE, &triangles) - 1.0).abs() < 1e-14);
        assert!(exact(DVec3::new(2.5, 1.0, 1.0), &triangles).abs() < 1e-14);
        assert!(
            (exact(DVec3::new(1.2, 0.7, 2.0), &triangles) - 0.5).abs() < 1e-14,
            "on a face: the mean of both sides"
        );
        let face = [[DVec3::X, DVec3::Y, DVec3::Z]];
        assert!((exact(DVec3::ZERO, &face) - 0.125).abs() < 1e-14);
    }

    #[test]
    fn the_expansion_agrees_with_the_sum_on_real_models() {
        for file in [
            "nasty/bun_zipper_res2.ply",
            "meshes/teapot_utah.obj",
            "meshes/scorpion_12k.obj",
            "nasty/triangle_soup.stl",
        ] {
            let Some(mesh) = shared_mesh(file) else { return };
            let triangles = corners(&mesh);
            let (lo, hi) = mesh.bounding_box().unwrap();
            let bvh = Bvh::new(triangles.clone());
            let winding = WindingNumber::new(&bvh);
            let mut worst = 0.0f64;
            let n = 400;
            for i in 0..n {
                // Half of the points in the box, half beside a triangle.
                let mut p = lo - 0.1 * (hi - lo)
                    + 1.2 * (hi - lo) * DVec3::new(noise(3 * i), noise(3 * i + 1), noise(3 * i + 2));
                if i % 2 == 0 {
                    let [a, b, c] = triangles[i * 37 % triangles.len()];
                    p = (a + b + c) / 3.0
                        + 0.02
                            * (hi - lo).length()
                            * (DVec3::new(noise(5 * i), noise(5 * i + 1), noise(5 * i + 2)) - 0.5);
                }
                worst = worst.max((winding.at(p) - exact(p, &triangles)).abs());
            }
            println!("{file}: largest error {worst:.5}");
            assert!(worst < 0.02, "{file}: {worst}");
        }
    }
}
