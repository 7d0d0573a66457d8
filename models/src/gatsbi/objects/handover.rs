//! Objects told apart by their colours: what is found near a known object in its colour is that object, even where it has
//! been pushed out of the window that propagation looks into, or was hidden by the arm for a while.

use tch::{Kind, Tensor};

use super::{
    gather_rows,
    latents::{absent, looking_like, place, presence, shift, with_presence},
};
use crate::nn::spatial_transformer::crop;

/// Share of a box's sides that counts as its middle: little enough to lie on an object that the box misses by a few pixels.
const MIDDLE: f64 = 0.3;

/// Samples along each side of a middle.
const SAMPLES: i64 = 3;

/// Presence of an object that is kept in mind: it is believed in, but the frame is explained by whatever covers it.
const COVERED: f64 = 0.51;

/// Known objects in a frame.
pub(super) struct Known<'a> {
    /// Latent vectors, `[B, N, Z]`.
    pub(super) z: &'a Tensor,
    /// The same a frame earlier, `[B, N, Z]`.
    pub(super) before: &'a Tensor,
    /// Identities, `[B, N]`.
    pub(super) ids: &'a Tensor,
    /// Colours that they are known to have, `[B, N, 3]`.
    pub(super) own: Tensor,
    /// The frame, `[B, 3, H, W]`.
    pub(super) frame: &'a Tensor,
    /// Distance between colours above which they are of different objects.
    pub(super) unlike: f64,
}

impl Known<'_> {
    /// Which have the colour that the frame has at `others [B, M, Z]`, `[B, M, N]` bool.
    pub(super) fn alike(&self, others: &Tensor) -> Tensor {
        self.difference(others).lt(1.0)
    }

    /// At which of `others [B, M, Z]` the frame shows nothing but `mu_mix [B, 3, H, W]`, `[B, M]` bool.
    pub(super) fn nothing_at(&self, others: &Tensor, mu_mix: &Tensor) -> Tensor {
        let [seen, behind] = [self.frame, mu_mix].map(|image| colours(image, others));
        squared(&seen, &behind).le(self.unlike.powi(2))
    }

    /// The objects without those that are lost: not to be seen where they are thought to be.
    pub(super) fn seen(&self) -> Tensor {
        let differs = squared(&self.own, &colours(self.frame, self.z)).gt(self.unlike.powi(2));
        absent(self.z, &differs.logical_and(&self.ids.ge(0)))
    }

    /// The known objects, and what is left of `found [B, D, Z]`, after those that are not `seen` have become what is likely
    /// them: one of the finds, or an object that is known since later, not farther than `reach`.
    pub(super) fn recognised(&self, found: &Tensor, seen: &Tensor, reach: f64) -> (Tensor, Tensor) {
        let finds = found.size()[1];
        let lost = present(seen).logical_not().logical_and(&self.ids.ge(0));
        let pool = Tensor::cat(&[found, seen], 1); // [B, D + N, Z]
        let way = squared(&shift(&pool).unsqueeze(2), &shift(self.z).unsqueeze(1)) / reach.powi(2);
        let difference = self.difference(&pool);
        let newest =
            self.ids.new_full([found.size()[0], finds], i64::MAX, (Kind::Int64, self.ids.device()));
        let since = Tensor::cat(&[&newest, self.ids], 1);
        let may = since
            .unsqueeze(2)
            .greater_tensor(&self.ids.unsqueeze(1))
            .logical_and(&present(&pool).unsqueeze(2))
            .logical_and(&lost.unsqueeze(1))
            .logical_and(&difference.lt(1.0))
            .logical_and(&way.lt(1.0));
        let cost = (difference + way).masked_fill(&may.logical_not(), f64::INFINITY);
        let (least, best) = cost.min_dim(1, false); // [B, N] into the pool
        let whose = cost.argmin(2, false).gather(1, &best, false);
        let itself = Tensor::arange(best.size()[1], (Kind::Int64, best.device()));
        let recognised = whose.eq_tensor(&itself).logical_and(&least.isfinite()); // [B, N]
        let taken =
            since.zeros_like().scatter_add(1, &best, &recognised.to_kind(Kind::Int64)).gt(0);
        // It is where it was found, and looks as it did before it was lost, as does one that is kept in mind.
        let there = gather_rows(&pool, &best).where_self(&recognised.unsqueeze(-1), self.z);
        let covered = lost.logical_and(&recognised.logical_not()).unsqueeze(-1);
        let pres = presence(&there);
        let pres = pres.clamp_max(COVERED).where_self(&covered, &pres);
        let there = with_presence(&there, &pres);
        let z = looking_like(&there, self.before).where_self(&lost.unsqueeze(-1), &there);
        let left = absent(found, &taken.narrow(1, 0, finds));
        (absent(&z, &taken.narrow(1, finds, best.size()[1])), left)
    }

    /// Squared differences between own colours and those of the frame at `others [B, M, Z]`, `[B, M, N]`; 1 is `unlike`.
    fn difference(&self, others: &Tensor) -> Tensor {
        let seen = colours(self.frame, others).unsqueeze(2);
        squared(&seen, &self.own.unsqueeze(1)) / self.unlike.powi(2)
    }
}

/// Which pairs of objects of colours `own [B, N, 3]` are of different ones, `[B, N, N]` bool.
pub(super) fn different(own: &Tensor, unlike: f64) -> Tensor {
    squared(&own.unsqueeze(2), &own.unsqueeze(1)).gt(unlike.powi(2))
}

/// Which of the objects `z [B, N, Z]` are present, `[B, N]` bool.
fn present(z: &Tensor) -> Tensor {
    presence(z).squeeze_dim(-1).gt(0.5)
}

/// Squared distances over the last axis.
fn squared(a: &Tensor, b: &Tensor) -> Tensor {
    (a - b).square().sum_dim_intlist(-1, false, Kind::Float)
}

/// Mean colours of `frame [B, 3, H, W]` in the middle of the boxes of objects `z [B, N, Z]`, `[B, N, 3]`.
fn colours(frame: &Tensor, z: &Tensor) -> Tensor {
    let boxes = place(z).detach();
    let middle = [boxes.narrow(-1, 0, 2) * MIDDLE, boxes.narrow(-1, 2, 2)];
    let glimpses = crop(frame, &Tensor::cat(&middle, -1), SAMPLES);
    glimpses.mean_dim([-1i64, -2].as_slice(), false, Kind::Float)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    const SAND: [f32; 3] = [0.8, 0.7, 0.6];
    const RED: [f32; 3] = [0.9, 0.1, 0.1];
    const BLUE: [f32; 3] = [0.1, 0.1, 0.9];

    /// A sandy frame of 64x64 with squares of 8 pixels around `(x, y)`.
    fn frame(squares: &[([f32; 3], i64, i64)]) -> Tensor {
        let colour = |colour: &[f32; 3]| Tensor::from_slice(colour).view([1, 3, 1, 1]);
        let frame = colour(&SAND).repeat([1, 1, 64, 64]);
        for (of, x, y) in squares {
            frame.narrow(2, y - 4, 8).narrow(3, x - 4, 8).copy_(&colour(of));
        }
        frame
    }

    /// Latent vectors of present objects at pixels `(x, y)`; what follows place counts the objects from `look` on.
    fn objects(places: &[(i64, i64)], look: f32) -> Tensor {
        let row = |(i, (x, y)): (usize, &(i64, i64))| {
            let at = |pixel: i64| pixel as f32 / 32.0 - 1.0;
            [1.0, 0.5, 0.15, 0.15, at(*x), at(*y), look + i as f32]
        };
        let rows: Vec<f32> = places.iter().enumerate().flat_map(row).collect();
        Tensor::from_slice(&rows).view([1, places.len() as i64, 7])
    }

    fn values(z: &Tensor, column: i64) -> Vec<f32> {
        Vec::try_from(z.select(-1, column).flatten(0, -1)).expect("a row of numbers")
    }

    /// Red and blue objects, known at (20, 20) and (44, 20).
    struct Case {
        z: Tensor,
        before: Tensor,
        ids: Tensor,
        own: Tensor,
        frame: Tensor,
    }

    impl Case {
        fn new(frame: Tensor) -> Self {
            let own = Tensor::from_slice(&[RED, BLUE].concat()).view([1, 2, 3]);
            let z = objects(&[(20, 20), (44, 20)], 10.0);
            let before = objects(&[(20, 20), (44, 20)], 70.0);
            Self { z, before, ids: Tensor::from_slice(&[3i64, 5]).unsqueeze(0), own, frame }
        }

        fn known(&self) -> Known<'_> {
            let Self { z, before, ids, own, frame } = self;
            Known { z, before, ids, own: own.shallow_clone(), frame, unlike: 0.3 }
        }

        /// Lost ones, the objects' places and latent vectors, and how present what is left of the finds is.
        fn after(&self, found: &Tensor) -> (Vec<bool>, Vec<[f32; 2]>, Tensor, Vec<f32>) {
            let known = self.known();
            let seen = known.seen();
            let (z, left) = known.recognised(found, &seen, 0.5);
            let places = values(&z, 4).into_iter().zip(values(&z, 5));
            let pixel = |at: f32| (at + 1.0) * 32.0;
            let lost = values(&seen, 0).iter().map(|presence| *presence == 0.0).collect();
            let places = places.map(|(x, y)| [pixel(x), pixel(y)]).collect();
            (lost, places, z, values(&left, 0))
        }
    }

    #[test]
    fn an_object_that_was_pushed_away_is_what_is_found_in_its_colour() {
        let case = Case::new(frame(&[(RED, 20, 32), (BLUE, 44, 20)]));
        let found = objects(&[(44, 21), (20, 32), (30, 50)], 20.0);
        let (lost, places, z, left) = case.after(&found);
        assert_eq!(lost, [true, false]);
        assert_eq!(places, [[20.0, 32.0], [44.0, 20.0]]);
        let look = values(&z, 6);
        assert_eq!(look, [70.0, 11.0], "a lost one looks as before, the other as it does now");
        assert_eq!(values(&z, 0), [1.0, 1.0]);
        assert_eq!(left, [1.0, 0.0, 1.0]);
    }

    #[test]
    fn one_that_is_found_nowhere_is_kept_in_mind() {
        for (squares, what) in [
            (vec![(BLUE, 44, 20)], "nothing is found"),
            (vec![(BLUE, 20, 32), (BLUE, 44, 20)], "another colour"),
            (vec![(RED, 20, 48), (BLUE, 44, 20)], "too far"),
        ] {
            let place = squares.first().map_or((0, 0), |(_, x, y)| (*x, *y));
            let case = Case::new(frame(&squares));
            let (lost, places, z, left) = case.after(&objects(&[place], 20.0));
            assert_eq!(values(&z, 0), [COVERED as f32, 1.0], "{what}");
            assert_eq!((lost, places[0]), (vec![true, false], [20.0, 20.0]), "{what}");
            assert_eq!(left, [1.0], "{what}");
        }
    }

    #[test]
    fn one_that_is_known_twice_keeps_the_older_identity() {
        let mut case = Case::new(frame(&[(RED, 30, 20)]));
        case.z = objects(&[(20, 20), (30, 20)], 10.0);
        case.before = case.z.shallow_clone();
        case.own = Tensor::from_slice(&[RED, RED].concat()).view([1, 2, 3]);
        let known = case.known();
        let none = absent(&case.z, &Tensor::ones([1, 2], (Kind::Bool, Device::Cpu)));
        let (z, _) = known.recognised(&none, &known.seen(), 0.5);
        assert_eq!(values(&z, 0), [1.0, 0.0]);
        assert!((values(&z, 4)[0] - (30.0 / 32.0 - 1.0)).abs() < 1e-6, "{z}");
    }

    #[test]
    fn of_two_that_are_lost_the_nearer_one_is_found() {
        let mut case = Case::new(frame(&[(RED, 30, 20)]));
        case.own = Tensor::from_slice(&[RED, RED].concat()).view([1, 2, 3]);
        let (lost, places, _, left) = case.after(&objects(&[(30, 20)], 20.0));
        assert_eq!(lost, [true, true]);
        assert_eq!(places, [[30.0, 20.0], [44.0, 20.0]]);
        assert_eq!(left, [0.0]);
    }

    #[test]
    fn empty_slots_are_never_lost() {
        let mut case = Case::new(frame(&[]));
        case.ids = Tensor::from_slice(&[-1i64, -1]).unsqueeze(0);
        let (lost, places, _, _) = case.after(&objects(&[(30, 20)], 20.0));
        assert_eq!(lost, [false, false]);
        assert_eq!(places, [[20.0, 20.0], [44.0, 20.0]]);
    }
}
