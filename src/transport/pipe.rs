//! A tracker's stream from standard input or another reader.

use super::link::{Link, LinkSettings, Outlet};
use crate::tracker::{Event, Reader};
use crate::units::Time;
use std::io::{ErrorKind, Read};
use std::thread;

impl Link {
    /// Reads `input`, called `name` in messages, to its end. A thread of its own does so, because
    /// reading a pipe may block for ever. `clock` gives the receive times.
    pub fn read<R, C>(mut input: R, name: &str, settings: LinkSettings, clock: C) -> Self
    where
        R: Read + Send + 'static,
        C: Fn() -> Time + Send + 'static,
    {
        let (link, mut outlet) = Link::new(&settings);
        let mut reader = Reader::new(settings.protocol);
        let name = name.to_owned();
        thread::spawn(move || {
            outlet.hand_on(clock(), Event::Connected { peer: name.clone() });
            let why = read_to_end(&mut input, &mut reader, &mut outlet, &clock);
            let reason = format!("tracker: {name} {why}");
            outlet.hand_on(clock(), Event::Disconnected { reason });
        });
        link
    }
}

/// Reads until the input ends or the link is dropped, and returns how it ended.
fn read_to_end(
    input: &mut impl Read,
    reader: &mut Reader,
    outlet: &mut Outlet,
    clock: impl Fn() -> Time,
) -> String {
    let mut buffer = [0; 4096];
    while !outlet.is_closed() {
        let len = match input.read(&mut buffer) {
            Ok(0) => {
                let cut = reader.finish().err().map(|error| format!(": {error}"));
                return format!("has ended{}", cut.unwrap_or_default());
            }
            Ok(len) => len,
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            Err(error) => return format!("failed: {error}"),
        };
        let now = clock();
        reader.push(now, buffer.get(..len).unwrap_or_default());
        if let Err(reason) = outlet.hand_on_all(now, reader) {
            return reason;
        }
    }
    "is no longer read".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracker::Protocol;

    const NOW: Time = Time::from_nanos(42);

    fn events(text: &'static str) -> Vec<String> {
        let settings = LinkSettings { protocol: Protocol::Ndjson, ..LinkSettings::default() };
        let mut link = Link::read(text.as_bytes(), "standard input", settings, || NOW);
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let next = || runtime.block_on(link.next());
        std::iter::from_fn(next)
            .map(|event| match event {
                Event::Sample(sample) => {
                    assert_eq!(sample.receive_time, NOW);
                    format!("{} {}", sample.tool, sample.position_mm.x)
                }
                Event::Connected { peer } => format!("connected to {peer}"),
                Event::Malformed(error) => error.to_string(),
                Event::Disconnected { reason } => reason,
                other => format!("{other:?}"),
            })
            .collect()
    }

    #[test]
    fn a_pipe_is_read_to_its_end() {
        assert_eq!(
            events("{\"tool\":\"N\",\"position_tracker_mm\":[1,2,3]}\nnonsense\n{\"tool\""),
            [
                "connected to standard input",
                "SawTool { tool: \"N\", message_type: \"NDJSON\" }",
                "N 1",
                "ndjson: line 2: expected ident (column 2)",
                "tracker: standard input has ended: ndjson: line 3: 7 bytes and no end of line; it \
                 was cut off",
            ]
        );
    }
}
