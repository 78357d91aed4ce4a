//! Beads against what else is known of the specimen: the scene's own bead spheres, metal in the CT, where there is matter at all.

use glam::DVec3;

use super::alignment::{Alignment, Mistake, Strictness, align, mistakes};
use super::finding::Finding;
use super::metal::{CtMetal, Specimen, bead_spheres, ct_metal};
use crate::beads::{BeadLayout, says_ras};
use crate::pose::span_mm;
use crate::scene::Scene;
use crate::session::file::Setup;

/// A bead stands at a sphere of the scene when it is this close.
const SPHERE_TOLERANCE_MM: f64 = 2.0;
/// More blobs than this are noise, teeth, calcifications: any layout finds some of them.
const MOST_BLOBS: usize = 300;
/// Beads stick to the skin at most this far from matter.
const REACH_MM: f64 = 8.0;
/// Beads further than this outside everything cannot come from this CT.
const FAR_OUTSIDE_MM: f64 = 30.0;
/// Layouts narrower than this were hardly meant in millimetres, nor wider than the second.
const PLAUSIBLE_SPAN_MM: (f64, f64) = (3.0, 2000.0);

/// All checks of a layout against its scene.
#[must_use]
pub fn check_beads(setup: &Setup, scene: &Scene, layout: &BeadLayout) -> Vec<Finding> {
    let points: Vec<DVec3> = layout.beads.iter().map(|bead| bead.lps_mm).collect();
    let stated = stated_system(setup);
    [
        check_descriptions(layout),
        check_span(&points),
        against_spheres(scene, layout, &points, stated),
        against_ct(scene, &points, stated),
        in_specimen(scene, &points, stated),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// What the markups file says of its axes: `LPS` or `RAS`.
fn stated_system(setup: &Setup) -> Option<&'static str> {
    let (path, text) = setup.beads.as_ref()?;
    says_ras(path, text.as_bytes()).map(|ras| if ras { "RAS" } else { "LPS" })
}

/// The remedy for a mistake.
fn remedy(mistake: &Mistake, stated: Option<&str>) -> String {
    let (is, other) = match stated {
        Some("RAS") => ("RAS", "LPS"),
        _ => ("LPS", "RAS"),
    };
    if mistake.is_swap() {
        format!("the file says {is} but its numbers are {other}: set its coordinateSystem to \"{other}\", or export it again")
    } else if let Some((_, key)) = mistake.unit() {
        let of_unit = unit_remedy(key);
        let of_both =
            format!("{of_unit}; the file says {is} but its numbers are {other}: set its coordinateSystem to \"{other}\" as well");
        if mistake.keeps_axes() { of_unit } else { of_both }
    } else {
        "export the beads again from the CT that the scene names, in its own axes and without a transform".to_owned()
    }
}

/// The remedy for beads in another unit, which a markups file calls `key` if it has a name for it.
fn unit_remedy(key: Option<&str>) -> String {
    match key {
        Some(key) => {
            format!("write \"coordinateUnits\": \"{key}\" into the file (.mrk.json), or export the beads in millimetres")
        }
        None => "export the beads in millimetres (coordinateUnits \"mm\")".to_owned(),
    }
}

/// What descriptions probably mean and do not say.
fn check_descriptions(layout: &BeadLayout) -> Option<Finding> {
    let remedy = "correct them in Slicer; docs/beads.md lists the words that are read";
    (!layout.doubts.is_empty()).then(|| Finding::warn("bead descriptions", layout.doubts.join("; "), remedy))
}

fn check_span(points: &[DVec3]) -> Option<Finding> {
    if points.len() < 2 {
        return None;
    }
    let span_mm = span_mm(points);
    let (least, most) = PLAUSIBLE_SPAN_MM;
    if span_mm >= least && span_mm <= most {
        return Some(Finding::pass("bead units", format!("{} beads over {span_mm:.0} mm", points.len())));
    }
    let (unit, key) = if span_mm < least { ("metres", Some("m")) } else { ("microns", Some("um")) };
    let detail =
        format!("{} beads lie within {span_mm:.3} mm of each other: they look like {unit} taken for millimetres", points.len());
    Some(Finding::fail("bead units", detail, unit_remedy(key)))
}

fn against_spheres(scene: &Scene, layout: &BeadLayout, points: &[DVec3], stated: Option<&str>) -> Option<Finding> {
    const CHECK: &str = "beads and spheres";
    let spheres = bead_spheres(scene);
    let strictness = Strictness { tolerance_mm: SPHERE_TOLERANCE_MM, fewest: 3, mistaken_share: 0.75 };
    let (n, m) = (points.len(), spheres.len());
    Some(match align(points, &spheres, &strictness) {
        Alignment::Unknown => Finding::pass(CHECK, format!("the scene has {m} metal spheres: nothing can be said of {n} beads")),
        Alignment::Fits { matched, off } if off.is_empty() || matched == m => {
            Finding::pass(CHECK, format!("{matched} of {n} beads stand at the scene's {m} metal spheres"))
        }
        Alignment::Fits { matched, off } => {
            let names: Vec<&str> = off.iter().map(|index| layout.beads[*index].name.as_str()).collect();
            let detail = format!(
                "{matched} of {n} beads stand at the scene's {m} metal spheres; {} more than {SPHERE_TOLERANCE_MM} mm away: {}",
                if names.len() == 1 { "one is" } else { "others are" },
                names.join(", ")
            );
            Finding::warn(CHECK, detail, "correct the positions, or remove the bead or its sphere")
        }
        Alignment::Mistaken { mistake, matched, as_stated } => {
            let detail = format!(
                "{as_stated} of {n} beads stand at the scene's {m} metal spheres, {matched} do as if {}",
                mistake.words()
            );
            Finding::fail(CHECK, detail, remedy(&mistake, stated))
        }
        Alignment::Apart { matched } => {
            let detail = format!(
                "{matched} of {n} beads stand at the scene's {m} metal spheres, and no exchange of axes, unit or origin explains it"
            );
            Finding::warn(CHECK, detail, "check that scene and beads are of the same specimen")
        }
    })
}

fn against_ct(scene: &Scene, points: &[DVec3], stated: Option<&str>) -> Option<Finding> {
    const CHECK: &str = "beads and CT metal";
    let (blobs, spacing_mm) = match ct_metal(scene) {
        CtMetal::NoCt => return None,
        CtMetal::TooMuch { voxels } => {
            return Some(Finding::pass(
                CHECK,
                format!("{voxels} voxels of the CT are metal: beads are not told apart, nothing can be said"),
            ));
        }
        CtMetal::Blobs { centres_lps_mm, spacing_mm } => (centres_lps_mm, spacing_mm),
    };
    let (n, m) = (points.len(), blobs.len());
    if m > MOST_BLOBS {
        return Some(Finding::pass(CHECK, format!("the CT has {m} bright spots: nothing can be said of {n} beads")));
    }
    let strictness = Strictness { tolerance_mm: (1.5 * spacing_mm).max(2.0), fewest: 4, mistaken_share: 0.8 };
    Some(match align(points, &blobs, &strictness) {
        Alignment::Unknown => Finding::pass(
            CHECK,
            format!("the CT shows {m} bright spots of bead size (ordinary where beads came later): nothing can be said"),
        ),
        Alignment::Fits { matched, .. } => {
            Finding::pass(CHECK, format!("{matched} of {n} beads lie at bright spots of the CT ({m} found)"))
        }
        Alignment::Mistaken { mistake, matched, as_stated } => {
            let detail =
                format!("{as_stated} of {n} beads lie at the CT's {m} bright spots, {matched} do as if {}", mistake.words());
            Finding::fail(CHECK, detail, remedy(&mistake, stated))
        }
        Alignment::Apart { matched } if matched == 0 && m >= n => {
            let detail = format!("the CT shows {m} bright spots of bead size, and none of {n} beads lies at one");
            Finding::warn(CHECK, detail, "check that CT and beads are of the same specimen")
        }
        Alignment::Apart { matched } => {
            Finding::pass(CHECK, format!("{matched} of {n} beads lie at bright spots of the CT ({m} found): nothing can be said"))
        }
    })
}

fn in_specimen(scene: &Scene, points: &[DVec3], stated: Option<&str>) -> Option<Finding> {
    const CHECK: &str = "beads in specimen";
    let specimen = Specimen::of(scene)?;
    let near = |mistake: Option<&Mistake>| {
        let mended = points.iter().map(|p| mistake.map_or(*p, |mistake| mistake.mend(*p)));
        mended.filter(|p| specimen.is_near(*p, REACH_MM)).count()
    };
    let (n, inside) = (points.len(), near(None));
    if inside == n {
        return Some(Finding::pass(CHECK, format!("all {n} beads lie in or on the specimen")));
    }
    let farthest_mm = points.iter().map(|p| specimen.outside_mm(*p)).fold(0.0, f64::max);
    let away = format!("{} of {n} beads are more than {REACH_MM:.0} mm from any matter of the scene", n - inside);
    let far = if farthest_mm > FAR_OUTSIDE_MM { format!(", up to {farthest_mm:.0} mm outside its box") } else { String::new() };
    // Axes exchanged any which way also land somewhere in a round specimen; only what people do is suggested.
    let (least, most) = PLAUSIBLE_SPAN_MM;
    // Points that are all shrunk to one lie in anything: a wrong unit must show in their distances as well.
    let unit_shows = !(span_mm(points) >= least && span_mm(points) <= most);
    let likely = mistakes().into_iter().find(|mistake| {
        (mistake.is_swap() || mistake.unit().is_some() && unit_shows)
            && near(Some(mistake)) as f64 >= 0.9 * n as f64
            && 2 * inside <= n
    });
    Some(match likely {
        Some(mistake) => {
            let detail = format!("{away}{far}, but {} lie in it as if {}", near(Some(&mistake)), mistake.words());
            Finding::fail(CHECK, detail, remedy(&mistake, stated))
        }
        None if inside == 0 => Finding::fail(
            CHECK,
            format!("{away}{far}"),
            "check that CT and beads are of the same specimen, in the same axes (LPS or RAS) and in mm",
        ),
        None => Finding::warn(
            CHECK,
            format!("{away}{far}"),
            "check these beads' positions, and that CT and beads are of the same specimen",
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::super::alignment::SWAPPED;
    use super::*;

    /// Of beads in metres and the other system only the unit was told.
    #[test]
    fn a_remedy_names_both_the_unit_and_the_axes_where_both_are_wrong() {
        let units: Vec<String> =
            mistakes().iter().filter(|mistake| mistake.unit().is_some()).map(|mistake| remedy(mistake, None)).collect();
        assert!(units[0].contains("\"m\"") && !units[0].contains("coordinateSystem"), "{}", units[0]);
        assert!(units[1].contains("\"m\"") && units[1].contains("coordinateSystem to \"RAS\""), "{}", units[1]);
        assert!(remedy(&SWAPPED, None).contains("coordinateSystem to \"RAS\""), "the control");
    }
}
