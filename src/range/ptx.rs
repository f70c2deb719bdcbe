//! PTX: scans of turning heads as text. For each: columns, rows, the scanner's place and axes (not used), a 4x4 matrix to the world by rows of its
//! transpose, then a line `x y z intensity [r g b]` a point, column by column, zeros where nothing was measured.

use std::path::Path;

use glam::{DAffine3, DMat4, DVec3};

use super::files::{name, text};
use super::turning::Scan;
use super::{MOST_PIXELS, RangeSet, check_rigid};
use crate::error::{EditError, Result};

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
        check_rigid(&pose).map_err(|problem| EditError::input(path, format!("scan {scan}: {problem}")))?;
        // Memory for points follows the lines that there are.
        let (mut points, mut colors) = (Vec::new(), Vec::new());
        for _ in 0..columns * rows {
            let line = numbers("a point is")?.ok_or_else(short)?;
            points.push(match line[..] {
                [x, y, z, ..] => Some(DVec3::new(x, y, z)).filter(|p| p.is_finite() && *p != DVec3::ZERO),
                _ => return Err(EditError::input(path, "a point has three numbers or more")),
            });
            if let [_, _, _, _, r, g, b] = line[..] {
                colors.push([r, g, b].map(|c| c.clamp(0.0, 255.0) as u8));
            }
        }
        if colors.len() != points.len() {
            colors.clear();
        }
        let title = format!("{} scan {scan}", name(path));
        match (Scan { name: title.clone(), pose, points, colors }.ordered(columns, rows)) {
            Some((map, warning)) => {
                set.maps.push(map);
                set.warnings.extend(warning);
            }
            None => set.warnings.push(format!("{title}: no point holds a measurement: left out")),
        }
    }
    Ok(set)
}
