//! Beads as a point list of 3D Slicer: markups schema 1.0.3, `lps`, mm.

use serde_json::{Value, json};

use super::ct_bead::CtBead;

const SCHEMA: &str = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#";

/// The document that Slicer opens and edits, and `beads::read_markups` reads. The description of each point holds `radius_mm` (where it
/// is certain), `sigma_mm` per axis, the covariance's six numbers `xx:xy:xz:yy:yz:zz` in mm², and the body.
#[must_use]
pub fn markups(beads: &[CtBead]) -> Value {
    point_list(beads.iter().map(|bead| (bead.name.clone(), bead.lps_mm, description(bead))))
}

/// A point list of name, position in mm, and description.
#[must_use]
pub fn point_list(points: impl Iterator<Item = (String, [f64; 3], String)>) -> Value {
    let point = |(number, (name, lps_mm, description)): (usize, (String, [f64; 3], String))| {
        json!({
            "id": (number + 1).to_string(),
            "label": name,
            "description": description,
            "associatedNodeID": "",
            "position": lps_mm,
            // Slicer's own axes, as it writes them in LPS.
            "orientation": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0],
            "selected": true,
            "locked": false,
            "visibility": true,
            "positionStatus": "defined",
        })
    };
    let points: Vec<Value> = points.enumerate().map(point).collect();
    json!({
        "@schema": SCHEMA,
        "markups": [{
            "type": "Fiducial",
            "coordinateSystem": "LPS",
            "coordinateUnits": "mm",
            "locked": false,
            "fixedNumberOfControlPoints": false,
            "labelFormat": "%N-%d",
            "lastUsedControlPointNumber": points.len(),
            "controlPoints": points,
            "measurements": [],
        }],
    })
}

fn description(bead: &CtBead) -> String {
    let radius = if bead.radius_stated { format!("radius_mm={:.3} ", bead.radius_mm) } else { String::new() };
    let [[xx, xy, xz], [_, yy, yz], [_, _, zz]] = bead.covariance_mm2;
    let covariance = [xx, xy, xz, yy, yz, zz].map(|value| format!("{value:.3e}")).join(":");
    format!("{radius}sigma_mm={:.4} covariance_mm2={covariance} body={}", bead.sigma_mm, bead.body)
}
