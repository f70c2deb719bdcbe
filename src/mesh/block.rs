//! Cubes of voxels, and the clusters of triangles that can be nearest to one of their voxels.
//!
//! If the centre of a block of radius r has the distance D, a voxel v of it has at most D + r, so a cluster nearest to v is at most
//! D + 2r from the centre, by its box. Halved from a tile down, each block looks only at what its parent could not leave out.

use glam::{IVec3, Vec3};

use super::cluster::{Candidates, Clusters, Nearby, Query, SLACK};
use crate::stencil::simd::dispatch;

/// Voxels along the edge of a tile: its clusters fit the second-level cache, and those of its neighbours that it needs as well are
/// as many as half its own.
pub(super) const TILE: i32 = 32;
/// Voxels along the edge of the blocks whose voxels are computed one by one.
pub(super) const BLOCK: i32 = 4;

/// The candidates of the current block at each level below a tile.
pub(super) type Lists = [Candidates; 3];

/// A cube of voxels of a tile.
#[derive(Clone, Copy)]
pub(super) struct Block {
    /// Its first voxel, relative to the tile.
    pub origin: IVec3,
    /// Voxels along its edge.
    pub edge: i32,
    /// Clusters near it.
    pub nearest: [u32; 2],
}

impl Block {
    /// A whole tile.
    pub const WHOLE: Self = Self { origin: IVec3::ZERO, edge: TILE, nearest: [0; 2] };

    /// Its eight halves.
    pub fn halves(self) -> impl Iterator<Item = Self> {
        let edge = self.edge / 2;
        (0..8).map(move |c| Self { origin: self.origin + IVec3::new(c >> 2, c >> 1 & 1, c & 1) * edge, edge, ..self })
    }

    /// Half the diagonal of its voxels, and what covers the rounding.
    pub fn radius(&self) -> f32 {
        (self.edge - 1) as f32 / 2.0 * 3f32.sqrt() + SLACK
    }

    fn centre(&self) -> Vec3 {
        self.origin.as_vec3() + (self.edge - 1) as f32 / 2.0
    }

    /// The distance of its centre from the nearest triangle; infinite if no voxel of it is within `reach` of one.
    pub fn distance(&mut self, clusters: &Clusters, candidates: &Candidates, reach: f32) -> f32 {
        let limit = reach + self.radius();
        let mut squared = [[limit * limit]];
        let (first, guesses) = (self.centre(), &mut self.nearest);
        dispatch(Query { candidates, clusters, first, guesses, squared: &mut squared });
        // At the limit nothing was found.
        if squared[0][0] < limit * limit { squared[0][0].sqrt() } else { f32::INFINITY }
    }

    /// Puts those of the candidates `from` into `to` that can be nearest to a voxel of it, the centre being at that distance.
    pub fn narrow(&self, distance: f32, reach: f32, from: &Candidates, to: &mut Candidates) {
        let radius = self.radius();
        let reach = (reach + radius).min(distance + 2.0 * radius);
        dispatch(Nearby { from, to, centre: self.centre(), reach });
    }

    /// Squares of the distances of its voxels, by rows along z, each up to a limit, whose square stands there before. A block of [`BLOCK`].
    pub fn look_up(
        &self,
        clusters: &Clusters,
        candidates: &Candidates,
        squared: &mut [[f32; BLOCK as usize]; (BLOCK * BLOCK) as usize],
    ) {
        let (first, mut nearest) = (self.origin.as_vec3(), self.nearest);
        dispatch(Query { candidates, clusters, first, guesses: &mut nearest, squared });
    }
}
