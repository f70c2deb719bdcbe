//! What a triangle mesh is as a surface: its edges, parts and orientation, read from the indices alone.
//!
//! An edge of a closed, consistently oriented surface is used by exactly two triangles, once in each direction. Everything
//! else is named here: *boundary* (one triangle), *non-manifold* (three or more), *misoriented* (two, both in the same
//! direction). The *boundary chain* is the algebraic version of the same: how often each edge is used forwards minus
//! backwards. It is empty exactly when the winding number of the mesh is an integer everywhere, whether or not
//! the mesh is manifold.

use rayon::prelude::*;

use super::TriangleMesh;

/// One use of an undirected edge by a triangle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct EdgeUse {
    /// Smaller vertex index in the upper half, larger in the lower.
    pub key: u64,
    /// The triangle.
    pub triangle: u32,
    /// Whether the triangle runs from the smaller index to the larger.
    pub forward: bool,
}

impl EdgeUse {
    /// The two vertex indices, smaller first.
    pub fn vertices(&self) -> [u32; 2] {
        [(self.key >> 32) as u32, self.key as u32]
    }
}

/// All uses of edges by triangles, grouped by edge: sorted by edge, then triangle. Collapsed edges are left out.
pub(crate) fn edge_uses(triangles: &[[u32; 3]]) -> Vec<EdgeUse> {
    let uses = |t: usize| {
        let [a, b, c] = triangles[t];
        [(a, b), (b, c), (c, a)].into_iter().filter(|(from, to)| from != to).map(move |(from, to)| {
            let key = (from.min(to) as u64) << 32 | from.max(to) as u64;
            EdgeUse { key, triangle: t as u32, forward: from < to }
        })
    };
    sort_by_vertex(triangles, uses, |u| (u.key >> 32) as u32)
}

/// The vertices of each triangle in ascending order, and the triangle: sorted, so that duplicates follow each other.
pub(crate) fn sorted_triangles(triangles: &[[u32; 3]]) -> Vec<([u32; 3], u32)> {
    sort_by_vertex(triangles, |t| [(sorted(triangles[t]), t as u32)].into_iter(), |&(v, _)| v[0])
}

/// What `items` gives for every triangle, sorted. `vertex`, by which the items must be sorted first, is one of the triangle's: the few
/// items of each vertex are gathered by counting, so that only they are compared.
fn sort_by_vertex<T: Copy + Ord + Send, I: Iterator<Item = T>>(
    triangles: &[[u32; 3]],
    items: impl Fn(usize) -> I,
    vertex: impl Fn(&T) -> u32 + Sync,
) -> Vec<T> {
    let vertices = triangles.iter().flatten().max().map_or(0, |&v| v as usize + 1);
    let mut next = vec![0usize; vertices + 1];
    // `for_each`, since the loop of a nested iterator asks after each item whether the inner one has ended.
    (0..triangles.len()).flat_map(&items).for_each(|item| next[vertex(&item) as usize + 1] += 1);
    for v in 0..vertices {
        next[v + 1] += next[v];
    }
    let Some(any) = (0..triangles.len()).flat_map(&items).next() else { return Vec::new() };
    let mut sorted = vec![any; next[vertices]];
    (0..triangles.len()).flat_map(&items).for_each(|item| {
        let at = &mut next[vertex(&item) as usize];
        sorted[*at] = item;
        *at += 1;
    });
    sorted.par_chunk_by_mut(|a, b| vertex(a) == vertex(b)).for_each(<[T]>::sort_unstable);
    sorted
}

/// The uses of one edge after the other.
pub(crate) fn by_edge(uses: &[EdgeUse]) -> impl Iterator<Item = &[EdgeUse]> {
    uses.chunk_by(|a, b| a.key == b.key)
}

/// The algebraic boundary: directed edges with the number of times that they bound the mesh (never 0).
pub(crate) fn boundary_chain(uses: &[EdgeUse]) -> Vec<([u32; 2], i32)> {
    by_edge(uses)
        .filter_map(|edge| {
            let net: i32 = edge.iter().map(|u| if u.forward { 1 } else { -1 }).sum();
            (net != 0).then(|| (edge[0].vertices(), net))
        })
        .collect()
}

/// Disjoint sets over `0..n`; the root of a set is its smallest member, so labels do not depend on the order of unions.
pub(crate) struct DisjointSets(Vec<u32>);

impl DisjointSets {
    pub fn new(n: usize) -> Self {
        Self((0..n as u32).collect())
    }

    pub fn root(&mut self, mut i: u32) -> u32 {
        while self.0[i as usize] != i {
            let parent = self.0[i as usize];
            self.0[i as usize] = self.0[parent as usize];
            i = parent;
        }
        i
    }

    pub fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

/// The surface properties of a mesh as its indices define it: vertices at the same place are different vertices.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Topology {
    /// Edges used by exactly one triangle.
    pub boundary_edges: usize,
    /// Edges used by three triangles or more.
    pub non_manifold_edges: usize,
    /// Edges used by two triangles in the same direction.
    pub misoriented_edges: usize,
    /// Triangles whose three vertices are those of an earlier triangle, in any order.
    pub duplicate_triangles: usize,
    /// Triangles with a repeated vertex or no area.
    pub degenerate_triangles: usize,
    /// Vertices that no triangle uses.
    pub unreferenced_vertices: usize,
    /// Connected parts (triangles that share an edge are connected).
    pub parts: usize,
    /// Whether every edge is used by two triangles, once in each direction.
    pub closed: bool,
    /// Vertices in use − edges + triangles.
    pub euler_characteristic: i64,
    /// Enclosed volume, negative when the triangles face inwards; for an open mesh it depends on the origin.
    pub signed_volume: f64,
}

/// Examines `mesh`, whose indices must be in range.
pub fn analyze(mesh: &TriangleMesh) -> Topology {
    analyze_edges(mesh, &edge_uses(&mesh.triangles))
}

/// [`analyze`], given the mesh's edge uses.
pub(crate) fn analyze_edges(mesh: &TriangleMesh, uses: &[EdgeUse]) -> Topology {
    let (of_edges, of_triangles) = rayon::join(|| EdgeCounts::new(mesh, uses), || TriangleCounts::new(mesh));
    let EdgeCounts { edges, boundary, misoriented, non_manifold, parts, twins } = of_edges;
    let TriangleCounts { degenerate, used, signed_volume } = of_triangles;
    // A triangle of one vertex has no edge that would show its twin.
    let duplicates = if twins || degenerate > 0 {
        sorted_triangles(&mesh.triangles).windows(2).filter(|w| w[0].0 == w[1].0).count()
    } else {
        0
    };
    Topology {
        boundary_edges: boundary,
        non_manifold_edges: non_manifold,
        misoriented_edges: misoriented,
        duplicate_triangles: duplicates,
        degenerate_triangles: degenerate,
        unreferenced_vertices: mesh.positions.len() - used,
        parts,
        closed: !mesh.triangles.is_empty() && boundary + non_manifold + misoriented == 0,
        euler_characteristic: used as i64 - edges as i64 + mesh.triangles.len() as i64,
        signed_volume,
    }
}

/// What the edges tell.
#[derive(Default)]
struct EdgeCounts {
    edges: usize,
    boundary: usize,
    misoriented: usize,
    non_manifold: usize,
    parts: usize,
    /// Whether an edge has two triangles with the same third vertex.
    twins: bool,
}

impl EdgeCounts {
    fn new(mesh: &TriangleMesh, uses: &[EdgeUse]) -> Self {
        let mut counts = Self::default();
        let mut sets = DisjointSets::new(mesh.triangles.len());
        let third = |u: &EdgeUse| {
            let ([a, b, c], [from, to]) = (mesh.triangles[u.triangle as usize], u.vertices());
            a ^ b ^ c ^ from ^ to
        };
        for edge in by_edge(uses) {
            counts.edges += 1;
            match edge {
                [_] => counts.boundary += 1,
                [a, b] => {
                    counts.misoriented += usize::from(a.forward == b.forward);
                    counts.twins |= third(a) == third(b);
                }
                _ => {
                    counts.non_manifold += 1;
                    let mut thirds: Vec<u32> = edge.iter().map(third).collect();
                    thirds.sort_unstable();
                    counts.twins |= thirds.windows(2).any(|pair| pair[0] == pair[1]);
                }
            }
            for pair in edge.windows(2) {
                sets.join(pair[0].triangle, pair[1].triangle);
            }
        }
        counts.parts = (0..mesh.triangles.len() as u32).filter(|&t| sets.root(t) == t).count();
        counts
    }
}

/// What the triangles tell one by one.
struct TriangleCounts {
    degenerate: usize,
    /// Vertices in use.
    used: usize,
    signed_volume: f64,
}

impl TriangleCounts {
    fn new(mesh: &TriangleMesh) -> Self {
        let mut used = vec![false; mesh.positions.len()];
        mesh.triangles.iter().flatten().for_each(|&v| used[v as usize] = true);
        Self {
            degenerate: (0..mesh.triangles.len()).filter(|&t| is_degenerate(mesh, t)).count(),
            used: used.iter().filter(|&&u| u).count(),
            signed_volume: signed_volume(mesh),
        }
    }
}

/// The vertices of a triangle in ascending order: equal for duplicates, whatever their winding.
pub(crate) fn sorted(mut triangle: [u32; 3]) -> [u32; 3] {
    triangle.sort_unstable();
    triangle
}

/// Whether a triangle repeats a vertex or has exactly no area.
pub(crate) fn is_degenerate(mesh: &TriangleMesh, t: usize) -> bool {
    let [a, b, c] = mesh.corners(t);
    (b - a).cross(c - a) == glam::DVec3::ZERO
}

/// Volume enclosed by the triangles, summed about the middle of the bounding box so that distant meshes keep their digits.
pub(crate) fn signed_volume(mesh: &TriangleMesh) -> f64 {
    let Some((lo, hi)) = mesh.bounding_box() else { return 0.0 };
    let middle = lo + (hi - lo) * 0.5;
    sum_of_triangles(mesh.triangles.len(), |t| volume_about(middle, mesh.corners(t)))
}

/// A sum over so many triangles, in parts of fixed length: the same bits with any number of threads.
pub(crate) fn sum_of_triangles(count: usize, of: impl Fn(usize) -> f64 + Sync) -> f64 {
    const LENGTH: usize = 4096;
    let part = |i: usize| (i * LENGTH..count.min((i + 1) * LENGTH)).map(&of).sum();
    let parts: Vec<f64> = (0..count.div_ceil(LENGTH)).into_par_iter().map(part).collect();
    parts.iter().sum()
}

/// Signed volume of the tetrahedron of `origin` and a triangle.
pub(crate) fn volume_about(origin: glam::DVec3, [a, b, c]: [glam::DVec3; 3]) -> f64 {
    (a - origin).dot((b - origin).cross(c - origin)) / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::testing::{cube, tetrahedron};
    use glam::DVec3;

    #[test]
    fn a_cube_is_closed_and_its_volume_is_exact() {
        let mesh = cube(DVec3::new(100.0, -3.0, 7.0), 2.0);
        let topology = analyze(&mesh);
        assert!(topology.closed);
        assert_eq!((topology.parts, topology.euler_characteristic), (1, 2));
        assert!((topology.signed_volume - 8.0).abs() < 1e-12);
        assert!(boundary_chain(&edge_uses(&mesh.triangles)).is_empty());
    }

    #[test]
    fn every_defect_is_counted_once() {
        let mut mesh = cube(DVec3::ZERO, 1.0);
        mesh.triangles.pop();
        let open = analyze(&mesh);
        assert_eq!((open.boundary_edges, open.closed), (3, false));

        let mut mesh = cube(DVec3::ZERO, 1.0);
        mesh.triangles[0].swap(0, 1);
        let flipped = analyze(&mesh);
        assert_eq!((flipped.misoriented_edges, flipped.boundary_edges, flipped.closed), (3, 0, false));

        let mut mesh = tetrahedron();
        mesh.triangles.push(mesh.triangles[2]);
        mesh.triangles.push([0, 1, 1]);
        mesh.positions.push(DVec3::ONE);
        let messy = analyze(&mesh);
        assert_eq!((messy.duplicate_triangles, messy.degenerate_triangles, messy.unreferenced_vertices), (1, 1, 1));
    }

    #[test]
    fn an_empty_mesh_is_not_closed() {
        assert_eq!(analyze(&TriangleMesh::default()), Topology::default());
    }
}
