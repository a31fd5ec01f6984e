//! The YAML subset of camera files: block mappings and sequences, flow lists, scalars.
//!
//! This is a reader of exactly this subset rather than a YAML library, because OpenCV's `%YAML:1.0` is not valid YAML of any
//! version, and because nothing here can expand: anchors, aliases and tags other than OpenCV's are refused by name, and nesting
//! is limited. Features that a camera file never needs are refused too: complex keys, scalars over several lines, several
//! documents.

use serde_json::{Map, Number, Value};

/// Deepest nesting; camera files have three levels.
const MAX_DEPTH: usize = 16;
/// Tags that add no information to the value.
const TAGS: [&str; 6] = ["!!opencv-matrix", "!!float", "!!int", "!!str", "!!map", "!!seq"];

struct Line<'a> {
    number: usize,
    indent: usize,
    text: &'a str,
}

struct Reader<'a> {
    lines: Vec<Line<'a>>,
    at: usize,
}

/// The value of a text.
///
/// # Errors
/// The line, what was found and what was expected.
pub(super) fn parse(text: &str) -> Result<Value, String> {
    let mut reader = Reader { lines: lines(text)?, at: 0 };
    let Some(first) = reader.lines.first() else { return Err("found nothing, expected a camera".to_owned()) };
    let value = reader.block(first.indent, 0)?;
    match reader.lines.get(reader.at) {
        None => Ok(value),
        Some(line) => Err(format!(
            "line {}: found {:?}, expected the indent of the lines before",
            line.number,
            short(line.text)
        )),
    }
}

/// The lines of the single document, without comments and empty lines.
fn lines(text: &str) -> Result<Vec<Line<'_>>, String> {
    let mut lines: Vec<Line<'_>> = vec![];
    let mut ended = false;
    for (i, raw) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let number = i + 1;
        let text = without_comment(raw).trim_end();
        if text.trim().is_empty() || (lines.is_empty() && text.starts_with('%')) {
            continue;
        }
        if text == "---" || text == "..." {
            ended |= !lines.is_empty();
            continue;
        }
        if ended {
            return Err(format!(
                "line {number}: found a second document, expected one camera: keep one of them"
            ));
        }
        let content = text.trim_start_matches(' ');
        if content.starts_with('\t') {
            return Err(format!("line {number}: found a tab, expected blanks before a key"));
        }
        lines.push(Line { number, indent: text.len() - content.len(), text: content });
    }
    Ok(lines)
}

/// The line up to a `#` that begins a comment.
fn without_comment(line: &str) -> &str {
    let mut quote = None;
    let mut before = ' ';
    for (i, c) in line.char_indices() {
        match quote {
            Some(q) if c == q => quote = None,
            Some(_) => {}
            None if (c == '"' || c == '\'') && " [{,:".contains(before) => quote = Some(c),
            None if c == '#' && before.is_whitespace() => return &line[..i],
            None => {}
        }
        before = c;
    }
    line
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Key and rest of a line `key: rest`.
fn entry(text: &str) -> Option<(String, &str)> {
    if let Some(quote) = text.chars().next().filter(|c| "\"'".contains(*c)) {
        let end = text[1..].find(quote)? + 1;
        let rest = text[end + 1..].trim_start().strip_prefix(':')?;
        return Some((text[1..end].to_owned(), rest.trim()));
    }
    let colon = text.find(": ").or_else(|| text.ends_with(':').then(|| text.len() - 1))?;
    Some((text[..colon].trim().to_owned(), text[colon + 1..].trim()))
}

impl<'a> Reader<'a> {
    fn block(&mut self, indent: usize, depth: usize) -> Result<Value, String> {
        let Some(line) = self.lines.get(self.at) else { return Ok(Value::Null) };
        if depth > MAX_DEPTH {
            return Err(format!("line {}: found more than {MAX_DEPTH} levels", line.number));
        }
        if is_item(line.text) { self.sequence(indent, depth) } else { self.mapping(indent, depth) }
    }

    fn mapping(&mut self, indent: usize, depth: usize) -> Result<Value, String> {
        let mut map = Map::new();
        while let Some(line) = self.lines.get(self.at).filter(|l| l.indent == indent && !is_item(l.text)) {
            let (number, text) = (line.number, line.text);
            let (key, rest) = entry(text)
                .ok_or_else(|| format!("line {number}: found {:?}, expected key: value", short(text)))?;
            self.at += 1;
            let value = self.value(rest, number, indent, depth)?;
            if map.insert(key.clone(), value).is_some() {
                return Err(format!("line {number}: the key {key:?} stands twice; remove one of them"));
            }
        }
        Ok(Value::Object(map))
    }

    fn sequence(&mut self, indent: usize, depth: usize) -> Result<Value, String> {
        let mut list = vec![];
        while let Some(line) = self.lines.get_mut(self.at).filter(|l| l.indent == indent && is_item(l.text)) {
            let (number, rest) = (line.number, line.text[1..].trim_start());
            if entry(rest).is_some() && !rest.starts_with(['[', '{']) {
                // A mapping that begins after the dash.
                line.indent += line.text.len() - rest.len();
                line.text = rest;
                let inner = line.indent;
                list.push(self.block(inner, depth + 1)?);
            } else {
                self.at += 1;
                list.push(self.value(rest, number, indent, depth)?);
            }
        }
        Ok(Value::Array(list))
    }

    /// The value after a key or dash, on its line or on the following ones.
    fn value(&mut self, rest: &'a str, number: usize, indent: usize, depth: usize) -> Result<Value, String> {
        let mut rest = rest;
        if rest.starts_with('!') {
            let (tag, behind) = rest.split_once(' ').unwrap_or((rest, ""));
            if !TAGS.contains(&tag) {
                return Err(format!(
                    "line {number}: found the tag {}, expected {}",
                    short(tag),
                    TAGS.join(", ")
                ));
            }
            rest = behind.trim();
        }
        match rest.chars().next() {
            None => match self.lines.get(self.at) {
                Some(next) if next.indent > indent || (next.indent == indent && is_item(next.text)) => {
                    // A sequence may have the same indent as its key; after an empty item, the next item has the same indent.
                    if next.indent == indent && self.in_sequence(indent) {
                        return Ok(Value::Null);
                    }
                    let inner = next.indent;
                    self.block(inner, depth + 1)
                }
                _ => Ok(Value::Null),
            },
            Some('[' | '{') => self.flow(rest, number),
            Some('&' | '*') => Err(format!(
                "line {number}: found {:?}, an anchor or alias; write the value out",
                short(rest)
            )),
            Some('|' | '>') => Ok(self.text_block(indent)),
            _ => Ok(scalar(rest)),
        }
    }

    /// Whether the previous line is an item at this indent: then a line at the same indent is the next item.
    fn in_sequence(&self, indent: usize) -> bool {
        self.lines.get(self.at - 1).is_some_and(|l| l.indent == indent && is_item(l.text))
    }

    /// Lines of text after `|` or `>`.
    fn text_block(&mut self, indent: usize) -> Value {
        let mut text = String::new();
        while let Some(line) = self.lines.get(self.at).filter(|l| l.indent > indent) {
            text.push_str(line.text);
            text.push('\n');
            self.at += 1;
        }
        text.into()
    }

    /// A list or mapping in brackets, possibly over several lines.
    fn flow(&mut self, first: &str, number: usize) -> Result<Value, String> {
        let mut text = first.to_owned();
        let mut brackets = Brackets::default();
        brackets.read(first);
        while brackets.open > 0 {
            let Some(line) = self.lines.get(self.at) else {
                return Err(format!("line {number}: found no end of {:?}", short(first)));
            };
            brackets.read(line.text);
            text.push(' ');
            text.push_str(line.text);
            self.at += 1;
        }
        let wrong = |reason: String| format!("line {number}: {reason}");
        let mut flow = Flow { text: &text };
        let value = flow.value(0).map_err(wrong)?;
        match flow.text.trim() {
            "" => Ok(value),
            rest => Err(wrong(format!("found {:?} behind the closing bracket", short(rest)))),
        }
    }
}

fn is_item(text: &str) -> bool {
    text == "-" || text.starts_with("- ")
}

/// The number of open brackets, and the open quote.
#[derive(Default)]
struct Brackets {
    open: i64,
    quote: Option<char>,
}

impl Brackets {
    fn read(&mut self, text: &str) {
        for c in text.chars() {
            match (self.quote, c) {
                (Some(q), _) if c == q => self.quote = None,
                (Some(_), _) => {}
                (None, '"' | '\'') => self.quote = Some(c),
                (None, '[' | '{') => self.open += 1,
                (None, ']' | '}') => self.open -= 1,
                _ => {}
            }
        }
    }
}

/// The remaining text of a list or mapping in brackets.
struct Flow<'a> {
    text: &'a str,
}

impl Flow<'_> {
    fn take(&mut self, c: char) -> bool {
        self.text = self.text.trim_start();
        match self.text.strip_prefix(c) {
            Some(rest) => {
                self.text = rest;
                true
            }
            None => false,
        }
    }

    fn value(&mut self, depth: usize) -> Result<Value, String> {
        if depth > MAX_DEPTH {
            return Err(format!("found more than {MAX_DEPTH} brackets in one another"));
        }
        if self.take('[') {
            let mut list = vec![];
            while !self.take(']') {
                list.push(self.value(depth + 1)?);
                self.comma(']')?;
            }
            return Ok(Value::Array(list));
        }
        if self.take('{') {
            let mut map = Map::new();
            while !self.take('}') {
                let Value::String(key) = self.plain(":,]}") else {
                    return Err(format!("found {:?}, expected key: value", short(self.text)));
                };
                if !self.take(':') {
                    return Err(format!("found {:?} behind {key:?}, expected a colon", short(self.text)));
                }
                let value = self.value(depth + 1)?;
                if map.insert(key.clone(), value).is_some() {
                    return Err(format!("the key {key:?} stands twice; remove one of them"));
                }
                self.comma('}')?;
            }
            return Ok(Value::Object(map));
        }
        match self.plain(",]}") {
            Value::String(text) if text.starts_with(['&', '*', '!']) => {
                Err(format!("found {text:?}, expected a value"))
            }
            value => Ok(value),
        }
    }

    fn comma(&mut self, end: char) -> Result<(), String> {
        if self.take(',') || self.text.trim_start().starts_with(end) {
            return Ok(());
        }
        Err(format!("found {:?}, expected a comma or {end}", short(self.text)))
    }

    /// A scalar up to one of `ends`.
    fn plain(&mut self, ends: &str) -> Value {
        self.text = self.text.trim_start();
        let quote = self.text.chars().next().filter(|c| "\"'".contains(*c));
        let end = match quote {
            Some(q) => self.text[1..].find(q).map_or(self.text.len(), |i| i + 2),
            None => self.text.find(|c: char| ends.contains(c)).unwrap_or(self.text.len()),
        };
        let (value, rest) = self.text.split_at(end);
        self.text = rest;
        scalar(value.trim())
    }
}

/// The value of a word.
pub(super) fn scalar(text: &str) -> Value {
    for quote in ['"', '\''] {
        if let Some(inside) = text.strip_prefix(quote).and_then(|t| t.strip_suffix(quote)) {
            return inside.into();
        }
    }
    match text {
        "" | "~" | "null" => return Value::Null,
        "true" | "True" => return true.into(),
        "false" | "False" => return false.into(),
        _ => {}
    }
    if let Ok(whole) = text.parse::<i64>() {
        return whole.into();
    }
    match text.parse::<f64>().ok().and_then(Number::from_f64) {
        Some(number) => number.into(),
        None => text.into(),
    }
}
