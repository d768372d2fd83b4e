//! The SocketCAN transport on vcan0 and vcan1 of `vcan/run.sh`. Tests that would disturb others use vcan1.

use std::time::{Duration, SystemTime};

use crate::support::link::ip;
use crate::support::programs::LONG;
use crate::support::vcan;
use needle_bench::canopen::{CanId, Frame, NodeId};
use needle_bench::transport::can::{BusError, BusEvent, CanBus, CanError};
use needle_bench::transport::socketcan::SocketCan;
use socketcan::{CanErrorFrame, CanFrame, CanSocket, Socket};

/// A busy kernel may deliver a frame this long after it was sent.
const ARRIVES: Duration = Duration::from_secs(1);

fn open(interface: &str) -> SocketCan {
    SocketCan::open(interface).unwrap_or_else(|error| panic!("{error}"))
}

/// The first event that `wanted` accepts; skips the traffic of other tests.
fn next(bus: &mut SocketCan, wanted: impl Fn(&BusEvent) -> bool) -> BusEvent {
    loop {
        match bus.receive(LONG).unwrap() {
            Some(event) if wanted(&event) => return event,
            Some(_) => {}
            None => panic!("no event within {LONG:?}"),
        }
    }
}

#[test]
fn request_and_reply_pass_and_the_request_is_not_echoed() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let (mut master, mut drive) = (open("vcan0"), open("vcan0"));
    let request = Frame::new(0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]);
    let reply = Frame::new(0x581, &[0x4B, 0x41, 0x60, 0, 0x40, 0x02, 0, 0]);

    master.send(&request).unwrap();
    next(&mut drive, |event| *event == BusEvent::Frame(request));
    drive.send(&reply).unwrap();
    // A socket does not receive its own frames, so the reply comes first.
    let ours = |event: &BusEvent| [request, reply].map(BusEvent::Frame).contains(event);
    assert_eq!(next(&mut master, ours), BusEvent::Frame(reply));
}

#[test]
fn extended_and_remote_frames_pass() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let (mut a, mut b) = (open("vcan0"), open("vcan0"));
    let extended = Frame::from_parts(CanId::Extended(0x602), false, &[1, 2, 3]).unwrap();
    let remote = Frame::from_parts(CanId::Base(0x703), true, &[0; 4]).unwrap();
    for frame in [extended, remote] {
        a.send(&frame).unwrap();
        next(&mut b, |event| *event == BusEvent::Frame(frame));
    }
}

#[test]
fn an_error_frame_is_received_and_described() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let injector = CanSocket::open("vcan0").unwrap();
    let mut bus = open("vcan0");
    let counters = [0, 0, 0, 0, 0, 0, 248, 7];
    let frame = CanErrorFrame::new_error(0x240, &counters).unwrap();
    injector.write_frame(&CanFrame::Error(frame)).unwrap();
    let event = next(&mut bus, |event| matches!(event, BusEvent::Error(_)));
    let BusEvent::Error(error) = event else { unreachable!("filtered above") };
    assert_eq!(error, BusError::new(0x240, counters));
    assert_eq!(error.to_string(), "bus off; error counters: tx=248, rx=7");
}

#[test]
fn the_kernel_stamps_a_frame_when_it_arrives() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let (mut a, mut b) = (open("vcan0"), open("vcan0"));
    let frame = Frame::new(0x604, &[1]);
    assert_eq!(b.received_at(), None);
    // The kernel begins to stamp a little after a socket has asked for it.
    let (before, after, stamp) = (0..100)
        .find_map(|_| {
            let before = SystemTime::now();
            a.send(&frame).unwrap();
            let after = SystemTime::now();
            // The stamp does not depend on how long the frame waits here.
            next(&mut b, |event| *event == BusEvent::Frame(frame));
            Some((before, after, b.received_at()?))
        })
        .expect("a stamp");
    assert!((before..=after).contains(&stamp), "{before:?} {stamp:?} {after:?}");
}

#[test]
fn a_filter_passes_frames_from_and_for_our_nodes_whoever_sends_them() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let (mut sender, mut bus) = (open("vcan1"), open("vcan1"));
    // This frame waits already when the filter is set.
    sender.send(&Frame::new(0x185, &[0])).unwrap();
    bus.listen_to(&[1, 127].map(|node| NodeId::new(node).unwrap())).unwrap();
    let extended = CanId::Extended(0x181);
    let frames = [
        (Frame::new(0x000, &[1, 0]), true),
        (Frame::new(0x080, &[]), true),
        (Frame::new(0x181, &[1, 2]), true),
        (Frame::new(0x185, &[1, 2]), false),
        (Frame::from_parts(CanId::Base(0x701), true, &[]).unwrap(), true),
        (Frame::from_parts(extended, false, &[1, 2]).unwrap(), false),
        (Frame::new(0x702, &[5]), false),
        (Frame::new(0x77F, &[5]), true),
    ];
    frames.iter().for_each(|(frame, _)| sender.send(frame).unwrap());
    sender.report(&BusError::bus_off()).unwrap();
    let heard = std::iter::from_fn(|| bus.receive(ARRIVES).unwrap());
    let ours = frames.iter().filter(|(_, ours)| *ours).map(|(frame, _)| BusEvent::Frame(*frame));
    let expected: Vec<BusEvent> = ours.chain([BusEvent::Error(BusError::bus_off())]).collect();
    assert_eq!(heard.collect::<Vec<_>>(), expected);
}

#[test]
fn frames_that_overflow_the_receive_buffer_are_counted() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let (mut sender, mut sleeper) = (open("vcan1"), open("vcan1"));
    let mut sent = 0;
    while sleeper.dropped().unwrap() < 3 {
        assert!(sent < 100_000, "the socket drops no frame");
        sender.send(&Frame::new(0x80, &[])).unwrap();
        sent += 1;
    }
    let received = std::iter::from_fn(|| sleeper.receive(ARRIVES).unwrap()).count();
    assert_eq!(received, sent - 3);
}

/// The kernel's echo confirms that a frame was sent. An identical frame of another sender is received all the
/// same.
#[test]
fn a_third_cycle_is_refused_until_the_kernel_confirms_the_first_two() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let (mut bench, mut stranger) = (open("vcan1"), open("vcan1"));
    bench.confirm_sending(2).unwrap();
    let (sync, set_point) = (Frame::new(0x80, &[]), Frame::new(0x201, &[0x0F, 0, 1, 0, 0, 0]));
    for _ in 0..2 {
        bench.send(&set_point).unwrap();
        bench.send(&sync).unwrap();
    }
    let refused = bench.send(&set_point).unwrap_err();
    assert!(matches!(refused, CanError::NotConfirmed { frames: 4, .. }), "{refused}");
    stranger.send(&sync).unwrap();
    let heard = next(&mut bench, |event| matches!(event, BusEvent::Frame(_)));
    assert_eq!(heard, BusEvent::Frame(sync), "only the other sender's");
    assert_eq!(bench.receive(Duration::ZERO).unwrap(), None);
    bench.send(&set_point).unwrap();
}

#[test]
fn an_interface_that_is_down_is_reported_at_open_send_and_receive() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let mut bus = open("vcan1");
    ip("link set vcan1 down");
    let in_use = bus.receive(LONG);
    let at_send = bus.send(&Frame::new(0x80, &[]));
    let at_open = SocketCan::open("vcan1");
    ip("link set vcan1 up");
    assert!(matches!(in_use, Err(CanError::Down { .. })), "{in_use:?}");
    assert!(matches!(at_send, Err(CanError::Down { .. })), "{at_send:?}");
    assert!(matches!(at_open, Err(CanError::Down { .. })), "{at_open:?}");
}

#[test]
fn an_interface_that_is_absent_or_not_can_is_refused() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    assert!(matches!(SocketCan::open("lo"), Err(CanError::NotCan { .. })));
    assert!(matches!(SocketCan::open("can99"), Err(CanError::NoInterface { .. })));
}
