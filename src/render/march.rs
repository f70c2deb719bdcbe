//! Rays against the surface: the first zero of the trilinear field, solved exactly.
//!
//! Empty space is crossed in jumps ([`SkipMap`]). Where there is surface a ray steps by 0.9 |φ| where that is more than a cell,
//! and from cell to cell otherwise. Along a ray the trilinear field of a cell is a cubic; its first root
//! comes from the monotone pieces between its extremes (Marmitt et al. 2004), so that neighbouring pixels see one
//! continuous surface, without steps. Distances along rays are in voxels.

use glam::{DVec3, IVec3, Vec3, Vec3A};

use super::field::{Cursor, Field};
use super::skip::{self, SkipMap};

/// Part of |φ| that a step takes: trilinear values may exceed the distance by a few hundredths of a voxel.
const STEP: f32 = 0.9;
/// Where all corners of a cell are farther from the surface (voxels), a step by |φ| may be longer than the cell.
const HOP_FROM: f32 = 0.3;
/// After a jump, rays go this far (voxels) into the next part, so that rounding cannot put them back.
const NUDGE: f64 = 1e-7;
/// Components of a direction below this are taken as 0.
const PARALLEL: f64 = 1e-9;

/// A ray in index space; `direction` is a unit vector.
#[derive(Clone, Copy)]
pub(super) struct Ray {
    pub origin: DVec3,
    pub direction: DVec3,
    pub inverse: DVec3,
}

impl Ray {
    pub fn new(origin: DVec3, direction: DVec3) -> Self {
        // A component this small moves the ray by nothing that matters, but its quotient would be all rounding: such a
        // ray counts as parallel, and a huge quotient says that it never leaves a box along that axis.
        let direction = direction.map(|d| if d.abs() < PARALLEL { 0.0 } else { d });
        let inverse = direction.map(|d| if d == 0.0 { 1e30 } else { 1.0 / d });
        Self { origin, direction, inverse }
    }

    #[inline(always)]
    pub fn at(&self, t: f64) -> DVec3 {
        self.origin + self.direction * t
    }

    /// The ray without its first part.
    pub fn after(&self, t: f64) -> Self {
        Self { origin: self.at(t), ..*self }
    }

    /// Entry and exit of a box.
    #[inline(always)]
    pub fn crossing(&self, (lo, hi): (DVec3, DVec3)) -> (f64, f64) {
        let (a, b) = ((lo - self.origin) * self.inverse, (hi - self.origin) * self.inverse);
        (a.min(b).max_element(), a.max(b).min_element())
    }
}

/// Rounds down: the library's function is a call on machines without an instruction for it, and this is the inner loop.
#[inline(always)]
fn floor(p: DVec3) -> IVec3 {
    let toward_zero = p.as_ivec3();
    let above = p.cmplt(toward_zero.as_dvec3());
    toward_zero - IVec3::select(above, IVec3::ONE, IVec3::ZERO)
}

/// The same in single precision.
#[inline(always)]
fn floor_near(p: Vec3A) -> IVec3 {
    p.floor().as_ivec3()
}

/// Where a ray starts.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Start {
    /// Outside the surface: the first negative value is a hit.
    Outside,
    /// Beside the surface, perhaps just below it: counts from the first positive value on.
    Surface,
}

/// The level set as rays see it.
pub(super) struct Scene<'a> {
    pub field: Field<'a>,
    pub skip: SkipMap,
}

impl Scene<'_> {
    /// Distance along `ray` to the first crossing from outside to inside before `t_end`.
    pub fn hit(&self, cursor: &mut Cursor, ray: &Ray, start: Start, t_end: f64) -> Option<f64> {
        let (enter, leave) = ray.crossing(self.skip.bounds());
        let mut t = enter.max(0.0);
        let t_end = leave.min(t_end);
        let mut outside = start == Start::Outside;
        let mut nudge = NUDGE;
        let octant = skip::octant(ray.direction);
        while t < t_end {
            let cell = floor(ray.at(t));
            if let Some(far) = self.skip.empty_ahead(self.skip.part(cell), octant) {
                let beyond = ((far - ray.origin) * ray.inverse).min_element() + NUDGE;
                // Rounding may leave a grazing ray in the same part: growing steps get it out.
                nudge = if beyond > t { NUDGE } else { 2.0 * nudge };
                t = beyond.max(t + nudge);
                continue;
            }
            match self.walk(cursor, ray, t, cell, &mut outside) {
                Walk::Hit(at) => return (at < t_end).then_some(at),
                // Onto the cell that the walk has reached: its own corner may round to the other side of the face.
                Walk::Left(at) => t = at + NUDGE,
            }
        }
        None
    }

    /// Whether a point is outside the surface.
    pub fn is_outside(&self, cursor: &mut Cursor, point: DVec3) -> bool {
        let cell = floor(point);
        interpolate(&cursor.cell(cell), (point - cell.as_dvec3()).as_vec3()) > 0.0
    }

    /// The way of a ray through a part with surface from `cell` on, where it is at `t`.
    #[inline(always)]
    fn walk(&self, cursor: &mut Cursor, ray: &Ray, t: f64, mut cell: IVec3, outside: &mut bool) -> Walk {
        let to_voxels = self.field.to_voxels() as f32;
        let reach = HOP_FROM / to_voxels;
        let part = self.skip.part(cell);
        // From here on relative to the cell in which it enters and to t: single precision is plenty within a part.
        let first = cell;
        let origin = (ray.at(t) - first.as_dvec3()).as_vec3a();
        let (direction, inverse) = (ray.direction.as_vec3a(), ray.inverse.as_vec3a());
        let step = ray.direction.map(|d| if d < 0.0 { -1.0 } else { 1.0 }).as_ivec3();
        let ahead = step.max(IVec3::ZERO).as_vec3a();
        // Distances at which the ray leaves the cell through its next x, y and z face.
        let faces_of = |cell: IVec3| ((cell - first).as_vec3a() + ahead - origin) * inverse;
        let stride = inverse.abs();
        let (mut s, mut faces) = (0.0f32, faces_of(cell));
        loop {
            let corners = cursor.cell(cell);
            let (low, high) = extremes(&corners);
            let exit = faces.min_element();
            if low < 0.0 && high >= 0.0 {
                let [a, b, c, d, e, f, g, h] = corners;
                let corners = [a.into(), b.into(), c.into(), d.into(), e.into(), f.into(), g.into(), h.into()];
                let at = t + f64::from(s);
                let cubic = Cubic::along(&corners, ray.at(at) - cell.as_dvec3(), ray.direction);
                let length = f64::from((exit - s).max(0.0));
                if *outside && cubic.at(0.0) <= 0.0 {
                    return Walk::Hit(at);
                }
                if cubic.is_positive(length) {
                    *outside = true;
                } else {
                    if let Some(entry) = cubic.first_entry(length) {
                        return Walk::Hit(at + entry);
                    }
                    *outside = cubic.at(length) > 0.0;
                }
            } else if low < 0.0 {
                if *outside {
                    return Walk::Hit(t + f64::from(s));
                }
            } else {
                *outside = true;
            }
            let hop = if low > reach || high < -reach {
                let at = origin + direction * s - (cell - first).as_vec3a();
                s + STEP * to_voxels * interpolate(&corners, at.into()).abs()
            } else {
                0.0
            };
            if hop > exit {
                s = hop;
                cell = first + floor_near(origin + direction * s);
                faces = faces_of(cell);
            } else {
                s = exit.max(s);
                if faces.x <= exit {
                    cell.x += step.x;
                    faces.x += stride.x;
                } else if faces.y <= exit {
                    cell.y += step.y;
                    faces.y += stride.y;
                } else {
                    cell.z += step.z;
                    faces.z += stride.z;
                }
            }
            if self.skip.part(cell) != part {
                return Walk::Left(t + f64::from(s));
            }
        }
    }
}

/// How a ray has passed a part with surface.
enum Walk {
    /// It went into the surface here.
    Hit(f64),
    /// It left the part here.
    Left(f64),
}

/// The least and the largest of the corners. In pairs: the inner loop waits for it.
#[inline(always)]
fn extremes(corners: &[f32; 8]) -> (f32, f32) {
    let less = |a: f32, b: f32| if a < b { a } else { b };
    let more = |a: f32, b: f32| if a > b { a } else { b };
    let [a, b, c, d, e, f, g, h] = *corners;
    (
        less(less(less(a, b), less(c, d)), less(less(e, f), less(g, h))),
        more(more(more(a, b), more(c, d)), more(more(e, f), more(g, h))),
    )
}

/// Trilinear value at `part` of a cell.
#[inline(always)]
fn interpolate(corners: &[f32; 8], part: Vec3) -> f32 {
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let z: [f32; 4] = std::array::from_fn(|i| lerp(corners[2 * i], corners[2 * i + 1], part.z));
    lerp(lerp(z[0], z[1], part.y), lerp(z[2], z[3], part.y), part.x)
}

/// φ along a ray through one cell: c0 + c1 s + c2 s² + c3 s³.
struct Cubic([f64; 4]);

impl Cubic {
    /// The field with `corners` (order x·4 + y·2 + z) along `origin` + s `direction`, `origin` relative to the cell.
    fn along(corners: &[f64; 8], origin: DVec3, direction: DVec3) -> Self {
        let [a000, a001, a010, a011, a100, a101, a110, a111] = *corners;
        // Coefficients of 1, x, y, z, xy, xz, yz, xyz.
        let (x, y, z) = (a100 - a000, a010 - a000, a001 - a000);
        let (xy, xz, yz) = (a110 - a010 - x, a101 - a001 - x, a011 - a010 - z);
        let xyz = a111 - a110 - a101 - a011 + a100 + a010 + a001 - a000;
        let (o, d) = (origin, direction);
        // Products of two and three coordinates along the ray, by power of s.
        let pair = |o1: f64, d1: f64, o2: f64, d2: f64| [o1 * o2, o1 * d2 + o2 * d1, d1 * d2];
        let (pxy, pxz, pyz) = (pair(o.x, d.x, o.y, d.y), pair(o.x, d.x, o.z, d.z), pair(o.y, d.y, o.z, d.z));
        let sum = |k: usize| xy * pxy[k] + xz * pxz[k] + yz * pyz[k];
        Self([
            a000 + x * o.x + y * o.y + z * o.z + sum(0) + xyz * pxy[0] * o.z,
            x * d.x + y * d.y + z * d.z + sum(1) + xyz * (pxy[0] * d.z + pxy[1] * o.z),
            sum(2) + xyz * (pxy[1] * d.z + pxy[2] * o.z),
            xyz * pxy[2] * d.z,
        ])
    }

    #[inline(always)]
    fn at(&self, s: f64) -> f64 {
        let [c0, c1, c2, c3] = self.0;
        c0 + s * (c1 + s * (c2 + s * c3))
    }

    /// Whether the coefficients of the Bernstein form over 0..=length are positive, and so all values between.
    #[inline(always)]
    fn is_positive(&self, length: f64) -> bool {
        let [c0, c1, c2, _] = self.0;
        let (c1, c2) = (c1 * length, c2 * length * length);
        c0 > 0.0 && 3.0 * c0 + c1 > 0.0 && 3.0 * c0 + 2.0 * c1 + c2 > 0.0 && self.at(length) > 0.0
    }

    /// The first s in 0..=length at which the field goes from positive to negative.
    fn first_entry(&self, length: f64) -> Option<f64> {
        let [_, c1, c2, c3] = self.0;
        // Extremes: 3 c3 s² + 2 c2 s + c1 = 0, in the form that does not cancel.
        let root = (c2 * c2 - 3.0 * c3 * c1).max(0.0).sqrt();
        let q = -(c2 + root.copysign(c2));
        let clamp = |s: f64| if s > 0.0 && s < length { s } else { length };
        let (e1, e2) = (clamp(c1 / q), clamp(q / (3.0 * c3)));
        let mut from = 0.0;
        for to in [e1.min(e2), e1.max(e2), length] {
            if self.at(from) > 0.0 && self.at(to) <= 0.0 {
                return Some(self.root(from, to));
            }
            from = to;
        }
        None
    }

    /// The root between `a` (positive) and `b` (not positive), monotone between: Newton's steps kept inside by bisection.
    fn root(&self, mut a: f64, mut b: f64) -> f64 {
        let [_, c1, c2, c3] = self.0;
        let mut s = 0.5 * (a + b);
        for _ in 0..24 {
            let value = self.at(s);
            if value > 0.0 {
                a = s
            } else {
                b = s
            }
            let newton = s - value / (c1 + s * (2.0 * c2 + s * 3.0 * c3));
            let next = if newton >= a && newton <= b { newton } else { 0.5 * (a + b) };
            if (next - s).abs() < 1e-9 {
                return next;
            }
            s = next;
        }
        s
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::testing::{scene, sphere};

    #[test]
    fn cubic_of_a_cell_equals_interpolation_and_finds_the_first_of_three_roots() {
        let corners = [0.3, -0.7, 0.2, 0.9, -0.4, 0.1, 0.8, -0.6];
        let (o, d) = (DVec3::new(0.1, 0.9, 0.2), DVec3::new(0.8, -0.7, 0.6).normalize());
        let cubic = Cubic::along(&corners, o, d);
        for s in [0.0, 0.3, 0.6, 1.0] {
            let p = o + d * s;
            let expected: f64 = (0..8)
                .map(|c| {
                    let w = |bit: usize, v: f64| if c >> bit & 1 == 1 { v } else { 1.0 - v };
                    corners[c] * w(2, p.x) * w(1, p.y) * w(0, p.z)
                })
                .sum();
            assert!((cubic.at(s) - expected).abs() < 1e-12);
        }
        // −(s − 0.1)(s − 0.5)(s − 0.7): positive before 0.1, negative after, positive in 0.5..0.7.
        let three = Cubic([0.035, -0.47, 1.3, -1.0]);
        assert!((three.first_entry(1.0).unwrap() - 0.1).abs() < 1e-8);
        let linear = Cubic([0.5, -1.0, 0.0, 0.0]);
        assert!((linear.first_entry(1.0).unwrap() - 0.5).abs() < 1e-8);
        assert!(linear.first_entry(0.4).is_none());
        assert!(Cubic([0.5, 0.0, 0.0, 0.0]).first_entry(1.0).is_none());
    }

    #[test]
    fn hits_of_a_sphere_are_where_they_should_be() {
        let r = 25.0;
        let set = sphere(r, 3.0);
        let scene = scene(&set);
        let mut cursor = scene.field.cursor();
        let (mut hits, mut misses) = (0, 0);
        for i in 0..3000 {
            // Rays from all around, aimed at points spread over a cube around the sphere.
            let spread = |k: f64| (f64::from(i) * k).fract() * 2.0 - 1.0;
            let origin = DVec3::new(spread(0.618034), spread(0.414214), spread(0.732051)).normalize() * 90.0;
            let target = DVec3::new(spread(0.236068), spread(0.162278), spread(0.605551)) * 27.0;
            let ray = Ray::new(origin, (target - origin).normalize());
            let b = origin.dot(ray.direction);
            let discriminant = b * b - (origin.length_squared() - r * r);
            let closest = (origin.length_squared() - b * b).sqrt();
            let hit = scene.hit(&mut cursor, &ray, Start::Outside, f64::INFINITY);
            if closest < r - 0.02 {
                let hit = hit.unwrap();
                // The trilinear surface lies within h²/(4r) = 0.01 voxel of the sphere.
                assert!((ray.at(hit).length() - r).abs() < 0.011, "{i}");
                let depth = -b - discriminant.sqrt();
                let cosine = ray.at(hit).normalize().dot(-ray.direction);
                assert!((hit - depth).abs() * cosine < 0.02, "{i}: {hit} {depth}");
                hits += 1;
            } else if closest > r + 0.02 {
                assert!(hit.is_none(), "{i}");
                misses += 1;
            }
        }
        assert!(hits > 1000 && misses > 300, "{hits} {misses}");
    }

    #[test]
    fn rays_along_the_axes_and_from_the_surface() {
        let set = sphere(25.0, 3.0);
        let scene = scene(&set);
        let mut cursor = scene.field.cursor();
        for axis in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z] {
            let from_outside = Ray::new(axis * -100.0, axis);
            let hit = scene.hit(&mut cursor, &from_outside, Start::Outside, f64::INFINITY).unwrap();
            assert!((hit - 75.0).abs() < 0.01);
            assert!(scene.hit(&mut cursor, &from_outside, Start::Outside, 74.0).is_none());
            // From just below the surface outwards nothing is in the way; inwards the far wall is met from inside: no entry.
            let below = Ray::new(axis * 24.9, axis);
            assert!(scene.hit(&mut cursor, &below, Start::Surface, f64::INFINITY).is_none());
            let inwards = Ray::new(axis * 24.9, -axis);
            assert!(scene.hit(&mut cursor, &inwards, Start::Surface, f64::INFINITY).is_none());
        }
    }
}
