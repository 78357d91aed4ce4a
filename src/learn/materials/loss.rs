//! A batch of patches on the device, and its loss.

use burn::tensor::activation::{log_softmax, softmax};
use burn::tensor::{Device, Tensor, TensorData};

use super::patch::Patch;
use crate::infer::materials::{CLASSES, CubeNetwork, INPUTS, Pass};

/// Points that a class of its own size would have to be wrong by before an empty one counts.
const FEW: f32 = 50.0;

/// Patches of one step.
pub(super) struct Batch {
    windows: Tensor<5>,
    truth: Tensor<5>,
    weight: Tensor<5>,
    /// Sum of the weights.
    whole: f32,
}

impl Batch {
    pub(super) fn new(patches: &[Patch], pass: &Pass, device: &Device) -> Self {
        let side = pass.patch;
        let tensor = |channels: usize, values: &dyn Fn(&Patch) -> &[f32]| {
            let all: Vec<f32> = patches.iter().flat_map(|patch| values(patch).iter().copied()).collect();
            Tensor::from_data(TensorData::new(all, [patches.len(), channels, side, side, side]), device)
        };
        Self {
            windows: tensor(INPUTS, &|patch| &patch.windows),
            truth: tensor(CLASSES, &|patch| &patch.truth),
            weight: tensor(1, &|patch| &patch.weight),
            whole: patches.iter().flat_map(|patch| &patch.weight).map(|weight| f64::from(*weight)).sum::<f64>() as f32,
        }
    }

    /// 1 − mean over the classes of (2 Σ w p t + ε) / (Σ w (p² + t²) + ε), which is 0 only where every probability is the share of its class
    /// (multi-class Dice with squares, Milletari, Navab & Ahmadi 2016), and the cross-entropy −Σ w t ln p / Σ w beside it (Isensee et al. 2021): it
    /// has a slope also where a patch holds hardly any of a class.
    pub(super) fn loss(&self, network: &CubeNetwork) -> Tensor<1> {
        let logits = network.forward(self.windows.clone());
        let said = softmax(logits.clone(), 1);
        let of_class = |values: Tensor<5>| {
            let [batch, classes, depth, rows, columns] = values.dims();
            let flat: Tensor<3> = values.reshape([batch, classes, depth * rows * columns]);
            flat.sum_dim(2).sum_dim(0).reshape([CLASSES])
        };
        let weight = self.weight.clone();
        // By class, then over them: a GPU adds up a whole tensor in the order in which its groups are done, and then no training is another one's bits.
        let entropy = -of_class(log_softmax(logits, 1) * self.truth.clone() * weight.clone()).sum_dim(0) / (self.whole + FEW);
        let both: Tensor<1> = of_class(said.clone() * self.truth.clone() * weight.clone()) * 2.0 + FEW;
        let each: Tensor<1> = of_class((said.square() + self.truth.clone().square()) * weight) + FEW;
        -(both / each).mean_dim(0) + 1.0 + entropy
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::materials::{AIR, BONE, MaterialsArchitecture, SOFT, windows};
    use crate::learn::StepRule;
    use crate::learn::adam::Adam;
    use crate::learn::epochs::slopes_of;

    /// A ball of bone in tissue, and air beyond a plane.
    fn ball(pass: &Pass) -> Patch {
        let side = pass.patch;
        let class_of = |index: usize| {
            let [x, y, z] = [index % side, index / side % side, index / (side * side)].map(|n| n as f32 - 7.0);
            match x * x + y * y + z * z {
                squared if squared < 20.0 => BONE,
                _ if x + y > 8.0 => AIR,
                _ => SOFT,
            }
        };
        let points = pass.points();
        let mut truth = vec![0.0; CLASSES * points];
        (0..points).for_each(|index| truth[class_of(index) * points + index] = 1.0);
        let hu: Vec<f32> = (0..points).map(|index| [-1000.0, 40.0, 900.0][class_of(index)]).collect();
        Patch { windows: windows(&hu).collect(), truth, weight: vec![1.0; points] }
    }

    /// The paper's layers over a patch of 16³ in place of 128³, which costs a five-hundredth: they learn it by heart.
    #[test]
    fn the_paper_s_layers_learn_a_patch_by_heart() {
        let pass = Pass { patch: 16, keep: 8, ..MaterialsArchitecture::Paper.passes()[0] };
        let (patches, device) = ([ball(&pass)], Device::flex().autodiff());
        let rule = StepRule::default();
        let mut adam = Adam::drawn(&pass.layers(), 1);
        let (mut first, mut last) = (0.0, f64::INFINITY);
        // A few dozen steps do; what learns nothing has all of them.
        for step in 0..300 {
            let network = CubeNetwork::new(&pass, &adam.parameters, &device).expect("as many parameters as the layers have");
            let loss = Batch::new(&patches, &pass, &device).loss(&network);
            let (now, slopes) = slopes_of(&loss, network.layers()).expect("a processor");
            (first, last) = (if step == 0 { now } else { first }, now);
            if last < 0.3 * first {
                break;
            }
            adam.step(&slopes, 5e-3, &rule);
        }
        assert!(first > 0.5 && last < 0.3 * first, "{first} {last}");
    }

    /// Spongy bone in tissue, beside contrast medium as dense as it is on average: no threshold tells them apart, and in every patch they lie
    /// elsewhere.
    fn bone_beside_contrast(pass: &Pass, number: usize) -> Patch {
        let side = pass.patch;
        let apart2 =
            |at: [usize; 3], centre: [usize; 3]| -> usize { (0..3).map(|axis| at[axis].abs_diff(centre[axis]).pow(2)).sum() };
        // Opposite corners of the patch by turns, the balls as large as they find room.
        let corner = |bit: usize| if (number >> bit) & 1 == 0 { 4 } else { side - 5 };
        let (bone_at, contrast_at) =
            ([corner(0), corner(1), corner(2)], [corner(0), corner(1), corner(2)].map(|at| side - 1 - at));
        let largest2 = [12, 16, 20][number % 3];
        let points = pass.points();
        let (mut truth, mut hu) = (vec![0.0; CLASSES * points], Vec::new());
        for index in 0..points {
            let at = [index % side, index / side % side, index / (side * side)];
            let spongy = if at.iter().sum::<usize>() % 2 == 0 { 150.0 } else { 450.0 };
            let (class, value) = match (apart2(at, bone_at) <= largest2, apart2(at, contrast_at) <= largest2) {
                (true, _) => (BONE, spongy),
                (_, true) => (SOFT, 300.0),
                _ if at[number % 3] == 0 => (AIR, -1000.0),
                _ => (SOFT, 40.0),
            };
            truth[class * points + index] = 1.0;
            hu.push(value);
        }
        Patch { windows: windows(&hu).collect(), truth, weight: vec![1.0; points] }
    }

    /// The layers that all use over patches of 16³: two of ten a step, until the loss of all ten is a fifteenth of what it was.
    #[test]
    fn ten_patches_are_learnt_by_heart() {
        let pass = Pass { patch: 16, keep: 8, ..MaterialsArchitecture::Default.passes()[0] };
        let patches: Vec<Patch> = (0..10).map(|number| bone_beside_contrast(&pass, number)).collect();
        let device = Device::flex().autodiff();
        let loss_of = |patches: &[Patch], parameters: &[f32]| {
            let network = CubeNetwork::new(&pass, parameters, &device).expect("as many parameters as the layers have");
            let loss = Batch::new(patches, &pass, &device).loss(&network);
            slopes_of(&loss, network.layers()).expect("a processor")
        };
        let mut adam = Adam::drawn(&pass.layers(), 1);
        let (first, _) = loss_of(&patches, &adam.parameters);
        let mut reached = None;
        // What learns nothing has all of them.
        for epoch in 0..120 {
            let mut sum = 0.0;
            for some in patches.chunks(2) {
                let (loss, slopes) = loss_of(some, &adam.parameters);
                sum += loss / 5.0;
                adam.step(&slopes, 3e-3, &StepRule::default());
            }
            // Each step was judged before it was taken: what they come to together is asked once it may do.
            if sum < SMALL_LOSS && loss_of(&patches, &adam.parameters).0 < SMALL_LOSS {
                reached = Some(epoch);
                break;
            }
        }
        let (last, _) = loss_of(&patches, &adam.parameters);
        println!("loss {first:.3}, then {last:.4} in epoch {reached:?}");
        assert!(first > 15.0 * SMALL_LOSS && reached.is_some(), "{first} {last}");
        // The control: each patch by the truth of the next one.
        let others: Vec<Patch> =
            (0..10).map(|at| Patch { truth: patches[(at + 1) % 10].truth.clone(), ..patches[at].clone() }).collect();
        let (off, _) = loss_of(&others, &adam.parameters);
        assert!(off > 10.0 * SMALL_LOSS, "the control: {off}");
    }

    /// Of 1 - Dice and cross-entropy together, which begin near 1.7.
    const SMALL_LOSS: f64 = 0.08;
}
