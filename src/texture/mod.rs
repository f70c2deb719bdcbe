//! Geometric texturing: any solid wrapped onto any surface (Brodersen, Museth, Porumbescu & Budge 2007).
//!
//! A patch of the surface is spanned by geodesics between four points ([`patch`]), the space above it by layers of particles
//! ([`volume`]), and the texture's bounding box is mapped into that space.

mod cells;
mod level;
mod patch;
mod path;
mod volume;
mod wrap;

pub use cells::{Distortion, Spread};
pub use wrap::{Parameterization, Patch, Placement, wrapped};
