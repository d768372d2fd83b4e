//! Frames that were handed to the kernel and that nobody has seen on the bus yet.
//!
//! A bus whose cable is out takes frames all the same: they wait in the interface's queue (10 by
//! default) and in the controller, and leave in a burst when somebody acknowledges again. By then the
//! set-points among them are stale. So no more of them wait than those of as many SYNCs as may go
//! unanswered.

use crate::canopen::{Frame, cob};
use std::collections::VecDeque;

/// Frames whose echo would still be known after they were given up: some twenty cycles.
const GIVEN_UP_MAX: usize = 64;

/// Own frames from their sending to their echo, which the kernel gives when they have left.
#[derive(Debug, Clone)]
pub struct Unconfirmed {
    /// SYNCs that may wait at once.
    syncs_max: usize,
    frames: VecDeque<Frame>,
    /// Frames that are no longer waited for, and may be heard all the same.
    given_up: VecDeque<Frame>,
}

impl Unconfirmed {
    /// None yet; of `syncs_max` SYNCs, at least one, the frames may wait at once.
    pub fn new(syncs_max: usize) -> Self {
        let (frames, given_up) = (VecDeque::new(), VecDeque::new());
        Unconfirmed { syncs_max: syncs_max.max(1), frames, given_up }
    }

    /// How many frames wait, when no other may join them.
    pub fn too_many(&self) -> Option<usize> {
        let syncs = self.frames.iter().filter(|frame| frame.cob_id() == Some(cob::SYNC)).count();
        (syncs >= self.syncs_max).then_some(self.frames.len())
    }

    /// Notes a frame that was handed to the kernel.
    pub fn sent(&mut self, frame: Frame) {
        self.frames.push_back(frame);
    }

    /// Takes a frame that was heard: true if it is one of these. Those sent before it have left too,
    /// and their echoes were lost. Of a stranger's frame that is the same to the bit, the first to
    /// be heard counts as ours and the second as the stranger's.
    pub fn take_echo(&mut self, frame: &Frame) -> bool {
        [&mut self.frames, &mut self.given_up].into_iter().any(|frames| {
            let at = frames.iter().position(|sent| sent == frame);
            frames.drain(..at.map_or(0, |at| at + 1));
            at.is_some()
        })
    }

    /// Waits for none of them any longer: the interface has thrown them away, or their echoes were
    /// lost.
    pub fn give_up(&mut self) {
        self.given_up.append(&mut self.frames);
        let old = self.given_up.len().saturating_sub(GIVEN_UP_MAX);
        self.given_up.drain(..old);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sync() -> Frame {
        Frame::new(cob::SYNC, &[])
    }

    fn set_point(number: u8) -> Frame {
        Frame::new(0x201, &[0x0F, 0, number, 0, 0, 0])
    }

    #[test]
    fn two_cycles_may_wait_and_no_third() {
        let mut unconfirmed = Unconfirmed::new(2);
        for cycle in 0..2 {
            assert_eq!(unconfirmed.too_many(), None);
            unconfirmed.sent(set_point(cycle));
            unconfirmed.sent(sync());
        }
        assert_eq!(unconfirmed.too_many(), Some(4));
        assert!(unconfirmed.take_echo(&set_point(0)));
        assert_eq!(unconfirmed.too_many(), Some(3));
        assert!(unconfirmed.take_echo(&sync()));
        assert_eq!(unconfirmed.too_many(), None, "it goes on as soon as one cycle is out");
    }

    #[test]
    fn a_frame_is_an_echo_once() {
        let mut unconfirmed = Unconfirmed::new(2);
        unconfirmed.sent(sync());
        assert!(!unconfirmed.take_echo(&set_point(1)), "never sent");
        assert!(unconfirmed.take_echo(&sync()));
        assert!(!unconfirmed.take_echo(&sync()), "another master's");
    }

    /// Their echoes are not taken for another master's frames.
    #[test]
    fn what_was_given_up_is_known_when_it_is_heard_after_all() {
        let mut unconfirmed = Unconfirmed::new(2);
        (0..100).for_each(|number| unconfirmed.sent(set_point(number)));
        unconfirmed.sent(sync());
        unconfirmed.sent(sync());
        unconfirmed.give_up();
        assert_eq!(unconfirmed.too_many(), None);
        unconfirmed.sent(set_point(200));
        assert!(unconfirmed.take_echo(&set_point(99)));
        assert!(!unconfirmed.take_echo(&set_point(1)), "long ago");
        assert!(unconfirmed.take_echo(&set_point(200)));
    }

    #[test]
    fn a_lost_echo_is_made_up_for_by_the_next() {
        let mut unconfirmed = Unconfirmed::new(2);
        (0..3).for_each(|number| unconfirmed.sent(set_point(number)));
        assert!(unconfirmed.take_echo(&set_point(2)));
        assert!(!unconfirmed.take_echo(&set_point(0)));
    }
}
