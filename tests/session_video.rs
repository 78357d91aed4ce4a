//! A session whose frames come off a monitor: a pipe stands for the capture device, and what the monitor shows is what the mocked console exports.
#![cfg(all(unix, feature = "vision"))]

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::Value;
use sidecarm::acquire::{Frame, read_frames};
use sidecarm::image::Image;

use crate::lab_truth::{counter_of, has_its_own_exposure, pairs, poses};
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually, process_with};

const PER_S: u64 = 15;

/// Grey values of a screen, black to the left and right of the radiograph.
fn on_screen(frame: &Frame) -> Image<u8> {
    let (width, height) = (frame.pixels.width + 100, frame.pixels.height);
    let most = frame.pixels.pixels.iter().copied().fold(1.0, f32::max);
    let mut screen = Image::filled(width, height, 8);
    for row in 0..height {
        for column in 0..frame.pixels.width {
            let signal = (frame.pixels.at(column, row).max(0.0) / most).powf(0.5);
            *screen.at_mut(column + 50, row) = (16.0 + 230.0 * signal).round() as u8;
        }
    }
    screen
}

/// Shows each frame of `folder` as soon as it is whole, until `stop`; the exposures in the order in which they were shown.
fn monitor(folder: PathBuf, pipe: PathBuf, size: [usize; 2], stop: Arc<AtomicBool>) -> Arc<Mutex<Vec<u32>>> {
    let shown = Arc::new(Mutex::new(Vec::new()));
    let told = Arc::clone(&shown);
    std::thread::spawn(move || {
        let Ok(mut pipe) = std::fs::OpenOptions::new().write(true).open(pipe) else { return };
        let mut known = BTreeSet::new();
        let mut screen = Image::filled(size[0], size[1], 8u8);
        let head = format!("YUV4MPEG2 W{} H{} F{PER_S}:1 Ip A1:1 Cmono\n", size[0], size[1]);
        if pipe.write_all(head.as_bytes()).is_err() {
            return;
        }
        // Each picture stands for a while, however many have come before anybody looked.
        let mut stands = 0;
        while !stop.load(Ordering::Relaxed) {
            let listed = std::fs::read_dir(&folder).expect("frames").flatten();
            let names = listed.map(|entry| entry.file_name().into_string().expect("UTF-8"));
            let next = names.filter(|name| name.ends_with(".dcm") && !known.contains(name)).min().filter(|_| stands == 0);
            stands = u64::saturating_sub(stands, 1);
            if let Some(name) = next
                && let Ok(mut frames) = read_frames(&folder.join(&name), None)
            {
                screen = on_screen(&frames.remove(0));
                told.lock().expect("not poisoned").push(counter_of(&name));
                known.insert(name);
                stands = PER_S;
            }
            if pipe.write_all(b"FRAME\n").and_then(|()| pipe.write_all(&screen.pixels)).is_err() {
                return;
            }
            std::thread::sleep(Duration::from_millis(1000 / PER_S));
        }
    });
    shown
}

fn pipe(path: &Path) {
    let made = Command::new("mkfifo").arg(path).status().expect("mkfifo");
    assert!(made.success());
}

#[test]
fn frames_off_a_monitor_are_bound_and_posed_as_if_they_were_sent() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "16", "--faults", "none", "--await-all"]) else { return };
    let folder = lab.kit.join("grabbed");
    std::fs::create_dir_all(&folder).expect("a folder");
    let capture = lab.kit.join("monitor.y4m");
    pipe(&capture);
    let session = lab.session("monitor.json", |session| {
        session["frames"]["folder"] = folder.to_str().expect("UTF-8").into();
        session["frames"]["video"] = serde_json::json!({"from": capture, "crop_px": [50, 0, 620, 480]});
        session["domain"] = "display".into();
    });
    let stop = Arc::new(AtomicBool::new(false));
    let shown = monitor(lab.frames(), capture, [720, 480], Arc::clone(&stop));
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &["--include-existing"]);
    let delivered = eventually(HANG_S, || Some(lab.delivered().len()).filter(|count| *count == 8));
    assert!(delivered.is_some(), "{} frames", lab.delivered().len());
    // What was shown while the grabber was not there yet, or for no third of a second, is no frame of it.
    let all = eventually(HANG_S, || (live.pairs() == 8).then_some(()));
    assert!(all.is_some(), "{} pairs: {}", live.pairs(), live.stderr());
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());
    stop.store(true, Ordering::Relaxed);
    assert!(live.stderr().contains("video of 720 x 480"), "{}", live.stderr());
    let shown = shown.lock().expect("not poisoned").clone();
    let (pairs, poses) = (pairs(&live), poses(&live));
    assert_eq!(pairs.len(), shown.len());
    let mut accepted = 0;
    for (pair, counter) in pairs.iter().zip(&shown) {
        assert_eq!(pair["binding"], "time", "{pair:#}");
        let pose = poses.iter().rfind(|pose| pose["number"] == pair["number"]).expect("posed");
        has_its_own_exposure(&lab, pose, *counter);
        accepted += u32::from(pose["pose"]["status"] == "accepted");
    }
    assert!(accepted >= 5, "{accepted} accepted: {}", live.stderr());
    let log = std::fs::read(live.out.join("report.html")).expect("a report");
    assert!(String::from_utf8_lossy(&log).contains("video-0001"));
}

/// A device that is not there is waited for, and what was missed is a loss; so is what reads it and dies.
#[test]
fn a_monitor_that_falls_silent_is_a_loss_and_comes_back() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "60", "--faults", "none", "--kit-only"]) else { return };
    let (folder, capture) = (lab.kit.join("grabbed"), lab.kit.join("none.y4m"));
    std::fs::create_dir_all(&folder).expect("a folder");
    let session = lab.session("silent.json", |session| {
        session["frames"]["folder"] = folder.to_str().expect("UTF-8").into();
        session["frames"]["video"] = serde_json::json!({"from": capture});
        session.as_object_mut().expect("keys").retain(|key, _| !["carm", "robot"].contains(&key.as_str()));
    });
    let out = lab.kit.with_file_name("session");
    let mut live = Live::launch(&session, &out, &[]);
    let said = eventually(HANG_S, || live.stderr().contains("no frames come of the video: it cannot be opened").then_some(()));
    assert!(said.is_some(), "{}", live.stderr());
    pipe(&capture);
    let stop = Arc::new(AtomicBool::new(false));
    monitor(lab.frames(), capture.clone(), [720, 480], Arc::clone(&stop));
    let back = eventually(HANG_S, || live.stderr().contains("the video is back").then_some(()));
    assert!(back.is_some(), "{}", live.stderr());
    let reader = || process_with(&[capture.as_os_str().as_encoded_bytes()]);
    let first = reader().expect("a process reads it");
    rustix::process::kill_process(first, Signal::KILL).expect("it is there");
    let next = eventually(HANG_S, || reader().filter(|next| *next != first));
    assert!(next.is_some(), "{}", live.stderr());
    live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).and_then(|status| status.code());
    assert_eq!(code, Some(3), "{}", live.stderr());
    assert!(live.stderr().contains("has ended in the middle of it; it is tried again"), "{}", live.stderr());
    let report: Value = live.report().contains("no frames come of the video").into();
    assert!(report == true, "{}", live.report());
}

/// A crop that does not lie within the video is a loss once, however often the grabber tries.
#[test]
fn a_crop_outside_the_video_is_said_once() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "60", "--faults", "none", "--kit-only"]) else { return };
    let (folder, capture) = (lab.kit.join("grabbed"), lab.kit.join("still.y4m"));
    std::fs::create_dir_all(&folder).expect("a folder");
    let head = format!("YUV4MPEG2 W64 H48 F{PER_S}:1 Ip A1:1 Cmono\n");
    let picture = [&b"FRAME\n"[..], &[90; 64 * 48]].concat();
    std::fs::write(&capture, [head.as_bytes(), &picture.repeat(20)].concat()).expect("written");
    let session = lab.session("cropped.json", |session| {
        session["frames"]["folder"] = folder.to_str().expect("UTF-8").into();
        session["frames"]["video"] = serde_json::json!({"from": capture, "crop_px": [0, 0, 640, 480]});
        session.as_object_mut().expect("keys").retain(|key, _| !["carm", "robot"].contains(&key.as_str()));
    });
    let mut live = Live::launch(&session, &lab.kit.with_file_name("session"), &["--seconds", "8"]);
    assert_eq!(live.program.end(HANG_S).and_then(|status| status.code()), Some(3), "{}", live.stderr());
    let words = live.stderr();
    assert_eq!(words.matches("does not lie within the video of 64 x 48").count(), 1, "{words}");
}
