//! Making φ a distance again: `rebuild` exactly from the zero set, `renormalize` by the Eikonal flow.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::WorldLength;
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::Scheme;
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{self, MeshToLevelSet};
use crate::pde::{self, SolverOptions, TimeIntegrator, UpwindScheme, WenoEpsilon};
use crate::run::RunOptions;

/// Compute exact distances again from the surface, with a band of any width.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct RebuildDistance {
    /// Half width of the band in voxels; that of the input if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub half_width: Option<f32>,
    /// The value of φ whose surface is taken: 0 is the surface itself, a positive one lies outside. Within the band.
    pub iso: WorldLength,
}

impl Operator for RebuildDistance {
    const NAME: &'static str = "rebuild";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        if let Some(half_width) = self.half_width {
            MeshToLevelSet { half_width, ..MeshToLevelSet::new(1.0) }.validate()?;
        }
        let iso = self.iso.world(1.0);
        if iso.is_finite() { Ok(()) } else { Err(EditError::parameter(Self::NAME, "iso", iso, "a finite length")) }
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let input = inputs.remove(0);
        let iso = self.iso.world(input.voxel_size()) as f32;
        let what = mesh::Rebuild { iso, ..mesh::Rebuild::band(self.half_width.unwrap_or(input.half_width())) };
        Ok(mesh::rebuild(&input, &what, run)?.into())
    }
}

/// Restore |∇φ| = 1 step by step, from the surface outwards; the band is trimmed, never widened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Renormalize {
    /// Steps; each repairs about a third of a voxel more of the band (RK1).
    pub iterations: u32,
    /// One-sided differences. First order moves the surface by about 0.04 voxel when repeated, weno5 by 0.01.
    pub scheme: Scheme,
    /// Order of the TVD Runge–Kutta integrator, 1 to 3.
    pub order: u32,
}

impl Default for Renormalize {
    fn default() -> Self {
        Self { iterations: 10, scheme: Scheme::Weno5, order: 3 }
    }
}

impl Operator for Renormalize {
    const NAME: &'static str = "renormalize";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        if !(1..=3).contains(&self.order) {
            return Err(EditError::parameter(Self::NAME, "order", self.order, "1, 2 or 3"));
        }
        Ok(())
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let mut level_set = inputs.remove(0);
        let integrator =
            [TimeIntegrator::TvdRk1, TimeIntegrator::TvdRk2, TimeIntegrator::TvdRk3][self.order as usize - 1];
        let scheme = match self.scheme {
            Scheme::First => UpwindScheme::First,
            Scheme::Weno5 => UpwindScheme::HjWeno5,
        };
        let solver = SolverOptions {
            scheme,
            integrator,
            normalizations: self.iterations,
            weno_epsilon: WenoEpsilon::SCALE_FREE,
        };
        let mut tracker = pde::Tracker::new(&mut level_set, None, solver, run);
        tracker.renormalize()?;
        // Voxels at the rim may have been found to lie beyond it.
        tracker.trim_band()?;
        Ok(Outcome { level_set, summary: Summary { steps: Some(self.iterations), ..Summary::default() } })
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, IVec3};

    use super::*;
    use crate::grid::{Transform, offset_to_local};

    /// The field x² − R² of a sphere, scaled: right zero set, wrong everywhere else.
    fn quadratic_sphere(radius: f64) -> LevelSet {
        let bounds = (IVec3::splat(-28), IVec3::splat(28));
        // Cut off where it would exceed the distance, which sampling relies on.
        let f = |p: DVec3| ((p.length_squared() - radius * radius) / (2.0 * radius) * 0.9).clamp(-4.4, 4.4);
        LevelSet::from_distance(Transform::uniform(0.1), 4.0, bounds, f, &RunOptions::default()).unwrap()
    }

    fn errors(level_set: &LevelSet, radius: f64, within: f64) -> (f64, f64) {
        let grid = level_set.grid();
        let (mut sum, mut worst, mut n) = (0.0, 0f64, 0.0);
        for &id in grid.leaves() {
            for at in grid.mask(id).iter() {
                let d = (grid.origin(id) + offset_to_local(at)).as_dvec3().length() - radius;
                if d.abs() < within {
                    let error = (f64::from(grid.values(id).0[at]) / 0.1 - d).abs();
                    (sum, worst, n) = (sum + error, worst.max(error), n + 1.0);
                }
            }
        }
        (sum / n, worst)
    }

    #[test]
    fn rebuild_is_exact_and_renormalize_approaches_it() {
        let run = RunOptions::default();
        let bad = quadratic_sphere(20.0);
        assert!(errors(&bad, 20.0, 3.0).1 > 0.3, "{:?}", errors(&bad, 20.0, 3.0));
        let rebuilt = RebuildDistance::default().apply(vec![bad.clone()], &run).unwrap().level_set;
        // Polygons of a sphere of 20 voxels: up to 3/8·h²κ = 0.019 voxel inside it; the start field adds its curvature along the edges.
        assert!(errors(&rebuilt, 20.0, 3.0).1 < 0.03, "{:?}", errors(&rebuilt, 20.0, 3.0));
        let params = Renormalize { iterations: 20, ..Renormalize::default() };
        let renormalized = params.apply(vec![bad.clone()], &run).unwrap().level_set;
        // An independent computation gives 0.015 mean and 0.052 at most for WENO5, RK3, 20 iterations.
        let (mean, worst) = errors(&renormalized, 20.0, 3.0);
        assert!(mean < 0.02 && worst < 0.08, "{mean} {worst}");
        let first = Renormalize { iterations: 20, scheme: Scheme::First, order: 1 };
        let (mean, worst) = errors(&first.apply(vec![bad], &run).unwrap().level_set, 20.0, 3.0);
        assert!(mean < 0.08 && worst < 0.15, "{mean} {worst}");
    }

    #[test]
    fn a_wider_band_and_another_iso_value() {
        let run = RunOptions::default();
        let bounds = (IVec3::splat(-28), IVec3::splat(28));
        let ball = LevelSet::from_distance(Transform::uniform(0.1), 3.0, bounds, |p| p.length() - 20.0, &run).unwrap();
        let params = RebuildDistance { half_width: Some(9.0), iso: "2vx".parse().unwrap() };
        let wide = params.apply(vec![ball.clone()], &run).unwrap().level_set;
        assert_eq!(wide.half_width(), 9.0);
        // 3/8·h²κ.
        assert!(errors(&wide, 22.0, 9.0).1 < 0.375 / 22.0);
        let outside = RebuildDistance { half_width: None, iso: WorldLength::new(0.3) };
        assert!(outside.apply(vec![ball], &run).is_err(), "an iso value at the rim of the band has no surface");
    }
}
