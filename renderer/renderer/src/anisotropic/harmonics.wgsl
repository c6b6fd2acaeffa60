// Colour by direction: real spherical harmonics up to order 2 with the signs of the 3D Gaussian Splatting reference code
// (Kerbl et al. 2023), and their derivatives.
// Prefix: the attribute `harmonics`, const COEFFICIENTS (1, 4 or 9).
const C0 = 0.28209479177387814;
const C1 = 0.4886025119029199;
const C2_XY = 1.0925484305920792;
const C2_ZZ = 0.31539156525252005;
const C2_XX = 0.5462742152960396;

// Unclamped colour of Gaussian `i` in the unit direction `d`.
fn unclamped_color(i: u32, d: vec3<f32>) -> vec3<f32> {
    let at = i * COEFFICIENTS;
    var color = C0 * harmonics[at].rgb;
    if COEFFICIENTS >= 4u {
        color += C1 * (d.z * harmonics[at + 2u].rgb - d.y * harmonics[at + 1u].rgb - d.x * harmonics[at + 3u].rgb);
    }
    if COEFFICIENTS >= 9u {
        color += C2_XY * (d.x * d.y * harmonics[at + 4u].rgb - d.y * d.z * harmonics[at + 5u].rgb
                          - d.x * d.z * harmonics[at + 7u].rgb)
            + C2_ZZ * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y) * harmonics[at + 6u].rgb
            + C2_XX * (d.x * d.x - d.y * d.y) * harmonics[at + 8u].rgb;
    }
    return color;
}

// Values of the harmonics in the unit direction `d`.
fn basis(d: vec3<f32>) -> array<f32, 9> {
    return array<f32, 9>(
        C0,
        -C1 * d.y, C1 * d.z, -C1 * d.x,
        C2_XY * d.x * d.y, -C2_XY * d.y * d.z, C2_ZZ * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y),
        -C2_XY * d.x * d.z, C2_XX * (d.x * d.x - d.y * d.y),
    );
}

// dL/d direction, its part along the direction included, given dL/d colour.
fn direction_slope(i: u32, d: vec3<f32>, d_color: vec3<f32>) -> vec3<f32> {
    let at = i * COEFFICIENTS;
    var slope = vec3(0.0);
    if COEFFICIENTS >= 4u {
        slope += C1 * vec3(-dot(d_color, harmonics[at + 3u].rgb), -dot(d_color, harmonics[at + 1u].rgb),
                           dot(d_color, harmonics[at + 2u].rgb));
    }
    if COEFFICIENTS >= 9u {
        let xy = C2_XY * dot(d_color, harmonics[at + 4u].rgb);
        let yz = -C2_XY * dot(d_color, harmonics[at + 5u].rgb);
        let zz = 2.0 * C2_ZZ * dot(d_color, harmonics[at + 6u].rgb);
        let xz = -C2_XY * dot(d_color, harmonics[at + 7u].rgb);
        let xx = 2.0 * C2_XX * dot(d_color, harmonics[at + 8u].rgb);
        slope += vec3(xy * d.y + xz * d.z + (xx - zz) * d.x, xy * d.x + yz * d.z - (xx + zz) * d.y,
                      yz * d.y + xz * d.x + 2.0 * zz * d.z);
    }
    return slope;
}
