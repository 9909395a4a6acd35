//! The file beside a picture: what the picture's own file says of it, and what that must not say,
//! so that its bytes are the same whoever rendered it: when that was, how long it took, on which
//! hosts.

use std::{
    collections::BTreeSet,
    io::Write,
    path::PathBuf,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use anyhow::Context;
use rtfarm_core::render::Tally;
use rtfarm_picture::PictureReader;
use serde_json::{Map, Value, json};
use tokio_util::sync::CancellationToken;

use crate::output::Output;

/// What it is called, after the picture.
const EXTENSION: &str = ".json";

/// How a picture came about.
#[derive(Debug, Clone)]
pub(crate) struct Making {
    /// From the first lease to the last tile.
    pub(crate) rendering: Duration,
    pub(crate) workers: usize,
    /// Where they ran.
    pub(crate) hosts: BTreeSet<String>,
    pub(crate) tally: Tally,
}

impl Making {
    /// Where the file is.
    pub(crate) fn path(output: &Output) -> PathBuf {
        output.beside(EXTENSION)
    }

    /// Writes the file beside a picture that is in its place. Never call this on the async runtime.
    pub(crate) fn write(&self, output: &Output, stop: &CancellationToken) -> anyhow::Result<()> {
        let name = output.name().display();
        let reader = PictureReader::open(output.path())
            .with_context(|| format!("cannot read what {name} says of itself"))?;
        let lines = reader.notes().provenance.lines().filter_map(|line| line.split_once(' '));
        let said = lines.map(|(word, value)| (word.to_owned(), Value::from(value)));
        let Self { rendering, workers, hosts, tally } = self;
        let size = reader.size();
        let value = json!({
            "picture": name.to_string(),
            "width": size.width(),
            "height": size.height(),
            "time": now(),
            "seconds": rendering.as_secs_f64(),
            "workers": workers,
            "hosts": hosts,
            "rays": tally.rays,
            "samples": tally.samples,
            "error": tally.error(),
            "provenance": said.collect::<Map<String, Value>>(),
        });
        output.write_beside(EXTENSION, stop, |file| writeln!(file, "{value:#}"))
    }
}

/// Seconds since 1970.
#[expect(clippy::disallowed_methods, reason = "the user is told when")]
fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |time| time.as_secs())
}
