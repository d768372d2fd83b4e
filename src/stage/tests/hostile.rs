//! No input makes the stage send a target beyond a limit.

use proptest::prelude::*;

use super::*;
use crate::canopen::CanId;

/// Limits so narrow that random commands reach them.
fn narrow() -> StageConfig {
    let mut config = config();
    (config.insertion.limits.min, config.insertion.limits.max) = (-0.2, 0.3);
    (config.rotation.limits.min, config.rotation.limits.max) = (-0.4, 0.5);
    config
}

#[derive(Debug, Clone)]
enum Attack {
    Frame(u16, Vec<u8>),
    Statusword(bool, u16, i32),
    Command(f64, f64),
    Wait(u64),
    Late(u64),
    LoseTpdo,
}

fn attack() -> impl Strategy<Value = Attack> {
    let known = prop::sample::select(vec![
        0x000, 0x080, 0x081, 0x082, 0x181, 0x182, 0x201, 0x581, 0x582, 0x601, 0x701, 0x702, 0x77f,
    ]);
    let bytes = || prop::collection::vec(any::<u8>(), 0..=8);
    let step = prop_oneof![-0.3..0.3_f64, -200.0..200.0_f64, Just(f64::NAN), Just(1e300)];
    prop_oneof![
        2 => (known, bytes()).prop_map(|(id, data)| Attack::Frame(id, data)),
        1 => (0..0x800_u16, bytes()).prop_map(|(id, data)| Attack::Frame(id, data)),
        1 => (any::<bool>(), prop::sample::select(vec![0x0237, 0x0233, 0x0208, 0x2237]), any::<i32>())
            .prop_map(|(first, word, counts)| Attack::Statusword(first, word, counts)),
        8 => (step.clone(), step).prop_map(|(i, r)| Attack::Command(i, r)),
        6 => (0..30_u64).prop_map(Attack::Wait),
        1 => (0..100_u64).prop_map(Attack::Late),
        1 => Just(Attack::LoseTpdo),
    ]
}

/// The targets that took effect, in order: sent with Enable Operation and followed by a SYNC. Of several targets
/// before one SYNC the last takes effect.
fn targets(bench: &Bench, cob_id: u16) -> Vec<i64> {
    let (mut taken, mut next) = (Vec::new(), None);
    for (_, frame) in &bench.sent {
        match (frame.cob_id(), frame.data()) {
            (Some(id), [0x0f, 0, target @ ..]) if id == cob_id => next = target.try_into().ok(),
            (Some(id), _) if id == cob_id => next = None,
            (Some(0x080), _) => {
                taken.extend(next.take().map(|target| i64::from(i32::from_le_bytes(target))));
            }
            _ => {}
        }
    }
    taken
}

fn check_targets(
    targets: &[i64],
    zero: i64,
    range: [f64; 2],
    step_max: f64,
) -> Result<(), TestCaseError> {
    let range = range.map(|limit| limit.round() as i64 + zero);
    for target in targets {
        prop_assert!((range[0]..=range[1]).contains(target), "{target} out of {range:?}");
    }
    for pair in targets.windows(2) {
        let step = pair[0].abs_diff(pair[1]);
        prop_assert!(step as f64 <= step_max + 1.0, "a step of {step} counts");
    }
    Ok(())
}

fn check_all_targets(bench: &Bench) -> Result<(), TestCaseError> {
    let per_mm = f64::from(COUNTS_PER_MM);
    let per_rad = f64::from(COUNTS_PER_TURN) / std::f64::consts::TAU;
    let insertion = targets(bench, 0x201);
    let rotation = targets(bench, 0x202);
    // Zero is where the axis was enabled.
    if let (Some(&i), Some(&r)) = (insertion.first(), rotation.first()) {
        check_targets(&insertion, i, [-0.2 * per_mm, 0.3 * per_mm], 0.1 * per_mm)?;
        check_targets(&rotation, r, [-0.4 * per_rad, 0.5 * per_rad], 0.2 * per_rad)?;
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_target_leaves_its_limits(
        from_start: bool,
        attacks in prop::collection::vec(attack(), 1..120),
    ) {
        let mut bench = Bench::new(narrow());
        if !from_start {
            bench.until_feedback();
        }
        let (mut insertion_mm, mut rotation_rad) = (0.0, 0.0);
        for attack in attacks {
            match attack {
                Attack::Frame(id, data) => {
                    let frame = Frame::from_parts(CanId::Base(id), false, &data);
                    bench.receive(frame.expect("in range"));
                }
                Attack::Statusword(first, word, counts) => {
                    let id = if first { 0x181 } else { 0x182 };
                    let [s0, s1] = u16::to_le_bytes(word);
                    let [p0, p1, p2, p3] = counts.to_le_bytes();
                    bench.receive(Frame::new(id, &[s0, s1, p0, p1, p2, p3]));
                }
                Attack::Command(i, r) => {
                    if bench.command(insertion_mm + i, rotation_rad + r).is_ok() {
                        (insertion_mm, rotation_rad) = (insertion_mm + i, rotation_rad + r);
                    }
                }
                Attack::Wait(ms) => bench.run_for(Duration::from_millis(ms)),
                Attack::Late(ms) => {
                    bench.now = bench.now + Duration::from_millis(ms);
                    bench.stage.handle_timeout(bench.now);
                    bench.settle();
                }
                Attack::LoseTpdo => bench.insertion.tpdos_lost += 1,
            }
        }
        bench.stage.quick_stop(bench.now);
        bench.run_for(Duration::from_secs(7));
        prop_assert!(!bench.stage.sync_runs(), "a quick stop always ends");

        check_all_targets(&bench)?;
    }

    #[test]
    fn no_series_of_commands_leaves_its_limits(
        steps in prop::collection::vec((-0.05..0.13_f64, -0.25..0.15_f64), 1..60),
    ) {
        let mut bench = Bench::new(narrow());
        let mut feedback = bench.until_feedback();
        for (insertion_mm, rotation_rad) in steps {
            let _ = bench.command(
                feedback.commanded.insertion_mm + insertion_mm,
                feedback.commanded.rotation_rad + rotation_rad,
            );
            feedback = bench.until_feedback();
        }
        check_all_targets(&bench)?;
    }
}
