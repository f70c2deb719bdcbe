//! What is said of patches, and their particles as a file.

use std::fmt::Write as _;

use serde_json::json;

use crate::ops::registry::Summary;
use crate::render::PROPERTIES;
use crate::texture::{Distortion, Particles};

/// What the maps of all patches are like.
pub(super) struct PatchReport {
    distortions: Vec<Distortion>,
    pub kernels: Option<[u64; 2]>,
}

impl Default for PatchReport {
    fn default() -> Self {
        Self { distortions: Vec::new(), kernels: Some([0; 2]) }
    }
}

impl PatchReport {
    pub fn add(&mut self, distortion: &Distortion) {
        self.distortions.push(*distortion);
    }

    pub fn tell(&self, summary: &mut Summary, is_implicit: bool) {
        let sum = |of: fn(&Distortion) -> usize| self.distortions.iter().map(of).sum::<usize>();
        let (folded, overlapping, cells) = (sum(|d| d.folded), sum(|d| d.overlapping), sum(|d| d.cells));
        for (count, what) in [(folded, "fold over"), (overlapping, "lie in each other")] {
            if count > 0 {
                summary.warnings.push(format!(
                    "{count} of the {cells} cells above the patches {what}: the texture is torn or meets itself there; take a smaller height or patch, or the parameterization low-distortion or spline"
                ));
            }
        }
        let details = &mut summary.details;
        details.insert("patches".into(), self.distortions.len().into());
        details.insert("folded_cells".into(), folded.into());
        details.insert("overlapping_cells".into(), overlapping.into());
        if let (true, Some([near, everywhere])) = (is_implicit, self.kernels) {
            details.insert("kernel_evaluations".into(), near.into());
            details.insert("kernel_evaluations_everywhere".into(), everywhere.into());
        }
        details.insert("distortion".into(), json!(self.distortions));
    }
}

/// Particles as a PLY in text, with the cells and edges of their nets.
pub(super) fn write_particles(out: &mut dyn std::io::Write, particles: &Particles) -> std::io::Result<()> {
    let mut text = String::from("ply\nformat ascii 1.0\n");
    let _ = writeln!(text, "element vertex {}", particles.places.len());
    for name in PROPERTIES {
        let _ = writeln!(text, "property float {name}");
    }
    let _ = writeln!(text, "element face {}", particles.faces.len());
    text += "property list uchar int vertex_indices\n";
    let _ = writeln!(text, "element edge {}", particles.edges.len());
    text += "property int vertex1\nproperty int vertex2\nend_header\n";
    for ((p, uvw), distortion) in particles.places.iter().zip(&particles.distortion) {
        let numbers = p.to_array().into_iter().chain(uvw.to_array()).chain(*distortion);
        let words: Vec<String> = numbers.map(|v| (v as f32).min(f32::MAX).to_string()).collect();
        let _ = writeln!(text, "{}", words.join(" "));
    }
    for [a, b, c, d] in &particles.faces {
        let _ = writeln!(text, "4 {a} {b} {c} {d}");
    }
    for [a, b] in &particles.edges {
        let _ = writeln!(text, "{a} {b}");
    }
    out.write_all(text.as_bytes())
}
