//! Counter-based noise: the same request gives the same numbers whatever shares its batch.
//!
//! Every random number of a step is addressed, not drawn: Philox 4x32-10 (Salmon et al. 2011) maps a key made
//! of the request's seed and sample index, and a counter made of (step, [`Site`], element), to 32 random bits.
//! Neither the row of the batch, the candidate's index nor the session enters, so candidates share random
//! numbers (a fair comparison) and splitting or reordering a request changes nothing.

use tch::{Device, Tensor};

/// The places of a step at which noise enters; part of the Philox counter, so numbers never change meaning.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
#[repr(u32)]
pub enum Site {
    /// Mask latents, `[B, K, z_mask]` normal.
    Mask = 0,
    /// Component latents, `[B, K, z_comp]` normal.
    Component = 1,
    /// Dynamics latent of a propagated or generated object, `[B, N, z_dyna]` normal.
    Dynamics = 2,
    /// Presence of a propagated object, `[B, N, 1]` uniform.
    Presence = 3,
    /// Depth offset of a propagated or generated object, `[B, N, 1]` normal.
    Depth = 4,
    /// Where offset of a propagated or generated object, `[B, N, 4]` normal.
    Where = 5,
    /// What offset of a propagated or generated object, `[B, N, z_what]` normal.
    What = 6,
    /// Dynamics latent of a discovery cell, `[B, G*G, z_dyna]` normal.
    DiscoveryDynamics = 7,
    /// Presence of a discovery cell, `[B, G*G, 1]` uniform.
    DiscoveryPresence = 8,
    /// Depth of a discovery cell, `[B, G*G, 1]` normal.
    DiscoveryDepth = 9,
    /// Raw where of a discovery cell, `[B, G*G, 4]` normal.
    DiscoveryWhere = 10,
    /// What of a discovery cell, `[B, G*G, z_what]` normal.
    DiscoveryWhat = 11,
}

/// A source of noise for one step of a batch.
pub trait Noise {
    /// Standard normal numbers of the given shape, batch first.
    fn normal(&self, site: Site, shape: &[i64]) -> Tensor;

    /// Uniform numbers in (0, 1) of the given shape, batch first.
    fn uniform(&self, site: Site, shape: &[i64]) -> Tensor;
}

/// How one row of a batch draws.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RowNoise {
    /// Every distribution gives its mean: normal noise 0, uniform noise 1/2, which a relaxed Bernoulli of
    /// temperature 1 maps to its probability.
    Mean,
    /// Samples addressed by the request's seed, the sample index and the step (frames absorbed before this one).
    Sample {
        /// Seed of the request (imagining) or session (observing).
        seed: u64,
        /// Which of the request's S samples.
        sample: u32,
        /// Step of the row's state; see the module documentation.
        step: u64,
    },
}

/// Philox noise with one [`RowNoise`] per row of the batch.
#[derive(Clone, Debug)]
pub struct PhiloxNoise {
    rows: Vec<RowNoise>,
    device: Device,
}

impl PhiloxNoise {
    /// Noise for a batch of `rows.len()` rows, delivered on `device`.
    pub fn new(rows: Vec<RowNoise>, device: Device) -> Self {
        Self { rows, device }
    }

    /// Mean mode for every row.
    pub fn mean(batch: i64, device: Device) -> Self {
        Self::new(vec![RowNoise::Mean; batch as usize], device)
    }

    fn fill(&self, shape: &[i64], mean: f32, draw: impl Fn(&mut [f32], &RowCounter)) -> Tensor {
        assert_eq!(shape[0] as usize, self.rows.len(), "noise is made for another batch size");
        if self.rows.iter().all(|row| *row == RowNoise::Mean) {
            return Tensor::full(shape, f64::from(mean), (tch::Kind::Float, self.device));
        }
        let width = shape[1..].iter().product::<i64>() as usize;
        let mut values = vec![mean; width * self.rows.len()];
        for (row, out) in self.rows.iter().zip(values.chunks_exact_mut(width)) {
            if let RowNoise::Sample { seed, sample, step } = *row {
                draw(out, &RowCounter { key: key(seed, sample), step });
            }
        }
        Tensor::from_slice(&values).view(shape).to_device(self.device)
    }
}

impl Noise for PhiloxNoise {
    fn normal(&self, site: Site, shape: &[i64]) -> Tensor {
        self.fill(shape, 0.0, |out, row| {
            for (block, out) in out.chunks_mut(4).enumerate() {
                let normals = normals(row.bits(site, block));
                out.copy_from_slice(&normals[..out.len()]);
            }
        })
    }

    fn uniform(&self, site: Site, shape: &[i64]) -> Tensor {
        self.fill(shape, 0.5, |out, row| {
            for (block, out) in out.chunks_mut(4).enumerate() {
                let bits = row.bits(site, block);
                for (out, bits) in out.iter_mut().zip(bits) {
                    *out = open_unit(bits);
                }
            }
        })
    }
}

/// Key and step of a row; [`RowCounter::bits`] completes them to an address.
struct RowCounter {
    key: [u32; 2],
    step: u64,
}

impl RowCounter {
    fn bits(&self, site: Site, block: usize) -> [u32; 4] {
        let counter = [block as u32, site as u32, self.step as u32, (self.step >> 32) as u32];
        philox4x32_10(counter, self.key)
    }
}

/// Key of a (seed, sample) pair; mixed so that neighbouring seeds and samples never share a key.
fn key(seed: u64, sample: u32) -> [u32; 2] {
    let key = mix(mix(seed).wrapping_add(u64::from(sample)));
    [key as u32, (key >> 32) as u32]
}

/// The finaliser of `SplitMix64` (Steele et al. 2014), a bijection of 64 bits.
pub(crate) fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Uniform in the open interval (0, 1): 24 bits, centred, exact in f32.
pub(crate) fn open_unit(bits: u32) -> f32 {
    ((bits >> 8) as f32 + 0.5) * (1.0 / 16_777_216.0)
}

/// Four standard normals from four words (Box-Muller on pairs).
pub(crate) fn normals(bits: [u32; 4]) -> [f32; 4] {
    let pair = |a: u32, b: u32| {
        let radius = (-2.0 * open_unit(a).ln()).sqrt();
        let (sin, cos) = (std::f32::consts::TAU * open_unit(b)).sin_cos();
        (radius * cos, radius * sin)
    };
    let (a, b) = pair(bits[0], bits[1]);
    let (c, d) = pair(bits[2], bits[3]);
    [a, b, c, d]
}

/// The Philox 4x32 bijection with ten rounds: 128 bits of counter to 128 random bits under a 64-bit key.
pub fn philox4x32_10(mut counter: [u32; 4], mut key: [u32; 2]) -> [u32; 4] {
    let multiply = |a: u32, b: u32| {
        let product = u64::from(a) * u64::from(b);
        ((product >> 32) as u32, product as u32)
    };
    for round in 0..10 {
        if round > 0 {
            key = [key[0].wrapping_add(0x9E37_79B9), key[1].wrapping_add(0xBB67_AE85)];
        }
        let (high0, low0) = multiply(0xD251_1F53, counter[0]);
        let (high1, low1) = multiply(0xCD9E_8D57, counter[2]);
        counter = [high1 ^ counter[1] ^ key[0], low1, high0 ^ counter[3] ^ key[1], low0];
    }
    counter
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The known answers published with Random123.
    #[test]
    fn philox_known_answers() {
        let ones = u32::MAX;
        assert_eq!(
            philox4x32_10([0; 4], [0; 2]),
            [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]
        );
        assert_eq!(
            philox4x32_10([ones; 4], [ones; 2]),
            [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]
        );
        assert_eq!(
            philox4x32_10(
                [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
                [0xa409_3822, 0x299f_31d0]
            ),
            [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1]
        );
    }

    fn sample(seed: u64, sample: u32, step: u64) -> RowNoise {
        RowNoise::Sample { seed, sample, step }
    }

    fn draw(rows: Vec<RowNoise>) -> Vec<Vec<f32>> {
        let batch = rows.len() as i64;
        let noise = PhiloxNoise::new(rows, Device::Cpu).normal(Site::Mask, &[batch, 3, 5]);
        noise.view([batch, 15]).try_into().unwrap()
    }

    #[test]
    fn a_row_does_not_depend_on_its_neighbours() {
        let alone = draw(vec![sample(7, 1, 3)]);
        let among = draw(vec![sample(1, 0, 0), RowNoise::Mean, sample(7, 1, 3)]);
        assert_eq!(alone[0], among[2]);
        assert_eq!(among[1], vec![0.0; 15]);
    }

    #[test]
    fn seed_sample_step_and_site_all_matter() {
        let rows = vec![sample(7, 0, 0), sample(8, 0, 0), sample(7, 1, 0), sample(7, 0, 1)];
        let drawn = draw(rows);
        for i in 0..4 {
            for j in 0..i {
                assert_ne!(drawn[i], drawn[j]);
            }
        }
        let noise = PhiloxNoise::new(vec![sample(7, 0, 0)], Device::Cpu);
        let other: Vec<f32> =
            noise.normal(Site::Component, &[1, 15]).view([15]).try_into().unwrap();
        assert_ne!(drawn[0], other);
    }

    #[test]
    fn moments_are_those_of_the_distributions() {
        let noise = PhiloxNoise::new(vec![sample(11, 0, 0)], Device::Cpu);
        let normal = noise.normal(Site::What, &[1, 100_000]).to_kind(tch::Kind::Double);
        assert!(normal.mean(tch::Kind::Double).double_value(&[]).abs() < 0.01);
        assert!((normal.std(true).double_value(&[]) - 1.0).abs() < 0.01);
        let uniform = noise.uniform(Site::Presence, &[1, 100_000]);
        assert!((uniform.mean(tch::Kind::Double).double_value(&[]) - 0.5).abs() < 0.005);
        assert!(uniform.min().double_value(&[]) > 0.0 && uniform.max().double_value(&[]) < 1.0);
    }
}
