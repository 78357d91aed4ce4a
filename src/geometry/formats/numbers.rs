//! Numbers and matrices of texts, checked.

use glam::{DMat3, DVec3};

use super::FormatError;
use crate::geometry::{Intrinsics, Rigid};

/// A number that comes back bit for bit.
pub(super) fn show(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 || (1e-4..1e15).contains(&size) { format!("{value}") } else { format!("{value:e}") }
}

/// That K has no skew, for a format that has no place for it, but for what rounding leaves of a P that was taken apart.
pub(super) fn right_angled(k: &Intrinsics, expected: &'static str) -> Result<(), FormatError> {
    if k.skew.abs() <= 1e-9 * k.fx.abs() {
        return Ok(());
    }
    Err(FormatError::Unsupported { key: "skew".to_owned(), found: show(k.skew), expected })
}

/// Numbers in one line.
pub(super) fn line(values: &[f64]) -> String {
    values.iter().map(|value| show(*value)).collect::<Vec<_>>().join(" ")
}

/// A finite number.
pub(super) fn number(word: &str, what: &str) -> Result<f64, FormatError> {
    let value: f64 =
        word.parse().map_err(|_| FormatError::NotNumber { what: what.to_owned(), found: word.chars().take(40).collect() })?;
    finite(value, what)
}

/// The value, unless it is NaN or infinite.
pub(super) fn finite(value: f64, what: &str) -> Result<f64, FormatError> {
    if value.is_finite() { Ok(value) } else { Err(FormatError::NotFinite { what: what.to_owned() }) }
}

/// Numbers apart from each other by blanks, commas or semicolons; a semicolon may end them.
pub(super) fn numbers(text: &str, what: &str) -> Result<Vec<f64>, FormatError> {
    let text = text.trim_end().trim_end_matches(';');
    // Between semicolons a comma is a decimal one: that is no number here, and never two.
    let comma_parts = !text.contains(';');
    text.split(|c: char| c.is_whitespace() || c == ';' || comma_parts && c == ',')
        .filter(|word| !word.is_empty())
        .map(|word| number(word, what))
        .collect()
}

/// Lines of numbers; what follows `#` is a comment.
pub(super) fn rows(text: &str, what: &str) -> Result<Vec<Vec<f64>>, FormatError> {
    let mut rows = Vec::new();
    for line in text.lines() {
        let row = numbers(line.split('#').next().unwrap_or_default(), what)?;
        if !row.is_empty() {
            rows.push(row);
        }
    }
    Ok(rows)
}

/// `R` rows of `C` numbers.
pub(super) fn matrix<const R: usize, const C: usize>(
    rows: &[Vec<f64>],
    what: &str,
    expected: &'static str,
) -> Result<[[f64; C]; R], FormatError> {
    let wrong = || {
        let mut lengths: Vec<String> = rows.iter().take(6).map(|row| row.len().to_string()).collect();
        lengths.dedup();
        let lengths = if lengths.is_empty() { "no".to_owned() } else { lengths.join(" or ") };
        FormatError::Shape { what: what.to_owned(), found: format!("{} rows of {lengths} numbers", rows.len()), expected }
    };
    if !rows.iter().flatten().all(|value| value.is_finite()) {
        return Err(FormatError::NotFinite { what: what.to_owned() });
    }
    let fixed: Vec<[f64; C]> = rows.iter().map(|row| row.as_slice().try_into()).collect::<Result<_, _>>().map_err(|_| wrong())?;
    fixed.as_slice().try_into().map_err(|_| wrong())
}

/// A 3×4 \[R|t\], or a 4×4 that ends in 0 0 0 1.
pub(super) fn rigid(rows: &[Vec<f64>], what: &'static str) -> Result<Rigid, FormatError> {
    const EXPECTED: &str = "3 rows of 4 numbers, or 4 with a last row of 0 0 0 1";
    let top: [[f64; 4]; 3] = match rows {
        [top @ .., last] if rows.len() == 4 => {
            if last[..] != [0.0, 0.0, 0.0, 1.0] {
                return Err(FormatError::Shape {
                    what: format!("last row of {what}"),
                    found: format!("{last:?}"),
                    expected: "[0, 0, 0, 1]",
                });
            }
            matrix(top, what, EXPECTED)?
        }
        _ => matrix(rows, what, EXPECTED)?,
    };
    rigid_of(&top, what)
}

/// A rigid motion; one that mirrors is named as such.
pub(super) fn rigid_of(top: &[[f64; 4]; 3], what: &'static str) -> Result<Rigid, FormatError> {
    let determinant = determinant_of(&top.map(|row| [row[0], row[1], row[2]]));
    if determinant < -0.5 {
        return Err(FormatError::Mirrored { what, determinant, hint: "" });
    }
    Ok(Rigid::from_rows(&[top[0], top[1], top[2], [0.0, 0.0, 0.0, 1.0]])?)
}

/// Determinant with rows scaled to length 1: the sign is the handedness, the size how far from flat.
pub(super) fn determinant_of(rows: &[[f64; 3]; 3]) -> f64 {
    let [a, b, c] = rows.map(|row| DVec3::from_array(row).normalize_or_zero());
    a.dot(b.cross(c))
}

/// K and \[R|t\] with focal lengths made positive: both negative is a camera turned by 180° about its axis, one negative a mirror.
pub(super) fn camera(k: &[[f64; 3]; 3], camera_from_lps: Rigid, what: &'static str) -> Result<(Intrinsics, Rigid), FormatError> {
    if !k.iter().flatten().all(|value| value.is_finite()) {
        return Err(FormatError::NotFinite { what: what.to_owned() });
    }
    let (fx, fy) = (k[0][0], k[1][1]);
    if fx * fy < 0.0 {
        return Err(FormatError::Mirrored { what, determinant: fx.signum() * fy.signum(), hint: "" });
    }
    if fx < 0.0 && fy < 0.0 {
        let turned = [[-fx, -k[0][1], k[0][2]], [k[1][0], -fy, k[1][2]], k[2]];
        let half_turn = Rigid::rotation(glam::DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0));
        return Ok((Intrinsics::from_rows(&turned)?, half_turn * camera_from_lps));
    }
    Ok((Intrinsics::from_rows(k)?, camera_from_lps))
}

/// Image size from two numbers of a file.
pub(super) fn size(columns: f64, rows: f64) -> Result<[u32; 2], FormatError> {
    let whole = |value: f64| (value.fract() == 0.0 && (1.0..=1e6).contains(&value)).then_some(value as u32);
    match (whole(columns), whole(rows)) {
        (Some(columns), Some(rows)) => Ok([columns, rows]),
        _ => Err(FormatError::Shape {
            what: "image size".to_owned(),
            found: format!("{columns}x{rows}"),
            expected: "two whole numbers from 1 to 1000000",
        }),
    }
}

/// A length that must be positive.
pub(super) fn positive(value: f64, key: &str) -> Result<f64, FormatError> {
    if value > 0.0 && value.is_finite() {
        Ok(value)
    } else {
        Err(FormatError::Unsupported { key: key.to_owned(), found: show(value), expected: "a positive number" })
    }
}

/// Rows of a rotation.
pub(super) fn rotation_rows(rigid: &Rigid) -> [[f64; 3]; 3] {
    let transposed: DMat3 = rigid.rotation_matrix().transpose();
    transposed.to_cols_array_2d()
}
