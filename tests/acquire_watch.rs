//! The watched folder: what lies still is offered once, what changes again, what is lost is said.

use std::path::Path;

use sidecarm::acquire::{Arrival, Fault, FolderSource, FrameSource, Reading, Sighting, Trouble};
use sidecarm::foreign::{ForeignReader, NotRegular};
use sidecarm::time::host_now_us;

use crate::acquire_frames::{fluoroscopy, save};

/// A watched folder and what came of it.
pub struct Watched {
    pub folder: tempfile::TempDir,
    pub source: FolderSource,
    pub now_us: i64,
    pub frames: Vec<(String, String, Option<String>)>,
    /// Frames of which an earlier version was delivered unfinished.
    pub unfinished: Vec<String>,
    pub troubles: Vec<Trouble>,
    /// Those that turned out to be none.
    pub mended: Vec<Trouble>,
    pub refused: Vec<String>,
    pub other: Vec<String>,
}

impl Watched {
    pub fn new(include_existing: bool) -> Self {
        let folder = tempfile::tempdir().expect("folder");
        Self::of(folder, include_existing)
    }

    pub fn of(folder: tempfile::TempDir, include_existing: bool) -> Self {
        let source = FolderSource::new(folder.path(), None, include_existing, ForeignReader::in_process());
        let (frames, troubles, refused, other) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let (unfinished, mended) = (Vec::new(), Vec::new());
        Self { folder, source, now_us: host_now_us(), frames, unfinished, troubles, mended, refused, other }
    }

    pub fn path(&self, name: &str) -> std::path::PathBuf {
        self.folder.path().join(name)
    }

    pub fn look(&mut self, later_us: i64) -> Vec<Sighting> {
        self.now_us += later_us;
        self.source.look(self.now_us)
    }

    /// Looks and reads everything.
    pub fn step(&mut self, later_us: i64) {
        for sighting in self.look(later_us) {
            self.take(sighting);
        }
    }

    pub fn take(&mut self, sighting: Sighting) {
        match sighting {
            Sighting::Ready(arrival) => match self.read(arrival) {
                Reading::Frames { frames, earlier } => {
                    for frame in frames {
                        let before = earlier.as_ref().map(|earlier| earlier.sha256.clone());
                        self.unfinished
                            .extend(earlier.iter().filter(|earlier| earlier.was_unfinished).map(|_| frame.name.clone()));
                        self.frames.push((frame.name, frame.sha256, before));
                    }
                }
                Reading::Refused(error) => self.refused.push(error.to_string()),
                Reading::Same { .. } => self.other.push("same".into()),
                Reading::Later => {}
            },
            Sighting::Trouble(trouble) => self.troubles.push(trouble),
            Sighting::FolderLost { .. } => self.other.push("lost".into()),
            Sighting::Said { words, .. } => self.other.push(words),
            Sighting::FolderBack => self.other.push("back".into()),
        }
    }

    fn read(&mut self, arrival: Arrival) -> Reading {
        let (reading, mended) = arrival.read_and_mend();
        self.mended.extend(mended);
        reading
    }

    /// Steps until nothing more can come of what is there.
    pub fn settle(&mut self) {
        for _ in 0..6 {
            self.step(120_000);
        }
    }

    /// Steps until what has not become whole is given up.
    pub fn outlast(&mut self) {
        for _ in 0..40 {
            self.step(300_000);
        }
    }

    /// Names of the frames that came, in alphabetical order.
    fn sorted(&self) -> Vec<&str> {
        let mut names = self.names();
        names.sort_unstable();
        names
    }

    pub fn names(&self) -> Vec<&str> {
        self.frames.iter().map(|(name, _, _)| name.as_str()).collect()
    }
}

/// A fluoroscopy frame whose first pixel is `first`.
pub fn frame_bytes(first: u16) -> Vec<u8> {
    use dicom_core::{DataElement, PrimitiveValue, VR};
    let folder = tempfile::tempdir().expect("folder");
    let mut object = fluoroscopy();
    let values: Vec<u16> = vec![first, 100, 200, 300, 400, 500, 600, 4095];
    object.put(DataElement::new(dicom_dictionary_std::tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    std::fs::read(save(object, &folder.path().join("x.dcm"))).expect("bytes")
}

pub fn age(path: &Path, seconds: u64) {
    let file = std::fs::File::options().append(true).open(path).expect("file");
    let modified = file.metadata().expect("metadata").modified().expect("time of change");
    file.set_modified(modified - std::time::Duration::from_secs(seconds)).expect("time is set");
}

#[test]
fn frames_arrive_once_after_they_have_settled() {
    let folder = tempfile::tempdir().expect("folder");
    save(fluoroscopy(), &folder.path().join("old.dcm"));
    let mut watched = Watched::of(folder, false);
    watched.settle();
    assert!(watched.frames.is_empty(), "what was there before is passed over");
    for name in ["b.dcm", "a.dcm", ".hidden.dcm", "c.dcm.part", "d.tmp"] {
        std::fs::write(watched.path(name), frame_bytes(name.len() as u16)).expect("written");
    }
    assert!(watched.look(1).is_empty() && watched.look(50_000).is_empty(), "too early");
    watched.step(60_000);
    // The clock of a disk may tick between two files: which comes first is not asked.
    assert_eq!(watched.sorted(), ["a", "b"]);
    watched.settle();
    std::fs::rename(watched.path("c.dcm.part"), watched.path("c.dcm")).expect("renamed");
    watched.settle();
    assert_eq!(watched.sorted(), ["a", "b", "c"], "nothing comes twice");
    std::fs::rename(watched.path("c.dcm"), watched.path("x.dcm")).expect("renamed");
    watched.settle();
    assert_eq!(watched.sorted(), ["a", "b", "c"], "another name makes no other frame");
    assert!(watched.troubles.is_empty() && watched.refused.is_empty(), "{:?}", watched.troubles);
}

/// A session takes seconds to start; what is exported meanwhile is its own.
#[test]
fn what_comes_between_the_beginning_and_the_first_look_is_new() {
    let folder = tempfile::tempdir().expect("folder");
    for (name, content) in [("old.dcm", 1), ("b.dcm", 2)] {
        std::fs::write(folder.path().join(name), frame_bytes(content)).expect("written");
    }
    let mut watched = Watched::of(folder, false);
    std::fs::write(watched.path("new.dcm"), frame_bytes(3)).expect("written");
    std::fs::remove_file(watched.path("b.dcm")).expect("removed");
    std::fs::write(watched.path("b.dcm"), frame_bytes(4)).expect("written");
    watched.settle();
    assert_eq!(watched.sorted(), ["b", "new"]);
    assert!(watched.troubles.is_empty() && watched.refused.is_empty(), "{:?}", watched.troubles);
}

#[test]
fn existing_files_come_when_asked_for() {
    let folder = tempfile::tempdir().expect("folder");
    save(fluoroscopy(), &folder.path().join("old.dcm"));
    let mut watched = Watched::of(folder, true);
    watched.settle();
    assert_eq!(watched.names(), ["old"]);
}

/// Names were keys: `latest.dcm` written three times gave one frame, and two were lost without a word.
#[test]
fn a_rewritten_name_is_a_new_frame_each_time() {
    let mut watched = Watched::new(true);
    for version in 0..3u16 {
        std::fs::write(watched.path("latest.dcm"), frame_bytes(version)).expect("written");
        watched.settle();
    }
    assert_eq!(watched.names(), ["latest", "latest", "latest"]);
    let hashes: Vec<_> = watched.frames.iter().map(|(_, sha256, _)| sha256.clone()).collect();
    assert!(hashes[0] != hashes[1] && hashes[1] != hashes[2]);
    let earlier: Vec<_> = watched.frames.iter().map(|(_, _, earlier)| earlier.clone()).collect();
    assert_eq!(earlier, [None, Some(hashes[0].clone()), Some(hashes[1].clone())]);
    // The same content written again is no new exposure.
    std::fs::write(watched.path("latest.dcm"), frame_bytes(2)).expect("written");
    watched.settle();
    assert_eq!((watched.frames.len(), watched.other.as_slice()), (3, ["same".to_owned()].as_slice()));
    // Replaced through a rename with an older time of change: size and time may repeat, the inode does not.
    let beside = watched.path("beside.part");
    std::fs::write(&beside, frame_bytes(7)).expect("written");
    age(&beside, 3600);
    std::fs::rename(beside, watched.path("latest.dcm")).expect("renamed");
    watched.settle();
    assert_eq!(watched.frames.len(), 4);
    assert!(watched.troubles.is_empty(), "{:?}", watched.troubles);
}

#[test]
fn a_version_that_is_overwritten_before_it_is_read_is_said() {
    let mut watched = Watched::new(true);
    std::fs::write(watched.path("latest.dcm"), frame_bytes(1)).expect("written");
    // The system's notice that the writer has closed it may come after the one that it writes: time for it.
    let mut offered = Vec::new();
    for _ in 0..200 {
        offered.extend(watched.look(150_000));
        if !offered.is_empty() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
    assert_eq!(offered.len(), 1);
    std::thread::sleep(std::time::Duration::from_millis(20));
    std::fs::write(watched.path("latest.dcm"), frame_bytes(2)).expect("written");
    watched.take(offered.remove(0));
    watched.settle();
    assert_eq!(watched.frames.len(), 1, "only the second version is there");
    assert_eq!(watched.troubles, [Trouble::Overwritten { label: "latest".into() }]);
}

#[cfg(target_os = "linux")]
#[test]
fn versions_renamed_into_place_one_after_the_other_are_all_read() {
    let mut watched = Watched::new(true);
    watched.settle();
    for version in 0..3u16 {
        std::fs::write(watched.path("beside.part"), frame_bytes(version)).expect("written");
        std::fs::rename(watched.path("beside.part"), watched.path("latest.dcm")).expect("renamed");
        // Time for the system's notice; the folder itself is not looked at.
        std::thread::sleep(std::time::Duration::from_millis(60));
    }
    watched.settle();
    assert_eq!(watched.frames.len(), 3, "{:?} {:?}", watched.frames, watched.troubles);
}

/// A writer gives each file its name when it is whole: nothing vanishes with the name before.
#[cfg(target_os = "linux")]
#[test]
fn a_file_that_is_renamed_at_once_has_not_vanished() {
    let mut watched = Watched::new(true);
    watched.settle();
    for index in 0..100u16 {
        let name = format!("frame-{index:03}.dcm");
        let writing = watched.path(&format!("{name}.writing"));
        std::fs::write(&writing, frame_bytes(index)).expect("written");
        std::fs::rename(writing, watched.path(&name)).expect("renamed");
    }
    // Time for the system's notices; the folder itself is not looked at.
    std::thread::sleep(std::time::Duration::from_millis(200));
    watched.settle();
    // Renaming touches a file: one that was read before is looked at again, and is the same.
    let is_same = watched.other.iter().all(|other| other == "same");
    assert!(watched.troubles.is_empty() && is_same, "{:?} {:?}", watched.troubles, watched.other);
    assert_eq!(watched.frames.len(), 100, "each once");
}

/// Frames deleted within 300 ms: 23 of 30 were gone without an event.
#[cfg(target_os = "linux")]
#[test]
fn a_file_that_is_deleted_at_once_is_read_all_the_same() {
    let mut watched = Watched::new(true);
    watched.settle();
    for index in 0..30u16 {
        let path = watched.path(&format!("frame-{index:03}.dcm"));
        std::fs::write(&path, frame_bytes(index)).expect("written");
        std::thread::sleep(std::time::Duration::from_millis(u64::from(index % 10) * 3 + 20));
        std::fs::remove_file(&path).expect("deleted");
        watched.step(50_000);
    }
    watched.settle();
    let vanished = watched.troubles.iter().filter(|trouble| matches!(trouble, Trouble::Vanished { .. })).count();
    println!("{} of 30 read, {vanished} said to have vanished", watched.frames.len());
    assert_eq!(watched.frames.len() + vanished, 30, "none goes without a word: {:?}", watched.troubles);
    assert!(watched.frames.len() >= 20, "{} of 30 read", watched.frames.len());
}

#[test]
fn a_file_that_is_deleted_before_it_was_whole_is_said() {
    let mut watched = Watched::new(true);
    let whole = frame_bytes(1);
    std::fs::write(watched.path("x.dcm"), &whole[..whole.len() - 5]).expect("half");
    watched.settle();
    std::fs::remove_file(watched.path("x.dcm")).expect("deleted");
    watched.settle();
    assert!(watched.frames.is_empty());
    assert_eq!(watched.troubles, [Trouble::Vanished { label: "x".into() }]);
}

#[test]
fn an_unreadable_file_is_said_once_and_stays() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("bad.dcm");
    std::fs::write(&path, b"this is no image at all").expect("file");
    let cut = folder.path().join("cut.dcm");
    let bytes = frame_bytes(3);
    std::fs::write(&cut, &bytes[..bytes.len() - 5]).expect("cut");
    let mut watched = Watched::of(folder, true);
    watched.outlast();
    assert_eq!(watched.refused.len(), 1, "{:?}", watched.refused);
    assert!(watched.refused[0].starts_with("bad: found something else"), "{:?}", watched.refused);
    let unfinished =
        |trouble: &Trouble| matches!(trouble, Trouble::Unfinished { fault: Fault::PixelBytes { .. } | Fault::Dicom { .. }, .. });
    assert!(watched.troubles.len() == 1 && unfinished(&watched.troubles[0]), "an old cut file: {:?}", watched.troubles);
    assert!(path.exists() && cut.exists());
    std::fs::write(&cut, &bytes).expect("repaired");
    watched.settle();
    assert_eq!(watched.names(), ["cut"], "a repaired file is tried again");
}

#[cfg(unix)]
#[test]
fn what_is_no_file_is_said_once_and_never_opened() {
    let mut watched = Watched::new(true);
    let made = std::process::Command::new("mkfifo").arg(watched.path("run.dcm")).status().expect("mkfifo is there");
    assert!(made.success());
    let _socket = std::os::unix::net::UnixListener::bind(watched.path("live.dcm")).expect("socket");
    std::os::unix::fs::symlink("/dev/zero", watched.path("test.png")).expect("link");
    std::os::unix::fs::symlink("nowhere", watched.path("old.png")).expect("link");
    std::fs::create_dir(watched.path("new.tif")).expect("folder");
    std::fs::create_dir(watched.path("series")).expect("an ordinary folder");
    watched.settle();
    let mut kinds: Vec<NotRegular> = watched
        .troubles
        .iter()
        .map(|trouble| match trouble {
            Trouble::NotAFile { kind, .. } => *kind,
            other => panic!("{other:?}"),
        })
        .collect();
    kinds.sort_by_key(|kind| kind.words());
    let mut expected = [NotRegular::Device, NotRegular::Folder, NotRegular::Fifo, NotRegular::Socket, NotRegular::Other];
    expected.sort_by_key(|kind| kind.words());
    assert_eq!(kinds, expected);
    assert!(watched.frames.is_empty() && watched.refused.is_empty());
}

#[test]
fn what_comes_into_a_folder_below_is_said_once() {
    let mut watched = Watched::new(true);
    std::fs::create_dir(watched.path("yesterday")).expect("folder");
    std::fs::write(watched.path("yesterday/a.dcm"), b"old").expect("file");
    watched.settle();
    std::fs::create_dir(watched.path("empty")).expect("folder");
    std::fs::create_dir_all(watched.path("@eaDir/thumbnail")).expect("a file server's own");
    watched.settle();
    assert!(watched.troubles.is_empty(), "what was there, and what is empty: {:?}", watched.troubles);
    std::fs::create_dir_all(watched.path("2026/run")).expect("folder");
    std::fs::write(watched.path("yesterday/b.dcm"), b"new").expect("file");
    watched.settle();
    std::fs::write(watched.path("yesterday/c.dcm"), b"new").expect("file");
    watched.settle();
    assert_eq!(watched.troubles.len(), 2, "once a folder: {:?}", watched.troubles);
    assert!(watched.troubles.iter().all(|trouble| matches!(trouble, Trouble::SubFolder { .. })), "{:?}", watched.troubles);
    assert!(!watched.troubles.iter().any(|trouble| trouble.to_string().contains("yesterday")), "names are labels");
}

#[test]
fn a_folder_that_is_gone_is_said_once_and_so_is_its_return() {
    let folder = tempfile::tempdir().expect("folder");
    let below = folder.path().join("frames");
    let mut source = FolderSource::new(&below, None, true, ForeignReader::in_process());
    let start = host_now_us();
    assert!(matches!(source.look(start).as_slice(), [Sighting::FolderLost { .. }]));
    assert!(source.look(start + 1).is_empty());
    std::fs::create_dir(&below).expect("folder");
    assert!(matches!(source.look(start + 2).as_slice(), [Sighting::FolderBack]));
    assert!(source.look(start + 3).is_empty());
}

/// `.f6.dcm` was never read, and nobody said a word but that exposure 6 has no frame.
#[test]
fn a_picture_that_stays_under_a_hidden_name_is_said_once_and_taken_back_when_it_gets_another() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join(".old.dcm"), frame_bytes(1)).expect("written");
    let mut watched = Watched::of(folder, false);
    watched.settle();
    // What is no picture, and what other programs leave everywhere, is nobody's frame.
    std::fs::write(watched.path(".DS_Store"), [b'x'; 4096]).expect("written");
    std::fs::write(watched.path("a.json.part"), b"{}").expect("written");
    std::fs::write(watched.path(".frame 6.dcm"), frame_bytes(6)).expect("written");
    std::fs::write(watched.path(".Quaxwelk.dcm.Ab12Cd"), frame_bytes(7)).expect("written");
    for _ in 0..19 {
        watched.step(500_000);
    }
    assert!(watched.troubles.is_empty(), "a copy may take that long: {:?}", watched.troubles);
    for _ in 0..5 {
        watched.step(500_000);
    }
    let hidden = |trouble: &Trouble| matches!(trouble, Trouble::Hidden { .. });
    assert!(watched.troubles.len() == 2 && watched.troubles.iter().all(hidden), "{:?}", watched.troubles);
    let words: String = watched.troubles.iter().map(ToString::to_string).collect();
    assert!(words.contains(".frame 6") && words.contains("file-") && !words.contains("Quaxwelk"), "{words}");
    std::fs::write(watched.path(".frame 6.dcm"), frame_bytes(8)).expect("written again");
    for _ in 0..25 {
        watched.step(500_000);
    }
    assert_eq!(watched.troubles.len(), 2, "once a name: {:?}", watched.troubles);
    std::fs::rename(watched.path(".Quaxwelk.dcm.Ab12Cd"), watched.path("frame 7.dcm")).expect("renamed");
    watched.settle();
    assert_eq!((watched.names(), watched.mended.len()), (vec!["frame 7"], 1), "{:?}", watched.troubles);
    assert!(watched.mended[0].mended().contains("not lost") && watched.troubles.contains(&watched.mended[0]));
}

/// The folder was moved away and another made in its place: what the console wrote on into the one before was lost, and the session ended
/// with 0.
#[cfg(unix)]
#[test]
fn another_folder_in_the_place_of_the_watched_one_is_said() {
    let home = tempfile::tempdir().expect("folder");
    let (below, beside) = (home.path().join("frames"), home.path().join("frames.old"));
    std::fs::create_dir(&below).expect("folder");
    let mut source = FolderSource::new(&below, None, true, ForeignReader::in_process());
    let start = host_now_us();
    let said = |sightings: Vec<Sighting>| -> Vec<String> {
        let words = |sighting| match sighting {
            Sighting::Said { words, .. } => words,
            other => format!("{other:?}"),
        };
        sightings.into_iter().map(words).collect()
    };
    assert!(said(source.look(start)).is_empty());
    // Away for a moment, and back.
    std::fs::rename(&below, &beside).expect("renamed");
    assert!(matches!(source.look(start + 1).as_slice(), [Sighting::FolderLost { .. }]));
    std::fs::rename(&beside, &below).expect("renamed");
    assert!(matches!(source.look(start + 2).as_slice(), [Sighting::FolderBack]));
    // Another one, with and without having been missed.
    std::fs::rename(&below, &beside).expect("renamed");
    std::fs::create_dir(&below).expect("folder");
    let found = said(source.look(start + 3));
    assert!(found.len() == 1 && found[0].contains("another one than before"), "{found:?}");
    assert!(said(source.look(start + 4)).is_empty(), "said once");
    std::fs::rename(&below, home.path().join("frames.older")).expect("renamed");
    assert!(matches!(source.look(start + 5).as_slice(), [Sighting::FolderLost { .. }]));
    std::fs::create_dir(&below).expect("folder");
    let found = said(source.look(start + 6));
    assert!(found.len() == 2 && found[1].contains("another one than before"), "{found:?}");
}

#[test]
fn a_burst_is_seen_at_once_and_read_in_any_order() {
    let mut watched = Watched::new(true);
    for index in 0..500u16 {
        std::fs::write(watched.path(&format!("frame-{index:03}.dcm")), frame_bytes(index)).expect("written");
    }
    std::thread::sleep(std::time::Duration::from_millis(200));
    watched.look(1);
    let mut offered = watched.look(150_000);
    assert_eq!(offered.len(), 500, "all at once");
    offered.reverse();
    let last = offered.pop();
    offered.into_iter().for_each(|sighting| watched.take(sighting));
    assert_eq!(watched.frames.len(), 499);
    assert_eq!(watched.names()[0], "frame-499");
    drop(last);
    watched.settle();
    assert_eq!(watched.frames.len(), 500, "what was dropped unread is offered again");
    assert!(watched.troubles.is_empty());
}
