//! Which voxels are inside of a surface: of a closed one by crossings, of any other where its winding number is above ½.
//!
//! Away from the triangles the winding number w of an open mesh is smooth; at a triangle it jumps by one. Its gradient is the
//! magnetic field of a current along the mesh's boundary (Biot and Savart), so |∇w| ≤ Σ ℓ/(4π d²) over the boundary edges of
//! length ℓ at distance d. In a leaf where this bound keeps w from reaching ½, voxels that no triangle separates are alike, and
//! one of them is asked for all; elsewhere every voxel is.

use std::f64::consts::PI;

use glam::{DVec3, IVec3};

use super::crossings::Crossings;
use crate::grid::{Face, LEAF_VOXELS, LeafMask, LeafValues, leaf_offset, leaf_origin, offset_to_local};
use crate::mesh::WindingNumber;
use crate::mesh::topology::{boundary_chain, edge_uses};
use crate::mesh::winding::BATCH;

/// Half the diagonal of the lattice of a leaf's voxels, 3.5·√3, rounded up.
const LEAF_RADIUS: f64 = 6.1;
/// The error of fast winding numbers, doubled.
pub(super) const WINDING_ERROR: f64 = 0.02;
/// Neighbouring voxels whose distances to the triangles add up to more than their own distance are not separated.
/// The excess covers the rounding of the distances.
pub(super) const APART: f32 = 1.0 + 1e-5;

/// Edges in a group of the rim.
const RIM_GROUP: usize = 32;

/// A piece of the mesh's boundary as a current: a ball that holds it and its length times multiplicity, over 4π.
#[derive(Clone, Copy)]
struct Current {
    center: DVec3,
    radius: f64,
    strength: f64,
}

/// The boundary of a mesh, and how fast the winding number can change because of it.
pub(super) struct Rim {
    groups: Vec<(Current, Vec<Current>)>,
}

impl Rim {
    /// The boundary of an indexed mesh; empty if it is closed.
    pub fn new(positions: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let edges: Vec<Current> = boundary_chain(&edge_uses(triangles))
            .into_iter()
            .map(|(ends, multiplicity)| {
                let [a, b] = ends.map(|v| positions[v as usize]);
                let length = a.distance(b);
                let strength = length * multiplicity.unsigned_abs() as f64 / (4.0 * PI);
                Current { center: (a + b) * 0.5, radius: 0.5 * length, strength }
            })
            .collect();
        // Vertices with near indices are mostly near each other, so the order of the edges makes fair groups.
        let groups = edges.chunks(RIM_GROUP).map(|chunk| {
            let center = chunk.iter().map(|e| e.center).sum::<DVec3>() / chunk.len() as f64;
            let radius = chunk.iter().map(|e| e.center.distance(center) + e.radius).fold(0.0, f64::max);
            (Current { center, radius, strength: chunk.iter().map(|e| e.strength).sum() }, chunk.to_vec())
        });
        Self { groups: groups.collect() }
    }

    /// A bound of |∇w| away from triangles in the ball around `center`; `None` if it exceeds `useless`.
    pub fn steepest(&self, center: DVec3, radius: f64, useless: f64) -> Option<f64> {
        let slope = |current: &Current| {
            let distance = current.center.distance(center) - current.radius - radius;
            if distance > 0.0 { current.strength / (distance * distance) } else { f64::INFINITY }
        };
        let mut sum = 0.0;
        for (group, edges) in &self.groups {
            let far = group.center.distance(center) > 3.0 * group.radius + radius;
            sum += if far { slope(group) } else { edges.iter().map(slope).sum() };
            if sum > useless {
                return None;
            }
        }
        Some(sum)
    }
}

/// Tells inside from outside, leaf by leaf.
pub(super) enum Inside<'a> {
    /// Of a mesh without boundary: where the integer winding number is positive.
    Closed(Crossings),
    /// Of any mesh.
    Open(OpenInside<'a>),
}

impl Inside<'_> {
    /// The voxels of the leaf at `origin` that are inside. `distance` holds the distances to all triangles, where any is near.
    pub fn leaf(&self, origin: IVec3, distance: Option<&LeafValues>) -> LeafMask {
        match self {
            Self::Closed(crossings) => crossings.inside(origin),
            Self::Open(open) => open.leaf(origin, distance),
        }
    }
}

/// Inside by winding number.
pub(super) struct OpenInside<'a> {
    pub winding: &'a WindingNumber<'a>,
    pub rim: &'a Rim,
}

impl OpenInside<'_> {
    fn leaf(&self, origin: IVec3, distance: Option<&LeafValues>) -> LeafMask {
        self.by_seeds(origin, distance).unwrap_or_else(|| self.by_voxels(origin))
    }

    fn by_voxels(&self, origin: IVec3) -> LeafMask {
        let mut mask = LeafMask::EMPTY;
        for row in 0..LEAF_VOXELS / BATCH {
            let points = std::array::from_fn(|z| (origin + offset_to_local(row * BATCH + z)).as_dvec3());
            let w = self.winding.at_each::<BATCH>(&points);
            w.iter().enumerate().for_each(|(z, w)| mask.set(row * BATCH + z, *w > 0.5));
        }
        mask
    }

    /// The mask from one voxel of each set of unseparated voxels, or `None` where that proves nothing.
    fn by_seeds(&self, origin: IVec3, distance: Option<&LeafValues>) -> Option<LeafMask> {
        /// With this slope w changes by ½ within the leaf.
        const USELESS: f64 = 0.5 / (2.0 * LEAF_RADIUS);
        let slope = self.rim.steepest(origin.as_dvec3() + 3.5, LEAF_RADIUS, USELESS)?;
        let mut known = LeafMask::EMPTY;
        let mut inside = LeafMask::EMPTY;
        let mut open = Vec::new();
        for seed in 0..LEAF_VOXELS {
            if known.get(seed) {
                continue;
            }
            let w = self.winding.at((origin + offset_to_local(seed)).as_dvec3());
            let from_half = (w - w.floor() - 0.5).abs();
            if from_half <= WINDING_ERROR + slope * 2.0 * LEAF_RADIUS {
                return None;
            }
            known.set(seed, true);
            open.push(seed);
            while let Some(offset) = open.pop() {
                inside.set(offset, w > 0.5);
                let local = offset_to_local(offset);
                for face in Face::ALL {
                    let next = local + face.step();
                    if leaf_origin(next) != IVec3::ZERO || known.get(leaf_offset(next)) {
                        continue;
                    }
                    let next = leaf_offset(next);
                    if distance.is_none_or(|d| d.0[offset] + d.0[next] > APART) {
                        known.set(next, true);
                        open.push(next);
                    }
                }
            }
        }
        Some(inside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Bvh;
    use crate::mesh::testing::*;
    use crate::mesh::to_levelset::scatter::distance_to_triangles;
    use crate::run::RunOptions;

    #[test]
    fn seeds_say_what_every_voxel_says() {
        // A large sphere with a small hole: far from the hole the bound holds, near it not.
        let mut mesh = sphere(DVec3::splat(0.37), 40.0, 40);
        mesh.triangles.truncate(mesh.triangles.len() - 40);
        let triangles: Vec<_> = (0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect();
        let bvh = Bvh::new(triangles.clone());
        let winding = WindingNumber::new(&bvh);
        let rim = Rim::new(&mesh.positions, &mesh.triangles);
        let open = OpenInside { winding: &winding, rim: &rim };
        let leaves = distance_to_triangles(triangles.len(), |t| triangles[t], 3.0, &RunOptions::default()).unwrap();
        let mut seeded = 0;
        for leaf in leaves.iter().step_by(7) {
            if let Some(mask) = open.by_seeds(leaf.origin, Some(&leaf.distance)) {
                seeded += 1;
                let by_voxels = open.by_voxels(leaf.origin);
                for o in 0..LEAF_VOXELS {
                    assert!(leaf.distance.0[o] < 1e-3 || mask.get(o) == by_voxels.get(o), "{} {o}", leaf.origin);
                }
            }
        }
        assert!(seeded * 7 > leaves.len() / 2, "{seeded} of {}", leaves.len() / 7);
    }
}
