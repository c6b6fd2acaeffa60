//! `flyrig serve`: a web page on which browsers show the people of a running rig.

use std::time::Duration;

use anyhow::Result;
use flyrig_report::stop;
use flyrig_transport::TransportConfig;
use flyrig_web::WebServer;

use crate::cli::ServeArgs;

/// How often Ctrl-C is looked at.
const TURN: Duration = Duration::from_millis(100);

/// Runs the command.
pub fn serve(args: &ServeArgs) -> Result<()> {
    stop::flag();
    let transport = TransportConfig { connect: vec![args.connect.clone()], ..TransportConfig::subscriber(&args.rig) };
    let server = WebServer::start(&args.web, transport)?;
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
