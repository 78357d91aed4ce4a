//! `sidecarm materials`: what scenes can name.

use std::io::Write;

use serde::Serialize;

use super::attenuation::{TableError, print};
use crate::scene::DensityCurve;
use crate::scene::physics::{Material, materials, symbol};

/// List the materials that scenes can name, and the classes that thresholds make of a CT.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm materials
  sidecarm materials titan --json

A scene takes a chemical formula (H2O) or mass fractions (Ti:0.9,Al:0.06,V:0.04) wherever it takes a name; those have a nominal density only
where they are a single element of the table.")]
pub struct MaterialsArgs {
    /// Only materials whose name holds this; or a formula, to see what it is read as
    pub part: Option<String>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    pub json: bool,
}

#[derive(Serialize)]
struct Answer<'a> {
    materials: Vec<Row<'a>>,
    /// Of `"materials": "threshold"`, ascending.
    threshold_classes: Vec<ClassRow>,
}

#[derive(Serialize)]
struct Row<'a> {
    name: &'a str,
    density_g_per_cm3: Option<f64>,
    mass_fractions: serde_json::Map<String, serde_json::Value>,
}

#[derive(Serialize)]
struct ClassRow {
    class: &'static str,
    from_hu: Option<f64>,
    to_hu: Option<f64>,
    composition: Option<&'static str>,
    density: &'static str,
}

/// Prints the list to `out`.
///
/// # Errors
/// When it cannot be printed.
pub fn run(args: &MaterialsArgs, out: &mut dyn Write) -> Result<(), TableError> {
    let part = args.part.as_deref().unwrap_or_default().to_lowercase();
    let mut found: Vec<&Material> = materials().iter().filter(|material| material.name.contains(&part)).collect();
    let own;
    if found.is_empty() {
        // A formula, or a slip: the error names the nearest.
        own = Material::parse(args.part.as_deref().unwrap_or_default())?;
        found.push(&own);
    }
    if args.json {
        let answer = Answer { materials: found.into_iter().map(row).collect(), threshold_classes: classes() };
        return print(&(serde_json::to_string_pretty(&answer)? + "\n"), out);
    }
    let mut text = format!("{:<20} {:>9}  mass fractions\n", "material", "g/cm3");
    for material in found {
        let density = material.density_g_per_cm3.map_or_else(|| "-".to_owned(), |density| format!("{density:.4}"));
        text += &format!("{:<20} {density:>9}  {}\n", material.name, material.describe());
    }
    text += "\nclasses of a CT by threshold\n";
    for class in classes() {
        let end = |hu: Option<f64>| hu.map_or_else(String::new, |hu| format!("{hu}"));
        let composition = class.composition.unwrap_or("-");
        text += &format!(
            "{:<20} {:>5} to {:>5} HU  {composition}, {}\n",
            class.class,
            end(class.from_hu),
            end(class.to_hu),
            class.density
        );
    }
    print(&text, out)
}

fn row(material: &Material) -> Row<'_> {
    let fraction = |(z, share): &(u8, f64)| (symbol(*z).unwrap_or("?").to_owned(), (*share).into());
    Row {
        name: &material.name,
        density_g_per_cm3: material.density_g_per_cm3,
        mass_fractions: material.composition.iter().map(fraction).collect(),
    }
}

fn classes() -> Vec<ClassRow> {
    let curve = DensityCurve::shipped();
    let (thin, bone) = (Some(curve.air_below_hu), Some(curve.bone_above_hu));
    let class = |class, from_hu, to_hu, composition, density| ClassRow { class, from_hu, to_hu, composition, density };
    vec![
        class("air", None, thin, None, "nothing: what connects to the border of its axial slice (\"air\": \"keep\" keeps it)"),
        class("lung", None, thin, Some("soft_tissue"), "density from HU: all else that is so thin (\"air\": \"drop\" drops it)"),
        class("soft_tissue", thin, bone, Some("soft_tissue"), "density from HU"),
        class("bone_cortical", bone, None, Some("bone_cortical"), "density from HU"),
    ]
}
