//! Access of other computers to a rig: keys, and the gate that admits their holders.
//!
//! A [`Ring`] is the folder of a rig's keys: an authority that signs certificates, the rig's own certificate, and the list of holders.
//! A [`KeyFile`] is the file of one holder: certificate, private key, and addresses of the rig. A [`Gate`] listens for holders, requires a
//! certificate of the ring from each (TLS 1.3 on both sides), and looks it up in the list at every handshake, so that keys added or revoked
//! take effect at once; a key that is revoked is disconnected. The folder is locked while it is changed. The gate bounds what one address may begin, and passes the connection on,
//! through TLS again, to a session of the same process under a name made of role and number ([`Inner::name`]), which selects the holder's
//! rights there. A [`KeyProbe`] finds out why a connection fails, which zenoh does not report.
//!
//! [`Listener`] is the bounded TCP listener below the gate; the servers of the web page and of the metrics use it as well.
//!
//! ```
//! use flyrig_access::{KeyFile, Ring, Role};
//!
//! # let folder = tempfile::tempdir()?;
//! # let (keys, file) = (folder.path().join("studio-keys"), folder.path().join("desk.key"));
//! let mut ring = Ring::create(&keys, "studio", &["rig.local".to_owned()], 7450)?;
//! ring.add_file(&file, "desk", Role::Viewer, &[], 30)?;
//! assert_eq!(KeyFile::read(&file, &[Role::Viewer])?.connect, ["rig.local:7450"]);
//! ring.revoke("desk")?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod ends;
mod error;
mod folder_lock;
mod gate;
mod holder;
mod hosts;
mod issue;
mod key_file;
mod limits;
mod listener;
mod open_files;
mod places;
mod probe;
mod ring_folder;
mod role;
mod secret_file;
mod tls;

pub use ends::KeyEnds;
pub use error::AccessError;
pub use gate::{Gate, HolderList, Inner};
pub use holder::{Holder, MAX_HOLDERS};
pub use key_file::KeyFile;
pub use listener::{BoundListener, Bounds, Connection, ConnectionPlace, Listener, Serve};
pub use probe::KeyProbe;
pub use ring_folder::{DEFAULT_PORT, Ring};
pub use role::Role;
