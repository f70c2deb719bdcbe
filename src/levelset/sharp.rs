//! The part of a sharp edge within a cell that the surface crosses.
//!
//! Polygons whose vertices lie on grid edges cut a sharp edge off, by up to half a voxel. The field of a distance function knows better: at
//! the sharp convex edge of a solid it is the maximum of its values for both sides, and each corner of the cell has the value and
//! the gradient of the side that it is nearest to. The edge is where these planes meet, found by least squares as in dual contouring (Ju et
//! al. 2002); it is the direction square to their normals.
//!
//! Gradients are differences to the side along each axis on which the field bends less (as in ENO schemes), so that they do not mix both sides.
//! What is found counts only if it is consistent: unit gradients, planes that meet, an angle of 30° or more between two of them. So surfaces with radii
//! of 3.3 voxels or more have no edges (their normals turn by √3 h/R within a cell), and noise has few.

use std::sync::atomic::{AtomicU64, Ordering};

use glam::{DMat3, DVec3, IVec3, Vec3};
use rayon::prelude::*;
use smallvec::SmallVec;

use super::isosurface::{IsoSurface, SurfaceLeaf, corner};
use super::marching::cell_case;
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LeafMask, leaf_offset, offset_to_local};
use crate::run::RunOptions;
use crate::stencil::Cube;

/// Differences of the field along parallel edges of a cell are apart by this where a sharp edge may pass, in voxels.
const BENT: f32 = 0.2;

/// Or the square of their mean is below this: where an edge crosses parallel edges of the cell alike, none differs from the others, but
/// gradients cancel. Balls of a radius of 3.3 voxels and cylinders of 3 stay above it (0.934 and 0.950 in the worst of 60,000 places).
const SHORT: f32 = 0.93;

/// How far a gradient may be from 1.
const UNEVEN: f64 = 0.15;

/// How far from each of the planes the point may lie where they meet, in voxels.
const APART: f64 = 0.25;

/// How far beyond its cell an edge may lie, in voxels: the tip of a wedge holds no voxel.
const BEYOND: f64 = 1.0;

/// cos 30°.
const LEAST_TURN: f64 = 0.866;

/// Weight of the middle of the crossings against the planes, which settles what these leave open.
const PULL: f64 = 0.01;

/// Cosine between a gradient and the direction of the edge from which on the planes have a corner.
const CORNER: f64 = 0.2;

/// Whether a sharp edge may pass a cell with these values at its corners, in voxels.
#[inline(always)]
fn may_be_sharp(values: &[f32; 8]) -> bool {
    let (mut bent, mut squared) = (false, 0.0);
    for step in [4, 2, 1] {
        let (mut lo, mut hi, mut sum) = (f32::INFINITY, f32::NEG_INFINITY, 0.0);
        for c in (0..8).filter(|c| c & step == 0) {
            let along = values[c | step] - values[c];
            (lo, hi, sum) = (lo.min(along), hi.max(along), sum + along);
        }
        bent |= hi - lo > BENT;
        squared += (sum / 4.0) * (sum / 4.0);
    }
    bent || squared < SHORT
}

/// Least height of a triangle at a sharp edge, in voxels.
const LEAST_HEIGHT: f32 = 1e-3;

/// Most triangles at a sharp edge: one at each of up to seven sides of the polygon, and one at each of its corners.
const MOST_TRIANGLES: u64 = 14;

/// The sharp convex edges of the solid `side`·(φ − iso) < 0, cell by cell.
pub(crate) struct SharpEdges {
    /// By the places of the surface's leaves.
    leaves: Vec<Vec<SharpEdge>>,
}

/// A sharp edge within a cell.
struct SharpEdge {
    /// The first corner of the cell, its place in the leaf.
    cell: u16,
    /// The cell's signs.
    pattern: u8,
    /// Relative to the first corner; twice the same at a corner of the solid.
    ends: [Vec3; 2],
}

impl SharpEdges {
    /// Looks at all cells of a surface; `scale` is one over the voxel size.
    pub fn new(
        surface: &IsoSurface,
        field: &Grid,
        (side, scale): (f32, f32),
        operation: &str,
        run: &RunOptions,
    ) -> Result<Self> {
        let (before, found) = (run.memory_in_use(), AtomicU64::new(0));
        let edges_of = |leaf: &SurfaceLeaf| {
            run.check(operation)?;
            let edges = edges_of_leaf(surface, field, leaf, (side, scale));
            let found = found.fetch_add(edges.len() as u64, Ordering::Relaxed) + edges.len() as u64;
            run.reserve_since(before, operation, found * size_of::<SharpEdge>() as u64, "take larger voxels")?;
            Ok(edges)
        };
        Ok(Self { leaves: surface.leaves().par_iter().map(edges_of).collect::<Result<_>>()? })
    }

    /// Most triangles that there can be in the leaf at a place.
    pub fn triangles_at_most(&self, place: usize) -> u64 {
        self.leaves[place].len() as u64 * MOST_TRIANGLES
    }

    /// Calls `f` with the first corner of a cell of the leaf at a place and a triangle, relative to that corner: the roofs over the polygons of
    /// those cells that are `wanted` and have a sharp edge.
    pub fn for_each_triangle(
        &self,
        surface: &IsoSurface,
        place: usize,
        wanted: impl Fn(IVec3) -> bool,
        mut f: impl FnMut(IVec3, [Vec3; 3]),
    ) {
        let mut values = None;
        for SharpEdge { cell, pattern, ends } in &self.leaves[place] {
            let cell = offset_to_local(usize::from(*cell));
            if !wanted(cell) {
                continue;
            }
            let values = values.get_or_insert_with(|| surface.values_of_cells(&surface.leaves()[place]));
            let case = cell_case(*pattern);
            let vertices = surface.vertices_of_cell(values, cell, case.crossed);
            let mut emit = |triangle: [Vec3; 3]| {
                let [a, b, c] = triangle;
                let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
                if (b - a).cross(c - a).length() > LEAST_HEIGHT * longest {
                    f(cell, triangle);
                }
            };
            // By end of the edge, the vertices that go to it.
            let mut joined = [0u16; 2];
            for segment in &case.segments {
                let [from, to] = segment.ends.map(usize::from);
                let (a, b) = (vertices[from], vertices[to]);
                let middle = (a + b) / 2.0;
                let nearer = usize::from(ends[1].distance_squared(middle) < ends[0].distance_squared(middle));
                joined[nearer] |= 1 << from | 1 << to;
                emit([ends[nearer], a, b]);
            }
            // Where the roof goes over from one end to the other; if it goes to one end only, the edge stands over all of it.
            let both = joined[0] & joined[1];
            let mut rest = if both == 0 { case.crossed } else { both };
            while rest != 0 {
                emit([ends[0], ends[1], vertices[rest.trailing_zeros() as usize]]);
                rest &= rest - 1;
            }
        }
    }
}

/// The sharp edges in the cells of one leaf.
fn edges_of_leaf(surface: &IsoSurface, field: &Grid, leaf: &SurfaceLeaf, (side, scale): (f32, f32)) -> Vec<SharpEdge> {
    let mut edges = Vec::new();
    let values = surface.values_of_cells(leaf);
    let mut around = None;
    surface.rows(leaf).for_each_cell(|cell, pattern| {
        let case = cell_case(pattern);
        let first = (cell.x * 81 + cell.y * 9 + cell.z) as usize;
        let mut corners = [0.0; 8];
        for (value, step) in corners.iter_mut().zip([0, 1, 9, 10, 81, 82, 90, 91]) {
            *value = values[first + step] * scale;
        }
        // Two pieces of surface in one cell are thinner than what differences tell apart.
        if case.loops != 1 || !may_be_sharp(&corners) {
            return;
        }
        let around = around.get_or_insert_with(|| {
            let mut cube = Cube::new(REACH);
            cube.gather(field.value_pages(), &field.neighbours()[leaf.id.index()], LeafMask::FULL);
            Around { cube, iso: surface.iso, side, scale }
        });
        let vertices = surface.vertices_of_cell(&values, cell, case.crossed);
        let crossings: SmallVec<[Vec3; 12]> =
            (0..12).filter(|edge| case.crossed >> edge & 1 == 1).map(|edge| vertices[edge]).collect();
        if let Some(ends) = sharp_edge(around, cell, &crossings) {
            edges.push(SharpEdge { cell: leaf_offset(cell) as u16, pattern, ends });
        }
    });
    edges
}

/// Voxels beyond a leaf that differences read: two before a cell's first corner, two after its last, which may lie one beyond.
const REACH: usize = 3;

/// A leaf and the voxels around it.
struct Around {
    cube: Cube,
    iso: f32,
    side: f32,
    scale: f32,
}

impl Around {
    /// side·(φ − iso) in voxels, of the six voxels from `ijk` on along an axis. Relative to the leaf.
    #[inline(always)]
    fn line(&self, ijk: IVec3, axis: usize) -> [f64; 6] {
        const LENGTH: usize = LEAF_DIM as usize + 2 * REACH;
        let mut line = [0.0; 6];
        for (k, value) in line.iter_mut().enumerate() {
            let mut at = ijk + REACH as i32;
            at[axis] += k as i32;
            let stored = self.cube.slab(at.x as usize)[at.y as usize * LENGTH + at.z as usize];
            *value = f64::from((stored - self.iso) * self.side * self.scale);
        }
        line
    }
}

/// The ends of the sharp edge in the cell with first corner `cell`, relative to that; twice the same at a corner. `crossings` are the
/// vertices of the cell.
fn sharp_edge(around: &Around, cell: IVec3, crossings: &[Vec3]) -> Option<[Vec3; 2]> {
    let (mut gradients, mut values) = ([DVec3::ZERO; 8], [0.0; 8]);
    for axis in 0..3 {
        let step = 4 >> axis;
        for c in (0..8).filter(|c| c & step == 0) {
            let mut first = cell + corner(c);
            first[axis] -= 2;
            let v = around.line(first, axis);
            for (c, k) in [(c, 2), (c | step, 3)] {
                let bend = [v[k] - 2.0 * v[k - 1] + v[k - 2], v[k + 2] - 2.0 * v[k + 1] + v[k]];
                gradients[c][axis] = if bend[0].abs() <= bend[1].abs() { v[k] - v[k - 1] } else { v[k + 1] - v[k] };
                values[c] = v[k];
            }
        }
    }
    let mut planes = [(DVec3::ZERO, 0.0); 8];
    let mut count = 0;
    for (c, (gradient, here)) in gradients.into_iter().zip(values).enumerate() {
        if (gradient.length() - 1.0).abs() <= UNEVEN {
            // n·z = d.
            planes[count] = (gradient, gradient.dot(corner(c).as_dvec3()) - here);
            count += 1;
        }
    }
    let planes = planes.get(..count)?;
    let pairs = planes.iter().enumerate().flat_map(|(i, (a, _))| planes[..i].iter().map(move |(b, _)| (*a, *b)));
    let (a, b) = pairs.min_by(|(a, b), (c, d)| a.dot(*b).total_cmp(&c.dot(*d)))?;
    if a.dot(b) > LEAST_TURN * a.length() * b.length() {
        return None;
    }
    let middle = crossings.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / crossings.len().max(1) as f64;
    let (mut matrix, mut right) = (DMat3::IDENTITY * PULL, DVec3::ZERO);
    for (n, d) in planes {
        matrix += DMat3::from_cols(*n * n.x, *n * n.y, *n * n.z);
        right += *n * (d - n.dot(middle));
    }
    let point = middle + matrix.inverse() * right;
    let near = |p: DVec3| (p - 0.5).abs().max_element() <= 0.5 + BEYOND;
    if !near(point) || planes.iter().any(|(n, d)| (n.dot(point) - d).abs() > APART) {
        return None;
    }
    let along = a.cross(b).normalize_or_zero();
    if planes.iter().any(|(n, _)| n.dot(along).abs() > CORNER) {
        return Some([point.as_vec3(); 2]);
    }
    // As far as the cell reaches.
    let to_side = |axis: usize, side: f64| (side - point[axis]) / along[axis];
    let span = (0..3).filter(|axis| along[*axis].abs() > 1e-6).map(|axis| {
        let (t, u) = (to_side(axis, 0.0), to_side(axis, 1.0));
        (t.min(u), t.max(u))
    });
    let (from, to) = span.fold((-1.0f64, 1.0f64), |(lo, hi), (t, u)| (lo.max(t), hi.min(u)));
    let (from, to) = if from <= to { (from.min(0.0), to.max(0.0)) } else { (0.0, 0.0) };
    Some([from, to].map(|t| (point + along * t).as_vec3()))
}
