//! Counts the instructions of a step of each observer and law. Unlike times on a busy machine, the count is the
//! same on every run of the same program.
//!
//! `cargo bench --profile dev --bench instructions`, with valgrind installed. The program runs
//! itself under callgrind with two numbers of insertions; the difference is that of the steps alone.

use nalgebra::Vector3;
use needle_bench::config::Config;
use needle_bench::emulator::WhiteNoise;
use needle_bench::geometry::{FixedAngles, Pose};
use needle_bench::needle::{Increment, TipPosition};
use needle_bench::session::{SessionConfig, Steering};
use std::process::{Command, ExitCode};

/// Steps of an insertion, one increment each, as in a study; a run has 50 increments a step.
const STEPS: u64 = 100;
const KINDS: [(&str, &str); 4] = [
    ("observer", "invariant"),
    ("observer", "coupled"),
    ("observer", "finite-difference"),
    ("control", "feedback-linearization"),
];

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [part, kind, insertions] = &arguments[..] {
        let insertions = insertions.parse().expect("a number");
        let sets = [format!("{part}.kind=\"{kind}\""), "observer.shadows=[]".to_owned()];
        let config = Config::from_sources(&[], &sets).expect("the defaults");
        let session = config.session().expect("valid");
        (0..insertions).for_each(|start| insert(&session, start));
        return ExitCode::SUCCESS;
    }
    for (part, kind) in KINDS {
        let count = |insertions| instructions(part, kind, insertions);
        let (Some(few), Some(many)) = (count(2), count(6)) else {
            println!("no count: is valgrind installed?");
            return ExitCode::SUCCESS;
        };
        println!("step, {kind}: {} instructions", (many - few) / (4 * STEPS));
    }
    ExitCode::SUCCESS
}

/// Counts the instructions of this program while it makes this number of insertions.
fn instructions(part: &str, kind: &str, insertions: u32) -> Option<u64> {
    let program = std::env::current_exe().ok()?;
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(program)
        .args([part, kind, &insertions.to_string()])
        .output()
        .ok()?;
    let stderr = String::from_utf8(output.stderr).ok()?;
    let (_, count) = stderr.split_once("Collected : ")?;
    count.split_whitespace().next()?.parse().ok()
}

/// Runs the steps of one insertion. The true needle takes few of the counted instructions, as many for every kind.
fn insert(session: &SessionConfig, start: u32) {
    let mut steering = Steering::new(session);
    let roll = f64::from(start);
    let mut tip = Pose {
        rotation: FixedAngles { yaw: 0.1, pitch: 0.1, roll }.to_rotation(),
        translation: Vector3::new(5.0, 0.0, 0.0),
    };
    let mut rotation_rad_per_mm = 0.0;
    for mm in 0..STEPS {
        let increment = Increment::new(1.0, rotation_rad_per_mm).expect("finite");
        tip = session.needle.step(&tip, increment);
        steering.predict(increment);
        let noise = WhiteNoise::Uniform(1.0).draw(u64::from(start), mm);
        steering.correct(&TipPosition::new(tip.translation + noise).expect("finite"), 1, 0.025);
        let decision = steering.decide(&[], false);
        rotation_rad_per_mm = decision.rotation_cmd_rad_per_mm.unwrap_or(0.0);
    }
}
