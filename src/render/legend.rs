//! A bar of colours with the numbers at its ends, in a corner of a picture.

use super::Image;
use super::shade::{display, quantize};
use super::vertices::sequential;

/// Rows of three pixels of 0..9 and the point.
const GLYPHS: [[u8; 5]; 11] = [
    [7, 5, 5, 5, 7],
    [2, 6, 2, 2, 7],
    [7, 1, 7, 4, 7],
    [7, 1, 3, 1, 7],
    [5, 5, 7, 1, 1],
    [7, 4, 7, 1, 7],
    [7, 4, 7, 5, 7],
    [7, 1, 2, 2, 2],
    [7, 5, 7, 5, 7],
    [7, 5, 7, 1, 7],
    [0, 0, 0, 0, 2],
];

/// Width of the bar as a part of the picture's, and its height in pixels of a glyph.
const BAR: f64 = 0.3;
const THICK: u32 = 5;

/// Draws the colours of a number from `low` to `high`, dark to bright, in the lower left corner.
pub(super) fn draw(image: &mut Image, low: f64, high: f64) {
    let pixel = (image.width / 240).max(1);
    let (margin, length) = (4 * pixel, (f64::from(image.width) * BAR) as u32);
    let top = image.height.saturating_sub(margin + THICK * pixel);
    for x in 0..length {
        let color = quantize(display(sequential(f64::from(x) / f64::from(length.max(2) - 1))), 0.5);
        for y in 0..THICK * pixel {
            set(image, margin + x, top + y, color);
        }
    }
    let above = top.saturating_sub(7 * pixel);
    write(image, margin, above, pixel, &format!("{low:.2}"));
    let text = format!("{high:.2}");
    let width = text.len() as u32 * 4 * pixel - pixel;
    write(image, (margin + length).saturating_sub(width), above, pixel, &text);
}

fn write(image: &mut Image, left: u32, top: u32, pixel: u32, text: &str) {
    for (n, letter) in (0..).zip(text.chars()) {
        let glyph = GLYPHS[letter.to_digit(10).map_or(10, |d| d as usize)];
        for (row, bits) in (0..).zip(glyph) {
            for column in (0..3).filter(|c| bits >> (2 - c) & 1 == 1) {
                for i in 0..pixel * pixel {
                    let (x, y) = (left + (4 * n + column) * pixel + i % pixel, top + row * pixel + i / pixel);
                    set(image, x, y, [240; 3]);
                }
            }
        }
    }
}

fn set(image: &mut Image, x: u32, y: u32, [r, g, b]: [u8; 3]) {
    if x < image.width && y < image.height {
        let at = (y as usize * image.width as usize + x as usize) * 4;
        image.rgba8[at..at + 4].copy_from_slice(&[r, g, b, u8::MAX]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_legend_has_its_colours_and_stays_in_the_picture() {
        for (width, height) in [(1, 1), (7, 3), (240, 120), (960, 400)] {
            let mut image = Image { width, height, rgba8: vec![0; (width * height * 4) as usize] };
            draw(&mut image, 1.0, 2.5);
            assert_eq!(image.rgba8.len(), (width * height * 4) as usize);
            if width >= 240 {
                let pixel = width / 240;
                let y = height - 6 * pixel;
                let (first, last) =
                    (image.pixel(4 * pixel, y).unwrap(), image.pixel(4 * pixel + width * 3 / 10 - 1, y).unwrap());
                assert!(first[2] > first[1] && last[0] > 200 && last[2] < 100, "{first:?} {last:?}");
            }
        }
    }
}
