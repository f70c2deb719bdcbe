//! A picture drawn again after an edit: only those pixels of which a ray could find something else.
//!
//! What has changed lies in some cubes of space. A pixel keeps what it showed if neither its ray passes one of them, nor one of the rays to the sky and to the key light
//! of the pixels that its light is the mean of, nor one of a neighbour's that its edges are smoothed with: every number that goes into it is the same. What belongs to
//! the picture as a whole (camera, lights, extent) must be the same too, or everything is drawn.

use std::mem::{Discriminant, discriminant};

use glam::{DVec2, DVec3, IVec3};
use rayon::prelude::*;

use super::camera::Camera;
use super::change::Changed;
use super::png::Image;
use super::screen::Screen;
use super::skip::SkipMap;
use super::tile::{Change, Drawn, Picture};
use super::{ColorBy, OPERATION, RenderOptions, prepare, render};
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafId};
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// Pixels of the picture along the side of one of the coarse picture.
const COARSE: u32 = 4;
/// How far away (voxels) values may be that a normal is made of.
const TAPS: f64 = 2.0;
/// Part of the picture that an edit may cover without a coarse picture: the whole one is as soon there.
const LOCAL: f64 = 0.125;

/// The last picture of a view, from which the next one takes what has not changed.
#[derive(Default)]
pub struct Redraw {
    last: Option<Last>,
    /// Pixels that were drawn for the last picture.
    drawn: usize,
}

struct Last {
    level_set: LevelSet,
    options: RenderOptions,
    colors: Discriminant<ColorBy<'static>>,
    spacing: i64,
    range: f64,
    camera: Camera,
    skip: SkipMap,
    screen: Screen,
    tiles: Vec<Drawn>,
}

impl Redraw {
    /// As [`render`](super::render), to the bit. Where more than an eighth of the picture may change, `coarse` is given a picture of a quarter of the
    /// resolution first, enlarged to the size of the whole.
    pub fn render(
        &mut self,
        level_set: &LevelSet,
        color_by: &ColorBy<'_>,
        options: &RenderOptions,
        coarse: &mut dyn FnMut(&Image) -> Result<()>,
        run: &RunOptions,
    ) -> Result<Image> {
        let picture = prepare(level_set, color_by, options, run)?;
        let corners = picture.corners();
        let last = self.last.take().filter(|last| last.is_of(&picture, level_set, color_by, options));
        let changed = last.as_ref().map(|last| last.changed(&picture, level_set.grid()));
        let pixels =
            changed.as_ref().map(|changed| changed.as_ref().map(|changed| picture.pixels_of(changed.bounds())));
        let is_local = |(lo, hi): (DVec2, DVec2)| {
            let size = DVec2::new(options.width.into(), options.height.into());
            let shown = (hi.min(size) - lo.max(DVec2::ZERO)).max(DVec2::ZERO);
            shown.element_product() <= LOCAL * size.element_product()
        };
        if pixels.is_none_or(|pixels| pixels.is_some_and(|pixels| !is_local(pixels))) {
            let small = RenderOptions {
                width: options.width.div_ceil(COARSE),
                height: options.height.div_ceil(COARSE),
                antialias: options.antialias.min(2),
                ..options.clone()
            };
            coarse(&render(level_set, color_by, &small, run)?.enlarged(COARSE, options.width, options.height))?;
        }
        let (mut old, screen) = last.map_or((Vec::new(), None), |last| (last.tiles, Some(last.screen)));
        let is_same = pixels == Some(None);
        let change = match (&screen, changed.flatten(), pixels.flatten()) {
            (Some(screen), Some(changed), Some(pixels)) => Some(Change { screen, changed, pixels }),
            _ => None,
        };
        let tiles = if is_same {
            // Nothing that can be seen has changed.
            old.iter_mut().for_each(|tile| tile.fresh = 0);
            old
        } else {
            let task = run.task(OPERATION, corners.len() as u64);
            let mut old: Vec<Option<Drawn>> = old.into_iter().map(Some).collect();
            old.resize_with(corners.len(), || None);
            let draw = |(corner, old): ((u32, u32), Option<Drawn>)| {
                if run.is_cancelled() {
                    return Drawn::default();
                }
                let tile = picture.tile(corner, old.zip(change.as_ref()));
                task.advance(1);
                tile
            };
            corners.into_par_iter().zip(old).map(draw).collect::<Vec<Drawn>>()
        };
        run.check(OPERATION)?;
        self.drawn = tiles.iter().map(|tile| tile.fresh).sum();
        let image = picture.assembled(tiles.iter().map(|tile| &tile.rgba8));
        let (range, spacing) = (picture.range.0, picture.spacing);
        let Picture { scene, screen, camera, .. } = picture;
        if let (Some(scene), Some(screen), Some(colors)) = (scene, screen, local(color_by)) {
            let (level_set, options, skip) = (level_set.clone(), options.clone(), scene.skip);
            self.last = Some(Last { level_set, options, colors, spacing, range, camera, skip, screen, tiles });
        }
        Ok(image)
    }

    /// The memory that it takes.
    pub fn bytes(&self) -> u64 {
        let tiles = |last: &Last| last.tiles.iter().map(Drawn::bytes).sum::<u64>();
        self.last.as_ref().map_or(0, |last| last.level_set.grid().bytes() + tiles(last))
    }

    /// How many pixels were drawn anew for the last picture.
    pub fn drawn(&self) -> usize {
        self.drawn
    }
}

/// Colours that say something of the surface where they are, and of nothing else.
fn local(color_by: &ColorBy<'_>) -> Option<Discriminant<ColorBy<'static>>> {
    match color_by {
        ColorBy::Clay => Some(discriminant(&ColorBy::Clay)),
        ColorBy::Normal => Some(discriminant(&ColorBy::Normal)),
        ColorBy::Curvature => Some(discriminant(&ColorBy::Curvature)),
        _ => None,
    }
}

impl Last {
    /// Whether a picture has the same view, lights and blocks.
    fn is_of(
        &self,
        picture: &Picture<'_>,
        level_set: &LevelSet,
        color_by: &ColorBy<'_>,
        options: &RenderOptions,
    ) -> bool {
        self.options == *options
            && local(color_by) == Some(self.colors)
            && self.level_set.transform() == level_set.transform()
            && (self.spacing, self.range) == (picture.spacing, picture.range.0)
            && self.camera == picture.camera
            && picture.scene.as_ref().is_some_and(|scene| scene.skip.is_congruent(&self.skip))
    }

    /// Where rays could find something else; none if there is nothing. A normal takes values up to two voxels away. How far the surface is from a block
    /// without it does not count, since it only says in how many jumps a ray gets there: it enters a part with surface at its face, wherever it
    /// came from.
    fn changed(&self, picture: &Picture<'_>, grid: &Grid) -> Option<Changed> {
        let old = self.level_set.grid();
        let parts = picture.scene.iter().flat_map(|scene| scene.skip.changed(&self.skip));
        let gone = old.leaves().iter().map(|id| old.origin(*id)).filter(|origin| grid.find(*origin).is_sentinel());
        let (neighbours, neighbours_before) = (grid.neighbours(), old.neighbours());
        let differs = |id: LeafId| {
            let before = old.find(grid.origin(id));
            if before.is_sentinel() {
                return Some(0);
            }
            // Leaves that come or go beside it count for themselves.
            let beside = neighbours[id.index()].iter().zip(&neighbours_before[before.index()]);
            let turned = |(now, before): (&LeafId, &LeafId)| now.is_sentinel() && before.is_sentinel() && now != before;
            let bits = |grid: &Grid, id: LeafId, at: usize| grid.values(id).0[at].to_bits();
            let same = || (0..LEAF_VOXELS).all(|at| bits(grid, id, at) == bits(old, before, at));
            let is_shared = before == id && grid.shares_storage(old, id);
            if beside.into_iter().any(turned) {
                return Some(LEAF_DIM);
            }
            (!(is_shared || same())).then_some(0)
        };
        let other = grid.map_leaves(|id| differs(id).map(|margin| (grid.origin(id), margin)));
        let leaf = |(lo, margin): (IVec3, i32)| ((lo - margin).as_dvec3(), (lo + LEAF_DIM + margin).as_dvec3());
        let leaves = gone.map(|origin| (origin, 0)).chain(other.into_iter().flatten()).map(leaf);
        let boxes: Vec<(DVec3, DVec3)> = parts.chain(leaves).collect();
        let all = boxes.iter().copied().reduce(|(a, b), (c, d)| (a.min(c), b.max(d)))?;
        Changed::of(&boxes, TAPS + picture.widest(all))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::render::testing::shape;

    /// A ball above a board, and a dent of the board of some depth at a place.
    fn scene(at: DVec3, depth: f64) -> LevelSet {
        shape(Transform::uniform(0.5), 3.0, 100, |p| {
            let ball = (p - DVec3::new(-20.0, 30.0, 0.0)).length() - 18.0;
            let board = (p.abs() - DVec3::new(90.0, 8.0, 60.0)).max_element();
            let dent = depth * (1.0 - (p - at).length_squared() / 64.0).max(0.0);
            ball.min(board + dent)
        })
    }

    #[test]
    fn a_picture_drawn_again_is_the_same_to_the_bit() {
        let run = RunOptions::default();
        let options = RenderOptions { width: 500, height: 400, ..RenderOptions::default() };
        let mut redraw = Redraw::default();
        let mut coarse = 0;
        for (n, (at, depth)) in [
            (DVec3::new(70.0, 8.0, 40.0), 0.0),
            (DVec3::new(70.0, 8.0, 40.0), 1.5),
            // In the shadow of the ball, which hides it from the camera in part.
            (DVec3::new(-10.0, 8.0, 10.0), 1.5),
            (DVec3::new(-10.0, 8.0, 10.0), 1.5),
        ]
        .into_iter()
        .enumerate()
        {
            let level_set = scene(at, depth);
            let count = &mut |image: &Image| {
                assert_eq!((image.width, image.height), (500, 400));
                coarse += 1;
                Ok(())
            };
            let again = redraw.render(&level_set, &ColorBy::Clay, &options, count, &run).unwrap();
            let whole = render(&level_set, &ColorBy::Clay, &options, &run).unwrap();
            assert!(again == whole, "{n}");
            let (drawn, all) = (redraw.drawn(), 500 * 400);
            match n {
                0 => assert_eq!(drawn, all),
                3 => assert_eq!(drawn, 0),
                _ => assert!((1..all / 2).contains(&drawn), "{n}: {drawn} of {all}"),
            }
        }
        assert!(coarse >= 1);
        // Another view is drawn whole.
        let mut turned = options.clone();
        turned.camera.azimuth += 1.0;
        let level_set = scene(DVec3::new(-10.0, 8.0, 10.0), 1.5);
        redraw.render(&level_set, &ColorBy::Clay, &turned, &mut |_| Ok(()), &run).unwrap();
        assert_eq!(redraw.drawn(), 500 * 400);
    }
}
