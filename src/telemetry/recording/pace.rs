//! How often rows are sent to rerun.

use std::time::{Duration, Instant};

/// Rows are gathered for this long: what a kill may cost, with a little for the way to the file.
const SEND_EVERY: Duration = Duration::from_millis(100);
/// On a machine so slow that sending takes long, this many times as long is left to others: what a
/// kill may cost there is then more,
const REST_PER_SEND: u32 = 4;
/// but not more than by this.
const REST_MAX: Duration = Duration::from_secs(1);

/// When rows are to be sent next.
#[derive(Debug)]
pub(super) struct Pace {
    next: Instant,
}

impl Pace {
    /// Of one who begins at `now`.
    pub(super) fn new(now: Instant) -> Self {
        Pace { next: now + SEND_EVERY }
    }

    pub(super) fn is_due(&self, now: Instant) -> bool {
        now >= self.next
    }

    /// Rows were sent, which took from `began` to `ended`.
    pub(super) fn sent(&mut self, began: Instant, ended: Instant) {
        let rest = ended.saturating_duration_since(began) * REST_PER_SEND;
        self.next = (began + SEND_EVERY).max(ended + rest.min(REST_MAX));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_machine_sends_less_often_and_never_seldom() {
        let ms = Duration::from_millis;
        let begin = Instant::now();
        let mut pace = Pace::new(begin);
        assert!(!pace.is_due(begin + ms(99)) && pace.is_due(begin + ms(100)));
        let mut next_after = |took: u64| {
            pace.sent(begin, begin + ms(took));
            pace.next - begin
        };
        assert_eq!(
            [5, 20, 50, 200, 9000].map(&mut next_after).map(|d| d.as_millis()),
            [100, 100, 250, 1000, 10_000]
        );
    }
}
