//! The only home of finite differences.
//!
//! A kernel sees a leaf and its rim gathered into one contiguous [`Halo`], works along rows of 8 voxels in z and fills
//! row buffers; it knows nothing of the tree, of regions or of time. All differences are unscaled (values are not divided
//! by the voxel size) unless the name says otherwise. Loops over a row are plain Rust that the compiler vectorises;
//! [`simd`] compiles them for the widest instruction set of the machine, with the same bits on every one.

pub mod curvature;
mod halo;
pub mod simd;
pub mod upwind;

pub use halo::{Halo, Row, Star};
