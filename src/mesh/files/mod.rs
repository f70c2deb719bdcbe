//! Mesh files, chosen by their extension.
//!
//! | extension | read | written |
//! |---|---|---|
//! | `.obj` | polygons, negative indices, vertex colours, texture coordinates | text, shortest exact numbers |
//! | `.ply` | text and binary of both byte orders, triangle strips | binary little endian |
//! | `.stl` | text and binary; equal vertices are welded | binary |
//! | `.glb`, `.gltf` | the default scene with its transforms | with normals |
//! | `.off` | OFF, COFF, NOFF, STOFF as text | text |

mod build;
mod color;
mod gltf;
mod gltf_write;
mod obj;
mod off;
mod ply;
mod polygon;
mod stl;
mod text;

pub(crate) use color::linear_from_srgb8;
use std::ffi::OsStr;
use std::fmt;
use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;

use super::{QuadMesh, TriangleMesh};
use crate::atomic::write_atomically;
use crate::{EditError, Result};

/// A mesh as it stood in a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadMesh {
    /// The mesh; its triangles are valid and its positions finite, nothing else is promised.
    pub mesh: TriangleMesh,
    /// What was odd about the file and what was done about it, one sentence each.
    pub warnings: Vec<String>,
}

/// The file formats for meshes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum MeshFormat {
    /// Wavefront OBJ.
    Obj,
    /// Stanford PLY.
    Ply,
    /// Stereolithography.
    Stl,
    /// glTF 2.0 in one binary file.
    Glb,
    /// glTF 2.0 as JSON; written with its data inside.
    Gltf,
    /// Geomview's object file format.
    Off,
}

impl MeshFormat {
    /// Every format.
    pub const ALL: [Self; 6] = [Self::Obj, Self::Ply, Self::Stl, Self::Glb, Self::Gltf, Self::Off];

    /// The extension, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Obj => "obj",
            Self::Ply => "ply",
            Self::Stl => "stl",
            Self::Glb => "glb",
            Self::Gltf => "gltf",
            Self::Off => "off",
        }
    }

    /// Whether faces may have four corners and more.
    pub fn has_polygons(self) -> bool {
        matches!(self, Self::Obj | Self::Ply | Self::Off)
    }

    /// Whether vertices may have colours and texture coordinates.
    pub fn has_attributes(self) -> bool {
        self != Self::Stl
    }

    /// The format of a path by its extension, in upper or lower case.
    pub fn of(path: &Path) -> Option<Self> {
        let extension = path.extension().and_then(OsStr::to_str)?;
        Self::ALL.into_iter().find(|format| format.extension().eq_ignore_ascii_case(extension))
    }
}

impl fmt::Display for MeshFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, ".{}", self.extension())
    }
}

/// Reads a mesh file.
///
/// Refused with [`EditError::Input`]: unknown extensions, unreadable, empty, malformed or truncated files, indices out of
/// range, vertices that are not finite, files without faces. What can be read in one sensible way is, and said in
/// [`ReadMesh::warnings`]. Vertices on texture seams occur once a side, as the attributes of a [`TriangleMesh`] need it: two
/// vertices at the same place are the same point of the surface.
pub fn read(path: &Path) -> Result<ReadMesh> {
    let format = MeshFormat::of(path).ok_or_else(|| EditError::input(path, unknown_extension()))?;
    let data = std::fs::read(path).map_err(|e| EditError::input(path, format!("cannot be read: {e}")))?;
    if data.is_empty() {
        return Err(EditError::input(path, "the file is empty"));
    }
    match format {
        MeshFormat::Obj => obj::read(path, &data),
        MeshFormat::Ply => ply::read(path, &data),
        MeshFormat::Stl => stl::read(path, &data),
        MeshFormat::Glb | MeshFormat::Gltf => gltf::read(path, &data),
        MeshFormat::Off => off::read(path, &data),
    }
}

/// Writes a mesh file, whole or not at all.
///
/// An unknown extension is an [`EditError::Parameter`], a mesh that the format cannot hold and every failure of the disk
/// an [`EditError::Output`].
pub fn write(path: &Path, mesh: &TriangleMesh) -> Result<()> {
    let format = format_to_write(path)?;
    write_atomically(path, |out| write_to(out, format, mesh))
}

/// Writes a mesh in `format`. A mesh that the format cannot hold is [`io::ErrorKind::InvalidInput`].
pub fn write_to(out: &mut dyn Write, format: MeshFormat, mesh: &TriangleMesh) -> io::Result<()> {
    let polygons = Polygons::from(mesh);
    polygons.check().map_err(unwritable)?;
    match format {
        MeshFormat::Obj => obj::write(out, &polygons),
        MeshFormat::Ply => ply::write(out, &polygons),
        MeshFormat::Stl => stl::write(out, mesh),
        MeshFormat::Glb => gltf_write::write_glb(out, mesh),
        MeshFormat::Gltf => gltf_write::write_gltf(out, mesh),
        MeshFormat::Off => off::write(out, &polygons),
    }
}

/// Writes a mesh of quads, like [`write()`]: as quads where the format [has polygons](MeshFormat::has_polygons), else in
/// triangles.
pub fn write_quads(path: &Path, mesh: &QuadMesh) -> Result<()> {
    let polygons = Polygons::from(mesh);
    let writer: fn(&mut dyn Write, &Polygons<4>) -> io::Result<()> = match format_to_write(path)? {
        MeshFormat::Obj => obj::write,
        MeshFormat::Ply => ply::write,
        MeshFormat::Off => off::write,
        MeshFormat::Stl | MeshFormat::Glb | MeshFormat::Gltf => {
            polygons.check().map_err(|problem| EditError::output(path, problem))?;
            return write(path, &mesh.clone().into_triangles());
        }
    };
    write_atomically(path, |out| {
        polygons.check().map_err(unwritable)?;
        writer(out, &polygons)
    })
}

fn format_to_write(path: &Path) -> Result<MeshFormat> {
    MeshFormat::of(path).ok_or_else(|| EditError::parameter("write mesh", "path", path.display(), unknown_extension()))
}

/// What is written: vertices, and faces of N corners.
struct Polygons<'a, const N: usize> {
    positions: &'a [DVec3],
    faces: &'a [[u32; N]],
    colors: Option<&'a [[f32; 4]]>,
    uvs: Option<&'a [[f32; 2]]>,
    normals: Option<&'a [[f32; 3]]>,
}

impl<'a> From<&'a TriangleMesh> for Polygons<'a, 3> {
    fn from(mesh: &'a TriangleMesh) -> Self {
        let (colors, uvs) = (mesh.colors.as_deref(), mesh.uvs.as_deref());
        Self { positions: &mesh.positions, faces: &mesh.triangles, colors, uvs, normals: mesh.normals.as_deref() }
    }
}

impl<'a> From<&'a QuadMesh> for Polygons<'a, 4> {
    fn from(mesh: &'a QuadMesh) -> Self {
        let (colors, uvs) = (mesh.colors.as_deref(), mesh.uvs.as_deref());
        Self { positions: &mesh.positions, faces: &mesh.quads, colors, uvs, normals: None }
    }
}

impl<const N: usize> Polygons<'_, N> {
    /// The fields of a mesh are public: nothing is taken for granted before it is written.
    fn check(&self) -> Result<(), String> {
        let vertices = self.positions.len();
        let attributes = [
            ("colors", self.colors.map(<[_]>::len)),
            ("uvs", self.uvs.map(<[_]>::len)),
            ("normals", self.normals.map(<[_]>::len)),
        ];
        for (name, count) in attributes {
            if let Some(count) = count.filter(|&count| count != vertices) {
                return Err(format!("the mesh has {vertices} vertices but {count} {name}"));
            }
        }
        let faces = self.faces.iter().enumerate();
        if let Some((f, v)) = faces.flat_map(|(f, c)| c.map(|v| (f, v))).find(|&(_, v)| v as usize >= vertices) {
            return Err(format!("face {f} uses vertex {v}, but there are {vertices}"));
        }
        match self.positions.iter().position(|p| !p.is_finite()) {
            Some(v) => Err(format!("vertex {v} is not finite: {}", self.positions[v])),
            None => Ok(()),
        }
    }
}

/// A file that another one names, relative to it. What is no regular file (a device never ends) is not followed.
fn read_beside(path: &Path, name: &str) -> io::Result<Vec<u8>> {
    let beside = path.with_file_name(name);
    if Path::new(name).is_absolute() || !std::fs::metadata(&beside)?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a file beside it"));
    }
    std::fs::read(beside)
}

/// The error of a mesh that a format cannot hold.
fn unwritable(problem: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, problem)
}

fn unknown_extension() -> String {
    let known = MeshFormat::ALL.map(|format| format.to_string()).join(", ");
    format!("the extension is of no mesh format; {known} are")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> TriangleMesh {
        TriangleMesh {
            positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y],
            triangles: vec![[0, 1, 2]],
            ..Default::default()
        }
    }

    #[test]
    fn extensions_in_any_case_and_unknown_ones_name_the_accepted() {
        assert_eq!(MeshFormat::of(Path::new("a/b.STL")), Some(MeshFormat::Stl));
        let error = read(Path::new("a.fbx")).unwrap_err();
        assert!(error.to_string().contains(".obj, .ply, .stl, .glb, .gltf, .off"), "{error}");
        assert_eq!((error.exit_code(), write(Path::new("a"), &triangle()).unwrap_err().exit_code()), (3, 2));
    }

    #[test]
    fn missing_files_and_folders_are_input_errors() {
        let folder = tempfile::Builder::new().suffix(".ply").tempdir().unwrap();
        for path in [folder.path().to_path_buf(), folder.path().join("missing.obj")] {
            assert!(read(&path).unwrap_err().to_string().contains("cannot be read"));
        }
    }

    #[test]
    fn every_format_comes_back_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let mut mesh = triangle();
        mesh.positions.push(DVec3::new(0.1f32.into(), -2.5, 1e6));
        mesh.triangles.push([1, 3, 2]);
        let bytes = [[0, 127, 255, 255], [9, 8, 7, 255], [255, 0, 0, 255], [1, 2, 3, 255]];
        let colors = bytes.map(|c: [u8; 4]| super::color::decode(c.map(|c| f32::from(c) / 255.0)));
        mesh.colors = Some(colors.to_vec());
        mesh.uvs = Some(vec![[0.0, 0.0], [0.25, 0.0], [0.0, 0.75], [1.5, -1.0]]);
        mesh.normals = Some(vec![[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8], [0.0, 0.0, 1.0]]);
        for format in MeshFormat::ALL {
            let path = folder.path().join("a").with_extension(format.extension());
            write(&path, &mesh).unwrap();
            let back = read(&path).unwrap();
            assert_eq!(back.warnings, Vec::<String>::new(), "{format}");
            let mut expected = mesh.clone();
            if format == MeshFormat::Stl {
                (expected.colors, expected.uvs, expected.normals) = (None, None, None);
            }
            assert_eq!(back.mesh.positions, expected.positions, "{format}");
            assert_eq!(back.mesh.triangles, expected.triangles, "{format}");
            assert_eq!(back.mesh.uvs, expected.uvs, "{format}");
            assert_eq!(back.mesh.normals, expected.normals, "{format}");
            let colors = |mesh: &TriangleMesh| mesh.colors.clone().unwrap_or_default().concat();
            let (back, expected) = (colors(&back.mesh), colors(&expected));
            assert_eq!(back.len(), expected.len(), "{format}");
            assert!(back.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6), "{format}");
        }
    }

    #[test]
    fn quads_stay_quads_where_there_are_polygons() {
        let folder = tempfile::tempdir().unwrap();
        let positions = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
        let uvs = Some(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
        let mesh = QuadMesh { positions, quads: vec![[0, 1, 2, 3]], uvs, colors: None };
        for format in MeshFormat::ALL {
            let path = folder.path().join("a").with_extension(format.extension());
            write_quads(&path, &mesh).unwrap();
            let back = read(&path).unwrap().mesh;
            assert_eq!((back.positions.len(), back.triangles.len()), (4, 2), "{format}");
            assert_eq!(back.uvs.is_some(), format.has_attributes(), "{format}");
            let bytes = std::fs::read(&path).unwrap();
            let said = String::from_utf8_lossy(&bytes);
            match format {
                MeshFormat::Obj => assert!(said.contains("\nf 1/1 2/2 3/3 4/4\n"), "{said}"),
                MeshFormat::Off => assert!(said.contains("\n4 0 1 2 3\n"), "{said}"),
                MeshFormat::Ply => assert!(said.contains("element face 1\n"), "{said}"),
                _ => assert!(!format.has_polygons()),
            }
        }
        let broken = QuadMesh { quads: vec![[0, 1, 2, 4]], ..mesh };
        for format in [MeshFormat::Off, MeshFormat::Stl] {
            let path = folder.path().join("b").with_extension(format.extension());
            assert_eq!(write_quads(&path, &broken).unwrap_err().exit_code(), 4);
        }
    }

    #[test]
    fn positions_beyond_single_precision_survive_where_the_format_can() {
        let mut mesh = triangle();
        mesh.positions[1] = DVec3::new(1.0 + 1e-12, 1e300, -1e-300);
        for format in MeshFormat::ALL {
            let mut file = Vec::new();
            let written = write_to(&mut file, format, &mesh);
            let single = matches!(format, MeshFormat::Stl | MeshFormat::Glb | MeshFormat::Gltf);
            assert_eq!(written.is_err(), single, "{format}");
        }
        let folder = tempfile::tempdir().unwrap();
        for format in [MeshFormat::Obj, MeshFormat::Ply, MeshFormat::Off] {
            let path = folder.path().join("a").with_extension(format.extension());
            write(&path, &mesh).unwrap();
            assert_eq!(read(&path).unwrap().mesh, mesh, "{format}");
        }
    }

    #[test]
    fn inconsistent_meshes_are_not_written() {
        let broken = [
            TriangleMesh { triangles: vec![[0, 1, 3]], ..triangle() },
            TriangleMesh { colors: Some(vec![[0.0; 4]]), ..triangle() },
            TriangleMesh { positions: vec![DVec3::NAN; 3], ..triangle() },
        ];
        let folder = tempfile::tempdir().unwrap();
        for mesh in broken {
            let error = write(&folder.path().join("a.ply"), &mesh).unwrap_err();
            assert!(matches!(error, EditError::Output { .. }), "{error}");
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
