//! Which slot is the agent's: the one whose mask agrees best with a map of it, pooled over frames (mixture spec 3.1).

use std::fmt;

use tch::{Kind, Tensor};

/// A pixel above this belongs to a mask, or to the map.
const INSIDE: f64 = 0.5;

/// Shares of the image between which a map says something of the agent.
const TELLING: std::ops::RangeInclusive<f64> = 0.005..=0.4;

/// How much better than the next one a slot must be to be told from it.
const CLEAR: f64 = 1.3;

/// Agreement of every slot's mask with the map, pooled over frames.
#[derive(Clone, Debug)]
pub struct Vote {
    intersections: Vec<f64>,
    unions: Vec<f64>,
}

impl Vote {
    /// No frame yet, for K slots.
    pub fn new(slots: usize) -> Self {
        Self { intersections: vec![0.0; slots], unions: vec![0.0; slots] }
    }

    /// Counts frames: masks `[B, K, H, W]` and the map `[B, 1, H, W]`, both in [0, 1]. Those whose map covers next to
    /// nothing or nearly everything do not count.
    pub fn add(&mut self, masks: &Tensor, map: &Tensor) {
        let map = map.gt(INSIDE);
        let share: Vec<f64> = map
            .to_kind(Kind::Double)
            .mean_dim([1i64, 2, 3].as_slice(), false, Kind::Double)
            .try_into()
            .expect("one share per row");
        let masks = masks.gt(INSIDE);
        let count = |x: Tensor| -> Vec<f64> {
            let counts =
                x.to_kind(Kind::Double).sum_dim_intlist([2i64, 3].as_slice(), false, Kind::Double);
            counts.flatten(0, -1).try_into().expect("one count per row and slot")
        };
        let both = count(masks.logical_and(&map));
        let either = count(masks.logical_or(&map));
        let slots = self.unions.len();
        for (row, share) in share.into_iter().enumerate() {
            if TELLING.contains(&share) {
                for slot in 0..slots {
                    self.intersections[slot] += both[row * slots + slot];
                    self.unions[slot] += either[row * slots + slot];
                }
            }
        }
    }

    /// Pooled intersection over union of a slot's mask with the map; 0 where neither was ever there.
    pub fn agreement(&self, slot: usize) -> f64 {
        if self.unions[slot] > 0.0 { self.intersections[slot] / self.unions[slot] } else { 0.0 }
    }

    /// A slot that agrees clearly better than `slot`, if there is one.
    pub fn contradicts(&self, slot: usize) -> Option<usize> {
        let own = self.agreement(slot);
        (0..self.unions.len())
            .find(|other| self.agreement(*other) >= CLEAR * own.max(1e-9))
            .filter(|other| *other != slot)
    }
}

impl fmt::Display for Vote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for slot in 0..self.unions.len() {
            let comma = if slot > 0 { ", " } else { "" };
            write!(f, "{comma}slot {slot} {:.3}", self.agreement(slot))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    /// A map over the left `columns` of 8x8, twice.
    fn left(columns: i64) -> Tensor {
        let map = Tensor::zeros([2, 1, 8, 8], (Kind::Float, Device::Cpu));
        let _ = map.narrow(3, 0, columns).fill_(1.0);
        map
    }

    #[test]
    fn the_slot_that_lies_on_the_map_agrees() {
        let mut vote = Vote::new(3);
        let masks = Tensor::cat(&[left(1), left(3), 1.0 - left(4)], 1);
        vote.add(&masks, &left(2));
        assert!((vote.agreement(0) - 0.5).abs() < 1e-12, "{vote}");
        assert!((vote.agreement(1) - 2.0 / 3.0).abs() < 1e-12, "{vote}");
        assert!(vote.agreement(2) < 1e-12, "{vote}");
        assert_eq!((vote.contradicts(0), vote.contradicts(1)), (Some(1), None));
    }

    #[test]
    fn a_map_of_everything_says_nothing() {
        let mut vote = Vote::new(2);
        vote.add(&Tensor::cat(&[left(8), left(0)], 1), &left(8));
        assert!(vote.agreement(0) < 1e-12, "{vote}");
    }
}
