//! LoGAvatar's local networks: the lists of an avatar's Gaussians as outputs of networks that neighbours share.

pub(crate) mod atlas_map;
mod decoders;
mod groups;
mod hash;
pub(crate) mod networks;
mod texture;
