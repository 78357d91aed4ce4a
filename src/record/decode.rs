//! From log entries back to values.

use foxglove::Decode;
use foxglove::messages as fg;

use super::messages::encoded;
use super::{LogEntry, RecordError, topic};
use crate::acquire::{Frame, Samples};
use crate::image::{Image, sha256_bytes};

/// One read from a serial line, as it was recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RawBytes<'a> {
    /// Counts the openings of the line.
    pub epoch: u32,
    /// The bytes.
    pub bytes: &'a [u8],
}

impl LogEntry {
    /// Reads a JSON message.
    ///
    /// # Errors
    /// When the message is no JSON or not of type `T`.
    pub fn json<T: serde::de::DeserializeOwned>(&self) -> Result<T, RecordError> {
        serde_json::from_slice(&self.data).map_err(|error| self.wrong(error.to_string()))
    }

    /// Reads raw serial bytes; `None` on other topics.
    ///
    /// # Errors
    /// When the message is shorter than its epoch.
    pub fn raw_bytes(&self) -> Result<Option<RawBytes<'_>>, RecordError> {
        if &*self.schema != super::channel::RAW_SCHEMA {
            return Ok(None);
        }
        match self.data.split_first_chunk::<4>() {
            Some((epoch, bytes)) => Ok(Some(RawBytes { epoch: u32::from_le_bytes(*epoch), bytes })),
            None => Err(self.wrong(format!("raw bytes of {} bytes, expected at least 4", self.data.len()))),
        }
    }

    /// Reads a `foxglove.RawImage` of encoding `mono16` or `32FC1`; `None` for other messages.
    ///
    /// # Errors
    /// When the message is damaged or its byte count does not fit its size.
    pub fn image(&self) -> Result<Option<Image<f32>>, RecordError> {
        if &*self.schema != "foxglove.RawImage" {
            return Ok(None);
        }
        let message: fg::RawImage = self.decoded()?;
        let (width, height) = (message.width as usize, message.height as usize);
        let image = Samples::from_bytes(&message.encoding, &message.data).and_then(|samples| samples.into_image(width, height));
        let misfit = || self.wrong(format!("{} bytes of {} for {width}x{height} pixels", message.data.len(), message.encoding));
        image.map(Some).ok_or_else(misfit)
    }

    /// Text of an event on `/events`; `None` for other messages.
    ///
    /// # Errors
    /// When the message is damaged.
    pub fn event(&self) -> Result<Option<String>, RecordError> {
        if &*self.schema != "foxglove.Log" {
            return Ok(None);
        }
        Ok(Some(self.decoded::<fg::Log>()?.message))
    }

    /// Reads the message as its schema promises, and throws the result away.
    ///
    /// # Errors
    /// When it is damaged.
    pub fn check(&self) -> Result<(), RecordError> {
        match (&*self.schema, &*self.encoding) {
            (super::channel::RAW_SCHEMA, _) => self.raw_bytes().map(|_| ()),
            ("foxglove.RawImage", _) => self.image().map(|_| ()),
            ("foxglove.Log", _) => self.event().map(|_| ()),
            ("foxglove.CameraCalibration", _) => self.decoded::<fg::CameraCalibration>().map(|_| ()),
            ("foxglove.FrameTransforms", _) => self.decoded::<fg::FrameTransforms>().map(|_| ()),
            ("foxglove.ImageAnnotations", _) => self.decoded::<fg::ImageAnnotations>().map(|_| ()),
            ("foxglove.JointStates", _) => self.decoded::<fg::JointStates>().map(|_| ()),
            (_, "json") => self.json::<serde::de::IgnoredAny>().map(|_| ()),
            _ => Ok(()),
        }
    }

    /// The same with its words passed through `word`: what is written beside the beads on [`topic::ANNOTATIONS`], what was told on
    /// [`topic::EVENTS`]. Other messages stay as they are.
    ///
    /// # Errors
    /// When the message is damaged.
    pub fn reworded(&self, word: &dyn Fn(&str) -> String) -> Result<Self, RecordError> {
        let data = match &*self.schema {
            "foxglove.ImageAnnotations" => {
                let mut message: fg::ImageAnnotations = self.decoded()?;
                message.texts.iter_mut().for_each(|text| text.text = word(&text.text));
                encoded(&message)
            }
            "foxglove.Log" => {
                let mut message: fg::Log = self.decoded()?;
                message.message = word(&message.message);
                encoded(&message)
            }
            _ => self.data.clone(),
        };
        Ok(Self { data, ..self.clone() })
    }

    fn decoded<M: Decode>(&self) -> Result<M, RecordError> {
        M::decode(self.data.as_slice()).map_err(|error| self.wrong(error.to_string()))
    }

    /// What is wrong with the message.
    fn wrong(&self, detail: String) -> RecordError {
        RecordError::Message { topic: self.topic.to_string(), sequence: self.sequence, detail }
    }
}

/// Joins the two messages that an acquired frame is logged as.
#[derive(Debug, Default)]
pub struct FrameAssembler {
    tags: Option<(Frame, MessageHash)>,
}

/// What the tags say of the message with the pixels; nothing in logs of earlier versions.
#[derive(Debug, serde::Deserialize)]
struct MessageHash {
    message_sha256: Option<String>,
}

impl FrameAssembler {
    /// Takes any entry in log order; gives the frame once its pixels have come, bit for bit as it was acquired.
    ///
    /// # Errors
    /// When tags or pixels are damaged, pixels come without tags or are not those that were recorded, or their sizes differ.
    pub fn push(&mut self, entry: &LogEntry) -> Result<Option<Frame>, RecordError> {
        match &*entry.topic {
            topic::FRAME_TAGS => {
                // Damaged tags must not leave earlier ones for these pixels.
                self.tags = None;
                self.tags = Some((entry.json()?, entry.json()?));
                Ok(None)
            }
            topic::FRAME_PIXELS => {
                let (mut frame, hash) = self.tags.take().ok_or_else(|| entry.wrong("pixels without their tags".into()))?;
                if hash.message_sha256.is_some_and(|recorded| recorded != sha256_bytes(&entry.data)) {
                    return Err(entry.wrong(format!("the pixels of frame {} are not those that were recorded", frame.number)));
                }
                let pixels = entry.image()?.ok_or_else(|| entry.wrong(format!("schema {} is no image", entry.schema)))?;
                if frame.size_px != [pixels.width, pixels.height] {
                    let [width, height] = frame.size_px;
                    let found = format!("{}x{} pixels, its tags say {width}x{height}", pixels.width, pixels.height);
                    return Err(entry.wrong(found));
                }
                frame.pixels = pixels;
                Ok(Some(frame))
            }
            _ => Ok(None),
        }
    }
}
