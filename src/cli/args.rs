//! Options that many commands share.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::builder::ValueParser;
use clap::{Arg, ArgAction, ArgMatches, Command, ValueEnum, ValueHint, value_parser};

use super::progress::When;
use super::report::Format;
use super::{options, size};
use crate::ops::Vector;
use crate::stencil::simd::Isa;

/// Headings of the help.
const RUNNING: &str = "Running";
const INPUT: &str = "Reading";
const OUTPUT: &str = "Writing";

/// `--isa`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum IsaChoice {
    /// The best of this machine.
    Auto,
    /// What every machine has.
    Portable,
    /// AVX2.
    Avx2,
    /// AVX-512.
    Avx512,
}

impl IsaChoice {
    /// The instruction set, `None` for the best.
    pub fn isa(self) -> Option<Isa> {
        match self {
            Self::Auto => None,
            Self::Portable => Some(Isa::Portable),
            Self::Avx2 => Some(Isa::Avx2),
            Self::Avx512 => Some(Isa::Avx512),
        }
    }
}

/// `--memory-limit`; `None` is no limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryLimit(pub Option<u64>);

/// How a command is run: of every command.
pub fn running(command: Command) -> Command {
    command.args(
        [
            Arg::new("threads")
                .long("threads")
                .value_name("N")
                .value_parser(value_parser!(u32).range(1..=4096))
                .help("Threads to use [default: all]; every number gives the same bits"),
            Arg::new("memory-limit")
                .long("memory-limit")
                .value_name("SIZE")
                .value_parser(ValueParser::new(|text: &str| size::parse(text).map(MemoryLimit)))
                .help("Refuse work that needs more memory: 500M, 2GiB, none [default: 80 % of the machine's]"),
            Arg::new("quiet")
                .long("quiet")
                .short('q')
                .action(ArgAction::SetTrue)
                .help("Say nothing but warnings and errors"),
            Arg::new("json")
                .long("json")
                .action(ArgAction::SetTrue)
                .help("Print the result as one JSON object on standard output"),
            Arg::new("log-format")
                .long("log-format")
                .value_parser(value_parser!(Format))
                .hide_possible_values(true)
                .value_name("text|json")
                .help("Form of messages on standard error [default: text]"),
            Arg::new("progress")
                .long("progress")
                .value_parser(value_parser!(When))
                .hide_possible_values(true)
                .value_name("auto|always|never")
                .help("A bar on a terminal, else a line a step [default: auto]"),
            Arg::new("isa")
                .long("isa")
                .value_parser(value_parser!(IsaChoice))
                .hide_possible_values(true)
                .value_name("auto|portable|avx2|avx512")
                .help("Instruction set; every one gives the same bits [default: auto]"),
        ]
        .map(|arg| arg.global(true).help_heading(RUNNING)),
    )
}

/// Which grid of a `.vdb` is meant, and what to do with one that is not quite a level set.
pub fn grids(command: Command) -> Command {
    command.args(
        [
            Arg::new("grid").long("grid").value_name("NAME").action(ArgAction::Append).help(
                "The level set to take: NAME, or NAME[n] where several have it; given several times, one an input",
            ),
            Arg::new("assume-level-set")
                .long("assume-level-set")
                .action(ArgAction::SetTrue)
                .help("Take float grids whose class was never set for level sets"),
            Arg::new("repair")
                .long("repair")
                .action(ArgAction::SetTrue)
                .help("Make an invalid level set valid first, and say how"),
        ]
        .map(|arg| arg.help_heading(INPUT)),
    )
}

/// How meshes become level sets. Options that the operator has itself are left to it.
pub fn conversion(command: Command, own: impl Fn(&str) -> bool) -> Command {
    let args = [
        Arg::new("voxel_size")
            .long("voxel-size")
            .value_name("LENGTH")
            .allow_hyphen_values(true)
            .value_parser(ValueParser::new(options::length))
            .help("Edge of a voxel in world units, for meshes [default: that of a .vdb among the inputs, else by --resolution]"),
        Arg::new("resolution")
            .long("resolution")
            .value_name("N")
            .allow_hyphen_values(true)
            .value_parser(ValueParser::new(options::length))
            .conflicts_with("voxel_size")
            .help("Voxels along the longest axis of all meshes together [default: 256]"),
        Arg::new("half_width")
            .long("half-width")
            .value_name("LENGTH")
            .allow_hyphen_values(true)
            .value_parser(ValueParser::new(options::length))
            .help("Half width of the narrow band of meshes, in voxels (or `0.5wu`) [default: 3]"),
        Arg::new("strict")
            .long("strict")
            .action(ArgAction::SetTrue)
            .help("Refuse open, flipped or self-intersecting meshes instead of repairing them"),
    ];
    args.into_iter().fold(command, |command, arg| {
        let id = arg.get_id().as_str();
        // Of the two sizes, the operator has both or none.
        if own(id) || (id == "resolution" && own("voxel_size")) {
            command
        } else {
            command.arg(arg.help_heading(INPUT))
        }
    })
}

/// Where the result goes, and in which form.
pub fn output(command: Command) -> Command {
    command.args(
        [
            path("output")
                .long("output")
                .short('o')
                .value_name("OUT")
                .required(true)
                .help("Where the result goes: .vdb, a mesh (.obj .ply .stl .glb .gltf .off), or `-` for a .vdb on standard output"),
            Arg::new("check")
                .long("check")
                .action(ArgAction::SetTrue)
                .help("Verify the invariants of the result; write nothing and exit with 1 if one does not hold"),
            path("preview").long("preview").value_name("FILE.png").help("A picture of before and after, side by side"),
            Arg::new("dry-run").long("dry-run").action(ArgAction::SetTrue).help("Say what would be done; write nothing"),
            Arg::new("only-result")
                .long("only-result")
                .action(ArgAction::SetTrue)
                .help("Leave the other grids of the input out of the output"),
            path("attributes-from").long("attributes-from").value_name("MESH").help(
                "Give a mesh result the colours and texture coordinates of this mesh, by closest point",
            ),
            Arg::new("precision")
                .long("precision")
                .value_parser(["float", "half"])
                .hide_possible_values(true)
                .value_name("float|half")
                .help("How a .vdb stores values [default: as the input, else float]"),
            Arg::new("compression")
                .long("compression")
                .value_parser(["blosc", "zip", "none"])
                .hide_possible_values(true)
                .value_name("blosc|zip|none")
                .help("How a .vdb is compressed [default: as the input, else blosc]"),
        ]
        .map(|arg| arg.help_heading(OUTPUT)),
    )
}

/// An argument that is a file.
pub fn path(id: &'static str) -> Arg {
    Arg::new(id).value_parser(value_parser!(PathBuf)).value_hint(ValueHint::FilePath)
}

/// Whether a flag was given; `false` where the command has no such flag.
pub fn flag(matches: &ArgMatches, id: &str) -> bool {
    matches.try_get_one::<bool>(id).ok().flatten().copied().unwrap_or(false)
}

/// The files of an argument.
pub fn paths(matches: &ArgMatches, id: &str) -> Vec<PathBuf> {
    matches.try_get_many::<PathBuf>(id).ok().flatten().map(|paths| paths.cloned().collect()).unwrap_or_default()
}

/// The arguments with `--from A B C` spelled `--from A --from B --from C`: an option that takes any number of values which may begin with a
/// minus would take the options after it as well.
pub fn with_repeated_points(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    const OPTION: &str = "--from";
    let is_point = |text: &OsString| text.to_str().is_some_and(|text| text.parse::<Vector>().is_ok());
    let mut spelled: Vec<OsString> = Vec::new();
    let mut points = 0;
    for argument in arguments {
        points = match (argument == OPTION, points > 0 && is_point(&argument)) {
            (true, _) => 1,
            (_, true) => points + 1,
            _ => 0,
        };
        if points > 2 {
            spelled.push(OPTION.into());
        }
        spelled.push(argument);
    }
    spelled
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn several_points_behind_one_option() {
        let spelled = |line: &str| with_repeated_points(line.split(' ').map(OsString::from)).join(" ".as_ref());
        assert_eq!(spelled("g --from 0,0,1 -1,0,0 2,2,2 -o f"), "g --from 0,0,1 --from -1,0,0 --from 2,2,2 -o f");
        assert_eq!(spelled("g --from 0,0,1 --from -1,0,0 x 1,1,1"), "g --from 0,0,1 --from -1,0,0 x 1,1,1");
    }
}
