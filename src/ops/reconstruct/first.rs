//! The first surface: where the maps put it voxel by voxel.

use fearless_simd::{Select, Simd, SimdBase};
use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::NAME;
use super::measured::Measurements;
use super::term::{CUT, Sampled, Term, window};
use crate::error::Result;
use crate::grid::{LEAF_DIM, LEAF_VOXELS, LeafMask, LeafValues, offset_to_local};
use crate::levelset::{LevelSet, background, grid_of_parts};
use crate::range::Around;
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch, splat};

/// Sum of weights from which on the maps alone say where the first surface is.
const ENOUGH: f64 = 0.05;

/// What maps say of all voxels of a leaf at once, and the maps that must be asked voxel by voxel.
#[derive(Default)]
struct Votes {
    in_front: bool,
    empty: u32,
    behind: u32,
    surely_empty: bool,
    /// Numbers of maps.
    mixed: Vec<usize>,
}

impl Votes {
    /// Of the voxels around a point, up to `radius` away, in a band of some half width (world units).
    fn new(terms: &[Term], (centre, radius): (DVec3, f64), half_width: f64) -> Self {
        let mut votes = Self::default();
        // What the maps say in whose windows they are.
        let (mut all_in_front, mut all_behind) = (true, true);
        for (number, term) in terms.iter().enumerate() {
            let (cut, is_solid) = (CUT * term.width, term.thickness.is_infinite());
            match term.look_around(centre, radius, half_width) {
                Around::Outside => {}
                Around::Invalid if term.sees_through() => votes.surely_empty = true,
                Around::Invalid => votes.empty += 1,
                Around::Measured(least, _) if least > cut => votes.in_front = true,
                Around::Measured(_, most) if most < -cut && is_solid => votes.behind += 1,
                around => {
                    let [least, most] = match around {
                        Around::Measured(least, most) => [least, most],
                        _ => [f64::NEG_INFINITY, f64::INFINITY],
                    };
                    all_in_front &= least > half_width;
                    all_behind &= most < -half_width && is_solid;
                    votes.mixed.push(number);
                }
            }
        }
        // Where they agree, it does not matter how far the surface is.
        if all_in_front && !votes.mixed.is_empty() {
            votes.in_front = true;
            votes.mixed.clear();
        } else if all_behind && !votes.in_front && !votes.surely_empty {
            votes.behind += votes.mixed.len() as u32;
            votes.mixed.clear();
        }
        votes
    }

    /// Inside is what maps see the surface in front of, and none sees through. What no map has in its picture is outside: it is not closed
    /// off by anything but the end of the pictures.
    fn is_inside(&self) -> bool {
        !self.in_front && !self.surely_empty && self.behind > 0 && self.empty <= self.behind
    }

    /// φ₀ of a leaf, world units: Σ c μ w D / Σ c μ w where the maps say enough; else outside where a map sees through, inside where none does.
    fn values(&self, terms: &[Term], sampled: &[Sampled], background: f32) -> LeafValues {
        let mut values = LeafValues::default();
        dispatch(Estimate { votes: self, terms, sampled, background, values: &mut values });
        values
    }
}

struct Estimate<'a> {
    votes: &'a Votes,
    terms: &'a [Term<'a>],
    sampled: &'a [Sampled],
    background: f32,
    values: &'a mut LeafValues,
}

impl Work for Estimate<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { votes, terms, sampled, background, values } = self;
        let (zero, one, background) = (splat(simd, 0.0), splat(simd, 1.0), Lanes::splat(simd, background));
        for at in (0..LEAF_VOXELS).step_by(16) {
            let (mut sum, mut weights) = (zero, zero);
            let mut outside = splat(simd, f64::from(u8::from(votes.in_front || votes.surely_empty)));
            let (mut empty, mut behind) = (splat(simd, votes.empty.into()), splat(simd, votes.behind.into()));
            for Sampled { map, distance, weight } in sampled {
                let Some(term) = terms.get(*map as usize) else { continue };
                let distance = Lanes::from_slice(simd, &distance.0[at..at + 16]);
                let weight = Lanes::from_slice(simd, &weight.0[at..at + 16]);
                // Neither holds where D is no number.
                let in_front = distance.simd_gt(zero).select(weight.simd_gt(zero).select(one, zero), zero);
                let is_behind = distance.simd_lt(zero).select(one, zero);
                let beyond = distance.simd_lt(splat(simd, -term.thickness)).select(one, zero);
                let unanswered = distance.simd_eq(splat(simd, f64::INFINITY)).select(one, zero);
                behind += is_behind - beyond;
                outside = outside.max(in_front);
                // A ray without an answer is a vote, not a proof.
                match term.sees_through() {
                    true => outside = outside.max(unanswered),
                    false => empty += unanswered,
                }
                empty += beyond;
                let weight = weight * window(simd, distance * splat(simd, 1.0 / term.width));
                let counts = weight.simd_gt(zero);
                sum += counts.select(weight * distance, zero);
                weights += counts.select(weight, zero);
            }
            let enough = weights.simd_gt(splat(simd, ENOUGH));
            let mean = (sum / enough.select(weights, one)).max(-background).min(background);
            let inside = behind.simd_gt(zero).select(behind.simd_ge(empty).select(one - outside, zero), zero);
            let sign = inside.simd_gt(zero).select(-background, background);
            enough.select(mean, sign).store_slice(&mut values.0[at..at + 16]);
        }
    }
}

/// A leaf of the box.
enum Found {
    /// All maps say the same: whether it is inside.
    Whole(bool),
    Split(Box<LeafValues>),
}

impl Found {
    fn sign(&self) -> Option<bool> {
        match self {
            Self::Whole(inside) => Some(*inside),
            Self::Split(values) => values.one_sign(),
        }
    }
}

impl Measurements<'_> {
    /// The zero set of the data term between two voxels, closed by the box. What maps say beside it is kept for the flow.
    pub fn first_surface(&self, half_width: f32, (lo, hi): (IVec3, IVec3), run: &RunOptions) -> Result<LevelSet> {
        let background = background(half_width, &self.transform);
        let (first, last) = (lo.div_euclid(IVec3::splat(LEAF_DIM)), hi.div_euclid(IVec3::splat(LEAF_DIM)));
        let size = last - first + 1;
        let [sx, sy, sz] = size.to_array().map(|n| n.unsigned_abs() as usize);
        let count = sx.saturating_mul(sy).saturating_mul(sz);
        run.reserve(
            NAME,
            (count as u64).saturating_mul((size_of::<Votes>() + size_of::<Found>()) as u64),
            "take a larger voxel_size",
        )?;
        let task = run.task("first estimate", count as u64);
        let place_of = |n: usize| IVec3::new((n / (sy * sz)) as i32, (n / sz % sy) as i32, (n % sz) as i32);
        let origin_of = |n: usize| (first + place_of(n)) * LEAF_DIM;
        // The box closes what no map does.
        let within = |ijk: IVec3| ijk.cmpgt(lo).all() && ijk.cmplt(hi).all();
        let votes: Vec<Votes> = (0..count)
            .into_par_iter()
            .with_min_len(16)
            .map(|n| match run.is_cancelled() {
                true => Votes::default(),
                false => Votes::new(self.terms, self.ball(origin_of(n)), background.into()),
            })
            .collect();
        run.check(NAME)?;
        let is_whole = |n: usize| within(origin_of(n)) && within(origin_of(n) + (LEAF_DIM - 1));
        let split = |n: usize| !votes[n].mixed.is_empty() || votes[n].is_inside() && !is_whole(n);
        let leaves = (0..count).filter(|&n| split(n)).count() as u64;
        run.reserve(NAME, leaves.saturating_mul(5000), "take a larger voxel_size")?;
        let of_leaf = |sampled: &mut Vec<Sampled>, n: usize| {
            task.advance(1);
            if !split(n) || run.is_cancelled() || self.has_failed() {
                return Found::Whole(votes[n].is_inside());
            }
            let origin = origin_of(n);
            sampled.clear();
            for &map in &votes[n].mixed {
                let Some(term) = self.terms.get(map) else { continue };
                let mut more = Sampled::of(map);
                term.sample(origin, &self.transform, &mut more);
                sampled.push(more);
            }
            let mut values = votes[n].values(self.terms, sampled, background);
            if !is_whole(n) {
                let outside = |at: &usize| !within(origin + offset_to_local(*at));
                (0..LEAF_VOXELS).filter(outside).for_each(|at| values.0[at] = background);
            }
            if values.0.iter().any(|value| value.abs() < background) {
                self.complete(origin, sampled);
            }
            Found::Split(Box::new(values))
        };
        let found: Vec<Found> = (0..count).into_par_iter().with_min_len(4).map_init(Vec::new, of_leaf).collect();
        run.check(NAME)?;
        let signs: Vec<Option<bool>> = found.iter().map(Found::sign).collect();
        let sign = |place: IVec3| match place.cmpge(IVec3::ZERO).all() && place.cmplt(size).all() {
            true => signs[((place.x * size.y + place.y) * size.z + place.z) as usize],
            false => Some(false),
        };
        // Leaves of one sign beside those of the other one are wanted as well.
        let needed = |n: &usize| {
            let (place, own) = (place_of(*n), signs[*n]);
            own.is_none() || (0..27).any(|k| sign(place + IVec3::new(k / 9 - 1, k / 3 % 3 - 1, k % 3 - 1)) != own)
        };
        let needed: Vec<usize> = (0..count).filter(needed).collect();
        run.reserve(NAME, needed.len() as u64 * 5000, "take a larger voxel_size")?;
        let of_place = |n: usize| {
            let values = match &found[n] {
                Found::Split(values) => LeafValues::clone(values),
                Found::Whole(true) => LeafValues::filled(-background),
                Found::Whole(false) => LeafValues::filled(background),
            };
            let mut mask = LeafMask::EMPTY;
            for (at, value) in values.0.iter().enumerate() {
                mask.set(at, value.abs() < background);
            }
            (origin_of(n), values, mask)
        };
        let parts = vec![needed.into_par_iter().map(of_place).collect()];
        let grid = grid_of_parts(background, &parts);
        Ok(LevelSet::new(grid, self.transform))
    }
}
