//! `morph`: a sequence of frames from shape to shape. As a recipe's step it is an operator that makes one of them.

use std::path::PathBuf;
use std::time::Instant;

use clap::{Arg, ArgAction, ArgMatches, Command};
use glam::DVec3;
use serde_json::{Map, Value, json};

use super::context::Context;
use super::{Verb, args, files, options, render, table};
use crate::atomic::write_atomically;
use crate::error::{EditError, Result};
use crate::files::frames::numbered;
use crate::files::input;
use crate::files::mesh_output::MeshParams;
use crate::files::output::{self, Output};
use crate::levelset::LevelSet;
use crate::mesh::{TriangleMesh, transfer_attributes};
use crate::ops::morph::{FrameFacts, Morph, Sequence, Ways};
use crate::ops::{Entry, find, parse};
use crate::render::{ColorBy, Frame, Image, RenderOptions, render as draw};

/// The command.
pub const VERB: Verb = Verb { name: "morph", build, run };

/// Options of commands with one result, which this one is not, and the parameter of recipes.
const OF_ONE_RESULT: [&str; 2] = ["at", "attributes-from"];

/// Pixels of frames that are pictures, and of each of those side by side in a preview.
const PICTURE: [u32; 2] = [1280, 960];
const SMALL_PICTURE: [u32; 2] = [480, 400];

/// Of an animation.
const FRAMES_A_SECOND: u16 = 24;

/// Pictures in a preview.
const PREVIEWED: usize = 5;

fn build(command: Command) -> Command {
    let Ok(entry) = find(VERB.name) else { return command };
    let help = entry.help();
    let about = help.split("\n\n").next().unwrap_or_default().replace('\n', " ");
    let command = options::add(command.about(about).long_about(help), entry);
    let inputs = args::path("input").required(true).value_name("IN").num_args(2..);
    let command = command.arg(inputs.help("Two shapes or more, each a .vdb, a mesh, or `-`"));
    let command =
        args::output(args::conversion(args::grids(command), |_| false))
            .mut_arg("output", |arg| {
                arg.value_name("OUT.####.vdb").help(
                    "Where the frames go, with `####` or `%04d` for their numbers: .vdb, a mesh, or .png for pictures",
                )
            })
            .mut_arg("preview", |arg| arg.help("A picture of some of the frames, side by side"))
            .arg(
                Arg::new("skip-existing")
                    .long("skip-existing")
                    .action(ArgAction::SetTrue)
                    .help("Leave out frames whose files are there"),
            )
            .arg(
                args::path("animation")
                    .long("animation")
                    .value_name("FILE.png")
                    .help("All frames as an animated PNG, 24 a second"),
            )
            .arg(args::path("plot").long("plot").value_name("FILE.png").help(
                "A plot of the frames: RMS distance (blue) and shared volume (orange), each from 0 to its largest",
            ));
    OF_ONE_RESULT.iter().fold(command, |command, id| command.mut_arg(id, |arg| arg.hide(true)))
}

/// A frame to be written.
struct Planned {
    path: PathBuf,
    /// A picture if there is none.
    output: Option<Output>,
    /// Whether its file is there and stays.
    kept: bool,
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let began = Instant::now();
    let entry: &Entry = find(VERB.name)?;
    let values = options::collect(entry, matches);
    entry.check(values.clone())?;
    let params: Morph = parse(VERB.name, values.clone())?;
    let paths = args::paths(matches, "input");
    let input_options = files::input_options(matches)?;
    let mut planned = plan(&params, matches)?;
    let preview = picture(matches, "preview")?;
    let plot = picture(matches, "plot")?;
    let animation = picture(matches, "animation")?;
    if args::flag(matches, "dry-run") {
        return dry_run(values, &input::probe(&paths, &input_options)?, &planned, context);
    }
    let pattern = args::paths(matches, "output").pop().unwrap_or_default().display().to_string();
    if preview.is_none() && plot.is_none() && animation.is_none() && planned.iter().all(|frame| frame.kept) {
        let value = json!({
            "operation": VERB.name, "output": pattern, "seconds": began.elapsed().as_secs_f64(), "frames": [],
            "warnings": [], "skipped": planned.len(),
        });
        return context.reporter.result(&value, || format!("all {} frames are there\n", planned.len()));
    }
    let mut warnings = Vec::new();
    let inputs = input::load(&paths, &input_options, &mut warnings, &context.run)?;
    let shapes: Vec<LevelSet> = inputs.iter().map(|input| input.level_set.clone()).collect();
    warnings.iter().for_each(|warning| context.reporter.warn(warning));
    let sequence = Sequence::new(&shapes, &params, &context.run, &mut |warning| context.reporter.warn(warning))?;
    let told = sequence.warnings().len();
    let places = sequence.places();
    let boxes = sequence.shapes().iter().filter_map(LevelSet::world_bounds);
    let frame =
        boxes.reduce(|(a, b), (c, d)| (a.min(c), b.max(d))).map_or(Frame::Surface, |(lo, hi)| Frame::Box(lo, hi));
    let picture_of = |level_set: &LevelSet, [width, height]: [u32; 2]| {
        let mut options = RenderOptions { width, height, ..RenderOptions::default() };
        options.camera.frame = frame;
        draw(level_set, &ColorBy::Clay, &options, &context.run)
    };
    let from = inputs.iter().find_map(|input| input.from());
    let check = args::flag(matches, "check");
    let colors = Colors::of(&paths, &planned, sequence.ways())?;
    let (mut facts, mut strip, mut moving, mut bytes) = (Vec::new(), Vec::new(), Vec::new(), 0);
    let last = planned.len() - 1;
    let mut first_and_last = [None, None];
    let report = sequence.frames(&places, &mut |n, level_set, frame_facts| {
        let Some(frame) = planned.get_mut(n) else { return Ok(()) };
        if n == 0 || n == last {
            first_and_last[usize::from(n == last)] = Some(level_set.measure(&context.run)?);
        }
        if preview.is_some() && (0..PREVIEWED).any(|k| k * last / (PREVIEWED - 1) == n) {
            strip.push(picture_of(&level_set, SMALL_PICTURE)?);
        }
        if animation.is_some() {
            moving.push(picture_of(&level_set, SMALL_PICTURE)?);
        }
        if !frame.kept {
            if check {
                output::verify(VERB.name, &level_set)?;
            }
            match &frame.output {
                Some(output) if colors.carries(&frame_facts) => {
                    let of = |points: &[DVec3]| colors.at(points, &frame_facts, context);
                    bytes += output.write_colored(&level_set, from, &of, &context.run)?.bytes.unwrap_or(0);
                }
                Some(output) => {
                    let written = output.write(&level_set, 0.0, from, &context.run)?;
                    bytes += written.bytes.unwrap_or(0);
                    if n == 0 {
                        warnings.extend(written.warnings);
                    }
                }
                None => render::write(&frame.path, &picture_of(&level_set, PICTURE)?)?,
            }
        }
        facts.push(frame_facts);
        Ok(())
    })?;
    if let Some(path) = &preview {
        render::write(path, &Image::side_by_side(&strip))?;
    }
    if let Some(path) = &animation {
        write_atomically(path, |out| Image::write_animation(&moving, FRAMES_A_SECOND, out))?;
    }
    if let Some(path) = &plot {
        render::write(path, &plotted(&facts))?;
    }
    let summary = report.summary();
    summary.warnings.iter().skip(told).for_each(|warning| context.reporter.warn(warning));
    warnings.extend(summary.warnings);
    let frames: Vec<Value> = facts
        .iter()
        .zip(&planned)
        .enumerate()
        .map(|(n, (facts, frame))| {
            let mut value = facts.json();
            if let Some(object) = value.as_object_mut() {
                object.insert("frame".into(), (u64::from(params.frame_start) + n as u64).into());
                object.insert("output".into(), frame.path.display().to_string().into());
                object.insert("written".into(), (!frame.kept).into());
            }
            value
        })
        .collect();
    let seconds = began.elapsed().as_secs_f64();
    let [before, after] = first_and_last;
    let inputs: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
    let mut value = json!({
        "operation": VERB.name, "inputs": inputs, "output": pattern, "bytes": bytes, "seconds": seconds,
        "steps": summary.steps, "stopped_because": summary.stopped_because,
        "voxels_changed": shapes.first().zip(shapes.last()).map(|(a, b)| crate::ops::compare::changed_voxels(Some(a), b)),
        "volume_before": before.map(|m| m.volume), "volume_after": after.map(|m| m.volume),
        "area_before": before.map(|m| m.area), "area_after": after.map(|m| m.area),
        "components_before": before.map(|m| m.components), "components_after": after.map(|m| m.components),
        "frames": frames, "warnings": warnings,
    });
    if let Some(object) = value.as_object_mut() {
        object.extend(summary.details);
    }
    context.reporter.result(&value, || text(&pattern, seconds, &facts, &planned, params.frame_start, summary.steps))
}

/// The colours of the shapes, where they came as meshes with colours.
struct Colors {
    shapes: Vec<Option<TriangleMesh>>,
    ways: Ways,
}

impl Colors {
    /// Those that the frames can hold.
    fn of(paths: &[PathBuf], planned: &[Planned], ways: Ways) -> Result<Self> {
        let holds = planned.first().and_then(|frame| frame.output.as_ref()).is_some_and(Output::holds_colors);
        let of_shape = |path: &PathBuf| match holds && !input::is_volume(path) {
            true => Ok(Some(input::read_mesh(path, &mut Vec::new())?).filter(|mesh| mesh.colors.is_some())),
            false => Ok(None),
        };
        Ok(Self { shapes: paths.iter().map(of_shape).collect::<Result<_>>()?, ways })
    }

    fn around(&self, facts: &FrameFacts) -> [Option<&TriangleMesh>; 2] {
        let leg = facts.place.0;
        [self.shapes.get(leg).and_then(Option::as_ref), self.shapes.get(leg + 1).and_then(Option::as_ref)]
    }

    /// Whether a frame has colours.
    fn carries(&self, facts: &FrameFacts) -> bool {
        self.around(facts).iter().any(Option::is_some)
    }

    /// The colours of points of a frame: those of the closest points of both shapes, mixed as far as the frame has gone (Breen, Mauch & Whitaker 2000), or that
    /// of the one that has any.
    fn at(&self, points: &[DVec3], facts: &FrameFacts, context: &Context) -> Result<Vec<[f32; 4]>> {
        let ways = self.ways.of(facts.place, points);
        let mut found = Vec::new();
        for ((shape, points), share) in
            self.around(facts).into_iter().zip(&ways).zip([1.0 - facts.place.1, facts.place.1])
        {
            if let Some(shape) = shape {
                let colors = transfer_attributes(shape, points, &context.run)?.colors;
                found.extend(colors.map(|colors| (colors, share as f32)));
            }
        }
        Ok(match &found[..] {
            [(a, share), (b, _)] => a.iter().zip(b).map(|(a, b)| mixed(*a, *b, *share)).collect(),
            [(only, _)] => only.clone(),
            _ => Vec::new(),
        })
    }
}

fn mixed(a: [f32; 4], b: [f32; 4], share: f32) -> [f32; 4] {
    std::array::from_fn(|k| share * a[k] + (1.0 - share) * b[k])
}

/// The files of all frames, refused now if they could not be written later.
fn plan(params: &Morph, matches: &ArgMatches) -> Result<Vec<Planned>> {
    let pattern = args::paths(matches, "output").pop().unwrap_or_default();
    let skip = args::flag(matches, "skip-existing");
    let pictures = pattern.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
    let volume = files::volume_options(matches);
    (0..params.frame_count)
        .map(|n| {
            let path = numbered(&pattern, i64::from(params.frame_start) + i64::from(n)).ok_or_else(|| {
                let accepted = "a name with a place for the frame's number, such as `out.####.vdb`";
                EditError::parameter(VERB.name, "output", pattern.display(), accepted)
            })?;
            let kept = skip && path.exists();
            let output = match pictures {
                true => None,
                false => Some(Output::plan(path.clone(), volume.clone(), &MeshParams::default())?),
            };
            if pictures && n == 0 {
                output::writable(&path)?;
            }
            Ok(Planned { path, output, kept })
        })
        .collect()
}

/// The path of a picture, if one is asked for.
fn picture(matches: &ArgMatches, id: &str) -> Result<Option<PathBuf>> {
    let path = matches.get_one::<PathBuf>(id).cloned();
    if let Some(path) = &path {
        render::is_png(path, id)?;
        output::writable(path)?;
    }
    Ok(path)
}

fn dry_run(values: Map<String, Value>, inputs: &[String], planned: &[Planned], context: &Context) -> Result<()> {
    let names: Vec<String> =
        planned.iter().filter(|frame| !frame.kept).map(|frame| frame.path.display().to_string()).collect();
    let value =
        json!({ "dry_run": true, "operation": VERB.name, "parameters": values, "inputs": inputs, "outputs": names });
    context.reporter.result(&value, || {
        let inputs: String = inputs.iter().map(|line| format!("  reads {line}\n")).collect();
        format!("morph would run; nothing is written\n{inputs}  would write {}\n", names.join(", "))
    })
}

fn text(
    pattern: &str,
    seconds: f64,
    facts: &[FrameFacts],
    planned: &[Planned],
    start: u32,
    steps: Option<u32>,
) -> String {
    let mut text = format!("{pattern}: {} frames in {seconds:.2} s, {} steps\n", facts.len(), steps.unwrap_or(0));
    let heading = ["frame", "RMS (voxels)", "shared volume", "volume", ""].map(str::to_owned).to_vec();
    let rows = facts.iter().zip(planned).enumerate().map(|(n, (facts, frame))| {
        vec![
            (u64::from(start) + n as u64).to_string(),
            format!("{:.3}", facts.rms_voxels),
            format!("{:.4}", facts.shared_volume),
            table::number(facts.volume),
            if frame.kept { "was there".into() } else { String::new() },
        ]
    });
    text += &table::columns(std::iter::once(heading).chain(rows));
    text
}

/// A plot of RMS distance and shared volume over the frames.
fn plotted(facts: &[FrameFacts]) -> Image {
    const SIZE: [usize; 2] = [960, 540];
    const RIM: f64 = 40.0;
    let [width, height] = SIZE;
    let mut rgba8 = vec![u8::MAX; width * height * 4];
    let mut line = |from: [f64; 2], to: [f64; 2], thick: f64, color: [u8; 3]| {
        let steps = (from[0] - to[0]).hypot(from[1] - to[1]).ceil().max(1.0);
        for step in 0..=(2.0 * steps) as usize {
            let t = step as f64 / (2.0 * steps);
            let centre = [from[0] + (to[0] - from[0]) * t, from[1] + (to[1] - from[1]) * t];
            let reach = thick / 2.0;
            for y in (centre[1] - reach).round() as i64..=(centre[1] + reach).round() as i64 {
                for x in (centre[0] - reach).round() as i64..=(centre[0] + reach).round() as i64 {
                    if (0..width as i64).contains(&x) && (0..height as i64).contains(&y) {
                        let at = (y as usize * width + x as usize) * 4;
                        rgba8[at..at + 3].copy_from_slice(&color);
                    }
                }
            }
        }
    };
    let (right, bottom) = (width as f64 - RIM, height as f64 - RIM);
    for n in 0..=10 {
        let y = bottom - (bottom - RIM) * f64::from(n) / 10.0;
        line([RIM, y], [right, y], 0.0, if n == 0 { [60; 3] } else { [225; 3] });
    }
    let x = |n: usize| RIM + (right - RIM) * n as f64 / facts.len().saturating_sub(1).max(1) as f64;
    for n in 0..facts.len() {
        line([x(n), bottom], [x(n), bottom + 5.0], 0.0, [60; 3]);
    }
    line([RIM, RIM], [RIM, bottom], 0.0, [60; 3]);
    let values: [Vec<f64>; 2] =
        [facts.iter().map(|f| f.rms_voxels).collect(), facts.iter().map(|f| f.shared_volume).collect()];
    for (values, color) in values.iter().zip([[31, 119, 180], [255, 127, 14]]) {
        let most = values.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        let y = |value: f64| bottom - (bottom - RIM) * (value / most).clamp(0.0, 1.0);
        for (n, pair) in values.windows(2).enumerate() {
            line([x(n), y(pair[0])], [x(n + 1), y(pair[1])], 2.0, color);
        }
    }
    Image { width: width as u32, height: height as u32, rgba8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_shows_both_curves() {
        let fact = |n: usize| FrameFacts {
            place: (0, n as f64 / 4.0),
            rms_voxels: 8.0 - 2.0 * n as f64,
            shared_volume: n as f64 / 4.0,
            volume: 1.0,
            time: 0.0,
        };
        let image = plotted(&(0..5).map(fact).collect::<Vec<_>>());
        let has = |color: [u8; 3]| image.rgba8.chunks(4).filter(|p| p[..3] == color).count() > 500;
        assert!(has([31, 119, 180]) && has([255, 127, 14]));
        let _ = plotted(&[]);
    }
}
