//! A tile of the picture: hits, visibility, filter, colours, and more samples where the picture has an edge.
//!
//! Every pixel is computed from its own coordinates, and a tile looks at a rim of pixels around it, so the picture does not
//! depend on how it is cut into tiles or which thread takes which.

use glam::{DVec2, DVec3, DVec4, IVec3};

use super::camera::Camera;
use super::change::Changed;
use super::field::Cursor;
use super::march::{Ray, Scene, Start};
use super::occlusion::{self, FilterPoint, Light, REACH, Visibility, filter_weight};
use super::png::Image;
use super::screen::Screen;
use super::shade::{self, Lights};
use super::vertices::sequential;
use super::{ColorBy, DataRange, legend};
use crate::grid::{Accessor, Transform};
use crate::levelset::Sampler;

/// Edge of a tile in pixels. The rim costs an eighth more work.
pub(super) const TILE: u32 = 96;
/// A step of colour between neighbours that counts as an edge, linear.
const COLOR_EDGE: f64 = 0.06;
/// Cosine between the normals of neighbours below which there is an edge.
const NORMAL_EDGE: f64 = 0.96;

/// So many voxels before the nearest of its neighbours the rays of a pixel with an edge begin.
const MARGIN: f64 = 3.0;

/// All that the tiles share.
pub(super) struct Picture<'a> {
    pub scene: Option<Scene<'a>>,
    pub screen: Option<Screen>,
    pub camera: Camera,
    pub transform: Transform,
    pub lights: Lights,
    pub light: Light,
    pub color_by: &'a ColorBy<'a>,
    pub range: DataRange,
    /// Pixels from one that follows rays to the lights to the next, along either side.
    pub spacing: i64,
    /// Samples along the side of a pixel at edges.
    pub antialias: u32,
    pub width: u32,
    pub height: u32,
    /// Colour of each row, linear and as displayed; none is transparent.
    pub background: Option<Vec<[DVec3; 2]>>,
}

/// A surface point that a ray met.
#[derive(Clone, Copy, PartialEq)]
struct Hit {
    /// Index space, with the normal along index axes.
    point: FilterPoint,
    /// Edge of a pixel there, in voxels.
    footprint: f64,
    /// World space.
    normal: DVec3,
    view: DVec3,
    albedo: DVec3,
}

/// A tile as it was drawn, with all that its pixels follow from: of the window around it, nothing where it shows no surface.
#[derive(Default)]
pub(super) struct Drawn {
    /// Red, green, blue, alpha of its pixels.
    pub rgba8: Vec<u8>,
    hits: Vec<Option<Hit>>,
    /// What the pixels that follow rays have seen, and the means of that.
    raw: Vec<Visibility>,
    seen: Vec<Visibility>,
    /// Pixels that followed rays of their own.
    alone: Vec<bool>,
    /// How many pixels were drawn anew.
    pub fresh: usize,
}

impl Drawn {
    /// The memory that it takes.
    pub fn bytes(&self) -> u64 {
        let window = size_of::<Option<Hit>>() + 2 * size_of::<Visibility>() + 1;
        (self.rgba8.len() + self.hits.len() * window) as u64
    }
}

/// What was changed since the last picture, and the rectangle of pixels that may show it. Where its rays began.
pub(super) struct Change<'a> {
    pub screen: &'a Screen,
    pub changed: Changed,
    pub pixels: (DVec2, DVec2),
}

/// The tile before that.
#[derive(Clone, Copy)]
struct Before<'a> {
    tile: &'a Drawn,
    change: &'a Change<'a>,
}

/// Readers of one tile.
struct Readers<'a> {
    cursor: Cursor<'a>,
    other: Option<(Sampler<'a>, &'a Transform, f64)>,
    distances: Option<(Accessor<'a>, &'a Transform)>,
}

/// The pixels whose visibility is averaged: up to `reach` away, `spacing` apart; those `border` away count half.
struct Around {
    at: (i64, i64),
    reach: i64,
    spacing: i64,
    border: i64,
}

impl Around {
    /// How far away they are, and their indices, row by row.
    fn pixels<'a>(&'a self, window: &'a Window) -> impl Iterator<Item = ((i64, i64), usize)> + 'a {
        let &Self { at: (x, y), reach, spacing, .. } = self;
        let along = move |at: i64| (-reach + (reach - at).rem_euclid(spacing)..=reach).step_by(spacing as usize);
        along(y).flat_map(move |dy| along(x).map(move |dx| ((dx, dy), window.index(x + dx, y + dy))))
    }
}

/// What changes between a pixel and its neighbours.
#[derive(Clone, Copy, PartialEq)]
enum Edge {
    None,
    /// The orientation or the colour of one surface.
    Crease,
    /// The surface.
    Outline,
}

impl Edge {
    fn between(a: &Option<Hit>, b: &Option<Hit>) -> Self {
        match (a, b) {
            (None, None) => Self::None,
            (Some(a), Some(b)) => {
                let is_off_plane = (b.point.position - a.point.position).dot(a.point.normal).abs() > 1.5 * a.footprint;
                let is_bent = a.normal.dot(b.normal) < NORMAL_EDGE;
                match is_off_plane {
                    true => Self::Outline,
                    false if is_bent || (a.albedo - b.albedo).abs().max_element() > COLOR_EDGE => Self::Crease,
                    false => Self::None,
                }
            }
            _ => Self::Outline,
        }
    }
}

/// Pixels of a tile with its rim.
struct Window {
    x: i64,
    y: i64,
    columns: usize,
    rows: usize,
    /// Pixels around the tile.
    rim: i64,
}

impl Window {
    fn index(&self, x: i64, y: i64) -> usize {
        (y - self.y) as usize * self.columns + (x - self.x) as usize
    }

    /// The pixels within `reach` of the tile, with their indices.
    fn pixels(&self, reach: i64) -> impl Iterator<Item = (i64, i64, usize)> + '_ {
        let skip = self.rim - reach;
        let (x0, y0) = (self.x + skip, self.y + skip);
        let (x1, y1) = (self.x + self.columns as i64 - skip, self.y + self.rows as i64 - skip);
        (y0..y1).flat_map(move |y| (x0..x1).map(move |x| (x, y, self.index(x, y))))
    }
}

impl Picture<'_> {
    /// The first pixels of all tiles.
    pub fn corners(&self) -> Vec<(u32, u32)> {
        let columns = |y| (0..self.width).step_by(TILE as usize).map(move |x| (x, y));
        (0..self.height).step_by(TILE as usize).flat_map(columns).collect()
    }

    /// Pixels around a tile that it looks at: one for the search for edges, the filter's reach around that.
    fn rim(&self) -> i64 {
        REACH * self.spacing + 1
    }

    /// The picture of all tiles.
    pub fn assembled<'t>(&self, tiles: impl Iterator<Item = &'t Vec<u8>>) -> Image {
        let (width, height) = (self.width, self.height);
        let mut rgba8 = vec![0; width as usize * height as usize * 4];
        for ((x, y), tile) in self.corners().into_iter().zip(tiles) {
            let row_bytes = TILE.min(width - x) as usize * 4;
            for (row, bytes) in (y as usize..).zip(tile.chunks_exact(row_bytes)) {
                let at = (row * width as usize + x as usize) * 4;
                rgba8[at..at + row_bytes].copy_from_slice(bytes);
            }
        }
        let mut image = Image { width, height, rgba8 };
        if matches!(self.color_by, ColorBy::Distortion(_)) {
            legend::draw(&mut image, 1.0, 1.0 + self.range.0);
        }
        image
    }

    /// The tile whose first pixel is (x0, y0), row by row, cut at the picture's border. What no ray can have found changed is taken
    /// from the tile before.
    pub fn tile(&self, (x0, y0): (u32, u32), before: Option<(Drawn, &Change<'_>)>) -> Drawn {
        let (width, height) = (TILE.min(self.width - x0), TILE.min(self.height - y0));
        let Some(scene) = &self.scene else {
            let background = |y| (x0..x0 + width).flat_map(move |x| self.encode(x, y, DVec4::ZERO));
            return Drawn { rgba8: (y0..y0 + height).flat_map(background).collect(), ..Drawn::default() };
        };
        let (reach, spacing, rim) = (REACH * self.spacing, self.spacing, self.rim());
        let window = Window {
            x: i64::from(x0) - rim,
            y: i64::from(y0) - rim,
            columns: width as usize + 2 * rim as usize,
            rows: height as usize + 2 * rim as usize,
            rim,
        };
        let lit = |x: i64, y: i64| x.rem_euclid(spacing) == 0 && y.rem_euclid(spacing) == 0;
        let place = |x: i64, y: i64| (x.div_euclid(spacing), y.div_euclid(spacing));
        let point = |hit: &Hit| (hit.point.position, hit.point.normal);
        if let Some((tile, change)) = &before {
            let shown = tile.hits.iter().zip(window.pixels(rim));
            let mut shown =
                shown.filter_map(|(hit, (x, y, _))| hit.as_ref().filter(|_| lit(x, y)).map(|hit| (hit, place(x, y))));
            let is_touched = || window.pixels(rim).any(|(x, y, _)| self.is_touched(pixel(x, y) + 0.5, change));
            let meets = |(hit, at): (&Hit, _)| occlusion::meets(&self.light, point(hit), at, &change.changed);
            if !tile.alone.contains(&true) && !is_touched() && !shown.any(meets) {
                return before.map(|(tile, _)| Drawn { fresh: 0, ..tile }).unwrap_or_default();
            }
        }
        let before = before.as_ref().map(|(tile, change)| Before { tile, change });
        let mut readers = Readers {
            cursor: scene.field.cursor(),
            other: match self.color_by {
                ColorBy::Difference(other) => Some((other.sampler(), other.transform(), other.voxel_size())),
                _ => None,
            },
            distances: match self.color_by {
                ColorBy::Geodesic(field) => Some((field.accessor(), field.transform())),
                _ => None,
            },
        };
        let centre = DVec2::splat(0.5);
        let count = window.columns * window.rows;
        let mut hits: Vec<Option<Hit>> = vec![None; count];
        // Pixels whose rays could find something else; those that did, or that see something else.
        let (mut touched, mut fresh) = (vec![false; count], vec![false; count]);
        let mut find = |(x, y, i): (i64, i64, usize)| {
            let at = pixel(x, y) + centre;
            touched[i] = before.is_none_or(|before| self.is_touched(at, before.change));
            let old = || before.and_then(|before| before.tile.hits.get(i).copied().flatten());
            hits[i] = if touched[i] { self.cast(scene, &mut readers, at, None) } else { old() };
            fresh[i] = touched[i] && (before.is_none() || hits[i] != old());
        };
        window.pixels(rim).filter(|(x, y, _)| lit(*x, *y)).for_each(&mut find);
        window.pixels(1).filter(|(x, y, _)| !lit(*x, *y)).for_each(&mut find);
        let mut visibility = |hit: &Hit, (x, y): (i64, i64)| {
            occlusion::visibility(scene, &mut readers.cursor, &self.light, point(hit), place(x, y))
        };
        let mut raw = vec![Visibility::default(); count];
        for (x, y, i) in window.pixels(rim).filter(|(x, y, _)| lit(*x, *y)) {
            let Some(hit) = &hits[i] else { continue };
            let meets =
                |before: &Before| occlusion::meets(&self.light, point(hit), place(x, y), &before.change.changed);
            let old = before.filter(|before| !fresh[i] && !meets(before)).and_then(|b| b.tile.raw.get(i).copied());
            raw[i] = old.unwrap_or_else(|| visibility(hit, (x, y)));
            fresh[i] |= old.is_none() && before.is_none_or(|b| b.tile.raw.get(i) != Some(&raw[i]));
        }
        let (mut seen, mut alone) = (vec![Visibility::default(); count], vec![false; count]);
        let mut seen_anew = vec![false; count];
        for (x, y, i) in window.pixels(1) {
            let Some(hit) = &hits[i] else { continue };
            let around = Around { at: (x, y), reach, spacing, border: reach };
            alone[i] = before.is_some_and(|before| before.tile.alone.get(i) == Some(&true));
            let same = !fresh[i] && !alone[i] && !around.pixels(&window).any(|(_, at)| fresh[at]);
            let old = before.filter(|_| same).and_then(|before| before.tile.seen.get(i).copied());
            seen[i] = old.unwrap_or_else(|| {
                let mean = self.mean(&window, &hits, &raw, hit, &around);
                alone[i] = mean.is_none();
                // Parts too thin for any of the pixels that follow rays.
                mean.unwrap_or_else(|| visibility(hit, (x, y)))
            });
            seen_anew[i] = old.is_none();
        }
        let mut rgba8 = Vec::with_capacity((width * height * 4) as usize);
        let mut drawn = 0;
        for (n, (x, y, i)) in window.pixels(0).enumerate() {
            let beside = || (0..9).map(|k| window.index(x + k % 3 - 1, y + k / 3 - 1));
            let same = !touched[i] && !alone[i] && !beside().any(|at| fresh[at] || seen_anew[at]);
            let old = before.filter(|_| same).and_then(|before| before.tile.rgba8.get(n * 4..n * 4 + 4));
            if let Some(old) = old {
                rgba8.extend_from_slice(old);
                continue;
            }
            drawn += 1;
            let samples = match self.edge(&window, &hits, (x, y)) {
                Edge::None => 1,
                // Both sides of a crease are there; the outline is finer than that.
                Edge::Crease => self.antialias.div_ceil(2),
                Edge::Outline => self.antialias,
            };
            let color = match samples {
                1 => hits[i].map_or(DVec4::ZERO, |hit| self.color(&hit, seen[i]).extend(1.0)),
                n => {
                    let shown = (&window, &hits[..], &seen[..]);
                    let (color, own) = self.supersample(scene, &mut readers, shown, (x, y), n);
                    alone[i] |= own;
                    color
                }
            };
            rgba8.extend(self.encode(x as u32, y as u32, color));
        }
        if hits.iter().all(Option::is_none) && !alone.contains(&true) {
            return Drawn { rgba8, fresh: drawn, ..Drawn::default() };
        }
        Drawn { rgba8, hits, raw, seen, alone, fresh: drawn }
    }

    /// The rectangle of pixels that may show something in a box.
    pub fn pixels_of(&self, (lo, hi): (DVec3, DVec3)) -> (DVec2, DVec2) {
        let corner = |c: i32| lo + (hi - lo) * IVec3::new(c >> 2, c >> 1 & 1, c & 1).as_dvec3();
        let pixels = (0..8).map(|c| self.camera.pixel_of(self.transform.index_to_world(corner(c))));
        let around = |(a, b): (DVec2, DVec2), at: DVec2| (a.min(at), b.max(at));
        let all = pixels.collect::<Option<Vec<DVec2>>>();
        // Beside or behind the eye: anywhere.
        all.map_or((DVec2::NEG_INFINITY, DVec2::INFINITY), |all| {
            let (lo, hi) = all.into_iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), around);
            (lo - 2.0, hi + 2.0)
        })
    }

    /// Whether a ray through the pixel around a point can find something else than before: it passes what was changed, or begins elsewhere.
    fn is_touched(&self, at: DVec2, change: &Change<'_>) -> bool {
        let begin = |screen: &Screen| screen.start(at);
        let (first, last) = change.pixels;
        if self.screen.as_ref().map(begin) != Some(begin(change.screen)) {
            return true;
        }
        if !(at.cmpge(first).all() && at.cmple(last).all()) {
            return false;
        }
        change.changed.is_met(&self.ray(at), f64::INFINITY)
    }

    /// Edge of a pixel (voxels) where a box is farthest.
    pub fn widest(&self, (lo, hi): (DVec3, DVec3)) -> f64 {
        let eye = self.transform.world_to_index(self.camera.eye);
        (eye.distance((lo + hi) / 2.0) + (hi - lo).length()) * self.camera.pixel()
    }

    /// The ray through a point of the picture, in index space.
    fn ray(&self, at: DVec2) -> Ray {
        let to_index = self.transform.to_index();
        // Unit in index space: voxels are cubes, so lengths are only scaled.
        Ray::new(
            to_index.transform_point3(self.camera.eye),
            to_index.transform_vector3(self.camera.direction(at.x, at.y)) * self.transform.voxel_size(),
        )
    }

    /// What a ray through a point of the picture meets; it begins `near` the surface if that is outside.
    fn cast(&self, scene: &Scene<'_>, readers: &mut Readers<'_>, at: DVec2, near: Option<f64>) -> Option<Hit> {
        let mut start = self.screen.as_ref().map_or(0.0, |screen| screen.start(at));
        if start.is_infinite() {
            return None;
        }
        let direction = self.camera.direction(at.x, at.y);
        let ray = self.ray(at);
        if let Some(near) = near
            && near > start
            && scene.is_outside(&mut readers.cursor, ray.at(near))
        {
            start = near;
        }
        let t = start + scene.hit(&mut readers.cursor, &ray.after(start), Start::Outside, f64::INFINITY)?;
        let position = ray.at(t);
        let jet = readers.cursor.jet(position);
        let normal = jet.gradient.normalize_or(-ray.direction);
        let world_normal = self.transform.direction_to_world(normal);
        let xyz = || self.transform.index_to_world(position);
        let albedo = match self.color_by {
            ColorBy::Clay => shade::CLAY * shade::patina(jet.mean_curvature()),
            ColorBy::Normal => shade::to_linear(world_normal * 0.5 + 0.5),
            ColorBy::Curvature => shade::diverging(jet.mean_curvature() / self.range.0),
            ColorBy::Difference(_) => readers.other.as_mut().map_or(shade::CLAY, |(sampler, transform, voxel)| {
                let phi = f64::from(sampler.trilinear(transform.world_to_index(xyz())));
                shade::diverging(phi / *voxel / self.range.0)
            }),
            ColorBy::Geodesic(_) => {
                let distance = readers.distances.as_mut().and_then(|(accessor, transform)| {
                    crate::levelset::Field::trilinear(accessor, transform.world_to_index(xyz()))
                });
                distance.map_or(shade::CLAY, |distance| sequential(f64::from(distance) / self.range.0))
            }
            ColorBy::Region(region) => REGION_OFF.lerp(REGION_ON, f64::from(region.weight(xyz())).clamp(0.0, 1.0)),
            ColorBy::Label(label) => label(xyz()).map_or(shade::CLAY, shade::label),
            ColorBy::Patches(patches) => patches.color(xyz(), None).unwrap_or(shade::CLAY),
            ColorBy::Distortion(patches) => patches.color(xyz(), Some(self.range.0)).unwrap_or(shade::CLAY),
        };
        Some(Hit {
            point: FilterPoint { position, normal },
            footprint: t * self.camera.pixel(),
            normal: world_normal,
            view: -direction,
            albedo,
        })
    }

    /// Mean visibility around a pixel over the surface that `hit` is on; `None` if no pixel shows it.
    fn mean(
        &self,
        window: &Window,
        hits: &[Option<Hit>],
        values: &[Visibility],
        hit: &Hit,
        around: &Around,
    ) -> Option<Visibility> {
        let (mut sum, mut sky, mut key) = (0.0, 0.0, 0.0);
        for ((dx, dy), at) in around.pixels(window) {
            if let Some(other) = &hits[at] {
                let distance = hit.footprint * (dx.abs().max(dy.abs()) + 1) as f64;
                let weight = filter_weight(dx, around.border)
                    * filter_weight(dy, around.border)
                    * hit.point.affinity(&other.point, distance);
                sum += weight;
                sky += weight * values[at].sky;
                key += weight * values[at].key;
            }
        }
        (sum > 0.05).then(|| Visibility { sky: sky / sum, key: key / sum })
    }

    /// Whether a pixel and its neighbours show different surfaces, orientations or colours.
    fn edge(&self, window: &Window, hits: &[Option<Hit>], (x, y): (i64, i64)) -> Edge {
        if self.antialias == 1 {
            return Edge::None;
        }
        let centre = &hits[window.index(x, y)];
        let mut edge = Edge::None;
        for (dx, dy) in (0..9).map(|k| (k % 3 - 1, k / 3 - 1)) {
            match Edge::between(centre, &hits[window.index(x + dx, y + dy)]) {
                Edge::None => {}
                Edge::Crease => edge = Edge::Crease,
                Edge::Outline => return Edge::Outline,
            }
        }
        edge
    }

    /// The mean of a grid of samples over a pixel, premultiplied, and whether one of them had to follow rays of its own.
    fn supersample(
        &self,
        scene: &Scene<'_>,
        readers: &mut Readers<'_>,
        (window, hits, seen): (&Window, &[Option<Hit>], &[Visibility]),
        (x, y): (i64, i64),
        n: u32,
    ) -> (DVec4, bool) {
        let (mut sum, mut alone) = (DVec4::ZERO, false);
        // What is nearer than any neighbour would be thinner than a pixel, and no voxel is.
        let beside = (0..9).filter_map(|k| hits[window.index(x + k % 3 - 1, y + k / 3 - 1)].as_ref());
        let (near, least) = beside.fold((f64::INFINITY, f64::INFINITY), |(near, least), hit| {
            (near.min(hit.footprint / self.camera.pixel()), least.min(hit.footprint))
        });
        let near = (least < 1.0).then_some(near - MARGIN);
        let centre = &hits[window.index(x, y)];
        // The corners of the grid first: where they and the centre show one surface, they are enough.
        let is_corner = |k: u32| [k % n, k / n].iter().all(|at| *at == 0 || *at == n - 1);
        let (corners, others): (Vec<u32>, Vec<u32>) = (0..n * n).partition(|k| is_corner(*k));
        let mut has_outline = false;
        let mut count = 0;
        for samples in [corners, others] {
            if count > 0 && !has_outline {
                break;
            }
            count += samples.len();
            for k in samples {
                // Rows and columns sheared against each other, so that upright and level edges get n² steps, not n.
                let (i, j) = (f64::from(k % n), f64::from(k / n));
                let side = f64::from(n);
                let offset = DVec2::new(i + (j + 0.5) / side, j + (i + 0.5) / side) / side;
                let hit = self.cast(scene, readers, pixel(x, y) + offset, near);
                has_outline |= Edge::between(centre, &hit) == Edge::Outline;
                let Some(hit) = hit else { continue };
                let beside = Around { at: (x, y), reach: 1, spacing: 1, border: 2 };
                let visibility = self.mean(window, hits, seen, &hit, &beside).unwrap_or_else(|| {
                    alone = true;
                    // A part too thin for any pixel's centre.
                    let at = (hit.point.position, hit.point.normal);
                    occlusion::visibility(scene, &mut readers.cursor, &self.light, at, (x + i64::from(k), y))
                });
                sum += self.color(&hit, visibility).extend(1.0);
            }
        }
        (sum / count as f64, alone)
    }

    /// Displayed colour of a surface point, linear.
    fn color(&self, hit: &Hit, seen: Visibility) -> DVec3 {
        match self.color_by {
            ColorBy::Clay => shade::filmic(shade::clay(&self.lights, hit.albedo, hit.normal, hit.view, seen)),
            ColorBy::Normal => hit.albedo * (0.4 + 0.6 * seen.sky),
            _ => shade::data(&self.lights, hit.albedo, hit.normal, hit.view, seen).min(DVec3::ONE),
        }
    }

    /// A pixel from its premultiplied linear colour, over the background.
    fn encode(&self, x: u32, y: u32, color: DVec4) -> [u8; 4] {
        let alpha = color.w.clamp(0.0, 1.0);
        let dither = shade::dither(x, y);
        match self.background.as_ref().map(|rows| rows[y as usize]) {
            Some([behind, shown]) => {
                let shown =
                    if alpha == 0.0 { shown } else { shade::display(color.truncate() + behind * (1.0 - alpha)) };
                let [r, g, b] = shade::quantize(shown, dither);
                [r, g, b, u8::MAX]
            }
            None if alpha == 0.0 => [0; 4],
            None => {
                let [r, g, b] = shade::quantize(shade::display(color.truncate() / alpha), dither);
                [r, g, b, (alpha * 255.0).round() as u8]
            }
        }
    }
}

/// Colours of a region's weight 0 and 1.
const REGION_OFF: DVec3 = DVec3::new(0.62, 0.62, 0.62);
const REGION_ON: DVec3 = DVec3::new(0.95, 0.33, 0.05);

fn pixel(x: i64, y: i64) -> DVec2 {
    DVec2::new(x as f64, y as f64)
}
