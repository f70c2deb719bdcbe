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
            Some(before) => side_by_side(&draw(before)?, &draw(after)?),
            None => draw(after)?,
        };
        render::write(path, &image)
    }
}

/// Two pictures of one height beside each other.
fn side_by_side(left: &Image, right: &Image) -> Image {
    let row = |image: &Image| (image.width as usize * 4).max(1);
    let rows = left.rgba8.chunks(row(left)).zip(right.rgba8.chunks(row(right)));
    let rgba8 = rows.flat_map(|(l, r)| [l, r].concat()).collect();
    Image { width: left.width + right.width, height: left.height, rgba8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_stay_together() {
        let of = |value: u8, width: u32| Image { width, height: 2, rgba8: vec![value; width as usize * 8] };
        let both = side_by_side(&of(1, 2), &of(2, 1));
        assert_eq!((both.width, both.height), (3, 2));
        assert_eq!(both.pixel(1, 1), Some([1; 4]));
        assert_eq!(both.pixel(2, 0), Some([2; 4]));
        assert_eq!(both.rgba8.len(), 24);
    }
}
