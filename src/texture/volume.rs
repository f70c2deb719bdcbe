//! The space above a patch: layers of nets from the surface up to a height, and the map from (u, v, w) in 0..1³ into it.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::field::Field;
use super::level::Level;
use super::patch::{Net, patch};
use crate::mesh::{Spline, double_reflection};

/// Largest step of a particle, in voxels of the lattice that it is in, and the height up to which that is the base's.
const STEP: f64 = 0.5;
const NEAR: f64 = 3.0;

/// Most layers above the surface.
const MOST_LAYERS: usize = 48;

/// Most levels that get a net of their own, and most sections along a spline.
const MOST_NETS: usize = 12;
const MOST_SECTIONS: usize = 192;

/// Pieces that a spline is cut into between two points for its length, frames and curvature.
const PIECES: usize = 64;

/// Part of the radius of curvature of a spline that its sections may reach to: at 1 particles would run backwards.
const WITHIN_BEND: f64 = 0.9;

/// Angle (radians) that a spline turns by between two sections at most, as far as their number allows.
const TURN: f64 = 0.1;

/// How often sections that fold are drawn together further, and to what part of their width each time.
const MOST_ROUNDS: usize = 40;
const NARROWER: f64 = 0.85;

/// A direction that rises less than this with the surface is along it.
const LEAST_SLOPE: f64 = 0.1;

/// Nets one above the other, at rising values of w: 0 on the surface, 1 at the height, below 0 under the surface. Layers may have
/// different numbers of cells. Positions in voxels.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Volume {
    pub layers: Vec<Net>,
    pub levels: Vec<f64>,
    /// Whether w goes down, so that left and right are exchanged in space (and not as seen from outside).
    pub mirrors: bool,
}

/// Where the layers of a volume lie, in voxels above the surface, and which of them hold the texture.
pub(super) struct Heights {
    /// Falling from below 0.
    below: Vec<f64>,
    /// Rising from above 0.
    above: Vec<f64>,
    /// The heights of w = 0 and w = 1.
    texture: [f64; 2],
}

impl Heights {
    /// The texture stands `height` on the surface; one layer `depth` under it takes what sinks in.
    pub fn raised(height: f64, depth: f64, spacing: f64) -> Self {
        Self { below: vec![-depth], above: even(height, spacing), texture: [0.0, height] }
    }

    /// The texture reaches `height` down from the surface, upside down; one layer `depth` above it takes what stands out.
    pub fn sunk(height: f64, depth: f64, spacing: f64) -> Self {
        Self {
            below: even(height, spacing).into_iter().map(|c| -c).collect(),
            above: vec![depth],
            texture: [0.0, -height],
        }
    }

    /// The same on fewer levels.
    pub fn coarser(self) -> Self {
        let thinned = |levels: Vec<f64>| {
            let keep = levels.len().div_ceil(MOST_NETS).max(1);
            let last = levels.len();
            levels
                .into_iter()
                .enumerate()
                .filter(|(i, _)| (last - 1 - i).is_multiple_of(keep))
                .map(|(_, c)| c)
                .collect()
        };
        Self { below: thinned(self.below), above: thinned(self.above), texture: self.texture }
    }

    /// The volume of nets below, on and above the surface, in the order of these heights.
    fn volume(&self, below: Vec<Net>, base: Net, above: Vec<Net>) -> Volume {
        let [bottom, top] = self.texture;
        let heights = self.below.iter().rev().copied().chain([0.0]).chain(self.above.iter().copied());
        let mut layers: Vec<Net> = below.into_iter().rev().chain([base]).chain(above).collect();
        let mut levels: Vec<f64> = heights.map(|c| (c - bottom) / (top - bottom)).collect();
        if top < bottom {
            layers.reverse();
            levels.reverse();
        }
        Volume { layers, levels, mirrors: top < bottom }
    }
}

/// Steps of about `spacing` up to `height`.
fn even(height: f64, spacing: f64) -> Vec<f64> {
    let steps = ((height / spacing).ceil() as usize).clamp(1, MOST_LAYERS);
    (1..=steps).map(|k| height * k as f64 / steps as f64).collect()
}

impl Volume {
    /// Over `base`, on the levels of the field: each particle follows ∇φ. The band must reach two voxels beyond the levels. Particles keep
    /// their neighbours at every height, so cells widen over convex parts and narrow over concave ones.
    pub fn conforming(field: &Field, base: Net, heights: &Heights) -> Self {
        let nets = |levels: &[f64]| {
            let climbed = |p: &DVec3| climb(field, *p, levels, None);
            let paths: Vec<Vec<DVec3>> = base.points.par_iter().map(climbed).collect();
            let net = |k| Net { counts: base.counts, points: paths.iter().map(|path| path[k]).collect() };
            (0..levels.len()).map(net).collect::<Vec<_>>()
        };
        let (below, above) = (nets(&heights.below), nets(&heights.above));
        heights.volume(below, base, above)
    }

    /// As [`conforming`](Self::conforming), but only the corners climb, along `directions` if there are any; between them each level gets a
    /// net of its own, so that cells stay even. `None` where a level cannot be spanned.
    pub fn low_distortion(
        field: &Field,
        base: Net,
        heights: &Heights,
        spacing: f64,
        directions: Option<[DVec3; 4]>,
    ) -> Option<Self> {
        let nets = |levels: &[f64]| {
            let climbed = |c: usize| climb(field, base.corners()[c], levels, directions.map(|d| d[c]));
            let paths: [Vec<DVec3>; 4] = std::array::from_fn(climbed);
            let mut nets: Vec<Net> = Vec::with_capacity(levels.len());
            for (k, &height) in levels.iter().enumerate() {
                let corners = [0, 1, 2, 3].map(|c| paths[c][k]);
                nets.push(patch(Level::new(field, height), corners, spacing, Some(nets.last().unwrap_or(&base)))?);
            }
            Some(nets)
        };
        let (below, above) = (nets(&heights.below)?, nets(&heights.above)?);
        Some(heights.volume(below, base, above))
    }

    /// Along a curve: sections of the shape of `base` are carried along a spline (its points begin at the middle of the base, whose normal is `normal`)
    /// by frames that turn as little as can be, and drawn together where the curve bends so much that they would meet. w is the part of the curve's
    /// length. A layer `depth` under the base follows the field. Returns the length of the curve as well.
    pub fn along_spline(
        field: &Field,
        base: Net,
        points: &[DVec3],
        normal: DVec3,
        depth: f64,
        spacing: f64,
    ) -> (Self, f64) {
        let curve = Spline::through(points);
        // Point, tangent and length so far.
        let (mut curve_places, mut lengths, mut length) = (vec![curve.at(0, 0.0)], vec![0.0], 0.0);
        for i in 0..curve.pieces() {
            for k in 1..=PIECES {
                let place = curve.at(i, k as f64 / PIECES as f64);
                length += place.0.distance(curve_places[curve_places.len() - 1].0);
                curve_places.push(place);
                lengths.push(length);
            }
        }
        let tangent = curve_places[0].1;
        let across = tangent.any_orthonormal_vector();
        let first = DMat3::from_cols(across, tangent.cross(across), tangent);
        let mut frames = vec![first];
        for w in curve_places.windows(2) {
            frames.push(double_reflection(&frames[frames.len() - 1], w[0], w[1]));
        }
        // The base stands across the normal, the sections across the curve.
        let upright = DMat3::from_quat(DQuat::from_rotation_arc(normal, tangent));
        let start = curve_places[0].0;
        let local: Vec<DVec3> = base.points.iter().map(|p| first.transpose() * (upright * (*p - start))).collect();
        // κ N by differences, in each frame.
        let n = curve_places.len();
        let bends: Vec<DVec3> = (0..n)
            .map(|k| {
                let (a, b) = (k.saturating_sub(1), (k + 1).min(n - 1));
                frames[k].transpose() * (curve_places[b].1 - curve_places[a].1) / (lengths[b] - lengths[a]).max(1e-12)
            })
            .collect();
        let allowed: Vec<f64> = bends
            .iter()
            .map(|bend| {
                let reach = local.iter().map(|p| p.x * bend.x + p.y * bend.y).fold(0.0, f64::max);
                if reach > WITHIN_BEND { WITHIN_BEND / reach } else { 1.0 }
            })
            .collect();
        let reach = local.iter().map(|p| p.truncate().length()).fold(0.0, f64::max);
        let places = section_places(&bends, &lengths, spacing);
        let sections = |widths: &[f64]| -> Vec<Net> {
            let section = |&(at, t): &(usize, f64)| {
                let place = |j: usize| {
                    // The base's relief fades along the curve: sections become plane.
                    let size = DVec3::new(1.0, 1.0, (1.0 - lengths[j] / length).max(0.0)) * widths[j];
                    let (point, frame) = (curve_places[j].0, frames[j]);
                    local.iter().map(|p| point + frame * (*p * size)).collect::<Vec<_>>()
                };
                let points = place(at).into_iter().zip(place(at + 1)).map(|(p, q)| p.lerp(q, t)).collect();
                Net { counts: base.counts, points }
            };
            places.iter().map(section).collect()
        };
        // What holds for the curve need not for its sections, which are apart: where cells between two of them fold all the same, both are drawn together
        // further.
        let [p1, p2, _, p4] = base.corners();
        let hand = (p2 - p1).cross(p4 - p1).dot(normal);
        let mut allowed = allowed;
        let mut made = sections(&drawn_together(&allowed, &lengths, reach));
        for _ in 0..MOST_ROUNDS {
            let below = |k: usize| if k == 0 { &base } else { &made[k - 1] };
            let folded: Vec<usize> = (0..made.len()).filter(|&k| folds(below(k), &made[k], hand)).collect();
            if folded.is_empty() {
                break;
            }
            for k in folded {
                let (from, to) = (if k == 0 { 0 } else { places[k - 1].0 }, (places[k].0 + 1).min(n - 1));
                allowed[from..=to].iter_mut().for_each(|width| *width *= NARROWER);
            }
            made = sections(&drawn_together(&allowed, &lengths, reach));
        }
        let heights_of = |&(at, t): &(usize, f64)| lengths[at] + (lengths[at + 1] - lengths[at]) * t;
        let above: Vec<f64> = places.iter().map(heights_of).collect();
        let under = |p: &DVec3| climb(field, *p, &[-depth], None)[0];
        let below = Net { counts: base.counts, points: base.points.par_iter().map(under).collect() };
        let heights = Heights { below: vec![-depth], above, texture: [0.0, length] };
        (heights.volume(vec![below], base, made), length)
    }

    /// The map from texture space: bilinear on the two layers around w, linear between them.
    pub fn at(&self, uvw: DVec3) -> DVec3 {
        let above = self.levels.partition_point(|&w| w <= uvw.z).clamp(1, self.levels.len() - 1);
        let (low, high) = (self.levels[above - 1], self.levels[above]);
        let t = ((uvw.z - low) / (high - low)).clamp(0.0, 1.0);
        self.layers[above - 1].bilinear(uvw.x, uvw.y).lerp(self.layers[above].bilinear(uvw.x, uvw.y), t)
    }
}

/// Where the sections of a curve are: the place before each, and the part of the way to the next. They are `spacing` apart, less where it bends; the last one is
/// at the end.
fn section_places(bends: &[DVec3], lengths: &[f64], spacing: f64) -> Vec<(usize, f64)> {
    let n = lengths.len();
    let mut so_far = vec![0.0];
    for k in 1..n {
        let bend = (bends[k - 1].length() + bends[k].length()) / 2.0;
        so_far.push(so_far[k - 1] + (lengths[k] - lengths[k - 1]) * (1.0 / spacing).max(bend / TURN));
    }
    let count = (so_far[n - 1].ceil() as usize).clamp(4, MOST_SECTIONS);
    let mut at = 0;
    let place = |k: usize| {
        let s = so_far[n - 1] * k as f64 / count as f64;
        while at + 2 < n && so_far[at + 1] < s {
            at += 1;
        }
        (at, ((s - so_far[at]) / (so_far[at + 1] - so_far[at]).max(1e-12)).clamp(0.0, 1.0))
    };
    (1..=count).map(place).collect()
}

/// Whether a cell between two nets of equal counts folds: its Jacobian has not the sign of `hand` at a corner.
fn folds(low: &Net, high: &Net, hand: f64) -> bool {
    let [nu, nv] = low.counts;
    (0..nu * nv).any(|cell| {
        let (i, j) = (cell / nv, cell % nv);
        let corner = |u: usize, v: usize, w: usize| [low, high][w].at(i + u, j + v);
        (0..8).any(|c| {
            let [u, v, w] = [c >> 2, c >> 1 & 1, c & 1];
            let by_u = corner(1, v, w) - corner(0, v, w);
            let by_v = corner(u, 1, w) - corner(u, 0, w);
            let by_w = corner(u, v, 1) - corner(u, v, 0);
            by_u.cross(by_v).dot(by_w) * hand <= 0.0
        })
    })
}

/// Widths (0..1) of the sections along a curve that are nowhere more than `allowed`, and change by as much as the curve goes on over `reach` at most.
fn drawn_together(allowed: &[f64], lengths: &[f64], reach: f64) -> Vec<f64> {
    let mut widths = allowed.to_vec();
    let step = |a: usize, b: usize| (lengths[b] - lengths[a]) / reach.max(1e-12);
    for k in 1..widths.len() {
        widths[k] = widths[k].min(widths[k - 1] + step(k - 1, k));
    }
    for k in (1..widths.len()).rev() {
        widths[k - 1] = widths[k - 1].min(widths[k] + step(k - 1, k));
    }
    widths
}

/// The places of a particle of the surface on levels that begin at 0 and rise, or fall, along ∇φ or a direction. It stays where the field has no slope.
fn climb(field: &Field, from: DVec3, levels: &[f64], direction: Option<DVec3>) -> Vec<DVec3> {
    let mut probe = Level::new(field, 0.0).probe();
    // dx/dc for the level c: unit speed through the levels.
    let mut velocity = |x: DVec3| {
        let n = probe.normal(x)?;
        match direction {
            Some(d) => {
                let slope = d.dot(n);
                (slope > LEAST_SLOPE).then(|| d / slope)
            }
            None => Some(n),
        }
    };
    let mut settle = Level::new(field, 0.0).probe();
    let mut path = Vec::with_capacity(levels.len());
    let (mut x, mut c) = (from, 0.0f64);
    for &end in levels {
        let longest = if c.abs() < NEAR { STEP } else { STEP * field.coarseness() };
        let steps = (end - c).abs().div_euclid(longest) as usize + 1;
        let step = (end - c) / steps as f64;
        for _ in 0..steps {
            c += step;
            let Some(v) = velocity(x) else { continue };
            let Some(v) = velocity(x + v * (0.5 * step)) else { continue };
            let moved = x + v * step;
            // Back to the level, without leaving the direction.
            x = moved + v * (c - settle.above(moved)).clamp(-step.abs(), step.abs());
        }
        path.push(x);
    }
    path
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::super::patch::corners_on_surface;
    use super::*;
    use crate::grid::Transform;
    use crate::levelset::LevelSet;
    use crate::run::RunOptions;

    /// Voxel size 1.
    fn sampled(reach: i32, half_width: f32, f: impl Fn(DVec3) -> f64 + Sync) -> Field {
        let bounds = (IVec3::splat(-reach), IVec3::splat(reach));
        let level_set = LevelSet::from_distance(Transform::uniform(1.0), half_width, bounds, f, &RunOptions::default());
        Field::around(&level_set.unwrap(), 8.0)
    }

    fn over(field: &Field, corners: [DVec3; 4]) -> Net {
        let corners = corners_on_surface(field, corners, 5.0, false).unwrap();
        patch(Level::new(field, 0.0), corners, 2.0, None).unwrap()
    }

    #[test]
    fn over_a_plane_the_map_is_affine() {
        let plane = sampled(20, 10.0, |p| p.z - 0.25);
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let base = over(&plane, [corner(-8.0, -6.0), corner(8.0, -6.0), corner(8.0, 6.0), corner(-8.0, 6.0)]);
        let conforming = Volume::conforming(&plane, base.clone(), &Heights::raised(6.0, 2.0, 2.0));
        let even = Volume::low_distortion(&plane, base, &Heights::raised(6.0, 2.0, 2.0), 2.0, None).unwrap();
        for volume in [conforming, even] {
            for uvw in [DVec3::ZERO, DVec3::ONE, DVec3::new(0.3, 0.7, 0.4), DVec3::new(0.9, 0.1, -0.25)] {
                let exact = DVec3::new(16.0 * uvw.x - 8.0, 12.0 * uvw.y - 6.0, 6.0 * uvw.z + 0.25);
                assert!(volume.at(uvw).distance(exact) < 1e-3, "{uvw}");
            }
        }
    }

    #[test]
    fn over_a_ball_areas_grow_with_the_square() {
        let ball = sampled(34, 12.0, |p| p.length() - 16.0);
        let at = |x: f64, y: f64| DVec3::new(x, y, 1.0).normalize() * 16.0;
        let base = over(&ball, [at(-0.4, -0.4), at(0.4, -0.4), at(0.4, 0.4), at(-0.4, 0.4)]);
        let volume = Volume::conforming(&ball, base.clone(), &Heights::raised(8.0, 2.0, 2.0));
        for (net, w) in volume.layers.iter().zip(&volume.levels) {
            for (p, q) in base.points.iter().zip(&net.points) {
                let radius = 16.0 + 8.0 * w;
                assert!(q.distance(*p / 16.0 * radius) < 0.06, "{w} {p} {q}");
            }
        }
        // The low-distortion net of a level has cells of the size asked for, hence more of them.
        let even = Volume::low_distortion(&ball, base, &Heights::raised(8.0, 2.0, 2.0), 2.0, None).unwrap();
        assert!(even.layers[5].counts[0] > even.layers[0].counts[0]);
        assert!(even.layers[5].points.iter().all(|p| (p.length() - 24.0).abs() < 0.06));
    }

    #[test]
    fn corners_follow_their_directions() {
        let plane = sampled(24, 10.0, |p| p.z);
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let base = over(&plane, [corner(-6.0, -6.0), corner(6.0, -6.0), corner(6.0, 6.0), corner(-6.0, 6.0)]);
        let outwards = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| DVec3::new(x, y, 2.0));
        let volume =
            Volume::low_distortion(&plane, base, &Heights::raised(8.0, 2.0, 2.0), 2.0, Some(outwards)).unwrap();
        assert!(volume.at(DVec3::new(1.0, 1.0, 1.0)).distance(DVec3::new(10.0, 10.0, 8.0)) < 1e-2);
        assert!(volume.at(DVec3::new(0.5, 0.5, 0.5)).distance(DVec3::new(0.0, 0.0, 4.0)) < 1e-2);
    }
}
