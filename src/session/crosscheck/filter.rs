//! What filters the beam, by telemetry, by the frame's tags and in the scene: each against the others.

use super::finding::Finding;
use crate::acquire::{FilterMaterial, FilterTags};
use crate::telemetry::CarmSample;

const CHECK: &str = "filter";
/// Copper beyond this changes the spectrum visibly; it is half a step of the filters of C-arms, which are of tenths of a millimetre.
const COPPER_MM: f64 = 0.05;
/// Aluminium beyond what the scene has in all.
const ALUMINIUM_MM: f64 = 0.3;
/// A tube, its housing and its collimator have at most this of their own, as aluminium.
const OWN_ALUMINIUM_MM: f64 = 4.0;

/// A metal of which filters are made, and how far what is said of it may be apart.
struct Metal {
    name: &'static str,
    /// What scenes call it.
    names: &'static [&'static str],
    material: FilterMaterial,
    told_mm: fn(&CarmSample) -> f64,
    /// Telemetry and tags, either way.
    apart_mm: f64,
    /// What is told beyond what the scene has, and what the scene has beyond what is told.
    beside_scene_mm: (f64, f64),
}

const METALS: [Metal; 2] = [
    Metal {
        name: "copper",
        names: &["copper", "cu"],
        material: FilterMaterial::Copper,
        told_mm: |beam| beam.filter_mm_cu,
        // Nothing but the filter wheel has copper: both mean the same sheets, in hundredths of a millimetre.
        apart_mm: COPPER_MM,
        beside_scene_mm: (COPPER_MM, COPPER_MM),
    },
    Metal {
        name: "aluminium",
        names: &["aluminium", "aluminum", "al"],
        material: FilterMaterial::Aluminum,
        told_mm: |beam| beam.filter_mm_al,
        // Both should mean added sheets alone. But one that is fixed in the housing is added to one maker and the tube's own to the next,
        // and some tell the total: either side may count what the other leaves out.
        apart_mm: OWN_ALUMINIUM_MM + ALUMINIUM_MM,
        // The scene's filtration holds the tube's own as well, which is not told: more aluminium there is ordinary.
        beside_scene_mm: (ALUMINIUM_MM, OWN_ALUMINIUM_MM),
    },
];

/// Telemetry against the frame's tags; where they agree or one of them is silent, what is said against the scene.
pub(super) fn check_filter(beam: Option<&CarmSample>, tags: Option<&FilterTags>, scene_json: &str) -> Option<Finding> {
    let apart = beam.zip(tags).and_then(|(beam, tags)| METALS.iter().find_map(|metal| against_tags(metal, beam, tags)));
    apart.or_else(|| METALS.iter().find_map(|metal| against_scene(metal, beam, tags, scene_json)))
}

/// The filter that telemetry reports against the one that is rendered.
pub(super) fn filter_against_scene(beam: &CarmSample, scene_json: &str) -> Option<Finding> {
    check_filter(Some(beam), None, scene_json)
}

fn against_tags(metal: &Metal, beam: &CarmSample, tags: &FilterTags) -> Option<Finding> {
    let (told_mm, [least_mm, most_mm]) = ((metal.told_mm)(beam), tags.thickness_mm(metal.material)?);
    // A filter that was not measured is NaN, and agrees with any. Zero is a measured none: the protocol has NaN for the rest.
    if !(told_mm > most_mm + metal.apart_mm || told_mm < least_mm - metal.apart_mm) {
        return None;
    }
    let detail = format!(
        "telemetry says {told_mm:.2} mm of {} in the beam, the frame's tags say {}",
        metal.name,
        thickness_words([least_mm, most_mm])
    );
    Some(Finding::warn(
        CHECK,
        detail,
        "check that the frame belongs to this exposure and that telemetry's filter is live; an arm that does not measure it has to send NaN",
    ))
}

fn against_scene(metal: &Metal, beam: Option<&CarmSample>, tags: Option<&FilterTags>, scene_json: &str) -> Option<Finding> {
    let told = beam.map(metal.told_mm).filter(|mm| !mm.is_nan()).map(|mm| ("telemetry says", [mm; 2]));
    let tagged = || Some(("the frame's tags say", tags?.thickness_mm(metal.material)?));
    let (who, [least_mm, most_mm]) = told.or_else(tagged)?;
    let scene_mm = filtration_mm(scene_json, metal.names)?;
    let (over_mm, under_mm) = metal.beside_scene_mm;
    if !(least_mm - scene_mm > over_mm || scene_mm - most_mm > under_mm) {
        return None;
    }
    let (name, seen) = (metal.name, thickness_words([least_mm, most_mm]));
    let detail = format!("{who} {seen} of {name} in the beam, the scene renders {scene_mm:.2} mm");
    Some(Finding::warn(CHECK, detail, format!("correct beam.filtration_mm.{name} of the scene, or the filter at the console")))
}

/// Least and most, one number where they are alike.
fn thickness_words([least_mm, most_mm]: [f64; 2]) -> String {
    if most_mm - least_mm >= 0.005 { format!("{least_mm:.2} to {most_mm:.2} mm") } else { format!("{most_mm:.2} mm") }
}

/// Thickness of a filter in the scene's file, 0 where it has none; `None` where the beam is not that of a tube.
fn filtration_mm(scene_json: &str, names: &[&str]) -> Option<f64> {
    let scene: serde_json::Value = serde_json::from_str(scene_json).ok()?;
    scene["beam"]["tube_kvp"].as_f64()?;
    let filters = scene["beam"]["filtration_mm"].as_object();
    let thickness =
        |(name, mm): (&String, &serde_json::Value)| names.contains(&name.to_lowercase().as_str()).then(|| mm.as_f64()).flatten();
    // The sum of nothing is −0.
    Some(filters.into_iter().flatten().filter_map(thickness).fold(0.0, |sum, mm| sum + mm))
}
