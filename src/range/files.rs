//! Sets of range maps, by the kind of their file.

use std::path::{Path, PathBuf};

use super::{RangeMap, e57, ptx, stanford, toml};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

/// Range maps, and what was said while they were read.
#[derive(Clone, Debug, Default)]
pub struct RangeSet {
    /// The maps that could be read and hold a measurement.
    pub maps: Vec<RangeMap>,
    /// What the user should know.
    pub warnings: Vec<String>,
    /// Files that are not there.
    pub missing: Vec<PathBuf>,
}

impl RangeSet {
    /// Reads a set from a `.toml`, `.conf`, `.ptx` or `.e57`. Without `skip_missing`, a scan that is not there is an error.
    ///
    /// A description in TOML, paths relative to it, poses from the scanner's frame to the world:
    ///
    /// ```toml
    /// version = 1
    /// units = 1.0                     # world units a unit of the files
    /// noise = 0.002                   # world units; estimated where it is not given
    /// background = "unknown"          # or "empty": rays without a measurement meet nothing
    /// scale = 0.001                   # pictures: units a count
    /// camera = { focal = [525, 525], centre = [319.5, 239.5] }   # or the path of a JSON file of Open3D
    /// trajectory = "trajectory.log"   # 4x4 poses, one a map
    ///
    /// [[map]]
    /// file = "depth/00000.png"        # or an .exr, a PLY with a range grid, a .ptx or an .e57
    /// pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]   # instead of the trajectory
    /// color = "color/00000.png"       # a picture of as many pixels
    /// confidence = "amplitude.png"    # a picture of amplitudes, with
    /// noise_table = [[100, 0.01], [1000, 0.002]]   # amplitude and standard deviation
    /// ```
    ///
    /// `noise`, `background`, `scale` and `camera` may stand in a `[[map]]` as well; `orthographic = { pitch = [x, y], first = [x, y] }` instead of a camera
    /// means parallel rays along −z.
    pub fn read(path: &Path, skip_missing: bool, run: &RunOptions) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let mut set = match ending.as_str() {
            "toml" => toml::read(path, run)?,
            "conf" => stanford::read_conf(path, run)?,
            "ptx" => ptx::read(path)?,
            "e57" => e57::read(path, run)?,
            _ => {
                let accepted = "of an unknown kind; sets of range maps are .toml, .conf, .ptx or .e57";
                return Err(EditError::input(path, accepted));
            }
        };
        for missing in &set.missing {
            if !skip_missing {
                let problem = "there is no such file; `skip_missing` uses the other scans";
                return Err(EditError::input(missing, problem));
            }
            set.warnings.push(format!("{}: there is no such file: left out", missing.display()));
        }
        let warnings = &mut set.warnings;
        set.maps.retain(|map| {
            let empty = map.count() == 0;
            if empty {
                warnings.push(format!("{}: no pixel holds a measurement: left out", map.name));
            }
            !empty
        });
        if set.maps.is_empty() {
            let why: Vec<&str> = set.warnings.iter().map(String::as_str).take(3).collect();
            let why = if why.is_empty() { String::new() } else { format!("; {}", why.join("; ")) };
            return Err(EditError::input(path, format!("holds no range map with a measurement{why}")));
        }
        Ok(set)
    }
}

/// The folder that relative paths of a file begin in.
pub(super) fn beside(path: &Path, name: &str) -> PathBuf {
    path.parent().unwrap_or_else(|| Path::new("")).join(name)
}

/// A file's bytes; `None` if it is not there.
pub(super) fn bytes(path: &Path) -> Result<Option<Vec<u8>>> {
    match std::fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(EditError::input(path, format!("cannot be read: {error}"))),
    }
}

/// A file's text; `None` if it is not there.
pub(super) fn text(path: &Path) -> Result<Option<String>> {
    Ok(bytes(path)?.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()))
}

/// The name of a file, for reports.
pub(super) fn name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}
