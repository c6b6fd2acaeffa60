//! `flyrig keys`: keys with which other computers connect to a rig.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use clap::{Args, Subcommand};
use flyrig_access::{DEFAULT_PORT, Holder, KeyFile, Ring, Role};

/// Keys of a rig.
#[derive(Debug, Args)]
pub struct RingArgs {
    /// Folder of the rig's keys; the only such folder in the current one otherwise.
    #[arg(long)]
    pub ring: Option<PathBuf>,
}

/// Arguments of a new key.
#[derive(Debug, Args)]
pub struct NewKeyArgs {
    /// Validity, days.
    #[arg(long, default_value_t = 365)]
    pub days: u64,
    /// File of the key; NAME.key otherwise.
    #[arg(long)]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub ring: RingArgs,
}

/// Subcommands of `flyrig keys`.
#[derive(Debug, Subcommand)]
pub enum KeysAction {
    /// Create the folder of a rig's keys.
    New {
        /// Name of the rig, as rig.name in its configuration.
        rig: String,
        /// Name or address by which other computers reach this computer; may be repeated.
        #[arg(long = "host", required = true, value_name = "NAME")]
        hosts: Vec<String>,
        /// Port for viewers; cameras of other computers use the next one.
        #[arg(long, default_value_t = DEFAULT_PORT)]
        port: u16,
        /// New folder; RIG-keys otherwise.
        #[arg(long)]
        out: Option<PathBuf>,
    },
    /// Create a key: a single file, which is all that its holder needs.
    Add {
        /// Name of the holder.
        name: String,
        /// Role: "viewer" watches, "cameras" sends camera images, "relay" watches and serves other viewers.
        #[arg(long, default_value = "viewer", value_parser = parse_role)]
        role: Role,
        /// Camera that a key of role "cameras" may send; may be repeated. Every camera otherwise.
        #[arg(long = "camera", value_name = "NAME")]
        cameras: Vec<String>,
        #[command(flatten)]
        file: NewKeyArgs,
    },
    /// List the holders of keys.
    List {
        #[command(flatten)]
        ring: RingArgs,
    },
    /// Create a new key for a holder, and refuse the old one from now on.
    Renew {
        /// Name of the holder.
        name: String,
        #[command(flatten)]
        file: NewKeyArgs,
    },
    /// Refuse a holder from now on; a running rig disconnects it within a second.
    Revoke {
        /// Name of the holder.
        name: String,
        #[command(flatten)]
        ring: RingArgs,
    },
}

fn parse_role(text: &str) -> Result<Role, String> {
    let known = Role::ALL.map(Role::name);
    Role::ALL
        .into_iter()
        .find(|role| role.name() == text)
        .ok_or_else(|| format!("no such role; known: {}", known.join(", ")))
}

/// Ending of the names of key folders.
const FOLDER_END: &str = "-keys";

/// Runs the command.
pub fn keys(action: &KeysAction) -> Result<()> {
    match action {
        KeysAction::New { rig, hosts, port, out } => {
            let folder = out.clone().unwrap_or_else(|| PathBuf::from(format!("{rig}{FOLDER_END}")));
            let ring = Ring::create(&folder, rig, hosts, *port)?;
            println!("{}", folder.display());
            let (viewers, cameras) = (ring.address(Role::Viewer).port(), ring.address(Role::Cameras).port());
            eprintln!(
                "keys: the keys of rig '{rig}' lie in {0}. Keep that folder secret, and on this computer.\n\
                 Name it in the rig's configuration:\n\n    [rig]\n    name = \"{rig}\"\n    [transport]\n    keys = \"{0}\"\n\n\
                 and let ports {viewers} (viewers) and {cameras} (cameras of other computers) through the firewall.\n\
                 Next: flyrig keys add NAME --ring {0}",
                folder.display()
            );
        }
        KeysAction::Add { name, role, cameras, file } => {
            let mut ring = open(&file.ring)?;
            let path = new_file(&mut ring, file.out.as_deref(), name)?;
            report(&ring.add_file(&path, name, *role, cameras, file.days)?, &path);
        }
        KeysAction::Renew { name, file } => {
            let mut ring = open(&file.ring)?;
            let path = new_file(&mut ring, file.out.as_deref(), name)?;
            report(&ring.renew_file(&path, name, file.days)?, &path);
            eprintln!("keys: the old key of '{name}' is refused from now on");
        }
        KeysAction::Revoke { name, ring } => {
            open(ring)?.revoke(name)?;
            eprintln!("keys: '{name}' is refused from now on, and disconnected if it is connected");
        }
        KeysAction::List { ring } => {
            let mut ring = open(ring)?;
            if let Err(error) = ring.refresh() {
                tracing::debug!(%error, "the list is shown as it is");
            }
            println!("rig '{}', reached at {}", ring.rig(), ring.hosts().join(", "));
            println!("{:<24} {:<8} {:<16} {:<21} state", "name", "role", "cameras", "valid until");
            ring.holders().iter().for_each(|holder| println!("{}", line(holder)));
        }
    }
    Ok(())
}

fn line(holder: &Holder) -> String {
    let state = match holder {
        Holder { revoked: true, .. } => "revoked",
        _ if holder.expires_at() <= std::time::SystemTime::now() => "expired",
        _ => "valid",
    };
    let cameras = match holder {
        Holder { revoked: true, .. } => "-".to_owned(),
        _ if holder.role != Role::Cameras => "-".to_owned(),
        _ if holder.cameras.is_empty() => "all".to_owned(),
        _ => holder.cameras.join(","),
    };
    format!("{:<24} {:<8} {cameras:<16} {:<21} {state}", holder.name, holder.role.name(), holder.expires)
}

/// Opens the named key ring, or the only one in this folder.
fn open(RingArgs { ring }: &RingArgs) -> Result<Ring> {
    if let Some(folder) = ring {
        return Ok(Ring::open(folder)?);
    }
    let entries = std::fs::read_dir(".").context("cannot look for keys in this folder; name theirs with --ring")?;
    let mut found: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.join("ring.toml").is_file())
        .map(|path| path.strip_prefix("./").map(Path::to_owned).unwrap_or(path))
        .collect();
    found.sort();
    match found.as_slice() {
        [only] => Ok(Ring::open(only)?),
        [] => anyhow::bail!(
            "there are no keys in this folder; make some with `flyrig keys new RIG --host NAME`, or name their folder with --ring"
        ),
        several => {
            let names: Vec<_> = several.iter().map(|path| path.display().to_string()).collect();
            anyhow::bail!("there are several rings of keys here ({}); name one with --ring", names.join(", "))
        }
    }
}

/// Returns the file of a new key, which must not exist; one that an ended command left there is removed.
fn new_file(ring: &mut Ring, out: Option<&Path>, name: &str) -> Result<PathBuf> {
    ring.refresh()?;
    let path = out.map_or_else(|| PathBuf::from(format!("{name}.key")), Path::to_owned);
    anyhow::ensure!(
        !path.exists(),
        "{} is there already; move it away, or name another file with --out",
        path.display()
    );
    Ok(path)
}

/// Prints where a new key is, and how it is used.
fn report(key: &KeyFile, path: &Path) {
    println!("{}", path.display());
    let file = path.display();
    let with = match key.role {
        Role::Viewer => format!("flyrig view {file}"),
        Role::Cameras => format!("flyrig capture rig.toml --key {file}"),
        Role::Relay => format!("flyrig serve {file}"),
    };
    eprintln!(
        "keys: give {file} to '{}' over a channel you trust; it is used with `{with}` and valid until {}",
        key.holder, key.expires
    );
    if key.role == Role::Cameras && key.cameras.is_empty() {
        eprintln!(
            "keys: it may send every camera; name those of its computer with --camera to let it send these alone"
        );
    }
}
