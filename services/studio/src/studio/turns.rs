//! Whose turn it is to find the candidate under a pointer: the provider's, if it is free and was in time before.

use std::time::{Duration, Instant};

/// Time after which a candidate comes too late for a pointer that moves.
pub(super) const IN_TIME: Duration = Duration::from_millis(60);

/// How long a provider that came too late is not tried again: its work would be for nothing.
const REST: Duration = Duration::from_secs(10);

/// The turns of a session's provider: one candidate at a time.
#[derive(Debug, Default)]
pub(super) struct ProviderTurns {
    busy: bool,
    resting_until: Option<Instant>,
    /// Whether it has no further turn.
    retired: bool,
}

impl ProviderTurns {
    /// Takes a turn; returns whether there is one.
    pub fn take(&mut self, now: Instant) -> bool {
        let resting = self.resting_until.is_some_and(|until| now < until);
        let free = !self.busy && !resting && !self.retired;
        self.busy |= free;
        free
    }

    /// Ends a turn whose candidate took a time, if there was one.
    pub fn end(&mut self, took: Option<Duration>, now: Instant) {
        self.busy = false;
        self.resting_until = took.filter(|took| *took > IN_TIME).map(|_| now + REST);
    }

    /// Lets the provider rest for good: it keeps nothing of a photo, so that no candidate of its own would ever come.
    pub fn retire(&mut self) {
        self.retired = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_provider_has_one_turn_at_a_time_and_rests_once_it_came_too_late() {
        let (mut turns, start) = (ProviderTurns::default(), Instant::now());
        assert!(turns.take(start) && !turns.take(start));
        turns.end(Some(IN_TIME), start);
        assert!(turns.take(start));
        // To encode a photo is no candidate.
        turns.end(None, start);
        assert!(turns.take(start));
        turns.end(Some(2 * IN_TIME), start);
        assert!(!turns.take(start) && !turns.take(start + REST / 2));
        assert!(turns.take(start + REST) && !turns.take(start + REST));
        turns.retire();
        turns.end(None, start + REST);
        assert!(!turns.take(start + 9 * REST));
    }
}
