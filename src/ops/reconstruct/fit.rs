//! How well maps and surface fit: residuals, noise, and better poses.

use glam::{DAffine3, DQuat, DVec3};
use nalgebra::{Matrix6, Vector6};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::term::{Term, View};
use crate::levelset::LevelSet;
use crate::mesh::TriangleMesh;
use crate::range::RangeMap;

/// Surfaces at a cosine below this do not tell of the ranges.
const LEAST_COSINE: f32 = 0.3;

/// Points of a map that its pose is found from.
const PROBES: usize = 6000;

/// How a map sees the vertices of a surface.
pub(super) fn views(term: &Term, mesh: &TriangleMesh, normals: &[DVec3]) -> Vec<View> {
    const CHUNK: usize = 4096;
    let chunks = mesh.positions.par_chunks(CHUNK).zip(normals.par_chunks(CHUNK));
    chunks.map(|(points, normals)| term.views(points, normals)).collect::<Vec<_>>().concat()
}

/// What is told of a map: the residuals of the ranges to the surface that it sees.
pub(super) fn residuals(term: &Term, views: &[View], estimated: Option<f64>) -> Value {
    let (mut count, mut sum, mut squares) = (0usize, 0.0, 0.0);
    for view in views.iter().filter(|view| view.weight > 0.0 && view.cosine > LEAST_COSINE) {
        let distance = f64::from(view.distance);
        (count, sum, squares) = (count + 1, sum + distance, squares + distance * distance);
    }
    let per_vertex = 1.0 / count.max(1) as f64;
    json!({
        "name": term.map.name, "measurements": term.map.count(), "estimated_noise": estimated,
        "seen_vertices": count, "residual_mean": sum * per_vertex, "residual_rms": (squares * per_vertex).sqrt(),
    })
}

/// Outward normals at the vertices of a mesh of a level set.
pub(super) fn normals(level_set: &LevelSet, mesh: &TriangleMesh) -> Vec<DVec3> {
    let transform = level_set.transform();
    let normal = |p: &DVec3| {
        let gradient = level_set.sampler().smooth_gradient(transform.world_to_index(*p));
        transform.direction_to_world(gradient).normalize_or_zero()
    };
    mesh.positions.par_iter().with_min_len(256).map(normal).collect()
}

/// The rigid motion that brings the measurements of a map nearest to the surface, one step of point-to-surface ICP: φ + ∇φ·(ω × p + t) is least in the
/// mean square over the points within the band. `None` if too few are, or if they leave the motion open.
pub(super) fn towards(map: &RangeMap, level_set: &LevelSet) -> Option<DAffine3> {
    let transform = level_set.transform();
    let step = ((map.count() as f64 / PROBES as f64).sqrt() as usize).max(1);
    let points: Vec<DVec3> = map.points(step).collect();
    let limit = 0.9 * f64::from(level_set.background());
    let near: Vec<(DVec3, DVec3, f64)> = points
        .par_iter()
        .with_min_len(256)
        .filter_map(|p| {
            let ijk = transform.world_to_index(*p);
            let mut sampler = level_set.sampler();
            let phi = f64::from(sampler.trilinear(ijk));
            let normal = transform.direction_to_world(sampler.smooth_gradient(ijk)).try_normalize()?;
            (phi.abs() < limit).then_some((*p, normal, phi))
        })
        .collect();
    if near.len() < 100 {
        return None;
    }
    let centre = near.iter().map(|n| n.0).sum::<DVec3>() / near.len() as f64;
    let size = near.iter().map(|n| n.0.distance(centre)).fold(0.0, f64::max);
    let (mut matrix, mut right) = (Matrix6::zeros(), Vector6::zeros());
    for (p, n, phi) in near {
        let arm = ((p - centre) / size).cross(n);
        let row = Vector6::new(arm.x, arm.y, arm.z, n.x, n.y, n.z);
        matrix += row * row.transpose();
        right -= row * phi;
    }
    // Shapes that can be turned or moved along themselves leave part of it open: that part stays as it was.
    let eigen = matrix.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    let mut motion = Vector6::zeros();
    for n in 0..6 {
        let axis = eigen.eigenvectors.column(n);
        if eigen.eigenvalues[n] > 1e-3 * largest {
            motion += axis * (axis.dot(&right) / eigen.eigenvalues[n]);
        }
    }
    let turn = DVec3::new(motion[0], motion[1], motion[2]) / size;
    let shift = DVec3::new(motion[3], motion[4], motion[5]);
    let turn = DAffine3::from_quat(DQuat::from_scaled_axis(turn));
    let moved = DAffine3::from_translation(centre + shift) * turn * DAffine3::from_translation(-centre);
    moved.is_finite().then_some(moved)
}
