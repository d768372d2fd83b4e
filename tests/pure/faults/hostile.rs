//! Any input at any time: no panic, no target outside a limit, and every run ends.

use crate::support::bench::{Bench, configured};
use nalgebra::Vector3;
use needle_bench::canopen::{CanId, Frame};
use needle_bench::session::Input;
use needle_bench::tracker::{Event, Sample, Validity};
use needle_bench::units::Time;
use proptest::prelude::*;
use std::time::Duration;

/// Counts per mm and per turn in the default configuration.
const PER_MM: f64 = 4646.0;
const PER_TURN: f64 = 378_830.0 / 5.0;

#[derive(Debug, Clone)]
enum Attack {
    Frame(CanId, bool, Vec<u8>),
    Tpdo { first: bool, statusword: u16, counts: i32 },
    Sample { tool: bool, at_mm: [f64; 3], stamp_ns: Option<i64>, validity: Validity },
    Link(Event),
    BusWarning,
}

fn attack() -> impl Strategy<Value = Attack> {
    let known = prop::sample::select(vec![
        0x000, 0x080, 0x081, 0x082, 0x181, 0x182, 0x201, 0x202, 0x581, 0x582, 0x601, 0x602, 0x701,
        0x702, 0x77f,
    ]);
    let bytes = || prop::collection::vec(any::<u8>(), 0..=8);
    let coordinate = prop_oneof![
        4 => -20.0..20.0_f64,
        1 => any::<f64>(),
        1 => prop::sample::select(vec![0.0, f64::NAN, f64::INFINITY, 1e300, -1e155]),
    ];
    let stamp_ns = prop_oneof![
        Just(None),
        any::<i64>().prop_map(Some),
        (0..20_000_000_000_i64).prop_map(Some),
    ];
    let validity = prop::sample::select(vec![Validity::Valid, Validity::Missing]);
    let statusword = prop::sample::select(vec![0x0237, 0x0233, 0x0208, 0x2237, 0x1237]);
    let link = prop_oneof![
        Just(Event::Connected { peer: "peer".to_owned() }),
        Just(Event::Disconnected { reason: "gone".to_owned() }),
    ];
    prop_oneof![
        2 => (known, bytes()).prop_map(|(id, data)| Attack::Frame(CanId::Base(id), false, data)),
        1 => (0..0x800_u16, any::<bool>(), bytes())
            .prop_map(|(id, remote, data)| Attack::Frame(CanId::Base(id), remote, data)),
        1 => (0..0x2000_0000_u32, bytes())
            .prop_map(|(id, data)| Attack::Frame(CanId::Extended(id), false, data)),
        2 => (any::<bool>(), statusword, prop_oneof![-100..5000_i32, any::<i32>()])
            .prop_map(|(first, statusword, counts)| Attack::Tpdo { first, statusword, counts }),
        8 => (any::<bool>(), prop::array::uniform3(coordinate), stamp_ns, validity).prop_map(
            |(tool, at_mm, stamp_ns, validity)| Attack::Sample { tool, at_mm, stamp_ns, validity }
        ),
        1 => link.prop_map(Attack::Link),
        1 => Just(Attack::BusWarning),
    ]
}

fn apply(bench: &mut Bench, attack: Attack) {
    match attack {
        Attack::Frame(id, remote, data) => {
            bench.inject(Frame::from_parts(id, remote, &data).expect("in range"));
        }
        Attack::Tpdo { first, statusword, counts } => {
            let ([s0, s1], [p0, p1, p2, p3]) = (statusword.to_le_bytes(), counts.to_le_bytes());
            let cob_id = if first { 0x181 } else { 0x182 };
            bench.inject(Frame::new(cob_id, &[s0, s1, p0, p1, p2, p3]));
        }
        Attack::Sample { tool, at_mm, stamp_ns, validity } => {
            let sample = Sample {
                tool: if tool { "NeedleToTracker" } else { "Other" }.to_owned(),
                receive_time: bench.now,
                source_unix_ns: stamp_ns,
                position_mm: Vector3::from(at_mm),
                orientation: None,
                validity,
            };
            bench.hand(Input::Tracker(Event::Sample(sample)));
        }
        Attack::Link(event) => bench.hand(Input::Tracker(event)),
        Attack::BusWarning => bench.hand(Input::BusWarning("error passive".to_owned())),
    }
}

/// The targets sent to a drive with Enable Operation set, in counts from the first.
fn targets(bench: &Bench, cob_id: u16) -> Vec<i64> {
    let target = |frame: &Frame| match frame.data() {
        [control, 0, target @ ..] if frame.cob_id() == Some(cob_id) && control & 0x08 != 0 => {
            Some(i64::from(i32::from_le_bytes(target.try_into().ok()?)))
        }
        _ => None,
    };
    let counts: Vec<i64> = bench.sent.iter().filter_map(target).collect();
    counts.iter().map(|target| target - counts[0]).collect()
}

/// All `targets` are within `min` to `max` counts, and none is further than `step` from the one before.
fn within(targets: &[i64], [min, max]: [f64; 2], step: f64) -> Result<(), TestCaseError> {
    for &target in targets {
        prop_assert!((min.round()..=max.round()).contains(&(target as f64)), "{target} counts");
    }
    for pair in targets.windows(2) {
        prop_assert!(
            pair[0].abs_diff(pair[1]) as f64 <= step + 1.0,
            "from {} to {}",
            pair[0],
            pair[1]
        );
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_input_leads_out_of_the_limits_and_every_run_ends(
        stamp in prop::sample::select(vec!["receive", "source", "auto"]),
        mode in prop::sample::select(vec!["continuous", "stepwise"]),
        turn_max_deg in prop::sample::select(vec![25.0, 200.0]),
        attacks in prop::collection::vec((0..400_u64, attack()), 0..30),
    ) {
        let sets = [
            &format!("tracker.stamp=\"{stamp}\""),
            &format!("insertion.mode=\"{mode}\""),
            "insertion.depth_mm=10",
            "stage.insertion.max_mm=10.2",
            &format!("stage.rotation.min_deg=-{turn_max_deg}"),
            &format!("stage.rotation.max_deg={turn_max_deg}"),
        ];
        let mut bench = Bench::new(configured(&sets));
        for (wait_ms, attack) in attacks {
            bench.run_for(Duration::from_millis(wait_ms));
            apply(&mut bench, attack);
        }
        bench.run_to_end();
        prop_assert!(bench.now < Time::from_secs_f64(60.0), "{}", bench.now);
        within(&targets(&bench, 0x201), [-PER_MM, 10.2 * PER_MM], 0.1 * PER_MM)?;
        let range = turn_max_deg / 360.0 * PER_TURN;
        within(&targets(&bench, 0x202), [-range, range], 0.01 * PER_TURN)?;
    }
}
