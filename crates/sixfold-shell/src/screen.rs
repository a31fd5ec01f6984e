//! All output of the programs goes through this module. Control characters of names and messages that were read from files never
//! reach a terminal, nor does the password in a server's address, wherever on the command line it was given. A result that could
//! not be printed is reported as an error.
//!
//! The macros have the names of the standard ones and replace them, so that no line of the programs bypasses them.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fmt;
use std::io::{self, Write};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use clap::Parser;
use serde_json::json;

use crate::idle::{Idle, refuse};

/// Prints a line to standard output as [`std::println`] does, without control characters and without a panic.
#[macro_export]
macro_rules! println {
    () => { $crate::screen::out(::std::format_args!("\n")) };
    ($($text:tt)*) => { $crate::screen::out(::std::format_args!("{}\n", ::std::format_args!($($text)*))) };
}

/// Prints to standard output as [`std::print`] does, without control characters and without a panic.
#[macro_export]
macro_rules! print {
    ($($text:tt)*) => { $crate::screen::out(::std::format_args!($($text)*)) };
}

/// Prints a line to standard error as [`std::eprintln`] does, without control characters and without a panic.
#[macro_export]
macro_rules! eprintln {
    () => { $crate::screen::err(::std::format_args!("\n")) };
    ($($text:tt)*) => { $crate::screen::err(::std::format_args!("{}\n", ::std::format_args!($($text)*))) };
}

/// Whether anything went to standard output.
static PRINTED: AtomicBool = AtomicBool::new(false);
/// The first error of writing to standard output.
static FAILED: Mutex<Option<io::Error>> = Mutex::new(None);

/// What the macros call for standard output. A failure is kept for the end of the program.
pub fn out(text: fmt::Arguments<'_>) {
    PRINTED.store(true, Ordering::Relaxed);
    kept(io::stdout().write_all(printable(&text.to_string()).as_bytes()));
}

/// What the macros call for standard error. A failure to write there cannot be reported anywhere.
pub fn err(text: fmt::Arguments<'_>) {
    if let Err(error) = io::stderr().write_all(printable(&text.to_string()).as_bytes()) {
        end_with_the_reader(&error);
    }
}

/// Ends the program when nobody reads its output any more (`sixfold ... | head`), as the signal would end a C program. Commands
/// write what must be kept to files.
fn end_with_the_reader(error: &io::Error) {
    if error.kind() == io::ErrorKind::BrokenPipe {
        // 128 and the number of SIGPIPE.
        std::process::exit(141);
    }
}

/// Keeps the first failure.
fn kept(result: io::Result<()>) {
    if let Err(error) = result {
        end_with_the_reader(&error);
        FAILED.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }
}

/// The text with control characters and those that reverse the direction of writing as JSON escapes (`\u001b`), so that texts of
/// files cannot move the cursor, clear the screen or imitate another name. Line ends and tabs stay. JSON remains the same JSON.
pub fn plain(text: &str) -> Cow<'_, str> {
    let harmful = |c: char| {
        (c.is_control() && !matches!(c, '\n' | '\t'))
            || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    if !text.contains(harmful) {
        return Cow::Borrowed(text);
    }
    let mut safe = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if harmful(c) {
            safe.push_str(&format!("\\u{:04x}", u32::from(c)));
        } else {
            safe.push(c);
        }
    }
    Cow::Owned(safe)
}

/// A text made safe to print: as [`plain`], and with the passwords removed from server addresses that are among the program's
/// arguments.
pub(crate) fn printable(text: &str) -> String {
    plain(&without_addresses(text, addresses())).into_owned()
}

/// A server address given anywhere on the command line, and its form without a password.
#[derive(Debug, PartialEq)]
struct Address {
    given: String,
    shown: String,
}

/// The addresses among the arguments of this program.
fn addresses() -> &'static [Address] {
    static ADDRESSES: OnceLock<Vec<Address>> = OnceLock::new();
    ADDRESSES.get_or_init(|| addresses_of(std::env::args_os().skip(1)))
}

/// The addresses among arguments, and among the values after equals signs; the longest first.
fn addresses_of(arguments: impl Iterator<Item = OsString>) -> Vec<Address> {
    let mut found = vec![];
    for argument in arguments {
        let argument = argument.to_string_lossy();
        let value = argument.split_once('=').map(|(_, value)| value);
        for given in [Some(&*argument), value].into_iter().flatten() {
            if let Some(shown) = shown_address(given).filter(|shown| shown != given) {
                found.push(Address { given: given.to_owned(), shown });
            }
        }
    }
    found.sort_by_key(|address| std::cmp::Reverse(address.given.len()));
    found
}

/// The address of a server without its password; `None` for text that is not an address.
#[cfg(feature = "experience")]
fn shown_address(text: &str) -> Option<String> {
    match sixfold_experience::StorePlace::from(text) {
        sixfold_experience::StorePlace::File(_) => None,
        place => Some(place.to_string()),
    }
}

/// No option of this program takes an address.
#[cfg(not(feature = "experience"))]
fn shown_address(_: &str) -> Option<String> {
    None
}

/// A text with the addresses replaced by their forms without passwords.
fn without_addresses<'t>(text: &'t str, addresses: &[Address]) -> Cow<'t, str> {
    let mut text = Cow::Borrowed(text);
    for Address { given, shown } in addresses {
        if text.contains(given.as_str()) {
            text = Cow::Owned(text.replace(given.as_str(), shown));
        }
    }
    text
}

/// A message about the command line without passwords. A message that shows a part of an address, such as the part before a comma,
/// is replaced by `kind`, which names no argument.
fn without_passwords(message: &str, kind: &str, addresses: &[Address]) -> String {
    fn words(text: &str) -> impl Iterator<Item = &str> {
        text.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty())
    }
    let safe = without_addresses(message, addresses);
    let in_message: BTreeSet<&str> = words(&safe).collect();
    let public: BTreeSet<&str> = addresses.iter().flat_map(|a| words(&a.shown)).collect();
    let secret = |a: &Address| words(&a.given).any(|w| in_message.contains(w) && !public.contains(w));
    if addresses.iter().any(secret) {
        return format!(
            "error: {kind}; what was given is not shown, for there is a server's address in it\n"
        );
    }
    safe.into_owned()
}

/// The kind of failure that a program reports to its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Failure {
    /// The command line is wrong.
    Usage,
    /// The command failed.
    Command,
    /// The user stopped it.
    Interrupt,
}

/// Reports an error on standard error and, where JSON was asked for and nothing was printed yet, as JSON on standard output.
pub(crate) fn fail(message: &str, failure: Failure) {
    eprintln!("error: {message}");
    fail_as_json(message, failure);
}

fn fail_as_json(message: &str, failure: Failure) {
    if !json_wanted(std::env::args_os().skip(1)) || PRINTED.load(Ordering::Relaxed) {
        return;
    }
    let kind = match failure {
        Failure::Usage => "usage",
        Failure::Command => "command",
        Failure::Interrupt => "interrupt",
    };
    println!("{:#}", json!({ "error": { "kind": kind, "message": message, "exit_status": 2 } }));
}

/// Whether `--json` requests JSON on the screen, that is, no file follows it. Used when arguments could not be parsed.
fn json_wanted(arguments: impl Iterator<Item = OsString>) -> bool {
    let arguments: Vec<OsString> = arguments.take_while(|a| a != "--").collect();
    let is_option = |a: &OsString| a.len() > 1 && a.as_encoded_bytes().starts_with(b"-");
    let place = arguments.iter().position(|a| a == "--json");
    place.is_some_and(|i| arguments.get(i + 1).is_none_or(is_option))
}

/// Parses the command line of a program. If it is wrong or requests help, the text has been printed and the error is the exit
/// status. Options that have no effect according to `idle` are wrong.
pub fn parse<A: Parser>(idle: &[Idle]) -> Result<A, ExitCode> {
    let mut command = A::command();
    let parsed = command.try_get_matches_from_mut(std::env::args_os()).and_then(|matches| {
        let arguments = A::from_arg_matches(&matches);
        arguments
            .and_then(|arguments| refuse(idle, &command, &matches).map(|()| arguments))
            .map_err(|error| error.format(&mut command))
    });
    parsed.map_err(|error| {
        if error.use_stderr() {
            let kind = error.kind().as_str().unwrap_or("the command line is wrong");
            let text = match addresses() {
                [] => {
                    // This prints with colours. A failure to print cannot be reported anywhere.
                    drop(error.print());
                    error.render().to_string()
                }
                addresses => {
                    let text = without_passwords(&error.render().to_string(), kind, addresses);
                    err(format_args!("{text}"));
                    text
                }
            };
            let end = ["\n\nUsage:", "\n\nFor more information"].iter().filter_map(|e| text.find(e)).min();
            let message = text[..end.unwrap_or(text.len())].trim();
            fail_as_json(message.strip_prefix("error: ").unwrap_or(message), Failure::Usage);
        } else {
            kept(error.print());
        }
        finish(u8::try_from(error.exit_code()).unwrap_or(2))
    })
}

/// The exit status of a program that would end with `code`: 2 where its output could not be printed.
pub(crate) fn finish(code: u8) -> ExitCode {
    kept(io::stdout().flush());
    match FAILED.lock().unwrap_or_else(PoisonError::into_inner).take() {
        None => ExitCode::from(code),
        Some(error) => {
            eprintln!(
                "error: standard output: cannot be written: {error}; give --json FILE or --out for a file"
            );
            ExitCode::from(2)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terminals_see_no_control_characters() {
        assert!(matches!(plain("Tasse, 12 µm\n\tΩ"), Cow::Borrowed(_)));
        let hostile = "mug\u{1b}[2J\u{1b}]0;title\u{7}\r\u{9b}1m\u{202e}gnp.\u{7f}";
        assert_eq!(plain(hostile), "mug\\u001b[2J\\u001b]0;title\\u0007\\u000d\\u009b1m\\u202egnp.\\u007f");
        // JSON means the same as before.
        let text = json!({ "name": hostile }).to_string();
        let back: serde_json::Value = serde_json::from_str(&plain(&text)).unwrap();
        assert_eq!(back["name"], hostile);
    }

    #[cfg(feature = "experience")]
    #[test]
    fn addresses_on_the_command_line_are_printed_without_passwords() {
        let of = |text: &str| addresses_of(text.split_whitespace().map(OsString::from));
        assert!(
            of("grasp propose --depth d.png --camera=c.json --box 1,2,3,4 --experiences a.db").is_empty()
        );
        // Text without a password is not changed.
        assert!(of("grasp store list postgres://robot@server:5432/fleet").is_empty());
        let address = "postgres://robot:secret@server/fleet";
        let given = of(&format!("grasp learn {address}"));
        let message = format!("error: unexpected argument '{address}' found\n\nUsage: sixfold grasp learn");
        let safe = without_passwords(&message, "unexpected argument found", &given);
        assert_eq!(safe, message.replace(":secret", ""));
        // Only the value of an option; the whole argument where the option does not exist.
        let given = of(&format!("--outbox={address} --{address}"));
        for shown in [address.to_owned(), format!("--{address}"), format!("--outbox={address}")] {
            let safe = without_passwords(&format!("found '{shown}', expected none"), "wrong", &given);
            assert!(safe.starts_with("found '") && !safe.contains("secret"), "{safe}");
        }
        // A part of it.
        let given = of("detect --ids postgres://robot:sec,ret@server/fleet");
        let safe =
            without_passwords("error: invalid value 'ret@server/fleet' for --ids", "invalid value", &given);
        assert!(safe.starts_with("error: invalid value; ") && !safe.contains("server/fleet"), "{safe}");
    }

    #[test]
    fn json_is_wanted_on_the_screen_or_in_a_file() {
        let wanted = |text: &str| json_wanted(text.split_whitespace().map(OsString::from));
        for text in ["eval --json", "eval --json --dataset lmo", "object list --json -v"] {
            assert!(wanted(text), "{text}");
        }
        for text in
            ["eval", "eval --json out.json", "eval --json=out.json", "eval -- --json", "eval --json -"]
        {
            assert!(!wanted(text), "{text}");
        }
    }
}
