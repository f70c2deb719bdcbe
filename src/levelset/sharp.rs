//! The part of a sharp edge within a cell that the surface crosses.
//!
//! Polygons whose vertices lie on grid edges cut a sharp edge off, by up to half a voxel. The field of a distance function knows better: inside
//! the sharp convex edge of a solid it is the maximum of its values for both sides, and the edge is where the faces meet whose distances these are.
//! Outside, it may be that of the faces, too, or, after an erosion, the fan of distances from the edge: only voxels inside are looked at.
//!
//! Faces are told by voxels around the cell at which the field does not bend: their normals fall into two or three directions, 40° or more apart, and hardly
//! any lies between them. (So a rounded edge has none.) Next to the edge each voxel is given to the face whose normal is nearest to
//! its one-sided differences, taken along each axis to the side that fits. Each then has the tangent plane at its foot point. A curved face
//! lies r²κ/2 below a plane that touches it at a distance r: the height of the face above the edge is what regression on r² says of r = 0. The edge is where
//! these planes meet, by least squares as in dual contouring (Ju et al. 2002).
//!
//! Against edges of known solids, before an opening and after it: 0.02 to 0.06 voxel where plane faces meet at 45° to 130°, 0.05 to 0.12 between spheres of 9 to
//! 19 voxels. Wedges below 45° hold too few voxels: their edges stay cut off.

use std::cmp::Ordering;

use glam::{DMat3, DVec3, IVec3, Vec3};
use smallvec::{SmallVec, smallvec};

use crate::grid::Accessor;

/// Differences of the field along parallel edges of a cell are apart by this where a sharp edge may pass, in voxels.
const BENT: f32 = 0.2;

/// The square of the mean gradient in a cell below which a sharp edge may pass.
const SHORT: f32 = 0.94;

/// Second difference, in voxels, up to which the field does not bend.
const SMOOTH: f64 = 0.15;

/// How far a gradient may be from 1.
const UNEVEN: f64 = 0.05;

/// cos 40°: between two faces.
const LEAST_TURN: f64 = 0.766;

/// Cosine to the normal of a face from which on a voxel is of it.
const OF_FACE: f64 = 0.9;

/// Part of the voxels around that may be of no face.
const BETWEEN: f64 = 0.1;

/// How far the normal of a voxel beside the edge may be from that of its face.
const TURNED: f64 = 0.4;

/// Depth, in voxels, down to which voxels beside the edge are asked.
const DEPTH: f64 = 1.5;

/// Foot points count as the inverse square of the square of their distance, in voxels, and this.
const NEXT: f64 = 0.3;

/// Largest κ/2 of a face, and what keeps it near 0 where the feet do not tell.
const MOST_CURVED: f64 = 0.2;
const RIDGE: f64 = 0.1;

/// How far from each of the faces the point may lie where they meet, in voxels.
const APART: f64 = 0.15;

/// Mean height of the foot points of one face above the other from which on an edge is concave, in voxels.
const CONCAVE: f64 = 0.3;

/// How far beyond its cell an edge may lie, in voxels: the tip of a wedge holds no voxel.
const BEYOND: f64 = 0.5;

/// Weight of the middle of the crossings against the faces, which settles what these leave open.
const PULL: f64 = 0.01;

/// Whether a sharp edge may pass a cell with these values at its corners, in voxels.
#[inline(always)]
pub(super) fn may_be_sharp(values: &[f32; 8]) -> bool {
    let mut squared = 0.0;
    for step in [4, 2, 1] {
        let along = (0..8).filter(|c| c & step == 0).map(|c| values[c | step] - values[c]);
        let (lo, hi, sum) =
            along.fold((f32::INFINITY, f32::NEG_INFINITY, 0.0), |(lo, hi, sum), d| (lo.min(d), hi.max(d), sum + d));
        if hi - lo > BENT {
            return true;
        }
        squared += sum * sum / 16.0;
    }
    squared < SHORT
}

/// The ends of the sharp convex edge of the solid `side`·(φ − iso) < 0 in the cell with first corner `cell`, relative to that; twice
/// the same at a corner. `crossings` are the vertices of the cell, `scale` is one over the voxel size.
pub(super) fn sharp_edge(
    accessor: &mut Accessor,
    cell: IVec3,
    crossings: &[Vec3],
    (iso, side, scale): (f32, f32, f32),
) -> Option<[Vec3; 2]> {
    let block = Block::new(|at| f64::from((accessor.value(cell + at) - iso) * side * scale));
    let normals = block.normals_of_faces()?;
    let touching = block.touching(&normals);
    let middle = crossings.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / crossings.len().max(1) as f64;
    let faces = |at: DVec3| -> Faces { touching.iter().filter_map(|feet| Face::at(feet, at)).collect() };
    let mut found = faces(middle);
    if found.len() == 2 {
        found = faces(meeting(&found, middle));
    }
    if found.len() < 2 {
        return None;
    }
    found.sort_by(|a, b| (a.height(middle).abs()).total_cmp(&b.height(middle).abs()));
    let is_edge = |faces: &[Face], point: DVec3| {
        (point - 0.5).abs().max_element() <= 0.5 + BEYOND && faces.iter().all(|face| face.height(point).abs() <= APART)
    };
    let mut third = None;
    if let [_, _, last] = *found {
        let corner = meeting(&found, middle);
        if (corner - 0.5).abs().max_element() <= 0.5 && is_edge(&found, corner) {
            return Some([corner.as_vec3(); 2]);
        }
        third = Some(last);
    }
    let [a, b] = *found.first_chunk()?;
    let point = meeting(&[a, b], middle);
    // A foot point of one face lies behind the other.
    let feet = || touching.iter().flatten();
    let beyond: f64 = feet().map(|foot| a.height(foot.point).max(b.height(foot.point))).sum();
    let is_convex = beyond < CONCAVE * feet().count() as f64;
    if a.normal.dot(b.normal) > LEAST_TURN || !is_convex || !is_edge(&[a, b], point) {
        return None;
    }
    // From side to side of the cell along the axis that the edge follows most, and not beyond a third face.
    let along = a.normal.cross(b.normal).normalize_or_zero();
    let axis = (0..3).max_by(|i, k| along[*i].abs().total_cmp(&along[*k].abs()))?;
    let (t, u) = (-point[axis] / along[axis], (1.0 - point[axis]) / along[axis]);
    let (mut from, mut to) = (t.min(u), t.max(u));
    if let Some(face) = third {
        let rise = face.normal.dot(along);
        let end = -face.height(point) / rise;
        match rise.partial_cmp(&0.0) {
            Some(Ordering::Greater) => to = to.min(end),
            Some(Ordering::Less) => from = from.max(end),
            _ => {}
        }
    }
    (from <= to).then(|| [from, to].map(|t| (point + along * t).as_vec3()))
}

/// The field around a cell, in voxels, negative inside.
struct Block([f64; Self::SIZE * Self::SIZE * Self::SIZE]);

impl Block {
    /// Voxels beyond the cell's corners.
    const RIM: i32 = 3;
    const SIZE: usize = 2 * Self::RIM as usize + 2;

    fn new(mut value: impl FnMut(IVec3) -> f64) -> Self {
        let mut block = Self([0.0; Self::SIZE * Self::SIZE * Self::SIZE]);
        for (n, at) in (0..).zip(&mut block.0) {
            *at = value(IVec3::new(n / 64, n / 8 % 8, n % 8) - Self::RIM);
        }
        block
    }

    fn value(&self, at: IVec3) -> f64 {
        let IVec3 { x, y, z } = at + Self::RIM;
        self.0[(x * 64 + y * 8 + z) as usize]
    }

    /// Values before and after a voxel along each axis.
    fn beside(&self, at: IVec3) -> [(f64, f64); 3] {
        IVec3::AXES.map(|axis| (self.value(at - axis), self.value(at + axis)))
    }

    /// The normals of the two or three faces that are around the cell, if there are as many.
    fn normals_of_faces(&self) -> Option<SmallVec<[DVec3; 3]>> {
        let mut normals: SmallVec<[DVec3; 64]> = SmallVec::new();
        for at in (0..216).map(|n| IVec3::new(n / 36, n / 6 % 6, n % 6) - (Self::RIM - 1)) {
            let (here, beside) = (self.value(at), self.beside(at));
            if here < 0.0 && beside.iter().all(|(before, after)| (before + after - 2.0 * here).abs() < SMOOTH) {
                let gradient = DVec3::from_array(beside.map(|(before, after)| (after - before) / 2.0));
                if (gradient.length() - 1.0).abs() <= UNEVEN {
                    normals.push(gradient.normalize());
                }
            }
        }
        let nearest = |ends: &[DVec3], normal: &DVec3| ends.iter().map(|end| end.dot(*normal)).fold(-1.0, f64::max);
        let farthest =
            |ends: &[DVec3]| normals.iter().copied().min_by(|a, b| nearest(ends, a).total_cmp(&nearest(ends, b)));
        let first = farthest(&[*normals.first()?])?;
        let mut ends: SmallVec<[DVec3; 3]> = smallvec![first, farthest(&[first])?];
        if ends[0].dot(ends[1]) > LEAST_TURN {
            return None;
        }
        ends.extend(farthest(&ends).filter(|normal| nearest(&ends, normal) < LEAST_TURN));
        let mut sums: SmallVec<[DVec3; 3]> = SmallVec::from_elem(DVec3::ZERO, ends.len());
        let mut of_faces = 0;
        for normal in &normals {
            let cosines = ends.iter().map(|end| end.dot(*normal));
            let nearest = cosines.zip(&mut sums).max_by(|(a, _), (b, _)| a.total_cmp(b));
            if let Some((_, sum)) = nearest.filter(|(cosine, _)| *cosine >= OF_FACE) {
                *sum += *normal;
                of_faces += 1;
            }
        }
        let between = normals.len() - of_faces;
        (between as f64 <= BETWEEN * normals.len() as f64)
            .then(|| sums.iter().map(|sum| sum.normalize_or_zero()).collect())
    }

    /// Of each face, what the voxels beside the edge know of it.
    fn touching(&self, normals: &[DVec3]) -> SmallVec<[Feet; 3]> {
        let mut touching: SmallVec<[Feet; 3]> = normals.iter().map(|_| Feet::new()).collect();
        for at in (0..64).map(|n| IVec3::new(n / 16, n / 4 % 4, n % 4) - 1) {
            let here = self.value(at);
            if !(-DEPTH..0.0).contains(&here) {
                continue;
            }
            let beside = self.beside(at).map(|(before, after)| (here - before, after - here));
            let fitting = |normal: &DVec3| {
                DVec3::from_array(std::array::from_fn(|axis| {
                    let (before, after) = beside[axis];
                    if (before - normal[axis]).abs() <= (after - normal[axis]).abs() { before } else { after }
                }))
            };
            let by_face = normals.iter().map(|normal| (fitting(normal), fitting(normal).distance(*normal)));
            let best = by_face.zip(&mut touching).min_by(|((_, a), _), ((_, b), _)| a.total_cmp(b));
            if let Some(((gradient, off), feet)) = best
                && off <= TURNED
                && (gradient.length() - 1.0).abs() <= UNEVEN
            {
                let normal = gradient.normalize();
                feet.push(Foot { normal, point: at.as_dvec3() - normal * here });
            }
        }
        touching
    }
}

/// A point of a face.
struct Foot {
    normal: DVec3,
    point: DVec3,
}

type Feet = SmallVec<[Foot; 32]>;

/// A plane that touches a face.
#[derive(Clone, Copy)]
struct Face {
    normal: DVec3,
    /// n·x of the plane.
    level: f64,
}

type Faces = SmallVec<[Face; 3]>;

impl Face {
    /// Where the face is nearest to `at`, as far as `feet` know it.
    fn at(feet: &[Foot], at: DVec3) -> Option<Self> {
        let weight = |foot: &Foot| (NEXT + foot.point.distance_squared(at)).powi(-2);
        let total: f64 = feet.iter().map(weight).sum();
        if total == 0.0 {
            return None;
        }
        let mean = |of: &dyn Fn(&Foot) -> f64| feet.iter().map(|foot| weight(foot) * of(foot)).sum::<f64>() / total;
        let normal = feet.iter().map(|foot| foot.normal * weight(foot)).sum::<DVec3>().try_normalize()?;
        let apart = |foot: &Foot| {
            let by = at - foot.point;
            by.length_squared() - by.dot(foot.normal).powi(2)
        };
        let level = |foot: &Foot| foot.normal.dot(foot.point - at);
        let (mean_apart, mean_level) = (mean(&apart), mean(&level));
        let spread = mean(&|foot| (apart(foot) - mean_apart).powi(2));
        let common = mean(&|foot| (apart(foot) - mean_apart) * (level(foot) - mean_level));
        let slope = (common / (spread + RIDGE)).clamp(-MOST_CURVED, MOST_CURVED);
        Some(Self { normal, level: mean_level - slope * mean_apart + normal.dot(at) })
    }

    fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.level
    }
}

/// Where faces meet, near `middle`.
fn meeting(faces: &[Face], middle: DVec3) -> DVec3 {
    let (mut matrix, mut right) = (DMat3::IDENTITY * PULL, DVec3::ZERO);
    for face in faces {
        let n = face.normal;
        matrix += DMat3::from_cols(n * n.x, n * n.y, n * n.z);
        right -= n * face.height(middle);
    }
    middle + matrix.inverse() * right
}
