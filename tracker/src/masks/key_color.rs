//! Masks and mattes before a screen of one colour.
//!
//! A screen's chroma (linear light less its mean) lies along that of the key colour, and its strength varies slowly over
//! the image with the lamps. Coverage is the missing share of the screen's chroma; chroma that remains on the foreground is
//! spill.

use std::fmt;
use std::str::FromStr;

use crate::image::grid::Grid;
use crate::image::light::{byte, linear_of_bytes};
use crate::image::pixels::Rgb;
use crate::masks::edge_color::{EdgeColor, Matte};

/// Least cosine between the chroma of a screen pixel and that of the key.
const SCREEN_COSINE: f32 = 0.94;
/// Least chroma of a screen pixel as a share of the key's: a screen in the shade.
const LEAST_CHROMA: f32 = 0.12;
/// Share of an image that must show the screen for the key to be used.
const LEAST_SCREEN: f32 = 0.02;
/// Half side of the square in which the screen's light is averaged, pixels.
const LOCAL_PX: usize = 24;
/// Least share of its chroma that a screen keeps in a shadow.
const SHADOW: f32 = 0.35;
/// Largest spill that is removed, as a share of the screen's chroma: more is the foreground's own colour.
const SPILL: f32 = 0.3;

/// Colour of a screen behind the people.
///
/// ```
/// use flyrig_tracker::KeyColor;
///
/// let key: KeyColor = "#00b140".parse()?;
/// assert_eq!("green".parse::<KeyColor>()?, key);
/// assert!("#808080".parse::<KeyColor>().is_err(), "grey has no chroma that separates a screen from people");
/// # Ok::<(), flyrig_tracker::KeyColorError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyColor {
    rgb: [u8; 3],
    /// Linear light less its mean.
    chroma: [f32; 3],
}

/// Error of a text that names no key colour.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no key colour; use \"green\", \"blue\" or a saturated colour such as \"#00b140\"")]
pub struct KeyColorError(String);

impl FromStr for KeyColor {
    type Err = KeyColorError;

    fn from_str(text: &str) -> Result<Self, KeyColorError> {
        let error = || KeyColorError(text.to_owned());
        let rgb = match text {
            "green" => [0x00, 0xb1, 0x40],
            "blue" => [0x00, 0x47, 0xbb],
            _ => {
                let digits = text.strip_prefix('#').filter(|digits| digits.len() == 6 && digits.is_ascii());
                let digits = digits.ok_or_else(error)?;
                let channel = |k: usize| u8::from_str_radix(&digits[2 * k..2 * k + 2], 16).map_err(|_| error());
                [channel(0)?, channel(1)?, channel(2)?]
            }
        };
        let key = Self { rgb, chroma: chroma(linear_of_bytes(rgb)) };
        // Grey has no chroma by which to separate it.
        if dot(key.chroma, key.chroma).sqrt() < 0.1 { Err(error()) } else { Ok(key) }
    }
}

impl fmt::Display for KeyColor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [r, g, b] = self.rgb;
        write!(f, "#{r:02x}{g:02x}{b:02x}")
    }
}

/// Screen as one image shows it.
#[derive(Debug, PartialEq)]
pub(crate) struct Screen {
    /// Chroma of each pixel along the key's, over that of the screen there: 1 on the screen.
    share: Grid,
    /// Strength of the screen's chroma along the key's at each pixel.
    strength: Grid,
    /// Linear light of the screen where it shines with strength 1.
    light: [f32; 3],
    /// Whether each pixel shows the screen alone.
    is_screen: Vec<bool>,
}

impl Screen {
    /// Returns the screen's linear light at a pixel.
    pub fn at(&self, pixel: usize) -> [f32; 3] {
        self.light.map(|light| light * self.strength.values[pixel])
    }
}

impl KeyColor {
    /// Measures the screen in an image; `None` when it shows no screen of this colour.
    pub(crate) fn screen(&self, picture: &Rgb) -> Option<Screen> {
        let (width, height) = (picture.width, picture.height);
        let key2 = dot(self.chroma, self.chroma);
        let mut along = Grid::new(width, height, 0.0);
        let mut is_screen = vec![false; width * height];
        let mut sum = [0.0f64; 3];
        for ((value, is_screen), bytes) in
            along.values.iter_mut().zip(&mut is_screen).zip(picture.bytes.chunks_exact(3))
        {
            let light = linear_of_bytes([bytes[0], bytes[1], bytes[2]]);
            let own = chroma(light);
            let length = dot(own, own).sqrt();
            *value = dot(own, self.chroma) / key2;
            *is_screen = *value > LEAST_CHROMA && *value * key2.sqrt() > SCREEN_COSINE * length;
            if *is_screen {
                (0..3).for_each(|k| sum[k] += f64::from(light[k]));
            }
        }
        let mut seen: Vec<f64> =
            along.values.iter().zip(&is_screen).filter(|(_, is)| **is).map(|(v, _)| f64::from(*v)).collect();
        if (seen.len() as f32) < LEAST_SCREEN * (width * height) as f32 {
            return None;
        }
        let count = seen.len() as f64;
        let typical = flyrig_solve::median(&mut seen)? as f32;
        // Dark pixels of the screen's hue are its shadows, or mixtures with the foreground.
        for (is_screen, value) in is_screen.iter_mut().zip(&along.values) {
            *is_screen &= *value > 0.6 * typical;
        }
        let mean = |value: &dyn Fn(usize) -> f32| {
            let values = (0..is_screen.len()).map(|at| if is_screen[at] { value(at) } else { 0.0 }).collect();
            Grid { width, height, values }.box_mean(LOCAL_PX)
        };
        let (total, known) = (mean(&|at| along.values[at]), mean(&|_| 1.0));
        // Far from the screen the typical strength is used.
        let strengths = total.values.iter().zip(&known.values).map(|(t, n)| (t + 0.01 * typical) / (n + 0.01));
        let strength = Grid { width, height, values: strengths.collect() };
        let shares = along.values.iter().zip(&strength.values).map(|(a, s)| a / s);
        let share = Grid { width, height, values: shares.collect() };
        let light = sum.map(|s| (s / count) as f32 / typical);
        Some(Screen { share, strength, light, is_screen })
    }

    /// Returns evidence for a foreground inside `bounds` (x0, y0, x1, y1, ends excluded), 0..=1 with the border at one
    /// half.
    pub(crate) fn evidence(&self, picture: &Rgb, screen: &Screen, [x0, y0, x1, y1]: [usize; 4]) -> Grid {
        let mut evidence = Grid::new(x1 - x0, y1 - y0, 0.0);
        let key = dot(self.chroma, self.chroma).sqrt();
        let pixels = (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y)));
        for (value, (x, y)) in evidence.values.iter_mut().zip(pixels) {
            let at = y * picture.width + x;
            let share = screen.share.values[at];
            let own = chroma(linear_of_bytes(picture.pixel(x, y)));
            let cosine = dot(own, self.chroma) / (key * dot(own, own).sqrt()).max(1e-6);
            *value = (1.0 - share).clamp(0.0, 1.0);
            if screen.is_screen[at] || share > SHADOW && cosine > SCREEN_COSINE {
                *value = value.min(0.35);
            }
        }
        evidence
    }

    /// Subtracts the screen's spill from the colours of a matte of the image that shows it.
    pub(crate) fn despill(&self, picture: &Rgb, screen: &Screen, matte: &mut Matte) {
        let mut colors = Vec::new();
        let mut solved = std::mem::take(&mut matte.colors).into_iter().peekable();
        for (at, coverage) in matte.mask.coverage().iter().enumerate() {
            let own = solved.next_if(|color| color.pixel as usize == at);
            if *coverage == 0 {
                continue;
            }
            let seen = picture.pixel(at % picture.width, at / picture.width);
            let light = linear_of_bytes(own.map_or(seen, |color| color.rgb));
            let spill = dot(chroma(light), self.chroma) / dot(self.chroma, self.chroma);
            let spill = spill.clamp(0.0, SPILL * screen.strength.values[at]);
            let rgb = std::array::from_fn(|k| byte(light[k] - spill * self.chroma[k]));
            if rgb != seen {
                colors.push(EdgeColor { pixel: at as u32, rgb });
            }
        }
        matte.colors = colors;
    }
}

/// Returns linear light less its mean.
fn chroma(light: [f32; 3]) -> [f32; 3] {
    let mean = (light[0] + light[1] + light[2]) / 3.0;
    light.map(|c| c - mean)
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Image, Mask, PixelFormat};

    use super::*;
    use crate::masks::background::Background;
    use crate::masks::matte::matte;
    use crate::testing::small_camera;

    const SIDE: usize = 96;

    fn picture(paint: impl Fn(usize, usize) -> [f32; 3]) -> Image {
        let bytes: Vec<u8> = (0..SIDE * SIDE).flat_map(|at| paint(at % SIDE, at / SIDE).map(byte)).collect();
        Image::new(SIDE as u32, SIDE as u32, PixelFormat::Rgb8, bytes).unwrap()
    }

    /// A green screen that is brighter at the left, with a shadow below.
    fn screen(x: usize, y: usize) -> [f32; 3] {
        let light = linear_of_bytes([0x10, 0xa8, 0x48]);
        let lamp = (1.2 - 0.006 * x as f32) * if y > 80 { 0.6 } else { 1.0 };
        light.map(|c| c * lamp)
    }

    /// A disc with a soft edge.
    fn truth(x: usize, y: usize) -> f32 {
        let radius = ((x as f32 - 45.3).powi(2) + (y as f32 - 44.6).powi(2)).sqrt();
        (25.4 - radius).clamp(-0.5, 0.5) + 0.5
    }

    const SHIRT: [f32; 3] = [0.35, 0.12, 0.1];

    fn background(key: &str) -> Background {
        Background::from_key(&small_camera("a", SIDE), key.parse().unwrap())
    }

    fn scene() -> Image {
        picture(|x, y| {
            let (alpha, back) = (truth(x, y), screen(x, y));
            std::array::from_fn(|k| alpha * SHIRT[k] + (1.0 - alpha) * back[k])
        })
    }

    #[test]
    fn names_and_codes_are_read_and_greys_and_nonsense_refused() {
        assert_eq!("green".parse::<KeyColor>().unwrap().to_string(), "#00b140");
        assert_eq!("#1020F0".parse::<KeyColor>().unwrap().to_string(), "#1020f0");
        for text in ["", "red-ish", "#12345", "#12345g", "#808080", "#000000", "#12\u{20ac}4", "00b140"] {
            let error = text.parse::<KeyColor>().unwrap_err();
            assert!(error.to_string().contains("#00b140"), "{error}");
        }
    }

    #[test]
    fn a_disc_before_a_screen_of_uneven_light_is_found_and_its_shadow_is_not() {
        let image = scene();
        let (key, picture) = ("green".parse::<KeyColor>().unwrap(), Rgb::new(&image).unwrap());
        let evidence = key.evidence(&picture, &key.screen(&picture).unwrap(), [0, 0, SIDE, SIDE]);
        let wrong = (0..SIDE * SIDE)
            .filter(|at| {
                let inside = truth(at % SIDE, at / SIDE);
                inside > 0.9 && evidence.values[*at] < 0.5 || inside < 0.1 && evidence.values[*at] >= 0.5
            })
            .count();
        assert_eq!(wrong, 0);
    }

    #[test]
    fn coverage_is_that_of_the_mixture_and_colours_hold_no_green() {
        let image = scene();
        let coverage: Vec<u8> =
            (0..SIDE * SIDE).map(|at| if truth(at % SIDE, at / SIDE) >= 0.2 { 255 } else { 0 }).collect();
        let mask = Mask::new(SIDE as u32, SIDE as u32, coverage).unwrap();
        let solved = matte(&image, &mask, Some(&background("green")), None).unwrap();
        let mut errors = Vec::new();
        for (at, alpha) in solved.mask.coverage().iter().enumerate() {
            let truth = truth(at % SIDE, at / SIDE);
            if truth > 0.0 && truth < 1.0 {
                errors.push((f64::from(*alpha) / 255.0 - f64::from(truth)).abs());
            }
        }
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!(errors.len() > 80 && mean < 0.06, "{mean} of {} pixels", errors.len());
        for color in &solved.colors {
            let [r, g, _] = color.rgb;
            let alpha = solved.mask.coverage()[color.pixel as usize];
            assert!(alpha < 100 || g < r, "{color:?}, coverage {alpha}");
        }
    }

    #[test]
    fn without_a_screen_nothing_is_keyed() {
        let key: KeyColor = "blue".parse().unwrap();
        let black = picture(|_, _| [0.0; 3]);
        assert!(key.screen(&Rgb::new(&scene()).unwrap()).is_none(), "the screen is green");
        assert!(key.screen(&Rgb::new(&black).unwrap()).is_none());
        let mask = Mask::new(SIDE as u32, SIDE as u32, vec![255; SIDE * SIDE]).unwrap();
        let solved = matte(&black, &mask, Some(&background("blue")), None).unwrap();
        assert_eq!(solved, Matte { mask, colors: Vec::new() });
    }
}
