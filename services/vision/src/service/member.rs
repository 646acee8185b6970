//! One service of several: its connection, its slots, and whether it is there.

use crate::service_address::ServiceAddress;
use crate::service_error::ServiceError;
use crate::service_tls::{TrustedCertificates, encrypted, innermost};
use segwild_files::lock;
use segwild_proto::Token;
use segwild_proto::v1::vision_client::VisionClient;
use segwild_proto::v1::{self, Capability, PixelFormat};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};
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
/// Shortest rest of a service that failed.
const SHORTEST_REST: Duration = Duration::from_millis(100);
/// Longest rest.
const LONGEST_REST: Duration = Duration::from_secs(10);
/// A service rests for this part of the time that it has been away: it is used again after at most that much longer than it was
/// away, and one that stays away is called more and more rarely.
const REST_SHARE: u32 = 8;
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

impl Described {
    /// Key of the model of texts; `None` where it has none.
    pub fn texts(&self) -> Option<&String> {
        self.keys.get(&Capability::EmbedText)
    }

    /// Models of a run, and their keys: texts take no part in one.
    pub fn models_of_run(&self) -> impl Iterator<Item = (&Capability, &String)> {
        self.keys.iter().filter(|(capability, _)| **capability != Capability::EmbedText)
    }

    /// Whether a run may use both.
    pub fn serves_as(&self, other: &Described) -> bool {
        (&self.name, self.format, self.sky_uses_points) == (&other.name, other.format, other.sky_uses_points)
            && self.models_of_run().eq(other.models_of_run())
    }
}

/// What is known of a service.
#[derive(Clone, Debug, Default)]
struct Health {
    /// Since when it does not answer.
    gone_since: Option<Instant>,
    /// No call goes there before.
    rests_until: Option<Instant>,
    /// Whether it has to describe itself before the next call: it may have become another one.
    unknown: bool,
    /// Whether somebody asks it to.
    waited_for: bool,
    /// Key of its model of texts, when it described itself last.
    texts: Option<String>,
    /// Why it is not used any more.
    left_out: Option<String>,
    last: String,
}

impl Health {
    /// No call goes there for a while. Calls that fail together count once: the rest depends on the time alone.
    fn rest(&mut self, now: Instant, reason: &str) {
        let absence = now.duration_since(*self.gone_since.get_or_insert(now));
        self.rests_until = Some(now + (absence / REST_SHARE).clamp(SHORTEST_REST, LONGEST_REST));
        reason.clone_into(&mut self.last);
    }
}

/// A service.
pub(super) struct Member {
    pub address: ServiceAddress,
    client: Client,
    slots: OnceLock<Arc<Semaphore>>,
    health: Mutex<Health>,
}

impl Member {
    /// A service that is not known yet. It is connected when it is called.
    ///
    /// # Errors
    /// When what is sent there cannot be encrypted.
    pub fn new(
        address: ServiceAddress,
        token: Option<&Token>,
        trusted: Option<&TrustedCertificates>,
        most_message: usize,
    ) -> Result<Member, ServiceError> {
        let mut endpoint =
            Endpoint::from_shared(address.http()).expect("an address is checked when it is read");
        if address.is_encrypted() {
            endpoint = encrypted(endpoint, trusted).map_err(|error| ServiceError::NoTls {
                address: address.clone(),
                reason: innermost(&error).to_string(),
            })?;
        }
        let channel = endpoint
            .connect_timeout(CONNECT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(SIGN_OF_LIFE)
            .keep_alive_timeout(SIGN_OF_LIFE)
            .connect_lazy();
        let client = VisionClient::with_interceptor(channel, Credentials(token.map(Token::credentials)))
            .max_decoding_message_size(most_message);
        let health = Mutex::new(Health { unknown: true, ..Health::default() });
        Ok(Member { address, client, slots: OnceLock::new(), health })
    }

    fn health(&self) -> MutexGuard<'_, Health> {
        lock(&self.health)
    }

    pub fn client(&self) -> Client {
        self.client.clone()
    }

    /// Asks what it is.
    pub async fn describe(&self) -> Result<Described, Status> {
        let (described, calls) = described(self.client()).await?;
        self.slots.get_or_init(|| Arc::new(Semaphore::new(calls)));
        self.health().texts = described.texts().cloned();
        Ok(described)
    }

    /// Whether it has the model that a call needs: one of texts with this key, or those of a run.
    pub fn has(&self, texts: Option<&str>) -> bool {
        texts.is_none_or(|key| self.health().texts.as_deref() == Some(key))
    }

    /// Texts are not sent there until it describes itself again.
    pub fn has_other_texts(&self) {
        self.health().texts = None;
    }

    /// Its slots, if it may be called now.
    pub fn slots(&self, now: Instant) -> Option<Arc<Semaphore>> {
        let health = self.health();
        let rests = health.rests_until.is_some_and(|until| now < until);
        if rests || health.unknown || health.left_out.is_some() {
            return None;
        }
        self.slots.get().cloned()
    }

    /// Whether it has to describe itself and nobody asks it to yet. The caller then does, until [`rest`](Self::rest) is `None`.
    pub fn starts_waiting(&self) -> bool {
        let mut health = self.health();
        let asks = health.unknown && health.left_out.is_none() && !health.waited_for;
        health.waited_for |= asks;
        asks
    }

    /// Time until it may be queried for its description; `None` when that is known, or nobody needs to know any more.
    pub fn rest(&self) -> Option<Duration> {
        let mut health = self.health();
        health.waited_for = health.unknown && health.left_out.is_none();
        let until = health.rests_until.map(|until| until.saturating_duration_since(Instant::now()));
        health.waited_for.then(|| until.unwrap_or_default())
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
        health.unknown = false;
        health.rests_until = None;
        health.gone_since.take().is_some()
    }

    /// It does not answer: it rests, and has to describe itself afterwards. Returns whether it did answer before.
    pub fn fails(&self, reason: &str) -> bool {
        let mut health = self.health();
        let first = health.gone_since.is_none();
        health.rest(Instant::now(), reason);
        health.unknown = true;
        first
    }

    /// It has too much to do.
    pub fn is_busy(&self) {
        self.health().rest(Instant::now(), "it has too much to do");
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_without_texts_takes_part_in_a_run_beside_one_that_has_them() {
        let described = |models: &[(Capability, &str)]| Described {
            name: "sam".into(),
            keys: models.iter().map(|(capability, key)| (*capability, (*key).to_owned())).collect(),
            format: PixelFormat::U8,
            sky_uses_points: false,
        };
        let plain = described(&[(Capability::FindSky, "a")]);
        let with_texts = described(&[(Capability::FindSky, "a"), (Capability::EmbedText, "clip")]);
        assert!(plain.serves_as(&with_texts) && with_texts.serves_as(&plain));
        assert_eq!((plain.texts(), with_texts.texts().map(String::as_str)), (None, Some("clip")));
        assert!(!plain.serves_as(&described(&[(Capability::FindSky, "b")])));
        assert!(!plain.serves_as(&described(&[(Capability::FindSky, "a"), (Capability::Embed, "a")])));
    }

    #[test]
    fn a_service_rests_for_a_part_of_the_time_since_it_failed_however_many_calls_did() {
        let (mut health, began) = (Health::default(), Instant::now());
        let mut rest_after = |seconds: u64| {
            let now = began + Duration::from_secs(seconds);
            health.rest(now, "gone");
            health.rests_until.unwrap() - now
        };
        let rests = [0, 0, 0, 4, 20, 3600].map(&mut rest_after);
        assert_eq!(rests.map(|rest| rest.as_millis()), [100, 100, 100, 500, 2500, 10_000]);
    }
}
