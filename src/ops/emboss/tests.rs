use std::path::PathBuf;

use glam::IVec3;
use tempfile::TempDir;

use super::*;
use crate::grid::{Transform, offset_to_local};
use crate::levelset::testing::{ball, box_distance};
use crate::ops::RegionSpecs;
use crate::render::Image;

/// A slab below z = 0, 80 × 80 × 20 voxels of half a unit.
fn slab() -> LevelSet {
    let half = DVec3::new(40.0, 40.0, 10.0);
    let bounds = (IVec3::new(-46, -46, -26), IVec3::new(46, 46, 16));
    let distance = move |p: DVec3| box_distance(p + DVec3::Z * half.z, half);
    LevelSet::from_distance(Transform::uniform(0.5), 3.0, bounds, distance, &RunOptions::default()).unwrap()
}

fn file(folder: &TempDir, name: &str, text: &str) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, text).unwrap();
    path
}

fn run(level_set: &LevelSet, emboss: &Emboss) -> Result<Outcome> {
    emboss.validate()?;
    let outcome = emboss.apply(vec![level_set.clone()], &RunOptions::default())?;
    assert_eq!(outcome.level_set.check(), []);
    Ok(outcome)
}

fn volume(level_set: &LevelSet) -> f64 {
    level_set.measure(&RunOptions::default()).unwrap().volume
}

/// A square ring, 40 × 40 with a hole of 20 × 20.
const RING: &str = r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 40 40"><path fill-rule="evenodd" d="M0 0H40V40H0Z M10 10H30V30H10Z"/></svg>"#;

fn stamp(svg: PathBuf) -> Emboss {
    Emboss {
        svg: Some(svg),
        at: Some(Vector(DVec3::new(1.0, 0.5, 0.2))),
        up: Some(Vector(DVec3::Y)),
        size: Some(WorldLength::new(20.0)),
        height: Some(WorldLength::new(2.0)),
        ..Emboss::default()
    }
}

#[test]
fn a_stamp_stands_out_with_sharp_edges() {
    let folder = tempfile::tempdir().unwrap();
    let slab = slab();
    for height in [2.0, -2.0] {
        let params = Emboss { height: Some(WorldLength::new(height)), ..stamp(file(&folder, "ring.svg", RING)) };
        let stamped = run(&slab, &params).unwrap().level_set;
        // The ring of area 20² − 10², 2 high; edges are cut by less than half a voxel along 120 units of length and 8 corners.
        let added = volume(&stamped) - volume(&slab);
        assert!((added - 300.0 * height).abs() < 8.0, "{added}");
        let phi = |x: f64, y: f64, z: f64| {
            f64::from(stamped.sampler().trilinear(stamped.transform().world_to_index(DVec3::new(x, y, z))))
        };
        // The wall at x = 1 + 10, half-way up; the inner one at 1 + 5; top and ground.
        let middle = height / 2.0;
        for (x, inside) in [(10.7, true), (11.3, false), (6.3, true), (5.7, false)] {
            assert_eq!(phi(x, 0.5, middle) < 0.0, inside == (height > 0.0), "{height} {x}");
        }
        assert!(phi(8.5, 0.5, height).abs() < 0.05 && phi(1.0, 0.5, 0.0).abs() < 0.05);
        // Beyond the band around the stamp nothing changes.
        for &id in slab.grid().leaves() {
            for offset in slab.grid().mask(id).iter() {
                let ijk = slab.grid().origin(id) + offset_to_local(offset);
                let p = slab.transform().voxel_to_world(ijk) - DVec3::new(1.0, 0.5, 0.0);
                if p.truncate().abs().max_element() > 10.0 + 4.0 * 0.5 || p.z < -4.0 {
                    assert_eq!(stamped.grid().voxel(ijk), slab.grid().voxel(ijk));
                }
            }
        }
    }
}

#[test]
fn a_stamp_follows_a_curved_surface() {
    let folder = tempfile::tempdir().unwrap();
    let ball = ball(DVec3::ZERO, 30.0);
    let disc = r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 2 2"><circle cx="1" cy="1" r="1"/></svg>"#;
    let params = Emboss {
        at: Some(Vector(DVec3::new(40.0, 0.0, 0.0))),
        up: None,
        size: Some(WorldLength::new(40.0)),
        height: Some(WorldLength::new(4.0)),
        ..stamp(file(&folder, "disc.svg", disc))
    };
    let stamped = run(&ball, &params).unwrap().level_set;
    let mut sampler = stamped.sampler();
    // A cap of radius 34 up to the angle 20/30, with walls along the normals.
    for i in 0..12 {
        let around = f64::from(i) * std::f64::consts::FRAC_PI_6;
        let at =
            |theta: f64, r: f64| DVec3::new(theta.cos(), theta.sin() * around.cos(), theta.sin() * around.sin()) * r;
        for theta in [0.0, 0.3, 0.6] {
            assert!(sampler.trilinear(at(theta, 34.0)).abs() < 0.1, "{theta} {around}");
        }
        let wall = 20.0 / 30.0;
        assert!(
            sampler.trilinear(at(wall - 0.03, 32.0)) < 0.0 && sampler.trilinear(at(wall + 0.03, 32.0)) > 0.0,
            "{around}"
        );
        assert!(sampler.trilinear(at(0.9, 30.0)).abs() < 0.05);
    }
}

#[test]
fn brightness_is_height() {
    let folder = tempfile::tempdir().unwrap();
    // From black on the left to white on the right.
    let rgba8 = (0..64).flat_map(|i| [(i % 16 * 17) as u8; 3].into_iter().chain([255])).collect();
    let path = folder.path().join("ramp.png");
    Image { width: 16, height: 4, rgba8 }.write_png(std::fs::File::create(&path).unwrap()).unwrap();
    let params = Emboss { image: Some(path), svg: None, ..stamp(PathBuf::new()) };
    let raised = run(&slab(), &params).unwrap().level_set;
    for x in [-6.0, 0.0, 4.0, 7.0] {
        // Pixels are 1.25 wide; their middles hold 0 to 15 fifteenths.
        let expected = ((x + 10.0) / 1.25 - 0.5) / 15.0 * 2.0;
        let mut sampler = raised.sampler();
        let phi = sampler.trilinear(raised.transform().world_to_index(DVec3::new(x + 1.0, 0.5, expected)));
        assert!(phi.abs() < 0.06, "{x} {phi}");
    }
}

#[test]
fn text_has_the_area_of_its_outlines() {
    let font = std::env::var_os("VDB_EDIT_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from)
        .join("data/textures/DejaVuSans.ttf");
    if !font.is_file() {
        eprintln!("SKIPPED: {} is absent", font.display());
        return;
    }
    let slab = slab();
    let text = |text: &str| Emboss {
        text: Some(text.into()),
        font: Some(font.clone()),
        svg: None,
        size: Some(WorldLength::new(34.0)),
        ..stamp(PathBuf::new())
    };
    let stamped = run(&slab, &text("HO\nT")).unwrap().level_set;
    let added = volume(&stamped) - volume(&slab);
    // The area by counting points on a lattice of a tenth of a voxel.
    let outline = Drawing::of_text("HO\nT", &font).unwrap().outline(34.0, 0.01).unwrap();
    let covered = (0..700 * 900).filter(|i| {
        outline.distance(DVec2::new(f64::from(i % 700), f64::from(i / 700)) * 0.05 - DVec2::new(17.5, 22.5)) < 0.0
    });
    let area = covered.count() as f64 * 0.0025;
    assert!(area > 100.0 && (added / (2.0 * area) - 1.0).abs() < 0.03, "{added} {area}");
    for (refused, code, part) in [("", 2, "visible"), (" \n ", 2, "visible"), ("a\u{e000}b", 3, "U+E000")] {
        let error = run(&slab, &text(refused)).err().unwrap();
        assert!(error.exit_code() == code && error.to_string().contains(part), "{error}");
    }
}

#[test]
fn points_are_reached_and_the_rest_keeps_its_bits() {
    let folder = tempfile::tempdir().unwrap();
    let slab = slab();
    for (z, sign) in [(3.0, 1.0), (-3.0, -1.0)] {
        // A single point, six voxels away.
        let params = Emboss { points: Some(file(&folder, "one.xyz", &format!("1 2 {z}\n"))), ..Emboss::default() };
        let outcome = run(&slab, &params).unwrap();
        assert_eq!(outcome.summary.details["points_reached"], 1, "{:?}", outcome.summary);
        assert_eq!(outcome.summary.stopped_because.as_deref(), Some("everything that draws is reached"));
        let drawn = outcome.level_set;
        let phi = drawn.sampler().trilinear(drawn.transform().world_to_index(DVec3::new(1.0, 2.0, z)));
        assert!(phi.abs() < 0.125, "{phi}");
        assert!((volume(&drawn) - volume(&slab)) * sign > 3.0);
        let corner = drawn.transform().world_to_index(DVec3::new(-19.0, -19.0, 0.0)).round().as_ivec3();
        assert_eq!(drawn.grid().voxel(corner), slab.grid().voxel(corner));
    }
    // Only in a region.
    let points = file(&folder, "two.xyz", "-8 0 2\n8 0 2\n");
    let region = RegionSpecs(vec!["sphere center=8,0,0 radius=6".into()]);
    let evolution = EvolutionOptions { region, ..EvolutionOptions::default() };
    let outcome = run(&slab, &Emboss { points: Some(points), evolution, ..Emboss::default() }).unwrap();
    let at = |x: f64| outcome.level_set.sampler().trilinear(slab.transform().world_to_index(DVec3::new(x, 0.0, 2.0)));
    assert!(at(8.0).abs() < 0.125 && at(-8.0) > 1.4);
    assert_eq!(outcome.summary.details["points_reached"], 1);
}

#[test]
fn curves_meshes_and_solids_draw_without_samples() {
    let folder = tempfile::tempdir().unwrap();
    let slab = slab();
    let square = "v -5 -5 2\nv 5 -5 2\nv 5 5 2\nv -5 5 2\n";
    let curve = file(&folder, "curve.obj", &format!("{square}l 1 2 3 4 1\n"));
    let mesh = file(&folder, "mesh.obj", &format!("{square}f 1 2 3 4\n"));
    let at = |level_set: &LevelSet, p: [f64; 3]| {
        f64::from(level_set.sampler().trilinear(level_set.transform().world_to_index(DVec3::from(p))))
    };
    let ring = run(&slab, &Emboss { curve: Some(curve), ..Emboss::default() }).unwrap().level_set;
    for p in [[0.0, -5.0, 2.0], [5.0, 1.3, 2.0], [-5.0, -3.7, 2.0]] {
        assert!(at(&ring, p).abs() < 0.15, "{p:?} {}", at(&ring, p));
    }
    assert!(at(&ring, [0.0, 0.0, 0.6]) > 0.0);
    let plateau = run(&slab, &Emboss { mesh: Some(mesh), ..Emboss::default() }).unwrap().level_set;
    for p in [[0.0, 0.0, 2.0], [4.0, -3.0, 2.0]] {
        assert!(at(&plateau, p).abs() < 0.15, "{p:?} {}", at(&plateau, p));
    }
    // A box that the slab reaches into: its bottom side draws nothing where it lies in the slab, its top is not drawn through.
    let boxed = "v -4 -4 1\nv 4 -4 1\nv 4 4 1\nv -4 4 1\nv -4 -4 9\nv 4 -4 9\nv 4 4 9\nv -4 4 9\n\
                 f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
    let solid =
        run(&slab, &Emboss { solid: Some(file(&folder, "box.obj", boxed)), ..Emboss::default() }).unwrap().level_set;
    assert!(at(&solid, [0.0, 0.0, 1.0]).abs() < 0.15 && at(&solid, [0.0, 0.0, 1.6]) > 0.0);
}

#[test]
fn repelled_surfaces_stop_at_the_depth() {
    let folder = tempfile::tempdir().unwrap();
    let slab = slab();
    let sheet: String =
        (0..400).map(|i| format!("{} {} 2\n", f64::from(i % 20) / 2.0 - 5.0, f64::from(i / 20) / 2.0 - 5.0)).collect();
    let params = Emboss { points: Some(file(&folder, "sheet.xyz", &sheet)), repel: true, ..Emboss::default() };
    assert!(run(&slab, &params).err().unwrap().to_string().contains("max_depth"));
    let pushed = run(&slab, &Emboss { max_depth: Some(WorldLength::new(3.0)), ..params }).unwrap().level_set;
    let phi = pushed.sampler().trilinear(pushed.transform().world_to_index(DVec3::new(0.0, 0.0, -3.0)));
    assert!(phi.abs() < 0.2, "{phi}");
}

#[test]
fn what_is_there_already_draws_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let slab = slab();
    let params = Emboss { points: Some(file(&folder, "on.xyz", "0 0 0.05\n")), ..Emboss::default() };
    let outcome = run(&slab, &params).unwrap();
    assert!(outcome.summary.warnings.iter().any(|w| w.contains("nothing is drawn")), "{:?}", outcome.summary);
    assert_eq!(crate::ops::compare::changed_voxels(Some(&slab), &outcome.level_set), 0);
}

#[test]
fn refusals() {
    let folder = tempfile::tempdir().unwrap();
    let slab = slab();
    let ring = stamp(file(&folder, "ring.svg", RING));
    let points = Emboss { points: Some(file(&folder, "one.xyz", "1 2 3\n")), ..Emboss::default() };
    let w = |value| Some(WorldLength::new(value));
    for (params, code, part) in [
        (Emboss::default(), 2, "one of"),
        (Emboss { points: points.points.clone(), ..ring.clone() }, 2, "one of"),
        (Emboss { at: None, ..ring.clone() }, 2, "at"),
        (Emboss { size: None, ..ring.clone() }, 2, "size"),
        (Emboss { size: w(0.0), ..ring.clone() }, 2, "size"),
        (Emboss { size: w(1e9), ..ring.clone() }, 2, "size"),
        (Emboss { height: w(0.0), ..ring.clone() }, 2, "height"),
        (Emboss { up: Some(Vector(DVec3::Z)), ..ring.clone() }, 2, "up"),
        (Emboss { at: Some(Vector(DVec3::Z * 90.0)), ..ring.clone() }, 2, "away"),
        (Emboss { repel: true, ..ring.clone() }, 2, "repel"),
        (
            Emboss {
                svg: Some(file(&folder, "none.svg", "<svg xmlns='http://www.w3.org/2000/svg'/>")),
                ..ring.clone()
            },
            3,
            "none.svg",
        ),
        (Emboss { svg: Some("absent.svg".into()), ..ring.clone() }, 3, "absent.svg"),
        (Emboss { image: Some("absent.png".into()), svg: None, ..ring.clone() }, 3, "absent.png"),
        (Emboss { text: Some("a".into()), svg: None, ..ring.clone() }, 2, "font"),
        (
            Emboss { text: Some("a".into()), font: Some("absent.ttf".into()), svg: None, ..ring.clone() },
            3,
            "absent.ttf",
        ),
        (Emboss { height: w(1.0), ..points.clone() }, 2, "height"),
        (Emboss { max_depth: w(1.0), ..points.clone() }, 2, "max_depth"),
        (Emboss { angle_limits: [0.9, 0.8], ..points.clone() }, 2, "angle_limits"),
        (Emboss { angle_limits: [0.9, 1.8], ..points.clone() }, 2, "angle_limits"),
        (Emboss { points: Some("absent.xyz".into()), ..points.clone() }, 3, "absent.xyz"),
    ] {
        let error = run(&slab, &params).err().unwrap_or_else(|| panic!("{params:?}"));
        assert!(error.exit_code() == code && error.to_string().contains(part), "{error}");
    }
}
