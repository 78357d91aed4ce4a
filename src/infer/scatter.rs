//! Scattered radiation by a network: the seam, and the network that comes from files.

use std::path::Path;

use burn::tensor::{Tensor, TensorData};

use super::{CELLS, COLUMNS, Card, InferError, Input, Network, NetworkDevice, NetworkFiles, Prediction, ROWS, fetched};

/// The network that comes with the program: where its files are in the sources, and what they hold.
const SHIPPED: &str = "calibration/networks/scatter";
const SHIPPED_WEIGHTS: &[u8] = include_bytes!("../../calibration/networks/scatter.safetensors");
const SHIPPED_CARD: &[u8] = include_bytes!("../../calibration/networks/scatter.json");

/// Anything that predicts scatter from what the rays of an image met.
pub trait ScatterNetwork {
    /// What it is.
    fn card(&self) -> &Card;

    /// The scatter of `sample`. Inputs outside the training's range are predicted all the same, and named.
    ///
    /// # Errors
    /// When `sample` has another size than the network takes, or its scale is no positive number; when the device fails.
    fn predict(&self, sample: &Input) -> Result<Prediction, InferError>;
}

/// A network from files.
#[derive(Clone, Debug)]
pub struct LoadedNetwork {
    card: Card,
    network: Network,
    device: NetworkDevice,
}

impl LoadedNetwork {
    /// The network `name` (a path, with or without the ending of one of its files), which must take `channels` and `scalar_names`, in
    /// this order.
    ///
    /// # Errors
    /// When a file is missing, truncated or of another network, or the network takes other inputs.
    pub fn load(name: &Path, channels: &[&str], scalar_names: &[&str]) -> Result<Self, InferError> {
        let files = NetworkFiles::of(name);
        let read = files.read::<Card>()?;
        Self::of(files, read, channels, scalar_names, &NetworkDevice::default())
    }

    /// The network that comes with the program.
    ///
    /// # Errors
    /// When it takes other inputs.
    pub fn shipped(channels: &[&str], scalar_names: &[&str]) -> Result<Self, InferError> {
        Self::shipped_on(&NetworkDevice::default(), channels, scalar_names)
    }

    /// The same on `device`.
    ///
    /// # Errors
    /// As [`Self::shipped`].
    pub fn shipped_on(device: &NetworkDevice, channels: &[&str], scalar_names: &[&str]) -> Result<Self, InferError> {
        let files = NetworkFiles::of(Path::new(SHIPPED));
        let read = files.parse(SHIPPED_WEIGHTS, SHIPPED_CARD)?;
        Self::of(files, read, channels, scalar_names, device)
    }

    fn of(
        files: NetworkFiles,
        (card, parameters): (Card, Vec<f32>),
        channels: &[&str],
        scalar_names: &[&str],
        device: &NetworkDevice,
    ) -> Result<Self, InferError> {
        for (what, expected, found) in
            [("channels", channels, card.channel_names()), ("scalars", scalar_names, card.scalar_names())]
        {
            if expected != found {
                let expected = expected.iter().map(|name| (*name).to_owned()).collect();
                return Err(InferError::Names { path: files.card, what, expected, found });
            }
        }
        let network = Network::new(card.architecture, channels.len(), scalar_names.len(), &parameters, &device.device)
            .expect("as many parameters as the layers have were read");
        Ok(Self { card, network, device: device.clone() })
    }
}

impl ScatterNetwork for LoadedNetwork {
    fn card(&self) -> &Card {
        &self.card
    }

    fn predict(&self, sample: &Input) -> Result<Prediction, InferError> {
        self.card.check_input(sample)?;
        let outside = self.card.outside(sample);
        // A rectifier may turn NaN into 0: it must not come out as a number that looks like scatter.
        if !sample.inputs.iter().chain(&sample.scalars).all(|value| value.is_finite()) {
            return Ok(Prediction { single: vec![f64::NAN; CELLS], multiple: vec![f64::NAN; CELLS], outside });
        }
        let (channels, scalars) = self.card.normalised(sample);
        let shape = [1, self.card.channels.len(), ROWS, COLUMNS];
        let on = &self.device.device;
        let channels = Tensor::<4>::from_data(TensorData::new(channels, shape), on);
        let scalars = Tensor::<2>::from_data(TensorData::new(scalars, [1, self.card.scalars.len()]), on);
        let failed = |detail: String| InferError::Device { name: self.device.name.clone(), detail };
        let logarithm = fetched(self.network.forward(channels, scalars)).map_err(failed)?;
        if let Some(fault) = self.device.fault() {
            return Err(failed(fault.to_owned()));
        }
        let scatter = logarithm.iter().map(|value| f64::from(sample.scale) * f64::from(*value).exp());
        let mut single: Vec<f64> = scatter.collect();
        let multiple = single.split_off(CELLS);
        Ok(Prediction { single, multiple, outside })
    }
}
