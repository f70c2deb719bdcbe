//! Where patches are: four corners, a point with a direction, or all over the surface.

use std::path::Path;

use glam::{DVec2, DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::{PARALLEL, Texture};
use crate::error::{EditError, Result};
use crate::grid::offset_to_local;
use crate::levelset::LevelSet;
use crate::ops::confine::cut_out;
use crate::ops::emboss::{Flat, read_polylines};
use crate::ops::params::Vector;
use crate::ops::registry::Operator;
use crate::run::RunOptions;
use crate::spec::Spec;
use crate::texture::Net;

/// Most patches.
const MOST_PATCHES: usize = 10_000;

/// Cells along an edge of a patch around a centre, per voxel and at most.
const CELL: f64 = 2.0;
const MOST_CELLS: usize = 48;

/// How far a centre may lie from the surface, in radii.
const CENTER_REACH: f64 = 1.0;

/// Part of a patch around a centre that may lie folded: slivers among the triangles.
const FOLDED: f64 = 0.005;

/// Where a patch is, in world units.
pub(super) enum Place {
    Corners([DVec3; 4]),
    Around { center: DVec3, direction: Option<DVec3>, radius: f64 },
}

/// Where patches are to be.
pub(super) struct Places {
    pub list: Vec<Place>,
    /// How many are wanted of those scattered, of which some may not do; `None` where each was asked for.
    pub scattered: Option<usize>,
}

impl Places {
    fn all(list: Vec<Place>) -> Self {
        Self { list, scattered: None }
    }
}

impl Texture {
    pub(super) fn places(&self, base: &LevelSet, run: &RunOptions) -> Result<Places> {
        if let Some(path) = &self.corners_file {
            return corners_of_file(path).map(Places::all);
        }
        if let Some(text) = &self.scatter {
            return Scatter::parse(text)?.places(base, self.direction.map(|d| d.0), run);
        }
        if let (Some(center), Some(radius)) = (self.center, self.radius) {
            let radius = radius.world(base.voxel_size());
            let place = Place::Around { center: center.0, direction: self.direction.map(|d| d.0), radius };
            return Ok(Places::all(vec![place]));
        }
        let corners: std::result::Result<[Vector; 4], _> = self.corners.clone().try_into();
        Ok(Places::all(corners.map(|c| Place::Corners(c.map(|v| v.0))).into_iter().collect()))
    }

    /// The points of `spline`, typed or in a file.
    pub(super) fn spline_points(&self) -> Result<Vec<DVec3>> {
        let text = self.spline.as_deref().unwrap_or_default();
        let points: Option<Vec<DVec3>> =
            text.split_whitespace().map(|p| p.parse::<Vector>().map(|v| v.0).ok()).collect();
        if let Some(points) = points.filter(|points| !points.is_empty()) {
            return Ok(points);
        }
        let path = Path::new(text);
        if !path.exists() {
            let accepted = "points `x,y,z x,y,z …`, or a file of them";
            return Err(EditError::parameter(Self::NAME, "spline", text, accepted));
        }
        Ok(read_polylines(path)?.into_iter().next().unwrap_or_default())
    }

    /// A square net around a point by the exponential map.
    pub(super) fn net(
        &self,
        part: &LevelSet,
        center: DVec3,
        direction: Option<DVec3>,
        radius: f64,
        run: &RunOptions,
    ) -> Result<Net> {
        let transform = part.transform();
        let refuse = |accepted: &str| {
            Err(EditError::parameter(Self::NAME, "center", format!("{center} with the radius {radius}"), accepted))
        };
        let voxels = radius / part.voxel_size();
        let frame = |normal: DVec3| {
            let normal = transform.direction_to_world(normal).normalize_or_zero();
            let along = match direction {
                None => normal.any_orthonormal_vector(),
                Some(d) => {
                    let along = d - normal * d.dot(normal);
                    if along.length() < PARALLEL * d.length() {
                        let accepted = format!("a direction along the surface, whose normal here is {normal}");
                        return Err(EditError::parameter(Self::NAME, "direction", d, accepted));
                    }
                    along.normalize()
                }
            };
            let back = transform.to_index().matrix3;
            Ok(((back * along).normalize_or_zero(), (back * normal.cross(along)).normalize_or_zero()))
        };
        let at = transform.world_to_index(center);
        let flat = Flat::new(part, at, voxels * 2.0f64.sqrt(), (voxels * CENTER_REACH).max(4.0), frame, run)
            // Its map is shared with stamps, whose centre is called `at`.
            .map_err(|error| match error {
                EditError::Parameter { field, value, accepted, .. } if field == "at" => {
                    EditError::parameter(Self::NAME, "center", value, accepted)
                }
                error => error,
            })?;
        let n = ((2.0 * voxels / CELL).ceil() as usize).clamp(4, MOST_CELLS);
        let mut net = Net { counts: [n, n], points: Vec::with_capacity((n + 1) * (n + 1)) };
        for i in 0..=n {
            for j in 0..=n {
                let to = |k: usize| (2.0 * k as f64 / n as f64 - 1.0) * voxels;
                let Some((p, _)) = flat.lift(DVec2::new(to(i), to(j))) else {
                    return refuse(
                        "a smaller radius, or another place: the surface cannot be laid flat as far as that",
                    );
                };
                net.points.push(p);
            }
        }
        if flat.folded(|p| p.abs().max_element() <= voxels) > FOLDED {
            return refuse("a smaller radius, or another place: the patch folds over");
        }
        Ok(net)
    }
}

impl Place {
    /// About as wide as the patch is along u.
    pub fn width(&self) -> f64 {
        match self {
            Self::Corners([p1, p2, ..]) => p1.distance(*p2),
            Self::Around { radius, .. } => 2.0 * radius,
        }
    }

    /// The part of the base that the patch and the space above it are in.
    pub fn part_of(&self, base: &LevelSet, height: f64, run: &RunOptions) -> Result<LevelSet> {
        let (lo, hi, around) = match self {
            Self::Corners(corners) => {
                let lo = corners.iter().copied().fold(DVec3::INFINITY, DVec3::min);
                let hi = corners.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
                (lo, hi, lo.distance(hi))
            }
            Self::Around { center, radius, .. } => (*center, *center, radius * 2.0),
        };
        let transform = base.transform();
        let corners = (0..8).map(|c| {
            let pick = |axis: usize| if c >> axis & 1 == 0 { lo[axis] } else { hi[axis] };
            transform.world_to_index(DVec3::new(pick(0), pick(1), pick(2)))
        });
        let (lo, hi) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
        let margin = (around + height) / base.voxel_size() + 4.0 * f64::from(base.half_width()) + 16.0;
        cut_out(base, (lo, hi), margin, run)
    }
}

/// Four points a line.
fn corners_of_file(path: &Path) -> Result<Vec<Place>> {
    let refuse = |problem: String| EditError::input(path, problem);
    let text = std::fs::read_to_string(path).map_err(|e| refuse(format!("cannot be read as text: {e}")))?;
    let mut places = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.split('#').next().unwrap_or_default();
        if line.trim().is_empty() {
            continue;
        }
        let points: Option<Vec<DVec3>> =
            line.split_whitespace().map(|p| p.parse::<Vector>().map(|v| v.0).ok()).collect();
        let corners = points.and_then(|points| <[DVec3; 4]>::try_from(points).ok());
        let corners = corners.ok_or_else(|| refuse(format!("line {number}: a patch is four points `x,y,z`")))?;
        places.push(Place::Corners(corners));
        if places.len() > MOST_PATCHES {
            return Err(refuse(format!("more than {MOST_PATCHES} patches")));
        }
    }
    if places.is_empty() {
        return Err(refuse("there is no patch in it: four points `x,y,z` a line".into()));
    }
    Ok(places)
}

/// Patches all over a surface.
pub(super) struct Scatter {
    spacing: f64,
    radius: f64,
    seed: u64,
    density: Option<f64>,
    count: Option<f64>,
}

impl Scatter {
    pub fn parse(text: &str) -> Result<Self> {
        let spec = Spec::parse("scatter", &format!("scatter {text}"))?;
        let scatter = Self {
            spacing: spec.length("spacing")?,
            radius: spec.length("radius")?,
            seed: spec.number("seed")?.unwrap_or(0.0).to_bits(),
            density: spec.number("density")?,
            count: spec.number("count")?,
        };
        spec.finish()?;
        Ok(scatter)
    }

    /// Centres by throwing darts: the voxels beside the surface in an order by chance, each taken that is far enough from those before.
    pub fn places(&self, base: &LevelSet, direction: Option<DVec3>, run: &RunOptions) -> Result<Places> {
        let (grid, h) = (base.grid(), base.voxel_size());
        if self.spacing < h {
            let accepted = format!("`spacing=` of a voxel or more, {h}");
            return Err(EditError::parameter(Texture::NAME, "scatter", format!("spacing={}", self.spacing), accepted));
        }
        let mut most = self.count.unwrap_or(f64::INFINITY);
        if let Some(density) = self.density {
            most = most.min((density * base.measure(run)?.area).round());
        }
        let candidates = grid.map_leaves(|id| {
            let mut sampler = base.sampler();
            let origin = grid.origin(id);
            let beside = |at: &usize| f64::from(grid.values(id).0[*at]).abs() < 0.5 * h;
            let place = |at: usize| {
                let ijk = origin + offset_to_local(at);
                let chance = [ijk.x, ijk.y, ijk.z].iter().fold(self.seed, |s, c| mixed(s ^ *c as u32 as u64));
                Some((chance, ijk.to_array(), sampler.closest_point(ijk.as_dvec3())?))
            };
            grid.mask(id).iter().filter(beside).filter_map(place).collect::<Vec<_>>()
        });
        run.check(Texture::NAME)?;
        let mut candidates: Vec<_> = candidates.into_iter().flatten().collect();
        candidates.sort_unstable_by_key(|c| (c.0, c.1));
        let spacing = self.spacing / h;
        let mut taken = FxHashMap::<[i32; 3], Vec<DVec3>>::default();
        let mut places = Vec::new();
        for (chance, _, p) in candidates {
            let cell = (p / spacing).floor().as_ivec3();
            let near = (0..27).any(|i| {
                let beside = cell + IVec3::new(i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1);
                taken.get(&beside.to_array()).is_some_and(|all| all.iter().any(|q| q.distance(p) < spacing))
            });
            if near {
                continue;
            }
            taken.entry(cell.to_array()).or_default().push(p);
            let direction = direction.or_else(|| {
                let number = |k: u64| (mixed(chance ^ k) >> 11) as f64 / (1u64 << 52) as f64 - 1.0;
                DVec3::new(number(1), number(2), number(3)).try_normalize()
            });
            places.push(Place::Around { center: base.transform().index_to_world(p), direction, radius: self.radius });
            if places.len() > MOST_PATCHES {
                let accepted = format!("a `spacing=` or `count=` with at most {MOST_PATCHES} patches");
                return Err(EditError::parameter(Texture::NAME, "scatter", self.spacing, accepted));
            }
        }
        Ok(Places { scattered: Some(most.max(0.0) as usize), list: places })
    }
}

/// A number that looks like chance (Steele, Lea and Flood 2014, SplitMix64).
fn mixed(seed: u64) -> u64 {
    let a = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let b = (a ^ (a >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let c = (b ^ (b >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    c ^ (c >> 31)
}
