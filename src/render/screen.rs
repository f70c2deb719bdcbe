//! Where in the picture the surface may be, and how near: the blocks of the skip map drawn as boxes.
//!
//! Most rays of a picture meet nothing, or empty space for most of their way. A block's box covers what its projected corners span, and is no nearer than the ball
//! around it; so a ray may begin at the least of these distances over its pixel, and where there is none, it meets nothing.

use glam::{DVec2, DVec3};

use super::camera::Camera;
use super::skip::SkipMap;
use crate::grid::Transform;

/// For each pixel, how far from the eye (voxels) the first block with surface is at least; infinite where there is none.
pub(super) struct Screen {
    width: usize,
    height: usize,
    nearest: Vec<f32>,
}

impl Screen {
    /// Of a picture.
    pub fn new(skip: &SkipMap, camera: &Camera, transform: &Transform, width: u32, height: u32) -> Self {
        let (width, height) = (width as usize, height as usize);
        let mut screen = Self { width, height, nearest: vec![f32::INFINITY; width * height] };
        for (lo, hi) in skip.blocks() {
            let (mut first, mut last) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            for corner in 0..8 {
                let pick = |bit: i32| f64::from(corner >> bit & 1);
                let at = lo + (hi - lo) * DVec3::new(pick(2), pick(1), pick(0));
                let Some(pixel) = camera.pixel_of(transform.index_to_world(at)) else {
                    // Beside or behind the eye: anything may be anywhere.
                    screen.nearest.fill(0.0);
                    return screen;
                };
                (first, last) = (first.min(pixel), last.max(pixel));
            }
            let eye = transform.world_to_index(camera.eye);
            let distance = ((lo + hi) / 2.0).distance(eye) - (hi - lo).length() / 2.0;
            screen.draw(first, last, (distance - 1.0).max(0.0) as f32);
        }
        screen
    }

    /// A rectangle with its rim.
    fn draw(&mut self, first: DVec2, last: DVec2, distance: f32) {
        let side = |at: f64, size: usize| at.clamp(0.0, size as f64) as usize;
        let (left, right) = (side(first.x - 1.0, self.width), side(last.x + 2.0, self.width));
        let (top, bottom) = (side(first.y - 1.0, self.height), side(last.y + 2.0, self.height));
        for y in top..bottom {
            for nearest in &mut self.nearest[y * self.width + left..y * self.width + right.max(left)] {
                *nearest = nearest.min(distance);
            }
        }
    }

    /// How far from the eye a ray through a point of the picture may begin. Beyond the picture nothing is known.
    pub fn start(&self, at: DVec2) -> f64 {
        let within = at.cmpge(DVec2::ZERO).all() && at.x < self.width as f64 && at.y < self.height as f64;
        if within { self.nearest[at.y as usize * self.width + at.x as usize].into() } else { 0.0 }
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
