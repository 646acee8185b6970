//! How often clients may ask. A client has a bucket of requests, which fills again with time; without one left it waits.

use segwild_flow::lock;
use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Candidates and renders that a page asks for in a second at most: one of each per frame of the fastest displays while a pointer
/// moves, and each only once the one before is there.
const PER_PAGE: f64 = 2.0 * 240.0;

/// Pages of one address that do so at a time.
const PAGES: f64 = 4.0;

/// For clients with the token. A page that opens asks for some files and for the thumbnails that are in sight.
const WITH_TOKEN: RateLimit = RateLimit { most: 4000.0, per_second: PAGES * PER_PAGE };

/// For requests that are refused: a page with an earlier token tries again every few seconds.
const REFUSED: RateLimit = RateLimit { most: 60.0, per_second: 5.0 };

/// Clients that are counted at a time.
const MOST_CLIENTS: usize = 1024;

/// Bits of an IPv6 address that name a network; the rest is its owner's to choose.
const NETWORK: u128 = u128::MAX << 64;

/// How many requests a client may save up, and how many it gets in a second.
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
    /// How long the client has to wait, where it has none left.
    pub fn admit(&self, client: RatedClient, now: Instant) -> Result<(), Duration> {
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
        if bucket.left < 1.0 {
            return Err(Duration::from_secs_f64((1.0 - bucket.left) / limit.per_second));
        }
        bucket.left -= 1.0;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(last: u8, has_token: bool) -> RatedClient {
        RatedClient::of(IpAddr::from([192, 0, 2, last]), has_token)
    }

    /// How many of the requests of a client pass that come every so often.
    fn passing(
        rates: &RequestRates,
        client: RatedClient,
        from: Instant,
        requests: u32,
        every: Duration,
    ) -> u32 {
        (0..requests).map(|k| u32::from(rates.admit(client, from + every * k).is_ok())).sum()
    }

    #[test]
    fn hovering_on_the_fastest_display_never_waits() {
        let (rates, start) = (RequestRates::default(), Instant::now());
        let (every, requests) = (Duration::from_secs_f64(1.0 / PER_PAGE), 100_000);
        assert_eq!(passing(&rates, client(1, true), start, requests, every), requests);
        // Nor do four pages of one machine.
        let every = every.div_f64(PAGES);
        assert_eq!(passing(&rates, client(2, true), start, requests, every), requests);
    }

    #[test]
    fn a_client_that_asks_without_end_waits_and_goes_on_once_it_has_waited() {
        let (rates, start) = (RequestRates::default(), Instant::now());
        let flooding = client(1, true);
        let most = WITH_TOKEN.most as u32;
        assert_eq!(passing(&rates, flooding, start, 3 * most, Duration::ZERO), most);
        let wait = rates.admit(flooding, start).unwrap_err();
        assert!(wait > Duration::ZERO && wait < Duration::from_secs(1), "{wait:?}");
        assert_eq!(rates.admit(flooding, start + 2 * wait), Ok(()));
        // Somebody else, and a clock that steps back, lose nothing.
        assert_eq!(rates.admit(client(2, true), start), Ok(()));
        let later = start + Duration::from_secs(3600);
        assert_eq!(passing(&rates, flooding, later, 3 * most, Duration::ZERO), most);
        assert!(rates.admit(flooding, start).is_err());
    }

    #[test]
    fn refused_requests_use_nothing_up_of_those_with_the_token() {
        let (rates, now) = (RequestRates::default(), Instant::now());
        let most = REFUSED.most as u32;
        assert_eq!(passing(&rates, client(1, false), now, 2 * most, Duration::ZERO), most);
        assert_eq!(rates.admit(client(1, true), now), Ok(()));
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
            assert_eq!(rates.admit(client, now), Ok(()));
        }
        assert!(lock(&rates.buckets).len() <= MOST_CLIENTS);
    }
}
