//! What the header says about the meaning and the direction of pixel values.
//!
//! *Domain.* A DISP relationship, an image FOR PRESENTATION, or traces of processing make `display`; LIN and LOG count only where the
//! image is not made for eyes (DX images carry LIN or LOG even after processing). Without any of these: `unknown`.
//!
//! *Direction.* The sign attribute (0028,1041) decides where it exists. Else LIN and LOG mean "larger is more X-rays" as the standard
//! defines them. Else the habit of the modality decides: fluoroscopy (XA, RF and others) shows metal and bone dark, so larger is more
//! X-rays in MONOCHROME2 and fewer in MONOCHROME1; radiographs (CR, DX, MG) show bone white like film, so it is the other way round.

use super::tags::FrameTags;

/// What a pixel value means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Domain {
    /// Proportional to the X-ray signal, up to gain and offset; larger is more signal.
    Linear,
    /// Proportional to the logarithm of the signal; larger is more attenuation. In nepers where [`super::Frame::unit`] says so.
    Log,
    /// Processed for eyes: monotone in the signal at best; larger is more signal.
    Display,
    /// What the values mean is not known. Larger is more signal where a header tells the direction, else values are as stored.
    Unknown,
}

impl Domain {
    /// The word used in files and on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Log => "log",
            Self::Display => "display",
            Self::Unknown => "unknown",
        }
    }

    /// Whether the values are gray levels without a known relation to the signal.
    #[must_use]
    pub fn is_gray(self) -> bool {
        matches!(self, Self::Display | Self::Unknown)
    }
}

impl std::fmt::Display for Domain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Domain {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        [Self::Linear, Self::Log, Self::Display, Self::Unknown]
            .into_iter()
            .find(|domain| domain.as_str() == word)
            .ok_or_else(|| format!("domain '{word}' is not one of linear, log, display, unknown"))
    }
}

/// What else in the header speaks for processing.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Traces {
    /// A VOI look-up table is present.
    pub voi_lut: bool,
    /// A processing function or an acquisition device's processing code is present.
    pub processing: bool,
    /// The pixels passed through lossy compression.
    pub lossy: bool,
}

/// The verdict on a DICOM image.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Verdict {
    pub domain: Domain,
    /// Whether larger values, after rescaling, mean more X-rays at the detector.
    pub larger_is_more_signal: bool,
    pub evidence: Vec<String>,
    pub notes: Vec<String>,
}

pub(super) fn judge(tags: &FrameTags, traces: Traces, rescale_negative: bool, declared: Option<Domain>) -> Verdict {
    let (mut evidence, mut notes) = (Vec::new(), Vec::new());
    let from_header = domain_from_header(tags, traces, &mut evidence, &mut notes);
    let domain = declared.unwrap_or(from_header);
    if let Some(declared) = declared {
        evidence.insert(0, format!("declared by the user: {declared} (the header says {from_header})"));
    }
    let larger_is_more_signal = match declared_direction(tags, declared) {
        // Whoever says what the values mean says it of the values as they are.
        Some(more) => {
            let way = if more { "more" } else { "fewer" };
            evidence.push(format!("declared {domain}, and no attribute states a direction: larger values mean {way} X-rays"));
            more
        }
        None => direction(tags, rescale_negative, &mut evidence, &mut notes),
    };
    Verdict { domain, larger_is_more_signal, evidence, notes }
}

fn domain_from_header(tags: &FrameTags, traces: Traces, evidence: &mut Vec<String>, notes: &mut Vec<String>) -> Domain {
    let modality = tags.modality.as_deref().unwrap_or("");
    if !matches!(modality, "XA" | "RF" | "DX" | "CR") {
        let shown = if modality.is_empty() { "missing" } else { modality };
        notes.push(format!("modality (0008,0060) is {shown}, expected XA, RF, DX or CR: read by the same rules as XA"));
    }
    let for_eyes = tags.presentation_intent.as_deref() == Some("FOR PRESENTATION");
    if let Some(intent) = &tags.presentation_intent {
        evidence.push(format!("presentation intent (0008,0068) is {intent}"));
    }
    if let Some(relation) = &tags.intensity_relationship {
        evidence.push(format!("pixel intensity relationship (0028,1040) is {relation}"));
    }
    match tags.intensity_relationship.as_deref() {
        Some("DISP") => return Domain::Display,
        Some("LIN" | "LOG") if for_eyes => {
            evidence.push("images for presentation carry LIN or LOG even after processing, so that is not believed".into());
            return Domain::Display;
        }
        Some("LIN") => return Domain::Linear,
        Some("LOG") => return Domain::Log,
        _ => evidence.push("pixel intensity relationship (0028,1040) is missing".into()),
    }
    if for_eyes {
        return Domain::Display;
    }
    let before = evidence.len();
    if traces.voi_lut {
        evidence.push("a VOI look-up table is present: values are meant for display".into());
    }
    if traces.processing {
        evidence.push("a processing function is named: the console changed the values".into());
    }
    if traces.lossy {
        evidence.push("the pixels were compressed with loss".into());
    }
    if tags.image_type.first().is_some_and(|kind| kind == "DERIVED") {
        evidence.push("image type is DERIVED: values are not the detector's own".into());
    }
    if tags.intensifier_mm.is_some() {
        evidence.push("an image intensifier's video chain is not linear unless its relationship says so".into());
    }
    if tags.bits_stored.is_some_and(|bits| bits <= 8) {
        evidence.push("8 bits or fewer are stored: values were windowed for display".into());
    }
    if evidence.len() > before && tags.presentation_intent.is_none() { Domain::Display } else { Domain::Unknown }
}

/// What a declared domain promises of the values, where no attribute says otherwise: no sign, no relationship, and no picture that is shown
/// inverted.
fn declared_direction(tags: &FrameTags, declared: Option<Domain>) -> Option<bool> {
    let is_stated = tags.intensity_sign.is_some()
        || tags.intensity_relationship.is_some()
        || tags.photometric.as_deref() == Some("MONOCHROME1");
    match declared.filter(|_| !is_stated)? {
        Domain::Linear => Some(true),
        Domain::Log => Some(false),
        Domain::Display | Domain::Unknown => None,
    }
}

fn direction(tags: &FrameTags, rescale_negative: bool, evidence: &mut Vec<String>, notes: &mut Vec<String>) -> bool {
    if rescale_negative {
        evidence.push("the rescale slope (0028,1053) is negative: it turns the values round".into());
    }
    if let Some(sign) = tags.intensity_sign {
        let more = sign > 0;
        let word = if more { "more" } else { "fewer" };
        evidence.push(format!("intensity sign (0028,1041) is {sign}: larger stored values mean {word} X-rays"));
        return more != rescale_negative;
    }
    let radiograph = matches!(tags.modality.as_deref(), Some("CR" | "DX" | "MG"));
    let monochrome1 = tags.photometric.as_deref() == Some("MONOCHROME1");
    let stated = matches!(tags.intensity_relationship.as_deref(), Some("LIN" | "LOG"));
    let photometric = if monochrome1 { "MONOCHROME1" } else { "MONOCHROME2" };
    if stated && (radiograph || !monochrome1) {
        evidence.push("a LIN or LOG relationship means that larger stored values mean more X-rays".into());
        return !rescale_negative;
    }
    // The presentation state applies after rescaling, so the slope does not enter here.
    let more = monochrome1 == radiograph;
    let habit = if radiograph { "radiographs show bone white" } else { "fluoroscopy shows bone dark" };
    let word = if more { "more" } else { "fewer" };
    evidence.push(format!("{photometric}, and {habit}: larger values mean {word} X-rays"));
    if !stated {
        notes.push("the direction of the values rests on the habit of the modality; no attribute states it".into());
    }
    more
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tags(modality: &str, photometric: &str, relation: Option<&str>) -> FrameTags {
        FrameTags {
            modality: Some(modality.into()),
            photometric: Some(photometric.into()),
            intensity_relationship: relation.map(Into::into),
            ..FrameTags::default()
        }
    }

    fn verdict(tags: &FrameTags, traces: Traces) -> (Domain, bool) {
        let verdict = judge(tags, traces, false, None);
        assert!(!verdict.evidence.is_empty(), "a verdict without evidence");
        (verdict.domain, verdict.larger_is_more_signal)
    }

    #[test]
    fn relationships_decide_where_they_exist() {
        for (word, domain) in [("LIN", Domain::Linear), ("LOG", Domain::Log), ("DISP", Domain::Display)] {
            assert_eq!(verdict(&tags("XA", "MONOCHROME2", Some(word)), Traces::default()), (domain, true));
        }
        assert_eq!(verdict(&tags("XA", "MONOCHROME2", None), Traces::default()).0, Domain::Unknown);
        assert_eq!(verdict(&tags("XA", "MONOCHROME2", Some("ODD")), Traces::default()).0, Domain::Unknown);
    }

    #[test]
    fn an_image_for_presentation_is_display_whatever_it_claims() {
        let mut dx = tags("DX", "MONOCHROME2", Some("LIN"));
        dx.presentation_intent = Some("FOR PRESENTATION".into());
        assert_eq!(verdict(&dx, Traces::default()).0, Domain::Display);
        dx.presentation_intent = Some("FOR PROCESSING".into());
        assert_eq!(verdict(&dx, Traces::default()).0, Domain::Linear);
        dx.intensity_relationship = None;
        assert_eq!(verdict(&dx, Traces { voi_lut: true, ..Traces::default() }).0, Domain::Unknown);
    }

    #[test]
    fn traces_of_processing_make_display() {
        let mut rf = tags("RF", "MONOCHROME2", None);
        rf.intensifier_mm = Some(229.0);
        assert_eq!(verdict(&rf, Traces::default()).0, Domain::Display);
        let cr = tags("CR", "MONOCHROME1", None);
        assert_eq!(verdict(&cr, Traces::default()).0, Domain::Unknown, "control: no trace, no verdict");
        assert_eq!(verdict(&cr, Traces { processing: true, ..Traces::default() }).0, Domain::Display);
    }

    /// Computed radiographs are stored as MONOCHROME1 with more exposure at larger values; turning every MONOCHROME1 image round made
    /// bone brighter than air.
    #[test]
    fn direction_follows_sign_then_relationship_then_habit() {
        assert!(verdict(&tags("CR", "MONOCHROME1", None), Traces::default()).1);
        assert!(!verdict(&tags("CR", "MONOCHROME2", None), Traces::default()).1);
        assert!(!verdict(&tags("RF", "MONOCHROME1", None), Traces::default()).1);
        assert!(verdict(&tags("RF", "MONOCHROME2", None), Traces::default()).1);
        let mut dx = tags("DX", "MONOCHROME2", Some("LIN"));
        assert!(verdict(&dx, Traces::default()).1);
        dx.intensity_sign = Some(-1);
        assert!(!verdict(&dx, Traces::default()).1);
        assert!(judge(&dx, Traces::default(), true, None).larger_is_more_signal, "a negative slope turns it back");
    }

    #[test]
    fn the_user_outranks_the_header() {
        let verdict = judge(&tags("XA", "MONOCHROME2", Some("DISP")), Traces::default(), false, Some(Domain::Linear));
        assert_eq!(verdict.domain, Domain::Linear);
        assert!(verdict.evidence[0].contains("declared"));
    }

    /// A radiograph's raw values were turned over by the habit of its modality, whatever was said of them.
    #[test]
    fn a_declared_domain_outranks_the_habit_of_a_modality_and_no_attribute() {
        let says = |tags: &FrameTags, domain| judge(tags, Traces::default(), false, Some(domain)).larger_is_more_signal;
        for modality in ["DX", "XA"] {
            let plain = tags(modality, "MONOCHROME2", None);
            assert_eq!([says(&plain, Domain::Linear), says(&plain, Domain::Log)], [true, false], "{modality}");
        }
        let dx = tags("DX", "MONOCHROME2", None);
        assert!(!says(&dx, Domain::Display), "the control: bone is white");
        let signed = FrameTags { intensity_sign: Some(-1), ..dx };
        assert!(!says(&signed, Domain::Linear), "an attribute says so");
        assert!(!says(&tags("RF", "MONOCHROME1", None), Domain::Linear), "shown inverted");
    }
}
