//! All that nobody states of a picture and that moves places beside its beads: what bends it, and K where the header alone says it.

use super::nuisance::{Nuisance, Word};
use super::request::Registration;
use super::settle::Settled;
use super::unstated_k::heard_of_k;
use super::unstated_lens::heard_of_lens;

/// Of a match, and what is said of it. Each counts by itself, as if all else were known.
pub(super) fn unstated(request: &Registration, settled: &Settled) -> (Vec<Nuisance>, Vec<Word>) {
    let (lens, bends) = heard_of_lens(request, settled);
    let (k, moves) = heard_of_k(request, settled);
    (lens.into_iter().chain(k).collect(), bends.into_iter().chain(moves).collect())
}
