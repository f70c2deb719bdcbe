//! The space above a patch: layers of nets from the surface up to a height, and the map from (u, v, w) in 0..1³ into it.

use glam::DVec3;
use rayon::prelude::*;

use super::level::Level;
use super::patch::{Net, patch};
use crate::levelset::LevelSet;

/// Largest step of a particle, in voxels.
const STEP: f64 = 0.5;

/// Nets one above the other; layer k is at w = k/(layers − 1). Layers may have different numbers of cells. Positions in voxels.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Volume {
    pub layers: Vec<Net>,
}

impl Volume {
    /// Over `base`, on the levels of the field up to `height` voxels: each particle follows ∇φ. The band must reach two voxels
    /// beyond the height. Particles keep their neighbours at every height, so cells widen over convex parts and narrow over concave ones.
    pub fn conforming(field: &LevelSet, base: Net, height: f64, layers: usize) -> Self {
        let paths: Vec<Vec<DVec3>> = base.points.par_iter().map(|&p| climb(field, p, height, layers, None)).collect();
        let counts = base.counts;
        let layer = |k| Net { counts, points: paths.iter().map(|path| path[k]).collect() };
        Self { layers: (0..layers).map(layer).collect() }
    }

    /// As [`conforming`](Self::conforming), but only the corners climb, along `directions` if there are any; between them each level gets a
    /// net of its own, so that cells stay even. `None` where a level cannot be spanned.
    pub fn low_distortion(
        field: &LevelSet,
        base: Net,
        height: f64,
        layers: usize,
        spacing: f64,
        directions: Option<[DVec3; 4]>,
    ) -> Option<Self> {
        let corners = base.corners();
        let paths: [Vec<DVec3>; 4] =
            std::array::from_fn(|c| climb(field, corners[c], height, layers, directions.map(|d| d[c])));
        let mut nets = vec![base];
        for k in 1..layers {
            let level = Level::new(field, height * k as f64 / (layers - 1) as f64);
            let corners = [0, 1, 2, 3].map(|c| paths[c][k]);
            let net = patch(level, corners, spacing, nets.last())?;
            nets.push(net);
        }
        Some(Self { layers: nets })
    }

    /// The map from texture space: bilinear on the two layers around w, linear between them.
    pub fn at(&self, uvw: DVec3) -> DVec3 {
        let last = self.layers.len() - 1;
        let level = uvw.z.clamp(0.0, 1.0) * last as f64;
        let k = (level as usize).min(last.saturating_sub(1));
        let below = self.layers[k].bilinear(uvw.x, uvw.y);
        match self.layers.get(k + 1) {
            Some(above) => below.lerp(above.bilinear(uvw.x, uvw.y), level - k as f64),
            None => below,
        }
    }
}

/// The places of a particle of the surface on the levels 0 … `height`, along ∇φ or a direction. It stays where the field has no slope.
fn climb(field: &LevelSet, from: DVec3, height: f64, layers: usize, direction: Option<DVec3>) -> Vec<DVec3> {
    let mut probe = Level::new(field, 0.0).probe();
    // dx/dc for the level c: unit speed through the levels.
    let mut velocity = |x: DVec3| {
        let n = probe.normal(x)?;
        match direction {
            Some(d) => {
                let slope = d.dot(n);
                (slope > 0.1).then(|| d / slope)
            }
            None => Some(n),
        }
    };
    let mut settle = Level::new(field, 0.0).probe();
    let mut path = vec![from];
    let (mut x, mut c) = (from, 0.0);
    for k in 1..layers {
        let end = height * k as f64 / (layers - 1) as f64;
        while c < end {
            let step = STEP.min(end - c);
            c += step;
            let Some(v) = velocity(x) else { continue };
            let Some(v) = velocity(x + v * (0.5 * step)) else { continue };
            let moved = x + v * step;
            // Back to the level, without leaving the direction.
            let off = c - settle.above(moved);
            x = moved + v * off.clamp(-step, step);
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
    use crate::run::RunOptions;

    /// Voxel size 1.
    fn sampled(reach: i32, half_width: f32, f: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
        let bounds = (IVec3::splat(-reach), IVec3::splat(reach));
        LevelSet::from_distance(Transform::uniform(1.0), half_width, bounds, f, &RunOptions::default()).unwrap()
    }

    fn over(field: &LevelSet, corners: [DVec3; 4]) -> Net {
        let corners = corners_on_surface(field, corners, 5.0).unwrap();
        patch(Level::new(field, 0.0), corners, 2.0, None).unwrap()
    }

    #[test]
    fn over_a_plane_the_map_is_affine() {
        let plane = sampled(20, 10.0, |p| p.z - 0.25);
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let base = over(&plane, [corner(-8.0, -6.0), corner(8.0, -6.0), corner(8.0, 6.0), corner(-8.0, 6.0)]);
        let conforming = Volume::conforming(&plane, base.clone(), 6.0, 4);
        let even = Volume::low_distortion(&plane, base, 6.0, 4, 2.0, None).unwrap();
        for volume in [conforming, even] {
            for uvw in [DVec3::ZERO, DVec3::ONE, DVec3::new(0.3, 0.7, 0.4), DVec3::new(0.9, 0.1, 0.95)] {
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
        let volume = Volume::conforming(&ball, base.clone(), 8.0, 5);
        for (k, net) in volume.layers.iter().enumerate() {
            for (p, q) in base.points.iter().zip(&net.points) {
                let radius = 16.0 + 2.0 * k as f64;
                assert!(q.distance(*p / 16.0 * radius) < 0.06, "{k} {p} {q}");
            }
        }
        // The low-distortion net of a level has cells of the size asked for, hence more of them.
        let even = Volume::low_distortion(&ball, base, 8.0, 5, 2.0, None).unwrap();
        assert!(even.layers[4].counts[0] > even.layers[0].counts[0]);
        assert!(even.layers[4].points.iter().all(|p| (p.length() - 24.0).abs() < 0.06));
    }

    #[test]
    fn corners_follow_their_directions() {
        let plane = sampled(24, 10.0, |p| p.z);
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let base = over(&plane, [corner(-6.0, -6.0), corner(6.0, -6.0), corner(6.0, 6.0), corner(-6.0, 6.0)]);
        let outwards = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| DVec3::new(x, y, 2.0));
        let volume = Volume::low_distortion(&plane, base, 8.0, 5, 2.0, Some(outwards)).unwrap();
        assert!(volume.at(DVec3::new(1.0, 1.0, 1.0)).distance(DVec3::new(10.0, 10.0, 8.0)) < 1e-2);
        assert!(volume.at(DVec3::new(0.5, 0.5, 0.5)).distance(DVec3::new(0.0, 0.0, 4.0)) < 1e-2);
    }
}
