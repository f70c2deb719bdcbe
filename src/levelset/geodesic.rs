//! Distance along a surface, |∇ₛψ| = 1.
//!
//! The graph of the closest points: every voxel within one voxel of the surface is a node at the surface point closest to it, joined to the nodes among the 124 voxels around it by edges as long as
//! the straight line between their points. Shortest paths are found by Dijkstra's method. As there is a finite number of directions, they are up to 2 % too long however fine the grid is, and so they are corrected afterwards:
//! each node takes the shortest way through the segment between its best neighbour and any node beside that, ψ = minₛ ψⱼ + s (ψₖ − ψⱼ)/|e| + |x − xⱼ − s e/|e||, twice, in the order of ψ. On
//! a sphere of 24 voxels, beyond the equator, the error is 0.4 % on average and 1.6 % at most before (an independent computation), and 0.1 % on average after.
//!
//! Edges between points whose normals are opposed are left out: they would lead through a thin part, or over a narrow gap. Parts thinner than about two voxels are not told from their other side.
//! A chord is shorter than the way along the surface by d³/(24R²), over a sharp edge by up to 1.2 voxels.
//!
//! Other voxels of the band get their values from their neighbours nearer to the surface, so that ψ is constant along normals.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::{Field, LevelSet, Sampler};
use crate::error::{EditError, Result};
use crate::grid::{Face, Grid, LEAF_VOXELS, LeafId, leaf_offset, leaf_origin, neighbour_index, offset_to_local};
use crate::run::RunOptions;

const OPERATION: &str = "geodesic";

/// Nodes are the voxels within this distance of the surface, in voxels.
const NEAR: f64 = 1.0;
/// Voxels to each side among which a node's neighbours are: 5³ − 1 = 124.
const REACH: i32 = 2;
/// Cosine of the normals of two points below which they are on different sides.
const OPPOSED: f32 = -0.5;
/// Nodes this near a source, in voxels, are reached from it in a straight line.
const START: f64 = 2.5;
/// The longest segment, in voxels, that a way goes through.
const SEGMENT: f64 = 2.0;
/// Cosine of the widest angle under which a segment is seen.
const NARROW: f64 = 0.5;
/// Rounds of correction.
const ROUNDS: usize = 2;
/// No node.
const NONE: u32 = u32::MAX;

/// Distances along a surface.
pub struct Geodesic {
    /// ψ in world units at the voxels of the band; infinite where no source can be reached.
    pub field: Field,
    /// Active voxels that no source reaches.
    pub unreachable: u64,
}

impl Geodesic {
    /// The field without the voxels whose value is infinite.
    pub fn reached(&self) -> Field {
        let mut grid = self.field.grid().clone();
        grid.update_all(|_, values, mask| {
            for at in mask.iter().filter(|&at| !values.0[at].is_finite()).collect::<Vec<_>>() {
                values.0[at] = 0.0;
                mask.set(at, false);
            }
        });
        Field::new(grid, *self.field.transform())
    }
}

impl LevelSet {
    /// The distance along the surface from the nearest of `sources`, world positions on the surface or within the band; each counts as the surface point closest to it.
    pub fn geodesic(&self, sources: &[DVec3], run: &RunOptions) -> Result<Geodesic> {
        let grid = self.grid();
        let leaves = grid.leaves().len() as u64;
        // A table and some hundred nodes a leaf.
        run.reserve(OPERATION, leaves * (LEAF_VOXELS as u64 * 4 + 150 * 64), "a coarser grid needs less")?;
        let nodes = Nodes::of(self, run)?;
        let starts = sources.iter().map(|xyz| nodes.snapped(self, *xyz)).collect::<Result<Vec<_>>>()?;
        if starts.is_empty() {
            return Err(EditError::parameter(OPERATION, "from", "nothing", "at least one point on the surface"));
        }
        let (mut psi, order) = nodes.shortest_paths(&starts, run)?;
        for _ in 0..ROUNDS {
            run.check(OPERATION)?;
            nodes.straighten(&mut psi, &order, &starts);
        }
        nodes.extended(self, &psi, run)
    }
}

/// The surface points closest to voxels near the surface, in the order of leaves and voxels.
struct Nodes<'a> {
    grid: &'a Grid,
    /// By slot of the leaf, the place of its table.
    tables_of: Vec<u32>,
    /// The node of each voxel.
    tables: Vec<[u32; LEAF_VOXELS]>,
    voxels: Vec<(LeafId, u16)>,
    /// In voxels.
    points: Vec<DVec3>,
    normals: Vec<Vec3>,
}

impl<'a> Nodes<'a> {
    fn of(level_set: &'a LevelSet, run: &RunOptions) -> Result<Self> {
        let grid = level_set.grid();
        let near = (NEAR * level_set.voxel_size()) as f32;
        let found = grid.map_leaves(|id| {
            let mut sampler = level_set.sampler();
            let mut found = Vec::new();
            if run.is_cancelled() {
                return found;
            }
            for at in grid.mask(id).iter().filter(|&at| grid.values(id).0[at].abs() < near) {
                let voxel = (grid.origin(id) + offset_to_local(at)).as_dvec3();
                if let Some((point, normal)) = closest(&mut sampler, voxel) {
                    found.push((at as u16, point, normal));
                }
            }
            found
        });
        run.check(OPERATION)?;
        let slots = grid.leaves().iter().map(|id| id.index() + 1).max().unwrap_or(0);
        let mut nodes = Self {
            grid,
            tables_of: vec![NONE; slots],
            tables: Vec::new(),
            voxels: Vec::new(),
            points: Vec::new(),
            normals: Vec::new(),
        };
        for (&id, found) in grid.leaves().iter().zip(&found).filter(|(_, found)| !found.is_empty()) {
            nodes.tables_of[id.index()] = nodes.tables.len() as u32;
            let mut table = [NONE; LEAF_VOXELS];
            for &(at, point, normal) in found {
                table[usize::from(at)] = nodes.points.len() as u32;
                nodes.voxels.push((id, at));
                nodes.points.push(point);
                nodes.normals.push(normal);
            }
            nodes.tables.push(table);
        }
        Ok(nodes)
    }

    /// Calls `f` with the nodes among the voxels up to `reach` to each side of one, itself among them.
    #[inline(always)]
    fn for_each_around(&self, (id, at): (LeafId, usize), reach: i32, mut f: impl FnMut(usize)) {
        let around = &self.grid.neighbours()[id.index()];
        let p = offset_to_local(at);
        for x in p.x - reach..=p.x + reach {
            for y in p.y - reach..=p.y + reach {
                for z in p.z - reach..=p.z + reach {
                    let leaf = around[neighbour_index(IVec3::new(x >> 3, y >> 3, z >> 3))];
                    let Some(table) =
                        self.tables.get(self.tables_of.get(leaf.index()).map_or(usize::MAX, |t| *t as usize))
                    else {
                        continue;
                    };
                    let node = table[leaf_offset(IVec3::new(x, y, z))];
                    if node != NONE {
                        f(node as usize);
                    }
                }
            }
        }
    }

    /// Calls `f` with the neighbours of a node in the graph.
    #[inline(always)]
    fn for_each_neighbour(&self, node: usize, mut f: impl FnMut(usize)) {
        let (id, at) = self.voxels[node];
        let normal = self.normals[node];
        self.for_each_around((id, usize::from(at)), REACH, |other| {
            if other != node && normal.dot(self.normals[other]) > OPPOSED {
                f(other);
            }
        });
    }

    /// The surface point closest to a source, and its normal.
    fn snapped(&self, level_set: &LevelSet, xyz: DVec3) -> Result<(DVec3, Vec3)> {
        let ijk = level_set.transform().world_to_index(xyz);
        let refuse = |accepted: String| {
            Err(EditError::parameter(OPERATION, "from", format!("{},{},{}", xyz.x, xyz.y, xyz.z), accepted))
        };
        if !ijk.is_finite() {
            return refuse("a point with finite coordinates".into());
        }
        if let Some(found) = closest(&mut level_set.sampler(), ijk) {
            return Ok(found);
        }
        let distance = |node: &usize| self.points[*node].distance_squared(ijk);
        match (0..self.points.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))) {
            None => refuse("a level set with a surface".into()),
            Some(node) => {
                let p = level_set.transform().index_to_world(self.points[node]);
                let digits = |v: f64| (v * 1e6).round() / 1e6;
                refuse(format!(
                    "a point within {} voxels of the surface; the closest point on it is {},{},{}",
                    level_set.half_width(),
                    digits(p.x),
                    digits(p.y),
                    digits(p.z)
                ))
            }
        }
    }

    /// The nodes that are reached from a start in a straight line, with their distances in voxels.
    fn for_each_beside(&self, (point, normal): (DVec3, Vec3), mut f: impl FnMut(usize, f64)) {
        let voxel = point.round().as_ivec3();
        let id = self.grid.find(leaf_origin(voxel));
        if id.is_sentinel() {
            return;
        }
        self.for_each_around((id, leaf_offset(voxel)), REACH + 1, |node| {
            let distance = self.points[node].distance(point);
            if distance <= START && normal.dot(self.normals[node]) > OPPOSED {
                f(node, distance);
            }
        });
    }

    /// ψ in voxels by Dijkstra's method, and the nodes in the order in which they were reached.
    fn shortest_paths(&self, starts: &[(DVec3, Vec3)], run: &RunOptions) -> Result<(Vec<f64>, Vec<u32>)> {
        let mut psi = vec![f64::INFINITY; self.points.len()];
        let mut order = Vec::with_capacity(self.points.len());
        let mut done = vec![false; self.points.len()];
        let mut heap = BinaryHeap::new();
        for &start in starts {
            self.for_each_beside(start, |node, distance| {
                if distance < psi[node] {
                    psi[node] = distance;
                    heap.push((Reverse(Key(distance)), Reverse(node as u32)));
                }
            });
        }
        let task = run.task("distances along the surface", self.points.len() as u64);
        while let Some((Reverse(Key(distance)), Reverse(node))) = heap.pop() {
            let at = node as usize;
            if done[at] {
                continue;
            }
            done[at] = true;
            order.push(node);
            if order.len().is_multiple_of(PART) {
                run.check(OPERATION)?;
                task.advance(PART as u64);
            }
            self.for_each_neighbour(at, |other| {
                if done[other] {
                    return;
                }
                let through = distance + self.points[at].distance(self.points[other]);
                if through < psi[other] {
                    psi[other] = through;
                    heap.push((Reverse(Key(through)), Reverse(other as u32)));
                }
            });
        }
        Ok((psi, order))
    }

    /// One round of ways through segments, in the order given.
    fn straighten(&self, psi: &mut [f64], order: &[u32], starts: &[(DVec3, Vec3)]) {
        let mut fixed = vec![false; psi.len()];
        for &start in starts {
            self.for_each_beside(start, |node, distance| fixed[node] |= psi[node] == distance);
        }
        let mut near: Vec<(usize, f64)> = Vec::new();
        for &node in order {
            let node = node as usize;
            if fixed[node] {
                continue;
            }
            let x = self.points[node];
            near.clear();
            self.for_each_neighbour(node, |other| near.push((other, psi[other] + x.distance(self.points[other]))));
            let Some(&(best, through)) = near.iter().min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
            let mut value = psi[node].min(through);
            let from = self.points[best];
            for &(other, _) in &near {
                let e = self.points[other] - from;
                let length = e.length();
                let (a, b) = (from - x, self.points[other] - x);
                // Seen under a wide angle, the ends of a segment may be reached from two sides, and what comes through it from neither.
                let narrow = a.dot(b) >= NARROW * a.length() * b.length();
                if other != best && length > 1e-3 && length <= SEGMENT && narrow && psi[other].is_finite() {
                    value = value.min(through_segment(psi[best], psi[other], x - from, e / length, length));
                }
            }
            psi[node] = value;
        }
    }

    /// ψ in world units at all active voxels: nodes keep theirs, each other voxel gets the mean of its face neighbours nearer to the surface, weighted by how
    /// much nearer they are, from the surface outwards. On a linear φ that is the value one step along the gradient.
    fn extended(&self, level_set: &LevelSet, psi: &[f64], run: &RunOptions) -> Result<Geodesic> {
        let voxel_size = level_set.voxel_size();
        let source = self.grid;
        let mut grid = source.zeroed();
        let mut values = grid.value_pages().clone();
        for (node, &(id, at)) in self.voxels.iter().enumerate() {
            values.get_mut(id).0[usize::from(at)] = (psi[node] * voxel_size) as f32;
        }
        let rest = source.map_leaves(|id| {
            let table = self.tables_of.get(id.index()).and_then(|t| self.tables.get(*t as usize));
            let is_node = |at: &usize| table.is_some_and(|table| table[*at] != NONE);
            let phi = &source.values(id).0;
            source.mask(id).iter().filter(|at| !is_node(at)).map(|at| (phi[at].abs(), id, at)).collect::<Vec<_>>()
        });
        let mut rest = rest.concat();
        // Stable: equal distances stay in the order of leaves.
        rest.par_sort_by(|a, b| a.0.total_cmp(&b.0));
        for part in rest.chunks(PART) {
            run.check(OPERATION)?;
            for &(distance, id, at) in part {
                let around = &source.neighbours()[id.index()];
                let inside = source.values(id).0[at] < 0.0;
                let (mut sum, mut weights) = (0.0, 0.0);
                for face in Face::ALL {
                    let p = offset_to_local(at) + face.step();
                    let (leaf, there) = (around[neighbour_index(p >> 3)], leaf_offset(p));
                    let phi = source.values(leaf).0[there];
                    // The other side of the surface has nodes of its own.
                    let weight = if (phi < 0.0) == inside || phi == 0.0 { distance - phi.abs() } else { 0.0 };
                    let value = values.get(leaf).0[there];
                    if weight > 0.0 && value.is_finite() {
                        sum += f64::from(weight) * f64::from(value);
                        weights += f64::from(weight);
                    }
                }
                values.get_mut(id).0[at] = if weights > 0.0 { (sum / weights) as f32 } else { f32::INFINITY };
            }
        }
        grid.swap_values(&mut values);
        let infinite = |id| source.mask(id).iter().filter(|&at| !grid.values(id).0[at].is_finite()).count() as u64;
        let unreachable = source.map_leaves(infinite).into_iter().sum();
        Ok(Geodesic { field: Field::new(grid, *level_set.transform()), unreachable })
    }
}

/// Nodes between two looks at whether the run was cancelled.
const PART: usize = 1 << 14;

/// A distance by which nodes are ordered.
#[derive(PartialEq)]
struct Key(f64);

impl Eq for Key {}

impl PartialOrd for Key {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Key {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// The surface point closest to a position in index space, and the normal there; `None` if it is farther than the band.
fn closest(sampler: &mut Sampler, ijk: DVec3) -> Option<(DVec3, Vec3)> {
    let point = sampler.closest_point(ijk)?;
    Some((point, sampler.smooth_gradient(point).normalize_or_zero().as_vec3()))
}

/// The least of ψ(s) + |x − s e| over the inside of a segment from the origin along the unit vector e, on which ψ is linear between `a` and `b`.
fn through_segment(a: f64, b: f64, x: DVec3, e: DVec3, length: f64) -> f64 {
    let slope = (b - a) / length;
    let along = x.dot(e);
    let beside = (x.length_squared() - along * along).max(0.0).sqrt();
    let rest = 1.0 - slope * slope;
    if rest <= 0.0 {
        return f64::INFINITY;
    }
    let s = along - beside * slope / rest.sqrt();
    if s > 0.0 && s < length { a + slope * along + beside * rest.sqrt() } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{ball, box_distance, sampled};
    use super::*;

    fn run() -> RunOptions {
        RunOptions::default()
    }

    /// Mean and largest relative error at the active voxels that are farther than `far` from the source.
    fn errors(level_set: &LevelSet, from: DVec3, far: f64, exact: impl Fn(DVec3) -> Option<f64>) -> (f64, f64) {
        let found = level_set.geodesic(&[from], &run()).unwrap();
        assert_eq!(found.unreachable, 0);
        let grid = found.field.grid();
        let (mut sum, mut worst, mut count) = (0.0, 0f64, 0.0);
        for &id in grid.leaves() {
            for at in grid.mask(id).iter() {
                let p = (grid.origin(id) + offset_to_local(at)).as_dvec3();
                if let Some(exact) = exact(p).filter(|d| *d > far) {
                    let error = f64::from(grid.values(id).0[at]) / exact - 1.0;
                    (sum, worst, count) = (sum + error, worst.max(error.abs()), count + 1.0);
                }
            }
        }
        assert!(count > 500.0);
        (sum / count, worst)
    }

    #[test]
    fn on_a_sphere_up_to_the_antipode() {
        let centre = DVec3::new(0.3, 0.1, -0.2);
        let level_set = ball(centre, 24.0);
        let pole = centre + DVec3::Z * 24.0;
        let exact = |p: DVec3| Some(24.0 * ((p - centre).normalize().z).clamp(-1.0, 1.0).acos());
        let (mean, worst) = errors(&level_set, pole, 24.0, exact);
        // 0.43 % and 1.63 % are those of the graph; below 1 % is asked of the corrected distances.
        assert!(mean.abs() < 0.0043 && worst < 0.01, "{mean} {worst}");
        // A quarter of the way round: πR/2, within 2 %.
        let found = level_set.geodesic(&[pole], &run()).unwrap();
        let equator = f64::from(found.field.accessor().value(IVec3::new(24, 0, 0)));
        assert!((equator / (24.0 * std::f64::consts::FRAC_PI_2) - 1.0).abs() < 0.02, "{equator}");
    }

    #[test]
    fn on_a_cylinder_as_unrolled() {
        let cylinder = sampled(44, |p| {
            let (side, end) = (p.truncate().length() - 15.0, p.z.abs() - 36.0);
            side.max(end).min(0.0) + DVec3::new(side.max(0.0), end.max(0.0), 0.0).length()
        });
        let from = DVec3::new(15.0, 0.0, -12.0);
        let exact = |p: DVec3| {
            // Ways over the caps are longer here, and the side is all that is looked at.
            let on_side = p.z.abs() < 22.0 && p.truncate().length() > 13.0;
            on_side.then(|| (15.0 * p.y.atan2(p.x)).hypot(p.z + 12.0))
        };
        let (mean, worst) = errors(&cylinder, from, 8.0, exact);
        assert!(mean.abs() < 0.01 && worst < 0.02, "{mean} {worst}");
    }

    #[test]
    fn on_planes_exact_along_the_axes() {
        let slab = sampled(36, |p| box_distance(p, DVec3::new(30.0, 30.0, 6.0)));
        let from = DVec3::new(0.0, 0.0, 6.0);
        let top = |p: DVec3| (p.z > 4.0 && p.truncate().abs().max_element() < 24.0).then(|| p.truncate().length());
        let (_, worst) = errors(&slab, from, 4.0, top);
        assert!(worst < 0.02, "{worst}");
        let found = slab.geodesic(&[from], &run()).unwrap();
        let mut psi = found.field.accessor();
        for x in 1..=24 {
            for at in [IVec3::new(x, 0, 6), IVec3::new(0, -x, 6), IVec3::new(0, x, 7)] {
                assert!((psi.value(at) - x as f32).abs() < 1e-4, "{at} {}", psi.value(at));
            }
        }
        // The far side is reached over two edges, 30 + 12 + 30, each cut by a chord of up to 2√2 voxels, which saves 1.2.
        let below = psi.value(IVec3::new(0, 0, -6));
        assert!(below < 72.0 * 1.02 && below > 72.0 * 0.98 - 2.4, "{below}");
    }

    #[test]
    fn symmetric_and_no_detour_is_shorter() {
        let centre = DVec3::new(0.2, 0.0, 0.1);
        let level_set = ball(centre, 16.0);
        let points: Vec<DVec3> = [DVec3::X, DVec3::new(-1.0, 2.0, 2.0), DVec3::new(0.5, -1.0, 0.3), DVec3::NEG_Z]
            .map(|d| centre + d.normalize() * 16.0)
            .to_vec();
        let fields: Vec<_> = points.iter().map(|p| level_set.geodesic(&[*p], &run()).unwrap()).collect();
        let value = |i: usize, j: usize| f64::from(fields[i].field.accessor().value(points[j].round().as_ivec3()));
        for i in 0..4 {
            for j in 0..4 {
                // The voxel nearest to a point is up to 0.87 voxel off.
                assert!((value(i, j) - value(j, i)).abs() < 0.02 * value(i, j) + 1.0, "{i} {j}");
                for k in 0..4 {
                    assert!(value(i, j) <= (value(i, k) + value(k, j)) * 1.02 + 1.0, "{i} {j} {k}");
                }
            }
        }
        // Of several sources the nearest counts.
        let both = level_set.geodesic(&points[..2], &run()).unwrap();
        let grid = both.field.grid();
        for &id in grid.leaves() {
            for at in grid.mask(id).iter().step_by(7) {
                let ijk = grid.origin(id) + offset_to_local(at);
                let least = fields[0].field.accessor().value(ijk).min(fields[1].field.accessor().value(ijk));
                let apart = (fields[0].field.accessor().value(ijk) - fields[1].field.accessor().value(ijk)).abs();
                // Where both are as near, the mean of neighbours in one field is less than that in each of the two.
                let tolerance = if apart > 4.0 { 0.3 } else { 1.0 };
                assert!((grid.values(id).0[at] - least).abs() < tolerance, "{ijk}");
            }
        }
    }

    #[test]
    fn what_cannot_be_reached_is_infinitely_far() {
        let two = sampled(30, |p| ((p - DVec3::X * 14.0).length() - 8.0).min((p + DVec3::X * 14.0).length() - 8.0));
        let found = two.geodesic(&[DVec3::X * 22.0], &run()).unwrap();
        let mut psi = found.field.accessor();
        assert_eq!(psi.value(IVec3::new(-22, 0, 0)), f32::INFINITY);
        // Chords of up to 2√3 voxels are shorter than their arcs by d²/(24R²), 0.8 %; the graph errs by 1.6 %.
        assert!((psi.value(IVec3::new(6, 0, 0)) / (8.0 * std::f32::consts::PI) - 1.0).abs() < 0.05);
        let half = found.field.grid().active_voxels() / 2;
        assert!(found.unreachable.abs_diff(half) < half / 10);
        // Both sides of a thin wall are far apart.
        let wall = sampled(30, |p| box_distance(p, DVec3::new(20.0, 20.0, 1.5)));
        let found = wall.geodesic(&[DVec3::Z * 1.5], &run()).unwrap();
        assert!(found.field.accessor().value(IVec3::new(0, 0, -2)) > 35.0);
    }

    #[test]
    fn points_off_the_surface_are_snapped_or_refused() {
        let level_set = ball(DVec3::ZERO, 12.0);
        let near = level_set.geodesic(&[DVec3::X * 13.7], &run()).unwrap();
        assert!(near.field.accessor().value(IVec3::new(12, 0, 0)) < 0.1);
        let refused = |p: DVec3| level_set.geodesic(&[p], &run()).err().unwrap().to_string();
        let far = refused(DVec3::X * 40.0);
        assert!(far.contains("40,0,0") && far.contains("closest point on it is 12,0,0"), "{far}");
        assert!(refused(DVec3::NAN).contains("finite"));
        assert!(level_set.geodesic(&[], &run()).is_err());
    }
}
