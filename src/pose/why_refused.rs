//! What else speaks for the cause of a refusal: beads in another unit, K against the frame's own header, a picture that is saturated, in blocks
//! or lined.

use glam::DVec3;

use super::artefact::Artefact;
use super::record::Pose;
use super::refusal::{MORE_SHADOWS, Refusal};
use super::register::intrinsics_of;
use super::verdict::span_mm;
use crate::acquire::Frame;

/// Beads on a specimen that a C-arm sees lie at least so far apart, and at most, mm.
const PLAUSIBLE_SPAN_MM: (f64, f64) = (40.0, 1500.0);
/// Layouts narrower than this are in metres rather than in centimetres.
const METRES_BELOW_MM: f64 = 3.0;
/// A focal length that is off by more than this share of what the header says is said beside a refusal.
const OFF_HEADER: f64 = 0.05;
/// A picture of which more than this share is at the end of the scale shows no beads there.
const SATURATED: f64 = 0.5;

impl Pose {
    /// Adds to the reason of a refusal what else is known that may be its cause.
    pub(super) fn hear_refused(&mut self, frame: &Frame) {
        // What the session's own checks said, or a fault of this program, has its cause already.
        let is_explained = matches!(self.refusal, None | Some(Refusal::Layout { .. } | Refusal::Fault { .. }));
        let Some(mut reason) = self.reason.take_if(|_| !is_explained) else { return };
        let share = frame.clipping.saturated_share;
        let saturated = (share > SATURATED).then(|| {
            format!("{:.0} % of the frame is saturated: lower the dose, or choose another window or export", 100.0 * share)
        });
        let looks = self.refusal.as_ref().is_some_and(rests_on_looks);
        let artefacts = if looks { Artefact::of(&frame.pixels) } else { Vec::new() };
        for words in saturated.into_iter().chain(artefacts.iter().map(ToString::to_string)) {
            // More of the same picture would show no more.
            reason = match reason.contains(MORE_SHADOWS) {
                true => reason.replace(MORE_SHADOWS, &words),
                false => format!("{reason}; {words}"),
            };
        }
        for words in [self.other_unit(), self.other_focal(frame)].into_iter().flatten() {
            reason = format!("{reason}; {words}");
        }
        self.reason = Some(reason);
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
    fn other_focal(&self, frame: &Frame) -> Option<String> {
        // K that was solved for a pose that is refused is nobody's word.
        let given =
            self.intrinsics.filter(|_| self.intrinsics_source.as_deref().is_none_or(|source| !source.starts_with("solved")));
        let (k, (header, ..)) = given.zip(intrinsics_of(frame))?;
        (!((k.fx / header.fx - 1.0).abs() <= OFF_HEADER))
            .then(|| format!("K says f {:.0} px, the header's SID and pitch say {:.0} px", k.fx, header.fx))
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

    /// Why it is refused in a frame that says 5000 px and is saturated to this share.
    fn heard(mut pose: Pose, saturated_share: f64) -> String {
        let mut frame = Frame::from_pixels("f", Image::filled(64, 48, 1.0f32), Domain::Linear).expect("a frame");
        (frame.tags.sid_mm, frame.tags.pitch_mm) = (Some(1000.0), Some([0.2; 2]));
        frame.clipping.saturated_share = saturated_share;
        pose.hear_header(&frame, false);
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
        let few = Refusal::TooFewShadows { found: 0, required: 4, prior_puts_into_frame: None };
        let words = reason(160.0, 5000.0, 0.99, &few);
        assert!(words.contains("99 % of the frame is saturated") && !words.contains("raise the dose"), "{words}");
        assert!(reason(160.0, 5000.0, 0.1, &few).contains("raise the dose"));
        let solved = Pose { intrinsics_source: Some("solved".to_owned()), ..refused(160.0, 2500.0, &none) };
        assert_eq!(heard(solved, 0.1), none.to_string());
        let told = Refusal::Layout { detail: "told".to_owned() };
        assert_eq!(reason(0.16, 2500.0, 0.99, &told), "told");
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
            pose.hear_refused(&Frame::from_pixels("f", pixels, Domain::Linear).expect("a frame"));
            pose.reason.expect("a reason")
        };
        let few = lined(&Refusal::TooFewShadows { found: 0, required: 4, prior_puts_into_frame: None });
        assert!(few.contains("lines every 5.0 pixels") && !few.contains("open the collimator"), "{few}");
        let none = lined(&Refusal::NoMatch { shadows: 9, beads: 9 });
        assert!(none.starts_with("no_match") && none.contains("lines every 5.0 pixels"), "{none}");
        assert!(!lined(&Refusal::Unsolved).contains("lines every"), "the control");
    }
}
