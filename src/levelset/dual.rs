//! The vertices of one cell in a dual mesh, one for each piece of surface, for the 256 sign patterns.
//!
//! A dual mesh has a vertex in each crossed cell and a polygon around each crossed grid edge. With one vertex for each loop
//! of [`marching`](super::marching) it is the dual of that surface, and as manifold (Nielson 2004, Dual Marching Cubes),
//! save one case: where both segments of an ambiguous face belong to one loop on either side, two edges of the dual mesh
//! join the same two vertices, and four polygons meet there. Both cells then decide that face the other way round
//! (Wenger 2013, Isosurfaces): each of the two loops falls into two, and the edges part. Such a face is the bridge
//! of a voxel's width between two outside voxels, so a tunnel may close there that the triangle mesh keeps open.

use std::sync::LazyLock;

use super::marching::{Edge, doubled_face, loops};

/// Which vertex of a cell each of its crossed edges belongs to.
#[derive(Debug)]
pub(crate) struct DualCase {
    /// The crossed edges around each vertex of the cell.
    pub loops: Vec<Vec<Edge>>,
    /// The vertex by edge; 0 for edges that are not crossed.
    pub vertex_of: [u8; 12],
}

impl DualCase {
    fn new(loops: Vec<Vec<Edge>>) -> Self {
        let mut vertex_of = [0; 12];
        for (vertex, edges) in (0..).zip(&loops) {
            edges.iter().for_each(|&e| vertex_of[usize::from(e)] = vertex);
        }
        Self { loops, vertex_of }
    }
}

struct Cases {
    plain: DualCase,
    /// The face with both segments in one loop, and the case with that face decided the other way.
    turned: Option<(u8, DualCase)>,
}

fn cases(pattern: u8) -> &'static Cases {
    static CASES: LazyLock<Vec<Cases>> = LazyLock::new(|| {
        let derive = |pattern| Cases {
            plain: DualCase::new(loops(pattern, None)),
            turned: doubled_face(pattern).map(|face| (face, DualCase::new(loops(pattern, Some(face))))),
        };
        (0..=255).map(derive).collect()
    });
    &CASES[usize::from(pattern)]
}

/// The vertices of a cell with the given signs; `beyond` gives the signs of the neighbour across a face (axis·2, + 1 on the
/// upper side) and is asked in few cases.
#[inline]
pub(crate) fn dual_case(pattern: u8, beyond: impl FnOnce(u8) -> u8) -> &'static DualCase {
    let cases = cases(pattern);
    match &cases.turned {
        Some((face, turned)) if cases_meet(beyond(*face), face ^ 1) => turned,
        _ => &cases.plain,
    }
}

fn cases_meet(pattern: u8, face: u8) -> bool {
    cases(pattern).turned.as_ref().is_some_and(|(doubled, _)| *doubled == face)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::marching::cell_case;

    #[test]
    fn every_crossed_edge_has_one_vertex_and_turned_faces_part() {
        let mut turned_cases = 0;
        for pattern in 0..=255u8 {
            let Cases { plain, turned } = cases(pattern);
            assert_eq!(plain.loops.len(), cell_case(pattern).loops as usize);
            for case in std::iter::once(plain).chain(turned.as_ref().map(|t| &t.1)) {
                let mut edges: Vec<Edge> = case.loops.concat();
                edges.sort_unstable();
                let crossed: Vec<Edge> = (0..12).filter(|e| cell_case(pattern).crossed >> e & 1 == 1).collect();
                assert_eq!(edges, crossed, "{pattern:08b}");
                assert!(case.loops.iter().all(|edges| edges.len() >= 3), "{pattern:08b}");
            }
            if let Some((_, case)) = turned {
                assert_eq!((plain.loops.len(), case.loops.len()), (1, 2), "{pattern:08b}");
                turned_cases += 1;
            }
        }
        assert_eq!(turned_cases, 36);
    }
}
