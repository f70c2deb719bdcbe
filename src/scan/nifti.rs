//! NIfTI-1 scans: the header by the crate `nifti`, the samples read here, since the crate allocates what the header asks for.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use flate2::read::MultiGzDecoder;
use glam::{DAffine3, DMat3, DQuat, DVec3};
use nifti::{Endianness, NiftiHeader};

use super::Scan;
use super::samples::{Encoding, Kind, Samples};
use crate::error::{EditError, Result};
use crate::run::RunOptions;

/// Reads a `.nii`, compressed or not.
pub(super) fn read(path: &Path, run: &RunOptions) -> Result<Scan> {
    let refuse = |problem: String| EditError::input(path, problem);
    let failed = |e: std::io::Error| refuse(format!("cannot be read: {e}"));
    let mut file = File::open(path).map_err(|e| refuse(format!("cannot be opened: {e}")))?;
    let bytes = file.metadata().map_err(failed)?.len();
    let mut magic = [0; 2];
    let is_gzip = file.read_exact(&mut magic).is_ok() && magic == [0x1f, 0x8b];
    file.rewind().map_err(failed)?;
    let header = match is_gzip {
        true => NiftiHeader::from_reader(MultiGzDecoder::new(BufReader::new(&file))),
        false => NiftiHeader::from_reader(BufReader::new(&file)),
    };
    let header = header.map_err(|e| refuse(format!("is no NIfTI-1 file: {e}")))?;
    file.rewind().map_err(failed)?;
    let encoding = if is_gzip { Encoding::Gzip } else { Encoding::Raw };
    let samples = samples(&header, encoding).map_err(refuse)?;
    let to_world = placement(&header).map_err(refuse)?;
    if !(352.0..=1e9).contains(&header.vox_offset) {
        return Err(refuse(format!("its samples begin at byte {}; 352 or more was expected", header.vox_offset)));
    }
    let skip = header.vox_offset as u64;
    samples.reserve(bytes.saturating_sub(if is_gzip { 0 } else { skip }), run)?.map_err(refuse)?;
    let mut values = samples.read(&file, skip, run).map_err(refuse)?;
    run.check("reading a scan")?;
    let (slope, intercept) = (header.scl_slope, header.scl_inter);
    if slope != 0.0 && slope.is_finite() && intercept.is_finite() && (slope, intercept) != (1.0, 0.0) {
        values.iter_mut().for_each(|v| *v = *v * slope + intercept);
    }
    Scan::new(samples.size, values, to_world).map_err(refuse)
}

fn samples(header: &NiftiHeader, encoding: Encoding) -> Result<Samples, String> {
    if &header.magic != b"n+1\0" {
        return Err("has its samples in another file; one file (.nii or .nii.gz) is read".into());
    }
    let axes = usize::from(header.dim[0]);
    if !(3..=7).contains(&axes) || header.dim[4..=axes.max(4)].iter().skip(usize::from(axes < 4)).any(|n| *n > 1) {
        return Err(format!("has dimensions {:?}; one volume of three axes is read", &header.dim[1..]));
    }
    let kind = match header.datatype {
        2 => Kind::U8,
        4 => Kind::I16,
        8 => Kind::I32,
        16 => Kind::F32,
        64 => Kind::F64,
        256 => Kind::I8,
        512 => Kind::U16,
        768 => Kind::U32,
        1024 => Kind::I64,
        1280 => Kind::U64,
        other => return Err(format!("holds values of type {other}; whole numbers and floats up to 64 bits are read")),
    };
    Ok(Samples {
        size: [1, 2, 3].map(|k| usize::from(header.dim[k])),
        kind,
        big_endian: header.endianness == Endianness::Big,
        encoding,
    })
}

/// The affine map: that of `sform`, else of `qform`, else of the spacings alone.
fn placement(header: &NiftiHeader) -> Result<DAffine3, String> {
    let spacing = DVec3::new(header.pixdim[1].into(), header.pixdim[2].into(), header.pixdim[3].into()).abs();
    let rows = [header.srow_x, header.srow_y, header.srow_z].map(|row| row.map(f64::from));
    if header.sform_code > 0 {
        let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
        return Ok(DAffine3::from_mat3_translation(DMat3::from_cols(column(0), column(1), column(2)), column(3)));
    }
    if !(spacing.is_finite() && spacing.min_element() > 0.0) {
        return Err(format!("has samples of {spacing} units; positive spacings are wanted"));
    }
    if header.qform_code <= 0 {
        return Ok(DAffine3::from_scale(spacing));
    }
    let [b, c, d] = [header.quatern_b, header.quatern_c, header.quatern_d].map(f64::from);
    let a = (1.0 - b * b - c * c - d * d).max(0.0).sqrt();
    let turn = DMat3::from_quat(DQuat::from_xyzw(b, c, d, a).normalize());
    // The sign of the third axis is kept apart, as a quaternion holds no mirror.
    let side = if header.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let scale = DMat3::from_diagonal(spacing * DVec3::new(1.0, 1.0, side));
    let place = DVec3::new(header.quatern_x.into(), header.quatern_y.into(), header.quatern_z.into());
    Ok(DAffine3::from_mat3_translation(turn * scale, place))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    /// A header of 348 bytes and four of no extension, then 2 x 3 x 4 samples of 16 bits: 0, 10, 20, …
    fn file(big_endian: bool, change: impl FnOnce(&mut Vec<u8>, &dyn Fn(f32) -> [u8; 4])) -> Vec<u8> {
        let short = |v: i16| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
        let long = |v: i32| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
        let float = |v: f32| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
        let mut bytes = vec![0; 352];
        bytes[..4].copy_from_slice(&long(348));
        for (k, n) in [3, 2, 3, 4, 1, 1, 1, 1].into_iter().enumerate() {
            bytes[40 + 2 * k..42 + 2 * k].copy_from_slice(&short(n));
        }
        bytes[70..72].copy_from_slice(&short(4));
        bytes[72..74].copy_from_slice(&short(16));
        for (k, v) in [1.0, 0.5, 0.5, 2.0].into_iter().enumerate() {
            bytes[76 + 4 * k..80 + 4 * k].copy_from_slice(&float(v));
        }
        bytes[108..112].copy_from_slice(&float(352.0));
        bytes[344..348].copy_from_slice(b"n+1\0");
        change(&mut bytes, &float);
        for k in 0..24 {
            bytes.extend(short(k * 10));
        }
        bytes
    }

    fn read_bytes(name: &str, bytes: &[u8]) -> Result<Scan> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        Scan::read(&path, &RunOptions::default())
    }

    #[test]
    fn both_byte_orders_plain_and_compressed() {
        for big_endian in [false, true] {
            let bytes = file(big_endian, |_, _| ());
            let scan = read_bytes("a.nii", &bytes).unwrap();
            assert_eq!((scan.size, scan.range()), ([2, 3, 4], Some((0.0, 230.0))));
            assert_eq!(scan.value(glam::IVec3::new(1, 2, 3)), 230.0);
            assert_eq!(scan.value(glam::IVec3::new(0, 1, 0)), 20.0);
            assert_eq!(scan.to_world, DAffine3::from_scale(DVec3::new(0.5, 0.5, 2.0)));
            let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
            gzip.write_all(&bytes).unwrap();
            assert_eq!(read_bytes("a.nii.gz", &gzip.finish().unwrap()).unwrap(), scan);
        }
    }

    #[test]
    fn slopes_and_placements() {
        let scaled = file(false, |bytes, float| {
            bytes[112..116].copy_from_slice(&float(0.1));
            bytes[116..120].copy_from_slice(&float(-5.0));
        });
        let scan = read_bytes("a.nii", &scaled).unwrap();
        assert!((scan.value(glam::IVec3::new(1, 2, 3)) - 18.0).abs() < 1e-5);
        // A quarter turn around z: b = c = 0, d = sin 45°, and a mirrored third axis.
        let turned = file(false, |bytes, float| {
            bytes[252..254].copy_from_slice(&1i16.to_le_bytes());
            bytes[76..80].copy_from_slice(&float(-1.0));
            bytes[264..268].copy_from_slice(&float(0.5f32.sqrt()));
            bytes[268..272].copy_from_slice(&float(7.0));
        });
        let to_world = read_bytes("a.nii", &turned).unwrap().to_world;
        let p = to_world.transform_point3(DVec3::new(2.0, 0.0, 1.0));
        assert!((p - DVec3::new(7.0, 1.0, -2.0)).length() < 1e-6, "{p}");
        let placed = file(false, |bytes, float| {
            bytes[254..256].copy_from_slice(&2i16.to_le_bytes());
            for (k, v) in [0.0, 3.0, 0.0, 1.0, 3.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0, 4.0].into_iter().enumerate() {
                bytes[280 + 4 * k..284 + 4 * k].copy_from_slice(&float(v));
            }
        });
        let scan = read_bytes("a.nii", &placed).unwrap();
        assert_eq!(scan.to_world.transform_point3(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(7.0, 5.0, 13.0));
        assert_eq!(scan.transform().unwrap().voxel_size(), 3.0);
    }

    #[test]
    fn damaged_files_are_refused() {
        let whole = file(false, |_, _| ());
        for (bytes, part) in [
            (whole[..whole.len() - 1].to_vec(), "truncated"),
            (whole[..100].to_vec(), "is no NIfTI"),
            (b"hello".to_vec(), "is no NIfTI"),
            (file(false, |b, _| b[70] = 128), "type 128"),
            (file(false, |b, _| b[40..44].copy_from_slice(&[2, 0, 255, 127])), "dimensions"),
            (file(false, |b, _| b[42..46].copy_from_slice(&[255, 127, 255, 127])), "truncated"),
            (file(false, |b, _| b[40..50].copy_from_slice(&[4, 0, 2, 0, 3, 0, 4, 0, 9, 0])), "dimensions"),
            (file(false, |b, f| b[108..112].copy_from_slice(&f(f32::NAN))), "begin at byte"),
            (file(false, |b, f| b[80..84].copy_from_slice(&f(0.0))), "positive spacings"),
        ] {
            let error = read_bytes("a.nii", &bytes).unwrap_err();
            assert!(error.to_string().contains(part) && error.exit_code() == 3, "{error}");
        }
        // A compressed file of no size that claims much.
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        gzip.write_all(&file(false, |b, _| b[42..46].copy_from_slice(&[255, 127, 255, 127]))).unwrap();
        assert!(read_bytes("a.nii.gz", &gzip.finish().unwrap()).unwrap_err().to_string().contains("truncated"));
    }
}
