//! Light, material and tone: from a surface point to a colour.
//!
//! All colours are linear sRGB until [`display`]. The lights stand relative to the camera, so every view is lit alike: a
//! large key light from the upper left, a weak one at the camera that keeps shadows readable, a rim light from behind,
//! and a sky that is brighter above than below. Creases show because the sky's part is weighed by how much of it is seen.

use glam::DVec3;

use super::camera::Camera;
use super::occlusion::Visibility;

/// Warm grey of modelling clay.
pub(super) const CLAY: DVec3 = DVec3::new(0.44, 0.355, 0.30);

/// Radiance of the lights; their sum puts lit clay at the bright end of the tone curve, short of its shoulder.
const KEY: DVec3 = DVec3::new(1.34, 1.265, 1.15);
const HEADLIGHT: DVec3 = DVec3::new(0.09, 0.095, 0.10);
const RIM: DVec3 = DVec3::new(0.75, 0.85, 1.0);
const SKY_ABOVE: DVec3 = DVec3::new(0.46, 0.51, 0.58);
const SKY_BELOW: DVec3 = DVec3::new(0.17, 0.145, 0.13);

/// Directions of the lights, world space, unit.
pub(super) struct Lights {
    pub key: DVec3,
    rim: DVec3,
    up: DVec3,
}

impl Lights {
    pub fn around(camera: &Camera) -> Self {
        let place = |x: f64, y: f64, z: f64| (camera.right * x + camera.up * y + camera.back * z).normalize();
        Self { key: place(-0.75, 0.8, 0.5), rim: place(0.75, 0.5, -0.75), up: place(-0.15, 1.0, 0.25) }
    }
}

/// Light that leaves a clay surface with `normal` towards `view` (world, unit).
pub(super) fn clay(lights: &Lights, albedo: DVec3, normal: DVec3, view: DVec3, seen: Visibility) -> DVec3 {
    // The key light is large: where little of the sky is seen, part of the light is hidden as well.
    let key = KEY * (normal.dot(lights.key).max(0.0) * seen.key * (0.5 + 0.5 * seen.sky));
    let head = HEADLIGHT * normal.dot(view).max(0.0) * (0.4 + 0.6 * seen.sky);
    let height = 0.5 + 0.5 * normal.dot(lights.up);
    let sky = SKY_BELOW.lerp(SKY_ABOVE, height) * bounced(seen.sky, albedo);
    let diffuse = albedo * (key + head + sky);
    // A broad sheen, and light that grazes the edges from behind.
    let half = (lights.key + view).normalize_or(normal);
    let fresnel = 0.04 + 0.96 * (1.0 - view.dot(half).max(0.0)).powi(5);
    let sheen = KEY * (fresnel * normal.dot(half).max(0.0).powi(22) * 1.1 * seen.key);
    let facing = normal.dot(view).clamp(0.0, 1.0);
    let rim = RIM * (normal.dot(lights.rim).max(0.0) * (1.0 - facing).powi(3) * 0.55 * seen.sky);
    diffuse + sheen + rim
}

/// What sculptors rub into and off a cast: a factor that darkens creases and lightens ridges by their mean curvature
/// (1/voxel), so that both can be seen in full light as well. Half of its effect is reached at a radius of about 6 voxels.
pub(super) fn patina(mean_curvature: f64) -> f64 {
    let strength = (3.0 * mean_curvature.abs()).tanh();
    if mean_curvature < 0.0 { 1.0 - 0.42 * strength } else { 1.0 + 0.14 * strength }
}

/// Light on a surface whose colour says something: bright and even, so that the colour can be read off a legend.
pub(super) fn data(lights: &Lights, albedo: DVec3, normal: DVec3, view: DVec3, seen: Visibility) -> DVec3 {
    let key = 0.34 * normal.dot(lights.key).max(0.0) * seen.key;
    let head = 0.2 * normal.dot(view).max(0.0);
    let sky = (0.5 + 0.12 * normal.dot(lights.up)) * seen.sky;
    albedo * (key + head + sky)
}

/// The visible part of the sky with the light that the hiding surface, of the same colour, reflects (fit of Jimenez et al. 2016).
fn bounced(seen: f64, albedo: DVec3) -> DVec3 {
    let a = albedo * 2.0404 - 0.3324;
    let b = albedo * -4.7951 + 0.6417;
    let c = albedo * 2.7552 + 0.6903;
    (((a * seen + b) * seen + c) * seen).max(DVec3::splat(seen))
}

/// Filmic tone curve, 0..∞ to 0..1 (Narkowicz's fit of ACES): soft shoulder, slight toe.
pub(super) fn filmic(x: DVec3) -> DVec3 {
    let curve = |x: f64| (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14);
    x.map(|c| curve(0.86 * c.max(0.0)).min(1.0))
}

/// Linear from sRGB 0..1.
pub(super) fn to_linear(srgb: DVec3) -> DVec3 {
    srgb.map(|c| if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) })
}

/// Linear from 8-bit sRGB.
pub(super) fn decode(srgb: [u8; 3]) -> DVec3 {
    to_linear(DVec3::from_array(srgb.map(f64::from)) / 255.0)
}

/// sRGB, 0..255, from linear 0..1.
pub(super) fn display(linear: DVec3) -> DVec3 {
    let linear = linear.clamp(DVec3::ZERO, DVec3::ONE);
    linear.map(|c| if c <= 0.003_130_8 { c * 12.92 } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }) * 255.0
}

/// 8 bits from 0..255. `dither` (0..1) decides which of the two nearest values is taken: smooth gradients keep no bands.
pub(super) fn quantize(srgb: DVec3, dither: f64) -> [u8; 3] {
    // Within a hair of a whole number there is nothing to dither: white stays white.
    srgb.to_array().map(|c| (c + 0.02 + 0.96 * dither) as u8)
}

/// Interleaved gradient noise (Jimenez 2014): even within every 3×3 pixels, the same for every run.
pub(super) fn dither(x: u32, y: u32) -> f64 {
    (52.982_918_9 * (0.067_110_56 * f64::from(x) + 0.005_837_15 * f64::from(y)).fract()).fract()
}

/// Stops of the diverging map: negative blue, zero near white, positive red, even in lightness on both sides.
const DIVERGING: [[u8; 3]; 7] =
    [[24, 58, 140], [58, 117, 196], [146, 188, 226], [240, 239, 236], [240, 170, 130], [214, 84, 62], [134, 18, 34]];

/// Diverging colour of −1..1, linear.
pub(super) fn diverging(value: f64) -> DVec3 {
    let at = (value.clamp(-1.0, 1.0) + 1.0) / 2.0 * (DIVERGING.len() - 1) as f64;
    let low = (at as usize).min(DIVERGING.len() - 2);
    decode(DIVERGING[low]).lerp(decode(DIVERGING[low + 1]), at - low as f64)
}

/// A colour for number `n`: hues by the golden angle, so that neighbouring numbers differ and none comes back.
pub(super) fn label(n: u32) -> DVec3 {
    let hue = (0.03 + f64::from(n) * 0.618_033_988_75).fract() * 6.0;
    let ramp = |shift: f64| ((hue + shift).rem_euclid(6.0) - 3.0).abs() - 1.0;
    let pure = DVec3::new(ramp(0.0), ramp(4.0), ramp(2.0)).clamp(DVec3::ZERO, DVec3::ONE);
    DVec3::splat(0.14).lerp(pure, 0.62) * 0.9
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encode(linear: DVec3, dither: f64) -> [u8; 3] {
        quantize(display(linear), dither)
    }

    #[test]
    fn srgb_round_trips_and_dithering_keeps_whole_values() {
        for v in 0..=255u8 {
            for d in [0.0, 0.5, 0.999] {
                assert_eq!(encode(decode([v; 3]), d), [v; 3]);
            }
        }
        // A quarter above 100: one pixel in four is 101.
        let level = decode([100; 3]).lerp(decode([101; 3]), 0.25);
        let share = (0..4096).filter(|i| encode(level, dither(i % 64, i / 64))[0] == 101).count();
        assert!((924..1124).contains(&share), "{share}");
    }

    #[test]
    fn maps_are_white_at_zero_and_take_sides() {
        assert_eq!(encode(diverging(0.0), 0.5), [240, 239, 236]);
        let (cold, warm) = (diverging(-0.7), diverging(0.7));
        assert!(cold.z > 2.0 * cold.x && warm.x > 2.0 * warm.z);
        assert_eq!(diverging(f64::INFINITY), diverging(1.0));
        let labels: Vec<_> = (0..8).map(label).collect();
        for (i, a) in labels.iter().enumerate() {
            assert!(labels[..i].iter().all(|b| (*a - *b).length() > 0.1));
        }
    }

    #[test]
    fn tone_curve_rises_to_white() {
        let mut last = -1.0;
        for i in 0..200 {
            let y = filmic(DVec3::splat(f64::from(i) * 0.1)).x;
            assert!(y >= last && y <= 1.0);
            last = y;
        }
        assert!(last > 0.99);
    }
}
