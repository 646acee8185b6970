//! Models on other machines: a service answers what the same provider answers here, or the client says why not.

use segwild_proto::Token;
use segwild_scene::{Image, Mask, Prompts, ScoredMask};
use segwild_vision::{
    MaskProposer, Providers, RemoteVision, ServiceAddress, ServiceError, ServiceIdentity, ServiceTerms,
    TrustedCertificates, VisionError, VisionServer, VisionServiceOptions, VisionSettings, serve_vision,
};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// A photo of two squares and a gradient above.
fn photo(width: usize, height: usize) -> Image {
    let mut image = Image::zeros(width, height, 3);
    for y in 0..height {
        for x in 0..width {
            let sky = if y < height / 3 { 0.8 - 0.3 * y as f32 / height as f32 } else { 0.2 };
            let square = |x0: usize, y0: usize| (x0..x0 + 20).contains(&x) && (y0..y0 + 20).contains(&y);
            let [r, g, b] = match (square(10, 40), square(50, 44)) {
                (true, _) => [0.9, 0.3, 0.1],
                (_, true) => [0.1, 0.6, 0.3],
                _ => [sky * 0.8, sky * 0.9, sky],
            };
            for (channel, value) in [r, g, b].into_iter().enumerate() {
                image.data[channel * width * height + y * width + x] = value;
            }
        }
    }
    image
}

fn served(providers: Providers, address: &str, token: Option<Token>, memory: usize) -> VisionServer {
    let address: SocketAddr = address.parse().unwrap();
    serve_vision(providers, VisionServiceOptions { address, token, memory, parallel: 2, tls: None }).unwrap()
}

fn builtin() -> Providers {
    Providers::from_settings(&VisionSettings::default()).unwrap()
}

fn terms(seconds: u64) -> ServiceTerms {
    let time = Duration::from_secs(seconds);
    ServiceTerms { deadline: time, patience: time, first_patience: Duration::from_millis(500) }
}

fn connect(servers: &[&VisionServer], seconds: u64) -> Result<RemoteVision, ServiceError> {
    let all: Vec<String> = servers.iter().map(|server| format!("grpc://{}", server.address())).collect();
    RemoteVision::connect(ServiceAddress::list(&all.join(",")).unwrap(), None, None, terms(seconds))
}

#[test]
fn a_service_of_the_built_in_provider_answers_as_it_does_here() {
    let (here, image) = (builtin(), photo(90, 80));
    let server = served(builtin(), "127.0.0.1:0", None, 64 << 20);
    let settings = VisionSettings {
        vision_service: format!("grpc://{}", server.address()),
        sky: segwild_vision::SkyChoice::Service,
        ..VisionSettings::default()
    };
    let there = Providers::from_settings(&settings).unwrap();
    assert_eq!((there.name.as_str(), there.remote_calls), ("remote:built-in", 4));
    assert_eq!(there.embedder.embed(&image).unwrap(), here.embedder.embed(&image).unwrap());
    let points = [[20.0, 50.0], [60.0, 50.0]];
    assert_eq!(
        there.proposer.propose(&image, &points).unwrap(),
        here.proposer.propose(&image, &points).unwrap()
    );
    let click = Prompts::click(20.0, 50.0);
    let (answer, own) =
        (there.segmenter.prompted(&image, &click).unwrap(), here.segmenter.prompted(&image, &click).unwrap());
    assert_eq!(answer, own);
    assert!(answer.answer.mask.get(20, 50));
    let rough = Image {
        width: 90,
        height: 80,
        channels: 1,
        data: (0..90 * 80)
            .map(|i| f32::from((12..28).contains(&(i % 90)) && (42..58).contains(&(i / 90))))
            .collect(),
    };
    assert_eq!(
        there.segmenter.refine(&image, &rough).unwrap(),
        here.segmenter.refine(&image, &rough).unwrap()
    );
    assert_eq!(there.segmenter.finds_objects(), here.segmenter.finds_objects());
    there.segmenter.prepare(&image);
    assert!(!there.segmenter.is_prepared(&image), "nothing of a photo is kept here");
    assert_eq!(
        there.segmenter.boundary_strengths(&image).unwrap(),
        here.segmenter.boundary_strengths(&image).unwrap()
    );
    assert_eq!(there.sky.sky(&image).unwrap(), here.sky.sky(&image).unwrap());
    for (key, own) in
        [(there.embedder.key(), here.embedder.key()), (there.proposer.key(), here.proposer.key())]
    {
        assert!(
            key != own && key.contains(&own),
            "the model's own key, and not under the name of ours: {key}"
        );
    }
    assert!(
        there.notes.iter().any(|note| note.contains("vision service grpc://127.0.0.1")),
        "{:?}",
        there.notes
    );
    assert_eq!(server.computed(), 6);
}

#[test]
fn an_image_that_the_service_forgot_is_put_again() {
    let server = served(builtin(), "127.0.0.1:0", None, 1);
    let there = connect(&[&server], 20).unwrap();
    let (one, other) = (photo(90, 80), photo(80, 90));
    for _ in 0..2 {
        there.propose(&one, &[[20.0, 50.0]]).unwrap();
        there.propose(&other, &[[20.0, 50.0]]).unwrap();
    }
    assert_eq!(server.computed(), 4);
}

fn rest(time: Duration) {
    // A channel that nobody sends to: a wait that clippy's sleeping actors are not meant by.
    let (_never, next) = std::sync::mpsc::channel::<()>();
    let _ = next.recv_timeout(time);
}

/// Says how many calls it computes at the same time, and fails at photos of one width.
struct Slow {
    now: AtomicUsize,
    most: Arc<AtomicUsize>,
    key: &'static str,
}

impl MaskProposer for Slow {
    fn key(&self) -> String {
        self.key.into()
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let now = self.now.fetch_add(1, Ordering::AcqRel) + 1;
        self.most.fetch_max(now, Ordering::AcqRel);
        rest(Duration::from_millis(30));
        self.now.fetch_sub(1, Ordering::AcqRel);
        match image.width {
            13 => panic!("a photo that no model survives"),
            14 => Err(VisionError::Image("this photo is too small".into())),
            _ => {
                let mask = Mask::full(image.width as u32, image.height as u32);
                Ok(points
                    .iter()
                    .map(|_| ScoredMask { mask: mask.clone(), predicted_iou: 1.0, stability: 1.0 })
                    .collect())
            }
        }
    }
}

fn slow(key: &'static str) -> (Providers, Arc<AtomicUsize>) {
    let most = Arc::new(AtomicUsize::new(0));
    let proposer = Arc::new(Slow { now: AtomicUsize::new(0), most: most.clone(), key });
    (Providers { proposer, ..builtin() }, most)
}

#[test]
fn calls_are_shared_out_and_no_service_computes_more_than_it_takes() {
    let ((a, most_a), (b, most_b)) = (slow("m"), slow("m"));
    let (a, b) = (served(a, "127.0.0.1:0", None, 1 << 20), served(b, "127.0.0.1:0", None, 1 << 20));
    let there = connect(&[&a, &b], 20).unwrap();
    std::thread::scope(|scope| {
        for _ in 0..12 {
            scope.spawn(|| assert_eq!(there.propose(&photo(30, 70), &[[1.0, 1.0]]).unwrap().len(), 1));
        }
    });
    assert_eq!((most_a.load(Ordering::Acquire), most_b.load(Ordering::Acquire)), (2, 2));
    assert_eq!(a.computed() + b.computed(), 12);
    assert!(a.computed().min(b.computed()) >= 4, "{} and {}", a.computed(), b.computed());
}

#[test]
fn a_service_that_goes_is_left_out_and_used_again_when_it_is_back() {
    let (a, b) = (
        served(slow("m").0, "127.0.0.1:0", None, 1 << 20),
        served(slow("m").0, "127.0.0.1:0", None, 1 << 20),
    );
    let there = connect(&[&a, &b], 20).unwrap();
    let ask = || there.propose(&photo(30, 70), &[[1.0, 1.0]]).map(|masks| masks.len()).unwrap();
    let address = a.address().to_string();
    drop(a);
    for _ in 0..4 {
        assert_eq!(ask(), 1, "the other one answers");
    }
    let before = b.computed();
    let a = served(slow("m").0, &address, None, 1 << 20);
    drop(b);
    assert_eq!(ask(), 1, "it is waited for");
    assert!(a.computed() >= 1 && before >= 4);
}

#[test]
fn services_that_are_gone_for_too_long_are_named_and_no_photo_is_at_fault() {
    let a = served(builtin(), "127.0.0.1:0", None, 1 << 20);
    let (there, address) = (connect(&[&a], 1).unwrap(), a.address());
    drop(a);
    let error = there.propose(&photo(30, 70), &[[1.0, 1.0]]).unwrap_err();
    let words = error.to_string();
    assert!(matches!(error, VisionError::Service(ServiceError::Gone { .. })), "{words}");
    assert!(words.contains(&address.to_string()), "{words}");
    let of_the_system = std::iter::successors(std::error::Error::source(&error), |e| e.source()).any(|e| {
        e.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::NotConnected)
    });
    assert!(of_the_system, "an actor tells it from a bad photo");
    let nobody = RemoteVision::connect(
        ServiceAddress::list(&format!("grpc://{address}")).unwrap(),
        None,
        None,
        terms(1),
    );
    assert!(nobody.err().expect("nobody is there").to_string().contains(&address.to_string()));
}

#[test]
fn a_service_that_comes_back_with_another_model_is_not_used() {
    let a = served(slow("m").0, "127.0.0.1:0", None, 1 << 20);
    let (there, address) = (connect(&[&a], 1).unwrap(), a.address().to_string());
    drop(a);
    let _other = served(slow("another").0, &address, None, 1 << 20);
    let error = there.propose(&photo(30, 70), &[[1.0, 1.0]]).unwrap_err().to_string();
    assert!(error.contains("other models than before"), "{error}");
}

#[test]
fn a_photo_that_a_model_refuses_or_dies_of_costs_itself_only() {
    let a = served(slow("m").0, "127.0.0.1:0", None, 1 << 20);
    let there = connect(&[&a], 20).unwrap();
    let ask = |width| there.propose(&photo(width, 70), &[[1.0, 1.0]]).map_err(|error| error.to_string());
    let refused = ask(14).unwrap_err();
    assert!(refused.contains("too small") && refused.contains("grpc://"), "{refused}");
    assert!(ask(13).unwrap_err().contains("failed unexpectedly"));
    assert_eq!(ask(30).unwrap().len(), 1);
}

#[test]
fn services_with_other_models_and_clients_without_the_token_are_refused() {
    let (a, b) =
        (served(slow("m").0, "127.0.0.1:0", None, 1 << 20), served(builtin(), "127.0.0.1:0", None, 1 << 20));
    let refused = connect(&[&a, &b], 1).err().expect("they differ").to_string();
    assert!(refused.contains("different models") && refused.contains(&b.address().to_string()), "{refused}");

    let token = Token::random().unwrap();
    let server = served(builtin(), "127.0.0.1:0", Some(token.clone()), 1 << 20);
    let refused = connect(&[&server], 1).err().expect("no token").to_string();
    assert!(refused.contains("token"), "{refused}");
    let address = || ServiceAddress::list(&format!("grpc://{}", server.address())).unwrap();
    let other = RemoteVision::connect(address(), Some(&Token::random().unwrap()), None, terms(1));
    assert!(other.is_err());
    RemoteVision::connect(address(), Some(&token), None, terms(1)).unwrap();

    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), "short").unwrap();
    let settings = VisionSettings {
        vision_service: address()[0].to_string(),
        vision_token_file: file.path().display().to_string(),
        ..VisionSettings::default()
    };
    let refused =
        |settings: &VisionSettings| Providers::from_settings(settings).err().expect("refused").to_string();
    assert!(refused(&settings).contains("16 letters"));
    std::fs::write(file.path(), token.text()).unwrap();
    assert_eq!(Providers::from_settings(&settings).unwrap().name, "remote:built-in");
    let none = VisionSettings { masks: segwild_vision::ModelChoice::Service, ..VisionSettings::default() };
    assert!(refused(&none).contains("--vision-service"));
    let wrong = VisionSettings { vision_service: "gpu1:50051".into(), ..VisionSettings::default() };
    assert!(refused(&wrong).contains("grpc://HOST:PORT"));
}

/// A file of `tls/`: a service's certificate for 127.0.0.1 with its key, who signed it (`ca.pem`), and somebody else.
fn tls(name: &str) -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/tls").join(name)
}

#[test]
fn a_service_by_tls_answers_who_trusts_its_certificate_and_nobody_else() {
    let identity = ServiceIdentity::read(&tls("service.pem"), &tls("service.key")).unwrap();
    let address = "127.0.0.1:0".parse().unwrap();
    let options =
        VisionServiceOptions { address, token: None, memory: 1 << 20, parallel: 1, tls: Some(identity) };
    let server = serve_vision(builtin(), options).unwrap();
    let at = |scheme: &str| ServiceAddress::list(&format!("{scheme}://{}", server.address())).unwrap();
    let signer = TrustedCertificates::read(&tls("ca.pem")).unwrap();
    let there = RemoteVision::connect(at("grpcs"), None, Some(&signer), terms(20)).unwrap();
    assert!(!there.propose(&photo(90, 80), &[[20.0, 50.0]]).unwrap().is_empty());
    let other = TrustedCertificates::read(&tls("other.pem")).unwrap();
    let refused =
        RemoteVision::connect(at("grpcs"), None, Some(&other), terms(1)).err().expect("somebody else's");
    assert!(refused.to_string().contains("certificate"), "{refused}");
    assert!(
        RemoteVision::connect(at("grpc"), None, None, terms(1)).is_err(),
        "nothing goes there in the open"
    );
    // By settings, as a run does it.
    let settings = VisionSettings {
        vision_service: at("grpcs")[0].to_string(),
        vision_certificates: tls("ca.pem").display().to_string(),
        ..VisionSettings::default()
    };
    assert_eq!(Providers::from_settings(&settings).unwrap().name, "remote:built-in");
}

#[test]
fn certificates_and_keys_that_cannot_be_used_are_named() {
    let read = |certificate: &str, key: &str| {
        ServiceIdentity::read(&tls(certificate), &tls(key)).map(drop).unwrap_err().to_string()
    };
    assert!(read("none.pem", "service.key").contains("none.pem"));
    assert!(read("service.key", "service.key").contains("service.key has no certificate"));
    assert!(read("service.pem", "ca.pem").contains("ca.pem has no private key"));
    let words = read("other.pem", "service.key");
    assert!(words.contains("other.pem") && words.contains("cannot be used together"), "{words}");
    assert!(TrustedCertificates::read(&tls("service.key")).is_err());
    let identity = ServiceIdentity::read(&tls("service.pem"), &tls("service.key")).unwrap();
    assert!(!format!("{identity:?}").contains("KEY"), "keys are not printed");
}
