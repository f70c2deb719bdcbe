//! Pictures of a level set: sphere tracing on the sparse grid, without a mesh in between.
//!
//! [`render`] frames the surface, finds for every pixel the exact zero of the trilinear field, takes the normal from a
//! smooth spline of φ, and lights it with a key light with soft shadow, a headlight, a rim light and a sky of which every
//! point sees its unhidden part. The picture is the same, to the bit, for any number of threads.

mod camera;
mod change;
mod field;
mod legend;
mod march;
mod occlusion;
mod patches;
mod png;
mod redraw;
mod screen;
mod shade;
mod skip;
mod tile;
mod vertices;

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use camera::{CameraSpec, Frame, UpAxis};
pub(crate) use patches::PROPERTIES;
pub use patches::Patches;
pub use png::Image;
pub use redraw::Redraw;
pub use vertices::{distance_colors, vertex_colors};

use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;
use camera::{Camera, points_to_frame};
use field::Field;
use march::Scene;
use occlusion::Light;
use screen::Screen;
use shade::Lights;
use skip::SkipMap;
use tile::Picture;

/// Largest width and height of a picture.
pub const MAX_SIZE: u32 = 16384;
/// Name of the operation in errors and progress.
const OPERATION: &str = "render";
/// Curvature at which the diverging colours are saturated, where nothing else is asked: a radius of 8 voxels.
pub const CURVATURE_RANGE: f64 = 0.125;
/// Difference at which they are, in voxels, and distortion above 1.
const DIFFERENCE_RANGE: f64 = 1.0;
const DISTORTION_RANGE: f64 = 1.0;
/// How far an obstacle darkens the sky, as a part of the surface's largest extent.
const OCCLUSION_RANGE: f64 = 0.35;
/// Rays of a pixel to the key light; sixteen pixels share theirs.
const SHADOW_RAYS: usize = 4;

/// What the colours of the surface say.
pub enum ColorBy<'a> {
    /// Nothing: warm grey clay, for the shape alone.
    Clay,
    /// The normal n in the world, as (n + 1) / 2.
    Normal,
    /// Mean curvature: blue concave, white flat, red convex.
    Curvature,
    /// Signed distance to another surface, in its voxels: red outside of it, blue inside, white where both agree.
    /// Beyond the other's band the colour is that of its rim.
    Difference(&'a LevelSet),
    /// Distance along the surface (world units), as of [`LevelSet::geodesic`]: dark blue 0 to yellow, clay where there is none.
    Geodesic(&'a crate::levelset::Field),
    /// Weight of a region: grey 0, orange 1.
    Region(&'a dyn Region),
    /// A colour for each number that the function gives a world position near the surface, as of connected components; clay for `None`.
    Label(&'a (dyn Fn(DVec3) -> Option<u32> + Sync)),
    /// Patches of a texture: lines of u and v; clay around them.
    Patches(&'a Patches),
    /// The same, and how much the map distorts: s1/s2 from 1, dark, to 1 + `range`, bright, with a legend.
    Distortion(&'a Patches),
}

/// How a picture is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderOptions {
    /// Width in pixels, 1..16384.
    pub width: u32,
    /// Height in pixels, 1..16384.
    pub height: u32,
    /// Where the camera stands and what it frames.
    pub camera: CameraSpec,
    /// Samples along the side of a pixel where the picture has an edge, 1..8; 1 leaves edges jagged.
    pub antialias: u32,
    /// Rays a pixel that look for the sky, 0..256; sixteen pixels share theirs. 0 leaves creases as bright as the rest.
    pub occlusion_rays: u32,
    /// Whether the surface throws shadows on itself.
    pub shadow: bool,
    /// Value at which the diverging colours are saturated: curvature in 1/voxel (0.125 where not given), difference in voxels (1),
    /// distance along the surface in world units (the farthest), distortion above 1 (1).
    pub range: Option<f64>,
    /// Leaves the background transparent.
    pub transparent_background: bool,
    /// 8-bit sRGB of the background at the top and at the bottom.
    pub background: [[u8; 3]; 2],
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            width: 1280,
            height: 960,
            camera: CameraSpec::default(),
            antialias: 4,
            occlusion_rays: 8,
            shadow: true,
            range: None,
            transparent_background: false,
            background: [[58, 63, 70], [128, 132, 136]],
        }
    }
}

impl RenderOptions {
    /// Refuses what cannot work, before any work.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &str, value: String, accepted: &str| {
            Err(EditError::parameter(OPERATION, field, value, accepted.to_string()))
        };
        for (field, value) in [("width", self.width), ("height", self.height)] {
            if !(1..=MAX_SIZE).contains(&value) {
                return refuse(field, value.to_string(), "a picture has 1 to 16384 pixels a side");
            }
        }
        if !(1..=8).contains(&self.antialias) {
            return refuse("antialias", self.antialias.to_string(), "take 1 (off) to 8 samples along a pixel's side");
        }
        if self.occlusion_rays > 256 {
            return refuse("occlusion_rays", self.occlusion_rays.to_string(), "take 0 (off) to 256 rays a pixel");
        }
        if let Some(range) = self.range
            && !(range > 0.0 && range.is_finite())
        {
            return refuse(
                "range",
                range.to_string(),
                "take a positive number (1/voxel for curvature, voxels for difference)",
            );
        }
        let CameraSpec { azimuth, elevation, field_of_view, margin, frame, .. } = self.camera;
        if !azimuth.is_finite() {
            return refuse("camera.azimuth", azimuth.to_string(), "take degrees");
        }
        if !(-90.0..=90.0).contains(&elevation) {
            return refuse("camera.elevation", elevation.to_string(), "take −90 to 90 degrees");
        }
        if !(1.0..=120.0).contains(&field_of_view) {
            return refuse("camera.field_of_view", field_of_view.to_string(), "take 1 to 120 degrees");
        }
        if !(0.0..=0.45).contains(&margin) {
            return refuse("camera.margin", margin.to_string(), "take 0 to 0.45 of the picture's size");
        }
        if let Frame::Box(lo, hi) = frame
            && !(lo.is_finite() && hi.is_finite() && lo.cmple(hi).all() && lo != hi)
        {
            return refuse("camera.frame", format!("{lo} .. {hi}"), "give the lower and the upper corner of a box");
        }
        Ok(())
    }
}

/// Value at which the diverging colours are saturated.
#[derive(Clone, Copy)]
struct DataRange(f64);

/// A picture of a level set. One without surface shows the background alone.
pub fn render(
    level_set: &LevelSet,
    color_by: &ColorBy<'_>,
    options: &RenderOptions,
    run: &RunOptions,
) -> Result<Image> {
    let picture = prepare(level_set, color_by, options, run)?;
    let corners = picture.corners();
    let task = run.task(OPERATION, corners.len() as u64);
    let draw = |corner: &(u32, u32)| {
        if run.is_cancelled() {
            return Vec::new();
        }
        let tile = picture.tile(*corner, None).rgba8;
        task.advance(1);
        tile
    };
    let tiles: Vec<Vec<u8>> = corners.par_iter().map(draw).collect();
    run.check(OPERATION)?;
    Ok(picture.assembled(tiles.iter()))
}

/// All that a picture's tiles need to be drawn.
fn prepare<'a>(
    level_set: &'a LevelSet,
    color_by: &'a ColorBy<'a>,
    options: &RenderOptions,
    run: &RunOptions,
) -> Result<Picture<'a>> {
    options.validate()?;
    run.check(OPERATION)?;
    let &RenderOptions { width, height, .. } = options;
    let pixels = u64::from(width) * u64::from(height);
    // The tiles, the picture that they are copied to, and where rays begin.
    run.reserve(OPERATION, pixels * 12 + SkipMap::MAX_BYTES, "take a smaller picture")?;

    let transform = *level_set.transform();
    let points = points_to_frame(level_set, options.camera.frame);
    let camera = Camera::framing(&options.camera, &points, width, height);
    let middle = points.iter().map(|p| p.0).sum::<DVec3>() / points.len().max(1) as f64;
    let footprint = middle.distance(camera.eye) * camera.pixel() / level_set.voxel_size();
    let skip = SkipMap::new(level_set.grid());
    let extent = skip.as_ref().map_or(0.0, |s| (s.bounds().1 - s.bounds().0).max_element());
    let lights = Lights::around(&camera);
    let key = transform.to_index().transform_vector3(lights.key).normalize();
    let key_rays = if options.shadow { SHADOW_RAYS } else { 0 };
    let light = Light::new(key, OCCLUSION_RANGE * extent, options.occlusion_rays as usize, key_rays);
    let default_range = match color_by {
        ColorBy::Difference(_) => DIFFERENCE_RANGE,
        ColorBy::Distortion(_) => DISTORTION_RANGE,
        ColorBy::Geodesic(field) => field.range().map_or(1.0, |(_, most)| f64::from(most).max(f64::MIN_POSITIVE)),
        _ => CURVATURE_RANGE,
    };
    let range = options.range.unwrap_or(default_range);
    Ok(Picture {
        screen: skip.as_ref().map(|skip| Screen::new(skip, &camera, &transform, width, height)),
        scene: skip.map(|skip| Scene { field: Field::new(level_set.grid(), level_set.voxel_size()), skip }),
        camera,
        transform,
        lights,
        light,
        color_by,
        range: DataRange(range),
        spacing: occlusion::spacing(footprint),
        antialias: options.antialias,
        width,
        height,
        background: (!options.transparent_background).then(|| background(options)),
    })
}

/// Colours of the rows of the background, linear and as displayed.
fn background(options: &RenderOptions) -> Vec<[DVec3; 2]> {
    let [top, bottom] = options.background.map(shade::decode);
    let row = |y| top.lerp(bottom, (f64::from(y) + 0.5) / f64::from(options.height));
    (0..options.height).map(row).map(|linear| [linear, shade::display(linear)]).collect()
}

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
