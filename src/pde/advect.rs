//! Advection: a surface is carried along by a velocity field.
//!
//! > φ_t + V·∇φ = 0
//!
//! Differences are taken from where V comes on each axis, first order or HJ-WENO5. The step is that of the CFL condition,
//! c·h / max(|V_x| + |V_y| + |V_z|). V does not change in time; it is looked up once at each voxel of the band. Where div V = 0 the
//! volume is kept up to the error of the scheme, which smooths at first order.

use fearless_simd::{Simd, SimdBase};
use glam::DVec3;
use rayon::prelude::*;

use super::evolve::{Motion, Report, Until, drive};
use super::step::{LeafKernel, Rows, Target};
use super::tracker::Tracker;
use super::{SolverOptions, TimeIntegrator};
use crate::error::Result;
use crate::grid::{Grid, LeafId, LeafMask, LeafValues, PageLeaves, Paged, offset_to_local};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;
use crate::stencil::simd::Lanes;
use crate::stencil::upwind::{UpwindScheme, WenoEpsilon, transport_first, transport_weno5};
use crate::stencil::{FaceHalo, LeafHalo, StarHalo};

/// A velocity everywhere.
pub trait VelocityField: Sync {
    /// World units a unit of time, at a world position.
    fn velocity(&self, xyz: DVec3) -> DVec3;
}

impl<F: Fn(DVec3) -> DVec3 + Sync> VelocityField for F {
    fn velocity(&self, xyz: DVec3) -> DVec3 {
        self(xyz)
    }
}

/// Part of a voxel that anything moves in a step: half of what is stable, for accuracy.
const COURANT: f64 = 0.5;

/// Below this part of a voxel a unit of time, nothing moves.
const AT_REST: f32 = 1e-9;

/// Carries a level set along, everywhere or as strongly as a region says, and tracks the band after each step. Differences and time
/// integration are those of `solver`, as for renormalisation.
pub fn advect(
    level_set: &mut LevelSet,
    velocity: &dyn VelocityField,
    region: Option<&dyn Region>,
    until: Until,
    solver: &SolverOptions,
    run: &RunOptions,
) -> Result<Report> {
    let mut tracker =
        Tracker::new(level_set, region, SolverOptions { integrator: TimeIntegrator::TvdRk1, ..*solver }, run);
    let mut motion = Carried { velocity, solver: *solver, field: Default::default(), known: Vec::new() };
    drive(&mut tracker, &mut motion, until)
}

struct Carried<'a> {
    velocity: &'a dyn VelocityField,
    solver: SolverOptions,
    /// V of the voxels that move, by component.
    field: [Paged<LeafValues>; 3],
    /// By slot: the leaf that was there when V was looked up, and its voxels for which that was done.
    known: Vec<Option<(glam::IVec3, LeafMask)>>,
}

impl Carried<'_> {
    /// Looks V up where it is not known yet.
    fn look_up(&mut self, tracker: &Tracker) {
        let grid = tracker.grid();
        let pages = grid.value_pages().page_count();
        self.known.resize(pages * crate::grid::PAGE_LEAVES, None);
        for component in &mut self.field {
            component.truncate(pages);
            component.grow_unwritten(pages);
        }
        let known = &self.known;
        let missing = |id: LeafId| {
            let moving = tracker.domain.moving(id, grid.mask(id));
            match known[id.index()] {
                Some((origin, known)) if origin == grid.origin(id) => {
                    moving.zip(known, |moving, known| moving & !known)
                }
                _ => moving,
            }
        };
        let wanted: crate::grid::LeafSet =
            tracker.domain.leaves().iter().filter(|&id| !missing(id).is_empty()).collect();
        let [x, y, z] = &mut self.field;
        // The leaves of x tell which pages are written; the other two follow leaf by leaf.
        let found: Vec<Vec<(LeafId, [LeafValues; 2])>> = x.par_update_pages(&wanted, |leaves, page| {
            let mut rest = Vec::new();
            leaves.for_each(|id| {
                let values = &mut page[PageLeaves::slot(id)];
                let mut other = [LeafValues::default(), LeafValues::default()];
                let origin = grid.origin(id);
                for offset in missing(id).iter() {
                    let v = self.velocity.velocity(tracker.transform.voxel_to_world(origin + offset_to_local(offset)));
                    // In index axes, so that differences along them are meant.
                    let v = tracker.transform.direction_to_index(v);
                    let v = if v.is_finite() { v } else { DVec3::ZERO };
                    (values.0[offset], other[0].0[offset], other[1].0[offset]) = (v.x as f32, v.y as f32, v.z as f32);
                }
                rest.push((id, other));
            });
            rest
        });
        for (id, [second, third]) in found.into_iter().flatten() {
            let missing = missing(id);
            for offset in missing.iter() {
                y.get_mut(id).0[offset] = second.0[offset];
                z.get_mut(id).0[offset] = third.0[offset];
            }
        }
        for id in wanted.iter() {
            self.known[id.index()] = match self.known[id.index()] {
                Some((origin, known)) if origin == grid.origin(id) => {
                    Some((origin, known.zip(tracker.domain.moving(id, grid.mask(id)), |a, b| a | b)))
                }
                _ => Some((grid.origin(id), tracker.domain.moving(id, grid.mask(id)))),
            };
        }
    }
}

impl Motion for Carried<'_> {
    fn prepare(&mut self, tracker: &Tracker, left: f64) -> Option<f64> {
        self.look_up(tracker);
        let (grid, [x, y, z]) = (tracker.grid(), &self.field);
        let of_leaf = |id: LeafId| {
            let (x, y, z) = (x.get(id), y.get(id), z.get(id));
            let moving = tracker.domain.moving(id, grid.mask(id)).iter();
            moving.map(|o| x.0[o].abs() + y.0[o].abs() + z.0[o].abs()).fold(0.0, f32::max)
        };
        let of_page = |leaves: PageLeaves| leaves.iter().map(of_leaf).fold(0.0, f32::max);
        let fastest = tracker.domain.leaves().par_pages().map(of_page).reduce(|| 0.0, f32::max);
        let voxel_size = tracker.voxel_size();
        if fastest <= AT_REST * voxel_size {
            return None;
        }
        let largest = COURANT * f64::from(voxel_size) / f64::from(fastest);
        // Equal parts of the time that is left, as few as may be.
        Some(if left.is_finite() { left / (left / largest).ceil().max(1.0) } else { largest })
    }

    fn step(&mut self, tracker: &mut Tracker, dt: f64) -> Result<()> {
        let step = Transport { field: &self.field, dt: dt as f32, voxel_size: tracker.voxel_size() };
        match self.solver.scheme {
            UpwindScheme::First => tracker.integrate(&FirstOrder(step), self.solver.integrator, Target::Moving),
            UpwindScheme::HjWeno5 => {
                tracker.integrate(&Weno5(step, self.solver.weno_epsilon), self.solver.integrator, Target::Moving)
            }
        }
    }
}

/// φ − dt·V·∇φ.
#[derive(Clone, Copy)]
struct Transport<'a> {
    field: &'a [Paged<LeafValues>; 3],
    dt: f32,
    voxel_size: f32,
}

impl Transport<'_> {
    #[inline(always)]
    fn velocity<S: Simd>(&self, simd: S, id: LeafId, at: usize) -> [Lanes<S>; 3] {
        let [x, y, z] = self.field;
        let row = |field: &Paged<LeafValues>| Lanes::from_slice(simd, &field.get(id).0[at..at + 16]);
        [row(x), row(y), row(z)]
    }
}

struct FirstOrder<'a>(Transport<'a>);

impl LeafKernel for FirstOrder<'_> {
    const REACH: usize = FaceHalo::REACH;

    type Scratch = FaceHalo;

    fn scratch(&self) -> FaceHalo {
        FaceHalo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, halo: &mut FaceHalo, out: &mut LeafValues) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        let scale = self.0.dt / self.0.voxel_size;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let change = transport_first(simd, halo, x, y, self.0.velocity(simd, id, at));
                (halo.centre(simd, x, y) - change * scale).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

struct Weno5<'a>(Transport<'a>, WenoEpsilon);

impl LeafKernel for Weno5<'_> {
    const REACH: usize = <StarHalo as LeafHalo>::REACH;

    type Scratch = StarHalo;

    fn scratch(&self) -> StarHalo {
        StarHalo::new()
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, halo: &mut StarHalo, out: &mut LeafValues) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        let Transport { dt, voxel_size, .. } = self.0;
        let scale = dt / voxel_size;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let change = transport_weno5(simd, halo, x, y, self.0.velocity(simd, id, at), voxel_size, self.1);
                (halo.centre(simd, x, y) - change * scale).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::ball;
    use crate::region::{Primitive, Shape};
    use glam::DMat3;

    const SOLVER: SolverOptions = SolverOptions {
        scheme: UpwindScheme::HjWeno5,
        integrator: TimeIntegrator::TvdRk2,
        ..SolverOptions::FIRST_ORDER
    };

    fn carried(
        level_set: &LevelSet,
        velocity: &dyn VelocityField,
        region: Option<&dyn Region>,
        until: Until,
        solver: &SolverOptions,
    ) -> (LevelSet, Report) {
        let mut moved = level_set.clone();
        let report = advect(&mut moved, velocity, region, until, solver, &RunOptions::default()).unwrap();
        assert_eq!(moved.check(), []);
        (moved, report)
    }

    /// Largest error against the distance function, within a voxel of the surface.
    fn error(level_set: &LevelSet, exact: impl Fn(DVec3) -> f64) -> f64 {
        let grid = level_set.grid();
        let mut worst = 0.0f64;
        for &id in grid.leaves() {
            for offset in grid.mask(id).iter() {
                let ijk = (grid.origin(id) + offset_to_local(offset)).as_dvec3();
                let (phi, truth) = (f64::from(grid.values(id).0[offset]), exact(ijk));
                worst = worst.max(if truth.abs() < 1.0 { (phi - truth).abs() } else { 0.0 });
            }
        }
        worst
    }

    #[test]
    fn a_constant_velocity_shifts_the_solid() {
        let centre = DVec3::new(0.3, 0.1, -0.2);
        let velocity = DVec3::new(1.0, -0.5, 0.25);
        let field = move |_: DVec3| velocity;
        for (scheme, integrator, tolerance) in
            [(UpwindScheme::First, TimeIntegrator::TvdRk1, 0.16), (UpwindScheme::HjWeno5, TimeIntegrator::TvdRk2, 0.03)]
        {
            let solver = SolverOptions { scheme, integrator, ..SOLVER };
            let (moved, report) = carried(&ball(centre, 12.0), &field, None, Until::Time(5.0), &solver);
            assert!((report.time - 5.0).abs() < 1e-12);
            // First order diffuses by D = |V|(1 − c)h/2 along each axis, c = |V|dt/h (its modified equation). On a ball φ_xx = (1 − n_x²)/R, so that
            // the surface shrinks by t Σ D(1 − n²)/R: 0.24 where z is the normal. Renormalisation of first order adds up to 0.0028·20/R a step (docs/NUMERICS.md): 0.085 in 18,
            // and leaves distances that are wrong by as much again a voxel from the surface.
            let part = velocity.abs() * (5.0 / f64::from(report.steps));
            let spread = if scheme == UpwindScheme::First { velocity.abs() * (1.0 - part) / 2.0 } else { DVec3::ZERO };
            let worst = error(&moved, |p| {
                let from = p - centre - velocity * 5.0;
                let normal = from.normalize_or_zero();
                from.length() - 12.0 + 5.0 * spread.dot(1.0 - normal * normal) / 12.0
            });
            assert!(worst < tolerance, "{scheme:?} {worst}");
        }
    }

    #[test]
    fn a_flow_without_divergence_keeps_the_volume() {
        // Rotation about z, and a shear, which in 100 steps draws the ball out to twice its length.
        let run = RunOptions::default();
        // Without edges, which any scheme rounds.
        let solid = ball(DVec3::X * 8.0, 16.0);
        let before = solid.measure(&run).unwrap().volume;
        let turning = |p: DVec3| DVec3::new(-p.y, p.x, 0.0);
        let shearing = |p: DVec3| DVec3::new(p.z, 0.0, 0.0);
        for field in [&turning as &dyn VelocityField, &shearing] {
            let (moved, report) = carried(&solid, field, None, Until::Iterations(100), &SOLVER);
            assert_eq!(report.steps, 100);
            let after = moved.measure(&run).unwrap().volume;
            assert!((after / before - 1.0).abs() < 0.01, "{}", after / before);
        }
    }

    #[test]
    fn outside_the_region_every_bit_stays() {
        let before = ball(DVec3::ZERO, 15.0);
        let region =
            Primitive::new(Shape::Sphere { radius: 8.0 }, DVec3::X * 15.0, DMat3::IDENTITY, [0.3, 1.0]).unwrap();
        let (after, _) = carried(&before, &|_: DVec3| DVec3::X, Some(&region), Until::Time(2.0), &SOLVER);
        assert!(after.sampler().trilinear(DVec3::X * 16.5) < 0.0);
        for &id in before.grid().leaves() {
            for offset in before.grid().mask(id).iter() {
                let ijk = before.grid().origin(id) + offset_to_local(offset);
                if region.weight(ijk.as_dvec3()) == 0.0 {
                    assert_eq!(after.grid().voxel(ijk), before.grid().voxel(ijk));
                }
            }
        }
    }

    #[test]
    fn threads_and_instructions_do_not_change_a_bit() {
        use crate::stencil::simd::{Isa, choose};
        let solid = ball(DVec3::ZERO, 10.0);
        let on = |threads, isa| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let before = choose(isa);
            let (moved, _) = pool.install(|| {
                carried(&solid, &|p: DVec3| DVec3::new(p.y, 0.3, -p.x), None, Until::Iterations(6), &SOLVER)
            });
            choose(before);
            let grid = moved.into_grid();
            grid.leaves().iter().map(|&id| (grid.origin(id), grid.values(id).0.map(f32::to_bits))).collect::<Vec<_>>()
        };
        let expected = on(1, Isa::Portable);
        assert!(expected == on(1, Isa::Avx512) && expected == on(3, Isa::Avx2));
    }
}
