//! Analytic solids as level sets; every one a true distance.
//!
//! Spheres, boxes, tori, cylinders and capsules are sampled from their closed-form distance. A superellipsoid or supertoroid
//! is sampled as an implicit function and its distance rebuilt from the zero set (Barr 1981). So are expressions: unions,
//! intersections and differences, sharp or with rounded edges ([`expression`](crate::levelset::expression)), whose minima and maxima are
//! distances on one side only. The polygons of the zero set cut up to half a voxel off a sharp edge.

use std::path::Path;

use glam::{BVec3, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::{WorldLength, voxel_size};
use super::registry::{Arity, Operator, Outcome, Summary};
use crate::error::{EditError, Result};
use crate::grid::{MAX_COORD, Transform};
use crate::levelset::expression::Expression;
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet};
use crate::mesh::{BezierPatches, MeshToLevelSet, Rebuild, mesh_to_level_set, rebuild, shell};
use crate::run::RunOptions;
use crate::spec::Spec;

/// Make a level set of an analytic solid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Shape {
    /// The solid, such as `torus major=1 minor=0.3 axis=z` (world units). Kinds: `sphere`, `box`, `torus`, `cylinder`, `capsule`,
    /// `superellipsoid`, `supertoroid`, and `bezier file=F [thickness=t]` for the patches of a BPT file, or the Bézier and NURBS surfaces of an OBJ file. Solids combine:
    /// `union(A, B, …)`, `intersection(A, B, …)`, `difference(A, B, …)`, and `smooth-union(radius=r, A, B, …)` and its like with rounded edges.
    pub spec: String,
    /// Edge of a voxel in world units.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voxel_size: Option<WorldLength>,
    /// Voxels along the longest edge of the solid's box, instead of a voxel size; 256 if neither is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resolution: Option<u32>,
    /// Half width of the band in voxels.
    pub half_width: f32,
}

impl Default for Shape {
    fn default() -> Self {
        Self { spec: String::new(), voxel_size: None, resolution: None, half_width: DEFAULT_HALF_WIDTH }
    }
}

/// Voxels along the longest edge where nothing is asked for.
const DEFAULT_RESOLUTION: u32 = 256;

/// What is made: a solid with a formula, or the surface of a file of patches.
enum Source {
    Solid(Expression),
    Patches { patches: BezierPatches, thickness: Option<f64> },
}

impl Source {
    fn parse(text: &str) -> Result<Self> {
        if text.split_whitespace().next() != Some("bezier") {
            return Expression::parse(text).map(Self::Solid);
        }
        let spec = Spec::parse("shape", text)?;
        let file = spec.text("file").ok_or_else(|| {
            spec.refuse("`bezier` needs `file=` (a BPT file of patches, or an OBJ file of free-form surfaces)")
        })?;
        let thickness = spec.number("thickness")?;
        spec.finish()?;
        if thickness.is_some_and(|t| t <= 0.0) {
            return Err(spec.refuse("`thickness` positive, or none for the inside of a closed surface"));
        }
        let file = Path::new(file);
        let is_obj = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("obj"));
        let patches = if is_obj { BezierPatches::read_obj(file)? } else { BezierPatches::read(file)? };
        Ok(Self::Patches { patches, thickness })
    }

    fn bounds(&self) -> Result<(DVec3, DVec3)> {
        match self {
            Self::Solid(solid) => solid.bounds().ok_or_else(|| {
                let accepted = "parts that overlap: nothing is inside of all of them";
                EditError::parameter(Shape::NAME, "spec", "intersection", accepted)
            }),
            Self::Patches { patches, thickness } => {
                let ((lo, hi), margin) = (patches.bounds(), thickness.unwrap_or(0.0) / 2.0);
                Ok((lo - margin, hi + margin))
            }
        }
    }
}

impl Shape {
    fn resolved_voxel_size(&self, source: &Source) -> Result<f64> {
        if let Some(size) = self.voxel_size {
            return voxel_size(Self::NAME, size);
        }
        let (lo, hi) = source.bounds()?;
        Ok((hi - lo).max_element() / f64::from(self.resolution.unwrap_or(DEFAULT_RESOLUTION)))
    }
}

impl Operator for Shape {
    const NAME: &'static str = "shape";
    const ARITY: Arity = Arity::Source;

    fn validate(&self) -> Result<()> {
        let source = Source::parse(&self.spec)?;
        if let (Some(size), Some(_)) = (self.voxel_size, self.resolution) {
            return Err(EditError::parameter(
                Self::NAME,
                "voxel_size",
                size,
                "either `voxel_size` or `resolution`, not both",
            ));
        }
        if self.resolution == Some(0) {
            return Err(EditError::parameter(Self::NAME, "resolution", 0, "1 voxel or more"));
        }
        let size = self.resolved_voxel_size(&source)?;
        MeshToLevelSet { half_width: self.half_width, ..MeshToLevelSet::new(size) }.validate()?;
        let (lo, hi) = source.bounds()?;
        let farthest = lo.abs().max(hi.abs()).max_element() / size + f64::from(self.half_width) + 2.0;
        if farthest > f64::from(MAX_COORD) {
            return Err(EditError::parameter(
                Self::NAME,
                "voxel_size",
                size,
                format!("a solid within {MAX_COORD} voxels of the origin"),
            ));
        }
        Ok(())
    }

    fn apply(&self, _: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        self.validate()?;
        let source = Source::parse(&self.spec)?;
        let size = self.resolved_voxel_size(&source)?;
        let solid = match source {
            Source::Solid(solid) => solid,
            Source::Patches { patches, thickness } => return self.of_patches(&patches, thickness, size, run),
        };
        Ok(sampled(&solid, &Transform::uniform(size), self.half_width, run)?.into())
    }
}

/// A solid on a lattice.
pub(super) fn sampled(
    solid: &Expression,
    transform: &Transform,
    half_width: f32,
    run: &RunOptions,
) -> Result<LevelSet> {
    let Some((lo, hi)) = solid.bounds() else { return Ok(LevelSet::empty(*transform, half_width)) };
    let corners = (0..8).map(|c| DVec3::select(BVec3::new(c & 4 != 0, c & 2 != 0, c & 1 != 0), hi, lo));
    let corners = corners.map(|corner| transform.world_to_index(corner));
    let (lo, hi) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), c| (lo.min(c), hi.max(c)));
    let margin = f64::from(half_width) + 2.0;
    let bounds = ((lo - margin).floor().as_ivec3(), (hi + margin).ceil().as_ivec3());
    let size = transform.voxel_size();
    let sample = |half_width: f32| {
        let distance = |ijk| solid.value(transform.index_to_world(ijk)) / size;
        LevelSet::from_distance(*transform, half_width, bounds, distance, run)
    };
    if solid.is_distance() {
        return sample(half_width);
    }
    // The implicit function is only about a distance: sampled in a band wide enough for its zero set, then made exact.
    rebuild(&sample(SAMPLED_BAND)?, &Rebuild::band(half_width), run)
}

impl Shape {
    /// The inside of a surface of patches, or the shell around it.
    fn of_patches(
        &self,
        patches: &BezierPatches,
        thickness: Option<f64>,
        size: f64,
        run: &RunOptions,
    ) -> Result<Outcome> {
        let mesh = patches.tessellate(PATCH_TOLERANCE * size, run)?;
        let params = MeshToLevelSet { half_width: self.half_width, ..MeshToLevelSet::new(size) };
        if let Some(thickness) = thickness {
            let level_set = shell(&mesh, thickness, &params, run)?;
            let mut summary = Summary::default();
            if thickness < THINNEST_SHELL * size {
                summary.warnings.push(format!(
                    "a shell of {:.1} voxels may have holes: take a voxel size of {:e} or less",
                    thickness / size,
                    thickness / THINNEST_SHELL
                ));
            }
            return Ok(Outcome { level_set, summary });
        }
        let (level_set, findings) = mesh_to_level_set(&mesh, &params, run)?;
        Ok(Outcome { level_set, summary: Summary { warnings: findings.warnings(), ..Summary::default() } })
    }
}

/// Distance, in voxels, within which patches are made triangles: a fifth of what polygons of a level set may be off by at an edge.
const PATCH_TOLERANCE: f64 = 0.1;

/// Voxels of thickness from which on a sheet in any position has whole voxels inside everywhere: the diagonal of a cell (√3),
/// and room for the slope of the field on either side.
const THINNEST_SHELL: f64 = 3.0;

/// Band of an implicit function whose slope at the surface is between a third and three.
const SAMPLED_BAND: f32 = 8.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn make(spec: &str, voxel_size: f64) -> LevelSet {
        let shape = Shape { spec: spec.into(), voxel_size: Some(WorldLength::new(voxel_size)), ..Shape::default() };
        shape.apply(Vec::new(), &RunOptions::default()).unwrap().level_set
    }

    #[test]
    fn volumes_are_those_of_the_formulas() {
        use std::f64::consts::PI;
        for (spec, volume) in [
            ("sphere radius=1 center=0.1,0.2,0.3", 4.0 / 3.0 * PI),
            ("box size=1,2,1.5", 3.0),
            ("torus major=1 minor=0.3", 2.0 * PI * PI * 0.09),
            ("cylinder radius=0.5 height=2 axis=y", PI * 0.5),
            ("capsule a=0,0,0 b=0,1,0 radius=0.4", 4.0 / 3.0 * PI * 0.064 + PI * 0.16),
            ("superellipsoid radii=1,0.8,0.6", 4.0 / 3.0 * PI * 0.48),
            ("supertoroid radii=0.3,0.3,0.3 alpha=3.3333333333", 2.0 * PI * PI * 0.09),
        ] {
            let level_set = make(spec, 0.02);
            assert!(level_set.check().is_empty(), "{spec}: {:?}", level_set.check());
            let measured = level_set.measure(&RunOptions::default()).unwrap();
            assert!((measured.volume / volume - 1.0).abs() < 2e-3, "{spec}: {} {volume}", measured.volume);
            assert_eq!((measured.components, measured.euler), (1, if spec.contains("tor") { 0 } else { 2 }), "{spec}");
        }
    }

    #[test]
    fn patches_become_shells_and_solids() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("one patch.bpt");
        std::fs::write(&file, "1\n1 1\n0 0 0\n0 2 0\n3 0 0\n3 2 0\n").unwrap();
        let plate = make(&format!("bezier file=\"{}\" thickness=0.4", file.display()), 0.05);
        assert!(plate.check().is_empty(), "{:?}", plate.check());
        // A rectangle of 2 x 3 with a rounded border: area times thickness, half a cylinder along the border, a ball at the corners.
        let r = 0.2f64;
        let volume = 6.0 * 0.4 + std::f64::consts::PI * r * r * 5.0 + 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
        let measured = plate.measure(&RunOptions::default()).unwrap();
        assert!((measured.volume / volume - 1.0).abs() < 5e-3, "{} {volume}", measured.volume);
        let open = Shape { spec: format!("bezier file=\"{}\"", file.display()), ..Shape::default() };
        assert!(open.apply(Vec::new(), &RunOptions::default()).is_err(), "a sheet encloses nothing");
        let missing = Shape { spec: "bezier file=nowhere.bpt".into(), ..Shape::default() };
        assert_eq!(missing.validate().unwrap_err().exit_code(), 3);
    }

    #[test]
    fn superquadrics_are_distances() {
        // A sphere and a torus written as superquadrics, against their exact distances.
        for (spec, exact) in [
            ("superellipsoid radii=0.5,0.5,0.5", "sphere radius=0.5"),
            ("supertoroid radii=0.25,0.25,0.25 alpha=2", "torus major=0.5 minor=0.25"),
        ] {
            let (ours, truth) = (make(spec, 0.02), Expression::parse(exact).unwrap());
            for &id in ours.grid().leaves() {
                for at in ours.grid().mask(id).iter() {
                    let p = ours.transform().voxel_to_world(ours.grid().origin(id) + crate::grid::offset_to_local(at));
                    let error = (f64::from(ours.grid().values(id).0[at]) - truth.value(p)).abs() / 0.02;
                    // h²κ/4 with κ = 1/12.5 voxel: 0.02; the implicit function is not linear along the edges, which adds as much.
                    assert!(error < 0.045, "{spec}: {error}");
                }
            }
        }
    }

    #[test]
    fn refuses_what_cannot_work() {
        let bad = |f: fn(&mut Shape)| {
            let mut shape = Shape { spec: "sphere radius=1".into(), ..Shape::default() };
            f(&mut shape);
            shape.validate().is_err()
        };
        assert!(!bad(|_| ()));
        assert!(
            bad(|s| s.voxel_size = Some(WorldLength::new(0.0)))
                && bad(|s| s.voxel_size = Some(WorldLength::new(-1.0)))
                && bad(|s| s.resolution = Some(0))
        );
        assert!(
            bad(|s| s.voxel_size = Some(WorldLength::new(1e-12)))
                && bad(|s| s.half_width = 0.0)
                && bad(|s| s.spec = "cube".into())
        );
    }
}
