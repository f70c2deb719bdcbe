//! Reads φ for rays: cells for exact crossings, a smooth spline for normals and curvature.

use glam::{DVec3, IVec3};

use crate::grid::{Grid, LEAF_DIM, LeafId, NeighbourTable, leaf_offset, leaf_origin};

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
        Cursor { field: self, origin: IVec3::ZERO, id: self.grid.find(IVec3::ZERO) }
    }
}

/// Reads a [`Field`]. Positions are in index space.
pub(super) struct Cursor<'a> {
    field: &'a Field<'a>,
    origin: IVec3,
    id: LeafId,
}

impl Cursor<'_> {
    #[inline(always)]
    fn enter(&mut self, ijk: IVec3) {
        let origin = leaf_origin(ijk);
        if origin != self.origin {
            self.origin = origin;
            self.id = self.field.grid.find(origin);
        }
    }

    /// The leaf `q` around the current one, numbered as in [`Neighbours`](crate::grid::Neighbours).
    #[inline(always)]
    fn beside(&self, q: usize) -> LeafId {
        if self.id.is_sentinel() {
            let q = q as i32;
            self.field.grid.find(self.origin + IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * LEAF_DIM)
        } else {
            self.field.neighbours[self.id.index()][q]
        }
    }

    /// φ (world units) at the corners of the cell with first corner `ijk`, in the order x·4 + y·2 + z.
    #[inline(always)]
    pub fn cell(&mut self, ijk: IVec3) -> [f32; 8] {
        self.enter(ijk);
        let local = ijk - self.origin;
        if local.max_element() < LEAF_DIM - 1 {
            let values = &self.field.grid.values(self.id).0[leaf_offset(ijk)..];
            // Within one leaf x is 64 apart, y 8, z 1.
            [0, 1, 8, 9, 64, 65, 72, 73].map(|step| values[step])
        } else {
            self.border_cell(local)
        }
    }

    /// [`cell`](Self::cell) where a corner lies beyond the leaf.
    fn border_cell(&self, local: IVec3) -> [f32; 8] {
        // The leaf of a corner is found once for all corners in it: mostly two.
        let beyond = local.cmpeq(IVec3::splat(LEAF_DIM - 1)).bitmask() as usize;
        let mut leaves = [self.id; 8];
        for (side, leaf) in leaves.iter_mut().enumerate().skip(1) {
            // Bits x, y, z as those of the mask.
            if side & !beyond == 0 {
                *leaf = self.beside(13 + (side & 1) * 9 + (side >> 1 & 1) * 3 + (side >> 2));
            }
        }
        let mut corners = [0.0; 8];
        for (c, corner) in corners.iter_mut().enumerate() {
            let at = local + IVec3::new(c as i32 >> 2, c as i32 >> 1 & 1, c as i32 & 1);
            let side = (c >> 2 | c & 2 | (c & 1) << 2) & beyond;
            *corner = self.field.grid.values(leaves[side]).0[leaf_offset(at)];
        }
        corners
    }

    /// The voxel at `local` relative to the current leaf, at most a leaf away.
    #[inline(always)]
    fn tap(&self, local: IVec3) -> f32 {
        let leaf: IVec3 = local >> 3;
        let id = self.beside((13 + leaf.x * 9 + leaf.y * 3 + leaf.z) as usize);
        self.field.grid.values(id).0[leaf_offset(local)]
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
        let [wx, wy, wz] = [part.x, part.y, part.z].map(spline_weights);
        let first = base - self.origin - 1;
        // Sums over z, then y, then x; the index is the order of the derivative along that axis.
        let mut gradient = DVec3::ZERO;
        let (mut diagonal, mut mixed) = (DVec3::ZERO, DVec3::ZERO);
        for (i, x) in (0..).zip(wx) {
            let mut plane = [[0.0; 3]; 3];
            for (j, y) in (0..).zip(wy) {
                let mut row = [0.0; 3];
                for (k, z) in (0..).zip(wz) {
                    let value = f64::from(self.tap(first + IVec3::new(i, j, k)));
                    for (sum, w) in row.iter_mut().zip(z) {
                        *sum += w * value;
                    }
                }
                for (sums, w) in plane.iter_mut().zip(y) {
                    for (sum, r) in sums.iter_mut().zip(row) {
                        *sum += w * r;
                    }
                }
            }
            gradient += DVec3::new(x[1] * plane[0][0], x[0] * plane[1][0], x[0] * plane[0][1]);
            diagonal += DVec3::new(x[2] * plane[0][0], x[0] * plane[2][0], x[0] * plane[0][2]);
            mixed += DVec3::new(x[0] * plane[1][1], x[1] * plane[0][1], x[1] * plane[1][0]);
        }
        let s = self.field.to_voxels;
        Jet { gradient: gradient * s, diagonal: diagonal * s, mixed: mixed * s }
    }
}

/// Weights of the four taps of the uniform cubic B-spline at `t` in 0..1 of its middle interval, each with its first and
/// second derivative.
fn spline_weights(t: f64) -> [[f64; 3]; 4] {
    let u = 1.0 - t;
    [
        [u * u * u / 6.0, -0.5 * u * u, u],
        [(3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0, 1.5 * t * t - 2.0 * t, 3.0 * t - 2.0],
        [(3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0, 2.0 * u - 1.5 * u * u, 3.0 * u - 2.0],
        [t * t * t / 6.0, 0.5 * t * t, t],
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
