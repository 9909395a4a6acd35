//! Plots with logarithmic axes, as SVG.

use std::ops::Range;

use plotters::prelude::*;

use crate::Ladder;

/// A panel's size in pixels.
const PANEL: (u32, u32) = (460, 320);

/// The colours of a panel's series, one after the other.
const COLORS: [RGBColor; 7] = [
    RGBColor(110, 110, 110),
    RGBColor(200, 30, 30),
    RGBColor(30, 90, 200),
    RGBColor(20, 140, 60),
    RGBColor(190, 120, 0),
    RGBColor(130, 50, 170),
    RGBColor(0, 150, 160),
];

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Failed<'a> = DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>;

/// Why a plot cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw a plot: {0}")]
pub struct PlotError(String);

impl From<Failed<'_>> for PlotError {
    fn from(failed: Failed<'_>) -> Self {
        Self(failed.to_string())
    }
}

/// Draws error against time, one panel a scene: a line a series, with 95 % bands.
pub fn draw_errors(ladders: &[Ladder]) -> Result<String, PlotError> {
    let panels: Vec<Panel> = ladders
        .iter()
        .map(|ladder| Panel {
            caption: ladder.name.clone(),
            x: "time on one thread, ms",
            y: "RMSE",
            y_limits: None,
            is_joined: true,
            legend: Legend::UpperRight,
            series: (ladder.series.iter())
                .map(|series| {
                    let points = series.rungs.iter().map(|rung| {
                        let (rmse, band) = rung.rmse();
                        [rung.time(), rmse, band]
                    });
                    (series.name.clone(), points.collect())
                })
                .collect(),
        })
        .collect();
    draw(&panels)
}

/// One plot: series of points with logarithmic axes.
#[derive(Debug)]
pub struct Panel {
    /// What stands above it.
    pub caption: String,
    /// What stands below the horizontal axis.
    pub x: &'static str,
    /// What stands beside the vertical axis.
    pub y: &'static str,
    /// The ends of the vertical axis; those of the points when missing.
    pub y_limits: Option<Range<f64>>,
    /// The points of a series are joined by a line.
    pub is_joined: bool,
    /// Where the names of the series stand.
    pub legend: Legend,
    /// A name and the points (x, y, half the width of the band of y) of each series.
    pub series: Vec<(String, Vec<[f64; 3]>)>,
}

/// The corner of a panel that its legend stands in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Legend {
    /// The upper left one.
    UpperLeft,
    /// The upper right one.
    UpperRight,
}

/// One plot: bars that lie below each other, from 0 on, each with words on it.
#[derive(Debug)]
pub struct Bars {
    /// What stands above it.
    pub caption: String,
    /// What stands below the axis.
    pub x: &'static str,
    /// Each bar's length, what stands on it, and its colour's place among the colours.
    pub bars: Vec<(f64, String, usize)>,
}

/// Draws panels side by side, two in a row, as one SVG.
pub fn draw(panels: &[Panel]) -> Result<String, PlotError> {
    draw_all(panels, Panel::draw)
}

/// The same for bars.
pub fn draw_bars(panels: &[Bars]) -> Result<String, PlotError> {
    draw_all(panels, Bars::draw)
}

fn draw_all<P>(
    panels: &[P],
    draw: for<'a> fn(&P, &Area<'a>) -> Result<(), Failed<'a>>,
) -> Result<String, PlotError> {
    let columns = panels.len().clamp(1, 2);
    let rows = panels.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        root.fill(&WHITE)?;
        for (panel, area) in panels.iter().zip(root.split_evenly((rows, columns))) {
            draw(panel, &area)?;
        }
        root.present()?;
    }
    Ok(text)
}

impl Bars {
    fn draw<'a>(&self, area: &Area<'a>) -> Result<(), Failed<'a>> {
        let longest = self.bars.iter().map(|bar| bar.0).fold(0.0, f64::max);
        let mut chart = ChartBuilder::on(area)
            .caption(&self.caption, ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(36)
            .build_cartesian_2d(0.0..longest * 1.5, self.bars.len() as f64..0.0)?;
        chart.configure_mesh().disable_y_mesh().x_desc(self.x).light_line_style(WHITE).draw()?;
        chart.draw_series((0..).map(f64::from).zip(&self.bars).map(
            |(y, &(length, _, color))| {
                let color = COLORS[color % COLORS.len()].mix(0.6).filled();
                Rectangle::new([(0.0, y + 0.1), (length, y + 0.9)], color)
            },
        ))?;
        chart.draw_series((0..).map(f64::from).zip(&self.bars).map(|(y, (_, words, _))| {
            Text::new(words.clone(), (longest * 0.01, y + 0.25), ("sans-serif", 11))
        }))?;
        Ok(())
    }
}

impl Panel {
    /// A little more than the values of an axis take up.
    fn limits(&self, axis: usize) -> Range<f64> {
        let points = self.series.iter().flat_map(|(_, points)| points);
        let values = points.map(|point| point[axis]).filter(|value| *value > 0.0);
        let (low, high) = values
            .fold((f64::INFINITY, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
        if low <= high { low / 1.5..high * 1.5 } else { 0.1..1.0 }
    }

    /// The same across, with room for a long legend.
    fn limits_across(&self) -> Range<f64> {
        let Range { start, end } = self.limits(0);
        // Half as wide again, in logarithms.
        let more = if self.series.len() > 2 { (end / start).sqrt().max(2.0) } else { 1.0 };
        match self.legend {
            Legend::UpperLeft => start / more..end,
            Legend::UpperRight => start..end * more,
        }
    }

    fn draw<'a>(&self, area: &Area<'a>) -> Result<(), Failed<'a>> {
        let y_limits = self.y_limits.clone().unwrap_or_else(|| self.limits(1));
        let mut chart = ChartBuilder::on(area)
            .caption(&self.caption, ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(36)
            .y_label_area_size(64)
            .build_cartesian_2d(self.limits_across().log_scale(), y_limits.log_scale())?;
        chart
            .configure_mesh()
            .x_labels(4)
            .y_labels(4)
            .x_desc(self.x)
            .y_desc(self.y)
            .y_label_formatter(&|error| format!("{error:.0e}"))
            .light_line_style(WHITE)
            .draw()?;
        for ((name, points), color) in self.series.iter().zip(COLORS.into_iter().cycle()) {
            let line = points.iter().filter(|_| self.is_joined).map(|&[x, y, _]| (x, y));
            chart.draw_series(LineSeries::new(line, color.stroke_width(2)))?.label(name).legend(
                move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)),
            );
            chart.draw_series(
                points.iter().map(|&[x, y, _]| Circle::new((x, y), 3, color.filled())),
            )?;
            chart.draw_series(points.iter().map(|&[x, y, band]| {
                let low = (y - band).max(y / 10.0);
                PathElement::new([(x, low), (x, y + band)], color.stroke_width(1))
            }))?;
        }
        let legend = match self.legend {
            Legend::UpperLeft => SeriesLabelPosition::UpperLeft,
            Legend::UpperRight => SeriesLabelPosition::UpperRight,
        };
        chart.configure_series_labels().position(legend).background_style(WHITE).draw()
    }
}
