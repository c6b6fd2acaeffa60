//! Options that the command line names.

use clap::{ArgMatches, Args, Command, Error, FromArgMatches, parser::ValueSource};

/// Names of options as they are in the arguments' definition, where the command line and no default gives the value.
#[derive(Debug, Clone, Default)]
pub struct NamedOptions(Vec<String>);

impl NamedOptions {
    /// Returns whether the command line names an option.
    pub fn contains(&self, name: &str) -> bool {
        self.0.iter().any(|named| named == name)
    }
}

impl Args for NamedOptions {
    fn augment_args(command: Command) -> Command {
        command
    }

    fn augment_args_for_update(command: Command) -> Command {
        command
    }
}

impl FromArgMatches for NamedOptions {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let names = matches.ids().map(clap::Id::as_str);
        let is_named = |name: &&str| matches.value_source(name) == Some(ValueSource::CommandLine);
        Ok(Self(names.filter(is_named).map(str::to_owned).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}
