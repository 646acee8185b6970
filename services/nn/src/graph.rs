//! Networks over planes as lists of operations: an engine that implements the operations can run and train the network.

use crate::conv::{Conv, Up};
use crate::map::Map;
use crate::norm::{GroupNorm, NormState};

/// A map of a network: an input, or the output of an operation.
pub type Id = usize;

/// How large a map is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Form {
    /// Its planes.
    pub channels: usize,
    /// How often the image's sides were halved.
    pub halved: u32,
}

impl Form {
    /// Rows and numbers in a row, for an image of so many.
    pub fn size(&self, [height, width]: [usize; 2]) -> [usize; 2] {
        [height >> self.halved, width >> self.halved]
    }

    /// Numbers in it, for an image of so many rows and numbers in a row.
    pub fn numbers(&self, image: [usize; 2]) -> usize {
        self.channels * self.size(image).iter().product::<usize>()
    }
}

/// An operation: computes one map from others.
#[derive(Clone, Debug)]
pub struct Op {
    /// Which operation.
    pub what: OpKind,
    /// Its input.
    pub from: Id,
    /// Its output.
    pub to: Id,
    /// Whether a ReLU follows.
    pub relu: bool,
}

impl Op {
    /// Whether it reads a map.
    pub fn reads(&self, map: Id) -> bool {
        let other = match self.what {
            OpKind::Add(other) | OpKind::Concat(other) => Some(other),
            OpKind::Conv(_) | OpKind::Up(_) | OpKind::Norm(_) => None,
        };
        self.from == map || other == Some(map)
    }
}

/// Type of an operation, with its layer.
#[derive(Clone, Debug)]
pub enum OpKind {
    /// A convolution.
    Conv(Conv),
    /// A transposed convolution.
    Up(Up),
    /// A norm; nothing else reads its input.
    Norm(GroupNorm),
    /// The sum with another map.
    Add(Id),
    /// Another map's planes after its own.
    Concat(Id),
}

/// The maps of a network, inputs first, and the operations in their order.
#[derive(Clone, Debug, Default)]
pub struct NetworkGraph {
    forms: Vec<Form>,
    given: usize,
    ops: Vec<Op>,
}

/// The maps of one forward pass, kept for the backward pass.
#[derive(Clone, Debug)]
pub struct Tape {
    maps: Vec<Option<Map>>,
    /// Per operation.
    norms: Vec<Option<NormState>>,
}

impl Tape {
    /// A map; those that only a norm reads are not kept.
    ///
    /// # Panics
    /// If it was not kept.
    pub fn of(&self, map: Id) -> &Map {
        self.maps[map].as_ref().expect("a map that is kept")
    }
}

impl NetworkGraph {
    /// A network with inputs of these forms and no operations.
    pub fn given(forms: &[Form]) -> NetworkGraph {
        NetworkGraph { forms: forms.to_vec(), given: forms.len(), ops: Vec::new() }
    }

    /// All maps.
    pub fn forms(&self) -> &[Form] {
        &self.forms
    }

    /// How many of them, the first, are inputs.
    pub fn inputs(&self) -> usize {
        self.given
    }

    /// Its operations.
    pub fn ops(&self) -> &[Op] {
        &self.ops
    }

    fn add(&mut self, form: Form, what: OpKind, from: Id, relu: bool) -> Id {
        let to = self.forms.len();
        self.forms.push(form);
        self.ops.push(Op { what, from, to, relu });
        to
    }

    /// A convolution of a map; of half the size, if it has a stride.
    pub fn conv(&mut self, layer: Conv, from: Id, relu: bool) -> Id {
        let halved = self.forms[from].halved + u32::from(layer.stride() == 2);
        self.add(Form { channels: layer.planes()[1], halved }, OpKind::Conv(layer), from, relu)
    }

    /// A transposed convolution of a map.
    pub fn up(&mut self, layer: Up, from: Id, relu: bool) -> Id {
        let form = Form { channels: layer.planes()[1], halved: self.forms[from].halved - 1 };
        self.add(form, OpKind::Up(layer), from, relu)
    }

    /// A norm of a map that nothing else reads.
    pub fn norm(&mut self, layer: GroupNorm, from: Id, relu: bool) -> Id {
        self.add(self.forms[from], OpKind::Norm(layer), from, relu)
    }

    /// The sum of two maps of one form.
    ///
    /// # Panics
    /// If they are not.
    pub fn sum(&mut self, [from, other]: [Id; 2], relu: bool) -> Id {
        assert_eq!(self.forms[from], self.forms[other], "forms");
        self.add(self.forms[from], OpKind::Add(other), from, relu)
    }

    /// The planes of two maps of one size.
    ///
    /// # Panics
    /// If they are not.
    pub fn concat(&mut self, [from, other]: [Id; 2]) -> Id {
        let [a, b] = [from, other].map(|id| self.forms[id]);
        assert_eq!(a.halved, b.halved, "sizes");
        let form = Form { channels: a.channels + b.channels, halved: a.halved };
        self.add(form, OpKind::Concat(other), from, false)
    }

    /// Runs the network on `given`, one map per input.
    ///
    /// # Panics
    /// If maps are missing or of another form.
    pub fn forward(&self, weights: &[f32], given: Vec<Map>) -> Tape {
        assert_eq!(given.len(), self.given, "number of inputs");
        let mut maps: Vec<Option<Map>> = given.into_iter().map(Some).collect();
        maps.resize(self.forms.len(), None);
        let mut norms = vec![None; self.ops.len()];
        for (op, norm) in self.ops.iter().zip(&mut norms) {
            let of = |id: Id| maps[id].as_ref().expect("made before");
            let made = match &op.what {
                OpKind::Conv(layer) => layer.forward(weights, of(op.from)),
                OpKind::Up(layer) => layer.forward(weights, of(op.from)),
                OpKind::Norm(layer) => {
                    let (made, state) = layer.forward(weights, maps[op.from].take().expect("made before"));
                    *norm = Some(state);
                    made
                }
                OpKind::Add(other) => {
                    let mut sum = of(op.from).clone();
                    sum.add(of(*other));
                    sum
                }
                OpKind::Concat(other) => of(op.from).concat(of(*other)),
            };
            maps[op.to] = Some(if op.relu { made.relu() } else { made });
        }
        Tape { maps, norms }
    }

    /// Adds the gradient of the weights to `sums`, from those of some maps.
    pub fn backward(&self, weights: &[f32], tape: &Tape, from: Vec<(Id, Map)>, sums: &mut [f32]) {
        let mut grads: Vec<Option<Map>> = vec![None; self.forms.len()];
        let given = self.given;
        let give = |grads: &mut [Option<Map>], id: Id, grad: Map| match &mut grads[id] {
            _ if id < given => {}
            Some(sum) => sum.add(&grad),
            none => *none = Some(grad),
        };
        for (id, grad) in from {
            give(&mut grads, id, grad);
        }
        for (op, norm) in self.ops.iter().zip(&tape.norms).rev() {
            let Some(mut grad) = grads[op.to].take() else { continue };
            if op.relu {
                grad = grad.relu_backward(tape.of(op.to));
            }
            match &op.what {
                OpKind::Conv(layer) => {
                    let wanted = op.from >= given;
                    let back = layer.backward(weights, tape.of(op.from), &grad, sums, wanted);
                    back.into_iter().for_each(|back| give(&mut grads, op.from, back));
                }
                OpKind::Up(layer) => {
                    let back = layer.backward(weights, tape.of(op.from), &grad, sums);
                    give(&mut grads, op.from, back);
                }
                OpKind::Norm(layer) => {
                    let state = norm.as_ref().expect("left by the forward pass");
                    give(&mut grads, op.from, layer.backward(weights, state, grad, sums));
                }
                OpKind::Add(other) => {
                    give(&mut grads, op.from, grad.clone());
                    give(&mut grads, *other, grad);
                }
                OpKind::Concat(other) => {
                    let (first, second) = grad.split(self.forms[op.from].channels);
                    give(&mut grads, op.from, first);
                    give(&mut grads, *other, second);
                }
            }
        }
    }
}
