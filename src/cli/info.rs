//! `info`: what files hold, and whether the level sets in them are valid.

use std::path::{Path, PathBuf};

use clap::{Arg, ArgAction, ArgMatches, Command};
use glam::DVec3;
use serde_json::{Map, Value, json};

use super::context::Context;
use super::{Verb, args, files, size, table};
use crate::error::{EditError, Result};
use crate::files::input::{self, InputOptions};
use crate::files::output;
use crate::files::volume::{self, BandState, Description, GridDescription, VolumeGrid};
use crate::levelset::{CurvatureKind, LevelSet, Measures, Violation, curvature};
use crate::mesh::{self, MeshFormat};
use crate::render::{CURVATURE_RANGE, vertex_colors};
use crate::spec;

/// The command.
pub const VERB: Verb = Verb { name: "info", build, run };

fn build(command: Command) -> Command {
    let files = args::path("input").value_name("FILE").num_args(1..).required(true).help("A .vdb, a mesh, or `-`");
    let check = Arg::new("check")
        .long("check")
        .action(ArgAction::SetTrue)
        .help("Exit with 1 when a level set breaks an invariant");
    let curvature = Arg::new("write-curvature")
        .long("write-curvature")
        .num_args(2)
        .value_names(["mean|gaussian|min|max", "FILE"])
        .help("Write a curvature of the level set: to a .vdb as a float grid, after all that the file holds; to a mesh (.ply, .obj, .glb, .gltf, .off) as vertex colours");
    let command = command.about("Say what files hold, measure level sets and verify their invariants");
    args::grids(command.arg(files).arg(check).arg(curvature)).mut_arg("repair", |arg| arg.hide(true))
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let paths: Vec<PathBuf> = args::paths(matches, "input");
    let options = files::input_options(matches)?;
    let curvature = CurvatureFile::plan(matches, &paths)?;
    let mut found = Vec::new();
    for path in &paths {
        found.push(examine(path, &options, context)?);
    }
    if let (Some(curvature), [file]) = (curvature, &mut found[..]) {
        curvature.write(&paths, &options, file, context)?;
    }
    for warning in found.iter().flat_map(|file| &file.warnings) {
        context.reporter.warn(warning);
    }
    let mut files: Vec<Value> = found.iter().map(|file| file.json.clone()).collect();
    let value = if files.len() == 1 { files.remove(0) } else { json!({ "files": files }) };
    context.reporter.result(&value, || found.iter().map(|file| file.text.as_str()).collect())?;
    let violations: Vec<&String> = found.iter().flat_map(|file| &file.violations).collect();
    if args::flag(matches, "check") && !violations.is_empty() {
        let said = violations.iter().map(|v| v.as_str()).collect::<Vec<_>>().join("; ");
        return Err(EditError::Unmet { operation: "--check".into(), problem: said });
    }
    Ok(())
}

/// A curvature to be written.
struct CurvatureFile {
    kind: CurvatureKind,
    /// The name of the kind on the command line.
    word: &'static str,
    path: PathBuf,
}

impl CurvatureFile {
    const KINDS: [(&str, CurvatureKind); 4] = [
        ("mean", CurvatureKind::Mean),
        ("gaussian", CurvatureKind::Gaussian),
        ("min", CurvatureKind::Min),
        ("max", CurvatureKind::Max),
    ];

    /// What `--write-curvature` asks for, refused now if it could not be done later.
    fn plan(matches: &ArgMatches, inputs: &[PathBuf]) -> Result<Option<Self>> {
        let Some(mut values) = matches.get_many::<String>("write-curvature") else { return Ok(None) };
        let (Some(word), Some(path)) = (values.next(), values.next()) else { return Ok(None) };
        let refuse =
            |value: &str, accepted: String| Err(EditError::parameter("info", "write-curvature", value, accepted));
        let Some((known, kind)) = Self::KINDS.into_iter().find(|(name, _)| name == word) else {
            return refuse(word, spec::suggest(word, Self::KINDS.into_iter().map(|(name, _)| name)));
        };
        let path = PathBuf::from(path);
        let is_mesh = MeshFormat::of(&path).is_some_and(MeshFormat::has_attributes);
        if input::is_pipe(&path) || !(is_mesh || input::is_volume(&path)) {
            let accepted =
                "a file name that ends in .vdb, or one of a mesh with colours: .ply, .obj, .glb, .gltf, .off";
            return refuse(&path.display().to_string(), accepted.into());
        }
        if inputs.len() != 1 || inputs.iter().any(|input| input::is_pipe(input)) {
            return refuse(word, "one input that is a file".into());
        }
        output::writable(&path)?;
        Ok(Some(Self { kind, word: known, path }))
    }

    /// Computes and writes it, and adds it to what is said of the file.
    fn write(self, inputs: &[PathBuf], options: &InputOptions, found: &mut Found, context: &Context) -> Result<()> {
        // The grid that the level set was read from is written as well.
        let loaded = input::load_whole(inputs, options, &mut found.warnings, &context.run)?;
        let Some(input) = loaded.first() else { return Ok(()) };
        let field = curvature(&input.level_set, self.kind, &context.run)?;
        let (least, most) = field.range().unwrap_or_default();
        let unit = if self.kind == CurvatureKind::Gaussian { "world unit²" } else { "world unit" };
        let shown = |v: f64| table::number(v);
        let mut written = json!({
            "kind": self.word, "output": self.path.display().to_string(),
            "voxels": field.grid().active_voxels(), "min": least, "max": most,
        });
        let mut note = |key: &str, value: Value| {
            if let Some(object) = written.as_object_mut() {
                object.insert(key.to_owned(), value);
            }
        };
        if !input::is_volume(&self.path) {
            // Red and blue are full at a ball of as many voxels in every kind of curvature.
            let full = CURVATURE_RANGE / input.level_set.voxel_size();
            let full = if self.kind == CurvatureKind::Gaussian { full * full } else { full };
            let mut mesh = mesh::level_set_to_mesh(&input.level_set, 0.0, &context.run)?;
            mesh.colors = Some(vertex_colors(&mesh.positions, &field, full));
            mesh::write(&self.path, &mesh)?;
            note("color_range", json!([-full, full]));
            note("vertices", mesh.positions.len().into());
            found.text += &format!(
                "{}: vertex colours by {} curvature, {} .. {} per {unit}; blue at -{}, red at {}\n",
                self.path.display(),
                self.word,
                shown(least.into()),
                shown(most.into()),
                shown(full),
                shown(full)
            );
            found.insert("curvature", written);
            return Ok(());
        }
        let name = format!("{}_curvature", self.word);
        let to_write = volume::FieldToWrite { field: &field, name: &name };
        let (bytes, warnings) =
            volume::write_field(&self.path, &input.level_set, to_write, input.from().map(|(volume, _)| volume))?;
        found.warnings.extend(warnings);
        note("grid", name.as_str().into());
        note("bytes", bytes.into());
        found.text += &format!(
            "{}: grid {name}, {} .. {} per {unit}\n",
            self.path.display(),
            shown(least.into()),
            shown(most.into())
        );
        found.insert("curvature", written);
        Ok(())
    }
}

/// What was found in a file.
#[derive(Default)]
struct Found {
    json: Value,
    text: String,
    warnings: Vec<String>,
    /// Broken invariants, each with file and grid.
    violations: Vec<String>,
}

impl Found {
    fn insert(&mut self, key: &str, value: Value) {
        if let Some(object) = self.json.as_object_mut() {
            object.insert(key.to_owned(), value);
        }
    }
}

fn examine(path: &Path, options: &InputOptions, context: &Context) -> Result<Found> {
    if input::is_volume(path) {
        let description = volume::describe(path, options.choice(0), &context.run)?;
        examine_volume(path, description, context)
    } else {
        examine_mesh(path)
    }
}

fn examine_volume(path: &Path, description: Description, context: &Context) -> Result<Found> {
    let mut found = Found::default();
    let mut grids = Vec::new();
    found.text = format!("{}: file format {}\n", path.display(), description.format);
    for (name, value) in &description.metadata {
        found.text += &format!("  {name} = {value}\n");
    }
    if description.grids.is_empty() {
        found.text += "  no grid\n";
    }
    for grid in &description.grids {
        context.run.check("info")?;
        let facts = match &grid.level_set {
            Some(Ok(read)) => Some(LevelSetFacts::of(&read.level_set, context)?),
            _ => None,
        };
        if let Some(facts) = &facts {
            let place = format!("{} [{}]", path.display(), grid.selector);
            found.violations.extend(facts.violations.iter().map(|v| format!("{place}: {v}")));
        }
        if let Some(Err(problem)) = &grid.level_set {
            found.warnings.push(problem.clone());
            found.violations.push(problem.clone());
        }
        found.text += &grid_text(grid, facts.as_ref());
        grids.push(grid_json(grid, facts.as_ref()));
    }
    found.json = json!({ "file": path.display().to_string(), "grids": grids, "metadata": description.metadata });
    Ok(found)
}

/// What is measured of a level set.
struct LevelSetFacts {
    measures: Measures,
    violations: Vec<Violation>,
    active_voxels: u64,
    leaves: usize,
    bytes: u64,
    half_width: f32,
    bounds: Option<(DVec3, DVec3)>,
}

impl LevelSetFacts {
    fn of(level_set: &LevelSet, context: &Context) -> Result<Self> {
        let grid = level_set.grid();
        Ok(Self {
            measures: level_set.measure(&context.run)?,
            violations: level_set.check(),
            active_voxels: grid.active_voxels(),
            leaves: grid.leaves().len(),
            bytes: grid.bytes(),
            half_width: level_set.half_width(),
            bounds: level_set.world_bounds(),
        })
    }
}

fn band_note(read: &VolumeGrid) -> Option<&str> {
    match &read.band {
        BandState::Regular => None,
        BandState::Trim { what, .. } | BandState::Rebuild { what, .. } => Some(what),
    }
}

fn bounds_json(bounds: Option<(DVec3, DVec3)>) -> Value {
    bounds.map_or(Value::Null, |(lo, hi)| json!([lo.to_array(), hi.to_array()]))
}

/// One number where the voxel is a cube, else three.
fn voxel_size_json(size: DVec3) -> Value {
    match (size / size.x - 1.0).abs().max_element() < 1e-6 {
        true => json!(size.x),
        false => json!(size.to_array()),
    }
}

fn grid_json(grid: &GridDescription, facts: Option<&LevelSetFacts>) -> Value {
    let mut object = json!({
        "name": grid.name,
        "selector": grid.selector,
        "type": grid.value_type,
        "class": grid.class,
        "voxel_size": voxel_size_json(grid.voxel_size),
        "half_width": facts.map(|f| f.half_width),
        "active_voxels": facts.map(|f| f.active_voxels).or(grid.active_voxels),
        "leaves": facts.map(|f| f.leaves),
        "bbox_world": bounds_json(facts.and_then(|f| f.bounds).or(grid.bounds)),
        "memory_bytes": facts.map(|f| f.bytes),
        "storage": grid.storage,
        "metadata": grid.metadata,
        "level_set": facts.map(level_set_json),
    });
    let note = match &grid.level_set {
        Some(Ok(read)) => band_note(read).map(str::to_owned),
        Some(Err(problem)) => Some(problem.clone()),
        None => None,
    };
    if let (Some(object), Some(note)) = (object.as_object_mut(), note) {
        object.insert("note".into(), note.into());
    }
    object
}

fn level_set_json(facts: &LevelSetFacts) -> Value {
    let Measures { area, volume, mean_curvature_integral, components, surface_components, euler } = facts.measures;
    json!({
        "area": area,
        "volume": volume,
        "components": components,
        "surface_components": surface_components,
        "euler": euler,
        "mean_curvature_integral": mean_curvature_integral,
        "violations": facts.violations,
    })
}

/// Metadata that only repeats what the other lines say, as does everything that begins with `file_`.
const SAID_ABOVE: [&str; 3] = ["class", "name", "is_saved_as_half_float"];

fn grid_text(grid: &GridDescription, facts: Option<&LevelSetFacts>) -> String {
    let size = grid.voxel_size;
    let cube = voxel_size_json(size).is_number();
    let triple = |v: DVec3| [v.x, v.y, v.z].map(table::number).join(", ");
    let mut rows = vec![
        ("voxel size", if cube { table::number(size.x) } else { triple(size) } + " world units"),
        ("storage", grid.storage.clone()),
    ];
    if let Some(active) = facts.map(|f| f.active_voxels).or(grid.active_voxels) {
        rows.push(("active voxels", table::count(active)));
    }
    if let Some((lo, hi)) = facts.and_then(|f| f.bounds).or(grid.bounds) {
        rows.push(("bounding box", format!("{} .. {}", triple(lo), triple(hi))));
    }
    if let Some(facts) = facts {
        let measures = &facts.measures;
        rows.push(("half width", format!("{} voxels", table::number(facts.half_width.into()))));
        rows.push(("memory", format!("{} in {} leaves", size::shown(facts.bytes), table::count(facts.leaves as u64))));
        rows.push(("volume", format!("{} world units³", table::number(measures.volume))));
        rows.push(("area", format!("{} world units²", table::number(measures.area))));
        rows.push((
            "mean curvature",
            format!("{} world units, integrated", table::number(measures.mean_curvature_integral)),
        ));
        rows.push(("components", format!("{} ({} of the surface)", measures.components, measures.surface_components)));
        rows.push(("Euler number", measures.euler.to_string()));
    }
    let said = |name: &str| name.starts_with("file_") || SAID_ABOVE.contains(&name);
    for (name, value) in grid.metadata.iter().filter(|(name, _)| !said(name)) {
        rows.push((name, value.as_str().map_or_else(|| value.to_string(), str::to_owned)));
    }
    match &grid.level_set {
        Some(Ok(read)) => rows.extend(band_note(read).map(|note| ("band", note.to_owned()))),
        Some(Err(problem)) => rows.push(("cannot be edited", problem.clone())),
        None => {}
    }
    if let Some(facts) = facts {
        let valid = || "every invariant of a level set holds".to_owned();
        match facts.violations.is_empty() {
            true => rows.push(("valid", valid())),
            false => rows.extend(facts.violations.iter().map(|v| ("violated", v.to_string()))),
        }
    }
    format!("{}: {}, {}\n{}", grid.selector, grid.class, grid.value_type, table::pairs(rows))
}

fn examine_mesh(path: &Path) -> Result<Found> {
    let mut warnings = Vec::new();
    let mesh = input::read_mesh(path, &mut warnings)?;
    // As the conversion sees it: files store the corners of seams and STL triangles apart.
    let topology = mesh::prepare(&mesh).1.found;
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    let bounds = mesh.bounding_box();
    let facts = json!({
        "vertices": vertices,
        "triangles": triangles,
        "closed": topology.closed,
        "boundary_edges": topology.boundary_edges,
        "non_manifold_edges": topology.non_manifold_edges,
        "misoriented_edges": topology.misoriented_edges,
        "bbox_world": bounds_json(bounds),
    });
    let json = json!({
        "file": path.display().to_string(), "grids": [], "metadata": Map::<String, Value>::new(), "mesh": facts,
    });
    let mut rows = vec![
        ("vertices", table::count(vertices as u64)),
        ("triangles", table::count(triangles as u64)),
        (
            "closed",
            if topology.closed { "yes".into() } else { format!("no, {} boundary edges", topology.boundary_edges) },
        ),
    ];
    if let Some((lo, hi)) = bounds {
        let triple = |v: DVec3| [v.x, v.y, v.z].map(table::number).join(", ");
        rows.push(("bounding box", format!("{} .. {}", triple(lo), triple(hi))));
    }
    let text = format!("{}: mesh\n{}", path.display(), table::pairs(rows));
    Ok(Found { json, text, warnings, violations: Vec::new() })
}
