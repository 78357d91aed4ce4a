//! The OpenIGTLink server against clients that behave, stand still, or send what is no message.

#![cfg(unix)]

use std::net::{IpAddr, Ipv4Addr};

use glam::{DQuat, DVec3};
use sidecarm::geometry::Rigid;
use sidecarm::igtl::{Content, MOST_CLIENTS, Message, Picture, Placement, Server, Status};
use sidecarm::image::Image;
use sidecarm::reporter::Reporter;
use sidecarm::time::Stopwatch;

use crate::igtl_client::{Client, packed};
use crate::live_lab::eventually;

const LOOPBACK: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

fn open(reporter: &Reporter) -> Server {
    let status = Status { code: Status::NOT_READY, frame: 0, name: "no frame yet".to_owned(), words: "waiting".to_owned() };
    Server::open(LOOPBACK, 0, "Sidecarm", status, reporter).expect("a free port")
}

/// A client that the server knows of.
fn joined(server: &Server) -> Client {
    let before = server.clients();
    let client = Client::connect(server.address());
    assert!(eventually(20.0, || (server.clients() > before).then_some(())).is_some(), "the client is not welcomed");
    client
}

fn transform(device: &str, time_us: i64, x_mm: f64) -> Message {
    let transform = Rigid { rotation: DQuat::from_rotation_x(0.3), translation_mm: DVec3::new(x_mm, -2.0, 3.5) };
    Message { device: device.to_owned(), time_us, content: Content::Transform(transform) }
}

#[test]
fn a_client_hears_what_is_sent_in_the_format_that_it_speaks() {
    let reporter = Reporter::silent();
    let server = open(&reporter);
    let mut client = joined(&server);
    let first = client.next().expect("a status");
    assert_eq!((first.version, first.device.as_str(), first.status()), (1, "Sidecarm", (13, "waiting".to_owned())));
    server.send(transform("BaseToLps", 1_700_000_000_250_001, 1.25));
    let heard = client.find(|told| told.device == "BaseToLps");
    assert_eq!((heard.version, heard.time_us()), (1, 1_700_000_000_250_001));
    let (sin, cos) = 0.3f64.sin_cos();
    let wanted = [[1.0, 0.0, 0.0, 1.25], [0.0, cos, -sin, -2.0], [0.0, sin, cos, 3.5], [0.0, 0.0, 0.0, 1.0]];
    for (found, wanted) in heard.matrix().iter().flatten().zip(wanted.iter().flatten()) {
        assert!((found - wanted).abs() < 1e-6, "{heard:?}");
    }
    // What is no number is not sent; what follows it is.
    server.send(transform("BaseToLps", 7, f64::NAN));
    server.set_status(Status { code: Status::OK, frame: 3, name: "accepted".to_owned(), words: "frame 3".to_owned() });
    let next = client.find(|told| told.type_name == "TRANSFORM" || told.status().0 == 1);
    assert_eq!((next.type_name.as_str(), next.uint16(8)), ("STATUS", 3), "the sub-code is the frame's number");
    // From here on the client speaks version 2, with metadata.
    client.send(&packed(2, "TRANSFORM", &[0; 48]));
    client.send(&packed(2, "GET_STATUS", b""));
    let answer = client.find(|told| told.version == 2);
    assert_eq!(answer.status(), (1, "frame 3".to_owned()));
    let image = Image::from_pixels(3, 2, vec![0.5, 1.0, 2.0, 3.0, 4.0, f32::NAN]).expect("six pixels");
    let picture = Picture::of(&image, Placement::PIXELS).expect("small");
    server.send(Message { device: "Drr".to_owned(), time_us: 0, content: Content::Image(picture) });
    let heard = client.find(|told| told.type_name == "IMAGE");
    assert_eq!((heard.version, &heard.content[2..6], heard.content.len()), (2, &[1, 10, 2, 1][..], 72 + 24));
    assert_eq!([6, 8, 10].map(|at| heard.uint16(at)), [3, 2, 1]);
    // Its middle, the second of two columns' centres and between two rows.
    assert_eq!([48, 52, 56].map(|at| heard.float32(at)), [1.0, 0.5, 0.0]);
    assert_eq!(heard.content[72..76], 0.5f32.to_le_bytes());
    client.send(&packed(1, "GET_CAPABIL", b""));
    let capable = client.find(|told| told.type_name == "CAPABILITY");
    assert!(capable.version == 1 && capable.content.chunks(12).any(|name| name.starts_with(b"POSITION\0")));
    drop(server);
    assert_eq!(client.find(|told| told.type_name == "STATUS" && told.status().0 == 19).status().1, "the session ends");
    assert!(client.next().is_none());
    assert!(reporter.warnings().is_empty(), "{:?}", reporter.warnings());
}

#[test]
fn a_client_that_stands_still_loses_the_oldest_and_holds_nobody_up() {
    let reporter = Reporter::silent();
    let server = open(&reporter);
    let mut still = joined(&server);
    let mut reading = joined(&server);
    let reader = std::thread::spawn(move || {
        let told = std::iter::from_fn(|| reading.next()).filter(|told| told.device == "TipToLps");
        told.map(|told| told.time_us()).collect::<Vec<i64>>()
    });
    let image = Image::filled(500, 500, 0.5f32);
    let mut slowest_ms = 0.0f64;
    const COUNT: i64 = 60;
    for n in 1..=COUNT {
        let picture = Picture::of(&image, Placement::PIXELS).expect("small");
        let watch = Stopwatch::start();
        server.send(Message { device: "Drr".to_owned(), time_us: n, content: Content::Image(picture) });
        server.send(transform("TipToLps", n, n as f64));
        slowest_ms = slowest_ms.max(watch.ms());
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
    assert!(slowest_ms < 500.0, "sending took {slowest_ms} ms");
    let slow = eventually(20.0, || reporter.warnings().get("OpenIGTLink client slow").cloned());
    assert!(slow.is_some_and(|slow| slow.latest.contains("messages dropped")), "{:?}", reporter.warnings());
    // The one that stood still reads again, and soon hears of the newest.
    let newest = still.find(|told| told.type_name == "IMAGE" && told.time_us() == COUNT);
    assert_eq!(newest.content.len(), 72 + 1_000_000);
    drop(server);
    let heard = reader.join().expect("the reader is well");
    assert!(heard.is_sorted() && heard.last() == Some(&COUNT), "{heard:?}");
    assert!(heard.len() > COUNT as usize / 2, "{heard:?}");
}

#[test]
fn what_is_no_message_ends_its_connection_alone_and_is_counted() {
    let reporter = Reporter::silent();
    let server = open(&reporter);
    let mut other = joined(&server);
    let mut altered = packed(1, "TRANSFORM", &[1; 48]);
    altered[70] ^= 0x10;
    let mut huge = packed(1, "IMAGE", b"");
    huge[42..50].copy_from_slice(&(1u64 << 40).to_be_bytes());
    let cases = [
        (altered, "OpenIGTLink checksum"),
        (huge, "OpenIGTLink message too large"),
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1:18944\r\nAccept: */*\r\n\r\n      ".to_vec(), "OpenIGTLink garbage"),
    ];
    for (bytes, kind) in &cases {
        let mut client = joined(&server);
        client.send(bytes);
        assert!(eventually(20.0, || client.next().is_none().then_some(())).is_some(), "{kind}: still connected");
        let counted = reporter.warnings().get(*kind).cloned().unwrap_or_else(|| panic!("{kind}: {:?}", reporter.warnings()));
        assert!(counted.count == 1 && counted.latest.contains("disconnected"), "{counted:?}");
        assert!(eventually(20.0, || (server.clients() == 1).then_some(())).is_some(), "{kind}: it keeps its place");
    }
    server.send(transform("TipToLps", 5, 0.0));
    assert_eq!(other.find(|told| told.type_name == "TRANSFORM").time_us(), 5);
}

#[test]
fn one_client_more_than_there_is_room_for_is_turned_away() {
    let reporter = Reporter::silent();
    let server = open(&reporter);
    let mut clients: Vec<Client> = (0..MOST_CLIENTS).map(|_| joined(&server)).collect();
    let mut late = Client::connect(server.address());
    assert!(late.next().is_none() && reporter.warnings().contains_key("OpenIGTLink clients"));
    clients.pop();
    assert!(eventually(20.0, || (server.clients() < MOST_CLIENTS).then_some(())).is_some(), "a place is free again");
    drop(joined(&server));
}

#[test]
fn a_port_that_is_taken_is_said() {
    let reporter = Reporter::silent();
    let server = open(&reporter);
    let status = Status { code: Status::OK, frame: 0, name: String::new(), words: String::new() };
    let refused = Server::open(LOOPBACK, server.address().port(), "Sidecarm", status, &reporter).err().expect("taken");
    assert!(refused.to_string().contains(&server.address().to_string()), "{refused}");
}
