//! What a seed decides about a person.

use flyrig_body::ShapeParams;
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::{Build, SimConfig};

/// sRGB in 0..=1.
pub(crate) type Srgb = [f32; 3];

/// Print of a top.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Print {
    Plain,
    Stripes,
    Checks,
    Dots,
}

/// Cut of the hair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HairCut {
    Crop,
    Short,
    Bob,
    Bun,
}

/// Everything about the person's looks.
#[derive(Debug, Clone)]
pub(crate) struct Look {
    pub shape: ShapeParams,
    pub female: bool,
    pub skin: Srgb,
    pub hair: Srgb,
    pub iris: Srgb,
    pub cut: HairCut,
    pub recede_m: f32,
    pub stubble: f32,
    pub print: Print,
    pub logo: bool,
    /// Ground and print of the top.
    pub top: [Srgb; 2],
    pub sleeve_m: f32,
    pub v_neck_m: f32,
    pub top_offset_m: f32,
    pub knit: bool,
    pub denim: bool,
    pub bottom: Srgb,
    pub bottom_offset_m: f32,
    pub shoe: [Srgb; 2],
}

const SKINS: [Srgb; 6] = [
    [0.90, 0.73, 0.63],
    [0.87, 0.68, 0.56],
    [0.80, 0.60, 0.47],
    [0.70, 0.49, 0.36],
    [0.53, 0.35, 0.25],
    [0.40, 0.26, 0.19],
];
const HAIRS: [Srgb; 6] = [
    [0.10, 0.08, 0.07],
    [0.20, 0.13, 0.09],
    [0.33, 0.21, 0.13],
    [0.55, 0.40, 0.24],
    [0.42, 0.20, 0.10],
    [0.50, 0.48, 0.46],
];
const IRISES: [Srgb; 4] = [[0.30, 0.19, 0.11], [0.25, 0.38, 0.52], [0.30, 0.42, 0.28], [0.18, 0.11, 0.07]];
const TOPS: [[Srgb; 2]; 8] = [
    [[0.90, 0.89, 0.86], [0.14, 0.22, 0.42]],
    [[0.74, 0.16, 0.15], [0.95, 0.90, 0.82]],
    [[0.13, 0.34, 0.36], [0.93, 0.78, 0.36]],
    [[0.93, 0.76, 0.27], [0.20, 0.22, 0.28]],
    [[0.27, 0.45, 0.70], [0.94, 0.94, 0.92]],
    [[0.45, 0.50, 0.36], [0.88, 0.86, 0.76]],
    [[0.83, 0.52, 0.47], [0.33, 0.16, 0.23]],
    [[0.24, 0.24, 0.27], [0.85, 0.42, 0.22]],
];
const CHINOS: [Srgb; 5] =
    [[0.63, 0.55, 0.42], [0.30, 0.32, 0.25], [0.22, 0.23, 0.27], [0.46, 0.34, 0.27], [0.36, 0.38, 0.42]];
const SHOES: [[Srgb; 2]; 5] = [
    [[0.88, 0.88, 0.86], [0.20, 0.35, 0.55]],
    [[0.16, 0.16, 0.18], [0.85, 0.85, 0.83]],
    [[0.60, 0.20, 0.18], [0.92, 0.90, 0.86]],
    [[0.40, 0.28, 0.19], [0.24, 0.17, 0.12]],
    [[0.22, 0.30, 0.46], [0.92, 0.92, 0.90]],
];

impl Look {
    pub(crate) fn new(config: &SimConfig) -> Self {
        let mut rng = StdRng::seed_from_u64(config.seed);
        let builds = [Build::SlimWoman, Build::BroadMan, Build::RoundWoman, Build::SlimMan, Build::HeavyMan];
        // Neighbouring seeds differ in build; the rest is drawn.
        let by_seed = builds[(config.seed.wrapping_sub(1) % builds.len() as u64) as usize];
        let build = if config.person.build == Build::BySeed { by_seed } else { config.person.build };
        let [gender, muscle, weight, height, proportions] = match build {
            Build::SlimWoman => [0.00, 0.38, 0.40, 0.56, 0.90],
            Build::RoundWoman => [0.00, 0.40, 0.72, 0.46, 0.70],
            Build::SlimMan => [0.96, 0.50, 0.36, 0.62, 0.75],
            Build::HeavyMan => [1.00, 0.50, 0.84, 0.55, 0.55],
            Build::BroadMan | Build::BySeed => [1.00, 0.78, 0.58, 0.66, 0.85],
        };
        let female = gender < 0.5;
        let mut jitter = |value: f32| (value + rng.random_range(-0.04..0.04f32)).clamp(0.0, 1.0);
        let shape = ShapeParams::default()
            .with("gender", jitter(gender))
            .with("muscle", jitter(muscle))
            .with("weight", jitter(weight))
            .with("height", jitter(height))
            .with("proportions", jitter(proportions))
            .with("age", jitter(0.56));
        let mut pick = |count: usize| rng.random_range(0..count);
        let print = [Print::Stripes, Print::Plain, Print::Checks, Print::Dots][pick(4)];
        let (skin, mut hair) = (pick(SKINS.len()), pick(HAIRS.len()));
        if skin >= 3 {
            hair %= 2;
        }
        let long_sleeves = pick(2) == 0;
        let denim = pick(3) > 0;
        let cuts = if female { [HairCut::Bob, HairCut::Bun] } else { [HairCut::Short, HairCut::Crop] };
        let cut = cuts[pick(2)];
        let logo = print == Print::Plain || pick(3) == 0;
        let v_neck = pick(3) == 0 && !logo;
        Self {
            shape,
            female,
            skin: SKINS[skin],
            hair: HAIRS[hair],
            iris: IRISES[if skin >= 3 { [0, 3][pick(2)] } else { pick(IRISES.len()) }],
            cut,
            recede_m: if female { 0.0 } else { 0.008 * pick(3) as f32 },
            stubble: if female { 0.0 } else { 0.4 * pick(3) as f32 },
            print,
            logo,
            top: TOPS[pick(TOPS.len())],
            sleeve_m: if long_sleeves { 0.465 } else { 0.16 },
            v_neck_m: if v_neck { 0.09 } else { 0.0 },
            top_offset_m: if long_sleeves { 0.011 } else { 0.010 },
            knit: long_sleeves,
            denim,
            bottom: if denim { [0.17, 0.25, 0.41] } else { CHINOS[pick(CHINOS.len())] },
            bottom_offset_m: 0.009,
            shoe: SHOES[pick(SHOES.len())],
        }
    }
}
