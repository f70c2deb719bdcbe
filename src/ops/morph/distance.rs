//! The distance to a target everywhere that a surface may go, not in its band alone.
//!
//! In the band it is the target's own φ; beyond, exact distances on a lattice of a few voxels, interpolated. A surface far away moves by the
//! latter; where it comes to rest, the former counts.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::NAME;
use crate::error::Result;
use crate::levelset::{LevelSet, Sampler};
use crate::mesh::{Bvh, level_set_to_mesh};
use crate::run::RunOptions;

/// Most nodes of the lattice.
const MOST_NODES: f64 = 150_000.0;

/// Voxels around the shapes that it covers.
const MARGIN: i32 = 4;

/// The part of the band in which the target's own values are taken: at its rim interpolation meets ±background.
const OWN: f64 = 0.65;

/// The signed distance to a level set (world units), at positions in its index space.
pub(super) struct TargetDistance {
    near: LevelSet,
    first: IVec3,
    spacing: i32,
    size: IVec3,
    /// In the order x, y, z.
    far: Vec<f32>,
}

impl TargetDistance {
    /// Of a level set with a surface, between the voxels `lo` and `hi`.
    pub fn new(near: &LevelSet, (lo, hi): (IVec3, IVec3), run: &RunOptions) -> Result<Self> {
        let extent = (hi - lo + 2 * MARGIN).as_dvec3();
        let mut spacing = 1;
        while (extent / f64::from(spacing) + 2.0).element_product() > MOST_NODES {
            spacing *= 2;
        }
        let first = lo - MARGIN;
        let size = (hi + MARGIN - first) / spacing + 2;
        let transform = near.transform();
        let mesh = level_set_to_mesh(near, 0.0, run)?;
        let positions: Vec<DVec3> = mesh.positions.iter().map(|p| transform.world_to_index(*p)).collect();
        let tree = Bvh::new(mesh.triangles.iter().map(|t| t.map(|v| positions[v as usize])).collect());
        let (grid, voxel_size) = (near.grid(), near.voxel_size());
        let row = |row: i32| {
            // The distance of the node before bounds that of the next.
            let mut before = f64::INFINITY;
            let mut values = Vec::with_capacity(size.z as usize);
            for z in 0..size.z {
                if run.is_cancelled() {
                    return Vec::new();
                }
                let ijk = first + IVec3::new(row / size.y, row % size.y, z) * spacing;
                let limit = before + f64::from(spacing) * 1.001;
                let hit = tree.closest_point(ijk.as_dvec3(), limit);
                before = hit.map_or(limit, |hit| hit.distance_squared.sqrt());
                let distance = (before * voxel_size) as f32;
                values.push(if grid.voxel(ijk).0 < 0.0 { -distance } else { distance });
            }
            values
        };
        let far = (0..size.x * size.y).into_par_iter().map(row).collect::<Vec<_>>().concat();
        run.check(NAME)?;
        Ok(Self { near: near.clone(), first, spacing, size, far })
    }

    /// The level set.
    pub fn level_set(&self) -> &LevelSet {
        &self.near
    }

    /// The distance at a position; `sampler` is one of the level set.
    pub fn at(&self, sampler: &mut Sampler, ijk: DVec3) -> f64 {
        let own = OWN * f64::from(self.near.background());
        let far = self.far_at(ijk);
        // So far away that neither the sign nor the band can be otherwise.
        if far.abs() > own + 2.0 * f64::from(self.spacing) * self.near.voxel_size() {
            return far;
        }
        let near = f64::from(sampler.trilinear(ijk));
        if near.abs() < own {
            return near;
        }
        // The sign is the level set's: the lattice does not see what is thinner than its spacing.
        near.signum() * far.abs().max(own)
    }

    fn far_at(&self, ijk: DVec3) -> f64 {
        let last = (self.size - 1).as_dvec3() - 1e-6;
        let at = ((ijk - self.first.as_dvec3()) / f64::from(self.spacing)).clamp(DVec3::ZERO, last);
        let (cell, t) = (at.floor().as_ivec3(), at - at.floor());
        let node = |step: IVec3| {
            let IVec3 { x, y, z } = cell + step;
            f64::from(self.far[((x * self.size.y + y) * self.size.z + z) as usize])
        };
        let along = |x: i32, y: i32| {
            let (a, b) = (node(IVec3::new(x, y, 0)), node(IVec3::new(x, y, 1)));
            a + (b - a) * t.z
        };
        let across = |x: i32| {
            let (a, b) = (along(x, 0), along(x, 1));
            a + (b - a) * t.y
        };
        let (a, b) = (across(0), across(1));
        a + (b - a) * t.x
    }

    /// M = −∫ b over the inside of a solid on the same lattice: what it shares with the target less what it has outside of it, both the more
    /// the deeper. Largest for the target itself.
    pub fn shared_volume(&self, solid: &LevelSet) -> f64 {
        let step = f64::from(self.spacing);
        // Inside and outside are told apart as sharply as the lattice and the band allow.
        let width = step.min(2.0 * f64::from(solid.half_width())) * solid.voxel_size();
        let of_row = |row: i32| {
            let mut sampler = solid.sampler();
            let mut sum = 0.0;
            for z in 0..self.size.z {
                let ijk = self.first + IVec3::new(row / self.size.y, row % self.size.y, z) * self.spacing;
                let inside = (0.5 - f64::from(sampler.voxel(ijk)) / width).clamp(0.0, 1.0);
                sum -= inside * f64::from(self.far[(row * self.size.z + z) as usize]);
            }
            sum
        };
        let rows: Vec<f64> = (0..self.size.x * self.size.y).into_par_iter().map(of_row).collect();
        rows.into_iter().sum::<f64>() * (step * solid.voxel_size()).powi(3)
    }
}
