//! Examples of the operators: commands for the help and for the pages of `docs/operators`, which draw their pictures.

/// An operator in use.
pub struct Example {
    /// Its name.
    pub operator: &'static str,
    /// What the picture shows.
    pub shows: &'static str,
    /// Commands, run in the folder of the project; the last one draws the picture, if there is one, under the operator's name.
    pub commands: &'static [&'static str],
}

/// Commands for the help of verbs that are no operators.
const VERBS: &[(&str, &str)] = &[
    ("info", "vdb-edit info a.vdb b.obj"),
    ("convert", "vdb-edit convert bunny.ply -o bunny.vdb --resolution 256"),
    ("compare", "vdb-edit compare a.vdb b.vdb --tolerance 0.1"),
    ("geodesic", "vdb-edit geodesic a.vdb --from 0,0,1 -o distances.ply"),
    ("render", "vdb-edit render a.vdb -o a.png --color-by curvature --size 1920x1080"),
    ("crosscheck", "vdb-edit crosscheck a.vdb --only offset"),
    ("run", "vdb-edit run session.toml --set voxel_size=0.01 --frames 1-24"),
    ("schema", "vdb-edit schema > recipe.schema.json"),
    ("completions", "vdb-edit completions bash > /etc/bash_completion.d/vdb-edit"),
    ("man", "vdb-edit man smooth | man -l -"),
];

/// A command of a verb or of an operator, for its help.
pub fn command_of(name: &str) -> Option<&'static str> {
    let of_verb = VERBS.iter().find(|(verb, _)| *verb == name).map(|(_, command)| *command);
    of_verb.or_else(|| Example::of(name)?.command())
}

impl Example {
    /// Of an operator.
    pub fn of(operator: &str) -> Option<&'static Self> {
        EXAMPLES.iter().find(|example| example.operator == operator)
    }

    /// The first command of the operator itself.
    fn command(&self) -> Option<&'static str> {
        let own = format!("vdb-edit {} ", super::options::kebab(self.operator));
        self.commands.iter().copied().find(|command| command.starts_with(&own))
    }
}

/// One an operator.
const EXAMPLES: &[Example] = &[
    Example {
        operator: "shape",
        shows: "A round box, a superellipsoid, and a difference.",
        commands: &[
            "vdb-edit shape 'box size=2,1.4,1 round=0.2' -o a.vdb --voxel-size 0.02",
            "vdb-edit shape 'superellipsoid radii=1,0.8,0.7 exponents=0.3,0.3' -o b.vdb --voxel-size 0.02",
            "vdb-edit shape 'difference(sphere radius=1, cylinder radius=0.5 height=3)' -o c.vdb --voxel-size 0.02",
            "vdb-edit render a.vdb b.vdb c.vdb -o shape.png --columns 3 --size 260x220",
        ],
    },
    Example {
        operator: "segment",
        shows: "A density at 0.2, and the same with a smoother surface.",
        commands: &[
            "vdb-edit segment assets/three_grids.vdb --volume-grid density -o a.vdb --iso 0.2",
            "vdb-edit segment assets/three_grids.vdb --volume-grid density -o b.vdb --iso 0.2 --smoothness 0.1",
            "vdb-edit render a.vdb b.vdb -o segment.png --columns 2 --size 260x220",
        ],
    },
    Example {
        operator: "reconstruct",
        shows: "",
        commands: &["vdb-edit reconstruct scans.conf -o solid.vdb --resolution 200 --beta 0.5"],
    },
    Example {
        operator: "transform",
        shows: "The model, turned by 40 degrees, and mirrored at seven tenths of its size.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit transform spot.vdb -o turned.vdb --rotate y,40",
            "vdb-edit transform spot.vdb -o small.vdb --mirror x --scale 0.7",
            "vdb-edit render spot.vdb turned.vdb small.vdb -o transform.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "csg",
        shows: "Union, difference, and a union whose edge is rounded by a radius of 0.2.",
        commands: &[
            "vdb-edit shape 'box size=2,1,1' -o box.vdb --voxel-size 0.02",
            "vdb-edit shape 'cylinder radius=0.35 height=2 axis=y' -o rod.vdb --voxel-size 0.02",
            "vdb-edit csg union box.vdb rod.vdb -o union.vdb",
            "vdb-edit csg difference box.vdb rod.vdb -o difference.vdb",
            "vdb-edit csg smooth-union box.vdb rod.vdb -o smooth.vdb --radius 0.2",
            "vdb-edit render union.vdb difference.vdb smooth.vdb -o csg.png --columns 3 --size 260x220",
        ],
    },
    Example {
        operator: "blend",
        shows: "A plain union; blended within 6 and within 14 voxels of the edge.",
        commands: &[
            "vdb-edit shape 'box size=2,1,1' -o box.vdb --voxel-size 0.02",
            "vdb-edit shape 'cylinder radius=0.35 height=2 axis=y' -o rod.vdb --voxel-size 0.02",
            "vdb-edit csg union box.vdb rod.vdb -o union.vdb",
            "vdb-edit blend box.vdb rod.vdb -o narrow.vdb --d-min 4 --d-max 6",
            "vdb-edit blend box.vdb rod.vdb -o wide.vdb --d-min 12 --d-max 14",
            "vdb-edit render union.vdb narrow.vdb wide.vdb -o blend.png --columns 3 --size 260x220",
        ],
    },
    Example {
        operator: "smooth",
        shows: "The model, and 10 and 60 iterations of mean curvature flow in a sphere around its head.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 160",
            "vdb-edit smooth spot.vdb -o little.vdb --iterations 10 --region 'sphere center=0,0.6,-0.4 radius=0.7'",
            "vdb-edit smooth spot.vdb -o much.vdb --iterations 60 --region 'sphere center=0,0.6,-0.4 radius=0.7'",
            "vdb-edit render spot.vdb little.vdb much.vdb -o smooth.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "sharpen",
        shows: "A scan, and 5 and 12 iterations.",
        commands: &[
            "vdb-edit convert assets/nefertiti_70k.ply -o bust.vdb --resolution 200",
            "vdb-edit sharpen bust.vdb -o little.vdb --iterations 5",
            "vdb-edit sharpen bust.vdb -o much.vdb --iterations 12",
            "vdb-edit render bust.vdb little.vdb much.vdb -o sharpen.png --columns 3 --size 230x210 --camera 20,5",
        ],
    },
    Example {
        operator: "fillet",
        shows: "A sharp union; its concave edges filled to a radius of 0.1 and of 0.25.",
        commands: &[
            "vdb-edit shape 'box size=2,1,1' -o box.vdb --voxel-size 0.02",
            "vdb-edit shape 'cylinder radius=0.35 height=2 axis=y' -o rod.vdb --voxel-size 0.02",
            "vdb-edit csg union box.vdb rod.vdb -o union.vdb",
            "vdb-edit fillet union.vdb -o narrow.vdb --radius 0.1",
            "vdb-edit fillet union.vdb -o wide.vdb --radius 0.25",
            "vdb-edit render union.vdb narrow.vdb wide.vdb -o fillet.png --columns 3 --size 260x220",
        ],
    },
    Example {
        operator: "emboss",
        shows: "A drawing stamped by 2 and by 6 voxels, and engraved by 4.",
        commands: &[
            "vdb-edit shape 'sphere radius=1' -o ball.vdb --voxel-size 0.02",
            "vdb-edit emboss ball.vdb -o low.vdb --svg assets/vdb.svg --at 0,0,1 --up 0,1,0 --size 1.2 --height 2vx",
            "vdb-edit emboss ball.vdb -o high.vdb --svg assets/vdb.svg --at 0,0,1 --up 0,1,0 --size 1.2 --height 6vx",
            "vdb-edit emboss ball.vdb -o engraved.vdb --svg assets/vdb.svg --at 0,0,1 --up 0,1,0 --size 1.2 --height -4vx",
            "vdb-edit render low.vdb high.vdb engraved.vdb -o emboss.png --columns 3 --size 260x220 --camera 20,15",
        ],
    },
    Example {
        operator: "texture",
        shows: "One star on a patch of radius 0.5, three by three of them on the same patch, and stars scattered all over.",
        commands: &[
            "vdb-edit shape 'sphere radius=1' -o ball.vdb --voxel-size 0.03",
            "vdb-edit texture ball.vdb assets/star.obj -o one.vdb --center 0,0,1 --radius 0.5 --loose drop",
            "vdb-edit texture ball.vdb assets/star.obj -o tiled.vdb --center 0,0,1 --radius 0.7 --tile 3,3 --height 0.15",
            "vdb-edit texture ball.vdb assets/star.obj -o scattered.vdb --scatter 'spacing=0.7 radius=0.25 seed=1'",
            "vdb-edit render one.vdb tiled.vdb scattered.vdb -o texture.png --columns 3 --size 260x220 --camera 20,15",
        ],
    },
    Example {
        operator: "warp",
        shows: "The model, its head drawn up, and the same within a sphere with a soft edge.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit warp spot.vdb -o all.vdb --handle 0,0.9,-0.4:0,1.3,-0.4 --fixed 0,-0.7,0.3",
            "vdb-edit warp spot.vdb -o near.vdb --handle 0,0.9,-0.4:0,1.3,-0.4 --region 'sphere center=0,0.6,-0.4 radius=0.9 soft=0.2,1'",
            "vdb-edit render spot.vdb all.vdb near.vdb -o warp.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "sweep",
        shows: "A box carried along a curve, turning with it and not.",
        commands: &[
            "vdb-edit shape 'box size=0.3,0.3,0.5 center=-1,0,0' -o box.vdb --voxel-size 0.02",
            "vdb-edit sweep box.vdb -o turned.vdb --through -1,0,0 --through 0,0.5,0 --through 1,0,0",
            "vdb-edit sweep box.vdb -o level.vdb --through -1,0,0 --through 0,0.5,0 --through 1,0,0 --turning none",
            "vdb-edit render turned.vdb level.vdb -o sweep.png --columns 2 --size 260x220",
        ],
    },
    Example {
        operator: "advect",
        shows: "A surface, and the same carried for 0.2 and 0.6 units of time.",
        commands: &[
            "vdb-edit shape 'sphere center=1.5,1.5,1.5 radius=1' -o ball.vdb --voxel-size 0.03",
            "vdb-edit advect ball.vdb -o early.vdb --velocity assets/three_grids.vdb --time 0.2",
            "vdb-edit advect ball.vdb -o late.vdb --velocity assets/three_grids.vdb --time 0.6",
            "vdb-edit render ball.vdb early.vdb late.vdb -o advect.png --columns 3 --size 260x220",
        ],
    },
    Example {
        operator: "morph",
        shows: "Frames 1, 3 and 5 of five.",
        commands: &[
            "vdb-edit shape 'box size=1,1,1' -o cube.vdb --voxel-size 0.02",
            "vdb-edit shape 'torus major=0.5 minor=0.2' -o donut.vdb --voxel-size 0.02",
            "vdb-edit morph cube.vdb donut.vdb -o morph.####.vdb --frame-count 5",
            "vdb-edit render morph.0001.vdb morph.0003.vdb morph.0005.vdb -o morph.png --columns 3 --size 260x220 --up z",
        ],
    },
    Example {
        operator: "offset",
        shows: "The surface moved inwards by 0.05, as it is, and outwards by 0.1.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit offset spot.vdb -o thin.vdb --distance -0.05",
            "vdb-edit offset spot.vdb -o thick.vdb --distance 0.1",
            "vdb-edit render thin.vdb spot.vdb thick.vdb -o offset.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "dilate",
        shows: "As it is, and dilated by 0.05 and 0.1.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit dilate spot.vdb -o little.vdb --distance 0.05",
            "vdb-edit dilate spot.vdb -o much.vdb --distance 0.1",
            "vdb-edit render spot.vdb little.vdb much.vdb -o dilate.png --columns 3 --size 250x210 --camera 200,15",
        ],
    },
    Example {
        operator: "erode",
        shows: "As it is, and eroded by 0.03 and 0.06.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit erode spot.vdb -o little.vdb --distance 0.03",
            "vdb-edit erode spot.vdb -o much.vdb --distance 0.06",
            "vdb-edit render spot.vdb little.vdb much.vdb -o erode.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "open",
        shows: "As it is, and without what is thinner than 0.1 and than 0.3.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit open spot.vdb -o little.vdb --distance 0.05",
            "vdb-edit open spot.vdb -o much.vdb --distance 0.15",
            "vdb-edit render spot.vdb little.vdb much.vdb -o open.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "close",
        shows: "As it is, and with gaps narrower than 0.1 and 0.4 filled.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit close spot.vdb -o little.vdb --distance 0.05",
            "vdb-edit close spot.vdb -o much.vdb --distance 0.2",
            "vdb-edit render spot.vdb little.vdb much.vdb -o close.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "rebuild",
        shows: "The same surface in a wider band, and the surfaces three and seven voxels outside of it.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit rebuild spot.vdb -o wide.vdb --half-width 8",
            "vdb-edit rebuild wide.vdb -o outer.vdb --iso 3vx",
            "vdb-edit rebuild wide.vdb -o outermost.vdb --iso 7vx",
            "vdb-edit render wide.vdb outer.vdb outermost.vdb -o rebuild.png --columns 3 --size 260x220 --camera 200,15",
        ],
    },
    Example {
        operator: "renormalize",
        shows: "Nothing that can be seen moves: the colour says how far, up to 0.05 voxel.",
        commands: &[
            "vdb-edit convert assets/spot.obj -o spot.vdb --resolution 128",
            "vdb-edit renormalize spot.vdb -o once.vdb --iterations 1 --scheme first",
            "vdb-edit renormalize spot.vdb -o often.vdb --iterations 10",
            "vdb-edit render once.vdb often.vdb -o renormalize.png --columns 2 --size 260x220 --camera 200,15 --color-by difference:spot.vdb --range 0.05",
        ],
    },
];
