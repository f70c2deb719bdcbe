//! Parts of a texture that do not meet the base: pieces of a tile that only the next tile would hold, tips thinner than a voxel.

use glam::IVec3;
use rustc_hash::FxHashMap;

use crate::error::Result;
use crate::grid::{LeafId, offset_to_local};
use crate::levelset::Components;
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild};
use crate::run::RunOptions;

/// The parts of base and texture together that hold nothing of the base.
pub(super) struct Loose {
    parts: Components,
    is_loose: Vec<bool>,
}

impl Loose {
    /// `together` is the union of the base and the texture.
    pub fn of(together: &LevelSet, base: &LevelSet, run: &RunOptions) -> Result<Self> {
        let (parts, of_base) = (together.components(run)?, base.components(run)?);
        let mut is_loose = vec![true; parts.voxels().len()];
        // One voxel of each part of the base says which part of the union it is in.
        let mut unseen = vec![true; of_base.voxels().len()];
        let grid = base.grid();
        let mut mark = |ijk: IVec3| {
            if let Some(seen) = of_base.at(ijk).and_then(|label| unseen.get_mut(label as usize))
                && std::mem::take(seen)
                && let Some(loose) = parts.at(ijk).and_then(|label| is_loose.get_mut(label as usize))
            {
                *loose = false;
            }
        };
        for &id in grid.leaves() {
            let (origin, values) = (grid.origin(id), grid.values(id));
            (0..values.0.len()).filter(|&at| values.0[at] < 0.0).for_each(|at| mark(origin + offset_to_local(at)));
        }
        grid.inside_tiles().into_iter().for_each(|(origin, _)| mark(origin));
        Ok(Self { parts, is_loose })
    }

    /// How many there are, and the inside voxels of the largest.
    pub fn count(&self) -> (usize, u64) {
        let loose = self.parts.voxels().iter().zip(&self.is_loose).filter(|(_, loose)| **loose);
        loose.fold((0, 0), |(count, most), (voxels, _)| (count + 1, most.max(*voxels)))
    }

    /// The texture without them.
    pub fn dropped_from(&self, texture: &LevelSet, run: &RunOptions) -> Result<LevelSet> {
        let drops = |ijk: IVec3| self.parts.at(ijk).is_some_and(|label| self.is_loose[label as usize]);
        let mut rest = texture.clone();
        let origins: FxHashMap<LeafId, IVec3> =
            texture.grid().leaves().iter().map(|&id| (id, texture.grid().origin(id))).collect();
        let background = texture.background();
        let grid = rest.grid_mut();
        for (origin, edge) in texture.grid().inside_tiles() {
            if drops(origin) {
                grid.set_sign(origin, origin + edge, false);
            }
        }
        grid.update_all(|id, values, mask| {
            let Some(origin) = origins.get(&id) else { return };
            for at in 0..values.0.len() {
                if values.0[at] < 0.0 && drops(*origin + offset_to_local(at)) {
                    values.0[at] = background;
                    mask.set(at, false);
                }
            }
        });
        rebuild(&rest, &Rebuild::band(texture.half_width()), run)
    }
}
