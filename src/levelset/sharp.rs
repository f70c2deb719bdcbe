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

use glam::{DMat3, DVec3, IVec3, Vec3};

use super::isosurface::corner;
use crate::grid::Accessor;

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
pub(super) fn may_be_sharp(values: &[f32; 8]) -> bool {
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

/// The ends of the sharp convex edge of the solid `side`·(φ − iso) < 0 in the cell with first corner `cell`, relative to that; twice
/// the same at a corner. `crossings` are the vertices of the cell, `scale` is one over the voxel size.
pub(super) fn sharp_edge(
    accessor: &mut Accessor,
    cell: IVec3,
    crossings: &[Vec3],
    (iso, side, scale): (f32, f32, f32),
) -> Option<[Vec3; 2]> {
    let mut value = |ijk: IVec3| f64::from((accessor.value(ijk) - iso) * side * scale);
    let mut planes = [(DVec3::ZERO, 0.0); 8];
    let mut count = 0;
    for c in 0..8 {
        let at = cell + corner(c);
        let here = value(at);
        let gradient = DVec3::from_array(IVec3::AXES.map(|axis| {
            let [far, before, after, farther] = [-2, -1, 1, 2].map(|k| value(at + axis * k));
            let bend = [here - 2.0 * before + far, farther - 2.0 * after + here];
            if bend[0].abs() <= bend[1].abs() { here - before } else { after - here }
        }));
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
