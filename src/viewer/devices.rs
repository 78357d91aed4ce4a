//! The devices: whether they are heard, how often, what was lost, how their clocks run, how they stand.

use eframe::egui::{self, Color32, RichText, Ui};

use super::theme::{BAD, BODY, CAUTION, DIM, GOOD, SMALL, STALE, TEXT, dim, title};
use crate::session::board::{BoardState, Link};
use crate::telemetry::{AngleSource, CarmSample, RobotSample, Sample, status_words};

/// Draws them.
pub(super) fn show(ui: &mut Ui, board: &BoardState) {
    title(ui, "DEVICES");
    if board.links.is_empty() {
        ui.label(dim("No serial line is open"));
    }
    for link in &board.links {
        device(ui, link, board.now_us);
    }
}

fn device(ui: &mut Ui, link: &Link, now_us: i64) {
    let age_s = link.last_sample_us.map(|last_us| (now_us - last_us).max(0) as f64 * 1e-6);
    let stale = link.is_stale(now_us);
    let (colour, words) = match (link.open, stale, age_s) {
        (false, _, _) => (BAD, "unplugged".to_owned()),
        (true, true, Some(age_s)) => (STALE, format!("STALE {age_s:.1} s")),
        (true, true, None) => (STALE, "silent".to_owned()),
        (true, false, _) => (GOOD, "live".to_owned()),
    };
    let fresh = link.open && !stale;
    ui.horizontal(|ui| {
        let (dot, _) = ui.allocate_exact_size(egui::vec2(10.0, 14.0), egui::Sense::hover());
        ui.painter().circle_filled(dot.center(), 4.5, colour);
        ui.label(RichText::new(format!("{} {words}", link.device)).size(BODY + 2.0).color(if fresh { TEXT } else { colour }));
        if let Some(rate_hz) = link.rate_hz.filter(|_| fresh) {
            ui.label(dim(format!("{rate_hz:.0} Hz")));
        }
    });
    let health = &link.health;
    let lost = health.lost_in_all();
    let told: Vec<String> = health.faults().map(|(count, what)| format!("{count} {what}")).collect();
    let told = if told.is_empty() { "none lost".to_owned() } else { told.join(", ") };
    ui.label(RichText::new(format!("{} samples, {told}", health.frames)).size(SMALL).color(if lost > 0 { CAUTION } else { DIM }));
    if let Some(clock) = &link.clock {
        let steps = match link.clock_steps {
            0 => String::new(),
            steps => format!(", {steps} steps"),
        };
        let words = format!(
            "clock {:+.1} ± {:.1} ppm, ± {:.2} ms{steps}",
            clock.drift_ppm,
            clock.drift_sigma_ppm,
            clock.uncertainty_us * 1e-3
        );
        ui.label(RichText::new(words.replace('-', "−")).size(SMALL).color(if link.clock_steps > 0 { CAUTION } else { DIM }));
    }
    if let Some(trouble) = &link.trouble {
        ui.label(RichText::new(trouble).size(SMALL).color(BAD));
    }
    // What stood before the silence is still worth seeing, and must not pass for what stands now.
    let ink = if fresh { TEXT } else { STALE };
    match &link.latest {
        Some(Sample::Carm(sample)) => carm(ui, sample, ink),
        Some(Sample::Robot(sample)) => robot(ui, sample, ink),
        Some(Sample::Metadata(_)) | None => {}
    }
}

fn carm(ui: &mut Ui, sample: &CarmSample, ink: Color32) {
    let joints = &sample.joints;
    let rows = [
        [("orbital", joints.orbital_rad.to_degrees(), "°"), ("angulation", joints.angulation_rad.to_degrees(), "°")],
        [("wig-wag", joints.wig_wag_rad.to_degrees(), "°"), ("detector", joints.detector_rotation_rad.to_degrees(), "°")],
        [("lift", joints.lift_mm, " mm"), ("along", joints.longitudinal_mm, " mm")],
        [("SDD", joints.source_to_detector_mm, " mm"), ("tube", sample.tube_kvp, " kV")],
    ];
    values(ui, "joints", &rows, ink);
    let beam = if sample.xray_on { "beam on" } else { "beam off" };
    let exposures = sample.exposure_counter.map(|n| format!(", exposure {n}")).unwrap_or_default();
    let colour = if sample.xray_on { CAUTION } else { DIM };
    ui.label(RichText::new(format!("{beam}{exposures}")).size(SMALL).color(colour));
    status(ui, &status_words(crate::telemetry::DeviceKind::Carm, sample.status));
}

fn robot(ui: &mut Ui, sample: &RobotSample, ink: Color32) {
    let (angles_deg, source) = sample.control_angles_deg();
    let angle = |point: usize| (["bend 1", "bend 2", "bend 3", "bend 4", "bend 5"][point], angles_deg[point], "°");
    let drill = ("drill", sample.drill_rpm, " rpm");
    values(ui, "angles", &[[angle(0), angle(1)], [angle(2), angle(3)], [angle(4), drill]], ink);
    let (words, colour) = match source {
        AngleSource::Sensed => ("angles sensed", DIM),
        AngleSource::Commanded => ("angles commanded, not sensed", CAUTION),
    };
    let base = if sample.tracker_from_base.is_some() { ", base tracked" } else { "" };
    ui.label(RichText::new(format!("{words}{base}")).size(SMALL).color(colour));
    status(ui, &status_words(crate::telemetry::DeviceKind::Robot, sample.status));
}

fn status(ui: &mut Ui, words: &[String]) {
    if !words.is_empty() {
        ui.label(RichText::new(words.join(", ")).size(SMALL).color(CAUTION));
    }
}

/// Two values a row, each with its unit; what is not measured is a dash.
fn values(ui: &mut Ui, name: &str, rows: &[[(&str, f64, &str); 2]], ink: Color32) {
    egui::Grid::new(name).num_columns(4).spacing([8.0, 1.0]).min_col_width(54.0).show(ui, |ui| {
        for row in rows {
            for (what, value, unit) in row {
                ui.label(dim(*what));
                let words = if value.is_finite() { format!("{value:.1}{unit}").replace('-', "−") } else { "–".to_owned() };
                ui.label(RichText::new(words).size(SMALL).color(ink));
            }
            ui.end_row();
        }
    });
}
