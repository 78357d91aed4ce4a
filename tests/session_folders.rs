//! Consoles that write a folder for each study, through `live`.
#![cfg(unix)]

use std::path::Path;
use std::time::Duration;

use sidecarm::acquire::{Arrival, FolderTree, FrameSource, Reading, Sighting, Trouble};
use sidecarm::foreign::ForeignReader;
use sidecarm::time::host_now_us;

use crate::acquire_watch::frame_bytes;
use crate::live_lab::{HANG_S, Live, Signal, copies, eventually, quiet_lab};

/// Frames in folders that were there, that came, and that went again: all are the session's, each once.
#[test]
fn what_comes_into_folders_below_is_read_where_the_session_says_so() {
    let Some((lab, frame, folder)) = quiet_lab("60") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, 4, &folder.path().join("copies"));
    let session = lab.session("session-tree.json", |session| session["frames"]["sub_folders"] = true.into());
    let there = lab.frames().join("there before");
    std::fs::create_dir(&there).expect("made");
    // What was there before the start is not the session's.
    std::fs::copy(&files[0], there.join("old.dcm")).expect("copied");
    let mut live = Live::start(&session, &folder.path().join("session"), &[]);
    let frames = |count: usize| {
        let all = eventually(HANG_S, || (live.heard().images == count).then_some(()));
        assert!(all.is_some(), "{} of {count} frames: {}", live.heard().images, live.stderr());
    };
    std::fs::copy(&files[0], there.join("frame.dcm")).expect("copied");
    frames(1);
    let deep = lab.frames().join("day").join("study").join("series");
    std::fs::create_dir_all(&deep).expect("made");
    std::fs::copy(&files[1], deep.join("frame.dcm")).expect("copied");
    frames(2);
    // Written elsewhere, then moved into place with its folder.
    let elsewhere = folder.path().join("export");
    std::fs::create_dir(&elsewhere).expect("made");
    std::fs::copy(&files[2], elsewhere.join("frame.dcm")).expect("copied");
    std::fs::rename(&elsewhere, lab.frames().join("day").join("export")).expect("moved");
    frames(3);
    std::fs::remove_dir_all(lab.frames().join("day")).expect("removed");
    std::thread::sleep(Duration::from_millis(700));
    std::fs::copy(&files[3], lab.frames().join("frame.dcm")).expect("copied");
    frames(4);
    live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stdout() + &live.stderr();
    assert!(live.lacks_exposures_alone(status.code()) && live.heard().frames.len() == 4, "{words}");
    // Folders may be named after patients.
    assert!(!words.contains("there before") && !live.report().contains("there before"), "{words}");
}

/// A tree that is looked at by hand.
struct Tree {
    source: FolderTree,
    now_us: i64,
    frames: usize,
    troubles: Vec<Trouble>,
    /// What was offered and is not read yet.
    offered: Vec<Arrival>,
}

impl Tree {
    fn new(root: &Path) -> Self {
        let source = FolderTree::new(root, None, false, ForeignReader::in_process());
        Self { source, now_us: host_now_us(), frames: 0, troubles: Vec::new(), offered: Vec::new() }
    }

    fn look(&mut self) {
        self.now_us += 250_000;
        for sighting in self.source.look(self.now_us) {
            match sighting {
                Sighting::Ready(arrival) => self.offered.push(arrival),
                Sighting::Trouble(trouble) => self.troubles.push(trouble),
                _ => {}
            }
        }
    }

    fn read(&mut self) {
        for arrival in self.offered.drain(..) {
            if let Reading::Frames { frames, .. } = arrival.read() {
                self.frames += frames.len();
            }
        }
    }

    fn settle(&mut self) {
        for _ in 0..8 {
            self.look();
            self.read();
        }
    }
}

/// All that a share held came again as new when it had been away for a moment.
#[test]
fn a_tree_that_is_away_for_a_moment_brings_nothing_twice() {
    let outside = tempfile::tempdir().expect("a folder");
    let (root, away) = (outside.path().join("root"), outside.path().join("away"));
    std::fs::create_dir_all(root.join("study")).expect("made");
    std::fs::write(root.join("study/old.dcm"), frame_bytes(1)).expect("written");
    let mut tree = Tree::new(&root);
    tree.settle();
    std::fs::write(root.join("study/new.dcm"), frame_bytes(2)).expect("written");
    tree.settle();
    assert_eq!(tree.frames, 1);
    std::fs::rename(&root, &away).expect("moved");
    // Away for longer than the system's notices take: one of them may come when the file has gone.
    tree.settle();
    std::thread::sleep(Duration::from_millis(100));
    tree.settle();
    std::fs::rename(&away, &root).expect("moved");
    tree.settle();
    assert_eq!((tree.frames, &tree.troubles[..]), (1, &[][..]));
    std::fs::write(root.join("study/newer.dcm"), frame_bytes(3)).expect("written");
    tree.settle();
    assert_eq!(tree.frames, 2, "the control");
}

/// Read before the share was away, while it was, or after it: a frame comes once.
#[test]
fn a_frame_that_is_being_read_while_its_tree_is_away_comes_once() {
    for read_while in ["away", "back"] {
        let outside = tempfile::tempdir().expect("a folder");
        let (root, away) = (outside.path().join("root"), outside.path().join("away"));
        std::fs::create_dir_all(root.join("study")).expect("made");
        let mut tree = Tree::new(&root);
        tree.settle();
        std::fs::write(root.join("study/new.dcm"), frame_bytes(2)).expect("written");
        (0..8).for_each(|_| tree.look());
        assert_eq!(tree.offered.len(), 1);
        std::fs::rename(&root, &away).expect("moved");
        (0..8).for_each(|_| tree.look());
        if read_while == "away" {
            tree.read();
            (0..8).for_each(|_| tree.look());
        }
        std::fs::rename(&away, &root).expect("moved");
        (0..8).for_each(|_| tree.look());
        tree.settle();
        assert_eq!((tree.frames, tree.source.is_expecting()), (1, false), "{read_while}: {:?}", tree.troubles);
    }
}

/// More folders than are watched: those that come are read all the same, and what comes into one that is not is a loss.
#[test]
fn of_many_folders_those_that_come_are_read_and_what_is_not_is_said() {
    let root = tempfile::tempdir().expect("a folder");
    (0..130).for_each(|n| std::fs::create_dir(root.path().join(format!("study-{n:03}"))).expect("made"));
    let mut tree = Tree::new(root.path());
    tree.settle();
    let today = root.path().join("today");
    std::fs::create_dir(&today).expect("made");
    std::fs::write(today.join("frame.dcm"), frame_bytes(2)).expect("written");
    tree.settle();
    assert_eq!((tree.frames, &tree.troubles[..]), (1, &[][..]));
    for n in 0..130 {
        std::fs::write(root.path().join(format!("study-{n:03}/frame.dcm")), frame_bytes(10 + n)).expect("written");
    }
    tree.settle();
    assert!(matches!(tree.troubles[..], [Trouble::TooManyFolders { .. }]), "{:?}", tree.troubles);
    assert_eq!(tree.frames, 101, "of those that were there a hundred are watched");
    // A link to a folder is none, and that is said.
    std::os::unix::fs::symlink(&today, root.path().join("link")).expect("linked");
    tree.settle();
    assert!(matches!(tree.troubles[..], [_, Trouble::SubFolder { .. }]), "{:?}", tree.troubles);
}
