//! Radii of shadows against those of the beads: a contradiction where they are known, none where blur hides them.

use sidecarm::beads::Detection;
use sidecarm::pose::{Refusal, register_shadows};

use crate::pose_registration::{landmark_error_px, matching, shadows};
use crate::pose_synthetic as synthetic;

/// Right poses were refused because small blurred beads look half as large as they are.
#[test]
fn shadows_half_as_large_contradict_unless_blur_hides_their_size() {
    let mut cases = 0;
    for seed in 0..4 {
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(9, 0.75, seed));
        let found = shadows(&view, &layout, 0.05, 0.02, seed);
        if found.len() < 8 {
            continue;
        }
        let halved = |radius_sigma_ln: f64| -> Vec<Detection> {
            found.iter().map(|shadow| Detection { radius_px: 0.5 * shadow.radius_px, radius_sigma_ln, ..*shadow }).collect()
        };
        let request = matching(&view, &layout);
        for known in [0.0, 0.03] {
            let refused = register_shadows(&request, &halved(known));
            let told = matches!(refused.refusal, Some(Refusal::Radii { ratio }) if (ratio - 0.5).abs() < 0.05);
            assert!(told, "seed {seed}, {known}: {:?}", refused.reason);
        }
        // Blur that hides less than that leaves it a doubt at least.
        let partly = register_shadows(&request, &halved(0.2));
        assert!(!partly.is_accepted() || partly.doubt.is_some(), "seed {seed}: {:?}", partly.cautions);
        let hidden = register_shadows(&request, &halved(0.4));
        assert!(hidden.is_accepted(), "seed {seed}: {:?}", hidden.reason);
        assert!(landmark_error_px(&hidden, &view) < 1.0, "seed {seed}: {} px", landmark_error_px(&hidden, &view));
        cases += 1;
    }
    assert!(cases >= 2, "{cases}");
}
