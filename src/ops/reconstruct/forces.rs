//! What range maps say to a surface, and the first surface that follows from them.

use std::sync::{Arc, Mutex, PoisonError};

use glam::{DAffine3, DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::NAME;
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LeafMask, LeafValues, Transform, offset_to_local};
use crate::levelset::{LevelSet, background};
use crate::mesh::{TriangleMesh, level_set_of_mesh, level_set_to_mesh};
use crate::pde::{LeafSurface, SurfaceSpeed, Tally};
use crate::range::{Around, Background, RangeMap, Seen};
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
    /// s of the window exp(−D²/2s²), world units.
    pub width: f64,
    /// σ_ref²/σ².
    confidence: f64,
    /// 1 over the mean density of pixels.
    per_density: f64,
}

impl<'a> Term<'a> {
    pub fn new(map: &'a RangeMap, width: f64, confidence: f64, mean_density: Option<f64>) -> Self {
        Self {
            map,
            to_scanner: map.pose.inverse(),
            width,
            confidence,
            per_density: mean_density.map_or(1.0, f64::recip),
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
                if distance < -CUT * self.width {
                    return Look::Behind;
                }
                let window = (-0.5 * (distance / self.width).powi(2)).exp();
                let density = (density * self.per_density).clamp(DENSITIES[0], DENSITIES[1]);
                Look::Near { distance, weight: self.confidence * density * window * weight, direction }
            }
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
    Near {
        distance: f64,
        weight: f64,
        direction: DVec3,
    },
}

/// The data term: F = −Σ V(n) c μ w(D) D. All but V is looked up once a voxel and kept.
pub(super) struct Forces<'a> {
    terms: &'a [Term<'a>],
    transform: Transform,
    /// By the origin of a leaf.
    known: Mutex<FxHashMap<IVec3, Arc<LeafForces>>>,
}

/// c μ w(D) D of the voxels of a leaf, by number of the map, of those maps that say anything there.
type LeafForces = Vec<(usize, Box<LeafValues>)>;

impl<'a> Forces<'a> {
    pub fn new(terms: &'a [Term<'a>], transform: Transform) -> Self {
        Self { terms, transform, known: Mutex::default() }
    }

    fn of(&self, origin: IVec3) -> Arc<LeafForces> {
        let known = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(forces) = known().get(&origin) {
            return forces.clone();
        }
        let mut forces = Vec::new();
        for (n, term) in self.terms.iter().enumerate() {
            let mut values = LeafValues::default();
            let mut any = false;
            for (at, value) in values.0.iter_mut().enumerate() {
                let xyz = self.transform.voxel_to_world(origin + offset_to_local(at));
                if let Look::Near { distance, weight, .. } = term.at(xyz) {
                    *value = (weight * distance) as f32;
                    any |= *value != 0.0;
                }
            }
            if any {
                forces.push((n, Box::new(values)));
            }
        }
        let forces = Arc::new(forces);
        known().insert(origin, forces.clone());
        forces
    }
}

impl SurfaceSpeed for Forces<'_> {
    fn of_leaf(&self, leaf: &LeafSurface<'_>, speed: &mut LeafValues) -> Tally {
        let mut tally = Tally::default();
        let forces = self.of(leaf.origin);
        for foot in leaf.feet() {
            let normal = self.transform.direction_to_world(foot.normal).normalize_or_zero();
            let xyz = self.transform.voxel_to_world(leaf.origin + offset_to_local(foot.offset));
            let mut force = 0.0;
            for (n, values) in forces.iter() {
                let value = f64::from(values.0[foot.offset]);
                if value != 0.0 {
                    let facing = (-normal.dot(self.terms[*n].direction(xyz)) / RAMP).clamp(0.0, 1.0);
                    force -= facing * value;
                }
            }
            speed.0[foot.offset] = force as f32;
            if foot.beside {
                tally.count += 1.0;
                tally.squares += force * force;
            }
        }
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
                Around::Behind => votes.behind += 1,
                Around::Mixed => votes.mixed.push(term),
            }
        }
        votes
    }

    /// φ₀ at a point, world units: Σ c μ w D / Σ c μ w where the maps say enough; else outside where a map sees through, inside where none does.
    fn value(&self, xyz: DVec3, background: f64) -> f64 {
        let (mut sum, mut weights) = (0.0, 0.0);
        let Self { mut in_front, mut empty, mut behind, mut surely_empty, .. } = *self;
        for term in &self.mixed {
            match term.at(xyz) {
                // A ray without an answer is a vote, not a proof.
                Look::Unseen => empty += usize::from(term.frames(xyz)),
                Look::Empty => surely_empty = true,
                Look::InFront(weight) => in_front |= weight > 0.0,
                Look::Behind => behind += 1,
                Look::Near { distance, weight, .. } => {
                    sum += weight * distance;
                    weights += weight;
                    in_front |= distance > 0.0 && weight > 0.0;
                }
            }
        }
        if weights > ENOUGH {
            return (sum / weights).clamp(-background, background);
        }
        if in_front || surely_empty || empty > behind { background } else { -background }
    }
}

impl Term<'_> {
    /// The direction of the ray to a point, in the world.
    fn direction(&self, xyz: DVec3) -> DVec3 {
        self.map.pose.transform_vector3(self.map.projection.direction(self.to_scanner.transform_point3(xyz)))
    }

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
    let values_of = |n: usize| {
        let origin = (first + place_of(n)) * LEAF_DIM;
        let mut values = LeafValues::default();
        let half = f64::from(LEAF_DIM - 1) / 2.0;
        let centre = transform.index_to_world(origin.as_dvec3() + half);
        let votes = Votes::new(terms, centre, half * 3f64.sqrt() * transform.voxel_size());
        for (at, value) in values.0.iter_mut().enumerate() {
            let ijk = origin + offset_to_local(at);
            // The box closes what no map does.
            let within = ijk.cmpgt(lo).all() && ijk.cmplt(hi).all();
            *value = match within {
                true => votes.value(transform.voxel_to_world(ijk), f64::from(background)) as f32,
                false => background,
            };
        }
        (origin, values)
    };
    // Whether a leaf is needed: its own sign if it has one.
    let signs: Vec<Option<bool>> = (0..count)
        .into_par_iter()
        .with_min_len(16)
        .map(|n| {
            if run.is_cancelled() {
                return Some(false);
            }
            task.advance(1);
            values_of(n).1.one_sign()
        })
        .collect();
    run.check(NAME)?;
    let sign = |place: IVec3| match place.cmpge(IVec3::ZERO).all() && place.cmplt(size).all() {
        true => signs[((place.x * size.y + place.y) * size.z + place.z) as usize],
        false => Some(false),
    };
    let needed: Vec<usize> = (0..count)
        .filter(|&n| {
            let place = place_of(n);
            let own = sign(place);
            own.is_none() || (0..27).any(|k| sign(place + IVec3::new(k / 9 - 1, k / 3 % 3 - 1, k % 3 - 1)) != own)
        })
        .collect();
    run.reserve(NAME, needed.len() as u64 * 5000, "take a larger voxel_size")?;
    let leaves: Vec<(IVec3, LeafValues)> = needed.par_iter().with_min_len(16).map(|&n| values_of(n)).collect();
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
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    fn root(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    for &[a, b, c] in &mesh.triangles {
        for (v, w) in [(a, b), (b, c)] {
            let (v, w) = (root(&mut parent, v), root(&mut parent, w));
            parent[v.max(w) as usize] = v.min(w);
        }
    }
    let mut place: FxHashMap<u32, usize> = FxHashMap::default();
    let mut pieces: Vec<Vec<[u32; 3]>> = Vec::new();
    for triangle in &mesh.triangles {
        let root = root(&mut parent, triangle[0]);
        let n = *place.entry(root).or_insert_with(|| {
            pieces.push(Vec::new());
            pieces.len() - 1
        });
        pieces[n].push(*triangle);
    }
    pieces
}
