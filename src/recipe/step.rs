//! What a step does: an operator of the registry, or one of four things that are none.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::assert::Assertions;
use super::read::{Key, Source};
use super::render::Picture;
use crate::error::{EditError, Result};
use crate::files::input::InputOptions;
use crate::files::mesh_output::MeshParams;
use crate::files::output::VolumeOptions;
use crate::ops::{
    Arity, Entry, Parameter, ParameterSet, REGISTRY, SequenceOption, VoxelLength, WorldLength, parse, words,
};

/// A step of a recipe.
pub(super) struct Step {
    pub op: Op,
    pub name: Option<String>,
    pub line: usize,
    pub inputs: Vec<Source>,
    pub keys: Vec<Key>,
    /// How often later steps take its result.
    pub uses: usize,
    parameters: Vec<Parameter>,
}

/// What a key of a step stands for.
pub(super) enum Meaning<'a> {
    /// A parameter.
    Parameter(&'a Parameter),
    /// Entries of a list parameter, with what goes before them.
    Entries(&'a Parameter, &'static SequenceOption),
}

impl Step {
    pub fn new(op: Op, name: Option<String>, line: usize) -> Self {
        let parameters = op.set().list();
        Self { op, name, line, inputs: Vec::new(), keys: Vec::new(), uses: 0, parameters }
    }

    /// As errors name it.
    pub fn label(&self) -> String {
        let op = self.op.name();
        self.name.as_ref().map_or_else(|| op.to_owned(), |name| format!("{op} `{name}`"))
    }

    pub fn knows(&self, key: &str) -> bool {
        self.meaning(key).is_some()
    }

    pub fn meaning(&self, key: &str) -> Option<Meaning<'_>> {
        let entries = |p| {
            let parameter: &Parameter = p;
            let option = parameter.sequence()?.options.iter().find(|option| option.name == key)?;
            Some(Meaning::Entries(parameter, option))
        };
        let parameter = || self.parameters.iter().find(|p| p.name == key).map(Meaning::Parameter);
        self.parameters.iter().find_map(entries).or_else(parameter)
    }

    /// The keys that it could have.
    pub fn key_names(&self) -> Vec<String> {
        let options = self.parameters.iter().filter_map(Parameter::sequence).flat_map(|sequence| sequence.options);
        let options = options.map(|option| option.name).filter(|name| self.parameters.iter().all(|p| p.name != *name));
        self.parameters.iter().map(|p| p.name.clone()).chain(options.map(str::to_owned)).collect()
    }
}

/// What a step does.
#[derive(Clone, Copy)]
pub(super) enum Op {
    Operator(&'static Entry),
    Convert,
    Assert,
    Write,
    Render,
}

static CONVERT: ParameterSet = ParameterSet::of::<Conversion>(|values| Conversion::read(values).map(drop));
static ASSERT: ParameterSet = ParameterSet::of::<Assertions>(|values| Assertions::read(values).map(drop));
static WRITE: ParameterSet = ParameterSet::of::<Target>(|values| Target::read(values).map(drop));
static RENDER: ParameterSet = ParameterSet::of::<Picture>(|values| Picture::read(values).map(drop));

impl Op {
    const OTHERS: [Self; 4] = [Self::Convert, Self::Assert, Self::Write, Self::Render];

    /// All of them, in the order of the manual.
    pub fn all() -> impl Iterator<Item = Self> {
        REGISTRY.iter().map(Self::Operator).chain(Self::OTHERS)
    }

    pub fn names() -> Vec<&'static str> {
        Self::all().map(Self::name).collect()
    }

    pub fn find(name: &str) -> Option<Self> {
        Self::all().find(|op| op.name() == name)
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Operator(entry) => entry.name,
            Self::Convert => "convert",
            Self::Assert => "assert",
            Self::Write => "write",
            Self::Render => "render",
        }
    }

    pub fn set(self) -> &'static ParameterSet {
        match self {
            Self::Operator(entry) => entry.set(),
            Self::Convert => &CONVERT,
            Self::Assert => &ASSERT,
            Self::Write => &WRITE,
            Self::Render => &RENDER,
        }
    }

    /// Whether it makes a level set.
    pub fn makes(self) -> bool {
        matches!(self, Self::Operator(_) | Self::Convert)
    }

    pub fn reads_files_only(self) -> bool {
        matches!(self, Self::Convert)
    }

    /// Least and largest number of inputs, and that in words.
    pub fn inputs(self) -> (usize, usize, &'static str) {
        match self {
            Self::Operator(entry) => match entry.arity {
                Arity::Source => (0, 0, "no input: it makes a level set of nothing"),
                Arity::One => (1, 1, "one input: `input = \"…\"`"),
                Arity::BaseAndSolid => (2, 2, "two inputs, base and texture: `inputs = [\"…\", \"…\"]`"),
                Arity::Many => (2, usize::MAX, "two inputs or more: `inputs = [\"…\", \"…\"]`"),
            },
            Self::Convert => (1, 1, "one input: `input = \"…\"`, a file"),
            Self::Assert | Self::Write => (1, 1, "one input: `input = \"…\"`"),
            Self::Render => {
                (1, super::render::MOST_PICTURES, "one input, or `inputs` of up to eight beside each other")
            }
        }
    }
}

/// Read a file: a mesh becomes a level set, the level set of a `.vdb` is verified, a volume gives its surface at `iso`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub(super) struct Conversion {
    /// Edge of a voxel in world units, for meshes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voxel_size: Option<WorldLength>,
    /// Voxels along the longest axis of a mesh, instead of a voxel size; 256 if neither is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resolution: Option<f64>,
    /// Half width of the band of a mesh, in voxels; 3 if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub half_width: Option<VoxelLength>,
    /// The surface at this distance, positive outside; of a volume that is no level set, at this value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub iso: Option<WorldLength>,
    /// With `iso`, of a volume or scan: what lies below the value is inside.
    pub invert: bool,
    /// The level set to take: NAME, or NAME[n] where several have it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grid: Option<String>,
    /// Take float grids whose class was never set for level sets.
    pub assume_level_set: bool,
    /// Make an invalid level set valid first, and say how.
    pub repair: bool,
    /// Refuse open, flipped or self-intersecting meshes instead of repairing them.
    pub strict: bool,
}

impl Conversion {
    pub fn read(values: Map<String, Value>) -> Result<Self> {
        let read: Self = parse("convert", values)?;
        read.options().validate()?;
        Ok(read)
    }

    pub fn options(&self) -> InputOptions {
        InputOptions {
            grids: self.grid.iter().cloned().collect(),
            assume_level_set: self.assume_level_set,
            repair: self.repair,
            strict: self.strict,
            voxel_size: self.voxel_size,
            resolution: self.resolution,
            half_width: self.half_width,
        }
    }
}

words! {
    /// How values are stored.
    Precision {
        /// 32 bits.
        Float = "float",
        /// 16 bits.
        Half = "half",
    }
}

words! {
    /// How a `.vdb` is compressed.
    Compression {
        /// Fast.
        Blosc = "blosc",
        /// Smaller.
        Zip = "zip",
        /// Not at all.
        None = "none",
    }
}

/// Write a level set as a `.vdb`, or its surface as a mesh.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub(super) struct Target {
    /// Where to: .vdb, .obj, .ply, .stl, .glb, .gltf or .off. `####`, `%04d` and `$F4` become the frame.
    #[schemars(extend("x-kind" = "FILE"))]
    pub path: String,
    /// How a .vdb stores values; as the input if not given, else float.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub precision: Option<Precision>,
    /// How a .vdb is compressed; as the input if not given, else blosc.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compression: Option<Compression>,
    /// Leave the other grids of the file that the level set came from out.
    pub only_result: bool,
    /// To meshes: keep this part of the triangles, above 0 up to 1, where the surface bends most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simplify: Option<f64>,
    /// To meshes: larger triangles where it is flat; no vertex left out is farther than so many voxels, 0..1, from the result.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub adaptivity: Option<f64>,
    /// To meshes: quads instead of triangles.
    pub quads: bool,
    /// Give a mesh the colours and texture coordinates of this mesh, by closest point.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub attributes_from: Option<String>,
}

impl Target {
    pub fn read(values: Map<String, Value>) -> Result<Self> {
        let read: Self = parse("write", values)?;
        if read.path.is_empty() {
            return Err(EditError::parameter("write", "path", "nothing", "the file to be written"));
        }
        read.mesh().validate()?;
        Ok(read)
    }

    pub fn mesh(&self) -> MeshParams {
        MeshParams {
            simplify: self.simplify,
            adaptivity: self.adaptivity,
            quads: self.quads,
            attributes_from: self.attributes_from.as_ref().map(PathBuf::from),
        }
    }

    pub fn volume(&self) -> VolumeOptions {
        VolumeOptions {
            half: self.precision.map(|precision| precision == Precision::Half),
            compression: self.compression.map(|compression| {
                match compression {
                    Compression::Blosc => "blosc",
                    Compression::Zip => "zip",
                    Compression::None => "none",
                }
                .to_owned()
            }),
            only_result: self.only_result,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_parameter_is_named_as_a_key_of_steps() {
        for op in Op::all() {
            for parameter in op.set().list() {
                assert!(!super::super::read::STEP_KEYS.contains(&parameter.name.as_str()), "{}", op.name());
            }
        }
    }
}
