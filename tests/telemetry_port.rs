//! The serial adapter on real pseudo-terminals: reading, unplugging, re-opening, errors, back-pressure.
#![cfg(unix)]

use std::io::Write;
use std::path::Path;
use std::time::Duration;

use serialport::{SerialPort, TTYPort};
use sidecarm::telemetry::{DeviceKind, Event, Link, PortConfig, PortError, PortEvent, hint, spawn_port};
use tokio::sync::mpsc;

use crate::telemetry_frames::plain;

/// The device's end of a pseudo-terminal, and the path of the other end.
fn pty() -> (TTYPort, String) {
    let (master, mut slave) = TTYPort::pair().expect("pseudo-terminals are there");
    let path = slave.name().expect("the slave has a path");
    slave.set_exclusive(false).expect("the slave can be shared");
    (master, path)
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("a runtime")
}

/// The next event, within ten seconds.
fn next(events: &mut mpsc::Receiver<(DeviceKind, PortEvent)>, runtime: &tokio::runtime::Runtime) -> PortEvent {
    let event = runtime.block_on(async { tokio::time::timeout(Duration::from_secs(10), events.recv()).await });
    event.expect("an event within ten seconds").expect("the port task runs").1
}

fn opened(event: &PortEvent) -> Option<u32> {
    if let PortEvent::Opened { epoch, .. } = event { Some(*epoch) } else { None }
}

#[test]
fn frames_arrive_the_device_is_unplugged_and_comes_back_elsewhere() {
    let runtime = runtime();
    let folder = tempfile::tempdir().expect("a folder");
    let link_path = folder.path().join("by-id");
    let (mut first, first_path) = pty();
    std::os::unix::fs::symlink(&first_path, &link_path).expect("a link");

    let (sink, mut events) = mpsc::channel(64);
    let task = spawn_port(runtime.handle(), PortConfig::new(DeviceKind::Carm, &link_path), sink);
    let mut link = Link::new(DeviceKind::Carm);
    let mut seen: Vec<(u32, u32)> = Vec::new();
    let mut stamps = Vec::new();
    let event = next(&mut events, &runtime);
    assert_eq!(opened(&event), Some(0));
    let PortEvent::Opened { resolved, path, .. } = event else { panic!("opened") };
    assert_eq!((resolved.as_path(), path.as_path()), (Path::new(&first_path), link_path.as_path()));

    let mut receive = |until: u32, events: &mut mpsc::Receiver<(DeviceKind, PortEvent)>| loop {
        let event = next(events, &runtime);
        if let PortEvent::Bytes { host_us, .. } = &event {
            stamps.push(*host_us);
        }
        link.handle(&event, &mut |received| {
            if let Event::Sample(sample, _) = received.event {
                seen.push((received.epoch, sample.sequence()));
            }
        });
        if seen.last().is_some_and(|(_, sequence)| *sequence == until) {
            break (seen.clone(), *link.health());
        }
    };
    for sequence in 0..50 {
        first.write_all(&plain(sequence)).expect("written");
    }
    let (seen_first, _) = receive(49, &mut events);
    assert_eq!(seen_first, (0..50).map(|sequence| (0, sequence)).collect::<Vec<_>>());

    // Unplugged; plugged in again it is another device file behind the same name.
    first.write_all(&plain(50)[..20]).expect("written");
    let (mut second, second_path) = pty();
    std::fs::remove_file(&link_path).expect("removed");
    std::os::unix::fs::symlink(&second_path, &link_path).expect("a link");
    drop(first);
    let mut lost = false;
    let epoch = loop {
        match next(&mut events, &runtime) {
            PortEvent::Lost { epoch: 0, .. } => lost = true,
            PortEvent::Opened { epoch, .. } => break epoch,
            PortEvent::Bytes { epoch: 0, .. } | PortEvent::Retry { .. } => {}
            other => panic!("unexpected {other:?}"),
        }
    };
    assert!(lost && epoch == 1);
    for sequence in 80..100 {
        second.write_all(&plain(sequence)).expect("written");
    }
    let (seen_all, health) = receive(99, &mut events);
    assert_eq!(seen_all[50..], (80..100).map(|sequence| (1, sequence)).collect::<Vec<_>>());
    assert_eq!((health.corrupt, health.lost, health.missed_unplugged, health.epochs), (0, 0, 30, 2));
    assert!(stamps.windows(2).all(|pair| pair[0] <= pair[1]), "arrival never runs back");
    drop(task);
}

#[test]
fn a_port_that_appears_later_is_opened_then() {
    let runtime = runtime();
    let folder = tempfile::tempdir().expect("a folder");
    let link_path = folder.path().join("late");
    let (sink, mut events) = mpsc::channel(64);
    let _task = spawn_port(runtime.handle(), PortConfig::new(DeviceKind::Robot, &link_path), sink);
    let PortEvent::Retry { error, attempt: 1, wait_ms: 50, .. } = next(&mut events, &runtime) else { panic!("a retry") };
    assert_eq!(error, PortError::NotFound { path: link_path.clone() });
    let PortEvent::Retry { attempt: 2, wait_ms: 100, .. } = next(&mut events, &runtime) else { panic!("a longer retry") };
    let (_master, path) = pty();
    std::os::unix::fs::symlink(&path, &link_path).expect("a link");
    loop {
        match next(&mut events, &runtime) {
            PortEvent::Retry { .. } => {}
            event => {
                assert_eq!(opened(&event), Some(0));
                break;
            }
        }
    }
}

/// The first thing that opening `path` leads to.
fn first_event(path: &Path) -> PortEvent {
    let runtime = runtime();
    let (sink, mut events) = mpsc::channel(4);
    let _task = spawn_port(runtime.handle(), PortConfig::new(DeviceKind::Carm, path), sink);
    next(&mut events, &runtime)
}

#[test]
fn what_cannot_be_opened_says_why() {
    let folder = tempfile::tempdir().expect("a folder");
    let missing = folder.path().join("missing");
    let file = folder.path().join("file");
    std::fs::write(&file, "no port").expect("written");
    let (_master, busy_path) = pty();
    let _holder = serialport::new(&busy_path, 921_600).open_native().expect("opens once");

    let mut cases = 0;
    for (path, wanted) in [(missing.as_path(), "not found"), (file.as_path(), "no port"), (Path::new(&busy_path), "busy")] {
        let PortEvent::Retry { error, .. } = first_event(path) else { panic!("{wanted}: it opened") };
        let kind = match &error {
            PortError::NotFound { .. } => "not found",
            PortError::NotAPort { .. } => "no port",
            PortError::Busy { .. } => "busy",
            other => panic!("{wanted}: {other}"),
        };
        assert_eq!(kind, wanted);
        assert!(error.to_string().contains(&*path.to_string_lossy()), "{error} names the path");
        assert!(!hint(&error).is_empty());
        cases += 1;
    }
    assert_eq!(cases, 3);
    // The control: a free port opens.
    let (_free, free_path) = pty();
    assert_eq!(opened(&first_event(Path::new(&free_path))), Some(0));
}

#[test]
fn a_full_receiver_slows_reading_down_and_loses_nothing() {
    let runtime = runtime();
    let (mut master, path) = pty();
    let (sink, mut events) = mpsc::channel(1);
    let task = spawn_port(runtime.handle(), PortConfig::new(DeviceKind::Carm, &path), sink);
    assert_eq!(opened(&next(&mut events, &runtime)), Some(0));
    let writer = std::thread::spawn(move || {
        for sequence in 0..200 {
            let frame = plain(sequence);
            let mut rest = &frame[..];
            // The kernel's buffer fills while nobody reads; a device that waits is patient.
            while !rest.is_empty() {
                match master.write(rest) {
                    Ok(count) => rest = &rest[count..],
                    Err(error) if error.kind() == std::io::ErrorKind::TimedOut => {}
                    Err(error) => panic!("{error}"),
                }
            }
        }
        master
    });
    while task.stalls() == 0 {
        std::thread::sleep(Duration::from_millis(5));
    }
    let mut link = Link::new(DeviceKind::Carm);
    let mut seen = Vec::new();
    while seen.last() != Some(&199) {
        let event = next(&mut events, &runtime);
        link.handle(&event, &mut |received| {
            if let Event::Sample(sample, _) = received.event {
                seen.push(sample.sequence());
            }
        });
    }
    assert_eq!(seen, (0..200).collect::<Vec<_>>());
    assert_eq!((link.health().lost, link.health().corrupt), (0, 0));
    assert_eq!(task.bytes(), link.health().bytes);
    drop(writer.join().expect("written"));
}

#[test]
fn a_recording_goes_the_same_way_as_a_port() {
    let script: Vec<(i64, u32, Vec<u8>)> =
        (0..40u32).map(|i| (1_000_000 + i64::from(i) * 33_333 + if i >= 20 { 2_000_000 } else { 0 }, i / 20, plain(i))).collect();
    let mut whole = Link::new(DeviceKind::Carm);
    let mut events = Vec::new();
    for (host_us, epoch, bytes) in script.clone() {
        whole.handle(&PortEvent::Bytes { host_us, epoch, bytes }, &mut |received| events.push(received));
    }
    assert_eq!(events.iter().filter(|received| matches!(received.event, Event::Sample(..))).count(), 40);
    let health = *whole.health();
    assert_eq!((health.stale, health.epochs, health.lost), (1, 2, 0));
    let mut again = Link::new(DeviceKind::Carm);
    let mut events_again = Vec::new();
    for (host_us, epoch, bytes) in &script {
        again.feed(*host_us, *epoch, bytes, &mut |received| events_again.push(received));
    }
    assert_eq!(events, events_again);
}
