//! The command line: arguments, messages, exit codes.
//!
//! Data goes to stdout, everything else to stderr. Exit status: 0 the run completed, 1 it was
//! stopped (the reason is the last line), 2 bad usage or configuration, 3 the environment failed.

mod about;
mod after;
mod calibrate;
mod check;
mod console;
mod ending;
mod evaluate;
mod generate;
mod insertions;
mod operator;
mod output;
mod perform;
mod plan;
mod preflight;
mod realtime;
mod recording;
mod replay;
mod review;
mod run;
mod runs;
mod sources;
mod stage;
mod stop;
mod study;
mod tracker;
mod virtual_stage;

use self::output::{say, tell};
use crate::telemetry::TelemetryError;
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, Parser, Subcommand};
use serde_json::{Value, json};
use std::fmt::Display;
use std::io::ErrorKind;
use std::path::Path;
use std::process::ExitCode;
use tokio::runtime::Runtime;

/// Steers a flexible bevel-tip needle into a plane, and records the proof.
#[derive(Debug, Parser)]
#[command(name = "needle-bench", version, arg_required_else_help = true)]
struct Bench {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Insert the needle once. Without arguments: a virtual stage, needle and tracker.
    #[command(
        after_help = "Examples:\n  needle-bench run\n  needle-bench run my-rig.toml --rehearse\n  needle-bench run my-rig.toml --set insertion.depth_mm=20 --note \"in air\""
    )]
    Run(run::Arguments),
    /// Plan a path to the target of [goal], around its obstacles; nothing moves.
    #[command(
        after_help = "Examples:\n  needle-bench plan bench-config/target.toml --out plan.svg"
    )]
    Plan(plan::Arguments),
    /// Check a configuration, and with --connect the drives and the tracker; nothing moves.
    #[command(
        after_help = "Examples:\n  needle-bench check my-rig.toml\n  needle-bench check my-rig.toml --connect"
    )]
    Check(check::Arguments),
    /// Move the stage without a needle to steer: status, home, jog, withdraw,
    /// prove, reset, stop.
    #[command(
        after_help = "Examples:\n  needle-bench stage status my-rig.toml\n  needle-bench stage jog my-rig.toml --axis insertion --by 2mm\n  needle-bench stage --rehearse home my-rig.toml"
    )]
    Stage(stage::Arguments),
    /// Stop both axes of a stage at once, whichever program moves them, and take power off. Only [can] and
    /// the node numbers of the configuration must be right.
    #[command(
        after_help = "Examples:\n  needle-bench stop my-rig.toml\n  needle-bench stop --set can.interface=can0 --set stage.insertion.node=1 --set stage.rotation.node=2"
    )]
    Stop(stop::Arguments),
    /// Run a recorded session again, bit for bit, or show where it first differs.
    #[command(
        after_help = "Examples:\n  needle-bench replay runs/20261121T113902Z-virtual\n  needle-bench replay runs/20261121T113902Z-virtual --set observer.kind=coupled"
    )]
    Replay(replay::Arguments),
    /// Review recorded runs: one, two side by side, or a campaign; judge or repair one.
    #[command(
        after_help = "Examples:\n  needle-bench review\n  needle-bench review runs --by observer.kind"
    )]
    Review(review::Arguments),
    /// Run the observers over recorded insertions and score them.
    #[command(after_help = "Examples:\n  needle-bench evaluate insertion-*.csv")]
    Evaluate(evaluate::Arguments),
    /// Insert thousands of emulated needles from random starts, and report how well they were
    /// steered.
    #[command(after_help = "Examples:\n  needle-bench study --trials 200 --out trials.csv")]
    Study(study::Arguments),
    /// Look at the tracker without a run: list its tools, watch, record, or measure it at rest.
    #[command(
        after_help = "Examples:\n  needle-bench tracker list my-rig.toml\n  needle-bench tracker rest my-rig.toml --out noise.toml"
    )]
    Tracker(tracker::Arguments),
    /// Calibrate the rig: from recordings to numbers for the configuration.
    #[command(
        after_help = "Examples:\n  needle-bench calibrate registration points.csv my-rig.toml --out registration.toml\n  needle-bench calibrate tip turn.csv my-rig.toml --run --along-mm 7 --out tip.toml"
    )]
    Calibrate(calibrate::Arguments),
    /// Print completions for a shell, or write man pages to a folder.
    #[command(
        after_help = "Examples:\n  needle-bench generate bash > ~/.local/share/bash-completion/completions/needle-bench\n  needle-bench generate man ~/.local/share/man/man1"
    )]
    Generate(generate::Arguments),
}

/// Why a command failed; each variant has its exit status.
#[derive(Debug)]
enum Failure {
    /// The configuration or the arguments are wrong: status 2.
    Configuration(String),
    /// The environment lacks something: status 3.
    Environment(String),
}

impl Failure {
    fn configuration(error: impl Display) -> Self {
        Failure::Configuration(error.to_string())
    }

    fn environment(error: impl Display) -> Self {
        Failure::Environment(error.to_string())
    }

    /// The file at `path` is wrong.
    fn in_file(path: &Path, error: impl Display) -> Self {
        Failure::Configuration(format!("{}: {error}", path.display()))
    }
}

/// A folder that is no run, or a run that is not whole, is bad input; a disk that fails is not.
impl From<TelemetryError> for Failure {
    fn from(error: TelemetryError) -> Self {
        use TelemetryError::{File, NotARun, Record};
        match error {
            NotARun { .. } => Failure::Configuration(format!(
                "{error}; name a run's own folder (in record.dir: <UTC>-<name>), or one with such \
                 folders in it"
            )),
            File { ref source, .. } if source.kind() == ErrorKind::NotFound => {
                Failure::configuration(error)
            }
            Record { .. } => Failure::configuration(error),
            error => Failure::environment(error),
        }
    }
}

/// The thread for sockets and signals, beside the control thread.
fn io_runtime() -> Result<Runtime, Failure> {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(1).enable_all().build().map_err(Failure::environment)
}

/// Status of a command that succeeded.
const COMPLETED: u8 = 0;
/// Status of a run that was stopped.
const STOPPED: u8 = 1;
const BAD_CONFIGURATION: u8 = 2;
const ENVIRONMENT_FAILED: u8 = 3;

/// Runs the bench's command line.
pub fn bench() -> ExitCode {
    let is_json = std::env::args_os().any(|argument| argument == "--json");
    let bench = Bench::try_parse().unwrap_or_else(|error| {
        let error = with_suggestion(error);
        if error.use_stderr() && is_json {
            let _ = say(json!({ "error": error.to_string().trim_end() }));
        }
        error.exit()
    });
    listen_to_logs();
    let no_result = match bench.command {
        Command::Run(_) => json!({ "outcome": null }),
        _ => json!({}),
    };
    let result = match bench.command {
        Command::Run(arguments) => run::run(&arguments),
        Command::Plan(arguments) => plan::plan(&arguments),
        Command::Check(arguments) => check::check(&arguments),
        Command::Stage(arguments) => stage::stage(&arguments),
        Command::Stop(stop::Arguments { configured, json, .. }) => {
            stop::stop(configured.path(), &configured.set, json)
        }
        Command::Replay(arguments) => replay::replay(&arguments),
        Command::Review(arguments) => review::review(&arguments),
        Command::Evaluate(arguments) => evaluate::evaluate(&arguments),
        Command::Study(arguments) => study::study(&arguments),
        Command::Tracker(arguments) => tracker::tracker(&arguments),
        Command::Calibrate(arguments) => calibrate::calibrate(&arguments),
        Command::Generate(arguments) => generate::generate(&arguments),
    };
    exit(result, is_json.then_some(no_result))
}

/// Adds the nearest command to the error of a mistyped one: clap's own threshold misses swapped letters.
fn with_suggestion(mut error: clap::Error) -> clap::Error {
    let Some(ContextValue::String(typed)) = error.get(ContextKind::InvalidSubcommand) else {
        return error;
    };
    let bench = Bench::command();
    let command = std::env::args()
        .skip(1)
        .fold(&bench, |command, argument| command.find_subcommand(argument).unwrap_or(command));
    let edits_to = |name: &str| strsim::damerau_levenshtein(typed, name);
    let nearest = command
        .get_subcommands()
        .map(|command| (edits_to(command.get_name()), command.get_name()))
        .min()
        .filter(|(edits, name)| 2 * edits < name.len());
    // The word before it was left out, as in `needle-bench jog`.
    let is_typed = |command: &&clap::Command| command.get_name() == typed;
    let inside = command.get_subcommands().find_map(|command| {
        let inside = command.get_subcommands().find(is_typed)?;
        Some(format!("{} {}", command.get_name(), inside.get_name()))
    });
    if let Some(name) = inside.or(nearest.map(|(_, name)| name.to_owned())) {
        let names = ContextValue::Strings(vec![name]);
        error.insert(ContextKind::SuggestedSubcommand, names);
    }
    error
}

/// Runs the virtual stage's command line.
pub fn virtual_stage() -> ExitCode {
    let arguments = virtual_stage::Arguments::parse();
    listen_to_logs();
    exit(virtual_stage::serve(&arguments), None)
}

/// The exit status. A failure is reported on stderr, and in the object `json` on stdout.
fn exit(result: Result<ExitCode, Failure>, json: Option<Value>) -> ExitCode {
    let (message, status) = match result {
        Ok(code) => return code,
        Err(Failure::Configuration(message)) => (message, BAD_CONFIGURATION),
        Err(Failure::Environment(message)) => (message, ENVIRONMENT_FAILED),
    };
    tell(format_args!("error: {message}"));
    if let Some(mut object) = json {
        object["error"] = json!(message);
        // If stdout is broken as well, nothing is left to report to.
        let _ = say(object);
    }
    ExitCode::from(status)
}

/// Warnings of the libraries go to stderr; `RUST_LOG` sets the level.
fn listen_to_logs() {
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    // A test may have set a subscriber already; that one stays.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .log_internal_errors(false)
        .try_init();
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the help shows can be typed.
    #[test]
    fn each_command_has_examples_that_it_understands() {
        let mut commands = vec![Bench::command()];
        while let Some(command) = commands.pop() {
            let subcommands = command.get_subcommands().cloned().collect::<Vec<_>>();
            let name = command.get_name();
            if name != "needle-bench" {
                let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
                let examples = help.strip_prefix("Examples:\n").unwrap_or_else(|| {
                    panic!("{name} has no examples");
                });
                for example in examples.lines() {
                    let typed = example.split(" > ").next().unwrap_or_default();
                    let typed = typed.replace("\"in air\"", "in-air");
                    let parsed = Bench::try_parse_from(typed.split_whitespace());
                    assert!(parsed.is_ok(), "{example}: {}", parsed.expect_err("refused"));
                }
            }
            commands.extend(subcommands);
        }
    }
}
