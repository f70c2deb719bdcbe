//! The boundary of an open mesh, and how fast its winding number can change because of it.
//!
//! Away from the triangles the winding number w of an open mesh is smooth; at a triangle it jumps by one. Its gradient is the
//! magnetic field of a current along the mesh's boundary (Biot and Savart), so |∇w| ≤ Σ ℓ/(4π d²) over the boundary edges of
//! length ℓ at distance d.

use std::f64::consts::PI;

use glam::DVec3;

/// The error of fast winding numbers, doubled.
pub(super) const WINDING_ERROR: f64 = 0.02;
/// Edges in a group of the rim.
const RIM_GROUP: usize = 32;

/// A piece of the mesh's boundary as a current: a ball that holds it and its length times multiplicity, over 4π.
#[derive(Clone, Copy)]
struct Current {
    center: DVec3,
    radius: f64,
    strength: f64,
}

/// The boundary of a mesh as currents.
pub(super) struct Rim {
    groups: Vec<(Current, Vec<Current>)>,
}

impl Rim {
    /// Of the boundary chain of an indexed mesh; empty if it is closed.
    pub fn new(positions: &[DVec3], chain: &[([u32; 2], i32)]) -> Self {
        let edges: Vec<Current> = chain
            .iter()
            .map(|&(ends, multiplicity)| {
                let [a, b] = ends.map(|v| positions[v as usize]);
                let length = a.distance(b);
                let strength = length * multiplicity.unsigned_abs() as f64 / (4.0 * PI);
                Current { center: (a + b) * 0.5, radius: 0.5 * length, strength }
            })
            .collect();
        // Vertices with near indices are mostly near each other, so the order of the edges makes fair groups.
        let groups = edges.chunks(RIM_GROUP).map(|chunk| {
            let center = chunk.iter().map(|e| e.center).sum::<DVec3>() / chunk.len() as f64;
            let radius = chunk.iter().map(|e| e.center.distance(center) + e.radius).fold(0.0, f64::max);
            (Current { center, radius, strength: chunk.iter().map(|e| e.strength).sum() }, chunk.to_vec())
        });
        Self { groups: groups.collect() }
    }

    /// Whether there is no boundary.
    pub fn is_empty(&self) -> bool {
        self.groups.is_empty()
    }

    /// A bound of |∇w| away from triangles in the ball around `center`; `None` if it exceeds `useless`.
    pub fn steepest(&self, center: DVec3, radius: f64, useless: f64) -> Option<f64> {
        let slope = |current: &Current| {
            let distance = current.center.distance(center) - current.radius - radius;
            if distance > 0.0 { current.strength / (distance * distance) } else { f64::INFINITY }
        };
        let mut sum = 0.0;
        for (group, edges) in &self.groups {
            let far = group.center.distance(center) > 3.0 * group.radius + radius;
            sum += if far { slope(group) } else { edges.iter().map(slope).sum() };
            if sum > useless {
                return None;
            }
        }
        Some(sum)
    }
}
