//! WebSocket of one browser.

use std::{sync::Arc, time::Duration};

use flyrig_access::ConnectionPlace;
use futures_util::{SinkExt as _, StreamExt as _};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use tokio::time::timeout;
use tokio_tungstenite::{
    WebSocketStream,
    tungstenite::{
        Message,
        protocol::{CloseFrame, Role, WebSocketConfig, frame::coding::CloseCode},
    },
};

use crate::{guard::Token, hub::Hub};

/// Time limit of the token of a browser's link.
const TOKEN_PATIENCE: Duration = Duration::from_secs(5);
/// Time limit of sending a message; a slower browser is disconnected.
const SEND_PATIENCE: Duration = Duration::from_secs(20);
/// Largest message of a browser, bytes.
const LONGEST: usize = 1024;

/// Serves a browser until it leaves; it keeps its place once it has shown the token.
pub(crate) async fn serve(
    upgraded: Upgraded,
    hub: &Arc<Hub>,
    token: &Token,
    most: usize,
    connection: &mut ConnectionPlace,
) {
    let config = WebSocketConfig::default()
        .read_buffer_size(4096)
        .write_buffer_size(0)
        .max_message_size(Some(LONGEST))
        .max_frame_size(Some(LONGEST));
    let mut socket = WebSocketStream::from_raw_socket(TokioIo::new(upgraded), Role::Server, Some(config)).await;
    let Some((code, reason)) = talk(&mut socket, hub, token, most, connection).await else { return };
    let close = CloseFrame { code, reason: reason.into() };
    // A browser that does not respond is closed all the same.
    let _ = timeout(TOKEN_PATIENCE, socket.close(Some(close))).await;
}

/// Serves a browser; returns why it is disconnected, or `None` when it left by itself.
async fn talk(
    socket: &mut WebSocketStream<TokioIo<Upgraded>>,
    hub: &Arc<Hub>,
    token: &Token,
    most: usize,
    connection: &mut ConnectionPlace,
) -> Option<(CloseCode, &'static str)> {
    let admitted = match timeout(TOKEN_PATIENCE, socket.next()).await {
        Ok(Some(Ok(Message::Text(given)))) => token.admits(&given),
        Ok(Some(Ok(Message::Close(_)) | Err(_)) | None) => return None,
        Ok(Some(Ok(_))) | Err(_) => false,
    };
    if !admitted {
        return Some((CloseCode::Policy, "the link's token is wrong or missing; use the link that flyrig printed"));
    }
    let Some(place) = hub.join(most) else {
        return Some((CloseCode::Again, "all places are taken; try again later"));
    };
    connection.established();
    loop {
        tokio::select! {
            received = socket.next() => match received {
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                Some(Ok(Message::Close(_)) | Err(_)) | None => return None,
                Some(Ok(_)) => return Some((CloseCode::Policy, "the page sent an unexpected message")),
            },
            bytes = place.next() => match timeout(SEND_PATIENCE, socket.send(Message::Binary(bytes))).await {
                Ok(Ok(())) => {}
                Ok(Err(_)) => return None,
                Err(_) => return Some((CloseCode::Policy, "the network is too slow")),
            },
        }
    }
}
