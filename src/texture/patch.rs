//! A four-sided patch of a surface as a grid of points, equally spaced along geodesics (Brodersen et al. 2007, section 2.1).

use glam::DVec3;
use rayon::prelude::*;

use super::field::Field;
use super::level::Level;
use super::path::{geodesic, length, resampled};
use crate::error::EditError;

/// Cells along an edge, at least and at most.
const CELLS: [usize; 2] = [4, 64];

/// Points along a geodesic are no closer than this part of its length: every other one becomes a point of the net.
const FINEST: f64 = 2.0 * CELLS[1] as f64;

/// Cells along the longer edge of the coarsest net.
const COARSEST: usize = 12;

/// Relaxation of the grid: part of the way to the neighbours' mean, weight of the neighbours across a cell, sweeps at most (of the coarsest net,
/// and of finer ones, which begin near rest), and the move below which it is at rest, as a part of the spacing.
const RELAXATION: f64 = 0.5;
const DIAGONAL: f64 = 0.25;
const COARSE_SWEEPS: usize = 500;
const SWEEPS: usize = 60;
const REST: f64 = 1e-3;

/// Part of the cells of a patch that may fold over, and how much longer than the mean one a cell may be.
const SLIVERS: f64 = 0.02;
const TORN: f64 = 8.0;

/// Neighbouring corners whose normals differ by more than this see opposite sides of the surface.
const OPPOSITE: f64 = 150.0;

/// A grid of points on a surface, in voxels.
#[derive(Clone, Debug, PartialEq)]
pub struct Net {
    /// Cells along u and v.
    pub counts: [usize; 2],
    /// Positions, those of one u after the other.
    pub points: Vec<DVec3>,
}

impl Net {
    /// The point between cells i − 1 and i along u, j − 1 and j along v.
    pub fn at(&self, i: usize, j: usize) -> DVec3 {
        self.points[i * (self.counts[1] + 1) + j]
    }

    fn at_mut(&mut self, i: usize, j: usize) -> &mut DVec3 {
        &mut self.points[i * (self.counts[1] + 1) + j]
    }

    /// Corners in the order p1, p2, p3, p4: (0,0), (1,0), (1,1), (0,1) in (u, v).
    pub fn corners(&self) -> [DVec3; 4] {
        let [nu, nv] = self.counts;
        [self.at(0, 0), self.at(nu, 0), self.at(nu, nv), self.at(0, nv)]
    }

    /// The four sides: p1p2, p4p3 (along u), p1p4, p2p3 (along v).
    fn sides(&self) -> [Vec<DVec3>; 4] {
        let [nu, nv] = self.counts;
        let along_u = |j| (0..=nu).map(|i| self.at(i, j)).collect();
        let along_v = |i| (0..=nv).map(|j| self.at(i, j)).collect();
        [along_u(0), along_u(nv), along_v(0), along_v(nu)]
    }

    /// Lengths of the edges p1p2 and p1p4.
    pub fn edges(&self) -> [f64; 2] {
        let [bottom, _, left, _] = self.sides();
        [length(&bottom), length(&left)]
    }

    /// What is wrong with it as a piece of a surface: cells that turn away from the side that most of them face, or that are much longer than the others, as
    /// where it is spanned across a hole.
    pub(super) fn flaw(&self) -> Option<&'static str> {
        let [nu, nv] = self.counts;
        let (mut areas, mut longest) = (Vec::with_capacity(nu * nv), 0.0f64);
        for i in 0..nu {
            for j in 0..nv {
                let (along, across) = (self.at(i + 1, j) - self.at(i, j), self.at(i, j + 1) - self.at(i, j));
                longest = longest.max(along.length()).max(across.length());
                let other = (self.at(i + 1, j + 1) - self.at(i, j + 1), self.at(i + 1, j + 1) - self.at(i + 1, j));
                areas.push((along.cross(across), other.0.cross(other.1)));
            }
        }
        // Both corners of a cell see one side, but for a few slivers in creases.
        let turned = areas.iter().filter(|(a, b)| a.dot(*b) <= 0.0).count();
        if turned as f64 > SLIVERS * areas.len() as f64 {
            return Some("the patch folds over");
        }
        (longest > TORN * self.spacing().max(1.0)).then_some("the patch is torn, as across a hole")
    }

    /// Mean length of the cells along the first sides.
    pub fn spacing(&self) -> f64 {
        let ([a, b], [nu, nv]) = (self.edges(), self.counts);
        (a / nu as f64 + b / nv as f64) / 2.0
    }

    /// The point at (u, v), bilinear in its cell; beyond 0..1 the cells at the border go on.
    pub fn bilinear(&self, u: f64, v: f64) -> DVec3 {
        let [nu, nv] = self.counts;
        let cell = |t: f64, n: usize| {
            let at = t * n as f64;
            let i = (at.max(0.0) as usize).min(n - 1);
            (i, at - i as f64)
        };
        let ((i, s), (j, t)) = (cell(u, nu), cell(v, nv));
        let along = |j| self.at(i, j).lerp(self.at(i + 1, j), s);
        along(j).lerp(along(j + 1), t)
    }
}

/// Corners of a patch brought to the surface and verified. Positions in voxels, which see the world `mirrored` or not; the error names the corner and
/// what to change.
pub(super) fn corners_on_surface(
    field: &Field,
    corners: [DVec3; 4],
    reach: f64,
    mirrored: bool,
) -> Result<[DVec3; 4], String> {
    let level = Level::new(field, 0.0);
    let mut probe = level.probe();
    let mut placed = corners;
    let mut normals = [DVec3::ZERO; 4];
    for k in 0..4 {
        let point = level.reach(&mut probe, corners[k]).ok_or("there is no surface")?;
        let away = point.distance(corners[k]);
        if away > reach {
            return Err(format!(
                "corner {} is {away:.1} voxels from the surface; at most {reach:.0} are accepted",
                k + 1
            ));
        }
        normals[k] = probe.normal(point).unwrap_or(DVec3::ZERO);
        placed[k] = point;
    }
    for k in 0..4 {
        let next = (k + 1) % 4;
        if placed[k].distance(placed[next]) < 2.0 {
            return Err(format!("corners {} and {} coincide: two voxels apart is the least", k + 1, next + 1));
        }
        if normals[k].angle_between(normals[next]) > OPPOSITE.to_radians() {
            return Err(format!(
                "the surface faces opposite sides at corners {} and {}: choose them on one side",
                k + 1,
                next + 1
            ));
        }
    }
    let outwards = (placed[1] - placed[0]).cross(placed[3] - placed[0]).dot(normals.iter().sum());
    if (outwards <= 0.0) != mirrored {
        return Err("the corners run clockwise seen from outside: give them the other way round".into());
    }
    Ok(placed)
}

/// The patch between four points of a level, with cells of about `spacing` voxels. `begin` may hold a net nearby, to begin with.
///
/// The sides are geodesics; within, springs come to rest ([`relax`]), on coarse nets first. What rests does not depend on where it began, as
/// long as that is on the same piece of the surface: so the geodesics between opposite sides, whose means the paper begins with, are not traced.
pub(super) fn patch(level: Level, corners: [DVec3; 4], spacing: f64, begin: Option<&Net>) -> Option<Net> {
    let [p1, p2, p3, p4] = corners;
    let ends = [(p1, p2), (p4, p3), (p1, p4), (p2, p3)];
    let first = begin.map_or_else(Default::default, Net::sides);
    let longest = ends.iter().map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
    let fine = spacing.min(1.0).max(longest / FINEST);
    let sides: Vec<Vec<DVec3>> = (0..4)
        .into_par_iter()
        .map(|k| geodesic(level, inner(&first[k]), ends[k].0, ends[k].1, fine))
        .collect::<Option<_>>()?;
    let sides = Sides { level, sides };
    let cells = |[a, b]: [usize; 2]| {
        ((sides.length(a).max(sides.length(b)) / spacing).ceil() as usize).clamp(CELLS[0], CELLS[1])
    };
    let counts = [cells([0, 1]), cells([2, 3])];
    if let Some(begin) = begin {
        return sides.around(counts, begin, SWEEPS);
    }
    let halved = |counts: &[usize; 2]| {
        (counts[0].max(counts[1]) > COARSEST).then(|| counts.map(|n| n.div_ceil(2).max(CELLS[0])))
    };
    let sizes: Vec<[usize; 2]> = std::iter::successors(Some(counts), halved).collect();
    // A flat net, which takes the shape of its sides.
    let mut net = Net { counts: [1, 1], points: vec![p1, p4, p2, p3] };
    for (k, counts) in sizes.into_iter().rev().enumerate() {
        net = sides.around(counts, &net, if k == 0 { COARSE_SWEEPS } else { SWEEPS })?;
    }
    Some(net)
}

fn inner(chain: &[DVec3]) -> &[DVec3] {
    if chain.len() > 2 { &chain[1..chain.len() - 1] } else { &[] }
}

/// The four sides of a patch, in the order of [`Net::sides`].
struct Sides<'a> {
    level: Level<'a>,
    sides: Vec<Vec<DVec3>>,
}

impl Sides<'_> {
    fn length(&self, side: usize) -> f64 {
        length(&self.sides[side])
    }

    /// A net within the sides that begins with the shape of another, brought to the level and to rest.
    fn around(&self, counts: [usize; 2], begin: &Net, sweeps: usize) -> Option<Net> {
        let [nu, nv] = counts;
        let mut probe = self.level.probe();
        let mut net = Net { counts, points: vec![DVec3::ZERO; (nu + 1) * (nv + 1)] };
        for (side, n) in [(0, nu), (1, nu), (2, nv), (3, nv)] {
            for (k, p) in resampled(&self.sides[side], n).into_iter().enumerate() {
                // Chords leave the level; the corners are on it.
                let p = if k == 0 || k == n { p } else { probe.project(p)? };
                let (i, j) = [(k, 0), (k, nv), (0, k), (nu, k)][side];
                *net.at_mut(i, j) = p;
            }
        }
        let part = |i: usize, j: usize| (i as f64 / nu as f64, j as f64 / nv as f64);
        // What moved the sides moves what is between them, by Coons' interpolation.
        let moved = |i: usize, j: usize| {
            let (u, v) = part(i, j);
            net.at(i, j) - begin.bilinear(u, v)
        };
        let place = |i: usize, j: usize| {
            let (u, v) = part(i, j);
            let ruled = moved(i, 0).lerp(moved(i, nv), v) + moved(0, j).lerp(moved(nu, j), u);
            let corners = moved(0, 0).lerp(moved(nu, 0), u).lerp(moved(0, nv).lerp(moved(nu, nv), u), v);
            begin.bilinear(u, v) + ruled - corners
        };
        let inner: Vec<(usize, usize)> = (1..nu).flat_map(|i| (1..nv).map(move |j| (i, j))).collect();
        let places: Vec<DVec3> =
            inner.iter().map(|&(i, j)| self.level.reach(&mut probe, place(i, j))).collect::<Option<_>>()?;
        for ((i, j), p) in inner.into_iter().zip(places) {
            *net.at_mut(i, j) = p;
        }
        relax(self.level, &mut net, sweeps)?;
        Some(net)
    }
}

/// Springs of no rest length between neighbours, weaker ones across the cells; the border stays. At rest the net is a discrete
/// harmonic map: on mildly curved patches with convex corners no cell folds over.
fn relax(level: Level, net: &mut Net, sweeps: usize) -> Option<()> {
    let mut probe = level.probe();
    let [nu, nv] = net.counts;
    let spacing = length(&net.sides()[0]) / nu as f64;
    for _ in 0..sweeps {
        let mut most = 0.0f64;
        for i in 1..nu {
            for j in 1..nv {
                let beside = net.at(i - 1, j) + net.at(i + 1, j) + net.at(i, j - 1) + net.at(i, j + 1);
                let across = net.at(i - 1, j - 1) + net.at(i - 1, j + 1) + net.at(i + 1, j - 1) + net.at(i + 1, j + 1);
                let x = net.at(i, j);
                let pull = (beside + across * DIAGONAL) / (4.0 + 4.0 * DIAGONAL) - x;
                let tangential = probe.normal(x).map_or(pull, |n| pull - n * pull.dot(n));
                let moved = probe.project(x + tangential * RELAXATION)?;
                most = most.max(moved.distance(x));
                *net.at_mut(i, j) = moved;
            }
        }
        if most < REST * spacing {
            break;
        }
    }
    Some(())
}

/// What is said when a patch cannot be spanned.
pub(super) fn broken(operation: &str) -> EditError {
    let accepted = "corners whose connections lie on one smooth piece of the surface, without a hole between them";
    EditError::parameter(operation, "corners", "the surface between them ends or folds", accepted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing;

    fn ball(radius: f64) -> Field {
        Field::around(&testing::ball(DVec3::ZERO, radius), 8.0)
    }

    fn plane() -> Field {
        Field::around(&testing::sampled(24, |p| p.z - 0.3), 8.0)
    }

    const SQUARE: [DVec3; 4] = [
        DVec3::new(-10.0, -10.0, 1.5),
        DVec3::new(10.0, -10.0, 0.0),
        DVec3::new(10.0, 10.0, 0.0),
        DVec3::new(-10.0, 10.0, -1.0),
    ];

    #[test]
    fn a_plane_has_a_regular_net() {
        let plane = plane();
        let corners = corners_on_surface(&plane, SQUARE, 10.0, false).unwrap();
        let net = patch(Level::new(&plane, 0.0), corners, 2.0, None).unwrap();
        assert_eq!(net.counts, [10, 10]);
        for i in 0..=10 {
            for j in 0..=10 {
                let exact = DVec3::new(2.0 * i as f64 - 10.0, 2.0 * j as f64 - 10.0, 0.3);
                assert!(net.at(i, j).distance(exact) < 1e-3, "{i} {j} {}", net.at(i, j));
            }
        }
        assert!(net.bilinear(0.25, 0.9).distance(DVec3::new(-5.0, 8.0, 0.3)) < 1e-3);
        assert_eq!(net.corners(), corners);
    }

    #[test]
    fn a_ball_has_an_even_net() {
        let ball = ball(20.0);
        let at = |x: f64, y: f64| DVec3::new(x, y, 1.0).normalize() * 20.0;
        let corners = [at(-0.5, -0.5), at(0.5, -0.5), at(0.5, 0.5), at(-0.5, 0.5)];
        let net = patch(Level::new(&ball, 0.0), corners, 2.0, None).unwrap();
        assert!(net.points.iter().all(|p| (p.length() - 20.0).abs() < 0.02));
        // A map of a symmetric patch: the centre lies at the pole and the diagonals mirror each other.
        let [nu, nv] = net.counts;
        assert_eq!(nu, nv);
        assert!(net.bilinear(0.5, 0.5).normalize().distance(DVec3::Z) < 0.01);
        for i in 0..=nu {
            for j in 0..=nv {
                let (p, q) = (net.at(i, j), net.at(j, i));
                assert!(p.distance(DVec3::new(q.y, q.x, q.z)) < 0.1, "{p} {q}");
            }
        }
    }

    #[test]
    fn corners_that_cannot_work_are_named() {
        let ball = ball(20.0);
        let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z).normalize() * 20.0;
        let good = [at(-0.5, -0.5, 1.0), at(0.5, -0.5, 1.0), at(0.5, 0.5, 1.0), at(-0.5, 0.5, 1.0)];
        assert!(corners_on_surface(&ball, good, 10.0, false).is_ok());
        let refused = |corners| corners_on_surface(&ball, corners, 10.0, false).unwrap_err();
        let [a, b, c, d] = good;
        assert!(refused([d, c, b, a]).contains("clockwise"));
        assert!(refused([a, a, c, d]).contains("1 and 2 coincide"));
        assert!(refused([a, b, c, d * 1.8]).contains("corner 4 is 16"));
        assert!(refused([a, b, -b, -a]).contains("opposite sides"));
    }

    #[test]
    fn a_torus_patch_across_the_inner_rim() {
        let torus = Field::around(&testing::torus(20.0, 8.0), 8.0);
        let at = |u: f64, v: f64| {
            DVec3::new((20.0 + 8.0 * v.cos()) * u.cos(), (20.0 + 8.0 * v.cos()) * u.sin(), 8.0 * v.sin())
        };
        // From the outer equator upwards.
        let corners = [at(-0.4, -0.6), at(0.4, -0.6), at(0.4, 0.8), at(-0.4, 0.8)];
        let net = patch(Level::new(&torus, 0.0), corners_on_surface(&torus, corners, 5.0, false).unwrap(), 2.0, None)
            .unwrap();
        for p in &net.points {
            assert!(((p.x.hypot(p.y) - 20.0).hypot(p.z) - 8.0).abs() < 0.05);
        }
    }
}
