//! A perspective camera that frames the surface.
//!
//! For a fixed orientation, all points lie in the frame of half-angle tangent τ at the right when x + τ z ≤ cx + τ cz, and
//! likewise at the other sides (x right, y up, z towards the camera at c). So the largest value over the points at each
//! side gives the closest camera that cuts nothing, in one pass and without iteration.

use glam::{DVec2, DVec3, IVec3};
use serde::{Deserialize, Serialize};

use crate::grid::offset_to_local;
use crate::levelset::LevelSet;

/// The axis of the world that points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// y up, azimuth 0 looks along −z: most scanned and game models, Houdini, Maya.
    #[default]
    Y,
    /// z up, azimuth 0 looks along +y: Blender, 3ds Max, CAD.
    Z,
}

/// What the picture is framed on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Frame {
    /// The surface, as large as it fits.
    #[default]
    Surface,
    /// A sphere around the surface: the same size from every direction, for turntables.
    Sphere,
    /// A box in the world, lower and upper corner: the same picture area for several objects.
    Box(DVec3, DVec3),
}

/// Where the camera stands and what it frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraSpec {
    /// Degrees around the up axis, counter-clockwise seen from above; 0 is the front.
    pub azimuth: f64,
    /// Degrees above the horizon, −90..90.
    pub elevation: f64,
    /// Vertical field of view in degrees, 1..120. Small values flatten the perspective.
    pub field_of_view: f64,
    /// Empty part of the picture at each side, 0..0.45 of its size.
    pub margin: f64,
    /// The axis of the world that points up.
    pub up: UpAxis,
    /// What fills the picture.
    pub frame: Frame,
}

impl Default for CameraSpec {
    fn default() -> Self {
        Self { azimuth: 35.0, elevation: 20.0, field_of_view: 28.0, margin: 0.06, up: UpAxis::Y, frame: Frame::Surface }
    }
}

/// A placed camera, in world space.
#[derive(Clone, PartialEq)]
pub(super) struct Camera {
    pub eye: DVec3,
    pub right: DVec3,
    pub up: DVec3,
    /// Towards the camera.
    pub back: DVec3,
    /// Half of the picture's extent at distance 1, horizontally and vertically.
    tangent: [f64; 2],
    size: [f64; 2],
}

impl Camera {
    /// The camera of `spec` for a picture of `width` × `height` that shows `points`, each with a radius (world).
    pub fn framing(spec: &CameraSpec, points: &[(DVec3, f64)], width: u32, height: u32) -> Self {
        let [right, up, back] = axes(spec);
        let size = [f64::from(width), f64::from(height)];
        let vertical = (spec.field_of_view.to_radians() / 2.0).tan();
        let tangent = [vertical * size[0] / size[1], vertical];
        // Relative to the first point, so that a place far from the world's origin costs no digits.
        let origin = points.first().map_or(DVec3::ZERO, |p| p.0);
        let fit = |axis: DVec3, tau: f64| {
            let tau = tau * (1.0 - 2.0 * spec.margin);
            let secant = (1.0 + tau * tau).sqrt();
            let (mut low, mut high) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
            for &(p, radius) in points {
                let (x, z) = ((p - origin).dot(axis), tau * (p - origin).dot(back));
                high = high.max(x + z + radius * secant);
                low = low.max(z - x + radius * secant);
            }
            // Position across and distance along `back` of the closest camera.
            ((high - low) / 2.0, (high + low) / (2.0 * tau))
        };
        let ((x, dx), (y, dy)) = (fit(right, tangent[0]), fit(up, tangent[1]));
        let eye = if points.is_empty() { DVec3::ZERO } else { origin + right * x + up * y + back * dx.max(dy) };
        Self { eye, right, up, back, tangent, size }
    }

    /// Direction (world, unit) through the picture at (x, y) in pixels from the top left corner.
    #[inline]
    pub fn direction(&self, x: f64, y: f64) -> DVec3 {
        let u = (2.0 * x / self.size[0] - 1.0) * self.tangent[0];
        let v = (1.0 - 2.0 * y / self.size[1]) * self.tangent[1];
        (self.right * u + self.up * v - self.back).normalize()
    }

    /// Where in the picture (pixels from the top left corner) a point is seen; `None` beside and behind the eye.
    pub fn pixel_of(&self, xyz: DVec3) -> Option<DVec2> {
        let from_eye = xyz - self.eye;
        let depth = -from_eye.dot(self.back);
        let u = from_eye.dot(self.right) / depth / self.tangent[0];
        let v = from_eye.dot(self.up) / depth / self.tangent[1];
        (depth > 1e-9).then(|| DVec2::new((u + 1.0) * self.size[0], (1.0 - v) * self.size[1]) / 2.0)
    }

    /// Edge of a pixel at distance 1.
    pub fn pixel(&self) -> f64 {
        2.0 * self.tangent[1] / self.size[1]
    }
}

/// Right, up and back of a camera that looks from an azimuth and elevation.
fn axes(spec: &CameraSpec) -> [DVec3; 3] {
    let (sa, ca) = spec.azimuth.to_radians().sin_cos();
    let (se, ce) = spec.elevation.to_radians().sin_cos();
    let right = DVec3::new(ca, 0.0, -sa);
    let back = DVec3::new(ce * sa, se, ce * ca);
    let local = [right, back.cross(right), back];
    match spec.up {
        UpAxis::Y => local,
        UpAxis::Z => local.map(|v| DVec3::new(v.x, -v.z, v.y)),
    }
}

/// The points that have to be in the picture, with radii: the surface by its leaves, or what the frame says.
pub(super) fn points_to_frame(level_set: &LevelSet, frame: Frame) -> Vec<(DVec3, f64)> {
    if let Frame::Box(lo, hi) = frame {
        return (0..8)
            .map(|c| {
                let pick = |bit: i32| if c >> bit & 1 == 1 { 1.0 } else { 0.0 };
                (lo + (hi - lo) * DVec3::new(pick(2), pick(1), pick(0)), 0.0)
            })
            .collect();
    }
    let boxes = surface_boxes(level_set);
    let transform = level_set.transform();
    if frame == Frame::Sphere {
        let Some((lo, hi)) = boxes.iter().copied().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) else {
            return Vec::new();
        };
        let centre = (lo.as_dvec3() + hi.as_dvec3()) / 2.0;
        let reach = |b: &(IVec3, IVec3)| (b.0.as_dvec3() - centre).abs().max((b.1.as_dvec3() - centre).abs()).length();
        let radius = boxes.iter().map(reach).fold(0.0, f64::max) * level_set.voxel_size();
        return vec![(transform.index_to_world(centre), radius)];
    }
    boxes
        .into_iter()
        .flat_map(|(lo, hi)| {
            (0..8).map(move |c| IVec3::new([lo.x, hi.x][c >> 2], [lo.y, hi.y][c >> 1 & 1], [lo.z, hi.z][c & 1]))
        })
        .map(|corner| (transform.voxel_to_world(corner), 0.0))
        .collect()
}

/// For every leaf with surface, the box of its voxels less than a voxel from the surface. Together they hold the surface;
/// their corners stick out by a few voxels where it runs obliquely, so a very coarse object gets a wider margin.
fn surface_boxes(level_set: &LevelSet) -> Vec<(IVec3, IVec3)> {
    let grid = level_set.grid();
    let reach = level_set.voxel_size() as f32;
    let mut boxes: Vec<_> = grid
        .map_leaves(|id| {
            let values = &grid.values(id).0;
            let near = (0..values.len()).filter(|&o| values[o].abs() < reach).map(offset_to_local);
            near.map(|p| (p, p))
                .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
                .map(|(lo, hi)| (lo + grid.origin(id), hi + grid.origin(id)))
        })
        .into_iter()
        .flatten()
        .collect();
    if boxes.is_empty() {
        boxes.extend(grid.active_bounds());
    }
    boxes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sphere_touches_the_margin_on_all_sides_it_can() {
        for (width, height) in [(400, 300), (200, 500)] {
            let spec = CameraSpec { margin: 0.1, azimuth: 77.0, elevation: -31.0, ..CameraSpec::default() };
            let centre = DVec3::new(1e6, -2e6, 3e5);
            let camera = Camera::framing(&spec, &[(centre, 2.0)], width, height);
            let to_centre = centre - camera.eye;
            // Straight at the centre, and as close as the narrower side allows: sin of the half-angle = r / distance.
            assert!((to_centre.normalize() + camera.back).length() < 1e-9);
            let narrow = (14f64.to_radians().tan() * (f64::from(width.min(height)) / f64::from(height)) * 0.8).atan();
            assert!((2.0 / to_centre.length() - narrow.sin()).abs() < 1e-9);
        }
    }

    #[test]
    fn no_point_is_cut_and_some_point_is_at_the_margin() {
        let points: Vec<_> = (0..60)
            .map(|i| DVec3::new((i * 37 % 61) as f64, (i * 17 % 23) as f64, (i * 29 % 97) as f64))
            .map(|p| (p, 0.0))
            .collect();
        for (azimuth, elevation, up) in [(0.0, 0.0, UpAxis::Y), (130.0, 90.0, UpAxis::Z), (-60.0, -45.0, UpAxis::Z)] {
            let spec = CameraSpec { azimuth, elevation, up, margin: 0.05, ..CameraSpec::default() };
            let camera = Camera::framing(&spec, &points, 640, 480);
            let mut largest: f64 = 0.0;
            for (p, _) in &points {
                let q = *p - camera.eye;
                let depth = -q.dot(camera.back);
                assert!(depth > 0.0);
                for (axis, tangent) in [(camera.right, camera.tangent[0]), (camera.up, camera.tangent[1])] {
                    largest = largest.max((q.dot(axis) / depth / tangent).abs());
                }
            }
            assert!((largest - 0.9).abs() < 1e-9, "{largest}");
            assert!((camera.right.cross(camera.up) - camera.back).length() < 1e-12);
        }
    }
}
