//! Bands as other programs write them: whether one is regular, only needs trimming, or must be rebuilt.
//!
//! A regular band holds |φ| < background in its active voxels and ±background everywhere else. Houdini also makes bands of
//! unequal inner and outer width, grids whose whole interior is active, and backgrounds that are no width of the band.
//! Widths here are in world units unless the name says voxels.

use std::fmt;

use fearless_simd::{Bytes, Select, Simd, SimdBase, SimdMask, i32x16, mask32x16};

use super::bridge::ffi;
use crate::grid::{LEAF_VOXELS, LeafMask, LeafValues};
use crate::stencil::simd::{Lanes, Work, dispatch};

/// A band narrower than this on either side cannot carry a gradient: it must be rebuilt, not trimmed.
const MIN_HALF_WIDTH_VOXELS: f64 = 1.0;

/// Relative difference up to which a width counts as the background: half floats are stored with 2⁻¹¹.
const WIDTH_TOLERANCE: f64 = 1e-3;

/// Smallest and largest of some values; none if `low > high`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// The smallest.
    pub low: f64,
    /// The largest.
    pub high: f64,
}

impl Range {
    const EMPTY: Self = Self { low: f64::INFINITY, high: f64::NEG_INFINITY };

    /// Whether there was no value.
    pub fn is_empty(&self) -> bool {
        self.low > self.high
    }

    fn add(&mut self, value: f64) {
        self.low = self.low.min(value);
        self.high = self.high.max(value);
    }

    fn join(&mut self, other: &Self) {
        self.low = self.low.min(other.low);
        self.high = self.high.max(other.high);
    }
}

/// What [`BandFacts::of_leaf`] measures, two rows at a time.
struct Scan<'a> {
    values: &'a LeafValues,
    mask: LeafMask,
    facts: &'a mut BandFacts,
}

impl Work for Scan<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let splat = |v| Lanes::splat(simd, v);
        let infinity = splat(f32::INFINITY);
        // Of the active voxels, the inactive ones inside, and those outside.
        let mut low = [infinity; 3];
        let mut high = [splat(f32::NEG_INFINITY); 3];
        let mut finite = 0;
        for (pair, values) in self.values.0.as_chunks::<16>().0.iter().enumerate() {
            let v = Lanes::from_slice(simd, values);
            let on = self.mask.0[pair / 4] >> (16 * (pair % 4)) & 0xffff;
            // By the sign bit: a negative zero is inside.
            let negative = v.bitcast::<i32x16<S>>().simd_lt(i32x16::splat(simd, 0)).to_bitmask();
            let sets = [on, !on & negative & 0xffff, !on & !negative & 0xffff];
            for set in 0..3 {
                let counts = mask32x16::from_bitmask(simd, sets[set]);
                // Comparisons with NaN are false: it changes neither end.
                let below = counts.select(v, infinity);
                low[set] = below.simd_lt(low[set]).select(below, low[set]);
                let above = counts.select(v, -infinity);
                high[set] = above.simd_gt(high[set]).select(above, high[set]);
            }
            finite += v.abs().simd_lt(infinity).to_bitmask().count_ones();
        }
        let ranges = [&mut self.facts.active, &mut self.facts.inactive_inside, &mut self.facts.inactive_outside];
        for (set, range) in ranges.into_iter().enumerate() {
            low[set].as_slice().iter().for_each(|v| range.low = range.low.min(f64::from(*v)));
            high[set].as_slice().iter().for_each(|v| range.high = range.high.max(f64::from(*v)));
        }
        self.facts.non_finite = u64::from(LEAF_VOXELS as u32 - finite);
    }
}

/// What was measured of a grid's values as stored, in world units.
#[derive(Clone, Debug, PartialEq)]
pub struct BandFacts {
    /// The stored background.
    pub background: f64,
    /// Active voxels.
    pub active: Range,
    /// Inactive voxels and tiles of negative value.
    pub inactive_inside: Range,
    /// Inactive voxels and tiles of positive value.
    pub inactive_outside: Range,
    /// Number of active tiles.
    pub active_tiles: u64,
    /// Values of active tiles.
    pub active_tile_values: Range,
    /// Voxels that are NaN or infinite.
    pub non_finite: u64,
}

impl BandFacts {
    pub(super) fn new(background: f64) -> Self {
        Self {
            background,
            active: Range::EMPTY,
            inactive_inside: Range::EMPTY,
            inactive_outside: Range::EMPTY,
            active_tiles: 0,
            active_tile_values: Range::EMPTY,
            non_finite: 0,
        }
    }

    pub(super) fn take_tiles(&mut self, leaves: &ffi::Leaves) -> Result<(), cxx::Exception> {
        let (mut low, mut high) = (0.0, 0.0);
        leaves.inactive_tile_range(&mut low, &mut high)?;
        for value in [low, high].into_iter().filter(|v| v.is_finite()) {
            self.add_inactive(value);
        }
        for tile in leaves.tiles()?.iter().filter(|tile| tile.active) {
            self.active_tiles += 1;
            self.active_tile_values.add(f64::from(tile.value));
        }
        Ok(())
    }

    /// With vector instructions: one voxel at a time, this takes longer than reading the leaf.
    pub(super) fn of_leaf(values: &LeafValues, mask: LeafMask) -> Self {
        let mut facts = Self::new(0.0);
        dispatch(Scan { values, mask, facts: &mut facts });
        facts
    }

    fn add_inactive(&mut self, value: f64) {
        if value < 0.0 { self.inactive_inside.add(value) } else { self.inactive_outside.add(value) }
    }

    pub(super) fn join(&mut self, leaf: &Self) {
        self.active.join(&leaf.active);
        self.inactive_inside.join(&leaf.inactive_inside);
        self.inactive_outside.join(&leaf.inactive_outside);
        self.non_finite += leaf.non_finite;
    }

    /// The stored background, or one that can stand for "outside" where that is not a positive number.
    pub(super) fn usable_background(&self, voxel_size: f64) -> f32 {
        let stored = self.background as f32;
        let fallback = (voxel_size as f32).max(f32::MIN_POSITIVE);
        if stored.is_finite() && stored > 0.0 { stored } else { fallback }
    }

    /// Whether some inactive voxel is not exactly ±background.
    pub(super) fn has_odd_inactive(&self, background: f32) -> bool {
        let b = f64::from(background);
        let odd = |range: &Range, value: f64| !range.is_empty() && (range.low != value || range.high != value);
        self.non_finite > 0 || odd(&self.inactive_inside, -b) || odd(&self.inactive_outside, b)
    }
}

/// What must be done to a band to make it regular.
#[derive(Clone, Debug, PartialEq)]
pub enum Band {
    /// Nothing.
    Regular,
    /// Its distances are right but reach farther on one side, or the background is no width of the band: cut both sides to
    /// the smaller of the two.
    Trim {
        /// Width of the band inside.
        inner: f64,
        /// Width of the band outside.
        outer: f64,
    },
    /// It cannot be trimmed: distances must be computed again from the zero set.
    Rebuild {
        /// Why.
        reason: String,
    },
}

impl fmt::Display for Band {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Regular => write!(f, "the band is regular"),
            Self::Trim { inner, outer } => write!(
                f,
                "the band reaches {inner} inside and {outer} outside; it is trimmed to {} on both sides",
                inner.min(*outer)
            ),
            Self::Rebuild { reason } => write!(f, "the band must be rebuilt from the surface: {reason}"),
        }
    }
}

/// Judges a band by what was measured of it.
///
/// The width of a side is that of its inactive voxels if the active ones reach there, else the farthest active value. A side
/// without inactive voxels (a thin solid, or an interior that is active throughout) does not limit the band.
pub fn diagnose_band(facts: &BandFacts, voxel_size: f64) -> Band {
    let rebuild = |reason: String| Band::Rebuild { reason };
    if facts.non_finite > 0 {
        return rebuild(format!("{} voxels are not numbers", facts.non_finite));
    }
    if !(facts.background.is_finite() && facts.background > 0.0) {
        return rebuild(format!("its background is {}; a positive distance is wanted", facts.background));
    }
    if facts.active.is_empty() && facts.active_tiles == 0 && facts.inactive_inside.is_empty() {
        return Band::Regular;
    }
    let outside_value = if facts.inactive_outside.is_empty() { facts.background } else { facts.inactive_outside.low };
    let outer = side(facts.active.high, outside_value, voxel_size);
    let inner = match facts.inactive_inside.is_empty() {
        true => (-facts.active.low).max(facts.background),
        false => side(-facts.active.low, -facts.inactive_inside.high, voxel_size),
    };
    let width = inner.min(outer);
    if facts.active_tiles > 0 {
        let Range { low, high } = facts.active_tile_values;
        if low.abs().min(high.abs()) < width || low * high < 0.0 {
            return rebuild(format!(
                "{} active tiles with values {low} to {high} hold no distances",
                facts.active_tiles
            ));
        }
    }
    if width < MIN_HALF_WIDTH_VOXELS * voxel_size {
        return rebuild(format!(
            "it is {:.2} voxels wide inside and {:.2} outside; at least {MIN_HALF_WIDTH_VOXELS} is needed",
            inner / voxel_size,
            outer / voxel_size
        ));
    }
    let close = |a: f64, b: f64| (a - b).abs() <= WIDTH_TOLERANCE * b.abs();
    let b = facts.background;
    let within = facts.active.is_empty() || (facts.active.low > -b && facts.active.high < b);
    if close(inner, b) && close(outer, b) && facts.active_tiles == 0 && within {
        Band::Regular
    } else {
        Band::Trim { inner, outer }
    }
}

/// Width of one side from the farthest active distance and the distance that its inactive voxels hold: the latter, if the
/// active ones come within a voxel of it.
fn side(active: f64, inactive: f64, voxel_size: f64) -> f64 {
    if active.is_finite() && active < inactive - voxel_size * (1.0 + WIDTH_TOLERANCE) {
        active.max(0.0)
    } else {
        inactive
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn facts(background: f64, active: (f64, f64), inside: Option<f64>) -> BandFacts {
        BandFacts {
            active: Range { low: active.0, high: active.1 },
            inactive_inside: inside.map_or(Range::EMPTY, |v| Range { low: v, high: v }),
            inactive_outside: Range { low: background, high: background },
            ..BandFacts::new(background)
        }
    }

    #[test]
    fn regular_bands_thick_and_thin() {
        assert_eq!(diagnose_band(&facts(0.3, (-0.29, 0.28), Some(-0.3)), 0.1), Band::Regular);
        // A plate thinner than the band has no inactive voxel inside.
        assert_eq!(diagnose_band(&facts(0.3, (-0.12, 0.29), None), 0.1), Band::Regular);
        assert_eq!(diagnose_band(&BandFacts::new(0.3), 0.1), Band::Regular);
    }

    #[test]
    fn unequal_widths_and_filled_interiors_are_trimmed() {
        assert_eq!(diagnose_band(&facts(0.3, (-0.49, 0.29), Some(-0.5)), 0.1), Band::Trim { inner: 0.5, outer: 0.3 });
        assert_eq!(diagnose_band(&facts(0.3, (-7.0, 0.29), None), 0.1), Band::Trim { inner: 7.0, outer: 0.3 });
        // A background far from the band.
        let odd = diagnose_band(&facts(1e6, (-0.29, 0.28), Some(-0.3)), 0.1);
        assert_eq!(odd, Band::Trim { inner: 0.3, outer: 0.28 });
        assert!(odd.to_string().contains("trimmed to 0.28"));
    }

    #[test]
    fn what_cannot_be_trimmed_is_rebuilt() {
        let reason = |f: &BandFacts| match diagnose_band(f, 0.1) {
            Band::Rebuild { reason } => reason,
            other => panic!("{other:?}"),
        };
        assert!(reason(&facts(0.0, (-0.2, 0.2), None)).contains("background is 0"));
        assert!(reason(&facts(0.3, (-0.05, 0.29), Some(-0.06))).contains("voxels wide"));
        let tiles = BandFacts {
            active_tiles: 5,
            active_tile_values: Range { low: 0.0, high: 0.0 },
            ..facts(0.3, (-0.29, 0.29), Some(-0.3))
        };
        assert!(reason(&tiles).contains("5 active tiles"));
        assert!(reason(&BandFacts { non_finite: 2, ..facts(0.3, (-0.29, 0.29), None) }).contains("2 voxels"));
    }
}
