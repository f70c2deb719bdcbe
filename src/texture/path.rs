//! Shortest paths between two points of a surface.
//!
//! A path is a chain of points that is tightened: each point moves half way to the middle of its two neighbours and back to the
//! surface,
//!
//! > pᵢ ← Π(pᵢ + ½((pᵢ₋₁ + pᵢ₊₁)/2 − pᵢ)).
//!
//! At rest the second difference is normal to the surface, so the path is a geodesic, and the points are equally far apart. A chain
//! of n points needs about n² sweeps, so it begins with five points and gets its midpoints when it has come to rest (33 points from
//! the start take 1600 sweeps where four levels of 60 do). A path is the shortest of those that it can be deformed into on the
//! surface: on which side of a hole or a handle it runs is decided by where it begins, which is a curve along the
//! surface at both ends ([`bow`]), brought to it, or, where that strays too far or the other is shorter, the shortest way over neighbouring voxels
//! ([`over_voxels`]).

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::level::{Level, Probe};

/// Sweeps of one level of refinement at most, and how often rest is looked for.
const SWEEPS: usize = 100;
const LOOK: usize = 20;

/// A path is at rest when its geodesic curvature is below this, in 1/voxel.
const STRAIGHT: f64 = 0.01;

/// Points of a path at first.
const FIRST_POINTS: usize = 5;

/// A path that is so many times as long as the straight line is compared with the shortest way over voxels.
const DETOUR: f64 = 1.15;

/// A straight line that projection moves farther than this part of its length is no good beginning.
const STRAY: f64 = 1.0 / 3.0;

/// Voxels this near a level are its graph, in voxels: half the diagonal, so that every voxel that the level crosses is in it.
const ON_LEVEL: f64 = 0.87;

/// Voxels that a search for a way visits at most.
const MOST_VOXELS: usize = 4_000_000;

/// The shortest path from `a` to `b`, points of the level, in steps of at most `spacing`: the points in between and both ends, equally spaced.
/// It begins as the chain `begin` (any number of points, on the level or not), or as a curve that leaves both ends along the level. `None` where the surface ends, folds
/// or breaks on the way.
pub(super) fn geodesic(level: Level, begin: &[DVec3], a: DVec3, b: DVec3, spacing: f64) -> Option<Vec<DVec3>> {
    let mut probe = level.probe();
    let first = match begin {
        [] => bow(&mut probe, a, b),
        begin => [&[a], begin, &[b]].concat(),
    };
    let begun = resampled(&first, FIRST_POINTS - 1);
    let mut path = begun.clone();
    let near = project_inner(&mut probe, &mut path).is_some()
        && path.iter().zip(&begun).all(|(p, q)| p.distance(*q) < STRAY * a.distance(b));
    let first = if near { at_rest(&mut probe, path, spacing) } else { None };
    if first.as_ref().is_some_and(|path| !begin.is_empty() || length(path) < DETOUR * a.distance(b)) {
        return first;
    }
    // What is long, though near, may run over the wrong side of an edge.
    let over = over_voxels(&mut probe, a, b).and_then(|way| {
        let mut path = resampled(&way, 2 * FIRST_POINTS - 2);
        project_inner(&mut probe, &mut path)?;
        at_rest(&mut probe, path, spacing)
    });
    [first, over].into_iter().flatten().min_by(|p, q| length(p).total_cmp(&length(q)))
}

/// A cubic curve from `a` to `b` that leaves both along the level towards the other: as a geodesic would.
fn bow(probe: &mut Probe, a: DVec3, b: DVec3) -> Vec<DVec3> {
    let chord = b - a;
    let mut along = |p: DVec3| {
        let tangent = probe.normal(p).map_or(chord, |n| chord - n * n.dot(chord));
        tangent.normalize_or(chord.normalize_or_zero()) * chord.length()
    };
    let (from, to) = (along(a), along(b));
    let place = |t: f64| {
        let (square, cube) = (t * t, t * t * t);
        a.lerp(b, 3.0 * square - 2.0 * cube) + from * (cube - 2.0 * square + t) + to * (cube - square)
    };
    let pieces = 4 * FIRST_POINTS;
    (0..=pieces).map(|k| place(k as f64 / pieces as f64)).collect()
}

/// A path, on the level, tightened with more and more points.
fn at_rest(probe: &mut Probe, mut path: Vec<DVec3>, spacing: f64) -> Option<Vec<DVec3>> {
    loop {
        tighten(probe, &mut path)?;
        if length(&path) <= spacing * (path.len() - 1) as f64 {
            return Some(path);
        }
        path = with_midpoints(&path);
        project_inner(probe, &mut path)?;
    }
}

/// The shortest way from `a` to `b` over voxels beside the level, by A*. `None` where there is none.
fn over_voxels(probe: &mut Probe, a: DVec3, b: DVec3) -> Option<Vec<DVec3>> {
    let (from, to) = (a.round().as_ivec3(), b.round().as_ivec3());
    // Order of the open voxels: estimated length, then place. Lengths are positive, so their bits are in order.
    let estimate = |length: f64, at: IVec3| (length + at.as_dvec3().distance(b)).to_bits();
    let mut best = FxHashMap::<IVec3, (f64, IVec3)>::default();
    let mut open = BinaryHeap::new();
    best.insert(from, (0.0, from));
    open.push(Reverse((estimate(0.0, from), from.to_array())));
    while let Some(Reverse((priority, at))) = open.pop() {
        let at = IVec3::from_array(at);
        if at == to {
            let mut way = vec![b];
            let mut at = to;
            while at != from {
                at = best[&at].1;
                way.push(at.as_dvec3());
            }
            way.push(a);
            way.reverse();
            return Some(way);
        }
        let length = best[&at].0;
        if priority > estimate(length, at) || best.len() > MOST_VOXELS {
            continue;
        }
        for i in (0..27).filter(|&i| i != 13) {
            let step = IVec3::new(i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1);
            let next = at + step;
            if next != to && probe.above(next.as_dvec3()).abs() > ON_LEVEL {
                continue;
            }
            let longer = length + step.as_dvec3().length();
            if best.get(&next).is_none_or(|&(known, _)| longer < known) {
                best.insert(next, (longer, at));
                open.push(Reverse((estimate(longer, next), next.to_array())));
            }
        }
    }
    None
}

/// A chain cut into `parts` pieces of equal length, both ends kept.
pub(super) fn resampled(chain: &[DVec3], parts: usize) -> Vec<DVec3> {
    let whole = length(chain);
    let mut points = Vec::with_capacity(parts + 1);
    let (mut segment, mut before) = (0, 0.0);
    for i in 0..parts {
        let at = whole * i as f64 / parts as f64;
        while segment + 2 < chain.len() && before + chain[segment].distance(chain[segment + 1]) < at {
            before += chain[segment].distance(chain[segment + 1]);
            segment += 1;
        }
        let (p, q) = (chain[segment], chain[segment + 1]);
        let step = p.distance(q);
        points.push(if step > 0.0 { p.lerp(q, ((at - before) / step).clamp(0.0, 1.0)) } else { p });
    }
    points.extend(chain.last());
    points
}

/// Length of a chain.
pub(super) fn length(chain: &[DVec3]) -> f64 {
    chain.windows(2).map(|w| w[0].distance(w[1])).sum()
}

/// Sweeps until the path is straight on the surface.
fn tighten(probe: &mut Probe, path: &mut [DVec3]) -> Option<()> {
    for sweep in 1..=SWEEPS {
        for i in 1..path.len() - 1 {
            let middle = (path[i - 1] + path[i + 1]) * 0.5;
            path[i] = probe.project(path[i].lerp(middle, 0.5))?;
        }
        if sweep % LOOK == 0 && bend(probe, path) < STRAIGHT {
            break;
        }
    }
    Some(())
}

/// The largest tangential second difference over the spacing squared: the geodesic curvature.
fn bend(probe: &mut Probe, path: &[DVec3]) -> f64 {
    let spacing = length(path) / (path.len() - 1) as f64;
    if spacing == 0.0 {
        return 0.0;
    }
    let bend = |w: &[DVec3]| {
        let second = w[0] + w[2] - 2.0 * w[1];
        let along_normal = probe.normal(w[1]).map_or(DVec3::ZERO, |n| n * second.dot(n));
        (second - along_normal).length() / (spacing * spacing)
    };
    path.windows(3).map(bend).fold(0.0, f64::max)
}

fn with_midpoints(path: &[DVec3]) -> Vec<DVec3> {
    let mut finer = Vec::with_capacity(2 * path.len() - 1);
    for w in path.windows(2) {
        finer.extend([w[0], (w[0] + w[1]) * 0.5]);
    }
    finer.extend(path.last());
    finer
}

fn project_inner(probe: &mut Probe, path: &mut [DVec3]) -> Option<()> {
    let inner = 1..path.len().saturating_sub(1);
    for p in &mut path[inner] {
        *p = probe.project(*p)?;
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::super::field::Field;
    use super::*;
    use crate::levelset::testing;

    fn torus(major: f64, minor: f64) -> Field {
        Field::around(&testing::torus(major, minor), 8.0)
    }

    #[test]
    fn great_circles() {
        let radius = 20.0;
        let ball = Field::around(&testing::ball(DVec3::ZERO, radius), 8.0);
        for degrees in [30.0, 90.0, 150.0, 175.0] {
            let angle = f64::to_radians(degrees);
            let (a, b) = (DVec3::X * radius, DVec3::new(angle.cos(), 0.6 * angle.sin(), 0.8 * angle.sin()) * radius);
            let path = geodesic(Level::new(&ball, 0.0), &[], a, b, 1.0).unwrap();
            // As long as the polyline inscribed in the circle; the surface itself is off by h²/(8R)·2 = 0.0125.
            let n = (path.len() - 1) as f64;
            let inscribed = 2.0 * radius * n * (angle / (2.0 * n)).sin();
            assert!((length(&path) / inscribed - 1.0).abs() < 1e-3, "{degrees}: {} {inscribed}", length(&path));
            let steps: Vec<f64> = path.windows(2).map(|w| w[0].distance(w[1])).collect();
            let (least, most) = steps.iter().fold((f64::INFINITY, 0.0f64), |(l, m), &s| (l.min(s), m.max(s)));
            assert!(most / least < 1.03 && most <= 1.0, "{degrees}: {least} {most}");
        }
    }

    #[test]
    fn a_torus_has_shorter_ways_than_its_meridians() {
        // A generic pair: refinement finds the length that a single level needs 1600 sweeps for.
        let (major, minor) = (20.0, 8.0);
        let torus = torus(major, minor);
        let at = |u: f64, v: f64| {
            DVec3::new((major + minor * v.cos()) * u.cos(), (major + minor * v.cos()) * u.sin(), minor * v.sin())
        };
        let path = geodesic(Level::new(&torus, 0.0), &[], at(0.0, 0.3), at(1.6, 1.9), 1.0).unwrap();
        // On a surface of revolution r·sin(angle to the meridian) is constant along a geodesic (Clairaut).
        let clairaut: Vec<f64> = path
            .windows(2)
            .map(|w| {
                let (middle, along) = ((w[0] + w[1]) * 0.5, (w[1] - w[0]).normalize());
                let r = middle.x.hypot(middle.y);
                r * along.dot(DVec3::new(-middle.y, middle.x, 0.0) / r)
            })
            .collect();
        let mean = clairaut.iter().sum::<f64>() / clairaut.len() as f64;
        assert!(clairaut.iter().all(|c| (c - mean).abs() < 0.02 * mean), "{clairaut:?}");
    }

    #[test]
    fn refinement_finds_the_length_of_a_single_level() {
        // The generic pair of the reference: 42.44 at first, 38.6586 at rest with 33 points.
        let torus = torus(20.0, 8.0);
        let mut probe = Level::new(&torus, 0.0).probe();
        let a = probe.project(DVec3::X * 28.0).unwrap();
        let b = probe.project(DVec3::new(12.0 * 1.8f64.cos(), 12.0 * 1.8f64.sin(), 5.0)).unwrap();
        let path = geodesic(Level::new(&torus, 0.0), &[], a, b, 1.25).unwrap();
        // Linear interpolation moves the surface by 0.02 voxel.
        assert!((length(&path) - 38.6586).abs() < 0.05, "{} {}", length(&path), path.len());
    }

    #[test]
    fn resampling_keeps_ends_and_spacing() {
        let chain = [DVec3::ZERO, DVec3::X, DVec3::X * 4.0];
        let points = resampled(&chain, 4);
        assert_eq!(points, [0.0, 1.0, 2.0, 3.0, 4.0].map(|x| DVec3::X * x));
        assert_eq!(resampled(&[DVec3::X, DVec3::X], 2), [DVec3::X; 3]);
    }
}
