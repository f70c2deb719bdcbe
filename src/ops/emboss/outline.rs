//! Flat outlines: letters of a font and drawings in SVG, and the signed distance to them.

use std::path::Path;

use glam::{DVec2, DVec3};
use kurbo::{Affine, BezPath, PathEl, Shape as _, Stroke, StrokeOpts};
use ttf_parser::{Face, GlyphId, OutlineBuilder};
use usvg::tiny_skia_path::PathSegment;

use crate::error::{EditError, Result};
use crate::mesh::Bvh;

/// Most segments of an outline: more are finer than any surface.
const MOST_SEGMENTS: usize = 2_000_000;

/// Which points a closed path encloses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fill {
    NonZero,
    EvenOdd,
}

/// Curves with what they fill, y upwards, in units of the file.
#[derive(Clone, Debug)]
pub(super) struct Drawing {
    paths: Vec<(BezPath, Fill)>,
}

impl Drawing {
    /// The filled paths of an SVG file, and its strokes as wide as they are drawn. Colours do not matter; letters that are not paths
    /// are not read.
    pub fn of_svg(path: &Path) -> Result<Self> {
        let refuse = |problem: String| EditError::input(path, problem);
        let data = std::fs::read(path).map_err(|e| refuse(format!("cannot be read: {e}")))?;
        let tree = usvg::Tree::from_data(&data, &usvg::Options::default())
            .map_err(|e| refuse(format!("is no SVG drawing that can be read: {e}")))?;
        let mut drawing = Self { paths: Vec::new() };
        drawing.add_group(tree.root());
        match drawing.bounds() {
            Some(_) => Ok(drawing),
            None => {
                Err(refuse("there is no filled or stroked path in it; letters have to be converted to paths".into()))
            }
        }
    }

    fn add_group(&mut self, group: &usvg::Group) {
        for node in group.children() {
            match node {
                usvg::Node::Group(group) => self.add_group(group),
                usvg::Node::Path(path) if path.is_visible() => {
                    let t = path.abs_transform();
                    // The page's y runs downwards.
                    let place = Affine::FLIP_Y * Affine::new([t.sx, t.ky, t.kx, t.sy, t.tx, t.ty].map(f64::from));
                    let curve = path_of(path.data().segments());
                    if let Some(fill) = path.fill() {
                        let rule = match fill.rule() {
                            usvg::FillRule::NonZero => Fill::NonZero,
                            usvg::FillRule::EvenOdd => Fill::EvenOdd,
                        };
                        self.paths.push((place * curve.clone(), rule));
                    }
                    if let Some(stroke) = path.stroke() {
                        let width = f64::from(stroke.width().get());
                        let style = Stroke::new(width);
                        let outline = kurbo::stroke(curve, &style, &StrokeOpts::default(), width / 100.0);
                        self.paths.push((place * outline, Fill::NonZero));
                    }
                }
                _ => {}
            }
        }
    }

    /// Text in a font, lines centred below each other. A character that the font does not have is refused.
    pub fn of_text(text: &str, font: &Path) -> Result<Self> {
        let refuse = |problem: String| EditError::input(font, problem);
        let data = std::fs::read(font).map_err(|e| refuse(format!("cannot be read: {e}")))?;
        let face = Face::parse(&data, 0).map_err(|e| refuse(format!("is no TrueType or OpenType font: {e}")))?;
        let line_height = f64::from(face.ascender()) - f64::from(face.descender()) + f64::from(face.line_gap());
        let mut drawing = Self { paths: Vec::new() };
        for (row, line) in text.lines().enumerate() {
            let mut glyphs: Vec<(BezPath, f64)> = Vec::new();
            let (mut pen, mut before) = (0.0, None);
            for character in line.chars() {
                let character = if character == '\t' { ' ' } else { character };
                let glyph = face.glyph_index(character).ok_or_else(|| {
                    refuse(format!("has no glyph for `{character}` (U+{:04X})", u32::from(character)))
                })?;
                pen += before.map_or(0.0, |before| kerning(&face, before, glyph));
                let mut outline = GlyphPath(BezPath::new());
                if face.outline_glyph(glyph, &mut outline).is_some() {
                    glyphs.push((outline.0, pen));
                }
                pen += f64::from(face.glyph_hor_advance(glyph).unwrap_or(0));
                before = Some(glyph);
            }
            let down = row as f64 * line_height;
            drawing.paths.extend(
                glyphs.into_iter().map(|(path, x)| (Affine::translate((x - pen / 2.0, -down)) * path, Fill::NonZero)),
            );
        }
        match drawing.bounds() {
            Some(_) => Ok(drawing),
            None => Err(EditError::parameter("emboss", "text", text, "text with at least one visible character")),
        }
    }

    /// Box around the curves; `None` if they have no extent.
    fn bounds(&self) -> Option<kurbo::Rect> {
        let boxes = self.paths.iter().filter(|(path, _)| !path.is_empty()).map(|(path, _)| path.bounding_box());
        let all = boxes.reduce(|a, b| a.union(b))?;
        (all.width() > 0.0 && all.height() > 0.0 && all.is_finite()).then_some(all)
    }

    /// Height over width.
    pub fn aspect(&self) -> f64 {
        self.bounds().map_or(1.0, |b| b.height() / b.width())
    }

    /// The curves `width` wide around the origin, as polygons within `tolerance`.
    fn flattened(&self, width: f64, tolerance: f64) -> Vec<(Vec<Vec<DVec2>>, Fill)> {
        let Some(bounds) = self.bounds() else { return Vec::new() };
        let scale = width / bounds.width();
        let place = Affine::scale(scale) * Affine::translate(-bounds.center().to_vec2());
        let polygons = |path: &BezPath| {
            let mut polygons: Vec<Vec<DVec2>> = Vec::new();
            kurbo::flatten(place * path.clone(), tolerance, |element| match element {
                PathEl::MoveTo(p) => polygons.push(vec![DVec2::new(p.x, p.y)]),
                PathEl::LineTo(p) => {
                    if let Some(polygon) = polygons.last_mut() {
                        polygon.push(DVec2::new(p.x, p.y));
                    }
                }
                PathEl::ClosePath => {
                    if let Some(polygon) = polygons.last_mut() {
                        polygon.extend(polygon.first().copied());
                    }
                }
                PathEl::QuadTo(..) | PathEl::CurveTo(..) => {}
            });
            polygons
        };
        self.paths.iter().map(|(path, fill)| (polygons(path), *fill)).collect()
    }

    /// The curves `width` wide around the origin as polylines.
    pub fn polylines(&self, width: f64, tolerance: f64) -> Vec<Vec<DVec2>> {
        self.flattened(width, tolerance).into_iter().flat_map(|(polygons, _)| polygons).collect()
    }

    /// What the curves fill, `width` wide around the origin, as polygons within `tolerance`.
    pub fn outline(&self, width: f64, tolerance: f64) -> Result<Outline> {
        let paths = self.flattened(width, tolerance);
        let mut segments = Vec::new();
        for (path, (polygons, fill)) in (0..).zip(&paths) {
            for polygon in polygons {
                // Open contours are filled as if they were closed.
                let ends = polygon.iter().zip(polygon.iter().skip(1).chain(polygon.first()));
                segments.extend(ends.filter(|(a, b)| a != b).map(|(&a, &b)| Segment { a, b, path, fill: *fill }));
            }
        }
        if segments.len() > MOST_SEGMENTS {
            let accepted = format!("a drawing of at most {MOST_SEGMENTS} straight pieces at this size");
            return Err(EditError::parameter("emboss", "svg", segments.len(), accepted));
        }
        Ok(Outline::new(segments))
    }
}

fn path_of(segments: impl Iterator<Item = PathSegment>) -> BezPath {
    let point = |p: usvg::tiny_skia_path::Point| (f64::from(p.x), f64::from(p.y));
    let mut path = BezPath::new();
    for segment in segments {
        match segment {
            PathSegment::MoveTo(p) => path.move_to(point(p)),
            PathSegment::LineTo(p) => path.line_to(point(p)),
            PathSegment::QuadTo(a, p) => path.quad_to(point(a), point(p)),
            PathSegment::CubicTo(a, b, p) => path.curve_to(point(a), point(b), point(p)),
            PathSegment::Close => path.close_path(),
        }
    }
    path
}

/// What two glyphs beside each other are to be moved by.
fn kerning(face: &Face, left: GlyphId, right: GlyphId) -> f64 {
    let Some(kern) = face.tables().kern else { return 0.0 };
    let tables = kern.subtables.into_iter().filter(|table| table.horizontal && !table.variable);
    tables.filter_map(|table| table.glyphs_kerning(left, right)).map(f64::from).sum()
}

struct GlyphPath(BezPath);

impl OutlineBuilder for GlyphPath {
    fn move_to(&mut self, x: f32, y: f32) {
        self.0.move_to((f64::from(x), f64::from(y)));
    }

    fn line_to(&mut self, x: f32, y: f32) {
        self.0.line_to((f64::from(x), f64::from(y)));
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        self.0.quad_to((f64::from(x1), f64::from(y1)), (f64::from(x), f64::from(y)));
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        let (a, b) = ((f64::from(x1), f64::from(y1)), (f64::from(x2), f64::from(y2)));
        self.0.curve_to(a, b, (f64::from(x), f64::from(y)));
    }

    fn close(&mut self) {
        self.0.close_path();
    }
}

#[derive(Clone, Copy)]
struct Segment {
    a: DVec2,
    b: DVec2,
    path: u32,
    fill: Fill,
}

/// What a drawing fills: signed distances, negative inside.
pub(super) struct Outline {
    tree: Bvh,
    /// The segments that cross each of equally high rows.
    rows: Vec<Vec<Segment>>,
    bottom: f64,
    rows_per_unit: f64,
}

impl Outline {
    fn new(segments: Vec<Segment>) -> Self {
        let ys = || segments.iter().flat_map(|s| [s.a.y, s.b.y]);
        let (bottom, top) = ys().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), y| (lo.min(y), hi.max(y)));
        let count = segments.len().clamp(1, 4096);
        let rows_per_unit = if top > bottom { count as f64 / (top - bottom) } else { 0.0 };
        let row = |y: f64| (((y - bottom) * rows_per_unit) as usize).min(count - 1);
        let mut rows = vec![Vec::new(); count];
        for segment in &segments {
            let (lo, hi) = (row(segment.a.y.min(segment.b.y)), row(segment.a.y.max(segment.b.y)));
            rows[lo..=hi].iter_mut().for_each(|list| list.push(*segment));
        }
        // A segment is a triangle without area.
        let flat = |p: DVec2| p.extend(0.0);
        let tree = Bvh::new(segments.iter().map(|s| [flat(s.a), flat(s.b), flat(s.b)]).collect());
        Self { tree, rows, bottom, rows_per_unit }
    }

    /// Signed distance from `p`.
    pub fn distance(&self, p: DVec2) -> f64 {
        let hit = self.tree.closest_point(DVec3::new(p.x, p.y, 0.0), f64::INFINITY);
        let distance = hit.map_or(f64::INFINITY, |hit| hit.distance_squared.sqrt());
        if self.contains(p) { -distance } else { distance }
    }

    /// Whether any path fills `p`: crossings of the ray to the right, path by path.
    fn contains(&self, p: DVec2) -> bool {
        let row = (p.y - self.bottom) * self.rows_per_unit;
        let Some(row) = (row >= 0.0).then(|| self.rows.get(row as usize)).flatten() else { return false };
        // The segments of a path follow each other.
        row.chunk_by(|s, t| s.path == t.path).any(|path| {
            let crossed = path
                .iter()
                .filter(|s| (s.a.y <= p.y) != (s.b.y <= p.y))
                .filter(|s| s.a.x + (s.b.x - s.a.x) * ((p.y - s.a.y) / (s.b.y - s.a.y)) > p.x);
            let winding: i64 = crossed.map(|s| if s.b.y > s.a.y { 1 } else { -1 }).sum();
            match path[0].fill {
                Fill::NonZero => winding != 0,
                Fill::EvenOdd => winding % 2 != 0,
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(half: f64) -> BezPath {
        kurbo::Rect::new(-half, -half, half, half).to_path(0.1)
    }

    fn svg(text: &str) -> Result<Drawing> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("drawing.svg");
        std::fs::write(&path, text).unwrap();
        Drawing::of_svg(&path)
    }

    #[test]
    fn distances_to_a_square_ring_are_exact() {
        let mut ring = square(2.0);
        ring.extend(square(1.0).iter());
        for (fill, hole) in [(Fill::EvenOdd, 1.0), (Fill::NonZero, -1.0)] {
            let outline = Drawing { paths: vec![(ring.clone(), fill)] }.outline(4.0, 0.01).unwrap();
            for (p, expected) in
                [([0.0, 0.0], hole), ([1.5, 0.0], -0.5), ([3.0, 0.0], 1.0), ([5.0, 6.0], 5.0), ([0.5, -1.25], -0.25)]
            {
                let got = outline.distance(DVec2::from(p));
                assert!((got - expected).abs() < 1e-12, "{p:?} {got}");
            }
        }
    }

    #[test]
    fn drawings_are_scaled_and_stand_upright() {
        // A triangle with its tip upwards on the page, where y runs down; and a stroke.
        let drawing = svg(
            r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 40 20"><path d="M0 20 L40 20 L20 0 Z"/></svg>"#,
        )
        .unwrap();
        assert!((drawing.aspect() - 0.5).abs() < 1e-9);
        let outline = drawing.outline(8.0, 0.01).unwrap();
        assert!(outline.distance(DVec2::new(0.0, 1.5)) < 0.0 && outline.distance(DVec2::new(3.0, 1.5)) > 0.0);
        let stroke = svg(r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 40 20"><path d="M0 10 L40 10" stroke="black" stroke-width="4" fill="none"/></svg>"#).unwrap();
        assert!((stroke.aspect() - 0.1).abs() < 1e-9);
        assert!((stroke.outline(40.0, 0.01).unwrap().distance(DVec2::ZERO) + 2.0).abs() < 1e-6);
    }

    #[test]
    fn what_is_no_drawing_is_refused() {
        for text in [
            "",
            "<svg",
            "<svg xmlns='http://www.w3.org/2000/svg'/>",
            "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 1 1'><text>a</text></svg>",
        ] {
            assert_eq!(svg(text).unwrap_err().exit_code(), 3, "{text}");
        }
        assert_eq!(Drawing::of_svg(Path::new("absent.svg")).unwrap_err().exit_code(), 3);
        assert_eq!(Drawing::of_text("a", Path::new("absent.ttf")).unwrap_err().exit_code(), 3);
    }
}
