//! What attracts: points, curves, surfaces and solids, in one tree and without sampling.

use std::path::Path;

use glam::DVec3;

use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{self, Bvh, MeshFormat, WindingNumber, level_set_to_mesh};
use crate::pde::Attractor;
use crate::region::files;
use crate::run::RunOptions;

/// Points, segments and triangles in index space; the first two are triangles without area.
pub(super) struct Elements(pub Vec<[DVec3; 3]>);

impl Elements {
    /// Points of a file, such as a region takes.
    pub fn of_points(path: &Path, level_set: &LevelSet) -> Result<Self> {
        let to = |p: DVec3| level_set.transform().world_to_index(p);
        Ok(Self(files::points(path)?.into_iter().map(|p| [to(p); 3]).collect()))
    }

    /// Segments of polylines (world space).
    pub fn of_polylines(lines: &[Vec<DVec3>], level_set: &LevelSet) -> Self {
        let to = |p: &DVec3| level_set.transform().world_to_index(*p);
        let segments = lines.iter().flat_map(|line| line.windows(2)).map(|w| [to(&w[0]), to(&w[1]), to(&w[1])]);
        Self(segments.collect())
    }

    /// Triangles of a mesh file, or of the surface of the level set in a `.vdb`; those of solids face outwards where that can be told.
    pub fn of_surface(path: &Path, level_set: &LevelSet, run: &RunOptions) -> Result<Self> {
        let mesh = match MeshFormat::of(path) {
            Some(_) => mesh::prepare(&mesh::read(path)?.mesh).0,
            None => {
                // A `.vdb` comes with its own voxels.
                let solid = files::level_set(path, None, level_set.voxel_size(), level_set.half_width(), run)?;
                level_set_to_mesh(&solid, 0.0, run)?
            }
        };
        let to = |p: DVec3| level_set.transform().world_to_index(p);
        let triangles: Vec<_> = (0..mesh.triangles.len()).map(|t| mesh.corners(t).map(to)).collect();
        if triangles.is_empty() {
            Err(EditError::input(path, "there is no surface in it"))
        } else {
            Ok(Self(triangles))
        }
    }
}

/// The polylines of a file: `l` statements of an OBJ, or points in the order of a text or mesh file, which are joined.
pub(in crate::ops) fn read_polylines(path: &Path) -> Result<Vec<Vec<DVec3>>> {
    let refuse = |problem: String| EditError::input(path, problem);
    let lines = match MeshFormat::of(path) {
        Some(MeshFormat::Obj) => {
            let text = std::fs::read_to_string(path).map_err(|e| refuse(format!("cannot be read as text: {e}")))?;
            obj_lines(&text).map_err(refuse)?
        }
        Some(format) => {
            return Err(refuse(format!(
                "a {format} file has no lines; an OBJ with `l` statements, an SVG or a text of points has"
            )));
        }
        None => vec![files::points(path)?],
    };
    match lines.iter().any(|line| line.len() >= 2) {
        true => Ok(lines),
        false => Err(refuse("there is no line of two points or more in it".into())),
    }
}

/// The `l` statements of an OBJ file; its indices count from 1, or back from the latest vertex.
fn obj_lines(text: &str) -> Result<Vec<Vec<DVec3>>, String> {
    let mut vertices: Vec<DVec3> = Vec::new();
    let mut lines = Vec::new();
    for (number, statement) in (1..).zip(text.lines()) {
        let mut words = statement.split_whitespace();
        match words.next() {
            Some("v") => {
                let mut next = || words.next()?.parse::<f64>().ok().filter(|v| v.is_finite());
                match (next(), next(), next()) {
                    (Some(x), Some(y), Some(z)) => vertices.push(DVec3::new(x, y, z)),
                    _ => return Err(format!("line {number}: a vertex needs three finite numbers")),
                }
            }
            Some("l") => lines.push((number, words.map(str::to_owned).collect::<Vec<_>>(), vertices.len())),
            _ => {}
        }
    }
    let vertex = |word: &str, known: usize| {
        let index: i64 = word.split('/').next()?.parse().ok()?;
        let place = if index < 0 { known as i64 + index } else { index - 1 };
        vertices.get(usize::try_from(place).ok()?).copied()
    };
    lines
        .into_iter()
        .map(|(number, words, known)| {
            let points = words.iter().map(|word| {
                vertex(word, known)
                    .ok_or_else(|| format!("line {number}: `{word}` is none of the {} vertices", vertices.len()))
            });
            points.collect()
        })
        .collect()
}

/// A surface, a curve or a set of points: the closest point of its elements.
pub(super) struct Surface<'a>(pub &'a Bvh);

impl Attractor for Surface<'_> {
    fn closest(&self, ijk: DVec3, within: f64) -> Option<DVec3> {
        self.0.closest_point(ijk, within).map(|hit| hit.point)
    }
}

/// A solid: what lies inside of it is its own closest point.
pub(super) struct Solid<'a> {
    surface: Surface<'a>,
    winding: WindingNumber<'a>,
}

impl<'a> Solid<'a> {
    pub fn new(tree: &'a Bvh) -> Self {
        Self { surface: Surface(tree), winding: WindingNumber::new(tree) }
    }
}

impl Attractor for Solid<'_> {
    fn closest(&self, ijk: DVec3, within: f64) -> Option<DVec3> {
        if self.winding.at(ijk) > 0.5 { Some(ijk) } else { self.surface.closest(ijk, within) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_obj_files() {
        let text = "v 0 0 0\nv 1 0 0\nl 1 2 -1\nv 2 0 0\nl 3/1 1\nf 1 2 3\n";
        let lines = obj_lines(text).unwrap();
        let p = |x: f64| DVec3::new(x, 0.0, 0.0);
        assert_eq!(lines, [vec![p(0.0), p(1.0), p(1.0)], vec![p(2.0), p(0.0)]]);
        for (text, part) in [("v 0 0\n", "line 1"), ("v 0 0 0\nl 1 2\n", "`2` is none of the 1"), ("l -1\n", "`-1`")] {
            assert!(obj_lines(text).unwrap_err().contains(part), "{text}");
        }
    }

    #[test]
    fn files_without_lines_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in [("a.obj", "v 0 0 0\n"), ("a.xyz", "0 0 0\n"), ("a.ply", "ply\n")] {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            assert_eq!(read_polylines(&path).unwrap_err().exit_code(), 3, "{name}");
        }
        let path = folder.path().join("b.xyz");
        std::fs::write(&path, "0 0 0\n1 0 0\n1 2 0\n").unwrap();
        assert_eq!(read_polylines(&path).unwrap()[0].len(), 3);
    }
}
