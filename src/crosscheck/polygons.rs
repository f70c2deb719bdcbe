//! Level set → mesh on both sides: polygons are compared by area, volume and distance.

use glam::DVec3;

use super::Input;
use super::contest::{Contest, timed};
use super::difference::Difference;
use crate::error::Result;
use crate::mesh::{TriangleMesh, level_set_to_mesh};
use crate::vdb::reference::{ReferenceGrid, ReferenceMesh};

/// Ours against volumeToMesh at adaptivity 0, on grids that both sides hold.
pub(super) struct Polygonising<'a> {
    input: &'a Input<'a>,
    reference: ReferenceGrid,
    ours: Option<TriangleMesh>,
    theirs: Option<ReferenceMesh>,
}

impl<'a> Polygonising<'a> {
    pub fn boxed(input: &'a Input<'a>) -> Result<Box<dyn Contest + 'a>> {
        let reference = ReferenceGrid::from_level_set(input.level_set)?;
        Ok(Box::new(Self { input, reference, ours: None, theirs: None }))
    }
}

impl Contest for Polygonising<'_> {
    fn ours(&mut self) -> Result<f64> {
        self.ours = None;
        let (mesh, ms) = timed(|| level_set_to_mesh(self.input.level_set, 0.0, self.input.run))?;
        self.ours = Some(mesh);
        Ok(ms)
    }

    fn theirs(&mut self) -> Result<f64> {
        self.theirs = None;
        let (mesh, ms) = timed(|| self.reference.to_mesh(0.0, 0.0))?;
        self.theirs = Some(mesh);
        Ok(ms)
    }

    /// How far OpenVDB's vertices lie from our polygons.
    fn difference(&self) -> Result<Difference> {
        let (Some(ours), Some(theirs)) = (&self.ours, &self.theirs) else { return Ok(Difference::default()) };
        let points: Vec<DVec3> = theirs.points()?.iter().map(|p| p.as_dvec3()).collect();
        let mut difference = Difference::default();
        let (truth, transform) = (self.input.truth()?, self.input.level_set.transform());
        for point in &points {
            let reach = 4.0;
            let hit = truth.closest_point(transform.world_to_index(*point), reach);
            difference.add(hit.map_or(reach, |hit| hit.distance_squared.sqrt()));
        }
        let [our_area, our_volume] = area_and_volume(&ours.positions, &ours.triangles);
        let [their_area, their_volume] = area_and_volume(&points, &theirs.all_triangles()?);
        // OpenVDB's polygons are clockwise seen from outside.
        difference.area = Some(our_area / their_area - 1.0);
        difference.volume = Some(our_volume / -their_volume - 1.0);
        if let Some(mesh) = self.input.source {
            let [area, volume] = area_and_volume(&mesh.positions, &mesh.triangles);
            difference.area_to_source = Some([our_area / area - 1.0, their_area / area - 1.0]);
            difference.volume_to_source = Some([our_volume / volume - 1.0, -their_volume / volume - 1.0]);
        }
        Ok(difference)
    }
}

fn area_and_volume(positions: &[DVec3], triangles: &[[u32; 3]]) -> [f64; 2] {
    let corners = triangles.iter().map(|t| t.map(|v| positions[v as usize]));
    corners.fold([0.0, 0.0], |[area, volume], [a, b, c]| {
        [area + (b - a).cross(c - a).length() / 2.0, volume + a.dot(b.cross(c)) / 6.0]
    })
}
