//! The providers that settings name.

use crate::geometry::{ColourSky, GeometrySky, JointSky};
use crate::network_file::NetworkFile;
use crate::onnx::Runtime;
use crate::registry::{DEEPLAB, EDGES, SKY};
use crate::service::{RemoteVision, ServiceTerms};
use crate::service_address::ServiceAddress;
use crate::service_error::{ServiceError, TokenFileError};
use crate::settings::{EdgeChoice, ModelChoice, SkyChoice, VisionSettings};
use crate::{
    Builtin, EdgeDetector, EdgeNetwork, Embedder, MaskProposer, PromptSegmenter, RegionCache, SkyDetector,
    SkyNetwork, TransientDetector, TransientNetwork, VisionError,
};
use segwild_proto::Token;
use segwild_scene::{Image, Mask};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Name of the built-in provider of masks, as records, tables and reports have it.
pub const BUILT_IN: &str = "built-in";

/// Time in which the first vision service must answer: a wrong address is reported at once.
const FIRST_PATIENCE: Duration = Duration::from_secs(10);
/// Most bytes of a file with a token.
const MOST_TOKEN: u64 = 1024;

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
    /// Name of the provider of masks and clicks, as records, tables and reports have it: [`BUILT_IN`], `sam:` and the stem of
    /// its files, or `remote:` and the name that a vision service has for its model. Other implementations of the traits give a name of their own.
    pub name: String,
    /// What was found and chosen, a sentence each.
    pub notes: Vec<String>,
    /// The network files in use, and the vision services.
    pub networks: Vec<NetworkFile>,
    /// Calls that vision services take at the same time; 0 without one.
    pub remote_calls: usize,
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
            "the network {name} is requested, but no folder of models is set: set `models` to the folder that holds it"
        ))),
        (true, false) => Err(VisionError::Model(format!(
            "the network {name} is requested, but {} has no such file",
            settings.models
        ))),
    }
}

impl Providers {
    /// Finds the providers that `settings` name. Where `auto` cannot have a network, the built-in provider serves and a note says
    /// why; a network requested by name that cannot be had is an error.
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
        let service = connected(settings)?.map(Arc::new);
        let sam = crate::sam::find_pair(settings, &mut notes)?;
        networks.extend(sam.iter().flat_map(|sam| sam.files()));
        let edges = edges(settings, &mut notes, &mut networks)?;
        let builtin = match edges {
            Some(edges) => Builtin::with_edges(edges),
            None => Builtin::new(),
        };
        // SAM's embeddings and the built-in provider's analyses share what photos may take.
        let shares = if sam.is_some() { 2 } else { 1 };
        let by_service = |choice: ModelChoice, has: fn(&RemoteVision) -> bool| {
            let wanted = matches!(choice, ModelChoice::Auto | ModelChoice::Service);
            service.clone().filter(|service| wanted && has(service))
        };
        let by_sam = |choice: ModelChoice| {
            let wanted = matches!(choice, ModelChoice::Auto | ModelChoice::Sam);
            sam.clone().filter(|_| wanted)
        };
        let (remote_embedder, remote_masks) = (
            by_service(settings.embedder, RemoteVision::embeds),
            by_service(settings.masks, RemoteVision::finds_masks),
        );
        for (choice, remote, what) in [
            (settings.embedder, &remote_embedder, "describe photos (Embed)"),
            (settings.masks, &remote_masks, "find masks (ProposeMasks and SegmentPrompts)"),
        ] {
            demand(choice == ModelChoice::Service && remote.is_none(), what, service.as_deref())?;
        }
        let builtin = builtin.within(settings.vision_memory as usize * (1 << 20) / shares);
        let is_builtin = remote_masks.is_none() && by_sam(settings.masks).is_none();
        let builtin = Arc::new(match cache.filter(|_| is_builtin) {
            Some(cache) => builtin.keeping(cache),
            None => builtin,
        });
        let without = match (settings.models.is_empty(), &sam) {
            (false, None) => " (SAM is not there, or not requested)",
            _ => "",
        };
        let note = |what: &str, service: &Option<Arc<RemoteVision>>, sam: bool| match (service, sam) {
            (Some(service), _) => {
                format!("{what}: {} by the vision service {}", service.name(), service.addresses())
            }
            (None, true) => format!("{what}: SAM"),
            (None, false) => format!("{what}: built-in{without}"),
        };
        notes.push(note("descriptors", &remote_embedder, by_sam(settings.embedder).is_some()));
        notes.push(note("masks, clicks and refinement", &remote_masks, by_sam(settings.masks).is_some()));
        let remote_sky = service.clone().filter(|service| service.finds_skies());
        demand(
            settings.sky == SkyChoice::Service && remote_sky.is_none(),
            "find skies (FindSky)",
            service.as_deref(),
        )?;
        let sky: Arc<dyn SkyDetector> = match sky(settings, &builtin, &mut notes, &mut networks)? {
            Some(network) => network,
            None if let Some(service) = remote_sky.filter(|_| settings.sky == SkyChoice::Service) => {
                notes.push(format!("sky: the vision service {}", service.addresses()));
                service
            }
            None if settings.sky == SkyChoice::None => {
                notes.push("sky: none".into());
                Arc::new(NoSky)
            }
            None if settings.sky == SkyChoice::Geometry => {
                notes.push("sky: by the points that lie in photos (requested)".into());
                Arc::new(GeometrySky(builtin.clone()))
            }
            None => {
                let why = match settings.sky {
                    SkyChoice::Auto if settings.models.is_empty() => "no folder of models is set",
                    SkyChoice::Auto => {
                        "selections are better by it than by a network; `sky = \"both\"` takes that as well"
                    }
                    _ => "requested",
                };
                notes.push(format!("sky: built-in detector (colour and boundaries; {why})"));
                Arc::new(ColourSky(builtin.clone()))
            }
        };
        let embedder: Arc<dyn Embedder> = match (&remote_embedder, by_sam(settings.embedder)) {
            (Some(service), _) => service.clone(),
            (None, Some(sam)) => sam,
            (None, None) => builtin.clone(),
        };
        let by_sam = by_sam(settings.masks);
        let name = match (&remote_masks, &by_sam) {
            (Some(service), _) => format!("remote:{}", service.name()),
            (None, Some(sam)) => format!("sam:{}", sam.stem()),
            (None, None) => BUILT_IN.to_owned(),
        };
        let (proposer, segmenter): (Arc<dyn MaskProposer>, Arc<dyn PromptSegmenter>) =
            match (remote_masks, by_sam) {
                (Some(service), _) => (service.clone(), service),
                (None, Some(sam)) => (sam.clone(), sam),
                (None, None) => (builtin.clone(), builtin),
            };
        let transients: Option<Arc<dyn TransientDetector>> = match settings.transient_network.as_str() {
            "" => match service.clone().filter(|service| service.finds_transients()) {
                Some(service) => {
                    notes.push(format!("persons and vehicles: the vision service {}", service.addresses()));
                    Some(service)
                }
                None => None,
            },
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
        networks.extend(service.iter().map(|service| service.as_network_file()));
        let remote_calls = service.map_or(0, |service| service.calls());
        Ok(Providers { embedder, proposer, segmenter, sky, transients, name, notes, networks, remote_calls })
    }
}

/// Connects to the vision services, if there are any.
fn connected(settings: &VisionSettings) -> Result<Option<RemoteVision>, VisionError> {
    let addresses = ServiceAddress::list(&settings.vision_service).map_err(ServiceError::Address)?;
    if addresses.is_empty() {
        return Ok(None);
    }
    let file = Path::new(&settings.vision_token_file);
    let token = match settings.vision_token_file.as_str() {
        "" => None,
        _ => Some(token_of(file).map_err(|reason| ServiceError::Token { file: file.to_owned(), reason })?),
    };
    let terms = ServiceTerms {
        deadline: Duration::from_secs(settings.network_limit.into()),
        patience: Duration::from_secs(settings.vision_patience.into()),
        first_patience: FIRST_PATIENCE.min(Duration::from_secs(settings.vision_patience.into())),
    };
    Ok(Some(RemoteVision::connect(addresses, token.as_ref(), terms)?))
}

fn token_of(file: &Path) -> Result<Token, TokenFileError> {
    let bytes = segwild_files::read_within(file, MOST_TOKEN)?;
    String::from_utf8(bytes).ok().and_then(|text| Token::of(&text)).ok_or(TokenFileError::NoToken)
}

/// Refuses a choice that needs a service which is not named, or one that does not have what is requested.
fn demand(lacks: bool, what: &str, service: Option<&RemoteVision>) -> Result<(), VisionError> {
    match (lacks, service) {
        (false, _) => Ok(()),
        (true, None) => Err(VisionError::Model(format!(
            "a vision service is to {what}, but none is named: give --vision-service grpc://HOST:PORT"
        ))),
        (true, Some(service)) => {
            Err(VisionError::Model(format!("the vision service {} does not {what}", service.addresses())))
        }
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
        SkyChoice::Auto | SkyChoice::Builtin | SkyChoice::Geometry | SkyChoice::Service | SkyChoice::None => {
            return Ok(None);
        }
    };
    let Some(path) = file(settings, name, true)? else { return Ok(None) };
    let runtime = Runtime::find_within(&settings.onnxruntime, settings.network_memory)?;
    let network = SkyNetwork::load(&runtime, &path, settings.network_threads, settings.sky_confidence)?;
    let with = if settings.sky == SkyChoice::Both { " together with the built-in detector" } else { "" };
    notes.push(format!("sky: network {}{with} (requested)", path.display()));
    networks.push(NetworkFile::of_models(&path, network.hash()));
    Ok(Some(match settings.sky {
        SkyChoice::Both => Arc::new(JointSky { network, colour: ColourSky(builtin.clone()) }),
        _ => Arc::new(network),
    }))
}
