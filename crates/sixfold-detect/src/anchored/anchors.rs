//! Anchors: boxes of fixed sizes and shapes about every pixel of every level (Ren et al. 2015, section 3.1.1).

use super::boxes::Corners;

/// Height over width (Ren et al. 2015, section 3.1.1).
const RATIOS: [f32; 3] = [0.5, 1.0, 2.0];
/// Side of the finest level's anchors in pixels; each further level's are twice as long (Lin et al. 2017, "Feature pyramid
/// networks", section 4.1).
const FINEST: usize = 32;

/// Sides of a level's anchors, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scales {
    /// One a level, for proposals.
    One,
    /// Three a level, an octave in thirds, cut to whole pixels (Lin et al. 2017, "Focal loss", section 4).
    Three,
}

impl Scales {
    fn of_level(self, level: usize) -> Vec<f32> {
        let side = FINEST << level;
        match self {
            Scales::One => vec![side as f32],
            Scales::Three => {
                [0.0, 1.0, 2.0].map(|i: f64| (side as f64 * (i / 3.0).exp2()).trunc() as f32).to_vec()
            }
        }
    }

    /// Anchors about a pixel.
    pub(super) fn anchors(self) -> usize {
        RATIOS.len() * if self == Scales::One { 1 } else { 3 }
    }
}

/// The anchors about the origin, rounded to whole pixels as torchvision does: shape after shape, each in all sizes.
fn about_origin(scales: &[f32]) -> Vec<Corners> {
    let shape = |ratio: f32| {
        let tall = ratio.sqrt();
        let wide = 1.0 / tall;
        scales.iter().map(move |scale| {
            let [w, h] = [wide * scale, tall * scale];
            [-w, -h, w, h].map(|v| (v / 2.0).round_ties_even())
        })
    };
    RATIOS.iter().flat_map(|ratio| shape(*ratio)).collect()
}

/// The anchors of every level, row by row, pixel by pixel, those of a pixel in the order of the network's channels. `grids` are
/// rows and columns of the levels, `image` those of the padded image.
pub(super) fn anchors(scales: Scales, grids: &[[usize; 2]], image: [usize; 2]) -> Vec<Vec<Corners>> {
    let of_level = |(level, [rows, columns]): (usize, &[usize; 2])| {
        let shapes = about_origin(&scales.of_level(level));
        let [down, right] = [image[0] / rows, image[1] / columns];
        let pixels = (0..*rows).flat_map(|y| (0..*columns).map(move |x| (x * right, y * down)));
        let shifted = |(x, y): (usize, usize)| {
            let [x, y] = [x as f32, y as f32];
            shapes.iter().map(move |[l, t, r, b]| [x + l, y + t, x + r, y + b])
        };
        pixels.flat_map(shifted).collect()
    };
    grids.iter().enumerate().map(of_level).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn they_are_those_of_torchvision() {
        // AnchorGenerator(((32,),), ((0.5, 1.0, 2.0),)).cell_anchors
        let proposals = [[-23.0, -11.0, 23.0, 11.0], [-16.0, -16.0, 16.0, 16.0], [-11.0, -23.0, 11.0, 23.0]];
        assert_eq!(about_origin(&Scales::One.of_level(0)), proposals);
        assert_eq!(Scales::Three.of_level(0), [32.0, 40.0, 50.0]);
        assert_eq!(Scales::Three.of_level(4), [512.0, 645.0, 812.0]);
        let retina = about_origin(&Scales::Three.of_level(0));
        assert_eq!(
            retina[..3],
            [[-23.0, -11.0, 23.0, 11.0], [-28.0, -14.0, 28.0, 14.0], [-35.0, -18.0, 35.0, 18.0]]
        );
        assert_eq!(retina.len(), Scales::Three.anchors());
    }

    #[test]
    fn they_are_shifted_row_by_row() {
        let all = anchors(Scales::One, &[[2, 3], [1, 2]], [64, 96]);
        assert_eq!([all[0].len(), all[1].len()], [18, 6]);
        // Second row, third column, square: centre at (64, 32).
        assert_eq!(all[0][(3 + 2) * 3 + 1], [48.0, 16.0, 80.0, 48.0]);
        assert_eq!(all[1][3 + 1], [16.0, -32.0, 80.0, 32.0]);
    }
}
