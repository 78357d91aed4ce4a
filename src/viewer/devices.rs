//! The devices: whether they are heard, how often, what was lost, how their clocks run, how they stand, or stood at the exposure shown.

use eframe::egui::{self, Color32, RichText, Ui};

use super::theme::{BAD, BODY, CAUTION, DIM, GOOD, SMALL, STALE, TEXT, dim, title};
use super::told::{count, fixed, signed};
use crate::geometry::CarmJoints;
use crate::session::board::{AtExposure, BoardState, Link, PairView};
use crate::telemetry::{AngleSource, CarmSample, DeviceKind, RobotSample, Sample, status_words};

/// Draws them. `past` is an exposure of which all else tells: the devices' values are then those of it, not the latest.
pub(super) fn show(ui: &mut Ui, board: &BoardState, past: Option<&PairView>) {
    title(ui, "DEVICES");
    if board.links.is_empty() {
        ui.label(dim("No serial line is open"));
    }
    for link in &board.links {
        let fresh = line(ui, board, link);
        match past {
            Some(pair) => at_exposure(ui, link.device, pair),
            None => latest(ui, link, fresh),
        }
    }
}

/// What is known of the line itself; whether what it said last is of now.
fn line(ui: &mut Ui, board: &BoardState, link: &Link) -> bool {
    let age_s = link.last_sample_us.map(|last_us| (board.now_us - last_us).max(0) as f64 * 1e-6);
    let stale = link.is_stale(board.now_us);
    let (colour, words) = match (link.open, stale, age_s) {
        // Time stands still then, and nothing grows old.
        _ if board.finished => (STALE, "ended".to_owned()),
        (false, _, _) => (BAD, "unplugged".to_owned()),
        (true, true, Some(age_s)) => (STALE, format!("STALE {:.0} s", age_s.floor().max(1.0))),
        (true, true, None) => (STALE, "silent".to_owned()),
        (true, false, _) => (GOOD, "live".to_owned()),
    };
    let fresh = link.open && !stale && !board.finished;
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
    small(ui, format!("{}, {told}", count(health.frames as usize, "sample")), if lost > 0 { CAUTION } else { DIM });
    if let Some(clock) = &link.clock {
        let steps = match link.clock_steps {
            0 => String::new(),
            steps => format!(", {}", count(steps as usize, "step")),
        };
        let words = format!(
            "clock {} ± {:.1} ppm, ± {:.2} ms{steps}",
            signed(clock.drift_ppm, 1),
            clock.drift_sigma_ppm,
            clock.uncertainty_us * 1e-3
        );
        small(ui, words, if link.clock_steps > 0 { CAUTION } else { DIM });
    }
    if let Some(trouble) = &link.trouble {
        small(ui, trouble.as_str(), BAD);
    }
    fresh
}

/// What the line said last.
fn latest(ui: &mut Ui, link: &Link, fresh: bool) {
    // What stood before the silence is still worth seeing, and must not pass for what stands now.
    let ink = if fresh { TEXT } else { STALE };
    match &link.latest {
        Some(Sample::Carm(sample)) => carm(ui, sample, ink),
        Some(Sample::Robot(sample)) => robot(ui, sample, ink),
        Some(Sample::Metadata(_)) | None => {}
    }
}

/// What the device said at the exposure of a pair.
fn at_exposure(ui: &mut Ui, device: DeviceKind, pair: &PairView) {
    let AtExposure { joints, beam, robot } = &*pair.devices;
    let when = format!("at the exposure of frame {}", pair.number());
    let untold = format!("{when}: no telemetry");
    match (device, joints, robot) {
        (DeviceKind::Carm, Some(joints), _) => {
            small(ui, when, DIM);
            arm_values(ui, joints, beam.as_ref().map_or(f64::NAN, |beam| beam.tube_kvp), TEXT);
        }
        (DeviceKind::Robot, _, Some(robot)) => {
            small(ui, when, DIM);
            let [a, b, c, d, e] = bends(&robot.control_angles_deg);
            values(ui, "angles", &[&[a, b], &[c, d], &[e]], TEXT);
            small(ui, format!("angles {}", robot.source), if robot.source == "commanded" { CAUTION } else { DIM });
        }
        (DeviceKind::Carm, None, _) | (DeviceKind::Robot, _, None) => small(ui, untold, STALE),
    }
}

fn carm(ui: &mut Ui, sample: &CarmSample, ink: Color32) {
    arm_values(ui, &sample.joints, sample.tube_kvp, ink);
    let beam = if sample.xray_on { "beam on" } else { "beam off" };
    let exposures = sample.exposure_counter.map(|n| format!(", exposure {n}")).unwrap_or_default();
    small(ui, format!("{beam}{exposures}"), if sample.xray_on { CAUTION } else { DIM });
    status(ui, &status_words(DeviceKind::Carm, sample.status));
}

fn arm_values(ui: &mut Ui, joints: &CarmJoints, tube_kvp: f64, ink: Color32) {
    let rows: [&[Value]; 4] = [
        &[("orbital", joints.orbital_rad.to_degrees(), "°"), ("angulation", joints.angulation_rad.to_degrees(), "°")],
        &[("wig-wag", joints.wig_wag_rad.to_degrees(), "°"), ("detector", joints.detector_rotation_rad.to_degrees(), "°")],
        &[("lift", joints.lift_mm, " mm"), ("along", joints.longitudinal_mm, " mm")],
        &[("SDD", joints.source_to_detector_mm, " mm"), ("tube", tube_kvp, " kV")],
    ];
    values(ui, "joints", &rows, ink);
}

fn robot(ui: &mut Ui, sample: &RobotSample, ink: Color32) {
    let (angles_deg, source) = sample.control_angles_deg();
    let [a, b, c, d, e] = bends(&angles_deg);
    values(ui, "angles", &[&[a, b], &[c, d], &[e, ("drill", sample.drill_rpm, RPM)]], ink);
    let (words, colour) = match source {
        AngleSource::Sensed => ("angles sensed", DIM),
        AngleSource::Commanded => ("angles commanded, not sensed", CAUTION),
    };
    let base = if sample.tracker_from_base.is_some() { ", base tracked" } else { "" };
    small(ui, format!("{words}{base}"), colour);
    status(ui, &status_words(DeviceKind::Robot, sample.status));
}

fn bends(angles_deg: &[f64; 5]) -> [Value<'static>; 5] {
    const NAMES: [&str; 5] = ["bend 1", "bend 2", "bend 3", "bend 4", "bend 5"];
    std::array::from_fn(|point| (NAMES[point], angles_deg[point], "°"))
}

fn status(ui: &mut Ui, words: &[String]) {
    if !words.is_empty() {
        small(ui, words.join(", "), CAUTION);
    }
}

fn small(ui: &mut Ui, words: impl Into<String>, colour: Color32) {
    ui.label(RichText::new(words).size(SMALL).color(colour));
}

/// Name, value and unit.
type Value<'a> = (&'a str, f64, &'a str);

/// Nobody reads tenths of it.
const RPM: &str = " rpm";

/// Some values a row, each with its unit; what is not measured is a dash.
fn values(ui: &mut Ui, name: &str, rows: &[&[Value]], ink: Color32) {
    egui::Grid::new(name).num_columns(4).spacing([8.0, 1.0]).min_col_width(54.0).show(ui, |ui| {
        for row in rows {
            for (what, value, unit) in *row {
                ui.label(dim(*what));
                let decimals = if *unit == RPM { 0 } else { 1 };
                let words = if value.is_finite() { format!("{}{unit}", fixed(*value, decimals)) } else { "–".to_owned() };
                small(ui, words, ink);
            }
            ui.end_row();
        }
    });
}
