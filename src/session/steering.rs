//! The estimates and the command of each step: observers and control law, without stage or time.

use super::config::{Samples, SessionConfig};
use super::goal::{Approach, Pursuit};
use crate::control::{Command, Controller};
use crate::needle::{Increment, TipPosition};
use crate::observer::{Estimate, HandednessWatch, Observer, ObserverConfig, Whiteness};
use nalgebra::Vector3;

/// The observers of a run and its control law.
///
/// The caller carries it along the measured path with [`Steering::predict`], corrects it with each
/// measurement, and calls [`Steering::decide`] once a step. A session does so with what the stage and the
/// tracker send, a study with what they would have sent.
pub struct Steering {
    observer: Box<dyn Observer>,
    shadows: Vec<(String, Box<dyn Observer>)>,
    control: Box<dyn Controller>,
    pursuit: Option<Pursuit>,
    /// Depth of the observers' states, from where they began, mm.
    depth_mm: f64,
    handedness: HandednessWatch,
    samples: Samples,
    whiteness: Whiteness,
    is_noise_configured: bool,
    step_mm: f64,
}

/// With one correction a step, the correlation of the positions between two steps is not known. Every second
/// position counts as independent.
const UNKNOWN_INFLATION: f64 = 2.0;

/// The result of a step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Decision {
    /// The estimate that steers; `None` while its observer has none.
    pub estimate: Option<Estimate>,
    /// The estimates of the shadows, by name.
    pub shadows: Vec<(String, Option<Estimate>)>,
    /// Rotation of the base for the next step, rad/mm; `None` after the last step, and if the
    /// law refuses.
    pub rotation_cmd_rad_per_mm: Option<f64>,
    /// The law demanded more than its own limits allow.
    pub command_saturated: bool,
    /// The approach to the target; `None` without a target or without an estimate.
    pub approach: Option<Approach>,
    /// Why there is no command: the run must be stopped for this reason.
    pub refused: Option<String>,
    /// A warning of the observer that steers.
    pub warning: Option<String>,
}

impl Steering {
    /// Builds the observers and the law that `config` names.
    pub fn new(config: &SessionConfig) -> Self {
        let build =
            |observer: &ObserverConfig| observer.build(config.needle, config.needle_torsion);
        let shadows = config.shadows.iter();
        let shadows = shadows.map(|shadow| (shadow.name().to_owned(), build(shadow))).collect();
        let mut handedness =
            HandednessWatch::new(config.needle, config.needle_torsion, config.handedness);
        if !config.tracker.judges_stream {
            handedness.give_up();
        }
        let position_sd_mm = config.handedness.position_sd_mm;
        let observer_sd_mm = config.observer.position_sd_mm().unwrap_or(position_sd_mm);
        Steering {
            observer: build(&config.observer),
            shadows,
            control: config.control.build(config.needle),
            pursuit: config.goal.clone().map(|goal| Pursuit::new(goal, config)),
            depth_mm: 0.0,
            handedness,
            samples: config.insertion.corrected_by,
            whiteness: Whiteness::new(position_sd_mm)
                .with_noise(config.tracker.noise, observer_sd_mm),
            is_noise_configured: config.tracker.noise.is_some(),
            step_mm: config.insertion.step_mm,
        }
    }

    /// Advances every observer by one measured increment.
    pub fn predict(&mut self, increment: Increment) {
        self.depth_mm += increment.insertion_mm();
        self.observers().for_each(|observer| observer.predict(increment));
    }

    /// Corrects every observer with the mean of `positions` positions measured at the depth of their states,
    /// each `spacing_s` after the one before (infinite for the first position of a run). Returns the
    /// innovation of the observer that steers, mm; `None` if it had no estimate yet.
    pub fn correct(
        &mut self,
        tip_meas: &TipPosition,
        positions: u32,
        spacing_s: f64,
    ) -> Option<Vector3<f64>> {
        let predicted_mm = self.observer.position_mm();
        let independent = match (self.samples, self.is_noise_configured) {
            (Samples::OnePerStep, false) => 1.0,
            _ => f64::from(positions) / self.whiteness.inflation(spacing_s),
        };
        self.observers().for_each(|observer| observer.correct(tip_meas, independent));
        let innovation_mm = tip_meas.mm() - predicted_mm?;
        // The watch expects the noise of one position. The mean of n independent positions has 1/√n of it.
        self.whiteness.take(innovation_mm * f64::from(positions).sqrt(), spacing_s);
        Some(innovation_mm)
    }

    /// The handedness watch. The caller carries it along the measured path, independently of the observers.
    pub fn handedness(&mut self) -> &mut HandednessWatch {
        &mut self.handedness
    }

    /// Corrects the handedness watch with the mean of `positions` positions, `spacing_s` apart, whose mean
    /// depth is that of the watch.
    pub fn correct_handedness(&mut self, tip_meas: &TipPosition, positions: u32, spacing_s: f64) {
        let inflation = match (self.samples, self.is_noise_configured) {
            (Samples::OnePerStep, false) => UNKNOWN_INFLATION,
            _ => self.whiteness.inflation(spacing_s),
        };
        self.handedness.correct(tip_meas, f64::from(positions) / inflation);
    }

    /// Sets the position of the target, plane frame, mm. Does nothing without a target.
    pub fn set_target(&mut self, target_mm: Vector3<f64>) {
        if let Some(pursuit) = &mut self.pursuit {
            pursuit.set_target(target_mm);
        }
    }

    /// Checks, before the first step, that a path leads to the target from a tip that is seen at `tip_mm`, plane
    /// frame. Without a target every start is good.
    ///
    /// # Errors
    /// The reason, in words.
    pub fn check_start(&mut self, tip_mm: &Vector3<f64>) -> Result<(), String> {
        self.pursuit.as_mut().map_or(Ok(()), |pursuit| pursuit.check_start(tip_mm))
    }

    /// The estimate that steers, at the depth of the observers' states; `None` while there is none.
    pub fn estimate(&self) -> Option<Estimate> {
        self.observer.estimate()
    }

    /// Decides on the next step, from the estimates predicted over the increments `ahead` of the observers'
    /// states. Without an estimate the needle goes on unturned, unless there is a target.
    pub fn decide(&mut self, ahead: &[Increment], is_last: bool) -> Decision {
        let estimate = self.observer.estimate_after(ahead);
        let shadows = self.shadows.iter();
        let shadows =
            shadows.map(|(name, shadow)| (name.clone(), shadow.estimate_after(ahead))).collect();
        // A lost observer has no estimate either, so it is checked first.
        let unturned = Command { rotation_rad_per_mm: 0.0, saturated: false };
        let ahead_mm: f64 = ahead.iter().map(|increment| increment.insertion_mm()).sum();
        let (approach, command) = match (self.check(), &estimate) {
            (Err(error), estimate) => {
                let pursuit = self.pursuit.as_mut().zip(estimate.as_ref());
                (pursuit.map(|(pursuit, estimate)| pursuit.stopped(estimate)), Err(error))
            }
            (Ok(()), None) if self.pursuit.is_some() => {
                (None, Err("goal: no estimate says where the tip is".to_owned()))
            }
            (Ok(()), None) => (None, Ok((!is_last).then_some(unturned))),
            (Ok(()), Some(estimate)) => self.command(estimate, self.depth_mm + ahead_mm, is_last),
        };
        let (command, refused) = match command {
            Ok(command) => (command, None),
            Err(error) => (None, Some(error)),
        };
        Decision {
            estimate,
            shadows,
            rotation_cmd_rad_per_mm: command.map(|command| command.rotation_rad_per_mm),
            command_saturated: command.is_some_and(|command| command.saturated),
            approach,
            refused,
            warning: self.observer.take_warning(),
        }
    }

    /// A stream of the wrong handedness and a lost observer end a run. The stream is checked first, since it
    /// may have caused the loss.
    fn check(&self) -> Result<(), String> {
        self.handedness.check().map_err(|error| format!("tracker: {error}"))?;
        self.observer.check().map_err(|error| format!("observer: {error}"))
    }

    /// Returns the approach to the target at this step, and the command; no command if the insertion ends here.
    fn command(
        &mut self,
        estimate: &Estimate,
        depth_mm: f64,
        is_last: bool,
    ) -> (Option<Approach>, Result<Option<Command>, String>) {
        match &mut self.pursuit {
            Some(pursuit) if is_last => (Some(pursuit.end(estimate)), Ok(None)),
            Some(pursuit) => {
                let (approach, command) = pursuit.step(estimate, depth_mm, self.step_mm);
                (Some(approach), command)
            }
            None if is_last => (None, Ok(None)),
            None => {
                let command = self.control.command(estimate, self.step_mm);
                (None, command.map(Some).map_err(|error| format!("control: {error}")))
            }
        }
    }

    fn observers(&mut self) -> impl Iterator<Item = &mut Box<dyn Observer>> {
        let shadows = self.shadows.iter_mut().map(|(_, shadow)| shadow);
        std::iter::once(&mut self.observer).chain(shadows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::geometry::Pose;
    use crate::observer::PositionNoise;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;
    use std::time::Duration;

    /// An observer that refuses to go on. Without an estimate it has lost every hypothesis.
    struct Lost(Option<Estimate>);

    impl Observer for Lost {
        fn predict(&mut self, _: Increment) {}
        fn correct(&mut self, _: &TipPosition, _: f64) {}
        fn estimate_after(&self, _: &[Increment]) -> Option<Estimate> {
            self.0
        }
        fn check(&self) -> Result<(), String> {
            Err("lost".to_owned())
        }
    }

    struct Still;

    impl Controller for Still {
        fn command(&mut self, _: &Estimate, _: f64) -> Result<Command, String> {
            Ok(Command { rotation_rad_per_mm: 0.0, saturated: false })
        }
    }

    /// An observer without an estimate yet lets the needle go on unturned. A lost one must not.
    #[test]
    fn a_lost_observer_ends_the_run() {
        let config = Config::from_sources(&[], &[]).unwrap().session().unwrap();
        let mut steering = Steering {
            observer: Box::new(Lost(None)),
            control: Box::new(Still),
            ..Steering::new(&config)
        };
        for is_last in [false, true] {
            let decision = steering.decide(&[], is_last);
            assert_eq!(decision.rotation_cmd_rad_per_mm, None);
            assert_eq!(decision.refused.as_deref(), Some("observer: lost"));
        }
    }

    fn with_target() -> SessionConfig {
        let sets = ["goal.kind=\"target\"", "goal.position_mm=[0.0, 0.0, 120.0]"];
        let config = Config::from_sources(&[], &sets.map(str::to_owned)).unwrap();
        config.session().unwrap()
    }

    /// The figures at the end of a run are those of its last row.
    #[test]
    fn a_refused_step_has_its_distance_from_the_target() {
        let config = with_target();
        let translation = Vector3::new(0.0, 0.0, 110.0);
        let estimate = Estimate::of_pose(Pose { translation, ..Pose::identity() });
        let mut steering =
            Steering { observer: Box::new(Lost(Some(estimate))), ..Steering::new(&config) };
        let decision = steering.decide(&[], false);
        assert!(decision.refused.is_some());
        assert_eq!(decision.approach.expect("an approach").distance_mm, 10.0);
    }

    /// An observer that states no standard deviation, or has no estimate, would switch the checks of the clearance off.
    #[test]
    fn a_run_to_a_target_needs_an_estimate_with_its_uncertainty() {
        struct Sure(Option<Estimate>);
        impl Observer for Sure {
            fn predict(&mut self, _: Increment) {}
            fn correct(&mut self, _: &TipPosition, _: f64) {}
            fn estimate_after(&self, _: &[Increment]) -> Option<Estimate> {
                self.0
            }
        }
        let config = with_target();
        let unsure = Estimate::of_pose(Pose::identity());
        let not_stated = "goal: the observer does not state how well it knows the tip";
        for (estimate, why) in [
            (None, "goal: no estimate says where the tip is"),
            (Some(unsure), not_stated),
            (Some(Estimate { sd: Some([f64::NAN; 6]), ..unsure }), not_stated),
        ] {
            let observer = Box::new(Sure(estimate));
            let mut steering = Steering { observer, ..Steering::new(&config) };
            let decision = steering.decide(&[], false);
            assert_eq!(decision.rotation_cmd_rad_per_mm, None);
            assert_eq!(decision.refused.as_deref(), Some(why));
        }
    }

    /// Standard deviation of x after an arc of 60 mm with `per_mm` means of `positions` positions a mm, each sent
    /// `times` times. The noise of a mean is that of `independent` positions.
    fn x_sd_mm(per_mm: u32, times: u32, positions: u32, independent: u32) -> f64 {
        let config = Config::from_sources(&[], &[]).unwrap().session().unwrap();
        let mut steering = Steering::new(&config);
        let sent = per_mm * times;
        let curvature_per_mm = config.needle.curvature_per_mm();
        let (mut rng, mut noise) = (Pcg64::seed_from_u64(1), Vector3::zeros());
        for k in 0..60 * sent {
            if k % times == 0 {
                let mut draw = || Vector3::from_fn(|_, _| 2.0 * rng.random::<f64>() - 1.0);
                let sum: Vector3<f64> = (0..independent).map(|_| draw()).sum();
                noise = sum / f64::from(independent);
            }
            let step_mm = f64::from(sent).recip();
            let bent = f64::from(k) * step_mm * curvature_per_mm;
            let arc_mm = Vector3::new(0.0, bent.cos() - 1.0, bent.sin()) / curvature_per_mm;
            steering.correct(&TipPosition::new(arc_mm + noise).unwrap(), positions, 0.025);
            steering.predict(Increment::new(step_mm, 0.0).unwrap());
        }
        steering.estimate().unwrap().sd.unwrap()[0]
    }

    /// Five independent positions would lower it by √5.
    #[test]
    fn repeated_positions_do_not_lower_the_standard_deviation() {
        let [repeated, independent] =
            [(4, 5), (20, 1)].map(|(per_mm, times)| x_sd_mm(per_mm, times, 1, 1));
        assert!(repeated > 1.8 * independent, "{repeated} {independent}");
    }

    /// Twenty independent positions in a mean lower it by √20.
    #[test]
    fn positions_in_a_mean_that_are_not_independent_count_for_less() {
        let [repeated, independent] = [1, 20].map(|draws| x_sd_mm(1, 1, 20, draws));
        assert!(repeated > 1.8 * independent, "{repeated} {independent}");
    }

    /// Positions with correlated noise count for less from the first one on.
    #[test]
    fn configured_correlated_noise_raises_the_standard_deviation() {
        let sd_mm = |noise| {
            let mut config = Config::from_sources(&[], &[]).unwrap().session().unwrap();
            config.tracker.noise = noise;
            let mut steering = Steering::new(&config);
            for _ in 0..40 {
                steering.correct(&TipPosition::new(Vector3::zeros()).unwrap(), 1, 0.025);
            }
            steering.estimate().unwrap().sd.unwrap()[0]
        };
        let configured = |correlated_sd_mm| {
            Some(PositionNoise {
                white_sd_mm: 0.577,
                correlated_sd_mm,
                correlation_time: Duration::from_millis(200),
            })
        };
        let [unknown, white, coloured] = [None, configured(0.0), configured(1.0)].map(sd_mm);
        assert!(white <= unknown && unknown < 0.5 * coloured, "{white} {unknown} {coloured}");
    }
}
