use super::*;
use crate::grid::Transform;
use crate::levelset::testing::box_distance;
use crate::mesh::Bvh;

struct Points(Bvh);

impl Attractor for Points {
    fn closest(&self, ijk: DVec3, within: f64) -> Option<DVec3> {
        self.0.closest_point(ijk, within).map(|hit| hit.point)
    }
}

fn points(list: impl IntoIterator<Item = DVec3>) -> Points {
    Points(Bvh::new(list.into_iter().map(|p| [p; 3]).collect()))
}

/// Solid below z = 0, far enough to all sides; the band of the reference.
fn ground() -> LevelSet {
    let half = DVec3::new(30.0, 30.0, 15.0);
    let bounds = (IVec3::new(-40, -40, -40), IVec3::new(40, 40, 10));
    let distance = move |p: DVec3| box_distance(p + DVec3::Z * half.z, half);
    LevelSet::from_distance(Transform::uniform(1.0), 7.0, bounds, distance, &RunOptions::default()).unwrap()
}

/// A sheet of 13 × 13 points with spacing 1.
fn sheet(z: f64) -> Points {
    points((0..169).map(|i| DVec3::new(f64::from(i / 13 - 6), f64::from(i % 13 - 6), z)))
}

/// The limits of the paper alone.
fn paper() -> Attraction {
    Attraction { tip: 0.0, ..Attraction::default() }
}

fn drawn(target: &Points, how: &Attraction, until: Until) -> (LevelSet, AttractionReport) {
    let mut level_set = ground();
    let run = RunOptions::default();
    let pull = Pull::new(&level_set, target, how, None, &run).unwrap().unwrap();
    let within = pull.drawn_within(&level_set, &run).unwrap().unwrap();
    let report = attract(&mut level_set, &pull, within, until, &run).unwrap();
    assert_eq!(level_set.check(), []);
    (level_set, report)
}

/// Height of the surface above (x, y).
fn height(level_set: &LevelSet, x: f64, y: f64) -> f64 {
    let mut sampler = level_set.sampler();
    let mut at = |z: f64| f64::from(sampler.trilinear(DVec3::new(x, y, z)));
    let steps = (-100..100).map(|k| f64::from(k) / 10.0);
    let z = steps.rev().find(|z| at(*z) < 0.0).unwrap();
    let (a, b) = (at(z), at(z + 0.1));
    z + 0.1 * a / (a - b)
}

#[test]
fn a_sheet_of_points_draws_a_plateau() {
    // A dense reference in f64: 2.566, 3.816, 3.992; linear theory 4(1 − e^(−t)): 2.528, 3.801, 3.990. Steps of a twentieth
    // are up to 0.03 ahead of it.
    for (t, expected) in [(1.0, 2.566), (3.0, 3.816), (6.0, 3.992)] {
        let (level_set, report) = drawn(&sheet(4.0), &paper(), Until::Time(t));
        let z = height(&level_set, 0.0, 0.0);
        assert!((z - expected).abs() < 0.06 && report.flow.time <= t, "{t} {z}");
        if t == 6.0 {
            // The last points are at 6. On this grid the reference has 3 and 1 at 6 and 7, which is its own error; this scheme has 1.76 and
            // 0.74 here, 1.42 and 0.54 at half, 1.31 and 0.49 at a third of the voxel size. At 9 all have 0.
            let [at6, at7, at9] = [6.0, 7.0, 9.0].map(|x| height(&level_set, x, 0.0));
            assert!((1.2..3.0).contains(&at6) && (0.4..1.0).contains(&at7) && at9.abs() < 0.05, "{at6} {at7} {at9}");
            // The flank is even: what changes normals has broken up into no pits.
            let along: Vec<f64> = (-5..=5).map(|y| height(&level_set, 6.0, f64::from(y))).collect();
            assert!(along.iter().all(|z| (z - at6).abs() < 0.05), "{along:?}");
        }
    }
    // Engraved: −3.816.
    let (level_set, _) = drawn(&sheet(-4.0), &paper(), Until::Time(3.0));
    let z = height(&level_set, 0.0, 0.0);
    assert!((z + 3.816).abs() < 0.06, "{z}");
}

#[test]
fn a_sheet_of_points_pushes_faster_and_faster() {
    // z = 4(1 − e^t) is −1.967 at t = 0.4; the reference has −1.91.
    let repel = Attraction { repel: true, ..paper() };
    let (level_set, _) = drawn(&sheet(4.0), &repel, Until::Time(0.4));
    let z = height(&level_set, 0.0, 0.0);
    assert!((z + 1.91).abs() < 0.1, "{z}");
}

#[test]
fn a_point_draws_what_faces_it() {
    // Six above a plane: full speed up to .4843·6 = 2.9, none from .75·6 = 4.5 on.
    let (level_set, target, how) = (ground(), points([DVec3::new(0.0, 0.0, 6.0)]), paper());
    let pull = Pull::new(&level_set, &target, &how, None, &RunOptions::default()).unwrap().unwrap();
    let mut sampler = level_set.sampler();
    for (r, expected) in (0..6).zip([6.0, 6.0, 6.0, 5.963, 1.233, 0.0]) {
        for z in [-2, 0, 1, 3] {
            let felt = pull.at(&mut sampler, None, 1.0, IVec3::new(r, 0, z), None, &Default::default()).unwrap();
            assert!((felt.speed - expected).abs() < 1e-3, "{r} {z} {}", felt.speed);
        }
    }
}

#[test]
fn a_single_point_is_reached() {
    let target = points([DVec3::new(0.0, 0.0, 6.0)]);
    // By the limits alone the disc that is drawn shrinks to a voxel on the way: a dense reference stalls at 4.
    let (level_set, report) = drawn(&target, &paper(), Until::Iterations(1000));
    let apex = height(&level_set, 0.0, 0.0);
    assert!((4.0..6.3).contains(&apex), "{apex} {report:?}");
    let (level_set, report) = drawn(&target, &Attraction::default(), Until::Iterations(1000));
    let apex = height(&level_set, 0.0, 0.0);
    assert!((apex - 6.0).abs() < REACHED + 0.05 && report.gap < REACHED && !report.stalled, "{apex} {report:?}");
    // A cone, without a bulb at its tip.
    let mut sampler = level_set.sampler();
    for (r, z) in [(4.0, 5.0), (4.0, 6.0), (5.0, 3.0)] {
        assert!(sampler.trilinear(DVec3::new(r, 0.0, z)) > 0.0, "{r} {z}");
    }
}

#[test]
fn points_between_the_voxels_and_far_off_are_reached() {
    for point in [[0.5, 0.5, 6.0], [0.37, 0.21, 8.4], [0.5, 0.5, 15.7], [0.37, 0.21, -8.4]] {
        let point = DVec3::from_array(point);
        let (level_set, report) = drawn(&points([point]), &Attraction::default(), Until::Rest(1000));
        let gap = level_set.sampler().trilinear(point);
        assert!(f64::from(gap).abs() < REACHED, "{point}: {gap} {report:?}");
        assert_eq!(level_set.measure(&RunOptions::default()).unwrap().components, 1);
    }
}

#[test]
fn points_off_edges_and_corners_are_reached() {
    // Of the ground's top: by the limits hardly a voxel faces them.
    for point in [[30.3, 0.2, 6.0], [35.0, 0.5, 5.0], [33.4, 33.1, 3.6], [30.5, 2.5, 12.5]] {
        let point = DVec3::from_array(point);
        let (level_set, report) = drawn(&points([point]), &Attraction::default(), Until::Rest(1000));
        let gap = level_set.sampler().trilinear(point);
        assert!(f64::from(gap).abs() < REACHED, "{point}: {gap} {report:?}");
        assert_eq!((level_set.measure(&RunOptions::default()).unwrap().components, report.specks), (1, 0), "{point}");
    }
}

#[test]
fn a_ring_draws_a_whole_wall() {
    let at = |i: u32| {
        let angle = f64::from(i) / 60.0 * std::f64::consts::TAU;
        DVec3::new(15.0 * angle.cos() + 0.3, 15.0 * angle.sin() + 0.1, 12.0)
    };
    let (level_set, report) = drawn(&points((0..60).map(at)), &Attraction::default(), Until::Rest(1000));
    let mut sampler = level_set.sampler();
    for point in (0..60).map(at) {
        let gap = f64::from(sampler.trilinear(point));
        assert!(gap.abs() < REACHED, "{point}: {gap} {report:?}");
    }
    let measured = level_set.measure(&RunOptions::default()).unwrap();
    assert_eq!((measured.components, measured.euler), (1, 2));
}

#[test]
fn what_breaks_off_is_taken_away() {
    let (before, run) = (ground(), RunOptions::default());
    let half = DVec3::new(30.0, 30.0, 15.0);
    let both = |p: DVec3| {
        box_distance(p + DVec3::Z * half.z, half).min(box_distance(p - DVec3::new(0.0, 0.0, 6.2), DVec3::splat(1.6)))
    };
    let bounds = (IVec3::new(-40, -40, -40), IVec3::new(40, 40, 18));
    let both = LevelSet::from_distance(Transform::uniform(1.0), 7.0, bounds, both, &run).unwrap();
    let (left, specks) = without_specks(&both, &before, &run).unwrap();
    let rebuilt = |level_set: &LevelSet| rebuild(level_set, &Rebuild::band(3.0), &run).unwrap().measure(&run).unwrap();
    assert_eq!((specks, rebuilt(&left).components), (1, 1));
    assert_eq!(rebuilt(&left).volume, rebuilt(&before).volume);
}

#[test]
fn threads_and_instructions_change_no_bit() {
    use crate::stencil::simd::{Isa, choose};
    let target = points([DVec3::new(5.0, 4.0, 3.0), DVec3::new(7.0, 4.0, 3.0)]);
    let on = |threads, isa| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let chosen = choose(isa);
        let (after, _) = pool.install(|| drawn(&target, &Attraction::default(), Until::Iterations(1000)));
        choose(chosen);
        after
    };
    let bits = |level_set: &LevelSet| {
        let grid = level_set.grid();
        grid.leaves().iter().map(|&id| (grid.origin(id), grid.values(id).0.map(f32::to_bits))).collect::<Vec<_>>()
    };
    assert!(bits(&on(1, Isa::Portable)) == bits(&on(3, Isa::Avx2)));
}
