//! The session's folder: `strips/NNN.png drr/NNN.tif pairs.json report.html` (DESIGN §7).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::SessionError;
use super::develop::{Developed, Workshop};
use super::engine::Engine;
use super::file::Setup;
use crate::geometry::CarmJoints;
use crate::image::write_png_rgb;
use crate::render::write_image;
use crate::report::{Gap, LinkReport, Pair, Provenance, SessionReport, Track, write_pairs, write_session};
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, Sample};

/// A finished session.
#[derive(Debug)]
pub struct Folder {
    /// The folder.
    pub path: PathBuf,
    /// The log; absent for a replay.
    pub log: Option<PathBuf>,
    /// One row per exposure, in order.
    pub pairs: Vec<Pair>,
    /// Pose of each rendered frame, by name.
    pub views: BTreeMap<String, crate::geometry::View>,
    /// What was lost.
    pub losses: Vec<String>,
}

/// Collects what the report needs while pairs come in.
pub(super) struct Collector {
    path: PathBuf,
    rows: BTreeMap<u32, Pair>,
    views: BTreeMap<String, crate::geometry::View>,
    report: SessionReport,
    links: BTreeMap<DeviceKind, LinkReport>,
    joints: Vec<(i64, CarmJoints)>,
    angles: Vec<(i64, [f64; 5])>,
}

/// Joint tracks are drawn with at most one sample per this.
const TRACK_STEP_US: i64 = 100_000;

impl Collector {
    /// Creates the folder and those inside it.
    pub(super) fn create(path: &Path) -> Result<Self, SessionError> {
        for part in ["strips", "drr"] {
            let folder = path.join(part);
            std::fs::create_dir_all(&folder)
                .map_err(|source| SessionError::Folder { path: folder.display().to_string(), source })?;
        }
        Ok(Self {
            path: path.to_owned(),
            rows: BTreeMap::new(),
            views: BTreeMap::new(),
            report: SessionReport { title: "Sidecarm session".to_owned(), ..SessionReport::default() },
            links: BTreeMap::new(),
            joints: Vec::new(),
            angles: Vec::new(),
        })
    }

    pub(super) fn start(&mut self, started_us: i64, setup: &Setup, workshop: &Workshop) {
        self.report.started_us = Some(started_us);
        self.report.not_modelled = [
            "scatter: it is not in the DRR, so acquired frames are brighter behind thick tissue",
            "detector blur, focal spot, anode heel, lag",
            "the operating table and whatever else is not in the CT",
        ]
        .map(str::to_owned)
        .to_vec();
        let inputs = workshop.inputs().iter().map(|input| (input.path.clone(), input.sha256.clone())).collect();
        let details = vec![("scene".to_owned(), setup.scene_path.display().to_string())];
        self.report.provenance = Provenance {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            adapter: Some(workshop.adapter().to_owned()),
            command: None,
            inputs,
            details,
        };
    }

    pub(super) fn loss(&mut self, what: String) {
        self.report.losses.push(what);
    }

    fn link(&mut self, device: DeviceKind) -> &mut LinkReport {
        self.links.entry(device).or_insert_with(|| LinkReport {
            device: device.key().to_owned(),
            first_us: None,
            last_us: None,
            counters: Vec::new(),
            gaps: Vec::new(),
        })
    }

    pub(super) fn line_lost(&mut self, device: DeviceKind, host_us: i64, reason: &str) {
        let gap = Gap { start_us: host_us, end_us: host_us, reason: reason.to_owned() };
        self.link(device).gaps.push(gap);
    }

    pub(super) fn line_opened(&mut self, device: DeviceKind, host_us: i64) {
        if let Some(gap) = self.link(device).gaps.last_mut() {
            gap.end_us = host_us;
        }
    }

    pub(super) fn sample(&mut self, host_us: i64, sample: &Sample) {
        let device = match sample {
            Sample::Carm(carm) => {
                if self.joints.last().is_none_or(|(last_us, _)| host_us - last_us >= TRACK_STEP_US) {
                    self.joints.push((host_us, carm.joints));
                }
                DeviceKind::Carm
            }
            Sample::Robot(robot) => {
                if self.angles.last().is_none_or(|(last_us, _)| host_us - last_us >= TRACK_STEP_US) {
                    self.angles.push((host_us, robot.control_angles_deg().0));
                }
                DeviceKind::Robot
            }
            Sample::Metadata(_) => return,
        };
        let link = self.link(device);
        link.first_us.get_or_insert(host_us);
        link.last_us = Some(host_us);
    }

    /// Whether this pair came before, so that only its null is new.
    pub(super) fn knows(&self, developed: &Developed) -> bool {
        self.rows.contains_key(&developed.posed.index)
    }

    /// Writes strip, DRR and `pairs.json`.
    pub(super) fn take(&mut self, developed: Developed) -> Result<(), SessionError> {
        let index = developed.posed.index;
        let mut pair = developed.pair;
        let strip = format!("strips/{:03}.png", index + 1);
        write_png_rgb(&self.path.join(&strip), &developed.strip)?;
        pair.strip = Some(strip);
        if let Some((drr, scene)) = &developed.drr {
            let name = format!("drr/{:03}.tif", index + 1);
            if !self.rows.contains_key(&index) {
                write_image(&self.path.join(&name), drr, scene)?;
            }
            pair.drr = Some(name);
        }
        if let Some(view) = developed.posed.view {
            self.views.insert(pair.frame.clone(), view);
        }
        self.rows.insert(index, pair);
        let pairs: Vec<Pair> = self.rows.values().cloned().collect();
        write_pairs(&self.path.join("pairs.json"), &pairs)?;
        Ok(())
    }

    /// Writes the report.
    pub(super) fn finish(mut self, engine: &Engine, reporter: &Reporter, log: Option<PathBuf>) -> Result<Folder, SessionError> {
        self.report.ended_us = self.links.values().filter_map(|link| link.last_us).max().or(self.report.started_us);
        self.report.pairs = self.rows.into_values().collect();
        for device in DeviceKind::ALL {
            let (Some(health), Some(link)) = (engine.health(device), self.links.get_mut(&device)) else { continue };
            let counters = serde_json::to_value(health).unwrap_or_default();
            let counters = counters.as_object().cloned().unwrap_or_default();
            link.counters = counters.into_iter().filter_map(|(name, count)| Some((name, count.as_u64()?))).collect();
        }
        self.report.links = self.links.into_values().collect();
        self.report.tracks = tracks(&self.joints, &self.angles);
        self.report.warnings = reporter.warnings();
        write_session(&self.path, &self.report)?;
        Ok(Folder { path: self.path, log, pairs: self.report.pairs, views: self.views, losses: self.report.losses })
    }
}

fn tracks(joints: &[(i64, CarmJoints)], angles: &[(i64, [f64; 5])]) -> Vec<Track> {
    let mut tracks = Vec::new();
    if !joints.is_empty() {
        let degrees = |name: &str, value: fn(&CarmJoints) -> f64| {
            (name.to_owned(), joints.iter().map(|(t_us, j)| (*t_us, value(j).to_degrees())).collect())
        };
        let series = vec![
            degrees("orbital", |j| j.orbital_rad),
            degrees("angulation", |j| j.angulation_rad),
            degrees("wig-wag", |j| j.wig_wag_rad),
        ];
        tracks.push(Track { title: "C-arm joints".to_owned(), unit: "deg".to_owned(), series });
    }
    if !angles.is_empty() {
        let control =
            |index: usize| (format!("control point {}", index + 1), angles.iter().map(|(t_us, a)| (*t_us, a[index])).collect());
        let series = (0..5).map(control).collect();
        tracks.push(Track { title: "Robot bending".to_owned(), unit: "deg".to_owned(), series });
    }
    tracks
}
