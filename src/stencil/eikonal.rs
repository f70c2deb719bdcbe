//! The Eikonal equation |∇u| = 1 at a voxel from its face neighbours, first order (Rouy & Tourin 1992; Zhao 2005).
//!
//! > Σ max(u − uᵢ, 0)² = h²,  uᵢ the smaller neighbour along axis i
//!
//! Exact on planes with exact neighbours. Behind a point or an edge, from which distances fan out, the error is of order
//! h·log(1/h): a voxel and a half at a distance of 16 voxels from a single voxel.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask, mask32x16};

use super::LeafHalo;
use super::simd::Lanes;

/// Below this |∇φ| a central difference says nothing of the distance to the surface.
const LEAST_GRADIENT: f32 = 1e-3;

/// What starts a sweep.
pub struct Seeds<S: Simd> {
    /// Distance to the surface of the voxels beside it, world units.
    pub distance: Lanes<S>,
    /// The voxels beside the surface: those with a face neighbour of the other sign. A bit a lane.
    pub beside: u16,
}

/// The voxels of rows (x, y) and (x, y + 1) beside the zero set of φ, and their distance to it.
///
/// > d = |φ| / |∇φ|,  but no more than the way to the zero along each axis, h·φ/(φ − φ')
///
/// with the central gradient; second order where φ is smooth, and never farther than the surface is on a grid line.
#[inline(always)]
pub fn seeds<S: Simd>(simd: S, halo: &impl LeafHalo, x: usize, y: usize, voxel_size: f32) -> Seeds<S> {
    let phi = halo.centre(simd, x, y);
    let zero = Lanes::splat(simd, 0.0);
    let inside = phi.simd_lt(zero).to_bitmask();
    let (mut squared, mut way, mut beside) = (zero, Lanes::splat(simd, voxel_size), 0);
    for axis in 0..3 {
        let [before, after] = halo.beside(simd, x, y, axis);
        let slope = (after - before) * (0.5 / voxel_size);
        squared += slope * slope;
        for there in [before, after] {
            let crosses = there.simd_lt(zero).to_bitmask() ^ inside;
            beside |= crosses;
            // Of different sign, so the quotient is 0..1; not read where they are not.
            let along = phi / (phi - there) * voxel_size;
            way = mask32x16::from_bitmask(simd, crosses).select(way.min(along), way);
        }
    }
    let distance = phi.abs() / squared.sqrt().max(Lanes::splat(simd, LEAST_GRADIENT));
    Seeds { distance: distance.min(way), beside: beside as u16 }
}

/// The smaller of |u| at the two neighbours along each axis.
#[inline(always)]
pub fn upwind_neighbours<S: Simd>(simd: S, halo: &impl LeafHalo, x: usize, y: usize) -> [Lanes<S>; 3] {
    macro_rules! least {
        ($axis:literal) => {{
            let [before, after] = halo.beside(simd, x, y, $axis);
            before.abs().min(after.abs())
        }};
    }
    [least!(0), least!(1), least!(2)]
}

/// u from the smaller neighbour along each axis.
#[inline(always)]
pub fn solve<S: Simd>(simd: S, [u1, u2, u3]: [Lanes<S>; 3], voxel_size: f32) -> Lanes<S> {
    // a ≤ b ≤ c.
    let (low, high) = (u1.min(u2), u1.max(u2));
    let (a, rest) = (low.min(u3), low.max(u3));
    let (b, c) = (rest.min(high), rest.max(high));
    // Relative to the smallest, so that squares cancel no digits of it.
    let (p, q) = (b - a, c - a);
    let (h, zero) = (Lanes::splat(simd, voxel_size), Lanes::splat(simd, 0.0));
    let h2 = Lanes::splat(simd, voxel_size * voxel_size);
    let two = (p + (h2 * 2.0 - p * p).max(zero).sqrt()) * 0.5;
    let sum = p + q;
    let three = (sum + (sum * sum - (p * p + q * q - h2) * 3.0).max(zero).sqrt()) * (1.0 / 3.0);
    // Neighbours that are not below the result take no part in it.
    a + p.simd_ge(h).select(h, q.simd_ge(two).select(two, three))
}

/// A field that is constant along ∇u, from its values `v` at the smaller neighbours: ∇v·∇u = 0 upwind,
///
/// > v = Σ wᵢ vᵢ / Σ wᵢ,  wᵢ = max(|u| − |uᵢ|, 0)
///
/// Where no neighbour is smaller it stays what it is.
#[inline(always)]
pub fn extend<S: Simd>(simd: S, distance: &impl LeafHalo, field: &impl LeafHalo, x: usize, y: usize) -> Lanes<S> {
    let zero = Lanes::splat(simd, 0.0);
    let here = distance.centre(simd, x, y).abs();
    let (mut weights, mut sum) = (zero, zero);
    for axis in 0..3 {
        let ([before, after], values) = (distance.beside(simd, x, y, axis), field.beside(simd, x, y, axis));
        let (before, after) = (before.abs(), after.abs());
        let value = before.simd_lt(after).select(values[0], values[1]);
        let weight = (here - before.min(after)).max(zero);
        weights += weight;
        sum += weight * value;
    }
    let known = weights.simd_gt(zero);
    known.select(sum / known.select(weights, Lanes::splat(simd, 1.0)), field.centre(simd, x, y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stencil::simd::{Work, dispatch};

    fn solved(neighbours: [f32; 3], h: f32) -> f32 {
        struct Solve<'a>([f32; 3], f32, &'a mut f32);
        impl Work for Solve<'_> {
            fn run<S: Simd>(self, simd: S) {
                *self.2 = solve(simd, self.0.map(|v| Lanes::splat(simd, v)), self.1)[0];
            }
        }
        let mut u = f32::NAN;
        dispatch(Solve(neighbours, h, &mut u));
        u
    }

    #[test]
    fn the_solution_satisfies_the_equation() {
        for h in [1.0f32, 0.01] {
            for k in 0..1000u32 {
                let part = |m: u32| (k.wrapping_mul(m) >> 7 & 1023) as f32 / 1024.0 * 3.0 * h;
                let neighbours = [part(2_654_435_761), part(2_246_822_519), part(3_266_489_917)];
                let u = f64::from(solved(neighbours, h));
                let sum: f64 = neighbours.iter().map(|n| (u - f64::from(*n)).max(0.0).powi(2)).sum();
                assert!((sum / f64::from(h * h) - 1.0).abs() < 1e-5, "{neighbours:?} {u} {sum}");
            }
        }
        // A neighbour that has no value yet counts as far away.
        assert_eq!(solved([1.0, 1e9, 1e9], 0.5), 1.5);
        // A plane through all three: exact.
        assert!((solved([1.0, 1.0, 1.0], 1.0) - (1.0 + 1.0 / 3f32.sqrt())).abs() < 1e-6);
    }
}
