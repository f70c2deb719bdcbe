//! Whole pictures against what they must show.

use glam::{DAffine3, DQuat, DVec3};

use super::testing::{shape, sphere};
use super::*;
use crate::grid::Transform;

/// Without the parts that take time and do not matter for where the surface is.
fn plain(width: u32, height: u32) -> RenderOptions {
    RenderOptions {
        width,
        height,
        occlusion_rays: 0,
        shadow: false,
        transparent_background: true,
        ..RenderOptions::default()
    }
}

fn picture(level_set: &LevelSet, color_by: &ColorBy<'_>, options: &RenderOptions) -> Image {
    render(level_set, color_by, options, &RunOptions::default()).unwrap()
}

/// Covered area of a picture in pixels.
fn coverage(image: &Image) -> f64 {
    image.rgba8.chunks_exact(4).map(|p| f64::from(p[3]) / 255.0).sum()
}

/// A crossed pair of bars: no two views alike, creases, shadows.
fn bars(transform: Transform) -> LevelSet {
    shape(transform, 3.0, 24, |p| {
        let bar = |p: DVec3, h: DVec3| {
            let q = p.abs() - h;
            q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
        };
        bar(p - DVec3::new(0.3, 0.2, 0.1), DVec3::new(17.0, 4.0, 5.0))
            .min(bar(p - DVec3::new(5.0, 6.0, 0.4), DVec3::new(3.0, 10.0, 8.0)))
    })
}

/// Largest and mean difference of two pictures, over all channels.
fn differences(a: &Image, b: &Image) -> (u8, f64) {
    let diffs = || a.rgba8.iter().zip(&b.rgba8).map(|(a, b)| a.abs_diff(*b));
    (diffs().max().unwrap(), diffs().map(f64::from).sum::<f64>() / a.rgba8.len() as f64)
}

#[test]
fn the_silhouette_of_a_sphere_has_the_area_of_its_cone() {
    let (radius, distance) = (30.0 * 0.5, 100.0);
    let set = sphere(30.0, 3.0);
    // A box that is a point in depth and sets the distance of the camera: its height fills the picture.
    let half = (14f64.to_radians()).tan() * distance;
    let mut options = plain(220, 200);
    options.camera = CameraSpec {
        azimuth: 0.0,
        elevation: 0.0,
        margin: 0.0,
        frame: Frame::Box(DVec3::new(-1.0, -half, 0.0), DVec3::new(1.0, half, 0.0)),
        ..CameraSpec::default()
    };
    let image = picture(&set, &ColorBy::Clay, &options);
    // Centred: a circle of radius tan(asin(r/d)) on the plane at distance 1, of which the picture shows ±tan 14°.
    let pixels = (radius / distance).asin().tan() / 14f64.to_radians().tan() * 100.0;
    let expected = std::f64::consts::PI * pixels * pixels;
    // 0.01 voxel of the trilinear surface is 0.03 % of the radius; sixteen samples a pixel of the border average out.
    assert!((coverage(&image) / expected - 1.0).abs() < 2e-3, "{} {expected}", coverage(&image));
}

#[test]
fn the_frame_holds_the_surface_with_its_margin() {
    for transform in [Transform::uniform(0.5), moved(0.5)] {
        for azimuth in [0.0, 50.0, 200.0] {
            let mut options = plain(120, 90);
            options.camera.azimuth = azimuth;
            let image = picture(&bars(transform), &ColorBy::Clay, &options);
            let covered: Vec<_> = (0..90)
                .flat_map(|y| (0..120).map(move |x| (x, y)))
                .filter(|&(x, y)| image.pixel(x, y).unwrap()[3] > 0)
                .collect();
            let gap = |f: &dyn Fn(&(u32, u32)) -> u32| covered.iter().map(f).min().unwrap();
            let left_right = gap(&|p| p.0).min(gap(&|p| 119 - p.0));
            let top_bottom = gap(&|p| p.1).min(gap(&|p| 89 - p.1));
            // The margin is 6 % of each side, and the frame may exceed the surface by a voxel (2 pixels here).
            assert!(left_right >= 6 && top_bottom >= 4, "{left_right} {top_bottom}");
            assert!(left_right <= 11 || top_bottom <= 9, "{left_right} {top_bottom}");
        }
    }
}

/// Rotated, mirrored and far away.
fn moved(voxel_size: f64) -> Transform {
    let rotation = DQuat::from_axis_angle(DVec3::new(1.0, -2.0, 0.5).normalize(), 0.8);
    Transform::from_affine(
        DAffine3::from_scale_rotation_translation(DVec3::splat(voxel_size), rotation, DVec3::new(3e4, -5e3, 7e2))
            * DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0)),
    )
    .unwrap()
}

#[test]
fn turning_the_object_equals_turning_the_camera() {
    let level = bars(Transform::uniform(0.5));
    let turned = level
        .clone()
        .with_transform(Transform::from_affine(DAffine3::from_rotation_y(0.7) * level.transform().to_world()).unwrap());
    let mut options = RenderOptions { width: 97, height: 73, ..RenderOptions::default() };
    let a = picture(&level, &ColorBy::Clay, &options);
    options.camera.azimuth += 0.7f64.to_degrees();
    let b = picture(&turned, &ColorBy::Clay, &options);
    let (_, mean) = differences(&a, &b);
    // Rounding moves a few rays across an edge; no more.
    assert!(mean < 0.05, "{mean}");
    // And z up is y up of the object that stands on its side.
    let upright = level.clone().with_transform(
        Transform::from_affine(DAffine3::from_rotation_x(std::f64::consts::FRAC_PI_2) * level.transform().to_world())
            .unwrap(),
    );
    options.camera = CameraSpec { up: UpAxis::Z, ..CameraSpec::default() };
    let (_, mean) = differences(&a, &picture(&upright, &ColorBy::Clay, &options));
    assert!(mean < 0.05, "{mean}");
}

#[test]
fn a_framed_sphere_keeps_its_size_from_everywhere() {
    let set = bars(Transform::uniform(0.5));
    let mut options = plain(80, 60);
    options.camera.frame = Frame::Sphere;
    let centre_of = |options: &RenderOptions| {
        let points = points_to_frame(&set, options.camera.frame);
        let camera = Camera::framing(&options.camera, &points, 80, 60);
        (points[0].0, (camera.eye - points[0].0).length())
    };
    let (centre, distance) = centre_of(&options);
    for azimuth in [0.0, 90.0, 123.0] {
        options.camera.azimuth = azimuth;
        let (c, d) = centre_of(&options);
        assert!((c - centre).length() < 1e-9 && (d - distance).abs() < 1e-9);
        let image = picture(&set, &ColorBy::Clay, &options);
        let border = (0..80).flat_map(|x| [(x, 0), (x, 59)]).chain((0..60).flat_map(|y| [(0, y), (79, y)]));
        assert!(border.into_iter().all(|(x, y)| image.pixel(x, y).unwrap()[3] == 0));
        assert!(coverage(&image) > 400.0);
    }
}

#[test]
fn a_narrow_band_has_no_holes() {
    // Where leaves end so close to the surface, cells with surface begin in absent leaves. The surface is the same.
    let options = plain(101, 101);
    let narrow = picture(&sphere(24.0, 1.5), &ColorBy::Clay, &options);
    let wide = picture(&sphere(24.0, 3.0), &ColorBy::Clay, &options);
    let alpha = |image: &Image| image.rgba8.iter().copied().skip(3).step_by(4).collect::<Vec<_>>();
    assert!(coverage(&wide) > 3000.0);
    let differ = std::iter::zip(alpha(&narrow), alpha(&wide)).enumerate().filter(|(_, (a, b))| a != b).take(9);
    let differ: Vec<_> = differ.map(|(i, d)| (i % 101, i / 101, d)).collect();
    assert!(differ.is_empty(), "{differ:?}");
}

#[test]
fn the_world_is_not_mirrored() {
    // A small ball at +x and one at +y on the big one: right and above in a front view.
    let set = shape(Transform::uniform(0.5), 3.0, 30, |p| {
        let ball = |c: DVec3, r: f64| (p - c).length() - r;
        ball(DVec3::ZERO, 10.0).min(ball(DVec3::X * 20.0, 5.0)).min(ball(DVec3::Y * 18.0, 3.0))
    });
    let mut options = plain(100, 100);
    options.camera = CameraSpec { azimuth: 0.0, elevation: 0.0, ..options.camera };
    let image = picture(&set, &ColorBy::Normal, &options);
    let side = |of: &dyn Fn(u32, u32) -> bool| {
        (0..100)
            .flat_map(|y| (0..100).map(move |x| (x, y)))
            .filter(|&(x, y)| of(x, y) && image.pixel(x, y).unwrap()[3] == 255)
            .count()
    };
    // The box is 35 × 31 voxels; the big ball's centre stands at 10/35 from the left and 21/31 from the top.
    assert!(side(&|x, y| x >= 75 && y > 40) > 100 && side(&|x, y| x < 50 && y < 20) > 30);
    assert_eq!(side(&|x, y| x > 60 && y < 30), 0);
}

#[test]
fn normals_are_coloured_by_the_world() {
    let level = sphere(30.0, 3.0);
    let mut options = plain(101, 101);
    options.camera = CameraSpec { azimuth: 0.0, elevation: 0.0, ..options.camera };
    for transform in [*level.transform(), moved(0.5)] {
        let image = picture(&level.clone().with_transform(transform), &ColorBy::Normal, &options);
        let [r, g, b, _] = image.pixel(50, 50).unwrap().map(i16::from);
        assert!((r - 127).abs() <= 2 && (g - 127).abs() <= 2 && b >= 253, "{r} {g} {b}");
        // Towards the right border of the disk the normal turns to +x, towards the top to +y.
        let right = image.pixel(85, 50).unwrap();
        let top = image.pixel(50, 15).unwrap();
        assert!(
            right[0] > 215 && right[1].abs_diff(127) < 4 && top[1] > 215 && top[0].abs_diff(127) < 4,
            "{right:?} {top:?}"
        );
    }
}

#[test]
fn threads_and_tiles_do_not_change_a_bit() {
    let set = bars(Transform::uniform(0.5));
    let options = RenderOptions { width: 201, height: 103, occlusion_rays: 3, ..RenderOptions::default() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| picture(&set, &ColorBy::Clay, &options))
    };
    let one = with(1);
    assert_eq!(one, with(3));
}

#[test]
fn creases_are_darker_than_open_surface() {
    // A ball that rests on a slab, seen from above: the slab beside the contact against the slab's far corner.
    let set = shape(Transform::uniform(1.0), 3.0, 40, |p| {
        let slab = (p - DVec3::new(0.3, -14.0, 0.2)).abs() - DVec3::new(36.0, 4.0, 36.0);
        let slab = slab.max(DVec3::ZERO).length() + slab.max_element().min(0.0);
        slab.min(p.length() - 11.0)
    });
    let mut options = RenderOptions { width: 200, height: 200, shadow: false, ..RenderOptions::default() };
    options.camera = CameraSpec { azimuth: 0.0, elevation: 90.0, field_of_view: 5.0, ..CameraSpec::default() };
    let image = picture(&set, &ColorBy::Clay, &options);
    let luminance = |x: u32, y: u32| f64::from(image.pixel(x, y).unwrap()[1]);
    let (beside, open) = (luminance(100 + 31, 100), luminance(182, 18));
    assert!(beside < 0.97 * open && beside > 0.3 * open, "{beside} {open}");
    // Without noise: along a ring around the ball the slab is of one brightness.
    let ring: Vec<_> = (0..40)
        .map(|i| f64::from(i) * 0.157)
        .map(|a| luminance((100.0 + 36.0 * a.cos()) as u32, (100.0 + 36.0 * a.sin()) as u32))
        .collect();
    let mean = ring.iter().sum::<f64>() / 40.0;
    assert!(ring.iter().all(|l| (l - mean).abs() < 8.0), "{ring:?}");
}

#[test]
fn colours_tell_the_data() {
    let ball = sphere(16.0, 3.0);
    let mut options = plain(65, 65);
    options.camera.azimuth = 0.0;
    let centre =
        |set: &LevelSet, by: &ColorBy<'_>, options: &RenderOptions| picture(set, by, options).pixel(32, 32).unwrap();
    // Convex is red; a hole through a box is blue inside.
    let [r, _, b, _] = centre(&ball, &ColorBy::Curvature, &options);
    assert!(r > b + 30, "{r} {b}");
    let bowl =
        shape(Transform::uniform(0.5), 3.0, 30, |p| (p.length() - 24.0).max(14.0 - (p - DVec3::Z * 22.0).length()));
    options.camera.elevation = 0.0;
    let [r, _, b, _] = centre(&bowl, &ColorBy::Curvature, &options);
    assert!(b > r + 30, "{r} {b}");
    // Larger than the other: red; smaller: blue; equal: neither.
    let other = |radius| sphere(radius, 3.0);
    let by = |set: &LevelSet| centre(&ball, &ColorBy::Difference(set), &options);
    let ([r1, _, b1, _], [r2, _, b2, _], [r3, _, b3, _]) = (by(&other(15.2)), by(&other(16.8)), by(&ball));
    assert!(r1 > b1 + 60 && b2 > r2 + 60 && r3.abs_diff(b3) < 8);
    let half = crate::region::Combined::Any(Vec::new());
    let [r, g, b, _] = centre(&ball, &ColorBy::Region(&half), &options);
    assert!(r == g && g == b);
    let numbers = |p: DVec3| Some(u32::from(p.x > 0.0));
    let image = picture(&ball, &ColorBy::Label(&numbers), &options);
    assert_ne!(image.pixel(20, 32).unwrap()[..3], image.pixel(44, 32).unwrap()[..3]);
}

#[test]
fn no_surface_is_a_picture_of_the_background() {
    let empty = LevelSet::empty(Transform::uniform(0.1), 3.0);
    let options = RenderOptions { width: 7, height: 3, background: [[10, 20, 30]; 2], ..RenderOptions::default() };
    let image = picture(&empty, &ColorBy::Curvature, &options);
    assert!(image.rgba8.chunks_exact(4).all(|p| p == [10, 20, 30, 255]));
    let transparent = RenderOptions { transparent_background: true, ..options };
    assert!(picture(&empty, &ColorBy::Clay, &transparent).rgba8.iter().all(|v| *v == 0));
}

#[test]
fn odd_sizes_work_and_bad_options_are_refused() {
    let ball = sphere(6.0, 3.0);
    for (width, height) in [(1, 1), (7, 3), (1, 40), (97, 1)] {
        let image = picture(&ball, &ColorBy::Clay, &RenderOptions { width, height, ..RenderOptions::default() });
        assert_eq!(image.rgba8.len() as u32, width * height * 4);
    }
    type Change = fn(&mut RenderOptions);
    let refused: [(&str, Change); 9] = [
        ("width", |o| o.width = 0),
        ("height", |o| o.height = 16385),
        ("antialias", |o| o.antialias = 0),
        ("occlusion_rays", |o| o.occlusion_rays = 257),
        ("range", |o| o.range = Some(f64::NAN)),
        ("camera.azimuth", |o| o.camera.azimuth = f64::INFINITY),
        ("camera.elevation", |o| o.camera.elevation = 91.0),
        ("camera.field_of_view", |o| o.camera.field_of_view = f64::NAN),
        ("camera.frame", |o| o.camera.frame = Frame::Box(DVec3::ONE, DVec3::ZERO)),
    ];
    for (name, change) in refused {
        let mut options = RenderOptions::default();
        change(&mut options);
        match render(&ball, &ColorBy::Clay, &options, &RunOptions::default()) {
            Err(EditError::Parameter { field, .. }) => assert_eq!(field, name),
            other => panic!("{name}: {:?}", other.map(|i| i.width)),
        }
    }
    let mut run = RunOptions::default();
    run.memory_limit = Some(1 << 20);
    let refused = render(&ball, &ColorBy::Clay, &RenderOptions::default(), &run);
    assert!(matches!(refused, Err(EditError::Memory { .. })));
    let run = RunOptions::default();
    run.cancel_flag().store(true, std::sync::atomic::Ordering::Relaxed);
    let refused = render(&ball, &ColorBy::Clay, &RenderOptions::default(), &run);
    assert!(matches!(refused, Err(EditError::Cancelled { .. })));
}

#[test]
fn space_that_changes_sign_without_leaves_is_a_surface() {
    // A solid block of tiles, as a file that lost its band has: its faces lie between the tile's last voxel and the next.
    let mut grid = crate::grid::Grid::empty(1.5);
    grid.set_sign(glam::IVec3::ZERO, glam::IVec3::splat(32), true);
    let set = LevelSet::new(grid, Transform::uniform(0.5));
    let mut options = plain(60, 60);
    options.camera = CameraSpec { azimuth: 0.0, elevation: 0.0, margin: 0.0, ..options.camera };
    options.camera.frame = Frame::Box(DVec3::splat(-8.0), DVec3::splat(24.0));
    let image = picture(&set, &ColorBy::Clay, &options);
    // 16 of 32 across at the middle of the frame; the near face is nearer than that.
    let share = coverage(&image) / 3600.0;
    assert!((0.1..0.26).contains(&share), "{share}");
    assert_eq!(image.pixel(30, 30).unwrap()[3], 255);
}
