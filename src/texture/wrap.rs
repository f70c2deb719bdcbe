//! A texture in the space above a patch.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::cells::{Cells, Distortion};
use super::level::Level;
use super::patch::{broken, corners_on_surface, patch};
use super::volume::{Heights, Volume};
use crate::error::{EditError, Result};
use crate::grid::{LeafMask, LeafValues, MAX_COORD, offset_to_local};
use crate::levelset::{BYTES_A_LEAF, LevelSet, Sampler, grid_of_leaves};
use crate::mesh::{Rebuild, level_set_to_mesh, rebuild, widened, with_half_width};
use crate::run::RunOptions;

const OPERATION: &str = "texture";

/// Spacing of particles along the patch and across it, in voxels.
const SPACING: f64 = 2.0;

/// How far a corner may lie from the surface, as a part of the longest edge, and in voxels at least.
const CORNER_REACH: f64 = 0.25;
const LEAST_CORNER_REACH: f64 = 5.0;

/// Largest patch and height, in voxels.
const LARGEST: f64 = 4000.0;

/// How particles are distributed above a patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Parameterization {
    /// Each follows the normal.
    Conforming,
    /// Each level has an even net of its own; the corners climb along directions (world space) if there are any.
    LowDistortion(Option<[DVec3; 4]>),
}

/// Where a texture goes, in world units.
#[derive(Clone, Debug, PartialEq)]
pub struct Placement {
    /// The patch, counter-clockwise seen from outside; brought to the surface.
    pub corners: [DVec3; 4],
    /// How high the texture stands; if negative, how deep it goes.
    pub height: f64,
    /// How often it is repeated along u and v.
    pub tile: [u32; 2],
    /// How far it is pushed into the surface, or out of it if it goes down, so that the two are sure to meet.
    pub push: f64,
    /// How the space above the patch is divided.
    pub parameterization: Parameterization,
}

/// A patch with the space above it.
pub struct Patch {
    volume: Volume,
    cells: Cells,
    /// Lengths of the edges p1p2 and p1p4 and the height, in voxels.
    lengths: DVec3,
}

impl Patch {
    /// Spans a patch on `base` and the space above it.
    pub fn new(base: &LevelSet, placement: &Placement, run: &RunOptions) -> Result<Self> {
        let (transform, h) = (base.transform(), base.voxel_size());
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter(OPERATION, field, value, accepted));
        let height = placement.height.abs() / h;
        if !(height >= 1.0 && height <= LARGEST) {
            let accepted = format!("{h} to {} (1 to {LARGEST} voxels)", LARGEST * h);
            return refuse("height", placement.height.to_string(), &accepted);
        }
        let corners = placement.corners.map(|p| transform.world_to_index(p));
        let longest = (0..4).map(|k| corners[k].distance(corners[(k + 1) % 4])).fold(0.0, f64::max);
        if !(longest <= LARGEST) {
            let accepted = format!("corners at most {} apart ({LARGEST} voxels)", LARGEST * h);
            return refuse("corners", format!("{:?}", placement.corners.map(|p| p.to_array())), &accepted);
        }
        let reach = (CORNER_REACH * longest).max(LEAST_CORNER_REACH);
        let corners = corners_on_surface(base, corners, reach).map_err(|problem| {
            EditError::parameter(
                OPERATION,
                "corners",
                format!("{:?}", placement.corners.map(|p| p.to_array())),
                problem,
            )
        })?;
        // The levels above the patch, and the layer under it.
        let depth = f64::from(base.half_width()) + 2.0;
        let around = height + longest / 2.0 + 8.0;
        let lo = corners.into_iter().fold(corners[0], DVec3::min) - around;
        let hi = corners.into_iter().fold(corners[0], DVec3::max) + around;
        if lo.abs().max(hi.abs()).max_element() > f64::from(MAX_COORD) {
            return refuse(
                "corners",
                format!("{:?}", placement.corners.map(|p| p.to_array())),
                "a place within 2^30 voxels of the origin",
            );
        }
        let wanted = |first: IVec3, last: IVec3| first.as_dvec3().cmple(hi).all() && last.as_dvec3().cmpge(lo).all();
        let field = widened(base, (height.max(depth) + 3.0) as f32, wanted, run)?;
        run.check(OPERATION)?;
        let net = patch(Level::new(&field, 0.0), corners, SPACING, None).ok_or_else(|| broken(OPERATION))?;
        let [bottom, left] = net.edges();
        let lengths = DVec3::new(bottom, left, height);
        let of = if placement.height > 0.0 { Heights::raised } else { Heights::sunk };
        let heights = of(height, depth, SPACING);
        run.check(OPERATION)?;
        let volume = match placement.parameterization {
            Parameterization::Conforming => Volume::conforming(&field, net, &heights),
            Parameterization::LowDistortion(directions) => {
                let directions = directions.map(|d| d.map(|d| (transform.to_index().matrix3 * d).normalize_or_zero()));
                Volume::low_distortion(&field, net, &heights, SPACING, directions).ok_or_else(|| {
                    let accepted =
                        "a smaller height, or the conforming parameterization: a level above the patch ends or folds";
                    EditError::parameter(OPERATION, "height", placement.height, accepted)
                })?
            }
        };
        let cells = Cells::new(&volume);
        Ok(Self { volume, cells, lengths })
    }

    /// Distortion of the map from a texture of this patch's edge lengths and height.
    pub fn distortion(&self) -> Distortion {
        self.cells.distortion(self.lengths)
    }

    /// The place in voxels of (u, v, w) in 0..1³: the semi-implicit map.
    pub fn place(&self, uvw: DVec3) -> DVec3 {
        self.volume.at(uvw)
    }

    /// (u, v, w) of a place in voxels, `None` outside the space above the patch; w is negative down to a few voxels under the surface.
    pub fn find(&self, ijk: DVec3) -> Option<DVec3> {
        self.cells.find(ijk)
    }
}

/// The texture as it lies on the patch, on the lattice of `base` and with its half width, with exact distances. Its bounding box becomes the
/// patch: x → u, y → v, z → w.
pub fn wrapped(
    base: &LevelSet,
    texture: &LevelSet,
    patch: &Patch,
    placement: &Placement,
    run: &RunOptions,
) -> Result<LevelSet> {
    let (transform, half_width) = (*base.transform(), base.half_width());
    let Some((lo, hi)) = level_set_to_mesh(texture, 0.0, run)?.bounding_box() else {
        return Ok(LevelSet::empty(transform, half_width));
    };
    let size = hi - lo;
    let tile = placement.tile.map(|n| f64::from(n.max(1)));
    // World units of the texture a voxel of the base, at most.
    let stretch = patch.cells.largest_stretch(size * DVec3::new(tile[0], tile[1], 1.0));
    // A band that tells whole leaves without the texture's surface.
    let band = (LEAF_REACH + f64::from(half_width)) * stretch / texture.voxel_size();
    let widest = f64::from(texture.half_width()).max(WIDEST);
    let texture = with_half_width(texture, band.clamp(f64::from(texture.half_width()), widest) as f32, run)?;
    let push = placement.push.abs() / placement.height.abs();
    // The faces on the surface go on into it, or out of it: what is just inside of them.
    let rim = (1.5 * texture.voxel_size() / size.z).min(0.5);
    let raised = placement.height > 0.0;
    let repeated = |t: f64, n: f64| t * n - (t * n).floor().clamp(0.0, n - 1.0);
    // In voxels of the base, at most the distance.
    let distance = |probe: &mut Sampler, own: &mut Sampler, ijk: DVec3| {
        let uvw = patch.find(ijk)?;
        let w = if raised { (uvw.z + push).max(rim) } else { (uvw.z - push).min(1.0 - rim) };
        let at = lo + size * DVec3::new(repeated(uvw.x, tile[0]), repeated(uvw.y, tile[1]), w);
        let phi = f64::from(probe.trilinear(texture.transform().world_to_index(at))) / stretch;
        if raised && uvw.z < 0.0 && phi < 0.0 {
            // Not out of the other side of a thin wall.
            return Some(phi.max(f64::from(own.trilinear(ijk)) / base.voxel_size()));
        }
        Some(phi)
    };
    let background = transform.voxel_size() * f64::from(half_width);
    let leaves = patch.cells.leaves();
    run.reserve(OPERATION, leaves.len() as u64 * BYTES_A_LEAF, "take a smaller patch or height, or larger voxels")?;
    let task = run.task("wrapping", leaves.len() as u64);
    let made = leaves.into_par_iter().map_init(
        || (texture.sampler(), base.sampler()),
        |(probe, own), origin| {
            if run.is_cancelled() {
                return None;
            }
            task.advance(1);
            let centre = origin.as_dvec3() + 3.5;
            if distance(probe, own, centre).is_some_and(|d| d.abs() > LEAF_REACH + f64::from(half_width)) {
                return None;
            }
            let mut values = LeafValues::filled(background as f32);
            let mut mask = LeafMask::EMPTY;
            for (offset, value) in values.0.iter_mut().enumerate() {
                let ijk = (origin + offset_to_local(offset)).as_dvec3();
                if let Some(d) = distance(probe, own, ijk) {
                    let d = d * transform.voxel_size();
                    *value = d.clamp(-background, background) as f32;
                    mask.set(offset, d.abs() < background);
                }
            }
            (!mask.is_empty()).then_some((origin, values, mask))
        },
    );
    let made: Vec<_> = made.flatten().collect();
    run.check(OPERATION)?;
    let sampled = LevelSet::new(grid_of_leaves(background as f32, made), transform);
    rebuild(&sampled, &Rebuild::band(half_width), run)
}

/// From the centre of a leaf to its outermost voxels.
const LEAF_REACH: f64 = 6.1;

/// Widest band that a texture gets, in voxels.
const WIDEST: f64 = 24.0;
