//! What a session says over OpenIGTLink.
//!
//! | device | type | says | when |
//! |---|---|---|---|
//! | `LpsToCamera` | TRANSFORM | `camera_from_lps`: patient (LPS, mm) to camera | each accepted frame |
//! | `CameraToRas` | TRANSFORM | its inverse into RAS, the world of 3D Slicer: above `Acquired` and `Drr` it lays them on the detector | each accepted frame |
//! | `CameraToWorld` | TRANSFORM | `world_from_camera`, nominal, of the panel's own axes | each C-arm sample |
//! | `BaseToLps`, `TipToLps` | TRANSFORM | `lps_from_base`, `lps_from_tip` | each robot sample whose base is known |
//! | `Tip` | POSITION | the drill's tip in LPS, mm, with its orientation | as `TipToLps` |
//! | `TipCommandedToLps`, `TipCommanded` | | the same by angles that were commanded and not sensed | in place of those |
//! | `Acquired`, `Drr` | IMAGE | the newest pair: the frame as it is registered, the DRR's line integral in nepers | each pair of an accepted pose whose pixel pitch is known |
//! | `AcquiredUnplaced`, `DrrUnplaced` | IMAGE | the same of a frame that lies nowhere: under a name of its own, which no transform moves | each other pair |
//! | `Frame` | STRING | the terminal's line | each frame; again when its image or telemetry disagrees, or it is in doubt |
//! | `Telemetry` | STRING | that a device is not heard any more, or again | when it is so |
//! | `Sidecarm` | STATUS | both in a code: 1 accepted, 2 refused, doubted or a device not heard, 13 no frame yet, 19 leaving | each frame, once a second, when asked |
//!
//! `AToB` takes points from A to B. Stamps are those of the exposure (its middle), of telemetry those of its arrival. A frame without an
//! accepted pose gives no transform, and its pictures lie nowhere: pixels 1 apart, the first at the origin. Those of an accepted one lie on
//! the detector in the camera's frame. Of frames that are developed late, the newer one's transforms and pictures stand. The protocol cannot
//! take a transform back: that those of a silent device are old, the status says for as long as it is so.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::SessionError;
use super::developed::Developed;
use super::engine::Engine;
use super::hearing::SILENT_US;
use super::posed::Posed;
use super::servers::IgtlServer;
use super::whereabouts::Whereabouts;
use crate::geometry::{RAS_FROM_LPS, Rigid};
use crate::igtl::{Content, Message, Picture, Placement, Server, Status};
use crate::image::Image;
use crate::report::{PoseSource, Standing};
use crate::reporter::Reporter;
use crate::telemetry::{AngleSource, CarmSample, DeviceKind, RobotSample, Sample};
use crate::timeline::{FreshLimits, Freshness};

/// The name under which the status is sent.
const DEVICE: &str = "Sidecarm";

/// A device that said nothing for longer is not heard any more.
const HEARD: FreshLimits = FreshLimits { stale_us: SILENT_US };

/// A device that is not heard, and whether it ever was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Silent {
    device: DeviceKind,
    ever: bool,
}

impl Silent {
    fn words(self) -> String {
        let Self { device, ever } = self;
        match ever {
            true => {
                format!(
                    "the {device} is not heard any more, and what was sent of it stands where it was then; check the device, its cable and port"
                )
            }
            false => format!("nothing has come from the {device} yet; is it on, and is this its port?"),
        }
    }
}

/// What is said of a frame while these devices are not heard: that comes first.
fn beside(of_frame: &Status, silent: &[Silent]) -> Status {
    if silent.is_empty() {
        return of_frame.clone();
    }
    let devices: Vec<String> = silent.iter().map(|silent| silent.device.to_string()).collect();
    let words = silent.iter().map(|silent| silent.words()).chain([of_frame.words.clone()]).collect::<Vec<_>>().join("; ");
    Status { code: Status::ERROR, frame: of_frame.frame, name: format!("{} silent", devices.join(", ")), words }
}

/// Times of the newest exposure of which each was sent.
struct Newest {
    pose_us: i64,
    pictures_us: i64,
    status_us: i64,
    /// Frames of which it was said that they are doubted, and what of.
    doubted: BTreeSet<(u32, &'static str)>,
    /// What the status says of the frame.
    of_frame: Status,
    /// Devices that are not heard.
    silent: Vec<Silent>,
    /// When that was first looked at.
    looked_us: Option<i64>,
}

impl Newest {
    fn tell(&mut self, server: &Server, of_frame: Status) {
        self.of_frame = of_frame;
        server.set_status(beside(&self.of_frame, &self.silent));
    }
}

/// See the module; without a server it says nothing.
pub(super) struct Broadcast {
    server: Option<Server>,
    whereabouts: Whereabouts,
    newest: Mutex<Newest>,
}

impl Broadcast {
    /// Listens where `server` says, if anywhere.
    pub(super) fn open(server: Option<&IgtlServer>, whereabouts: Whereabouts, reporter: &Reporter) -> Result<Self, SessionError> {
        let words = "no frame has come yet".to_owned();
        let waiting = Status { code: Status::NOT_READY, frame: 0, name: "no frame yet".to_owned(), words };
        let of_frame = waiting.clone();
        let open = |server: &IgtlServer| Server::open(server.bind, server.port, DEVICE, waiting, reporter);
        let server = server.map(open).transpose()?;
        if let Some(server) = &server {
            let address = server.address();
            let whom = if address.ip().is_loopback() { "" } else { "; whoever reaches this address sees poses and pictures" };
            reporter.note(format!("OpenIGTLink listens on {address}{whom}"));
        }
        let newest = Newest {
            pose_us: i64::MIN,
            pictures_us: i64::MIN,
            status_us: i64::MIN,
            doubted: BTreeSet::new(),
            of_frame,
            silent: Vec::new(),
            looked_us: None,
        };
        Ok(Self { server, whereabouts, newest: Mutex::new(newest) })
    }

    /// Where somebody listens.
    fn heard(&self) -> Option<&Server> {
        self.server.as_ref().filter(|server| server.clients() > 0)
    }

    fn newest(&self) -> MutexGuard<'_, Newest> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A sample of either device; `world_from_lps` is what is known of the specimen now.
    pub(super) fn sample(&self, host_us: i64, sample: &Sample, world_from_lps: Option<Rigid>) {
        let Some(server) = self.heard() else { return };
        match sample {
            Sample::Carm(sample) => self.carm_sample(server, host_us, sample),
            Sample::Robot(sample) => self.robot_sample(server, host_us, sample, world_from_lps),
            Sample::Metadata(_) => {}
        }
    }

    fn carm_sample(&self, server: &Server, time_us: i64, sample: &CarmSample) {
        if let Some(world_from_camera) = self.whereabouts.world_from_camera(&sample.joints) {
            server.send(transform("CameraToWorld", time_us, world_from_camera));
        }
    }

    fn robot_sample(&self, server: &Server, time_us: i64, sample: &RobotSample, world_from_lps: Option<Rigid>) {
        let Some(place) = self.whereabouts.robot(sample, world_from_lps) else { return };
        server.send(transform("BaseToLps", time_us, place.lps_from_base));
        let Some(shape) = &place.shape else { return };
        let lps_from_tip = place.lps_from_base * shape.base_from_tip;
        let (name, tip) = match place.source {
            AngleSource::Sensed => ("TipToLps", "Tip"),
            AngleSource::Commanded => ("TipCommandedToLps", "TipCommanded"),
        };
        server.send(transform(name, time_us, lps_from_tip));
        server.send(Message { device: tip.to_owned(), time_us, content: Content::Position(lps_from_tip) });
    }

    /// Time has come to `now_us`: what a device said last looks like what it says now, and is not that once it has fallen silent.
    pub(super) fn look(&self, engine: &Engine, now_us: i64) {
        let Some(server) = &self.server else { return };
        let mut newest = self.newest();
        let begun = now_us.saturating_sub(*newest.looked_us.get_or_insert(now_us)) > SILENT_US;
        let present = DeviceKind::ALL.into_iter().filter(|device| engine.health(*device).is_some());
        let silent: Vec<Silent> = present
            .filter_map(|device| match engine.timeline().freshness(device, now_us, HEARD) {
                Freshness::Stale { .. } => Some(Silent { device, ever: true }),
                Freshness::Absent if begun => Some(Silent { device, ever: false }),
                Freshness::Fresh { .. } | Freshness::Absent => None,
            })
            .collect();
        if silent == newest.silent {
            return;
        }
        let before = std::mem::replace(&mut newest.silent, silent);
        let fallen = newest.silent.iter().filter(|silent| !before.contains(silent)).map(|silent| silent.words());
        let is_silent = |device: DeviceKind| newest.silent.iter().any(|silent| silent.device == device);
        let back = before.iter().filter(|before| !is_silent(before.device));
        let back = back.map(|before| format!("the {} is heard{}", before.device, if before.ever { " again" } else { "" }));
        for words in fallen.chain(back) {
            server.send(Message { device: "Telemetry".to_owned(), time_us: now_us, content: Content::Text(words) });
        }
        let of_frame = newest.of_frame.clone();
        newest.tell(server, of_frame);
    }

    /// Another session begins: of its devices nothing is missed yet.
    pub(super) fn begin_anew(&self) {
        let Some(server) = &self.server else { return };
        let mut newest = self.newest();
        newest.looked_us = None;
        newest.silent.clear();
        let of_frame = newest.of_frame.clone();
        newest.tell(server, of_frame);
    }

    /// A frame that was registered, and what the terminal says of it.
    pub(super) fn posed(&self, posed: &Posed, words: &str) {
        let Some(server) = &self.server else { return };
        let time_us = posed.time_us;
        server.send(Message { device: "Frame".to_owned(), time_us, content: Content::Text(words.to_owned()) });
        let mut newest = self.newest();
        if time_us >= newest.status_us {
            newest.status_us = time_us;
            newest.tell(server, status_of(posed, words));
        }
        let accepted = posed.view.filter(|_| posed.pose.is_accepted() && posed.pose_source == PoseSource::Beads);
        if let Some(view) = accepted.filter(|_| time_us >= newest.pose_us) {
            newest.pose_us = time_us;
            server.send(transform("LpsToCamera", time_us, view.camera_from_lps));
            server.send(transform("CameraToRas", time_us, RAS_FROM_LPS * view.camera_from_lps.inverse()));
        }
    }

    /// A pair; `is_new` when it can be shown for the first time.
    pub(super) fn developed(&self, developed: &Developed, is_new: bool) {
        let Some(server) = &self.server else { return };
        let (posed, standing) = (&developed.posed, developed.pair.standing());
        let mut newest = self.newest();
        let is_doubted = matches!(standing, Standing::ImageDisagrees | Standing::TelemetryDisagrees | Standing::InDoubt);
        if is_doubted && newest.doubted.insert((posed.number, standing.short())) {
            let words = format!("{}: {}: {}", posed.label(), standing.word().to_lowercase(), developed.pair.status_line());
            let content = Content::Text(words.clone());
            server.send(Message { device: "Frame".to_owned(), time_us: posed.time_us, content });
            if posed.time_us >= newest.status_us {
                let name = standing.short().to_owned();
                newest.tell(server, Status { code: Status::ERROR, frame: i64::from(posed.number), name, words });
            }
        }
        if is_new && posed.time_us >= newest.pictures_us && server.clients() > 0 {
            newest.pictures_us = posed.time_us;
            drop(newest);
            self.pictures(server, developed);
        }
    }

    fn pictures(&self, server: &Server, developed: &Developed) {
        let posed = &developed.posed;
        let by_beads = posed.pose.is_accepted() && posed.pose_source == PoseSource::Beads;
        let placed = match (posed.pose.camera(), developed.pitch_mm()) {
            (Some((k, _)), Some(pitch_mm)) if by_beads => Placement::on_detector(&k, pitch_mm),
            _ => None,
        };
        // Under the transform of an earlier pose it would lie where another picture was taken.
        let [acquired, drr] = if placed.is_some() { ["Acquired", "Drr"] } else { ["AcquiredUnplaced", "DrrUnplaced"] };
        let placement = placed.unwrap_or(Placement::PIXELS);
        let send = |device: &str, image: &Image<f32>| {
            if let Some(picture) = Picture::of(image, placement) {
                server.send(Message { device: device.to_owned(), time_us: posed.time_us, content: Content::Image(picture) });
            }
        };
        send(acquired, &posed.frame.pixels);
        if let Some((image, _)) = &developed.drr {
            send(drr, &image.pages[0]);
        }
    }
}

fn transform(device: &str, time_us: i64, transform: Rigid) -> Message {
    Message { device: device.to_owned(), time_us, content: Content::Transform(transform) }
}

fn status_of(posed: &Posed, words: &str) -> Status {
    let disagrees = posed.telemetry_disagreement.is_some() || posed.other_depth.is_some();
    let (code, name) = match (posed.pose.is_accepted(), disagrees, &posed.pose.doubt) {
        (true, false, None) => (Status::OK, Standing::Accepted.short()),
        (true, true, _) => (Status::ERROR, Standing::TelemetryDisagrees.short()),
        (true, false, Some(_)) => (Status::ERROR, Standing::InDoubt.short()),
        (false, _, _) => (Status::ERROR, Standing::Refused.short()),
    };
    Status { code, frame: i64::from(posed.number), name: name.to_owned(), words: words.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The robot was silent for minutes, and whoever listened read that all was accepted.
    #[test]
    fn a_silent_device_stands_before_what_is_said_of_the_frame() {
        let words = "frame 4 (a): accepted, rms 0.1 px".to_owned();
        let accepted = Status { code: Status::OK, frame: 4, name: "accepted".to_owned(), words };
        assert_eq!(beside(&accepted, &[]), accepted);
        let robot = Silent { device: DeviceKind::Robot, ever: true };
        let told = beside(&accepted, &[robot]);
        assert_eq!((told.code, told.frame, told.name.as_str()), (Status::ERROR, 4, "robot silent"));
        assert!(told.words.starts_with("the robot is not heard any more, and what was sent of it stands"), "{}", told.words);
        assert!(told.words.ends_with(&accepted.words), "{}", told.words);
        let carm = Silent { device: DeviceKind::Carm, ever: false };
        let told = beside(&accepted, &[carm, robot]);
        // The protocol has room for twenty characters.
        assert!(told.name == "C-arm, robot silent" && told.name.len() <= 20, "{}", told.name);
        assert!(told.words.contains("nothing has come from the C-arm yet"), "{}", told.words);
    }

    /// Navigation would have used a pose that was 6 mm off as a good one.
    #[test]
    fn a_depth_that_is_another_reaches_those_who_listen() {
        let k = crate::geometry::Intrinsics { fx: 1700.0, fy: 1700.0, skew: 0.0, cx: 199.5, cy: 159.5 };
        let projection = Some(crate::geometry::Projection::compose(&k, &Rigid::IDENTITY));
        let pose = crate::pose::Pose { projection, ..crate::pose::Pose::default() };
        let posed = Posed { pose, ..Posed::bare(1) };
        assert_eq!(status_of(&posed, "").code, Status::OK);
        let told = status_of(&Posed { other_depth: Some("nearer".to_owned()), ..posed }, "");
        assert_eq!((told.code, told.name.as_str()), (Status::ERROR, "telemetry disagrees"));
    }
}
