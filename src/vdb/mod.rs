//! OpenVDB files: reading, writing, and OpenVDB's own tools as a second opinion.
//!
//! [`list`] says what a file holds without loading voxels; [`open`] reads it whole; [`VdbFile::read_level_set`] makes a
//! level set of one of its grids; [`write()`] puts level sets back beside everything else the file held. [`mod@reference`] runs
//! OpenVDB's own operators for comparison.
//!
//! The C++ side is in `cpp/` and small on purpose: `archive.cc` and `output.cc` (files), `grid.cc` (leaves and tiles), `vector.cc` (components of vectors), `reference.cc`
//! and `reference_morph.cc` (OpenVDB's tools). Every C++ exception becomes an error here; nothing that OpenVDB logs reaches standard output.
//!
//! A truncated or damaged file is an error wherever it shows: the bytes end early, a grid does not begin or end where the
//! file says, or bytes are left over. OpenVDB itself loads files cut short without a word when they are not compressed by blosc.

mod band;
mod bridge;
mod listing;
mod read;
pub mod reference;
mod scalar;
mod select;
mod structure;
mod vector;
mod write;

pub use band::{Band, BandFacts, Range, diagnose_band};
pub use listing::{Compression, FileListing, GridListing, MetaItem, Precision};
pub use read::{ReadLevelSet, VdbFile, library_version, list, open, set_threads, trim_heap};
pub use write::{
    FieldToWrite, GridToWrite, VectorsToWrite, WriteOptions, WriteReport, write, write_with_fields, write_with_vectors,
};
