//! Smooth random fields, determined by their seed.

use glam::Vec3;

/// Random field over space.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Noise(u32);

impl Noise {
    pub(crate) fn new(seed: u64, stream: u32) -> Self {
        Self(mix((seed ^ (seed >> 32)) as u32 ^ mix(stream.wrapping_add(0x9e37_79b9))))
    }

    /// Evaluates trilinear value noise with unit cells, smoothed, in -1..=1.
    pub(crate) fn at(self, p: Vec3) -> f32 {
        let cell = p.floor();
        let t = p - cell;
        let t = t * t * (Vec3::splat(3.0) - 2.0 * t);
        let [x, y, z] = cell.as_ivec3().to_array();
        let corner = |dx: i32, dy: i32, dz: i32| self.cell(x.wrapping_add(dx), y.wrapping_add(dy), z.wrapping_add(dz));
        let edge = |dy, dz| lerp(corner(0, dy, dz), corner(1, dy, dz), t.x);
        lerp(lerp(edge(0, 0), edge(1, 0), t.y), lerp(edge(0, 1), edge(1, 1), t.y), t.z)
    }

    /// Sums `octaves` fields, each of twice the frequency and half the amplitude, in -1..=1.
    pub(crate) fn sum(self, p: Vec3, octaves: u32) -> f32 {
        let (mut total, mut weight, mut height, mut q) = (0.0, 0.0, 1.0, p);
        for octave in 0..octaves {
            total += height * Self(self.0.wrapping_add(octave)).at(q);
            weight += height;
            height *= 0.5;
            q *= 2.03;
        }
        total / weight
    }

    /// Returns a number in -1..=1 for a cell of a grid.
    pub(crate) fn cell(self, x: i32, y: i32, z: i32) -> f32 {
        let h = mix(self.0 ^ mix((x as u32).wrapping_add(mix((y as u32).wrapping_add(mix(z as u32))))));
        (h >> 8) as f32 / 8_388_607.5 - 1.0
    }
}

/// Hashes an integer with full avalanche (two rounds of multiply and shift).
fn mix(mut h: u32) -> u32 {
    h ^= h >> 16;
    h = h.wrapping_mul(0x7feb_352d);
    h ^= h >> 15;
    h = h.wrapping_mul(0x846c_a68b);
    h ^ (h >> 16)
}

pub(crate) fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Rises smoothly from 0 below `low` to 1 above `high`; falls when `low > high`.
pub(crate) fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_bounded_continuous_and_differs_by_seed() {
        let (a, b) = (Noise::new(1, 0), Noise::new(2, 0));
        let mut differs = false;
        for i in 0..1000 {
            let p = Vec3::new(i as f32 * 0.37 - 180.0, i as f32 * 0.11, -(i as f32) * 0.053);
            let value = a.sum(p, 3);
            assert!(value.abs() <= 1.0);
            assert!((a.at(p) - a.at(p + Vec3::splat(1e-3))).abs() < 0.02);
            differs |= (value - b.sum(p, 3)).abs() > 0.1;
        }
        assert!(differs);
    }
}
