//! Colours and texture coordinates from one mesh to another, by closest point.
//!
//! Each vertex takes what the source has at the nearest point of its surface, interpolated within that triangle (of
//! equally near ones the first). On a texture seam a vertex can have the coordinates of one side only: the row of
//! triangles that spans the seam joins both sides.

use glam::DVec3;
use rayon::prelude::*;

use super::to_levelset::check_numbers;
use super::unit::UnitFrame;
use super::{Bvh, TriangleMesh};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

const OPERATION: &str = "transfer attributes";

/// Colours and texture coordinates, one a vertex, as far as the source has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Attributes {
    /// Linear RGBA in 0..1.
    pub colors: Option<Vec<[f32; 4]>>,
    /// Texture coordinates.
    pub uvs: Option<Vec<[f32; 2]>>,
}

/// The attributes of `source` at the points of its surface nearest to `positions`.
///
/// Errors name the mesh `mesh`; a caller that knows the file puts its name there.
pub fn transfer_attributes(source: &TriangleMesh, positions: &[DVec3], run: &RunOptions) -> Result<Attributes> {
    check_numbers(source)?;
    let vertices = source.positions.len();
    for (name, count) in [("colors", source.colors.as_ref().map(Vec::len)), ("uvs", source.uvs.as_ref().map(Vec::len))]
    {
        if let Some(count) = count.filter(|&count| count != vertices) {
            return Err(EditError::input("mesh", format!("{vertices} vertices but {count} {name}")));
        }
    }
    if source.triangles.is_empty() {
        return Err(EditError::input("mesh", "no triangles to take attributes from"));
    }
    let per_triangle = 2 * size_of::<[DVec3; 3]>() + 64;
    let bytes = source.triangles.len() * per_triangle + positions.len() * (size_of::<Source>() + 24);
    run.reserve(OPERATION, bytes as u64, "take a smaller mesh")?;
    run.check(OPERATION)?;

    let frame = UnitFrame::around(source)?;
    let tree = Bvh::new((0..source.triangles.len()).map(|t| source.corners(t).map(|p| frame.map(p))).collect());
    let task = run.task(OPERATION, positions.len() as u64);
    let sources: Vec<Source> = positions
        .par_chunks(4096)
        .flat_map_iter(|chunk| {
            task.advance(chunk.len() as u64);
            let cancelled = run.is_cancelled();
            let (tree, frame) = (&tree, &frame);
            chunk.iter().map(move |&p| match cancelled {
                true => Source::default(),
                false => nearest(source, tree, frame, p),
            })
        })
        .collect();
    run.check(OPERATION)?;
    Ok(Attributes {
        colors: source.colors.as_ref().map(|colors| sources.par_iter().map(|s| s.of(colors)).collect()),
        uvs: source.uvs.as_ref().map(|uvs| sources.par_iter().map(|s| s.of(uvs)).collect()),
    })
}

/// Where the attributes of a vertex come from.
#[derive(Clone, Copy, Default)]
struct Source {
    corners: [u32; 3],
    /// Barycentric: not negative, 1 in sum.
    weights: [f32; 3],
}

impl Source {
    fn of<const N: usize>(&self, values: &[[f32; N]]) -> [f32; N] {
        let [a, b, c] = self.corners.map(|v| values[v as usize]);
        let [u, v, w] = self.weights;
        std::array::from_fn(|k| u * a[k] + v * b[k] + w * c[k])
    }
}

fn nearest(source: &TriangleMesh, tree: &Bvh, frame: &UnitFrame, p: DVec3) -> Source {
    let p = frame.map(p);
    // A position so far away that squares overflow has no nearest point: any will do.
    let hit = tree.closest_point(p, f64::INFINITY);
    let (triangle, point) = hit.map_or((0, p), |hit| (hit.triangle as usize, hit.point));
    let corners = source.corners(triangle).map(|c| frame.map(c));
    Source { corners: source.triangles[triangle], weights: barycentric(point, corners).map(|w| w as f32) }
}

/// Barycentric coordinates of a point of a triangle, which may be a segment or a point: then all weight is on the nearest
/// corner.
pub(crate) fn barycentric(p: DVec3, [a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let normal = (b - a).cross(c - a);
    let area_squared = normal.length_squared();
    let v = normal.dot((p - a).cross(c - a)) / area_squared;
    let w = normal.dot((b - a).cross(p - a)) / area_squared;
    if v.is_finite() && w.is_finite() {
        let v = v.clamp(0.0, 1.0);
        let w = w.clamp(0.0, 1.0 - v);
        return [1.0 - v - w, v, w];
    }
    let [da, db, dc] = [a, b, c].map(|corner| corner.distance_squared(p));
    if da <= db && da <= dc {
        [1.0, 0.0, 0.0]
    } else if db <= dc {
        [0.0, 1.0, 0.0]
    } else {
        [0.0, 0.0, 1.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::testing::{noise, sphere};

    fn painted(center: DVec3, radius: f64) -> TriangleMesh {
        let mut mesh = sphere(center, radius, 32);
        let unit = |p: &DVec3| (*p - center) / radius;
        mesh.colors = Some(mesh.positions.iter().map(|p| unit(p).as_vec3().extend(1.0).to_array()).collect());
        mesh.uvs = Some(mesh.positions.iter().map(|p| [unit(p).x as f32, unit(p).z as f32]).collect());
        mesh
    }

    #[test]
    fn linear_attributes_come_through_exactly() {
        // Far from the origin and at a size where squares of f32 would overflow.
        for (center, radius) in [(DVec3::ZERO, 1.0), (DVec3::splat(1e6), 50.0), (DVec3::ZERO, 1e30)] {
            let source = painted(center, radius);
            let points: Vec<DVec3> = (0..500)
                .map(|i| center + radius * 3.0 * (DVec3::new(noise(i), noise(i + 1000), noise(i + 2000)) - 0.5))
                .collect();
            let Attributes { colors, uvs } = transfer_attributes(&source, &points, &RunOptions::default()).unwrap();
            let tree = Bvh::new(
                (0..source.triangles.len()).map(|t| source.corners(t).map(|p| (p - center) / radius)).collect(),
            );
            for ((p, color), uv) in points.iter().zip(colors.unwrap()).zip(uvs.unwrap()) {
                let truth = tree.closest_point((*p - center) / radius, f64::INFINITY).unwrap().point;
                let found = DVec3::new(color[0].into(), color[1].into(), color[2].into());
                assert!((found - truth).length() < 1e-5 && (color[3] - 1.0).abs() < 1e-6, "{found} {truth}");
                assert!((f64::from(uv[0]) - truth.x).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn seams_are_not_blended_and_slivers_have_a_corner() {
        // Two triangles that share an edge in space, with different coordinates on its two sides.
        let source = TriangleMesh {
            positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::ZERO, DVec3::Y, -DVec3::X],
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            uvs: Some(vec![[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0]]),
            normals: None,
            colors: None,
        };
        let points = [DVec3::new(1e-3, 0.5, 1.0), DVec3::new(-1e-3, 0.5, 1.0), DVec3::new(0.0, 0.5, 0.0)];
        let found = transfer_attributes(&source, &points, &RunOptions::default()).unwrap();
        assert_eq!((found.colors, found.uvs), (None, Some(vec![[0.0; 2], [1.0; 2], [0.0; 2]])));
        assert_eq!(barycentric(DVec3::X * 0.9, [DVec3::ZERO, DVec3::X, DVec3::X * 2.0]), [0.0, 1.0, 0.0]);
    }

    #[test]
    fn refusals() {
        let none = transfer_attributes(&TriangleMesh::default(), &[], &RunOptions::default());
        assert_eq!(none.unwrap_err().exit_code(), 3);
        let mut short = painted(DVec3::ZERO, 1.0);
        short.uvs = Some(Vec::new());
        assert_eq!(transfer_attributes(&short, &[DVec3::ZERO], &RunOptions::default()).unwrap_err().exit_code(), 3);
        let mut huge = painted(DVec3::ZERO, 1.0);
        huge.positions[0] = DVec3::MAX;
        huge.positions[1] = DVec3::MIN;
        assert_eq!(transfer_attributes(&huge, &[DVec3::ZERO], &RunOptions::default()).unwrap_err().exit_code(), 3);
    }
}
