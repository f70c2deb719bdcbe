//! Which voxels are inside of a surface: of a closed one by crossings, of any other where its winding number is above ½.
//!
//! Away from the triangles the winding number w of an open mesh is smooth; at a triangle it jumps by one. Its gradient is the
//! magnetic field of a current along the mesh's boundary (Biot and Savart), so |∇w| ≤ Σ ℓ/(4π d²) over the boundary edges of
//! length ℓ at distance d. In a leaf where this bound keeps w from reaching ½, voxels that no triangle separates are alike, and
//! one of them is asked for all; elsewhere every voxel is.

use std::f64::consts::PI;

use glam::{DVec3, IVec3};

use super::WindingNumber;
use super::crossings::Crossings;
use super::topology::{boundary_chain, edge_uses};
use crate::grid::{Face, LEAF_VOXELS, LeafMask, LeafValues, leaf_offset, leaf_origin, offset_to_local};

/// Half the diagonal of the lattice of a leaf's voxels, 3.5·√3, rounded up.
const LEAF_RADIUS: f64 = 6.1;
/// The error of fast winding numbers, doubled.
const WINDING_ERROR: f64 = 0.02;
/// Neighbouring voxels whose distances to the triangles add up to more than their own distance are not separated.
/// The excess covers the rounding of the distances.
pub(crate) const APART: f32 = 1.0 + 1e-5;

/// An edge that bounds the mesh.
struct RimEdge {
    middle: DVec3,
    half_length: f64,
    /// Length times multiplicity, over 4π.
    strength: f64,
}

/// Tells inside from outside, leaf by leaf.
pub(crate) enum Inside<'a> {
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
pub(crate) struct OpenInside<'a> {
    winding: &'a WindingNumber<'a>,
    rim: Vec<RimEdge>,
}

impl<'a> OpenInside<'a> {
    /// Of the indexed mesh (in index space) whose winding number is given.
    pub fn new(winding: &'a WindingNumber<'a>, positions: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let rim = boundary_chain(&edge_uses(triangles))
            .into_iter()
            .map(|(ends, multiplicity)| {
                let [a, b] = ends.map(|v| positions[v as usize]);
                let length = a.distance(b);
                let strength = length * multiplicity.unsigned_abs() as f64 / (4.0 * PI);
                RimEdge { middle: (a + b) * 0.5, half_length: 0.5 * length, strength }
            })
            .collect();
        Self { winding, rim }
    }

    fn is_inside(&self, ijk: IVec3) -> bool {
        self.winding.at(ijk.as_dvec3()) > 0.5
    }

    fn leaf(&self, origin: IVec3, distance: Option<&LeafValues>) -> LeafMask {
        self.by_seeds(origin, distance).unwrap_or_else(|| {
            let mut mask = LeafMask::EMPTY;
            (0..LEAF_VOXELS).for_each(|o| mask.set(o, self.is_inside(origin + offset_to_local(o))));
            mask
        })
    }

    /// The mask from one voxel of each set of unseparated voxels, or `None` where that proves nothing.
    fn by_seeds(&self, origin: IVec3, distance: Option<&LeafValues>) -> Option<LeafMask> {
        let slope = self.steepest(origin)?;
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

    /// A bound of |∇w| in the leaf at `origin`, away from triangles; `None` if it is too large to be of use.
    fn steepest(&self, origin: IVec3) -> Option<f64> {
        /// With this slope w changes by ½ within the leaf.
        const USELESS: f64 = 0.5 / (2.0 * LEAF_RADIUS);
        let center = origin.as_dvec3() + 3.5;
        let mut slope = 0.0;
        for edge in &self.rim {
            let distance = edge.middle.distance(center) - edge.half_length - LEAF_RADIUS;
            if distance <= 0.0 {
                return None;
            }
            slope += edge.strength / (distance * distance);
            if slope > USELESS {
                return None;
            }
        }
        Some(slope)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Bvh;
    use crate::mesh::scatter::distance_to_triangles;
    use crate::mesh::testing::*;
    use crate::run::RunOptions;

    #[test]
    fn seeds_say_what_every_voxel_says() {
        // A large sphere with a small hole: far from the hole the bound holds, near it not.
        let mut mesh = sphere(DVec3::splat(0.37), 40.0, 40);
        mesh.triangles.truncate(mesh.triangles.len() - 40);
        let triangles: Vec<_> = (0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect();
        let bvh = Bvh::new(triangles.clone());
        let winding = WindingNumber::new(&bvh);
        let open = OpenInside::new(&winding, &mesh.positions, &mesh.triangles);
        let leaves = distance_to_triangles(triangles.len(), |t| triangles[t], 3.0, &RunOptions::default()).unwrap();
        let mut seeded = 0;
        for leaf in leaves.iter().step_by(7) {
            if let Some(mask) = open.by_seeds(leaf.origin, Some(&leaf.distance)) {
                seeded += 1;
                for o in 0..LEAF_VOXELS {
                    let ijk = leaf.origin + offset_to_local(o);
                    assert!(leaf.distance.0[o] < 1e-3 || mask.get(o) == open.is_inside(ijk), "{ijk}");
                }
            }
        }
        assert!(seeded * 7 > leaves.len() / 2, "{seeded} of {}", leaves.len() / 7);
    }
}
