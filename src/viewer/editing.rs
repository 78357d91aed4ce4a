//! Beads that are edited by hand in the window: what is chosen, where it is dragged to, and what is asked of the session. Nothing is changed
//! here: the session solves, judges and logs, and the window shows what comes of it.

use glam::DVec2;

use crate::session::board::PairView;
use crate::session::edit::{BeadEdit, EditRequest};

/// What a key asks for while beads are edited.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EditCommand {
    /// Begins, or ends.
    Toggle,
    /// Ends.
    Leave,
    /// Chooses the bead or shadow so many further.
    Next(isize),
    /// Puts a bead under the cursor.
    Add,
    /// Says that the chosen shadow is no bead's.
    Drop,
    /// Gives what is chosen the nth of the names that are listed, from 0.
    Name(usize),
    /// Moves what is chosen by columns and rows, px; nothing is asked yet.
    Nudge([f64; 2]),
    /// Puts the chosen bead where it was moved to.
    Put,
    /// Takes the latest edit of this exposure back.
    Undo,
}

/// Names that are listed: as many as there are digits.
const MOST_NAMES: usize = 9;
/// A mark of another look at the exposure is the chosen one within this, px.
const SAME_PX: f64 = 4.0;
/// Shorter drags are clicks of an unsteady hand, px.
const LEAST_MOVE_PX: f64 = 0.25;

/// A bead, or a shadow that is no bead's.
#[derive(Clone, Debug, PartialEq)]
pub struct Chosen {
    /// Where it is, px of the frame.
    pub image_px: [f64; 2],
    /// Its name.
    pub bead: Option<String>,
    /// How far it has been moved, px.
    pub moved_px: [f64; 2],
}

impl Chosen {
    /// Where it is shown.
    #[must_use]
    pub fn now_px(&self) -> [f64; 2] {
        [self.image_px[0] + self.moved_px[0], self.image_px[1] + self.moved_px[1]]
    }
}

/// See the module.
#[derive(Debug, Default)]
pub struct Editing {
    on: bool,
    /// The newest exposure was followed before.
    follows: bool,
    chosen: Option<Chosen>,
    dragging: bool,
    /// Exposure and development at the last look.
    looked_at: Option<(u32, u32)>,
    asked: Vec<EditRequest>,
}

impl Editing {
    /// Whether beads are edited.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.on
    }

    /// What is chosen.
    #[must_use]
    pub fn chosen(&self) -> Option<&Chosen> {
        self.chosen.as_ref()
    }

    /// What was asked since this was last called.
    pub fn take_asked(&mut self) -> Vec<EditRequest> {
        std::mem::take(&mut self.asked)
    }

    /// Begins with an exposure; `follows`: it is shown because it is the newest.
    pub(super) fn begin(&mut self, follows: bool) {
        *self = Self { on: true, follows, asked: std::mem::take(&mut self.asked), ..Self::default() };
    }

    /// Ends; whether the newest exposure was followed before.
    pub(super) fn end(&mut self) -> bool {
        let follows = self.follows;
        *self = Self { asked: std::mem::take(&mut self.asked), ..Self::default() };
        follows
    }

    /// Looks at the exposure shown: what is chosen follows a new pose of it, and is left where another is shown.
    pub(super) fn look_at(&mut self, pair: &PairView) {
        let now = (pair.number(), pair.development);
        let before = self.looked_at.replace(now);
        if before == Some(now) {
            return;
        }
        let chosen = self.chosen.take().filter(|_| before.is_some_and(|(number, _)| number == pair.number()));
        self.dragging &= chosen.is_some();
        self.chosen = chosen.map(|chosen| match nearest(pair, chosen.image_px, SAME_PX) {
            Some(found) => Chosen { moved_px: chosen.moved_px, ..found },
            None => chosen,
        });
    }

    /// Chooses the bead or shadow next to `at` within `reach_px`; none where there is none.
    pub(super) fn choose_at(&mut self, pair: &PairView, at: [f64; 2], reach_px: f64) {
        self.chosen = nearest(pair, at, reach_px);
    }

    /// A drag begins at `at`; whether it moves a bead.
    pub(super) fn drag_from(&mut self, pair: &PairView, at: [f64; 2], reach_px: f64) {
        self.choose_at(pair, at, reach_px);
        self.dragging = self.chosen.is_some();
    }

    /// Whether a drag moves a bead.
    pub(super) fn is_dragging(&self) -> bool {
        self.dragging
    }

    /// The drag goes on, or ends and puts the bead where it is.
    pub(super) fn drag(&mut self, by_px: [f64; 2], ends: bool, pair: &PairView) {
        self.nudge(by_px);
        if ends {
            self.dragging = false;
            self.put(pair);
        }
    }

    /// Does what a key asks for, of the exposure shown; `cursor_px` is what lies under the cursor.
    pub(super) fn run(&mut self, command: EditCommand, pair: &PairView, cursor_px: Option<[f64; 2]>) {
        match command {
            EditCommand::Toggle | EditCommand::Leave => {}
            EditCommand::Next(by) => self.next(pair, by),
            EditCommand::Add => self.add(pair, cursor_px),
            EditCommand::Drop => {
                if let Some(chosen) = self.chosen.take() {
                    self.ask(pair, BeadEdit::Drop { image_px: DVec2::from_array(chosen.image_px) });
                }
            }
            EditCommand::Name(n) => {
                let Some((chosen, bead)) = self.chosen.clone().and_then(|chosen| {
                    let bead = names(pair, chosen.image_px).into_iter().nth(n)?;
                    Some((chosen, bead))
                }) else {
                    return;
                };
                self.chosen = Some(Chosen { bead: Some(bead.clone()), ..chosen.clone() });
                self.ask(pair, BeadEdit::Name { bead, image_px: DVec2::from_array(chosen.image_px) });
            }
            EditCommand::Nudge(by) => self.nudge(by),
            EditCommand::Put => self.put(pair),
            EditCommand::Undo => {
                self.chosen = None;
                self.ask(pair, BeadEdit::Undo);
            }
        }
    }

    /// A note about a frame goes to the session as edits do.
    pub(super) fn ask_note(&mut self, number: u32, words: String) {
        self.asked.push(EditRequest { number, edit: BeadEdit::Note { words } });
    }

    fn ask(&mut self, pair: &PairView, edit: BeadEdit) {
        self.asked.push(EditRequest { number: pair.number(), edit });
    }

    fn nudge(&mut self, [du, dv]: [f64; 2]) {
        if let Some(chosen) = &mut self.chosen {
            chosen.moved_px = [chosen.moved_px[0] + du, chosen.moved_px[1] + dv];
        }
    }

    fn next(&mut self, pair: &PairView, by: isize) {
        let places = places(pair);
        let is_chosen = |place: &Chosen| self.chosen.as_ref().is_some_and(|chosen| chosen.image_px == place.image_px);
        let at = match (places.iter().position(is_chosen), by) {
            (Some(at), _) => (at as isize + by).rem_euclid(places.len().max(1) as isize),
            (None, by) if by < 0 => places.len() as isize - 1,
            (None, _) => 0,
        };
        self.chosen = usize::try_from(at).ok().and_then(|at| places.into_iter().nth(at));
    }

    /// The first free name goes to what lies under the cursor.
    fn add(&mut self, pair: &PairView, cursor_px: Option<[f64; 2]>) {
        let [width, height] = pair.pictures.size_px.map(|side| side as f64);
        let inside = |[u, v]: &[f64; 2]| *u >= -0.5 && *v >= -0.5 && *u < width - 0.5 && *v < height - 0.5;
        let Some(at) = cursor_px.filter(inside) else { return };
        let Some(bead) = free_names(pair, at).into_iter().next() else { return };
        self.chosen = Some(Chosen { image_px: at, bead: Some(bead.clone()), moved_px: [0.0; 2] });
        self.ask(pair, BeadEdit::Put { bead, image_px: DVec2::from_array(at) });
    }

    fn put(&mut self, pair: &PairView) {
        let Some(chosen) = self.chosen.as_mut().filter(|chosen| DVec2::from(chosen.moved_px).length() >= LEAST_MOVE_PX) else {
            self.chosen.iter_mut().for_each(|chosen| chosen.moved_px = [0.0; 2]);
            return;
        };
        let at = chosen.now_px();
        // A shadow without a name gets the free one that belongs there.
        let Some(bead) = chosen.bead.clone().or_else(|| free_names(pair, at).into_iter().next()) else { return };
        *chosen = Chosen { image_px: at, bead: Some(bead.clone()), moved_px: [0.0; 2] };
        self.ask(pair, BeadEdit::Put { bead, image_px: DVec2::from_array(at) });
    }
}

/// What can be chosen: beads that were found, in the order of the layout, then shadows that are no bead's.
fn places(pair: &PairView) -> Vec<Chosen> {
    let place = |image_px: [f64; 2], bead: Option<&str>| Chosen { image_px, bead: bead.map(str::to_owned), moved_px: [0.0; 2] };
    let beads = pair.marks.beads.iter().filter_map(|bead| Some(place(bead.found_px?, Some(&bead.name))));
    beads.chain(pair.marks.strays().map(|shadow| place(shadow.image_px, None))).collect()
}

fn apart_px(a: [f64; 2], b: [f64; 2]) -> f64 {
    DVec2::from_array(a).distance(DVec2::from_array(b))
}

fn nearest(pair: &PairView, at: [f64; 2], reach_px: f64) -> Option<Chosen> {
    let near = places(pair).into_iter().filter(|place| apart_px(place.image_px, at) <= reach_px);
    // Of a bead and the shadow that it has, the bead: it comes first.
    near.min_by(|a, b| apart_px(a.image_px, at).total_cmp(&apart_px(b.image_px, at)))
}

/// Beads on which a pose may rest, by how near the pose puts them to `at`; those without a place in the order of the layout. With whether
/// the pose rests on them.
fn by_nearness(pair: &PairView, at: [f64; 2]) -> Vec<(String, bool)> {
    let is_check = |name: &str| pair.pose.beads.iter().any(|row| row.check && row.name == name);
    let mut beads: Vec<_> = pair.marks.beads.iter().filter(|bead| !is_check(&bead.name)).collect();
    let distance = |predicted: Option<[f64; 2]>| predicted.map_or(f64::INFINITY, |predicted| apart_px(predicted, at));
    beads.sort_by(|a, b| distance(a.predicted_px).total_cmp(&distance(b.predicted_px)));
    beads.into_iter().map(|bead| (bead.name.clone(), bead.used)).collect()
}

fn free_names(pair: &PairView, at: [f64; 2]) -> Vec<String> {
    by_nearness(pair, at).into_iter().filter(|(_, used)| !used).map(|(name, _)| name).collect()
}

/// Names that what lies at `at` may get: those that are free, then those that another shadow would lose; the nearest first.
pub(super) fn names(pair: &PairView, at: [f64; 2]) -> Vec<String> {
    let (taken, free): (Vec<_>, Vec<_>) = by_nearness(pair, at).into_iter().partition(|(_, used)| *used);
    free.into_iter().chain(taken).map(|(name, _)| name).take(MOST_NAMES).collect()
}

/// What can be done now, in a line.
pub(super) fn words(pair: &PairView, editing: &Editing) -> String {
    let Some(chosen) = editing.chosen() else {
        return "EDITING BEADS  ·  a click, or N, chooses a bead or a shadow  ·  A adds a bead under the cursor  ·  Ctrl Z takes back  ·  \
                Esc leaves"
            .to_owned();
    };
    let what = chosen.bead.as_ref().map_or_else(|| "a shadow without a name".to_owned(), |bead| format!("bead {bead}"));
    let listed: Vec<String> =
        names(pair, chosen.image_px).iter().enumerate().map(|(n, name)| format!("{}: {name}", n + 1)).collect();
    format!(
        "EDITING {what}  ·  drag, or arrows and Enter, move it  ·  Delete drops it  ·  its name: {}  ·  Ctrl Z takes back  ·  Esc leaves",
        listed.join(", ")
    )
}
