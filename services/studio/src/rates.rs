//! How much clients may request. A client has a bucket, which fills again with time; a request takes of it what its
//! answer costs, and without enough left the client waits.

use segwild_flow::lock;
use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// What a request takes of its client's bucket. A candidate under the pointer is 1, which is 10 to 20 ms of a
/// processor; so is what costs less, such as a file of the page.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct RequestCost(f64);

impl RequestCost {
    /// Of a candidate, of the state, of a file of the page, and of a refusal.
    pub const LEAST: RequestCost = RequestCost(1.0);
    /// Of a photo that is decoded.
    const PHOTO: RequestCost = RequestCost(2.0);
    /// Of the view of operators: that of a farm has a line per scene.
    const VIEW: RequestCost = RequestCost(4.0);
    /// Of a render.
    const RENDER: RequestCost = RequestCost(4.0);
    /// Of a click, which all photos answer unless the next click cancels it; of other actions; of renders into all
    /// photos.
    const ACTION: RequestCost = RequestCost(20.0);
    /// Of a file with splats or masks, and of a training.
    const EXPORT: RequestCost = RequestCost(100.0);
    /// What a candidate in a view costs beyond one in a photo: it is a render.
    pub const OF_VIEW: RequestCost = RequestCost(RequestCost::RENDER.0 - RequestCost::LEAST.0);

    /// That of a call of `session.proto`.
    pub fn of(call: &str) -> RequestCost {
        match call {
            "Photo" | "TrainingPhoto" => RequestCost::PHOTO,
            "Status" | "Farm" => RequestCost::VIEW,
            "Frame" | "Pick" | "PhotoLabels" => RequestCost::RENDER,
            "Act" | "ObjectPhotos" | "Changes" | "Retry" | "RetryOnFarm" => RequestCost::ACTION,
            "Save" | "Coco" | "ObjectCoco" | "Masks" | "ObjectMasks" | "ObjectFile" | "LabelledPly"
            | "Splats" | "Train" => RequestCost::EXPORT,
            _ => RequestCost::LEAST,
        }
    }
}

/// What a page takes in a second at most: a candidate and a render per frame of the fastest displays while a pointer
/// moves, each only once the one before is there.
const PER_PAGE: f64 = 240.0 * (RequestCost::LEAST.0 + RequestCost::RENDER.0);

/// Pages of one address that do so at a time.
const PAGES: f64 = 4.0;

/// For clients with the token. A page that opens requests some files, the splats, and the thumbnails that are in sight.
const WITH_TOKEN: RateLimit = RateLimit { most: 10_000.0, per_second: PAGES * PER_PAGE };

/// For requests that are refused: a page with an earlier token tries again every few seconds.
const REFUSED: RateLimit = RateLimit { most: 60.0, per_second: 5.0 };

/// Clients that are counted at a time.
const MOST_CLIENTS: usize = 1024;

/// Bits of an IPv6 address that name a network; the rest is its owner's to choose.
const NETWORK: u128 = u128::MAX << 64;

/// How much a client may save up, and how much it gets in a second.
#[derive(Clone, Copy, Debug)]
struct RateLimit {
    most: f64,
    per_second: f64,
}

/// Whose requests are counted together. A server has one token, so that the address tells its clients apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum RatedClient {
    /// Those of an address that have the token.
    WithToken(IpAddr),
    /// Those of an address that are refused. They use nothing up of what the others may.
    Refused(IpAddr),
}

impl RatedClient {
    /// The client of an address.
    pub fn of(address: IpAddr, has_token: bool) -> RatedClient {
        let address = match address.to_canonical() {
            IpAddr::V6(v6) => IpAddr::V6(Ipv6Addr::from_bits(v6.to_bits() & NETWORK)),
            v4 @ IpAddr::V4(_) => v4,
        };
        if has_token { RatedClient::WithToken(address) } else { RatedClient::Refused(address) }
    }

    fn limit(self) -> RateLimit {
        match self {
            RatedClient::WithToken(_) => WITH_TOKEN,
            RatedClient::Refused(_) => REFUSED,
        }
    }
}

/// What a client has left, and since when.
struct RequestBucket {
    left: f64,
    at: Instant,
}

impl RequestBucket {
    fn refill(&mut self, limit: RateLimit, now: Instant) {
        let passed = now.saturating_duration_since(self.at).as_secs_f64();
        self.left = (self.left + passed * limit.per_second).min(limit.most);
        self.at = self.at.max(now);
    }
}

/// The buckets of a server's clients.
#[derive(Default)]
pub(crate) struct RequestRates {
    buckets: Mutex<HashMap<RatedClient, RequestBucket>>,
}

impl RequestRates {
    /// Takes a request of a client, at a time.
    ///
    /// # Errors
    /// How long the client has to wait, where it has not enough left.
    pub fn admit(&self, client: RatedClient, cost: RequestCost, now: Instant) -> Result<(), Duration> {
        let limit = client.limit();
        let mut buckets = lock(&self.buckets);
        if !buckets.contains_key(&client) && buckets.len() >= MOST_CLIENTS {
            // A full bucket is as good as none.
            buckets.retain(|client, bucket| {
                bucket.refill(client.limit(), now);
                bucket.left < client.limit().most
            });
            let fullest =
                buckets.iter().max_by(|a, b| a.1.left.total_cmp(&b.1.left)).map(|(client, _)| *client);
            if let Some(fullest) = fullest.filter(|_| buckets.len() >= MOST_CLIENTS) {
                buckets.remove(&fullest);
            }
        }
        let bucket = buckets.entry(client).or_insert(RequestBucket { left: limit.most, at: now });
        bucket.refill(limit, now);
        let RequestCost(cost) = cost;
        if bucket.left < cost {
            return Err(Duration::from_secs_f64((cost - bucket.left) / limit.per_second));
        }
        bucket.left -= cost;
        Ok(())
    }

    /// Takes what an admitted request costs further, of what comes where not enough is left.
    fn charge(&self, client: RatedClient, cost: RequestCost, now: Instant) {
        if let Some(bucket) = lock(&self.buckets).get_mut(&client) {
            bucket.refill(client.limit(), now);
            bucket.left -= cost.0;
        }
    }
}

/// The client of a request that was admitted, for whoever finds out by its body that it costs more.
#[derive(Clone)]
pub(crate) struct AdmittedClient {
    pub rates: Arc<RequestRates>,
    pub client: RatedClient,
}

impl AdmittedClient {
    /// Takes what the request costs beyond what it was admitted for.
    pub fn charge(&self, cost: RequestCost) {
        self.rates.charge(self.client, cost, Instant::now());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEAST: RequestCost = RequestCost::LEAST;

    fn client(last: u8, has_token: bool) -> RatedClient {
        RatedClient::of(IpAddr::from([192, 0, 2, last]), has_token)
    }

    /// How many of the requests of a client pass that come every so often.
    fn passing(
        rates: &RequestRates,
        client: RatedClient,
        cost: RequestCost,
        from: Instant,
        requests: u32,
        every: Duration,
    ) -> u32 {
        (0..requests).map(|k| u32::from(rates.admit(client, cost, from + every * k).is_ok())).sum()
    }

    #[test]
    fn hovering_on_the_fastest_display_never_waits() {
        let (rates, start) = (RequestRates::default(), Instant::now());
        // A candidate and a render per frame, of each of four pages of one machine.
        for frame in 0..50_000 {
            let now = start + Duration::from_secs_f64(1.0 / 240.0) * frame;
            for cost in [LEAST, RequestCost::of("Frame")].repeat(PAGES as usize) {
                assert_eq!(rates.admit(client(1, true), cost, now), Ok(()), "frame {frame}");
            }
        }
    }

    #[test]
    fn what_costs_more_passes_less_often() {
        let calls = ["Hover", "Photo", "Frame", "Act", "ObjectFile"];
        let now = Instant::now();
        let count = |call: &str| {
            let (rates, cost) = (RequestRates::default(), RequestCost::of(call));
            passing(&rates, client(1, true), cost, now, 2 * WITH_TOKEN.most as u32, Duration::ZERO)
        };
        let counts: Vec<u32> = calls.iter().map(|call| count(call)).collect();
        assert!(counts.is_sorted_by(|a, b| a > b), "{counts:?}");
        // A person who clicks and exports as fast as they can does not wait.
        assert!(counts[3] >= 100 && counts[4] >= 20, "{counts:?}");
        // Exports that had to wait leave what a candidate needs.
        let (rates, client) = (RequestRates::default(), client(1, true));
        let export = RequestCost::of("ObjectFile");
        assert_eq!(passing(&rates, client, export, now, 1000, Duration::ZERO), counts[4]);
        let wait = rates.admit(client, export, now).unwrap_err();
        assert!(wait < Duration::from_secs(1), "{wait:?}");
        assert_eq!(rates.admit(client, LEAST, now + wait), Ok(()));
    }

    #[test]
    fn a_client_that_asks_without_end_waits_and_goes_on_once_it_has_waited() {
        let (rates, start) = (RequestRates::default(), Instant::now());
        let flooding = client(1, true);
        let most = WITH_TOKEN.most as u32;
        assert_eq!(passing(&rates, flooding, LEAST, start, 3 * most, Duration::ZERO), most);
        let wait = rates.admit(flooding, LEAST, start).unwrap_err();
        assert!(wait > Duration::ZERO && wait < Duration::from_secs(1), "{wait:?}");
        assert_eq!(rates.admit(flooding, LEAST, start + 2 * wait), Ok(()));
        // Somebody else, and a clock that steps back, lose nothing.
        assert_eq!(rates.admit(client(2, true), LEAST, start), Ok(()));
        let later = start + Duration::from_secs(3600);
        assert_eq!(passing(&rates, flooding, LEAST, later, 3 * most, Duration::ZERO), most);
        assert!(rates.admit(flooding, LEAST, start).is_err());
    }

    #[test]
    fn what_a_request_costs_further_is_waited_for_by_the_next_one() {
        let (rates, client) = (Arc::new(RequestRates::default()), client(1, true));
        let admitted = AdmittedClient { rates: rates.clone(), client };
        // One that was never admitted has no bucket.
        admitted.charge(RequestCost::OF_VIEW);
        assert_eq!(rates.admit(client, LEAST, Instant::now()), Ok(()));
        (0..WITH_TOKEN.most as usize).for_each(|_| admitted.charge(RequestCost::OF_VIEW));
        let wait = rates.admit(client, LEAST, Instant::now()).expect_err("more was taken than was left");
        assert_eq!(rates.admit(client, LEAST, Instant::now() + 2 * wait), Ok(()));
        assert_eq!(RequestCost(LEAST.0 + RequestCost::OF_VIEW.0), RequestCost::of("Pick"));
    }

    #[test]
    fn refused_requests_use_nothing_up_of_those_with_the_token() {
        let (rates, now) = (RequestRates::default(), Instant::now());
        let most = REFUSED.most as u32;
        assert_eq!(passing(&rates, client(1, false), LEAST, now, 2 * most, Duration::ZERO), most);
        assert_eq!(rates.admit(client(1, true), LEAST, now), Ok(()));
    }

    #[test]
    fn a_network_is_one_client_and_clients_without_end_take_bounded_memory() {
        let address = |text: &str| RatedClient::of(text.parse().unwrap(), false);
        assert_eq!(address("2001:db8::1"), address("2001:db8::ffff:2"));
        assert_ne!(address("2001:db8::1"), address("2001:db8:0:1::1"));
        assert_eq!(address("::ffff:192.0.2.1"), client(1, false));
        let (rates, now) = (RequestRates::default(), Instant::now());
        let many = 2 * MOST_CLIENTS as u32;
        for k in 0..many {
            let client = RatedClient::of(IpAddr::from(k.to_be_bytes()), false);
            assert_eq!(rates.admit(client, LEAST, now), Ok(()));
        }
        assert!(lock(&rates.buckets).len() <= MOST_CLIENTS);
    }
}
