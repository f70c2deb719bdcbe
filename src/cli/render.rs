//! `render`: a picture of a level set, or of several beside each other.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::builder::ValueParser;
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use glam::DVec3;
use serde_json::{Map, json};

use super::context::Context;
use super::{Verb, args, files};
use crate::atomic::write_atomically;
use crate::error::{EditError, Result};
use crate::files::{frames, input, output};
use crate::levelset::{Components, Field, LevelSet};
use crate::ops::Vector;
use crate::region::{Region, RegionPlan};
use crate::render::{CameraSpec, ColorBy, Frame, Image, Patches, RenderOptions, UpAxis, render};
use crate::run::RunOptions;

/// The command.
pub const VERB: Verb = Verb { name: "render", build, run };

/// `--color-by`.
#[derive(Clone, Debug, PartialEq)]
enum Color {
    Clay,
    Curvature,
    Normal,
    Region,
    Component,
    Geodesic,
    Difference(PathBuf),
    Patch(PathBuf),
    Distortion(PathBuf),
}

fn build(command: Command) -> Command {
    let option = |id: &'static str, value_name: &'static str| Arg::new(id).long(id).value_name(value_name);
    let command = command
        .about("Draw a picture of a level set or mesh, or of several beside each other")
        .arg(
            args::path("input")
                .value_name("IN")
                .required(true)
                .num_args(1..)
                .help("A .vdb, a mesh, or `-`; several are seen by the same camera, as the frames of a sequence"),
        )
        .arg(args::path("output").long("output").short('o').value_name("OUT.png").required(true).help("The picture"))
        .arg(
            option("color-by", "WHAT")
                .value_parser(ValueParser::new(color))
                .help("clay, curvature, normal, component, geodesic (with --from), region (with --region), difference:OTHER, or patch:PARTICLES and distortion:PARTICLES (of texture --write-particles) [default: clay]"),
        )
        .arg(
            option("from", "X,Y,Z")
                .action(ArgAction::Append)
                .allow_hyphen_values(true)
                .value_parser(ValueParser::new(|text: &str| text.parse::<Vector>()))
                .help("The points on the surface from which --color-by geodesic measures"),
        )
        .arg(
            option("stripes", "WIDTH")
                .value_parser(value_parser!(f64))
                .help("With --color-by geodesic: stripes of this width (world units) of two colours in turn"),
        )
        .arg(
            option("columns", "N")
                .value_parser(value_parser!(u32).range(1..=1000))
                .help("With several inputs: pictures in a row of the sheet [default: all]"),
        )
        .arg(
            option("region", "SPEC")
                .action(ArgAction::Append)
                .help("The region that --color-by region shows; several multiply, `or SPEC` and `not SPEC` combine"),
        )
        .arg(
            option("size", "WxH")
                .value_parser(ValueParser::new(picture_size))
                .help("Width and height in pixels [default: 1280x960]"),
        )
        .arg(
            option("camera", "AZIMUTH,ELEVATION[,FOV]")
                .allow_hyphen_values(true)
                .value_parser(ValueParser::new(camera))
                .help(
                    "Where from, in degrees: around the up axis, above the horizon, field of view [default: 35,20,28]",
                ),
        )
        .arg(
            option("up", "y|z")
                .value_parser(["y", "z"])
                .hide_possible_values(true)
                .help("The axis that points up [default: y]"),
        )
        .arg(
            option("range", "NUMBER").value_parser(value_parser!(f64)).help(
                "Where colours saturate: curvature in 1/voxel [default: 0.125], difference in voxels [default: 1], geodesic in world units [default: the farthest], distortion above 1 [default: 1]",
            ),
        )
        .arg(
            option("turntable", "N")
                .value_parser(value_parser!(u32).range(1..=10_000))
                .help("N pictures once around: #### in OUT.png becomes the number, or it is put before the ending"),
        )
        .arg(option("transparent", "").num_args(0).action(ArgAction::SetTrue).help("Leave the background transparent"))
        .arg(
            option("dry-run", "").num_args(0).action(ArgAction::SetTrue).help("Say what would be done; write nothing"),
        );
    args::conversion(args::grids(command), |_| false)
}

fn color(text: &str) -> Result<Color, String> {
    Ok(match text {
        "clay" => Color::Clay,
        "curvature" => Color::Curvature,
        "normal" => Color::Normal,
        "region" => Color::Region,
        "component" => Color::Component,
        "geodesic" => Color::Geodesic,
        _ => match text.split_once(':') {
            Some(("difference", file)) if !file.is_empty() => Color::Difference(file.into()),
            Some(("patch", file)) if !file.is_empty() => Color::Patch(file.into()),
            Some(("distortion", file)) if !file.is_empty() => Color::Distortion(file.into()),
            _ => {
                return Err("there are clay, curvature, normal, component, geodesic, region, difference:OTHER, patch:PARTICLES and distortion:PARTICLES".into());
            }
        },
    })
}

fn picture_size(text: &str) -> Result<[u32; 2], String> {
    let size = text.split_once(['x', 'X']).and_then(|(w, h)| Some([w.trim().parse().ok()?, h.trim().parse().ok()?]));
    size.ok_or_else(|| "width and height such as 1280x960 are wanted".into())
}

fn camera(text: &str) -> Result<CameraSpec, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    let spec = CameraSpec::default();
    match numbers.as_deref() {
        Some(&[azimuth, elevation]) => Ok(CameraSpec { azimuth, elevation, ..spec }),
        Some(&[azimuth, elevation, field_of_view]) => Ok(CameraSpec { azimuth, elevation, field_of_view, ..spec }),
        _ => Err("degrees such as 35,20 or 35,20,28 are wanted".into()),
    }
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let began = Instant::now();
    let paths = args::paths(matches, "input");
    let path = matches.get_one::<PathBuf>("output").cloned().unwrap_or_default();
    is_png(&path, "output")?;
    output::writable(&path)?;
    let input_options = files::input_options(matches)?;
    let options = options(matches);
    options.validate()?;
    let color = matches.get_one::<Color>("color-by").cloned().unwrap_or(Color::Clay);
    let specs: Vec<String> = matches.get_many("region").map(|specs| specs.cloned().collect()).unwrap_or_default();
    let plan = RegionPlan::parse(&specs)?;
    if (color == Color::Region) != plan.is_some() {
        let accepted = "`--color-by region` and one or more `--region SPEC` go together";
        return Err(EditError::parameter("render", "color_by", format!("{color:?}").to_lowercase(), accepted));
    }
    let from: Vec<DVec3> = matches.get_many::<Vector>("from").into_iter().flatten().map(|v| v.0).collect();
    if (color == Color::Geodesic) == from.is_empty() {
        let accepted = "`--color-by geodesic` and one or more points `--from X,Y,Z` go together";
        return Err(EditError::parameter("render", "color_by", format!("{color:?}").to_lowercase(), accepted));
    }
    let stripes = matches.get_one::<f64>("stripes").copied();
    if let Some(width) = stripes
        && (color != Color::Geodesic || !(width > 0.0 && width.is_finite()))
    {
        return Err(EditError::parameter("render", "stripes", width, "a positive width, with `--color-by geodesic`"));
    }
    let frames = frames(&path, matches.get_one::<u32>("turntable").copied());
    if args::flag(matches, "dry-run") {
        let mut all = paths;
        all.extend(color.other());
        let lines = input::probe(&all, &input_options)?;
        let names: Vec<String> = frames.iter().map(|(path, _)| path.display().to_string()).collect();
        let value = json!({ "dry_run": true, "operation": "render", "inputs": lines, "outputs": names });
        return context.reporter.result(&value, || format!("would draw {}\n", names.join(", ")));
    }
    let patches = match &color {
        Color::Patch(path) | Color::Distortion(path) => Some(Patches::read(path)?),
        _ => None,
    };
    let mut all = paths;
    let drawn = all.len();
    all.extend(color.other());
    let mut warnings = Vec::new();
    let inputs = input::load(&all, &input_options, &mut warnings, &context.run)?;
    warnings.iter().for_each(|warning| context.reporter.warn(warning));
    let (inputs, other) = inputs.split_at(drawn.min(inputs.len()));
    let what = What { color: &color, plan, from, stripes, patches, other: other.first().map(|input| &input.level_set) };
    let subjects = inputs.iter().map(|input| Subject::new(&what, &input.level_set, &context.run));
    let subjects: Vec<Subject> = subjects.collect::<Result<_>>()?;
    let mut options = options.clone();
    if subjects.len() > 1 {
        let boxes = inputs.iter().filter_map(|input| input.level_set.world_bounds());
        if let Some((lo, hi)) = boxes.reduce(|(a, b), (c, d)| (a.min(c), b.max(d))) {
            options.camera.frame = Frame::Box(lo, hi);
        }
    } else if frames.len() > 1 {
        options.camera.frame = Frame::Sphere;
    }
    let columns = matches.get_one::<u32>("columns").map_or(subjects.len(), |n| *n as usize);
    let (mut width, mut height) = (options.width, options.height);
    for (path, turn) in &frames {
        let mut options = options.clone();
        options.camera.azimuth += turn;
        let images: Vec<Image> =
            subjects.iter().map(|subject| subject.draw(&options, &context.run)).collect::<Result<_>>()?;
        let sheet = Image::sheet(&images, columns);
        (width, height) = (sheet.width, sheet.height);
        write(path, &sheet)?;
    }
    let names: Vec<String> = frames.iter().map(|(path, _)| path.display().to_string()).collect();
    let seconds = began.elapsed().as_secs_f64();
    let mut value = Map::new();
    value.insert("operation".into(), "render".into());
    value.insert("output".into(), names.first().cloned().into());
    value.insert("outputs".into(), names.clone().into());
    value.insert("width".into(), width.into());
    value.insert("height".into(), height.into());
    if let Some(components) = subjects.first().and_then(|subject| subject.components.as_ref()) {
        value.insert("components".into(), components.voxels().len().into());
    }
    value.insert("seconds".into(), seconds.into());
    value.insert("warnings".into(), warnings.into());
    context
        .reporter
        .result(&value.into(), || format!("{}: {width} x {height} pixels in {seconds:.2} s\n", names.join(", ")))
}

impl Color {
    /// The file of the other surface.
    fn other(&self) -> Option<PathBuf> {
        match self {
            Self::Difference(path) => Some(path.clone()),
            _ => None,
        }
    }
}

/// What the colours say, of any input.
struct What<'a> {
    color: &'a Color,
    plan: Option<RegionPlan>,
    from: Vec<DVec3>,
    stripes: Option<f64>,
    patches: Option<Patches>,
    other: Option<&'a LevelSet>,
}

/// An input with what its colours say.
struct Subject<'a> {
    what: &'a What<'a>,
    level_set: &'a LevelSet,
    region: Option<Box<dyn Region>>,
    components: Option<Components>,
    distances: Option<Field>,
}

impl<'a> Subject<'a> {
    fn new(what: &'a What, level_set: &'a LevelSet, run: &RunOptions) -> Result<Self> {
        let of_points = || level_set.geodesic(&what.from, run).map(|geodesic| geodesic.reached());
        Ok(Self {
            what,
            level_set,
            region: what.plan.as_ref().map(|plan| plan.on(level_set, run)).transpose()?,
            components: (*what.color == Color::Component).then(|| level_set.components(run)).transpose()?,
            distances: (*what.color == Color::Geodesic).then(of_points).transpose()?,
        })
    }

    fn draw(&self, options: &RenderOptions, run: &RunOptions) -> Result<Image> {
        let What { stripes, ref patches, other, .. } = *self.what;
        let label = |xyz: DVec3| self.components.as_ref()?.nearest(self.level_set.transform().world_to_index(xyz));
        let stripe = |xyz: DVec3| {
            let (field, width) = (self.distances.as_ref()?, stripes?);
            let distance = Field::trilinear(&mut field.accessor(), field.transform().world_to_index(xyz))?;
            Some((f64::from(distance) / width) as u32 % 2)
        };
        // What a colour needs was made with it.
        let color_by = match self.what.color {
            Color::Clay => None,
            Color::Curvature => Some(ColorBy::Curvature),
            Color::Normal => Some(ColorBy::Normal),
            Color::Component => Some(ColorBy::Label(&label)),
            Color::Geodesic if stripes.is_some() => Some(ColorBy::Label(&stripe)),
            Color::Geodesic => self.distances.as_ref().map(ColorBy::Geodesic),
            Color::Difference(_) => other.map(ColorBy::Difference),
            Color::Region => self.region.as_deref().map(ColorBy::Region),
            Color::Patch(_) => patches.as_ref().map(ColorBy::Patches),
            Color::Distortion(_) => patches.as_ref().map(ColorBy::Distortion),
        };
        render(self.level_set, &color_by.unwrap_or(ColorBy::Clay), options, run)
    }
}

fn options(matches: &ArgMatches) -> RenderOptions {
    let mut options = RenderOptions::default();
    if let Some(&[width, height]) = matches.get_one::<[u32; 2]>("size") {
        (options.width, options.height) = (width, height);
    }
    if let Some(camera) = matches.get_one::<CameraSpec>("camera") {
        options.camera = *camera;
    }
    if matches.get_one::<String>("up").is_some_and(|axis| axis == "z") {
        options.camera.up = UpAxis::Z;
    }
    options.range = matches.get_one("range").copied();
    options.transparent_background = args::flag(matches, "transparent");
    options
}

/// The pictures of a command: file and degrees of turn.
fn frames(path: &Path, turntable: Option<u32>) -> Vec<(PathBuf, f64)> {
    let Some(count) = turntable else { return vec![(path.to_path_buf(), 0.0)] };
    let frame = |n: u32| (numbered(path, n + 1), 360.0 * f64::from(n) / f64::from(count));
    (0..count).map(frame).collect()
}

/// The path of a frame: its number in the place of `####`, or before the ending.
fn numbered(path: &Path, frame: u32) -> PathBuf {
    frames::numbered(path, i64::from(frame)).unwrap_or_else(|| {
        let ending = path.extension().map(|e| format!(".{}", e.to_string_lossy())).unwrap_or_default();
        path.with_extension(format!("{frame:04}{ending}"))
    })
}

/// Refuses what is no `.png`.
pub fn is_png(path: &Path, field: &str) -> Result<()> {
    let png = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
    let device = || std::fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir());
    if png || device() {
        return Ok(());
    }
    Err(EditError::parameter("render", field, path.display(), "a file name that ends in .png"))
}

/// Writes a picture, whole or not at all.
pub fn write(path: &Path, image: &Image) -> Result<()> {
    write_atomically(path, |out| image.write_png(out))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_understood() {
        assert_eq!(picture_size("640x480"), Ok([640, 480]));
        assert!(picture_size("640").is_err() && picture_size("-1x5").is_err());
        assert_eq!(camera("-30, 10").map(|c| (c.azimuth, c.elevation)), Ok((-30.0, 10.0)));
        assert_eq!(camera("1,2,3").map(|c| c.field_of_view), Ok(3.0));
        assert!(camera("1").is_err() && camera("a,b").is_err());
        assert_eq!(color("difference:a.vdb"), Ok(Color::Difference("a.vdb".into())));
        assert_eq!(color("geodesic"), Ok(Color::Geodesic));
        assert_eq!(color("patch:p.ply"), Ok(Color::Patch("p.ply".into())));
        assert_eq!(color("distortion:p.ply"), Ok(Color::Distortion("p.ply".into())));
        assert!(color("difference:").is_err() && color("patch").is_err() && color("colour").is_err());
    }

    #[test]
    fn frames_are_numbered() {
        let name = |path: &str, n| numbered(Path::new(path), n).display().to_string();
        assert_eq!(name("out/turn.####.png", 7), "out/turn.0007.png");
        assert_eq!(name("turn##.png", 123), "turn123.png");
        assert_eq!(name("turn.png", 7), "turn.0007.png");
        let turns: Vec<f64> = frames(Path::new("a.png"), Some(4)).into_iter().map(|f| f.1).collect();
        assert_eq!(turns, [0.0, 90.0, 180.0, 270.0]);
    }
}
