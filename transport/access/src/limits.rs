//! Bounds, per address, on connections that are not established yet.

use std::{collections::HashMap, net::IpAddr, time::Instant};

use flyrig_types::saturating_secs;

/// Connections per second that one address may begin on average.
const PER_SECOND: f64 = 20.0;
/// Connections that one address may begin at once.
const BURST: f64 = 40.0;
/// Handshakes of one address at a time.
const PENDING_OF_ONE: usize = 16;
/// Handshakes at a time.
const PENDING: usize = 256;
/// Largest number of addresses that are remembered.
const ADDRESSES: usize = 4096;
/// Mask of the bits that identify an IPv6 network.
const V6_NETWORK: u128 = !0 << 64;

/// Counts of one network.
#[derive(Debug)]
struct Visitor {
    /// Connections that may begin at `at`.
    left: f64,
    at: Instant,
    pending: usize,
}

/// Whether a handshake may begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Begin {
    /// It has begun; [`Limits::end`] must follow.
    Begun,
    /// Not before a handshake of another address has ended.
    Full,
    /// The address must wait.
    TooMany,
}

/// Counts of connections by address.
#[derive(Debug, Default)]
pub(crate) struct Limits {
    visitors: HashMap<IpAddr, Visitor>,
    pending: usize,
}

/// Returns the network that counts as one client: an IPv4 address, or 64 bits of an IPv6 address.
pub(crate) fn network(address: IpAddr) -> IpAddr {
    match address {
        IpAddr::V4(_) => address,
        IpAddr::V6(v6) => v6.to_ipv4_mapped().map_or_else(
            || IpAddr::V6((u128::from_be_bytes(v6.octets()) & V6_NETWORK).to_be_bytes().into()),
            IpAddr::V4,
        ),
    }
}

impl Limits {
    /// Begins a handshake of an address.
    pub fn begin(&mut self, address: IpAddr, now: Instant) -> Begin {
        if self.visitors.len() >= ADDRESSES {
            // After this time a visitor has its whole burst again.
            let full = saturating_secs(BURST / PER_SECOND);
            self.visitors.retain(|_, visitor| visitor.pending > 0 || now.duration_since(visitor.at) < full);
        }
        let network = network(address);
        if self.visitors.len() >= ADDRESSES && !self.visitors.contains_key(&network) {
            return Begin::TooMany;
        }
        let visitor = self.visitors.entry(network).or_insert(Visitor { left: BURST, at: now, pending: 0 });
        let since = now.duration_since(visitor.at).as_secs_f64();
        visitor.left = (visitor.left + since * PER_SECOND).min(BURST);
        visitor.at = now;
        if visitor.left < 1.0 || visitor.pending >= PENDING_OF_ONE {
            return Begin::TooMany;
        }
        if self.pending >= PENDING {
            return Begin::Full;
        }
        visitor.left -= 1.0;
        visitor.pending += 1;
        self.pending += 1;
        Begin::Begun
    }

    /// Ends a handshake.
    pub fn end(&mut self, address: IpAddr) {
        if let Some(visitor) = self.visitors.get_mut(&network(address)) {
            visitor.pending = visitor.pending.saturating_sub(1);
        }
        self.pending = self.pending.saturating_sub(1);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn one_address_does_not_use_up_the_room_of_others() {
        let (mut limits, now) = (Limits::default(), Instant::now());
        let (noisy, calm) = (IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2]));
        assert_eq!((0..1000).filter(|_| limits.begin(noisy, now) == Begin::Begun).count(), PENDING_OF_ONE);
        assert_eq!(limits.begin(calm, now), Begin::Begun);
        // Handshakes that end make room, until the burst is used up.
        (0..PENDING_OF_ONE).for_each(|_| limits.end(noisy));
        let mut begun = PENDING_OF_ONE;
        while limits.begin(noisy, now) == Begin::Begun {
            limits.end(noisy);
            begun += 1;
        }
        assert_eq!(begun, BURST as usize);
        // Then the rate per second applies.
        let later = |tenths: u64| now + Duration::from_millis(100 * tenths);
        let slow =
            (1..=100).filter(|tenth| (0..50).any(|_| limits.begin(noisy, later(*tenth)) == Begin::Begun)).count();
        assert!(slow >= 14, "{slow}");
    }

    #[test]
    fn many_addresses_are_bounded_and_forgotten() {
        let (mut limits, now) = (Limits::default(), Instant::now());
        let mut begun = 0;
        for n in 0..100_000u32 {
            begun += usize::from(limits.begin(IpAddr::from(n.to_be_bytes()), now) == Begin::Begun);
        }
        assert_eq!(begun, PENDING);
        assert_eq!(limits.begin(IpAddr::from(0u32.to_be_bytes()), now), Begin::Full, "an address that has few");
        assert!(limits.visitors.len() <= ADDRESSES);
        let later = now + Duration::from_secs(60);
        (0..PENDING as u32).for_each(|n| limits.end(IpAddr::from(n.to_be_bytes())));
        assert_eq!(limits.begin(IpAddr::from([1, 2, 3, 4]), later), Begin::Begun);
        assert!(limits.visitors.len() < 10);
    }

    #[test]
    fn an_ipv6_network_is_one_visitor() {
        let (mut limits, now) = (Limits::default(), Instant::now());
        let of = |host: u16| IpAddr::from([0x2001, 0xdb8, 0, 1, 0, 0, 0, host]);
        assert_eq!((0..1000).filter(|host| limits.begin(of(*host), now) == Begin::Begun).count(), PENDING_OF_ONE);
        assert_eq!(limits.begin(IpAddr::from([0x2001, 0xdb8, 0, 2, 0, 0, 0, 1]), now), Begin::Begun);
        assert_eq!(network("::ffff:10.0.0.1".parse().unwrap()), IpAddr::from([10, 0, 0, 1]));
    }
}
