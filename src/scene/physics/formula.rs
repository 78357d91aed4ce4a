//! Chemical formulas and mass fractions to compositions.

use std::collections::BTreeMap;

use super::PhysicsError;
use super::elements::z_of;

/// Standard atomic weights (IUPAC 2021, conventional values), u; index z − 1. Long-lived isotopes where there is no standard.
const ATOMIC_WEIGHTS: [f64; 92] = [
    1.008, 4.002602, 6.94, 9.0121831, 10.81, 12.011, 14.007, 15.999, 18.998403, 20.1797, 22.989769, 24.305, 26.981538, 28.085,
    30.973762, 32.06, 35.45, 39.95, 39.0983, 40.078, 44.955907, 47.867, 50.9415, 51.9961, 54.938043, 55.845, 58.933194, 58.6934,
    63.546, 65.38, 69.723, 72.63, 74.921595, 78.971, 79.904, 83.798, 85.4678, 87.62, 88.905838, 91.224, 92.90637, 95.95, 98.0,
    101.07, 102.90549, 106.42, 107.8682, 112.414, 114.818, 118.71, 121.76, 127.6, 126.90447, 131.293, 132.905452, 137.327,
    138.90547, 140.116, 140.90766, 144.242, 145.0, 150.36, 151.964, 157.249, 158.925354, 162.5, 164.930329, 167.259, 168.934219,
    173.045, 174.9668, 178.486, 180.94788, 183.84, 186.207, 190.23, 192.217, 195.084, 196.96657, 200.592, 204.38, 207.2,
    208.9804, 209.0, 210.0, 222.0, 223.0, 226.0, 227.0, 232.0377, 231.03588, 238.02891,
];

/// Standard atomic weight of element `z`, 1–92, u.
#[must_use]
pub fn atomic_weight(z: u8) -> Option<f64> {
    ATOMIC_WEIGHTS.get(usize::from(z).checked_sub(1)?).copied()
}

/// Mass fractions of `formula`: element symbols with atom counts and nested parentheses, such as `H2O`, `Ca10(PO4)6(OH)2`,
/// `Ti90Al6V4` (atoms, not weight per cent).
///
/// # Errors
/// When a symbol is unknown, a parenthesis does not close, or a count is zero.
pub(super) fn parse_formula(formula: &str) -> Result<Vec<(u8, f64)>, PhysicsError> {
    let wrong = |detail: String| PhysicsError::Formula { formula: formula.to_owned(), detail };
    let bytes = formula.as_bytes();
    let mut at = 0;
    let mut groups: Vec<BTreeMap<u8, f64>> = vec![BTreeMap::new()];
    let count = |at: &mut usize| -> Result<f64, PhysicsError> {
        let start = *at;
        while *at < bytes.len() && (bytes[*at].is_ascii_digit() || bytes[*at] == b'.') {
            *at += 1;
        }
        if start == *at {
            return Ok(1.0);
        }
        let number: f64 = formula[start..*at].parse().map_err(|_| wrong(format!("'{}' is no number", &formula[start..*at])))?;
        if number > 0.0 { Ok(number) } else { Err(wrong("a count must be positive".to_owned())) }
    };
    while at < bytes.len() {
        match bytes[at] {
            b'(' => {
                groups.push(BTreeMap::new());
                at += 1;
            }
            b')' if groups.len() > 1 => {
                at += 1;
                let times = count(&mut at)?;
                let inner = groups.pop().unwrap_or_default();
                if let Some(outer) = groups.last_mut() {
                    for (z, atoms) in inner {
                        *outer.entry(z).or_default() += atoms * times;
                    }
                }
            }
            b'A'..=b'Z' => {
                let length = if bytes.get(at + 1).is_some_and(u8::is_ascii_lowercase) { 2 } else { 1 };
                let symbol = &formula[at..at + length];
                let z = z_of(symbol).ok_or_else(|| wrong(format!("'{symbol}' is no element up to uranium")))?;
                at += length;
                let atoms = count(&mut at)?;
                if let Some(group) = groups.last_mut() {
                    *group.entry(z).or_default() += atoms;
                }
            }
            _ => {
                let rest: String = formula[at..].chars().take(8).collect();
                return Err(wrong(format!("cannot read '{rest}'")));
            }
        }
    }
    if groups.len() != 1 {
        return Err(wrong("a parenthesis does not close".to_owned()));
    }
    let weigh = |(z, atoms): (&u8, &f64)| (*z, atoms * ATOMIC_WEIGHTS[usize::from(*z) - 1]);
    let weights: Vec<(u8, f64)> = groups[0].iter().map(weigh).collect();
    let sum: f64 = weights.iter().map(|(_, weight)| weight).sum();
    if !(sum > 0.0 && sum.is_finite()) {
        return Err(wrong("it names no element".to_owned()));
    }
    Ok(weights.into_iter().map(|(z, weight)| (z, weight / sum)).collect())
}

/// Mass fractions written out: `Ti:0.9,Al:0.06,V:0.04`; a sum within 1 % of 1 is normalised.
///
/// # Errors
/// When a symbol is unknown, a number is not in (0, 1], or they do not add up to 1 within 1 %.
pub(super) fn parse_fractions(text: &str) -> Result<Vec<(u8, f64)>, PhysicsError> {
    let wrong = |detail: String| PhysicsError::Formula { formula: text.to_owned(), detail };
    let mut parts = Vec::new();
    for part in text.split(',') {
        let (symbol, number) = part.split_once(':').ok_or_else(|| wrong(format!("'{part}' is not SYMBOL:FRACTION")))?;
        let z = z_of(symbol.trim()).ok_or_else(|| wrong(format!("'{}' is no element up to uranium", symbol.trim())))?;
        let fraction: f64 = number.trim().parse().map_err(|_| wrong(format!("'{number}' is no number")))?;
        if !(fraction > 0.0 && fraction <= 1.0) {
            return Err(wrong(format!("fraction {fraction} of {} is not in (0, 1]", symbol.trim())));
        }
        parts.push((z, fraction));
    }
    let sum: f64 = parts.iter().map(|(_, fraction)| fraction).sum();
    if !((sum - 1.0).abs() <= 0.01) {
        return Err(PhysicsError::Fractions { name: text.to_owned(), sum });
    }
    Ok(parts.into_iter().map(|(z, fraction)| (z, fraction / sum)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn water_has_the_tabulated_mass_fractions() {
        let water = parse_formula("H2O").expect("water");
        assert_eq!(water.iter().map(|(z, _)| *z).collect::<Vec<_>>(), [1, 8]);
        assert!((water[0].1 - 0.111898).abs() < 2e-5 && (water[1].1 - 0.888102).abs() < 2e-5);
    }

    #[test]
    fn groups_multiply() {
        let apatite = parse_formula("Ca10(PO4)6(OH)2").expect("hydroxyapatite");
        let calcium = apatite.iter().find(|(z, _)| *z == 20).expect("has calcium").1;
        assert!((calcium - 0.398_94).abs() < 1e-4, "{calcium}");
    }

    #[test]
    fn nonsense_is_named() {
        for (formula, says) in
            [("H2Q", "Q"), ("(H2", "parenthesis"), ("H0", "positive"), ("water!", "cannot read"), ("", "no element")]
        {
            let error = parse_formula(formula).expect_err(formula).to_string();
            assert!(error.contains(says), "{formula}: {error}");
        }
        assert!(matches!(parse_fractions("Ti:0.5,Al:0.1"), Err(PhysicsError::Fractions { .. })));
        assert!(parse_fractions("Ti:0.9,Al:NaN").is_err());
    }
}
