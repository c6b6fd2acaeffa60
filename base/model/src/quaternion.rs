//! Quaternions `[x, y, z, w]` in `f32` for code without `std`; elsewhere `glam` serves.
//!
//! ```
//! use flyrig_model::quaternion::{from_rows, matrix, product, unit};
//!
//! // A quarter turn around z, twice: half a turn.
//! let quarter = unit([0.0, 0.0, 1.0, 1.0]);
//! let half = product(quarter, quarter);
//! assert!((half[2] - 1.0).abs() < 1e-6);
//! assert!((matrix(half)[0][0] + 1.0).abs() < 1e-6);
//! assert!((from_rows(matrix(quarter))[2] - quarter[2]).abs() < 1e-6);
//! ```

/// Rotation by nothing.
pub const IDENTITY: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Returns the quaternion scaled to length 1, or [`IDENTITY`] for one whose length is next to 0 or not finite.
#[must_use]
pub fn unit(q: [f32; 4]) -> [f32; 4] {
    let squared = q.iter().map(|v| v * v).sum::<f32>();
    if squared > 1e-20 && squared.is_finite() { q.map(|v| v / libm::sqrtf(squared)) } else { IDENTITY }
}

/// Returns the product `a b`: the rotation by `b`, followed by that by `a`.
#[must_use]
pub fn product([ax, ay, az, aw]: [f32; 4], [bx, by, bz, bw]: [f32; 4]) -> [f32; 4] {
    [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
}

/// Returns the rows of the rotation matrix of a unit quaternion.
#[inline]
#[must_use]
pub fn matrix([x, y, z, w]: [f32; 4]) -> [[f32; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Returns the unit quaternion of the rotation matrix with these rows.
#[must_use]
pub fn from_rows([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]: [[f32; 3]; 3]) -> [f32; 4] {
    // The largest component first, so that nothing is divided by a small number.
    unit(if xx + yy + zz > 0.0 {
        [zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz]
    } else if xx > yy && xx > zz {
        [1.0 + xx - yy - zz, xy + yx, xz + zx, zy - yz]
    } else if yy > zz {
        [xy + yx, 1.0 + yy - xx - zz, yz + zy, xz - zx]
    } else {
        [xz + zx, yz + zy, 1.0 + zz - xx - yy, yx - xy]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SplitMix64;

    #[test]
    fn matrices_return_their_quaternions_and_products_multiply_matrices() {
        let mut random = SplitMix64(3);
        for _ in 0..2000 {
            let mut any = || unit(core::array::from_fn(|_| random.signed() as f32));
            let (a, b) = (any(), any());
            let back = from_rows(matrix(a));
            let along: f32 = back.iter().zip(a).map(|(p, q)| p * q).sum();
            assert!((along.abs() - 1.0).abs() < 1e-5, "{a:?} {back:?}");
            let (first, second, both) = (matrix(b), matrix(a), matrix(product(a, b)));
            for (i, row) in both.iter().enumerate() {
                for (k, found) in row.iter().enumerate() {
                    let expected: f32 = (0..3).map(|j| second[i][j] * first[j][k]).sum();
                    assert!((found - expected).abs() < 1e-5);
                }
            }
        }
    }

    #[test]
    fn poison_is_the_identity() {
        for poison in [[0.0; 4], [f32::NAN; 4], [f32::INFINITY; 4], [1e30, 0.0, 0.0, 0.0]] {
            assert_eq!(unit(poison).map(f32::to_bits), IDENTITY.map(f32::to_bits));
        }
    }
}
