//! The whole way: patches, maps and textures on surfaces whose answer is known. Voxel size 1.

use glam::{DVec3, IVec3};

use super::implicit::Implicit;
use super::wrap::Solid;
use super::*;
use crate::grid::{Transform, offset_to_local};
use crate::levelset::LevelSet;
use crate::levelset::testing::{box_distance, sampled};
use crate::mesh::level_set_to_mesh;
use crate::rbf::Basis;
use crate::run::RunOptions;

fn run() -> RunOptions {
    RunOptions::default()
}

fn source(texture: &LevelSet) -> Source {
    Source::new(texture.clone(), &run()).unwrap()
}

const CONFORMING: Parameterization = Parameterization::Conforming;
const EVEN: Parameterization = Parameterization::LowDistortion(None);

const LAYING: Laying = Laying { tile: [1, 1], push: 0.0, map: Map::Inverse, sampling: Sampling::Linear };

fn implicit(particles: u32) -> Map {
    Map::Implicit(Rbf { basis: Basis::Linear, lambda: [0.005, 0.3], particles })
}

const MAPS: [Map; 2] = [Map::Inverse, Map::SemiImplicit];

/// A block with its top at z = 0.25.
fn plane() -> LevelSet {
    sampled(32, |p| box_distance(p - DVec3::new(0.0, 0.0, -14.75), DVec3::new(24.0, 24.0, 15.0)))
}

/// Counter-clockwise seen from above.
fn rectangle(x: f64, y: f64) -> [DVec3; 4] {
    [(-x, -y), (x, -y), (x, y), (-x, y)].map(|(x, y)| DVec3::new(x, y, 0.0))
}

/// An L of three bars: its mirror image is another solid.
fn letter(scale: f64) -> LevelSet {
    let bounds = (IVec3::splat(-40), IVec3::splat(40));
    let shape = move |p: DVec3| {
        let upright = box_distance(p - DVec3::new(-6.0, 0.0, 0.0), DVec3::new(2.0, 10.0, 3.0));
        let foot = box_distance(p - DVec3::new(0.0, -8.0, 0.0), DVec3::new(8.0, 2.0, 3.0));
        let peg = box_distance(p - DVec3::new(-6.0, 8.0, 3.0), DVec3::new(2.0, 2.0, 3.0));
        upright.min(foot).min(peg)
    };
    LevelSet::from_distance(Transform::uniform(scale), 3.0, bounds, shape, &run()).unwrap()
}

#[test]
fn on_a_plane_the_maps_are_affine() {
    let plane = plane();
    let patch = Patch::between(&plane, rectangle(8.0, 10.0), 9.0, &CONFORMING, &run()).unwrap();
    let exact = |uvw: DVec3| DVec3::new(16.0 * uvw.x - 8.0, 20.0 * uvw.y - 10.0, 9.0 * uvw.z + 0.25);
    let through = Implicit::new(&patch, Rbf { basis: Basis::Linear, lambda: [0.005, 0.3], particles: 200 }).unwrap();
    for uvw in [DVec3::splat(0.5), DVec3::new(0.1, 0.9, 0.3), DVec3::new(1.0, 0.0, 1.0)] {
        // The field is sampled in f32: what is exact in it is exact in the map.
        assert!(patch.place(uvw).distance(exact(uvw)) < 1e-6, "{uvw} {}", patch.place(uvw) - exact(uvw));
        assert!(patch.find(exact(uvw)).unwrap().distance(uvw) < 1e-6);
        assert!(through.find(exact(uvw)).unwrap().distance(uvw) < 1e-6);
    }
    let distortion = patch.distortion();
    assert!((distortion.angle.max - 1.0).abs() < 1e-6 && (distortion.area.max - 1.0).abs() < 1e-6, "{distortion:?}");
    assert_eq!((distortion.folded, distortion.overlapping), (0, 0));
}

#[test]
fn a_texture_keeps_its_volume_and_its_hand() {
    // Three times as large as the texture in each direction: what rounds its edges is a third of a voxel there.
    let plane = sampled(64, |p| box_distance(p - DVec3::new(0.0, 0.0, -29.75), DVec3::new(50.0, 50.0, 30.0)));
    let texture = letter(1.0);
    let patch = Patch::between(&plane, rectangle(24.0, 30.0), 27.0, &CONFORMING, &run()).unwrap();
    let volume = texture.measure(&run()).unwrap().volume * 27.0;
    for map in MAPS.into_iter().chain([implicit(200)]) {
        let result =
            wrapped(&plane, &mut source(&texture), &patch, &Laying { map, ..LAYING }, &run()).unwrap().level_set;
        assert_eq!(result.check(), [], "{map:?}");
        let measures = result.measure(&run()).unwrap();
        assert!((measures.volume / volume - 1.0).abs() < 0.01, "{map:?}: {} {volume}", measures.volume);
        assert_eq!(measures.components, 1);
        // The foot goes to the right of the upright, and the peg up.
        let mut sampler = result.sampler();
        let mut inside = |x: f64, y: f64, z: f64| sampler.trilinear(DVec3::new(x, y, z) * 3.0) < 0.0;
        assert!(inside(6.0, -8.0, 2.0) && inside(-6.0, 8.0, 8.0), "{map:?}");
        assert!(!inside(6.0, 8.0, 2.0) && !inside(-6.0, -8.0, 8.0), "{map:?}");
    }
}

#[test]
fn heights_are_those_asked_for_and_pushed_in() {
    let (plane, texture) = (plane(), letter(0.5));
    for (push, top, bottom) in [(0.0, 9.25, 0.25), (1.0, 8.25, -3.25)] {
        let patch = Patch::between(&plane, rectangle(8.0, 10.0), 9.0, &CONFORMING, &run()).unwrap();
        for map in MAPS {
            let result = wrapped(&plane, &mut source(&texture), &patch, &Laying { map, push, ..LAYING }, &run())
                .unwrap()
                .level_set;
            let (lo, hi) = level_set_to_mesh(&result, 0.0, &run()).unwrap().bounding_box().unwrap();
            assert!((hi.z - top).abs() < 0.05, "{map:?} {push}: {}", hi.z);
            // Pushed polygons end a voxel below the surface; the inverse goes on behind it.
            let bottom = if map == Map::SemiImplicit { 0.25 - push } else { bottom };
            assert!((lo.z - bottom).abs() < 0.3, "{map:?} {push}: {}", lo.z);
        }
    }
}

#[test]
fn on_a_cylinder_lengths_are_kept() {
    let radius = 24.0;
    let bounds = (IVec3::splat(-44), IVec3::splat(44));
    let cylinder = LevelSet::from_distance(
        Transform::uniform(1.0),
        3.0,
        bounds,
        |p| (p.y.hypot(p.z) - radius).max(p.x.abs() - 30.0),
        &run(),
    );
    let cylinder = cylinder.unwrap();
    // x along the axis, y around it; the arc is 1 rad.
    let at = |x: f64, a: f64| DVec3::new(x, -radius * a.sin(), radius * a.cos());
    let corners = [at(-8.0, 0.5), at(8.0, 0.5), at(8.0, -0.5), at(-8.0, -0.5)];
    let patch = Patch::between(&cylinder, corners, 6.0, &CONFORMING, &run()).unwrap();
    assert!((patch.lengths() - DVec3::new(16.0, radius, 6.0)).abs().max_element() < 0.01 * 16.0, "{}", patch.lengths());
    let along = |w: f64| {
        let points: Vec<DVec3> = (0..=200).map(|k| patch.place(DVec3::new(0.5, f64::from(k) / 200.0, w))).collect();
        points.windows(2).map(|p| p[0].distance(p[1])).sum::<f64>()
    };
    assert!((along(0.0) / radius - 1.0).abs() < 0.01, "{}", along(0.0));
    assert!((along(1.0) / (radius + 6.0) - 1.0).abs() < 0.01, "{}", along(1.0));
    let mut across = Vec::new();
    for k in 0..=40 {
        across.push(patch.place(DVec3::new(f64::from(k) / 40.0, 0.3, 1.0)));
    }
    let length: f64 = across.windows(2).map(|p| p[0].distance(p[1])).sum();
    assert!((length / 16.0 - 1.0).abs() < 0.01, "{length}");
}

/// A ball with bumps: 24 and a half voxels, bumps of 2.
fn bumpy() -> LevelSet {
    let bounds = (IVec3::splat(-36), IVec3::splat(36));
    let shape = |p: DVec3| {
        let r = p.length().max(1e-9);
        let d = p / r;
        // Shrunk, so that it is no more than the distance.
        0.6 * (r - 24.5 - 2.0 * (7.0 * d.x).sin() * (7.0 * d.y).cos())
    };
    let rough = LevelSet::from_distance(Transform::uniform(1.0), 3.0, bounds, shape, &run()).unwrap();
    crate::mesh::rebuild(&rough, &crate::mesh::Rebuild::band(3.0), &run()).unwrap()
}

fn cap() -> [DVec3; 4] {
    rectangle(0.5, 0.5).map(|p| (p + DVec3::Z).normalize() * 24.5)
}

#[test]
fn low_distortion_is_evener_than_conforming() {
    let bumpy = bumpy();
    let p95 = |how: &Parameterization| {
        let distortion = Patch::between(&bumpy, cap(), 10.0, how, &run()).unwrap().distortion();
        [distortion.angle.p95 - 1.0, distortion.area.p95 - 1.0]
    };
    let (conforming, even) = (p95(&CONFORMING), p95(&EVEN));
    for axis in 0..2 {
        assert!(even[axis] <= 0.6 * conforming[axis], "{even:?} {conforming:?}");
    }
}

#[test]
fn the_implicit_map_is_evaluated_near_the_texture_and_agrees_with_the_sum() {
    let (base, texture) = (bumpy(), letter(0.5));
    let patch = Patch::between(&base, cap(), 10.0, &EVEN, &run()).unwrap();
    let laying = Laying { map: implicit(300), ..LAYING };
    for basis in [Basis::Linear, Basis::Cubic, Basis::Wendland(4.0)] {
        let rbf = Rbf { basis, lambda: [0.005, 0.3], particles: 300 };
        let through = Implicit::new(&patch, rbf).unwrap();
        let result =
            wrapped(&base, &mut source(&texture), &patch, &Laying { map: Map::Implicit(rbf), ..laying }, &run())
                .unwrap();
        assert_eq!(result.level_set.check(), []);
        let [near, everywhere] = result.kernels.unwrap();
        assert!(near < everywhere / 4, "{near} {everywhere}");
        // The surface, looked up in the texture by the exact sum: a voxel of the texture is 0.5.
        let mesh = level_set_to_mesh(&result.level_set, 0.0, &run()).unwrap();
        let (lo, hi) = level_set_to_mesh(&texture, 0.0, &run()).unwrap().bounding_box().unwrap();
        let mut sampler = texture.sampler();
        let (mut worst, mut sum) = (0.0f64, 0.0);
        for p in &mesh.positions {
            let uvw = through.find(*p).unwrap();
            let phi = f64::from(sampler.trilinear((lo + (hi - lo) * uvw) / 0.5)) / 0.5;
            worst = worst.max(phi.abs());
            sum += phi.abs();
        }
        // Polygons cut edges off by half a voxel of the base, which is about one of the texture; on faces the map counts alone.
        assert!(sum / (mesh.positions.len() as f64) < 0.1 && worst < 1.0, "{basis:?} {worst}");
    }
}

#[test]
fn what_is_interpolated_is_the_sum_to_a_tenth_of_a_voxel() {
    let (base, texture) = (bumpy(), letter(0.5));
    let patch = Patch::between(&base, cap(), 10.0, &EVEN, &run()).unwrap();
    for (basis, particles) in
        [(Basis::Linear, 300), (Basis::Linear, 60), (Basis::Cubic, 100), (Basis::Wendland(4.0), 100)]
    {
        let rbf = Rbf { basis, lambda: [0.005, 0.3], particles };
        let through = Implicit::new(&patch, rbf).unwrap();
        let solid = Solid::new(&mut source(&texture), &base, &patch, &LAYING, &run()).unwrap();
        let (leaves, _) = through.leaves(&solid, patch.cells().leaves(), &run()).unwrap();
        let mut probe = solid.probe();
        let (mut worst, mut seen) = (0.0f64, 0);
        for (origin, values, mask) in &leaves {
            for at in mask.iter() {
                let ijk = (*origin + offset_to_local(at)).as_dvec3();
                let Some(uvw) = through.find(ijk) else { continue };
                // φ of the texture in its voxels; values are in voxels of the base, which are 1.
                let off = f64::from(values.0[at]) - solid.distance(&mut probe, ijk, uvw);
                if f64::from(values.0[at]).abs() < 2.5 {
                    worst = worst.max((off * solid.stretch / solid.voxel_size()).abs());
                    seen += 1;
                }
            }
        }
        assert!(seen > 5000 && worst < 0.1, "{basis:?} {particles}: {worst} of {seen}");
    }
}

#[test]
fn twenty_times_fewer_distances_to_particles_than_everywhere() {
    let ball = crate::levelset::testing::ball(DVec3::ZERO, 90.0);
    let corners = rectangle(0.6, 0.6).map(|p| (p + DVec3::Z).normalize() * 90.0);
    let patch = Patch::between(&ball, corners, 45.0, &CONFORMING, &run()).unwrap();
    let result =
        wrapped(&ball, &mut source(&letter(2.0)), &patch, &Laying { map: implicit(400), ..LAYING }, &run()).unwrap();
    let [near, everywhere] = result.kernels.unwrap();
    assert!(near < everywhere / 20, "{near} {everywhere}");
}

#[test]
fn tiles_meet_without_gaps() {
    let plane = plane();
    let block = sampled(14, |p| box_distance(p, DVec3::new(8.0, 6.0, 4.0)));
    let patch = Patch::between(&plane, rectangle(9.0, 12.0), 8.0, &CONFORMING, &run()).unwrap();
    for map in MAPS.into_iter().chain([implicit(200)]) {
        let laying = Laying { tile: [2, 3], map, ..LAYING };
        let result = wrapped(&plane, &mut source(&block), &patch, &laying, &run()).unwrap().level_set;
        let measures = result.measure(&run()).unwrap();
        // Polygons that are moved meet face to face, with their rounded edges.
        let euler = if map == Map::SemiImplicit { measures.euler } else { 2 };
        assert_eq!((measures.components, measures.euler), (1, euler), "{map:?}");
        // The outer edges are rounded by a part of a voxel; of moved polygons those of each tile. Half a square voxel of each edge would be 0.03.
        let allowed = if map == Map::SemiImplicit { 0.08 } else { 0.05 };
        let ratio = measures.volume / (18.0 * 24.0 * 8.0);
        assert!((ratio - 1.0).abs() < allowed, "{map:?} {ratio}");
    }
}

#[test]
fn tiles_keep_their_volume() {
    // The patch and the texture at three times the resolution: what voxels round off the edges of a tile is below a third of a percent of it.
    let plane = sampled(64, |p| box_distance(p - DVec3::new(0.0, 0.0, -29.75), DVec3::new(50.0, 50.0, 30.0)));
    let bounds = (IVec3::splat(-60), IVec3::splat(60));
    let block = |p: DVec3| box_distance(p, DVec3::new(27.2, 24.2, 24.2) * 0.5);
    let block = LevelSet::from_distance(Transform::uniform(0.5), 3.0, bounds, block, &run()).unwrap();
    let patch = Patch::between(&plane, rectangle(27.2, 36.3), 24.2, &CONFORMING, &run()).unwrap();
    for map in MAPS.into_iter().chain([implicit(200)]) {
        let laying = Laying { tile: [2, 3], map, ..LAYING };
        let result = wrapped(&plane, &mut source(&block), &patch, &laying, &run()).unwrap().level_set;
        let ratio = result.measure(&run()).unwrap().volume / (54.4 * 72.6 * 24.2);
        assert!((ratio - 1.0).abs() < 0.01, "{map:?} {ratio}");
    }
}

#[test]
fn particles_that_coincide_are_refused_without_smoothing() {
    let plane = plane();
    let mut patch = Patch::between(&plane, rectangle(8.0, 10.0), 9.0, &CONFORMING, &run()).unwrap();
    let rbf = Rbf { basis: Basis::Cubic, lambda: [0.0, 0.0], particles: 100 };
    assert!(Implicit::new(&patch, rbf).is_ok());
    // All of the upper layers at one place.
    for net in &mut patch.volume.layers[2..] {
        net.points.fill(DVec3::Z * 5.0);
    }
    let error = Implicit::new(&patch, rbf).err().unwrap().to_string();
    assert!(["map", "smaller height", "inverse"].iter().all(|w| error.contains(w)), "{error}");
}

#[test]
fn on_a_bumpy_part_of_the_bunny_low_distortion_is_evener() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/bunny.ply");
    if !path.exists() {
        eprintln!("SKIPPED: {} is absent", path.display());
        return;
    }
    let bunny = crate::mesh::read(&path).unwrap().mesh;
    let bunny = crate::mesh::level_set_of_mesh(bunny, &Transform::uniform(0.012), 3.0, &run()).unwrap();
    // The thigh.
    let corners = [(-0.15, -0.55, 0.5), (0.4, -0.55, 0.5), (0.4, -0.05, 0.45), (-0.15, -0.05, 0.45)];
    for height in [0.05, 0.1] {
        let p95 = |how: &Parameterization| {
            let patch = Patch::between(&bunny, corners.map(DVec3::from), height, how, &run()).unwrap();
            let distortion = patch.distortion();
            [distortion.angle.p95, distortion.area.p95, distortion.volume.p95]
        };
        let (conforming, even) = (p95(&CONFORMING), p95(&EVEN));
        for k in 0..3 {
            // Of the distortion itself, and of its excess over 1, which it has where nothing is distorted.
            assert!(even[k] <= 0.6 * conforming[k], "{height} {even:?} {conforming:?}");
            assert!(even[k] - 1.0 <= 0.3 * (conforming[k] - 1.0), "{height} {even:?} {conforming:?}");
        }
    }
}

#[test]
fn folds_are_closed_and_hold_what_any_of_their_sheets_holds() {
    // The upper layers of a patch pushed across each other: the map folds, and its surface stays closed.
    let (plane, texture) = (plane(), letter(0.5));
    let mut patch = Patch::between(&plane, rectangle(8.0, 10.0), 9.0, &CONFORMING, &run()).unwrap();
    for net in &mut patch.volume.layers[3..5] {
        let [_, nv] = net.counts;
        for (k, p) in net.points.iter_mut().enumerate() {
            let (i, j) = (k / (nv + 1), k % (nv + 1));
            *p += DVec3::new(if i % 3 == 1 { 5.0 } else { -1.0 }, if j % 4 == 2 { -4.0 } else { 1.0 }, -3.0);
        }
    }
    assert!(patch.distortion().folded > 0);
    for map in [Map::Inverse, implicit(200)] {
        let result =
            wrapped(&plane, &mut source(&texture), &patch, &Laying { map, ..LAYING }, &run()).unwrap().level_set;
        assert_eq!(result.check(), [], "{map:?}");
    }
    // Particles inside of the texture are inside of what it becomes.
    let result = wrapped(&plane, &mut source(&texture), &patch, &LAYING, &run()).unwrap().level_set;
    let (lo, hi) = source(&texture).mesh().bounding_box().unwrap();
    let (mut of_texture, mut of_result) = (texture.sampler(), result.sampler());
    let (mut seen, mut missed) = (0, 0usize);
    for i in 0..3000 {
        let uvw = [0.618_033_99, 0.754_877_67, 0.569_840_29].map(|step| (f64::from(i) * step).fract());
        let uvw = DVec3::from_array(uvw);
        let phi = of_texture.trilinear(texture.transform().world_to_index(lo + (hi - lo) * uvw));
        if phi < -0.4 {
            seen += 1;
            missed += usize::from(of_result.trilinear(patch.place(uvw)) > 0.5);
        }
    }
    // Sheets that the folds press thinner than a voxel are lost.
    assert!(seen > 100 && missed * 4 < seen, "{missed} of {seen}");
}

#[test]
fn a_spline_carries_the_patch_without_crossings() {
    let plane = plane();
    let rod = sampled(14, |p| (p.x.hypot(p.y) - 6.0).max(p.z.abs() - 10.0));
    // A hook with a radius about that of the patch.
    let hook = [(0.0, 16.0), (6.0, 24.0), (14.0, 24.0), (18.0, 16.0)].map(|(x, z)| DVec3::new(x, 0.0, z + 0.25));
    let patch =
        Patch::between(&plane, rectangle(5.0, 5.0), 1.0, &Parameterization::Spline(hook.to_vec()), &run()).unwrap();
    let distortion = patch.distortion();
    assert_eq!((distortion.folded, distortion.overlapping), (0, 0), "{distortion:?}");
    assert!(patch.place(DVec3::new(0.5, 0.5, 1.0)).distance(hook[3]) < 0.1);
    let result = wrapped(&plane, &mut source(&rod), &patch, &LAYING, &run()).unwrap().level_set;
    assert_eq!(result.check(), []);
    let measures = result.measure(&run()).unwrap();
    assert_eq!((measures.components, measures.euler), (1, 2));
}

#[test]
fn sharp_bends_draw_sections_together() {
    // Turns by 90 and by 150 degrees at points of a spline, narrower than the patch is wide.
    let plane = plane();
    for turn in [[(0.0, 12.0), (14.0, 13.0), (30.0, 13.0)], [(0.0, 14.0), (3.0, 17.0), (6.0, 6.0)]] {
        let points = turn.map(|(x, z)| DVec3::new(x, 0.0, z + 0.25)).to_vec();
        let patch =
            Patch::between(&plane, rectangle(8.0, 8.0), 1.0, &Parameterization::Spline(points), &run()).unwrap();
        let distortion = patch.distortion();
        assert_eq!(distortion.folded, 0, "{turn:?} {distortion:?}");
        assert!(distortion.least_determinant > 0.0);
    }
}

#[test]
fn corners_around_a_hole_are_refused() {
    let torus = crate::levelset::testing::torus(20.0, 6.0);
    // On the top of the ring, a quarter turn apart.
    let corners = [0.8, 2.4, 3.9, 5.5].map(|a: f64| DVec3::new(20.0 * a.cos(), 20.0 * a.sin(), 6.0));
    let error = Patch::between(&torus, corners, 5.0, &CONFORMING, &run()).err().unwrap().to_string();
    assert!(error.contains("corners") && error.contains("hole"), "{error}");
}

#[test]
fn what_goes_down_is_carved() {
    let (plane, texture) = (plane(), letter(1.0));
    let patch = Patch::between(&plane, rectangle(8.0, 10.0), -6.0, &CONFORMING, &run()).unwrap();
    let result = wrapped(&plane, &mut source(&texture), &patch, &LAYING, &run()).unwrap().level_set;
    let (lo, hi) = level_set_to_mesh(&result, 0.0, &run()).unwrap().bounding_box().unwrap();
    assert!((lo.z + 5.75).abs() < 0.05 && (hi.z - 0.25).abs() < 0.05, "{lo} {hi}");
    // As seen from outside the letter is not mirrored; its peg points down.
    let mut sampler = result.sampler();
    let mut inside = |x: f64, y: f64, z: f64| sampler.trilinear(DVec3::new(x, y, z)) < 0.0;
    assert!(inside(6.0, -8.0, -1.0) && inside(-6.0, 8.0, -5.0) && !inside(6.0, 8.0, -1.0) && !inside(6.0, -8.0, -5.0));
    assert_eq!(patch.distortion().folded, 0);
}
