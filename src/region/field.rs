//! Regions given by fields: inside a level set, near one, a painted volume, a component of the level set itself.

use glam::DVec3;

use super::{Region, ramp, ramp_between};
use crate::grid::Volume;
use crate::levelset::{Components, LevelSet};

/// The inside of a level set: α = P(−φ; 0, depth), 0 on its surface and 1 at `depth` below it.
pub struct Inside {
    level_set: LevelSet,
    /// World units; at most the half width of the band, beyond which φ is not known.
    depth: f64,
}

impl Inside {
    /// The inside of `level_set`, full at `depth` (world units) below its surface, or at the end of its band if that comes first.
    pub fn new(level_set: LevelSet, depth: f64) -> Self {
        // φ of the deepest inside voxels is −background: there α has to be 1.
        let depth = depth.min(f64::from(level_set.background()));
        Self { level_set, depth }
    }
}

impl Region for Inside {
    fn weight(&self, xyz: DVec3) -> f32 {
        let phi = self.level_set.sampler().trilinear(self.level_set.transform().world_to_index(xyz));
        ramp(f64::from(-phi) / self.depth) as f32
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        Some(self.level_set.world_bounds().unwrap_or((DVec3::ZERO, DVec3::ZERO)))
    }
}

/// Both sides of a surface: α = 1 − P(|φ|; d_min, d_max).
pub struct NearSurface {
    level_set: LevelSet,
    reach: [f64; 2],
}

impl NearSurface {
    /// Full within `reach[0]` of the surface, nothing beyond `reach[1]` (world units), which the band has to reach.
    pub fn new(level_set: LevelSet, reach: [f64; 2]) -> Self {
        let band = f64::from(level_set.background());
        Self { level_set, reach: reach.map(|d| d.min(band)) }
    }
}

impl Region for NearSurface {
    fn weight(&self, xyz: DVec3) -> f32 {
        let phi = self.level_set.sampler().trilinear(self.level_set.transform().world_to_index(xyz));
        (1.0 - ramp_between(f64::from(phi).abs(), self.reach[0], self.reach[1])) as f32
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        Some(self.level_set.world_bounds().unwrap_or((DVec3::ZERO, DVec3::ZERO)))
    }
}

/// A volume whose values are α, interpolated linearly and clamped to 0..1: painted masks, densities of fog.
pub struct Painted(pub Volume);

impl Region for Painted {
    fn weight(&self, xyz: DVec3) -> f32 {
        self.0.trilinear(xyz).clamp(0.0, 1.0)
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        // Where the background is above 0 there is no end.
        if self.0.background() > 0.0 { None } else { Some(self.0.world_bounds().unwrap_or((DVec3::ZERO, DVec3::ZERO))) }
    }
}

/// A connected part of a level set: α = 1 where the closest surface point belongs to it.
pub struct Part {
    level_set: LevelSet,
    components: Components,
    label: u32,
}

impl Part {
    /// Component `label` (0 is the largest) of `level_set`.
    pub fn new(level_set: LevelSet, components: Components, label: u32) -> Self {
        Self { level_set, components, label }
    }
}

impl Region for Part {
    fn weight(&self, xyz: DVec3) -> f32 {
        let ijk = self.level_set.transform().world_to_index(xyz);
        let surface = self.level_set.sampler().closest_point(ijk).unwrap_or(ijk);
        let label = self.components.nearest(surface).or_else(|| self.components.nearest(ijk));
        f32::from(u8::from(label == Some(self.label)))
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, sampled};
    use crate::run::RunOptions;

    #[test]
    fn inside_a_level_set_the_weight_rises_with_depth() {
        let region = Inside::new(ball(DVec3::ZERO, 10.0), 2.0);
        for (r, w) in [(11.0, 0.0), (10.0, 0.0), (9.0, 0.5), (8.0, 1.0), (0.0, 1.0)] {
            assert!((region.weight(DVec3::X * r) - w).abs() < 0.02, "{r}");
        }
        // Deeper than the band is known nowhere: full at the end of the band.
        assert_eq!(Inside::new(ball(DVec3::ZERO, 10.0), 9.0).weight(DVec3::ZERO), 1.0);
        let (lo, hi) = region.bounds().unwrap();
        assert!(lo.max_element() <= -9.0 && hi.min_element() >= 9.0);
    }

    #[test]
    fn a_component_is_told_from_its_neighbour() {
        let centres = [DVec3::new(-8.0, 0.0, 0.0), DVec3::new(6.0, 0.0, 0.0)];
        let two = sampled(20, move |p| ((p - centres[0]).length() - 6.0).min((p - centres[1]).length() - 5.0));
        let components = two.components(&RunOptions::default()).unwrap();
        let small = Part::new(two, components, 1);
        for (x, w) in [(6.0, 1.0), (2.0, 1.0), (0.5, 1.0), (-2.5, 0.0), (-8.0, 0.0)] {
            assert_eq!(small.weight(DVec3::X * x), w, "{x}");
        }
    }
}
