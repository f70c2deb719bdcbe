//! The only home of finite differences.
//!
//! A kernel sees a leaf and its rim gathered into one contiguous buffer ([`Halo`], [`StarHalo`]) and works on two rows of
//! 8 voxels at once; it knows nothing of the tree, of regions or of time. All differences are unscaled (values are not
//! divided by the voxel size) unless the name says otherwise.

pub mod curvature;
pub mod eikonal;
mod halo;
pub mod normals;
pub mod simd;
pub mod upwind;

pub use halo::{FaceHalo, Halo, LeafHalo, Row, StarHalo};
