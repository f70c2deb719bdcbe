//! `render`: a picture of one or several results.

use std::path::Path;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::ops::{RegionSpecs, Vector, parse, words};
use crate::render::{CameraSpec, ColorBy, Frame, Image, Patches, Redraw, RenderOptions, UpAxis, render};
use crate::run::RunOptions;

/// Pictures beside each other.
pub(super) const MOST_PICTURES: usize = 8;

words! {
    /// What the colours of the surface say.
    Color {
        /// Nothing: clay, for the shape alone.
        Clay = "clay",
        /// Mean curvature: blue concave, red convex.
        Curvature = "curvature",
        /// The normal.
        Normal = "normal",
        /// A colour a connected part.
        Component = "component",
        /// The weight of `region`.
        Region = "region",
        /// Distance of the first input to the second.
        Difference = "difference",
        /// Distance along the surface from `from`, in stripes with `stripes`; along that of the second input, if there is one.
        Geodesic = "geodesic",
        /// Patches of a texture, of `patches`, with the lines of their nets.
        Patch = "patch",
        /// The same with how much their maps distort.
        Distortion = "distortion",
    }
}

words! {
    /// The axis that points up.
    Up {
        /// As in Houdini and Maya.
        Y = "y",
        /// As in Blender and CAD.
        Z = "z",
    }
}

/// Draw a picture: of one input, or of several beside each other, seen by the same camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub(super) struct Picture {
    /// Where to: a .png. `####`, `%04d` and `$F4` become the frame.
    #[schemars(extend("x-kind" = "FILE"))]
    pub path: String,
    /// What the colours say; `region` needs `region`, `geodesic` `from`; `difference` takes two inputs and draws the first, as `geodesic` may.
    pub color_by: Color,
    /// The region that is shown; several multiply, `or …` and `not …` combine.
    pub region: RegionSpecs,
    /// The points on the surface from which `geodesic` measures.
    #[schemars(extend("x-list" = true, "x-kind" = "x,y,z"))]
    pub from: Vec<Vector>,
    /// With `geodesic`: stripes of this width (world units) of two colours in turn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stripes: Option<f64>,
    /// With `patch` and `distortion`: the particles that a step `texture` wrote with `write_particles`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub patches: Option<String>,
    /// Width and height in pixels, of each input's picture.
    pub size: [u32; 2],
    /// Where from, in degrees: around the up axis, above the horizon and, if given, field of view.
    pub camera: Vec<f64>,
    /// The axis that points up.
    pub up: Up,
    /// Lower and upper corner of what the picture shows, six numbers; if not given, of all inputs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame_box: Option<[f64; 6]>,
    /// Where colours saturate: curvature in 1/voxel (0.125 if not given), difference in voxels (1), distortion above 1 (1).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range: Option<f64>,
    /// Leave the background transparent.
    pub transparent: bool,
}

impl Default for Picture {
    fn default() -> Self {
        let (options, camera) = (RenderOptions::default(), CameraSpec::default());
        Self {
            path: String::new(),
            color_by: Color::Clay,
            region: RegionSpecs::default(),
            from: Vec::new(),
            stripes: None,
            patches: None,
            size: [options.width, options.height],
            camera: vec![camera.azimuth, camera.elevation],
            up: Up::Y,
            frame_box: None,
            range: None,
            transparent: false,
        }
    }
}

impl Picture {
    pub fn read(values: Map<String, Value>) -> Result<Self> {
        let read: Self = parse("render", values)?;
        let refuse = |field: &str, value: String, accepted: &str| {
            Err(EditError::parameter("render", field, value, accepted.to_owned()))
        };
        if !Path::new(&read.path).extension().is_some_and(|e| e.eq_ignore_ascii_case("png")) {
            return refuse("path", format!("\"{}\"", read.path), "a file name that ends in .png");
        }
        if !(2..=3).contains(&read.camera.len()) {
            return refuse("camera", format!("{:?}", read.camera), "degrees such as [35, 20] or [35, 20, 28]");
        }
        if (read.color_by == Color::Region) == read.region.0.is_empty() {
            let accepted = "`color_by = \"region\"` and `region` go together";
            return refuse("region", format!("{:?}", read.region.0), accepted);
        }
        if (read.color_by == Color::Geodesic) == read.from.is_empty() {
            let accepted = "`color_by = \"geodesic\"` and `from`, points on the surface, go together";
            return refuse("from", format!("{} points", read.from.len()), accepted);
        }
        if let Some(width) = read.stripes
            && (read.color_by != Color::Geodesic || !(width > 0.0 && width.is_finite()))
        {
            return refuse("stripes", width.to_string(), "a positive width, with `color_by = \"geodesic\"`");
        }
        if matches!(read.color_by, Color::Patch | Color::Distortion) != read.patches.is_some() {
            let accepted =
                "`color_by` with \"patch\" or \"distortion\" and `patches`, a file of particles, go together";
            return refuse("patches", read.patches.clone().unwrap_or_default(), accepted);
        }
        if let Some([a, b, c, d, e, f]) = read.frame_box
            && !(a < d && b < e && c < f)
        {
            return refuse("frame_box", format!("{:?}", read.frame_box), "the lower corner, then the upper one");
        }
        read.region.validate()?;
        read.options().validate()?;
        Ok(read)
    }

    /// Refuses a number of inputs that does not go with the colours.
    pub fn takes(&self, inputs: usize) -> Result<()> {
        if self.color_by == Color::Difference && inputs != 2 {
            let accepted = "two inputs: the one that is drawn, and the one that it is compared with";
            return Err(EditError::parameter("render", "color_by", "\"difference\"", accepted));
        }
        if self.color_by == Color::Geodesic && inputs > 2 {
            let accepted =
                "one input, or two: the one that is drawn, and the one along whose surface distances are measured";
            return Err(EditError::parameter("render", "color_by", "\"geodesic\"", accepted));
        }
        Ok(())
    }

    fn options(&self) -> RenderOptions {
        let mut options = RenderOptions { range: self.range, ..RenderOptions::default() };
        [options.width, options.height] = self.size;
        options.transparent_background = self.transparent;
        options.camera.up = if self.up == Up::Z { UpAxis::Z } else { UpAxis::Y };
        if let Some(&[azimuth, elevation]) = self.camera.first_chunk() {
            (options.camera.azimuth, options.camera.elevation) = (azimuth, elevation);
        }
        if let Some(&field_of_view) = self.camera.get(2) {
            options.camera.field_of_view = field_of_view;
        }
        if let Some([a, b, c, d, e, f]) = self.frame_box {
            options.camera.frame = Frame::Box(DVec3::new(a, b, c), DVec3::new(d, e, f));
        }
        options
    }

    /// Draws the inputs.
    pub fn draw(&self, inputs: &[LevelSet], run: &RunOptions) -> Result<Image> {
        self.draw_each(inputs, run, |_, level_set, color_by, options| render(level_set, color_by, options, run))
    }

    /// As [`draw`](Self::draw), what has not changed since the last time taken from the last pictures; `coarse` is given a coarse picture
    /// before, if there is one input and anything to be drawn.
    pub fn draw_again(
        &self,
        inputs: &[LevelSet],
        last: &mut Vec<Redraw>,
        coarse: &mut dyn FnMut(&Image) -> Result<()>,
        run: &RunOptions,
    ) -> Result<Image> {
        last.resize_with(inputs.len(), Redraw::default);
        let is_one = inputs.len() == 1;
        let mut coarse = |image: &Image| if is_one { coarse(image) } else { Ok(()) };
        self.draw_each(inputs, run, |n, level_set, color_by, options| match last.get_mut(n) {
            Some(last) => last.render(level_set, color_by, options, &mut coarse, run),
            None => render(level_set, color_by, options, run),
        })
    }

    fn draw_each(
        &self,
        inputs: &[LevelSet],
        run: &RunOptions,
        mut draw: impl FnMut(usize, &LevelSet, &ColorBy<'_>, &RenderOptions) -> Result<Image>,
    ) -> Result<Image> {
        let mut options = self.options();
        let first = matches!(self.color_by, Color::Difference | Color::Geodesic);
        let drawn = if first { &inputs[..1.min(inputs.len())] } else { inputs };
        if self.frame_box.is_none() && drawn.len() > 1 {
            let boxes = drawn.iter().filter_map(LevelSet::world_bounds);
            if let Some((lo, hi)) = boxes.reduce(|(a, b), (c, d)| (a.min(c), b.max(d))) {
                options.camera.frame = Frame::Box(lo, hi);
            }
        }
        let mut images = Vec::new();
        for (n, level_set) in drawn.iter().enumerate() {
            let draw = |color_by: &ColorBy<'_>| draw(n, level_set, color_by, &options);
            images.push(self.colored(level_set, inputs.get(1), run, draw)?);
        }
        Ok(Image::side_by_side(&images))
    }

    /// Has something drawn with the colours of an input.
    fn colored<T>(
        &self,
        level_set: &LevelSet,
        other: Option<&LevelSet>,
        run: &RunOptions,
        draw: impl FnOnce(&ColorBy<'_>) -> Result<T>,
    ) -> Result<T> {
        let region = self.region.on(level_set, run)?;
        let components = match self.color_by {
            Color::Component => Some(level_set.components(run)?),
            _ => None,
        };
        let distances = match self.color_by {
            Color::Geodesic => {
                let from: Vec<DVec3> = self.from.iter().map(|p| p.0).collect();
                Some(other.unwrap_or(level_set).geodesic(&from, run)?.reached())
            }
            _ => None,
        };
        let patches = self.patches.as_deref().map(|path| Patches::read(Path::new(path))).transpose()?;
        let stripe = |xyz: DVec3| {
            let (field, width) = (distances.as_ref()?, self.stripes?);
            let ijk = field.transform().world_to_index(xyz);
            let distance = crate::levelset::Field::trilinear(&mut field.accessor(), ijk)?;
            Some((f64::from(distance) / width) as u32 % 2)
        };
        let label = |xyz: DVec3| components.as_ref()?.nearest(level_set.transform().world_to_index(xyz));
        let color_by = match (self.color_by, &region, other) {
            (Color::Geodesic, ..) if self.stripes.is_some() => ColorBy::Label(&stripe),
            (Color::Geodesic, ..) => distances.as_ref().map_or(ColorBy::Clay, ColorBy::Geodesic),
            (Color::Curvature, ..) => ColorBy::Curvature,
            (Color::Normal, ..) => ColorBy::Normal,
            (Color::Component, ..) => ColorBy::Label(&label),
            (Color::Region, Some(region), _) => ColorBy::Region(&**region),
            (Color::Difference, _, Some(other)) => ColorBy::Difference(other),
            (Color::Patch, ..) => patches.as_ref().map_or(ColorBy::Clay, ColorBy::Patches),
            (Color::Distortion, ..) => patches.as_ref().map_or(ColorBy::Clay, ColorBy::Distortion),
            _ => ColorBy::Clay,
        };
        draw(&color_by)
    }
}
