//! A session heard over OpenIGTLink by a client of its own, and by pyigtl: what it says is what stands in the log, and nothing of a refused frame.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock};

use serde_json::{Value, json};
use sidecarm::image::read_tiff_f32;
use sidecarm::record::{read_log, topic};

use crate::igtl_client::{Client, Told};
use crate::igtl_peer::Peer;
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

pub type Matrix = [[f64; 4]; 4];

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..4).map(|k| a[row][k] * b[k][column]).sum()))
}

fn place(matrix: &Matrix) -> [f64; 3] {
    std::array::from_fn(|row| matrix[row][3])
}

fn apart_mm(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

/// The address that the program says.
pub fn address(words: &str) -> Option<std::net::SocketAddr> {
    words.split("OpenIGTLink listens on ").nth(1)?.split_whitespace().next()?.parse().ok()
}

/// Poses of the log by time: number, whether accepted, `camera_from_lps`.
pub fn poses(log: &Path) -> BTreeMap<i64, (u64, bool, Option<Matrix>)> {
    let mut found = BTreeMap::new();
    for entry in &read_log(log).expect("the log opens").entries {
        if &*entry.topic == topic::POSE {
            let pose: Value = entry.json().expect("JSON");
            let number = pose["number"].as_u64().expect("a number");
            let matrix = serde_json::from_value(pose["camera_from_lps"].clone()).ok();
            found.insert(entry.host_us, (number, pose["pose"]["status"] == "accepted", matrix));
        }
    }
    found
}

/// What two clients heard of one session.
pub struct Heard {
    pub told: Vec<Told>,
    /// pyigtl's messages, and what it complained of, where it is there.
    pub by_peer: Option<(Vec<Value>, String)>,
    pub out: PathBuf,
    pub log: PathBuf,
    pub stderr: String,
}

fn hear() -> Option<Heard> {
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("igtl");
    let _ = std::fs::remove_dir_all(&home);
    std::fs::create_dir_all(&home).expect("a folder");
    let lab = Lab::start(&["--duration-s", "12", "--faults", "none"])?;
    let session = lab.session("heard.json", |session| session["igtl"] = json!({ "port": 0 }));
    let mut live = Live::launch(&session, &home.join("heard"), &[]);
    let address = eventually(HANG_S, || address(&live.stderr())).expect("it says where it listens");
    assert!(address.ip().is_loopback(), "{address}");
    let peer = Peer::start(&home, address);
    let told = Arc::new(Mutex::new(Vec::<Told>::new()));
    let listener = {
        let (told, mut client) = (Arc::clone(&told), Client::connect(address));
        std::thread::spawn(move || {
            std::iter::from_fn(|| client.next()).for_each(|message| told.lock().expect("not poisoned").push(message));
        })
    };
    let has = |device: &str, is_it: fn(&Told) -> bool| {
        told.lock().expect("not poisoned").iter().any(|told| told.device == device && is_it(told))
    };
    // On a crowded machine the newest frames are developed first, and of older ones only the lines are told.
    let enough = eventually(HANG_S, || {
        (has("Frame", is_refused) && has("Drr", |_| true) && (has("AcquiredUnplaced", |_| true) || live.pairs() == 8))
            .then_some(())
    });
    assert!(enough.is_some(), "no refused frame, or no DRR: {}", live.stderr());
    if let Some(peer) = &peer {
        assert!(eventually(HANG_S, || peer.has_enough().then_some(())).is_some(), "{} {}", peer.complaints(), live.stderr());
    }
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "the session ends");
    listener.join().expect("the client is well");
    let by_peer = peer.map(Peer::end);
    let told = std::mem::take(&mut *told.lock().expect("not poisoned"));
    Some(Heard { told, by_peer, out: live.out.clone(), log: live.log.clone(), stderr: live.stderr() })
}

/// One session for both clients; `None` (said) where mock-lab was not built.
pub fn heard() -> Option<&'static Heard> {
    static HEARD: OnceLock<Option<Heard>> = OnceLock::new();
    HEARD.get_or_init(hear).as_ref()
}

fn is_refused(told: &Told) -> bool {
    told.text().contains("refused, ")
}

#[test]
fn a_session_tells_its_poses_pictures_and_lines() {
    let Some(heard) = heard() else { return };
    let of = |device: &str| -> Vec<Told> { heard.told.iter().filter(|told| told.device == device).cloned().collect() };
    assert_eq!(of("Sidecarm").last().map(Told::status), Some((19, "the session ends".to_owned())));

    let poses = poses(&heard.log);
    let (mut transforms, mut worlds) = (0, Vec::new());
    let nominal = of("CameraToWorld");
    assert!(nominal.len() > 30 && nominal.is_sorted_by_key(Told::time_us), "{} of the C-arm", nominal.len());
    for told in of("LpsToCamera") {
        let (_, accepted, logged) = &poses[&told.time_us()];
        assert!(accepted, "of a refused frame");
        let logged = logged.expect("a camera");
        for (heard, logged) in told.matrix().iter().flatten().zip(logged.iter().flatten()) {
            assert!((heard - logged).abs() <= logged.abs() * 1e-6 + 1e-6, "{heard} {logged}");
        }
        transforms += 1;
        // world_from_camera · camera_from_lps: the specimen lies still, wherever the arm stands.
        let nearest = nominal.iter().min_by_key(|of_arm| (of_arm.time_us() - told.time_us()).abs()).expect("some");
        worlds.push(place(&product(&nearest.matrix(), &told.matrix())));
    }
    assert!(transforms >= 1, "no transform");
    for (index, world) in worlds.iter().enumerate() {
        assert!(apart_mm(*world, worlds[0]) < 25.0, "frame {index}: {worlds:?}");
    }
    // Into RAS and back: the camera's own origin, x and y negated.
    let (to_ras, to_camera) = (of("CameraToRas"), of("LpsToCamera"));
    assert_eq!(to_ras.len(), to_camera.len());
    let ras = to_ras[0].matrix();
    let lps = [-ras[0][3], -ras[1][3], ras[2][3], 1.0];
    let origin = to_camera[0].matrix().map(|row| (0..4).map(|k| row[k] * lps[k]).sum::<f64>());
    assert!(apart_mm([origin[0], origin[1], origin[2]], [0.0; 3]) < 1e-2, "{origin:?}");

    // The tip lies a robot's length from its base.
    let (bases, tips, points) = (of("BaseToLps"), of("TipToLps"), of("Tip"));
    assert!(tips.len() > 50 && bases.len() >= tips.len(), "{} {}", bases.len(), tips.len());
    // The robot tells its shape a hundred times a second.
    let spans_us = tips.windows(4).map(|four| four[3].time_us() - four[0].time_us());
    assert!(
        spans_us.filter(|span_us| *span_us > 0).min().is_some_and(|least_us| least_us < 45_000),
        "no four places of the tip in a row"
    );
    let (base, tip) = (place(&bases[0].matrix()), place(&tips[0].matrix()));
    assert!((20.0..60.0).contains(&apart_mm(base, tip)), "{base:?} {tip:?}");
    assert_eq!(std::array::from_fn(|k| points[0].float32(4 * k)), tip);

    // A refused frame: its line, its picture nowhere, and no transform.
    let lines = of("Frame");
    let line = lines.iter().find(|line| is_refused(line)).expect("there is one");
    assert!(heard.stderr.contains(&line.text()), "{}", line.text());
    let (number, accepted, _) = poses[&line.time_us()];
    assert!(!accepted && line.text().starts_with(&format!("frame {number} ")), "{}", line.text());
    let has = |device: &str, time_us: i64| of(device).iter().any(|told| told.time_us() == time_us);
    assert!(!has("LpsToCamera", line.time_us()) && !has("CameraToRas", line.time_us()));
    let mut pictures = 0;
    for (device, is_placed) in [("Acquired", true), ("AcquiredUnplaced", false)] {
        for picture in of(device) {
            let size = [6, 8].map(|at| picture.uint16(at));
            let (step_mm, z_mm) = (picture.float32(12), picture.float32(56));
            assert_eq!((size, poses[&picture.time_us()].1), ([620, 480], is_placed), "{device}");
            match is_placed {
                true => assert!((0.1..0.6).contains(&step_mm) && (800.0..1400.0).contains(&z_mm), "{step_mm} {z_mm}"),
                false => assert_eq!((step_mm, z_mm), (1.0, 0.0)),
            }
            pictures += 1;
        }
    }
    assert!(pictures >= 1, "no picture");
    // The DRR is the one in the session's folder.
    let drr = of("Drr").pop().expect("some");
    let number = poses[&drr.time_us()].0;
    let file = read_tiff_f32(&heard.out.join(format!("drr/{number:03}.tif"))).expect("readable").remove(0);
    let bytes: Vec<u8> = file.pixels.iter().flat_map(|value| value.to_le_bytes()).collect();
    assert!(drr.content[72..] == bytes[..], "DRR of frame {number}");
}
