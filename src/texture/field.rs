//! Distances from a surface all over the space above a patch.
//!
//! The band of the base knows them near the surface. Beyond, they are found at the nodes of a lattice, so coarse that there is a bounded number of
//! nodes in the space: the farther a level is from the surface, the smoother it is. A node's distance is that of its closest point: from the
//! nearest of many points of the surface the tangent plane leads on to it. Between nodes they are linear, which errs by up to g²κ/8 along an
//! axis, for a lattice of g voxels and levels of curvature κ: above a sharp edge, where that is large, there are more nodes.

use glam::DVec3;
use rayon::prelude::*;

use super::OPERATION;
use crate::error::Result;
use crate::grid::{LEAF_DIM, Transform, offset_to_local};
use crate::levelset::{LevelSet, Sampler};
use crate::run::RunOptions;

/// Nodes of the lattice above a patch, about, the same above a sharp edge, and where only the way back to the surface is asked for.
pub(super) const ABOVE: f64 = 120e3;
pub(super) const ABOVE_SHARP: f64 = 1e6;
pub(super) const GROUND: f64 = 30e3;

/// Edge of the blocks of voxels that get one point of the surface each, in voxels, for lattices up to twice as coarse as the base's and for coarser ones.
const BLOCK: [i32; 2] = [2, 4];

/// Distances around a patch. Positions and distances are in voxels of the base.
pub(super) struct Field {
    base: LevelSet,
    /// Place of the first node, edge of the lattice, nodes along each axis, their distances (z fastest).
    origin: DVec3,
    edge: f64,
    counts: [usize; 3],
    distances: Vec<f32>,
    /// Distances up to which the band of the base counts alone, and from which on it does not.
    seam: [f64; 2],
}

impl Field {
    /// In the box from `lo` to `hi`, on about so many nodes; `reach` is how far from it the surface may be that is nearest to a place in it.
    pub fn new(base: &LevelSet, (lo, hi): (DVec3, DVec3), reach: f64, nodes: f64, run: &RunOptions) -> Result<Self> {
        let edge = ((hi - lo).element_product() / nodes).cbrt().max(1.0);
        // On a lattice as fine as the base's, nodes are voxels.
        let origin = lo.floor();
        let counts = ((hi - origin) / edge).ceil().to_array().map(|n| n as usize + 2);
        let size = counts.iter().product::<usize>();
        run.reserve(OPERATION, size as u64 * 4, "take a smaller patch or height")?;
        let (grid, h) = (base.grid(), base.voxel_size());
        let samples = samples(base, lo - reach, hi + reach, BLOCK[usize::from(edge > 2.0)]);
        run.check(OPERATION)?;
        let mut nodes = Nodes { origin, edge, counts, samples: &samples, nearest: vec![NONE; size] };
        nodes.seed();
        nodes.sweep(run);
        let far = f64::from(base.half_width()) * 0.999;
        let mut distances = vec![f32::MAX; size];
        let slab = counts[1] * counts[2];
        distances.par_chunks_mut(slab.max(1)).enumerate().for_each(|(i, slab)| {
            if run.is_cancelled() {
                return;
            }
            let (mut sampler, mut accessor) = (base.sampler(), grid.accessor());
            for (k, value) in slab.iter_mut().enumerate() {
                let x = nodes.place([i, k / counts[2], k % counts[2]]);
                let known = f64::from(sampler.trilinear(x)) / h;
                *value = if known.abs() < far {
                    known as f32
                } else {
                    let side = f64::from(accessor.value(x.round().as_ivec3())).signum();
                    let foot = samples.get(nodes.nearest[i * counts[1] * counts[2] + k] as usize);
                    foot.map_or(f32::MAX, |p| (side * closest(*p, edge, &mut sampler, x).distance(x)) as f32)
                };
            }
        });
        run.check(OPERATION)?;
        let half_width = f64::from(base.half_width());
        let seam = [(half_width - 2.5).max(0.25), (half_width - 1.5).max(0.75)];
        Ok(Self { base: base.clone(), origin, edge, counts, distances, seam })
    }

    /// All around a level set, and `more` voxels.
    #[cfg(test)]
    pub fn around(base: &LevelSet, more: f64) -> Self {
        let (lo, hi) = base.grid().active_bounds().unwrap_or_default();
        Self::new(base, (lo.as_dvec3() - more, hi.as_dvec3() + more), 0.0, 1e9, &RunOptions::default()).unwrap()
    }

    /// Edge of the lattice beyond the band.
    pub fn coarseness(&self) -> f64 {
        self.edge
    }

    pub fn transform(&self) -> &Transform {
        self.base.transform()
    }

    /// Looks distances up, one after the other.
    pub fn lookup(&self) -> Lookup<'_> {
        Lookup { field: self, near: self.base.sampler(), scale: 1.0 / self.base.voxel_size() }
    }

    /// The node beside a level that is nearest to `x`.
    pub fn nearest_node(&self, height: f64, x: DVec3) -> Option<DVec3> {
        let mut best: Option<(f64, DVec3)> = None;
        for (k, &value) in self.distances.iter().enumerate() {
            if (f64::from(value) - height).abs() < self.edge {
                let node =
                    [k / (self.counts[1] * self.counts[2]), k / self.counts[2] % self.counts[1], k % self.counts[2]];
                let p = self.origin + DVec3::from_array(node.map(|n| n as f64)) * self.edge;
                let d = p.distance_squared(x);
                if best.is_none_or(|(least, _)| d < least) {
                    best = Some((d, p));
                }
            }
        }
        best.map(|(_, p)| p)
    }

    fn node(&self, i: usize, j: usize, k: usize) -> f64 {
        f64::from(self.distances[(i * self.counts[1] + j) * self.counts[2] + k])
    }

    /// The distance and its gradient on the lattice; beyond its border those of the border.
    fn far(&self, x: DVec3) -> (f64, DVec3) {
        let at = (x - self.origin) / self.edge;
        let cell: [(usize, f64); 3] = std::array::from_fn(|axis| {
            let t = at[axis].clamp(0.0, (self.counts[axis] - 1) as f64);
            let i = (t as usize).min(self.counts[axis] - 2);
            (i, t - i as f64)
        });
        let [(i, s), (j, t), (k, u)] = cell;
        let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let corner: [[f64; 2]; 4] = std::array::from_fn(|c| {
            let (i, j) = (i + (c >> 1), j + (c & 1));
            [self.node(i, j, k), self.node(i, j, k + 1)]
        });
        let z = corner.map(|[a, b]| lerp(a, b, u));
        let y = [lerp(z[0], z[1], t), lerp(z[2], z[3], t)];
        let dz = corner.map(|[a, b]| b - a);
        let gradient = DVec3::new(
            y[1] - y[0],
            lerp(z[1] - z[0], z[3] - z[2], s),
            lerp(lerp(dz[0], dz[1], t), lerp(dz[2], dz[3], t), s),
        );
        (lerp(y[0], y[1], s), gradient / self.edge)
    }
}

/// Points of the surface between `lo` and `hi`: of each block that it goes through, the one closest to the voxel that is nearest to it.
fn samples(base: &LevelSet, lo: DVec3, hi: DVec3, block: i32) -> Vec<DVec3> {
    let (grid, h) = (base.grid(), base.voxel_size());
    let blocks = LEAF_DIM / block;
    let of_leaves = grid.map_leaves(|id| {
        let origin = grid.origin(id);
        let outside = origin.as_dvec3().cmpgt(hi).any() || (origin + LEAF_DIM).as_dvec3().cmplt(lo).any();
        if outside {
            return Vec::new();
        }
        let mut nearest = vec![(h as f32, 0); blocks.pow(3) as usize];
        for offset in grid.mask(id).iter() {
            let at = offset_to_local(offset) / block;
            let best = &mut nearest[((at.x * blocks + at.y) * blocks + at.z) as usize];
            let away = grid.values(id).0[offset].abs();
            if away < best.0 {
                *best = (away, offset);
            }
        }
        let mut sampler = base.sampler();
        let found = nearest.into_iter().filter(|(away, _)| f64::from(*away) < h);
        found.filter_map(|(_, offset)| sampler.closest_point((origin + offset_to_local(offset)).as_dvec3())).collect()
    });
    of_leaves.concat()
}

/// The point of the surface closest to `x`: from a sample nearby along the tangent plane to where the normal leads to `x`.
fn closest(p: DVec3, edge: f64, sampler: &mut Sampler, x: DVec3) -> DVec3 {
    let normal = sampler.smooth_gradient(p).normalize_or_zero();
    let aside = (x - p) - normal * (x - p).dot(normal);
    let better = sampler.closest_point(p + aside.clamp_length_max(edge.max(f64::from(BLOCK[0])))).unwrap_or(p);
    if better.distance_squared(x) < p.distance_squared(x) { better } else { p }
}

/// No sample.
const NONE: u32 = u32::MAX;

/// The nodes of the lattice, each with the nearest sample that its neighbours know (Danielsson 1980): found by sweeping over all nodes in eight
/// directions, in time that is linear in their number.
struct Nodes<'a> {
    origin: DVec3,
    edge: f64,
    counts: [usize; 3],
    samples: &'a [DVec3],
    nearest: Vec<u32>,
}

impl Nodes<'_> {
    fn place(&self, node: [usize; 3]) -> DVec3 {
        self.origin + DVec3::from_array(node.map(|n| n as f64)) * self.edge
    }

    fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        (i * self.counts[1] + j) * self.counts[2] + k
    }

    /// Takes a sample for a node if it is nearer than the one it has.
    fn offer(&mut self, index: usize, place: DVec3, sample: u32) {
        let own = self.nearest[index];
        if sample == own || sample == NONE {
            return;
        }
        let away = |s: u32| self.samples[s as usize].distance_squared(place);
        if own == NONE || away(sample) < away(own) {
            self.nearest[index] = sample;
        }
    }

    /// The nodes around each sample.
    fn seed(&mut self) {
        for s in 0..self.samples.len() {
            let cell = ((self.samples[s] - self.origin) / self.edge).floor();
            let last = DVec3::from_array(self.counts.map(|n| n as f64 - 2.0));
            if cell.cmplt(DVec3::ZERO).any() || cell.cmpgt(last).any() {
                // It may be the nearest one of what is at the border.
                let node = cell.clamp(DVec3::ZERO, last + 1.0).to_array().map(|c| c as usize);
                self.offer(self.index(node), self.place(node), s as u32);
                continue;
            }
            let cell = cell.to_array().map(|c| c as usize);
            for c in 0..8 {
                let node = [cell[0] + (c >> 2), cell[1] + (c >> 1 & 1), cell[2] + (c & 1)];
                self.offer(self.index(node), self.place(node), s as u32);
            }
        }
    }

    fn sweep(&mut self, run: &RunOptions) {
        let strides = [self.counts[1] * self.counts[2], self.counts[2], 1];
        for direction in 0..8 {
            if run.is_cancelled() {
                return;
            }
            let forward: [bool; 3] = std::array::from_fn(|axis| direction >> axis & 1 == 0);
            let counts = self.counts;
            let along = |axis: usize, n: usize| if forward[axis] { n } else { counts[axis] - 1 - n };
            for a in 0..counts[0] {
                for b in 0..counts[1] {
                    for c in 0..counts[2] {
                        let node = [along(0, a), along(1, b), along(2, c)];
                        let (index, place) = (self.index(node), self.place(node));
                        for (axis, n) in [a, b, c].into_iter().enumerate() {
                            if n > 0 {
                                let before = if forward[axis] { index - strides[axis] } else { index + strides[axis] };
                                self.offer(index, place, self.nearest[before]);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// A look into a field.
pub(super) struct Lookup<'a> {
    field: &'a Field,
    near: Sampler<'a>,
    scale: f64,
}

impl Lookup<'_> {
    /// The part that the base's band has where its distance is `d`.
    fn part(&self, d: f64) -> f64 {
        let [inner, outer] = self.field.seam;
        ((outer - d.abs()) / (outer - inner)).clamp(0.0, 1.0)
    }

    /// The distance.
    pub fn value(&mut self, x: DVec3) -> f64 {
        let near = f64::from(self.near.trilinear(x)) * self.scale;
        let part = self.part(near);
        if part == 1.0 {
            return near;
        }
        let (far, _) = self.field.far(x);
        far + (near - far) * part
    }

    /// The distance and its gradient by differences in a cell.
    pub fn value_and_gradient(&mut self, x: DVec3) -> (f64, DVec3) {
        let (near, slope) = self.near.value_and_gradient(x);
        let near = f64::from(near) * self.scale;
        let part = self.part(near);
        if part == 1.0 {
            return (near, slope);
        }
        let (far, far_slope) = self.field.far(x);
        (far + (near - far) * part, far_slope.lerp(slope, part))
    }

    /// The gradient by central differences over a voxel of the lattice there.
    pub fn smooth_gradient(&mut self, x: DVec3) -> DVec3 {
        let near = f64::from(self.near.trilinear(x)) * self.scale;
        let part = self.part(near);
        if part == 1.0 {
            return self.near.smooth_gradient(x);
        }
        let edge = self.field.edge;
        let along =
            |axis: DVec3| (self.field.far(x + axis * edge).0 - self.field.far(x - axis * edge).0) / (2.0 * edge);
        let far = DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z));
        if part == 0.0 { far } else { far.lerp(self.near.smooth_gradient(x), part) }
    }

    /// First node and edge of the lattice that a level of this height shows on.
    pub fn lattice(&self, height: f64) -> (DVec3, f64) {
        if height.abs() < self.field.seam[0] { (DVec3::ZERO, 1.0) } else { (self.field.origin, self.field.edge) }
    }
}
