//! Bézier patches (BPT files, as the Utah teapot is passed around) as triangles.
//!
//! A patch of degrees m × n is S(u, v) = Σ Bᵢᵐ(u) Bⱼⁿ(v) pᵢⱼ with the Bernstein polynomials B; it is evaluated by de
//! Casteljau's repeated interpolation, which stays within the control points. The file holds the number of patches, then for
//! each its degrees and (m + 1)(n + 1) points, row by row.

use std::path::Path;

use glam::DVec3;

use super::TriangleMesh;
use crate::error::{EditError, Result};

/// Highest degree that is read: far above any in use, low enough that a damaged number is noticed.
const HIGHEST_DEGREE: usize = 16;

/// Most segments along a patch's edge.
const MOST_SEGMENTS: usize = 256;

/// A surface of tensor-product patches.
#[derive(Clone, Debug, PartialEq)]
pub struct BezierPatches {
    patches: Vec<Patch>,
}

#[derive(Clone, Debug, PartialEq)]
struct Patch {
    columns: usize,
    points: Vec<DVec3>,
}

impl BezierPatches {
    /// Reads a BPT file.
    pub fn read(path: &Path) -> Result<Self> {
        let text =
            std::fs::read_to_string(path).map_err(|e| EditError::input(path, format!("could not be read: {e}")))?;
        Self::parse(&text).map_err(|problem| EditError::input(path, problem))
    }

    fn parse(text: &str) -> Result<Self, String> {
        let words = text.lines().zip(1..).flat_map(|(line, n)| line.split_whitespace().map(move |word| (word, n)));
        let mut words = words.peekable();
        let mut next = |what: &str| words.next().ok_or_else(|| format!("ends early: {what} is missing"));
        let whole = |(word, line): (&str, i32), most: usize| match word.parse::<usize>() {
            Ok(value) if (1..=most).contains(&value) => Ok(value),
            _ => Err(format!("line {line}: `{word}` is no number from 1 to {most}")),
        };
        // A patch takes at least 14 words, so the text bounds their number.
        let count = whole(next("the number of patches")?, text.len())?;
        let mut patches = Vec::new();
        for p in 1..=count {
            let rows = whole(next(&format!("patch {p} of {count}"))?, HIGHEST_DEGREE)? + 1;
            let columns = whole(next(&format!("the second degree of patch {p}"))?, HIGHEST_DEGREE)? + 1;
            let mut points = Vec::with_capacity(rows * columns);
            for k in 1..=rows * columns {
                let mut coordinates = [0.0; 3];
                for c in &mut coordinates {
                    let (word, line) = next(&format!("point {k} of patch {p}"))?;
                    let value = word.parse::<f64>().ok().filter(|v| v.is_finite());
                    *c = value.ok_or_else(|| format!("line {line}: `{word}` is no finite number"))?;
                }
                points.push(DVec3::from(coordinates));
            }
            patches.push(Patch { columns, points });
        }
        match words.next() {
            None => Ok(Self { patches }),
            Some((word, line)) => Err(format!("line {line}: `{word}` comes after the last of {count} patches")),
        }
    }

    /// Box around the control points, which holds the surface.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let points = self.patches.iter().flat_map(|patch| &patch.points);
        points.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(*p), hi.max(*p)))
    }

    /// Triangles whose edges are at most about `edge` long (world units). All patches are cut alike, so that neighbours meet
    /// along the same points.
    pub fn tessellate(&self, edge: f64) -> TriangleMesh {
        let length = |patch: &Patch| {
            let across =
                patch.points.chunks_exact(patch.columns).flat_map(|row| row.windows(2).map(|w| w[0].distance(w[1])));
            let down = patch.points.iter().zip(patch.points.iter().skip(patch.columns)).map(|(a, b)| a.distance(*b));
            let longest = across.chain(down).fold(0.0, f64::max);
            longest * patch.columns.max(patch.points.len() / patch.columns) as f64
        };
        let longest = self.patches.iter().map(length).fold(0.0, f64::max);
        let segments = ((longest / edge).ceil() as usize).clamp(1, MOST_SEGMENTS);
        let mut mesh = TriangleMesh::default();
        for patch in &self.patches {
            let first = mesh.positions.len() as u32;
            let side = segments as u32 + 1;
            for i in 0..=segments {
                let u = i as f64 / segments as f64;
                mesh.positions.extend((0..=segments).map(|j| patch.at(u, j as f64 / segments as f64)));
            }
            for i in 0..segments as u32 {
                for j in 0..segments as u32 {
                    let [a, b, c, d] =
                        [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)].map(|(i, j)| first + i * side + j);
                    mesh.triangles.extend([[a, b, c], [a, c, d]]);
                }
            }
        }
        mesh
    }
}

impl Patch {
    fn at(&self, u: f64, v: f64) -> DVec3 {
        let mut column: Vec<DVec3> =
            self.points.chunks_exact(self.columns).map(|row| casteljau(row.to_vec(), v)).collect();
        casteljau(std::mem::take(&mut column), u)
    }
}

fn casteljau(mut points: Vec<DVec3>, t: f64) -> DVec3 {
    for last in (1..points.len()).rev() {
        for k in 0..last {
            points[k] = points[k].lerp(points[k + 1], t);
        }
    }
    points.first().copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLAT: &str = "1\n1 1\n0 0 0\n0 2 0\n3 0 0\n3 2 0\n";

    #[test]
    fn a_bilinear_patch_is_a_rectangle() {
        let patches = BezierPatches::parse(FLAT).unwrap();
        assert_eq!(patches.bounds(), (DVec3::ZERO, DVec3::new(3.0, 2.0, 0.0)));
        let mesh = patches.tessellate(0.5);
        let area: f64 = (0..mesh.triangles.len())
            .map(|t| mesh.corners(t))
            .map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0)
            .sum();
        assert!((area - 6.0).abs() < 1e-12 && mesh.triangles.len() >= 2 * 6 * 6);
    }

    #[test]
    fn a_cubic_row_is_its_polynomial() {
        // Control points of x³ over [0, 1]: the Bernstein coefficients of a cubic monomial are 0, 0, 0, 1.
        let text = "1 3 1  0 0 0  0 1 0   0.3333333333333333 0 0  0.3333333333333333 1 0 \
                    0.6666666666666666 0 0  0.6666666666666666 1 0   1 0 1  1 1 1";
        let patches = BezierPatches::parse(text).unwrap();
        for k in 0..=10 {
            let u = f64::from(k) / 10.0;
            let p = patches.patches[0].at(u, 0.25);
            assert!((p - DVec3::new(u, 0.25, u.powi(3))).length() < 1e-14);
        }
    }

    #[test]
    fn damaged_files_are_refused_where_they_are_damaged() {
        for (text, part) in [
            ("", "number of patches"),
            ("x", "line 1: `x`"),
            ("0", "`0`"),
            ("99999999999999999999", "is no number"),
            ("2\n1 1\n0 0 0 0 2 0 3 0 0 3 2 0", "patch 2 of 2"),
            ("1\n1 99", "line 2: `99`"),
            ("1\n1 1\n0 0 0 0 2", "point 2 of patch 1"),
            ("1\n1 1\n0 0 0\n0 nan 0", "line 4: `nan`"),
            ("1\n1 1\n0 0 0 0 2 0 3 0 0 3 2 0 7", "after the last"),
        ] {
            let error = BezierPatches::parse(text).unwrap_err();
            assert!(error.contains(part), "{text:?}: {error}");
        }
    }
}
