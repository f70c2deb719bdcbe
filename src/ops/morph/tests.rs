use glam::{DQuat, DVec3, IVec3};

use super::*;
use crate::grid::{LeafValues, Transform, offset_to_local};
use crate::ops::compare::compare;
use crate::ops::csg::{CsgOperation, csg};
use crate::pde::{LeafSurface, Moment, SurfaceSpeed, Tally, move_surface};

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
    let sequence = Sequence::new(inputs, params, &run, &mut |_| ()).unwrap();
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
    Sequence::new(inputs, params, &RunOptions::default(), &mut |_| ()).err().unwrap().to_string()
}

/// The distance to a target wherever a surface goes on its way there.
fn distance_to(from: &LevelSet, to: &LevelSet) -> TargetDistance {
    let ((a, b), (c, d)) = (from.grid().active_bounds().unwrap(), to.grid().active_bounds().unwrap());
    TargetDistance::new(to, (a.min(c), b.max(d)), &RunOptions::default()).unwrap()
}

/// Where a flow comes to rest.
fn at_rest(from: &LevelSet, to: &LevelSet, steps: u32) -> LevelSet {
    let distance = distance_to(from, to);
    let mut surface = from.clone();
    let leg = Morph::default().leg(&distance);
    let mut control = |moment: &Moment| (moment.steps < steps).then_some(0.5);
    move_surface(&mut surface, &leg.towards(), 0.0, 0.005, steps, &mut control, &RunOptions::default()).unwrap();
    surface
}

/// F = −b at the voxels themselves: what the sub-voxel correction mends.
struct AtVoxels<'a>(&'a TargetDistance);

impl SurfaceSpeed for AtVoxels<'_> {
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
        let around = self.0.around(leaf.origin);
        for foot in leaf.feet() {
            speed.0[foot.offset] = -around.at((leaf.origin + offset_to_local(foot.offset)).as_dvec3()) as f32;
        }
        Tally::default()
    }
}

/// Mean |∇φ| within a voxel and a half of the surface.
fn mean_slope(level_set: &LevelSet) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    let mut sampler = level_set.sampler();
    for &id in level_set.grid().leaves() {
        for at in level_set.grid().mask(id).iter().filter(|&at| level_set.grid().values(id).0[at].abs() < 1.5) {
            sum += sampler.voxel_gradient(level_set.grid().origin(id) + offset_to_local(at)).length();
            count += 1.0;
        }
    }
    sum / count
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

/// R(t) = 15 − 7e^(−t) is 14.249 at t = 2.23; steps of a quarter end 0.044 beyond.
#[test]
fn the_radius_follows_its_exponential() {
    let (from, to) = (ball(DVec3::ZERO, 8.0), ball(DVec3::ZERO, 15.0));
    let distance = distance_to(&from, &to);
    for (step, expected, tolerance) in [(0.25, 14.293, 0.03), (0.0625, 14.249, 0.05)] {
        let mut surface = from.clone();
        let mut control = |moment: &Moment| {
            let left = 2.23 - moment.time;
            (left > 1e-9).then_some(left.min(step))
        };
        let leg = Morph::default().leg(&distance);
        move_surface(&mut surface, &leg.towards(), 0.0, 0.005, 1000, &mut control, &RunOptions::default()).unwrap();
        println!("radius at 2.23, steps of {step}: {}", radius(&surface));
        assert!((radius(&surface) - expected).abs() < tolerance, "{step}: {}", radius(&surface));
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
    let slope = mean_slope(&rests);
    println!("cube to torus: {rms:.4} voxel, {degrees:.3} degrees, slope {slope:.4} of {:.4}", mean_slope(&torus));
    assert!(rms < 0.02 && degrees < 0.8, "{rms} {degrees}");
    // The reference rests at 1.01; the target's own is 0.996.
    assert!((0.98..1.02).contains(&slope), "{slope}");
    assert_eq!(rests.measure(&RunOptions::default()).unwrap().euler, 0);
    // On voxels the level sets bunch up, and normals with them.
    let distance = distance_to(&cube, &torus);
    let mut control = |moment: &Moment| (moment.steps < 250).then_some(0.5);
    let mut bunched = cube.clone();
    move_surface(&mut bunched, &AtVoxels(&distance), 0.0, 0.005, 250, &mut control, &RunOptions::default()).unwrap();
    let (rms_there, degrees_there) = errors(&bunched, torus_distance);
    println!("on voxels: {rms_there:.4} voxel, {degrees_there:.3} degrees, slope {:.4}", mean_slope(&bunched));
    assert!(rms_there > 1.5 * rms && degrees_there > 2.0 * degrees, "{rms_there} {degrees_there}");
    // What is shared with the target, every ten steps on the way; it rests after some 75.
    let (leg, mut shared, mut surface) = (Morph::default().leg(&distance), Vec::new(), cube.clone());
    let mut control = |moment: &Moment| {
        if moment.steps.is_multiple_of(10) {
            shared.push(distance.shared_volume(&LevelSet::new(moment.grid.clone(), *cube.transform())));
        }
        (moment.steps < 250).then_some(0.5)
    };
    move_surface(&mut surface, &leg.towards(), 0.0, 0.005, 250, &mut control, &RunOptions::default()).unwrap();
    let whole = distance.shared_volume(distance.level_set());
    println!("shared {:?}", shared.iter().map(|m| m / whole).collect::<Vec<_>>());
    assert!(shared.len() > 4 && shared.windows(2).all(|pair| pair[1] > pair[0] - 1e-3 * whole), "{shared:?}");
    assert!((shared.last().unwrap() / whole - 1.0).abs() < 5e-3);
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
    let sequence = Sequence::new(&shapes, &Morph::default(), &run, &mut |_| ()).unwrap().warnings().join("; ");
    assert!(sequence.contains("1 of 2 parts of shape 2") && sequence.contains("not appear"), "{sequence}");
    // Without a bridge half of it is reached.
    let reached = at_rest(&shapes[0], &target, 80);
    assert!((volume(&reached) / volume(&target) - 0.5).abs() < 0.01);
    // What overlaps nothing vanishes.
    assert!(at_rest(&ball(DVec3::Y * 20.0, 4.0), &target, 80).is_empty());
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
    let sequence = Sequence::new(&[small, large], &params, &run, &mut |_| ()).unwrap();
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
