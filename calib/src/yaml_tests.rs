//! Accepted and rejected input of the YAML reader.

use super::*;

fn parse(text: &str) -> Result<YamlFile, String> {
    let root = YamlFile::parse(&format!("%YAML:1.0\n---\n{text}"))?;
    Ok(YamlFile { path: "x.yml".into(), root })
}

#[test]
fn the_ways_in_which_opencv_and_people_write() {
    let text = "# by hand\nnames: [ \"a\", 'b', c ]\nflat:\n- \"01\"\n- x # told\n\"quoted\": 7.5\nK: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   \
                data: [ 1., -2.5e-3,\n       +3, .5 ]\nempty:\nlast: !!str yes\n";
    let file = parse(text).unwrap();
    assert_eq!(file.keys().collect::<Vec<_>>(), ["K", "empty", "flat", "last", "names", "quoted"]);
    assert_eq!(file.strings("names").unwrap(), ["a", "b", "c"]);
    assert_eq!(file.strings("flat").unwrap(), ["01", "x"]);
    assert_eq!((file.number("quoted"), file.number("names"), file.number("last")), (Some(7.5), None, None));
    let matrix = file.matrix(&"a".into(), "K").unwrap().unwrap();
    assert_eq!(matrix, Matrix { rows: 2, cols: 2, values: vec![1.0, -0.0025, 3.0, 0.5] });
    assert_eq!(parse("names:\n   - 00\n   - 01\n").unwrap().strings("names"), None, "numbers, to YAML");
}

#[test]
fn damage_is_named_with_its_line() {
    for (text, expected) in [
        ("a: 1\n  b: 2\n", "line 4: "),
        ("a: [ 1,\n 2\n", "line "),
        ("a: 1\na: 2\n", "line 4: key \"a\" is there twice"),
        ("? [1]\n: 2\n", "line 3: a key that is a list or a map"),
        ("- 1\n", "expected keys with values"),
        ("", "no keys in it"),
    ] {
        let found = parse(text).err().unwrap();
        assert!(found.contains(expected), "{text}: {found}");
    }
    let file = parse(
        "K: !!opencv-matrix\n  rows: 1e300\n  cols: 3\n  data: [ 1 ]\nL:\n  rows: 2\n  cols: 3\n  data: [ inf ]\n",
    )
    .unwrap();
    for key in ["K", "L"] {
        assert!(file.matrix(&"a".into(), key).unwrap_err().to_string().contains("cannot be read as a matrix"));
    }
}
