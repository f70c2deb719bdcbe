//! The speed that range maps give a surface.

use std::sync::atomic::{AtomicU32, Ordering};

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};
use glam::DVec3;

use super::measured::{Measured, Measurements};
use super::term::{CUT, Local, RAMP, Rays, Term, window};
use crate::grid::LeafValues;
use crate::pde::{LeafSurface, SurfaceSpeed, Tally};
use crate::stencil::simd::{Lanes, Work, dispatch, splat};

/// The data term F = −Σ V(n) c μ w(ρ) ρ with ρ = D + φ/(n·l): how far the ray through a voxel misses what was measured where it meets the
/// surface. D and c μ are looked up once a voxel and kept; ρ follows the surface, so that F is nearly the same along a normal and vanishes at rest.
pub(super) struct Forces<'a> {
    measurements: &'a Measurements<'a>,
    /// Rays of the terms in index space.
    local_rays: Vec<Rays<DVec3>>,
    /// The bits of the largest Σ V c μ w since it was last asked for.
    stiffness: AtomicU32,
}

impl<'a> Forces<'a> {
    pub fn new(measurements: &'a Measurements<'a>) -> Self {
        let transform = &measurements.transform;
        let local = |term: &Term| match term.rays {
            Rays::Parallel(ray) => Rays::Parallel(transform.direction_to_index(ray).normalize_or_zero()),
            Rays::From(scanner) => Rays::From(transform.world_to_index(scanner)),
        };
        let local_rays = measurements.terms.iter().map(local).collect();
        Self { measurements, local_rays, stiffness: AtomicU32::new(0) }
    }

    /// The largest Σ V c μ w of a voxel since the last call: what bounds the step.
    pub fn take_stiffness(&self) -> f64 {
        f32::from_bits(self.stiffness.swap(0, Ordering::Relaxed)).into()
    }
}

impl SurfaceSpeed for Forces<'_> {
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
        let mut tally = Tally::default();
        let measured = self.measurements.of(leaf.origin).filter(|measured| !measured.maps.is_empty());
        let Some(measured) = measured else {
            speed.0.fill(0.0);
            return tally;
        };
        let mut stiffest = 0.0;
        dispatch(Push { forces: self, leaf, measured: &measured, speed, stiffest: &mut stiffest });
        // Positive numbers are in the order of their bits.
        self.stiffness.fetch_max(f32::to_bits(stiffest), Ordering::Relaxed);
        for at in leaf.beside().iter() {
            tally.count += 1.0;
            tally.squares += f64::from(speed.0[at]) * f64::from(speed.0[at]);
        }
        tally
    }
}

/// F of a leaf.
struct Push<'a> {
    forces: &'a Forces<'a>,
    leaf: &'a LeafSurface<'a>,
    measured: &'a Measured,
    speed: &'a mut LeafValues,
    stiffest: &'a mut f32,
}

/// A map as the voxels of a leaf see it.
struct LocalMap {
    /// In voxels from the first one of the leaf.
    rays: Rays<[f32; 3]>,
    /// 1/s.
    per_width: f32,
    /// |ρ| from which on the window is 0, world units.
    cut: f32,
    /// Of its rows.
    units: [f32; 2],
}

impl Work for Push<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { forces: Forces { measurements, local_rays, .. }, leaf, measured, speed, stiffest } = self;
        let (zero, one, ramp) = (splat(simd, 0.0), splat(simd, 1.0), splat(simd, RAMP));
        let voxel_size = splat(simd, measurements.transform.voxel_size());
        let mut maps = Vec::with_capacity(measured.maps.len());
        for map in &measured.maps {
            let (term, rays) = (&measurements.terms[map.number as usize], &local_rays[map.number as usize]);
            let rays = match rays {
                Rays::Parallel(ray) => Rays::Parallel(ray.as_vec3().to_array()),
                Rays::From(scanner) => Rays::From((*scanner - leaf.origin.as_dvec3()).as_vec3().to_array()),
            };
            let (per_width, cut) = ((1.0 / term.width) as f32, (CUT * term.width) as f32);
            maps.push(LocalMap { rays, per_width, cut, units: map.units });
        }
        let local = Local::new(simd);
        let mut most = zero;
        leaf.moving().for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let p = local.rows(simd, at);
                macro_rules! normal {
                    ($axis:literal) => {
                        Lanes::from_slice(simd, &leaf.normals()[$axis].0[at..at + 16])
                    };
                }
                let n = [normal!(0), normal!(1), normal!(2)];
                let depth = Lanes::from_slice(simd, &leaf.depths().0[at..at + 16]) * voxel_size;
                // How far from a voxel its ray meets the surface at most.
                let farthest = depth.abs() * splat(simd, 1.0 / RAMP);
                let (mut force, mut stiffness) = (zero, zero);
                for (head, row) in measured.pair(at / 16) {
                    let map = &maps[head.map as usize];
                    if farthest.simd_gt(head.nearest - map.cut).to_bitmask() == 0 {
                        continue;
                    }
                    // −n·l times a length, and the square of that length.
                    let (facing, squared) = match map.rays {
                        Rays::Parallel([x, y, z]) => (-(n[0] * x + n[1] * y + n[2] * z), one),
                        Rays::From([x, y, z]) => {
                            let [x, y, z] = [p[0] - x, p[1] - y, p[2] - z];
                            (-(n[0] * x + n[1] * y + n[2] * z), x * x + y * y + z * z)
                        }
                    };
                    if facing.simd_gt(zero).to_bitmask() == 0 {
                        continue;
                    }
                    let length = squared.max(Lanes::splat(simd, f32::MIN_POSITIVE)).sqrt();
                    let distance = Lanes::from_slice(simd, &row.distance.map(f32::from)) * map.units[0];
                    let weight = Lanes::from_slice(simd, &row.weight.map(f32::from)) * map.units[1];
                    // V is −n·l over RAMP, but at most 1: it has this denominator as well.
                    let per = one / facing.max(length * ramp);
                    let miss = distance - depth * length * per;
                    let weight = weight * window(simd, miss * map.per_width) * (facing * per);
                    let counts = weight.simd_gt(zero);
                    force -= counts.select(weight * miss, zero);
                    stiffness += counts.select(weight, zero);
                }
                force.store_slice(&mut speed.0[at..at + 16]);
                most = most.max(stiffness);
            },
        );
        *stiffest = (0..16).map(|k| most[k]).fold(0.0, f32::max);
    }
}
