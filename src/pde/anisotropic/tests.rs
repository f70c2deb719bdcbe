use glam::{DVec3, IVec3};

use super::*;
use crate::grid::{Transform, offset_to_local};
use crate::levelset::sweep_distance;
use crate::levelset::testing::box_distance;
use crate::mesh::level_set_to_mesh;
use crate::region::{Near, Primitive, Shape};
use crate::stencil::simd::{Isa, choose};

const DEFAULT: [f32; 2] = AnisotropicGaussian::DEFAULT_SIGMA;

fn gaussian(sigma: [f32; 2]) -> AnisotropicGaussian {
    AnisotropicGaussian { sigma, ..AnisotropicGaussian::default() }
}

/// A field sampled up to `reach` voxels from the origin; voxel size 1.
fn sampled(reach: i32, half_width: f32, field: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
    let bounds = (IVec3::splat(-reach), IVec3::splat(reach));
    LevelSet::from_distance(Transform::uniform(1.0), half_width, bounds, field, &RunOptions::default()).unwrap()
}

/// The values of `field` after the passes, as a grid of the same leaves.
fn passes(field: &LevelSet, sigma: [f32; 2], region: Option<&dyn Region>, fades_kernels: bool) -> Grid {
    let what = AnisotropicGaussian { fades_kernels, ..gaussian(sigma) };
    let mut grid = field.grid().clone();
    let mut values = filtered(field, &what, region, &RunOptions::default()).unwrap();
    grid.swap_values(&mut values);
    grid
}

/// The active voxels of a grid for which `f` holds.
fn voxels(grid: &Grid, f: impl Fn(IVec3) -> bool + Sync) -> VoxelSet {
    VoxelSet::new(grid, |id| {
        let mut mask = grid.mask(id);
        for at in grid.mask(id).iter() {
            mask.set(at, f(grid.origin(id) + offset_to_local(at)));
        }
        mask
    })
}

/// The passes at the voxels given, the first two and the last.
fn passes_at(field: &LevelSet, sigma: [f32; 2], at: [&VoxelSet; 2]) -> Grid {
    let (mut grid, values) = (field.grid().clone(), field.grid().value_pages());
    let source = KernelSource { normals: Some(values), bends: None, sigma, critical: 1.0, fade: None, voxel_size: 1.0 };
    grid.swap_values(&mut three_passes(field.grid(), values, &source, at, &RunOptions::default()).unwrap());
    grid
}

/// Active voxels near the surface with their positions and values.
fn near(grid: &Grid, mut f: impl FnMut(DVec3, f64)) {
    for &id in grid.leaves() {
        for at in grid.mask(id).iter() {
            f((grid.origin(id) + offset_to_local(at)).as_dvec3(), f64::from(grid.values(id).0[at]));
        }
    }
}

fn mean_shift(grid: &Grid, before: impl Fn(DVec3) -> f64, within: impl Fn(DVec3) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    near(grid, |p, v| {
        if before(p).abs() < 1.5 && within(p) {
            (sum, count) = (sum + v - before(p), count + 1.0);
        }
    });
    sum / count
}

/// Where a grid first becomes positive on the way from the origin along a direction.
fn zero(grid: &Grid, direction: IVec3) -> f64 {
    let value = |i: i32| f64::from(grid.voxel(direction * i).0);
    let last = (0..20).find(|&i| value(i) < 0.0 && value(i + 1) >= 0.0).unwrap();
    f64::from(last) + value(last) / (value(last) - value(last + 1))
}

fn volume(level_set: &LevelSet) -> f64 {
    level_set.measure(&RunOptions::default()).unwrap().volume
}

#[test]
fn spheres_and_cylinders_move_by_their_mean_curvature() {
    // φ' − φ = s₂² H: s₂²/R and s₂²/(2R).
    let sphere = |p: DVec3| p.length() - 20.0;
    let shift = mean_shift(&passes(&sampled(31, 9.0, sphere), [1.333, 2.0], None, false), sphere, |_| true);
    assert!((shift - 0.2).abs() < 0.01, "{shift}");
    let cylinder = |p: DVec3| p.truncate().length() - 20.0;
    let middle = |p: DVec3| p.z.abs() < 8.0;
    let shift = mean_shift(&passes(&sampled(31, 9.0, cylinder), [1.333, 2.0], None, false), cylinder, middle);
    assert!((shift - 0.1).abs() < 0.01, "{shift}");
}

#[test]
fn the_first_passes_must_run_beyond_the_region() {
    // A ball of 14 voxels: with all passes in the band alone, an independent computation has 0.299 of 0.362.
    let ball = |p: DVec3| p.length() - 14.0;
    let field = sampled(24, 9.0, ball);
    let band = voxels(field.grid(), |ijk| ball(ijk.as_dvec3()).abs() < 1.5);
    let trapped = mean_shift(&passes_at(&field, DEFAULT, [&band, &band]), ball, |_| true);
    assert!((trapped - 0.299).abs() < 0.02, "{trapped}");
    let wide = mean_shift(&passes(&field, DEFAULT, None, false), ball, |_| true);
    assert!((wide - 0.3616).abs() < 0.012, "{wide}");

    // Two balls: the difference from the direct sum over each voxel's own kernel, by how far the region is dilated for the first passes.
    let a = |p: DVec3| (p + DVec3::X * 5.0).length() - 9.0;
    let b = |p: DVec3| (p - DVec3::new(6.0, 2.0, 1.0)).length() - 7.3;
    let union = |p: DVec3| a(p).min(b(p));
    let field = sampled(26, 15.0, union);
    let region = voxels(field.grid(), |ijk| {
        let p = ijk.as_dvec3();
        a(p).abs() < 4.0 && b(p).abs() < 4.0
    });
    let mut direct = Vec::new();
    for id in region.leaves().iter() {
        for at in region.mask(id).iter() {
            let ijk = field.grid().origin(id) + offset_to_local(at);
            if union(ijk.as_dvec3()).abs() < 1.0 {
                direct.push((ijk, direct_sum(&union, ijk.as_dvec3(), 1.5, 2.25)));
            }
        }
    }
    let rms = |steps: usize| {
        let around = region.grown(field.grid(), steps);
        let grid = passes_at(&field, DEFAULT, [&around, &region]);
        let squares = direct.iter().map(|(ijk, value)| (f64::from(grid.voxel(*ijk).0) - value).powi(2)).sum::<f64>();
        (squares / direct.len() as f64).sqrt()
    };
    for (steps, stated) in [(0, 0.0752), (1, 0.0432), (2, 0.0278), (3, 0.0217), (4, 0.0209)] {
        let found = rms(steps);
        assert!((found - stated).abs() < 0.006, "{steps}: {found}, {stated}");
    }
    assert_eq!(gaussian(DEFAULT).rim(), 4);
}

/// The Gaussian of one voxel, summed directly; its normal by central differences.
fn direct_sum(field: &impl Fn(DVec3) -> f64, x: DVec3, s1: f64, s2: f64) -> f64 {
    let difference = |axis: DVec3| field(x + axis) - field(x - axis);
    let n = DVec3::new(difference(DVec3::X), difference(DVec3::Y), difference(DVec3::Z)).normalize();
    let reach = (3.0 * s2).ceil() as i32;
    let (mut sum, mut weights) = (0.0, 0.0);
    for i in -reach..=reach {
        for j in -reach..=reach {
            for k in -reach..=reach {
                let d = DVec3::new(f64::from(i), f64::from(j), f64::from(k));
                let along = d.dot(n);
                let across = d.length_squared() - along * along;
                let w = (-0.5 * (along * along / (s1 * s1) + across / (s2 * s2))).exp();
                (sum, weights) = (sum + w * field(x + d), weights + w);
            }
        }
    }
    sum / weights
}

#[test]
fn creases_are_filled_as_far_as_the_theory_says() {
    let crease = sampled(26, 14.0, |p| p.x.min(p.y));
    for (sigma, value, place) in
        [([1.0, 1.5], -0.8463, 1.197), ([1.5, 2.25], -1.2694, 1.795), ([2.0, 3.0], -1.6926, 2.394)]
    {
        let grid = passes(&crease, sigma, None, false);
        let at_edge = f64::from(grid.voxel(IVec3::ZERO).0);
        // −s₂/√π at the edge, the surface 0.798 s₂ from it on the bisector.
        assert!((at_edge - value).abs() < 0.05, "{sigma:?} {at_edge}");
        let found = zero(&grid, IVec3::new(1, 1, 0)) * 2f64.sqrt();
        assert!((found - place).abs() < 0.05, "{sigma:?} {found}");
    }
}

#[test]
fn faded_kernels_keep_the_fillet() {
    // Height of the surface above the floor, 1, 2 and 3 voxels from the crease.
    let crease = sampled(26, 14.0, |p| p.x.min(p.y));
    let curve: Vec<DVec3> = (-100..=100).map(|i| DVec3::Z * f64::from(i) / 4.0).collect();
    for (reach, heights) in [(6.0, [1.49, 0.41, 0.16]), (8.0, [1.49, 0.42, 0.19])] {
        let region = Near::new(&curve, [reach / 2.0, reach]).unwrap();
        let grid = passes(&crease, DEFAULT, Some(&region), true);
        for (x, height) in (1..).zip(heights) {
            let value = |y: i32| f64::from(grid.voxel(IVec3::new(x, y, 0)).0);
            let y = (-3..9).find(|&y| value(y) < 0.0 && value(y + 1) >= 0.0).unwrap();
            let found = f64::from(y) + value(y) / (value(y) - value(y + 1));
            assert!((found - height).abs() < 0.03, "{reach} {x}: {found}");
        }
        // Beyond the region nothing is touched.
        near(&grid, |p, v| {
            if p.truncate().length() > reach + 0.2 && p.z.abs() < 20.0 {
                assert_eq!(v, p.x.min(p.y));
            }
        });
    }
}

#[test]
fn values_beyond_the_needed_band_do_not_matter() {
    // Clamped at 3, 4, 5 and 6 voxels the result differs by 0.027, 0.005, 0.0006 and 0.0000 (rms).
    let a = |p: DVec3| (p + DVec3::X * 5.0).length() - 9.0;
    let b = |p: DVec3| (p - DVec3::new(6.0, 2.0, 1.0)).length() - 7.3;
    let union = |p: DVec3| a(p).min(b(p));
    let exact = passes(&sampled(26, 15.0, union), DEFAULT, None, false);
    for (half_width, most) in [(3.0, 0.04), (4.0, 0.012), (5.0, 0.003), (6.0, 0.001)] {
        let cut = passes(&sampled(26, half_width, union), DEFAULT, None, false);
        let (mut squares, mut count) = (0.0, 0.0);
        near(&cut, |p, v| {
            if union(p).abs() < 1.0 && a(p).abs() < 4.0 && b(p).abs() < 4.0 {
                squares += (v - f64::from(exact.voxel(p.as_ivec3()).0)).powi(2);
                count += 1.0;
            }
        });
        let rms = f64::sqrt(squares / count);
        assert!(rms < most, "{half_width}: {rms}");
    }
    assert_eq!(gaussian(DEFAULT).needed_half_width(), 5.0);
    assert_eq!(gaussian([0.5, 1.0]).needed_half_width(), 3.0);
}

/// The whole filter in place, on a band of three voxels.
fn apply(level_set: &mut LevelSet, what: &AnisotropicGaussian, times: u32, region: Option<&dyn Region>) -> Report {
    let report = filter_anisotropic(level_set, what, times, region, &what.repair(), &RunOptions::default()).unwrap();
    assert_eq!(level_set.check(), []);
    assert_eq!(level_set.half_width(), 3.0);
    report
}

#[test]
fn a_ball_shrinks_and_stays_a_distance() {
    let mut ball = sampled(26, 3.0, |p| p.length() - 20.0);
    assert_eq!(apply(&mut ball, &gaussian([1.333, 2.0]), 3, None).steps, 3);
    let radius = 20.0 - 3.0 * 0.2 - 0.006;
    let mut worst = 0f64;
    near(ball.grid(), |p, v| {
        if v.abs() < 1.5 {
            worst = worst.max((v - (p.length() - radius)).abs());
        }
    });
    assert!(worst < 0.05, "{worst}");
}

#[test]
fn a_thin_slab_survives_what_an_isotropic_filter_removes() {
    let slab = |p: DVec3| box_distance(p - DVec3::new(0.2, 0.1, 0.0), DVec3::new(24.0, 24.0, 2.0));
    let mut kept = sampled(30, 3.0, slab);
    apply(&mut kept, &gaussian([1.0, 3.0]), 1, None);
    let (below, above) = (zero(kept.grid(), IVec3::NEG_Z), zero(kept.grid(), IVec3::Z));
    assert!(below + above > 3.5, "{below} {above}");
    // The same width in all directions: 1.6 · 3 voxels is more than 4.
    let mut gone = sampled(30, 3.0, slab);
    apply(&mut gone, &gaussian([3.0, 3.0]), 1, None);
    assert!(gone.grid().voxel(IVec3::ZERO).0 > 0.0);
}

#[test]
fn added_or_removed_only() {
    let crossed =
        |p: DVec3| box_distance(p, DVec3::new(16.0, 5.0, 5.0)).min(box_distance(p, DVec3::new(5.0, 16.0, 5.0)));
    let before = sampled(22, 3.0, crossed);
    for direction in [Direction::Add, Direction::Remove, Direction::Both] {
        let mut after = before.clone();
        apply(&mut after, &AnisotropicGaussian { direction, ..gaussian(DEFAULT) }, 2, None);
        let (mut rose, mut fell) = (0, 0);
        let mut old = before.grid().accessor();
        near(after.grid(), |p, v| {
            let old = f64::from(old.value(p.as_ivec3()));
            (rose, fell) = (rose + u32::from(v > old), fell + u32::from(v < old));
        });
        match direction {
            Direction::Add => assert!(rose == 0 && fell > 100 && volume(&after) > volume(&before)),
            Direction::Remove => assert!(fell == 0 && rose > 100 && volume(&after) < volume(&before)),
            Direction::Both => assert!(rose > 100 && fell > 100),
        }
    }
}

#[test]
fn outside_the_region_every_bit_stays() {
    let noisy = |p: DVec3| p.length() - 18.0 + 0.4 * (p.x * 0.9).sin() * (p.y * 0.8).cos();
    let before = sampled(26, 3.0, |p| noisy(p) * 0.8);
    let ball =
        Primitive::new(Shape::Sphere { radius: 9.0 }, DVec3::X * 18.0, glam::DMat3::IDENTITY, [0.5, 1.0]).unwrap();
    let curve: Vec<DVec3> = (-60..60).map(|i| DVec3::new(18.0, 0.0, f64::from(i) / 8.0)).collect();
    let near_curve = Near::new(&curve, [3.0, 7.0]).unwrap();
    for (region, fades_kernels) in [(&ball as &dyn Region, false), (&near_curve, true)] {
        let mut after = before.clone();
        let what = AnisotropicGaussian { fades_kernels, ..gaussian(DEFAULT) };
        apply(&mut after, &what, 2, Some(region));
        let (mut kept, mut changed) = (0, 0);
        near(before.grid(), |p, v| {
            let same = f64::from(after.grid().voxel(p.as_ivec3()).0) == v;
            if region.weight(p) == 0.0 {
                assert!(same, "{p}");
                kept += 1;
            } else {
                changed += u32::from(!same);
            }
        });
        assert!(kept > 1000 && changed > 300, "{kept} {changed}");
    }
    let nowhere = Near::new(&[DVec3::splat(500.0)], [3.0, 7.0]).unwrap();
    assert_eq!(apply(&mut before.clone(), &gaussian(DEFAULT), 1, Some(&nowhere)).voxels, 0);
}

/// A box of 32.6 voxels whose surface carries smooth noise of about a third of a voxel.
fn noisy_box() -> LevelSet {
    const N: i32 = 64;
    let index = |p: IVec3| ((p.x * N + p.y) * N + p.z) as usize;
    let mut state = 11u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let mut noise: Vec<f64> = (0..N * N * N).map(|_| (0..6).map(|_| next() - 0.5).sum()).collect();
    for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
        let old = noise.clone();
        for (at, v) in noise.iter_mut().enumerate() {
            let at = at as i32;
            let p = IVec3::new(at / (N * N), at / N % N, at % N);
            let tap = |k: i32| old[index((p + axis * k).rem_euclid(IVec3::splat(N)))] * (f64::from(-k * k) / 2.0).exp();
            *v = (-4..=4).map(tap).sum();
        }
    }
    let deviation = (noise.iter().map(|v| v * v).sum::<f64>() / noise.len() as f64).sqrt();
    let mut level_set = sampled(28, 6.0, |p| box_distance(p, DVec3::splat(16.3)));
    let origins: Vec<_> = level_set.grid().leaves().iter().map(|&id| (id, level_set.grid().origin(id))).collect();
    level_set.grid_mut().update_all(|id, values, mask| {
        let origin = origins.iter().find(|o| o.0 == id).unwrap().1;
        for at in mask.iter() {
            let n = noise[index((origin + offset_to_local(at)).rem_euclid(IVec3::splat(N)))] * 0.35 / deviation;
            values.0[at] = (f64::from(values.0[at]) + n).clamp(-5.99, 5.99) as f32;
        }
    });
    // Distances by sweeping, as in the independent computation: polygons would cut the edges off.
    sweep_distance(&level_set, 3.0, &RunOptions::default()).unwrap()
}

/// Roughness of the faces (rms) and how far the edges have retreated along their bisectors.
fn faces_and_edges(level_set: &LevelSet) -> [f64; 2] {
    let mesh = level_set_to_mesh(level_set, 0.0, &RunOptions::default()).unwrap();
    let (mut squares, mut count_of_faces) = (0.0, 0.0);
    for p in &mesh.positions {
        let mut a = p.abs().to_array();
        a.sort_by(f64::total_cmp);
        if a[1] < 10.0 {
            squares += box_distance(*p, DVec3::splat(16.3)).powi(2);
            count_of_faces += 1.0;
        }
    }
    let mut sampler = level_set.sampler();
    let (mut retreat, mut count) = (0.0, 0.0);
    for edge in 0..12 {
        let sign = |bit: i32| f64::from(1 - 2 * (edge & bit).min(1));
        for z in -8..=8 {
            let at = |i: i32| 12.0 + f64::from(i) * 0.02;
            let place = |i: i32| {
                let p = DVec3::new(sign(1) * at(i), sign(2) * at(i), f64::from(z));
                [p, DVec3::new(p.y, p.z, p.x), DVec3::new(p.z, p.x, p.y)][edge as usize / 4]
            };
            let last = (0..400).filter(|&i| sampler.trilinear(place(i)) < 0.0).last().unwrap();
            retreat += (16.3 - at(last)) * 2f64.sqrt();
            count += 1.0;
        }
    }
    [f64::sqrt(squares / count_of_faces), retreat / count]
}

#[test]
fn shapes_are_preserved_where_noise_goes() {
    let noisy = noisy_box();
    let [rough, start] = faces_and_edges(&noisy);
    assert!((rough - 0.33).abs() < 0.05, "{rough}");
    let of = |critical_curvature: Option<f32>, times: u32| {
        let mut level_set = noisy.clone();
        apply(&mut level_set, &AnisotropicGaussian { critical_curvature, ..gaussian([1.0, 2.0]) }, times, None);
        faces_and_edges(&level_set)
    };
    let adaptive = Some(AnisotropicGaussian::DEFAULT_CRITICAL_CURVATURE);
    // Faces and edges of an independent computation, with other noise of the same kind.
    for (critical, times, face, edge) in
        [(None, 1, 0.156, 1.52), (adaptive, 1, 0.161, 0.12), (None, 3, 0.103, 2.64), (adaptive, 3, 0.098, 0.07)]
    {
        let [found_face, found_edge] = of(critical, times);
        assert!((found_face - face).abs() < 0.04, "{critical:?} {times}: faces {found_face}");
        match critical {
            // The mean of all twelve edges, of one noise or another: 1.51 to 1.59 and 2.64 to 2.68 there in four of them.
            None => assert!((found_edge - edge).abs() < 0.06, "{times}: edges {found_edge}"),
            // Edges that are kept keep what the noise did to them: 0.17 there before the filter.
            Some(_) => {
                let (retreat, stated) = (found_edge - start, edge - 0.166);
                assert!((retreat - stated).abs() < 0.3, "{times}: edges {retreat}, {stated}");
            }
        }
    }
}

#[test]
fn numbers_of_threads_and_instruction_sets_change_no_bit() {
    let before = sampled(18, 3.0, |p| box_distance(p, DVec3::new(12.3, 8.1, 10.7)));
    let region =
        Primitive::new(Shape::Sphere { radius: 12.0 }, DVec3::splat(8.0), glam::DMat3::IDENTITY, [0.5, 1.0]).unwrap();
    let run = |isa, threads: usize| {
        choose(isa);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut level_set = before.clone();
            let what = AnisotropicGaussian { critical_curvature: Some(0.12), ..gaussian(DEFAULT) };
            apply(&mut level_set, &what, 1, Some(&region));
            level_set
        })
    };
    let first = run(Isa::Portable, 1);
    for (isa, threads) in [(Isa::Avx2, 2), (Isa::Avx512, 3)] {
        let other = run(isa, threads);
        let (a, b) = (first.grid(), other.grid());
        assert_eq!(a.leaves().len(), b.leaves().len());
        for (&i, &j) in a.leaves().iter().zip(b.leaves()) {
            assert!(a.origin(i) == b.origin(j) && a.values(i) == b.values(j) && a.mask(i) == b.mask(j));
        }
    }
    choose(Isa::detect());
}

#[test]
fn widths_that_cannot_be_are_refused() {
    for sigma in [[0.1, 1.0], [2.0, 1.0], [1.0, 9.0], [f32::NAN, 1.0], [1.0, f32::NAN]] {
        assert!(gaussian(sigma).validate("smooth").unwrap_err().to_string().contains("sigma"), "{sigma:?}");
    }
    let what = AnisotropicGaussian { critical_curvature: Some(0.0), ..gaussian(DEFAULT) };
    assert!(what.validate("smooth").is_err());
}
