//! Geometric texturing: a solid is wrapped onto patches of a surface and united with it or cut out of it ([`crate::texture`]; Brodersen,
//! Museth, Porumbescu & Budge 2007, *Geometric Texturing Using Level Sets*).
//!
//! A patch lies between four corners, joined by geodesics, or around a centre by the discrete exponential map. The bounding box of the
//! texture's surface becomes the space above it: x → u along the first edge, y → v along the last, z → w away from the surface, so that
//! left and right are kept. Maps:
//!
//! - `inverse` looks each voxel up in the texture by the exact inverse of the map between the particles, trilinear in each cell;
//! - `implicit` by radial basis functions through some of the particles, the paper's: smooth across the cells, and not quite exact;
//! - `semi-implicit` moves the polygons of the texture.
//!
//! The result of each has exact distances to the surface of the texture as it lies there; the union or difference with the base is that of `csg`.
//! Cells of the map that fold over (their Jacobian is not positive) or lie in each other are counted and said.

mod loose;
mod places;
mod report;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;

use self::loose::Loose;
use self::places::{Place, Scatter};
use self::report::{PatchReport, write_particles};
use super::CurvatureOptions;
use super::blend::{Blend, BlendMethod, blend};
use super::csg::{CsgOperation, csg};
use super::params::{Vector, VoxelLength, WorldLength, words};
use super::registry::{Arity, Operator, Outcome, Summary};
use crate::atomic::write_atomically;
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::TriangleMesh;
use crate::rbf::Basis;
use crate::run::RunOptions;
use crate::texture::{
    Distortion, Laying, Map, Parameterization, Particles, Patch, Rbf, Sampling, Source, warped, wrapped,
};

words! {
    /// How the space above a patch is divided.
    Division {
        /// Each particle follows the normal.
        Conforming = "conforming",
        /// Each level gets an even net of its own.
        LowDistortion = "low-distortion",
        /// The patch is carried along a curve.
        Spline = "spline",
    }
}

words! {
    /// Which map takes a place to the texture.
    MapKind {
        /// Radial basis functions through the particles.
        Implicit = "implicit",
        /// The polygons of the texture are moved.
        SemiImplicit = "semi-implicit",
        /// The exact inverse of that.
        Inverse = "inverse",
    }
}

words! {
    /// What a particle contributes at a distance r to the implicit map.
    BasisKind {
        /// r.
        Linear = "r",
        /// r³.
        Cubic = "r3",
        /// Wendland's function of compact support.
        Wendland = "wendland",
    }
}

words! {
    /// How the texture is found between its voxels.
    Between {
        /// Linear along each axis.
        Linear = "linear",
        /// Cubic along each axis.
        Cubic = "cubic",
    }
}

words! {
    /// What is done with base and texture.
    Joining {
        /// United.
        Union = "union",
        /// The texture is cut out of the base.
        Difference = "difference",
        /// The texture alone is the result.
        None = "none",
    }
}

words! {
    /// How the edge where they meet is blended.
    Blending {
        /// By mean curvature flow.
        Curvature = "curvature",
        /// By an anisotropic Gaussian.
        Gaussian = "gaussian",
        /// Not at all.
        None = "none",
    }
}

words! {
    /// What becomes of parts of the texture that do not meet the base.
    LooseParts {
        /// They stay, and are counted.
        Keep = "keep",
        /// They are left out.
        Drop = "drop",
    }
}

/// Wrap a solid, the texture, onto patches of a surface, the base.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Texture {
    /// Four points, on the surface or near it, counter-clockwise seen from outside: x of the texture goes along the edge from the first to the second, y from the first to the fourth.
    #[schemars(extend("x-list" = true, "x-kind" = "x,y,z", "x-count" = 4))]
    pub corners: Vec<Vector>,
    /// A text file of patches: four points `x,y,z` a line (`#` begins a comment).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub corners_file: Option<PathBuf>,
    /// A square patch around this point of the surface, instead of corners, with `radius`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub center: Option<Vector>,
    /// Which way x of the texture goes on a patch around a point; any if not given, on scattered patches one by chance for each.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub direction: Option<Vector>,
    /// Half the side of the patch around `center`, along the surface.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius: Option<WorldLength>,
    /// Patches all over the surface: `spacing=0.3 radius=0.1 seed=1`, centres at least `spacing` apart, sides of twice `radius`; `density=` (patches an area of 1) or `count=` take no more than that.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "'spacing=… radius=… seed=…'"))]
    pub scatter: Option<String>,
    /// How high the texture stands on the surface, or how deep it goes, upside down, if negative; as the width of the patch and the shape of the texture make it if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<WorldLength>,
    /// How often the texture is repeated along u and v.
    pub tile: [f64; 2],
    /// How the space above the patch is divided: `conforming` along the normals; `low-distortion` with cells that stay even at every height; `spline` along a curve.
    pub parameterization: Division,
    /// With `low-distortion`: the directions in which the four corners rise.
    #[schemars(extend("x-list" = true, "x-kind" = "x,y,z", "x-count" = 4))]
    pub corner_directions: Vec<Vector>,
    /// With `spline`: the points that the curve from the middle of the patch runs through, `'x,y,z x,y,z …'`, or a file of them. Its length is the height.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spline: Option<String>,
    /// The map: `inverse` is exact; `implicit` by radial basis functions, smooth across the cells between particles; `semi-implicit` moves the polygons of the texture.
    pub map: MapKind,
    /// The radial basis function of `implicit`.
    pub basis: BasisKind,
    /// Smoothing of `implicit` at particles on the surface, and above it, 0..10.
    pub lambda: [f64; 2],
    /// Particles of `implicit`, about, 27 to 3000.
    pub particles: u32,
    /// How far the texture is pushed into the surface, so that the two are sure to meet; 1 voxel if not given, with the operation `none` 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub push: Option<VoxelLength>,
    /// How the texture is found between its voxels.
    pub interpolation: Between,
    /// What is done with base and texture; `none` gives the texture alone, as it lies there.
    pub operation: Joining,
    /// With `union`: parts of the texture that do not meet the base, such as pieces of a tile that only the next tile would hold, are kept and counted, or left out (`drop`).
    pub loose: LooseParts,
    /// How the edge where they meet is blended.
    pub blend: Blending,
    /// Distance from that edge up to which it is blended; that of `blend` if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blend_distance: Option<VoxelLength>,
    /// With `blend` curvature: it rests where the mean curvature is below the first number, and acts in full above the second, in 1/voxel; 0.04,0.06 if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blend_curvature: Option<[f64; 2]>,
    /// Write the particles of all patches to this PLY, with their u, v and w, the edges and cells of their nets and how the map distorts these; `render --color-by patch:FILE` and `distortion:FILE` draw them.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub write_particles: Option<PathBuf>,
    /// Write the polygons of the texture as they lie on all patches, moved by the semi-implicit map, to this mesh (.obj, .ply, .stl, .off, .glb).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub write_mesh: Option<PathBuf>,
    /// The mesh whose polygons `write_mesh` moves, with its colours and texture coordinates; the surface of the texture if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub mesh: Option<PathBuf>,
}

impl Default for Texture {
    fn default() -> Self {
        Self {
            corners: Vec::new(),
            corners_file: None,
            center: None,
            direction: None,
            radius: None,
            scatter: None,
            height: None,
            tile: [1.0, 1.0],
            parameterization: Division::Conforming,
            corner_directions: Vec::new(),
            spline: None,
            map: MapKind::Inverse,
            basis: BasisKind::Linear,
            lambda: [0.005, 0.3],
            particles: 400,
            push: None,
            interpolation: Between::Linear,
            operation: Joining::Union,
            loose: LooseParts::Keep,
            blend: Blending::None,
            blend_distance: None,
            blend_curvature: None,
            write_particles: None,
            write_mesh: None,
            mesh: None,
        }
    }
}

/// Most repetitions along an edge.
const MOST_TILES: f64 = 1000.0;

/// Reach of Wendland's function, in spacings of the particles.
const SUPPORT: f64 = 4.0;

/// Part of the cells above a patch that may fold over or lie in each other.
const MOST_FOLDED: f64 = 0.15;

/// Sine of the angle below which directions count as parallel.
const PARALLEL: f64 = 1e-3;

impl Operator for Texture {
    const NAME: &'static str = "texture";
    const ARITY: Arity = Arity::BaseAndSolid;

    fn validate(&self) -> Result<()> {
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter(Self::NAME, field, value, accepted));
        let given = [
            ("corners", !self.corners.is_empty()),
            ("corners_file", self.corners_file.is_some()),
            ("center", self.center.is_some()),
            ("scatter", self.scatter.is_some()),
        ];
        let accepted = "one of `corners`, `corners_file`, `center` with `radius`, and `scatter`";
        match given.iter().filter(|(_, given)| *given).count() {
            1 => {}
            0 => return refuse("corners", "nothing".into(), accepted),
            _ => return refuse("corners", "several kinds of patches at once".into(), accepted),
        }
        if !self.corners.is_empty() && self.corners.len() != 4 {
            return refuse("corners", format!("{} points", self.corners.len()), "four points `x,y,z`");
        }
        let positive = |l: WorldLength| l.world(1.0) > 0.0 && l.world(1.0).is_finite();
        match (self.center, self.radius) {
            (Some(_), None) => return refuse("radius", "nothing".into(), "half the side of the patch, such as 0.2"),
            (None, Some(radius)) => return refuse("radius", radius.to_string(), "only with `center`"),
            (_, Some(radius)) if !positive(radius) => {
                return refuse("radius", radius.to_string(), "a positive, finite length");
            }
            _ => {}
        }
        if let Some(direction) = self.direction {
            if self.center.is_none() && self.scatter.is_none() {
                return refuse("direction", direction.0.to_string(), "only with `center` and `scatter`");
            }
            if direction.0.length() < PARALLEL {
                return refuse("direction", direction.0.to_string(), "a direction that is not 0");
            }
        }
        if let Some(text) = &self.scatter {
            Scatter::parse(text)?;
        }
        if let Some(height) = self.height
            && !(height.world(1.0) != 0.0 && height.world(1.0).is_finite())
        {
            return refuse("height", height.to_string(), "a finite height: positive stands out, negative goes down");
        }
        let [a, b] = self.tile;
        if ![a, b].iter().all(|n| (1.0..=MOST_TILES).contains(n) && n.fract() == 0.0) {
            let accepted = format!("two whole numbers from 1 to {MOST_TILES}, such as 4,2");
            return refuse("tile", format!("{a},{b}"), &accepted);
        }
        match (self.parameterization, &self.spline) {
            (Division::Spline, None) => {
                return refuse("spline", "nothing".into(), "points `'x,y,z x,y,z …'` or a file of them");
            }
            (Division::Conforming | Division::LowDistortion, Some(text)) => {
                return refuse("spline", text.clone(), "only with the parameterization spline");
            }
            _ => {}
        }
        if let (Division::Spline, Some(height)) = (self.parameterization, self.height) {
            return refuse("height", height.to_string(), "nothing with a spline: its length is the height");
        }
        if !self.corner_directions.is_empty() {
            let count = format!("{} directions", self.corner_directions.len());
            if self.parameterization != Division::LowDistortion {
                return refuse("corner_directions", count, "only with the parameterization low-distortion");
            }
            if self.corner_directions.len() != 4 || self.corner_directions.iter().any(|d| d.0.length() < PARALLEL) {
                return refuse("corner_directions", count, "four directions `x,y,z` that are not 0");
            }
        }
        let [surface, above] = self.lambda;
        if !self.lambda.iter().all(|l| (0.0..=10.0).contains(l)) {
            return refuse("lambda", format!("{surface},{above}"), "two numbers from 0 (through all particles) to 10");
        }
        if !(27..=3000).contains(&self.particles) {
            return refuse("particles", self.particles.to_string(), "27 to 3000");
        }
        if self.map != MapKind::Implicit
            && (self.lambda, self.basis, self.particles)
                != (Self::default().lambda, Self::default().basis, Self::default().particles)
        {
            let said = format!("{surface},{above}, {} particles", self.particles);
            return refuse("lambda", said, "`lambda`, `basis` and `particles` only with the map implicit");
        }
        if let Some(push) = self.push
            && !(0.0..=100.0).contains(&push.voxels(1.0))
        {
            return refuse("push", push.to_string(), "0 to 100 voxels");
        }
        if self.blend != Blending::None && self.operation == Joining::None {
            return refuse("blend", "with the operation none".into(), "only with the operations union and difference");
        }
        if self.loose == LooseParts::Drop && self.operation != Joining::Union {
            return refuse("loose", "drop".into(), "only with the operation union");
        }
        if let Some(path) = &self.mesh
            && self.write_mesh.is_none()
        {
            return refuse("mesh", path.display().to_string(), "only with `write_mesh`");
        }
        if let Some(distance) = self.blend_distance {
            if self.blend == Blending::None {
                return refuse("blend_distance", distance.to_string(), "only with `blend`");
            }
            self.blending().validate()?;
        }
        if let Some([a, b]) = self.blend_curvature {
            if self.blend != Blending::Curvature {
                return refuse("blend_curvature", format!("{a},{b}"), "only with `blend` curvature");
            }
            self.blending().validate()?;
        }
        Ok(())
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let texture = inputs.remove(1);
        let base = inputs.remove(0);
        let mut summary = Summary::default();
        if base.is_empty() {
            summary.warnings.push("the base has no surface: nothing was changed".into());
            return Ok(Outcome { level_set: base, summary });
        }
        let laid = self.laid(&base, texture, &mut summary, run)?;
        let [first, others @ ..] = &laid[..] else {
            summary.warnings.push("there is no patch: nothing was changed".into());
            return Ok(Outcome { level_set: base, summary });
        };
        let others: Vec<&LevelSet> = others.iter().collect();
        let mut together = csg(first, &others, CsgOperation::Union, run)?;
        if self.operation == Joining::Union {
            together = self.without_loose(&base, together, &mut summary, run)?;
        }
        let operation = match self.operation {
            Joining::None => return Ok(Outcome { level_set: together, summary }),
            Joining::Union => CsgOperation::Union,
            Joining::Difference => CsgOperation::Difference,
        };
        if self.blend == Blending::None {
            return Ok(Outcome { level_set: csg(&base, &[&together], operation, run)?, summary });
        }
        let (blended, found) = blend(&base, &together, &Blend { operation, ..self.blending() }, run)?;
        summary.details.insert("fillet_radius".into(), json!(found.fillet_radius));
        summary.warnings.extend(blended.summary.warnings);
        summary.steps = blended.summary.steps;
        summary.stopped_because = blended.summary.stopped_because;
        Ok(Outcome { level_set: blended.level_set, summary })
    }
}

/// Refuses a space above a patch that runs through itself.
fn refuse_folds(distortion: &Distortion, height: f64) -> Result<()> {
    let Distortion { folded, overlapping, cells, .. } = *distortion;
    if (folded + overlapping) as f64 <= MOST_FOLDED * cells as f64 {
        return Ok(());
    }
    let accepted = format!(
        "a smaller height or patch, or the parameterization low-distortion or spline: the space above the patch runs through itself ({folded} of its {cells} cells fold over, {overlapping} lie in others)"
    );
    Err(EditError::parameter(Texture::NAME, "height", height, accepted))
}

impl Texture {
    /// The texture, or that of it which meets the base.
    fn without_loose(
        &self,
        base: &LevelSet,
        texture: LevelSet,
        summary: &mut Summary,
        run: &RunOptions,
    ) -> Result<LevelSet> {
        let loose = Loose::of(&csg(base, &[&texture], CsgOperation::Union, run)?, base, run)?;
        let (count, most) = loose.count();
        summary.details.insert("loose_parts".into(), count.into());
        match (count, self.loose) {
            (0, _) => Ok(texture),
            (_, LooseParts::Drop) => loose.dropped_from(&texture, run),
            (_, LooseParts::Keep) => {
                summary.warnings.push(format!(
                    "{count} parts of the texture do not meet the base (the largest has {most} voxels inside); push it in deeper, or leave them out with `loose` drop"
                ));
                Ok(texture)
            }
        }
    }

    /// How the edge is blended; the operation is set where it is known.
    fn blending(&self) -> Blend {
        let method = if self.blend == Blending::Gaussian { BlendMethod::Gaussian } else { BlendMethod::Curvature };
        let part = |l: VoxelLength| VoxelLength::new(l.voxels(1.0) * 0.75);
        let flow = CurvatureOptions { curvature_low: self.blend_curvature, ..CurvatureOptions::default() };
        Blend { method, d_max: self.blend_distance, d_min: self.blend_distance.map(part), flow, ..Blend::default() }
    }

    /// The texture on each patch.
    fn laid(
        &self,
        base: &LevelSet,
        texture: LevelSet,
        summary: &mut Summary,
        run: &RunOptions,
    ) -> Result<Vec<LevelSet>> {
        let mut source = Source::new(texture, run)?;
        let shape = source.size();
        let places = self.places(base, run)?;
        let most = places.scattered.unwrap_or(places.list.len()).min(places.list.len());
        let (mut left_out, mut refused) = (0, None);
        let laying = self.laying(base.voxel_size());
        let mut report = PatchReport::default();
        let mut particles = Particles::default();
        let given = self.mesh.as_deref().map(crate::mesh::read).transpose()?.map(|read| read.mesh);
        let mut moved = TriangleMesh::default();
        let mut laid = Vec::with_capacity(most);
        let task = run.task("patches", most as u64);
        for place in &places.list {
            if laid.len() == most {
                break;
            }
            let height = self.height.map_or_else(
                || place.width() / self.tile[0] * shape.z / shape.x,
                |height| height.world(base.voxel_size()),
            );
            let part = place.part_of(base, height.abs(), run)?;
            let patch = match self.patch(&part, place, height, run) {
                // Where chance leads to a place that will not do, it goes on.
                Err(error @ EditError::Parameter { .. }) if places.scattered.is_some() => {
                    refused = Some(error);
                    None
                }
                patch => Some(patch?),
            };
            let made = patch.map(|patch| (patch.distortion(), patch));
            if let (Some((distortion, _)), None) = (&made, places.scattered) {
                refuse_folds(distortion, height)?;
            }
            let good = |made: &(Distortion, Patch)| places.scattered.is_none() || made.0.folded == 0;
            let Some((distortion, patch)) = made.filter(good) else {
                left_out += 1;
                continue;
            };
            report.add(&distortion);
            if self.write_particles.is_some() {
                let mut more = patch.particles();
                more.places.iter_mut().for_each(|(p, _)| *p = base.transform().index_to_world(*p));
                particles.append(more);
            }
            if self.write_mesh.is_some() {
                let mesh = given.as_ref().unwrap_or(source.mesh());
                if let Some(bounds) = mesh.bounding_box() {
                    moved.append(warped(mesh, bounds, &part, &patch, &laying));
                }
            }
            let wrapped = wrapped(&part, &mut source, &patch, &laying, run)?;
            report.kernels = report.kernels.zip(wrapped.kernels).map(|(a, b)| [a[0] + b[0], a[1] + b[1]]);
            laid.push(wrapped.level_set);
            task.advance(1);
        }
        drop(task);
        if let (true, Some(error)) = (laid.is_empty(), refused) {
            return Err(error);
        }
        if left_out > 0 {
            summary.warnings.push(format!(
                "{left_out} places were left out, where the surface cannot be laid flat or the space above it folds; a smaller `radius=` or height would fit more"
            ));
        }
        report.tell(summary, self.map == MapKind::Implicit);
        if let Some(path) = &self.write_particles {
            write_atomically(path, |out| write_particles(out, &particles))?;
        }
        if let Some(path) = &self.write_mesh {
            crate::mesh::write(path, &moved)?;
        }
        Ok(laid)
    }

    fn laying(&self, voxel_size: f64) -> Laying {
        let default = if self.operation == Joining::None { 0.0 } else { 1.0 };
        Laying {
            tile: self.tile.map(|n| n as u32),
            push: self.push.map_or(default, |push| push.voxels(voxel_size)),
            map: match self.map {
                MapKind::Inverse => Map::Inverse,
                MapKind::SemiImplicit => Map::SemiImplicit,
                MapKind::Implicit => {
                    let basis = match self.basis {
                        BasisKind::Linear => Basis::Linear,
                        BasisKind::Cubic => Basis::Cubic,
                        BasisKind::Wendland => Basis::Wendland(SUPPORT),
                    };
                    Map::Implicit(Rbf { basis, lambda: self.lambda, particles: self.particles })
                }
            },
            sampling: match self.interpolation {
                Between::Linear => Sampling::Linear,
                Between::Cubic => Sampling::Cubic,
            },
        }
    }

    fn patch(&self, part: &LevelSet, place: &Place, height: f64, run: &RunOptions) -> Result<Patch> {
        let parameterization = match self.parameterization {
            Division::Conforming => Parameterization::Conforming,
            Division::LowDistortion => {
                let directions: Option<[Vector; 4]> = self.corner_directions.clone().try_into().ok();
                Parameterization::LowDistortion(directions.map(|d| d.map(|d| d.0)))
            }
            Division::Spline => Parameterization::Spline(self.spline_points()?),
        };
        match *place {
            Place::Corners(corners) => Patch::between(part, corners, height, &parameterization, run),
            Place::Around { center, direction, radius } => {
                let net = self.net(part, center, direction, radius, run)?;
                Patch::over(part, net, height, &parameterization, run)
            }
        }
    }
}
