//! Regions around points: α = D_p(d) = 1 − P(d; d_min, d_max) with d the distance to the closest point.

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::{Region, ramp_between};
use crate::error::{EditError, Result};

/// The neighbourhood of a set of points, such as an intersection curve.
pub struct Near {
    tree: ImmutableKdTree<f64, 3>,
    points: Vec<DVec3>,
    bounds: (DVec3, DVec3),
    reach: [f64; 2],
}

impl Near {
    /// Full within `reach[0]` of a point, nothing beyond `reach[1]` (world units).
    pub fn new(points: &[DVec3], reach: [f64; 2]) -> Result<Self> {
        if !(0.0 <= reach[0] && reach[0] <= reach[1] && reach[1] > 0.0 && reach[1].is_finite()) {
            let accepted = "two distances, the smaller first, the larger above 0, such as 7,9";
            return Err(EditError::parameter("region", "d", format!("{},{}", reach[0], reach[1]), accepted));
        }
        let bounds = points.iter().map(|&p| (p, p)).reduce(|(lo, hi), (p, _)| (lo.min(p), hi.max(p)));
        let (lo, hi) = bounds.unwrap_or((DVec3::ZERO, DVec3::ZERO));
        if !(lo.is_finite() && hi.is_finite()) {
            return Err(EditError::parameter("region", "points", "not finite", "points with finite coordinates"));
        }
        let places: Vec<[f64; 3]> = points.iter().map(|p| p.to_array()).collect();
        let tree = ImmutableKdTree::new_from_slice(&places).map_err(|e| {
            let accepted = format!("fewer points, or less dense ones: {e}");
            EditError::parameter("region", "points", points.len(), accepted)
        })?;
        Ok(Self { tree, points: points.to_vec(), bounds: (lo - reach[1], hi + reach[1]), reach })
    }

    /// Distance to the closest point, infinite without points; and the place of that.
    fn closest(&self, xyz: DVec3) -> (f64, usize) {
        if self.tree.size() == 0 {
            return (f64::INFINITY, 0);
        }
        let found = self.tree.query(&xyz.to_array()).nearest_one::<SquaredEuclidean<f64>>().execute();
        (found.distance.sqrt(), found.item as usize)
    }

    /// α at a distance.
    fn at(&self, distance: f64) -> f32 {
        (1.0 - ramp_between(distance, self.reach[0], self.reach[1])) as f32
    }

    fn is_outside(&self, xyz: DVec3) -> bool {
        let (lo, hi) = self.bounds;
        xyz.cmplt(lo).any() || xyz.cmpgt(hi).any()
    }
}

/// What is this much nearer than a limit, as a part of it, is so however distances are rounded.
const SURELY: f64 = 1e-9;

impl Region for Near {
    fn weight(&self, xyz: DVec3) -> f32 {
        if self.is_outside(xyz) { 0.0 } else { self.at(self.closest(xyz).0) }
    }

    fn weights(&self, xyz: &[DVec3], alpha: &mut [f32]) {
        // Between the limits alone does the distance matter. Most positions are within the lower limit of the point that was closest to the
        // one before, or farther than the upper one from any, as their distance to that position says.
        let (full, none) = (self.reach[0] * (1.0 - SURELY), self.reach[1] * (1.0 + SURELY));
        let mut last: Option<(DVec3, f64, DVec3)> = None;
        for (alpha, &xyz) in alpha.iter_mut().zip(xyz) {
            let known = last.and_then(|(position, distance, point)| {
                let far = distance - xyz.distance(position) > none;
                if xyz.distance(point) < full { Some(1.0) } else { far.then_some(0.0) }
            });
            *alpha = match known {
                Some(known) => known,
                None if self.is_outside(xyz) => 0.0,
                None => {
                    let (distance, place) = self.closest(xyz);
                    last = self.points.get(place).map(|point| (xyz, distance, *point));
                    self.at(distance)
                }
            };
        }
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        Some(self.bounds)
    }

    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        let (lo, hi) = self.bounds;
        if (centre + radius).cmplt(lo).any() || (centre - radius).cmpgt(hi).any() {
            return [0.0; 2];
        }
        let distance = self.closest(centre).0;
        [radius, -radius].map(|by| self.at(distance + by * (1.0 + SURELY)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weight_falls_with_the_distance_to_the_closest_point() {
        let region = Near::new(&[DVec3::ZERO, DVec3::X * 100.0], [7.0, 9.0]).unwrap();
        for (x, w) in [(0.0, 1.0), (7.0, 1.0), (8.0, 0.5), (9.0, 0.0), (50.0, 0.0), (92.0, 0.5)] {
            assert!((region.weight(DVec3::X * x) - w).abs() < 1e-6, "{x}");
        }
        assert_eq!(region.weights_within(DVec3::X * 50.0, 3.0), [0.0, 0.0]);
        assert_eq!(region.weights_within(DVec3::X * 3.0, 3.0), [1.0, 1.0]);
        assert_eq!(Near::new(&[], [7.0, 9.0]).unwrap().weight(DVec3::ZERO), 0.0);
        assert!(Near::new(&[DVec3::ZERO], [9.0, 7.0]).is_err());
        assert!(Near::new(&[DVec3::NAN], [7.0, 9.0]).is_err());
    }

    #[test]
    fn many_positions_at_once_have_the_weights_of_each() {
        let points: Vec<DVec3> =
            (0..60).map(|i| DVec3::new(f64::from(i) * 0.7, f64::from(i * i % 7) * 0.3, 0.0)).collect();
        // A ramp, and a step.
        for reach in [[7.0, 9.0], [8.0, 8.0], [0.0, 3.0]] {
            let region = Near::new(&points, reach).unwrap();
            let positions: Vec<DVec3> = (0..16 * 24 * 24)
                .map(|n| DVec3::new(f64::from(n / 576), f64::from(n / 24 % 24 - 12), f64::from(n % 24 - 12)))
                .collect();
            let mut alpha = vec![0.5; positions.len()];
            region.weights(&positions, &mut alpha);
            let each: Vec<f32> = positions.iter().map(|p| region.weight(*p)).collect();
            assert!(alpha.iter().zip(&each).all(|(a, b)| a.to_bits() == b.to_bits()));
            let count = |of: fn(f32) -> bool| each.iter().filter(|a| of(**a)).count();
            assert!(count(|a| a == 0.0) > 500 && count(|a| a > 0.0) > 200, "{reach:?}");
        }
    }

    #[test]
    fn many_points_with_one_coordinate_in_common() {
        // A flat grid of points: k-d trees of fixed bucket size refuse such sets.
        let points: Vec<DVec3> =
            (0..100).flat_map(|x| (0..100).map(move |y| DVec3::new(f64::from(x), f64::from(y), 0.0))).collect();
        let region = Near::new(&points, [1.0, 2.0]).unwrap();
        assert_eq!(region.weight(DVec3::new(50.3, 50.2, 0.5)), 1.0);
        assert_eq!(region.weight(DVec3::new(50.0, 50.0, 2.5)), 0.0);
    }
}
