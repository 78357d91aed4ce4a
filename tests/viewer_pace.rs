//! How often a real window is drawn while somebody moves the pointer over a large pair.
#![cfg(all(feature = "viewer", target_os = "linux"))]

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use sidecarm::time::Stopwatch;

use crate::live_lab::{Lab, Live};
use crate::viewer_real::{Screen, newest, used_s};

/// A pointer that is moved, by the X11 protocol: no program that does it is needed.
struct Pointer {
    server: UnixStream,
    root: u32,
}

impl Pointer {
    fn on(screen: &Screen) -> Self {
        let path = format!("/tmp/.X11-unix/X{}", screen.display.trim_start_matches(':'));
        let mut server = UnixStream::connect(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
        server.set_read_timeout(Some(Duration::from_secs(20))).expect("a timeout");
        // Little-endian, protocol 11.0, no authorization.
        server.write_all(&[b'l', 0, 11, 0, 0, 0, 0, 0, 0, 0, 0, 0]).expect("asked");
        let mut head = [0; 8];
        server.read_exact(&mut head).expect("answered");
        assert_eq!(head[0], 1, "the server lets us in");
        let mut told = vec![0; 4 * usize::from(u16::from_le_bytes([head[6], head[7]]))];
        server.read_exact(&mut told).expect("the rest");
        // 32 bytes, the vendor's name, formats of 8 bytes each; then the first screen, which begins with its root.
        let vendor = usize::from(u16::from_le_bytes([told[16], told[17]]));
        let at = 32 + vendor.next_multiple_of(4) + 8 * usize::from(told[21]);
        let root = u32::from_le_bytes(told[at..at + 4].try_into().expect("four bytes"));
        Self { server, root }
    }

    /// WarpPointer, which every program hears of as of a hand's doing.
    fn to(&mut self, column: i16, row: i16) {
        let mut request = vec![41u8, 0, 6, 0];
        request.extend(0u32.to_le_bytes());
        request.extend(self.root.to_le_bytes());
        request.extend([0u8; 8]);
        request.extend([column, row].map(i16::to_le_bytes).concat());
        self.server.write_all(&request).expect("asked");
    }
}

/// Pictures a second that are drawn of a pair of [`SIDE_PX`] while the pointer moves, on a machine that does nothing else.
const LEAST_PER_S: f64 = 30.0;
const SIDE_PX: &str = "1536";
/// How long they are counted.
const COUNTED_MS: f64 = 10_000.0;

/// The line below the pictures tells of the pixel under the pointer: it is another one in each picture that is drawn.
#[test]
#[ignore = "a minute, on a machine that does nothing else: scripts/evaluate window runs it"]
fn a_large_pair_is_drawn_thirty_times_a_second() {
    let screen = Screen::required();
    let args = ["--duration-s", "20", "--exposures", "1", "--faults", "none", "--idle-s", "300", "--panel-px", SIDE_PX];
    let Some(lab) = Lab::start(&args) else { return };
    let live = Live::windowed(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &screen.display);
    newest(&live, |pair| pair["drr"].is_string());
    // What comes of it has been drawn, and memory is given back.
    std::thread::sleep(Duration::from_secs(5));
    let mut pointer = Pointer::on(&screen);
    let line = || screen.part(320..620, 790..830);
    let (watch, before_s) = (Stopwatch::start(), used_s(live.program.id()));
    let (mut last, mut drawn, mut moves) = (line(), 0, 0);
    while watch.ms() < COUNTED_MS {
        // To and fro within the acquired picture, which has three and a half pixels to a point.
        let along = moves % 200;
        pointer.to(400 + 2 * along.min(200 - along), 250);
        moves += 1;
        std::thread::sleep(Duration::from_millis(2));
        let seen = line();
        drawn += i32::from(seen != last);
        last = seen;
    }
    let took_s = watch.ms() * 1e-3;
    let share = (used_s(live.program.id()) - before_s) / took_s;
    let per_s = f64::from(drawn) / took_s;
    println!(
        "{SIDE_PX}x{SIDE_PX}: drawn {per_s:.0} times a second while the pointer moves, with {:.0} % of a core",
        100.0 * share
    );
    pointer.to(1390, 890);
    std::thread::sleep(Duration::from_secs(1));
    let still = line();
    std::thread::sleep(Duration::from_secs(2));
    assert!(line() == still, "control: what changes in that line is what the pointer does");
    assert!(per_s >= LEAST_PER_S, "{per_s:.1} times a second, {LEAST_PER_S} are asked for");
}
