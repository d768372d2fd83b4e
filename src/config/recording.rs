//! `[tracker.csv]`: what the columns of a recorded stream hold.

use std::time::Duration;

use super::schema::{Rule, named, over, section, within};
use crate::tracker::{CsvMapping, TimeColumn};

const COLUMN: Rule = named("the name of a column");

section! {
    /// `[tracker.csv]`. Columns are named as in the file's header.
    pub struct CsvConfig {
        /// What paces the replay. Columns given as s, ms, us and ns are added.
        time: TimeColumnsConfig => "{ s = \"time_s\" }", whole;
        /// When the sender says each position was measured, since 1970.
        stamp: Option<TimeColumnsConfig>, whole;
        /// x, y and z in the tracker's frame.
        position: [String; 3] [COLUMN] = ["x_meas_mm", "y_meas_mm", "z_meas_mm"];
        /// Millimetres per unit of those columns; 1000 where they are in metres.
        position_unit_mm: f64 [over(0.0, 1e6)] = 1.0;
        /// w, x, y and z of the sensor's orientation in that frame.
        quaternion_wxyz: Option<[String; 4]> [COLUMN];
        /// Length of the beginning to leave out, s.
        skip_s: f64 [within(0.0, 1e6)] = 0.0;
    }
}

section! {
    /// Columns that add up to a time, each in its unit.
    pub struct TimeColumnsConfig {
        /// The column of seconds.
        s: Option<String> [COLUMN];
        /// The column of milliseconds.
        ms: Option<String> [COLUMN];
        /// The column of microseconds.
        us: Option<String> [COLUMN];
        /// The column of nanoseconds.
        ns: Option<String> [COLUMN];
    }
}

impl CsvConfig {
    /// As the tracker module has it, for the positions of `tool`.
    pub fn to_mapping(&self, tool: &str) -> CsvMapping {
        CsvMapping {
            tool: tool.to_owned(),
            time: self.time.to_columns(),
            stamp: self.stamp.as_ref().map(TimeColumnsConfig::to_columns).unwrap_or_default(),
            position: self.position.clone(),
            position_unit_mm: self.position_unit_mm,
            quaternion_wxyz: self.quaternion_wxyz.clone(),
            skip: Duration::from_secs_f64(self.skip_s),
        }
    }
}

impl TimeColumnsConfig {
    pub(super) fn to_columns(&self) -> Vec<TimeColumn> {
        let columns =
            [(&self.s, 1_000_000_000), (&self.ms, 1_000_000), (&self.us, 1000), (&self.ns, 1)];
        let named = |(name, unit_ns): (&Option<String>, _)| {
            name.clone().map(|name| TimeColumn { name, unit_ns })
        };
        columns.into_iter().filter_map(named).collect()
    }
}
