//! What range maps say to a surface, and the first surface that follows from them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use glam::{DAffine3, DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::NAME;
use crate::error::{EditError, Result};
use crate::grid::{Grid, LEAF_DIM, LeafMask, LeafValues, Transform, offset_to_local};
use crate::levelset::{LevelSet, UnionFind, background};
use crate::mesh::{TriangleMesh, level_set_of_mesh, level_set_to_mesh};
use crate::pde::{LeafSurface, SurfaceSpeed, Tally};
use crate::range::{Around, Background, Projection, RangeMap, Seen};
use crate::run::RunOptions;

/// The window is cut off at so many times its width.
const CUT: f64 = 3.0;

/// Surfaces at a cosine below this are seen less and less.
const RAMP: f64 = 0.2;

/// Sum of weights from which on the maps alone say where the first surface is.
const ENOUGH: f64 = 0.05;

/// Bounds of the density of pixels, as a part of its mean: a map from very near or far neither rules nor vanishes.
const DENSITIES: [f64; 2] = [0.1, 10.0];

/// A map with what does not change from point to point.
pub(super) struct Term<'a> {
    pub map: &'a RangeMap,
    to_scanner: DAffine3,
    rays: Rays,
    /// s of the window exp(−D²/2s²), world units.
    pub width: f64,
    /// σ_ref²/σ².
    confidence: f64,
    /// 1 over the mean density of pixels.
    per_density: f64,
    /// How far behind a measurement it is solid, as far as this map knows.
    thickness: f64,
}

impl<'a> Term<'a> {
    pub fn new(map: &'a RangeMap, width: f64, confidence: f64, mean_density: Option<f64>, thickness: f64) -> Self {
        Self {
            map,
            to_scanner: map.pose.inverse(),
            rays: Rays::of(map),
            width,
            confidence,
            per_density: mean_density.map_or(1.0, f64::recip),
            // Within the window it is what was measured.
            thickness: thickness.max(CUT * width),
        }
    }

    /// D, the weight c·μ·w(D) and the ray's direction, where the map says anything near the point.
    pub fn at(&self, xyz: DVec3) -> Look {
        match self.map.look(&self.to_scanner, xyz) {
            Seen::No => Look::Unseen,
            Seen::Nothing => Look::Empty,
            Seen::Surface { distance, weight, density, direction } => {
                if distance > CUT * self.width {
                    return Look::InFront(weight);
                }
                if distance < -self.thickness {
                    return Look::Beyond;
                }
                if distance < -CUT * self.width {
                    return Look::Behind;
                }
                Look::Near { distance, weight: self.window(distance) * self.weight(density, weight), direction }
            }
        }
    }

    /// D and c·μ where it measured something at most `reach` from the point.
    fn sample(&self, xyz: DVec3, reach: f64) -> Option<(f64, f64)> {
        match self.map.look(&self.to_scanner, xyz) {
            Seen::Surface { distance, weight, density, .. } if distance.abs() < reach => {
                Some((distance, self.weight(density, weight)))
            }
            _ => None,
        }
    }

    /// w, a Gaussian; 0 where it is cut off.
    fn window(&self, distance: f64) -> f64 {
        let widths = distance / self.width;
        if widths.abs() < CUT { (-0.5 * widths * widths).exp() } else { 0.0 }
    }

    /// The colour that the map saw at a point of the surface with that normal, and how much it counts.
    pub fn color(&self, xyz: DVec3, normal: DVec3) -> Option<([u8; 3], f64)> {
        let Look::Near { weight, direction, .. } = self.at(xyz) else { return None };
        let weight = weight * -normal.dot(direction);
        Some((self.map.color(&self.to_scanner, xyz)?, weight)).filter(|(_, weight)| *weight > 0.0)
    }

    /// Whether the map sees a point of the surface with that normal.
    pub fn sees(&self, xyz: DVec3, normal: DVec3) -> bool {
        matches!(self.at(xyz), Look::Near { weight, direction, .. } if weight > 0.0 && -normal.dot(direction) > 0.0)
    }

    /// c·μ.
    fn weight(&self, density: f64, weight: f64) -> f64 {
        self.confidence * (density * self.per_density).clamp(DENSITIES[0], DENSITIES[1]) * weight
    }
}

/// The directions of a map's rays in the world.
enum Rays {
    Parallel(DVec3),
    /// From a point.
    From(DVec3),
}

impl Rays {
    fn of(map: &RangeMap) -> Self {
        match map.projection {
            Projection::Orthographic { .. } => Self::Parallel(map.pose.transform_vector3(DVec3::NEG_Z)),
            Projection::Pinhole { .. } | Projection::Spherical { .. } => Self::From(map.pose.translation),
        }
    }

    /// The direction of the ray through a point.
    fn at(&self, xyz: DVec3) -> DVec3 {
        match *self {
            Self::Parallel(direction) => direction,
            Self::From(scanner) => (xyz - scanner).normalize_or_zero(),
        }
    }
}

/// What a map says of a point.
pub(super) enum Look {
    Unseen,
    /// Its ray found nothing.
    Empty,
    /// Far in front of what was measured, with that confidence.
    InFront(f64),
    Behind,
    /// So far behind that it is not taken for solid.
    Beyond,
    Near {
        distance: f64,
        weight: f64,
        direction: DVec3,
    },
}

/// The data term F = −Σ V(n) c μ w(ρ) ρ with ρ = D + φ/(n·l): how far the ray through a voxel misses what was measured where it meets the
/// surface. D and c μ are looked up once a voxel and kept; ρ follows the surface, so that F is nearly the same along a normal and vanishes at rest.
pub(super) struct Forces<'a> {
    terms: &'a [Term<'a>],
    transform: Transform,
    run: &'a RunOptions,
    /// By the origin of a leaf.
    known: Mutex<FxHashMap<IVec3, Arc<Vec<Sampled>>>>,
    bytes: AtomicU64,
    failure: OnceLock<EditError>,
    /// The bits of the largest Σ V c μ w since it was last asked for.
    stiffness: AtomicU64,
}

/// What a map says at the voxels of a leaf.
struct Sampled {
    /// Number of the map.
    map: usize,
    /// D.
    distance: LeafValues,
    /// c μ; 0 where it says nothing.
    weight: LeafValues,
}

impl<'a> Forces<'a> {
    pub fn new(terms: &'a [Term<'a>], transform: Transform, run: &'a RunOptions) -> Self {
        Self {
            terms,
            transform,
            run,
            known: Mutex::default(),
            bytes: AtomicU64::new(0),
            failure: OnceLock::new(),
            stiffness: AtomicU64::new(0),
        }
    }

    /// What went wrong, if anything did.
    pub fn failure(self) -> Option<EditError> {
        self.failure.into_inner()
    }

    /// Whether anything went wrong.
    pub fn has_failed(&self) -> bool {
        self.failure.get().is_some()
    }

    /// The largest Σ V c μ w of a voxel since the last call: what bounds the step.
    pub fn take_stiffness(&self) -> f64 {
        f64::from_bits(self.stiffness.swap(0, Ordering::Relaxed))
    }

    fn of(&self, origin: IVec3, half_width: f64) -> Option<Arc<Vec<Sampled>>> {
        let known = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(forces) = known().get(&origin) {
            return Some(forces.clone());
        }
        let half = f64::from(LEAF_DIM - 1) / 2.0;
        let (centre, radius) =
            (self.transform.index_to_world(origin.as_dvec3() + half), half * 3f64.sqrt() * self.transform.voxel_size());
        let mut sampled = Vec::new();
        for (map, term) in self.terms.iter().enumerate() {
            let reach = CUT * term.width + half_width / RAMP;
            if !matches!(term.map.look_around(&term.to_scanner, centre, radius, reach), Around::Mixed) {
                continue;
            }
            let (mut distance, mut weight) = (LeafValues::default(), LeafValues::default());
            let mut any = false;
            for at in 0..weight.0.len() {
                let xyz = self.transform.voxel_to_world(origin + offset_to_local(at));
                if let Some((d, w)) = term.sample(xyz, reach) {
                    (distance.0[at], weight.0[at]) = (d as f32, w as f32);
                    any |= w > 0.0;
                }
            }
            if any {
                sampled.push(Sampled { map, distance, weight });
            }
        }
        let bytes = (sampled.len() * size_of::<Sampled>()) as u64;
        let total = bytes + self.bytes.fetch_add(bytes, Ordering::Relaxed);
        if let Err(error) = self.run.reserve(NAME, total, "take a larger voxel_size") {
            let _ = self.failure.set(error);
            return None;
        }
        let sampled = Arc::new(sampled);
        known().insert(origin, sampled.clone());
        Some(sampled)
    }
}

impl SurfaceSpeed for Forces<'_> {
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
        let mut tally = Tally::default();
        let half_width = f64::from(leaf.background);
        let Some(sampled) = self.of(leaf.origin, half_width).filter(|_| !self.has_failed()) else {
            speed.0.fill(0.0);
            return tally;
        };
        let voxel_size = self.transform.voxel_size();
        let mut stiffest = 0f64;
        for foot in leaf.feet() {
            let normal = self.transform.direction_to_world(foot.normal).normalize_or_zero();
            let xyz = self.transform.voxel_to_world(leaf.origin + offset_to_local(foot.offset));
            let (mut force, mut stiffness) = (0.0, 0.0);
            for Sampled { map, distance, weight } in sampled.iter() {
                let weight = f64::from(weight.0[foot.offset]);
                let Some(term) = self.terms.get(*map).filter(|_| weight > 0.0) else { continue };
                let cosine = -normal.dot(term.rays.at(xyz));
                if cosine <= 0.0 {
                    continue;
                }
                let miss = f64::from(distance.0[foot.offset]) - foot.depth * voxel_size / cosine.max(RAMP);
                let weight = weight * term.window(miss) * (cosine / RAMP).min(1.0);
                force -= weight * miss;
                stiffness += weight;
            }
            speed.0[foot.offset] = force as f32;
            stiffest = stiffest.max(stiffness);
            if foot.beside {
                tally.count += 1.0;
                tally.squares += force * force;
            }
        }
        // Positive numbers are in the order of their bits.
        self.stiffness.fetch_max(stiffest.to_bits(), Ordering::Relaxed);
        tally
    }
}

/// What maps say of all voxels of a leaf at once, and the maps that must be asked voxel by voxel.
#[derive(Default)]
struct Votes<'t, 'a> {
    in_front: bool,
    empty: usize,
    behind: usize,
    surely_empty: bool,
    mixed: Vec<&'t Term<'a>>,
}

impl<'t, 'a> Votes<'t, 'a> {
    /// Of the voxels around a point, up to `radius` away.
    fn new(terms: &'t [Term<'a>], centre: DVec3, radius: f64) -> Self {
        let mut votes = Self::default();
        for term in terms {
            match term.map.look_around(&term.to_scanner, centre, radius, CUT * term.width) {
                Around::Outside => {}
                Around::Invalid => match term.map.background {
                    Background::Empty => votes.surely_empty = true,
                    Background::Unknown => votes.empty += 1,
                },
                Around::InFront => votes.in_front = true,
                Around::Behind if term.thickness.is_finite() => votes.mixed.push(term),
                Around::Behind => votes.behind += 1,
                Around::Mixed => votes.mixed.push(term),
            }
        }
        votes
    }

    /// Whether the voxels are inside, if no map must be asked.
    fn agreed(&self) -> Option<bool> {
        self.mixed.is_empty().then(|| self.is_inside())
    }

    /// Inside is what maps see the surface in front of, and none sees through. What no map has in its picture is outside: it is not closed
    /// off by anything but the end of the pictures.
    fn is_inside(&self) -> bool {
        !self.in_front && !self.surely_empty && self.behind > 0 && self.empty <= self.behind
    }

    /// φ₀ at a point, world units: Σ c μ w D / Σ c μ w where the maps say enough; else outside where a map sees through, inside where none does.
    fn value(&self, xyz: DVec3, background: f64) -> f64 {
        let (mut sum, mut weights) = (0.0, 0.0);
        let mut all = Self { mixed: Vec::new(), ..*self };
        for term in &self.mixed {
            match term.at(xyz) {
                // A ray without an answer is a vote, not a proof.
                Look::Unseen => all.empty += usize::from(term.frames(xyz)),
                Look::Empty => all.surely_empty = true,
                Look::InFront(weight) => all.in_front |= weight > 0.0,
                Look::Behind => all.behind += 1,
                Look::Beyond => all.empty += 1,
                Look::Near { distance, weight, .. } => {
                    sum += weight * distance;
                    weights += weight;
                    all.in_front |= distance > 0.0 && weight > 0.0;
                    all.behind += usize::from(distance < 0.0);
                }
            }
        }
        if weights > ENOUGH {
            return (sum / weights).clamp(-background, background);
        }
        if all.is_inside() { -background } else { background }
    }
}

impl Term<'_> {
    /// Whether the point is within the map's picture.
    fn frames(&self, xyz: DVec3) -> bool {
        let Some((pixel, _)) = self.map.projection.project(self.to_scanner.transform_point3(xyz)) else { return false };
        pixel.min_element() > -0.5 && pixel.x < self.map.width as f64 - 0.5 && pixel.y < self.map.height as f64 - 0.5
    }
}

/// The zero set of the data term between two voxels, closed by the box.
pub(super) fn first_surface(
    terms: &[Term],
    transform: &Transform,
    half_width: f32,
    (lo, hi): (IVec3, IVec3),
    run: &RunOptions,
) -> Result<LevelSet> {
    let background = background(half_width, transform);
    let (first, last) = (lo.div_euclid(IVec3::splat(LEAF_DIM)), hi.div_euclid(IVec3::splat(LEAF_DIM)));
    let size = last - first + 1;
    let [sx, sy, sz] = size.to_array().map(|n| n.unsigned_abs() as usize);
    let count = sx.saturating_mul(sy).saturating_mul(sz);
    run.reserve(NAME, (count as u64).saturating_mul(16), "take a larger voxel_size")?;
    let task = run.task("first estimate", count as u64);
    let place_of = |n: usize| IVec3::new((n / (sy * sz)) as i32, (n / sz % sy) as i32, (n % sz) as i32);
    let origin_of = |n: usize| (first + place_of(n)) * LEAF_DIM;
    let half = f64::from(LEAF_DIM - 1) / 2.0;
    let votes_of = |n: usize| {
        let centre = transform.index_to_world(origin_of(n).as_dvec3() + half);
        Votes::new(terms, centre, half * 3f64.sqrt() * transform.voxel_size())
    };
    // The box closes what no map does.
    let within = |ijk: IVec3| ijk.cmpgt(lo).all() && ijk.cmplt(hi).all();
    // The sign of leaves of which all maps say the same.
    let mut signs: Vec<Option<bool>> = (0..count)
        .into_par_iter()
        .with_min_len(16)
        .map(|n| {
            task.advance(1);
            if run.is_cancelled() {
                return Some(false);
            }
            let (origin, votes) = (origin_of(n), votes_of(n));
            let inside = votes.agreed()?;
            let whole = within(origin) && within(origin + (LEAF_DIM - 1));
            (whole || !inside).then_some(inside)
        })
        .collect();
    run.check(NAME)?;
    let split: Vec<usize> = (0..count).filter(|&n| signs[n].is_none()).collect();
    run.reserve(NAME, split.len() as u64 * 5000, "take a larger voxel_size")?;
    let values_of = |&n: &usize| {
        let (origin, votes) = (origin_of(n), votes_of(n));
        let mut values = LeafValues::default();
        for (at, value) in values.0.iter_mut().enumerate() {
            let ijk = origin + offset_to_local(at);
            *value = match within(ijk) && !run.is_cancelled() {
                true => votes.value(transform.voxel_to_world(ijk), f64::from(background)) as f32,
                false => background,
            };
        }
        (n, values)
    };
    let mut found: Vec<(usize, LeafValues)> = split.par_iter().with_min_len(4).map(values_of).collect();
    run.check(NAME)?;
    for (n, values) in &found {
        signs[*n] = values.one_sign();
    }
    let sign = |place: IVec3| match place.cmpge(IVec3::ZERO).all() && place.cmplt(size).all() {
        true => signs[((place.x * size.y + place.y) * size.z + place.z) as usize],
        false => Some(false),
    };
    // Leaves of one sign beside those of the other one are wanted as well.
    let needed = |n: usize| {
        let (place, own) = (place_of(n), signs[n]);
        own.is_none() || (0..27).any(|k| sign(place + IVec3::new(k / 9 - 1, k / 3 % 3 - 1, k % 3 - 1)) != own)
    };
    found.retain(|(n, _)| needed(*n));
    let mut is_split = vec![false; count];
    split.iter().for_each(|&n| is_split[n] = true);
    let whole: Vec<usize> = (0..count).filter(|&n| !is_split[n] && needed(n)).collect();
    run.reserve(NAME, (found.len() + whole.len()) as u64 * 5000, "take a larger voxel_size")?;
    let filled = |n: usize| LeafValues::filled(if signs[n] == Some(true) { -background } else { background });
    found.extend(whole.into_iter().map(|n| (n, filled(n))));
    found.sort_unstable_by_key(|(n, _)| *n);
    let leaves: Vec<(IVec3, LeafValues)> = found.into_iter().map(|(n, values)| (origin_of(n), values)).collect();
    let origins: Vec<IVec3> = leaves.iter().map(|leaf| leaf.0).collect();
    let mut grid = Grid::from_origins(background, &origins);
    let by_origin: FxHashMap<IVec3, usize> = origins.iter().enumerate().map(|(n, o)| (*o, n)).collect();
    let of_slot: FxHashMap<usize, usize> =
        grid.leaves().iter().filter_map(|&id| Some((id.index(), *by_origin.get(&grid.origin(id))?))).collect();
    grid.update_all(|id, values, mask| {
        if let Some(&n) = of_slot.get(&id.index()) {
            values.clone_from(&leaves[n].1);
            *mask = LeafMask::EMPTY;
            for (at, value) in values.0.iter().enumerate() {
                mask.set(at, value.abs() < background);
            }
        }
    });
    grid.flood_signs();
    Ok(LevelSet::new(grid, *transform))
}

/// The surface without its small pieces, with exact distances: pieces that enclose less than a part of what the largest does are specks or
/// bubbles. Says how many went.
pub(super) fn without_specks(level_set: &LevelSet, part: f64, run: &RunOptions) -> Result<(LevelSet, usize)> {
    let mesh = level_set_to_mesh(level_set, 0.0, run)?;
    let pieces = pieces(&mesh);
    let volume = |triangles: &[[u32; 3]]| {
        let at = |v: u32| mesh.positions[v as usize];
        let reference = triangles.first().map_or(DVec3::ZERO, |t| at(t[0]));
        let sixth = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| at(v) - reference);
            a.dot(b.cross(c)) / 6.0
        };
        triangles.iter().map(sixth).sum::<f64>().abs()
    };
    let volumes: Vec<f64> = pieces.iter().map(|piece| volume(piece)).collect();
    let largest = volumes.iter().copied().fold(0.0, f64::max);
    let kept: Vec<[u32; 3]> = pieces
        .iter()
        .zip(&volumes)
        .filter(|(_, volume)| **volume >= part * largest)
        .flat_map(|(piece, _)| piece.iter().copied())
        .collect();
    let gone = volumes.iter().filter(|volume| **volume < part * largest).count();
    let mesh = TriangleMesh { triangles: kept, ..mesh };
    Ok((level_set_of_mesh(mesh, level_set.transform(), level_set.half_width(), run)?, gone))
}

/// The triangles of each connected piece, in the order of their first.
fn pieces(mesh: &TriangleMesh) -> Vec<Vec<[u32; 3]>> {
    let joined = UnionFind::new(mesh.positions.len());
    for &[a, b, c] in &mesh.triangles {
        joined.join(a, b);
        joined.join(b, c);
    }
    let mut place: FxHashMap<u32, usize> = FxHashMap::default();
    let mut pieces: Vec<Vec<[u32; 3]>> = Vec::new();
    for triangle in &mesh.triangles {
        let root = joined.root(triangle[0]);
        let n = *place.entry(root).or_insert_with(|| {
            pieces.push(Vec::new());
            pieces.len() - 1
        });
        pieces[n].push(*triangle);
    }
    pieces
}
