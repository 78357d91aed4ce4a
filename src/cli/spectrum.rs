//! `sidecarm spectrum`: tungsten spectra behind filters.

use std::io::Write;
use std::path::PathBuf;

use serde_json::json;

use super::attenuation::TableError;
use crate::image::plot::{Axis, Series, line_plot};
use crate::image::write_atomically;
use crate::scene::physics::{Material, Spectrum};

/// Spectrum of a tungsten anode behind filters: mean energy, half-value layers, photons per bin.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm spectrum --kvp 120 --filter aluminium=4.3 --filter copper=0.1 --json")]
pub struct SpectrumArgs {
    /// Tube voltage, 40 to 140 kV.
    #[arg(long)]
    pub kvp: f64,
    /// Anode angle, 6 to 20 degrees.
    #[arg(long, default_value_t = 12.0)]
    pub anode_angle: f64,
    /// Filter material and its thickness in mm; may be given several times.
    #[arg(long = "filter", value_name = "MATERIAL=MM", value_parser = filter)]
    pub filters: Vec<(String, f64)>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
    /// Draw the spectrum.
    #[arg(long, value_name = "FILE.svg")]
    pub plot: Option<PathBuf>,
}

fn filter(text: &str) -> Result<(String, f64), String> {
    let (material, mm) = text.split_once('=').ok_or("expected MATERIAL=MM, as aluminium=4.3")?;
    let mm: f64 = mm.parse().map_err(|_| format!("'{mm}' is no thickness in mm"))?;
    Ok((material.to_owned(), mm))
}

/// Prints the spectrum.
///
/// # Errors
/// When voltage, angle or a filter is outside its range, or the plot cannot be written.
pub fn run(args: &SpectrumArgs, out: &mut dyn Write) -> Result<(), TableError> {
    let filtration = args.filters.iter().map(|(name, mm)| Ok((Material::parse(name)?, *mm))).collect::<Result<Vec<_>, TableError>>()?;
    let spectrum = Spectrum::tungsten(args.kvp, args.anode_angle, &filtration)?;
    let (mean_kev, hvl1, hvl2) = (spectrum.mean_kev(), spectrum.hvl1_mm_al()?, spectrum.hvl2_mm_al()?);
    if args.json {
        let filters: serde_json::Map<_, _> = args.filters.iter().map(|(name, mm)| (name.clone(), json!(mm))).collect();
        let value = json!({
            "kvp": args.kvp, "anode_angle_deg": args.anode_angle, "filtration_mm": filters, "mean_kev": mean_kev,
            "hvl1_mm_al": hvl1, "hvl2_mm_al": hvl2, "bins": spectrum.bins
        });
        writeln!(out, "{value:#}")?;
    } else {
        writeln!(out, "{} kV, anode {} deg", args.kvp, args.anode_angle)?;
        writeln!(out, "mean energy {mean_kev:.2} keV, HVL1 {hvl1:.3} mm Al, HVL2 {hvl2:.3} mm Al")?;
        writeln!(out, "{:>8}{:>14}", "keV", "photons/bin")?;
        for bin in &spectrum.bins {
            writeln!(out, "{:>8.2}{:>14.4e}", bin.energy_kev, bin.fluence)?;
        }
    }
    if let Some(path) = &args.plot {
        let points = spectrum.bins.iter().map(|bin| (bin.energy_kev, bin.fluence)).collect();
        let axis = |label: &str| Axis { label: label.to_owned(), logarithmic: false };
        let title = format!("Tungsten, {} kV, {} deg", args.kvp, args.anode_angle);
        let series = [Series { label: String::new(), points }];
        let svg = line_plot(&title, &axis("energy (keV)"), &axis("share of photons per keV"), &series);
        write_atomically(path, |file| file.write_all(svg.as_bytes()))?;
    }
    Ok(())
}
