//! Which parts of two shapes take part in a morph, and bridges for those that do not.
//!
//! A flow by the distance reaches the parts of the target that the source overlaps; a part of the source that the target does not overlap vanishes. With a
//! bridge, a part that would not appear buds: a copy small enough to be hidden inside what both shapes share moves out to
//! its place on a straight line and grows to its size,
//!
//! > x ↦ (1 − β) a + β c + ((1 − β) s + β)(x − c),
//!
//! with the anchor a, the centre c of the part and a first scale s. A part that would vanish goes the other way. β of a frame is the one with which the volume is
//! on the straight line between those of the two shapes, or as near as it comes: so parts leave when there is room for their volume,
//! nothing appears in the open, and the volume does not go up and down.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::NAME;
use crate::error::Result;
use crate::grid::{Grid, offset_to_local};
use crate::levelset::{Components, LevelSet};
use crate::mesh::{TriangleMesh, level_set_of_mesh, level_set_to_mesh};
use crate::ops::csg::{CsgOperation, csg};
use crate::run::RunOptions;

/// How deep an anchor lies, as a part of the deepest there is: the nearest of the deep ones is taken.
const DEEP: f64 = 0.5;

/// Part of the room around an anchor that a hidden copy takes.
const HIDDEN: f64 = 0.8;

/// Halvings of β.
const BISECTIONS: u32 = 14;

/// The parts of two shapes, and which of them overlap. Both on one lattice.
pub(super) struct Overlap {
    /// Of the source, by part: its voxels and whether the target overlaps it.
    pub source: Vec<(u64, bool)>,
    /// Of the target, by part: its voxels and whether the source overlaps it.
    pub target: Vec<(u64, bool)>,
    components: [Components; 2],
    /// What both share.
    common: LevelSet,
}

impl Overlap {
    /// Of two level sets.
    pub fn new(source: &LevelSet, target: &LevelSet, run: &RunOptions) -> Result<Self> {
        let common = csg(source, &[target], CsgOperation::Intersection, run)?;
        let components = [source.components(run)?, target.components(run)?];
        let mut met = components.each_ref().map(|c| vec![false; c.voxels().len()]);
        let mut mark = |ijk: IVec3| {
            for (components, met) in components.iter().zip(&mut met) {
                if let Some(met) = components.at(ijk).and_then(|label| met.get_mut(label as usize)) {
                    *met = true;
                }
            }
        };
        for ijk in one_voxel_a_part(&common, run)? {
            mark(ijk);
        }
        let [of_source, of_target] = met;
        let list = |components: &Components, met: Vec<bool>| components.voxels().iter().copied().zip(met).collect();
        Ok(Self {
            source: list(&components[0], of_source),
            target: list(&components[1], of_target),
            components,
            common,
        })
    }

    /// Whether nothing overlaps.
    pub fn is_none(&self) -> bool {
        self.source.iter().all(|part| !part.1)
    }

    /// What would go wrong without a bridge, in words.
    pub fn warnings(&self, [from, to]: [&str; 2]) -> Vec<String> {
        let said = |parts: &[(u64, bool)], of: &str, fate: &str| {
            let lost: Vec<u64> = parts.iter().filter(|p| !p.1).map(|p| p.0).collect();
            (!lost.is_empty()).then(|| {
                let sizes: Vec<String> = lost.iter().take(5).map(u64::to_string).collect();
                let more = if lost.len() > 5 { ", …" } else { "" };
                format!(
                    "{} of {} parts of {of} ({}{more} voxels) {fate}: `bridge` lets them take part",
                    lost.len(),
                    parts.len(),
                    sizes.join(", ")
                )
            })
        };
        let vanish = said(&self.source, from, "will vanish, since the target does not overlap them");
        let absent =
            said(&self.target, to, "will not appear until the last frame, since the source does not overlap them");
        vanish.into_iter().chain(absent).collect()
    }

    /// The shapes without the parts that do not take part, and those parts as surfaces that bud or vanish.
    pub fn bridged(
        &self,
        source: &LevelSet,
        target: &LevelSet,
        run: &RunOptions,
    ) -> Result<(LevelSet, LevelSet, Vec<Bud>)> {
        let mut buds = Vec::new();
        let mut shapes = Vec::new();
        let sides =
            [(source, &self.source, &self.components[0], true), (target, &self.target, &self.components[1], false)];
        for (shape, parts, components, vanishes) in sides {
            if parts.iter().all(|part| part.1) {
                shapes.push(shape.clone());
                continue;
            }
            let mesh = level_set_to_mesh(shape, 0.0, run)?;
            let mut pieces: Vec<Vec<[u32; 3]>> = vec![Vec::new(); parts.len() + 1];
            for triangle in &mesh.triangles {
                let corner = shape.transform().world_to_index(mesh.positions[triangle[0] as usize]);
                let label = components.nearest(corner).map_or(parts.len(), |label| label as usize);
                pieces[label.min(parts.len())].push(*triangle);
            }
            let piece = |triangles: Vec<[u32; 3]>| TriangleMesh { triangles, ..mesh.clone() };
            let mut kept = Vec::new();
            for (n, triangles) in pieces.into_iter().enumerate() {
                match parts.get(n) {
                    Some((_, false)) => {
                        buds.extend(Bud::new(used(&piece(triangles)), vanishes, &self.common));
                    }
                    _ => kept.extend(triangles),
                }
            }
            shapes.push(level_set_of_mesh(used(&piece(kept)), shape.transform(), shape.half_width(), run)?);
        }
        let (target, source) = (shapes.pop(), shapes.pop());
        Ok((source.unwrap_or_else(|| self.common.clone()), target.unwrap_or_else(|| self.common.clone()), buds))
    }
}

/// A voxel of each connected part of the inside.
fn one_voxel_a_part(level_set: &LevelSet, run: &RunOptions) -> Result<Vec<IVec3>> {
    let components = level_set.components(run)?;
    let grid = level_set.grid();
    let mut found: Vec<Option<IVec3>> = vec![None; components.voxels().len()];
    let mut missing = found.len();
    let inside = |grid: &Grid, id| {
        let origin = grid.origin(id);
        let values = grid.values(id).0;
        (0..values.len()).filter(move |&at| values[at] < 0.0).map(move |at| origin + offset_to_local(at))
    };
    for &id in grid.leaves() {
        if missing == 0 {
            break;
        }
        for ijk in inside(grid, id) {
            if let Some(place) = components.at(ijk).and_then(|label| found.get_mut(label as usize))
                && place.is_none()
            {
                *place = Some(ijk);
                missing -= 1;
            }
        }
    }
    Ok(found.into_iter().flatten().collect())
}

/// The mesh without the vertices that no triangle uses.
fn used(mesh: &TriangleMesh) -> TriangleMesh {
    let mut place = vec![u32::MAX; mesh.positions.len()];
    let mut positions = Vec::new();
    let triangles = mesh.triangles.iter().map(|t| {
        t.map(|v| {
            let place = &mut place[v as usize];
            if *place == u32::MAX {
                *place = positions.len() as u32;
                positions.push(mesh.positions[v as usize]);
            }
            *place
        })
    });
    let triangles = triangles.collect();
    TriangleMesh { positions, triangles, ..TriangleMesh::default() }
}

/// A part that moves out of what both shapes share, or into it.
pub(super) struct Bud {
    mesh: TriangleMesh,
    centre: DVec3,
    anchor: DVec3,
    /// Scale at the anchor.
    hidden: f64,
    vanishes: bool,
}

impl Bud {
    /// `None` where there is no room to hide it.
    fn new(mesh: TriangleMesh, vanishes: bool, common: &LevelSet) -> Option<Self> {
        let count = mesh.positions.len().max(1) as f64;
        let centre = mesh.positions.iter().sum::<DVec3>() / count;
        let radius = mesh.positions.iter().map(|p| p.distance(centre)).fold(0.0, f64::max);
        let (anchor, room) = anchor(common, centre)?;
        Some(Self { hidden: (HIDDEN * room / radius).min(1.0), mesh, centre, anchor, vanishes })
    }

    /// Its surface when it has gone `beta` of its way.
    fn mesh_at(&self, beta: f64) -> TriangleMesh {
        let out = if self.vanishes { 1.0 - beta } else { beta };
        let (place, scale) = (self.anchor.lerp(self.centre, out), self.hidden + (1.0 - self.hidden) * out);
        let positions = self.mesh.positions.iter().map(|p| place + (*p - self.centre) * scale).collect();
        TriangleMesh { positions, triangles: self.mesh.triangles.clone(), ..TriangleMesh::default() }
    }
}

/// A point deep inside a solid, near another point, and the distance from it to the surface (a lower bound).
fn anchor(solid: &LevelSet, to: DVec3) -> Option<(DVec3, f64)> {
    let (lo, hi) = solid.grid().active_bounds()?;
    let mesh = level_set_to_mesh(solid, 0.0, &RunOptions::default()).ok()?;
    let tree = crate::mesh::Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
    let step = ((hi - lo).max_element() / 32).max(1);
    let size = (hi - lo) / step + 1;
    let columns: Vec<(DVec3, f64)> = (0..size.x * size.y)
        .into_par_iter()
        .flat_map_iter(|column| {
            let mut sampler = solid.sampler();
            let tree = &tree;
            (0..size.z).filter_map(move |z| {
                let ijk = lo + IVec3::new(column / size.y, column % size.y, z) * step;
                if sampler.voxel(ijk) >= 0.0 {
                    return None;
                }
                let xyz = solid.transform().voxel_to_world(ijk);
                Some((xyz, tree.closest_point(xyz, f64::INFINITY)?.distance_squared.sqrt()))
            })
        })
        .collect();
    let deepest = columns.iter().map(|c| c.1).fold(0.0, f64::max);
    let deep = columns.into_iter().filter(|c| c.1 >= DEEP * deepest);
    deep.min_by(|a, b| a.0.distance(to).total_cmp(&b.0.distance(to)))
}

/// The buds of a leg, and how far they have gone.
pub(super) struct Buds {
    pub list: Vec<Bud>,
    /// Volumes of the two shapes, with all their parts.
    pub volumes: [f64; 2],
    /// β of the frame before.
    pub beta: f64,
}

impl Buds {
    /// The flowing surface and the buds at a place between 0 and 1.
    pub fn joined(&mut self, flow: &LevelSet, place: f64, run: &RunOptions) -> Result<LevelSet> {
        if self.list.is_empty() {
            return Ok(flow.clone());
        }
        let wanted = self.volumes[0] + (self.volumes[1] - self.volumes[0]) * place;
        let with = |beta: f64| self.at(flow, beta, run);
        let volume = |level_set: &LevelSet| level_set.measure(run).map(|m| m.volume);
        let (mut low, mut high) = (self.beta, 1.0);
        let (first, last) = (volume(&with(low)?)?, volume(&with(high)?)?);
        // Where the line is beyond what can be had, the nearer end.
        let beta = if (wanted - first) * (last - first) <= 0.0 {
            low
        } else if (wanted - last) * (last - first) >= 0.0 {
            high
        } else {
            for _ in 0..BISECTIONS {
                run.check(NAME)?;
                let middle = 0.5 * (low + high);
                let short = (volume(&with(middle)?)? - wanted) * (last - first) < 0.0;
                if short { low = middle } else { high = middle }
            }
            0.5 * (low + high)
        };
        let joined = with(beta)?;
        self.beta = beta;
        Ok(joined)
    }

    fn at(&self, flow: &LevelSet, beta: f64, run: &RunOptions) -> Result<LevelSet> {
        let buds =
            self.list.iter().map(|bud| level_set_of_mesh(bud.mesh_at(beta), flow.transform(), flow.half_width(), run));
        let buds = buds.collect::<Result<Vec<_>>>()?;
        csg(flow, &buds.iter().collect::<Vec<_>>(), CsgOperation::Union, run)
    }
}
