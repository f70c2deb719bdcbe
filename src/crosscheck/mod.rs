//! Ours beside OpenVDB's: the same operation on the same grid in one process, timed in turn, and the results compared.
//!
//! Each row runs both sides alternately, so that a busy machine slows both; the ratio is the median of the ratios of
//! neighbouring runs. Grids are copied and converted outside the timed part. Where the two compute the same thing the
//! results must agree within the tolerance; where ours is exact and OpenVDB's is not (`offset`, `rebuild`) both are
//! held against the distance to the polygonised surface, by looking up the closest triangle. So are the two conversions of a
//! mesh, to its own triangles; [`Mutual`] says how far they are from each other.

mod cases;
mod contest;
mod difference;
mod files;
mod polygons;

use std::cell::OnceCell;
use std::time::{Duration, Instant};

use serde::Serialize;

use cases::{CASES, Case};
pub use difference::Mutual;

use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, TriangleMesh, level_set_to_mesh};
use crate::run::RunOptions;

/// One operation on both sides.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The operation.
    pub operator: &'static str,
    /// Numerical scheme on both sides.
    pub scheme: &'static str,
    /// Median time of ours, in milliseconds.
    pub ours_ms: f64,
    /// Median time of OpenVDB's, in milliseconds.
    pub openvdb_ms: f64,
    /// OpenVDB's time over ours: median, smallest and largest of the pairs of runs.
    pub ratio: f64,
    /// See [`ratio`](Self::ratio).
    pub ratio_min: f64,
    /// See [`ratio`](Self::ratio).
    pub ratio_max: f64,
    /// Largest difference (or, against the truth, our largest error) on active voxels, in voxels.
    pub max_diff_voxels: f64,
    /// Root mean square of the same.
    pub rms_diff_voxels: f64,
    /// Voxels active on one side only.
    pub active_diff: u64,
    /// OpenVDB's largest error, where both are held against the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub openvdb_max_error_voxels: Option<f64>,
    /// How the two compare with each other, where both are held against the mesh that they were made of.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub mutual: Option<Mutual>,
    /// What the difference may be.
    pub tolerance_voxels: f64,
    /// Of meshes: our area over OpenVDB's, less 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area_difference: Option<f64>,
    /// Of meshes: our volume over OpenVDB's, less 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volume_difference: Option<f64>,
    /// Area of ours and of OpenVDB's over that of the mesh that the level set was made from, less 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area_to_source: Option<[f64; 2]>,
    /// The same of the volume.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volume_to_source: Option<[f64; 2]>,
    /// Of files: the median of ours less that of OpenVDB's, in microseconds a leaf.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub us_a_leaf_over_openvdb: Option<f64>,
    /// Of writing: what copying to OpenVDB's grid takes, in microseconds a leaf.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub copy_us_a_leaf: Option<f64>,
}

impl Row {
    /// Whether the difference is within the tolerance. A mesh must also have OpenVDB's area and volume to 0.1 %, or be nearer
    /// than OpenVDB's to those of the mesh that the level set was made from, if there is one.
    pub fn passes(&self) -> bool {
        let right = |difference: Option<f64>, to_source: Option<[f64; 2]>| {
            let alike = difference.is_none_or(|d| d.abs() <= 1e-3);
            alike || to_source.is_none_or(|[ours, theirs]| ours.abs() <= theirs.abs())
        };
        self.max_diff_voxels <= self.tolerance_voxels
            && right(self.area_difference, self.area_to_source)
            && right(self.volume_difference, self.volume_to_source)
    }
}

/// What all rows work on.
struct Input<'a> {
    level_set: &'a LevelSet,
    /// The mesh that it was made from.
    source: Option<&'a TriangleMesh>,
    run: &'a RunOptions,
    surface: OnceCell<TriangleMesh>,
    truth: OnceCell<Bvh>,
}

impl Input<'_> {
    /// The polygonised surface, made when the first row asks for it.
    fn surface(&self) -> Result<&TriangleMesh> {
        let made = match self.surface.get() {
            Some(_) => None,
            None => Some(level_set_to_mesh(self.level_set, 0.0, self.run)?),
        };
        Ok(self.surface.get_or_init(|| made.unwrap_or_default()))
    }

    /// The triangles of the polygonised surface in index space, to look up the closest.
    fn truth(&self) -> Result<&Bvh> {
        let surface = self.surface()?;
        Ok(self.truth.get_or_init(|| difference::bvh(surface, self.level_set.transform())))
    }
}

/// Fewest runs of a row, and those that are wanted unless they take longer than this.
const RUNS: (usize, usize) = (2, 5);
const ENOUGH: Duration = Duration::from_secs(20);
/// Rows of a few milliseconds, which other programs disturb most, are run more often: so many times in so much time.
const MOST_RUNS: usize = 31;
const SHORT: Duration = Duration::from_secs(2);

/// The names of all rows, in order.
pub fn operators() -> impl Iterator<Item = &'static str> + Clone {
    CASES.iter().map(|case| case.operator)
}

/// Runs the rows named in `only` (all if it is empty) on `level_set`; `done` gets each row as it is finished.
///
/// `source` is the mesh that the level set was made from; without it, rows that need a mesh take the polygonised surface.
pub fn crosscheck(
    level_set: &LevelSet,
    source: Option<&TriangleMesh>,
    only: &[String],
    run: &RunOptions,
    mut done: impl FnMut(&Row),
) -> Result<Vec<Row>> {
    if let Some(name) = only.iter().find(|name| !operators().any(|operator| operator == name.as_str())) {
        return Err(EditError::parameter("crosscheck", "only", name, crate::spec::suggest(name, operators())));
    }
    let wanted = |case: &&Case| only.is_empty() || only.iter().any(|name| name == case.operator);
    let task = run.task("crosscheck", CASES.iter().filter(wanted).count() as u64);
    let input = Input { level_set, source, run, surface: OnceCell::new(), truth: OnceCell::new() };
    let mut rows = Vec::new();
    for case in CASES.iter().filter(wanted) {
        run.check("crosscheck")?;
        let row = measure(case, &input)?;
        done(&row);
        rows.push(row);
        task.advance(1);
    }
    Ok(rows)
}

fn measure(case: &Case, input: &Input) -> Result<Row> {
    let mut contest = (case.contest)(input)?;
    let began = Instant::now();
    let (mut ours_ms, mut theirs_ms) = (Vec::new(), Vec::new());
    let more = |runs: usize| {
        let limit = if runs < RUNS.1 { ENOUGH } else { SHORT };
        runs < RUNS.0 || (runs < MOST_RUNS && began.elapsed() < limit)
    };
    while more(ours_ms.len()) {
        input.run.check("crosscheck")?;
        ours_ms.push(contest.ours()?);
        theirs_ms.push(contest.theirs()?);
    }
    let ratios: Vec<f64> = ours_ms.iter().zip(&theirs_ms).map(|(ours, theirs)| theirs / ours).collect();
    let difference = contest.difference()?;
    Ok(Row {
        operator: case.operator,
        scheme: case.scheme,
        ours_ms: median(&ours_ms),
        openvdb_ms: median(&theirs_ms),
        ratio: median(&ratios),
        ratio_min: ratios.iter().copied().fold(f64::INFINITY, f64::min),
        ratio_max: ratios.iter().copied().fold(0.0, f64::max),
        max_diff_voxels: difference.max,
        rms_diff_voxels: difference.rms(),
        active_diff: difference.active,
        openvdb_max_error_voxels: difference.openvdb_max,
        mutual: difference.mutual,
        tolerance_voxels: case.tolerance,
        area_difference: difference.area,
        volume_difference: difference.volume,
        area_to_source: difference.area_to_source,
        volume_to_source: difference.volume_to_source,
        us_a_leaf_over_openvdb: difference.leaves.map(|n| (median(&ours_ms) - median(&theirs_ms)) * 1e3 / n),
        copy_us_a_leaf: difference.copy_us_a_leaf,
    })
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => 0.0,
        n if n % 2 == 1 => sorted[n / 2],
        n => (sorted[n / 2 - 1] + sorted[n / 2]) / 2.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::shape::Shape;
    use crate::ops::{Operator, WorldLength};

    #[test]
    fn every_row_passes_on_a_torus() {
        let run = RunOptions::default();
        let shape = Shape {
            spec: "torus major=1 minor=0.4".into(),
            voxel_size: Some(WorldLength::new(0.05)),
            ..Shape::default()
        };
        let torus = shape.apply(Vec::new(), &run).unwrap().level_set;
        let mut seen = Vec::new();
        let rows = crosscheck(&torus, None, &[], &run, |row| seen.push(row.operator)).unwrap();
        assert!(operators().eq(seen));
        for row in &rows {
            assert!(row.passes(), "{row:?}");
            assert!(row.mutual.iter().all(|mutual| mutual.missigned_by_ours == 0), "{row:?}");
            assert!(row.ratio_min <= row.ratio && row.ratio <= row.ratio_max && row.ours_ms > 0.0, "{row:?}");
        }
        let only = crosscheck(&torus, None, &["track".into()], &run, |_| ()).unwrap();
        assert_eq!(only.len(), 1);
        let error = crosscheck(&torus, None, &["trak".into()], &run, |_| ()).unwrap_err();
        assert!(error.to_string().contains("did you mean `track`"));
    }
}
