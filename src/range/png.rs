//! PNG: greyscale pictures of 8 and 16 bits as numbers, colours.

use std::io::Cursor;
use std::path::Path;

use super::MOST_PIXELS;
use crate::error::{EditError, Result};

/// Width, height and numbers row by row.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<(usize, usize, Vec<u16>)> {
    let refused = |e: ::png::DecodingError| EditError::input(path, format!("is no picture that can be read: {e}"));
    let mut reader = ::png::Decoder::new(Cursor::new(bytes)).read_info().map_err(refused)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    if width as f64 * height as f64 > MOST_PIXELS {
        return Err(EditError::input(path, format!("{width} x {height} pixels are too many")));
    }
    let (kind, depth) = reader.output_color_type();
    if kind != ::png::ColorType::Grayscale {
        return Err(EditError::input(path, "a greyscale picture is wanted, of 16 bits for depth"));
    }
    let size = reader.output_buffer_size().ok_or_else(|| EditError::input(path, "is too large"))?;
    let mut data = vec![0; size];
    reader.next_frame(&mut data).map_err(refused)?;
    let numbers: Vec<u16> = match depth {
        ::png::BitDepth::Sixteen => data.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect(),
        ::png::BitDepth::Eight => data.iter().map(|b| u16::from(*b)).collect(),
        _ => return Err(EditError::input(path, "8 or 16 bits a pixel are wanted")),
    };
    match numbers.len() == width * height {
        true => Ok((width, height, numbers)),
        false => Err(EditError::input(path, "the picture is cut short")),
    }
}

/// Width, height and sRGB colours row by row.
pub(super) fn read_colors(path: &Path, bytes: &[u8]) -> Result<(usize, usize, Vec<[u8; 3]>)> {
    let refused = |e: ::png::DecodingError| EditError::input(path, format!("is no picture that can be read: {e}"));
    let mut decoder = ::png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(::png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(refused)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    if width as f64 * height as f64 > MOST_PIXELS {
        return Err(EditError::input(path, format!("{width} x {height} pixels are too many")));
    }
    let samples = reader.output_color_type().0.samples();
    let size = reader.output_buffer_size().ok_or_else(|| EditError::input(path, "is too large"))?;
    let mut data = vec![0; size];
    reader.next_frame(&mut data).map_err(refused)?;
    let color = |pixel: &[u8]| if samples < 3 { [pixel[0]; 3] } else { [pixel[0], pixel[1], pixel[2]] };
    let colors: Vec<[u8; 3]> = data.chunks_exact(samples).map(color).collect();
    match colors.len() == width * height {
        true => Ok((width, height, colors)),
        false => Err(EditError::input(path, "the picture is cut short")),
    }
}
