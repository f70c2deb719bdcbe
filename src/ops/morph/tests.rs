use glam::{DQuat, DVec3, IVec3};

use super::*;
use crate::grid::Transform;
use crate::grid::offset_to_local;
use crate::ops::compare::compare;
use crate::ops::csg::{CsgOperation, csg};
use crate::pde::{Moment, move_surface};

fn sampled(reach: i32, distance: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
    let bounds = (IVec3::splat(-reach), IVec3::splat(reach));
    LevelSet::from_distance(Transform::uniform(1.0), 3.0, bounds, distance, &RunOptions::default()).unwrap()
}

fn ball(centre: DVec3, radius: f64) -> LevelSet {
    sampled((centre.abs().max_element() + radius) as i32 + 6, move |p| p.distance(centre) - radius)
}

fn cuboid(half: DVec3, turn: DQuat, shift: DVec3) -> LevelSet {
    sampled((half.length() + shift.length()) as i32 + 6, move |p| {
        let q = (turn.inverse() * (p - shift)).abs() - half;
        q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
    })
}

fn torus_distance(p: DVec3) -> f64 {
    (p.x.hypot(p.y) - 12.0).hypot(p.z) - 5.37
}

fn radius(level_set: &LevelSet) -> f64 {
    (volume(level_set) * 3.0 / 4.0 / std::f64::consts::PI).cbrt()
}

fn volume(level_set: &LevelSet) -> f64 {
    level_set.measure(&RunOptions::default()).unwrap().volume
}

fn components(level_set: &LevelSet) -> u64 {
    level_set.measure(&RunOptions::default()).unwrap().components
}

fn frames(inputs: &[LevelSet], params: &Morph) -> (Vec<(LevelSet, FrameFacts)>, SequenceReport) {
    let run = RunOptions::default();
    let sequence = Sequence::new(inputs, params, &run).unwrap();
    let places = sequence.places();
    let mut made = Vec::new();
    let report = sequence
        .frames(&places, &mut |n, level_set, facts| {
            assert_eq!(n, made.len());
            assert_eq!(level_set.check(), [], "frame {n}");
            made.push((level_set, facts));
            Ok(())
        })
        .unwrap();
    assert_eq!(made.len(), places.len());
    (made, report)
}

fn refused(inputs: &[LevelSet], params: &Morph) -> String {
    Sequence::new(inputs, params, &RunOptions::default()).err().unwrap().to_string()
}

/// Where a flow comes to rest.
fn at_rest(from: &LevelSet, to: &LevelSet, steps: u32) -> LevelSet {
    let run = RunOptions::default();
    let ((a, b), (c, d)) = (from.grid().active_bounds().unwrap(), to.grid().active_bounds().unwrap());
    let distance = TargetDistance::new(to, (a.min(c), b.max(d)), &run).unwrap();
    let mut surface = from.clone();
    let leg = Morph::default().leg(&distance);
    let mut control = |moment: &Moment| (moment.steps < steps).then_some(0.5);
    move_surface(&mut surface, &leg.towards(), 0.0, 0.005, steps, &mut control, &run).unwrap();
    surface
}

/// RMS distance of the zero set from a surface and mean angle of the normals to its own, in degrees.
fn errors(level_set: &LevelSet, exact: impl Fn(DVec3) -> f64) -> (f64, f64) {
    let mesh = level_set_to_mesh(level_set, 0.0, &RunOptions::default()).unwrap();
    let squares: f64 = mesh.positions.iter().map(|p| exact(*p).powi(2)).sum();
    let (mut angles, mut count) = (0.0, 0.0);
    let mut sampler = level_set.sampler();
    for &id in level_set.grid().leaves() {
        for at in level_set.grid().mask(id).iter() {
            let ijk = level_set.grid().origin(id) + offset_to_local(at);
            if exact(ijk.as_dvec3()).abs() < 0.7 {
                let along = |axis: DVec3| exact(ijk.as_dvec3() + axis * 1e-4) - exact(ijk.as_dvec3() - axis * 1e-4);
                let truth = DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z)).normalize();
                let normal = sampler.voxel_gradient(ijk).normalize();
                angles += normal.dot(truth).clamp(-1.0, 1.0).acos().to_degrees();
                count += 1.0;
            }
        }
    }
    ((squares / mesh.positions.len() as f64).sqrt(), angles / count)
}

#[test]
fn concentric_spheres_pass_equal_radii() {
    let shapes = [ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 15.0)];
    let (made, report) = frames(&shapes, &Morph { frame_count: 8, ..Morph::default() });
    for (n, (level_set, facts)) in made.iter().enumerate() {
        let r = radius(level_set);
        println!(
            "frame {n}: r {r:.3} rms {:.3} t {:.3} 15-7e^-t {:.3} shared {:.4}",
            facts.rms_voxels,
            facts.time,
            15.0 - 7.0 * (-facts.time).exp(),
            facts.shared_volume
        );
        assert!((r - 8.0 - n as f64).abs() < 0.15, "{n}: {r}");
        // R(t) = 15 − 7e^(−t), but for the last frame, which is the target.
        assert!(n == 7 || (r - 15.0 + 7.0 * (-facts.time).exp()).abs() < 0.2, "{n}: {r} at {}", facts.time);
        assert!(n == 0 || facts.shared_volume > made[n - 1].1.shared_volume - 1e-3);
    }
    assert!(report.ends[0].1 && report.ends[0].0 <= 0.02, "{report:?}");
    assert!(compare(&made[0].0, &shapes[0], &RunOptions::default()).unwrap().identical);
    assert!(compare(&made[7].0, &shapes[1], &RunOptions::default()).unwrap().identical);
    // And inwards, by volume and by time.
    let back = [shapes[1].clone(), shapes[0].clone()];
    let (made, _) = frames(&back, &Morph { frame_count: 6, frame_spacing: FrameSpacing::Volume, ..Morph::default() });
    let (from, to) = (volume(&back[0]), volume(&back[1]));
    for (n, (level_set, _)) in made.iter().enumerate() {
        let expected = from + (to - from) * n as f64 / 5.0;
        assert!((volume(level_set) - expected).abs() < 0.005 * from, "{n}: {} {expected}", volume(level_set));
    }
    let (made, _) = frames(&back, &Morph { frame_count: 6, frame_spacing: FrameSpacing::Time, ..Morph::default() });
    for (n, (_, facts)) in made.iter().enumerate() {
        assert!((facts.time - made[5].1.time * n as f64 / 5.0).abs() < 0.02 * made[5].1.time, "{n}: {facts:?}");
    }
}

#[test]
fn clamped_speed_moves_at_a_constant_rate() {
    let shapes = [ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 15.0)];
    for (speed, tolerance) in [(SpeedLaw::Clamped, 0.25), (SpeedLaw::Constant, 0.5)] {
        let params = Morph { frame_count: 8, speed, max_speed: VoxelLength::new(2.0), ..Morph::default() };
        let (made, _) = frames(&shapes, &params);
        for (level_set, facts) in &made[..6] {
            let r = radius(level_set);
            // The constant law is 2a/√(a² + 1): slower by 2 % at five voxels, by 11 % at two.
            assert!((r - 8.0 - 2.0 * facts.time).abs() < tolerance, "{speed:?}: {r} at {}", facts.time);
        }
    }
}

#[test]
fn a_cube_comes_to_rest_on_a_torus() {
    let cube = cuboid(DVec3::splat(18.2), DQuat::IDENTITY, DVec3::ZERO);
    let torus = sampled(24, torus_distance);
    let rests = at_rest(&cube, &torus, 250);
    assert_eq!(rests.check(), []);
    let (rms, degrees) = errors(&rests, torus_distance);
    println!("cube to torus: {rms:.4} voxel, {degrees:.3} degrees");
    assert!(rms < 0.02 && degrees < 0.8, "{rms} {degrees}");
    assert_eq!(rests.measure(&RunOptions::default()).unwrap().euler, 0);
    let (made, _) = frames(&[cube, torus], &Morph { frame_count: 6, ..Morph::default() });
    for pair in made.windows(2) {
        println!("shared {} rms {}", pair[1].1.shared_volume, pair[1].1.rms_voxels);
        assert!(pair[1].1.shared_volume > pair[0].1.shared_volume - 1e-3, "{:?}", pair[1].1);
    }
}

#[test]
fn a_shape_that_becomes_itself_stays() {
    let torus = sampled(24, torus_distance);
    let rests = at_rest(&torus, &torus, 60);
    let apart = compare(&rests, &torus, &RunOptions::default()).unwrap().surface_distance.unwrap();
    println!("itself: {apart:?}");
    assert!(apart.rms < 0.05, "{apart:?}");
    let (made, report) = frames(&[torus.clone(), torus], &Morph { frame_count: 3, ..Morph::default() });
    assert!(report.warnings.iter().any(|w| w.contains("the same")), "{report:?}");
    assert_eq!(made.len(), 3);
}

#[test]
fn two_spheres_apart_move_from_one_place_to_the_other() {
    let shapes = [ball(DVec3::X * -14.0, 8.0), ball(DVec3::X * 14.0, 11.0)];
    assert!(refused(&shapes, &Morph::default()).contains("do not overlap"));
    let params = Morph { frame_count: 9, bridge: true, ..Morph::default() };
    let (made, _) = frames(&shapes, &params);
    let volumes: Vec<f64> = made.iter().map(|m| volume(&m.0)).collect();
    println!("apart: {volumes:?}");
    assert!(volumes.windows(2).all(|pair| pair[1] > pair[0]), "{volumes:?}");
    assert!(made.iter().all(|m| components(&m.0) == 1));
    assert!(compare(&made[8].0, &shapes[1], &RunOptions::default()).unwrap().identical);
}

#[test]
fn a_bridge_lets_a_part_that_is_not_overlapped_arrive() {
    let run = RunOptions::default();
    let (left, right) = (ball(DVec3::X * -12.0, 6.0), ball(DVec3::X * 12.0, 6.0));
    let target = csg(&left, &[&right], CsgOperation::Union, &run).unwrap();
    let source = ball(DVec3::new(-10.0, 0.0, 0.0), 4.0);
    let shapes = [source, target.clone()];
    let sequence = Sequence::new(&shapes, &Morph::default(), &run).unwrap().warnings().join("; ");
    assert!(sequence.contains("1 of 2 parts of shape 2") && sequence.contains("not appear"), "{sequence}");
    // Without a bridge half of it is reached.
    let reached = at_rest(&shapes[0], &target, 80);
    assert!((volume(&reached) / volume(&target) - 0.5).abs() < 0.01);
    for (from, to) in [(0, 1), (1, 0)] {
        let pair = [shapes[from].clone(), shapes[to].clone()];
        let params = Morph { frame_count: 13, bridge: true, ..Morph::default() };
        let (made, report) = frames(&pair, &params);
        let volumes: Vec<f64> = made.iter().map(|m| volume(&m.0)).collect();
        let parts: Vec<u64> = made.iter().map(|m| components(&m.0)).collect();
        println!("bridge {volumes:?} {parts:?} {report:?}");
        let total = volumes[12] - volumes[0];
        for pair in volumes.windows(2) {
            let step = (pair[1] - pair[0]) / total;
            // Twelve equal steps, none backwards, none a jump.
            assert!((-1e-3..0.2).contains(&step), "{volumes:?}");
        }
        assert!(parts[0] as usize == from + 1 && parts[12] as usize == to + 1, "{parts:?}");
    }
}

#[test]
fn a_chain_passes_every_shape() {
    let shapes = [ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 14.0), ball(DVec3::ZERO, 11.0)];
    let (made, report) = frames(&shapes, &Morph { frame_count: 10, ..Morph::default() });
    // 6 and 3 voxels of way in nine steps.
    let identical =
        |n: usize, shape: usize| compare(&made[n].0, &shapes[shape], &RunOptions::default()).unwrap().identical;
    assert!(identical(0, 0) && identical(6, 1) && identical(9, 2));
    assert_eq!(report.ends.len(), 2);
    assert!((radius(&made[8].0) - 12.0).abs() < 0.1);
    assert!(refused(&shapes, &Morph { frame_count: 2, ..Morph::default() }).contains("frame_count"));
    assert!(
        refused(&shapes, &Morph { transform: Some("rotate z,90".into()), ..Morph::default() }).contains("two shapes")
    );
}

#[test]
fn moments_turn_a_box_onto_its_copy() {
    let half = DVec3::new(14.0, 8.0, 5.0);
    let turn = DQuat::from_rotation_z(0.6) * DQuat::from_rotation_x(0.3);
    let shapes = [cuboid(half, DQuat::IDENTITY, DVec3::ZERO), cuboid(half * 1.25, turn, DVec3::new(9.0, -4.0, 2.0))];
    for params in [
        Morph { align: Align::Moments, frame_count: 5, ..Morph::default() },
        Morph {
            transform: Some("scale 1.25; rotate x,17.18873; rotate z,34.37747; translate 9,-4,2".into()),
            frame_count: 5,
            ..Morph::default()
        },
    ] {
        let (made, report) = frames(&shapes, &params);
        println!("poses {:?} ends {:?}", report.poses, report.ends);
        assert!(compare(&made[4].0, &shapes[1], &RunOptions::default()).unwrap().identical);
        // Nothing but the pose changes: the volume grows with the cube of the scale.
        for (n, (level_set, _)) in made.iter().enumerate() {
            let expected = volume(&shapes[0]) * 1.25f64.powf(0.75 * n as f64);
            assert!((volume(level_set) / expected - 1.0).abs() < 0.02, "{n}: {} {expected}", volume(level_set));
        }
    }
}

#[test]
fn landmarks_lead_the_way_and_may_not_fold() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("marks.txt");
    let shapes = [ball(DVec3::ZERO, 10.0), cuboid(DVec3::splat(9.0), DQuat::IDENTITY, DVec3::new(6.0, 0.0, 0.0))];
    let with = |text: &str| {
        std::fs::write(&file, text).unwrap();
        Morph { landmarks: Some(file.display().to_string()), frame_count: 5, ..Morph::default() }
    };
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let lines: Vec<String> = axes
        .iter()
        .flat_map(|a| [*a, -*a])
        .map(|a| {
            let (p, q) = (a * 10.0, a * 9.0 + DVec3::X * 6.0);
            format!("{},{},{}  {} {} {}  # a face", p.x, p.y, p.z, q.x, q.y, q.z)
        })
        .collect();
    let (made, report) = frames(&shapes, &with(&lines.join("\n")));
    assert!(report.ends[0].1, "{report:?}");
    // The shapes are 9 and 10 voxels wide at the marks: they coincide in the frame of the source, so that the marks move evenly.
    let mut sampler = made[2].0.sampler();
    let at = |sampler: &mut crate::levelset::Sampler, p: DVec3| f64::from(sampler.trilinear(p));
    assert!(at(&mut sampler, DVec3::new(3.0 + 9.487, 0.0, 0.0)).abs() < 0.3);
    assert!(compare(&made[4].0, &shapes[1], &RunOptions::default()).unwrap().identical);
    let folds =
        "10 0 0 -10 0 0\n8 0 0 14 0 0\n0 10 0 6 9 0\n0 -10 0 6 -9 0\n0 0 10 6 0 9\n0 0 -10 6 0 -9\n-10 0 0 -3 0 0";
    assert!(refused(&shapes, &with(folds)).contains("folds"));
    assert!(refused(&shapes, &with("1 2 3")).contains("six numbers"));
    assert!(refused(&shapes, &with("1 2 3 4 5 6")).contains("2 to 1000"));
}

#[test]
fn refusals_and_warnings() {
    let shapes = [ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 12.0)];
    for (params, word) in [
        (Morph { frame_count: 1, ..Morph::default() }, "frame_count"),
        (Morph { stop_rms: VoxelLength::new(0.0), ..Morph::default() }, "stop_rms"),
        (Morph { max_speed: VoxelLength::new(f64::NAN), ..Morph::default() }, "max_speed"),
        (Morph { smoothness: -1.0, ..Morph::default() }, "smoothness"),
        (Morph { transform: Some("mirror x".into()), ..Morph::default() }, "mirror"),
        (Morph { transform: Some("shear 1".into()), ..Morph::default() }, "transform"),
        (Morph { align: Align::Moments, transform: Some(String::new()), ..Morph::default() }, "one of"),
    ] {
        let said = refused(&shapes, &params);
        assert!(said.contains(word), "{said}");
    }
    let nothing = LevelSet::empty(Transform::uniform(1.0), 3.0);
    assert!(refused(&[shapes[0].clone(), nothing], &Morph::default()).contains("shape 2"));
    let same = [shapes[0].clone(), ball(DVec3::new(0.5, 0.0, 0.0), 8.0)];
    let by_volume = Morph { frame_spacing: FrameSpacing::Volume, ..Morph::default() };
    assert!(refused(&same, &by_volume).contains("same volume"));
    let (small, large) = (ball(DVec3::ZERO, 2.0), ball(DVec3::ZERO, 45.0));
    let run = RunOptions::default();
    let params = Morph::default();
    let sequence = Sequence::new(&[small, large], &params, &run).unwrap();
    assert!(sequence.warnings()[0].contains("same units"), "{:?}", sequence.warnings());
    // In a recipe it is a frame.
    let half = Morph { at: 0.5, ..Morph::default() }.apply(shapes.to_vec(), &run).unwrap();
    assert!((radius(&half.level_set) - 10.0).abs() < 0.15);
}

#[test]
fn curvature_holds_the_surface_back() {
    let shapes = [ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 15.0)];
    let (made, report) = frames(&shapes, &Morph { frame_count: 3, smoothness: 1.5, ..Morph::default() });
    // It rests where 15 − R = 2β/R: 0.2 voxel short, which is said.
    assert!((report.ends[0].0 - 0.2).abs() < 0.05 && report.warnings.iter().any(|w| w.contains("jump")), "{report:?}");
    assert_eq!(made.len(), 3);
}
