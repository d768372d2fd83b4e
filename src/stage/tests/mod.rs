//! The stage against two drives, in virtual time.

mod bring_up;
mod disobedient;
mod drive;
mod earlier_use;
mod enabling;
mod following_error;
mod found_in_fault;
mod homing;
mod hostile;
mod other_master;
mod quick_stop;
mod set_points;
mod stopping;
mod supervision;

use std::collections::VecDeque;
use std::time::Duration;

use drive::TestDrive;

use super::*;
use crate::canopen::{Frame, NodeId, cob};
use crate::units::Time;

const COUNTS_PER_MM: i32 = 4646;
const COUNTS_PER_TURN: i32 = 75_766;

impl StageConfig {
    /// Two axes with the common choices for everything else: 10 ms SYNC, bench node 127.
    pub(crate) fn new(insertion: AxisConfig, rotation: AxisConfig) -> Self {
        const BENCH: NodeId = NodeId::new(127).unwrap();
        StageConfig {
            hardware: false,
            bus: BusConfig {
                sync_ms: 10,
                bench_node: BENCH,
                heartbeat_ms: 100,
                heartbeat_timeout_ms: 300,
                sdo_timeout_ms: 150,
                sdo_attempts: 3,
                boot_timeout: Duration::from_secs(5),
                boot_attempts: 3,
                missed_feedback_max: 1,
            },
            power: PowerConfig {
                fault_reset_on_start: false,
                enable_timeout: Duration::from_secs(3),
                state_transition_timeout: Duration::from_millis(500),
                stop_timeout: Duration::from_secs(2),
            },
            listen_first: Duration::from_millis(300),
            insertion,
            rotation,
        }
    }
}

impl AxisConfig {
    /// An axis of the drive `node` with the common choices: quick stop on its own ramp, also when the bench falls
    /// silent; zero where the axis stands.
    pub(crate) fn new(node: NodeId, ratio: CountsRatio, limits: AxisLimits) -> Self {
        AxisConfig {
            node,
            vendor_id: None,
            product_code: None,
            serial: None,
            ratio,
            sign: Sign::Positive,
            zero: None,
            reference: Reference::Absolute,
            homing: None,
            wraps: false,
            limits,
            following_error_max: None,
            following_error_timeout_ms: None,
            quick_stop_deceleration: None,
            quick_stop_option: 6,
            fault_reaction_option: 2,
            abort_connection_option: 3,
            communication_error_behaviour: 0,
            optional_objects: Vec::new(),
            sdo: Vec::new(),
            jog_speed: 2.0,
            jog_acceleration: 10.0,
            withdraw_speed: None,
        }
    }
}

fn node(id: u8) -> NodeId {
    NodeId::new(id).expect("in range")
}

fn config() -> StageConfig {
    let axis = |id, counts: i32, limits| {
        let ratio = CountsRatio::new(counts.unsigned_abs(), 1).expect("not zero");
        AxisConfig::new(node(id), ratio, limits)
    };
    let depth = AxisLimits { min: -1.0, max: 150.0, speed_max: 10.0, acceleration_max: None };
    let angle = AxisLimits { min: -700.0, max: 700.0, speed_max: 20.0, acceleration_max: None };
    StageConfig::new(axis(1, COUNTS_PER_MM, depth), axis(2, COUNTS_PER_TURN, angle))
}

/// The same; a drive that is in fault at the start is reset.
fn resetting_config() -> StageConfig {
    let mut config = config();
    config.power.fault_reset_on_start = true;
    config
}

/// The stage, its drives and the bus between them.
struct Bench {
    now: Time,
    stage: Stage,
    insertion: TestDrive,
    rotation: TestDrive,
    /// All frames that the stage has sent.
    sent: Vec<(Time, Frame)>,
    /// SDO answers, and TPDO1, arrive so much later, and these still have to.
    sdo_delay: Duration,
    tpdo_delay: Duration,
    /// A second drive has the node number of the insertion drive. It answers each SDO request as that one does, so
    /// much later.
    twin_later: Option<Duration>,
    delayed: VecDeque<(Time, Frame)>,
    events: Vec<StageEvent>,
    /// Number of events that `run_until` has passed.
    seen: usize,
}

impl Bench {
    fn new(config: StageConfig) -> Self {
        let now = Time::from_secs_f64(1.0);
        let nodes = config.nodes();
        Self::with(Stage::new(config, now), nodes)
    }

    fn with(stage: Stage, nodes: PerAxis<NodeId>) -> Self {
        Bench {
            now: Time::from_secs_f64(1.0),
            insertion: TestDrive::new(nodes.insertion, 1000),
            rotation: TestDrive::new(nodes.rotation, -20),
            stage,
            sent: Vec::new(),
            sdo_delay: Duration::ZERO,
            tpdo_delay: Duration::ZERO,
            twin_later: None,
            delayed: VecDeque::new(),
            events: Vec::new(),
            seen: 0,
        }
    }

    /// A bench whose stage is ready and has the positions of its last SYNC.
    fn ready() -> Self {
        let mut bench = Bench::new(config());
        bench.until_feedback();
        bench
    }

    /// Passes frames on until the stage has no more output at `self.now`.
    fn settle(&mut self) {
        while let Some(output) = self.stage.poll() {
            match output {
                Output::Event(event) => self.events.push(event),
                Output::Transmit(frame) => {
                    self.sent.push((self.now, frame));
                    let mut answers = self.insertion.handle_frame(self.now, &frame);
                    answers.extend(self.rotation.handle_frame(self.now, &frame));
                    for answer in answers {
                        let is_sdo_of = |id: u8| answer.cob_id() == Some(cob::sdo_tx(node(id)));
                        let is_sdo = is_sdo_of(1) || is_sdo_of(2);
                        let twin = self.twin_later.filter(|_| is_sdo_of(1));
                        let is_tpdo_of = |id: u8| answer.cob_id() == Some(cob::tpdo1(node(id)));
                        let own = match answer {
                            _ if is_sdo => self.sdo_delay,
                            _ if is_tpdo_of(1) || is_tpdo_of(2) => self.tpdo_delay,
                            _ => Duration::ZERO,
                        };
                        for delay in
                            [Some(own), twin.map(|later| own + later)].into_iter().flatten()
                        {
                            let due = self.now + delay;
                            if delay.is_zero() {
                                self.stage.handle_frame(self.now, &answer);
                            } else {
                                let at = self.delayed.partition_point(|(other, _)| *other <= due);
                                self.delayed.insert(at, (due, answer));
                            }
                        }
                    }
                }
            }
        }
    }

    fn receive(&mut self, frame: Frame) {
        self.stage.handle_frame(self.now, &frame);
        self.settle();
    }

    fn step(&mut self) {
        self.settle();
        let delayed = self.delayed.front().map_or(Time::NEVER, |(due, _)| *due);
        let deadlines =
            [self.stage.deadline(), self.insertion.deadline(), self.rotation.deadline(), delayed];
        self.now = self.now.max(deadlines.into_iter().min().expect("four"));
        while let Some((_, answer)) = self.delayed.pop_front_if(|(due, _)| *due <= self.now) {
            self.stage.handle_frame(self.now, &answer);
        }
        for heartbeat in
            [self.insertion.handle_timeout(self.now), self.rotation.handle_timeout(self.now)]
                .concat()
        {
            self.stage.handle_frame(self.now, &heartbeat);
        }
        self.stage.handle_timeout(self.now);
        self.settle();
    }

    fn run_for(&mut self, duration: Duration) {
        let end = self.now + duration;
        while self.now < end {
            self.step();
        }
    }

    /// Runs to the first event that `passes` after the event that was waited for last.
    fn run_until(&mut self, mut passes: impl FnMut(&StageEvent) -> bool) -> StageEvent {
        for _ in 0..20_000 {
            if let Some(at) = self.events[self.seen..].iter().position(&mut passes) {
                self.seen += at + 1;
                return self.events[self.seen - 1].clone();
            }
            self.step();
        }
        panic!("this event never came; events since: {:?}", &self.events[self.seen..]);
    }

    fn until_ready(&mut self) {
        self.run_until(|event| *event == StageEvent::Ready);
    }

    fn until_progress(&mut self, progress: StageProgress) {
        self.run_until(|event| *event == StageEvent::Progress(progress));
    }

    fn until_fault(&mut self) -> String {
        match self.run_until(|event| matches!(event, StageEvent::Fault(_))) {
            StageEvent::Fault(fault) => fault,
            _ => unreachable!(),
        }
    }

    fn until_feedback(&mut self) -> Feedback {
        match self.run_until(|event| matches!(event, StageEvent::Feedback(_))) {
            StageEvent::Feedback(feedback) => feedback,
            _ => unreachable!(),
        }
    }

    fn until_stopped(&mut self) -> bool {
        match self.run_until(|event| matches!(event, StageEvent::Stopped { .. })) {
            StageEvent::Stopped { standing, .. } => standing,
            _ => unreachable!(),
        }
    }

    /// The first fault so far.
    fn fault(&self) -> Option<&str> {
        self.events.iter().find_map(|event| match event {
            StageEvent::Fault(fault) => Some(&**fault),
            _ => None,
        })
    }

    /// Whether a frame was sent that begins with `start`, as candump prints it.
    fn has_sent(&self, start: &str) -> bool {
        self.sent.iter().any(|(_, frame)| frame.to_string().starts_with(start))
    }

    fn command(&mut self, insertion_mm: f64, rotation_rad: f64) -> Result<(), String> {
        self.stage.command(SetPoint { insertion_mm, rotation_rad })
    }

    /// Sends `steps` set-points of 1 mm/s and 1 rad/s; returns the feedback while the axes move to the last one.
    fn drive_on(&mut self, steps: usize) -> Feedback {
        let mut feedback = self.until_feedback();
        for step in 1..=steps {
            let way = step as f64 * 0.01;
            self.command(way, way).expect("within limits");
            feedback = self.until_feedback();
        }
        feedback
    }
}
