//! Pictures as heights: brightness 0..1, dark is low.

use std::io::BufReader;
use std::path::Path;

use glam::DVec2;

use crate::error::{EditError, Result};

/// Most pixels that are read.
const MOST_PIXELS: u64 = 1 << 28;

/// Brightness, row by row from the top left.
#[derive(Clone, Debug)]
pub(super) struct Picture {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Picture {
    /// The luma (Rec. 709 on the stored values, as height maps are meant) of a PNG file times its opacity.
    /// `invert` makes dark high.
    pub fn read(path: &Path, invert: bool) -> Result<Self> {
        let refuse = |problem: String| EditError::input(path, problem);
        let file = std::fs::File::open(path).map_err(|e| refuse(format!("cannot be read: {e}")))?;
        let mut decoder = png::Decoder::new(BufReader::new(file));
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder.read_info().map_err(|e| refuse(format!("is no PNG picture that can be read: {e}")))?;
        let (width, height) = (reader.info().width, reader.info().height);
        let pixels = u64::from(width) * u64::from(height);
        if pixels == 0 || pixels > MOST_PIXELS {
            return Err(refuse(format!("it has {width} x {height} pixels; 1 to {MOST_PIXELS} in all can be used")));
        }
        let size = reader.output_buffer_size().ok_or_else(|| refuse("it is too large".into()))?;
        let mut data = vec![0; size];
        let frame = reader.next_frame(&mut data).map_err(|e| refuse(format!("is damaged: {e}")))?;
        let (colour, wide) = (frame.color_type, frame.bit_depth == png::BitDepth::Sixteen);
        let bytes = if wide { 2 } else { 1 };
        let level = |sample: &[u8]| match *sample {
            [high, low] => f32::from(u16::from_be_bytes([high, low])) / 65535.0,
            [value] => f32::from(value) / 255.0,
            _ => 0.0,
        };
        let luma = |r: f32, g: f32, b: f32| 0.2126 * r + 0.7152 * g + 0.0722 * b;
        let pixel = |samples: Vec<f32>| {
            let (luma, opacity) = match samples[..] {
                [y] => (y, 1.0),
                [y, a] => (y, a),
                [r, g, b] => (luma(r, g, b), 1.0),
                [r, g, b, a] => (luma(r, g, b), a),
                _ => (0.0, 0.0),
            };
            opacity * if invert { 1.0 - luma } else { luma }
        };
        let row = |row: &[u8]| -> Vec<f32> {
            row.chunks_exact(bytes * colour.samples())
                .map(|p| pixel(p.chunks_exact(bytes).map(level).collect()))
                .collect()
        };
        let values: Vec<f32> = data
            .chunks_exact(frame.line_size)
            .take(height as usize)
            .flat_map(|line| row(&line[..bytes * colour.samples() * width as usize]))
            .collect();
        if values.iter().all(|v| *v <= 0.0) {
            let problem = if invert {
                "it is white or transparent everywhere: nothing would stand out"
            } else {
                "it is black or transparent everywhere: nothing would stand out; `invert` makes dark high"
            };
            return Err(refuse(problem.into()));
        }
        Ok(Self { width: width as usize, height: height as usize, values })
    }

    /// Height over width.
    pub fn aspect(&self) -> f64 {
        self.height as f64 / self.width as f64
    }

    /// The picture with pixels averaged until a row has at most `columns`: finer detail than the voxels would only alias.
    pub fn reduced(self, columns: f64) -> Self {
        let factor = (self.width as f64 / columns.max(1.0)).round().max(1.0) as usize;
        if factor == 1 {
            return self;
        }
        let (width, height) = (self.width.div_ceil(factor), self.height.div_ceil(factor));
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let (mut sum, mut count) = (0.0f64, 0.0);
                for v in y * factor..((y + 1) * factor).min(self.height) {
                    for u in x * factor..((x + 1) * factor).min(self.width) {
                        sum += f64::from(self.values[v * self.width + u]);
                        count += 1.0;
                    }
                }
                values.push((sum / count) as f32);
            }
        }
        Self { width, height, values }
    }

    /// Brightness at a place of the unit square, (0, 0) at the bottom left, interpolated linearly between pixels.
    pub fn at(&self, place: DVec2) -> f64 {
        let x = (place.x * self.width as f64 - 0.5).clamp(0.0, self.width as f64 - 1.0);
        let y = ((1.0 - place.y) * self.height as f64 - 0.5).clamp(0.0, self.height as f64 - 1.0);
        let (i, j) = (x as usize, y as usize);
        let pixel =
            |i: usize, j: usize| f64::from(self.values[j.min(self.height - 1) * self.width + i.min(self.width - 1)]);
        let (s, t) = (x - i as f64, y - j as f64);
        let row = |j: usize| pixel(i, j) + (pixel(i + 1, j) - pixel(i, j)) * s;
        row(j) + (row(j + 1) - row(j)) * t
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Image;

    fn read(image: &Image, invert: bool) -> Result<Picture> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        image.write_png(std::fs::File::create(&path).unwrap()).unwrap();
        Picture::read(&path, invert)
    }

    #[test]
    fn brightness_is_upright_and_counts_opacity() {
        // White at the top left, half-transparent white beside it, black below.
        let mut rgba8 = vec![255; 8];
        rgba8[7] = 128;
        rgba8.extend([0, 0, 0, 255, 0, 0, 0, 255]);
        let image = Image { width: 2, height: 2, rgba8 };
        let picture = read(&image, false).unwrap();
        for (place, value) in [
            ([0.25, 0.75], 1.0),
            ([0.75, 0.75], 128.0 / 255.0),
            ([0.25, 0.25], 0.0),
            ([0.25, 0.5], 0.5),
            ([0.0, 1.0], 1.0),
        ] {
            assert!((picture.at(DVec2::from(place)) - value).abs() < 1e-6, "{place:?}");
        }
        let mean = picture.reduced(1.0);
        assert!((mean.at(DVec2::splat(0.3)) - (1.0 + 128.0 / 255.0) / 4.0).abs() < 1e-6);
        let inverted = read(&image, true).unwrap();
        assert_eq!((inverted.at(DVec2::new(0.25, 0.75)), inverted.at(DVec2::new(0.25, 0.25))), (0.0, 1.0));
        let black = Image { width: 1, height: 1, rgba8: vec![0, 0, 0, 255] };
        assert!(read(&black, false).unwrap_err().to_string().contains("invert"));
    }

    #[test]
    fn what_is_no_picture_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        std::fs::write(&path, b"\x89PNG\r\n\x1a\nno").unwrap();
        assert_eq!(Picture::read(&path, false).unwrap_err().exit_code(), 3);
        assert_eq!(Picture::read(&folder.path().join("absent.png"), false).unwrap_err().exit_code(), 3);
    }
}
