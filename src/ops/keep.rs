//! Operators that make a whole new field keep the voxels that a region leaves out.

use crate::error::Result;
use crate::grid::LeafMask;
use crate::levelset::LevelSet;
use crate::region::{Region, RegionWeights};
use crate::run::RunOptions;

/// `edited`, but for the voxels that were active in `original` and have the weight 0: those keep their bits. Both on one lattice.
pub(super) fn kept(
    mut edited: LevelSet,
    original: &LevelSet,
    region: &dyn Region,
    run: &RunOptions,
) -> Result<LevelSet> {
    let weights = RegionWeights::new(original.grid(), original.transform(), region);
    run.check("region")?;
    let source = original.grid();
    // Leaves whose kept voxels the edited field lost.
    let mut lost: Vec<_> = source
        .leaves()
        .iter()
        .filter(|&&id| {
            let frozen = source.mask(id).zip(weights.positive(id), |active, moves| active & !moves);
            !frozen.is_empty() && edited.grid().find(source.origin(id)).is_sentinel()
        })
        .map(|&id| source.origin(id))
        .collect();
    lost.sort_unstable_by_key(|o| (o.x, o.y, o.z));
    let grid = edited.grid_mut();
    grid.add_leaves(&lost);
    let origins: Vec<_> = {
        let mut origins = vec![glam::IVec3::ZERO; grid.value_pages().page_count() * 64];
        grid.leaves().iter().for_each(|&id| origins[id.index()] = grid.origin(id));
        origins
    };
    grid.update_all(|id, values, mask| {
        let from = source.find(origins[id.index()]);
        if from.is_sentinel() {
            return;
        }
        let frozen: LeafMask = source.mask(from).zip(weights.positive(from), |active, moves| active & !moves);
        for offset in frozen.iter() {
            values.0[offset] = source.values(from).0[offset];
            mask.set(offset, true);
        }
    });
    Ok(edited)
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::grid::{LEAF_VOXELS, offset_to_local};
    use crate::levelset::testing::ball;
    use crate::region::{Primitive, Shape};

    #[test]
    fn what_a_region_leaves_out_keeps_its_bits() {
        let (before, after) = (ball(DVec3::ZERO, 12.0), ball(DVec3::X * 3.0, 12.0));
        let shape = Shape::Box { half_size: DVec3::new(20.0, 40.0, 40.0) };
        let region = Primitive::new(shape, DVec3::X * 20.0, DMat3::IDENTITY, [0.9, 1.0]).unwrap();
        let mixed = kept(after.clone(), &before, &region, &RunOptions::default()).unwrap();
        let (mut same, mut new) = (0, 0);
        for &id in before.grid().leaves() {
            for offset in (0..LEAF_VOXELS).filter(|o| before.grid().mask(id).get(*o)) {
                let ijk = before.grid().origin(id) + offset_to_local(offset);
                if region.weight(ijk.as_dvec3()) == 0.0 {
                    assert_eq!(mixed.grid().voxel(ijk), before.grid().voxel(ijk));
                    same += 1;
                } else {
                    assert_eq!(mixed.grid().voxel(ijk), after.grid().voxel(ijk));
                    new += 1;
                }
            }
        }
        assert!(same > 1000 && new > 1000);
    }
}
