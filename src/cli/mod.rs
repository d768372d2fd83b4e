//! The command line: arguments, messages, exit codes.
//!
//! Data goes to stdout, everything else to stderr. Exit status: 0 the run completed, 1 it was
//! stopped (the reason is the last line), 2 bad usage or configuration, 3 the environment failed.

mod arguments;
mod calibrate;
mod check;
mod console;
mod ending;
mod evaluate;
mod generate;
mod mask;
mod operator;
mod output;
mod perform;
mod plan;
mod preflight;
mod records;
mod replay;
mod review;
mod run;
mod stage;
mod stop;
mod study;
mod tracker;
mod virtual_stage;

use self::output::{print_stderr, print_stdout};
use crate::config::ConfigError;
use crate::telemetry::TelemetryError;
use crate::text::escaped;
use crate::transport::can::CanError;
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use serde_json::{Value, json};
use std::fmt::Display;
use std::io::{self, ErrorKind, IsTerminal as _};
use std::path::Path;
use std::process::ExitCode;
use tokio::runtime::Runtime;

/// Steers a flexible bevel-tip needle into a plane, and records the run.
#[derive(Debug, Parser)]
#[command(name = "needle-bench", version, arg_required_else_help = true)]
struct Bench {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Insert the needle once. Without arguments: a virtual stage, needle and tracker.
    Run(run::Arguments),
    /// Plan a path to the target of [goal], around its obstacles; nothing moves.
    Plan(plan::Arguments),
    /// Check a configuration, and with --connect the drives and the tracker; nothing moves.
    Check(check::Arguments),
    /// Move the stage without a needle to steer: status, home, jog, withdraw,
    /// prove, reset, stop.
    Stage(stage::Arguments),
    /// Stop both axes of a stage at once, whichever program moves them, and take power off. Only [can] and
    /// the node numbers of the configuration must be right.
    Stop(stop::Arguments),
    /// Run a recorded session again, bit for bit, or show where it first differs.
    Replay(replay::Arguments),
    /// Review recorded runs: one, two side by side, or a campaign; judge or repair one.
    Review(review::Arguments),
    /// Run the observers over recorded insertions and score them.
    Evaluate(evaluate::Arguments),
    /// Insert thousands of emulated needles from random starts, and report how well they were
    /// steered.
    Study(study::Arguments),
    /// Look at the tracker without a run: list its tools, watch, record, or measure it at rest.
    #[command(subcommand)]
    Tracker(tracker::TrackerCommand),
    /// Calibrate the rig: from recordings to numbers for the configuration.
    #[command(subcommand)]
    Calibrate(calibrate::Calibration),
    /// Print completions for a shell, or write man pages to a folder.
    #[command(subcommand)]
    Generate(generate::Artifact),
}

/// Why a command did not succeed. Its text is the message, empty if it was printed already.
#[derive(Debug, derive_more::Display)]
#[display("{}", self.message.as_deref().unwrap_or_default())]
struct Failure {
    /// `None` if the command has printed it already.
    message: Option<String>,
    /// The exit status of the command.
    status: u8,
}

impl Failure {
    /// The configuration or the arguments are wrong.
    fn configuration(error: impl Display) -> Self {
        Failure { message: Some(error.to_string()), status: BAD_CONFIGURATION }
    }

    /// The environment lacks something.
    fn environment(error: impl Display) -> Self {
        Failure { message: Some(error.to_string()), status: ENVIRONMENT_FAILED }
    }

    /// The content of the file or folder `path` is wrong.
    fn bad_input(path: &Path, error: impl Display) -> Self {
        Failure::configuration(format_args!("{}: {error}", shown(path)))
    }

    /// The system cannot read or write the file `path`.
    fn io(path: &Path, error: impl Display) -> Self {
        Failure::environment(format_args!("{}: {error}", shown(path)))
    }
}

/// `path` in one line.
fn shown(path: &Path) -> String {
    escaped(&path.to_string_lossy()).into_owned()
}

/// The result of a command, or of a part of one.
type Result<T, E = Failure> = std::result::Result<T, E>;

/// The end of a command that has printed its result: a failure unless `status` is 0.
fn finish_with(status: u8) -> Result<()> {
    match status {
        0 => Ok(()),
        _ => Err(Failure { message: None, status }),
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Failure::configuration(error)
    }
}

impl From<CanError> for Failure {
    fn from(error: CanError) -> Self {
        Failure::environment(error)
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Failure::environment(error)
    }
}

/// A folder without a run, or with an incomplete run, is bad input; a failing disk is not.
impl From<TelemetryError> for Failure {
    fn from(error: TelemetryError) -> Self {
        use TelemetryError::{File, NotARun, Unusable};
        match &error {
            NotARun { .. } => Failure::configuration(format_args!(
                "{error}; name a run's own folder (in record.dir: <UTC>-<name>)"
            )),
            File { source, .. } if source.kind() == ErrorKind::NotFound => {
                Failure::configuration(error)
            }
            Unusable { .. } => Failure::configuration(error),
            _ => Failure::environment(error),
        }
    }
}

/// A runtime with one thread for sockets and signals, beside the control thread.
fn io_runtime() -> io::Result<Runtime> {
    tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()
}

/// Status of a run that was stopped.
const STOPPED: u8 = 1;
const BAD_CONFIGURATION: u8 = 2;
const ENVIRONMENT_FAILED: u8 = 3;

/// The examples below the help of each command: a paragraph for each, under its name.
const EXAMPLES: &str = include_str!("examples.txt");

/// The command line as it is declared, with examples.
fn command_line() -> clap::Command {
    Bench::command().mut_subcommands(|command| with_examples(command, ""))
}

/// Adds the examples to `command`, which is typed after `prefix`, and to its subcommands.
fn with_examples(command: clap::Command, prefix: &str) -> clap::Command {
    let name = format!("{prefix}{}", command.get_name());
    let paragraphs = EXAMPLES.split("\n\n").filter_map(|paragraph| paragraph.split_once('\n'));
    let examples: String =
        paragraphs.filter(|(title, _)| *title == name).map(|(_, examples)| examples).collect();
    command
        .after_help(format!("Examples:\n{}", examples.trim_end()))
        .mut_subcommands(|inner| with_examples(inner, &format!("{name} ")))
}

/// Runs the bench's command line.
pub fn bench() -> ExitCode {
    let is_json = std::env::args_os().any(|argument| argument == "--json");
    let matches = command_line().try_get_matches();
    let bench = matches.and_then(|matches| Bench::from_arg_matches(&matches));
    let bench = bench.unwrap_or_else(|error| {
        let error = with_suggestion(error);
        if error.use_stderr() && is_json {
            let text = error.to_string();
            let what = text.split("\n\n").next().unwrap_or_default();
            let words = what.trim_start_matches("error: ").split_whitespace().collect::<Vec<_>>();
            let _ = print_stdout(json!({ "error": words.join(" ") }));
        }
        error.exit()
    });
    start_logging();
    let no_result = match bench.command {
        Command::Run(_) => json!({ "outcome": null }),
        _ => json!({}),
    };
    exit(bench.command.execute(), is_json.then_some(no_result))
}

impl Command {
    fn execute(&self) -> Result<()> {
        match self {
            Command::Run(arguments) => run::run(arguments),
            Command::Plan(arguments) => plan::plan(arguments),
            Command::Check(arguments) => check::check(arguments),
            Command::Stage(arguments) => stage::stage(arguments),
            Command::Stop(arguments) => stop::stop(&arguments.configured, arguments.json),
            Command::Replay(arguments) => replay::replay(arguments),
            Command::Review(arguments) => review::review(arguments),
            Command::Evaluate(arguments) => evaluate::evaluate(arguments),
            Command::Study(arguments) => study::study(arguments),
            Command::Tracker(command) => tracker::tracker(command),
            Command::Calibrate(calibration) => calibrate::calibrate(calibration),
            Command::Generate(artifact) => generate::generate(artifact),
        }
    }
}

/// Adds the nearest command to the error of a mistyped one: clap's own threshold misses swapped letters.
fn with_suggestion(mut error: clap::Error) -> clap::Error {
    let Some(ContextValue::String(typed)) = error.get(ContextKind::InvalidSubcommand) else {
        return error;
    };
    let bench = Bench::command();
    let command = std::env::args_os()
        .skip(1)
        .fold(&bench, |command, argument| command.find_subcommand(argument).unwrap_or(command));
    let edits_to = |name: &str| strsim::damerau_levenshtein(typed, name);
    let nearest = command
        .get_subcommands()
        .map(|command| (edits_to(command.get_name()), command.get_name()))
        .min()
        .filter(|(edits, name)| 2 * edits < name.len());
    // `needle-bench jog` lacks the word before it: suggest `stage jog`.
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
    start_logging();
    exit(virtual_stage::serve(&arguments), None)
}

/// The exit status. A failure that is not printed yet is reported on stderr, and in the object `json` on
/// stdout.
fn exit(result: Result<()>, json: Option<Value>) -> ExitCode {
    let Err(Failure { message, status }) = result else { return ExitCode::SUCCESS };
    if let Some(message) = message {
        print_stderr(format_args!("error: {message}"));
        if let Some(mut object) = json {
            object["error"] = json!(message);
            // If stdout is broken as well, nothing is left to report to.
            let _ = print_stdout(object);
        }
    }
    ExitCode::from(status)
}

/// Warnings of the libraries go to stderr; `RUST_LOG` sets the level.
fn start_logging() {
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    let has_no_colour = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    // A test may have set a subscriber already; it is kept.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal() && !has_no_colour)
        .log_internal_errors(false)
        .try_init();
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(line: &str) -> String {
        let words = ["needle-bench"].into_iter().chain(line.split_whitespace());
        match Bench::try_parse_from(words) {
            Ok(bench) => bench.command.execute().expect_err("it is refused").to_string(),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn a_file_that_exists_is_refused_before_anything_is_done() {
        for line in [
            "plan --out docs/target-plan.svg",
            "study --out Cargo.toml",
            "replay runs/none --out Cargo.toml",
            "tracker rest --out Cargo.toml",
            "calibrate needle none.csv --out Cargo.toml",
            "calibrate tracker none.csv --out Cargo.toml",
            "calibrate registration none.csv --collect --out Cargo.toml",
            "calibrate tip none.csv --run --out Cargo.toml",
        ] {
            let error = refusal(line);
            assert!(error.contains("exists, and is not overwritten"), "{line}: {error}");
        }
    }

    #[test]
    fn a_plan_is_drawn_as_svg_alone() {
        let error = refusal("plan bench-config/target.toml --out plan.pdf");
        assert!(error.contains("the plan is drawn as SVG: a name that ends in .svg"), "{error}");
    }

    #[test]
    fn a_stage_that_is_not_named_can_be_rehearsed_as_the_error_says() {
        for line in ["calibrate tip none.csv --run", "stage status"] {
            let error = refusal(line);
            assert!(error.contains("on the emulated stage with --rehearse"), "{error}");
        }
        let rehearsed = Bench::try_parse_from(["needle-bench", "stage", "status", "--rehearse"]);
        rehearsed.unwrap().command.execute().unwrap();
    }

    #[test]
    fn each_command_has_examples_that_it_understands() {
        let mut commands: Vec<_> = command_line().get_subcommands().cloned().collect();
        while let Some(command) = commands.pop() {
            let name = command.get_name();
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let examples: Vec<&str> = help.lines().skip(1).collect();
            assert!(!examples.is_empty(), "{name} has no examples");
            for example in examples {
                let typed = example.split(" > ").next().unwrap_or_default();
                let typed = typed.replace("\"in air\"", "in-air");
                let parsed = Bench::try_parse_from(typed.split_whitespace());
                assert!(parsed.is_ok(), "{example}: {}", parsed.expect_err("refused"));
            }
            commands.extend(command.get_subcommands().cloned());
        }
    }
}
