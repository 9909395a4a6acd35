//! Error against time, drawn.

use anyhow::anyhow;
use plotters::prelude::*;

use super::{
    figures::mean_and_band,
    ladder::{Ladder, Rung},
};

/// The plot's file, beside the report.
pub(super) const FILE: &str = "error-against-time.svg";

/// A panel's size in pixels.
const PANEL: (u32, u32) = (460, 320);

/// One panel a scene, as an SVG: fixed samples in grey, adaptive ones in red, with 95 % bands.
pub(super) fn draw(ladders: &[Ladder]) -> anyhow::Result<String> {
    let columns = ladders.len().clamp(1, 2);
    let rows = ladders.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        root.fill(&WHITE).map_err(|error| anyhow!("{error}"))?;
        for (ladder, area) in ladders.iter().zip(root.split_evenly((rows, columns))) {
            panel(ladder, &area).map_err(|error| anyhow!("{error}"))?;
        }
        root.present().map_err(|error| anyhow!("{error}"))?;
    }
    Ok(text)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Failed<'a> = DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>;

fn panel<'a>(ladder: &Ladder, area: &Area<'a>) -> Result<(), Failed<'a>> {
    let limits = |values: &dyn Fn(&Rung) -> f64| {
        let values = ladder.rungs().map(values).filter(|value| *value > 0.0);
        let (low, high) = values
            .fold((f64::INFINITY, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
        if low < high { low / 1.5..high * 1.5 } else { 0.1..1.0 }
    };
    let (time, error) = (limits(&|rung| rung.milliseconds), limits(&|rung| rmse(rung).0));
    let mut chart = ChartBuilder::on(area)
        .caption(&ladder.name, ("sans-serif", 16))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(64)
        .build_cartesian_2d(time.log_scale(), error.log_scale())?;
    chart
        .configure_mesh()
        .x_labels(4)
        .y_labels(4)
        .x_desc("time on one thread, ms")
        .y_desc("RMSE")
        .y_label_formatter(&|error| format!("{error:.0e}"))
        .light_line_style(WHITE)
        .draw()?;
    let kinds = [
        ("--samples", &ladder.fixed, RGBColor(110, 110, 110)),
        ("--error", &ladder.adaptive, RGBColor(200, 30, 30)),
    ];
    for (name, rungs, color) in kinds {
        let points = || rungs.iter().map(|rung| (rung.milliseconds, rmse(rung)));
        chart
            .draw_series(LineSeries::new(
                points().map(|(x, (y, _))| (x, y)),
                color.stroke_width(2),
            ))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
        chart.draw_series(points().map(|(x, (y, _))| Circle::new((x, y), 3, color.filled())))?;
        chart.draw_series(points().map(|(x, (y, band))| {
            PathElement::new([(x, (y - band).max(y / 10.0)), (x, y + band)], color.stroke_width(1))
        }))?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE)
        .draw()
}

fn rmse(rung: &Rung) -> (f64, f64) {
    mean_and_band(rung.errors.iter().map(|errors| errors.rmse))
}
