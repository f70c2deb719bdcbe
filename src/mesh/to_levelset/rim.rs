//! The boundary of an open mesh, and how fast its winding number can change because of it.
//!
//! Away from the triangles the winding number w of an open mesh is smooth; at a triangle it jumps by one. Its gradient is the
//! magnetic field of a current along the mesh's boundary (Biot and Savart): with the boundary's elements dl at r before a point,
//! ∇w = 1/4π Σ dl × r/|r|³, so |∇w| ≤ Σ ℓ/(4π d²) over pieces of length ℓ at distance d. The matrix of its second derivatives
//! is 1/4π Σ dl × ∇(r/|r|³), and ∇(r/|r|³) has the eigenvalues (−2, 1, 1)/|r|³: |w_xx| + |w_yy| + |w_zz| ≤ Σ 4ℓ/(4π d³).

use std::f64::consts::PI;

use glam::DVec3;

/// The error of fast winding numbers, doubled.
pub(super) const WINDING_ERROR: f64 = 0.02;
/// The longest piece of boundary that is seen as one, in voxels: pieces are bounded by balls, which hide what lies beside long ones.
const PIECE: f64 = 1.0;
/// Pieces are longer where there would be more than about this many.
const MOST_PIECES: f64 = 1e5;
/// Groups of pieces are not divided further than to this many.
const FEW: usize = 4;

/// A piece of the mesh's boundary as a current: a ball that holds it and its length times multiplicity, over 4π.
#[derive(Clone, Copy)]
struct Current {
    center: DVec3,
    radius: f64,
    strength: f64,
}

/// The boundary of a mesh as currents, in a tree.
pub(super) struct Rim {
    /// Groups of pieces, each before its parts, and the pieces themselves.
    nodes: Vec<Node>,
}

struct Node {
    current: Current,
    /// The next node that is not a part of this one.
    next: usize,
}

impl Rim {
    /// Of the boundary chain of an indexed mesh; empty if it is closed.
    pub fn new(positions: &[DVec3], chain: &[([u32; 2], i32)]) -> Self {
        let ends = |edge: [u32; 2]| edge.map(|v| positions[v as usize]);
        let total: f64 = chain.iter().map(|&(edge, _)| ends(edge)).map(|[a, b]| a.distance(b)).sum();
        let longest = PIECE.max(total / MOST_PIECES);
        let pieces = chain.iter().flat_map(|&(edge, multiplicity)| {
            let [a, b] = ends(edge);
            let count = (a.distance(b) / longest).ceil().max(1.0);
            let length = a.distance(b) / count;
            let strength = length * multiplicity.unsigned_abs() as f64 / (4.0 * PI);
            let center = move |i| a.lerp(b, (f64::from(i) + 0.5) / count);
            (0..count as u32).map(move |i| Current { center: center(i), radius: 0.5 * length, strength })
        });
        let mut nodes = Vec::new();
        add_groups(&mut pieces.collect::<Vec<_>>(), &mut nodes);
        Self { nodes }
    }

    /// Whether there is no boundary.
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    /// A bound of |∇w| away from triangles in the ball around `center`; `None` if it exceeds `useless`.
    pub fn steepest(&self, center: DVec3, radius: f64, useless: f64) -> Option<f64> {
        self.sum(center, radius, useless, |d| 1.0 / (d * d))
    }

    /// A bound of |w_xx| + |w_yy| + |w_zz| there.
    pub fn most_bent(&self, center: DVec3, radius: f64, useless: f64) -> Option<f64> {
        self.sum(center, radius, useless, |d| 4.0 / (d * d * d))
    }

    /// An upper bound of the sum of strengths times `falloff` of the distance, at any point of a ball.
    #[inline(always)]
    fn sum(&self, center: DVec3, radius: f64, useless: f64, falloff: impl Fn(f64) -> f64) -> Option<f64> {
        let mut sum = 0.0;
        let mut at = 0;
        while let Some(Node { current, next }) = self.nodes.get(at) {
            let distance = current.center.distance(center) - current.radius - radius;
            if *next > at + 1 && distance < 2.0 * current.radius {
                at += 1;
                continue;
            }
            if distance <= 0.0 {
                return None;
            }
            sum += current.strength * falloff(distance);
            if sum > useless {
                return None;
            }
            at = *next;
        }
        Some(sum)
    }
}

/// Adds a group of pieces to the nodes of a tree, and its halves along the axis in which it extends farthest.
fn add_groups(pieces: &mut [Current], nodes: &mut Vec<Node>) {
    if pieces.is_empty() {
        return;
    }
    let center = pieces.iter().map(|e| e.center).sum::<DVec3>() / pieces.len() as f64;
    let radius = pieces.iter().map(|e| e.center.distance(center) + e.radius).fold(0.0, f64::max);
    let at = nodes.len();
    let strength = pieces.iter().map(|e| e.strength).sum();
    nodes.push(Node { current: Current { center, radius, strength }, next: 0 });
    if pieces.len() > FEW {
        let spread = pieces.iter().fold(DVec3::ZERO, |spread, e| spread.max((e.center - center).abs()));
        let axis = (0..3).fold(0, |best, axis| if spread[axis] > spread[best] { axis } else { best });
        let middle = pieces.len() / 2;
        pieces.select_nth_unstable_by(middle, |a, b| a.center[axis].total_cmp(&b.center[axis]));
        let (low, high) = pieces.split_at_mut(middle);
        add_groups(low, nodes);
        add_groups(high, nodes);
    } else if pieces.len() > 1 {
        for &mut current in pieces {
            nodes.push(Node { current, next: nodes.len() + 1 });
        }
    }
    nodes[at].next = nodes.len();
}
