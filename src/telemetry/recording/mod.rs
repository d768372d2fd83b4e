//! The run for rerun's viewer: `run.rrd`, made when the run is over, and a live view while it goes on.
//! Nothing outside this module names rerun.
//!
//! Both log the same content. Angles are in degrees here: people read this, programs read `steps.csv`.
//!
//! A file has 1.2 MB for the layout, and at 10 ms SYNC, with two observers alongside, 3 to 4 MB a
//! metre of insertion at 2 mm/s, 6 MB at 1 mm/s.

mod can;
mod content;
mod document;
mod file;
mod layout;
pub(super) mod live;
mod motion;
mod now;
mod palette;
mod samples;
mod scene;
mod space;
mod states;
mod steps;
mod table;
mod views;

pub use self::file::Recording;
