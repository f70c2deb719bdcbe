//! The implicit map: radial basis functions from places to (u, v, w) through the particles (Brodersen et al. 2007, section 3), evaluated near the
//! texture's surface only.
//!
//! A sum over all particles is taken at the nodes of a lattice of half the particles' spacing and interpolated by Catmull and Rom's splines between them. Blocks without
//! the texture's surface are left out by their middle; where the interpolated value at the middle is off by more than a part of a voxel
//! of the texture, a block is divided, down to single voxels, which are summed exactly.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::OPERATION;
use super::space::Patch;
use super::wrap::{Leaves, Made, Solid, block, catmull_rom, radius};
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, leaf_origin};
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

/// Lattice of nodes, as a part of the particles' spacing.
const NODES: f64 = 0.5;

/// Largest error of the interpolation, in voxels of the texture.
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

    /// The leaves near the texture's surface, and how often a sum over all particles was taken.
    pub fn leaves(&self, solid: &Solid, leaves: Vec<IVec3>, run: &RunOptions) -> Result<(Leaves, u64)> {
        let mut sums = 0;
        let mut edge = LEAF_DIM;
        while edge > 2 && f64::from(edge) > NODES * self.spacing {
            edge /= 2;
        }
        // Leaves, then blocks of the lattice's size, that the texture's surface may be in.
        let mut blocks = self.near(solid, &leaves, LEAF_DIM, &mut sums, run)?;
        if edge < LEAF_DIM {
            let split =
                blocks.iter().flat_map(|b| block(LEAF_DIM / edge).map(move |c| b.0 + c * edge)).collect::<Vec<_>>();
            blocks = self.near(solid, &split, edge, &mut sums, run)?;
        }
        let mut found: Vec<Block> = Vec::new();
        let voxels = solid.extent() / solid.voxel_size();
        loop {
            let (nodes, taken) = self.nodes(blocks.iter().map(|b| b.0), edge, run)?;
            sums += taken;
            let tried: Vec<(Block, bool)> = blocks
                .par_iter()
                .map(|&(origin, exact)| {
                    let around = Around::new(&nodes, origin, edge);
                    let middle = around.at(DVec3::splat(0.5));
                    let good = ((middle - exact) * voxels).abs().max_element() < TOLERANCE;
                    (Block { origin, edge, around: good.then(|| Box::new(around)) }, good)
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
            blocks = self.near(solid, &split, edge, &mut sums, run)?;
        }
        sums += found.iter().filter(|b| b.around.is_none()).map(|b| b.edge.pow(3) as u64).sum::<u64>();
        found.par_sort_unstable_by_key(|b| (leaf_origin(b.origin).to_array(), b.origin.to_array()));
        let leaves: Vec<&[Block]> = found.chunk_by(|a, b| leaf_origin(a.origin) == leaf_origin(b.origin)).collect();
        let made = leaves.into_par_iter().map_init(
            || solid.probe(),
            |probe, blocks| {
                let origin = leaf_origin(blocks.first()?.origin);
                let mut made = Made::new(solid);
                for b in blocks {
                    for offset in block(b.edge) {
                        let ijk = (b.origin + offset).as_dvec3();
                        let uvw = match &b.around {
                            Some(around) => Some(around.at((offset.as_dvec3() + 0.5) / f64::from(b.edge)))
                                .filter(|uvw| self.holds(ijk, *uvw)),
                            None => self.find(ijk),
                        };
                        if let Some(uvw) = uvw {
                            made.set(b.origin - origin + offset, solid.distance(probe, ijk, uvw));
                        }
                    }
                }
                (!made.mask.is_empty()).then_some((origin, made.values, made.mask))
            },
        );
        let made = made.flatten().collect();
        run.check(OPERATION)?;
        Ok((made, sums))
    }

    /// Of blocks of `edge` voxels, those that the texture's surface and its band may be in, with (u, v, w) of their middles.
    fn near(
        &self,
        solid: &Solid,
        blocks: &[IVec3],
        edge: i32,
        sums: &mut u64,
        run: &RunOptions,
    ) -> Result<Vec<(IVec3, DVec3)>> {
        *sums += blocks.len() as u64;
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
                let inside = uvw.cmpge(self.domain.0 - slack).all() && uvw.cmple(self.domain.1 + slack).all();
                (inside && solid.distance(probe, middle, uvw).abs() <= reach).then_some((origin, uvw))
            },
        );
        let near = near.flatten().collect();
        run.check(OPERATION)?;
        Ok(near)
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
        run.reserve(OPERATION, wanted.len() as u64 * 64, "take a smaller patch or height, or larger voxels")?;
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

/// A block of voxels near the surface; the map in it is interpolated, or summed up for each voxel.
struct Block {
    origin: IVec3,
    edge: i32,
    around: Option<Box<Around>>,
}

/// The 4³ nodes around a block.
struct Around([DVec3; 64]);

impl Around {
    fn new(nodes: &FxHashMap<IVec3, DVec3>, origin: IVec3, edge: i32) -> Self {
        let first = origin / edge - 1;
        Self(std::array::from_fn(|i| {
            let c = IVec3::new(i as i32 / 16, i as i32 / 4 % 4, i as i32 % 4);
            nodes.get(&(first + c)).copied().unwrap_or_default()
        }))
    }

    /// At `t` in 0..1³ between the inner nodes.
    fn at(&self, t: DVec3) -> DVec3 {
        let (x, y, z) = (catmull_rom(t.x), catmull_rom(t.y), catmull_rom(t.z));
        let mut sum = DVec3::ZERO;
        for (i, a) in x.iter().enumerate() {
            for (j, b) in y.iter().enumerate() {
                let row = &self.0[i * 16 + j * 4..][..4];
                let along: DVec3 = row.iter().zip(&z).map(|(v, c)| *v * *c).sum();
                sum += along * (a * b);
            }
        }
        sum
    }
}
