//! `sidecarm attenuation`: mass attenuation of a material at energies, from the tables that every render uses.

use std::io::Write;
use std::path::{Path, PathBuf};

use clap::builder::{PathBufValueParser, TypedValueParser};
use serde::Serialize;

use super::named;
use crate::image::plot::{Axis, Plot, PlotError, Scale, Series, Stroke};
use crate::image::{ImageFileError, write_atomically};
use crate::scene::physics::{Coefficients, ENERGY_RANGE_KEV, Material, PhysicsError, symbol};

/// Print the mass attenuation of a material by interaction.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm attenuation titanium --kev 20,60
  sidecarm attenuation Ca10(PO4)6(OH)2 --kev 30,40,50 --json
  sidecarm attenuation Ti:0.9,Al:0.06,V:0.04 --kev 60 --plot alloy.svg

Subscripts of a formula count atoms: Ti90Al6V4 is 90 atoms of titanium, not 90 per cent by mass.
Total is the sum of the three. Source: xraylib 4.3, 1 to 150 keV.")]
pub struct AttenuationArgs {
    /// Name of the materials table (any case), chemical formula, or mass fractions
    pub material: String,
    /// Photon energies in keV, separated by commas
    #[arg(long, value_name = "E1,E2", value_delimiter = ',', required = true, num_args = 1, allow_negative_numbers = true)]
    pub kev: Vec<f64>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    pub json: bool,
    /// Draw all four over the whole range of energies, the asked ones as dots
    #[arg(long, value_name = "FILE.svg", value_parser = PathBufValueParser::new().try_map(named::svg))]
    pub plot: Option<PathBuf>,
}

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The material, an energy, or the beam.
    #[error(transparent)]
    Physics(#[from] PhysicsError),
    /// A filter of unknown density.
    #[error(
        "--filter {name}: its density is not known here; name an element or a material of `sidecarm materials`, such as water for H2O"
    )]
    FilterDensity {
        /// As typed.
        name: String,
    },
    /// The plot cannot be drawn.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// The plot cannot be written.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// The answer cannot be printed.
    #[error("standard output: {0}")]
    Output(#[from] std::io::Error),
    /// The answer cannot be turned into JSON.
    #[error("answer as JSON: {0}")]
    Json(#[from] serde_json::Error),
}

#[derive(Serialize)]
struct Answer<'a> {
    material: &'a str,
    density_g_per_cm3: Option<f64>,
    mass_fractions: serde_json::Map<String, serde_json::Value>,
    rows: Vec<Row>,
}

#[derive(Serialize)]
struct Row {
    energy_kev: f64,
    total_cm2_per_g: f64,
    photo_cm2_per_g: f64,
    compton_cm2_per_g: f64,
    rayleigh_cm2_per_g: f64,
}

/// Prints the answer to `out`, and draws it where asked.
///
/// # Errors
/// When the material is unknown, an energy is outside the tables, or something cannot be written; nothing is printed then.
pub fn run(args: &AttenuationArgs, out: &mut dyn Write) -> Result<(), TableError> {
    let material = Material::parse(&args.material)?;
    let rows: Vec<Row> = args.kev.iter().map(|kev| row(&material, *kev)).collect::<Result<_, _>>()?;
    if let Some(path) = &args.plot {
        write_plot(path, &plot(&material, &rows)?)?;
    }
    if args.json {
        let mass_fractions =
            material.composition.iter().map(|(z, fraction)| (symbol(*z).unwrap_or("?").to_owned(), (*fraction).into())).collect();
        let answer = Answer { material: &material.name, density_g_per_cm3: material.density_g_per_cm3, mass_fractions, rows };
        return print(&(serde_json::to_string_pretty(&answer)? + "\n"), out);
    }
    print(&table(&material, &rows), out)
}

/// Writes `text`; a reader that has seen enough and closed the pipe is no error.
pub(super) fn print(text: &str, out: &mut dyn Write) -> Result<(), TableError> {
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        outcome => Ok(outcome?),
    }
}

/// Writes a drawing; a file of that name is replaced as a whole.
pub(super) fn write_plot(path: &Path, plot: &Plot) -> Result<(), TableError> {
    let svg = plot.svg()?;
    write_atomically(path, |file| file.write_all(svg.as_bytes()))?;
    Ok(())
}

fn row(material: &Material, energy_kev: f64) -> Result<Row, PhysicsError> {
    let Coefficients { total_cm2_per_g, photo_cm2_per_g, compton_cm2_per_g, rayleigh_cm2_per_g } =
        material.attenuation(energy_kev)?;
    Ok(Row { energy_kev, total_cm2_per_g, photo_cm2_per_g, compton_cm2_per_g, rayleigh_cm2_per_g })
}

fn table(material: &Material, rows: &[Row]) -> String {
    let density = material.density_g_per_cm3;
    let nominal =
        density.map_or_else(|| "no nominal density, so no half values".to_owned(), |d| format!("nominal density {d} g/cm3"));
    let mut text = format!("{}: {} by mass\n{nominal}\n\n", material.name, material.describe());
    let heads = ["energy", "total", "photo", "compton", "rayleigh", "half value"];
    let units = ["keV", "cm2/g", "cm2/g", "cm2/g", "cm2/g", "mm"];
    let mut line = |cells: [String; 6]| {
        let [energy, rest @ ..] = cells;
        text.push_str(&format!("{energy:>9}"));
        rest.iter().for_each(|cell| text.push_str(&format!("  {cell:>11}")));
        text.push('\n');
    };
    line(heads.map(str::to_owned));
    line(units.map(str::to_owned));
    for row in rows {
        let half_value_mm = density.map(|density| 10.0 * 2f64.ln() / (row.total_cm2_per_g * density));
        line([
            row.energy_kev.to_string(),
            format!("{:.4e}", row.total_cm2_per_g),
            format!("{:.4e}", row.photo_cm2_per_g),
            format!("{:.4e}", row.compton_cm2_per_g),
            format!("{:.4e}", row.rayleigh_cm2_per_g),
            half_value_mm.map_or_else(|| "-".to_owned(), |mm| format!("{mm:.4}")),
        ]);
    }
    text
}

/// Four curves on logarithmic axes, dense enough that an absorption edge is upright, and the asked energies as dots on the total.
fn plot(material: &Material, rows: &[Row]) -> Result<Plot, PhysicsError> {
    const POINTS: i32 = 1500;
    let (from_kev, to_kev) = ENERGY_RANGE_KEV;
    let curve: Vec<Row> = (0..=POINTS)
        .map(|i| {
            let energy_kev = from_kev * (to_kev / from_kev).powf(f64::from(i) / f64::from(POINTS));
            row(material, energy_kev.clamp(from_kev, to_kev))
        })
        .collect::<Result<_, _>>()?;
    let line = |label: &str, value: fn(&Row) -> f64| Series {
        label: label.to_owned(),
        points: curve.iter().map(|row| [row.energy_kev, value(row)]).collect(),
        ..Series::default()
    };
    let asked = Series {
        points: rows.iter().map(|row| [row.energy_kev, row.total_cm2_per_g]).collect(),
        stroke: Stroke::Points,
        colour: Some(0),
        ..Series::default()
    };
    // Tails far below the total only squeeze what matters.
    let totals = || curve.iter().map(|row| row.total_cm2_per_g);
    let (low, high) = (totals().fold(f64::INFINITY, f64::min), totals().fold(0.0, f64::max));
    Ok(Plot {
        title: format!("Mass attenuation of {}", material.name),
        x: Axis { range: Some([from_kev, to_kev]), ..Axis::new("photon energy / keV", Scale::Log) },
        y: Axis { range: Some([low * 1e-2, high * 2.0]), ..Axis::new("mass attenuation / (cm²/g)", Scale::Log) },
        series: vec![
            line("total", |row| row.total_cm2_per_g),
            line("photoelectric", |row| row.photo_cm2_per_g),
            line("Compton", |row| row.compton_cm2_per_g),
            line("Rayleigh", |row| row.rayleigh_cm2_per_g),
            asked,
        ],
        ..Plot::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(material: &str, kev: &[f64]) -> AttenuationArgs {
        AttenuationArgs { material: material.to_owned(), kev: kev.to_vec(), json: true, plot: None }
    }

    /// Water at 60 keV, mean free path 48.57 mm.
    #[test]
    fn json_has_the_documented_keys() {
        let mut out = Vec::new();
        run(&args("Water", &[20.0, 60.0]), &mut out).expect("inside");
        let value: serde_json::Value = serde_json::from_slice(&out).expect("JSON");
        assert_eq!((value["material"].as_str(), value["density_g_per_cm3"].as_f64()), (Some("water"), Some(1.0)));
        let row = &value["rows"][1];
        let number = |key: &str| row[key].as_f64().expect(key);
        assert!((10.0 / number("total_cm2_per_g") - 48.57).abs() < 0.05 && number("energy_kev") == 60.0);
        let parts = number("photo_cm2_per_g") + number("compton_cm2_per_g") + number("rayleigh_cm2_per_g");
        assert!((parts / number("total_cm2_per_g") - 1.0).abs() < 1e-9);
    }

    #[test]
    fn tables_and_plots_are_written_and_errors_print_nothing() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("lead.svg");
        let mut out = Vec::new();
        run(&AttenuationArgs { json: false, plot: Some(path.clone()), ..args("lead", &[87.9, 88.1]) }, &mut out).expect("inside");
        let text = String::from_utf8(out).expect("text");
        assert!(text.contains("density 11.35 g/cm3") && text.contains("88.1") && text.contains("rayleigh"), "{text}");
        let svg = std::fs::read_to_string(&path).expect("written");
        assert!(svg.contains("Mass attenuation of lead") && svg.matches("<circle").count() == 2);
        let mut out = Vec::new();
        for wrong in [args("lead", &[60.0, 200.0]), args("leed", &[60.0])] {
            run(&wrong, &mut out).expect_err("refused");
        }
        assert!(out.is_empty());
    }
}
