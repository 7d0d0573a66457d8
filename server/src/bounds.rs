//! What requests may hold, whatever the model and whoever operates the server.
//!
//! Said once: the service refuses what is beyond, and the document of the REST API tells it. What a model or an
//! operator sets is in `Model.limits` and in no document.

use std::{fmt, ops::Bound};

use crate::error::Error;

/// Finite numbers between two bounds.
#[derive(Clone, Copy, Debug)]
pub struct Numbers {
    /// The lower bound.
    pub least: Bound<f64>,
    /// The upper bound.
    pub most: Bound<f64>,
}

const fn numbers(least: Bound<f64>, most: Bound<f64>) -> Numbers {
    Numbers { least, most }
}

const fn between(least: f64, most: f64) -> Numbers {
    numbers(Bound::Included(least), Bound::Included(most))
}

const fn at_least(least: f64) -> Numbers {
    numbers(Bound::Included(least), Bound::Unbounded)
}

/// Counts of which there is one, and of what is divided among two.
pub const ONE_OR_MORE: Numbers = at_least(1.0);
/// As above.
pub const TWO_OR_MORE: Numbers = at_least(2.0);
/// Distances and the like.
pub const NOT_NEGATIVE: Numbers = at_least(0.0);
/// Scales of what is drawn.
pub const POSITIVE: Numbers = numbers(Bound::Excluded(0.0), Bound::Unbounded);
/// A share of something.
pub const SHARE: Numbers = between(0.0, 1.0);
/// A share that is not nothing.
pub const SOME: Numbers = numbers(Bound::Excluded(0.0), Bound::Included(1.0));
/// A share that is not the whole.
pub const NOT_ALL: Numbers = numbers(Bound::Included(0.0), Bound::Excluded(1.0));

/// Sessions of a page.
pub const PAGE_SIZE: Numbers = between(1.0, 1000.0);
/// Forks of one request.
pub const FORKS: Numbers = between(1.0, 1000.0);
/// Characters of a label.
pub const LABEL: usize = 128;

/// Terms of a cost program, and as many constraints.
pub const TERMS: usize = 64;
/// Iterations of a search.
pub const ITERATIONS: Numbers = between(1.0, 100.0);
/// Exponents of a noise spectrum.
pub const SPECTRUM: Numbers = between(0.0, 10.0);

/// Pixels of a picture for one of the model.
pub const SCALE: Numbers = between(1.0, 16.0);
/// Milliseconds between two overviews.
pub const EVERY_MILLIS: Numbers = between(100.0, 60_000.0);
/// Sessions of an overview.
pub const OVERVIEW: Numbers = between(0.0, 1000.0);

impl Numbers {
    /// The value, if it is one of these numbers.
    ///
    /// # Errors
    /// If it is not; `field` is its path in the request.
    pub fn check<T: Copy + fmt::Display + Into<f64>>(
        self,
        value: T,
        field: &str,
    ) -> Result<T, Error> {
        let number: f64 = value.into();
        let holds = number.is_finite() && std::ops::RangeBounds::contains(&self.bounds(), &number);
        if holds { Ok(value) } else { Err(Error::invalid(field, value, self.to_string())) }
    }

    fn bounds(self) -> (Bound<f64>, Bound<f64>) {
        (self.least, self.most)
    }
}

impl fmt::Display for Numbers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.bounds() {
            (Bound::Included(least), Bound::Included(most)) => {
                return write!(f, "{least} to {most}");
            }
            (Bound::Included(least), _) => write!(f, "{least} or more")?,
            (Bound::Excluded(least), _) => write!(f, "more than {least}")?,
            (Bound::Unbounded, _) => write!(f, "a finite number")?,
        }
        match self.most {
            Bound::Included(most) => write!(f, ", at most {most}"),
            Bound::Excluded(most) => write!(f, ", less than {most}"),
            Bound::Unbounded => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_kept_and_told() {
        let told =
            |numbers: Numbers, value: f32| numbers.check(value, "x").unwrap_err().to_string();
        assert_eq!(told(PAGE_SIZE, 0.0), "x is 0, expected 1 to 1000");
        assert_eq!(told(SOME, 0.0), "x is 0, expected more than 0, at most 1");
        assert_eq!(told(NOT_ALL, 1.0), "x is 1, expected 0 or more, less than 1");
        assert_eq!(told(ONE_OR_MORE, f32::INFINITY), "x is inf, expected 1 or more");
        assert_eq!(told(POSITIVE, f32::NAN), "x is NaN, expected more than 0");
        for (numbers, value) in [(PAGE_SIZE, 1000.0), (SOME, 1.0), (NOT_ALL, 0.0), (POSITIVE, 1e30)]
        {
            assert_eq!(numbers.check(value, "x"), Ok(value));
        }
    }
}
