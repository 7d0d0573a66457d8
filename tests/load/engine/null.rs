//! A world model that computes next to nothing: it remembers what it saw, and imagines that nothing happens.
//!
//! It takes and gives what others do: frames of 64 x 64 pixels, 7 numbers of an action, a belief of 16 kB. What it takes
//! to be served is what the service takes.

use gatsbi_models::{
    noise::Noise,
    scene::{ObjectTable, Output, Outputs, Scene},
    state::{Field, FieldKind, State, StateLayout},
    world_model::{ActionDimension, ModelSpec, Preprocess, WorldModel},
};
use tch::{Device, Kind, Tensor};

const SIDE: i64 = 64;
const ACTIONS: usize = 7;
const OBJECTS: i64 = 7;

/// The model.
#[derive(Debug)]
pub(crate) struct Null {
    spec: ModelSpec,
    layout: StateLayout,
}

impl Null {
    pub(crate) fn new() -> Self {
        let action = |i| ActionDimension {
            name: format!("joint {i}"),
            unit: String::new(),
            offset: 0.0,
            scale: 1.0,
        };
        let spec = ModelSpec {
            name: "null".to_owned(),
            hash: "0".repeat(64),
            image_size: SIDE,
            preprocess: Preprocess::Stretch,
            frame_period: None,
            actions: (0..ACTIONS).map(action).collect(),
            slots: 1,
            agent_slot: None,
            max_objects: OBJECTS,
            keypoints: None,
            latents: 1,
            trained_steps: 0,
            provenance: "{}".to_owned(),
        };
        let field = |name, shape: &[i64], kind| Field { name, shape: shape.to_vec(), kind };
        let layout =
            [field("seen", &[SIDE, SIDE], FieldKind::Float), field("step", &[1], FieldKind::Int)];
        Self { spec, layout: layout.into_iter().collect() }
    }

    fn step(seen: Tensor, state: &State, wanted: Outputs) -> (State, Scene) {
        let batch = state.batch();
        let frame = wanted
            .contains(Output::Frame)
            .then(|| seen.view([batch, 1, SIDE, SIDE]).expand([batch, 3, SIDE, SIDE], false));
        let objects = wanted.contains(Output::Objects).then(|| ObjectTable {
            ids: Tensor::full([batch, OBJECTS], -1, (Kind::Int64, Device::Cpu)),
            values: Tensor::zeros([batch, OBJECTS, 6], (Kind::Float, Device::Cpu)),
        });
        let scene = Scene { frame, objects, ..Scene::default() };
        (State { floats: seen, ints: &state.ints + 1 }, scene)
    }
}

impl WorldModel for Null {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn layout(&self) -> &StateLayout {
        &self.layout
    }

    fn device(&self) -> Device {
        Device::Cpu
    }

    fn initial_state(&self, batch: i64) -> State {
        State {
            floats: Tensor::zeros([batch, self.layout.floats()], (Kind::Float, Device::Cpu)),
            ints: Tensor::zeros([batch, self.layout.ints()], (Kind::Int64, Device::Cpu)),
        }
    }

    fn observe(
        &self,
        state: &State,
        frame: Option<&Tensor>,
        _action: &Tensor,
        _noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        let green = |frame: &Tensor| frame.select(1, 1).reshape([state.batch(), -1]);
        let seen = frame.map_or_else(|| state.floats.shallow_clone(), green);
        Self::step(seen, state, wanted)
    }

    fn imagine(
        &self,
        state: &State,
        _action: &Tensor,
        _noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        Self::step(state.floats.shallow_clone(), state, wanted)
    }
}

#[cfg(test)]
mod tests {
    use gatsbi_models::noise::PhiloxNoise;

    use super::*;

    #[test]
    fn nothing_happens_to_what_was_seen() {
        let model = Null::new();
        let noise = PhiloxNoise::mean(2, Device::Cpu);
        let frame = Tensor::rand([2, 3, SIDE, SIDE], (Kind::Float, Device::Cpu));
        let action = Tensor::zeros([2, ACTIONS as i64], (Kind::Float, Device::Cpu));
        let wanted = [Output::Frame, Output::Objects].into_iter().collect();
        let (seen, _) =
            model.observe(&model.initial_state(2), Some(&frame), &action, &noise, wanted);
        let (state, scene) = model.imagine(&seen, &action, &noise, wanted);
        assert_eq!(scene.frame.unwrap().select(1, 0), frame.select(1, 1));
        assert_eq!(scene.objects.unwrap().ids.size(), [2, OBJECTS]);
        let rows = state.to_rows();
        assert_eq!((rows[1].ints[0], rows[1].floats.len() as i64), (2, model.layout().floats()));
    }
}
