//! Maps of scanners with a turning head, from the points that they deliver: in columns and rows, or loose.

use glam::{DAffine3, DVec2, DVec3};

use super::{MOST_PIXELS, Projection, RangeMap};

/// Largest mean error of the angles, in pixels, with which they count as even.
const UNEVEN: f64 = 1.0;

/// Pixels of a map of loose points for each of them.
const PIXELS_A_POINT: f64 = 0.5;

/// Points in the frame of the scanner, which is at the origin and turns about z.
pub(super) struct Scan {
    pub name: String,
    /// To the world.
    pub pose: DAffine3,
    pub points: Vec<Option<DVec3>>,
    /// Of each point, or none at all.
    pub colors: Vec<[u8; 3]>,
}

impl Scan {
    /// The map of points column by column, with what is to be said of it; `None` if it holds no measurement. Azimuths must go evenly with the
    /// columns and elevations with the rows, as such heads measure.
    pub fn ordered(self, columns: usize, rows: usize) -> Option<(RangeMap, Option<String>)> {
        let (projection, error) = spherical(&self.points, columns, rows)?;
        let warning = (error > UNEVEN)
            .then(|| format!("{}: rays are uneven by {error:.1} pixels; distances are as inexact", self.name));
        // A map goes row by row.
        let place = |at: usize| at % columns * rows + at / columns;
        let ranges = (0..rows * columns).map(|at| self.points[place(at)].map_or(f32::NAN, |p| p.length() as f32));
        let mut map = RangeMap::new(self.name, projection, self.pose, columns, ranges.collect());
        if !self.colors.is_empty() {
            map.colors = (0..rows * columns).map(|at| self.colors[place(at)]).collect();
        }
        Some((map, warning))
    }

    /// The map of points in any order: each pixel holds the nearest of those within it. `None` without a measurement.
    pub fn loose(self) -> Option<RangeMap> {
        let angles = |p: DVec3| DVec2::new(p.y.atan2(p.x), (p.z / p.length()).clamp(-1.0, 1.0).asin());
        let valid = || self.points.iter().enumerate().filter_map(|(n, p)| p.map(|p| (n, angles(p), p.length())));
        let lo = valid().fold(DVec2::INFINITY, |lo, (_, a, _)| lo.min(a));
        let hi = valid().fold(DVec2::NEG_INFINITY, |hi, (_, a, _)| hi.max(a));
        let wanted = (valid().count() as f64 * PIXELS_A_POINT).clamp(1.0, MOST_PIXELS);
        let size = hi - lo;
        let step = (size.x * size.y / wanted).sqrt();
        if !(step > 0.0 && step.is_finite()) {
            return None;
        }
        // A pixel more on the near side: angles below the first pixel's are those of a turn later.
        let first = lo - step;
        let (columns, rows) = ((size.x / step + 0.5) as usize + 2, (size.y / step + 0.5) as usize + 2);
        let projection = Projection::Spherical { first, step: DVec2::splat(step) };
        let mut ranges = vec![f32::NAN; columns * rows];
        let mut colors = vec![[0; 3]; if self.colors.is_empty() { 0 } else { columns * rows }];
        for (n, angles, range) in valid() {
            let cell = ((angles - first) / step + 0.5).as_usizevec2();
            let at = cell.y.min(rows - 1) * columns + cell.x.min(columns - 1);
            if ranges[at].is_nan() || (range as f32) < ranges[at] {
                ranges[at] = range as f32;
                if let (Some(slot), Some(color)) = (colors.get_mut(at), self.colors.get(n)) {
                    *slot = *color;
                }
            }
        }
        let mut map = RangeMap::new(self.name, projection, self.pose, columns, ranges);
        map.colors = colors;
        Some(map)
    }
}

/// The even angles of a scan, column by column, and how far the rays are from them, in pixels.
fn spherical(points: &[Option<DVec3>], columns: usize, rows: usize) -> Option<(Projection, f64)> {
    let valid = || points.iter().enumerate().filter_map(|(n, p)| p.map(|p| (n / rows, n % rows, p)));
    // Azimuths unrolled from the first one on, the short way round from column to column.
    let mut of_column: Vec<Option<f64>> = vec![None; columns];
    let mut before: Option<f64> = None;
    for (column, slot) in of_column.iter_mut().enumerate() {
        let here = &points[column * rows..(column + 1) * rows];
        // Near the pole azimuths say little: the lowest point counts.
        let lowest = here.iter().flatten().min_by(|a, b| (a.z.abs() / a.length()).total_cmp(&(b.z.abs() / b.length())));
        let Some(p) = lowest else { continue };
        let mut angle = p.y.atan2(p.x);
        if let Some(before) = before {
            let turn = std::f64::consts::TAU;
            angle += turn * ((before - angle) / turn).round();
        }
        (*slot, before) = (Some(angle), Some(angle));
    }
    let azimuth = line(of_column.iter().enumerate().filter_map(|(n, a)| a.map(|a| (n as f64, a))))?;
    let elevation = line(valid().map(|(_, row, p)| (row as f64, (p.z / p.length()).asin())))?;
    let projection =
        Projection::Spherical { first: DVec2::new(azimuth.0, elevation.0), step: DVec2::new(azimuth.1, elevation.1) };
    if azimuth.1 == 0.0 || elevation.1 == 0.0 {
        return None;
    }
    let (mut sum, mut count) = (0.0, 0.0);
    for (column, row, p) in valid() {
        if let Some((pixel, _)) = projection.project(p) {
            sum += (pixel - DVec2::new(column as f64, row as f64)).abs().max_element();
            count += 1.0;
        }
    }
    Some((projection, sum / f64::max(count, 1.0)))
}

/// The line y = a + b x nearest to points.
fn line(points: impl Iterator<Item = (f64, f64)>) -> Option<(f64, f64)> {
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (x, y) in points {
        (n, sx, sy, sxx, sxy) = (n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y);
    }
    let determinant: f64 = n * sxx - sx * sx;
    (determinant > 0.0).then(|| {
        let b = (n * sxy - sx * sy) / determinant;
        ((sy - b * sx) / n, b)
    })
}
