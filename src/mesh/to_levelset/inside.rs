//! Which voxels are inside of a surface: those whose winding number is above ½.
//!
//! A mesh M with a boundary is closed by caps C over the cycles of its boundary. Then w(M) = w(M ∪ C) − w(C): the first is an
//! integer, counted by crossings along rows, and the second a sum over the few triangles of the caps, nearly zero far from them.
//! Where all caps together fill less than half of the view from a block of voxels, the integer alone decides; where none passes through
//! it and their winding number stays clear of ½ and its like, one place decides for all; else every voxel is asked.

use std::f64::consts::PI;

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::crossings::Crossings;
use super::rim::{Rim, WINDING_ERROR};
use crate::grid::{LEAF_DIM, LeafMask, leaf_offset};
use crate::mesh::winding::BATCH;
use crate::mesh::{Bvh, WindingNumber};

/// ½, and what the sums may be off: beside a sheet the winding number comes near to ½ and must not pass for more.
const LEVEL: f64 = 0.501;
/// What lies this near to a cube of voxels, in voxels, may pass through it.
const BESIDE: f64 = 0.01;
/// The part of the view, of ½, up to which caps decide nothing; the rest is for the error of fast winding numbers.
const HALF: f64 = 0.48;
/// Where winding numbers of caps are asked for, relative to the voxel: crossings count a voxel on a triangle as above it in
/// z, and in x and y beyond it, so the caps must be seen from there.
const ABOVE: DVec3 = DVec3::new(3e-7, 1e-7, 1e-5);

/// The triangles that close a mesh with the given boundary chain.
///
/// The chain is a sum of cycles. Each is halved again and again: two edges in a row and the chord that takes their place are a
/// triangle. So most triangles are small and lie at the boundary, and few are large.
pub(super) fn caps(positions: &[DVec3], chain: &[([u32; 2], i32)]) -> Vec<[DVec3; 3]> {
    // Against the direction in which the mesh runs along each edge, as often as it does.
    let directed = |&([a, b], net): &([u32; 2], i32)| {
        let ends = if net > 0 { (b, a) } else { (a, b) };
        std::iter::repeat_n(ends, net.unsigned_abs() as usize)
    };
    let mut edges: Vec<(u32, u32)> = chain.iter().flat_map(directed).collect();
    edges.sort_unstable();
    // The first edge from each vertex that was not walked yet.
    let mut next: FxHashMap<u32, usize> = FxHashMap::default();
    for i in (0..edges.len()).rev() {
        next.insert(edges[i].0, i);
    }
    let mut caps = Vec::new();
    for start in 0..edges.len() {
        // As many edges arrive at a vertex as leave it, so a walk ends where it began.
        let mut cycle = Vec::new();
        let mut at = edges[start].0;
        while let Some(i) = next.get_mut(&at).filter(|i| edges.get(**i).is_some_and(|edge| edge.0 == at)) {
            cycle.push(at);
            at = edges[*i].1;
            *i += 1;
        }
        while cycle.len() > 2 {
            let mut left = Vec::with_capacity(cycle.len() / 2 + 1);
            for pair in cycle.chunks(2) {
                left.push(pair[0]);
            }
            let closing = cycle[0];
            for (i, pair) in cycle.chunks_exact(2).enumerate() {
                let end = left.get(i + 1).copied().unwrap_or(closing);
                caps.push([pair[0], pair[1], end].map(|v| positions[v as usize]));
            }
            cycle = left;
        }
    }
    caps
}

/// Tells inside from outside, leaf by leaf.
pub(super) struct Inside<'a> {
    crossings: Crossings,
    tree: &'a Bvh,
    caps: WindingNumber<'a>,
    rim: &'a Rim,
}

impl<'a> Inside<'a> {
    /// Of a mesh whose crossings, with those of the caps that close it, and boundary are given.
    pub fn new(crossings: Crossings, caps: &'a Bvh, rim: &'a Rim) -> Self {
        Self { crossings, tree: caps, caps: WindingNumber::new(caps).exact_nearby(), rim }
    }

    /// Places where the integer winding number is neither 0 nor 1: see [`Crossings::overlaps`].
    pub fn overlaps(&self) -> &[IVec3] {
        self.crossings.overlaps()
    }

    /// Whether the integer winding number decides in a cube of voxels.
    pub fn is_integer(&self, start: IVec3, edge: i32) -> bool {
        // Half the diagonal of the lattice of the cube's voxels, √3/2 · (edge − 1), rounded up.
        let radius = 0.87 * f64::from(edge - 1);
        let center = start.as_dvec3() + 0.5 * f64::from(edge - 1);
        self.caps.is_below(center, radius, HALF * 4.0 * PI)
    }

    /// The winding number at a voxel.
    pub fn winding(&self, ijk: IVec3) -> f64 {
        f64::from(self.crossings.level(ijk)) - self.caps.at(ijk.as_dvec3() + ABOVE)
    }

    /// The voxels of the leaf at `origin` that are inside.
    pub fn leaf(&self, origin: IVec3) -> LeafMask {
        if let Some(level) = self.level_inside(origin, LEAF_DIM) {
            return self.crossings.at_least(origin, level);
        }
        let mut inside = LeafMask::EMPTY;
        for octant in blocks(LEAF_DIM / 2) {
            if let Some(level) = self.level_inside(origin + octant, LEAF_DIM / 2) {
                let mask = self.crossings.at_least(origin, level);
                (0..(LEAF_DIM / 2).pow(3)).map(|i| leaf_offset(octant + offset_in(i, LEAF_DIM / 2))).for_each(|o| {
                    inside.set(o, mask.get(o));
                });
            } else {
                (0..8).for_each(|i| self.by_voxels(origin, octant + offset_in(i, 2) * 2, &mut inside));
            }
        }
        inside
    }

    /// The integer winding number from which on the voxels of a cube are inside, if it is one for all.
    ///
    /// Between the triangles of the caps their winding number changes no faster than the boundary lets it.
    fn level_inside(&self, start: IVec3, edge: i32) -> Option<i32> {
        if self.is_integer(start, edge) {
            return Some(1);
        }
        let radius = 0.87 * f64::from(edge - 1);
        let center = start.as_dvec3() + 0.5 * f64::from(edge - 1);
        let slope = self.rim.steepest(center, radius, 0.5 / radius)?;
        let (lo, hi) = (start.as_dvec3() - BESIDE, (start + edge - 1).as_dvec3() + BESIDE);
        if self.tree.any_in_box(lo, hi, |_| true) {
            return None;
        }
        let (threshold, error) = (self.caps.at(center) + 0.5, WINDING_ERROR + slope * radius);
        let level = (threshold - error).floor();
        (level == (threshold + error).floor()).then_some(level as i32 + 1)
    }

    /// Asks for each of the eight voxels from `start` in the leaf at `origin`.
    fn by_voxels(&self, origin: IVec3, start: IVec3, inside: &mut LeafMask) {
        let voxels: [IVec3; BATCH] = std::array::from_fn(|i| start + offset_in(i as i32, 2));
        let caps = self.caps.at_each::<BATCH>(&voxels.map(|v| (origin + v).as_dvec3() + ABOVE));
        for (v, caps) in voxels.into_iter().zip(caps) {
            inside.set(leaf_offset(v), f64::from(self.crossings.level(origin + v)) - caps > LEVEL);
        }
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
    use crate::grid::{LEAF_VOXELS, offset_to_local};
    use crate::mesh::TriangleMesh;
    use crate::mesh::testing::*;
    use crate::mesh::topology::{boundary_chain, edge_uses};

    /// Inside says what the winding number of the open mesh says, wherever that is not all but ½.
    fn check(mesh: &TriangleMesh) {
        let chain = boundary_chain(&edge_uses(&mesh.triangles));
        let caps = caps(&mesh.positions, &chain);
        let count = mesh.triangles.len();
        let corners = |t: usize| if t < count { mesh.corners(t) } else { caps[t - count] };
        let crossings = Crossings::new(count + caps.len(), corners);
        let closing = Bvh::new(caps.clone());
        let rim = Rim::new(&mesh.positions, &chain);
        let inside = Inside::new(crossings, &closing, &rim);
        let whole = Bvh::new((0..count).map(|t| mesh.corners(t)).collect());
        let winding = WindingNumber::new(&whole);
        let (lo, hi) = mesh.bounding_box().unwrap();
        let (lo, hi) = ((lo / 8.0).floor().as_ivec3() - 1, (hi / 8.0).floor().as_ivec3() + 1);
        let mut by_integer = 0;
        for i in 0..(hi - lo + 1).element_product() {
            let size = hi - lo + 1;
            let origin = (lo + IVec3::new(i / (size.y * size.z), i / size.z % size.y, i % size.z)) * 8;
            by_integer += u32::from(inside.is_integer(origin, 8));
            let mask = inside.leaf(origin);
            for o in (0..LEAF_VOXELS).step_by(3) {
                let ijk = origin + offset_to_local(o);
                let on_surface = whole.closest_point(ijk.as_dvec3(), 1e-3).is_some();
                let w = winding.at(ijk.as_dvec3());
                assert!(on_surface || (w - 0.5).abs() < 0.03 || mask.get(o) == (w > 0.5), "{ijk}: {w}");
                assert!(on_surface || (inside.winding(ijk) - w).abs() < 0.03, "{ijk}: {w} {}", inside.winding(ijk));
            }
        }
        assert!(by_integer > 0);
    }

    #[test]
    fn caps_and_integers_make_the_winding_number_of_open_meshes() {
        let mut mesh = sphere(DVec3::splat(0.37), 24.0, 30);
        mesh.triangles.truncate(mesh.triangles.len() - 40);
        check(&mesh);
        // A cube without its lid, all in planes of the lattice.
        let mut open = cube(DVec3::splat(-16.0), 32.0);
        open.triangles.truncate(10);
        check(&open);
        // Two sheets that share a boundary edge, and one far off.
        let sheets = joined(TriangleMesh { triangles: open.triangles[..3].to_vec(), ..open.clone() }, &mesh);
        check(&sheets);
    }
}
