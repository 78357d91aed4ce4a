//! What a plot shows.

use crate::image::ticks::{Scale, Tick};

/// What stands along one side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// Quantity with its unit: `energy / keV`.
    pub label: String,
    /// How values become positions.
    pub scale: Scale,
    /// First and last value; from the data when absent.
    pub range: Option<[f64; 2]>,
    /// A value that a range from the data holds as well.
    pub holds: Option<f64>,
    /// What stands there instead of round numbers, where it has names.
    pub named: Vec<Tick>,
}

impl Axis {
    /// An axis whose range comes from the data.
    #[must_use]
    pub fn new(label: &str, scale: Scale) -> Self {
        Self { label: label.to_owned(), scale, ..Self::default() }
    }
}

/// How the points of a series are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Stroke {
    /// Straight lines between the points, in their order.
    #[default]
    Line,
    /// Dashed straight lines.
    Dashed,
    /// A histogram: each value from half-way before its point to half-way after.
    Steps,
    /// A dot each.
    Points,
    /// A hollow dot each.
    Rings,
    /// A bar each, from the lower end of the axes up to it.
    Bars,
    /// A level band from each first to each second point.
    Bands,
}

impl Stroke {
    /// What its lines say of themselves beside colour and width.
    pub(super) fn dashes(self) -> &'static str {
        if self == Self::Dashed { " stroke-dasharray=\"6 4\"" } else { "" }
    }
}

/// One quantity.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Name in the legend; a series without one has no entry there.
    pub label: String,
    /// (x, y); those that are not finite, or not positive on a logarithmic axis, leave a gap.
    pub points: Vec<[f64; 2]>,
    /// What is told of each dot, bar or first point of a band where the pointer rests on it; none may be there.
    pub words: Vec<String>,
    /// How they are drawn.
    pub stroke: Stroke,
    /// Colour, by its place in the palette; by the place of the series when absent.
    pub colour: Option<usize>,
}

/// A vertical line at a position on the x axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Mark {
    /// Where.
    pub x: f64,
    /// What it is, written beside it.
    pub label: String,
}

/// Where a plot stands.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Place {
    /// By itself: 760 × 460 user units, under its title, its legend where it covers least.
    #[default]
    Alone,
    /// In a page, whose heading names it: 640 user units wide, its legend above axes of this height.
    InPage {
        /// User units.
        height: f64,
    },
}

/// A plot, to be drawn by [`Plot::svg`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    /// Above the drawing, or what those hear who do not see it.
    pub title: String,
    /// Where it stands.
    pub place: Place,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// What is drawn, later ones on top.
    pub series: Vec<Series>,
    /// Positions on the x axis.
    pub marks: Vec<Mark>,
}

/// Why a plot could not be drawn.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlotError {
    /// No point of any series has a place on the axes.
    #[error(
        "plot '{title}': none of its {found} points can be drawn, expected finite values (positive ones on a logarithmic axis)"
    )]
    NothingToDraw {
        /// The plot's title.
        title: String,
        /// Points given.
        found: usize,
    },
    /// A range that is not one.
    #[error("plot '{title}': axis '{axis}' goes from {from} to {to}, expected ascending values that the scale can show")]
    Range {
        /// The plot's title.
        title: String,
        /// The axis's label.
        axis: String,
        /// First.
        from: f64,
        /// Last.
        to: f64,
    },
}

/// Okabe and Ito's colours, told apart by colour-blind readers, in an order that puts the strongest first. One list serves both schemes but for
/// its first entry, which is the text's own colour.
const PALETTE: [&str; 7] = ["currentColor", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"];

/// Places of colours in the palette that say how something came out.
pub const GOOD: usize = 3;
/// See [`GOOD`].
pub const CAUTION: usize = 6;
/// See [`GOOD`].
pub const BAD: usize = 2;

impl Series {
    /// Its colour, as the one at `index` of its plot.
    pub(super) fn colour(&self, index: usize) -> &'static str {
        PALETTE[self.colour.unwrap_or(index) % PALETTE.len()]
    }
}

/// Text as it may stand in SVG.
pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
