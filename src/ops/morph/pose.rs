//! The coordinate transformation under a morph (Breen & Whitaker 2001): the target is seen in the frame of the source, where the surface flows; each
//! frame is then placed by the transformation as far as it has gone.
//!
//! > T(x, α) = p + α d + s^α q^α ((x + α u(x)) − p),  T(·, 0) = id
//!
//! with a pivot p, a shift d, a scale s, a rotation q (by slerp) and the thin-plate displacement u of landmarks. T(·, 1) takes the source's frame to
//! the target's. The similarity is given, that of the moments, or the best for the landmarks, of which u is the rest.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::Matrix3;
use rayon::prelude::*;

use super::NAME;
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, TriangleMesh, level_set_of_mesh, level_set_to_mesh};
use crate::ops::warp::Displacement;
use crate::run::RunOptions;

/// Surface points that rotations are compared on.
const PROBES: usize = 1500;

/// A rotation is taken instead of a smaller one if the shapes then are nearer by this part.
const BETTER: f64 = 0.95;

/// Steps of Newton's iteration, and when it is there, as a part of a voxel.
const MOST_NEWTON_STEPS: usize = 50;
const NEWTON_TOLERANCE: f64 = 1e-6;

/// T.
#[derive(Clone)]
pub(super) struct Pose {
    pivot: DVec3,
    shift: DVec3,
    scale: f64,
    rotation: DQuat,
    warp: Option<Arc<Displacement>>,
}

impl Pose {
    /// From a similarity of the world, about a pivot.
    pub fn of_similarity(map: DAffine3, pivot: DVec3) -> Option<Self> {
        let scale = map.matrix3.determinant().cbrt();
        if !(scale > 0.0 && scale.is_finite()) {
            return None;
        }
        let rotation = DQuat::from_mat3(&(map.matrix3 * (1.0 / scale))).normalize();
        Some(Self { pivot, shift: map.transform_point3(pivot) - pivot, scale, rotation, warp: None })
    }

    /// The shift of the centres of two solids.
    pub fn of_centres(from: &Moments, to: &Moments) -> Self {
        let shift = to.centre - from.centre;
        Self { pivot: from.centre, shift, scale: 1.0, rotation: DQuat::IDENTITY, warp: None }
    }

    /// By the moments of two solids: centres, axes, size. Of the rotations that take axes to axes, and none, the one is taken after which the
    /// surfaces are nearest to each other.
    pub fn of_moments(from: &TriangleMesh, to: &TriangleMesh) -> Option<Self> {
        let (a, b) = (Moments::of(from)?, Moments::of(to)?);
        let scale = (b.size() / a.size()).sqrt();
        let step = from.positions.len().div_ceil(PROBES).max(1);
        let probes: Vec<DVec3> = from.positions.iter().step_by(step).map(|p| *p - a.centre).collect();
        let tree = Bvh::new((0..to.triangles.len()).map(|t| to.corners(t)).collect());
        let apart = |rotation: &DQuat| {
            let of_probe = |p: &DVec3| {
                let hit = tree.closest_point(b.centre + *rotation * (*p * scale), f64::INFINITY);
                hit.map_or(0.0, |hit| hit.distance_squared)
            };
            probes.par_iter().map(of_probe).collect::<Vec<f64>>().into_iter().sum::<f64>()
        };
        let (axes_a, axes_b) = (a.axes(), b.axes());
        let turns = [DVec3::ONE, DVec3::new(1.0, -1.0, -1.0), DVec3::new(-1.0, 1.0, -1.0), DVec3::new(-1.0, -1.0, 1.0)];
        let mut rotations =
            turns.map(|turn| DQuat::from_mat3(&(axes_b * DMat3::from_diagonal(turn) * axes_a.transpose())).normalize());
        // Shapes with symmetries turn no further than they must.
        rotations.sort_by(|a, b| b.w.abs().total_cmp(&a.w.abs()));
        let mut best = (DQuat::IDENTITY, apart(&DQuat::IDENTITY));
        for rotation in rotations {
            let apart = apart(&rotation);
            if apart < best.1 * BETTER {
                best = (rotation, apart);
            }
        }
        Some(Self { pivot: a.centre, shift: b.centre - a.centre, scale, rotation: best.0, warp: None })
    }

    /// The best similarity for pairs of points of source and target (Umeyama 1991), and the displacement that is left.
    pub fn of_landmarks(pairs: &[(DVec3, DVec3)]) -> Result<Self> {
        let n = pairs.len() as f64;
        let centre = |of: fn(&(DVec3, DVec3)) -> DVec3| pairs.iter().map(of).sum::<DVec3>() / n;
        let (a, b) = (centre(|p| p.0), centre(|p| p.1));
        let size = |of: fn(&(DVec3, DVec3)) -> DVec3, centre: DVec3| {
            pairs.iter().map(|p| of(p).distance_squared(centre)).sum::<f64>()
        };
        let (size_a, size_b) = (size(|p| p.0, a), size(|p| p.1, b));
        if !(size_a > 0.0 && size_b > 0.0) {
            let accepted = "two or more pairs of points at different places";
            return Err(EditError::parameter(NAME, "landmarks", pairs.len(), accepted));
        }
        let mut cross = Matrix3::zeros();
        for (p, q) in pairs {
            let (p, q) = (*p - a, *q - b);
            cross += Matrix3::from_fn(|i, j| q[i] * p[j]);
        }
        let rotation = rotation_of(&cross);
        let scale = (size_b / size_a).sqrt();
        let mut pose = Self { pivot: a, shift: b - a, scale, rotation, warp: None };
        let rest: Vec<(DVec3, DVec3)> = pairs.iter().map(|(p, q)| (*p, pose.unplaced(*q, 1.0) - *p)).collect();
        let refused = |_| {
            let accepted = "pairs of points whose first points are at different places";
            EditError::parameter(NAME, "landmarks", pairs.len(), accepted)
        };
        pose.warp = Some(Arc::new(Displacement::new(&rest).map_err(refused)?));
        Ok(pose)
    }

    /// T(x, α).
    pub fn at(&self, x: DVec3, alpha: f64) -> DVec3 {
        let x = match &self.warp {
            Some(warp) => x + warp.at(x) * alpha,
            None => x,
        };
        let turned = DQuat::IDENTITY.slerp(self.rotation, alpha) * (x - self.pivot);
        self.pivot + self.shift * alpha + turned * self.scale.powf(alpha)
    }

    /// What the similarity at α takes to y.
    fn unplaced(&self, y: DVec3, alpha: f64) -> DVec3 {
        let turned = DQuat::IDENTITY.slerp(self.rotation, alpha).inverse() * (y - self.pivot - self.shift * alpha);
        self.pivot + turned / self.scale.powf(alpha)
    }

    /// The x with T(x, α) = y; `None` where the iteration does not end.
    pub fn inverse(&self, y: DVec3, alpha: f64, voxel_size: f64) -> Option<DVec3> {
        let target = self.unplaced(y, alpha);
        let Some(warp) = &self.warp else { return Some(target) };
        let mut x = target;
        for _ in 0..MOST_NEWTON_STEPS {
            let error = x + warp.at(x) * alpha - target;
            if error.length() < NEWTON_TOLERANCE * voxel_size {
                return Some(x);
            }
            let slope = gradient(warp, x, voxel_size) - DMat3::IDENTITY;
            x -= (DMat3::IDENTITY + slope * alpha).inverse() * error;
            if !x.is_finite() {
                return None;
            }
        }
        None
    }

    /// The target in the frame of the source: T⁻¹ of its surface, on the lattice of `like`. Refused if T folds there on its way.
    pub fn unposed(&self, target: &LevelSet, like: &LevelSet, run: &RunOptions) -> Result<LevelSet> {
        let mut mesh = level_set_to_mesh(target, 0.0, run)?;
        let voxel_size = like.voxel_size();
        let found: Vec<Option<DVec3>> = mesh
            .positions
            .par_iter()
            .map(|y| self.inverse(*y, 1.0, voxel_size).filter(|x| !self.folds(*x, voxel_size)))
            .collect();
        run.check(NAME)?;
        for (position, found) in mesh.positions.iter_mut().zip(found) {
            let Some(found) = found else {
                let accepted = "landmarks whose displacements differ less between neighbours";
                let value = format!("a map that folds at {position}");
                return Err(EditError::parameter(NAME, "landmarks", value, accepted));
            };
            *position = found;
        }
        level_set_of_mesh(mesh, like.transform(), like.half_width(), run)
    }

    /// Whether x + α u(x) turns space inside out at x for some α in 0..1.
    fn folds(&self, x: DVec3, voxel_size: f64) -> bool {
        let Some(warp) = &self.warp else { return false };
        let slope = gradient(warp, x, voxel_size) - DMat3::IDENTITY;
        (1..=8).any(|n| (DMat3::IDENTITY + slope * (f64::from(n) / 8.0)).determinant() <= 0.0)
    }

    /// A level set placed by T(·, α), on its own lattice.
    pub fn posed(&self, level_set: &LevelSet, alpha: f64, run: &RunOptions) -> Result<LevelSet> {
        let mut mesh = level_set_to_mesh(level_set, 0.0, run)?;
        mesh.positions.par_iter_mut().for_each(|p| *p = self.at(*p, alpha));
        level_set_of_mesh(mesh, level_set.transform(), level_set.half_width(), run)
    }

    /// Scale, shift and angle, for the report.
    pub fn describe(&self) -> String {
        let degrees = 2.0 * self.rotation.w.abs().min(1.0).acos().to_degrees();
        format!("scale {:.4}, turn {degrees:.2} degrees, shift {}", self.scale, self.shift)
    }
}

/// I + ∇u.
fn gradient(warp: &Displacement, x: DVec3, voxel_size: f64) -> DMat3 {
    let step = voxel_size / 2.0;
    let along = |axis: DVec3| axis + (warp.at(x + axis * step) - warp.at(x - axis * step)) / (2.0 * step);
    DMat3::from_cols(along(DVec3::X), along(DVec3::Y), along(DVec3::Z))
}

/// The rotation nearest to a matrix.
fn rotation_of(matrix: &Matrix3<f64>) -> DQuat {
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v)) = (svd.u, svd.v_t) else { return DQuat::IDENTITY };
    let sign = (u.determinant() * v.determinant()).signum();
    let r = u * Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, sign)) * v;
    let r = DMat3::from_cols_array(&[r.m11, r.m21, r.m31, r.m12, r.m22, r.m32, r.m13, r.m23, r.m33]);
    DQuat::from_mat3(&r).normalize()
}

/// Centre and second moments of a solid.
pub(super) struct Moments {
    pub centre: DVec3,
    /// ∫ (x − c)(x − c)ᵀ over the solid, a unit of volume.
    spread: Matrix3<f64>,
}

impl Moments {
    /// Of a closed mesh, by the tetrahedra of its triangles with a point; `None` without a volume.
    pub fn of(mesh: &TriangleMesh) -> Option<Self> {
        let reference = *mesh.positions.first()?;
        let (mut volume, mut first, mut second) = (0.0, DVec3::ZERO, Matrix3::zeros());
        for t in 0..mesh.triangles.len() {
            let corners = mesh.corners(t).map(|p| p - reference);
            let [a, b, c] = corners;
            let sixth = a.dot(b.cross(c)) / 6.0;
            let sum = a + b + c;
            volume += sixth;
            first += sum * (sixth / 4.0);
            // ∫ x xᵀ over a tetrahedron with a corner at the origin.
            second += Matrix3::from_fn(|i, j| {
                let own: f64 = corners.iter().map(|p| p[i] * p[j]).sum();
                (own + sum[i] * sum[j]) * sixth / 20.0
            });
        }
        if !(volume > 0.0 && volume.is_finite()) {
            return None;
        }
        let middle = first / volume;
        let spread = second / volume - Matrix3::from_fn(|i, j| middle[i] * middle[j]);
        Some(Self { centre: reference + middle, spread })
    }

    /// Mean square distance from the centre.
    fn size(&self) -> f64 {
        self.spread.trace()
    }

    /// The principal axes, the longest first, right-handed.
    fn axes(&self) -> DMat3 {
        let eigen = self.spread.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
        let axis = |i: usize| DVec3::from_array(std::array::from_fn(|k| eigen.eigenvectors[(k, order[i])]));
        let (x, y) = (axis(0), axis(1));
        DMat3::from_cols(x, y, x.cross(y))
    }
}
