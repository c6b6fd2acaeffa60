//! Determinism: a seed determines the person and every byte.

#![allow(clippy::unwrap_used)]

mod common;

use common::{simulator, small_config};

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_another_person() {
    let [mut a, mut b, mut other] = [7, 7, 8].map(|seed| simulator(&small_config(seed)));
    let nanos = a.frame_nanos(11);
    for slot in 0..2 {
        // Another instant in between must leave no trace.
        b.capture(b.frame_nanos(40), slot).unwrap();
        let (x, y, z) =
            (a.render(nanos, slot).unwrap(), b.render(nanos, slot).unwrap(), other.render(nanos, slot).unwrap());
        assert_eq!(x.color.bytes(), y.color.bytes());
        assert_eq!(x.mask, y.mask);
        assert_eq!(x.depth, y.depth);
        assert_eq!(x.canonical, y.canonical);
        assert_eq!(x.part, y.part);
        assert_eq!(a.plate(slot).unwrap().bytes(), b.plate(slot).unwrap().bytes());
        assert_ne!(x.color.bytes(), z.color.bytes());
        assert_ne!(x.mask, z.mask);
    }
    assert_eq!(a.clothed_surface(nanos), b.clothed_surface(nanos));
    assert_ne!(a.template().positions, other.template().positions);
}
