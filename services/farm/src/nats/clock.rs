//! The server's clock, as far as a handle knows it.

use crate::table::CLOCK_SLACK_S;

/// What the server's clock shows, estimated from when it stored this handle's own records, by the steady clock of this
/// machine. The estimate is never ahead of the server: a lease is not taken for over too early. What the wall clock of
/// this machine shows plays no part.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ServerClock {
    /// What the server's clock shows at least when the steady clock shows 0.
    ahead: Option<f64>,
}

impl ServerClock {
    /// The time at a reading of the steady clock; `None` before anything was observed.
    pub fn now(&self, steady: f64) -> Option<f64> {
        Some(self.ahead? + steady)
    }

    /// The server stored a record at `stored`, between two readings of the steady clock. Where that cannot be by what is
    /// known, the server's clock was set: says by how much, and keeps to what it knew.
    pub fn observe(&mut self, stored: f64, sent: f64, answered: f64) -> Option<f64> {
        let (least, most) = (stored - answered, stored - sent);
        let Some(ahead) = self.ahead else {
            self.ahead = Some(least);
            return None;
        };
        // What was estimated was never too much, and too little by no more than the slowest answer so far.
        if most < ahead - CLOCK_SLACK_S {
            return Some(most - ahead);
        }
        // How late that answer was is not known; two slow ones in a row are no jump.
        if least > ahead + CLOCK_SLACK_S.max(10.0 * (answered - sent)) {
            return Some(least - ahead);
        }
        self.ahead = Some(ahead.max(least));
        None
    }

    /// The server's clock was set.
    pub fn set(&mut self, seconds: f64) {
        self.ahead = self.ahead.map(|ahead| ahead + seconds);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_is_never_ahead_of_the_server_and_comes_close() {
        let mut clock = ServerClock::default();
        assert_eq!(clock.now(5.0), None);
        // The server's clock shows 1000 when the steady one shows 0; the answer took long.
        assert_eq!(clock.observe(1005.1, 5.0, 5.8), None);
        let first = clock.now(10.0).unwrap();
        assert!((1009.0..=1010.0).contains(&first), "{first}");
        assert_eq!(clock.observe(1010.1, 10.0, 10.2), None);
        let second = clock.now(20.0).unwrap();
        assert!((1019.85..=1020.0).contains(&second), "{second}");
        // A slow answer later does not take it back.
        assert_eq!(clock.observe(1025.9, 25.0, 26.5), None);
        assert_eq!(clock.now(20.0), Some(second));
    }

    #[test]
    fn a_server_whose_clock_is_set_is_noticed_and_followed() {
        for jump in [-86_400.0, 86_400.0] {
            let mut clock = ServerClock::default();
            clock.observe(1005.0, 5.0, 5.0);
            let seen = clock.observe(1010.0 + jump, 10.0, 10.0).expect("a jump");
            assert!((seen - jump).abs() < 0.01, "{seen}");
            assert_eq!(clock.now(10.0), Some(1010.0), "until everybody knows");
            clock.set(seen);
            assert_eq!(clock.observe(1015.0 + jump, 15.0, 15.0), None);
        }
    }
}
