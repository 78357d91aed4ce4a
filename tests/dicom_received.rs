//! Frames over DICOM: a sender of its own through a real socket, into a session and into a watched folder.

#![cfg(unix)]

use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::path::Path;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::InMemDicomObject;
use dicom_transfer_syntax_registry::{TransferSyntaxIndex, TransferSyntaxRegistry};
use dicom_ul::association::client::ClientAssociation;
use dicom_ul::pdu::{AssociationRJServiceUserReason, AssociationRJSource, PDataValue, PDataValueType, Pdu};
use dicom_ul::{ClientAssociationOptions, association};
use serde_json::json;
use sidecarm::acquire::{
    FolderSource, Frame, FrameSource, MOST_ASSOCIATIONS, Reading, ReceivedSource, ReceiverOptions, Sighting,
};
use sidecarm::foreign::ForeignReader;
use sidecarm::time::host_now_us;

use crate::acquire_frames::fluoroscopy;
use crate::acquire_identity::{hits, written};
use crate::acquire_live::Room;
use crate::live_lab::{HANG_S, eventually};

const XA: &str = uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE;
const LOOPBACK: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// An element of a command, implicit VR.
fn element(number: u16, value: &[u8]) -> Vec<u8> {
    let padded = [value, &[0][..value.len() % 2]].concat();
    [&[0, 0][..], &number.to_le_bytes(), &(padded.len() as u32).to_le_bytes(), &padded].concat()
}

fn store_request(class: &str, instance: &str) -> Vec<u8> {
    let parts = [
        element(0x0002, class.as_bytes()),
        element(0x0100, &[1, 0]),
        element(0x0110, &[7, 0]),
        element(0x0700, &[0, 0]),
        element(0x0800, &[0, 0]),
        element(0x1000, instance.as_bytes()),
    ];
    let body = parts.concat();
    [element(0, &(body.len() as u32).to_le_bytes()), body].concat()
}

fn echo_request() -> Vec<u8> {
    let class = element(0x0002, uids::VERIFICATION.as_bytes());
    [class, element(0x0100, &[0x30, 0]), element(0x0110, &[1, 0]), element(0x0800, &[1, 1])].concat()
}

/// Status and message of a response.
fn response(bytes: &[u8]) -> (u16, u16) {
    let (mut rest, mut found) = (bytes, (u16::MAX, u16::MAX));
    while rest.len() >= 8 {
        let length = u32::from_le_bytes([rest[4], rest[5], rest[6], rest[7]]) as usize;
        let number = || u16::from_le_bytes([rest[8], rest[9]]);
        match u16::from_le_bytes([rest[2], rest[3]]) {
            0x0900 => found.0 = number(),
            0x0120 => found.1 = number(),
            _ => {}
        }
        rest = &rest[8 + length..];
    }
    found
}

struct Sender {
    association: ClientAssociation<TcpStream>,
}

impl Sender {
    fn associate(address: SocketAddr, called: &str, class: &str, syntax: &str) -> Result<Self, association::Error> {
        let options = ClientAssociationOptions::new()
            .calling_ae_title("ARM")
            .called_ae_title(called.to_owned())
            .with_presentation_context(class.to_owned(), vec![syntax.to_owned()])
            .with_presentation_context(uids::VERIFICATION.to_owned(), vec![uids::IMPLICIT_VR_LITTLE_ENDIAN.to_owned()]);
        options.establish(address).map(|association| Self { association })
    }

    fn open(address: SocketAddr) -> Self {
        Self::associate(address, "SIDECARM", XA, uids::EXPLICIT_VR_LITTLE_ENDIAN).expect("welcome")
    }

    fn fragment(&mut self, context: u8, value_type: PDataValueType, is_last: bool, data: &[u8]) {
        let value = PDataValue { presentation_context_id: context, value_type, is_last, data: data.to_vec() };
        self.association.send(&Pdu::PData { data: vec![value] }).expect("sent");
    }

    fn answer(&mut self) -> (u16, u16) {
        match self.association.receive().expect("an answer") {
            Pdu::PData { data } => response(&data[0].data),
            other => panic!("{other:?}"),
        }
    }

    /// Sends an object in pieces; the status that comes back.
    fn store(&mut self, class: &str, instance: &str, data: &[u8]) -> u16 {
        self.fragment(1, PDataValueType::Command, true, &store_request(class, instance));
        let pieces: Vec<&[u8]> = data.chunks(100).collect();
        for (index, piece) in pieces.iter().enumerate() {
            self.fragment(1, PDataValueType::Data, index + 1 == pieces.len(), piece);
        }
        let (status, message) = self.answer();
        assert_eq!(message, 7, "the answer to this request");
        status
    }
}

/// The bytes of a data set.
fn bytes_of(object: &InMemDicomObject, syntax: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    let syntax = TransferSyntaxRegistry.get(syntax).expect("known");
    object.write_dataset_with_ts(&mut bytes, syntax).expect("written");
    bytes
}

fn object(instance: &str, first: u16) -> InMemDicomObject {
    let mut object = fluoroscopy();
    object.put(DataElement::new(tags::SOP_INSTANCE_UID, VR::UI, PrimitiveValue::from(instance)));
    let values: Vec<u16> = vec![first, 100, 200, 300, 400, 500, 600, 4095];
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    object
}

fn open(folder: &Path, calling: &[&str]) -> ReceivedSource {
    let watched = FolderSource::new(folder, None, false, ForeignReader::in_process());
    let calling_ae_titles = calling.iter().map(|title| (*title).to_owned()).collect();
    let options = ReceiverOptions { address: LOOPBACK, ae_title: "SIDECARM".to_owned(), calling_ae_titles };
    ReceivedSource::open(Box::new(watched), folder, options).expect("a free port")
}

/// What a source has seen: frames, and what was said.
#[derive(Default)]
struct Seen {
    frames: Vec<Frame>,
    said: Vec<(&'static str, String)>,
}

impl Seen {
    fn look(&mut self, source: &mut ReceivedSource) {
        for sighting in source.look(host_now_us()) {
            match sighting {
                Sighting::Ready(arrival) => match arrival.read() {
                    Reading::Frames { frames, .. } => self.frames.extend(frames),
                    Reading::Later => {}
                    other => panic!("{other:?}"),
                },
                Sighting::Trouble(trouble) => self.said.push((trouble.kind(), trouble.to_string())),
                Sighting::Said { kind, words } => self.said.push((kind, words)),
                other => panic!("{other:?}"),
            }
        }
    }

    fn until(&mut self, source: &mut ReceivedSource, what: &str, fact: impl Fn(&Self) -> bool) {
        let seen = eventually(60.0, || {
            self.look(source);
            fact(self).then_some(())
        });
        assert!(seen.is_some(), "{what}: {} frames, {:?}", self.frames.len(), self.said);
    }
}

#[test]
fn what_a_sender_stores_becomes_frames_in_its_order() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut source, mut seen) = (open(folder.path(), &[]), Seen::default());
    let mut sender = Sender::open(source.address());
    sender.fragment(3, PDataValueType::Command, true, &echo_request());
    assert_eq!(sender.answer(), (0, 1), "C-ECHO");
    for first in 1..=3u16 {
        let instance = format!("2.25.{first}");
        let status = sender.store(XA, &instance, &bytes_of(&object(&instance, first), uids::EXPLICIT_VR_LITTLE_ENDIAN));
        assert_eq!(status, 0);
        let file = folder.path().join(format!("dicom-{first:04}.dcm"));
        assert!(file.exists(), "success is told when it lies in the folder");
    }
    // The same again, as after an answer that was lost; then as implicit VR over an association of its own.
    let again = bytes_of(&object("2.25.3", 3), uids::EXPLICIT_VR_LITTLE_ENDIAN);
    assert_eq!(sender.store(XA, "2.25.3", &again), 0);
    sender.association.release().expect("released");
    let mut implicit = Sender::associate(source.address(), "SIDECARM", XA, uids::IMPLICIT_VR_LITTLE_ENDIAN).expect("welcome");
    assert_eq!(implicit.store(XA, "2.25.4", &bytes_of(&object("2.25.4", 4), uids::IMPLICIT_VR_LITTLE_ENDIAN)), 0);
    seen.until(&mut source, "four frames", |seen| seen.frames.len() >= 4);
    let firsts: Vec<f32> = seen.frames.iter().map(|frame| frame.pixels.pixels[0]).collect();
    assert_eq!(firsts, [1.0, 2.0, 3.0, 4.0]);
    assert!(seen.said.iter().all(|(kind, _)| *kind == "DICOM object again") && seen.said.len() == 1, "{:?}", seen.said);
    // Class of the request and class that was agreed on are not the same.
    assert_eq!(implicit.store(uids::CT_IMAGE_STORAGE, "2.25.5", &again), 0x0122);
    assert_eq!(implicit.store(XA, "2.25.6/../x", &again), 0xc000);
    // A folder that is gone.
    std::fs::remove_dir_all(folder.path()).expect("removed");
    assert_eq!(implicit.store(XA, "2.25.7", &again), 0xa700);
    let said = eventually(20.0, || {
        let heard = source.look(host_now_us());
        heard
            .iter()
            .any(|sighting| matches!(sighting, Sighting::Trouble(trouble) if trouble.kind() == "DICOM object not taken"))
            .then_some(())
    });
    assert!(said.is_some());
}

#[test]
fn who_is_not_meant_is_refused_with_the_reason() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut source, mut seen) = (open(folder.path(), &["ARM"]), Seen::default());
    let reason = |outcome: Result<Sender, association::Error>| match outcome.err().expect("refused") {
        association::Error::Rejected { association_rj, .. } => association_rj.source,
        other => panic!("{other}"),
    };
    let called = Sender::associate(source.address(), "OTHER", XA, uids::EXPLICIT_VR_LITTLE_ENDIAN);
    assert_eq!(reason(called), AssociationRJSource::ServiceUser(AssociationRJServiceUserReason::CalledAETitleNotRecognized));
    let mut strict = open(folder.path(), &["ARM-2"]);
    let calling = Sender::associate(strict.address(), "SIDECARM", XA, uids::EXPLICIT_VR_LITTLE_ENDIAN);
    assert_eq!(reason(calling), AssociationRJSource::ServiceUser(AssociationRJServiceUserReason::CallingAETitleNotRecognized));
    strict.close();
    seen.until(&mut source, "a refusal", |seen| seen.said.iter().any(|(_, words)| words.contains("OTHER")));
    // A class or a transfer syntax that nobody reads has no context.
    for (class, syntax) in [(uids::CT_IMAGE_STORAGE, uids::EXPLICIT_VR_LITTLE_ENDIAN), (XA, uids::JPEG2000_LOSSLESS)] {
        let sender = Sender::associate(source.address(), "SIDECARM", class, syntax).expect("verification is agreed on");
        let agreed = sender.association.presentation_contexts();
        assert!(agreed.iter().all(|context| context.abstract_syntax == uids::VERIFICATION), "{agreed:?}");
        if class == XA {
            seen.until(&mut source, "why it will not send", |seen| seen.said.iter().any(|(_, words)| words.contains(class)));
        }
    }
    // A sender that takes no notice of it was told Success, and its object was kept under a syntax that it was not written in.
    let mut heedless =
        Sender::associate(source.address(), "SIDECARM", XA, uids::JPEG2000_LOSSLESS).expect("verification is agreed on");
    heedless.fragment(1, PDataValueType::Command, true, &store_request(XA, "2.25.4"));
    let answer = heedless.association.receive();
    assert!(!matches!(answer, Ok(Pdu::PData { .. })), "{answer:?}");
    assert_eq!(written(folder.path()).len(), 0);
    // More at one time than there is room for.
    let mut there: Vec<Sender> = Vec::new();
    let full = eventually(20.0, || match Sender::associate(source.address(), "SIDECARM", XA, uids::EXPLICIT_VR_LITTLE_ENDIAN) {
        Ok(sender) => {
            there.push(sender);
            assert!(there.len() <= MOST_ASSOCIATIONS);
            None
        }
        Err(association::Error::Rejected { association_rj, .. }) => Some(association_rj),
        Err(other) => panic!("{other}"),
    });
    assert!(matches!(full.expect("refused").source, AssociationRJSource::ServiceProviderPresentation(_)));
}

/// dcmtk's own sender, which offers every class that there is.
#[test]
fn storescu_of_dcmtk_stores() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut source, mut seen) = (open(folder.path(), &[]), Seen::default());
    let outside = tempfile::tempdir().expect("a folder");
    let files = [1u16, 2].map(|n| {
        let path = outside.path().join(format!("{n}.dcm"));
        let meta = dicom_object::FileMetaTableBuilder::new()
            .transfer_syntax(uids::EXPLICIT_VR_LITTLE_ENDIAN)
            .media_storage_sop_class_uid(XA)
            .media_storage_sop_instance_uid(format!("2.25.7{n}"));
        object(&format!("2.25.7{n}"), n).with_meta(meta).expect("meta").write_to_file(&path).expect("written");
        path
    });
    let port = source.address().port().to_string();
    let store = |title: &str| {
        let mut command = std::process::Command::new("storescu");
        command.args(["-aet", "ARM", "-aec", title, "127.0.0.1", &port]).args(&files).output()
    };
    let Ok(sent) = store("SIDECARM") else {
        println!("skipped: storescu of dcmtk is not installed");
        return;
    };
    assert!(sent.status.success(), "{}", String::from_utf8_lossy(&sent.stderr));
    seen.until(&mut source, "two frames", |seen| seen.frames.len() == 2);
    assert!(seen.said.is_empty(), "{:?}", seen.said);
    assert!(!store("OTHER").expect("it is there").status.success(), "the control: another AE title");
}

#[test]
fn half_an_object_and_garbage_leave_nothing_behind() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut source, mut seen) = (open(folder.path(), &[]), Seen::default());
    let bytes = bytes_of(&object("2.25.9", 9), uids::EXPLICIT_VR_LITTLE_ENDIAN);
    let mut sender = Sender::open(source.address());
    sender.fragment(1, PDataValueType::Command, true, &store_request(XA, "2.25.9"));
    sender.fragment(1, PDataValueType::Data, false, &bytes[..120]);
    // The line is cut: no release, no abort.
    drop(sender);
    seen.until(&mut source, "half an object", |seen| !seen.said.is_empty());
    assert!(seen.said[0].0 == "half a DICOM object" && seen.said[0].1.contains("120 bytes"), "{:?}", seen.said);
    let mut stream = TcpStream::connect(source.address()).expect("somebody listens");
    std::io::Write::write_all(&mut stream, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n").expect("sent");
    seen.until(&mut source, "garbage", |seen| seen.said.iter().any(|(kind, _)| *kind == "DICOM garbage"));
    assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 0, "nothing is left in the folder");
    // It is sent once more, whole.
    assert_eq!(Sender::open(source.address()).store(XA, "2.25.9", &bytes), 0);
    seen.until(&mut source, "the whole object", |seen| seen.frames.len() == 1);
    assert_eq!(seen.said.len(), 2, "{:?}", seen.said);
}

#[test]
fn a_session_takes_frames_from_a_folder_and_over_dicom_and_keeps_names_to_itself() {
    let room = Room::new("frames");
    let port = TcpListener::bind(LOOPBACK).and_then(|listener| listener.local_addr()).expect("a free port").port();
    let session = json!({"frames": {"folder": room.frames, "dicom": {"port": port}}, "scene": "scene.json"});
    std::fs::write(room.folder.path().join("session.json"), session.to_string()).expect("written");
    let child = room.start(8.0);
    let address = SocketAddr::new(LOOPBACK.ip(), port);
    assert!(eventually(HANG_S, || TcpStream::connect(address).ok()).is_some(), "it listens");
    crate::acquire_frames::save(object("2.25.20", 20), &room.frames.join("frame-1.dcm"));
    let mut sender = Sender::open(address);
    assert_eq!(sender.store(XA, "2.25.21", &bytes_of(&object("2.25.21", 21), uids::EXPLICIT_VR_LITTLE_ENDIAN)), 0);
    let _ = sender.association.release();
    let mut half = Sender::open(address);
    half.fragment(1, PDataValueType::Command, true, &store_request(XA, "2.25.777"));
    half.fragment(1, PDataValueType::Data, false, &[0; 64]);
    drop(half);
    let ended = room.end(child);
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.pairs.len(), 2, "{stderr}");
    assert_eq!(ended.code, Some(3), "half an object is a loss: {stderr}");
    assert!(String::from_utf8_lossy(&ended.stdout).contains("half a DICOM object"), "{stderr}");
    let mut outputs = written(&room.out());
    outputs.extend([("stdout".to_owned(), ended.stdout.clone()), ("stderr".to_owned(), ended.stderr.clone())]);
    // The control: what may be shown is found by the same search.
    assert!(!hits(&outputs, "dicom-0001").is_empty());
    for word in ["Lovelace", "AAL-1815", "2.25.21", "2.25.777", "18151210"] {
        assert!(hits(&outputs, word).is_empty(), "{word} in {:?}", hits(&outputs, word));
    }
}
