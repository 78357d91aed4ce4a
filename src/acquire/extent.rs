//! Lengths in a DICOM data set that its file cannot hold. The parser takes memory for a value before it reads it: four gigabytes for a
//! damaged length in a file of some hundred bytes.

use dicom_core::{Tag, VR};
use dicom_dictionary_std::tags;

const PREAMBLE_BYTES: usize = 132;
/// "Ends where its delimiter stands".
const UNDEFINED: u32 = u32::MAX;
/// Items of sequences and of compressed pixels, and their delimiters.
const ITEMS: u16 = 0xfffe;
const SEQUENCE_END: Tag = Tag(ITEMS, 0xe0dd);
const META: u16 = 0x0002;
/// Identifiers of syntaxes with compressed pixels begin so; two of them deflate the elements as well.
const COMPRESSED: &str = "1.2.840.10008.1.2.4.";
const DEFLATED_JPIP: &str = "1.2.840.10008.1.2.4.95";
const DEFLATED_HTJ2K_JPIP: &str = "1.2.840.10008.1.2.4.205";

/// How elements are written.
#[derive(Clone, Copy)]
struct Syntax {
    explicit: bool,
    big_endian: bool,
}

/// The head of an element.
struct Head {
    tag: Tag,
    vr: Option<VR>,
    length: u32,
}

/// Whether an element before `until` claims more bytes than follow it. What is not understood is left to the parser.
pub(super) fn claims_too_much(bytes: &[u8], until: Option<Tag>) -> bool {
    let mut rest = bytes.get(PREAMBLE_BYTES..).unwrap_or_default();
    let mut syntax = Syntax { explicit: true, big_endian: false };
    let (mut in_meta, mut transfer_syntax, mut in_fragments) = (true, &[][..], false);
    loop {
        if in_meta && !rest.starts_with(&META.to_le_bytes()) {
            in_meta = false;
            match Syntax::of(transfer_syntax) {
                Some(found) => syntax = found,
                None => return false,
            }
        }
        let Some((head, behind)) = syntax.head(rest) else { return false };
        // Those from `until` on are left out; one that lies within others ends the walk as well.
        if until.is_some_and(|until| head.tag.group() != ITEMS && until <= head.tag) {
            return false;
        }
        rest = behind;
        if head.length == UNDEFINED {
            // Whoever writes unknown elements of undefined length writes what is in them another way.
            if head.vr == Some(VR::UN) {
                return false;
            }
            in_fragments |= head.tag == tags::PIXEL_DATA;
            continue;
        }
        let Some((value, behind)) = rest.split_at_checked(head.length as usize) else { return true };
        if head.tag == tags::TRANSFER_SYNTAX_UID {
            transfer_syntax = value;
        }
        in_fragments &= head.tag != SEQUENCE_END;
        // Elements of sequences and their items come next.
        let is_nested = if head.tag.group() == ITEMS { !in_fragments } else { head.vr == Some(VR::SQ) };
        if !is_nested {
            rest = behind;
        }
    }
}

impl Syntax {
    /// Of a data set by its transfer syntax; `None` where it is deflated, or unknown.
    fn of(uid: &[u8]) -> Option<Self> {
        let explicit = Self { explicit: true, big_endian: false };
        match std::str::from_utf8(uid).ok()?.trim_end_matches(['\0', ' ']) {
            "1.2.840.10008.1.2" => Some(Self { explicit: false, ..explicit }),
            "1.2.840.10008.1.2.2" => Some(Self { big_endian: true, ..explicit }),
            "1.2.840.10008.1.2.1" | "1.2.840.10008.1.2.5" => Some(explicit),
            DEFLATED_JPIP | DEFLATED_HTJ2K_JPIP => None,
            other => other.starts_with(COMPRESSED).then_some(explicit),
        }
    }

    /// The next element's head, and what follows it; `None` at the end, or within a head.
    fn head(self, bytes: &[u8]) -> Option<(Head, &[u8])> {
        let word = |at: usize| Some(self.word(*bytes.get(at..)?.first_chunk()?));
        let long = |at: usize| Some(self.long(*bytes.get(at..)?.first_chunk()?));
        let tag = Tag(word(0)?, word(2)?);
        if !self.explicit || tag.group() == ITEMS {
            return Some((Head { tag, vr: None, length: long(4)? }, &bytes[8..]));
        }
        // As the parser has it: what is not known is unknown, and those have long lengths.
        let vr = VR::from_binary([*bytes.get(4)?, *bytes.get(5)?]).unwrap_or(VR::UN);
        if has_short_length(vr) {
            return Some((Head { tag, vr: Some(vr), length: u32::from(word(6)?) }, &bytes[8..]));
        }
        Some((Head { tag, vr: Some(vr), length: long(8)? }, &bytes[12..]))
    }

    fn word(self, two: [u8; 2]) -> u16 {
        if self.big_endian { u16::from_be_bytes(two) } else { u16::from_le_bytes(two) }
    }

    fn long(self, four: [u8; 4]) -> u32 {
        if self.big_endian { u32::from_be_bytes(four) } else { u32::from_le_bytes(four) }
    }
}

/// PS3.5 §7.1.2, table 7.1-2.
fn has_short_length(vr: VR) -> bool {
    use VR::{AE, AS, AT, CS, DA, DS, DT, FD, FL, IS, LO, LT, PN, SH, SL, SS, ST, TM, UI, UL, US};
    matches!(vr, AE | AS | AT | CS | DA | DS | DT | FD | FL | IS | LO | LT | PN | SH | SL | SS | ST | TM | UI | UL | US)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of that transfer syntax.
    fn file(transfer_syntax: &str, elements: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0u8; 128];
        bytes.extend(b"DICM");
        let uid = format!("{transfer_syntax}{}", if transfer_syntax.len() % 2 == 1 { "\0" } else { "" });
        bytes.extend([2, 0, 0x10, 0, b'U', b'I', uid.len() as u8, 0]);
        bytes.extend(uid.as_bytes());
        bytes.extend(elements);
        bytes
    }

    const EXPLICIT: &str = "1.2.840.10008.1.2.1";

    #[test]
    fn an_element_that_is_longer_than_its_file_is_found_wherever_it_stands() {
        let name = [0x10, 0, 0x10, 0, b'P', b'N', 2, 0, b'A', b'B'];
        let long = |length: u32| {
            let mut element = vec![0xe1, 0x7f, 0x10, 0x10, b'O', b'B', 0, 0];
            element.extend(length.to_le_bytes());
            element.extend([1, 2, 3, 4]);
            element
        };
        let claims = |elements: Vec<u8>| claims_too_much(&file(EXPLICIT, &elements), None);
        assert!(!claims([&name[..], &long(4)].concat()));
        assert!(claims([&name[..], &long(5)].concat()));
        assert!(claims([&long(4)[..], &long(4_000_000_000)].concat()));
        // In an item of undefined length within a sequence of undefined length, and of defined ones.
        let undefined =
            [0x08, 0, 0x40, 0x11, b'S', b'Q', 0, 0, 0xff, 0xff, 0xff, 0xff, 0xfe, 0xff, 0, 0xe0, 0xff, 0xff, 0xff, 0xff];
        let ends = [0xfe, 0xff, 0x0d, 0xe0, 0, 0, 0, 0, 0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0];
        assert!(!claims([&undefined[..], &long(4), &ends, &name].concat()));
        assert!(claims([&undefined[..], &long(4000), &ends, &name].concat()));
        let defined = [0x08, 0, 0x40, 0x11, b'S', b'Q', 0, 0, 24, 0, 0, 0, 0xfe, 0xff, 0, 0xe0, 16, 0, 0, 0];
        assert!(!claims([&defined[..], &long(4), &name].concat()));
        assert!(claims([&defined[..], &long(4000), &name].concat()));
        // A representation that nobody knows has a long length; one that is short stays short.
        assert!(claims(vec![0x28, 0, 3, 1, b'U', 0xd6, 0, 0, 0, 0, 0, 0x10]));
        assert!(claims(vec![0x10, 0, 0x10, 0, b'P', b'N', 3, 0, b'A', b'B']));
        // Nothing is parsed: the parser would first miss the rest of the meta information.
        let parse = |length: u32| super::super::dicom::parse(&file(EXPLICIT, &long(length)), None).map(drop);
        let fault = |detail: &str| Err(super::super::Fault::Dicom { detail: detail.to_owned() });
        assert_eq!(parse(4_000_000_000), fault("it ends early"));
        assert_eq!(parse(4), fault("in its file meta information"));
    }

    #[test]
    fn fragments_other_syntaxes_and_what_is_left_out_are_read_as_they_are() {
        // Two fragments whose content looks like anything.
        let mut fragments = vec![0xe0, 0x7f, 0x10, 0, b'O', b'B', 0, 0, 0xff, 0xff, 0xff, 0xff];
        for content in [&[0xff; 8][..], &[0x28, 0, 3, 1, b'U', b'N', 0, 0]] {
            fragments.extend([0xfe, 0xff, 0, 0xe0, content.len() as u8, 0, 0, 0]);
            fragments.extend(content);
        }
        fragments.extend([0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0]);
        assert!(!claims_too_much(&file("1.2.840.10008.1.2.4.50", &fragments), None));
        fragments[16] = 200;
        assert!(claims_too_much(&file("1.2.840.10008.1.2.4.50", &fragments), None));
        assert!(!claims_too_much(&file("1.2.840.10008.1.2.4.50", &fragments), Some(tags::PIXEL_DATA)));
        let implicit = |length: u8| file("1.2.840.10008.1.2", &[0x10, 0, 0x10, 0, length, 0, 0, 0, b'A', b'B']);
        assert!(!claims_too_much(&implicit(2), None) && claims_too_much(&implicit(3), None));
        let big = |length: u8| file("1.2.840.10008.1.2.2", &[0, 0x10, 0, 0x10, b'P', b'N', 0, length, b'A', b'B']);
        assert!(!claims_too_much(&big(2), None) && claims_too_much(&big(3), None));
        for deflated in ["1.2.840.10008.1.2.1.99", DEFLATED_JPIP, "1.2.840.113619.5.2"] {
            assert!(!claims_too_much(&file(deflated, &[1; 40]), None));
        }
        assert!(claims_too_much(&file(EXPLICIT, &[1; 40]), None), "the control");
        let name = [0x10, 0, 0x10, 0, 2, 0, 0, 0, b'A', b'B'];
        assert!(!claims_too_much(&file("1.2.840.10008.1.2\0\0\0", &name), None), "padded");
        // Unknown elements of undefined length hold what may be written otherwise.
        let unknown = [0x09, 0, 0x10, 0x10, b'U', b'N', 0, 0, 0xff, 0xff, 0xff, 0xff];
        assert!(!claims_too_much(&file(EXPLICIT, &[&unknown[..], &[1; 40]].concat()), None));
        // A file of which only the beginning is looked at, and which holds no pixels: what comes behind their place is not asked for.
        let private = [0xe1, 0x7f, 0x10, 0x10, b'O', b'B', 0, 0, 0, 0, 0, 1];
        assert!(claims_too_much(&file(EXPLICIT, &private), None));
        assert!(!claims_too_much(&file(EXPLICIT, &private), Some(tags::PIXEL_DATA)));
        assert!(!claims_too_much(b"DICM", None) && !claims_too_much(&[], None));
    }
}
