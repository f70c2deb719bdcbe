use std::path::PathBuf;

use glam::{DAffine3, DVec2, DVec3};

use super::sight::tests::distance;
use super::*;
use crate::run::RunOptions;

fn folder_with(files: &[(&str, Vec<u8>)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    folder
}

fn read(folder: &tempfile::TempDir, name: &str, skip: bool) -> Result<RangeSet, String> {
    let path: PathBuf = folder.path().join(name);
    RangeSet::read(&path, skip, &RunOptions::default()).map_err(|e| e.to_string())
}

/// A 16-bit greyscale picture.
fn picture(width: u32, height: u32, numbers: &[u16]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(::png::ColorType::Grayscale);
    encoder.set_depth(::png::BitDepth::Sixteen);
    let data: Vec<u8> = numbers.iter().flat_map(|n| n.to_be_bytes()).collect();
    encoder.write_header().unwrap().write_image_data(&data).unwrap();
    bytes
}

/// A grid of 3 x 2 points on the plane z = 1 + x, one of them missing.
const SCAN: &str = "ply\nformat ascii 1.0\nobj_info num_cols 3\nobj_info num_rows 2\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement range_grid 6\nproperty list uchar int vertex_indices\nend_header\n0 0 1\n1 0 2\n2 0 3\n0 1 1\n1 1 2\n1 0\n1 1\n1 2\n1 3\n1 4\n0\n";

#[test]
fn projections_and_points_are_inverse() {
    let projections = [
        Projection::Orthographic { first: DVec2::new(-1.0, 2.0), pitch: DVec2::new(0.5, 0.25) },
        Projection::Pinhole { focal: DVec2::new(300.0, 310.0), centre: DVec2::new(160.0, 120.0) },
        Projection::Spherical { first: DVec2::new(2.9, -0.6), step: DVec2::new(0.01, 0.012) },
        Projection::Spherical { first: DVec2::new(-2.9, 0.6), step: DVec2::new(-0.01, -0.012) },
    ];
    for projection in projections {
        for pixel in [DVec2::new(3.0, 7.0), DVec2::new(100.25, 40.5)] {
            let p = projection.point(pixel, 2.5);
            let (back, range) = projection.project(p).unwrap();
            assert!((back - pixel).length() < 1e-9 && (range - 2.5).abs() < 1e-12, "{projection:?} {back} {range}");
        }
    }
    assert!(projections[1].project(DVec3::new(0.0, 0.0, -1.0)).is_none());
}

#[test]
fn a_stanford_scan_is_drawn_where_it_was_measured() {
    let conf = "camera 0 0 0 0 0 0 1\nbmesh scan.ply 10 0 0 0 0 0 1\nbmesh gone.ply 0 0 0 0 0 0 1\n";
    let folder = folder_with(&[("a.conf", conf.into()), ("scan.ply", SCAN.into())]);
    let missing = read(&folder, "a.conf", false).unwrap_err();
    assert!(missing.contains("gone.ply"), "{missing}");
    let set = read(&folder, "a.conf", true).unwrap();
    assert!(set.maps.len() == 1 && set.warnings[0].contains("gone.ply"), "{:?}", set.warnings);
    let map = &set.maps[0];
    // Above the plane z = 1 + x by a half, at x = 0.5; and out of the picture.
    assert!((distance(map, DVec3::new(10.5, 0.5, 2.0)) - 0.5).abs() < 1e-6);
    assert!(distance(map, DVec3::new(10.5, 40.0, 2.0)).is_nan());
    // Binary of both byte orders says the same.
    for order in ["binary_little_endian", "binary_big_endian"] {
        let header = SCAN[..SCAN.find("end_header").unwrap()].replace("ascii", order) + "end_header\n";
        let mut bytes = header.into_bytes();
        let big = order.contains("big");
        for v in [[0.0f32, 0.0, 1.0], [1.0, 0.0, 2.0], [2.0, 0.0, 3.0], [0.0, 1.0, 1.0], [1.0, 1.0, 2.0]].concat() {
            bytes.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() });
        }
        for index in 0..5i32 {
            bytes.push(1);
            bytes.extend(if big { index.to_be_bytes() } else { index.to_le_bytes() });
        }
        bytes.push(0);
        std::fs::write(folder.path().join("scan.ply"), &bytes).unwrap();
        let same = read(&folder, "a.conf", true).unwrap();
        assert_eq!(format!("{:?}", same.maps[0].ranges), format!("{:?}", map.ranges));
        std::fs::write(folder.path().join("scan.ply"), &bytes[..bytes.len() - 9]).unwrap();
        assert!(read(&folder, "a.conf", true).unwrap_err().contains("cut short"));
    }
}

#[test]
fn damaged_scans_are_refused() {
    let conf = "bmesh scan.ply 0 0 0 0 0 0 1\n";
    for (scan, word) in [
        (SCAN.replace("1 4\n0\n", "1 9\n0\n"), "vertex 9"),
        (SCAN.replace("num_cols 3", "num_cols 4"), "6 cells"),
        (SCAN.replace("2 0 3", "2 x 3"), "`x`"),
        (SCAN.replace("obj_info num_cols 3\n", ""), "no range scan"),
        (SCAN[..40].to_owned(), "end_header"),
        (String::new(), "end_header"),
        (SCAN.replace("vertex 5", "vertex 99999999999"), "cut short"),
    ] {
        let folder = folder_with(&[("a.conf", conf.into()), ("scan.ply", scan.clone().into())]);
        let said = read(&folder, "a.conf", false).unwrap_err();
        assert!(said.contains(word) || said.contains("not a number"), "{scan}: {said}");
    }
    for (conf, word) in [
        ("bmesh scan.ply 0 0 0 0 0 0 2", "not rigid"),
        ("bmesh scan.ply 0 0 0", "seven numbers"),
        ("nothing", "lists no scan"),
    ] {
        let folder = folder_with(&[("a.conf", conf.into()), ("scan.ply", SCAN.into())]);
        let said = read(&folder, "a.conf", false).unwrap_err();
        assert!(said.contains(word), "{said}");
    }
}

#[test]
fn depth_pictures_with_a_description() {
    let depths: Vec<u16> = (0..12u16).map(|n| if n == 5 { 0 } else { 2000 }).collect();
    let description = "version = 1\nnoise = 0.01\nscale = 0.001\ncamera = { focal = [2, 2], centre = [1.5, 1] }\n\
        [[map]]\nfile = \"a.png\"\npose = [[1,0,0,5],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\nconfidence = \"amp.png\"\nnoise_table = [[0, 0.02], [100, 0.01]]\n";
    let amplitudes: Vec<u16> = (0..12u16).map(|n| if n < 6 { 0 } else { 200 }).collect();
    let folder = folder_with(&[
        ("set.toml", description.into()),
        ("a.png", picture(4, 3, &depths)),
        ("amp.png", picture(4, 3, &amplitudes)),
    ]);
    let set = read(&folder, "set.toml", false).unwrap();
    let map = &set.maps[0];
    assert_eq!((map.width, map.height, map.count(), map.noise), (4, 3, 11, Some(0.01)));
    assert!(map.ranges[5].is_nan());
    // Depths go along the axis, ranges along the rays.
    let p = map.points(1).next().unwrap();
    assert!((p - DVec3::new(5.0 - 1.5, -1.0, 2.0)).length() < 1e-6, "{p}");
    assert!((map.weights[0] - 0.25).abs() < 1e-6 && map.weights[11] == 1.0);
    assert!(distance(map, DVec3::new(5.2, 0.6, 1.8)) > 0.15);
    for (from, to, word) in [
        ("version = 1", "version = 2", "version 2"),
        ("noise = 0.01", "nois = 0.01", "nois"),
        ("[1,0,0,5]", "[2,0,0,5]", "not rigid"),
        ("focal = [2, 2]", "focal = [0, 2]", "focal"),
        ("scale = 0.001", "scale = -1", "scale"),
        ("[0, 0.02], [100, 0.01]", "[100, 0.02], [0, 0.01]", "noise_table"),
        ("a.png\"", "a.jpg\"", "a.jpg"),
        ("noise = 0.01", "units = 0", "units"),
        ("noise = 0.01", "background = \"black\"", "background"),
    ] {
        std::fs::write(folder.path().join("set.toml"), description.replacen(from, to, 1)).unwrap();
        let said = read(&folder, "set.toml", false).unwrap_err();
        assert!(said.contains(word), "{to}: {said}");
    }
    std::fs::write(folder.path().join("set.toml"), description).unwrap();
    let whole = picture(4, 3, &depths);
    std::fs::write(folder.path().join("a.png"), &whole[..whole.len() / 2]).unwrap();
    assert!(read(&folder, "set.toml", false).is_err());
    std::fs::write(folder.path().join("a.png"), picture(4, 3, &[0; 12])).unwrap();
    assert!(read(&folder, "set.toml", false).unwrap_err().contains("no range map"));
}

#[test]
fn ptx_scans() {
    let mut text = String::from("4\n3\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n7 0 0 1\n");
    let angle = |column: i32, row: i32| (0.1 * f64::from(column) - 3.1, 0.2 - 0.1 * f64::from(row));
    for column in 0..4 {
        for row in 0..3 {
            let (azimuth, elevation) = angle(column, row);
            let d = DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
            let p = if (column, row) == (1, 1) { DVec3::ZERO } else { d * 5.0 };
            text += &format!("{} {} {} 0.5\n", p.x, p.y, p.z);
        }
    }
    let folder = folder_with(&[("a.ptx", text.clone().into())]);
    let set = read(&folder, "a.ptx", false).unwrap();
    let map = &set.maps[0];
    assert_eq!((map.width, map.height, map.count()), (4, 3, 11));
    assert!(set.warnings.is_empty(), "{:?}", set.warnings);
    let (azimuth, elevation) = angle(2, 1);
    let d = DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
    assert!((distance(map, d * 4.0 + DVec3::X * 7.0) - 1.0).abs() < 1e-5);
    for (bad, word) in [
        (text[..=text[..text.len() / 2].rfind('\n').unwrap()].to_owned(), "cut short"),
        (text.replace("7 0 0 1", "7 0 0"), "four numbers"),
        (text.replacen("1 0 0 0", "3 0 0 0", 1), "not rigid"),
        (text.replacen("4\n3", "4\n0", 1), "no scan"),
        (text.replacen("0.5", "abc", 1), "wanted"),
    ] {
        let folder = folder_with(&[("a.ptx", bad.into())]);
        let said = read(&folder, "a.ptx", false).unwrap_err();
        assert!(said.contains(word), "{said}");
    }
}

#[test]
fn low_pass_keeps_jumps_and_edges_are_not_trusted() {
    let (width, height) = (40, 20);
    let ranges: Vec<f32> = (0..width * height)
        .map(|n| if n % width < 20 { 1.0 + if n % 2 == 0 { 0.01 } else { -0.01 } } else { 5.0 })
        .collect();
    let mut map = RangeMap {
        name: String::new(),
        projection: Projection::Orthographic { first: DVec2::ZERO, pitch: DVec2::splat(0.1) },
        pose: DAffine3::IDENTITY,
        width,
        height,
        colors: Vec::new(),
        weights: vec![1.0; ranges.len()],
        ranges,
        noise: None,
        background: Background::Unknown,
    };
    map.low_pass(|_| 1.5, 0.5);
    assert!((map.range(10, 10) - 1.0).abs() < 1e-3 && map.range(20, 10) == 5.0);
    map.distrust_edges(0.5);
    let weight = |u: usize| map.weights[10 * width + u];
    assert!(weight(19) < 0.4 && weight(18) == 1.0 && weight(20) < 0.4, "{} {}", weight(19), weight(18));
}

/// The points of a turning head at the origin, three rows of four columns on a ball of five; the second of the second column is missing.
fn turned() -> Vec<(i64, i64, DVec3)> {
    let mut points = Vec::new();
    for column in 0..4i64 {
        for row in 0..3i64 {
            let (azimuth, elevation) = (0.1 * column as f64 - 3.1, 0.2 - 0.1 * row as f64);
            let d = DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
            if (column, row) != (1, 1) {
                points.push((column, row, d * 5.0));
            }
        }
    }
    points
}

/// An E57 file of these points at x = 7, with or without rows and columns, pose and colours.
fn e57_file(places: bool, posed: bool) -> Vec<u8> {
    use ::e57::{E57Writer, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform, Translation};
    let mut file = std::io::Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut file, "file").unwrap();
    let mut records = vec![Record::CARTESIAN_X_F64, Record::CARTESIAN_Y_F64, Record::CARTESIAN_Z_F64];
    for name in [RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue] {
        records.push(Record { name, data_type: RecordDataType::U8 });
    }
    if places {
        for name in [RecordName::RowIndex, RecordName::ColumnIndex] {
            records.push(Record { name, data_type: RecordDataType::U16 });
        }
    }
    let mut cloud = writer.add_pointcloud("cloud", records).unwrap();
    let (rotation, translation) =
        (Quaternion { w: 1.0, x: 0.0, y: 0.0, z: 0.0 }, Translation { x: 7.0, y: 0.0, z: 0.0 });
    cloud.set_transform(posed.then_some(Transform { rotation, translation }));
    for (column, row, p) in turned() {
        let mut values = vec![RecordValue::Double(p.x), RecordValue::Double(p.y), RecordValue::Double(p.z)];
        values.extend([255, 0, 60 * column].map(RecordValue::Integer));
        if places {
            values.extend([row, column].map(RecordValue::Integer));
        }
        cloud.add_point(values).unwrap();
    }
    cloud.finalize().unwrap();
    writer.finalize().unwrap();
    drop(writer);
    file.into_inner()
}

#[test]
fn e57_scans() {
    for (places, posed) in [(true, true), (true, false), (false, true)] {
        let folder = folder_with(&[("a.e57", e57_file(places, posed))]);
        let set = read(&folder, "a.e57", false).unwrap();
        let map = &set.maps[0];
        // Loose points may share a pixel.
        assert!(map.count() == 11 || !places && map.count() >= 5, "{places} {posed}");
        let place = if posed { DVec3::X * 7.0 } else { DVec3::ZERO };
        let to_scanner = map.pose.inverse();
        for (column, _, p) in turned() {
            let color = map.color(&to_scanner, p + place);
            assert!((distance(map, p * 0.8 + place) - 1.0).abs() < 1e-5);
            assert!(color == Some([255, 0, 60 * column as u8]) || !places && color.is_some_and(|c| c[0] == 255));
        }
        assert!(!places || (map.width, map.height) == (4, 3));
    }
    let whole = e57_file(true, true);
    let mut flipped = whole.clone();
    flipped[100] ^= 1;
    for (bytes, word) in [
        (whole[..whole.len() / 2].to_vec(), "no E57 file"),
        (flipped, "no E57 file"),
        (b"nothing".to_vec(), "no E57 file"),
        (e57_file(false, false), "no range map"),
    ] {
        let said = read(&folder_with(&[("a.e57", bytes)]), "a.e57", false).unwrap_err();
        assert!(said.contains(word), "{said}");
    }
}

#[test]
fn depths_of_exr_and_colours() {
    use ::exr::prelude::{
        AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes, WritableImage,
    };
    let depths: Vec<f32> = (0..12).map(|n| [2.0, f32::NAN, f32::INFINITY, -1.0][if n < 4 { n } else { 0 }]).collect();
    let file = |names: &[&str]| {
        let channels = names.iter().map(|name| AnyChannel::new(*name, FlatSamples::F32(depths.clone())));
        let channels = AnyChannels::sort(channels.collect());
        let layer = Layer::new((4, 3), LayerAttributes::named("all"), Encoding::UNCOMPRESSED, channels);
        let mut bytes = std::io::Cursor::new(Vec::new());
        Image::from_layer(layer).write().to_buffered(&mut bytes).unwrap();
        bytes.into_inner()
    };
    let mut colors = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut colors, 4, 3);
    encoder.set_color(::png::ColorType::Rgb);
    let data: Vec<u8> = (0..36).collect();
    encoder.write_header().unwrap().write_image_data(&data).unwrap();
    let description =
        "version = 1\ncamera = { focal = [2, 2], centre = [1.5, 1] }\n[[map]]\nfile = \"a.exr\"\ncolor = \"c.png\"\n";
    let folder = folder_with(&[
        ("set.toml", description.into()),
        ("a.exr", file(&["A", "Z"])),
        ("b.exr", file(&["A", "B"])),
        ("c.png", colors),
        ("d.png", picture(2, 2, &[0; 4])),
    ]);
    let set = read(&folder, "set.toml", false).unwrap();
    let map = &set.maps[0];
    // What is no positive number is no measurement.
    assert_eq!((map.width, map.height, map.count()), (4, 3, 9));
    let p = map.points(1).last().unwrap();
    assert!((p - DVec3::new(1.5, 1.0, 2.0)).length() < 1e-6, "{p}");
    assert_eq!(map.color(&map.pose.inverse(), p), Some([33, 34, 35]));
    for (from, to, word) in
        [("a.exr", "b.exr", "one named Z"), ("c.png", "d.png", "2 x 2"), ("c.png", "e.png", "no such file")]
    {
        std::fs::write(folder.path().join("set.toml"), description.replacen(from, to, 1)).unwrap();
        let said = read(&folder, "set.toml", false).unwrap_err();
        assert!(said.contains(word), "{said}");
    }
    let whole = std::fs::read(folder.path().join("a.exr")).unwrap();
    std::fs::write(folder.path().join("set.toml"), description).unwrap();
    for bytes in [&whole[..whole.len() / 2], &b"nothing"[..]] {
        std::fs::write(folder.path().join("a.exr"), bytes).unwrap();
        assert!(read(&folder, "set.toml", false).is_err());
    }
}

#[test]
fn noise_is_estimated_beside_jumps_and_where_depths_come_in_steps() {
    const WIDTH: usize = 160;
    let projection = Projection::Orthographic { first: DVec2::ZERO, pitch: DVec2::ONE };
    // Four uniform numbers that are the same everywhere make a normal one.
    let normal = |at: usize| {
        let uniform = |k: usize| {
            let h = (at * 4 + k + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15_u64 as usize);
            let h = (h ^ h >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9_u64 as usize);
            (h >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        (0..4).map(uniform).sum::<f64>() * 3f64.sqrt()
    };
    for (noise, step) in [(0.02, 0.0), (0.02, 0.02), (0.01, 0.04)] {
        let depth = |at: usize| {
            // A slope with a jump in each row.
            let (u, v) = (at % WIDTH, at / WIDTH);
            let depth = 5.0 + 0.003 * u as f64 + f64::from(u8::from(u > 40 + v % 60)) + noise * normal(at);
            if step > 0.0 { ((depth / step).round() * step) as f32 } else { depth as f32 }
        };
        let ranges: Vec<f32> = (0..WIDTH * 120).map(depth).collect();
        let map = RangeMap::new("steps".into(), projection, DAffine3::IDENTITY, WIDTH, ranges);
        let expected = f64::hypot(noise, step / 12f64.sqrt());
        let estimated = map.estimated_noise().unwrap();
        println!("noise {noise} in steps of {step}: {estimated:.5} of {expected:.5}");
        // Steps larger than the noise are not normal.
        let tolerance = if step > noise { 0.5 } else { 0.1 };
        assert!((estimated / expected - 1.0).abs() < tolerance, "{noise} {step}: {estimated} {expected}");
    }
}
