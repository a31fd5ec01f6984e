//! The two ends of a known length, in photographs.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Result, bail};

/// Two points in a photograph, in pixels; `None` for a point that it does not show.
pub type TwoPixels = [Option<[f64; 2]>; 2];

/// Two points in a photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct Ends {
    photograph: String,
    points: TwoPixels,
}

impl FromStr for Ends {
    type Err = String;

    fn from_str(text: &str) -> Result<Ends, String> {
        let wrong = || format!("found {text}, expected PHOTOGRAPH:X,Y:X,Y with pixels, or - for a point");
        let point = |text: &str| match text {
            "-" => Some(None),
            _ => {
                let (x, y) = text.split_once(',')?;
                let number = |text: &str| text.trim().parse().ok().filter(|v: &f64| v.is_finite());
                Some(Some([number(x)?, number(y)?]))
            }
        };
        let mut parts = text.rsplitn(3, ':');
        let (Some(second), Some(first), Some(photograph)) = (parts.next(), parts.next(), parts.next()) else {
            return Err(wrong());
        };
        let points = [point(first).ok_or_else(wrong)?, point(second).ok_or_else(wrong)?];
        Ok(Ends { photograph: photograph.to_owned(), points })
    }
}

impl Ends {
    /// The points with the index of their file in `files`; a file is given by its path or by its name.
    ///
    /// # Errors
    /// When no file has the name, or several have.
    pub fn numbered(all: &[Ends], files: &[PathBuf]) -> Result<Vec<(usize, TwoPixels)>> {
        let number = |photograph: &str| {
            let named = |file: &Path| {
                file == Path::new(photograph) || file.file_name().is_some_and(|name| name == photograph)
            };
            let found: Vec<usize> = (0..files.len()).filter(|i| named(&files[*i])).collect();
            match found.as_slice() {
                [number] => Ok(*number),
                [] => bail!(
                    "--ends: found {photograph}, expected the name of one of the {} photographs",
                    files.len()
                ),
                _ => bail!("--ends: {} photographs are named {photograph}: give the path", found.len()),
            }
        };
        all.iter().map(|ends| Ok((number(&ends.photograph)?, ends.points))).collect()
    }
}
