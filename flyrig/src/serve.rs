//! `flyrig serve`: a web page on which browsers show the people of a running rig.

use std::time::Duration;

use anyhow::Result;
use flyrig_report::stop;
use flyrig_web::{WebConfig, WebServer};

use crate::cli::ServeArgs;

/// How often Ctrl-C is looked at.
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

/// Runs the command.
pub fn serve(args: &ServeArgs) -> Result<()> {
    stop::flag();
    let transport = args.rig.transport()?;
    let (rig, connect) = (transport.rig.clone(), transport.connect.join(", "));
    let server = WebServer::start(&args.web, transport)?;
    eprintln!("serve: rig '{rig}' at {connect}; open {} in a browser (Ctrl-C ends)", server.link());
    print_fingerprint("serve", &server, &args.web);
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
