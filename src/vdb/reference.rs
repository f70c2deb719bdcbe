//! OpenVDB's own tools on our level sets: the second opinion that tests and `crosscheck` compare with.
//!
//! A [`ReferenceGrid`] is held by OpenVDB; conversions copy whole leaves. Distances are in world units and positive outwards,
//! as everywhere here (OpenVDB's own offset erodes when positive).

use std::path::Path;

use cxx::UniquePtr;
use glam::Vec3;

use super::bridge::ffi;
use super::listing::{Compression, Precision};
use super::read::read_grid;
use super::write::{WriteOptions, copy_leaves, matrix, to_openvdb};
use crate::error::{EditError, Result};
use crate::grid::Transform;
use crate::levelset::LevelSet;

/// The upwind differences that OpenVDB's tracker renormalises with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReferenceScheme {
    /// First order.
    First,
    /// Hamilton–Jacobi WENO, fifth order: OpenVDB's default.
    HjWeno5,
}

/// How OpenVDB's tracker works. The default is OpenVDB's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tracker {
    /// Spatial scheme.
    pub scheme: ReferenceScheme,
    /// Order of the TVD Runge–Kutta integrator, 1 to 3.
    pub runge_kutta: u32,
    /// Normalisations a track.
    pub normalizations: u32,
}

impl Default for Tracker {
    fn default() -> Self {
        Self { scheme: ReferenceScheme::HjWeno5, runge_kutta: 1, normalizations: 3 }
    }
}

impl Tracker {
    fn raw(&self) -> ffi::TrackerOptions {
        ffi::TrackerOptions {
            weno5: self.scheme == ReferenceScheme::HjWeno5,
            runge_kutta: self.runge_kutta,
            normalizations: self.normalizations,
        }
    }
}

/// A filter of OpenVDB's level set tools; each step is followed by a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Filter {
    /// So many steps of mean curvature flow, each dx²/3.
    MeanCurvature(usize),
    /// So many steps of the Laplacian, each dx²/6.
    Laplacian(usize),
    /// Gaussian of this width in voxels.
    Gaussian(i32),
    /// Mean over a box of this width in voxels.
    Mean(i32),
    /// Median over a box of this width in voxels.
    Median(i32),
    /// Moves the surface outwards by this distance in world units.
    Offset(f32),
    /// Dilates the band, renormalises and trims.
    Track,
    /// Renormalises alone.
    Normalize,
}

/// A constructive operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Csg {
    /// Minimum.
    Union,
    /// Maximum.
    Intersection,
    /// Maximum with the complement.
    Difference,
}

/// A mesh as OpenVDB extracts it, still held by OpenVDB.
pub struct ReferenceMesh {
    raw: UniquePtr<ffi::RawMesh>,
}

impl ReferenceMesh {
    /// Vertices in world space.
    pub fn points(&self) -> Result<Vec<Vec3>> {
        let mut flat = vec![0.0; self.raw.point_count() * 3];
        self.raw.points(&mut flat).map_err(failed)?;
        Ok(flat.chunks_exact(3).map(Vec3::from_slice).collect())
    }

    /// Triangles; none unless adaptive.
    pub fn triangles(&self) -> Result<Vec<[u32; 3]>> {
        let mut triangles = vec![[0; 3]; self.raw.triangle_count()];
        self.raw.triangles(triangles.as_flattened_mut()).map_err(failed)?;
        Ok(triangles)
    }

    /// Quadrilaterals.
    pub fn quads(&self) -> Result<Vec<[u32; 4]>> {
        let mut quads = vec![[0; 4]; self.raw.quad_count()];
        self.raw.quads(quads.as_flattened_mut()).map_err(failed)?;
        Ok(quads)
    }

    /// All polygons as triangles: quadrilaterals parted by the diagonal from their first corner. As OpenVDB turns them,
    /// clockwise seen from outside.
    pub fn all_triangles(&self) -> Result<Vec<[u32; 3]>> {
        let halves = self.quads()?.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]);
        Ok(halves.chain(self.triangles()?).collect())
    }
}

/// A float grid held by OpenVDB.
pub struct ReferenceGrid {
    grid: UniquePtr<ffi::FloatGrid>,
    transform: Transform,
}

fn failed(e: cxx::Exception) -> EditError {
    EditError::Unmet { operation: "OpenVDB".into(), problem: e.what().into() }
}

impl ReferenceGrid {
    /// A copy of a level set.
    pub fn from_level_set(level_set: &LevelSet) -> Result<Self> {
        Ok(Self { grid: to_openvdb(level_set, copy_leaves).map_err(failed)?, transform: *level_set.transform() })
    }

    /// A copy as a level set of ours: values, masks and signs.
    pub fn to_level_set(&self) -> Result<LevelSet> {
        let leaves = ffi::float_grid_leaves(&self.grid).map_err(failed)?;
        let (grid, _) = read_grid(&leaves, self.transform.voxel_size())
            .map_err(|problem| EditError::Unmet { operation: "OpenVDB".into(), problem })?;
        Ok(LevelSet::new(grid, self.transform))
    }

    /// OpenVDB's meshToLevelSet: triangles in world space, half width in voxels.
    pub fn from_mesh(points: &[Vec3], triangles: &[[u32; 3]], transform: Transform, half_width: f32) -> Result<Self> {
        Self::converted(points, triangles, transform, half_width, true)
    }

    /// As [`from_mesh`](Self::from_mesh), without what it does to the distances in the end (`DISABLE_RENORMALIZATION`,
    /// `DISABLE_INTERSECTING_VOXEL_REMOVAL`).
    pub fn from_mesh_unnormalized(
        points: &[Vec3],
        triangles: &[[u32; 3]],
        transform: Transform,
        half_width: f32,
    ) -> Result<Self> {
        Self::converted(points, triangles, transform, half_width, false)
    }

    fn converted(
        points: &[Vec3],
        triangles: &[[u32; 3]],
        transform: Transform,
        half_width: f32,
        renormalize: bool,
    ) -> Result<Self> {
        let flat: Vec<f32> = points.iter().flat_map(|p| p.to_array()).collect();
        let grid =
            ffi::mesh_to_level_set(&flat, triangles.as_flattened(), &matrix(&transform), half_width, renormalize);
        Ok(Self { grid: grid.map_err(failed)?, transform })
    }

    /// A deep copy.
    pub fn duplicate(&self) -> Result<Self> {
        Ok(Self { grid: ffi::copy_grid(&self.grid).map_err(failed)?, transform: self.transform })
    }

    /// Applies a filter in place.
    pub fn apply(&mut self, filter: Filter, tracker: &Tracker) -> Result<()> {
        let (grid, raw) = (self.grid.pin_mut(), &tracker.raw());
        match filter {
            Filter::MeanCurvature(steps) => ffi::filter_mean_curvature(grid, steps, raw),
            Filter::Laplacian(steps) => ffi::filter_laplacian(grid, steps, raw),
            Filter::Gaussian(width) => ffi::filter_gaussian(grid, width, raw),
            Filter::Mean(width) => ffi::filter_mean(grid, width, raw),
            Filter::Median(width) => ffi::filter_median(grid, width, raw),
            Filter::Offset(distance) => ffi::filter_offset(grid, distance, raw),
            Filter::Track => ffi::track(grid, raw),
            Filter::Normalize => ffi::normalize(grid, raw),
        }
        .map_err(failed)
    }

    /// OpenVDB's `LevelSetMorphing` towards `target` for a time, spatial scheme and Runge–Kutta order first; returns its steps.
    pub fn morph(
        &mut self,
        target: &Self,
        time: f32,
        scheme: ReferenceScheme,
        runge_kutta: u32,
        tracker: &Tracker,
    ) -> Result<usize> {
        let weno5 = scheme == ReferenceScheme::HjWeno5;
        ffi::morph(self.grid.pin_mut(), &target.grid, time, weno5, runge_kutta, &tracker.raw()).map_err(failed)
    }

    /// OpenVDB's sdfToSdf: distances again by fast sweeping, in the same voxels.
    pub fn sweep(&self, iterations: i32) -> Result<Self> {
        let grid = ffi::sdf_to_sdf(&self.grid, iterations).map_err(failed)?;
        Ok(Self { grid, transform: self.transform })
    }

    /// OpenVDB's dilateSdf: distances by fast sweeping in so many more layers of face neighbours.
    pub fn sweep_outwards(&self, voxels: i32, iterations: i32) -> Result<Self> {
        let grid = ffi::dilate_sdf(&self.grid, voxels, iterations).map_err(failed)?;
        Ok(Self { grid, transform: self.transform })
    }

    /// One step of mean curvature flow, weighted by the values of `mask` (0 to 1, as active voxels of a grid).
    pub fn mean_curvature_masked(&mut self, mask: &Self, tracker: &Tracker) -> Result<()> {
        ffi::filter_mean_curvature_masked(self.grid.pin_mut(), &mask.grid, &tracker.raw()).map_err(failed)
    }

    /// A constructive operation into a new grid. Both must have the same transform.
    pub fn csg(&self, other: &Self, operation: Csg) -> Result<Self> {
        let grid = match operation {
            Csg::Union => ffi::csg_union(&self.grid, &other.grid),
            Csg::Intersection => ffi::csg_intersection(&self.grid, &other.grid),
            Csg::Difference => ffi::csg_difference(&self.grid, &other.grid),
        };
        Ok(Self { grid: grid.map_err(failed)?, transform: self.transform })
    }

    /// OpenVDB's levelSetRebuild at `iso` (world units), half width in voxels.
    pub fn rebuild(&self, iso: f32, half_width: f32) -> Result<Self> {
        let grid = ffi::level_set_rebuild(&self.grid, iso, half_width).map_err(failed)?;
        Ok(Self { grid, transform: self.transform })
    }

    /// OpenVDB's volumeToMesh at `iso` (world units).
    pub fn to_mesh(&self, iso: f64, adaptivity: f64) -> Result<ReferenceMesh> {
        Ok(ReferenceMesh { raw: ffi::volume_to_mesh(&self.grid, iso, adaptivity).map_err(failed)? })
    }

    /// Writes a file of this grid alone through OpenVDB's own interface, neither flushed nor verified; float and blosc if `options` say nothing.
    pub fn write(&mut self, path: &Path, options: &WriteOptions) -> Result<()> {
        self.grid.pin_mut().set_half(options.precision == Some(Precision::Half)).map_err(failed)?;
        let compression = options.compression.unwrap_or(Compression::Blosc).flags();
        ffi::plain_write(&self.grid, path.as_os_str().as_encoded_bytes(), compression).map_err(failed)
    }

    /// Reads the float grid of a file through OpenVDB's own interface, voxels included; `transform` is what it has.
    pub fn read(path: &Path, transform: Transform) -> Result<Self> {
        let grid = ffi::plain_read(path.as_os_str().as_encoded_bytes()).map_err(failed)?;
        Ok(Self { grid, transform })
    }

    /// OpenVDB's levelSetArea, in world units squared.
    pub fn area(&self) -> Result<f64> {
        ffi::level_set_area(&self.grid).map_err(failed)
    }

    /// OpenVDB's levelSetVolume, in world units cubed.
    pub fn volume(&self) -> Result<f64> {
        ffi::level_set_volume(&self.grid).map_err(failed)
    }
}
