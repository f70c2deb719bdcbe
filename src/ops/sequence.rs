//! Lists whose entries are written under several names: an option each on the command line, a key each in a recipe.

use super::registry::Parameter;

/// A list parameter with several names: each value becomes an entry of the list, after the name's prefix, in the order in
/// which they are written.
pub struct Sequence {
    /// The parameter.
    pub parameter: &'static str,
    /// Its names.
    pub options: &'static [SequenceOption],
}

/// A name of a [`Sequence`].
pub struct SequenceOption {
    /// As it is written in a recipe (`region_not`).
    pub name: &'static str,
    /// What goes before its values.
    pub prefix: &'static str,
    /// What a value looks like.
    pub value_name: &'static str,
    /// Instead of the parameter's own.
    pub help: Option<&'static str>,
}

const fn option(
    name: &'static str,
    prefix: &'static str,
    value_name: &'static str,
    help: Option<&'static str>,
) -> SequenceOption {
    SequenceOption { name, prefix, value_name, help }
}

const SEQUENCES: &[Sequence] = &[
    Sequence {
        parameter: "region",
        options: &[
            option("region", "", "SPEC", None),
            option("region_or", "or ", "SPEC", Some("Unite with the regions before")),
            option("region_not", "not ", "SPEC", Some("Leave out the inside of this region")),
        ],
    },
    Sequence {
        parameter: "steps",
        options: &[
            option("scale", "scale ", "FACTOR", Some("Scale by this factor")),
            option("rotate", "rotate ", "AXIS,DEGREES", Some("Rotate: `y,90`, or a quaternion `x,y,z,w`")),
            option("translate", "translate ", "X,Y,Z", Some("Move, in world units")),
            option("mirror", "mirror ", "AXIS", Some("Mirror along x, y or z")),
        ],
    },
];

impl Parameter {
    /// The names of its entries, if they have several.
    pub fn sequence(&self) -> Option<&'static Sequence> {
        SEQUENCES.iter().find(|s| s.parameter == self.name && self.is_list)
    }
}
