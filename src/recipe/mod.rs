//! Recipes: a whole editing session in a TOML file.
//!
//! ```toml
//! version = 1
//!
//! [set]                       # what `--set name=value` may change
//! voxel_size = 0.01
//!
//! [[step]]
//! op = "convert"
//! input = "creature.ply"
//! voxel_size = "$voxel_size"
//! name = "body"
//!
//! [[step]]
//! op = "write"
//! input = "body"
//! path = "body.vdb"
//! ```
//!
//! A step is an operator of the registry with its parameters as keys, or one of four that are none: `convert`, `assert`, `write` and
//! `render`. Inputs are names of earlier steps, or files relative to the recipe. Steps run in the order in which they are written.
//!
//! [`Recipe::read`] checks what does not depend on the frame: keys, names, references. [`Recipe::plan`] checks all else, for a frame:
//! values, regions, files. [`Plan::run`] computes; results stay in memory until their last use, and they are those of the same
//! commands run one by one. Nothing appears at the paths of `write` and `render` before the last step of the frame has succeeded.
//!
//! A text may hold variables: `$name` is one of `[set]`, `$F` the frame and `$F4` the frame with four digits; a text that is nothing but a
//! variable has its value and kind. Numbers and vectors may be keyframed, `{ frames = [1, 24], values = [0, 45] }`: linear between
//! keys, constant before and after. A frame is one evaluation of the whole recipe and knows nothing of others.

mod assert;
mod plan;
mod read;
mod render;
mod results;
mod run;
mod schema;
mod step;
mod value;

pub use crate::files::frames::parse_frames;
pub use plan::Plan;
pub use read::Recipe;
pub use results::{Results, Stamp};
pub use run::{FrameReport, StepReport};
pub use schema::schema;
