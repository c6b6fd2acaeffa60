//! Places of connections that are not established yet. While there is none for a new connection, the oldest one of the address that has the
//! most is ended: slow or silent clients, however many, keep nobody out, and those of one address nobody of another.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::Mutex,
    time::{Duration, Instant},
};

use flyrig_types::lock;

use tokio::{
    task::{AbortHandle, yield_now},
    time::sleep,
};

use crate::limits::network;

/// Time that each connection has before it may be ended: clients that come all at once do not end those that are about to be answered.
const YOUNG: Duration = Duration::from_millis(50);

/// Connection that may be ended.
#[derive(Debug)]
struct Place {
    number: u64,
    network: IpAddr,
    begun: Instant,
    task: AbortHandle,
}

/// Connections that are not established, the oldest first.
#[derive(Debug, Default)]
pub(crate) struct Places(Vec<Place>);

impl Places {
    /// Adds the task that serves connection `number`.
    pub fn add(&mut self, number: u64, address: IpAddr, task: AbortHandle) {
        self.0.push(Place { number, network: network(address), begun: Instant::now(), task });
    }

    /// Removes a connection that was established, or has ended.
    pub fn remove(&mut self, number: u64) {
        self.0.retain(|place| place.number != number);
    }

    /// Returns the index of the oldest connection of the address that has the most.
    fn oldest(&self) -> Option<usize> {
        let mut counts: HashMap<IpAddr, usize> = HashMap::new();
        for place in &self.0 {
            *counts.entry(place.network).or_default() += 1;
        }
        let most = counts.values().copied().max();
        self.0.iter().position(|place| counts.get(&place.network).copied() == most)
    }

    /// Ends that connection if it is older than [`YOUNG`]; otherwise returns the time until it is. `None` when there is none.
    fn end_oldest(&mut self) -> Option<Duration> {
        let at = self.oldest()?;
        let left = self.0.get(at).map_or(Duration::ZERO, |place| YOUNG.saturating_sub(place.begun.elapsed()));
        if left.is_zero() {
            self.0.remove(at).task.abort();
        }
        Some(left)
    }
}

/// Waits until a connection can be ended, and ends it; returns false when there is none.
pub(crate) async fn make_room(places: &Mutex<Places>) -> bool {
    loop {
        let left = lock(places).end_oldest();
        let Some(left) = left else { return false };
        if left.is_zero() {
            // Its task drops the connection.
            yield_now().await;
            return true;
        }
        sleep(left).await;
    }
}

#[cfg(test)]
mod tests {
    use std::future::pending;

    use tokio::{runtime, task::JoinHandle};

    use super::*;

    #[test]
    fn the_address_with_the_most_connections_makes_room_once_they_had_their_time() {
        let runtime = runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let tasks: Vec<_> = (0..6).map(|_| tokio::spawn(pending::<()>())).collect();
            let places = Mutex::<Places>::default();
            let begun = Instant::now();
            for (number, host) in [1, 2, 2, 1, 2, 3].into_iter().enumerate() {
                lock(&places).add(number as u64, IpAddr::from([10, 0, 0, host]), tasks[number].abort_handle());
            }
            // Established.
            lock(&places).remove(5);
            let mut order = Vec::new();
            loop {
                let before: Vec<bool> = tasks.iter().map(JoinHandle::is_finished).collect();
                if !make_room(&places).await {
                    break;
                }
                assert!(begun.elapsed() >= YOUNG);
                order.extend((0..6).filter(|n| tasks[*n].is_finished() && !before[*n]));
            }
            assert_eq!(order, [1, 0, 2, 3, 4]);
            assert!(!tasks[5].is_finished());
        });
    }
}
