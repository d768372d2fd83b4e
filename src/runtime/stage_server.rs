//! Serves the virtual stage in real time: frames on a CAN bus, tip positions over TCP.

use super::interrupt::Interrupt;
use super::timing::Clock;
use crate::canopen::Frame;
use crate::emulator::fault::{Fault, FaultKind};
use crate::emulator::{StageOutput, TrackedTip, Truth, VirtualStage};
use crate::geometry::FixedAngles;
use crate::session::Direction;
use crate::tracker::openigtlink::{Body, IgtlStamp, Message};
use crate::transport::can::{BusError, BusEvent, CanBus, CanError};
use crate::transport::tcp::TransformServer;
use crate::units::Time;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, UNIX_EPOCH};
use tokio::runtime::Runtime;

/// Longest single wait on the bus, so that an interrupt is noticed.
const WAIT_MAX: Duration = Duration::from_millis(50);

/// A tracker server: sends tracked tips to every client as OpenIGTLink TRANSFORM messages.
#[derive(Debug)]
pub struct TipServer {
    server: TransformServer,
    tool: String,
    target: Option<String>,
    clock: Clock,
    truth: Option<BufWriter<File>>,
}

impl TipServer {
    /// Listens at `address` and names the tip `tool`, the target `target`. The true pose of each tracked tip
    /// goes to the new CSV file `truth`.
    ///
    /// # Errors
    /// The address cannot be bound, or the file cannot be made.
    pub fn bind(
        runtime: &Runtime,
        address: &str,
        tool: &str,
        target: Option<String>,
        clock: Clock,
        truth: Option<&Path>,
    ) -> Result<Self, String> {
        let server = runtime.block_on(TransformServer::bind(address));
        let server = server.map_err(|error| format!("tracker server at {address}: {error}"))?;
        let truth = truth.map(|path| {
            let file = truth_file(path);
            file.map_err(|error| format!("truth file {}: {error}", path.display()))
        });
        let truth = truth.transpose()?;
        Ok(TipServer { server, tool: tool.to_owned(), target, clock, truth })
    }

    /// The address that it listens on.
    pub fn local_addr(&self) -> SocketAddr {
        self.server.local_addr()
    }

    /// Sends a tracked tip or target to every client, as a tool of this name.
    fn send(&self, tool: &str, tip: &TrackedTip) {
        // Column by column: the rotation, then the translation.
        let columns = tip.x_ts.rotation.matrix().iter().chain(&tip.x_ts.translation);
        let mut elements = [0.0; 12];
        elements.iter_mut().zip(columns).for_each(|(to, from)| *to = *from as f32);
        let origin = self.clock.origin_utc().duration_since(UNIX_EPOCH).unwrap_or_default();
        let origin_ns = i64::try_from(origin.as_nanos()).unwrap_or(0);
        let stamp = IgtlStamp::from_unix_ns(origin_ns + tip.acquisition_time.as_nanos());
        self.server.send(&Message::new(tool, stamp, Body::Transform(elements)));
    }

    fn send_tip(&mut self, tip: &TrackedTip, truth: &Truth) -> io::Result<()> {
        self.send(&self.tool, tip);
        if let Some(file) = &mut self.truth {
            let p = truth.x_pb.translation;
            let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(&truth.x_pb.rotation);
            let time_s = tip.acquisition_time.as_secs_f64();
            writeln!(file, "{time_s},{},{},{},{yaw},{pitch},{roll}", p.x, p.y, p.z)?;
        }
        Ok(())
    }
}

/// A new file for the true poses, with its header.
fn truth_file(path: &Path) -> io::Result<BufWriter<File>> {
    let mut file = BufWriter::new(File::create_new(path)?);
    writeln!(
        file,
        "time_s,x_true_mm,y_true_mm,z_true_mm,yaw_true_rad,pitch_true_rad,roll_true_rad"
    )?;
    Ok(file)
}

/// Logs a scripted fault that begins. Bus off is put on the bus as an error frame, which every program on it
/// receives. Other bus faults need no action here: an interface is taken down by hand, `ip link set … down`.
fn begin_fault(fault: &Fault, bus: &mut dyn CanBus) {
    tracing::warn!("emulated fault: {fault}");
    if fault.kind == FaultKind::BusOff
        && let Err(error) = bus.report(&BusError::bus_off())
    {
        tracing::warn!("{error}");
    }
}

/// Serves the stage on `bus` until `until`, or until `interrupt` is raised. A frame that the bus refuses is
/// lost, as a real drive's would be. An interface that goes down is like a pulled cable: the drives continue by
/// themselves. `log` is called with every frame that was sent or received.
///
/// # Errors
/// The bus is gone, or the truth file cannot be written.
pub fn serve_stage(
    mut stage: VirtualStage,
    bus: &mut dyn CanBus,
    mut tips: TipServer,
    until: Option<Time>,
    interrupt: &Interrupt,
    mut log: impl FnMut(Direction, &Frame),
) -> Result<(), String> {
    let clock = tips.clock;
    while !interrupt.is_raised() && until.is_none_or(|until| clock.now() < until) {
        while let Some(output) = stage.poll() {
            match output {
                StageOutput::Frame(frame) => match bus.send(&frame) {
                    Ok(()) => log(Direction::Sent, &frame),
                    Err(error) => tracing::warn!("{error}"),
                },
                StageOutput::Tip { tip, truth } => {
                    tips.send_tip(&tip, &truth).map_err(|error| format!("truth file: {error}"))?
                }
                StageOutput::Target(target) => {
                    tips.target.iter().for_each(|tool| tips.send(tool, &target));
                }
                StageOutput::FaultBegan(fault) => begin_fault(&fault, bus),
            }
        }
        let (now, deadline) = (clock.now(), stage.deadline());
        if now >= deadline {
            stage.handle_timeout(now);
            continue;
        }
        match bus.receive(deadline.since(now).min(WAIT_MAX)) {
            Ok(Some(BusEvent::Frame(frame))) => {
                log(Direction::Received, &frame);
                stage.handle_frame(clock.now(), &frame);
            }
            Ok(Some(BusEvent::Error(error))) => tracing::warn!("{error}"),
            Ok(None) => {}
            Err(error @ CanError::Down { .. }) => tracing::warn!("{error}"),
            Err(error) => return Err(error.to_string()),
        }
    }
    tips.truth.as_mut().map_or(Ok(()), Write::flush).map_err(|error| format!("truth file: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::Scratch;

    #[test]
    fn an_existing_truth_file_is_refused_and_kept() {
        let scratch = Scratch::new("truth");
        let path = scratch.0.join("truth.csv");
        std::fs::write(&path, "kept").unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let clock = Clock::start();
        let server = TipServer::bind(&runtime, "127.0.0.1:0", "Needle", None, clock, Some(&path));
        let said = server.err().unwrap();
        assert_eq!(said, format!("truth file {}: File exists (os error 17)", path.display()));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "kept");
    }
}
