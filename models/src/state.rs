//! Session state as plain rows: what the engine stores, gathers, scatters, forks and serialises.
//!
//! A model's state is a set of named tensors; for everything outside the model it is one row of floats and one
//! row of integers per session, laid out by a [`StateLayout`].

use tch::{Device, Kind, Tensor};

/// What the numbers of a field are.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum FieldKind {
    /// 32-bit floats.
    Float,
    /// 64-bit integers.
    Int,
}

/// One named tensor of a state.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Field {
    /// Dotted name, such as `mixture.z_mask`.
    pub name: &'static str,
    /// Shape without the batch axis.
    pub shape: Vec<i64>,
    /// What its numbers are.
    pub kind: FieldKind,
}

impl Field {
    fn width(&self) -> i64 {
        self.shape.iter().product()
    }
}

/// The fields of a state in the order in which a row holds them, floats and integers apart.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct StateLayout {
    fields: Vec<Field>,
}

impl FromIterator<Field> for StateLayout {
    fn from_iter<F: IntoIterator<Item = Field>>(fields: F) -> Self {
        Self { fields: fields.into_iter().collect() }
    }
}

impl StateLayout {
    /// The fields in order.
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// Floats of a row.
    pub fn floats(&self) -> i64 {
        self.width(FieldKind::Float)
    }

    /// Integers of a row.
    pub fn ints(&self) -> i64 {
        self.width(FieldKind::Int)
    }

    /// Bytes of a row.
    pub fn row_bytes(&self) -> usize {
        (self.floats() * 4 + self.ints() * 8) as usize
    }

    fn width(&self, kind: FieldKind) -> i64 {
        self.fields.iter().filter(|field| field.kind == kind).map(Field::width).sum()
    }
}

/// The state of a batch of sessions: `floats [B, F]` and `ints [B, I]`.
#[derive(Debug)]
pub struct State {
    /// All float fields of each row.
    pub floats: Tensor,
    /// All integer fields of each row.
    pub ints: Tensor,
}

/// The state of one session, on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct StateRow {
    /// All float fields.
    pub floats: Box<[f32]>,
    /// All integer fields.
    pub ints: Box<[i64]>,
}

impl State {
    /// A batch of the given rows.
    ///
    /// # Panics
    /// If there are none or they differ in size.
    pub fn from_rows<'a>(rows: impl IntoIterator<Item = &'a StateRow>, device: Device) -> Self {
        let (mut floats, mut ints, mut batch) = (Vec::new(), Vec::new(), 0i64);
        for row in rows {
            floats.extend_from_slice(&row.floats);
            ints.extend_from_slice(&row.ints);
            batch += 1;
        }
        let tensor = |values: Tensor| values.view([batch, -1]).to_device(device);
        Self {
            floats: tensor(Tensor::from_slice(&floats)),
            ints: tensor(Tensor::from_slice(&ints)),
        }
    }

    /// The rows of the batch, on the host.
    pub fn to_rows(&self) -> Vec<StateRow> {
        let host = |x: &Tensor| x.to_device(Device::Cpu).contiguous();
        let (floats, ints) = (host(&self.floats), host(&self.ints));
        let floats: Vec<f32> = floats.view(-1).try_into().expect("states are 32-bit floats");
        let ints: Vec<i64> = ints.view(-1).try_into().expect("identities are 64-bit integers");
        let batch = self.batch() as usize;
        floats
            .chunks_exact(floats.len() / batch)
            .zip(ints.chunks_exact(ints.len() / batch))
            .map(|(floats, ints)| StateRow { floats: floats.into(), ints: ints.into() })
            .collect()
    }

    /// Rows of this batch in another order or number.
    #[must_use]
    pub fn gather(&self, rows: &Tensor) -> Self {
        Self { floats: self.floats.index_select(0, rows), ints: self.ints.index_select(0, rows) }
    }

    /// Number of rows.
    pub fn batch(&self) -> i64 {
        self.floats.size()[0]
    }
}

/// Writes a model's tensors into a [`State`], recording the layout.
#[derive(Debug, Default)]
pub(crate) struct Packer {
    floats: Vec<Tensor>,
    ints: Vec<Tensor>,
    layout: StateLayout,
}

impl Packer {
    pub(crate) fn push(&mut self, name: &'static str, tensor: &Tensor) {
        let size = tensor.size();
        let flat = tensor.reshape([size[0], -1]);
        let kind = if tensor.kind() == Kind::Int64 { FieldKind::Int } else { FieldKind::Float };
        match kind {
            FieldKind::Float => self.floats.push(flat),
            FieldKind::Int => self.ints.push(flat),
        }
        self.layout.fields.push(Field { name, shape: size[1..].to_vec(), kind });
    }

    pub(crate) fn finish(self) -> (State, StateLayout) {
        let state =
            State { floats: Tensor::cat(&self.floats, 1), ints: Tensor::cat(&self.ints, 1) };
        (state, self.layout)
    }
}

/// Reads a model's tensors out of a [`State`] in the order in which they were written.
#[derive(Debug)]
pub(crate) struct Unpacker<'a> {
    state: &'a State,
    fields: std::slice::Iter<'a, Field>,
    next: (i64, i64),
}

impl<'a> Unpacker<'a> {
    pub(crate) fn new(state: &'a State, layout: &'a StateLayout) -> Self {
        Self { state, fields: layout.fields.iter(), next: (0, 0) }
    }

    pub(crate) fn take(&mut self) -> Tensor {
        let field = self.fields.next().expect("the layout has as many fields as the model reads");
        let (rows, next) = match field.kind {
            FieldKind::Float => (&self.state.floats, &mut self.next.0),
            FieldKind::Int => (&self.state.ints, &mut self.next.1),
        };
        let width = field.width();
        let part = rows.narrow(1, *next, width);
        *next += width;
        let mut shape = vec![rows.size()[0]];
        shape.extend(&field.shape);
        part.reshape(shape)
    }
}
