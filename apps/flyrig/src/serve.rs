//! `flyrig serve`: a web page on which browsers show the people of a running rig.

use std::{
    net::{Ipv4Addr, TcpListener},
    path::PathBuf,
    time::Duration,
};

use anyhow::{Context as _, Result};
use clap::Args;
use flyrig_fusion::check_threads;
use flyrig_report::stop;
use flyrig_transport::{Relay, TransportConfig};
use flyrig_web::{WebConfig, WebServer};

use crate::arguments::RigArgs;

/// Arguments of `flyrig serve`.
#[derive(Debug, Args)]
pub struct ServeArgs {
    #[command(flatten)]
    pub rig: RigArgs,
    /// Folder of the keys of this relay (`flyrig keys new RIG --host THIS-COMPUTER`), whose holders watch the rig through it with `flyrig view`.
    #[arg(long, value_name = "FOLDER")]
    pub keys: Option<PathBuf>,
    #[command(flatten)]
    pub web: WebConfig,
}

/// Interval at which Ctrl-C is checked.
const TURN: Duration = Duration::from_millis(100);

/// Prints the fingerprint of the server's certificate, for comparison with the one that a browser shows.
pub fn print_fingerprint(command: &str, server: &WebServer, config: &WebConfig) {
    let Some(fingerprint) = server.fingerprint() else { return };
    eprintln!("{command}: SHA-256 of the certificate: {fingerprint}");
    if config.certificate.as_os_str().is_empty() {
        eprintln!(
            "{command}: browsers warn of a certificate that signs itself; compare its SHA-256. It is new in each run: with --certificate and --key \
             ([web] certificate, key) it is kept in these files, and so is one that a browser trusts"
        );
    }
}

/// Returns a free loopback endpoint, at which the page reaches the relay of the same program.
fn free_endpoint() -> Result<String> {
    let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).and_then(|listener| listener.local_addr());
    Ok(format!("tcp/{}", free.context("no free port on this computer")?))
}

/// Runs the command.
pub fn serve(args: &ServeArgs) -> Result<()> {
    stop::flag();
    let mut transport = args.rig.transport()?;
    let (rig, connect) = (transport.rig.clone(), transport.connect.join(", "));
    let relay = args.keys.clone().map(|keys| -> Result<Relay> {
        let listen = vec![free_endpoint()?];
        let relay = Relay::start(
            &transport,
            &TransportConfig { keys, listen: listen.clone(), ..TransportConfig::publisher(&rig) },
        )?;
        // Browsers and viewers share what the rig sends.
        transport = TransportConfig { connect: listen, ..TransportConfig::subscriber(&rig) };
        Ok(relay)
    });
    let relay = relay.transpose()?;
    let server = WebServer::start(&args.web, transport)?;
    eprintln!("serve: rig '{rig}' at {connect}; open {} in a browser (Ctrl-C ends)", server.link());
    print_fingerprint("serve", &server, &args.web);
    let (mut browsers, mut state) = (0, String::new());
    while !stop::requested() {
        std::thread::sleep(TURN);
        let now = server.browsers();
        if std::mem::replace(&mut browsers, now) != now {
            eprintln!("serve: {now} browsers");
        }
        let Some(relay) = &relay else { continue };
        check_threads([relay.thread()])?;
        let now = match (relay.trouble(), relay.gate()) {
            (Some(trouble), _) => trouble,
            (None, Some(gate)) => format!("passing rig '{rig}' on to holders of this relay's keys at {gate}"),
            (None, None) => continue,
        };
        if now != state {
            eprintln!("serve: {now}");
            state = now;
        }
    }
    Ok(())
}
