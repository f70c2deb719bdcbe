//! Curves through points, and frames that are carried along them.

use glam::{DMat3, DVec3};

/// A natural cubic spline through points, its parameter the length of the chords.
pub struct Spline {
    points: Vec<DVec3>,
    /// Length of the chord after each point but the last.
    chords: Vec<f64>,
    /// Second derivatives.
    bends: Vec<DVec3>,
}

impl Spline {
    /// Through points of which no two neighbours are equal.
    pub fn through(points: &[DVec3]) -> Self {
        let chords: Vec<f64> = points.windows(2).map(|w| w[0].distance(w[1])).collect();
        let n = points.len();
        let mut bends = vec![DVec3::ZERO; n];
        // h₋ m₋ + 2(h₋ + h₊) m + h₊ m₊ = 6 (d₊ − d₋), no bend at the ends: elimination and back substitution.
        let (mut factors, mut rights) = (vec![0.0; n], vec![DVec3::ZERO; n]);
        for i in 1..n.saturating_sub(1) {
            let (a, b) = (chords[i - 1], chords[i]);
            let slope = |k: usize| (points[k + 1] - points[k]) / chords[k];
            let pivot = 2.0 * (a + b) - a * factors[i - 1];
            factors[i] = b / pivot;
            rights[i] = ((slope(i) - slope(i - 1)) * 6.0 - rights[i - 1] * a) / pivot;
        }
        for i in (1..n.saturating_sub(1)).rev() {
            bends[i] = rights[i] - bends[i + 1] * factors[i];
        }
        Self { points: points.to_vec(), chords, bends }
    }

    /// Pieces between its points.
    pub fn pieces(&self) -> usize {
        self.chords.len()
    }

    /// Point and tangent (a unit vector) at part `t` (0..1) of piece `i`.
    pub fn at(&self, i: usize, t: f64) -> (DVec3, DVec3) {
        let (h, s) = (self.chords[i], 1.0 - t);
        let (p, q, m, n) = (self.points[i], self.points[i + 1], self.bends[i], self.bends[i + 1]);
        let square = h * h / 6.0;
        let point = p * s + q * t + (m * (s * s * s - s) + n * (t * t * t - t)) * square;
        let slope = (q - p) / h + (n * (3.0 * t * t - 1.0) - m * (3.0 * s * s - 1.0)) * (h / 6.0);
        (point, slope.try_normalize().unwrap_or((q - p) / h))
    }
}

/// The frame (two normals, tangent) carried from a point and tangent to the next by two reflections, turning as little as can be.
pub fn double_reflection(frame: &DMat3, (x, _): (DVec3, DVec3), (y, tangent): (DVec3, DVec3)) -> DMat3 {
    let reflect = |v: DVec3, along: DVec3| {
        let squared = along.length_squared();
        if squared > 0.0 { v - along * (2.0 * v.dot(along) / squared) } else { v }
    };
    let chord = y - x;
    let (normal, turned) = (reflect(frame.x_axis, chord), reflect(frame.z_axis, chord));
    let normal = reflect(normal, tangent - turned);
    // Rounding would add up over many steps.
    let normal = (normal - tangent * normal.dot(tangent)).try_normalize().unwrap_or(frame.x_axis);
    DMat3::from_cols(normal, tangent.cross(normal), tangent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_a_helix_turn_by_its_torsion() {
        // A rotation minimising frame turns against the Frenet frame by ∫τ ds; the analytic frame of the helix (cos, sin, c·t) gives the angle.
        let c = 0.5f64;
        let speed = (1.0 + c * c).sqrt();
        let at = |t: f64| (DVec3::new(t.cos(), t.sin(), c * t), DVec3::new(-t.sin(), t.cos(), c) / speed);
        let normal = |t: f64| DVec3::new(-t.cos(), -t.sin(), 0.0);
        let error = |n: usize| {
            let (_, tangent) = at(0.0);
            let mut frame = DMat3::from_cols(normal(0.0), tangent.cross(normal(0.0)), tangent);
            for k in 0..n {
                let [a, b] = [k, k + 1].map(|k| std::f64::consts::TAU * k as f64 / n as f64);
                frame = double_reflection(&frame, at(a), at(b));
            }
            let binormal = at(std::f64::consts::TAU).1.cross(normal(0.0));
            let angle = frame.x_axis.dot(binormal).atan2(frame.x_axis.dot(normal(0.0)));
            let expected = -c / speed * std::f64::consts::TAU;
            let turn = (angle - expected) / std::f64::consts::TAU;
            ((turn - turn.round()) * std::f64::consts::TAU).abs()
        };
        let (coarse, fine) = (error(16), error(32));
        assert!(coarse < 1e-3 && fine < coarse / 12.0, "{coarse} {fine}");
    }

    #[test]
    fn frames_are_of_fourth_order() {
        // A helix of radius 4 and slope 1.5: the reference's errors of the whole turn.
        let (a, b) = (4.0f64, 1.5f64);
        let speed = a.hypot(b);
        let at =
            |t: f64| (DVec3::new(a * t.cos(), a * t.sin(), b * t), DVec3::new(-a * t.sin(), a * t.cos(), b) / speed);
        let normal = |t: f64| DVec3::new(-t.cos(), -t.sin(), 0.0);
        for (samples, expected) in [(9, 1.3e-4), (17, 7.9e-6), (33, 4.9e-7), (65, 3.1e-8)] {
            let (n, (_, tangent)) = (samples - 1, at(0.0));
            let mut frame = DMat3::from_cols(normal(0.0), tangent.cross(normal(0.0)), tangent);
            for k in 0..n {
                let [p, q] = [k, k + 1].map(|k| std::f64::consts::TAU * f64::from(k) / f64::from(n));
                frame = double_reflection(&frame, at(p), at(q));
            }
            let binormal = at(std::f64::consts::TAU).1.cross(normal(0.0));
            let angle = frame.x_axis.dot(binormal).atan2(frame.x_axis.dot(normal(0.0)));
            let turn = (angle + b / speed * std::f64::consts::TAU) / std::f64::consts::TAU;
            let error = ((turn - turn.round()) * std::f64::consts::TAU).abs();
            assert!((error / expected - 1.0).abs() < 0.05, "{samples}: {error:e}");
        }
    }

    #[test]
    fn a_spline_runs_through_its_points_without_a_kink() {
        let points = [DVec3::ZERO, DVec3::new(3.0, 1.0, 0.0), DVec3::new(5.0, -1.0, 2.0), DVec3::new(5.5, 0.0, 7.0)];
        let spline = Spline::through(&points);
        for i in 0..3 {
            assert!(
                (spline.at(i, 0.0).0 - points[i]).length() < 1e-12
                    && (spline.at(i, 1.0).0 - points[i + 1]).length() < 1e-12
            );
        }
        for i in 0..2 {
            assert!((spline.at(i, 1.0).1 - spline.at(i + 1, 0.0).1).length() < 1e-9);
        }
    }
}
