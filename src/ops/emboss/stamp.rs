//! Stamps: a layer of given height over the part of a surface that an outline or a picture covers.
//!
//! The surface around a point is laid flat ([`Patch`]); over a point of it with flat coordinates (u, v), height d:
//!
//! > L = max(d − H(u, v), −d − s, O(u, v))
//!
//! with the height H, the signed distance O to the outline in the plane, and a depth s by which the layer reaches below the surface. L < 0
//! is the layer; its zero set is polygonised and its distances are made exact, and the layer is united with the solid, or cut out of it.
//! So edges are as sharp as the voxels allow, nothing flows, and what the layer does not reach keeps its bits.

use glam::{DVec2, DVec3};

use super::outline::Outline;
use super::patch::Patch;
use super::picture::Picture;
use crate::error::{EditError, Result};
use crate::grid::MAX_COORD;
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild};
use crate::ops::csg::{CsgOperation, csg};
use crate::region::Region;
use crate::run::RunOptions;

/// What is stamped, in voxels, around the origin of the plane.
pub(super) enum Motif {
    /// What an outline fills, at full height.
    Outline(Outline),
    /// A picture over its rectangle, at the height of its brightness.
    Picture(Picture),
}

/// A motif with its size and height.
pub(super) struct Stamp {
    pub motif: Motif,
    /// Width and height in the plane, in voxels.
    pub size: DVec2,
    /// How far it stands out, in voxels; negative is engraved.
    pub height: f64,
}

/// The part by which lengths may be stretched where the patch is laid flat, up to which blocks of space are safely passed over.
const STRETCH: f64 = 2.0;

impl Stamp {
    /// Signed distance in the plane to the outline.
    fn outline(&self, flat: DVec2) -> f64 {
        match &self.motif {
            Motif::Outline(outline) => outline.distance(flat),
            Motif::Picture(_) => {
                let q = flat.abs() - self.size / 2.0;
                q.max(DVec2::ZERO).length() + q.max_element().min(0.0)
            }
        }
    }

    /// Part of the height at a place.
    fn level(&self, flat: DVec2) -> f64 {
        match &self.motif {
            Motif::Outline(_) => 1.0,
            Motif::Picture(picture) => picture.at(flat / self.size + 0.5),
        }
    }

    /// The radius of the patch that it needs.
    pub fn radius(&self) -> f64 {
        self.size.length() / 2.0 + 4.0
    }

    /// Stamps a surface laid flat; where `region` is 0 nothing changes, and in between the height is as much less.
    pub fn on(
        &self,
        level_set: &LevelSet,
        patch: &Patch,
        region: Option<&dyn Region>,
        run: &RunOptions,
    ) -> Result<LevelSet> {
        let height = self.height.abs();
        let raised = self.height > 0.0;
        // Deep enough that distances below the surface are not those to the bottom of the layer.
        let sunk = f64::from(level_set.half_width()) + 2.0;
        let transform = *level_set.transform();
        let layer = |ijk: DVec3| {
            let Some(place) = patch.locate(ijk) else { return f64::INFINITY };
            let outline = self.outline(place.flat);
            // Far from the outline there is no need to look closer.
            let reach = height + sunk;
            if outline > 2.0 * reach {
                return outline.max(place.height.abs() - reach) / STRETCH;
            }
            let alpha = region.map_or(1.0, |region| f64::from(region.weight(transform.index_to_world(ijk))));
            let top = height * alpha * self.level(place.flat);
            let (above, mut below) = match raised {
                true => (place.height, -place.height),
                false => (-place.height, place.height),
            };
            below -= sunk;
            let mut value = (above - top).max(below).max(outline);
            if above < 0.0 && value < 0.0 {
                // Not out of the other side of a thin wall, nor into the next one.
                let phi = f64::from(level_set.sampler().trilinear(ijk)) / level_set.voxel_size();
                value = value.max(if raised { phi } else { -phi });
            }
            if alpha == 0.0 {
                value = value.max(0.5);
            }
            value / STRETCH
        };
        let reach = self.radius() + height + 2.0 * sunk;
        let (lo, hi) = (patch.centre - reach, patch.centre + reach);
        if lo.abs().max(hi.abs()).max_element() > f64::from(MAX_COORD) {
            let accepted = "a place within 2^30 voxels of the origin";
            return Err(EditError::parameter("emboss", "size", self.size.x * level_set.voxel_size(), accepted));
        }
        let bounds = (lo.floor().as_ivec3(), hi.ceil().as_ivec3());
        let half_width = level_set.half_width();
        let sampled = LevelSet::from_distance(transform, half_width, bounds, layer, run)?;
        let tool = rebuild(&sampled, &Rebuild::band(half_width), run)?;
        let operation = if raised { CsgOperation::Union } else { CsgOperation::Difference };
        let mut result = csg(level_set, &[&tool], operation, run)?;
        if let Some(region) = region {
            result = crate::ops::keep::kept(result, level_set, region, run)?;
        }
        Ok(result)
    }

    /// A box in the plane around it: whether it holds a place.
    pub fn covers(&self, flat: DVec2) -> bool {
        flat.abs().cmple(self.size / 2.0).all()
    }
}
