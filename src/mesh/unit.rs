//! Coordinates about the middle of a mesh, scaled to its size: what stays exact and in range in single precision.

use glam::DVec3;

use super::TriangleMesh;
use crate::error::{EditError, Result};

/// The map from the world to a box of edge 1 around the origin that holds a mesh.
#[derive(Clone, Copy, Debug)]
pub(super) struct UnitFrame {
    middle: DVec3,
    /// Longest side of the mesh in world units, positive.
    pub extent: f64,
}

impl UnitFrame {
    /// Around the triangles of `mesh`, whose numbers must be checked already. Refused where their extent is beyond f64.
    pub fn around(mesh: &TriangleMesh) -> Result<Self> {
        let Some((lo, hi)) = mesh.bounding_box() else { return Ok(Self { middle: DVec3::ZERO, extent: 1.0 }) };
        let extent = (hi - lo).max_element();
        if !extent.is_finite() {
            return Err(EditError::input("mesh", format!("reaches from {lo} to {hi}: too far for any number")));
        }
        Ok(Self { middle: lo + (hi - lo) * 0.5, extent: if extent > 0.0 { extent } else { 1.0 } })
    }

    /// A world point in the unit box.
    pub fn map(&self, world: DVec3) -> DVec3 {
        (world - self.middle) / self.extent
    }
}
