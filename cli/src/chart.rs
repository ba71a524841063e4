//! Line charts as SVG: values over steps or seconds, divided into stages. The scale is logarithmic for positive values over a wide range.

use crate::html::escaped;
use std::fmt::Write;

/// Small, so that the text is readable at the width of a phone.
const WIDTH: f64 = 600.0;
const HEIGHT: f64 = 380.0;
/// Height of a line of the legend.
const LEGEND: f64 = 20.0;
const LEFT: f64 = 88.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 64.0;
const BOTTOM: f64 = 56.0;
/// Minimum width of a part of the horizontal axis with a name.
const NARROWEST: f64 = 40.0;

const INK: &str = "#222";
const FAINT: &str = "#e4e4e4";
const MARK: &str = "#888";
/// Colors of the curves, in order.
const CURVES: [&str; 6] = ["#1f5fa8", "#c8501e", "#3a8a3a", "#7a4fa0", "#a07a20", "#3a8f8f"];

/// A chart.
#[derive(Debug, Default)]
pub struct Chart {
    /// Title above the chart.
    pub title: String,
    /// Label of the horizontal axis, and its end; it begins at 0.
    pub across: (String, f64),
    /// Label of the vertical axis.
    pub up: String,
    /// Parts of the horizontal axis: start and name.
    pub parts: Vec<(f64, String)>,
    /// The curves. Several curves have a legend.
    pub curves: Vec<Curve>,
}

/// A curve, and a pale band around it.
#[derive(Debug, Clone, Default)]
pub struct Curve {
    /// Name in the legend.
    pub name: String,
    /// Polylines, each a list of points.
    pub lines: Vec<Vec<(f64, f64)>>,
    /// Points of the band, with the lowest and the highest value.
    pub band: Vec<(f64, f64, f64)>,
}

impl Chart {
    /// Formats the chart as SVG.
    pub fn svg(&self) -> String {
        let (across, end) = (&self.across.0, self.across.1.max(f64::MIN_POSITIVE));
        let x = |place: f64| LEFT + place / end * (WIDTH - LEFT - RIGHT);
        let on_lines = self.curves.iter().flat_map(|curve| curve.lines.iter().flatten().map(|point| point.1));
        let in_bands = self.curves.iter().flat_map(|curve| curve.band.iter().flat_map(|(_, low, high)| [*low, *high]));
        let scale = Scale::of(on_lines.chain(in_bands), self.up == DECIBELS);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {1}\" font-family=\"Helvetica, Arial, sans-serif\" \
             font-size=\"15\" fill=\"{INK}\">\n<title>{0}</title>\n<rect width=\"{WIDTH}\" height=\"{1}\" fill=\"#fff\"/>\n\
             <text x=\"{LEFT}\" y=\"24\" font-size=\"17\">{0}</text>\n",
            escaped(&self.title),
            HEIGHT + if self.curves.len() > 1 { LEGEND * self.curves.len() as f64 + 6.0 } else { 0.0 },
        );
        let (bottom, right) = (HEIGHT - BOTTOM, WIDTH - RIGHT);
        for (value, label) in scale.ticks() {
            let y = scale.y(value);
            line(&mut svg, [LEFT, y, right, y], FAINT, "");
            text(&mut svg, LEFT - 8.0, y + 4.5, "end", &label);
        }
        for (tick, label) in linear_ticks(0.0, end, 6) {
            line(&mut svg, [x(tick), bottom, x(tick), bottom + 5.0], INK, "");
            text(&mut svg, x(tick), bottom + 20.0, "middle", &label);
        }
        for (i, (from, name)) in self.parts.iter().enumerate() {
            if *from > 0.0 {
                line(&mut svg, [x(*from), TOP, x(*from), bottom], MARK, " stroke-dasharray=\"4 3\"");
            }
            let to = self.parts.get(i + 1).map_or(end, |next| next.0);
            if x(to) - x(*from) >= NARROWEST {
                text(&mut svg, x(0.5 * (from + to)), TOP - 10.0, "middle", name);
            }
        }
        for (i, curve) in self.curves.iter().enumerate() {
            let color = CURVES[i % CURVES.len()];
            let dashes = ["", " stroke-dasharray=\"6 3\"", " stroke-dasharray=\"2 3\""][i / CURVES.len() % 3];
            let place = |at: f64, value: f64| format!("{:.1},{:.1} ", x(at), scale.y(value));
            if !curve.band.is_empty() {
                let above = curve.band.iter().map(|(at, _, high)| place(*at, *high));
                let below = curve.band.iter().rev().map(|(at, low, _)| place(*at, *low));
                let band: String = above.chain(below).collect();
                let _ = writeln!(svg, "<polygon points=\"{band}\" fill=\"{color}\" fill-opacity=\"0.22\"/>");
            }
            for points in curve.lines.iter().filter(|points| !points.is_empty()) {
                // A line of one point would not be seen.
                if let [(at, value)] = points[..] {
                    let _ = writeln!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{color}\"/>", x(at), scale.y(value));
                    continue;
                }
                let points: String = points.iter().map(|(at, value)| place(*at, *value)).collect();
                let style = format!("stroke-width=\"1.8\" stroke-linejoin=\"round\"{dashes}");
                let _ = writeln!(svg, "<polyline points=\"{points}\" fill=\"none\" stroke=\"{color}\" {style}/>");
            }
            if self.curves.len() > 1 {
                let y = HEIGHT + 6.0 + LEGEND * i as f64;
                line(&mut svg, [LEFT, y, LEFT + 30.0, y], color, &format!(" stroke-width=\"3\"{dashes}"));
                text(&mut svg, LEFT + 38.0, y + 4.5, "start", &curve.name);
            }
        }
        line(&mut svg, [LEFT, bottom, right, bottom], INK, "");
        line(&mut svg, [LEFT, TOP, LEFT, bottom], INK, "");
        text(&mut svg, 0.5 * (LEFT + right), HEIGHT - 12.0, "middle", across);
        let y = 0.5 * (TOP + bottom);
        let up = escaped(&self.up) + if scale.logarithmic { " (log scale)" } else { "" };
        let _ = writeln!(svg, "<text transform=\"translate(16 {y}) rotate(-90)\" text-anchor=\"middle\">{up}</text>\n</svg>");
        svg
    }
}

/// The unit of values that are logarithms.
pub const DECIBELS: &str = "dB";
/// Maximum range of a logarithmic scale, as a factor; smaller values are drawn at its lower end.
const LONGEST: f64 = 1e4;

/// Vertical scale. It is logarithmic if no value is negative, the positive values differ by more than a factor of five, and the values are not in decibels.
struct Scale {
    logarithmic: bool,
    low: f64,
    high: f64,
}

impl Scale {
    fn of(values: impl Iterator<Item = f64> + Clone, are_logarithms: bool) -> Self {
        let finite = || values.clone().filter(|value| value.is_finite());
        let low = finite().fold(f64::INFINITY, f64::min);
        let high = finite().fold(f64::NEG_INFINITY, f64::max);
        if low > high {
            return Scale { logarithmic: false, low: 0.0, high: 1.0 };
        }
        let least = finite().filter(|value| *value > 0.0).fold(f64::INFINITY, f64::min);
        if !are_logarithms && low >= 0.0 && high > 5.0 * least {
            let (low, high) = (least.max(high / LONGEST) / 1.15, high * 1.15);
            return Scale { logarithmic: true, low, high };
        }
        let margin = 0.05 * (high - low).max(1e-6 * high.abs()).max(1e-12);
        Scale { logarithmic: false, low: low - margin, high: high + margin }
    }

    fn y(&self, value: f64) -> f64 {
        let place = match self.logarithmic {
            true => (value / self.low).ln() / (self.high / self.low).ln(),
            false => (value - self.low) / (self.high - self.low),
        };
        let bottom = HEIGHT - BOTTOM;
        bottom - place.clamp(0.0, 1.0) * (bottom - TOP)
    }

    /// Values of the grid lines, with labels: 1, 2 and 5 in every decade, or only powers of ten over many decades.
    fn ticks(&self) -> Vec<(f64, String)> {
        if !self.logarithmic {
            return linear_ticks(self.low, self.high, 6);
        }
        let decades = (self.high / self.low).log10();
        let steps: &[f64] = if decades > 3.0 { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let powers = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        powers
            .flat_map(|power| steps.iter().map(move |step| step * 10f64.powi(power)))
            .filter(|v| (self.low..=self.high).contains(v))
            .map(|v| (v, label(v)))
            .collect()
    }
}

fn label(value: f64) -> String {
    // Rounded to two digits, so that 5 · 10⁻³ is not 0.0050000000000000001.
    match value.abs() {
        0.0 => "0".to_owned(),
        v if !(1e-4..1e5).contains(&v) => format!("{value:.0e}"),
        v => {
            let digits = (1.0 - v.log10().floor()).max(0.0) as usize;
            let text = format!("{value:.digits$}");
            match text.contains('.') {
                true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
                false => text,
            }
        }
    }
}

/// Returns at most `most` + 1 round numbers between two bounds, with labels of the necessary decimals.
fn linear_ticks(low: f64, high: f64, most: usize) -> Vec<(f64, String)> {
    let rough = (high - low) / most as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|k| k * power);
    let step = step.into_iter().find(|s| *s >= rough).unwrap_or(10.0 * power);
    let (unit, name) = match low.abs().max(high.abs()) {
        1e6.. => (1e6, " M"),
        1e4.. => (1e3, " k"),
        _ => (1.0, ""),
    };
    let digits = (-(step / unit * 1.0001).log10().floor()).max(0.0) as usize;
    let label = |value: f64| if value == 0.0 { "0".to_owned() } else { format!("{:.digits$}{name}", value / unit) };
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|k| k as f64 * step).map(|value| (value, label(value))).collect()
}

fn line(svg: &mut String, [x1, y1, x2, y2]: [f64; 4], color: &str, more: &str) {
    let _ = writeln!(svg, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{color}\"{more}/>");
}

fn text(svg: &mut String, x: f64, y: f64, anchor: &str, text: &str) {
    let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>", escaped(text));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers_with_short_labels() {
        let scale = Scale::of([0.004, 0.11].into_iter(), false);
        let labels: Vec<String> = scale.ticks().into_iter().map(|(_, label)| label).collect();
        assert_eq!(labels, ["0.005", "0.01", "0.02", "0.05", "0.1"]);
        // A curve that begins at 0 is shown completely, and a curve near 0 does not compress the others.
        let scale = Scale::of([0.0, 1e-12, 0.01, 1.0].into_iter(), false);
        assert!(scale.logarithmic && scale.low > 5e-5 && scale.y(0.0) == HEIGHT - BOTTOM && scale.y(0.01) < scale.y(1e-12));
        assert!(!Scale::of([5.0, 33.0].into_iter(), true).logarithmic && !Scale::of([-1.0, 33.0].into_iter(), false).logarithmic);
        let said = |low, high, most| linear_ticks(low, high, most).into_iter().map(|(_, label)| label).collect::<Vec<_>>();
        assert_eq!(said(0.0, 4400.0, 8), ["0", "1000", "2000", "3000", "4000"]);
        assert_eq!(said(28.2, 30.6, 6), ["28.5", "29.0", "29.5", "30.0", "30.5"]);
        assert_eq!(said(0.95e6, 1.42e6, 6), ["1.0 M", "1.1 M", "1.2 M", "1.3 M", "1.4 M"]);
        assert_eq!(said(0.0, 1.3, 8), ["0", "0.2", "0.4", "0.6", "0.8", "1.0", "1.2"]);
        assert_eq!([label(0.0), label(2.5), label(1e-7), label(100.0)], ["0", "2.5", "1e-7", "100"]);
    }
}
