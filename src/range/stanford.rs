//! Scans of the Stanford repository: PLY files with a grid of points (`range_grid`), and `.conf` lists of their poses.
//!
//! A line `bmesh file tx ty tz qx qy qz qw` places a scan: p_world = R(q)ᵀ p + t. The scanner moves along x and looks along −z, in a fan along y. In the scans of
//! the bunny the rows of a grid keep x to 0.13 mm, the width of their interlacing, and y goes with z by 0.014 to 0.083: a fan from 1.2 m away, whose rays are
//! up to 5 degrees off the axis. It is taken for parallel: points are drawn where they were measured, and the rays only say from where a point was
//! seen and how far from it a voxel is. Both matter near the surface alone, where a distance along a ray errs by less than 0.4 %.

use std::path::Path;

use glam::{DAffine3, DQuat, DVec3};

use super::files::{beside, bytes, name, text};
use super::{RangeMap, RangeSet, draw_parallel, rigid};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

/// Points are joined over at most so many pixels.
const LONGEST: f64 = 6.0;

pub(super) fn read_conf(path: &Path, run: &RunOptions) -> Result<RangeSet> {
    let Some(text) = text(path)? else { return Err(EditError::input(path, "cannot be opened: there is no such file")) };
    let mut set = RangeSet::default();
    for (n, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace();
        if words.next() != Some("bmesh") {
            continue;
        }
        let place = |problem: &str| EditError::input(path, format!("line {}: {problem}", n + 1));
        let file = words.next().ok_or_else(|| place("the name of a scan is wanted"))?;
        let numbers: Vec<f64> = words.map_while(|word| word.parse().ok()).collect();
        let &[x, y, z, a, b, c, d] = &numbers[..] else {
            return Err(place("seven numbers are wanted, a translation and a quaternion"));
        };
        // The file's quaternions turn the other way.
        let turn = DQuat::from_xyzw(a, b, c, d).conjugate();
        let pose = rigid(turn, DVec3::new(x, y, z)).map_err(|problem| place(&problem))?;
        let scan = beside(path, file);
        match read_scan(&scan, pose, run)? {
            Some(map) => set.maps.push(map),
            None => set.missing.push(scan),
        }
    }
    if set.maps.is_empty() && set.missing.is_empty() {
        return Err(EditError::input(path, "lists no scan: lines `bmesh file tx ty tz qx qy qz qw` are wanted"));
    }
    Ok(set)
}

/// A scan; `None` if there is no such file.
pub(super) fn read_scan(path: &Path, pose: DAffine3, run: &RunOptions) -> Result<Option<RangeMap>> {
    run.check("reading")?;
    let Some(bytes) = bytes(path)? else { return Ok(None) };
    let Grid { points, columns } = grid(&bytes).map_err(|problem| EditError::input(path, problem))?;
    let parallel = super::Projection::Orthographic { first: glam::DVec2::ZERO, pitch: glam::DVec2::ONE };
    let empty = RangeMap::new(name(path), parallel, pose, 1, vec![f32::NAN]);
    let Some(pitch) = pitch(&points, columns) else { return Ok(Some(empty)) };
    let drawn = draw_parallel(&points, columns, pitch, LONGEST * pitch)
        .ok_or_else(|| EditError::input(path, "its points are spread too far for their distances"))?;
    let (projection, width, _, ranges) = drawn;
    Ok(Some(RangeMap::new(name(path), projection, pose, width, ranges)))
}

/// Median distance of neighbours, seen along z.
fn pitch(points: &[Option<DVec3>], columns: usize) -> Option<f64> {
    let mut distances: Vec<f64> = points
        .chunks(columns)
        .flat_map(|row| row.windows(2))
        .filter_map(|pair| Some((pair[1]? - pair[0]?).truncate().length()))
        .filter(|d| *d > 0.0)
        .collect();
    let middle = distances.len() / 2;
    (!distances.is_empty()).then(|| *distances.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Points row by row.
struct Grid {
    points: Vec<Option<DVec3>>,
    columns: usize,
}

/// How numbers are stored.
#[derive(Clone, Copy, PartialEq)]
enum Coding {
    Text,
    Little,
    Big,
}

/// The numbers of a PLY body, one after the other.
struct Numbers<'a> {
    rest: &'a [u8],
    coding: Coding,
}

impl Numbers<'_> {
    fn next(&mut self, kind: &str) -> Result<f64, String> {
        const SHORT: &str = "the file is cut short";
        if self.coding == Coding::Text {
            let start = self.rest.iter().position(|b| !b.is_ascii_whitespace()).ok_or(SHORT)?;
            let rest = &self.rest[start..];
            let end = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
            self.rest = &rest[end..];
            let word = std::str::from_utf8(&rest[..end]).unwrap_or_default();
            return word.parse().map_err(|_| format!("`{word}` is not a number"));
        }
        let size = match kind {
            "char" | "uchar" | "int8" | "uint8" => 1,
            "short" | "ushort" | "int16" | "uint16" => 2,
            "int" | "uint" | "float" | "int32" | "uint32" | "float32" => 4,
            "double" | "float64" => 8,
            _ => return Err(format!("properties of the kind `{kind}` are unknown")),
        };
        let (own, rest) = self.rest.split_at_checked(size).ok_or(SHORT)?;
        self.rest = rest;
        let mut bytes = [0u8; 8];
        bytes[..size].copy_from_slice(own);
        if self.coding == Coding::Big {
            bytes[..size].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match kind {
            "char" | "int8" => f64::from(a as i8),
            "uchar" | "uint8" => f64::from(a),
            "short" | "int16" => f64::from(i16::from_le_bytes([a, b])),
            "ushort" | "uint16" => f64::from(u16::from_le_bytes([a, b])),
            "int" | "int32" => f64::from(i32::from_le_bytes([a, b, c, d])),
            "uint" | "uint32" => f64::from(u32::from_le_bytes([a, b, c, d])),
            "float" | "float32" => f64::from(f32::from_le_bytes([a, b, c, d])),
            _ => f64::from_le_bytes(bytes),
        })
    }
}

/// A property: the kinds of a list's length and entries, or of a number, and its name.
enum Property<'a> {
    Number(&'a str, &'a str),
    List(&'a str, &'a str),
}

/// The grid of points of a PLY file.
fn grid(bytes: &[u8]) -> Result<Grid, String> {
    const END: &[u8] = b"end_header";
    let end = bytes.windows(END.len()).position(|w| w == END).ok_or("is no PLY file: it has no `end_header`")?;
    let header = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let body = &bytes[end + END.len()..];
    let line_end = body.iter().position(|b| *b == b'\n').ok_or("the file is cut short")?;
    let (mut coding, mut columns, mut rows) = (None, None, None);
    let mut elements: Vec<(&str, usize, Vec<Property>)> = Vec::new();
    for line in header.lines() {
        match line.split_whitespace().collect::<Vec<_>>()[..] {
            ["format", "ascii", _] => coding = Some(Coding::Text),
            ["format", "binary_little_endian", _] => coding = Some(Coding::Little),
            ["format", "binary_big_endian", _] => coding = Some(Coding::Big),
            ["obj_info", "num_cols", n] => columns = n.parse::<usize>().ok(),
            ["obj_info", "num_rows", n] => rows = n.parse::<usize>().ok(),
            ["element", name, n] => {
                elements.push((name, n.parse().map_err(|_| format!("`{n}` is no number of {name}"))?, Vec::new()));
            }
            ["property", "list", length, entry, _] => {
                elements.last_mut().ok_or("a property before an element")?.2.push(Property::List(length, entry));
            }
            ["property", kind, name] => {
                elements.last_mut().ok_or("a property before an element")?.2.push(Property::Number(kind, name));
            }
            _ => {}
        }
    }
    let mut numbers = Numbers { rest: &body[line_end + 1..], coding: coding.ok_or("the header names no format")? };
    let (mut vertices, mut cells) = (Vec::new(), Vec::new());
    for (name, count, properties) in elements {
        for _ in 0..count {
            let mut point = [f64::NAN; 3];
            let mut first = None;
            for property in &properties {
                match property {
                    Property::Number(kind, of) => {
                        let value = numbers.next(kind)?;
                        if let Some(axis) = ["x", "y", "z"].iter().position(|a| a == of) {
                            point[axis] = value;
                        }
                    }
                    Property::List(length, entry) => {
                        let length = numbers.next(length)?;
                        for _ in 0..length as u32 {
                            let value = numbers.next(entry)?;
                            first.get_or_insert(value);
                        }
                    }
                }
            }
            match name {
                "vertex" => vertices.push(DVec3::from_array(point)),
                "range_grid" => cells.push(first),
                _ => {}
            }
        }
    }
    let (Some(columns), Some(rows)) = (columns, rows) else {
        return Err("is no range scan: `obj_info num_cols` and `num_rows` are missing".into());
    };
    if columns == 0 || columns.checked_mul(rows) != Some(cells.len()) {
        return Err(format!("its range grid has {} cells, not {columns} x {rows}", cells.len()));
    }
    let points = cells.into_iter().map(|cell| match cell {
        None => Ok(None),
        Some(index) => match vertices.get(index as usize).filter(|_| index >= 0.0) {
            Some(point) => Ok(Some(*point).filter(|p| p.is_finite())),
            None => Err(format!("its range grid names vertex {index} of {}", vertices.len())),
        },
    });
    Ok(Grid { points: points.collect::<Result<_, String>>()?, columns })
}
