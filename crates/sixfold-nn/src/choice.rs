//! Enumerations whose values users type, such as the networks of a recipe: one list for the command line and Python.

/// An enumeration whose values have names.
pub trait Choice: Copy + 'static {
    /// All values, in the order in which they are listed.
    const ALL: &'static [Self];

    /// Its name, as typed.
    fn name(self) -> &'static str;

    /// One line about it, for help.
    fn help(self) -> &'static str;

    /// The value with that name.
    fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|choice| choice.name() == name)
    }
}
