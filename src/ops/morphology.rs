//! Offsets and mathematical morphology with exact distances (Museth et al. 2002, section 5.5).
//!
//! `offset` moves the surface outwards by a distance, `dilate` outwards and `erode` inwards by a positive one; `open` is
//! erode, then dilate: what is thinner than twice the distance goes; `close` is dilate, then erode: gaps narrower than
//! twice the distance are filled. Between the two the distance is rebuilt, or the second would undo the first.
//!
//! Each step is one rebuild ([`crate::mesh::rebuild`]): exact distances to the polygonised surface, at any distance, and to
//! its sharp edges, up to 64 voxels; no stepping; `offset --like openvdb` takes steps, to compare. Eroding everything away leaves an empty level set, which is legal.
//!
//! An opening never adds and a closing never removes, φ_open ≥ φ ≥ φ_close: what the errors of the two steps would move to the other side stays as it was. A second
//! one should change nothing. It changes a box, a turned box and a lens by less than 0.1 voxel, but single voxels of scanned models by up to 0.9
//! (the armadillo at 128 voxels, opened by 3: 99 % by less than 0.2): the eroded surface has edges that differences of the field do not find.
//!
//! In a region the result is φ' = (1 − α) φ + α φ_new, made a distance again around it. The surface moves by α times the distance, so
//! a feathered region leaves a slope from where it begins to where it is full.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::confine::{Reach, confined};
use super::csg::{CsgOperation, csg};
use super::params::WorldLength;
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::{Like, RegionSpecs, evolved};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild};
use crate::pde::{self, SolverOptions};
use crate::run::RunOptions;

/// Moves the surface's polygons by `distance` (world units, positive outwards); the band keeps its half width.
pub fn offset(level_set: &LevelSet, distance: f64, run: &RunOptions) -> Result<LevelSet> {
    rebuild(level_set, &Rebuild { offset: distance, ..Rebuild::band(level_set.half_width()) }, run)
}

/// The same, but the field's sharp edges on the side that the surface moves to are kept, which polygons cut off, here more and there less: the rounding
/// around the edge would show that as ripples, and a second step would carry it over all of the rounding.
pub(super) fn offset_sharp(level_set: &LevelSet, distance: f64, run: &RunOptions) -> Result<LevelSet> {
    rebuild(level_set, &Rebuild { offset: distance, sharp: true, ..Rebuild::band(level_set.half_width()) }, run)
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

/// Moves the surface by the distance times a sign, then by that times another if there is one, everywhere or in a region.
fn moved(
    operation: &str,
    mut inputs: Vec<LevelSet>,
    distance: WorldLength,
    (first, second): (f64, Option<f64>),
    region: &RegionSpecs,
    run: &RunOptions,
) -> Result<Outcome> {
    let mut summary = Summary::default();
    let input = inputs.remove(0);
    let was_empty = input.is_empty();
    let length = distance.world(input.voxel_size());
    let all = |level_set: LevelSet| {
        let there = offset_sharp(&level_set, first * length, run)?;
        let Some(second) = second else { return Ok(there) };
        run.check(operation)?;
        let back = offset_sharp(&there, second * length, run)?;
        let bound = if first < 0.0 { CsgOperation::Intersection } else { CsgOperation::Union };
        csg(&back, &[&level_set], bound, run)
    };
    let result = match region.on(&input, run)? {
        None => all(input)?,
        Some(region) => {
            let moves = length.abs() / input.voxel_size();
            let reach = Reach { moves, sees: if second.is_some() { 2.0 * moves } else { moves } };
            let changed = confined(operation, &input, &*region, &reach, all, run)?;
            changed.unwrap_or_else(|| {
                if !was_empty {
                    summary.warnings.push(format!(
                        "the region touches nothing within {distance} of the surface: nothing was changed"
                    ));
                }
                input
            })
        }
    };
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
    /// Where to move it, and which part of the way; everywhere if not given.
    pub region: RegionSpecs,
}

impl Default for Offset {
    /// One voxel.
    fn default() -> Self {
        Self { distance: WorldLength::voxel(), like: None, region: RegionSpecs::default() }
    }
}

impl Operator for Offset {
    const NAME: &'static str = "offset";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        validate(Self::NAME, self.distance, f64::NEG_INFINITY)?;
        self.region.validate()
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        match self.like {
            None => moved(Self::NAME, inputs, self.distance, (1.0, None), &self.region, run),
            Some(Like::OpenVdb) => evolved(inputs.remove(0), run, |level_set| {
                let distance = self.distance.world(level_set.voxel_size());
                let region = self.region.on(level_set, run)?;
                pde::offset(level_set, distance, region.as_deref(), &SolverOptions::OPENVDB, run)
            }),
        }
    }
}

/// An operator that moves the surface by its distance times a sign, and perhaps by that times another.
macro_rules! morphology {
    ($(#[$doc:meta])* $name:ident, $text:literal, $signs:expr) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
        #[serde(default)]
        pub struct $name {
            /// How far the surface moves.
            pub distance: WorldLength,
            /// Where to act, and how strongly; everywhere if not given.
            pub region: RegionSpecs,
        }

        impl Default for $name {
            /// One voxel.
            fn default() -> Self {
                Self { distance: WorldLength::voxel(), region: RegionSpecs::default() }
            }
        }

        impl Operator for $name {
            const NAME: &'static str = $text;
            const ARITY: Arity = Arity::One;

            fn validate(&self) -> Result<()> {
                validate(Self::NAME, self.distance, 0.0)?;
                self.region.validate()
            }

            fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
                moved(Self::NAME, inputs, self.distance, $signs, &self.region, run)
            }
        }
    };
}

morphology!(
    /// Move the surface outwards by an exact distance.
    Dilate,
    "dilate",
    (1.0, None)
);
morphology!(
    /// Move the surface inwards by an exact distance.
    Erode,
    "erode",
    (-1.0, None)
);
morphology!(
    /// Remove what is thinner than twice the distance: erode, then dilate.
    Open,
    "open",
    (-1.0, Some(1.0))
);
morphology!(
    /// Fill gaps narrower than twice the distance: dilate, then erode.
    Close,
    "close",
    (1.0, Some(-1.0))
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
    fn edges_are_rounded_without_ripples() {
        // A box gets round edges and corners when it is dilated, and when the space around it is eroded: one outwards, one inwards.
        let run = RunOptions::default();
        let turn = glam::DMat3::from_axis_angle(DVec3::new(0.3, 0.5, 0.8).normalize(), 0.4);
        let (half, w) = (DVec3::new(14.3, 12.7, 13.1), 5.0);
        let distance = WorldLength::new(w * 0.5);
        let solid = |p: DVec3| box_distance(turn * p, half);
        let dilated =
            Dilate { distance, ..Dilate::default() }.apply(vec![level_set(30, solid)], &run).unwrap().level_set;
        let hollow = level_set(40, |p| box_distance(p, DVec3::splat(34.0)).max(-solid(p)));
        let eroded = Erode { distance, ..Erode::default() }.apply(vec![hollow], &run).unwrap().level_set;
        let rounded = |p: DVec3| solid(p) - w;
        // The worst is at the corners; polygons are 0.87 off there.
        let error = worst(&dilated, rounded);
        assert!(error < 0.2, "{error}");
        // Around the box alone, not at the outer faces.
        let inner = |p: DVec3| if p.abs().max_element() < 24.0 { -rounded(p) } else { f64::NAN };
        let error = worst(&eroded, inner);
        assert!(error < 0.2, "{error}");
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
        let opened = apply(&|| Open { distance, ..Open::default() }.apply(vec![cube.clone()], &run));
        let closed = apply(&|| Close { distance, ..Close::default() }.apply(vec![cube.clone()], &run));
        // Of the eroded box, the sharp edges are kept.
        let error = worst(&opened, |p| box_distance(p, half - w) - w);
        assert!(error < 0.02, "{error}");
        let s: f64 = 2.0 * (16.3 - w);
        let volume = s.powi(3)
            + 6.0 * s * s * w
            + 3.0 * std::f64::consts::PI * s * w * w
            + 4.0 / 3.0 * std::f64::consts::PI * w.powi(3);
        let measured = opened.measure(&run).unwrap().volume / 0.125;
        // A corner retreats by (√3 − 1) w along its diagonal, 3.660 voxels.
        let corner = half.length() - (3f64.sqrt() - 1.0) * w;
        let at_corner = f64::from(opened.sampler().trilinear(DVec3::ONE.normalize() * corner)) / 0.5;
        assert!(at_corner.abs() < 0.05, "{at_corner}");
        // The volume is that of its polygons, which lie up to 3/8·h²/w inside the rounded edges and corners.
        assert!((measured / volume - 1.0).abs() < 0.003, "{measured} {volume}");
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
        let opened = Open { distance, ..Open::default() }.apply(vec![thin.clone()], &run).unwrap().level_set;
        assert!(opened.grid().voxel(IVec3::new(30, 0, 0)).0 > 0.0 && opened.grid().voxel(IVec3::ZERO).0 < 0.0);
        let closed = Close { distance, ..Close::default() }.apply(vec![thin], &run).unwrap().level_set;
        assert!(closed.grid().voxel(IVec3::new(30, 0, 0)).0 < 0.0);
        // What stays of the bar is the cap of a ball that leans out of its root: to 12 − √(3² − 2.2²) + 3.
        let tip = 15.0 - (9.0f64 - 2.2 * 2.2).sqrt();
        let at_tip = f64::from(opened.sampler().trilinear(DVec3::new(tip, 0.0, 0.0))) / 0.5;
        assert!(at_tip.abs() < 0.05, "{at_tip}");
        let gap = level_set(40, |p| {
            box_distance(p - DVec3::new(0.0, 0.0, 12.0), DVec3::splat(10.0))
                .min(box_distance(p + DVec3::new(0.0, 0.0, 12.0), DVec3::splat(10.0)))
        });
        let opened = Open { distance, ..Open::default() }.apply(vec![gap.clone()], &run).unwrap().level_set;
        assert!((opened.grid().voxel(IVec3::ZERO).0 / 0.5 - 2.0).abs() < 0.1, "opening leaves the gap of 4");
        let closed = Close { distance, ..Close::default() }.apply(vec![gap], &run).unwrap().level_set;
        assert!(closed.grid().voxel(IVec3::ZERO).0 < 0.0);
        // Around the waist the ball of 3 that touches both edges sinks in by 3 − √(3² − 2²).
        let waist = 7.0 + 5f64.sqrt();
        let at_waist = f64::from(closed.sampler().trilinear(DVec3::new(waist, 0.0, 0.0))) / 0.5;
        assert!(at_waist.abs() < 0.05, "{at_waist}");
    }

    /// Morphology in a region: name, parameters and what it should do to the far half of a body.
    fn in_region(input: &LevelSet, name: &str, distance: &str, region: &str) -> Outcome {
        let values = serde_json::json!({ "distance": distance, "region": region });
        let values = values.as_object().unwrap().clone();
        super::super::find(name).unwrap().run(values, vec![input.clone()], &RunOptions::default()).unwrap()
    }

    /// Voxels that were active with weight 0 keep their bits; returns how many voxels changed.
    fn assert_kept(before: &LevelSet, after: &LevelSet, region: &str) -> u64 {
        let run = RunOptions::default();
        let region = RegionSpecs(vec![region.into()]).on(before, &run).unwrap().unwrap();
        let (mut kept, mut changed) = (0, 0);
        for &id in before.grid().leaves() {
            for at in before.grid().mask(id).iter() {
                let ijk = before.grid().origin(id) + offset_to_local(at);
                let (value, active) = after.grid().voxel(ijk);
                let same = active && value.to_bits() == before.grid().values(id).0[at].to_bits();
                if region.weight(before.transform().voxel_to_world(ijk)) == 0.0 {
                    assert!(same, "{ijk}");
                    kept += 1;
                } else {
                    changed += u64::from(!same);
                }
            }
        }
        assert!(kept > 1000);
        changed
    }

    #[test]
    fn in_a_region_the_surface_moves_by_alpha_times_the_distance() {
        // A slab whose upper face is the plane z = 2 (voxels), dilated by 6 under a feathered ball.
        let plate = level_set(44, |p| box_distance(p, DVec3::new(36.0, 36.0, 8.0)));
        let region = "sphere center=0,0,4 radius=14 soft=0.25,1";
        let outcome = in_region(&plate, "dilate", "6vx", region);
        assert!(assert_kept(&plate, &outcome.level_set, region) > 1000);
        assert!(outcome.level_set.check().is_empty(), "{:?}", outcome.level_set.check());
        // Along the axis: full weight within a quarter of the radius, so the surface is at 8 + 6; the height over a point of the plane
        // solves z − 8 = 6 α(x, z).
        let mut sampler = outcome.level_set.sampler();
        let sphere = RegionSpecs(vec![region.into()]).on(&plate, &RunOptions::default()).unwrap().unwrap();
        for x in [0.0, 4.0, 8.0, 12.0, 16.0, 20.0] {
            let alpha = |z: f64| f64::from(sphere.weight(DVec3::new(x, 0.0, z) * 0.5));
            let (mut lo, mut hi) = (8.0f64, 14.5);
            for _ in 0..40 {
                let z = (lo + hi) / 2.0;
                if z - 8.0 < 6.0 * alpha(z) { lo = z } else { hi = z }
            }
            let phi = f64::from(sampler.trilinear(DVec3::new(x, 0.0, lo))) / 0.5;
            assert!(phi.abs() < 0.1, "{x}: {phi} at {lo}");
        }
        assert_eq!(outcome.level_set.measure(&RunOptions::default()).unwrap().euler, 2);
    }

    #[test]
    fn a_steep_region_on_a_large_offset_is_a_valid_surface() {
        let ball = level_set(30, |p| (p - DVec3::new(0.3, 0.1, -0.2)).length() - 20.0);
        for (name, distance) in [("dilate", "12vx"), ("erode", "9vx"), ("open", "6vx"), ("close", "12vx")] {
            for region in
                ["box center=10,0,0 size=10,8,8 soft=1,1", "box center=10,0,0 size=10,8,8", "halfspace normal=1,1,0"]
            {
                let outcome = in_region(&ball, name, distance, region);
                assert_kept(&ball, &outcome.level_set, region);
                let found = outcome.level_set.check();
                assert!(found.is_empty(), "{name} {region}: {found:?}");
                let measured = outcome.level_set.measure(&RunOptions::default()).unwrap();
                let before = ball.measure(&RunOptions::default()).unwrap();
                match name {
                    "dilate" => assert!(measured.volume > 1.05 * before.volume, "{region} {}", measured.volume),
                    "erode" => assert!(measured.volume < 0.97 * before.volume, "{region} {}", measured.volume),
                    // A ball is its own opening and closing, within 0.05 voxel.
                    _ => assert!((measured.volume / before.volume - 1.0).abs() < 3.0 * 0.05 / 20.0, "{name} {region}"),
                }
                assert_eq!((measured.components, measured.euler), (1, 2), "{name} {region}");
            }
        }
    }

    #[test]
    fn everywhere_as_a_region_is_no_region_and_nowhere_changes_nothing() {
        let run = RunOptions::default();
        let ball = level_set(30, |p| p.length() - 20.0);
        let all = in_region(&ball, "dilate", "7vx", "sphere radius=100 soft=1,1").level_set;
        let plain = Dilate { distance: "7vx".parse().unwrap(), ..Dilate::default() };
        let plain = plain.apply(vec![ball.clone()], &run).unwrap().level_set;
        assert!((all.measure(&run).unwrap().volume / plain.measure(&run).unwrap().volume - 1.0).abs() < 1e-3);
        assert!(worst(&all, |p| p.length() - 27.0) < 0.375 / 20.0 * 3.0);
        let none = in_region(&ball, "open", "2vx", "sphere center=90,0,0 radius=3");
        assert!(none.summary.warnings[0].contains("nothing was changed"), "{:?}", none.summary);
        assert_kept(&ball, &none.level_set, "sphere center=90,0,0 radius=3");
    }

    #[test]
    fn opening_shrinks_closing_grows_and_both_are_idempotent() {
        let run = RunOptions::default();
        // Two balls that overlap, and what they have in common: a concave edge for closing to fill, a convex one for opening to round.
        let balls = |p: DVec3| [(p - DVec3::X * 7.0).length() - 12.0, (p + DVec3::X * 7.0).length() - 14.0];
        let distance = "3vx".parse().unwrap();
        let [lens, both] = [f64::max, f64::min].map(|combine: fn(f64, f64) -> f64| {
            let body = level_set(30, |p| combine(balls(p)[0], balls(p)[1]));
            // Neither is a distance everywhere.
            rebuild(&body, &Rebuild::band(3.0), &run).unwrap()
        });
        // Its edges and corners lie anywhere in their cells.
        let turn = glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.4, 0.7, 0.2);
        let turned = level_set(34, |p| box_distance(turn * p, DVec3::new(16.3, 12.2, 9.7)));
        for (open, body, least) in [(true, &lens, 100), (false, &both, 100), (true, &turned, 1000), (false, &turned, 0)]
        {
            let apply = |input: &LevelSet| match open {
                true => Open { distance, ..Open::default() }.apply(vec![input.clone()], &run).unwrap().level_set,
                false => Close { distance, ..Close::default() }.apply(vec![input.clone()], &run).unwrap().level_set,
            };
            let once = apply(body);
            let twice = apply(&once);
            let sign = if open { 1.0 } else { -1.0 };
            let mut sampler = once.sampler();
            let mut moved = 0;
            for (ijk, value) in body.band_voxels() {
                // φ_open ≥ φ and φ_close ≤ φ.
                let grown = sign * (sampler.voxel(ijk) - value) / 0.5;
                assert!(grown > -1e-6, "{open} {ijk}: {grown}");
                moved += i32::from(grown > 0.3);
            }
            assert!(moved >= least, "the edge is rounded: {moved}");
            let mut again = twice.sampler();
            // Each begins at the polygons of what the other left, up to 3/8·h²/12 inside the balls and more at the rounded edge.
            let beside: Vec<_> = once.band_voxels().into_iter().filter(|(_, value)| value.abs() < 0.5).collect();
            let difference = |(ijk, value): &(IVec3, f32)| f64::from(again.voxel(*ijk) - value).abs() / 0.5;
            let most = beside.iter().map(difference).fold(0.0, f64::max);
            assert!(most < 0.1, "{open}: {most}");
        }
    }

    impl LevelSet {
        /// Active voxels with their values.
        fn band_voxels(&self) -> Vec<(IVec3, f32)> {
            let grid = self.grid();
            let voxels =
                |id| grid.mask(id).iter().map(move |at| (grid.origin(id) + offset_to_local(at), grid.values(id).0[at]));
            grid.leaves().iter().copied().flat_map(voxels).collect()
        }
    }

    #[test]
    fn negative_distances_are_for_offset_only() {
        let distance = WorldLength::new(-1.0);
        assert!(Offset { distance, ..Offset::default() }.validate().is_ok());
        assert!(
            Dilate { distance, ..Dilate::default() }.validate().is_err()
                && Open { distance, ..Open::default() }.validate().is_err()
        );
        assert!(Offset { distance: WorldLength::new(f64::NAN), ..Offset::default() }.validate().is_err());
    }
}
