//! `sidecarm register`: a frame, a bead layout, a P (or the reason why there is none); with `--together` several frames.

use std::path::PathBuf;

use super::read_aloud::frame_aloud;
use super::register_args::Given;
pub use super::register_args::RegisterArgs;
use super::register_error::RegisterError;
use super::register_explain;
use super::register_seen::{Console, Seen};
use super::register_together;
use crate::beads::read_correspondences;
use crate::beads::tags::{find_tags, read_tags};
use crate::image::write_png_rgb;
use crate::mask;
use crate::pose::{BeadResidual, IntrinsicsPrior, Pose, Refusal, Registration, register_masked, register_tagged};
use crate::report;
use crate::reporter::Reporter;

/// Registers, writes the pose, prints a summary. Returns the exit code: 0 accepted, 1 refused.
///
/// # Errors
/// When an input cannot be read or does not fit the others, or an output cannot be written.
pub fn run(args: &RegisterArgs, reporter: &Reporter) -> Result<u8, RegisterError> {
    if args.together {
        return register_together::run(args, reporter);
    }
    let [path] = args.frames.as_slice() else { return Err(RegisterError::Frames { found: args.frames.len() }) };
    let outputs: Vec<&PathBuf> = std::iter::once(&args.out).chain(&args.overlay).collect();
    let given = Given::read(args, &outputs)?;
    given.tell_doubts(reporter);
    let tags = args.tags.as_deref().map(read_tags).transpose()?;
    let correspondences = args.correspondences.as_deref().map(read_correspondences).transpose()?.unwrap_or_default();
    let stored = frame_aloud(path, args.domain, reporter)?;
    let mut notes = stored.altered.clone();
    let declared = match Console::of(args, &given, &stored, &mut notes)? {
        Ok(declared) => declared,
        Err(pose) => {
            if let Some(path) = &args.overlay {
                write_png_rgb(path, &report::overlay(&stored, &pose, &mask::of_frame(&stored)))?;
            }
            return answer(args, &pose, reporter);
        }
    };
    let mut seen = Seen::of(args, path, &stored, given.file.as_ref(), declared.as_ref())?;
    notes.append(&mut seen.notes);
    let prior = given.priors.first().map(|prior| prior.turned(seen.turn_rad));
    let intensifier = args.distortion_file().map(|path| seen.intensifier(path, &args.carm_angles)).transpose()?;
    let request = Registration {
        distortion: intensifier.as_ref().map(|intensifier| &intensifier.distortion),
        fuse: args.fuse,
        correspondences: &correspondences,
        ..seen.request(args, &given, prior.as_ref())
    };
    let masks = mask::of_frame(&seen.frame);
    let mut pose = match &tags {
        Some(tags) => register_tagged(&request, &seen.frame, &masks, tags, &find_tags(&seen.frame, tags.family)?),
        None => register_masked(&request, &seen.frame, &masks),
    };
    pose.notes.extend(notes);
    if let Some(path) = args.prior.first() {
        pose.prior_from(&path.display().to_string());
    }
    pose.explained.get_or_insert_default().told = register_explain::told(args.intrinsics.as_deref(), &seen, &masks);
    if tags.is_some() && seen.prior.is_some() {
        pose.notes.push("where tags are used K is taken as stated: its sigma is left aside".to_owned());
    }
    if let (Some(path), Some(intensifier)) = (&args.distortion, &intensifier) {
        pose.notes.push(format!("all places are those of the picture undistorted by {}", path.display()));
        pose.notes.extend(intensifier.note.clone());
    }
    pose.notes.extend(pose.beyond_sigma());
    if let Some(words) = seen.off_header(&pose) {
        pose.doubt(words);
    }
    if let Some(words) = pose.solved_k() {
        pose.cautions.push(format!("{words}, and depth is as uncertain as f is: give --intrinsics"));
    }
    pose.hear_header(&seen.frame, intensifier.is_some(), IntrinsicsPrior::stated_focal_sigma_px(seen.prior.as_ref()));
    given.pass_doubt_on(0, &mut pose);
    let drawn = request.distortion.map(|distortion| pose.drawn_on_distorted(distortion));
    if let Some(path) = &args.overlay {
        write_png_rgb(path, &report::overlay(&seen.frame, drawn.as_ref().unwrap_or(&pose), &masks))?;
    }
    answer(args, &pose, reporter)
}

/// Writes and prints.
fn answer(args: &RegisterArgs, pose: &Pose, reporter: &Reporter) -> Result<u8, RegisterError> {
    pose.write(&args.out)?;
    if args.json {
        match serde_json::to_string_pretty(pose) {
            Ok(text) => println!("{text}"),
            Err(error) => reporter.warn("json", format!("the pose cannot be printed: {error}")),
        }
    } else {
        print!("{}", summary(pose, args.explain));
    }
    reporter.wrote(std::iter::once(&args.out).chain(&args.overlay));
    Ok(u8::from(!pose.is_accepted()))
}

/// Human words for a pose.
#[must_use]
pub fn summary(pose: &Pose, explain: bool) -> String {
    let mut lines = Vec::new();
    let used = pose.beads.iter().filter(|bead| bead.used).count();
    if pose.is_accepted() {
        let number = |value: Option<f64>, digits: usize| value.map_or("?".to_owned(), |v| format!("{v:.digits$}"));
        let with_caution = match (&pose.doubt, pose.cautions.is_empty()) {
            (Some(_), _) => " in doubt",
            (None, false) => " with caution",
            (None, true) => "",
        };
        let (rms_px, rms_mm) = (number(pose.rms_px, 3), number(pose.rms_mm, 3));
        let at = |otherwise: &'static str| if pose.source_to_isocentre_mm.is_some() { "isocentre" } else { otherwise };
        if used == 0 {
            let tags = pose.tags.iter().filter(|tag| tag.used).count();
            lines.push(format!(
                "accepted{with_caution}: {tags} tags, no beads, corners to {rms_px} px = {rms_mm} mm at the {}",
                at("tags")
            ));
        } else {
            lines.push(format!(
                "accepted{with_caution}: {used} of {} beads, rms {rms_px} px = {rms_mm} mm at the {}, {} accidental matches expected",
                pose.beads.iter().filter(|bead| !bead.check).count(),
                at("beads"),
                pose.chance.map_or("?".to_owned(), |chance| format!("{chance:.0e}"))
            ));
        }
        lines.extend(pose.unseen.as_ref().map(ToString::to_string));
        if let Some(rows) = &pose.covariance_at_centroid {
            let sigma = |n: usize| rows[n][n].sqrt();
            lines.push(format!(
                "uncertainty at the beads: {:.3}°, {:.3}°, {:.3}° about x, y, z; {:.3}, {:.3} mm across and {:.3} mm along the beam",
                sigma(0).to_degrees(),
                sigma(1).to_degrees(),
                sigma(2).to_degrees(),
                sigma(3),
                sigma(4),
                sigma(5)
            ));
        }
        if let (Some(k), Some(source)) = (&pose.intrinsics, &pose.intrinsics_source) {
            let sigma = pose.intrinsics_sigma_px.map_or(String::new(), |[f, _, x, y]| format!(" (± {f:.1}; {x:.1}, {y:.1})"));
            lines.push(format!("K {source}: f {:.1}, {:.1} px, principal point {:.1}, {:.1} px{sigma}", k.fx, k.fy, k.cx, k.cy));
        }
    } else {
        lines.push(format!("refused: {}", pose.reason.as_deref().unwrap_or("no reason given")));
        // Of a console's ways round each is another picture, and the reason says what was seen in it.
        if !matches!(pose.refusal, Some(Refusal::NoOrientation { .. } | Refusal::EitherOrientation { .. })) {
            lines.push(format!("{} bead-like shadows in the frame, {} beads in the layout", pose.detections, pose.beads.len()));
        }
    }
    if pose.is_accepted() {
        lines.push(format!("{:16} {:>10} {:>10} {:>9} {:>9} {:>8}", "bead", "u px", "v px", "du px", "dv px", "sigma px"));
        let of_shadow = |bead: &BeadResidual| {
            let own = pose.shadows.iter().find(|shadow| shadow.bead.as_deref() == Some(bead.name.as_str()));
            let words = own.map(|shadow| shadow.flags.words().join(", ")).unwrap_or_default();
            if words.is_empty() { words } else { format!("  its shadow is {words}") }
        };
        for bead in &pose.beads {
            match (bead.image_px, bead.residual_px) {
                (Some(at), Some(off)) => lines.push(format!(
                    "{:16} {:10.3} {:10.3} {:9.3} {:9.3} {:8.3}{}{}",
                    bead.name,
                    at[0],
                    at[1],
                    off[0],
                    off[1],
                    bead.sigma_px.unwrap_or(f64::NAN),
                    of_shadow(bead),
                    bead.reason.as_deref().map_or(String::new(), |why| format!("  not used: {why}"))
                )),
                _ => lines.push(format!("{:16} not used: {}", bead.name, bead.reason.as_deref().unwrap_or("no shadow"))),
            }
        }
    }
    for tag in &pose.tags {
        let [[u, v], ..] = tag.corners_px;
        let off = tag.residual_px.map_or(String::new(), |off| format!(", corners {off:.2} px from where P puts them"));
        let why = tag.reason.as_deref().map_or(String::new(), |why| format!("  not used: {why}"));
        let mirrored = if tag.mirrored { ", mirrored" } else { "" };
        lines.push(format!(
            "tag {} {}: first corner {u:.2}, {v:.2} px, margin {:.0}{mirrored}{off}{why}",
            tag.family, tag.id, tag.margin
        ));
    }
    if pose.is_accepted() {
        for landmark in &pose.landmarks {
            let [x, y, z] = landmark.sigma_mm;
            let px = landmark.sigma_px.map_or(String::new(), |[u, v]| format!(", {u:.2}, {v:.2} px"));
            lines.push(format!("landmark {}: ± {x:.3}, {y:.3} mm across, {z:.3} mm along the beam{px}", landmark.name));
        }
    }
    lines.extend(pose.cautions.iter().map(|caution| format!("caution: {caution}")));
    if explain {
        lines.extend(register_explain::lines(pose));
    }
    lines.extend(pose.notes.iter().map(|note| format!("note: {note}")));
    lines.join("\n") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beads::BeadLayout;

    /// Of four beads that agreed among six shadows the next line said that there were none.
    #[test]
    fn a_refused_console_does_not_count_shadows_of_the_stored_picture() {
        let layout = BeadLayout::none();
        let told = |refusal: &Refusal| summary(&Registration::new([64, 48], &layout).refuse(refusal), false);
        let none = Refusal::NoOrientation { as_stored: "four of 6 shadows".to_owned(), mirrored: "none".to_owned() };
        let either = Refusal::EitherOrientation { matched: 8, rms_px: 0.5, other_matched: 8, other_px: 0.6 };
        for console in [none, either] {
            assert!(!told(&console).contains("0 bead-like shadows"), "{}", told(&console));
        }
        assert!(told(&Refusal::Unsolved).contains("0 bead-like shadows in the frame"), "the control");
    }
}
