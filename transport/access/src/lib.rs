//! Access of other computers to a rig: keys of those who may connect, and the gate that admits them.
//!
//! A [`Ring`] is the folder of a rig's keys: an authority that signs certificates, the rig's own certificate, and the list of holders.
//! A [`KeyFile`] is what one holder gets: certificate, private key, and where the rig is. A [`Gate`] listens for holders, requires a
//! certificate of the ring from each (TLS 1.3 on both sides), looks every one up in the list, and passes the connection on to a session
//! of this computer under a name by which that session knows what the holder may do. The list is read again while the gate is open: a
//! key that is revoked is disconnected at once.

mod error;
mod gate;
mod holder;
mod issue;
mod key_file;
mod limits;
mod listener;
mod probe;
mod ring_folder;
mod role;
mod secret_file;
mod tls;

pub use error::AccessError;
pub use gate::{Gate, Inner};
pub use holder::{Holder, MAX_HOLDERS};
pub use key_file::KeyFile;
pub use listener::{BoundListener, Bounds, Connection, ConnectionPlace, Listener, Serve};
pub use probe::KeyProbe;
pub use ring_folder::{DEFAULT_PORT, Ring};
pub use role::Role;
