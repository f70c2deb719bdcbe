//! Clusters of sixteen triangles: the exact distances of a point from all of them at once, and a box that tells which
//! clusters are near.
//!
//! In the frame of a triangle (its first edge, the direction square to that in its plane, its normal) a voxel has the
//! coordinates u, w and s, affine in its position, and the triangle has the corners (0, 0), (l, 0) and (p, q) with q > 0. The
//! squared distance is s² within the three edges, else s² plus the least square of the planar distances from the edges. All of
//! these are affine maps and rotations of lengths of a few voxels, so that f32 suffices: the error is below 1e-6 voxels
//! at a distance of a few voxels and grows in proportion to it.
//!
//! The box of a cluster is turned to its mean normal: on a smooth surface it is thin, and a voxel is near to few of them.
//! Boxes are wider by [`SLACK`] than what they hold, and decide only which triangles are looked at: rounding in them does
//! not reach a result.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};
use glam::Vec3;

use crate::stencil::simd::{Lanes, Work, dispatch};

/// Triangles of a cluster, and boxes of a group.
pub(super) const WIDTH: usize = 16;

/// What boxes are wider by on each side, in voxels: far above the rounding of f32 for coordinates up to a few hundred.
pub(super) const SLACK: f32 = 1e-3;

/// Triangles of one cluster come from cells at most this far apart, in voxels: else its box would be large and almost empty.
const SPREAD: f32 = 3.0;

type Sixteen = [f32; WIDTH];

/// Sixteen triangles, a lane each.
#[repr(C, align(64))]
pub(super) struct Cluster {
    /// Gradient of each of the coordinates u, w and s, and its value at `base`.
    coordinates: [[Sixteen; 4]; 3],
    /// Length of the first edge.
    length: Sixteen,
    /// Of the second edge from its start (l, 0), and of the third one from (0, 0): cosine, sine and length.
    edges: [[Sixteen; 3]; 2],
    /// A voxel nearby.
    base: Vec3,
}

impl Cluster {
    /// Squares of the distances from `N` voxels in a row along z, by voxel.
    #[inline(always)]
    fn distances_squared<S: Simd, const N: usize>(&self, simd: S, first: Vec3) -> [Lanes<S>; N] {
        macro_rules! lanes {
            ($values:expr) => {
                Lanes::from_slice(simd, &$values[..])
            };
        }
        let from_base = first - self.base;
        let x = Lanes::splat(simd, from_base.x);
        let y = Lanes::splat(simd, from_base.y);
        let z = Lanes::splat(simd, from_base.z);
        macro_rules! coordinate {
            ($of:expr) => {
                (lanes!($of[0]) * x + lanes!($of[1]) * y) + (lanes!($of[2]) * z + lanes!($of[3]))
            };
        }
        let zero = Lanes::splat(simd, 0.0);
        let length = lanes!(self.length);
        let [[cos1, sin1, length1], [cos2, sin2, length2]] = &self.edges;
        let (cos1, sin1, length1) = (lanes!(cos1), lanes!(sin1), lanes!(length1));
        let (cos2, sin2, length2) = (lanes!(cos2), lanes!(sin2), lanes!(length2));
        // All coordinates at the first voxel, and their steps from one to the next.
        let mut u = coordinate!(self.coordinates[0]);
        let mut w = coordinate!(self.coordinates[1]);
        let mut s = coordinate!(self.coordinates[2]);
        let step_u = lanes!(self.coordinates[0][2]);
        let step_w = lanes!(self.coordinates[1][2]);
        let step_s = lanes!(self.coordinates[2][2]);
        let from_end = u - length;
        let (mut along1, mut across1) = (from_end * cos1 + w * sin1, w * cos1 - from_end * sin1);
        let (step_along1, step_across1) = (step_u * cos1 + step_w * sin1, step_w * cos1 - step_u * sin1);
        let (mut along2, mut across2) = (u * cos2 + w * sin2, u * sin2 - w * cos2);
        let (step_along2, step_across2) = (step_u * cos2 + step_w * sin2, step_u * sin2 - step_w * cos2);
        let mut squares = [zero; N];
        for (k, square) in squares.iter_mut().enumerate() {
            if k > 0 {
                (u, w, s) = (u + step_u, w + step_w, s + step_s);
                (along1, across1) = (along1 + step_along1, across1 + step_across1);
                (along2, across2) = (along2 + step_along2, across2 + step_across2);
            }
            let past = u - u.max(zero).min(length);
            let past1 = along1 - along1.max(zero).min(length1);
            let past2 = along2 - along2.max(zero).min(length2);
            let outside =
                (w * w + past * past).min(across1 * across1 + past1 * past1).min(across2 * across2 + past2 * past2);
            let inwards = w.min(across1).min(across2);
            *square = s * s + inwards.simd_ge(zero).select(zero, outside);
        }
        squares
    }
}

/// A turned box around a cluster: the points whose coordinates along three axes are within `half` of `middle`.
struct TurnedBox {
    axes: [Vec3; 3],
    middle: Vec3,
    half: Vec3,
}

/// Sixteen boxes and the clusters in them.
#[repr(C, align(64))]
#[derive(Clone)]
struct BoxGroup {
    /// By axis: direction, middle, half width.
    axes: [[Sixteen; 5]; 3],
    cluster: [u32; WIDTH],
}

impl BoxGroup {
    /// Boxes at no finite distance.
    const NONE: Self = {
        let mut group = Self { axes: [[[0.0; WIDTH]; 5]; 3], cluster: [0; WIDTH] };
        group.axes[0][4] = [-1e15; WIDTH];
        group
    };

    /// Squares of the distances from `N` voxels in a row along z, by voxel.
    #[inline(always)]
    fn distances_squared<S: Simd, const N: usize>(&self, simd: S, first: Vec3) -> [Lanes<S>; N] {
        let x = Lanes::splat(simd, first.x);
        let y = Lanes::splat(simd, first.y);
        let z = Lanes::splat(simd, first.z);
        let zero = Lanes::splat(simd, 0.0);
        let mut squares = [zero; N];
        for [ax, ay, az, middle, half] in &self.axes {
            let step = Lanes::from_slice(simd, az);
            let from_middle = (Lanes::from_slice(simd, ax) * x + Lanes::from_slice(simd, ay) * y)
                + (step * z - Lanes::from_slice(simd, middle));
            let half = Lanes::from_slice(simd, half);
            for (k, square) in squares.iter_mut().enumerate() {
                let beyond = ((from_middle + step * k as f32).abs() - half).max(zero);
                *square += beyond * beyond;
            }
        }
        squares
    }
}

/// Clusters, known by their boxes.
#[derive(Default)]
pub(super) struct Candidates {
    groups: Vec<BoxGroup>,
    count: usize,
}

impl Candidates {
    pub fn clear(&mut self) {
        self.groups.clear();
        self.count = 0;
    }

    /// A free lane at the end.
    fn append(&mut self, cluster: u32) -> Option<(&mut BoxGroup, usize)> {
        let lane = self.count % WIDTH;
        if lane == 0 {
            self.groups.push(BoxGroup::NONE);
        }
        self.count += 1;
        let group = self.groups.last_mut()?;
        group.cluster[lane] = cluster;
        Some((group, lane))
    }

    fn push(&mut self, of: &TurnedBox, cluster: u32) {
        let Some((group, lane)) = self.append(cluster) else { return };
        for (axis, values) in group.axes.iter_mut().enumerate() {
            let direction = of.axes[axis];
            let column = [direction.x, direction.y, direction.z, of.middle[axis], of.half[axis]];
            values.iter_mut().zip(column).for_each(|(values, value)| values[lane] = value);
        }
    }

    #[inline(always)]
    fn copy(&mut self, from: &BoxGroup, lane: usize) {
        let Some((group, to)) = self.append(from.cluster[lane]) else { return };
        for (values, sources) in group.axes.iter_mut().zip(&from.axes) {
            for (value, source) in values.iter_mut().zip(sources) {
                value[to] = source[lane];
            }
        }
    }
}

/// Triangles on their way into clusters. Coordinates are voxels about an origin nearby.
#[derive(Default)]
pub(super) struct Clusters {
    all: Vec<Cluster>,
    /// All of them, by their boxes.
    pub boxes: Candidates,
    /// The triangles of the next cluster: by corner, then axis; relative to its base.
    corners: [[Sixteen; 3]; 3],
    count: usize,
    base: Vec3,
}

impl Clusters {
    /// What a triangle needs at most, on average, in bytes.
    pub const BYTES_A_TRIANGLE: u64 = ((size_of::<Cluster>() + 2 * size_of::<BoxGroup>() / WIDTH) / WIDTH) as u64 + 1;

    pub fn clear(&mut self) {
        self.all.clear();
        self.boxes.clear();
        self.count = 0;
    }

    /// Adds the triangle with `corners` relative to `voxel`. Triangles that follow each other should be neighbours.
    ///
    /// It must have an area: 1e-5 voxels or more in height.
    pub fn push(&mut self, voxel: Vec3, corners: [Vec3; 3]) {
        if (voxel - self.base).abs().max_element() > SPREAD {
            self.finish();
        }
        if self.count == 0 {
            self.base = voxel;
        }
        let shift = voxel - self.base;
        for (values, corner) in self.corners.iter_mut().zip(corners) {
            let corner = corner + shift;
            for (axis, values) in values.iter_mut().enumerate() {
                values[self.count] = corner[axis];
            }
        }
        self.count += 1;
        if self.count == WIDTH {
            self.finish();
        }
    }

    /// Closes the last cluster. Free lanes repeat its first triangle.
    pub fn finish(&mut self) {
        if self.count == 0 {
            return;
        }
        for values in self.corners.iter_mut().flatten() {
            let first = values[0];
            values[self.count..].fill(first);
        }
        self.count = 0;
        dispatch(Enclose { clusters: self });
    }
}

/// Makes a cluster and its box of the triangles collected.
struct Enclose<'a> {
    clusters: &'a mut Clusters,
}

impl Work for Enclose<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Clusters { all, boxes, corners, base, .. } = self.clusters;
        macro_rules! lanes {
            ($values:expr) => {
                Lanes::from_slice(simd, &$values[..])
            };
        }
        macro_rules! vector {
            ($corner:expr) => {
                [lanes!(corners[$corner][0]), lanes!(corners[$corner][1]), lanes!(corners[$corner][2])]
            };
        }
        let (a, b, c) = (vector!(0), vector!(1), vector!(2));
        let first = minus(b, a);
        let third = minus(c, a);
        let length = dot(first, first).sqrt();
        let one = Lanes::splat(simd, 1.0);
        let along = times(first, one / length);
        let p = dot(third, along);
        // Twice: what is left of the first edge after once is as large as rounding, and so is the height of a thin triangle.
        let mut across = minus(third, times(along, p));
        across = minus(across, times(along, dot(across, along)));
        let q = dot(across, across).sqrt();
        let across = times(across, one / q);
        let normal = [
            along[1] * across[2] - along[2] * across[1],
            along[2] * across[0] - along[0] * across[2],
            along[0] * across[1] - along[1] * across[0],
        ];
        let mut cluster = Cluster {
            coordinates: [[[0.0; WIDTH]; 4]; 3],
            length: [0.0; WIDTH],
            edges: [[[0.0; WIDTH]; 3]; 2],
            base: *base,
        };
        for (coordinate, gradient) in cluster.coordinates.iter_mut().zip([along, across, normal]) {
            let [x, y, z, at] = coordinate;
            gradient[0].store_slice(x);
            gradient[1].store_slice(y);
            gradient[2].store_slice(z);
            (-dot(gradient, a)).store_slice(at);
        }
        length.store_slice(&mut cluster.length);
        for ([cos, sin, size], run) in cluster.edges.iter_mut().zip([p - length, p]) {
            let hypotenuse = (run * run + q * q).sqrt();
            (run / hypotenuse).store_slice(cos);
            (q / hypotenuse).store_slice(sin);
            hypotenuse.store_slice(size);
        }
        // The normals by area: thin triangles have any direction.
        let area = length * q;
        let mean = Vec3::new(
            (normal[0] * area).reduce_sum(),
            (normal[1] * area).reduce_sum(),
            (normal[2] * area).reduce_sum(),
        );
        let axes = axes_about(mean);
        let (mut middle, mut half) = (Vec3::ZERO, Vec3::ZERO);
        for (k, axis) in axes.into_iter().enumerate() {
            let axis_lanes = [Lanes::splat(simd, axis.x), Lanes::splat(simd, axis.y), Lanes::splat(simd, axis.z)];
            let (at_a, at_b, at_c) = (dot(a, axis_lanes), dot(b, axis_lanes), dot(c, axis_lanes));
            let lo = at_a.min(at_b).min(at_c).reduce_min();
            let hi = at_a.max(at_b).max(at_c).reduce_max();
            middle[k] = (lo + hi) / 2.0 + axis.dot(*base);
            half[k] = (hi - lo) / 2.0 + SLACK;
        }
        boxes.push(&TurnedBox { axes, middle, half }, all.len() as u32);
        all.push(cluster);
    }
}

#[inline(always)]
fn dot<S: Simd>(a: [Lanes<S>; 3], b: [Lanes<S>; 3]) -> Lanes<S> {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn minus<S: Simd>(a: [Lanes<S>; 3], b: [Lanes<S>; 3]) -> [Lanes<S>; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn times<S: Simd>(a: [Lanes<S>; 3], factor: Lanes<S>) -> [Lanes<S>; 3] {
    [a[0] * factor, a[1] * factor, a[2] * factor]
}

/// Three axes square to each other, the first along `direction`, the second as near to a lattice axis as can be.
fn axes_about(direction: Vec3) -> [Vec3; 3] {
    let normal = direction.try_normalize().unwrap_or(Vec3::X);
    let (_, least) = normal
        .to_array()
        .into_iter()
        .enumerate()
        .fold((f32::INFINITY, 0), |(small, at), (k, v)| if v.abs() < small { (v.abs(), k) } else { (small, at) });
    let lattice = Vec3::AXES[least];
    // The least component is at most 1/√3: what is left has a length.
    let second = (lattice - normal * normal.dot(lattice)).normalize();
    [normal, second, normal.cross(second)]
}

/// Squares of the distances of `N`³ voxels, a voxel apart, from the nearest triangle of the candidates, each up to a limit.
pub(super) struct Query<'a, const N: usize> {
    pub candidates: &'a Candidates,
    pub clusters: &'a Clusters,
    /// The first voxel.
    pub first: Vec3,
    /// Clusters that are likely near; afterwards those nearest to the first and the last voxel of the last row.
    pub guesses: &'a mut [u32; 2],
    /// The squares of the limits, by rows along z; afterwards the result.
    pub squared: &'a mut [[f32; N]],
}

impl<const N: usize> Work for Query<'_, N> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        for step in 0..N * N {
            // There and back, so that each row is beside the last one.
            let (x, y) = (step / N, step % N);
            let y = if x % 2 == 0 { y } else { N - 1 - y };
            let row = x * N + y;
            let first = self.first + Vec3::new(x as f32, y as f32, 0.0);
            let Some(&limits) = self.squared.get(row) else { return };
            let squares = self.row(simd, first, limits);
            self.squared[row] = squares;
        }
    }
}

impl<const N: usize> Query<'_, N> {
    /// A row at a time, so that the work on one voxel goes on while the others wait for results.
    #[inline(always)]
    fn row<S: Simd>(&mut self, simd: S, first: Vec3, limits: [f32; N]) -> [f32; N] {
        let clusters = &self.clusters.all;
        let [of_first, of_last] = *self.guesses;
        let mut best = [Lanes::splat(simd, 0.0); N];
        for k in 0..N {
            best[k] = Lanes::splat(simd, limits[k]);
        }
        // By lane, what is nearest to the first and to the last voxel. As f32, which names the first 2²⁴ exactly: more than a tile has, and guesses need not hold.
        let mut nearest = [Lanes::splat(simd, of_first as f32), Lanes::splat(simd, of_last as f32)];
        macro_rules! look_at {
            ($of:expr) => {
                if let Some(cluster) = clusters.get($of as usize) {
                    let squares = cluster.distances_squared::<S, N>(simd, first);
                    let this = Lanes::splat(simd, $of as f32);
                    nearest[0] = squares[0].simd_lt(best[0]).select(this, nearest[0]);
                    nearest[1] = squares[N - 1].simd_lt(best[N - 1]).select(this, nearest[1]);
                    for k in 0..N {
                        best[k] = best[k].min(squares[k]);
                    }
                }
            };
        }
        // Good distances from the start spare the look at most of the others.
        look_at!(of_first);
        if of_last != of_first {
            look_at!(of_last);
        }
        let mut bounds = best;
        for k in 0..N {
            bounds[k] = Lanes::splat(simd, best[k].reduce_min());
        }
        for group in &self.candidates.groups {
            let boxes = group.distances_squared::<S, N>(simd, first);
            let mut near = 0;
            for k in 0..N {
                near |= boxes[k].simd_lt(bounds[k]).to_bitmask();
            }
            while near != 0 {
                let lane = near.trailing_zeros() as usize;
                near &= near - 1;
                let of = group.cluster[lane % WIDTH];
                if of != of_first && of != of_last {
                    look_at!(of);
                }
            }
        }
        let mut result = [0.0; N];
        for k in 0..N {
            result[k] = best[k].reduce_min();
        }
        for (k, (guess, nearest)) in [0, N - 1].into_iter().zip(self.guesses.iter_mut().zip(nearest)) {
            let lane = best[k].simd_le(Lanes::splat(simd, result[k])).to_bitmask().trailing_zeros();
            let mut of = [0.0; WIDTH];
            nearest.store_slice(&mut of);
            *guess = of[lane as usize % WIDTH] as u32;
        }
        result
    }
}

/// Copies the candidates whose box is not farther than `reach` from `centre`.
pub(super) struct Nearby<'a> {
    pub from: &'a Candidates,
    pub to: &'a mut Candidates,
    pub centre: Vec3,
    pub reach: f32,
}

impl Work for Nearby<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.to.clear();
        let bound = Lanes::splat(simd, self.reach * self.reach);
        for group in &self.from.groups {
            let [boxes] = group.distances_squared::<S, 1>(simd, self.centre);
            let mut near = boxes.simd_le(bound).to_bitmask();
            while near != 0 {
                let lane = near.trailing_zeros() as usize;
                near &= near - 1;
                self.to.copy(group, lane % WIDTH);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::mesh::closest::closest_on_triangle;
    use crate::mesh::testing::noise;

    fn point(seed: usize, scale: f32) -> Vec3 {
        Vec3::new(noise(3 * seed) as f32 - 0.5, noise(3 * seed + 1) as f32 - 0.5, noise(3 * seed + 2) as f32 - 0.5)
            * scale
    }

    /// Down to the thinnest and smallest triangles that marching can make.
    fn triangles() -> Vec<[Vec3; 3]> {
        (0..400)
            .map(|i| {
                let size = [2.0, 1.0, 0.1, 1e-3][i % 4];
                let a = point(10 * i, 2.0);
                let b = a + point(10 * i + 1, size);
                let height = [1.0, 1e-2, 1e-4][i / 4 % 3];
                [a, b, a.lerp(b, noise(i) as f32 * 1.5) + point(10 * i + 2, 1.0).normalize() * height]
            })
            .collect()
    }

    #[test]
    fn distances_are_those_to_the_nearest_triangle() {
        let triangles = triangles();
        let mut clusters = Clusters::default();
        for t in &triangles {
            clusters.push(Vec3::ZERO, *t);
        }
        clusters.finish();
        let distance = |p: DVec3| {
            let to = |t: &[Vec3; 3]| closest_on_triangle(p, t.map(|c| c.as_dvec3())).distance(p);
            triangles.iter().map(to).fold(f64::INFINITY, f64::min)
        };
        for i in 0..100 {
            let voxel = (point(7919 * i, 16.0)).round();
            let mut squared = [[1e6; 4]; 16];
            dispatch(Query {
                candidates: &clusters.boxes,
                clusters: &clusters,
                first: voxel,
                guesses: &mut [0; 2],
                squared: &mut squared,
            });
            for (row, squares) in squared.iter().enumerate() {
                for (z, squared) in squares.iter().enumerate() {
                    let p = voxel.as_dvec3() + DVec3::new((row / 4) as f64, (row % 4) as f64, z as f64);
                    let truth = distance(p);
                    let error = (f64::from(squared.sqrt()) - truth).abs();
                    assert!(error < 1e-6 * (1.0 + truth), "{p}: {} {truth}", squared.sqrt());
                }
            }
        }
    }

    #[test]
    fn candidates_are_those_within_reach_by_their_boxes() {
        let mut clusters = Clusters::default();
        for i in 0..200 {
            let voxel = point(31 * i, 40.0).round();
            for t in triangles().iter().take(16) {
                clusters.push(voxel, *t);
            }
        }
        let mut list = Candidates::default();
        let centre = Vec3::new(1.0, -2.0, 0.5);
        for reach in [0.0, 4.0, 12.0, 60.0] {
            dispatch(Nearby { from: &clusters.boxes, to: &mut list, centre, reach });
            let kept: Vec<u32> = list.groups.iter().flat_map(|g| g.cluster).take(list.count).collect();
            assert!(kept.is_sorted());
            for i in 0..200usize {
                // The triangles lie within 4 voxels of theirs.
                let distance = point(31 * i, 40.0).round().distance(centre);
                let found = kept.contains(&(i as u32));
                assert!(found || distance > reach - 4.0, "{i} is at {distance}");
                assert!(!found || distance < reach + 8.0, "{i} is at {distance}");
            }
        }
    }
}
