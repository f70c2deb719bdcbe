//! Moving a level set without resampling: new transforms, voxels renamed, bands cut narrower.

use glam::{DAffine3, DMat3, DVec3, IVec3};

use super::{LevelSet, background};
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafMask, Transform, leaf_origin, offset_to_local};

/// How far, in voxels, two lattices may be apart and still count as the same: far below the error of any stencil, far above rounding.
const SAME_LATTICE: f64 = 1e-6;

impl LevelSet {
    /// The level set after a similarity (rotation, uniform scale, mirror, translation) of the world: the grid's transform
    /// and, for a scale, the values change; no voxel is resampled. The reason, if the map is none.
    pub fn moved(&self, motion: DAffine3) -> Result<Self, String> {
        let transform = Transform::from_affine(motion * self.transform.to_world())?;
        let scale = (transform.voxel_size() / self.voxel_size()) as f32;
        let half_width = self.half_width();
        let grid = if scale == 1.0 {
            self.grid.clone()
        } else {
            scaled(&self.grid, scale, background(half_width, &transform))
        };
        Ok(Self::new(grid, transform))
    }

    /// The same voxels on the lattice of `target`, if each of them lies on one of its voxels exactly: lattices that differ by a
    /// whole number of voxels, right angles and mirrors. `None` if they do not coincide.
    pub fn renamed(&self, target: &Transform) -> Option<Self> {
        let map = target.to_index() * self.transform.to_world();
        let (turn, shift) = whole(&map)?;
        if turn == DMat3::IDENTITY && shift == DVec3::ZERO {
            return Some(Self::new(self.grid.clone(), *target));
        }
        let to = |ijk: IVec3| (turn * ijk.as_dvec3() + shift).as_ivec3();
        let back = DAffine3::from_mat3_translation(turn, shift).inverse();
        let from = |ijk: IVec3| back.transform_point3(ijk.as_dvec3()).round().as_ivec3();

        let mut origins: Vec<IVec3> = Vec::new();
        for &id in self.grid.leaves() {
            // A leaf lands on up to eight leaves of the other lattice: those of its mapped corners.
            let (a, b) = (to(self.grid.origin(id)), to(self.grid.origin(id) + (LEAF_DIM - 1)));
            let (lo, hi) = (leaf_origin(a.min(b)), leaf_origin(a.max(b)));
            for c in 0..8 {
                let pick = |bit: i32, lo: i32, hi: i32| if c & bit == 0 { lo } else { hi };
                origins.push(IVec3::new(pick(4, lo.x, hi.x), pick(2, lo.y, hi.y), pick(1, lo.z, hi.z)));
            }
        }
        origins.sort_unstable_by_key(|o| (o.x, o.y, o.z));
        origins.dedup();
        let mut grid = Grid::from_origins(self.background(), &origins);
        let places = grid.places();
        grid.update_all(|id, values, mask| {
            let mut accessor = self.grid.accessor();
            for offset in 0..LEAF_VOXELS {
                let source = from(origins[places[id.index()] as usize] + offset_to_local(offset));
                values.0[offset] = accessor.value(source);
                mask.set(offset, accessor.is_active(source));
            }
        });
        grid.flood_signs();
        let all = grid.leaf_set().clone();
        grid.prune(&all);
        Some(Self::new(grid, *target))
    }

    /// The level set with its band cut to `half_width` voxels, which must not be more than it has.
    pub fn narrowed(&self, half_width: f32) -> Self {
        debug_assert!(half_width <= self.half_width());
        let background = background(half_width, &self.transform);
        let mut grid = with_background(&self.grid, background, |v| v);
        let all = grid.leaf_set().clone();
        grid.prune(&all);
        Self::new(grid, self.transform)
    }
}

/// The grid with values changed by `change` and cut to a new background.
fn with_background(grid: &Grid, background: f32, change: impl Fn(f32) -> f32 + Sync) -> Grid {
    let origins: Vec<IVec3> = grid.leaves().iter().map(|&id| grid.origin(id)).collect();
    let mut new = Grid::from_origins(background, &origins);
    let leaves = grid.leaves();
    let places = new.places();
    new.update_all(|id, values, mask| {
        let source = leaves[places[id.index()] as usize];
        *mask = LeafMask::EMPTY;
        let active = grid.mask(source);
        for (offset, value) in values.0.iter_mut().enumerate() {
            let v = change(grid.values(source).0[offset]);
            *value = if active.get(offset) { v.clamp(-background, background) } else { background.copysign(v) };
            mask.set(offset, active.get(offset) && v.abs() < background);
        }
    });
    new.combine_signs(grid, |_, inside| inside);
    new
}

fn scaled(grid: &Grid, scale: f32, background: f32) -> Grid {
    with_background(grid, background, |v| v * scale)
}

/// The map as a signed permutation and a whole shift, if it is one.
fn whole(map: &DAffine3) -> Option<(DMat3, DVec3)> {
    let near = |v: DVec3, tolerance: f64| (v - v.round()).abs().max_element() <= tolerance;
    let m = map.matrix3;
    // A turn of ε moves voxels at the far end of a large grid by 1e4·ε.
    let right = [m.x_axis, m.y_axis, m.z_axis]
        .iter()
        .all(|c| near(*c, 1e-4 * SAME_LATTICE) && c.round().abs().element_sum() == 1.0);
    let turn = DMat3::from_cols(m.x_axis.round(), m.y_axis.round(), m.z_axis.round());
    (right && near(map.translation, SAME_LATTICE)).then(|| (turn, map.translation.round()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::RunOptions;

    fn blob() -> LevelSet {
        // No symmetry at all: two spheres of different size.
        let f = |p: DVec3| (p.length() - 9.0).min((p - DVec3::new(7.0, 4.0, -3.0)).length() - 6.0);
        let bounds = (IVec3::splat(-16), IVec3::splat(20));
        LevelSet::from_distance(Transform::uniform(0.5), 3.0, bounds, f, &RunOptions::default()).unwrap()
    }

    #[test]
    fn right_angles_mirrors_and_whole_shifts_keep_every_voxel() {
        let source = blob();
        let quarter = DAffine3::from_rotation_y(std::f64::consts::FRAC_PI_2);
        let mirror = DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0));
        let shift = DAffine3::from_translation(DVec3::new(1.5, -20.0, 0.5));
        let motion = shift * mirror * quarter;
        let moved = source.moved(motion).unwrap().renamed(&Transform::uniform(0.5)).unwrap();
        assert_eq!(moved.grid().active_voxels(), source.grid().active_voxels());
        for &id in source.grid().leaves() {
            for offset in 0..LEAF_VOXELS {
                let ijk = source.grid().origin(id) + offset_to_local(offset);
                let world = motion.transform_point3(source.transform().voxel_to_world(ijk));
                let there = moved.transform().world_to_index(world).round().as_ivec3();
                assert_eq!(source.grid().voxel(ijk), moved.grid().voxel(there));
            }
        }
        let half = DAffine3::from_translation(DVec3::splat(0.25));
        assert!(source.moved(half).unwrap().renamed(&Transform::uniform(0.5)).is_none());
    }

    #[test]
    fn scaling_keeps_the_half_width_and_refuses_what_is_no_similarity() {
        let scaled = blob().moved(DAffine3::from_scale(DVec3::splat(3.0))).unwrap();
        assert!((scaled.voxel_size() - 1.5).abs() < 1e-12 && (scaled.half_width() - 3.0).abs() < 1e-6);
        assert_eq!(scaled.grid().voxel(IVec3::ZERO), (-4.5, false));
        assert!(blob().moved(DAffine3::from_scale(DVec3::new(1.0, 2.0, 1.0))).is_err());
    }

    #[test]
    fn a_narrower_band_is_the_band_made_narrow() {
        let f = |p: DVec3| p.length() - 20.3;
        let bounds = (IVec3::splat(-28), IVec3::splat(28));
        let make = |w| LevelSet::from_distance(Transform::uniform(0.1), w, bounds, f, &RunOptions::default()).unwrap();
        let (wide, narrow) = (make(5.0).narrowed(2.0), make(2.0));
        assert_eq!(wide.grid().leaves().len(), narrow.grid().leaves().len());
        for &id in narrow.grid().leaves() {
            let other = wide.grid().find(narrow.grid().origin(id));
            assert_eq!(narrow.grid().values(id), wide.grid().values(other));
            assert_eq!(narrow.grid().mask(id), wide.grid().mask(other));
        }
        assert_eq!(wide.grid().voxel(IVec3::ZERO), narrow.grid().voxel(IVec3::ZERO));
    }
}
