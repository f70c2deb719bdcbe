//! What all readers share: vertices and polygons in, a checked [`ReadMesh`] out.

use std::fmt::Display;
use std::path::Path;

use glam::DVec3;

use super::polygon::{Outline, one_turn, triangulate};
use super::{ReadMesh, TriangleMesh};
use crate::{EditError, Result};

/// A mesh under construction, with the oddities met so far.
pub(super) struct MeshBuilder<'a> {
    path: &'a Path,
    pub mesh: TriangleMesh,
    oddities: Vec<Oddity>,
    warnings: Vec<String>,
}

/// A kind of oddity, how often it occurred and where first.
struct Oddity {
    what: &'static str,
    count: u64,
    first: String,
}

impl<'a> MeshBuilder<'a> {
    pub fn new(path: &'a Path) -> Self {
        Self { path, mesh: TriangleMesh::default(), oddities: Vec::new(), warnings: Vec::new() }
    }

    /// The error for this file.
    pub fn refuse(&self, problem: impl Into<String>) -> EditError {
        EditError::input(self.path, problem)
    }

    /// Something worth saying once.
    pub fn warn(&mut self, warning: impl Into<String>) {
        self.warnings.push(warning.into());
    }

    /// One more of a kind of oddity; the warning gives the number and the first place.
    pub fn note(&mut self, what: &'static str, place: impl FnOnce() -> String) {
        match self.oddities.iter_mut().find(|oddity| oddity.what == what) {
            Some(oddity) => oddity.count += 1,
            None => self.oddities.push(Oddity { what, count: 1, first: place() }),
        }
    }

    /// Adds a vertex, which must be finite.
    pub fn vertex(&mut self, position: DVec3, place: impl FnOnce() -> String) -> Result<()> {
        let number = self.mesh.positions.len();
        if !position.is_finite() {
            let DVec3 { x, y, z } = position;
            return Err(self.refuse(format!("{}: vertex {number} is not finite: ({x}, {y}, {z})", place())));
        }
        if number >= u32::MAX as usize {
            return Err(self.refuse("more than 4,294,967,295 vertices"));
        }
        self.mesh.positions.push(position);
        Ok(())
    }

    /// Checks an index (from 0) as a file gives it.
    pub fn index(&self, index: impl TryInto<u32> + Display + Copy, place: impl FnOnce() -> String) -> Result<u32> {
        let count = self.mesh.positions.len();
        match index.try_into() {
            Ok(valid) if (valid as usize) < count => Ok(valid),
            _ => Err(self.refuse(format!("{}: vertex index {index} is out of range: {}", place(), range(count)))),
        }
    }

    /// Adds a polygon of checked indices. `corners` is changed: corners repeated in a row are taken out.
    pub fn polygon(&mut self, corners: &mut Vec<u32>, place: impl FnOnce() -> String) {
        corners.dedup();
        while corners.len() > 1 && corners.first() == corners.last() {
            corners.pop();
        }
        let turn = one_turn(corners);
        if turn.len() < 3 {
            return self.note("polygon(s) with fewer than three different corners skipped", place);
        }
        let repeated = turn.len() < corners.len();
        if triangulate(&self.mesh.positions, turn, &mut self.mesh.triangles) == Outline::Crossed {
            self.note("polygon(s) cross themselves, have no area or are too intricate to tell", place);
        } else if repeated {
            self.note("polygon(s) run around the same corners several times, taken once", place);
        }
    }

    /// The mesh, if it has any triangle.
    pub fn finish(mut self) -> Result<ReadMesh> {
        let mut warnings = std::mem::take(&mut self.warnings);
        let oddities = self.oddities.iter().map(|o| format!("{} {} (first: {})", o.count, o.what, o.first));
        warnings.extend(oddities);
        let vertices = self.mesh.positions.len();
        if self.mesh.triangles.is_empty() {
            let faces = if self.oddities.is_empty() { "" } else { &format!(" ({})", warnings.join("; ")) };
            return Err(self.refuse(match vertices {
                0 => format!("no vertices and no faces{faces}; a mesh with faces is needed"),
                _ => format!("no faces, {vertices} points only{faces}; a mesh with faces is needed"),
            }));
        }
        let mut used = vec![false; vertices];
        self.mesh.triangles.iter().flatten().for_each(|&v| used[v as usize] = true);
        let unused = used.iter().filter(|&&used| !used).count();
        if unused > 0 {
            warnings.push(format!("{unused} of {vertices} vertices are in no face"));
        }
        Ok(ReadMesh { mesh: self.mesh, warnings })
    }
}

fn range(count: usize) -> String {
    match count {
        0 => "there are no vertices".into(),
        _ => format!("there are {count} vertices (0..={})", count - 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oddities_are_counted_and_points_alone_are_refused() {
        let mut builder = MeshBuilder::new(Path::new("a.off"));
        for i in 0..4 {
            builder.vertex(DVec3::new(f64::from(i), f64::from(i * i), 0.0), String::new).unwrap();
        }
        for place in 5..8 {
            builder.polygon(&mut vec![0, 0, 1, 0], || format!("line {place}"));
        }
        let error = builder.finish().unwrap_err().to_string();
        assert!(error.contains("4 points only") && error.contains("3 polygon(s)"), "{error}");
        assert!(error.contains("first: line 5"), "{error}");
    }

    #[test]
    fn bad_vertices_and_indices_say_where() {
        let mut builder = MeshBuilder::new(Path::new("a.off"));
        let error = builder.vertex(DVec3::new(0.0, f64::NAN, 1.0), || "line 3".into()).unwrap_err();
        assert_eq!(error.to_string(), "a.off: line 3: vertex 0 is not finite: (0, NaN, 1)");
        let error = builder.index(-1i64, || "line 9".into()).unwrap_err();
        assert_eq!(error.to_string(), "a.off: line 9: vertex index -1 is out of range: there are no vertices");
        assert!(builder.index(1u64 << 40, String::new).is_err());
    }
}
