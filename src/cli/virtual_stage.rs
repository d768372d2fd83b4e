//! `vcan-stage`: the virtual stage on a CAN interface, with its tracker on TCP.

use super::arguments::{Configured, number_in};
use super::output::print_stderr;
use super::perform::open_bus;
use super::{Failure, Result, io_runtime};
use crate::archive::{CandumpLine, interface_name, unix_us};
use crate::canopen::Frame;
use crate::emulator::{VirtualStage, VirtualStageConfig};
use crate::runtime::{Clock, Interrupt, TipServer, serve_stage};
use crate::session::Direction;
use clap::Parser;
use std::fs::File;
use std::io::{LineWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

/// The default configuration.
const VCAN_TOML: (&str, &str) =
    ("bench-config/vcan.toml", include_str!("../../bench-config/vcan.toml"));

/// Two emulated CiA 402 drives on a CAN interface, a needle in tissue behind them, and an
/// OpenIGTLink tracker server in front. It runs until it is interrupted. It uses the sections can, stage, plane,
/// tracker, goal (a tracked target) and emulator of CONFIG, by default bench-config/vcan.toml.
#[derive(Debug, Parser)]
#[command(name = "vcan-stage", version)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// Write the true tip pose at each tracked position to this CSV file.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Write every frame sent and received to this file, in the format of candump -L -x.
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// Write the electronic data sheets of the two drives, insertion.eds and rotation.eds, to this
    /// folder and do nothing else.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["truth", "log", "seconds"])]
    write_eds: Option<PathBuf>,
    /// Stop after this many seconds.
    #[arg(long = "for", value_name = "SECONDS", value_parser = number_in(0.001..=1e6, "seconds"))]
    seconds: Option<f64>,
}

fn write_data_sheets(stage: &VirtualStageConfig, dir: &Path) -> Result<()> {
    std::fs::create_dir_all(dir).map_err(|error| Failure::io(dir, error))?;
    let drives = [("insertion.eds", &stage.insertion.0), ("rotation.eds", &stage.rotation.0)];
    for (name, drive) in drives {
        let path = dir.join(name);
        std::fs::write(&path, drive.eds(name)).map_err(|error| Failure::io(&path, error))?;
    }
    Ok(())
}

pub(super) fn serve(arguments: &Arguments) -> Result<()> {
    let config = arguments.configured.load(Some(VCAN_TOML))?;
    let stage = config.virtual_stage()?;
    if let Some(dir) = &arguments.write_eds {
        return write_data_sheets(&stage, dir);
    }
    let runtime = io_runtime()?;
    let interrupt = Interrupt::listen()?;
    let clock = Clock::start();
    let mut bus = open_bus(&config.can.interface)?;
    let log = frame_log(arguments.log.as_deref(), bus.name(), clock)?;
    let (address, tool) = (&config.tracker.address, &config.tracker.tool);
    let target = config.goal.tool.clone();
    let tips = TipServer::bind(&runtime, address, tool, target, clock, arguments.truth.as_deref())
        .map_err(Failure::environment)?;
    let until = arguments.seconds.map(|s| clock.now() + Duration::from_secs_f64(s));
    let stage = VirtualStage::new(stage, clock.now());
    print_stderr(format_args!(
        "vcan-stage: nodes {} and {} on {}, \"{tool}\" at {}",
        config.stage.insertion.node,
        config.stage.rotation.node,
        bus.name(),
        tips.local_addr()
    ));
    serve_stage(stage, bus.as_mut(), tips, until, &interrupt, log).map_err(Failure::environment)?;
    runtime.shutdown_background();
    Ok(())
}

/// Returns a function that writes a frame to a new file at `path`; without a path it does nothing.
fn frame_log(
    path: Option<&Path>,
    interface: &str,
    clock: Clock,
) -> Result<impl FnMut(Direction, &Frame) + use<>> {
    let file = path.map(|path| match File::create_new(path) {
        Ok(file) => Ok((LineWriter::new(file), path.display().to_string())),
        Err(error) => Err(Failure::io(path, error)),
    });
    let mut file = file.transpose()?;
    let origin = clock.origin_utc().duration_since(UNIX_EPOCH).unwrap_or_default();
    let started_unix_us = i64::try_from(origin.as_micros()).unwrap_or(0);
    let interface = interface_name(interface);
    Ok(move |direction, frame: &Frame| {
        let Some((out, path)) = &mut file else { return };
        let (unix_us, interface) = (unix_us(started_unix_us, clock.now()), &interface);
        let line = CandumpLine { unix_us, interface, direction, frame: *frame };
        if let Err(error) = writeln!(out, "{line}") {
            tracing::warn!("{path}: {error}; frames are no longer logged");
            file = None;
        }
    })
}
