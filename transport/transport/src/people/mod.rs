//! The person stream: topics, templates, the choice of colour layers, relays.

pub(crate) mod color_layers;
pub(crate) mod person_stream;
pub(crate) mod relay;
pub(crate) mod template_fetcher;
pub(crate) mod wake_lag;
