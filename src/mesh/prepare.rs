//! From a mesh as it came from a file to the best oriented surface that its triangles make.
//!
//! In this order: equal vertices are joined; triangles without area are dropped; duplicates are resolved; if edges stay
//! open, nearly equal vertices on them are joined too (cracks of exporters that round each corner by itself); orientation
//! is spread over edges of two triangles; parts and the whole are turned outwards. Every step is deterministic and
//! goes into the [`MeshFindings`]. What cannot be repaired here, holes and intersections, is left to the winding number.

use std::collections::VecDeque;
use std::hash::BuildHasher;

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::{FxBuildHasher, FxHashMap, FxHashSet};

use super::topology::{
    DisjointSets, EdgeUse, analyze_edges, by_edge, edge_uses, is_degenerate, signed_volume, sorted_triangles,
    volume_about,
};
use super::winding::solid_angle;
use super::{Bvh, MeshFindings, TriangleMesh, WindingNumber, analyze};

/// How near two vertices on open edges must be to be joined, relative to the diagonal of the bounding box. Exporters
/// that write f32 move a corner by 1e-7 of the coordinates; real gaps of models are above 1e-4.
const CRACK_TOLERANCE: f64 = 2e-6;

/// Cleans and orients `mesh`, whose indices must be in range and positions finite. Colours and texture coordinates are left
/// behind: they have no part in a level set.
pub fn prepare(mesh: &TriangleMesh) -> (TriangleMesh, MeshFindings) {
    let mut findings = MeshFindings::default();
    let (positions, triangles) = rayon::join(|| mesh.positions.clone(), || mesh.triangles.clone());
    let mut clean = TriangleMesh { positions, triangles, ..Default::default() };
    findings.welded_equal = weld_equal(&mut clean);
    let mut uses = edge_uses(&clean.triangles);
    findings.found = analyze_edges(&clean, &uses);
    if findings.found.degenerate_triangles + findings.found.duplicate_triangles > 0 {
        findings.degenerate_dropped += drop_degenerate(&mut clean);
        resolve_duplicates(&mut clean, &mut findings);
        uses = edge_uses(&clean.triangles);
    }
    if by_edge(&uses).any(|edge| edge.len() == 1) {
        findings.welded_near = weld_cracks(&mut clean, &uses);
        if findings.welded_near > 0 {
            findings.degenerate_dropped += drop_degenerate(&mut clean);
            resolve_duplicates(&mut clean, &mut findings);
            uses = edge_uses(&clean.triangles);
        }
    }
    // `found` is of the mesh as it still is, if nothing was dropped or joined.
    let changes = findings.degenerate_dropped + findings.duplicates_dropped + findings.cancelled + findings.welded_near;
    let patches = if changes == 0 && findings.found.closed && findings.found.parts == 1 {
        Patches::one(clean.triangles.len())
    } else {
        Patches::new(&mut clean, &uses, &mut findings)
    };
    drop(uses);
    orient_outwards(&mut clean, &patches, &mut findings);
    let turned = findings.inside_out || findings.reoriented + findings.flipped_parts > 0;
    findings.converted = if changes == 0 && !turned { findings.found.clone() } else { analyze(&clean) };
    findings.converted.unreferenced_vertices = 0;
    (clean, findings)
}

/// Lets every triangle use the first of the vertices that have equal coordinates. Returns how many vertices were joined.
fn weld_equal(mesh: &mut TriangleMesh) -> usize {
    /// About as many vertices are looked through at a time, so that their table stays in the cache.
    const SHARE: usize = 1024;
    let count = (mesh.positions.len() / SHARE).next_power_of_two();
    // Adding zero makes −0 and 0 one key.
    let key = |p: DVec3| (p + DVec3::ZERO).to_array().map(f64::to_bits);
    let mut shares: Vec<Vec<u32>> = (0..count).map(|_| Vec::with_capacity(SHARE)).collect();
    for (v, &p) in (0u32..).zip(&mesh.positions) {
        // Neither the highest nor the lowest bits, which a table goes by.
        shares[(FxBuildHasher.hash_one(key(p)) >> 32) as usize % count].push(v);
    }
    let positions = &mesh.positions;
    let joined = |share: &Vec<u32>| -> Vec<(u32, u32)> {
        let mut first = FxHashMap::with_capacity_and_hasher(share.len(), FxBuildHasher);
        let target = |v: u32| (v, *first.entry(key(positions[v as usize])).or_insert(v));
        share.iter().copied().map(target).filter(|(v, target)| v != target).collect()
    };
    let joined: Vec<Vec<(u32, u32)>> = shares.par_iter().map(joined).collect();
    let count = joined.iter().map(Vec::len).sum();
    if count > 0 {
        let mut target: Vec<u32> = (0..mesh.positions.len() as u32).collect();
        joined.iter().flatten().for_each(|&(v, first)| target[v as usize] = first);
        mesh.triangles.par_iter_mut().for_each(|t| *t = t.map(|v| target[v as usize]));
    }
    count
}

/// Joins vertices at the ends of open edges that lie within [`CRACK_TOLERANCE`] of each other. Returns how many.
fn weld_cracks(mesh: &mut TriangleMesh, uses: &[EdgeUse]) -> usize {
    let Some((lo, hi)) = mesh.bounding_box() else { return 0 };
    let tolerance = CRACK_TOLERANCE * (hi - lo).length();
    if tolerance <= 0.0 {
        return 0;
    }
    let mut rim: Vec<u32> = by_edge(uses).filter(|e| e.len() == 1).flat_map(|e| e[0].vertices()).collect();
    rim.sort_unstable();
    rim.dedup();
    let cell_of = |p: DVec3| ((p - lo) / tolerance).floor().as_i64vec3();
    let mut cells: FxHashMap<glam::I64Vec3, Vec<u32>> = FxHashMap::default();
    let mut sets = DisjointSets::new(mesh.positions.len());
    for &v in &rim {
        let p = mesh.positions[v as usize];
        let cell = cell_of(p);
        for offset in 0..27 {
            let neighbour = cell + glam::I64Vec3::new(offset % 3 - 1, offset / 3 % 3 - 1, offset / 9 - 1);
            for &other in cells.get(&neighbour).into_iter().flatten() {
                if mesh.positions[other as usize].distance(p) <= tolerance {
                    sets.join(v, other);
                }
            }
        }
        cells.entry(cell).or_default().push(v);
    }
    mesh.triangles.iter_mut().flatten().for_each(|v| *v = sets.root(*v));
    rim.iter().filter(|&&v| sets.root(v) != v).count()
}

/// Removes triangles without area. Returns how many.
fn drop_degenerate(mesh: &mut TriangleMesh) -> usize {
    let keep: Vec<bool> = (0..mesh.triangles.len()).map(|t| !is_degenerate(mesh, t)).collect();
    retain(mesh, &keep)
}

/// Keeps the marked triangles. Returns how many were removed.
fn retain(mesh: &mut TriangleMesh, keep: &[bool]) -> usize {
    let before = mesh.triangles.len();
    let mut marks = keep.iter();
    mesh.triangles.retain(|_| marks.next() == Some(&true));
    before - mesh.triangles.len()
}

/// Reduces every set of triangles over the same three vertices to one, or to none where they lie back to back.
///
/// Back to back means wound oppositely, and not needed: where the surface around misses exactly one triangle the first is
/// kept whatever the winding, because in a mesh of random orientation the winding says nothing.
fn resolve_duplicates(mesh: &mut TriangleMesh, findings: &mut MeshFindings) {
    let order = sorted_triangles(&mesh.triangles);
    if order.windows(2).all(|w| w[0].0 != w[1].0) {
        return;
    }
    let uses = edge_uses(&mesh.triangles);
    let valence = |a: u32, b: u32| {
        let key = (a.min(b) as u64) << 32 | a.max(b) as u64;
        uses.partition_point(|u| u.key <= key) - uses.partition_point(|u| u.key < key)
    };
    let mut keep = vec![true; mesh.triangles.len()];
    for group in order.chunk_by(|a, b| a.0 == b.0).filter(|g| g.len() > 1) {
        let even = |t: u32| {
            let [a, b, c] = mesh.triangles[t as usize];
            // A triangle is an even permutation of its sorted vertices, or an odd one.
            [a, b, c] == group[0].0 || [b, c, a] == group[0].0 || [c, a, b] == group[0].0
        };
        let net: i32 = group.iter().map(|&(_, t)| if even(t) { 1 } else { -1 }).sum();
        let [a, b, c] = group[0].0;
        let missing_one =
            [(a, b), (b, c), (c, a)].iter().filter(|(a, b)| (valence(*a, *b) - group.len()) % 2 == 1).count() >= 2;
        let kept = if net == 0 {
            missing_one.then_some(group[0].1)
        } else {
            group.iter().map(|&(_, t)| t).find(|&t| even(t) == (net > 0))
        };
        group.iter().for_each(|&(_, t)| keep[t as usize] = Some(t) == kept);
        match kept {
            Some(_) => findings.duplicates_dropped += group.len() - 1,
            None => findings.cancelled += group.len(),
        }
    }
    retain(mesh, &keep);
}

/// The pieces of surface connected over edges of exactly two triangles, each consistently oriented as far as it can be.
struct Patches {
    /// The patch of each triangle.
    of: Vec<u32>,
    /// Whether each patch has no edge but those between its own triangles.
    closed: Vec<bool>,
}

impl Patches {
    /// Of a surface that is one, closed and consistent.
    fn one(triangles: usize) -> Self {
        Self { of: vec![0; triangles], closed: vec![true] }
    }

    /// Finds the patches and turns over the fewer triangles in each whose neighbours disagree.
    fn new(mesh: &mut TriangleMesh, uses: &[EdgeUse], findings: &mut MeshFindings) -> Self {
        const NONE: u32 = u32::MAX;
        let n = mesh.triangles.len();
        // The neighbour over each of a triangle's manifold edges, and whether the two run the same way along it.
        let mut neighbours = vec![[(NONE, false); 3]; n];
        let mut slots = vec![0u8; n];
        let mut open = vec![false; n];
        for edge in by_edge(uses) {
            if let [a, b] = edge {
                for (from, to) in [(a, b), (b, a)] {
                    let slot = &mut slots[from.triangle as usize];
                    neighbours[from.triangle as usize][*slot as usize] = (to.triangle, a.forward == b.forward);
                    *slot += 1;
                }
            } else {
                edge.iter().for_each(|u| open[u.triangle as usize] = true);
            }
        }
        let mut of = vec![NONE; n];
        let mut turned = vec![false; n];
        let mut closed = Vec::new();
        let mut queue = VecDeque::new();
        let mut members = Vec::new();
        for seed in 0..n as u32 {
            if of[seed as usize] != NONE {
                continue;
            }
            let patch = closed.len() as u32;
            of[seed as usize] = patch;
            queue.push_back(seed);
            members.clear();
            while let Some(t) = queue.pop_front() {
                members.push(t);
                for (next, disagrees) in neighbours[t as usize] {
                    if next != NONE && of[next as usize] == NONE {
                        of[next as usize] = patch;
                        turned[next as usize] = turned[t as usize] != disagrees;
                        queue.push_back(next);
                    }
                }
            }
            let count = members.iter().filter(|&&t| turned[t as usize]).count();
            if 2 * count > members.len() {
                members.iter().for_each(|&t| turned[t as usize] = !turned[t as usize]);
            }
            closed.push(!members.iter().any(|&t| open[t as usize]));
        }
        for (triangle, _) in mesh.triangles.iter_mut().zip(&turned).filter(|(_, turned)| **turned) {
            triangle.swap(1, 2);
            findings.reoriented += 1;
        }
        Self { of, closed }
    }

    /// Signed volumes about the middle of the mesh.
    fn volumes(&self, mesh: &TriangleMesh) -> Vec<f64> {
        if self.closed.len() == 1 {
            return vec![signed_volume(mesh)];
        }
        let mut volumes = vec![0.0; self.closed.len()];
        if let Some((lo, hi)) = mesh.bounding_box() {
            let middle = lo + (hi - lo) * 0.5;
            for (t, &patch) in self.of.iter().enumerate() {
                volumes[patch as usize] += volume_about(middle, mesh.corners(t));
            }
        }
        volumes
    }

    fn turn(&self, mesh: &mut TriangleMesh, patches: &FxHashSet<u32>) {
        for (triangle, patch) in mesh.triangles.iter_mut().zip(&self.of) {
            if patches.contains(patch) {
                triangle.swap(1, 2);
            }
        }
    }
}

/// Turns outwards what faces inwards: all closed parts if their volume is negative, all open pieces together by their winding
/// numbers, and single closed parts unless they are cavities.
fn orient_outwards(mesh: &mut TriangleMesh, patches: &Patches, findings: &mut MeshFindings) {
    let mut volumes = patches.volumes(mesh);
    let ids = 0..patches.closed.len() as u32;
    let is_closed = |p: &u32| patches.closed[*p as usize];
    let mut turned: FxHashSet<u32> = FxHashSet::default();
    if ids.clone().filter(is_closed).map(|p| volumes[p as usize]).sum::<f64>() < 0.0 {
        findings.inside_out = true;
        turned.extend(ids.clone().filter(is_closed));
        volumes.iter_mut().for_each(|v| *v = -*v);
    }
    // A patch between non-manifold edges is part of a shell whose other parts it must agree with, so all such turn together.
    let loose: Vec<u32> = ids.clone().filter(|p| !is_closed(p)).collect();
    let volume = loose.iter().map(|&p| volumes[p as usize]).sum();
    if !loose.is_empty() && faces_inwards(mesh, patches, volume) {
        findings.inside_out = true;
        turned.extend(loose);
    }

    let inward: Vec<u32> = ids.filter(|p| is_closed(p) && volumes[*p as usize] < 0.0).collect();
    if !inward.is_empty() {
        let shells = Shells::new(mesh, patches);
        for &patch in &inward {
            if shells.is_inside_another(mesh, patch) {
                findings.cavities += 1;
            } else {
                findings.flipped_parts += 1;
                if !turned.remove(&patch) {
                    turned.insert(patch);
                }
            }
        }
    }
    patches.turn(mesh, &turned);
}

/// Whether the open patches face inwards, given their signed `volume` about the middle of the mesh.
///
/// Where that is small for their area they are far from closed and it depends on the origin. Then the mean winding
/// number on them decides, which is ½ on a closed surface and −½ on one that is inside out.
fn faces_inwards(mesh: &TriangleMesh, patches: &Patches, volume: f64) -> bool {
    /// The least volume to trust, relative to that of a sphere of the same area: the bunny with its holes has 0.58. Below
    /// that both answers cost, so ask the better one.
    const BULKY: f64 = 0.5;
    /// As many triangles are asked, evenly chosen.
    const SAMPLES: usize = 4096;
    /// The box is scaled to this, the size of a grid, for which the tree's tolerances are made.
    const EXTENT: f64 = 512.0;
    let Some((lo, hi)) = mesh.bounding_box() else { return false };
    let scale = EXTENT / (hi - lo).max_element().max(f64::MIN_POSITIVE);
    let open = (0..mesh.triangles.len()).filter(|&t| !patches.closed[patches.of[t] as usize]);
    let triangles: Vec<[DVec3; 3]> = open.map(|t| mesh.corners(t).map(|c| (c - lo) * scale)).collect();
    let area: f64 = triangles.iter().map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).sum();
    let sphere = area.powf(1.5) / (6.0 * std::f64::consts::PI.sqrt());
    if volume.abs() * scale.powi(3) > BULKY * sphere {
        return volume < 0.0;
    }
    let bvh = Bvh::new(triangles.clone());
    let winding = WindingNumber::new(&bvh);
    let stride = triangles.len().div_ceil(SAMPLES).max(1);
    let facing = triangles.par_iter().step_by(stride).map(|&[a, b, c]| {
        let normal = (b - a).cross(c - a);
        // In front of the triangle w is ½ less than on it.
        let front = winding.at((a + b + c) / 3.0 + normal.normalize_or_zero() * 1e-3);
        normal.length() * (front + 0.5)
    });
    // Collected first: the sum of a parallel iterator depends on how it was split.
    facing.collect::<Vec<f64>>().iter().sum::<f64>() < 0.0
}

/// The closed patches with their triangles and boxes, to find out which lies within which.
struct Shells {
    /// Patch, box and triangles of each.
    list: Vec<(u32, DVec3, DVec3, Vec<u32>)>,
}

impl Shells {
    fn new(mesh: &TriangleMesh, patches: &Patches) -> Self {
        let mut members = vec![Vec::new(); patches.closed.len()];
        (0u32..).zip(&patches.of).for_each(|(t, &patch)| members[patch as usize].push(t));
        let list = (0u32..)
            .zip(members)
            .filter(|(patch, _)| patches.closed[*patch as usize])
            .map(|(patch, triangles)| {
                let corners = || triangles.iter().flat_map(|&t| mesh.corners(t as usize));
                let lo = corners().fold(DVec3::INFINITY, DVec3::min);
                let hi = corners().fold(DVec3::NEG_INFINITY, DVec3::max);
                (patch, lo, hi, triangles)
            })
            .collect();
        Self { list }
    }

    /// Whether `patch` lies within an odd number of other shells, whatever their orientation.
    fn is_inside_another(&self, mesh: &TriangleMesh, patch: u32) -> bool {
        let Some((_, lo, hi, triangles)) = self.list.iter().find(|s| s.0 == patch) else { return false };
        let Some(&t) = triangles.first() else { return false };
        let probe = mesh.corners(t as usize)[0];
        let around = self.list.iter().filter(|(other, other_lo, other_hi, members)| {
            *other != patch && other_lo.cmple(*lo).all() && other_hi.cmpge(*hi).all() && {
                let winding: f64 = members.iter().map(|&t| solid_angle(probe, mesh.corners(t as usize))).sum();
                winding.abs() > std::f64::consts::TAU
            }
        });
        around.count() % 2 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::testing::*;

    #[test]
    fn a_sound_mesh_stays_as_it_is() {
        let mesh = cube(DVec3::ONE, 3.0);
        let (clean, findings) = prepare(&mesh);
        assert_eq!(clean, mesh);
        assert!(findings.is_sound());
        assert_eq!(findings.warnings(), Vec::<String>::new());
    }

    #[test]
    fn corners_stored_one_by_one_make_a_closed_surface_again() {
        let mesh = cube(DVec3::ZERO, 1.0);
        let corners: Vec<DVec3> = (0..12).flat_map(|t| mesh.corners(t)).collect();
        let soup = TriangleMesh {
            triangles: (0..12).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            positions: corners,
            ..mesh
        };
        let (_, findings) = prepare(&soup);
        assert!(findings.is_sound());
        assert_eq!((findings.welded_equal, findings.converted.euler_characteristic), (28, 2));

        // The same with every corner rounded differently.
        let mut cracked = soup;
        let wiggle = |i: usize| 1e-7 * (DVec3::new(noise(i), noise(i + 1), noise(i + 2)) - 0.5);
        cracked.positions.iter_mut().enumerate().for_each(|(i, p)| *p += wiggle(3 * i));
        let (_, findings) = prepare(&cracked);
        assert!(findings.converted.closed && findings.welded_near == 28, "{findings:?}");
    }

    #[test]
    fn back_to_back_triangles_cancel_and_duplicates_do_not() {
        let mesh = tetrahedron();
        let (clean, findings) = prepare(&joined(mesh.clone(), &reversed(mesh.clone())));
        assert_eq!((clean.triangles.len(), findings.cancelled), (0, 8));
        let mut doubled = mesh.clone();
        doubled.triangles.push(doubled.triangles[1]);
        let (clean, findings) = prepare(&doubled);
        assert_eq!((clean, findings.duplicates_dropped), (mesh.clone(), 1));
        // Where the surface needs one of the two, one stays, whichever way they run.
        let [a, b, c] = mesh.triangles[1];
        doubled.triangles[4] = [a, c, b];
        let (clean, findings) = prepare(&doubled);
        assert_eq!((clean, findings.duplicates_dropped), (mesh, 1));
    }

    #[test]
    fn orientation_spreads_and_parts_turn_outwards() {
        let mut mesh = sphere(DVec3::ZERO, 1.0, 12);
        let volume = analyze(&mesh).signed_volume;
        let flips = (0..mesh.triangles.len()).filter(|&t| noise(t) < 0.3).collect::<Vec<_>>();
        flips.iter().for_each(|&t| mesh.triangles[t].swap(0, 1));
        let (clean, findings) = prepare(&mesh);
        assert_eq!(findings.reoriented, flips.len());
        assert!(findings.converted.closed && (analyze(&clean).signed_volume - volume).abs() < 1e-12);

        let far = reversed(cube(DVec3::splat(5.0), 1.0));
        let (clean, findings) = prepare(&joined(sphere(DVec3::ZERO, 1.0, 12), &far));
        assert_eq!((findings.flipped_parts, findings.cavities), (1, 0));
        assert!((analyze(&clean).signed_volume - volume - 1.0).abs() < 1e-12);
    }

    #[test]
    fn cavities_stay_even_when_all_is_inside_out() {
        let hollow = joined(cube(DVec3::ZERO, 4.0), &reversed(cube(DVec3::ONE, 2.0)));
        for mesh in [hollow.clone(), reversed(hollow)] {
            let (clean, findings) = prepare(&mesh);
            assert_eq!((findings.flipped_parts, findings.cavities), (0, 1));
            assert!((analyze(&clean).signed_volume - 56.0).abs() < 1e-12);
        }
        // An island in the cavity faces outwards again.
        let island = joined(
            joined(cube(DVec3::ZERO, 4.0), &reversed(cube(DVec3::ONE, 2.0))),
            &reversed(cube(DVec3::splat(1.5), 1.0)),
        );
        let (clean, findings) = prepare(&island);
        assert_eq!((findings.flipped_parts, findings.cavities), (1, 1));
        assert!((analyze(&clean).signed_volume - 57.0).abs() < 1e-12);
    }

    #[test]
    fn real_models_are_diagnosed() {
        if let Some(mesh) = shared_mesh("nasty/conrod_flipped.stl") {
            let (_, findings) = prepare(&mesh);
            assert_eq!(findings.found.misoriented_edges, 5149);
            assert_eq!(findings.converted.misoriented_edges, 0, "{findings:?}");
        }
        if let Some(mesh) = shared_mesh("nasty/nested_shell_hollow.obj") {
            let (_, findings) = prepare(&mesh);
            assert_eq!((findings.cavities, findings.flipped_parts, findings.inside_out), (1, 0, false));
        }
        if let Some(mesh) = shared_mesh("meshes/horse_inside_out.ply") {
            let (clean, findings) = prepare(&mesh);
            assert!(findings.inside_out && analyze(&clean).signed_volume > 2.6e-4);
        }
        if let Some(mesh) = shared_mesh("nasty/Wuson_inside_out.off") {
            assert!(prepare(&mesh).1.inside_out);
        }
        if let Some(mesh) = shared_mesh("nasty/chair_double_sided.obj") {
            let (clean, findings) = prepare(&mesh);
            assert!(clean.triangles.is_empty() && findings.cancelled > 12_000, "{findings:?}");
        }
        if let Some(mesh) = shared_mesh("nasty/featuretype_cracks.STL") {
            let (_, findings) = prepare(&mesh);
            assert!(findings.converted.boundary_edges == 0 && findings.welded_near > 0, "{findings:?}");
        }
        if let Some(mesh) = shared_mesh("nasty/joined_tetrahedra.obj") {
            let (clean, findings) = prepare(&mesh);
            assert!(findings.converted.closed && findings.cancelled == 2 && clean.triangles.len() == 6, "{findings:?}");
        }
    }
}
