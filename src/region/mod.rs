//! Where an operator may act, and how strongly: a weight of 0..1 at every point (Museth et al. 2002, section 4.1).
//!
//! An operator's result is (1 − α)·old + α·new. Where α = 0, every voxel that was active keeps its bits. Regions are
//! feathered by default, so that the result stays a distance at the region's rim.

mod field;
pub(crate) mod files;
mod near;
mod plan;
mod primitive;
mod voxels;
mod weights;

use glam::DVec3;

pub use field::{Inside, NearSurface, Painted, Part};
pub(crate) use files::volume as read_volume;
pub use near::Near;
pub use plan::RegionPlan;
pub use primitive::{HalfSpace, Primitive, Shape};
pub use voxels::VoxelSet;
pub use weights::{RegionWeights, touched_leaves};

/// A weight in space.
pub trait Region: Send + Sync {
    /// α in 0..1 at a world position.
    fn weight(&self, xyz: DVec3) -> f32;

    /// α at each of several positions.
    fn weights(&self, xyz: &[DVec3], alpha: &mut [f32]) {
        alpha.iter_mut().zip(xyz).for_each(|(alpha, xyz)| *alpha = self.weight(*xyz));
    }

    /// World-space box outside which α is 0; `None` if there is none.
    fn bounds(&self) -> Option<(DVec3, DVec3)>;

    /// Least and largest α that may occur in a ball; may be wider than what does. Where both are 0 or both are 1 the voxels of a leaf need no
    /// look.
    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        let touched =
            self.bounds().is_none_or(|(lo, hi)| (centre + radius).cmpge(lo).all() && (centre - radius).cmple(hi).all());
        [0.0, f32::from(u8::from(touched))]
    }
}

/// Museth's C¹ ramp P: 0 below 0, 2β² up to ½, 1 − 2(β − 1)² up to 1, then 1.
#[inline(always)]
pub fn ramp(beta: f64) -> f64 {
    // Without branches, so that loops over it are vector code.
    let beta = beta.clamp(0.0, 1.0);
    let (rising, settling) = (2.0 * beta * beta, 1.0 - 2.0 * (beta - 1.0) * (beta - 1.0));
    if beta <= 0.5 { rising } else { settling }
}

/// P stretched to rise from `low` to `high`; the step at `high` where they coincide.
#[inline(always)]
pub fn ramp_between(value: f64, low: f64, high: f64) -> f64 {
    if high <= low { f64::from(u8::from(value > high)) } else { ramp((value - low) / (high - low)) }
}

/// How regions combine.
pub enum Combined {
    /// α = Π αᵢ: where all of them act.
    All(Vec<Box<dyn Region>>),
    /// α = max αᵢ: where any of them acts.
    Any(Vec<Box<dyn Region>>),
    /// α = 1 − α: everywhere else.
    Not(Box<dyn Region>),
}

impl Region for Combined {
    fn weight(&self, xyz: DVec3) -> f32 {
        match self {
            Self::All(parts) => parts.iter().map(|p| p.weight(xyz)).product(),
            Self::Any(parts) => parts.iter().map(|p| p.weight(xyz)).fold(0.0, f32::max),
            Self::Not(part) => 1.0 - part.weight(xyz),
        }
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        match self {
            Self::All(parts) => {
                parts.iter().filter_map(|p| p.bounds()).reduce(|a, b| (a.0.max(b.0), a.1.min(b.1).max(a.0.max(b.0))))
            }
            Self::Any(parts) => parts
                .iter()
                .map(|p| p.bounds())
                .reduce(|a, b| a.zip(b).map(|(a, b)| (a.0.min(b.0), a.1.max(b.1))))
                .flatten(),
            Self::Not(_) => None,
        }
    }

    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        let of = |part: &dyn Region| part.weights_within(centre, radius);
        match self {
            Self::All(parts) => parts.iter().map(|p| of(&**p)).fold([1.0; 2], |a, b| [a[0] * b[0], a[1] * b[1]]),
            Self::Any(parts) => parts.iter().map(|p| of(&**p)).fold([0.0; 2], |a, b| [a[0].max(b[0]), a[1].max(b[1])]),
            Self::Not(part) => {
                let [low, high] = of(&**part);
                [1.0 - high, 1.0 - low]
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ramp_has_the_values_of_the_paper() {
        for (beta, p) in [(-1.0, 0.0), (0.0, 0.0), (0.25, 0.125), (0.5, 0.5), (0.75, 0.875), (1.0, 1.0), (9.0, 1.0)] {
            assert_eq!(ramp(beta), p);
        }
        assert_eq!(ramp_between(8.0, 7.0, 9.0), 0.5);
        assert_eq!((ramp_between(7.0, 7.0, 7.0), ramp_between(7.1, 7.0, 7.0)), (0.0, 1.0));
    }
}
