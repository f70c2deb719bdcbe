//! Free-form surfaces of OBJ files as Bézier patches: `cstype`, `deg`, `surf`, `parm`, `end` (Wavefront's specification, 3.0).
//!
//! Bézier and B-spline surfaces, rational (NURBS) or not. Each knot within the range of a surface is inserted until it is as often
//! there as the degree (Boehm 1980): then the control points between two knots are those of a Bézier patch, and the surface is the
//! same. Trimmed surfaces and other bases are refused.

use std::path::Path;

use glam::{DVec3, DVec4};

use super::BezierPatches;
use super::bezier::{HIGHEST_DEGREE, Patch};
use crate::error::{EditError, Result};

impl BezierPatches {
    /// Reads the free-form surfaces of an OBJ file.
    pub fn read_obj(path: &Path) -> Result<Self> {
        let text =
            std::fs::read_to_string(path).map_err(|e| EditError::input(path, format!("could not be read: {e}")))?;
        parse(&text).map_err(|problem| EditError::input(path, problem))
    }
}

/// What is being read.
#[derive(Default)]
struct Reader {
    vertices: Vec<DVec4>,
    /// Whether the basis is a B-spline's; `None` before `cstype`.
    spline: Option<bool>,
    rational: bool,
    degrees: Option<[usize; 2]>,
    surface: Option<Surface>,
    patches: Vec<Patch>,
}

/// A surface whose `end` is not reached.
struct Surface {
    /// Parameters at which it begins and ends, for u and v.
    range: [[f64; 2]; 2],
    points: Vec<DVec4>,
    parameters: [Vec<f64>; 2],
}

fn parse(text: &str) -> Result<BezierPatches, String> {
    let mut reader = Reader::default();
    let mut lines = text.lines().zip(1..);
    while let Some((line, number)) = lines.next() {
        let mut whole = line.to_owned();
        while whole.trim_end().ends_with('\\') {
            whole.truncate(whole.trim_end().len() - 1);
            whole.push(' ');
            whole.push_str(lines.next().map_or("", |(next, _)| next));
        }
        let words: Vec<&str> = whole.split('#').next().unwrap_or_default().split_whitespace().collect();
        if let Some((key, values)) = words.split_first() {
            reader.line(key, values).map_err(|problem| format!("line {number}: {problem}"))?;
        }
    }
    match (reader.surface, reader.patches.is_empty()) {
        (Some(_), _) => Err("ends within a surface: `end` is missing".into()),
        (None, true) => Err("has no free-form surface (`cstype`, `surf`); as a mesh it needs no `shape`".into()),
        (None, false) => Ok(BezierPatches::new(reader.patches)),
    }
}

fn numbers(words: &[&str]) -> Result<Vec<f64>, String> {
    let number = |w: &&str| w.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or(format!("`{w}` is no finite number"));
    words.iter().map(number).collect()
}

impl Reader {
    fn line(&mut self, key: &str, words: &[&str]) -> Result<(), String> {
        match key {
            "v" => {
                let v = numbers(words)?;
                let (&[x, y, z], w) = (v.get(..3).and_then(|v| v.first_chunk()).ok_or("`v` needs x y z")?, v.get(3));
                let w = w.copied().unwrap_or(1.0);
                if w <= 0.0 {
                    return Err(format!("a weight of {w}: positive ones are read"));
                }
                self.vertices.push(DVec3::new(x, y, z).extend(w));
            }
            "cstype" => {
                self.rational = words.first() == Some(&"rat");
                self.spline = Some(match words.last() {
                    Some(&"bspline") => true,
                    Some(&"bezier") => false,
                    other => return Err(format!("`cstype {}`: bezier and bspline are read", other.unwrap_or(&""))),
                });
            }
            "deg" => {
                let degrees: Option<Vec<usize>> =
                    words.iter().map(|w| w.parse().ok().filter(|d| (1..=HIGHEST_DEGREE).contains(d))).collect();
                let degrees = degrees.ok_or_else(|| format!("degrees of 1 to {HIGHEST_DEGREE} are read"))?;
                // A single one is that of curves, which are passed over.
                self.degrees = <[usize; 2]>::try_from(degrees).ok();
            }
            "surf" => self.surface = Some(self.surface(words)?),
            "parm" => {
                if let (Some(surface), Some((axis, values))) = (&mut self.surface, words.split_first()) {
                    let axis = match *axis {
                        "u" => 0,
                        "v" => 1,
                        other => return Err(format!("`parm {other}`: u or v")),
                    };
                    surface.parameters[axis] = numbers(values)?;
                }
            }
            "trim" | "hole" if self.surface.is_some() => return Err("trimmed surfaces are not read".into()),
            "end" => {
                if let Some(surface) = self.surface.take() {
                    self.finish(surface)?;
                }
            }
            _ => {}
        }
        Ok(())
    }

    fn surface(&self, words: &[&str]) -> Result<Surface, String> {
        let (range, points) = words.split_at_checked(4).ok_or("`surf` needs s0 s1 t0 t1 and control points")?;
        let [s0, s1, t0, t1] = numbers(range)?[..] else { return Err("`surf` needs s0 s1 t0 t1".into()) };
        let point = |word: &&str| {
            let index: i64 = word.split('/').next().and_then(|w| w.parse().ok()).unwrap_or(0);
            let count = self.vertices.len() as i64;
            let place = if index < 0 { count + index } else { index - 1 };
            let found = usize::try_from(place).ok().and_then(|place| self.vertices.get(place));
            let p = found.ok_or_else(|| format!("`{word}`: there are {count} vertices"))?;
            let w = if self.rational { p.w } else { 1.0 };
            Ok::<_, String>((p.truncate() * w).extend(w))
        };
        let points = points.iter().map(point).collect::<Result<_, _>>()?;
        Ok(Surface { range: [[s0, s1], [t0, t1]], points, parameters: [Vec::new(), Vec::new()] })
    }

    /// Adds the patches of a surface.
    fn finish(&mut self, surface: Surface) -> Result<(), String> {
        let (Some(spline), Some(degrees)) = (self.spline, self.degrees) else {
            return Err("a surface before `cstype` and `deg` with two degrees".into());
        };
        let Surface { range, points, mut parameters } = surface;
        if !spline {
            // Segments of equal knots: as a B-spline whose every knot is as often there as the degree.
            for (knots, degree) in parameters.iter_mut().zip(degrees) {
                let all = knots.iter().flat_map(|t| std::iter::repeat_n(*t, degree));
                let (first, last) = (knots.first().copied(), knots.last().copied());
                *knots = first.into_iter().chain(all).chain(last).collect();
            }
        }
        let mut counts = [0; 2];
        for axis in 0..2 {
            let (knots, degree) = (&parameters[axis], degrees[axis]);
            counts[axis] = knots.len().saturating_sub(degree + 1);
            let rising = knots.is_sorted() && range[axis][0] < range[axis][1];
            let name = ["u", "v"][axis];
            if counts[axis] <= degree || !rising {
                return Err(format!(
                    "`parm {name}`: more than {} rising values, as many as points and degree ask for",
                    2 * degree + 1
                ));
            }
            let [from, to] = range[axis];
            if from < knots[degree] || to > knots[counts[axis]] {
                return Err(format!("the range {from} to {to} of {name} lies outside of its knots"));
            }
        }
        if counts[0] * counts[1] != points.len() {
            return Err(format!(
                "{} control points, where the knots ask for {} x {}",
                points.len(),
                counts[0],
                counts[1]
            ));
        }
        // Rows of constant v in the file; first all of them along u, then what comes out along v.
        let rows: Vec<Vec<DVec4>> = points.chunks_exact(counts[0]).map(<[DVec4]>::to_vec).collect();
        let strips = pieces(rows, &parameters[0], degrees[0], range[0]);
        for strip in strips {
            let across: Vec<Vec<DVec4>> = (0..=degrees[0]).map(|i| strip.iter().map(|row| row[i]).collect()).collect();
            for piece in pieces(across, &parameters[1], degrees[1], range[1]) {
                self.patches.push(Patch { columns: degrees[1] + 1, points: piece.concat() });
            }
        }
        Ok(())
    }
}

/// The Bézier pieces of B-spline curves over the same knots, between two parameters: for each piece, the control points of each curve.
fn pieces(mut curves: Vec<Vec<DVec4>>, knots: &[f64], degree: usize, [from, to]: [f64; 2]) -> Vec<Vec<Vec<DVec4>>> {
    let mut knots = knots.to_vec();
    let mut cuts: Vec<f64> = knots.iter().copied().filter(|t| *t > from && *t < to).chain([from, to]).collect();
    cuts.sort_by(f64::total_cmp);
    cuts.dedup();
    for &t in &cuts {
        while knots.iter().filter(|k| **k == t).count() < degree {
            insert(&mut curves, &mut knots, degree, t);
        }
    }
    let spans = cuts.windows(2).map(|pair| knots.partition_point(|k| *k <= pair[0]) - 1);
    spans.map(|s| curves.iter().map(|curve| curve[s - degree..=s].to_vec()).collect()).collect()
}

/// Inserts a knot once (Boehm 1980): the curves stay as they are, and have a control point more.
fn insert(curves: &mut [Vec<DVec4>], knots: &mut Vec<f64>, degree: usize, t: f64) {
    let k = knots.partition_point(|knot| *knot <= t) - 1;
    for points in curves {
        let mut more: Vec<DVec4> = points[..=k - degree].to_vec();
        for i in k - degree + 1..=k {
            // At the end of the range there is no further point, and its part is 0.
            let a = (t - knots[i]) / (knots[i + degree] - knots[i]);
            more.push(points.get(i).map_or(points[i - 1], |next| points[i - 1].lerp(*next, a)));
        }
        more.extend(&points[k..]);
        *points = more;
    }
    knots.insert(k + 1, t);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::RunOptions;

    /// A cylinder of radius 1 and height 2 around z, as the usual nine points around.
    fn cylinder(extra: &str) -> String {
        let w = 0.5f64.sqrt();
        let around = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0)];
        let mut text = String::from("# a cylinder\n");
        for z in [0, 2] {
            for (k, (x, y)) in around.iter().enumerate() {
                text += &format!("v {x} {y} {z} {}\n", if k % 2 == 1 { w } else { 1.0 });
            }
        }
        text += "cstype rat bspline\ndeg 2 1\nsurf 0 4 0 1 1 2 3 4 5 6 7 8 9 \\\n 10 11 12 13 14 15 16 17 -1\n";
        text + "parm u 0 0 0 1 1 2 2 3 3 4 4 4\nparm v 0 0 1 1\n" + extra + "end\n"
    }

    fn mesh(text: &str, tolerance: f64) -> super::super::TriangleMesh {
        parse(text).unwrap().tessellate(tolerance, &RunOptions::default()).unwrap()
    }

    #[test]
    fn a_rational_spline_is_a_cylinder() {
        let mesh = mesh(&cylinder(""), 0.002);
        for p in &mesh.positions {
            assert!((p.x.hypot(p.y) - 1.0).abs() < 1e-14 && (0.0..=2.0).contains(&p.z), "{p}");
        }
        let area: f64 = (0..mesh.triangles.len())
            .map(|t| mesh.corners(t))
            .map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0)
            .sum();
        assert!((area / (4.0 * std::f64::consts::PI) - 1.0).abs() < 0.002, "{area}");
        // Half of it.
        let half = self::mesh(&cylinder("").replace("surf 0 4", "surf 0.5 2.5"), 0.002);
        assert!(half.positions.iter().all(|p| p.y > -0.93));
    }

    #[test]
    fn an_open_spline_without_repeated_knots_is_its_polynomials() {
        // A uniform cubic over points on a line at equal distances is that line; with one raised it is the basis function.
        let mut text = String::new();
        for y in 0..2 {
            for x in 0..7 {
                text += &format!("v {x} {y} {}\n", if x == 3 { 1.0 } else { 0.0 });
            }
        }
        text += "cstype bspline\ndeg 3 1\nsurf 3 7 0 1 1 2 3 4 5 6 7 8 9 10 11 12 13 14\n\
                 parm u 0 1 2 3 4 5 6 7 8 9 10\nparm v 0 0 1 1\nend\n";
        let patches = parse(&text).unwrap();
        let (lo, hi) = patches.bounds();
        assert!((lo - DVec3::new(1.0, 0.0, 0.0)).length() < 1e-12 && (hi.x - 5.0).abs() < 1e-12, "{lo} {hi}");
        let mesh = patches.tessellate(1e-3, &RunOptions::default()).unwrap();
        for p in &mesh.positions {
            // The cubic cardinal B-spline around 3.
            let d = (p.x - 3.0).abs();
            let b = if d < 1.0 { 2.0 / 3.0 - d * d + d * d * d / 2.0 } else { (2.0 - d).max(0.0).powi(3) / 6.0 };
            assert!((p.z - b).abs() < 1e-12, "{p} {b}");
        }
    }

    #[test]
    fn bezier_surfaces_of_several_segments() {
        let mut text = String::from("cstype bezier\ndeg 1 1\n");
        for y in [0, 1] {
            for x in [0, 1, 3] {
                text += &format!("v {x} {y} 0\n");
            }
        }
        text += "surf 0 2 0 1 1 2 3 4 5 6\nparm u 0 1 2\nparm v 0 1\nend\n";
        assert_eq!(parse(&text).unwrap().bounds(), (DVec3::ZERO, DVec3::new(3.0, 1.0, 0.0)));
    }

    #[test]
    fn damaged_files_are_refused() {
        let with = |from: &str, to: &str| cylinder("").replace(from, to);
        for (text, part) in [
            (String::new(), "no free-form surface"),
            (with("end\n", ""), "`end` is missing"),
            (cylinder("trim 0 1 1\n"), "trimmed"),
            (with("rat bspline", "bmatrix"), "bezier and bspline"),
            (with("deg 2 1", "deg 2 99"), "degrees"),
            (with("deg 2 1", "deg 2"), "two degrees"),
            (with("1 1\n10", "1 99\n10").replace("surf 0 4 0 1 1", "surf 0 4 0 1 99"), "18 vertices"),
            (with("parm v 0 0 1 1", "parm v 0 0 1"), "parm v"),
            (with("parm v 0 0 1 1", "parm v 0 0 0.5 1 1"), "control points"),
            (with("3 3 4 4 4", "3 3 4 4 1"), "rising"),
            (with("surf 0 4", "surf 0 9"), "outside of its knots"),
            (with("v 1 1 0 0.7071067811865476", "v 1 1 0 -1"), "weight"),
            (with("v 1 1 0 0.7071067811865476", "v 1 nan 0 1"), "`nan`"),
        ] {
            let error = parse(&text).unwrap_err();
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}
