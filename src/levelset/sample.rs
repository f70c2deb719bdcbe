//! φ, its gradient and the closest surface point at any position.

use glam::{DVec3, IVec3};

use super::LevelSet;
use crate::grid::Accessor;

/// Largest index-space coordinate at which a sample is looked up; beyond it everything is outside.
const FARTHEST: f64 = (crate::grid::MAX_COORD - 2) as f64;

/// Reads φ between voxels. Positions are in index space; values are in world units. Remembers the last leaf.
pub struct Sampler<'a> {
    accessor: Accessor<'a>,
    level_set: &'a LevelSet,
}

impl<'a> Sampler<'a> {
    pub(super) fn new(level_set: &'a LevelSet) -> Self {
        Self { accessor: level_set.grid().accessor(), level_set }
    }

    /// Value of a voxel.
    pub fn voxel(&mut self, ijk: IVec3) -> f32 {
        self.accessor.value(ijk)
    }

    /// Trilinear interpolation of φ at an index-space position; exact on linear fields.
    #[inline]
    pub fn trilinear(&mut self, ijk: DVec3) -> f32 {
        let Some((cell, t)) = split(ijk) else { return self.level_set.background() };
        let c = self.accessor.cell(cell).map(f64::from);
        let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let z: [f64; 4] = std::array::from_fn(|i| lerp(c[2 * i], c[2 * i + 1], t.z));
        lerp(lerp(z[0], z[1], t.y), lerp(z[2], z[3], t.y), t.x) as f32
    }

    /// φ (world units) and the gradient of its trilinear interpolant (dimensionless, index axes: a unit vector on a distance field).
    #[inline]
    pub fn value_and_gradient(&mut self, ijk: DVec3) -> (f32, DVec3) {
        let Some((cell, t)) = split(ijk) else { return (self.level_set.background(), DVec3::ZERO) };
        let (phi, gradient) = interpolate(self.accessor.cell(cell), t);
        (phi as f32, gradient / self.level_set.voxel_size())
    }

    /// Central-difference gradient at an index-space position, of the trilinear interpolant with a step of one voxel:
    /// smoother than [`value_and_gradient`](Self::value_and_gradient), whose gradient jumps between cells. Index axes, dimensionless.
    pub fn smooth_gradient(&mut self, ijk: DVec3) -> DVec3 {
        let mut along = |axis: DVec3| f64::from(self.trilinear(ijk + axis)) - f64::from(self.trilinear(ijk - axis));
        DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z)) / (2.0 * self.level_set.voxel_size())
    }

    /// The surface point closest to an index-space position within the band, by Newton's iteration
    /// x ← x − φ ∇φ/|∇φ|²; `None` where the field has no gradient or the iteration leaves the band.
    /// On a distance field two or three steps reach the accuracy of the interpolation.
    pub fn closest_point(&mut self, ijk: DVec3) -> Option<DVec3> {
        let voxel_size = self.level_set.voxel_size();
        let mut x = ijk;
        for _ in 0..10 {
            let (phi, gradient) = self.value_and_gradient(x);
            let phi = f64::from(phi) / voxel_size;
            if phi.abs() < 1e-3 {
                return Some(x);
            }
            let squared = gradient.length_squared();
            if squared < 1e-2 {
                return None;
            }
            x -= gradient * (phi / squared);
            if (x - ijk).length() > 2.0 * f64::from(self.level_set.half_width()) + 1.0 {
                return None;
            }
        }
        None
    }
}

/// The trilinear interpolant of the values at a cell's corners (x·4 + y·2 + z) at `t` in 0..1, and its gradient.
#[inline]
pub(crate) fn interpolate(corners: [f32; 8], t: DVec3) -> (f64, DVec3) {
    let c = corners.map(f64::from);
    let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let z: [f64; 4] = std::array::from_fn(|i| lerp(c[2 * i], c[2 * i + 1], t.z));
    let y = [lerp(z[0], z[1], t.y), lerp(z[2], z[3], t.y)];
    let dz: [f64; 4] = std::array::from_fn(|i| c[2 * i + 1] - c[2 * i]);
    let gradient = DVec3::new(
        y[1] - y[0],
        lerp(z[1] - z[0], z[3] - z[2], t.x),
        lerp(lerp(dz[0], dz[1], t.y), lerp(dz[2], dz[3], t.y), t.x),
    );
    (lerp(y[0], y[1], t.x), gradient)
}

/// The cell and the position in it; `None` where the position is not finite or too far away for an index.
fn split(ijk: DVec3) -> Option<(IVec3, DVec3)> {
    if ijk.is_nan() || ijk.abs().max_element() >= FARTHEST {
        return None;
    }
    let floor = ijk.floor();
    Some((floor.as_ivec3(), ijk - floor))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::run::RunOptions;

    fn sphere(radius: f64, half_width: f32) -> LevelSet {
        let r = radius as i32 + half_width as i32 + 2;
        let bounds = (IVec3::splat(-r), IVec3::splat(r));
        let centre = DVec3::new(0.25, -0.5, 0.125);
        LevelSet::from_distance(
            Transform::uniform(0.5),
            half_width,
            bounds,
            |p| (p - centre).length() - radius,
            &RunOptions::default(),
        )
        .unwrap()
    }

    #[test]
    fn samples_of_a_sphere() {
        let level_set = sphere(20.0, 3.0);
        let mut sampler = level_set.sampler();
        let centre = DVec3::new(0.25, -0.5, 0.125);
        for i in 0..500 {
            // Spread directions, all within a voxel of the surface, so that no sample touches the band.s rim.
            let a = f64::from(i) * 2.399963;
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 500.0;
            let n = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            let d = f64::from(i % 5) - 2.0;
            let p = centre + n * (20.0 + d * 0.45);
            // Trilinear interpolation of a distance errs by less than h²·(κ1+κ2)/8 = 0.0125 voxel here.
            assert!((f64::from(sampler.trilinear(p)) / 0.5 - d * 0.45).abs() < 0.0145, "{i}");
            let (phi, g) = sampler.value_and_gradient(p);
            assert!((phi - sampler.trilinear(p)).abs() < 1e-6);
            assert!((g - n).length() < 0.1 && (sampler.smooth_gradient(p) - n).length() < 0.02);
            let foot = sampler.closest_point(p).unwrap();
            assert!((foot - (centre + n * 20.0)).length() < 0.15 && ((foot - centre).length() - 20.0).abs() < 0.0145);
        }
        assert_eq!(sampler.trilinear(DVec3::ZERO), -1.5);
        assert_eq!(sampler.trilinear(DVec3::splat(f64::NAN)), 1.5);
        assert_eq!(sampler.trilinear(DVec3::splat(1e300)), 1.5);
        assert!(sampler.closest_point(DVec3::ZERO).is_none());
    }

    #[test]
    fn from_distance_has_exactly_the_band() {
        let level_set = sphere(20.0, 3.0);
        assert_eq!(level_set.half_width(), 3.0);
        let centre = DVec3::new(0.25, -0.5, 0.125);
        let mut accessor = level_set.grid().accessor();
        let mut active = 0;
        for x in -26..26 {
            for y in -26..26 {
                for z in -26..26 {
                    let ijk = IVec3::new(x, y, z);
                    let truth = (((ijk.as_dvec3() - centre).length() - 20.0) * 0.5) as f32;
                    assert_eq!(accessor.value(ijk), truth.clamp(-1.5, 1.5));
                    assert_eq!(accessor.is_active(ijk), truth.abs() < 1.5);
                    active += u64::from(truth.abs() < 1.5);
                }
            }
        }
        assert_eq!(level_set.grid().active_voxels(), active);
    }
}
