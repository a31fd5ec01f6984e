//! Options that would have no effect in combination with the other options: refused by name rather than ignored.
//!
//! `clap` has `requires` and `conflicts_with`. They do not work for options with a default or an environment variable, which
//! count as given, for values of other options, or where one of the required options conflicts with a given one.

use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{ArgMatches, Command};

/// A condition under which an option has no effect. Options are named by their `clap` ids.
#[derive(Debug, Clone, Copy)]
pub enum When {
    /// This option is not given.
    Without(&'static str),
    /// This option is given.
    With(&'static str),
    /// This option has one of these values, given or by default.
    Is(&'static str, &'static [&'static str]),
    /// This option is given, with another value than this one.
    IsNot(&'static str, &'static str),
}

/// Options of a command that have no effect when all conditions of `when` hold.
#[derive(Debug)]
pub struct Idle {
    /// The command, its words separated by blanks.
    pub command: &'static str,
    /// The options, by their `clap` ids.
    pub options: &'static [&'static str],
    /// The conditions.
    pub when: &'static [When],
}

/// Whether the option was given on the command line or in the environment.
fn is_given(matches: &ArgMatches, id: &str) -> bool {
    matches.value_source(id).is_some_and(|source| source != ValueSource::DefaultValue)
}

/// The option's value as text, given or by default.
fn value(matches: &ArgMatches, id: &str) -> Option<String> {
    let mut values = matches.try_get_raw(id).ok().flatten()?;
    values.next().map(|value| value.to_string_lossy().into_owned())
}

impl When {
    /// The option that the condition is about.
    fn option(&self) -> &'static str {
        match self {
            When::Without(id) | When::With(id) | When::Is(id, _) | When::IsNot(id, _) => id,
        }
    }

    fn holds(&self, matches: &ArgMatches) -> bool {
        match self {
            When::Without(id) => !is_given(matches, id),
            When::With(id) => is_given(matches, id),
            When::Is(id, values) => value(matches, id).is_some_and(|v| values.contains(&v.as_str())),
            When::IsNot(id, other) => {
                is_given(matches, id) && value(matches, id).is_some_and(|v| v != *other)
            }
        }
    }

    /// The condition as text for the message.
    fn text(&self, command: &Command, matches: &ArgMatches) -> String {
        let option = typed(command, self.option());
        match self {
            When::Without(_) => format!("without {option}"),
            When::With(_) => format!("with {option}"),
            When::Is(id, _) | When::IsNot(id, _) => {
                format!("with {option} {}", value(matches, id).unwrap_or_default())
            }
        }
    }
}

/// An option as it is typed on the command line.
fn typed(command: &Command, id: &str) -> String {
    let argument = command.get_arguments().find(|a| a.get_id() == id);
    match argument.and_then(clap::Arg::get_long) {
        Some(long) => format!("--{long}"),
        None => id.to_uppercase(),
    }
}

/// The subcommand of `command` that `words` name, if this program has it.
fn below<'c>(command: &'c Command, words: &str) -> Option<&'c Command> {
    words.split(' ').try_fold(command, |command, word| command.find_subcommand(word))
}

impl Idle {
    /// The message, if an option without effect was typed. An option from the environment is accepted: it may be meant for other
    /// commands.
    fn refusal(&self, root: &Command, matches: &ArgMatches) -> Option<String> {
        let command = below(root, self.command)?;
        let matches = self.command.split(' ').try_fold(matches, |m, word| m.subcommand_matches(word))?;
        if !self.when.iter().all(|when| when.holds(matches)) {
            return None;
        }
        let typed_in = |id: &&&str| matches.value_source(id) == Some(ValueSource::CommandLine);
        let option = self.options.iter().find(typed_in)?;
        let when: Vec<String> = self.when.iter().map(|when| when.text(command, matches)).collect();
        Some(format!("{} has no effect {}", typed(command, option), when.join(" ")))
    }

    /// The first name that is not an option of the command, or the command's name if there is no such command; for tests of the
    /// tables.
    pub fn unknown(&self, root: &Command) -> Option<String> {
        let Some(command) = below(root, self.command) else { return Some(self.command.to_owned()) };
        let known = |id: &str| command.get_arguments().any(|a| a.get_id() == id);
        let ids = self.options.iter().copied().chain(self.when.iter().map(When::option));
        ids.into_iter().find(|id| !known(id)).map(|id| format!("{}: {id}", self.command))
    }
}

/// An error for the first option that would have no effect.
///
/// # Errors
/// `clap`'s, of the kind of conflicting options.
pub fn refuse(table: &[Idle], root: &Command, matches: &ArgMatches) -> Result<(), clap::Error> {
    match table.iter().find_map(|idle| idle.refusal(root, matches)) {
        Some(text) => Err(clap::Error::raw(ErrorKind::ArgumentConflict, format!("{text}\n"))),
        None => Ok(()),
    }
}
