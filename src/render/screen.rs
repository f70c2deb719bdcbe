//! Where in the picture the surface may be, and how near: the parts of the skip map's blocks drawn as boxes.
//!
//! Most rays of a picture meet nothing, or empty space for most of their way. A box covers what its projected corners span, and is no nearer than the ball
//! around it; so a ray may begin at the least of these distances over its pixel, and where there is none, it meets nothing.

use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::camera::Camera;
use super::skip::SkipMap;
use crate::grid::Transform;

/// Edge in pixels of the squares of which one distance is known.
const SQUARE: usize = 2;
/// Rows of squares that a thread draws at a time.
const BAND: usize = 32;

/// For each square of pixels, how far from the eye (voxels) the first block with surface is at least; infinite where there is none.
pub(super) struct Screen {
    size: DVec2,
    columns: usize,
    nearest: Vec<f32>,
}

/// What a box covers, in squares: columns and rows, and how near it is.
struct Shadow {
    columns: Range<usize>,
    rows: Range<usize>,
    distance: f32,
}

impl Screen {
    /// Of a picture.
    pub fn new(skip: &SkipMap, camera: &Camera, transform: &Transform, width: u32, height: u32) -> Self {
        let [columns, rows] = [width, height].map(|n| (n as usize).div_ceil(SQUARE));
        let size = DVec2::new(width.into(), height.into());
        let eye = transform.world_to_index(camera.eye);
        let shadow = |(lo, hi): (DVec3, DVec3)| {
            let (mut first, mut last) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            for corner in 0..8 {
                let pick = |bit: i32| f64::from(corner >> bit & 1);
                let at = lo + (hi - lo) * DVec3::new(pick(2), pick(1), pick(0));
                let pixel = camera.pixel_of(transform.index_to_world(at))?;
                (first, last) = (first.min(pixel), last.max(pixel));
            }
            let distance = ((lo + hi) / 2.0).distance(eye) - (hi - lo).length() / 2.0;
            // A square is drawn from its pixels' corners, give or take a rounding.
            let side = |low: f64, high: f64, count: usize| {
                let square = |at: f64| (at / SQUARE as f64).clamp(0.0, count as f64) as usize;
                square(low - 0.01)..square(high + 0.01 + SQUARE as f64)
            };
            let (columns, rows) = (side(first.x, last.x, columns), side(first.y, last.y, rows));
            Some(Shadow { columns, rows, distance: (distance - 1.0).max(0.0) as f32 })
        };
        let parts: Vec<_> = skip.with_surface().collect();
        let shadows: Option<Vec<Shadow>> = parts.into_par_iter().map(shadow).collect();
        let mut nearest = vec![f32::INFINITY; columns * rows];
        match shadows {
            Some(shadows) => nearest.par_chunks_mut(BAND * columns.max(1)).enumerate().for_each(|(n, band)| {
                let top = n * BAND;
                for Shadow { columns: across, rows, distance } in &shadows {
                    for row in rows.start.max(top)..rows.end.min(top + BAND) {
                        let row = &mut band[(row - top) * columns..][..columns];
                        row[across.clone()].iter_mut().for_each(|nearest| *nearest = nearest.min(*distance));
                    }
                }
            }),
            // Beside or behind the eye: anything may be anywhere.
            None => nearest.fill(0.0),
        }
        Self { size, columns, nearest }
    }

    /// How far from the eye a ray through a point of the picture may begin. Beyond the picture nothing is known.
    pub fn start(&self, at: DVec2) -> f64 {
        let within = at.cmpge(DVec2::ZERO).all() && at.cmplt(self.size).all();
        let [column, row] = at.to_array().map(|at| at as usize / SQUARE);
        if within { self.nearest[row * self.columns + column].into() } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::camera::{CameraSpec, Frame, points_to_frame};
    use crate::render::march::{Ray, Start};
    use crate::render::testing::{scene, sphere};

    #[test]
    fn no_hit_is_before_the_start_or_where_there_is_none() {
        let set = sphere(25.0, 3.0);
        let scene = scene(&set);
        let (width, height) = (90, 60);
        let points = points_to_frame(&set, Frame::Surface);
        let camera = Camera::framing(&CameraSpec::default(), &points, width, height);
        let transform = set.transform();
        let screen = Screen::new(&scene.skip, &camera, transform, width, height);
        let (mut hits, mut none) = (0, 0);
        let mut cursor = scene.field.cursor();
        for n in 0..4 * width * height {
            let (n, part) = (n / 4, f64::from(n % 4) / 4.0 + 0.1);
            let at = DVec2::new(f64::from(n % width), f64::from(n / width)) + part;
            let direction = transform.to_index().transform_vector3(camera.direction(at.x, at.y)).normalize();
            let ray = Ray::new(transform.world_to_index(camera.eye), direction);
            match scene.hit(&mut cursor, &ray, Start::Outside, f64::INFINITY) {
                Some(t) => {
                    assert!(screen.start(at) < t, "{at}");
                    hits += 1;
                }
                None => none += usize::from(screen.start(at).is_infinite()),
            }
        }
        assert!(hits > 4000 && none > 1000, "{hits} {none}");
    }
}
