//! Settings of the vision models, and the providers that they name.

use crate::geometry::{ColourSky, GeometrySky, JointSky};
use crate::onnx::{MEMORY_MIB, Runtime};
use crate::registry::{DEEPLAB, EDGES, SKY};
use crate::{
    Builtin, EdgeDetector, EdgeNetwork, Embedder, MaskProposer, PromptSegmenter, RegionCache, SkyDetector,
    SkyNetwork, TransientDetector, TransientNetwork, VisionError,
};
use segwild_scene::{Image, Mask};
use std::path::{Path, PathBuf};
use std::sync::Arc;

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
        /// Nothing is sky.
        None = "none",
    }
}

segwild_scene::choice! {
    /// What describes photos, or what finds masks.
    pub enum ModelChoice {
        /// SAM if its files are in the models' folder, else the built-in provider.
        Auto = "auto",
        /// The built-in provider.
        Builtin = "builtin",
        /// SAM; an error without its files.
        Sam = "sam",
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
    pub struct VisionSettings("vision", user: models masks sky transient_network) {
        /// Folder of network files, SAM's among them. Files are `edges_bsds.onnx`, `sky_small_384.onnx`,
        /// `deeplab_cityscapes_513.onnx`, and pairs of the SAM family such as `mobile_sam_encoder.onnx` and
        /// `mobile_sam_decoder.onnx`. Empty: SEGWILD_MODELS; without that no network is used and the built-in provider
        /// does everything. It is never read from a run folder.
        models: String = String::new(),
        /// Where boundaries come from: auto, builtin or network.
        edges: EdgeChoice = EdgeChoice::Auto,
        /// How the sky is found.
        sky: SkyChoice = SkyChoice::Auto,
        /// Network file whose persons and vehicles are transients from the start. It answers the classes of Cityscapes
        /// (such as `deeplab_cityscapes_513.onnx`). Empty: none. It is never read from a run folder.
        transient_network: String = String::new(),
        /// What finds masks and answers clicks. `auto`: SAM if its files are there.
        masks: ModelChoice = ModelChoice::Auto,
        /// What describes photos for the feature field: auto (SAM if its files are there), builtin or sam.
        embedder: ModelChoice = ModelChoice::Auto,
        /// Stem of the names of SAM's files (`mobile_sam`, `sam_vit_b`, ..). Empty: the first that is there, lightest first.
        sam: String = String::new(),
        /// Where SAM computes: auto (CUDA where the ONNX Runtime has it), cpu or cuda.
        network_device: DeviceChoice = DeviceChoice::Auto,
        /// How far SAM's threshold moves, up and down, to tell how stable a mask is (in logits).
        stability_offset: f32 = 1.0 => 0.0..=100.0,
        /// The ONNX Runtime library, which runs the networks. Empty: ORT_DYLIB_PATH, the system's library folders,
        /// then Python's onnxruntime package. A run folder is never asked for it.
        onnxruntime: String = String::new(),
        /// CPU threads per network.
        network_threads: u32 = 1 => 0..=256,
        /// Most MiB that all networks together may hold; a file that asks for more is refused. The largest SAM encoders need
        /// more than this on a CPU.
        network_memory: u32 = MEMORY_MIB => 64..,
        /// Most seconds that SAM may take for one photo or for one batch of prompts.
        network_limit: u32 = 600 => 1..,
        /// Probability from which a pixel counts as sky.
        sky_confidence: f32 = 0.5 => 0.0..=1.0,
        /// Memory in MiB in which photos' analyses and SAM's embeddings are kept for the next prompt. Half of it holds analyses,
        /// of which one takes about 2 at 320 px and 3 at 640; an embedding takes 4.
        vision_memory: u32 = 256,
    }
}

/// Name of the built-in provider of masks, as records, tables and reports have it.
pub const BUILT_IN: &str = "built-in";

/// The providers that settings name, and notes on what was found and used.
#[derive(Clone)]
pub struct Providers {
    /// Dense descriptors.
    pub embedder: Arc<dyn Embedder>,
    /// Masks at points.
    pub proposer: Arc<dyn MaskProposer>,
    /// Masks from prompts, and refinement.
    pub segmenter: Arc<dyn PromptSegmenter>,
    /// Sky.
    pub sky: Arc<dyn SkyDetector>,
    /// Persons and vehicles, if a network for them was named.
    pub transients: Option<Arc<dyn TransientDetector>>,
    /// Name of the provider of masks and clicks, as records, tables and reports have it: [`BUILT_IN`], or `sam:` and the stem of
    /// its files. Other implementations of the traits give a name of their own.
    pub name: String,
    /// What was found and chosen, a sentence each.
    pub notes: Vec<String>,
    /// The network files in use.
    pub networks: Vec<NetworkFile>,
}

/// A network file in use.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct NetworkFile {
    /// The setting that led to it: `models` or `transient_network`.
    pub setting: String,
    /// Where it is.
    pub file: PathBuf,
    /// The first 16 digits of its BLAKE3, hexadecimal; those of weights beside it are in it.
    pub hash: String,
}

impl NetworkFile {
    pub(crate) fn of_models(file: &Path, hash: &str) -> NetworkFile {
        NetworkFile { setting: "models".into(), file: file.to_owned(), hash: hash.to_owned() }
    }
}

impl VisionSettings {
    /// Settings that name code: a library that is loaded, networks that it executes. They come from whoever runs the program
    /// (a flag, the environment, a settings file of their own), never from a folder that somebody may have sent.
    pub const CODE: [&'static str; 3] = ["models", "transient_network", "onnxruntime"];
}

/// Nothing is sky: for scenes without any, and for the ablation.
struct NoSky;

impl SkyDetector for NoSky {
    fn key(&self) -> String {
        "no-sky".into()
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        Ok(Mask::empty(image.width as u32, image.height as u32))
    }
}

/// A network's file, if the choice allows it: an error where it is demanded and missing.
fn file(settings: &VisionSettings, name: &str, demanded: bool) -> Result<Option<PathBuf>, VisionError> {
    let path = Path::new(&settings.models).join(name);
    if !settings.models.is_empty() && path.is_file() {
        return Ok(Some(path));
    }
    match (demanded, settings.models.is_empty()) {
        (false, _) => Ok(None),
        (true, true) => Err(VisionError::Model(format!(
            "the network {name} is asked for, but no folder of models is set: set `models` to the folder that holds it"
        ))),
        (true, false) => Err(VisionError::Model(format!(
            "the network {name} is asked for, but {} has no such file",
            settings.models
        ))),
    }
}

impl Providers {
    /// Finds the providers that `settings` name. Where `auto` cannot have a network, the built-in provider serves and a note says
    /// why; a network asked for by name that cannot be had is an error.
    pub fn from_settings(settings: &VisionSettings) -> Result<Providers, VisionError> {
        Providers::keeping(settings, None)
    }

    /// As [`Providers::from_settings`]; where the built-in provider answers clicks, it keeps the regions of photos in `cache`.
    pub fn keeping(
        settings: &VisionSettings,
        cache: Option<Arc<dyn RegionCache>>,
    ) -> Result<Providers, VisionError> {
        if !settings.models.is_empty() && !Path::new(&settings.models).is_dir() {
            return Err(VisionError::Model(format!(
                "the folder of models `{}` does not exist: correct `models` or leave it empty for the built-in provider",
                settings.models
            )));
        }
        if !(settings.sky_confidence > 0.0 && settings.sky_confidence < 1.0) {
            return Err(VisionError::Model(format!(
                "`sky_confidence` is {}; it must lie between 0 and 1",
                settings.sky_confidence
            )));
        }
        let (mut notes, mut networks) = (Vec::new(), Vec::new());
        let sam = crate::sam::find_pair(settings, &mut notes)?;
        networks.extend(sam.iter().flat_map(|sam| sam.files()));
        let edges = edges(settings, &mut notes, &mut networks)?;
        let builtin = match edges {
            Some(edges) => Builtin::with_edges(edges),
            None => Builtin::new(),
        };
        // SAM's embeddings and the built-in provider's analyses share what photos may take.
        let shares = if sam.is_some() { 2 } else { 1 };
        let by_sam = |choice: ModelChoice| sam.clone().filter(|_| choice != ModelChoice::Builtin);
        let builtin = builtin.within(settings.vision_memory as usize * (1 << 20) / shares);
        let builtin = Arc::new(match cache.filter(|_| by_sam(settings.masks).is_none()) {
            Some(cache) => builtin.keeping(cache),
            None => builtin,
        });
        let without = match (settings.models.is_empty(), &sam) {
            (false, None) => " (SAM is not there, or not asked for)",
            _ => "",
        };
        let note = |what: &str, sam: bool| match sam {
            true => format!("{what}: SAM"),
            false => format!("{what}: built-in{without}"),
        };
        notes.push(note("descriptors", by_sam(settings.embedder).is_some()));
        notes.push(note("masks, clicks and refinement", by_sam(settings.masks).is_some()));
        let sky: Arc<dyn SkyDetector> = match sky(settings, &builtin, &mut notes, &mut networks)? {
            Some(network) => network,
            None if settings.sky == SkyChoice::None => {
                notes.push("sky: none".into());
                Arc::new(NoSky)
            }
            None if settings.sky == SkyChoice::Geometry => {
                notes.push("sky: by the points that lie in photos (asked for)".into());
                Arc::new(GeometrySky(builtin.clone()))
            }
            None => {
                let why = match settings.sky {
                    SkyChoice::Auto if settings.models.is_empty() => "no folder of models is set",
                    SkyChoice::Auto => {
                        "selections are better by it than by a network; `sky = \"both\"` takes that as well"
                    }
                    _ => "asked for",
                };
                notes.push(format!("sky: built-in detector (colour and boundaries; {why})"));
                Arc::new(ColourSky(builtin.clone()))
            }
        };
        let embedder: Arc<dyn Embedder> = match by_sam(settings.embedder) {
            Some(sam) => sam,
            None => builtin.clone(),
        };
        let name =
            by_sam(settings.masks).map_or_else(|| BUILT_IN.to_owned(), |sam| format!("sam:{}", sam.stem()));
        let (proposer, segmenter): (Arc<dyn MaskProposer>, Arc<dyn PromptSegmenter>) =
            match by_sam(settings.masks) {
                Some(sam) => (sam.clone(), sam),
                None => (builtin.clone(), builtin),
            };
        let transients: Option<Arc<dyn TransientDetector>> = match settings.transient_network.as_str() {
            "" => None,
            file => {
                let runtime = Runtime::find_within(&settings.onnxruntime, settings.network_memory)?;
                let network = TransientNetwork::load(&runtime, Path::new(file), settings.network_threads)?;
                notes.push(format!("persons and vehicles: network {file}"));
                networks.push(NetworkFile {
                    setting: "transient_network".into(),
                    ..NetworkFile::of_models(Path::new(file), network.hash())
                });
                Some(Arc::new(network))
            }
        };
        Ok(Providers { embedder, proposer, segmenter, sky, transients, name, notes, networks })
    }
}

fn edges(
    settings: &VisionSettings,
    notes: &mut Vec<String>,
    networks: &mut Vec<NetworkFile>,
) -> Result<Option<Arc<dyn EdgeDetector>>, VisionError> {
    let demanded = settings.edges == EdgeChoice::Network;
    if settings.edges == EdgeChoice::Builtin {
        notes.push("boundaries: built-in detector".into());
        return Ok(None);
    }
    let Some(path) = file(settings, EDGES, demanded)? else {
        notes.push("boundaries: built-in detector (no edge network given)".into());
        return Ok(None);
    };
    let network = Runtime::find_within(&settings.onnxruntime, settings.network_memory)
        .and_then(|runtime| EdgeNetwork::load(&runtime, &path, settings.network_threads));
    match network {
        Ok(network) => {
            notes.push(format!("boundaries: network {}", path.display()));
            networks.push(NetworkFile::of_models(&path, network.hash()));
            Ok(Some(Arc::new(network)))
        }
        Err(error) if demanded => Err(error),
        Err(error) => {
            notes.push(format!("boundaries: built-in detector, because the network cannot be used: {error}"));
            Ok(None)
        }
    }
}

fn sky(
    settings: &VisionSettings,
    builtin: &Arc<Builtin>,
    notes: &mut Vec<String>,
    networks: &mut Vec<NetworkFile>,
) -> Result<Option<Arc<dyn SkyDetector>>, VisionError> {
    let name = match settings.sky {
        SkyChoice::Network | SkyChoice::Both => SKY,
        SkyChoice::Deeplab => DEEPLAB,
        SkyChoice::Auto | SkyChoice::Builtin | SkyChoice::Geometry | SkyChoice::None => return Ok(None),
    };
    let Some(path) = file(settings, name, true)? else { return Ok(None) };
    let runtime = Runtime::find_within(&settings.onnxruntime, settings.network_memory)?;
    let network = SkyNetwork::load(&runtime, &path, settings.network_threads, settings.sky_confidence)?;
    let with = if settings.sky == SkyChoice::Both { " together with the built-in detector" } else { "" };
    notes.push(format!("sky: network {}{with} (asked for)", path.display()));
    networks.push(NetworkFile::of_models(&path, network.hash()));
    Ok(Some(match settings.sky {
        SkyChoice::Both => Arc::new(JointSky { network, colour: ColourSky(builtin.clone()) }),
        _ => Arc::new(network),
    }))
}
