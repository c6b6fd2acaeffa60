//! `flyrig serve`: a web page on which browsers show the people of a running rig.

use std::time::Duration;

use anyhow::Result;
use flyrig_report::stop;
use flyrig_transport::TransportConfig;
use flyrig_web::{WebOptions, WebServer};

use crate::{cli::ServeArgs, config::WebSection};

/// How often Ctrl-C is looked at.
const TURN: Duration = Duration::from_millis(100);

/// Runs the command.
pub fn serve(args: &ServeArgs) -> Result<()> {
    stop::flag();
    let transport = TransportConfig { connect: vec![args.connect.clone()], ..TransportConfig::subscriber(&args.rig) };
    let server = start(&args.web, transport)?;
    eprintln!("serve: rig '{}' at {}; open {} in a browser (Ctrl-C ends)", args.rig, args.connect, server.link());
    let mut browsers = 0;
    while !stop::requested() {
        std::thread::sleep(TURN);
        let now = server.browsers();
        if std::mem::replace(&mut browsers, now) != now {
            eprintln!("serve: {now} browsers");
        }
    }
    Ok(())
}

/// Starts the server of a rig's web page.
pub fn start(settings: &WebSection, transport: TransportConfig) -> Result<WebServer> {
    let WebSection { listen, insecure, names, max_browsers } = settings.clone();
    let server = WebServer::start(&WebOptions { listen: listen.parse()?, insecure, names, max_browsers, transport })?;
    if insecure && !server.address().ip().is_loopback() {
        tracing::warn!(
            "the web page at {} is not encrypted: whoever can read this network can watch. Who watches needs the whole link",
            server.address()
        );
    }
    Ok(server)
}
