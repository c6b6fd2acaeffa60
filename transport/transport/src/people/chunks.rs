//! Queries for templates and present colours, in chunks beside motion.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use flyrig_stream::{MAX_TEMPLATE_BYTES, template_hash};
use zenoh::{
    Session, Wait,
    handlers::FifoChannelHandler,
    qos::{CongestionControl, Priority},
    query::Reply,
};

use crate::{error::TransportError, keys};

/// Bytes of a template per reply, which fit in one batch of zenoh's, so that a slow line drops no fragments.
pub(crate) const CHUNK: usize = 60_000;
/// Chunks under way at once: enough for 20 Mbit/s with 100 ms, and fewer than the places in the sender's queue.
const AT_ONCE: usize = 6;
/// Time limit of a chunk.
const CHUNK_PATIENCE: Duration = Duration::from_secs(5);

/// Fetches a template, or present colours, in chunks, some of them under way at once, and checks the hash.
pub(crate) fn ask_template(
    session: &Session,
    rig: &str,
    hash: u64,
    timeout: Duration,
) -> Result<Option<Vec<u8>>, TransportError> {
    let deadline = flyrig_types::deadline_after(timeout);
    let malformed = |problem: String| TransportError::malformed(keys::chunk_label(hash, 0), problem);
    let ask = |chunk: u32| ask_chunk(session, &keys::key(rig, &keys::chunk_label(hash, chunk)), deadline);
    let (mut bytes, mut count) = (Vec::new(), 1);
    let mut under_way = VecDeque::from([ask(0)?]);
    let mut asked = 1;
    for chunk in 0.. {
        let Some(replies) = under_way.pop_front() else { break };
        let mut part = received(&replies);
        if part.is_none() && chunk > 0 {
            // The chunk was dropped on the way.
            part = received(&ask(chunk)?);
        }
        let Some((size, part)) = part else { return Ok(None) };
        if size > MAX_TEMPLATE_BYTES {
            return Err(malformed(format!("a template of {size} bytes, at most {MAX_TEMPLATE_BYTES}")));
        }
        bytes.extend(part);
        count = count.max(size.div_ceil(CHUNK) as u32);
        while asked < count && under_way.len() < AT_ONCE {
            under_way.push_back(ask(asked)?);
            asked += 1;
        }
    }
    if template_hash(&bytes) == hash {
        Ok(Some(bytes))
    } else {
        Err(malformed("the answer is another template".to_owned()))
    }
}

type Replies = FifoChannelHandler<Reply>;

/// Queries a key once; the reply is short.
pub(crate) fn ask(session: &Session, key: &str, deadline: Instant) -> Result<Option<Vec<u8>>, TransportError> {
    let replies = ask_chunk(session, key, deadline)?;
    let payload = |reply: Reply| Some(reply.into_result().ok()?.payload().to_bytes().into_owned());
    Ok(replies.recv().ok().and_then(payload))
}

fn ask_chunk(session: &Session, key: &str, deadline: Instant) -> Result<Replies, TransportError> {
    let left = deadline.saturating_duration_since(Instant::now()).min(CHUNK_PATIENCE);
    session
        .get(key)
        // The reply inherits both: a stalled subscriber must not block the publisher's session, and motion goes first.
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::DataHigh)
        .timeout(left)
        .wait()
        .map_err(|error| TransportError::session(key, &error))
}

/// Returns the template's size and the bytes of a chunk; `None` when it did not arrive.
fn received(replies: &Replies) -> Option<(usize, Vec<u8>)> {
    let payload = replies.recv().ok()?.into_result().ok()?.payload().to_bytes().into_owned();
    let (size, chunk) = payload.split_first_chunk().filter(|(_, chunk)| chunk.len() <= CHUNK)?;
    Some((u32::from_le_bytes(*size) as usize, chunk.to_vec()))
}
