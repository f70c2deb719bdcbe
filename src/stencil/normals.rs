//! Curvatures of the level sets of φ by differences of normals, second order (Museth et al. 2002, appendix B, corrected).
//!
//! Unit normals n = Dφ/|Dφ| are taken half a voxel to each side along each axis: across the face the two-point difference,
//! along it the average of the central differences at both ends, 19 voxels in all. Their differences are the columns of
//! J = ∂n/∂x; the part of it along n belongs to φ and not to its level sets, and is projected out:
//!
//! > B = J − (J n) nᵀ,  H = tr B / 2,  D² = Σ B²,  κ₁,₂ = H ± √(D²/2 − H²),  K = κ₁ κ₂
//!
//! Positive on convex parts (φ negative inside): a ball of radius R has κ₁ = κ₂ = H = 1/R. On distance fields the error is about
//! 0.6 of that of central differences ([`mean_curvature`](super::curvature::mean_curvature)). Where κ₁ and κ₂ meet, the root
//! turns an error of order h² into one of order h.
//!
//! A grid resolves no radius below a voxel: κ and H are clamped to ±1/h. Where |∇φ| < 0.1 (medial axis, flat parts) there is no
//! normal and all curvatures are 0, but for peaks of φ: they are ±1/h, so that a flow does not leave specks of a voxel behind.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::Halo;
use super::simd::Lanes;

/// Below this |∇φ|², as a part of its value on a distance field, a difference counts as no gradient.
const FLAT_SQUARED: f32 = 0.01;

/// Keeps 0/0 from staggered normals of flat parts, in squared voxel sizes.
const LEAST_SQUARED: f32 = 1e-12;

/// The curvatures of 16 voxels, in 1/world and, for the Gaussian curvature, 1/world².
pub struct Curvatures<S: Simd> {
    /// H = (κ₁ + κ₂)/2.
    pub mean: Lanes<S>,
    /// K = κ₁ κ₂.
    pub gaussian: Lanes<S>,
    /// κ₁, the larger one.
    pub max: Lanes<S>,
    /// κ₂, the smaller one.
    pub min: Lanes<S>,
    /// The largest |φ| of the 19 voxels, world units: at the background, the stencil has left the band.
    pub reach: Lanes<S>,
}

/// All curvatures of rows (x, y) and (x, y + 1).
#[inline(always)]
pub fn curvatures<S: Simd>(simd: S, halo: &Halo, x: usize, y: usize, voxel_size: f32) -> Curvatures<S> {
    macro_rules! at {
        ($dx:literal, $dy:literal, $dz:literal) => {
            halo.rows(simd, x, y, [$dx, $dy, $dz])
        };
    }
    let (c, xm, xp) = (at!(0, 0, 0), at!(-1, 0, 0), at!(1, 0, 0));
    let (ym, yp, zm, zp) = (at!(0, -1, 0), at!(0, 1, 0), at!(0, 0, -1), at!(0, 0, 1));
    // Twice the central differences at the voxel, then at its face neighbours.
    let (dx, dy, dz) = (xp - xm, yp - ym, zp - zm);
    let (xyp, xym) = (at!(1, 1, 0), at!(1, -1, 0));
    let (xmyp, xmym) = (at!(-1, 1, 0), at!(-1, -1, 0));
    let (xzp, xzm) = (at!(1, 0, 1), at!(1, 0, -1));
    let (xmzp, xmzm) = (at!(-1, 0, 1), at!(-1, 0, -1));
    let (yzp, yzm) = (at!(0, 1, 1), at!(0, 1, -1));
    let (ymzp, ymzm) = (at!(0, -1, 1), at!(0, -1, -1));

    let least = Lanes::splat(simd, LEAST_SQUARED * voxel_size * voxel_size);
    macro_rules! normal {
        ($across:expr, $along:expr, $other:expr) => {
            unit(simd, [$across, $along * 0.25, $other * 0.25], least)
        };
    }
    // Columns of J in 1/voxel, each with its own axis first; columns y and z are put in the order x, y, z below.
    let [xx, yx, zx] = difference(
        normal!(xp - c, dy + (xyp - xym), dz + (xzp - xzm)),
        normal!(c - xm, dy + (xmyp - xmym), dz + (xmzp - xmzm)),
    );
    let [yy, xy, zy] = difference(
        normal!(yp - c, dx + (xyp - xmyp), dz + (yzp - yzm)),
        normal!(c - ym, dx + (xym - xmym), dz + (ymzp - ymzm)),
    );
    let [zz, xz, yz] = difference(
        normal!(zp - c, dx + (xzp - xmzp), dy + (yzp - ymzp)),
        normal!(c - zm, dx + (xzm - xmzm), dy + (yzm - ymzm)),
    );
    let rows = [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]];
    let n = unit(simd, [dx, dy, dz], least);

    let (mut trace, mut squares) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 0.0));
    for i in 0..3 {
        let [a, b, c] = rows[i];
        let along = a * n[0] + b * n[1] + c * n[2];
        let (a, b, c) = (a - along * n[0], b - along * n[1], c - along * n[2]);
        trace += [a, b, c][i];
        squares += a * a + b * b + c * c;
    }
    let (zero, one) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0));
    let mean = trace * 0.5;
    let spread = (squares * 0.5 - mean * mean).max(zero).sqrt();
    let (max, min) = ((mean + spread).min(one).max(-one), (mean - spread).min(one).max(-one));

    // dx, dy and dz are twice the central differences.
    let steep = (dx * dx + dy * dy + dz * dz).simd_gt(4.0 * FLAT_SQUARED * voxel_size * voxel_size);
    // Where φ rises to all sides there is no normal either, but a speck of a voxel, as round as a grid can hold one; where it
    // falls to all sides, a hole.
    let (least_turn, largest_turn) = (xx.min(yy).min(zz), xx.max(yy).max(zz));
    let peak = |turn: Lanes<S>| {
        let speck = least_turn.simd_gt(1.0).select(one, zero);
        steep.select(turn, largest_turn.simd_lt(-1.0).select(-one, speck))
    };
    let scale = 1.0 / voxel_size;
    let mut reach = c.abs();
    for v in [xm, xp, ym, yp, zm, zp, xyp, xym, xmyp, xmym, xzp, xzm, xmzp, xmzm, yzp, yzm, ymzp, ymzm] {
        reach = reach.max(v.abs());
    }
    Curvatures {
        reach,
        mean: peak(mean.min(one).max(-one)) * scale,
        gaussian: peak(max) * peak(min) * (scale * scale),
        max: peak(max) * scale,
        min: peak(min) * scale,
    }
}

/// v/|v|; 0 where |v|² is below `least`.
#[inline(always)]
fn unit<S: Simd>(simd: S, [a, b, c]: [Lanes<S>; 3], least: Lanes<S>) -> [Lanes<S>; 3] {
    let inverse = Lanes::splat(simd, 1.0) / (a * a + b * b + c * c).max(least).sqrt();
    [a * inverse, b * inverse, c * inverse]
}

#[inline(always)]
fn difference<S: Simd>(a: [Lanes<S>; 3], b: [Lanes<S>; 3]) -> [Lanes<S>; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3, IVec3};

    use super::*;
    use crate::grid::{Grid, offset_to_local};
    use crate::stencil::curvature::mean_curvature;
    use crate::stencil::simd::{Isa, Work, choose, dispatch};

    /// H, K, κ₁, κ₂ and the central H at the 512 voxels of the leaf at the origin of a field.
    fn measured(voxel_size: f32, field: &(dyn Fn(DVec3) -> f64 + Sync)) -> Vec<[f32; 5]> {
        struct Run<'a>(&'a Grid, f32, &'a mut Vec<[f32; 5]>);
        impl Work for Run<'_> {
            fn run<S: Simd>(self, simd: S) {
                let mut halo = Halo::new();
                let around = &self.0.neighbours()[self.0.find(IVec3::ZERO).index()];
                halo.gather(self.0.value_pages(), around);
                for x in 0..8 {
                    for y in [0, 2, 4, 6] {
                        let c = curvatures(simd, &halo, x, y, self.1);
                        let central = mean_curvature(simd, &halo, x, y, self.1).mean;
                        self.2.extend((0..16).map(|k| [c.mean[k], c.gaussian[k], c.max[k], c.min[k], central[k]]));
                    }
                }
            }
        }
        let origins: Vec<_> = (0..27).map(|q| IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * 8).collect();
        let mut grid = Grid::from_origins(1.0, &origins);
        let ids: Vec<_> = grid.leaves().iter().map(|&id| (id, grid.origin(id))).collect();
        grid.update_all(|id, values, _| {
            let origin = ids.iter().find(|i| i.0 == id).unwrap().1;
            for (o, v) in values.0.iter_mut().enumerate() {
                *v = field((origin + offset_to_local(o)).as_dvec3() * f64::from(voxel_size)) as f32;
            }
        });
        let mut out = Vec::new();
        dispatch(Run(&grid, voxel_size, &mut out));
        out
    }

    /// Where the voxels of [`measured`] lie, in its order.
    fn positions(voxel_size: f64) -> impl Iterator<Item = DVec3> {
        (0..512).map(move |o| offset_to_local(o).as_dvec3() * voxel_size)
    }

    /// The scheme in f64, written from its definition with matrices: H, K, κ₁, κ₂.
    fn reference(h: f64, at: DVec3, field: &(dyn Fn(DVec3) -> f64 + Sync)) -> [f64; 4] {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|a| a * h);
        let central = |p: DVec3| DVec3::from_array(axes.map(|a| (field(p + a) - field(p - a)) / (2.0 * h)));
        let staggered = |a: usize, sign: f64| {
            let there = at + axes[a] * sign;
            let mut g = (central(at) + central(there)) / 2.0;
            g[a] = (field(there) - field(at)) / (h * sign);
            g.normalize()
        };
        let column = |a| (staggered(a, 1.0) - staggered(a, -1.0)) / h;
        let j = DMat3::from_cols(column(0), column(1), column(2));
        let [mean, _, max, min] = invariants(j, central(at).normalize()).map(|v| v.clamp(-1.0 / h, 1.0 / h));
        [mean, max * min, max, min]
    }

    /// H, K, κ₁, κ₂ of a surface with the unit normal `n`, whose derivative is `j`.
    fn invariants(j: DMat3, n: DVec3) -> [f64; 4] {
        let b = j * (DMat3::IDENTITY - DMat3::from_cols(n * n.x, n * n.y, n * n.z));
        let mean = (b.x_axis.x + b.y_axis.y + b.z_axis.z) / 2.0;
        let squares: f64 = b.to_cols_array().iter().map(|v| v * v).sum();
        let spread = (squares / 2.0 - mean * mean).max(0.0).sqrt();
        [mean, 2.0 * mean * mean - squares / 2.0, mean + spread, mean - spread]
    }

    /// A torus around z, far enough from the origin that the leaf there meets its tube. Radii in units of the leaf's edge.
    fn torus(p: DVec3) -> f64 {
        let p = p + DVec3::new(1.15, 0.3, 0.2);
        (p.x.hypot(p.y) - 0.9).hypot(p.z) - 0.4
    }

    #[test]
    fn equals_its_definition_in_double_precision() {
        let wavy = |p: DVec3| (p.x * 1.3).sin() + p.y * 0.7 + (p.z * 0.9 + p.x * p.y * 0.2).cos() * 0.5;
        for (voxel_size, field) in
            [(0.1f32, &wavy as &(dyn Fn(DVec3) -> f64 + Sync)), (0.05, &torus), (2e-4, &|p| torus(p * 100.0) / 100.0)]
        {
            let h = f64::from(voxel_size);
            for (got, p) in measured(voxel_size, field).iter().zip(positions(h)) {
                let expected = reference(h, p, field);
                // Values of up to 2 (0.02) world units in f32 differ by 1.2e-7 (1e-9) at most; over a voxel that turns a normal by
                // 2e-6 (1e-5). Four times as much, as J has two normals in each of six differences; and the root doubles the digits lost.
                let error = 16.0 * f64::from(f32::EPSILON) * if h < 1e-3 { 0.02 } else { 2.0 } / (h * h);
                for k in 0..4 {
                    let scale = if k == 1 { 2.0 / h } else { 1.0 };
                    let spread = expected[2] - expected[3];
                    let tolerance =
                        if k == 0 { error } else { error * scale * (1.0 + 1.0 / h / spread.max(h)).min(30.0) };
                    assert!(
                        (f64::from(got[k]) - expected[k]).abs() < tolerance,
                        "{k} at {p}: {got:?} {expected:?} {tolerance}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_invariants_are_those_of_the_principal_curvatures() {
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        for _ in 0..1000 {
            let (a, b, along) = (random(), random(), DVec3::new(random(), random(), random()));
            let turn = DMat3::from_axis_angle(DVec3::new(random(), random(), random()).normalize(), 3.0 * random());
            let (s, t, n) = (turn.x_axis, turn.y_axis, turn.z_axis);
            let outer = |v: DVec3, w: DVec3| DMat3::from_cols(v * w.x, v * w.y, v * w.z);
            // Beside the two curvatures, a change of the normal along itself, which belongs to φ and must not count.
            let j = outer(s, s) * a + outer(t, t) * b + outer(along, n);
            let [mean, gaussian, max, min] = invariants(j, n);
            for (got, expected) in [(mean, (a + b) / 2.0), (gaussian, a * b)] {
                assert!((got - expected).abs() < 1e-14, "{got} {expected}");
            }
            // The root doubles the digits that are lost where both are nearly equal.
            for (got, expected) in [(max, a.max(b)), (min, a.min(b))] {
                assert!((got - expected).abs() < 1e-14 / (a - b).abs().max(1e-7), "{got} {expected}");
            }
        }
    }

    /// H, K, κ₁, κ₂ at a point of a surface, by voxels of `h` around it.
    fn at_point(h: f64, point: DVec3, field: &(dyn Fn(DVec3) -> f64 + Sync)) -> [f64; 4] {
        let [mean, gaussian, max, min, _] = measured(h as f32, &|p| field(p + point))[0];
        [mean, gaussian, max, min].map(f64::from)
    }

    #[test]
    fn the_numbers_of_torus_ellipsoid_saddle_and_crease() {
        let near = |got: [f64; 4], expected: [f64; 4], tolerance: f64| {
            for k in 0..4 {
                assert!(
                    (got[k] - expected[k]).abs() < tolerance * expected[2].abs().max(expected[3].abs()).max(1.0),
                    "{k}: {got:?} {expected:?}"
                );
            }
        };
        let torus = |p: DVec3| (p.x.hypot(p.y) - 0.9).hypot(p.z) - 0.4;
        // (1/r + 1/(R + r))/2, 1/(r (R + r)); (1/r − 1/(R − r))/2, −1/(r (R − r)).
        let h = 0.0234375;
        near(at_point(h, DVec3::X * 1.3, &torus), [1.6346, 1.9231, 2.5, 0.7692], 0.003);
        near(at_point(h, DVec3::X * 0.5, &torus), [0.25, -5.0, 2.5, -2.0], 0.003);
        // An ellipsoid at the end of its first axis, a/b² and a/c²; its quadratic is no distance, with a slope of 2 there.
        let axes = DVec3::new(1.0, 0.7, 0.5);
        near(
            at_point(h, DVec3::X, &|p| ((p / axes).length_squared() - 1.0) / 2.0),
            [3.0204, 8.163, 4.0, 2.0408],
            0.003,
        );
        for radius in [0.5, 1.0, 2.0] {
            let saddle = at_point(h, DVec3::ZERO, &|p| p.z - (p.x * p.x - p.y * p.y) / (2.0 * radius));
            near(saddle, [0.0, -1.0 / (radius * radius), 1.0 / radius, -1.0 / radius], 0.003);
        }
        let crease = at_point(h, DVec3::ZERO, &|p| p.x.min(p.y));
        assert!(crease[0] < 0.0 && crease[3] < 0.0, "concave: {crease:?}");
    }

    #[test]
    fn errors_on_a_sphere_fall_with_the_square_of_the_voxel() {
        // Over directions all around a sphere of radius 1: rms errors of H and of K, and the largest of H.
        let errors = |h: f64| {
            let (mut sums, mut most, count) = ([0.0; 2], 0f64, 60);
            for k in 0..count {
                let z = 1.0 - 2.0 * (f64::from(k) + 0.5) / f64::from(count);
                let (s, c) = (f64::from(k) * 2.399963).sin_cos();
                let n = DVec3::new((1.0 - z * z).sqrt() * c, (1.0 - z * z).sqrt() * s, z);
                let [mean, gaussian, ..] = at_point(h, n, &|p| p.length() - 1.0);
                sums = [sums[0] + (mean - 1.0).powi(2), sums[1] + (gaussian - 1.0).powi(2)];
                most = most.max((mean - 1.0).abs());
            }
            [(sums[0] / f64::from(count)).sqrt(), (sums[1] / f64::from(count)).sqrt(), most]
        };
        let (coarse, fine) = (errors(0.09375), errors(0.046875));
        // An independent computation has 1.17e-4 and 2.3e-4 rms, and 2.9e-4 at most, at the finer one; f32 adds a few 1e-5.
        assert!(fine[0] < 1.6e-4 && fine[1] < 3.2e-4 && fine[2] < 4e-4, "{fine:?}");
        for k in 0..3 {
            assert!((3.0..5.0).contains(&(coarse[k] / fine[k])), "{k}: {coarse:?} {fine:?}");
        }
    }

    #[test]
    fn second_order_on_a_torus_and_better_than_central_differences() {
        // The exact curvatures at a distance d from the torus: those of the torus with a tube of 0.4 + d.
        let exact = |p: DVec3| {
            let q = p + DVec3::new(1.15, 0.3, 0.2);
            let from_axis = q.x.hypot(q.y);
            let tube = (from_axis - 0.9).hypot(q.z);
            let (k1, k2) = (1.0 / tube, (from_axis - 0.9) / tube / from_axis);
            [(k1 + k2) / 2.0, k1 * k2, k1.max(k2), k1.min(k2)]
        };
        let errors = |h: f64| {
            let mut sums = [0.0; 5];
            let mut count = 0.0;
            for (got, p) in measured(h as f32, &torus).iter().zip(positions(h)) {
                if torus(p).abs() < 0.2 {
                    let truth = exact(p);
                    for k in 0..5 {
                        sums[k] += (f64::from(got[k]) - truth[k % 4]).powi(2);
                    }
                    count += 1.0;
                }
            }
            assert!(count > 50.0, "{count}");
            sums.map(|s: f64| (s / count).sqrt())
        };
        let (coarse, fine) = (errors(0.05), errors(0.025));
        for k in 0..4 {
            // A factor of 4 in theory; the voxels are not the same ones.
            assert!(fine[k] < coarse[k] / 2.8, "{k}: {coarse:?} {fine:?}");
        }
        // The leading term of the error is about h²κ³/6 for H, with κ up to 3.3.
        assert!(coarse[0] < 0.05f64.powi(2) * 36.0 / 6.0, "{coarse:?}");
        assert!(coarse[0] < 0.85 * coarse[4], "{coarse:?}");
    }

    #[test]
    fn spheres_cylinders_saddles_and_creases() {
        let h = 0.05f32;
        let near = |got: f32, expected: f64, tolerance: f64| (f64::from(got) - expected).abs() < tolerance;
        let centre = DVec3::new(-0.9, -0.4, -0.5);
        for (got, p) in measured(h, &|p| (p - centre).length() - 1.0).iter().zip(positions(0.05)) {
            let r = (p - centre).length();
            // κ₁ = κ₂: the root of an error e² h²κ³ is an error of order h.
            assert!(near(got[0], 1.0 / r, 0.002) && near(got[1], r.powi(-2), 0.004), "{got:?} {r}");
            assert!(near(got[2], 1.0 / r, 0.05) && near(got[3], 1.0 / r, 0.05), "{got:?} {r}");
        }
        // A hollow cylinder is concave: κ₁ = 0.
        for (got, p) in measured(h, &|p| 1.0 - (p.x + 0.9).hypot(p.y + 0.4)).iter().zip(positions(0.05)) {
            let r = (p.x + 0.9).hypot(p.y + 0.4);
            assert!(near(got[2], 0.0, 1e-3) && near(got[3], -1.0 / r, 2e-3) && near(got[1], 0.0, 1e-3), "{got:?} {r}");
        }
        // z = (x² − y²)/2 has H = 0 and K = −1 at the origin, and κ = ±1.
        let saddle = measured(h, &|p| p.z - (p.x * p.x - p.y * p.y) / 2.0)[0];
        assert!(near(saddle[0], 0.0, 1e-3) && near(saddle[1], -1.0, 0.01) && near(saddle[2], 1.0, 0.005), "{saddle:?}");
        // A convex edge through the leaf: bounded by 1/h, positive, and 0 in the flats beside it.
        for (got, p) in measured(h, &|p| (p.x - 0.17).max(p.y - 0.17)).iter().zip(positions(0.05)) {
            assert!(got.iter().all(|k| k.is_finite()) && got[0].abs() <= 20.0 && got[2] <= 20.0);
            if (p.x - p.y).abs() > 0.14 {
                assert!(near(got[0], 0.0, 1e-3) && near(got[1], 0.0, 1e-2), "{got:?}");
            } else if (p.x - p.y).abs() < 0.01 {
                assert!(got[2] > 10.0 && got[0] > 5.0, "{got:?}");
            }
        }
        // The centre of a speck, and that of a hole, is as round as can be; the axis of a cylinder is not round at all.
        let at = DVec3::splat(0.15);
        for sign in [1.0, -1.0] {
            let all = measured(h, &|p| sign * ((p - at).length() - 0.03));
            let got = all[positions(0.05).position(|p| (p - at).length() < 1e-6).unwrap()];
            let k = 1.0 / 0.05 * sign;
            assert!(near(got[0], k, 1e-4) && near(got[1], 400.0, 1e-2) && near(got[2], k, 1e-4), "{got:?}");
            let all = measured(h, &|p| sign * ((p - at).truncate().length() - 0.03));
            let axis = positions(0.05).zip(&all).filter(|(p, _)| (*p - at).truncate().length() < 1e-6);
            assert!(axis.map(|(_, got)| got[0]).all(|mean| mean == 0.0));
        }
        // No gradient, no curvature.
        assert!(measured(h, &|_| 0.7).iter().all(|got| *got == [0.0; 5]));
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let run = |isa| {
            choose(isa);
            measured(0.05, &torus)
        };
        let first = run(Isa::Portable);
        assert!(run(Isa::Avx2) == first && run(Isa::Avx512) == first);
        choose(Isa::detect());
    }
}
