//! The generalised winding number of a triangle mesh (Jacobson et al. 2013), fast by far-field expansion
//! (Barill, Dickson, Schmidt, Levin and Jacobson 2018, "Fast Winding Numbers for Soups and Clouds").
//!
//! w(p) = 1/4π Σ Ω_t(p), the sum of the solid angles that the triangles subtend at p: 1 inside a closed surface that faces
//! outwards, 0 outside, in between for open ones, where the surface w = ½ closes the holes smoothly. Nearby
//! triangles are summed exactly; a group of triangles seen from farther than β times its radius is replaced by the
//! Taylor expansion of the solid angle to second order (eq. 10–12 there). With r from p to the group's centre c, δ = x − c, and
//! the moments N = ∫ n, M = ∫ n δᵀ, T = ∫ n⊗δ⊗δ (exact integrals over the triangles, only their symmetric parts matter):
//!
//! Ω ≈ N·r/|r|³ + tr M/|r|³ − 3 rᵀMr/|r|⁵ − 9/2 T_iik r_k/|r|⁵ + 15/2 T_ijk r_i r_j r_k/|r|⁷.
//!
//! At a point on a triangle, that triangle's own solid angle is 0: w is the mean of the two sides.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};

use super::bvh::{Bvh, Children};

/// Signed solid angle of a triangle seen from `p`, positive when `p` is on the inner side (van Oosterom and Strackee 1983).
/// In the triangle's plane it is 0.
pub(crate) fn solid_angle(p: DVec3, corners: [DVec3; 3]) -> f64 {
    let (re, im) = half_angle(p, corners);
    2.0 * im.atan2(re)
}

/// A complex number whose argument is half the solid angle.
#[inline]
fn half_angle(p: DVec3, corners: [DVec3; 3]) -> (f64, f64) {
    let [a, b, c] = corners.map(|corner| corner - p);
    let (la, lb, lc) = (a.length(), b.length(), c.length());
    let numerator = a.dot(b.cross(c));
    let denominator = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
    // In the plane the sign of a zero would choose between 2π and −2π.
    if numerator == 0.0 { (1.0, 0.0) } else { (denominator, numerator) }
}

/// Sum of the solid angles of a few triangles. Arguments add up where complex numbers multiply: one arctangent serves
/// several triangles, as long as all factors and products stay in the right half-plane, where nothing wraps around.
fn sum_of_solid_angles(p: DVec3, triangles: &[[DVec3; 3]]) -> f64 {
    let mut sum = 0.0;
    let (mut re, mut im) = (1.0, 0.0);
    for &triangle in triangles {
        let (x, y) = half_angle(p, triangle);
        let product = (re * x - im * y, re * y + im * x);
        if x <= 0.0 {
            sum += f64::atan2(y, x);
        } else if product.0 > 0.0 {
            (re, im) = product;
        } else {
            sum += f64::atan2(im, re);
            (re, im) = (x, y);
        }
    }
    2.0 * (sum + im.atan2(re))
}

/// How many radii away a group of triangles must be to be seen as a whole: the value of Barill et al. The test below
/// holds the error under 0.02 with it.
const BETA: f64 = 2.0;

/// What a group of triangles looks like from afar.
#[derive(Clone, Copy, Debug, Default)]
struct Moments {
    /// Area-weighted centre.
    center: DVec3,
    /// Square of the distance from which the expansion serves, (β · radius)².
    reach_squared: f64,
    /// ∫ n.
    dipole: DVec3,
    /// ∫ n δᵀ.
    first: DMat3,
    /// Symmetric part of ∫ n⊗δ⊗δ.
    second: Cubic,
}

impl Moments {
    /// Adds a bundle of oriented area `n` at `delta` from the centre.
    fn add(&mut self, n: DVec3, delta: DVec3) {
        self.dipole += n;
        self.first += outer(n, delta);
        self.second.add(n, delta, delta, 1.0);
    }

    /// Adds the moments of a child about its own centre, `shift` from this one.
    fn add_shifted(&mut self, child: &Self, shift: DVec3) {
        self.add(child.dipole, shift);
        self.first += child.first;
        let DMat3 { x_axis, y_axis, z_axis } = child.first;
        for (column, axis) in [(x_axis, DVec3::X), (y_axis, DVec3::Y), (z_axis, DVec3::Z)] {
            self.second.add(column, axis, shift, 2.0);
        }
        self.second.0.iter_mut().zip(child.second.0).for_each(|(a, b)| *a += b);
    }

    /// Sum of the solid angles seen from `r` before the centre, where |r|² = `r2`.
    fn solid_angle(&self, r: DVec3, r2: f64) -> f64 {
        let inverse2 = 1.0 / r2;
        let inverse3 = inverse2 * inverse2.sqrt();
        let trace = self.first.x_axis.x + self.first.y_axis.y + self.first.z_axis.z;
        let quadratic = r.dot(self.first * r);
        let (linear, cubic) = self.second.contract(r);
        inverse3 * (self.dipole.dot(r) + trace - inverse2 * (3.0 * quadratic + 4.5 * linear - 7.5 * inverse2 * cubic))
    }
}

/// A symmetric tensor of rank 3: xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz.
#[derive(Clone, Copy, Debug, Default)]
struct Cubic([f64; 10]);

impl Cubic {
    const INDICES: [[usize; 3]; 10] =
        [[0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 0, 1], [0, 0, 2], [0, 1, 1], [1, 1, 2], [0, 2, 2], [1, 2, 2], [0, 1, 2]];

    /// Adds `factor` times the symmetric part of a⊗b⊗c.
    fn add(&mut self, a: DVec3, b: DVec3, c: DVec3, factor: f64) {
        for (entry, [i, j, k]) in self.0.iter_mut().zip(Self::INDICES) {
            let permutations = [(i, j, k), (i, k, j), (j, i, k), (j, k, i), (k, i, j), (k, j, i)];
            *entry += factor / 6.0 * permutations.iter().map(|&(i, j, k)| a[i] * b[j] * c[k]).sum::<f64>();
        }
    }

    /// T_iik r_k and T_ijk r_i r_j r_k.
    fn contract(&self, r: DVec3) -> (f64, f64) {
        let [xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz] = self.0;
        let traces = DVec3::new(xxx + xyy + xzz, xxy + yyy + yzz, xxz + yyz + zzz);
        let DVec3 { x, y, z } = r;
        let pure = xxx * x * x * x + yyy * y * y * y + zzz * z * z * z;
        let mixed = x * x * (xxy * y + xxz * z) + y * y * (xyy * x + yyz * z) + z * z * (xzz * x + yzz * y);
        (traces.dot(r), pure + 3.0 * mixed + 6.0 * xyz * x * y * z)
    }
}

/// The winding number of the triangles of a [`Bvh`].
pub struct WindingNumber<'a> {
    bvh: &'a Bvh,
    moments: Vec<Moments>,
}

impl<'a> WindingNumber<'a> {
    /// Sums the moments of all groups of triangles.
    pub fn new(bvh: &'a Bvh) -> Self {
        let n = bvh.node_count();
        let mut moments = vec![Moments::default(); n];
        let (mut areas, mut radii) = (vec![0.0; n], vec![0.0f64; n]);
        // Children lie behind their parents, so backwards is bottom-up.
        for node in (0..n).rev() {
            let mut m = Moments::default();
            let (lo, hi) = bvh.node_box(node);
            let center = |area: f64, weighted: DVec3| if area > 0.0 { weighted / area } else { (lo + hi) * 0.5 };
            let radius = match bvh.children(node) {
                Children::Nodes(pair) => {
                    areas[node] = areas[pair[0]] + areas[pair[1]];
                    m.center = center(areas[node], pair.iter().map(|&i| moments[i].center * areas[i]).sum());
                    let shifts = pair.map(|i| moments[i].center - m.center);
                    pair.iter().zip(shifts).for_each(|(&i, shift)| m.add_shifted(&moments[i], shift));
                    pair.iter().zip(shifts).map(|(&i, shift)| radii[i] + shift.length()).fold(0.0, f64::max)
                }
                Children::Triangles(triangles) => {
                    let oriented = |t: &[DVec3; 3]| (t[1] - t[0]).cross(t[2] - t[0]) * 0.5;
                    areas[node] = triangles.iter().map(|t| oriented(t).length()).sum();
                    let weighted = triangles.iter().map(|t| (t[0] + t[1] + t[2]) / 3.0 * oriented(t).length()).sum();
                    m.center = center(areas[node], weighted);
                    for t in triangles {
                        // The midpoints of the edges integrate quadratic functions exactly.
                        for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
                            m.add(oriented(t) / 3.0, (a + b) * 0.5 - m.center);
                        }
                    }
                    triangles.iter().flatten().map(|corner| corner.distance(m.center)).fold(0.0, f64::max)
                }
            };
            // By the children's spheres or by the box, whichever is tighter.
            radii[node] = radius.min((hi - m.center).max(m.center - lo).length());
            m.reach_squared = (BETA * radii[node]).powi(2);
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
                sum += m.solid_angle(r, r2);
                continue;
            }
            match self.bvh.children(node) {
                Children::Nodes(pair) => stack.extend(pair),
                Children::Triangles(list) => sum += sum_of_solid_angles(p, list),
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
    fn the_expansion_is_of_third_order() {
        // The error of an expansion to second order falls with the fourth power of the distance, relative to |N|/r²: r⁻⁵.
        let mut mesh = sphere(DVec3::ZERO, 1.0, 6);
        mesh.triangles.truncate(30);
        let triangles = corners(&mesh);
        let bvh = Bvh::new(triangles.clone());
        let winding = WindingNumber::new(&bvh);
        let direction = DVec3::new(1.0, 2.0, 4.0).normalize();
        let error = |distance: f64| {
            let p = winding.moments[0].center + direction * distance;
            let m = &winding.moments[0];
            (m.solid_angle(m.center - p, distance * distance) / (4.0 * PI) - exact(p, &triangles)).abs()
        };
        let ratio = error(8.0) / error(16.0);
        assert!((24.0..44.0).contains(&ratio), "{ratio}");
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
            for i in 0..600 {
                // Half of the points in the box, half beside a triangle.
                let random = |k: usize| DVec3::new(noise(k), noise(k + 1), noise(k + 2));
                let mut p = lo + (1.2 * random(3 * i) - 0.1) * (hi - lo);
                if i % 2 == 0 {
                    let [a, b, c] = triangles[i * 37 % triangles.len()];
                    p = (a + b + c) / 3.0 + 0.02 * (hi - lo).length() * (random(5 * i) - 0.5);
                }
                worst = worst.max((winding.at(p) - exact(p, &triangles)).abs());
            }
            let start = std::time::Instant::now();
            let sum: f64 = (0..20000)
                .map(|i| winding.at(lo + (hi - lo) * DVec3::new(noise(i), noise(i + 7), noise(i + 13))))
                .sum();
            println!("{file}: largest error {worst:.5}, {:?} a query, mean {}", start.elapsed() / 20000, sum / 20000.0);
            assert!(worst < 0.02, "{file}: {worst}");
        }
    }
}
