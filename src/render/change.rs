//! Where something was changed: cubes of space that a ray passes or does not.

use glam::{DVec3, IVec3};

use super::march::Ray;

/// Least edge of a cube, in voxels.
const LEAST_EDGE: i32 = 4;
/// Most cubes; a larger change has larger ones.
const MAX_CUBES: u64 = 1 << 21;

/// Cubes in index space that hold all that was changed.
pub(super) struct Changed {
    /// First cube, in cubes.
    lo: IVec3,
    size: IVec3,
    edge: i32,
    is_marked: Vec<bool>,
}

impl Changed {
    /// What lies in boxes, and `margin` voxels around them; `None` without any.
    pub fn of(boxes: &[(DVec3, DVec3)], margin: f64) -> Option<Self> {
        let (lo, hi) = boxes.iter().copied().reduce(|(a, b), (c, d)| (a.min(c), b.max(d)))?;
        let mut edge = LEAST_EDGE;
        let cube = |at: DVec3, edge: i32| (at / f64::from(edge)).floor().as_ivec3();
        let span = |lo: DVec3, hi: DVec3, edge: i32| (cube(lo - margin, edge), cube(hi + margin, edge) + 1);
        let count = |edge: i32| {
            let (first, end) = span(lo, hi, edge);
            (end - first).to_array().iter().map(|&n| n as u64).product::<u64>()
        };
        while count(edge) > MAX_CUBES {
            edge *= 2;
        }
        let (first, end) = span(lo, hi, edge);
        let is_marked = vec![false; count(edge) as usize];
        let mut changed = Self { lo: first, size: end - first, edge, is_marked };
        for &(lo, hi) in boxes {
            let (first, end) = span(lo, hi, edge);
            for x in first.x..end.x {
                for y in first.y..end.y {
                    let row = changed.index(IVec3::new(x, y, first.z) - changed.lo);
                    changed.is_marked[row..row + (end.z - first.z) as usize].fill(true);
                }
            }
        }
        Some(changed)
    }

    fn index(&self, local: IVec3) -> usize {
        ((local.x * self.size.y + local.y) * self.size.z + local.z) as usize
    }

    /// The box around all of it.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let corner = |at: IVec3| at.as_dvec3() * f64::from(self.edge);
        (corner(self.lo), corner(self.lo + self.size))
    }

    /// Whether a ray passes any of it before `t_end`.
    pub fn is_met(&self, ray: &Ray, t_end: f64) -> bool {
        let (enter, leave) = ray.crossing(self.bounds());
        let (t, t_end) = (enter.max(0.0), leave.min(t_end));
        if t > t_end {
            return false;
        }
        let edge = f64::from(self.edge);
        let local = (ray.at(t) / edge).floor().as_ivec3() - self.lo;
        let mut cube = local.clamp(IVec3::ZERO, self.size - 1);
        let step = IVec3::select(ray.direction.cmplt(DVec3::ZERO), IVec3::NEG_ONE, IVec3::ONE);
        let ahead = (self.lo + cube + step.max(IVec3::ZERO)).as_dvec3() * edge;
        // Where the ray leaves the cube along each axis.
        let mut faces = (ahead - ray.origin) * ray.inverse;
        loop {
            if self.is_marked[self.index(cube)] {
                return true;
            }
            let axis = faces.min_position();
            if faces[axis] > t_end {
                return false;
            }
            cube[axis] += step[axis];
            faces[axis] += edge * ray.inverse[axis].abs();
            if !(0..self.size[axis]).contains(&cube[axis]) {
                return false;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_what_they_pass() {
        let boxes =
            [(DVec3::splat(-3.0), DVec3::splat(3.0)), (DVec3::new(60.0, 0.0, 0.0), DVec3::new(64.0, 30.0, 5.0))];
        let changed = Changed::of(&boxes, 1.0).unwrap();
        let (lo, hi) = changed.bounds();
        assert!(boxes.iter().all(|(a, b)| (*a - 1.0).cmpge(lo).all() && (*b + 1.0).cmple(hi).all()));
        let (mut met, mut beside) = (0, 0);
        for i in 0..4000 {
            let spread = |k: f64| (f64::from(i) * k).fract() * 2.0 - 1.0;
            let origin = DVec3::new(spread(0.618034), spread(0.414214), spread(0.732051)).normalize() * 90.0;
            let target = DVec3::new(30.0, 10.0, 0.0)
                + DVec3::new(spread(0.236068), spread(0.162278), spread(0.605551)) * DVec3::new(45.0, 25.0, 12.0);
            let ray = Ray::new(origin, (target - origin).normalize());
            let meets = |bounds: (DVec3, DVec3)| {
                let (enter, leave) = ray.crossing(bounds);
                enter <= leave && leave >= 0.0
            };
            let passes = |grown: f64| boxes.iter().any(|(lo, hi)| meets((*lo - grown, *hi + grown)));
            let is_met = changed.is_met(&ray, f64::INFINITY);
            assert!(is_met || !passes(1.0), "{i}");
            assert!(!is_met || passes(1.0 + f64::from(LEAST_EDGE)), "{i}");
            let start = boxes.iter().map(|b| ray.crossing((b.0 - 9.0, b.1 + 9.0)).0).fold(f64::INFINITY, f64::min);
            assert!(!changed.is_met(&ray, start));
            met += usize::from(is_met);
            beside += usize::from(!is_met && meets((lo, hi)));
        }
        assert!(met > 500 && beside > 500, "{met} {beside}");
        assert!(Changed::of(&[], 1.0).is_none());
    }
}
