//! Messages about cameras in foxglove's and ROS's schemas, decoded by the name of the schema.

mod cdr;
mod content;
mod json;
mod ros;
mod schema;

pub(super) use self::{
    content::{ImageMessage, Kind, LensMessage, Link, Pixels},
    schema::Schema,
};
