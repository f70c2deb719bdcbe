//! How much of the sky and of the key light a surface point sees, without noise.
//!
//! Every pixel of a 4×4 pattern follows its own few rays of one fixed set, stratified over the hemisphere by the cosine; a
//! filter over 5×5 pixels with half weights at its border then gives every pixel the mean of the whole set
//! (interleaved sampling, Keller and Heidrich 2001). Pixels on another part of the surface do not count. Where pixels are smaller than voxels, every second or
//! fourth one along a side follows rays: the filter reaches over as many of them.

use glam::DVec3;

use super::change::Changed;
use super::field::Cursor;
use super::march::{Ray, Scene, Start};

/// Edge of the interleaved pattern in pixels that follow rays.
const PATTERN: usize = 4;
/// How many of these the filter reaches to each side.
pub(super) const REACH: i64 = PATTERN as i64 / 2;
/// Rays start this far (voxels) off the surface: the facets of the trilinear surface shall not shadow each other.
const LIFT: f64 = 0.35;
/// Half-angle of the key light's disc: a large studio light.
const LIGHT_RADIUS: f64 = 0.16;
/// The two irrationals of the R2 sequence (Roberts 2018): the plane's counterpart of the golden ratio.
const R2: [f64; 2] = [0.754_877_666_246_693, 0.569_840_290_998_053];

/// Visible part of the sky and of the key light, 0..1 each.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Visibility {
    pub sky: f64,
    pub key: f64,
}

/// What the rays need to know, in index space.
pub(super) struct Light {
    /// Towards the key light, unit.
    pub key: DVec3,
    /// How far an obstacle darkens the sky, in voxels.
    pub range: f64,
    /// Rays a pixel to the sky; none leaves all of it visible.
    pub sky_rays: usize,
    /// Rays a pixel to the key light; none leaves it visible.
    pub key_rays: usize,
    /// The directions to the sky of all classes, along the axes of a surface point: two tangents and the normal.
    to_sky: Vec<DVec3>,
    /// The directions to the key light of all classes.
    to_key: Vec<DVec3>,
}

/// Visibility from a surface point with unit `normal` (index axes), with the rays of the pattern at pixel (x, y).
pub(super) fn visibility(
    scene: &Scene<'_>,
    cursor: &mut Cursor<'_>,
    light: &Light,
    (point, normal): (DVec3, DVec3),
    (x, y): (i64, i64),
) -> Visibility {
    let origin = point + normal * LIFT;
    let class = class_of((x, y));
    let (tangent, bitangent) = normal.any_orthonormal_pair();
    let sky = if light.sky_rays == 0 {
        1.0
    } else {
        let mut seen = 0.0;
        for k in 0..light.sky_rays {
            let ray = light.to_sky((origin, normal), (tangent, bitangent), k, class);
            // A near obstacle hides the sky, a far one reflects light itself.
            seen += scene.hit(cursor, &ray, Start::Surface, light.range).map_or(1.0, |t| (t / light.range).powi(2));
        }
        seen / light.sky_rays as f64
    };
    let key = if light.key_rays == 0 {
        1.0
    } else if normal.dot(light.key) < -LIGHT_RADIUS {
        0.0
    } else {
        let mut seen = 0;
        for k in 0..light.key_rays {
            let ray = light.to_key(origin, k, class);
            seen += usize::from(scene.hit(cursor, &ray, Start::Surface, f64::INFINITY).is_none());
        }
        seen as f64 / light.key_rays as f64
    };
    Visibility { sky, key }
}

/// Whether one of the rays of [`visibility`] passes something that was changed.
pub(super) fn meets(light: &Light, (point, normal): (DVec3, DVec3), at: (i64, i64), changed: &Changed) -> bool {
    let (origin, class) = (point + normal * LIFT, class_of(at));
    // Most are decided by a ball around the box: too far or below the horizon for the sky, beside the cone towards the light.
    let bounds = changed.bounds();
    let (to, radius) = ((bounds.0 + bounds.1) / 2.0 - origin, (bounds.1 - bounds.0).length() / 2.0);
    let distance = to.length();
    let (along, reach) = (to.dot(light.key), light.range + radius);
    let across = (distance * distance - along * along).max(0.0).sqrt();
    let is_in_sky = distance <= reach && to.dot(normal) > -radius;
    let is_to_key = along > -radius && across - radius <= (along + radius) * LIGHT_RADIUS;
    let pair = normal.any_orthonormal_pair();
    let to_sky = |k| changed.is_met(&light.to_sky((origin, normal), pair, k, class), light.range);
    let to_key = |k| changed.is_met(&light.to_key(origin, k, class), f64::INFINITY);
    is_in_sky && (0..light.sky_rays).any(to_sky) || is_to_key && (0..light.key_rays).any(to_key)
}

/// The place of a pixel in the pattern.
fn class_of((x, y): (i64, i64)) -> usize {
    let [column, row] = [x, y].map(|c| c.rem_euclid(PATTERN as i64) as usize);
    row * PATTERN + column
}

impl Light {
    /// With so many rays a pixel.
    pub fn new(key: DVec3, range: f64, sky_rays: usize, key_rays: usize) -> Self {
        let points = |count: usize| {
            (0..PATTERN * PATTERN).flat_map(move |class| (0..count).map(move |k| set_point(k, count, class)))
        };
        let turn = |v: f64| (std::f64::consts::TAU * v).sin_cos();
        let sky = |[u, v]: [f64; 2]| {
            let (sin, cos) = turn(v);
            DVec3::new(cos * u.sqrt(), sin * u.sqrt(), (1.0 - u).sqrt())
        };
        let (a, b) = key.any_orthonormal_pair();
        let disc = |[u, v]: [f64; 2]| {
            let (sin, cos) = turn(v);
            (key + (a * cos + b * sin) * (u.sqrt() * LIGHT_RADIUS)).normalize()
        };
        let (to_sky, to_key) = (points(sky_rays).map(sky).collect(), points(key_rays).map(disc).collect());
        Self { key, range, sky_rays, key_rays, to_sky, to_key }
    }

    /// A ray to the sky above a point with its normal and the directions across that.
    fn to_sky(&self, (origin, normal): (DVec3, DVec3), (a, b): (DVec3, DVec3), k: usize, class: usize) -> Ray {
        let along = self.to_sky[class * self.sky_rays + k];
        Ray::new(origin, a * along.x + b * along.y + normal * along.z)
    }

    /// A ray to the key light.
    fn to_key(&self, origin: DVec3, k: usize, class: usize) -> Ray {
        Ray::new(origin, self.to_key[class * self.key_rays + k])
    }
}

/// Point `k` of `count` in the unit square, for one class of the pattern: any run of the R2 sequence is even over the
/// square, so both the points of one class and those of all classes together are.
fn set_point(k: usize, count: usize, class: usize) -> [f64; 2] {
    R2.map(|r| (0.5 + (class * count + k + 1) as f64 * r).fract())
}

/// A pixel as the filter sees it.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct FilterPoint {
    pub position: DVec3,
    pub normal: DVec3,
}

impl FilterPoint {
    /// How much `other` belongs to the same piece of surface, 0..1, for pixels that are `footprint` voxels apart.
    pub fn affinity(&self, other: &Self, footprint: f64) -> f64 {
        let bend = ((self.normal.dot(other.normal) - 0.7) / 0.25).clamp(0.0, 1.0);
        let gap = other.position - self.position;
        let off_plane = gap.dot(self.normal).abs().max(gap.dot(other.normal).abs());
        bend * (1.0 - off_plane / (3.0 * footprint + 0.25)).max(0.0)
    }
}

/// Weight of a pixel `offset` away along one axis: half at the border of a filter.
pub(super) fn filter_weight(offset: i64, border: i64) -> f64 {
    if offset.abs() == border { 0.5 } else { 1.0 }
}

/// Pixels from one that follows rays to the next, for pixels with an edge of so many voxels: what a voxel holds is not looked for twice.
pub(super) fn spacing(footprint: f64) -> i64 {
    match footprint {
        f if f > 0.6 => 1,
        f if f > 0.3 => 2,
        _ => 4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::testing::{scene, sphere};

    #[test]
    fn the_whole_pattern_is_even_over_the_square() {
        let points: Vec<_> = (0..16).flat_map(|class| (0..8).map(move |k| set_point(k, 8, class))).collect();
        // 128 points in 16 cells: no cell is empty or crowded.
        let mut counts = [[0; 4]; 4];
        for [u, v] in points {
            assert!((0.0..1.0).contains(&u) && (0.0..1.0).contains(&v));
            counts[(u * 4.0) as usize][(v * 4.0) as usize] += 1;
        }
        assert!(counts.iter().flatten().all(|c| (6..=10).contains(c)), "{counts:?}");
    }

    #[test]
    fn a_convex_surface_sees_the_whole_sky() {
        let set = sphere(20.0, 3.0);
        let scene = scene(&set);
        let mut cursor = scene.field.cursor();
        let light = Light::new(DVec3::Y, 30.0, 8, 4);
        for i in 0..64 {
            let a = f64::from(i) * 2.399963;
            let z = 1.0 - (f64::from(i) + 0.5) / 32.0;
            let n = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            let pixel = (i64::from(i) % 4, i64::from(i) / 4);
            let seen = visibility(&scene, &mut cursor, &light, (n * 20.0, n), pixel);
            assert_eq!(seen.sky, 1.0);
            if n.y.abs() > 0.2 {
                assert_eq!(seen.key, f64::from(u8::from(n.y > 0.0)), "{n}");
            }
        }
    }
}
