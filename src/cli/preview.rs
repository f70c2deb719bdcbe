//! `--preview`: before and after, side by side, seen by the same camera.

use std::path::PathBuf;

use clap::ArgMatches;

use super::context::Context;
use super::render;
use crate::error::Result;
use crate::files::output;
use crate::levelset::LevelSet;
use crate::render::{ColorBy, Frame, Image, RenderOptions, render as draw};

/// Pixels of each of the two pictures.
const SIZE: [u32; 2] = [960, 720];

/// The picture that was asked for, if any.
pub struct Preview(Option<PathBuf>);

impl Preview {
    /// Refused now if it could not be written later.
    pub fn plan(matches: &ArgMatches) -> Result<Self> {
        let path = matches.get_one::<PathBuf>("preview").cloned();
        if let Some(path) = &path {
            render::is_png(path, "preview")?;
            output::writable(path)?;
        }
        Ok(Self(path))
    }

    /// Whether there is to be one.
    pub fn is_wanted(&self) -> bool {
        self.0.is_some()
    }

    /// Draws and writes it.
    pub fn write(&self, before: Option<&LevelSet>, after: &LevelSet, context: &Context) -> Result<()> {
        let Some(path) = &self.0 else { return Ok(()) };
        let boxes = [before, Some(after)].into_iter().flatten().filter_map(LevelSet::world_bounds);
        let frame = match boxes.reduce(|(a, b), (c, d)| (a.min(c), b.max(d))) {
            Some((lo, hi)) if before.is_some() => Frame::Box(lo, hi),
            _ => Frame::Surface,
        };
        let mut options = RenderOptions { width: SIZE[0], height: SIZE[1], ..RenderOptions::default() };
        options.camera.frame = frame;
        let draw = |level_set: &LevelSet| draw(level_set, &ColorBy::Clay, &options, &context.run);
        let image = match before {
            Some(before) => Image::side_by_side(&[draw(before)?, draw(after)?]),
            None => draw(after)?,
        };
        render::write(path, &image)
    }
}
