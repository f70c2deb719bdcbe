//! Geometric texturing: any solid wrapped onto any surface (Brodersen, Museth, Porumbescu & Budge 2007).
//!
//! A patch of the surface is spanned by geodesics between four points (`patch`), the space above it by layers of particles
//! (`volume`), and the texture's bounding box is mapped into that space: forwards by moving its polygons, backwards by the exact inverse of that map (`cells`)
//! or by radial basis functions (`implicit`).

mod cells;
mod field;
mod implicit;
mod leaves;
mod level;
mod patch;
mod path;
mod space;
#[cfg(test)]
mod tests;
mod volume;
mod wrap;

pub use cells::{Distortion, Spread};
pub use implicit::Rbf;
pub use patch::Net;
pub use space::{Parameterization, Particles, Patch};
pub use wrap::{Laying, Map, Sampling, Source, Wrapped, warped, wrapped};

/// What errors name.
const OPERATION: &str = "texture";
