//! Networks that take one photo and answer one map.

use super::{NetworkDevice, NetworkModel, NetworkOutput, Options, Runtime};
use crate::VisionError;
use ort::value::{Tensor, TensorElementType};
use segwild_scene::Image;
use std::path::Path;
use std::time::Duration;

/// Longest that a map of one photo may take: the networks of this kind take a second or two.
const LIMIT: Duration = Duration::from_secs(300);

/// A network of one photo in, one map out.
pub(crate) struct Network {
    model: NetworkModel,
    /// Height and width the photo must have; `None` where the file leaves it open.
    pub size: [Option<usize>; 2],
    /// Channels of the answer, where the file says.
    pub answers: Option<usize>,
}

impl Network {
    /// Loads a file and checks that it takes `[1, 3, h, w]` and answers `[1, c, h, w]`.
    pub fn load(runtime: &Runtime, path: &Path, threads: u32) -> Result<Network, VisionError> {
        let options = Options { threads, device: NetworkDevice::Cpu, limit: LIMIT, memory_mib: 0 };
        let model = NetworkModel::load(runtime, path, options)?;
        let [input] = &model.inputs[..] else {
            let names: Vec<&str> = model.inputs.iter().map(|i| i.name.as_str()).collect();
            let (count, names) = (names.len(), names.join(", "));
            return Err(model.wrong(format!("takes {count} inputs ({names}); one photo was expected")));
        };
        let float = Some(TensorElementType::Float32);
        let size = match input.shape[..] {
            [None | Some(1), None | Some(3), h, w] if input.kind == float => [h, w],
            _ => {
                return Err(model.wrong(format!(
                    "its input `{}` is {}; float32 [1, 3, h, w] was expected",
                    input.name,
                    input.words()
                )));
            }
        };
        let Some(output) = model.outputs.first() else { return Err(model.wrong("has no output")) };
        if output.kind != float || output.shape.len() != 4 {
            return Err(model.wrong(format!(
                "its output `{}` is {}; float32 [1, c, h, w] was expected",
                output.name,
                output.words()
            )));
        }
        Ok(Network { size, answers: output.shape[1], model })
    }

    /// The file's name, for messages.
    pub fn name(&self) -> &str {
        self.model.name()
    }

    /// Hash of the file (16 hexadecimal digits).
    pub fn key(&self) -> &str {
        self.model.key()
    }

    /// Runs the network on three planes that already have its size and value range.
    pub fn run(&self, planes: Image) -> Result<Image, VisionError> {
        let (h, w) = (planes.height, planes.width);
        let tensor = Tensor::from_array(([1usize, 3, h, w], planes.data))
            .map_err(|e| self.model.wrong(format!("takes no photo: {e}")))?;
        let inputs = vec![(self.model.inputs[0].name.as_str(), tensor.into())];
        let outputs = [self.model.outputs[0].name.as_str()];
        let answers = self.model.run(inputs, &outputs, &format!("a photo of {w} x {h}"))?;
        match answers.into_iter().next() {
            Some(NetworkOutput { shape, data }) => match shape[..] {
                [1, channels, height, width] if !data.is_empty() => {
                    Ok(Image { width, height, channels, data })
                }
                _ => Err(self.model.wrong(format!("answered {shape:?}; [1, c, h, w] was expected"))),
            },
            None => Err(self.model.wrong("answered nothing")),
        }
    }
}
