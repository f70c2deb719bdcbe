//! Level sets for tests, in voxels.

use glam::{DVec3, IVec3};

use super::LevelSet;
use super::build::grid_of_leaves;
use crate::grid::{LeafMask, LeafValues, Transform, offset_to_local};
use crate::run::RunOptions;

/// A distance function sampled up to `reach` voxels from the origin, voxel size and half width 1 and 3.
pub fn sampled(reach: i32, distance: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
    let bounds = (IVec3::splat(-reach), IVec3::splat(reach));
    LevelSet::from_distance(Transform::uniform(1.0), 3.0, bounds, distance, &RunOptions::default()).unwrap()
}

/// A ball.
pub fn ball(centre: DVec3, radius: f64) -> LevelSet {
    sampled((centre.abs().max_element() + radius) as i32 + 5, move |p| (p - centre).length() - radius)
}

/// A torus around z.
pub fn torus(major: f64, minor: f64) -> LevelSet {
    sampled((major + minor) as i32 + 5, move |p| (p.x.hypot(p.y) - major).hypot(p.z) - minor)
}

/// Exact distance to an axis-aligned box around the origin.
pub fn box_distance(p: DVec3, half: DVec3) -> f64 {
    let q = p.abs() - half;
    q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
}

/// A block of `leaves`³ leaves from the origin, all active inside its outermost layer of voxels, which is outside.
/// Background 3.
pub fn block(leaves: i32, value: impl Fn(IVec3) -> f32) -> LevelSet {
    let mut all = Vec::new();
    for i in 0..leaves.pow(3) {
        let origin = IVec3::new(i / (leaves * leaves), i / leaves % leaves, i % leaves) * 8;
        let mut values = LeafValues::filled(3.0);
        let mut mask = LeafMask::EMPTY;
        for (offset, v) in values.0.iter_mut().enumerate() {
            let ijk = origin + offset_to_local(offset);
            if ijk.min_element() > 0 && ijk.max_element() < leaves * 8 - 1 {
                *v = value(ijk);
                mask.set(offset, true);
            }
        }
        all.push((origin, values, mask));
    }
    LevelSet::new(grid_of_leaves(3.0, all), Transform::uniform(1.0))
}

/// A block of values in −1..1 without any order, inside with the given probability; some are exactly 0.
pub fn noise(leaves: i32, seed: u64, inside: f64) -> LevelSet {
    block(leaves, move |ijk| {
        // The finaliser of SplitMix64 on the voxel's place.
        let mut h = seed ^ (ijk.x as u64) << 40 ^ (ijk.y as u64) << 20 ^ ijk.z as u64;
        for factor in [0xbf58_476d_1ce4_e5b9, 0x94d0_49bb_1331_11eb] {
            h = (h ^ h >> 30).wrapping_add(0x9e37_79b9_7f4a_7c15).wrapping_mul(factor);
        }
        h ^= h >> 31;
        let magnitude = (h >> 8 & 0xff) as f32 / 256.0;
        let sign = if (h >> 32) as f64 / 4_294_967_296.0 < inside { -1.0 } else { 1.0 };
        sign * magnitude
    })
}
