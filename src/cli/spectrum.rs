//! `sidecarm spectrum`: a tungsten anode's spectrum behind filters, as every render uses it.

use std::io::Write;
use std::path::PathBuf;
use std::str::FromStr;

use clap::builder::{PathBufValueParser, TypedValueParser};
use serde::Serialize;

use super::attenuation::{TableError, print, write_plot};
use super::named;
use crate::image::plot::{Axis, Mark, Plot, Scale, Series, Stroke};
use crate::scene::physics::{Bin, Material, Spectrum};

/// Print the spectrum of a tungsten anode behind filters: mean energy, half-value layers, bins.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm spectrum --kvp 120 --filter aluminium=4.3
  sidecarm spectrum --kvp 70 --anode-angle 9 --filter aluminium=2.5 --filter copper=0.1 --json --plot beam.svg

Half-value layers are of aluminium and weigh photons by air kerma. Without --filter the anode's bare output is shown, which no tube emits.
Source: SpekPy 2.5, 40 to 140 kV, 6 to 20 degrees; filters by our own attenuation tables.")]
pub struct SpectrumArgs {
    /// Tube voltage in kV, 40 to 140
    #[arg(long, value_name = "KV", allow_negative_numbers = true)]
    pub kvp: f64,
    /// Anode angle in degrees, 6 to 20
    #[arg(long, value_name = "DEG", default_value_t = 12.0, allow_negative_numbers = true)]
    pub anode_angle: f64,
    /// A filter: material and thickness in mm; may be given several times, also with formulas of known density
    #[arg(long, value_name = "MATERIAL=MM")]
    pub filter: Vec<FilterArg>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    pub json: bool,
    /// Draw the spectrum
    #[arg(long, value_name = "FILE.svg", value_parser = PathBufValueParser::new().try_map(named::svg))]
    pub plot: Option<PathBuf>,
}

/// `aluminium=4.3`, not yet looked up.
#[derive(Clone, Debug, PartialEq)]
pub struct FilterArg {
    /// As typed.
    pub material: String,
    /// As typed; the physics refuses negative ones.
    pub thickness_mm: f64,
}

impl FromStr for FilterArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (material, thickness) =
            text.rsplit_once('=').ok_or_else(|| format!("'{text}' is not MATERIAL=MM, for example aluminium=4.3"))?;
        let thickness_mm = thickness.trim().parse().map_err(|_| format!("thickness '{thickness}' is not a number of mm"))?;
        Ok(Self { material: material.trim().to_owned(), thickness_mm })
    }
}

#[derive(Serialize)]
struct Answer {
    kvp: f64,
    anode_angle_deg: f64,
    /// By name; the same material given twice adds up.
    filtration_mm: serde_json::Map<String, serde_json::Value>,
    mean_kev: f64,
    hvl1_mm_al: f64,
    hvl2_mm_al: f64,
    /// Of `bins[].fluence`.
    fluence_unit: &'static str,
    total_fluence: f64,
    bins: Vec<BinAnswer>,
}

#[derive(Serialize)]
struct BinAnswer {
    energy_kev: f64,
    fluence: f64,
    fraction: f64,
}

/// Prints the answer to `out`, and draws it where asked.
///
/// # Errors
/// When voltage, angle or a filter is outside what is known, or something cannot be written; nothing is printed then.
pub fn run(args: &SpectrumArgs, out: &mut dyn Write) -> Result<(), TableError> {
    let mut filtration = Vec::with_capacity(args.filter.len());
    for filter in &args.filter {
        let material = Material::parse(&filter.material)?;
        if material.density_g_per_cm3.is_none() {
            return Err(TableError::FilterDensity { name: material.name });
        }
        filtration.push((material, filter.thickness_mm));
    }
    let spectrum = Spectrum::tungsten_output(args.kvp, args.anode_angle, &filtration)?;
    let answer = answer(args, &filtration, &spectrum)?;
    if let Some(path) = &args.plot {
        write_plot(path, &plot(args, &answer))?;
    }
    if args.json {
        return print(&(serde_json::to_string_pretty(&answer)? + "\n"), out);
    }
    print(&table(args, &answer), out)
}

fn answer(args: &SpectrumArgs, filtration: &[(Material, f64)], spectrum: &Spectrum) -> Result<Answer, TableError> {
    let total_fluence: f64 = spectrum.bins.iter().map(|bin| bin.fluence).sum();
    let bin = |bin: &Bin| BinAnswer { energy_kev: bin.energy_kev, fluence: bin.fluence, fraction: bin.fluence / total_fluence };
    let mut filtration_mm = serde_json::Map::new();
    for (material, thickness_mm) in filtration {
        let before = filtration_mm.get(&material.name).and_then(serde_json::Value::as_f64).unwrap_or(0.0);
        filtration_mm.insert(material.name.clone(), (before + thickness_mm).into());
    }
    Ok(Answer {
        kvp: args.kvp,
        anode_angle_deg: args.anode_angle,
        filtration_mm,
        mean_kev: spectrum.mean_kev(),
        hvl1_mm_al: spectrum.hvl1_mm_al()?,
        hvl2_mm_al: spectrum.hvl2_mm_al()?,
        fluence_unit: "photons per bin, per cm2 and mAs at 1 m",
        total_fluence,
        bins: spectrum.bins.iter().map(bin).collect(),
    })
}

/// `120 kV tungsten, 12 deg anode, aluminium 4.3 mm`.
fn beam(args: &SpectrumArgs) -> String {
    let mut words = format!("{} kV tungsten, {} deg anode", args.kvp, args.anode_angle);
    for filter in &args.filter {
        words.push_str(&format!(", {} {} mm", filter.material, filter.thickness_mm));
    }
    if args.filter.is_empty() {
        words.push_str(", no filter");
    }
    words
}

fn table(args: &SpectrumArgs, answer: &Answer) -> String {
    let mut text = format!(
        "{}\nmean energy {:>9.3} keV\nHVL1        {:>9.3} mm Al\nHVL2        {:>9.3} mm Al\nfluence     {:>9.3e} photons per cm2 and mAs at 1 m\n\n",
        beam(args),
        answer.mean_kev,
        answer.hvl1_mm_al,
        answer.hvl2_mm_al,
        answer.total_fluence,
    );
    text.push_str(&format!("{:>9}  {:>12}  {:>10}\n", "energy", "fluence", "fraction"));
    text.push_str(&format!("{:>9}  {:>12}  {:>10}\n", "keV", "/cm2/mAs", "1"));
    for bin in &answer.bins {
        text.push_str(&format!("{:>9.2}  {:>12.4e}  {:>10.3e}\n", bin.energy_kev, bin.fluence, bin.fraction));
    }
    text
}

fn plot(args: &SpectrumArgs, answer: &Answer) -> Plot {
    Plot {
        title: beam(args),
        x: Axis::new("photon energy / keV", Scale::Linear),
        y: Axis::new("share of photons per bin", Scale::Linear),
        series: vec![Series {
            points: answer.bins.iter().map(|bin| [bin.energy_kev, bin.fraction]).collect(),
            stroke: Stroke::Steps,
            colour: Some(1),
            ..Series::default()
        }],
        marks: vec![Mark { x: answer.mean_kev, label: format!("mean {:.1} keV", answer.mean_kev) }],
        ..Plot::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Typed {
        #[command(flatten)]
        args: SpectrumArgs,
    }

    fn json(words: &[&str]) -> serde_json::Value {
        let typed = Typed::try_parse_from(["spectrum"].iter().chain(words)).expect("usage");
        let mut out = Vec::new();
        run(&typed.args, &mut out).expect("inside");
        serde_json::from_slice(&out).expect("JSON")
    }

    #[test]
    fn json_has_the_documented_keys_and_sums() {
        let value = json(&["--kvp", "120", "--filter", "aluminium=4", "--filter", "Aluminium=0.3", "--json"]);
        assert!((value["mean_kev"].as_f64().expect("number") / 57.5 - 1.0).abs() < 0.01);
        assert!((value["hvl1_mm_al"].as_f64().expect("number") / 5.49 - 1.0).abs() < 0.01);
        assert!(value["hvl2_mm_al"].as_f64() > value["hvl1_mm_al"].as_f64());
        assert!((value["filtration_mm"]["aluminium"].as_f64().expect("number") - 4.3).abs() < 1e-12);
        let bins = value["bins"].as_array().expect("bins");
        let sum = |key: &str| bins.iter().map(|bin| bin[key].as_f64().expect("number")).sum::<f64>();
        assert!(bins.len() > 100 && (sum("fraction") - 1.0).abs() < 1e-9);
        assert!((sum("fluence") / value["total_fluence"].as_f64().expect("number") - 1.0).abs() < 1e-9);
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (words, says) in [
            (["--kvp", "120", "--filter", "aluminium"], "MATERIAL=MM"),
            (["--kvp", "120", "--filter", "aluminium=thick"], "thick"),
            (["--kvp", "120", "--filter", "aluminum=1"], "aluminium"),
            (["--kvp", "500", "--filter", "aluminium=1"], "140"),
            (["--kvp", "80", "--filter", "lead=900"], "nothing passes"),
        ] {
            let message = match Typed::try_parse_from(["spectrum"].iter().chain(&words)) {
                Err(usage) => usage.to_string(),
                Ok(typed) => {
                    let mut out = Vec::new();
                    let error = run(&typed.args, &mut out).expect_err(says).to_string();
                    assert!(out.is_empty(), "nothing is printed before the error");
                    error
                }
            };
            assert!(message.contains(says), "{words:?}: {message}");
        }
    }

    #[test]
    fn the_plot_names_the_beam() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("s.svg");
        json(&["--kvp", "73", "--filter", "copper=0.1", "--json", "--plot", &path.to_string_lossy()]);
        let svg = std::fs::read_to_string(&path).expect("written");
        assert!(svg.contains("73 kV tungsten, 12 deg anode, copper 0.1 mm") && svg.contains("photon energy / keV"), "{svg}");
    }
}
