// sRGB (IEC 61966-2-1) of linear light, both in 0..=1, as flyrig_model::srgb::encode.
fn srgb_from_linear(linear: f32) -> f32 {
    return select(1.055 * pow(linear, 1.0 / 2.4) - 0.055, linear * 12.92, linear <= 0.0031308);
}
