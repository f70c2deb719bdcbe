use glam::{DAffine3, DMat3, DVec2};

use super::term::View;
use super::*;
use crate::mesh::level_set_of_mesh;
use crate::range::{Background, Projection};

const MAJOR: f64 = 1.0 / 0.0425;
const MINOR: f64 = 0.4 / 0.0425;

fn torus(p: DVec3) -> f64 {
    (p.x.hypot(p.y) - MAJOR).hypot(p.z) - MINOR
}

/// Standard normal numbers that are the same everywhere.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut h = self.0;
        for factor in [0xbf58_476d_1ce4_e5b9, 0x94d0_49bb_1331_11eb] {
            h = (h ^ h >> 30).wrapping_mul(factor);
        }
        ((h ^ h >> 31) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Six maps along the axes of something given by its distance function.
fn six_maps(solid: fn(DVec3) -> f64, noise: f64, perspective: bool) -> RangeSet {
    const PIXELS: usize = 200;
    const FAR: f64 = 5.0 / 0.0425;
    let half = 1.6 / 0.0425;
    let mut random = Noise(1);
    let views = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
    let maps = views.iter().enumerate().map(|(n, view)| {
        let side = if view.z.abs() > 0.5 { DVec3::X } else { DVec3::Z.cross(*view) };
        let up = view.cross(side);
        let (projection, axes) = if perspective {
            let focal = (PIXELS as f64 - 1.0) / 2.0 / 20f64.to_radians().tan();
            let centre = DVec2::splat((PIXELS as f64 - 1.0) / 2.0);
            // The camera looks along its z.
            (Projection::Pinhole { focal: DVec2::splat(focal), centre }, DMat3::from_cols(side, -up, -*view))
        } else {
            let pitch = 2.0 * half / (PIXELS as f64 - 1.0);
            let first = DVec2::splat(-half);
            (Projection::Orthographic { first, pitch: DVec2::splat(pitch) }, DMat3::from_cols(side, up, *view))
        };
        let pose = DAffine3 { matrix3: axes, translation: *view * FAR };
        let mut ranges = Vec::new();
        for v in 0..PIXELS {
            for u in 0..PIXELS {
                let at = |t: f64| pose.transform_point3(projection.point(DVec2::new(u as f64, v as f64), t));
                let mut t = 0.0;
                for _ in 0..200 {
                    t += solid(at(t));
                }
                let hit = solid(at(t)).abs() < 1e-3 && t < 2.0 * FAR;
                ranges.push(if hit { (t + noise * random.normal()) as f32 } else { f32::NAN });
            }
        }
        let map = RangeMap::new(format!("view {n}"), projection, pose, PIXELS, ranges);
        RangeMap { noise: (noise > 0.0).then_some(noise), background: Background::Empty, ..map }
    });
    RangeSet { maps: maps.collect(), ..RangeSet::default() }
}

fn made(set: RangeSet, params: &Reconstruct) -> (LevelSet, Summary) {
    let Outcome { level_set, summary } = reconstruct(set, params, &RunOptions::default()).unwrap();
    assert_eq!(level_set.check(), []);
    (level_set, summary)
}

fn voxels() -> Reconstruct {
    Reconstruct { voxel_size: Some(WorldLength::new(1.0)), ..Reconstruct::default() }
}

/// RMS and mean of the distance of the zero set from a surface.
fn error(level_set: &LevelSet, exact: fn(DVec3) -> f64) -> (f64, f64) {
    let mesh = level_set_to_mesh(level_set, 0.0, &RunOptions::default()).unwrap();
    let distances: Vec<f64> = mesh.positions.iter().map(|p| exact(*p)).collect();
    let count = distances.len() as f64;
    ((distances.iter().map(|d| d * d).sum::<f64>() / count).sqrt(), distances.iter().sum::<f64>() / count)
}

#[test]
fn a_torus_from_six_noisy_maps() {
    let truth = 2.0 * std::f64::consts::PI.powi(2) * MAJOR * MINOR * MINOR;
    // The prior shifts the surface inwards by 2βH over the weight of the maps that see it. Integrated over the torus, with what hides what, that is a volume of
    // 0.975 for the parallel maps of 2.0 in the mean and 0.970 for the perspective ones of 1.6, whose cones see less than half of the surface.
    for (perspective, low_pass, beta, limit, volume) in [
        (false, 0.5, 2.0, 0.25, 0.98..1.02),
        (true, 0.5, 1.0, 0.25, 0.98..1.02),
        (true, 0.5, 2.0, 0.25, 0.963..1.0),
        (false, 0.0, 2.0, 0.35, 0.98..1.02),
    ] {
        let params = Reconstruct { low_pass: VoxelLength::new(low_pass), beta, ..voxels() };
        let (level_set, summary) = made(six_maps(torus, 0.2 * MINOR, perspective), &params);
        let (rms, mean) = error(&level_set, torus);
        let measures = level_set.measure(&RunOptions::default()).unwrap();
        println!(
            "torus: perspective {perspective} low pass {low_pass}: rms {rms:.3} mean {mean:+.3} volume {:.4} components {} euler {} {:?} {:?}",
            measures.volume / truth,
            measures.components,
            measures.euler,
            summary.steps,
            summary.stopped_because
        );
        assert!(rms < limit, "{rms}");
        assert!(volume.contains(&(measures.volume / truth)), "{}", measures.volume / truth);
        assert!(measures.components == 1 && measures.euler == 0, "{measures:?}");
        // The noise that is estimated from the maps is that which was put in.
        for map in summary.details["maps"].as_array().unwrap() {
            let noise = map["estimated_noise"].as_f64().unwrap();
            assert!(low_pass == 0.0 || (noise / (0.2 * MINOR) - 1.0).abs() < 0.1, "{map}");
        }
    }
}

#[test]
fn without_noise_and_prior_the_torus_is_met() {
    let params = Reconstruct { beta: 0.0, ..voxels() };
    let (level_set, _) = made(six_maps(torus, 0.0, false), &params);
    let (rms, mean) = error(&level_set, torus);
    println!("no noise: rms {rms:.3} mean {mean:+.3}");
    assert!(rms < 0.1, "{rms}");
}

/// A hall of 9 x 4.4 x 5.2 with a table, a column and a ball; positive in the air.
fn hall(p: DVec3) -> f64 {
    let cuboid = |centre: DVec3, half: DVec3| {
        let q = (p - centre).abs() - half;
        q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
    };
    let walls = -cuboid(DVec3::ZERO, DVec3::new(4.5, 2.2, 2.6));
    let table = cuboid(DVec3::new(1.5, -1.2, 0.3), DVec3::new(0.9, 1.0, 0.6));
    let column = p.truncate().distance(DVec2::new(-1.8, 0.3)) - 0.4;
    let ball = p.distance(DVec3::new(-3.2, -1.4, 1.4)) - 0.7;
    walls.min(table).min(column).min(ball)
}

/// What twelve turning scanners in the hall measure.
fn hall_maps(columns: i32, rows: i32, noise: f64) -> Vec<RangeMap> {
    let mut random = Noise(7);
    let mut maps = Vec::new();
    for n in 0..12 {
        let place =
            DVec3::new(f64::from(n % 4) * 2.3 - 3.5, [1.2, -0.3, 1.6][n as usize / 4], f64::from(n % 3) * 0.9 - 1.0);
        if hall(place) < 0.3 {
            continue;
        }
        let step = DVec2::new(std::f64::consts::TAU / f64::from(columns), 2.8 / f64::from(rows));
        let projection = Projection::Spherical { first: DVec2::new(-3.0, -1.4), step };
        let pose = DAffine3::from_rotation_translation(glam::DQuat::from_rotation_z(f64::from(n)), place);
        let mut ranges = Vec::new();
        for v in 0..rows {
            for u in 0..columns {
                let direction = projection.point(DVec2::new(f64::from(u), f64::from(v)), 1.0);
                let direction = pose.transform_vector3(direction);
                let mut t = 0.0;
                for _ in 0..100 {
                    t += hall(place + direction * t);
                }
                ranges.push((t + noise * random.normal()) as f32);
            }
        }
        let map = RangeMap::new(format!("scanner {n}"), projection, pose, columns as usize, ranges);
        maps.push(RangeMap { noise: Some(noise), ..map });
    }
    maps
}

#[test]
fn a_hall_seen_by_twelve_turning_scanners() {
    let maps = hall_maps(160, 70, 0.05);
    let params =
        Reconstruct { voxel_size: Some(WorldLength::new(0.12)), iterations: 32, beta: 0.5, ..Reconstruct::default() };
    let (level_set, summary) = made(RangeSet { maps, ..RangeSet::default() }, &params);
    let mesh = level_set_to_mesh(&level_set, 0.0, &RunOptions::default()).unwrap();
    let near: Vec<f64> = mesh.positions.iter().map(|p| hall(*p) / 0.12).filter(|d| d.abs() < 2.0).collect();
    let rms = (near.iter().map(|d| d * d).sum::<f64>() / near.len() as f64).sqrt();
    println!(
        "hall: {} of {} vertices near, rms {rms:.3} voxels, {:?} steps",
        near.len(),
        mesh.positions.len(),
        summary.steps
    );
    // The noise of one measurement is 0.42 voxel; edges are a voxel wide.
    assert!(rms < 0.35, "{rms}");
    // The box around it is not there: the rest is the air.
    let air = mesh.positions.iter().filter(|p| p.abs().cmplt(DVec3::new(4.6, 2.3, 2.7)).all()).count();
    assert!(near.len() as f64 > 0.9 * air as f64, "{} of {air}", near.len());
}

#[test]
fn one_map_shows_the_front_of_a_ball_and_the_box_closes_the_rest() {
    fn ball(p: DVec3) -> f64 {
        p.length() - 20.0
    }
    let mut set = six_maps(ball, 0.0, false);
    set.maps = vec![set.maps.remove(4)];
    let params = Reconstruct { beta: 0.5, ..voxels() };
    let (level_set, summary) = made(set, &params);
    let mesh = level_set_to_mesh(&level_set, 0.0, &RunOptions::default()).unwrap();
    let front: Vec<f64> = mesh.positions.iter().filter(|p| p.z > 12.0).map(|p| ball(*p)).collect();
    let rms = (front.iter().map(|d| d * d).sum::<f64>() / front.len() as f64).sqrt();
    println!("one map: rms of the front {rms:.3}, unseen {:?}", summary.details["unseen_part"]);
    assert!(front.len() > 300 && rms < 0.1, "{rms}");
    assert_eq!(level_set.measure(&RunOptions::default()).unwrap().components, 1);
    assert!(summary.details["unseen_part"].as_f64().unwrap() > 0.2);
}

#[test]
fn poses_are_refined() {
    let mut set = six_maps(torus, 0.0, false);
    for (n, map) in set.maps.iter_mut().enumerate().skip(1) {
        let shift = DVec3::new(1.0, -0.8, 0.6) * if n % 2 == 0 { 1.0 } else { -1.0 };
        map.pose.translation += shift;
    }
    let params = voxels();
    // Of a torus that is moved as a whole nothing can be said: it is the maps that are to agree.
    let disagreement = |params: &Reconstruct| {
        let (_, summary) = made(set.clone(), params);
        let maps = summary.details["maps"].as_array().unwrap();
        maps.iter().map(|map| map["residual_rms"].as_f64().unwrap()).sum::<f64>() / 6.0
    };
    let (before, after) = (disagreement(&params), disagreement(&Reconstruct { refine: 2, ..params.clone() }));
    println!("poses: {before:.3} to {after:.3}");
    assert!(after < 0.6 * before, "{before} {after}");
}

#[test]
fn refusals() {
    let refused = |params: Reconstruct| params.validate().err().unwrap();
    assert_eq!(refused(Reconstruct::default()).exit_code(), 3);
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.display().to_string()
    };
    let conf = file("a.conf", "bmesh missing.ply 0 0 0 0 0 0 1\n");
    for (params, word) in [
        (Reconstruct { resolution: 2.0, ..Reconstruct::default() }, "resolution"),
        (Reconstruct { beta: -1.0, ..Reconstruct::default() }, "beta"),
        (Reconstruct { low_pass: VoxelLength::new(f64::NAN), ..Reconstruct::default() }, "low_pass"),
        (Reconstruct { least_part: 1.0, ..Reconstruct::default() }, "least_part"),
        (Reconstruct { noise: Some(WorldLength::new(-1.0)), ..Reconstruct::default() }, "noise"),
    ] {
        let error = refused(Reconstruct { scans: conf.clone(), ..params });
        assert!(error.exit_code() == 2 && error.to_string().contains(word), "{error}");
    }
    let run = RunOptions::default();
    let error = |scans: &str, skip_missing: bool| {
        let params = Reconstruct { scans: scans.into(), skip_missing, ..Reconstruct::default() };
        params.apply(Vec::new(), &run).err().unwrap()
    };
    let said = error(&conf, false).to_string();
    assert!(said.contains("missing.ply") && said.contains("skip_missing"), "{said}");
    assert!(error(&conf, true).to_string().contains("holds no range map"));
    // All ranges are no numbers.
    let mut set = six_maps(torus, 0.0, false);
    set.maps.iter_mut().for_each(|map| map.ranges.iter_mut().for_each(|r| *r = f32::INFINITY));
    assert_eq!(reconstruct(set, &voxels(), &run).err().unwrap().exit_code(), 2);
}

/// A ball seen from one side is a shell as thick as asked, in its colours; what no map sees is listed.
#[test]
fn thin_shells_holes_and_colours() {
    fn ball(p: DVec3) -> f64 {
        p.length() - 20.0
    }
    let mut set = six_maps(ball, 0.0, false);
    set.maps = vec![set.maps.remove(4)];
    let map = &mut set.maps[0];
    map.colors = (0..map.ranges.len())
        .map(|at| if at % map.width < map.width / 2 { [255, 0, 0] } else { [0, 0, 255] })
        .collect();
    let (whole, _) = made(set.clone(), &Reconstruct { beta: 0.0, ..voxels() });
    let thickness = Some(WorldLength::new(8.0));
    let (shell, summary) = made(set, &Reconstruct { beta: 0.0, thickness, ..voxels() });
    let volume = |level_set: &LevelSet| level_set.measure(&RunOptions::default()).unwrap().volume;
    // A cylinder over the disc, but for its rim, where it is not trusted.
    let expected = std::f64::consts::PI * 400.0 * 8.0;
    println!("shell {} of {expected}, whole {}, {:?}", volume(&shell), volume(&whole), summary.details["unseen_part"]);
    assert!((volume(&shell) / expected - 1.0).abs() < 0.1 && volume(&whole) > 1.5 * expected);
    let holes = summary.details["holes"].as_array().unwrap();
    let (area, of_largest) = (&summary.details["unseen_area"], &holes[0]["area"]);
    assert!(of_largest.as_f64().unwrap() > 0.95 * area.as_f64().unwrap(), "{holes:?}");
    // The back lies below the middle of the front.
    assert!(holes[0]["centre"][2].as_f64().unwrap() < 10.0, "{holes:?}");
    let mesh = summary.colored.unwrap();
    let mut side = [0.0; 2];
    for (p, color) in mesh.positions.iter().zip(mesh.colors.as_ref().unwrap()) {
        assert!(color[3] == 1.0 && (color[0] + color[2] - 1.0).abs() < 1e-3 && color[1] == 0.0, "{color:?}");
        if p.x.abs() > 1.0 && p.z > 10.0 && ball(*p).abs() < 1.0 {
            side[usize::from(p.x > 0.0)] += f64::from(color[0]);
            assert!(color[0] == 0.0 || color[0] == 1.0, "{p} {color:?}");
        }
    }
    assert!(side[0].min(side[1]) == 0.0 && side[0].max(side[1]) > 100.0, "{side:?}");
}

/// MATH.md 7.2: moved along its normal, a plane of any slope loses energy at the rate ψ'(D) = w(D) D an area, without a
/// cosine: the one of the range's change and the one of the pixels an area cancel.
#[test]
fn the_force_is_that_of_the_energy_at_any_slope() {
    let run = RunOptions::default();
    for slope in [0.0, 1.0, 3.0] {
        // The upper face of a block lies in z = slope x; measured was the plane one voxel above it.
        let turn = DMat3::from_rotation_y(-f64::atan(slope));
        let mut block = crate::mesh::testing::cube(DVec3::splat(-1.0), 2.0);
        block.positions.iter_mut().for_each(|p| *p = turn * (*p * DVec3::new(30.0, 30.0, 10.0) - DVec3::Z * 10.0));
        let transform = Transform::uniform(1.0);
        let mut surface = level_set_of_mesh(block, &transform, 3.0, &run).unwrap();
        const PIXELS: usize = 200;
        const FAR: f64 = 200.0;
        let (half, pitch) = (25.0, 50.0 / (PIXELS as f64 - 1.0));
        let ranges = |_v| (0..PIXELS).map(|u| (FAR - 1.0 - slope * (u as f64 * pitch - half)) as f32);
        let map = RangeMap::new(
            "plane".into(),
            Projection::Orthographic { first: DVec2::splat(-half), pitch: DVec2::splat(pitch) },
            DAffine3::from_translation(DVec3::Z * FAR),
            PIXELS,
            (0..PIXELS).flat_map(ranges).collect(),
        );
        // ψ of the surface moved by `t` along its normal, over the pixels of an area.
        let width = 2.0;
        let energy = |t: f64| {
            let distance: f64 = -1.0 + t * slope.hypot(1.0);
            width * width * (1.0 - (-0.5 * (distance / width).powi(2)).exp()) / slope.hypot(1.0)
        };
        let rate = (energy(-1e-4) - energy(1e-4)) / 2e-4;
        let terms = [Term::new(&map, width, 1.0, None, f64::INFINITY)];
        let measurements = Measurements::new(&terms, transform, 3.0, &run);
        let forces = Forces::new(&measurements);
        let step = 0.25;
        let mut control = |moment: &Moment| (moment.steps == 0).then_some(step);
        move_surface(&mut surface, &forces, 0.0, 0.0, 1, &mut control, &run).unwrap();
        let moved = -f64::from(surface.grid().accessor().value(glam::IVec3::ZERO));
        println!("slope {slope}: moved {moved:.4}, energy falls by {:.4}", step * rate);
        assert!((moved / (step * rate) - 1.0).abs() < 0.02, "{slope}: {moved} {}", step * rate);
    }
}

/// MATH.md 7.4: maps that face away from a surface, and measured what lies behind it, push it outwards (by 0.17 voxel there); the
/// gate takes that away.
#[test]
fn the_gate_takes_away_what_maps_of_the_other_side_push() {
    let mut set = six_maps(torus, 0.2 * MINOR, false);
    let width = 0.4 * MINOR;
    for map in &mut set.maps {
        let projection = map.projection;
        map.low_pass(|range| 0.5 / projection.pixel_size(range), 3.0 * width);
        map.distrust_edges(3.0 * width);
    }
    let terms: Vec<Term> = set.maps.iter().map(|map| Term::new(map, width, 1.0, None, f64::INFINITY)).collect();
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for i in 0..200 {
        for j in 0..90 {
            let (u, v) = (f64::from(i) * std::f64::consts::TAU / 200.0, f64::from(j) * std::f64::consts::TAU / 90.0);
            let n = DVec3::new(u.cos() * v.cos(), u.sin() * v.cos(), v.sin());
            points.push(DVec3::new(u.cos(), u.sin(), 0.0) * MAJOR + n * MINOR);
            normals.push(n);
        }
    }
    // A view says nothing of what faces away: there it is asked with the normal turned round.
    let behind: Vec<DVec3> = normals.iter().map(|n| -*n).collect();
    let both = |term: &Term| -> Vec<View> {
        let turned = term.views(&points, &behind).into_iter().map(|view| View { cosine: -view.cosine, ..view });
        let pairs = term.views(&points, &normals).into_iter().zip(turned);
        pairs.map(|(front, back)| if front.cosine > 0.0 { front } else { back }).collect()
    };
    let views: Vec<Vec<View>> = terms.iter().map(both).collect();
    // Where the force would be at rest, to first order, in the mean over points.
    let shift = |gate: &dyn Fn(f64) -> f64| {
        let at = |i: usize| {
            let (mut push, mut weights) = (0.0, 0.0);
            for view in views.iter().map(|views| views[i]).filter(|view| view.weight > 0.0) {
                let weight = f64::from(view.weight) * gate(view.cosine.into());
                push -= weight * f64::from(view.distance);
                weights += weight;
            }
            (weights > 0.05).then(|| push / weights)
        };
        let shifts: Vec<f64> = (0..points.len()).filter_map(at).collect();
        shifts.iter().sum::<f64>() / shifts.len() as f64
    };
    let (off, step, ramp) =
        (shift(&|_| 1.0), shift(&|c| f64::from(u8::from(c > 0.0))), shift(&|c| (c / 0.2).clamp(0.0, 1.0)));
    println!("gate off {off:+.3} step {step:+.3} ramp {ramp:+.3}");
    // What grazes the surface pushes outwards as well, by 0.10 there without a prior; the ramp takes some of it.
    assert!(off - step > 0.17 && step < 0.2 && ramp.abs() < 0.7 * step, "{off} {step} {ramp}");
    // The first surface, by the same maps.
    let run = RunOptions::default();
    let bounds = (glam::IVec3::splat(-42), glam::IVec3::splat(42));
    let measurements = Measurements::new(&terms, Transform::uniform(1.0), 3.0, &run);
    let first = measurements.first_surface(3.0, bounds, &run).unwrap();
    let (rms, mean) = error(&first, torus);
    println!("first surface: rms {rms:.3} mean {mean:+.3}");
    assert!(rms < 0.35, "{rms}");
}

/// MATH.md 7.4: the prior shifts the surface inwards, the more the larger β is.
#[test]
fn the_prior_shifts_the_surface_inwards() {
    let set = six_maps(torus, 0.2 * MINOR, false);
    let means = [0.0, 0.5, 2.0, 5.0].map(|beta| {
        let (level_set, _) = made(set.clone(), &Reconstruct { beta, ..voxels() });
        let (rms, mean) = error(&level_set, torus);
        println!("beta {beta}: rms {rms:.3} mean {mean:+.3}");
        assert!(rms < 0.28, "{beta}: {rms}");
        mean
    });
    assert!(means.is_sorted_by(|a, b| a > b), "{means:?}");
    // From +0.10 to −0.13 there.
    assert!((0.15..0.35).contains(&(means[0] - means[3])), "{means:?}");
}
