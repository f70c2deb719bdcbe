//! Index space ↔ world space, uniform: rotation, one scale, translation.

use glam::{BVec3, DAffine3, DMat3, DVec3, IVec3};

/// Relative difference of axis lengths, and cosine between axes, up to which a transform counts as uniform and unsheared.
/// Files store matrices in f64; products of a few rotations stay below 1e-12, and a real anisotropy is never this small.
const UNIFORM_TOLERANCE: f64 = 1e-7;

/// Edges of a voxel, in world units, between which the products of distances in f32 neither vanish nor overflow (WENO5 and the
/// curvature go up to the fourth power of a distance times small numbers).
pub const VOXEL_SIZES: std::ops::RangeInclusive<f64> = 1e-9..=1e9;

/// The placement of a grid in the world: `xyz = linear · ijk + translation`, voxels cubic with edge [`voxel_size`](Self::voxel_size).
///
/// Voxel values sit at integer `ijk`. Mirrored transforms (negative determinant) are uniform too.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    to_world: DAffine3,
    to_index: DAffine3,
    voxel_size: f64,
}

impl Transform {
    /// Voxels of edge `voxel_size` (world units), `ijk = 0` at the world's origin. `voxel_size` must be positive and finite.
    pub fn uniform(voxel_size: f64) -> Self {
        debug_assert!(voxel_size > 0.0 && voxel_size.is_finite());
        let to_world = DAffine3::from_scale(DVec3::splat(voxel_size));
        Self { to_world, to_index: to_world.inverse(), voxel_size }
    }

    /// A transform from its affine map, or the reason why a level set cannot live on it.
    pub fn from_affine(to_world: DAffine3) -> Result<Self, String> {
        let DMat3 { x_axis: x, y_axis: y, z_axis: z } = to_world.matrix3;
        let sizes = [x.length(), y.length(), z.length()];
        // Of three equal sizes it is that size to the last bit: a transform comes back from a file as it was.
        let mean = sizes[0] + ((sizes[1] - sizes[0]) + (sizes[2] - sizes[0])) / 3.0;
        if !(mean.is_finite() && mean > 0.0 && to_world.translation.is_finite()) {
            return Err("its transform is not invertible".into());
        }
        if !VOXEL_SIZES.contains(&mean) {
            let (least, most) = (VOXEL_SIZES.start(), VOXEL_SIZES.end());
            return Err(format!("its voxels of {mean:e} world units are not between {least:e} and {most:e}"));
        }
        if sizes.iter().any(|s| (s - mean).abs() > UNIFORM_TOLERANCE * mean) {
            return Err(format!("its voxels are not cubes ({} x {} x {})", sizes[0], sizes[1], sizes[2]));
        }
        if [x.dot(y), y.dot(z), z.dot(x)].iter().any(|d| d.abs() > UNIFORM_TOLERANCE * mean * mean) {
            return Err("its transform is sheared".into());
        }
        Ok(Self { to_world, to_index: to_world.inverse(), voxel_size: mean })
    }

    /// Edge of a voxel in world units.
    pub fn voxel_size(&self) -> f64 {
        self.voxel_size
    }

    /// The affine map index → world.
    pub fn to_world(&self) -> DAffine3 {
        self.to_world
    }

    /// The affine map world → index.
    pub fn to_index(&self) -> DAffine3 {
        self.to_index
    }

    /// World position of an index-space position.
    pub fn index_to_world(&self, ijk: DVec3) -> DVec3 {
        self.to_world.transform_point3(ijk)
    }

    /// World position of a voxel.
    pub fn voxel_to_world(&self, ijk: IVec3) -> DVec3 {
        self.index_to_world(ijk.as_dvec3())
    }

    /// Index-space position of a world position.
    pub fn world_to_index(&self, xyz: DVec3) -> DVec3 {
        self.to_index.transform_point3(xyz)
    }

    /// Index-space box around a world-space box, both as their lowest and highest corner.
    pub fn box_to_index(&self, (lo, hi): (DVec3, DVec3)) -> (DVec3, DVec3) {
        let corner = |c: u8| DVec3::select(BVec3::new(c & 1 == 1, c & 2 == 2, c & 4 == 4), hi, lo);
        let corners = (0..8).map(|c| self.world_to_index(corner(c)));
        corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)))
    }

    /// World direction of an index-space direction: rotated, not scaled.
    pub fn direction_to_world(&self, direction: DVec3) -> DVec3 {
        self.to_world.transform_vector3(direction) / self.voxel_size
    }

    /// Index-space direction of a world direction: rotated, not scaled.
    pub fn direction_to_index(&self, direction: DVec3) -> DVec3 {
        self.to_index.transform_vector3(direction) * self.voxel_size
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_refusals() {
        let rotated = DAffine3::from_scale_rotation_translation(
            DVec3::splat(0.05),
            glam::DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7),
            DVec3::new(4.0, -5.0, 6.0),
        );
        let transform = Transform::from_affine(rotated).unwrap();
        let ijk = DVec3::new(-7.25, 100.0, 3.5);
        assert!((transform.world_to_index(transform.index_to_world(ijk)) - ijk).length() < 1e-10);
        assert!((transform.voxel_size() - 0.05).abs() < 1e-15);
        for size in [0.05, 0.1, 0.7, 1.0 / 3.0] {
            let uniform = Transform::uniform(size);
            assert_eq!(Transform::from_affine(uniform.to_world()), Ok(uniform));
        }

        let flat = DAffine3::from_scale(DVec3::new(0.01, 0.02, 0.01));
        assert!(Transform::from_affine(flat).unwrap_err().contains("not cubes"));
        let mut sheared = DAffine3::IDENTITY;
        sheared.matrix3.y_axis = DVec3::new(0.5, 0.75f64.sqrt(), 0.0);
        assert!(Transform::from_affine(sheared).unwrap_err().contains("sheared"));
        assert!(Transform::from_affine(DAffine3::from_scale(DVec3::ZERO)).is_err());
        for size in [1e-20, 1e20] {
            assert!(Transform::from_affine(DAffine3::from_scale(DVec3::splat(size))).unwrap_err().contains("between"));
        }
    }
}
