//! Line plots as SVG, for reports.

use plotters::prelude::*;
use std::ops::Range;

/// Pixels of a plot; browsers scale it.
const SIZE: (u32, u32) = (560, 380);

/// The points that are drawn in one colour.
pub struct Series {
    pub name: String,
    pub points: Vec<(f64, f64)>,
    /// Whether the points are joined, in the order given.
    pub line: bool,
}

/// How positions along an axis stand for values.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    Linear,
    /// Values that are not above 0 are left out.
    Log,
}

/// An axis.
#[derive(Clone, Copy)]
pub struct Axis<'a> {
    pub label: &'a str,
    pub scale: Scale,
}

/// A plot as an `<svg>` element. Points that are not finite are left out.
pub fn plot(x: Axis<'_>, y: Axis<'_>, series: &[Series]) -> String {
    let position = |&(px, py): &(f64, f64)| (x.position(px), y.position(py));
    let placed: Vec<Vec<(f64, f64)>> = (series.iter())
        .map(|s| s.points.iter().map(position).filter(|(x, y)| x.is_finite() && y.is_finite()).collect())
        .collect();
    let range = |value: fn(&(f64, f64)) -> f64| extent(placed.iter().flatten().map(value));
    let mut svg = String::new();
    let drawn = draw(&mut svg, (x, range(|p| p.0)), (y, range(|p| p.1)), series, &placed);
    drawn.expect("writing to a string does not fail");
    svg
}

type Drawn = Result<(), Box<dyn std::error::Error>>;

fn draw(
    svg: &mut String,
    (x, x_range): (Axis<'_>, Range<f64>),
    (y, y_range): (Axis<'_>, Range<f64>),
    series: &[Series],
    placed: &[Vec<(f64, f64)>],
) -> Drawn {
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    let mut chart = ChartBuilder::on(&root)
        .margin(8)
        .x_label_area_size(42)
        .y_label_area_size(58)
        .build_cartesian_2d(x_range, y_range)?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc(x.label)
        .y_desc(y.label)
        .x_label_formatter(&|position| x.tick(*position))
        .y_label_formatter(&|position| y.tick(*position))
        .draw()?;
    for (i, (series, points)) in series.iter().zip(placed).enumerate() {
        let color = Palette99::pick(i).to_rgba();
        if series.line {
            chart.draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))?;
        }
        chart
            .draw_series(points.iter().map(|point| Circle::new(*point, 3, color.filled())))?
            .label(&series.name)
            .legend(move |(x, y)| Circle::new((x + 8, y), 4, color.filled()));
    }
    if series.len() > 1 {
        chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3)).draw()?;
    }
    root.present()?;
    Ok(())
}

impl Axis<'_> {
    fn position(&self, value: f64) -> f64 {
        match self.scale {
            Scale::Linear => value,
            Scale::Log if value > 0.0 => value.log10(),
            Scale::Log => f64::NAN,
        }
    }

    fn tick(&self, position: f64) -> String {
        let (value, digits) = if self.scale == Scale::Log { (10f64.powf(position), 1) } else { (position, 3) };
        let rounded: f64 = format!("{value:.digits$e}").parse().unwrap_or(value);
        if (1e-3..1e5).contains(&rounded.abs()) || rounded == 0.0 {
            rounded.to_string()
        } else {
            format!("{rounded:.0e}")
        }
    }
}

/// The range of values with a margin; never empty.
fn extent(values: impl Iterator<Item = f64>) -> Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    if low > high {
        return 0.0..1.0;
    }
    let margin = (0.05 * (high - low)).max(1e-9 + 0.01 * high.abs());
    low - margin..high + margin
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_drawn_and_others_left_out() {
        let axis = |label| Axis { label, scale: Scale::Log };
        let points = vec![(1.0, 10.0), (0.0, 1.0), (f64::NAN, 1.0), (100.0, 1.0)];
        let svg = plot(axis("across"), axis("up"), &[Series { name: "a".into(), points, line: true }]);
        assert!(svg.starts_with("<svg") && svg.contains("across") && svg.contains("up"));
        assert_eq!(svg.matches("<circle").count(), 2, "{svg}");
        assert!(plot(axis("x"), axis("y"), &[]).starts_with("<svg"));
    }
}
