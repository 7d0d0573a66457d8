//! Candidate action sequences: from a file, or drawn.

use std::path::Path;

use anyhow::Context as _;
use gatsbi_client::{ActionDimension, Actions};
use rand::{RngExt as _, SeedableRng as _, rngs::ChaCha8Rng};

use crate::failure::{Misuse, misuse};

/// Reads candidates from a `.json` file, `[H][A]` or `[N][H][A]` numbers, or a `.csv` file: a step a line, and an empty
/// line between two candidates.
pub(crate) fn read(path: &Path) -> anyhow::Result<Actions> {
    let file = path.display();
    let extension = path.extension().and_then(|extension| extension.to_str());
    if !matches!(extension, Some("csv" | "json")) {
        misuse!("--actions is {file}, expected a .csv or .json file");
    }
    let text = fs_err::read_to_string(path).map_err(|error| Misuse(error.to_string()))?;
    let candidates = if extension == Some("csv") { csv(&text) } else { json(&text) };
    let candidates = candidates.with_context(|| format!("{file}"))?;
    Actions::nested(&candidates).with_context(|| format!("{file}"))
}

/// Draws `n` candidates uniformly from what the model has seen: offset and twice the scale to both sides.
pub(crate) fn draw(
    dimensions: &[ActionDimension],
    n: usize,
    horizon: usize,
    seed: u64,
) -> gatsbi_client::Result<Actions> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut values = Vec::new();
    for _ in 0..n * horizon {
        for ActionDimension { offset, scale, .. } in dimensions {
            let share: f64 = random.random_range(-2.0..=2.0);
            values.push((offset + share * scale) as f32);
        }
    }
    Actions::new([n, horizon, dimensions.len()], values)
}

fn csv(text: &str) -> anyhow::Result<Vec<Vec<Vec<f32>>>> {
    let mut candidates = vec![Vec::new()];
    for (number, line) in text.lines().enumerate() {
        if line.trim().is_empty() {
            candidates.push(Vec::new());
            continue;
        }
        let mut step = Vec::new();
        for (column, cell) in line.split(',').enumerate() {
            let Ok(value) = cell.trim().parse::<f32>() else {
                let (line, column) = (number + 1, column + 1);
                misuse!("line {line}, column {column} is {:?}, expected a number", cell.trim());
            };
            step.push(value);
        }
        if let Some(last) = candidates.last_mut() {
            last.push(step);
        }
    }
    candidates.retain(|candidate| !candidate.is_empty());
    Ok(candidates)
}

fn json(text: &str) -> anyhow::Result<Vec<Vec<Vec<f32>>>> {
    serde_json::from_str(text)
        .or_else(|_| serde_json::from_str(text).map(|candidate| vec![candidate]))
        .or_else(|error| misuse!("expected [H][A] or [N][H][A] numbers: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(name: &str, text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        fs_err::write(&path, text).unwrap();
        (folder, path)
    }

    #[test]
    fn every_form_reads_the_same() {
        for (name, text) in [
            ("a.csv", "1, 2\n3,4\n5,6\n\n-1,0\n0,0\n0,1e-1\n"),
            ("a.json", "[[[1, 2], [3, 4], [5, 6]], [[-1, 0], [0, 0], [0, 0.1]]]"),
        ] {
            let (_folder, path) = write(name, text);
            let actions = read(&path).unwrap();
            assert_eq!((actions.candidates(), actions.horizon()), (2, 3), "{name}");
            let expected = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.1];
            assert_eq!(actions.values(), expected, "{name}");
        }
        let (_folder, path) = write("one.json", "[[1, 2], [3, 4]]");
        assert_eq!(read(&path).unwrap().candidates(), 1);
    }

    #[test]
    fn mistakes_are_located() {
        #[track_caller]
        fn check(name: &str, text: &str, expected: &str) {
            let (_folder, path) = write(name, text);
            let error = format!("{:#}", read(&path).unwrap_err());
            assert!(error.contains(expected), "{error}");
        }
        check("a.csv", "1,2\n3,x\n", "line 2, column 2 is \"x\", expected a number");
        check("a.csv", "1,2\n\n1,2\n3,4\n", "is 2 steps in candidate 1, expected 1 steps");
        check("a.csv", "", "is 0 numbers");
        check("a.json", "{}", "expected [H][A] or [N][H][A] numbers");
        check("a.txt", "", "expected a .csv or .json file");
        let error = read(Path::new("missing.csv")).unwrap_err();
        assert!(error.is::<Misuse>() && error.to_string().contains("missing.csv"), "{error}");
    }

    #[test]
    fn drawn_actions_stay_within_what_the_model_has_seen() {
        let dimension = |offset, scale| ActionDimension { offset, scale, ..Default::default() };
        let dimensions = [dimension(0.0, 0.5), dimension(10.0, 1.0)];
        let actions = draw(&dimensions, 20, 5, 7).unwrap();
        assert_eq!(actions.values().len(), 200);
        let (pairs, _) = actions.values().as_chunks::<2>();
        assert!(pairs.iter().all(|[a, b]| (-1.0..=1.0).contains(a) && (8.0..=12.0).contains(b)));
        assert!(pairs.iter().any(|[a, _]| *a > 0.5) && pairs.iter().any(|[a, _]| *a < -0.5));
        assert_eq!(draw(&dimensions, 20, 5, 7).unwrap(), actions);
        assert_ne!(draw(&dimensions, 20, 5, 8).unwrap(), actions);
    }
}
