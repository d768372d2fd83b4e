//! How often rows are sent to rerun.

use std::time::{Duration, Instant};

/// Rows are gathered for this long: what a kill may cost, with a little for the way to the file.
const SEND_EVERY: Duration = Duration::from_millis(100);
/// On a machine so slow that this is too little for the way to the file, as long is left to others,
/// but not so long that a file which takes nothing more would be told of late.
const REST_MAX: Duration = Duration::from_millis(300);

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

    /// Rows were on their way from `began` to `ended`.
    pub(super) fn sent(&mut self, began: Instant, ended: Instant) {
        let rest = ended.saturating_duration_since(began).min(REST_MAX);
        self.next = (began + SEND_EVERY).max(ended + rest);
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
        let next = [5, 50, 80, 300, 9000].map(|took| next_after(took).as_millis());
        assert_eq!(next, [100, 100, 160, 600, 9300]);
    }
}
