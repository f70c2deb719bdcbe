//! Velocities: grids of vectors of three numbers.

use super::VdbFile;
use super::bridge::ffi;
use crate::error::{EditError, Result};
use crate::grid::VectorVolume;
use crate::run::RunOptions;

impl VdbFile {
    /// The place of the grid of vectors that `selector` names; without one the only such grid.
    pub fn select_vector(&self, selector: Option<&str>) -> Result<usize> {
        let refuse = |problem: String| EditError::input(&self.path, problem);
        let grids = &self.listing().grids;
        let is_vector = |i: usize| matches!(grids[i].value_type.as_str(), "vec3s" | "vec3d");
        let vectors: Vec<usize> = (0..grids.len()).filter(|&i| is_vector(i)).collect();
        match (selector, &vectors[..]) {
            (Some(selector), _) => match self.listing().find(selector).map_err(refuse)? {
                index if is_vector(index) => Ok(index),
                index => Err(refuse(format!(
                    "grid `{}` holds {} values, not vectors of three numbers",
                    grids[index].selector, grids[index].value_type
                ))),
            },
            (None, [index]) => Ok(*index),
            (None, []) => Err(refuse("there is no grid of vectors of three numbers (vec3s or vec3d) in it".into())),
            (None, several) => {
                let names: Vec<String> = several.iter().map(|&i| format!("`{}`", grids[i].selector)).collect();
                Err(refuse(format!("it holds several grids of vectors: {}; choose one", names.join(", "))))
            }
        }
    }

    /// A grid of vectors as it is.
    pub fn read_vectors(&self, index: usize, run: &RunOptions) -> Result<VectorVolume> {
        let listing = &self.listing().grids[index];
        let component = |c: u32| {
            let leaves = ffi::archive_component(&self.archive, index, c)
                .map_err(|e| EditError::input(&self.path, format!("grid `{}`: {}", listing.selector, e.what())))?;
            self.volume_of(index, &leaves, run)
        };
        Ok(VectorVolume {
            components: [component(0)?, component(1)?, component(2)?],
            staggered: listing.class == "staggered",
        })
    }
}
