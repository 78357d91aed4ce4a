//! The smallest lossless form of a frame's pixels.

use crate::image::Image;

/// Pixels as they are logged: 16-bit integers when that loses nothing, floats otherwise. Row-major.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// Every pixel is an integer in 0..=65535.
    U16(Vec<u16>),
    /// Anything else.
    F32(Vec<f32>),
}

impl Samples {
    /// The smallest form that gives back `pixels` bit for bit (−0 is kept as a float).
    #[must_use]
    pub fn from_pixels(pixels: &[f32]) -> Self {
        let exact = |value: f32| {
            let integer = value as u16;
            (f32::from(integer).to_bits() == value.to_bits()).then_some(integer)
        };
        match pixels.iter().map(|&value| exact(value)).collect::<Option<Vec<u16>>>() {
            Some(integers) => Self::U16(integers),
            None => Self::F32(pixels.to_vec()),
        }
    }

    /// The Foxglove `RawImage` encoding: `mono16` or `32FC1`.
    #[must_use]
    pub fn encoding(&self) -> &'static str {
        match self {
            Self::U16(_) => "mono16",
            Self::F32(_) => "32FC1",
        }
    }

    /// Bytes per pixel.
    #[must_use]
    pub fn stride_bytes(&self) -> usize {
        match self {
            Self::U16(_) => 2,
            Self::F32(_) => 4,
        }
    }

    /// Little-endian bytes, row by row without padding.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::U16(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
            Self::F32(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        }
    }

    /// Reads what [`Samples::to_bytes`] wrote, and 8-bit pictures; `None` when `encoding` is another one or the byte count does not fit.
    #[must_use]
    pub fn from_bytes(encoding: &str, bytes: &[u8]) -> Option<Self> {
        match encoding {
            // Pictures for the eye.
            "mono8" => Some(Self::U16(bytes.iter().copied().map(u16::from).collect())),
            "mono16" if bytes.len().is_multiple_of(2) => {
                Some(Self::U16(bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect()))
            }
            "32FC1" if bytes.len().is_multiple_of(4) => Some(Self::F32(
                bytes.chunks_exact(4).map(|four| f32::from_le_bytes([four[0], four[1], four[2], four[3]])).collect(),
            )),
            _ => None,
        }
    }

    /// Back to an image of `width` × `height`; `None` when the count does not fit.
    #[must_use]
    pub fn into_image(self, width: usize, height: usize) -> Option<Image<f32>> {
        let pixels = match self {
            Self::U16(values) => values.into_iter().map(f32::from).collect(),
            Self::F32(values) => values,
        };
        Image::from_pixels(width, height, pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_form_is_bit_exact() {
        let cases: [(&[f32], &str); 5] = [
            (&[0.0, 1.0, 65535.0], "mono16"),
            (&[0.0, 0.5], "32FC1"),
            (&[65536.0], "32FC1"),
            (&[-0.0, 1.0], "32FC1"),
            (&[-1.0], "32FC1"),
        ];
        for (pixels, encoding) in cases {
            let samples = Samples::from_pixels(pixels);
            assert_eq!(samples.encoding(), encoding, "{pixels:?}");
            let back = Samples::from_bytes(encoding, &samples.to_bytes()).expect("own bytes are read");
            let image = back.into_image(pixels.len(), 1).expect("the count fits");
            assert!(image.pixels.iter().zip(pixels).all(|(a, b)| a.to_bits() == b.to_bits()), "{pixels:?}");
        }
        assert!(Samples::from_bytes("mono16", &[1, 2, 3]).is_none());
        assert!(Samples::from_bytes("rgb8", &[1, 2, 3]).is_none());
    }
}
