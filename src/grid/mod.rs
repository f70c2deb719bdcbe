//! Sparse storage: leaves of 8³ voxels in pages, found through node tables. Knows nothing of distance.

mod leaf;
mod transform;

pub use leaf::{Face, LEAF_DIM, LEAF_VOXELS, LeafMask, LeafValues, leaf_offset, leaf_origin, offset_to_local};
pub use transform::Transform;
