//! `flyrig config check`: a configuration, and the files, folders and addresses that it names.

use std::{
    net::{TcpListener, ToSocketAddrs},
    path::Path,
};

use anyhow::{Context as _, Result, bail, ensure};
use flyrig_access::{Ring, Role};
use flyrig_fusion::PersonMemory;
use flyrig_takes::{SourceKind, known_body};
use flyrig_tracker::PoseNet;

use crate::config::Config;

/// Runs the command; `offline` checks the text alone.
///
/// # Errors
/// Names everything that is missing or wrong, one line each.
pub fn check(path: &Path, offline: bool) -> Result<()> {
    let config = Config::load_for_capture(path)?;
    // Cameras are configured before they are calibrated.
    let scene = config.check_scene().and_then(|()| if offline { Ok(()) } else { require_calibration(&config, path) });
    let name = path.display();
    if !offline {
        let problems = problems(&config, scene.is_ok());
        match problems.as_slice() {
            [] => {}
            [only] => bail!("in the configuration {name}: {only}"),
            several => bail!("{} problems in the configuration {name}:\n  {}", several.len(), several.join("\n  ")),
        }
    }
    match scene {
        Ok(()) => println!("{name} is right"),
        Err(error) => println!("{name} is right for `flyrig capture` and `flyrig doctor` alone: {error}"),
    }
    Ok(())
}

/// Checks that the cameras of this computer have been calibrated.
fn require_calibration(config: &Config, path: &Path) -> Result<()> {
    let source = &config.source;
    let folder = source.calibration_folder().unwrap_or(&source.path).display();
    ensure!(
        source.kind != SourceKind::Cameras || source.has_calibration(),
        "{folder} holds no calibration yet; make one with `flyrig calibrate live {} --out {folder}`",
        path.display()
    );
    Ok(())
}

/// Opens all that a configuration names. Without `has_scene` no person is tracked, so that calibration and body are not needed.
fn problems(config: &Config, has_scene: bool) -> Vec<String> {
    let mut checks = Vec::new();
    if has_scene {
        checks.push(config.take().check());
        checks.extend(person_checks(config));
    }
    checks.extend(address_checks(config));
    let text = |error: anyhow::Error| flyrig_report::program::one_line(&error);
    checks.into_iter().filter_map(Result::err).map(text).collect()
}

/// Opens the files that describe people and networks.
fn person_checks(config: &Config) -> Vec<Result<()>> {
    let network = &config.perception.network;
    let weights = || config.appearance.load_networks().map(|_| ()).context("appearance.weights");
    vec![
        known_body(&config.body, config.output.avatar).map(|_| ()),
        config.body.person_file().map_or(Ok(()), check_person),
        if PoseNet::is_built_in(network) {
            Ok(())
        } else {
            PoseNet::load(network, true).map(|_| ()).context("perception.network")
        },
        weights(),
    ]
}

/// Reads the saved person, or checks that one can be saved.
fn check_person(path: &Path) -> Result<()> {
    if path.exists() {
        return PersonMemory::load(path).map(|_| ()).context("body.person");
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(folder.is_dir(), "body.person: its folder {} does not exist; create it first", folder.display());
    Ok(())
}

/// Tries the addresses that the configuration listens on, and reads the keys.
fn address_checks(config: &Config) -> Vec<Result<()>> {
    let transport = &config.transport;
    let mut checks: Vec<Result<()>> = Vec::new();
    checks.extend(transport.listen.iter().map(|endpoint| check_endpoint("transport.listen", endpoint)));
    if !transport.keys.as_os_str().is_empty() {
        checks.push(check_keys(config));
    }
    for (key, address) in [("web.listen", &config.web.listen), ("health.listen", &config.health.listen)] {
        if !address.is_empty() {
            checks.push(check_address(key, address));
        }
    }
    let (certificate, key) = (&config.web.certificate, &config.web.key);
    if certificate.exists() != key.exists() {
        let (there, missing) = if key.exists() { (key, certificate) } else { (certificate, key) };
        let problem = format!("web: {} exists and {} does not", there.display(), missing.display());
        checks.push(Err(anyhow::anyhow!("{problem}; give both, or delete the one, and both are made")));
    }
    checks
}

/// Opens the keys, which must be of this rig, and tries their address.
fn check_keys(config: &Config) -> Result<()> {
    let folder = &config.transport.keys;
    ensure!(
        folder.is_dir(),
        "transport.keys: {} does not exist; `flyrig keys new {} --host NAME` makes it",
        folder.display(),
        config.rig.name
    );
    let ring = Ring::open(folder).context("transport.keys")?;
    ensure!(
        ring.rig() == config.rig.name,
        "transport.keys: {} holds the keys of rig '{}', and rig.name is '{}'; use the keys of this rig, or its name",
        folder.display(),
        ring.rig(),
        config.rig.name
    );
    let mut roles = vec![Role::Viewer];
    if config.source.kind == SourceKind::Network {
        roles.push(Role::Cameras);
    }
    for role in roles {
        check_address("transport.keys", &ring.address(role).to_string())?;
    }
    Ok(())
}

/// Listens on a zenoh endpoint for a moment, if it is one of TCP; `key` names the setting.
///
/// # Errors
/// The address is taken, or is none of this computer's.
pub fn check_endpoint(key: &str, endpoint: &str) -> Result<()> {
    let address = endpoint.strip_prefix("tcp/").and_then(|address| address.split(['#', '?']).next());
    address.map_or(Ok(()), |address| check_address(key, address))
}

/// Listens on an address for a moment.
fn check_address(key: &str, address: &str) -> Result<()> {
    let addresses: Vec<_> = address
        .to_socket_addrs()
        .with_context(|| format!("{key}: {address} is no address of this computer; write HOST:PORT"))?
        .collect();
    match TcpListener::bind(addresses.as_slice()) {
        Ok(_) => Ok(()),
        Err(error) => bail!(
            "{key}: cannot listen on {address}: {error}; end the program that uses it (another flyrig?), or name another port"
        ),
    }
}
