//! A tree of boxes over triangles: closest points, and the groups for winding numbers.
//!
//! The tree is built by `obvhs` (PLOC) over boxes in f32 about the middle of all, rounded outwards so that they hold the f64
//! triangles; everything computed on it is f64.

use glam::{DVec3, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::leaf_collapser::collapse;
use obvhs::ploc::{PlocBuilder, PlocSearchDistance, SortPrecision};

use super::closest::{closest_on_triangle, distance_squared_to_box};

/// Triangles in a leaf at most. More make winding numbers slower (all are summed), fewer make the tree deeper.
const LEAF_TRIANGLES: u32 = 6;

/// What lies below a node.
pub(crate) enum Children<'a> {
    /// Two nodes, both behind their parent.
    Nodes([usize; 2]),
    /// The triangles of a leaf.
    Triangles(&'a [[DVec3; 3]]),
}

/// The nearest point of a set of triangles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index of the triangle in the order in which they were given; the smallest of equally near ones.
    pub triangle: u32,
    /// The point on it.
    pub point: DVec3,
    /// Square of its distance.
    pub distance_squared: f64,
}

/// Triangles in a tree of boxes.
pub struct Bvh {
    tree: Bvh2,
    /// What the boxes are relative to.
    middle: DVec3,
    /// In the order of the tree's leaves.
    triangles: Vec<[DVec3; 3]>,
}

impl Bvh {
    /// Builds the tree. Coordinates must be finite, and their extent within the range of f32.
    pub fn new(triangles: Vec<[DVec3; 3]>) -> Self {
        let corners = || triangles.iter().flatten();
        let lo = corners().fold(DVec3::INFINITY, |lo, c| lo.min(*c));
        let hi = corners().fold(DVec3::NEG_INFINITY, |hi, c| hi.max(*c));
        let middle = if triangles.is_empty() { DVec3::ZERO } else { lo + (hi - lo) * 0.5 };
        let boxes: Vec<Aabb> = triangles
            .iter()
            .map(|[a, b, c]| {
                let down = (a.min(*b).min(*c) - middle).to_array().map(|v| (v as f32).next_down());
                let up = (a.max(*b).max(*c) - middle).to_array().map(|v| (v as f32).next_up());
                Aabb::new(Vec3A::from_array(down), Vec3A::from_array(up))
            })
            .collect();
        let indices = (0..triangles.len() as u32).collect();
        let mut tree = PlocBuilder::new().build(PlocSearchDistance::VeryLow, &boxes, indices, SortPrecision::U64, 2);
        collapse(&mut tree, LEAF_TRIANGLES, 2.0);
        tree.reorder_in_stack_traversal_order();
        let triangles = tree.primitive_indices.iter().map(|&t| triangles[t as usize]).collect();
        Self { tree, middle, triangles }
    }

    /// Number of nodes; 0 without triangles.
    pub(crate) fn node_count(&self) -> usize {
        if self.triangles.is_empty() { 0 } else { self.tree.nodes.len() }
    }

    /// What lies below `node`.
    #[inline]
    pub(crate) fn children(&self, node: usize) -> Children<'_> {
        let node = &self.tree.nodes[node];
        let first = node.first_index as usize;
        if node.is_leaf() {
            Children::Triangles(&self.triangles[first..first + node.prim_count as usize])
        } else {
            Children::Nodes([first, first + 1])
        }
    }

    /// The box of `node`.
    pub(crate) fn node_box(&self, node: usize) -> (DVec3, DVec3) {
        let aabb = self.tree.nodes[node].aabb();
        (aabb.min.as_dvec3() + self.middle, aabb.max.as_dvec3() + self.middle)
    }

    /// The triangles as given, in an order in which neighbours are near each other: that of a walk through the tree.
    pub(crate) fn order(&self) -> Vec<u32> {
        let mut order = Vec::with_capacity(self.triangles.len());
        let mut stack = Vec::new();
        if self.node_count() > 0 {
            stack.push(0);
        }
        while let Some(node) = stack.pop() {
            match self.children(node) {
                Children::Nodes(pair) => stack.extend(pair),
                Children::Triangles(list) => {
                    let first = self.tree.nodes[node].first_index as usize;
                    order.extend_from_slice(&self.tree.primitive_indices[first..first + list.len()]);
                }
            }
        }
        order
    }

    /// Whether `f` holds for any triangle whose leaf touches the box.
    pub(crate) fn any_in_box(&self, lo: DVec3, hi: DVec3, f: impl Fn(u32) -> bool) -> bool {
        let mut stack = smallvec::SmallVec::<[usize; 64]>::new();
        if self.node_count() > 0 {
            stack.push(0);
        }
        while let Some(node) = stack.pop() {
            let (node_lo, node_hi) = self.node_box(node);
            if node_lo.cmpgt(hi).any() || node_hi.cmplt(lo).any() {
                continue;
            }
            match self.children(node) {
                Children::Nodes(pair) => stack.extend(pair),
                Children::Triangles(list) => {
                    let first = self.tree.nodes[node].first_index as usize;
                    for (i, [a, b, c]) in list.iter().enumerate() {
                        let apart = a.min(*b).min(*c).cmpgt(hi).any() || a.max(*b).max(*c).cmplt(lo).any();
                        if !apart && f(self.tree.primitive_indices[first + i]) {
                            return true;
                        }
                    }
                }
            }
        }
        false
    }

    /// The nearest point to `p` on any triangle, if it is not farther than `max_distance`.
    pub fn closest_point(&self, p: DVec3, max_distance: f64) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        let mut limit = max_distance * max_distance;
        let mut stack = smallvec::SmallVec::<[(f64, usize); 64]>::new();
        let to_box = |node: usize| {
            let (lo, hi) = self.node_box(node);
            distance_squared_to_box(p, lo, hi)
        };
        if self.node_count() > 0 {
            stack.push((to_box(0), 0));
        }
        while let Some((distance, node)) = stack.pop() {
            if distance > limit {
                continue;
            }
            match self.children(node) {
                Children::Nodes(pair) => {
                    let [a, b] = pair.map(|n| (to_box(n), n));
                    // The nearer one on top.
                    let (near, far) = if a.0 <= b.0 { (a, b) } else { (b, a) };
                    stack.extend([far, near].into_iter().filter(|(d, _)| *d <= limit));
                }
                Children::Triangles(list) => {
                    let first = self.tree.nodes[node].first_index as usize;
                    for (i, corners) in list.iter().enumerate() {
                        let point = closest_on_triangle(p, *corners);
                        let distance_squared = point.distance_squared(p);
                        let triangle = self.tree.primitive_indices[first + i];
                        let better =
                            best.is_none_or(|b| (distance_squared, triangle) < (b.distance_squared, b.triangle));
                        if distance_squared <= limit && better {
                            best = Some(Hit { triangle, point, distance_squared });
                            limit = distance_squared;
                        }
                    }
                }
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::testing::*;
    use proptest::prelude::*;

    #[test]
    fn an_empty_tree_has_no_nearest_point() {
        assert_eq!(Bvh::new(Vec::new()).closest_point(DVec3::ZERO, 1e9), None);
    }

    #[test]
    fn one_triangle_is_a_tree() {
        let bvh = Bvh::new(vec![[DVec3::X, DVec3::Y, DVec3::Z]]);
        let hit = bvh.closest_point(DVec3::ZERO, 1.0).unwrap();
        assert!(hit.triangle == 0 && (hit.point - DVec3::splat(1.0 / 3.0)).length() < 1e-15);
        assert_eq!(bvh.closest_point(DVec3::ZERO, 0.5), None, "beyond the limit");
    }

    #[test]
    fn the_nearest_point_of_a_fine_sphere_is_on_the_ray() {
        // Far away, where the boxes would not tell the triangles apart if they were not relative to the middle.
        let center = DVec3::new(4e8, -7.0, 3.0);
        let mesh = sphere(center, 10.0, 100);
        let bvh = Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
        for i in 0..200 {
            let p = center + 40.0 * (DVec3::new(noise(i), noise(i + 1000), noise(i + 2000)) - 0.5);
            let hit = bvh.closest_point(p, f64::INFINITY).unwrap();
            let truth = ((p - center).length() - 10.0).abs();
            // The chord of a facet of edge 2πr/200 falls short of the sphere by r(1 − cos(π/200)), twice for the diagonal.
            assert!((hit.distance_squared.sqrt() - truth).abs() < 0.003, "{hit:?} {truth}");
        }
    }

    proptest! {
        #[test]
        fn the_tree_finds_what_a_search_through_all_finds(
            coordinates in prop::collection::vec(-8i32..8, 9..180),
            p in prop::array::uniform3(-20.0f64..20.0),
        ) {
            // Integer corners: many degenerate, coincident and touching triangles, and ties.
            let triangles: Vec<[DVec3; 3]> = coordinates
                .chunks_exact(9)
                .map(|c| [0, 3, 6].map(|k| DVec3::new(c[k] as f64, c[k + 1] as f64, c[k + 2] as f64)))
                .collect();
            let p = DVec3::from_array(p);
            let brute = (0u32..).zip(&triangles)
                .map(|(t, c)| (closest_on_triangle(p, *c).distance_squared(p), t))
                .min_by(|a, b| a.partial_cmp(b).unwrap())
                .unwrap();
            let hit = Bvh::new(triangles).closest_point(p, f64::INFINITY).unwrap();
            prop_assert_eq!((hit.distance_squared, hit.triangle), brute);
        }
    }
}
