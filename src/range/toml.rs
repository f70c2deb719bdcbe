//! The description of a set of range maps, in TOML.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat4, DVec2};
use serde::Deserialize;

use super::files::{beside, bytes, name, text};
use super::{Background, Projection, RangeMap, RangeSet, check_rigid, e57, exr, png, ptx, stanford};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

#[derive(Deserialize)]
struct Description {
    version: u32,
    #[serde(default = "one")]
    units: f64,
    #[serde(flatten)]
    common: Common,
    trajectory: Option<String>,
    #[serde(rename = "map", default)]
    maps: Vec<Entry>,
}

fn one() -> f64 {
    1.0
}

/// What may stand for all maps and for one.
#[derive(Clone, Default, Deserialize)]
struct Common {
    noise: Option<f64>,
    background: Option<String>,
    scale: Option<f64>,
    camera: Option<CameraSource>,
    orthographic: Option<Parallel>,
}

#[derive(Clone, Deserialize)]
#[serde(untagged)]
enum CameraSource {
    File(String),
    Given(Camera),
}

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Camera {
    focal: [f64; 2],
    centre: [f64; 2],
}

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parallel {
    pitch: [f64; 2],
    first: [f64; 2],
}

#[derive(Deserialize)]
struct Entry {
    file: String,
    pose: Option<[[f64; 4]; 4]>,
    #[serde(flatten)]
    own: Common,
    confidence: Option<String>,
    color: Option<String>,
    #[serde(default)]
    noise_table: Vec<[f64; 2]>,
}

/// What a description may hold; flattened structs let others through.
const KEYS: [&[&str]; 2] = [
    &["version", "units", "noise", "background", "scale", "camera", "orthographic", "trajectory", "map"],
    &["file", "pose", "noise", "background", "scale", "camera", "orthographic", "confidence", "noise_table", "color"],
];

pub(super) fn read(path: &Path, run: &RunOptions) -> Result<RangeSet> {
    let Some(source) = text(path)? else {
        return Err(EditError::input(path, "cannot be opened: there is no such file"));
    };
    let refused = |e: ::toml::de::Error| EditError::input(path, e.to_string().trim().replace('\n', " "));
    let table: ::toml::Table = ::toml::from_str(&source).map_err(refused)?;
    let maps = table.get("map").and_then(|maps| maps.as_array()).into_iter().flatten().filter_map(|map| map.as_table());
    for (table, known) in std::iter::once((&table, KEYS[0])).chain(maps.map(|map| (map, KEYS[1]))) {
        if let Some(key) = table.keys().find(|key| !known.contains(&key.as_str())) {
            let accepted = crate::spec::suggest(key, known.iter().copied());
            return Err(EditError::input(path, format!("unknown key `{key}`; {accepted}")));
        }
    }
    let description: Description = ::toml::from_str(&source).map_err(refused)?;
    if description.version != 1 {
        return Err(EditError::input(path, format!("version {} is unknown: 1 is wanted", description.version)));
    }
    if !(description.units > 0.0 && description.units.is_finite()) {
        return Err(EditError::input(path, format!("units = {}: a positive number is wanted", description.units)));
    }
    if description.maps.is_empty() {
        return Err(EditError::input(path, "lists no map: tables [[map]] with a `file` are wanted"));
    }
    let poses = match &description.trajectory {
        Some(file) => Some(trajectory(&beside(path, file))?),
        None => None,
    };
    let mut set = RangeSet::default();
    for (n, entry) in description.maps.iter().enumerate() {
        run.check("reading")?;
        let place = |problem: String| EditError::input(path, format!("map {} ({}): {problem}", n + 1, entry.file));
        let pose = match (&entry.pose, &poses) {
            (Some(rows), _) => affine(rows),
            (None, Some(poses)) => {
                *poses.get(n).ok_or_else(|| place(format!("the trajectory has {} poses", poses.len())))?
            }
            (None, None) => DAffine3::IDENTITY,
        };
        check_rigid(&pose).map_err(place)?;
        let file = beside(path, &entry.file);
        let before = set.maps.len();
        if !file.exists() {
            set.missing.push(file);
            continue;
        }
        let ending = file.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        match ending.as_str() {
            "png" | "exr" => set.maps.push(picture(path, &file, entry, &description.common, &place)?),
            "ply" => set.maps.extend(stanford::read_scan(&file, pose, run)?),
            "ptx" | "e57" => {
                let scans = if ending == "e57" { e57::read(&file, run)? } else { ptx::read(&file)? };
                set.maps.extend(scans.maps);
                set.warnings.extend(scans.warnings);
            }
            _ => {
                return Err(place(
                    "a .png or .exr of depths, a .ply with a range grid, a .ptx or an .e57 is wanted".into(),
                ));
            }
        }
        let common = |of: fn(&Common) -> Option<&String>| of(&entry.own).or_else(|| of(&description.common));
        let background = match common(|c| c.background.as_ref()).map(String::as_str) {
            Some("empty") => Background::Empty,
            None | Some("unknown") => Background::Unknown,
            Some(other) => return Err(place(format!("background = `{other}`: `empty` or `unknown` is wanted"))),
        };
        let noise = entry.own.noise.or(description.common.noise);
        if noise.is_some_and(|noise| !(noise >= 0.0 && noise.is_finite())) {
            return Err(place("noise: a number of world units, 0 or more, is wanted".into()));
        }
        for map in &mut set.maps[before..] {
            scale(map, description.units);
            map.background = background;
            map.noise = noise.or(map.noise);
            map.pose = match ["ptx", "e57"].contains(&ending.as_str()) {
                // These have poses of their own.
                true if entry.pose.is_none() && poses.is_none() => map.pose,
                _ => pose,
            };
            map.pose.translation *= description.units;
            if let Some(colors) = &entry.color {
                map.colors = painted(map, &beside(path, colors))?;
            }
            if let Some(amplitudes) = &entry.confidence {
                confide(map, &beside(path, amplitudes), &entry.noise_table, noise, &place)?;
            }
        }
    }
    Ok(set)
}

/// A picture of depths along the camera's axis.
fn picture(
    path: &Path,
    file: &Path,
    entry: &Entry,
    common: &Common,
    place: &dyn Fn(String) -> EditError,
) -> Result<RangeMap> {
    let read = bytes(file)?.unwrap_or_default();
    let (width, _, counts) = match file.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr")) {
        true => exr::read(file, &read)?,
        false => {
            let (width, height, counts) = png::read(file, &read)?;
            (width, height, counts.into_iter().map(f32::from).collect())
        }
    };
    let scale = entry.own.scale.or(common.scale).unwrap_or(1.0);
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(place(format!("scale = {scale}: a positive number of units a count is wanted")));
    }
    let positive = |v: [f64; 2], what: &str| {
        let fine = v.iter().all(|v| *v != 0.0 && v.is_finite());
        if fine {
            Ok(DVec2::from(v))
        } else {
            Err(place(format!("{what}: two finite numbers other than 0 are wanted")))
        }
    };
    let parallel = entry.own.orthographic.or(if entry.own.camera.is_some() { None } else { common.orthographic });
    let projection = match (parallel, entry.own.camera.as_ref().or(common.camera.as_ref())) {
        (Some(Parallel { pitch, first }), _) => {
            Projection::Orthographic { first: DVec2::from(first), pitch: positive(pitch, "pitch")? }
        }
        (None, Some(camera)) => {
            let Camera { focal, centre } = match camera {
                CameraSource::Given(camera) => *camera,
                CameraSource::File(json) => open3d(&beside(path, json))?,
            };
            Projection::Pinhole { focal: positive(focal, "focal")?, centre: DVec2::from(centre) }
        }
        (None, None) => return Err(place("a `camera` or `orthographic` is wanted".into())),
    };
    let ranges = counts.iter().enumerate().map(|(at, count)| {
        if !(*count > 0.0 && count.is_finite()) {
            return f32::NAN;
        }
        let depth = f64::from(*count) * scale;
        match projection {
            Projection::Pinhole { focal, centre } => {
                let pixel = DVec2::new((at % width) as f64, (at / width) as f64);
                (depth * ((pixel - centre) / focal).extend(1.0).length()) as f32
            }
            _ => depth as f32,
        }
    });
    Ok(RangeMap::new(name(file), projection, DAffine3::IDENTITY, width, ranges.collect()))
}

/// The colours of a picture of as many pixels as the map has.
fn painted(map: &RangeMap, file: &Path) -> Result<Vec<[u8; 3]>> {
    let Some(bytes) = bytes(file)? else { return Err(EditError::input(file, "there is no such file")) };
    let (width, height, colors) = png::read_colors(file, &bytes)?;
    match (width, height) == (map.width, map.height) {
        true => Ok(colors),
        false => Err(EditError::input(
            file,
            format!("{width} x {height} pixels, the depths have {} x {}", map.width, map.height),
        )),
    }
}

/// From the units of the files to world units.
fn scale(map: &mut RangeMap, units: f64) {
    if units == 1.0 {
        return;
    }
    map.ranges.iter_mut().for_each(|r| *r = (f64::from(*r) * units) as f32);
    if let Projection::Orthographic { first, pitch } = &mut map.projection {
        (*first, *pitch) = (*first * units, *pitch * units);
    }
}

/// Confidence (σ₀/σ)² of each pixel, σ by a table of amplitudes, linear between its entries.
fn confide(
    map: &mut RangeMap,
    file: &Path,
    table: &[[f64; 2]],
    noise: Option<f64>,
    place: &dyn Fn(String) -> EditError,
) -> Result<()> {
    let rising = table.windows(2).all(|pair| pair[0][0] < pair[1][0]);
    if table.is_empty() || !rising || table.iter().any(|entry| !(entry[1] > 0.0 && entry[1].is_finite())) {
        return Err(place("noise_table: pairs of rising amplitudes and positive deviations are wanted".into()));
    }
    let Some(bytes) = bytes(file)? else { return Err(EditError::input(file, "there is no such file")) };
    let (width, height, amplitudes) = png::read(file, &bytes)?;
    if (width, height) != (map.width, map.height) {
        return Err(EditError::input(
            file,
            format!("{width} x {height} pixels, the depths have {} x {}", map.width, map.height),
        ));
    }
    let least = table.iter().map(|entry| entry[1]).fold(f64::INFINITY, f64::min);
    let reference = noise.unwrap_or(least);
    let deviation = |amplitude: f64| {
        let above = table.partition_point(|entry| entry[0] <= amplitude);
        match (above.checked_sub(1).and_then(|n| table.get(n)), table.get(above)) {
            (Some(a), Some(b)) => a[1] + (b[1] - a[1]) * (amplitude - a[0]) / (b[0] - a[0]),
            (Some(only), None) | (None, Some(only)) => only[1],
            (None, None) => reference,
        }
    };
    for (weight, amplitude) in map.weights.iter_mut().zip(amplitudes) {
        *weight *= (reference / deviation(f64::from(amplitude))).powi(2).min(1.0) as f32;
    }
    map.noise = Some(reference);
    Ok(())
}

fn affine(rows: &[[f64; 4]; 4]) -> DAffine3 {
    DAffine3::from_mat4(DMat4::from_cols_array_2d(rows).transpose())
}

/// Poses of a trajectory: a line of numbers, then a matrix of four lines, for each.
fn trajectory(path: &Path) -> Result<Vec<DAffine3>> {
    let Some(text) = text(path)? else { return Err(EditError::input(path, "there is no such file")) };
    let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
    let poses = lines.chunks(5).enumerate().map(|(n, chunk)| {
        let refused =
            || EditError::input(path, format!("pose {}: a matrix of four lines with four numbers is wanted", n + 1));
        let mut rows = [[0.0; 4]; 4];
        for (row, line) in rows.iter_mut().zip(chunk.get(1..5).ok_or_else(refused)?) {
            let numbers: Vec<f64> = line.split_whitespace().map_while(|word| word.parse().ok()).collect();
            *row = numbers.try_into().map_err(|_| refused())?;
        }
        Ok(affine(&rows))
    });
    poses.collect()
}

/// The camera of a JSON file of Open3D: `intrinsic_matrix`, column by column.
fn open3d(path: &PathBuf) -> Result<Camera> {
    let Some(text) = text(path)? else { return Err(EditError::input(path, "there is no such file")) };
    let value: serde_json::Value =
        serde_json::from_str(&text).map_err(|e| EditError::input(path, format!("is no JSON: {e}")))?;
    let matrix = value.get("intrinsic_matrix").and_then(|m| m.as_array());
    let number = |n: usize| matrix.and_then(|m| m.get(n)).and_then(serde_json::Value::as_f64);
    match [0, 4, 6, 7].map(number) {
        [Some(fx), Some(fy), Some(cx), Some(cy)] => Ok(Camera { focal: [fx, fy], centre: [cx, cy] }),
        _ => Err(EditError::input(path, "an `intrinsic_matrix` of nine numbers is wanted")),
    }
}
