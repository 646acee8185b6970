//! Networks over planes as lists of operations: whoever can do the operations can run and train the network.

use crate::conv::{Conv, Up};
use crate::map::Map;
use crate::norm::{GroupNorm, NormState};

/// A map of a network: what an operation makes, or what the network is given.
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

/// What makes one map of others.
#[derive(Clone, Debug)]
pub struct Op {
    /// What is done.
    pub what: What,
    /// What it is done to.
    pub from: Id,
    /// The map that it makes.
    pub to: Id,
    /// Whether what is below 0 becomes 0 in the end.
    pub relu: bool,
}

impl Op {
    /// Whether it reads a map.
    pub fn reads(&self, map: Id) -> bool {
        let other = match self.what {
            What::Join(other) | What::Beside(other) => Some(other),
            What::Conv(_) | What::Up(_) | What::Norm(_) => None,
        };
        self.from == map || other == Some(map)
    }
}

/// What an operation does.
#[derive(Clone, Debug)]
pub enum What {
    /// A convolution.
    Conv(Conv),
    /// A transposed convolution.
    Up(Up),
    /// A norm; nothing else reads what it is given.
    Norm(GroupNorm),
    /// The sum with another map.
    Join(Id),
    /// Another map's planes after its own.
    Beside(Id),
}

/// The maps of a network, first those that it is given, and the operations in their order.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    forms: Vec<Form>,
    given: usize,
    ops: Vec<Op>,
}

/// What a network made of what it was given.
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

impl Graph {
    /// A network that is given maps of these forms, and does nothing yet.
    pub fn given(forms: &[Form]) -> Graph {
        Graph { forms: forms.to_vec(), given: forms.len(), ops: Vec::new() }
    }

    /// All maps.
    pub fn forms(&self) -> &[Form] {
        &self.forms
    }

    /// How many of them, the first, the network is given.
    pub fn inputs(&self) -> usize {
        self.given
    }

    /// What it does.
    pub fn ops(&self) -> &[Op] {
        &self.ops
    }

    fn add(&mut self, form: Form, what: What, from: Id, relu: bool) -> Id {
        let to = self.forms.len();
        self.forms.push(form);
        self.ops.push(Op { what, from, to, relu });
        to
    }

    /// A convolution of a map; of half the size, if it has a stride.
    pub fn conv(&mut self, layer: Conv, from: Id, relu: bool) -> Id {
        let halved = self.forms[from].halved + u32::from(layer.stride() == 2);
        self.add(Form { channels: layer.planes()[1], halved }, What::Conv(layer), from, relu)
    }

    /// A transposed convolution of a map.
    pub fn up(&mut self, layer: Up, from: Id, relu: bool) -> Id {
        let form = Form { channels: layer.planes()[1], halved: self.forms[from].halved - 1 };
        self.add(form, What::Up(layer), from, relu)
    }

    /// A norm of a map that nothing else reads.
    pub fn norm(&mut self, layer: GroupNorm, from: Id, relu: bool) -> Id {
        self.add(self.forms[from], What::Norm(layer), from, relu)
    }

    /// The sum of two maps of one form.
    ///
    /// # Panics
    /// If they are not.
    pub fn join(&mut self, [from, other]: [Id; 2], relu: bool) -> Id {
        assert_eq!(self.forms[from], self.forms[other], "forms");
        self.add(self.forms[from], What::Join(other), from, relu)
    }

    /// The planes of two maps of one size.
    ///
    /// # Panics
    /// If they are not.
    pub fn beside(&mut self, [from, other]: [Id; 2]) -> Id {
        let [a, b] = [from, other].map(|id| self.forms[id]);
        assert_eq!(a.halved, b.halved, "sizes");
        let form = Form { channels: a.channels + b.channels, halved: a.halved };
        self.add(form, What::Beside(other), from, false)
    }

    /// Runs what it is given.
    ///
    /// # Panics
    /// If maps are missing or of another form.
    pub fn forward(&self, weights: &[f32], given: Vec<Map>) -> Tape {
        assert_eq!(given.len(), self.given, "what the network is given");
        let mut maps: Vec<Option<Map>> = given.into_iter().map(Some).collect();
        maps.resize(self.forms.len(), None);
        let mut norms = vec![None; self.ops.len()];
        for (op, norm) in self.ops.iter().zip(&mut norms) {
            let of = |id: Id| maps[id].as_ref().expect("made before");
            let made = match &op.what {
                What::Conv(layer) => layer.forward(weights, of(op.from)),
                What::Up(layer) => layer.forward(weights, of(op.from)),
                What::Norm(layer) => {
                    let (made, state) = layer.forward(weights, maps[op.from].take().expect("made before"));
                    *norm = Some(state);
                    made
                }
                What::Join(other) => {
                    let mut sum = of(op.from).clone();
                    sum.add(of(*other));
                    sum
                }
                What::Beside(other) => of(op.from).beside(of(*other)),
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
                What::Conv(layer) => {
                    let wanted = op.from >= given;
                    let back = layer.backward(weights, tape.of(op.from), &grad, sums, wanted);
                    back.into_iter().for_each(|back| give(&mut grads, op.from, back));
                }
                What::Up(layer) => {
                    let back = layer.backward(weights, tape.of(op.from), &grad, sums);
                    give(&mut grads, op.from, back);
                }
                What::Norm(layer) => {
                    let state = norm.as_ref().expect("left by the way forward");
                    give(&mut grads, op.from, layer.backward(weights, state, grad, sums));
                }
                What::Join(other) => {
                    give(&mut grads, op.from, grad.clone());
                    give(&mut grads, *other, grad);
                }
                What::Beside(other) => {
                    let (first, second) = grad.split(self.forms[op.from].channels);
                    give(&mut grads, op.from, first);
                    give(&mut grads, *other, second);
                }
            }
        }
    }
}
