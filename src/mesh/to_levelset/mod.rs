//! Triangle mesh → narrow-band level set.
//!
//! The mesh is cleaned and oriented ([`prepare`]); distances are exact to its triangles. The sign of a closed mesh is that
//! of its integer winding number: inside where it is 1 or more, so that overlapping shells are united and shells that
//! face inwards within others are cavities. Any other mesh is inside where its generalised winding number is above ½.
//!
//! Where shells overlap or the mesh is open, distances are to the *repaired* surface: pieces of triangles with the same inside or
//! outside on both sides are left out (`pieces`), and the ½ level of the winding number is put in where the sign changes
//! without a triangle (`closure`). So the result is a valid level set whatever came in, and [`MeshFindings`] says what was done.

mod closure;
mod crossings;
mod inside;
mod intersect;
mod pieces;
mod rays;
mod rim;

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};
use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use closure::{DistanceLeaves, Surroundings};
use crossings::Crossings;
use inside::{Inside, caps};
use pieces::separating_pieces;
use rim::Rim;

use super::bins::Bins;
use super::prepare::prepare;
use super::scatter::{UnsignedLeaf, distance_to_triangles, estimated_bytes, leaves_near_triangles, tiles_near};
use super::topology::{boundary_chain, edge_uses, sum_of_triangles};
use super::{Bvh, MeshFindings, TriangleMesh};
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, LEAF_VOXELS, LeafMask, LeafValues, MAX_COORD, Transform, VOXEL_SIZES};
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet, background, grid_of_parts};
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch};

const OPERATION: &str = "mesh to level set";
/// The narrowest band, in voxels, that has both neighbours of every sign change in it, and room for a gradient.
const NARROWEST: f32 = 1.5;
/// The widest band that makes sense: beyond it the band is the whole volume.
const WIDEST: f32 = 512.0;

/// How a mesh becomes a level set.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshToLevelSet {
    /// Edge of a voxel in world units.
    pub voxel_size: f64,
    /// Half width of the band in voxels.
    pub half_width: f32,
    /// Refuse meshes that are open, passing through themselves or not consistently oriented, instead of repairing them.
    pub strict: bool,
}

impl MeshToLevelSet {
    /// Voxels of edge `voxel_size`, the default band, repairs allowed.
    pub fn new(voxel_size: f64) -> Self {
        Self { voxel_size, half_width: DEFAULT_HALF_WIDTH, strict: false }
    }

    /// Refuses values that cannot work.
    pub fn validate(&self) -> Result<()> {
        if !(self.voxel_size.is_finite() && self.voxel_size > 0.0) {
            let accepted = "it must be positive and finite, in the mesh's units";
            return Err(EditError::parameter(OPERATION, "voxel_size", self.voxel_size, accepted));
        }
        if !VOXEL_SIZES.contains(&self.voxel_size) {
            let accepted = format!("{:e} to {:e} world units", VOXEL_SIZES.start(), VOXEL_SIZES.end());
            return Err(EditError::parameter(OPERATION, "voxel_size", format!("{:e}", self.voxel_size), accepted));
        }
        if !(NARROWEST..=WIDEST).contains(&self.half_width) {
            let accepted = format!("the band reaches {NARROWEST} to {WIDEST} voxels to each side (3 is usual)");
            return Err(EditError::parameter(OPERATION, "half_width", self.half_width, accepted));
        }
        Ok(())
    }
}

/// Converts `mesh` and tells what was found in it.
///
/// Errors name the mesh `mesh`; a caller that knows the file puts its name there.
pub fn mesh_to_level_set(
    mesh: &TriangleMesh,
    params: &MeshToLevelSet,
    run: &RunOptions,
) -> Result<(LevelSet, MeshFindings)> {
    check_numbers(mesh)?;
    let bounds = mesh.bounding_box().unwrap_or_default();
    check_room(bounds)?;
    params.validate()?;
    check_range(bounds, params)?;
    let (mut clean, mut findings) = prepare(mesh);
    if clean.triangles.is_empty() {
        return Err(nothing_left(mesh, &findings));
    }
    clean.positions.par_iter_mut().for_each(|p| *p /= params.voxel_size);
    reserve(&clean, params, run)?;
    run.check(OPERATION)?;

    let corners = |t: usize| clean.corners(t);
    let count = clean.triangles.len();
    let chain = match findings.converted.closed {
        true => Vec::new(),
        false => boundary_chain(&edge_uses(&clean.triangles)),
    };
    let caps = caps(&clean.positions, &chain);
    // The crossings of a closed surface.
    let with_caps = |t: usize| caps.get(t.wrapping_sub(count)).copied().unwrap_or_else(|| corners(t));
    let crossings = Crossings::new(count + caps.len(), with_caps);
    let overlaps = crossings.overlaps().to_vec();
    run.check(OPERATION)?;
    let closed = chain.is_empty();
    findings.self_intersecting = closed && !overlaps.is_empty();
    if params.strict && !findings.is_sound() {
        return Err(EditError::input("mesh", format!("refused (strict): {}", findings.warnings().join("; "))));
    }
    let transform = Transform::uniform(params.voxel_size);
    let background = background(params.half_width, &transform);
    let leaves = if closed && overlaps.is_empty() {
        leaves_near_triangles(count, corners, params.half_width, run, |origin, distance| {
            signed(origin, distance, &crossings.inside(origin), params)
        })?
    } else {
        let (tree, caps) = (Bvh::new((0..count).map(corners).collect()), Bvh::new(caps));
        let rim = Rim::new(&clean.positions, &chain);
        let doubts = Doubts { inside: Inside::new(crossings, &tree, &caps, &rim), overlaps, tree: &tree, rim: &rim };
        repair(&clean, &doubts, params, &mut findings, run)?
    };
    let level_set = LevelSet::new(grid_of_parts(background, &leaves), transform);
    if !encloses_a_voxel(&level_set) {
        return Err(encloses_nothing(closed, &findings, params));
    }
    Ok((level_set, findings))
}

/// What is known of a surface that overlaps itself or is open.
struct Doubts<'a> {
    inside: Inside<'a>,
    /// Leaves where it overlaps itself.
    overlaps: Vec<IVec3>,
    /// Its triangles, in their order.
    tree: &'a Bvh,
    rim: &'a Rim,
}

impl Doubts<'_> {
    /// Marks the triangles near which the winding number may be other than 0 on one side and 1 on the other.
    fn triangles(&self, mesh: &TriangleMesh) -> Vec<bool> {
        let around = (0..27).map(|i| IVec3::new(i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1) * LEAF_DIM);
        let overlaps: FxHashSet<IVec3> =
            around.flat_map(|step| self.overlaps.iter().map(move |origin| *origin + step)).collect();
        let bins = Bins::new(mesh.triangles.len(), |t, leaves| tiles_near(leaves, mesh.corners(t), 1.0, LEAF_DIM));
        let doubtful = |bin: &usize| {
            let origin = IVec3::from_array(*bins.key(*bin)) * LEAF_DIM;
            overlaps.contains(&origin) || !self.inside.is_integer(origin, LEAF_DIM + 1)
        };
        let mut marks = vec![false; mesh.triangles.len()];
        let leaves: Vec<usize> = (0..bins.len()).into_par_iter().filter(doubtful).collect();
        leaves.into_iter().flat_map(|bin| bins.items(bin)).for_each(|&t| marks[t as usize] = true);
        marks
    }
}

/// Signed leaves of a surface that overlaps itself or is open.
fn repair(
    clean: &TriangleMesh,
    doubts: &Doubts<'_>,
    params: &MeshToLevelSet,
    findings: &mut MeshFindings,
    run: &RunOptions,
) -> Result<Vec<Vec<SignedLeaf>>> {
    let half_width = params.half_width;
    let doubtful = doubts.triangles(clean);
    run.check(OPERATION)?;
    let pieces = separating_pieces(clean, &doubtful, doubts, run)?;
    findings.removed_area_fraction = pieces.removed_area_fraction;
    run.check(OPERATION)?;
    let leaf = |origin, distance: &LeafValues| Some(UnsignedLeaf { origin, distance: distance.clone() });
    let corners = |t: usize| pieces.kept[t];
    let mut kept = DistanceLeaves::new(leaves_near_triangles(pieces.kept.len(), corners, half_width, run, leaf)?);
    // The surface may go on where triangles were left out.
    let suspects: Vec<IVec3> = if pieces.removed_area_fraction > 0.0 {
        let marked: Vec<usize> = (0..doubtful.len()).filter(|&t| doubtful[t]).collect();
        let bins = Bins::new(marked.len(), |i, leaves| tiles_near(leaves, clean.corners(marked[i]), 1.0, LEAF_DIM));
        (0..bins.len()).map(|bin| IVec3::from_array(*bins.key(bin)) * LEAF_DIM).collect()
    } else {
        Vec::new()
    };
    let mut surroundings = Surroundings::new(&doubts.inside);
    let closure = surroundings.close(&kept, &suspects, half_width, run)?;
    findings.closure_triangles = closure.len();
    kept.merge(distance_to_triangles(closure.len(), |t| closure[t], half_width, run)?);
    let unsigned: Vec<_> = kept.origins().filter(|o| surroundings.mask(*o).is_none()).collect();
    surroundings.extend(&unsigned);
    let signed = |leaf: &UnsignedLeaf| {
        signed(leaf.origin, &leaf.distance, &surroundings.mask(leaf.origin).copied().unwrap_or_default(), params)
    };
    Ok(kept.parts().par_iter().map(|part| part.iter().filter_map(signed).collect()).collect())
}

/// Values and mask of a leaf at its origin.
type SignedLeaf = (IVec3, LeafValues, LeafMask);

/// World-space signed distances and active mask from distances in voxels and the inside of a leaf; `None` where none is in
/// the band.
fn signed(origin: IVec3, distance: &LeafValues, inside: &LeafMask, params: &MeshToLevelSet) -> Option<SignedLeaf> {
    let mut leaf = (origin, LeafValues::default(), LeafMask::EMPTY);
    let (_, values, active) = &mut leaf;
    let &MeshToLevelSet { voxel_size, half_width, .. } = params;
    let background = background(half_width, &Transform::uniform(voxel_size));
    dispatch(Sign { distance, inside, voxel_size: voxel_size as f32, half_width, background, values, active });
    (!leaf.2.is_empty()).then_some(leaf)
}

/// Scales distances, cuts them at the background and gives them their signs.
struct Sign<'a> {
    distance: &'a LeafValues,
    inside: &'a LeafMask,
    voxel_size: f32,
    half_width: f32,
    background: f32,
    values: &'a mut LeafValues,
    active: &'a mut LeafMask,
}

impl Work for Sign<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for at in (0..LEAF_VOXELS).step_by(16) {
            let (word, shift) = (at / 64, at % 64);
            let distance = Lanes::from_slice(simd, &self.distance.0[at..at + 16]);
            let phi = distance * self.voxel_size;
            // Either alone would not do: the background is rounded otherwise than products with the voxel size.
            let active = distance.simd_lt(self.half_width) & phi.simd_lt(self.background);
            self.active.0[word] |= active.to_bitmask() << shift;
            let magnitude = active.select(phi, Lanes::splat(simd, self.background));
            let inside = mask32x16::from_bitmask(simd, self.inside.0[word] >> shift & 0xffff);
            inside.select(-magnitude, magnitude).store_slice(&mut self.values.0[at..at + 16]);
        }
    }
}

/// Refuses indices out of range and positions that are no numbers.
pub(super) fn check_numbers(mesh: &TriangleMesh) -> Result<()> {
    let vertices = mesh.positions.len();
    let first_with = |refused: &(dyn Fn(u32) -> bool + Sync)| {
        let of = |(t, triangle): (usize, &[u32; 3])| Some((t, *triangle.iter().find(|&&v| refused(v))?));
        mesh.triangles.par_iter().enumerate().with_min_len(1024).find_map_first(of)
    };
    // One look at a mesh that is all right.
    if first_with(&|v| !mesh.positions.get(v as usize).is_some_and(|p| p.is_finite())).is_none() {
        return Ok(());
    }
    if let Some((t, v)) = first_with(&|v| v as usize >= vertices) {
        let problem = format!("triangle {t} uses vertex {v}, but there are only {vertices}");
        return Err(EditError::input("mesh", problem));
    }
    if let Some((t, v)) = first_with(&|v| !mesh.positions[v as usize].is_finite()) {
        let problem =
            format!("vertex {v} (of triangle {t}) is at {}: coordinates must be finite", mesh.positions[v as usize]);
        return Err(EditError::input("mesh", problem));
    }
    Ok(())
}

/// Refuses coordinates that no voxel size has room for.
fn check_room((lo, hi): (DVec3, DVec3)) -> Result<()> {
    let farthest = lo.abs().max(hi.abs()).max_element();
    let room = f64::from(MAX_COORD) * VOXEL_SIZES.end();
    if farthest > room {
        let problem =
            format!("coordinates reach {farthest:e}: there are no voxels for more than {room:e}; scale it down");
        return Err(EditError::input("mesh", problem));
    }
    Ok(())
}

/// Refuses coordinates for which index space has no room.
fn check_range((lo, hi): (DVec3, DVec3), params: &MeshToLevelSet) -> Result<()> {
    let room = f64::from(MAX_COORD) - f64::from(params.half_width) - 64.0;
    let largest = lo.abs().max(hi.abs()).max_element();
    if largest / params.voxel_size > room {
        let accepted = format!(
            "coordinates reach {largest:e} and an index at most {MAX_COORD}: take {:e} or more, or move the mesh nearer to the origin",
            largest / room
        );
        return Err(EditError::parameter(OPERATION, "voxel_size", params.voxel_size, accepted));
    }
    Ok(())
}

/// Checks the memory limit before anything is allocated that grows with the resolution. The mesh in voxels.
fn reserve(mesh: &TriangleMesh, params: &MeshToLevelSet, run: &RunOptions) -> Result<()> {
    let (lo, hi) = mesh.bounding_box().unwrap_or_default();
    let area = |t| {
        let [a, b, c] = mesh.corners(t);
        0.5 * (b - a).cross(c - a).length()
    };
    let area = sum_of_triangles(mesh.triangles.len(), area);
    let needed = estimated_bytes(area, hi - lo, mesh.triangles.len(), f64::from(params.half_width));
    run.reserve(OPERATION, needed, "take a larger voxel_size")
}

fn encloses_a_voxel(level_set: &LevelSet) -> bool {
    let grid = level_set.grid();
    grid.leaves().par_iter().any(|&id| grid.values(id).0.iter().any(|v| *v < 0.0)) || !grid.inside_tiles().is_empty()
}

/// The error for a mesh of which no triangle was left.
fn nothing_left(mesh: &TriangleMesh, findings: &MeshFindings) -> EditError {
    let problem = if mesh.triangles.is_empty() {
        "has no triangles; a level set needs a surface that encloses a volume".into()
    } else if findings.cancelled > 0 {
        format!(
            "encloses nothing: all its triangles lie back to back ({} of {}), so that both sides of it are outside; use a mesh whose walls have a thickness",
            findings.cancelled,
            mesh.triangles.len()
        )
    } else {
        format!("encloses nothing: none of its {} triangles has an area", mesh.triangles.len())
    };
    EditError::input("mesh", problem)
}

/// The error for a surface without a voxel inside.
fn encloses_nothing(closed: bool, findings: &MeshFindings, params: &MeshToLevelSet) -> EditError {
    if closed {
        let accepted = "every part of the mesh is thinner than a voxel, so that no voxel is inside; take a smaller one";
        return EditError::parameter(OPERATION, "voxel_size", params.voxel_size, accepted);
    }
    let boundary = findings.converted.boundary_edges;
    let problem = format!(
        "encloses no voxel: it is open ({boundary} boundary edges) and its winding number nowhere exceeds 1/2; use a closed mesh, give a sheet some thickness in a modelling tool first, or take a smaller voxel_size than {} if it has thin parts that are closed",
        params.voxel_size
    );
    EditError::input("mesh", problem)
}

#[cfg(test)]
mod tests;
