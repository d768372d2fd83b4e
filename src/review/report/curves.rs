//! The curves of a run.

use super::chart::{Chart, Layer, Named, Points, VALUE_MAX};
use super::colour::{COMMANDED, COORDINATES, ESTIMATE, FAULT, MEASURED, NEUTRAL, TRUTH};
use crate::archive::RunOutcome;
use crate::review::limits::Limits;
use crate::review::run::Run;
use crate::units::wrap_angle;
use plotters::style::RGBColor;

const DEPTH: &str = "depth (mm)";
const TIME: &str = "time (s)";

/// A column, known or not.
type Column = Vec<Option<f64>>;

/// The charts of `run` that have something to show.
pub(super) fn curves(run: &Run, limits: Option<&Limits>) -> Vec<Chart> {
    let mut charts: Vec<Chart> =
        ["x", "y"].iter().map(|axis| position(run, axis, limits)).collect();
    charts.extend(["pitch", "roll"].iter().map(|angle| attitude(run, angle)));
    charts.extend([position_errors(run), angle_errors(run), residuals(run)]);
    charts.extend([turning(run), rotation(run), insertion(run, limits), tip_age(run, limits)]);
    charts.retain(Chart::has_curve);
    charts
}

/// A tip coordinate over depth: measured, estimated with its band, true.
fn position(run: &Run, axis: &str, limits: Option<&Limits>) -> Chart {
    let (meas, est, sd, truth) = provenances(run, axis, "mm", |mm| mm);
    let mut layers = layers_of_estimate(run, &est, &sd, &truth, f64::INFINITY);
    layers.insert(1, named("measured", MEASURED, Layer::Points(points(&depth(run), &meas))));
    let (title, y) = match axis {
        "x" => ("Distance from the plane", "x (mm)"),
        _ => ("Tip in the plane, across the start", "y (mm)"),
    };
    if axis == "x"
        && let Some(limits) = limits
    {
        let level = |sign: f64| Layer::Level(sign * limits.off_plane_mm);
        layers.push(named("1 mm off the plane", NEUTRAL, level(1.0)));
        layers.push(named("", NEUTRAL, level(-1.0)));
    }
    Chart { title, x: DEPTH, y, layers, span: None }
}

/// An angle over depth: estimated with its band, true.
fn attitude(run: &Run, angle: &str) -> Chart {
    let (_, est, sd, truth) = provenances(run, angle, "rad", f64::to_degrees);
    let layers = layers_of_estimate(run, &est, &sd, &truth, 180.0);
    let (title, y, span) = match angle {
        "pitch" => ("Pitch: the heading out of the plane", "pitch (deg)", None),
        _ => ("Roll: where the bevel looks", "roll (deg)", Some((-180.0, 180.0))),
    };
    Chart { title, x: DEPTH, y, layers, span }
}

fn position_errors(run: &Run) -> Chart {
    let layers = [("x", 0), ("y", 1), ("z", 2)].map(|(axis, n)| {
        let (_, est, _, truth) = provenances(run, axis, "mm", |mm| mm);
        let error = difference(&est, &truth);
        let pieces = pieces(&depth(run), &error, f64::INFINITY);
        named(axis, COORDINATES[n], Layer::Line(pieces))
    });
    errors(run, "Errors of the estimated position", "estimate − truth (mm)", layers.into())
}

fn angle_errors(run: &Run) -> Chart {
    let layers = [("yaw", 0), ("pitch", 1), ("roll", 2)].map(|(angle, n)| {
        let (_, est, _, truth) = provenances(run, angle, "rad", |rad| rad);
        let error: Column = difference(&est, &truth)
            .into_iter()
            .map(|rad| Some(wrap_angle(rad?).to_degrees()))
            .collect();
        let pieces = pieces(&depth(run), &error, 180.0);
        named(angle, COORDINATES[n], Layer::Line(pieces))
    });
    errors(run, "Errors of the estimated angles", "estimate − truth (deg)", layers.into())
}

/// Errors over depth, on an axis that what an observer begins with does not stretch.
fn errors(run: &Run, title: &'static str, y: &'static str, layers: Vec<Named>) -> Chart {
    let mut chart = Chart { title, x: DEPTH, y, layers, span: None };
    let deepest_mm = depth(run).into_iter().flatten().fold(0.0, f64::max);
    chart.span = chart.span_from(deepest_mm / 3.0);
    if chart.span.is_some() {
        chart.x = "depth (mm); the axis spans the errors from a third of it on";
    }
    chart
}

/// What is left of the measurements: the innovation is in `run.rrd`, this is after the correction.
fn residuals(run: &Run) -> Chart {
    let layers = [("x", 0), ("y", 1), ("z", 2)].map(|(axis, n)| {
        let (meas, est, ..) = provenances(run, axis, "mm", |mm| mm);
        let left = points(&depth(run), &difference(&meas, &est));
        named(axis, COORDINATES[n], Layer::Points(left))
    });
    let y = "measured − estimate (mm)";
    Chart {
        title: "Measured tip less the estimate",
        x: DEPTH,
        y,
        layers: layers.into(),
        span: None,
    }
}

fn turning(run: &Run) -> Chart {
    let per_mm = scaled(column(run, "rotation_cmd_rad_per_mm"), f64::to_degrees);
    let line = Layer::Line(pieces(&depth(run), &per_mm, f64::INFINITY));
    let layers = vec![named("commanded for the next step", COMMANDED, line)];
    Chart { title: "Turning of the base", x: DEPTH, y: "turning (deg/mm)", layers, span: None }
}

fn rotation(run: &Run) -> Chart {
    let turned = scaled(column(run, "rotation_rad"), f64::to_degrees);
    let line = Layer::Line(pieces(&depth(run), &turned, f64::INFINITY));
    let layers = vec![named("stage, measured", MEASURED, line)];
    Chart { title: "Rotation of the base", x: DEPTH, y: "rotation (deg)", layers, span: None }
}

/// Depth over time, with the holds.
fn insertion(run: &Run, limits: Option<&Limits>) -> Chart {
    let time = column(run, "time_s");
    let depth = column(run, "insertion_mm");
    let states = run.states();
    let ends = states.iter().skip(1).map(|next| next.time_s).chain([f64::INFINITY]);
    let held = states.iter().zip(ends).filter(|(change, _)| change.state == "holding");
    let held: Points = held.map(|(change, end)| (change.time_s, end)).collect();
    let mut line = pieces(&time, &depth, f64::INFINITY);
    // The way from the last step to where the run was stopped.
    if let (Some(stop_s), Some(piece)) = (run.stopped_at_s(), line.last_mut())
        && let Some((last_s, depth_mm)) = piece.last().copied()
        && stop_s > last_s
    {
        piece.push((stop_s, run.figures().insertion_mm.max(depth_mm)));
    }
    let line = Layer::Line(line);
    let mut layers = vec![
        named("held", NEUTRAL, Layer::Stretches(held)),
        named("stage, measured", MEASURED, line),
    ];
    let goal = limits.map(|limits| limits.depth_mm);
    if run.folder.manifest.outcome == Some(RunOutcome::Stopped) {
        let last = points(&time, &depth).last().copied();
        layers.push(named("last step", FAULT, Layer::Points(last.into_iter().collect())));
    }
    layers.extend(goal.map(|mm| named("depth to reach", NEUTRAL, Layer::Level(mm))));
    Chart { title: "Insertion", x: TIME, y: "depth (mm)", layers, span: None }
}

/// How old the newest believed tip position was when the next one came: what holds are about.
fn tip_age(run: &Run, limits: Option<&Limits>) -> Chart {
    let s = |ns: i64| ns as f64 * 1e-9;
    let (mut ages, mut refused) = (Points::new(), Points::new());
    let mut newest: Option<i64> = None;
    for sample in &run.samples {
        let received_s = s(sample.receive_time_ns);
        if sample.refused.is_some() {
            refused.push((received_s, 0.0));
        }
        let Some(acquired_ns) = sample.acquisition_time_ns else { continue };
        if let Some(before_ns) = newest {
            ages.push((received_s, s(sample.receive_time_ns.saturating_sub(before_ns))));
        }
        newest = Some(newest.map_or(acquired_ns, |before| before.max(acquired_ns)));
    }
    // The hold that ended the run had no next one.
    if let Some(stop_s) = run.stopped_at_s() {
        let heard = run.samples.iter().filter(|sample| s(sample.receive_time_ns) <= stop_s);
        if let Some(seen_ns) = heard.filter_map(|sample| sample.acquisition_time_ns).max() {
            let at = ages.partition_point(|(time_s, _)| *time_s <= stop_s);
            ages.insert(at, (stop_s, stop_s - s(seen_ns)));
        }
    }
    let mut layers = vec![
        named("age when the next came", MEASURED, Layer::Line(vec![ages])),
        named("refused", FAULT, Layer::Points(refused)),
    ];
    let hold = limits.map(|limits| Layer::Level(limits.tip_age_s));
    layers.extend(hold.map(|level| named("held when older", NEUTRAL, level)));
    Chart { title: "Age of the newest tip position", x: TIME, y: "age (s)", layers, span: None }
}

fn named(name: &'static str, colour: RGBColor, layer: Layer) -> Named {
    Named { name, colour, layer }
}

/// The band of ± 2 standard deviations, the estimate, and the truth. `jump` is the step at which a
/// line is taken to have gone round.
fn layers_of_estimate(
    run: &Run,
    est: &Column,
    sd: &Column,
    truth: &Column,
    jump: f64,
) -> Vec<Named> {
    let depth = depth(run);
    let band = pieces(&depth, est, jump).into_iter();
    // Pieces hold each known row once, in order: the deviations are walked along with them.
    let known =
        depth.iter().zip(est).zip(sd).filter(|((depth, est), _)| depth.is_some() && est.is_some());
    let mut sds = known.map(|(_, sd)| *sd);
    let band = band.map(|piece| {
        let bounded = piece.into_iter().filter_map(|(x, y)| {
            let half = 2.0 * sds.next().flatten()?;
            half.is_finite().then_some((x, y - half, y + half))
        });
        bounded.collect()
    });
    let band: Vec<Vec<(f64, f64, f64)>> = band.collect();
    vec![
        named("estimate ± 2 σ", ESTIMATE, Layer::Band(band)),
        named("estimate", ESTIMATE, Layer::Broad(pieces(&depth, est, jump))),
        named("truth", TRUTH, Layer::Line(pieces(&depth, truth, jump))),
    ]
}

fn depth(run: &Run) -> Column {
    column(run, "insertion_mm")
}

/// The column of that name, without what has no place on an axis.
fn column(run: &Run, name: &str) -> Column {
    scaled(run.steps.column(name), |value| value)
}

/// Measured, estimated, its standard deviation, true.
fn provenances(
    run: &Run,
    name: &str,
    unit: &str,
    scale: fn(f64) -> f64,
) -> (Column, Column, Column, Column) {
    let column =
        |provenance: &str| scaled(run.steps.column(&format!("{name}_{provenance}_{unit}")), scale);
    (column("meas"), column("est"), column("sd"), column("true"))
}

fn scaled(column: Column, scale: fn(f64) -> f64) -> Column {
    column
        .into_iter()
        .map(|value| value.map(scale).filter(|value| value.abs() < VALUE_MAX))
        .collect()
}

fn difference(a: &Column, b: &Column) -> Column {
    a.iter().zip(b).map(|(a, b)| Some((*a)? - (*b)?)).collect()
}

/// The points that are known.
fn points(xs: &Column, ys: &Column) -> Points {
    xs.iter().zip(ys).filter_map(|(x, y)| x.zip(*y)).collect()
}

/// The points that are known, apart where a step is over `jump`: an angle that went round.
fn pieces(xs: &Column, ys: &Column, jump: f64) -> Vec<Points> {
    let mut pieces = vec![Points::new()];
    for point in points(xs, ys) {
        let last = pieces.last().and_then(|piece| piece.last().copied());
        let is_apart = last.is_some_and(|(_, y)| (point.1 - y).abs() > jump);
        match pieces.last_mut() {
            Some(piece) if !is_apart => piece.push(point),
            _ => pieces.push(vec![point]),
        }
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::TrackerTimes;
    use crate::review::run::tests::run;
    use crate::session::Outcome;

    #[test]
    fn an_angle_that_goes_round_is_no_line_across() {
        let xs = (0..4).map(|x| Some(f64::from(x))).collect();
        let pieces = pieces(&xs, &vec![Some(170.0), Some(-175.0), None, Some(-160.0)], 180.0);
        assert_eq!(pieces, [vec![(0.0, 170.0)], vec![(1.0, -175.0), (3.0, -160.0)]]);
    }

    #[test]
    fn what_a_run_does_not_have_is_not_drawn() {
        let limits = Limits::of("").unwrap();
        let titles =
            |run: &Run| curves(run, Some(&limits)).iter().map(|c| c.title).collect::<Vec<_>>();
        let mut run = run();
        let all = titles(&run);
        assert!(all.contains(&"Errors of the estimated angles"), "{all:?}");
        assert!(!all.contains(&"Age of the newest tip position"), "{all:?}");
        run.steps = Default::default();
        assert!(titles(&run).is_empty());
    }

    #[test]
    fn a_band_is_two_deviations_to_each_side() {
        let chart = position(&run(), "x", None);
        let Layer::Band(band) = &chart.layers[0].layer else { panic!("no band") };
        assert_eq!(band[0].len(), 4);
        let (x, low, high) = band[0][1];
        assert!(x == 1.0 && (low - 0.35).abs() < 1e-12 && (high - 1.15).abs() < 1e-12);
    }

    /// Acquired at 0, 1 and 2 s, received 0.1 s later; one in between is refused.
    #[test]
    fn age_is_what_the_one_before_has_become() {
        let mut run = run();
        let at = |ms: i64, refused: bool| TrackerTimes {
            receive_time_ns: (ms + 100) * 1_000_000,
            acquisition_time_ns: (!refused).then_some(ms * 1_000_000),
            refused: refused.then(|| "zero".to_owned()),
        };
        run.samples = vec![at(0, false), at(1000, true), at(2000, false)];
        let chart = tip_age(&run, None);
        let (Layer::Line(ages), Layer::Points(refused)) =
            (&chart.layers[0].layer, &chart.layers[1].layer)
        else {
            panic!("other layers")
        };
        assert_eq!(ages[0], [(2.1, 2.1)]);
        assert_eq!(refused, &[(1.1, 0.0)]);
    }

    /// The run is stopped at 9 s: nothing was believed since 2 s, and the needle was 3.5 mm in.
    #[test]
    fn the_hold_that_stopped_a_run_is_in_its_curves() {
        let mut run = run();
        run.folder.manifest.set_outcome(&Outcome::Stopped("tracker: no tip".to_owned()));
        run.folder.manifest.figures.insert("insertion_mm".to_owned(), 3.5.into());
        let at = |ms: i64, refused: Option<String>| TrackerTimes {
            receive_time_ns: ms * 1_000_000,
            acquisition_time_ns: refused.is_none().then_some(ms * 1_000_000),
            refused,
        };
        run.samples = vec![at(1000, None), at(2000, None), at(8000, Some("step".to_owned()))];
        run.samples.push(at(10_000, None));
        let chart = tip_age(&run, None);
        let Layer::Line(ages) = &chart.layers[0].layer else { panic!("another layer") };
        assert_eq!(ages[0], [(2.0, 1.0), (9.0, 7.0), (10.0, 8.0)]);
        let chart = insertion(&run, None);
        let Layer::Line(depths) = &chart.layers[1].layer else { panic!("another layer") };
        assert_eq!(depths[0].last(), Some(&(9.0, 3.5)));
    }
}
