//! What is promised of every operator, asked of each one in the registry: a new operator is tested by being listed.

mod common;

use glam::{DVec3, IVec3};
use serde_json::{Map, Value, json};
use std::sync::OnceLock;
use tempfile::TempPath;
use vdb_edit::LevelSet;
use vdb_edit::grid::{Transform, offset_to_local};
use vdb_edit::ops::csg::{CsgOperation, csg};
use vdb_edit::ops::{Arity, Entry, REGISTRY, find};
use vdb_edit::region::RegionPlan;
use vdb_edit::run::RunOptions;

const DX: f64 = 0.1;
/// Acts on about a third of each subject.
const REGION: &str = "sphere center=0.8,0,0 radius=0.9";

/// Parameters without which an operator has nothing to do.
fn needed(entry: &Entry) -> Map<String, Value> {
    let values = match entry.name {
        "shape" => json!({ "spec": "torus major=1 minor=0.4 axis=x", "voxel_size": DX }),
        // Off the lattice, so that voxels are computed.
        "transform" => json!({ "steps": ["rotate z,30", "translate 0.123,0,0"] }),
        "segment" => json!({ "volume": scan(), "iso": 0.0 }),
        "reconstruct" => json!({ "scans": scans(), "voxel_size": DX }),
        "morph" => json!({ "at": 0.5 }),
        "emboss" => json!({ "points": points() }),
        "texture" => json!({ "center": "-1.15,0,0", "radius": 0.3, "height": 0.25 }),
        "warp" => json!({ "handle": ["1.1,0,0:1.11,0.01,0"], "fixed": ["-1,0,0", "0,1,0", "0,0,1"] }),
        "sweep" => json!({ "through": ["0,0,0", "0.2,0.1,0"] }),
        "advect" => json!({ "velocity": velocity(), "time": 0.004 }),
        _ => json!({}),
    };
    values.as_object().unwrap().clone()
}

/// The operators whose files are at hand: velocities are not among what this repository ships.
fn operators() -> impl Iterator<Item = &'static Entry> {
    let velocities = common::shared("vdb").is_some();
    REGISTRY.iter().filter(move |entry| velocities || entry.name != "advect")
}

/// A grid of vectors: 0, −15, 0 between −2 and 2 along each axis.
fn velocity() -> String {
    common::shared("vdb").map(|folder| folder.join("velocity_vec3s.vdb").display().to_string()).unwrap_or_default()
}

/// A file that stays for the whole run.
fn file(place: &'static OnceLock<TempPath>, suffix: &str, text: impl FnOnce() -> String) -> String {
    let path = place.get_or_init(|| {
        let mut file = tempfile::Builder::new().suffix(suffix).tempfile().unwrap();
        std::io::Write::write_all(&mut file, text().as_bytes()).unwrap();
        file.into_temp_path()
    });
    path.display().to_string()
}

/// Points beside every subject.
fn points() -> String {
    static FILE: OnceLock<TempPath> = OnceLock::new();
    file(&FILE, ".xyz", || "1.4 0.05 0\n0 0.9 0.1\n-1.35 0 0\n".into())
}

/// A scan of a ball of 8 voxels.
fn scan() -> String {
    static FILE: OnceLock<TempPath> = OnceLock::new();
    file(&FILE, ".nrrd", || {
        let mut text = String::from("NRRD0004\ntype: float\ndimension: 3\nsizes: 24 24 24\nencoding: text\n\n");
        for i in 0..24 * 24 * 24 {
            let p = IVec3::new(i % 24, i / 24 % 24, i / 576).as_dvec3() - 11.5;
            text += &format!("{:.3}\n", 8.0 - p.length());
        }
        text
    })
}

/// Two pictures of a ball, from the left and from the right.
fn scans() -> String {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, 32, 32);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Sixteen);
        let depth = |n: i32| {
            let (x, y) = (f64::from(n % 32) * 0.1 - 1.55, f64::from(n / 32) * 0.1 - 1.55);
            let squared = 1.0 - x * x - y * y;
            if squared > 0.0 { ((4.0 - squared.sqrt()) * 1e4) as u16 } else { 0 }
        };
        let data: Vec<u8> = (0..1024).flat_map(|n| depth(n).to_be_bytes()).collect();
        encoder.write_header().unwrap().write_image_data(&data).unwrap();
        std::fs::write(folder.path().join("a.png"), bytes).unwrap();
        let text = "version = 1\nscale = 1e-4\nbackground = \"empty\"\northographic = { pitch = [0.1, 0.1], first = [-1.55, -1.55] }\n\
            [[map]]\nfile = \"a.png\"\npose = [[0,0,1,4],[1,0,0,0],[0,1,0,0],[0,0,0,1]]\n\
            [[map]]\nfile = \"a.png\"\npose = [[0,0,-1,-4],[-1,0,0,0],[0,1,0,0],[0,0,0,1]]\n";
        std::fs::write(folder.path().join("set.toml"), text).unwrap();
        folder
    });
    folder.path().join("set.toml").display().to_string()
}

fn made(distance: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
    let (transform, bounds) = (Transform::uniform(DX), (IVec3::splat(-24), IVec3::splat(24)));
    LevelSet::from_distance(transform, 3.0, bounds, |ijk| distance(ijk * DX) / DX, &RunOptions::default()).unwrap()
}

fn box_distance(p: DVec3, half: DVec3) -> f64 {
    let q = p.abs() - half;
    q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
}

/// A smooth surface, sharp edges, and a field that is no distance near the crease.
fn subjects() -> Vec<(&'static str, LevelSet)> {
    let sphere = made(|p| p.distance(DVec3::new(0.03, -0.02, 0.01)) - 1.2);
    let block = made(|p| box_distance(p - DVec3::new(0.2, 0.0, 0.05), DVec3::new(1.0, 0.7, 0.5)));
    let union = csg(&sphere, &[&block], CsgOperation::Difference, &RunOptions::default()).unwrap();
    vec![("sphere", sphere), ("box", block), ("difference", union)]
}

fn inputs(entry: &Entry, subject: &LevelSet) -> Vec<LevelSet> {
    let other = || made(|p| p.distance(DVec3::new(0.9, 0.4, 0.2)) - 0.8);
    match entry.arity {
        Arity::Source => vec![],
        Arity::One => vec![subject.clone()],
        Arity::Many | Arity::BaseAndSolid => vec![subject.clone(), other()],
    }
}

fn run(entry: &Entry, values: Map<String, Value>, subject: &LevelSet) -> LevelSet {
    let outcome = entry.run(values, inputs(entry, subject), &RunOptions::default());
    outcome.unwrap_or_else(|e| panic!("{}: {e}", entry.name)).level_set
}

/// Everything of a level set, bit by bit.
type Bits = (Vec<(IVec3, Vec<u32>, Vec<usize>)>, Vec<(IVec3, i32)>, u32, Transform);

fn bits(level_set: &LevelSet) -> Bits {
    let grid = level_set.grid();
    let leaf = |&id| {
        let values = grid.values(id).0.iter().map(|v| v.to_bits()).collect();
        (grid.origin(id), values, grid.mask(id).iter().collect())
    };
    let leaves = grid.leaves().iter().map(leaf).collect();
    (leaves, grid.inside_tiles(), level_set.background().to_bits(), *level_set.transform())
}

#[test]
fn names_are_unique_and_well_formed() {
    let word = |name: &str| {
        !name.is_empty()
            && name.starts_with(|c: char| c.is_ascii_lowercase())
            && !name.ends_with('_')
            && !name.contains("__")
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
    };
    for (i, entry) in REGISTRY.iter().enumerate() {
        assert!(word(entry.name), "{}", entry.name);
        assert!(REGISTRY[..i].iter().all(|other| other.name != entry.name), "{} is there twice", entry.name);
        assert_eq!(find(entry.name).unwrap().name, entry.name);
        let parameters = entry.parameters();
        for (j, parameter) in parameters.iter().enumerate() {
            assert!(word(&parameter.name), "{}: {}", entry.name, parameter.name);
            assert!(parameters[..j].iter().all(|other| other.name != parameter.name), "{}", parameter.name);
        }
        let misspelt = format!("{}x", entry.name);
        assert!(find(&misspelt).err().unwrap().to_string().contains(&format!("`{}`", entry.name)), "{misspelt}");
    }
}

#[test]
fn every_operator_and_parameter_is_documented() {
    let sentence = |text: &str| text.starts_with(char::is_uppercase) && text.trim_end().ends_with('.');
    for entry in REGISTRY {
        assert!(sentence(&entry.help()), "{}: `{}`", entry.name, entry.help());
        for parameter in entry.parameters() {
            assert!(sentence(&parameter.help), "{} {}: `{}`", entry.name, parameter.name, parameter.help);
            assert!(!parameter.kind.is_empty() && parameter.kind != "value", "{} {}", entry.name, parameter.name);
        }
    }
}

#[test]
fn defaults_agree_with_the_schema_and_survive_json() {
    for entry in operators() {
        let schema = entry.schema();
        let properties = schema.get("properties").and_then(Value::as_object).unwrap();
        let mut defaults = needed(entry);
        for parameter in entry.parameters() {
            let said = properties[&parameter.name].get("default").cloned().unwrap_or(Value::Null);
            assert_eq!(said, parameter.default, "{} {}: schema and default", entry.name, parameter.name);
            if !parameter.default.is_null() {
                defaults.entry(parameter.name).or_insert(parameter.default);
            }
        }
        let text = serde_json::to_string(&defaults).unwrap();
        let back: Map<String, Value> = serde_json::from_str(&text).unwrap();
        assert_eq!(back, defaults);
        entry.check(back).unwrap_or_else(|e| panic!("{}: its own defaults are refused: {e}", entry.name));
    }
}

/// Said or left unsaid, a default does the same.
#[cfg(feature = "cli")]
#[test]
fn defaults_given_in_toml_change_nothing() {
    let (_, subject) = &subjects()[2];
    for entry in operators() {
        let mut table = needed(entry);
        for parameter in entry.parameters().into_iter().filter(|p| !p.default.is_null()) {
            table.entry(parameter.name).or_insert(parameter.default);
        }
        let text = toml::to_string(&table).unwrap();
        let back: Map<String, Value> = toml::from_str(&text).unwrap();
        let (said, unsaid) = (run(entry, back, subject), run(entry, needed(entry), subject));
        assert!(bits(&said) == bits(&unsaid), "{}: {text}", entry.name);
    }
}

#[test]
fn unknown_parameters_are_refused_with_the_nearest() {
    for entry in operators() {
        for parameter in entry.parameters() {
            let misspelt = format!("{}x", parameter.name);
            let mut values = needed(entry);
            values.insert(misspelt.clone(), json!(1));
            let error = entry.check(values).unwrap_err();
            assert_eq!(error.exit_code(), 2);
            let text = error.to_string();
            assert!(text.contains(entry.name) && text.contains(&misspelt), "{text}");
            assert!(text.contains(&format!("did you mean `{}`", parameter.name)), "{text}");
        }
    }
}

#[test]
fn values_of_the_wrong_kind_are_blamed_by_name() {
    for entry in operators() {
        for parameter in entry.parameters() {
            for wrong in [json!({ "a": 1 }), json!([[1]]), json!("no such word, no number")] {
                // Any text may name a file; one that is not there is another error.
                let takes_text = ["string", "FILE"].contains(&parameter.kind.as_str()) || parameter.is_list;
                if wrong.is_string() && takes_text {
                    continue;
                }
                let mut values = needed(entry);
                values.insert(parameter.name.clone(), wrong.clone());
                let error = entry.check(values).err().unwrap_or_else(|| {
                    panic!("{} takes {wrong} for {}", entry.name, parameter.name);
                });
                assert_eq!(error.exit_code(), 2, "{error}");
                assert!(error.to_string().contains(&parameter.name), "{error}");
            }
        }
    }
}

#[test]
fn the_number_of_inputs_is_checked() {
    let (_, subject) = &subjects()[0];
    for entry in operators() {
        let wrong: &[usize] = match entry.arity {
            Arity::Source => &[1, 2],
            Arity::One => &[0, 2],
            Arity::Many => &[0, 1],
            Arity::BaseAndSolid => &[0, 1, 3],
        };
        for &count in wrong {
            let result = entry.run(needed(entry), vec![subject.clone(); count], &RunOptions::default());
            let error = result.err().unwrap_or_else(|| panic!("{} takes {count} inputs", entry.name));
            assert_eq!(error.exit_code(), 2);
            assert!(error.to_string().contains("inputs"), "{error}");
        }
    }
}

#[test]
fn results_are_valid_level_sets_and_inputs_stay_as_they_were() {
    for (name, subject) in subjects() {
        assert_eq!(subject.check(), [], "{name}");
        let before = bits(&subject);
        for entry in operators() {
            let result = run(entry, needed(entry), &subject);
            assert_eq!(result.check(), [], "{} of the {name}", entry.name);
            assert!(!result.is_empty(), "{} of the {name}", entry.name);
            assert!(bits(&subject) == before, "{} changed its input", entry.name);
        }
    }
}

#[test]
fn nothing_in_gives_nothing_out() {
    let nothing = LevelSet::empty(Transform::uniform(DX), 3.0);
    for entry in operators().filter(|entry| entry.arity != Arity::Source) {
        let count = if entry.arity == Arity::One { 1 } else { 2 };
        let outcome = entry.run(needed(entry), vec![nothing.clone(); count], &RunOptions::default());
        let result = outcome.unwrap_or_else(|e| panic!("{}: {e}", entry.name)).level_set;
        assert!(result.is_empty() && result.check().is_empty(), "{}", entry.name);
    }
}

#[test]
fn runs_and_thread_counts_agree_to_the_last_bit() {
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (one, four) = (pool(1), pool(4));
    for (name, subject) in subjects() {
        for entry in operators() {
            let once = || bits(&run(entry, needed(entry), &subject));
            let alone = one.install(once);
            assert!(alone == one.install(once), "{} of the {name}: two runs", entry.name);
            assert!(alone == four.install(once), "{} of the {name}: one thread and four", entry.name);
        }
    }
}

#[test]
fn a_cancelled_run_says_so() {
    let (_, subject) = &subjects()[0];
    for entry in operators() {
        let options = RunOptions::default();
        options.cancel_flag().store(true, std::sync::atomic::Ordering::Relaxed);
        let result = entry.run(needed(entry), inputs(entry, subject), &options);
        let error = result.err().unwrap_or_else(|| panic!("{} ran although cancelled", entry.name));
        assert_eq!(error.exit_code(), 130, "{}: {error}", entry.name);
    }
}

/// Every voxel that was active and has weight 0 keeps its bits.
#[test]
fn nothing_happens_outside_the_region() {
    let plan = RegionPlan::parse(&[REGION.into()]).unwrap().unwrap();
    let mut limited = 0;
    for entry in operators().filter(|entry| entry.parameters().iter().any(|p| p.name == "region")) {
        limited += 1;
        for (name, subject) in subjects() {
            let mut values = needed(entry);
            values.insert("region".into(), json!(REGION));
            let region = plan.on(&subject, &RunOptions::default()).unwrap();
            let result = run(entry, values, &subject);
            assert_eq!(result.check(), [], "{} of the {name}", entry.name);
            let (mut kept, mut changed) = (0, 0);
            // Of several level sets one is made first, and that is what stays.
            let subject = match entry.arity {
                Arity::Many => {
                    csg(&subject, &[&inputs(entry, &subject)[1]], CsgOperation::Union, &RunOptions::default()).unwrap()
                }
                _ => subject,
            };
            let grid = subject.grid();
            let mut after = result.grid().accessor();
            for &id in grid.leaves() {
                for offset in grid.mask(id).iter() {
                    let ijk = grid.origin(id) + offset_to_local(offset);
                    let (was, is) = (grid.values(id).0[offset], after.value(ijk));
                    if region.weight(subject.transform().voxel_to_world(ijk)) == 0.0 {
                        assert!(was.to_bits() == is.to_bits() && after.is_active(ijk), "{} {name} {ijk}", entry.name);
                        kept += 1;
                    } else {
                        changed += usize::from(was != is);
                    }
                }
            }
            assert!(kept > 500 && changed > 200, "{} of the {name}: {kept} kept, {changed} changed", entry.name);
        }
    }
    assert!(limited > 0);
}
