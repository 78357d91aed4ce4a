//! A console's end of DICOM storage: one object an association, written from PS3.8 (section 9.3, the protocol data units) and PS3.7 (section
//! 9.3.1 and annex E, C-STORE). Nobody else's code: a wrong reading of the standard in a receiver's library is caught.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use serde_json::{Value, json};

use crate::MockError;
use crate::dicom::UID_BASE;

/// The name of the console, and that of whom it calls.
pub const CALLING: &str = "MOCKARM";
/// See [`CALLING`].
pub const CALLED: &str = "SIDECARM";

const APPLICATION_CONTEXT: &str = "1.2.840.10008.3.1.1.1";
/// The one presentation context: the object's class in its transfer syntax.
const CONTEXT: u8 = 1;
/// Longest unit that is taken, and the longest that is sent to who takes any.
const MOST_PDU_BYTES: u32 = 1 << 16;
/// Who says nothing for so long has gone.
const SILENCE: Duration = Duration::from_secs(20);
/// How often a destination is tried that is not there, or does not take what it is sent, and after how long again.
const TRIES: usize = 10;
const AGAIN: Duration = Duration::from_millis(500);

/// Kinds of units (PS3.8 section 9.3.1).
const ASSOCIATE_RQ: u8 = 1;
const ASSOCIATE_AC: u8 = 2;
const ASSOCIATE_RJ: u8 = 3;
const P_DATA: u8 = 4;
const RELEASE_RQ: u8 = 5;
const RELEASE_RP: u8 = 6;

/// Bits of a fragment's head (PS3.8 annex E.2).
const IS_COMMAND: u8 = 1;
const IS_LAST: u8 = 2;

/// What a Part 10 file holds.
struct Object<'a> {
    class: String,
    instance: String,
    syntax: String,
    data: &'a [u8],
}

/// Reads the head of a file, which is explicit VR, little endian (PS3.10 section 7.1).
fn part_10(file: &[u8]) -> Option<Object<'_>> {
    let mut rest = file.get(132..)?;
    let (mut class, mut instance, mut syntax) = (String::new(), String::new(), String::new());
    while rest.starts_with(&[2, 0]) {
        let (head, behind) = rest.split_first_chunk::<8>()?;
        let (length, behind) = match &head[4..6] {
            b"OB" | b"UN" => {
                let (long, behind) = behind.split_first_chunk::<4>()?;
                (u32::from_le_bytes(*long) as usize, behind)
            }
            _ => (usize::from(u16::from_le_bytes([head[6], head[7]])), behind),
        };
        let (value, next) = behind.split_at_checked(length)?;
        let uid = || String::from_utf8_lossy(value).trim_end_matches(['\0', ' ']).to_owned();
        match [head[2], head[3]] {
            [0x02, 0] => class = uid(),
            [0x03, 0] => instance = uid(),
            [0x10, 0] => syntax = uid(),
            _ => {}
        }
        rest = next;
    }
    let is_whole = !(class.is_empty() || instance.is_empty() || syntax.is_empty() || rest.is_empty());
    is_whole.then_some(Object { class, instance, syntax, data: rest })
}

/// A unit: its kind, and its length as 32 bits, big endian as all lengths of PS3.8.
fn unit(kind: u8, body: &[u8]) -> Vec<u8> {
    [&[kind, 0][..], &(body.len() as u32).to_be_bytes(), body].concat()
}

/// An item of an association's request: its kind, and its length as 16 bits.
fn item(kind: u8, body: &[u8]) -> Vec<u8> {
    [&[kind, 0][..], &(body.len() as u16).to_be_bytes(), body].concat()
}

/// The items of an answer; what is cut off is none.
fn items(mut rest: &[u8]) -> Vec<(u8, &[u8])> {
    let mut found = Vec::new();
    while let Some((head, behind)) = rest.split_first_chunk::<4>() {
        let Some((body, next)) = behind.split_at_checked(usize::from(u16::from_be_bytes([head[2], head[3]]))) else { break };
        found.push((head[0], body));
        rest = next;
    }
    found
}

/// Asks for one presentation context (PS3.8 section 9.3.2, PS3.7 annex D.3.3).
fn associate_request(class: &str, syntax: &str) -> Vec<u8> {
    let title = |name: &str| format!("{name:16}").into_bytes();
    let context = [&[CONTEXT, 0, 0, 0][..], &item(0x30, class.as_bytes()), &item(0x40, syntax.as_bytes())].concat();
    let implementation = format!("2.25.{}", UID_BASE + (1 << 61));
    let user = [item(0x51, &MOST_PDU_BYTES.to_be_bytes()), item(0x52, implementation.as_bytes()), item(0x55, b"MOCK_LAB")];
    let parts = [
        // Version 1 of the protocol.
        vec![0, 1, 0, 0],
        title(CALLED),
        title(CALLING),
        vec![0; 32],
        item(0x10, APPLICATION_CONTEXT.as_bytes()),
        item(0x20, &context),
        item(0x50, &user.concat()),
    ];
    unit(ASSOCIATE_RQ, &parts.concat())
}

/// The longest unit that an answer to the request lets through, or why nothing may be sent.
fn accepted(kind: u8, body: &[u8]) -> Result<u32, String> {
    match (kind, body) {
        (ASSOCIATE_AC, _) => {}
        (ASSOCIATE_RJ, [_, result, source, reason, ..]) => {
            return Err(format!("the association is rejected: result {result}, source {source}, reason {reason}"));
        }
        _ => return Err(format!("it answers a request for an association with a unit of kind {kind}")),
    }
    let answered = items(body.get(68..).unwrap_or_default());
    let of = |wanted: u8| answered.iter().find(|(kind, _)| *kind == wanted).map(|(_, body)| *body);
    match of(0x21) {
        Some([CONTEXT, _, 0, ..]) => {}
        Some([_, _, result, ..]) => return Err(format!("class and transfer syntax are not taken: result {result}")),
        _ => return Err("it says nothing of class and transfer syntax".to_owned()),
    }
    let most = items(of(0x50).unwrap_or_default()).into_iter().find(|(kind, _)| *kind == 0x51);
    let most = most.and_then(|(_, bytes)| bytes.first_chunk::<4>()).map_or(0, |bytes| u32::from_be_bytes(*bytes));
    // 0 is no limit.
    Ok(if most == 0 { MOST_PDU_BYTES } else { most.min(MOST_PDU_BYTES) })
}

/// An element of a command: group 0000, implicit VR, little endian.
fn element(number: u16, value: &[u8]) -> Vec<u8> {
    let padding: &[u8] = if value.len() % 2 == 1 { &[0] } else { &[] };
    let length = (value.len() + padding.len()) as u32;
    [&[0, 0][..], &number.to_le_bytes(), &length.to_le_bytes(), value, padding].concat()
}

/// C-STORE-RQ, message 1, of medium priority, a data set behind it.
fn store_request(object: &Object) -> Vec<u8> {
    let body = [
        element(0x0002, object.class.as_bytes()),
        element(0x0100, &[1, 0]),
        element(0x0110, &[1, 0]),
        element(0x0700, &[0, 0]),
        element(0x0800, &[0, 0]),
        element(0x1000, object.instance.as_bytes()),
    ]
    .concat();
    [element(0, &(body.len() as u32).to_le_bytes()), body].concat()
}

/// The status of a response.
fn status(command: &[u8]) -> Option<u16> {
    let mut rest = command;
    while let Some((head, behind)) = rest.split_first_chunk::<8>() {
        let length = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
        let (value, next) = behind.split_at_checked(length as usize)?;
        if head[..4] == [0, 0, 0, 9] {
            return value.first_chunk::<2>().map(|pair| u16::from_le_bytes(*pair));
        }
        rest = next;
    }
    None
}

/// A unit with one fragment.
fn fragment(bits: u8, bytes: &[u8]) -> Vec<u8> {
    let value = [&(bytes.len() as u32 + 2).to_be_bytes()[..], &[CONTEXT, bits], bytes].concat();
    unit(P_DATA, &value)
}

fn read_unit(stream: &mut impl Read) -> Result<(u8, Vec<u8>), String> {
    let lost = |error: std::io::Error| format!("no answer: {error}");
    let mut head = [0; 6];
    stream.read_exact(&mut head).map_err(lost)?;
    let length = u32::from_be_bytes([head[2], head[3], head[4], head[5]]);
    if length > MOST_PDU_BYTES {
        return Err(format!("it answers with a unit of {length} bytes"));
    }
    let mut body = vec![0; length as usize];
    stream.read_exact(&mut body).map_err(lost)?;
    Ok((head[0], body))
}

/// Sends the object of a Part 10 file over `stream`, waiting for `pause` in the middle of it; the status that comes back.
fn store(stream: &mut (impl Read + Write), file: &[u8], pause: Duration) -> Result<u16, String> {
    let sent = |error: std::io::Error| format!("it does not take what is sent: {error}");
    let object = part_10(file).ok_or("no Part 10 file")?;
    stream.write_all(&associate_request(&object.class, &object.syntax)).map_err(sent)?;
    let (kind, body) = read_unit(stream)?;
    let most = accepted(kind, &body)?;
    stream.write_all(&fragment(IS_COMMAND | IS_LAST, &store_request(&object))).map_err(sent)?;
    // Length and head of the fragment count; fragments are of an even length.
    let piece = (most.saturating_sub(6).max(2) & !1) as usize;
    let pieces = object.data.chunks(piece);
    let count = pieces.len();
    for (index, bytes) in pieces.enumerate() {
        if index == count / 2 {
            std::thread::sleep(pause);
        }
        stream.write_all(&fragment(if index + 1 == count { IS_LAST } else { 0 }, bytes)).map_err(sent)?;
    }
    let mut command = Vec::new();
    loop {
        let (kind, body) = read_unit(stream)?;
        // Length, context, head, then the fragment.
        let ([.., bits], behind) = match (kind, body.split_first_chunk::<6>()) {
            (P_DATA, Some(split)) => split,
            _ => return Err(format!("it answers an object with a unit of kind {kind}")),
        };
        command.extend(behind);
        if bits & IS_LAST != 0 {
            break;
        }
    }
    let status = status(&command).ok_or("its answer has no status")?;
    stream.write_all(&unit(RELEASE_RQ, &[0; 4])).map_err(sent)?;
    match read_unit(stream)? {
        (RELEASE_RP, _) => Ok(status),
        (kind, _) => Err(format!("it answers a release with a unit of kind {kind}")),
    }
}

/// Stores a file at `port` of this machine; tries again where nobody is there yet, or where it is not taken.
fn deliver(port: u16, file: &[u8], pause: Duration) -> Result<(), String> {
    let mut refused = String::new();
    for attempt in 0..TRIES {
        if attempt > 0 {
            std::thread::sleep(AGAIN);
        }
        let stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).and_then(|stream| {
            stream.set_read_timeout(Some(SILENCE))?;
            stream.set_nodelay(true)?;
            Ok(stream)
        });
        let stored = stream.map_err(|error| error.to_string()).and_then(|mut stream| store(&mut stream, file, pause));
        refused = match stored {
            Ok(0) => return Ok(()),
            Ok(status) => format!("status {status:04X}"),
            Err(words) => words,
        };
    }
    Err(refused)
}

/// A file on its way, how long its sender waits in the middle of it.
type Parcel = (PathBuf, Vec<u8>, Duration);

/// Sends files in their order, on a thread of its own: devices do not wait for it.
pub struct Console {
    parcels: Option<Sender<Parcel>>,
    events: Receiver<Value>,
}

impl Console {
    /// To `port` of this machine.
    #[must_use]
    pub fn to_port(port: u16) -> Self {
        let (parcels, taken) = channel::<Parcel>();
        let (told, events) = channel();
        std::thread::spawn(move || {
            for (path, file, pause) in taken {
                let event = match deliver(port, &file, pause) {
                    Ok(()) => json!({"event": "stored", "file": path}),
                    Err(detail) => json!({"event": "not_stored", "file": path, "detail": detail}),
                };
                // Whoever plays may have gone.
                let _ = told.send(event);
            }
        });
        Self { parcels: Some(parcels), events }
    }

    /// Hands a file over.
    ///
    /// # Errors
    /// When the sender has died.
    pub fn send(&self, path: &Path, file: Vec<u8>, pause: Duration) -> Result<(), MockError> {
        let died =
            || MockError::Data { what: path.display().to_string(), detail: "the thread that sends it has died".to_owned() };
        self.parcels.as_ref().and_then(|parcels| parcels.send((path.to_owned(), file, pause)).ok()).ok_or_else(died)
    }

    /// What has happened since it was asked last.
    pub fn events(&self) -> impl Iterator<Item = Value> + '_ {
        self.events.try_iter()
    }

    /// Waits until all is sent, or given up.
    pub fn finish(&mut self, tell: &mut dyn FnMut(Value)) {
        self.parcels = None;
        self.events.iter().for_each(tell);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dicom::{FrameTags, encode};

    const TAGS: FrameTags = FrameTags {
        size_px: [300, 200],
        pitch_mm: 0.4,
        source_to_detector_mm: 1000.0,
        tube_kvp: 80.0,
        tube_ma: 3.0,
        exposure_ms: 100.0,
        acquired_us: None,
        exposure_counter: Some(1),
        instance: 1,
        beam: None,
    };

    /// A receiver that says what is laid into it, and keeps what it hears.
    struct Wire {
        answers: std::io::Cursor<Vec<u8>>,
        heard: Vec<u8>,
    }

    impl Read for Wire {
        fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
            self.answers.read(buffer)
        }
    }

    impl Write for Wire {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.heard.extend(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    /// Takes the context, units of at most `most` bytes, and the object with a status; then releases.
    fn answers(result: u8, most: u32, status: u16) -> Vec<u8> {
        let context = [&[CONTEXT, 0, result, 0][..], &item(0x40, b"1.2.840.10008.1.2.1")].concat();
        let user = item(0x51, &most.to_be_bytes());
        let body = [vec![0; 68], item(0x10, b"1.2"), item(0x21, &context), item(0x50, &user)].concat();
        let response = [element(0x0100, &[1, 0x80]), element(0x0900, &status.to_le_bytes())].concat();
        let released = unit(RELEASE_RP, &[0; 4]);
        [unit(ASSOCIATE_AC, &body), fragment(IS_COMMAND | IS_LAST, &response), released].concat()
    }

    /// Kind and body.
    type Unit = (u8, Vec<u8>);

    /// What became of it, the units that were sent, and the data set that they carry.
    fn stored(answers: Vec<u8>) -> (Result<u16, String>, Vec<Unit>, Vec<u8>) {
        let values: Vec<u16> = (0..300 * 200).map(|at| (at % 60_000) as u16).collect();
        let file = encode(&TAGS, &values).expect("encodes");
        let mut wire = Wire { answers: std::io::Cursor::new(answers), heard: Vec::new() };
        let outcome = store(&mut wire, &file, Duration::ZERO);
        let (mut heard, mut units) = (&wire.heard[..], Vec::new());
        while let Ok(unit) = read_unit(&mut heard) {
            units.push(unit);
        }
        let data = part_10(&file).expect("a head").data.to_vec();
        (outcome, units, data)
    }

    #[test]
    fn an_object_comes_in_pieces_that_its_receiver_takes_and_is_whole() {
        let (outcome, units, data) = stored(answers(0, 4096, 0));
        assert_eq!(outcome, Ok(0));
        let kinds: Vec<u8> = units.iter().map(|(kind, _)| *kind).collect();
        assert_eq!((kinds[0], kinds[1], kinds.last()), (ASSOCIATE_RQ, P_DATA, Some(&RELEASE_RQ)));
        assert_eq!(&units[0].1[4..36], b"SIDECARM        MOCKARM         ");
        let fragments = &units[2..units.len() - 1];
        assert!(fragments.len() > 20 && fragments.iter().all(|(kind, body)| *kind == P_DATA && body.len() <= 4096));
        let last: Vec<bool> = fragments.iter().map(|(_, body)| body[5] == IS_LAST).collect();
        assert!(last.iter().filter(|last| **last).count() == 1 && last.last() == Some(&true), "{last:?}");
        let sent: Vec<u8> = fragments.iter().flat_map(|(_, body)| body[6..].to_vec()).collect();
        assert!(sent == data && data.starts_with(&[8, 0]), "the data set, without its file's head");
        // The command says how long it is, and its status is found where there is one.
        let command = &units[1].1[6..];
        assert_eq!(u32::from_le_bytes([command[8], command[9], command[10], command[11]]) as usize, command.len() - 12);
        assert_eq!((status(command), status(&element(0x0900, &[0, 0xa7]))), (None, Some(0xa700)));
    }

    #[test]
    fn what_is_not_taken_is_said_with_its_reason() {
        let (outcome, units, _) = stored(answers(0, 0, 0xa700));
        assert_eq!(outcome, Ok(0xa700));
        assert_eq!(units.len(), 4 + 1, "two pieces of 64 KiB where there is no limit, request, command and release");
        for (answers, words) in [
            (answers(4, 4096, 0), "not taken: result 4"),
            (unit(ASSOCIATE_RJ, &[0, 1, 1, 7]), "rejected: result 1, source 1, reason 7"),
            (unit(7, &[0; 4]), "kind 7"),
            (Vec::new(), "no answer"),
        ] {
            let (outcome, units, _) = stored(answers);
            assert!(outcome.as_ref().is_err_and(|said| said.contains(words)), "{outcome:?}");
            assert_eq!(units.len(), 1, "nothing is sent that nobody takes");
        }
    }
}
