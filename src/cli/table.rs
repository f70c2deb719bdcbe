//! Tables and numbers for people.

use comfy_table::{CellAlignment, Table, presets};
use serde_json::Value;

/// Rows of words in aligned columns, indented; the first column is left-aligned, the others right-aligned.
pub fn columns(rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    for row in rows {
        table.add_row(row);
    }
    for (index, column) in table.column_iter_mut().enumerate() {
        column.set_cell_alignment(if index == 0 { CellAlignment::Left } else { CellAlignment::Right });
    }
    let lines = table.lines().map(|line| format!(" {}\n", line.trim_end()));
    lines.collect()
}

/// A name and its value on each line.
pub fn pairs<'a>(rows: impl IntoIterator<Item = (&'a str, String)>) -> String {
    let rows: Vec<(&str, String)> = rows.into_iter().collect();
    let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    rows.iter().map(|(name, value)| format!("  {name:width$}  {value}\n")).collect()
}

/// A number with five significant digits, zeros at its end left out.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    // Rounded first, so that 9.99996 counts as 10.
    let rounded = format!("{value:.4e}");
    let (digits, exponent) = rounded.split_once('e').unwrap_or((&rounded, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let text = match exponent {
        -4..=4 => format!("{value:.*}", (4 - exponent) as usize),
        5..=14 => return format!("{value:.0}"),
        _ => return format!("{}e{exponent}", without_zeros(digits)),
    };
    without_zeros(&text).to_owned()
}

/// What a program would be told.
pub fn value(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Number(n) => match n.as_u64() {
            Some(n) => count(n),
            None => n.as_f64().map_or_else(|| n.to_string(), number),
        },
        value => value.to_string(),
    }
}

fn without_zeros(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

/// A whole number with its digits in groups of three.
pub fn count(value: u64) -> String {
    let digits = value.to_string();
    let mut out = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

/// The change from one number to another in percent.
pub fn change(before: f64, after: f64) -> String {
    if before == after {
        return "same".into();
    }
    let percent = 100.0 * (after / before - 1.0);
    if percent.is_finite() { format!("{percent:+.3} %") } else { String::new() }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn numbers_have_five_digits() {
        for (value, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.01 - 1e-17, "0.01"),
            (9.99996, "10"),
            (12345.6, "12346"),
            (-12.34567, "-12.346"),
            (0.00123456, "0.0012346"),
            (123456.7, "123457"),
            (1e-9, "1e-9"),
            (2.5e20, "2.5e20"),
        ] {
            assert_eq!(number(value), text);
        }
        assert_eq!([count(0), count(999), count(1000), count(1234567)], ["0", "999", "1,000", "1,234,567"]);
        assert_eq!(
            [json!(13764), json!(-3), json!(1.392665490040933), json!("a b")].map(|v| value(&v)),
            ["13,764", "-3", "1.3927", "a b"]
        );
        assert_eq!(change(2.0, 1.0), "-50.000 %");
        assert_eq!(change(0.0, 1.0), "");
    }

    #[test]
    fn columns_line_up() {
        let row = |a: &str, b: &str| vec![a.to_owned(), b.to_owned()];
        let text = columns([row("a", "1"), row("long", "100")]);
        let ends: Vec<usize> = text.lines().map(str::len).collect();
        assert_eq!(ends[0], ends[1]);
        assert_eq!(pairs([("a", "1".into()), ("bcd", "2".into())]), "  a    1\n  bcd  2\n");
    }
}
