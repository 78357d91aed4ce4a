//! Beads get names: by their place in a list, or numbers from the feet up.

use std::collections::BTreeSet;

use super::ct_bead::CtBead;
use crate::beads::BeadLayout;

/// Beads with names, in their final order.
pub(super) struct Named {
    pub beads: Vec<CtBead>,
    /// Names of the list without a bead.
    pub without_bead: Vec<String>,
    pub notes: Vec<String>,
}

/// Names `beads`: pairs of bead and listed place within `tolerance_mm`, nearest first, each used once; the others are numbered by
/// height, then from back to front, then from right to left. Listed beads come first, in the order of the list.
pub(super) fn name(mut beads: Vec<CtBead>, list: Option<&BeadLayout>, tolerance_mm: f64) -> Named {
    beads.sort_by(|a, b| {
        (0..3)
            .rev()
            .map(|axis| a.lps_mm[axis].total_cmp(&b.lps_mm[axis]))
            .find(|o| o.is_ne())
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    let listed = list.map_or(&[][..], |list| &list.beads);
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (at, bead) in beads.iter().enumerate() {
        for (place, known) in listed.iter().enumerate() {
            let apart_mm = known.lps_mm.distance(bead.centre());
            if apart_mm <= tolerance_mm {
                pairs.push((apart_mm, place, at));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut place_of: Vec<Option<usize>> = vec![None; beads.len()];
    let mut taken = BTreeSet::new();
    for (_, place, at) in &pairs {
        if place_of[*at].is_none() && taken.insert(*place) {
            place_of[*at] = Some(*place);
        }
    }
    let mut notes = Vec::new();
    for (_, place, at) in &pairs {
        if place_of[*at] != Some(*place) && place_of[*at].is_none() {
            let name = &listed[*place].name;
            notes.push(format!("two beads lie within {tolerance_mm} mm of {name}: the nearer one has the name"));
        }
    }
    let names: BTreeSet<&str> = listed.iter().map(|bead| bead.name.as_str()).collect();
    let digits = beads.len().to_string().len().max(2);
    let mut numbers = (1..).map(|number| format!("bead-{number:0digits$}")).filter(|name| !names.contains(name.as_str()));
    for (bead, place) in beads.iter_mut().zip(&place_of) {
        match place {
            Some(place) => {
                let known = &listed[*place];
                bead.name.clone_from(&known.name);
                bead.body.clone_from(&known.body);
            }
            None => bead.name = numbers.next().unwrap_or_default(),
        }
    }
    let mut order: Vec<usize> = (0..beads.len()).collect();
    order.sort_by_key(|at| place_of[*at].unwrap_or(usize::MAX));
    let ordered = order.iter().map(|at| beads[*at].clone()).collect();
    let without_bead = (0..listed.len()).filter(|place| !taken.contains(place)).map(|place| listed[place].name.clone()).collect();
    Named { beads: ordered, without_bead, notes }
}
