//! The printed sheet.

use serde::{Deserialize, Serialize};
use sixfold_geometry::{Image, RgbImage, Vec2, Vec3};
use sixfold_plot::text_dots;

use crate::detector::Tag;
use crate::family::{self, SIDE};
use crate::pdf;

/// Side of a tag's black square, metres: three millimetres per cell, which is four pixels at 0.75 metres for a camera with a focal
/// length of a thousand pixels.
const TAG: f64 = 0.024;
/// White gap between two tags, metres: four cells.
const GAP: f64 = 0.012;
/// Length of the printed ruler, metres.
pub(crate) const RULER: f64 = 0.1;

/// A size of paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Paper {
    /// 210 x 297 mm: 5 x 7 tags, numbers 0 to 34.
    A4,
    /// 297 x 420 mm: 7 x 10 tags, numbers 100 to 169.
    A3,
    /// 8.5 x 11 inches: 5 x 6 tags, numbers 200 to 229.
    Letter,
}

impl Paper {
    /// All sizes.
    pub const ALL: [Paper; 3] = [Paper::A4, Paper::A3, Paper::Letter];

    /// Width and height, metres.
    pub fn size(self) -> (f64, f64) {
        match self {
            Paper::A4 => (0.210, 0.297),
            Paper::A3 => (0.297, 0.420),
            Paper::Letter => (0.2159, 0.2794),
        }
    }

    /// Columns and rows of tags, and the number of the first.
    fn tags(self) -> (usize, usize, usize) {
        match self {
            Paper::A4 => (5, 7, 0),
            Paper::A3 => (7, 10, 100),
            Paper::Letter => (5, 6, 200),
        }
    }
}

impl std::str::FromStr for Paper {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.to_ascii_lowercase().as_str() {
            "a4" => Ok(Paper::A4),
            "a3" => Ok(Paper::A3),
            "letter" => Ok(Paper::Letter),
            _ => Err(format!("found {text:?}, expected a4, a3 or letter")),
        }
    }
}

impl std::fmt::Display for Paper {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Paper::A4 => "a4",
            Paper::A3 => "a3",
            Paper::Letter => "letter",
        })
    }
}

/// The print on a sheet, metres from its top left corner.
pub(crate) struct Print {
    /// Black rectangles: left, top, width, height.
    pub black: Vec<[f64; 4]>,
    /// The line below the ruler.
    pub text: Text,
}

/// A line of text.
pub(crate) struct Text {
    pub left: f64,
    pub baseline: f64,
    pub height: f64,
    pub text: String,
}

/// A corner of a tag, on the board and in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Number of the tag.
    pub tag: usize,
    /// Its position on the board, metres.
    pub on_board: Vec3,
    /// Its position in the image, pixels as stored (lens distortion included).
    pub pixel: Vec2,
    /// Width of the edges that meet there, pixels.
    pub edge_width: f64,
    /// Length of the tag's sides in the image, pixels.
    pub side: f64,
}

/// A sheet with a grid of tags. Sheets of different paper sizes have different tags, so that a photograph identifies its sheet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
    paper: Paper,
    scale: f64,
}

impl Board {
    /// The board for a size of paper, printed at its true size.
    pub fn new(paper: Paper) -> Board {
        Board { paper, scale: 1.0 }
    }

    /// The same board printed at another scale, so that its ruler of 100 mm measures `ruler` metres; `None` unless that is between
    /// 10 mm and 1 m.
    pub fn with_ruler(self, ruler: f64) -> Option<Board> {
        (0.01..=1.0).contains(&ruler).then_some(Board { scale: ruler / RULER, ..self })
    }

    /// The board to which these tags belong: the one with most of them; `None` if there is none.
    pub fn of_tags(tags: &[Tag]) -> Option<Board> {
        let count = |board: &Board| tags.iter().filter(|tag| board.place(tag.id).is_some()).count();
        let boards = Paper::ALL.map(Board::new);
        // The first one of several with equal numbers.
        boards.into_iter().rev().max_by_key(count).filter(|board| count(board) > 0)
    }

    /// The size of paper.
    pub fn paper(&self) -> Paper {
        self.paper
    }

    /// Number of tags.
    pub fn len(&self) -> usize {
        let (columns, rows, _) = self.paper.tags();
        columns * rows
    }

    /// Always false: a board has tags.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Side of a tag's black square as printed, metres.
    pub fn tag_side(&self) -> f64 {
        TAG * self.scale
    }

    /// Top left corner of a tag on the board before scaling, metres.
    fn place(&self, id: usize) -> Option<(f64, f64)> {
        let (columns, rows, first) = self.paper.tags();
        let number = id.checked_sub(first).filter(|n| *n < columns * rows)?;
        let from_centre = |i: usize, n: usize| i as f64 * (TAG + GAP) - 0.5 * (n as f64 * (TAG + GAP) - GAP);
        Some((from_centre(number % columns, columns), -from_centre(number / columns, rows)))
    }

    /// The corners of a tag in the board's frame, metres: top left, top right, bottom right, bottom left; `None` for a tag that is
    /// not on this board.
    pub fn tag_corners(&self, id: usize) -> Option<[Vec3; 4]> {
        let (x, y) = self.place(id)?;
        let corners = [(x, y), (x + TAG, y), (x + TAG, y - TAG), (x, y - TAG)];
        Some(corners.map(|(x, y)| Vec3::new(x, y, 0.0) * self.scale))
    }

    /// The corners of found tags that are on this board. A tag that was found twice is left out, because it is unknown which of the
    /// two is the board's.
    pub fn corners(&self, tags: &[Tag]) -> Vec<Corner> {
        let of_tag = |tag: &Tag| {
            let places = self.tag_corners(tag.id)?;
            let side = tag.side();
            let corner = |i: usize| Corner {
                tag: tag.id,
                on_board: places[i],
                pixel: tag.corners[i],
                edge_width: tag.edge_width,
                side,
            };
            Some(std::array::from_fn::<_, 4, _>(corner))
        };
        let once = |tag: &&Tag| tags.iter().filter(|other| other.id == tag.id).count() == 1;
        tags.iter().filter(once).filter_map(of_tag).flatten().collect()
    }

    /// Whether the sheet is white at a point of the board's frame, metres; `None` outside the sheet. The ruler and its text are
    /// ignored.
    pub fn is_white(&self, x: f64, y: f64) -> Option<bool> {
        let (x, y) = (x / self.scale, y / self.scale);
        let (width, height) = self.paper.size();
        let below = self.tags_above_sheet_centre();
        if x.abs() > 0.5 * width || (y + below).abs() > 0.5 * height {
            return None;
        }
        let (columns, rows, first) = self.paper.tags();
        let Some((left, top)) = self.place(first) else { return Some(true) };
        let (u, v) = (x - left, top - y);
        let (column, row) = ((u / (TAG + GAP)).floor(), (v / (TAG + GAP)).floor());
        let (du, dv) = (u - column * (TAG + GAP), v - row * (TAG + GAP));
        let in_grid = column >= 0.0 && row >= 0.0 && column < columns as f64 && row < rows as f64;
        if !in_grid || du >= TAG || dv >= TAG {
            return Some(true);
        }
        let cell = |d: f64| ((d / TAG * SIDE as f64) as usize).min(SIDE - 1);
        let (i, j) = (cell(dv), cell(du));
        if i == 0 || j == 0 || i == SIDE - 1 || j == SIDE - 1 {
            return Some(false);
        }
        Some(family::cells(first + row as usize * columns + column as usize)[i - 1][j - 1])
    }

    /// The extent of the sheet in the board's frame: smallest and largest coordinates, metres.
    pub fn extent(&self) -> [Vec2; 2] {
        let (width, height) = self.paper.size();
        let centre = Vec2::new(0.0, -self.tags_above_sheet_centre());
        let half = Vec2::new(0.5 * width, 0.5 * height);
        [(centre - half) * self.scale, (centre + half) * self.scale]
    }

    /// How far the centre of the tags is above the centre of the sheet, metres: the ruler is below the tags.
    pub(crate) fn tags_above_sheet_centre(&self) -> f64 {
        0.008
    }

    /// The print of the sheet.
    pub(crate) fn print(&self) -> Print {
        let (width, height) = self.paper.size();
        let (columns, rows, first) = self.paper.tags();
        let (centre_x, centre_y) = (0.5 * width, 0.5 * height - self.tags_above_sheet_centre());
        let cell = TAG / SIDE as f64;
        let mut black = vec![];
        for id in first..first + columns * rows {
            let Some((x, y)) = self.place(id) else { continue };
            let (left, top) = (centre_x + x, centre_y - y);
            let edge = TAG - cell;
            black.extend([
                [left, top, TAG, cell],
                [left, top + edge, TAG, cell],
                [left, top + cell, cell, TAG - 2.0 * cell],
                [left + edge, top + cell, cell, TAG - 2.0 * cell],
            ]);
            for (i, row) in family::cells(id).iter().enumerate() {
                // Neighbouring cells are merged into one rectangle, because viewers show hairlines between two.
                let mut j = 0;
                while j < row.len() {
                    let run = row[j..].iter().take_while(|white| !**white).count();
                    if run > 0 {
                        let (x, y) = (left + cell * (j + 1) as f64, top + cell * (i + 1) as f64);
                        black.push([x, y, cell * run as f64, cell]);
                    }
                    j += run.max(1);
                }
            }
        }
        let (ruler_x, ruler_y) = (centre_x - 0.5 * RULER, height - 0.012);
        black.push([ruler_x, ruler_y, RULER, 0.0003]);
        for millimetre in 0..=100 {
            let long = match millimetre {
                m if m % 10 == 0 => 0.004,
                m if m % 5 == 0 => 0.003,
                _ => 0.002,
            };
            let x = ruler_x + 0.001 * f64::from(millimetre);
            black.push([x - 0.000_05, ruler_y - long, 0.0001, long]);
        }
        let text = format!(
            "Sixfold board {}. Print at 100 %. This ruler has to measure 100 mm; else give its length: --ruler MM",
            self.paper
        );
        let text = Text { left: ruler_x - 0.025, baseline: height - 0.0085, height: 0.0022, text };
        Print { black, text }
    }

    /// The sheet as a PDF file of one page, at its true size.
    pub fn pdf(&self) -> Vec<u8> {
        pdf::page(self.paper.size(), &self.print())
    }

    /// The sheet as an image with `dots` pixels per millimetre.
    pub fn image(&self, dots: f64) -> RgbImage {
        let (width, height) = self.paper.size();
        let pixels = |metres: f64| (metres * 1000.0 * dots).round().max(1.0) as usize;
        let mut image = Image::filled(pixels(width), pixels(height), [255; 3]);
        let mut fill = |[x, y, w, h]: [f64; 4]| {
            let (right, bottom) = (pixels(x + w).max(pixels(x) + 1), pixels(y + h).max(pixels(y) + 1));
            for v in pixels(y)..bottom.min(image.height()) {
                for u in pixels(x)..right.min(image.width()) {
                    image[(u, v)] = [0; 3];
                }
            }
        };
        let Print { black, text } = self.print();
        black.into_iter().for_each(&mut fill);
        // About as wide as Helvetica in the PDF.
        let dot = text.height / 12.0;
        for (column, row) in text_dots(&text.text) {
            let (x, y) = (text.left + dot * column as f64, text.baseline - text.height + dot * row as f64);
            fill([x, y, dot, dot]);
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tags_and_ruler_are_on_the_sheet_without_overlap() {
        for paper in Paper::ALL {
            let board = Board::new(paper);
            let (width, height) = paper.size();
            let black = board.print().black;
            let margin = 0.005;
            for [x, y, w, h] in black {
                assert!(
                    x > margin && y > margin && x + w < width - margin && y + h < height - margin,
                    "{paper}"
                );
            }
            let lowest = 0.5 * height - board.tags_above_sheet_centre();
            let first = paper.tags().2;
            let last = board.tag_corners(first + board.len() - 1).unwrap();
            assert!(
                lowest - last[2].y < height - 0.012 - 0.004 - 0.004,
                "{paper}: tags reach into the ruler"
            );
            assert!(board.tag_corners(first + board.len()).is_none());
        }
    }

    #[test]
    fn the_image_and_the_pattern_are_the_same() {
        let board = Board::new(Paper::A4);
        let image = board.image(2.0);
        let (width, height) = board.paper().size();
        for y in (0..500).step_by(7) {
            for x in (0..420).step_by(5) {
                // Centre of the pixel in the board's frame.
                let u = (x as f64 + 0.5) / 2000.0 - 0.5 * width;
                let v = 0.5 * height - board.tags_above_sheet_centre() - (y as f64 + 0.5) / 2000.0;
                assert_eq!(board.is_white(u, v), Some(image[(x, y)] == [255; 3]), "{x} {y}");
            }
        }
    }

    #[test]
    fn a_ruler_of_another_length_scales_the_board() {
        let board = Board::new(Paper::A4).with_ruler(0.1414).unwrap();
        assert!((board.tag_side() - 0.024 * 1.414).abs() < 1e-12);
        assert!(board.with_ruler(f64::NAN).is_none() && board.with_ruler(2.0).is_none());
    }
}
