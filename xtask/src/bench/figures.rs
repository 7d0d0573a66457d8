//! The figures that a bench is run for, by the names under which they are followed over time.

use std::collections::BTreeMap;

use super::{Beside, Line, MANY, PRESETS, Round};

/// Each figure by preset and name, such as `push1.imagine_vs_twin_n64`.
pub(super) fn figures(lines: &[Line]) -> BTreeMap<String, f64> {
    let mut figures = BTreeMap::new();
    for preset in PRESETS {
        let mut put = |name: String, figure| figures.insert(format!("{preset}.{name}"), figure);
        for line in lines.iter().filter(|line| line.preset == preset) {
            let [_, ratio, _] = line.ratio();
            put(format!("{}_vs_twin_n{}", line.step, line.batch), ratio);
            if line.rounds.iter().all(|round| round.compiled.is_some()) {
                let compiled = |round: &Round| round.compiled.unwrap_or(f64::NAN) / round.rust;
                put(format!("imagine_vs_compile_n{}", line.batch), line.median(compiled));
            }
            if line.rounds.iter().any(|round| round.beside.is_some()) {
                let beside = |of: &dyn Fn(f64, &Beside) -> f64| {
                    line.median(|round| {
                        round.beside.as_ref().map_or(f64::NAN, |b| of(round.rust, b))
                    })
                };
                let rows = MANY as f64 / line.batch as f64;
                put("row_cost_512_over_64".to_owned(), beside(&|rust, b| b.many / rust / rows));
                put("roofline_share".to_owned(), beside(&|rust, b| b.macs / rust / b.multiply));
                put("state_bytes".to_owned(), beside(&|_, b| b.state));
            }
        }
    }
    figures
}

#[expect(clippy::print_stdout, reason = "the figures are what one runs it to see")]
pub(super) fn print(figures: &BTreeMap<String, f64>) {
    println!();
    for (name, figure) in figures {
        println!("{name:<32}{figure:>12.2}");
    }
}

#[cfg(test)]
mod tests {
    use super::{super::lines, *};

    #[test]
    fn figures_follow_from_the_rounds() {
        let mut lines = lines(&[64]);
        for line in &mut lines {
            let beside = Beside { many: 20.0, multiply: 100.0, macs: 60.0, state: 1000.0 };
            let beside = (line.step == "imagine").then_some(beside);
            let compiled = beside.is_some().then_some(3.0);
            line.rounds = vec![Round { rust: 2.0, twin: [5.0, 6.0], compiled, beside }];
        }
        let figures = figures(&lines);
        let close = |name: &str, figure: f64| assert!((figures[name] - figure).abs() < 1e-9);
        close("push1.imagine_vs_twin_n64", 2.5);
        close("tiny.observe_vs_twin_n64", 2.5);
        close("tiny.row_cost_512_over_64", 1.25);
        close("tiny.roofline_share", 0.3);
        close("tiny.state_bytes", 1000.0);
        close("tiny.imagine_vs_compile_n64", 1.5);
    }
}
