//! DIMSE commands: elements of group 0000 in implicit VR, little-endian (PS3.7 §6.3.1 and annex E). Bytes in, bytes out.

/// Fields of a command (PS3.7 §E.1).
const AFFECTED_CLASS: u16 = 0x0002;
const COMMAND_FIELD: u16 = 0x0100;
const MESSAGE_ID: u16 = 0x0110;
const RESPONDED_TO: u16 = 0x0120;
const DATA_SET_TYPE: u16 = 0x0800;
const STATUS: u16 = 0x0900;
const AFFECTED_INSTANCE: u16 = 0x1000;
/// No data set follows.
const NO_DATA_SET: u16 = 0x0101;
const C_STORE: u16 = 0x0001;
const C_ECHO: u16 = 0x0030;
/// What a response adds to its request's field.
const RESPONSE: u16 = 0x8000;
/// Longest unique identifier.
const MOST_UID: usize = 64;

/// How a request ended (PS3.7 annex C, PS3.4 §B.2.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// Done.
    Success,
    /// The SOP class is not the one that was agreed on.
    ClassNotSupported,
    /// There is no such operation here.
    Unrecognized,
    /// There is no room.
    OutOfResources,
    /// An identifier is none.
    CannotUnderstand,
}

impl Outcome {
    fn code(self) -> u16 {
        match self {
            Self::Success => 0x0000,
            Self::ClassNotSupported => 0x0122,
            Self::Unrecognized => 0x0211,
            Self::OutOfResources => 0xa700,
            Self::CannotUnderstand => 0xc000,
        }
    }
}

/// A request as it came.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Request {
    field: u16,
    message: u16,
    /// SOP class.
    pub(super) class: String,
    /// SOP instance; empty where there is none.
    pub(super) instance: String,
    /// Whether a data set follows.
    pub(super) has_data: bool,
}

impl Request {
    /// Reads a whole command; `None` where it is none, or a response.
    pub(super) fn parse(bytes: &[u8]) -> Option<Self> {
        let mut request = Self { field: RESPONSE, message: 0, class: String::new(), instance: String::new(), has_data: false };
        let mut rest = bytes;
        while !rest.is_empty() {
            let (head, behind) = rest.split_first_chunk::<8>()?;
            let [group, element] = [0, 2].map(|at| u16::from_le_bytes([head[at], head[at + 1]]));
            let length = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
            let (value, behind) = behind.split_at_checked(usize::try_from(length).ok()?)?;
            rest = behind;
            if group != 0 {
                return None;
            }
            let number = || value.first_chunk::<2>().map(|pair| u16::from_le_bytes(*pair));
            match element {
                COMMAND_FIELD => request.field = number()?,
                MESSAGE_ID => request.message = number()?,
                DATA_SET_TYPE => request.has_data = number()? != NO_DATA_SET,
                AFFECTED_CLASS => request.class = uid(value),
                AFFECTED_INSTANCE => request.instance = uid(value),
                _ => {}
            }
        }
        (request.field & RESPONSE == 0).then_some(request)
    }

    pub(super) fn is_echo(&self) -> bool {
        self.field == C_ECHO
    }

    pub(super) fn is_store(&self) -> bool {
        self.field == C_STORE
    }

    /// Whether class and instance are identifiers by their form, so that they can stand in a file's head.
    pub(super) fn is_identified(&self) -> bool {
        let is_uid =
            |text: &str| (1..=MOST_UID).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
        is_uid(&self.class) && is_uid(&self.instance)
    }

    /// The response to it, a whole command.
    pub(super) fn response(&self, outcome: Outcome) -> Vec<u8> {
        let mut body = Vec::new();
        put_uid(&mut body, AFFECTED_CLASS, &self.class);
        put(&mut body, COMMAND_FIELD, &(self.field | RESPONSE).to_le_bytes());
        put(&mut body, RESPONDED_TO, &self.message.to_le_bytes());
        put(&mut body, DATA_SET_TYPE, &NO_DATA_SET.to_le_bytes());
        put(&mut body, STATUS, &outcome.code().to_le_bytes());
        put_uid(&mut body, AFFECTED_INSTANCE, &self.instance);
        let mut bytes = Vec::new();
        put(&mut bytes, 0, &(body.len() as u32).to_le_bytes());
        bytes.extend(body);
        bytes
    }
}

fn uid(value: &[u8]) -> String {
    String::from_utf8_lossy(value).trim_matches(['\0', ' ']).to_owned()
}

fn put(out: &mut Vec<u8>, element: u16, value: &[u8]) {
    out.extend([0, 0]);
    out.extend(element.to_le_bytes());
    out.extend((value.len() as u32).to_le_bytes());
    out.extend(value);
}

/// An identifier of an even number of bytes; none where it is empty.
fn put_uid(out: &mut Vec<u8>, element: u16, uid: &str) {
    let mut value = uid.as_bytes().to_vec();
    if !value.len().is_multiple_of(2) {
        value.push(0);
    }
    if !value.is_empty() {
        put(out, element, &value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn store() -> Vec<u8> {
        let mut bytes = Vec::new();
        put_uid(&mut bytes, AFFECTED_CLASS, "1.2.3");
        put(&mut bytes, COMMAND_FIELD, &C_STORE.to_le_bytes());
        put(&mut bytes, MESSAGE_ID, &[9, 0]);
        put(&mut bytes, DATA_SET_TYPE, &[0, 0]);
        put_uid(&mut bytes, AFFECTED_INSTANCE, "1.2.3.44");
        bytes
    }

    #[test]
    fn a_request_is_read_and_answered_in_its_own_words() {
        let request = Request::parse(&store()).expect("a request");
        assert!(request.is_store() && request.has_data && request.is_identified());
        let response = request.response(Outcome::OutOfResources);
        assert_eq!(response[..12], [0, 0, 0, 0, 4, 0, 0, 0, (response.len() - 12) as u8, 0, 0, 0]);
        // (0000,0002) "1.2.3\0", (0000,0100) 8001H, (0000,0120) 9 …
        assert_eq!(response[12..20], [0, 0, 2, 0, 6, 0, 0, 0]);
        assert_eq!(response[26..36], [0, 0, 0, 1, 2, 0, 0, 0, 1, 0x80]);
        assert_eq!(response[36..46], [0, 0, 0x20, 1, 2, 0, 0, 0, 9, 0]);
        assert!(Request::parse(&response).is_none(), "a response is no request");
    }

    #[test]
    fn what_is_cut_or_of_another_group_is_none() {
        let bytes = store();
        let whole: Vec<usize> = (0..bytes.len()).filter(|end| Request::parse(&bytes[..*end]).is_some()).collect();
        // Elements are optional, half ones are not: behind the command's field each whole element ends a command.
        assert_eq!(whole.len(), 3, "{whole:?}");
        let mut other = bytes.clone();
        other[0] = 8;
        assert!(Request::parse(&other).is_none());
        let odd = Request { instance: "1.2/../3".to_owned(), ..Request::parse(&bytes).expect("a request") };
        assert!(!odd.is_identified());
    }
}
