//! Scans: dense boxes of numbers from NRRD and NIfTI files, and the surfaces in them.
//!
//! A sample lies at integer (x, y, z), x fastest; an affine map places it in the world, in the unit and the axes of the file (NRRD says
//! left or right in `space`, NIfTI is right-anterior-superior; neither is turned). What lies outside the box, and NaN, is outside of every
//! surface. A level set has cubic voxels: other spacings are resampled.

mod nifti;
mod nrrd;
mod samples;

use std::path::Path;

use glam::{DAffine3, DMat3, DVec3, IVec3};
use rayon::prelude::*;

use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, LEAF_VOXELS, LeafMask, LeafValues, Transform, Volume, offset_to_local};
use crate::levelset::{BYTES_A_LEAF, LevelSet, grid_of_leaves};
use crate::run::RunOptions;

/// File name endings of scans.
pub const EXTENSIONS: [&str; 4] = [".nrrd", ".nhdr", ".nii", ".nii.gz"];

/// Most samples along an axis, so that no index overflows; and in all, four terabytes.
const MOST_ALONG: usize = 1 << 20;
const MOST_SAMPLES: usize = 1 << 40;

/// Relative difference of spacings, and cosine between axes, that is a rounding of the file: NIfTI's numbers are `f32`.
const ROUNDED: f64 = 1e-5;

/// A box of numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Scan {
    size: [usize; 3],
    values: Vec<f32>,
    to_world: DAffine3,
}

/// Whether a path is a scan's, by its ending.
pub fn is_scan(path: &Path) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
    EXTENSIONS.iter().any(|ending| name.ends_with(ending))
}

/// Which side of a value is inside.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Inside {
    /// Where there is more: densities, intensities.
    #[default]
    Above,
    /// Where there is less: distances, cavities.
    Below,
}

impl Inside {
    /// Negative inside: iso − value, or value − iso.
    pub fn field(self, value: f32, iso: f32) -> f32 {
        match self {
            Self::Above => iso - value,
            Self::Below => value - iso,
        }
    }
}

impl Scan {
    /// A box of `size` samples, x fastest.
    pub fn new(size: [usize; 3], values: Vec<f32>, to_world: DAffine3) -> Result<Self, String> {
        if size.iter().any(|n| *n == 0 || *n > MOST_ALONG) {
            return Err(format!("has {size:?} samples along its axes; 1 to {MOST_ALONG} are read"));
        }
        if size.iter().product::<usize>() != values.len() {
            return Err(format!("holds {} samples, not {size:?}", values.len()));
        }
        let finite = to_world.matrix3.to_cols_array().iter().all(|v| v.is_finite()) && to_world.translation.is_finite();
        if !(finite && to_world.matrix3.determinant() != 0.0) {
            return Err("its axes do not span space".into());
        }
        Ok(Self { size, values, to_world })
    }

    /// The box around all that a sparse volume stores; `None` if that is nothing.
    pub fn of_volume(volume: &Volume, run: &RunOptions) -> Result<Option<Self>, EditError> {
        let Some((lo, hi)) = volume.index_bounds() else { return Ok(None) };
        let size = (hi.as_i64vec3() - lo.as_i64vec3() + 1).to_array().map(|n| n as usize);
        run.reserve("reading a volume", samples_bytes(size), "take a smaller volume")?;
        let refuse = |problem: String| EditError::parameter("reading a volume", "size", format!("{size:?}"), problem);
        if size.iter().any(|n| *n > MOST_ALONG) || samples_bytes(size) / 4 > MOST_SAMPLES as u64 {
            return Err(refuse(format!("up to {MOST_ALONG} voxels along an axis, {MOST_SAMPLES} in all")));
        }
        let [nx, ny, _] = size;
        let mut values = vec![0.0; size.iter().product()];
        values.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
            for (at, value) in slice.iter_mut().enumerate() {
                *value = volume.value(lo + IVec3::new((at % nx) as i32, (at / nx) as i32, z as i32));
            }
        });
        let to_world = volume.transform().to_world();
        let place = to_world.transform_point3(lo.as_dvec3());
        Self::new(size, values, DAffine3::from_mat3_translation(to_world.matrix3, place)).map(Some).map_err(refuse)
    }

    /// Reads a file. Memory is bounded by what the file can hold before any is taken.
    pub fn read(path: &Path, run: &RunOptions) -> Result<Self> {
        let name = path.to_string_lossy().to_lowercase();
        let read = if name.ends_with(".nrrd") || name.ends_with(".nhdr") { nrrd::read } else { nifti::read };
        read(path, run)
    }

    /// Samples along each axis.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Index space → world space.
    pub fn to_world(&self) -> DAffine3 {
        self.to_world
    }

    /// Smallest and largest number; `None` if all are NaN.
    pub fn range(&self) -> Option<(f32, f32)> {
        let join = |a: (f32, f32), b: (f32, f32)| (a.0.min(b.0), a.1.max(b.1));
        let known = self.values.par_iter().filter(|v| !v.is_nan()).map(|v| (*v, *v));
        known.reduce_with(join)
    }

    /// The number at a sample; NaN outside the box.
    pub fn value(&self, ijk: IVec3) -> f32 {
        let [nx, ny, nz] = self.size;
        let inside = ijk.min_element() >= 0 && (ijk.x as usize) < nx && (ijk.y as usize) < ny && (ijk.z as usize) < nz;
        if !inside {
            return f32::NAN;
        }
        self.values[(ijk.z as usize * ny + ijk.y as usize) * nx + ijk.x as usize]
    }

    /// Every number changed.
    pub fn mapped(mut self, f: impl Fn(f32) -> f32 + Sync) -> Self {
        self.values.par_iter_mut().for_each(|v| *v = f(*v));
        self
    }

    /// The placement as a level set's, if its voxels are cubes but for the rounding of the file.
    pub fn transform(&self) -> Result<Transform, String> {
        let DMat3 { x_axis: x, y_axis: y, z_axis: z } = self.to_world.matrix3;
        let sizes = [x.length(), y.length(), z.length()];
        let mean = sizes.iter().sum::<f64>() / 3.0;
        let cosines = [x.dot(y), y.dot(z), z.dot(x)].map(|d| d.abs() / (mean * mean));
        if sizes.iter().all(|s| (s - mean).abs() <= ROUNDED * mean) && cosines.iter().all(|c| *c <= ROUNDED) {
            return Transform::from_affine(DAffine3::from_mat3_translation(
                orthonormal(self.to_world.matrix3) * mean,
                self.to_world.translation,
            ));
        }
        Transform::from_affine(self.to_world)
    }

    /// The scan on cubes with the edge of its smallest spacing, by trilinear interpolation, and what was changed; as it is if its voxels are
    /// cubes already.
    pub fn on_cubes(self, run: &RunOptions) -> Result<(Self, Option<String>), String> {
        if self.transform().is_ok() {
            return Ok((self, None));
        }
        let matrix = self.to_world.matrix3;
        let sizes = [matrix.x_axis.length(), matrix.y_axis.length(), matrix.z_axis.length()];
        let edge = sizes.into_iter().fold(f64::INFINITY, f64::min);
        let cubes = DAffine3::from_mat3_translation(orthonormal(matrix) * edge, self.to_world.translation);
        Transform::from_affine(cubes)?;
        let there = cubes.inverse() * self.to_world;
        let last = self.size.map(|n| (n - 1) as f64);
        let corners = (0..8).map(|c| {
            let pick = |axis: usize| if c >> axis & 1 == 1 { last[axis] } else { 0.0 };
            there.transform_point3(DVec3::new(pick(0), pick(1), pick(2)))
        });
        let (lo, hi) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)));
        // A hair is the rounding of a whole number.
        let (lo, hi) = ((lo + 1e-6).floor(), (hi + 1e-6).floor());
        let count = (hi - lo + 1.0).to_array();
        if count.iter().any(|n| !(*n >= 1.0 && *n <= MOST_ALONG as f64)) {
            return Err(format!("would need {count:?} cubes of {edge} world units"));
        }
        let size = count.map(|n| n as usize);
        run.reserve("resampling a scan", samples_bytes(size), "take a coarser scan").map_err(|e| e.to_string())?;
        let cubes = DAffine3::from_mat3_translation(cubes.matrix3, cubes.transform_point3(lo));
        let back = self.to_world.inverse() * cubes;
        let [nx, ny, _] = size;
        let mut values = vec![0.0; size.iter().product()];
        values.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
            if !run.is_cancelled() {
                for (at, value) in slice.iter_mut().enumerate() {
                    let ijk = DVec3::new((at % nx) as f64, (at / nx) as f64, z as f64);
                    *value = self.trilinear(back.transform_point3(ijk));
                }
            }
        });
        let said = format!(
            "its samples of {} x {} x {} world units were resampled to cubes of {edge}",
            sizes[0], sizes[1], sizes[2]
        );
        Ok((Self::new(size, values, cubes)?, Some(said)))
    }

    /// Trilinear interpolation in index space; NaN outside the box.
    fn trilinear(&self, p: DVec3) -> f32 {
        let last = DVec3::from(self.size.map(|n| (n - 1) as f64));
        // The rounding of a point on the border.
        const RIM: f64 = 1e-6;
        if !(p.cmpge(DVec3::splat(-RIM)).all() && p.cmple(last + RIM).all()) {
            return f32::NAN;
        }
        let p = p.clamp(DVec3::ZERO, last);
        let floor = p.floor().min((last - 1.0).max(DVec3::ZERO));
        let (cell, t) = (floor.as_ivec3(), p - floor);
        let top = last.as_ivec3();
        let at = |x: i32, y: i32, z: i32| f64::from(self.value((cell + IVec3::new(x, y, z)).min(top)));
        let lerp = |a: f64, b: f64, t: f64| if t == 0.0 { a } else { a + (b - a) * t };
        let row = |y: i32, z: i32| lerp(at(0, y, z), at(1, y, z), t.x);
        let slab = |z: i32| lerp(row(0, z), row(1, z), t.y);
        lerp(slab(0), slab(1), t.z) as f32
    }

    /// The field whose zero set is the surface at `iso`, with leaves where that runs: negative inside, linear as the scan is, no distance.
    /// Its voxels must be cubes. `None` if no sample is inside.
    pub fn iso_field(&self, iso: f32, inside: Inside, run: &RunOptions) -> Result<Option<LevelSet>, EditError> {
        const OPERATION: &str = "the surface of a scan";
        let transform = self.transform().map_err(|problem| EditError::parameter(OPERATION, "scan", "", problem))?;
        let Some((least, most)) = self.range() else { return Ok(None) };
        let of_range = [inside.field(least, iso), inside.field(most, iso)];
        let background = of_range[0].abs().max(of_range[1].abs());
        if of_range[0].min(of_range[1]) >= 0.0 || !background.is_finite() {
            return Ok(None);
        }
        let field = |ijk: IVec3| {
            let value = inside.field(self.value(ijk), iso);
            if value.is_nan() { background } else { value }
        };
        let leaves_along = self.size.map(|n| (n as i32 + LEAF_DIM) / LEAF_DIM + 1);
        let origin = |n: usize| {
            let [_, ny, nz] = leaves_along.map(|n| n as usize);
            (IVec3::new((n / (ny * nz)) as i32, (n / nz % ny) as i32, (n % nz) as i32) - 1) * LEAF_DIM
        };
        let count: usize = leaves_along.iter().map(|n| *n as usize).product();
        let is_crossed = |origin: &IVec3| {
            let mut seen = [false; 2];
            for n in 0..1000 {
                let step = IVec3::new(n / 100, n / 10 % 10, n % 10) - 1;
                seen[usize::from(field(*origin + step) < 0.0)] = true;
                if seen == [true; 2] {
                    return true;
                }
            }
            false
        };
        let crossed: Vec<IVec3> =
            (0..count).into_par_iter().map(origin).filter(|o| !run.is_cancelled() && is_crossed(o)).collect();
        run.check(OPERATION)?;
        run.reserve(OPERATION, crossed.len() as u64 * BYTES_A_LEAF, "take a coarser scan")?;
        let leaves = crossed
            .into_par_iter()
            .map(|origin| {
                let mut values = LeafValues::default();
                for at in 0..LEAF_VOXELS {
                    values.0[at] = field(origin + offset_to_local(at));
                }
                (origin, values, LeafMask::FULL)
            })
            .collect();
        Ok(Some(LevelSet::new(grid_of_leaves(background, leaves), transform)))
    }
}

/// Bytes of a box of numbers.
fn samples_bytes(size: [usize; 3]) -> u64 {
    size.iter().fold(size_of::<f32>() as u64, |bytes, n| bytes.saturating_mul(*n as u64))
}

/// The nearest axes at right angles, x kept (Gram and Schmidt).
fn orthonormal(matrix: DMat3) -> DMat3 {
    let x = matrix.x_axis.normalize();
    let y = (matrix.y_axis - x * x.dot(matrix.y_axis)).normalize();
    let z = x.cross(y);
    DMat3::from_cols(x, y, if z.dot(matrix.z_axis) < 0.0 { -z } else { z })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{Rebuild, rebuild};

    /// A ball of radius 6 world units around (8, 9, 10) as a density that falls by 10 a world unit, 0 on its surface.
    fn ball(spacing: DVec3, turn: DMat3) -> Scan {
        let extent = DVec3::new(16.0, 18.0, 20.0);
        let size = (extent / spacing).to_array().map(|n| n as usize + 1);
        let to_world =
            DAffine3::from_mat3_translation(turn * DMat3::from_diagonal(spacing), DVec3::new(5.0, 0.0, -2.0));
        let [nx, ny, nz] = size;
        let values = (0..nx * ny * nz).map(|i| {
            let ijk = DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / nx / ny) as f64);
            (10.0 * (6.0 - (ijk * spacing - DVec3::new(8.0, 9.0, 10.0)).length())) as f32
        });
        Scan::new(size, values.collect(), to_world).unwrap()
    }

    #[test]
    fn surfaces_lie_where_the_scan_has_the_value_whatever_its_spacing() {
        let run = RunOptions::default();
        let turned = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.8);
        let mirrored = DMat3::from_diagonal(DVec3::new(-1.0, -1.0, 1.0));
        for (spacing, turn) in [
            (DVec3::splat(0.5), DMat3::IDENTITY),
            (DVec3::splat(0.5), turned),
            (DVec3::new(0.4, 0.4, 1.0), mirrored),
            (DVec3::new(0.9, 0.5, 0.6), turned),
        ] {
            let (cubes, said) = ball(spacing, turn).on_cubes(&run).unwrap();
            assert_eq!(said.is_some(), spacing.min_element() != spacing.max_element());
            for (iso, radius) in [(0.0, 6.0), (20.0, 4.0)] {
                let field = cubes.iso_field(iso, Inside::Above, &run).unwrap().unwrap();
                let level_set = rebuild(&field, &Rebuild::band(3.0), &run).unwrap();
                assert!(level_set.check().is_empty(), "{:?}", level_set.check());
                let measured = level_set.measure(&run).unwrap();
                let volume = 4.0 / 3.0 * std::f64::consts::PI * f64::powi(radius, 3);
                // Chords cut h²/(8 R) off the radius, h the largest spacing.
                let tolerance = 3.0 * (spacing.max_element() / radius).powi(2) / 2.0;
                assert!(
                    (measured.volume / volume - 1.0).abs() < tolerance,
                    "{spacing} {iso}: {}",
                    measured.volume / volume
                );
                assert_eq!((measured.components, measured.euler), (1, 2));
                let centre = DVec3::new(5.0, 0.0, -2.0) + turn * DVec3::new(8.0, 9.0, 10.0);
                let (lo, hi) = level_set.world_bounds().unwrap();
                assert!(((lo + hi) / 2.0 - centre).length() < 1.1 * spacing.max_element(), "{centre} {lo} {hi}");
            }
        }
    }

    #[test]
    fn the_other_side_the_border_and_nothing() {
        let run = RunOptions::default();
        let scan = ball(DVec3::splat(0.5), DMat3::IDENTITY);
        // Below: the box without the ball, closed by its border, which lies half a voxel outside at most.
        let outside = scan.iso_field(0.0, Inside::Below, &run).unwrap().unwrap();
        let level_set = rebuild(&outside, &Rebuild::band(3.0), &run).unwrap();
        let measured = level_set.measure(&run).unwrap();
        assert_eq!((measured.components, measured.euler), (1, 4), "an outer and an inner surface");
        let volume = 16.0 * 18.0 * 20.0 - 4.0 / 3.0 * std::f64::consts::PI * 216.0;
        assert!((measured.volume / volume - 1.0).abs() < 0.1);
        assert!(scan.iso_field(1000.0, Inside::Above, &run).unwrap().is_none());
        assert!(scan.clone().mapped(|_| f32::NAN).iso_field(0.0, Inside::Above, &run).unwrap().is_none());
        let mut limited = RunOptions::default();
        limited.memory_limit = Some(1000);
        assert_eq!(scan.iso_field(0.0, Inside::Above, &limited).err().unwrap().exit_code(), 5);
    }

    #[test]
    fn endings() {
        for (name, is) in
            [("a.nrrd", true), ("b.NII.GZ", true), ("c.nii", true), ("d.nhdr", true), ("e.gz", false), ("f.vdb", false)]
        {
            assert_eq!(is_scan(Path::new(name)), is, "{name}");
        }
    }
}
