//! Embossing and engraving: a surface is drawn to points, curves, meshes or solids, or stamped with text, drawings and pictures.
//!
//! *Attraction* is a flow (Museth et al. 2002, equation 10; [`crate::pde::attract`]): F = α·D(x)·C(sign(φ(p)) n·u)·φ(p) with p the
//! closest point of the target; it stops by itself when every point that draws is within a quarter of a voxel. Curves, meshes and solids draw by their
//! closest point, without sampling.
//!
//! *Stamps* do not flow: a layer of exact height over the outline, laid on the surface by the exponential map around a point, is united with the solid or
//! cut out of it (`stamp`). Their edges are as sharp as the voxels allow, which a flow's are not.

mod outline;
mod patch;
mod picture;
mod stamp;
mod targets;

use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use self::outline::Drawing;
use self::patch::Patch;
pub(in crate::ops) use self::patch::Patch as Flat;
use self::picture::Picture;
use self::stamp::{Motif, Stamp};
pub(super) use self::targets::read_polylines;
use self::targets::{Elements, Solid, Surface};
use super::confine::{cut_out, put_back};
use super::params::{Vector, VoxelLength, WorldLength};
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::{EvolutionOptions, evolved};
use crate::error::{EditError, Result};
use crate::grid::LEAF_DIM;
use crate::levelset::LevelSet;
use crate::mesh::Bvh;
use crate::pde::{
    Attraction, AttractionReport, Attractor, CutOff, Pull, REACHED, Report, SolverOptions, StopReason, attract,
    leaves_around,
};
use crate::region::Region;
use crate::run::RunOptions;

/// Draw a surface to points, curves, meshes or solids, or stamp text, a drawing or a picture on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Emboss {
    /// Draw the surface to the points of this file: lines of `x y z`, or the vertices of a mesh. Points inside engrave.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub points: Option<PathBuf>,
    /// Draw it to a curve: a text of points in order, the `l` lines of an OBJ, or the paths of an SVG, which are laid on the surface by `at`, `up`, `size` and `height`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub curve: Option<PathBuf>,
    /// Draw it to the surface of this mesh or level set.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub mesh: Option<PathBuf>,
    /// Draw it to this solid, a mesh or level set: what lies inside of it already is not drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub solid: Option<PathBuf>,
    /// Stamp this PNG: brightness is height.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub image: Option<PathBuf>,
    /// With `image`: dark is high.
    pub invert: bool,
    /// Stamp what the paths of this SVG fill, and its strokes.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub svg: Option<PathBuf>,
    /// Stamp this text; `font` says how. Line breaks centre lines below each other.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// The TrueType or OpenType font of `text`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub font: Option<PathBuf>,
    /// Where the middle of a stamp goes; the closest point of the surface is taken.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at: Option<Vector>,
    /// Which way is up on a stamp; 0,0,1, or 0,1,0 where the surface faces that way, if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<Vector>,
    /// Width of a stamp along the surface; its height in the plane follows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<WorldLength>,
    /// How far a stamp stands out of the surface, or is cut into it if negative; 3 voxels if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<WorldLength>,
    /// Cosines of the angle between the normal and the direction to the target between which the surface begins to be drawn.
    pub angle_limits: [f64; 2],
    /// Distance from the target within which all of the surface that does not face away is drawn, and more for a target that is farther off; 0 for the angles
    /// alone, with which a single point is not reached.
    pub tip: VoxelLength,
    /// Push the surface away from the target instead, for `time`, `iterations` or down to `max_depth`.
    pub repel: bool,
    /// How far a pushed surface goes at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_depth: Option<WorldLength>,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub evolution: EvolutionOptions,
}

impl Default for Emboss {
    fn default() -> Self {
        Self {
            points: None,
            curve: None,
            mesh: None,
            solid: None,
            image: None,
            invert: false,
            svg: None,
            text: None,
            font: None,
            at: None,
            up: None,
            size: None,
            height: None,
            angle_limits: Attraction::LIMITS,
            tip: VoxelLength::new(Attraction::TIP),
            repel: false,
            max_depth: None,
            evolution: EvolutionOptions::default(),
        }
    }
}

/// Most steps where nothing is asked for: the approach to the limit is algebraic, not exponential.
const MOST_ITERATIONS: u32 = 1000;

/// How far a stamp stands out where nothing is asked for, in voxels.
const DEFAULT_HEIGHT: f64 = 3.0;

/// Flattening of curves, in voxels.
const FLATNESS: f64 = 0.02;

/// Part of a stamp's area that may lie folded before it is said.
const FOLDED: f64 = 0.005;

/// Directions that count as parallel: the sine of the angle.
const PARALLEL: f64 = 1e-3;

/// Largest size of a stamp in voxels, and of its height: a patch that large would hold millions of triangles.
const LARGEST: f64 = 20_000.0;

/// What is asked for.
enum Source<'a> {
    Points(&'a Path),
    Curve(&'a Path),
    Mesh(&'a Path),
    Solid(&'a Path),
    Image(&'a Path),
    Svg(&'a Path),
    Text(&'a str, &'a Path),
}

impl Source<'_> {
    /// Whether it is laid on the surface.
    fn is_placed(&self) -> bool {
        match self {
            Self::Image(_) | Self::Svg(_) | Self::Text(..) => true,
            Self::Curve(path) => is_svg(path),
            Self::Points(_) | Self::Mesh(_) | Self::Solid(_) => false,
        }
    }

    /// Whether it is a layer, not a flow.
    fn is_stamp(&self) -> bool {
        matches!(self, Self::Image(_) | Self::Svg(_) | Self::Text(..))
    }
}

fn is_svg(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("svg"))
}

impl Emboss {
    fn source(&self) -> Result<Source<'_>> {
        let refuse =
            |field: &str, value: &str, accepted: &str| EditError::parameter(Self::NAME, field, value, accepted);
        let font = self.font.as_deref();
        let text = self.text.as_deref().map(|text| match font {
            Some(_) if text.trim().is_empty() => Err(refuse("text", "", "text with at least one visible character")),
            Some(font) => Ok(Source::Text(text, font)),
            None => Err(refuse("text", text, "with `font`, the file of a TrueType or OpenType font")),
        });
        if let (None, Some(font)) = (&text, font) {
            return Err(refuse("font", &font.display().to_string(), "only with `text`"));
        }
        let sources = [
            self.points.as_deref().map(|p| Ok(Source::Points(p))),
            self.curve.as_deref().map(|p| Ok(Source::Curve(p))),
            self.mesh.as_deref().map(|p| Ok(Source::Mesh(p))),
            self.solid.as_deref().map(|p| Ok(Source::Solid(p))),
            self.image.as_deref().map(|p| Ok(Source::Image(p))),
            self.svg.as_deref().map(|p| Ok(Source::Svg(p))),
            text,
        ];
        let accepted = "one of `points`, `curve`, `mesh`, `solid`, `image`, `svg` and `text`";
        let mut given = sources.into_iter().flatten();
        let source = given.next().unwrap_or_else(|| Err(refuse("points", "nothing", accepted)))?;
        match given.next() {
            None => Ok(source),
            Some(_) => Err(refuse("points", "several targets at once", accepted)),
        }
    }

    /// A length in voxels; refused where it cannot work.
    fn voxels(&self, field: &str, length: WorldLength, level_set: &LevelSet) -> Result<f64> {
        let voxels = length.voxels(level_set.voxel_size());
        match voxels.abs() <= LARGEST {
            true => Ok(voxels),
            false => Err(EditError::parameter(Self::NAME, field, length, format!("at most {LARGEST} voxels"))),
        }
    }

    /// Where a stamp lies: its middle, and the tangents at a normal (all in index space).
    fn placed(&self, level_set: &LevelSet, width: f64, radius: f64, run: &RunOptions) -> Result<Patch> {
        let transform = level_set.transform();
        let at = transform.world_to_index(self.at.unwrap_or_default().0);
        let frame = |normal: DVec3| {
            let normal = transform.direction_to_world(normal).normalize_or_zero();
            let tangent = |up: DVec3| {
                let up = up.normalize_or_zero();
                let tangent = up - normal * up.dot(normal);
                (tangent.length() > PARALLEL).then(|| tangent.normalize())
            };
            let up = match self.up {
                None => tangent(DVec3::Z).or_else(|| tangent(DVec3::Y)),
                Some(up) => tangent(up.0),
            };
            let up = up.ok_or_else(|| {
                let up = self.up.unwrap_or_default().0;
                let accepted = format!("a direction along the surface, whose normal here is {normal}");
                EditError::parameter(Self::NAME, "up", up, accepted)
            })?;
            // Read from outside: to the right is up × normal.
            let back = transform.to_index().matrix3;
            let to_index = |v: DVec3| (back * v).normalize_or_zero();
            Ok((to_index(up.cross(normal)), to_index(up)))
        };
        Patch::new(level_set, at, radius, width.max(10.0), frame, run)
    }

    fn stamp(&self, level_set: LevelSet, source: &Source, run: &RunOptions) -> Result<Outcome> {
        let width = self.voxels("size", self.size.unwrap_or_default(), &level_set)?;
        let height = self.voxels("height", self.height.unwrap_or(DEFAULT_LENGTH), &level_set)?;
        let (motif, aspect) = match source {
            Source::Image(path) => {
                let picture = Picture::read(path, self.invert)?;
                let aspect = picture.aspect();
                (Motif::Picture(picture.reduced(width)), aspect)
            }
            Source::Text(text, font) => outlined(&Drawing::of_text(text, font)?, width)?,
            Source::Svg(path)
            | Source::Points(path)
            | Source::Curve(path)
            | Source::Mesh(path)
            | Source::Solid(path) => outlined(&Drawing::of_svg(path)?, width)?,
        };
        let stamp = Stamp { motif, size: DVec2::new(width, width * aspect), height };
        let mut summary = Summary::default();
        let region = self.evolution.region.on(&level_set, run)?;
        let patch = self.placed(&level_set, width, stamp.radius(), run)?;
        let folded = patch.folded(|flat| stamp.covers(flat));
        if folded > FOLDED {
            summary.warnings.push(format!(
                "the surface cannot be laid flat over the whole stamp: {:.1} % of it is folded; make it smaller or place it elsewhere",
                folded * 100.0
            ));
        }
        let result = stamp.on(&level_set, &patch, region.as_deref(), run)?;
        Ok(Outcome { level_set: result, summary })
    }

    /// The curves of a drawing, laid on the surface at their height.
    fn laid(&self, path: &Path, level_set: &LevelSet, run: &RunOptions) -> Result<Vec<Vec<DVec3>>> {
        let width = self.voxels("size", self.size.unwrap_or_default(), level_set)?;
        let height = self.voxels("height", self.height.unwrap_or(DEFAULT_LENGTH), level_set)?;
        let drawing = Drawing::of_svg(path)?;
        let patch =
            self.placed(level_set, width, width * DVec2::new(1.0, drawing.aspect()).length() / 2.0 + 4.0, run)?;
        let transform = level_set.transform();
        let place = |flat: DVec2| patch.lift(flat).map(|(p, n)| transform.index_to_world(p + n * height));
        let split = |line: Vec<DVec2>| -> Vec<DVec3> {
            // Pieces of half a voxel follow the surface.
            let pieces = line.windows(2).flat_map(|w| {
                let n = (w[0].distance(w[1]) * 2.0).ceil().max(1.0);
                (0..n as u32).map(move |k| w[0].lerp(w[1], f64::from(k) / n))
            });
            pieces.chain(line.last().copied()).filter_map(place).collect()
        };
        Ok(drawing.polylines(width, FLATNESS).into_iter().map(split).filter(|line| line.len() > 1).collect())
    }

    fn attraction(&self, level_set: &LevelSet) -> Result<Attraction> {
        let max_depth = self.max_depth.map(|depth| self.voxels("max_depth", depth, level_set)).transpose()?;
        let tip = self.tip.voxels(level_set.voxel_size());
        let cut_off = CutOff::NONE.with_low(self.angle_limits).unwrap_or_default();
        Ok(Attraction { cut_off, tip, repel: self.repel, max_depth })
    }
}

const DEFAULT_LENGTH: WorldLength = WorldLength::in_voxels(DEFAULT_HEIGHT);

fn outlined(drawing: &Drawing, width: f64) -> Result<(Motif, f64)> {
    Ok((Motif::Outline(drawing.outline(width, FLATNESS)?), drawing.aspect()))
}

impl Operator for Emboss {
    const NAME: &'static str = "emboss";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter(Self::NAME, field, value, accepted));
        let source = self.source()?;
        if source.is_placed() {
            if self.at.is_none() {
                return refuse(
                    "at",
                    "nothing".into(),
                    "a point `x,y,z` on or near the surface, for the middle of the stamp",
                );
            }
            match self.size {
                None => return refuse("size", "nothing".into(), "the width of the stamp, such as 0.3 or 40vx"),
                Some(size) if !(size.world(1.0) > 0.0 && size.world(1.0).is_finite()) => {
                    return refuse("size", size.to_string(), "a positive, finite width");
                }
                _ => {}
            }
        } else {
            let given = [
                ("at", self.at.map(|v| v.0.to_string())),
                ("up", self.up.map(|v| v.0.to_string())),
                ("size", self.size.map(|l| l.to_string())),
                ("height", self.height.map(|l| l.to_string())),
            ];
            if let Some((field, Some(value))) = given.into_iter().find(|(_, value)| value.is_some()) {
                return refuse(
                    field,
                    value,
                    "only with `image`, `svg`, `text` and the curves of an SVG, which are laid on the surface",
                );
            }
        }
        if self.invert && self.image.is_none() {
            return refuse("invert", "true".into(), "only with `image`");
        }
        if let Some(height) = self.height
            && !(height.world(1.0).is_finite() && height.world(1.0) != 0.0)
        {
            return refuse("height", height.to_string(), "a finite height: positive stands out, negative is cut in");
        }
        let flows = [
            ("repel", self.repel.then(|| "true".to_owned())),
            ("max_depth", self.max_depth.map(|l| l.to_string())),
            ("time", self.evolution.time.map(|t| t.to_string())),
            ("iterations", self.evolution.iterations.map(|t| t.to_string())),
            ("max_iterations", self.evolution.max_iterations.map(|t| t.to_string())),
        ];
        if source.is_stamp()
            && let Some((field, Some(value))) = flows.into_iter().find(|(_, value)| value.is_some())
        {
            return refuse(field, value, "only with `points`, `curve`, `mesh` and `solid`: stamps do not flow");
        }
        let [low, high] = self.angle_limits;
        if let Err(accepted) = CutOff::NONE.with_low(self.angle_limits) {
            return refuse("angle_limits", format!("{low},{high}"), accepted);
        }
        if high > 1.0 {
            return refuse("angle_limits", format!("{low},{high}"), "cosines up to 1, such as 0.8,0.9");
        }
        let tip = self.tip.voxels(1.0);
        if !(tip >= 0.0 && tip.is_finite()) {
            return refuse("tip", self.tip.to_string(), "0 or more voxels");
        }
        match self.max_depth {
            Some(depth) if !self.repel => return refuse("max_depth", depth.to_string(), "only with `repel`"),
            Some(depth) if !(depth.world(1.0) > 0.0 && depth.world(1.0).is_finite()) => {
                return refuse("max_depth", depth.to_string(), "a positive, finite depth");
            }
            None if self.repel && self.evolution.time.is_none() && self.evolution.iterations.is_none() => {
                let accepted = "with `max_depth`, `time` or `iterations`: a pushed surface goes faster and faster";
                return refuse("repel", "true".into(), accepted);
            }
            _ => {}
        }
        if self.evolution.solver(SolverOptions::FIRST_ORDER) != SolverOptions::FIRST_ORDER {
            let accepted = "nothing: attraction has a scheme of its own, and stamps do not flow";
            return refuse("scheme", "options of the solver".into(), accepted);
        }
        self.evolution.validate(Self::NAME)
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let level_set = inputs.remove(0);
        let source = self.source()?;
        if source.is_stamp() {
            return self.stamp(level_set, &source, run);
        }
        let elements = match &source {
            Source::Points(path) => Elements::of_points(path, &level_set)?,
            Source::Curve(path) if is_svg(path) => {
                Elements::of_polylines(&self.laid(path, &level_set, run)?, &level_set)
            }
            Source::Curve(path) => Elements::of_polylines(&read_polylines(path)?, &level_set),
            Source::Mesh(path)
            | Source::Solid(path)
            | Source::Image(path)
            | Source::Svg(path)
            | Source::Text(_, path) => Elements::of_surface(path, &level_set, run)?,
        };
        let points: Vec<DVec3> = match &source {
            Source::Points(_) => elements.0.iter().map(|e| e[0]).collect(),
            _ => Vec::new(),
        };
        let tree = Bvh::new(elements.0);
        let region = self.evolution.region.on(&level_set, run)?;
        let mut drawn = None;
        let mut outcome = evolved(level_set, run, |level_set| {
            let how = self.attraction(level_set)?;
            let region = region.as_deref();
            let report = match source {
                Source::Solid(_) => self.flow(level_set, &Solid::new(&tree), &how, region, run)?,
                _ => self.flow(level_set, &Surface(&tree), &how, region, run)?,
            };
            drawn = Some(report.clone());
            Ok(report.flow)
        })?;
        if let Some(report) = drawn {
            self.tell(&mut outcome, &report, &points, region.as_deref());
        }
        Ok(outcome)
    }
}

impl Emboss {
    /// Draws the part of the level set that is to move, and puts back the leaves that did.
    fn flow(
        &self,
        level_set: &mut LevelSet,
        target: &dyn Attractor,
        how: &Attraction,
        region: Option<&dyn Region>,
        run: &RunOptions,
    ) -> Result<AttractionReport> {
        let nothing = |level_set: &LevelSet| {
            let voxels = level_set.grid().active_voxels();
            let flow = Report { steps: 0, time: 0.0, voxels, stopped: StopReason::AtRest };
            AttractionReport { flow, gap: 0.0, stalled: false, moved: Default::default(), specks: 0 }
        };
        let Some(pull) = Pull::new(level_set, target, how, region, run)? else { return Ok(nothing(level_set)) };
        let Some(within) = pull.drawn_within(level_set, run)? else { return Ok(nothing(level_set)) };
        // The band of what moved reaches into so many leaves around it.
        let half_width = f64::from(level_set.half_width());
        let rings = ((half_width + 1.0) / f64::from(LEAF_DIM)).ceil();
        let margin = f64::from(LEAF_DIM) * (rings + 1.0) + 2.0 * half_width + 4.0;
        let mut part = cut_out(level_set, within, margin, run)?;
        let until = self.evolution.until_rest(MOST_ITERATIONS);
        let report = attract(&mut part, &pull, within, until, run)?;
        let mut leaves = report.moved.clone();
        for _ in 0..rings as u32 {
            leaves = leaves.into_iter().flat_map(leaves_around).collect();
        }
        if !leaves.is_empty() {
            *level_set = put_back(level_set, &part, leaves, region);
        }
        Ok(report)
    }

    /// What the flow reached.
    fn tell(&self, outcome: &mut Outcome, report: &AttractionReport, points: &[DVec3], region: Option<&dyn Region>) {
        let Outcome { level_set, summary } = outcome;
        if report.flow.steps == 0 {
            summary.warnings.push(
                "nothing is drawn: the target is on the surface already, or no part of the surface (in the region) faces it; nothing was changed".into(),
            );
            return;
        }
        if report.specks > 0 {
            summary.warnings.push(format!("{} specks that broke off were taken away", report.specks));
        }
        if self.repel {
            return;
        }
        if report.gap < REACHED {
            summary.stopped_because = Some("everything that draws is reached".into());
        } else if report.stalled {
            summary.stopped_because = Some("nothing comes nearer any more".into());
        }
        let transform = level_set.transform();
        let mut sampler = level_set.sampler();
        let near = |p: &&DVec3| region.is_none_or(|region| region.weight(transform.index_to_world(**p)) > 0.0);
        let gaps: Vec<f64> = points
            .iter()
            .filter(near)
            .map(|p| f64::from(sampler.trilinear(*p)).abs() / level_set.voxel_size())
            .collect();
        let missed = gaps.iter().filter(|gap| **gap >= REACHED).count();
        if !points.is_empty() {
            summary.details.insert("points".into(), points.len().into());
            summary.details.insert("points_reached".into(), (gaps.len() - missed).into());
        }
        if missed > 0 {
            summary.warnings.push(format!(
                "{missed} of {} points were not reached: no part of the surface that may move faces them, or others are nearer",
                gaps.len()
            ));
        }
    }
}

#[cfg(test)]
mod tests;
