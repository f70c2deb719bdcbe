//! The transfer curve of sRGB (IEC 61966-2-1), between the linear values of a mesh and those that files hold.
//!
//! PLY, OBJ and OFF do not say what their colours mean; like Blender, we take them as sRGB. glTF's are linear.

/// A channel brought into 0..1; NaN becomes 0.
pub(super) fn unit(channel: f32) -> f32 {
    if channel.is_nan() { 0.0 } else { channel.clamp(0.0, 1.0) }
}

/// Encoded to linear; values outside 0..1 are clamped, NaN becomes 0.
pub(super) fn to_linear(encoded: f32) -> f32 {
    let c = f64::from(unit(encoded));
    let linear = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
    linear as f32
}

/// Linear to encoded; values outside 0..1 are clamped, NaN becomes 0.
pub(super) fn to_srgb(linear: f32) -> f32 {
    let c = f64::from(unit(linear));
    let encoded = if c <= 0.003_130_8 { c * 12.92 } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    encoded as f32
}

/// The linear values of an 8-bit sRGB colour.
pub(crate) fn linear_from_srgb8(color: [u8; 3]) -> [f32; 3] {
    color.map(|c| to_linear(f32::from(c) / 255.0))
}

/// A file's sRGB colour with linear alpha, each 0..1, as a mesh holds it.
pub(super) fn decode([r, g, b, a]: [f32; 4]) -> [f32; 4] {
    [to_linear(r), to_linear(g), to_linear(b), unit(a)]
}

/// A mesh's colour as the 8-bit sRGB that files hold, alpha linear.
pub(super) fn encode_bytes([r, g, b, a]: [f32; 4]) -> [u8; 4] {
    // `as` saturates and takes NaN to 0.
    [to_srgb(r), to_srgb(g), to_srgb(b), a].map(|c| (c * 255.0).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_points_and_every_byte() {
        assert!((to_linear(0.5) - 0.214_041).abs() < 1e-6);
        assert_eq!([to_linear(0.0), to_linear(1.0), to_srgb(1.0), to_linear(f32::NAN)], [0.0, 1.0, 1.0, 0.0]);
        for byte in 0..=255u8 {
            let encoded = f32::from(byte) / 255.0;
            assert_eq!(encode_bytes(decode([encoded; 4])), [byte; 4]);
        }
    }
}
