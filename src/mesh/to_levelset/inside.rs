//! Which voxels are inside of a surface: those whose winding number is above ½.
//!
//! A mesh M with a boundary is closed by caps C over the cycles of its boundary. Then w(M) = w(M ∪ C) − w(C): the first is an
//! integer, counted by crossings along rows, and the second a sum over the few triangles of the caps, nearly zero far from them.
//! Where all caps together fill less than half of the view from a block of voxels, the integer alone decides; where none passes through
//! it and their winding number stays clear of ½ and its like, one place decides for all. Where the mesh itself does not pass
//! through it, w(M) is smooth: its values at the corners say what it is between them, up to an error that [`Rim`] bounds. Only
//! voxels nearer to ½ than that are asked one by one.

use std::f64::consts::PI;

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::crossings::Crossings;
use super::rays::crossings_above;
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
/// Voxels along the edge of the smallest blocks.
const BLOCK: i32 = LEAF_DIM / 2;
/// Corners of a block say nothing if the error between them might be larger.
const USELESS: f64 = 0.3;
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
    mesh: &'a Bvh,
    cap_tree: &'a Bvh,
    caps: WindingNumber<'a>,
    rim: &'a Rim,
}

impl<'a> Inside<'a> {
    /// Of a mesh, given with its boundary, the caps that close it, and the crossings of both together.
    pub fn new(crossings: Crossings, mesh: &'a Bvh, caps: &'a Bvh, rim: &'a Rim) -> Self {
        Self { crossings, mesh, cap_tree: caps, caps: WindingNumber::new(caps).exact_nearby(), rim }
    }

    /// Whether the integer winding number decides in a cube of voxels.
    pub fn is_integer(&self, start: IVec3, edge: i32) -> bool {
        // Half the diagonal of the lattice of the cube's voxels, √3/2 · (edge − 1), rounded up.
        let radius = 0.87 * f64::from(edge - 1);
        let center = start.as_dvec3() + 0.5 * f64::from(edge - 1);
        self.caps.is_below(center, radius, HALF * 4.0 * PI)
    }

    /// The winding numbers at voxels that lie near each other.
    pub fn windings(&self, voxels: &[IVec3; BATCH]) -> [f64; BATCH] {
        let caps = self.caps.at_each(&voxels.map(|ijk| ijk.as_dvec3() + ABOVE));
        std::array::from_fn(|i| f64::from(self.crossings.level(voxels[i])) - caps[i])
    }

    /// The winding numbers at points that lie near each other, none of them on a triangle.
    pub fn windings_at<const N: usize>(&self, points: &[DVec3; N]) -> [f64; N] {
        let caps = self.caps.at_each(points);
        let whole = |p| crossings_above(self.mesh, p) + crossings_above(self.cap_tree, p);
        std::array::from_fn(|i| f64::from(whole(points[i])) - caps[i])
    }

    /// The voxels of the leaf at `origin` that are inside.
    pub fn leaf(&self, origin: IVec3) -> LeafMask {
        if let Some(level) = self.level_inside(origin, LEAF_DIM) {
            return self.crossings.at_least(origin, level);
        }
        let mut inside = LeafMask::EMPTY;
        for i in 0..8 {
            let block = offset_in(i, 2) * BLOCK;
            let voxels = (0..BLOCK.pow(3)).map(|i| block + offset_in(i, BLOCK));
            if let Some(level) = self.level_inside(origin + block, BLOCK) {
                let mask = self.crossings.at_least(origin, level);
                voxels.map(leaf_offset).for_each(|o| inside.set(o, mask.get(o)));
            } else {
                self.by_voxels(origin, block, &mut inside);
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
        if self.cap_tree.any_in_box(lo, hi, |_| true) {
            return None;
        }
        let (threshold, error) = (self.caps.at(center) + 0.5, WINDING_ERROR + slope * radius);
        let level = (threshold - error).floor();
        (level == (threshold + error).floor()).then_some(level as i32 + 1)
    }

    /// Asks for the voxels of the block at `block` in the leaf at `origin`: for all of them, or for the corners and those that
    /// these leave open.
    fn by_voxels(&self, origin: IVec3, block: IVec3, inside: &mut LeafMask) {
        let corners: [IVec3; BATCH] = std::array::from_fn(|i| origin + block + offset_in(i as i32, 2) * (BLOCK - 1));
        let between = self.error_between(origin + block).map(|error| (self.windings(&corners), error));
        let mut asked = smallvec::SmallVec::<[IVec3; 64]>::new();
        // In cubes of eight, which are asked together.
        for i in 0..BLOCK.pow(3) {
            let local = offset_in(i / 8, 2) * 2 + offset_in(i % 8, 2);
            let mut set = |value| inside.set(leaf_offset(block + local), value);
            match between.map(|(corners, error)| (trilinear(&corners, local.as_dvec3() / f64::from(BLOCK - 1)), error))
            {
                Some((w, error)) if (w - LEVEL).abs() > error => set(w > LEVEL),
                _ => asked.push(block + local),
            }
        }
        for voxels in asked.chunks(BATCH) {
            let batch = std::array::from_fn(|i| origin + voxels[i.min(voxels.len() - 1)]);
            for (v, w) in voxels.iter().zip(self.windings(&batch)) {
                inside.set(leaf_offset(*v), w > LEVEL);
            }
        }
    }

    /// How far the winding number in a block may be from what its corners say; `None` where the mesh passes through it or
    /// they say nothing.
    ///
    /// Linear interpolation over a length h is off by no more than h²/8 times the second derivative.
    fn error_between(&self, start: IVec3) -> Option<f64> {
        let length = f64::from(BLOCK - 1);
        let (center, radius) = (start.as_dvec3() + 0.5 * length, 0.87 * length);
        let factor = length * length / 8.0;
        let bent = self.rim.most_bent(center, radius, USELESS / factor)?;
        let (lo, hi) = (start.as_dvec3() - BESIDE, start.as_dvec3() + length + BESIDE);
        (!self.mesh.any_in_box(lo, hi, |_| true)).then_some(bent * factor)
    }
}

/// The value at `at` in the unit cube with these values at its corners, the last coordinate running fastest.
fn trilinear(corners: &[f64; 8], at: DVec3) -> f64 {
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let along_z = |i: usize| mix(corners[i], corners[i + 1], at.z);
    mix(mix(along_z(0), along_z(2), at.y), mix(along_z(4), along_z(6), at.y), at.x)
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
        let whole = Bvh::new((0..count).map(|t| mesh.corners(t)).collect());
        let inside = Inside::new(crossings, &whole, &closing, &rim);
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
                let [own, ..] = inside.windings(&[ijk; BATCH]);
                assert!(on_surface || (own - w).abs() < 0.03, "{ijk}: {w} {own}");
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
