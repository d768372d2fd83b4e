//! `needle-bench stage` as its user meets it, on the virtual stage; and the dialogues with drives
//! that a run is moving.

use crate::support::program::{Said, Scratch, needle_bench, refusals};
use needle_bench::canopen::cia402::{DriveState, Mode};
use needle_bench::canopen::emcy::EmcyCode;
use needle_bench::canopen::{Frame, NodeId};
use needle_bench::config::Config;
use needle_bench::emulator::fault::FaultKind;
use needle_bench::emulator::{StageOutput, VirtualStage};
use needle_bench::runtime::talk_virtual;
use needle_bench::stage::{
    Axis, Dialogue, Halt, Output, Reset, SetPoint, Stage, StageConfig, StageEvent, StatusReader,
};
use needle_bench::units::Time;

fn stage(scratch: &Scratch, arguments: &[&str]) -> Said {
    needle_bench(scratch, &[&["stage", "--virtual"], arguments].concat())
}

#[test]
fn status_says_who_and_where_and_moves_nothing() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["status", "--set", "emulator.insertion_start_mm=12.5"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert!(lines[0].starts_with("insertion   node 1, vendor 0x000002F1"), "{}", said.stdout);
    assert!(lines[0].ends_with("at 12.500 mm (58075 counts)"), "{}", said.stdout);
    assert!(lines[1].ends_with("at 0.000 deg (0 counts)"), "{}", said.stdout);
    assert!(!scratch.path().join("runs").exists(), "nothing happened, nothing is recorded");

    let json = stage(&scratch, &["status", "--json"]).json();
    assert_eq!(json["insertion"]["state"], "switch on disabled");
    assert_eq!(json["insertion"]["position_mm"], 0.0);
    assert_eq!(json["rotation"]["position_deg"], 0.0, "from the drive's own zero");
    assert_eq!(json["rotation"]["node"], 2);
}

#[test]
fn a_jog_leaves_a_record_and_says_where_it_went() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["jog", "--axis", "insertion", "--by", "2mm", "--quiet"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert_eq!(lines[0], "insertion   from 0.000 to 2.000 mm");
    assert_eq!(lines.last(), Some(&"completed"));

    let said = stage(&scratch, &["jog", "--axis", "rotation", "--by", "-10deg", "--json", "-q"]);
    let json = said.json();
    assert_eq!((said.status, json["outcome"].as_str()), (0, Some("completed")));
    let moved = json["axes"][0]["to_deg"].as_f64().unwrap();
    assert!((moved + 10.0).abs() < 0.01, "{json}");
    let dir = scratch.path().join(json["run_dir"].as_str().unwrap());
    // The second of two within a second has a number behind its name.
    let name = dir.to_string_lossy();
    assert!(name.trim_end_matches("-2").ends_with("-virtual-jog"), "{name}");
    let manifest = std::fs::read_to_string(dir.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["outcome"], "completed");
    assert_eq!(manifest["drives"].as_array().map(Vec::len), Some(2));
    let log = std::fs::read_to_string(dir.join("can.log")).unwrap();
    assert!(log.contains(" 080# "), "every frame is in the record");
}

#[test]
fn a_jog_goes_to_a_position_at_a_speed() {
    let scratch = Scratch::new();
    let start = ["--set", "emulator.insertion_start_mm=5"];
    let jog = ["jog", "--axis", "insertion", "-q"];
    let said = stage(
        &scratch,
        &[&jog[..], &["--to", "2.5mm", "--speed", "0.5mm/s", "--json"], &start].concat(),
    );
    let json = said.json();
    assert_eq!((said.status, &json["axes"][0]["from_mm"]), (0, &5.0.into()), "{}", said.stderr);
    assert!((json["axes"][0]["to_mm"].as_f64().unwrap() - 2.5).abs() < 0.01, "{json}");
    // 2.5 mm at 0.5 mm/s, bring-up and stop included.
    let duration_s = json["duration_s"].as_f64().unwrap();
    assert!((5.0..6.5).contains(&duration_s), "{json}");
    let replayed = needle_bench(&scratch, &["replay", json["run_dir"].as_str().unwrap()]);
    assert_eq!(replayed.stdout.lines().last(), Some("identical"), "{}", replayed.screen());
    let turn = ["jog", "--axis", "rotation", "--to", "10deg"];
    let commands: &[&[&str]] = &[
        &[&jog[..], &["--to", "2mm", "--by", "2mm"]].concat(),
        &jog,
        &[&jog[..], &["--to", "2deg"]].concat(),
        &[&jog[..], &["--by", "2mm", "--speed", "11mm/s"]].concat(),
        &[&jog[..], &["--by", "2mm", "--speed", "2mm"]].concat(),
        &[&jog[..], &["--by", "2mm", "--speed", "-1mm/s"]].concat(),
        &turn,
    ];
    let commands: Vec<Vec<&str>> =
        commands.iter().map(|command| [&["stage", "--virtual"], *command].concat()).collect();
    let commands: Vec<&[&str]> = commands.iter().map(Vec::as_slice).collect();
    insta::assert_snapshot!(refusals(&scratch, &commands));
}

/// A fault and its history are cleared, and nothing has power.
#[test]
fn a_reset_clears_a_fault_whose_cause_is_gone() {
    let config = Config::from_sources(&[], &[]).unwrap();
    let stage_config = config.stage.to_stage(&config.can).unwrap();
    let mut stage = VirtualStage::new(config.virtual_stage().unwrap(), Time::ZERO);
    stage.change_drive(0, Time::ZERO, FaultKind::Drive(EmcyCode(0x4210)), true);
    stage.handle_timeout(Time::from_secs_f64(0.01));
    let status = |stage: &mut VirtualStage| {
        let mut reader = StatusReader::new(&stage_config, Time::ZERO);
        talk_virtual(&mut reader, stage);
        Axis::BOTH.map(|axis| reader.status(axis).unwrap())
    };
    let [before, _] = status(&mut stage);
    assert_eq!(before.statusword.state(), Some(DriveState::Fault));
    assert_eq!(before.error_history, [EmcyCode(0x4210)]);
    let mut reset = Reset::new(&stage_config, Time::ZERO);
    talk_virtual(&mut reset, &mut stage);
    for (axis, after) in Axis::BOTH.into_iter().zip(status(&mut stage)) {
        assert_eq!(reset.result(axis).map(|word| word.state()), Ok(after.statusword.state()));
        assert_eq!(after.statusword.state(), Some(DriveState::SwitchOnDisabled));
        assert_eq!((after.error_history.len(), after.error_code), (0, None));
    }
    // An open safety input takes the torque: the drive stays in fault.
    stage.change_drive(1, Time::ZERO, FaultKind::Drive(EmcyCode(0x4210)), true);
    stage.change_drive(1, Time::ZERO, FaultKind::Interlock, true);
    stage.handle_timeout(Time::from_secs_f64(20.0));
    let mut reset = Reset::new(&stage_config, Time::ZERO);
    talk_virtual(&mut reset, &mut stage);
    assert!(reset.result(Axis::Insertion).is_ok());
    let why = reset.result(Axis::Rotation).unwrap_err();
    assert!(why.starts_with("rotation: node 2 stays in fault, error 0x4210"), "{why}");
    let scratch = Scratch::new();
    let said = self::stage(&scratch, &["reset"]);
    assert_eq!((said.status, said.stdout.lines().count()), (0, 2), "{}", said.screen());
}

#[test]
fn limits_refuse_with_the_number() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["jog", "--axis", "insertion", "--by", "311mm", "-q"]);
    assert_eq!(said.status, 1);
    assert_eq!(
        said.stdout.lines().last(),
        Some("stopped: stage: insertion: 311.000 mm is over the limit of 310.000 mm")
    );
    let said = stage(&scratch, &["jog", "--axis", "insertion", "--by", "-1.5mm", "-q"]);
    assert_eq!(
        said.stdout.lines().last(),
        Some("stopped: stage: insertion: -1.500 mm is under the limit of -1.000 mm")
    );
    let fast = ["jog", "--axis", "insertion", "--by", "1mm", "--set"];
    let said = stage(&scratch, &[&fast[..], &["stage.insertion.jog_speed_mm_per_s=11"]].concat());
    assert_eq!(said.status, 2);
    assert!(
        said.stderr
            .contains("is 11, allowed: up to stage.insertion.speed_max_mm_per_s, which is 10"),
        "{}",
        said.stderr
    );
}

#[test]
fn what_cannot_be_meant_is_bad_usage() {
    let scratch = Scratch::new();
    let operations: &[&[&str]] = &[
        &["jog", "--axis", "insertion", "--by", "2"],
        &["jog", "--axis", "insertion", "--by", "2deg"],
        &["jog", "--axis", "rotation", "--by", "2mm"],
        &["jog", "--axis", "insertion", "--by", "1e300mm"],
        &["jog", "--axis", "insertion", "--by", "0.00001mm"],
        &["withdraw", "--by", "-2mm"],
        &["withdraw", "--by=-2mm"],
        &["withdraw", "--set", "stage.insertion.zero=start"],
        &["home", "--axis", "insertion", "--set", "can.interface=can0"],
        &["prove", "--realtime"],
        &["--realtime", "--cpu", "0", "stop"],
        &["up"],
        &["status", "--set", "can.interface=udp", "--set", "tracker.source=openigtlink"],
        &["stop"],
    ];
    let commands: Vec<Vec<&str>> =
        operations.iter().map(|operation| [&["stage", "--virtual"], *operation].concat()).collect();
    let commands: Vec<&[&str]> = commands.iter().map(Vec::as_slice).collect();
    insta::assert_snapshot!(refusals(&scratch, &commands));
    assert!(!scratch.path().join("runs").exists(), "refused before a folder is made");
}

/// A limit set before the operation holds, whatever is set after it.
#[test]
fn settings_add_up_wherever_they_stand() {
    let scratch = Scratch::new();
    let [limit, jog] = [["--set", "stage.insertion.max_mm=5"], ["--axis", "insertion"]];
    let other = ["--set", "name=x", "--set", "insertion.depth_mm=4"];
    let by = ["--by", "6mm", "-q"];
    let before = [&limit[..], &["jog"], &jog, &by, &other].concat();
    let after = [&other[..], &["jog"], &jog, &by, &limit].concat();
    for arguments in [before, after] {
        let said = stage(&scratch, &arguments);
        assert_eq!(said.status, 1, "{}{}", said.stdout, said.stderr);
        assert!(
            said.stdout.ends_with("6.000 mm is over the limit of 5.000 mm\n"),
            "{}",
            said.stdout
        );
        assert!(said.stdout.contains("-x-jog"), "{}", said.stdout);
    }
    // The last of two counts.
    let twice =
        [&["--set", "name=a", "jog"][..], &jog, &["--by", "1mm", "--set", "name=b"]].concat();
    assert!(stage(&scratch, &twice).stdout.contains("-b-jog"));
}

#[test]
fn two_configurations_are_refused() {
    let scratch = Scratch::new();
    for name in ["a.toml", "b.toml"] {
        scratch.write(name, "");
    }
    let twice = ["status", "stop", "home"]
        .map(|operation| ["stage", "--config", "a.toml", operation, "--config", "b.toml"]);
    insta::assert_snapshot!(refusals(&scratch, &twice.each_ref().map(|command| &command[..])));
}

#[test]
fn withdraw_comes_back_to_where_the_axis_reads_zero() {
    let scratch = Scratch::new();
    let deep = ["--set", "emulator.insertion_start_mm=30"];
    let said = stage(&scratch, &[&["withdraw", "-q"][..], &deep].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_eq!(said.stdout.lines().next(), Some("insertion   from 30.000 to 0.000 mm"));
    let said = stage(&scratch, &[&["withdraw", "--by", "5mm", "-q"][..], &deep].concat());
    assert_eq!(said.stdout.lines().next(), Some("insertion   from 30.000 to 25.000 mm"));
}

#[test]
fn home_finds_home_and_a_run_asks_for_it() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["home", "-q", "--set", "emulator.insertion_start_mm=5"]);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert_eq!(lines[..2], ["insertion   home, at 0.000 mm", "rotation    home, at 0.000 deg"]);

    let needs = "stage.insertion.reference=homing";
    for arguments in [
        &["run", "-q", "--set", needs][..],
        &["stage", "--virtual", "jog", "--axis", "insertion", "--by", "1mm", "-q", "--set", needs],
        &["stage", "--virtual", "withdraw", "-q", "--set", needs],
    ] {
        let said = needle_bench(&scratch, arguments);
        assert_eq!(said.status, 1, "{arguments:?}");
        let last = said.stdout.lines().last().unwrap();
        assert!(last.starts_with("stopped: stage: node 1 (insertion): not homed"), "{last}");
        assert!(last.ends_with("home it first: needle-bench stage home"), "{last}");
    }
}

#[test]
fn prove_shows_that_the_drives_miss_the_bench() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["prove"]);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    for axis in ["insertion", "rotation"] {
        let noticed = format!("{axis}: noticed the bench's silence after ");
        assert!(said.stderr.contains(&noticed), "{}", said.stderr);
    }
    let last = said.stdout.lines().last().unwrap();
    assert!(
        last.starts_with("proved: both drives notice a silent bench and stand: insertion after "),
        "{last}"
    );
    let reviewed = needle_bench(&scratch, &["review"]);
    assert!(reviewed.stdout.lines().any(|line| line == last), "{}", reviewed.screen());
}

/// An operator who forgot `--config` must not take the emulated stage for the rig.
#[test]
fn nothing_is_done_to_a_stage_that_nobody_named() {
    let scratch = Scratch::new();
    scratch.write("memory.toml", "can.interface = \"memory\"\n");
    let mut screens = String::new();
    for operation in [
        &["status"][..],
        &["home"],
        &["jog", "--axis", "insertion", "--by", "1mm"],
        &["withdraw"],
        &["prove"],
    ] {
        for named in [&[][..], &["--config", "memory.toml"], &["--set", "can.interface=memory"]] {
            screens += &refusals(&scratch, &[&[&["stage"], operation, named].concat()]);
        }
    }
    // The virtual stage's nodes are not those of a rig.
    screens += &refusals(&scratch, &[&["stage", "status", "--set", "can.interface=can0"]]);
    insta::assert_snapshot!(screens);
    assert!(!scratch.path().join("runs").exists());
}

#[test]
fn a_stop_of_nothing_is_refused() {
    let scratch = Scratch::new();
    let commands: &[&[&str]] = &[
        &["stop"],
        &["stage", "stop"],
        &["stop", "--json", "--set", "can.interface=memory"],
        &["stop", "--json", "--set", "can.interface=can0"],
        &["stop", "--json", "--config", "absent.toml"],
    ];
    insta::assert_snapshot!(refusals(&scratch, commands));
}

/// The interface and the nodes are enough to try.
#[test]
fn a_stop_that_cannot_be_sent_says_so() {
    let scratch = Scratch::new();
    let absent = ["--set", "can.interface=nocan9", "--config", "absent.toml"];
    let nodes = ["--set", "stage.insertion.node=5", "--set", "stage.rotation.node=6"];
    let said = needle_bench(&scratch, &[&["stop"][..], &absent, &nodes].concat());
    assert_eq!((said.status, said.stdout.as_str()), (3, ""), "{}", said.stderr);
    assert!(said.stderr.starts_with("error: nothing was stopped: "), "{}", said.stderr);
    assert!(said.stderr.contains("nocan9"), "{}", said.stderr);
    assert!(said.stderr.ends_with("; use the emergency stop\n"), "{}", said.stderr);
}

/// At the bound that the configuration is held to.
#[test]
fn moves_keep_to_the_acceleration_of_their_axis() {
    let scratch = Scratch::new();
    let sets = [
        "stage.insertion.acceleration_max_mm_per_s2=40",
        "stage.insertion.jog_acceleration_mm_per_s2=35.5555",
        "stage.insertion.withdraw_speed_mm_per_s=5",
        "stage.rotation.acceleration_max_deg_per_s2=24000",
        "stage.rotation.jog_acceleration_deg_per_s2=21333",
        "stage.rotation.jog_speed_deg_per_s=360",
        "emulator.insertion_start_mm=30",
    ];
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
    for operation in [
        &["jog", "--axis", "insertion", "--by", "0.017mm"][..],
        &["jog", "--axis", "insertion", "--by", "-3.3mm"],
        &["jog", "--axis", "rotation", "--by", "100deg"],
        &["jog", "--axis", "rotation", "--by", "-0.7deg"],
        &["withdraw"],
        &["withdraw", "--by", "0.123mm"],
    ] {
        let said = stage(&scratch, &[operation, &["-q"], &sets].concat());
        assert_eq!((said.status, said.stderr.as_str()), (0, ""), "{operation:?}: {}", said.stdout);
    }
}

/// No other program.
struct Nobody;

impl Dialogue for Nobody {
    fn handle_frame(&mut self, _: Time, _: &Frame) {}
    fn handle_timeout(&mut self, _: Time) {}
    fn poll_transmit(&mut self) -> Option<Frame> {
        None
    }
    fn deadline(&self) -> Time {
        Time::NEVER
    }
    fn is_over(&self) -> bool {
        true
    }
}

/// A stage that is moved by a run's own master, while another program talks to its drives.
struct Bench {
    now: Time,
    config: StageConfig,
    master: Stage,
    stage: VirtualStage,
    step: u32,
    events: Vec<StageEvent>,
    /// What the other program has sent.
    sent: Vec<Frame>,
}

impl Bench {
    /// The insertion moves at 2 mm/s.
    fn moving() -> Self {
        let config = Config::from_sources(&[], &[]).unwrap();
        let now = Time::ZERO;
        let stage = config.stage.to_stage(&config.can).unwrap();
        let mut bench = Bench {
            now,
            master: Stage::new(stage.clone(), now).unwrap(),
            config: stage,
            stage: VirtualStage::new(config.virtual_stage().unwrap(), now),
            step: 0,
            events: Vec::new(),
            sent: Vec::new(),
        };
        while bench.step < 100 {
            bench.go_on_alone(1);
        }
        bench
    }

    fn settle(&mut self, other: &mut dyn Dialogue) {
        loop {
            let mut frames = Vec::new();
            while let Some(output) = self.master.poll() {
                match output {
                    Output::Transmit(frame) => frames.push(frame),
                    Output::Event(StageEvent::Feedback(_)) => {
                        self.step += 1;
                        let way = f64::from(self.step) * 0.02;
                        let set_point = SetPoint { insertion_mm: way, rotation_rad: 0.0 };
                        // Refused once it stops.
                        let _ = self.master.command(set_point);
                    }
                    Output::Event(event) => self.events.push(event),
                }
            }
            let said: Vec<Frame> = std::iter::from_fn(|| other.poll_transmit()).collect();
            self.sent.extend(&said);
            frames.extend(said);
            frames.iter().for_each(|frame| self.stage.handle_frame(self.now, frame));
            let answers: Vec<Frame> = std::iter::from_fn(|| self.stage.poll())
                .filter_map(|output| match output {
                    StageOutput::Frame(frame) => Some(frame),
                    _ => None,
                })
                .collect();
            for frame in &answers {
                self.master.handle_frame(self.now, frame);
                other.handle_frame(self.now, frame);
            }
            if frames.is_empty() && answers.is_empty() {
                return;
            }
        }
    }

    fn go_on(&mut self, other: &mut dyn Dialogue) {
        self.settle(other);
        let due = self.master.deadline().min(self.stage.deadline()).min(other.deadline());
        self.now = self.now.max(due);
        self.stage.handle_timeout(self.now);
        self.master.handle_timeout(self.now);
        other.handle_timeout(self.now);
        self.settle(other);
    }

    fn go_on_alone(&mut self, turns: u32) {
        (0..turns).for_each(|_| self.go_on(&mut Nobody));
    }

    fn talk(&mut self, other: &mut dyn Dialogue) {
        let mut turns = 0;
        while !other.is_over() {
            self.go_on(other);
            turns += 1;
            assert!(turns < 10_000, "it does not end");
        }
    }

    fn depth_mm(&self) -> f64 {
        self.stage.position_true(self.now).0
    }

    fn states(&self) -> [DriveState; 2] {
        self.stage.drives().map(|drive| drive.state())
    }
}

/// The other master's set-points, which go on for as long as it does not notice, do not take the
/// stop back.
#[test]
fn a_stop_from_outside_ends_a_run_that_is_moving() {
    let mut bench = Bench::moving();
    let at_mm = bench.depth_mm();
    let mut halt = Halt::new(&bench.config, bench.now);
    assert_eq!(halt.result(Axis::Insertion), None);
    bench.talk(&mut halt);
    assert!((bench.depth_mm() - at_mm).abs() < 0.2, "{} mm", bench.depth_mm() - at_mm);
    assert!(halt.result(Axis::Insertion).unwrap().is_ok());
    assert!(halt.result(Axis::Rotation).unwrap().is_ok());
    let first: Vec<String> = bench.sent.iter().take(4).map(Frame::to_string).collect();
    let quick_stop = ["601#2B40600002000000", "602#2B40600002000000"];
    assert_eq!(first[..2], ["000#8001", "000#8002"]);
    assert_eq!(first[2..], quick_stop, "both at once");
    let faults = bench.events.iter().filter(|event| matches!(event, StageEvent::Fault(_)));
    assert_eq!(faults.count(), 1, "the run ends by its own fault");
    let at_mm = bench.depth_mm();
    bench.go_on_alone(500);
    assert_eq!(bench.depth_mm(), at_mm, "and nothing moves any more");
    assert!(!bench.states().contains(&DriveState::OperationEnabled));
}

#[test]
fn a_drive_that_does_not_answer_a_stop_is_named_and_the_other_is_stopped() {
    let mut bench = Bench::moving();
    let mut config = bench.config.clone();
    config.rotation.node = NodeId::new(9).unwrap();
    let mut halt = Halt::new(&config, bench.now);
    bench.talk(&mut halt);
    assert!(halt.result(Axis::Insertion).unwrap().is_ok());
    assert_eq!(
        halt.result(Axis::Rotation).unwrap().unwrap_err(),
        "rotation: node 9 0x6040:00: no SDO reply within 150 ms (attempt 3 of 3), is the drive \
         powered, node-id and bitrate right?; power off was not confirmed"
    );
}

/// A stop that hears nothing of the rotation drive, which does not get the first frames either.
struct Deaf {
    halt: Halt,
    lost: u32,
}

impl Dialogue for Deaf {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if frame.cob_id() != Some(0x582) {
            self.halt.handle_frame(now, frame);
        }
    }
    fn handle_timeout(&mut self, now: Time) {
        self.halt.handle_timeout(now);
    }
    fn poll_transmit(&mut self) -> Option<Frame> {
        while let Some(frame) = self.halt.poll_transmit() {
            match frame.cob_id() {
                Some(0x602) if self.lost > 0 => self.lost -= 1,
                _ => return Some(frame),
            }
        }
        None
    }
    fn deadline(&self) -> Time {
        self.halt.deadline()
    }
    fn is_over(&self) -> bool {
        self.halt.is_over()
    }
}

/// Whether a drive answers or not, it is told to brake and then to take its power off.
#[test]
fn a_drive_that_is_not_heard_is_stopped_all_the_same() {
    for lost in [0, 1, 5] {
        let mut bench = Bench::moving();
        let mut stop = Deaf { halt: Halt::new(&bench.config, bench.now), lost };
        bench.talk(&mut stop);
        assert_eq!(bench.states(), [DriveState::SwitchOnDisabled; 2], "{lost} lost");
        let said = stop.halt.result(Axis::Rotation).unwrap().unwrap_err();
        assert!(said.ends_with("; power off was not confirmed"), "{said}");
        let told = |word: &str| {
            let frame = format!("602#2B406000{word}000000");
            bench.sent.iter().filter(|sent| sent.to_string() == frame).count()
        };
        assert!(told("02") >= 2 && told("00") >= 1, "{} and {}", told("02"), told("00"));
    }
}

/// A stop whose looks at the rotation drive's statusword are lost.
struct Blind(Halt);

impl Dialogue for Blind {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        // The run that is being stopped asks the same, and hears the answer.
        if !frame.to_string().starts_with("582#4B4160") {
            self.0.handle_frame(now, frame);
        }
    }
    fn handle_timeout(&mut self, now: Time) {
        self.0.handle_timeout(now);
    }
    fn poll_transmit(&mut self) -> Option<Frame> {
        let look = Frame::new(0x602, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]);
        std::iter::from_fn(|| self.0.poll_transmit()).find(|frame| *frame != look)
    }
    fn deadline(&self) -> Time {
        self.0.deadline()
    }
    fn is_over(&self) -> bool {
        self.0.is_over()
    }
}

/// That nobody can say whether it stands is no reason to leave it under power.
#[test]
fn a_stop_that_sees_nothing_takes_power_off_and_says_what_it_did_not_see() {
    let mut bench = Bench::moving();
    let mut halt = Blind(Halt::new(&bench.config, bench.now));
    bench.talk(&mut halt);
    let said = halt.0.result(Axis::Rotation).unwrap().unwrap_err();
    assert!(said.starts_with("rotation: node 2 0x6041:00: no SDO reply within 150 ms"), "{said}");
    assert!(said.ends_with(": power off was not seen, press the emergency stop"), "{said}");
    assert!(halt.0.result(Axis::Insertion).unwrap().is_ok());
    assert_eq!(bench.states(), [DriveState::SwitchOnDisabled; 2]);
    let last: Vec<String> = bench.sent.iter().rev().take(1).map(Frame::to_string).collect();
    assert_eq!(last, ["000#8002"], "the node is told once more to leave Operational");
}

#[test]
fn status_of_drives_that_are_moving_disturbs_nothing() {
    let mut bench = Bench::moving();
    let mut reader = StatusReader::new(&bench.config, bench.now);
    bench.talk(&mut reader);
    let status = reader.status(Axis::Insertion).unwrap();
    assert_eq!(status.statusword.state(), Some(DriveState::OperationEnabled));
    assert_eq!(status.mode, Some(Mode::CSP));
    assert!(status.position.is_some_and(|mm| (1.5..2.5).contains(&mm)), "{status:?}");
    assert_eq!(status.homed, None, "it cannot say so in this mode");
    assert!(bench.sent.iter().all(|frame| frame.data()[0] == 0x40), "it only reads");
    bench.go_on_alone(200);
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));
}
