//! The only home of finite differences.
//!
//! A kernel sees a leaf and its rim gathered into one contiguous buffer ([`Halo`], [`StarHalo`], [`Cube`]) and works on two rows of
//! 8 voxels at once; it knows nothing of the tree, of regions or of time. All differences are unscaled (values are not
//! divided by the voxel size) unless the name says otherwise.

pub mod anisotropic;
mod cube;
pub mod curvature;
pub mod eikonal;
pub mod filter;
mod halo;
pub mod normals;
mod results;
pub mod simd;
pub mod upwind;

pub use cube::{Cube, WIDEST_RIM};
pub use filter::{MedianScratch, SlabScratch, box_mean, box_median};
pub use halo::{FaceHalo, Halo, LeafHalo, Row, StarHalo};
pub(crate) use results::Results;
