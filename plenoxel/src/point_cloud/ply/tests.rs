use super::*;
use crate::point_cloud::{PointCloud, ScalarField};
use crate::random::{Purpose, bits};

fn parse(bytes: &[u8]) -> Result<PlyFile> {
    PlyFile::parse(Path::new("cloud.ply"), bytes.to_vec())
}

fn cloud() -> PointCloud {
    let n = 5u8;
    let of = |f: &dyn Fn(f32) -> f32| (0..n).map(|i| f(f32::from(i))).collect::<Vec<f32>>();
    PointCloud {
        positions: (0..n).map(|i| DVec3::new(f64::from(i), 0.1f32.into(), -2.5)).collect(),
        colors: Some((0..n).map(|i| [i, 10 * i, 255 - i]).collect()),
        normals: Some((0..n).map(|i| [0.0, 1.0, f32::from(i)]).collect()),
        fields: vec![
            ScalarField { name: "opacity".into(), values: of(&|i| i / 7.0) },
            ScalarField { name: "C2C_distances[<3]".into(), values: of(&|i| if i == 2.0 { f32::NAN } else { -i }) },
        ],
    }
}

/// Reads everything about the points, with colors as whole numbers up to 255.
fn read_cloud(file: &PlyFile) -> Result<PointCloud> {
    let three = |names: [&[&str]; 3]| -> Result<Option<Vec<[f64; 3]>>> {
        let [Some(a), Some(b), Some(c)] = names.map(|names| file.property(names)) else { return Ok(None) };
        file.each(|row| Ok([file.value(row, a)?, file.value(row, b)?, file.value(row, c)?])).map(Some)
    };
    let colors = three(COLORS)?.map(|colors| colors.into_iter().map(|c| c.map(|c| c as u8)).collect());
    let normals = three(NORMALS)?.map(|normals| normals.into_iter().map(|n| n.map(|n| n as f32)).collect());
    let field = |name: &str| Ok(ScalarField { name: name.to_owned(), values: file.values(name)? });
    Ok(PointCloud {
        positions: file.positions()?,
        colors,
        normals,
        fields: file.field_names().into_iter().map(field).collect::<Result<_>>()?,
    })
}

/// Compares clouds; NaN equals NaN.
fn same(a: &PointCloud, b: &PointCloud) -> bool {
    let fields = |c: &PointCloud| {
        c.fields.iter().map(|f| (f.name.clone(), f.values.iter().map(|v| v.to_bits()).collect())).collect::<Vec<(_, Vec<_>)>>()
    };
    a.positions == b.positions && a.colors == b.colors && a.normals == b.normals && fields(a) == fields(b)
}

/// Returns a file as other programs write it: several elements, lists, unusual properties and names, in all encodings.
fn foreign(encoding: Encoding) -> Vec<u8> {
    let name = match encoding {
        Encoding::Ascii => "ascii",
        Encoding::LittleEndian => "binary_little_endian",
        Encoding::BigEndian => "binary_big_endian",
    };
    let header = format!(
        "ply\r\nformat {name} 1.0\ncomment made by hand: ä\nobj_info num_cols 3\nelement camera 1\nproperty list uchar float view\nproperty int32 id\n\
         element vertex 3\nproperty double X\nproperty list uint8 int links\nproperty double y\nproperty float64 z\nproperty uchar red\n\
         property uchar green\nproperty uchar blue\nproperty float scalar_Coord._Z\nproperty short label\n\
         element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    );
    let mut file = header.into_bytes();
    let mut put = |value: f64, number: Number| {
        // Each row of a text is a line.
        if value.is_infinite() {
            return if encoding == Encoding::Ascii {
                file.push(b'\n')
            };
        }
        let mut bytes = match number {
            _ if encoding == Encoding::Ascii => format!("{value} ").into_bytes(),
            Number::U8 => vec![value as u8],
            Number::I16 => (value as i16).to_le_bytes().to_vec(),
            Number::I32 => (value as i32).to_le_bytes().to_vec(),
            Number::F32 => (value as f32).to_le_bytes().to_vec(),
            _ => value.to_le_bytes().to_vec(),
        };
        if encoding == Encoding::BigEndian {
            bytes.reverse();
        }
        file.extend(bytes);
    };
    const END: (f64, Number) = (f64::INFINITY, Number::U8);
    [(2.0, Number::U8), (0.5, Number::F32), (1.5, Number::F32), (-7.0, Number::I32), END].into_iter().for_each(|(v, n)| put(v, n));
    for i in 0..3u8 {
        let f = f64::from(i);
        put(4_500_000.125 + f, Number::F64);
        put(f, Number::U8);
        (0..i).for_each(|j| put(f64::from(j) - 1.0, Number::I32));
        put(f / 3.0, Number::F64);
        put(-f, Number::F64);
        [f, 128.0, 255.0].into_iter().for_each(|c| put(c, Number::U8));
        put(if i == 1 { f64::NAN } else { 0.25 * f }, Number::F32);
        put(-300.0 + f, Number::I16);
        put(END.0, END.1);
    }
    put(3.0, Number::U8);
    [0.0, 1.0, 2.0, END.0].into_iter().for_each(|v| put(v, Number::I32));
    file
}

const ENCODINGS: [Encoding; 3] = [Encoding::Ascii, Encoding::LittleEndian, Encoding::BigEndian];

#[test]
fn what_is_written_is_read_again_to_the_last_bit() {
    let mut cloud = cloud();
    let read = |cloud: &PointCloud| parse(&encode(cloud, &["voxel_side 0.5".into()])).unwrap();
    let file = read(&cloud);
    assert_eq!(file.header().remarks[0], "comment voxel_side 0.5");
    let names: Vec<&str> = file.element().properties.iter().map(|p| &p.name[..]).collect();
    let expected = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "scalar_opacity", "scalar_C2C_distances[<3]", "quality"];
    assert_eq!(names, expected);
    let mut again = read_cloud(&file).unwrap();
    // MeshLab's copy of the first field.
    let quality = again.fields.pop().unwrap();
    assert!(quality.name == "quality" && quality.values == cloud.fields[0].values);
    assert!(same(&again, &cloud), "{again:?}");

    // A coordinate that is not a `float` makes all of them `double`.
    cloud.positions[3].x = 1e6 + 0.1;
    let file = read(&cloud);
    assert_eq!(file.element().properties[0].kind, Kind::Scalar(Number::F64));
    assert_eq!(file.positions().unwrap(), cloud.positions);
    assert_eq!(read(&PointCloud::default()).len(), 0);
}

#[test]
fn clouds_of_others_are_read_in_every_encoding_and_keep_everything_when_some_points_are_chosen() {
    for encoding in ENCODINGS {
        let file = parse(&foreign(encoding)).unwrap();
        let cloud = read_cloud(&file).unwrap();
        assert_eq!(cloud.positions[1], DVec3::new(4_500_001.125, 1.0 / 3.0, -1.0), "{encoding:?}");
        assert_eq!(cloud.colors, Some(vec![[0, 128, 255], [1, 128, 255], [2, 128, 255]]));
        assert_eq!(file.field_names(), ["Coord._Z", "label"]);
        let field = |name: &str| cloud.field(name).unwrap();
        assert!(field("Coord._Z")[1].is_nan() && field("Coord._Z")[2] == 0.5 && field("label") == [-300.0, -299.0, -298.0]);
        assert_eq!(file.values("scalar_Coord._Z").unwrap()[2], 0.5);
        let error = file.values("height").unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains("[Coord._Z, label]"), "{error}");
        assert_eq!(file.others().map(|e| &e.name[..]).collect::<Vec<_>>(), ["camera", "face"]);

        let chosen = parse(&file.chosen(&[2, 0], "two of three")).unwrap();
        assert_eq!(chosen.header().encoding, encoding);
        assert_eq!(chosen.header().remarks, ["comment made by hand: ä", "obj_info num_cols 3", "comment two of three"]);
        assert_eq!(chosen.element().properties, file.element().properties);
        assert_eq!((chosen.others().count(), chosen.len()), (0, 2));
        let some = read_cloud(&chosen).unwrap();
        assert!(same(&some, &cloud.chosen(&[2, 0])), "{encoding:?}");
        // The list of the last point is kept too.
        let last = |file: &PlyFile| parse(&file.chosen(&[file.len() as u32 - 1], "one")).unwrap().chosen(&[0], "");
        assert_eq!(last(&parse(&file.chosen(&[0, 2], "one")).unwrap()).len(), last(&file).len() + "comment one\n".len());
    }
}

#[test]
fn each_broken_file_is_refused_with_the_place_and_the_remedy() {
    let refused = |text: &str, parts: &[&str]| {
        let error = parse(text.as_bytes()).unwrap_err();
        assert_eq!(error.exit_code(), 3, "{error}");
        assert!([&["cloud.ply"], parts].concat().iter().all(|part| error.to_string().contains(part)), "{parts:?} in {error}");
    };
    let ascii = |rest: &str| format!("ply\nformat ascii 1.0\n{rest}");
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    refused("", &["not a PLY file", "it is empty"]);
    refused("\u{89}PNG\r\n", &["not a PLY file", "PNG"]);
    refused("plyx\nend_header\n", &["line 1", "plyx"]);
    refused("ply\nformat ascii 1.0\nelement vertex 3\n", &["no `end_header`", "truncated"]);
    refused("ply\nelement vertex 0\nend_header\n", &["no line `format`"]);
    refused("ply\nformat binary 1.0\nend_header\n", &["line 2", "binary_little_endian"]);
    refused(&ascii("element vertex -3\nend_header\n"), &["line 3", "whole number"]);
    refused(&ascii("element vertex 99999999999999999999999\nend_header\n"), &["line 3"]);
    refused(&ascii("property float x\nend_header\n"), &["line 3", "an element before"]);
    refused(&ascii("element vertex 1\nproperty half x\nend_header\n"), &["line 4", "property half x", "the types char"]);
    refused(&ascii("element vertex 1\nproperty list float int x\nend_header\n"), &["line 4"]);
    refused(&ascii("element vertex 1\nvertices 3\nend_header\n"), &["line 4", "vertices 3"]);
    refused(&ascii("element face 0\nend_header\n"), &["no points", "[face]"]);
    refused(&ascii("element vertex 0\nproperty float x\nproperty list int int y\nend_header\n"), &["no property `y`", "[x, y]"]);
    refused(&ascii(&format!("element vertex 2\n{xyz}end_header\n1 2 3\n4 5")), &["2 rows of `vertex`", "ends in row 1", "truncated"]);
    for count in ["4000000000", "18446744073709551615", "5000000000"] {
        for format in ["ascii", "binary_little_endian"] {
            let text = format!("ply\nformat {format} 1.0\nelement vertex {count}\n{xyz}end_header\n1 2 3\n");
            let error = parse(text.as_bytes()).unwrap_err().to_string();
            assert!(error.contains("truncated") || error.contains("at most 4294967295"), "{error}");
        }
    }
    // Lists that announce more than the file contains, and an element without properties, which takes no bytes.
    refused(
        &format!(
            "ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty list uint double w\n{xyz}end_header\n\u{7f}\u{7f}\u{7f}\u{7f}1234567890123456"
        ),
        &["truncated"],
    );
    refused(
        &ascii(&format!("element vertex 1\nproperty list int int w\n{xyz}end_header\n1e30 1 2 3 4\n")),
        &["row 0 of `vertex` has `1e30` where a whole number from -2147483648 to 2147483647 is expected"],
    );
    refused(&ascii(&format!("element vertex 1\nproperty list uint int w\n{xyz}end_header\n4000000000 1 2 3 4\n")), &["fewer numbers"]);
    refused(&ascii(&format!("element vertex 1\nproperty list int int w\n{xyz}end_header\n-1 1 2 3 4\n")), &["list of -1 items"]);
    let nothing = ascii(&format!("element empty 4000000000\nelement vertex 1\n{xyz}end_header\n1 2 3\n"));
    assert_eq!(parse(nothing.as_bytes()).unwrap().positions().unwrap(), [DVec3::new(1.0, 2.0, 3.0)]);
    let words = ascii(&format!("element vertex 2\n{xyz}end_header\n1 2 3\n4 five 6\n"));
    refused(&words, &["row 1 of `vertex` has `five` where a number is expected"]);
}

#[test]
fn what_the_format_does_not_allow_is_not_read_as_something_else() {
    let refused = |bytes: &[u8], part: &str| {
        let error = parse(bytes).unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains(part), "{part} in {error}");
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let ascii = |more: &str, rows: &str| format!("ply\nformat ascii 1.0\nelement vertex 2\n{xyz}{more}end_header\n{rows}").into_bytes();
    // A row is a line.
    refused(&ascii("", "1 2 3 4 5 6\n7 8 9\n"), "the line of row 0 of `vertex` has more numbers");
    refused(&ascii("", "1 2\n3\n4 5 6\n"), "the line of row 0 of `vertex` has fewer numbers");
    refused(&ascii("", "1 2 3\n\n4 5 6\n"), "the line of row 1 of `vertex` has fewer numbers");
    refused(&ascii("property list uchar int w\n", "1 2 3 0\n4 5 6 2 7 8 9\n"), "the line of row 1 of `vertex` has more numbers");
    // Nothing stands behind the last.
    refused(&ascii("", "1 2 3\n4 5 6\n7 8 9\n"), "line 10 follows the last row");
    for end in ["", "\n", " \r\n\n \n"] {
        assert_eq!(parse(&ascii("", &format!("1 2 3\r\n\t4 5 6{end}"))).unwrap().positions().unwrap()[1], DVec3::new(4.0, 5.0, 6.0));
    }
    let binary = |rest: usize| {
        let mut file = format!("ply\nformat binary_little_endian 1.0\nelement vertex 2\n{xyz}end_header\n").into_bytes();
        file.extend(vec![0; 24 + rest]);
        file
    };
    refused(&binary(5), "5 bytes follow the last row");
    assert_eq!(parse(&binary(0)).unwrap().len(), 2);
    // Numbers are of their type.
    for (number, word, fits) in [
        ("uchar", "300", false),
        ("uchar", "-1", false),
        ("uchar", "255", true),
        ("uchar", "1.0", false),
        ("char", "-128", true),
        ("char", "128", false),
        ("ushort", "65536", false),
        ("int", "-2147483648", true),
        ("uint", "4294967296", false),
        ("float", "1.#QNAN", true),
        ("float", "-nan(ind)", true),
        ("int", "nan", false),
        ("double", "1,5", false),
    ] {
        let file = ascii(&format!("property {number} a\n"), &format!("1 2 3 0\n4 5 6 {word}\n"));
        match fits {
            true => assert!(parse(&file).unwrap().values("a").unwrap().len() == 2, "{number} {word}"),
            false => refused(&file, &format!("row 1 of `vertex` has `{word}` where a")),
        }
    }
    // Headers of other versions, and names that are not clear.
    let header = |text: &str| format!("ply\n{text}\nend_header\n").into_bytes();
    refused(&header("format ascii 2.0"), "line 2 of the header is `format ascii 2.0`; expected `format ENCODING 1.0`");
    refused(&header("format ascii 1.0\nformat ascii 1.0"), "line 3");
    refused(&ascii("property uchar x\n", ""), "line 7 of the header is `property uchar x`; expected a different name for each property");
    refused(&ascii("element vertex 1\n", ""), "line 7 of the header is `element vertex 1`; expected a different name for each element");
    assert_eq!(parse(&ascii("element face 1\nproperty uchar x\n", "1 2 3\n4 5 6\n7\n")).unwrap().len(), 2);
}

#[test]
fn headers_have_an_end() {
    for line in ["comment hello\n", "obj_info x\n", "element e 0\n", "property char a\n", "x"] {
        let text = format!("ply\nformat ascii 1.0\n{}", line.repeat((1 << 20) / line.len() + 1));
        let error = parse(text.as_bytes()).unwrap_err().to_string();
        // Or at the first line that says the same again.
        assert!(
            error.len() < 300 && (error.contains("longer than the limit of 1 MB") || error.contains("line 4") || error.contains("line 3")),
            "{error}"
        );
    }
    let names: String = (0..100_000).map(|i| format!("element {i} 0\n")).collect();
    let error = parse(format!("ply\nformat ascii 1.0\n{}end_header\n", &names[..names[..1_000_000].rfind("element").unwrap()]).as_bytes())
        .unwrap_err()
        .to_string();
    assert!(error.contains("no points: its elements are [0, 1, 2") && error.contains('…') && error.len() < 1500, "{error}");
}

#[test]
fn a_file_cut_short_anywhere_is_refused() {
    for encoding in ENCODINGS {
        let whole = foreign(encoding);
        // The last number of a text may lose digits and still be one; here it has one digit, and a space and a line break after it.
        let end = if encoding == Encoding::Ascii { whole.len() - 2 } else { whole.len() };
        for length in 0..end {
            let error = parse(&whole[..length]).unwrap_err();
            assert!(error.exit_code() == 3 && error.to_string().contains("cloud.ply"), "{encoding:?} cut to {length}: {error}");
        }
    }
}

#[test]
fn random_damage_gives_an_error_or_a_cloud_and_never_a_panic() {
    let seed = 11;
    for encoding in ENCODINGS {
        let whole = foreign(encoding);
        for trial in 0..3000 {
            let mut file = whole.clone();
            let random = |i: u64| bits(seed, Purpose::Initial, trial, i) as usize;
            for flip in 0..1 + random(0) as u64 % 3 {
                let at = random(3 * flip + 1) % file.len();
                file[at] = random(3 * flip + 2) as u8;
            }
            let Ok(read) = parse(&file) else { continue };
            let numbers: Vec<u32> = (0..read.len() as u32).collect();
            let again = parse(&read.chosen(&numbers, "damaged"));
            if let (Ok(cloud), Ok(again)) = (read_cloud(&read), again) {
                assert_eq!((cloud.len(), again.len()), (read.len(), read.len()), "{encoding:?}, trial {trial}");
            }
        }
    }
}
