//! Numbers on a level set as the colours of a mesh's vertices.

use glam::DVec3;
use rayon::prelude::*;

use super::shade::diverging;
use crate::levelset::Field;

/// Linear RGBA of vertices by a field: blue below 0, near white at 0, red above, saturated at ±`range`; grey where the field has no value.
pub fn vertex_colors(positions: &[DVec3], field: &Field, range: f64) -> Vec<[f32; 4]> {
    colors(positions, field, |value| diverging(value / range))
}

/// Linear RGBA of vertices by a field of distances: dark blue at 0 to yellow at `farthest`; grey where the field has no value.
pub fn distance_colors(positions: &[DVec3], field: &Field, farthest: f64) -> Vec<[f32; 4]> {
    colors(positions, field, |value| sequential(value / farthest.max(f64::MIN_POSITIVE)))
}

fn colors(positions: &[DVec3], field: &Field, color: impl Fn(f64) -> DVec3 + Sync) -> Vec<[f32; 4]> {
    const UNKNOWN: f32 = 0.2;
    positions
        .par_iter()
        .map_init(
            || field.accessor(),
            |accessor, xyz| {
                let ijk = field.transform().world_to_index(*xyz);
                match Field::trilinear(accessor, ijk) {
                    Some(value) => color(f64::from(value)).as_vec3().extend(1.0).to_array(),
                    None => [UNKNOWN, UNKNOWN, UNKNOWN, 1.0],
                }
            },
        )
        .collect()
}

/// Five colours of rising lightness (viridis) in sRGB.
const STOPS: [[f64; 3]; 5] =
    [[0.267, 0.005, 0.329], [0.230, 0.322, 0.546], [0.128, 0.567, 0.551], [0.369, 0.789, 0.383], [0.993, 0.906, 0.144]];

/// The linear colour of a number in 0..1.
fn sequential(value: f64) -> DVec3 {
    let at = value.clamp(0.0, 1.0) * (STOPS.len() - 1) as f64;
    let stop = (at as usize).min(STOPS.len() - 2);
    let srgb = DVec3::from(STOPS[stop]).lerp(DVec3::from(STOPS[stop + 1]), at - stop as f64);
    let linear = |v: f64| if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    DVec3::new(linear(srgb.x), linear(srgb.y), linear(srgb.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::torus;
    use crate::levelset::{CurvatureKind, curvature};
    use crate::mesh::level_set_to_mesh;
    use crate::run::RunOptions;

    #[test]
    fn a_torus_is_red_outside_and_blue_where_it_is_a_saddle() {
        let run = RunOptions::default();
        let level_set = torus(20.0, 8.0);
        let mesh = level_set_to_mesh(&level_set, 0.0, &run).unwrap();
        let field = curvature(&level_set, CurvatureKind::Gaussian, &run).unwrap();
        let colors = vertex_colors(&mesh.positions, &field, 1.0 / 100.0);
        let mut accessor = field.accessor();
        for (p, [red, _, blue, alpha]) in mesh.positions.iter().zip(&colors) {
            // K = cos θ / (r (R + r cos θ)), 0 on the top circle.
            let out = p.x.hypot(p.y) - 20.0;
            let exact = out / 8.0 / (8.0 * (20.0 + out));
            let ours = f64::from(Field::trilinear(&mut accessor, *p).unwrap());
            assert!((ours - exact).abs() < 5e-4, "{p}: {ours} {exact}");
            assert!(*alpha == 1.0 && (out.abs() < 1.0 || (out > 0.0) == (red > blue)), "{p}: {red} {blue}");
        }
        assert_eq!(vertex_colors(&[DVec3::splat(500.0)], &field, 1.0), [[0.2, 0.2, 0.2, 1.0]]);
    }

    #[test]
    fn distances_run_from_dark_to_light() {
        let light: Vec<f64> =
            (0..=20).map(|i| sequential(f64::from(i) / 20.0).dot(DVec3::new(0.2126, 0.7152, 0.0722))).collect();
        assert!(light.windows(2).all(|w| w[1] > w[0]) && light[0] < 0.02 && light[20] > 0.7, "{light:?}");
    }
}
