//! Ports and each fault on them.

use mock_lab::fault::{Channel, FaultKind};
use mock_lab::pty::Line;
use mock_lab::wire::{MetadataMessage, Stamp, encode_metadata};
use rand::SeedableRng;

use crate::folder;
use crate::receiver::{Heard, hear, open, read_available};

fn packet(sequence: u32) -> Vec<u8> {
    let texts = ["S", "F", "C", "mm"].map(str::to_owned);
    let message = MetadataMessage { kind: 2, texts, limits: vec![[0.0, f32::from(sequence as u8)]] };
    encode_metadata(Stamp { sequence, device_us: u64::from(sequence) * 10_000 }, &message)
}

/// Forty packets, 10 ms apart, with `kind` at the tenth; heard on a port that stays open.
fn with_fault(kind: Option<FaultKind>) -> Heard {
    let folder = folder(&format!("fault-{}", kind.map_or("none", FaultKind::name)));
    let mut channel = Channel::new(Line::open(&folder.join("tty")).expect("pty"));
    let mut port = open(channel.line.path());
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let mut bytes = Vec::new();
    for sequence in 0..40 {
        if let Some(kind) = kind.filter(|_| sequence == 10) {
            channel.inject(kind);
        }
        channel.send(&packet(sequence), f64::from(sequence) * 0.01, &mut random).expect("sent");
        bytes.extend(read_available(&mut port));
    }
    assert_eq!(channel.line.overrun_bytes, 0);
    std::fs::remove_dir_all(folder).expect("removed");
    hear(&bytes)
}

#[test]
fn every_fault_leaves_its_own_trace() {
    let counts = |heard: &Heard| (heard.packets.len(), heard.corrupt, heard.lost, heard.duplicate, heard.reordered);
    assert_eq!(counts(&with_fault(None)), (40, 0, 0, 0, 0), "control");
    assert_eq!(counts(&with_fault(Some(FaultKind::Drop))), (39, 0, 1, 0, 0));
    assert_eq!(counts(&with_fault(Some(FaultKind::Flip))), (39, 1, 1, 0, 0));
    assert_eq!(counts(&with_fault(Some(FaultKind::Tear))), (38, 1, 2, 0, 0));
    assert_eq!(counts(&with_fault(Some(FaultKind::Duplicate))), (41, 0, 0, 1, 0));
    assert_eq!(counts(&with_fault(Some(FaultKind::Reorder))), (40, 0, 0, 0, 1));
    let delayed = with_fault(Some(FaultKind::Delay));
    assert_eq!(counts(&delayed), (40, 0, 0, 0, 0), "late, but whole and in order");
}

#[test]
fn an_unplugged_line_comes_back_as_another_terminal_behind_the_same_link() {
    let folder = folder("unplug");
    let link = folder.join("tty");
    let mut channel = Channel::new(Line::open(&link).expect("pty"));
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let mut port = open(&link);
    channel.send(&packet(0), 0.0, &mut random).expect("sent");
    assert_eq!(hear(&read_available(&mut port)).packets.len(), 1);
    channel.inject(FaultKind::Unplug);
    channel.send(&packet(1), 0.1, &mut random).expect("sent");
    assert!(!link.exists() && !channel.line.is_plugged());
    channel.send(&packet(2), 0.5, &mut random).expect("not sent");
    assert!(!channel.tick(1.0).expect("still away"));
    assert!(channel.tick(1.2).expect("plugged"));
    assert!(read_available(&mut port).is_empty(), "the old terminal stays dead");
    let mut port = open(&link);
    channel.send(&packet(3), 1.3, &mut random).expect("sent");
    let heard = hear(&read_available(&mut port));
    assert_eq!(heard.packets.iter().map(|packet| packet.2).collect::<Vec<_>>(), [3]);
    drop(channel);
    assert!(!link.exists(), "a line cleans up after itself");
    std::fs::remove_dir_all(folder).expect("removed");
}

#[test]
fn a_line_that_nobody_reads_never_blocks_and_counts_what_it_loses() {
    let folder = folder("overrun");
    let mut line = Line::open(&folder.join("tty")).expect("pty");
    let bytes = vec![7u8; 200_000];
    line.write(&bytes);
    let lost = line.overrun_bytes;
    assert!(lost > 0 && lost < 200_000, "{lost}");
    let mut port = open(line.path());
    assert_eq!(read_available(&mut port).len() as u64 + lost, 200_000);
    std::fs::remove_dir_all(folder).expect("removed");
}

#[test]
fn datagrams_come_one_a_packet_until_the_plug_is_pulled() {
    let free = std::net::UdpSocket::bind("127.0.0.1:0").expect("a free port");
    let port = free.local_addr().expect("an address").port();
    let mut channel = Channel::new(Line::to_port(port).expect("a socket"));
    assert_eq!(channel.line.path().to_str(), Some(format!("udp://127.0.0.1:{port}").as_str()));
    assert!(
        channel.line.is_plugged() && channel.line.is_read().expect("known") == cfg!(target_os = "linux"),
        "it is listened to"
    );
    free.set_read_timeout(Some(std::time::Duration::from_secs(10))).expect("a limit");
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let hear_one = || {
        let mut buffer = [0; 2048];
        free.recv(&mut buffer).ok().map(|count| buffer[..count].to_vec())
    };
    for sequence in 0..3 {
        channel.send(&packet(sequence), 0.01 * f64::from(sequence), &mut random).expect("sent");
        assert_eq!(hear_one().as_deref(), Some(&packet(sequence)[..]), "{sequence}");
    }
    channel.line.unplug();
    assert!(!channel.line.is_plugged() && !channel.line.is_read().expect("known"));
    channel.send(&packet(3), 0.03, &mut random).expect("nobody hears it");
    channel.line.plug().expect("a socket");
    channel.send(&packet(4), 0.04, &mut random).expect("sent");
    assert_eq!(hear_one().as_deref(), Some(&packet(4)[..]), "the third one never came");
    drop(free);
    assert!(!channel.line.is_read().expect("known"), "nobody listens any more");
    channel.send(&packet(5), 0.05, &mut random).expect("nobody hears it");
}
