//! Places of connections that are not established yet. While there is none for a new connection, the oldest one of the address that has the
//! most is ended: slow or silent clients, however many, keep nobody out, and those of one address nobody of another.

use std::{collections::HashMap, net::IpAddr};

use tokio::task::AbortHandle;

use crate::limits::network;

/// Connection that may be ended.
#[derive(Debug)]
struct Place {
    number: u64,
    network: IpAddr,
    task: AbortHandle,
}

/// Connections that are not established, the oldest first.
#[derive(Debug, Default)]
pub(crate) struct Places(Vec<Place>);

impl Places {
    /// Adds the task that serves connection `number`.
    pub fn add(&mut self, number: u64, address: IpAddr, task: AbortHandle) {
        self.0.push(Place { number, network: network(address), task });
    }

    /// Removes a connection that was established, or has ended.
    pub fn remove(&mut self, number: u64) {
        self.0.retain(|place| place.number != number);
    }

    /// Ends the oldest connection of the address that has the most; returns false when there is none.
    pub fn end_oldest(&mut self) -> bool {
        let mut counts: HashMap<IpAddr, usize> = HashMap::new();
        for place in &self.0 {
            *counts.entry(place.network).or_default() += 1;
        }
        let most = counts.values().copied().max();
        let Some(at) = self.0.iter().position(|place| counts.get(&place.network).copied() == most) else {
            return false;
        };
        self.0.remove(at).task.abort();
        true
    }
}
