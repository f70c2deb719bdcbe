//! A picture drawn again after an edit: only those tiles into which rays could bring something else.
//!
//! While a tile is drawn, the blocks of the skip map that its rays look at are noted: those of the rays to the surface, to the sky and to
//! the key light. If none of them holds other values than before, and rays begin where they did, every number that goes into the tile is
//! the same, so that its pixels are. What belongs to the picture as a whole (camera, lights, the blocks themselves) must be the same too, or everything
//! is drawn.

use std::mem::{Discriminant, discriminant};

use glam::IVec3;
use rayon::prelude::*;

use super::camera::Camera;
use super::png::Image;
use super::screen::Screen;
use super::skip::SkipMap;
use super::tile::Picture;
use super::{ColorBy, OPERATION, RenderOptions, prepare, render};
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafId};
use crate::levelset::LevelSet;
use crate::run::RunOptions;

/// Pixels of the picture along the side of one of the coarse picture.
const COARSE: u32 = 4;
/// A coarse picture goes before one of which more than this part of the tiles is drawn: it takes about as long as that part.
const COARSE_FROM: f64 = 0.1;

/// Blocks of a skip map, by their places.
#[derive(Clone)]
pub(super) struct Blocks(Vec<u64>);

impl Blocks {
    pub fn none_of(count: usize) -> Self {
        Self(vec![0; count.div_ceil(64)])
    }

    #[inline(always)]
    pub fn insert(&mut self, block: usize) {
        if let Some(word) = self.0.get_mut(block / 64) {
            *word |= 1 << (block % 64);
        }
    }

    fn meets(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).any(|(a, b)| a & b != 0)
    }
}

/// The last picture of a view, from which the next one takes what has not changed.
#[derive(Default)]
pub struct Redraw {
    last: Option<Last>,
    /// Tiles that were drawn for the last picture, and all tiles.
    drawn: (usize, usize),
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
    tiles: Vec<(Vec<u8>, Blocks)>,
}

impl Redraw {
    /// As [`render`](super::render), to the bit. Where much is to be drawn, `coarse` is given a picture of a quarter of the resolution first,
    /// enlarged to the size of the whole.
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
        let mut tiles: Vec<Option<(Vec<u8>, Blocks)>> = vec![None; corners.len()];
        if let Some(last) = last {
            let changed = last.changed(&picture, level_set.grid());
            let same = |(corner, (_, visited)): &(&(u32, u32), &(Vec<u8>, Blocks))| {
                let (first, end) = picture.window(**corner);
                let begins = |screen: &Screen| !screen.differs(&last.screen, first, end);
                picture.screen.as_ref().is_some_and(begins) && !visited.meets(&changed)
            };
            let kept: Vec<bool> = corners.iter().zip(&last.tiles).map(|pair| same(&pair)).collect();
            for ((tile, old), kept) in tiles.iter_mut().zip(last.tiles).zip(kept) {
                *tile = kept.then_some(old);
            }
        }
        let missing = tiles.iter().filter(|tile| tile.is_none()).count();
        self.drawn = (missing, tiles.len());
        if missing as f64 > COARSE_FROM * tiles.len() as f64 {
            let small = RenderOptions {
                width: options.width.div_ceil(COARSE),
                height: options.height.div_ceil(COARSE),
                antialias: options.antialias.min(2),
                ..options.clone()
            };
            coarse(&render(level_set, color_by, &small, run)?.enlarged(COARSE, options.width, options.height))?;
        }
        let blocks = picture.scene.as_ref().map_or(0, |scene| scene.skip.distances().len());
        let task = run.task(OPERATION, missing as u64);
        tiles.par_iter_mut().zip(&corners).filter(|(tile, _)| tile.is_none()).for_each(|(tile, corner)| {
            if !run.is_cancelled() {
                let mut visited = Blocks::none_of(blocks);
                *tile = Some((picture.tile(*corner, Some(&mut visited)), visited));
                task.advance(1);
            }
        });
        drop(task);
        run.check(OPERATION)?;
        let tiles: Vec<(Vec<u8>, Blocks)> = tiles.into_iter().flatten().collect();
        let image = picture.assembled(tiles.iter().map(|(rgba8, _)| rgba8));
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
        let tile = |(rgba8, visited): &(Vec<u8>, Blocks)| (rgba8.len() + 8 * visited.0.len()) as u64;
        self.last.as_ref().map_or(0, |last| last.level_set.grid().bytes() + last.tiles.iter().map(tile).sum::<u64>())
    }

    /// How many tiles were drawn for the last picture, and how many it has.
    pub fn drawn(&self) -> (usize, usize) {
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

    /// The blocks in which rays could find something else. A normal takes values of the leaves around the one in which it is.
    fn changed(&self, picture: &Picture<'_>, grid: &Grid) -> Blocks {
        let Some(scene) = &picture.scene else { return Blocks::none_of(0) };
        let (old, skip) = (self.level_set.grid(), &scene.skip);
        let mut changed = Blocks::none_of(skip.distances().len());
        for (n, (now, before)) in skip.distances().iter().zip(self.skip.distances()).enumerate() {
            // How far the surface is from a block without it only says in how many jumps a ray gets there: it enters a block with
            // surface at its face, wherever it came from.
            if (*now == 0) != (*before == 0) {
                changed.insert(n);
            }
        }
        let gone = old.leaves().iter().map(|id| old.origin(*id)).filter(|origin| grid.find(*origin).is_sentinel());
        let (neighbours, neighbours_before) = (grid.neighbours(), old.neighbours());
        let differs = |id: LeafId| {
            let before = old.find(grid.origin(id));
            if before.is_sentinel() {
                return true;
            }
            // Leaves that come or go beside it count for themselves.
            let beside = neighbours[id.index()].iter().zip(&neighbours_before[before.index()]);
            let turned = |(now, before): (&LeafId, &LeafId)| now.is_sentinel() && before.is_sentinel() && now != before;
            let bits = |grid: &Grid, id: LeafId, at: usize| grid.values(id).0[at].to_bits();
            let same = || (0..LEAF_VOXELS).all(|at| bits(grid, id, at) == bits(old, before, at));
            beside.into_iter().any(turned) || !(before == id && grid.shares_storage(old, id)) && !same()
        };
        let other = grid.map_leaves(|id| differs(id).then(|| grid.origin(id)));
        for origin in gone.chain(other.into_iter().flatten()) {
            for q in 0..27 {
                let beside = origin + IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * LEAF_DIM;
                changed.insert(skip.number(skip.block(beside)));
            }
        }
        changed
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

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
            let (drawn, all) = redraw.drawn();
            match n {
                0 => assert_eq!(drawn, all),
                3 => assert_eq!(drawn, 0),
                _ => assert!((1..all).contains(&drawn), "{n}: {drawn} of {all}"),
            }
        }
        assert!(coarse >= 1);
        // Another view is drawn whole.
        let mut turned = options.clone();
        turned.camera.azimuth += 1.0;
        let level_set = scene(DVec3::new(-10.0, 8.0, 10.0), 1.5);
        redraw.render(&level_set, &ColorBy::Clay, &turned, &mut |_| Ok(()), &run).unwrap();
        assert_eq!(redraw.drawn().0, redraw.drawn().1);
    }
}
