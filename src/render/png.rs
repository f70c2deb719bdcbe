//! Pictures in memory and as PNG.

use std::io::{self, Write};

/// A picture of 8-bit sRGB with straight alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Red, green, blue, alpha of each pixel, row by row from the top left.
    pub rgba8: Vec<u8>,
}

impl Image {
    /// The pixel at column `x` and row `y`; `None` outside the picture.
    pub fn pixel(&self, x: u32, y: u32) -> Option<[u8; 4]> {
        if x >= self.width {
            return None;
        }
        let at = (y as usize * self.width as usize + x as usize) * 4;
        self.rgba8.get(at..)?.first_chunk().copied()
    }

    /// Pictures beside each other, as high as the lowest of them.
    pub fn side_by_side(images: &[Self]) -> Self {
        let height = images.iter().map(|image| image.height).min().unwrap_or(0);
        let row = |image: &Self, y: u32| {
            let length = image.width as usize * 4;
            let start = y as usize * length;
            image.rgba8.get(start..start + length).unwrap_or_default().to_vec()
        };
        let rgba8 = (0..height).flat_map(|y| images.iter().flat_map(move |image| row(image, y))).collect();
        Self { width: images.iter().map(|image| image.width).sum(), height, rgba8 }
    }

    /// Pictures in rows of `columns`, a contact sheet. Places without a picture have the colour of the first one's corner.
    pub fn sheet(images: &[Self], columns: usize) -> Self {
        let columns = columns.max(1);
        let rows: Vec<Self> = images.chunks(columns).map(Self::side_by_side).collect();
        let (width, height) =
            (rows.iter().map(|row| row.width).max().unwrap_or(0), rows.iter().map(|row| row.height).sum());
        let corner = images.first().and_then(|image| image.pixel(0, 0)).unwrap_or_default();
        let mut rgba8 = Vec::with_capacity(width as usize * height as usize * 4);
        for row in &rows {
            for pixels in row.rgba8.chunks_exact((row.width as usize * 4).max(4)) {
                rgba8.extend_from_slice(pixels);
                rgba8.extend(std::iter::repeat_n(corner, (width - row.width) as usize).flatten());
            }
        }
        Self { width, height, rgba8 }
    }

    /// Every pixel as a square of pixels with an edge of `factor`, cut to a size.
    pub fn enlarged(&self, factor: u32, width: u32, height: u32) -> Self {
        let at = |x: u32, y: u32| self.pixel(x / factor.max(1), y / factor.max(1)).unwrap_or_default();
        let rgba8 = (0..height).flat_map(|y| (0..width).flat_map(move |x| at(x, y))).collect();
        Self { width, height, rgba8 }
    }

    /// Writes the picture as PNG, marked as sRGB; without an alpha channel where every pixel is opaque.
    pub fn write_png(&self, to: impl Write) -> io::Result<()> {
        let opaque = self.rgba8.chunks_exact(4).all(|p| p[3] == u8::MAX);
        let mut encoder = png::Encoder::new(to, self.width, self.height);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_color(if opaque { png::ColorType::Rgb } else { png::ColorType::Rgba });
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        compress(&mut encoder);
        let mut writer = encoder.write_header()?;
        if opaque {
            let rgb: Vec<u8> = self.rgba8.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
            writer.write_image_data(&rgb)?;
        } else {
            writer.write_image_data(&self.rgba8)?;
        }
        writer.finish()?;
        Ok(())
    }

    /// Writes pictures of one size as an animated PNG that goes on for ever; viewers without animation show the first.
    pub fn write_animation(images: &[Self], frames_a_second: u16, to: impl Write) -> io::Result<()> {
        let Some(first) = images.first() else { return Err(io::Error::other("an animation without pictures")) };
        if images.iter().any(|image| (image.width, image.height) != (first.width, first.height)) {
            return Err(io::Error::other("the pictures of an animation have one size"));
        }
        let mut encoder = png::Encoder::new(to, first.width, first.height);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        let count = u32::try_from(images.len()).map_err(io::Error::other)?;
        if count > 1 {
            encoder.set_animated(count, 0)?;
            encoder.set_frame_delay(1, frames_a_second)?;
        }
        let mut writer = encoder.write_header()?;
        for image in images {
            writer.write_image_data(&image.rgba8)?;
        }
        writer.finish()?;
        Ok(())
    }
}

/// A third of the time of the usual compression, for pictures a twentieth larger.
fn compress(encoder: &mut png::Encoder<'_, impl Write>) {
    encoder.set_filter(png::Filter::Sub);
    encoder.set_deflate_compression(png::DeflateCompression::Level(3));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_stay_together() {
        let of = |value: u8, width: u32| Image { width, height: 2, rgba8: vec![value; width as usize * 8] };
        let sheet = Image::sheet(&[of(1, 2), of(1, 2), of(1, 2)], 2);
        assert_eq!((sheet.width, sheet.height, sheet.rgba8.len()), (4, 4, 64));
        assert_eq!(sheet.pixel(3, 3), of(1, 2).pixel(0, 0));
        let both = Image::side_by_side(&[of(1, 2), of(2, 1)]);
        assert_eq!((both.width, both.height), (3, 2));
        assert_eq!(both.pixel(1, 1), Some([1; 4]));
        assert_eq!(both.pixel(2, 0), Some([2; 4]));
        assert_eq!(both.rgba8.len(), 24);
    }

    fn round_trip(image: &Image) -> (png::ColorType, bool, Vec<u8>) {
        let mut file = Vec::new();
        image.write_png(&mut file).unwrap();
        let mut reader = png::Decoder::new(io::Cursor::new(file)).read_info().unwrap();
        let mut data = vec![0; reader.output_buffer_size().unwrap()];
        let frame = reader.next_frame(&mut data).unwrap();
        data.truncate(frame.buffer_size());
        assert_eq!((frame.width, frame.height), (image.width, image.height));
        (frame.color_type, reader.info().srgb.is_some(), data)
    }

    #[test]
    fn files_hold_the_pixels_and_alpha_only_where_needed() {
        let mut image = Image { width: 3, height: 1, rgba8: vec![1, 2, 3, 255, 4, 5, 6, 255, 7, 8, 9, 255] };
        assert_eq!(round_trip(&image), (png::ColorType::Rgb, true, vec![1, 2, 3, 4, 5, 6, 7, 8, 9]));
        image.rgba8[7] = 0;
        assert_eq!(round_trip(&image), (png::ColorType::Rgba, true, image.rgba8.clone()));
        assert_eq!((image.pixel(1, 0), image.pixel(3, 0), image.pixel(0, 1)), (Some([4, 5, 6, 0]), None, None));
    }

    #[test]
    fn a_full_disk_is_an_error() {
        let image = Image { width: 64, height: 64, rgba8: vec![200; 64 * 64 * 4] };
        assert!(image.write_png(&mut [0u8; 40][..]).is_err());
    }
}
