//! The ports and files of `check`: what is there, what is wrong.
#![cfg(unix)]

use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serialport::{SerialPort, TTYPort};
use sidecarm::cli::line_checks::{CheckFile, CheckList, FileCheck, check_lines};
use sidecarm::telemetry::{DeviceKind, PortConfig};

use crate::telemetry_frames::{GOLDEN_METADATA, bytes, plain};

#[test]
fn a_session_is_checked_line_by_line() {
    let (mut master, mut slave) = TTYPort::pair().expect("pseudo-terminals are there");
    let path = slave.name().expect("the slave has a path");
    slave.set_exclusive(false).expect("the slave can be shared");
    drop(slave);
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    let sender = std::thread::spawn(move || {
        let mut sequence = 100;
        while !stopped.load(Ordering::Relaxed) {
            // Whoever listens may be gone already.
            let _ = master.write_all(&if sequence % 20 == 0 { bytes(GOLDEN_METADATA) } else { plain(sequence) });
            sequence += 1;
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    let folder = tempfile::tempdir().expect("a folder");
    let broken = folder.path().join("broken.json");
    std::fs::write(&broken, "{\"origin\": 1,").expect("written");
    let calibration = folder.path().join("carm.json");
    let text = r#"{"origin": "bench", "columns_px": 620, "rows_px": 480, "pitch_mm": 0.4, "source_to_isocentre_mm": 600.0, "column_to_isocentre_mm": [0, 0, 0]}"#;
    std::fs::write(&calibration, text).expect("written");
    let missing = folder.path().join("missing");
    let file = |role: &str, path: &PathBuf, check| CheckFile { role: role.to_owned(), path: path.clone(), check };
    let lines = check_lines(&CheckList {
        carm: Some(PortConfig::new(DeviceKind::Carm, &path)),
        robot: Some(PortConfig::new(DeviceKind::Robot, &missing)),
        files: vec![
            file("calibration", &calibration, FileCheck::CarmCalibration),
            file("scene", &broken, FileCheck::Json),
            file("beads", &missing, FileCheck::Json),
            file("frames", &folder.path().to_path_buf(), FileCheck::Folder),
        ],
    });
    stop.store(true, Ordering::Relaxed);
    sender.join().expect("sent");
    let verdicts: Vec<(&str, bool)> = lines.iter().map(|line| (line.what.as_str(), line.ok)).collect();
    let expected =
        [("C-arm", true), ("robot", false), ("calibration", true), ("scene", false), ("beads", false), ("frames", true)];
    assert_eq!(verdicts, expected, "{lines:#?}");
    assert!(lines[0].rate_hz.is_some_and(|rate_hz| rate_hz > 5.0), "{}", lines[0].detail);
    assert!(lines[0].detail.contains("CARM-0042"), "{}", lines[0].detail);
    assert!(lines[1].detail.contains("does not exist"), "{}", lines[1].detail);
    assert!(lines[3].detail.contains("line 1"), "{}", lines[3].detail);
}
