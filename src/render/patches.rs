//! Patches of a texture on a surface: their nets as lines, and how much the map distorts as a colour.

use std::path::Path;

use glam::{DVec2, DVec3};

use super::vertices::sequential;
use crate::error::{EditError, Result};
use crate::mesh::{Bvh, barycentric};

/// Lines of a net along u and along v, and their width as a part of the space between them.
const LINES: f64 = 16.0;
const WIDTH: f64 = 0.07;

/// How far from the net a surface may lie to be coloured, as a part of the length of a cell.
const REACH: f64 = 0.75;

/// Linear colours of lines, and of the patch between them if it does not show a number.
const LINE: DVec3 = DVec3::new(0.02, 0.03, 0.06);
const PATCH: DVec3 = DVec3::new(0.75, 0.66, 0.52);

/// The cells of patches on the surface, as of the particles that `texture` writes.
pub struct Patches {
    bvh: Bvh,
    /// Of the corners of each triangle.
    values: Vec<[Corner; 3]>,
    reach: f64,
}

#[derive(Clone, Copy)]
struct Corner {
    place: DVec3,
    uv: DVec2,
    /// s1/s2 of the map.
    angle: f64,
}

impl Patches {
    /// Reads a PLY that `texture` wrote (`write_particles`).
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| {
            EditError::input(
                path,
                format!("cannot be read as text: {e}; the particles of `texture --write-particles` are wanted"),
            )
        })?;
        Self::parse(&text).map_err(|problem| {
            EditError::input(path, format!("{problem}; a PLY of `texture --write-particles` is wanted"))
        })
    }

    fn parse(text: &str) -> std::result::Result<Self, String> {
        let mut lines = text.lines();
        let (mut counts, mut properties) = ([0usize; 2], Vec::new());
        for line in lines.by_ref() {
            let words: Vec<&str> = line.split_whitespace().collect();
            match words[..] {
                ["end_header"] => break,
                ["element", "vertex", n] => counts[0] = n.parse().map_err(|_| format!("`{line}`: no number"))?,
                ["element", "face", n] => counts[1] = n.parse().map_err(|_| format!("`{line}`: no number"))?,
                ["property", "float", name] => properties.push(name),
                _ => {}
            }
        }
        if properties != PROPERTIES || counts.contains(&0) {
            return Err("it has not the vertices x, y, z, u, v, w, angle and area with faces".into());
        }
        let short = || "it ends before its last face".to_owned();
        let mut vertices = Vec::new();
        for line in lines.by_ref().take(counts[0]) {
            let numbers: Vec<f64> = line.split_whitespace().filter_map(|word| word.parse().ok()).collect();
            let [x, y, z, u, v, w, angle, _] = numbers[..] else { return Err(format!("`{line}` is no particle")) };
            let place = DVec3::new(x, y, z);
            if !(place.is_finite() && place.abs().max_element() < f64::from(f32::MAX)) {
                return Err(format!("`{line}` is no particle"));
            }
            vertices.push((w == 0.0, Corner { place, uv: DVec2::new(u, v), angle }));
        }
        let (mut triangles, mut values, mut length, mut edges) = (Vec::new(), Vec::new(), 0.0, 0.0f64);
        for _ in 0..counts[1] {
            let line = lines.next().ok_or_else(short)?;
            let corners: Option<Vec<_>> = line
                .split_whitespace()
                .skip(1)
                .map(|word| vertices.get(word.parse::<usize>().ok()?).copied())
                .collect();
            let Some([a, b, c, d]) = corners.as_deref().and_then(|c| <[_; 4]>::try_from(c).ok()) else {
                return Err(format!("`{line}` is no cell"));
            };
            if ![a, b, c, d].iter().all(|(on_surface, _)| *on_surface) {
                continue;
            }
            for [p, q, r] in [[a, b, c], [a, c, d]] {
                triangles.push([p.1.place, q.1.place, r.1.place]);
                values.push([p.1, q.1, r.1]);
                length += p.1.place.distance(q.1.place);
                edges += 1.0;
            }
        }
        if triangles.is_empty() {
            return Err("none of its cells lies on a surface (w = 0)".into());
        }
        Ok(Self { bvh: Bvh::new(triangles), values, reach: length / edges * REACH })
    }

    /// The linear colour of a place on the surface; `None` beside the patches. With a `range`, s1/s2 − 1 from 0 (dark) to that (bright).
    pub(super) fn color(&self, xyz: DVec3, range: Option<f64>) -> Option<DVec3> {
        let hit = self.bvh.closest_point(xyz, self.reach)?;
        let corners = self.values[hit.triangle as usize];
        let t = barycentric(hit.point, corners.map(|c| c.place));
        let uv: DVec2 = corners.iter().zip(t).map(|(c, t)| c.uv * t).sum();
        let line = (uv * LINES - (uv * LINES).round()).abs().min_element() < WIDTH / 2.0;
        if line {
            return Some(LINE);
        }
        let angle: f64 = corners.iter().zip(t).map(|(c, t)| c.angle * t).sum();
        Some(range.map_or(PATCH, |range| sequential((angle - 1.0) / range)))
    }
}

/// What a particle has in its file.
pub(crate) const PROPERTIES: [&str; 8] = ["x", "y", "z", "u", "v", "w", "angle", "area"];

#[cfg(test)]
mod tests {
    use super::*;

    fn text(rows: &str) -> String {
        let header: String = PROPERTIES.iter().map(|name| format!("property float {name}\n")).collect();
        let header = format!("ply\nformat ascii 1.0\nelement vertex 4\n{header}element face 1\n");
        format!("{header}property list uchar int vertex_indices\nend_header\n{rows}")
    }

    const SQUARE: &str = "0 0 0 0 0 0 1 1\n4 0 0 1 0 0 2 1\n4 4 0 1 1 0 2 1\n0 4 0 0 1 0 1 1\n4 0 1 2 3\n";

    #[test]
    fn lines_and_numbers_are_coloured() {
        let patches = Patches::parse(&text(SQUARE)).unwrap();
        // u = 4/16 is a line, half a cell on is none.
        assert_eq!(patches.color(DVec3::new(1.0, 0.6, 0.2), None), Some(LINE));
        assert_eq!(patches.color(DVec3::new(1.125, 0.625, -0.2), None), Some(PATCH));
        assert_eq!(patches.color(DVec3::new(9.0, 0.6, 0.0), None), None);
        // s1/s2 rises from 1 to 2 with x.
        let at = |x: f64| patches.color(DVec3::new(x, 0.625, 0.0), Some(1.0)).unwrap();
        assert!(
            at(0.125).distance(sequential(0.125 / 4.0)) < 1e-9 && at(3.875).distance(sequential(3.875 / 4.0)) < 1e-9
        );
    }

    #[test]
    fn other_files_are_refused() {
        for (text, words) in [
            ("ply\nend_header\n".into(), "x, y, z, u, v, w"),
            (text("0 0 0 0 0 0 1\n"), "no particle"),
            (text(&SQUARE.replace("1 2 3", "1 2 9")), "no cell"),
            (text(&SQUARE.replace("4 0 1 2 3\n", "")), "ends before"),
            (text(&SQUARE.replace("0 0 1 1\n", "0 1 1 1\n")), "w = 0"),
        ] {
            let problem = Patches::parse(&text).err().unwrap();
            assert!(problem.contains(words), "{problem}");
        }
    }
}
