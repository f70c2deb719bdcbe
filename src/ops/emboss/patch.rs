//! A piece of a surface laid flat: the discrete exponential map (Schmidt, Grimm and Wyvill 2006).
//!
//! From a seed with its tangent frame, coordinates go from vertex to vertex of the polygonised surface in the order of their distance along
//! the edges: an edge (q − p), seen along the normal of p, is added in the frame of p; the frame
//! goes on to q by the smallest rotation that takes the normal of p to that of q. Where several vertices lead to one, their mean counts, weighted so that
//! together they lie on the straight line from the seed: paths along edges zigzag about it, and the frame would turn by the curvature of
//! what lies between. A few rounds of averaging over all neighbours even out what is left.
//!
//! The normals are averaged over a part of the patch first: so it is the surface without its relief that is laid flat, and a stamp
//! crosses a fold or a ribbon as if it was projected on it. The paper keeps the length of each edge instead, which follows every wrinkle.
//!
//! Exact on planes and, up to the polygons, on developable surfaces; on a sphere within 0.4 % of the radius (rms), up to one radius from the seed. Beyond the radius π/√max K it folds: [`Patch::folded`] counts.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, closest_on_triangle, level_set_to_mesh};
use crate::run::RunOptions;

/// How much longer paths along edges are than the coordinates that they lead to, at most.
const DETOUR: f64 = 1.5;

/// Voxels around that: the triangles at the rim of a small patch are whole, whichever way their diagonals run.
const RIM: f64 = 4.0;

/// Below this sum of weights nothing leads to a vertex from the seed's side.
const LEAST_AHEAD: f64 = 1e-6;

/// Rounds of averaging of coordinates.
const ROUNDS: usize = 30;

/// How far from a triangle in the plane, in voxels, a place counts as in it.
const INSIDE: f64 = 1e-4;

/// Part of a patch's radius over which its normals are averaged, and most rounds of averaging: a round spreads over an edge, n over √n of them.
const AVERAGED: f64 = 0.15;
const MOST_ROUNDS: f64 = 200.0;

/// A patch of a surface with flat coordinates, all in index space.
pub(in crate::ops) struct Patch {
    tree: Bvh,
    /// Of the triangles as they lie in the plane.
    flat: Bvh,
    triangles: Vec<[u32; 3]>,
    positions: Vec<DVec3>,
    normals: Vec<DVec3>,
    coordinates: Vec<DVec2>,
    /// The seed on the surface.
    pub centre: DVec3,
}

/// Where a point lies over a patch.
#[derive(Clone, Copy, Debug)]
pub(in crate::ops) struct Place {
    /// Flat coordinates of the patch's closest point.
    pub flat: DVec2,
    /// Distance from it, negative below the surface.
    pub height: f64,
}

/// The directions at a seed: to the right and upwards.
pub(super) type Frame = (DVec3, DVec3);

impl Patch {
    /// The surface around the point of it closest to `at`, as far as `radius` (both in voxels). `frame` turns the normal into two tangents.
    pub fn new(
        level_set: &LevelSet,
        at: DVec3,
        radius: f64,
        reach: f64,
        frame: impl FnOnce(DVec3) -> Result<Frame>,
        run: &RunOptions,
    ) -> Result<Self> {
        let mesh = level_set_to_mesh(level_set, 0.0, run)?;
        let transform = level_set.transform();
        let positions: Vec<DVec3> = mesh.positions.par_iter().map(|p| transform.world_to_index(*p)).collect();
        let corners = |t: &[u32; 3]| t.map(|v| positions[v as usize]);
        let nearest = mesh.triangles.par_iter().enumerate().map(|(i, t)| {
            let point = closest_on_triangle(at, corners(t));
            (point.distance_squared(at), i, point)
        });
        let nearest = nearest.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let far = |distance: Option<f64>| {
            let found = distance.map_or("there is no surface".into(), |d| {
                format!("the surface is {} away", d * transform.voxel_size())
            });
            let accepted = format!("a point near the surface, within {}; {found}", reach * transform.voxel_size());
            EditError::parameter("emboss", "at", transform.index_to_world(at), accepted)
        };
        let Some((squared, seed, centre)) = nearest else { return Err(far(None)) };
        if squared.sqrt() > reach {
            return Err(far(Some(squared.sqrt())));
        }
        // The part that can be reached, with vertices numbered anew.
        let limit = (radius * 1.2 + RIM).powi(2);
        let mut numbers = vec![u32::MAX; positions.len()];
        let (mut local, mut triangles, mut seed_triangle) = (Vec::new(), Vec::new(), 0);
        for (i, triangle) in mesh.triangles.iter().enumerate() {
            if i != seed && corners(triangle).iter().any(|p| p.distance_squared(centre) > limit) {
                continue;
            }
            if i == seed {
                seed_triangle = triangles.len();
            }
            triangles.push(triangle.map(|v| {
                let number = &mut numbers[v as usize];
                if *number == u32::MAX {
                    *number = local.len() as u32;
                    local.push(positions[v as usize]);
                }
                *number
            }));
        }
        let normals: Vec<DVec3> = local
            .par_iter()
            .map_init(|| level_set.sampler(), |sampler, p| sampler.smooth_gradient(*p).normalize_or_zero())
            .collect();
        let normal = triangles[seed_triangle].iter().map(|&v| normals[v as usize]).sum::<DVec3>().normalize_or_zero();
        if normal == DVec3::ZERO {
            let accepted =
                "a place where the surface has a normal; this one is on a sheet or a tip thinner than a voxel";
            return Err(EditError::parameter("emboss", "at", transform.index_to_world(at), accepted));
        }
        let (right, up) = frame(normal)?;
        run.check("emboss")?;
        let frame = DMat3::from_cols(right, up, normal);
        let seed = Seed { triangle: triangles[seed_triangle], centre, frame };
        let coordinates = flattened(&local, &normals, &triangles, &seed, radius);
        let known = |t: &[u32; 3]| t.iter().all(|&v| coordinates[v as usize].is_some());
        let triangles: Vec<[u32; 3]> = triangles.into_iter().filter(known).collect();
        let coordinates: Vec<DVec2> = coordinates.into_iter().map(Option::unwrap_or_default).collect();
        let tree = Bvh::new(triangles.iter().map(|t| t.map(|v| local[v as usize])).collect());
        let flat = Bvh::new(triangles.iter().map(|t| t.map(|v| coordinates[v as usize].extend(0.0))).collect());
        Ok(Self { tree, flat, triangles, positions: local, normals, coordinates, centre })
    }

    /// Where `ijk` lies over the patch.
    pub fn locate(&self, ijk: DVec3) -> Option<Place> {
        let hit = self.tree.closest_point(ijk, f64::INFINITY)?;
        let triangle = self.triangles[hit.triangle as usize].map(|v| v as usize);
        let weights = barycentric(hit.point, triangle.map(|v| self.positions[v]));
        let blend = |v: usize, w: f64| (self.coordinates[triangle[v]] * w, self.normals[triangle[v]] * w);
        let (mut flat, mut normal) = (DVec2::ZERO, DVec3::ZERO);
        for (v, w) in weights.into_iter().enumerate() {
            let (c, n) = blend(v, w);
            (flat, normal) = (flat + c, normal + n);
        }
        let distance = hit.distance_squared.sqrt();
        let above = (ijk - hit.point).dot(normal) >= 0.0;
        Some(Place { flat, height: if above { distance } else { -distance } })
    }

    /// The surface point with given flat coordinates and its normal: that of the triangle that holds them.
    pub fn lift(&self, flat: DVec2) -> Option<(DVec3, DVec3)> {
        let hit = self.flat.closest_point(flat.extend(0.0), INSIDE)?;
        let t = self.triangles[hit.triangle as usize].map(|v| v as usize);
        let weights = barycentric(hit.point, t.map(|v| self.coordinates[v].extend(0.0)));
        let sum = |of: &[DVec3]| t.iter().zip(weights).map(|(&v, w)| of[v] * w).sum::<DVec3>();
        Some((sum(&self.positions), sum(&self.normals).normalize_or_zero()))
    }

    /// Of the triangles that `wanted` picks by their middle, the part (0..1, by area) that lies upside down in the plane.
    pub fn folded(&self, wanted: impl Fn(DVec2) -> bool) -> f64 {
        let (mut all, mut wrong) = (0.0, 0.0);
        for t in &self.triangles {
            let [a, b, c] = t.map(|v| self.coordinates[v as usize]);
            if !wanted((a + b + c) / 3.0) {
                continue;
            }
            let [p, q, r] = t.map(|v| self.positions[v as usize]);
            let normal: DVec3 = t.iter().map(|&v| self.normals[v as usize]).sum();
            let facing = (q - p).cross(r - p);
            all += facing.length();
            if (b - a).perp_dot(c - a) * facing.dot(normal) < 0.0 {
                wrong += facing.length();
            }
        }
        if all > 0.0 { wrong / all } else { 0.0 }
    }
}

fn barycentric(p: DVec3, [a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let (u, v, w) = (b - a, c - a, p - a);
    let (uu, uv, vv, wu, wv) = (u.dot(u), u.dot(v), v.dot(v), w.dot(u), w.dot(v));
    let area = uu * vv - uv * uv;
    if area <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let (s, t) = ((vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area);
    let (s, t) = (s.clamp(0.0, 1.0), t.clamp(0.0, 1.0));
    [1.0 - s - t, s, t]
}

struct Seed {
    triangle: [u32; 3],
    centre: DVec3,
    /// Right, up, normal.
    frame: DMat3,
}

/// The smallest rotation of a frame (right, up, normal) onto another normal.
fn carried(frame: &DMat3, normal: DVec3) -> DMat3 {
    let turned = DMat3::from_quat(DQuat::from_rotation_arc(frame.z_axis, normal)) * *frame;
    DMat3::from_cols(turned.x_axis, turned.y_axis, normal)
}

/// An edge in the frame of its first vertex.
fn unrolled(frame: &DMat3, edge: DVec3) -> DVec2 {
    DVec2::new(edge.dot(frame.x_axis), edge.dot(frame.y_axis))
}

/// What a neighbour says of a vertex.
struct Way {
    /// Its own flat coordinates.
    from: DVec2,
    /// Those of the vertex, from there.
    to: DVec2,
    /// The frame's first axis, from there.
    right: DVec3,
    length: f64,
}

/// The mean of what neighbours say of a vertex, weighted so that together they lie on the straight line from the seed.
fn joined(ways: &[Way]) -> (DVec2, DVec3) {
    // Vertices within a hundredth of a voxel count alike.
    let near = |way: &Way| 1.0 / way.length.max(0.01);
    let mean = |weights: &[f64]| {
        let sum = |(flat, right): (DVec2, DVec3), (way, w): (&Way, &f64)| (flat + way.to * *w, right + way.right * *w);
        let (flat, right) = ways.iter().zip(weights).fold((DVec2::ZERO, DVec3::ZERO), sum);
        (flat / weights.iter().sum::<f64>(), right)
    };
    let mut weights: smallvec::SmallVec<[f64; 8]> = ways.iter().map(near).collect();
    let (flat, right) = mean(&weights);
    let Some(outwards) = flat.try_normalize() else { return (flat, right) };
    for (weight, way) in weights.iter_mut().zip(ways) {
        let ahead = (flat - way.from).dot(outwards).max(0.0) / way.length.max(0.01);
        *weight *= ahead * ahead;
    }
    let aside = |way: &Way| way.from.perp_dot(outwards);
    let of_side = |left: bool| {
        ways.iter()
            .zip(&weights)
            .filter(|(way, _)| (aside(way) > 0.0) == left)
            .map(|(way, w)| w * aside(way).abs())
            .sum::<f64>()
    };
    let [left, other] = [true, false].map(of_side);
    if left > 0.0 && other > 0.0 {
        for (weight, way) in weights.iter_mut().zip(ways) {
            *weight *= if aside(way) > 0.0 { other } else { left };
        }
    }
    // All neighbours are beside the vertex, or behind it, near the seed.
    if weights.iter().sum::<f64>() > LEAST_AHEAD { mean(&weights) } else { (flat, right) }
}

/// Normals averaged over all neighbours, `rounds` times.
fn averaged(mut normals: Vec<DVec3>, around: &[smallvec::SmallVec<[u32; 8]>], rounds: usize) -> Vec<DVec3> {
    for _ in 0..rounds {
        let mean =
            |at: usize| around[at].iter().fold(normals[at], |sum, &v| sum + normals[v as usize]).normalize_or_zero();
        normals = (0..normals.len()).into_par_iter().map(mean).collect();
    }
    normals
}

/// Flat coordinates of the vertices within reach of paths along the edges to `radius`.
fn flattened(
    positions: &[DVec3],
    normals: &[DVec3],
    triangles: &[[u32; 3]],
    seed: &Seed,
    radius: f64,
) -> Vec<Option<DVec2>> {
    let farthest = radius * DETOUR + RIM;
    let around = neighbours(positions.len(), triangles);
    let rounds = (radius * AVERAGED).powi(2).min(MOST_ROUNDS) as usize;
    let normals = averaged(normals.to_vec(), &around, rounds);
    let mut coordinates: Vec<Option<DVec2>> = vec![None; positions.len()];
    let mut frames = vec![DMat3::IDENTITY; positions.len()];
    let mut distance = vec![f64::INFINITY; positions.len()];
    // Distances are not negative, so that the order of their bits is theirs.
    let mut queue = BinaryHeap::new();
    for v in seed.triangle {
        let d = positions[v as usize].distance(seed.centre);
        distance[v as usize] = d;
        queue.push(Reverse((d.to_bits(), v)));
    }
    while let Some(Reverse((bits, v))) = queue.pop() {
        let at = v as usize;
        if coordinates[at].is_some() || f64::from_bits(bits) > distance[at] || normals[at] == DVec3::ZERO {
            continue;
        }
        let settled = around[at].iter().filter_map(|&other| {
            let other = other as usize;
            let edge = positions[at] - positions[other];
            let from = coordinates[other]?;
            let to = from + unrolled(&frames[other], edge);
            Some(Way { from, to, right: carried(&frames[other], normals[at]).x_axis, length: edge.length() })
        });
        let ways: smallvec::SmallVec<[Way; 8]> = settled.collect();
        let first = carried(&seed.frame, normals[at]);
        if ways.is_empty() || seed.triangle.contains(&v) {
            coordinates[at] = Some(unrolled(&seed.frame, positions[at] - seed.centre));
            frames[at] = first;
        } else {
            let (flat, right) = joined(&ways);
            coordinates[at] = Some(flat);
            let right = (right - normals[at] * right.dot(normals[at])).try_normalize();
            let handed = seed.frame.determinant().signum();
            frames[at] = right.map_or(first, |x| DMat3::from_cols(x, normals[at].cross(x) * handed, normals[at]));
        }
        for &other in &around[at] {
            let o = other as usize;
            let d = distance[at] + positions[at].distance(positions[o]);
            if coordinates[o].is_none() && d < distance[o] && d <= farthest {
                distance[o] = d;
                queue.push(Reverse((d.to_bits(), other)));
            }
        }
    }
    for _ in 0..ROUNDS {
        let evened = (0..positions.len()).into_par_iter().map(|at| {
            let own = coordinates[at]?;
            if seed.triangle.contains(&(at as u32)) {
                return Some(own);
            }
            let (mut sum, mut weights) = (own, 1.0);
            for &other in &around[at] {
                let other = other as usize;
                let Some(from) = coordinates[other] else { continue };
                let edge = positions[at] - positions[other];
                // The same from both ends.
                let there = (unrolled(&frames[other], edge) - unrolled(&frames[at], -edge)) * 0.5;
                sum += from + there;
                weights += 1.0;
            }
            Some(sum / weights)
        });
        coordinates = evened.collect();
    }
    coordinates
}

/// The vertices that share an edge with each.
fn neighbours(count: usize, triangles: &[[u32; 3]]) -> Vec<smallvec::SmallVec<[u32; 8]>> {
    let mut around: Vec<smallvec::SmallVec<[u32; 8]>> = vec![Default::default(); count];
    for [a, b, c] in triangles {
        for (v, w) in [(a, b), (b, c), (c, a), (b, a), (c, b), (a, c)] {
            if !around[*v as usize].contains(w) {
                around[*v as usize].push(*w);
            }
        }
    }
    around
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, sampled};

    fn patch(level_set: &LevelSet, at: DVec3, radius: f64) -> Patch {
        let frame = |n: DVec3| Ok((DVec3::Y.cross(n).normalize(), n.cross(DVec3::Y.cross(n)).normalize()));
        Patch::new(level_set, at, radius, 5.0, frame, &RunOptions::default()).unwrap()
    }

    #[test]
    fn great_circles_of_a_sphere_keep_their_length() {
        // An independent computation has 0.087 voxel (rms) and 0.42 at most, on dense samples with thirty neighbours each.
        let ball = ball(DVec3::ZERO, 24.0);
        let patch = patch(&ball, DVec3::Z * 24.0, 24.0);
        let (mut sum, mut worst, mut count) = (0.0, 0.0f64, 0.0);
        for i in 0..40 {
            for r in [6.0, 12.0, 18.0, 22.0] {
                let (angle, theta) = (f64::from(i) * 0.157, r / 24.0f64);
                let direction = DVec2::from_angle(angle);
                let p = (direction * theta.sin()).extend(theta.cos()) * 25.0;
                let place = patch.locate(p).unwrap();
                let error = (place.flat - direction * r).length();
                assert!((place.height - 1.0).abs() < 0.03);
                (sum, worst, count) = (sum + error * error, worst.max(error), count + 1.0);
            }
        }
        let rms = f64::sqrt(sum / count);
        assert!(rms < 0.087 && worst < 0.42, "{rms} {worst}");
        assert_eq!(patch.folded(|p| p.length() < 20.0), 0.0);
    }

    #[test]
    fn a_cylinder_unrolls() {
        let cylinder = sampled(50, |p| (p.x.hypot(p.z) - 12.0).max(p.y.abs() - 40.0));
        let patch = patch(&cylinder, DVec3::Z * 12.0, 20.0);
        for (angle, y) in [(0.0f64, 15.0), (0.5, -10.0), (1.2, 3.0), (-1.0, 8.0)] {
            let place = patch.locate(DVec3::new(12.5 * angle.sin(), y, 12.5 * angle.cos())).unwrap();
            assert!((place.flat - DVec2::new(12.0 * angle, y)).length() < 0.15, "{place:?}");
            let (p, n) = patch.lift(place.flat).unwrap();
            assert!((p - DVec3::new(12.0 * angle.sin(), y, 12.0 * angle.cos())).length() < 0.1);
            assert!((n - DVec3::new(angle.sin(), 0.0, angle.cos())).length() < 0.05);
        }
    }

    #[test]
    fn a_point_far_from_the_surface_is_refused() {
        let frame = |_: DVec3| Ok((DVec3::X, DVec3::Y));
        let refused = Patch::new(&ball(DVec3::ZERO, 10.0), DVec3::X * 40.0, 5.0, 20.0, frame, &RunOptions::default());
        assert_eq!(refused.err().unwrap().exit_code(), 2);
    }
}
