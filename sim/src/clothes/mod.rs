//! Clothes: what people wear, the sheets that garments are cut from, and the textures of cloth.

pub(crate) mod collars;
pub(crate) mod cuts;
pub(crate) mod fabric;
pub(crate) mod garments;
pub(crate) mod glyphs;
pub(crate) mod hanging;
pub(crate) mod lift;
pub(crate) mod loose;
pub(crate) mod prints;
pub(crate) mod sheet;
pub(crate) mod straps;
pub(crate) mod wardrobe;
