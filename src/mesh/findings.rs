//! What was found in a mesh, and what was done about it.

use super::Topology;

/// The record of a mesh on its way to a level set: its state as it came, what was repaired, and what the repair cost.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshFindings {
    /// The surface after its equal vertices were joined, before anything else was done.
    pub found: Topology,
    /// The surface that was converted.
    pub converted: Topology,
    /// Vertices joined because they were equal. Ordinary: STL files store every corner by itself.
    pub welded_equal: usize,
    /// Vertices on open edges joined because they were nearly equal.
    pub welded_near: usize,
    /// Triangles without area, left out.
    pub degenerate_dropped: usize,
    /// Triangles stored more than once, left out but for one.
    pub duplicates_dropped: usize,
    /// Triangles left out because they lay back to back with another: they bound nothing.
    pub cancelled: usize,
    /// Triangles turned over to agree with their neighbours.
    pub reoriented: usize,
    /// Closed parts that faced inwards and were turned over.
    pub flipped_parts: usize,
    /// Whether the mesh as a whole faced inwards and was turned over.
    pub inside_out: bool,
    /// Closed parts that face inwards within another part: cavities, kept.
    pub cavities: usize,
    /// Whether parts of the surface lie inside of others or pass through them (interior walls were removed).
    pub self_intersecting: bool,
    /// Fraction of the area that was inside or had no inside, and was removed.
    pub removed_area_fraction: f64,
    /// Triangles added where the surface was open, on the ½ level of the winding number.
    pub closure_triangles: usize,
}

impl MeshFindings {
    /// Whether the mesh was a closed, consistently oriented surface that does not pass through itself. Equal vertices,
    /// duplicates and triangles without area do not count against it.
    pub fn is_sound(&self) -> bool {
        self.converted.closed
            && self.found.misoriented_edges == 0
            && !self.inside_out
            && !self.self_intersecting
            && self.flipped_parts + self.welded_near == 0
    }

    /// One sentence for each thing that a user should know, the gravest first. Empty for a sound mesh.
    pub fn warnings(&self) -> Vec<String> {
        let mut out = Vec::new();
        let converted = &self.converted;
        let mut say = |condition: bool, sentence: String| {
            if condition {
                out.push(sentence);
            }
        };
        let closing = match self.closure_triangles {
            0 => "the other parts cover its openings".into(),
            n => format!("closed by {n} triangles where its winding number is 1/2"),
        };
        say(
            converted.boundary_edges > 0,
            format!(
                "the mesh is open ({} boundary edges): {closing}; close it in a modelling tool if that is not what is meant (`strict` refuses it)",
                converted.boundary_edges
            ),
        );
        say(
            converted.boundary_edges == 0 && self.closure_triangles > 0,
            format!(
                "the mesh does not bound a volume everywhere: {} closing triangles were added",
                self.closure_triangles
            ),
        );
        say(
            converted.non_manifold_edges > 0,
            format!("{} edges have more than two triangles", converted.non_manifold_edges),
        );
        say(
            converted.misoriented_edges > 0,
            format!("{} edges have triangles that cannot be oriented alike", converted.misoriented_edges),
        );
        say(
            self.self_intersecting,
            format!(
                "parts of the surface overlap or pass through each other: their union was taken ({:.2} % of the area lay inside and was removed)",
                100.0 * self.removed_area_fraction
            ),
        );
        say(
            !self.self_intersecting && self.removed_area_fraction > 0.0,
            format!(
                "{:.2} % of the area separates no inside from an outside and was removed",
                100.0 * self.removed_area_fraction
            ),
        );
        say(self.inside_out, "the mesh was inside out: turned over".into());
        say(
            self.reoriented > 0,
            format!("{} triangles disagreed with their neighbours on the outside: turned over", self.reoriented),
        );
        say(self.flipped_parts > 0, format!("{} closed parts faced inwards: turned over", self.flipped_parts));
        say(
            self.welded_near > 0,
            format!("{} vertices on cracks differed from their neighbours by rounding: joined", self.welded_near),
        );
        say(self.cancelled > 0, format!("{} triangles lay back to back with another: removed", self.cancelled));
        say(self.duplicates_dropped > 0, format!("{} triangles were stored twice: dropped", self.duplicates_dropped));
        say(self.degenerate_dropped > 0, format!("{} triangles had no area: dropped", self.degenerate_dropped));
        out
    }
}
