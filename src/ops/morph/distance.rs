//! The distance to a target everywhere that a surface may go, not in its band alone.
//!
//! In the band it is the target's own φ; beyond, exact distances on a lattice of a few voxels, interpolated. A surface far away moves by the
//! latter; where it comes to rest, the former counts.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::NAME;
use crate::error::Result;
use crate::grid::{LEAF_DIM, LeafMask};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, level_set_to_mesh};
use crate::run::RunOptions;
use crate::stencil::Cube;

/// Most nodes of the lattice.
const MOST_NODES: f64 = 150_000.0;

/// Voxels around the shapes that it covers.
const MARGIN: i32 = 4;

/// The part of the band in which the target's own values are taken: at its rim interpolation meets ±background.
const OWN: f32 = 0.65;

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
            spacing += 1;
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

    /// The distances at the surface points that the voxels of a leaf see.
    pub fn around(&self, leaf: IVec3) -> Around<'_> {
        let own = OWN * self.near.background();
        let voxel_size = self.near.voxel_size() as f32;
        let mut around = Around { target: self, origin: leaf.as_dvec3(), cube: None, own, sure: own };
        around.sure += 2.0 * self.spacing as f32 * voxel_size;
        // From the middle of the leaf to the corners of its rim.
        let rim = (1.25 * self.near.half_width()).ceil() as usize;
        let radius = (3.5 + rim as f32) * 3f32.sqrt() * voxel_size;
        if around.far(leaf.as_dvec3() + 3.5).abs() > around.sure + radius {
            return around;
        }
        let grid = self.near.grid();
        let neighbours = std::array::from_fn(|n| {
            let n = n as i32;
            grid.find(leaf + IVec3::new(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1) * LEAF_DIM)
        });
        let mut cube = Cube::new(rim);
        cube.gather(grid.value_pages(), &neighbours, LeafMask::FULL);
        around.cube = Some(cube);
        around
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

/// The distance near a leaf.
pub(super) struct Around<'a> {
    target: &'a TargetDistance,
    origin: DVec3,
    /// The target's own values, where they matter.
    cube: Option<Cube>,
    /// The distance up to which they count.
    own: f32,
    /// The distance from which on neither the sign nor the band can be otherwise.
    sure: f32,
}

impl Around<'_> {
    /// The signed distance (world units) at a position of the target's index space.
    #[inline]
    pub fn at(&self, ijk: DVec3) -> f64 {
        let Some(cube) = &self.cube else { return self.far(ijk).into() };
        let near = self.near(cube, ijk);
        if near.abs() < self.own {
            return near.into();
        }
        let far = self.far(ijk);
        if far.abs() > self.sure {
            return far.into();
        }
        // The sign is the level set's: the lattice does not see what is thinner than its spacing.
        f64::from(near.signum() * far.abs().max(self.own))
    }

    /// By the target's own values; positions beyond the rim as at the rim.
    #[inline]
    fn near(&self, cube: &Cube, ijk: DVec3) -> f32 {
        let side = LEAF_DIM as usize + 2 * cube.width();
        let at = (ijk - self.origin).as_vec3() + cube.width() as f32;
        let (cell, t) = split(at, Vec3::splat(side as f32 - 1.0));
        trilinear(cube.slab(cell[0]), cube.slab(cell[0] + 1), cell[1] * side + cell[2], side, t)
    }

    /// By the lattice.
    #[inline]
    fn far(&self, ijk: DVec3) -> f32 {
        let TargetDistance { first, spacing, size, far, .. } = self.target;
        let at = (ijk - first.as_dvec3()).as_vec3() / *spacing as f32;
        let (cell, t) = split(at, (*size - 1).as_vec3());
        let (row, slab) = (size.z as usize, (size.y * size.z) as usize);
        let first = cell[0] * slab;
        trilinear(&far[first..], &far[first + slab..], cell[1] * row + cell[2], row, t)
    }
}

/// The cell of a lattice whose last node is `last`, and the place in it.
#[inline]
fn split(at: Vec3, last: Vec3) -> ([usize; 3], Vec3) {
    // Not quite the last node: its cell would be one beyond.
    let at = at.clamp(Vec3::ZERO, last * (1.0 - f32::EPSILON) - 1e-4);
    let cell = at.as_uvec3();
    (cell.to_array().map(|c| c as usize), at - cell.as_vec3())
}

/// Between two slabs of constant x, from the place of the cell's first corner on.
#[inline]
fn trilinear(below: &[f32], above: &[f32], first: usize, row: usize, t: Vec3) -> f32 {
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let of_slab = |slab: &[f32]| {
        let (a, b) = (&slab[first..first + 2], &slab[first + row..first + row + 2]);
        lerp(lerp(a[0], a[1], t.z), lerp(b[0], b[1], t.z), t.y)
    };
    lerp(of_slab(below), of_slab(above), t.x)
}
