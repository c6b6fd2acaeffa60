//! Appearance of a person, drawn from a seed.

use flyrig_body::ShapeParams;
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::clothes::wardrobe::{
    Beard, Bottom, Fabric, Footwear, HairCut, Hat, Outer, Print, ShoeKind, SrgbColor, Textile, Top, TopKind,
};
use crate::config::{Build, SimConfig};
use crate::person::features::Features;
use crate::person::palette::{CHINOS, CLOTHS, DENIMS, HAIRS, IRISES, LEATHERS, SHOES, SKINS};

/// Appearance of a person.
#[derive(Debug, Clone)]
pub(crate) struct PersonLook {
    pub shape: ShapeParams,
    pub female: bool,
    pub skin: SrgbColor,
    /// Strength of freckles and moles, 0..=1.
    pub freckles: f32,
    /// Strength of the lips' colour, 0..=1.
    pub lips: f32,
    pub hair: SrgbColor,
    pub iris: SrgbColor,
    pub cut: HairCut,
    pub recede_m: f32,
    pub stubble: f32,
    pub beard: Beard,
    pub hat: Hat,
    pub top: Top,
    pub bottom: Bottom,
    pub outer: Option<Outer>,
    pub shoes: Footwear,
    pub features: Features,
}

/// Random choices from a seed.
struct Dice(StdRng);

impl Dice {
    fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.0.random_range(0..of.len())]
    }

    fn within(&mut self, low: f32, high: f32) -> f32 {
        self.0.random_range(low..high)
    }

    /// Returns a number in a range, denser in its middle.
    fn middling(&mut self, low: f32, high: f32) -> f32 {
        0.5 * (self.within(low, high) + self.within(low, high))
    }

    fn chance(&mut self, share: f32) -> bool {
        self.within(0.0, 1.0) < share
    }

    /// Returns a colour close to one of a palette.
    fn colour(&mut self, of: &[SrgbColor]) -> SrgbColor {
        let light = self.within(-0.05, 0.05);
        self.pick(of).map(|c| (c + light + self.within(-0.025, 0.025)).clamp(0.02, 0.97))
    }

    fn cloth(&mut self, fabric: Fabric, prints: &[Print]) -> Textile {
        let ground = self.colour(&CLOTHS);
        let far = |other: SrgbColor| (0..3).map(|i| (other[i] - ground[i]).abs()).sum::<f32>();
        // A print has to be seen: the farthest of four colours.
        let mut print = self.colour(&CLOTHS);
        for _ in 0..3 {
            let other = self.colour(&CLOTHS);
            if far(other) > far(print) {
                print = other;
            }
        }
        let print_kind = match self.pick(prints) {
            Print::Text(_) => Print::Text(self.0.random_range(0..=255)),
            Print::Logo(_) => Print::Logo(self.0.random_range(0..=255)),
            other => other,
        };
        Textile {
            fabric,
            print: print_kind,
            colours: [ground, print, self.colour(&CLOTHS)],
            scale: self.within(0.75, 1.4),
        }
    }
}

impl PersonLook {
    pub(crate) fn new(config: &SimConfig) -> Self {
        let mut dice = Dice(StdRng::seed_from_u64(config.seed));
        let (mut shape, female, age) = body_shape(config, &mut dice);
        shape.0.extend(config.person.shape.0.clone());
        let tone = dice.within(0.0, SKINS.len() as f32 - 1.001);
        let (low, t) = (tone as usize, tone.fract());
        let warm = dice.within(-0.015, 0.015);
        let mut skin: SrgbColor = std::array::from_fn(|i| SKINS[low][i] + (SKINS[low + 1][i] - SKINS[low][i]) * t);
        skin[0] += warm;
        skin[2] -= warm;
        let dark = tone > 2.4;
        let mut hair = dice.colour(if dark { &HAIRS[..2] } else { &HAIRS }).map(|c| c.max(0.06));
        if age > 0.82 {
            let grey = dice.within(0.5, 0.8);
            hair = hair.map(|c| c * 0.2 + grey * 0.8);
        }
        let iris = if dark { dice.pick(&IRISES[..2]) } else { dice.pick(&IRISES) };
        let cut = hair_cut(&mut dice, female, age);
        let man = !female && age > 0.35;
        let beard = if man {
            let none = Beard::None;
            dice.pick(&[none, none, none, none, Beard::Moustache, Beard::Goatee, Beard::Full, Beard::Full, Beard::Long])
        } else {
            Beard::None
        };
        let (top, bottom) = clothes(&mut dice, female);
        let outer = outer(&mut dice, &bottom);
        Self {
            shape,
            female,
            skin,
            freckles: if dice.chance(0.3) { dice.within(0.3, 1.0) } else { 0.1 },
            lips: if female && age > 0.35 { dice.within(0.4, 1.0) } else { dice.within(0.2, 0.5) },
            hair,
            iris,
            cut,
            recede_m: if man { dice.pick(&[0.0, 0.0, 0.006, 0.014]) } else { 0.0 },
            stubble: if man { dice.pick(&[0.0, 0.3, 0.8]) } else { 0.0 },
            beard,
            hat: hat(&mut dice, cut),
            top,
            bottom,
            outer,
            shoes: footwear(&mut dice),
            features: Features::random(&mut dice.0),
        }
    }
}

/// Returns shape, whether to dress as a woman, and the age axis.
fn body_shape(config: &SimConfig, dice: &mut Dice) -> (ShapeParams, bool, f32) {
    let female = dice.chance(0.5);
    let age = if dice.chance(0.12) {
        dice.within(0.06, 0.34)
    } else if dice.chance(0.25) {
        dice.within(0.78, 1.0)
    } else {
        dice.within(0.45, 0.75)
    };
    // Gender, muscle, weight, height, proportions, age, and how far each is drawn around that.
    let (macros, around) = match config.person.build {
        Build::SlimWoman => ([0.00, 0.38, 0.40, 0.56, 0.90, 0.56], 0.04),
        Build::RoundWoman => ([0.00, 0.40, 0.72, 0.46, 0.70, 0.56], 0.04),
        Build::SlimMan => ([0.96, 0.50, 0.36, 0.62, 0.75, 0.56], 0.04),
        Build::HeavyMan => ([1.00, 0.50, 0.84, 0.55, 0.55, 0.56], 0.04),
        Build::BroadMan => ([1.00, 0.78, 0.58, 0.66, 0.85, 0.56], 0.04),
        Build::BySeed => {
            let gender = if female { dice.within(0.0, 0.25) } else { dice.within(0.75, 1.0) };
            let (muscle, weight) = (dice.middling(0.25, 0.95), dice.middling(0.22, 0.98));
            // The average of this axis is small for a man and tall for a woman.
            let height = if female { dice.middling(0.30, 0.56) } else { dice.middling(0.36, 0.57) };
            ([gender, muscle, weight, height, dice.within(0.35, 0.95), age], 0.01)
        }
    };
    let mut shape = ShapeParams::default();
    for (name, value) in ["gender", "muscle", "weight", "height", "proportions", "age"].into_iter().zip(macros) {
        shape = shape.with(name, (value + dice.within(-around, around)).clamp(0.0, 1.0));
    }
    const LOCALS: [(&str, f32); 14] = [
        ("torso-vshape", 0.4),
        ("torso-scale-horiz", 0.3),
        ("hip-scale-horiz", 0.3),
        ("stomach-tone", 0.5),
        ("buttocks-volume", 0.4),
        ("upperleg-scale-vert", 0.3),
        ("upperarm-fat", 0.4),
        ("neck-scale-horiz", 0.25),
        ("head-fat", 0.6),
        ("head-scale-horiz", 0.35),
        ("head-scale-vert", 0.3),
        ("chin-width", 0.7),
        ("chin-height", 0.5),
        ("chin-prominent", 0.6),
    ];
    for (name, reach) in LOCALS {
        shape = shape.with(name, dice.within(-reach, reach));
    }
    (shape, macros[0] < 0.5, macros[5])
}

fn hair_cut(dice: &mut Dice, female: bool, age: f32) -> HairCut {
    use HairCut::{Bald, Bob, Bun, Crop, Curls, Long, Ponytail, Short};
    if female {
        dice.pick(&[Bob, Bob, Long, Long, Long, Bun, Bun, Ponytail, Ponytail, Curls, Short])
    } else if age > 0.7 {
        dice.pick(&[Bald, Bald, Crop, Short, Short])
    } else {
        dice.pick(&[Crop, Short, Short, Short, Curls, Bob, Bun, if age > 0.4 { Bald } else { Short }])
    }
}

fn hat(dice: &mut Dice, cut: HairCut) -> Hat {
    let kind = dice.within(0.0, 1.0);
    // These do not fit under a hat.
    if matches!(cut, HairCut::Curls | HairCut::Bun) || kind > 0.3 {
        return Hat::None;
    }
    let knit = [Print::Plain, Print::Plain, Print::Stripes];
    match kind {
        k if k < 0.11 => Hat::Beanie(dice.cloth(Fabric::Knit, &knit)),
        k if k < 0.22 => Hat::Cap(dice.cloth(Fabric::Weave, &[Print::Plain, Print::Plain, Print::Camouflage])),
        _ => Hat::Brimmed(dice.cloth(Fabric::Weave, &[Print::Plain])),
    }
}

fn trousers_cloth(dice: &mut Dice) -> Textile {
    let mut cloth = dice.cloth(
        Fabric::Weave,
        &[Print::Plain, Print::Plain, Print::Plain, Print::Plain, Print::Pinstripes, Print::Camouflage, Print::Plaid],
    );
    if dice.chance(0.45) {
        let ground = dice.colour(&DENIMS);
        return Textile { fabric: Fabric::Denim, print: Print::Plain, colours: [ground; 3], ..cloth };
    }
    cloth.colours[0] = dice.colour(&CHINOS);
    cloth.colours[1] = cloth.colours[0].map(|c| if c > 0.4 { c * 0.7 } else { c * 1.4 + 0.05 });
    cloth
}

fn clothes(dice: &mut Dice, female: bool) -> (Top, Bottom) {
    use Print::{Camouflage, Checks, Dots, Gradient, Logo, Pinstripes, Plaid, Plain, Stripes, Text};
    let kind = dice.pick(&[
        TopKind::TShirt,
        TopKind::TShirt,
        TopKind::TShirt,
        TopKind::Shirt,
        TopKind::Shirt,
        TopKind::Jumper,
        TopKind::Jumper,
        TopKind::Turtleneck,
        TopKind::Hoodie,
    ]);
    let cloth = match kind {
        TopKind::TShirt => dice.cloth(
            Fabric::Jersey,
            &[Plain, Stripes, Stripes, Dots, Camouflage, Gradient, Text(0), Text(0), Logo(0), Logo(0)],
        ),
        TopKind::Shirt => dice.cloth(Fabric::Weave, &[Plain, Plain, Checks, Plaid, Plaid, Dots, Pinstripes]),
        TopKind::Jumper => dice.cloth(Fabric::Knit, &[Plain, Stripes, Stripes, Gradient, Checks]),
        TopKind::Turtleneck => dice.cloth(Fabric::Knit, &[Plain, Plain, Stripes]),
        TopKind::Hoodie => dice.cloth(Fabric::Jersey, &[Plain, Text(0), Logo(0), Gradient]),
    };
    let sleeve_m = match kind {
        TopKind::TShirt => dice.within(0.10, 0.20),
        TopKind::Shirt => dice.pick(&[0.21, 0.30, 0.465, 0.465]),
        _ => 0.465,
    };
    let low_neck = kind == TopKind::TShirt || kind == TopKind::Jumper;
    let mut top = Top {
        kind,
        cloth,
        sleeve_m,
        v_neck_m: match kind {
            TopKind::TShirt | TopKind::Jumper if !matches!(cloth.print, Text(_) | Logo(_)) && dice.chance(0.3) => {
                dice.within(0.06, 0.10)
            }
            // The top button is open.
            TopKind::Shirt => 0.045,
            _ => 0.0,
        },
        neck_m: if low_neck { dice.within(0.088, 0.100) } else { 0.080 },
        hem_m: dice.within(0.80, 0.87),
        offset_m: match kind {
            TopKind::Jumper | TopKind::Hoodie => dice.within(0.012, 0.018),
            _ => dice.within(0.008, 0.013),
        },
        tucked: false,
    };
    let lower = dice.within(0.0, 1.0);
    let skirt_share = if female { 0.46 } else { 0.0 };
    if lower < skirt_share {
        let dress = lower < 0.24;
        let hem_m = dice.pick(&[0.52, 0.46, 0.40, 0.28, 0.13]);
        let flare = dice.within(0.04, 0.42);
        let pleats = dice.pick(&[7, 9, 12, 16]);
        top.tucked = true;
        top.hem_m = 0.955;
        if dress {
            top.kind = TopKind::TShirt;
            let prints = [Plain, Plain, Dots, Dots, Stripes, Plaid, Gradient, Checks];
            top.cloth = dice.cloth(Fabric::Weave, &prints);
            top.sleeve_m = dice.pick(&[0.06, 0.10, 0.16, 0.465]);
            top.offset_m = 0.007;
            top.v_neck_m = dice.pick(&[0.0, 0.08]);
            return (top, Bottom::Skirt { cloth: top.cloth, hem_m, flare, pleats });
        }
        top.offset_m = top.offset_m.min(0.010);
        let mut cloth = dice.cloth(Fabric::Weave, &[Plain, Plain, Plaid, Dots, Checks, Stripes]);
        if dice.chance(0.2) {
            cloth = Textile { fabric: Fabric::Denim, print: Plain, colours: [dice.colour(&DENIMS); 3], ..cloth };
        } else if dice.chance(0.15) {
            cloth = Textile { fabric: Fabric::Leather, print: Plain, colours: [dice.colour(&LEATHERS); 3], ..cloth };
        }
        return (top, Bottom::Skirt { cloth, hem_m, flare, pleats });
    }
    let cloth = trousers_cloth(dice);
    if lower > 0.91 && matches!(top.kind, TopKind::TShirt | TopKind::Jumper | TopKind::Turtleneck) {
        top.tucked = true;
        top.offset_m = 0.008;
        return (top, Bottom::Overalls { cloth, hem_m: dice.pick(&[0.062, 0.062, 0.10, 0.48]) });
    }
    let hem_m = if lower > 0.70 { dice.within(0.44, 0.60) } else { dice.pick(&[0.062, 0.062, 0.062, 0.11]) };
    top.tucked = dice.chance(0.15) && top.kind == TopKind::Shirt;
    (top, Bottom::Trousers { cloth, hem_m, wide_m: dice.pick(&[0.0, 0.008, 0.016, 0.030]) })
}

fn outer(dice: &mut Dice, bottom: &Bottom) -> Option<Outer> {
    if matches!(bottom, Bottom::Overalls { .. }) || !dice.chance(0.32) {
        return None;
    }
    let coat = dice.chance(0.42);
    let prints = [Print::Plain, Print::Plain, Print::Plain, Print::Plaid, Print::Pinstripes];
    let mut cloth = dice.cloth(Fabric::Weave, &prints);
    let kind = dice.within(0.0, 1.0);
    if kind < 0.35 {
        let ground = dice.colour(&LEATHERS);
        cloth = Textile { fabric: Fabric::Leather, print: Print::Plain, colours: [ground; 3], ..cloth };
    } else if kind < 0.55 && !coat {
        cloth = Textile { fabric: Fabric::Denim, print: Print::Plain, colours: [dice.colour(&DENIMS); 3], ..cloth };
    } else {
        cloth.colours[0] = dice.colour(&CHINOS);
        cloth.colours[1] = cloth.colours[0].map(|c| if c > 0.4 { c * 0.72 } else { c * 1.5 + 0.06 });
    }
    Some(Outer {
        cloth,
        hem_m: if coat { dice.within(0.34, 0.58) } else { dice.within(0.79, 0.86) },
        open_m: if dice.chance(0.35) { 0.0 } else { dice.within(0.05, 0.10) },
        collar_m: dice.within(0.035, 0.060),
    })
}

fn footwear(dice: &mut Dice) -> Footwear {
    let kind =
        dice.pick(&[ShoeKind::Trainers, ShoeKind::Trainers, ShoeKind::Trainers, ShoeKind::Leather, ShoeKind::Boots]);
    let colours = match kind {
        ShoeKind::Trainers => {
            let [main, accent] = dice.pick(&SHOES);
            [dice.colour(&[main]), dice.colour(&[accent])]
        }
        ShoeKind::Leather | ShoeKind::Boots => [dice.colour(&LEATHERS); 2],
    };
    let white = [0.88, 0.87, 0.85];
    Footwear {
        kind,
        colours,
        sock: if dice.chance(0.4) { white } else { dice.colour(&CLOTHS) },
        sock_m: dice.pick(&[0.0, 0.14, 0.20, 0.36]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_given_shape_changes_those_targets_alone() {
        let look = |shape: ShapeParams| {
            let mut config = SimConfig { seed: 11, ..SimConfig::default() };
            config.person.shape = shape;
            PersonLook::new(&config)
        };
        let of_seed = look(ShapeParams::default());
        let mut found = look(ShapeParams::default().with("weight", 0.9).with("stomach-pregnant", 0.5));
        assert_eq!((found.shape.0["weight"], found.shape.0.remove("stomach-pregnant")), (0.9, Some(0.5)));
        found.shape.0.insert("weight".to_owned(), of_seed.shape.0["weight"]);
        assert!((of_seed.shape.0["weight"] - 0.9).abs() > 1e-3);
        assert_eq!(format!("{found:?}"), format!("{of_seed:?}"));
    }
}
