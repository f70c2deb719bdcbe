//! What a map says of sixteen points at once.
//!
//! In single precision: ranges err by a part in ten million, angles by as much of a turn. Points are given in the scanner's frame, so that where that lies in
//! the world costs no digits.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::{Projection, RangeMap};
use crate::stencil::simd::{Lanes, splat};

/// What a map says of sixteen points.
pub struct Sight<S: Simd> {
    /// Signed distance along the ray: positive in front of the measured surface. ∞ where the ray has no measurement, NaN outside of the picture.
    pub distance: Lanes<S>,
    /// Confidence; 0 where nothing was measured.
    pub weight: Lanes<S>,
    /// Pixels a unit of area square to the ray, up to a constant that all maps share.
    pub density: Lanes<S>,
}

/// Where points are in a picture.
struct Pixels<S: Simd> {
    u: Lanes<S>,
    v: Lanes<S>,
    range: Lanes<S>,
    density: Lanes<S>,
}

/// A map as it is looked at: range and confidence of a pixel lie side by side.
pub struct Picture<'a> {
    map: &'a RangeMap,
    /// Row by row.
    pixels: Vec<[f32; 2]>,
}

impl<'a> Picture<'a> {
    /// Of a map as it is now.
    pub fn new(map: &'a RangeMap) -> Self {
        let pixels = map.ranges.iter().zip(&map.weights).map(|(range, weight)| [*range, *weight]).collect();
        Self { map, pixels }
    }

    /// What it says of points in the scanner's frame.
    #[inline(always)]
    pub fn look<S: Simd>(&self, simd: S, points: [Lanes<S>; 3]) -> Sight<S> {
        let Pixels { u, v, range, density } = self.map.projection.pixels(simd, points);
        let [measured, weight] = self.between_pixels(simd, u, v);
        Sight { distance: measured - range, weight, density }
    }

    /// Range and confidence between pixels: bilinear where all four pixels around are valid, else those of the nearest one. The range is ∞ where that has none,
    /// NaN outside of the picture.
    #[inline(always)]
    fn between_pixels<S: Simd>(&self, simd: S, u: Lanes<S>, v: Lanes<S>) -> [Lanes<S>; 2] {
        let zero = Lanes::splat(simd, 0.0);
        let (last_u, last_v) = (self.map.width as f32 - 1.0, self.map.height as f32 - 1.0);
        let (least, half) = (Lanes::splat(simd, -0.5), 0.5);
        // Neither holds of what is no number.
        let within = u.simd_gt(least) & u.simd_lt(last_u + half) & v.simd_gt(least) & v.simd_lt(last_v + half);
        let bits = within.to_bitmask();
        let nowhere = Lanes::splat(simd, f32::NAN);
        if bits == 0 {
            return [nowhere, zero];
        }
        let place = |at: Lanes<S>, last: f32| within.select(at.max(zero).min(Lanes::splat(simd, last)), zero);
        let (u, v) = (place(u, last_u), place(v, last_v));
        let (left, top) = (u.floor(), v.floor());
        let (mut columns, mut rows) = ([0.0; 16], [0.0; 16]);
        left.store_slice(&mut columns);
        top.store_slice(&mut rows);
        // Range and confidence of the four pixels around each point.
        let mut around = [[[0.0; 16]; 2]; 4];
        for k in 0..16 {
            let (column, row) = (columns[k] as usize, rows[k] as usize);
            let at = row * self.map.width + column;
            let two = |at: usize| self.pixels.get(at..at + 2).filter(|_| column + 1 < self.map.width);
            let four = match (two(at), two(at + self.map.width)) {
                (Some(&[a, b]), Some(&[c, d])) => [a, b, c, d],
                _ => [[f32::NAN, 0.0]; 4],
            };
            for (lanes, [range, weight]) in around.iter_mut().zip(four) {
                (lanes[0][k], lanes[1][k]) = (range, weight);
            }
        }
        let (s, t) = (u - left, v - top);
        macro_rules! mixed {
            ($what:literal) => {{
                let [a, b, c, d] = around.each_ref().map(
                    #[inline(always)]
                    |lanes| Lanes::from_slice(simd, &lanes[$what]),
                );
                let (above, below) = (a + (b - a) * s, c + (d - c) * s);
                above + (below - above) * t
            }};
        }
        let (range, weight) = (mixed!(0), mixed!(1));
        // A single pixel without a measurement makes no number of it.
        let gaps = bits & !range.simd_eq(range).to_bitmask();
        let (range, weight) = (within.select(range, nowhere), within.select(weight, zero));
        if gaps == 0 {
            return [range, weight];
        }
        let (mut ranges, mut weights) = ([0.0; 16], [0.0; 16]);
        range.store_slice(&mut ranges);
        weight.store_slice(&mut weights);
        for k in (0..16).filter(|k| gaps >> k & 1 == 1) {
            let nearest = (v[k] + 0.5) as usize * self.map.width + (u[k] + 0.5) as usize;
            [ranges[k], weights[k]] = match self.pixels.get(nearest) {
                Some(&[range, weight]) if !range.is_nan() => [range, weight],
                _ => [f32::INFINITY, 0.0],
            };
        }
        [Lanes::from_slice(simd, &ranges), Lanes::from_slice(simd, &weights)]
    }
}

impl Projection {
    /// As [`project`](Self::project), with densities; pixels are NaN where none looks.
    #[inline(always)]
    fn pixels<S: Simd>(&self, simd: S, [x, y, z]: [Lanes<S>; 3]) -> Pixels<S> {
        let one = Lanes::splat(simd, 1.0);
        match *self {
            Self::Orthographic { first, pitch } => Pixels {
                u: (x - splat(simd, first.x)) * splat(simd, 1.0 / pitch.x),
                v: (y - splat(simd, first.y)) * splat(simd, 1.0 / pitch.y),
                range: -z,
                density: one,
            },
            Self::Pinhole { focal, centre } => {
                let before = z.simd_gt(0.0);
                let deep = before.select(z, one);
                let nowhere = Lanes::splat(simd, f32::NAN);
                let range = (x * x + y * y + z * z).sqrt();
                Pixels {
                    u: before.select(x / deep * splat(simd, focal.x) + splat(simd, centre.x), nowhere),
                    v: before.select(y / deep * splat(simd, focal.y) + splat(simd, centre.y), nowhere),
                    range,
                    // Equal pixels of a plane: cos³ of the angle to the axis.
                    density: range / (deep * deep * deep),
                }
            }
            Self::Spherical { first, step } => {
                let turn = std::f64::consts::TAU;
                let flat = x * x + y * y;
                let squared = flat + z * z;
                // The turn at which the pixels begin may lie anywhere; it is that from half a pixel before the first one on.
                let mut azimuth = atan2(simd, y, x) - splat(simd, first.x - step.x / 2.0);
                azimuth -= (azimuth * splat(simd, 1.0 / turn)).floor() * splat(simd, turn);
                if step.x < 0.0 {
                    azimuth -= splat(simd, turn);
                }
                azimuth -= splat(simd, step.x / 2.0);
                Pixels {
                    u: azimuth * splat(simd, 1.0 / step.x),
                    v: (atan2(simd, z, flat.sqrt()) - splat(simd, first.y)) * splat(simd, 1.0 / step.y),
                    range: squared.sqrt(),
                    density: one / squared.max(Lanes::splat(simd, f32::MIN_POSITIVE)),
                }
            }
        }
    }
}

/// The angle of (x, y), −π to π; 0 at the origin. Errors are below 3e-7 (polynomial of the Cephes library by S. Moshier).
#[inline(always)]
fn atan2<S: Simd>(simd: S, y: Lanes<S>, x: Lanes<S>) -> Lanes<S> {
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let (along, across) = (x.abs(), y.abs());
    let (large, small) = (along.max(across), along.min(across));
    // 0 to 1, then within tan(π/8) of 0.
    let slope = small / large.max(Lanes::splat(simd, f32::MIN_POSITIVE));
    let steep = slope.simd_gt(std::f32::consts::SQRT_2 - 1.0);
    let t = steep.select((slope - one) / (slope + one), slope);
    let z = t * t;
    let p = ((z * 8.053_744_5e-2 - splat(simd, 1.387_768_6e-1)) * z + splat(simd, 1.997_771_1e-1)) * z
        - splat(simd, 3.333_294_9e-1);
    let angle = p * z * t + t + steep.select(splat(simd, std::f64::consts::FRAC_PI_4), zero);
    let angle = across.simd_gt(along).select(splat(simd, std::f64::consts::FRAC_PI_2) - angle, angle);
    let angle = x.simd_lt(zero).select(splat(simd, std::f64::consts::PI) - angle, angle);
    y.simd_lt(zero).select(-angle, angle)
}

#[cfg(test)]
pub(super) mod tests {
    use glam::{DAffine3, DQuat, DVec2, DVec3};

    use super::*;
    use crate::stencil::simd::{Work, dispatch};

    /// D at a point of the world.
    pub fn distance(map: &RangeMap, xyz: DVec3) -> f64 {
        look(map, &[map.pose.inverse().transform_point3(xyz)])[0][0].into()
    }

    struct Look<'a> {
        picture: Picture<'a>,
        points: &'a [DVec3],
        out: &'a mut Vec<[f32; 3]>,
    }

    impl Work for Look<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            for points in self.points.chunks(16) {
                let axis = |axis: usize| Lanes::from_fn(simd, |k| points.get(k).map_or(0.0, |p| p[axis] as f32));
                let sight = self.picture.look(simd, [axis(0), axis(1), axis(2)]);
                let all = [sight.distance, sight.weight, sight.density];
                self.out.extend((0..points.len()).map(|k| all.map(|values| values[k])));
            }
        }
    }

    /// D, confidence and density at points of the scanner's frame.
    fn look(map: &RangeMap, points: &[DVec3]) -> Vec<[f32; 3]> {
        let mut out = Vec::new();
        dispatch(Look { picture: Picture::new(map), points, out: &mut out });
        out
    }

    #[test]
    fn pixels_are_those_of_the_projection() {
        let projections = [
            Projection::Orthographic { first: DVec2::new(-3.0, -2.0), pitch: DVec2::new(0.5, 0.25) },
            Projection::Pinhole { focal: DVec2::new(90.0, 100.0), centre: DVec2::new(30.0, 20.0) },
            Projection::Spherical { first: DVec2::new(-2.0, -1.2), step: DVec2::new(0.1, 0.06) },
            Projection::Spherical { first: DVec2::new(0.7, 1.2), step: DVec2::new(-0.1, -0.06) },
        ];
        for projection in projections {
            // The range of a pixel is a plane over the picture, so that interpolation tells where it was looked up.
            let (width, height) = (60, 40);
            let plane = |u: f64, v: f64| 3.0 + 0.05 * u + 0.02 * v;
            let ranges = (0..width * height).map(|n| plane((n % width) as f64, (n / width) as f64) as f32).collect();
            let map = RangeMap::new("plane".into(), projection, DAffine3::IDENTITY, width, ranges);
            let points: Vec<DVec3> = (0..2000)
                .map(|n| DQuat::from_rotation_y(f64::from(n) * 0.37) * DVec3::Z * (0.5 + f64::from(n % 7)))
                .enumerate()
                .map(|(n, p)| DQuat::from_rotation_z(n as f64 * 0.61) * p)
                .collect();
            let mut inside = 0;
            for (p, [distance, weight, density]) in points.iter().zip(look(&map, &points)) {
                let rim = 1e-3;
                let within = projection.project(*p).filter(|(pixel, _)| {
                    pixel.cmpge(DVec2::splat(rim)).all()
                        && pixel.x < width as f64 - 1.0 - rim
                        && pixel.y < height as f64 - 1.0 - rim
                });
                let Some((pixel, range)) = within else { continue };
                inside += 1;
                let expected = plane(pixel.x, pixel.y) - range;
                assert!((f64::from(distance) - expected).abs() < 1e-5, "{projection:?} {p}: {distance} {expected}");
                assert_eq!(weight, 1.0);
                let expected = projection.density(*p, range);
                assert!((f64::from(density) / expected - 1.0).abs() < 1e-5, "{density} {expected}");
            }
            assert!(inside > 100, "{projection:?} {inside}");
        }
    }

    #[test]
    fn angles_all_around() {
        struct Angles<'a>(&'a [DVec2], &'a mut Vec<f32>);
        impl Work for Angles<'_> {
            #[inline(always)]
            fn run<S: Simd>(self, simd: S) {
                for points in self.0.chunks(16) {
                    let axis = |axis: usize| Lanes::from_fn(simd, |k| points.get(k).map_or(0.0, |p| p[axis] as f32));
                    let angles = atan2(simd, axis(1), axis(0));
                    self.1.extend((0..points.len()).map(|k| angles[k]));
                }
            }
        }
        let points: Vec<DVec2> =
            (0..4000).map(|n| DVec2::from_angle(f64::from(n) * 0.01) * f64::from(1 + n % 9)).collect();
        let mut angles = Vec::new();
        dispatch(Angles(&points, &mut angles));
        for (p, angle) in points.iter().zip(angles) {
            let exact = f64::from(p.y as f32).atan2(f64::from(p.x as f32));
            assert!((f64::from(angle) - exact).abs() < 3e-7, "{p}: {angle} {exact}");
        }
    }

    #[test]
    fn what_was_not_measured_and_what_is_not_in_the_picture() {
        let projection = Projection::Orthographic { first: DVec2::ZERO, pitch: DVec2::ONE };
        let ranges = vec![1.0, f32::NAN, 1.0, 1.0];
        let map = RangeMap::new("four".into(), projection, DAffine3::IDENTITY, 2, ranges);
        let at = |x: f64, y: f64| look(&map, &[DVec3::new(x, y, -0.25)])[0];
        // The nearest pixel where one of four has no measurement.
        assert_eq!(at(0.2, 0.3)[..2], [0.75, 1.0]);
        assert_eq!(at(0.9, 0.1)[..2], [f32::INFINITY, 0.0]);
        assert!(at(1.6, 0.0)[0].is_nan() && at(0.0, -0.6)[0].is_nan() && at(-0.4, -0.4)[0] == 0.75);
        let pinhole = Projection::Pinhole { focal: DVec2::ONE, centre: DVec2::ZERO };
        let behind = RangeMap { projection: pinhole, ..map };
        assert!(look(&behind, &[DVec3::new(0.0, 0.0, -1.0)])[0][0].is_nan());
    }
}
