//! The surfaces φ = c of a distance field, to which points are brought back.

use glam::{DVec3, IVec3};

use super::field::{Field, Lookup};

/// Newton steps, and how near the level they end, in voxels (Brodersen et al. 2007).
const STEPS: usize = 10;
const NEAR_ENOUGH: f64 = 1e-3;

/// |∇φ|² below which a field has no direction: medial axes, flat parts beyond the band.
const FLAT_SQUARED: f64 = 0.01;

/// The surface φ = c. Positions and c are in voxels of the field.
#[derive(Clone, Copy)]
pub(super) struct Level<'a> {
    field: &'a Field,
    height: f64,
}

impl<'a> Level<'a> {
    /// The surface `height` voxels outside the zero set. The band must hold it.
    pub fn new(field: &'a Field, height: f64) -> Self {
        Self { field, height }
    }

    /// The point of the level that belongs to a place that may lie far from it: by the gradient where there is one, else from the nearest
    /// voxel beside the level.
    pub fn reach(&self, probe: &mut Probe, x: DVec3) -> Option<DVec3> {
        probe.project(x).or_else(|| probe.project(self.field.nearest_node(self.height, x)?))
    }

    /// Looks points up, one after the other.
    pub fn probe(&self) -> Probe<'a> {
        Probe { field: self.field.lookup(), height: self.height }
    }
}

/// A level and the place in the grid that was looked at last.
pub(super) struct Probe<'a> {
    field: Lookup<'a>,
    height: f64,
}

impl Probe<'_> {
    /// Voxels above the level.
    pub fn above(&mut self, x: DVec3) -> f64 {
        self.field.value(x) - self.height
    }

    /// The unit normal of the level through `x`, by central differences over a voxel; `None` where there is none.
    pub fn normal(&mut self, x: DVec3) -> Option<DVec3> {
        let gradient = self.field.smooth_gradient(x);
        (gradient.length_squared() > FLAT_SQUARED).then(|| gradient.normalize())
    }

    /// The point of the level by `x`, by x ← x − (φ − c) ∇φ/|∇φ|²; where the field is not smooth, the nearest crossing of
    /// an edge of the grid. `None` where there is no surface within two voxels of the lattice of where the iteration ends.
    pub fn project(&mut self, x: DVec3) -> Option<DVec3> {
        let mut at = x;
        for _ in 0..STEPS {
            let (phi, gradient) = self.field.value_and_gradient(at);
            let above = phi - self.height;
            if above.abs() < NEAR_ENOUGH {
                return Some(at);
            }
            let squared = gradient.length_squared();
            if squared < FLAT_SQUARED {
                break;
            }
            // A gradient that is too small must not throw the point away.
            let step = gradient * (above / squared);
            at -= step.clamp_length_max(2.0 * above.abs());
        }
        self.nearest_crossing(at)
    }

    /// The crossing of the level with an edge of the grid that is nearest to `x`, among those up to two voxels away along each axis.
    fn nearest_crossing(&mut self, x: DVec3) -> Option<DVec3> {
        if !x.is_finite() || x.abs().max_element() > f64::from(crate::grid::MAX_COORD - 4) {
            return None;
        }
        let (origin, edge) = self.field.lattice(self.height);
        let place = |voxel: IVec3| origin + voxel.as_dvec3() * edge;
        let base = ((x - origin) / edge).floor().as_ivec3();
        let mut best: Option<(f64, DVec3)> = None;
        for i in 0..6 * 6 * 6 {
            let voxel = base + IVec3::new(i / 36 - 2, i / 6 % 6 - 2, i % 6 - 2);
            let a = self.above(place(voxel));
            for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
                let b = self.above(place(voxel + axis));
                if (a < 0.0) != (b < 0.0) {
                    let p = place(voxel) + axis.as_dvec3() * (edge * a / (a - b));
                    let d = p.distance_squared(x);
                    if best.is_none_or(|(least, _)| d < least) {
                        best = Some((d, p));
                    }
                }
            }
        }
        best.map(|(_, p)| p)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::LevelSet;
    use crate::levelset::testing::{ball, box_distance, sampled};

    #[test]
    fn points_come_back_to_the_level() {
        let ball = Field::around(&ball(DVec3::new(0.2, 0.1, 0.0), 12.0), 8.0);
        let mut probe = Level::new(&ball, 1.0).probe();
        for direction in [DVec3::X, DVec3::new(1.0, 2.0, -3.0).normalize(), DVec3::new(-1.0, 0.1, 0.1).normalize()] {
            let centre = DVec3::new(0.2, 0.1, 0.0);
            let p = probe.project(centre + direction * 14.0).unwrap();
            // Trilinear interpolation errs by up to h²/(8R)·2.
            assert!((p.distance(centre) - 13.0).abs() < 0.03 && probe.above(p).abs() < 1e-3);
            assert!((probe.normal(p).unwrap() - direction).length() < 0.02);
        }
        assert!(probe.project(DVec3::splat(1e300)).is_none());
    }

    #[test]
    fn a_point_by_a_sharp_corner_or_far_away_finds_the_surface() {
        let half = DVec3::new(9.3, 9.3, 9.3);
        let cube = Field::around(&sampled(14, move |p| box_distance(p, half)), 8.0);
        let mut probe = Level::new(&cube, 0.0).probe();
        let p = probe.project(DVec3::splat(9.0)).unwrap();
        assert!(box_distance(p, half).abs() < 0.5, "{p}");
        let level = Level::new(&cube, 0.0);
        let far = level.reach(&mut probe, DVec3::new(60.0, 1.0, 2.0)).unwrap();
        assert!((far - DVec3::new(9.3, 1.0, 2.0)).length() < 0.01, "{far}");
        let empty = Field::around(&LevelSet::empty(crate::grid::Transform::uniform(1.0), 3.0), 8.0);
        let level = Level::new(&empty, 0.0);
        assert!(level.reach(&mut level.probe(), DVec3::ZERO).is_none());
    }
}
