//! Clothes whose shape the body's surface cannot take: skirts, long coats, shoes.

use crate::{BodyError, Shoes, Skirt, Template};

/// Clothes with a surface of their own; others are part of the body and its deformation.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Outfit {
    /// Skirt or long coat, if any.
    pub skirt: Option<Skirt>,
    /// Shoes; `None` for bare feet.
    pub shoes: Option<Shoes>,
}

impl Outfit {
    /// Returns whether the outfit is empty.
    #[must_use]
    pub fn is_bare(self) -> bool {
        self == Self::default()
    }

    /// Returns the body in this outfit, with unchanged joints.
    ///
    /// # Errors
    /// As [`Skirt::on`] and [`Shoes::on`].
    pub fn on(self, body: &Template) -> Result<Template, BodyError> {
        let shod = self.shoes.map(|shoes| shoes.on(body)).transpose()?;
        let shod = shod.as_ref().unwrap_or(body);
        self.skirt.map_or_else(|| Ok(shod.clone()), |skirt| skirt.on(shod))
    }
}

impl std::fmt::Display for Outfit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match (self.skirt, self.shoes) {
            (Some(_), Some(_)) => "a skirt or long coat, shoes",
            (Some(_), None) => "a skirt or long coat",
            (None, Some(_)) => "shoes",
            (None, None) => "bare feet",
        })
    }
}
