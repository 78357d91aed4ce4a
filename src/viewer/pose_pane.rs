//! What P rests on, and how well it is known where it matters.

use eframe::egui::{self, RichText, Ui};

use super::theme::{CAUTION, SMALL, TEXT, dim, title};
use super::told::{count, signed};
use crate::pose::{Covariance, UnseenBy};
use crate::report::PoseSource;
use crate::session::board::PairView;

/// Landmarks that are listed; the others are under the cursor.
const LISTED: usize = 5;
/// Warnings of a pair that are listed.
const FLAGS: usize = 3;

/// Draws it.
pub(super) fn show(ui: &mut Ui, pair: Option<&PairView>) {
    let Some(view) = pair else { return };
    title(ui, "POSE");
    let (pair, pose) = (&view.pair, &view.pose);
    let source = match pair.pose_source {
        PoseSource::Beads => "by beads",
        PoseSource::Telemetry => "by telemetry alone",
        PoseSource::None => "none",
    };
    let used = pose.beads.iter().filter(|bead| bead.used).count();
    let beads = pose.beads.iter().filter(|bead| !bead.check).count();
    row(ui, "pose", &format!("{source}; {used} of {} used, {}", count(beads, "bead"), count(pose.detections, "shadow")));
    if let Some(rms_px) = pose.rms_px {
        row(ui, "rms", &in_px_and_mm(rms_px, pose.rms_mm));
    }
    if let Some(unseen) = &pose.unseen {
        let by = match unseen.by {
            UnseenBy::CheckBeads => "at check beads",
            UnseenBy::LeftOut => "each left out",
        };
        row(ui, by, &in_px_and_mm(unseen.rms_px, Some(unseen.rms_mm)));
    }
    // Where the two disagree, that is the reason that stands above.
    if let Some(innovation) = pair.innovation.as_ref().filter(|_| !view.is_reason_telemetry()) {
        let mm = innovation.shift_mm.iter().map(|mm| mm * mm).sum::<f64>().sqrt();
        row(ui, "telemetry", &format!("{mm:.1} mm and {:.1}° away", innovation.turn_deg));
    }
    if let Some(tip) = &pair.tip {
        let ([u, v], sigma_mm) = (tip.off_mm, tip.sigma_mm[0].max(tip.sigma_mm[1]));
        row(ui, "drill tip", &format!("seen {}, {} ± {sigma_mm:.1} mm off", signed(u, 1), signed(v, 1)));
    }
    uncertainty(ui, view);
    let words = view.cautions();
    for same in words.iter().take(FLAGS) {
        ui.add(egui::Label::new(RichText::new(same[0]).size(SMALL).color(CAUTION)).wrap()).on_hover_text(same.join("\n"));
    }
    if words.len() > FLAGS {
        let more = &words[FLAGS..];
        ui.label(dim(format!("and {} more to beware of", more.len()))).on_hover_text(more.concat().join("\n"));
    }
}

/// σ at the landmarks, else at the beads.
fn uncertainty(ui: &mut Ui, view: &PairView) {
    let landmarks = &view.marks.landmarks;
    if landmarks.is_empty() {
        if let Some([across_mm, depth_mm, turn_deg]) = view.pose.covariance_at_centroid.as_ref().map(at_beads) {
            row(ui, "σ at beads", &format!("{across_mm:.2} mm across, {depth_mm:.1} mm deep, {turn_deg:.2}°"));
        }
        return;
    }
    egui::Grid::new("landmarks").num_columns(3).spacing([8.0, 1.0]).show(ui, |ui| {
        ui.label(dim("σ at landmarks"));
        ui.label(dim("across"));
        ui.label(dim("deep"));
        ui.end_row();
        for landmark in landmarks.iter().take(LISTED) {
            let [x, y, z] = landmark.sigma_mm;
            ui.label(RichText::new(&landmark.name).size(SMALL).color(TEXT));
            ui.label(RichText::new(format!("{:.2} mm", x.max(y))).size(SMALL));
            ui.label(RichText::new(format!("{z:.1} mm")).size(SMALL));
            ui.end_row();
        }
    });
    if landmarks.len() > LISTED {
        let more: Vec<String> =
            landmarks[LISTED..].iter().map(|mark| format!("{} {:.2?} mm", mark.name, mark.sigma_mm)).collect();
        ui.label(dim(format!("and {} more landmarks", more.len()))).on_hover_text(more.join("\n"));
    }
}

/// σ across and along the beam in mm, and of the attitude in degrees.
fn at_beads(covariance: &Covariance) -> [f64; 3] {
    let sigma = |n: usize| covariance[n][n].max(0.0).sqrt();
    let turn = sigma(0).max(sigma(1)).max(sigma(2));
    [sigma(3).max(sigma(4)), sigma(5), turn.to_degrees()]
}

fn in_px_and_mm(px: f64, mm: Option<f64>) -> String {
    let mm = mm.map(|mm| format!(" = {mm:.3} mm")).unwrap_or_default();
    format!("{px:.2} px{mm}")
}

fn row(ui: &mut Ui, what: &str, words: &str) {
    ui.horizontal_wrapped(|ui| {
        ui.label(dim(what));
        ui.label(RichText::new(words).size(SMALL).color(TEXT));
    });
}
