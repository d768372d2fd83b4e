//! The charts of a run.

use super::chart::{
    COMMANDED, COORDINATES, Chart, ESTIMATE, FAULT, Layer, MEASURED, Points, Shape, TRUTH,
    VALUE_MAX,
};
use crate::archive::RunOutcome;
use crate::review::figures::{BLIND_DEPTH, Limits, OFF_PLANE, TARGET_DEPTH, TIP_AGE};
use crate::review::run::Run;
use crate::stage::Axis;
use crate::units::wrap_angle;

const DEPTH: &str = "depth (mm)";
const TIME: &str = "time (s)";

/// A column of `steps.csv`; unknown values are `None`.
type Column = Vec<Option<f64>>;

/// The charts of `run` that have a curve.
pub(super) fn curves(run: &Run, limits: &Limits) -> Vec<Chart> {
    let roll = tip(run, "roll", "Roll: where the bevel looks", "roll (deg)");
    let (position, angles) = (["x", "y", "z"], ["yaw", "pitch", "roll"]);
    let mut charts = vec![
        off_plane(run, limits),
        tip(run, "y", "Tip in the plane, across the start", "y (mm)"),
        tip(run, "pitch", "Pitch: the heading out of the plane", "pitch (deg)"),
        Chart { span: Some((-180.0, 180.0)), ..roll },
        errors(run, "Errors of the estimated position", "estimate − truth (mm)", position),
        errors(run, "Errors of the estimated angles", "estimate − truth (deg)", angles),
        residuals(run),
        turning_of_base(run),
        rotation_of_base(run),
        target_error(run, limits),
        path_left(run),
        insertion(run, limits),
        tip_age(run, limits),
        blind_depth(run, limits),
    ];
    if run.folder.manifest.operation.is_some() {
        charts.push(motion(run, Axis::Insertion, "Motion of the insertion", "position (mm)"));
        charts.push(motion(run, Axis::Rotation, "Motion of the rotation", "position (deg)"));
    }
    charts.retain(Chart::has_curve);
    charts
}

/// A tip coordinate over depth: measured, estimated with its band of ± 2 standard deviations, true.
fn tip(run: &Run, name: &str, title: &'static str, y: &'static str) -> Chart {
    let depth = depth(run);
    let of = |provenance| coordinate(run, name, provenance);
    let (estimate, jump) = (of("est"), jump(name));
    let layers = vec![
        band("estimate ± 2 σ", &depth, &estimate, &of("sd"), jump, f64::NEG_INFINITY),
        dots("measured", MEASURED, points(&measured_depth(run), &of("meas"))),
        Layer::new("estimate", ESTIMATE, Shape::Broad, pieces(&depth, &estimate, jump)),
        Layer::new("truth", TRUTH, Shape::Line, pieces(&depth, &of("true"), jump)),
    ];
    Chart::new(title, DEPTH, y, layers)
}

fn off_plane(run: &Run, limits: &Limits) -> Chart {
    let mut chart = tip(run, "x", "Distance from the plane", "x (mm)");
    if let Some(off_plane_mm) = limits.get(OFF_PLANE) {
        chart.layers.push(Layer::level("1 mm off the plane", *off_plane_mm));
        chart.layers.push(Layer::level("", -off_plane_mm));
    }
    chart
}

/// The predicted distance from the target at the end of the path, with a band of ± 2 standard deviations.
fn target_error(run: &Run, limits: &Limits) -> Chart {
    let (depth, error) = (depth(run), column(run, "target_error_pred_mm"));
    let sd = column(run, "target_error_pred_sd_mm");
    let mut layers = vec![
        band("prediction ± 2 σ", &depth, &error, &sd, f64::INFINITY, 0.0),
        line("prediction", ESTIMATE, points(&depth, &error)),
    ];
    layers.extend(limits.get("target_error_mm").map(|mm| Layer::level("goal.tolerance_mm", *mm)));
    Chart::new("Predicted error at the target", DEPTH, "error (mm)", layers)
}

/// How far the target is, and how long the way there.
fn path_left(run: &Run) -> Chart {
    let depth = depth(run);
    let of = |name| points(&depth, &column(run, name));
    let layers = vec![
        line("planned path", COMMANDED, of("path_left_mm")),
        line("estimated distance", ESTIMATE, of("target_distance_mm")),
    ];
    Chart::new("Way to the target", DEPTH, "length (mm)", layers)
}

/// Errors of the estimate over depth. The large errors at the start do not widen the y axis.
fn errors(run: &Run, title: &'static str, y: &'static str, names: [&'static str; 3]) -> Chart {
    let depth = depth(run);
    let layers = names.into_iter().zip(COORDINATES).map(|(name, colour)| {
        let mut error = difference(&coordinate(run, name, "est"), &coordinate(run, name, "true"));
        if is_angle(name) {
            error = scaled(error, |deg| wrap_angle(deg.to_radians()).to_degrees());
        }
        Layer::new(name, colour, Shape::Line, pieces(&depth, &error, jump(name)))
    });
    let mut chart = Chart::new(title, DEPTH, y, layers.collect());
    chart.span = chart.span_from(depth.iter().flatten().fold(0.0, |a, b| b.max(a)) / 3.0);
    if chart.span.is_some() {
        chart.x = "depth (mm); the axis spans the errors from a third of it on";
    }
    chart
}

/// The residuals after the correction, at the depths at which the positions were acquired; the innovations are
/// in `run.rrd`.
fn residuals(run: &Run) -> Chart {
    let layers = ["x", "y", "z"].into_iter().zip(COORDINATES).map(|(name, colour)| {
        let measured = points(&measured_depth(run), &coordinate(run, name, "meas"));
        let estimate = points(&depth(run), &coordinate(run, name, "est"));
        let residuals = measured.into_iter();
        let residuals = residuals.filter_map(|(mm, y)| Some((mm, y - at_depth(&estimate, mm)?)));
        dots(name, colour, residuals.collect())
    });
    let (title, y) = ("Measured tip less the estimate", "measured − estimate (mm)");
    Chart::new(title, DEPTH, y, layers.collect())
}

fn turning_of_base(run: &Run) -> Chart {
    let turning = scaled(run.steps.column("rotation_cmd_rad_per_mm"), f64::to_degrees);
    let turning = points(&depth(run), &turning);
    let layers = vec![line("commanded for the next step", COMMANDED, turning)];
    Chart::new("Turning of the base", DEPTH, "turning (deg/mm)", layers)
}

fn rotation_of_base(run: &Run) -> Chart {
    let rotation = scaled(run.steps.column("rotation_rad"), f64::to_degrees);
    let layers = vec![line("stage, measured", MEASURED, points(&depth(run), &rotation))];
    Chart::new("Rotation of the base", DEPTH, "rotation (deg)", layers)
}

/// Depth over time, with the holds, to the last step or to the point where the run was stopped.
fn insertion(run: &Run, limits: &Limits) -> Chart {
    let steps = points(&column(run, "time_s"), &depth(run));
    let (last, depth_mm) = (steps.last().copied(), run.depth_over_time());
    let end_s = last.map_or(0.0, |(last_s, _)| run.stop_time_s().unwrap_or(last_s).max(last_s));
    let times = run.motion.measured.insertion.iter().map(|(time_s, _)| *time_s);
    let times = times.take_while(|time_s| *time_s <= end_s).chain([end_s]);
    let course = times.filter_map(|time_s| Some((time_s, depth_mm(time_s)?)));
    let course = course.filter(|(_, mm)| mm.abs() < VALUE_MAX).collect();
    let held = run.held();
    let mut layers =
        vec![Layer::intervals("held", held), line("stage, measured", MEASURED, course)];
    if run.folder.manifest.outcome == Some(RunOutcome::Stopped) {
        layers.push(dots("last step", FAULT, last.into_iter().collect()));
    }
    layers.extend(limits.get(TARGET_DEPTH).map(|mm| Layer::level("depth to reach", *mm)));
    Chart::new("Insertion", TIME, "depth (mm)", layers)
}

/// The commanded and the measured position of an axis in an operation.
fn motion(run: &Run, axis: Axis, title: &'static str, y: &'static str) -> Chart {
    let (commanded, measured) = (&run.motion.commanded[axis], &run.motion.measured[axis]);
    let mut layers = vec![
        line("stage, commanded", COMMANDED, commanded.clone()),
        line("stage, measured", MEASURED, measured.clone()),
    ];
    if let Some(stop_s) = run.stop_time_s() {
        let stopped = measured.iter().rfind(|(time_s, _)| *time_s <= stop_s).copied();
        layers.push(dots("stopped", FAULT, stopped.into_iter().collect()));
    }
    Chart::new(title, TIME, y, layers)
}

/// For each accepted tip position, and for the stop of the run: its time, and when the newest position before
/// it was acquired, s. The stop is included because no position follows the hold that ended a run.
fn newest_before(run: &Run) -> Points {
    let s = |ns: i64| ns as f64 * 1e-9;
    let accepted = run.samples.iter().filter_map(|sample| {
        Some((s(sample.receive_time_ns), Some(s(sample.acquisition_time_ns?))))
    });
    let stop = run.stop_time_s().map(|stop_s| (stop_s, None));
    let mut times: Vec<(f64, Option<f64>)> = accepted.chain(stop).collect();
    times.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    let mut newest = None::<f64>;
    let pairs = times.into_iter().filter_map(|(time_s, acquired_s)| {
        let before_s = newest;
        newest = newest.into_iter().chain(acquired_s).reduce(f64::max);
        Some((time_s, before_s?))
    });
    pairs.collect()
}

/// The age of the newest accepted tip position when the next one came; a large age causes a hold.
fn tip_age(run: &Run, limits: &Limits) -> Chart {
    let refused = run.samples.iter().filter(|sample| sample.refused.is_some());
    let refused = refused.map(|sample| (sample.receive_time_ns as f64 * 1e-9, 0.0)).collect();
    let ages = newest_before(run).into_iter();
    let ages = ages.map(|(time_s, acquired_s)| (time_s, time_s - acquired_s)).collect();
    let mut layers =
        vec![line("age when the next came", MEASURED, ages), dots("refused", FAULT, refused)];
    layers.extend(limits.get(TIP_AGE).map(|age_s| Layer::level("held when older", *age_s)));
    Chart::new("Age of the newest tip position", TIME, "age (s)", layers)
}

/// The depth inserted since the newest accepted tip position, when the next one came.
fn blind_depth(run: &Run, limits: &Limits) -> Chart {
    let depth_mm = run.depth_over_time();
    let blind_mm = |time_s, acquired_s| Some(depth_mm(time_s)? - depth_mm(acquired_s)?);
    let blind = newest_before(run)
        .into_iter()
        .filter_map(|(time_s, acquired_s)| Some((time_s, blind_mm(time_s, acquired_s)?)))
        .filter(|(_, mm)| mm.abs() < VALUE_MAX);
    let mut layers = vec![line("inserted when the next came", MEASURED, blind.collect())];
    layers.extend(limits.get(BLIND_DEPTH).map(|mm| Layer::level("held before", *mm)));
    let title = "Inserted since the newest tip position";
    Chart::new(title, TIME, "blind depth (mm)", layers)
}

fn line(name: &'static str, colour: &'static str, points: Points) -> Layer {
    Layer::new(name, colour, Shape::Line, vec![points])
}

fn dots(name: &'static str, colour: &'static str, points: Points) -> Layer {
    Layer::new(name, colour, Shape::Points, vec![points])
}

/// The band of ± 2 standard deviations around the estimate, in the same pieces as its line.
fn band(
    name: &'static str,
    depth: &Column,
    est: &Column,
    sd: &Column,
    jump: f64,
    least: f64,
) -> Layer {
    let known = depth.iter().zip(est).zip(sd);
    let known = known.filter_map(|((x, y), sd)| Some(((*x)?, (*y)?, *sd)));
    let known: Vec<(f64, f64, Option<f64>)> = known.collect();
    let outline = |piece: &[(f64, f64, Option<f64>)]| {
        let edge = |sign: f64| {
            let edge = piece
                .iter()
                .filter_map(|(x, y, sd)| Some((*x, (y + sign * 2.0 * (*sd)?).max(least))));
            edge.collect::<Points>()
        };
        edge(-1.0).into_iter().chain(edge(1.0).into_iter().rev()).collect()
    };
    let pieces = known.chunk_by(|(_, a, _), (_, b, _)| (b - a).abs() <= jump).map(outline);
    Layer::new(name, ESTIMATE, Shape::Area, pieces.collect())
}

fn depth(run: &Run) -> Column {
    column(run, "insertion_mm")
}

/// The depth at which the position of each step was acquired; in an older record, which lacks it, the step's depth.
fn measured_depth(run: &Run) -> Column {
    let acquired = column(run, "tip_meas_insertion_mm");
    acquired.into_iter().zip(depth(run)).map(|(acquired, depth)| acquired.or(depth)).collect()
}

/// The value at `depth_mm`, linear between two points; `None` outside them.
fn at_depth(points: &Points, depth_mm: f64) -> Option<f64> {
    let (from_mm, from) = *points.iter().rfind(|(mm, _)| *mm <= depth_mm)?;
    let (to_mm, to) = *points.iter().find(|(mm, _)| *mm >= depth_mm)?;
    match to_mm > from_mm {
        true => Some(from + (to - from) * (depth_mm - from_mm) / (to_mm - from_mm)),
        false => Some(from),
    }
}

/// The column of this name, without values too large for an axis.
fn column(run: &Run, name: &str) -> Column {
    scaled(run.steps.column(name), |value| value)
}

fn is_angle(name: &str) -> bool {
    ["yaw", "pitch", "roll"].contains(&name)
}

/// The step of a line from which on it counts as a turn past ± 180 degrees.
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

/// The points whose coordinates are both known.
fn points(xs: &Column, ys: &Column) -> Points {
    xs.iter().zip(ys).filter_map(|(x, y)| x.zip(*y)).collect()
}

/// The points whose coordinates are both known, in pieces that end where a step exceeds `jump` (an angle passed
/// ±180°).
fn pieces(xs: &Column, ys: &Column, jump: f64) -> Vec<Points> {
    let points = points(xs, ys);
    let is_joined = |a: &(f64, f64), b: &(f64, f64)| (b.1 - a.1).abs() <= jump;
    points.chunk_by(is_joined).map(<[_]>::to_vec).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::{StepsTable, TrackerTimes};
    use crate::review::run::tests::run;
    use crate::session::Outcome;

    #[test]
    fn a_curve_breaks_where_its_angle_wraps() {
        let xs = (0..4).map(|x| Some(f64::from(x))).collect();
        let pieces = pieces(&xs, &vec![Some(170.0), Some(-175.0), None, Some(-160.0)], 180.0);
        assert_eq!(pieces, [vec![(0.0, 170.0)], vec![(1.0, -175.0), (3.0, -160.0)]]);
    }

    #[test]
    fn curves_without_data_are_not_drawn() {
        let limits = run().folder.limits().unwrap();
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
        let [outline] = &chart.layers[0].pieces[..] else { panic!("one band") };
        assert_eq!(outline.len(), 8);
        let (low, high) = (outline[1], outline[6]);
        assert_eq!((low.0, high.0), (1.0, 1.0));
        assert!((low.1 - 0.35).abs() < 1e-12 && (high.1 - 1.15).abs() < 1e-12, "{outline:?}");
    }

    /// The position of each step was acquired 0.25 mm before it, where z is as estimated. An older record does not
    /// say so.
    #[test]
    fn a_measured_tip_is_compared_with_the_estimate_at_its_own_depth() {
        let residual_z = |acquired: fn(f64) -> String| {
            let mut run = run();
            let mut csv = "insertion_mm,z_meas_mm,z_est_mm,tip_meas_insertion_mm\n".to_owned();
            for mm in [1.0, 2.0, 3.0] {
                csv += &format!("{mm},{},{mm},{}\n", mm - 0.25, acquired(mm));
            }
            run.steps = StepsTable::parse(&csv).unwrap();
            residuals(&run).layers[2].pieces.clone()
        };
        let known = residual_z(|mm| format!("{}", mm - 0.25));
        assert_eq!(known, [[(1.75, 0.0), (2.75, 0.0)]], "no estimate is known at 0.75 mm");
        assert_eq!(residual_z(|_| String::new()), [[(1.0, -0.25), (2.0, -0.25), (3.0, -0.25)]]);
    }

    /// Samples are acquired at 0, 1 and 2 s and received 0.1 s later; the one in between is
    /// refused.
    #[test]
    fn the_age_is_that_of_the_previous_accepted_position() {
        let mut run = run();
        let at = |ms: i64, refused: bool| TrackerTimes {
            tool: "NeedleToTracker".to_owned(),
            receive_time_ns: (ms + 100) * 1_000_000,
            acquisition_time_ns: (!refused).then_some(ms * 1_000_000),
            refused: refused.then(|| "zero".to_owned()),
        };
        run.samples = vec![at(0, false), at(1000, true), at(2000, false)];
        let chart = tip_age(&run, &Limits::new());
        assert_eq!(chart.layers[0].pieces, [[(2.1, 2.1)]]);
        assert_eq!(chart.layers[1].pieces, [[(1.1, 0.0)]]);
    }

    #[test]
    fn an_operation_is_drawn_with_the_moment_of_its_stop() {
        let mut run = run();
        run.folder.manifest.set_outcome(&Outcome::Stopped("stage: drive in fault".to_owned()));
        run.folder.manifest.operation = Some("jog".to_owned());
        run.motion.measured.insertion = vec![(8.5, 1.0), (8.9, 1.4), (9.1, 1.5)];
        let titles: Vec<_> = curves(&run, &Limits::new()).iter().map(|c| c.title).collect();
        assert!(titles.contains(&"Motion of the insertion"), "{titles:?}");
        assert!(!titles.contains(&"Motion of the rotation"), "{titles:?}");
        let chart = motion(&run, Axis::Insertion, "title", "position (mm)");
        assert_eq!(chart.layers[2].pieces, [[(8.9, 1.4)]]);
    }

    /// The run stops at 9 s in 3.5 mm; the last accepted position came at 2 s.
    #[test]
    fn the_hold_that_stopped_a_run_is_in_its_curves() {
        let mut run = run();
        run.folder.manifest.set_outcome(&Outcome::Stopped("tracker: no tip".to_owned()));
        run.motion.measured.insertion = vec![(2.0, 10.0), (5.0, 13.0), (9.0, 13.5)];
        let at = |ms: i64, refused: Option<String>| TrackerTimes {
            tool: "NeedleToTracker".to_owned(),
            receive_time_ns: ms * 1_000_000,
            acquisition_time_ns: refused.is_none().then_some(ms * 1_000_000),
            refused,
        };
        run.samples = vec![at(1000, None), at(2000, None), at(8000, Some("step".to_owned()))];
        run.samples.push(at(10_000, None));
        let chart = tip_age(&run, &Limits::new());
        assert_eq!(chart.layers[0].pieces, [[(2.0, 1.0), (9.0, 7.0), (10.0, 8.0)]]);
        let chart = blind_depth(&run, &Limits::new());
        let blind = &chart.layers[0].pieces;
        assert_eq!(blind, &[[(9.0, 3.5), (10.0, 3.5)]], "last position at 0 mm, stop at 3.5 mm");
        let chart = insertion(&run, &Limits::new());
        assert_eq!(chart.layers[1].pieces[0].last(), Some(&(9.0, 3.5)));
    }
}
