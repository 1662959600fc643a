use plotters::{coord::Shift, prelude::*};
use std::{fmt::Write, iter, ops::Range};

/// In pixels, without the legend.
const SIZE: (u32, u32) = (440, 330);
const MARGIN: i32 = 8;
/// Row height of the legend, and mean width of a letter.
const ROW: i32 = 20;
const LETTER: i32 = 7;
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

/// Returns an SVG with a legend titled `meaning`. Omits non-finite points and series past the
/// sixth. `beneath` is a gray line.
pub fn plot(x: Axis<'_>, y: Axis<'_>, meaning: &str, series: &[Series], beneath: Option<&Series>) -> String {
    let shown = &series[..series.len().min(COLORS.len())];
    let place = |at: &At| At { x: x.position(at.x), y: y.position(at.y), of: at.of };
    let placed = |series: &Series| -> Vec<At> {
        series.points.iter().map(place).filter(|at| at.x.is_finite() && at.y.is_finite()).collect()
    };
    let (points, line): (Vec<_>, _) = (shown.iter().map(placed).collect(), beneath.map(placed).unwrap_or_default());
    let range = |value: fn(&At) -> f64| extent(points.iter().chain([&line]).flatten().map(value));
    let (legend, height) = legend(meaning, shown, series.len() - shown.len(), beneath);
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, (SIZE.0, SIZE.1 + height)).into_drawing_area();
    let (chart, below) = root.split_vertically(SIZE.1);
    (root.fill(&WHITE).map_err(Into::into))
        .and_then(|()| draw(&chart, [x, y], [range(|at| at.x), range(|at| at.y)], shown, &points, &line))
        .and_then(|()| draw_legend(&below, legend))
        .and_then(|()| Ok(root.present()?))
        .expect("writing to a string does not fail");
    drop((root, chart, below));
    numbered(&svg, points.iter().flatten().map(|at| at.of))
}

pub fn sheet(plots: &[(&str, String)]) -> String {
    let height = |svg: &str| svg.split('"').skip_while(|part| !part.ends_with("height=")).nth(1)?.parse::<u32>().ok();
    let (mut sheet, mut top) = (String::new(), 0);
    for row in plots.chunks(2) {
        for ((heading, svg), left) in row.iter().zip([0, SIZE.0]) {
            let _ = write!(sheet, "<text x=\"{}\" y=\"{}\" font-weight=\"bold\">{heading}</text>", left + 8, top + ROW);
            sheet += &svg.replacen("<svg", &format!("<svg x=\"{left}\" y=\"{}\"", top + ROW + MARGIN), 1);
        }
        top += ROW + MARGIN + row.iter().filter_map(|(_, svg)| height(svg)).max().unwrap_or(0) as i32;
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{}\" height=\"{top}\" \
         font-family=\"sans-serif\" font-size=\"14\"><rect width=\"100%\" height=\"100%\" fill=\"white\"/>{sheet}</svg>\n",
        2 * SIZE.0
    )
}

fn numbered(svg: &str, numbers: impl Iterator<Item = Option<usize>>) -> String {
    let mut pieces = svg.split("<circle");
    let mut numbered = pieces.next().unwrap_or_default().to_owned();
    // Circles of the legend come last, without a number.
    for (piece, number) in pieces.zip(numbers.chain(iter::repeat(None))) {
        numbered += "<circle";
        if let Some(number) = number {
            let _ = write!(numbered, " data-point=\"{number}\"");
        }
        numbered += piece;
    }
    numbered
}

type Entry = (String, Option<RGBColor>, (i32, i32));
type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

fn legend(meaning: &str, shown: &[Series], omitted: usize, beneath: Option<&Series>) -> (Vec<Entry>, u32) {
    let names = iter::once((format!("{meaning}:"), None))
        .chain(beneath.map(|line| (line.name.clone(), Some(GRAY))))
        .chain(shown.iter().zip(COLORS).map(|(series, color)| (series.name.clone(), Some(color))))
        .chain((omitted > 0).then(|| (format!("{omitted} more: in the table"), None)));
    let (mut left, mut top) = (MARGIN, 0);
    let place = |(name, color): (String, Option<RGBColor>)| {
        let width = LETTER * name.chars().count() as i32 + if color.is_some() { 30 } else { 14 };
        if left > MARGIN && left + width > SIZE.0 as i32 {
            (left, top) = (MARGIN, top + ROW);
        }
        left += width;
        (name, color, (left - width, top))
    };
    let entries: Vec<Entry> = names.map(place).collect();
    (entries, (top + ROW + MARGIN) as u32)
}

fn draw_legend(area: &Area<'_>, entries: Vec<Entry>) -> Drawn {
    for (name, color, (left, top)) in entries {
        if let Some(color) = color {
            area.draw(&Circle::new((left + 4, top + 8), 4, color.filled()))?;
        }
        let left = if color.is_some() { left + 14 } else { left };
        area.draw(&Text::new(name, (left, top), ("sans-serif", 14)))?;
    }
    Ok(())
}

fn draw(
    root: &Area<'_>,
    [x, y]: [Axis<'_>; 2],
    [x_range, y_range]: [Range<f64>; 2],
    series: &[Series],
    placed: &[Vec<At>],
    line: &[At],
) -> Drawn {
    let mut chart = ChartBuilder::on(root)
        .margin(MARGIN)
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
        let circles: Vec<&str> = html.split("<circle data-point=").skip(1).map(|circle| &circle[..4]).collect();
        assert_eq!(circles, ["\"0\" ", "\"30\""], "{html}");
        assert!(plot(LOG, LOG, "nothing", &[], None).contains("<svg"));
    }

    #[test]
    fn a_sheet_has_two_plots_a_row() {
        let high: Vec<Series> = ('a'..='f').map(|name| series(&name.to_string().repeat(20), &[(1.0, 1.0)])).collect();
        let [low, high] = [&[][..], &high].map(|series| plot(LOG, LOG, "letters", series, None));
        let sheet = sheet(&[("first", low.clone()), ("second", high.clone()), ("third", low)]);
        assert_eq!(sheet.matches("<svg").count(), 4);
        let places = ["x=\"0\" y=\"28\"", "x=\"440\" y=\"28\"", "x=\"0\" y=\"454\""];
        assert!(places.iter().all(|place| sheet.contains(place)), "{sheet}");
    }

    #[test]
    fn at_most_six_series_have_a_color_each() {
        let all: Vec<Series> = ('a'..='h').map(|name| series(&name.to_string(), &[(1.0, 1.0)])).collect();
        let html = plot(LOG, LOG, "letters", &all, Some(&series("front", &[(1.0, 1.0), (2.0, 2.0)])));
        assert_eq!(html.matches("<circle").count(), 6 + 6 + 1);
        assert_eq!(html.matches("<circle data-point").count(), 6);
        assert!(html.contains("2 more") && html.contains("front"), "{html}");
        let circles = html.split("<circle").skip(1);
        let mut colors: Vec<&str> = circles.filter_map(|circle| circle.split("fill=\"").nth(1)?.get(..7)).collect();
        colors.sort_unstable();
        colors.dedup();
        assert_eq!(colors.len(), 7);
    }
}
