//! `[tracker.csv]`: what the columns of a recorded stream hold.

use serde::Serialize;
use std::time::Duration;

use super::rule::Range;
use super::section::Section;
use crate::tracker::{CsvMapping, TimeColumn};

/// `[tracker.csv]`. Columns are named as in the file's header.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CsvConfig {
    /// What paces the replay.
    pub time: TimeColumnsConfig,
    /// When the sender says each position was measured, since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stamp: Option<TimeColumnsConfig>,
    /// x, y and z in the tracker's frame.
    pub position: [String; 3],
    /// Millimetres per unit of those columns.
    pub position_unit_mm: f64,
    /// w, x, y and z of the sensor's orientation in that frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quaternion_wxyz: Option<[String; 4]>,
    /// Of the beginning to leave out, s.
    pub skip_s: f64,
}

/// Columns that add up to a time, each in its unit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct TimeColumnsConfig {
    /// The column of seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub s: Option<String>,
    /// Of milliseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ms: Option<String>,
    /// Of microseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub us: Option<String>,
    /// Of nanoseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ns: Option<String>,
}

const COLUMN: &str = "the name of a column";

impl CsvConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        CsvConfig {
            time: s.section("time", TimeColumnsConfig::read),
            stamp: s.optional_section("stamp", TimeColumnsConfig::read),
            position: s.texts("position", COLUMN),
            position_unit_mm: s.number("position_unit_mm", Range::over(0.0, 1e6)),
            quaternion_wxyz: s.optional_texts("quaternion_wxyz", COLUMN),
            skip_s: s.number("skip_s", Range::within(0.0, 1e6)),
        }
    }

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
    fn read(s: &mut Section<'_>) -> Self {
        TimeColumnsConfig {
            s: s.optional_text("s", COLUMN),
            ms: s.optional_text("ms", COLUMN),
            us: s.optional_text("us", COLUMN),
            ns: s.optional_text("ns", COLUMN),
        }
    }

    /// True where no column is named.
    pub(super) fn is_empty(&self) -> bool {
        self.to_columns().is_empty()
    }

    fn to_columns(&self) -> Vec<TimeColumn> {
        let columns =
            [(&self.s, 1_000_000_000), (&self.ms, 1_000_000), (&self.us, 1000), (&self.ns, 1)];
        let named = columns
            .into_iter()
            .filter_map(|(name, unit_ns)| name.clone().map(|name| TimeColumn { name, unit_ns }));
        named.collect()
    }
}
