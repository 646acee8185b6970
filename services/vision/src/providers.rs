//! The providers that settings name.

use crate::clip::find_clip;
use crate::family::{DEEPLAB, EDGES, SKY};
use crate::geometry::{ColourSky, GeometrySky, JointSky};
use crate::network_file::NetworkFile;
use crate::onnx::Runtime;
use crate::service::{RemoteVision, ServiceTerms};
use crate::service_address::ServiceAddress;
use crate::service_error::{ServiceError, TokenFileError};
use crate::service_tls::TrustedCertificates;
use crate::settings::{EdgeChoice, ModelChoice, SkyChoice, VisionSettings};
use crate::{
    Builtin, EdgeDetector, EdgeNetwork, Embedder, MaskProposer, PromptSegmenter, RegionCache, Sam,
    SkyDetector, SkyNetwork, TextEmbedder, TransientDetector, TransientNetwork, VisionError,
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
    /// Embeds texts and images, if a model for it was found.
    pub texts: Option<Arc<dyn TextEmbedder>>,
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
        check(settings)?;
        let (mut notes, mut networks) = (Vec::new(), Vec::new());
        let service = connected(settings)?.map(Arc::new);
        let sam = crate::sam::find_pair(settings, &mut notes)?;
        networks.extend(sam.iter().flat_map(|sam| sam.files()));
        let edges = edges(settings, &mut notes, &mut networks)?;
        let of_service = |has: fn(&RemoteVision) -> bool| service.as_ref().filter(|service| has(service));
        let describes = ModelSource::of(settings.embedder, of_service(RemoteVision::embeds), sam.as_ref());
        let masks = ModelSource::of(settings.masks, of_service(RemoteVision::finds_masks), sam.as_ref());
        for (choice, source, what) in [
            (settings.embedder, &describes, "describe photos (Embed)"),
            (settings.masks, &masks, "find masks (ProposeMasks and SegmentPrompts)"),
        ] {
            let lacks = choice == ModelChoice::Service && !matches!(source, ModelSource::Service(_));
            demand(lacks, what, service.as_deref())?;
        }
        let builtin = match edges {
            Some(edges) => Builtin::with_edges(edges),
            None => Builtin::new(),
        };
        // SAM's embeddings and the built-in provider's analyses share what photos may take.
        let shares = if sam.is_some() { 2 } else { 1 };
        let builtin = builtin.within(settings.vision_memory as usize * (1 << 20) / shares);
        let builtin = Arc::new(match cache.filter(|_| matches!(masks, ModelSource::BuiltIn)) {
            Some(cache) => builtin.keeping(cache),
            None => builtin,
        });
        let without = match (settings.models.is_empty(), &sam) {
            (false, None) => " (SAM is not there, or not requested)",
            _ => "",
        };
        notes.push(describes.note("descriptors", without));
        notes.push(masks.note("masks, clicks and refinement", without));
        let sky = sky(settings, service.as_ref(), &builtin, &mut notes, &mut networks)?;
        let (proposer, segmenter) = masks.of_masks(&builtin);
        let transients = transients(settings, service.as_ref(), &mut notes, &mut networks)?;
        // It takes no part in a run, so that no run records its files.
        let texts: Option<Arc<dyn TextEmbedder>> = match of_service(RemoteVision::embeds_texts) {
            Some(service) => {
                notes.push(format!("text: the vision service {}", service.addresses()));
                Some(service.clone())
            }
            None => find_clip(settings, &mut notes)?.map(|clip| Arc::new(clip) as Arc<dyn TextEmbedder>),
        };
        networks.extend(service.iter().map(|service| service.as_network_file()));
        let remote_calls = service.map_or(0, |service| service.calls());
        let (embedder, name) = (describes.embedder(&builtin), masks.name());
        Ok(Providers {
            embedder,
            proposer,
            segmenter,
            sky,
            transients,
            texts,
            name,
            notes,
            networks,
            remote_calls,
        })
    }

    /// What embeds texts.
    ///
    /// # Errors
    /// When nothing does; the error says which files would.
    pub fn text_embedder(&self) -> Result<&dyn TextEmbedder, VisionError> {
        let unused = || self.notes.iter().filter_map(|note| note.strip_prefix("text: not used: "));
        let none = || {
            let found = unused().collect::<Vec<_>>().join("; ");
            VisionError::NoTexts { found: if found.is_empty() { found } else { format!(" ({found})") } }
        };
        self.texts.as_deref().ok_or_else(none)
    }
}

/// Refuses settings that no provider can have.
fn check(settings: &VisionSettings) -> Result<(), VisionError> {
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
    Ok(())
}

/// What describes photos, or what finds masks.
enum ModelSource {
    /// A vision service.
    Service(Arc<RemoteVision>),
    /// SAM on this machine.
    Sam(Arc<Sam>),
    /// The built-in provider.
    BuiltIn,
}

impl ModelSource {
    /// The first that a choice allows and that is there: a service that has what is needed, SAM, the built-in provider.
    fn of(choice: ModelChoice, service: Option<&Arc<RemoteVision>>, sam: Option<&Arc<Sam>>) -> ModelSource {
        let auto = choice == ModelChoice::Auto;
        match (service, sam) {
            (Some(service), _) if auto || choice == ModelChoice::Service => {
                ModelSource::Service(service.clone())
            }
            (_, Some(sam)) if auto || choice == ModelChoice::Sam => ModelSource::Sam(sam.clone()),
            _ => ModelSource::BuiltIn,
        }
    }

    /// The note on what does `what`; `without` says why it is not SAM.
    fn note(&self, what: &str, without: &str) -> String {
        match self {
            ModelSource::Service(service) => {
                format!("{what}: {} by the vision service {}", service.name(), service.addresses())
            }
            ModelSource::Sam(_) => format!("{what}: SAM"),
            ModelSource::BuiltIn => format!("{what}: built-in{without}"),
        }
    }

    /// Its name, as [`Providers::name`] has it.
    fn name(&self) -> String {
        match self {
            ModelSource::Service(service) => format!("remote:{}", service.name()),
            ModelSource::Sam(sam) => format!("sam:{}", sam.stem()),
            ModelSource::BuiltIn => BUILT_IN.to_owned(),
        }
    }

    /// What describes photos.
    fn embedder(&self, builtin: &Arc<Builtin>) -> Arc<dyn Embedder> {
        match self {
            ModelSource::Service(service) => service.clone(),
            ModelSource::Sam(sam) => sam.clone(),
            ModelSource::BuiltIn => builtin.clone(),
        }
    }

    /// What finds masks at points, and what answers prompts.
    fn of_masks(&self, builtin: &Arc<Builtin>) -> (Arc<dyn MaskProposer>, Arc<dyn PromptSegmenter>) {
        match self {
            ModelSource::Service(service) => (service.clone(), service.clone()),
            ModelSource::Sam(sam) => (sam.clone(), sam.clone()),
            ModelSource::BuiltIn => (builtin.clone(), builtin.clone()),
        }
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
    let trusted = match settings.vision_certificates.as_str() {
        "" => None,
        file => Some(TrustedCertificates::read(Path::new(file)).map_err(ServiceError::Certificates)?),
    };
    let terms = ServiceTerms {
        deadline: Duration::from_secs(settings.network_limit.into()),
        patience: Duration::from_secs(settings.vision_patience.into()),
        first_patience: FIRST_PATIENCE.min(Duration::from_secs(settings.vision_patience.into())),
    };
    Ok(Some(RemoteVision::connect(addresses, token.as_ref(), trusted.as_ref(), terms)?))
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

/// What finds the sky.
fn sky(
    settings: &VisionSettings,
    service: Option<&Arc<RemoteVision>>,
    builtin: &Arc<Builtin>,
    notes: &mut Vec<String>,
    networks: &mut Vec<NetworkFile>,
) -> Result<Arc<dyn SkyDetector>, VisionError> {
    let remote = service.filter(|service| service.finds_skies());
    let by_service = settings.sky == SkyChoice::Service;
    demand(by_service && remote.is_none(), "find skies (FindSky)", service.map(Arc::as_ref))?;
    if let Some(network) = sky_network(settings, builtin, notes, networks)? {
        return Ok(network);
    }
    if let Some(service) = remote.filter(|_| by_service) {
        notes.push(format!("sky: the vision service {}", service.addresses()));
        return Ok(service.clone());
    }
    let why = match settings.sky {
        SkyChoice::None => {
            notes.push("sky: none".into());
            return Ok(Arc::new(NoSky));
        }
        SkyChoice::Geometry => {
            notes.push("sky: by the points that lie in photos (requested)".into());
            return Ok(Arc::new(GeometrySky(builtin.clone())));
        }
        SkyChoice::Auto if settings.models.is_empty() => "no folder of models is set",
        SkyChoice::Auto => {
            "selections are better by it than by a network; `sky = \"both\"` takes that as well"
        }
        _ => "requested",
    };
    notes.push(format!("sky: built-in detector (colour and boundaries; {why})"));
    Ok(Arc::new(ColourSky(builtin.clone())))
}

/// The network that finds the sky, if one is requested.
fn sky_network(
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

/// What finds persons and vehicles: a network that is named, else a vision service that does.
fn transients(
    settings: &VisionSettings,
    service: Option<&Arc<RemoteVision>>,
    notes: &mut Vec<String>,
    networks: &mut Vec<NetworkFile>,
) -> Result<Option<Arc<dyn TransientDetector>>, VisionError> {
    let file = settings.transient_network.as_str();
    if file.is_empty() {
        let Some(service) = service.filter(|service| service.finds_transients()) else { return Ok(None) };
        notes.push(format!("persons and vehicles: the vision service {}", service.addresses()));
        return Ok(Some(service.clone()));
    }
    let runtime = Runtime::find_within(&settings.onnxruntime, settings.network_memory)?;
    let network = TransientNetwork::load(&runtime, Path::new(file), settings.network_threads)?;
    notes.push(format!("persons and vehicles: network {file}"));
    networks.push(NetworkFile {
        setting: "transient_network".into(),
        ..NetworkFile::of_models(Path::new(file), network.hash())
    });
    Ok(Some(Arc::new(network)))
}
