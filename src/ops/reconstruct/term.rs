//! A range map with what is the same at all points: what it says of points, of the vertices of a surface and of the voxels of a leaf.

use fearless_simd::{Select, Simd, SimdBase};
use glam::{DAffine3, DVec3, IVec3};

use crate::grid::{LEAF_VOXELS, LeafValues, Transform};
use crate::range::{Around, Background, Picture, Projection, RangeMap};
use crate::stencil::simd::{Lanes, Work, dispatch, splat};

/// The window is cut off at so many times its width.
pub(super) const CUT: f64 = 3.0;

/// Surfaces at a cosine below this are seen less and less.
pub(super) const RAMP: f64 = 0.2;

/// Bounds of the density of pixels, as a part of its mean: a map from very near or far neither rules nor vanishes.
const DENSITIES: [f64; 2] = [0.1, 10.0];

/// A map with what does not change from point to point.
pub(super) struct Term<'a> {
    pub map: &'a RangeMap,
    picture: Picture<'a>,
    pub to_scanner: DAffine3,
    /// In the world.
    pub rays: Rays<DVec3>,
    /// s of the window exp(−D²/2s²), world units.
    pub width: f64,
    /// σ_ref²/σ².
    confidence: f64,
    /// 1 over the mean density of pixels.
    per_density: f64,
    /// How far behind a measurement it is solid, as far as this map knows.
    pub thickness: f64,
}

impl<'a> Term<'a> {
    pub fn new(map: &'a RangeMap, width: f64, confidence: f64, mean_density: Option<f64>, thickness: f64) -> Self {
        let rays = match map.projection {
            Projection::Orthographic { .. } => Rays::Parallel(map.pose.transform_vector3(DVec3::NEG_Z)),
            Projection::Pinhole { .. } | Projection::Spherical { .. } => Rays::From(map.pose.translation),
        };
        Self {
            map,
            picture: Picture::new(map),
            to_scanner: map.pose.inverse(),
            rays,
            width,
            confidence,
            per_density: mean_density.map_or(1.0, f64::recip),
            // Within the window it is what was measured.
            thickness: thickness.max(CUT * width),
        }
    }

    /// Whether a ray without a measurement says that there is nothing.
    pub fn sees_through(&self) -> bool {
        self.map.background == Background::Empty
    }

    /// D and c μ at points in the scanner's frame.
    #[inline(always)]
    fn look<S: Simd>(&self, simd: S, points: [Lanes<S>; 3]) -> [Lanes<S>; 2] {
        let sight = self.picture.look(simd, points);
        let density = (sight.density * splat(simd, self.per_density))
            .max(splat(simd, DENSITIES[0]))
            .min(splat(simd, DENSITIES[1]));
        [sight.distance, density * sight.weight * splat(simd, self.confidence)]
    }

    /// What it says of the points up to `radius` from a point of the world; what may be nearer than `near` to what was measured is not told apart.
    pub fn look_around(&self, centre: DVec3, radius: f64, near: f64) -> Around {
        self.map.look_around(&self.to_scanner, centre, radius, near)
    }

    /// The largest c μ.
    pub fn heaviest(&self) -> f64 {
        DENSITIES[1] * self.confidence
    }

    /// How it sees points of a surface with those normals.
    pub fn views(&self, points: &[DVec3], normals: &[DVec3]) -> Vec<View> {
        let mut views = Vec::with_capacity(points.len());
        dispatch(Views { term: self, points, normals, views: &mut views });
        views
    }

    /// What it says at the voxels of a leaf.
    pub fn sample(&self, origin: IVec3, transform: &Transform, sampled: &mut Sampled) {
        let frame = self.to_scanner * transform.to_world();
        dispatch(SampleLeaf { term: self, frame, origin, sampled });
    }

    /// D of the voxels of a band that may matter: where rays graze the surface, they meet it far from a voxel.
    pub fn reach(&self, half_width: f64) -> f64 {
        CUT * self.width + half_width / RAMP
    }
}

/// Where the rays of a map come from.
pub(super) enum Rays<V> {
    /// Their unit direction.
    Parallel(V),
    /// The point.
    From(V),
}

/// The window w at a distance in units of its width: exp(−x²/2), 0 beyond the cut.
#[inline(always)]
pub(super) fn window<S: Simd>(simd: S, widths: Lanes<S>) -> Lanes<S> {
    // e^t with t from −4.5 to 0: the series of e^(t/16), within 4e-9 of it, and four squares.
    let t = widths * widths * (-0.5 / 16.0);
    let mut series = splat(simd, 1.0 / 720.0);
    for factor in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        series = series * t + splat(simd, factor);
    }
    let squared = series * series;
    let fourth = squared * squared;
    let eighth = fourth * fourth;
    widths.abs().simd_lt(CUT as f32).select(eighth * eighth, splat(simd, 0.0))
}

/// How a map sees a point of a surface.
#[derive(Clone, Copy)]
pub(super) struct View {
    /// D, world units.
    pub distance: f32,
    /// c μ w(D); 0 where it says nothing or the surface faces away.
    pub weight: f32,
    /// −n·l.
    pub cosine: f32,
}

impl View {
    const UNSEEN: Self = Self { distance: f32::NAN, weight: 0.0, cosine: 0.0 };

    /// Whether the map sees the point.
    pub fn is_seen(&self) -> bool {
        self.weight > 0.0
    }
}

struct Views<'a> {
    term: &'a Term<'a>,
    points: &'a [DVec3],
    normals: &'a [DVec3],
    views: &'a mut Vec<View>,
}

impl Work for Views<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { term, points, normals, views } = self;
        for (points, normals) in points.chunks(16).zip(normals.chunks(16)) {
            let mut seen = [View::UNSEEN; 16];
            for ((view, p), n) in seen.iter_mut().zip(points).zip(normals) {
                let ray = match term.rays {
                    Rays::Parallel(direction) => direction,
                    Rays::From(scanner) => (*p - scanner).normalize_or_zero(),
                };
                view.cosine = -n.dot(ray) as f32;
            }
            if seen.iter().any(|view| view.cosine > 0.0) {
                let mut at = [[0.0; 16]; 3];
                for (k, p) in points.iter().enumerate() {
                    let p = term.to_scanner.transform_point3(*p);
                    for axis in 0..3 {
                        at[axis][k] = p[axis] as f32;
                    }
                }
                let [distance, weight] = term.look(
                    simd,
                    at.each_ref().map(
                        #[inline(always)]
                        |values| Lanes::from_slice(simd, values),
                    ),
                );
                let weight = weight * window(simd, distance * (1.0 / term.width) as f32);
                for (k, view) in seen.iter_mut().enumerate() {
                    view.distance = distance[k];
                    if view.cosine > 0.0 && view.distance.is_finite() {
                        view.weight = weight[k];
                    }
                }
            }
            views.extend_from_slice(&seen[..points.len()]);
        }
    }
}

/// What a map says at the voxels of a leaf.
pub(super) struct Sampled {
    /// Number of the map.
    pub map: u32,
    /// D; ∞ where its ray has no measurement, NaN outside of its picture.
    pub distance: LeafValues,
    /// c μ; 0 where it says nothing.
    pub weight: LeafValues,
}

impl Sampled {
    pub fn of(map: usize) -> Self {
        Self { map: map as u32, distance: LeafValues::default(), weight: LeafValues::default() }
    }
}

struct SampleLeaf<'a> {
    term: &'a Term<'a>,
    /// From voxels to the scanner's frame.
    frame: DAffine3,
    origin: IVec3,
    sampled: &'a mut Sampled,
}

impl Work for SampleLeaf<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { term, frame, origin, sampled } = self;
        let (a, first) = (frame.matrix3, frame.transform_point3(origin.as_dvec3()));
        let local = Local::new(simd);
        for at in (0..LEAF_VOXELS).step_by(16) {
            let [x, y, z] = local.rows(simd, at);
            macro_rules! along {
                ($axis:literal) => {
                    x * splat(simd, a.x_axis[$axis])
                        + y * splat(simd, a.y_axis[$axis])
                        + z * splat(simd, a.z_axis[$axis])
                        + splat(simd, first[$axis])
                };
            }
            let [distance, weight] = term.look(simd, [along!(0), along!(1), along!(2)]);
            distance.store_slice(&mut sampled.distance.0[at..at + 16]);
            weight.store_slice(&mut sampled.weight.0[at..at + 16]);
        }
    }
}

/// Places of voxels in their leaf.
pub(super) struct Local<S: Simd> {
    y: Lanes<S>,
    z: Lanes<S>,
}

impl<S: Simd> Local<S> {
    #[inline(always)]
    pub fn new(simd: S) -> Self {
        Self { y: Lanes::from_fn(simd, |k| (k / 8) as f32), z: Lanes::from_fn(simd, |k| (k % 8) as f32) }
    }

    /// Of the two rows that begin at an offset.
    #[inline(always)]
    pub fn rows(&self, simd: S, at: usize) -> [Lanes<S>; 3] {
        [Lanes::splat(simd, (at / 64) as f32), self.y + Lanes::splat(simd, (at / 8 % 8) as f32), self.z]
    }
}
