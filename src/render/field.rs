//! Reads φ for rays: cells for exact crossings, a smooth spline for normals and curvature.

use glam::{DVec3, IVec3};

use crate::grid::{Grid, LEAF_DIM, LeafId, LeafValues, NeighbourTable, leaf_offset, leaf_origin};

/// A level set's values with the tables that make neighbouring leaves cheap to read.
pub(super) struct Field<'a> {
    grid: &'a Grid,
    neighbours: NeighbourTable<'a>,
    /// Voxels per world unit: turns stored values into voxels.
    to_voxels: f64,
}

/// First and second derivatives of φ at a point, in voxels and along index axes.
#[derive(Clone, Copy)]
pub(super) struct Jet {
    pub gradient: DVec3,
    /// Second derivatives xx, yy, zz.
    diagonal: DVec3,
    /// Second derivatives yz, xz, xy.
    mixed: DVec3,
}

impl Jet {
    /// H = div(∇φ/|∇φ|)/2 in 1/voxel, positive on convex parts; 0 where there is no gradient.
    pub fn mean_curvature(&self) -> f64 {
        let Self { gradient: g, diagonal: d, mixed: m } = *self;
        let g2 = g * g;
        let norm2 = g2.element_sum();
        if norm2 < 1e-8 {
            return 0.0;
        }
        let across = g2.x * (d.y + d.z) + g2.y * (d.x + d.z) + g2.z * (d.x + d.y);
        let cross = g.y * g.z * m.x + g.x * g.z * m.y + g.x * g.y * m.z;
        (across - 2.0 * cross) / (2.0 * norm2 * norm2.sqrt())
    }
}

impl<'a> Field<'a> {
    pub fn new(grid: &'a Grid, voxel_size: f64) -> Self {
        Self { grid, neighbours: grid.neighbours(), to_voxels: 1.0 / voxel_size }
    }

    /// Voxels per world unit.
    #[inline(always)]
    pub fn to_voxels(&self) -> f64 {
        self.to_voxels
    }

    /// A reader for one ray or pixel, which remembers the last leaf.
    pub fn cursor(&self) -> Cursor<'_> {
        let id = self.grid.find(IVec3::ZERO);
        Cursor { field: self, origin: IVec3::ZERO, id, leaf: self.grid.values(id) }
    }
}

/// Reads a [`Field`]. Positions are in index space.
pub(super) struct Cursor<'a> {
    field: &'a Field<'a>,
    origin: IVec3,
    id: LeafId,
    leaf: &'a LeafValues,
}

impl<'a> Cursor<'a> {
    #[inline(always)]
    fn enter(&mut self, ijk: IVec3) {
        let origin = leaf_origin(ijk);
        if origin != self.origin {
            self.origin = origin;
            self.id = self.field.grid.find(origin);
            self.leaf = self.field.grid.values(self.id);
        }
    }

    /// The leaf `q` around the current one, numbered as in [`Neighbours`](crate::grid::Neighbours).
    #[inline(always)]
    fn around(&self, q: usize) -> &'a LeafValues {
        let grid = self.field.grid;
        let id = if self.id.is_sentinel() {
            let q = q as i32;
            grid.find(self.origin + IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * LEAF_DIM)
        } else {
            self.field.neighbours[self.id.index()][q]
        };
        grid.values(id)
    }

    /// φ (world units) at the corners of the cell with first corner `ijk`, in the order x·4 + y·2 + z.
    #[inline(always)]
    pub fn cell(&mut self, ijk: IVec3) -> [f32; 8] {
        self.enter(ijk);
        let local = ijk - self.origin;
        if local.max_element() < LEAF_DIM - 1 {
            let values = &self.leaf.0[leaf_offset(ijk)..];
            // Within one leaf x is 64 apart, y 8, z 1.
            let at = |step: usize| values[step];
            [at(0), at(1), at(8), at(9), at(64), at(65), at(72), at(73)]
        } else {
            self.border_cell(local)
        }
    }

    /// [`cell`](Self::cell) where a corner lies beyond the leaf.
    fn border_cell(&self, local: IVec3) -> [f32; 8] {
        // Bits x, y, z.
        let beyond = local.cmpeq(IVec3::splat(LEAF_DIM - 1)).bitmask() as usize;
        // The leaf of a corner is found once for all corners in it: mostly two.
        let mut leaves = [self.leaf; 8];
        for (side, leaf) in leaves.iter_mut().enumerate().skip(1) {
            if side & !beyond == 0 {
                *leaf = self.around(13 + (side & 1) * 9 + (side >> 1 & 1) * 3 + (side >> 2));
            }
        }
        let mut corners = [0.0; 8];
        for (c, corner) in corners.iter_mut().enumerate() {
            let at = local + IVec3::new(c as i32 >> 2, c as i32 >> 1 & 1, c as i32 & 1);
            let side = (c >> 2 | c & 2 | (c & 1) << 2) & beyond;
            *corner = leaves[side].0[leaf_offset(at)];
        }
        corners
    }

    /// Derivatives of the cubic B-spline whose coefficients are the voxels (4³ taps).
    ///
    /// It smooths over about one voxel and its gradient is C¹: shading shows neither the cells nor their borders, while
    /// a crease stays as sharp as the grid can hold it. Interpolating kernels keep the grid's ripple, which light shows.
    pub fn jet(&mut self, ijk: DVec3) -> Jet {
        let floor = ijk.floor();
        let base = floor.as_ivec3();
        self.enter(base);
        let part = ijk - floor;
        let [wx, wy, wz] = [part.x, part.y, part.z].map(|t| spline_weights(t as f32));
        let taps = self.taps(base - self.origin - 1);
        // Sums over x, then y, then z; the indices are the orders of the derivatives along those axes.
        let over_x = |d: usize| {
            let mut plane = [0.0f32; 16];
            for (taps, w) in taps.chunks_exact(16).zip(&wx[d]) {
                plane.iter_mut().zip(taps).for_each(|(sum, tap)| *sum += w * tap);
            }
            plane
        };
        let over_y = |plane: &[f32; 16], d: usize| {
            let mut row = [0.0f32; 4];
            for (taps, w) in plane.chunks_exact(4).zip(&wy[d]) {
                row.iter_mut().zip(taps).for_each(|(sum, tap)| *sum += w * tap);
            }
            row
        };
        let over_z =
            |row: [f32; 4], d: usize| -> f64 { row.iter().zip(&wz[d]).map(|(tap, w)| f64::from(tap * w)).sum() };
        let [p0, p1, p2] = [over_x(0), over_x(1), over_x(2)];
        let [r00, r01, r02] = [over_y(&p0, 0), over_y(&p0, 1), over_y(&p0, 2)];
        let [r10, r11, r20] = [over_y(&p1, 0), over_y(&p1, 1), over_y(&p2, 0)];
        let s = self.field.to_voxels;
        Jet {
            gradient: s * DVec3::new(over_z(r10, 0), over_z(r01, 0), over_z(r00, 1)),
            diagonal: s * DVec3::new(over_z(r20, 0), over_z(r02, 0), over_z(r00, 2)),
            mixed: s * DVec3::new(over_z(r01, 1), over_z(r10, 1), over_z(r11, 0)),
        }
    }

    /// The 4³ voxels from `first`, relative to the current leaf and at most a leaf away; z runs fastest.
    #[inline(always)]
    fn taps(&self, first: IVec3) -> [f32; 64] {
        let mut taps = [0.0; 64];
        let mut leaf = (usize::MAX, self.leaf);
        for (row, taps) in (0..).zip(taps.chunks_exact_mut(4)) {
            let at = first + IVec3::new(row >> 2, row & 3, 0);
            for (z, tap) in (at.z..).zip(taps) {
                let voxel = IVec3::new(at.x, at.y, z);
                let beside: IVec3 = voxel >> 3;
                let q = (13 + beside.x * 9 + beside.y * 3 + beside.z) as usize;
                // Found once for all that lie in it, one after the other.
                if q != leaf.0 {
                    leaf = (q, self.around(q));
                }
                *tap = leaf.1.0[leaf_offset(voxel)];
            }
        }
        taps
    }
}

/// Weights of the four taps of the uniform cubic B-spline at `t` in 0..1 of its middle interval, with its first and second derivative.
#[inline(always)]
fn spline_weights(t: f32) -> [[f32; 4]; 3] {
    let u = 1.0 - t;
    [
        [
            u * u * u / 6.0,
            (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
            (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0,
            t * t * t / 6.0,
        ],
        [-0.5 * u * u, 1.5 * t * t - 2.0 * t, 2.0 * u - 1.5 * u * u, 0.5 * t * t],
        [u, 3.0 * t - 2.0, 3.0 * u - 2.0, t],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::LevelSet;
    use crate::render::testing::sphere;

    /// Points on and near a sphere of radius `r` around the origin.
    fn points(r: f64) -> impl Iterator<Item = (DVec3, DVec3)> {
        (0..400).map(move |i| {
            let a = f64::from(i) * 2.399963;
            let z = 1.0 - (f64::from(i) + 0.5) / 200.0;
            let n = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            (n, n * (r + 0.1 * f64::from(i % 3 - 1)))
        })
    }

    #[test]
    fn normals_and_curvature_of_a_sphere() {
        let set: LevelSet = sphere(20.0, 4.0);
        let field = Field::new(set.grid(), set.voxel_size());
        let mut cursor = field.cursor();
        for (n, p) in points(20.0) {
            let jet = cursor.jet(p);
            // The spline of a distance errs by O(h²/r²) in direction; its curvature by O(h²/r³), plus the smoothing.
            assert!((jet.gradient.normalize() - n).length() < 1e-3);
            assert!((jet.mean_curvature() - 0.05).abs() < 1e-3, "{}", jet.mean_curvature());
        }
    }

    #[test]
    fn cells_across_leaves_equal_single_voxels() {
        let set = sphere(20.0, 3.0);
        let field = Field::new(set.grid(), set.voxel_size());
        let mut cursor = field.cursor();
        for (_, p) in points(19.0).chain(points(30.0)) {
            for shift in 0..8 {
                let cell = p.floor().as_ivec3() + shift;
                let corners = cursor.cell(cell);
                for (c, v) in corners.into_iter().enumerate() {
                    let c = c as i32;
                    let ijk = cell + IVec3::new(c >> 2, c >> 1 & 1, c & 1);
                    assert_eq!(v, set.grid().voxel(ijk).0);
                }
            }
        }
    }
}
