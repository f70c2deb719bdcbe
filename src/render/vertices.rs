//! Numbers on a level set as the colours of a mesh's vertices.

use glam::DVec3;
use rayon::prelude::*;

use super::shade::diverging;
use crate::levelset::Field;

/// Linear RGBA of vertices by a field: blue below 0, near white at 0, red above, saturated at ±`range`; grey where the field has no value.
pub fn vertex_colors(positions: &[DVec3], field: &Field, range: f64) -> Vec<[f32; 4]> {
    const UNKNOWN: f32 = 0.2;
    positions
        .par_iter()
        .map_init(
            || field.accessor(),
            |accessor, xyz| {
                let ijk = field.transform().world_to_index(*xyz);
                match Field::trilinear(accessor, ijk) {
                    Some(value) => diverging(f64::from(value) / range).as_vec3().extend(1.0).to_array(),
                    None => [UNKNOWN, UNKNOWN, UNKNOWN, 1.0],
                }
            },
        )
        .collect()
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
}
