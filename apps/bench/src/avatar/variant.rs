//! Variants of the fit of an avatar, the rows of the ablation tables.

use clap::ValueEnum;
use flyrig_avatar::{AtlasLayout, AvatarFitSettings, LocalSettings};
use flyrig_fit::{ErrorWeights, FitSettings};

/// A variant of the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Variant {
    /// Independent attributes of every Gaussian.
    Direct,
    /// `direct` without light: the light of the room is part of the colours.
    NoLight,
    /// `direct` without the attraction between neighbours.
    NoPull,
    /// `direct` with corrections of the poses of the take.
    RefinePoses,
    /// `direct` with corrections of the skin weights (LoGAvatar Eq. 15).
    SkinCorrection,
    /// `direct` with both corrections.
    RefineBoth,
    /// `direct` with corrections of each frame's node translations.
    RefineNodes,
    /// `direct` with the error of fine detail (unsharp mask).
    Sharpen,
    /// Shared networks and an atlas of colours (LoGAvatar Eq. 11 to 14).
    #[value(name = "logavatar")]
    LogAvatar,
    /// `logavatar` without the atlas: independent colours of every Gaussian.
    LocalGeometry,
    /// `logavatar` without networks of geometry: independent places, sizes and opacities.
    LocalColors,
    /// `logavatar` with the error of fine detail.
    LogavatarSharpen,
    /// `logavatar` without the attraction between neighbours.
    LogavatarNoPull,
    /// `logavatar` without light.
    LogavatarNoLight,
    /// `logavatar` that predicts geometry in two stages.
    #[value(name = "logavatar-stages-2")]
    LogavatarStages2,
    /// `logavatar` with one Gaussian per anchor in place of 4.
    #[value(name = "logavatar-group-1")]
    LogavatarGroup1,
    /// `logavatar` with 20 Gaussians per anchor in place of 4.
    #[value(name = "logavatar-group-20")]
    LogavatarGroup20,
    /// `logavatar` with an atlas of the front and the back in place of texture coordinates.
    LogavatarFrontBack,
    /// `logavatar` with 128 texels along a side of the atlas in place of 256.
    #[value(name = "logavatar-texels-128")]
    LogavatarTexels128,
}

impl Variant {
    /// Returns the name in tables, that of the command line.
    pub fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    /// Returns the settings of the fit.
    pub fn fit_settings(self) -> FitSettings {
        let sharpness = match self {
            Self::Sharpen | Self::LogavatarSharpen => 1.0,
            _ => 0.0,
        };
        FitSettings { weights: ErrorWeights { sharpness, ..ErrorWeights::default() }, ..FitSettings::default() }
    }

    /// Returns the settings of the avatar in the fit, `base` changed by the variant.
    pub fn avatar_settings(self, base: AvatarFitSettings) -> AvatarFitSettings {
        match self {
            Self::NoLight | Self::LogavatarNoLight => AvatarFitSettings { light: false, ..base },
            Self::NoPull | Self::LogavatarNoPull => AvatarFitSettings { pull: 0.0, ..base },
            Self::RefinePoses => AvatarFitSettings { refine_poses: true, ..base },
            Self::SkinCorrection => AvatarFitSettings { skin_correction: true, ..base },
            Self::RefineNodes => AvatarFitSettings { refine_nodes: true, ..base },
            Self::RefineBoth => AvatarFitSettings { refine_poses: true, skin_correction: true, ..base },
            _ => base,
        }
    }

    /// Returns the settings of the shared networks; `None` for variants without any.
    pub fn local_settings(self) -> Option<LocalSettings> {
        let base = LocalSettings::default();
        Some(match self {
            Self::LogAvatar | Self::LogavatarSharpen | Self::LogavatarNoPull | Self::LogavatarNoLight => base,
            Self::LocalGeometry => LocalSettings { colors: false, ..base },
            Self::LocalColors => LocalSettings { geometry: false, ..base },
            Self::LogavatarStages2 => LocalSettings { stages: 2, ..base },
            Self::LogavatarGroup1 => LocalSettings { group: 1, ..base },
            Self::LogavatarGroup20 => LocalSettings { group: 20, ..base },
            Self::LogavatarFrontBack => LocalSettings { layout: AtlasLayout::FrontBack, ..base },
            Self::LogavatarTexels128 => LocalSettings { side: 128, ..base },
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_variant_but_the_first_changes_something_of_its_own() {
        let of = |variant: Variant| {
            let avatar = variant.avatar_settings(AvatarFitSettings::default());
            format!("{:?} {avatar:?} {:?}", variant.fit_settings(), variant.local_settings())
        };
        let mut all: Vec<String> = Variant::value_variants().iter().map(|&variant| of(variant)).collect();
        let count = all.len();
        all.sort();
        all.dedup();
        assert_eq!(all.len(), count);
    }
}
