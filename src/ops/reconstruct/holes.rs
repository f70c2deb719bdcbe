//! What no map sees of a surface, and the colours of what some see.

use glam::DVec3;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::term::{Term, View};
use crate::levelset::UnionFind;
use crate::mesh::{TriangleMesh, linear_from_srgb8};

/// Holes that are listed.
const LISTED: usize = 20;

/// The parts of a surface that fill holes of the maps.
pub(super) struct Holes {
    /// World units squared.
    pub area: f64,
    /// Of the whole area.
    pub part: f64,
    /// The largest connected parts: area, centre.
    pub largest: Vec<Value>,
}

/// What the maps see of the vertices of a surface, map by map.
pub(super) struct Seen {
    seen: Vec<bool>,
    /// Linear colours times weights, and their sum; none if no map has colours.
    colors: Vec<([f64; 3], f64)>,
}

impl Seen {
    /// Nothing yet.
    pub fn new(terms: &[Term], mesh: &TriangleMesh) -> Self {
        let vertices = mesh.positions.len();
        let colored = terms.iter().any(|term| !term.map.colors.is_empty());
        Self { seen: vec![false; vertices], colors: vec![([0.0; 3], 0.0); if colored { vertices } else { 0 }] }
    }

    /// Adds what a map sees.
    pub fn add(&mut self, term: &Term, mesh: &TriangleMesh, views: &[View]) {
        self.seen.iter_mut().zip(views).for_each(|(seen, view)| *seen |= view.is_seen());
        if term.map.colors.is_empty() {
            return;
        }
        self.colors.par_iter_mut().zip(views).zip(&mesh.positions).for_each(|(((sum, weights), view), p)| {
            let color = Some(p).filter(|_| view.is_seen()).and_then(|p| term.map.color(&term.to_scanner, *p));
            if let Some(color) = color {
                let weight = f64::from(view.weight) * f64::from(view.cosine);
                let linear = linear_from_srgb8(color);
                *sum = std::array::from_fn(|k| sum[k] + weight * f64::from(linear[k]));
                *weights += weight;
            }
        });
    }

    /// What no map sees: triangles none of whose corners is seen.
    pub fn holes(&self, mesh: &TriangleMesh) -> Holes {
        find(&self.seen, mesh)
    }

    /// A colour for each vertex, linear: the mean of what the maps saw there, and beyond that of the nearest vertices along the surface that are seen. `None`
    /// if no map has colours.
    pub fn colors(&self, mesh: &TriangleMesh) -> Option<Vec<[f32; 4]>> {
        let of_vertex = |&(sum, weights): &([f64; 3], f64)| (weights > 0.0).then(|| sum.map(|s| (s / weights) as f32));
        (!self.colors.is_empty()).then(|| spread(self.colors.iter().map(of_vertex).collect(), mesh))
    }
}

fn find(seen: &[bool], mesh: &TriangleMesh) -> Holes {
    let is_seen = |v: u32| seen.get(v as usize).copied().unwrap_or(false);
    let area_of = |t: usize| {
        let [a, b, c] = mesh.corners(t);
        (b - a).cross(c - a).length() / 2.0
    };
    let whole: f64 = (0..mesh.triangles.len()).map(area_of).sum();
    let unseen: Vec<usize> =
        (0..mesh.triangles.len()).filter(|&t| !mesh.triangles[t].iter().any(|v| is_seen(*v))).collect();
    let joined = UnionFind::new(mesh.positions.len());
    for &t in &unseen {
        let [a, b, c] = mesh.triangles[t];
        joined.join(a, b);
        joined.join(b, c);
    }
    // Area and area-weighted centre, by the root.
    let mut holes: std::collections::BTreeMap<u32, (f64, DVec3)> = std::collections::BTreeMap::new();
    for &t in &unseen {
        let (area, [a, b, c]) = (area_of(t), mesh.corners(t));
        let hole = holes.entry(joined.root(mesh.triangles[t][0])).or_default();
        (hole.0, hole.1) = (hole.0 + area, hole.1 + (a + b + c) * (area / 3.0));
    }
    // The sum of nothing would be −0.
    let area = holes.values().fold(0.0, |sum, hole| sum + hole.0);
    let mut largest: Vec<(f64, DVec3)> = holes.into_values().filter(|hole| hole.0 > 0.0).collect();
    largest.sort_by(|a, b| b.0.total_cmp(&a.0));
    largest.truncate(LISTED);
    let told = |(area, sum): (f64, DVec3)| json!({ "area": area, "centre": (sum / area).to_array() });
    Holes { area, part: area / whole.max(f64::MIN_POSITIVE), largest: largest.into_iter().map(told).collect() }
}

/// Colours of all vertices, from those of some.
fn spread(mut found: Vec<Option<[f32; 3]>>, mesh: &TriangleMesh) -> Vec<[f32; 4]> {
    let mut beside: Vec<Vec<u32>> = vec![Vec::new(); found.len()];
    for &[a, b, c] in &mesh.triangles {
        for (v, w) in [(a, b), (b, c), (c, a)] {
            beside[v as usize].push(w);
        }
    }
    let mut front: Vec<u32> = (0..found.len() as u32).filter(|&v| found[v as usize].is_some()).collect();
    while !front.is_empty() {
        let mut next = Vec::new();
        for v in front {
            for &w in &beside[v as usize] {
                if found[w as usize].is_none() {
                    found[w as usize] = found[v as usize];
                    next.push(w);
                }
            }
        }
        front = next;
    }
    let grey = [0.5; 3];
    found.into_iter().map(|color| color.unwrap_or(grey)).map(|[r, g, b]| [r, g, b, 1.0]).collect()
}
