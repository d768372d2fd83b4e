//! `needle-bench plan`: the way to the target, without a stage.

use super::arguments::Configured;
use super::output::{give, refuse_existing, write_new};
use super::{Failure, STOPPED, ended};
use crate::config::PoseConfig;
use crate::geometry::FixedAngles;
use crate::plan::{
    Answer, Mask, Obstacle, Problem, Status, Tip, World, plan as solve, plan_with_reserve,
};
use crate::text::screen;
use clap::Args;
use flate2::CrcReader;
use flate2::read::MultiGzDecoder;
use minijinja::context;
use nalgebra::{Matrix3, Rotation3, Vector3};
use nifti::{NiftiError, NiftiHeader, NiftiObject, RandomAccessNiftiVolume, ReaderOptions};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::fmt::Display;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Distance between two rows of `path`, mm.
const ROW_MM: f64 = 0.5;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Draw the plan into a new SVG file.
    #[arg(long, value_name = "FILE.svg", value_parser = svg_file)]
    out: Option<PathBuf>,
}

pub(super) fn plan(arguments: &Arguments) -> Result<(), Failure> {
    refuse_existing(arguments.out.as_deref())?;
    let (config, _) = arguments.configured.load_with_warnings()?;
    let (world, problem) = config.to_plan(&mask_reader(arguments.configured.path()))?;
    let begun = Instant::now();
    let mut answer = solve(&world, &problem);
    let seconds = begun.elapsed().as_secs_f64();
    let roomy = plan_with_reserve(&world, &problem, config.goal.reserve_mm, &answer);
    // A path that no run may take is no plan.
    if let (Status::Plan, Err(refusal)) = (answer.status, &roomy) {
        (answer.status, answer.reason) = (Status::None, Some(refusal.clone()));
    }
    let mut object = to_json(&world, &problem, &answer, seconds);
    let reserve_mm = roomy.as_ref().ok().filter(|_| !world.obstacles.is_empty());
    object["run_reserve_mm"] = json!(reserve_mm.map(|roomy| roomy.reserve_mm));
    object["run_refusal"] = json!(roomy.err());
    object["curvature_margin"] = json!(config.goal.curvature_margin());
    if let Some(path) = &arguments.out {
        write_new(path, &picture(&world, &problem, &answer)?)?;
    }
    let text = || screen(include_str!("plan.txt"), &object, context! {});
    give(arguments.json, &object, text)?;
    ended(match answer.status {
        Status::Plan => 0,
        Status::None | Status::Budget => STOPPED,
    })
}

/// The name of a picture, for clap.
fn svg_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().is_some_and(|extension| extension == "svg") {
        true => Ok(path),
        false => Err("the plan is drawn as SVG: a name that ends in .svg".to_owned()),
    }
}

/// Reads the masks that the configuration in `file` names. Their paths are relative to its folder.
pub(super) fn mask_reader(
    file: Option<&Path>,
) -> impl Fn(&str, Option<u32>, &PoseConfig) -> Result<Obstacle, String> + Sync {
    move |name, crc32, pose| {
        let path = file.map_or_else(|| PathBuf::from(name), |file| file.with_file_name(name));
        mask(&path, crc32, pose).map_err(|error| format!("{}: {error}", path.display()))
    }
}

/// The image in `path`, as an obstacle.
fn mask(path: &Path, crc32: Option<u32>, pose: &PoseConfig) -> Result<Obstacle, String> {
    check_regular(path).map_err(|error| error.to_string())?;
    let header = NiftiHeader::from_file(path).map_err(|error| reason(&error))?;
    // A record has one checksum for a mask, so the mask must be one file.
    if &header.magic != b"n+1\0" {
        return Err("its voxels are in another file (.img); write both as one .nii".to_owned());
    }
    let dim = header.dim().map_err(|error| reason(&error))?;
    let size: [usize; 3] = match dim {
        [x, y, z, rest @ ..] if rest.iter().all(|count| *count == 1) => {
            [*x, *y, *z].map(usize::from)
        }
        _ => return Err(format!("the mask has {} dimensions, allowed: 3", dim.len())),
    };
    if !is_upright(&header) {
        return Err("its header turns or mirrors the voxels; resample it along x, y, z".to_owned());
    }
    is_in_mm(&header)?;
    let [_, x, y, z, ..] = header.pixdim.map(f64::from);
    let spacing_mm = Vector3::new(x, y, z);
    let voxels = Mask::check(size, &spacing_mm)?;
    check_length(path, &header, voxels)?;
    let image = ReaderOptions::new().read_file(path).map_err(|error| reason(&error))?;
    let image = image.into_volume();
    let mut at = vec![0; dim.len()];
    let occupied = (0..voxels).map(|voxel| {
        let [nx, ny, _] = size;
        let indices = [voxel % nx, voxel / nx % ny, voxel / nx / ny];
        at.iter_mut().zip(indices).for_each(|(at, index)| *at = index as u16);
        // NaN is not 0: what is not known counts as part of the obstacle.
        image.get_f64(&at).map(|value| value != 0.0).map_err(|error| reason(&error))
    });
    let occupied: Vec<bool> = occupied.collect::<Result<_, _>>()?;
    let found = file_crc32(path).map_err(|error| error.to_string())?;
    if let Some(crc32) = crc32.filter(|crc32| *crc32 != found) {
        return Err(format!(
            "the mask has another content: its CRC-32 is {found:#010x}, crc32 says {crc32:#010x}; find \
             the file that was meant, or mend the key"
        ));
    }
    if !occupied.contains(&true) {
        return Err(
            "all of its voxels are 0, so it is no obstacle: is it the right label?".to_owned()
        );
    }
    Mask::new(size, spacing_mm, &occupied, &pose.to_pose()).map(Obstacle::Mask)
}

/// Refuses an image with bytes after its voxels: its header may belong to another image. A compressed image is
/// refused if its bytes are damaged.
fn check_length(path: &Path, header: &NiftiHeader, voxels: usize) -> Result<(), String> {
    let unreadable = |error: io::Error| reason(&NiftiError::Io(error));
    let file = File::open(path).map_err(unreadable)?;
    let is_compressed = path.extension().is_some_and(|extension| extension == "gz");
    let image: Box<dyn Read> =
        if is_compressed { Box::new(MultiGzDecoder::new(file)) } else { Box::new(file) };
    let bits = u64::try_from(header.bitpix).unwrap_or_default() * voxels as u64;
    let expected = f64::from(header.vox_offset) as u64 + bits / 8;
    // Not farther than is needed: a compressed file may be of any length.
    let length = io::copy(&mut image.take(expected + 1), &mut io::sink()).map_err(unreadable)?;
    match length > expected {
        true => Err(format!(
            "the mask goes on after the {voxels} voxels of its header: is it cut, or the header another's?"
        )),
        false => Ok(()),
    }
}

/// Refuses a pipe or a device, because reading it may never end.
fn check_regular(path: &Path) -> io::Result<()> {
    match std::fs::metadata(path) {
        Ok(found) if !found.is_file() => Err(io::Error::other("not a regular file")),
        // Whoever opens it says what is wrong with it.
        _ => Ok(()),
    }
}

/// The CRC-32 of the file in `path`, read in pieces: a file that is no mask may be of any size.
pub(super) fn file_crc32(path: &Path) -> io::Result<u32> {
    check_regular(path)?;
    let mut file = CrcReader::new(File::open(path)?);
    io::copy(&mut file, &mut io::sink())?;
    Ok(file.crc().sum())
}

/// Why an image cannot be read.
fn reason(error: &NiftiError) -> String {
    let error: &dyn Display = if let NiftiError::Io(error) = error { error } else { error };
    format!("no NIfTI image can be read: {error}")
}

/// The largest part of a voxel's side that may point along another axis.
const TURNED_MAX: f32 = 1e-3;

/// Whether the header neither turns nor mirrors the voxels: the pose alone places them.
fn is_upright(header: &NiftiHeader) -> bool {
    let [qfac, sides @ ..] = header.pixdim;
    if header.sform_code > 0 {
        let rows = [header.srow_x, header.srow_y, header.srow_z];
        (0..3).all(|i| {
            (0..3).all(|j| match i == j {
                true => rows[i][j] > 0.0,
                false => rows[i][j].abs() <= TURNED_MAX * sides[j].abs(),
            })
        })
    } else {
        let turned = [header.quatern_b, header.quatern_c, header.quatern_d];
        header.qform_code <= 0 || qfac >= 0.0 && turned.iter().all(|part| part.abs() <= TURNED_MAX)
    }
}

/// Refuses an image whose voxels may be of another size than `pixdim` in mm: an obstacle must not be taken for
/// smaller than it is.
fn is_in_mm(header: &NiftiHeader) -> Result<(), String> {
    // NIfTI-1, xyzt_units: the lowest three bits are the unit of space.
    let unit = match header.xyzt_units & 7 {
        0 | 2 => None,
        1 => Some("metres".to_owned()),
        3 => Some("micrometres".to_owned()),
        code => Some(format!("units of code {code}")),
    };
    if let Some(unit) = unit {
        return Err(format!("its header gives lengths in {unit}, allowed: mm (xyzt_units)"));
    }
    let [_, x, y, z, ..] = header.pixdim;
    let rows = [header.srow_x[0], header.srow_y[1], header.srow_z[2]];
    let differ = |(row, side): (&f32, &f32)| (row - side).abs() > TURNED_MAX * side.abs();
    if header.sform_code > 0 && rows.iter().zip(&[x, y, z]).any(differ) {
        let [a, b, c] = rows;
        return Err(format!(
            "its header gives voxels of two sizes, {x} x {y} x {z} mm (pixdim) and {a} x {b} x {c} mm \
             (srow); resample it, or mend the header"
        ));
    }
    Ok(())
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
            let arc = |(tip, arc): (Tip, crate::plan::Arc)| json!({
                "length_mm": arc.length_mm,
                "curvature_per_mm": arc.curvature_per_mm,
                "roll_deg": roll_rad(&tip, &arc.bend).to_degrees(),
            });
            path.pieces().map(arc).collect::<Vec<_>>()
        }),
    })
}

/// The roll with which the tip bends toward `bend`: an unturned tip bends toward its own -y.
fn roll_rad(tip: &Tip, bend: &Vector3<f64>) -> f64 {
    let y = -bend;
    let axes = Matrix3::from_columns(&[y.cross(&tip.heading), y, tip.heading]);
    let roll_rad = FixedAngles::from_rotation(&Rotation3::from_matrix_unchecked(axes)).roll;
    // Rounding must not turn half a turn into its negative.
    if roll_rad < -std::f64::consts::PI + 1e-9 { -roll_rad } else { roll_rad }
}

/// Points of the outline of a circle.
const CIRCLE_POINTS: u32 = 48;
/// The smallest side of the squares of which a mask is drawn, mm.
const MASK_STEP_MM: f64 = 2.0;

/// The plan as SVG: from the side, y over z, and from above, x over z.
fn picture(world: &World, problem: &Problem, answer: &Answer) -> Result<String, Failure> {
    let [min, max] = [world.workspace.min_mm, world.workspace.max_mm];
    let path = answer.path.as_ref();
    let points = path.map(|path| path.points_mm(ROW_MM)).unwrap_or_default();
    // z to the right, y or x up.
    let views = [1, 0].map(|up| {
        let place = |point: &Vector3<f64>| json!([point.z - min.z, max[up] - point[up]]);
        let outlines = world.obstacles.iter().flat_map(|obstacle| outlines(obstacle, up));
        json!({
            "axis": if up == 1 { "y" } else { "x" },
            "high_mm": max[up] - min[up],
            "obstacles": outlines
                .map(|outline| outline.iter().map(place).collect::<Vec<_>>())
                .collect::<Vec<_>>(),
            "path": points.iter().map(place).collect::<Vec<_>>(),
            "start": place(&problem.start.position_mm),
            "target": place(&problem.target_mm),
            "nearest": answer.nearest_mm.filter(|_| path.is_none()).as_ref().map(place),
        })
    });
    let object = json!({
        "views": views,
        "wide_mm": max.z - min.z,
        "tolerance_mm": problem.tolerance_mm,
        "status": answer.status.to_string(),
        "length_mm": path.map(|path| path.length_mm()),
    });
    screen(include_str!("plan.svg"), &object, context! {}).map_err(Failure::environment)
}

/// The outlines of an obstacle, seen along x (`up` is y) or along y (`up` is x).
fn outlines(obstacle: &Obstacle, up: usize) -> Vec<Vec<Vector3<f64>>> {
    let circle = |centre: &Vector3<f64>, radius_mm: f64, [first, second]: [Vector3<f64>; 2]| {
        let turn = |i| std::f64::consts::TAU * f64::from(i) / f64::from(CIRCLE_POINTS);
        let point = move |i| centre + (first * turn(i).cos() + second * turn(i).sin()) * radius_mm;
        (0..CIRCLE_POINTS).map(point).collect::<Vec<_>>()
    };
    let points = match obstacle {
        Obstacle::Sphere { centre_mm, radius_mm } => {
            circle(centre_mm, *radius_mm, [Vector3::z(), Vector3::ith(up, 1.0)])
        }
        Obstacle::Cylinder { from_mm, to_mm, radius_mm } => {
            let heading = (to_mm - from_mm).normalize();
            let across = Tip { position_mm: *from_mm, heading }.across();
            [from_mm, to_mm].map(|end| circle(end, *radius_mm, across)).concat()
        }
        Obstacle::Box { min_mm, max_mm } => {
            let corner =
                |i: usize| Vector3::from_fn(|axis, _| [min_mm, max_mm][i >> axis & 1][axis]);
            (0..8).map(corner).collect()
        }
        Obstacle::Mask(mask) => {
            let side_mm = MASK_STEP_MM.max(mask.spacing_mm().max());
            let square = |mm: f64| (mm / side_mm).floor() as i64;
            let squares: BTreeSet<_> =
                mask.occupied_mm().map(|at| (square(at.z), square(at[up]))).collect();
            let outline = |(z, v): (i64, i64)| {
                [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(dz, dv)| {
                    let mm = |index: i64| index as f64 * side_mm;
                    Vector3::z() * mm(z + dz) + Vector3::ith(up, mm(v + dv))
                })
            };
            return squares.into_iter().map(|square| outline(square).to_vec()).collect();
        }
    };
    vec![hull(points, up)]
}

/// The corners of the convex hull of `points` in z and the coordinate `up`, in order.
fn hull(mut points: Vec<Vector3<f64>>, up: usize) -> Vec<Vector3<f64>> {
    points.sort_by(|a, b| a.z.total_cmp(&b.z).then(a[up].total_cmp(&b[up])));
    let mut hull: Vec<Vector3<f64>> = Vec::new();
    let back: Vec<Vector3<f64>> = points.iter().rev().copied().collect();
    for half in [points, back] {
        let first = hull.len();
        for point in half {
            let is_inside = |hull: &[Vector3<f64>]| match hull[first..] {
                [.., a, b] => {
                    (b.z - a.z) * (point[up] - a[up]) <= (b[up] - a[up]) * (point.z - a.z)
                }
                _ => false,
            };
            while is_inside(&hull) {
                hull.pop();
            }
            hull.push(point);
        }
    }
    hull
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_or_pipe_in_place_of_a_mask_is_refused() {
        let pipe = std::env::temp_dir().join(format!("needle-mask-{}", std::process::id()));
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRUSR).expect("a pipe");
        for path in [Path::new("/dev/zero"), &pipe] {
            assert_eq!(file_crc32(path).unwrap_err().to_string(), "not a regular file");
            let read =
                mask_reader(None)(path.to_str().expect("text"), None, &PoseConfig::default());
            let error = read.expect_err("it is refused");
            assert!(error.ends_with(": not a regular file"), "{error}");
        }
        std::fs::remove_file(&pipe).expect("the pipe");
    }
}
