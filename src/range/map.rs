//! One range map: what a scanner measured along the ray of each pixel, and where it stood.

use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

/// How pixels and rays belong together, in the scanner's frame. Pixel centres have whole coordinates (u, v).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Projection {
    /// Parallel rays along −z; pixel (0, 0) at `first`, pixels `pitch` apart along x and y. The range is −z.
    Orthographic {
        /// x and y of the first pixel.
        first: DVec2,
        /// Distance between pixels along x and y.
        pitch: DVec2,
    },
    /// A camera that looks along +z, x to the right and y down. The range is the distance from the origin.
    Pinhole {
        /// Focal length in pixels along u and v.
        focal: DVec2,
        /// The pixel on the axis.
        centre: DVec2,
    },
    /// A turning head at the origin: azimuth atan2(y, x) along u, elevation along v. The range is the distance from the origin.
    Spherical {
        /// Azimuth and elevation of the first pixel, radians.
        first: DVec2,
        /// Their steps from pixel to pixel.
        step: DVec2,
    },
}

impl Projection {
    /// The pixel (with fractions) and range of a point in the scanner's frame; `None` where no pixel looks.
    pub fn project(&self, p: DVec3) -> Option<(DVec2, f64)> {
        match *self {
            Self::Orthographic { first, pitch } => Some(((p.truncate() - first) / pitch, -p.z)),
            Self::Pinhole { focal, centre } => (p.z > 0.0).then(|| (p.truncate() / p.z * focal + centre, p.length())),
            Self::Spherical { first, step } => {
                let range = p.length();
                let mut angles = DVec2::new(p.y.atan2(p.x), (p.z / range.max(f64::MIN_POSITIVE)).asin()) - first;
                // The turn at which the pixels begin may lie anywhere; it is that from half a pixel before the first one on.
                let (turn, half) = (std::f64::consts::TAU, step.x / 2.0);
                angles.x += half;
                angles.x -= turn * (angles.x / turn).floor();
                if step.x < 0.0 {
                    angles.x -= turn;
                }
                angles.x -= half;
                (range > 0.0).then(|| (angles / step, range))
            }
        }
    }

    /// The point that a pixel sees at a range, in the scanner's frame.
    pub fn point(&self, pixel: DVec2, range: f64) -> DVec3 {
        match *self {
            Self::Orthographic { first, pitch } => (first + pixel * pitch).extend(-range),
            Self::Pinhole { focal, centre } => ((pixel - centre) / focal).extend(1.0).normalize() * range,
            Self::Spherical { first, step } => {
                let angles = first + pixel * step;
                let (sin_a, cos_a) = angles.x.sin_cos();
                let (sin_e, cos_e) = angles.y.sin_cos();
                DVec3::new(cos_e * cos_a, cos_e * sin_a, sin_e) * range
            }
        }
    }

    /// Distance between neighbouring pixels at a range.
    pub fn pixel_size(&self, range: f64) -> f64 {
        match *self {
            Self::Orthographic { pitch, .. } => pitch.abs().max_element(),
            Self::Pinhole { focal, .. } => range / focal.abs().min_element(),
            Self::Spherical { step, .. } => range * step.abs().max_element(),
        }
    }

    /// Pixels a unit of area square to the ray at a range, up to a constant: what a measurement there weighs in the integral over pixels.
    pub(super) fn density(&self, p: DVec3, range: f64) -> f64 {
        match *self {
            Self::Orthographic { .. } => 1.0,
            Self::Spherical { .. } => 1.0 / (range * range),
            // Equal pixels of a plane: cos³ of the angle to the axis.
            Self::Pinhole { .. } => range / (p.z * p.z * p.z).max(f64::MIN_POSITIVE),
        }
    }

    fn is_parallel(&self) -> bool {
        matches!(self, Self::Orthographic { .. })
    }
}

/// What is known of space along the rays that found nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Background {
    /// Nothing is known: the surface may have been too dark, or hidden from the lamp.
    #[default]
    Unknown,
    /// There is nothing along them.
    Empty,
}

/// A range map in the world.
#[derive(Clone, Debug)]
pub struct RangeMap {
    /// What it is called in reports.
    pub name: String,
    /// How its pixels look.
    pub projection: Projection,
    /// From the scanner's frame to the world; rigid.
    pub pose: DAffine3,
    /// Pixels a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Ranges in world units, row by row; NaN where nothing was measured.
    pub ranges: Vec<f32>,
    /// Confidence, 0 to 1.
    pub weights: Vec<f32>,
    /// sRGB colours, or none at all.
    pub colors: Vec<[u8; 3]>,
    /// Standard deviation of the ranges, world units; `None` if it is to be estimated.
    pub noise: Option<f64>,
    /// What rays without a measurement say.
    pub background: Background,
}

/// What a map says of all points of a ball.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Around {
    /// The ball is outside of its picture.
    Outside,
    /// No ray through it has a measurement.
    Invalid,
    /// All rays through it have one: the least and the largest signed distance along them, positive in front of what was measured.
    Measured(f64, f64),
    /// One thing here, another there, or as near to what was measured as not to matter, or too near to the scanner to be told.
    Mixed,
}

impl RangeMap {
    /// A map of rows of `width` pixels, each as good as the others.
    pub fn new(name: String, projection: Projection, pose: DAffine3, width: usize, ranges: Vec<f32>) -> Self {
        Self {
            name,
            projection,
            pose,
            width,
            height: ranges.len() / width.max(1),
            weights: vec![1.0; ranges.len()],
            ranges,
            colors: Vec::new(),
            noise: None,
            background: Background::default(),
        }
    }

    /// The colour of the pixel that sees a point of the world.
    pub fn color(&self, to_scanner: &DAffine3, xyz: DVec3) -> Option<[u8; 3]> {
        let (pixel, _) = self.projection.project(to_scanner.transform_point3(xyz))?;
        let within = pixel.cmpgt(DVec2::splat(-0.5)).all() && pixel.x < self.width as f64 - 0.5;
        let (u, v) = ((pixel.x + 0.5) as usize, (pixel.y + 0.5) as usize);
        self.colors.get(v * self.width + u).copied().filter(|_| within)
    }

    /// What it says of the points up to `radius` from a point of the world. Where some may be less than `near` from what was measured, that is not looked into.
    pub fn look_around(&self, to_scanner: &DAffine3, xyz: DVec3, radius: f64, near: f64) -> Around {
        let p = to_scanner.transform_point3(xyz);
        let Some((_, range)) = self.projection.project(p) else { return Around::Mixed };
        let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for corner in 0..8 {
            let side = |bit: i32| if corner & bit == 0 { -radius } else { radius };
            match self.projection.project(p + DVec3::new(side(1), side(2), side(4))) {
                Some((pixel, _)) => (lo, hi) = (lo.min(pixel), hi.max(pixel)),
                None => return Around::Mixed,
            }
        }
        // A pixel more: between pixels four of them count.
        let (lo, hi) = ((lo - 1.0).floor(), (hi + 1.0).ceil());
        let size = DVec2::new(self.width as f64, self.height as f64);
        if hi.cmplt(DVec2::ZERO).any() || lo.cmpge(size).any() {
            // Turning heads see round the back as well.
            return if matches!(self.projection, Projection::Spherical { .. }) {
                Around::Mixed
            } else {
                Around::Outside
            };
        }
        if !(lo.cmpge(DVec2::ZERO).all() && hi.cmplt(size).all()) || (hi - lo).element_product() > 4096.0 {
            return Around::Mixed;
        }
        let (mut least, mut most, mut gaps) = (f32::INFINITY, f32::NEG_INFINITY, 0);
        for v in lo.y as usize..=hi.y as usize {
            for &range in &self.ranges[v * self.width + lo.x as usize..=v * self.width + hi.x as usize] {
                // Neither holds of what is no number.
                least = if range < least { range } else { least };
                most = if range > most { range } else { most };
                gaps += usize::from(range.is_nan());
            }
            let is_near = f64::from(least) - range - radius <= near && f64::from(most) - range + radius >= -near;
            if is_near || gaps > 0 && least <= most {
                return Around::Mixed;
            }
        }
        match gaps {
            0 => Around::Measured(f64::from(least) - range - radius, f64::from(most) - range + radius),
            _ => Around::Invalid,
        }
    }

    /// The range at a pixel, NaN where there is none.
    pub fn range(&self, u: usize, v: usize) -> f32 {
        self.ranges.get(v * self.width + u).copied().filter(|_| u < self.width).unwrap_or(f32::NAN)
    }

    /// World positions of the measurements, every `step`-th along both sides.
    pub fn points(&self, step: usize) -> impl Iterator<Item = DVec3> + '_ {
        let step = step.max(1);
        (0..self.height).step_by(step).flat_map(move |v| {
            (0..self.width).step_by(step).filter_map(move |u| {
                let range = self.range(u, v);
                let pixel = DVec2::new(u as f64, v as f64);
                (!range.is_nan()).then(|| self.pose.transform_point3(self.projection.point(pixel, f64::from(range))))
            })
        })
    }

    /// Number of measurements.
    pub fn count(&self) -> usize {
        self.ranges.iter().filter(|r| !r.is_nan()).count()
    }

    /// Mean density of its pixels over what they measured, each pixel standing for 1/density of it; `None` without any, or where rays are parallel and it says
    /// nothing.
    pub fn mean_density(&self) -> Option<f64> {
        if self.projection.is_parallel() {
            return None;
        }
        let (mut area, mut count) = (0.0, 0.0);
        for v in (0..self.height).step_by(4) {
            for u in (0..self.width).step_by(4) {
                let range = f64::from(self.range(u, v));
                if range > 0.0 {
                    let p = self.projection.point(DVec2::new(u as f64, v as f64), range);
                    area += 1.0 / self.projection.density(p, range);
                    count += 1.0;
                }
            }
        }
        (count > 0.0).then(|| count / area)
    }

    /// Standard deviation of the noise, from second differences along rows, over √6: the RMS of the smaller four fifths of them, which jumps and
    /// edges stay out of, over what that is of the normal distribution's. (Their median says nothing of depths that come in steps.)
    pub fn estimated_noise(&self) -> Option<f64> {
        /// (1 − 2zφ(z)/0.8)^½ for the z below which four fifths of |x| lie.
        const OF_NORMAL: f64 = 0.661_57;
        let mut sizes: Vec<f32> = Vec::new();
        for row in self.ranges.chunks(self.width) {
            let differences = row.windows(3).map(|r| (r[0] - 2.0 * r[1] + r[2]).abs());
            sizes.extend(differences.filter(|d| d.is_finite()));
        }
        let count = sizes.len() * 4 / 5;
        let (smaller, ..) = (count > 0).then(|| sizes.select_nth_unstable_by(count, f32::total_cmp))?;
        let mean = smaller.iter().map(|d| f64::from(*d).powi(2)).sum::<f64>() / count as f64;
        Some(mean.sqrt() / OF_NORMAL / 6f64.sqrt())
    }

    /// Low-passes the ranges with a Gaussian of so many pixels at each measurement (by its range), over valid pixels alone and not across jumps of more
    /// than `jump`.
    pub fn low_pass(&mut self, sigma: impl Fn(f64) -> f64 + Sync, jump: f64) {
        /// Pixels to either side at most: what is coarser needs a coarser map.
        const REACH: i64 = 12;
        let (width, height) = (self.width as i64, self.height as i64);
        let ranges = &self.ranges;
        let filtered = |at: usize| {
            let centre = ranges[at];
            if centre.is_nan() {
                return centre;
            }
            let sigma = sigma(f64::from(centre));
            if sigma < 0.2 {
                return centre;
            }
            let reach = ((3.0 * sigma).ceil() as i64).min(REACH);
            let along: [f64; REACH as usize + 1] = std::array::from_fn(|k| match k as i64 <= reach {
                true => (-0.5 * (k * k) as f64 / (sigma * sigma)).exp(),
                false => 0.0,
            });
            let (u, v) = (at as i64 % width, at as i64 / width);
            let (mut sum, mut weights) = (0.0, 0.0);
            for b in (v - reach).max(0)..=(v + reach).min(height - 1) {
                for a in (u - reach).max(0)..=(u + reach).min(width - 1) {
                    let difference = f64::from(ranges[(b * width + a) as usize]) - f64::from(centre);
                    if difference.abs() <= jump {
                        let weight = along[(a - u).unsigned_abs() as usize] * along[(b - v).unsigned_abs() as usize];
                        sum += weight * difference;
                        weights += weight;
                    }
                }
            }
            (f64::from(centre) + sum / weights) as f32
        };
        self.ranges = (0..ranges.len()).into_par_iter().with_min_len(256).map(filtered).collect();
    }

    /// Lowers the confidence to 0 within 1.5 pixels of jumps of more than `jump` and of pixels without a measurement.
    pub fn distrust_edges(&mut self, jump: f64) {
        const WIDTH: f64 = 1.5;
        let (width, height) = (self.width as i64, self.height as i64);
        let this = &*self;
        let trust = |at: usize| {
            let centre = f64::from(this.ranges[at]);
            if centre.is_nan() {
                return 0.0;
            }
            let (u, v) = (at as i64 % width, at as i64 / width);
            let mut nearest = WIDTH + 0.5;
            for b in -2..=2i64 {
                for a in -2..=2i64 {
                    let (x, y) = (u + a, v + b);
                    // The picture's rim is no edge.
                    if x < 0 || y < 0 || x >= width || y >= height {
                        continue;
                    }
                    let other = f64::from(this.ranges[(y * width + x) as usize]);
                    if other.is_nan() || (other - centre).abs() > jump {
                        nearest = nearest.min(((a * a + b * b) as f64).sqrt());
                    }
                }
            }
            ((nearest - 0.5) / WIDTH).clamp(0.0, 1.0)
        };
        let trusted: Vec<f64> = (0..this.ranges.len()).into_par_iter().with_min_len(256).map(trust).collect();
        for (weight, trust) in self.weights.iter_mut().zip(trusted) {
            *weight *= trust as f32;
        }
    }
}

/// A turn and a shift as a pose, refused if the quaternion is not of length 1, up to rounding in a file.
pub(super) fn rigid(turn: DQuat, shift: DVec3) -> Result<DAffine3, String> {
    let pose = DAffine3::from_rotation_translation(turn.normalize(), shift);
    match (turn.length() - 1.0).abs() < 1e-2 {
        true => check_rigid(&pose).map(|()| pose),
        false => Err(format!("its pose is not rigid: its quaternion's length is {:.4}, not 1", turn.length())),
    }
}

/// Refuses what is no rigid map of the world, up to rounding in a file, and says how it differs.
pub(super) fn check_rigid(pose: &DAffine3) -> Result<(), String> {
    const TOLERANCE: f64 = 1e-3;
    let m = pose.matrix3;
    let [x, y, z] = [m.x_axis, m.y_axis, m.z_axis].map(DVec3::length);
    let error = m.transpose() * m - DMat3::IDENTITY;
    let how = if !pose.is_finite() {
        "not all of its numbers are finite".into()
    } else if [x, y, z].iter().any(|length| (length * length - 1.0).abs() >= TOLERANCE) {
        format!("it makes lengths of 1 along x, y and z {x:.4}, {y:.4} and {z:.4}")
    } else if error.to_cols_array().iter().any(|e| e.abs() >= TOLERANCE) {
        "it shears".into()
    } else if m.determinant() < 0.0 {
        "it mirrors".into()
    } else {
        return Ok(());
    };
    Err(format!("its pose is not rigid: {how}; a rotation and a translation are wanted"))
}

/// A map of a scanner that delivers a grid of points: the quads and triangles of neighbouring points are drawn into an orthographic map, the nearest in
/// front. Neighbours farther apart than `longest` are not joined.
pub fn draw_parallel(
    points: &[Option<DVec3>],
    columns: usize,
    pitch: f64,
    longest: f64,
) -> Option<(Projection, usize, usize, Vec<f32>)> {
    let valid = || points.iter().flatten();
    let lo = valid().fold(DVec3::INFINITY, |a, p| a.min(*p));
    let hi = valid().fold(DVec3::NEG_INFINITY, |a, p| a.max(*p));
    let size = ((hi - lo).truncate() / pitch).ceil();
    if !(size.is_finite() && columns > 0 && (size + 5.0).element_product() <= MOST_PIXELS) {
        return None;
    }
    let first = lo.truncate() - 2.0 * pitch;
    let (width, height) = (size.x as usize + 5, size.y as usize + 5);
    let mut depths = vec![f32::NAN; width * height];
    let mut draw = |corners: [DVec3; 3]| {
        let [a, b, c] = corners.map(|p| ((p.truncate() - first) / pitch, p.z));
        let far = |p: DVec3, q: DVec3| p.distance(q) > longest;
        if far(corners[0], corners[1]) || far(corners[1], corners[2]) || far(corners[2], corners[0]) {
            return;
        }
        let area = (b.0 - a.0).perp_dot(c.0 - a.0);
        if area.abs() < 1e-12 {
            return;
        }
        let lo = a.0.min(b.0).min(c.0).ceil().max(DVec2::ZERO);
        let hi = a.0.max(b.0).max(c.0).floor().min(DVec2::new(width as f64 - 1.0, height as f64 - 1.0));
        for v in lo.y as usize..=hi.y as usize {
            for u in lo.x as usize..=hi.x as usize {
                let p = DVec2::new(u as f64, v as f64);
                let (s, t) = ((p - a.0).perp_dot(c.0 - a.0) / area, (b.0 - a.0).perp_dot(p - a.0) / area);
                if s >= -1e-9 && t >= -1e-9 && s + t <= 1.0 + 1e-9 {
                    let range = -(a.1 + s * (b.1 - a.1) + t * (c.1 - a.1)) as f32;
                    let depth = &mut depths[v * width + u];
                    if depth.is_nan() || range < *depth {
                        *depth = range;
                    }
                }
            }
        }
    };
    for pair in points.chunks(columns).collect::<Vec<_>>().windows(2) {
        for u in 1..pair[1].len() {
            let quad = [pair[0][u - 1], pair[0][u], pair[1][u - 1], pair[1][u]];
            match quad {
                [Some(a), Some(b), Some(c), Some(d)] => {
                    draw([a, b, c]);
                    draw([b, d, c]);
                }
                _ => {
                    if let [a, b, c] = quad.into_iter().flatten().collect::<Vec<_>>()[..] {
                        draw([a, b, c]);
                    }
                }
            }
        }
    }
    let projection = Projection::Orthographic { first, pitch: DVec2::splat(pitch) };
    Some((projection, width, height, depths))
}

/// Most pixels of a map.
pub const MOST_PIXELS: f64 = 2e8;
