//! Horizontal bars in groups, with their values printed at the ends.

use sixfold_geometry::RgbImage;

use crate::{COLORS, Canvas, FAINT, INK, text_width, ticks, ticks_logarithmic};

const WIDTH: usize = 760;
/// Heights of a bar, of the gap between groups, and of title, legend and axis, pixels.
const BAR: f64 = 15.0;
const GAP: f64 = 12.0;
const TITLE: f64 = 30.0;
const LEGEND: f64 = 22.0;
const AXIS: f64 = 40.0;
/// Margin between the longest label and the bars, and space right of the bars for their values, pixels.
const MARGIN: f64 = 10.0;
const VALUES: f64 = 64.0;
/// Side of a font's dot, pixels: text, title.
const SMALL: f64 = 1.5;
const LARGE: f64 = 2.0;

/// A chart of horizontal bars.
#[derive(Debug, Clone, Default)]
pub struct BarChart {
    /// Text above the chart.
    pub title: String,
    /// Quantity of the axis, with its unit.
    pub axis: String,
    /// Names of the bars of each group, for the legend; with fewer than two there is no legend.
    pub series: Vec<String>,
    /// Groups of bars, from top to bottom.
    pub groups: Vec<BarGroup>,
    /// Whether the axis is logarithmic (powers of ten).
    pub logarithmic: bool,
    /// End of a linear axis; `None`: the largest value.
    pub end: Option<f64>,
}

/// Bars with a common label.
#[derive(Debug, Clone, Default)]
pub struct BarGroup {
    /// Text left of the bars.
    pub label: String,
    /// One value for each series.
    pub values: Vec<f64>,
}

impl BarChart {
    /// The chart as an image, 760 pixels wide.
    pub fn render(&self) -> RgbImage {
        let bars: usize = self.groups.iter().map(|g| g.values.len()).sum();
        let legend = if self.series.len() > 1 { LEGEND } else { 0.0 };
        let top = TITLE + legend;
        let bottom = top + BAR * bars as f64 + GAP * self.groups.len() as f64;
        let mut canvas = Canvas::new(WIDTH, (bottom + AXIS) as usize);
        canvas.text(MARGIN, 8.0, LARGE, &self.title, INK);
        self.legend(&mut canvas);
        let labels = self.groups.iter().map(|g| text_width(&g.label, SMALL)).fold(0.0, f64::max);
        let left = labels + 2.0 * MARGIN;
        let at = self.axis(&mut canvas, (left, WIDTH as f64 - VALUES), (top, bottom));
        let mut y = top + 0.5 * GAP;
        for group in &self.groups {
            let label_y = y + 0.5 * BAR * group.values.len() as f64 - 3.5 * SMALL;
            canvas.text(left - MARGIN - text_width(&group.label, SMALL), label_y, SMALL, &group.label, INK);
            for (series, value) in group.values.iter().enumerate() {
                let length = (at(*value) - left).max(0.0);
                let color = COLORS[series % COLORS.len()];
                canvas.rectangle(left, y + 1.0, length, BAR - 2.0, color);
                canvas.text(left + length + 5.0, y + 0.5 * BAR - 3.5 * SMALL, SMALL, &written(*value), INK);
                y += BAR;
            }
            y += GAP;
        }
        canvas.line((left, top), (left, bottom), 1.0, INK);
        canvas.finish()
    }

    fn legend(&self, canvas: &mut Canvas) {
        let mut x = MARGIN;
        for (i, name) in self.series.iter().enumerate().filter(|_| self.series.len() > 1) {
            canvas.rectangle(x, TITLE + 1.0, 10.0, 10.0, COLORS[i % COLORS.len()]);
            canvas.text(x + 15.0, TITLE + 1.0, SMALL, name, INK);
            x += 15.0 + text_width(name, SMALL) + 2.0 * MARGIN;
        }
    }

    /// Draws grid lines with numbers; returns the map from a value to its position.
    fn axis(
        &self,
        canvas: &mut Canvas,
        (left, right): (f64, f64),
        (top, bottom): (f64, f64),
    ) -> impl Fn(f64) -> f64 + use<> {
        let values = || self.groups.iter().flat_map(|g| &g.values).copied();
        let largest = values().fold(f64::MIN_POSITIVE, f64::max);
        let logarithmic = self.logarithmic;
        let marks = if logarithmic {
            ticks_logarithmic(values().filter(|v| *v > 0.0).fold(f64::INFINITY, f64::min), largest)
        } else {
            ticks(0.0, self.end.unwrap_or(largest))
        };
        let (low, high) = (marks.low, marks.high);
        let at = move |value: f64| {
            let fraction = if logarithmic {
                (value.max(low).ln() - low.ln()) / (high.ln() - low.ln())
            } else {
                (value - low) / (high - low)
            };
            left + fraction.clamp(0.0, 1.0) * (right - left)
        };
        for (value, label) in &marks.marks {
            let x = at(*value);
            canvas.line((x, top), (x, bottom), 1.0, FAINT);
            canvas.text(x - 0.5 * text_width(label, SMALL), bottom + 5.0, SMALL, label, INK);
        }
        canvas.text(left, bottom + 22.0, SMALL, &self.axis, INK);
        at
    }
}

/// A value with three significant digits.
fn written(value: f64) -> String {
    let digits = if value == 0.0 { 0.0 } else { value.abs().log10().floor() };
    let decimals = (2.0 - digits).clamp(0.0, 3.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> BarChart {
        let group = |label: &str, values: &[f64]| BarGroup { label: label.into(), values: values.to_vec() };
        BarChart {
            title: "Title".into(),
            axis: "axis (ms)".into(),
            series: vec!["one".into(), "two".into()],
            groups: vec![group("first", &[0.25, 0.5]), group("second", &[1.0, 0.0])],
            logarithmic: false,
            end: Some(1.0),
        }
    }

    /// Pixels of a colour in a row of the image.
    fn length(image: &RgbImage, color: [u8; 3], y: usize) -> usize {
        (0..image.width()).filter(|x| image[(*x, y)] == color).count()
    }

    #[test]
    fn bars_are_as_long_as_their_values_say() {
        let image = chart().render();
        let row =
            |bar: f64, group: f64| (TITLE + LEGEND + 0.5 * GAP + BAR * (bar + 0.5) + GAP * group) as usize;
        let [a, b] = [length(&image, COLORS[0], row(0.0, 0.0)), length(&image, COLORS[1], row(1.0, 0.0))];
        let [c, d] = [length(&image, COLORS[0], row(2.0, 1.0)), length(&image, COLORS[1], row(3.0, 1.0))];
        assert!(c > 400 && d == 0, "{c} {d}");
        assert!(a.abs_diff(c / 4) <= 2 && b.abs_diff(c / 2) <= 2, "{a} {b} {c}");
        let logarithmic = BarChart {
            groups: vec![
                BarGroup { label: "l".into(), values: vec![1.0, 10.0] },
                BarGroup { label: "m".into(), values: vec![100.0] },
            ],
            logarithmic: true,
            ..chart()
        };
        let image = logarithmic.render();
        let ten = length(&image, COLORS[1], row(1.0, 0.0));
        let hundred = length(&image, COLORS[0], row(2.0, 1.0));
        assert!(ten.abs_diff(hundred / 2) <= 2, "{ten} {hundred}");
    }

    #[test]
    fn values_are_written_with_three_digits() {
        let all = [0.0, 0.5, 0.608, 1.23, 11.6, 874.0, 0.0304].map(written);
        assert_eq!(all, ["0", "0.5", "0.608", "1.23", "11.6", "874", "0.03"]);
    }
}
