//! The XML that OpenCV's `FileStorage` writes: nested elements, and numbers separated by blanks.
//!
//! The reader supports exactly this: entities and document types, which could refer to other files or expand,
//! are refused.

use serde_json::{Map, Value};

use super::yaml::scalar;

/// Deepest nesting; camera files have three levels.
const MAX_DEPTH: usize = 16;

struct Reader<'a> {
    text: &'a str,
}

/// The content of the root element of a text.
///
/// # Errors
/// What was found and what was expected.
pub(super) fn parse(text: &str) -> Result<Value, String> {
    let mut reader = Reader { text };
    reader.skip()?;
    let name = reader.opening()?.ok_or_else(|| reader.found("an element such as <opencv_storage>"))?;
    let value = reader.inside(name.0, 0)?;
    reader.skip()?;
    if reader.text.is_empty() { Ok(value) } else { Err(reader.found("the end of the file")) }
}

impl<'a> Reader<'a> {
    fn found(&self, expected: &str) -> String {
        let found: String = self.text.chars().take(40).collect();
        format!("found {found:?}, expected {expected}")
    }

    /// Skips blanks, comments and the declaration.
    fn skip(&mut self) -> Result<(), String> {
        loop {
            self.text = self.text.trim_start();
            let ends = [("<?", "?>"), ("<!--", "-->")];
            let Some((_, end)) = ends.into_iter().find(|(start, _)| self.text.starts_with(start)) else {
                break;
            };
            let at = self.text.find(end).ok_or_else(|| self.found(end))?;
            self.text = &self.text[at + end.len()..];
        }
        if self.text.starts_with("<!") { Err(self.found("an element")) } else { Ok(()) }
    }

    /// Name of an element that begins here, and whether it is empty (`<name/>`).
    fn opening(&mut self) -> Result<Option<(&'a str, bool)>, String> {
        if !self.text.starts_with('<') || self.text.starts_with("</") {
            return Ok(None);
        }
        let end = self.text.find('>').ok_or_else(|| self.found("an element that is closed by >"))?;
        let inside = &self.text[1..end];
        self.text = &self.text[end + 1..];
        let (inside, ended) = inside.strip_suffix('/').map_or((inside, false), |rest| (rest, true));
        let name = inside.split_whitespace().next().unwrap_or_default();
        Ok(Some((name, ended)))
    }

    /// The content up to `</name>`.
    fn inside(&mut self, name: &str, depth: usize) -> Result<Value, String> {
        if depth > MAX_DEPTH {
            return Err(format!("found more than {MAX_DEPTH} elements in one another"));
        }
        let (mut map, mut list, mut text) = (Map::new(), vec![], String::new());
        loop {
            self.skip()?;
            if let Some(rest) = self.text.strip_prefix("</") {
                let end = rest.find('>').ok_or_else(|| self.found("</name>"))?;
                if rest[..end].trim() != name {
                    return Err(self.found(&format!("</{name}>")));
                }
                self.text = &rest[end + 1..];
                break;
            }
            if let Some((child, ended)) = self.opening()? {
                let value = if ended { Value::Null } else { self.inside(child, depth + 1)? };
                if child == "_" {
                    list.push(value);
                } else if map.insert(child.to_owned(), value).is_some() {
                    return Err(format!(
                        "the element <{child}> stands twice in <{name}>; remove one of them"
                    ));
                }
                continue;
            }
            let end = self.text.find('<').ok_or_else(|| self.found(&format!("</{name}>")))?;
            text.push_str(&self.text[..end]);
            text.push(' ');
            self.text = &self.text[end..];
        }
        if !map.is_empty() {
            return Ok(Value::Object(map));
        }
        if !list.is_empty() {
            return Ok(Value::Array(list));
        }
        let text = text.trim();
        let words: Vec<Value> = text.split_whitespace().map(scalar).collect();
        let numbers = words.len() > 1 && words.iter().all(Value::is_number);
        Ok(if numbers { Value::Array(words) } else { scalar(text) })
    }
}
