//! What can be wrong with a network or with what it is asked.

use std::path::PathBuf;

use super::TensorFault;
use crate::json::JsonFault;

/// Why a network cannot be loaded or does not answer.
#[derive(Debug, thiserror::Error)]
pub enum InferError {
    /// The device fails: it is lost, or has no memory left.
    #[error("{name}: {detail}; ask the network on the processor")]
    Device {
        /// Its name.
        name: String,
        /// What it said.
        detail: String,
    },
    /// One of the two files is missing or unreadable.
    #[error("network file {}: cannot be read ({source}); a network is NAME.safetensors with NAME.json beside it", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The card is no card.
    #[error("network card {}: {fault}; take the card that was written with the weights", path.display())]
    CardForm {
        /// The card.
        path: PathBuf,
        /// What is wrong, and where.
        fault: JsonFault,
    },
    /// A value of the card cannot be used.
    #[error("network card {}: {field} is {found}, expected {expected}; take the card that was written with the weights", path.display())]
    CardValue {
        /// The card.
        path: PathBuf,
        /// The key.
        field: String,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// The weights are not the ones the card speaks of: truncated, changed, or of another network.
    #[error(
        "network weights {}: sha256 is {found} over {byte_count} bytes, the card {} says {expected}; \
         copy both files again, or train anew",
        path.display(), card.display()
    )]
    Checksum {
        /// The weights.
        path: PathBuf,
        /// The card.
        card: PathBuf,
        /// Of the card.
        expected: String,
        /// Of the file.
        found: String,
        /// Length of the file.
        byte_count: usize,
    },
    /// The weights do not fit the architecture.
    #[error("network weights {}: {fault}; they do not fit the architecture their card names, train anew", path.display())]
    Weights {
        /// The weights.
        path: PathBuf,
        /// What is wrong.
        fault: TensorFault,
    },
    /// The network was trained for other inputs than the program computes.
    #[error(
        "network card {}: {what} are [{}], this program computes [{}]; use a network trained by this version, or train anew",
        path.display(), found.join(", "), expected.join(", ")
    )]
    Names {
        /// The card.
        path: PathBuf,
        /// `channels` or `scalars`.
        what: &'static str,
        /// Names the program computes, in order.
        expected: Vec<String>,
        /// Names of the card, in order.
        found: Vec<String>,
    },
    /// An input has another number of values than the network takes.
    #[error("network input `{what}` has {found} values, the network takes {expected}")]
    InputLength {
        /// Which input.
        what: &'static str,
        /// Values the network takes.
        expected: usize,
        /// Values given.
        found: usize,
    },
    /// The rough guess of the mean scatter is no positive number, so nothing can be predicted from it.
    #[error("network input `scale` is {found}, expected a finite number above 0")]
    Scale {
        /// What was given.
        found: f32,
    },
}
