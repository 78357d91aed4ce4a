//! Ports that are no serial ports: datagrams and files that grow, of lines and of packets.

use std::io::Write;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::{Value, json};
use sidecarm::telemetry::{
    DeviceKind, Event, Health, Link, PortConfig, PortError, PortEvent, PortTask, Sample, hint, spawn_port,
};
use tokio::sync::mpsc;

use crate::telemetry_frames;
use crate::telemetry_lines::{adapter, plain};

/// A port of the loopback that nobody listens on.
pub fn free_udp_port() -> u16 {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
    socket.local_addr().expect("it is bound").port()
}

/// A port that is open, and what came from it so far.
struct Listening {
    runtime: tokio::runtime::Runtime,
    events: mpsc::Receiver<(DeviceKind, PortEvent)>,
    task: PortTask,
    link: Link,
    /// The first sensed angle of robots, the sequence number of C-arms.
    values: Vec<f64>,
    told: Vec<String>,
    epochs: u32,
}

impl Listening {
    fn new(device: DeviceKind, port: &str, declaration: Option<&Value>) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("a runtime");
        let adapter = declaration.map(adapter);
        let link = adapter.as_ref().map_or_else(|| Link::new(device), |adapter| Link::of_lines(adapter, true));
        let (sink, events) = mpsc::channel(64);
        let config = PortConfig { adapter, ..PortConfig::new(device, port) };
        let task = spawn_port(runtime.handle(), config, sink);
        Self { runtime, events, task, link, values: Vec::new(), told: Vec::new(), epochs: 0 }
    }

    /// Takes events until `is_enough`, within twenty seconds.
    fn until(&mut self, what: &str, is_enough: impl Fn(&Self) -> bool) {
        while !is_enough(self) {
            let Self { runtime, events, .. } = self;
            let event = runtime.block_on(async { tokio::time::timeout(Duration::from_secs(20), events.recv()).await });
            let event = event.unwrap_or_else(|_| panic!("{what}: {:?} {:?}", self.values, self.told)).expect("the task runs").1;
            match &event {
                PortEvent::Opened { .. } => self.epochs += 1,
                PortEvent::Lost { reason, .. } => self.told.push(reason.clone()),
                PortEvent::Retry { error, .. } => self.told.push(format!("{error}; {}", hint(error))),
                PortEvent::Said { words, .. } => self.told.push(words.clone()),
                PortEvent::Bytes { .. } => {}
            }
            let Self { link, values, .. } = self;
            link.handle(&event, &mut |received| match received.event {
                Event::Sample(Sample::Robot(robot), _) => values.push(robot.sensed_deg.expect("declared")[0]),
                Event::Sample(sample, _) => values.push(f64::from(sample.sequence())),
                Event::Fault(_) => {}
            });
        }
    }

    fn health(&self) -> Health {
        *self.link.health()
    }
}

fn line(value: u32) -> String {
    format!("{value},0,0,0,0\n")
}

#[test]
fn datagrams_are_lines_whether_they_end_so_or_not() {
    let port = free_udp_port();
    let mut listening = Listening::new(DeviceKind::Robot, &format!("udp://:{port}"), Some(&plain()));
    listening.until("open", |listening| listening.epochs == 1);
    let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
    let to = (Ipv4Addr::LOCALHOST, port);
    for text in [line(1), "2,0,0,0,0".to_owned(), String::new(), line(3) + &line(4), "5,0,0,0,0\r\n6,0,0,0,0".to_owned()] {
        sender.send_to(text.as_bytes(), to).expect("sent");
    }
    listening.until("six lines", |listening| listening.values.len() == 6);
    assert_eq!(listening.values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "the first one as well: a datagram is not cut");
    assert_eq!((listening.health().corrupt, listening.health().partial_at_open), (0, 0));
    assert_eq!(listening.task.bytes(), listening.health().bytes);

    // Two devices in one line would be one that jumps.
    let second = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
    second.send_to(line(90).as_bytes(), to).expect("sent");
    sender.send_to(line(7).as_bytes(), to).expect("sent");
    listening.until("the first sender goes on", |listening| listening.values.last() == Some(&7.0));
    assert!(!listening.values.contains(&90.0) && listening.told.len() == 1, "{:?}", listening.told);
    assert!(listening.told[0].contains("second sender"), "{:?}", listening.told);
    // A sender that was started again has another port, and comes when the first one has gone.
    std::thread::sleep(Duration::from_millis(1100));
    second.send_to(line(91).as_bytes(), to).expect("sent");
    second.send_to(line(92).as_bytes(), to).expect("sent");
    listening.until("the second sender", |listening| listening.values.last() == Some(&92.0));
    assert_eq!((&listening.values[7..], listening.epochs), (&[91.0, 92.0][..], 2), "of another opening, and none is lost");
    assert!(listening.told[1].contains("another sender"), "{:?}", listening.told);
}

#[test]
fn packets_come_over_udp_as_well() {
    let port = free_udp_port();
    let mut listening = Listening::new(DeviceKind::Carm, &format!("udp://127.0.0.1:{port}"), None);
    listening.until("open", |listening| listening.epochs == 1);
    let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
    let send = |bytes: &[u8]| sender.send_to(bytes, (Ipv4Addr::LOCALHOST, port)).expect("sent");
    // One a datagram, two in one, and one over two.
    send(&telemetry_frames::plain(1));
    send(&[telemetry_frames::plain(2), telemetry_frames::plain(3)].concat());
    let fourth = telemetry_frames::plain(4);
    send(&fourth[..50]);
    send(&fourth[50..]);
    listening.until("four packets", |listening| listening.values.len() == 4);
    assert_eq!(listening.values, [1.0, 2.0, 3.0, 4.0]);
    assert_eq!((listening.health().corrupt, listening.health().lost), (0, 0));
    // Where somebody listens, nobody else can.
    let mut other = Listening::new(DeviceKind::Carm, &format!("udp://:{port}"), None);
    other.until("busy", |other| !other.told.is_empty());
    assert!(other.told[0].contains("in use") && other.told[0].contains("ss -ulnp"), "{:?}", other.told);
}

fn append(path: &Path, text: &str) {
    let mut file = std::fs::OpenOptions::new().append(true).create(true).open(path).expect("opens");
    file.write_all(text.as_bytes()).expect("written");
}

#[test]
fn a_file_is_followed_from_its_end_through_renaming_and_cutting() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.csv");
    // Yesterday's lines, and one that is being written.
    append(&path, &(line(1) + &line(2) + "3,0"));
    let mut listening = Listening::new(DeviceKind::Robot, &format!("file:{}", path.display()), Some(&plain()));
    listening.until("open", |listening| listening.epochs == 1);
    append(&path, ",0,0,0\n");
    append(&path, &(line(4) + "5,0,"));
    listening.until("the line that was begun", |listening| listening.values.len() == 2);
    assert_eq!(listening.values, [3.0, 4.0]);
    append(&path, "0,0,0\n");
    listening.until("its end", |listening| listening.values.len() == 3);
    // The program begins another file: what is written last to the old one is read as well.
    append(&path, &line(6));
    std::fs::rename(&path, folder.path().join("robot.csv.1")).expect("renamed");
    append(&path, &line(7));
    listening.until("another file", |listening| listening.values.last() == Some(&7.0));
    assert_eq!((&listening.values[2..], listening.epochs), (&[5.0, 6.0, 7.0][..], 2));
    // It may be looked at between the renaming and the new file.
    assert!(["another file", "the file is gone"].iter().any(|words| listening.told[0].contains(words)), "{:?}", listening.told);
    append(&path, &(line(8) + &line(9)));
    listening.until("it goes on", |listening| listening.values.last() == Some(&9.0));
    // Cut to nothing, and written anew.
    std::fs::File::create(&path).expect("cut");
    listening.until("cut", |listening| listening.epochs == 3);
    append(&path, &line(10));
    listening.until("the first line since", |listening| listening.values.last() == Some(&10.0));
    assert_eq!(listening.values[5..], [8.0, 9.0, 10.0], "nothing twice, nothing lost");
    assert_eq!(listening.health().corrupt, 0);
    for told in &listening.told {
        assert!(!told.contains("robot.csv"), "names of files reach no log: {told}");
    }
    assert!(listening.told.iter().any(|told| told.contains("cut short")), "{:?}", listening.told);
    // Lines that come while the port is being closed are read.
    append(&path, &line(11));
    listening.task.finish();
    listening.until("the last line", |listening| listening.values.last() == Some(&11.0));
}

#[test]
fn a_file_that_comes_later_is_read_from_its_beginning_and_a_header_always() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("late.csv");
    let port = format!("file:{}", path.display());
    let mut declaration = plain();
    declaration["format"]["csv"] = json!({"header": true});
    let mut listening = Listening::new(DeviceKind::Robot, &port, Some(&declaration));
    listening.until("missing", |listening| !listening.told.is_empty());
    let said = &listening.told[0];
    assert!(said.starts_with("telemetry file ") && said.contains("does not exist; it is read from its beginning"), "{said}");
    append(&path, &("e,d,c,b,a\n".to_owned() + "0,0,0,0,1\n"));
    listening.until("the first line", |listening| listening.values == [1.0]);
    // Opened later, it is followed from its end; its first line still names the columns.
    append(&path, "0,0,0,0,2\n");
    let mut second = Listening::new(DeviceKind::Robot, &port, Some(&declaration));
    second.until("open", |second| second.health().bytes > 0);
    append(&path, "0,0,0,0,3\n");
    second.until("the line that is new", |second| !second.values.is_empty());
    assert_eq!(second.values, [3.0]);
    assert_eq!(second.health().corrupt, 0);
}

/// Lines that end in a carriage return alone were read from the beginning of yesterday's; a comment before the header stood for it; and of
/// two headers the first was taken.
#[test]
fn what_stood_in_a_file_before_is_its_latest_header_alone() {
    let mut declaration = plain();
    declaration["format"]["csv"] = json!({"header": true, "comment": "#"});
    let folder = tempfile::tempdir().expect("a folder");
    let columns = ["a,b,c,d,e", "e,d,c,b,a"];
    for (name, before, end) in [
        ("old Mac", format!("{}\r1,0,0,0,0\r2,0,0,0,0\r", columns[0]), "\r"),
        ("comment", format!("# exported\n{}\n1,0,0,0,0\n", columns[0]), "\n"),
        ("again", format!("{}\n1,0,0,0,0\n{}\n0,0,0,0,2\n", columns[0], columns[1]), "\n"),
    ] {
        let path = folder.path().join(format!("{name}.csv"));
        append(&path, &before);
        let mut listening = Listening::new(DeviceKind::Robot, &format!("file:{}", path.display()), Some(&declaration));
        listening.until("open", |listening| listening.epochs == 1);
        let line = if name == "again" { "0,0,0,0,7" } else { "7,0,0,0,0" };
        append(&path, &format!("{line}{end}"));
        listening.until("the line", |listening| !listening.values.is_empty());
        assert_eq!((&listening.values[..], listening.health().corrupt), (&[7.0][..], 0), "{name}");
    }
}

#[test]
fn what_is_no_file_and_no_address_is_said() {
    let folder = tempfile::tempdir().expect("a folder");
    let first = |port: &str| {
        let mut listening = Listening::new(DeviceKind::Robot, port, Some(&plain()));
        listening.until(port, |listening| !listening.told.is_empty());
        listening.told[0].clone()
    };
    let said = first(&format!("file:{}", folder.path().display()));
    assert!(said.contains("is not a file") && said.contains("name the file"), "{said}");
    let said = first("udp://192.0.2.1:5005");
    assert!(said.starts_with("udp://192.0.2.1:5005: ") && said.contains("address of this machine"), "{said}");
    // One of these is an error of a port that a session cannot name.
    let error = PortError::NotFound { path: PathBuf::from("/dev/ttyUSB7") };
    assert!(error.to_string() == "serial port /dev/ttyUSB7: does not exist" && hint(&error).contains("cable"));
}
