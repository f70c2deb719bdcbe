//! Shapes for the tests of this module.

use glam::{DVec3, IVec3};

use super::field::Field;
use super::march::Scene;
use super::skip::SkipMap;
use crate::grid::Transform;
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// The level set of a distance in voxels within ±`reach` voxels, with the transform given.
pub fn shape(transform: Transform, half_width: f32, reach: i32, distance: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
    let bounds = (IVec3::splat(-reach), IVec3::splat(reach));
    LevelSet::from_distance(transform, half_width, bounds, distance, &RunOptions::default()).unwrap()
}

/// A sphere of `radius` voxels around the origin, voxel size 0.5.
pub fn sphere(radius: f64, half_width: f32) -> LevelSet {
    shape(Transform::uniform(0.5), half_width, (radius + f64::from(half_width)) as i32 + 2, |p| p.length() - radius)
}

pub fn scene(level_set: &LevelSet) -> Scene<'_> {
    let skip = SkipMap::new(level_set.grid()).unwrap();
    Scene { field: Field::new(level_set.grid(), level_set.voxel_size()), skip }
}
