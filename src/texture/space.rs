//! A patch with the space above it.

use std::fmt::Write as _;
use std::sync::OnceLock;

use glam::DVec3;

use super::OPERATION;
use super::cells::{Cells, Distortion, singular_values};
use super::field::{ABOVE, ABOVE_SHARP, Field, GROUND};
use super::level::Level;
use super::patch::{Net, broken, corners_on_surface, patch};
use super::volume::{Heights, Volume};
use crate::error::{EditError, Result};
use crate::grid::MAX_COORD;
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// Spacing of particles along the patch and across it, in voxels.
const SPACING: f64 = 2.0;

/// How far a corner may lie from the surface, as a part of the longest edge, and in voxels at least.
const CORNER_REACH: f64 = 0.25;
const LEAST_CORNER_REACH: f64 = 5.0;

/// Largest patch and height, in voxels.
const LARGEST: f64 = 4000.0;

/// How far below the surface (or above it, if the height goes down) the space goes on, in voxels beyond the half width of the band.
const BEYOND: f64 = 2.0;

/// Cosine of the angle between the normals of neighbouring particles below which the base is sharp there: levels above are then as curved as they are near.
const SHARP: f64 = 0.9;

/// Space around what is expected to hold the particles, in voxels; and as a part of the height, where they are pushed aside.
const MARGIN: f64 = 8.0;
const ASIDE: f64 = 0.5;

/// How far a corner is expected to go along its direction, in heights.
const STEEPEST: f64 = 3.0;

/// How particles are distributed above a patch.
#[derive(Clone, Debug, PartialEq)]
pub enum Parameterization {
    /// Each follows the normal.
    Conforming,
    /// Each level has an even net of its own; the corners climb along directions (world space) if there are any.
    LowDistortion(Option<[DVec3; 4]>),
    /// The patch is carried along a curve through these points (world space), which begins at the middle of the patch. The height is its length.
    Spline(Vec<DVec3>),
}

/// A patch of a surface with the space above it, and the map from (u, v, w) in 0..1³ into that.
pub struct Patch {
    pub(super) volume: Volume,
    cells: OnceLock<Cells>,
    /// Lengths of the edges p1p2 and p1p4 and the height, in voxels.
    lengths: DVec3,
    /// Whether the space is outside of the surface.
    pub(super) raised: bool,
    /// How far the space goes on behind the surface, in voxels.
    pub(super) depth: f64,
}

impl Patch {
    /// Over the four-sided piece of the surface of `base` between four corners (world units), counter-clockwise seen from outside, which are brought to
    /// the surface. The space is `height` world units high; if that is negative, it goes down.
    pub fn between(
        base: &LevelSet,
        corners: [DVec3; 4],
        height: f64,
        parameterization: &Parameterization,
        run: &RunOptions,
    ) -> Result<Self> {
        let transform = base.transform();
        let said = corners.iter().fold(String::new(), |mut said, p| {
            let _ = write!(said, "{}{},{},{}", if said.is_empty() { "" } else { " " }, p.x, p.y, p.z);
            said
        });
        let refuse = |accepted: String| EditError::parameter(OPERATION, "corners", &said, accepted);
        let corners = corners.map(|p| transform.world_to_index(p));
        let longest = (0..4).map(|k| corners[k].distance(corners[(k + 1) % 4])).fold(0.0, f64::max);
        if !longest.is_finite() || longest > LARGEST {
            let most = LARGEST * base.voxel_size();
            return Err(refuse(format!("corners at most {most} apart ({LARGEST} voxels)")));
        }
        let reach = (CORNER_REACH * longest).max(LEAST_CORNER_REACH);
        let handed = transform.to_world().matrix3.determinant() < 0.0;
        // As far as the edges may leave the plane of the corners.
        let around = longest / 2.0 + MARGIN;
        let ground = Field::new(base, bounds(&corners, around, "corners")?, 0.0, GROUND, run)?;
        let corners = corners_on_surface(&ground, corners, reach, handed).map_err(refuse)?;
        let net = patch(Level::new(&ground, 0.0), corners, SPACING, None).ok_or_else(|| broken(OPERATION))?;
        if let Some(flaw) = net.flaw() {
            let accepted = "corners on one smooth piece of the surface, without a hole or a fold between them";
            return Err(refuse(format!("{accepted}: {flaw}")));
        }
        Self::over(base, net, height, parameterization, run)
    }

    /// Over a net of points on the surface of `base`.
    pub fn over(
        base: &LevelSet,
        net: Net,
        height: f64,
        parameterization: &Parameterization,
        run: &RunOptions,
    ) -> Result<Self> {
        Space::around(base, &net, height, parameterization, run)?.patch(net, parameterization, run)
    }

    /// Made when they are first asked for: the semi-implicit map does without.
    pub(super) fn cells(&self) -> &Cells {
        self.cells.get_or_init(|| Cells::new(&self.volume))
    }

    /// Distortion of the map from a texture of this patch's edge lengths and height.
    pub fn distortion(&self) -> Distortion {
        self.cells().distortion(self.lengths)
    }

    /// Lengths of the edges p1p2 and p1p4 and the height, in voxels.
    pub fn lengths(&self) -> DVec3 {
        self.lengths
    }

    /// The place in voxels of (u, v, w) in 0..1³: the semi-implicit map.
    pub fn place(&self, uvw: DVec3) -> DVec3 {
        self.volume.at(uvw)
    }

    /// (u, v, w) of a place in voxels, the exact inverse of [`place`](Self::place); `None` outside the space above the patch. w goes on a few
    /// voxels beyond the surface.
    pub fn find(&self, ijk: DVec3) -> Option<DVec3> {
        self.cells().finder().find(ijk)
    }

    /// The particles, in voxels, with their (u, v, w), the nets that they make, and how the map distorts the nets.
    pub fn particles(&self) -> Particles {
        let mut all = Particles::default();
        for (net, &w) in self.volume.layers.iter().zip(&self.volume.levels) {
            let first = all.places.len();
            let [nu, nv] = net.counts;
            for i in 0..=nu {
                for j in 0..=nv {
                    all.places.push((net.at(i, j), DVec3::new(i as f64 / nu as f64, j as f64 / nv as f64, w)));
                    let ([a, b], [c, d]) =
                        ([i.saturating_sub(1), (i + 1).min(nu)], [j.saturating_sub(1), (j + 1).min(nv)]);
                    let by_u = (net.at(b, j) - net.at(a, j)) * (nu as f64 / ((b - a) as f64 * self.lengths.x));
                    let by_v = (net.at(i, d) - net.at(i, c)) * (nv as f64 / ((d - c) as f64 * self.lengths.y));
                    let [s1, s2] = singular_values(by_u, by_v);
                    all.distortion.push([s1 / s2, s1 * s2]);
                    let here = first + i * (nv + 1) + j;
                    all.edges.extend((j > 0).then(|| [here - 1, here].map(|k| k as u32)));
                    all.edges.extend((i > 0).then(|| [here - (nv + 1), here].map(|k| k as u32)));
                    if i > 0 && j > 0 {
                        all.faces.push([here - nv - 2, here - 1, here, here - nv - 1].map(|k| k as u32));
                    }
                }
            }
        }
        all
    }
}

/// Particles and the nets that they make.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Particles {
    /// Position in voxels and (u, v, w).
    pub places: Vec<(DVec3, DVec3)>,
    /// Of each particle s1/s2 and s1·s2 of the map from a texture of the patch's edge lengths to the net, as of [`Distortion`].
    pub distortion: Vec<[f64; 2]>,
    /// Edges of the nets: pairs of particles.
    pub edges: Vec<[u32; 2]>,
    /// Cells of the nets: particles (0, 0), (0, 1), (1, 1), (1, 0) in (u, v).
    pub faces: Vec<[u32; 4]>,
}

impl Particles {
    /// Adds those of another patch.
    pub fn append(&mut self, other: Self) {
        let first = self.places.len() as u32;
        self.places.extend(other.places);
        self.distortion.extend(other.distortion);
        self.edges.extend(other.edges.into_iter().map(|e| e.map(|v| v + first)));
        self.faces.extend(other.faces.into_iter().map(|f| f.map(|v| v + first)));
    }
}

/// The distance field around a patch that is to be.
struct Space {
    field: Field,
    /// In voxels, negative downwards.
    height: f64,
    depth: f64,
}

impl Space {
    /// Around a net (in voxels), as far as the height.
    fn around(
        base: &LevelSet,
        net: &Net,
        height: f64,
        parameterization: &Parameterization,
        run: &RunOptions,
    ) -> Result<Self> {
        let (h, depth) = (base.voxel_size(), f64::from(base.half_width()) + BEYOND);
        let along_curve = matches!(parameterization, Parameterization::Spline(_));
        let voxels = if along_curve { depth } else { height / h };
        if !(voxels.abs() >= 1.0 && voxels.abs() <= LARGEST) {
            let accepted = format!("{h} to {} (1 to {LARGEST} voxels), or as much downwards", LARGEST * h);
            return Err(EditError::parameter(OPERATION, "height", height, accepted));
        }
        // Where the particles go if nothing is in their way.
        let mut sampler = base.sampler();
        let mut points = net.points.clone();
        let normals: Vec<DVec3> = net.points.iter().map(|p| sampler.smooth_gradient(*p).normalize_or_zero()).collect();
        for (p, normal) in net.points.iter().zip(&normals) {
            points.extend([*p + *normal * voxels, *p - *normal * (depth * voxels.signum())]);
        }
        if let Parameterization::LowDistortion(Some(directions)) = parameterization {
            let to_index = base.transform().to_index().matrix3;
            for (p, d) in net.corners().into_iter().zip(directions) {
                points.push(p + (to_index * *d).normalize_or_zero() * (voxels * STEEPEST));
            }
        }
        let bounds = bounds(&points, voxels.abs() * ASIDE + MARGIN, "corners")?;
        let nodes = if is_sharp(net, &normals) { ABOVE_SHARP } else { ABOVE };
        let field = Field::new(base, bounds, voxels.abs() * ASIDE, nodes, run)?;
        Ok(Self { field, height: voxels, depth })
    }

    fn patch(self, net: Net, parameterization: &Parameterization, run: &RunOptions) -> Result<Patch> {
        let Self { field, height, depth } = self;
        let transform = *field.transform();
        let [bottom, left] = net.edges();
        let mut lengths = DVec3::new(bottom, left, height.abs());
        let of = if height > 0.0 { Heights::raised } else { Heights::sunk };
        let heights = of(height.abs(), depth, net.spacing().max(SPACING));
        let volume = match parameterization {
            Parameterization::Conforming => Volume::conforming(&field, net, &heights),
            Parameterization::LowDistortion(directions) => {
                let directions = directions.map(|d| d.map(|d| (transform.to_index().matrix3 * d).normalize_or_zero()));
                Volume::low_distortion(&field, net, &heights.coarser(), SPACING, directions).ok_or_else(|| {
                    let accepted =
                        "a smaller height, or the conforming parameterization: a level above the patch ends or folds";
                    EditError::parameter(OPERATION, "height", height * transform.voxel_size(), accepted)
                })?
            }
            Parameterization::Spline(points) => {
                let middle = net.bilinear(0.5, 0.5);
                let normal = Level::new(&field, 0.0).probe().normal(middle).ok_or_else(|| broken(OPERATION))?;
                let mut curve = vec![middle];
                curve.extend(points.iter().map(|p| transform.world_to_index(*p)));
                curve.dedup_by(|a, b| a.distance(*b) < 1.0);
                let longest = curve.windows(2).map(|w| w[0].distance(w[1])).sum::<f64>();
                if !(curve.len() >= 2 && longest <= LARGEST) {
                    let accepted = format!("points that lead up to {LARGEST} voxels away from the patch");
                    return Err(EditError::parameter(OPERATION, "spline", points.len(), accepted));
                }
                // It leaves the surface along the normal.
                curve.insert(1, middle + normal * (curve[1].distance(middle) * UPRIGHT));
                let (volume, length) = Volume::along_spline(&field, net, &curve, normal, depth, SPACING);
                lengths.z = length;
                volume
            }
        };
        run.check(OPERATION)?;
        Ok(Patch { volume, cells: OnceLock::new(), lengths, raised: height > 0.0, depth })
    }
}

/// Whether the surface turns sharply between neighbouring points of a net.
fn is_sharp(net: &Net, normals: &[DVec3]) -> bool {
    let [nu, nv] = net.counts;
    let turned = |a: usize, b: usize| normals[a].dot(normals[b]) < SHARP;
    (0..=nu).any(|i| {
        (0..=nv).any(|j| {
            let at = i * (nv + 1) + j;
            (i > 0 && turned(at - nv - 1, at)) || (j > 0 && turned(at - 1, at))
        })
    })
}

/// The box around points and so much more; refused where it is too far away for voxels.
fn bounds(points: &[DVec3], more: f64, what: &str) -> Result<(DVec3, DVec3)> {
    let lo = points.iter().copied().fold(DVec3::INFINITY, DVec3::min) - more;
    let hi = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max) + more;
    let farthest = lo.abs().max(hi.abs()).max_element();
    if !farthest.is_finite() || farthest > f64::from(MAX_COORD) {
        let accepted = "a place within 2^30 voxels of the origin";
        return Err(EditError::parameter(OPERATION, what, format!("{lo} to {hi}, in voxels"), accepted));
    }
    Ok((lo, hi))
}

/// Part of the way to the first point of a spline along which it goes with the normal.
const UPRIGHT: f64 = 0.25;
