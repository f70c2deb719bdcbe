//! The cells of a patch volume: the exact inverse of its map, folds, and distortion.

use std::collections::BTreeSet;
use std::sync::OnceLock;

use glam::{DMat3, DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};
use serde::Serialize;
use smallvec::SmallVec;

use super::volume::Volume;
use crate::grid::{LEAF_DIM, leaf_origin};

/// Newton steps for the place in a cell, and how near they end, in voxels.
const STEPS: usize = 12;
const NEAR_ENOUGH: f64 = 1e-6;

/// How far the map goes on around the patch, in cells.
const RIM: f64 = 1.5;

/// How far outside a cell, in its own coordinates, a place still counts as in it: cells share their faces.
const SLACK: f64 = 1e-6;

/// A cell on which the map is trilinear.
#[derive(Clone, Debug)]
struct Cell {
    low: DVec3,
    high: DVec3,
    /// Corner x·4 + y·2 + z in (u, v, w).
    corners: [DVec3; 8],
    /// Around the corners, in which all of the cell lies.
    bounds: (DVec3, DVec3),
}

impl Cell {
    /// The place at `t` in 0..1³, and the derivatives by t.
    fn at(&self, t: DVec3) -> (DVec3, DMat3) {
        let c = &self.corners;
        let along_w: [DVec3; 4] = std::array::from_fn(|i| c[2 * i].lerp(c[2 * i + 1], t.z));
        let by_w: [DVec3; 4] = std::array::from_fn(|i| c[2 * i + 1] - c[2 * i]);
        let (low, high) = (along_w[0].lerp(along_w[1], t.y), along_w[2].lerp(along_w[3], t.y));
        let by_v = (along_w[1] - along_w[0]).lerp(along_w[3] - along_w[2], t.x);
        let by_w = by_w[0].lerp(by_w[1], t.y).lerp(by_w[2].lerp(by_w[3], t.y), t.x);
        (low.lerp(high, t.x), DMat3::from_cols(high - low, by_v, by_w))
    }

    /// Where `x` is in the cell, by Newton's iteration from the middle; `None` outside.
    fn find(&self, x: DVec3) -> Option<DVec3> {
        let mut t = DVec3::splat(0.5);
        for _ in 0..STEPS {
            let (p, derivative) = self.at(t);
            let off = x - p;
            if off.length() < NEAR_ENOUGH {
                let inside = t.cmpge(DVec3::splat(-SLACK)).all() && t.cmple(DVec3::splat(1.0 + SLACK)).all();
                return inside.then(|| t.clamp(DVec3::ZERO, DVec3::ONE));
            }
            let step = derivative.inverse() * off;
            if !step.is_finite() {
                return None;
            }
            // A place outside may be far outside: the iteration must not run away on the way to one inside.
            t = (t + step).clamp(DVec3::splat(-1.0), DVec3::splat(2.0));
        }
        None
    }

    /// Whether it lies in 0..1³.
    fn holds_texture(&self) -> bool {
        let slack = DVec3::splat(SLACK);
        self.low.cmpge(-slack).all() && self.high.cmple(1.0 + slack).all()
    }

    fn new(low: DVec3, high: DVec3, corners: [DVec3; 8]) -> Self {
        let bounds = corners.iter().fold((corners[0], corners[0]), |(lo, hi), &c| (lo.min(c), hi.max(c)));
        Self { low, high, corners, bounds }
    }
}

/// The cells of a volume, to be found by place.
pub(super) struct Cells {
    cells: Vec<Cell>,
    /// The sign of the map's determinant where it does not fold.
    sign: f64,
    bin: f64,
    bins: FxHashMap<IVec3, SmallVec<[u32; 4]>>,
    flaws: OnceLock<Flaws>,
}

/// Where the map is not one to one.
struct Flaws {
    /// Cells of the texture whose Jacobian is not positive somewhere, and those whose middle lies in another, earlier one.
    folded: usize,
    overlapping: usize,
    /// Leaves that such cells, or such cells around the texture, may reach into.
    leaves: FxHashSet<IVec3>,
}

impl Cells {
    /// The cells between two layers are those of both nets laid over each other, so that the map is trilinear in each. Around the patch, and above and
    /// under it, there is one more cell, in which the map goes on: so distances to a texture that touches its box are known on both sides.
    pub fn new(volume: &Volume) -> Self {
        let mut cells = Vec::new();
        let n = volume.layers.len();
        for k in 0..=n {
            // The outermost ones continue the map of those beside them.
            let low = k.clamp(1, n - 1) - 1;
            let (below, above) = (&volume.layers[low], &volume.layers[low + 1]);
            let (w0, w1) = (volume.levels[low], volume.levels[low + 1]);
            let w = match k {
                0 => [w0 - (w1 - w0) * RIM, w0],
                k if k == n => [w1, w1 + (w1 - w0) * RIM],
                _ => [w0, w1],
            };
            let at = |u: f64, v: f64, w: f64| below.bilinear(u, v).lerp(above.bilinear(u, v), (w - w0) / (w1 - w0));
            let (us, vs) = (merged(below.counts[0], above.counts[0]), merged(below.counts[1], above.counts[1]));
            for u in us.windows(2) {
                for v in vs.windows(2) {
                    let corners = std::array::from_fn(|c| at(u[c >> 2], v[c >> 1 & 1], w[c & 1]));
                    cells.push(Cell::new(DVec3::new(u[0], v[0], w[0]), DVec3::new(u[1], v[1], w[1]), corners));
                }
            }
        }
        let size = |cell: &Cell| {
            let (lo, hi) = cell.bounds;
            (hi - lo).max_element()
        };
        let bin = (cells.iter().map(size).sum::<f64>() / cells.len().max(1) as f64).max(1e-3);
        let mut bins = FxHashMap::<IVec3, SmallVec<[u32; 4]>>::default();
        for (i, cell) in cells.iter().enumerate() {
            let (lo, hi) = cell.bounds;
            let (lo, hi) = ((lo / bin).floor().as_ivec3(), (hi / bin).floor().as_ivec3());
            for x in lo.x..=hi.x {
                for y in lo.y..=hi.y {
                    for z in lo.z..=hi.z {
                        bins.entry(IVec3::new(x, y, z)).or_default().push(i as u32);
                    }
                }
            }
        }
        Self { cells, sign: if volume.mirrors { -1.0 } else { 1.0 }, bin, bins, flaws: OnceLock::new() }
    }

    /// Looks places up, one after the other.
    pub fn finder(&self) -> Finder<'_> {
        Finder { cells: self, last: 0 }
    }

    /// (u, v, w) of a place in a cell.
    fn in_cell(&self, index: usize, x: DVec3) -> Option<DVec3> {
        let cell = self.cells.get(index)?;
        let (lo, hi) = cell.bounds;
        if x.cmplt(lo - NEAR_ENOUGH).any() || x.cmpgt(hi + NEAR_ENOUGH).any() {
            return None;
        }
        cell.find(x).map(|t| cell.low + (cell.high - cell.low) * t)
    }

    /// The least determinant over the corners of a cell, where a fold shows first; positive where the map does not fold.
    fn least_determinant(&self, cell: &Cell) -> f64 {
        let corner = |c: usize| {
            let t = DVec3::new((c >> 2) as f64, (c >> 1 & 1) as f64, (c & 1) as f64);
            self.sign * cell.at(t).1.determinant()
        };
        (0..8).map(corner).fold(f64::INFINITY, f64::min)
    }

    /// An earlier cell, not beside it, that the middle of a cell lies in as well, one of the texture if there is one: the space above the patch meets itself.
    fn overlapped(&self, i: usize) -> Option<usize> {
        let cell = &self.cells[i];
        let middle = cell.at(DVec3::splat(0.5)).0;
        let others = self.bins.get(&(middle / self.bin).floor().as_ivec3())?;
        let own = (cell.low + cell.high) / 2.0;
        let meets = |&k: &usize| {
            let other = &self.cells[k];
            let away = (own - (other.low + other.high) / 2.0).abs();
            k < i && away.cmpgt((cell.high - cell.low) * 1.5).any() && self.in_cell(k, middle).is_some()
        };
        let mut found = None;
        for k in others.iter().map(|&k| k as usize).filter(meets) {
            found = Some(k);
            if self.cells[k].holds_texture() {
                break;
            }
        }
        found
    }

    fn flaws(&self) -> &Flaws {
        self.flaws.get_or_init(|| {
            let flaw = |(i, cell): (usize, &Cell)| (self.least_determinant(cell) <= 0.0, self.overlapped(i));
            let flaws: Vec<_> = self.cells.par_iter().enumerate().map(flaw).collect();
            let mut all = Flaws { folded: 0, overlapping: 0, leaves: FxHashSet::default() };
            for (cell, (folded, overlapped)) in self.cells.iter().zip(flaws) {
                let other = overlapped.map(|k| &self.cells[k]);
                if folded || other.is_some() {
                    // Cells beside it may lie in others by less than half.
                    for cell in [Some(cell), other].into_iter().flatten() {
                        let (lo, hi) = cell.bounds;
                        all.leaves.extend(leaves_between(lo - (hi - lo), hi + (hi - lo)).map(IVec3::from_array));
                    }
                }
                if cell.holds_texture() {
                    all.folded += usize::from(folded);
                    all.overlapping += usize::from(other.is_some_and(Cell::holds_texture));
                }
            }
            all
        })
    }

    /// Whether the map may fold, or lie in itself, somewhere in a leaf.
    pub fn folds_in(&self, leaf: IVec3) -> bool {
        self.flaws().leaves.contains(&leaf)
    }

    /// (u, v, w) of a place in every cell that holds it.
    pub fn all(&self, x: DVec3) -> impl Iterator<Item = DVec3> + '_ {
        let candidates = self.bins.get(&(x / self.bin).floor().as_ivec3());
        candidates.into_iter().flatten().filter_map(move |&i| self.in_cell(i as usize, x))
    }

    /// First voxels of the leaves that the cells touch, in order.
    pub fn leaves(&self) -> Vec<IVec3> {
        let mut leaves = BTreeSet::new();
        for cell in &self.cells {
            leaves.extend(leaves_between(cell.bounds.0, cell.bounds.1));
        }
        leaves.into_iter().map(IVec3::from_array).collect()
    }

    /// How far a step of a voxel moves in a texture of the given size: in the middle cell by its root mean square over directions, and at most, bounded
    /// by the norm of the inverse's columns.
    pub fn stretch(&self, size: DVec3) -> [f64; 2] {
        let stretch = |cell: &Cell| {
            let (_, by_t) = cell.at(DVec3::splat(0.5));
            let inverse = DMat3::from_diagonal((cell.high - cell.low) * size) * by_t.inverse();
            let columns = [inverse.x_axis, inverse.y_axis, inverse.z_axis];
            columns.iter().map(|c| c.length_squared()).sum::<f64>().sqrt()
        };
        let cells = self.cells.iter().filter(|cell| cell.holds_texture());
        let mut all: Vec<f64> = cells.map(stretch).filter(|s| s.is_finite()).collect();
        all.sort_unstable_by(f64::total_cmp);
        let typical = all.get(all.len() / 2).map_or(1.0, |s| s / 3.0f64.sqrt());
        [typical, all.last().copied().unwrap_or(1.0)]
    }

    /// Distortion of the map over target lengths of the whole edges u, v, w, in voxels.
    pub fn distortion(&self, lengths: DVec3) -> Distortion {
        let mut of_cells = Vec::with_capacity(self.cells.len());
        for cell in self.cells.iter().filter(|cell| cell.holds_texture()) {
            // Derivatives by lengths of the texture instead of by t.
            let unit = (cell.high - cell.low) * lengths;
            let (_, by_t) = cell.at(DVec3::splat(0.5));
            let j = DMat3::from_cols(by_t.x_axis / unit.x, by_t.y_axis / unit.y, by_t.z_axis / unit.z);
            let least = self.least_determinant(cell) / (unit.x * unit.y * unit.z);
            let [s1, s2] = singular_values(j.x_axis, j.y_axis);
            of_cells.push(CellDistortion { angle: s1 / s2, area: s1 * s2, volume: self.sign * j.determinant(), least });
        }
        let Flaws { folded, overlapping, .. } = *self.flaws();
        Distortion { folded, overlapping, ..Distortion::of(&of_cells) }
    }
}

/// A look into the cells that remembers where it found the last place: the next is likely to be there or beside it.
pub(super) struct Finder<'a> {
    cells: &'a Cells,
    last: usize,
}

impl Finder<'_> {
    /// (u, v, w) of a place; `None` outside the volume. Where cells overlap, the one that held the place before, else the lowest one.
    pub fn find(&mut self, x: DVec3) -> Option<DVec3> {
        if let Some(uvw) = self.cells.in_cell(self.last, x) {
            return Some(uvw);
        }
        let candidates = self.cells.bins.get(&(x / self.cells.bin).floor().as_ivec3())?;
        candidates.iter().find_map(|&i| {
            let uvw = self.cells.in_cell(i as usize, x)?;
            self.last = i as usize;
            Some(uvw)
        })
    }
}

/// Singular values s1 ≥ s2 of the matrix of two columns, from the metric.
pub(super) fn singular_values(by_u: DVec3, by_v: DVec3) -> [f64; 2] {
    let (e, f, g) = (by_u.length_squared(), by_u.dot(by_v), by_v.length_squared());
    let (mean, spread) = ((e + g) / 2.0, ((e - g) / 2.0).hypot(f));
    [mean + spread, (mean - spread).max(0.0)].map(f64::sqrt)
}

/// First voxels of the leaves between two places.
fn leaves_between(lo: DVec3, hi: DVec3) -> impl Iterator<Item = [i32; 3]> {
    let (lo, hi) = (leaf_origin(lo.floor().as_ivec3()), leaf_origin(hi.ceil().as_ivec3()));
    let step = LEAF_DIM as usize;
    (lo.x..=hi.x).step_by(step).flat_map(move |x| {
        (lo.y..=hi.y).step_by(step).flat_map(move |y| (lo.z..=hi.z).step_by(step).map(move |z| [x, y, z]))
    })
}

/// Places at which one of two even divisions of 0..1 has a border, and one cell more on both sides.
fn merged(a: usize, b: usize) -> Vec<f64> {
    let rim = RIM / a.max(b) as f64;
    let mut all: Vec<f64> = (0..=a).map(|i| i as f64 / a as f64).chain((0..=b).map(|i| i as f64 / b as f64)).collect();
    all.extend([-rim, 1.0 + rim]);
    all.sort_by(f64::total_cmp);
    all.dedup_by(|a, b| (*a - *b).abs() < 1e-12);
    all
}

struct CellDistortion {
    angle: f64,
    area: f64,
    volume: f64,
    least: f64,
}

/// Mean, 95th percentile and largest value over cells.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let Some(&max) = values.last() else { return Self::default() };
        let p95 = values[((values.len() - 1) as f64 * 0.95).round() as usize];
        Self { mean: values.iter().sum::<f64>() / values.len() as f64, p95, max }
    }
}

/// How the map of a patch distorts, over its cells (Brodersen et al. 2007). Singular values s1 ≥ s2 are those of the derivative by (u, v) in
/// lengths of the texture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Distortion {
    /// s1/s2: 1 keeps angles.
    pub angle: Spread,
    /// Area s1·s2 over its mean, or the inverse where that is larger: 1 keeps ratios of areas.
    pub area: Spread,
    /// Volume over its mean, or the inverse where that is larger.
    pub volume: Spread,
    /// Smallest determinant over the mean one: not positive where the map folds.
    pub least_determinant: f64,
    /// Cells that fold over: their Jacobian is not positive somewhere.
    pub folded: usize,
    /// Cells that lie in others.
    pub overlapping: usize,
    /// Cells in all.
    pub cells: usize,
}

impl Distortion {
    fn of(cells: &[CellDistortion]) -> Self {
        let n = cells.len().max(1) as f64;
        let (area, volume) =
            (cells.iter().map(|c| c.area).sum::<f64>() / n, cells.iter().map(|c| c.volume).sum::<f64>() / n);
        let ratio = |value: f64, mean: f64| if value > mean { value / mean } else { mean / value };
        Self {
            angle: Spread::of(cells.iter().map(|c| c.angle)),
            area: Spread::of(cells.iter().map(|c| ratio(c.area, area))),
            volume: Spread::of(cells.iter().map(|c| ratio(c.volume, volume))),
            least_determinant: cells.iter().map(|c| c.least / volume).fold(f64::INFINITY, f64::min),
            folded: 0,
            overlapping: 0,
            cells: cells.len(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::patch::Net;
    use super::*;

    /// A cylinder shell of 1 rad: radius 10 to 14, length 8 along x.
    fn shell(layers: usize, cells: usize) -> Volume {
        let net = |k: usize| {
            let r = 10.0 + 4.0 * k as f64 / (layers - 1) as f64;
            // More cells further out, as low distortion makes them.
            let nu = cells + k;
            let points = (0..=nu)
                .flat_map(|i| {
                    let a = i as f64 / nu as f64;
                    (0..=4).map(move |j| DVec3::new(2.0 * j as f64, r * a.cos(), r * a.sin()))
                })
                .collect();
            Net { counts: [nu, 4], points }
        };
        let levels = (0..layers).map(|k| k as f64 / (layers - 1) as f64).collect();
        Volume { layers: (0..layers).map(net).collect(), levels, mirrors: false }
    }

    #[test]
    fn the_inverse_is_exact() {
        let volume = shell(3, 7);
        let cells = Cells::new(&volume);
        for i in 0..2000 {
            let uvw = DVec3::new(
                (f64::from(i) * 0.618_033_99).fract(),
                (f64::from(i) * 0.754_877_67).fract(),
                (f64::from(i) * 0.569_840_29).fract(),
            );
            let found = cells.finder().find(volume.at(uvw)).unwrap();
            assert!(volume.at(found).distance(volume.at(uvw)) < 1e-5 && found.distance(uvw) < 1e-5, "{uvw} {found}");
        }
        assert!(cells.finder().find(DVec3::new(4.0, 5.0, 0.0)).is_none());
        assert!(cells.finder().find(DVec3::splat(1e9)).is_none());
    }

    #[test]
    fn distortion_of_a_developable_base() {
        // Lengths of the base: nothing is distorted there; at radius r the stretch along u is r/10.
        let volume = shell(41, 40);
        let distortion = Cells::new(&volume).distortion(DVec3::new(10.0, 8.0, 4.0));
        // s1/s2 at the middle of the outermost cells, whose chords are inscribed.
        assert!((distortion.angle.max - 13.95 / 10.0).abs() < 1e-3, "{distortion:?}");
        // The layers have 40 to 80 cells, and where two layers differ, those of both: r/10 weighted by about r.
        assert!((distortion.angle.mean - 1.211).abs() < 0.02, "{distortion:?}");
        assert_eq!(distortion.folded, 0);
        assert!((0.7..0.9).contains(&distortion.least_determinant), "{distortion:?}");
    }

    #[test]
    fn folds_are_counted() {
        let mut volume = shell(2, 4);
        let n = volume.layers[1].points.len();
        volume.layers[1].points[n / 2] = DVec3::new(4.0, 4.0, 3.0);
        let distortion = Cells::new(&volume).distortion(DVec3::new(10.0, 8.0, 4.0));
        assert!(distortion.folded > 0 && distortion.least_determinant < 0.0);
    }
}
