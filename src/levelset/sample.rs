//! φ, its gradient and the closest surface point at any position.
//!
//! | interpolation | voxels | largest error of φ, an axis | error of the gradient |
//! |---|---|---|---|
//! | trilinear | 8 | h²/8 times the second derivative | first order |
//! | triquadratic | 27 | 0.064 h³ times the third derivative | second order |
//!
//! Both have the values of the voxels there and are continuous; their gradients jump between cells. Where the stencil leaves
//! the band both read ±background.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::LevelSet;
use crate::grid::{Accessor, Grid};

/// Largest index-space coordinate at which a sample is looked up; beyond it everything is outside.
const FARTHEST: f64 = (crate::grid::MAX_COORD - 2) as f64;

/// How values between voxels are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Interpolation {
    /// From the 8 voxels around a position: second order.
    #[default]
    Trilinear,
    /// From 27 voxels: third order.
    Triquadratic,
}

impl LevelSet {
    /// φ at many index-space positions, in their order, computed in parallel. Fastest where neighbours in the list are
    /// neighbours in space.
    pub fn sample(&self, positions: &[DVec3], interpolation: Interpolation) -> Vec<f32> {
        // Long enough for the remembered leaf to pay.
        let chunks = positions.par_chunks(1024).map(|chunk| {
            let mut sampler = self.sampler();
            let at = |p: &DVec3| match interpolation {
                Interpolation::Trilinear => sampler.trilinear(*p),
                Interpolation::Triquadratic => sampler.triquadratic(*p),
            };
            chunk.iter().map(at).collect::<Vec<_>>()
        });
        chunks.collect::<Vec<_>>().concat()
    }
}

/// Reads φ between voxels. Positions are in index space; values are in world units. Remembers the last leaf.
pub struct Sampler<'a> {
    accessor: Accessor<'a>,
    voxel_size: f64,
    background: f32,
}

impl<'a> Sampler<'a> {
    /// A sampler of a field of distances whose voxels have this size.
    pub(crate) fn new(grid: &'a Grid, voxel_size: f64) -> Self {
        Self { accessor: grid.accessor(), voxel_size, background: grid.background() }
    }

    /// Edge of a voxel in world units.
    pub(super) fn voxel_size(&self) -> f64 {
        self.voxel_size
    }

    /// Value of a voxel.
    pub fn voxel(&mut self, ijk: IVec3) -> f32 {
        self.accessor.value(ijk)
    }

    /// Trilinear interpolation of φ at an index-space position; exact on linear fields.
    #[inline]
    pub fn trilinear(&mut self, ijk: DVec3) -> f32 {
        let Some((cell, t)) = split(ijk) else { return self.background };
        let c = self.accessor.cell(cell).map(f64::from);
        let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let z: [f64; 4] = std::array::from_fn(|i| lerp(c[2 * i], c[2 * i + 1], t.z));
        lerp(lerp(z[0], z[1], t.y), lerp(z[2], z[3], t.y), t.x) as f32
    }

    /// φ (world units) and the gradient of its trilinear interpolant (dimensionless, index axes: a unit vector on a distance field).
    #[inline]
    pub fn value_and_gradient(&mut self, ijk: DVec3) -> (f32, DVec3) {
        let Some((cell, t)) = split(ijk) else { return (self.background, DVec3::ZERO) };
        let (phi, gradient) = interpolate(self.accessor.cell(cell), t);
        (phi as f32, gradient / self.voxel_size)
    }

    /// Triquadratic interpolation of φ at an index-space position; exact on quadratic fields.
    ///
    /// Along each axis the parabola through the voxels −1, 0 and 1 of the one below the position, OpenVDB's
    /// `QuadraticSampler`: for u = x − ⌊x⌋,
    ///
    /// > p(u) = v₀ + u (v₁ − v₋₁)/2 + u² (v₁ − 2v₀ + v₋₁)/2,
    ///
    /// which is v₀ at 0 and v₁ at 1, so neighbouring cells meet. The stencil looks back and not ahead: the mirror image of
    /// a field is sampled as the mirror image only within the error of the table above.
    #[inline]
    pub fn triquadratic(&mut self, ijk: DVec3) -> f32 {
        let Some((cell, t)) = split(ijk) else { return self.background };
        interpolate_quadratic(self.accessor.block(cell), t).0 as f32
    }

    /// φ (world units) and the gradient of its triquadratic interpolant (dimensionless, index axes).
    #[inline]
    pub fn triquadratic_gradient(&mut self, ijk: DVec3) -> (f32, DVec3) {
        let Some((cell, t)) = split(ijk) else { return (self.background, DVec3::ZERO) };
        let (phi, gradient) = interpolate_quadratic(self.accessor.block(cell), t);
        (phi as f32, gradient / self.voxel_size)
    }

    /// Central-difference gradient at an index-space position, of the trilinear interpolant with a step of one voxel:
    /// smoother than [`value_and_gradient`](Self::value_and_gradient), whose gradient jumps between cells. Index axes, dimensionless.
    pub fn smooth_gradient(&mut self, ijk: DVec3) -> DVec3 {
        let mut along = |axis: DVec3| f64::from(self.trilinear(ijk + axis)) - f64::from(self.trilinear(ijk - axis));
        DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z)) / (2.0 * self.voxel_size)
    }

    /// Gradient of a voxel by central differences. Index axes, dimensionless.
    pub fn voxel_gradient(&mut self, ijk: IVec3) -> DVec3 {
        let mut along =
            |axis: IVec3| f64::from(self.accessor.value(ijk + axis)) - f64::from(self.accessor.value(ijk - axis));
        DVec3::new(along(IVec3::X), along(IVec3::Y), along(IVec3::Z)) / (2.0 * self.voxel_size)
    }

    /// The surface point closest to an index-space position within the band, by Newton's iteration
    /// x ← x − φ ∇φ/|∇φ|²; `None` where the field has no gradient or the iteration leaves the band.
    /// On a distance field two or three steps reach the accuracy of the interpolation.
    pub fn closest_point(&mut self, ijk: DVec3) -> Option<DVec3> {
        let voxel_size = self.voxel_size;
        let half_width = f64::from(self.background) / voxel_size;
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
            if (x - ijk).length() > 2.0 * half_width + 1.0 {
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

/// The parabola through v₋₁, v₀, v₁ at u, and its derivative.
#[inline(always)]
fn parabola([before, v, after]: [f64; 3], u: f64) -> (f64, f64) {
    let (slope, bend) = ((after - before) * 0.5, (after + before) * 0.5 - v);
    (v + u * (slope + u * bend), slope + 2.0 * u * bend)
}

/// The triquadratic interpolant of the 27 values around a voxel (x·9 + y·3 + z from −1 on) at `t` in 0..1 from it, and its gradient.
#[inline]
fn interpolate_quadratic(block: [f32; 27], t: DVec3) -> (f64, DVec3) {
    let (mut along_y, mut along_y_dy, mut along_y_dz) = ([0.0; 3], [0.0; 3], [0.0; 3]);
    for (x, slab) in block.chunks_exact(9).enumerate() {
        let (mut along_z, mut along_z_dz) = ([0.0; 3], [0.0; 3]);
        for (y, row) in slab.chunks_exact(3).enumerate() {
            (along_z[y], along_z_dz[y]) = parabola([row[0], row[1], row[2]].map(f64::from), t.z);
        }
        (along_y[x], along_y_dy[x]) = parabola(along_z, t.y);
        along_y_dz[x] = parabola(along_z_dz, t.y).0;
    }
    let (value, dx) = parabola(along_y, t.x);
    (value, DVec3::new(dx, parabola(along_y_dy, t.x).0, parabola(along_y_dz, t.x).0))
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
    fn orders_of_convergence_on_an_analytic_field() {
        // Distances to a sphere of R voxels; its second derivatives are up to 2/R in all, its third ones up to 1.2/R² along an axis.
        let errors = |radius: f64| {
            let level_set = sphere(radius, 5.0);
            let mut sampler = level_set.sampler();
            let centre = DVec3::new(0.25, -0.5, 0.125);
            let mut worst = [0.0f64; 4];
            for i in 0..4000 {
                let a = f64::from(i) * 2.399963;
                let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 4000.0;
                let n = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
                let d = (f64::from(i % 7) - 3.0) * 0.3;
                let p = centre + n * (radius + d);
                let (linear, linear_gradient) = sampler.value_and_gradient(p);
                let (quadratic, gradient) = sampler.triquadratic_gradient(p);
                assert_eq!(quadratic, sampler.triquadratic(p));
                let error = |phi: f32| (f64::from(phi) / 0.5 - d).abs();
                let found = [error(linear), error(quadratic), (linear_gradient - n).length(), (gradient - n).length()];
                worst = std::array::from_fn(|k| worst[k].max(found[k]));
            }
            worst
        };
        let (coarse, fine) = (errors(10.0), errors(20.0));
        // Per halving of h, in voxels: trilinear 2 (4 in world units), triquadratic 4 (8); gradients 2 and 4.
        for (k, factor) in [(0, 2.0), (1, 4.0), (2, 2.0), (3, 4.0)] {
            let found = coarse[k] / fine[k];
            assert!(found > factor * 0.8 && found < factor * 1.3, "{k}: {coarse:?} {fine:?}");
        }
        assert!(coarse[1] < 3.0 * 0.064 * 1.2 / 100.0 * 1.3 && coarse[1] < coarse[0] / 5.0, "{coarse:?}");
    }

    #[test]
    fn triquadratic_is_exact_on_quadratic_fields_and_continuous() {
        let field = |p: DVec3| 1.0 + p.x * p.y * 0.25 - p.z * p.z * 0.5 + p.x * 0.75 - p.y * p.y * p.z * 0.125;
        let block = std::array::from_fn(|q| {
            field(DVec3::new((q / 9) as f64 - 1.0, (q / 3 % 3) as f64 - 1.0, (q % 3) as f64 - 1.0)) as f32
        });
        for t in [DVec3::ZERO, DVec3::new(0.3, 0.9, 0.5), DVec3::ONE] {
            let (value, gradient) = interpolate_quadratic(block, t);
            let exact = DVec3::new(t.y * 0.25 + 0.75, t.x * 0.25 - t.y * t.z * 0.25, -t.z - t.y * t.y * 0.125);
            assert!((value - field(t)).abs() < 1e-12 && (gradient - exact).length() < 1e-12);
        }
        // Across the faces of cells, inside a leaf and between leaves.
        let level_set = sphere(20.0, 3.0);
        let mut sampler = level_set.sampler();
        for x in -21..21 {
            let p = DVec3::new(f64::from(x), 3.4, 2.6);
            let (below, above) = (sampler.triquadratic(p - DVec3::X * 1e-9), sampler.triquadratic(p));
            assert!((below - above).abs() < 1e-6, "{x}");
        }
        let positions: Vec<_> = (0..3000).map(|i| DVec3::new(f64::from(i) * 0.013 - 20.0, 1.3, 0.2)).collect();
        let many = level_set.sample(&positions, Interpolation::Triquadratic);
        assert!(many.iter().zip(&positions).all(|(v, p)| *v == sampler.triquadratic(*p)));
        assert_eq!(level_set.sample(&[DVec3::splat(f64::NAN)], Interpolation::Trilinear), [1.5]);
        assert_eq!(sampler.triquadratic(DVec3::splat(1e300)), 1.5);
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
