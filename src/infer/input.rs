//! What a scatter network is asked and what it answers.

/// One image, as a scatter network sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// Physical channels, [C, 48, 64] row-major, row 0 at the top; each in the unit its name ends with.
    pub inputs: Vec<f32>,
    /// Scalars of the whole image, [K].
    pub scalars: Vec<f32>,
    /// Rough physical guess of the mean scatter, above 0, in the unit of the scatter that was trained on.
    pub scale: f32,
}

/// The predicted scatter, and whether to believe it.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Scattered once, [12, 16] row-major, in the unit of `scale`.
    pub single: Vec<f64>,
    /// Scattered more than once, [12, 16] row-major, in the unit of `scale`.
    pub multiple: Vec<f64>,
    /// Every input that lies outside what was seen in training, with its value and the bounds; empty for an image like those.
    /// Where an input is NaN or infinite, all cells are NaN.
    pub outside: Vec<String>,
}
