//! A session heard by pyigtl, the client that laboratories have: what it understands is what stands in the log and in the session's folder.
#![cfg(unix)]

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::{Value, json};
use sidecarm::image::read_tiff_f32;

use crate::igtl_session::{heard, poses};
use crate::live_lab::Running;

/// Prints every message that pyigtl gives, a line each, until the other side closes or the time is over.
const LISTEN: &str = r#"
import json, sys, time
import pyigtl
client = pyigtl.OpenIGTLinkClient(host=sys.argv[1], port=int(sys.argv[2]))
end = time.time() + float(sys.argv[3])
while time.time() < end:
    for message in client.get_latest_messages():
        row = {"device": message.device_name, "type": message.message_type, "stamp": message.timestamp}
        if message.message_type == "TRANSFORM":
            row["matrix"] = [[float(value) for value in line] for line in message.matrix]
        elif message.message_type == "STRING":
            row["text"] = message.string
        elif message.message_type == "IMAGE":
            row["shape"] = list(message.image.shape)
            row["sum"] = float(message.image.astype("float64").sum())
            row["matrix"] = [[float(value) for value in line] for line in message.ijk_to_world_matrix]
        print(json.dumps(row), flush=True)
    time.sleep(0.002)
"#;

/// Where `scripts/install --tests` puts pyigtl; `None` (said) where it is not.
fn peers() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/peers");
    let there = folder.join("pyigtl").is_dir();
    if !there {
        println!("skipped: pyigtl is not in target/peers; scripts/install --tests puts it there");
    }
    there.then_some(folder)
}

/// pyigtl in a process of its own.
pub struct Peer {
    python: Running,
    /// What it prints, and what it complains of.
    files: [PathBuf; 2],
}

impl Peer {
    /// Begins to listen, with its files in `folder`; `None` (said) where it is not there.
    pub fn start(folder: &Path, address: SocketAddr) -> Option<Self> {
        let peers = peers()?;
        let files = ["heard.jsonl", "heard.txt"].map(|name| folder.join(name));
        let [out, complaints] = [0, 1].map(|at| Stdio::from(std::fs::File::create(&files[at]).expect("a file")));
        let mut python = Command::new("/usr/bin/python3");
        python.args(["-c", LISTEN, &address.ip().to_string(), &address.port().to_string(), "390"]).env("PYTHONPATH", &peers);
        let python = Running(python.stdout(out).stderr(complaints).spawn().expect("Python starts"));
        Some(Self { python, files })
    }

    fn heard(&self) -> Vec<Value> {
        let text = std::fs::read_to_string(&self.files[0]).unwrap_or_default();
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        whole.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
    }

    pub fn complaints(&self) -> String {
        std::fs::read_to_string(&self.files[1]).expect("what it complains of")
    }

    /// pyigtl keeps the newest message of each device: what comes more often than it is asked is not seen.
    pub fn has_enough(&self) -> bool {
        let heard = self.heard();
        let devices = ["LpsToCamera", "Drr", "Acquired", "TipToLps", "Frame"];
        devices.iter().all(|device| heard.iter().any(|row| row["device"] == *device))
    }

    /// It listens until it is told otherwise; what it heard, and what it complained of.
    pub fn end(mut self) -> (Vec<Value>, String) {
        self.python.kill();
        (self.heard(), self.complaints())
    }
}

#[test]
fn pyigtl_understands_a_session() {
    if peers().is_none() {
        return;
    }
    let Some(session) = heard() else { return };
    let (heard, wrong) = session.by_peer.as_ref().expect("pyigtl was there");
    let of = |device: &str| -> Vec<Value> { heard.iter().filter(|row| row["device"] == device).cloned().collect() };
    assert!(!wrong.contains("Error") && !wrong.contains("CRC"), "{wrong}");

    let logged = poses(&session.log);
    let logged_at = |row: &Value| {
        let us = row["stamp"].as_f64().expect("seconds") * 1e6;
        // Seconds since 1970 as a float are good to a quarter of a microsecond.
        logged.range((us - 1.5) as i64..=(us + 1.5) as i64).next().map(|(_, pose)| *pose)
    };
    let matrix = |row: &Value| -> [[f64; 4]; 4] { serde_json::from_value(row["matrix"].clone()).expect("four rows") };
    let mut transforms = 0;
    for row in of("LpsToCamera") {
        let (number, accepted, pose) = logged_at(&row).unwrap_or_else(|| panic!("no pose at {row}"));
        let pose = pose.expect("a camera");
        assert!(accepted, "frame {number} was refused");
        for (heard, logged) in matrix(&row).iter().flatten().zip(pose.iter().flatten()) {
            assert!((heard - logged).abs() <= logged.abs() * 1e-6 + 1e-6, "frame {number}: {heard} {logged}");
        }
        transforms += 1;
    }
    assert!(transforms >= 1, "no transform");
    for row in of("Acquired") {
        assert_eq!(row["shape"], json!([1, 480, 620]), "{row}");
    }
    // Rows of a picture are its second axis: the DRR is the file's, pixel for pixel, as far as its sum and its scale tell.
    let drrs = of("Drr");
    assert!(!drrs.is_empty(), "no DRR");
    for row in &drrs {
        let (number, accepted, _) = logged_at(row).expect("the pose of a DRR");
        let file = read_tiff_f32(&session.out.join(format!("drr/{number:03}.tif"))).expect("readable").remove(0);
        let sum: f64 = file.pixels.iter().map(|value| f64::from(*value)).sum();
        assert_eq!(row["shape"], json!([1, file.height, file.width]));
        assert!((row["sum"].as_f64().expect("a sum") - sum).abs() <= 1e-9 * sum.abs(), "{row} {sum}");
        let place = matrix(row);
        let step_mm = |axis: usize| (0..3).map(|k| place[k][axis].powi(2)).sum::<f64>().sqrt();
        assert!((step_mm(0) - step_mm(1)).abs() < 1e-4, "{place:?}");
        assert!(accepted && (0.1..0.6).contains(&step_mm(0)), "{accepted} {place:?}");
    }
    // It gives the newest message of a device when it is asked: how many of a hundred in a second it sees hangs on the machine.
    let stamps_s: Vec<f64> = of("TipToLps").iter().filter_map(|row| row["stamp"].as_f64()).collect();
    assert!(stamps_s.len() >= 2 && stamps_s.windows(2).all(|two| two[0] < two[1]), "{stamps_s:?}");
    assert!(of("Frame").iter().all(|row| row["text"].as_str().is_some_and(|text| text.starts_with("frame "))));
}
