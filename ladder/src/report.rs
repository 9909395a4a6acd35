//! A report: its text, the plots that it shows, and how they are written.

use std::{fs, io, os::unix::fs::PermissionsExt, path::Path, slice};

use rtfarm_core::render::StandardError;

use crate::{
    Ladder,
    plot::{PlotError, draw_errors},
    tables::{LEGEND, method, soonest, table},
};

/// The plot of error against time, beside a report.
pub const ERROR_PLOT: &str = "error-against-time.svg";

/// A text in Markdown and the plots that it shows.
#[derive(Debug)]
pub struct Report {
    /// What it says.
    pub text: String,
    /// The name and the SVG of each plot.
    pub plots: Vec<(&'static str, String)>,
}

impl Report {
    /// The report on a user's scene. `wanted` is the error of its picture that is asked for, where
    /// 1 is full light; some are looked at when it is missing.
    pub fn on_scene(ladder: &Ladder, wanted: Option<StandardError>) -> Result<Self, PlotError> {
        let samples = ladder.reference.map_or(0, |reference| reference.samples.get());
        let text = [
            &*format!(
                "# Speed against error\n\nTruth is the picture at {samples} samples a pixel. {LEGEND}"
            ),
            &soonest(ladder, wanted),
            &table(ladder),
            &format!("![error against time]({ERROR_PLOT})\n\n"),
            &method(slice::from_ref(ladder)),
        ];
        let plots = vec![(ERROR_PLOT, draw_errors(slice::from_ref(ladder))?)];
        Ok(Self { text: text.concat(), plots })
    }

    /// Writes `report.md` and the plots into a folder, which is made if it is missing; each file is
    /// whole or not there.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        fs::create_dir_all(folder)?;
        let plots = self.plots.iter().map(|(name, plot)| (*name, plot));
        for (name, content) in [("report.md", &self.text)].into_iter().chain(plots) {
            let file = tempfile::Builder::new()
                .permissions(fs::Permissions::from_mode(0o666))
                .tempfile_in(folder)?;
            fs::write(file.path(), content)?;
            file.persist(folder.join(name)).map_err(|error| error.error)?;
        }
        Ok(())
    }
}
