//! Curvature of the level sets of φ at the voxels of the band.

use fearless_simd::{Simd, SimdBase, SimdMask};

use super::{Field, LevelSet};
use crate::error::Result;
use crate::grid::{Grid, LEAF_VOXELS, LeafMask, LeafSet, LeafValues, PageLeaves};
use crate::run::RunOptions;
use crate::stencil::Halo;
use crate::stencil::normals::curvatures;
use crate::stencil::simd::{Work, dispatch};

/// Which curvature. All are positive on convex parts and in 1/world, the Gaussian one in 1/world².
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurvatureKind {
    /// H = (κ₁ + κ₂)/2.
    Mean,
    /// K = κ₁ κ₂.
    Gaussian,
    /// κ₂, the smaller principal curvature.
    Min,
    /// κ₁, the larger principal curvature.
    Max,
}

const OPERATION: &str = "curvature";

/// The curvature at each voxel of the band, of the level set of φ that passes through it, by differences of normals
/// ([`curvatures`]); κ and H between ±1/h.
///
/// Voxels whose stencil (18 neighbours, up to √2 voxels away) leaves the band have no value: they are inactive and 0. With a
/// half width of 3, the least that level sets are made with, all eight corners of every cell that a plane cuts have one:
/// for a unit normal n the farthest neighbour of a corner is at most Σ|nᵢ| + (the two largest |nᵢ|) ≤ 3 voxels away from it.
pub fn curvature(level_set: &LevelSet, kind: CurvatureKind, run: &RunOptions) -> Result<Field> {
    curvature_of(level_set, kind, level_set.grid().leaf_set(), run)
}

/// As [`curvature`], of some leaves alone: the voxels of others have no value.
pub fn curvature_of(level_set: &LevelSet, kind: CurvatureKind, leaves: &LeafSet, run: &RunOptions) -> Result<Field> {
    let source = level_set.grid();
    let bytes = leaves.len() as u64 * (size_of::<LeafValues>() + size_of::<LeafMask>()) as u64;
    run.reserve(OPERATION, bytes, "a coarser grid needs less")?;
    let mut grid = source.zeroed_on(leaves);
    // All tasks read the neighbours: computed before they start, not by the first of them.
    source.neighbours();
    let voxel_size = level_set.voxel_size() as f32;
    grid.update_pages(leaves, |leaves, values, masks| {
        if !run.is_cancelled() {
            dispatch(Page { source, kind, voxel_size, leaves, values, masks });
        }
    });
    run.check(OPERATION)?;
    Ok(Field::new(grid, *level_set.transform()))
}

/// The leaves of one page.
struct Page<'a> {
    source: &'a Grid,
    kind: CurvatureKind,
    voxel_size: f32,
    leaves: PageLeaves,
    values: &'a mut [LeafValues],
    masks: &'a mut [LeafMask],
}

impl Work for Page<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut halo = Halo::new();
        let background = self.source.background();
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let (values, mask) = (&mut self.values[PageLeaves::slot(id)], &mut self.masks[PageLeaves::slot(id)]);
                halo.gather(self.source.value_pages(), &self.source.neighbours()[id.index()]);
                let mut known = LeafMask::EMPTY;
                mask.for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let all = curvatures(simd, &halo, x, y, self.voxel_size);
                        let found = match self.kind {
                            CurvatureKind::Mean => all.mean,
                            CurvatureKind::Gaussian => all.gaussian,
                            CurvatureKind::Min => all.min,
                            CurvatureKind::Max => all.max,
                        };
                        let inside = all.reach.simd_lt(background).to_bitmask() & u64::from(bits);
                        known.0[x] |= inside << (y * 8);
                        found.store_slice(&mut values.0[at..at + 16]);
                    },
                );
                *mask = known;
                for offset in 0..LEAF_VOXELS {
                    if !known.get(offset) {
                        values.0[offset] = 0.0;
                    }
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::grid::offset_to_local;
    use crate::levelset::testing::{ball, torus};

    /// Calls `f` with position and value of each active voxel.
    fn for_each(field: &Field, mut f: impl FnMut(DVec3, f64)) {
        let grid = field.grid();
        for &id in grid.leaves() {
            for o in grid.mask(id).iter() {
                f((grid.origin(id) + offset_to_local(o)).as_dvec3(), f64::from(grid.values(id).0[o]));
            }
        }
    }

    #[test]
    fn of_a_ball_everywhere_that_the_stencil_fits() {
        let centre = DVec3::new(0.3, 0.2, -0.4);
        let level_set = ball(centre, 20.0);
        for kind in [CurvatureKind::Mean, CurvatureKind::Gaussian, CurvatureKind::Min, CurvatureKind::Max] {
            let field = curvature(&level_set, kind, &RunOptions::default()).unwrap();
            let (mut count, mut worst) = (0, 0.0f64);
            for_each(&field, |p, k| {
                let r = (p - centre).length();
                let exact = if kind == CurvatureKind::Gaussian { r.powi(-2) } else { 1.0 / r };
                worst = worst.max((k / exact - 1.0).abs());
                count += 1;
            });
            // Relative errors of the scheme: (h/R)² of H, twice that of K, and the root of it for the principal curvatures.
            let tolerance = match kind {
                CurvatureKind::Mean => 0.0025,
                CurvatureKind::Gaussian => 0.005,
                _ => 0.05,
            };
            assert!(worst < tolerance, "{kind:?} {worst}");
            assert!(field.range().unwrap().0 > 0.0);
            // At least every voxel within 3 − √2 voxels of the surface, and no voxel in the last half of a voxel of the band.
            let shell = |a: f64, b: f64| 4.0 / 3.0 * std::f64::consts::PI * ((20.0 + b).powi(3) - (20.0 + a).powi(3));
            assert!(f64::from(count) > shell(-1.58, 1.58) && f64::from(count) < shell(-2.5, 2.5), "{count}");
            assert!(!field.accessor().is_active(glam::IVec3::ZERO) && field.accessor().value(glam::IVec3::ZERO) == 0.0);
        }
    }

    #[test]
    fn all_corners_of_cells_that_the_surface_cuts_have_a_value() {
        let level_set = torus(20.0, 8.0);
        let field = curvature(&level_set, CurvatureKind::Mean, &RunOptions::default()).unwrap();
        let (mut phi, mut found) = (level_set.grid().accessor(), field.accessor());
        let mut cells = 0;
        for &id in level_set.grid().leaves() {
            for o in level_set.grid().mask(id).iter() {
                let ijk = level_set.grid().origin(id) + offset_to_local(o);
                let corners = phi.cell(ijk);
                if corners.iter().any(|v| *v < 0.0) && corners.iter().any(|v| *v >= 0.0) {
                    cells += 1;
                    for c in 0..8 {
                        assert!(found.is_active(ijk + glam::IVec3::new(c >> 2, c >> 1 & 1, c & 1)));
                    }
                }
            }
        }
        assert!(cells > 1000);
    }
}
