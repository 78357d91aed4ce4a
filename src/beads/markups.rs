//! 3D Slicer point lists: `.mrk.json` (markups schema 1.0) and the older `.fcsv`.

use std::path::Path;

use glam::{DMat3, DVec3};
use serde_json::Value;

use super::description::{Doubts, value};
use super::markups_error::BeadsError;
use super::place_covariance::PlaceCovariance;
use super::{Bead, BeadLayout, DEFAULT_BODY, Landmark};
use crate::foreign::read_small;
use crate::geometry::lps_from_ras;
use crate::table::{cells_of, unmarked};

/// A stated `sigma_mm` says the same as the covariance beside it where the two differ by no more than this share, and mm: rounded digits.
const SAME_SIGMA: (f64, f64) = (0.02, 1e-4);

struct Point {
    label: String,
    description: String,
    lps_mm: DVec3,
    /// Whether the file gives it along R, A and S.
    is_ras: bool,
}

struct Points {
    points: Vec<Point>,
    notes: Vec<String>,
}

/// Beads of a Slicer markups file. `radius_mm=`, `sigma_mm=`, `covariance_mm2=`, `body=` and `role=check` are read from the descriptions;
/// points whose status is not defined are skipped. A covariance is along the axes of the file's positions, in mm² whatever their unit.
///
/// # Errors
/// Every form of damage, each with the file, the place and what was expected; also duplicate names and a list without a bead to solve from.
pub fn read_markups(path: &Path) -> Result<BeadLayout, BeadsError> {
    layout(path, read_points(path)?)
}

/// Beads of the content of a markups file; `path` tells the format and serves messages.
///
/// # Errors
/// As [`read_markups`].
pub fn parse_markups(path: &Path, content: &[u8]) -> Result<BeadLayout, BeadsError> {
    layout(path, parse_points(path, content)?)
}

fn layout(path: &Path, Points { points, mut notes }: Points) -> Result<BeadLayout, BeadsError> {
    let (mut beads, mut checks) = (Vec::new(), Vec::new());
    let (mut turned, mut contradicted) = (0, 0);
    let mut doubts = Doubts::default();
    for point in points {
        let (is_ras, name, description) = (point.is_ras, point.label.clone(), point.description.clone());
        let Described { bead, is_check, is_contradicted } = bead(path, point)?;
        doubts.look(&name, &description, bead.radius_mm);
        turned += usize::from(is_ras && bead.covariance_mm2.is_some());
        contradicted += usize::from(is_contradicted);
        if is_check { checks.push(bead) } else { beads.push(bead) }
    }
    let doubts = doubts.sentences();
    notes.extend(doubts.iter().cloned());
    if turned > 0 {
        notes.push(format!("the covariance_mm2 of {turned} beads is taken along R, A and S, as the file gives their positions"));
    }
    if contradicted > 0 {
        notes
            .push(format!("the sigma_mm of {contradicted} beads is left aside: their covariance_mm2 says otherwise, and counts"));
    }
    if beads.is_empty() {
        return Err(BeadsError::OnlyChecks { path: path.to_owned(), checks: checks.len() });
    }
    Ok(BeadLayout { beads, checks, source: path.display().to_string(), notes, doubts, refused: None })
}

/// Landmarks of a Slicer markups file; as [`read_markups`], without a look at the descriptions.
///
/// # Errors
/// As [`read_markups`].
pub fn read_landmarks(path: &Path) -> Result<Vec<Landmark>, BeadsError> {
    Ok(landmarks(read_points(path)?))
}

/// Landmarks of the content of a markups file; `path` tells the format and serves messages.
///
/// # Errors
/// As [`read_markups`].
pub fn parse_landmarks(path: &Path, content: &[u8]) -> Result<Vec<Landmark>, BeadsError> {
    Ok(landmarks(parse_points(path, content)?))
}

fn landmarks(Points { points, .. }: Points) -> Vec<Landmark> {
    points.into_iter().map(|point| Landmark { name: point.label, lps_mm: point.lps_mm }).collect()
}

/// A bead as its point describes it.
struct Described {
    bead: Bead,
    /// It is one to check poses by.
    is_check: bool,
    /// Its `sigma_mm` says other than its covariance.
    is_contradicted: bool,
}

fn bead(path: &Path, point: Point) -> Result<Described, BeadsError> {
    let value = |key: &str| value(&point.description, key).map(str::to_owned);
    let positive = |key: &'static str, least_mm: f64| match value(key) {
        None => Ok(None),
        Some(text) => match text.parse::<f64>() {
            Ok(number) if number.is_finite() && number >= least_mm => Ok(Some(number)),
            _ => Err(BeadsError::Description { path: path.to_owned(), name: point.label.clone(), key, found: text }),
        },
    };
    let covariance_mm2 = match value("covariance_mm2") {
        None => None,
        Some(found) => match found.parse::<PlaceCovariance>() {
            Ok(own) if point.is_ras => Some(own.turned(&DMat3::from_diagonal(lps_from_ras(DVec3::ONE)))),
            Ok(own) => Some(own),
            Err(fault) => {
                return Err(BeadsError::Covariance { path: path.to_owned(), name: point.label, found, fault });
            }
        },
    };
    let is_check = match value("role").as_deref() {
        None => false,
        Some("check") => true,
        Some(found) => {
            let (name, found) = (point.label, found.to_owned());
            return Err(BeadsError::Role { path: path.to_owned(), name, found });
        }
    };
    let stated_mm = positive("sigma_mm", 0.0)?;
    let of_covariance_mm = covariance_mm2.map(|own| own.sigma_mm());
    let differ = |(one, other): (f64, f64)| !((one - other).abs() <= SAME_SIGMA.0 * one.max(other) + SAME_SIGMA.1);
    let is_contradicted = stated_mm.zip(of_covariance_mm).is_some_and(differ);
    let bead = Bead {
        radius_mm: positive("radius_mm", f64::MIN_POSITIVE)?,
        sigma_mm: stated_mm.filter(|_| !is_contradicted).or(of_covariance_mm),
        covariance_mm2,
        body: value("body").filter(|body| !body.is_empty()).unwrap_or_else(|| DEFAULT_BODY.to_owned()),
        lps_mm: point.lps_mm,
        name: point.label,
    };
    Ok(Described { bead, is_check, is_contradicted })
}

fn read_points(path: &Path) -> Result<Points, BeadsError> {
    let bytes = read_small(path).map_err(|source| BeadsError::Read { path: path.to_owned(), source })?;
    parse_points(path, &bytes)
}

fn parse_points(path: &Path, bytes: &[u8]) -> Result<Points, BeadsError> {
    let name = path.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
    let (read, skipped) = if name.ends_with(".json") {
        read_json(path, bytes)?
    } else if name.ends_with(".fcsv") {
        read_fcsv(path, &String::from_utf8_lossy(bytes))?
    } else {
        return Err(BeadsError::Extension { path: path.to_owned() });
    };
    if read.points.is_empty() {
        return Err(BeadsError::Empty { path: path.to_owned(), skipped });
    }
    let mut seen = std::collections::BTreeSet::new();
    if let Some(point) = read.points.iter().find(|point| !seen.insert(point.label.clone())) {
        return Err(BeadsError::Duplicate { path: path.to_owned(), name: point.label.clone() });
    }
    let Points { points, mut notes } = read;
    if skipped > 0 {
        notes.push(format!("{skipped} points without a defined position were skipped"));
    }
    Ok(Points { points, notes })
}

/// Whether a file says that its coordinates are RAS, else LPS; `None` where it says neither.
#[must_use]
pub fn says_ras(path: &Path, bytes: &[u8]) -> Option<bool> {
    let stated = match crate::json::parse_json::<Value>(bytes) {
        Ok(document) => match &document["markups"][0]["coordinateSystem"] {
            Value::String(text) => text.clone(),
            other => other.to_string(),
        },
        Err(_) => {
            let text = String::from_utf8_lossy(bytes);
            let header = |line: &str| Some(line.strip_prefix('#')?.split_once('=')?.1.to_owned());
            unmarked(&text).lines().filter(|line| line.contains("CoordinateSystem")).find_map(header)?
        }
    };
    is_ras(path, "", &stated).ok()
}

/// Whether coordinates are RAS (else LPS): Slicer writes `LPS`, `RAS`, or in older files `1` and `0`.
fn is_ras(path: &Path, place: &str, found: &str) -> Result<bool, BeadsError> {
    match found.trim().to_ascii_uppercase().as_str() {
        "RAS" | "0" => Ok(true),
        "LPS" | "1" => Ok(false),
        _ => Err(BeadsError::Form {
            path: path.to_owned(),
            place: place.to_owned(),
            found: format!("{found:?}"),
            expected: "LPS or RAS (or 1 or 0)",
        }),
    }
}

fn mm_per_unit(path: &Path, place: &str, units: &Value) -> Result<f64, BeadsError> {
    let text = match units {
        Value::String(text) => text.clone(),
        Value::Array(all) if !all.is_empty() && all.iter().all(|unit| *unit == all[0]) => {
            all[0].as_str().unwrap_or_default().to_owned()
        }
        _ => units.to_string(),
    };
    match text.as_str() {
        "mm" | "millimeter" | "millimetre" => Ok(1.0),
        "cm" => Ok(10.0),
        "m" | "meter" | "metre" => Ok(1000.0),
        "um" | "µm" => Ok(1e-3),
        _ => Err(BeadsError::Form {
            path: path.to_owned(),
            place: place.to_owned(),
            found: units.to_string(),
            expected: "mm (or m, cm, um)",
        }),
    }
}

fn read_json(path: &Path, bytes: &[u8]) -> Result<(Points, usize), BeadsError> {
    let document: Value = crate::json::parse_json(bytes).map_err(|source| BeadsError::Json { path: path.to_owned(), source })?;
    let form = |place: String, found: &Value, expected| {
        let mut found = found.to_string();
        if found.chars().count() > 60 {
            found = found.chars().take(60).chain("…".chars()).collect();
        }
        BeadsError::Form { path: path.to_owned(), place, found, expected }
    };
    let lists =
        document["markups"].as_array().ok_or_else(|| form("markups".into(), &document["markups"], "a list of markups nodes"))?;
    let mut read = Points { points: Vec::new(), notes: Vec::new() };
    let mut skipped = 0;
    for (index, list) in lists.iter().enumerate() {
        let at = |key: &str| format!("markups[{index}].{key}");
        if list["type"] != "Fiducial" {
            return Err(form(at("type"), &list["type"], "\"Fiducial\" (a point list)"));
        }
        let ras = match &list["coordinateSystem"] {
            Value::Null => {
                read.notes.push("no coordinateSystem in the file: LPS, the schema's default, is taken".to_owned());
                false
            }
            Value::String(text) => is_ras(path, &at("coordinateSystem"), text)?,
            other => is_ras(path, &at("coordinateSystem"), &other.to_string())?,
        };
        let scale = match &list["coordinateUnits"] {
            Value::Null => 1.0,
            units => mm_per_unit(path, &at("coordinateUnits"), units)?,
        };
        let points = list["controlPoints"]
            .as_array()
            .ok_or_else(|| form(at("controlPoints"), &list["controlPoints"], "a list of points"))?;
        for (number, point) in points.iter().enumerate() {
            if !(point["positionStatus"].is_null() || point["positionStatus"] == "defined") {
                skipped += 1;
                continue;
            }
            let text = |key: &str| point[key].as_str().map(str::trim).filter(|text| !text.is_empty()).map(str::to_owned);
            let label = text("label").or_else(|| text("id")).unwrap_or_else(|| format!("point-{}", number + 1));
            let numbers: Option<Vec<f64>> =
                point["position"].as_array().and_then(|all| all.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>());
            let position = match numbers.as_deref() {
                Some(&[x, y, z]) => DVec3::new(x, y, z) * scale,
                _ => DVec3::NAN,
            };
            if !position.is_finite() {
                let found = point["position"].to_string();
                return Err(BeadsError::Position { path: path.to_owned(), name: label, found });
            }
            let lps_mm = if ras { lps_from_ras(position) } else { position };
            let description = text("description").unwrap_or_default();
            read.points.push(Point { label, description, lps_mm, is_ras: ras });
        }
    }
    Ok((read, skipped))
}

/// Columns Slicer writes when the header names none.
const FCSV_COLUMNS: &str = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID,positionStatus";

fn read_fcsv(path: &Path, text: &str) -> Result<(Points, usize), BeadsError> {
    let mut ras = None;
    let mut columns: Vec<String> = FCSV_COLUMNS.split(',').map(str::to_owned).collect();
    let mut read = Points { points: Vec::new(), notes: Vec::new() };
    let mut skipped = 0;
    for (index, line) in unmarked(text).lines().enumerate() {
        let place = format!("line {}", index + 1);
        if let Some(header) = line.strip_prefix('#') {
            if let Some((key, value)) = header.split_once('=') {
                match key.trim() {
                    "CoordinateSystem" => ras = Some(is_ras(path, &place, value)?),
                    "columns" => {
                        columns = value.trim().split(',').map(|name| name.trim().to_owned()).collect();
                        // Slicer 5 writes the status in a column of its own after those it names.
                        if columns.last().is_some_and(|last| last == "associatedNodeID") {
                            columns.push("positionStatus".to_owned());
                        }
                    }
                    _ => {}
                }
            }
            continue;
        }
        if line.trim().is_empty() {
            continue;
        }
        let cells = cells_of(line);
        let cell = |name: &str| columns.iter().position(|column| column == name).and_then(|at| cells.get(at));
        if cells.len() < 4 {
            let found = format!("{} cells", cells.len());
            return Err(BeadsError::Form { path: path.to_owned(), place, found, expected: "at least id,x,y,z" });
        }
        let label = cell("label").filter(|label| !label.is_empty()).or(cell("id")).unwrap_or_default().to_owned();
        // vtkMRMLMarkupsNode: 0 undefined, 1 preview, 2 defined, 3 missing.
        if cell("positionStatus").is_some_and(|status| matches!(status, "0" | "1" | "3")) {
            skipped += 1;
            continue;
        }
        let coordinate = |name: &str| cell(name).and_then(|text| text.parse::<f64>().ok()).unwrap_or(f64::NAN);
        let position = DVec3::new(coordinate("x"), coordinate("y"), coordinate("z"));
        if !position.is_finite() {
            let found = format!("{place}: {}", cells.iter().skip(1).take(3).collect::<Vec<_>>().join(","));
            return Err(BeadsError::Position { path: path.to_owned(), name: label, found });
        }
        let Some(ras) = ras else {
            let found = "points before any coordinate system".to_owned();
            return Err(BeadsError::Form {
                path: path.to_owned(),
                place,
                found,
                expected: "a line `# CoordinateSystem = LPS` (or RAS)",
            });
        };
        let lps_mm = if ras { lps_from_ras(position) } else { position };
        let description = cell("desc").unwrap_or_default().to_owned();
        read.points.push(Point { label, description, lps_mm, is_ras: ras });
    }
    Ok((read, skipped))
}
