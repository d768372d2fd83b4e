//! Frames that the kernel accepted and that are not confirmed on the bus yet.
//!
//! An interface accepts frames even when its cable is out. They wait in its queue (10 frames by default) and
//! in the controller, and leave in a burst when another node acknowledges again. By then the set-points
//! among them are stale. So the number of SYNCs whose frames may wait is limited.

use crate::canopen::sync::is_sync;
use crate::canopen::{Frame, cob};
use std::collections::VecDeque;

/// The echoes of at most this many given-up frames are still recognized: those of some twenty cycles.
const GIVEN_UP_MAX: usize = 64;

/// Own frames that wait for their echo, which the kernel delivers once the frame was sent.
#[derive(Debug, Clone, Default)]
pub struct Unconfirmed {
    /// Maximum number of waiting SYNCs.
    syncs_max: usize,
    frames: VecDeque<Frame>,
    /// For each waiting SYNC, the socket's count of dropped frames when it was sent.
    dropped_before: VecDeque<u64>,
    /// Frames that were given up; their echoes may still come.
    given_up: VecDeque<Frame>,
    /// Frames whose echo is missing although the echo of a later frame has come: those since the last SYNC was
    /// sent, and those since the SYNC before. A missing echo comes within two cycles, or was lost. After that,
    /// an identical frame is another node's.
    overtaken: [Vec<Frame>; 2],
}

impl Unconfirmed {
    /// No frames yet. The frames of up to `syncs_max` SYNCs, at least one, may wait.
    pub fn new(syncs_max: usize) -> Self {
        Unconfirmed { syncs_max: syncs_max.max(1), ..Unconfirmed::default() }
    }

    /// The numbers of waiting frames and SYNCs, if so many SYNCs wait that no more frames may be sent; otherwise
    /// `None`.
    pub fn too_many(&self) -> Option<(usize, usize)> {
        let syncs = self.dropped_before.len();
        (syncs >= self.syncs_max).then_some((self.frames.len(), syncs))
    }

    /// True if the missing echoes may have been dropped: a full socket drops echoes as it drops other frames.
    /// `dropped` is the socket's count of dropped frames now, which is then higher than when the oldest waiting
    /// SYNC was sent.
    pub fn may_be_dropped(&self, dropped: u64) -> bool {
        self.dropped_before.front().is_some_and(|before| *before < dropped)
    }

    /// Adds a frame that the kernel accepted; `dropped` is the socket's count of dropped frames at that time.
    pub fn sent(&mut self, frame: Frame, dropped: u64) {
        if is_sync(&frame, cob::SYNC) {
            self.dropped_before.push_back(dropped);
            let [newest, before] = &mut self.overtaken;
            *before = std::mem::take(newest);
        }
        self.frames.push_back(frame);
    }

    /// Takes a received frame; true if it is the echo of an own frame, which is then confirmed. The frames sent
    /// before that one were on the bus, too: their echoes were lost, or come a little later, because another
    /// processor delivers them. If another node sends an identical frame, the first one received counts as the
    /// echo.
    pub fn take_echo(&mut self, frame: &Frame) -> bool {
        let find = |frames: &VecDeque<Frame>| frames.iter().position(|sent| sent == frame);
        if let Some(index) = find(&self.frames) {
            let confirmed = self.frames.iter().take(index + 1);
            let syncs = confirmed.filter(|frame| is_sync(frame, cob::SYNC)).count();
            self.dropped_before.drain(..syncs);
            self.overtaken[0].extend(self.frames.drain(..index));
            self.frames.pop_front();
            return true;
        }
        if let Some(index) = find(&self.given_up) {
            self.given_up.drain(..=index);
            return true;
        }
        for overtaken in &mut self.overtaken {
            if let Some(index) = overtaken.iter().position(|sent| sent == frame) {
                overtaken.remove(index);
                return true;
            }
        }
        false
    }

    /// Stops waiting for all frames: the interface has dropped them, or their echoes were lost.
    pub fn give_up(&mut self) {
        self.dropped_before.clear();
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
    fn two_cycles_may_be_unconfirmed_and_no_third() {
        let mut unconfirmed = Unconfirmed::new(2);
        for cycle in 0..2 {
            assert_eq!(unconfirmed.too_many(), None);
            unconfirmed.sent(set_point(cycle), 0);
            unconfirmed.sent(sync(), 0);
        }
        assert_eq!(unconfirmed.too_many(), Some((4, 2)));
        assert!(unconfirmed.take_echo(&set_point(0)));
        assert_eq!(unconfirmed.too_many(), Some((3, 2)));
        assert!(unconfirmed.take_echo(&sync()));
        assert_eq!(unconfirmed.too_many(), None, "one cycle is confirmed");
    }

    /// Frames that were dropped before the cable was unplugged must not hide the missing echoes after it.
    #[test]
    fn only_frames_dropped_since_the_oldest_sync_that_waits_excuse_missing_echoes() {
        let mut unconfirmed = Unconfirmed::new(2);
        unconfirmed.sent(sync(), 0);
        assert!(unconfirmed.take_echo(&sync()));
        unconfirmed.sent(sync(), 5);
        unconfirmed.sent(sync(), 5);
        assert!(unconfirmed.too_many().is_some());
        assert!(!unconfirmed.may_be_dropped(5), "dropped before both SYNCs");
        assert!(!unconfirmed.may_be_dropped(0), "the count could not be read");
        assert!(unconfirmed.may_be_dropped(6));
        unconfirmed.give_up();
        unconfirmed.sent(sync(), 6);
        unconfirmed.sent(sync(), 7);
        assert!(unconfirmed.may_be_dropped(7), "dropped between the two");
        // The first is confirmed late, while the second waits.
        assert!(unconfirmed.take_echo(&sync()));
        unconfirmed.sent(sync(), 7);
        assert!(unconfirmed.too_many().is_some());
        assert!(!unconfirmed.may_be_dropped(7), "dropped before both that wait");
    }

    #[test]
    fn a_sent_frame_has_one_echo() {
        let mut unconfirmed = Unconfirmed::new(2);
        unconfirmed.sent(sync(), 0);
        assert!(!unconfirmed.take_echo(&set_point(1)), "never sent");
        assert!(unconfirmed.take_echo(&sync()));
        assert!(!unconfirmed.take_echo(&sync()), "another master's");
    }

    /// Otherwise the bench would take its own frames for those of another master.
    #[test]
    fn the_echo_of_a_frame_that_was_given_up_is_recognized() {
        let mut unconfirmed = Unconfirmed::new(2);
        (0..100).for_each(|number| unconfirmed.sent(set_point(number), 0));
        unconfirmed.sent(sync(), 0);
        unconfirmed.sent(sync(), 0);
        unconfirmed.give_up();
        assert_eq!(unconfirmed.too_many(), None);
        unconfirmed.sent(set_point(200), 0);
        assert!(unconfirmed.take_echo(&set_point(99)));
        assert!(!unconfirmed.take_echo(&set_point(1)), "given up long ago");
        assert!(unconfirmed.take_echo(&set_point(200)));
    }

    /// If a thread moves to another processor between two frames, the kernel echoes them from two queues.
    #[test]
    fn echoes_may_arrive_in_another_order() {
        let mut unconfirmed = Unconfirmed::new(2);
        (0..3).for_each(|number| unconfirmed.sent(set_point(number), 0));
        unconfirmed.sent(sync(), 0);
        assert!(unconfirmed.take_echo(&sync()));
        assert_eq!(unconfirmed.too_many(), None);
        for number in [1, 0] {
            assert!(unconfirmed.take_echo(&set_point(number)), "{number}");
            assert!(!unconfirmed.take_echo(&set_point(number)), "{number}, another master's");
        }
        assert!(unconfirmed.take_echo(&set_point(2)));
    }

    #[test]
    fn a_lost_echo_hides_another_masters_frame_for_two_cycles_at_most() {
        for (cycles, is_echo) in [(1, true), (2, false)] {
            let mut unconfirmed = Unconfirmed::new(2);
            unconfirmed.sent(set_point(7), 0);
            unconfirmed.sent(set_point(8), 0);
            assert!(unconfirmed.take_echo(&set_point(8)), "the echo of 7 is lost");
            for _ in 0..cycles {
                unconfirmed.sent(sync(), 0);
                assert!(unconfirmed.take_echo(&sync()));
            }
            assert_eq!(unconfirmed.take_echo(&set_point(7)), is_echo, "{cycles}");
        }
    }
}
