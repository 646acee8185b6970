//! Settings of the vision models.

use crate::onnx::MEMORY_MIB;
use crate::service_address::ServiceAddress;

segwild_scene::choice! {
    /// Where boundaries come from.
    pub enum EdgeChoice {
        /// The network if its file is in the models' folder, else the built-in detector.
        Auto = "auto",
        /// The built-in detector.
        Builtin = "builtin",
        /// The network `edges_bsds.onnx`; an error without it.
        Network = "network",
    }
}

segwild_scene::choice! {
    /// How the sky is found.
    pub enum SkyChoice {
        /// The built-in detector, over the edge network's boundaries where that is used: on `liberty` selections are better by its
        /// skies than by any others.
        Auto = "auto",
        /// The built-in detector.
        Builtin = "builtin",
        /// The network `sky_small_384.onnx`; an error without it.
        Network = "network",
        /// That network together with the built-in detector: each misses skies that the other finds.
        Both = "both",
        /// The network `deeplab_cityscapes_513.onnx`, the paper's kind; an error without it.
        Deeplab = "deeplab",
        /// Where the reconstruction saw nothing, above what it saw.
        Geometry = "geometry",
        /// The services of `vision_service`; an error without them.
        Service = "service",
        /// Nothing is sky.
        None = "none",
    }
}

segwild_scene::choice! {
    /// What describes photos, or what finds masks.
    pub enum ModelChoice {
        /// The services of `vision_service` if there are any, else SAM if its files are in the models' folder, else the built-in
        /// provider.
        Auto = "auto",
        /// The built-in provider.
        Builtin = "builtin",
        /// SAM; an error without its files.
        Sam = "sam",
        /// The services of `vision_service`; an error without them.
        Service = "service",
    }
}

segwild_scene::choice! {
    /// Where SAM computes.
    pub enum DeviceChoice {
        /// On CUDA if the ONNX Runtime has it and it works, else on the CPU.
        Auto = "auto",
        /// On the CPU.
        Cpu = "cpu",
        /// On CUDA; an error without it.
        Cuda = "cuda",
    }
}

segwild_scene::settings! {
    /// How photos are analysed: boundaries, regions, descriptors, sky.
    pub struct VisionSettings("vision", user: models masks vision_service sky transient_network) {
        /// Folder of network files, SAM's among them. Files are `edges_bsds.onnx`, `sky_small_384.onnx`,
        /// `deeplab_cityscapes_513.onnx`, pairs of the SAM family such as `mobile_sam_encoder.onnx` and
        /// `mobile_sam_decoder.onnx`, and CLIP's `vision_model.onnx` and `text_model.onnx` with `tokenizer.json`. Empty: SEGWILD_MODELS; without that no network is used and the built-in provider
        /// does everything. It is never read from a run folder.
        models: String = String::new(),
        /// Where boundaries come from.
        edges: EdgeChoice = EdgeChoice::Auto,
        /// How the sky is found.
        sky: SkyChoice = SkyChoice::Auto,
        /// Network whose persons and vehicles are transients from the start. The file answers the classes of Cityscapes
        /// (such as `deeplab_cityscapes_513.onnx`). Empty: none. It is never read from a run folder.
        transient_network: String = String::new(),
        /// What finds masks. It answers clicks as well. An address `grpc://HOST:PORT` or `grpcs://HOST:PORT` is short for `vision_service` and `service`.
        masks: ModelChoice = ModelChoice::Auto,
        /// What describes photos for the feature field.
        embedder: ModelChoice = ModelChoice::Auto,
        /// Vision services that have the models, with commas between. Each is `grpc://HOST:PORT`, or `grpcs://HOST:PORT` by TLS:
        /// `segwild vision serve` on another machine, or a server of your own; all have the same models. Empty: none. It is never
        /// read from a run folder.
        vision_service: String = String::new(),
        /// File with the token that the vision services want. Empty: none. It is never read from a run folder.
        vision_token_file: String = String::new(),
        /// File with the certificates of who signed those of the vision services (PEM, for `grpcs://`). Empty: the certificates that
        /// the system trusts. It is never read from a run folder.
        vision_certificates: String = String::new(),
        /// Seconds for which a run waits when no vision service answers any more. Then it stops, and the same command continues.
        vision_patience: u32 = 120 => 1..,
        /// Stem of the names of SAM's files (`mobile_sam`, `sam_vit_b`, ..). Empty: the first that is there, lightest first.
        sam: String = String::new(),
        /// Where SAM computes.
        network_device: DeviceChoice = DeviceChoice::Auto,
        /// How far SAM's threshold moves, up and down, to tell how stable a mask is (in logits).
        stability_offset: f32 = 1.0 => 0.0..=100.0,
        /// The ONNX Runtime library, which runs the networks. Empty: ORT_DYLIB_PATH, the system's library folders,
        /// then Python's onnxruntime package. It is never taken from a run folder.
        onnxruntime: String = String::new(),
        /// CPU threads per network.
        network_threads: u32 = 1 => 0..=256,
        /// Most MiB that all networks together may hold; a file that asks for more is refused. The largest SAM encoders need
        /// more than this on a CPU.
        network_memory: u32 = MEMORY_MIB => 64..,
        /// Most seconds that SAM or a vision service may take for one photo or for one batch of prompts.
        network_limit: u32 = 600 => 1..,
        /// Probability from which a pixel counts as sky.
        sky_confidence: f32 = 0.5 => 0.0..=1.0,
        /// Memory in MiB in which photos' analyses and SAM's embeddings are kept for the next prompt. Half of it holds analyses,
        /// of which one takes about 2 at 320 px and 3 at 640; an embedding takes 4, one of SAM 2 17.
        vision_memory: u32 = 256,
    }
}

impl VisionSettings {
    /// Settings that name code, or machines that are trusted as code is: a library that is loaded, networks that it executes,
    /// services that photos are sent to. They come from whoever runs the program (a flag, the environment, a settings file of
    /// their own), never from a folder that somebody may have sent.
    pub const CODE: [&'static str; 6] = [
        "models",
        "transient_network",
        "onnxruntime",
        "vision_service",
        "vision_token_file",
        "vision_certificates",
    ];

    /// The values of [`VisionSettings::CODE`], in its order.
    pub fn code_mut(&mut self) -> [&mut String; Self::CODE.len()] {
        let VisionSettings {
            models,
            transient_network,
            onnxruntime,
            vision_service,
            vision_token_file,
            vision_certificates,
            ..
        } = self;
        [models, transient_network, onnxruntime, vision_service, vision_token_file, vision_certificates]
    }

    /// Flags with `masks = grpc://..` written out: the service, and that it finds masks.
    pub fn with_services(flags: &[(String, String)]) -> Vec<(String, String)> {
        let named =
            |(name, value): &(String, String)| match name == "masks" && ServiceAddress::is_meant(value) {
                true => vec![
                    ("vision_service".to_owned(), value.clone()),
                    (name.clone(), ModelChoice::Service.to_string()),
                ],
                false => vec![(name.clone(), value.clone())],
            };
        flags.iter().flat_map(named).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_from_an_address_are_the_service_and_the_choice_of_it() {
        let flags = [("masks", "grpc://a:1,grpc://b:2"), ("embedder", "sam"), ("tau", "1")];
        let flags: Vec<(String, String)> = flags.map(|(n, v)| (n.to_owned(), v.to_owned())).into();
        let written = VisionSettings::with_services(&flags);
        let shown: Vec<String> = written.iter().map(|(name, value)| format!("{name}={value}")).collect();
        assert_eq!(shown, ["vision_service=grpc://a:1,grpc://b:2", "masks=service", "embedder=sam", "tau=1"]);
        let other = [("masks".to_owned(), "sam".to_owned())];
        assert_eq!(VisionSettings::with_services(&other), other);
    }
}
