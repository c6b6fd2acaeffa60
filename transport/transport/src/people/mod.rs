//! The person stream: topics, templates, the choice of colour layers, relays.

pub(crate) mod catch_up;
mod chunks;
pub(crate) mod color_layers;
pub(crate) mod person_stream;
pub(crate) mod present;
pub(crate) mod relay;
pub(crate) mod template_fetcher;
pub(crate) mod wake_lag;
