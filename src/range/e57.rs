//! E57: point clouds with poses in a binary file with checksums and a description in XML (ASTM E2807).
//!
//! A cloud with rows and columns is the map of a turning head. One without them but with a pose is taken for what a scanner there saw: its points
//! are sorted into pixels by their directions. A cloud with neither may have been seen from anywhere, so that nothing is known of the rays.

use std::io::Cursor;
use std::path::Path;

use ::e57::{CartesianCoordinate, E57Reader, PointCloud};
use glam::{DAffine3, DQuat, DVec3};

use super::files::{bytes, name};
use super::turning::Scan;
use super::{MOST_PIXELS, RangeMap, RangeSet, rigid};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

pub(super) fn read(path: &Path, run: &RunOptions) -> Result<RangeSet> {
    let mut set = RangeSet::default();
    let Some(bytes) = bytes(path)? else {
        set.missing.push(path.into());
        return Ok(set);
    };
    let refused = |e: ::e57::Error| EditError::input(path, format!("is no E57 file that can be read: {e}"));
    E57Reader::validate_crc(Cursor::new(&bytes)).map_err(refused)?;
    let mut reader = E57Reader::new(Cursor::new(&bytes)).map_err(refused)?;
    for (n, cloud) in reader.pointclouds().into_iter().enumerate() {
        let title = match &cloud.name {
            Some(own) if !own.is_empty() => format!("{} scan {} ({own})", name(path), n + 1),
            _ => format!("{} scan {}", name(path), n + 1),
        };
        let pose = pose(&cloud).map_err(|problem| EditError::input(path, format!("scan {}: {problem}", n + 1)))?;
        let ordered = cloud.has_row_column();
        if !ordered && cloud.transform.is_none() {
            set.warnings.push(format!(
                "{title}: its points have neither rows and columns nor a scanner's pose, so that nothing is known of their rays: left out"
            ));
            continue;
        }
        // A point takes a bit of the file at least.
        if cloud.records as f64 > MOST_PIXELS.min(bytes.len() as f64 * 8.0) {
            return Err(EditError::input(path, format!("scan {} claims {} points", n + 1, cloud.records)));
        }
        let mut loose = Loose::default();
        let mut points = reader.pointcloud_simple(&cloud).map_err(refused)?;
        points.apply_pose(false);
        points.spherical_to_cartesian(true);
        points.intensity_to_color(false);
        for (k, point) in points.enumerate() {
            if k % 65536 == 0 {
                run.check("reading")?;
            }
            let point = point.map_err(refused)?;
            let CartesianCoordinate::Valid { x, y, z } = point.cartesian else { continue };
            let xyz = DVec3::new(x, y, z);
            if !xyz.is_finite() || xyz == DVec3::ZERO {
                continue;
            }
            loose.places.push([point.column, point.row]);
            loose.points.push(xyz);
            if let Some(color) = point.color {
                let byte = |c: f32| (c.clamp(0.0, 1.0) * 255.0).round() as u8;
                loose.colors.push([byte(color.red), byte(color.green), byte(color.blue)]);
            }
        }
        let (map, warning) = match ordered {
            true => loose.ordered(title.clone(), pose).map_or((None, None), |(map, warning)| (Some(map), warning)),
            false => (loose.scan(title.clone(), pose).loose(), None),
        };
        set.warnings.extend(warning);
        match map {
            Some(map) => set.maps.push(map),
            None => set.warnings.push(format!("{title}: no point holds a measurement: left out")),
        }
    }
    Ok(set)
}

fn pose(cloud: &PointCloud) -> Result<DAffine3, String> {
    let Some(::e57::Transform { rotation: q, translation: t }) = &cloud.transform else {
        return Ok(DAffine3::IDENTITY);
    };
    rigid(DQuat::from_xyzw(q.x, q.y, q.z, q.w), DVec3::new(t.x, t.y, t.z))
}

/// Points as they come.
#[derive(Default)]
struct Loose {
    /// Column and row.
    places: Vec<[i64; 2]>,
    points: Vec<DVec3>,
    colors: Vec<[u8; 3]>,
}

impl Loose {
    fn scan(self, name: String, pose: DAffine3) -> Scan {
        let colors = if self.colors.len() == self.points.len() { self.colors } else { Vec::new() };
        Scan { name, pose, points: self.points.into_iter().map(Some).collect(), colors }
    }

    /// Points at their rows and columns.
    fn ordered(self, name: String, pose: DAffine3) -> Option<(RangeMap, Option<String>)> {
        let extent = |axis: usize| {
            let of = || self.places.iter().map(|place| place[axis]);
            Some((of().min()?, of().max()?))
        };
        let (across, along) = (extent(0)?, extent(1)?);
        let count = |(lo, hi): (i64, i64)| hi.checked_sub(lo)?.checked_add(1).and_then(|n| usize::try_from(n).ok());
        let (columns, rows) = (count(across)?, count(along)?);
        if columns as f64 * rows as f64 > MOST_PIXELS {
            return None;
        }
        let mut points = vec![None; columns * rows];
        let colored = self.colors.len() == self.points.len();
        let mut colors = vec![[0; 3]; if colored { points.len() } else { 0 }];
        for (n, (place, point)) in self.places.iter().zip(&self.points).enumerate() {
            let at = (place[0] - across.0) as usize * rows + (place[1] - along.0) as usize;
            points[at] = Some(*point);
            if colored {
                colors[at] = self.colors[n];
            }
        }
        Scan { name, pose, points, colors }.ordered(columns, rows)
    }
}
