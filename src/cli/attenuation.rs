//! `sidecarm attenuation`: mass attenuation of any material.

use std::io::Write;
use std::path::PathBuf;

use serde_json::json;

use crate::image::plot::{Axis, Series, line_plot};
use crate::image::{ImageFileError, write_atomically};
use crate::scene::physics::{Coefficients, Material, PhysicsError};

/// Mass attenuation coefficients of a material, a formula (H2O, Ti90Al6V4) or mass fractions (Ti:0.9,Al:0.06,V:0.04).
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm attenuation water --kev 20,60 --json")]
pub struct AttenuationArgs {
    /// Name, formula or mass fractions.
    pub material: String,
    /// Energies, 1 to 150 keV.
    #[arg(long, value_delimiter = ',', required = true)]
    pub kev: Vec<f64>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
    /// Draw the coefficients from 5 to 150 keV.
    #[arg(long, value_name = "FILE.svg")]
    pub plot: Option<PathBuf>,
}

/// Why nothing is printed.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// Material or energy.
    #[error(transparent)]
    Physics(#[from] PhysicsError),
    /// The plot.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// Standard output.
    #[error("standard output: {0}")]
    Output(#[from] std::io::Error),
}

/// Prints the table.
///
/// # Errors
/// When the material is not known, an energy is outside the tables, or the plot cannot be written.
pub fn run(args: &AttenuationArgs, out: &mut dyn Write) -> Result<(), TableError> {
    let material = Material::parse(&args.material)?;
    let rows: Vec<(f64, Coefficients)> =
        args.kev.iter().map(|kev| Ok((*kev, material.attenuation(*kev)?))).collect::<Result<_, PhysicsError>>()?;
    if args.json {
        let row = |(kev, c): &(f64, Coefficients)| {
            json!({
                "energy_kev": kev, "total_cm2_per_g": c.total_cm2_per_g, "photo_cm2_per_g": c.photo_cm2_per_g,
                "compton_cm2_per_g": c.compton_cm2_per_g, "rayleigh_cm2_per_g": c.rayleigh_cm2_per_g
            })
        };
        let rows: Vec<_> = rows.iter().map(row).collect();
        let value = json!({"material": material.name, "density_g_per_cm3": material.density_g_per_cm3, "rows": rows});
        writeln!(out, "{value:#}")?;
    } else {
        let density = material.density_g_per_cm3.map_or_else(|| "no nominal density".to_owned(), |d| format!("{d} g/cm3"));
        writeln!(out, "{} ({density}; {})", material.name, material.describe())?;
        writeln!(out, "{:>10}{:>13}{:>13}{:>13}{:>13}", "keV", "total", "photo", "Compton", "Rayleigh   cm2/g")?;
        for (kev, c) in &rows {
            writeln!(
                out,
                "{kev:>10}{:>13.5}{:>13.5}{:>13.5}{:>13.5}",
                c.total_cm2_per_g, c.photo_cm2_per_g, c.compton_cm2_per_g, c.rayleigh_cm2_per_g
            )?;
        }
    }
    if let Some(path) = &args.plot {
        let energies: Vec<f64> = (0..=580).map(|i| 5.0 + 0.25 * f64::from(i)).collect();
        let curve = |label: &str, pick: fn(&Coefficients) -> f64| -> Result<Series, PhysicsError> {
            let points = energies.iter().map(|e| Ok((*e, pick(&material.attenuation(*e)?)))).collect::<Result<_, PhysicsError>>()?;
            Ok(Series { label: label.to_owned(), points })
        };
        let series = [
            curve("total", |c| c.total_cm2_per_g)?,
            curve("photoelectric", |c| c.photo_cm2_per_g)?,
            curve("Compton", |c| c.compton_cm2_per_g)?,
            curve("Rayleigh", |c| c.rayleigh_cm2_per_g)?,
        ];
        let axis = |label: &str| Axis { label: label.to_owned(), logarithmic: true };
        let svg = line_plot(&material.name, &axis("energy (keV)"), &axis("mass attenuation (cm2/g)"), &series);
        write_atomically(path, |file| file.write_all(svg.as_bytes()))?;
    }
    Ok(())
}
