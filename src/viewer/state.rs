//! What the window remembers between two looks: which pair is shown, and how.

use std::sync::Arc;

use super::editing::{EditCommand, Editing};
use super::note::NoteField;
use super::picture_cache::PictureCache;
use super::player::Player;
use super::sight::Sight;
use crate::session::board::{BoardState, PairView};

/// Which panes there are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Arrangement {
    /// Acquired and DRR large, difference and overlay below or beside.
    #[default]
    All,
    /// Acquired and DRR.
    Two,
    /// The difference alone.
    Difference,
    /// The overlay alone.
    Overlay,
}

/// How acquired frame and DRR are laid over each other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overlay {
    /// Edges of the DRR over the frame.
    #[default]
    Edges,
    /// One after the other.
    Blink,
    /// In squares.
    Checkerboard,
    /// The DRR through which the frame is seen.
    Opacity,
}

/// What is drawn over pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// Where beads are found and predicted.
    Beads,
    /// Their names.
    Names,
    /// Residuals, enlarged.
    Residuals,
    /// The robot's centreline and tip.
    Robot,
    /// Landmarks and their uncertainty, enlarged.
    Landmarks,
    /// What is masked.
    Masks,
}

impl Overlay {
    /// In the order of the keys.
    pub const ALL: [Self; 4] = [Self::Edges, Self::Blink, Self::Checkerboard, Self::Opacity];

    /// As a button shows it.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Edges => "edges",
            Self::Blink => "blink",
            Self::Checkerboard => "checkerboard",
            Self::Opacity => "opacity",
        }
    }
}

impl Arrangement {
    /// In the order of the keys.
    pub const ALL: [Self; 4] = [Self::All, Self::Two, Self::Difference, Self::Overlay];

    /// As a button shows it.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::All => "all four",
            Self::Two => "acquired | DRR",
            Self::Difference => "difference",
            Self::Overlay => "overlay",
        }
    }
}

impl Mark {
    /// In the order of the toolbar.
    pub const ALL: [Self; 6] = [Self::Beads, Self::Names, Self::Residuals, Self::Robot, Self::Landmarks, Self::Masks];

    /// As a button shows it.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Beads => "beads",
            Self::Names => "names",
            Self::Residuals => "residuals",
            Self::Robot => "robot",
            Self::Landmarks => "landmarks",
            Self::Masks => "masks",
        }
    }
}

/// See the module.
pub struct ViewState {
    /// Number of the frame shown; `None` follows the newest.
    pub selected: Option<u32>,
    /// Which panes there are.
    pub arrangement: Arrangement,
    /// How the overlay shows both pictures.
    pub overlay: Overlay,
    /// Of the DRR over the frame, 0 to 1.
    pub opacity: f32,
    /// Which part of the frame is seen.
    pub sight: Sight,
    /// Values shown black and white, in all panes; `None` chooses them for each pair.
    pub window: Option<[f64; 2]>,
    /// What is not drawn.
    pub hidden: Vec<Mark>,
    /// Plays the exposures.
    pub player: Player,
    /// The keys are listed over everything.
    pub shows_keys: bool,
    /// Beads that are edited.
    pub editing: Editing,
    /// A note that is being written.
    pub(super) note: Option<NoteField>,
    /// What lies under the cursor, in pixels of the frame.
    pub(super) cursor_px: Option<[f64; 2]>,
    pub(super) cache: PictureCache,
}

impl Default for ViewState {
    fn default() -> Self {
        Self {
            selected: None,
            arrangement: Arrangement::default(),
            overlay: Overlay::default(),
            opacity: 0.5,
            sight: Sight::default(),
            window: None,
            hidden: vec![Mark::Masks],
            player: Player::default(),
            shows_keys: false,
            editing: Editing::default(),
            note: None,
            cursor_px: None,
            cache: PictureCache::default(),
        }
    }
}

impl ViewState {
    /// Index of the pair shown: the selected one, else the newest.
    #[must_use]
    pub fn shown_index(&self, board: &BoardState) -> Option<usize> {
        let selected = self.selected.and_then(|number| board.pairs.iter().position(|pair| pair.number() == number));
        selected.or(board.pairs.len().checked_sub(1))
    }

    /// The pair shown.
    #[must_use]
    pub fn shown<'a>(&self, board: &'a BoardState) -> Option<&'a Arc<PairView>> {
        board.pairs.get(self.shown_index(board)?)
    }

    /// Shows the pair at `index`; the newest one is followed from then on.
    pub fn select(&mut self, board: &BoardState, index: usize) {
        let last = board.pairs.len().saturating_sub(1);
        self.selected = board.pairs.get(index.min(last)).filter(|_| index < last).map(|pair| pair.number());
    }

    /// Does what a key asks for while beads are edited, and begins and ends that.
    pub(super) fn edit(&mut self, command: EditCommand, board: &BoardState) {
        let begins = command == EditCommand::Toggle && !self.editing.is_on();
        match self.shown(board).map(Arc::clone) {
            // Nobody wants to be shown another exposure under the hand.
            Some(pair) if begins && board.editable => {
                self.player.stop();
                self.editing.begin(self.selected.is_none());
                self.selected = Some(pair.number());
            }
            Some(pair) if self.editing.is_on() && !matches!(command, EditCommand::Toggle | EditCommand::Leave) => {
                self.editing.run(command, &pair, self.cursor_px);
            }
            _ if self.editing.is_on() => self.leave_editing(),
            _ => {}
        }
    }

    /// A note about the exposure shown is written, where the session takes one.
    pub(super) fn begin_note(&mut self, board: &BoardState) {
        if let Some(pair) = self.shown(board).filter(|_| board.editable) {
            let number = pair.number();
            self.player.stop();
            self.note = Some(NoteField::of(number, board.notes.get(&number).map(String::as_str)));
        }
    }

    /// Beads are edited no longer.
    pub(super) fn leave_editing(&mut self) {
        if self.editing.end() {
            self.selected = None;
        }
    }

    /// Whether `mark` is drawn.
    #[must_use]
    pub fn draws(&self, mark: Mark) -> bool {
        !self.hidden.contains(&mark)
    }

    /// Draws `mark`, or does not any more.
    pub fn toggle(&mut self, mark: Mark) {
        if self.draws(mark) {
            self.hidden.push(mark);
        } else {
            self.hidden.retain(|hidden| *hidden != mark);
        }
    }

    /// The values shown black and white of this pair.
    #[must_use]
    pub fn window_of(&self, pair: &PairView) -> [f64; 2] {
        self.window.unwrap_or(pair.pictures.window)
    }

    /// Moves the values shown black and white of `pair` by `level` of their range, and widens it by `width` of it.
    pub fn shift_window(&mut self, pair: &PairView, level: f64, width: f64) {
        let [low, high] = self.window_of(pair);
        let range = (high - low).max(1e-9);
        let (middle, half) = (0.5 * (low + high) + level * range, 0.5 * range * (1.0 + width).clamp(0.2, 5.0));
        self.window = Some([middle - half, middle + half]);
    }
}
