//! Triangle meshes: files, and the way to a level set and back.

mod attributes;
mod bezier;
mod bins;
mod block;
mod bvh;
mod closest;
mod cluster;
pub mod files;
mod findings;
mod from_levelset;
mod gather;
mod nearest;
mod nurbs;
mod prepare;
mod quads;
mod rebuild;
mod remesh;
mod scatter;
mod shell;
mod simplify;
mod spline;
#[cfg(test)]
pub(crate) mod testing;
mod to_levelset;
mod topology;
mod unit;
mod winding;

pub(crate) use attributes::barycentric;
pub use attributes::{Attributes, transfer_attributes};
pub use bezier::BezierPatches;
pub use bvh::{Bvh, Hit};
pub(crate) use closest::closest_on_triangle;
pub(crate) use files::linear_from_srgb8;
pub use files::{MeshFormat, ReadMesh, read, write, write_quads, write_to};
pub use findings::MeshFindings;
pub use from_levelset::level_set_to_mesh;
pub use prepare::prepare;
pub use quads::{QuadMesh, level_set_to_quads};
pub(crate) use rebuild::rebuilt_leaves;
pub use rebuild::{Rebuild, level_set_of_mesh, onto_lattice, rebuild, rebuild_where, widened, with_half_width};
pub use remesh::Remesh;
pub use scatter::{UnsignedLeaf, distance_to_triangles};
pub use shell::shell;
pub use simplify::{Bound, Simplified, simplify};
pub use spline::{Spline, double_reflection};
pub use to_levelset::{MeshToLevelSet, mesh_to_level_set};
pub use topology::{Topology, analyze};
pub use winding::WindingNumber;

use glam::DVec3;
use rayon::prelude::*;

/// An indexed triangle mesh in world units.
///
/// `triangles` index `positions` counter-clockwise seen from outside. The attributes, where present, have one entry a
/// vertex. Positions are f64: files may hold coordinates far from the origin, where f32 would lose the shape.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertex positions.
    pub positions: Vec<DVec3>,
    /// Vertex indices of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Linear RGBA in 0..1, one a vertex.
    pub colors: Option<Vec<[f32; 4]>>,
    /// Texture coordinates, one a vertex.
    pub uvs: Option<Vec<[f32; 2]>>,
    /// Normals that a file gave, one a vertex.
    pub normals: Option<Vec<[f32; 3]>>,
}

impl TriangleMesh {
    /// The corners of triangle `t`.
    #[inline]
    pub fn corners(&self, t: usize) -> [DVec3; 3] {
        // Not by `map`, which would not be inlined.
        let [a, b, c] = self.triangles[t];
        [self.positions[a as usize], self.positions[b as usize], self.positions[c as usize]]
    }

    /// Adds another mesh. Attributes that only one of the two has are dropped.
    pub fn append(&mut self, other: Self) {
        let (first, was_empty) = (self.positions.len() as u32, self.positions.is_empty());
        self.positions.extend(other.positions);
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + first)));
        fn joined<T>(own: Option<Vec<T>>, others: Option<Vec<T>>, was_empty: bool) -> Option<Vec<T>> {
            match (own, others) {
                (Some(mut own), Some(others)) => {
                    own.extend(others);
                    Some(own)
                }
                (None, others) if was_empty => others,
                _ => None,
            }
        }
        self.colors = joined(self.colors.take(), other.colors, was_empty);
        self.uvs = joined(self.uvs.take(), other.uvs, was_empty);
        self.normals = joined(self.normals.take(), other.normals, was_empty);
    }

    /// Smallest box around the positions that triangles use; `None` without triangles.
    pub fn bounding_box(&self) -> Option<(DVec3, DVec3)> {
        let of_one = |t| {
            let [a, b, c] = self.corners(t);
            (a.min(b).min(c), a.max(b).max(c))
        };
        let both = |(lo, hi): (DVec3, DVec3), (a, b): (DVec3, DVec3)| (lo.min(a), hi.max(b));
        (0..self.triangles.len()).into_par_iter().with_min_len(1024).map(of_one).reduce_with(both)
    }
}
