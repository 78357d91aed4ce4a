//! `Shadow`: what looks like a bead in a frame, in a pose's file.

use serde::{Deserialize, Serialize};

use crate::beads::{Detection, Flags};

/// A bead-like shadow in the frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shadow {
    /// Its centre.
    pub image_px: [f64; 2],
    /// Standard deviation of the centre per axis.
    pub sigma_px: f64,
    /// Covariance of the centre, columns and rows. A file that states one that is none cannot be read.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "super::residual::covariance_px2")]
    pub covariance_px2: Option<[[f64; 2]; 2]>,
    /// Fitted radius.
    pub radius_px: f64,
    /// Depth over its standard deviation.
    pub snr: f64,
    /// In (0, 1]: how much it looks like a bead and like the others. Absent where the file does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<f64>,
    /// Structure that a sphere's shadow does not explain, as a share of the depth. Absent where the file does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub misfit: Option<f64>,
    /// What speaks against its centre.
    #[serde(default)]
    pub flags: Flags,
    /// The bead that it was matched to, if P rests on it.
    pub bead: Option<String>,
}

impl Shadow {
    pub(super) fn of(detection: &Detection, bead: Option<String>) -> Self {
        let Detection { image_px, sigma_px, radius_px, snr, quality, misfit, flags, .. } = *detection;
        let covariance_px2 = Some(square(detection.noise_px2()));
        let (quality, misfit) = (Some(quality), Some(misfit));
        Self { image_px: image_px.to_array(), sigma_px, covariance_px2, radius_px, snr, quality, misfit, flags, bead }
    }

    /// Whether it is what `detection` became in the file.
    pub(super) fn is_of(&self, detection: &Detection) -> bool {
        self.image_px == detection.image_px.to_array()
    }

    /// What was detected of a bead, by the shadow of `shadows` that was matched to it.
    pub(super) fn detected<'d>(shadows: &[Self], bead: &str, detections: &'d [Detection]) -> Option<&'d Detection> {
        let shadow = shadows.iter().find(|shadow| shadow.bead.as_deref() == Some(bead))?;
        detections.iter().find(|detection| shadow.is_of(detection))
    }
}

/// A 2×2 covariance from uu, uv, vv.
pub fn square([uu, uv, vv]: [f64; 3]) -> [[f64; 2]; 2] {
    [[uu, uv], [uv, vv]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    #[test]
    fn what_speaks_against_a_shadow_stands_in_its_file() {
        let flags = Flags { overlapping: true, over_structure: true, ..Flags::default() };
        let detection = Detection {
            image_px: DVec2::new(3.0, 4.0),
            sigma_px: 0.5,
            quality: 0.7,
            misfit: 0.02,
            flags,
            ..Detection::default()
        };
        let own = Shadow::of(&detection, Some("b1".to_owned()));
        assert_eq!((own.flags, own.quality, own.misfit), (flags, Some(0.7), Some(0.02)));
        let other = Detection { image_px: DVec2::new(3.0, 4.5), ..detection };
        assert!(own.is_of(&detection) && !own.is_of(&other));
        let shadows = [Shadow::of(&other, None), own.clone()];
        let found = |bead: &str| Shadow::detected(&shadows, bead, &[other, detection]).map(|found| found.image_px);
        assert_eq!([found("b1"), found("b2")], [Some(detection.image_px), None]);
        let text = serde_json::to_string(&own).expect("JSON");
        assert!(text.contains(r#""flags":{"overlapping":true,"over_structure":true}"#), "{text}");
        assert_eq!(serde_json::from_str::<Shadow>(&text).expect("reads what it writes"), own);
        // A file that says nothing of them.
        let bare = r#"{"image_px": [3, 4], "sigma_px": 0.05, "radius_px": 2, "snr": 9, "bead": null}"#;
        let read: Shadow = serde_json::from_str(bare).expect("a shadow");
        assert_eq!((read.flags, read.quality, read.misfit), (Flags::default(), None, None));
    }
}
