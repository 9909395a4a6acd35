//! A client of a farm: it orders a picture, waits for it and brings it. `submission` decides what
//! is done next, a pure state machine with events in, actions out and time as an argument;
//! [`run()`] does it, in surroundings that are handed in.

mod plain;
mod run;
mod submission;

pub use plain::plain;
pub use run::{Order, Outside, is_lost, run, time_left};
pub use submission::{
    Ended, FIRST_PAUSE, Finished, JobEnd, JobState, LONGEST_PAUSE, NoPicture, Trouble,
};
