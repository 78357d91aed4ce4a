//! The watched folder: half-written files wait, unreadable ones are said once, order is by name.

use std::path::Path;

use sidecarm::acquire::{FolderWatch, WatchEvent};
use sidecarm::time::host_now_us;

use crate::acquire_frames::{fluoroscopy, save};

fn frames(events: &[WatchEvent]) -> Vec<String> {
    events
        .iter()
        .filter_map(|event| match event {
            WatchEvent::Frame { frame, .. } => Some(frame.name.clone()),
            _ => None,
        })
        .collect()
}

fn unreadable(events: &[WatchEvent]) -> usize {
    events.iter().filter(|event| matches!(event, WatchEvent::Unreadable { .. })).count()
}

fn age(path: &Path, seconds: u64) {
    let file = std::fs::File::options().append(true).open(path).expect("file");
    let modified = file.metadata().expect("metadata").modified().expect("time of change");
    file.set_modified(modified - std::time::Duration::from_secs(seconds)).expect("time is set");
}

#[test]
fn frames_arrive_once_in_order_of_name_after_they_have_settled() {
    let folder = tempfile::tempdir().expect("folder");
    save(fluoroscopy(), &folder.path().join("old.dcm"));
    let mut watch = FolderWatch::new(folder.path(), None, false);
    let start = host_now_us();
    assert!(watch.poll(start).is_empty(), "what was there before is passed over");
    for name in ["b.dcm", "a.dcm", ".hidden.dcm", "c.dcm.part", "d.tmp"] {
        save(fluoroscopy(), &folder.path().join(name));
    }
    assert_eq!(watch.poll(start + 1).len(), 2, "two files wait");
    assert!(frames(&watch.poll(start + 50_000)).is_empty(), "too early");
    assert_eq!(frames(&watch.poll(start + 150_000)), ["a", "b"]);
    assert!(watch.poll(start + 300_000).is_empty(), "nothing comes twice");
    std::fs::rename(folder.path().join("c.dcm.part"), folder.path().join("c.dcm")).expect("renamed");
    watch.poll(start + 400_000);
    assert_eq!(frames(&watch.poll(start + 600_000)), ["c"]);
}

#[test]
fn existing_files_come_when_asked_for() {
    let folder = tempfile::tempdir().expect("folder");
    save(fluoroscopy(), &folder.path().join("old.dcm"));
    let mut watch = FolderWatch::new(folder.path(), None, true);
    let start = host_now_us();
    watch.poll(start);
    assert_eq!(frames(&watch.poll(start + 100_000)), ["old"]);
}

#[test]
fn a_half_written_file_waits_and_is_delivered_when_whole() {
    let folder = tempfile::tempdir().expect("folder");
    let source = tempfile::tempdir().expect("folder");
    let whole = std::fs::read(save(fluoroscopy(), &source.path().join("x.dcm"))).expect("bytes");
    let mut watch = FolderWatch::new(folder.path(), None, true);
    let start = host_now_us();
    let path = folder.path().join("x.dcm");
    std::fs::write(&path, &whole[..whole.len() - 5]).expect("half");
    watch.poll(start);
    let events = watch.poll(start + 200_000);
    assert!(frames(&events).is_empty() && unreadable(&events) == 0, "{events:?}");
    std::fs::write(&path, &whole).expect("whole");
    watch.poll(start + 400_000);
    assert_eq!(frames(&watch.poll(start + 600_000)), ["x"]);
}

#[test]
fn an_unreadable_file_is_said_once_and_stays() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("bad.dcm");
    std::fs::write(&path, b"this is no image at all").expect("file");
    let cut = save(fluoroscopy(), &folder.path().join("cut.dcm"));
    let bytes = std::fs::read(&cut).expect("bytes");
    std::fs::write(&cut, &bytes[..bytes.len() - 5]).expect("cut");
    age(&cut, 10);
    let mut watch = FolderWatch::new(folder.path(), None, true);
    let start = host_now_us();
    watch.poll(start);
    assert_eq!(unreadable(&watch.poll(start + 200_000)), 2, "an old cut file will not become whole");
    assert!(watch.poll(start + 400_000).is_empty(), "said once");
    assert!(path.exists() && cut.exists());
    std::fs::write(&cut, &bytes).expect("repaired");
    watch.poll(start + 600_000);
    assert_eq!(frames(&watch.poll(start + 800_000)), ["cut"], "a repaired file is tried again");
}

#[test]
fn a_folder_that_is_gone_is_said_once() {
    let folder = tempfile::tempdir().expect("folder");
    let below = folder.path().join("frames");
    let mut watch = FolderWatch::new(&below, None, true);
    let start = host_now_us();
    assert_eq!(unreadable(&watch.poll(start)), 1);
    assert!(watch.poll(start + 1).is_empty());
    std::fs::create_dir(&below).expect("folder");
    assert!(watch.poll(start + 2).is_empty());
}
