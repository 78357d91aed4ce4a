//! The description `IMAGE.tif.json` that this program writes beside its images: it says what the values mean.

use std::io::Read;
use std::path::Path;

use super::domain::Domain;
use crate::foreign::open_regular;
use crate::image::beside;
use crate::json::parse_json;

/// More than any description takes.
const MAX_BYTES: u64 = 1 << 20;
/// Units that are known, by all their names; a file may say anything.
const UNITS: [(&str, &[&str]); 5] = [
    ("1", &["1", "1 (unattenuated signal)"]),
    ("neper", &["neper", "nepers", "Np"]),
    ("keV", &["keV"]),
    ("photons", &["photons"]),
    ("g/cm2", &["g/cm2", "g/cm²"]),
];

/// What the description says, reduced to what is known here.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Beside {
    pub(super) domain: Domain,
    pub(super) unit: Option<String>,
    pub(super) pitch_mm: Option<[f64; 2]>,
    pub(super) evidence: Vec<String>,
}

impl Default for Beside {
    fn default() -> Self {
        Self { domain: Domain::Unknown, unit: None, pitch_mm: None, evidence: Vec::new() }
    }
}

impl Beside {
    /// Nothing but a word on why.
    fn only(evidence: &str) -> Self {
        Self { evidence: vec![evidence.to_owned()], ..Self::default() }
    }

    /// Reads the description of the image at `path`.
    pub(super) fn of(path: &Path) -> Self {
        let file = match open_regular(&beside(path, "json"), MAX_BYTES) {
            Ok(open) => open.file,
            Err(crate::foreign::OpenFault::Io(error)) if error.kind() == std::io::ErrorKind::NotFound => {
                return Self::only("the file has no header for radiographs and no sidecar .json");
            }
            Err(_) => return Self::only("the sidecar .json could not be read"),
        };
        let mut text = String::new();
        if file.take(MAX_BYTES).read_to_string(&mut text).is_err() {
            return Self::only("the sidecar .json could not be read");
        }
        match parse_json::<serde_json::Value>(text.as_bytes()) {
            Ok(json) => Self::of_json(&json),
            Err(_) => Self::only("the sidecar .json is not valid JSON"),
        }
    }

    fn of_json(json: &serde_json::Value) -> Self {
        let Some(quantity) = json.get("quantity").and_then(serde_json::Value::as_str) else {
            return Self::only("the sidecar .json names no quantity");
        };
        let (domain, shown) = match quantity {
            // Parts of a signal, and their standard errors, over the unattenuated one.
            "intensity" | "counts" | "scatter" => (Domain::Linear, quantity),
            "line_integral" => (Domain::Log, quantity),
            "area_density" => (Domain::Unknown, quantity),
            _ => (Domain::Unknown, "that is not known here"),
        };
        let named = json.get("unit").and_then(serde_json::Value::as_str);
        let unit =
            named.and_then(|named| UNITS.iter().find(|(_, names)| names.contains(&named))).map(|(unit, _)| (*unit).to_owned());
        let pitch = ["/pitch_mm", "/detector/pitch_mm", "/view/pitch_mm"].iter().find_map(|at| json.pointer(at)?.as_f64());
        let pitch_mm = pitch.filter(|pitch| *pitch > 0.0).map(|pitch| [pitch, pitch]);
        Self { domain, unit, pitch_mm, evidence: vec![format!("the sidecar .json says quantity {shown}")] }
    }
}
