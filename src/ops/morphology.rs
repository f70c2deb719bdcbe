//! Offsets and mathematical morphology with exact distances (Museth et al. 2002, section 5.5).
//!
//! `offset` moves the surface outwards by a distance, `dilate` outwards and `erode` inwards by a positive one; `open` is
//! erode, then dilate: what is thinner than twice the distance goes; `close` is dilate, then erode: gaps narrower than
//! twice the distance are filled. Between the two the distance is rebuilt, or the second would undo the first.
//!
//! Each step is one rebuild ([`crate::mesh::rebuild`]): exact distances to the polygonised surface, at any distance,
//! no stepping; `offset --like openvdb` takes steps, to compare. Eroding everything away leaves an empty level set, which is legal.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::WorldLength;
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::{Like, evolved};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild};
use crate::pde::{self, SolverOptions};
use crate::run::RunOptions;

/// Moves the surface by `distance` (world units, positive outwards); the band keeps its half width.
pub fn offset(level_set: &LevelSet, distance: f64, run: &RunOptions) -> Result<LevelSet> {
    rebuild(level_set, &Rebuild { offset: distance, ..Rebuild::band(level_set.half_width()) }, run)
}

/// Refuses a length that cannot be moved by.
fn validate(operation: &str, distance: WorldLength, least: f64) -> Result<()> {
    let value = distance.world(1.0);
    if value.is_finite() && value >= least {
        return Ok(());
    }
    let accepted = if least == 0.0 { "a length of 0 or more, such as 0.1 or 3vx" } else { "a finite length" };
    Err(EditError::parameter(operation, "distance", distance, accepted))
}

/// Moves the surface by the distance times each of `signs` in turn.
fn moved(
    operation: &str,
    inputs: Vec<LevelSet>,
    distance: WorldLength,
    signs: &[f64],
    run: &RunOptions,
) -> Result<Outcome> {
    let mut summary = Summary::default();
    let mut result = inputs.into_iter().next().unwrap_or_else(|| unreachable!("the registry counts the inputs"));
    let length = distance.world(result.voxel_size());
    let was_empty = result.is_empty();
    for sign in signs {
        run.check(operation)?;
        result = offset(&result, sign * length, run)?;
    }
    if result.is_empty() && !was_empty {
        let warning = format!("nothing is left: every part is thinner than twice the distance {distance}");
        summary.warnings.push(warning);
    }
    Ok(Outcome { level_set: result, summary })
}

/// Move the surface by an exact distance, outwards if positive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Offset {
    /// How far the surface moves.
    pub distance: WorldLength,
    /// Move it as another tool does, to compare results one to one: `openvdb` takes steps of half a voxel and tracks the band after
    /// each, which is not exact.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub like: Option<Like>,
}

impl Default for Offset {
    /// One voxel.
    fn default() -> Self {
        Self { distance: WorldLength::voxel(), like: None }
    }
}

impl Operator for Offset {
    const NAME: &'static str = "offset";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        validate(Self::NAME, self.distance, f64::NEG_INFINITY)
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        match self.like {
            None => moved(Self::NAME, inputs, self.distance, &[1.0], run),
            Some(Like::OpenVdb) => evolved(inputs.remove(0), run, |level_set| {
                let distance = self.distance.world(level_set.voxel_size());
                pde::offset(level_set, distance, None, &SolverOptions::OPENVDB, run)
            }),
        }
    }
}

/// An operator that moves the surface by its distance times each of `signs` in turn.
macro_rules! morphology {
    ($(#[$doc:meta])* $name:ident, $text:literal, $signs:expr) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
        #[serde(default)]
        pub struct $name {
            /// How far the surface moves.
            pub distance: WorldLength,
        }

        impl Default for $name {
            /// One voxel.
            fn default() -> Self {
                Self { distance: WorldLength::voxel() }
            }
        }

        impl Operator for $name {
            const NAME: &'static str = $text;
            const ARITY: Arity = Arity::One;

            fn validate(&self) -> Result<()> {
                validate(Self::NAME, self.distance, 0.0)
            }

            fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
                moved(Self::NAME, inputs, self.distance, &$signs, run)
            }
        }
    };
}

morphology!(
    /// Move the surface outwards by an exact distance.
    Dilate,
    "dilate",
    [1.0]
);
morphology!(
    /// Move the surface inwards by an exact distance.
    Erode,
    "erode",
    [-1.0]
);
morphology!(
    /// Remove what is thinner than twice the distance: erode, then dilate.
    Open,
    "open",
    [-1.0, 1.0]
);
morphology!(
    /// Fill gaps narrower than twice the distance: dilate, then erode.
    Close,
    "close",
    [1.0, -1.0]
);

#[cfg(test)]
mod tests {
    use glam::{DVec3, IVec3};

    use super::*;
    use crate::grid::{Transform, offset_to_local};

    fn level_set(bound: i32, f: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
        let bounds = (IVec3::splat(-bound), IVec3::splat(bound));
        LevelSet::from_distance(Transform::uniform(0.5), 3.0, bounds, f, &RunOptions::default()).unwrap()
    }

    fn box_distance(p: DVec3, half: DVec3) -> f64 {
        let d = p.abs() - half;
        d.max(DVec3::ZERO).length() + d.max_element().min(0.0)
    }

    /// Largest difference to a distance function (voxels) over the band, and the active voxels that it says are none.
    fn worst(level_set: &LevelSet, truth: impl Fn(DVec3) -> f64) -> f64 {
        let grid = level_set.grid();
        let mut worst = 0f64;
        for &id in grid.leaves() {
            for at in grid.mask(id).iter() {
                let p = (grid.origin(id) + offset_to_local(at)).as_dvec3();
                worst = worst.max((f64::from(grid.values(id).0[at]) / 0.5 - truth(p)).abs());
            }
        }
        worst
    }

    #[test]
    fn spheres_move_by_any_distance() {
        let run = RunOptions::default();
        let centre = DVec3::new(0.3, 0.1, -0.2);
        let ball = level_set(30, |p| (p - centre).length() - 20.0);
        for d in [1.0, -1.0, 5.0, -6.5, 14.0, -15.0, 60.0] {
            let moved = offset(&ball, d * 0.5, &run).unwrap();
            // The middle of a cell's polygon lies up to 3/8·h²κ (half its diagonal, squared, over the diameter) inside the sphere.
            let error = worst(&moved, |p| (p - centre).length() - 20.0 - d);
            assert!(error < 0.375 / 20.0, "{d}: {error}");
            let expected = level_set(90, |p| (p - centre).length() - 20.0 - d).grid().active_voxels() as f64;
            assert!((moved.grid().active_voxels() as f64 / expected - 1.0).abs() < 0.01, "{d}");
        }
        assert!(offset(&ball, -30.0, &run).unwrap().is_empty());
    }

    #[test]
    fn opening_and_closing_of_a_box() {
        // Opening rounds the corners of a box, which retreat by (√3 − 1)·w; closing leaves it as it is.
        let run = RunOptions::default();
        let half = DVec3::splat(16.3);
        let cube = level_set(24, |p| box_distance(p, half));
        let w = 5.0;
        let apply = |o: &dyn Fn() -> Result<Outcome>| o().unwrap().level_set;
        let distance = WorldLength::new(w * 0.5);
        let opened = apply(&|| Open { distance }.apply(vec![cube.clone()], &run));
        let closed = apply(&|| Close { distance }.apply(vec![cube.clone()], &run));
        // The polygonised box loses up to half a voxel at its edges, and no more than that elsewhere.
        assert!(worst(&opened, |p| box_distance(p, half - w) - w) < 0.6);
        let s: f64 = 2.0 * (16.3 - w);
        let volume = s.powi(3)
            + 6.0 * s * s * w
            + 3.0 * std::f64::consts::PI * s * w * w
            + 4.0 / 3.0 * std::f64::consts::PI * w.powi(3);
        let measured = opened.measure(&run).unwrap().volume / 0.125;
        // The polygons cut the twelve edges of the eroded box off at up to half a voxel, and the dilation carries that outwards.
        assert!((measured / volume - 1.0).abs() < 0.015, "{measured} {volume}");
        let before = cube.measure(&run).unwrap().volume;
        assert!((closed.measure(&run).unwrap().volume / before - 1.0).abs() < 0.01);
    }

    #[test]
    fn opening_removes_thin_parts_and_closing_fills_gaps() {
        let run = RunOptions::default();
        let thin = level_set(60, |p| {
            let plate = box_distance(p, DVec3::new(12.0, 12.0, 12.0));
            plate.min(box_distance(p - DVec3::new(20.0, 0.0, 0.0), DVec3::new(20.0, 2.2, 2.2)))
        });
        let distance = "3vx".parse().unwrap();
        let opened = Open { distance }.apply(vec![thin.clone()], &run).unwrap().level_set;
        assert!(opened.grid().voxel(IVec3::new(30, 0, 0)).0 > 0.0 && opened.grid().voxel(IVec3::ZERO).0 < 0.0);
        let closed = Close { distance }.apply(vec![thin], &run).unwrap().level_set;
        assert!(closed.grid().voxel(IVec3::new(30, 0, 0)).0 < 0.0);
        let gap = level_set(40, |p| {
            box_distance(p - DVec3::new(0.0, 0.0, 12.0), DVec3::splat(10.0))
                .min(box_distance(p + DVec3::new(0.0, 0.0, 12.0), DVec3::splat(10.0)))
        });
        assert!(gap.grid().voxel(IVec3::ZERO).0 > 0.0);
        let closed = Close { distance }.apply(vec![gap], &run).unwrap().level_set;
        assert!(closed.grid().voxel(IVec3::ZERO).0 < 0.0);
    }

    #[test]
    fn negative_distances_are_for_offset_only() {
        let distance = WorldLength::new(-1.0);
        assert!(Offset { distance, like: None }.validate().is_ok());
        assert!(Dilate { distance }.validate().is_err() && Open { distance }.validate().is_err());
        assert!(Offset { distance: WorldLength::new(f64::NAN), like: None }.validate().is_err());
    }
}
