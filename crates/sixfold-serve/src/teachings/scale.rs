//! The scale of photographs without a board: a measured length, and the pixels of its two ends.

use serde::{Deserialize, Serialize};
use sixfold_teach::KnownLength;
use utoipa::ToSchema;

use super::of_teach;
use crate::error::{Answer, ApiError};
use crate::form::Form;

/// The two ends of a measured length in one photograph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct EndsBody {
    /// The photograph: its name or its number, from 0.
    photograph: NameOrNumber,
    /// The pixels of the two ends in the photograph as it was taken, of its full size; the centre of the top left one is (0, 0). Null
    /// for an end that it does not show.
    #[schema(value_type = Vec<Option<[f64; 2]>>)]
    points: [Option<[f64; 2]>; 2],
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
enum NameOrNumber {
    Number(usize),
    Name(String),
}

impl EndsBody {
    /// The ends of a teaching's length.
    pub fn all(length: &KnownLength) -> Vec<EndsBody> {
        let of = |(number, points): &(usize, _)| EndsBody {
            photograph: NameOrNumber::Number(*number),
            points: *points,
        };
        length.ends.iter().map(of).collect()
    }
}

/// A photograph's name, width and height.
pub(super) type NamedSize = (String, (usize, usize));
type Ends = Vec<(usize, [Option<[f64; 2]>; 2])>;

const LENGTHS: &str = "metres, 0.005 to 5";
const ENDS: &str = "a list like [{\"photograph\": \"a.jpg\", \"points\": [[812, 640], [1010, 655]]}, ...], null for a point \
                    that a photograph does not show";

/// What a form says about the scale; `None` for a field that was not sent.
#[derive(Debug, Default)]
pub(super) struct Scale {
    metres: Option<f64>,
    ends: Option<Ends>,
}

impl Scale {
    /// Reads the fields `length` and `ends`; `photographs` are all those that the teaching will have, by number, and `before` is its
    /// length until now.
    pub fn of_form(
        form: &Form,
        without_board: bool,
        photographs: &[NamedSize],
        before: Option<&KnownLength>,
    ) -> Answer<Scale> {
        let metres = form.number("length", LENGTHS, |metres| (0.005..=5.0).contains(&metres))?;
        let ends = form.text("ends")?.map(|text| numbered(text, photographs)).transpose()?;
        let scale = Scale { metres, ends };
        for (field, sent) in [("length", scale.metres.is_some()), ("ends", scale.ends.is_some())] {
            if sent && !without_board {
                return Err(ApiError::field(
                    field,
                    "it for photographs on the printed board, which has a known size",
                    "it with without_board=true",
                    "send without_board=true if the photographs show no board, otherwise leave it out",
                ));
            }
        }
        if scale.is_sent() {
            scale.check(photographs, before)?;
        }
        Ok(scale)
    }

    pub fn is_sent(&self) -> bool {
        self.metres.is_some() || self.ends.is_some()
    }

    fn check(&self, photographs: &[NamedSize], before: Option<&KnownLength>) -> Answer<()> {
        let Some(ends) = self.ends.as_ref().or(before.map(|b| &b.ends)) else {
            let advice = "mark the two ends of the length in two or more photographs";
            return Err(ApiError::field("ends", "nothing", ENDS, advice));
        };
        let Some(metres) = self.metres.or(before.map(|b| b.metres)) else {
            if ends.is_empty() {
                return Ok(());
            }
            let advice = "give the measured length between the two points";
            return Err(ApiError::field("length", "nothing", LENGTHS, advice));
        };
        if self.removes() {
            return Ok(());
        }
        let named: Vec<(&str, (usize, usize))> =
            photographs.iter().map(|(name, size)| (name.as_str(), *size)).collect();
        KnownLength { metres, ends: ends.clone() }.check(&named).map_err(|e| of_teach(&e))
    }

    /// An empty list without a length removes the length.
    fn removes(&self) -> bool {
        self.metres.is_none() && self.ends.as_ref().is_some_and(Vec::is_empty)
    }

    /// The length that a teaching has after this; `before` is the one that it has now.
    pub fn applied(self, before: Option<&KnownLength>) -> Option<KnownLength> {
        if self.removes() {
            return None;
        }
        let metres = self.metres.or(before.map(|b| b.metres))?;
        let ends = self.ends.or_else(|| before.map(|b| b.ends.clone()))?;
        Some(KnownLength { metres, ends })
    }
}

/// The ends with the numbers of their photographs.
fn numbered(text: &str, photographs: &[NamedSize]) -> Answer<Ends> {
    let advice = "correct the list; the teaching lists its photographs";
    let wrong = |found: String| ApiError::field("ends", found, ENDS, "correct the list");
    let sent: Vec<EndsBody> = serde_json::from_str(text).map_err(|e| wrong(format!("{text} ({e})")))?;
    let mut all: Ends = vec![];
    for EndsBody { photograph, points } in sent {
        let number = match &photograph {
            NameOrNumber::Number(number) => Some(*number).filter(|n| *n < photographs.len()),
            NameOrNumber::Name(name) => photographs.iter().position(|(there, _)| there == name),
        };
        let count = photographs.len();
        let found = match &photograph {
            NameOrNumber::Number(number) => format!("photograph {number}"),
            NameOrNumber::Name(name) => name.clone(),
        };
        let Some(number) = number else {
            let expected = format!("the name of one of the {count} photographs, or its number, from 0");
            return Err(ApiError::field("ends", found, expected, advice));
        };
        if all.iter().any(|(i, _)| *i == number) {
            return Err(ApiError::field("ends", format!("{found} twice"), "each photograph once", advice));
        }
        all.push((number, points));
    }
    Ok(all)
}

/// Without a board, photographs alone do not show how large things are.
pub(super) fn no_scale() -> ApiError {
    ApiError::field(
        "length",
        "neither a length nor depth",
        "for photographs without the board: length (metres) with ends, or depth images",
        "measure a length, and mark its two ends in two or more photographs",
    )
}
