//! A data set to code.

use std::path::PathBuf;

use flyrig_sim::MotionKind;
use serde::{Deserialize as _, de::IntoDeserializer as _};

/// Prefix of the name of a simulated person.
pub const SIMULATED: &str = "sim:";

/// A data set to code.
#[derive(Debug, Clone)]
pub enum CodedSubject {
    /// A folder in EasyMocap layout.
    Folder(PathBuf),
    /// A simulated person with this motion.
    Simulated(MotionKind, String),
}

impl std::str::FromStr for CodedSubject {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some(name) = text.strip_prefix(SIMULATED) else { return Ok(Self::Folder(text.into())) };
        let kind: Result<MotionKind, serde::de::value::Error> = MotionKind::deserialize(name.into_deserializer());
        Ok(Self::Simulated(kind.map_err(|error| error.to_string())?, name.to_owned()))
    }
}
