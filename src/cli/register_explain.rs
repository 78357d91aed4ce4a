//! `sidecarm register --explain`: which beads, which prior, what else was looked at and why it does not stand, what was told besides.

use std::path::Path;

use super::register_seen::Seen;
use crate::acquire::CollimatorTags;
use crate::mask::Masks;
use crate::pose::{BeadResidual, Pose, Shadow, Told, intrinsics_of};

/// What becomes of edges that a header states.
const LOOKED_AT: &str = "masked where the picture shows them";

/// What the frame's header, and the picture, say of numbers that a pose may rest on; `intrinsics` is the file that K was read from.
pub(super) fn told(intrinsics: Option<&Path>, seen: &Seen, masks: &Masks) -> Vec<Told> {
    let tags = &seen.frame.tags;
    let mut told = Vec::new();
    let mut say = |what: &str, value: String, used: bool, why: String| {
        told.push(Told { what: what.to_owned(), value, used, why });
    };
    if let (Some((k, ..)), Some(sid_mm), Some([across, down])) = (intrinsics_of(&seen.frame), tags.sid_mm, tags.pitch_mm) {
        let value = format!("SID {sid_mm} mm over a pitch of {across} x {down} mm is a focal length of {:.1} px", k.fx);
        let (used, why) = match (intrinsics, seen.intrinsics) {
            (Some(path), Some(own)) => {
                let off = 100.0 * (own.fx / k.fx - 1.0);
                (false, format!("that of {} counts, {:.1} px, which is {off:+.1} % from it", path.display(), own.fx))
            }
            (_, None) => (false, "K is solved from the beads".to_owned()),
            (None, Some(_)) => (true, "no --intrinsics says otherwise".to_owned()),
        };
        say("K by the header", value, used, why);
    }
    match &masks.field {
        Some(field) => say("open field by the picture", field.clone(), true, "beads are sought inside it".to_owned()),
        None => say("open field by the picture", "no edge of one".to_owned(), true, "beads are sought everywhere".to_owned()),
    }
    if let Some(collimator) = &tags.collimator {
        say("open field by the header", words_of(collimator), true, LOOKED_AT.to_owned());
    }
    if let Some(shutter) = &tags.display_shutter {
        say("display shutter by the header", words_of(shutter), true, LOOKED_AT.to_owned());
    }
    if let (Some(primary), Some(secondary)) = (tags.primary_deg, tags.secondary_deg) {
        let why = "they do not say where the specimen lies; --prior says where the pose is expected";
        say("positioner angles by the header", format!("{primary}°, {secondary}°"), false, why.to_owned());
    }
    if let Some(kvp) = tags.kvp {
        say("tube voltage by the header", format!("{kvp} kVp"), false, "P does not depend on it".to_owned());
    }
    told
}

fn words_of(collimator: &CollimatorTags) -> String {
    let edges = collimator.edges_px.map(|[left, top, right, bottom]| format!("edges at {left}, {top}, {right}, {bottom} px"));
    let iris = collimator.radius_px.map(|radius| format!("iris of radius {radius} px"));
    let polygon = (!collimator.corners_px.is_empty()).then(|| format!("polygon of {} corners", collimator.corners_px.len()));
    let all: Vec<String> = [edges, iris, polygon].into_iter().flatten().collect();
    if all.is_empty() { "no numbers".to_owned() } else { all.join(", ") }
}

/// All of it in words, a line each.
pub(super) fn lines(pose: &Pose) -> Vec<String> {
    let with_sigmas = |bead: &BeadResidual| match bead.off_sigmas {
        Some(sigmas) => format!("{} ({sigmas:.1} σ)", bead.name),
        None => bead.name.clone(),
    };
    let own = || pose.beads.iter().filter(|bead| !bead.check);
    let used: Vec<String> = own().filter(|bead| bead.used).map(with_sigmas).collect();
    let left: Vec<String> = own()
        .filter(|bead| !bead.used)
        .map(|bead| format!("{}, {}", with_sigmas(bead), bead.reason.as_deref().unwrap_or("no shadow")))
        .collect();
    let mut lines = Vec::new();
    match used.is_empty() {
        true => lines.push("P rests on no bead".to_owned()),
        false => {
            let (count, all) = (used.len(), used.join(", "));
            lines.push(format!("P rests on {count} beads, each so far from where the others put it: {all}"));
        }
    }
    if pose.is_accepted() && !left.is_empty() {
        lines.push(format!("it does not rest on {} beads: {}", left.len(), left.join("; ")));
    }
    if let Some(explained) = &pose.explained {
        lines.push(explained.prior.as_ref().map_or("no prior was given".to_owned(), ToString::to_string));
        if !explained.readings.is_empty() {
            lines.push("other readings of the frame:".to_owned());
            lines.extend(explained.readings.iter().map(|reading| format!("  {reading}")));
        }
        if !explained.told.is_empty() {
            lines.push("told besides:".to_owned());
            lines.extend(explained.told.iter().map(|told| format!("  {told}")));
        }
    }
    lines.push(format!(
        "{:>4} {:>10} {:>10} {:>9} {:>9} {:>8} {:>8} {:>8}  shadows, best first",
        "", "u px", "v px", "sigma px", "radius px", "snr", "quality", "misfit"
    ));
    lines.extend(pose.shadows.iter().enumerate().map(|(n, shadow)| {
        let [u, v] = shadow.image_px;
        let made_of_it = shadow.bead.as_deref().unwrap_or("belongs to no bead");
        let Shadow { sigma_px, radius_px, snr, flags, .. } = shadow;
        let [quality, misfit] = [shadow.quality, shadow.misfit].map(|share| share.map_or("?".to_owned(), |x| format!("{x:.3}")));
        let told: String = flags.words().iter().map(|words| format!(", {words}")).collect();
        format!(
            "{:>4} {u:10.3} {v:10.3} {sigma_px:9.3} {radius_px:9.2} {snr:8.1} {quality:>8} {misfit:>8}  {made_of_it}{told}",
            n + 1
        )
    }));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::geometry::Intrinsics;
    use crate::image::Image;

    #[test]
    fn what_speaks_against_a_shadow_is_told_with_it() {
        let flags = crate::beads::Flags { overlapping: true, over_structure: true, ..Default::default() };
        let flagged = Shadow { radius_px: 4.0, quality: Some(0.25), flags, ..Shadow::default() };
        let told = lines(&Pose { shadows: vec![flagged, Shadow::default()], ..Pose::default() });
        let [.., first, second] = told.as_slice() else { panic!("{told:?}") };
        assert!(first.ends_with("0.250        ?  belongs to no bead, overlapping, over structure"), "{first}");
        assert!(second.ends_with("belongs to no bead"), "the control: {second}");
    }

    /// What the header says of K, shutters, angles and tube, and what is made of it.
    #[test]
    fn what_the_header_tells_is_named_with_what_counts_instead() {
        let k = |focal_px: f64| Intrinsics { fx: focal_px, fy: focal_px, skew: 0.0, cx: 31.5, cy: 23.5 };
        let seen = |own: Option<Intrinsics>| {
            let mut frame = Frame::from_pixels("f", Image::filled(64, 48, 1.0f32), Domain::Linear).expect("a frame");
            let tags = &mut frame.tags;
            (tags.sid_mm, tags.pitch_mm, tags.kvp) = (Some(1000.0), Some([0.2; 2]), Some(80.0));
            (tags.primary_deg, tags.secondary_deg) = (Some(30.0), Some(-5.0));
            tags.collimator = Some(CollimatorTags { edges_px: Some([1.0, 2.0, 60.0, 40.0]), ..CollimatorTags::default() });
            tags.display_shutter = Some(CollimatorTags { corners_px: vec![[1.0; 2]; 3], ..CollimatorTags::default() });
            Seen {
                frame,
                intrinsics: own,
                is_k_of_header: false,
                prior: None,
                pitch_mm: None,
                turn_rad: 0.0,
                off_pitch: None,
                notes: Vec::new(),
            }
        };
        let words = |path: Option<&str>, own: Option<Intrinsics>| {
            let told = told(path.map(Path::new), &seen(own), &Masks::default());
            told.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
        };
        let stated = words(Some("k.json"), Some(k(5250.0)));
        for expected in [
            "K by the header: SID 1000 mm over a pitch of 0.2 x 0.2 mm is a focal length of 5000.0 px; not used: that of k.json counts, \
             5250.0 px, which is +5.0 % from it",
            "open field by the picture: no edge of one; beads are sought everywhere",
            "open field by the header: edges at 1, 2, 60, 40 px; masked where the picture shows them",
            "display shutter by the header: polygon of 3 corners; masked where the picture shows them",
            "positioner angles by the header: 30°, -5°; not used",
            "tube voltage by the header: 80 kVp; not used: P does not depend on it",
        ] {
            assert!(stated.contains(expected), "{expected:?} in\n{stated}");
        }
        let header = words(None, Some(k(5000.0)));
        assert!(header.contains("5000.0 px; no --intrinsics says otherwise"), "{header}");
        assert!(words(None, None).contains("not used: K is solved from the beads"));
    }
}
