//! The objects' recurrent memories, posterior and prior (object spec 2.9 and 3.5).

use tch::Tensor;

use super::{
    relation::{Relations, gather_rows},
    surroundings::Surroundings,
};
use crate::{
    config::GatsbiConfig,
    gatsbi::mixture::Memory,
    nn::{Init, InitScheme, Linear, LstmCell, Path},
};

/// One memory: relations between objects, then an LSTM over `[z, relations, surroundings]`.
#[derive(Debug)]
pub(crate) struct ObjectMemory {
    pub(super) relations: Relations,
    input: Linear,
    cell: LstmCell,
    start: (Tensor, Tensor),
}

impl ObjectMemory {
    /// `which` is `post` or `prior`; `width` is that of a latent vector.
    pub(crate) fn new(path: &Path<'_>, which: &str, config: &GatsbiConfig, width: i64) -> Self {
        let hidden = config.objects.hidden;
        let rnn = path.sub(format!("temporal_rnn_{which}")).sub("mod");
        let input = path.sub(format!("temporal_rnn_{which}_input")).sub("mod");
        let inputs = width + hidden + Surroundings::width(config);
        let start = |name| {
            path.weight(&format!("{name}_init_{which}"), &[1, 1, hidden], Init::Normal { std: 1.0 })
        };
        Self {
            relations: Relations::new(path, which, &config.objects, width + hidden),
            input: Linear::new(&input, inputs, hidden, InitScheme::Framework),
            cell: LstmCell::new(&rnn, hidden, hidden),
            start: (start("h"), start("c")),
        }
    }

    /// The learned memory of `count` objects that were never seen before, `[B, count, hidden]`.
    pub(crate) fn initial(&self, batch: i64, count: i64) -> Memory {
        let expand = |x: &Tensor| x.expand([batch, count, x.size()[2]], false);
        Memory { h: expand(&self.start.0), c: expand(&self.start.1) }
    }

    /// Lets objects remember a step.
    ///
    /// # Shapes
    /// `z [B, N, Z]`, memory of `[B, N, hidden]`; with `rows [B, R]` only these objects' memories are computed
    /// (the others still act on them). `surroundings [B, R, width]` are those of the computed objects. Returns
    /// memories of `[B, R, hidden]`.
    pub(crate) fn advance(
        &self,
        z: &Tensor,
        memory: &Memory,
        surroundings: &Tensor,
        rows: Option<&Tensor>,
    ) -> Memory {
        let relations = self.relations.forward(z, &memory.h, rows);
        let pick = |x: &Tensor| match rows {
            Some(rows) => gather_rows(x, rows),
            None => x.shallow_clone(),
        };
        let input = Tensor::cat(&[&pick(z), &relations, surroundings], -1);
        let input = self.input.forward(&input);
        let (batch, count) = (input.size()[0], input.size()[1]);
        let flat = |x: &Tensor| x.reshape([batch * count, -1]);
        let (h, c) =
            self.cell.forward(&flat(&input), (&flat(&pick(&memory.h)), &flat(&pick(&memory.c))));
        Memory { h: h.view([batch, count, -1]), c: c.view([batch, count, -1]) }
    }

    pub(crate) fn freeze(&mut self) {
        self.relations.freeze();
    }
}
