//! The curves of a run.

use super::chart::{Chart, Layer, Named, Points, VALUE_MAX};
use super::colour::{COMMANDED, COORDINATES, ESTIMATE, FAULT, MEASURED, NEUTRAL, TRUTH};
use crate::archive::RunOutcome;
use crate::review::figures::{BLIND_DEPTH, GOAL, Limits, OFF_PLANE, TIP_AGE};
use crate::review::run::Run;
use crate::session::{Lane, State};
use crate::stage::Axis;
use crate::units::wrap_angle;

const DEPTH: &str = "depth (mm)";
const TIME: &str = "time (s)";

/// A column of `steps.csv`; unknown values are `None`.
type Column = Vec<Option<f64>>;

/// The charts of `run` that have a curve.
pub(super) fn curves(run: &Run, limits: &Limits) -> Vec<Chart> {
    let mut charts = vec![
        off_plane(run, limits),
        tip(run, "y", "Tip in the plane, across the start", "y (mm)"),
        tip(run, "pitch", "Pitch: the heading out of the plane", "pitch (deg)"),
        roll(run),
        errors(run, "position", "estimate − truth (mm)", ["x", "y", "z"]),
        errors(run, "angles", "estimate − truth (deg)", ["yaw", "pitch", "roll"]),
        residuals(run),
        turning(run),
        rotation(run),
        insertion(run, limits),
        tip_age(run, limits),
        blind_depth(run, limits),
        motion(run, Axis::Insertion),
        motion(run, Axis::Rotation),
    ];
    charts.retain(Chart::has_curve);
    charts
}

/// A tip coordinate over depth: measured, estimated with its band of ± 2 standard deviations, true.
fn tip(run: &Run, name: &str, title: &'static str, y: &'static str) -> Chart {
    let depth = depth(run);
    let of = |provenance| coordinate(run, name, provenance);
    let (estimate, jump) = (of("est"), jump(name));
    let layers = vec![
        named("estimate ± 2 σ", ESTIMATE, Layer::Band(band(&depth, &estimate, &of("sd"), jump))),
        named("measured", MEASURED, Layer::Points(points(&depth, &of("meas")))),
        named("estimate", ESTIMATE, Layer::Broad(pieces(&depth, &estimate, jump))),
        named("truth", TRUTH, Layer::Line(pieces(&depth, &of("true"), jump))),
    ];
    Chart { title, x: DEPTH, y, layers, span: None }
}

fn off_plane(run: &Run, limits: &Limits) -> Chart {
    let mut chart = tip(run, "x", "Distance from the plane", "x (mm)");
    if let Some(off_plane_mm) = limits.get(OFF_PLANE) {
        chart.layers.push(named("1 mm off the plane", NEUTRAL, Layer::Level(*off_plane_mm)));
        chart.layers.push(named("", NEUTRAL, Layer::Level(-off_plane_mm)));
    }
    chart
}

fn roll(run: &Run) -> Chart {
    let chart = tip(run, "roll", "Roll: where the bevel looks", "roll (deg)");
    Chart { span: Some((-180.0, 180.0)), ..chart }
}

/// Errors of the estimate over depth. The errors at the start, which are large, do not stretch the
/// y axis.
fn errors(run: &Run, what: &str, y: &'static str, names: [&'static str; 3]) -> Chart {
    let depth = depth(run);
    let layers = names.into_iter().zip(COORDINATES).map(|(name, colour)| {
        let mut error = difference(&coordinate(run, name, "est"), &coordinate(run, name, "true"));
        if is_angle(name) {
            let wrapped = |deg: f64| wrap_angle(deg.to_radians()).to_degrees();
            error = scaled(error, wrapped);
        }
        named(name, colour, Layer::Line(pieces(&depth, &error, jump(name))))
    });
    let title = match what {
        "position" => "Errors of the estimated position",
        _ => "Errors of the estimated angles",
    };
    let mut chart = Chart { title, x: DEPTH, y, layers: layers.collect(), span: None };
    chart.span = chart.span_from(depth.iter().flatten().fold(0.0, |a, b| b.max(a)) / 3.0);
    if chart.span.is_some() {
        chart.x = "depth (mm); the axis spans the errors from a third of it on";
    }
    chart
}

/// The residuals after the correction; the innovations are in `run.rrd`.
fn residuals(run: &Run) -> Chart {
    let depth = depth(run);
    let layers = ["x", "y", "z"].into_iter().zip(COORDINATES).map(|(name, colour)| {
        let left = difference(&coordinate(run, name, "meas"), &coordinate(run, name, "est"));
        named(name, colour, Layer::Points(points(&depth, &left)))
    });
    let (title, y) = ("Measured tip less the estimate", "measured − estimate (mm)");
    Chart { title, x: DEPTH, y, layers: layers.collect(), span: None }
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
fn insertion(run: &Run, limits: &Limits) -> Chart {
    let time = column(run, "time_s");
    let depth = column(run, "insertion_mm");
    let states = run.states();
    let ends = states.iter().skip(1).map(|next| next.time_s).chain([f64::INFINITY]);
    let is_held = |name: &str| State::named(Lane::Session, name).is_some_and(State::is_held);
    let held = states.iter().zip(ends).filter(|(change, _)| is_held(&change.state));
    let held: Points = held.map(|(change, end)| (change.time_s, end)).collect();
    let mut line = pieces(&time, &depth, f64::INFINITY);
    // From the last step to the point where the run was stopped.
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
    if run.folder.manifest.outcome == Some(RunOutcome::Stopped) {
        let last = points(&time, &depth).last().copied();
        layers.push(named("last step", FAULT, Layer::Points(last.into_iter().collect())));
    }
    let goal = limits.get(GOAL);
    layers.extend(goal.map(|mm| named("depth to reach", NEUTRAL, Layer::Level(*mm))));
    Chart { title: "Insertion", x: TIME, y: "depth (mm)", layers, span: None }
}

/// Where an axis of an operation was told to be, and where it was.
fn motion(run: &Run, axis: Axis) -> Chart {
    let (title, y) = match axis {
        Axis::Insertion => ("Motion of the insertion", "position (mm)"),
        Axis::Rotation => ("Motion of the rotation", "position (deg)"),
    };
    let (commanded, measured) = (&run.motion.commanded[axis], &run.motion.measured[axis]);
    let line = |course: &Points| Layer::Line(vec![course.clone()]);
    let mut layers = vec![
        named("stage, commanded", COMMANDED, line(commanded)),
        named("stage, measured", MEASURED, line(measured)),
    ];
    if let Some(stop_s) = run.stopped_at_s() {
        let at = measured.partition_point(|(time_s, _)| *time_s <= stop_s).checked_sub(1);
        let stopped = at.and_then(|at| measured.get(at)).copied().into_iter().collect();
        layers.push(named("stopped", FAULT, Layer::Points(stopped)));
    }
    Chart { title, x: TIME, y, layers, span: None }
}

/// When the next accepted tip position came, or the run was stopped, and when the newest before that was
/// acquired, s. The hold that ended a run has no next position.
fn sights(run: &Run) -> Points {
    let s = |ns: i64| ns as f64 * 1e-9;
    let accepted = run
        .samples
        .iter()
        .filter_map(|sample| Some((s(sample.receive_time_ns), s(sample.acquisition_time_ns?))));
    let (mut sights, mut newest) = (Points::new(), None::<f64>);
    let mut stop_s = run.stopped_at_s();
    for (received_s, acquired_s) in accepted.chain([(f64::INFINITY, f64::INFINITY)]) {
        let times = stop_s.take_if(|stop_s| *stop_s < received_s).into_iter().chain([received_s]);
        sights.extend(times.filter_map(|time_s| Some((time_s, newest?))));
        newest = Some(newest.map_or(acquired_s, |before| before.max(acquired_s)));
    }
    sights.retain(|(time_s, _)| time_s.is_finite());
    sights
}

/// The age of the newest accepted tip position when the next one came; a large age causes a hold.
fn tip_age(run: &Run, limits: &Limits) -> Chart {
    let refused = run.samples.iter().filter(|sample| sample.refused.is_some());
    let refused = refused.map(|sample| (sample.receive_time_ns as f64 * 1e-9, 0.0)).collect();
    let ages = sights(run).into_iter().map(|(time_s, seen_s)| (time_s, time_s - seen_s)).collect();
    let mut layers = vec![
        named("age when the next came", MEASURED, Layer::Line(vec![ages])),
        named("refused", FAULT, Layer::Points(refused)),
    ];
    let hold = limits.get(TIP_AGE);
    layers.extend(hold.map(|age_s| named("held when older", NEUTRAL, Layer::Level(*age_s))));
    Chart { title: "Age of the newest tip position", x: TIME, y: "age (s)", layers, span: None }
}

/// The depth inserted since the newest accepted tip position, when the next one came.
fn blind_depth(run: &Run, limits: &Limits) -> Chart {
    let depth_mm = run.depth_over_time();
    let blind = sights(run)
        .into_iter()
        .filter_map(|(time_s, seen_s)| Some((time_s, depth_mm(time_s)? - depth_mm(seen_s)?)));
    let line = Layer::Line(vec![blind.collect()]);
    let mut layers = vec![named("inserted when the next came", MEASURED, line)];
    let hold = limits.get(BLIND_DEPTH);
    layers.extend(hold.map(|mm| named("held before", NEUTRAL, Layer::Level(*mm))));
    let title = "Inserted since the newest tip position";
    Chart { title, x: TIME, y: "blind depth (mm)", layers, span: None }
}

/// The band of ± 2 standard deviations around the estimate, in the same pieces as its line.
fn band(depth: &Column, est: &Column, sd: &Column, jump: f64) -> Vec<Vec<(f64, f64, f64)>> {
    // The pieces hold each known row once and in order, so the deviations are read along with them.
    let known = depth.iter().zip(est).zip(sd);
    let mut sds = known.filter(|((x, y), _)| x.is_some() && y.is_some()).map(|(_, sd)| *sd);
    let band = pieces(depth, est, jump).into_iter().map(|piece| {
        let bounded = piece.into_iter().filter_map(|(x, y)| {
            let half = 2.0 * sds.next().flatten()?;
            half.is_finite().then_some((x, y - half, y + half))
        });
        bounded.collect()
    });
    band.collect()
}

fn named(name: &'static str, colour: &'static str, layer: Layer) -> Named {
    Named { name, colour, layer }
}

fn depth(run: &Run) -> Column {
    column(run, "insertion_mm")
}

/// The column of that name, without values that no axis can show.
fn column(run: &Run, name: &str) -> Column {
    scaled(run.steps.column(name), |value| value)
}

fn is_angle(name: &str) -> bool {
    ["yaw", "pitch", "roll"].contains(&name)
}

/// A step of a line that is taken as a turn past ± 180 degrees.
fn jump(name: &str) -> f64 {
    if is_angle(name) { 180.0 } else { f64::INFINITY }
}

/// A tip coordinate in mm or degrees, from the provenance `meas`, `est`, `sd` or `true`.
fn coordinate(run: &Run, name: &str, provenance: &str) -> Column {
    match is_angle(name) {
        true => scaled(run.steps.column(&format!("{name}_{provenance}_rad")), f64::to_degrees),
        false => column(run, &format!("{name}_{provenance}_mm")),
    }
}

fn scaled(column: Column, scale: impl Fn(f64) -> f64) -> Column {
    let shown = |value: f64| Some(scale(value)).filter(|value| value.abs() < VALUE_MAX);
    column.into_iter().map(|value| value.and_then(shown)).collect()
}

fn difference(a: &Column, b: &Column) -> Column {
    a.iter().zip(b).map(|(a, b)| Some((*a)? - (*b)?)).collect()
}

/// The points that are known.
fn points(xs: &Column, ys: &Column) -> Points {
    xs.iter().zip(ys).filter_map(|(x, y)| x.zip(*y)).collect()
}

/// The points that are known, in pieces that end where a step exceeds `jump` (an angle passed
/// ±180°).
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
        let limits = crate::review::figures::limits("").unwrap();
        let titles = |run: &Run| curves(run, &limits).iter().map(|c| c.title).collect::<Vec<_>>();
        let mut run = run();
        let all = titles(&run);
        assert!(all.contains(&"Errors of the estimated angles"), "{all:?}");
        assert!(!all.contains(&"Age of the newest tip position"), "{all:?}");
        run.steps = Default::default();
        assert!(titles(&run).is_empty());
    }

    #[test]
    fn a_band_is_two_deviations_to_each_side() {
        let chart = tip(&run(), "x", "Distance from the plane", "x (mm)");
        let Layer::Band(band) = &chart.layers[0].layer else { panic!("no band") };
        assert_eq!(band[0].len(), 4);
        let (x, low, high) = band[0][1];
        assert!(x == 1.0 && (low - 0.35).abs() < 1e-12 && (high - 1.15).abs() < 1e-12);
    }

    /// Samples are acquired at 0, 1 and 2 s and received 0.1 s later; the one in between is
    /// refused.
    #[test]
    fn age_is_what_the_one_before_has_become() {
        let mut run = run();
        let at = |ms: i64, refused: bool| TrackerTimes {
            receive_time_ns: (ms + 100) * 1_000_000,
            acquisition_time_ns: (!refused).then_some(ms * 1_000_000),
            refused: refused.then(|| "zero".to_owned()),
        };
        run.samples = vec![at(0, false), at(1000, true), at(2000, false)];
        let chart = tip_age(&run, &Limits::new());
        let (Layer::Line(ages), Layer::Points(refused)) =
            (&chart.layers[0].layer, &chart.layers[1].layer)
        else {
            panic!("other layers")
        };
        assert_eq!(ages[0], [(2.1, 2.1)]);
        assert_eq!(refused, &[(1.1, 0.0)]);
    }

    #[test]
    fn an_operation_is_drawn_with_the_moment_of_its_stop() {
        let mut run = run();
        run.folder.manifest.set_outcome(&Outcome::Stopped("stage: drive in fault".to_owned()));
        run.motion.measured.insertion = vec![(8.5, 1.0), (8.9, 1.4), (9.1, 1.5)];
        let titles: Vec<_> = curves(&run, &Limits::new()).iter().map(|c| c.title).collect();
        assert!(titles.contains(&"Motion of the insertion"), "{titles:?}");
        assert!(!titles.contains(&"Motion of the rotation"), "{titles:?}");
        let chart = motion(&run, Axis::Insertion);
        let Layer::Points(stopped) = &chart.layers[2].layer else { panic!("another layer") };
        assert_eq!(stopped, &[(8.9, 1.4)]);
    }

    /// The run is stopped at 9 s at 3.5 mm depth; the last accepted position came at 2 s.
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
        let chart = tip_age(&run, &Limits::new());
        let Layer::Line(ages) = &chart.layers[0].layer else { panic!("another layer") };
        assert_eq!(ages[0], [(2.0, 1.0), (9.0, 7.0), (10.0, 8.0)]);
        let chart = blind_depth(&run, &Limits::new());
        let Layer::Line(blind) = &chart.layers[0].layer else { panic!("another layer") };
        assert_eq!(blind[0], [(9.0, 3.5), (10.0, 3.5)], "seen at 0 mm, stopped at 3.5");
        let chart = insertion(&run, &Limits::new());
        let Layer::Line(depths) = &chart.layers[1].layer else { panic!("another layer") };
        assert_eq!(depths[0].last(), Some(&(9.0, 3.5)));
    }
}
