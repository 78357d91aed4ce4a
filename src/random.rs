//! Counter-based random numbers keyed by (seed, frame, pixel, purpose), so that no result depends on thread order.
//!
//! Philox 4×32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"). The WGSL twin is `shaders/shared/philox.wgsl`.

/// What a stream of random numbers is for; streams of different purposes are independent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// Quantum noise of a pixel.
    QuantumNoise = 1,
    /// Electronic noise of a pixel.
    ReadoutNoise = 2,
    /// The Monte Carlo transport of a history.
    Transport = 3,
    /// Synthetic scenes of tests and evaluations.
    Evaluation = 4,
    /// Scenes that networks are trained on.
    Training = 5,
    /// First weights of a network.
    FirstWeights = 6,
    /// Order and mirroring of the samples of a training's epoch.
    Epoch = 7,
    /// Which seeds a training holds out.
    HeldOut = 8,
}

/// A stream of 32-bit words for one (seed, frame, pixel, purpose).
#[derive(Clone, Debug)]
pub struct Stream {
    key: [u32; 2],
    counter: [u32; 4],
    block: [u32; 4],
    used: usize,
}

impl Stream {
    /// The stream of `pixel` (row-major index) in `frame` for `purpose`.
    #[must_use]
    pub fn new(seed: u64, frame: u32, pixel: u32, purpose: Purpose) -> Self {
        Self { key: [seed as u32, (seed >> 32) as u32], counter: [0, pixel, frame, purpose as u32], block: [0; 4], used: 4 }
    }

    /// The next 32 random bits.
    pub fn next_u32(&mut self) -> u32 {
        if self.used == 4 {
            self.block = philox(self.counter, self.key);
            self.counter[0] = self.counter[0].wrapping_add(1);
            self.used = 0;
        }
        self.used += 1;
        self.block[self.used - 1]
    }

    /// Uniform in the open interval (0, 1), with 32 bits: (n + ½)·2⁻³².
    pub fn uniform(&mut self) -> f64 {
        (f64::from(self.next_u32()) + 0.5) * (1.0 / 4_294_967_296.0)
    }

    /// Standard normal (Box–Muller; uses two words).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Ten rounds of Philox 4×32 on `counter` with `key`.
#[must_use]
pub fn philox(mut counter: [u32; 4], mut key: [u32; 2]) -> [u32; 4] {
    for _ in 0..10 {
        let first = u64::from(counter[0]) * 0xD251_1F53;
        let second = u64::from(counter[2]) * 0xCD9E_8D57;
        counter = [
            (second >> 32) as u32 ^ counter[1] ^ key[0],
            second as u32,
            (first >> 32) as u32 ^ counter[3] ^ key[1],
            first as u32,
        ];
        key = [key[0].wrapping_add(0x9E37_79B9), key[1].wrapping_add(0xBB67_AE85)];
    }
    counter
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Known answers published with the Random123 library.
    #[test]
    fn philox_gives_the_published_answers() {
        assert_eq!(philox([0; 4], [0; 2]), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
        assert_eq!(philox([u32::MAX; 4], [u32::MAX; 2]), [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]);
    }

    #[test]
    fn streams_differ_by_every_key() {
        let word = |seed, frame, pixel, purpose| Stream::new(seed, frame, pixel, purpose).next_u32();
        let base = word(1, 2, 3, Purpose::QuantumNoise);
        for other in [
            word(9, 2, 3, Purpose::QuantumNoise),
            // Beyond 32 bits.
            word(1 + (1 << 32), 2, 3, Purpose::QuantumNoise),
            word(1, 9, 3, Purpose::QuantumNoise),
            word(1, 2, 9, Purpose::QuantumNoise),
            word(1, 2, 3, Purpose::ReadoutNoise),
        ] {
            assert_ne!(base, other);
        }
    }
}
