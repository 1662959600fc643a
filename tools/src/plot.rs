use plotters::prelude::*;
use std::{fmt::Write, ops::Range};

/// In pixels; browsers scale it.
const SIZE: (u32, u32) = (440, 330);
/// Colors for any color vision (Okabe and Ito); their number limits the series.
const COLORS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
];
const GRAY: RGBColor = RGBColor(150, 150, 150);

#[derive(Clone, Copy, Debug)]
pub struct At {
    pub x: f64,
    pub y: f64,
    /// `data-point` of the circle.
    pub of: Option<usize>,
}

#[derive(Debug)]
pub struct Series {
    pub name: String,
    pub points: Vec<At>,
    pub line: bool,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    Linear,
    /// Drops values of at most 0.
    Log,
}

#[derive(Clone, Copy)]
pub struct Axis<'a> {
    pub label: &'a str,
    pub scale: Scale,
}

/// Returns a plot with a legend titled `meaning`. Omits non-finite points and series past the
/// sixth, which the legend counts. `beneath` is a gray line without points.
pub fn plot(x: Axis<'_>, y: Axis<'_>, meaning: &str, series: &[Series], beneath: Option<&Series>) -> String {
    let shown = &series[..series.len().min(COLORS.len())];
    let place = |at: &At| At { x: x.position(at.x), y: y.position(at.y), of: at.of };
    let placed = |series: &Series| -> Vec<At> {
        series.points.iter().map(place).filter(|at| at.x.is_finite() && at.y.is_finite()).collect()
    };
    let (points, line): (Vec<_>, _) = (shown.iter().map(placed).collect(), beneath.map(placed).unwrap_or_default());
    let range = |value: fn(&At) -> f64| extent(points.iter().chain([&line]).flatten().map(value));
    let mut svg = String::new();
    let drawn = draw(&mut svg, (x, range(|at| at.x)), (y, range(|at| at.y)), shown, &points, &line);
    drawn.expect("writing to a string does not fail");
    // HTML needs no namespace.
    let svg = svg.replace(" xmlns=\"http://www.w3.org/2000/svg\"", "");
    let numbers = points.iter().flatten().map(|at| at.of);
    format!(
        "<div class=\"plot\">{}{}</div>",
        numbered(&svg, numbers),
        legend(meaning, shown, series.len() - shown.len(), beneath)
    )
}

fn numbered(svg: &str, numbers: impl Iterator<Item = Option<usize>>) -> String {
    let mut pieces = svg.split("<circle");
    let mut numbered = pieces.next().unwrap_or_default().to_owned();
    for (piece, number) in pieces.zip(numbers) {
        numbered += "<circle";
        if let Some(number) = number {
            let _ = write!(numbered, " data-point=\"{number}\"");
        }
        numbered += piece;
    }
    numbered
}

fn legend(meaning: &str, shown: &[Series], skipped_passes: usize, beneath: Option<&Series>) -> String {
    let row = |(name, RGBColor(r, g, b)): (&String, RGBColor)| {
        format!("<li><i style=\"background:rgb({r},{g},{b})\"></i>{name}</li>")
    };
    let names = beneath.map(|line| (&line.name, GRAY)).into_iter();
    let rows: String = names.chain(shown.iter().map(|series| &series.name).zip(COLORS)).map(row).collect();
    let more = if skipped_passes > 0 { format!("<li>{skipped_passes} more: in the table</li>") } else { String::new() };
    format!("<ul class=\"legend\"><li>{meaning}</li>{rows}{more}</ul>")
}

type Drawn = Result<(), Box<dyn std::error::Error>>;

fn draw(
    svg: &mut String,
    (x, x_range): (Axis<'_>, Range<f64>),
    (y, y_range): (Axis<'_>, Range<f64>),
    series: &[Series],
    placed: &[Vec<At>],
    line: &[At],
) -> Drawn {
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    let mut chart = ChartBuilder::on(&root)
        .margin(8)
        .x_label_area_size(42)
        .y_label_area_size(54)
        .build_cartesian_2d(x_range, y_range)?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_labels(6)
        .y_labels(6)
        .label_style(("sans-serif", 14))
        .axis_desc_style(("sans-serif", 15))
        .x_desc(x.label)
        .y_desc(y.label)
        .x_label_formatter(&|position| x.tick(*position))
        .y_label_formatter(&|position| y.tick(*position))
        .draw()?;
    let places = |points: &[At]| points.iter().map(|at| (at.x, at.y)).collect::<Vec<_>>();
    chart.draw_series(LineSeries::new(places(line), GRAY.stroke_width(5)))?;
    for ((series, points), color) in series.iter().zip(placed).zip(COLORS) {
        if series.line {
            chart.draw_series(LineSeries::new(places(points), color.stroke_width(2)))?;
        }
    }
    for (points, color) in placed.iter().zip(COLORS) {
        chart.draw_series(places(points).into_iter().map(|at| Circle::new(at, 4, color.filled())))?;
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

/// Adds a margin; never empty.
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

    const LOG: Axis<'_> = Axis { label: "across", scale: Scale::Log };

    fn series(name: &str, places: &[(f64, f64)]) -> Series {
        let at = |(i, (x, y)): (usize, &(f64, f64))| At { x: *x, y: *y, of: Some(10 * i) };
        Series { name: name.into(), points: places.iter().enumerate().map(at).collect(), line: true }
    }

    #[test]
    fn points_are_drawn_and_others_left_out() {
        let points = series("a", &[(1.0, 10.0), (0.0, 1.0), (f64::NAN, 1.0), (100.0, 1.0)]);
        let html = plot(LOG, Axis { label: "up", ..LOG }, "letters", &[points], None);
        assert!(html.contains("<svg") && html.contains("across") && html.contains("up"));
        let circles: Vec<&str> = html.split("<circle").skip(1).map(|circle| &circle[..16]).collect();
        assert_eq!(circles, [" data-point=\"0\" ", " data-point=\"30\""], "{html}");
        assert!(plot(LOG, LOG, "nothing", &[], None).contains("<svg"));
    }

    #[test]
    fn at_most_six_series_have_a_color_each() {
        let all: Vec<Series> = ('a'..='h').map(|name| series(&name.to_string(), &[(1.0, 1.0)])).collect();
        let html = plot(LOG, LOG, "letters", &all, Some(&series("front", &[(1.0, 1.0), (2.0, 2.0)])));
        assert_eq!(html.matches("<circle").count(), 6);
        // Title, background line, six series, and the omitted count.
        assert_eq!(html.matches("<li>").count(), 1 + 1 + 6 + 1);
        assert!(html.contains("2 more") && html.contains("front"), "{html}");
        let mut colors: Vec<&str> =
            html.split("background:").skip(1).filter_map(|piece| piece.split('"').next()).collect();
        colors.sort_unstable();
        colors.dedup();
        assert_eq!(colors.len(), 7);
    }
}
