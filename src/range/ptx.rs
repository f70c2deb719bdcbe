//! PTX: scans of turning heads as text. For each: columns, rows, the scanner's place and axes (not used), a 4x4 matrix to the world by rows of its
//! transpose, then a line `x y z intensity [r g b]` a point, column by column, zeros where nothing was measured.
//!
//! Azimuths must go evenly with the columns and elevations with the rows, as such heads measure; the fit is checked.

use std::path::Path;

use glam::{DAffine3, DMat4, DVec2, DVec3};

use super::files::{name, text};
use super::{Background, MOST_PIXELS, Projection, RangeMap, RangeSet, is_rigid};
use crate::error::{EditError, Result};

/// Largest mean error of the angles, in pixels, with which they count as even.
const UNEVEN: f64 = 1.0;

pub(super) fn read(path: &Path) -> Result<RangeSet> {
    let mut set = RangeSet::default();
    let Some(text) = text(path)? else {
        set.missing.push(path.into());
        return Ok(set);
    };
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let mut numbers = |wanted: &str| -> Result<Option<Vec<f64>>> {
        let Some((n, line)) = lines.next() else { return Ok(None) };
        let refused = |_| EditError::input(path, format!("line {}: {wanted} wanted, not `{}`", n + 1, line.trim()));
        line.split_whitespace().map(str::parse).collect::<std::result::Result<_, _>>().map(Some).map_err(refused)
    };
    let short = || EditError::input(path, "the file is cut short");
    while let Some(count) = numbers("the number of columns is")? {
        let columns = count.first().copied().unwrap_or(0.0);
        let rows = numbers("the number of rows is")?.and_then(|n| n.first().copied()).ok_or_else(short)?;
        if !(columns >= 2.0 && rows >= 2.0 && columns * rows <= MOST_PIXELS) {
            return Err(EditError::input(path, format!("{columns} columns and {rows} rows are no scan")));
        }
        let (columns, rows) = (columns as usize, rows as usize);
        for _ in 0..4 {
            numbers("a line of three numbers is")?.ok_or_else(short)?;
        }
        let mut matrix = [0.0; 16];
        for line in matrix.chunks_mut(4) {
            match numbers("a line of four numbers is")?.ok_or_else(short)?[..] {
                [a, b, c, d] => line.copy_from_slice(&[a, b, c, d]),
                _ => return Err(EditError::input(path, "a matrix of four lines with four numbers is wanted")),
            }
        }
        // Lines of the file are columns of the matrix.
        let pose = DAffine3::from_mat4(DMat4::from_cols_array(&matrix));
        let scan = set.maps.len() + 1;
        if !is_rigid(&pose) {
            return Err(EditError::input(path, format!("the pose of scan {scan} is not rigid")));
        }
        // Memory for points follows the lines that there are.
        let mut points = Vec::new();
        for _ in 0..columns * rows {
            let line = numbers("a point is")?.ok_or_else(short)?;
            points.push(match line[..] {
                [x, y, z, ..] => Some(DVec3::new(x, y, z)).filter(|p| p.is_finite() && *p != DVec3::ZERO),
                _ => return Err(EditError::input(path, "a point has three numbers or more")),
            });
        }
        let title = format!("{} scan {scan}", name(path));
        match spherical(&points, columns, rows) {
            Some((projection, error)) => {
                if error > UNEVEN {
                    set.warnings
                        .push(format!("{title}: rays are uneven by {error:.1} pixels; distances are as inexact"));
                }
                let ranges = (0..rows * columns).map(|at| {
                    let (row, column) = (at / columns, at % columns);
                    points[column * rows + row].map_or(f32::NAN, |p| p.length() as f32)
                });
                set.maps.push(RangeMap {
                    name: title,
                    projection,
                    pose,
                    width: columns,
                    height: rows,
                    ranges: ranges.collect(),
                    weights: vec![1.0; rows * columns],
                    noise: None,
                    background: Background::Unknown,
                });
            }
            None => set.warnings.push(format!("{title}: no point holds a measurement: left out")),
        }
    }
    Ok(set)
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
