use super::*;
use crate::grid::Transform;
use crate::levelset::testing::{ball, box_distance, sampled, torus};
use glam::{DVec2, DVec3, IVec3, Vec3};

fn run() -> RunOptions {
    RunOptions::default()
}

/// A cone of 10 by 10 by 16 voxels.
fn spike() -> LevelSet {
    let bounds = (IVec3::splat(-24), IVec3::splat(24));
    // Its sides have the slope 5/16; divided by the length of the gradient it is the distance to them.
    let cone = |p: DVec3| {
        let side = (p.x.hypot(p.y) - 5.0 * (1.0 - p.z / 16.0)) / (1.0f64 + (5.0f64 / 16.0).powi(2)).sqrt();
        side.max(-p.z)
    };
    LevelSet::from_distance(Transform::uniform(0.5), 3.0, bounds, cone, &run()).unwrap()
}

fn vectors(points: [DVec3; 4]) -> Vec<Vector> {
    points.map(Vector).to_vec()
}

fn on_torus() -> Texture {
    let at =
        |u: f64, v: f64| DVec3::new((24.0 + 9.0 * v.cos()) * u.cos(), (24.0 + 9.0 * v.cos()) * u.sin(), 9.0 * v.sin());
    let corners = vectors([at(-0.3, -0.8), at(0.3, -0.8), at(0.3, 0.8), at(-0.3, 0.8)]);
    Texture { corners, height: Some(WorldLength::new(8.0)), ..Texture::default() }
}

fn apply(base: &LevelSet, solid: &LevelSet, texture: &Texture) -> Result<Outcome> {
    texture.validate()?;
    texture.apply(vec![base.clone(), solid.clone()], &run())
}

#[test]
fn a_torus_with_spikes_is_one_component() {
    let (torus, spike) = (torus(24.0, 9.0), spike());
    let before = torus.measure(&run()).unwrap();
    for map in [MapKind::Inverse, MapKind::Implicit, MapKind::SemiImplicit] {
        let texture = Texture { map, tile: [2.0, 2.0], ..on_torus() };
        let Outcome { level_set, summary } = apply(&torus, &spike, &texture).unwrap();
        assert_eq!(level_set.check(), [], "{map:?}");
        assert_eq!(summary.warnings, [""; 0]);
        let after = level_set.measure(&run()).unwrap();
        // The push lets the spikes overlap with the torus; none hangs beside it.
        assert_eq!((after.components, after.euler), (1, 0), "{map:?}");
        assert!(after.volume > before.volume + 100.0, "{map:?}");
        assert_eq!(summary.details["folded_cells"], 0);
    }
}

#[test]
fn results_are_bases() {
    // A spike on the top of a spike.
    let (ball, spike) = (ball(DVec3::ZERO, 20.0), spike());
    let on = |z: f64, radius: f64, height: f64| Texture {
        center: Some(Vector(DVec3::Z * z)),
        radius: Some(WorldLength::new(radius)),
        height: Some(WorldLength::new(height)),
        ..Texture::default()
    };
    let block = sampled(12, |p| box_distance(p, DVec3::new(6.0, 6.0, 4.0)));
    let once = apply(&ball, &block, &on(20.0, 9.0, 8.0)).unwrap().level_set;
    let twice = apply(&once, &spike, &on(27.0, 3.0, 7.0)).unwrap().level_set;
    assert_eq!(twice.check(), []);
    assert_eq!(twice.measure(&run()).unwrap().components, 1);
    let top = twice.grid().active_bounds().unwrap().1.z;
    // 20 + 8 + 7, less two pushes and a tip too thin to stand, and the band.
    assert!((33..=38).contains(&top), "{top}");
}

#[test]
fn differences_cut_and_blends_round() {
    let ball = ball(DVec3::ZERO, 20.0);
    let block = sampled(12, |p| box_distance(p, DVec3::new(6.0, 6.0, 4.0)));
    let carved = Texture {
        center: Some(Vector(DVec3::Z * 20.0)),
        radius: Some(WorldLength::new(7.0)),
        height: Some(WorldLength::new(-5.0)),
        operation: Joining::Difference,
        ..Texture::default()
    };
    let cut = apply(&ball, &block, &carved).unwrap().level_set;
    assert_eq!(cut.check(), []);
    let mut sampler = cut.sampler();
    assert!(sampler.trilinear(DVec3::Z * 17.0) > 0.0 && sampler.trilinear(DVec3::Z * 13.0) < 0.0);
    let raised = Texture { height: Some(WorldLength::new(5.0)), operation: Joining::Union, ..carved };
    let sharp = apply(&ball, &block, &raised).unwrap().level_set;
    for blend in [Blending::Curvature, Blending::Gaussian] {
        let rounded = Texture { blend, blend_distance: Some(VoxelLength::new(4.0)), ..raised.clone() };
        let rounded = apply(&ball, &block, &rounded).unwrap().level_set;
        assert_eq!(rounded.check(), []);
        let (sharp, rounded) = (sharp.measure(&run()).unwrap(), rounded.measure(&run()).unwrap());
        assert!(rounded.volume > sharp.volume + 10.0 && rounded.area < sharp.area, "{blend:?}");
    }
}

#[test]
fn a_blended_seam_is_as_round_as_was_asked() {
    // A block on a block: the seam is a right angle.
    let slab = sampled(26, |p| box_distance(p - DVec3::new(0.0, 0.0, -10.5), DVec3::new(22.0, 22.0, 10.0)));
    let pillar = sampled(12, |p| (p.x.hypot(p.y) - 8.0).max(p.z.abs() - 8.0));
    let plain = Texture {
        center: Some(Vector(DVec3::Z * -0.5)),
        radius: Some(WorldLength::new(8.0)),
        direction: Some(Vector(DVec3::X)),
        height: Some(WorldLength::new(14.0)),
        ..Texture::default()
    };
    // The most concave place by the seam, away from the rim of the pillar.
    let most_concave = |texture: &Texture| {
        let joined = apply(&slab, &pillar, texture).unwrap().level_set;
        let field = crate::levelset::curvature(&joined, crate::levelset::CurvatureKind::Mean, &run()).unwrap();
        let mesh = crate::mesh::level_set_to_mesh(&joined, 0.0, &run()).unwrap();
        let by_seam = mesh.positions.iter().filter(|p| p.z < 6.0 && p.x.hypot(p.y) < 14.0);
        let mut accessor = field.accessor();
        let value = |p: &DVec3| crate::levelset::Field::trilinear(&mut accessor, *p).map(f64::from);
        by_seam.filter_map(value).fold(0.0, f64::min)
    };
    let sharp = most_concave(&plain);
    let asked = Texture {
        blend: Blending::Curvature,
        blend_distance: Some(VoxelLength::new(10.0)),
        blend_curvature: Some([0.08, 0.12]),
        ..plain.clone()
    };
    let round = most_concave(&asked);
    // By differences over voxels curvature is right to about a tenth where the radius is three of them.
    assert!(sharp < -0.3 && round > -0.12 * 1.15, "{sharp} {round}");
    assert!(Texture { blend: Blending::Gaussian, ..asked }.validate().is_err());
}

#[test]
fn every_map_gives_the_same_bits_on_one_thread_and_on_three() {
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (torus, spike) = (torus(24.0, 9.0), spike());
    for map in [MapKind::Inverse, MapKind::Implicit, MapKind::SemiImplicit] {
        for parameterization in [Division::Conforming, Division::LowDistortion] {
            let texture = Texture { map, parameterization, tile: [2.0, 1.0], ..on_torus() };
            let once = || apply(&torus, &spike, &texture).unwrap().level_set;
            let (one, three) = (pool(1).install(once), pool(3).install(once));
            assert!(crate::ops::compare::compare(&one, &three, &run()).unwrap().identical, "{map:?}");
        }
    }
}

#[test]
fn loose_parts_are_counted_or_left_out() {
    let ball = ball(DVec3::ZERO, 20.0);
    // A plate above a block, apart from it.
    let texture = sampled(14, |p| {
        let block = box_distance(p + DVec3::Z * 4.0, DVec3::new(8.0, 8.0, 3.0));
        block.min(box_distance(p - DVec3::Z * 6.0, DVec3::new(8.0, 8.0, 2.0)))
    });
    let on = Texture {
        center: Some(Vector(DVec3::Z * 20.0)),
        radius: Some(WorldLength::new(8.0)),
        height: Some(WorldLength::new(16.0)),
        ..Texture::default()
    };
    let Outcome { level_set, summary } = apply(&ball, &texture, &on).unwrap();
    assert_eq!(level_set.measure(&run()).unwrap().components, 2);
    assert!(summary.details["loose_parts"] == 1 && summary.warnings[0].contains("loose"), "{summary:?}");
    let dropped = Texture { loose: LooseParts::Drop, ..on.clone() };
    let Outcome { level_set, summary } = apply(&ball, &texture, &dropped).unwrap();
    assert_eq!(level_set.check(), []);
    let measures = level_set.measure(&run()).unwrap();
    assert_eq!((measures.components, measures.euler), (1, 2));
    assert!(summary.details["loose_parts"] == 1 && summary.warnings.is_empty());
    assert!(Texture { operation: Joining::None, ..dropped }.validate().is_err());
}

#[test]
fn a_space_that_runs_through_itself_is_refused() {
    // Far down into a ball the normals meet.
    let ball = ball(DVec3::ZERO, 20.0);
    let deep = Texture {
        center: Some(Vector(DVec3::Z * 20.0)),
        radius: Some(WorldLength::new(10.0)),
        height: Some(WorldLength::new(-50.0)),
        operation: Joining::Difference,
        ..Texture::default()
    };
    let error = apply(&ball, &spike(), &deep).err().unwrap();
    assert_eq!(error.exit_code(), 2);
    let said = error.to_string();
    assert!(["height", "smaller", "through itself"].iter().all(|w| said.contains(w)), "{said}");
}

#[test]
fn scattered_patches_keep_their_distance_and_follow_their_seed() {
    let ball = ball(DVec3::ZERO, 30.0);
    let centers = |text: &str| -> Vec<DVec3> {
        let places = Scatter::parse(text).unwrap().places(&ball, None, &run()).unwrap();
        places
            .list
            .iter()
            .take(places.scattered.unwrap())
            .map(|p| if let Place::Around { center, .. } = p { *center } else { DVec3::ZERO })
            .collect()
    };
    let all = centers("spacing=9 radius=4 seed=5");
    assert!((80..200).contains(&all.len()), "{}", all.len());
    for (i, p) in all.iter().enumerate() {
        assert!((p.length() - 30.0).abs() < 0.05);
        assert!(all[..i].iter().all(|q| q.distance(*p) >= 9.0));
    }
    assert_eq!(all, centers("spacing=9 radius=4 seed=5"));
    assert_ne!(all, centers("spacing=9 radius=4 seed=6"));
    assert_eq!(centers("spacing=9 radius=4 seed=5 count=7"), all[..7]);
    // Seven on the whole area.
    let density = 7.0 / ball.measure(&run()).unwrap().area;
    assert_eq!(centers(&format!("spacing=9 radius=4 seed=5 density={density}")).len(), 7);
    assert!(Scatter::parse("spacing=9 radius=4 sed=5").is_err() && Scatter::parse("radius=4").is_err());
}

#[test]
fn the_exponential_map_of_a_ball() {
    // Distances from the centre are kept, circles around it have the length sin θ/θ.
    let ball = ball(DVec3::ZERO, 24.0);
    let texture = Texture { direction: Some(Vector(DVec3::X)), ..Texture::default() };
    let net = texture.net(&ball, DVec3::Z * 24.0, Some(DVec3::X), 16.0, &run()).unwrap();
    let [n, _] = net.counts;
    for i in 0..=n {
        for j in 0..=n {
            let flat = DVec2::new(i as f64 / n as f64 * 2.0 - 1.0, j as f64 / n as f64 * 2.0 - 1.0) * 16.0;
            let angle = flat.length() / 24.0;
            let along = flat.normalize_or_zero();
            let exact = DVec3::new(along.x * angle.sin(), along.y * angle.sin(), angle.cos()) * 24.0;
            // A voxel of 24, and 4 % of sin 1/1.
            assert!(net.at(i, j).distance(exact) < 0.6, "{flat} {} {exact}", net.at(i, j));
        }
    }
}

#[test]
fn particles_are_written_with_their_coordinates() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("p.ply");
    let texture = Texture { write_particles: Some(path.clone()), ..on_torus() };
    apply(&torus(24.0, 9.0), &spike(), &texture).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let header: Vec<&str> = text.lines().take_while(|l| *l != "end_header").collect();
    assert!(header.contains(&"property float w"));
    let count = |what: &str| header.iter().find_map(|l| l.strip_prefix(what)).unwrap().parse::<usize>().unwrap();
    let (vertices, faces, edges) = (count("element vertex "), count("element face "), count("element edge "));
    assert_eq!(text.lines().count(), header.len() + 1 + vertices + faces + edges);
    assert!(crate::render::Patches::read(&path).is_ok());
    assert!(vertices > 200 && edges > vertices);
}

#[test]
fn moved_polygons_keep_colours_and_coordinates() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (folder.path().join("from.ply"), folder.path().join("to.ply"));
    let quad = crate::mesh::TriangleMesh {
        positions: vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.5), DVec3::Y],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        colors: Some(vec![[1.0, 0.0, 0.0, 1.0]; 4]),
        uvs: Some(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        normals: Some(vec![[0.0, 0.0, 1.0]; 4]),
    };
    crate::mesh::write(&from, &quad).unwrap();
    let texture = Texture {
        write_mesh: Some(to.clone()),
        mesh: Some(from),
        tile: [2.0, 1.0],
        push: Some(VoxelLength::new(0.0)),
        ..on_torus()
    };
    apply(&torus(24.0, 9.0), &spike(), &texture).unwrap();
    let moved = crate::mesh::read(&to).unwrap().mesh;
    assert_eq!((moved.positions.len(), moved.triangles.len()), (8, 4));
    assert_eq!(moved.uvs.unwrap()[..4], quad.uvs.unwrap());
    assert_eq!(moved.colors.unwrap().len(), 8);
    let normals = moved.normals.unwrap();
    // On the surface where z was 0, counter-clockwise as before.
    let torus = torus(24.0, 9.0);
    assert!(torus.sampler().trilinear(moved.positions[0]).abs() < 0.05);
    assert!(torus.sampler().trilinear(moved.positions[2]) > 2.9);
    // What was across the box of the texture is across the surface.
    for v in [0, 1, 3, 4, 5, 7] {
        let across = torus.sampler().smooth_gradient(moved.positions[v]).normalize().as_vec3();
        assert!(Vec3::from_array(normals[v]).dot(across) > 0.98, "{v} {across} {:?}", normals[v]);
    }
}

#[test]
fn refusals_name_what_to_change() {
    let (torus, spike) = (torus(24.0, 9.0), spike());
    let said = |texture: Texture| {
        let error = apply(&torus, &spike, &texture).err().unwrap();
        assert_eq!(error.exit_code(), 2, "{error}");
        error.to_string()
    };
    let good = on_torus();
    let [a, b, c, d] = [0, 1, 2, 3].map(|k| good.corners[k]);
    let with = |corners: [Vector; 4]| Texture { corners: corners.to_vec(), ..good.clone() };
    for (texture, words) in [
        (Texture::default(), ["corners", "center"]),
        (with([a, a, c, d]), ["corners", "1 and 2 coincide"]),
        (with([d, c, b, a]), ["corners", "other way round"]),
        (with([a, b, c, Vector(d.0 * 3.0)]), ["corners", "from the surface"]),
        (Texture { center: Some(a), ..good.clone() }, ["corners", "several kinds"]),
        (Texture { height: Some(WorldLength::new(0.1)), ..good.clone() }, ["height", "1 to"]),
        (Texture { height: Some(WorldLength::new(0.0)), ..good.clone() }, ["height", "finite"]),
        (Texture { lambda: [-1.0, 0.3], map: MapKind::Implicit, ..good.clone() }, ["lambda", "0 (through"]),
        (Texture { lambda: [0.005, 11.0], map: MapKind::Implicit, ..good.clone() }, ["lambda", "to 10"]),
        (Texture { mesh: Some("a.obj".into()), ..good.clone() }, ["mesh", "write_mesh"]),
        (Texture { lambda: [0.1, 0.3], ..good.clone() }, ["lambda", "implicit"]),
        (Texture { tile: [1.5, 1.0], ..good.clone() }, ["tile", "whole"]),
        (Texture { spline: Some("0,0,1".into()), ..good.clone() }, ["spline", "only with"]),
        (Texture { blend: Blending::Curvature, operation: Joining::None, ..good.clone() }, ["blend", "union"]),
        (Texture { corners: vec![a, b], ..good.clone() }, ["corners", "four"]),
        (
            Texture { scatter: Some("spacing=0.1 radius=3".into()), corners: vec![], ..good.clone() },
            ["scatter", "voxel"],
        ),
    ] {
        let said = said(texture);
        assert!(words.iter().all(|w| said.contains(w)), "{said}");
    }
    let empty = LevelSet::empty(Transform::uniform(1.0), 3.0);
    let error = apply(&torus, &empty, &good).err().unwrap().to_string();
    assert!(error.contains("texture") && error.contains("resolution"), "{error}");
    let nothing = apply(&empty, &spike, &good).unwrap();
    assert!(nothing.level_set.is_empty() && nothing.summary.warnings.len() == 1);
}
