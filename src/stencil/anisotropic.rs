//! An anisotropic Gaussian whose axes follow the surface, as three one-dimensional passes.
//!
//! At each voxel the covariance is Σ = s₂²(I − nnᵀ) + s₁² nnᵀ: s₁ along the normal, s₂ along the surface (voxels). Σ = V D Vᵀ with V unit upper
//! triangular and D diagonal ([`factor`]; Geusebroek et al. 2003) needs no angles, and makes the filter three gathers along sheared axes:
//!
//! > F₁(x) = Σₖ g(k; d₁) F₀(x − k (1, 0, 0))
//! > F₂(x) = Σₖ g(k; d₂) F₁(x − k (v₁₂, 1, 0))   linear between voxels along x
//! > F₃(x) = Σₖ g(k; d₃) F₂(x − k (v₁₃, v₂₃, 1))  bilinear along x and y
//!
//! up to |k| = ⌈3d⌉. Interpolation between voxels at t adds a variance t(1 − t) a sample along its axis; what it adds to Σ is taken off
//! d₁, d₂ and v₁₂ beforehand. The weights are scaled so that their second moment is d², which truncated and sampled Gaussians miss by up to 14 %.
//! So each pass is F + d²/2 · Σ g (F₊ + F₋ − 2F)/Σ g k²: planes stay as they are, and the covariance of the whole is Σ to rounding.
//!
//! A pass with d below [`LEAST_SIGMA`] leaves its voxel as it is. Where n = 0 there is no axis: s₁ is taken for s₂.

use std::ops::{Add, Div, Mul, Neg, Sub};

use fearless_simd::{Select, Simd, SimdBase, SimdCombine, SimdFloat, SimdMask, f32x8, mask32x16};
use glam::IVec3;

use super::simd::Lanes;
use super::{FaceHalo, LeafHalo, cube::row_range};
use crate::grid::{Grid, LEAF_DIM, LeafId, LeafMask, LeafValues, Paged};

/// The largest standard deviation in voxels: its kernel reaches two leaves far.
pub const LARGEST_SIGMA: f32 = 5.0;
/// The smallest standard deviation that changes anything, in voxels: below, a sampled Gaussian is its middle sample.
pub const LEAST_SIGMA: f32 = 0.3;

/// Standard deviations up to which weights are taken.
const EXTENT: f32 = 3.0;
/// Below this |∇φ|², as a part of its value on a distance field, there is no normal.
const FLAT_SQUARED: f32 = 0.01;
/// Leaves along each axis that a window may reach into.
const LEAVES: i32 = 5;

/// Σ = V D Vᵀ with V unit upper triangular.
#[derive(Clone, Copy, Debug)]
pub struct Factors<T> {
    /// The diagonal of D: d₁², d₂², d₃².
    pub variances: [T; 3],
    /// v₁₂, v₁₃, v₂₃.
    pub shears: [T; 3],
}

/// The factors of Σ = `across` (I − nnᵀ) + `along` nnᵀ (variances) for a unit normal, or for none, n = 0.
#[inline(always)]
pub fn factor<T>(n: [T; 3], along: T, across: T) -> Factors<T>
where
    T: Copy + Add<Output = T> + Sub<Output = T> + Mul<Output = T> + Div<Output = T> + Neg<Output = T>,
{
    let q = across - along;
    let a = along + q * n[0] * n[0];
    let d3 = across - q * n[2] * n[2];
    Factors {
        variances: [along * across / a, across * a / d3, d3],
        shears: [-(q * n[0] * n[1] / a), -(q * n[0] * n[2] / d3), -(q * n[1] * n[2] / d3)],
    }
}

/// The axes along which the three passes gather, in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pass {
    /// Along x.
    First,
    /// Along y, sheared towards x.
    Second,
    /// Along z, sheared towards x and y.
    Third,
}

impl Pass {
    /// In the order in which they are applied.
    pub const ALL: [Self; 3] = [Self::First, Self::Second, Self::Third];
}

/// The kernels of 16 voxels.
pub struct Kernels<S: Simd> {
    /// Unit normals, 0 where there is none.
    pub normal: [Lanes<S>; 3],
    /// s₁² and s₂² in voxels².
    pub variances: [Lanes<S>; 2],
}

/// Unit normals of rows (x, y) and (x, y + 1) by central differences, 0 where φ is flat.
#[inline(always)]
pub fn normals<S: Simd>(simd: S, halo: &FaceHalo, x: usize, y: usize, voxel_size: f32) -> [Lanes<S>; 3] {
    // Twice the gradient in voxels; a macro, since a closure would not be inlined.
    macro_rules! difference {
        ($axis:literal) => {{
            let [before, after] = halo.beside(simd, x, y, $axis);
            (after - before) * (1.0 / voxel_size)
        }};
    }
    let [a, b, c] = [difference!(0), difference!(1), difference!(2)];
    let squared = a * a + b * b + c * c;
    let flat = Lanes::splat(simd, 4.0 * FLAT_SQUARED);
    let (zero, one) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0));
    let scale = squared.simd_gt(flat).select(one / squared.max(flat).sqrt(), zero);
    [a * scale, b * scale, c * scale]
}

/// A leaf and what its kernels read around it, for one pass.
pub struct Window {
    rim: usize,
    values: Vec<f32>,
}

impl Window {
    /// A buffer for kernels with standard deviations up to `sigma` voxels, at most [`LARGEST_SIGMA`].
    pub fn new(sigma: f32) -> Self {
        let rim = (EXTENT * sigma.clamp(LEAST_SIGMA, LARGEST_SIGMA)).ceil() as usize + 1;
        let length = 8 + 2 * rim;
        Self { rim, values: vec![0.0; length * length * length] }
    }

    /// Voxels along z in the buffer: kernels of the last pass alone reach beyond the leaf there.
    #[inline(always)]
    fn depth(&self, pass: Pass) -> usize {
        if pass == Pass::Third { 8 + 2 * self.rim } else { 8 }
    }

    /// Rows along y in the buffer.
    #[inline(always)]
    fn rows(&self, pass: Pass) -> usize {
        if pass == Pass::First { 8 } else { 8 + 2 * self.rim }
    }

    /// Copies what the kernels of `voxels` of a leaf may read.
    #[inline(always)]
    fn gather(&mut self, pass: Pass, grid: &Grid, values: &Paged<LeafValues>, id: LeafId, voxels: LeafMask) {
        let Some((slabs, lines)) = extent(voxels) else { return };
        let (rim, rows, depth) = (self.rim, self.rows(pass), self.depth(pass));
        let rim_y = if pass == Pass::First { 0 } else { rim };
        let rim_z = if pass == Pass::Third { rim } else { 0 };
        let origin = grid.origin(id);
        let mut leaves = [LeafId::OUTSIDE; (LEAVES * LEAVES * LEAVES) as usize];
        let reach = |rim: usize| (rim as i32 + LEAF_DIM - 1) / LEAF_DIM;
        for i in -reach(rim)..=reach(rim) {
            for j in -reach(rim_y)..=reach(rim_y) {
                for k in -reach(rim_z)..=reach(rim_z) {
                    let offset = IVec3::new(i, j, k);
                    leaves[place(offset)] =
                        if offset == IVec3::ZERO { id } else { grid.find(origin + offset * LEAF_DIM) };
                }
            }
        }
        // From here on everything is counted from the rim.
        for x in slabs.0..=slabs.1 + 2 * rim {
            let (i, from_x) = split(x, rim);
            for y in lines.0..=lines.1 + 2 * rim_y {
                let (j, from_y) = split(y, rim_y);
                let at = from_x * 64 + from_y * 8;
                let row = &mut self.values[(x * rows + y) * depth..][..depth];
                let source = |k: i32| &values.get(leaves[place(IVec3::new(i, j, k))]).0[at..at + 8];
                if rim_z == 0 {
                    row.copy_from_slice(source(0));
                    continue;
                }
                row[rim_z..rim_z + 8].copy_from_slice(source(0));
                let (near, beyond) = (rim_z.min(8), rim_z.saturating_sub(8));
                row[beyond..rim_z].copy_from_slice(&source(-1)[8 - near..]);
                row[rim_z + 8..rim_z + 8 + near].copy_from_slice(&source(1)[..near]);
                if beyond > 0 {
                    row[..beyond].copy_from_slice(&source(-2)[8 - beyond..]);
                    row[rim_z + 16..].copy_from_slice(&source(2)[..beyond]);
                }
            }
        }
    }

    /// Rows (x, y) and (x, y + 1) of the leaf, shifted.
    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, pass: Pass, x: usize, y: usize, [dx, dy, dz]: [isize; 3]) -> Lanes<S> {
        let (rim, rows, depth) = (self.rim, self.rows(pass), self.depth(pass));
        let x = (x + rim).wrapping_add_signed(dx);
        match pass {
            Pass::First => Lanes::from_slice(simd, &self.values[(x * rows + y) * depth..][..16]),
            Pass::Second => {
                let y = (y + rim).wrapping_add_signed(dy);
                Lanes::from_slice(simd, &self.values[(x * rows + y) * depth..][..16])
            }
            Pass::Third => {
                let y = (y + rim).wrapping_add_signed(dy);
                let at = (x * rows + y) * depth + rim.wrapping_add_signed(dz);
                let [first, second] = [&self.values[at..at + 8], &self.values[at + depth..at + depth + 8]];
                f32x8::from_slice(simd, first).combine(f32x8::from_slice(simd, second))
            }
        }
    }
}

/// The first and the last slab along x and row along y with a voxel.
#[inline(always)]
fn extent(voxels: LeafMask) -> Option<((usize, usize), (usize, usize))> {
    let any = voxels.0.iter().fold(0, |any, word| any | word);
    let (first, last) = row_range(any)?;
    let slabs = (voxels.0.iter().position(|w| *w != 0)?, voxels.0.iter().rposition(|w| *w != 0)?);
    // Rows are computed in pairs.
    Some((slabs, (first & !1, last | 1)))
}

/// The leaf, relative to the one in the middle, and the place in it of a coordinate counted from the rim.
#[inline(always)]
fn split(at: usize, rim: usize) -> (i32, usize) {
    let at = at as i32 - rim as i32;
    (at.div_euclid(LEAF_DIM), at.rem_euclid(LEAF_DIM) as usize)
}

#[inline(always)]
fn place(offset: IVec3) -> usize {
    let at = offset + LEAVES / 2;
    ((at.x * LEAVES + at.y) * LEAVES + at.z) as usize
}

/// One pass over `voxels` of a leaf: reads `values`, the field as the passes before left it, writes `out`, of which other voxels than these are not
/// changed. `kernels` gives those of two rows.
#[inline(always)]
pub fn filter_leaf<S: Simd>(
    simd: S,
    pass: Pass,
    window: &mut Window,
    (grid, values): (&Grid, &Paged<LeafValues>),
    (id, voxels): (LeafId, LeafMask),
    kernels: impl Fn(usize, usize) -> Kernels<S>,
    out: &mut LeafValues,
) {
    window.gather(pass, grid, values, id, voxels);
    let window = &*window;
    voxels.for_each_pair(
        #[inline(always)]
        |x, y, bits| {
            let at = x * 64 + y * 8;
            let Kernels { normal, variances: [along, across] } = kernels(x, y);
            // Without a normal there is no direction to be wide in.
            let [a, b, c] = normal;
            let is_flat = (a * a + b * b + c * c).simd_eq(Lanes::splat(simd, 0.0));
            let least = Lanes::splat(simd, TINY);
            let along = along.max(least);
            let across = is_flat.select(along, across.max(least));
            let factors = factor(normal, along, across);
            let found = match pass {
                Pass::First => first(simd, window, x, y, bits, &factors),
                Pass::Second => second(simd, window, x, y, bits, &factors),
                Pass::Third => third(simd, window, x, y, bits, &factors),
            };
            let before = window.load(simd, pass, x, y, [0; 3]);
            mask32x16::from_bitmask(simd, u64::from(bits)).select(found, before).store_slice(&mut out.0[at..at + 16]);
        },
    );
}

/// Keeps 0/0 from kernels of no width, in voxels².
const TINY: f32 = 1e-4;

#[inline(always)]
fn first<S: Simd>(simd: S, window: &Window, x: usize, y: usize, bits: u16, factors: &Factors<Lanes<S>>) -> Lanes<S> {
    let [d1, d2, d3] = factors.variances;
    let [v12, v13, v23] = factors.shears;
    // What the passes to come will add along x, by shear and by interpolation.
    let (second, v12_kept) = second_factors(simd, window, bits, d2, d3, v12, v23);
    let added = interpolation(simd, window, bits, second, v12_kept) + interpolation(simd, window, bits, d3, v13);
    let variance = d1 + v12 * v12 * d2 - v12_kept * v12_kept * second - added;
    let centre = window.load(simd, Pass::First, x, y, [0; 3]);
    let mut taps = Taps::new(simd, variance, Lanes::splat(simd, 0.0), window.rim);
    let mut sum = Lanes::splat(simd, 0.0);
    for k in 1..=window.rim as isize {
        let Some(weight) = taps.next(simd, bits) else { break };
        let (before, after) =
            (window.load(simd, Pass::First, x, y, [-k, 0, 0]), window.load(simd, Pass::First, x, y, [k, 0, 0]));
        sum += weight * ((before - centre) + (after - centre));
    }
    taps.result(simd, centre, sum)
}

#[inline(always)]
fn second<S: Simd>(simd: S, window: &Window, x: usize, y: usize, bits: u16, factors: &Factors<Lanes<S>>) -> Lanes<S> {
    let [_, d2, d3] = factors.variances;
    let [v12, _, v23] = factors.shears;
    let (variance, v12) = second_factors(simd, window, bits, d2, d3, v12, v23);
    let centre = window.load(simd, Pass::Second, x, y, [0; 3]);
    let mut taps = Taps::new(simd, variance, v12, window.rim);
    let range = range(v12, bits);
    let mut sum = Lanes::splat(simd, 0.0);
    for k in 1..=window.rim as isize {
        let Some(weight) = taps.next(simd, bits) else { break };
        let shift = v12 * k as f32;
        let mut sample = Lanes::splat(simd, 0.0);
        for i in cells(range, k, window.rim) {
            let before = window.load(simd, Pass::Second, x, y, [-i, -k, 0]);
            let after = window.load(simd, Pass::Second, x, y, [i, k, 0]);
            sample += hat(simd, shift, i) * ((before - centre) + (after - centre));
        }
        sum += weight * sample;
    }
    taps.result(simd, centre, sum)
}

#[inline(always)]
fn third<S: Simd>(simd: S, window: &Window, x: usize, y: usize, bits: u16, factors: &Factors<Lanes<S>>) -> Lanes<S> {
    let [_, v13, v23] = factors.shears;
    let centre = window.load(simd, Pass::Third, x, y, [0; 3]);
    let mut taps = Taps::new(simd, factors.variances[2], v13.abs().max(v23.abs()), window.rim);
    let (range_x, range_y) = (range(v13, bits), range(v23, bits));
    let mut sum = Lanes::splat(simd, 0.0);
    for k in 1..=window.rim as isize {
        let Some(weight) = taps.next(simd, bits) else { break };
        let (shift_x, shift_y) = (v13 * k as f32, v23 * k as f32);
        let mut sample = Lanes::splat(simd, 0.0);
        for i in cells(range_x, k, window.rim) {
            let mut column = Lanes::splat(simd, 0.0);
            for j in cells(range_y, k, window.rim) {
                let before = window.load(simd, Pass::Third, x, y, [-i, -j, -k]);
                let after = window.load(simd, Pass::Third, x, y, [i, j, k]);
                column += hat(simd, shift_y, j) * ((before - centre) + (after - centre));
            }
            sample += hat(simd, shift_x, i) * column;
        }
        sum += weight * sample;
    }
    taps.result(simd, centre, sum)
}

/// d₂² less what the interpolation of the third pass adds along y, and the v₁₂ that keeps Σ₁₂.
#[inline(always)]
fn second_factors<S: Simd>(
    simd: S,
    window: &Window,
    bits: u16,
    d2: Lanes<S>,
    d3: Lanes<S>,
    v12: Lanes<S>,
    v23: Lanes<S>,
) -> (Lanes<S>, Lanes<S>) {
    let kept = (d2 - interpolation(simd, window, bits, d3, v23)).max(Lanes::splat(simd, LEAST_SIGMA * LEAST_SIGMA));
    // Not more than there was, where there was little.
    let kept = kept.min(d2);
    (kept, v12 * d2 / kept)
}

/// The variance that linear interpolation between voxels adds along an axis to a pass that is sheared towards it: Σ g t(1 − t).
#[inline(always)]
fn interpolation<S: Simd>(simd: S, window: &Window, bits: u16, variance: Lanes<S>, shear: Lanes<S>) -> Lanes<S> {
    let mut taps = Taps::new(simd, variance, shear, window.rim);
    let (zero, one) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0));
    let mut sum = zero;
    for k in 1..=window.rim as isize {
        let Some(weight) = taps.next(simd, bits) else { break };
        let t = shear * k as f32;
        let t = t - t.floor();
        sum += weight * t * (one - t) * 2.0;
    }
    taps.result(simd, zero, sum)
}

/// Sampled Gaussian weights g(k) for k = 1, 2, …, each the one before times a ratio that itself shrinks by a constant.
struct Taps<S: Simd> {
    variance: Lanes<S>,
    weight: Lanes<S>,
    ratio: Lanes<S>,
    shrink: Lanes<S>,
    /// Weights from here on are 0.
    end: Lanes<S>,
    k: f32,
    /// Σ g k² so far.
    moment: Lanes<S>,
}

impl<S: Simd> Taps<S> {
    /// For shears up to `shear` in magnitude; what they would read beyond the rim is left out.
    #[inline(always)]
    fn new(simd: S, variance: Lanes<S>, shear: Lanes<S>, rim: usize) -> Self {
        let least = Lanes::splat(simd, LEAST_SIGMA * LEAST_SIGMA);
        let zero = Lanes::splat(simd, 0.0);
        let wide = variance.simd_ge(least);
        let at_least = variance.max(least);
        let first = exponential(simd, Lanes::splat(simd, -0.5) / at_least);
        let shrink = first * first;
        // A voxel beyond ⌈3d⌉ − 1 is one beyond 3d; and ⌊k v⌋ + 1 stays within the rim.
        let most = Lanes::splat(simd, rim as f32) / shear.abs().max(Lanes::splat(simd, 1.0));
        let end = (at_least.sqrt() * EXTENT + 1.0).min(most);
        let end = wide.select(end, zero);
        Self { variance, weight: first, ratio: first * shrink, shrink, end, k: 0.0, moment: zero }
    }

    /// The next weight, `None` if it is 0 for all voxels of `bits`.
    #[inline(always)]
    fn next(&mut self, simd: S, bits: u16) -> Option<Lanes<S>> {
        self.k += 1.0;
        let live = self.end.simd_gt(self.k);
        if live.to_bitmask() & u64::from(bits) == 0 {
            return None;
        }
        let weight = live.select(self.weight, Lanes::splat(simd, 0.0));
        self.moment += weight * (self.k * self.k);
        self.weight *= self.ratio;
        self.ratio *= self.shrink;
        Some(weight)
    }

    /// `centre` + d²/2 · `sum`/Σ g k².
    #[inline(always)]
    fn result(&self, simd: S, centre: Lanes<S>, sum: Lanes<S>) -> Lanes<S> {
        let is_any = self.moment.simd_gt(Lanes::splat(simd, 0.0));
        let moved = centre + self.variance * sum * 0.5 / self.moment.max(Lanes::splat(simd, f32::MIN_POSITIVE));
        is_any.select(moved, centre)
    }
}

/// e^x for −6 < x ≤ 0: the series of e^(x/8) − 1, doubled thrice in a form that keeps its relative accuracy.
#[inline(always)]
fn exponential<S: Simd>(simd: S, x: Lanes<S>) -> Lanes<S> {
    let one = Lanes::splat(simd, 1.0);
    let t = x * 0.125;
    let mut series = one;
    for divisor in [8.0f32, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0] {
        series = one + t * series * (1.0 / divisor);
    }
    let mut less_one = t * series;
    for _ in 0..3 {
        less_one = less_one * (less_one + 2.0);
    }
    less_one + one
}

/// Least and largest of the voxels of `bits`.
#[inline(always)]
fn range<S: Simd>(values: Lanes<S>, bits: u16) -> [f32; 2] {
    let (mut least, mut largest) = (f32::INFINITY, f32::NEG_INFINITY);
    for (i, &v) in values.as_slice().iter().enumerate() {
        let is_in = bits >> i & 1 == 1;
        least = if is_in { least.min(v) } else { least };
        largest = if is_in { largest.max(v) } else { largest };
    }
    [least, largest]
}

/// The voxels between which samples shifted by k times a shear in `range` lie.
#[inline(always)]
fn cells(range: [f32; 2], k: isize, rim: usize) -> std::ops::RangeInclusive<isize> {
    let rim = rim as isize;
    let [low, high] = range.map(|v| (v * k as f32).floor() as isize);
    low.clamp(-rim, rim)..=high.saturating_add(1).clamp(-rim, rim)
}

/// The weight of voxel `i` in a sample at `at`.
#[inline(always)]
fn hat<S: Simd>(simd: S, at: Lanes<S>, i: isize) -> Lanes<S> {
    (Lanes::splat(simd, 1.0) - (at - i as f32).abs()).max(Lanes::splat(simd, 0.0))
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::grid::offset_to_local;
    use crate::stencil::simd::{Isa, Work, choose, dispatch};

    fn covariance(n: DVec3, s1: f64, s2: f64) -> DMat3 {
        let outer = DMat3::from_cols(n * n.x, n * n.y, n * n.z);
        (DMat3::IDENTITY - outer) * (s2 * s2) + outer * (s1 * s1)
    }

    /// Reproducible numbers in −1..1.
    fn random() -> impl FnMut() -> f64 {
        let mut state = 3u64;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        }
    }

    fn direction(random: &mut impl FnMut() -> f64) -> DVec3 {
        loop {
            let v = DVec3::new(random(), random(), random());
            if (0.01..1.0).contains(&v.length()) {
                return v.normalize();
            }
        }
    }

    fn largest(m: DMat3) -> f64 {
        m.to_cols_array().into_iter().fold(0.0, |a, v| a.max(v.abs()))
    }

    #[test]
    fn the_factors_make_up_the_covariance() {
        let mut random = random();
        for _ in 0..2000 {
            let n = direction(&mut random);
            let (a, b) = (1.75 + 1.25 * random(), 1.75 + 1.25 * random());
            let (s1, s2) = (a.min(b), a.max(b));
            let Factors { variances: d, shears: [v12, v13, v23] } = factor(n.to_array(), s1 * s1, s2 * s2);
            let v = DMat3::from_cols(DVec3::X, DVec3::new(v12, 1.0, 0.0), DVec3::new(v13, v23, 1.0));
            let product = v * DMat3::from_diagonal(DVec3::from(d)) * v.transpose();
            assert!(largest(product - covariance(n, s1, s2)) < 1e-12);
            // The general formulas for any covariance.
            let s = covariance(n, s1, s2).to_cols_array_2d();
            let general_d2 = s[1][1] - v23 * v23 * s[2][2];
            let general_v12 = (s[1][0] - v13 * v23 * s[2][2]) / general_d2;
            let general_d1 = s[0][0] - general_v12 * general_v12 * general_d2 - v13 * v13 * s[2][2];
            assert!((general_d1 - d[0]).abs() < 1e-12 && (general_v12 - v12).abs() < 1e-12);
            assert!(d.into_iter().all(|d| (s1 * s1 * (1.0 - 1e-12)..=s2 * s2 * (1.0 + 1e-12)).contains(&d)));
            // Of one width it is that width along each axis.
            let round = factor(n.to_array(), s1 * s1, s1 * s1);
            assert!(round.variances.into_iter().all(|d| (d - s1 * s1).abs() < 1e-12));
            assert!(round.shears.into_iter().all(|v| v == 0.0));
        }
    }

    /// A cube of 5³ leaves from voxel −16 on, all voxels active.
    fn grid(value: impl Fn(IVec3) -> f32 + Sync) -> Grid {
        let origins: Vec<_> = (0..125).map(|q| (IVec3::new(q / 25, q / 5 % 5, q % 5) - 2) * 8).collect();
        // Next to nothing beyond.
        let mut grid = Grid::from_origins(1e-20, &origins);
        // A fresh grid has its leaves in slot order.
        let first = grid.leaves()[0].index();
        grid.update_all(|id, values, mask| {
            let origin = origins[id.index() - first];
            for (at, v) in values.0.iter_mut().enumerate() {
                *v = value(origin + offset_to_local(at));
            }
            *mask = LeafMask::FULL;
        });
        grid
    }

    /// The three passes with one kernel at all voxels of `leaves`.
    fn filtered(grid: &Grid, normal: DVec3, [s1, s2]: [f32; 2], leaves: &[LeafId]) -> Paged<LeafValues> {
        struct One<'a>(Pass, &'a Grid, &'a Paged<LeafValues>, LeafId, [f32; 3], [f32; 2], &'a mut LeafValues);
        impl Work for One<'_> {
            #[inline(always)]
            fn run<S: Simd>(self, simd: S) {
                let Self(pass, grid, values, id, n, variances, out) = self;
                let mut window = Window::new(variances[1].sqrt());
                let kernels = |_: usize, _: usize| Kernels {
                    normal: n.map(|v| Lanes::splat(simd, v)),
                    variances: variances.map(|v| Lanes::splat(simd, v)),
                };
                filter_leaf(simd, pass, &mut window, (grid, values), (id, LeafMask::FULL), kernels, out);
            }
        }
        let mut current = grid.value_pages().clone();
        for pass in Pass::ALL {
            let mut next = current.clone();
            for &id in leaves {
                let n = normal.as_vec3().to_array();
                dispatch(One(pass, grid, &current, id, n, [s1 * s1, s2 * s2], next.get_mut(id)));
            }
            current = next;
        }
        current
    }

    #[test]
    fn an_impulse_spreads_as_its_covariance_says() {
        let mut random = random();
        let impulse = grid(|ijk| f32::from(u8::from(ijk == IVec3::splat(4))));
        let all = impulse.leaves().to_vec();
        for case in 0..50 {
            let n = direction(&mut random);
            let [s1, s2] = [[1.5f32, 2.25], [1.0, 1.5], [2.0, 3.0]][case % 3];
            let spread = filtered(&impulse, n, [s1, s2], &all);
            let (mut sum, mut second) = (0.0, [[0.0; 3]; 3]);
            for &id in &all {
                for (at, &v) in spread.get(id).0.iter().enumerate() {
                    let p = (impulse.origin(id) + offset_to_local(at) - 4).as_dvec3().to_array();
                    sum += f64::from(v);
                    for (i, row) in second.iter_mut().enumerate() {
                        row.iter_mut().zip(p).for_each(|(m, q)| *m += f64::from(v) * p[i] * q);
                    }
                }
            }
            let found = DMat3::from_cols_array_2d(&second) * (1.0 / sum);
            let wanted = covariance(n, s1.into(), s2.into());
            let norm = |m: DMat3| m.to_cols_array().into_iter().map(|v| v * v).sum::<f64>().sqrt();
            let error = norm(found - wanted) / norm(wanted);
            assert!(error < 0.01 && (sum - 1.0).abs() < 1e-4, "{n} {s1} {s2}: {error} {sum}");
        }
    }

    #[test]
    fn one_width_is_the_plain_separable_gaussian() {
        let noise = |ijk: IVec3| {
            let h = (ijk.x.wrapping_mul(73_856_093) ^ ijk.y.wrapping_mul(19_349_663) ^ ijk.z.wrapping_mul(83_492_791))
                as u32;
            (h.wrapping_mul(2_654_435_761) >> 8) as f32 / (1 << 24) as f32 - 0.5
        };
        let grid = grid(noise);
        for sigma in [0.31f32, 0.5, 1.0, 1.5, 2.0] {
            // Weights of second moment σ², in f64.
            let s = f64::from(sigma);
            let last = (3.0 * s).ceil() as i32;
            let g: Vec<f64> = (1..=last).map(|k| (-0.5 * f64::from(k * k) / (s * s)).exp()).collect();
            let moment: f64 = g.iter().zip(1..).map(|(g, k)| g * f64::from(k * k)).sum();
            let weight = |k: i32| match k {
                0 => 1.0 - g.iter().sum::<f64>() * s * s / moment,
                _ => g[k.unsigned_abs() as usize - 1] * s * s / (2.0 * moment),
            };
            let all = grid.leaves().to_vec();
            let mut random = random();
            let ours = filtered(&grid, direction(&mut random), [sigma; 2], &all);
            let id = grid.find(IVec3::ZERO);
            for at in (0..512).step_by(37) {
                let ijk = offset_to_local(at);
                let mut sum = 0.0;
                for i in -last..=last {
                    for j in -last..=last {
                        for k in -last..=last {
                            let w = weight(i) * weight(j) * weight(k);
                            sum += w * f64::from(noise(ijk + IVec3::new(i, j, k)));
                        }
                    }
                }
                // Rounding of f32 values below ½ over some 50 weights.
                assert!((f64::from(ours.get(id).0[at]) - sum).abs() < 1e-6, "{sigma} {ijk}");
            }
        }
    }

    #[test]
    fn planes_stay_and_every_instruction_set_gives_the_same_bits() {
        let n = DVec3::new(0.3, 0.5, -0.81);
        let plane = grid(|ijk| (n.dot(ijk.as_dvec3()) + 0.2) as f32);
        let middle = [plane.find(IVec3::ZERO)];
        let mut found = Vec::new();
        for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
            choose(isa);
            let ours = filtered(&plane, n.normalize(), [1.5, 2.25], &middle);
            found.push(ours.get(middle[0]).0.map(f32::to_bits));
            for (at, v) in ours.get(middle[0]).0.iter().enumerate() {
                let exact = n.dot(offset_to_local(at).as_dvec3()) + 0.2;
                // Values of up to 20 have the last bit at 2e-6; the passes average them.
                assert!((f64::from(*v) - exact).abs() < 3e-6, "{isa:?} {at}: {v} {exact}");
            }
        }
        choose(Isa::detect());
        assert!(found[0] == found[1] && found[0] == found[2]);
    }
}
