//! The one-line grammar of shapes and regions: `sphere center=0,0,1 radius=2`.

use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use glam::{DMat3, DQuat, DVec3};

use crate::error::{EditError, Result};

/// A kind and its `key=value` pairs. Values are read by name; [`finish`](Self::finish) refuses the keys nobody asked for.
pub struct Spec {
    what: &'static str,
    text: String,
    kind: String,
    pairs: Vec<(String, String, Cell<bool>)>,
}

impl Spec {
    /// Splits a specification of `what` (`shape`, `region`). A value with spaces is written in double quotes.
    pub fn parse(what: &'static str, text: &str) -> Result<Self> {
        let words = split(text).ok_or_else(|| refuse(what, text, "the double quote must be closed"))?;
        let mut words = words.into_iter();
        let kind = words
            .next()
            .ok_or_else(|| refuse(what, text, "a kind, then key=value, as in `sphere center=0,0,0 radius=1`"))?;
        let mut pairs: Vec<(String, String, Cell<bool>)> = Vec::new();
        for word in words {
            let (key, value) =
                word.split_once('=').ok_or_else(|| refuse(what, text, format!("key=value, `{word}` has no `=`")))?;
            if pairs.iter().any(|p| p.0 == key) {
                return Err(refuse(what, text, format!("each key once, `{key}` is given twice")));
            }
            pairs.push((key.into(), value.into(), Cell::new(false)));
        }
        Ok(Self { what, text: text.into(), kind, pairs })
    }

    /// The first word.
    pub fn kind(&self) -> &str {
        &self.kind
    }

    /// The error for a kind that is none of `known`.
    pub fn unknown_kind(&self, known: &[&str]) -> EditError {
        refuse(self.what, &self.text, suggest(&self.kind, known.iter().copied()))
    }

    /// An error about this specification; `accepted` says what would work.
    pub fn refuse(&self, accepted: impl Into<String>) -> EditError {
        refuse(self.what, &self.text, accepted)
    }

    /// The text of a key, if it is there.
    pub fn text(&self, key: &str) -> Option<&str> {
        let pair = self.pairs.iter().find(|p| p.0 == key)?;
        pair.2.set(true);
        Some(&pair.1)
    }

    fn required<T>(&self, key: &str, kind: &str, value: Result<Option<T>>) -> Result<T> {
        value?.ok_or_else(|| refuse(self.what, &self.text, format!("`{}` needs `{key}=` ({kind})", self.kind)))
    }

    fn parsed<T>(&self, key: &str, kind: &str, read: impl Fn(&str) -> Option<T>) -> Result<Option<T>> {
        let Some(text) = self.text(key) else { return Ok(None) };
        read(text)
            .map(Some)
            .ok_or_else(|| refuse(self.what, &self.text, format!("`{key}` must be {kind}, not `{text}`")))
    }

    /// A finite number.
    pub fn number(&self, key: &str) -> Result<Option<f64>> {
        self.parsed(key, "a finite number", |t| f64::from_str(t.trim()).ok().filter(|v| v.is_finite()))
    }

    /// A length: positive and finite.
    pub fn length(&self, key: &str) -> Result<f64> {
        let value =
            self.parsed(key, "a positive number", |t| f64::from_str(t).ok().filter(|v| *v > 0.0 && v.is_finite()));
        self.required(key, "a positive number", value)
    }

    fn numbers<const N: usize>(&self, key: &str, kind: &str) -> Result<Option<[f64; N]>> {
        self.parsed(key, kind, |t| {
            let parts: Vec<f64> =
                t.split(',').map(|p| p.trim().parse().ok().filter(|v: &f64| v.is_finite())).collect::<Option<_>>()?;
            parts.try_into().ok()
        })
    }

    /// Two numbers.
    pub fn pair(&self, key: &str) -> Result<Option<[f64; 2]>> {
        self.numbers(key, "two finite numbers `a,b`")
    }

    /// Three numbers, if the key is there.
    pub fn vector(&self, key: &str) -> Result<Option<DVec3>> {
        Ok(self.numbers::<3>(key, "three finite numbers `x,y,z`")?.map(DVec3::from))
    }

    /// Three numbers.
    pub fn required_vector(&self, key: &str) -> Result<DVec3> {
        self.required(key, "x,y,z", self.vector(key))
    }

    /// `center=`, the origin where it is not given.
    pub fn center(&self) -> Result<DVec3> {
        Ok(self.vector("center")?.unwrap_or(DVec3::ZERO))
    }

    /// Local axes as columns, the third along `axis=` (`x`, `y`, `z` or a vector; z where it is not given), then turned by `rotate=`.
    pub fn axes(&self) -> Result<DMat3> {
        let axis = match self.text("axis") {
            None | Some("z") => DVec3::Z,
            Some("x") => DVec3::X,
            Some("y") => DVec3::Y,
            Some(_) => self
                .required_vector("axis")?
                .try_normalize()
                .ok_or_else(|| self.refuse("`axis` must be x, y, z or a vector that is not zero"))?,
        };
        let aligned = DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, axis));
        let turned = match self.text("rotate") {
            None => DMat3::IDENTITY,
            Some(text) => DMat3::from_quat(parse_rotation(text).map_err(|accepted| self.refuse(accepted))?),
        };
        Ok(turned * aligned)
    }

    /// Refuses keys that were not read.
    pub fn finish(&self) -> Result<()> {
        match self.pairs.iter().find(|p| !p.2.get()) {
            None => Ok(()),
            Some((key, ..)) => {
                let known = self.pairs.iter().filter(|p| p.2.get()).map(|p| p.0.as_str());
                Err(self.refuse(format!(
                    "`{}` has no key `{key}` (used here: {})",
                    self.kind,
                    known.collect::<Vec<_>>().join(", ")
                )))
            }
        }
    }
}

/// A rotation: `axis,degrees` with axis x, y or z, or a quaternion `x,y,z,w`; otherwise what would be accepted.
pub fn parse_rotation(text: &str) -> Result<DQuat, String> {
    let accepted = || format!("`axis,degrees` such as `z,90`, or a quaternion `x,y,z,w`, not `{text}`");
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let number = |t: &str| t.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(accepted);
    match parts[..] {
        [axis, degrees] => {
            let radians = number(degrees)?.to_radians();
            let axis = match axis {
                "x" | "X" => DVec3::X,
                "y" | "Y" => DVec3::Y,
                "z" | "Z" => DVec3::Z,
                _ => return Err(accepted()),
            };
            Ok(DQuat::from_axis_angle(axis, radians))
        }
        [x, y, z, w] => {
            let q = DQuat::from_xyzw(number(x)?, number(y)?, number(z)?, number(w)?);
            if q.length() > 1e-12 { Ok(q.normalize()) } else { Err(accepted()) }
        }
        _ => Err(accepted()),
    }
}

/// A specification whose relative files begin in `folder`, and those files.
///
/// Files are the values of `file` and, for a `curve`, of `a` and `b`; all else stays as it is, wrong or not.
pub fn rebased(text: &str, folder: &Path) -> (String, Vec<PathBuf>) {
    let keys: &[&str] = match text.split_whitespace().any(|word| word == "curve") {
        true => &["file=", "a=", "b="],
        false => &["file="],
    };
    let (mut out, mut files) = (String::new(), Vec::new());
    let mut rest = text;
    while let Some(space) = rest.find(char::is_whitespace) {
        let (before, after) = rest.split_at(space + rest[space..].chars().next().map_or(1, char::len_utf8));
        out.push_str(before);
        rest = after;
        let Some(key) = keys.iter().find(|key| rest.starts_with(**key)) else { continue };
        let value = &rest[key.len()..];
        // A quoted value ends with its quote; another at a space, or where an expression goes on.
        let (name, end) = match value.strip_prefix('"') {
            Some(quoted) => match quoted.find('"') {
                Some(end) => (&quoted[..end], end + 2),
                None => continue,
            },
            None => {
                let end = value.find(|c: char| c.is_whitespace() || matches!(c, ',' | ')' | '"'));
                let end = end.unwrap_or(value.len());
                (&value[..end], end)
            }
        };
        if !name.is_empty() {
            let path = folder.join(name);
            out.push_str(&format!("{key}\"{}\"", path.display()));
            files.push(path);
            rest = &value[end..];
        }
    }
    out.push_str(rest);
    (out, files)
}

/// "did you mean", or the list of what there is.
pub fn suggest<'a>(given: &str, known: impl Iterator<Item = &'a str>) -> String {
    let known: Vec<&str> = known.collect();
    let near = known.iter().map(|k| (strsim::damerau_levenshtein(given, k), *k)).min();
    match near {
        Some((distance, name)) if distance <= 1 + name.len() / 3 => format!("did you mean `{name}`?"),
        _ => format!("there are {}", known.join(", ")),
    }
}

fn refuse(what: &str, text: &str, accepted: impl Into<String>) -> EditError {
    EditError::parameter(what, "specification", format!("`{text}`"), accepted)
}

/// Splits at white space outside double quotes; `None` if a quote is not closed.
fn split(text: &str) -> Option<Vec<String>> {
    let mut words = Vec::new();
    let mut word = String::new();
    let mut quoted = false;
    for c in text.chars() {
        match c {
            '"' => quoted = !quoted,
            c if c.is_whitespace() && !quoted => {
                if !word.is_empty() {
                    words.push(std::mem::take(&mut word));
                }
            }
            c => word.push(c),
        }
    }
    if !word.is_empty() {
        words.push(word);
    }
    (!quoted).then_some(words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_is_asked_and_refuses_the_rest() {
        let spec = Spec::parse("region", "sphere  center=-1,2.5,3e-1 radius=2 file=\"a b.vdb\"").unwrap();
        assert_eq!(spec.kind(), "sphere");
        assert_eq!(spec.center().unwrap(), DVec3::new(-1.0, 2.5, 0.3));
        assert_eq!(spec.length("radius").unwrap(), 2.0);
        assert!(spec.finish().unwrap_err().to_string().contains("`file`"));
        assert_eq!(spec.text("file"), Some("a b.vdb"));
        spec.finish().unwrap();
    }

    #[test]
    fn errors_say_what_would_work() {
        let error = |text: &str, read: fn(&Spec) -> Result<()>| {
            Spec::parse("shape", text).and_then(|s| read(&s)).unwrap_err().to_string()
        };
        assert!(error("", |_| Ok(())).contains("a kind"));
        assert!(error("sphere radius", |_| Ok(())).contains("no `=`"));
        assert!(error("sphere r=1 r=2", |_| Ok(())).contains("twice"));
        assert!(error("sphere f=\"a", |_| Ok(())).contains("quote"));
        assert!(error("sphere", |s| s.length("radius").map(drop)).contains("needs `radius=`"));
        assert!(error("sphere radius=-1", |s| s.length("radius").map(drop)).contains("positive"));
        assert!(error("sphere center=1,2", |s| s.center().map(drop)).contains("three finite numbers"));
        assert!(error("torus axis=0,0,0", |s| s.axes().map(drop)).contains("not zero"));
        assert!(error("spere", |s| Err(s.unknown_kind(&["sphere", "box"]))).contains("did you mean `sphere`"));
    }

    #[test]
    fn files_of_specifications_begin_in_a_folder() {
        let folder = Path::new("r");
        let (text, files) = rebased("or curve a=x.vdb b=\"y z.vdb\" d=7,9", folder);
        assert_eq!(text, "or curve a=\"r/x.vdb\" b=\"r/y z.vdb\" d=7,9");
        assert_eq!(files, [PathBuf::from("r/x.vdb"), "r/y z.vdb".into()]);
        assert_eq!(rebased("capsule a=0,0,0 b=1,0,0 radius=1", folder).0, "capsule a=0,0,0 b=1,0,0 radius=1");
        assert_eq!(rebased("mask file=/m.vdb", folder).1, [PathBuf::from("/m.vdb")]);
        assert_eq!(rebased("mask file=\"m", folder).0, "mask file=\"m");
        let (text, files) = rebased("union(bezier file=p.bpt, sphere radius=1, bezier file=q.bpt)", folder);
        assert_eq!(text, "union(bezier file=\"r/p.bpt\", sphere radius=1, bezier file=\"r/q.bpt\")");
        assert_eq!(files.len(), 2);
    }

    #[test]
    fn rotations_and_axes() {
        let quarter = parse_rotation("z,90").unwrap();
        assert!((quarter * DVec3::X - DVec3::Y).length() < 1e-15);
        assert!((parse_rotation("0,0,0.7071,0.7071").unwrap() * DVec3::X - DVec3::Y).length() < 1e-12);
        for bad in ["90", "w,90", "0,0,0,0", "z,inf", "1,2,3"] {
            assert!(parse_rotation(bad).is_err(), "{bad}");
        }
        let axes = Spec::parse("shape", "torus axis=y").unwrap().axes().unwrap();
        assert!((axes * DVec3::Z - DVec3::Y).length() < 1e-15);
    }
}
