//! Error against time, and against rays a second, drawn.

use std::ops::Range;

use anyhow::anyhow;
use plotters::prelude::*;

use super::{
    figures::median,
    kernels::{Case, Kernel, names},
    ladder::Ladder,
};

/// The plots' files, beside the report.
pub(super) const ERROR_FILE: &str = "error-against-time.svg";
pub(super) const PEERS_FILE: &str = "peers.svg";
pub(super) const KERNEL_FILE: &str = "kernels.svg";

/// A panel's size in pixels.
const PANEL: (u32, u32) = (460, 320);

/// Of the series of a panel, one after the other.
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

/// One panel a scene, as an SVG: a line a series, with 95 % bands.
pub(super) fn errors(ladders: &[Ladder]) -> anyhow::Result<String> {
    let panels: Vec<Panel> = ladders
        .iter()
        .map(|ladder| Panel {
            caption: ladder.name.clone(),
            x: "time on one thread, ms",
            y: "RMSE",
            y_limits: None,
            is_joined: true,
            legend: SeriesLabelPosition::UpperRight,
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

/// One panel a place of the mesh, as an SVG: a point a kernel and aim.
pub(super) fn kernels(cases: &[Case]) -> anyhow::Result<String> {
    let panels: Vec<Panel> = cases
        .chunk_by(|a, b| a.moved == b.moved)
        .map(|cases| Panel {
            caption: format!("the mesh moved by {:e}", cases[0].moved),
            x: "million rays a second",
            y: "largest relative error",
            // From double precision to worse than single.
            y_limits: Some(3e-17..1e-5),
            is_joined: false,
            legend: SeriesLabelPosition::UpperLeft,
            series: (names(cases).into_iter())
                .map(|name| {
                    let kernels = cases.iter().flat_map(|case| &case.kernels);
                    let is_drawn =
                        |kernel: &&Kernel| kernel.name == name && !kernel.speeds.is_empty();
                    let point = |kernel: &Kernel| [median(&kernel.speeds), kernel.worst, 0.0];
                    (name.to_owned(), kernels.filter(is_drawn).map(point).collect())
                })
                .filter(|(_, points): &(String, Vec<_>)| !points.is_empty())
                .collect(),
        })
        .collect();
    draw(&panels)
}

/// Series of (x, y, half a band of y) with logarithmic axes.
struct Panel {
    caption: String,
    x: &'static str,
    y: &'static str,
    /// Those of the points otherwise.
    y_limits: Option<Range<f64>>,
    is_joined: bool,
    legend: SeriesLabelPosition,
    series: Vec<(String, Vec<[f64; 3]>)>,
}

fn draw(panels: &[Panel]) -> anyhow::Result<String> {
    let columns = panels.len().clamp(1, 2);
    let rows = panels.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        root.fill(&WHITE).map_err(|error| anyhow!("{error}"))?;
        for (panel, area) in panels.iter().zip(root.split_evenly((rows, columns))) {
            panel.draw(&area).map_err(|error| anyhow!("{error}"))?;
        }
        root.present().map_err(|error| anyhow!("{error}"))?;
    }
    Ok(text)
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
            SeriesLabelPosition::UpperLeft => start / more..end,
            _ => start..end * more,
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
        chart.configure_series_labels().position(self.legend.clone()).background_style(WHITE).draw()
    }
}
