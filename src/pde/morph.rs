//! Morphing: a surface moves towards another one by the difference of the distances to both (Whitaker & Breen 1998;
//! OpenVDB's `LevelSetMorphing`).
//!
//! > φ_t = −F|∇φ|,  F = φ − b,  b the signed distance to the target
//!
//! On the surface F = −b: it moves outwards where it lies inside the target, inwards where it lies outside, and rests where it
//! lies on it; it comes near the target as e^(−t). Off the surface, φ − b changes little along normals where the two surfaces are
//! nearly parallel, so that φ stays a distance; −b alone would bunch its level sets up. b is ±background outside the target's
//! band: what is farther than that moves at the speed of its background. A part of the target that the surface does not overlap is not
//! reached, a part of the surface that the target does not overlap vanishes.
//!
//! |∇φ| is Godunov's, upwind for the sign of F. The step is that of the CFL condition, c·h / (√3 max|F|); F is that of the beginning of a step
//! in all stages of the time integrator. So a step dt leaves (1 − dt) of the way, and dt is at most 1: a longer one, which the CFL condition
//! allows near the target, would go beyond it.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask, mask32x16};

use super::evolve::{Motion, Report, Until, drive};
use super::step::{LeafKernel, Target};
use super::tracker::Tracker;
use super::{SolverOptions, TimeIntegrator};
use crate::error::Result;
use crate::grid::{Grid, LeafId, LeafMask, LeafValues, PageLeaves, Paged, offset_to_local};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch};
use crate::stencil::upwind::{UpwindScheme, WenoEpsilon, godunov_first, godunov_weno5};
use crate::stencil::{FaceHalo, LeafHalo, StarHalo};

/// The product that approximates F|∇φ|.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MorphSpeed {
    /// F|∇φ| with the upwind |∇φ| for the sign of F.
    #[default]
    Upwind,
    /// F|∇φ|² with the |∇φ|² of renormalisation, upwind for the sign of φ: what OpenVDB's `LevelSetMorphing` computes. The same
    /// on a distance field; the side that lies downwind is kept stable by the tracker. For comparisons.
    OpenVdb,
}

/// How a morph is solved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MorphOptions {
    /// One-sided differences of |∇φ|.
    pub scheme: UpwindScheme,
    /// Time integration.
    pub integrator: TimeIntegrator,
    /// How F|∇φ| is approximated.
    pub speed: MorphSpeed,
    /// How the band is kept on the surface after each step; its ε serves the differences of |∇φ| as well.
    pub tracker: SolverOptions,
}

impl MorphOptions {
    /// The cheapest: first-order differences, Euler steps, one normalisation a step.
    pub const FIRST_ORDER: Self = Self {
        scheme: UpwindScheme::First,
        integrator: TimeIntegrator::TvdRk1,
        speed: MorphSpeed::Upwind,
        tracker: SolverOptions::FIRST_ORDER,
    };

    /// What OpenVDB's `LevelSetMorphing` does unless told otherwise.
    pub const OPENVDB: Self = Self {
        scheme: UpwindScheme::HjWeno5,
        integrator: TimeIntegrator::TvdRk2,
        speed: MorphSpeed::OpenVdb,
        tracker: SolverOptions::OPENVDB,
    };
}

impl Default for MorphOptions {
    /// HJ-WENO5, RK2, three normalisations a step.
    fn default() -> Self {
        Self {
            speed: MorphSpeed::Upwind,
            tracker: SolverOptions { weno_epsilon: WenoEpsilon::SCALE_FREE, ..SolverOptions::OPENVDB },
            ..Self::OPENVDB
        }
    }
}

/// Moves a level set towards `target`, everywhere or weighted by a region, and tracks the band after each step. The time unit is that in
/// which the distance to the target falls to 1/e. A target on another lattice is interpolated linearly.
pub fn morph_towards(
    level_set: &mut LevelSet,
    target: &LevelSet,
    region: Option<&dyn Region>,
    until: Until,
    options: &MorphOptions,
    run: &RunOptions,
) -> Result<Report> {
    let aligned = level_set.transform() == target.transform();
    let mut tracker = Tracker::new(level_set, region, options.tracker, run);
    drive(&mut tracker, &mut Morph { target, aligned, options, speed: Paged::default() }, until)
}

/// The longest step: with the speed that it begins with, it ends on the target.
const LONGEST_STEP: f64 = 1.0;

/// Below this part of a voxel a unit of time, nothing moves.
const AT_REST: f32 = 1e-6;

struct Morph<'a> {
    target: &'a LevelSet,
    /// Whether both lie on one lattice.
    aligned: bool,
    options: &'a MorphOptions,
    /// F of the step.
    speed: Paged<LeafValues>,
}

impl Motion for Morph<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        let pages = tracker.grid().value_pages().page_count();
        self.speed.truncate(pages);
        // Rows are written before they are read.
        self.speed.grow_unwritten(pages);
        let (target, aligned) = (self.target, self.aligned);
        let fastest = self.speed.par_update_pages(tracker.domain.leaves(), |leaves, speed| {
            let mut fastest = 0.0;
            if aligned {
                dispatch(Difference { tracker, target: target.grid(), leaves, speed, fastest: &mut fastest });
            } else {
                fastest = difference_between_lattices(tracker, target, leaves, speed);
            }
            fastest
        });
        let fastest = fastest.into_iter().fold(0.0, f32::max);
        // The steps of OpenVDB's LevelSetMorphing.
        let courant = match self.options.integrator {
            TimeIntegrator::TvdRk1 => 0.3,
            TimeIntegrator::TvdRk2 => 0.9,
            TimeIntegrator::TvdRk3 => 1.0,
        };
        let voxel_size = tracker.voxel_size();
        let largest = courant / 3f64.sqrt() * f64::from(voxel_size) / f64::from(fastest);
        (fastest > AT_REST * voxel_size).then_some(largest.min(LONGEST_STEP).min(left))
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        let MorphOptions { scheme, integrator, speed: form, tracker: solver } = *self.options;
        let step = MorphStep { speed: &self.speed, form, dt: dt as f32, voxel_size: tracker.voxel_size() };
        match scheme {
            UpwindScheme::First => tracker.integrate(&FirstOrder(step), integrator, Target::Moving),
            UpwindScheme::HjWeno5 => tracker.integrate(&Weno5(step, solver.weno_epsilon), integrator, Target::Moving),
        }
    }
}

/// φ − b on the leaves of one page, and the largest |φ − b| of the voxels that move.
struct Difference<'a> {
    tracker: &'a Tracker<'a>,
    target: &'a Grid,
    leaves: PageLeaves,
    speed: &'a mut [LeafValues],
    fastest: &'a mut f32,
}

impl Work for Difference<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (grid, zero) = (self.tracker.grid(), Lanes::splat(simd, 0.0));
        let mut fastest = zero;
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let speed = &mut self.speed[PageLeaves::slot(id)];
                let (phi, target) = (grid.values(id), self.target.values(self.target.find(grid.origin(id))));
                self.tracker.domain.moving(id, grid.mask(id)).for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let (phi, target) = (&phi.0[at..at + 16], &target.0[at..at + 16]);
                        let difference = Lanes::from_slice(simd, phi) - Lanes::from_slice(simd, target);
                        difference.store_slice(&mut speed.0[at..at + 16]);
                        let moving = mask32x16::from_bitmask(simd, u64::from(bits));
                        fastest = fastest.max(moving.select(difference.abs(), zero));
                    },
                );
            },
        );
        let mut lanes = [0.0; 16];
        fastest.store_slice(&mut lanes);
        *self.fastest = lanes.into_iter().fold(0.0, f32::max);
    }
}

/// As [`Difference`], for a target on another lattice.
fn difference_between_lattices(
    tracker: &Tracker,
    target: &LevelSet,
    leaves: PageLeaves,
    speed: &mut [LeafValues],
) -> f32 {
    let grid = tracker.grid();
    let mut sampler = target.sampler();
    let mut fastest = 0f32;
    leaves.for_each(|id| {
        let speed = &mut speed[PageLeaves::slot(id)];
        for offset in tracker.domain.moving(id, grid.mask(id)).iter() {
            let xyz = tracker.transform.voxel_to_world(grid.origin(id) + offset_to_local(offset));
            let difference = grid.values(id).0[offset] - sampler.trilinear(target.transform().world_to_index(xyz));
            speed.0[offset] = difference;
            fastest = fastest.max(difference.abs());
        }
    });
    fastest
}

/// φ − dt·F|∇φ| for a given F; what both schemes share.
#[derive(Clone, Copy)]
pub(super) struct MorphStep<'a> {
    /// F of every voxel that moves.
    pub speed: &'a Paged<LeafValues>,
    /// The product.
    pub form: MorphSpeed,
    /// Time step.
    pub dt: f32,
    /// Edge of a voxel.
    pub voxel_size: f32,
}

impl MorphStep<'_> {
    /// F of rows (x, y) and (x, y + 1).
    #[inline(always)]
    fn speed<S: Simd>(&self, simd: S, id: LeafId, x: usize, y: usize) -> Lanes<S> {
        Lanes::from_slice(simd, &self.speed.get(id).0[x * 64 + y * 8..][..16])
    }

    /// The field whose sign says which way is upwind.
    #[inline(always)]
    fn direction<S: Simd>(&self, phi: Lanes<S>, speed: Lanes<S>) -> Lanes<S> {
        match self.form {
            MorphSpeed::Upwind => speed,
            MorphSpeed::OpenVdb => phi,
        }
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, phi: Lanes<S>, speed: Lanes<S>, norm2: Lanes<S>) -> Lanes<S> {
        let norm = match self.form {
            MorphSpeed::Upwind => norm2.sqrt() * (1.0 / self.voxel_size),
            MorphSpeed::OpenVdb => norm2 * (1.0 / (self.voxel_size * self.voxel_size)),
        };
        phi - speed * self.dt * norm
    }
}

pub(super) struct FirstOrder<'a>(pub MorphStep<'a>);

impl LeafKernel for FirstOrder<'_> {
    const REACH: usize = FaceHalo::REACH;

    type Scratch = FaceHalo;

    fn scratch(&self) -> FaceHalo {
        FaceHalo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: LeafMask,
        halo: &mut FaceHalo,
        out: &mut LeafValues,
    ) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let (phi, speed) = (halo.centre(simd, x, y), self.0.speed(simd, id, x, y));
                let norm2 = godunov_first(simd, halo, x, y, self.0.direction(phi, speed));
                self.0.euler(phi, speed, norm2).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

struct Weno5<'a>(MorphStep<'a>, WenoEpsilon);

impl LeafKernel for Weno5<'_> {
    const REACH: usize = <StarHalo as LeafHalo>::REACH;

    type Scratch = StarHalo;

    fn scratch(&self) -> StarHalo {
        StarHalo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: LeafMask,
        halo: &mut StarHalo,
        out: &mut LeafValues,
    ) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        rows.for_each_pair(
            #[inline(always)]
            |x, y, bits| {
                let at = x * 64 + y * 8;
                let (phi, speed) = (halo.centre(simd, x, y), self.0.speed(simd, id, x, y));
                let direction = self.0.direction(phi, speed);
                let norm2 = godunov_weno5(simd, halo, x, y, bits, direction, self.0.voxel_size, self.1);
                self.0.euler(phi, speed, norm2).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::grid::Transform;
    use crate::levelset::testing::{ball, sampled};
    use crate::region::{Primitive, Shape};
    use glam::DMat3;

    const UPWIND: [UpwindScheme; 2] = [UpwindScheme::First, UpwindScheme::HjWeno5];

    fn morph(from: &LevelSet, to: &LevelSet, until: Until, options: &MorphOptions) -> (LevelSet, Report) {
        let mut moved = from.clone();
        let report = morph_towards(&mut moved, to, None, until, options, &RunOptions::default()).unwrap();
        assert_eq!(moved.check(), []);
        (moved, report)
    }

    /// Mean, least and largest distance of the surface from the origin, along spread directions.
    fn radii(level_set: &LevelSet, guess: f64) -> (f64, f64, f64) {
        let mut sampler = level_set.sampler();
        let (mut sum, mut least, mut most) = (0.0, f64::INFINITY, 0.0f64);
        for i in 0..300 {
            let (a, z) = (f64::from(i) * 2.399963, 1.0 - (f64::from(i) + 0.5) / 150.0);
            let n = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            let r = guess - f64::from(sampler.trilinear(n * guess));
            (sum, least, most) = (sum + r, least.min(r), most.max(r));
        }
        (sum / 300.0, least, most)
    }

    #[test]
    fn concentric_spheres_approach_exponentially() {
        // R(t) = R₁ + (R₀ − R₁)e^(−t), with F held for each step of c/(√3 |R₁ − R|): a step takes its part of what is left.
        let held = |mut left: f64, courant: f64| {
            let mut time = 1.0f64;
            while time > 0.0 {
                let dt = time.min(courant / 3f64.sqrt() / left.abs()).min(1.0);
                (left, time) = (left * (1.0 - dt), time - dt);
            }
            left
        };
        let (small, large) = (ball(DVec3::ZERO, 12.0), ball(DVec3::ZERO, 14.0));
        for (from, to, r0, r1) in [(&small, &large, 12.0, 14.0), (&large, &small, 14.0, 12.0)] {
            for (integrator, courant) in
                [(TimeIntegrator::TvdRk1, 0.3), (TimeIntegrator::TvdRk2, 0.9), (TimeIntegrator::TvdRk3, 1.0)]
            {
                let options = MorphOptions { integrator, ..MorphOptions::default() };
                let (moved, report) = morph(from, to, Until::Time(1.0), &options);
                assert_eq!(report.stopped, crate::pde::StopReason::Time);
                assert!((report.time - 1.0).abs() < 1e-12 && report.steps >= 2);
                let expected = r1 + held(r0 - r1, courant);
                let (mean, least, most) = radii(&moved, expected);
                // Linear interpolation, with which radii are measured, errs by h²/(4R) = 0.02 voxel.
                assert!((mean - expected).abs() < 0.05 && most - least < 0.06, "{integrator:?} {mean} {least} {most}");
            }
            // First order loses 0.05 voxel for each voxel of the way (measured: 0.2 of 8), and more at each normalisation.
            let (moved, _) = morph(from, to, Until::Time(1.0), &MorphOptions::FIRST_ORDER);
            let expected = r1 + held(r0 - r1, 0.3);
            let (mean, ..) = radii(&moved, expected);
            assert!((mean - expected).abs() < 0.4, "{mean} {expected}");
            let (arrived, _) = morph(from, to, Until::Time(8.0), &MorphOptions::default());
            let (mean, least, most) = radii(&arrived, r1);
            assert!((mean - r1).abs() < 0.04 && most - least < 0.06, "{mean} {least} {most}");
        }
    }

    #[test]
    fn far_targets_are_approached_at_the_speed_of_the_band() {
        // Farther than the band, b = −3 and F = 3 + φ: the surface moves 3 voxels a unit of time, the level sets outside it faster,
        // and renormalisation keeps what that does to the surface to a few hundredths of the way.
        let (from, to) = (ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 20.0));
        for scheme in UPWIND {
            let options = MorphOptions { scheme, ..MorphOptions::default() };
            let (moved, _) = morph(&from, &to, Until::Time(2.0), &options);
            let (mean, least, most) = radii(&moved, 14.0);
            let tolerance = if scheme == UpwindScheme::First { 0.8 } else { 0.3 };
            assert!((mean - 14.0).abs() < tolerance && most - least < tolerance, "{scheme:?} {mean} {least} {most}");
        }
    }

    #[test]
    fn a_surface_on_its_target_rests() {
        let from = ball(DVec3::ZERO, 10.0);
        let (same, report) = morph(&from, &from, Until::Time(5.0), &MorphOptions::default());
        assert_eq!((report.steps, report.stopped), (0, crate::pde::StopReason::AtRest));
        assert!(same.grid().active_voxels() == from.grid().active_voxels());
    }

    #[test]
    fn openvdb_s_form_differs_little_from_the_upwind_one() {
        let (from, to) = (ball(DVec3::ZERO, 12.0), ball(DVec3::ZERO, 13.0));
        let (a, _) = morph(&from, &to, Until::Time(1.0), &MorphOptions::OPENVDB);
        let (b, _) = morph(&from, &to, Until::Time(1.0), &MorphOptions::default());
        assert!((radii(&a, 12.63).0 - radii(&b, 12.63).0).abs() < 0.02);
    }

    #[test]
    fn targets_on_other_lattices_and_regions() {
        let from = ball(DVec3::ZERO, 12.0);
        let to = LevelSet::from_distance(
            Transform::uniform(0.8),
            4.0,
            (glam::IVec3::splat(-24), glam::IVec3::splat(24)),
            |p| p.length() - 14.0 / 0.8,
            &RunOptions::default(),
        )
        .unwrap();
        let (moved, _) = morph(&from, &to, Until::Time(8.0), &MorphOptions::default());
        // Linear interpolation of b and of the result errs by up to h²/(4R) each.
        let mean = radii(&moved, 14.0).0;
        assert!((mean - 14.0).abs() < 0.06, "{mean}");

        let aligned = sampled(20, |p| p.length() - 13.0);
        // The weight falls over 8 voxels, by less than 0.25 from one to the next, while the surface rises by 1: no step is left.
        let sphere = Shape::Sphere { radius: 10.0 };
        let region = Primitive::new(sphere, DVec3::X * 12.0, DMat3::IDENTITY, [0.2, 1.0]).unwrap();
        let mut part = from.clone();
        let options = MorphOptions::default();
        morph_towards(&mut part, &aligned, Some(&region), Until::Time(3.0), &options, &RunOptions::default()).unwrap();
        assert_eq!(part.check(), []);
        let mut sampler = part.sampler();
        assert!(sampler.trilinear(DVec3::X * 12.5) < 0.0 && sampler.trilinear(DVec3::NEG_X * 12.0).abs() < 0.02);
    }

    #[test]
    fn numbers_of_threads_and_instruction_sets_change_no_bit() {
        use crate::stencil::simd::{Isa, choose};
        let (from, to) = (ball(DVec3::ZERO, 12.0), ball(DVec3::new(2.0, 1.0, 0.0), 13.0));
        let run = |isa, threads: usize| {
            choose(isa);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| morph(&from, &to, Until::Time(0.5), &MorphOptions::default()).0)
        };
        let first = run(Isa::Portable, 1);
        for (isa, threads) in [(Isa::Avx2, 2), (Isa::Avx512, 3)] {
            let other = run(isa, threads);
            assert!(first.grid().leaves().len() == other.grid().leaves().len());
            for (&a, &b) in first.grid().leaves().iter().zip(other.grid().leaves()) {
                assert!(
                    first.grid().values(a) == other.grid().values(b) && first.grid().mask(a) == other.grid().mask(b)
                );
            }
        }
        choose(Isa::detect());
    }
}
