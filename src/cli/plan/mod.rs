//! `needle-bench plan`: plans the path to the target, without a stage.

mod picture;

use self::picture::picture;
use super::arguments::Configured;
use super::mask::{mask_reader, print_warning, warn_of_far_obstacles};
use super::output::{print_result_despite, refuse_unwritable, write_new};
use super::{Result, STOPPED, finish_with};
use crate::geometry::FixedAngles;
use crate::plan::{
    Answer, Arc, Obstacle, Problem, Status, Tip, World, plan as solve, plan_with_reserve,
};
use crate::text::screen;
use clap::Args;
use minijinja::context;
use nalgebra::{Matrix3, Rotation3, Vector3};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;

/// Distance between two rows of `path`, mm.
const ROW_MM: f64 = 0.5;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
    /// Draw the plan into a new SVG file.
    #[arg(long, value_name = "FILE.svg", value_parser = svg_file)]
    out: Option<PathBuf>,
}

pub(super) fn plan(arguments: &Arguments) -> Result<()> {
    refuse_unwritable(arguments.out.as_deref())?;
    let (config, _) = arguments.configured.load_with_warnings()?;
    let (world, problem) =
        config.to_plan(&mask_reader(arguments.configured.path(), print_warning))?;
    warn_of_far_obstacles(&world, problem.clearance_mm);
    let begun = Instant::now();
    let answer = solve(&world, &problem);
    let seconds = begun.elapsed().as_secs_f64();
    let run_path = config.check_wall(&world, &problem);
    let run_path = run_path
        .and_then(|()| plan_with_reserve(&world, &problem, config.goal.reserve_mm, &answer));
    let run_seconds = begun.elapsed().as_secs_f64() - seconds;
    let mut object = to_json(&world, &problem, &answer, seconds);
    let with_obstacles = run_path.as_ref().ok().filter(|_| !world.obstacles.is_empty());
    object["run_reserve_mm"] = json!(with_obstacles.map(|run_path| run_path.reserve_mm));
    object["run_seconds"] = json!(answer.path.as_ref().map(|_| run_seconds));
    object["run_refusal"] = json!(run_path.err());
    object["curvature_margin"] = json!(config.goal.curvature_margin());
    let drawn = match &arguments.out {
        Some(path) => write_new(path, &picture(&world, &problem, &answer)?),
        None => Ok(()),
    };
    let has_mask = world.obstacles.iter().any(|obstacle| matches!(obstacle, Obstacle::Mask(_)));
    let text = || screen(include_str!("plan.txt"), &object, context! { has_mask });
    print_result_despite(drawn, arguments.json, &object, text)?;
    finish_with(if answer.status == Status::Plan { 0 } else { STOPPED })
}

/// Parses the name of a picture, for clap.
fn svg_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("svg")) {
        true => Ok(path),
        false => Err("the plan is drawn as SVG: a name that ends in .svg".to_owned()),
    }
}

fn to_json(world: &World, problem: &Problem, answer: &Answer, seconds: f64) -> Value {
    let row = |point: &Vector3<f64>| json!([point.x, point.y, point.z]);
    let path = answer.path.as_ref();
    let clearance_mm = path.map(|path| path.distance_mm(world)).filter(|mm| mm.is_finite());
    let error_mm = path.map(|path| (path.end().position_mm - problem.target_mm).norm());
    let nearest = answer.nearest_mm.filter(|_| path.is_none());
    let resolution = answer.resolution;
    json!({
        "status": answer.status.to_string(),
        "reason": answer.reason,
        "length_mm": path.map(|path| path.length_mm()),
        "end_error_mm": error_mm,
        "clearance_mm": clearance_mm,
        "expansions": answer.expansions,
        "seconds": seconds,
        "start_mm": row(&problem.start.position_mm),
        "target_mm": row(&problem.target_mm),
        "nearest_mm": nearest.as_ref().map(row),
        "nearest_distance_mm": nearest.map(|point| (point - problem.target_mm).norm()),
        "resolution": {
            "step_mm": resolution.step_mm,
            "cell_mm": resolution.cell_mm,
            "heading_deg": resolution.heading_rad.to_degrees(),
        },
        "path": path.map(|path| path.points_mm(ROW_MM).iter().map(row).collect::<Vec<_>>()),
        "arcs": path.map(|path| {
            let arc = |(tip, arc): (Tip, Arc)| json!({
                "length_mm": arc.length_mm,
                "curvature_per_mm": arc.curvature_per_mm,
                "roll_deg": roll_rad(&tip, &arc.bend).to_degrees(),
            });
            path.pieces().map(arc).collect::<Vec<_>>()
        }),
    })
}

/// The roll at which the tip bends toward `bend`: a tip with roll 0 bends toward its own -y.
fn roll_rad(tip: &Tip, bend: &Vector3<f64>) -> f64 {
    let y = -bend;
    let axes = Matrix3::from_columns(&[y.cross(&tip.heading), y, tip.heading]);
    let roll_rad = FixedAngles::from_rotation(&Rotation3::from_matrix_unchecked(axes)).roll;
    // Rounding must not change 180 deg to -180 deg.
    if roll_rad < -std::f64::consts::PI + 1e-9 { -roll_rad } else { roll_rad }
}
