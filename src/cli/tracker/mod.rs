//! The source of tip positions that the configuration names; and `needle-bench tracker`, which listens to it
//! without a run.

mod list;
mod record;
mod watch;

use self::list::{ListArguments, list};
use self::record::{RecordArguments, record};
use self::watch::{WatchArguments, watch};
use super::arguments::{Configured, text_of};
use super::calibrate::tracker::{RestArguments, rest};
use super::output::print_stderr;
use super::{Failure, Result, io_runtime};
use crate::config::{Config, TrackerMode, TrackerSection, TrackerSource};
use crate::runtime::{Clock, Interrupt};
use crate::session::{HoldConfig, Resume};
use crate::text::clipped;
use crate::tracker::{Census, Event, Protocol, Sample, Sieve, StreamReplay, csv, ndjson};
use crate::transport::link::{Link, LinkSettings};
use crate::units::Time;
use clap::Subcommand;
use std::path::Path;
use std::time::{Duration, UNIX_EPOCH};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

#[derive(Debug, Subcommand)]
pub(super) enum TrackerCommand {
    /// The tools that the tracker sends, with types and rates.
    List(ListArguments),
    /// One line a second: position, rate, age, refusals; until Ctrl-C.
    Watch(WatchArguments),
    /// Write the tool's positions to a file; until Ctrl-C.
    Record(RecordArguments),
    /// Measure the tracker's noise while the tool is at rest, as `calibrate tracker` does.
    Rest(RestArguments),
}

pub(super) fn tracker(command: &TrackerCommand) -> Result<()> {
    match command {
        TrackerCommand::List(arguments) => list(arguments),
        TrackerCommand::Watch(arguments) => watch(arguments),
        TrackerCommand::Record(arguments) => record(arguments),
        TrackerCommand::Rest(arguments) => rest(arguments),
    }
}

/// A connection is not given up before the peer was silent for this long: a slow tracker may pause.
const SILENCE_MIN: Duration = Duration::from_secs(1);

fn link_settings(tracker: &TrackerSection, tools: Vec<String>) -> LinkSettings {
    let default = LinkSettings::default();
    let HoldConfig { after, timeout, resume, .. } = tracker.hold;
    // In a hold that may end, half of the time is left to connect again.
    let in_a_hold = (after + timeout / 2).max(SILENCE_MIN);
    let silence_limit = match resume {
        Resume::Stop => default.silence_limit,
        Resume::Automatic | Resume::Operator => default.silence_limit.min(in_a_hold),
    };
    let protocol = match tracker.source {
        TrackerSource::Ndjson => Protocol::Ndjson,
        _ => Protocol::OpenIgtLink,
    };
    let request = tracker.to_request();
    LinkSettings { protocol, tools, request, silence_limit, ..default }
}

/// Opens the stream of `tools`, or of every tool if none is named, in real time.
pub(super) fn open_tracker(
    config: &Config,
    tools: Vec<String>,
    runtime: &Runtime,
    clock: Clock,
) -> Result<Link> {
    let tracker = &config.tracker;
    let address = &tracker.address;
    let now = move || clock.now();
    let settings = link_settings(tracker, tools);
    let _in_runtime = runtime.enter();
    if let Some(replay) = load_replay(tracker, clock.now())? {
        return Ok(Link::replay(replay, &settings, now));
    }
    if tracker.is_standard_input() {
        return Ok(Link::read(std::io::stdin(), "standard input", settings, now));
    }
    match tracker.mode {
        TrackerMode::Connect => Ok(Link::connect(address, settings, now)),
        TrackerMode::Listen => match runtime.block_on(TcpListener::bind(address)) {
            Ok(listener) => Ok(Link::listen(listener, settings, now)),
            Err(error) => Err(Failure::environment(format_args!(
                "tracker: cannot listen at {address}: {error}"
            ))),
        },
    }
}

/// Loads the recording that replaces a tracker, to begin at `start`; `None` if the configuration names none.
pub(super) fn load_replay(tracker: &TrackerSection, start: Time) -> Result<Option<StreamReplay>> {
    let Some(file) = &tracker.file else { return Ok(None) };
    let text = text_of(Path::new(file))?;
    let recording = match tracker.source {
        TrackerSource::Csv => csv::recording(&text, &tracker.csv, &tracker.tool)
            .map_err(|error| format!("{file}: {error}; see [tracker.csv]")),
        _ => ndjson::recording(&text).map_err(|error| format!("{file}: {error}")),
    };
    Ok(Some(StreamReplay::new(file, recording.map_err(Failure::configuration)?, start)))
}

/// The source in a few words, for the manifest.
pub(super) fn source_label(config: &Config) -> String {
    let tracker = &config.tracker;
    let TrackerSection { mode, address, .. } = tracker;
    let source = config.tip_source();
    match (source, &tracker.file) {
        (TrackerSource::Emulated, _) => source.to_string(),
        (_, Some(file)) => format!("{source} {file}"),
        _ if tracker.is_standard_input() => format!("{source} standard input"),
        _ => format!("{source} {mode} {address}"),
    }
}

/// Interval at which a listener checks for Ctrl-C.
const SIGNAL_POLL: Duration = Duration::from_millis(100);

/// Shortest time over which a rate is given, s: a short recording is over at once.
const RATE_TIME_MIN_S: f64 = 0.1;
/// A message shows at most this many characters of the reason for a lost connection, and of an unreadable message.
const REASON_MAX: usize = 100;
const ERROR_MAX: usize = 140;

/// The configuration if none is named: only the tracker is opened, never the stage.
const ANY_STAGE: (&str, &str) =
    ("no configuration", "can.interface = \"vcan0\"\ntracker.source = \"openigtlink\"\n");
const NO_TRACKER: &str = "give --config my-rig.toml, or --set 'tracker.address=\"HOST:PORT\"'";

/// An open stream of a tracker, without a run.
pub(super) struct Listener {
    pub(super) config: Config,
    clock: Clock,
    link: Link,
    interrupt: Interrupt,
    census: Census,
    /// Why there is no connection; `None` while there is one.
    trouble: Option<String>,
    /// Connections that ended.
    ended: u64,
    /// Those of them since the last [`Self::connection_trouble`].
    ended_lately: u64,
    /// Why the last one ended.
    last_end: String,
    unreadable: Unreadable,
    has_ended: bool,
    // The last field, so dropped last: the link uses it.
    runtime: Runtime,
}

/// Opens the stream of the tool that `configured` names, or of every tool. Refuses an emulated tracker.
pub(super) fn listen(configured: &Configured, every_tool: bool) -> Result<Listener> {
    if configured.path().is_none() && configured.set.is_empty() {
        return Err(Failure::configuration(format!("tracker: none is named; {NO_TRACKER}")));
    }
    let config = configured.load(Some(ANY_STAGE))?;
    if config.tip_source() == TrackerSource::Emulated {
        return Err(Failure::configuration(
            "tracker.source is \"emulated\": that tracker exists in a run alone; set it to \"openigtlink\" and \
             tracker.address to \"HOST:PORT\", or give --config my-rig.toml",
        ));
    }
    Listener::open(config, every_tool)
}

impl Listener {
    /// Opens the stream of the tool of `config`, or of every tool.
    pub(super) fn open(config: Config, every_tool: bool) -> Result<Self> {
        let runtime = io_runtime()?;
        let interrupt = Interrupt::listen()?;
        let clock = Clock::start();
        let tools = if every_tool { vec![] } else { vec![config.tracker.tool.clone()] };
        let link = open_tracker(&config, tools, &runtime, clock)?;
        Ok(Listener {
            config,
            clock,
            link,
            interrupt,
            census: Census::default(),
            trouble: None,
            ended: 0,
            ended_lately: 0,
            last_end: String::new(),
            unreadable: Unreadable::default(),
            has_ended: false,
            runtime,
        })
    }

    /// The next event; `None` at `until`, at Ctrl-C and at the end of the stream.
    pub(super) fn next(&mut self, until: Time) -> Option<Event> {
        while !self.is_over() && self.clock.now() < until {
            let wait = until.since(self.clock.now()).min(SIGNAL_POLL);
            let next = async { tokio::time::timeout(wait, self.link.next()).await };
            match self.runtime.block_on(next) {
                Ok(Some(event)) => {
                    self.note(&event);
                    return Some(event);
                }
                Ok(None) => self.has_ended = true,
                Err(_) => {}
            }
        }
        None
    }

    fn note(&mut self, event: &Event) {
        self.census.note(event);
        self.unreadable.note(event);
        match event {
            Event::Unreachable { reason } => self.trouble = Some(reason.clone()),
            Event::Disconnected { reason } => {
                self.trouble = Some(reason.clone());
                self.ended += 1;
                self.ended_lately += 1;
                self.last_end.clone_from(reason);
            }
            Event::Connected { .. } => self.trouble = None,
            _ => {}
        }
    }

    /// True after Ctrl-C or the end of the stream.
    pub(super) fn is_over(&self) -> bool {
        self.has_ended || self.interrupt.is_raised()
    }

    pub(super) fn now(&self) -> Time {
        self.clock.now()
    }

    /// UTC at the origin of [`Self::now`], ns since 1970.
    pub(super) fn origin_unix_ns(&self) -> i64 {
        let origin = self.clock.origin_utc().duration_since(UNIX_EPOCH).unwrap_or_default();
        i64::try_from(origin.as_nanos()).unwrap_or(i64::MAX)
    }

    /// Passes each sample of the tool to `take`, for `seconds` from the first of them on or until
    /// Ctrl-C.
    ///
    /// # Errors
    /// No sample within `tracker.timeout_s`; those of `take`.
    pub(super) fn for_each_sample(
        &mut self,
        seconds: Option<f64>,
        mut take: impl FnMut(&Sample) -> Result<()>,
    ) -> Result<()> {
        let timeout = self.now() + self.config.tracker.timeout;
        let (mut until, mut has_sample) = (timeout, false);
        while let Some(event) = self.next(until) {
            let Event::Sample(sample) = event else { continue };
            if !has_sample {
                has_sample = true;
                until = seconds
                    .map_or(Time::NEVER, |seconds| self.now() + Duration::from_secs_f64(seconds));
            }
            take(&sample)?;
        }
        if !has_sample {
            return Err(Failure::environment(self.explain_missing()));
        }
        self.warn_of_losses();
        Ok(())
    }

    /// Warns of samples, messages and connections that were lost.
    fn warn_of_losses(&self) {
        match self.link.dropped() {
            0 => {}
            lost => print_stderr(format_args!(
                "warning: {lost} samples were lost: they came faster than they were read"
            )),
        }
        self.unreadable.warn();
        // A pipe and a recording end once, and that is no loss.
        match self.ended.saturating_sub(u64::from(self.has_ended)) {
            0 => {}
            lost => print_stderr(format_args!(
                "warning: the connection was lost {lost} times; the last: {}",
                short_reason(&self.last_end)
            )),
        }
    }

    /// What is wrong with the connection now, or was since the last call, to be appended to a line.
    fn connection_trouble(&mut self) -> String {
        let lost = std::mem::take(&mut self.ended_lately);
        match &self.trouble {
            _ if self.has_ended => String::new(),
            Some(trouble) => format!("; not connected: {}", short_reason(trouble)),
            None if lost == 0 => String::new(),
            None => format!("; connection lost {lost} times: {}", short_reason(&self.last_end)),
        }
    }

    /// Why no sample of the tool came, and what came instead.
    pub(super) fn explain_missing(&mut self) -> String {
        self.link.passed_over().iter().for_each(|event| self.census.note(event));
        let tool = &self.config.tracker.tool;
        match &self.trouble {
            // Neither the tool nor its name is the cause.
            Some(trouble) if self.census.messages() == 0 || self.census.has(tool) => {
                trouble.clone()
            }
            _ => self.census.explain_missing(tool),
        }
    }
}

/// `reason` as part of a longer message.
fn short_reason(reason: &str) -> String {
    clipped(reason.strip_prefix("tracker: ").unwrap_or(reason), REASON_MAX).into_owned()
}

/// Counts messages that could not be read.
#[derive(Debug, Clone, Default)]
pub(super) struct Unreadable {
    count: u64,
    last: String,
}

impl Unreadable {
    pub(super) fn note(&mut self, event: &Event) {
        if let Event::Malformed(error) = event {
            self.count += 1;
            self.last.clone_from(error);
        }
    }

    /// Warns if there are any.
    pub(super) fn warn(&self) {
        let Unreadable { count, last } = self;
        // A link passes on only some of a flood.
        let at_least = if *count < u64::from(Sieve::NOTICES_MAX) { "" } else { "at least " };
        if *count > 0 {
            print_stderr(format_args!(
                "warning: {at_least}{count} messages could not be read; the last: {}",
                clipped(last, ERROR_MAX)
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_silent_peer_is_given_up_while_a_hold_may_still_end() {
        let limit_s = |resume: &str, timeout_s: f64| {
            let sets =
                [format!("tracker.resume={resume}"), format!("tracker.hold_timeout_s={timeout_s}")];
            let config = Config::from_sources(&[], &sets).unwrap();
            link_settings(&config.tracker, Vec::new()).silence_limit.as_secs_f64()
        };
        assert_eq!(limit_s("stop", 5.0), 10.0);
        assert_eq!([limit_s("automatic", 5.0), limit_s("operator", 5.0)], [3.0, 3.0]);
        assert_eq!([limit_s("automatic", 60.0), limit_s("automatic", 0.3)], [10.0, 1.0]);
    }
}
