//! Text labels of objects in an image that do not overlap: greedy placement, each label at the nearest free place (the first
//! step of J. Christensen, J. Marks and S. Shieber, "An empirical study of algorithms for point-feature label placement", 1995).

use sixfold_geometry::RgbImage;
use sixfold_plot::text_dots;

/// Columns and rows of a character with its gap, and the border of a label, in dots of the font.
const CHARACTER: usize = 6;
/// See [`CHARACTER`].
const ROWS: usize = 8;
/// See [`CHARACTER`].
const BORDER: usize = 1;
/// Up to twice this width in pixels, an image has dots of one pixel; dots grow with the width.
const WIDTH_OF_A_DOT: usize = 640;
/// Free places are searched on every n-th column and row, in dots.
const STEP: usize = 4;
/// A label further than this many dots from its object gets a line to it.
const NEAR: f64 = 6.0;
/// Background of an uncertain object's label, whose text has the object's colour.
const DARK: [u8; 3] = [24; 3];

/// A rectangle in pixels: left, top, right, bottom.
pub(crate) type Corners = [f64; 4];

/// A label and the object that it names.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Label {
    /// A line of ASCII.
    pub text: String,
    /// The box of the object that it names.
    pub of: Corners,
    /// The object's colour.
    pub color: [u8; 3],
    /// Whether the text is black on the object's colour; otherwise it has the object's colour on black.
    pub is_sure: bool,
}

impl Label {
    /// The text at a given size of dots, shortened at its start to fit `width` pixels, because the number is at its end.
    fn fitting(&self, dot: usize, width: usize) -> String {
        let most = (width / dot).saturating_sub(2 * BORDER) / CHARACTER;
        let count = self.text.chars().count();
        self.text.chars().skip(count.saturating_sub(most)).collect()
    }
}

/// Left, top, width and height of a label, pixels.
type Place = [usize; 4];

fn overlap([ax, ay, aw, ah]: Place, [bx, by, bw, bh]: Place) -> bool {
    ax < bx + bw && bx < ax + aw && ay < by + bh && by < ay + ah
}

/// Squared distance between the centre of a place and the middle of the upper edge of the object's box, where a place is tried
/// first.
fn distance([left, top, width, height]: Place, of: &Corners) -> f64 {
    let x = left as f64 + 0.5 * width as f64 - 0.5 * (of[0] + of[2]);
    let y = top as f64 + 0.5 * height as f64 - (of[1] - 0.5 * height as f64);
    x * x + y * y
}

/// The place of each label, in order; `None` where the image has no room left.
fn places(labels: &[Label], size: (usize, usize), dot: usize) -> Vec<Option<Place>> {
    let mut taken: Vec<Place> = vec![];
    labels
        .iter()
        .map(|label| {
            let columns = CHARACTER * label.fitting(dot, size.0).chars().count() + 2 * BORDER;
            let (width, height) = (columns * dot, (ROWS + 2 * BORDER) * dot);
            let (last_x, last_y) = (size.0.checked_sub(width)?, size.1.checked_sub(height)?);
            // The preferred place, then all others, the nearest first.
            let within = |v: f64, last: usize| v.clamp(0.0, last as f64) as usize;
            let wanted = [
                within(0.5 * (label.of[0] + label.of[2] - width as f64), last_x),
                within(label.of[1] - height as f64, last_y),
                width,
                height,
            ];
            let free = |place: &Place| !taken.iter().any(|t| overlap(*t, *place));
            let step = STEP * dot;
            // Include the last row and column; otherwise narrow images have no room.
            let grid = move |last: usize| (0..=last).step_by(step).chain([last]);
            let all = || grid(last_y).flat_map(move |y| grid(last_x).map(move |x| [x, y, width, height]));
            let place = if free(&wanted) {
                wanted
            } else {
                all()
                    .filter(free)
                    .min_by(|a, b| distance(*a, &label.of).total_cmp(&distance(*b, &label.of)))?
            };
            taken.push(place);
            Some(place)
        })
        .collect()
}

/// Draws labels into an image: within the image, without overlaps, the first ones nearest to their objects, with a line where a
/// label had to move away. A label without room is left out.
pub(crate) fn draw_labels(image: &mut RgbImage, labels: &[Label]) {
    let dot = (image.width() / WIDTH_OF_A_DOT).max(1);
    let places = places(labels, image.size(), dot);
    let found = || labels.iter().zip(&places).filter_map(|(l, p)| Some((l, (*p)?)));
    for (label, place) in found() {
        leader(image, label, place, dot);
    }
    for (label, place) in found() {
        write(image, label, place, dot);
    }
}

/// The line from a label to the centre of its object, for a label that is not near it.
fn leader(image: &mut RgbImage, label: &Label, [left, top, width, height]: Place, dot: usize) {
    let [l, t, r, b] = label.of;
    let centre = [0.5 * (l + r), 0.5 * (t + b)];
    let (right, bottom) = ((left + width) as f64, (top + height) as f64);
    let (left, top) = (left as f64, top as f64);
    let near = NEAR * dot as f64;
    let touches = left < r + near && l < right + near && top < b + near && t < bottom + near;
    let from = [centre[0].clamp(left, right - 1.0), centre[1].clamp(top, bottom - 1.0)];
    if !touches && centre.iter().all(|v| v.is_finite()) {
        crate::overlay::line(image, from, centre, label.color);
    }
}

/// One label at its place.
fn write(image: &mut RgbImage, label: &Label, [left, top, width, height]: Place, dot: usize) {
    let (ground, ink) = if label.is_sure { (label.color, [0; 3]) } else { (DARK, label.color) };
    for (x, y) in (top..top + height).flat_map(|y| (left..left + width).map(move |x| (x, y))) {
        image[(x, y)] = ground;
    }
    for (column, row) in text_dots(&label.fitting(dot, image.width())) {
        for (dx, dy) in (0..dot).flat_map(|dy| (0..dot).map(move |dx| (dx, dy))) {
            let at = (left + (BORDER + column) * dot + dx, top + (BORDER + row) * dot + dy);
            if at.0 < left + width && at.1 < top + height {
                image[at] = ink;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn label(text: &str, of: Corners) -> Label {
        Label { text: text.into(), of, color: [200, 100, 50], is_sure: true }
    }

    /// Ten objects at the same place, in a corner and beyond the border.
    #[test]
    fn labels_neither_cover_each_other_nor_leave_the_image() {
        for of in [[50.0, 40.0, 60.0, 50.0], [0.0, 0.0, 5.0, 5.0], [-80.0, 300.0, -60.0, 310.0]] {
            let labels: Vec<Label> = (0..10).map(|i| label(&format!("mug {i}"), of)).collect();
            let found: Vec<Place> = places(&labels, (160, 120), 1).into_iter().flatten().collect();
            assert_eq!(found.len(), 10);
            for (i, a) in found.iter().enumerate() {
                assert!(a[0] + a[2] <= 160 && a[1] + a[3] <= 120, "{a:?}");
                assert!(found[..i].iter().all(|b| !overlap(*a, *b)), "{a:?}");
            }
        }
    }

    #[test]
    fn a_label_is_above_its_object_and_a_second_one_near_it() {
        let of = [70.0, 60.0, 90.0, 100.0];
        let found = places(&[label("can 0.91", of), label("can 0.32", of)], (160, 120), 1);
        let first = found[0].unwrap();
        assert_eq!(first, [55, 50, 50, 10]);
        let second = found[1].unwrap();
        assert!(distance(second, &of).sqrt() < 20.0, "{second:?}");
    }

    #[test]
    fn labels_without_room_are_left_out_and_long_names_keep_their_number() {
        let labels = vec![label("a", [0.0; 4]); 100];
        assert_eq!(places(&labels, (16, 20), 1).into_iter().flatten().count(), 4);
        assert_eq!(places(&labels, (16, 9), 1), vec![None; 100]);
        assert_eq!(label("a-very-long-name 0.50", [0.0; 4]).fitting(1, 26), "0.50");
        let mut image = RgbImage::filled(26, 12, [0; 3]);
        draw_labels(&mut image, &[label("a-very-long-name 0.50", [0.0; 4])]);
        assert_eq!(image[(0, 0)], [200, 100, 50]);
    }

    #[test]
    fn an_uncertain_label_is_dark_and_one_far_away_has_a_line() {
        let mut image = RgbImage::filled(160, 120, [255; 3]);
        let sure = label("8 0.90", [70.0, 60.0, 90.0, 100.0]);
        draw_labels(&mut image, std::slice::from_ref(&sure));
        assert_eq!(image[(61, 50)], sure.color);
        let mut other = RgbImage::filled(160, 120, [255; 3]);
        draw_labels(&mut other, &[Label { is_sure: false, ..sure.clone() }]);
        assert_eq!(other[(61, 50)], DARK);
        assert!(other.as_slice().contains(&sure.color));
        // Twenty labels of one object: the last ones are away from it, so lines are drawn too.
        let mut full = RgbImage::filled(160, 120, [255; 3]);
        let labels = vec![label("8 0.90", [0.0, 0.0, 4.0, 4.0]); 20];
        draw_labels(&mut full, &labels);
        let drawn = full.as_slice().iter().filter(|p| **p != [255; 3]).count();
        let labelled: usize =
            places(&labels, (160, 120), 1).into_iter().flatten().map(|[_, _, w, h]| w * h).sum();
        assert!(labelled == 20 * 38 * 10 && drawn > labelled, "{drawn} {labelled}");
    }
}
