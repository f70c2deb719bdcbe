//! Bézier patches as triangles: BPT files, as the Utah teapot is passed around, and what NURBS surfaces are made of.
//!
//! A patch of degrees m × n is S(u, v) = Σ Bᵢᵐ(u) Bⱼⁿ(v) pᵢⱼ with the Bernstein polynomials B; it is evaluated by de
//! Casteljau's repeated interpolation, which stays within the control points. Points are homogeneous, (w x, w y, w z, w), so that
//! rational patches need no case of their own. A BPT file holds the number of patches, then for each its degrees and
//! (m + 1)(n + 1) points, row by row; their weights are 1.
//!
//! **Tessellation.** A linear interpolation over triangles whose corners are 1/a apart in u and 1/b in v is off by at most
//! (M₁/a² + 2 M₂/(a b) + M₃/b²)/8, where M₁ = m(m − 1) max|Δ²ᵤp|, M₂ = m n max|ΔᵤΔᵥp| and M₃ = n(n − 1) max|Δ²ᵥp| bound the second
//! derivatives by those of the control net (Filip, Magedson, Markot 1986). a and b are chosen for each patch. Along an edge there are
//! as many segments as the finer of the two patches that share it wants, at the same points bit for bit: there are no cracks.
//! A patch's own points stay inside, and a strip of triangles joins them to the edge.

use std::path::Path;

use glam::{DVec3, DVec4};
use rustc_hash::FxHashMap;

use super::TriangleMesh;
use crate::error::{EditError, Result};
use crate::run::RunOptions;

/// Highest degree that is read: far above any in use, low enough that a damaged number is noticed.
pub(super) const HIGHEST_DEGREE: usize = 16;

/// Most segments along a patch's edge: one that needs more is far from what its file meant.
const MOST_SEGMENTS: f64 = 4096.0;

/// What the triangles of a strip may be off by, as a multiple of the bound for those inside: they lean, by up to a segment, and are
/// no right triangles (4/3 for the circle around them, 4 for the width).
const STRIP: f64 = 16.0 / 3.0;

/// A surface of tensor-product patches.
#[derive(Clone, Debug, PartialEq)]
pub struct BezierPatches {
    patches: Vec<Patch>,
}

/// A patch: rows of `columns` homogeneous control points with positive weights.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Patch {
    pub columns: usize,
    pub points: Vec<DVec4>,
}

impl BezierPatches {
    pub(super) fn new(patches: Vec<Patch>) -> Self {
        Self { patches }
    }

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
                points.push(DVec3::from(coordinates).extend(1.0));
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
        points.map(|p| projected(*p)).fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)))
    }

    /// Triangles within `tolerance` (world units) of the surface, without cracks between patches that share an edge.
    pub fn tessellate(&self, tolerance: f64, run: &RunOptions) -> Result<TriangleMesh> {
        let segments: Vec<[f64; 2]> = self.patches.iter().map(|patch| patch.segments(tolerance / STRIP)).collect();
        if let Some(most) = segments.iter().flatten().copied().find(|n| !(*n <= MOST_SEGMENTS)) {
            let accepted =
                format!("a tolerance that {MOST_SEGMENTS} segments along a patch reach; this one needs {most}");
            return Err(EditError::parameter("tessellate", "tolerance", tolerance, accepted));
        }
        let quads: f64 = segments.iter().map(|[a, b]| (a + 1.0) * (b + 1.0)).sum();
        // A position and two triangles a quad, and a strip along the edges.
        run.reserve("tessellate", (quads * 96.0) as u64, "take a larger voxel size")?;
        let mut edges: FxHashMap<Vec<[u64; 4]>, usize> = FxHashMap::default();
        for (patch, counts) in self.patches.iter().zip(&segments) {
            for side in Side::ALL {
                let count = edges.entry(key(&patch.edge(side))).or_default();
                *count = (*count).max(counts[side.axis()] as usize);
            }
        }
        let mut mesh = TriangleMesh::default();
        for (patch, [a, b]) in self.patches.iter().zip(&segments) {
            run.check("tessellate")?;
            patch.tessellate([*a as usize, *b as usize], |edge| edges.get(&key(edge)).copied().unwrap_or(1), &mut mesh);
        }
        // Where an edge is a single point, triangles have no area.
        let TriangleMesh { positions, triangles, .. } = &mut mesh;
        triangles.retain(|t| {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            a != b && b != c && c != a
        });
        Ok(mesh)
    }
}

/// An edge of a patch: v = 0, v = 1 (both along u), u = 0, u = 1 (along v).
#[derive(Clone, Copy, Debug)]
enum Side {
    Left,
    Right,
    First,
    Last,
}

impl Side {
    const ALL: [Self; 4] = [Self::Left, Self::Right, Self::First, Self::Last];

    /// The parameter that runs along it: 0 is u, 1 is v.
    fn axis(self) -> usize {
        match self {
            Self::Left | Self::Right => 0,
            Self::First | Self::Last => 1,
        }
    }
}

/// Control points of an edge as bits, the same from both sides.
fn key(edge: &[DVec4]) -> Vec<[u64; 4]> {
    let bits = |p: &DVec4| p.to_array().map(|v| (v + 0.0).to_bits());
    let forwards: Vec<_> = edge.iter().map(bits).collect();
    let backwards: Vec<_> = edge.iter().rev().map(bits).collect();
    forwards.min(backwards)
}

/// The `count` + 1 points of an edge curve, in its direction; the same bits from both sides.
fn edge_points(edge: &[DVec4], count: usize) -> Vec<DVec3> {
    let bits = |p: &DVec4| p.to_array().map(|v| (v + 0.0).to_bits());
    let turned = edge.iter().map(bits).gt(edge.iter().rev().map(bits));
    let curve: Vec<DVec4> = if turned { edge.iter().rev().copied().collect() } else { edge.to_vec() };
    let mut points: Vec<DVec3> =
        (0..=count).map(|k| projected(casteljau(curve.clone(), k as f64 / count as f64))).collect();
    if turned {
        points.reverse();
    }
    points
}

fn projected(p: DVec4) -> DVec3 {
    p.truncate() / p.w
}

impl Patch {
    fn rows(&self) -> usize {
        self.points.len() / self.columns
    }

    fn point(&self, i: usize, j: usize) -> DVec4 {
        self.points[i * self.columns + j]
    }

    fn at(&self, u: f64, v: f64) -> DVec3 {
        let column: Vec<DVec4> = self.points.chunks_exact(self.columns).map(|row| casteljau(row.to_vec(), v)).collect();
        projected(casteljau(column, u))
    }

    fn edge(&self, side: Side) -> Vec<DVec4> {
        let (rows, columns) = (self.rows(), self.columns);
        match side {
            Side::Left => (0..rows).map(|i| self.point(i, 0)).collect(),
            Side::Right => (0..rows).map(|i| self.point(i, columns - 1)).collect(),
            Side::First => (0..columns).map(|j| self.point(0, j)).collect(),
            Side::Last => (0..columns).map(|j| self.point(rows - 1, j)).collect(),
        }
    }

    /// Segments in u and v for which right triangles are within `tolerance`: whole numbers, maybe too large to be used.
    ///
    /// For a rational patch P/w, interpolating P and w linearly gives points of the triangle again, and
    /// |S − L| ≤ (|δP| + |S| |δw|)/w, with S measured from the patch's centre.
    fn segments(&self, tolerance: f64) -> [f64; 2] {
        let (rows, columns) = (self.rows(), self.columns);
        let centre = self.points.iter().map(|p| projected(*p)).sum::<DVec3>() / self.points.len() as f64;
        let radius = self.points.iter().map(|p| projected(*p).distance(centre)).fold(0.0, f64::max);
        let weight = self.points.iter().map(|p| p.w).fold(f64::INFINITY, f64::min);
        let size = |d: DVec4| ((d.truncate() - centre * d.w).length() + radius * d.w.abs()) / weight;
        let p = |i, j| self.point(i, j);
        let most = |values: &mut dyn Iterator<Item = DVec4>| values.map(size).fold(0.0, f64::max);
        let all = |rows: usize, columns: usize| (0..rows).flat_map(move |i| (0..columns).map(move |j| (i, j)));
        let along_u =
            most(&mut all(rows.saturating_sub(2), columns).map(|(i, j)| p(i + 2, j) - p(i + 1, j) * 2.0 + p(i, j)));
        let along_v =
            most(&mut all(rows, columns.saturating_sub(2)).map(|(i, j)| p(i, j + 2) - p(i, j + 1) * 2.0 + p(i, j)));
        let mixed = most(
            &mut all(rows - 1, columns - 1).map(|(i, j)| (p(i + 1, j + 1) - p(i + 1, j)) - (p(i, j + 1) - p(i, j))),
        );
        let (m, n) = ((rows - 1) as f64, (columns - 1) as f64);
        let (m1, m2, m3) = (m * (m - 1.0) * along_u, m * n * mixed, n * (n - 1.0) * along_v);
        // A third of the tolerance for each of the three terms.
        let (mut a, mut b) =
            ((3.0 * m1 / (8.0 * tolerance)).sqrt().max(1.0), (3.0 * m3 / (8.0 * tolerance)).sqrt().max(1.0));
        let wanted = 6.0 * m2 / (8.0 * tolerance);
        if a * b < wanted {
            let factor = (wanted / (a * b)).sqrt();
            (a, b) = (a * factor, b * factor);
        }
        // At least two, so that there is an inside.
        [a.ceil().max(2.0), b.ceil().max(2.0)]
    }

    /// Adds the patch with `a` × `b` segments inside and as many along each edge as `count` says of its control points.
    fn tessellate(&self, [a, b]: [usize; 2], count: impl Fn(&[DVec4]) -> usize, mesh: &mut TriangleMesh) {
        let first = mesh.positions.len() as u32;
        let inner = |i: usize, j: usize| first + ((i - 1) * (b - 1) + j - 1) as u32;
        for i in 1..a {
            mesh.positions.extend((1..b).map(|j| self.at(i as f64 / a as f64, j as f64 / b as f64)));
        }
        for i in 1..a - 1 {
            for j in 1..b - 1 {
                let [p, q, r, s] = [inner(i, j), inner(i + 1, j), inner(i + 1, j + 1), inner(i, j + 1)];
                mesh.triangles.extend([[p, q, r], [p, r, s]]);
            }
        }
        for side in Side::ALL {
            let edge = self.edge(side);
            let points = edge_points(&edge, count(&edge));
            let start = mesh.positions.len() as u32;
            let outer: Vec<(f64, u32)> =
                (0..points.len()).map(|k| (k as f64 / (points.len() - 1) as f64, start + k as u32)).collect();
            mesh.positions.extend(points);
            let along = |n: usize, at: &dyn Fn(usize) -> u32| -> Vec<(f64, u32)> {
                (1..n).map(|k| (k as f64 / n as f64, at(k))).collect()
            };
            // The winding of a strip between an edge and the row inside of it depends on the side.
            let (row, turned) = match side {
                Side::Left => (along(a, &|i| inner(i, 1)), false),
                Side::Right => (along(a, &|i| inner(i, b - 1)), true),
                Side::First => (along(b, &|j| inner(1, j)), true),
                Side::Last => (along(b, &|j| inner(a - 1, j)), false),
            };
            strip(&outer, &row, turned, &mut mesh.triangles);
        }
    }
}

/// Triangles between two rows of vertices with their parameters, from end to end.
fn strip(outer: &[(f64, u32)], inner: &[(f64, u32)], turned: bool, triangles: &mut Vec<[u32; 3]>) {
    let (mut i, mut j) = (0, 0);
    while i + 1 < outer.len() || j + 1 < inner.len() {
        // The row that lags behind goes on.
        let by_outer = match (outer.get(i + 1), inner.get(j + 1)) {
            (Some(a), Some(b)) => a.0 + outer[i].0 <= b.0 + inner[j].0,
            (next, _) => next.is_some(),
        };
        let third = if by_outer { outer[i + 1].1 } else { inner[j + 1].1 };
        let triangle = [outer[i].1, third, inner[j].1];
        triangles.push(if turned { [triangle[0], triangle[2], triangle[1]] } else { triangle });
        if by_outer { i += 1 } else { j += 1 }
    }
}

fn casteljau(mut points: Vec<DVec4>, t: f64) -> DVec4 {
    for last in (1..points.len()).rev() {
        for k in 0..last {
            points[k] = points[k].lerp(points[k + 1], t);
        }
    }
    points.first().copied().unwrap_or(DVec4::W)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLAT: &str = "1\n1 1\n0 0 0\n0 2 0\n3 0 0\n3 2 0\n";

    #[test]
    fn a_bilinear_patch_is_a_rectangle() {
        let patches = BezierPatches::parse(FLAT).unwrap();
        assert_eq!(patches.bounds(), (DVec3::ZERO, DVec3::new(3.0, 2.0, 0.0)));
        let mesh = patches.tessellate(0.01, &RunOptions::default()).unwrap();
        let area: f64 = (0..mesh.triangles.len())
            .map(|t| mesh.corners(t))
            .map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0)
            .sum();
        assert!((area - 6.0).abs() < 1e-12 && mesh.triangles.len() == 8, "{} {area}", mesh.triangles.len());
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

    /// Distance from points of a patch to the mesh, at most.
    fn worst(patches: &BezierPatches, mesh: &TriangleMesh) -> f64 {
        let bvh = super::super::Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
        let mut worst = 0f64;
        for patch in &patches.patches {
            for k in 0..31 * 31 {
                let p = patch.at(f64::from(k / 31) / 30.0, f64::from(k % 31) / 30.0);
                worst = worst.max(bvh.closest_point(p, f64::INFINITY).unwrap().distance_squared.sqrt());
            }
        }
        worst
    }

    /// Edges with one triangle, after equal positions are one.
    fn open_edges(mesh: &TriangleMesh) -> usize {
        let place = |v: u32| mesh.positions[v as usize].to_array().map(|x| (x + 0.0).to_bits());
        let mut count: FxHashMap<_, i32> = FxHashMap::default();
        for t in &mesh.triangles {
            for k in 0..3 {
                let (a, b) = (place(t[k]), place(t[(k + 1) % 3]));
                *count.entry(if a < b { (a, b) } else { (b, a) }).or_default() += if a < b { 1 } else { -1 };
            }
        }
        count.values().filter(|n| **n != 0).count()
    }

    #[test]
    fn triangles_stay_within_the_tolerance_and_need_no_more_than_the_bend_asks_for() {
        // Half a cylinder of radius 1 by two rational patches; beside it a flat patch that shares an edge.
        let w = 0.5f64.sqrt();
        let arc = |points: [[f64; 3]; 3]| {
            let rows = points.iter().zip([1.0, w, 1.0]);
            let points = rows.flat_map(|(p, w)| [0.0, 2.0].map(|y| (DVec3::new(p[0], y, p[2]) * w).extend(w)));
            Patch { columns: 2, points: points.collect() }
        };
        let flat = [[-1.0, 0.0, 0.0], [-1.0, 2.0, 0.0], [-1.0, 0.0, -3.0], [-1.0, 2.0, -3.0]];
        let flat = Patch { columns: 2, points: flat.iter().map(|p| DVec3::from(*p).extend(1.0)).collect() };
        let patches = BezierPatches::new(vec![
            arc([[1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]]),
            arc([[0.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]),
            flat,
        ]);
        for k in 0..=10 {
            let p = patches.patches[0].at(f64::from(k) / 10.0, 0.3);
            assert!((p.x.hypot(p.z) - 1.0).abs() < 1e-15, "a rational quadratic is a circle");
        }
        for tolerance in [0.1, 0.01, 0.001] {
            let error = worst(&patches, &patches.tessellate(tolerance, &RunOptions::default()).unwrap());
            assert!(error < tolerance, "{tolerance}: {error}");
        }
        // A parabola z = 1 − x², x = −1..1, along y: M₁ = 8, so 4 / √tolerance segments by two.
        let row = [(-1.0, 0.0), (0.0, 2.0), (1.0, 0.0)];
        let points = row.into_iter().flat_map(|(x, z)| [0.0, 1.0].map(|y| DVec4::new(x, y, z, 1.0)));
        let parabola = BezierPatches::new(vec![Patch { columns: 2, points: points.collect() }]);
        for tolerance in [0.1, 0.01, 0.001] {
            let mesh = parabola.tessellate(tolerance, &RunOptions::default()).unwrap();
            assert!(worst(&parabola, &mesh) < tolerance);
            let segments = 4.0 / f64::sqrt(tolerance);
            assert!((mesh.triangles.len() as f64) < 4.0 * segments + 12.0, "{tolerance}: {}", mesh.triangles.len());
        }
        let refused = patches.tessellate(1e-9, &RunOptions::default()).unwrap_err();
        assert_eq!(refused.exit_code(), 2, "{refused}");
    }

    #[test]
    fn patches_of_unlike_bend_meet_without_cracks() {
        // A high dome and a shallow bowl over the same square rim, which the bowl runs through the other way.
        let cap = |height: f64, turned: bool| {
            let points = (0..16).map(|k| {
                let (i, j) = (if turned { 3 - k / 4 } else { k / 4 }, k % 4);
                let inside = (1..3).contains(&i) && (1..3).contains(&j);
                DVec3::new(f64::from(i) / 3.0, f64::from(j) / 3.0, if inside { height } else { 1.0 }).extend(1.0)
            });
            Patch { columns: 4, points: points.collect() }
        };
        let patches = BezierPatches::new(vec![cap(9.0, false), cap(0.9, true)]);
        let mesh = patches.tessellate(0.002, &RunOptions::default()).unwrap();
        assert_eq!(open_edges(&mesh), 0);
        assert!(worst(&patches, &mesh) < 0.002, "{}", worst(&patches, &mesh));
        let alone = |k: usize| {
            let patch = BezierPatches::new(vec![patches.patches[k].clone()]);
            patch.tessellate(0.002, &RunOptions::default()).unwrap().triangles.len()
        };
        assert!(alone(0) > 5 * alone(1), "each patch by its own bend: {} {}", alone(0), alone(1));
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
