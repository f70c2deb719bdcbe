//! What range maps say of the voxels of leaves, looked up once and kept.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::NAME;
use super::term::{Sampled, Term};
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, Transform};
use crate::range::Around;
use crate::run::RunOptions;

/// What a set of maps says, leaf by leaf.
pub(super) struct Measurements<'a> {
    pub terms: &'a [Term<'a>],
    pub transform: Transform,
    /// Half width of the band in world units.
    half_width: f64,
    run: &'a RunOptions,
    /// By the origin of a leaf.
    known: Mutex<FxHashMap<IVec3, Arc<Measured>>>,
    bytes: AtomicU64,
    /// What was in use before.
    in_use: u64,
    failure: OnceLock<EditError>,
}

/// What maps say at the voxels of a leaf, pair of rows by pair of rows, in the order of the maps.
pub(super) struct Measured {
    pub maps: Vec<OfMap>,
    /// Where a pair begins, and where the last one ends.
    first: [u32; 33],
    heads: Vec<Head>,
    rows: Vec<RowPair>,
}

/// A map that says something of a leaf.
pub(super) struct OfMap {
    /// Its number.
    pub number: u32,
    /// What a unit of the rows is worth: world units of D, and of c μ.
    pub units: [f32; 2],
}

/// Of what a map says at two rows, so that these need not be read.
#[derive(Clone, Copy)]
pub(super) struct Head {
    /// Its place in the leaf's list.
    pub map: u32,
    /// Smallest |D| of a measurement, world units.
    pub nearest: f32,
}

/// What a map says at two rows: a line of memory, since reading it is most of the work. D is exact to a 65,000th of the map's reach.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(super) struct RowPair {
    /// D in units, at most the reach.
    pub distance: [i16; 16],
    /// c μ in units; 0 where it says nothing.
    pub weight: [u16; 16],
}

impl RowPair {
    fn new(distance: &[f32], weight: &[f32], units: [f32; 2]) -> Self {
        const MOST: f32 = i16::MAX as f32;
        // To the nearest whole number by cutting off positive ones. What is no number has no weight.
        let whole = |d: f32| ((d / units[0]).min(MOST) + (MOST + 0.5)) as u16;
        Self {
            distance: std::array::from_fn(|k| (i32::from(whole(distance[k])) - i32::from(i16::MAX)) as i16),
            weight: std::array::from_fn(|k| (weight[k] / units[1] + 0.5) as u16),
        }
    }
}

impl Measured {
    /// Of samples, without what is farther than the maps' reach.
    fn new(sampled: &[Sampled], terms: &[Term], half_width: f64) -> Self {
        let mut measured = Self { maps: Vec::new(), first: [0; 33], heads: Vec::new(), rows: Vec::new() };
        let known: Vec<(&Sampled, f32, [f32; 2])> = sampled
            .iter()
            .filter_map(|sampled| {
                let term = terms.get(sampled.map as usize)?;
                let reach = term.reach(half_width);
                // A little more, so that what ends at the reach stays beyond the window.
                let units = [1.001 * reach / f64::from(i16::MAX), term.heaviest() / f64::from(u16::MAX)];
                Some((sampled, reach as f32, units.map(|unit| unit as f32)))
            })
            .collect();
        for pair in 0..32 {
            let range = 16 * pair..16 * pair + 16;
            for (Sampled { map, distance, weight }, reach, units) in &known {
                let (distance, weight) = (&distance.0[range.clone()], &weight.0[range.clone()]);
                let of_voxel = |(d, w): (&f32, &f32)| if *w > 0.0 { d.abs() } else { f32::INFINITY };
                let nearest = distance.iter().zip(weight).map(of_voxel).fold(f32::INFINITY, f32::min);
                if nearest >= *reach {
                    continue;
                }
                let place = measured.maps.iter().position(|m| m.number == *map).unwrap_or_else(|| {
                    measured.maps.push(OfMap { number: *map, units: *units });
                    measured.maps.len() - 1
                });
                measured.heads.push(Head { map: place as u32, nearest });
                measured.rows.push(RowPair::new(distance, weight, *units));
            }
            measured.first[pair + 1] = measured.rows.len() as u32;
        }
        measured
    }

    /// What maps say at a pair of rows.
    #[inline(always)]
    pub fn pair(&self, pair: usize) -> impl Iterator<Item = (Head, &RowPair)> {
        let range = self.first[pair] as usize..self.first[pair + 1] as usize;
        self.heads[range.clone()].iter().copied().zip(&self.rows[range])
    }

    fn bytes(&self) -> u64 {
        (self.rows.len() * (size_of::<RowPair>() + size_of::<Head>()) + size_of::<Self>()) as u64
    }
}

impl<'a> Measurements<'a> {
    pub fn new(terms: &'a [Term<'a>], transform: Transform, half_width: f64, run: &'a RunOptions) -> Self {
        Self {
            terms,
            transform,
            half_width,
            run,
            known: Mutex::default(),
            bytes: AtomicU64::new(0),
            in_use: run.memory_in_use(),
            failure: OnceLock::new(),
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

    /// Middle of a leaf in the world, and how far its voxels are from there.
    pub fn ball(&self, origin: IVec3) -> (DVec3, f64) {
        let half = f64::from(LEAF_DIM - 1) / 2.0;
        (self.transform.index_to_world(origin.as_dvec3() + half), half * 3f64.sqrt() * self.transform.voxel_size())
    }

    /// What all maps say of a leaf of the band; nothing once something went wrong.
    pub fn of(&self, origin: IVec3) -> Option<Arc<Measured>> {
        let known = self.lock().get(&origin).cloned();
        known.or_else(|| self.complete(origin, &mut Vec::new()))
    }

    /// Looks up what the other maps say of a leaf as well, and keeps it. `sampled` is what some do.
    pub fn complete(&self, origin: IVec3, sampled: &mut Vec<Sampled>) -> Option<Arc<Measured>> {
        let asked: Vec<u32> = sampled.iter().map(|sampled| sampled.map).collect();
        let (centre, radius) = self.ball(origin);
        for (number, term) in self.terms.iter().enumerate().filter(|(n, _)| !asked.contains(&(*n as u32))) {
            let reach = term.reach(self.half_width);
            let matters = match term.look_around(centre, radius, self.half_width) {
                Around::Outside | Around::Invalid => false,
                Around::Measured(least, most) => least <= reach && most >= -reach,
                Around::Mixed => true,
            };
            if matters {
                let mut more = Sampled::of(number);
                term.sample(origin, &self.transform, &mut more);
                sampled.push(more);
            }
        }
        sampled.sort_by_key(|sampled| sampled.map);
        let measured = Measured::new(sampled, self.terms, self.half_width);
        let total = measured.bytes() + self.bytes.fetch_add(measured.bytes(), Ordering::Relaxed);
        if let Err(error) = self.run.reserve_since(self.in_use, NAME, total, "take a larger voxel_size") {
            let _ = self.failure.set(error);
            return None;
        }
        let measured = Arc::new(measured);
        self.lock().insert(origin, measured.clone());
        Some(measured)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, FxHashMap<IVec3, Arc<Measured>>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
