//! Sharpening: curvature flow run backwards, F = +C(γ)·k (Museth et al. 2002, equation 9), kept bearable.

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};

use super::curvature_flow::upwind_gradient;
use super::evolve::{Motion, Until, drive};
use super::step::{LeafKernel, Target};
use super::{CurvatureFlow, Report, SolverOptions, TimeIntegrator, Tracker};
use crate::error::Result;
use crate::grid::{Grid, LeafId, LeafMask, LeafValues, PageLeaves, Paged};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;
use crate::stencil::normals::curvatures;
use crate::stencil::simd::{Lanes, Work, dispatch};
use crate::stencil::{FaceHalo, Halo};

/// Moves a surface against its curvature flow, at most `reach` (world units) from where it is, everywhere or weighted by a region.
pub fn sharpen(
    level_set: &mut LevelSet,
    flow: &CurvatureFlow,
    reach: f64,
    region: Option<&dyn Region>,
    until: Until,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    let start = level_set.clone();
    let bytes = start.grid().leaves().len() as u64 * size_of::<LeafValues>() as u64;
    run.reserve("sharpen", 2 * bytes, "a region or a coarser grid needs less")?;
    let mut tracker = Tracker::new(level_set, region, *solver, run);
    let mut motion = Sharpening { flow, start: start.grid(), reach: reach as f32, curvature: Paged::default() };
    drive(&mut tracker, &mut motion, until)
}

/// In place of a curvature that is not known.
const UNKNOWN: f32 = f32::INFINITY;

struct Sharpening<'a> {
    flow: &'a CurvatureFlow,
    start: &'a Grid,
    reach: f32,
    /// k at the active voxels of the domain's leaves, in 1/world; `UNKNOWN` elsewhere.
    curvature: Paged<LeafValues>,
}

impl Motion for Sharpening<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        let pages = tracker.grid().value_pages().page_count();
        self.curvature.truncate(pages);
        self.curvature.grow(pages, LeafValues::filled(UNKNOWN));
        let flow = *self.flow;
        self.curvature.par_update_pages(tracker.domain.leaves(), |leaves, curvature| {
            if !tracker.run.is_cancelled() {
                dispatch(FindCurvature { tracker, flow, leaves, curvature });
            }
        });
        let voxel_size = f64::from(tracker.voxel_size());
        let largest = voxel_size * voxel_size / 6.0;
        Some(if left.is_infinite() { largest } else { left / (left / largest - 1e-9).ceil().max(1.0) })
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        let Self { flow, start, reach, ref curvature } = *self;
        let kernel = Sharpen { flow, start, reach, curvature, dt: dt as f32, voxel_size: tracker.voxel_size() };
        tracker.integrate(&kernel, TimeIntegrator::TvdRk1, Target::Moving)
    }
}

/// k on the leaves of one page.
struct FindCurvature<'a> {
    tracker: &'a Tracker<'a>,
    flow: CurvatureFlow,
    leaves: PageLeaves,
    curvature: &'a mut [LeafValues],
}

impl Work for FindCurvature<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (grid, voxel_size) = (self.tracker.grid(), self.tracker.voxel_size());
        let mut halo = Halo::new();
        let (background, unknown) = (Lanes::splat(simd, grid.background()), Lanes::splat(simd, UNKNOWN));
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let out = &mut self.curvature[PageLeaves::slot(id)];
                *out = LeafValues::filled(UNKNOWN);
                halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
                grid.mask(id).for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let all = curvatures(simd, &halo, x, y, voxel_size);
                        let (k, _) = self.flow.curvature.of(simd, &all, voxel_size);
                        let active = mask32x16::from_bitmask(simd, u64::from(bits));
                        let known = active & all.reach.simd_lt(background);
                        known.select(k, unknown).store_slice(&mut out.0[at..at + 16]);
                    },
                );
            },
        );
    }
}

struct Sharpen<'a> {
    flow: &'a CurvatureFlow,
    start: &'a Grid,
    reach: f32,
    curvature: &'a Paged<LeafValues>,
    dt: f32,
    voxel_size: f32,
}

impl LeafKernel for Sharpen<'_> {
    const REACH: usize = 1;

    type Scratch = (FaceHalo, Halo);

    fn scratch(&self) -> Self::Scratch {
        Default::default()
    }

    #[inline(always)]
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: LeafMask,
        (phi, curvature): &mut Self::Scratch,
        out: &mut LeafValues,
    ) {
        let around = &grid.neighbours()[id.index()];
        phi.gather(grid.value_pages(), around);
        curvature.gather(self.curvature, around);
        let start = self.start.values(self.start.find(grid.origin(id)));
        let (dt, voxel_size, reach) = (self.dt, self.voxel_size, self.reach);
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let k = if experiment().0 == 1 {
                    binomial_mean(simd, curvature, x, y)
                } else {
                    let v = curvature.rows(simd, x, y, [0, 0, 0]);
                    v.simd_lt(f32::MAX).select(v, Lanes::splat(simd, 0.0))
                };
                let gamma = k.abs() * voxel_size;
                let speed = self.flow.direction.constrain(simd, k * self.flow.cut_off.weights(simd, gamma));
                let rate = speed * upwind_gradient(simd, phi, x, y, speed, voxel_size);
                let start = Lanes::from_slice(simd, &start.0[at..at + 16]);
                let moved = phi.centre(simd, x, y) - rate * dt;
                moved.max(start - reach).min(start + reach).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

/// The 3×3×3 binomial mean of what is known.
#[inline(always)]
fn binomial_mean<S: Simd>(simd: S, halo: &Halo, x: usize, y: usize) -> Lanes<S> {
    let zero = Lanes::splat(simd, 0.0);
    let (mut sum, mut weights) = (zero, zero);
    for dx in -1..=1isize {
        for dy in -1..=1isize {
            for dz in -1..=1isize {
                let weight =
                    Lanes::splat(simd, f32::from(8u8 >> (dx.unsigned_abs() + dy.unsigned_abs() + dz.unsigned_abs())));
                let value = halo.rows(simd, x, y, [dx, dy, dz]);
                let known = value.simd_lt(f32::MAX);
                sum += known.select(value * weight, zero);
                weights += known.select(weight, zero);
            }
        }
    }
    sum / weights.max(Lanes::splat(simd, 1.0))
}

#[cfg(test)]
pub static EXPERIMENT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(1);
fn experiment() -> (u32,) {
    #[cfg(test)]
    return (EXPERIMENT.load(std::sync::atomic::Ordering::Relaxed),);
    #[cfg(not(test))]
    (1,)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::levelset::testing::sampled;
    use crate::pde::{CutOff, FlowCurvature, UpwindScheme};
    use crate::stencil::{Cube, SlabScratch, box_mean};

    struct Unsharp<'a> {
        flow: &'a CurvatureFlow,
        start: &'a Grid,
        reach: f32,
        dt: f32,
        width: usize,
        background: f32,
    }
    impl LeafKernel for Unsharp<'_> {
        const REACH: usize = 1;
        type Scratch = (Cube, SlabScratch, FaceHalo);
        fn scratch(&self) -> Self::Scratch {
            (Cube::new(self.width), SlabScratch::new(self.width), FaceHalo::default())
        }
        #[inline(always)]
        fn euler<S: Simd>(
            &self,
            simd: S,
            grid: &Grid,
            id: LeafId,
            rows: LeafMask,
            (cube, scratch, phi): &mut Self::Scratch,
            out: &mut LeafValues,
        ) {
            let around = &grid.neighbours()[id.index()];
            cube.gather(grid.value_pages(), around, rows);
            phi.gather(grid.value_pages(), around);
            box_mean(simd, cube, self.background, rows, scratch, out);
            let start = self.start.values(self.start.find(grid.origin(id)));
            let w = self.width as f32;
            let variance = w * (w + 1.0) / 3.0;
            rows.for_each_pair(|x, y, _| {
                let at = x * 64 + y * 8;
                let k = (Lanes::from_slice(simd, &out.0[at..at + 16]) - phi.centre(simd, x, y)) * (1.0 / variance);
                let speed = k * self.flow.cut_off.weights(simd, k.abs());
                let rate = speed * upwind_gradient(simd, phi, x, y, speed, 1.0);
                let start = Lanes::from_slice(simd, &start.0[at..at + 16]);
                let moved = phi.centre(simd, x, y) - rate * self.dt;
                moved.max(start - self.reach).min(start + self.reach).store_slice(&mut out.0[at..at + 16]);
            });
        }
    }
    struct UnsharpMotion<'a> {
        flow: &'a CurvatureFlow,
        start: &'a Grid,
        reach: f32,
        width: usize,
        background: f32,
    }
    impl Motion for UnsharpMotion<'_> {
        fn prepare(&mut self, _: &Tracker, _: f64) -> Option<f64> {
            Some(1.0 / 6.0)
        }
        fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
            let k = Unsharp {
                flow: self.flow,
                start: self.start,
                reach: self.reach,
                dt: dt as f32,
                width: self.width,
                background: self.background,
            };
            tracker.integrate(&k, TimeIntegrator::TvdRk1, Target::Moving)
        }
    }

    fn directions() -> impl Iterator<Item = DVec3> {
        (0..20000).map(|i| {
            let (a, z) = (f64::from(i) * 2.399963, 1.0 - (f64::from(i) + 0.5) / 10000.0);
            DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z)
        })
    }
    fn bumps(n: DVec3) -> f64 {
        (6.0 * n.y.atan2(n.x)).cos() * (1.0 - n.z * n.z).powi(3)
    }
    /// bump amplitude, noise rms (least squares on [1, bumps, bumps²]), radius range
    fn analyse(l: &LevelSet) -> (f64, f64, f64, f64) {
        let mut s = l.sampler();
        let rs: Vec<(f64, f64)> = directions()
            .map(|n| {
                let mut r = 16.0;
                for _ in 0..20 {
                    r -= f64::from(s.trilinear(n * r));
                }
                (r, bumps(n))
            })
            .collect();
        let n = rs.len() as f64;
        let (mr, mb) = (rs.iter().map(|v| v.0).sum::<f64>() / n, rs.iter().map(|v| v.1).sum::<f64>() / n);
        let sbb: f64 = rs.iter().map(|v| (v.1 - mb).powi(2)).sum();
        let srb: f64 = rs.iter().map(|v| (v.1 - mb) * (v.0 - mr)).sum();
        let a = srb / sbb;
        let res = (rs.iter().map(|v| (v.0 - mr - a * (v.1 - mb)).powi(2)).sum::<f64>() / n).sqrt();
        (a, res, rs.iter().map(|v| v.0).fold(f64::INFINITY, f64::min), rs.iter().map(|v| v.0).fold(0.0, f64::max))
    }

    #[test]
    fn experiment_sharpen() {
        let noise = |p: DVec3, amp: f64| {
            let q = p.floor().as_ivec3();
            let mut h = (q.x as u64) << 40 ^ (q.y as u64 & 0xfffff) << 20 ^ (q.z as u64 & 0xfffff);
            for f in [0xbf58_476d_1ce4_e5b9u64, 0x94d0_49bb_1331_11eb] {
                h = (h ^ h >> 30).wrapping_add(0x9e37_79b9_7f4a_7c15).wrapping_mul(f);
            }
            ((h >> 40) as f64 / 8388608.0 - 1.0) * amp
        };
        let run = RunOptions::default();
        let solver = SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };
        for amp in [0.0, 0.05] {
            let mut l = sampled(24, move |p| p.length() - 16.0 - 0.5 * bumps(p.normalize_or_zero()) + noise(p, amp));
            crate::pde::track(&mut l, &solver, &run).unwrap();
            println!("noise {amp}: start {:?}", analyse(&l));
            for (name, cut) in [
                ("high .15 .25", CutOff::NONE.with_high([0.15, 0.25]).unwrap()),
                (
                    "low .01 .013 high .8 .9",
                    CutOff::NONE.with_low([0.01, 0.013]).unwrap().with_high([0.8, 0.9]).unwrap(),
                ),
            ] {
                let flow = CurvatureFlow { cut_off: cut, curvature: FlowCurvature::Mean, ..CurvatureFlow::MEAN };
                for (variant, what) in [(0, "raw"), (1, "binomial"), (11, "unsharp 1"), (12, "unsharp 2")] {
                    for reach in [1.0, 10.0] {
                        print!("{name} {what} reach {reach}:");
                        let mut m = l.clone();
                        for _ in 0..4 {
                            if variant < 10 {
                                EXPERIMENT.store(variant, std::sync::atomic::Ordering::Relaxed);
                                let start = l.clone();
                                let mut t = Tracker::new(&mut m, None, solver, &run);
                                let mut mo = Sharpening {
                                    flow: &flow,
                                    start: start.grid(),
                                    reach: reach as f32,
                                    curvature: Paged::default(),
                                };
                                drive(&mut t, &mut mo, Until::Iterations(10)).unwrap();
                            } else {
                                let mut t = Tracker::new(&mut m, None, solver, &run);
                                let mut mo = UnsharpMotion {
                                    flow: &flow,
                                    start: l.grid(),
                                    reach: reach as f32,
                                    width: (variant - 10) as usize,
                                    background: 3.0,
                                };
                                drive(&mut t, &mut mo, Until::Iterations(10)).unwrap();
                            }
                            let (a, r, lo, hi) = analyse(&m);
                            print!(" [bump {a:.3} noise {r:.4} {lo:.1}..{hi:.1} {}]", m.measure(&run).unwrap().euler);
                        }
                        println!();
                    }
                }
            }
        }
    }
}
