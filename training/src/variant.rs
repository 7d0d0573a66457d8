//! Variants of a recipe, one switch away from it: what the paper's ablations compare.

use anyhow::ensure;
use clap::ValueEnum;
use gatsbi_models::config::{
    AgentFeature, GatsbiConfig, Graph, Interaction, KnnAggregate, KnnMetric, ObjectConfig,
};
use serde::{Deserialize, Serialize};

use crate::recipe::Recipe;

/// What is different.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    Deserialize,
    Eq,
    Hash,
    Ord,
    PartialEq,
    PartialOrd,
    Serialize,
    ValueEnum,
)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum Variant {
    /// Nothing.
    #[default]
    Plain,
    /// Objects know the environment, not the agent (INTER1, as in G-SWM).
    Inter1,
    /// Objects know the agent by a local feature each (INTER2).
    Inter2,
    /// Objects know the agent by one global feature (INTER3, the paper's choice).
    Inter3,
    /// Every object sees every other, as in G-SWM.
    Fc,
    /// Objects see their three nearest neighbours.
    Knn3,
    /// Objects see their five nearest neighbours.
    Knn5,
    /// Posterior and prior of the mixture share their memories (the paper's integrated RNN).
    OneMemory,
    /// The agent moves objects one step late, as in the original.
    AgentCurrent,
    /// The agent moves objects in the same step.
    AgentNext,
    /// The keypoints' dynamics do not teach the network that enhances actions (paper's supplement E.6).
    KeypointsApart,
}

impl Variant {
    /// The name that command lines and recipes use.
    pub fn name(self) -> String {
        self.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()
    }

    /// Turns its switch in an architecture.
    pub fn apply(self, model: &mut GatsbiConfig) {
        let ObjectConfig { interaction, graph, agent_feature, .. } = &mut model.objects;
        // As wide as what it replaces, where that merged an agent too.
        let outputs = match *interaction {
            Interaction::Inter1 => model.action.enhanced,
            Interaction::Inter2 { outputs, .. } | Interaction::Inter3 { outputs, .. } => outputs,
        };
        let knn =
            |k| Graph::Knn { k, metric: KnnMetric::Distance, aggregate: KnnAggregate::Attention };
        match self {
            Self::Plain | Self::KeypointsApart => {}
            Self::Inter1 => *interaction = Interaction::Inter1,
            Self::Inter2 => *interaction = Interaction::Inter2 { outputs, celu: false },
            Self::Inter3 => *interaction = Interaction::Inter3 { outputs, celu: false },
            Self::OneMemory => model.mixture.one_memory = true,
            Self::Fc => *graph = Graph::FullyConnected,
            Self::Knn3 => *graph = knn(3),
            Self::Knn5 => *graph = knn(5),
            Self::AgentCurrent => *agent_feature = AgentFeature::Current,
            Self::AgentNext => *agent_feature = AgentFeature::Next,
        }
    }

    /// The recipe with this variant, cut to `steps`.
    ///
    /// # Errors
    /// If the recipe has nothing that the switch could change.
    pub fn of(self, recipe: &Recipe, steps: u64) -> anyhow::Result<Recipe> {
        ensure!(
            self != Self::KeypointsApart || recipe.keypoints.is_some(),
            "the recipe {} trains no keypoints, so keypoints_apart changes nothing",
            recipe.name
        );
        let name = match self {
            Self::Plain => recipe.name.clone(),
            _ => format!("{}-{}", recipe.name, self.name()),
        };
        Ok(Recipe { name, variant: self, steps: steps.min(recipe.steps), ..recipe.clone() })
    }
}

#[cfg(test)]
mod tests {
    use gatsbi_models::config::presets;

    use super::*;

    #[test]
    fn every_variant_of_the_presets_can_be_built() {
        for preset in presets::NAMES {
            for variant in Variant::value_variants() {
                let mut model = presets::preset(preset).expect("a known preset");
                let needs_agent = matches!(variant, Variant::Inter2 | Variant::Inter3);
                if needs_agent && model.action.dim == 0 {
                    continue;
                }
                let plain = model.clone();
                variant.apply(&mut model);
                assert_eq!(model.problems(), Vec::<String>::new(), "{preset} {variant:?}");
                let same = matches!(variant, Variant::Plain | Variant::KeypointsApart);
                assert!(!same || model == plain, "{preset} {variant:?}");
            }
        }
    }

    #[test]
    fn a_switch_that_changes_nothing_is_refused() {
        let recipe = Recipe::load("tiny").expect("a named recipe");
        let error = Variant::KeypointsApart.of(&recipe, 10).expect_err("tiny has no keypoints");
        assert!(error.to_string().contains("trains no keypoints"), "{error}");
        let shorter = Variant::Fc.of(&recipe, 10).expect("it has objects");
        assert_eq!((shorter.steps, shorter.name.as_str()), (10, "push1-tiny-fc"));
    }
}
