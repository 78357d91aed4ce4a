//! What else speaks for the cause of a refusal: beads in another unit, K against the frame's own header, a picture that is saturated, in blocks
//! or lined.

use glam::DVec3;

use super::artefact::Artefact;
use super::by_header::{Focal, OtherFocal};
use super::record::Pose;
use super::refusal::Refusal;
use super::span::span_mm;
use crate::acquire::Frame;

/// Beads on a specimen that a C-arm sees lie at least so far apart, and at most, mm.
const PLAUSIBLE_SPAN_MM: (f64, f64) = (40.0, 1500.0);
/// Layouts narrower than this are in metres rather than in centimetres.
const METRES_BELOW_MM: f64 = 3.0;
/// A picture of which more than this share is at the end of the scale shows no beads there.
const SATURATED: f64 = 0.5;
/// How the words begin that K is not that of the frame's own header.
const K_SAYS: &str = "K says f ";

impl Pose {
    /// Adds to the reason of a refusal what else is known that may be its cause; `focal_sigma_px`: with which K's focal length is stated.
    pub(super) fn hear_refused(&mut self, frame: &Frame, focal_sigma_px: f64) {
        let besides = [self.other_unit(), self.other_focal(frame, focal_sigma_px)];
        let refusal = match &mut self.refusal {
            // What the session's own checks said, or a fault of this program, has its cause already.
            None | Some(Refusal::Layout { .. } | Refusal::Fault { .. }) => return,
            Some(refusal) => refusal,
        };
        let share = frame.clipping.saturated_share;
        let saturated = (share > SATURATED).then(|| {
            format!("{:.0} % of the frame is saturated: lower the dose, or choose another window or export", 100.0 * share)
        });
        let artefacts = if rests_on_looks(refusal) { Artefact::of(&frame.pixels) } else { Vec::new() };
        let mut hiding: Vec<String> = saturated.into_iter().chain(artefacts.iter().map(ToString::to_string)).collect();
        // It is what to do about too few shadows, in place of more dose.
        if let Refusal::TooFewShadows { hidden_by, .. } = refusal {
            *hidden_by = std::mem::take(&mut hiding);
        }
        // What was said besides the refusal stays.
        let told = self.reason.take().filter(|_| !matches!(refusal, Refusal::TooFewShadows { .. }));
        let besides = hiding.into_iter().chain(besides.into_iter().flatten());
        let words: Vec<String> = std::iter::once(told.unwrap_or_else(|| refusal.to_string())).chain(besides).collect();
        self.reason = Some(words.join("; "));
    }

    /// Whether it is refused, and K, as given, is not that of the frame's own header: that comes before whatever the refusal is about.
    #[must_use]
    pub fn is_refused_against_header(&self) -> bool {
        !self.is_accepted() && self.reason.as_deref().is_some_and(|reason| reason.contains(K_SAYS))
    }

    /// That the beads lie nearer together, or farther apart, than on any specimen.
    fn other_unit(&self) -> Option<String> {
        let places: Vec<DVec3> = self.beads.iter().filter(|bead| !bead.check).map(|bead| bead.lps_mm).collect();
        let span_mm = Some(span_mm(&places)).filter(|mm| *mm > 0.0)?;
        let (least, most) = PLAUSIBLE_SPAN_MM;
        let (unit, key) = match span_mm {
            mm if mm < METRES_BELOW_MM => ("metres", "m"),
            mm if mm < least => ("centimetres", "cm"),
            mm if mm > most => ("microns", "um"),
            _ => return None,
        };
        Some(format!(
            "the layout is {span_mm:.3} mm across: is it in {unit}? where it is so write \"coordinateUnits\": \"{key}\" into its file, or \
             export it in mm"
        ))
    }

    /// That K, as given, is not that of the frame's own header.
    fn other_focal(&self, frame: &Frame, sigma_px: f64) -> Option<String> {
        // K that was solved for a pose that is refused is nobody's word.
        let given =
            self.intrinsics.filter(|_| self.intrinsics_source.as_deref().is_none_or(|source| !source.starts_with("solved")));
        let px = given?.fx;
        let OtherFocal { header_px, own_pitch_mm, .. } = Focal { px, sigma_px, pitch_mm: self.pitch_mm }.other_by(frame)?;
        let pitch = if own_pitch_mm.is_some() { "K's own pitch" } else { "pitch" };
        Some(format!("{K_SAYS}{px:.0} px, the header's SID and {pitch} say {header_px:.0} px"))
    }
}

/// Whether shadows that are not found, or that are none, may be the cause.
fn rests_on_looks(refusal: &Refusal) -> bool {
    use Refusal::{Chance, Missing, NoMatch, TooFewShadows};
    matches!(refusal, TooFewShadows { .. } | NoMatch { .. } | Chance { .. } | Missing { .. })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::beads::{Bead, BeadLayout};
    use crate::geometry::Intrinsics;
    use crate::image::Image;
    use crate::pose::Registration;
    use crate::random::{Purpose, Stream};

    fn frame(pitch_mm: Option<f64>, saturated_share: f64) -> Frame {
        let mut frame = Frame::from_pixels("f", Image::filled(64, 48, 1.0f32), Domain::Linear).expect("a frame");
        (frame.tags.sid_mm, frame.tags.pitch_mm) = (Some(1000.0), pitch_mm.map(|mm| [mm; 2]));
        frame.clipping.saturated_share = saturated_share;
        frame
    }

    fn few_shadows(prior_puts_into_frame: Option<[usize; 2]>) -> Refusal {
        Refusal::TooFewShadows { found: 0, required: 4, prior_puts_into_frame, hidden_by: Vec::new() }
    }

    /// Why it is refused in a frame that says 5000 px and is saturated to this share.
    fn heard(mut pose: Pose, saturated_share: f64) -> String {
        pose.hear_header(&frame(Some(0.2), saturated_share), false, 0.0);
        pose.reason.expect("a reason")
    }

    fn reason(across_mm: f64, focal_px: f64, saturated_share: f64, refusal: &Refusal) -> String {
        heard(refused(across_mm, focal_px, refusal), saturated_share)
    }

    /// Of beads `across_mm` apart.
    fn refused(across_mm: f64, focal_px: f64, refusal: &Refusal) -> Pose {
        let beads = vec![Bead::new("a", DVec3::ZERO), Bead::new("b", across_mm * DVec3::X)];
        let layout = BeadLayout { beads, ..BeadLayout::none() };
        let intrinsics = Some(Intrinsics { fx: focal_px, fy: focal_px, skew: 0.0, cx: 31.5, cy: 23.5 });
        Registration { intrinsics, ..Registration::new([64, 48], &layout) }.refuse(refusal)
    }

    /// Beads in metres were on a line, in centimetres they were matched by no pose, and half a focal length was an accident.
    #[test]
    fn a_refusal_says_what_of_layout_k_and_picture_is_implausible() {
        let none = Refusal::NoMatch { shadows: 9, beads: 9 };
        assert_eq!(reason(160.0, 5000.0, 0.1, &none), none.to_string(), "the control");
        for (across_mm, unit) in [(0.16, "in metres? where it is so write \"coordinateUnits\": \"m\""), (16.0, "in centimetres?")]
        {
            let words = reason(across_mm, 5000.0, 0.1, &none);
            assert!(words.starts_with(&none.to_string()) && words.contains(unit), "{words}");
        }
        let words = reason(160.0, 2500.0, 0.1, &none);
        assert!(words.ends_with("K says f 2500 px, the header's SID and pitch say 5000 px"), "{words}");
        let against = |focal_px: f64| {
            let mut pose = refused(160.0, focal_px, &none);
            pose.hear_header(&frame(Some(0.2), 0.1), false, 0.0);
            pose.is_refused_against_header()
        };
        assert!(against(2500.0) && against(10_000.0) && !against(5000.0));
        let few = few_shadows;
        let words = reason(160.0, 5000.0, 0.99, &few(None));
        assert!(words.contains("99 % of the frame is saturated") && !words.contains("raise the dose"), "{words}");
        assert!(reason(160.0, 5000.0, 0.1, &few(None)).contains("raise the dose"));
        // The arm looks beside the beads, and too much light is there besides.
        let words = reason(160.0, 5000.0, 0.99, &few(Some([1, 9])));
        assert!(
            words.contains("1 of the 9 beads lie in the frame") && words.contains("; 99 % of the frame is saturated"),
            "{words}"
        );
        let words = reason(160.0, 5000.0, 0.99, &none);
        assert!(words.starts_with(&none.to_string()) && words.contains("; 99 % of the frame is saturated"), "{words}");
        let solved = Pose { intrinsics_source: Some("solved".to_owned()), ..refused(160.0, 2500.0, &none) };
        assert_eq!(heard(solved, 0.1), none.to_string());
        let told = Refusal::Layout { detail: "told".to_owned() };
        assert_eq!(reason(0.16, 2500.0, 0.99, &told), "told");
    }

    /// Of K that was 4 % off an accepted pose was in doubt, and nothing was said of one that was refused for it; without a pixel spacing in the
    /// header nothing was said at all.
    #[test]
    fn k_is_off_the_header_by_the_rule_of_accepted_poses() {
        let none = Refusal::NoMatch { shadows: 9, beads: 9 };
        let told = |focal_px: f64, header_mm: Option<f64>, own_mm: Option<f64>, sigma_px: f64| {
            let mut pose = Pose { pitch_mm: own_mm, ..refused(160.0, focal_px, &none) };
            pose.hear_header(&frame(header_mm, 0.0), false, sigma_px);
            pose.reason.unwrap_or_default().replacen(&none.to_string(), "", 1)
        };
        assert_eq!(told(5200.0, Some(0.2), None, 0.0), "; K says f 5200 px, the header's SID and pitch say 5000 px");
        assert_eq!(told(5200.0, None, Some(0.2), 0.0), "; K says f 5200 px, the header's SID and K's own pitch say 5000 px");
        let silent = [told(5100.0, Some(0.2), None, 0.0), told(5200.0, Some(0.2), None, 80.0), told(5200.0, None, None, 0.0)];
        assert_eq!(silent, [""; 3], "2 %; three of its standard deviations; nobody knows a pitch");
    }

    /// A moiré hid all beads, and the advice was to open the collimator.
    #[test]
    fn a_refusal_for_want_of_shadows_names_the_lines_that_hide_them_and_no_other_refusal_does() {
        let lined = |refusal: &Refusal| {
            let mut random = Stream::new(3, 0, 0, Purpose::Evaluation);
            let mut pixels = Image::filled(300, 280, 0.0f32);
            for (n, pixel) in pixels.pixels.iter_mut().enumerate() {
                let wave = (std::f64::consts::TAU * (n % 300) as f64 / 5.0).sin();
                *pixel = (1000.0 + 30.0 * random.normal() + 80.0 * wave) as f32;
            }
            let mut pose = refused(160.0, 5000.0, refusal);
            pose.hear_refused(&Frame::from_pixels("f", pixels, Domain::Linear).expect("a frame"), 0.0);
            pose.reason.expect("a reason")
        };
        let few = lined(&few_shadows(None));
        assert!(few.contains("lines every 5.0 pixels") && !few.contains("open the collimator"), "{few}");
        let none = lined(&Refusal::NoMatch { shadows: 9, beads: 9 });
        assert!(none.starts_with("no_match") && none.contains("lines every 5.0 pixels"), "{none}");
        assert!(!lined(&Refusal::Unsolved).contains("lines every"), "the control");
    }
}
