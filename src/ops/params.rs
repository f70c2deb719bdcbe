//! Kinds of parameters: lengths with units, vectors, regions. They read the same from JSON and from the command line.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use glam::DVec3;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use crate::error::EditError;
use crate::grid::VOXEL_SIZES;

/// A number with an optional unit: `3vx` is voxels, `0.5wu` world units.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Quantity {
    value: f64,
    unit: Option<Unit>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Unit {
    Voxels,
    World,
}

impl Quantity {
    fn in_world(self, bare: Unit, voxel_size: f64) -> f64 {
        match self.unit.unwrap_or(bare) {
            Unit::World => self.value,
            Unit::Voxels => self.value * voxel_size,
        }
    }
}

impl FromStr for Quantity {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let (number, unit) = match (text.strip_suffix("vx"), text.strip_suffix("wu")) {
            (Some(number), _) => (number, Some(Unit::Voxels)),
            (_, Some(number)) => (number, Some(Unit::World)),
            _ => (text, None),
        };
        match number.trim_end().parse() {
            Ok(value) => Ok(Self { value, unit }),
            Err(_) => Err(format!("`{text}` is not a length: a number, `3vx` (voxels) or `0.5wu` (world units)")),
        }
    }
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unit = match self.unit {
            None => "",
            Some(Unit::Voxels) => "vx",
            Some(Unit::World) => "wu",
        };
        write!(f, "{}{unit}", self.value)
    }
}

/// Implements a kind of length: a [`Quantity`] whose bare numbers have the given unit.
macro_rules! length {
    ($(#[$doc:meta])* $name:ident, $bare:expr, $schema:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct $name(Quantity);

        impl Default for $name {
            /// Zero.
            fn default() -> Self {
                Self::new(0.0)
            }
        }

        impl $name {
            /// A length in the unit of bare numbers.
            pub const fn new(value: f64) -> Self {
                Self(Quantity { value, unit: None })
            }

            /// One voxel, whatever its size.
            pub const fn voxel() -> Self {
                Self::in_voxels(1.0)
            }

            /// So many voxels, whatever their size.
            pub const fn in_voxels(value: f64) -> Self {
                Self(Quantity { value, unit: Some(Unit::Voxels) })
            }

            /// In world units.
            pub fn world(self, voxel_size: f64) -> f64 {
                self.0.in_world($bare, voxel_size)
            }

            /// In voxels.
            pub fn voxels(self, voxel_size: f64) -> f64 {
                self.world(voxel_size) / voxel_size
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl FromStr for $name {
            type Err = String;

            fn from_str(text: &str) -> Result<Self, String> {
                text.parse().map(Self)
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                match self.0.unit {
                    None => serializer.serialize_f64(self.0.value),
                    Some(_) => serializer.collect_str(&self.0),
                }
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                match NumberOrText::deserialize(deserializer)? {
                    NumberOrText::Number(value) => Ok(Self::new(value)),
                    NumberOrText::Text(text) => text.parse().map_err(de::Error::custom),
                }
            }
        }

        impl JsonSchema for $name {
            fn schema_name() -> Cow<'static, str> {
                stringify!($name).into()
            }

            fn inline_schema() -> bool {
                true
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({ "type": ["number", "string"], "x-kind": $schema })
            }
        }
    };
}

length!(
    /// A length that places or sizes something: a bare number is in world units.
    WorldLength,
    Unit::World,
    "length (world units, or `3vx`)"
);
length!(
    /// A length that tunes numerics near the surface: a bare number is in voxels.
    VoxelLength,
    Unit::Voxels,
    "length (voxels, or `0.5wu`)"
);

#[derive(Deserialize)]
#[serde(untagged)]
enum NumberOrText {
    Number(f64),
    Text(String),
}

/// The voxel size in world units, or why it cannot be one: positive, finite and not itself in voxels.
pub(crate) fn voxel_size(operation: &str, size: WorldLength) -> Result<f64, EditError> {
    // Asked in a world whose voxels have no size, a length in voxels is no number.
    let world = size.world(f64::NAN);
    if VOXEL_SIZES.contains(&world) {
        return Ok(world);
    }
    let accepted = format!("a size in world units between {:e} and {:e}", VOXEL_SIZES.start(), VOXEL_SIZES.end());
    Err(EditError::parameter(operation, "voxel_size", size, accepted))
}

/// Comma-separated numbers.
pub(crate) fn parse_numbers(text: &str) -> Result<Vec<f64>, String> {
    text.split(',')
        .map(|part| part.trim().parse().map_err(|_| format!("`{}` in `{text}` is not a number", part.trim())))
        .collect()
}

/// A point or direction: `x,y,z`, or `[x, y, z]` in a recipe.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Vector(pub DVec3);

impl FromStr for Vector {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match parse_numbers(text)?[..] {
            [x, y, z] if x.is_finite() && y.is_finite() && z.is_finite() => Ok(Self(DVec3::new(x, y, z))),
            _ => Err(format!("`{text}` is not three finite numbers `x,y,z`")),
        }
    }
}

impl Serialize for Vector {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.0.to_array().serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Vector {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Form {
            Array([f64; 3]),
            Text(String),
        }
        match Form::deserialize(deserializer) {
            Ok(Form::Array(v)) => Ok(Self(DVec3::from(v))),
            Ok(Form::Text(text)) => text.parse().map_err(de::Error::custom),
            Err(_) => Err(de::Error::custom("expected three numbers `x,y,z`")),
        }
    }
}

impl JsonSchema for Vector {
    fn schema_name() -> Cow<'static, str> {
        "Vector".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": ["array", "string"], "items": { "type": "number" }, "minItems": 3, "maxItems": 3, "x-kind": "x,y,z"
        })
    }
}

/// Implements an enum of words: read, shown and listed by the same names.
macro_rules! words {
    ($(#[$doc:meta])* $name:ident { $($(#[$variant_doc:meta])* $variant:ident = $word:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        #[schemars(inline)]
        pub enum $name {
            $($(#[$variant_doc])* #[serde(rename = $word)] $variant,)+
        }
    };
}
pub(crate) use words;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_know_their_unit() {
        let voxel = |t: &str| t.parse::<VoxelLength>().unwrap();
        assert_eq!(voxel("3").world(0.5), 1.5);
        assert_eq!(voxel("3wu").world(0.5), 3.0);
        assert_eq!(voxel("3 vx").voxels(0.5), 3.0);
        assert_eq!("2vx".parse::<WorldLength>().unwrap().world(0.5), 1.0);
        assert!("2m".parse::<WorldLength>().unwrap_err().contains("3vx"));
        for text in ["3vx", "-0.5wu", "7"] {
            let length: WorldLength = text.parse().unwrap();
            assert_eq!(length.to_string(), text);
            let json = serde_json::to_value(length).unwrap();
            assert_eq!(serde_json::from_value::<WorldLength>(json).unwrap(), length);
        }
    }

    #[test]
    fn vectors_read_arrays_and_text() {
        for json in ["[1, -2.5, 3]", "\"1,-2.5,3\"", "\" 1, -2.5 ,3\""] {
            assert_eq!(serde_json::from_str::<Vector>(json).unwrap().0, DVec3::new(1.0, -2.5, 3.0));
        }
        for json in ["[1, 2]", "\"1,2\"", "\"1,2,nan\"", "\"1,2,x\"", "7"] {
            assert!(serde_json::from_str::<Vector>(json).is_err(), "{json}");
        }
    }
}
