//! Schema version of the wire.

/// Version of keys, headers and payloads; raised by any change that an older program would misread.
pub const SCHEMA_VERSION: u16 = 1;
