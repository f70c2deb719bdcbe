//! What a file holds: its metadata and its grids, without their voxels.

use glam::{DAffine3, DMat3, DVec3, IVec3};

use super::bridge::ffi;
use super::select;
use crate::grid::Transform;

/// One item of a file's or a grid's metadata.
#[derive(Clone, Debug, PartialEq)]
pub struct MetaItem {
    /// Its key.
    pub name: String,
    /// Its type as OpenVDB names it: "string", "float", "vec3i", "bool"…
    pub type_name: String,
    /// Its value as text.
    pub value: String,
}

/// How the values of a file are compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compression {
    /// Blosc with LZ4: OpenVDB's default.
    Blosc,
    /// Deflate: smaller and much slower. OpenVDB leaves level sets and fog volumes uncompressed with it.
    Zip,
    /// None, except that uniform inactive values are not stored.
    None,
}

impl Compression {
    const ZIP: u32 = 1;
    const ACTIVE_MASK: u32 = 2;
    const BLOSC: u32 = 4;

    pub(super) fn from_flags(flags: u32) -> Self {
        match flags {
            f if f & Self::BLOSC != 0 => Self::Blosc,
            f if f & Self::ZIP != 0 => Self::Zip,
            _ => Self::None,
        }
    }

    /// That of a file: OpenVDB zips neither level sets nor fog volumes, so the grids of one file may differ.
    pub(super) fn of_all(grids: &[GridListing]) -> Option<Self> {
        let any = |wanted| grids.iter().any(|g| g.compression == wanted).then_some(wanted);
        any(Self::Blosc).or_else(|| any(Self::Zip)).or_else(|| any(Self::None))
    }

    pub(super) fn flags(self) -> u32 {
        Self::ACTIVE_MASK
            | match self {
                Self::Blosc => Self::BLOSC,
                Self::Zip => Self::ZIP,
                Self::None => 0,
            }
    }
}

/// How floating-point values are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 32 bits.
    Float,
    /// 16 bits; rounded when written.
    Half,
}

/// A grid as its header describes it.
#[derive(Clone, Debug)]
pub struct GridListing {
    /// Its name; may be empty, and several grids of a file may share one.
    pub name: String,
    /// How to select it: the name, `NAME[n]` when several grids have it or when it is empty.
    pub selector: String,
    /// Type of its values: "float", "double", "vec3s", "ptdataidx32"…
    pub value_type: String,
    /// "level set", "fog volume", "staggered vector field" or "unknown".
    pub class: String,
    /// How its values are stored.
    pub precision: Precision,
    /// How its values are compressed.
    pub compression: Compression,
    /// The grid whose tree this one shares, if any.
    pub instance_of: Option<String>,
    /// The background value of float and double grids.
    pub background: Option<f64>,
    /// OpenVDB's name of the transform's kind.
    pub map_type: String,
    /// Index → world; `None` for a perspective frustum.
    pub to_world: Option<DAffine3>,
    /// Size of a voxel along each axis, in world units.
    pub voxel_size: DVec3,
    /// All of its metadata.
    pub metadata: Vec<MetaItem>,
}

impl GridListing {
    /// The value of a metadata item.
    pub fn meta(&self, name: &str) -> Option<&str> {
        self.metadata.iter().find(|item| item.name == name).map(|item| item.value.as_str())
    }

    /// Number of active voxels, if the file states it.
    pub fn active_voxels(&self) -> Option<u64> {
        self.meta("file_voxel_count")?.parse().ok()
    }

    /// Box of the active voxels, both ends included, if the file states it.
    pub fn active_bounds(&self) -> Option<(IVec3, IVec3)> {
        let corner = |name| {
            let text = self.meta(name)?.trim_matches(['[', ']']);
            let mut numbers = text.split(',').map(|n| n.trim().parse::<i32>());
            let mut next = || numbers.next()?.ok();
            Some(IVec3::new(next()?, next()?, next()?))
        };
        let (lo, hi) = (corner("file_bbox_min")?, corner("file_bbox_max")?);
        lo.cmple(hi).all().then_some((lo, hi))
    }

    /// Whether the values are f32 or f64.
    pub fn is_scalar(&self) -> bool {
        matches!(self.value_type.as_str(), "float" | "double")
    }

    /// Whether the class says that this is a level set.
    pub fn is_level_set(&self) -> bool {
        self.class == "level set"
    }

    /// The transform if a level set can live on it, or the reason why not.
    pub fn uniform_transform(&self) -> Result<Transform, String> {
        match self.to_world {
            Some(affine) => Transform::from_affine(affine),
            None => Err(format!("its transform is a perspective frustum ({})", self.map_type)),
        }
    }

    /// One line for lists: `"density" (fog volume, float)`.
    pub(super) fn summary(&self) -> String {
        format!("`{}` ({}, {})", self.selector, self.class, self.value_type)
    }
}

/// What a file holds.
#[derive(Clone, Debug)]
pub struct FileListing {
    /// Version of the file format, 224 for instance.
    pub file_version: u32,
    /// Version of the library that wrote it.
    pub library_version: (u32, u32),
    /// The tag that OpenVDB gives every file that it writes.
    pub uuid: String,
    /// Whether single grids can be read; files written as a stream must be read whole even to list them.
    pub has_offsets: bool,
    /// The file's metadata.
    pub metadata: Vec<MetaItem>,
    /// The grids, in file order.
    pub grids: Vec<GridListing>,
    /// What OpenVDB had to say while reading.
    pub warnings: Vec<String>,
}

impl FileListing {
    /// The place of the grid that `selector` names, of whatever kind; otherwise the reason.
    pub fn find(&self, selector: &str) -> Result<usize, String> {
        select::named(&self.grids, selector)
    }

    /// The place of the grid that [`VdbFile::select_level_set`](super::VdbFile::select_level_set) would choose; otherwise the
    /// reason why there is none.
    pub fn select_level_set(&self, selector: Option<&str>, assume_level_set: bool) -> Result<usize, String> {
        select::select_level_set(&self.grids, selector, assume_level_set)
    }

    pub(super) fn of(archive: &ffi::Archive) -> Result<Self, cxx::Exception> {
        let header = archive.header()?;
        let mut grids = (0..archive.grid_count())
            .map(|index| Ok(grid_listing(archive.grid_header(index)?)))
            .collect::<Result<Vec<_>, cxx::Exception>>()?;
        name_selectors(&mut grids);
        Ok(Self {
            file_version: header.file_version,
            library_version: (header.library_major, header.library_minor),
            uuid: header.uuid,
            has_offsets: header.has_offsets,
            metadata: items(header.metadata),
            grids,
            warnings: ffi::take_log()?.lines().map(str::to_string).collect(),
        })
    }
}

fn items(entries: Vec<ffi::MetaEntry>) -> Vec<MetaItem> {
    entries.into_iter().map(|e| MetaItem { name: e.name, type_name: e.type_name, value: e.value }).collect()
}

fn grid_listing(header: ffi::GridHeader) -> GridListing {
    let to_world = <&[f64; 16]>::try_from(header.affine.as_slice()).ok().map(|m| {
        let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
        DAffine3::from_mat3_translation(DMat3::from_cols(column(0), column(1), column(2)), column(3))
    });
    GridListing {
        selector: header.name.clone(),
        name: header.name,
        value_type: header.value_type,
        class: header.grid_class,
        precision: if header.half { Precision::Half } else { Precision::Float },
        compression: Compression::from_flags(header.compression),
        instance_of: (!header.instance_of.is_empty()).then_some(header.instance_of),
        background: (!header.background.is_nan()).then_some(header.background),
        map_type: header.map_type,
        to_world,
        voxel_size: DVec3::from_array(header.voxel_size),
        metadata: items(header.metadata),
    }
}

/// Numbers the grids that share a name, or have none.
fn name_selectors(grids: &mut [GridListing]) {
    for i in 0..grids.len() {
        let name = &grids[i].name;
        let count = grids.iter().filter(|g| g.name == *name).count();
        if count > 1 || name.is_empty() {
            let before = grids[..i].iter().filter(|g| g.name == *name).count();
            grids[i].selector = format!("{name}[{before}]");
        }
    }
}
