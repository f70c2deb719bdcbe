//! Regions inside closed shapes, and half spaces.
//!
//! Each closed shape has a function s that is 0 at its centre, 1 on its boundary and grows linearly along rays from the
//! centre ("0.9" is 90 % of the size in every direction). The weight is D = 1 − P(s; s_min, s_max).

use fearless_simd::Simd;
use glam::{DMat3, DVec3};

use super::{Region, ramp_between};
use crate::error::{EditError, Result};
use crate::stencil::simd::{Work, dispatch};

/// A closed shape or half space; lengths in world units.
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// |q| / radius.
    Sphere {
        /// Radius.
        radius: f64,
    },
    /// max |qᵢ| / half size.
    Box {
        /// Half of each edge.
        half_size: DVec3,
    },
    /// Capped cylinder along local z: max(hypot(x, y) / radius, |z| / half height).
    Cylinder {
        /// Radius.
        radius: f64,
        /// Half of the height.
        half_height: f64,
    },
    /// Barr's superellipsoid: s = I^(e1/2), I = (|x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1).
    Superellipsoid {
        /// Semi-axes a, b, c.
        radii: DVec3,
        /// Exponents e1 (north–south) and e2 (east–west), 0.1..2.
        exponents: [f64; 2],
    },
}

impl Shape {
    /// The radially linear s at a local position.
    #[inline(always)]
    fn size_fraction(&self, q: DVec3) -> f64 {
        match *self {
            Self::Sphere { radius } => q.length() / radius,
            Self::Box { half_size } => (q / half_size).abs().max_element(),
            Self::Cylinder { radius, half_height } => (q.x.hypot(q.y) / radius).max(q.z.abs() / half_height),
            Self::Superellipsoid { radii, exponents: [e1, e2] } => {
                let r = (q / radii).abs();
                // Homogeneous of degree one: taking out the largest part keeps the powers finite.
                let scale = r.max_element();
                if scale == 0.0 {
                    return 0.0;
                }
                let r = r / scale;
                let equator = (r.x.powf(2.0 / e2) + r.y.powf(2.0 / e2)).powf(e2 / e1);
                scale * (equator + r.z.powf(2.0 / e1)).powf(e1 / 2.0)
            }
        }
    }

    /// Radius of a ball around the centre that lies in the shape: s changes by at most 1/radius a unit of length.
    fn inner_radius(&self) -> f64 {
        match *self {
            Self::Sphere { radius } => radius,
            Self::Box { half_size } => half_size.min_element(),
            Self::Cylinder { radius, half_height } => radius.min(half_height),
            // Exponents up to 2: the octahedron with the semi-axes lies in it.
            Self::Superellipsoid { radii, .. } => 1.0 / radii.recip().length(),
        }
    }

    /// Half edges of the local box around the shape.
    fn extent(&self) -> DVec3 {
        match *self {
            Self::Sphere { radius } => DVec3::splat(radius),
            Self::Box { half_size } => half_size,
            Self::Cylinder { radius, half_height } => DVec3::new(radius, radius, half_height),
            Self::Superellipsoid { radii, .. } => radii,
        }
    }
}

/// A placed shape with a soft edge.
#[derive(Clone, Debug, PartialEq)]
pub struct Primitive {
    centre: DVec3,
    /// Local axes as columns, orthonormal.
    axes: DMat3,
    shape: Shape,
    soft: [f64; 2],
}

impl Primitive {
    /// The soft edge where none is asked for: full weight inside 90 % of the size, none on the boundary.
    pub const DEFAULT_SOFT: [f64; 2] = [0.9, 1.0];

    /// A shape at `centre`, its local axes the orthonormal columns of `axes`; the weight falls from 1 at `soft[0]` of the size to 0 at `soft[1]`.
    pub fn new(shape: Shape, centre: DVec3, axes: DMat3, soft: [f64; 2]) -> Result<Self> {
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter("region", field, value, accepted));
        let extent = shape.extent();
        if !(extent.min_element() > 0.0 && extent.is_finite()) {
            return refuse("size", format!("{extent}"), "every size of a region must be positive and finite");
        }
        if let Shape::Superellipsoid { exponents, .. } = &shape
            && exponents.iter().any(|e| !(0.1..=2.0).contains(e))
        {
            return refuse("exponents", format!("{exponents:?}"), "exponents between 0.1 and 2");
        }
        if !centre.is_finite() {
            return refuse("center", format!("{centre}"), "three finite numbers");
        }
        if !(0.0 <= soft[0] && soft[0] <= soft[1] && soft[1].is_finite()) {
            return refuse(
                "soft",
                format!("{},{}", soft[0], soft[1]),
                "two parts of the size, the smaller first, such as 0.9,1",
            );
        }
        Ok(Self { centre, axes, shape, soft })
    }
}

impl Primitive {
    /// α at a position, for the shape of this primitive.
    #[inline(always)]
    fn weight_in(&self, shape: &Shape, xyz: DVec3) -> f32 {
        let s = shape.size_fraction(self.axes.transpose() * (xyz - self.centre));
        if self.soft[0] == self.soft[1] {
            return f32::from(u8::from(s < self.soft[1]));
        }
        (1.0 - ramp_between(s, self.soft[0], self.soft[1])) as f32
    }

    #[inline(always)]
    fn weigh_in(&self, shape: &Shape, xyz: &[DVec3], alpha: &mut [f32]) {
        for (alpha, xyz) in alpha.iter_mut().zip(xyz) {
            *alpha = self.weight_in(shape, *xyz);
        }
    }
}

/// α at several positions.
struct Weights<'a> {
    of: &'a Primitive,
    xyz: &'a [DVec3],
    alpha: &'a mut [f32],
}

impl Work for Weights<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { of, xyz, alpha } = self;
        // A loop for each shape: what must be told apart in a loop is no vector code.
        match of.shape {
            Shape::Sphere { radius } => of.weigh_in(&Shape::Sphere { radius }, xyz, alpha),
            Shape::Box { half_size } => of.weigh_in(&Shape::Box { half_size }, xyz, alpha),
            Shape::Cylinder { radius, half_height } => {
                of.weigh_in(&Shape::Cylinder { radius, half_height }, xyz, alpha);
            }
            Shape::Superellipsoid { radii, exponents } => {
                of.weigh_in(&Shape::Superellipsoid { radii, exponents }, xyz, alpha);
            }
        }
    }
}

impl Region for Primitive {
    fn weight(&self, xyz: DVec3) -> f32 {
        self.weight_in(&self.shape, xyz)
    }

    fn weights(&self, xyz: &[DVec3], alpha: &mut [f32]) {
        dispatch(Weights { of: self, xyz, alpha });
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let extent = self.shape.extent() * self.soft[1];
        let abs = DMat3::from_cols(self.axes.x_axis.abs(), self.axes.y_axis.abs(), self.axes.z_axis.abs());
        let reach = abs * extent;
        Some((self.centre - reach, self.centre + reach))
    }

    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        // s is the gauge of a convex body, so that it changes by at most one over the radius of a ball within. A little more for rounding.
        let reach = radius / self.shape.inner_radius() * (1.0 + 1e-9) + 1e-9;
        let s = self.shape.size_fraction(self.axes.transpose() * (centre - self.centre));
        [f32::from(u8::from(s + reach < self.soft[0])), f32::from(u8::from(s - reach < self.soft[1]))]
    }
}

/// One side of a plane: α = P(−f; 0, depth) with f = (x − point)·normal, 0 on the plane and 1 from `depth` behind it on.
#[derive(Clone, Debug, PartialEq)]
pub struct HalfSpace {
    point: DVec3,
    normal: DVec3,
    depth: f64,
}

impl HalfSpace {
    /// The side of the plane through `point` that `normal` points away from, full at `depth` (world units) behind it.
    pub fn new(point: DVec3, normal: DVec3, depth: f64) -> Result<Self> {
        let refuse =
            |field: &str, value: String, accepted: &str| EditError::parameter("region", field, value, accepted);
        let unit = normal.try_normalize().filter(|n| n.is_finite());
        let unit = unit.ok_or_else(|| refuse("normal", normal.to_string(), "a finite vector that is not zero"))?;
        if !point.is_finite() {
            return Err(refuse("point", point.to_string(), "three finite numbers"));
        }
        if !(depth >= 0.0 && depth.is_finite()) {
            return Err(refuse("soft", depth.to_string(), "a finite number of voxels, 0 or more"));
        }
        Ok(Self { point, normal: unit, depth })
    }

    /// −f: how far a position lies inside.
    fn depth_of(&self, xyz: DVec3) -> f64 {
        (self.point - xyz).dot(self.normal)
    }
}

impl Region for HalfSpace {
    fn weight(&self, xyz: DVec3) -> f32 {
        ramp_between(self.depth_of(xyz), 0.0, self.depth) as f32
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        None
    }

    fn weights_within(&self, centre: DVec3, radius: f64) -> [f32; 2] {
        let depth = self.depth_of(centre);
        [-radius, radius].map(|by| ramp_between(depth + by * (1.0 + 1e-9), 0.0, self.depth) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_origin(shape: Shape) -> Primitive {
        Primitive::new(shape, DVec3::ZERO, DMat3::IDENTITY, Primitive::DEFAULT_SOFT).unwrap()
    }

    #[test]
    fn superellipsoid_is_homogeneous() {
        // Barr 1981.
        let ellipsoid = Shape::Superellipsoid { radii: DVec3::new(3.0, 2.0, 1.0), exponents: [1.0, 1.0] };
        for (p, s) in [([3.0, 0.0, 0.0], 1.0), ([0.0, 2.0, 0.0], 1.0), ([0.0, 0.0, 1.0], 1.0), ([1.5, 0.0, 0.0], 0.5)] {
            assert!((ellipsoid.size_fraction(DVec3::from(p)) - s).abs() < 1e-12);
        }
        let boxy = Shape::Superellipsoid { radii: DVec3::new(3.0, 2.0, 1.0), exponents: [0.2, 0.2] };
        let corner = DVec3::new(2.97, 1.98, 0.99);
        assert!((boxy.size_fraction(corner) - 1.105).abs() < 5e-4);
        assert!((boxy.size_fraction(corner * 0.25) - 1.105 * 0.25).abs() < 2e-4);
        assert_eq!(boxy.size_fraction(DVec3::ZERO), 0.0);
    }

    #[test]
    fn weights_fall_between_the_soft_limits() {
        for (shape, axis) in [
            (Shape::Sphere { radius: 2.0 }, DVec3::X * 2.0),
            (Shape::Box { half_size: DVec3::new(1.0, 2.0, 3.0) }, DVec3::Z * 3.0),
            (Shape::Cylinder { radius: 2.0, half_height: 1.0 }, DVec3::Z),
        ] {
            let region = at_origin(shape);
            for (s, w) in [(0.5, 1.0), (0.9, 1.0), (0.95, 0.5), (1.0, 0.0), (1.5, 0.0)] {
                assert!((region.weight(axis * s) - w).abs() < 1e-6, "{region:?} {s}");
            }
        }
    }

    #[test]
    fn no_weight_in_a_ball_is_beyond_its_limits() {
        for shape in [
            Shape::Sphere { radius: 2.0 },
            Shape::Box { half_size: DVec3::new(1.0, 2.0, 3.0) },
            Shape::Cylinder { radius: 2.0, half_height: 1.0 },
            Shape::Superellipsoid { radii: DVec3::new(3.0, 2.0, 1.0), exponents: [0.2, 2.0] },
            Shape::Superellipsoid { radii: DVec3::new(1.0, 1.0, 2.0), exponents: [2.0, 2.0] },
        ] {
            let region = at_origin(shape);
            // Places in and around the shape, and balls small against it: some lie wholly in the full part, some outside.
            let (radius, spread) = (0.1, region.shape.extent() * 1.5);
            let at = |i: u32, k: u32| f64::from(i * k % 41) / 20.5 - 1.0;
            let (mut all, mut none) = (0, 0);
            for i in 0..400 {
                let centre = DVec3::new(at(i, 7), at(i / 7, 11), at(i / 49, 17)) * spread;
                let [low, high] = region.weights_within(centre, radius);
                for k in 0..60 {
                    let offset = DVec3::new(at(k, 3), at(k, 13), at(k, 19)).normalize_or_zero() * radius;
                    assert!((low..=high).contains(&region.weight(centre + offset)), "{region:?} {centre}");
                }
                (all, none) = (all + u32::from(low == 1.0), none + u32::from(high == 0.0));
            }
            assert!(all > 0 && none > 40, "{region:?}: {all} {none}");
        }
    }

    #[test]
    fn half_space_is_full_behind_its_rim() {
        let region = HalfSpace::new(DVec3::X, DVec3::X * 5.0, 2.0).unwrap();
        for (x, w) in [(2.0, 0.0), (1.0, 0.0), (0.0, 0.5), (-1.0, 1.0), (-50.0, 1.0)] {
            assert_eq!(region.weight(DVec3::new(x, 7.0, -3.0)), w, "{x}");
        }
        assert_eq!(region.weights_within(DVec3::X * 3.0, 1.5), [0.0, 0.0]);
        assert_eq!(region.weights_within(DVec3::X * -3.0, 1.5), [1.0, 1.0]);
        assert_eq!(region.weights_within(DVec3::ZERO, 1.5), [0.0, 1.0]);
        assert!(HalfSpace::new(DVec3::X, DVec3::ZERO, 2.0).is_err());
    }

    #[test]
    fn refuses_what_cannot_work() {
        for (radius, soft) in
            [(0.0, [0.9, 1.0]), (f64::NAN, [0.9, 1.0]), (1.0, [1.0, 0.9]), (1.0, [0.5, f64::INFINITY])]
        {
            assert!(Primitive::new(Shape::Sphere { radius }, DVec3::ZERO, DMat3::IDENTITY, soft).is_err());
        }
    }
}
