//! Tests of the console, with a screen that the records of a run have filled.

mod bell;
mod keys;
mod screen;
mod svg;
mod threads;
mod view;

use super::screen::{Screen, Setup};
use super::view::render;
use super::*;
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::{Frame, NodeId};
use crate::geometry::{FixedAngles, Pose};
use crate::observer::Estimate;
use crate::session::stage_news;
use crate::session::{Approach, Decision, Direction, SampleRecord, State, StepRecord};
use crate::stage::{Axis, Feedback, SetPoint, StageEvent};
use crate::tracker::{GateName, Refusal, Sample};
use nalgebra::Vector3;
use ratatui::backend::TestBackend;

const SIZES: [(u16, u16); 4] = [(80, 24), (120, 40), (40, 12), (1, 1)];

fn setup() -> Setup {
    Setup {
        nodes: [1, 2],
        tip_age_max_s: 0.5,
        noise_sd_mm: 1.0,
        step_mm: 1.0,
        speed_max_mm_per_s: 2.0,
    }
}

fn at(s: f64) -> Time {
    Time::from_nanos((s * 1e9) as i64)
}

/// A screen after 40 mm of an insertion of 100 mm at 2 mm/s.
fn inserted() -> Screen {
    let mut screen = Screen::new(setup());
    screen.take(&Record::State { time: at(0.0), state: State::Inserting });
    for n in 0..2000 {
        let time = at(f64::from(n) * 0.01);
        let mm = f64::from(n) * 0.02;
        let sync = Frame::new(0x80, &[]);
        screen.take(&Record::Can { time, direction: Direction::Sent, frame: sync });
        for id in [0x181, 0x182] {
            let frame = Frame::new(id, &[0x37, 0x16, 0, 0, 0, 0]);
            screen.take(&Record::Can { time, direction: Direction::Received, frame });
        }
        let measured = SetPoint { insertion_mm: mm, rotation_rad: 0.3 };
        let commanded = SetPoint { insertion_mm: mm + 0.02, ..measured };
        screen.take(&Record::Stage(Feedback { time, sync: n as u64, measured, commanded }));
        if n % 4 == 0 {
            let mut sample = SampleRecord::received(Sample {
                receive_time: time,
                ..Sample::valid("N", Vector3::zeros())
            });
            let refusal = Refusal::new(GateName::Innovation, "3.1 mm off the model");
            sample.refused = (n % 400 == 0).then_some(refusal);
            screen.take(&Record::Sample(sample));
        }
        if n % 50 == 0 {
            let angles = FixedAngles { yaw: 0.0, pitch: 0.02, roll: 0.3 };
            let translation = Vector3::new(4.0 * (-mm / 12.0).exp(), 0.001 * mm * mm, mm);
            let x_pb = Pose { rotation: angles.to_rotation(), translation };
            let sd = Some([0.2, 0.2, 0.1, 0.01, 0.01, 0.08]);
            screen.take(&Record::Step(Box::new(StepRecord {
                time,
                insertion_meas_mm: mm,
                innovation_mm: Some(Vector3::new(0.8, -0.8, 0.8)),
                decision: Decision {
                    estimate: Some(Estimate { x_pb, sd, belief: None }),
                    ..Decision::default()
                },
                ..StepRecord::default()
            })));
        }
    }
    screen.event(at(1.0), Lane::Tracker, Severity::Info, "connected to 127.0.0.1:18944");
    screen.event(at(4.2), Lane::Tracker, Severity::Warning, "2 samples late");
    screen.why.clear();
    screen.record_bytes = 1_234_567;
    screen.progress = Progress {
        time: at(20.0),
        state: State::Inserting,
        insertion_meas_mm: 39.98,
        depth_mm: 100.0,
        speed_mm_per_s: 2.0,
        remaining_s: Some(30.0),
        tip_age_s: Some(0.03),
        ..Progress::default()
    };
    screen
}

/// Records a command of the operator.
fn ask(screen: &mut Screen, s: f64, command: OperatorCommand) {
    screen.take(&Record::Input { time: at(s), input: Input::Operator(command) });
}

fn held() -> Screen {
    let mut screen = inserted();
    screen.progress.state = State::HeldByOperator;
    screen.progress.remaining_s = None;
    ask(&mut screen, 20.0, OperatorCommand::Hold);
    screen.take(&Record::State { time: at(20.0), state: State::HeldByOperator });
    screen.event(at(20.0), Lane::Session, Severity::Info, "operator: hold at 39.98 mm");
    screen
}

fn stopped() -> Screen {
    let mut screen = inserted();
    screen.progress.state = State::Stopped;
    let why = "stage: insertion: fault (statusword 0x0208)";
    let emcy = Emcy { code: EmcyCode(0x3210), register: 0x04, manufacturer: [0; 5] };
    let frame = emcy.to_frame(NodeId::new(1).expect("a node"));
    screen.take(&Record::Can { time: at(20.0), direction: Direction::Received, frame });
    let event = StageEvent::Emergency(Axis::Insertion, emcy);
    let (severity, text) = stage_news(&event).expect("news");
    screen.event(at(20.0), Lane::Stage, severity, &text);
    screen.event(at(20.0), Lane::Session, Severity::Fault, why);
    screen.is_over = true;
    screen.withdrawal = Some(Ok("by 40.0 mm".to_owned()));
    screen
}

fn shown(screen: &Screen, (width, height): (u16, u16)) -> String {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a screen");
    terminal.draw(|frame| render(screen, frame)).expect("drawn");
    terminal.backend().to_string()
}
