//! What range maps say of the voxels of leaves, and the speed that follows from it.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};
use glam::{DAffine3, DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::NAME;
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, LEAF_VOXELS, LeafValues, Transform};
use crate::pde::{LeafSurface, SurfaceSpeed, Tally};
use crate::range::{Around, Background, Projection, RangeMap};
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch, splat};

/// The window is cut off at so many times its width.
pub(super) const CUT: f64 = 3.0;

/// Surfaces at a cosine below this are seen less and less.
const RAMP: f64 = 0.2;

/// Bounds of the density of pixels, as a part of its mean: a map from very near or far neither rules nor vanishes.
const DENSITIES: [f64; 2] = [0.1, 10.0];

/// A map with what does not change from point to point.
pub(super) struct Term<'a> {
    pub map: &'a RangeMap,
    pub to_scanner: DAffine3,
    /// In the world.
    rays: Rays<DVec3>,
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
        let sight = self.map.look(simd, points);
        let density = (sight.density * splat(simd, self.per_density))
            .max(splat(simd, DENSITIES[0]))
            .min(splat(simd, DENSITIES[1]));
        [sight.distance, density * sight.weight * splat(simd, self.confidence)]
    }

    /// How it sees points of a surface with those normals.
    pub fn views(&self, points: &[DVec3], normals: &[DVec3]) -> Vec<View> {
        let mut views = Vec::with_capacity(points.len());
        dispatch(Views { term: self, points, normals, views: &mut views });
        views
    }

    /// What it says at the voxels of a leaf. `number` is its own.
    pub fn sample(&self, number: usize, origin: IVec3, transform: &Transform) -> Sampled {
        let mut sampled =
            Sampled { map: number as u32, distance: LeafValues::default(), weight: LeafValues::default() };
        let frame = self.to_scanner * transform.to_world();
        dispatch(SampleLeaf { term: self, frame, origin, sampled: &mut sampled });
        sampled
    }
}

/// Where the rays of a map come from.
enum Rays<V> {
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
    /// c μ w(D); 0 where it says nothing.
    pub weight: f32,
    /// −n·l.
    pub cosine: f32,
}

impl View {
    /// Whether the map sees the point.
    pub fn is_seen(&self) -> bool {
        self.weight > 0.0 && self.cosine > 0.0
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
            for (k, (p, n)) in points.iter().zip(normals).enumerate() {
                let ray = match term.rays {
                    Rays::Parallel(direction) => direction,
                    Rays::From(scanner) => (*p - scanner).normalize_or_zero(),
                };
                let known = distance[k].is_finite();
                views.push(View {
                    distance: distance[k],
                    weight: if known { weight[k] } else { 0.0 },
                    cosine: -n.dot(ray) as f32,
                });
            }
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
struct Local<S: Simd> {
    y: Lanes<S>,
    z: Lanes<S>,
}

impl<S: Simd> Local<S> {
    #[inline(always)]
    fn new(simd: S) -> Self {
        Self { y: Lanes::from_fn(simd, |k| (k / 8) as f32), z: Lanes::from_fn(simd, |k| (k % 8) as f32) }
    }

    /// Of the two rows that begin at an offset.
    #[inline(always)]
    fn rows(&self, simd: S, at: usize) -> [Lanes<S>; 3] {
        [Lanes::splat(simd, (at / 64) as f32), self.y + Lanes::splat(simd, (at / 8 % 8) as f32), self.z]
    }
}

/// The data term F = −Σ V(n) c μ w(ρ) ρ with ρ = D + φ/(n·l): how far the ray through a voxel misses what was measured where it meets the
/// surface. D and c μ are looked up once a voxel and kept; ρ follows the surface, so that F is nearly the same along a normal and vanishes at rest.
pub(super) struct Forces<'a> {
    pub terms: &'a [Term<'a>],
    /// Rays of the terms in index space.
    local_rays: Vec<Rays<DVec3>>,
    pub transform: Transform,
    run: &'a RunOptions,
    /// By the origin of a leaf.
    known: Mutex<FxHashMap<IVec3, Arc<Known>>>,
    bytes: AtomicU64,
    /// What was in use before.
    in_use: u64,
    failure: OnceLock<EditError>,
    /// The bits of the largest Σ V c μ w since it was last asked for.
    stiffness: AtomicU32,
}

/// What is known of the voxels of a leaf.
pub(super) enum Known {
    /// What those maps say that the first surface needed.
    Begun(Vec<Sampled>),
    /// What all maps say, as it is read.
    Complete(Measured),
}

impl Known {
    fn bytes(&self) -> u64 {
        match self {
            Self::Begun(sampled) => (sampled.len() * size_of::<Sampled>()) as u64,
            Self::Complete(measured) => (measured.rows.len() * size_of::<RowPair>()) as u64,
        }
    }
}

/// What maps say at the voxels of a leaf, pair of rows by pair of rows, in the order of the maps.
pub(super) struct Measured {
    /// Numbers of the maps that say something.
    maps: Vec<u32>,
    /// Where a pair begins, and where the last one ends.
    first: [u32; 33],
    rows: Vec<RowPair>,
}

/// What a map says at two rows.
struct RowPair {
    /// Its place in the leaf's list.
    map: u32,
    /// D.
    distance: [f32; 16],
    /// c μ; 0 where it says nothing, and D is no number.
    weight: [f32; 16],
}

impl Measured {
    /// Of samples, without what is farther than `reach` tells for each map.
    fn new(sampled: &[Sampled], reach: impl Fn(u32) -> f32) -> Self {
        let mut measured = Self { maps: Vec::new(), first: [0; 33], rows: Vec::new() };
        for pair in 0..32 {
            let range = 16 * pair..16 * pair + 16;
            for Sampled { map, distance, weight } in sampled {
                let (distance, weight) = (&distance.0[range.clone()], &weight.0[range.clone()]);
                let reach = reach(*map);
                if !distance.iter().zip(weight).any(|(d, w)| *w > 0.0 && d.abs() < reach) {
                    continue;
                }
                let place = measured.maps.iter().position(|m| m == map).unwrap_or_else(|| {
                    measured.maps.push(*map);
                    measured.maps.len() - 1
                });
                let (distance, weight) = (std::array::from_fn(|k| distance[k]), std::array::from_fn(|k| weight[k]));
                measured.rows.push(RowPair { map: place as u32, distance, weight });
            }
            measured.first[pair + 1] = measured.rows.len() as u32;
        }
        measured
    }
}

impl<'a> Forces<'a> {
    pub fn new(terms: &'a [Term<'a>], transform: Transform, run: &'a RunOptions) -> Self {
        let local = |term: &Term| match term.rays {
            Rays::Parallel(ray) => Rays::Parallel(transform.direction_to_index(ray).normalize_or_zero()),
            Rays::From(scanner) => Rays::From(transform.world_to_index(scanner)),
        };
        Self {
            terms,
            local_rays: terms.iter().map(local).collect(),
            transform,
            run,
            known: Mutex::default(),
            bytes: AtomicU64::new(0),
            in_use: run.memory_in_use(),
            failure: OnceLock::new(),
            stiffness: AtomicU32::new(0),
        }
    }

    /// What went wrong, if anything did.
    pub fn check(&mut self) -> Result<()> {
        self.failure.take().map_or(Ok(()), Err)
    }

    /// Whether anything went wrong.
    pub fn has_failed(&self) -> bool {
        self.failure.get().is_some()
    }

    /// The largest Σ V c μ w of a voxel since the last call: what bounds the step.
    pub fn take_stiffness(&self) -> f64 {
        f32::from_bits(self.stiffness.swap(0, Ordering::Relaxed)).into()
    }

    /// Middle of a leaf in the world, and how far its voxels are from there.
    pub fn ball(&self, origin: IVec3) -> (DVec3, f64) {
        let half = f64::from(LEAF_DIM - 1) / 2.0;
        (self.transform.index_to_world(origin.as_dvec3() + half), half * 3f64.sqrt() * self.transform.voxel_size())
    }

    /// Keeps what some maps say of a leaf.
    pub fn keep(&self, origin: IVec3, sampled: Vec<Sampled>) {
        self.insert(origin, Known::Begun(sampled));
    }

    fn insert(&self, origin: IVec3, known: Known) -> Option<Arc<Known>> {
        let bytes = known.bytes();
        let total = bytes + self.bytes.fetch_add(bytes, Ordering::Relaxed);
        if let Err(error) = self.run.reserve_since(self.in_use, NAME, total, "take a larger voxel_size") {
            let _ = self.failure.set(error);
            return None;
        }
        let known = Arc::new(known);
        self.lock().insert(origin, known.clone());
        Some(known)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, FxHashMap<IVec3, Arc<Known>>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What all maps say of a leaf whose voxels are up to `half_width` (world units) from the surface.
    fn of(&self, origin: IVec3, half_width: f64) -> Option<Arc<Known>> {
        let mut begun = None;
        {
            let mut known = self.lock();
            match known.get(&origin).map(Arc::as_ref) {
                Some(Known::Complete(_)) => return known.get(&origin).cloned(),
                Some(Known::Begun(_)) => begun = known.remove(&origin),
                None => {}
            }
        }
        self.bytes.fetch_sub(begun.as_ref().map_or(0, |begun| begun.bytes()), Ordering::Relaxed);
        let mut sampled = match begun.and_then(Arc::into_inner) {
            Some(Known::Begun(sampled)) => sampled,
            _ => Vec::new(),
        };
        let asked: Vec<u32> = sampled.iter().map(|sampled| sampled.map).collect();
        let (centre, radius) = self.ball(origin);
        for (number, term) in self.terms.iter().enumerate().filter(|(n, _)| !asked.contains(&(*n as u32))) {
            if matches!(term.map.look_around(&term.to_scanner, centre, radius, term.reach(half_width)), Around::Mixed) {
                sampled.push(term.sample(number, origin, &self.transform));
            }
        }
        sampled.sort_by_key(|sampled| sampled.map);
        let reach = |map: u32| self.terms.get(map as usize).map_or(0.0, |term| term.reach(half_width) as f32);
        self.insert(origin, Known::Complete(Measured::new(&sampled, reach)))
    }
}

impl Term<'_> {
    /// D of the voxels of a band that may matter: where rays graze the surface, they meet it far from a voxel.
    fn reach(&self, half_width: f64) -> f64 {
        CUT * self.width + half_width / RAMP
    }
}

impl SurfaceSpeed for Forces<'_> {
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
        let mut tally = Tally::default();
        let known = self.of(leaf.origin, leaf.background.into()).filter(|_| !self.has_failed());
        let Some(Known::Complete(measured)) = known.as_deref() else {
            speed.0.fill(0.0);
            return tally;
        };
        let mut stiffest = 0.0;
        dispatch(Push { forces: self, leaf, measured, speed, stiffest: &mut stiffest });
        // Positive numbers are in the order of their bits.
        self.stiffness.fetch_max(f32::to_bits(stiffest), Ordering::Relaxed);
        for at in leaf.beside().iter() {
            tally.count += 1.0;
            tally.squares += f64::from(speed.0[at]) * f64::from(speed.0[at]);
        }
        tally
    }

    fn acts_on(&self, origin: IVec3, background: f32) -> bool {
        let known = self.of(origin, background.into());
        matches!(known.as_deref(), Some(Known::Complete(measured)) if !measured.maps.is_empty())
    }
}

/// F of a leaf.
struct Push<'a> {
    forces: &'a Forces<'a>,
    leaf: &'a LeafSurface<'a>,
    measured: &'a Measured,
    speed: &'a mut LeafValues,
    stiffest: &'a mut f32,
}

/// A map as the voxels of a leaf see it.
struct LocalMap {
    /// In voxels from the first one of the leaf.
    rays: Rays<[f32; 3]>,
    /// 1/s.
    per_width: f32,
    /// |ρ| from which on the window is 0, world units.
    cut: f32,
}

impl Work for Push<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { forces: Forces { terms, local_rays, transform, .. }, leaf, measured, speed, stiffest } = self;
        let (zero, one, ramp) = (splat(simd, 0.0), splat(simd, 1.0), splat(simd, RAMP));
        let voxel_size = splat(simd, transform.voxel_size());
        let mut maps = Vec::with_capacity(measured.maps.len());
        for map in &measured.maps {
            let (term, rays) = (&terms[*map as usize], &local_rays[*map as usize]);
            let rays = match rays {
                Rays::Parallel(ray) => Rays::Parallel(ray.as_vec3().to_array()),
                Rays::From(scanner) => Rays::From((*scanner - leaf.origin.as_dvec3()).as_vec3().to_array()),
            };
            maps.push(LocalMap { rays, per_width: (1.0 / term.width) as f32, cut: (CUT * term.width) as f32 });
        }
        let local = Local::new(simd);
        let mut most = zero;
        leaf.moving().for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let p = local.rows(simd, at);
                macro_rules! normal {
                    ($axis:literal) => {
                        Lanes::from_slice(simd, &leaf.normals()[$axis].0[at..at + 16])
                    };
                }
                let n = [normal!(0), normal!(1), normal!(2)];
                let depth = Lanes::from_slice(simd, &leaf.depths().0[at..at + 16]) * voxel_size;
                let farthest = depth.abs() * splat(simd, 1.0 / RAMP);
                let (mut force, mut stiffness) = (zero, zero);
                let pair = at / 16;
                for row in &measured.rows[measured.first[pair] as usize..measured.first[pair + 1] as usize] {
                    let map = &maps[row.map as usize];
                    let (weight, distance) =
                        (Lanes::from_slice(simd, &row.weight), Lanes::from_slice(simd, &row.distance));
                    // Where nothing was measured, D is no number and the weight 0.
                    let near =
                        weight.simd_gt(zero).select(distance.abs() - farthest, Lanes::splat(simd, f32::INFINITY));
                    if near.simd_lt(map.cut).to_bitmask() == 0 {
                        continue;
                    }
                    // −n·l times a length, and that length.
                    let (facing, length) = match map.rays {
                        Rays::Parallel([x, y, z]) => (-(n[0] * x + n[1] * y + n[2] * z), one),
                        Rays::From([x, y, z]) => {
                            let [x, y, z] = [p[0] - x, p[1] - y, p[2] - z];
                            let squared = (x * x + y * y + z * z).max(Lanes::splat(simd, f32::MIN_POSITIVE));
                            (-(n[0] * x + n[1] * y + n[2] * z), squared.sqrt())
                        }
                    };
                    // V is −n·l over RAMP, but at most 1: it has this denominator as well.
                    let per = one / facing.max(length * ramp);
                    let miss = distance - depth * length * per;
                    let weight = weight * window(simd, miss * map.per_width) * (facing * per);
                    let counts = weight.simd_gt(zero);
                    force -= counts.select(weight * miss, zero);
                    stiffness += counts.select(weight, zero);
                }
                force.store_slice(&mut speed.0[at..at + 16]);
                most = most.max(stiffness);
            },
        );
        *stiffest = (0..16).map(|k| most[k]).fold(0.0, f32::max);
    }
}
