//! `needle-bench tracker list`: the tools of the stream.

use super::{RATE_TIME_MIN_S, listen};
use crate::cli::arguments::{Configured, number_in};
use crate::cli::output::{print_stderr, print_stdout};
use crate::cli::{Failure, Result};
use crate::text::{clipped, table};
use crate::tracker::gate::is_same_tool;
use crate::tracker::{Event, Gate, Sample, Validity};
use crate::units::Time;
use clap::Args;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::time::Duration;

/// Most tools that are listed: a peer with more is faulty or hostile.
const TOOLS_MAX: usize = 64;
/// Most characters of a name or a status that are shown.
const SHOWN_MAX: usize = 40;

#[derive(Debug, Args)]
pub(in crate::cli) struct ListArguments {
    #[command(flatten)]
    configured: Configured,
    /// How long to listen, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0, value_parser = number_in(0.1..=3600.0, "seconds"))]
    seconds: f64,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// One tool of the stream, and its samples so far.
#[derive(Default)]
struct Tool {
    message_type: Option<String>,
    samples: u64,
    valid: u64,
    /// When the first and the last sample came.
    received: Option<(Time, Time)>,
    /// The validity of the last invalid sample.
    status: Option<Validity>,
}

impl Tool {
    /// Counts a sample, which is valid by the checks of `gate`.
    fn take(&mut self, gate: &Gate, sample: &Sample) {
        self.samples += 1;
        match (gate.check_content(sample), &sample.validity) {
            (Ok(()), _) => self.valid += 1,
            (Err(refusal), Validity::Valid) => {
                self.status = Some(Validity::Invalid(refusal.to_string()));
            }
            (Err(_), invalid) => self.status = Some(invalid.clone()),
        }
        let now = sample.receive_time;
        self.received = Some((self.received.map_or(now, |(first, _)| first), now));
    }

    /// Samples a second; `None` if they came in too short a time.
    fn rate_hz(&self) -> Option<f64> {
        let seconds = self.received.map(|(first, last)| last.seconds_after(first))?;
        (seconds >= RATE_TIME_MIN_S).then(|| (self.samples - 1) as f64 / seconds)
    }

    fn row(&self, name: &str, is_configured: bool) -> Vec<String> {
        let (samples, invalid) = (self.samples, self.samples - self.valid);
        let status = match &self.status {
            None if samples == 0 => "no positions".to_owned(),
            None => "valid".to_owned(),
            Some(status) => {
                let status = status.to_string();
                format!("{invalid} of {samples} invalid: {}", clipped(&status, SHOWN_MAX))
            }
        };
        let missing = || "-".to_owned();
        vec![
            clipped(name, SHOWN_MAX).into_owned(),
            self.message_type.clone().unwrap_or_else(missing),
            samples.to_string(),
            self.rate_hz().map_or_else(missing, |hz| format!("{hz:.1} Hz")),
            status + if is_configured { ", tracker.tool" } else { "" },
        ]
    }

    fn json(&self, name: &str, is_configured: bool) -> Value {
        json!({
            "tool": name,
            "type": self.message_type,
            "samples": self.samples,
            "valid": self.valid,
            "rate_hz": self.rate_hz(),
            "status": self.status.as_ref().map(Validity::status),
            "is_configured": is_configured,
        })
    }
}

pub(super) fn list(arguments: &ListArguments) -> Result<()> {
    let mut listener = listen(&arguments.configured, true)?;
    let until = listener.now() + Duration::from_secs_f64(arguments.seconds);
    let configured = listener.config.tracker.tool.clone();
    let is_configured = |name: &String| is_same_tool(name, &configured);
    let gate = listener.config.tracker.to_unregistered_gate();
    let mut tools: BTreeMap<String, Tool> = BTreeMap::new();
    while let Some(event) = listener.next(until) {
        let name = match &event {
            Event::Sample(sample) => &sample.tool,
            Event::SawTool { tool, .. } => tool,
            _ => continue,
        };
        if tools.len() >= TOOLS_MAX && !tools.contains_key(name) && !is_configured(name) {
            continue;
        }
        let tool = tools.entry(name.clone()).or_default();
        match event {
            Event::Sample(sample) => tool.take(&gate, &sample),
            Event::SawTool { message_type, .. } => tool.message_type = Some(message_type),
            _ => {}
        }
    }
    if tools.is_empty() {
        return Err(Failure::environment(listener.explain_missing()));
    }
    listener.warn_of_losses();
    if arguments.json {
        let tools: Vec<Value> =
            tools.iter().map(|(name, tool)| tool.json(name, is_configured(name))).collect();
        print_stdout(json!({ "seconds": arguments.seconds, "tools": tools }))?;
    } else {
        let head = ["tool", "type", "samples", "rate", "status"].map(str::to_owned).to_vec();
        let rows = tools.iter().map(|(name, tool)| tool.row(name, is_configured(name)));
        let rows: Vec<Vec<String>> = std::iter::once(head).chain(rows).collect();
        print_stdout(table(&rows).join("\n"))?;
    }
    if !tools.keys().any(is_configured) {
        print_stderr(format_args!(
            "warning: none of them is tracker.tool = \"{configured}\"; set it"
        ));
    }
    Ok(())
}
