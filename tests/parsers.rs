//! Our parsers on input at random: an answer or an error, never a panic.
//!
//! Texts are strung together from the words that a parser knows, numbers at the edge of what they can be, and characters at random; files are real ones
//! with damage. What fails is made smaller by proptest until the least that fails is found. A second each; `PARSER_SECONDS` asks for more.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use vdb_edit::levelset::expression::Expression;
use vdb_edit::levelset::shapes::Solid;
use vdb_edit::mesh::{self, BezierPatches};
use vdb_edit::ops::{Vector, VoxelLength, WorldLength, find};
use vdb_edit::range::RangeSet;
use vdb_edit::recipe::{Recipe, parse_frames};
use vdb_edit::region::RegionPlan;
use vdb_edit::run::RunOptions;
use vdb_edit::scan::Scan;
use vdb_edit::spec::parse_rotation;

/// Runs `parse` on what `strategy` makes until the time is over; the runs of a test are the same each time it is run.
fn attack<S: Strategy>(strategy: S, parse: impl Fn(S::Value)) {
    let seconds = std::env::var("PARSER_SECONDS").ok().and_then(|s| s.parse().ok()).unwrap_or(1);
    let (began, limit) = (Instant::now(), Duration::from_secs(seconds));
    let config = Config { cases: 50, failure_persistence: None, ..Config::default() };
    // The generator goes on from one batch to the next.
    let rng = proptest::test_runner::TestRng::deterministic_rng(config.rng_algorithm);
    let mut runner = TestRunner::new_with_rng(config, rng);
    while began.elapsed() < limit {
        let result = runner.run(&strategy, |input| {
            parse(input);
            Ok(())
        });
        if let Err(error) = result {
            panic!("{error}");
        }
    }
}

/// What numbers are mistaken for, or cannot be.
const NUMBERS: &str = "0 -0 1 -1 0.5 3vx -2vx 1e-30 1e30 1e308 -1e309 nan inf 2147483647 -2147483648 4294967296 18446744073709551616 1,2,3 0,0,0 1,2 , . - e +";

/// Texts of the words that a parser knows.
fn texts(words: &'static str) -> impl Strategy<Value = String> {
    let known: Vec<&str> = words.split(' ').chain(NUMBERS.split(' ')).collect();
    let word = prop_oneof![
        8 => proptest::sample::select(known).prop_map(str::to_owned),
        1 => "\\PC{0,3}",
    ];
    let gap = prop_oneof![4 => Just(" "), 3 => Just(""), 1 => Just("\n"), 1 => Just("=")];
    vec((word, gap), 0..40).prop_map(|parts| parts.into_iter().map(|(word, gap)| word + gap).collect())
}

/// A file with damage: bytes overwritten, parts repeated, the end cut off.
fn damaged(original: Vec<u8>) -> impl Strategy<Value = Vec<u8>> {
    let change = (any::<prop::sample::Index>(), any::<prop::sample::Index>(), any::<u8>(), 0..40usize, 0..6u8);
    vec(change, 1..12).prop_map(move |changes| {
        let mut bytes = original.clone();
        for (at, from, byte, count, kind) in changes {
            if bytes.is_empty() {
                break;
            }
            let (at, from) = (at.index(bytes.len()), from.index(bytes.len()));
            let to = (at + count).min(bytes.len());
            match kind {
                0 => bytes.truncate(at),
                1 => bytes[at] = byte,
                2 => bytes[at..to].fill(byte),
                // A digit more makes counts huge, one less leaves values out.
                3 => bytes.splice(at..at, b"9".repeat(count / 8 + 1)).for_each(drop),
                4 => drop(bytes.drain(at..to)),
                _ => {
                    let part: Vec<u8> = bytes.iter().skip(from).take(count).copied().collect();
                    bytes.splice(at..at, part).for_each(drop);
                }
            }
        }
        bytes
    })
}

/// Writes what is to be read under a name in a folder of its own.
fn file(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

fn run() -> RunOptions {
    let mut run = RunOptions::default();
    run.memory_limit = Some(256 << 20);
    run
}

#[test]
fn lengths_vectors_rotations_and_frames() {
    attack(texts("vx x y z x, y, z, 90 :: 1-10 1..10 %04d x2 by"), |text| {
        let _ = (text.parse::<VoxelLength>(), text.parse::<WorldLength>(), text.parse::<Vector>());
        let _ = (parse_rotation(&text), parse_frames(&text));
    });
}

#[test]
fn shapes_and_expressions() {
    const WORDS: &str = "sphere box torus cylinder capsule superellipsoid supertoroid center= radius= size= axis=z major= minor= exponents= rotate=y,30 \
        union( difference( intersection( smooth-union( \" ) ( , mirror( radii= height= half=";
    attack(texts(WORDS), |text| {
        let _ = (Solid::parse(&text), Expression::parse(&text));
    });
    // Deep, and never closed.
    for text in ["union(".repeat(100_000), "(".repeat(100_000), "\"".repeat(99_999), "sphere ".repeat(50_000)] {
        assert!(Expression::parse(&text).is_err());
    }
}

#[test]
fn regions() {
    const WORDS: &str = "sphere box cylinder halfspace superellipsoid levelset mask curve points everything center= radius= size= normal= point= file= grid= \
        soft=0.8,1 invert d= near= union not and or inside= \"";
    attack(vec(texts(WORDS), 0..4), |texts| drop(RegionPlan::parse(&texts)));
}

#[test]
fn recipes() {
    const WORDS: &str = "[[step]] [recipe] op= op=\"smooth\" op=\"csg\" op=\"blend\" name=\"a\" from=\"a\" base=\"a\" input=\"x.vdb\" read=\"x.vdb\" write=\"y.vdb\" \
        frames=\"1-10\" region=\"sphere radius=1\" assert={ components=1 } keys=[ ] { } \" iterations= distance=\"3vx\" [frames] [variables] ${frame} ${ } # 1979-05-27";
    attack(texts(WORDS), |text| {
        if let Ok(recipe) = Recipe::parse(&text, Path::new("recipe.toml")) {
            let _ = recipe.plan(&[1]);
        }
    });
    let real: Vec<Vec<u8>> = std::fs::read_dir("examples/recipes")
        .unwrap()
        .map(|entry| std::fs::read(entry.unwrap().path()).unwrap())
        .filter(|text| !text.is_empty())
        .collect();
    assert!(real.len() > 10);
    attack(proptest::sample::select(real).prop_flat_map(damaged), |bytes| {
        let _ = Recipe::parse(&String::from_utf8_lossy(&bytes), Path::new("recipe.toml"));
    });
}

#[test]
fn values_of_operators() {
    // What recipes and the command line hand to an operator, by type and by range.
    let names: Vec<&str> = vdb_edit::ops::REGISTRY.iter().map(|entry| entry.name).collect();
    let value = || {
        prop_oneof![
            texts("vx add union curvature mean first weno5 true false").prop_map(serde_json::Value::from),
            any::<f64>().prop_map(serde_json::Value::from),
            any::<i64>().prop_map(serde_json::Value::from),
            any::<bool>().prop_map(serde_json::Value::from),
            vec(any::<f64>(), 0..4).prop_map(serde_json::Value::from),
            Just(serde_json::Value::Null),
        ]
    };
    let strategy = proptest::sample::select(names).prop_flat_map(move |name| {
        let keys: Vec<String> =
            find(name).unwrap().parameters().into_iter().map(|parameter| parameter.name.to_owned()).collect();
        (Just(name), vec((proptest::sample::select(keys), value()), 0..4))
    });
    attack(strategy, |(name, values)| {
        let _ = find(name).unwrap().check(values.into_iter().collect());
    });
}

#[test]
fn meshes() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let tetrahedron =
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0.5 0.5\nvn 0 0 1\nf 1/1/1 3/1/1 2/1/1\nf 1 2 4\nf 2 3 4\nf -4 -1 -2\n";
    let ply = "ply\nformat ascii 1.0\ncomment a\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
        element face 4\nproperty list uchar int vertex_indices\nend_header\n0 0 0 1\n1 0 0 2\n0 1 0 3\n0 0 1 4\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n";
    let stl = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n";
    let off = "OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n";
    let nurbs = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1 2\ncstype rat bspline\ndeg 1 1\nsurf 0 1 0 1 1 2 3 4\nparm u 0 0 1 1\nparm v 0 0 1 1\nend\n";
    let gltf = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"scale":[1,2,3]}],"meshes":[{"primitives":[{"attributes":
        {"POSITION":0},"indices":1,"mode":4}]}],"buffers":[{"byteLength":44,"uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAAAAABAAIAAAA="}],
        "bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":36},{"buffer":0,"byteOffset":36,"byteLength":6}],"accessors":[{"bufferView":0,
        "componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]},{"bufferView":1,"componentType":5123,"count":3,"type":"SCALAR"}]}"#;
    for (name, text) in
        [("a.obj", tetrahedron), ("b.obj", nurbs), ("a.ply", ply), ("a.stl", stl), ("a.off", off), ("a.gltf", gltf)]
    {
        attack(damaged(text.into()), |bytes| drop(mesh::read(&file(folder, name, &bytes))));
    }
    let bpt = format!("1\n3 3\n{}", "0.5 1 -2\n".repeat(16));
    assert!(BezierPatches::read(&file(folder, "a.bpt", bpt.as_bytes())).is_ok());
    attack(damaged(bpt.into()), |bytes| drop(BezierPatches::read(&file(folder, "a.bpt", &bytes))));
}

#[test]
fn scans_and_range_maps() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut nrrd = b"NRRD0004\ntype: float\ndimension: 3\nsizes: 3 2 2\nspace: left-posterior-superior\nspace directions: (1,0,0) (0,1,0) (0,0,2)\n\
        space origin: (0,0,0)\nendian: little\nencoding: raw\n\n"
        .to_vec();
    nrrd.extend([0u8; 48]);
    assert!(Scan::read(&file(folder, "a.nrrd", &nrrd), &run()).is_ok());
    attack(damaged(nrrd), |bytes| drop(Scan::read(&file(folder, "a.nrrd", &bytes), &run())));
    let mut nifti = vec![0u8; 352 + 12];
    nifti[..4].copy_from_slice(&348i32.to_le_bytes());
    for (at, value) in [(40, 3i16), (42, 3), (44, 2), (46, 2), (48, 1), (70, 2), (72, 8)] {
        nifti[at..at + 2].copy_from_slice(&value.to_le_bytes());
    }
    for at in (76..108).step_by(4) {
        nifti[at..at + 4].copy_from_slice(&1f32.to_le_bytes());
    }
    nifti[108..112].copy_from_slice(&352f32.to_le_bytes());
    nifti[344..348].copy_from_slice(b"n+1\0");
    assert!(Scan::read(&file(folder, "a.nii", &nifti), &run()).is_ok());
    attack(damaged(nifti), |bytes| drop(Scan::read(&file(folder, "a.nii", &bytes), &run())));
    let ptx = "2\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n0 0 1 0.5\n1 0 1 0.5\n0 1 1 0.5\n0 0 0 0.5\n";
    attack(damaged(ptx.into()), |bytes| drop(RangeSet::read(&file(folder, "a.ptx", &bytes), true, &run())));
    let toml = "noise = 0.01\nscale = 0.001\nbackground = \"far\"\ntrajectory = \"poses.txt\"\n[camera]\nwidth = 4\nheight = 3\nfx = 4.0\nfy = 4.0\ncx = 2\ncy = 1.5\n\
        [[map]]\nfile = \"a.ptx\"\npose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\nnoise_table = [[100, 0.01], [1000, 0.002]]\n";
    attack(damaged(toml.into()), |bytes| drop(RangeSet::read(&file(folder, "a.toml", &bytes), true, &run())));
    let conf = "camera 0 0 0 0 0 0 1\nmesh bun000.ply 0 0 0 0 0 0 1\nbmesh bun045.ply -0.05 -0.0004 -0.01 0.003 -0.37 -0.002 0.92\n";
    attack(damaged(conf.into()), |bytes| drop(RangeSet::read(&file(folder, "a.conf", &bytes), true, &run())));
}
