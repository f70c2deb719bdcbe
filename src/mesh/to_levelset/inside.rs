//! Which voxels are inside of a surface: of a closed one by crossings, of any other where its winding number is above ½.
//!
//! Away from the triangles the winding number w of an open mesh is smooth; at a triangle it jumps by one. Its gradient is the
//! magnetic field of a current along the mesh's boundary (Biot and Savart), so |∇w| ≤ Σ ℓ/(4π d²) over the boundary edges of
//! length ℓ at distance d. In a leaf where this bound keeps w from reaching ½, voxels that no triangle separates are alike, and
//! one of them is asked for all; elsewhere every voxel is.

use std::f64::consts::PI;

use glam::{DVec3, IVec3};

use super::crossings::Crossings;
use crate::grid::{Face, LEAF_DIM, LeafMask, LeafValues, leaf_offset};
use crate::mesh::WindingNumber;
use crate::mesh::topology::{boundary_chain, edge_uses};
use crate::mesh::winding::BATCH;

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

    /// Whether there is no boundary.
    pub fn is_empty(&self) -> bool {
        self.groups.is_empty()
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
        let mut inside = LeafMask::EMPTY;
        if !self.by_seeds(Block { origin, start: IVec3::ZERO, edge: LEAF_DIM }, distance, &mut inside) {
            // Half the size has half the variation, and mostly less of the boundary near.
            for octant in blocks(LEAF_DIM / 2) {
                let block = Block { origin, start: octant, edge: LEAF_DIM / 2 };
                if !self.by_seeds(block, distance, &mut inside) {
                    self.by_voxels(block, &mut inside);
                }
            }
        }
        inside
    }

    /// Asks for every voxel of a block.
    fn by_voxels(&self, block: Block, inside: &mut LeafMask) {
        for start in blocks(2).map(|start| block.start + start).filter(|s| block.holds(*s)) {
            let voxels: [IVec3; BATCH] = std::array::from_fn(|i| start + offset_in(i as i32, 2));
            let w = self.winding.at_each::<BATCH>(&voxels.map(|v| (block.origin + v).as_dvec3()));
            voxels.iter().zip(w).for_each(|(v, w)| inside.set(leaf_offset(*v), w > 0.5));
        }
    }

    /// Asks for one voxel of each set of unseparated voxels of a block. Returns false where that proves nothing.
    fn by_seeds(&self, block: Block, distance: Option<&LeafValues>, inside: &mut LeafMask) -> bool {
        // Half the diagonal of the lattice of the block's voxels, √3/2 · (edge − 1), rounded up.
        let radius = 0.87 * f64::from(block.edge - 1);
        let center = (block.origin + block.start).as_dvec3() + 0.5 * f64::from(block.edge - 1);
        // With half a turn of w over the block's diameter every value is possible.
        let Some(slope) = self.rim.steepest(center, radius, 0.25 / radius) else { return false };
        let mut known = LeafMask::EMPTY;
        let mut open = Vec::new();
        for seed in (0..block.edge.pow(3)).map(|i| block.start + offset_in(i, block.edge)) {
            if known.get(leaf_offset(seed)) {
                continue;
            }
            let w = self.winding.at((block.origin + seed).as_dvec3());
            let from_half = (w - w.floor() - 0.5).abs();
            if from_half <= WINDING_ERROR + slope * 2.0 * radius {
                return false;
            }
            known.set(leaf_offset(seed), true);
            open.push(seed);
            while let Some(voxel) = open.pop() {
                inside.set(leaf_offset(voxel), w > 0.5);
                for next in Face::ALL.map(|face| voxel + face.step()) {
                    if !block.holds(next) || known.get(leaf_offset(next)) {
                        continue;
                    }
                    if distance.is_none_or(|d| d.0[leaf_offset(voxel)] + d.0[leaf_offset(next)] > APART) {
                        known.set(leaf_offset(next), true);
                        open.push(next);
                    }
                }
            }
        }
        true
    }
}

/// A cube of voxels in the leaf at `origin`.
#[derive(Clone, Copy)]
struct Block {
    origin: IVec3,
    /// Its first voxel, in the leaf.
    start: IVec3,
    edge: i32,
}

impl Block {
    fn holds(&self, voxel: IVec3) -> bool {
        voxel.cmpge(self.start).all() && voxel.cmplt(self.start + self.edge).all()
    }
}

/// The first voxels of the cubes of `edge` that make up a leaf.
fn blocks(edge: i32) -> impl Iterator<Item = IVec3> {
    let count = LEAF_DIM / edge;
    (0..count.pow(3)).map(move |i| offset_in(i, count) * edge)
}

/// The voxel number `i` of a cube.
fn offset_in(i: i32, edge: i32) -> IVec3 {
    IVec3::new(i / edge / edge, i / edge % edge, i % edge)
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
        let rim = Rim::new(&mesh.positions, &mesh.triangles);
        let open = OpenInside { winding: &winding, rim: &rim };
        let leaves = distance_to_triangles(triangles.len(), |t| triangles[t], 3.0, &RunOptions::default()).unwrap();
        let mut seeded = 0;
        for leaf in leaves.iter().step_by(7) {
            let block = Block { origin: leaf.origin, start: IVec3::ZERO, edge: LEAF_DIM };
            let (mut mask, mut by_voxels) = (LeafMask::EMPTY, LeafMask::EMPTY);
            if open.by_seeds(block, Some(&leaf.distance), &mut mask) {
                seeded += 1;
                open.by_voxels(block, &mut by_voxels);
                for o in 0..crate::grid::LEAF_VOXELS {
                    assert!(leaf.distance.0[o] < 1e-3 || mask.get(o) == by_voxels.get(o), "{} {o}", leaf.origin);
                }
            }
        }
        assert!(seeded * 7 > leaves.len() / 2, "{seeded} of {}", leaves.len() / 7);
    }
}
