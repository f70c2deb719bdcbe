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

use fearless_simd::Simd;
use glam::{DMat3, DVec3};

use super::bvh::{Bvh, Children};
use crate::stencil::simd::{Work, dispatch};

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

/// How many radii away a group of triangles must be to be seen as a whole: the value of Barill et al. The test below
/// holds the error under 0.02 with it.
const BETA: f64 = 2.0;

/// Points whose winding numbers are computed together, in one walk down the tree.
pub(crate) const BATCH: usize = 8;
/// Triangles up to this extent (voxels) are summed in f32 relative to the batch: at a thousandth of a voxel from such a
/// triangle the determinant still has its sign. Larger ones are summed in f64.
const F32_EXTENT: f64 = 64.0;
/// How near a box of triangles counts as beside a point, in voxels.
const BESIDE: f64 = 0.01;

/// What a group of triangles looks like from afar.
#[derive(Clone, Copy, Debug)]
struct Moments {
    /// Area-weighted centre.
    center: DVec3,
    /// Distance from which the expansion serves, β · radius.
    reach: f64,
    /// ∫ n.
    dipole: DVec3,
    /// ∫ n δᵀ.
    first: DMat3,
    /// Symmetric part of ∫ n⊗δ⊗δ.
    second: Cubic,
}

impl Moments {
    /// Of no triangles. (The default of a matrix is the identity.)
    const ZERO: Self =
        Self { center: DVec3::ZERO, reach: 0.0, dipole: DVec3::ZERO, first: DMat3::ZERO, second: Cubic([0.0; 10]) };

    /// Adds a bundle of oriented area `n` at `delta` from the centre.
    fn add(&mut self, n: DVec3, delta: DVec3) {
        self.dipole += n;
        self.first += outer(n, delta);
        self.second.add(outer(delta, delta), n, 1.0);
    }

    /// Adds the moments of a child about its own centre, `shift` from this one.
    fn add_shifted(&mut self, child: &Self, shift: DVec3) {
        self.add(child.dipole, shift);
        self.first += child.first;
        self.second.add((child.first + child.first.transpose()) * 0.5, shift, 2.0);
        self.second.0.iter_mut().zip(child.second.0).for_each(|(a, b)| *a += b);
    }

    /// The coefficients of the expansion.
    fn far_field(&self) -> FarField {
        let DMat3 { x_axis: x, y_axis: y, z_axis: z } = self.first;
        let [xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz] = self.second.0;
        FarField {
            center: self.center,
            reach: self.reach,
            dipole: self.dipole.as_vec3().to_array(),
            trace: (x.x + y.y + z.z) as f32,
            quadratic: [x.x, y.y, z.z, x.y + y.x, y.z + z.y, z.x + x.z].map(|v| (3.0 * v) as f32),
            linear: [xxx + xyy + xzz, xxy + yyy + yzz, xxz + yyz + zzz].map(|v| (4.5 * v) as f32),
            cubic: [
                [xxx, yyy, zzz].map(|v| (7.5 * v) as f32),
                [xxy, yyz, xzz].map(|v| (22.5 * v) as f32),
                [xxz, xyy, yzz].map(|v| (22.5 * v) as f32),
            ],
            mixed: (45.0 * xyz) as f32,
        }
    }
}

/// The coefficients of a group's expansion in the unit vector u = r/|r| and 1/|r|:
/// Ω |r|² ≈ N·u + (tr M − 3 uᵀMu)/|r| + (15/2 T(u, u, u) − 9/2 T_iik u_k)/|r|².
#[derive(Clone, Copy, Debug)]
struct FarField {
    center: DVec3,
    reach: f64,
    dipole: [f32; 3],
    trace: f32,
    /// xx, yy, zz, xy, yz, zx.
    quadratic: [f32; 6],
    linear: [f32; 3],
    /// xxx, yyy, zzz; xxy, yyz, zzx; xxz, yyx, zzy.
    cubic: [[f32; 3]; 3],
    mixed: f32,
}

impl FarField {
    /// Sum of the solid angles seen from `r` before the centre.
    #[inline(always)]
    fn solid_angle(&self, r: [f32; 3]) -> f32 {
        let inverse = 1.0 / (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]).sqrt();
        let [x, y, z] = [r[0] * inverse, r[1] * inverse, r[2] * inverse];
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let dipole = self.dipole[0] * x + self.dipole[1] * y + self.dipole[2] * z;
        let q = &self.quadratic;
        let quadratic = q[0] * xx + q[1] * yy + q[2] * zz + q[3] * x * y + q[4] * y * z + q[5] * z * x;
        let linear = self.linear[0] * x + self.linear[1] * y + self.linear[2] * z;
        let [pure, next, last] = &self.cubic;
        let cubic = xx * (pure[0] * x + next[0] * y + last[0] * z)
            + yy * (pure[1] * y + next[1] * z + last[1] * x)
            + zz * (pure[2] * z + next[2] * x + last[2] * y)
            + self.mixed * x * y * z;
        inverse * inverse * (dipole + inverse * (self.trace - quadratic + inverse * (cubic - linear)))
    }
}

/// A symmetric tensor of rank 3: xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz.
#[derive(Clone, Copy, Debug)]
struct Cubic([f64; 10]);

impl Cubic {
    const INDICES: [[usize; 3]; 10] =
        [[0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 0, 1], [0, 0, 2], [0, 1, 1], [1, 1, 2], [0, 2, 2], [1, 2, 2], [0, 1, 2]];

    /// Adds `factor` times the symmetric part of m⊗v; `m` must be symmetric.
    fn add(&mut self, m: DMat3, v: DVec3, factor: f64) {
        let m = m.to_cols_array_2d();
        for (entry, [i, j, k]) in self.0.iter_mut().zip(Self::INDICES) {
            *entry += factor / 3.0 * (m[i][j] * v[k] + m[j][k] * v[i] + m[k][i] * v[j]);
        }
    }
}

/// The winding number of the triangles of a [`Bvh`].
pub struct WindingNumber<'a> {
    bvh: &'a Bvh,
    far: Vec<FarField>,
    /// Area of the triangles below each node.
    areas: Vec<f64>,
    /// Whether what lies beside a point is summed in f64.
    exact_nearby: bool,
}

impl<'a> WindingNumber<'a> {
    /// Sums the moments of all groups of triangles.
    pub fn new(bvh: &'a Bvh) -> Self {
        let n = bvh.node_count();
        let mut moments = vec![Moments::ZERO; n];
        let (mut areas, mut radii) = (vec![0.0; n], vec![0.0f64; n]);
        // Children lie behind their parents, so backwards is bottom-up.
        for node in (0..n).rev() {
            let mut m = Moments::ZERO;
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
            m.reach = BETA * radii[node];
            moments[node] = m;
        }
        Self { bvh, far: moments.iter().map(Moments::far_field).collect(), areas, exact_nearby: false }
    }

    /// The same, with f64 for the triangles beside a point: right however near it lies to one of them, and slower.
    pub(crate) fn exact_nearby(self) -> Self {
        Self { exact_nearby: true, ..self }
    }

    /// Whether the triangles subtend less than `limit` at every point of a ball, however they face: at distance d an area
    /// A subtends no more than A/d².
    pub(crate) fn is_below(&self, center: DVec3, radius: f64, limit: f64) -> bool {
        let mut sum = 0.0;
        let mut stack = smallvec::SmallVec::<[usize; 64]>::new();
        if !self.far.is_empty() {
            stack.push(0);
        }
        while let Some(node) = stack.pop() {
            let far = &self.far[node];
            let own = far.reach / BETA;
            let distance = far.center.distance(center) - own - radius;
            match self.bvh.children(node) {
                Children::Nodes(pair) if distance < own => stack.extend(pair),
                _ if distance > 0.0 => sum += self.areas[node] / (distance * distance),
                _ => return false,
            }
            if sum >= limit {
                return false;
            }
        }
        true
    }

    /// The winding number at `p`.
    pub fn at(&self, p: DVec3) -> f64 {
        self.at_each(&[p])[0]
    }

    /// The winding numbers at points that lie near each other.
    pub(crate) fn at_each<const N: usize>(&self, points: &[DVec3; N]) -> [f64; N] {
        let mut sums = [0.0; N];
        dispatch(SumAngles { winding: self, points, sums: &mut sums });
        sums.map(|sum| sum / (4.0 * PI))
    }

    /// Adds the solid angles seen from points that lie near each other.
    #[inline(always)]
    fn add_angles<const N: usize>(&self, points: &[DVec3; N], sums: &mut [f64; N]) {
        let lo = points.iter().fold(DVec3::INFINITY, |a, p| a.min(*p));
        let hi = points.iter().fold(DVec3::NEG_INFINITY, |a, p| a.max(*p));
        let middle = (lo + hi) * 0.5;
        let spread = 0.5 * lo.distance(hi);
        // The offsets of the points by coordinate, for arithmetic on several points at once.
        let exact_offsets: [[f64; N]; 3] = std::array::from_fn(|axis| points.map(|p| p[axis] - middle[axis]));
        let offsets = exact_offsets.map(|along| along.map(|offset| offset as f32));
        let mut stack = smallvec::SmallVec::<[usize; 64]>::new();
        if !self.far.is_empty() {
            stack.push(0);
        }
        while let Some(node) = stack.pop() {
            let far = &self.far[node];
            let r = far.center - middle;
            let reach = far.reach + spread;
            if r.length_squared() > reach * reach {
                let r = r.as_vec3();
                let mut angles = [0.0f32; N];
                for lane in 0..N {
                    let [x, y, z] = [offsets[0][lane], offsets[1][lane], offsets[2][lane]];
                    angles[lane] = far.solid_angle([r.x - x, r.y - y, r.z - z]);
                }
                for lane in 0..N {
                    sums[lane] += f64::from(angles[lane]);
                }
                continue;
            }
            match self.bvh.children(node) {
                Children::Nodes(pair) => stack.extend(pair),
                Children::Triangles(list) => {
                    let (low, high) = self.bvh.node_box(node);
                    let beside = low.cmple(hi + BESIDE).all() && high.cmpge(lo - BESIDE).all();
                    if (high - low).max_element() <= F32_EXTENT && !(self.exact_nearby && beside) {
                        add_solid_angles(sums, &offsets, middle, list);
                    } else {
                        add_solid_angles(sums, &exact_offsets, middle, list);
                    }
                }
            }
        }
    }
}

/// Solid angles summed with the instruction set in use.
struct SumAngles<'a, const N: usize> {
    winding: &'a WindingNumber<'a>,
    points: &'a [DVec3; N],
    sums: &'a mut [f64; N],
}

impl<const N: usize> Work for SumAngles<'_, N> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        self.winding.add_angles(self.points, self.sums);
    }
}

/// Arithmetic of solid angles: f32, or f64 where the plane of a triangle must be told from what lies right beside it.
trait Real:
    Copy
    + PartialOrd
    + std::ops::Add<Output = Self>
    + std::ops::Sub<Output = Self>
    + std::ops::Mul<Output = Self>
    + std::ops::Div<Output = Self>
{
    fn of(value: f64) -> Self;
    fn to_f32(self) -> f32;
    fn to_f64(self) -> f64;
    fn sqrt(self) -> Self;
}

impl Real for f32 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value as Self
    }
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
    #[inline(always)]
    fn to_f64(self) -> f64 {
        f64::from(self)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
}

impl Real for f64 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value
    }
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self as f32
    }
    #[inline(always)]
    fn to_f64(self) -> f64 {
        self
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
}

/// The argument of x + iy for x > 0, within 1e-5: far below the error of the expansion, and without a function call.
/// Abramowitz and Stegun 1964, 4.4.49, to the eleventh power.
#[inline(always)]
fn argument(y: f32, x: f32) -> f32 {
    let (small, large) = if y.abs() < x { (y.abs(), x) } else { (x, y.abs()) };
    let a = small / large;
    let s = a * a;
    let series = 0.999_977_26
        + s * (-0.332_623_47 + s * (0.193_543_46 + s * (-0.116_432_87 + s * (0.052_653_32 - s * 0.011_721_2))));
    let angle = a * series;
    let angle = if y.abs() < x { angle } else { std::f32::consts::FRAC_PI_2 - angle };
    // Not `copysign`: this is made vector code of; see `with_sign` in `stencil::simd`.
    if y < 0.0 { -angle } else { angle }
}

/// Adds the solid angles of a few triangles at `middle + offsets`.
///
/// Arguments add up where complex numbers multiply: one arctangent serves several triangles, as long as all factors and
/// products stay in the right half-plane, where nothing wraps around.
#[inline(always)]
fn add_solid_angles<F: Real, const N: usize>(
    sums: &mut [f64; N],
    offsets: &[[F; N]; 3],
    middle: DVec3,
    triangles: &[[DVec3; 3]],
) {
    let zero = F::of(0.0);
    let dot = |a: [F; 3], b: [F; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let (mut re, mut im) = ([F::of(1.0); N], [zero; N]);
    for triangle in triangles {
        let corners = triangle.map(|corner| (corner - middle).to_array().map(F::of));
        let (mut x, mut y) = ([zero; N], [zero; N]);
        let (mut product_re, mut product_im) = ([zero; N], [zero; N]);
        let mut wraps = false;
        for lane in 0..N {
            let from = |c: [F; 3]| [c[0] - offsets[0][lane], c[1] - offsets[1][lane], c[2] - offsets[2][lane]];
            let [a, b, c] = [from(corners[0]), from(corners[1]), from(corners[2])];
            let (la, lb, lc) = (dot(a, a).sqrt(), dot(b, b).sqrt(), dot(c, c).sqrt());
            let volume = la * lb * lc;
            let least = F::of(f64::from(f32::MIN_POSITIVE));
            let scale = F::of(1.0) / if volume > least { volume } else { least };
            let denominator = volume + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb;
            let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
            x[lane] = denominator * scale;
            y[lane] = dot(a, cross) * scale;
            product_re[lane] = re[lane] * x[lane] - im[lane] * y[lane];
            product_im[lane] = re[lane] * y[lane] + im[lane] * x[lane];
            wraps |= x[lane] <= zero || product_re[lane] <= zero;
        }
        if !wraps {
            (re, im) = (product_re, product_im);
            continue;
        }
        for lane in 0..N {
            if x[lane] <= zero {
                // In the triangle's plane, the sign of a zero would choose between 2π and −2π.
                sums[lane] += if y[lane] == zero { 0.0 } else { 2.0 * y[lane].to_f64().atan2(x[lane].to_f64()) };
            } else if product_re[lane] > zero {
                (re[lane], im[lane]) = (product_re[lane], product_im[lane]);
            } else {
                sums[lane] += f64::from(2.0 * argument(im[lane].to_f32(), re[lane].to_f32()));
                (re[lane], im[lane]) = (x[lane], y[lane]);
            }
        }
    }
    for lane in 0..N {
        sums[lane] += f64::from(2.0 * argument(im[lane].to_f32(), re[lane].to_f32()));
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
            let far = &winding.far[0];
            let r = (direction * -distance).as_vec3().to_array();
            (f64::from(far.solid_angle(r)) / (4.0 * PI) - exact(far.center + direction * distance, &triangles)).abs()
        };
        let ratio = error(4.0) / error(8.0);
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
                let truth = exact(p, &triangles);
                worst = worst.max((winding.at(p) - truth).abs());
                // In a batch with others it is as exact.
                let batch = std::array::from_fn(|k| p + (k % BATCH) as f64 * 0.01 * (hi - lo));
                worst = worst.max((winding.at_each::<BATCH>(&batch)[0] - truth).abs());
            }
            assert!(worst < 0.02, "{file}: {worst}");
        }
    }
}
