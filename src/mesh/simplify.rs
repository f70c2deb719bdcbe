//! Fewer triangles for nearly the same surface, by edge collapse with quadric errors (Garland and Heckbert 1997), as
//! meshoptimizer does it.
//!
//! Vertices are not moved: those that stay keep position and attributes, in the order of the input. Flat parts lose most.
//! Texture seams and open borders are kept as such.
//!
//! A quadric error is an average over triangles, not the largest distance, and the collapse does not look at the topology
//! around both ends of an edge, so that thin parts may pinch. Both are therefore examined afterwards: vertices that came
//! to lie too far away, and those around a pinch of a closed mesh, are locked and the whole is done again.

use glam::DVec3;
use meshopt::SimplifyOptions;
use rayon::prelude::*;

use super::to_levelset::check_numbers;
use super::topology::{EdgeUse, by_edge, edge_uses};
use super::unit::UnitFrame;
use super::{Bvh, TriangleMesh, analyze};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

const OPERATION: &str = "simplify";

/// How often it is done again with more vertices locked. Two or three times are usual.
const ATTEMPTS: usize = 8;

/// How much to leave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bound {
    /// This part of the triangles, above 0 up to 1.
    Ratio(f64),
    /// As few triangles as leave no vertex of the mesh farther than this from the result, in world units.
    Distance(f64),
}

/// A mesh with fewer triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct Simplified {
    /// The mesh.
    pub mesh: TriangleMesh,
    /// Distance of the farthest vertex of the input from the mesh, in world units.
    pub deviation: f64,
    /// What is not as asked, one sentence each.
    pub warnings: Vec<String>,
}

/// Simplifies a mesh, in the same way for any number of threads.
///
/// Errors name the mesh `mesh`; a caller that knows the file puts its name there.
pub fn simplify(mesh: &TriangleMesh, bound: Bound, run: &RunOptions) -> Result<Simplified> {
    match bound {
        Bound::Ratio(ratio) if !(ratio > 0.0 && ratio <= 1.0) => {
            return Err(EditError::parameter(OPERATION, "ratio", ratio, "a part of the triangles above 0, up to 1"));
        }
        Bound::Distance(distance) if !(distance >= 0.0 && distance.is_finite()) => {
            return Err(EditError::parameter(OPERATION, "distance", distance, "a distance in world units, 0 or more"));
        }
        _ => {}
    }
    check_numbers(mesh)?;
    let frame = UnitFrame::around(mesh)?;
    // Positions, quadrics and adjacency of meshoptimizer; positions and tree of the comparison.
    let bytes = mesh.positions.len() * 160 + mesh.triangles.len() * 200;
    run.reserve(OPERATION, bytes as u64, "a larger voxel size makes fewer triangles")?;
    run.check(OPERATION)?;
    let task = run.task(OPERATION, 1);
    let (triangles, deviation) = Collapse::new(mesh, frame).settle(bound, run)?;
    task.advance(1);
    let result = compact(mesh, &triangles);
    let mut warnings = Vec::new();
    if let Bound::Ratio(ratio) = bound {
        let (kept, all) = (result.triangles.len() as f64, mesh.triangles.len() as f64);
        // The last triangles of each part and its handles cannot go.
        if kept > 1.05 * ratio * all + 1.0 {
            warnings.push(format!("{:.1} % of the triangles stay: fewer cannot hold the surface", 100.0 * kept / all));
        }
    }
    if triangles.len() < mesh.triangles.len() {
        let (before, after) = (analyze(mesh), analyze(&result));
        let pinched = after.non_manifold_edges.saturating_sub(before.non_manifold_edges);
        let open = (after.boundary_edges + after.misoriented_edges)
            .saturating_sub(before.boundary_edges + before.misoriented_edges);
        if before.closed && !after.closed {
            warnings.push(format!(
                "the simplified mesh is not closed and manifold any more: {pinched} edges join more than two triangles, {open} fewer"
            ));
        }
    }
    Ok(Simplified { mesh: result, deviation: deviation * frame.extent, warnings })
}

/// A mesh in the unit box.
struct Collapse<'a> {
    mesh: &'a TriangleMesh,
    positions: Vec<[f32; 3]>,
    frame: UnitFrame,
}

impl<'a> Collapse<'a> {
    fn new(mesh: &'a TriangleMesh, frame: UnitFrame) -> Self {
        // Vertices without triangles may lie anywhere.
        let unit = |p: DVec3| frame.map(p).clamp(DVec3::NEG_ONE, DVec3::ONE).as_vec3().to_array();
        Self { mesh, positions: mesh.positions.par_iter().map(|&p| unit(p)).collect(), frame }
    }

    /// The triangles that are left, and how far the removed vertices are from them in units of the box.
    fn settle(&self, bound: Bound, run: &RunOptions) -> Result<(Vec<[u32; 3]>, f64)> {
        let all = &self.mesh.triangles;
        let (target, mut error, limit) = match bound {
            Bound::Ratio(ratio) => ((all.len() as f64 * ratio).round() as usize, 1.0, f64::INFINITY),
            Bound::Distance(distance) => (0, (distance / self.frame.extent).min(1.0), distance / self.frame.extent),
        };
        // Even what lies exactly in a plane stays where nothing is asked.
        if limit == 0.0 || target >= all.len() {
            return Ok((all.clone(), 0.0));
        }
        let closed = unpaired(all).is_empty();
        let mut locked = vec![false; self.positions.len()];
        let mut near = None;
        for _ in 0..ATTEMPTS {
            let triangles = self.run(target, error as f32, &locked);
            let (far, deviation) = self.compare(&triangles, limit, run)?;
            let pinched = if closed { unpaired(&triangles) } else { Vec::new() };
            if far.is_empty() && pinched.is_empty() {
                return Ok((triangles, deviation));
            }
            self.lock(&far, &pinched, &mut locked);
            if far.is_empty() {
                near = Some((triangles, deviation));
            } else {
                error *= 0.75;
            }
        }
        // A pinch may stay, and is said; a distance may not.
        Ok(near.unwrap_or_else(|| (all.clone(), 0.0)))
    }

    /// Collapses edges down to `target` triangles, or until the quadric error (in units of the box) would be above `error`.
    fn run(&self, target: usize, error: f32, locked: &[bool]) -> Vec<[u32; 3]> {
        let indices = self.mesh.triangles.as_flattened();
        let left = meshopt::simplify_with_locks_decoder(
            indices,
            &self.positions,
            locked,
            target.saturating_mul(3).min(indices.len()),
            error,
            SimplifyOptions::None,
            None,
        );
        left.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect()
    }

    /// Locks vertices that were removed too far, and all around those at a pinch.
    fn lock(&self, far: &[u32], pinched: &[u32], locked: &mut [bool]) {
        let mut at_pinch = vec![false; locked.len()];
        pinched.iter().for_each(|&v| at_pinch[v as usize] = true);
        let around = self.mesh.triangles.iter().filter(|t| t.iter().any(|&v| at_pinch[v as usize]));
        far.iter().chain(around.flatten()).for_each(|&v| locked[v as usize] = true);
    }

    /// The removed vertices that are farther than `limit` (units of the box) from `triangles`, and the largest distance of
    /// the others.
    fn compare(&self, triangles: &[[u32; 3]], limit: f64, run: &RunOptions) -> Result<(Vec<u32>, f64)> {
        run.check(OPERATION)?;
        let at = |v: u32| self.frame.map(self.mesh.positions[v as usize]);
        let mut removed = vec![false; self.positions.len()];
        self.mesh.triangles.iter().flatten().for_each(|&v| removed[v as usize] = true);
        triangles.iter().flatten().for_each(|&v| removed[v as usize] = false);
        let removed: Vec<u32> = (0..).zip(&removed).filter(|(_, removed)| **removed).map(|(v, _)| v).collect();
        let tree = Bvh::new(triangles.iter().map(|t| t.map(at)).collect());
        let squared = |v: &u32| match run.is_cancelled() {
            true => Some(0.0),
            false => tree.closest_point(at(*v), limit).map(|hit| hit.distance_squared),
        };
        let distances: Vec<Option<f64>> = removed.par_iter().with_min_len(256).map(squared).collect();
        run.check(OPERATION)?;
        let far = removed.iter().zip(&distances).filter(|(_, d)| d.is_none()).map(|(v, _)| *v).collect();
        Ok((far, distances.into_iter().flatten().fold(0.0, f64::max).sqrt()))
    }
}

/// The vertices of edges that do not join exactly two triangles.
fn unpaired(triangles: &[[u32; 3]]) -> Vec<u32> {
    by_edge(&edge_uses(triangles))
        .filter(|uses| uses.len() != 2)
        .filter_map(|uses| uses.first())
        .flat_map(EdgeUse::vertices)
        .collect()
}

/// The triangles with the vertices that they use, in their order.
fn compact(mesh: &TriangleMesh, triangles: &[[u32; 3]]) -> TriangleMesh {
    let mut number = vec![u32::MAX; mesh.positions.len()];
    triangles.iter().flatten().for_each(|&v| number[v as usize] = 0);
    let mut kept: Vec<usize> = Vec::new();
    for (v, number) in number.iter_mut().enumerate().filter(|(_, number)| **number == 0) {
        *number = kept.len() as u32;
        kept.push(v);
    }
    TriangleMesh {
        positions: kept.iter().map(|&v| mesh.positions[v]).collect(),
        triangles: triangles.iter().map(|t| t.map(|v| number[v as usize])).collect(),
        colors: mesh.colors.as_ref().map(|colors| kept.iter().map(|&v| colors[v]).collect()),
        uvs: mesh.uvs.as_ref().map(|uvs| kept.iter().map(|&v| uvs[v]).collect()),
        normals: mesh.normals.as_ref().map(|normals| kept.iter().map(|&v| normals[v]).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::LevelSet;
    use crate::levelset::testing::{box_distance, noise, sampled, torus};
    use crate::mesh::testing::{area_and_volume, assert_manifold, cube, shared_mesh, sphere};
    use crate::mesh::{MeshToLevelSet, level_set_to_mesh, mesh_to_level_set};

    fn run() -> RunOptions {
        RunOptions::default()
    }

    fn mesh_of(level_set: &LevelSet) -> TriangleMesh {
        level_set_to_mesh(level_set, 0.0, &run()).unwrap()
    }

    /// The farthest that any of 10 points of each triangle of `a` is from `b`.
    fn one_sided(a: &TriangleMesh, b: &TriangleMesh) -> f64 {
        let tree = Bvh::new((0..b.triangles.len()).map(|t| b.corners(t)).collect());
        let points = (0..a.triangles.len()).flat_map(|t| {
            let [p, q, r] = a.corners(t);
            (0..4).flat_map(move |i| {
                (0..4 - i).map(move |j| p + (q - p) * (f64::from(i) / 3.0) + (r - p) * (f64::from(j) / 3.0))
            })
        });
        points.map(|p| tree.closest_point(p, f64::INFINITY).unwrap().distance_squared).fold(0.0, f64::max).sqrt()
    }

    #[test]
    fn a_ratio_is_met_and_the_surface_stays_closed() {
        let full = mesh_of(&torus(20.0, 6.0));
        for ratio in [0.5, 0.2, 0.05] {
            let Simplified { mesh, deviation, warnings } = simplify(&full, Bound::Ratio(ratio), &run()).unwrap();
            assert_eq!(warnings, Vec::<String>::new());
            let part = mesh.triangles.len() as f64 / full.triangles.len() as f64;
            assert!((part / ratio - 1.0).abs() < 0.02, "{part}");
            assert_eq!(assert_manifold(&mesh), 0);
            let (there, back) = (one_sided(&full, &mesh), one_sided(&mesh, &full));
            assert!(
                there >= deviation - 1e-12 && there < deviation + 0.02 && back < 2.0 * deviation + 0.02,
                "{ratio}: {deviation} {there} {back}"
            );
            let (area, volume) = area_and_volume(&mesh);
            let (whole_area, whole) = area_and_volume(&full);
            // No more lies between the surfaces than a layer as thick as the deviation.
            assert!((volume - whole).abs() < 0.5 * deviation * whole_area, "{ratio}: {volume} {whole}");
            assert!((area / whole_area - 1.0).abs() < 0.01, "{ratio}: {area} {whole_area}");
        }
        let same = simplify(&full, Bound::Ratio(1.0), &run()).unwrap();
        assert_eq!((same.mesh.triangles.len(), same.deviation), (full.triangles.len(), 0.0));
    }

    #[test]
    fn a_distance_is_kept_and_flat_parts_lose_most() {
        let block = mesh_of(&sampled(30, |p| box_distance(p, DVec3::new(20.3, 15.2, 10.1))));
        let mut last = block.triangles.len();
        for distance in [0.01, 0.1, 0.5, 1.0] {
            let Simplified { mesh, deviation, warnings } = simplify(&block, Bound::Distance(distance), &run()).unwrap();
            assert_eq!(warnings, Vec::<String>::new());
            assert!(deviation <= distance && mesh.triangles.len() <= last, "{distance}: {deviation}");
            // Between the vertices, a sharp edge that is cut along the other diagonal differs by a chamfer.
            assert!(one_sided(&block, &mesh) <= distance + 0.05, "{distance}");
            assert_eq!(assert_manifold(&mesh), 2);
            last = mesh.triangles.len();
        }
        assert!(last < block.triangles.len() / 50, "{last} of {}", block.triangles.len());
        let same = simplify(&block, Bound::Distance(0.0), &run()).unwrap();
        assert!(same.mesh == block && same.deviation == 0.0);
    }

    #[test]
    fn a_real_surface_keeps_its_handles() {
        let Some(mesh) = shared_mesh("meshes/fertility.off") else { return };
        let (level_set, _) = mesh_to_level_set(&mesh, &MeshToLevelSet::new(1.5), &run()).unwrap();
        let full = mesh_of(&level_set);
        let half_voxel = simplify(&full, Bound::Distance(0.75), &run()).unwrap();
        assert!(half_voxel.deviation <= 0.75 && half_voxel.warnings.is_empty(), "{:?}", half_voxel.warnings);
        assert_eq!(assert_manifold(&half_voxel.mesh), -6);
        assert!(half_voxel.mesh.triangles.len() * 4 < full.triangles.len(), "{}", half_voxel.mesh.triangles.len());
    }

    #[test]
    fn far_and_small_meshes_are_simplified_alike_and_seams_stay() {
        let ball = sphere(DVec3::ZERO, 1.0, 40);
        let near = simplify(&ball, Bound::Ratio(0.1), &run()).unwrap().mesh.triangles.len();
        let mut far = ball.clone();
        far.positions.iter_mut().for_each(|p| *p = *p * 1e-30 + DVec3::splat(3e-30));
        assert!(simplify(&far, Bound::Ratio(0.1), &run()).unwrap().mesh.triangles.len().abs_diff(near) < near / 20);
        // Attributes go with their vertices.
        let mut painted = ball;
        painted.colors = Some(painted.positions.iter().map(|p| [p.x as f32, p.y as f32, p.z as f32, 1.0]).collect());
        let mesh = simplify(&painted, Bound::Ratio(0.1), &run()).unwrap().mesh;
        assert!(
            mesh.colors.unwrap().iter().zip(&mesh.positions).all(|(c, p)| c[0] == p.x as f32 && c[2] == p.z as f32)
        );
    }

    #[test]
    fn what_cannot_go_stays_and_is_said() {
        let cube = cube(DVec3::ZERO, 1.0);
        let left = simplify(&cube, Bound::Ratio(0.01), &run()).unwrap();
        assert!(left.mesh.triangles.len() >= 4 || !left.warnings.is_empty());
        let foam = mesh_of(&noise(3, 3, 0.5));
        let left = simplify(&foam, Bound::Ratio(0.01), &run()).unwrap();
        assert!(!left.warnings.is_empty());
        let empty = simplify(&TriangleMesh::default(), Bound::Ratio(0.5), &run()).unwrap();
        assert_eq!(empty.mesh, TriangleMesh::default());
    }

    #[test]
    fn refusals() {
        let cube = cube(DVec3::ZERO, 1.0);
        for bound in [Bound::Ratio(0.0), Bound::Ratio(1.5), Bound::Ratio(f64::NAN), Bound::Distance(-1.0)] {
            assert_eq!(simplify(&cube, bound, &run()).unwrap_err().exit_code(), 2, "{bound:?}");
        }
        let mut broken = cube;
        broken.positions[3].x = f64::NAN;
        assert_eq!(simplify(&broken, Bound::Ratio(0.5), &run()).unwrap_err().exit_code(), 3);
    }
}
