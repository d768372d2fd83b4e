//! What moves in the 3-D view: the tips, their trails and the measured points.

use super::index::{Index, Moment};
use super::palette::{ESTIMATE, MEASURED, TRUTH};
use super::scene::{PLANE, quaternion};
use super::trail::Trail;
use crate::emulator::Truth;
use crate::geometry::Pose;
use crate::session::StepRecord;
use nalgebra::Vector3;
use rerun::{
    Arrows3D, Color, LineStrip3D, LineStrips3D, Points3D, RecordingStream, RecordingStreamResult,
    Transform3D,
};

/// Length of the arrows at a tip, mm.
const ARROW_MM: f32 = 12.0;

/// The moving part of the 3-D view.
pub(super) struct Space {
    estimate: Tip,
    truth: Tip,
    measured: Trail,
    measured_shown: bool,
}

impl Space {
    pub(super) fn new() -> Self {
        Space {
            estimate: Tip::new("estimate", ESTIMATE),
            truth: Tip::new("true", TRUTH),
            measured: Trail::default(),
            measured_shown: false,
        }
    }

    pub(super) fn push(&mut self, moment: Moment, step: &StepRecord, truth: Option<&Truth>) {
        if let Some(estimate) = &step.estimate {
            self.estimate.push(moment, &estimate.x_pb);
        }
        if let Some(truth) = truth {
            self.truth.push(moment, truth.x_pb());
        }
        if let Some(tip_meas_mm) = &step.tip_meas_mm {
            self.measured.push(moment, tip_meas_mm);
        }
    }

    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        self.truth.send(stream)?;
        self.estimate.send(stream)?;
        let (index, clouds) = self.measured.take_updates();
        if index.len() == 0 {
            return Ok(());
        }
        let path = format!("{PLANE}/path/measured");
        if !self.measured_shown {
            let style = Points3D::update_fields().with_colors([MEASURED]).with_radii([0.5]);
            stream.log_static(path.as_str(), &style)?;
            self.measured_shown = true;
        }
        let lengths: Vec<usize> = clouds.iter().map(Vec::len).collect();
        let columns = Points3D::new(clouds.into_iter().flatten()).columns(lengths)?;
        stream.send_columns(path.as_str(), index.columns(), columns)
    }
}

/// A tip's frame, with one arrow along its axis and one to the side where it bends, and its trail.
struct Tip {
    tip_path: String,
    trail_path: String,
    colour: Color,
    shown: bool,
    index: Index,
    poses: Vec<Pose>,
    trail: Trail,
}

impl Tip {
    fn new(provenance: &str, colour: Color) -> Self {
        Tip {
            tip_path: format!("{PLANE}/tip/{provenance}"),
            trail_path: format!("{PLANE}/path/{provenance}"),
            colour,
            shown: false,
            index: Index::default(),
            poses: Vec::new(),
            trail: Trail::default(),
        }
    }

    fn push(&mut self, moment: Moment, x_pb: &Pose) {
        if x_pb.is_finite() {
            self.index.push(moment);
            self.poses.push(*x_pb);
            self.trail.push(moment, &x_pb.translation);
        }
    }

    fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        if self.index.len() == 0 {
            return Ok(());
        }
        if !self.shown {
            self.log_style(stream)?;
            self.shown = true;
        }
        let poses = std::mem::take(&mut self.poses);
        let position = |pose: &Pose| -> [f32; 3] { pose.translation.cast::<f32>().into() };
        let transforms = Transform3D::update_fields()
            .with_many_translation(poses.iter().map(position))
            .with_many_quaternion(poses.iter().map(quaternion));
        let columns = transforms.columns_of_unit_batches()?;
        stream.send_columns(self.tip_path.as_str(), self.index.columns(), columns)?;
        self.index.clear();
        let (index, trails) = self.trail.take_updates();
        let strips = LineStrips3D::new(trails.iter().map(LineStrip3D::from_iter));
        let columns = strips.columns_of_unit_batches()?;
        stream.send_columns(self.trail_path.as_str(), index.columns(), columns)
    }

    /// The bevel bends the tip towards −y of its own frame (paper Eq. 1: `p'' = −κ R e₂`).
    fn log_style(&self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let arrows = [Vector3::z(), -Vector3::y() * 0.7]
            .map(|direction: Vector3<f32>| <[f32; 3]>::from(direction * ARROW_MM));
        stream.log_static(
            self.tip_path.as_str(),
            &Arrows3D::from_vectors(arrows).with_colors([self.colour]).with_radii([0.5]),
        )?;
        let style = LineStrips3D::update_fields().with_colors([self.colour]).with_radii([0.4]);
        stream.log_static(self.trail_path.as_str(), &style)
    }
}
