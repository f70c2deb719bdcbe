//! The cells that the surface φ = iso crosses, and the numbering of its vertices.
//!
//! A voxel is inside where φ < iso; a value of exactly iso (or NaN) is outside. A cell is the cube between eight
//! voxels and belongs to the leaf of its first corner, and a vertex lies on each grid edge between an inside and an
//! outside voxel and belongs to the leaf of the edge's first voxel. The vertices of a leaf are numbered by bit masks
//! and ranks, so that a cell finds the vertices of its neighbours without a hash. The polygons of a cell are those of
//! [`cell_case`](super::marching::cell_case): inside is connected through faces (6 neighbours), outside through faces
//! and edges (18).

use fearless_simd::{Simd, SimdBase, SimdMask};
use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::marching::{EDGES, cell_case};
use crate::error::{EditError, Result};
use crate::grid::{
    Face, Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafValues, Neighbours, leaf_offset, neighbour_index,
    offset_to_local,
};
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch};

/// Vertices keep this distance, in voxels, from the ends of their grid edge, so that no two coincide and no triangle
/// is degenerate where φ = iso at a voxel. Far below the accuracy of linear interpolation; still resolved by f32
/// files up to 4096 voxels from the origin.
pub(crate) const VERTEX_MARGIN: f64 = 1.0 / 4096.0;

/// Where φ = iso between two voxels with values `a` and `b` on different sides, 0..1.
#[inline(always)]
pub(crate) fn crossing(a: f32, b: f32, iso: f32) -> f64 {
    let (a, b, iso) = (f64::from(a), f64::from(b), f64::from(iso));
    let t = (iso - a) / (b - a);
    // Values that are not finite have no crossing to be found.
    if t.is_nan() { 0.5 } else { t.clamp(VERTEX_MARGIN, 1.0 - VERTEX_MARGIN) }
}

/// The signs of a leaf's voxels and of those next to its upper sides: bit z (0..=8) of row (x, y) (0..=8) is set
/// inside.
pub(crate) struct SignRows([[u16; 9]; 9]);

impl SignRows {
    fn gather(signs: &[LeafMask], around: &Neighbours) -> Self {
        let upper = |x: usize, y: usize, z: usize| {
            &signs[around[neighbour_index(IVec3::new(x as i32, y as i32, z as i32))].index()]
        };
        Self(std::array::from_fn(|x| {
            std::array::from_fn(|y| {
                let row = |z| u16::from(upper(x / 8, y / 8, z).row(x % 8, y % 8));
                row(0) | (row(1) & 1) << 8
            })
        }))
    }

    /// Calls `f` with the first corner and the sign pattern of each cell that the surface crosses.
    #[inline(always)]
    pub fn for_each_cell(&self, mut f: impl FnMut(IVec3, u8)) {
        for x in 0..8 {
            for y in 0..8 {
                let rows = [self.0[x][y], self.0[x][y + 1], self.0[x + 1][y], self.0[x + 1][y + 1]];
                let any = rows.iter().fold(0, |a, r| a | r);
                let all = rows.iter().fold(u16::MAX, |a, r| a & r);
                let mut rest = (any | any >> 1) & !(all & all >> 1) & 0xff;
                while rest != 0 {
                    let z = rest.trailing_zeros();
                    rest &= rest - 1;
                    let pattern = rows.iter().rev().fold(0, |p, r| p << 2 | (r >> z & 3) as u8);
                    f(IVec3::new(x as i32, y as i32, z as i32), pattern);
                }
            }
        }
    }

    /// The crossed grid edges along each axis, by their first voxel.
    fn edges(&self) -> [LeafMask; 3] {
        let mut edges = [LeafMask::EMPTY; 3];
        for x in 0..8 {
            for y in 0..8 {
                let row = self.0[x][y];
                let along = [row ^ self.0[x + 1][y], row ^ self.0[x][y + 1], row ^ row >> 1];
                for (mask, crossed) in edges.iter_mut().zip(along) {
                    mask.0[x] |= u64::from(crossed & 0xff) << (y * 8);
                }
            }
        }
        edges
    }
}

/// A leaf with crossed cells or crossed edges.
pub(crate) struct SurfaceLeaf {
    /// The leaf.
    pub id: LeafId,
    /// Number of its first vertex.
    pub first_vertex: u32,
    /// Number of its vertices.
    pub vertices: u32,
    /// Number of its first triangle.
    pub first_triangle: usize,
    /// Number of its triangles.
    pub triangles: u32,
    /// Number of pieces of surface, one or more a crossed cell.
    pub loops: u32,
    /// The crossed edges along each axis, by their first voxel.
    edges: [LeafMask; 3],
    /// Vertices of this leaf before each word of `edges`.
    pub ranks: [u16; 24],
}

impl SurfaceLeaf {
    fn new(id: LeafId, rows: &SignRows) -> Option<Self> {
        let edges = rows.edges();
        let mut ranks = [0; 24];
        let mut vertices = 0;
        for (rank, word) in ranks.iter_mut().zip(edges.iter().flat_map(|mask| mask.0)) {
            *rank = vertices;
            vertices += word.count_ones() as u16;
        }
        let (mut triangles, mut loops) = (0, 0);
        rows.for_each_cell(|_, pattern| {
            let case = cell_case(pattern);
            triangles += case.triangles.len() as u32;
            loops += case.loops;
        });
        let vertices = u32::from(vertices);
        (vertices + loops > 0).then_some(Self {
            id,
            first_vertex: 0,
            vertices,
            first_triangle: 0,
            triangles,
            loops,
            edges,
            ranks,
        })
    }

    /// Calls `f` with axis and offset of the first voxel of each crossed edge, in the order of the vertices' numbers.
    #[inline(always)]
    pub fn for_each_vertex(&self, mut f: impl FnMut(usize, usize)) {
        for (axis, mask) in self.edges.iter().enumerate() {
            for (x, &word) in mask.0.iter().enumerate() {
                let mut rest = word;
                while rest != 0 {
                    f(axis, x * 64 + rest.trailing_zeros() as usize);
                    rest &= rest - 1;
                }
            }
        }
    }
}

/// The surface φ = iso of a grid: its leaves in the order of their origins, with numbered vertices.
pub(crate) struct IsoSurface<'a> {
    grid: &'a Grid,
    pub(super) iso: f32,
    /// Inside voxels by slot, sentinels included.
    signs: Vec<LeafMask>,
    leaves: Vec<SurfaceLeaf>,
    /// Place in `leaves` by slot; `NO_SURFACE` where there is none.
    places: Vec<u32>,
}

/// What to do where the memory for a surface is not there.
pub(crate) const MEMORY_ADVICE: &str = "resample to a larger voxel size or raise the memory limit";

const NO_SURFACE: u32 = u32::MAX;

impl<'a> IsoSurface<'a> {
    /// Finds the crossed cells and edges of all leaves; `operation` names the caller in errors.
    pub fn new(grid: &'a Grid, iso: f32, operation: &str, run: &RunOptions) -> Result<Self> {
        let per_leaf = 2 * size_of::<LeafMask>() + size_of::<SurfaceLeaf>() + size_of::<Neighbours>() + 4;
        run.reserve(operation, (grid.leaves().len() * per_leaf) as u64, MEMORY_ADVICE)?;
        let around = grid.neighbours();
        let mut signs = vec![LeafMask::EMPTY; grid.slot_count()];
        if let Some(inside) = signs.get_mut(LeafId::INSIDE.index()) {
            *inside = LeafMask::FULL;
        }
        for (&id, mask) in grid.leaves().iter().zip(grid.map_leaves(|id| inside_mask(grid.values(id), iso))) {
            signs[id.index()] = mask;
        }
        let mut leaves: Vec<SurfaceLeaf> = grid
            .map_leaves(|id| SurfaceLeaf::new(id, &SignRows::gather(&signs, &around[id.index()])))
            .into_iter()
            .flatten()
            .collect();
        let mut places = vec![NO_SURFACE; grid.slot_count()];
        let (mut vertices, mut triangles) = (0u32, 0);
        for (place, leaf) in leaves.iter_mut().enumerate() {
            places[leaf.id.index()] = place as u32;
            (leaf.first_vertex, leaf.first_triangle) = (vertices, triangles);
            triangles += leaf.triangles as usize;
            vertices = vertices.checked_add(leaf.vertices).ok_or_else(|| {
                EditError::parameter(
                    operation,
                    "voxel_size",
                    "the level set's",
                    "at most 4294967295 surface vertices; resample to a larger one",
                )
            })?;
        }
        run.check(operation)?;
        Ok(Self { grid, iso, signs, leaves, places })
    }

    /// The leaves that the surface crosses, in the order of their origins.
    pub fn leaves(&self) -> &[SurfaceLeaf] {
        &self.leaves
    }

    /// Place of a leaf among [`leaves`](Self::leaves); `None` for the sentinels and where the surface does not cross it.
    pub fn place(&self, id: LeafId) -> Option<usize> {
        self.places.get(id.index()).copied().filter(|&place| place != NO_SURFACE).map(|place| place as usize)
    }

    /// The leaves, and the place of each among them by slot, `u32::MAX` where there is none.
    pub fn into_leaves(self) -> (Vec<SurfaceLeaf>, Vec<u32>) {
        (self.leaves, self.places)
    }

    /// Number of vertices.
    pub fn vertex_count(&self) -> usize {
        self.leaves.last().map_or(0, |leaf| (leaf.first_vertex + leaf.vertices) as usize)
    }

    /// Number of triangles.
    pub fn triangle_count(&self) -> usize {
        self.leaves.last().map_or(0, |leaf| leaf.first_triangle + leaf.triangles as usize)
    }

    /// The inside voxels of a leaf or sentinel.
    pub fn inside(&self, id: LeafId) -> &LeafMask {
        &self.signs[id.index()]
    }

    /// Signs of a leaf and its upper neighbours' first layers.
    pub fn rows(&self, leaf: &SurfaceLeaf) -> SignRows {
        SignRows::gather(&self.signs, &self.grid.neighbours()[leaf.id.index()])
    }

    /// Calls `f` with the index-space position of each vertex of a leaf, in the order of their numbers.
    pub fn for_each_position(&self, leaf: &SurfaceLeaf, mut f: impl FnMut(DVec3)) {
        let around = &self.grid.neighbours()[leaf.id.index()];
        let origin = self.grid.origin(leaf.id);
        let values = &self.grid.values(leaf.id).0;
        leaf.for_each_vertex(|axis, offset| {
            let voxel = offset_to_local(offset);
            let step = 64 >> (3 * axis);
            let next = if voxel[axis] + 1 < LEAF_DIM {
                values[offset + step]
            } else {
                let beyond = around[neighbour_index(IVec3::AXES[axis])];
                self.grid.values(beyond).0[offset - 7 * step]
            };
            let mut position = (origin + voxel).as_dvec3();
            position[axis] += crossing(values[offset], next, self.iso);
            f(position);
        });
    }

    /// Calls `f` with the first corner of a cell of the leaf and a triangle of it, relative to that corner, for each
    /// triangle of the cells that are `wanted`. The cells come block by block of 2³, so that triangles that follow each other are near each other.
    pub fn for_each_triangle(
        &self,
        leaf: &SurfaceLeaf,
        wanted: impl Fn(IVec3) -> bool,
        mut f: impl FnMut(IVec3, [Vec3; 3]),
    ) {
        let mut patterns = [0; LEAF_VOXELS];
        let mut crossed = LeafMask::EMPTY;
        self.rows(leaf).for_each_cell(|cell, pattern| {
            if wanted(cell) {
                let offset = leaf_offset(cell);
                patterns[offset] = pattern;
                crossed.set(offset, true);
            }
        });
        let mut values = None;
        for block in BLOCKS {
            for x in 2 * block.x..2 * block.x + 2 {
                // The bits of the block's four cells in this slice.
                let mut rest = crossed.0[x as usize] & 0x0303 << (16 * block.y + 2 * block.z);
                while rest != 0 {
                    let offset = x as usize * 64 + rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    let cell = offset_to_local(offset);
                    let values = values.get_or_insert_with(|| self.values_of_cells(leaf));
                    let case = cell_case(patterns[offset]);
                    let vertices = self.vertices_of_cell(values, cell, case.crossed);
                    for triangle in &case.triangles {
                        f(cell, triangle.map(|edge| vertices[usize::from(edge)]));
                    }
                }
            }
        }
    }

    /// φ at the corners of a leaf's cells: its voxels and those next to its upper sides, 9³ in all.
    pub(super) fn values_of_cells(&self, leaf: &SurfaceLeaf) -> [f32; 729] {
        let around = &self.grid.neighbours()[leaf.id.index()];
        let mut values = [0.0; 729];
        // The leaf and those above it, x first.
        let mut leaves = [&self.grid.values(leaf.id).0; 8];
        for (c, leaf) in leaves.iter_mut().enumerate() {
            *leaf = &self.grid.values(around[neighbour_index(corner(c))]).0;
        }
        for (x, slab) in values.as_chunks_mut::<81>().0.iter_mut().enumerate() {
            for (y, row) in slab.as_chunks_mut::<9>().0.iter_mut().enumerate() {
                let [own, above] = [leaves[x / 8 * 4 + y / 8 * 2], leaves[x / 8 * 4 + y / 8 * 2 + 1]];
                let first = x % 8 * 64 + y % 8 * 8;
                row[..8].copy_from_slice(&own[first..first + 8]);
                row[8] = above[first];
            }
        }
        values
    }

    /// The vertices on the `crossed` edges of a cell, relative to its first corner.
    #[inline(always)]
    pub(super) fn vertices_of_cell(&self, values: &[f32; 729], cell: IVec3, crossed: u16) -> [Vec3; 12] {
        let first = (cell.x * 81 + cell.y * 9 + cell.z) as usize;
        let mut vertices = [Vec3::ZERO; 12];
        let mut rest = crossed;
        while rest != 0 {
            let edge = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let CellEdge { from, to, start, direction } = CELL_EDGES[edge];
            let t = crossing(values[first + from], values[first + to], self.iso);
            vertices[edge] = start + direction * t as f32;
        }
        vertices
    }

    /// Whether a vertex lies on a grid edge of an absent leaf: space of both signs meets there without a leaf between, and the
    /// surface cannot be followed. Never on a valid level set.
    pub fn is_torn(&self) -> bool {
        let torn = |vertices: &mut CellVertices, leaf: &SurfaceLeaf| {
            let around = &self.grid.neighbours()[leaf.id.index()];
            if (1..8).all(|c| !around[neighbour_index(corner(c))].is_sentinel()) {
                return false;
            }
            vertices.take(self, leaf);
            let mut torn = false;
            self.rows(leaf).for_each_cell(|cell, pattern| {
                let crossed = cell_case(pattern).crossed;
                torn |= (0..12).any(|edge| crossed >> edge & 1 == 1 && vertices.vertex(cell, edge).is_none());
            });
            torn
        };
        self.leaves.par_iter().with_min_len(16).map_init(CellVertices::new, torn).any(|torn| torn)
    }

    /// A voxel of this leaf whose sign differs from that of the absent leaf next to it: the surface leaves the stored
    /// leaves there and cannot be followed. `None` everywhere on a valid level set.
    pub fn leak(&self, id: LeafId) -> Option<IVec3> {
        let around = &self.grid.neighbours()[id.index()];
        let inside = self.signs[id.index()];
        Face::ALL.into_iter().find_map(|face| {
            let beyond = around[neighbour_index(face.step())];
            if !beyond.is_sentinel() {
                return None;
            }
            let differing = if beyond == LeafId::INSIDE { LeafMask(inside.0.map(|w| !w)) } else { inside };
            let offset = differing.spill(face).iter().next()?;
            // `spill` names the voxel beyond the face, by its place in the neighbour; its counterpart is one step back.
            Some(self.grid.origin(id) + offset_to_local(offset) + face.step() * (LEAF_DIM - 1))
        })
    }
}

/// An edge of a cell, within the 9³ values at the corners of a leaf's cells and in space.
struct CellEdge {
    from: usize,
    to: usize,
    start: Vec3,
    direction: Vec3,
}

const CELL_EDGES: [CellEdge; 12] = {
    const NONE: CellEdge = CellEdge { from: 0, to: 0, start: Vec3::ZERO, direction: Vec3::ZERO };
    let mut edges = [NONE; 12];
    let mut e = 0;
    while e < 12 {
        let (axis, corner) = EDGES[e];
        let (x, y, z) = (corner >> 2, corner >> 1 & 1, corner & 1);
        let from = x as usize * 81 + y as usize * 9 + z as usize;
        let to = from + [81, 9, 1][axis];
        edges[e] = CellEdge { from, to, start: Vec3::new(x as f32, y as f32, z as f32), direction: Vec3::AXES[axis] };
        e += 1;
    }
    edges
};

/// The blocks of 2³ cells of a leaf along Morton's curve: those of each half, quarter and eighth of it follow each other.
const BLOCKS: [IVec3; 64] = {
    let mut blocks = [IVec3::ZERO; 64];
    let mut i = 0;
    while i < 64 {
        let (high, low) = (i as i32 >> 3, i as i32 & 7);
        blocks[i] =
            IVec3::new((high >> 2) * 2 + (low >> 2), (high >> 1 & 1) * 2 + (low >> 1 & 1), (high & 1) * 2 + (low & 1));
        i += 1;
    }
    blocks
};

/// The numbers of the vertices on the edges of a leaf's cells, by edge: made for one leaf after the other, so that cells
/// look up nothing but this table.
pub(crate) struct CellVertices {
    /// Edges along x, y, z, each by its first voxel: 9³ of them, as cells reach into the upper neighbours.
    numbers: Box<[u32; 3 * CORNERS]>,
    /// The entries in use.
    used: Vec<u16>,
}

/// Corners of a leaf's cells.
const CORNERS: usize = 9 * 9 * 9;

/// Stands for no vertex.
const NO_VERTEX: u32 = u32::MAX;

/// The voxels of a word of a mask with y = 0, and with z = 0.
const Y_FIRST: u64 = 0xff;
const Z_FIRST: u64 = 0x0101_0101_0101_0101;

/// Where the entry of an edge lies from that of its cell's first corner.
const EDGE_STEPS: [usize; 12] = {
    let mut steps = [0; 12];
    let mut e = 0;
    while e < 12 {
        let (axis, first) = (EDGES[e].0, EDGES[e].1 as usize);
        steps[e] = axis * CORNERS + (first >> 2) * 81 + (first >> 1 & 1) * 9 + (first & 1);
        e += 1;
    }
    steps
};

impl CellVertices {
    pub fn new() -> Self {
        Self { numbers: Box::new([NO_VERTEX; 3 * CORNERS]), used: Vec::new() }
    }

    /// Makes the table of `leaf`.
    pub fn take(&mut self, surface: &IsoSurface, leaf: &SurfaceLeaf) {
        self.used.drain(..).for_each(|entry| self.numbers[usize::from(entry)] = NO_VERTEX);
        let around = &surface.grid.neighbours()[leaf.id.index()];
        for c in 0..7 {
            let Some(place) = surface.place(around[neighbour_index(corner(c))]) else { continue };
            let Some(leaf) = surface.leaves.get(place) else { continue };
            // Of an upper neighbour, its lowest layer along the axes on which it lies above.
            let (slices, rows) = (if c & 4 == 0 { 8 } else { 1 }, if c & 2 == 0 { u64::MAX } else { Y_FIRST });
            let wanted = rows & if c & 1 == 0 { u64::MAX } else { Z_FIRST };
            let base = (c >> 2) * 8 * 81 + (c >> 1 & 1) * 8 * 9 + (c & 1) * 8;
            for axis in (0..3).filter(|axis| c >> (2 - axis) & 1 == 0) {
                for x in 0..slices {
                    let word = leaf.edges[axis].0[x];
                    let first = leaf.first_vertex + u32::from(leaf.ranks[axis * 8 + x]);
                    let mut rest = word & wanted;
                    let mut next = first;
                    while rest != 0 {
                        let bit = rest.trailing_zeros() as usize;
                        if wanted != u64::MAX {
                            next = first + (word & ((1 << bit) - 1)).count_ones();
                        }
                        let entry = axis * CORNERS + base + x * 81 + (bit >> 3) * 9 + (bit & 7);
                        self.numbers[entry] = next;
                        self.used.push(entry as u16);
                        next += 1;
                        rest &= rest - 1;
                    }
                }
            }
        }
    }

    /// Number of the vertex on an edge of the cell with first corner `cell`; `None` if the edge belongs to an absent
    /// leaf.
    #[inline(always)]
    pub fn vertex(&self, cell: IVec3, edge: u8) -> Option<u32> {
        let first = (cell.x * 81 + cell.y * 9 + cell.z) as usize;
        let number = self.numbers[first + EDGE_STEPS[usize::from(edge)]];
        (number != NO_VERTEX).then_some(number)
    }
}

/// Position of a corner within its cell.
pub(crate) fn corner(c: usize) -> IVec3 {
    IVec3::new((c >> 2) as i32, (c >> 1 & 1) as i32, (c & 1) as i32)
}

/// The voxels with φ < iso.
fn inside_mask(values: &LeafValues, iso: f32) -> LeafMask {
    let mut mask = LeafMask::EMPTY;
    dispatch(Inside { values, iso, mask: &mut mask });
    mask
}

struct Inside<'a> {
    values: &'a LeafValues,
    iso: f32,
    mask: &'a mut LeafMask,
}

impl Work for Inside<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let iso = Lanes::splat(simd, self.iso);
        for (pair, values) in self.values.0.as_chunks::<16>().0.iter().enumerate() {
            let inside = Lanes::from_slice(simd, values).simd_lt(iso).to_bitmask();
            self.mask.0[pair / 4] |= inside << (16 * (pair % 4));
        }
    }
}
