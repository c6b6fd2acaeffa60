//! Kinds of garments, hair and hats, and the cloth they are made of.

/// sRGB colour in 0..=1.
pub(crate) type SrgbColor = [f32; 3];

/// Structure of a cloth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fabric {
    /// Smooth cotton jersey.
    Jersey,
    /// Plain weave with visible threads.
    Weave,
    Denim,
    Knit,
    Leather,
}

/// Printed or woven pattern of a cloth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Print {
    Plain,
    /// Stripes across the body.
    Stripes,
    /// Stripes down the body.
    Pinstripes,
    Checks,
    Plaid,
    Dots,
    Camouflage,
    /// Gradient from the first colour above to the second below.
    Gradient,
    /// One of the words of [`crate::clothes::glyphs`] on the chest.
    Text(u8),
    /// One of the marks of [`crate::clothes::fabric`] on the chest.
    Logo(u8),
}

/// Cloth with its pattern and colours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Textile {
    pub fabric: Fabric,
    pub print: Print,
    /// Colours of ground, print and accent.
    pub colours: [SrgbColor; 3],
    /// Scale of the print relative to a common one.
    pub scale: f32,
}

/// Kind of a top.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TopKind {
    TShirt,
    Shirt,
    Jumper,
    Turtleneck,
    Hoodie,
}

/// Garment of the upper body; lengths in metres on the average body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Top {
    pub kind: TopKind,
    pub cloth: Textile,
    /// Length along the arm from the shoulder joint; the wrist is at 0.48.
    pub sleeve_m: f32,
    pub v_neck_m: f32,
    /// Radius of the neck opening.
    pub neck_m: f32,
    /// Height of the hem above the sole.
    pub hem_m: f32,
    /// Distance from the body.
    pub offset_m: f32,
    /// Whether its hem is under the waistband.
    pub tucked: bool,
}

/// Garment of the lower body; lengths in metres on the average body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Bottom {
    /// Trousers and shorts. `wide_m` is the additional distance of the hem from the leg, compared with the hip's.
    Trousers { cloth: Textile, hem_m: f32, wide_m: f32 },
    /// Trousers with a bib and straps.
    Overalls { cloth: Textile, hem_m: f32 },
    /// Separate skirt, or that of a dress (whose top is of the same cloth). `flare` is metres outwards per metre down.
    Skirt { cloth: Textile, hem_m: f32, flare: f32, pleats: u8 },
}

/// Garment over all others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Outer {
    pub cloth: Textile,
    /// Height of the hem, metres on the average body; below the hip the garment is a coat.
    pub hem_m: f32,
    /// Half the width of the front opening at the hem, metres; 0 for a closed one.
    pub open_m: f32,
    pub collar_m: f32,
}

/// Cut of the hair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HairCut {
    Bald,
    Crop,
    Short,
    Curls,
    Bob,
    Long,
    Bun,
    Ponytail,
}

/// Facial hair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Beard {
    None,
    Moustache,
    Goatee,
    Full,
    Long,
}

/// Headwear.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Hat {
    None,
    Beanie(Textile),
    Cap(Textile),
    Brimmed(Textile),
}

/// Kind of shoes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ShoeKind {
    Trainers,
    Leather,
    Boots,
}

/// Shoes and socks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Footwear {
    pub kind: ShoeKind,
    /// Upper and accents.
    pub colours: [SrgbColor; 2],
    pub sock: SrgbColor,
    /// Height of the socks, metres on the average body.
    pub sock_m: f32,
}
