//! Pixels that a console filled in where the panel saw nothing: they carry a value of their own and no measurement.

use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;

/// Stored values that mark padding, before rescaling (PS3.3 C.7.5.1.1.2): the padding value, or all from it to its limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Padding {
    low: i64,
    high: i64,
}

impl Padding {
    /// What the header says; `signed` is its pixel representation, which both values have.
    pub(super) fn of(object: &InMemDicomObject, signed: bool, notes: &mut Vec<String>) -> Option<Self> {
        let mut read = |tag, name: &str| {
            let element = object.get(tag)?;
            // Writers put 63536 for −2000, and implicit files do not say which was meant: the sixteen bits count.
            match element.to_int::<i32>().ok().filter(|value| (-0x8000..=0xffff).contains(value)) {
                Some(value) if signed => Some(i64::from(value as u16 as i16)),
                Some(value) => Some(i64::from(value as u16)),
                None => {
                    notes.push(format!("{name} is not a number of sixteen bits and was ignored: no pixels are masked by it"));
                    None
                }
            }
        };
        let value = read(tags::PIXEL_PADDING_VALUE, "pixel padding value (0028,0120)");
        let limit = read(tags::PIXEL_PADDING_RANGE_LIMIT, "pixel padding range limit (0028,0121)");
        match (value, limit) {
            (Some(value), Some(limit)) => Some(Self { low: value.min(limit), high: value.max(limit) }),
            (Some(value), None) => Some(Self { low: value, high: value }),
            (None, Some(_)) => {
                notes.push("a pixel padding range limit (0028,0121) without a padding value (0028,0120) was ignored".into());
                None
            }
            (None, None) => None,
        }
    }

    /// Whether a pixel of this stored value is padding.
    pub(super) fn holds(self, stored: i64) -> bool {
        (self.low..=self.high).contains(&stored)
    }

    /// A sentence on what is masked.
    pub(super) fn words(self) -> String {
        let Self { low, high } = self;
        if low == high {
            format!("pixels of the stored value {low} are masked: it is the pixel padding value (0028,0120)")
        } else {
            format!("pixels of the stored values {low} to {high} are masked: they are pixel padding (0028,0120 and 0028,0121)")
        }
    }
}

#[cfg(test)]
mod tests {
    use dicom_core::{DataElement, PrimitiveValue, VR};

    use super::*;

    fn padding(value: Option<PrimitiveValue>, limit: Option<PrimitiveValue>, signed: bool) -> (Option<Padding>, usize) {
        let mut object = InMemDicomObject::new_empty();
        for (tag, value) in [(tags::PIXEL_PADDING_VALUE, value), (tags::PIXEL_PADDING_RANGE_LIMIT, limit)] {
            if let Some(value) = value {
                object.put(DataElement::new(tag, VR::US, value));
            }
        }
        let mut notes = Vec::new();
        (Padding::of(&object, signed, &mut notes), notes.len())
    }

    #[test]
    fn values_are_read_as_the_pixels_are() {
        let both = |low, high| (Some(Padding { low, high }), 0);
        assert_eq!(padding(Some(63536u16.into()), None, false), both(63536, 63536));
        assert_eq!(padding(Some(63536u16.into()), None, true), both(-2000, -2000));
        assert_eq!(padding(Some((-2000i16).into()), None, true), both(-2000, -2000));
        assert_eq!(padding(Some((-2000i16).into()), None, false), both(63536, 63536));
        assert_eq!(padding(Some(0u16.into()), Some(16u16.into()), false), both(0, 16));
        assert_eq!(padding(Some(4095u16.into()), Some(4000u16.into()), false), both(4000, 4095), "from the upper end down");
        assert_eq!(padding(None, None, true), (None, 0));
    }

    #[test]
    fn what_cannot_be_used_is_said() {
        assert_eq!(padding(None, Some(16u16.into()), false), (None, 1));
        assert_eq!(padding(Some(PrimitiveValue::from("none")), None, false), (None, 1));
        assert_eq!(padding(Some(70_000u32.into()), None, false), (None, 1));
    }
}
