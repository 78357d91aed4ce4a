//! The dictionaries of tags.

/// A family of tags, by the name that the AprilTag library gives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Family {
    /// 16 bits, Hamming distance 5: many accidental readings.
    #[serde(rename = "tag16h5")]
    Tag16h5,
    /// 25 bits.
    #[serde(rename = "tag25h9")]
    Tag25h9,
    /// 36 bits: the usual one.
    #[serde(rename = "tag36h11")]
    Tag36h11,
    /// Round, 21 bits.
    #[serde(rename = "tagCircle21h7")]
    TagCircle21h7,
    /// Round, 49 bits.
    #[serde(rename = "tagCircle49h12")]
    TagCircle49h12,
    /// 41 bits, some outside the border.
    #[serde(rename = "tagStandard41h12")]
    TagStandard41h12,
    /// 52 bits, some outside the border.
    #[serde(rename = "tagStandard52h13")]
    TagStandard52h13,
    /// 48 bits around an empty middle.
    #[serde(rename = "tagCustom48h12")]
    TagCustom48h12,
}

impl Family {
    /// All that can be read.
    pub const ALL: [Self; 8] = [
        Self::Tag16h5,
        Self::Tag25h9,
        Self::Tag36h11,
        Self::TagCircle21h7,
        Self::TagCircle49h12,
        Self::TagStandard41h12,
        Self::TagStandard52h13,
        Self::TagCustom48h12,
    ];

    /// The word used in files and on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Tag16h5 => "tag16h5",
            Self::Tag25h9 => "tag25h9",
            Self::Tag36h11 => "tag36h11",
            Self::TagCircle21h7 => "tagCircle21h7",
            Self::TagCircle49h12 => "tagCircle49h12",
            Self::TagStandard41h12 => "tagStandard41h12",
            Self::TagStandard52h13 => "tagStandard52h13",
            Self::TagCustom48h12 => "tagCustom48h12",
        }
    }

    /// Number of tags: ids run from 0 to one less.
    #[must_use]
    pub fn count(self) -> u32 {
        match self {
            Self::Tag16h5 => 30,
            Self::Tag25h9 => 35,
            Self::Tag36h11 => 587,
            Self::TagCircle21h7 => 38,
            Self::TagCircle49h12 => 65_535,
            Self::TagStandard41h12 => 2_115,
            Self::TagStandard52h13 => 48_714,
            Self::TagCustom48h12 => 42_211,
        }
    }

    /// Wrong bits that are put right. None where the codes lie close together, and none in the families of many codes, whose table of
    /// neighbours would take hundreds of megabytes.
    #[must_use]
    pub fn corrected_bits(self) -> usize {
        match self {
            Self::Tag25h9 | Self::Tag36h11 | Self::TagCircle21h7 | Self::TagStandard41h12 => 1,
            Self::Tag16h5 | Self::TagCircle49h12 | Self::TagStandard52h13 | Self::TagCustom48h12 => 0,
        }
    }
}

impl std::fmt::Display for Family {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Family {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        let known = || Self::ALL.map(Self::as_str).join(", ");
        Self::ALL
            .into_iter()
            .find(|family| family.as_str() == word)
            .ok_or_else(|| format!("tag family '{word}' is not one of {}", known()))
    }
}
