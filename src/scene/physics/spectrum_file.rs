//! A spectrum that somebody measured or simulated, as a table of commas.

use std::path::Path;

use super::{Bin, PhysicsError, Spectrum, element_attenuation};
use crate::foreign::read_small_text;
use crate::table::{cells_of, unmarked};

const COLUMNS: [&str; 2] = ["energy_kev", "fluence"];

impl Spectrum {
    /// A file with the columns `energy_kev,fluence` (photons per bin at its centre, equal spacing, up or down), Σφ = 1.
    ///
    /// # Errors
    /// When the file cannot be read or a row is wrong; the message names the row.
    pub fn from_csv(path: &Path) -> Result<Self, PhysicsError> {
        let wrong = |detail: String| PhysicsError::SpectrumFile { path: path.display().to_string(), detail };
        let text = read_small_text(path).map_err(|error| wrong(error.to_string()))?;
        let mut bins: Vec<Bin> = Vec::new();
        let mut headed = false;
        for (index, line) in unmarked(&text).lines().enumerate() {
            let (row, line) = (index + 1, line.trim());
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            if !headed {
                if !cells_of(line).iter().eq(COLUMNS) {
                    return Err(wrong(format!("row {row} is '{line}', expected the header energy_kev,fluence")));
                }
                headed = true;
                continue;
            }
            let numbers: Option<Vec<f64>> = cells_of(line).iter().map(|cell| cell.parse().ok()).collect();
            let Some([energy_kev, fluence]) = numbers.as_deref() else {
                return Err(wrong(format!("row {row} is '{line}', expected two numbers")));
            };
            if !(*fluence >= 0.0 && fluence.is_finite()) {
                return Err(wrong(format!("row {row}: fluence is {fluence}, expected 0 or more")));
            }
            element_attenuation(1, *energy_kev).map_err(|error| wrong(format!("row {row}: {error}")))?;
            bins.push(Bin { energy_kev: *energy_kev, fluence: *fluence });
        }
        if let [first, second, ..] = bins.as_slice() {
            let step_kev = second.energy_kev - first.energy_kev;
            for (pair, row) in bins.windows(2).zip(2..) {
                let found = pair[1].energy_kev - pair[0].energy_kev;
                if !(step_kev != 0.0 && (found - step_kev).abs() <= 1e-3 * step_kev.abs()) {
                    return Err(wrong(format!("value {row}: spacing is {found} keV, expected {step_kev} keV as at the start")));
                }
            }
            if step_kev < 0.0 {
                bins.reverse();
            }
        }
        if bins.is_empty() {
            return Err(wrong("it has no values".to_owned()));
        }
        Self { bins }.normalised()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<Spectrum, String> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("s.csv");
        std::fs::write(&path, bytes).expect("written");
        Spectrum::from_csv(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn bad_files_name_the_row() {
        for (text, says) in [
            ("energy_kev,fluence\n30,1\n31,-2\n", "row 3"),
            ("energy_kev,fluence\n30,1\n31,2\n33,2\n", "spacing"),
            ("energy_kev,fluence\n33,1\n31,2\n30,2\n", "value 3: spacing is -1 keV, expected -2 keV"),
            ("energy_kev,fluence\n30,1\n31,2\n30,2\n", "value 3: spacing is -1 keV, expected 1 keV"),
            ("energy_kev,fluence\n30,1\n30,2\n", "spacing is 0 keV"),
            ("kev,n\n30,1\n", "header"),
            ("energy_kev,fluence\n30,NaN\n", "row 2"),
        ] {
            let error = read(text.as_bytes()).expect_err(text);
            assert!(error.contains(says), "{error}");
        }
        assert!((read(b"energy_kev,fluence\n30,1\n31,3\n").expect("good").mean_kev() - 30.75).abs() < 1e-12);
    }

    /// A spreadsheet's file was refused for a header that looked right, and one from the top down for its spacing.
    #[test]
    fn a_byte_order_mark_and_falling_energies_are_no_fault() {
        let rising = read(b"energy_kev,fluence\n30,1\n31,3\n32,2\n").expect("good");
        assert_eq!(read(b"\xef\xbb\xbfenergy_kev,fluence\r\n30,1\r\n31,3\r\n32,2\r\n").expect("marked"), rising);
        assert_eq!(read(b"energy_kev,fluence\n32,2\n31,3\n30,1\n").expect("falling"), rising);
    }

    /// What writes text in quotes writes numbers so as well; the header was not known then.
    #[test]
    fn quoted_cells_are_cells() {
        let plain = read(b"energy_kev,fluence\n30,1\n31,3\n").expect("good");
        let quoted = b"# measured\n\"energy_kev\", fluence\n\n\"30\",\"1\"\n\"31\" , 3 \n\n";
        assert_eq!(read(quoted).expect("quoted"), plain);
        let error = read(b"energy_kev,fluence\n30,1\n\n\"31,3\"\n").expect_err("one cell");
        assert!(error.contains("row 4") && error.contains("two numbers"), "{error}");
    }
}
