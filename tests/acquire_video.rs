//! `sidecarm grab` on recordings of a monitor: what stands still becomes a frame, once, with its time and its values.
#![cfg(feature = "vision")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use opencv::core::{CV_8UC3, Mat, MatTraitManual, Scalar, Size, Vec3b};
use opencv::videoio::{VideoWriter, VideoWriterTrait, VideoWriterTraitConst};
use sidecarm::acquire::{Domain, Frame, read_frames};
use sidecarm::random::{Purpose, Stream};

const SIZE: [usize; 2] = [320, 240];
/// The radiograph in the monitor's picture.
const CROP: [usize; 4] = [40, 0, 240, 240];
const PER_S: f64 = 30.0;

/// What the monitor shows for how many pictures.
#[derive(Clone, Copy)]
enum Shown {
    Empty(u32),
    /// Another exposure every picture.
    Fluoroscopy(u32),
    /// The last image.
    Held(u32),
    /// A menu over it.
    Menu(u32),
}

/// Signal of the `exposure`th picture where nothing is written over it: a wedge, and a rod that has moved on.
fn signal(exposure: u32, column: usize, row: usize) -> f64 {
    let across = row as f64 - (60.0 + 20.0 * f64::from(exposure % 5));
    let rod = if across.abs() < 6.0 && (60..260).contains(&column) { 0.4 } else { 1.0 };
    rod * (60.0 + 0.4 * column as f64)
}

fn draw(shown: Shown, exposure: u32, number: u32, clock: bool) -> Mat {
    let mut mat = Mat::new_rows_cols_with_default(SIZE[1] as i32, SIZE[0] as i32, CV_8UC3, Scalar::all(0.0)).expect("a picture");
    let mut noise = Stream::new(1, exposure, 0, Purpose::QuantumNoise);
    let pixels = mat.data_typed_mut::<Vec3b>().expect("colours");
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (column, row) = (index % SIZE[0], index / SIZE[0]);
        let inside = (CROP[0]..CROP[0] + CROP[2]).contains(&column);
        let radiograph = (signal(exposure, column, row) + 4.0 * noise.normal()).round().clamp(0.0, 255.0) as u8;
        let value = match shown {
            Shown::Empty(_) => 12,
            Shown::Menu(_) if row > 120 => 200,
            _ if inside => radiograph,
            _ => 12,
        };
        let digit = clock && row < 16 && (200..260).contains(&column) && (number as usize * 7 + column * row) % 11 < 5;
        *pixel = Vec3b::from([if digit { 250 } else { value }; 3]);
    }
    mat
}

/// Records a monitor that shows these; where each held picture begins, in pictures, and its exposure.
fn record(path: &Path, shown: &[Shown], clock: bool) -> Vec<(u32, u32)> {
    let fourcc = VideoWriter::fourcc('M', 'J', 'P', 'G').expect("a code");
    let mut writer =
        VideoWriter::new(path.to_str().expect("UTF-8"), fourcc, PER_S, Size::new(SIZE[0] as i32, SIZE[1] as i32), true)
            .expect("a writer");
    assert!(writer.is_opened().expect("asked"), "OpenCV writes MJPG");
    let (mut number, mut exposure, mut held) = (0, 0, Vec::new());
    for shown in shown {
        let pictures = match shown {
            Shown::Held(pictures) => {
                exposure += 1;
                held.push((number, exposure));
                pictures
            }
            Shown::Empty(pictures) | Shown::Fluoroscopy(pictures) | Shown::Menu(pictures) => pictures,
        };
        for _ in 0..*pictures {
            exposure += u32::from(matches!(shown, Shown::Fluoroscopy(_)));
            writer.write(&draw(*shown, exposure, number, clock)).expect("written");
            number += 1;
        }
    }
    writer.release().expect("closed");
    held
}

fn grab(video: &Path, into: &Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    // OpenCV's words go to its standard output then: none of them may come among the pictures.
    command.env("OPENCV_LOG_LEVEL", "INFO");
    command.arg("grab").arg(video).arg("--into").arg(into).args(more).output().expect("runs")
}

/// The frames of a folder in the order of their names, by the time at which they began to stand.
fn frames(folder: &Path) -> Vec<(i64, Frame)> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).expect("listed").flatten().map(|entry| entry.path()).collect();
    files.sort();
    let read = |file: &PathBuf| {
        let frame = read_frames(file, None).expect("a frame").remove(0);
        (frame.tags.acquired_local_us().expect("a time"), frame)
    };
    files.iter().map(read).collect()
}

#[test]
fn pictures_that_stand_are_frames_with_their_time_and_values() {
    let folder = tempfile::tempdir().expect("a folder");
    let (video, into) = (folder.path().join("monitor.avi"), folder.path().join("frames"));
    std::fs::create_dir(&into).expect("a folder");
    let shown = [
        Shown::Empty(30),
        Shown::Held(40),
        Shown::Fluoroscopy(75),
        Shown::Held(50),
        Shown::Menu(5),
        Shown::Held(30),
        Shown::Empty(20),
        Shown::Held(40),
    ];
    let held = record(&video, &shown, true);
    // A clock runs in a corner of the radiograph.
    let crop = ["--crop", "40,0,240,240", "--at-once", "--include-first"];
    let masked = [&crop[..], &["--mask", "196,0,70,20"]].concat();
    let ran = grab(&video, &into, &masked);
    let said = String::from_utf8_lossy(&ran.stderr).into_owned();
    assert_eq!(ran.status.code(), Some(0), "{said}");
    assert!(said.contains("video of 320 x 240, 30 pictures a second") && said.contains("4 pictures"), "{said}");
    let found = frames(&into);
    assert_eq!((found.len(), String::from_utf8_lossy(&ran.stdout).lines().count()), (held.len(), held.len()));
    for ((us, frame), (number, exposure)) in found.iter().zip(&held) {
        assert_eq!((frame.domain, frame.size_px), (Domain::Display, [240, 240]));
        let since_s = (us - found[0].0) as f64 * 1e-6;
        let expected_s = f64::from(number - held[0].0) / PER_S;
        assert!((since_s - expected_s).abs() < 2.5 / PER_S, "{since_s} of {expected_s} s");
        // The very exposure: its own noise is in it, and that of no other.
        let mut noise = Stream::new(1, *exposure, 0, Purpose::QuantumNoise);
        let mut drawn = vec![0.0; SIZE[0] * SIZE[1]];
        for (index, value) in drawn.iter_mut().enumerate() {
            *value = (signal(*exposure, index % SIZE[0], index / SIZE[0]) + 4.0 * noise.normal()).round().clamp(0.0, 255.0);
        }
        let apart = |row: usize, column: usize| {
            let stored = f64::from(*frame.pixels.at(column, row)) / 257.0;
            (stored - drawn[row * SIZE[0] + column + CROP[0]]).powi(2)
        };
        let sum: f64 =
            (30..240).flat_map(|row| (0..240).map(move |column| (row, column))).map(|(row, column)| apart(row, column)).sum();
        let rms = (sum / (210.0 * 240.0)).sqrt();
        // What MJPG leaves of quantum noise of 4: the wrong exposure's is 5.7 and more.
        assert!(rms < 3.5, "exposure {exposure}: {rms}");
    }
    // Nothing else is left there, and the same again gets names of its own.
    assert_eq!(grab(&video, &into, &masked).status.code(), Some(0));
    assert_eq!(frames(&into).len(), 2 * held.len());
}

#[test]
fn the_picture_at_the_beginning_is_known_unless_it_is_asked_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let video = folder.path().join("monitor.avi");
    record(&video, &[Shown::Held(40), Shown::Held(40)], false);
    for (more, expected) in [(&["--at-once"][..], 1), (&["--at-once", "--include-first"][..], 2)] {
        let into = folder.path().join(expected.to_string());
        std::fs::create_dir(&into).expect("a folder");
        assert_eq!(grab(&video, &into, more).status.code(), Some(0));
        assert_eq!(frames(&into).len(), expected);
    }
}

#[test]
fn linear_frames_are_those_whose_gamma_is_known() {
    let folder = tempfile::tempdir().expect("a folder");
    let video = folder.path().join("monitor.avi");
    record(&video, &[Shown::Empty(20), Shown::Held(40)], false);
    let mean = |more: &[&str], domain: Domain| {
        let into = tempfile::tempdir_in(folder.path()).expect("a folder");
        assert_eq!(grab(&video, into.path(), &[&["--at-once"], more].concat()).status.code(), Some(0));
        let (_, frame) = frames(into.path()).remove(0);
        assert_eq!(frame.domain, domain);
        // A patch of the wedge that no rod crosses.
        let patch = frame.pixels.part(&[200..216, 200..216]);
        f64::from(patch.pixels.iter().sum::<f32>()) / patch.pixels.len() as f64 / 65_535.0
    };
    let (shown, linear) = (mean(&[], Domain::Display), mean(&["--gamma", "2.2"], Domain::Linear));
    assert!((shown - 0.56).abs() < 0.03, "{shown}");
    assert!((linear / shown.powf(2.2) - 1.0).abs() < 0.03, "{linear} of {shown}");
}

#[test]
fn what_gives_no_frame_is_one_sentence() {
    let folder = tempfile::tempdir().expect("a folder");
    let (video, into) = (folder.path().join("monitor.avi"), folder.path().join("frames"));
    std::fs::create_dir(&into).expect("a folder");
    record(&video, &[Shown::Empty(10), Shown::Held(700)], true);
    std::fs::write(folder.path().join("notes.txt"), "no video").expect("written");
    let said = |video: &str, more: &[&str]| {
        let ran = grab(&folder.path().join(video), &into, &[&["--at-once", "--include-first"], more].concat());
        let said = String::from_utf8_lossy(&ran.stderr).into_owned();
        assert!(ran.status.code() == Some(1) && !said.contains("panicked"), "{video} {more:?}: {ran:?}");
        said
    };
    let restless = said("monitor.avi", &[]);
    assert!(restless.contains("no picture of the video stood still for 20 s"), "{restless}");
    let place = restless.split_once("around column ").and_then(|(_, after)| after.split_once(", row ")).expect("a place");
    let column: usize = place.0.parse().expect("a number");
    assert!((190..262).contains(&column) && place.1.starts_with("0 of the video"), "{restless}");
    for (video, more, words) in [
        ("notes.txt", &[][..], "cannot be opened as a video"),
        ("none.avi", &[], "cannot be opened as a video"),
        ("monitor.avi", &["--crop", "300,0,100,100"], "does not lie within the video of 320 x 240"),
        ("monitor.avi", &["--gamma", "0"], "gamma is 0, expected 0.1 to 10"),
        ("monitor.avi", &["--crop", "3,3,0,9"], "crop_px is [3, 3, 0, 9]"),
    ] {
        assert!(said(video, more).contains(words), "{video} {more:?}: {}", said(video, more));
    }
    assert_eq!(std::fs::read_dir(&into).expect("listed").count(), 0);
}

/// Each start of the program would wait for 250 libraries.
#[cfg(target_os = "linux")]
#[test]
fn the_program_itself_brings_no_library_of_videos() {
    let names = |program: &str| {
        let bytes = std::fs::read(program).expect("a program");
        bytes.windows(17).any(|part| part == b"libopencv_videoio")
    };
    assert!(!names(env!("CARGO_BIN_EXE_sidecarm")));
    assert!(names(env!("CARGO_BIN_EXE_sidecarm-video")), "the control");
}

/// Beside the program lies another that reads video, or none: said, and with what to do.
#[cfg(unix)]
#[test]
fn a_reader_of_videos_that_dies_or_is_not_there_is_said() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a folder");
    let program = folder.path().join("sidecarm");
    std::fs::hard_link(env!("CARGO_BIN_EXE_sidecarm"), &program).expect("linked");
    let into = folder.path().join("frames");
    std::fs::create_dir(&into).expect("a folder");
    let said = || {
        let ran = Command::new(&program).args(["grab", "a.avi", "--into"]).arg(&into).output().expect("runs");
        let words = String::from_utf8_lossy(&ran.stderr).into_owned();
        assert!(ran.status.code() == Some(1) && !words.contains("panicked"), "{words}");
        words
    };
    let words = said();
    assert!(words.contains("sidecarm-video") && words.contains("cargo build"), "{words}");
    let reader = folder.path().join("sidecarm-video");
    let nothing = "\\000".repeat(8);
    for (picture, expected) in [("\\012\\000", "has ended in the middle"), (nothing.as_str(), "its pictures have 0 x 0 pixels")] {
        // Open, not live, 25 pictures a second; then half a picture, or an empty one.
        std::fs::write(&reader, format!("#!/bin/sh\nprintf 'O{nothing}\\071\\100P{picture}'\n")).expect("written");
        std::fs::set_permissions(&reader, std::fs::Permissions::from_mode(0o755)).expect("may run");
        let words = said();
        assert!(words.contains(expected), "{words}");
    }
}

/// Whatever its driver hangs in, as here in a pipe that nobody opens.
#[cfg(unix)]
#[test]
fn a_reader_of_videos_ends_with_whoever_started_it() {
    use crate::live_lab::{HANG_S, Running};
    use std::process::Stdio;
    let folder = tempfile::tempdir().expect("a folder");
    let pipe = folder.path().join("monitor.y4m");
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm-video"));
    command.arg(&pipe).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut reader = Running(command.spawn().expect("starts"));
    assert!(reader.end(0.5).is_none(), "the control: it waits");
    drop(reader.0.stdin.take());
    assert!(reader.end(HANG_S).is_some(), "it goes on");
}

/// A word that OpenCV or a driver wrote to standard output was taken for a part of a picture, and the video was over.
#[cfg(unix)]
#[test]
fn words_of_libraries_do_not_come_among_the_pictures() {
    use std::process::Stdio;
    const PICTURES: usize = 3;
    let folder = tempfile::tempdir().expect("a folder");
    let video = folder.path().join("monitor.avi");
    record(&video, &[Shown::Held(PICTURES as u32)], false);
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm-video"));
    command.arg(&video).env("OPENCV_LOG_LEVEL", "INFO").stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut reader = command.spawn().expect("starts");
    // It ends with its standard input.
    let input = reader.stdin.take();
    let ran = reader.wait_with_output().expect("ends");
    drop(input);
    let words = String::from_utf8_lossy(&ran.stderr);
    assert!(words.contains("INFO"), "the control, OpenCV says something: {words}");
    // Open, then the pictures, then the end.
    let bytes = 1 + 2 + 8 + PICTURES * (1 + 8 + SIZE[0] * SIZE[1]) + 1;
    assert_eq!((ran.stdout.len(), ran.stdout.first(), ran.stdout.last()), (bytes, Some(&b'O'), Some(&b'E')), "{words}");
}

/// Who grabs heard nothing of a session's end while its driver opened the device, here a pipe that nobody opens.
#[cfg(unix)]
#[test]
fn a_video_that_does_not_open_is_left_when_the_session_ends() {
    use crate::live_lab::{HANG_S, Running, eventually, process_with};
    use std::process::Stdio;
    let folder = tempfile::tempdir().expect("a folder");
    let pipe = folder.path().join("monitor.y4m");
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("grab").arg(&pipe).arg("--into").arg(folder.path()).args(["--attended", "--json"]);
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut grabbing = Running(command.spawn().expect("starts"));
    let opening = || process_with(&[pipe.as_os_str().as_encoded_bytes()]);
    assert!(eventually(HANG_S, opening).is_some() && grabbing.end(0.5).is_none(), "the control: it waits");
    drop(grabbing.0.stdin.take());
    let status = grabbing.end(HANG_S).expect("it goes on");
    assert!(status.success(), "{status}");
}
