//! One service of several: its connection, its slots, and whether it is there.

use super::address::ServiceAddress;
use segwild_proto::Token;
use segwild_proto::v1::vision_client::VisionClient;
use segwild_proto::v1::{self, Capability, PixelFormat};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};

/// Time in which a connection must stand, and a service must describe itself.
const CONNECT: Duration = Duration::from_secs(5);
/// Time between two signs of life on a connection: a machine that is gone is noticed within two of them.
const SIGN_OF_LIFE: Duration = Duration::from_secs(10);
/// Rest of a service after its first failure; it doubles with each further one.
const FIRST_REST: Duration = Duration::from_millis(250);
/// Longest rest.
const LONGEST_REST: Duration = Duration::from_secs(10);
/// Calls that a service is sent beyond those that it computes: they arrive while it computes.
const AHEAD: usize = 1;
/// Most calls at a time, whatever a service says of itself.
const MOST_CALLS: usize = 256;

/// Adds the token to each call.
#[derive(Clone)]
pub(super) struct Credentials(Option<MetadataValue<Ascii>>);

impl Interceptor for Credentials {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(credentials) = &self.0 {
            request.metadata_mut().insert("authorization", credentials.clone());
        }
        Ok(request)
    }
}

pub(super) type Client = VisionClient<InterceptedService<Channel, Credentials>>;

/// What a service is, as it says.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Described {
    pub name: String,
    /// The key of the model of each capability.
    pub keys: BTreeMap<Capability, String>,
    pub format: PixelFormat,
    pub sky_uses_points: bool,
}

/// What is known of a service.
#[derive(Clone, Debug, Default)]
struct Health {
    failures: u32,
    /// No call goes there before.
    rests_until: Option<Instant>,
    /// Whether it has to describe itself before the next call: it may have become another one.
    unknown: bool,
    /// Why it is not used any more.
    left_out: Option<String>,
    last: String,
}

/// A service.
pub(super) struct Member {
    pub address: ServiceAddress,
    client: Client,
    slots: OnceLock<Arc<Semaphore>>,
    /// The slot of the one call that asks a service what it is: others need not wait for one that may be gone.
    asking: Arc<Semaphore>,
    health: Mutex<Health>,
}

impl Member {
    /// A service that is not known yet. It is connected when it is called.
    pub fn new(address: ServiceAddress, token: Option<&Token>, most_message: usize) -> Member {
        let endpoint = Endpoint::from_shared(address.http()).expect("an address is checked when it is read");
        let channel = endpoint
            .connect_timeout(CONNECT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(SIGN_OF_LIFE)
            .keep_alive_timeout(SIGN_OF_LIFE)
            .connect_lazy();
        let client = VisionClient::with_interceptor(channel, Credentials(token.map(Token::credentials)))
            .max_decoding_message_size(most_message);
        let health = Mutex::new(Health { unknown: true, ..Health::default() });
        Member { address, client, slots: OnceLock::new(), asking: Arc::new(Semaphore::new(1)), health }
    }

    fn health(&self) -> MutexGuard<'_, Health> {
        self.health.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn client(&self) -> Client {
        self.client.clone()
    }

    /// Asks what it is.
    pub async fn describe(&self) -> Result<Described, Status> {
        let (described, calls) = described(self.client()).await?;
        self.slots.get_or_init(|| Arc::new(Semaphore::new(calls)));
        Ok(described)
    }

    /// Its slots, if it may be called now.
    pub fn slots(&self, now: Instant) -> Option<Arc<Semaphore>> {
        let health = self.health();
        let rests = health.rests_until.is_some_and(|until| now < until);
        if rests || health.left_out.is_some() {
            return None;
        }
        let slots = self.slots.get().filter(|_| !health.unknown);
        Some(slots.unwrap_or(&self.asking).clone())
    }

    /// Calls that it is sent at a time; 0 where it was never reached.
    pub fn calls(&self) -> usize {
        self.slots.get().map_or(0, |slots| slots.available_permits())
    }

    pub fn is_unknown(&self) -> bool {
        self.health().unknown
    }

    /// It has answered. Returns whether it had failed before.
    pub fn answers(&self) -> bool {
        let mut health = self.health();
        let came_back = health.failures > 0;
        (health.failures, health.rests_until, health.unknown) = (0, None, false);
        came_back
    }

    /// It does not answer: it rests, and has to describe itself afterwards. Returns whether it did answer before.
    pub fn fails(&self, reason: &str) -> bool {
        let mut health = self.health();
        let first = health.failures == 0;
        self.rest(&mut health, reason);
        health.unknown = true;
        first
    }

    /// It has too much to do.
    pub fn is_busy(&self) {
        self.rest(&mut self.health(), "it has too much to do");
    }

    fn rest(&self, health: &mut Health, reason: &str) {
        let rest = FIRST_REST.saturating_mul(1 << health.failures.min(16)).min(LONGEST_REST);
        health.failures += 1;
        health.rests_until = Some(Instant::now() + rest);
        reason.clone_into(&mut health.last);
    }

    /// It is not used any more.
    pub fn leave_out(&self, reason: String) {
        self.health().left_out = Some(reason);
    }

    pub fn is_left_out(&self) -> bool {
        self.health().left_out.is_some()
    }

    /// Its address and what is known against it.
    pub fn reason(&self) -> String {
        let health = self.health();
        let reason = health.left_out.clone().unwrap_or_else(|| health.last.clone());
        format!("{}: {}", self.address, if reason.is_empty() { "it does not answer" } else { &reason })
    }
}

/// Asks a service what it is, and how many calls it is sent at a time.
pub(super) async fn described(mut client: Client) -> Result<(Described, usize), Status> {
    let answer = tokio::time::timeout(CONNECT, client.describe(v1::DescribeRequest {})).await;
    let answer = answer.map_err(|_| Status::unavailable("it does not answer"))??.into_inner();
    let calls = (answer.parallel.max(1) as usize).min(MOST_CALLS) + AHEAD;
    let known = |model: &v1::Model| model.capability() != Capability::Unspecified && !model.key.is_empty();
    let (format, name) = (answer.pixel_format(), answer.name);
    let keys: BTreeMap<_, _> =
        answer.models.into_iter().filter(known).map(|model| (model.capability(), model.key)).collect();
    if keys.is_empty() || format == PixelFormat::Unspecified {
        return Err(Status::failed_precondition("it names no model, or no format of images"));
    }
    Ok((Described { name: plain(&name), keys, format, sky_uses_points: answer.sky_uses_points }, calls))
}

/// Another machine's text, for messages of one line.
pub(super) fn plain(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(200).collect()
}
