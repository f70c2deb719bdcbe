//! The conversion against exact solids, brute force and real files.

use super::*;
use crate::grid::{Face, LEAF_VOXELS, offset_to_local};
use crate::mesh::testing::*;

fn convert(mesh: &TriangleMesh, voxel_size: f64) -> Result<(LevelSet, MeshFindings)> {
    mesh_to_level_set(mesh, &MeshToLevelSet::new(voxel_size), &RunOptions::default())
}

/// The promises of a level set that the conversion has to keep, and the volume inside in world units.
fn check_valid(level_set: &LevelSet) -> f64 {
    let grid = level_set.grid();
    let background = grid.background();
    let mut voxels = 0usize;
    for &id in grid.leaves() {
        let (origin, values, mask) = (grid.origin(id), grid.values(id), grid.mask(id));
        for offset in 0..LEAF_VOXELS {
            let (v, ijk) = (values.0[offset], origin + offset_to_local(offset));
            assert_eq!(mask.get(offset), v.abs() < background, "{ijk}: {v}");
            assert!(v.abs() <= background);
            voxels += usize::from(v < 0.0);
            for face in Face::ALL {
                let (other, active) = grid.voxel(ijk + face.step());
                let differ = (v < 0.0) != (other < 0.0);
                assert!(!differ || active && mask.get(offset), "{ijk} {face:?}: {v} and {other}");
                // Distances change by no more than the distance of the voxels.
                assert!((v - other).abs() as f64 <= level_set.voxel_size() * 1.001, "{ijk} {face:?}: {v} and {other}");
            }
        }
    }
    voxels += grid.inside_tiles().iter().map(|(_, edge)| (*edge as usize).pow(3)).sum::<usize>();
    voxels as f64 * level_set.voxel_size().powi(3)
}

fn value(level_set: &LevelSet, xyz: DVec3) -> f64 {
    let ijk = level_set.transform().world_to_index(xyz).round().as_ivec3();
    f64::from(level_set.grid().voxel(ijk).0)
}

#[test]
fn a_box_is_exact() {
    let (level_set, findings) = convert(&cube(DVec3::new(-0.53, 0.21, 0.07), 1.13), 0.05).unwrap();
    assert!(findings.is_sound());
    check_valid(&level_set);
    let grid = level_set.grid();
    let (center, half) = (DVec3::new(-0.53, 0.21, 0.07) + 1.13 / 2.0, 1.13 / 2.0);
    for &id in grid.leaves() {
        for offset in grid.mask(id).iter() {
            let q =
                (level_set.transform().voxel_to_world(grid.origin(id) + offset_to_local(offset)) - center).abs() - half;
            let truth = q.max(DVec3::ZERO).length() + q.max_element().min(0.0);
            assert!((f64::from(grid.values(id).0[offset]) - truth).abs() < 1e-5 * 0.05);
        }
    }
}

#[test]
fn what_is_beyond_the_band_is_inactive_at_any_voxel_size() {
    let mut open = sphere(DVec3::splat(0.013), 1.0, 20);
    open.triangles.truncate(open.triangles.len() - 20);
    for mesh in [sphere(DVec3::splat(0.013), 1.0, 20), open] {
        for i in 0..12 {
            let (level_set, _) = convert(&mesh, 0.05 + 0.0037 * f64::from(i)).unwrap();
            let grid = level_set.grid();
            // Two bands of three voxels do not fill eight voxels of a leaf but for a corner of the surface.
            let full = grid.leaves().iter().filter(|&&id| grid.mask(id) == LeafMask::FULL).count();
            assert!(10 * full < grid.leaves().len(), "{full} of {}", grid.leaves().len());
        }
    }
}

#[test]
fn a_torus_of_triangles_is_exact_to_its_triangles() {
    let Some(mesh) = shared_mesh("meshes/torus.obj") else { return };
    let (level_set, findings) = convert(&mesh, 0.02).unwrap();
    assert!(findings.is_sound());
    let volume = check_valid(&level_set);
    assert!((volume / analyze_volume(&mesh) - 1.0).abs() < 0.01);
    let bvh = Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect());
    let grid = level_set.grid();
    for &id in grid.leaves().iter().step_by(5) {
        for offset in grid.mask(id).iter() {
            let xyz = level_set.transform().voxel_to_world(grid.origin(id) + offset_to_local(offset));
            let truth = bvh.closest_point(xyz, 1.0).unwrap().distance_squared.sqrt();
            assert!((f64::from(grid.values(id).0[offset].abs()) - truth).abs() < 1e-5 * 0.02);
        }
    }
}

fn analyze_volume(mesh: &TriangleMesh) -> f64 {
    crate::mesh::analyze(mesh).signed_volume
}

#[test]
fn overlapping_shells_are_united_and_their_inner_walls_vanish() {
    let mesh = joined(cube(DVec3::splat(0.01), 1.0), &cube(DVec3::new(0.51, 0.01, 0.01), 1.0));
    let (level_set, findings) = convert(&mesh, 0.04).unwrap();
    assert!(findings.self_intersecting && !findings.is_sound());
    let volume = check_valid(&level_set);
    assert!((volume - 1.5).abs() < 0.05, "{volume}");
    // In the middle of the overlap the walls at x = 0.51 and x = 1.01 are gone.
    assert_eq!(value(&level_set, DVec3::new(0.52, 0.5, 0.5)), -f64::from(level_set.background()));
    assert_eq!(value(&level_set, DVec3::new(1.0, 0.5, 0.5)), -f64::from(level_set.background()));
    let strict = MeshToLevelSet { strict: true, ..MeshToLevelSet::new(0.04) };
    let error = mesh_to_level_set(&mesh, &strict, &RunOptions::default()).err().unwrap();
    assert!(error.exit_code() == 3 && error.to_string().contains("pass through"), "{error}");
}

#[test]
fn cavities_stay_and_inside_out_is_turned() {
    let hollow = joined(cube(DVec3::splat(0.01), 1.0), &reversed(cube(DVec3::splat(0.31), 0.4)));
    for mesh in [hollow.clone(), reversed(hollow)] {
        let (level_set, findings) = convert(&mesh, 0.04).unwrap();
        let volume = check_valid(&level_set);
        assert!((volume - (1.0 - 0.064)).abs() < 0.03, "{volume}");
        assert_eq!(findings.cavities, 1);
        assert!(value(&level_set, DVec3::splat(0.5)) > 0.0);
    }
}

#[test]
fn an_open_sphere_is_closed_smoothly() {
    let mut mesh = sphere(DVec3::splat(0.013), 1.0, 60);
    // The cap within 30 degrees of the north pole is missing.
    mesh.triangles.retain(|t| t.iter().any(|&v| mesh.positions[v as usize].z < 0.87));
    let (level_set, findings) = convert(&mesh, 0.05).unwrap();
    let volume = check_valid(&level_set);
    // Between the sphere without its cap (the plane lid) and the whole sphere.
    let cap = std::f64::consts::PI * 0.134f64.powi(2) * (3.0 - 0.134) / 3.0;
    let whole = 4.0 / 3.0 * std::f64::consts::PI;
    assert!(volume < whole && volume > whole - 2.0 * cap, "{volume} of {whole}");
    assert!(findings.converted.boundary_edges > 0 && findings.closure_triangles > 0);
    // Away from the hole nothing is different.
    assert!((value(&level_set, DVec3::new(0.013, 0.013, -0.9)) + 0.087).abs() < 0.03);
    assert!(!findings.warnings().is_empty());
}

#[test]
fn what_encloses_nothing_is_refused_with_a_reason() {
    let quad = cube(DVec3::ZERO, 1.0);
    let sheet = TriangleMesh { triangles: quad.triangles[..2].to_vec(), ..quad.clone() };
    let both = joined(sheet.clone(), &reversed(sheet.clone()));
    let empty = TriangleMesh::default();
    let mut nan = quad.clone();
    nan.positions[3].y = f64::NAN;
    let mut index = quad.clone();
    index.triangles[5][1] = 99;
    let cases =
        [(sheet, "open"), (both, "back to back"), (empty, "no triangles"), (nan, "vertex 3"), (index, "vertex 99")];
    for (mesh, word) in cases {
        let error = convert(&mesh, 0.1).err().unwrap();
        assert!(error.exit_code() == 3 && error.to_string().contains(word), "{error}");
    }
    let far = cube(DVec3::splat(1e30), 1e30);
    assert_eq!(convert(&far, 1.0).err().unwrap().exit_code(), 3, "no voxel size has room for it");
    for voxel_size in [0.0, f64::NAN, -1.0, 50.0] {
        let error = convert(&quad, voxel_size).err().unwrap();
        assert_eq!(error.exit_code(), 2, "{error}");
    }
    let mut run = RunOptions::default();
    run.memory_limit = Some(1 << 20);
    let error = mesh_to_level_set(&quad, &MeshToLevelSet::new(1e-4), &run).err().unwrap();
    assert_eq!(error.exit_code(), 5, "{error}");
}

/// Every file of the collection of nasty meshes ends in a valid level set or in a clear error.
#[test]
fn nasty_meshes_become_valid_level_sets_or_clear_errors() {
    // Words of the error, or of a warning; an empty word asks for a mesh without any.
    let expected = [
        ("3DSMaxExport.STL", "more than two triangles"),
        ("Offset1_degenerate.obj", "back to back"),
        ("Spider_binary.stl", "open"),
        ("Wuson_inside_out.off", "inside out"),
        ("beetle_car.obj", "open"),
        ("boxNotManifold.obj", "4 boundary edges"),
        ("box_longline.obj", "2 triangles disagreed"),
        ("bun_zipper_res4.ply", "back to back"),
        ("chair_double_sided.obj", "encloses nothing"),
        ("concave_polygon.obj", "encloses no voxel"),
        ("conrod_flipped.stl", "disagreed with their neighbours"),
        ("crlf_header_binary.ply", ""),
        ("featuretype_cracks.STL", "differed from their neighbours by rounding"),
        ("halftunnel_open.off", "open"),
        ("joined_tetrahedra.obj", "back to back"),
        ("malformed_face.obj", "open"),
        ("many_small_holes.ply", "open"),
        ("multibody_flipped.stl", "inside out"),
        ("negative_indices.obj", ""),
        ("nested_boxes.glb", ""),
        ("nested_shell_hollow.obj", ""),
        ("nonmanifold_not_convex.obj", "thinner than a voxel"),
        ("openscad_nonmanifold.obj", "more than two triangles"),
        ("rabbit_overlapping_parts.obj", "pass through each other"),
        ("self_intersectA.obj", "pass through each other"),
        ("sphereWithHole.stl", "9 boundary edges"),
        ("thingi10k_112932.stl", ""),
        ("thingi10k_79741_butterfly.stl", ""),
        ("triangle_soup.stl", "300 boundary edges"),
        ("tristrips_brain.ply", "pass through each other"),
        ("truck_open_parts.obj", "open"),
        ("two_solids.stl", "encloses no voxel"),
        ("wallhole_degenerate.obj", ""),
    ];
    let mut surprises = Vec::new();
    for (file, word) in expected {
        let Some(mesh) = shared_mesh(&format!("nasty/{file}")) else { return };
        let (lo, hi) = mesh.bounding_box().unwrap();
        match convert(&mesh, (hi - lo).max_element() / 30.0) {
            Err(error) => {
                if word.is_empty() || !error.to_string().contains(word) || !matches!(error.exit_code(), 2 | 3) {
                    surprises.push(format!("{file}: {error}"));
                }
            }
            Ok((level_set, findings)) => {
                assert!(check_valid(&level_set) > 0.0);
                surprises.extend(level_set.check().iter().map(|violation| format!("{file}: {violation:?}")));
                let warnings = findings.warnings().join("; ");
                if !warnings.contains(word) || word.is_empty() != warnings.is_empty() {
                    surprises.push(format!("{file}: {warnings}"));
                }
            }
        }
    }
    assert!(surprises.is_empty(), "{surprises:#?}");
    let huge = shared_mesh("nasty/huge_coordinates.obj").unwrap();
    assert_eq!(convert(&huge, 1.0).err().unwrap().exit_code(), 3);
}

#[test]
fn the_result_does_not_depend_on_the_threads() {
    let a = sphere(DVec3::splat(0.013), 1.0, 30);
    let mut mesh = joined(a.clone(), &sphere(DVec3::new(0.9, 0.2, 0.1), 0.8, 25));
    mesh.triangles.truncate(mesh.triangles.len() - 20);
    let with_threads = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| convert(&mesh, 0.07)).unwrap()
    };
    let ((one, found_one), (three, found_three)) = (with_threads(1), with_threads(3));
    assert_eq!(found_one, found_three);
    assert_eq!(one.grid().leaves(), three.grid().leaves());
    for &id in one.grid().leaves() {
        assert_eq!(one.grid().origin(id), three.grid().origin(id));
        assert_eq!(one.grid().mask(id), three.grid().mask(id));
        let bits = |l: &LevelSet| l.grid().values(id).0.map(f32::to_bits);
        assert_eq!(bits(&one), bits(&three));
    }
}
