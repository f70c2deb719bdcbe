//! Range maps: what scanners measured, from files, as distances along rays.
//!
//! | file | what it holds |
//! |---|---|
//! | `.toml` | a description of a set: files, poses, cameras, noise, units (see [`RangeSet::read`]) |
//! | `.conf` | Stanford's list of scans with their poses; the scans are PLY files with a `range_grid` |
//! | `.ptx` | scans of turning heads with their poses, as text |
//! | `.e57` | scans of turning heads with their poses |
//!
//! Pictures of depth are 16-bit greyscale PNG or OpenEXR. Missing files are named, and left out where that is asked for.

mod e57;
mod exr;
mod files;
mod map;
mod png;
mod ptx;
mod sight;
mod stanford;
#[cfg(test)]
mod tests;
mod toml;
mod turning;

pub use files::RangeSet;
pub use map::{Around, Background, MOST_PIXELS, Projection, RangeMap, draw_parallel};
use map::{check_rigid, rigid};
pub use sight::{Picture, Sight};
