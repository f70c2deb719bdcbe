//! The implicit map: radial basis functions from places to (u, v, w) through the particles (Brodersen et al. 2007, section 3), evaluated near the
//! texture's surface only.
//!
//! A sum over all particles is taken at the nodes of a lattice of at most 0.7 of the particles' spacing and interpolated by Catmull and Rom's splines between them.
//! What particles in a block or beside it add is not interpolated but taken exactly, since |x − p| has a kink at p: the rest is smooth. Blocks without
//! the texture's surface are left out by their middle; where the interpolated value at the middle is off by more than a part of a voxel
//! of the texture, a block is divided, down to single voxels, which are summed exactly.

use std::sync::atomic::{AtomicU64, Ordering};

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use smallvec::SmallVec;

use super::OPERATION;
use super::leaves::{ADVICE, Found, Leaves, Made, block, closed, radius};
use super::space::Patch;
use super::wrap::{Probe, Solid, catmull_rom};
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, LEAF_VOXELS, leaf_origin};
use crate::rbf::{Basis, Interpolant};
use crate::run::RunOptions;

/// Which radial basis functions, and how smooth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rbf {
    /// Their shape; distances are in spacings of the particles.
    pub basis: Basis,
    /// Smoothing λ at particles on the surface, and above it.
    pub lambda: [f64; 2],
    /// Particles, about: the equations are dense.
    pub particles: u32,
}

/// Spacing of particles in voxels, at least.
const LEAST_SPACING: f64 = 3.0;

/// Lattice of nodes, as a part of the particles' spacing: few nodes, and few particles whose kinks are near.
const NODES: f64 = 0.7;

/// Largest error of the interpolation in the middle of a block, in voxels of the texture; elsewhere in it it is at most twice that.
const TOLERANCE: f64 = 0.05;

/// Where the map leads to a place that is farther than this from the one it was asked for, in spacings, it repeats itself.
const REPEATED: f64 = 1.5;

/// How far (u, v, w) are followed outside of 0..1, in spacings.
const AROUND: f64 = 1.5;

/// The map and how it is evaluated.
pub(super) struct Implicit<'a> {
    patch: &'a Patch,
    interpolant: Interpolant,
    spacing: f64,
    /// The box of (u, v, w) that it is asked in.
    domain: (DVec3, DVec3),
}

impl<'a> Implicit<'a> {
    pub fn new(patch: &'a Patch, rbf: Rbf) -> Result<Self> {
        let lengths = patch.lengths();
        let spacing = (lengths.element_product() / f64::from(rbf.particles.max(8))).cbrt().max(LEAST_SPACING);
        let count = |length: f64| ((length / spacing).round() as i32).max(2);
        let (nu, nv, nw) = (count(lengths.x), count(lengths.y), count(lengths.z));
        // One layer behind the surface, as far as the space goes.
        let behind = (patch.depth / lengths.z).min(1.0);
        let levels: Vec<f64> = std::iter::once(-behind).chain((0..=nw).map(|k| f64::from(k) / f64::from(nw))).collect();
        let (mut places, mut values): (Vec<DVec3>, Vec<DVec3>) = (Vec::new(), Vec::new());
        for i in 0..=nu {
            for j in 0..=nv {
                for &w in &levels {
                    let uvw = DVec3::new(f64::from(i) / f64::from(nu), f64::from(j) / f64::from(nv), w);
                    places.push(patch.place(uvw));
                    values.push(uvw);
                }
            }
        }
        let lambda = |i: usize| rbf.lambda[usize::from(values[i].z != 0.0)];
        let interpolant = Interpolant::new(&places, &values, lambda, rbf.basis, spacing).ok_or_else(|| {
            let accepted = "a patch and a height whose particles do not meet: a smaller height, the parameterization low-distortion, or the map inverse";
            EditError::parameter(OPERATION, "map", format!("implicit, {} particles", places.len()), accepted)
        })?;
        let around = DVec3::splat(AROUND * spacing) / lengths;
        let domain = (-around.max(DVec3::new(0.0, 0.0, behind)), DVec3::ONE + around.max(DVec3::new(0.0, 0.0, behind)));
        Ok(Self { patch, interpolant, spacing, domain })
    }

    /// How many particles a value is a sum over.
    pub fn particles(&self) -> u64 {
        self.interpolant.len() as u64
    }

    /// (u, v, w) of a place, exactly; `None` where the map repeats itself.
    pub fn find(&self, ijk: DVec3) -> Option<DVec3> {
        let uvw = self.interpolant.at(ijk);
        self.holds(ijk, uvw).then_some(uvw)
    }

    fn holds(&self, ijk: DVec3, uvw: DVec3) -> bool {
        uvw.cmpge(self.domain.0).all()
            && uvw.cmple(self.domain.1).all()
            && self.patch.place(uvw).distance(ijk) < REPEATED * self.spacing
    }

    /// The leaves near the texture's surface, and how many distances to particles were taken.
    pub fn leaves(&self, solid: &Solid, leaves: Vec<IVec3>, run: &RunOptions) -> Result<(Leaves, u64)> {
        let (mut sums, particles) = (0, self.particles());
        let mut edge = LEAF_DIM;
        while edge > 2 && f64::from(edge) > NODES * self.spacing {
            edge /= 2;
        }
        // Leaves, then blocks of the lattice's size, that the texture's surface may be in.
        let (mut blocks, whole) = self.near(solid, &leaves, LEAF_DIM, &mut sums, run)?;
        let mut found: Vec<Block> = Vec::new();
        let inner = |edge: i32, blocks: Vec<IVec3>| {
            blocks.into_iter().map(move |origin| Block { origin, edge, held: true, how: How::Inside })
        };
        if edge < LEAF_DIM {
            let split =
                blocks.iter().flat_map(|b| block(LEAF_DIM / edge).map(move |c| b.0 + c * edge)).collect::<Vec<_>>();
            let inside;
            (blocks, inside) = self.near(solid, &split, edge, &mut sums, run)?;
            found.extend(inner(edge, inside));
        }
        let voxels = solid.extent() / solid.voxel_size();
        loop {
            let (nodes, taken) = self.nodes(blocks.iter().map(|b| b.0), edge, run)?;
            sums += taken * particles;
            let cones = self.cones(edge);
            let tried: Vec<(Block, bool)> = blocks
                .par_iter()
                .map(|&(origin, exact)| {
                    let around = Around::new(&nodes, origin, edge, cones.get(&(origin / edge)));
                    let middle = around.middle();
                    let good = ((middle - exact) * voxels).abs().max_element() < TOLERANCE;
                    let held = self.holds(origin.as_dvec3() + f64::from(edge - 1) / 2.0, exact);
                    let how = if good { How::Between(Box::new(around)) } else { How::Summed };
                    (Block { origin, edge, held, how }, good)
                })
                .collect();
            let mut rest = Vec::new();
            for (block, good) in tried {
                if good { found.push(block) } else { rest.push(block) }
            }
            if edge == 2 {
                found.extend(rest);
                break;
            }
            if rest.is_empty() {
                break;
            }
            let split: Vec<IVec3> =
                rest.iter().flat_map(|b| block(2).map(|c| b.origin + c * (edge / 2)).collect::<Vec<_>>()).collect();
            edge /= 2;
            let inside;
            (blocks, inside) = self.near(solid, &split, edge, &mut sums, run)?;
            found.extend(inner(edge, inside));
        }
        let of_block = |b: &Block| {
            let voxels = b.edge.pow(3) as u64;
            match &b.how {
                How::Inside => 0,
                How::Summed => voxels * particles,
                How::Between(around) => around.cones.len() as u64 * (65 + voxels),
            }
        };
        sums += found.iter().map(of_block).sum::<u64>();
        found.par_sort_unstable_by_key(|b| (leaf_origin(b.origin).to_array(), b.origin.to_array()));
        let parts: Vec<&[Block]> = found.chunk_by(|a, b| leaf_origin(a.origin) == leaf_origin(b.origin)).collect();
        let made = parts.into_par_iter().map_init(
            || (solid.probe(), [DVec3::ZERO; LEAF_VOXELS]),
            |(probe, map), blocks| {
                let origin = leaf_origin(blocks.first()?.origin);
                let mut made = Made::new(solid.base);
                for b in blocks {
                    self.fill(&mut made, b, solid, probe, map);
                }
                Some(made.found(origin))
            },
        );
        let mut made: Vec<Found> = made.flatten().collect();
        made.extend(whole.into_iter().map(|origin| Found::Whole(origin, true)));
        run.check(OPERATION)?;
        let summed = AtomicU64::new(0);
        let full = |origin: IVec3| {
            summed.fetch_add(LEAF_VOXELS as u64 * particles, Ordering::Relaxed);
            let mut made = Made::new(solid.base);
            self.sum_up(&mut made, origin, LEAF_DIM, solid, &mut solid.probe());
            made
        };
        let leaves = closed(made, full, run)?;
        Ok((leaves, sums + summed.into_inner()))
    }

    /// The voxels of a block in its leaf; `map` is scratch.
    fn fill(&self, made: &mut Made, b: &Block, solid: &Solid, probe: &mut Probe, map: &mut [DVec3; LEAF_VOXELS]) {
        let within = b.origin - leaf_origin(b.origin);
        let around = match &b.how {
            How::Inside => return made.fill(within, b.edge, true),
            How::Summed => return self.sum_up(made, b.origin, b.edge, solid, probe),
            How::Between(around) => around,
        };
        around.fill(map);
        for part in block(b.edge / 2) {
            // Halves of a block that the band does not reach.
            let first = part * 2;
            let at = |o: IVec3| map[((o.x * b.edge + o.y) * b.edge + o.z) as usize];
            let middle = (at(first) + at(first + 1)) / 2.0;
            let d = solid.distance(probe, (b.origin + first).as_dvec3() + 0.5, middle);
            if b.held && d.abs() > radius(2) + solid.half_width() {
                made.fill(within + first, 2, d < 0.0);
                continue;
            }
            for offset in block(2).map(|c| first + c) {
                let (ijk, uvw) = ((b.origin + offset).as_dvec3(), at(offset));
                if b.held || self.holds(ijk, uvw) {
                    made.set(within + offset, solid.distance(probe, ijk, uvw));
                }
            }
        }
    }

    /// The same by the exact sum at each voxel.
    fn sum_up(&self, made: &mut Made, origin: IVec3, edge: i32, solid: &Solid, probe: &mut Probe) {
        let within = origin - leaf_origin(origin);
        for offset in block(edge) {
            let ijk = (origin + offset).as_dvec3();
            if let Some(uvw) = self.find(ijk) {
                made.set(within + offset, solid.distance(probe, ijk, uvw));
            }
        }
    }

    /// Of blocks of `edge` voxels, those that the texture's surface and its band may be in, with (u, v, w) of their middles, and those that are inside of it.
    fn near(&self, solid: &Solid, blocks: &[IVec3], edge: i32, sums: &mut u64, run: &RunOptions) -> Result<Near> {
        *sums += blocks.len() as u64 * self.particles();
        let reach = radius(edge) + solid.half_width();
        let near = blocks.par_iter().map_init(
            || solid.probe(),
            |probe, &origin| {
                if run.is_cancelled() {
                    return None;
                }
                let middle = origin.as_dvec3() + f64::from(edge - 1) / 2.0;
                let uvw = self.interpolant.at(middle);
                // Outside of its box the texture is as far as the box.
                let slack = reach * solid.stretch / solid.extent();
                if uvw.cmplt(self.domain.0 - slack).any() || uvw.cmpgt(self.domain.1 + slack).any() {
                    return None;
                }
                let d = solid.distance(probe, middle, uvw);
                if d.abs() <= reach {
                    Some((origin, Some(uvw)))
                } else {
                    (d < 0.0 && self.holds(middle, uvw)).then_some((origin, None))
                }
            },
        );
        let near: Vec<(IVec3, Option<DVec3>)> = near.flatten().collect();
        run.check(OPERATION)?;
        let inside = near.iter().filter(|n| n.1.is_none()).map(|n| n.0).collect();
        Ok((near.into_iter().filter_map(|(origin, uvw)| Some((origin, uvw?))).collect(), inside))
    }

    /// Of blocks of `edge` voxels (by origin / edge), the cones of particles in and beside them.
    fn cones(&self, edge: i32) -> FxHashMap<IVec3, Cones> {
        let mut cones: FxHashMap<IVec3, Cones> = FxHashMap::default();
        for (p, slope) in self.interpolant.cones() {
            let own = ((p + 0.5) / f64::from(edge)).floor().as_ivec3();
            for c in block(3) {
                cones.entry(own + c - 1).or_default().push((p, slope));
            }
        }
        cones
    }

    /// The map at the nodes of a lattice around blocks, and how many those are. Node n is the middle of the voxels from n·edge on.
    fn nodes(
        &self,
        blocks: impl Iterator<Item = IVec3>,
        edge: i32,
        run: &RunOptions,
    ) -> Result<(FxHashMap<IVec3, DVec3>, u64)> {
        let mut wanted: FxHashMap<IVec3, DVec3> = FxHashMap::default();
        for origin in blocks {
            for c in block(4) {
                wanted.insert(origin / edge + c - 1, DVec3::ZERO);
            }
        }
        run.reserve(OPERATION, wanted.len() as u64 * 64, ADVICE)?;
        wanted.par_iter_mut().for_each(|(n, value)| {
            if !run.is_cancelled() {
                *value = self.interpolant.at((*n * edge).as_dvec3() - 0.5);
            }
        });
        run.check(OPERATION)?;
        let count = wanted.len() as u64;
        Ok((wanted, count))
    }
}

/// Blocks near the surface with (u, v, w) of their middles, and blocks inside of it.
type Near = (Vec<(IVec3, DVec3)>, Vec<IVec3>);

/// A block of voxels in a leaf near the surface.
struct Block {
    origin: IVec3,
    edge: i32,
    /// Whether the map does not repeat itself in its middle.
    held: bool,
    how: How,
}

/// How the map in a block is found.
enum How {
    /// Not at all: all of it is inside.
    Inside,
    /// Summed up for each voxel.
    Summed,
    /// Interpolated.
    Between(Box<Around>),
}

/// Particles whose part a·|x − p| of the sum has its kink nearby: p and a.
type Cones = SmallVec<[(DVec3, DVec3); 4]>;

/// The 4³ nodes around a block, without the cones.
struct Around {
    origin: IVec3,
    edge: i32,
    nodes: [DVec3; 64],
    cones: Cones,
}

impl Around {
    fn new(nodes: &FxHashMap<IVec3, DVec3>, origin: IVec3, edge: i32, cones: Option<&Cones>) -> Self {
        let first = origin / edge - 1;
        let cones = cones.cloned().unwrap_or_default();
        let nodes = std::array::from_fn(|i| {
            let node = first + IVec3::new(i as i32 / 16, i as i32 / 4 % 4, i as i32 % 4);
            let all = nodes.get(&node).copied().unwrap_or_default();
            all - sum(&cones, (node * edge).as_dvec3() - 0.5)
        });
        Self { origin, edge, nodes, cones }
    }

    /// At the middles of the voxels of a block of so many along each axis (z fastest): one axis after the other.
    fn fill(&self, map: &mut [DVec3; LEAF_VOXELS]) {
        let (edge, n) = (self.edge, self.edge as usize);
        let weights: [[f64; 4]; LEAF_DIM as usize] =
            std::array::from_fn(|i| catmull_rom((i as f64 + 0.5) / f64::from(edge)));
        let weights = &weights[..n];
        // Of 4 × 4 × n, then 4 × n × n, then all.
        let mut along_z = [DVec3::ZERO; 16 * LEAF_DIM as usize];
        for (row, out) in self.nodes.chunks_exact(4).zip(along_z.chunks_exact_mut(n)) {
            for (w, out) in weights.iter().zip(out) {
                *out = row[0] * w[0] + row[1] * w[1] + row[2] * w[2] + row[3] * w[3];
            }
        }
        let mut along_y = [DVec3::ZERO; 4 * (LEAF_DIM * LEAF_DIM) as usize];
        for (slab, out) in along_z.chunks_exact(4 * n).zip(along_y.chunks_exact_mut(n * n)) {
            for (w, out) in weights.iter().zip(out.chunks_exact_mut(n)) {
                for (z, out) in out.iter_mut().enumerate() {
                    *out = slab[z] * w[0] + slab[n + z] * w[1] + slab[2 * n + z] * w[2] + slab[3 * n + z] * w[3];
                }
            }
        }
        let m = n * n;
        for (w, out) in weights.iter().zip(map.chunks_exact_mut(m)) {
            for (yz, out) in out.iter_mut().enumerate() {
                *out = along_y[yz] * w[0]
                    + along_y[m + yz] * w[1]
                    + along_y[2 * m + yz] * w[2]
                    + along_y[3 * m + yz] * w[3];
            }
        }
        if !self.cones.is_empty() {
            for (offset, value) in block(edge).zip(map) {
                *value += sum(&self.cones, (self.origin + offset).as_dvec3());
            }
        }
    }

    /// In the middle.
    fn middle(&self) -> DVec3 {
        let weights = catmull_rom(0.5);
        let at = |i: usize| weights[i / 16] * weights[i / 4 % 4] * weights[i % 4];
        let smooth: DVec3 = self.nodes.iter().enumerate().map(|(i, v)| *v * at(i)).sum();
        smooth + sum(&self.cones, self.origin.as_dvec3() + f64::from(self.edge - 1) / 2.0)
    }
}

fn sum(cones: &Cones, x: DVec3) -> DVec3 {
    cones.iter().map(|(p, slope)| *slope * p.distance(x)).sum()
}
