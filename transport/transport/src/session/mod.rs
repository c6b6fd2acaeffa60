//! zenoh sessions: settings, ports, keys of holders, rules of access.

pub(crate) mod access_rules;
pub(crate) mod config;
pub(crate) mod network_threads;
pub(crate) mod opening;
