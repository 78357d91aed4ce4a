//! What filters the beam, by telemetry, by the frame's tags and in the scene: each against the others.

use super::finding::Finding;
use crate::acquire::{
    ALUMINIUM_APART_MM, AddedFilter, COPPER_APART_MM, FilterMaterial, FilterTags, OWN_ALUMINIUM_MM, thickness_words,
};
use crate::telemetry::CarmSample;

const CHECK: &str = "filter";

/// A metal of which filters are made, and how far what is said of it may be apart.
struct Metal {
    material: FilterMaterial,
    told_mm: fn(&CarmSample) -> f64,
    /// Telemetry and tags, either way.
    apart_mm: f64,
    /// What is told beyond what the scene has, and what the scene has beyond what is told.
    beside_scene_mm: (f64, f64),
}

const METALS: [Metal; 2] = [
    Metal {
        material: FilterMaterial::Copper,
        told_mm: |beam| beam.filter_mm_cu,
        // Nothing but the filter wheel has copper: both mean the same sheets, in hundredths of a millimetre.
        apart_mm: COPPER_APART_MM,
        beside_scene_mm: (COPPER_APART_MM, COPPER_APART_MM),
    },
    Metal {
        material: FilterMaterial::Aluminum,
        told_mm: |beam| beam.filter_mm_al,
        // Both should mean added sheets alone.
        apart_mm: OWN_ALUMINIUM_MM + ALUMINIUM_APART_MM,
        // The scene's filtration holds the tube's own as well, which is not told: more aluminium there is ordinary.
        beside_scene_mm: (ALUMINIUM_APART_MM, OWN_ALUMINIUM_MM),
    },
];

/// Telemetry against the frame's tags; where they agree or one of them is silent, what is said against the scene.
pub(super) fn check_filter(beam: Option<&CarmSample>, tags: Option<&FilterTags>, scene_json: &str) -> Option<Finding> {
    let tagged = tags.map(AddedFilter::by_header);
    let tagged = tagged.as_ref();
    let apart = beam.zip(tagged).and_then(|(beam, tagged)| METALS.iter().find_map(|metal| against_tags(metal, beam, tagged)));
    let found = apart.or_else(|| METALS.iter().find_map(|metal| against_scene(metal, beam, tagged, scene_json)));
    found.or_else(|| not_understood(tags?))
}

/// A filter of which something is known, and not all.
fn not_understood(tags: &FilterTags) -> Option<Finding> {
    tags.layers.iter().any(|layer| layer.material == FilterMaterial::Other).then(|| {
        let known = FilterMaterial::ALL.map(|material| material.names()[0]).join(", ");
        let detail = format!(
            "the frame's tags name a filter material that is none of the standard's ({known}): it is not known what it is"
        );
        Finding::warn(
            CHECK,
            detail,
            "see at the console what is in the beam: the scene and the air frames have to be of that filter",
        )
    })
}

/// The filter that telemetry reports against the one that is rendered.
pub(super) fn filter_against_scene(beam: &CarmSample, scene_json: &str) -> Option<Finding> {
    check_filter(Some(beam), None, scene_json)
}

fn against_tags(metal: &Metal, beam: &CarmSample, tagged: &AddedFilter) -> Option<Finding> {
    let (told_mm, [least_mm, most_mm]) = ((metal.told_mm)(beam), tagged.thickness_mm(metal.material, true)?);
    // A filter that was not measured is NaN, and agrees with any. Zero is a measured none: the protocol has NaN for the rest.
    if !(told_mm > most_mm + metal.apart_mm || told_mm < least_mm - metal.apart_mm) {
        return None;
    }
    let detail = format!(
        "telemetry says {told_mm:.2} mm of {} in the beam, the frame's tags say {}",
        metal.material.names()[0],
        thickness_words([least_mm, most_mm])
    );
    Some(Finding::warn(
        CHECK,
        detail,
        "check that the frame belongs to this exposure and that telemetry's filter is live; an arm that does not measure it has to send NaN",
    ))
}

fn against_scene(metal: &Metal, beam: Option<&CarmSample>, tagged: Option<&AddedFilter>, scene_json: &str) -> Option<Finding> {
    let told = beam.map(metal.told_mm).filter(|mm| !mm.is_nan()).map(|mm| ("telemetry says", [mm; 2]));
    let by_tags = || Some(("the frame's tags say", tagged?.thickness_mm(metal.material, true)?));
    let (who, [least_mm, most_mm]) = told.or_else(by_tags)?;
    let scene_mm = filtration_mm(scene_json, metal.material)?;
    let (over_mm, under_mm) = metal.beside_scene_mm;
    if !(least_mm - scene_mm > over_mm || scene_mm - most_mm > under_mm) {
        return None;
    }
    let (name, seen) = (metal.material.names()[0], thickness_words([least_mm, most_mm]));
    let detail = format!("{who} {seen} of {name} in the beam, the scene renders {scene_mm:.2} mm");
    Some(Finding::warn(CHECK, detail, format!("correct beam.filtration_mm.{name} of the scene, or the filter at the console")))
}

/// Thickness of a filter in the scene's file, 0 where it has none; `None` where the beam is not that of a tube.
fn filtration_mm(scene_json: &str, material: FilterMaterial) -> Option<f64> {
    let scene: serde_json::Value = serde_json::from_str(scene_json).ok()?;
    scene["beam"]["tube_kvp"].as_f64()?;
    let filters = scene["beam"]["filtration_mm"].as_object();
    let thickness = |(name, mm): (&String, &serde_json::Value)| {
        (FilterMaterial::named(name) == Some(material)).then(|| mm.as_f64()).flatten()
    };
    // The sum of nothing is −0.
    Some(filters.into_iter().flatten().filter_map(thickness).fold(0.0, |sum, mm| sum + mm))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::FilterLayer;

    /// The choice of a panel's air frames said another filter, and this said nothing.
    #[test]
    fn copper_that_the_tags_do_not_list_is_none() {
        let listed = |material| {
            let layers = vec![FilterLayer { material, thickness_mm: Some([0.3; 2]) }];
            FilterTags { form: None, layers }
        };
        let beam = CarmSample { filter_mm_cu: 0.3, ..CarmSample::UNTOLD };
        let said = |tags: &FilterTags| check_filter(Some(&beam), Some(tags), "{}").map(|found| found.to_string());
        let words = said(&listed(FilterMaterial::Aluminum)).expect("another filter");
        assert!(words.contains("telemetry says 0.30 mm of copper") && words.contains("tags say 0.00 mm"), "{words}");
        assert_eq!(said(&listed(FilterMaterial::Copper)), None, "the control");
        assert_eq!(said(&FilterTags::default()), None, "nothing is listed");
    }

    /// Its word was dropped, and what was left counted as all that is in the beam: copper, for one, was none.
    #[test]
    fn a_material_that_nobody_understands_is_said_and_may_be_any() {
        let layer = |material| FilterLayer { material, thickness_mm: Some([0.3; 2]) };
        let layers = vec![layer(FilterMaterial::Aluminum), layer(FilterMaterial::Other)];
        let tags = FilterTags { form: None, layers };
        let beam = CarmSample { filter_mm_cu: 0.3, ..CarmSample::UNTOLD };
        let words = check_filter(Some(&beam), Some(&tags), "{}").map(|found| found.to_string()).unwrap_or_default();
        assert!(words.contains("none of the standard's") && !words.contains("0.00 mm"), "{words}");
    }
}
